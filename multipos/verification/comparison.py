"""Repeated calibrations of one unit: spread, drift, and agreement within U.

- `compare` returns a `Comparison` of calibrations, or of regressions what
  `multipos.verification.regression_repeats` says of them.

Beside the test of `multipos.verification.consistency` stand the spread of each parameter, the
stability of the biases, and drift and changes (`multipos.verification.recalibration`). Several
methods on the same readings share their noise, so no test of spread applies: they agree where no
parameter differs by more than its expanded uncertainty.

References
----------
Song and Qin 2009, section 3.2 and figure 1: at least four runs.
"""

import math
from collections.abc import Sequence
from dataclasses import field
from typing import Any

import numpy as np

from multipos.errors import MultiposError, UsageError
from multipos.files import spelling, trees
from multipos.files.spelling import StrPath
from multipos.finding import Findings, in_order
from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import check_confidence
from multipos.numerics.terms import CONSTANT
from multipos.regression.regression import Regression, Regressions, all_of, load_regression
from multipos.results import Drawn, Result, Tabular, frozen, plain
from multipos.sensor.calibration import Calibration
from multipos.sensor.calibration_file import load
from multipos.uncertainty.propagation import GRAVITY, evaluate_budget
from multipos.verification.consistency import Judgement, judge_methods, judge_repeats
from multipos.verification.recalibration import (
    DAY,
    Change,
    LimitsSource,
    dates_of,
    find_changes,
    find_drift,
)
from multipos.verification.regression_repeats import RegressionComparison, compare_regressions
from multipos.verification.repeat_findings import find_repeats

_OF_PARAMETERS = (
    *("mean", "sd", "range", "chi2", "dof", "p", "scatter_dof"),
    *("drift", "drift_u", "drift_p"),
)
Run = Calibration | Regression | Regressions | StrPath


@frozen
class Comparison(Judgement, Result, Drawn, Tabular):
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
    common : str
        What its test leaves out as common, beside gravity, and for how many days; empty of none.
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
    findings: Findings
    changes: tuple[Change, ...] = ()
    common: str = ""

    @property
    def largest(self) -> Change | None:
        """The change with the largest E_n."""
        judged = [each for each in self.changes if math.isfinite(each.En)]
        return max(judged, key=lambda each: each.En, default=None)

    @property
    def largest_p(self) -> float:
        """The chance that any parameter has so large an E_n (Šidák); NaN where there is none."""
        p = math.nan if self.largest is None else self.largest.p
        return 1.0 if p >= 1.0 else -math.expm1(len(self.changes) * math.log1p(-p))

    def columns(self) -> dict[str, Any]:
        """Return the parameters: their values by run, mean, sd, range, tests and drift."""
        runs = {f"run {i + 1}": row for i, row in enumerate(self.values)}
        rest = {name: getattr(self, name) for name in _OF_PARAMETERS}
        return {"name": self.calibrations[0].names, **runs, **rest}

    def to_dict(self) -> dict[str, Any]:
        """Return everything as what JSON can carry."""
        first, most = self.calibrations[0].model, self.largest
        parameters = [
            {
                "output": output,
                "term": str(term),
                "name": name,
                "unit": first.units[i],
                "U": tuple(float(c.U[i]) for c in self.calibrations),
                "values": self.values[:, i],
                **{key: getattr(self, key)[i] for key in _OF_PARAMETERS},
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
            "largest": most and {"name": most.name, "En": most.En, "p": self.largest_p},
            "common": self.common,
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
    day = dates_of(found) // DAY
    judged = (
        judge_methods(found, values)
        if same
        else judge_repeats(found, values, day, 1.0 - confidence)
    )
    return Comparison(
        calibrations=found,
        files=files,
        values=values,
        mean=values.mean(axis=0),
        sd=sd,
        range=np.ptp(values, axis=0),
        bias_stability=_of_biases(found[0], sd),
        changes=() if same else find_changes(found, limits),
        common="" if same else _common(found, day),
        **drift._asdict(),
        findings=() if same else in_order(find_repeats(found)),
        **vars(judged),
    )


def _common(found: Sequence[Calibration], day: Array) -> str:
    """Say what calibrations of one day have in common, beside gravity."""
    rows = (row for c in found for row in evaluate_budget(c).rows)
    names = dict.fromkeys(r.quantity for r in rows if r.common and r.quantity != GRAVITY)
    if not names:
        return ""
    days = len(set(day.tolist()))
    listed = ", ".join(names)
    if days == 1:
        return f"common to all, of one day: gravity, {listed}"
    return f"common to all: gravity; to calibrations of one day, here {days}: {listed}"


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
    return load_regression(run) if trees.read_schema(run) == Regression.schema else load(run)
