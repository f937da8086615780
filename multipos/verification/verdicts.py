"""Verdicts: the result of `multipos.check`.

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

The errors of a run beside its own columns: what `regress` describes by temperature and rates.

A run whose rows say where the sensor stood gives for every row and axis the compensated force f and

    error = f − f_ref   [g],        nominal_error = (raw − bias)/scale − f_ref              (3)

of the nominal conversion; all other columns stay, time and temperatures among them.

Checks in files: what the file of a check holds, key by key, its writing and its reading.

What a check derives again when it is read (its summary and verdicts) is not read and not described
here; what every key means is in `docs/reference/formats`.

References
----------
JCGM 106:2012, 8.3 (guarded acceptance); ISO 13528:2015, 9.7; R. L. Berger, Technometrics 24, 1982.
"""

import math
from collections.abc import Mapping
from dataclasses import field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.compensation.correction import correct
from multipos.errors import MultiposError, UsageError
from multipos.files import records, trees, whole
from multipos.files.spelling import StrPath
from multipos.files.tables import Column, Source, read_table
from multipos.finding import FINDINGS, Findings, findings_upgraded, read_findings
from multipos.numerics.arrays import COMPONENTS, LARGEST, SMALLEST, Array, Mask
from multipos.positions.headers import MAGNETIC_UNITS
from multipos.regression.regression import Regression, Regressions
from multipos.results import Columns, Drawn, Result, data_frame, frozen
from multipos.sensor.calibration import Calibration
from multipos.verification.agreement import Agreement

VERDICTS = ("pass", "indeterminate", "fail")  # from best to worst


@frozen
class Check(Result, Drawn):
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
    verdicts : (n, K) array of str
        By eq. (1); empty without a limit and where `counted` is false.
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

    quantity: str
    unit: str
    axes: tuple[str, ...]
    positions: tuple[str, ...]
    reference: Array
    before: Array
    after: Array
    u: Array
    U: Array
    limit: float | None
    verdicts: NDArray[np.str_]
    counted: Mask
    linearity_percent: Mapping[str, Array]
    bias: float | None
    scale: float | None
    confidence: float
    source: str | None = field(compare=False)
    sha256: str | None
    calibration: str | None = field(default=None, compare=False)
    against: str | None = None
    segments: Mapping[str, Mask] = field(default_factory=dict)
    U_family: Array | None = None
    consistency: Agreement | None = None
    findings: Findings = ()

    @property
    def En(self) -> Array:  # noqa: N802 (the name that ISO 13528 gives it)
        """Error over expanded uncertainty (n, K), ``|e|/U``; NaN where there is no U."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return np.asarray(np.where(self.U > 0.0, np.abs(self.after) / self.U, np.nan))

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

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON carries it, keys as in docs/reference/formats.md."""
        return check_dict(self)

    def save(self, path: StrPath) -> None:
        """Write the check as JSON, whole or not at all."""
        whole.write_text(path, trees.to_json(self.to_dict()))


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


def errors_table(
    calibration: Calibration | Regression | Regressions, readings: Source, found: Check
) -> Columns:
    """Return the columns of a run with its errors beside them, eq. (3).

    Parameters
    ----------
    calibration : Calibration or Regression
        What was checked; of a regression the columns are those of `correct`.
    readings : path, mapping of columns, or data frame
        The run that was checked.
    found : Check
        What `check` found of it, of force.

    Raises
    ------
    MultiposError
        A column of that name is there already.
    UsageError
        The check is of tilt.
    """
    if isinstance(calibration, Regression | Regressions):
        return correct(calibration, readings, uncertainty=True)
    if found.quantity != "force":
        raise UsageError("errors of tilt are no errors to correct; check force, without --tilt.")
    table = read_table(readings, what="run")
    added: dict[str, Column] = {}
    for name, values in (
        ("f", found.reference + found.after),
        ("error", found.after),
        ("nominal_error", found.before),
    ):
        added |= {f"{name}_{axis}": values[:, k] for k, axis in enumerate(found.axes)}
    twice = [name for name in added if name in table]
    if twice:
        raise MultiposError(
            f"{table.source}: column '{twice[0]}' is there already; rename it, check writes it."
        )
    return Columns({**table.columns, **added})


SCHEMA = "multipos/check/1"
_BY_AXIS = ("reference", "before", "after", "u", "U", "U_family", "counted", "by_axis")
_ERRORS = records.Named(records.ANY_NUMBER)
_BY_AXIS_OR_NONE = records.Named(records.Maybe(records.ANY_NUMBER))
_UNCERTAINTIES = records.Named(records.Maybe(records.NOT_NEGATIVE))
_LINEARITY = records.Fields({"linearity_percent": records.Maybe(records.NOT_NEGATIVE)})

