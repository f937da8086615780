"""One task of a fleet: some units to their numbers, in one batch or one by one.

- `find_pattern` returns the `Pattern` that units read under the same conditions share.
- `solve_task` returns what is `Solved` of a `Task`.
- `fit_one` fits one unit by itself, `gather` puts such fits together.

A task is all that a worker needs and can be sent to another process. Units that were read under the
same conditions are solved together where a batch can do what `fit` does with them; all others, and
whatever unit a batch does not answer for, by `fit` itself, so that nothing depends on which way was
taken. Those that may not be fit for use (`multipos.fleets.suspects`) are fitted alone; what is a
caution alone is found by `multipos.fleets.unit_findings`; at uncertain and unknown orientations
outliers are looked for only in units that are fitted one by one.
"""

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import fields, replace
from multiprocessing import parent_process
from typing import Any, NamedTuple

import numpy as np

from multipos.diagnostics.examination import are_open, are_poorly_known
from multipos.diagnostics.projections import Kind
from multipos.errors import CalibrationWarning, MultiposError, RankError, UsageError
from multipos.estimation import correlated_rows, uncertain_orientations, user_models
from multipos.estimation.batches import Estimates
from multipos.estimation.known import REJECTED, SharedDesign, estimate_known, share_design
from multipos.estimation.unknown_orientations import SharedSphere, estimate_unknown, share_sphere
from multipos.files.tables import Table
from multipos.finding import Finding, errors_of, serious
from multipos.fitting.fit_readings import fit
from multipos.fitting.options import Options, with_default_errors
from multipos.fleets import solution_findings, unit_findings
from multipos.fleets.fixtures import Fixture, FixtureSums, sum_fixtures
from multipos.fleets.suspects import CALM, Sought, find_suspects
from multipos.fleets.unit_findings import UnitFindings
from multipos.numerics.arrays import Array, Mask, Places
from multipos.numerics.quantiles import chi2_quantile, coverage_factors
from multipos.positions.headers import TEMPERATURE
from multipos.positions.orientations import StatedOrientations, orient, place
from multipos.positions.reading_tables import read_readings
from multipos.results import frozen
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator
from multipos.sensor.gravity import Field
from multipos.sensor.temperature import zeros_in

_ROWS_NAMED = 6  # of a finding, in a cell


Shared = (
    SharedDesign
    | SharedSphere
    | uncertain_orientations.SharedOrientations
    | user_models.SharedExpression
)


class Solved(NamedTuple):
    """What a task found of its units (B,); NaN and a reason where a unit failed.

    Attributes
    ----------
    units : (B,) array of int
    names : tuple of p str
    parameters, u, dof : (B, p) arrays
    rms : (B,) array [g]
    findings, reasons : lists of B str
        Codes of errors and warnings, with `;` between them.
    unfit : list of B str
        Why a calibration is not fit for use; '' where it is.
    fixtures : tuple of FixtureSums
    """

    units: Places
    names: tuple[str, ...]
    parameters: Array
    u: Array
    dof: Array
    rms: Array
    findings: list[str]
    reasons: list[str]
    unfit: list[str]
    fixtures: tuple[FixtureSums, ...] = ()


class Listed(NamedTuple):
    """Positions as they are listed, and what is asked of residuals there."""

    shared: SharedDesign
    tests: unit_findings.UnitTests


