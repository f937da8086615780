"""Calibrations out of files: `load`, and what makes the parts of a calibration from its keys.

A file is held to its description (`multipos.sensor.calibration_file`) first, so that what is read
here is of the right kind; then its lists to one another's sizes, and in the end what it says to
what follows from it.
"""

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from multipos.doubt import read_doubt
from multipos.errors import MultiposError
from multipos.files.records import require, require_covariance
from multipos.files.trees import read_json
from multipos.numerics.arrays import Array
from multipos.numerics.rotations import directions
from multipos.numerics.terms import COMPONENTS
from multipos.positions.forces import known_rows
from multipos.positions.readings import Readings
from multipos.sensor.calibration import Calibration, Status
from multipos.sensor.calibration_file import CALIBRATION, SCHEMA
from multipos.sensor.diagnostics import Claim, Diagnostics
from multipos.sensor.found import (
    Chosen,
    Component,
    Estimator,
    FoundOrientations,
    Placed,
    RestToRest,
    Sessions,
    StatedBudget,
    VarianceComponents,
)
from multipos.sensor.functions import load_expression
from multipos.sensor.gravity import Gravity
from multipos.sensor.model import Model
from multipos.sensor.nominal import read_nominal
from multipos.sensor.own_models import load_sketch
from multipos.sensor.stating import build_model
from multipos.sensor.term_tests import model_test_from_dict

_PLACED = ("value", "u", "determined")


def load(path: str | os.PathLike[str]) -> Calibration:
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
    return from_dict(read_json(path, SCHEMA), str(path))


def from_dict(content: Mapping[str, Any], where: str = "the calibration") -> Calibration:
    """Return the calibration that `Calibration.to_dict` described.

    Raises
    ------
    MultiposError
        A key is missing or not as `CALIBRATION` has it, or the parts contradict each
        other.
    """
    require(content, CALIBRATION, where, "fit again")
    try:
        _check_shapes(content)
        calibration = _from_dict(content)
        _check_consistency(calibration, content["parameters"])
    except ValueError as error:
        said = str(error).rstrip(".")
        raise MultiposError(f"{where}: not a calibration: {said}; fit again.") from None
    return calibration


def _from_dict(content: Mapping[str, Any]) -> Calibration:
    outputs = tuple(content["outputs"])
    model = _model(content)
    parameters = content["parameters"]
    keys = [(entry["output"], entry["term"]) for entry in parameters]
    if keys != [(output, str(term)) for output, term in model.keys]:
        raise ValueError("its parameters are not those of its model")
    cross_check, gravity = content["cross_check"], content["gravity"]
    return Calibration(
        model=model,
        parameters=_numbers([entry["value"] for entry in parameters]),
        covariance=_numbers(content["covariance"]),
        parameter_dof=_dof([entry["dof"] for entry in parameters], parameters),
        dof=_dof([content["dof"][output] for output in outputs]),
        residuals=_numbers(content["residuals"]),
        residual_sd=_numbers([content["residual_sd"][output] for output in outputs]),
        reference=_numbers(content["reference"]),
        readings=_readings(content, model),
        convention=content["convention"],
        gravity=None if gravity is None else Gravity(gravity["value"], gravity["u"]),
        estimator=Estimator(content["estimator"]),
        criterion=content["criterion"],
        confidence=float(content["confidence"]),
        diagnostics=_diagnostics(content["diagnostics"]),
        status=Status(**_known_keys(content["status"], Status._fields)),
        created=content["created"],
        version=content["multipos_version"],
        cross_check=None
        if cross_check is None
        else float(cross_check["closed_form_max_difference"]),
        **_found(content),
    )


def _model(content: Mapping[str, Any]) -> Model:
    if "own_model" in content:
        return load_sketch(content)
    if "expression" in content:
        model: Model = load_expression(content)
    else:
        model = build_model(
            content["model"],
            tuple(content["outputs"]),
            tuple(content["axes"]),
            tuple(content["inputs"]),
            str(content["unit"]),
            tuple(content.get("environment", ())),
        )
    if content["gauge"] is not None:
        model = model.with_gauge(content["gauge"])
    chosen = content.get("selection")
    if chosen is None:
        return model
    return model.keeping([(o, term) for o in content["outputs"] for term in chosen[o]["terms"]])


