"""Calibrations in files: what a calibration file holds, key by key, and its writing.

Its reading is `multipos.sensor.calibration_file`. What a calibration derives again when it is read
(its rms, the labels of its parameters) is not read and not described here; what every key means is
in `docs/reference/formats`.

Calibrations out of files: `load`, and what makes the parts of a calibration from its keys.

A file is held to its description (`multipos.sensor.calibration_file`) first, so that what is read
here is of the right kind; then its lists to one another's sizes, and in the end what it says to
what follows from it.
"""

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.files.records import (
    ANY_NUMBER,
    ANY_TEXT,
    AXIS,
    FIGURE,
    INPUT,
    LARGEST_SQUARE,
    NOT_NEGATIVE,
    P_VALUE,
    POSITIVE,
    SHARE,
    TEXTS,
    VARIANCES,
    AnyOf,
    Fields,
    Flag,
    Listed,
    Maybe,
    Named,
    Number,
    Numbers,
    Text,
    Whole,
    require,
    require_covariance,
)
from multipos.files.trees import read_json
from multipos.finding import FINDINGS, read_findings
from multipos.numerics.arrays import Array
from multipos.numerics.rotations import directions
from multipos.numerics.terms import COMPONENTS
from multipos.positions.forces import known_rows
from multipos.positions.headers import MAGNETIC_UNITS
from multipos.positions.readings import Readings
from multipos.results import plain
from multipos.sensor.calibration import Calibration, Status
from multipos.sensor.fit_diagnostics import (
    MODEL_TESTS,
    Diagnostics,
    NoiseTest,
    model_test_from_dict,
)
from multipos.sensor.found import (
    Chosen,
    Component,
    Estimator,
    Excluded,
    FoundOrientations,
    OrientationSpread,
    RestToRest,
    Sessions,
    StatedBudget,
    VarianceComponents,
)
from multipos.sensor.functions import load_expression
from multipos.sensor.gravity import FIELD_KINDS, Field
from multipos.sensor.inverse import read_nominal
from multipos.sensor.model import GAUGES, ROLL_GAUGES, Model
from multipos.sensor.own_models import expression_dict, load_parsed
from multipos.sensor.stating import build_model

SCHEMA = "multipos/calibration/1"
_DIAGNOSTICS = (
    "rank",
    "parameters",
    "condition",
    "lack_of_fit",
    "outliers",
    "unidentifiable",
    "findings",
    "hidden",
    "leverage",
)
# Null is infinite, 0 none; less than a millionth of one is neither.
_DOF = Maybe(AnyOf((Number(0.0, 0.0), Number(1e-6))))
_SETTING = AnyOf((ANY_TEXT, Flag(), Listed(Whole()), ANY_NUMBER))  # of a table in a budget

# One number a position, or one an output as well where the outputs were fitted apart.
_BY_POSITION = AnyOf((Numbers(2, gaps=True), Numbers(1, gaps=True)))
_COMPONENT = Fields({"value": POSITIVE, "u": POSITIVE})
_ORIENTATION_SPREAD = Fields({"value": POSITIVE, "u": POSITIVE}, {"determined": Flag()})
_REST_TO_REST = Named(Fields({"value": NOT_NEGATIVE, "u": NOT_NEGATIVE, "dof": _DOF}))
_QUANTITY = Fields(
    {},
    {
        "start": ANY_NUMBER,
        "sd": ANY_NUMBER,
        "unit": ANY_TEXT,
        "low": ANY_NUMBER,
        "high": ANY_NUMBER,
    },
)
_NOISE_TEST = Maybe(Fields({"chi2": NOT_NEGATIVE, "dof": POSITIVE}))
_TESTED = Fields({"term": ANY_TEXT, "F": FIGURE, "p": P_VALUE})

