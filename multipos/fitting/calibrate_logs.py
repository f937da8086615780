"""The front door of logs: from raw logs to a complete calibration, in one go.

`calibrate` does all; `rests_or_rows` finds and averages the rests (`multipos.logs.averaging`), or
takes the rows of a magnetometer that was waved, and `fit_rests` fits them (`multipos.fitting`),
each output along the axis that it names. `readings_of` returns them in the unit that is given or
that they show, by `in_likely_unit`, of a field by `in_likely_field`.

Where no scheme says how the sensor stood, nothing is known of the orientations but that gravity has
the same size in all of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from multipos.errors import MultiposError, RankError, refused_with
from multipos.files.spelling import Names, split_names, spread
from multipos.files.tables import Source
from multipos.finding import Finding, in_order
from multipos.fitting.fit_readings import fit
from multipos.fitting.options import FitOptions, takes_options
from multipos.logs.averages import Averages
from multipos.logs.averaging import RestOptions, average
from multipos.logs.clock import time_columns
from multipos.logs.faults import SaturatedRestsError
from multipos.logs.log_columns import choose_outputs, magnetic_outputs
from multipos.logs.opening import less_copies, open_log
from multipos.logs.rests import NoRestError
from multipos.logs.table import Log
from multipos.numerics.arrays import COMPONENTS, Array, median
from multipos.numerics.terms import Formula, ModelText
from multipos.positions.readings import Readings
from multipos.sensor.calibration import Calibration
from multipos.sensor.gravity import FieldKind, field_sensed
from multipos.uncertainty.budgets import read_budget
from multipos.units import unit_of_gravity

if TYPE_CHECKING:
    from multipos.logs.waved import Waved

# Earth's magnetic field, and a little beyond; other units may as well be counts.
_EARTH = {"T": (2e-5, 7.5e-5), "uT": (20.0, 75.0), "G": (0.2, 0.75)}
_REACH = 0.8  # of the largest range of an output, where each sees both sides of its axis
_FEW = 9  # rests: as many as there are parameters
_LITTLE = 0.2  # of the log
_CROSS = 0.02  # of a scale factor: cross terms that a model without them allows for
_FEWEST = 12  # rests, from which on a model with cross terms sees how far off the faces they are


class CalibrateOptions(RestOptions, FitOptions, total=False):
    """The options of `calibrate`: how logs are averaged, and how the rests are fitted."""


@takes_options(CalibrateOptions, average, fit, model=None, exclude="auto")
def calibrate(*logs: "Source | Log", **options: Unpack[CalibrateOptions]) -> Calibration:
    """Calibrate an accelerometer from raw logs.

    Parameters
    ----------
    *logs : path, mapping of columns, data frame, or Log
        One or more, or one list of them.
    **options
        How the logs are read and where they stand still: as for `multipos.average`. What is fitted,
        and how: as for `multipos.fit`, but for the following.
    scheme : Scheme, name, path, mapping of columns, or data frame, optional
        The positions; otherwise the orientations are unknown.
    order : str
        In which rests that are matched by their order follow the scheme: as for `multipos.fit`.
    model : str or function, optional
        Where none is given it is 'linear', or '1 + own' where the rests are too few for that and
        see both sides of every axis.
    exclude : sequence of str, or comma-separated str
        Labels of the rests that are set aside; 'auto' sets outliers aside, 'none' nothing.

    Returns
    -------
    Calibration
        What averaging has to say is among its warnings.

    Raises
    ------
    MultiposError, UsageError
        As of `multipos.average` and `multipos.fit`.

    Examples
    --------
    >>> import multipos as mp
    >>> sensor = mp.demo().calibration
    >>> log = mp.simulate_log(sensor, "all-26", rate=50, rest=4, sample_sd=1e-3, seed=1)
    >>> cal = mp.calibrate(log)
    >>> print(cal.estimator, len(cal.readings), bool(cal.rms < 1e-3))
    unknown-orientation 26 True
    """
    options.setdefault("exclude", "auto")
    given: dict[str, Any] = {**options}
    averaged = RestOptions.__annotations__.keys() | _FOR_BOTH
    fitted = FitOptions.__annotations__.keys() - {"model", "outputs", "scheme", "order"}
    found = rests_or_rows(*logs, **{name: given[name] for name in averaged & given.keys()})
    return fit_rests(found, given.get("model"), **{n: given[n] for n in fitted & given.keys()})


# What the averaging of rests and their fit are both told.
_FOR_BOTH = {"convention", "exclude", "field", "unit", "outputs", "scheme", "order"}


def rests_or_rows(
    *logs: "Source | Log",
    exclude: Names = "none",
    field: FieldKind | None = None,
    unit: str | None = None,
    **options: Any,
) -> "Averages | Waved":
    """Return the means of rests, or of a magnetometer that was waved the rows as they are.

    Parameters
    ----------
    *logs, options
        As for `multipos.average`.
    exclude, field, unit
        As for `calibrate`.
    """
    sources, copies = less_copies(spread(logs))
    columns, outputs = options.get("columns"), options.get("outputs")
    # Once: what comes from an open file can be read no second time.
    opened = [open_log(source, columns=columns, outputs=outputs) for source in sources]
    averaged = partial(_averaged, set_aside=exclude == "auto")
    found = _rests_or_rows(opened, averaged, field, unit, options)
    return replace(found, findings=in_order((*copies, *found.findings)))


def _rests_or_rows(
    opened: Sequence[Log],
    averaged: Callable[..., Averages],
    field: FieldKind | None,
    unit: str | None,
    options: dict[str, Any],
) -> "Averages | Waved":
    known = ("sections", "label_column", "scheme", "only")
    if field == "gravity" or any(options.get(name) is not None for name in known):
        return averaged(opened, **_with_outputs(opened, field, unit, options))
    given = options.get("outputs")
    names = None if given is None else split_names(given, "--outputs")
    each = [magnetic_outputs(log, names, field, unit) for log in opened]
    first = each[0] if each else None
    if first is None or any(outputs != first for outputs in each):
        return _rests_or_turned(opened, averaged, names, unit, options)
    from multipos.logs.waved import holds_most, moves, read_rows, waved

    signed, drop_bad = options.get("signed"), bool(options.get("drop_bad"))
    values, environment = read_rows(opened, first, signed=signed, drop_bad=drop_bad)
    if not moves(values):
        try:
            found = averaged(opened, set_aside=False, **{**options, "outputs": first})
        except MultiposError:  # no rests: the rows are what there is
            found = None
        if found is not None and holds_most(found, len(values)):
            return found
    return waved(opened, first, values, environment)


def _rests_or_turned(
    opened: Sequence[Log],
    averaged: Callable[..., Averages],
    names: tuple[str, ...] | None,
    unit: str | None,
    options: dict[str, Any],
) -> "Averages | Waved":
    """Return the means of rests, or the windows of an accelerometer that is turned all the time."""
    found, nothing = None, None
    try:
        found = averaged(opened, **options)
    except NoRestError as error:
        nothing = error
    if found is None or _hold_little(found):
        from multipos.logs.turned import turned

        timed = filter(None, (*time_columns(opened[0]), options.get("time_column")))
        outputs = choose_outputs(opened[0], names, [*timed]).names
        asked: dict[str, Any] = {
            "unit": unit,
            "signed": options.get("signed"),
            "drop_bad": bool(options.get("drop_bad")),
        }
        windows = turned(opened[0], outputs, **asked) if len(opened) == 1 else None
        if windows is not None:
            return windows
    if found is None:
        assert nothing is not None
        raise nothing
    return found


def _hold_little(found: Averages) -> bool:
    """Tell whether rests are few and short, as where a sensor that is turned slows down."""
    held = sum(rest.rows.end - rest.rows.start for rest in found.rests)
    return len(found.rests) < _FEW and held < _LITTLE * found.rests[-1].rows.end


def _averaged(opened: Sequence[Log], *, set_aside: bool, **options: Any) -> Averages:
    """Return the means of rests, where a few saturated ones are set aside by the fit with them."""
    try:
        return average(*opened, **options)
    except SaturatedRestsError:
        if not set_aside or options.get("scheme") is not None:
            raise
        return average(*opened, **{**options, "accept_faults": True})


def _with_outputs(
    opened: Sequence[Log], field: str | None, unit: str | None, options: dict[str, Any]
) -> dict[str, Any]:
    """Return the options with the magnetometer's outputs, where --field asks for that sensor."""
    if field != "magnetic" or options.get("outputs") is not None:
        return options
    return {**options, "outputs": magnetic_outputs(opened[0], None, field, unit)}


