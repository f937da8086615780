"""What the names of columns say: units, axes, and which are of acceleration."""

import pytest

import multipos as mp
from multipos.files.written_units import split_unit
from multipos.positions.headers import axes_by_name


@pytest.mark.parametrize(
    ("outputs", "axes"),
    [
        (("ax", "ay", "az"), ("x", "y", "z")),
        (("az", "ay", "ax"), ("z", "y", "x")),
        (("acc_z", "acc_x"), ("z", "x")),
        (("Acc.X", "acc.y"), ("x", "y")),
        (("ay",), ("y",)),
        (("relay",), None),
        (("A", "B", "C"), None),
        (("ax", "by", "cz"), None),
        (("ax", "ax2"), None),
        (("a1_x", "a1_y", "a1_z", "a2_z", "a2_y", "a2_x"), ("x", "y", "z", "z", "y", "x")),
        (("a1_x", "a1_y", "a1_z", "a2_z", "a2_y"), None),
        (("acc[2]", "acc[0]", "acc[1]"), ("z", "x", "y")),
    ],
)
def test_outputs_sense_the_axes_they_name(outputs, axes):
    assert axes_by_name(outputs) == axes


@pytest.mark.parametrize(
    ("header", "name", "unit"),
    [
        ("ax (m/s^2)", "ax", "m/s^2"),
        ("ax [g]", "ax", "g"),
        ("ax (mps2)", "ax", "m/s^2"),
        ("ax_(m/s**2)", "ax", "m/s^2"),
        ("accelerometer_m_s2[0]", "accelerometer_m_s2[0]", None),
        ("ax (left)", "ax (left)", None),
    ],
)
def test_a_unit_in_brackets(header, name, unit):
    assert split_unit(header) == (name, unit)


def test_zeit_is_the_time():
    rows = {"Zeit": [0.0, 60.0], "x": [1.0, 0.0], "y": [0.0, 1.0], "z": [0.1, 0.2]}
    found = mp.read_readings(rows)
    assert found.outputs == ("x", "y", "z")
    assert found.environment["time"].tolist() == [0.0, 60.0]
