"""What a session would end with, tried before its source is opened: a fit of nominal readings.

`rehearse` averages a made-up log of the positions as `capture` does, and fits it with the options
of the session. An option that would be refused after the last pose is refused here, before a pose
is taken. Position k reads

    y_k = b + s (±u_k) + ε,

with s the size of the field in the unit of the readings, b zero, and ε small; where limits of the
readings are stated, they lie around the middle of them. Nothing of it is kept.
"""

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from multipos.capturing.evaluation import SessionPlan, model_of
from multipos.errors import CalibrationWarning, ConvergenceError, MultiposError, RankError
from multipos.files.written_units import MAGNETIC_UNITS
from multipos.fitting.calibrate_logs import fit_rests
from multipos.logs.averaging import average
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.numerics.terms import formula_columns
from multipos.positions.headers import TEMPERATURE
from multipos.positions.scheme import Scheme, read_scheme
from multipos.sensor.calibration import Calibration
from multipos.sensor.model import default_axes
from multipos.sensor.model_text import ParsedModel, read_model
from multipos.units import STANDARD_GRAVITY

_FREE = "faces-corners-14"  # positions of a session that follows no scheme
_MANY = "fibonacci-60"  # where these are too few for the model, and more may be taken
_RATE, _REST = 50.0, 25  # [Hz], samples
_NOISE = 1e-4  # of the size of the field
_SIZES = {"m/s^2": STANDARD_GRAVITY, "mg": 1e3, "count": 16384.0, "T": 5e-5, "uT": 50.0, "nT": 5e4}
_PART = 0.4  # of the range that the field takes
_WARM = {TEMPERATURE: (20.0, 5.0)}  # mean and reach of a column; of others 1 and 0.1


def rehearse(
    plan: SessionPlan,
    outputs: tuple[str, ...] | None,
    then: Callable[[Calibration], object] = lambda calibration: None,
) -> None:
    """Fit nominal readings by the options of a session, and go on with the calibration.

    Parameters
    ----------
    plan : SessionPlan
    outputs : tuple of str or None
        Where they are named.
    then : callable
        Is given the calibration, and raises where it cannot be used. Where no unit is stated it is
        asked of readings in g and in counts: one that can be used is enough.

    Raises
    ------
    UsageError, MultiposError
        The session would end without a calibration, or with one that cannot be used.
    """
    asked = plan.fitting.get("unit")
    magnetic = plan.fitting.get("field") == "magnetic"
    failed: list[MultiposError] = []
    for unit in (asked,) if asked else ("uT",) if magnetic else ("g", "count"):
        try:
            calibration = _fitted(plan, outputs, unit)
            if calibration is not None:
                then(calibration)
            return
        except MultiposError as error:
            failed.append(error)
    raise failed[0]


def _fitted(plan: SessionPlan, outputs: tuple[str, ...] | None, unit: str) -> Calibration | None:
    """Return the calibration of nominal readings; None of a model that these do not suit."""
    written = read_model(plan.fitting.get("model", "linear"))
    own = isinstance(written, ParsedModel)
    names, targets = outputs, plan.targets
    if names is None:
        names = _names(written, unit, plan.fitting.get("field"))
        targets = {name.partition("_")[0]: U for name, U in targets.items()}
    model_of(replace(plan, targets=targets), names, unit)
    schemes = (_FREE, _MANY) if plan.scheme is None else (plan.scheme,)
    for scheme in schemes:
        try:
            return _fit(plan, read_scheme(scheme), names, unit, written)
        except (RankError, ConvergenceError):
            if not own and scheme == schemes[-1]:
                raise
    return None  # what a model of one's own is near is not known before a reading


def _names(written: str | ParsedModel, unit: str, kind: str | None) -> tuple[str, ...]:
    """Return the outputs that nobody has named: those of the model, or of the kind of sensor."""
    if isinstance(written, ParsedModel) and written.lines[0][0] != "each":
        return tuple(name for name, _ in written.lines)
    magnetic = kind == "magnetic" or (kind is None and unit in MAGNETIC_UNITS)
    return tuple(f"{'m' if magnetic else 'a'}{axis}" for axis in COMPONENTS)


def _fit(
    plan: SessionPlan, scheme: Scheme, names: tuple[str, ...], unit: str, written: Any
) -> Calibration:
    """Return the fit of nominal readings at the positions of a scheme."""
    if isinstance(written, ParsedModel):
        columns = written.columns_among(())
    else:  # a single word is no column, but the name of a model
        columns = tuple(name for name in formula_columns(written) if name != written.strip())
    values = _nominal(plan, scheme, default_axes(names, plan.fitting.get("axes")), unit)
    log = _as_log(scheme, names, values, columns)
    found = average(log, label_column="position", outputs=names, accept_faults=True)
    found = replace(found, scheme_up=None if plan.scheme is None else scheme.up)
    options = {n: v for n, v in plan.fitting.items() if n not in ("model", "exclude")}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        model = plan.fitting.get("model", "linear")
        return fit_rests(found, model, **{**options, "unit": unit})


def _nominal(plan: SessionPlan, scheme: Scheme, axes: tuple[str, ...], unit: str) -> Array:
    """Return nominal readings (n, M) without noise."""
    size, bias = _SIZES.get(unit, 1.0), 0.0
    limits = plan.fitting.get("range")
    if limits is not None and len(limits) == 2 and limits[0] < limits[1]:
        bias = (limits[0] + limits[1]) / 2.0
        size = min(size, _PART * (limits[1] - limits[0]))
    sign = -1.0 if plan.convention == "gravity" else 1.0
    sensed = [COMPONENTS.index(axis) for axis in axes if axis in COMPONENTS]
    return np.asarray(bias + sign * size * scheme.up[:, sensed])


def _as_log(
    scheme: Scheme, names: tuple[str, ...], values: Array, columns: tuple[str, ...]
) -> dict[str, Any]:
    """Return rests at the positions, noise about their readings (n, M), and columns that vary."""
    rng = np.random.default_rng(1)
    size = float(np.ptp(values)) or 1.0
    rows = np.repeat(values, _REST, axis=0)
    rows += _NOISE * size * rng.normal(size=rows.shape)
    found: dict[str, Any] = {
        "position": np.repeat(scheme.names, _REST),
        "time": np.arange(len(rows)) / _RATE,
        **dict(zip(names, rows.T, strict=False)),
    }
    for name in columns:
        mean, reach = _WARM.get(name, (1.0, 0.1))
        found[name] = np.repeat(mean + reach * rng.uniform(-1.0, 1.0, len(scheme)), _REST)
    return found
