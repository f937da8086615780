"""More outputs than axes: least squares and the parity that it leaves."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

import multipos as mp
from multipos.parity import parity
from multipos.scheme import read_scheme
from multipos.tilt import reading_noise

TETRAHEDRON = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / math.sqrt(3)
NAMES = ("s1", "s2", "s3", "s4")
SD = 1e-4


def readings(up, seed=0, sd=SD):
    values = 0.01 + 1.2 * up @ TETRAHEDRON.T
    return values + sd * np.random.default_rng(seed).standard_normal(values.shape)


def columns(values):
    return dict(zip(NAMES, values.T, strict=True))


@pytest.fixture
def calibration():
    up = read_scheme("fibonacci-24").up
    return mp.fit(columns(readings(up)), scheme="fibonacci-24", axes="x,y,z,x")


def test_four_accelerometers_compensate_to_three_axes(calibration):
    up = read_scheme("all-26").up
    force = calibration.compensate(readings(up, seed=1))
    assert_allclose(force, up, rtol=0, atol=5 * SD)
    # four sensors at 1.2 per g on three axes: the noise of force is sd sqrt(3/4)/1.2
    many = calibration.compensate(readings(np.tile(up, (40, 1)), seed=2))
    assert_allclose(np.std(many - np.tile(up, (40, 1))), SD * math.sqrt(0.75) / 1.2, rtol=0.1)


def test_parity_by_hand(calibration):
    """The tetrahedron's rows sum to zero: its parity vector is (1, 1, 1, 1)/2."""
    up = read_scheme("all-26").up
    raw = readings(up, seed=1)
    force = calibration.compensate(raw)
    found = parity(calibration, raw, force, {}, reading_noise(calibration))
    assert found.vector.shape == (26, 1)
    bias = np.array([calibration[name, "1"].value for name in NAMES])
    assert_allclose(found.size, np.abs((raw - bias).sum(axis=1)) / 2, rtol=0, atol=3e-4)


def test_false_alarms_come_at_the_stated_rate(calibration):
    up = np.random.default_rng(3).standard_normal((4000, 3))
    up /= np.linalg.norm(up, axis=1)[:, None]
    found = mp.apply(calibration, columns(readings(up, seed=4)))
    assert sum(found["fault"]) <= 4 + 4 * math.sqrt(4) + 8  # 1e-3 of 4000, and u of the noise
    raw = readings(up, seed=4)
    raw[:, 2] += 2e-3  # one output fails
    assert np.mean(mp.apply(calibration, columns(raw))["fault"]) > 0.99


def test_no_parity_without_redundancy():
    up = read_scheme("fibonacci-24").up
    raw = readings(up)[:, :3]
    cal = mp.fit(dict(zip(NAMES, raw.T, strict=False)), scheme="fibonacci-24", axes="x,y,z")
    assert "parity" not in mp.apply(cal, dict(zip(NAMES, raw.T, strict=False)))


def test_a_row_without_an_answer_has_no_parity():
    up = read_scheme("fibonacci-24").up
    raw = readings(up)
    model = "1 + x + y + z + own^2"
    cal = mp.fit(columns(raw + 0.05 * up[:, [0, 1, 2, 0]] ** 2), scheme="fibonacci-24",
                 axes="x,y,z,x", model=model)  # fmt: skip
    found = mp.apply(cal, columns(np.full((1, 4), -1e3)), tilt=True, uncertainty=True)
    assert found["fault"] == [0]
    assert found["outside"] == [1]
    assert np.isnan(found["u_f_x"][0])
    assert np.isnan(found["u_tilt_x_deg"][0])