@frozen(eq=True)
class Pattern:
    """What units of one group share, found from one of them.

    Attributes
    ----------
    shared : SharedDesign, SharedSphere, SharedOrientations or SharedExpression
        Known orientations, unknown ones, uncertain ones, or known ones of a user-defined model.
    fixture : Fixture or None
        Where the angles of the positions can be identified from residuals.
    gravity : Field or None
    findings : str
        Codes that the positions alone give, whatever the unit.
    asked : bool
        Rows can show whether they are correlated: a unit whose rows are is looked at in full.
    tests : UnitTests or None
        Of the residuals at known orientations.
    kinds : tuple of Kind
        Terms that all but plain fits at known orientations may lack.
    like : Calibration or None
        The unit that was fitted, of unknown orientations.
    timed : bool
        Rows are in order of time, so that U allows for slow noise.
    sought : Sought or None
        Where rows that do not fit are looked for: a unit that has one is fitted singly.
    listed : Listed or None
        Where errors of the orientations are estimated: what those as listed may show.
    """

    shared: Shared
    fixture: Fixture | None
    gravity: Field | None
    findings: str
    asked: bool
    tests: unit_findings.UnitTests | None = None
    kinds: tuple[Kind, ...] = ()
    like: Calibration | None = None
    timed: bool = False
    sought: Sought | None = None
    listed: Listed | None = None

    @property
    def quick(self) -> bool:
        """Whether units take some microseconds: known orientations, of which no noise is stated."""
        known = isinstance(self.shared, SharedDesign) and self.like is None
        return known and self.tests is not None and not self.tests.stated


@frozen
class Task:
    """Units to solve.

    Attributes
    ----------
    units : (B,) array of int
    stations : (B,) array of int
    pattern : Pattern or None
        None: one by one.
    values : tuple of M (B, n) arrays
        Where there is a pattern.
    tables : mapping of unit to Table
        Of those that are taken one by one.
    options : mapping
        Of `fit`.
    stated, stated_dof : tuples of M (B, n) arrays
        What is stated of the readings' uncertainties, and their degrees of freedom, if anything.
    time : (B, n) array or None
        Where U allows for slow noise.
    temperature : tuple of one (B, n) array, or ()
        Where no term of the model takes it.
    """

    units: Places
    stations: Places
    pattern: Pattern | None
    values: tuple[Array, ...]
    tables: Mapping[int, Table]
    options: Mapping[str, Any]
    stated: tuple[Array, ...] = ()
    stated_dof: tuple[Array, ...] = ()
    time: Array | None = None
    temperature: tuple[Array, ...] = ()


def find_pattern(
    calibration: Calibration, table: Table, options: Mapping[str, Any], *, fixtures: bool = True
) -> Pattern | None:
    """Return what units share with one that was fitted; None where there is no batch for them.

    Parameters
    ----------
    calibration : Calibration
    table : Table
        What it was fitted from.
    options : mapping
        Of `fit`.
    fixtures : bool
        Whether what a fixture adds is asked.
    """
    c, exclude = calibration, options.get("exclude", "auto")
    if c.excluded and exclude == "auto":
        whole_of_it = fit_one(table, {**options, "exclude": "none"})
        if not isinstance(whole_of_it, Calibration):
            return None
        c = whole_of_it
    plain = (
        c.readings.covariance is None
        and c.robust_weight is None
        and c.budget is None
        and c.model.drift_per is None
        and zeros_in(c.readings, c.model) is None
        and not c.readings.forced.any()
        and (np.ptp(c.readings.values, axis=0) > 0.0).all()  # a dead output says nothing of others
    )
    own = not c.model.has_terms  # of which no correlation is asked
    timed = correlated_rows.order_in_time(c.readings) is not None and not own
    asked = correlated_rows.are_asked(c.model, c.readings, c.reference, c.estimator)
    asked = asked and not timed
    alike = c.estimator is Estimator.LINEAR and c.readings.noise is None
    whole = options.get("range") is None and exclude in ("auto", "none")
    # Rests of a log are weighed by their numbers of samples where few of these are independent.
    whole &= c.readings.samples is None or c.readings.dof is None
    if not (plain and whole) or ((asked or timed) and not alike):
        return None
    try:
        shared = _share(c, table, options)
    except RankError:
        return None
    if shared is None:
        return None
    tests = unit_findings.unit_tests(c, shared) if isinstance(shared, SharedDesign) else None
    fixture = _fixture(shared, c) if fixtures and c.readings.up is not None else None
    sought = _sought(shared, c, exclude)
    listed = None
    if isinstance(shared, uncertain_orientations.SharedOrientations) and shared.estimated:
        listed = _listed(c, table, options)
        if listed is None:
            return None
    codes = _in_order(_codes(c) - _OF_UNITS)
    like = c if isinstance(shared, SharedSphere) else None
    kinds: tuple[Kind, ...] = ()
    if own:
        kinds = unit_findings.lacking_in_batch(c)
    elif not isinstance(shared, SharedDesign):
        kinds = solution_findings.lacking_in_units(c)
    of_units = tests, kinds, like, timed, sought, listed
    return Pattern(shared, fixture, c.gravity, codes, asked, *of_units)


