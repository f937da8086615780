"""The median against its definition and NumPy's."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from multipos.numerics.arrays import coarse_steps, median


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


def test_steps_of_a_converter_are_those_that_all_differences_hold():
    """Of quarters; of no grid; of quarters that scatter by as much; of halves of the same."""
    rng = np.random.default_rng(4)
    quarters = 0.25 * rng.integers(-20, 20, 60)
    halves = 0.5 * np.array([0.0, 40.0] * 30)  # too few to show a step of their own
    values = np.column_stack([quarters, rng.normal(size=60), quarters, halves])
    found = coarse_steps(values, np.array([0.1, 1e-9, 0.13, 0.1]))
    np.testing.assert_allclose(found, [0.25, 0.0, 0.0, 0.25], rtol=1e-12)
    many = np.tile(values, (20, 1))
    np.testing.assert_allclose(coarse_steps(many, np.array([0.1, 1.0, 0.13, 0.1])), found)
