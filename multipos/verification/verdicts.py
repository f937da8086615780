"""Verdicts: the result of `multipos.check`.

- `judge_errors` gives the verdict of each error, `worst` that of several.
- `family_confidence` is the confidence of each of many errors that are judged together.
- `require_limit` refuses a limit that is none.
- `load_check` reads a `Check`; what every key of its file means is in `docs/reference/formats`.

Errors e of K quantities at n rows before and after compensation, with the expanded uncertainty U of
the latter. Against a limit L, U is the guard band:

    pass where |e| + U <= L,    fail where |e| − U > L,    else indeterminate.                  (1)

Each such verdict is about one error. Of m errors that are all within the limit, the larger ones
come out beyond by more than U now and then, so that the worst verdict of a long run is no verdict
of the run. For that,

    pass where every error passes,    fail where |e| − U_m > L of any,    else indeterminate,   (2)

with U_m at the confidence 1 − (1 − c)/m (Bonferroni). A run whose true errors are all within the
limit fails with at most the chance 1 − c, however the errors hang together; and one that passes
while any true error is beyond the limit has passed that error by itself (Berger's
intersection-union test), which needs no correction.

En = |e|/U, where U² = U²(run) + U²(calibration), compares an error with the U of both.

References
----------
JCGM 106:2012, 8.3 (guarded acceptance); ISO 13528:2015, 9.7; R. L. Berger, Technometrics 24, 1982.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import field
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError, UsageError
from multipos.files.records import (
    ANY_NUMBER,
    ANY_TEXT,
    AXIS,
    NOT_NEGATIVE,
    Fields,
    Flag,
    Listed,
    Maybe,
    Number,
    Share,
    Text,
)
from multipos.files.schema import As, Saved, Stored, also, restore
from multipos.files.spelling import StrPath
from multipos.files.trees import read_json
from multipos.files.written_units import MAGNETIC_UNITS
from multipos.finding import Findings, findings_upgraded
from multipos.numerics.arrays import COMPONENTS, LARGEST, SMALLEST, Array, Mask
from multipos.results import Drawn, data_frame, frozen
from multipos.verification.agreement import Agreement

VERDICTS = ("pass", "indeterminate", "fail")  # from best to worst


_UNIT = Text(("g", "deg", "1", *MAGNETIC_UNITS))
_BY_AXIS = Stored(rows="positions", by="axes")
_BY_AXIS_OR_NOT = Stored(rows="positions", by="axes", optional=True)
_LINEARITY = Fields({"linearity_percent": Maybe(NOT_NEGATIVE)})
_SUMMARY = Fields({"before": _LINEARITY, "after": _LINEARITY})


@frozen
class Check(Saved, Drawn):
    """Errors of K axes at n positions, before and after compensation.

    Of a regression the one axis is its response, and the positions are the rows of a table.

    Attributes
    ----------
    quantity, unit : str
        'force' in g or 'tilt' in degrees; of a regression its response, in g where a limit says so
        and else without a unit.
    axes : tuple of K str
    positions : tuple of n str
    reference, before, after, u, U : (n, K) arrays
        What is known, the errors, and the uncertainty of `after`; `after` is NaN where no tilt
        explains the reading. Of a regression the reference is the variable `against`.
    limit : float or None
    counted : (n, K) array of bool
        Positions within `within` of level, or rows inside what a regression was fitted to, which
        the summary and the verdict are about.
    linearity_percent : {'before': (K,) array, 'after': (K,) array}
    bias, scale : float or None
        The nominal conversion; a regression has none.
    confidence : float
    source, sha256 : str or None
    calibration : str or None
        When the calibration or regression was made, which tells it from others.
    against : str or None
    segments : mapping of str to (n,) array of bool
        The rows of every segment of a regression.
    U_family : (n, K) array or None
        U_m of eq. (2), where there is a limit.
    consistency : Agreement or None
        Of the run as a whole; None in a check that was written before there was one.
    findings : tuple of Finding

    Examples
    --------
    >>> import multipos as mp
    >>> cal = mp.demo().calibration
    >>> run = mp.simulate(cal, "faces-6", reading_sd=2e-4, seed=1)
    >>> found = mp.check(cal, run)
    >>> found.quantity, found.unit, found.after.shape
    ('force', 'g', (6, 3))
    >>> bool(abs(found.after).max() < abs(found.before).max())
    True
    """

    schema = "multipos/check/1"
    called = "check"
    again = "run check again"
    _also = (
        also("En", Stored(rows="positions", by="axes", after="U")),
        also("_worst_verdicts", Stored("verdict", rows="positions", after="U_family")),
        also("_summary", Stored(flat=True, after="counted")),
        also("run_verdict", Stored(after="counted")),
        also("_by_axis", _SUMMARY, Stored("by_axis", by="axes", after="consistency")),
        also("_by_segment", Stored("by_segment", after="consistency")),
    )

    source: Annotated[str | None, Stored("input.file")] = field(compare=False)
    sha256: Annotated[str | None, Stored("input.sha256")]
    calibration: Annotated[str | None, ANY_TEXT] = field(compare=False)
    quantity: Annotated[str, Text(("force", "tilt"))]
    against: str | None
    unit: Annotated[str, As(_UNIT, str, lambda unit: unit or None)]
    limit: Annotated[float | None, Maybe(Number(SMALLEST, LARGEST))]
    confidence: Share
    bias: Annotated[float | None, ANY_NUMBER, Stored("nominal.bias", optional=True)]
    scale: Annotated[float | None, ANY_NUMBER, Stored("nominal.scale", optional=True)]
    axes: Annotated[tuple[str, ...], Listed(AXIS, 1, len(COMPONENTS))]
    positions: Annotated[tuple[str, ...], Stored("position", rows="positions")]
    reference: Annotated[Array, ANY_NUMBER, _BY_AXIS]
    before: Annotated[Array, Maybe(ANY_NUMBER, math.nan), _BY_AXIS]
    after: Annotated[Array, Maybe(ANY_NUMBER, math.nan), _BY_AXIS]
    u: Annotated[Array, Maybe(NOT_NEGATIVE, math.nan), _BY_AXIS]
    U: Annotated[Array, Maybe(NOT_NEGATIVE, math.nan), _BY_AXIS]
    U_family: Annotated[Array | None, Maybe(NOT_NEGATIVE, math.nan), _BY_AXIS_OR_NOT]
    counted: Annotated[Mask, Flag(), _BY_AXIS]
    consistency: Agreement | None
    findings: Findings
    linearity_percent: Annotated[Mapping[str, Array], Stored(nowhere=True)]
    segments: Annotated[Mapping[str, Mask], Stored(nowhere=True)] = field(default_factory=dict)

    @staticmethod
    def _upgraded(content: Mapping[str, Any]) -> Any:
        """Return the content of a file; earlier ones had no `consistency` or `against`."""
        return {"consistency": None, "against": None, **findings_upgraded(content)}

    @classmethod
    def _from_file(cls, _by_axis: Sequence[Mapping[str, Any]], **values: Any) -> "Check":
        """Return the check that a file holds.

        Raises
        ------
        ValueError
            It has no nominal conversion.
        """
        if values["bias"] is None:
            raise ValueError("it has no nominal conversion")
        linearity = {
            when: np.array([each[when]["linearity_percent"] for each in _by_axis], dtype=np.float64)
            for when in ("before", "after")
        }
        return cls(**values, linearity_percent=linearity)

    @cached_property
    def verdicts(self) -> NDArray[np.str_]:
        """By eq. (1) of each error (n, K); empty without a limit and where it is not counted."""
        return judge_errors(self.after, self.U, self.limit, self.counted)

    @property
    def En(self) -> Array:  # noqa: N802 (the name that ISO 13528 gives it)
        """Error over expanded uncertainty (n, K), ``|e|/U``; NaN where there is no U."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return np.asarray(np.where(self.U > 0.0, np.abs(self.after) / self.U, np.nan))

    @property
    def _worst_verdicts(self) -> tuple[str | None, ...]:
        """The worst verdict of every position, None without a limit."""
        return tuple(map(worst, self.verdicts))

    @property
    def verdict(self) -> str | None:
        """The worst verdict of all positions, or None without a limit."""
        return worst(self.verdicts)

    @property
    def run_verdict(self) -> str | None:
        """The verdict of the run by eq. (2), or None without a limit."""
        if self.limit is None or self.U_family is None or self.verdict == "pass":
            return self.verdict
        beyond = (np.abs(self.after) - self.U_family > self.limit) | np.isnan(self.after)
        return "fail" if bool((beyond & self.counted).any()) else "indeterminate"

    @property
    def _summary(self) -> dict[str, Any]:
        return self.summary()

    @property
    def _by_axis(self) -> tuple[dict[str, Any], ...]:
        """The summary of every axis."""
        return tuple(self.summary(axis) for axis in self.axes)

    @property
    def _by_segment(self) -> dict[str, Any]:
        """The summary of every segment of a regression, and its number of rows."""
        return {
            name: {"rows": int(rows.sum()), **self.summary(segment=name)}
            for name, rows in self.segments.items()
        }

    def summary(self, axis: str | None = None, segment: str | None = None) -> dict[str, Any]:
        """Return maximum, rms and linearity before and after, of one axis or segment or of all."""
        columns = [self.axes.index(axis)] if axis else list(range(len(self.axes)))
        counted = self.counted
        if segment is not None:
            counted = counted & self.segments[segment][:, None]

        def seen(values: Array) -> Array:
            part = values[:, columns][counted[:, columns]]
            finite = part[np.isfinite(part)]
            return finite if len(finite) else np.array([np.nan])

        found: dict[str, Any] = {}
        for when, errors in (("before", self.before), ("after", self.after)):
            part = seen(errors)
            found[when] = {
                "maximum": float(np.abs(part).max()),
                "rms": float(np.sqrt(np.mean(part**2))),
                "linearity_percent": float(self.linearity_percent[when][columns].max()),
            }
        widest = np.where(counted, self.U, -np.inf)[:, columns]
        found["after"]["largest_U"] = float(widest.max())
        found["after"]["largest_En"] = float(seen(self.En).max())
        found["verdict"] = worst(np.where(counted, self.verdicts, "")[:, columns])
        return found

    def to_pandas(self) -> Any:
        """Return the errors as a data frame with a row for each position and axis.

        Raises
        ------
        MultiposError
            pandas is not installed.
        """
        n, k = self.after.shape
        columns = {
            "position": np.repeat(self.positions, k),
            "axis": np.tile(self.axes, n),
            **{
                name: getattr(self, name).ravel()
                for name in ("reference", "before", "after", "u", "U", "En", "counted")
            },
            "verdict": self.verdicts.ravel(),
        }
        return data_frame(columns)


