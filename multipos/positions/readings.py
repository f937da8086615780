"""Readings: what the sensor said at each position, how well it is known, and where it was.

A reading is the mean output of one position held still. A position read more than once stays
more than one row (a repeat), because the spread of repeats is the only pure measure of error.
Columns of a readings file, beside the outputs, are listed in `docs/reference/formats`.

`Readings` holds them; `select_outputs` and `select_rows` return some of them, `require_range`
refuses readings outside stated limits. The noise that they state is `Readings.noise`: variances
(n M,) where outputs are independent, else their covariance (n M, n M), output running fastest.
`stated_sd`, `diagonal` and `add_variances` read and extend it, `spread_reading_sd` makes it of an
option.
"""

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import MultiposError, UsageError
from multipos.files.records import LONGEST
from multipos.files.spelling import control_characters, numbered, require_columns, tuple_of, visible
from multipos.finding import Findings
from multipos.numerics.arrays import FEWEST, LARGEST, SMALLEST, Array, Mask, as_numbers
from multipos.positions import attitudes
from multipos.positions.forces import along_forces, known_rows
from multipos.results import Frozen, Result, Tabular, frozen

# What has a value a row, beside the environment and the covariance.
_BY_ROW = (
    *("values", "u", "dof", "sd", "samples", "orientation_sd", "up", "rotation", "force"),
    *("reference_u", "group", "open_roll"),
)


