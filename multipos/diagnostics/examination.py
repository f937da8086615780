"""Every finding about a finished calibration, in the order in which they are asked.

`examine` returns a calibration with its findings, of which `compete` names one among causes that
explain the same residuals and `without_explained` leaves out those that another explains.
`no_redundancy` and `poorly_determined` find fits that nothing checks or that U leaves open, which
`are_poorly_known` and `are_open` tell of many units; `drift_absorbed` and `hidden_table` find what
the model takes for the sensor, and `open_headings` says what a stated level assumes. `in_words`
words a sentence for a magnetometer.

A finding is a function from a calibration to at most one finding, a `Finding`, and a line in one of
the lists below. Cautions about what the residuals say are asked only where nothing wrong
was found: rows interchanged look like a missing term, an outlier and a rejected noise as well, and
are none of these.

Causes that explain the same residuals compete in one likelihood. Terms that the model lacks,
orientation error, outliers and repeats that agree too well are found by tests of their own, causes
of time and table by `multipos.diagnostics.row_order`. Where one of these is beyond chance, all are
held against each other by S of eq. (3) there, and the best is named, with its size and what to do.

Fits that nothing checks are cautioned about: as many parameters as readings, or hardly fewer.
A fit with no degrees of freedom passes through every reading, right or wrong, and its residuals,
zero to rounding, say nothing. With orientations unknown a position is one equation, however
many outputs it has. Positions that are much alike separate the parameters badly: at a condition of
10⁴ four of sixteen digits are gone, and every error of the model is as much larger. And a scale
factor that U leaves open by a fifth is no result, however it came about. Where nothing is left to
contradict it, a fit that the noise stated, or else one of 1 mg, moves by a tenth of a g or of a
scale factor is an error: with the gain G of the estimator by √(Σ G² u²).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np

from multipos.diagnostics import columns, gross_errors, model_error, row_order, scales, score_tests
from multipos.diagnostics.residuals import (
    MOST,
    effective_number,
    lack_of_fit,
    orientation_error,
    outlier,
    outlying_rows,
    rejected_noise,
    residuals_of,
    unequal_noise,
)
from multipos.diagnostics.variances import Residuals, deviances_of
from multipos.estimation.gains import AtSolution, estimator_gain, information_at_solution
from multipos.estimation.run_zeros import without_zeros
from multipos.files.numbers import p_in_words
from multipos.finding import Finding, Findings, errors_of, in_order
from multipos.numerics.arrays import Array, Mask, median
from multipos.positions.headers import RUN
from multipos.positions.order import share_absorbed
from multipos.positions.readings import Readings, diagonal
from multipos.results import changed
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator
from multipos.sensor.gravity import MAGNETIC
from multipos.sensor.model import Model

_POOR = 0.02  # U of a linear term, as a share of the scale factor of its output
_OPEN = 0.2  # likewise of an own scale factor, where the positions are known
ILL_CONDITIONED = 1e4
_TYPICAL = 1e-3  # [g], noise of a reading of which nothing is stated
_ABSORBED = 0.2  # share of a drift from which on it is said
_BEYOND = 0.1  # standard deviations of a linear term in scale factors, beyond any sensor


def no_redundancy(c: Calibration) -> Finding | None:
    """Find fits that nothing checks."""
    n = len(c.readings)
    if c.estimator == Estimator.UNKNOWN:
        spare = n - len(c.parameters)
    elif c.estimator.exact:
        spare = n - max(len(terms) for terms in c.model.terms)
    else:
        return None
    if spare <= 0:
        name, moved = _moved_by_noise(c)
        if moved > _BEYOND:
            noise = "the stated noise" if c.readings.noise is not None else "noise of 1 mg"
            return Finding(
                "no-residuals",
                "error",
                f"{n} positions for as many parameters: nothing checks the fit, and {noise} "
                f"changes {name} by {min(100.0 * moved, 1e6):.2g} % of 1 g",
                "Add positions that differ more.",
            )
        return Finding(
            "no-redundancy",
            "warning",
            (
                f"{n} positions for as many parameters: there are no residuals, so nothing checks "
                "the fit"
            ),
            "Add positions.",
        )
    return _poorly_known(c) if c.estimator == Estimator.UNKNOWN else None


def _moved_by_noise(c: Calibration) -> tuple[str, float]:
    """Return the linear term that noise moves most, and by how much of the scale factor."""
    readings = c.readings
    response = np.linalg.norm(c.sensitivity, axis=1)
    sd = np.full(readings.values.shape, _TYPICAL * float(response.max()))
    if readings.noise is None:
        c = replace(c, readings=replace(readings, u=sd), variance_components=None)
    else:
        sd = np.sqrt(diagonal(readings.noise)).reshape(readings.values.shape)
    u = np.sqrt(np.sum((estimator_gain(c) * sd.ravel()) ** 2, axis=1))
    share = _shares(c.model, c.parameters[None], u[None])[0]
    return c.names[int(np.argmax(share))], float(share.max())


def poorly_determined(c: Calibration) -> Finding | None:
    """Find positions that are much alike, and own scale factors that U leaves open, if not zero."""
    if c.diagnostics.condition > ILL_CONDITIONED:
        return Finding(
            "no-redundancy",
            "warning",
            "parameters are nearly inseparable at these positions (condition "
            f"{c.diagnostics.condition:.1e})",
            "Add positions that differ more.",
        )
    share = _shares(c.model, c.parameters[None], c.U[None])[0]
    found = [(c.names[i], share[i]) for i in c.model.own_scales if _OPEN < share[i] < 1.0]
    if not found:
        return None
    said = ", ".join(f"{name} (U = {100.0 * each:.2g} %)" for name, each in found)
    return Finding(
        "no-redundancy",
        "warning",
        f"scale factors are poorly determined: {said}",
        "Average longer, or add positions.",
    )


def _poorly_known(c: Calibration) -> Finding | None:
    """Find linear terms that positions of unknown orientation leave nearly open."""
    share = _shares(c.model, c.parameters[None], c.U[None])[0]
    poor = [
        (name, each) for name, each in zip(c.names, share.tolist(), strict=True) if each > _POOR
    ]
    if not poor:
        return None
    said = ", ".join(f"{name} (U = {1e3 * each:.2g} mrad)" for name, each in poor[:4])
    return Finding(
        "no-redundancy",
        "warning",
        f"parameters are poorly determined: {said}",
        "Add positions that differ more.",
    )


def are_poorly_known(model: Model, parameters: Array, U: Array) -> Mask:
    """Tell which units (B,) have a linear term that is nearly open; of many at once.

    Parameters
    ----------
    model : Model
    parameters, U : (B, p) arrays
        Expanded uncertainties.
    """
    return np.asarray((_shares(model, parameters, U) > _POOR).any(axis=1))


def are_open(model: Model, parameters: Array, U: Array) -> Mask:
    """Return of which units (B,) U leaves an own scale factor open, if that is not zero."""
    share = _shares(model, parameters, U)[:, list(model.own_scales)]
    return np.asarray(((share > _OPEN) & (share < 1.0)).any(axis=1))


def _shares(model: Model, parameters: Array, U: Array) -> Array:
    """Return U of linear terms as a share of the own scale factor (B, p), of others 0."""
    linear, own = model.scaled
    size = np.abs(parameters[:, own])
    share = np.zeros_like(U)
    share[:, linear] = np.where(size > 0.0, U[:, linear] / np.where(size > 0.0, size, 1.0), np.inf)
    return share


def drift_absorbed(c: Calibration) -> Finding | None:
    """Find an order of the rows in time in which the model takes a drift for the sensor."""
    time = c.readings.environment.get("time")
    if time is None or not c.estimator.exact or not np.isfinite(time).all():
        return None
    if c.model.drift_per is not None:  # it is estimated
        return None
    course = time - time.mean()
    _, blocks = c.model.respond(c.parameters, c.reference, c.readings.environment)
    share = max(share_absorbed(slopes, course) for _, slopes in blocks)
    if share <= _ABSORBED:
        return None
    return Finding(
        "drift-absorbed",
        "note",
        f"The order of the positions absorbs {100.0 * share:.0f} % of a linear drift: that part of "
        "one would stand in the parameters, and neither in the residuals nor in U.",
    )


def hidden_table(c: Calibration) -> Finding | None:
    """Find rolls whose table may be off by what the model takes for the sensor."""
    if c.readings.up is None or not c.estimator.exact:
        return None
    if all(term.force_degree < 2 for terms in c.model.terms for term in terms):
        return None  # residuals show a harmonic
    from multipos.uncertainty.turntable import changes_unseen, in_words_of_unseen

    sizes = changes_unseen(c).tolist()
    units, U = c.model.units, c.U.tolist()
    changes = [each for each in zip(c.names, sizes, units, U, strict=True) if each[1] > 0.0]
    if not changes:
        return None
    action = "State the table as [index] in a budget."
    return Finding("hidden-table", "note", in_words_of_unseen(changes), action)


def open_headings(c: Calibration) -> Finding | None:
    """Say what is assumed of a level that the budget states where positions have no headings."""
    rows = () if c.budget is None else c.budget.rows
    level = next((row for row in rows if row["quantity"] == "level"), None)
    rotation = c.readings.rotation
    known = rotation is not None and np.isfinite(rotation).all()
    if level is None or known or c.estimator is Estimator.UNKNOWN:
        return None
    each = math.sqrt(len(c.readings)) * level["u"]
    return Finding(
        "open-headings",
        "note",
        "no headings are stated: U includes [level] at its worst headings, as an orientation "
        f"error of {each:.2g} degrees at each position",
        "State whole attitudes for its own effect.",
    )


RIVALS = frozenset({"missing-term", "placement", "outlier", "lack-of-fit", row_order.SLOW})


def compete(
    c: Calibration, found: list[Finding], residuals: Callable[[], Residuals]
) -> list[Finding]:
    """Return what was found, with the best of the causes that explain the same residuals.

    Causes of time and table (`multipos.diagnostics.row_order`) are held against the terms that the
    model lacks, orientation error and outliers among what was found; one of them is named.
    """
    wrong = any(finding.level == "error" for finding in found)
    if wrong or not row_order.asked(c) or any(finding.code == "zero-per-soak" for finding in found):
        return found
    causes = row_order.search(c)
    if not causes:
        return found
    freedom = float(c.residuals.size - len(c.parameters))
    if c.estimator is Estimator.UNKNOWN:
        freedom = float(len(c.residuals) - len(c.parameters))
    best = max(causes, key=lambda cause: cause.score)
    rivals = [finding for finding in found if finding.code in RIVALS]
    kept = [finding for finding in found if finding.code not in RIVALS]
    if rivals:
        scores = [_score(c, finding, freedom, residuals) for finding in rivals]
        strongest = rivals[int(np.argmax(scores))].code
        if best.code in {finding.code for finding in rivals} or max(scores) >= best.score:
            return [*kept, *(d for d in rivals if d.code == strongest)]
    return [*kept, _describe(c, best)]


def _score(
    c: Calibration, finding: Finding, freedom: float, residuals: Callable[[], Residuals]
) -> float:
    """Return S of a finding of residuals, as `row_order` has it."""
    n, m = c.residuals.shape
    if finding.code == "missing-term":
        return score_tests.score_of_term(c, c.diagnostics.model_tests)
    if finding.code == "placement" and m == 3:  # by the normals of three outputs
        _, unequal, oriented = deviances_of(residuals())
        gain = float(unequal[0] - oriented[0])
        return float(gain - (2.0 - m) * math.log(freedom))
    if finding.code == row_order.SLOW:
        return row_order.slow_score(c)
    if finding.code == "lack-of-fit":
        found: Any = list(c.diagnostics.lack_of_fit.values())
        tests: list[tuple[float, float, float]] = [(each["F"], *each["dof"]) for each in found]
        gain = sum((q + nu) * math.log1p(q * f / nu) for f, q, nu in tests)
        return float(gain - sum(q for _, q, _ in tests) * math.log(freedom))
    if finding.code == "outlier" and c.estimator.exact:
        rows = [i for i, label in enumerate(c.readings.labels) if label in finding.rows]
        gain = _gain_without(c, rows)
        tried = math.comb(n, len(rows))
        return float(gain - m * len(rows) * math.log(freedom) - 2.0 * math.log(tried))
    if finding.code == "outlier" and (left := outlying_rows(c)) is not None:
        k, kept = len(left.rows), left.dof / freedom  # a row has one misfit
        gain = -freedom * math.log(max(kept, 1e-15) / left.ratio**2)
        return float(gain - k * math.log(freedom) - 2.0 * math.log(math.comb(n, k)))
    return 0.0


def _gain_without(c: Calibration, rows: list[int]) -> float:
    """Return Λ of rows that are left out of every output."""
    phi = c.model.basis(c.reference, c.readings.environment)
    total = 0.0
    for i, places in enumerate(c.model.columns):
        X, e = (
            phi[:, places] / c.sd_of_readings[:, [i]],
            c.residuals[:, i] / c.sd_of_readings[:, i],
        )
        Q = np.linalg.qr(X)[0][rows]
        lost = e[rows] @ np.linalg.lstsq(np.eye(len(rows)) - Q @ Q.T, e[rows], rcond=None)[0]
        total -= (len(e) - X.shape[1]) * math.log(max(1.0 - float(lost / (e @ e)), 1e-15))
    return total


def _describe(c: Calibration, cause: row_order.Cause) -> Finding:
    """Return what is said of a cause, with its size and what to do."""
    sizes = columns = np.zeros((0, 0))
    if cause.code != row_order.SLOW:
        sizes, columns = row_order.estimate(c, cause)
    text, action, rows = _SAID[cause.code](c, cause, sizes, columns)
    return Finding(cause.code, "warning", text, action, rows, p=cause.p)


_Said = tuple[str, str, tuple[str, ...]]


def _drift(c: Calibration, cause: row_order.Cause, sizes: Array, columns: Array) -> _Said:
    whole = float(np.abs(sizes).max()) * float(np.ptp(columns))
    text = f"readings drift by {whole:.2g} {c.model.unit} from the first row to the last"
    return f"{text} ({p_in_words(cause.p)})", "Fit the drift with --drift.", ()


def _slipped(c: Calibration, cause: row_order.Cause, sizes: Array, columns: Array) -> _Said:
    row, degrees = _first_row(c, cause), math.degrees(float(np.linalg.norm(sizes)))
    text = f"from row {row} on the case is rotated by {degrees:.2g} degrees, as if it slipped"
    action = f"Name the rows from {row} on in a column `group`, and no others."
    return f"{text} ({p_in_words(cause.p)}); U excludes it", action, (row,)


def _replaced(c: Calibration, cause: row_order.Cause, sizes: Array, columns: Array) -> _Said:
    row, what = _first_row(c, cause), "parameters"
    if columns.shape[1] == 1:
        what = f"biases, by up to {float(np.abs(sizes).max()):.2g} {c.model.unit}"
    text = f"from row {row} on readings have other {what} ({p_in_words(cause.p)})"
    action = f"Fit the rows before {row} and those from it on separately."
    return f"{text}, as after an exchange or a switch-on", action, (row,)


def _settling(c: Calibration, cause: row_order.Cause, sizes: Array, columns: Array) -> _Said:
    share = 100.0 * float(sizes.item())
    text = f"readings contain {share:.2g} % of the previous row ({p_in_words(cause.p)})"
    action = "Wait longer at each position before reading."
    return f"{text}, as from a filter with a long time constant", action, ()


def _hysteresis(c: Calibration, cause: row_order.Cause, sizes: Array, columns: Array) -> _Said:
    stated, both = columns.ndim == 2, 2.0 * float(np.abs(sizes).max())
    if not stated:  # in g
        both *= float(np.linalg.norm(c.sensitivity, axis=1).max())
    text = f"readings differ by {both:.2g} {c.model.unit} with the side of approach to a position"
    action = "Approach all positions from one side, or each from both."
    if not stated:
        action = "Approach all positions from one side, or state the side in a column `approach`."
    return f"{text} ({p_in_words(cause.p)})", action, ()


def _vibration(c: Calibration, cause: row_order.Cause, sizes: Array, columns: Array) -> _Said:
    sd = c.readings.sd
    assert sd is not None
    own = np.sqrt(np.einsum("nm,nm->n", sd, sd))
    loud = np.flatnonzero(own > row_order.UNEQUAL * median(own))
    moved = float(np.abs(sizes).max() * own.max() ** 2)
    text = f"readings change by up to {moved:.2g} {c.model.unit} with the variance of their rests"
    action = "Measure these rests again with less vibration, or set them aside with --exclude."
    rows = tuple(c.readings.labels[i] for i in loud.tolist())
    return f"{text} ({p_in_words(cause.p)}), as from rectified vibration", action, rows


def _level(c: Calibration, cause: row_order.Cause, sizes: Array, columns: Array) -> _Said:
    degrees = math.degrees(float(np.linalg.norm(sizes)))
    text = f"the attitudes indicate a table tilt of {degrees:.2g} degrees ({p_in_words(cause.p)})"
    return f"{text}; U excludes it", f"Level it, or fit with --level-sd {degrees:.1g}.", ()


def _table(c: Calibration, cause: row_order.Cause, sizes: Array, columns: Array) -> _Said:
    off = f"{math.degrees(float(np.abs(sizes).max())):.1g}"
    text = f"residuals follow the roll angles, as from table errors of {off} degrees"
    action = f"Correct the angles with `multipos tumble`, or fit with --orientation-sd {off}."
    return f"{text} ({p_in_words(cause.p)})", action, ()


def _slow(c: Calibration, cause: row_order.Cause, sizes: Array, columns: Array) -> _Said:
    text = "residuals of neighbouring rows are correlated although their positions differ; U is"
    action = "Add a column `time`, or measure the positions in random order."
    return f"{text} too small", action, ()


def _first_row(c: Calibration, cause: row_order.Cause) -> str:
    assert cause.row is not None
    return c.readings.labels[cause.row]


_SAID: dict[str, Callable[[Calibration, row_order.Cause, Array, Array], _Said]] = {
    "drift": _drift,
    "slipped": _slipped,
    "replaced": _replaced,
    "settling": _settling,
    "hysteresis": _hysteresis,
    "vibration": _vibration,
    "level": _level,
    "table": _table,
    "time-correlated": _slow,
}


Question = Callable[[Calibration], Finding | None]

# Implausible whatever the fit says; where a column is no output at all, no more is asked of it.
OF_COLUMNS: tuple[Question, ...] = (columns.dead_output, columns.counter_column, columns.saturated)
OF_OPTIONS: tuple[Question, ...] = (scales.gravity,)
# Cautions about what was given and what the positions can show.
CAUTIONS: tuple[Question, ...] = (
    columns.quantized,
    no_redundancy,
    columns.repeated_rows,
    columns.temperature_kelvin,
    open_headings,
)
# Cautions about what the residuals show beside outliers, and cannot show.
OF_RESIDUALS: tuple[Callable[..., Finding | None], ...] = (
    poorly_determined,
    model_error.hidden_terms,
    drift_absorbed,
    hidden_table,
    model_error.zero_per_soak,
    model_error.missing_term,
    lack_of_fit,
    rejected_noise,
    orientation_error,
    unequal_noise,
    effective_number,
)
# What a finding explains is not said beside it: rows alike because of a soak are no drift.
_BY_ROWS = ("denied-noise", "placement", "unequal-noise")
_EXPLAINED = {
    "no-rests": (
        *("time-correlated", "replaced", "drift", "slipped", "settling", "hysteresis"),
        *("unequal-noise", "denied-noise", "outlier", "scale-bias"),
    ),
    "zero-per-soak": ("time-correlated",),
    "no-redundancy": ("no-dof",),
    "no-residuals": ("no-dof",),
    "no-signal": ("convention",),
    "outlier": _BY_ROWS,
    "disturbance": ("missing-term", "scale-bias", "time-correlated"),
    "moving-iron": (
        *("replaced", "drift", "time-correlated", "disturbance", "outlier", "lack-of-fit"),
        *("unequal-noise", "scale-bias", "missing-term", "no-redundancy"),
    ),
    "flipped-row": _BY_ROWS,
    "missing-term": ("denied-noise",),
}
_SLOW_NOISE = 3.0  # times the noise within rests, that noise from rest to rest may well be


def examine(
    calibration: Calibration, *, sought: bool = False, exact: Calibration | None = None
) -> Calibration:
    """Return a calibration with what does not look right about it.

    Beside the findings stand the tests of the terms that the model lacks. Of a magnetometer they
    are asked of the relative field, and said in its words. Rows that are outliers are not looked
    for again where they were sought before the fit, and none were there. Rows of several runs are
    looked at less what the zeros of runs differ by. Where errors of the orientations are estimated
    `exact` is the calibration at those listed: they hide causes that it shows.
    """
    c = calibration
    readings = without_zeros(c.readings, c.model, c.reference) if c.estimator.exact else c.readings
    if readings is not c.readings:
        within = examine(_within_runs(c, readings), sought=sought)
        return replace(c, diagnostics=within.diagnostics)
    if calibration.field.unit == "g":
        return _examined(calibration, sought=sought, exact=exact)
    from multipos.diagnostics.magnetic import OF_FIELD

    plain = None if exact is None else exact.relative
    found = _examined(calibration.relative, sought=sought, exact=plain).diagnostics
    own = tuple(ask(calibration) for ask in OF_FIELD)
    said = (replace(f, text=in_words(f.text), action=in_words(f.action)) for f in found.findings)
    known = {each.code for each in found.findings}  # with the rows that were set aside
    new = [each for each in own if each is not None and each.code not in known]
    findings = without_explained((*new, *said))
    return replace(calibration, diagnostics=replace(found, findings=findings))


def _within_runs(c: Calibration, readings: Readings) -> Calibration:
    """Return a calibration with readings and residuals without the zeros of their runs."""
    residuals = c.residuals + readings.values - c.readings.values
    dof = np.maximum(c.dof - float(len(np.unique(c.readings.environment[RUN])) - 1), 1.0)
    spare = np.minimum(dof, len(residuals))
    return replace(
        c,
        readings=readings,
        residuals=residuals,
        residual_sd=np.sqrt(np.sum(residuals**2, axis=0) / spare),
        dof=dof,
        diagnostics=replace(c.diagnostics, outliers=(), lack_of_fit={}, claim=None),
    )


def in_words(text: str) -> str:
    """Return a sentence in the words of a magnetometer."""
    return MAGNETIC.worded(text)


def _examined(
    calibration: Calibration, *, sought: bool, exact: Calibration | None = None
) -> Calibration:
    at_solution: AtSolution = partial(information_at_solution, calibration)
    if calibration.residuals.size <= MOST:  # of many rows it is asked for once
        at_solution = cache(at_solution)
    tested = score_tests.judge_model(calibration, at_solution=at_solution)
    of_model = changed(calibration.diagnostics, model_tests=tested.tests, hidden=tested.hidden)
    calibration = changed(calibration, diagnostics=of_model)
    found = _answers(OF_COLUMNS, calibration)
    if not found:
        found += gross_errors.explained(calibration)
    named = {each.code for each in found}
    cautions = _answers(OF_OPTIONS, calibration) + _answers(CAUTIONS, calibration)
    found += [each for each in cautions if each.code not in named]
    if not errors_of(found):
        residuals = cache(partial(residuals_of, calibration))
        beyond = outlier(calibration, sought=sought)
        outlying = () if beyond is None else beyond.rows
        across = partial(orientation_error, residuals=residuals, outlying=outlying)
        equal = partial(unequal_noise, at_solution=at_solution)
        listed = calibration if exact is None else exact
        given: dict[Any, Question] = {
            orientation_error: across,
            unequal_noise: equal,
            drift_absorbed: lambda _: drift_absorbed(listed),
            hidden_table: lambda _: hidden_table(listed),
        }
        questions = [given.get(ask, ask) for ask in OF_RESIDUALS]
        of_rows = _answers(questions, calibration) + ([] if beyond is None else [beyond])
        if not any(each.code == "placement" for each in of_rows):
            residuals.cache_clear()  # of many rows they are large
        if any(
            each.code in ("quantized", "computed-readings") for each in found
        ):  # roundings follow no law
            found += [each for each in of_rows if each.code not in RIVALS]
        else:
            cause = [] if exact is None else _hidden_cause(exact, sought=sought)
            if cause:
                of_rows = [each for each in of_rows if each.code not in RIVALS]
            found += cause + compete(calibration, of_rows, residuals)
    before = calibration.diagnostics
    if row_order.SLOW in {each.code for each in before.findings}:  # the log has shown it
        found = [each for each in found if each.code != row_order.SLOW]
    every = (*found, *before.findings)
    if calibration.readings.dof is not None:  # nobody stated this noise
        every = tuple(
            replace(each, level="note") if _is_allowed_for(calibration, each.code) else each
            for each in every
        )
    return changed(calibration, diagnostics=changed(before, findings=without_explained(every)))


def _hidden_cause(exact: Calibration, *, sought: bool) -> list[Finding]:
    """Return the cause that explains residuals at listed orientations better than their errors."""
    if not row_order.asked(exact) or columns.quantized(exact) is not None:
        return []
    tested = score_tests.judge_model(exact)
    exact = changed(exact, diagnostics=changed(exact.diagnostics, model_tests=tested.tests))
    errors_of_orientation = Finding("placement", "warning", "their errors")
    beside = (model_error.missing_term(exact), outlier(exact, sought=sought), errors_of_orientation)
    rivals = [each for each in beside if each is not None]
    residuals = cache(partial(residuals_of, exact))
    found = compete(exact, rivals, residuals)
    if len(found) > 1:  # no cause of time or table
        freedom = float(exact.residuals.size - len(exact.parameters))
        found = [max(found, key=lambda each: _score(exact, each, freedom, residuals))]
    return [each for each in found if each.code not in ("placement", "outlier")]


def without_explained(every: Sequence[Finding]) -> Findings:
    """Return findings in order, less those that another of them explains."""
    explained_too = {code for each in every for code in _EXPLAINED.get(each.code, ())}
    return in_order(each for each in every if each.code not in explained_too)


def _is_allowed_for(c: Calibration, code: str) -> bool:
    """Tell whether a finding about noise that the rests gave leaves nothing to decide.

    Too large is the safe side, and what slow noise adds from rest to rest is in U.
    """
    claim = c.diagnostics.claim
    of_rests = claim is not None and claim.chi2 < _SLOW_NOISE**2 * claim.dof
    return code == "overstated-noise" or (code == "denied-noise" and of_rests)


def _answers(questions: Sequence[Question], calibration: Calibration) -> list[Finding]:
    answers = (ask(calibration) for ask in questions)
    return [finding for finding in answers if finding is not None]
