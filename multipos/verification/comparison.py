"""Repeated calibrations of one unit: spread, drift, and agreement within U.

Beside the test of `multipos.verification.consistency` stand the spread of each parameter, the
stability of the biases, and the drift (`multipos.verification.comparison`): the slope of the
straight line through the repeats, per second where their times are absolute or ordered and else per
run in the order given, judged by Student's t on R − 2 degrees of freedom.

Several methods on the same readings share their noise, so no test of spread applies: they agree
where no parameter differs by more than its expanded uncertainty.

Drift of repeated calibrations: the straight line through the repeats, and what it is against.

The times of readings tell when a calibration was made only if they share a clock. They do where
they are absolute, seconds since an epoch, or where they are ordered: no calibration begins before
another has ended. Four logs that each start at 0 s have a clock of their own each, and only the
order is left in which the calibrations were given. The slope has n − 2 degrees of freedom.

References
----------
Song and Qin 2009, section 3.2 and figure 1: at least four runs.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from multipos.errors import MultiposError, UsageError
from multipos.files import numbers, spelling, trees
from multipos.files.spelling import StrPath
from multipos.finding import Finding, in_order
from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import check_confidence, t_tail
from multipos.numerics.terms import CONSTANT
from multipos.regression.regression import Regression, Regressions, all_of
from multipos.regression.regression_file import SCHEMA, load_regression
from multipos.results import Drawn, Result, data_frame, frozen, plain
from multipos.sensor.calibration import Calibration
from multipos.sensor.calibration_file import load
from multipos.verification.consistency import Judgement, judge_repeats
from multipos.verification.recalibration import Change, LimitsSource, find_changes
from multipos.verification.regressions import RegressionComparison, compare_regressions
from multipos.verification.repeat_findings import find_repeats

ABSOLUTE, ORDERED, GIVEN = "absolute", "ordered", "as given"
_EPOCH = 1e8  # s: three years, longer than any log; seconds since 1970 are beyond it


class Drift(NamedTuple):
    """Slope of each parameter per second or per run, its u and p; NaN where nothing is left.

    Attributes
    ----------
    drift, drift_u, drift_p : (p,) arrays
    per : str
        'time', in seconds, or 'run'.
    times : str
        'absolute', 'ordered' or, per run, 'as given'.
    """

    drift: Array
    drift_u: Array
    drift_p: Array
    per: str
    times: str


def find_drift(calibrations: Sequence[Calibration], values: Array) -> Drift:
    """Return the slopes of the parameters (R, p) of R calibrations."""
    at, times = _clock(calibrations)
    per = "run" if times == GIVEN else "time"
    centred = at - at.mean()
    square = float(centred @ centred)
    slope = centred @ values / square
    dof = len(values) - 2
    if dof <= 0:
        unknown = np.full(values.shape[1], math.nan)
        return Drift(slope, unknown, unknown.copy(), per, times)
    left = values - values.mean(axis=0) - centred[:, None] * slope
    u = np.sqrt(np.sum(left**2, axis=0) / dof / square)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = slope / u
    p = np.array([t_tail(value, dof) if math.isfinite(value) else math.nan for value in t.tolist()])
    return Drift(slope, u, p, per, times)


def _clock(calibrations: Sequence[Calibration]) -> tuple[Array, str]:
    """Return when each calibration was made, and by what clock."""
    nothing = np.array([math.nan])
    known = [c.readings.environment.get("time", nothing) for c in calibrations]
    at = np.array([time.mean() for time in known])
    if np.isfinite(at).all() and np.ptp(at) > 0.0:
        if min(float(time.min()) for time in known) >= _EPOCH:
            return at, ABSOLUTE
        if _are_apart(known):
            return at, ORDERED
    return np.arange(1.0, len(known) + 1.0), GIVEN


def since_1970(calibrations: Sequence[Calibration]) -> Array | None:
    """Return when the readings were taken [s since 1970], where their times say it."""
    at, times = _clock(calibrations)
    return at if times == ABSOLUTE else None


def _are_apart(times: Sequence[Array]) -> bool:
    """Tell whether none begins before another has ended."""
    spans = sorted((float(time.min()), float(time.max())) for time in times)
    return all(end < begin for (_, end), (begin, _) in pairwise(spans))


Run = Calibration | Regression | Regressions | StrPath

_DAY = 86400.0  # s
_TIMES = {
    ABSOLUTE: "against the absolute times of the readings",
    ORDERED: "against the times of the readings, which follow one another",
    GIVEN: "per run, in the order given; the readings have no common clock",
}
_LEAST = 4  # repeats that the six-position paper asks for


@frozen
class Comparison(Judgement, Result, Drawn):
    """Repeated calibrations, or several methods on the same readings, and their judgement.

    Attributes
    ----------
    calibrations : tuple of R Calibration
    files : tuple of R str
    values : (R, p) array
    mean, sd, range, drift, drift_u : (p,) arrays
        Over the repeats; drift is the slope per second or per run.
    drift_p, chi2, p : (p,) arrays
        `chi2` is Q of eq. (1) of one parameter, against the pooled scatter where estimated.
    dof, scatter_dof : (p,) arrays
        Of `chi2`, R − 1, and of the scatter it is judged by, ν of eq. (2).
    bias_stability : dict of str to float
        Standard deviation of the repeated biases, by output.
    statistic, dof_total, p_total : float, list or float, float
        Of all parameters together; NaN where it is no repeat.
    test : str
        In words.
    consistent : bool
    per : str
        What drift is per: 'run', or 'time' in seconds.
    times : str
        Of the calibrations: 'absolute', 'ordered' or, per run, 'as given'.
    findings : tuple of Finding
    changes : tuple of Change
        Between the first and the last; empty for several methods on the same readings.
    """

    calibrations: tuple[Calibration, ...]
    files: tuple[str, ...] = field(compare=False)
    values: Array
    mean: Array
    sd: Array
    range: Array
    drift: Array
    drift_u: Array
    drift_p: Array
    bias_stability: dict[str, float]
    per: str
    times: str
    changes: tuple[Change, ...] = ()

    @property
    def largest(self) -> Change | None:
        """The change with the largest E_n."""
        judged = [each for each in self.changes if math.isfinite(each.En)]
        return max(judged, key=lambda each: each.En, default=None)

    def to_pandas(self) -> Any:
        """Return the parameters as a data frame: their values by run, mean, sd, drift and p.

        Raises
        ------
        MultiposError
            pandas is not installed.
        """
        runs = {f"run {i + 1}": row for i, row in enumerate(self.values)}
        columns = ("mean", "sd", "range", "drift", "drift_p", "chi2", "p")
        found = {name: getattr(self, name) for name in columns}
        return data_frame({"name": self.calibrations[0].names, **runs, **found})

    def to_dict(self) -> dict[str, Any]:
        """Return everything as what JSON can carry."""
        first = self.calibrations[0].model
        judged = ("chi2", "dof", "p", "scatter_dof")
        names = ("mean", "sd", "range", *judged, "drift", "drift_u", "drift_p")
        parameters = [
            {
                "output": output,
                "term": str(term),
                "name": name,
                "unit": first.units[i],
                "U": tuple(float(c.U[i]) for c in self.calibrations),
                "values": self.values[:, i],
                **{key: getattr(self, key)[i] for key in names},
                "drift_unit": f"{first.units[i]}/{'s' if self.per == 'time' else 'run'}",
                "moved": name in self.moved,
            }
            for i, (name, (output, term)) in enumerate(zip(first.names, first.keys, strict=True))
        ]
        return {
            "calibrations": [
                {"file": file, "created": c.created}
                for file, c in zip(self.files, self.calibrations, strict=True)
            ],
            "parameters": parameters,
            "bias_stability": self.bias_stability,
            "statistic": self.statistic,
            "dof": self.dof_total,
            "p": self.p_total,
            "test": self.test,
            "consistent": self.consistent,
            "changes": [
                plain(each) | {"per_year": each.per_year and plain(each.per_year._asdict())}
                for each in self.changes
            ],
            "largest": self.largest and {"name": self.largest.name, "En": self.largest.En},
            "drift_per": self.per,
            "drift_times": self.times,
            "findings": [finding.to_dict() for finding in self.findings],
        }


def compare(
    *calibrations: "Run | Sequence[Run]",
    confidence: float = 0.95,
    limits: LimitsSource | None = None,
) -> Comparison | RegressionComparison:
    """Compare repeated calibrations of one unit, or several methods on the same readings.

    Parameters
    ----------
    *calibrations : Calibration, Regression or path
        Two or more, in the order of the runs; one by one, or one list or tuple of them.
    confidence : float
        They are called inconsistent where chance would do so with probability 1 − confidence.
    limits : path, mapping of name to (low, high), or text, optional
        What a parameter may be, from a file as of `multipos.fleet`; a text such as
        'bias=1mg,scale=500ppm' says how far it may have changed, by name or kind.

    Returns
    -------
    Comparison, or RegressionComparison of regressions

    Raises
    ------
    UsageError
        Fewer than two calibrations, or regressions among them.
    MultiposError
        They are not of the same model, outputs, unit and convention.

    Examples
    --------
    >>> import multipos as mp
    >>> found = mp.demo()
    >>> both = mp.compare(found.calibration, found.closed_form)
    >>> both.consistent, bool(abs(both.values[0] - both.values[1]).max() < 1e-12)
    (True, True)
    """
    runs: tuple[Run, ...] = spelling.spread(calibrations)
    if len(runs) < 2:
        raise UsageError("compare needs two or more calibrations.")
    check_confidence(confidence)
    loaded = tuple(_loaded(run) for run in runs)
    files = _files(runs)
    found = tuple(one for one in loaded if isinstance(one, Calibration))
    regressions = [all_of(one) for one in loaded if not isinstance(one, Calibration)]
    if not regressions:
        return _compare(found, files, confidence, limits)
    if found:
        raise UsageError("calibrations and regressions are no repeats; compare one kind.")
    if limits is not None:
        raise UsageError("--limits are of calibrations; a regression has terms of its own.")
    return compare_regressions(regressions, files, confidence)


def _compare(
    found: tuple[Calibration, ...],
    files: tuple[str, ...],
    confidence: float,
    limits: LimitsSource | None,
) -> Comparison:
    _check_alike(found, files)
    values = np.array([c.parameters for c in found])
    sd = values.std(axis=0, ddof=1)
    drift = find_drift(found, values)
    same = _same_readings(found)
    if same:
        judged = Judgement.of_methods(found, values)
    else:
        judged = judge_repeats(found, values, 1.0 - confidence)
    findings = () if same else (*find_repeats(found), *judged.findings)
    if len(found) < _LEAST and not same:
        text = f"{len(found)} repeats determine stability poorly"
        action = f"Calibrate at least {_LEAST} times."
        findings += (Finding("few-repeats", "note", text, action),)
    return Comparison(
        calibrations=found,
        files=files,
        values=values,
        mean=values.mean(axis=0),
        sd=sd,
        range=np.ptp(values, axis=0),
        bias_stability=_of_biases(found[0], sd),
        changes=() if same else find_changes(found, since_1970(found), limits),
        **drift._asdict(),
        **vars(judged) | {"findings": in_order(findings)},
    )


def _files(runs: Sequence[Run]) -> tuple[str, ...]:
    """Return what the runs are called in messages and tables."""
    return tuple(
        f"{_kind(c)} {i}" if isinstance(c, Calibration | Regression | Regressions) else str(c)
        for i, c in enumerate(runs, start=1)
    )


def _kind(run: Run) -> str:
    return "calibration" if isinstance(run, Calibration) else "regression"


def _check_alike(found: Sequence[Calibration], files: Sequence[str]) -> None:
    first = _nature(found[0])
    for c, file in zip(found[1:], files[1:], strict=True):
        for (what, other), mine in zip(_nature(c).items(), first.values(), strict=True):
            if mine != other:
                raise MultiposError(
                    f"{file}: its {what} differ from those of {files[0]} ({_listed(other)}, not "
                    f"{_listed(mine)}); compare calibrations of one unit and one model."
                )


def _nature(c: Calibration) -> dict[str, object]:
    """Return what repeats have in common."""
    return {
        "outputs": c.outputs,
        "terms": [f"{output}:{term}" for output, term in c.model.keys],
        "unit": c.model.unit,
        "convention": c.convention,
        "units of the field": c.field.printed,
        "gauge": c.model.gauge,
    }


def _of_biases(calibration: Calibration, sd: Array) -> dict[str, float]:
    """Return the standard deviation of the bias of each output."""
    keys = calibration.model.keys
    return {output: float(sd[i]) for i, (output, term) in enumerate(keys) if term == CONSTANT}


def _listed(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _same_readings(found: Sequence[Calibration]) -> bool:
    """Whether several methods were tried on one set of readings, which is no repeat."""
    first = found[0].readings.values
    several = len({c.estimator for c in found}) > 1
    return several and all(np.array_equal(first, c.readings.values) for c in found[1:])


def _loaded(run: Run) -> Calibration | Regression | Regressions:
    """Return what a path holds, by its schema."""
    if isinstance(run, Calibration | Regression | Regressions):
        return run
    return load_regression(run) if trees.read_schema(run) == SCHEMA else load(run)


def comparison_text(found: Comparison) -> str:
    """Return a comparison as text: what changed, then run by run."""
    return "\n\n".join(filter(None, (changes_text(found), runs_text(found)))) + "\n"


def runs_text(found: Comparison) -> str:
    """Return the parameters run by run, and how stable the biases are."""
    lines = [
        f"{i}  {file}  ({c.created})"
        for i, (file, c) in enumerate(zip(found.files, found.calibrations, strict=True), start=1)
    ]
    model = found.calibrations[0].model
    stability = [[output, numbers.number(sd, 3)] for output, sd in found.bias_stability.items()]
    parts = [
        "\n".join(lines),
        _parameter_table(found),
        *([] if math.isnan(found.p_total) else [f"drift: {_TIMES[found.times]}"]),
        "bias stability\n" + numbers.table(["output", f"sd [{model.unit}]"], stability),
        _verdict(found),
    ]
    return "\n\n".join(parts)


def changes_text(found: Comparison) -> str:
    """Return the table of changes between the first and the last; nothing where there is none."""
    header, rows = change_rows(plain(found.to_dict()))
    return numbers.table(header, rows, left=2) if rows else ""


def change_rows(found: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of the changes that the JSON of `compare` has; empty without any."""
    header = ["parameter", "unit", "change", "U", "E_n", "per year", "U", "limit", "within", "due"]
    rows, changes = [], found.get("changes") or ()
    units = {each["name"]: each["unit"] for each in found["parameters"]}
    largest: dict[str, float] = {}  # rows of one unit keep one
    for each in changes:
        unit = units.get(each["name"], "")
        size = max(abs(or_nan(each["change"])), or_nan(each["U"]))
        largest[unit] = max(largest.get(unit, 0.0), size)
    for each in changes:
        rate, unit = each["per_year"], units.get(each["name"], "")
        factor, shown = numbers.readable_unit(largest[unit], unit)
        rows.append(
            [
                each["name"],
                shown,
                *_beside(factor, each["change"], each["U"]),
                numbers.plain_number(each["En"] and numbers.beyond_rounding(each["En"]), 2),
                *(("", "") if rate is None else _beside(factor, rate["value"], rate["U"])),
                _limit_in_words(each["limit"], factor),
                {True: "yes", False: "NO", None: ""}[each["within"]],
                each["due"] or "",
            ]
        )
    kept = [i for i in range(len(header)) if i < 5 or any(row[i] for row in rows)]
    return [header[i] for i in kept], [[row[i] for i in kept] for row in rows]