CALIBRATION = Fields(
    {
        "multipos_version": ANY_TEXT,
        "created": ANY_TEXT,
        "input": INPUT,
        "convention": Text(("specific-force", "gravity")),
        "gravity": Maybe(Fields({"value": Number(1.0, 100.0), "u": NOT_NEGATIVE})),
        "estimator": Text(tuple(Estimator)),
        "criterion": ANY_TEXT,
        "gauge": Maybe(Text((*GAUGES, *ROLL_GAUGES))),
        "model": ANY_TEXT,
        "outputs": Listed(ANY_TEXT, 1),
        "axes": Listed(AXIS, 1),
        "inputs": Listed(AXIS, 1, len(COMPONENTS)),
        "unit": ANY_TEXT,
        "confidence": SHARE,
        "status": Fields(
            {"converged": Flag(), "iterations": Whole(), "message": ANY_TEXT},
            {"last_step": Maybe(ANY_NUMBER), "gradient": Maybe(ANY_NUMBER)},
        ),
        "positions": Listed(ANY_TEXT, 1),
        "parameters": Listed(
            Fields(
                {
                    "output": ANY_TEXT,
                    "term": ANY_TEXT,
                    "value": ANY_NUMBER,
                    "u": Maybe(NOT_NEGATIVE),
                    "dof": _DOF,
                    "k": Maybe(NOT_NEGATIVE),
                }
            ),
            1,
        ),
        "covariance": VARIANCES,
        "residuals": Numbers(2),
        "residual_sd": Named(Maybe(NOT_NEGATIVE)),
        "dof": Named(_DOF),
        "readings": Numbers(2),
        "reference": Numbers(2),
        "diagnostics": Fields(
            {
                "rank": Whole(),
                "parameters": Whole(),
                "condition": FIGURE,
                "leverage": Numbers(2, gaps=True),
                "lack_of_fit": Named(
                    Fields({"F": FIGURE, "dof": Maybe(Numbers(1)), "p": P_VALUE}),
                ),
                "outliers": TEXTS,
                "unidentifiable": TEXTS,
            },
            {**FINDINGS, "model_tests": MODEL_TESTS, "hidden": TEXTS, "claim": _NOISE_TEST},
        ),
        "cross_check": Maybe(Fields({"closed_form_max_difference": ANY_NUMBER})),
    },
    {
        "reading_u": Numbers(2),
        "reading_dof": Numbers(2),
        "reading_covariance": Numbers(2, low=-LARGEST_SQUARE, high=LARGEST_SQUARE),
        "reading_sd": Numbers(2),
        "samples": Numbers(1),
        "orientation_sd_deg": Numbers(1, gaps=True),
        "group": TEXTS,
        "open_roll": TEXTS,
        "environment": Named(Numbers(1, gaps=True)),
        "attitude": Numbers(3, gaps=True),
        "up": Numbers(2, gaps=True),
        "force": Numbers(2, gaps=True),
        "reference_u": Numbers(2),
        "robust_weight": _BY_POSITION,
        "orientation_error_deg": _BY_POSITION,
        "group_rotation_deg": Named(Listed(ANY_NUMBER, 3, 3)),
        "inclination_deg": Named(ANY_NUMBER),
        "level_sd_deg": NOT_NEGATIVE,
        "level_tilt_deg": Numbers(1),
        "variance_components": Fields(
            {},
            {
                "rest_to_rest": _REST_TO_REST,
                "reading_sd": _COMPONENT,
                "orientation_sd_deg": _ORIENTATION_SPREAD,
                "effective_rows": Named(NOT_NEGATIVE),
            },
        ),
        "facing": Listed(Text(tuple(f"{sign}{axis}" for sign in ("", "-") for axis in COMPONENTS))),
        "selection": Named(
            Fields(
                {
                    "terms": Listed(ANY_TEXT, 1),
                    "path": Listed(_TESTED),
                    "runner_up": Maybe(_TESTED),
                    "collinear": TEXTS,
                }
            )
        ),
        "drift_per": Text(("h", "row")),
        "field": Fields(
            {
                "kind": Text(FIELD_KINDS),
                "size": Maybe(POSITIVE),
                "u": NOT_NEGATIVE,
                "unit": Maybe(Text(MAGNETIC_UNITS)),
            }
        ),
        "nominal": Fields({"bias": ANY_NUMBER, "scale": ANY_NUMBER}),
        "excluded": Listed(Fields({"label": ANY_TEXT, "off": NOT_NEGATIVE, "unit": ANY_TEXT})),
        "sessions": Fields({"runs": Whole(2), "files": TEXTS, "sd": Named(NOT_NEGATIVE)}),
        "budget": Fields(
            {
                "tables": Named(Named(_SETTING)),
                "rows": Listed(Fields({"quantity": ANY_TEXT, "contribution": Named(FIGURE)})),
            },
            {"scatter": VARIANCES},
        ),
        "own_model": Fields(
            {
                "parameters": Named(_QUANTITY),
                "outputs": Named(ANY_TEXT),
                "columns": TEXTS,
                "fixed": Listed(
                    Fields({"output": ANY_TEXT, "name": ANY_TEXT, "value": ANY_NUMBER})
                ),
            }
        ),
        "expression": Fields(
            {
                "functions": Listed(Listed(Listed(AnyOf((ANY_TEXT, ANY_NUMBER)), 2), 1), 1),
                "columns": TEXTS,
                "parameters": Listed(ANY_TEXT, 1),
            }
        ),
    },
)