def fit_rests(
    found: "Averages | Waved",
    model: ModelText | None = None,
    /,
    **options: Unpack[FitOptions],
) -> Calibration:
    """Fit the means of rests: of unknown orientation, unless a scheme was matched to them.

    Options and errors are those of `calibrate`.
    """
    free = options.pop("unknown_orientation", False)
    by_user = any(options.get(name) for name in ("closed_form", "level_sd"))
    by_user = by_user or options.get("orientation_sd") is not None
    assumed = found.scheme_up is None and not by_user
    options["unknown_orientation"] = free or assumed
    options["model"] = "linear" if model is None else model
    readings = readings_of(found, options.pop("unit", None), options.get("field"))
    simple = model is None and _both_sides(readings.values)
    try:
        with refused_with(lambda: found.seen):
            calibration = fit(readings, **options)
    except RankError as error:
        faults = [f"{each.text}. {each.action}" for each in found.findings if each.level == "error"]
        if faults:
            raise MultiposError(" ".join(faults)) from None
        if simple and assumed:
            text = (
                f"{len(readings)} rests near the faces cannot separate cross terms: bias and "
                "scale factor of each output are fitted, and U allows for cross terms of 2 %"
            )
            action = "Record four more rests with edges and corners up, to fit cross terms."
            reduced = Finding("reduced-model", "warning", text, action)
            return _without_cross_terms(readings, reduced, options)
        if free or not assumed:
            raise
        raise RankError(
            f"{error} Name the positions with --scheme if they are known.",
            rank=error.rank,
            parameters=error.parameters,
            combinations=error.combinations,
        ) from None
    off = _bending(calibration)
    if assumed or by_user or not simple or len(readings) >= _FEWEST or off is None:
        return calibration
    text = (
        f"rests stand {off:.2g} degrees off the scheme, too far to fit cross terms: bias and "
        "scale factor of each output are fitted, and U allows for cross terms of 2 %"
    )
    action = "State --orientation-sd in degrees, to fit cross terms all the same."
    reduced = Finding("reduced-model", "warning", text, action)
    options["unknown_orientation"] = True
    return _without_cross_terms(replace(readings, up=None), reduced, options)