def _readings(content: Mapping[str, Any], model: Model) -> Readings:
    reference, force = _numbers(content["reference"]), _numbers(content.get("force"))
    size = np.linalg.norm(reference, axis=1)
    at_rest = np.ones(len(size), dtype=bool) if force is None else ~known_rows(force)
    if not (np.isfinite(size) & ((size > 0.0) | ~at_rest)).all():
        raise ValueError("its reference is zero or not finite")
    sign = -1.0 if content["convention"] == "gravity" else 1.0
    up = directions(reference) * sign + 0.0
    sd_deg = content.get("orientation_sd_deg")
    return Readings(
        values=_numbers(content["readings"]),
        outputs=model.outputs,
        positions=tuple(content["positions"]),
        up=_numbers(content["up"]) if "up" in content else up,
        rotation=_numbers(content.get("attitude")),
        force=force,
        reference_u=_numbers(content.get("reference_u")),
        u=_numbers(content.get("reading_u")),
        covariance=_numbers(content.get("reading_covariance")),
        sd=_numbers(content.get("reading_sd")),
        samples=_numbers(content.get("samples")),
        orientation_sd=None if sd_deg is None else np.radians(_numbers(sd_deg)),
        group=content.get("group"),
        environment={
            name: _numbers(column) for name, column in content.get("environment", {}).items()
        },
        unit=model.unit,
        source=content["input"]["file"],
        sha256=content["input"]["sha256"],
        dof=_numbers(content.get("reading_dof")),
        open_roll=content.get("open_roll"),
    )


def _diagnostics(found: Mapping[str, Any]) -> Diagnostics:
    return Diagnostics(
        rank=found["rank"],
        parameters=found["parameters"],
        condition=float(_numbers([found["condition"]])[0]),
        leverage=_numbers(found["leverage"]),
        lack_of_fit={
            output: {key: test[key] for key in ("F", "dof", "p")}
            for output, test in found["lack_of_fit"].items()
        },
        outliers=tuple(found["outliers"]),
        unidentifiable=tuple(found["unidentifiable"]),
        warnings=tuple(found["warnings"]),
        doubts=tuple(map(read_doubt, found.get("doubts", ()))),
        model_tests=tuple(map(model_test_from_dict, found.get("model_tests", ()))),
        hidden=tuple(found.get("hidden", ())),
        claim=Claim(claim["chi2"], claim["dof"]) if (claim := found.get("claim")) else None,
    )


