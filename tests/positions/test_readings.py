"""Readings: which columns are what, how positions meet their scheme, and what is refused."""

import numpy as np
import pandas as pd
import pytest
from findings_bench import texts
from numpy.testing import assert_allclose, assert_array_equal

from multipos import Readings, fit, read_readings
from multipos.errors import MultiposError, UsageError
from multipos.positions.orientations import orient
from multipos.positions.scheme import read_scheme

UP = {"up_x": [0, 0, 1], "up_y": [0, 1, 0], "up_z": [1, 0, 0]}


def test_every_column_has_its_meaning():
    found = read_readings(
        {
            "position": ["a", "b", "b"],
            **UP,
            "ax": [1.0, 2.0, 3.0],
            "ay": [4.0, 5.0, 6.0],
            "u_ax": [0.1, 0.1, 0.2],
            "u_ay": [0.3, 0.3, 0.3],
            "sd_ax": [1, 0, 1],
            "sd_ay": [1, 1, 1],
            "n": [100, 100, 200],
            "orientation_sd_deg": [0, 0.5, ""],
            "group": ["g", "g", ""],
            "temperature": [20, 21, 22],
            "time": [0, 60, 120],
            "ambient_pressure": [1013, 1013, 1012],
            "yaw_rate": [0, 0, 0.1],
        }
    )
    assert found.outputs == ("ax", "ay")
    assert found.positions == ("a", "b", "b")
    assert_array_equal(found.values, [[1, 4], [2, 5], [3, 6]])
    assert_array_equal(found.u, [[0.1, 0.3], [0.1, 0.3], [0.2, 0.3]])
    assert_array_equal(found.sd, [[1, 1], [0, 1], [1, 1]])
    assert_array_equal(found.samples, [100, 100, 200])
    assert_allclose(found.orientation_sd, np.radians([0, 0.5, np.inf]))
    assert found.group == ("g", "g", "")
    assert set(found.environment) == {"temperature", "time", "ambient_pressure", "yaw_rate"}
    assert_array_equal(found.up, [[0, 0, 1], [0, 1, 0], [1, 0, 0]])
    assert texts(found) == ()
    assert len(found) == 3
    for array in (found.values, found.u, found.up, found.environment["time"]):
        assert not array.flags.writeable


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ax": [1.0, -1e308, 3.0]}, "row 2, column 'ax': -1e\\+308 is no number that is measured"),
        ({"u_ax": [0.1, 0.1, 1e-300]}, "row 3, column 'u_ax': 1e-300 is no number"),
        ({"u_ax": [0.1, 1e155, 0.1]}, "row 2, column 'u_ax': 1e\\+155 is no number"),
        ({"sd_ax": [1e300, 0.0, 0.0]}, "row 1, column 'sd_ax': 1e\\+300 is no number"),
        ({"ax": [0.0, 1e-310, 2e-310]}, "column 'ax' is 2e-310 at most, too small a number"),
        ({"orientation_sd_deg": [0, "", 1e155]}, "row 3: an orientation sd of 1e\\+155 degrees"),
        ({"orientation_sd_deg": [0, 180, ""]}, "row 2: an orientation sd of 180 degrees"),
    ],
)
def test_numbers_that_cannot_be_squared_are_refused(change, message):
    columns = {"ax": [1.0, 0.0, 1e-320], "u_ax": [0.1] * 3, "sd_ax": [0.0, 1.0, 1e-320]}
    assert len(read_readings(columns)) == 3
    with pytest.raises(MultiposError, match=message):
        read_readings(columns | change)


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_any_number_of_outputs(count):
    columns = {f"v{i}": [1.0, 2.0] for i in range(count)}
    assert read_readings(columns).outputs == tuple(columns)


def test_outputs_may_be_named_and_the_rest_is_said():
    columns = {"ax": [1.0], "ay": [2.0], "u_ax": [0.1], "u_ay": [0.1], "note": ["ok"]}
    for outputs in ("ay", ["ay"], ("ay",), " ay "):
        found = read_readings(columns, outputs=outputs)
        assert found.outputs == ("ay",)
        assert_array_equal(found.u, [[0.1]])
    assert texts(found) == (
        "column 'ax' is not among the outputs and is not used",
        "column 'note' is not among the outputs and is not used",
        "column 'u_ax' belongs to no output and is not used",
    )
    assert texts(read_readings(columns)) == ("column 'note' holds text and is not used",)


def test_a_column_of_the_formula_is_no_output():
    columns = {"ax": [1.0, 2.0], "pressure": [3.0, 4.0]}
    found = read_readings(columns, environment=["pressure"])
    assert found.outputs == ("ax",)
    assert_array_equal(found.environment["pressure"], [3, 4])
    again = read_readings(read_readings(columns), environment=["pressure"])
    assert again.outputs == ("ax",)
    assert_array_equal(again.environment["pressure"], [3, 4])