def or_nan(value: float | None) -> float:
    """Return a number of JSON, which has null for NaN."""
    return math.nan if value is None else value


def _beside(factor: float, value: float | None, U: float | None) -> tuple[str, str]:
    """Return a value and its U times a factor, to the two digits of U."""
    size = factor * or_nan(U)
    return numbers.beside(factor * or_nan(value), size, size)


def _limit_in_words(limit: float | Sequence[float | None] | None, factor: float) -> str:
    if isinstance(limit, Sequence):
        low, high = ("" if side is None else numbers.plain_number(factor * side) for side in limit)
        return f"{low} … {high}"
    return "" if limit is None else numbers.plain_number(factor * limit)


def _parameter_table(found: Comparison) -> str:
    """Return every parameter in every run, their mean and drift."""
    model = found.calibrations[0].model
    runs = [str(i) for i in range(1, len(found.files) + 1)]
    per, factor = ("day", _DAY) if found.per == "time" else ("run", 1.0)
    header = ["parameter", "unit", *runs, "mean(sd)", f"drift per {per}", "its p", "p", ""]
    rows = []
    for i, name in enumerate(model.names):
        mean, sd = float(found.mean[i]), float(found.sd[i])
        rounding = 1e-12 * float(np.abs(found.values).max())
        varies = sd > rounding
        rows.append(
            [
                name,
                model.units[i],
                *(f"{value:.7g}" for value in found.values[:, i].tolist()),
                numbers.uncertain(mean, sd if varies else 0.0),
                numbers.number(factor * float(found.drift[i]) if varies else 0.0, 2),
                numbers.chance(float(found.drift_p[i])),
                numbers.chance(float(found.p[i])),
                "moved" if name in found.moved else "",
            ]
        )
    return numbers.table(header, rows, left=2)


