"""CasADi functions mapped over rows: held to their evaluation row by row, and to NumPy."""

import casadi
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from multipos.sensor.compiled import _BLOCK, RowFunction

ULPS = 8 * np.finfo(float).eps  # two libraries round the last digits of sines and powers each


def test_rows_are_those_of_casadi_one_by_one():
    # eq. (1) of sensor.compiled
    force, columns, unknown = (casadi.SX.sym(s, k) for s, k in (("f", 3), ("e", 1), ("p", 2)))
    y = [force[0] * casadi.sin(unknown[0] * columns), casadi.fmin(force[1], unknown[1]), 0, 3]
    slopes = [casadi.jacobian(each, unknown).T for each in y[:2]]
    function = RowFunction((force, columns, unknown), [*y, *slopes])
    one = casadi.Function("f", [force, columns, unknown], [casadi.vertcat(*y, *slopes)])
    rng = np.random.default_rng(1)
    f, e, p = rng.standard_normal((7, 3)), rng.standard_normal((7, 1)), np.array([0.7, -0.2])
    expected = [one(*each, p).full().ravel() for each in zip(f, e, strict=True)]
    assert_array_equal(function(f, e, p), np.transpose(expected))
    own = rng.standard_normal((7, 2))  # parameters of each row
    expected = [one(*each).full().ravel() for each in zip(f, e, own, strict=True)]
    assert_array_equal(function(f, e, own), np.transpose(expected))


def test_rows_of_several_blocks_are_those_of_each_alone():
    force, columns, unknown = (casadi.SX.sym(s, k) for s, k in (("f", 3), ("e", 0), ("p", 2)))
    y = [unknown[0] * force[0] / (1 + force[1] ** 2), unknown[0] * unknown[1], 0, 3]
    function = RowFunction((force, columns, unknown), y)
    n = 2 * _BLOCK + 5
    rows = np.random.default_rng(1).standard_normal((n, 3))
    whole = function(rows, np.empty((n, 0)), np.array([2.0, 5.0]))
    # by hand: 2 x/(1 + y²), 2·5, and constants
    assert_allclose(whole[0], 2.0 * rows[:, 0] / (1.0 + rows[:, 1] ** 2), rtol=ULPS)
    assert_array_equal(whole[1:], np.tile([[10.0], [0.0], [3.0]], n))
    for some in (slice(0, 1), slice(_BLOCK - 1, _BLOCK + 1), slice(n - 3, n)):
        part = function(rows[some], np.empty((n, 0))[some], np.array([2.0, 5.0]))
        assert_array_equal(part, whole[:, some])
    assert function(rows[:0], np.empty((0, 0)), np.array([2.0, 5.0])).shape == (4, 0)