def _listed(c: Calibration, table: Table, options: Mapping[str, Any]) -> Listed | None:
    """Return the positions as listed, at which `fit` looks for what their errors may hide."""
    as_listed = {**options, "orientation_sd": 0.0, "exclude": "none"}
    exact = fit_one(table, as_listed)
    if not isinstance(exact, Calibration):
        return None
    shared = _share_known(exact, table, as_listed)
    tests = None if shared is None else unit_findings.unit_tests(exact, shared, of_causes=True)
    return None if shared is None or tests is None else Listed(shared, tests)


def _fixture(shared: Shared, c: Calibration) -> Fixture | None:
    """Return the fixture of positions that are listed."""
    assert c.readings.up is not None
    if isinstance(shared, uncertain_orientations.SharedOrientations):
        shared = share_design(shared.model, shared.reference, shared.environment)
    if not isinstance(shared, SharedDesign):
        return None
    return Fixture.of(shared, c.readings.labels, c.readings.up)


def _sought(shared: Shared, c: Calibration, exclude: str) -> Sought | None:
    """Return how rows that do not fit are looked for, as in `fit`, whether set aside or named."""
    if isinstance(shared, uncertain_orientations.SharedOrientations):
        return Sought(c.model, c.readings, shared.reference, shared.orientation_sd)
    if exclude == "none" or isinstance(shared, user_models.SharedExpression):
        return None
    reference = None if isinstance(shared, SharedSphere) else shared.reference
    return Sought(c.model, c.readings, reference)


def _share(c: Calibration, table: Table, options: Mapping[str, Any]) -> Shared | None:
    if not c.model.has_terms:
        return _share_expression(c, options)
    share = _SHARED.get(c.estimator)
    return None if share is None else share(c, table, options)


def _share_known(c: Calibration, table: Table, options: Mapping[str, Any]) -> SharedDesign | None:
    """Return what units share at known orientations."""
    if _POOR in _codes(c):  # of bad positions all are doubted, of a bad unit this one
        return None
    asked = options.get("orientation_sd") in (None, "auto")
    if asked and _oriented(c, table, options)[0].orientation_sd == "auto":
        return None  # of this unit alone orientations are taken as they are listed
    # Residuals are asked for temperature, where the model has no term of it, too.
    columns = c.readings.environment
    shared = replace(share_design(c.model, c.reference, columns), environment=columns)
    return shared if shared.well_posed else None


def _share_unknown(c: Calibration, table: Table, options: Mapping[str, Any]) -> Shared | None:
    """Return what units share where nothing is known of any orientation."""
    sd = c.readings.orientation_sd
    if sd is None or not np.isinf(sd).all():
        return None
    size = float(np.linalg.norm(c.reference[0]))
    return share_sphere(c.model, size, c.readings.environment)


def _share_expression(
    c: Calibration, options: Mapping[str, Any]
) -> user_models.SharedExpression | None:
    """Return what units share at known orientations and, if any, one temperature; else None."""
    plain = c.estimator is Estimator.LINEAR and not options.get("pool")
    asked = TEMPERATURE in set(c.readings.environment) - set(c.model.environment)
    sized = c.gravity is not None and c.gravity.u > 0.0
    return user_models.share_expression(c) if plain and not asked and not sized else None


