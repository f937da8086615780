"""Outliers, lack of fit and the equality of variances, by hand and by simulation."""

import math

import numpy as np
import pytest

from multipos.diagnostics import bartlett, lack_of_fit
from multipos.least_squares import solve


def test_bartlett_by_hand():
    # variances 2, 4, 2 on 4, 5, 3 degrees of freedom; χ² with two has the tail exp(−x/2)
    statistic = 12 * math.log(34 / 12) - (4 * math.log(2) + 5 * math.log(4) + 3 * math.log(2))
    correction = 1 + (1 / 4 + 1 / 5 + 1 / 3 - 1 / 12) / (3 * 2)
    p = math.exp(-statistic / correction / 2)
    assert bartlett([8.0, 20.0, 6.0], [4, 5, 3]) == pytest.approx(p, rel=1e-12)
    assert bartlett([3e-6, 3e-6], 7) == pytest.approx(1.0, abs=1e-6)


def test_bartlett_at_the_edges():
    assert bartlett([0.0, 1.0], 3) == 0.0
    assert math.isnan(bartlett([0.0, 0.0], 3))
    assert math.isnan(bartlett([1.0], 3))
    assert math.isnan(bartlett([1.0, 2.0], 0))


def test_bartlett_rejects_as_often_as_it_says():
    rng = np.random.default_rng(11)
    runs, level = 4000, 0.05
    rejected = sum(bartlett(rng.chisquare(8, 3), 8) < level for _ in range(runs))
    # binomial, four standard deviations, and half a percent for the χ² approximation
    allowed = 4 * math.sqrt(level * (1 - level) / runs) + 0.005
    assert rejected / runs == pytest.approx(level, abs=allowed)


def test_lack_of_fit_by_hand():
    # means 2, −3, 1 of pairs: pure error 2 + 2 + 0 on 3, lack of fit 2 (4 + 9 + 1) on 3 − 1
    found = lack_of_fit([1.0, -2.0, 1.0, 3.0, -4.0, 1.0], ["a", "b", "c", "a", "b", "c"], 1)
    assert found is not None
    f, dof_lack, dof_pure, p = found
    assert (dof_lack, dof_pure) == (2, 3)
    assert f == pytest.approx(14 / (4 / 3), rel=1e-14)
    assert p == pytest.approx((1 + 2 * f / 3) ** -1.5, rel=1e-12)


def test_lack_of_fit_needs_repeats_and_groups_to_spare():
    assert lack_of_fit([1.0, 2.0, 3.0], [1, 2, 3], 1) is None
    assert lack_of_fit([1.0, 2.0, 3.0, 4.0], [1, 1, 2, 2], 2) is None


def test_lack_of_fit_without_scatter():
    assert lack_of_fit([1.0, 1.0, -1.0, -1.0], np.array([1, 1, 2, 2]), 1) == (math.inf, 1, 2, 0.0)


def test_lack_of_fit_splits_the_residual_sum():
    rng = np.random.default_rng(3)
    x = np.repeat(np.linspace(-1, 1, 6), 3)
    y = x**2 + 0.1 * rng.standard_normal(18)
    fit = solve(np.column_stack((np.ones(18), x)), y)
    found = lack_of_fit(fit.residuals, x, 2)
    assert found is not None
    f, dof_lack, dof_pure, p = found
    assert (dof_lack, dof_pure) == (4, 12)
    pure = sum(((y[x == v] - y[x == v].mean()) ** 2).sum() for v in np.unique(x)) / dof_pure
    assert f == pytest.approx((fit.rss - pure * dof_pure) / dof_lack / pure, rel=1e-10)
    assert p < 1e-6  # a parabola is not a line
