"""Outliers among rows that may be noisier than others: by a second route, and by simulation."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize_scalar
from scipy.stats import multivariate_t
from scipy.stats import t as students_t

from multipos.sensor.studentised import find_outliers
from multipos.sensor.unlike_rows import p_values


def design_of(n):
    """Return ones and n directions on a spiral."""
    z = 1.0 - (2.0 * np.arange(n) + 1.0) / n
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(n)
    across = np.sqrt(1.0 - z**2)
    return np.column_stack([np.ones(n), across * np.cos(turn), across * np.sin(turn), z])


def fitted(X, noise):
    """Return residuals and leverage of a fit of every output."""
    hat = X @ np.linalg.pinv(X)
    return noise - hat @ noise, np.repeat(np.diag(hat)[:, None], noise.shape[1], axis=1)


def found_in(X, noise, sd=None):
    if sd is None:
        residuals, leverage = fitted(X, noise)
    else:  # one sd a row
        residuals, leverage = fitted(X / sd[:, :1], noise / sd)
        residuals = residuals * sd
    n, outputs = noise.shape
    return find_outliers(
        residuals,
        leverage,
        [float(n - X.shape[1])] * outputs,
        "abc"[:outputs],
        [str(row) for row in range(n)],
        sd,
        design=X,
        columns=[np.arange(X.shape[1])] * outputs,
    )


def test_p_values_by_another_route():
    """Fits of the other rows, v by a search, densities by SciPy, and eqs. (1) to (3) as they stand.

    Two readings are questioned, of different rows and outputs.
    """
    # eqs. (1), (2), (3) of sensor.unlike_rows
    rng = np.random.default_rng(3)
    X = design_of(14)
    noise = np.resize([3.0, 1.0], 14)[:, None] * rng.standard_normal((14, 3))
    noise[4, 1] += 9.0
    noise[9, 2] -= 7.0
    questioned = np.zeros((14, 3), dtype=bool)
    questioned[4, 1] = questioned[9, 2] = True
    residuals, leverage = fitted(X, noise)
    found = p_values(residuals, leverage, [X] * 3, questioned)

    r2, share, nu = np.empty((14, 3)), np.zeros((14, 3)), np.empty(3)
    for m in range(3):
        kept = ~questioned[:, m]
        beta = np.linalg.lstsq(X[kept], noise[kept, m], rcond=None)[0]
        error = noise[:, m] - X @ beta
        h = np.einsum("ni,ij,nj->n", X, np.linalg.inv(X[kept].T @ X[kept]), X)
        nu[m] = kept.sum() - 4
        c = np.sum(error[kept] ** 2) / nu[m]
        r2[:, m] = error**2 / c / np.where(kept, 1.0 - h, 1.0 + h)
        share[kept, m] = 1.0 - h[kept]
    left = (~questioned).sum(axis=1)
    each = share.sum(axis=1) / left

    def law(v, d):
        logs = [
            multivariate_t.logpdf(np.sqrt(row[keep]), shape=v * np.eye(count), df=d)
            for row, keep, count in zip(r2, ~questioned, left, strict=True)
        ]
        return float(each @ logs)

    ds = [*np.geomspace(1.0, 60.0, 8), 1e6]
    logs, best = [], []
    for d, with_prior in zip(ds, [0.3 / 8] * 8 + [0.7], strict=True):
        search = minimize_scalar(
            lambda x, d=d: -law(np.exp(x), d),
            bounds=(-4.0, 2.0),
            method="bounded",
            options={"xatol": 1e-8},
        )
        best.append(np.exp(search.x))
        logs.append(-search.fun + 0.5 * np.log1p(5.0 / d) + np.log(with_prior))
    chance = np.exp(np.array(logs) - max(logs))
    chance /= chance.sum()
    for p, (k, m) in zip(found, ((4, 1), (9, 2)), strict=True):
        q = r2[k].sum() - r2[k, m]
        expected = 0.0
        for weight, d, v in zip(chance, ds, best, strict=True):
            t = np.sqrt(r2[k, m] * (d + 2) / (d * v + q))
            expected += weight * 2.0 * students_t.sf(t, 1.0 / (1.0 / (d + 2) + 1.0 / nu[m]))
        # twenty steps towards the best v leave less than that
        assert p == pytest.approx(expected, rel=1e-4)


def test_without_the_others_there_is_no_p_value():
    X = design_of(12)
    X[5:, 3] = 0.0  # five rows show the last term
    residuals, leverage = fitted(X, np.random.default_rng(1).standard_normal((12, 2)))
    questioned = np.zeros((12, 2), dtype=bool)
    questioned[:5, 0] = True
    assert p_values(residuals, leverage, [X] * 2, questioned) is None
    questioned[:] = True
    assert p_values(residuals, leverage, [X] * 2, questioned) is None
    questioned[:] = False
    questioned[0, 0] = True
    assert p_values(np.zeros((12, 2)), leverage, [X] * 2, questioned) is None


@pytest.mark.parametrize("n", [12, 24, 48])
@pytest.mark.parametrize("in_blocks", [False, True])
def test_rows_of_unlike_noise_are_no_outliers(n, in_blocks):
    """Rows whose sd are 4:2:1 have one named in 1 or 2 of 100 good sets; 5 to 30 by eq. (1)."""
    rng = np.random.default_rng(11)
    X, sd = design_of(n), np.array([4.0, 2.0, 1.0])
    sd = np.repeat(sd, n // 3) if in_blocks else np.resize(sd, n)
    named = sum(bool(found_in(X, sd[:, None] * rng.standard_normal((n, 3)))) for _ in range(300))
    assert named <= 13  # a rate of 2 % has more once in a thousand


def test_an_error_among_rows_alike_is_an_outlier_still():
    """Eleven standard deviations in one output of 24 rows: named in 99 of 100 sets."""
    rng = np.random.default_rng(12)
    X, named = design_of(24), 0
    for _ in range(100):
        noise = rng.standard_normal((24, 3))
        noise[3, 1] += 11.0
        named += any(text.startswith("position 3: b deviates by") for text in found_in(X, noise))
    assert named >= 95  # of a rate of 99 %, once in a thousand fewer


def test_a_row_that_is_off_in_all_outputs_is_named():
    """As one that had not come to rest; its outputs do not hide each other."""
    rng = np.random.default_rng(13)
    X, named = design_of(24), 0
    for _ in range(100):
        noise = rng.standard_normal((24, 3))
        noise[3] += (11.0, -11.0, 11.0)
        named += any(text.startswith("position 3: ") for text in found_in(X, noise))
    assert named >= 90  # of a rate of 97 %, once in a thousand fewer


def test_rows_that_state_their_noise_are_alike():
    """In units of what they state: the error of a quiet row is found among loud ones."""
    rng = np.random.default_rng(14)
    sd = np.repeat(np.resize([10.0, 1.0, 1.0], 24)[:, None], 3, axis=1)
    noise = sd * rng.standard_normal((24, 3))
    noise[4, 1] += 14.0
    assert [text.partition(" deviates")[0] for text in found_in(design_of(24), noise, sd)] == [
        "position 4: b"
    ]
    assert found_in(design_of(24), noise) == ()


def test_scale_and_order_of_outputs_do_not_matter():
    rng = np.random.default_rng(15)
    X = design_of(16)
    residuals, leverage = fitted(X, rng.standard_normal((16, 3)))
    questioned = np.zeros((16, 3), dtype=bool)
    questioned[2, 0] = questioned[2, 1] = True
    p = p_values(residuals, leverage, [X] * 3, questioned)
    turned = p_values(
        1e4 * residuals[:, ::-1] * [1, 10, 1e-3], leverage, [X] * 3, questioned[:, ::-1]
    )
    assert_allclose(turned, p[::-1], rtol=1e-9)  # rounding
