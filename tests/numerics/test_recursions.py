"""Recursions of the first order against sums by hand."""

import numpy as np

from multipos.numerics.series import recur


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
