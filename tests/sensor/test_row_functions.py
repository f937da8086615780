"""Functions over rows by NumPy: held to CasADi's own evaluation, row by row."""

import casadi
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from multipos.sensor.compiled import _BINARY, _BLOCK, _UNARY, RowFunction

ULPS = 8 * np.finfo(float).eps  # two libraries round the last digits of sines and powers each
PAIRS = np.array(
    [
        [0.3, 0.7],
        [-0.4, 1.0],
        [0.0, 0.5],
        [-0.0, 2.0],
        [1.5, -3.0],
        [2.0, 2.0],
        [0.0, 0.0],
        [np.inf, 1.0],
        [np.nan, 0.25],
        [0.25, np.nan],
    ]
)


def both_ways(expressions, symbols, force, columns, parameters):
    column = casadi.densify(casadi.vertcat(*expressions))
    function = casadi.Function("f", symbols, [column], {"cse": True})
    one_by_one = [
        np.array(function(f, e, parameters)).ravel() for f, e in zip(force, columns, strict=True)
    ]
    return RowFunction(function)(force, columns, parameters), np.array(one_by_one).T


@pytest.mark.parametrize("name", [*_UNARY, *_BINARY])
def test_every_operation_and_its_slope_are_those_of_casadi(name):
    # eq. (3) of sensor.compiled
    force, columns, unknown = (casadi.SX.sym(s, k) for s, k in (("f", 3), ("e", 1), ("p", 2)))
    operation = getattr(casadi, f"OP_{name.upper()}")
    pairs = [(force[0], force[1]), (columns, unknown[0]), (unknown[0], unknown[1])]
    if name in _UNARY:
        found = [casadi.SX.unary(operation, a) for a, _ in pairs]
    else:
        found = [casadi.SX.binary(operation, a, b) for a, b in pairs]
    slopes = [casadi.jacobian(y, casadi.vertcat(force, columns, unknown)).T for y in found]
    given = np.column_stack([PAIRS, np.ones(len(PAIRS))]), PAIRS[:, :1], np.array([0.75, -0.5])
    mine, theirs = both_ways([*found, *slopes], [force, columns, unknown], *given)
    assert_allclose(mine, theirs, rtol=ULPS, atol=ULPS)


def test_rows_of_several_blocks_are_those_of_each_alone():
    force, columns, unknown = (casadi.SX.sym(s, k) for s, k in (("f", 3), ("e", 0), ("p", 2)))
    y = casadi.vertcat(unknown[0] * force[0] / (1 + force[1] ** 2), unknown[0] * unknown[1], 0, 3)
    function = RowFunction(casadi.Function("f", [force, columns, unknown], [casadi.densify(y)]))
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