CHECK = records.Fields(
    {
        "input": records.INPUT,
        "calibration": records.ANY_TEXT,
        "quantity": records.Text(("force", "tilt")),
        "unit": records.Text(("g", "deg", "1", *MAGNETIC_UNITS)),
        "limit": records.Maybe(records.Number(SMALLEST, LARGEST)),
        "confidence": records.SHARE,
        "nominal": records.Fields({"bias": records.ANY_NUMBER, "scale": records.ANY_NUMBER}),
        "axes": records.Listed(records.AXIS, 1, len(COMPONENTS)),
        "positions": records.Listed(
            records.Fields(
                {
                    "position": records.ANY_TEXT,
                    "reference": _ERRORS,
                    "before": _BY_AXIS_OR_NONE,
                    "after": _BY_AXIS_OR_NONE,
                    "u": _UNCERTAINTIES,
                    "U": _UNCERTAINTIES,
                    "counted": records.Named(records.Flag()),
                },
                {"U_family": _UNCERTAINTIES},
            ),
            1,
        ),
        "by_axis": records.Named(records.Fields({"before": _LINEARITY, "after": _LINEARITY})),
    },
    {
        "consistency": records.Maybe(
            records.Fields(
                {
                    "statistic": records.FIGURE,
                    "dof": records.AnyOf(
                        (
                            records.Maybe(records.NOT_NEGATIVE),
                            records.Entries((records.POSITIVE, records.Maybe(records.POSITIVE))),
                        )
                    ),
                    "p": records.P_VALUE,
                    "test": records.ANY_TEXT,
                }
            )
        ),
        **FINDINGS,
    },
)


def check_dict(c: Check) -> dict[str, Any]:
    """Return everything that a check holds, as JSON carries it."""
    rows = []
    for row, label in enumerate(c.positions):
        entry: dict[str, Any] = {"position": label}
        for name in ("reference", "before", "after", "u", "U", "En"):
            entry[name] = dict(zip(c.axes, getattr(c, name)[row].tolist(), strict=True))
        if c.U_family is not None:
            entry["U_family"] = dict(zip(c.axes, c.U_family[row].tolist(), strict=True))
        entry["verdict"] = worst(c.verdicts[row])
        entry["counted"] = dict(zip(c.axes, c.counted[row].tolist(), strict=True))
        rows.append(entry)
    return {
        "schema": SCHEMA,
        "input": {"file": c.source, "sha256": c.sha256},
        "calibration": c.calibration,
        "quantity": c.quantity,
        "against": c.against,
        "unit": c.unit or None,
        "limit": c.limit,
        "confidence": c.confidence,
        "nominal": None if c.bias is None else {"bias": c.bias, "scale": c.scale},
        "axes": c.axes,
        "positions": rows,
        **c.summary(),
        "run_verdict": c.run_verdict,
        "consistency": None if c.consistency is None else c.consistency.to_dict(),
        "by_axis": {axis: c.summary(axis) for axis in c.axes},
        "by_segment": {
            name: {"rows": int(rows.sum()), **c.summary(segment=name)}
            for name, rows in c.segments.items()
        },
        "findings": [finding.to_dict() for finding in c.findings],
    }


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
    content = trees.read_json(path, SCHEMA)
    if content.get("against") is not None:
        raise MultiposError(
            f"{path}: the check of a regression; a report of a calibration needs a check of it."
        )
    return records.restore(
        findings_upgraded(content),
        CHECK,
        _from_dict,
        str(path),
        what="check",
        again="run check again",
    )


def _from_dict(c: Mapping[str, Any]) -> Check:
    axes = tuple(c["axes"])
    for row in [*c["positions"], {"by_axis": c["by_axis"]}]:
        for key, entry in row.items():
            if key in _BY_AXIS and set(entry) != set(axes):
                raise ValueError(f"'{key}' is of {', '.join(entry)}, not of its axes")

    def column(name: str) -> Array:
        rows = [[row[name][axis] for axis in axes] for row in c["positions"]]
        return np.array(rows, dtype=np.float64).reshape(len(rows), len(axes))

    arrays: dict[str, Any] = {
        name: column(name) for name in ("reference", "before", "after", "u", "U")
    }
    counted = column("counted").astype(bool)
    linearity = {
        when: np.array(
            [c["by_axis"][axis][when]["linearity_percent"] for axis in axes], dtype=np.float64
        )
        for when in ("before", "after")
    }
    return Check(
        quantity=c["quantity"],
        unit=c["unit"],
        axes=axes,
        positions=tuple(row["position"] for row in c["positions"]),
        **arrays,
        limit=c["limit"],
        verdicts=judge_errors(arrays["after"], arrays["U"], c["limit"], counted),
        counted=counted,
        linearity_percent=linearity,
        bias=c["nominal"]["bias"],
        scale=c["nominal"]["scale"],
        confidence=c["confidence"],
        source=c["input"]["file"],
        sha256=c["input"]["sha256"],
        calibration=c["calibration"],
        U_family=column("U_family") if all("U_family" in row for row in c["positions"]) else None,
        consistency=_agreement(c.get("consistency")),
        findings=read_findings(c),
    )


def _agreement(c: Mapping[str, Any] | None) -> Agreement | None:
    """Return what a file says of the run as a whole; an unlimited dof is null there."""
    if c is None:
        return None
    statistic, p = (math.nan if c[key] is None else float(c[key]) for key in ("statistic", "p"))
    dof: float | list[float] = math.nan
    if isinstance(c["dof"], list):
        dof = [math.inf if value is None else float(value) for value in c["dof"]]
    elif c["dof"] is not None:
        dof = float(c["dof"])
    return Agreement(statistic, dof, p, c["test"])