def _found(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a calibration that only some estimators and budgets add."""
    found: dict[str, Any] = {"robust_weight": _numbers(content.get("robust_weight"))}
    components, chosen = content.get("variance_components"), content.get("selection")
    if components is not None:
        found["variance_components"] = _components(components)
    if orientations := _orientations(content):
        found["orientations"] = orientations
    if "facing" in content:
        found["facing"] = tuple(content["facing"])
    if chosen is not None:
        found["selection"] = {output: _chosen(said) for output, said in chosen.items()}
    if "nominal" in content:
        found["nominal"] = read_nominal([content["nominal"][key] for key in ("bias", "scale")])
    if "sessions" in content:
        said = content["sessions"]
        found["sessions"] = Sessions(said["runs"], tuple(said["files"]), said["sd"])
    if "budget" in content:
        said = content["budget"]
        scatter = _numbers(said.get("scatter"))
        found["budget"] = StatedBudget(said["tables"], tuple(said["rows"]), scatter)
    return found


def _orientations(content: Mapping[str, Any]) -> FoundOrientations | None:
    known = _known_keys(content, [field.name for field in fields(FoundOrientations)])
    if not known:
        return None
    for key in ("orientation_error_deg", "level_tilt_deg"):
        known[key] = _numbers(known.get(key))
    groups = known.get("group_rotation_deg")
    if groups is not None:
        known["group_rotation_deg"] = {k: _numbers(v) for k, v in groups.items()}
    return FoundOrientations(**known)


def _components(said: Mapping[str, Any]) -> VarianceComponents:
    scatter, reading, placed = (
        said.get(key) for key in ("rest_to_rest", "reading_sd", "orientation_sd_deg")
    )
    if scatter is not None:
        dof = _dof([part["dof"] for part in scatter.values()]).tolist()
        scatter = {
            output: RestToRest(part["value"], part["u"], nu)
            for (output, part), nu in zip(scatter.items(), dof, strict=True)
        }
    return VarianceComponents(
        scatter,
        None if reading is None else Component(reading["value"], reading["u"]),
        None if placed is None else Placed(**{"determined": True, **_known_keys(placed, _PLACED)}),
        said.get("effective_rows"),
    )


def _known_keys(said: Mapping[str, Any], keys: Iterable[str]) -> dict[str, Any]:
    """Return what is said under keys that are known; a later version may have more."""
    return {key: said[key] for key in keys if key in said}


def _chosen(said: Mapping[str, Any]) -> Chosen:
    return Chosen(
        tuple(said["terms"]), tuple(said["path"]), said["runner_up"], tuple(said["collinear"])
    )


def _check_shapes(c: Mapping[str, Any]) -> None:
    """Hold the lists of a file to the numbers of its readings, outputs and parameters."""
    for key, value, shape in _lists(c, len(c["readings"]), len(c["outputs"]), len(c["parameters"])):
        if np.shape(value) != shape:
            raise ValueError(f"'{key}' has shape {np.shape(value)}, but {shape} fits its others")
    by_output = {key: c[key] for key in ("residual_sd", "dof", "selection") if key in c}
    components = c.get("variance_components", {})
    for key in ("rest_to_rest", "effective_rows"):
        if key in components:
            by_output[f"variance_components.{key}"] = components[key]
    for key, value in by_output.items():
        if set(value) != set(c["outputs"]):
            raise ValueError(f"'{key}' names {', '.join(value)}, not its outputs")


def _lists(
    c: Mapping[str, Any], n: int, m: int, p: int
) -> Iterator[tuple[str, Any, tuple[int, ...]]]:
    """Yield lists of a file with the shapes that n readings, m outputs and p parameters ask."""
    known: dict[str, tuple[int, ...]] = {
        "covariance": (p, p),
        "readings": (n, m),
        "residuals": (n, m),
        "reference": (n, 3),
        "positions": (n,),
        "reading_u": (n, m),
        "reading_dof": (n, m),
        "reading_covariance": (n * m, n * m),
        "reading_sd": (n, m),
        "samples": (n,),
        "orientation_sd_deg": (n,),
        "group": (n,),
        "open_roll": (n,),
        "attitude": (n, 3, 3),
        "up": (n, 3),
        "force": (n, 3),
        "reference_u": (n, 3),
    }
    yield from ((key, c[key], shape) for key, shape in known.items() if key in c)
    yield "diagnostics.leverage", c["diagnostics"]["leverage"], (n, m)
    for name, column in c.get("environment", {}).items():
        yield f"environment.{name}", column, (n,)
    if "scatter" in c.get("budget", {}):
        yield "budget.scatter", c["budget"]["scatter"], (p, p)
    for key in ("robust_weight", "orientation_error_deg"):
        if key in c:
            yield key, c[key], (n, m) if np.ndim(c[key]) > 1 else (n,)


def _check_consistency(c: Calibration, parameters: list[dict[str, Any]]) -> None:
    """Hold the numbers of a file to each other: what it says must follow from what it says."""
    columns = [c.readings.environment.get(name, np.nan) for name in c.model.environment]
    if not all(np.isfinite(column).all() for column in columns):
        raise ValueError("its readings lack a column of its model, or a number in it")
    if c.model.gauge is not None and sorted(c.model.axes) != list(COMPONENTS):
        raise ValueError(f"its gauge is for outputs on x, y and z, not on {c.model.axes}")
    # NaN is right where nothing was left to estimate an uncertainty from.
    require_covariance(c.covariance, _numbers([entry["u"] for entry in parameters]))


def _numbers(value: Any) -> Any:
    """Return nested lists as an array, null as NaN; None stays None."""
    return None if value is None else np.array(value, dtype=np.float64)


def _dof(values: list[float | None], parameters: list[dict[str, Any]] | None = None) -> Array:
    """Return degrees of freedom; null is infinite where there is a k, else unknown."""
    dof = [np.inf if value is None else value for value in values]
    if parameters is not None:
        dof = [
            0.0 if entry["k"] is None else value
            for entry, value in zip(parameters, dof, strict=True)
        ]
    return np.array(dof, dtype=np.float64)