@frozen
class Readings(Result, Tabular):
    """Averaged readings of M outputs at n positions, with all that is known of them.

    Attributes
    ----------
    values : (n, M) array
        Mean outputs, in `unit`.
    outputs : tuple of M str
    positions : tuple of n str or None
        Labels; a label that comes again repeats the position.
    up : (n, 3) array or None
        Unit vectors pointing up, in case axes.
    rotation : (n, 3, 3) array or None
        Level (ENU) to case; NaN where the heading is open.
    force : (n, 3) array or None [g]
        Known specific force, NaN in rows that are at rest in gravity; `up` is its direction there.
    reference_u : (n, 3) array or None [g]
        Standard uncertainty of each component of the force that acted, 0 where it is exact.
    u : (n, M) array or None
        Standard uncertainty of each mean, in `unit`.
    covariance : (n M, n M) array or None
        Full covariance of the readings, output running fastest; instead of `u`.
    sd : (n, M) array or None
        Standard deviation of one sample; reported, never turned into `u`.
    samples : (n,) array or None
        Number of samples averaged; reported, never turned into `u`.
    orientation_sd : (n,) array or None [rad]
        How far each position may be from where it should be, per axis; inf = unknown, and NaN,
        as an empty cell is read, is taken as that.
    group : tuple of n str or None
        Rows of one group share one unknown rotation of the case; '' is no group.
    environment : mapping of str to (n,) array
        Temperature, time and other columns that are not outputs.
    unit : str
        Unit of the readings.
    source, sha256 : str or None
        The file they came from, and its digest.
    findings : tuple of Finding
        What was left out on reading, in words.
    dof : (n, M) array or None
        Degrees of freedom of `u`; infinite where None.
    open_roll : tuple of n str or None
        The case axis of a roll whose angle is open, '' for any other position; `up` is NaN there.
    plane : tuple of str
        The two axes of the plane that all positions were turned in, where angles alone tell them;
        a fit then has these components.

    Examples
    --------
    >>> import multipos as mp
    >>> up = mp.read_scheme("faces-6").up
    >>> readings = mp.Readings(0.01 + 0.99 * up, outputs=("ax", "ay", "az"), up=up, unit="g")
    >>> len(readings), readings.outputs, readings.unit
    (6, ('ax', 'ay', 'az'), 'g')
    >>> readings.values[:2].round(3)
    array([[ 1.  ,  0.01,  0.01],
           [-0.98,  0.01,  0.01]])
    """

    values: Array
    outputs: tuple[str, ...] = ()
    positions: tuple[str, ...] | None = field(default=None, compare=False)  # `labels` are
    up: Array | None = None
    rotation: Array | None = None
    u: Array | None = None
    covariance: Array | None = None
    sd: Array | None = None
    samples: Array | None = None
    orientation_sd: Array | None = None
    group: tuple[str, ...] | None = None
    environment: Mapping[str, Array] = field(default_factory=dict)
    unit: str = "reading"
    source: str | None = field(default=None, compare=False)
    sha256: str | None = None
    findings: Findings = ()
    force: Array | None = None
    reference_u: Array | None = None
    dof: Array | None = None
    open_roll: tuple[str, ...] | None = None
    plane: tuple[str, ...] = ()

    def columns(self) -> dict[str, Any]:
        """Return the means with sd, u and its dof, beside the up vectors and other columns."""
        found: dict[str, Any] = {"position": self.labels}
        if self.up is not None:
            found |= dict(zip(attitudes.UP, self.up.T, strict=True))
        if self.samples is not None:
            found["n"] = self.samples
        found |= dict(zip(self.outputs, self.values.T, strict=True))
        for prefix in ("sd", "u", "dof"):
            beside = getattr(self, prefix)
            if beside is not None:
                found |= {f"{prefix}_{n}": beside[:, i] for i, n in enumerate(self.outputs)}
        return found | dict(self.environment)

    def __eq__(self, other: object) -> bool:
        same = super().__eq__(other)
        return self.labels == other.labels if isinstance(other, Readings) and same else same

    __hash__ = None  # type: ignore[assignment]  # arrays have no hash

    def __post_init__(self) -> None:
        """Check shapes and values once, and keep read-only copies of the arrays."""
        values = _array("values", self.values, None)
        if values.ndim == 1:
            values = values[:, None]
        if values.ndim != 2 or not values.size:
            raise MultiposError(
                f"`values` must have shape (n, outputs), got {values.shape}; "
                "give one row per position."
            )
        n, m = values.shape
        _set(self, "values", values)
        _set(self, "outputs", self._named(m))
        self._freeze_arrays(n, m)
        self._freeze_labels(n)
        if self.source is not None:  # a file may be called anything
            _set(self, "source", visible(self.source))
        self._check_text()
        self._check_signs()
        self._check_sizes()
        if self.u is not None and self.covariance is not None:
            raise MultiposError("`u` and `covariance` both state the reading noise; give one.")
        self._normalise_up()

    def _freeze_arrays(self, n: int, m: int) -> None:
        for name, shape in (
            ("u", (n, m)),
            ("dof", (n, m)),
            ("covariance", (n * m, n * m)),
            ("sd", (n, m)),
            ("samples", (n,)),
            ("orientation_sd", (n,)),
            ("up", (n, 3)),
            ("rotation", (n, 3, 3)),
            ("force", (n, 3)),
            ("reference_u", (n, 3)),
        ):
            given = getattr(self, name)
            if given is not None:
                _set(self, name, _array(name, given, shape))
        if self.orientation_sd is not None:
            unknown = np.isnan(self.orientation_sd)
            _set(self, "orientation_sd", _readonly(np.where(unknown, np.inf, self.orientation_sd)))
        columns = {
            str(name): _array(f"environment['{name}']", column, (n,))
            for name, column in self.environment.items()
        }
        _set(self, "environment", Frozen(columns))

    def _freeze_labels(self, n: int) -> None:
        for name in ("positions", "group", "open_roll"):
            given = getattr(self, name)
            if given is not None:
                _set(self, name, tuple(str(label) for label in given))
                if len(given) != n:
                    raise MultiposError(f"`{name}` must have {n} labels, got {len(given)}.")
        strange = set(self.open_roll or ()) - {"x", "y", "z", ""}
        if strange:
            raise MultiposError(f"`open_roll` is x, y, z or '', got '{min(strange)}'.")

    def __len__(self) -> int:
        return len(self.values)

    @property
    def labels(self) -> tuple[str, ...]:
        """The position labels, or 1, 2, … where the readings have none."""
        if self.positions is not None:
            return self.positions
        return numbered(len(self))

    @property
    def forced(self) -> Mask:
        """Rows whose specific force is known as it stands, (n,)."""
        if self.force is None:
            return np.zeros(len(self), dtype=bool)
        return known_rows(self.force)

    @property
    def rolled(self) -> Mask:
        """Rows that are rolls of open angle, (n,)."""
        if self.open_roll is None:
            return np.zeros(len(self), dtype=bool)
        return np.array([axis != "" for axis in self.open_roll])

    @property
    def noise(self) -> Array | None:
        """The stated noise: variances (n M,) where outputs are independent, or (n M, n M)."""
        if self.u is not None:
            return np.asarray(self.u.ravel() ** 2)
        if self.covariance is None:
            return None
        variances = np.diag(self.covariance)
        dependent = np.any(self.covariance - np.diag(variances))
        return self.covariance if dependent else variances.copy()

    def _named(self, m: int) -> tuple[str, ...]:
        if len(self.outputs) == 0:
            return ("ax", "ay", "az")[:m] if m <= 3 else tuple(f"a{i + 1}" for i in range(m))
        names = tuple(map(str, tuple_of(self.outputs, "`outputs`")))
        if len(names) != m:
            raise MultiposError(f"`outputs` must name {m} columns, got {len(names)}: {names}.")
        if len(set(names)) < m:
            raise MultiposError(f"`outputs` names a column twice: {', '.join(names)}.")
        return names

    def _check_text(self) -> None:
        """Refuse names and labels that no file holds, or that would do something to a terminal."""
        named = {"outputs": self.outputs, "environment": self.environment, "unit": (self.unit,)}
        for name, labels in {**named, "positions": self.positions, "group": self.group}.items():
            for row, label in enumerate(labels or (), start=1):
                if len(label) > LONGEST:
                    raise MultiposError(
                        f"`{name}` {row} has {len(label)} characters, and the file of a "
                        f"calibration holds at most {LONGEST}; shorten it."
                    )
                if control_characters(label):
                    raise MultiposError(
                        f"`{name}` {row} is '{visible(label)}', with a control character; "
                        "write it without."
                    )

    def _check_signs(self) -> None:
        for name, lowest in (
            ("u", "above 0"),
            ("sd", "0 or more"),
            ("samples", "above 0"),
            ("orientation_sd", "0 or more"),
            ("reference_u", "0 or more"),
        ):
            array = getattr(self, name)
            if array is not None:
                _refuse(name, array, array <= 0.0 if lowest == "above 0" else array < 0.0, lowest)
        if self.dof is not None:
            bad = (self.dof < FEWEST) | ((self.dof > LARGEST) & np.isfinite(self.dof))
            _refuse("dof", self.dof, bad, f"from {FEWEST:g} to {LARGEST:g}")

    def _normalise_up(self) -> None:
        if self.force is not None:
            _set(self, "up", along_forces(self.force, self.up))
        if self.up is None:
            return
        known = ~np.isnan(self.up).any(axis=1)
        if known.all():
            up = attitudes.unit_vectors(self.up)
        else:
            up = np.full(self.up.shape, np.nan)
            up[known] = attitudes.unit_vectors(self.up[known]) if known.any() else up[known]
        _set(self, "up", _readonly(up))
        open_ = ~known & ~self.forced & ~self.rolled  # a force of no size points nowhere
        if open_.any() and self.orientation_sd is None:
            raise MultiposError(f"`up` of row {int(np.argmax(open_)) + 1} is not finite.")

    def _check_sizes(self) -> None:
        where = self.source or "the readings"
        for name in ("values", "u", "sd"):
            array = getattr(self, name)
            if array is None:
                continue
            far = np.abs(array) > LARGEST
            if name == "u":
                far |= array < SMALLEST
            if far.any():
                row, i = np.argwhere(far)[0].tolist()
                column = self.outputs[i] if name == "values" else f"{name}_{self.outputs[i]}"
                raise MultiposError(
                    f"{where}: row {row + 1}, column '{column}': {array[row, i]:g} is no number "
                    f"that is measured (from {SMALLEST:g} to {LARGEST:g} in any unit); correct it."
                )
        size = np.abs(self.values).max(axis=0)
        lost = (size > 0.0) & (size < SMALLEST)
        if lost.any():
            i = int(np.argmax(lost))
            raise MultiposError(
                f"{where}: column '{self.outputs[i]}' is {size[i]:g} at most, too small a number "
                "to be squared; give the readings in a smaller unit."
            )
        sd = np.zeros(0) if self.orientation_sd is None else self.orientation_sd
        far = np.isfinite(sd) & (sd >= np.pi)
        if far.any():
            row = int(np.argmax(far))
            raise MultiposError(
                f"{where}: row {row + 1}: an orientation sd of "
                f"{np.degrees(sd[row]):g} degrees; it must be below 180, or empty "
                "for unknown."
            )


