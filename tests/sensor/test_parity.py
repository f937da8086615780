"""More outputs than axes: least squares and the parity that it leaves."""

import math

import numpy as np
import pytest
from known_noise import with_known_noise
from numpy.testing import assert_allclose

import multipos as mp
from multipos.compensation.parity import parity
from multipos.positions.scheme import read_scheme
from multipos.sensor.tilt import reading_noise

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


def test_tail_of_a_parity_by_hand():
    """Two pairs along x and y, the first 2 s apart on either side: χ² = 8 on 2, p = exp(−4)."""
    # eq. (1) of compensation.parity
    up, axes = read_scheme("fibonacci-24").up, [0, 1, 2, 0, 1]
    names = ("a", "b", "c", "d", "e")
    exact = dict(zip(names, up[:, axes].T, strict=True))
    stated = {"axes": "x,y,z,x,y", "reading_sd": 1e-9, "orientation_sd": 0}
    cal = mp.fit(exact, scheme="fibonacci-24", **stated)
    cal = with_known_noise(cal)
    raw = up[:1, axes] + SD * np.array([[2.0, 0.0, 0.0, -2.0, 0.0]])
    found = parity(cal, raw, cal.compensate(raw), {}, np.full(5, SD))
    assert_allclose(found.size, 2 * math.sqrt(2) * SD, rtol=1e-9)
    assert_allclose(found.p, math.exp(-4.0), rtol=1e-6)


@pytest.mark.parametrize(("size", "fault"), [(3.26, 0), (3.32, 1)])
def test_a_fault_is_one_in_a_thousand_by_hand(size, fault):
    """1e-3 of the normal law lies beyond 3.2905 sd, and 1 + 4/3000 is the variance of a parity."""
    up = read_scheme("fibonacci-3000").up
    exact = columns(1.2 * up @ TETRAHEDRON.T)
    stated = {"axes": "x,y,z,x", "reading_sd": SD, "orientation_sd": 0}
    cal = mp.fit(exact, scheme="fibonacci-3000", **stated)
    raw = 1.2 * up[:1] @ TETRAHEDRON.T + SD * size / 2  # (1, 1, 1, 1)/2 sees twice as much
    assert mp.apply(cal, columns(raw))["fault"] == [fault]


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


def test_without_the_noise_of_an_output_parity_has_a_vector_and_no_p(calibration):
    raw = readings(read_scheme("fibonacci-24").up)
    noise = reading_noise(calibration)
    noise = np.where(np.arange(len(noise)) == 1, np.nan, noise)
    found = parity(calibration, raw, calibration.compensate(raw), {}, noise)
    assert np.isfinite(found.vector).all()
    assert np.isnan(found.p).all()


def test_a_row_without_an_answer_has_no_parity():
    up = read_scheme("fibonacci-24").up
    raw = readings(up)
    model = "1 + x + y + z + own^2"
    cal = mp.fit(
        columns(raw + 0.05 * up[:, [0, 1, 2, 0]] ** 2),
        scheme="fibonacci-24",
        axes="x,y,z,x",
        model=model,
    )
    found = mp.apply(cal, columns(np.full((1, 4), -1e3)), tilt=True, uncertainty=True)
    assert found["fault"] == [0]
    assert found["outside"] == [1]
    assert np.isnan(found["u_f_x"][0])
    assert np.isnan(found["u_tilt_x_deg"][0])
