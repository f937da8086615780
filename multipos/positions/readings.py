"""Readings: what the sensor said at each position, how well it is known, and where it was.

A reading is the mean output of one placement held still. A position read more than once stays
more than one row (a repeat), because the spread of repeats is the only pure measure of error.
Columns of a readings file, beside the outputs, are listed in `docs/reference/formats`.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import MultiposError, UsageError
from multipos.files.characters import control_characters, visible
from multipos.files.lists import Names, split_names
from multipos.files.tables import Source, Table, read_table
from multipos.numerics.arrays import LARGEST, SMALLEST, Array
from multipos.positions import attitudes
from multipos.positions.scheme import Scheme, read_scheme
from multipos.results import Frozen, Result

_RESERVED = attitudes.COLUMNS | {"position", "n", "orientation_sd_deg", "group"}


@dataclass(frozen=True, eq=False)
class Readings(Result):
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
    notes : tuple of str
        What was left out on reading, in words.
    """

    values: Array
    outputs: tuple[str, ...] = ()
    positions: tuple[str, ...] | None = None
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
    notes: tuple[str, ...] = ()

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
        for name, shape in (
            ("u", (n, m)),
            ("covariance", (n * m, n * m)),
            ("sd", (n, m)),
            ("samples", (n,)),
            ("orientation_sd", (n,)),
            ("up", (n, 3)),
            ("rotation", (n, 3, 3)),
        ):
            given = getattr(self, name)
            if given is not None:
                _set(self, name, _array(name, given, shape))
        if self.orientation_sd is not None:
            unknown = np.isnan(self.orientation_sd)
            _set(self, "orientation_sd", _readonly(np.where(unknown, np.inf, self.orientation_sd)))
        for name in ("positions", "group"):
            given = getattr(self, name)
            if given is not None:
                _set(self, name, tuple(str(label) for label in given))
                if len(given) != n:
                    raise MultiposError(f"`{name}` must have {n} labels, got {len(given)}.")
        columns = {
            str(name): _array(f"environment['{name}']", column, (n,))
            for name, column in self.environment.items()
        }
        _set(self, "environment", Frozen(columns))
        if self.source is not None:  # a file may be called anything
            _set(self, "source", visible(self.source))
        self._check_text()
        self._check_values()

    def __len__(self) -> int:
        return len(self.values)

    @property
    def labels(self) -> tuple[str, ...]:
        """The position labels, or 1, 2, … where the readings have none."""
        if self.positions is not None:
            return self.positions
        return tuple(str(row + 1) for row in range(len(self)))

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
        if not self.outputs:
            return ("ax", "ay", "az")[:m] if m <= 3 else tuple(f"a{i + 1}" for i in range(m))
        names = tuple(self.outputs)
        if len(names) != m:
            raise MultiposError(f"`outputs` must name {m} columns, got {len(names)}: {names}.")
        if len(set(names)) < m:
            raise MultiposError(f"`outputs` names a column twice: {', '.join(names)}.")
        return names

    def _check_text(self) -> None:
        """Refuse names and labels that would do something to a terminal or a file of lines."""
        named = {"outputs": self.outputs, "environment": self.environment, "unit": (self.unit,)}
        for name, labels in {**named, "positions": self.positions, "group": self.group}.items():
            for row, label in enumerate(labels or (), start=1):
                if control_characters(label):
                    raise MultiposError(
                        f"`{name}` {row} is '{visible(label)}', with a control character; "
                        "write it without."
                    )

    def _check_values(self) -> None:
        for name, lowest in (
            ("u", "above 0"),
            ("sd", "0 or more"),
            ("samples", "above 0"),
            ("orientation_sd", "0 or more"),
        ):
            array = getattr(self, name)
            if array is None:
                continue
            bad = array <= 0.0 if lowest == "above 0" else array < 0.0
            if bad.any():
                row = int(np.argwhere(bad)[0][0])
                raise MultiposError(
                    f"`{name}` of row {row + 1} is {array[bad][0]:g}; it must be {lowest}."
                )
        self._check_sizes()
        if self.u is not None and self.covariance is not None:
            raise MultiposError("`u` and `covariance` both state the reading noise; give one.")
        if self.up is not None:
            known = ~np.isnan(self.up).any(axis=1)
            up = np.full(self.up.shape, np.nan)
            up[known] = attitudes.from_up(self.up[known]).up if known.any() else up[known]
            _set(self, "up", _readonly(up))
            if not known.all() and self.orientation_sd is None:
                row = int(np.argmin(known))
                raise MultiposError(f"`up` of row {row + 1} is not finite.")

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