def select_outputs(readings: Readings, names: tuple[str, ...]) -> Readings:
    """Return readings with only the named outputs; the others become environment columns."""
    require_columns(names, readings.outputs, readings.source or "the readings")
    if names == readings.outputs:
        return readings
    if not names:
        raise MultiposError("no output is left; every column is used by the formula.")
    columns = [readings.outputs.index(name) for name in names]
    n, m = readings.values.shape
    covariance = readings.covariance
    if covariance is not None:
        kept = (np.arange(n)[:, None] * m + np.array(columns)).ravel()
        covariance = covariance[np.ix_(kept, kept)]
    moved = {
        name: readings.values[:, i] for i, name in enumerate(readings.outputs) if name not in names
    }
    by_output = [n for n in ("values", "u", "dof", "sd") if getattr(readings, n) is not None]
    chosen: dict[str, Any] = {name: getattr(readings, name)[:, columns] for name in by_output}
    return replace(
        readings,
        **chosen,
        outputs=names,
        covariance=covariance,
        environment={**readings.environment, **moved},
    )


def select_rows(readings: Readings, kept: Mask) -> Readings:
    """Return the rows (n,) of readings that are kept, with the labels that they had."""
    rows = np.flatnonzero(kept)
    m = readings.values.shape[1]

    def own(value: Any) -> Any:
        return value[rows] if isinstance(value, np.ndarray) else [value[row] for row in rows]

    by_row = [name for name in _BY_ROW if getattr(readings, name) is not None]
    chosen: dict[str, Any] = {name: own(getattr(readings, name)) for name in by_row}
    if readings.covariance is not None:
        cells = (rows[:, None] * m + np.arange(m)).ravel()
        chosen["covariance"] = readings.covariance[np.ix_(cells, cells)]
    environment = {name: column[rows] for name, column in readings.environment.items()}
    labels = [readings.labels[row] for row in rows]
    return replace(readings, **chosen | {"environment": environment, "positions": labels})


