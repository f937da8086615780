"""The median against its definition and NumPy's."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from multipos.numerics.arrays import median


@pytest.mark.parametrize(
    ("values", "expected"),
    [([7], 7.0), ([3, 1, 2], 2.0), ([4.0, 1.0, 2.0, 8.0], 3.0), ([1.0, np.inf, np.inf], np.inf)],
)
def test_what_lies_in_the_middle(values, expected):
    assert median(values) == expected


def test_no_number_has_no_median():
    assert np.isnan(median([1.0, np.nan, 2.0]))
    assert np.isnan(median([]))
    assert_array_equal(median([[1.0, np.nan], [3.0, 4.0]], axis=0), [2.0, np.nan])


@pytest.mark.parametrize("axis", [None, 0, 1, -1])
@pytest.mark.parametrize("shape", [(1, 1), (6, 5), (7, 4)])
def test_digit_by_digit_that_of_numpy(shape, axis):
    rng = np.random.default_rng(1)
    for values in (rng.normal(size=shape), rng.integers(0, 3, size=shape)):
        assert_array_equal(median(values, axis=axis), np.median(values, axis=axis))


def test_a_median_of_numbers_near_the_largest_there_is():
    assert median([1.7e308, 1.5e308, -1.0]) == 1.5e308
    assert median([1.5e308, 1.7e308]) == 1.6e308  # half of the sum, which is no number