def _verdict(found: Comparison) -> str:
    """Return whether the runs are consistent, and the test that says so."""
    verdict = "consistent" if found.consistent else "NOT consistent"
    if math.isnan(found.p_total):
        return f"{verdict}: {found.test}"
    dof = found.dof_total
    shown = ", ".join(map(numbers.number, dof)) if isinstance(dof, list) else numbers.number(dof)
    return (
        f"{verdict}: {found.test}: {numbers.number(found.statistic)} on {shown} degrees of "
        f"freedom, {numbers.p_in_words(found.p_total)}"
    )


def comparison_sentence(found: Mapping[str, Any]) -> str:
    """Return whether runs agree and what has moved, from the JSON of `compare`."""
    said = _agreement(found)
    unfit = any(each["level"] == "error" for each in found.get("findings", ()))
    return f"Not fit for use: {said}" if unfit else said


def _agreement(found: Mapping[str, Any]) -> str:
    """Return whether runs agree."""
    verdict = "agree" if found["consistent"] else "do not agree"
    if "terms" in found:
        least = min((t["p"] for t in found["terms"] if t["p"] is not None), default=None)
        smallest = "" if least is None else f"; smallest p of a term {numbers.chance(least)}"
        return f"{len(found['regressions'])} regressions {verdict}{smallest}."
    given = "" if found["p"] is None else f" ({numbers.p_in_words(found['p'])})"
    together = f"{len(found['calibrations'])} calibrations {verdict}{given}"
    changes, largest = found.get("changes") or (), found.get("largest")
    if largest is None or largest["En"] is None:
        moved = [each["name"] for each in found["parameters"] if each["moved"]]
        return f"{together}; moved: {', '.join(moved)}." if moved else f"{together}."
    agree = sum(each["En"] is not None and each["En"] <= 1.0 for each in changes)
    said = (
        f"{agree} of {len(changes)} parameters agree with the first calibration's within U "
        f"(largest E_n {numbers.plain_number(largest['En'])}, {largest['name']})."
    )
    limited = [each for each in changes if each["within"] is not None]
    if limited:
        beyond = [each["name"] for each in limited if not each["within"]]
        said += f" {len(limited) - len(beyond)} of {len(limited)} are within their limits"
        said += f"; beyond: {', '.join(beyond)}." if beyond else "."
        due = min((each["due"] for each in limited if each["due"]), default=None)
        said += f" Next calibration due {due}." if due else ""
    return said if found["consistent"] else f"{said} Together {together}."
