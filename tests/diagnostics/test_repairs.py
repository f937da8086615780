"""Which of several repairs is believed, and what an outlier must not be taken for."""

import warnings

import numpy as np
import pytest

import multipos as mp

BIAS = np.array([0.02, -0.03, 0.05])
MATRIX = np.array([[0.98, 0.01, -0.005], [0.004, 1.02, 0.01], [-0.01, 0.003, 0.99]])


def sense(up, rng, noise=1e-3):
    return BIAS + up @ MATRIX.T + noise * rng.standard_normal(up.shape)


def errors_of(values, up, **options):
    cal = mp.fit(mp.Readings(values, up=up), **options)
    return [finding.code for finding in cal.diagnostics.findings if finding.level == "error"]


def beside_placement(up, rng):
    """Readings at positions off by .3°, which scatters outputs across gravity alone."""
    moved = up + np.cross(np.radians(0.3) * rng.standard_normal(up.shape), up)
    return sense(moved / np.linalg.norm(moved, axis=1)[:, None], rng, 1e-4)


ONE_ROW = [
    [0.9345, -0.0632, 0.042],
    [-1.0534, -0.0798, 0.0118],
    [-0.0658, 0.9667, 0.027],
    [-0.0523, -1.1088, 0.0278],
    [-71.3138, -61.4317, 1164.886],
    [-0.0481, -0.0831, -1.109],
]
HALF = [
    [10.2435, -0.8342, 0.0649],
    [-11.4981, -0.732, -0.0099],
    [-0.64, 10.8387, -0.1034],
    [-0.0616, -1.27, -0.0091],
    [-0.0643, -0.0695, 1.1154],
    [-0.0604, -0.0824, -1.1186],
]


@pytest.mark.parametrize("values", [ONE_ROW, HALF], ids=["one row", "half of them"])
def test_rows_in_another_unit_on_six_faces(values):
    """Three steps of a converter put one row right as well as one factor; half was not found."""
    up = np.kron(np.eye(3), [[1.0], [-1.0]])
    assert errors_of(np.array(values), up) == ["row-unit"]


@pytest.mark.parametrize("n", [6, 26])
def test_radians_are_named_though_other_repairs_leave_as_little_of_a_response_too_large(n):
    for seed in range(12):
        rng = np.random.default_rng(seed)
        roll, pitch = rng.uniform(-np.pi, np.pi, n), rng.uniform(-1.5, 1.5, n)

        def up(factor, r=roll, p=pitch):
            r, p = factor * r, factor * p
            return np.column_stack([np.sin(p), -np.sin(r) * np.cos(p), -np.cos(r) * np.cos(p)])

        assert errors_of(sense(up(1.0), rng), up(np.pi / 180.0)) == ["angles-in-radians"]


def test_many_rows_are_repaired_though_placement_makes_one_of_them_stick_out():
    up = mp.read_scheme("all-26").up
    for seed in (1, 219):  # of 219 one row lies beyond its 1e-4 point
        rng = np.random.default_rng(seed)
        listed = up.copy()
        listed[1::2] *= -1.0
        assert errors_of(beside_placement(up, rng), listed) == ["flipped-row"]


def test_an_output_that_wrapped_at_both_ends_beside_one_that_did_at_one():
    """What wrapped at both faces looks reversed; what wrapped at one face is wrapped even so."""
    up = mp.read_scheme("faces-6").up
    values = sense(up, np.random.default_rng(1))
    values[0, 0] -= 2.0
    values[2:4, 1] -= [2.0, -2.0]
    assert errors_of(values, up) == ["wrapped"]


def test_rows_near_the_horizon_are_not_upside_down_for_an_outlier_among_them():
    """One output turns over rows at no cost where its axis is level: there an outlier may hide."""
    up = mp.read_scheme("dual-axis-48").up
    values = sense(up, np.random.default_rng(1))[:, 1:2]
    values[42] += 0.42
    assert errors_of(values, up, axes="y") == []


@pytest.mark.parametrize("error", [-0.5, 0.5])
@pytest.mark.parametrize("face", [0, 3])
def test_an_outlier_of_half_a_g_on_six_faces_leaves_an_output_its_signal(face, error):
    up = mp.read_scheme("faces-6").up
    values = 0.5 * sense(up, np.random.default_rng(0))
    values[face, 2] += error
    assert errors_of(values, up) == []


def test_readings_so_coarse_that_nothing_is_left_raise_no_warning_of_numpy():
    up = np.vstack([mp.read_scheme("faces-6").up] * 2)
    values = np.round(up[:, :2] * 100.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        warnings.simplefilter("ignore", mp.CalibrationWarning)
        mp.fit(mp.Readings(values, up=up), orientation_sd=0.01)


@pytest.mark.parametrize("scheme", ["faces-6", "faces-corners-14", "fibonacci-24"])
def test_a_reading_that_lost_its_sign_is_a_flipped_row_though_its_bias_is_negated_too(scheme):
    up = mp.read_scheme(scheme).up
    rng = np.random.default_rng(2)
    values = 0.02 + up @ (np.eye(3) + 0.005 * rng.standard_normal((3, 3))).T
    values += 2e-4 * rng.standard_normal(up.shape)
    values[3] *= -1.0
    with pytest.warns(mp.CalibrationWarning, match="upside down"):
        c = mp.fit(mp.Readings(values, up=up, unit="g"))
    assert [f.rows for f in c.findings if f.code == "flipped-row"] == [("4",)]
