"""What a calibration file has beside the fields of a `Calibration`: keys of its parts.

`OF_PARTS` has each with its path from the calibration and the field that it comes after: what is
known of the readings, the model and its field, and what follows from the rest and is not read.
"""

from dataclasses import replace

import numpy as np

from multipos.files.records import (
    ANY_NUMBER,
    ANY_TEXT,
    AXIS,
    LARGEST_SQUARE,
    NOT_NEGATIVE,
    TEXTS,
    Fields,
    Listed,
    Maybe,
    Named,
    Number,
    Numbers,
    Text,
)
from multipos.files.schema import As, Stored, also, schema_of
from multipos.numerics.arrays import COMPONENTS, SMALLEST
from multipos.positions.headers import MAGNETIC_UNITS
from multipos.sensor.found import Parameter
from multipos.sensor.gravity import KINDS
from multipos.sensor.model import GAUGES, ROLL_GAUGES


def _after(field: str, key: str = "", *, optional: bool = False) -> Stored:
    return Stored(key, optional=optional, after=field)


_GRAVITY = Fields({"value": Number(1.0, 100.0), "u": NOT_NEGATIVE})
_FIELD = Fields(
    {
        "kind": Text(tuple(KINDS)),
        "size": Maybe(Number(SMALLEST)),
        "u": NOT_NEGATIVE,
        "unit": Maybe(Text(MAGNETIC_UNITS)),
    }
)
_OWN_MODEL = Fields(
    {
        "parameters": Named(
            Fields(
                {},
                {
                    "start": ANY_NUMBER,
                    "sd": ANY_NUMBER,
                    "unit": ANY_TEXT,
                    "low": ANY_NUMBER,
                    "high": ANY_NUMBER,
                },
            )
        ),
        "outputs": Named(ANY_TEXT),
        "columns": TEXTS,
        "fixed": Listed(Fields({"output": ANY_TEXT, "name": ANY_TEXT, "value": ANY_NUMBER})),
    }
)
_PARAMETERS = Listed(replace(schema_of(Parameter), made=dict), 1)
_TABLE = Numbers(2)
_GAPS = Numbers(2, gaps=True)
_SQUARES = Numbers(2, low=-LARGEST_SQUARE, high=LARGEST_SQUARE)
_DEGREES = As(Numbers(1, gaps=True), np.radians, np.degrees)
# What the file has of the parts of a calibration, each after a field.
OF_PARTS = (
    also("readings.source", Maybe(ANY_TEXT), _after("created", "input.file")),
    also("readings.sha256", Maybe(ANY_TEXT), _after("created", "input.sha256")),
    also("field.of_gravity", Maybe(_GRAVITY), _after("convention", "gravity")),
    also("field.of_field", _FIELD, _after("convention", "field", optional=True)),
    also("model.gauge", Maybe(Text((*GAUGES, *ROLL_GAUGES))), _after("criterion", "gauge")),
    also("model.text", ANY_TEXT, _after("criterion", "model")),
    also("model.outputs", Listed(ANY_TEXT, 1), _after("criterion", "outputs")),
    also("model.axes", Listed(AXIS, 1), _after("criterion", "axes")),
    also("model.inputs", Listed(AXIS, 1, len(COMPONENTS)), _after("criterion", "inputs")),
    also("model.unit", ANY_TEXT, _after("criterion", "unit")),
    also("readings.labels", Listed(ANY_TEXT, 1), _after("status", "positions")),
    also("entries", _PARAMETERS, _after("status", "parameters")),
    also("readings.values", _TABLE, _after("dof", "readings")),
    also("_reference_environment", _after("reference", "reference_environment")),
    also("readings.u", _TABLE, _after("reference", "reading_u", optional=True)),
    also("readings.dof", _TABLE, _after("reference", "reading_dof", optional=True)),
    also("readings.covariance", _SQUARES, _after("reference", "reading_covariance", optional=True)),
    also("readings.sd", _TABLE, _after("reference", "reading_sd", optional=True)),
    also("readings.samples", Numbers(), _after("reference", "samples", optional=True)),
    also("readings.group", TEXTS, _after("reference", "group", optional=True)),
    also("readings.open_roll", TEXTS, _after("reference", "open_roll", optional=True)),
    also("readings.rotation", Numbers(3, True), _after("reference", "attitude", optional=True)),
    also("readings.up", _GAPS, _after("reference", "up", optional=True)),
    also("readings.force", _GAPS, _after("reference", "force", optional=True)),
    also("readings.reference_u", _TABLE, _after("reference", "reference_u", optional=True)),
    also(
        "readings.orientation_sd",
        _DEGREES,
        _after("reference", "orientation_sd_deg", optional=True),
    ),
    also(
        "readings.environment",
        Named(Numbers(1, gaps=True)),
        _after("reference", "environment", optional=True),
    ),
    also("rms", _after("reference")),
    also("linearity", _after("reference")),
    also("intrinsic", _after("cross_check")),
    also("installation_deg", _after("cross_check")),
    also("model.own_formulas", _OWN_MODEL, _after("cross_check", "own_model", optional=True)),
    also("model.drift_per", Text(("h", "row")), _after("cross_check", "drift_per", optional=True)),
    also("findings", _after("orientations")),
)
