"""A result's file is what its fields declare: written, checked and read by them alone."""

import json
import math
from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from multipos.errors import MultiposError
from multipos.files.records import (
    ANY_NUMBER,
    DOF,
    NOT_NEGATIVE,
    Flag,
    Maybe,
    NotNegative,
    Numbers,
    Whole,
)
from multipos.files.schema import As, Saved, Stored, also, read_saved, renamed, restore, schema_of
from multipos.files.trees import to_json
from multipos.numerics.arrays import Array, Mask
from multipos.results import Result, frozen


class Kind(StrEnum):
    A = "a"
    B = "b-c"


@frozen
class Value(Result):
    value: float
    u: NotNegative
    dof: Annotated[float, Maybe(DOF, math.inf)]


class Row(NamedTuple):
    label: str
    off: NotNegative
    pair: tuple[int, float] = (0, 0.0)


@frozen
class Tilt(Result):
    tilt_deg: Annotated[Array, As(Numbers(), np.radians, np.degrees), Stored("tilt")]
    level: float | None = None


_TABLE = Stored(rows="table", by="axes")


@frozen
class Composed(Saved):
    schema = "multipos/whole/1"
    called = "whole"
    again = "do it again"
    _also = (also("size", Stored(after="way")),)

    axes: tuple[str, ...]
    kind: Kind
    way: Literal["up", "down"]
    source: Annotated[str | None, Stored("input.file")]
    sha256: Annotated[str | None, Stored("input.sha256")]
    check: Annotated[float | None, Stored("cross.difference", optional=True)]
    by_name: Mapping[str, Value]
    flat: Annotated[Tilt | None, Stored(flat=True)]
    other: Annotated[Value, renamed(Value, value="o", u="o_u", dof="o_dof"), Stored(flat=True)]
    sd: Annotated[Array, NOT_NEGATIVE, Stored(by="axes")]
    labels: Annotated[tuple[str, ...], Stored("label", rows="table")]
    error: Annotated[Array, Maybe(ANY_NUMBER, math.nan), _TABLE]
    counted: Annotated[Mask, Flag(), _TABLE]
    rows: tuple[Row, ...] = ()
    weight: Annotated[Array | None, Stored(optional=True)] = None
    made: Annotated[Any, Stored(nowhere=True)] = None

    @property
    def size(self):
        """What the file says for its reader."""
        return len(self.axes)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind == Kind.B and self.check is None:
            raise ValueError("b-c needs a check.")


def whole(**change):
    values = {
        "axes": ("x", "y"),
        "kind": Kind.B,
        "way": "up",
        "source": "r.csv",
        "sha256": None,
        "check": 0.5,
        "by_name": {"a": Value(1.0, 0.1, math.inf)},
        "flat": Tilt(np.radians([30.0, 60.0])),
        "other": Value(2.0, 0.0, 4.0),
        "sd": np.array([1.0, 2.0]),
        "labels": ("p", "q"),
        "error": np.array([[1.0, np.nan], [3.0, 4.0]]),
        "counted": np.array([[True, False], [True, True]]),
        "rows": (Row("r", 1.5, (2, 0.5)),),
        "weight": np.array([1.0]),
    }
    return Composed(**(values | change))


WRITTEN = {
    "schema": "multipos/whole/1",
    "axes": ["x", "y"],
    "kind": "b-c",
    "way": "up",
    "size": 2,
    "input": {"file": "r.csv", "sha256": None},
    "cross": {"difference": 0.5},
    "by_name": {"a": {"value": 1.0, "u": 0.1, "dof": None}},
    "tilt": [30.0, 60.0],
    "level": None,
    "o": 2.0,
    "o_u": 0.0,
    "o_dof": 4.0,
    "sd": {"x": 1.0, "y": 2.0},
    "table": [
        {"label": "p", "error": {"x": 1.0, "y": None}, "counted": {"x": True, "y": False}},
        {"label": "q", "error": {"x": 3.0, "y": 4.0}, "counted": {"x": True, "y": True}},
    ],
    "rows": [{"label": "r", "off": 1.5, "pair": [2, 0.5]}],
    "weight": [1.0],
}


def test_a_file_is_its_fields_in_their_order():
    content = json.loads(to_json(whole().to_dict()))
    content["tilt"] = np.round(content["tilt"], 12).tolist()
    assert list(content.items()) == list(WRITTEN.items())
    bare = whole(kind=Kind.A, check=None, flat=None, weight=None).to_dict()
    assert bare["cross"] is None
    assert bare.keys().isdisjoint({"tilt", "level", "weight", "made"})


@pytest.mark.parametrize("change", [{}, {"kind": Kind.A, "check": None, "flat": None, "rows": ()}])
def test_what_was_written_is_read_again(change, tmp_path):
    before = whole(weight=None, **change)
    before.save(tmp_path / "w.json")
    after = read_saved(Composed, tmp_path / "w.json")
    assert after == before
    assert isinstance(after.kind, Kind)
    assert not after.error.flags.writeable
    assert_array_equal(after.sd, [1.0, 2.0])


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (["kind"], "c", "w.json: kind is 'c'; one of a, b-c is needed there; the file is damaged"),
        (["way"], None, "way is null; one of up, down is needed"),
        (["input", "file"], 3, "input.file is 3; a text is needed"),
        (["by_name", "a", "u"], -1.0, "by_name.a.u is -1.0; a number of at least 0"),
        (["tilt"], [[1.0]], "tilt[0] is a list of 1; a number is needed"),
        (["o_dof"], 0.0, "o_dof is 0.0; a number of at least 1e-06"),
        (["sd"], [1.0, 2.0], "sd is a list of 2; an object is needed"),
        (["table", 1, "counted", "y"], 1, "table[1].counted.y is 1; true or false is needed"),
        (["table"], [], "table is a list of 0; a list of at least 1"),
        (["rows", 0, "pair"], [2.0, 0.5], "rows[0].pair[0] is 2.0; a whole number from 0"),
        (["rows", 0], {}, "the key 'rows[0].label' is missing"),
        (["sd"], {"x": 1.0, "z": 1.0}, "not a whole: 'sd' is of x, z, not of its axes; do it"),
        (["cross"], None, "w.json: not a whole: b-c needs a check; do it again."),
    ],
)
def test_what_is_amiss_is_named_by_file_and_key(place, value, message):
    content = json.loads(to_json(whole().to_dict()))
    inner = content
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    with pytest.raises(MultiposError) as error:
        restore(Composed, content, "w.json")
    assert message in str(error.value)


def test_a_column_that_a_row_lacks_is_as_by_default():
    @frozen
    class Columned(Result):
        n: Annotated[Array, Whole(), Stored(rows="t")]
        u: Annotated[Array | None, NOT_NEGATIVE, Stored(rows="t", optional=True)]

    schema = schema_of(Columned)
    assert schema.write(Columned(np.array([1, 2]), None)) == {"t": [{"n": 1}, {"n": 2}]}
    read = schema.read({"t": [{"n": 1, "u": 0.5}, {"n": 2}]})
    assert read.u is None
    assert_array_equal(read.n, [1, 2])