def read_readings(
    source: "Source | Readings",
    *,
    outputs: Names | None = None,
    unit: str | None = None,
    environment: Sequence[str] = (),
) -> Readings:
    """Return readings from a CSV file, a mapping of columns or a data frame.

    Parameters
    ----------
    source : path, mapping of name to (n,) array, data frame, or Readings
    outputs : names, optional
        The columns that are outputs; otherwise every numeric column without another meaning.
    unit : str, optional
        Unit of the readings, for names and reports.
    environment : names, optional
        Columns that are not outputs, beside those whose name says so.

    Returns
    -------
    Readings

    Raises
    ------
    MultiposError
        A file that is missing, empty, ragged or holds a bad cell, which is named by file, row
        and column; an output that is not there.
    """
    names = None if outputs is None else split_names(outputs, "--outputs")
    if isinstance(source, Readings):
        if names is None and not set(environment).isdisjoint(source.outputs):
            names = tuple(name for name in source.outputs if name not in environment)
        readings = source if names is None else _with_outputs(source, names)
        return readings if unit is None else replace(readings, unit=unit)
    table = read_table(source, what="readings")
    candidates = [
        name for name in table.columns if _may_be_output(name, table) and name not in environment
    ]
    notes: list[str] = []
    if names is None:
        text = [name for name in candidates if table.is_text(name)]
        names = tuple(name for name in candidates if name not in text)
        if not names:
            raise MultiposError(
                f"{table.source}: no numeric column can be an output; "
                f"the columns are {_listed(table.columns)}."
            )
        notes += [f"column '{name}' holds text and is not used" for name in text]
        beside = _averaged_along(names, table)
        names = tuple(name for name in names if name not in beside)
        if beside:
            notes.append(f"no sd_… beside column {_listed(beside)}, as outputs have; not used")
    else:
        _require(names, table.columns, table.source)
        notes += [
            f"column '{name}' is not among the outputs and is not used"
            for name in candidates
            if name not in names
        ]
    spread = _orientation_sd(table)
    oriented = attitudes.read_attitudes(table, None if spread is None else np.isnan(spread))
    columns = _environment(table, names, environment, notes)
    return Readings(
        values=np.column_stack([table.number(name, largest=LARGEST) for name in names]),
        outputs=names,
        positions=table.text("position") if "position" in table else None,
        up=None if oriented is None else oriented.up,
        rotation=None if oriented is None else oriented.rotation,
        u=_beside(table, "u", names, notes),
        sd=_beside(table, "sd", names, notes),
        samples=_nonnegative(table, "n") if "n" in table else None,
        orientation_sd=spread,
        group=table.text("group") if "group" in table else None,
        environment=columns,
        unit=unit or "reading",
        source=None if table.sha256 is None else table.source,
        sha256=table.sha256,
        notes=tuple(notes),
    )


def _with_outputs(readings: Readings, names: tuple[str, ...]) -> Readings:
    """Return readings with only the named outputs; the others become environment columns."""
    _require(names, readings.outputs, readings.source or "the readings")
    if names == readings.outputs:
        return readings
    if not names:
        raise MultiposError("no output is left; every column is used by the formula.")
    columns = [readings.outputs.index(name) for name in names]
    others = [i for i, name in enumerate(readings.outputs) if name not in names]
    n, m = readings.values.shape
    covariance = readings.covariance
    if covariance is not None:
        kept = (np.arange(n)[:, None] * m + np.array(columns)).ravel()
        covariance = covariance[np.ix_(kept, kept)]
    moved = {readings.outputs[i]: readings.values[:, i] for i in others}
    return replace(
        readings,
        values=readings.values[:, columns],
        outputs=names,
        u=None if readings.u is None else readings.u[:, columns],
        sd=None if readings.sd is None else readings.sd[:, columns],
        covariance=covariance,
        environment={**readings.environment, **moved},
    )