def _share_uncertain(
    c: Calibration, table: Table, options: Mapping[str, Any]
) -> uncertain_orientations.SharedOrientations | None:
    """Return what units at uncertain orientations share, before anything was found of them."""
    given, stated_up = _oriented(c, table, options)
    apart = stated_up.groups or stated_up.rolls is not None or stated_up.repeats
    if apart or given.level_sd:
        return None
    columns = {name: c.readings.environment[name] for name in c.model.environment}
    return uncertain_orientations.share_orientations(
        c.model,
        stated_up.reference,
        stated_up.orientation_sd,
        columns,
        estimated=stated_up.estimated,
    )


_OPTIONS = frozenset(each.name for each in fields(Options))


def _oriented(
    c: Calibration, table: Table, options: Mapping[str, Any]
) -> tuple[Options, StatedOrientations]:
    """Return the options that `fit` takes, and what is stated of the orientations."""
    readings = read_readings(table, outputs=c.outputs, environment=c.model.environment)
    readings = orient(readings, options.get("scheme"), estimable=True)
    size = c.sign * float(np.linalg.norm(c.reference[0]))
    given = Options(**{name: options[name] for name in _OPTIONS & options.keys()})
    stated_up = place(readings, size, **given.spread)
    given, _ = with_default_errors(given, stated_up, readings, c.model)
    return given, place(readings, size, **given.spread)


_SHARED = {
    Estimator.LINEAR: _share_known,
    Estimator.UNCERTAIN: _share_uncertain,
    Estimator.UNKNOWN: _share_unknown,
}


_POOR, _REJECTED, _OVERSTATED = "no-redundancy", "denied-noise", "overstated-noise"
# What units are found of without being looked at in full, in the order of `fit`.
_CODES = (
    *("gravity", "turned", _POOR, "temperature-kelvin", "missing-term", "outlier"),
    *("lack-of-fit", _REJECTED, "placement", "unequal-noise", "time-correlated", "drift"),
    *("slipped", "replaced", "settling", "hysteresis", "vibration", "level", "table", _OVERSTATED),
    *("set-aside", "orientation-ignored"),
)
_OF_UNITS = frozenset((*_CODES[4:-1], _POOR))


def _codes(calibration: Calibration) -> set[str]:
    return {finding.code for finding in serious(calibration.diagnostics.findings)}


def _in_order(codes: Iterable[str]) -> str:
    return ";".join(code for code in _CODES if code in codes)


def _findings(
    task: Task,
    pattern: Pattern,
    found: Estimates,
    u: Array,
    dof: Array,
    named: dict[str, Mask],
) -> list[str]:
    """Return what every unit is found of; u and dof are those with gravity's part."""
    shared, count = pattern.shared, len(task.units)
    unknown = isinstance(shared, SharedSphere)
    if not isinstance(shared, uncertain_orientations.SharedOrientations):
        k = coverage_factors(float(task.options.get("confidence", 0.95)), dof)
        poor = are_poorly_known if unknown else are_open
        named[_POOR] = poor(shared.model, found.parameters, k * u)
    if _REJECTED in named:
        for code in ("outlier", "missing-term"):  # which explain it
            named[_REJECTED] &= ~named.get(code, np.False_)
    codes = [code for code, each in named.items() if each.any()]
    number = np.zeros(count, dtype=np.intp)
    for bit, code in enumerate(codes):
        number += named[code].astype(np.intp) << bit
    words = {
        mask: _in_order(
            (*pattern.findings.split(";"), *(c for i, c in enumerate(codes) if mask >> i & 1))
        )
        for mask in np.unique(number).tolist()
    }
    return [words[mask] for mask in number.tolist()]


def _chi2_findings(shared: Shared, task: Task, found: Estimates) -> dict[str, Mask]:
    """Return of which units (B,) chi-squared rejects the stated noise, if any, to either side."""
    if found.chi2 is None:
        return {}
    outputs, n = len(task.values), task.values[0].shape[1]
    equations = n if isinstance(shared, SharedSphere) else n * outputs
    freedom = float(equations - len(shared.model.keys))
    rejected = found.chi2 > chi2_quantile(REJECTED, freedom)
    return {_REJECTED: rejected, _OVERSTATED: found.chi2 < chi2_quantile(1.0 - REJECTED, freedom)}