def test_a_bad_cell_hurts_only_where_it_is_used():
    columns = {"ax": [1.0, 2.0], "time": ["9:00", "9:05"], "temperature": ["", "20"]}
    found = read_readings(columns)
    assert list(found.environment) == ["temperature"]
    assert texts(found)[0].startswith("column 'time' is not used: ")
    broken = {"ax": [1.0, 2.0], "ambient_pressure": [1e200, 1.0]}
    assert "1e+200 is no number that is measured" in texts(read_readings(broken))[0]
    with pytest.raises(MultiposError, match="row 1, column 'time': '9:00' is not a number"):
        read_readings(columns, environment=["time"])
    with pytest.raises(MultiposError, match="row 1, column 'temperature': the cell is empty"):
        read_readings(columns, environment=["temperature"])


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"ax": [1.0, "x"]}, "row 2, column 'ax': 'x' is not a number"),
        ({"ax": [1.0, np.nan]}, "row 2, column 'ax': 'nan' is not finite"),
        ({"ax": [1.0, ""]}, "row 2, column 'ax': the cell is empty"),
        ({"ax": [1, 2], "u_ax": [0.1, 0]}, "row 2, column 'u_ax': 0 is not above 0"),
        ({"ax": [1, 2], "sd_ax": [0, -1]}, "row 2, column 'sd_ax': -1 is not 0 or more"),
        ({"ax": [1, 2], "n": [10, 0]}, "row 2, column 'n': 0 is not above 0"),
        ({"ax": [1, 2], "orientation_sd_deg": [0, -1]}, "'orientation_sd_deg': -1 is not 0 or"),
        ({"ax": [1], "ay": [2], "u_ay": [1]}, "column 'u_ax' is missing next to 'u_ay'"),
        ({"name": ["a", "b"]}, "no numeric column can be an output"),
        ({"position": [1, 2], "temperature": [1, 2]}, "no numeric column can be an output"),
    ],
)
def test_faulty_readings_are_refused_by_name(columns, message):
    with pytest.raises(MultiposError, match=message):
        read_readings(columns)


def test_unknown_outputs_are_named():
    with pytest.raises(MultiposError, match="no column 'aq'; the columns are 'ax'"):
        read_readings({"ax": [1.0]}, outputs=["aq"])
    with pytest.raises(MultiposError, match="no column 'aq'"):
        read_readings(Readings([[1.0]], outputs=("ax",)), outputs=["aq"])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"values": []}, r"`values` must have shape \(n, outputs\)"),
        ({"values": [[[1]]]}, r"`values` must have shape"),
        ({"values": [["a"]]}, "`values` must hold numbers"),
        ({"values": [[1.0], [np.nan]]}, "`values` of row 2 is not finite"),
        ({"values": [[1.0]], "outputs": ("a", "b")}, "`outputs` must name 1 columns, got 2"),
        ({"values": [[1.0, 2]], "outputs": ("a", "a")}, "names a column twice"),
        ({"values": [[1.0]], "u": [[0.0]]}, "`u` of row 1 is 0; it must be above 0"),
        ({"values": [[1.0]], "dof": [[1e-9]]}, "`dof` of row 1 is 1e-09; it must be from 0.1"),
        ({"values": [[1.0]], "sd": [[-1.0]]}, "`sd` of row 1 is -1; it must be 0 or more"),
        ({"values": [[1.0]], "u": [1.0]}, r"`u` must have shape \(1, 1\), got \(1,\)"),
        ({"values": [[1.0]], "positions": ("a", "b")}, "`positions` must have 1 labels, got 2"),
        (
            {"values": [[1.0]], "positions": ("a" * 10_001,)},  # no file of a result would be read
            "`positions` 1 has 10001 characters, and the file of a calibration holds at most 10000",
        ),
        ({"values": [[1.0]], "up": [[0, 0, 0]]}, "the up vector of row 1 is zero"),
        ({"values": [[1.0]], "u": [[1]], "covariance": [[1]]}, "both state the reading noise"),
        ({"values": [[1.0]], "environment": {"t": [1, 2]}}, "must have shape"),
    ],
)
def test_faulty_arrays_are_refused(given, message):
    with pytest.raises(MultiposError, match=message):
        Readings(**given)


def test_arrays_are_copied():
    values = np.ones((2, 3))
    readings = Readings(values)
    values[:] = 7
    assert_array_equal(readings.values, np.ones((2, 3)))
    assert readings.outputs == ("ax", "ay", "az")
    assert Readings([1.0, 2.0]).outputs == ("ax",)
    assert Readings(np.ones((1, 4))).outputs == ("a1", "a2", "a3", "a4")


