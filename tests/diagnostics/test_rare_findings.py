"""Findings that few data raise, each on data made for it."""

from types import SimpleNamespace

import numpy as np
import pytest

import multipos as mp
from multipos.diagnostics.residuals import _ENOUGH, _GROSS, _SHOWN, _outlying
from multipos.positions.scheme import read_scheme
from multipos.sensor.found import Estimator

RNG = np.random.default_rng(1)


def said(result):
    return {each.code: each.text for each in result.findings}


def test_a_candidate_that_follows_another_is_named():
    x = RNG.standard_normal(200)
    y = 1.0 + 2.0 * x + 0.1 * RNG.standard_normal(200)
    columns = {"x": x, "z": 3.0 * x + 1e-9 * RNG.standard_normal(200), "y": y}
    found = mp.regress(columns, response="y", variables=("x", "z"), degree=1, stepwise=True)
    assert said(found)["collinear-terms"] == "the model: z cannot be separated from the model"


def test_a_straight_line_has_one_segment():
    t = np.linspace(-20.0, 60.0, 200)
    columns = {"t": t, "y": 1.0 + 0.1 * t + 0.01 * RNG.standard_normal(200)}
    found = mp.regress(columns, response="y", variables=("t",), segment="t:auto")
    assert (found.edges, len(found.segments)) == ((), 1)


@pytest.mark.parametrize("size", [9.8, 1e192])  # the square of the second is no number
def test_up_vectors_in_another_unit_are_directions(size):
    up = read_scheme("faces-corners-14").up
    columns = {f"up_{axis}": size * up[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"a{axis}": up[:, i] for i, axis in enumerate("xyz")}
    text = f"up vectors have lengths of {size:.4g}; only their directions are used"
    assert said(mp.fit(columns))["up-length"] == text


@pytest.mark.parametrize("unit", ["", " [m/s^2]"])
def test_known_forces_of_9_8_are_said(unit):
    up = read_scheme("faces-corners-14").up
    columns = {f"F{axis}{unit}": 9.8 * up[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"a{axis}": up[:, i] for i, axis in enumerate("xyz")}
    text = "known forces have a size of 9.8 without a unit and are read as g"
    assert said(mp.fit(columns)).get("likely-unit") == (None if unit else text)


def test_an_orientation_error_beside_noise_of_a_whole_g():
    text = said(mp.schemes(["faces-6"], orientation_sd=0.1))["orientation-unweighed"]
    assert text.endswith("--orientation-sd 0.1 hardly counts")


def test_an_output_that_stops_during_a_rest():
    up = np.repeat(read_scheme("faces-6").up, 300, axis=0)
    a = (up + 0.01 * RNG.standard_normal(up.shape)).round(4)
    a[1000:1100, 1] = a[1000, 1]
    pose = np.repeat([str(i) for i in range(1, 7)], 300)
    time = np.arange(len(up)) / 100.0
    log = {"time": time, "pose": pose, "ax": a[:, 0], "ay": a[:, 1], "az": a[:, 2]}
    found = mp.average(log, label_column="pose")
    assert said(found)["stuck"] == (
        "position '4' (rows 900 to 1200): 'ay' repeats one value 100 times"
    )


def test_a_parameter_far_from_linear_within_its_u():
    up = read_scheme("all-26").up
    noise = 0.1 * np.random.default_rng(3).standard_normal(up.shape)
    readings = mp.Readings(0.02 + 1.01 * up / (1.0 + 0.03 * up**2) + noise, up=up)
    found = mp.fit(readings, model="each = b + s*own/(1 + k*own^2)", orientation_sd=0)
    assert "nonlinear within its uncertainty" in said(found)["model-bias"]


@pytest.mark.parametrize(("more", "said"), [(1 - _SHOWN, ""), (2, " and 2 more")])
def test_outliers_that_are_many_are_counted(more, said):
    count = _SHOWN + more
    labels = [f"P{k}" for k in range(20)]
    readings = SimpleNamespace(labels=labels, up=None, orientation_sd=None)
    c = SimpleNamespace(readings=readings, estimator=Estimator.UNKNOWN)
    rows, off = np.arange(count), np.full(count, 0.005)
    left = SimpleNamespace(rows=rows, off=off, ratio=0.5 * _GROSS, dof=_ENOUGH)
    found = _outlying(c, left)
    shown = ", ".join(f"P{k} (5 mg)" for k in range(min(count, _SHOWN)))
    verb = "deviates" if count == 1 else "deviate"
    assert f"{shown}{said} {verb} from the fit of the others" in found.text
    assert (found.level, found.rows) == ("warning", tuple(labels[:count]))
    left.ratio = 2.0 * _GROSS
    assert _outlying(c, left).level == "error"
    left.dof = _ENOUGH - 1
    assert _outlying(c, left).level == "warning"


def test_one_output_with_estimated_orientations_is_examined():
    """Its normals are of no three outputs: the model `1 + own` ended in a fault of the program."""
    up = mp.read_scheme("all-26").up
    noise = 1e-4 * np.random.default_rng(1).standard_normal((26, 1))
    values = up @ [[0.9965], [0.0074], [-0.008]] + noise
    readings = mp.Readings(values, outputs=("ax",), up=up, unit="g")
    cal = mp.fit(readings, axes="x", model="1 + own", orientation_sd="auto")
    assert "missing-term" in {each.code for each in cal.findings}
