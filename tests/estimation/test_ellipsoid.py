"""The ellipsoid start: exact on exact readings, in any unit, and still a start where it is poor."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from orientation_bench import BIAS, MATRIX, Sensor, lower

import multipos as mp
from multipos.errors import MultiposError
from multipos.estimation.starts import ellipsoid_start
from multipos.estimation.unknown_orientations import _quadrics, symmetric_root
from multipos.positions.scheme import read_scheme


@pytest.mark.parametrize(
    ("gain", "offset"), [(1.0, 0.0), (16384.0, 32768.0), (0.66, 1.65), (1e-9, 0.0)]
)
@pytest.mark.parametrize("magnitude", [1.0, 0.9987])
def test_exact_readings_give_bias_and_square_of_the_matrix(gain, offset, magnitude):
    # eqs. (1), (2) of estimation.unknown_orientations
    up = read_scheme("fibonacci-24").up
    values = offset + gain * Sensor().read(magnitude * up)
    bias, found = ellipsoid_start(values, magnitude, crossed=True)
    # relative to the offset, whose last digits are those of the readings
    assert_allclose(bias, offset + gain * BIAS, rtol=1e-12, atol=1e-12 * gain)
    assert_allclose(found, gain * lower(MATRIX), atol=1e-10 * gain)
    root = symmetric_root(found)
    assert_allclose(root, root.T, atol=1e-14 * gain)
    assert_allclose(root @ root, found @ found.T, atol=1e-13 * gain**2)


def test_without_cross_terms_six_positions_are_enough():
    sensor = Sensor(matrix=np.diag([0.9, 1.1, 1.02]))
    values = sensor.read(read_scheme("faces-6").up)
    bias, found = ellipsoid_start(values, 1.0, crossed=False)
    assert_allclose(bias, BIAS, atol=1e-12)
    assert_allclose(found, sensor.matrix, atol=1e-12)


def test_what_positions_do_not_show_stays_as_on_a_sphere():
    values = Sensor(bias=np.zeros(3), matrix=np.eye(3)).read(
        np.vstack([read_scheme("roll-x-12").up, read_scheme("roll-y-12").up])
    )
    # no position has both x and y, so their cross term is never seen
    bias, found = ellipsoid_start(values, 1.0, crossed=True)
    assert_allclose(bias, 0.0, atol=1e-12)
    assert_allclose(found, np.eye(3), atol=1e-12)


def test_noise_of_a_tenth_still_gives_an_ellipsoid():
    rng = np.random.default_rng(4)
    up = read_scheme("fibonacci-24").up
    for _ in range(200):
        values = Sensor().read(up) + 0.1 * rng.standard_normal(up.shape)
        bias, found = ellipsoid_start(values, 1.0, crossed=True)
        assert np.abs(bias - BIAS).max() < 0.5
        assert np.all(np.diag(found) > 0.0)


def test_flat_readings_are_refused():
    values = Sensor().read(read_scheme("roll-x-24").up)
    with pytest.raises(MultiposError, match="all positions lie on one circle"):
        ellipsoid_start(values, 1.0, crossed=True)
    values[:, 0] = 1.0
    with pytest.raises(MultiposError, match="never change"):
        ellipsoid_start(values, 1.0, crossed=True)


def test_the_quadric_through_points_of_an_ellipsoid_is_its_own():
    # eq. (2) of estimation.unknown_orientations
    K = np.array([[1.1, 0.05, -0.1], [0.02, 0.9, 0.08], [-0.06, 0.03, 1.3]])
    bias, up = np.array([0.2, -0.1, 0.05]), mp.read_scheme("fibonacci-24").up
    for k, crossed in ((K, True), (np.diag(np.diag(K)), False)):
        points = np.stack([(bias + up @ k.T).T, 5.0 * (up @ k.T).T])
        found = _quadrics(points, crossed=crossed)
        np.testing.assert_allclose(found.bias, [bias, np.zeros(3)], atol=1e-12)
        np.testing.assert_allclose(found.square, [k @ k.T, 25.0 * k @ k.T], rtol=1e-9, atol=1e-12)
        assert found.good.all()
    flat = np.stack([(up * [1.0, 1.0, 0.0]).T])
    assert not _quadrics(flat, crossed=False).clear.any()
