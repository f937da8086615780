"""Recursions of the first order against sums by hand."""

import numpy as np
import pytest

from multipos.numerics.arrays import quadratic
from multipos.numerics.recursions import recur


def test_a_half_of_the_row_before_by_hand():
    w = np.array([[1.0, 8.0], [1.0, 0.0], [1.0, 4.0], [2.0, 2.0], [0.0, 1.0]])
    expected = [[1.0, 8.0], [1.5, 4.0], [1.75, 6.0], [2.875, 5.0], [1.4375, 3.5]]
    np.testing.assert_array_equal(recur(w, 0.5), expected)
    np.testing.assert_array_equal(recur(w[:, 1], 0.5), np.array(expected)[:, 1])
    np.testing.assert_array_equal(recur(w[:1], 0.5), w[:1])


def test_each_run_begins_anew_by_hand():
    first = np.array([True, False, True, False])
    found = recur(np.array([1.0, 1.0, 1.0, 1.0]), -2.0, first)
    np.testing.assert_array_equal(found, [1.0, -1.0, 1.0, -1.0])


@pytest.mark.parametrize("n", [1000, 8192, 8193, 20_000])
@pytest.mark.parametrize("a", [0.3, -0.9, 0.999])
def test_rows_of_one_block_and_of_several_are_summed_one_by_one(n, a):
    """At the end of a block too: z_k = w_k + a z_{k−1} by a loop."""
    # eq. (1) of numerics.recursions
    rng = np.random.default_rng(n)
    w, first = rng.normal(size=(n, 2)), rng.random(n) < 0.01
    expected = w.copy()
    for k in range(1, n):
        expected[k] += 0.0 if first[k] else a * expected[k - 1]
    np.testing.assert_allclose(recur(w, a, first), expected, rtol=0.0, atol=1e-11)


def test_a_form_of_vectors_by_hand():
    """x² + 4 x z + 3 z², whatever y: of (1, 7, 2) 21, of (0, 7, −1) 3; of nothing, nothing."""
    matrix = np.array([[1.0, 0.0, 2.0], [0.0, 0.0, 0.0], [2.0, 0.0, 3.0]])
    vectors = np.array([[[1.0, 7.0, 2.0], [0.0, 7.0, -1.0]], [[2.0, 0.0, 0.0], [1.0, 1.0, -1.0]]])
    np.testing.assert_allclose(quadratic(vectors, matrix), [[21.0, 3.0], [4.0, 0.0]])
    assert not quadratic(vectors, 0.0 * matrix).any()
