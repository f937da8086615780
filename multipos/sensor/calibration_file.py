"""Calibrations in files: what a calibration file holds, key by key, its writing and its reading.

What a calibration derives again when it is read (its rms, the labels of its parameters) is not read
and not described here; what every key means is in `docs/reference/formats`.

A file is held to its description first, so that what is read is of the right kind; then its lists
to one another's sizes, and in the end what it says to what follows from it.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.files.records import (
    ANY_NUMBER,
    ANY_TEXT,
    AXIS,
    DOF,
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
    Kind,
    Listed,
    Maybe,
    Named,
    Number,
    Numbers,
    Record,
    Text,
    Whole,
    require,
    require_covariance,
)
from multipos.files.spelling import StrPath
from multipos.files.trees import read_json
from multipos.finding import FINDINGS, findings_upgraded, read_findings
from multipos.numerics.arrays import COMPONENTS, LARGEST, SMALLEST, Array
from multipos.numerics.rotations import directions
from multipos.positions.headers import MAGNETIC_UNITS, known_rows
from multipos.positions.readings import Readings
from multipos.results import plain_dict
from multipos.sensor import fit_diagnostics, inverse
from multipos.sensor.calibration import Calibration, Status
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.found import (
    Chosen,
    Component,
    Estimator,
    Excluded,
    FoundOrientations,
    OrientationSpread,
    RestToRest,
    StatedBudget,
    VarianceComponents,
)
from multipos.sensor.gravity import KINDS, field_of_file
from multipos.sensor.model import GAUGES, ROLL_GAUGES, Model, build_model
from multipos.sensor.own_models import expression_dict, load_parsed

SCHEMA = "multipos/calibration/1"
# Null is infinite, 0 none; less than a millionth of one is neither.
_DOF = Maybe(AnyOf((Number(0.0, 0.0), DOF)), math.inf)
_SETTING = AnyOf((ANY_TEXT, Flag(), Listed(Whole()), ANY_NUMBER))  # of a table in a budget

# One number a position, or one an output as well where the outputs were fitted apart.
_BY_POSITION = AnyOf((Numbers(2, gaps=True), Numbers(1, gaps=True)))
_COMPONENTS = Record.of(
    VarianceComponents,
    {
        "rest_to_rest": Named(
            Record.of(RestToRest, {"value": NOT_NEGATIVE, "u": NOT_NEGATIVE, "dof": _DOF})
        ),
        "reading_sd": Record.of(Component, {"value": POSITIVE, "u": POSITIVE}),
        "orientation_sd_deg": Record(
            {"value": POSITIVE, "u": POSITIVE},
            {"determined": Flag()},  # not in files of version 0.1
            make=partial(OrientationSpread, determined=True),
        ),
        "effective_rows": Named(NOT_NEGATIVE),
    },
    optional=VarianceComponents.__dataclass_fields__,
)
_STATUS = Record.of(
    Status,
    {"last_step": Maybe(ANY_NUMBER), "gradient": Maybe(ANY_NUMBER)},
    optional=("last_step", "gradient"),
)
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
_TESTED = Fields({"term": ANY_TEXT, "F": FIGURE, "p": P_VALUE})
_DIAGNOSTICS = Record(
    {
        "rank": Whole(),
        "parameters": Whole(),
        "condition": FIGURE,
        "leverage": Numbers(2, gaps=True),
        "lack_of_fit": Named(Fields({"F": FIGURE, "dof": Maybe(Numbers(1)), "p": P_VALUE})),
        "outliers": TEXTS,
        "unidentifiable": TEXTS,
    },
    {
        "hidden": TEXTS,
        "claim": Maybe(Record({"chi2": NOT_NEGATIVE, "dof": DOF}, make=fit_diagnostics.NoiseTest)),
    },
)
# What is known of the readings beside their values, each with what it is called in `Readings` and
# its shape for n readings of m outputs.
_OF_READINGS: dict[str, tuple[Kind, str, str]] = {
    "reading_u": (Numbers(2), "u", "nm"),
    "reading_dof": (Numbers(2), "dof", "nm"),
    "reading_covariance": (
        Numbers(2, low=-LARGEST_SQUARE, high=LARGEST_SQUARE),
        "covariance",
        "kk",
    ),
    "reading_sd": (Numbers(2), "sd", "nm"),
    "samples": (Numbers(1), "samples", "n"),
    "group": (TEXTS, "group", "n"),
    "open_roll": (TEXTS, "open_roll", "n"),
    "attitude": (Numbers(3, gaps=True), "rotation", "n33"),
    "up": (Numbers(2, gaps=True), "up", "n3"),
    "force": (Numbers(2, gaps=True), "force", "n3"),
    "reference_u": (Numbers(2), "reference_u", "n3"),
}
_KNOWN = Record(
    {},
    {key: kind for key, (kind, _, _) in _OF_READINGS.items()},
    names={key: name for key, (_, name, _) in _OF_READINGS.items()},
)
_ORIENTATIONS = Record.of(
    FoundOrientations,
    {"orientation_error_deg": _BY_POSITION, "level_sd_deg": NOT_NEGATIVE},
    optional=FoundOrientations.__dataclass_fields__,
)
_CHOSEN = Record.of(
    Chosen, {"terms": Listed(ANY_TEXT, 1), "path": Listed(_TESTED), "runner_up": Maybe(_TESTED)}
)
# What only some estimators, options and budgets add.
_ADDED = Record(
    {},
    {
        "robust_weight": _BY_POSITION,
        "variance_components": _COMPONENTS,
        "facing": Listed(Text(tuple(f"{sign}{axis}" for sign in ("", "-") for axis in COMPONENTS))),
        "selection": Named(_CHOSEN),
        "nominal": Record(
            {"bias": ANY_NUMBER, "scale": ANY_NUMBER},
            make=lambda bias, scale: inverse.read_nominal((bias, scale)),
        ),
        "excluded": Listed(Record.of(Excluded, {"off": NOT_NEGATIVE})),
        "budget": Record(
            {
                "tables": Named(Named(_SETTING)),
                "rows": Listed(Fields({"quantity": ANY_TEXT, "contribution": Named(FIGURE)})),
            },
            {"scatter": VARIANCES},
            make=StatedBudget,
        ),
    },
)
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
        "status": _STATUS,
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
        "reference": Numbers(2, low=-LARGEST, high=LARGEST),
        "diagnostics": Fields(
            _DIAGNOSTICS.needed,
            {**FINDINGS, **_DIAGNOSTICS.optional, "model_tests": fit_diagnostics.MODEL_TESTS},
        ),
        "cross_check": Maybe(Fields({"closed_form_max_difference": ANY_NUMBER})),
    },
    {
        **_KNOWN.optional,
        **_ORIENTATIONS.optional,
        **_ADDED.optional,
        "orientation_sd_deg": Numbers(1, gaps=True),
        "environment": Named(Numbers(1, gaps=True, low=-LARGEST, high=LARGEST)),
        "drift_per": Text(("h", "row")),
        "field": Fields(
            {
                "kind": Text(tuple(KINDS)),
                "size": Maybe(Number(SMALLEST)),
                "u": NOT_NEGATIVE,
                "unit": Maybe(Text(MAGNETIC_UNITS)),
            }
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
        **c.field.to_dict(),
        "estimator": c.estimator,
        "criterion": c.criterion,
        "gauge": c.model.gauge,
        "model": c.model.text,
        "outputs": c.outputs,
        "axes": c.model.axes,
        "inputs": c.model.inputs,
        "unit": c.model.unit,
        "confidence": c.confidence,
        "status": _STATUS.write(c.status),
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
        "diagnostics": {
            **_DIAGNOSTICS.write(c.diagnostics),
            "findings": c.diagnostics.findings,
            "model_tests": [test.to_dict() for test in c.diagnostics.model_tests],
        },
        "cross_check": None
        if c.cross_check is None
        else {"closed_form_max_difference": c.cross_check},
        "intrinsic": c.intrinsic,
        "installation_deg": c.installation_deg,
        **(expression_dict(c.model) if isinstance(c.model, ExpressionModel) else {}),
        **({} if c.model.drift_per is None else {"drift_per": c.model.drift_per}),
        **_ADDED.write(c),
        **({} if c.orientations is None else _ORIENTATIONS.write(c.orientations)),
        "findings": c.findings,
    }
    return plain_dict(content)


def _known_of(readings: Readings) -> dict[str, Any]:
    """Return what is known of readings beside their values, as far as it is."""
    sd = readings.orientation_sd
    return {
        **_KNOWN.write(readings),
        **({} if sd is None else {"orientation_sd_deg": np.degrees(sd)}),
        **({"environment": dict(readings.environment)} if readings.environment else {}),
    }


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
    return from_dict(read_json(path, SCHEMA), str(path))


def from_dict(content: Mapping[str, Any], where: str = "the calibration") -> Calibration:
    """Return the calibration that `Calibration.to_dict` described.

    Raises
    ------
    MultiposError
        A key is missing or not as `CALIBRATION` has it, the parts contradict each other, or the
        model is a Python function.
    """
    if "expression" in content:  # written by version 0.1 or 0.2
        raise MultiposError(
            f"{where}: its model is a Python function, which is no longer read; fit again with "
            "the model as a formula, such as --model 'each = b + s*own'."
        )
    content = {**content, "diagnostics": findings_upgraded(content.get("diagnostics"))}
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
    model = replace(_model(content), field=field_of_file(content))
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
        residual_sd=_sds([content["residual_sd"][output] for output in outputs]),
        reference=_numbers(content["reference"]),
        readings=_readings(content, model),
        convention=content["convention"],
        estimator=Estimator(content["estimator"]),
        criterion=content["criterion"],
        confidence=float(content["confidence"]),
        diagnostics=_diagnostics(content["diagnostics"]),
        status=_STATUS.read(content["status"]),
        created=content["created"],
        version=content["multipos_version"],
        cross_check=None
        if cross_check is None
        else float(cross_check["closed_form_max_difference"]),
        orientations=_ORIENTATIONS.read(content)
        if _ORIENTATIONS.optional.keys() & content
        else None,
        **_ADDED.read(content),
    )


def _model(content: Mapping[str, Any]) -> Model:
    if "own_model" in content:
        return load_parsed(content)
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
    reference, known = _numbers(content["reference"]), _KNOWN.read(content)
    size = np.linalg.norm(reference, axis=1)
    force = known.get("force")
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
        up=known.pop("up", up),
        orientation_sd=None if sd_deg is None else np.radians(_numbers(sd_deg)),
        environment={
            name: _numbers(column) for name, column in content.get("environment", {}).items()
        },
        unit=model.unit,
        source=content["input"]["file"],
        sha256=content["input"]["sha256"],
        **known,
    )


def _diagnostics(found: Mapping[str, Any]) -> fit_diagnostics.Diagnostics:
    return fit_diagnostics.Diagnostics(
        **_DIAGNOSTICS.read(found),
        findings=read_findings(found),
        model_tests=tuple(map(fit_diagnostics.model_test_from_dict, found.get("model_tests", ()))),
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
    sizes = {"n": n, "m": m, "k": n * m, "3": 3}
    known: dict[str, tuple[int, ...]] = {
        "covariance": (p, p),
        "readings": (n, m),
        "residuals": (n, m),
        "reference": (n, 3),
        "positions": (n,),
        "orientation_sd_deg": (n,),
        **{key: tuple(sizes[d] for d in dims) for key, (_, _, dims) in _OF_READINGS.items()},
    }
    yield from ((key, c[key], shape) for key, shape in known.items() if key in c)
    yield "diagnostics.leverage", c["diagnostics"]["leverage"], (n, m)
    for name, column in c.get("environment", {}).items():
        yield f"environment.{name}", column, (n,)
    for name, vector in c.get("group_rotation_deg", {}).items():
        yield f"group_rotation_deg.{name}", vector, (3,)
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
    scatter = None if c.budget is None else c.budget.scatter
    if scatter is not None and (np.diag(scatter) < 0.0).any():
        raise ValueError("its budget has a variance below zero")


def _numbers(value: Any) -> Any:
    """Return nested lists as an array, null as NaN; None stays None."""
    return None if value is None else np.array(value, dtype=np.float64)


def _sds(values: list[float | None]) -> Array:
    """Return standard deviations, null as NaN; what is too small to divide by is 0."""
    sds = np.array(values, dtype=np.float64)
    return np.where(sds < SMALLEST, 0.0, sds)


def _dof(values: list[float | None], parameters: list[dict[str, Any]] | None = None) -> Array:
    """Return degrees of freedom; null is infinite where there is a k, else unknown."""
    dof = [np.inf if value is None else value for value in values]
    if parameters is not None:
        dof = [
            0.0 if entry["k"] is None else value
            for entry, value in zip(parameters, dof, strict=True)
        ]
    return np.array(dof, dtype=np.float64)