def orient(readings: Readings, scheme: "Source | Scheme | None") -> Readings:
    """Return readings with the orientation of a scheme, matched by label or row by row.

    Raises
    ------
    MultiposError
        Neither the readings nor a scheme say the orientation, or labels and counts do not match.
    """
    if scheme is None:
        if readings.up is not None or readings.rotation is not None:
            return _with_up(readings)
        raise MultiposError(
            f"{readings.source or 'the readings'}: no orientation; give --scheme (a name or a "
            "file) or orientation columns such as direction or up_x, up_y, up_z."
        )
    given = read_scheme(scheme)
    rows = _match(readings, given)
    notes = readings.notes
    if readings.up is not None or readings.rotation is not None:
        notes += (f"the orientation columns are ignored, scheme '{given.name}' is used",)
    positions = readings.positions
    if positions is None and given.labels is not None:
        positions = tuple(given.labels[row] for row in rows)
    return replace(
        readings, up=given.up[rows], rotation=given.rotation[rows], positions=positions, notes=notes
    )


def stated_sd(readings: Readings) -> Array | None:
    """Return the stated standard uncertainty of each reading (n, M), or None."""
    if readings.covariance is not None:
        return np.asarray(np.sqrt(np.diag(readings.covariance)).reshape(readings.values.shape))
    return readings.u


