"""Outliers, lack of fit and the equality of variances, by hand and by simulation."""

import math

import numpy as np
import pytest

import multipos as mp
from multipos.numerics.least_squares import solve
from multipos.sensor.fit_diagnostics import bartlett, lack_of_fit, linearity
from multipos.sensor.model import build_model
from multipos.sensor.studentised import find_outliers, find_outlying_positions


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


def test_lack_of_fit_with_unequal_variances_by_hand():
    # two rows of sd 1 and 1/2 weigh 1 and 4: their mean of 0 and 5 is 4, scatter 16 + 4 = 20;
    # the second pair, both −1, has none. Groups weigh 5 and 2: lack of fit 5·16 + 2·1 on 2 − 1
    found = lack_of_fit([0.0, 5.0, -1.0, -1.0], ["a", "a", "b", "b"], 1, sd=[1, 0.5, 1, 1])
    assert found is not None
    assert found[:3] == (pytest.approx(82 / (20 / 2), rel=1e-14), 1, 2)


ONE = {"design": np.zeros((40, 0)), "columns": [np.arange(0)]}  # not asked for one output


def test_an_outlier_is_judged_by_its_own_stated_uncertainty():
    rng = np.random.default_rng(5)
    sd = np.where(np.arange(40) < 20, 1.0, 100.0)[:, None]
    residuals = sd * rng.standard_normal((40, 1))
    residuals[3] = 8.0  # far for a row of sd 1, nothing among rows of sd 100
    labels = [str(row) for row in range(40)]
    leverage = np.full((40, 1), 0.1)
    found = find_outliers(residuals, leverage, [36.0], ["ax"], labels, sd, **ONE)
    assert [text.partition(":")[0] for text in found] == ["position 3"]
    assert "ax deviates by 8, " in found[0]
    assert not any(
        "position 3:" in t
        for t in find_outliers(residuals, leverage, [36.0], ["ax"], labels, **ONE)
    )


@pytest.mark.parametrize(("r", "named"), [(2.325, 0), (2.333, 1)])
def test_limit_of_an_outlier_by_hand(r, named):
    """Ten readings on ν = 6: t on 5 passes its two-sided 0.1 % point, 6.869, at r² = 5.425.

    r² = ν t²/(ν − 1 + t²) = 6 · 47.18/52.18, so r = 2.3292; the sum of squares is 6, so s = 1.
    """
    # eq. (1) of sensor.studentised
    residuals = np.full((10, 1), math.sqrt((6.0 - 0.6 * r**2) / 9))
    residuals[4] = -r * math.sqrt(0.6)  # of leverage 0.4
    found = find_outliers(residuals, np.full((10, 1), 0.4), [6.0], ["a"], list("0123456789"), **ONE)
    assert len(found) == named
    assert all("position 4: a deviates by -1.81, 2.3 times" in text for text in found)


@pytest.mark.parametrize(
    ("dof", "limit"),
    [
        # the tail of F on 2 and ν − 2 is ((ν − q)/ν)^((ν − 2)/2): 0.1 % at q = 12 (1 − 1e-3^(1/5))
        (12.0, 12 * (1 - 1e-3**0.2)),
        (math.inf, 2 * math.log(1e3)),  # that of χ² on 2 is exp(−q/2)
    ],
)
def test_limit_of_an_outlying_position_by_hand(dof, limit):
    for factor, named in ((0.995, 0), (1.005, 1)):
        q = np.full(10, 0.2)
        q[7] = factor * limit
        found = find_outlying_positions(q, np.full(10, 2.0), dof, list("0123456789"))
        assert len(found) == named
        size = math.sqrt(q[7] / 2)
        assert all(t == f"position 7 does not fit: {size:.1f} times the noise" for t in found)


def test_limit_of_an_outlying_position_beside_which_the_noise_was_found_robustly():
    """Of F on 2 and ν the tail is (1 + q/ν)^(−ν/2): 0.1 % on 12 at q = 12 (1e-3^(−1/6) − 1)."""
    for factor, named in ((0.995, 0), (1.005, 1)):
        q = np.full(10, 0.2)
        q[7] = factor * 12.0 * (10.0**0.5 - 1.0)
        labels = list("0123456789")
        found = find_outlying_positions(q, np.full(10, 2.0), 12.0, labels, robust=True)
        assert len(found) == named


def test_clean_data_have_an_outlier_as_rarely_as_said():
    rng = np.random.default_rng(7)
    design = rng.standard_normal((12, 4))
    hat = design @ np.linalg.pinv(design)
    runs, named = 3000, 0
    for _ in range(runs):
        noise = rng.standard_normal((12, 1))
        residual = noise - hat @ noise
        named += bool(
            find_outliers(
                residual, np.diag(hat)[:, None], [8.0], ["a"], list("abcdefghijkl"), **ONE
            )
        )
    # Bonferroni: at most 1 %, and hardly less; four standard deviations of the binomial law
    assert 0.005 < named / runs < 0.01 + 4 * math.sqrt(0.01 * 0.99 / runs)


def test_linearity_by_hand():
    model = build_model("linear", ("ax",), ("x",))
    reference = np.array([[-1.0, 0, 0], [0, 1, 0], [1, 0, 0]])
    values = np.array([[-2.0], [0.3], [2.0]])  # line 2 x + 0.1, largest distance 0.2, span 4
    found = linearity(model, reference, values, np.array([[0.01], [-0.04], [0.02]]))
    assert found["ax"]["without_model_percent"] == pytest.approx(5.0)
    assert found["ax"]["with_model_percent"] == pytest.approx(1.0)
    level = linearity(model, np.array([[0.0, 1, 0], [0, 0, 1]]), values[:2], values[:2])
    assert math.isnan(level["ax"]["without_model_percent"])


def test_an_outlier_of_many_positions_is_named_in_force():
    """2000 counts a g: a reading 10 counts off is 5 mg off, of as many positions as there are."""
    random = np.random.default_rng(4)
    up = random.standard_normal((500, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    values = 2000.0 * up + 0.5 * random.standard_normal(up.shape)
    values[7, 1] += 10.0
    readings = mp.Readings(values, up=up, unit="count")
    (said,) = mp.fit(readings, orientation_sd=0, exclude="none").diagnostics.outliers
    size = float(said.removeprefix("position 8: ay deviates by ").split(" mg")[0])
    assert abs(size - 5.0) < 4.0 * 0.25
