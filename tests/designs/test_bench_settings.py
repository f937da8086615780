"""A design keeps what the bench is set by: labels and angles of a file, of a head, of rolls."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import multipos as mp
from multipos.designs.designing import design_text
from multipos.designs.ranges import _leaning
from multipos.units import cos_deg, sin_deg

pytestmark = pytest.mark.usefixtures("optima_once")
FILE = """\
position,roll_deg,pitch_deg
A,0,0
B,180,0
C,90,0
D,-90,0
E,0,90
F,0,-90
G,45,0
"""


def test_labels_and_angles_of_a_file_stay(tmp_path):
    (tmp_path / "bench.csv").write_text(FILE, encoding="utf-8")
    found = mp.design("linear", 8, candidates=tmp_path / "bench.csv")
    angles = {line.split(",")[0]: line.split(",")[1:] for line in FILE.splitlines()[1:]}
    assert len(set(found.labels)) == 8
    for label, setting, up in zip(found.labels, found.settings, found.positions, strict=True):
        roll, pitch = map(float, angles[setting["position"]])
        assert label.split(" (")[0] == setting["position"]
        assert (setting["roll_deg"], setting["pitch_deg"]) == (roll, pitch)
        by_hand = [sin_deg(pitch), -sin_deg(roll) * cos_deg(pitch), -cos_deg(roll) * cos_deg(pitch)]
        assert_allclose(up, np.ravel(by_hand), rtol=0, atol=1e-12)
    again = mp.read_scheme(found.columns())
    assert_allclose(again.up, found.positions)
    assert again.labels == found.labels
    text = design_text(found)
    assert "operator's sheet" in text
    assert text.count("[ ]") == 8


def test_angles_of_its_own_beside_up_vectors_stay(tmp_path):
    rows = {"A": (0, 0, 1), "B": (0, 0, -1), "C": (1, 0, 0), "D": (-1, 0, 0), "E": (0, 1, 0)}
    lines = [f"{label},{10 * i},{x},{y},{z}" for i, (label, (x, y, z)) in enumerate(rows.items())]
    text = "\n".join(["position,table_deg,up_x,up_y,up_z", *lines, "F,70,0,-1,0"])
    (tmp_path / "bench.csv").write_text(text + "\n", encoding="utf-8")
    found = mp.design("linear", 6, candidates=tmp_path / "bench.csv")
    turned = {
        label: setting["table_deg"]
        for label, setting in zip(found.labels, found.settings, strict=True)
    }
    assert turned == {"A": 0.0, "B": 10.0, "C": 20.0, "D": 30.0, "E": 40.0, "F": 70.0}
    assert "table_deg  x above level" in design_text(found)


@pytest.mark.parametrize("bench", ["two-axis-45", "roll-45-xyz"])
def test_angles_of_a_named_bench_give_the_up_vector_back(bench):
    found = mp.design("linear", 6, candidates=bench)
    for setting, up in zip(found.settings, found.positions, strict=True):
        if bench.startswith("two"):
            a, b = setting["tilt_deg"], setting["roll_deg"]
            by_hand = [sin_deg(a) * cos_deg(b), sin_deg(a) * sin_deg(b), cos_deg(a)]
        else:
            c, s = cos_deg(setting["angle_deg"]), sin_deg(setting["angle_deg"])
            by_hand = {"x": [0, c, s], "y": [c, 0, s], "z": [c, s, 0]}[setting["roll_axis"]]
        assert_allclose(np.array(by_hand, dtype=float).ravel(), up, rtol=0, atol=1e-6)


def test_included_positions_keep_their_numbers_and_fine_sets_have_none():
    found = mp.design("linear", 8, include="faces-6", candidates="two-axis-45")
    assert [s.get("number") for s in found.settings[:6]] == ["1", "2", "3", "4", "5", "6"]
    assert set(found.settings[7]) == {"tilt_deg", "roll_deg"}
    assert mp.design("linear", 6, candidates="tilt-60").settings == ()
    long = "+".join(["cube"] * 60)  # longer than the name of a file may be
    assert {s["scheme"] for s in mp.design("linear", 6, candidates=long).settings} == {"faces-6"}
    assert list(mp.design("linear", 6).columns()) == ["position", "up_x", "up_y", "up_z"]


def test_a_range_of_tilts_leans_the_axes_that_are_not_upright():
    up, leaning = _leaning("tilt", 30.0, [0, 1, 2])
    assert leaning == [0, 1]
    np.testing.assert_allclose(np.linalg.norm(up, axis=1), 1.0)
    np.testing.assert_allclose(np.abs(up[:, :2]).max(axis=0), 0.5)  # sin 30°
    assert up[:, 2].min() == pytest.approx(np.sqrt(0.5))
    up, leaning = _leaning("level", 0.3, [2])  # z alone leans itself, from x
    assert leaning == [2]
    assert (up[:, 2].min(), up[:, 2].max()) == (-0.3, 0.3)
    assert up[:, 0].min() == pytest.approx(np.sqrt(1.0 - 0.09))


def test_positions_that_are_given_are_named_so():
    found = mp.design(
        "linear", 6, include={"up_x": [0.0, 0.6], "up_y": [0.0, 0.0], "up_z": [1.0, 0.8]}
    )
    rows = [line.split() for line in design_text(found).splitlines()]
    rows = [row for row in rows if row and row[0] in "123456"]
    assert [row[-1] == "given" for row in rows[:6]] == [True, True, False, False, False, False]