def calibration_dict(c: Calibration) -> dict[str, Any]:
    """Return everything that a calibration holds as what JSON can carry."""
    readings = c.readings
    content = {
        "schema": SCHEMA,
        "multipos_version": c.version,
        "created": c.created,
        "input": {"file": readings.source, "sha256": readings.sha256},
        "convention": c.convention,
        "gravity": _gravity(c.field),
        **({"field": c.field.to_dict()} if c.field.magnetic else {}),
        "estimator": c.estimator,
        "criterion": c.criterion,
        "gauge": c.model.gauge,
        "model": c.model.text,
        "outputs": c.outputs,
        "axes": c.model.axes,
        "inputs": c.model.inputs,
        "unit": c.model.unit,
        "confidence": c.confidence,
        "status": c.status._asdict(),
        "positions": readings.labels,
        "parameters": [entry._asdict() for entry in c.entries],
        "covariance": c.covariance,
        "residuals": c.residuals,
        "residual_sd": dict(zip(c.outputs, c.residual_sd, strict=True)),
        "dof": dict(zip(c.outputs, c.dof, strict=True)),
        "readings": readings.values,
        "reference": c.reference,
        "reference_environment": dict.fromkeys(c.model.environment, 0.0) or None,
        **_known_of(readings),
        "rms": c.rms,
        "linearity": c.linearity,
        "excluded": [each._asdict() for each in c.excluded],
        "diagnostics": {
            **{key: getattr(c.diagnostics, key) for key in _DIAGNOSTICS},
            "model_tests": [test.to_dict() for test in c.diagnostics.model_tests],
            "claim": c.diagnostics.claim and c.diagnostics.claim._asdict(),
        },
        "cross_check": None
        if c.cross_check is None
        else {"closed_form_max_difference": c.cross_check},
        "intrinsic": c.intrinsic,
        "installation_deg": c.installation_deg,
        **expression_dict(c.model),
        **({} if c.model.drift_per is None else {"drift_per": c.model.drift_per}),
        **_found_dict(c),
        "findings": c.findings,
    }
    result: dict[str, Any] = plain(content)
    return result


def _gravity(field: Field) -> dict[str, float] | None:
    """Return the stated gravity, None where there is none."""
    if field.magnetic or field.size is None:
        return None
    return {"value": field.size, "u": field.u}


def _field(content: Mapping[str, Any]) -> Field:
    """Return the field of a file: gravity where it says nothing of one."""
    gravity, stated = content["gravity"], content.get("field")
    if stated is not None:
        return Field(stated["kind"], stated["size"], stated["u"], stated["unit"] or "uT")
    return Field() if gravity is None else Field(size=gravity["value"], u=gravity["u"])


def _known_of(readings: Readings) -> dict[str, Any]:
    """Return what is known of readings beside their values, as far as it is."""
    known = {
        "reading_u": readings.u,
        "reading_dof": readings.dof,
        "reading_covariance": readings.covariance,
        "reading_sd": readings.sd,
        "samples": readings.samples,
        "orientation_sd_deg": None
        if readings.orientation_sd is None
        else np.degrees(readings.orientation_sd),
        "group": readings.group,
        "open_roll": readings.open_roll,
        "environment": dict(readings.environment) or None,
        "attitude": readings.rotation,
        "up": readings.up,
        "force": readings.force,
        "reference_u": readings.reference_u,
    }
    return _stated(known)


def _found_dict(c: Calibration) -> dict[str, Any]:
    """Return what only some estimators and budgets add."""
    found: dict[str, Any] = {
        "robust_weight": c.robust_weight,
        "selection": c.selection,
        "nominal": None if c.nominal is None else c.nominal._asdict(),
        "facing": c.facing,
        **(c.orientations or {}),
    }
    for name, parts in (
        ("variance_components", c.variance_components),
        ("budget", c.budget),
        ("sessions", c.sessions),
    ):
        if parts is not None:
            found[name] = _stated(parts)
    return _stated(found)


def _stated(parts: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in parts.items() if value is not None}


_SPREAD_LOADING = ("value", "u", "determined")


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
    cross_check = content["cross_check"]
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
    return replace(_model_in_gravity(content), field=_field(content))


def _model_in_gravity(content: Mapping[str, Any]) -> Model:
    if "own_model" in content:
        return load_parsed(content)
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
        if "drift_per" in content:
            model = model.with_drift(content["drift_per"])
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
        findings=read_findings(found),
        model_tests=tuple(map(model_test_from_dict, found.get("model_tests", ()))),
        hidden=tuple(found.get("hidden", ())),
        claim=NoiseTest(claim["chi2"], claim["dof"]) if (claim := found.get("claim")) else None,
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
    found["excluded"] = tuple(Excluded(**each) for each in content.get("excluded", ()))
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
    scatter, reading, spread = (
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
        None
        if spread is None
        else OrientationSpread(**{"determined": True, **_known_keys(spread, _SPREAD_LOADING)}),
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