def test_the_covariance_follows_the_outputs_that_stay():
    covariance = np.diag(np.arange(1.0, 7.0))
    covariance[0, 2] = covariance[2, 0] = 0.5  # output a of row 1 with output c of row 1
    readings = Readings(np.ones((2, 3)), outputs=("a", "b", "c"), covariance=covariance)
    found = read_readings(readings, outputs=("c", "a"))
    assert_array_equal(
        found.covariance, [[3, 0.5, 0, 0], [0.5, 1, 0, 0], [0, 0, 6, 0], [0, 0, 0, 4]]
    )
    assert_array_equal(found.environment["b"], [1, 1])


# --- meeting a scheme


def test_labels_are_matched_in_any_order_and_repeated():
    readings = Readings([[1.0], [2.0], [3.0]], positions=("6", "1", "6"))
    found = orient(readings, "song-qin-6")
    up = read_scheme("song-qin-6").up
    assert_array_equal(found.up, up[[5, 0, 5]])
    assert found.positions == ("6", "1", "6")


def test_without_labels_rows_are_matched_where_the_counts_agree():
    found = orient(Readings(np.ones((6, 1))), "song-qin-6")
    assert found.positions == tuple("123456")
    bare = {"up_x": [0, 1], "up_y": [0, 0], "up_z": [1, 0]}
    labelled = orient(Readings(np.ones((2, 1)), positions=("up", "front")), bare)
    assert labelled.positions == ("up", "front")
    assert_array_equal(labelled.up, [[0, 0, 1], [1, 0, 0]])


@pytest.mark.parametrize(
    ("readings", "scheme", "message"),
    [
        (
            Readings(np.ones((2, 1)), positions=("1", "A")),
            "faces-6",
            (
                "position 'A' is not in scheme 'faces-6', "
                "whose labels are '1', '2', '3', '4', '5', '6'"
            ),
        ),
        (Readings(np.ones((5, 1))), "faces-6", "5 readings but scheme 'faces-6' has 6 positions"),
        (
            Readings(np.ones((2, 1)), positions=("a", "b")),
            {"up_x": [1], "up_y": [0], "up_z": [0]},
            "only one has labels; the labels are 'a', 'b'",
        ),
        (Readings(np.ones((2, 1))), None, "no orientation; give --scheme"),
    ],
)
def test_labels_that_match_no_position_are_named(readings, scheme, message):
    with pytest.raises(MultiposError, match=message):
        orient(readings, scheme)


def test_a_scheme_that_agrees_takes_the_place_of_orientation_columns():
    listed = read_scheme("tumble-3").up
    leaning = listed + 0.03 * np.roll(listed, 1, axis=1)  # by 1.7 degrees
    columns = dict(zip(("up_x", "up_y", "up_z"), leaning.T, strict=True))
    found = orient(read_readings({**columns, "ax": [1, 2, 3]}), "tumble-3")
    assert_array_equal(found.up, listed)
    assert not any("scheme" in text for text in texts(found))


def test_a_scheme_that_contradicts_orientation_columns_is_refused_with_the_first_row():
    said = r"row 1, '1', points \(.*\) by its own column and \(1, 0, 0\) as position '1'"
    with pytest.raises(MultiposError, match=said):
        orient(read_readings({**UP, "ax": [1, 2, 3]}), "tumble-3")


def test_a_data_frame_works_wherever_a_file_does():
    up = read_scheme("faces-6").up
    frame = pd.DataFrame(up, columns=["up_x", "up_y", "up_z"])
    frame["ax"] = 0.1 + 2.0 * up[:, 0]
    assert fit(frame).parameters == pytest.approx([0.1, 2, 0, 0], abs=1e-15)
    scheme = frame[["up_x", "up_y", "up_z"]]
    assert fit(frame[["ax"]], scheme=scheme).parameters == pytest.approx([0.1, 2, 0, 0], abs=1e-15)


def test_more_than_three_columns_ask_for_outputs():
    columns = {f"c{i}": np.arange(6.0) for i in range(4)}
    with pytest.raises(UsageError, match="4 columns could be outputs: c0, c1, c2, c3; name them"):
        fit(columns, scheme="faces-6")
    assert fit(columns, scheme="faces-6", axes="x,y,z,x").outputs == ("c0", "c1", "c2", "c3")
    assert fit(columns, scheme="faces-6", outputs="c1").outputs == ("c1",)


def test_labels_are_numbers_where_there_are_none():
    assert Readings([1.0, 2.0]).labels == ("1", "2")
    assert Readings([1.0, 2.0], positions=("up", "up")).labels == ("up", "up")


def test_stated_noise_is_variances_or_a_covariance_where_outputs_are_dependent():
    values = [[1.0, 2.0]]
    assert Readings(values).noise is None
    assert_array_equal(Readings(values, u=[[0.5, 3.0]]).noise, [0.25, 9.0])
    apart, together = np.diag([0.25, 9.0]), np.array([[0.25, 0.1], [0.1, 9.0]])
    assert_array_equal(Readings(values, covariance=apart).noise, [0.25, 9.0])
    assert_array_equal(Readings(values, covariance=together).noise, together)