def solve_task(task: Task) -> Solved:
    """Return what a task finds of its units; those a batch does not answer for are left NaN."""
    if task.pattern is None:
        return _solve_each(task)
    shared = task.pattern.shared
    found = _estimate(shared, task)
    in_time = np.ones(len(task.units), dtype=np.bool_)
    if task.time is not None and isinstance(shared, SharedDesign):
        found, in_time = _spread(shared, task.time, found)
    u, dof = _with_gravity(task.pattern, found)
    count = len(task.units)
    listed, as_listed = task.pattern.listed, found
    if listed is not None:
        as_listed = estimate_known(listed.shared, task.values, task.stated, task.stated_dof)
    fixtures: tuple[FixtureSums, ...] = ()
    if task.pattern.fixture is not None:
        fixtures = sum_fixtures(task.pattern.fixture, task.values, as_listed, task.stations)
    uncertain_orientation = isinstance(shared, uncertain_orientations.SharedOrientations)
    looked_at = ~(found.sound & in_time) | find_suspects(
        shared.model, task.values, found, uncertain_orientation=uncertain_orientation
    )
    if task.pattern.sought is not None:
        looked_at |= task.pattern.sought.find(task.values, task.stated, task.stated_dof, ~looked_at)
    if task.pattern.asked and isinstance(shared, SharedDesign):
        looked_at |= correlated_rows.find_correlated(shared.reference, task.values, found.residuals)
    named = _chi2_findings(shared, task, found)
    tested = UnitFindings({}, looked_at)
    if task.pattern.tests is not None and isinstance(shared, SharedDesign):
        tested = unit_findings.find_in_units(
            task.pattern.tests,
            shared,
            task.values,
            found,
            task.temperature,
            named.get(_REJECTED, False),
        )
    if isinstance(shared, SharedSphere | uncertain_orientations.SharedOrientations):
        columns = {**shared.environment, **dict(zip([TEMPERATURE], task.temperature, strict=False))}
        tested = solution_findings.find_about_solutions(
            task.pattern.kinds, found, columns, task.pattern.like
        )
    if isinstance(shared, user_models.SharedExpression):
        tested = unit_findings.find_in_expressions(task.pattern.kinds, shared, found)
    if listed is not None:
        looked_at |= _may_be_hidden(listed, task, as_listed, tested.found["missing-term"])
    reasons = [LEFT if left else "" for left in (looked_at | tested.singly).tolist()]
    return Solved(
        task.units,
        shared.model.names,
        found.parameters,
        u,
        dof,
        found.rms,
        _findings(task, task.pattern, found, u, dof, named | tested.found),
        reasons,
        [""] * count,
        fixtures,
    )


def _may_be_hidden(listed: Listed, task: Task, found: Estimates, lacking: Mask) -> Mask:
    """Return of which units (B,) orientations as listed may show what their errors hide.

    A term that a unit is found to be lacking all the same is not hidden.
    """
    rejected = _chi2_findings(listed.shared, task, found).get(_REJECTED, False)
    given = listed.shared, task.values, found, task.temperature, rejected
    tested = unit_findings.find_in_units(listed.tests, *given)
    hidden = tested.singly | (tested.found["missing-term"] & ~lacking)
    return np.asarray(hidden | ~(found.sound & (found.rms < CALM)))


