"""Calibrations in files: what a calibration file holds, key by key, and its writing.

Its reading is `multipos.sensor.loading`. What a calibration derives again when it is read (its rms,
the labels of its parameters) is not read and not described here; what every key means is in
`docs/reference/formats`.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from multipos.doubt import DOUBTS
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
)
from multipos.numerics.terms import COMPONENTS
from multipos.positions.readings import Readings
from multipos.results import plain
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator
from multipos.sensor.model import GAUGES, ROLL_GAUGES
from multipos.sensor.own_models import expression_dict
from multipos.sensor.term_tests import MODEL_TESTS

SCHEMA = "multipos/calibration/1"
_DIAGNOSTICS = (
    "rank",
    "parameters",
    "condition",
    "lack_of_fit",
    "outliers",
    "unidentifiable",
    "warnings",
    "doubts",
    "hidden",
    "leverage",
)
# Null is infinite, 0 none; less than a millionth of one is neither.
_DOF = Maybe(AnyOf((Number(0.0, 0.0), Number(1e-6))))
_SETTING = AnyOf((ANY_TEXT, Flag(), Listed(Whole()), ANY_NUMBER))  # of a table in a budget

# One number a position, or one an output as well where the outputs were fitted apart.
_BY_POSITION = AnyOf((Numbers(2, gaps=True), Numbers(1, gaps=True)))
_COMPONENT = Fields({"value": POSITIVE, "u": POSITIVE})
_PLACED = Fields({"value": POSITIVE, "u": POSITIVE}, {"determined": Flag()})
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
_CLAIM = Maybe(Fields({"chi2": NOT_NEGATIVE, "dof": POSITIVE}))
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
                "warnings": TEXTS,
            },
            {"doubts": DOUBTS, "model_tests": MODEL_TESTS, "hidden": TEXTS, "claim": _CLAIM},
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
                "orientation_sd_deg": _PLACED,
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
        "nominal": Fields({"bias": ANY_NUMBER, "scale": ANY_NUMBER}),
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
        "gravity": None if c.gravity is None else c.gravity._asdict(),
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
        **_found_dict(c),
    }
    result: dict[str, Any] = plain(content)
    return result


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
    return _told(known)


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
            found[name] = _told(parts)
    return _told(found)


def _told(parts: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in parts.items() if value is not None}