def spread_reading_sd(reading_sd: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return --reading-sd, one number or one an output, as that of every reading (n, M).

    Raises
    ------
    UsageError
        Another number of values, or one that is not above 0 or cannot be squared.
    """
    sd = np.asarray(reading_sd, dtype=np.float64).ravel()
    if len(sd) not in (1, shape[1]):
        raise UsageError(f"--reading-sd takes 1 or {shape[1]} values, got {len(sd)}.")
    if not ((sd >= SMALLEST) & (sd <= LARGEST)).all():
        raise UsageError(
            f"--reading-sd must be above 0, from {SMALLEST:g} to {LARGEST:g}, got "
            f"{', '.join(f'{each:g}' for each in sd.tolist())}."
        )
    return np.broadcast_to(sd, shape)


def require_range(readings: Readings, limits: Sequence[float]) -> None:
    """Refuse readings outside stated limits: a saturated or disconnected output.

    Raises
    ------
    UsageError
        The limits are not LOW,HIGH.
    MultiposError
        A reading is outside; the first is named, and how many there are.
    """
    if len(limits) != 2 or not limits[0] < limits[1]:
        raise UsageError("--range takes LOW,HIGH in reading units, LOW below HIGH.")
    low, high = limits
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


def _with_up(readings: Readings) -> Readings:
    if readings.up is not None:
        return readings
    assert readings.rotation is not None
    return replace(readings, up=readings.rotation[:, :, 2])


def _match(readings: Readings, scheme: Scheme) -> list[int]:
    labels, known = readings.positions, scheme.labels
    if labels is not None and known is not None:
        index = {label: row for row, label in enumerate(known)}
        strange = sorted({label for label in labels if label not in index}, key=labels.index)
        if strange:
            raise MultiposError(
                f"{readings.source or 'the readings'}: position {_listed(strange)} is not in "
                f"scheme '{scheme.name}', whose labels are {_listed(known)}; use its labels."
            )
        return [index[label] for label in labels]
    if len(readings) != len(scheme):
        unlabelled = "neither" if labels is None and known is None else "only one"
        count = Counter(labels or known or ())
        seen = f"; the labels are {_listed(count)}" if count else ""
        raise MultiposError(
            f"{readings.source or 'the readings'}: {len(readings)} readings but scheme "
            f"'{scheme.name}' has {len(scheme)} positions and {unlabelled} has labels{seen}; "
            "add a 'position' column to both."
        )
    return list(range(len(scheme)))


def _may_be_output(name: str, table: Table) -> bool:
    if name in _RESERVED or is_environment(name):
        return False
    stem = name.partition("_")[2]
    return not (name.startswith(("u_", "sd_")) and stem in table.columns)


def _averaged_along(names: tuple[str, ...], table: Table) -> list[str]:
    """Return columns that an average of a log carries beside its outputs."""
    # Only an average has n and, for every output, sd_….
    if "n" not in table or not any(f"sd_{name}" in table for name in names):
        return []
    return [name for name in names if f"sd_{name}" not in table and f"u_{name}" not in table]


def is_environment(name: str) -> bool:
    """Tell whether a column is about the surroundings by its name."""
    return name in ("temperature", "time") or name.startswith("ambient") or name.endswith("_rate")


def _environment(
    table: Table, outputs: tuple[str, ...], used: Sequence[str], notes: list[str]
) -> dict[str, Array]:
    columns = {}
    for name in table.columns:
        if name in used:
            columns[name] = table.number(name)
            continue
        if not is_environment(name) or name in outputs:
            continue
        try:
            columns[name] = table.number(name, empty=True)
        except MultiposError as error:  # a date in `time`, say: an error only if it is used
            notes.append(f"column '{name}' is not used: {error}")
    return columns


def _beside(table: Table, prefix: str, outputs: tuple[str, ...], notes: list[str]) -> Array | None:
    names = [f"{prefix}_{output}" for output in outputs]
    present = [name for name in names if name in table and name not in outputs]
    others = [
        name
        for name in table.columns
        if name.startswith(f"{prefix}_")
        and name not in names
        and name not in outputs
        and name.partition("_")[2] in table.columns
    ]
    notes += [f"column '{name}' belongs to no output and is not used" for name in others]
    if not present:
        return None
    missing = [name for name in names if name not in table]
    if missing:
        raise MultiposError(
            f"{table.source}: column {_listed(missing)} is missing beside {_listed(present)}; "
            "give it for every output or for none."
        )
    return np.column_stack([_nonnegative(table, name, zero=prefix != "u") for name in names])


def _nonnegative(table: Table, name: str, *, zero: bool = False, empty: bool = False) -> Array:
    values = table.number(name, empty=empty)
    bad = values < 0.0 if zero else values <= 0.0
    if bad.any():
        row = int(np.argmax(bad))
        need = "0 or more" if zero else "above 0"
        raise MultiposError(f"{table.where(row, name)}: {values[row]:g} is not {need}.")
    return values


def _orientation_sd(table: Table) -> Array | None:
    if "orientation_sd_deg" not in table:
        return None
    return np.radians(_nonnegative(table, "orientation_sd_deg", zero=True, empty=True))


def _require(names: Sequence[str], columns: Any, where: str) -> None:
    missing = [name for name in names if name not in columns]
    if missing:
        raise MultiposError(
            f"{where}: no column {_listed(missing)}; the columns are {_listed(columns)}."
        )


def _listed(names: Any) -> str:
    quoted = [f"'{name}'" for name in names]
    return ", ".join(quoted[:12]) + (f" and {len(quoted) - 12} more" if len(quoted) > 12 else "")


def _array(name: str, value: ArrayLike, shape: tuple[int, ...] | None) -> Array:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise MultiposError(f"`{name}` must hold numbers.") from None
    if shape is not None and array.shape != shape:
        raise MultiposError(
            f"`{name}` must have shape {shape}, got {array.shape}; give one row per position."
        )
    # NaN has a meaning in these: heading open, orientation unknown, cell of an unused column.
    if name not in ("rotation", "up", "orientation_sd") and "environment" not in name:
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
