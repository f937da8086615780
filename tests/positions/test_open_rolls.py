"""Rolls of open angle as tables say them, and what is refused of them."""

import numpy as np
import pytest
from findings_bench import texts

import multipos as mp
from multipos.errors import MultiposError
from multipos.positions.orientations import place
from multipos.positions.reading_tables import read_readings

OUTPUTS = {"ax": [0.1, 0.2, 0.3], "ay": [1.0, 0.0, -1.0], "az": [0.0, 1.0, 0.1]}


def test_a_roll_without_its_angle_is_open_whether_the_column_stands_or_not():
    alone = read_readings({"roll_axis": ["x", "x", "y"], **OUTPUTS})
    empty = read_readings({"roll_axis": ["x", "x", "y"], "angle_deg": ["", "90", ""], **OUTPUTS})
    assert alone.open_roll == ("x", "x", "y")
    assert empty.open_roll == ("x", "", "y")
    assert np.isnan(empty.up[[0, 2]]).all()
    np.testing.assert_array_equal(empty.up[1], [0, 0, 1])
    assert any("roll angles of row 1, 3 are estimated" in note for note in texts(empty))
    assert (
        read_readings({"roll_axis": ["x"] * 3, "angle_deg": [0, 1, 2], **OUTPUTS}).open_roll is None
    )


def test_a_column_that_is_an_output_is_no_roll():
    readings = read_readings({"roll_axis": [1.0, 2.0, 3.0], **OUTPUTS}, outputs="roll_axis,ay,az")
    assert readings.open_roll is None


def test_what_is_known_of_the_axis_is_placed():
    table = {"roll_axis": ["x", "x", "z"], "group": ["a", "a", ""], **OUTPUTS}
    placed = place(read_readings(table), -1.0)
    assert placed.rolls.axis.tolist() == [0, 0, 2]
    assert placed.rolls.cone.tolist() == [0, 0, -1]
    assert placed.groups == 0
    assert not placed.exact
    assert not placed.unknown
    # anywhere on the circle, of the sign of the convention
    np.testing.assert_array_equal(placed.reference, [[0, -1, 0], [0, -1, 0], [-1, 0, 0]])
    assert not placed.listed.any()


def test_an_axis_that_is_unknown_too_is_an_unknown_position():
    table = {"roll_axis": ["x"] * 3, "orientation_sd_deg": ["", "0", "2"], **OUTPUTS}
    placed = place(read_readings(table), 1.0)
    assert np.isinf(placed.orientation_sd[0])
    assert placed.rolls.axis.tolist() == [-1, 0, 0]


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"roll_axis": ["x", "y", "x"], "group": ["a", "a", ""]}, "group 'a' has rolls of open"),
        (
            {"roll_axis": ["x", "x", "x"], "angle_deg": ["", "9", ""], "group": ["a", "a", ""]},
            "position '2': group 'a' has rolls of open angle about one axis and other",
        ),
        ({"roll_axis": ["q", "x", "x"]}, "'q' is not an axis"),
        (
            {"roll_axis": ["x"] * 3, "f_x": [1, "", ""], "f_y": [0, "", ""], "f_z": [0, "", ""]},
            "the row states a force and a roll",
        ),
    ],
)
def test_a_contradiction_is_refused_by_name(columns, message):
    with pytest.raises(MultiposError, match=message):
        mp.fit({**columns, **OUTPUTS})


def test_known_positions_are_asked_for_where_they_are_needed():
    up = mp.read_scheme("faces-6").up
    cal = mp.fit(dict(zip(("ax", "ay", "az"), up.T, strict=True)), scheme="faces-6")
    rolled = {"roll_axis": ["x"] * 3, **OUTPUTS}
    for judge in (lambda: mp.check(cal, rolled), lambda: mp.tumble(rolled)):
        with pytest.raises(MultiposError, match="position '1' is a roll of open angle"):
            judge()
    with pytest.raises(MultiposError, match="open_roll` is x, y, z"):
        mp.Readings(values=np.ones((1, 3)), open_roll=("q",))
    with pytest.raises(MultiposError, match="rolls of open angle"):
        mp.fit(rolled, closed_form=True)
