"""Attitudes in every form, against rotations written out by another route."""

import itertools

import numpy as np
import pytest
from findings_bench import texts
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

import multipos as mp
from multipos.errors import MultiposError
from multipos.files.tables import read_table
from multipos.positions.attitudes import from_up, parse_direction, read_attitudes

LEVEL = {"E": (1, 0, 0), "N": (0, 1, 0), "U": (0, 0, 1)}
LEVEL |= {"W": (-1, 0, 0), "S": (0, -1, 0), "D": (0, 0, -1)}
CHINESE = dict(zip("ENWSUD", "东北西南天地", strict=True))


def attitudes(**columns):
    found = read_attitudes(read_table(columns))
    assert found is not None
    return found


def right_handed():
    for triple in itertools.permutations("ENWSUD", 3):
        x, y, z = (np.array(LEVEL[mark]) for mark in triple)
        if (np.cross(x, y) == z).all():
            yield "".join(triple)


def test_there_are_24_right_handed_triples():
    assert len(list(right_handed())) == 24


@pytest.mark.parametrize("triple", list(right_handed()))
def test_a_direction_is_where_the_axes_point(triple):
    matrix = parse_direction(triple)
    assert_array_equal(matrix, [LEVEL[mark] for mark in triple])
    assert np.linalg.det(matrix) == pytest.approx(1)
    for form in ("-".join(triple), triple.lower(), "".join(CHINESE[mark] for mark in triple)):
        assert_array_equal(parse_direction(form), matrix)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("E-N-D", "left-handed: with x E and y N, z points U"),
        ("东北地", "left-handed"),
        ("E-N-N", "impossible: with x E and y N, z points U"),
        ("E-W-U", "impossible: x and y must be perpendicular, but point E and W"),
        ("E-E-U", "impossible: x and y must be perpendicular"),
        ("E-N", "not a triple"),
        ("E-N-U-D", "not a triple"),
        ("E-N-X", "not a triple"),
        ("", "not a triple"),
    ],
)
def test_an_impossible_direction_is_refused_with_its_row(text, message):
    with pytest.raises(MultiposError, match=message) as error:
        attitudes(direction=["E-N-U", text])
    assert "row 2, column 'direction'" in str(error.value)


def test_direction_and_up_vector_agree():
    found = attitudes(direction=["E-U-S", "东北天", "DES"])
    assert_array_equal(found.up, [[0, 1, 0], [0, 0, 1], [-1, 0, 0]])


@given(
    st.lists(st.tuples(*[st.floats(-1, 1)] * 3), min_size=1).filter(
        lambda rows: all(max(map(abs, row)) > 1e-3 for row in rows)
    ),
    st.sampled_from([1e-200, 1.0, 9.81, 1e200]),
)
def test_up_vectors_of_any_length(rows, length):
    up = from_up(np.array(rows) * length).up
    assert_allclose(np.linalg.norm(up, axis=1), 1, rtol=1e-15)
    assert_allclose(np.cross(up, rows), 0, atol=1e-15)
    assert (np.einsum("ni,ni->n", up, rows) > 0).all()


@pytest.mark.parametrize("row", [(0, 0, 0), (-0.0, 0, 0)])
def test_a_zero_up_vector_is_refused(row):
    with pytest.raises(MultiposError, match="the up vector of row 2 is zero"):
        from_up([(0, 0, 1), row])
    with pytest.raises(MultiposError, match="the up vector of row 2 is zero"):
        attitudes(up_x=[0, row[0]], up_y=[0, row[1]], up_z=[1, row[2]])


def test_an_up_vector_leaves_the_heading_open():
    assert np.isnan(attitudes(up_x=[1], up_y=[0], up_z=[0]).rotation).all()
    assert np.isnan(attitudes(roll_deg=[10], pitch_deg=[5]).rotation).all()
    assert not np.isnan(attitudes(roll_deg=[10], pitch_deg=[5], yaw_deg=[0]).rotation).any()


angles = st.lists(st.tuples(*[st.floats(-360, 360)] * 3), min_size=1, max_size=5)


@given(angles)
def test_roll_pitch_yaw_are_aerospace(rows):
    roll, pitch, yaw = np.array(rows).T
    found = attitudes(roll_deg=roll, pitch_deg=pitch, yaw_deg=yaw)
    # Z-Y-X turns the north-east-down frame into the case; SciPy's matrix takes case to level
    to_ned = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll]), degrees=True)
    ned_from_enu = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    expected = to_ned.as_matrix().transpose(0, 2, 1) @ ned_from_enu
    assert_allclose(found.rotation, expected, atol=1e-12)
    assert_allclose(attitudes(roll_deg=roll, pitch_deg=pitch).up, expected[:, :, 2], atol=1e-12)


def test_level_is_z_down():
    assert_array_equal(
        attitudes(roll_deg=[0, 90, 180], pitch_deg=[0, 0, 0]).up,
        [[0, 0, -1], [0, -1, 0], [0, 0, 1]],
    )
    assert_array_equal(attitudes(roll_deg=[0], pitch_deg=[90]).up, [[1, 0, 0]])


