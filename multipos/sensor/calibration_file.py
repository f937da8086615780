"""Calibrations from files: `load` reads one that was saved, `from_dict` what `to_dict` described.

A file is held to what `Calibration` declares first, so that what is read is of the right kind; then
its lists to one another's sizes, and in the end what it says to what follows from it. What every
key means is in `docs/reference/formats`.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.files.records import require_covariance, restore
from multipos.files.schema import schema_of
from multipos.files.spelling import StrPath
from multipos.files.trees import read_json
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.numerics.rotations import directions
from multipos.positions.forces import known_rows
from multipos.positions.readings import Readings
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator
from multipos.sensor.gravity import field_of_file
from multipos.sensor.model import Model, build_model
from multipos.sensor.own_models import load_parsed


def load(path: StrPath) -> Calibration:
    """Read a calibration written by `Calibration.save`.

    Raises
    ------
    MultiposError
        The file is missing, truncated, of another schema, or holds what no calibration does.

    Examples
    --------
    >>> import multipos as mp
    >>> mp.demo().calibration.save("cal.json")
    >>> mp.load("cal.json") == mp.demo().calibration
    True
    """
    return from_dict(read_json(path, Calibration.schema), str(path))


def from_dict(content: Mapping[str, Any], where: str = "the calibration") -> Calibration:
    """Return the calibration that `Calibration.to_dict` described.

    Raises
    ------
    MultiposError
        A key is missing or not as `Calibration` declares it, the parts contradict each other, or
        the model is a Python function.
    """
    if "expression" in content:  # written by version 0.1 or 0.2
        raise MultiposError(
            f"{where}: its model is a Python function, which is no longer read; fit again with "
            "the model as a formula, such as --model 'each = b + s*own'."
        )
    schema = schema_of(Calibration)

    def make(content: Mapping[str, Any]) -> Calibration:
        _check_names(content)
        return _calibration(**schema.values(content))

    what, again = Calibration.called, Calibration.again
    return restore(content, schema, make, where, what=what, again=again)


def _check_names(c: Mapping[str, Any]) -> None:
    """Hold what a file has by output to its outputs."""
    by_output = {key: c[key] for key in ("residual_sd", "dof", "selection") if key in c}
    components = c.get("variance_components", {})
    for key in ("rest_to_rest", "effective_rows"):
        if key in components:
            by_output[f"variance_components.{key}"] = components[key]
    for key, value in by_output.items():
        if set(value) != set(c["outputs"]):
            raise ValueError(f"'{key}' names {', '.join(value)}, not its outputs")


def _calibration(
    entries: Sequence[Mapping[str, Any]],
    field: Mapping[str, Any],
    model: Mapping[str, Any],
    readings: Mapping[str, Any],
    **values: Any,
) -> Calibration:
    made = _model(model, tuple(readings.get("environment", ())))
    made = replace(_chosen(made, values.get("selection")), field=field_of_file(**field))
    keys = [(entry["output"], entry["term"]) for entry in entries]
    if keys != [(output, str(term)) for output, term in made.keys]:
        raise ValueError("its parameters are not those of its model")
    u, k, dof = (np.array([entry[name] for entry in entries]) for name in ("u", "k", "dof"))
    c = Calibration(
        model=made,
        parameters=np.array([entry["value"] for entry in entries]),
        parameter_dof=np.where(np.isnan(k), 0.0, dof),
        readings=_readings(readings, made, values),
        **values,
    )
    for key, value, shape in _lists(c):
        _require_shape(key, value, shape)
    _check_consistency(c, u)
    return c


def _model(said: Mapping[str, Any], environment: tuple[str, ...]) -> Model:
    stated = (said["outputs"], said["axes"], said["inputs"], said["unit"])
    if "own_formulas" in said:
        return load_parsed(said["own_formulas"], *stated, said["gauge"])
    model = build_model(said["text"], *stated, environment)
    if "drift_per" in said:
        tau = said.get("drift", {}).get("tau")  # none in a file that knows lines alone
        model = model.with_drift(said["drift_per"], tau and (tau["value"], tau["u"]))
    return model if said["gauge"] is None else model.with_gauge(said["gauge"])


def _chosen(model: Model, selection: Mapping[str, Any] | None) -> Model:
    """Return a model of the terms that were chosen, where they were."""
    if selection is None:
        return model
    return model.keeping([(o, term) for o in model.outputs for term in selection[o].terms])


def _readings(said: Mapping[str, Any], model: Model, fitted: Mapping[str, Any]) -> Readings:
    """Return the readings of a file, up along its reference where it does not say otherwise."""
    reference, count, force = fitted["reference"], len(said["values"]), said.get("force")
    for key, vectors in (("reference", reference), ("force", force)):
        if vectors is not None:
            _require_shape(key, vectors, (count, 3))
    size = np.linalg.norm(reference, axis=1)
    at_rest = np.ones(count, dtype=bool) if force is None else ~known_rows(force)
    if not (np.isfinite(size) & ((size > 0.0) | ~at_rest)).all():
        raise ValueError("its reference is zero or not finite")
    sign = -1.0 if fitted["convention"] == "gravity" else 1.0
    free = fitted["estimator"] is Estimator.UNKNOWN
    stated = {} if free else {"up": directions(reference) * sign + 0.0}
    known = {**stated, **said}
    labels = known.pop("labels")
    return Readings(outputs=model.outputs, positions=labels, unit=model.unit, **known)


def _require_shape(key: str, value: Array, shape: tuple[int, ...]) -> None:
    if value.shape != shape:
        raise ValueError(f"'{key}' has shape {value.shape}, but {shape} fits its others")


def _lists(c: Calibration) -> Iterator[tuple[str, Array, tuple[int, ...]]]:
    """Yield lists of a file with the shapes that its readings, outputs and parameters ask."""
    (n, m), p = c.readings.values.shape, len(c.parameters)
    yield "covariance", c.covariance, (p, p)
    yield "residuals", c.residuals, (n, m)
    yield "diagnostics.leverage", c.diagnostics.leverage, (n, m)
    if c.budget is not None and c.budget.scatter is not None:
        yield "budget.scatter", c.budget.scatter, (p, p)
    if c.robust_weight is not None:
        yield "robust_weight", c.robust_weight, (n, m)[: c.robust_weight.ndim]
    if c.orientations is None:
        return
    error = c.orientations.orientation_error_deg
    if error is not None:
        yield "orientation_error_deg", error, (n, m)[: error.ndim]
    for name, vector in (c.orientations.group_rotation_deg or {}).items():
        yield f"group_rotation_deg.{name}", vector, (3,)


def _check_consistency(c: Calibration, u: Array) -> None:
    """Hold the numbers of a file to each other: what it says must follow from what it says."""
    columns = [c.readings.environment.get(name, np.nan) for name in c.model.environment]
    if not all(np.isfinite(column).all() for column in columns):
        raise ValueError("its readings lack a column of its model, or a number in it")
    if c.model.gauge is not None and sorted(c.model.axes) != list(COMPONENTS):
        raise ValueError(f"its gauge is for outputs on x, y and z, not on {c.model.axes}")
    # NaN is right where nothing was left to estimate an uncertainty from.
    require_covariance(c.covariance, u)
    scatter = None if c.budget is None else c.budget.scatter
    if scatter is not None and (np.diag(scatter) < 0.0).any():
        raise ValueError("its budget has a variance below zero")