def _without_cross_terms(readings: Readings, reduced: Finding, options: FitOptions) -> Calibration:
    """Return bias and scale factor of each output, fitted at unknown orientations."""
    noted = replace(readings, findings=(*readings.findings, reduced))
    budget = options.get("budget")
    stated = {} if budget is None else read_budget(budget).tables
    options["model"] = Formula("1 + own")
    options["budget"] = {"cross": {"u": _CROSS}, **stated}
    return fit(noted, **options)


def _bending(calibration: Calibration) -> float | None:
    """Return the sd of orientations [degrees] of which half the square exceeds noise, else None.

    That much of one g they take off the readings along them, which cross terms hide.
    """
    found = calibration.variance_components
    if found is None or found.orientation_sd_deg is None or calibration.readings.u is None:
        return None
    sd = found.orientation_sd_deg.value
    noise = median(calibration.readings.u) / median(np.linalg.norm(calibration.sensitivity, axis=1))
    return sd if np.radians(sd) ** 2 / 2.0 > noise else None


def _both_sides(values: Array) -> bool:
    """Tell whether rests (n, 3) see both sides of every axis, within some 35 degrees."""
    if values.shape[1] != len(COMPONENTS):
        return False
    reach = np.ptp(values, axis=0)
    return bool(len(values) >= 2 * len(COMPONENTS) and reach.min() > _REACH * reach.max())


def in_likely_field(readings: Readings) -> Readings:
    """Return readings in the unit in which the field is one of Earth's, where there is one."""
    size = float(np.sqrt(readings.values.var(axis=0).sum()))  # of directions all around
    for likely, (low, high) in _EARTH.items():
        if low < size < high:
            text = f"the unit is taken to be {likely}, since the field reads about {size:.2g}"
            findings = (*readings.findings, Finding("likely-unit", "note", text))
            return replace(readings, unit=likely, findings=findings)
    return readings


def readings_of(
    found: "Averages | Waved", unit: str | None, field: FieldKind | None = None
) -> Readings:
    """Return the readings of rests: in the unit given, that of the log, or the one they show."""
    readings = replace(found.readings, findings=found.findings)
    if unit is not None or found.unit is not None:
        return replace(readings, unit=unit or found.unit or "")
    if field_sensed(readings.outputs, readings.unit, field).unit != "g":
        return in_likely_field(readings)
    return in_likely_unit(readings)


def in_likely_unit(readings: Readings) -> Readings:
    """Return readings of a triad in the unit in which they show one g, where there is one."""
    size = float(median(np.linalg.norm(readings.values, axis=1)))
    likely = unit_of_gravity(size)
    if likely is None or readings.values.shape[1] != len(COMPONENTS):
        return readings
    text = f"the unit is taken to be {likely}, since gravity reads {size:.3g}"
    findings = (*readings.findings, Finding("likely-unit", "note", text))
    return replace(readings, unit=likely, findings=findings)