def judge_errors(after: Array, U: Array, limit: float | None, counted: Mask) -> NDArray[np.str_]:
    """Return the verdicts of eq. (1); empty without a limit and where nothing counts."""
    verdicts = np.full(after.shape, "", dtype="<U13")
    if limit is None:
        return verdicts
    error = np.abs(after)
    verdicts[:] = "indeterminate"
    verdicts[error + U <= limit] = "pass"
    verdicts[(error - U > limit) | np.isnan(after)] = "fail"
    verdicts[~counted] = ""
    return verdicts


def family_confidence(confidence: float, errors: int) -> float:
    """Return the confidence of each of so many errors that gives all of them together one."""
    return 1.0 - (1.0 - confidence) / max(errors, 1)


def worst(verdicts: NDArray[np.str_]) -> str | None:
    """Return the worst of some verdicts, None where there is none."""
    given = [VERDICTS.index(name) for name in set(verdicts.ravel().tolist()) if name]
    return VERDICTS[max(given)] if given else None


def require_limit(name: str, value: float) -> None:
    """Refuse a limit that is no size of an error."""
    if not SMALLEST <= value <= LARGEST:
        raise UsageError(f"{name} must be above 0, from {SMALLEST:g} to {LARGEST:g}, got {value}.")


def load_check(path: StrPath) -> Check:
    """Read a check of a calibration written by `Check.save`.

    Raises
    ------
    MultiposError
        The file is missing, truncated, of another schema or of a regression, or holds what no
        check does.

    Examples
    --------
    >>> import multipos as mp
    >>> cal = mp.demo().calibration
    >>> found = mp.check(cal, mp.simulate(cal, "faces-6", seed=1))
    >>> found.save("check.json")
    >>> mp.load_check("check.json") == found
    True
    """
    content = read_json(path, Check.schema)
    if content.get("against") is not None:
        raise MultiposError(
            f"{path}: the check of a regression; a report of a calibration needs a check of it."
        )
    return restore(Check, content, str(path))