def require_range(readings: Readings, limits: Sequence[float]) -> None:
    """Refuse readings outside stated limits: a saturated or disconnected output.

    Raises
    ------
    UsageError
        The limits are not LOW,HIGH.
    MultiposError
        A reading is outside; the first is named, and how many there are.
    """
    ends = as_numbers(limits, "--range", UsageError).ravel().tolist()
    if len(ends) != 2 or not ends[0] < ends[1]:
        raise UsageError("--range takes LOW,HIGH in reading units, LOW below HIGH.")
    low, high = ends
    outside = (readings.values < low) | (readings.values > high)
    if outside.any():
        row, column = np.argwhere(outside)[0].tolist()
        label = "" if readings.positions is None else f" (position {readings.positions[row]})"
        raise MultiposError(
            f"{readings.source or 'the readings'}: row {row + 1}{label}, column "
            f"'{readings.outputs[column]}': {readings.values[row, column]:g} is outside the range "
            f"{low:g} to {high:g} ({int(outside.sum())} of {outside.size} readings are); measure "
            "these positions again or leave them out."
        )


def _refuse(name: str, array: Array, bad: Mask, needed: str) -> None:
    """Refuse values that are bad; the first is named."""
    if bad.any():
        row = int(np.argwhere(bad)[0][0])
        raise MultiposError(f"`{name}` of row {row + 1} is {array[bad][0]:g}; it must be {needed}.")


def _array(name: str, value: ArrayLike, shape: tuple[int, ...] | None) -> Array:
    array = as_numbers(value, f"`{name}`")
    if shape is not None and array.shape != shape:
        raise MultiposError(
            f"`{name}` must have shape {shape}, got {array.shape}; give one row per position."
        )
    # NaN has a meaning in these: heading open, orientation unknown, cell of an unused column.
    if name not in ("rotation", "up", "orientation_sd", "force") and "environment" not in name:
        finite = np.isfinite(array)
        if not finite.all():
            row = int(np.argwhere(~finite)[0][0])
            raise MultiposError(f"`{name}` of row {row + 1} is not finite.")
    return _readonly(array)


def _readonly(array: Array) -> Array:
    array.setflags(write=False)
    return array


def _set(readings: Readings, name: str, value: object) -> None:
    object.__setattr__(readings, name, value)


def stated_sd(readings: Readings) -> Array | None:
    """Return the stated standard uncertainty of each reading (n, M), or None."""
    if readings.covariance is not None:
        return np.asarray(np.sqrt(np.diag(readings.covariance)).reshape(readings.values.shape))
    return readings.u


def diagonal(noise: Array) -> Array:
    """Return the variances (n M,) of noise as `Readings.noise` has it."""
    return noise if noise.ndim == 1 else np.diag(noise)


def add_variances(noise: Array, variances: Array) -> Array:
    """Return noise, as `Readings.noise` has it, with independent variances (n M,) added."""
    return noise + (variances if noise.ndim == 1 else np.diag(variances))


def spread_reading_sd(reading_sd: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return --reading-sd, one number or one an output, as that of every reading (n, M).

    Raises
    ------
    UsageError
        Another number of values, or one that is not above 0 or cannot be squared.
    """
    sd = as_numbers(reading_sd, "--reading-sd", UsageError).ravel()
    if len(sd) not in (1, shape[1]):
        raise UsageError(f"--reading-sd takes 1 or {shape[1]} values, got {len(sd)}.")
    if not ((sd >= SMALLEST) & (sd <= LARGEST)).all():
        raise UsageError(
            f"--reading-sd must be above 0, from {SMALLEST:g} to {LARGEST:g}, got "
            f"{', '.join(f'{each:g}' for each in sd.tolist())}."
        )
    return np.broadcast_to(sd, shape)