def _spread(shared: SharedDesign, time: Array, found: Estimates) -> tuple[Estimates, Mask]:
    """Return estimates with what slow noise makes of u, and which units (B,) it is right of."""
    order = np.argsort(time, axis=1, kind="stable")
    rising = (np.diff(np.take_along_axis(time, order, axis=1), axis=1) > 0.0).all(axis=1)
    alike = rising & (order == order[0]).all(axis=1) & np.isfinite(time).all(axis=1)
    alike &= np.logical_and.reduce([(e != 0.0).any(axis=1) for e in found.residuals])
    designs = [design[order[0]] for design in shared.designs]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios, rows = correlated_rows.spread_in_time(
            designs, [e[:, order[0]] for e in found.residuals]
        )
    alike &= rows >= len(order[0])  # what is said of the others is said in full
    return found._replace(u=found.u * np.concatenate(ratios, axis=1)), alike


def _estimate(shared: Shared, task: Task) -> Estimates:
    if isinstance(shared, SharedSphere):
        return estimate_unknown(shared, task.values, task.stated, task.stated_dof)
    if isinstance(shared, uncertain_orientations.SharedOrientations):
        return uncertain_orientations.estimate_uncertain(
            shared, task.values, task.stated, task.stated_dof
        )
    if isinstance(shared, user_models.SharedExpression):
        return user_models.estimate_expression(shared, task.values)
    pool = bool(task.options.get("pool"))
    return estimate_known(shared, task.values, task.stated, task.stated_dof, pool=pool)


LEFT = "\0left"  # the reason of a unit that a batch leaves to the fit of one


def _with_gravity(pattern: Pattern, found: Estimates) -> tuple[Array, Array]:
    """Return u and its degrees of freedom, with the common term of gravity, as by `add_gravity`."""
    dof = np.broadcast_to(found.dof, found.u.shape)
    gravity = pattern.gravity
    if gravity is None or not gravity.u > 0.0:
        return found.u, dof
    relative = pattern.shared.model.force_degrees * gravity.u / gravity.value
    u = np.hypot(found.u, relative * found.parameters)
    return u, dof * (u / found.u) ** 4


def _solve_each(task: Task) -> Solved:
    """Fit units one by one; one that fails has its reason."""
    if parent_process() is not None:  # a worker, whose warnings nobody asked for
        warnings.simplefilter("ignore", CalibrationWarning)
    fitted: list[Calibration | str] = []
    for unit in task.units.tolist():
        fitted.append(fit_one(task.tables[unit], task.options))
    return gather(task.units, fitted)


def fit_one(table: Table, options: Mapping[str, Any]) -> Calibration | str:
    """Return the calibration of a unit, or why there is none.

    Raises
    ------
    UsageError
        An option is at fault, which no unit can help.
    """
    try:
        return fit(table, **options)
    except UsageError:
        raise
    except MultiposError as error:
        return " ".join(str(error).split())


def gather(units: Places, fitted: list[Calibration | str]) -> Solved:
    """Return what fits of single units found, failures with their reasons."""
    names = next((each.names for each in fitted if isinstance(each, Calibration)), ())
    parameters, u, dof = np.full((3, len(fitted), len(names)), np.nan)
    rms = np.full(len(fitted), np.nan)
    findings, reasons = [""] * len(fitted), [""] * len(fitted)
    wrong = [""] * len(fitted)
    for row, each in enumerate(fitted):
        if isinstance(each, str):
            reasons[row] = each
            continue
        if each.names != names:
            reasons[row] = "the columns of this unit give other parameters than those of others."
            continue
        parameters[row], u[row], dof[row] = each.parameters, each.u, each.parameter_dof
        found = each.diagnostics.findings
        findings[row] = ";".join(dict.fromkeys(finding.code for finding in serious(found)))
        wrong[row] = "; ".join(map(_at_rows, errors_of(found)))
        rms[row] = each.rms
    return Solved(units, names, parameters, u, dof, rms, findings, reasons, wrong)


def _at_rows(finding: Finding) -> str:
    """Return the code of a finding with the rows that it is about, so many as are read."""
    rows = list(finding.rows[:_ROWS_NAMED])
    more = ["…"] if len(finding.rows) > len(rows) else []
    place = "positions" if len(finding.rows) > 1 else "position"
    return f"{finding.code} at {place} {', '.join(rows + more)}" if rows else finding.code