@given(
    st.lists(st.tuples(*[st.floats(-1, 1)] * 4), min_size=1, max_size=5).filter(
        lambda rows: all(np.linalg.norm(row) > 0.01 for row in rows)
    )
)
def test_quaternions_are_hamilton_scalar_first(rows):
    w, x, y, z = np.array(rows).T
    found = attitudes(qw=w, qx=x, qy=y, qz=z)
    to_level = Rotation.from_quat(np.column_stack([x, y, z, w])).as_matrix()
    assert_allclose(found.rotation, to_level.transpose(0, 2, 1), atol=1e-12)
    assert_allclose(found.up, to_level[:, 2, :], atol=1e-12)


def test_quarter_turns_by_quaternion_are_exact():
    half = np.sqrt(0.5)
    found = attitudes(
        qw=[1, half, 1, 0.5], qx=[0, half, 0, 0.5], qy=[0, 0, 1, 0.5], qz=[0, 0, 0, 0.5]
    )
    # about x by 90°, y turns up; about y by 90°, x turns down; about (1, 1, 1) by 120°, y is up
    assert_array_equal(found.up, [[0, 0, 1], [0, 1, 0], [-1, 0, 0], [0, 1, 0]])
    with pytest.raises(MultiposError, match="row 1, column 'qw': the quaternion is zero"):
        attitudes(qw=[0], qx=[0], qy=[0], qz=[0])


@pytest.mark.parametrize(
    ("axis", "up"),
    [("x", lambda c, s: (0, c, s)), ("y", lambda c, s: (c, 0, s)), ("z", lambda c, s: (c, s, 0))],
)
def test_roll_about_an_axis(axis, up):
    angle = np.array([0.0, 30, 90, 180, 270, -90, 400, 12.5])
    found = attitudes(roll_axis=[axis] * len(angle), angle_deg=angle)
    turn = np.radians(angle)
    assert_allclose(found.up, [up(np.cos(t), np.sin(t)) for t in turn], atol=1e-15)
    # whole turntable attitudes: proper, with the axis pointing east
    assert_allclose(np.linalg.det(found.rotation), 1)
    along = "xyz".index(axis)
    assert_allclose(found.rotation[:, along], [[1, 0, 0]] * len(angle), atol=1e-15)
    exact = found.up[[0, 2, 3, 4, 5]]
    assert_array_equal(exact, np.rint(exact))


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"direction": ["E-N-U"], "up_x": [1]}, "given as direction and as up vector; keep one"),
        ({"up_x": [1], "up_z": [1]}, "column 'up_y' is missing"),
        ({"roll_deg": [1]}, "column 'pitch_deg' is missing"),
        ({"yaw_deg": [1]}, "'yaw_deg' needs 'roll_deg' and 'pitch_deg'"),
        ({"qw": [1], "qx": [0]}, "column 'qy', 'qz' is missing"),
        ({"roll_axis": ["x"]}, "column 'angle_deg' is missing"),
        ({"roll_axis": ["q"], "angle_deg": [1]}, "column 'roll_axis': 'q' is not an axis"),
        ({"up_x": ["a"], "up_y": [0], "up_z": [1]}, "column 'up_x': 'a' is not a number"),
        ({"roll_deg": [np.inf], "pitch_deg": [0]}, "column 'roll_deg': 'inf' is not finite"),
    ],
)
def test_a_faulty_orientation_is_refused_by_name(columns, message):
    with pytest.raises(MultiposError, match=message):
        attitudes(**columns)


def test_no_orientation_is_none():
    assert read_attitudes(read_table({"ax": [1]})) is None


def test_an_open_angle_of_a_roll_is_found_on_its_circle():
    # eq. (1) of positions.open_rolls
    rng = np.random.default_rng(1)
    up = mp.read_scheme("roll-z-8+roll-y-8+roll-x-8").up
    values = up * [1.01, 0.99, 1.0] + [0.01, 0.0, -0.02] + 1e-5 * rng.standard_normal((24, 3))
    angle = [f"{45 * (k % 8)}" for k in range(24)]
    angle[3] = angle[12] = ""
    table = {"roll_axis": ["z"] * 8 + ["y"] * 8 + ["x"] * 8, "angle_deg": angle}
    outputs = dict(zip(("ax", "ay", "az"), values.T, strict=True))
    cal = mp.fit({**table, **outputs})
    assert cal.readings.open_roll == tuple("z" if k == 3 else "y" * (k == 12) for k in range(24))
    assert cal.readings.orientation_sd is None
    assert_allclose(cal.reference[[3, 12]], up[[3, 12]], atol=1e-4)  # found again, to the noise
    assert any("roll angles of row" in text for text in texts(cal))
    with pytest.raises(MultiposError, match="need three outputs"):
        mp.fit({**table, "ax": values[:, 0]})
