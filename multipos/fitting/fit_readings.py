"""The front door: from readings and a scheme to a complete calibration.

`fit` reads what it is given, resolves where the positions were, builds the model, picks the
estimator, completes the `Calibration`, and looks whether it looks right before giving it away.
`find_apart` returns the rows that are set aside before, `with_excluded` how far off they are, and
`calibrate_at` fits at orientations that are stated already.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from multipos.diagnostics import gross_errors
from multipos.diagnostics.examination import examine
from multipos.diagnostics.magnetic import moving_iron
from multipos.diagnostics.repairs import explain_failure, refuse_drowned
from multipos.diagnostics.residuals import outlier_of_rows
from multipos.errors import MultiposError, RankError, UsageError
from multipos.estimation import correlated_rows, run_zeros, stated_uncertainty, uncertain
from multipos.estimation.closed_form import solve_closed_form
from multipos.estimation.known import share_design, solve_known
from multipos.estimation.outliers import find_outlying_rows
from multipos.estimation.problem import Solution
from multipos.estimation.session_drift import find_time_constant, with_time_constant
from multipos.files.spelling import Names, quoted, split_names
from multipos.files.tables import Source
from multipos.files.written_units import MAGNETIC_UNITS
from multipos.finding import Finding, Findings, warn
from multipos.fitting.completion import add_findings, complete
from multipos.fitting.facing import face, note_names
from multipos.fitting.options import (
    Options,
    choose_estimator,
    criterion_in_words,
    with_default_errors,
)
from multipos.logs.faults import saturated_few
from multipos.numerics.arrays import COMPONENTS, Array, Mask, coarse_steps
from multipos.numerics.losses import Loss
from multipos.numerics.terms import ModelText, formula_columns, largest_value
from multipos.positions import orientations
from multipos.positions.attitudes import CONVENTIONS, AngleZero, Convention
from multipos.positions.order import Order
from multipos.positions.reading_tables import read_readings
from multipos.positions.readings import Readings, require_range, select_rows, spread_reading_sd
from multipos.positions.scheme import Scheme
from multipos.sensor.bench import StatedBench
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Chosen, Estimator, Excluded
from multipos.sensor.gravity import Field, FieldKind, check_field_kind, signed_size
from multipos.sensor.model import (
    DRIFT,
    GAUGES,
    Gauge,
    Model,
    build_model,
    default_axes,
    stated_facing,
)
from multipos.sensor.model_text import ParsedModel, read_model
from multipos.sensor.nominal import read_nominal
from multipos.sensor.temperature import zeros_in
from multipos.uncertainty.budgets import Budget, BudgetSource, read_budget

_TIED = "the listed directions fix the orientation of the case"
_SPARE = 3  # degrees of freedom of a robust fit: at two of six faces U held 6 to 48 %
_ROLLED = "the rolls of open angle fix the orientation of the case"


def fit(
    readings: "Source | Readings",
    *,
    scheme: "Source | Scheme | None" = None,
    order: Order = "paper",
    model: ModelText = "linear",
    convention: Convention = "specific-force",
    outputs: Names | None = None,
    axes: Names | None = None,
    inputs: Names = COMPONENTS,
    closed_form: bool = False,
    unknown_orientation: bool = False,
    orientation_sd: float | Literal["auto"] | None = None,
    gauge: Gauge = "lower",
    robust: Loss | None = None,
    pool: bool = False,
    stepwise: bool = False,
    exclude: Names = "auto",
    drift: bool = False,
    reading_sd: ArrayLike | None = None,
    gravity: float | None = None,
    gravity_u: float | None = None,
    latitude: float | None = None,
    height: float | None = None,
    field: FieldKind | None = None,
    field_size: float | str | None = None,
    field_size_u: float | str | None = None,
    level_sd: float = 0.0,
    budget: BudgetSource | Budget | None = None,
    unit: str | None = None,
    angle_zero: AngleZero = "up",
    range: Sequence[float] | None = None,
    nominal: Sequence[float] | None = None,
    confidence: float = 0.95,
) -> Calibration:
    """Calibrate an accelerometer from readings at static positions.

    Parameters
    ----------
    readings : Readings, path, mapping of columns, or data frame
    scheme : Scheme, name, path, mapping of columns, or data frame, optional
        The orientation of each position; otherwise the readings' own columns say it.
    order : str
        'paper', 'spread' or 'travel': in which the rows of readings without labels follow the
        scheme (`multipos.positions.order`).
    model : name, Formula, or path
        'linear', 'own-quadratic', … or a formula such as '1 + x + y + z + own^2', or a
        user-defined model (see `multipos.sensor.model_text`).
    convention : str
        'specific-force': the axis that points up reads +1; 'gravity': the one that points down.
    outputs, axes, inputs : sequences of str, or comma-separated str, optional
        The output columns, the case axis each senses, -x where it faces down that axis, and the
        components the model sees. Outputs named ax, ay, az sense the axes they name.
    closed_form : bool
        Use the six-position inversion instead of least squares.
    unknown_orientation : bool
        Nothing is known of the orientations but that gravity has the same size in all of them.
    orientation_sd : float [degrees] or 'auto', optional
        Likely standard deviation of every position about each axis, instead of the readings' own
        column; 'auto', and nothing where orientations are listed, estimates it together with the
        reading noise, and 0 says that they are exact.
    gauge : str
        'lower' or 'symmetric': how the rotation of the case is fixed where nothing else does.
    robust : str, optional
        'huber', 'soft-l1' or 'cauchy': the loss that lets bad positions count less.
    pool : bool
        Use one residual variance for all outputs.
    stepwise : bool
        Keep of the model's terms only those that the readings support.
    exclude : sequence of str, or comma-separated str
        Labels of the positions that are set aside; 'auto' sets single rows aside that do not fit,
        'none' nothing.
    drift : bool
        Fit a drift of every output beside its terms, which compensation leaves out: a line, per
        hour from mid-session by a column `time`, else per row, or exp(−t/τ) where that fits better.
        Biases are then those of the settled sensor (`model.drift`).
    reading_sd : float or M floats, optional
        Standard uncertainty of an averaged reading, in reading units.
    gravity, gravity_u : float [m/s²], optional
        Local gravity and its standard uncertainty; without it one g is the local gravity.
    latitude, height : float [degrees, m], optional
        Take gravity from the WGS 84 normal-gravity formula.
    field : str, optional
        'gravity' or 'magnetic': what the outputs sense; otherwise by their names and unit. Of a
        magnetometer up_…, f_… or b_x, b_y, b_z are the direction of the field, and without them
        the orientations are unknown.
    field_size, field_size_u : number or str, optional
        Size of the magnetic field and its standard uncertainty, such as '48.6uT'; a number is in
        the unit of the readings. Without it the field is of size one.
    level_sd : float [degrees]
        Standard deviation of a tilt that all positions share, about each level axis; where no
        heading is known in U as at the worst ones, as ``[level]`` of a budget.
    budget : path, tables or Budget, optional
        What is known of the measurement beside the readings (`multipos.uncertainty.budgets`).
    unit : str, optional
        Unit of the readings.
    angle_zero : str
        'up' or 'level': how an output stands at `angle_deg` 0.
    range : (low, high), optional
        Readings outside these limits are an error.
    nominal : (bias, scale), optional
        The conversion (raw − bias)/scale before the calibration, with which reports compare it.
    confidence : float
        Coverage probability of U.

    Returns
    -------
    Calibration

    Raises
    ------
    MultiposError
        The data are at fault; the message says what, where, and the way out.
    RankError
        The positions cannot separate the parameters, which are named.
    ConvergenceError
        An uncertain or unknown orientation could not be solved for.
    UsageError
        An option is at fault.

    Warns
    -----
    CalibrationWarning
        Once for each of `diagnostics.findings` that is an error or a warning.

    References
    ----------
    JCGM 100:2008, clauses 5.1, 6.2 and annex G; Song and Qin 2009 for the six positions.

    Examples
    --------
    >>> import multipos as mp
    >>> columns = {"direction": ["E-U-S", "E-N-U", "D-E-S", "W-D-S", "U-W-S", "S-W-D"],
    ...            "ax": [0.0071, -0.0094, -0.9965, -0.0076, 0.9965, 0.0067]}
    >>> cal = mp.fit(columns, unit="V")
    >>> bias = cal["bias_ax"]
    >>> print(f"{bias.value:.5f} {bias.unit}, U = {bias.U:.4f}, dof {bias.dof:g}")
    -0.00053 V, U = 0.0018, dof 2
    """
    given = dict(locals())
    bench = StatedBench(**{each.name: given[each.name] for each in fields(StatedBench)})
    asked = {each.name: given[each.name] for each in fields(Options) if each.name in given}
    options = Options(**asked)
    stated = None if budget is None else read_budget(budget)
    if stated is not None and (grid := stated.quantities.get("resolution")) is not None:
        options = replace(options, resolution=grid.u)
    before = None if nominal is None else read_nominal(nominal)
    local = _gravity_of(stated, bench.local_gravity())
    check_field_kind(field)
    written = read_model(model)
    used = _columns_named(written)
    data = read_readings(
        readings, outputs=outputs, unit=unit, environment=used, field=field, angle_zero=angle_zero
    )
    sensed, free = bench.field_of(data.outputs, data.unit, local), unknown_orientation
    if sensed.towards == "field":
        data, free = _magnetic(data, sensed, options, field, scheme)
    if range is not None:
        require_range(data, range)
    if reading_sd is not None:
        data = _with_reading_sd(data, reading_sd)
    built = _build(written, data, axes, inputs)
    if built.field != sensed:  # else it keeps what was derived of it before
        built = replace(built, field=sensed)
    if drift:
        data, built = _with_drift(data, built)
    if axes is None:
        data = note_names(data, built)
    _check_environment(data, built)
    size = signed_size(sensed, convention)
    if free:
        data = orientations.without_orientation(data, scheme)
    else:
        data = orientations.orient(data, scheme, order, estimable=True)
    if options.level_sd and (data.rotation is None or np.isnan(data.rotation).all()):
        level = {"level": {"u_deg": options.level_sd}}  # at its worst headings
        stated = read_budget({**({} if stated is None else stated.tables), **level})
        options = replace(options, level_sd=0.0)
    _, stated_up, _ = _with_errors(built, data, size, options)
    _require_one_unit(data, sensed)
    # Six positions that are inverted are all needed, and a loss looks for rows itself.
    all_of_them = closed_form or (robust is not None and exclude == "auto")
    sought: Names = "none" if all_of_them else exclude
    if drift:
        data, built, apart = _settled(built, data, stated_up, options, sought)
    else:
        apart = find_apart(built, data, stated_up, sought)
    whole, everywhere = data, stated_up.reference
    exactly = options.as_listed
    listed, facing = orientations.place(data, size, **exactly.spread), stated_facing(axes)
    repaired: Findings = ()
    if listed.exact and (stated_up.estimated or apart.any()):
        repaired = _repaired(built, data, listed, exactly, facing, apart)
    if repaired and not _are_apart(repaired, data.labels, apart):
        options = replace(exactly, orientation_sd=0.0)
        apart = np.zeros_like(apart)  # so that all of it is seen
    if apart.any():
        data = _without_saturated(select_rows(data, ~apart), whole)
    options, stated_up, left_exact = _with_errors(built, data, size, options)
    refuse_drowned(data)
    exact: Calibration | None = None
    if listed.exact and stated_up.estimated:
        exact = _solved(built, data, orientations.place(data, size, **exactly.spread), exactly)
    if exact is not None and exact.effective_rows:  # which U holds
        left_exact = (_as_exact(_CORRELATED),)
        options, exact = replace(exactly, orientation_sd=0.0), None
        stated_up = orientations.place(data, size, **options.spread)
    try:
        calibration = _solved(built, data, stated_up, options)
    except MultiposError as error:
        if exact is not None:  # readings that say nothing of them
            calibration, exact = add_findings(exact, _as_exact(_UNSOLVED)), None
        elif free:
            raise explain_failure(error, data) from None
        else:
            raise
    if apart.any():
        calibration = with_excluded(calibration, whole, everywhere, apart)
        settled = (replace(each, level="warning") for each in repaired)
        calibration = add_findings(calibration, *settled)
    calibration = add_findings(calibration, *left_exact)
    if before is not None:
        calibration = replace(calibration, nominal=before)
    calibration = face(calibration, facing)
    if exact is not None:
        exact = face(exact, facing)
    if stated is not None:
        from multipos.uncertainty.propagation import state_budget

        calibration = state_budget(calibration, stated)
    was_sought = sought == "auto" and not apart.any()
    calibration = examine(calibration, sought=was_sought, exact=exact)
    warn(calibration.findings)
    return calibration


def _with_errors(
    model: Model, readings: Readings, size: float, options: Options
) -> tuple[Options, orientations.StatedOrientations, Findings]:
    """Return options and orientations with what is estimated of their errors, or why nothing."""
    stated_up = orientations.place(readings, size, **options.spread)
    options, exactly = with_default_errors(options, stated_up, readings, model)
    found = () if exactly is None else (_as_exact(exactly),)
    return options, orientations.place(readings, size, **options.spread), found


_CORRELATED = "their errors are not estimated with correlated rows"
_UNSOLVED = "their errors could not be solved for"


def _solved(
    model: Model,
    readings: Readings,
    stated_up: orientations.StatedOrientations,
    options: Options,
) -> Calibration:
    """Return the calibration, or say in words that there is none."""
    try:
        return calibrate_at(model, readings, stated_up, options)
    except np.linalg.LinAlgError:
        raise MultiposError(
            f"{len(readings)} positions do not determine the {len(model.keys)} parameters of this "
            "model under these options; add positions, or drop a term or an option."
        ) from None


def _repaired(
    model: Model,
    readings: Readings,
    listed: orientations.StatedOrientations,
    options: Options,
    facing: tuple[str, ...] | None,
    apart: Mask,
) -> Findings:
    """Return what is grossly wrong with all rows as they are listed, which errors may hide."""
    plain = replace(options, robust=None, stepwise=False)
    try:
        whole = face(_solved(model, readings, listed, plain), facing)
    except MultiposError:
        return ()
    found = gross_errors.explained(whole)
    if found or not apart.any():
        return found
    outlying = outlier_of_rows(whole)
    if outlying is None or outlying.code == "outlier":
        return ()
    of_sign = (replace(outlying, action="Correct the sign."),)
    return of_sign if _are_apart(of_sign, readings.labels, apart) else ()


def _are_apart(found: Findings, labels: Sequence[str], apart: Mask) -> bool:
    """Return whether all rows that are named are among those set aside."""
    aside = {label for label, each in zip(labels, apart.tolist(), strict=True) if each}
    return all(each.rows and aside >= {*each.rows} for each in found)


def _as_exact(why: str) -> Finding:
    """Return the note that orientations are taken as exact though nobody said so."""
    text = f"orientations are taken as exact: {why}; U does not hold their errors"
    return Finding("inseparable", "note", text, "State --orientation-sd in degrees, or 0.")


def _magnetic(
    readings: Readings,
    field: Field,
    options: Options,
    stated: str | None,
    scheme: "Source | Scheme | None",
) -> tuple[Readings, bool]:
    """Return readings of a magnetometer with what is said of them; whether orientations are free.

    Raises
    ------
    UsageError
        A convention or a level, which are of gravity.
    """
    if options.convention != CONVENTIONS[0] or options.level_sd:
        raise UsageError(
            "--convention and --level-sd are of gravity; a magnetic field has the direction that "
            "columns b_x, b_y, b_z give."
        )
    findings = list(readings.findings)
    if stated is None:
        by = "unit" if readings.unit in MAGNETIC_UNITS else "names"
        text = f"outputs {', '.join(readings.outputs)} sense a magnetic field, by their {by}"
        findings.append(Finding("magnetic", "note", text, "State another with --field."))
    free = options.unknown_orientation
    stated_otherwise = options.orientation_sd is not None or options.closed_form
    if readings.up is None and scheme is None and not stated_otherwise:
        free = True
        if not options.unknown_orientation:
            text = "no columns b_x, b_y, b_z give the field's direction: orientations are unknown"
            findings.append(Finding("unknown-orientation", "note", text))
    return replace(readings, findings=tuple(findings)), free


def find_apart(
    model: Model, readings: Readings, stated_up: orientations.StatedOrientations, exclude: Names
) -> Mask:
    """Return which rows (n,) are to be set aside.

    Raises
    ------
    MultiposError
        No position has a label that is to be set aside, or none would be left.
    """
    apart = np.zeros(len(readings), dtype=np.bool_)
    if exclude == "none":
        return apart
    if exclude == "auto":
        known = None if stated_up.unknown else stated_up.reference
        if known is not None and (stated_up.groups or stated_up.rolls is not None):
            return apart  # directions of some positions follow from the others
        saturated = saturated_few(readings.findings, len(readings)) if known is None else ()
        apart[[label in saturated for label in readings.labels]] = True
        left = select_rows(readings, ~apart) if apart.any() else readings
        if known is not None:
            left = run_zeros.without_zeros(left, model, known)
        found = find_outlying_rows(
            model, stated_uncertainty.shrink_variances(left), known, stated_up.orientation_sd
        )
        if found is not None:
            apart[np.flatnonzero(~apart)[found.rows]] = True
        return apart
    labels = split_names(exclude, "--exclude")
    where = readings.source or "the readings"
    for label in labels:
        if label not in readings.labels:
            raise MultiposError(
                f"{where}: no position is called '{label}', which --exclude is to set aside; there "
                f"are {quoted(dict.fromkeys(readings.labels))}."
            )
    apart[[label in labels for label in readings.labels]] = True
    if apart.all():
        raise MultiposError(f"{where}: --exclude sets every position aside; keep some.")
    return apart


def _without_saturated(readings: Readings, whole: Readings) -> Readings:
    """Return readings that need no more be done about saturated rows that were set aside."""
    apart = set(whole.labels) - set(readings.labels)
    wider = "Record it again in a wider range."
    findings = tuple(
        replace(each, action=wider) if each.code == "saturated" and apart >= {*each.rows} else each
        for each in readings.findings
    )
    return replace(readings, findings=findings)


def with_excluded(
    calibration: Calibration, readings: Readings, reference: Array, apart: Mask
) -> Calibration:
    """Return a calibration with how far off it the rows are that were set aside.

    Parameters
    ----------
    calibration : Calibration
        Without them.
    readings, reference
        With them, (n, 3) [g].
    apart : (n,) array of bool
    """
    rows = select_rows(readings, apart)
    if calibration.estimator is Estimator.UNKNOWN:
        force = calibration.compensate(rows.values, rows.environment)
        size = float(np.linalg.norm(calibration.reference, axis=1).mean())
        off = np.abs(np.linalg.norm(force, axis=1) - size)
    else:
        left = rows.values - calibration.predict(reference[apart], rows.environment)
        response = np.linalg.norm(calibration.sensitivity, axis=1)
        response[response == 0.0] = np.inf  # an output that does not respond is off by no force
        off = np.linalg.norm(left / response, axis=1)
    places = (np.flatnonzero(apart) + 1).tolist()
    unit = calibration.field.unit
    excluded = tuple(
        Excluded(label, each, unit, row)
        for label, each, row in zip(rows.labels, off.tolist(), places, strict=True)
    )
    calibration = replace(calibration, excluded=excluded)
    labels = tuple(each.label for each in excluded)
    note = Finding("excluded", "note", calibration.set_aside, rows=labels)
    moved = moving_iron(calibration, readings) if calibration.field.towards == "field" else None
    return add_findings(calibration, *((note,) if moved is None else (note, moved)))


_WITHIN = 1e6  # degrees of freedom of a rounding


def _with_grid_variance(
    readings: Readings, solution: Solution, resolution: float
) -> Readings | None:
    """Return readings whose u is that of their grid, where it is coarser than their scatter.

    The grid is seen in the readings, or stated by its u, which stated noise does not hold. None
    where it is finer; u of other outputs is what their residuals show.
    """
    sd, noise = solution.residual_sd, readings.noise
    if not np.isfinite(sd).all() or (noise is not None and noise.ndim == 2):
        return None
    if readings.samples is not None:  # means of many lie between the steps
        return None
    steps = coarse_steps(readings.values, sd)
    if readings.u is None:
        steps = np.maximum(steps, np.where(sd < resolution, math.sqrt(12.0) * resolution, 0.0))
    if not steps.any():
        return None
    lower_bound = np.broadcast_to(steps / math.sqrt(12.0), readings.values.shape)
    if readings.u is not None:
        return replace(readings, u=np.maximum(readings.u, lower_bound))
    u = np.where(steps > 0.0, lower_bound, np.maximum(sd, 1e-3 * steps.max()))
    dof = np.where(steps > 0.0, _WITHIN, np.clip(solution.dof, 1.0, _WITHIN))
    return replace(readings, u=u, dof=np.broadcast_to(dof, u.shape))


def calibrate_at(
    model: Model,
    readings: Readings,
    stated_up: orientations.StatedOrientations,
    options: Options,
) -> Calibration:
    """Return the calibration of readings whose positions are resolved; no finding is asked yet."""
    tied = _TIED if stated_up.listed.any() else stated_up.rolls and _ROLLED
    if options.gauge != GAUGES[0] and tied:
        text = f"--gauge {options.gauge} has no effect: {tied}"
        unused = Finding("gauge-unused", "warning", text, "Omit --gauge.")
        readings = replace(readings, findings=(*readings.findings, unused))
    estimator = choose_estimator(options, stated_up)
    if options.robust is not None and stated_up.exact:
        _require_spare(model, len(readings))
    readings = stated_uncertainty.shrink_variances(readings)
    solve = _solver(estimator, readings, stated_up, options)
    chosen = None
    if options.stepwise:
        model, chosen = _stepwise(model, readings, stated_up, solve)
    solution = solve(model)
    if readings.reference_u is not None:
        tested = readings.noise is not None
        readings = stated_uncertainty.add_reference_noise(readings, solution)
        solution = _solver(estimator, readings, stated_up, options, tested=tested)(model)
    bounded_below = None
    if options.robust is None:
        bounded_below = _with_grid_variance(readings, solution, options.resolution)
    if bounded_below is not None:
        readings = bounded_below
        solution = _solver(estimator, readings, stated_up, options, tested=False)(model)
    solution = stated_uncertainty.with_stated_dof(solution, readings, joint=not estimator.exact)
    zeros = zeros_in(readings, model)
    if zeros is not None:
        solution = run_zeros.spread_zeros(solution, readings, zeros, estimator)
    else:
        solution = correlated_rows.spread_correlation(solution, readings, stated_up, estimator)
    found = solution.orientation_sd
    calibration = complete(
        solution,
        orientations.as_used(readings, stated_up.orientation_sd if found is None else found),
        listed=np.where(stated_up.listed[:, None], stated_up.reference, np.nan),
        convention=options.convention,
        estimator=estimator,
        criterion=criterion_in_words(estimator, options, model, readings),
        confidence=options.confidence,
    )
    calibration = with_time_constant(_with_rolls(calibration))
    if chosen is None:
        return calibration
    from multipos.fitting.model_selection import with_selection

    return with_selection(calibration, chosen)


def _require_one_unit(readings: Readings, field: Field) -> None:
    """Refuse known forces, which are in standard g, beside a gravity of unknown size."""
    forced = readings.forced
    if field.size is None and forced.any() and not forced.all():
        label = readings.labels[int(np.argmin(forced))]
        raise MultiposError(
            f"{readings.source or 'the readings'}: position '{label}' is at rest in gravity, "
            "others have a known force in standard g; give --gravity or --latitude, so that both "
            "are in one unit."
        )


def _require_spare(model: Model, n: int) -> None:
    """Refuse a robust loss where so little is left that it goes through what it should finding."""
    spare = n - max(len(terms) for terms in model.terms)
    if spare < _SPARE:
        raise UsageError(
            f"--robust needs {_SPARE} degrees of freedom, and {n} positions leave {max(spare, 0)} "
            f"with the model '{model.text}'; leave it out, or add positions."
        )


def _solver(
    estimator: Estimator,
    readings: Readings,
    stated_up: orientations.StatedOrientations,
    options: Options,
    *,
    tested: bool = True,
) -> Callable[[Model], Solution]:
    """Return what solves a model by the estimator; `tested`: residuals test the stated noise."""
    reference, pool = stated_up.reference, options.pool

    def solve(model: Model) -> Solution:
        if estimator is Estimator.CLOSED_FORM:
            return solve_closed_form(model, reference, readings, pool=pool)
        exact = estimator is Estimator.LINEAR and options.robust is None
        if exact and model.has_terms:
            return solve_known(model, reference, readings, pool=pool, tested=tested)
        if exact:
            from multipos.estimation.user_models import is_untied, solve_own_known

            if is_untied(model, readings):
                return solve_own_known(model, reference, readings, pool=pool, tested=tested)
        if stated_up.estimated and model.has_terms:
            share_design(model, reference, readings.environment)  # or it says what they separate
        found = uncertain.solve_uncertain(
            model, readings, stated_up, gauge=options.gauge, robust=options.robust, pool=pool
        )
        return found if tested else _untested(found)

    return solve


def _untested(found: Solution) -> Solution:
    """Return a solution without what it says of a noise that nobody stated."""
    findings = tuple(each for each in found.findings if each.code != "overstated-noise")
    return replace(found, claim=None, findings=findings)


def _stepwise(
    model: Model,
    readings: Readings,
    stated_up: orientations.StatedOrientations,
    solve: Callable[[Model], Solution],
) -> tuple[Model, dict[str, Chosen]]:
    """Return the model with the terms that the readings support, and how they were chosen."""
    from multipos.fitting.model_selection import select_terms

    if not model.has_terms:
        raise UsageError("--stepwise chooses among the terms of a formula, not of an expression.")
    if stated_up.exact:
        return select_terms(model, stated_up.reference, readings)
    try:
        whole = solve(model)  # where the positions are is found with all terms
    except RankError:
        if not stated_up.listed.all():
            raise
        return select_terms(model, stated_up.reference, readings)
    return select_terms(whole.model, whole.reference, readings)


def _gravity_of(budget: Budget | None, local: Field | None) -> Field | None:
    """Return the gravity of the options or of the budget."""
    if budget is None or budget.gravity is None:
        return local
    if local is not None:
        raise UsageError("the options and the budget's [gravity] both state it; give one.")
    return Field(*budget.gravity)


def _with_rolls(calibration: Calibration) -> Calibration:
    """Return the calibration of one or two axes with what its rolls warn of."""
    if len(calibration.outputs) == len(COMPONENTS):
        return calibration
    from multipos.uncertainty.turntable import find_in_rolls

    return add_findings(calibration, *find_in_rolls(calibration))


def _columns_named(model: str | ParsedModel) -> tuple[str, ...]:
    """Return the names in a model that are columns, where the readings have such."""
    if isinstance(model, ParsedModel):
        return model.possible_columns
    return formula_columns(model)


_HOUR = 3600.0  # [s]


def _with_drift(readings: Readings, model: Model) -> tuple[Readings, Model]:
    """Return readings with the time from mid-session, and the model with a drift.

    Raises
    ------
    UsageError
        The model is user-defined, or uses a column of the same name.
    """
    if DRIFT in model.environment:
        raise UsageError(
            "--drift adds a term `drift` to a formula, and the model uses a column of that name; "
            "give the column another one."
        )
    time, n = readings.environment.get("time"), len(readings)
    timed = time is not None and np.isfinite(time).all() and np.ptp(time) > 0.0
    column = np.arange(n, dtype=np.float64) if time is None or not timed else time / _HOUR
    middle = column - 0.5 * (column.min() + column.max())
    columns = {**readings.environment, DRIFT: middle}
    return replace(readings, environment=columns), model.with_drift("h" if timed else "row")


def _settled(
    model: Model,
    readings: Readings,
    stated_up: orientations.StatedOrientations,
    options: Options,
    exclude: Names,
) -> tuple[Readings, Model, Mask]:
    """Return readings and model with the drift that fits, and which rows are set aside beside it.

    Each hangs on the other: rows of a sensor that settles are no outliers, and an outlier is no
    drift.
    """
    line, plain = readings.environment[DRIFT], replace(options, stepwise=False, robust=None)
    elapsed = (line - line.min()) * (_HOUR if model.drift_per == "h" else 1.0)
    for _ in range(_ROUNDS):
        apart = find_apart(model, readings, stated_up, exclude)
        # a loss lets rows count less only when it is fitted
        used = ~find_apart(model, readings, stated_up, "auto") if options.robust else ~apart
        rows = select_rows(readings, used)
        size = signed_size(model.field, options.convention)
        try:
            found = calibrate_at(model, rows, *_with_errors(model, rows, size, plain)[1::-1])
            tau = find_time_constant(found, elapsed[used])
        except (MultiposError, np.linalg.LinAlgError):
            tau = None  # what is wrong is said of the fit itself
        column = line if tau is None else np.exp(-elapsed / tau[0])
        readings = replace(readings, environment={**readings.environment, DRIFT: column})
        model = replace(model, drift_tau=tau)
        if tau is None:
            break
    return readings, model, apart


_ROUNDS = 3  # of the drift and of the rows set aside


def _build(
    model: str | ParsedModel,
    readings: Readings,
    axes: Names | None,
    inputs: Names,
) -> Model:
    own = default_axes(readings.outputs, axes)
    columns = tuple(readings.environment)
    seen = split_names(inputs, "--inputs")
    if readings.plane and seen == COMPONENTS:
        seen = readings.plane
    if isinstance(model, ParsedModel):
        used = model.columns_among(columns)
        model.require_no_near_miss(used, (*columns, *readings.outputs), readings.outputs)
        from multipos.sensor.own_models import build_parsed

        return build_parsed(model, readings.outputs, own, seen, readings.unit, used)
    return build_model(model, readings.outputs, own, seen, readings.unit, columns)


def _with_reading_sd(readings: Readings, reading_sd: ArrayLike) -> Readings:
    u = spread_reading_sd(reading_sd, readings.values.shape)
    findings = readings.findings
    if readings.u is not None or readings.covariance is not None:
        text = "stated uncertainties of the readings are ignored; --reading-sd is used"
        findings += (Finding("u-ignored", "note", text),)
    return replace(readings, u=u, dof=None, covariance=None, findings=findings)


def _check_environment(readings: Readings, model: Model) -> None:
    for name in model.environment:
        if name not in readings.environment:
            raise MultiposError(
                f"{readings.source or 'the readings'}: the model uses '{name}', but there is no "
                "such column; add it, or take the term out of the model."
            )
        bad = ~np.isfinite(readings.environment[name])
        if bad.any():
            raise MultiposError(
                f"{readings.source or 'the readings'}: row {int(np.argmax(bad)) + 1}, "
                f"column '{name}' is empty or not finite, but the model uses it."
            )
        limit = largest_value((term for _, term in model.keys), name)
        far = np.abs(readings.environment[name]) > limit
        if far.any():
            row = int(np.argmax(far))
            raise MultiposError(
                f"{readings.source or 'the readings'}: row {row + 1}, column '{name}': "
                f"{readings.environment[name][row]:g} is beyond {limit:.0e}, whose powers are no "
                "numbers in this model; correct it, or give the column in another unit."
            )
