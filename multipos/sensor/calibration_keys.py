"""What a calibration file has beside the fields of a `Calibration`: keys of its parts.

`OF_PARTS` has each with its path from the calibration and the field that it comes after: what is
known of the readings, the model and its field, and what follows from the rest and is not read.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from multipos.files.records import (
    ANY_NUMBER,
    ANY_TEXT,
    AXIS,
    LARGEST_SQUARE,
    NOT_NEGATIVE,
    TEXTS,
    Fields,
    Kind,
    Listed,
    Maybe,
    Named,
    Number,
    Numbers,
    Text,
)
from multipos.files.schema import As, Stored, also, schema_of
from multipos.files.written_units import MAGNETIC_UNITS
from multipos.numerics.arrays import COMPONENTS, LARGEST, SMALLEST
from multipos.sensor.found import Parameter
from multipos.sensor.gravity import KINDS
from multipos.sensor.model import GAUGES, ROLL_GAUGES


def _after(field: str, key: str = "") -> Stored:
    return Stored(key, after=field)


def _known(attribute: str, kind: Kind, key: str) -> Any:
    """Return what is known of readings beside their values, where it is."""
    return also(f"readings.{attribute}", kind, Stored(key, optional=True, after="reference"))


_GRAVITY = Fields({"value": Number(1.0, 100.0), "u": NOT_NEGATIVE})
_FIELD = Fields(
    {
        "kind": Text(tuple(KINDS)),
        "size": Maybe(Number(SMALLEST)),
        "u": NOT_NEGATIVE,
        "unit": Maybe(Text(MAGNETIC_UNITS)),
    }
)
_QUANTITY = {"start": ANY_NUMBER, "sd": ANY_NUMBER, "unit": ANY_TEXT}
_BOUNDS = {"low": ANY_NUMBER, "high": ANY_NUMBER}
_OWN_MODEL = Fields(
    {
        "parameters": Named(Fields({}, _QUANTITY | _BOUNDS)),
        "outputs": Named(ANY_TEXT),
        "columns": TEXTS,
        "fixed": Listed(Fields({"output": ANY_TEXT, "name": ANY_TEXT, "value": ANY_NUMBER})),
    }
)
_PER = Text(("h", "row"))
_TAU = Fields({"value": Number(SMALLEST), "u": NOT_NEGATIVE, "unit": Text(("s", "row"))})
_DRIFT = Fields({"kind": Text(("linear", "exponential")), "tau": Maybe(_TAU)})
_PARAMETERS = Listed(replace(schema_of(Parameter), made=dict), 1)
_TABLE = Numbers(2)
_GAPS = Numbers(2, gaps=True)
_COLUMN = Numbers(1, gaps=True, low=-LARGEST, high=LARGEST)
_SQUARES = Numbers(2, low=-LARGEST_SQUARE, high=LARGEST_SQUARE)
_DEGREES = As(Numbers(1, gaps=True), np.radians, np.degrees)
# What the file has of the parts of a calibration, each after a field.
OF_PARTS = (
    also("readings.source", Maybe(ANY_TEXT), _after("created", "input.file")),
    also("readings.sha256", Maybe(ANY_TEXT), _after("created", "input.sha256")),
    also("field.of_gravity", Maybe(_GRAVITY), _after("convention", "gravity")),
    also("field.of_field", _FIELD, Stored("field", optional=True, after="convention")),
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
    _known("u", _TABLE, "reading_u"),
    _known("dof", _TABLE, "reading_dof"),
    _known("covariance", _SQUARES, "reading_covariance"),
    _known("sd", _TABLE, "reading_sd"),
    _known("samples", Numbers(), "samples"),
    _known("group", TEXTS, "group"),
    _known("open_roll", TEXTS, "open_roll"),
    _known("rotation", Numbers(3, gaps=True), "attitude"),
    _known("up", _GAPS, "up"),
    _known("force", _GAPS, "force"),
    _known("reference_u", _TABLE, "reference_u"),
    _known("orientation_sd", _DEGREES, "orientation_sd_deg"),
    _known("environment", Named(_COLUMN), "environment"),
    also("rms", _after("reference")),
    also("linearity", _after("reference")),
    also("intrinsic", _after("cross_check")),
    also("installation_deg", _after("cross_check")),
    also("model.own_formulas", _OWN_MODEL, Stored("own_model", optional=True, after="cross_check")),
    also("model.drift_per", _PER, Stored("drift_per", optional=True, after="cross_check")),
    also("model.drift", _DRIFT, Stored("drift", optional=True, after="cross_check")),
    also("findings", _after("orientations")),
)
