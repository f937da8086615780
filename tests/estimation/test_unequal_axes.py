"""Axes of unequal noise beside unknown orientation, by dense matrices, integrals and simulation."""

import numpy as np
import pytest
from multipos.estimation.unequal_axes import (
    _divide,
    _half_interval,
    _most_likely,
    _Parts,
    allow_for_axes,
)
from numpy.testing import assert_allclose
from scipy.optimize import brentq
from scipy.stats import t as student

import multipos as mp
from multipos.numerics.quantiles import coverage_factor

P = 9


def some_rows(n=24, seed=1, ratios=(1.0, 1.0, 3.0), stated=0.0):
    """Return rows a (n, p), heights r and the shares c (n, 4) of one unit; S⁻¹ too."""
    rng = np.random.default_rng(seed)
    m = rng.standard_normal((n, 3))
    m /= np.linalg.norm(m, axis=1)[:, None]
    a = np.concatenate([m, m[:, :, None].repeat(3, axis=2).reshape(n, 9)[:, :6]], axis=1)
    a = a * rng.standard_normal((n, P))
    share = np.column_stack([np.full(n, stated), (1.0 - stated) * m**2])
    inverse = np.linalg.inv(a.T @ a)
    noise = np.sqrt(share @ np.r_[1.0, np.square(ratios)]) * rng.standard_normal(n)
    return a, noise - a @ inverse @ a.T @ noise, share, inverse


def allowed(a, r, share, inverse):
    batch = (a.T, r, share[:, 1:].T, inverse)
    return allow_for_axes(*(each[None] for each in batch))[0]


def integrated(a, r, share, inverse, spread=4.0):
    """U/k over the root of F/ν by eqs. (1)–(3) on dense matrices, a fine grid and SciPy's t."""
    n, p = a.shape
    nu = n - p
    left = np.eye(n) - a @ inverse @ a.T
    weight = np.diag(left)
    x = np.linspace(-14.0, 14.0, 113)
    first, second = (each.ravel() for each in np.meshgrid(x, x))
    ln = np.column_stack(
        [
            np.zeros(first.size),
            first / np.sqrt(2.0) + second / np.sqrt(6.0),
            second / np.sqrt(6.0) - first / np.sqrt(2.0),
            -2.0 * second / np.sqrt(6.0),
        ]
    )
    s = np.exp(ln)
    v = s @ (left**2 @ share).T
    q = (r**2 / v) @ weight / nu
    log = -0.5 * np.log(v) @ weight - 0.5 * nu * np.log(q)
    log -= 0.5 * (first**2 + second**2) / spread**2
    chance = np.exp(log - log.max())
    chance /= chance.sum()
    variances = (s @ ((inverse @ a.T) ** 2 @ share).T) * q[:, None]

    def beyond(U, variance):
        return chance @ (2.0 * student.sf(U / np.sqrt(variance), nu)) - 0.05

    U = [
        brentq(beyond, 1e-3 * np.sqrt(each.min()), 1e3 * np.sqrt(chance @ each), args=(each,))
        for each in variances.T
    ]
    return np.array(U) / coverage_factor(0.95, nu) / np.sqrt(r @ r / nu)


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(each, marks=pytest.mark.slow) for each in range(1, 4))]
)
@pytest.mark.parametrize("n", [18, 48])
def test_the_lattice_is_the_integral(n, seed):
    # eq. (3) of estimation.unequal_axes
    a, r, share, inverse = some_rows(n, seed)
    u = np.sqrt(np.diag(allowed(a, r, share, inverse)))
    # 19 nodes, of a law that is far from normal where positions are few: 3 % rms of 50 sets, at
    # most a tenth, and with 61 nodes half of it
    ratio = u / integrated(a, r, share, inverse)
    assert_allclose(ratio, 1.0, atol=0.12)
    assert np.sqrt(np.mean((ratio - 1.0) ** 2)) < 0.06


def test_the_prior_of_ratios_is_the_stated_one():
    """Of few positions it decides: half of its standard deviation makes U 3 % shorter."""
    sets = [some_rows(14, seed) for seed in range(4)]
    u = [np.sqrt(np.diag(allowed(*each))) for each in sets]
    ratios = [np.log(found / integrated(*each)) for found, each in zip(u, sets, strict=True)]
    assert_allclose(np.exp(np.mean(ratios)), 1.0, rtol=0.02)


def test_the_spread_of_ratios_is_that_of_their_likelihood():
    """The root of their covariance against second differences of eq. (3) and the prior."""
    a, r, share, inverse = some_rows(4000, 3, (1.0, 2.0, 5.0))
    parts = _divide(a.T[None], r[None], share[None, :, 1:].transpose(0, 2, 1), inverse[None])
    x, root = (each[0] for each in _most_likely(parts))
    left = np.eye(4000) - a @ inverse @ a.T
    weight, V = np.diag(left), left**2 @ share
    axes = np.array([[0.0, 1.0, -1.0, 0.0], [0.0, 1.0, 1.0, -2.0]]) / np.sqrt([[2.0], [6.0]])

    def log(x):
        v = V @ np.exp(x @ axes)
        q = weight @ (r**2 / v)
        return -0.5 * (weight @ np.log(v) + weight.sum() * np.log(q) + x @ x / 16.0)

    step = 0.05 * np.eye(2)
    bend = [
        [log(x + i + j) - log(x + i - j) - log(x - i + j) + log(x - i - j) for j in step]
        for i in step
    ]
    # the expected information, of thousands of positions, is that of these to a few percent
    assert_allclose(root @ root.T, np.linalg.inv(np.array(bend) / -0.01), rtol=0.15)


def test_many_positions_leave_the_sandwich():
    """The ratios are then known, and U is that of least squares under them."""
    # eqs. (1), (2) of estimation.unequal_axes
    ratios = (1.0, 2.0, 5.0)
    a, r, share, inverse = some_rows(4000, 3, ratios)
    variance = share @ np.r_[1.0, np.square(ratios)]
    cov = inverse @ (a.T * variance) @ a @ inverse
    found = allowed(a, r, share, inverse) * (r @ r) / (4000 - P)
    # the largest variance is known to some root(2/1300) of itself
    assert_allclose(np.sqrt(np.diag(found)), np.sqrt(np.diag(cov)), rtol=0.08)
    scale = np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
    assert_allclose(found / scale, cov / scale, atol=0.1)


@pytest.mark.parametrize("dof", [1, 2, 5, 40, 900])
def test_alike_axes_leave_students_t(dof):
    """Nodes of one variance are one law, whose U/k is its standard deviation."""
    weights, variances = np.full((1, 5), 0.2), np.full((1, 5, 2), 9.0)
    assert_allclose(_half_interval(weights, variances, float(dof)), 3.0, rtol=1e-9)
    mixed = np.array([1.0, 4.0, 4.0, 9.0, 100.0])
    U = brentq(lambda U: (2.0 * student.sf(U / np.sqrt(mixed), dof)).mean() - 0.05, 1e-3, 1e3)
    found = _half_interval(weights, np.repeat(mixed[None, :, None], 2, axis=2), float(dof))
    # 4096 steps of the table, of which linear interpolation is 1e-6
    assert_allclose(found, U / coverage_factor(0.95, dof), rtol=2e-5)


def test_what_is_stated_in_full_leaves_nothing_to_allow_for():
    a, r, share, inverse = some_rows(stated=1.0)
    assert_allclose(allowed(a, r, share, inverse), inverse, rtol=1e-10)


def test_a_position_alone_with_its_parameter_says_nothing():
    a, r, share, inverse = some_rows(30)
    alone = np.zeros((1, P + 1))
    alone[0, P] = 2.0
    wider = np.concatenate([np.concatenate([a, np.zeros((30, 1))], axis=1), alone])
    found = allowed(
        wider, np.r_[r, 0.0], np.concatenate([share, share[:1]]), np.linalg.inv(wider.T @ wider)
    )
    expected = allowed(a, r, share, inverse)
    # c of the position with leverage 1 is its variance, and no part of what is told
    assert_allclose(found[:P, :P], expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())


def test_information_that_rounding_makes_negative_leaves_what_is_known_beforehand():
    """Weights of more than the degrees of freedom take off more than there is."""
    V = np.full((1, 3, 4), 1.0 / 3.0) * np.array([1.0, 2.0, 4.0])[:, None]
    parts = _Parts(np.zeros((1, 3, P, P)), V, np.ones((1, 4)), np.full((1, 4), 50.0), 1.0)
    root = _most_likely(parts)[1][0]
    assert_allclose(np.linalg.det(root), 4.0**2)  # of two ratios, e⁴ each beforehand


def test_a_batch_is_its_units():
    units = [some_rows(20, seed) for seed in range(40)]
    a, r, share, inverse = (np.stack(each) for each in zip(*units, strict=True))
    found = allow_for_axes(np.swapaxes(a, 1, 2), r, np.swapaxes(share[:, :, 1:], 1, 2), inverse)
    for unit, mine in zip(units, found, strict=True):
        assert_allclose(mine, allowed(*unit), rtol=1e-9, atol=1e-12 * np.abs(mine).max())


@pytest.mark.parametrize("stated", [0.0, 0.3])
def test_a_unit_that_is_no_number_leaves_the_others(stated):
    units = [some_rows(20, seed, stated=stated) for seed in range(3)]
    a, r, share, inverse = (np.stack(each) for each in zip(*units, strict=True))
    inverse[1] = share[1] = np.nan
    with np.errstate(all="ignore"):  # as the batch has it
        found = allow_for_axes(np.swapaxes(a, 1, 2), r, np.swapaxes(share[:, :, 1:], 1, 2), inverse)
    assert np.isnan(found[1]).all()
    for unit in (0, 2):
        assert_allclose(found[unit], allowed(*units[unit]), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("c", [1e-12, 1e12])
def test_no_unit_is_preferred(c):
    a, r, share, inverse = some_rows()
    found = allowed(c * a, 1e-3 * r, share, inverse / c**2)
    assert_allclose(c**2 * found, allowed(a, r, share, inverse), rtol=1e-9)


def hand_held(rng, n, noise):
    """Return readings of a sensor that is held anyhow, and its parameters by name."""
    up = rng.standard_normal((n, 3))
    up /= np.linalg.norm(up, axis=1)[:, None]
    matrix = np.array([[1.02, 0.0, 0.0], [0.01, 0.98, 0.0], [-0.02, 0.015, 1.01]])
    bias = np.array([0.03, -0.02, 0.01])
    values = bias + up @ matrix.T + 1e-4 * np.asarray(noise) * rng.standard_normal((n, 3))
    truth = dict(zip(("bias_ax", "bias_ay", "bias_az"), bias.tolist(), strict=True))
    lower = zip(
        ("scale_ax", "cross_ay_x", "scale_ay", "cross_az_x", "cross_az_y", "scale_az"),
        matrix[np.tril_indices(3)].tolist(),
        strict=True,
    )
    return values, truth | dict(lower)


def covered(rng, n, noise, sets, **stated):
    """Return how often U holds each parameter."""
    inside = []
    for _ in range(sets):
        values, truth = hand_held(rng, n, noise)
        c = mp.fit(mp.Readings(values, unit="g"), unknown_orientation=True, **stated)
        value = dict(zip(c.names, c.parameters, strict=True))
        U = dict(zip(c.names, c.U, strict=True))
        inside.append([abs(value[name] - truth[name]) <= U[name] for name in truth])
    return np.mean(inside, axis=0)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [(1, 1, 10), (1, 1, 1), (10, 10, 1)], ids=str)
@pytest.mark.usefixtures("without_findings")
def test_u_holds_what_hangs_on_one_axis(noise):
    sets = 250
    held = covered(np.random.default_rng(5), 30, noise, sets)
    # nine parameters at .9 and beyond, the least of them by 2.8 standard deviations; U that
    # believes in equal axes holds 84 % of the worst
    assert held.min() >= 0.9 - 2.8 * np.sqrt(0.9 * 0.1 / sets)
    assert 0.93 <= held.mean() <= 0.975


def test_an_own_model_allows_for_axes_as_the_built_in_one_does():
    values, _ = hand_held(np.random.default_rng(8), 24, (1, 1, 10))
    plain = mp.fit(mp.Readings(values, unit="g"), unknown_orientation=True)
    own = mp.fit(
        mp.Readings(values, unit="g"),
        model="each = a + p*x + q*y + r*z",
        unknown_orientation=True,
    )
    assert_allclose(own.u, plain.u, rtol=1e-4)
    assert_allclose(own.covariance, plain.covariance, atol=1e-4 * plain.u.max() ** 2)


def test_the_estimate_and_its_degrees_of_freedom_are_those_of_equal_axes():
    values, _ = hand_held(np.random.default_rng(9), 24, (1, 1, 10))
    c = mp.fit(mp.Readings(values, unit="g"), unknown_orientation=True)
    assert (c.parameter_dof == 24 - P).all()
    length = np.linalg.norm(c.compensate(values), axis=1)
    # the sum of squares along the normals has its minimum there: no step of theirs is left
    assert np.sqrt(np.mean((length - 1.0) ** 2)) == pytest.approx(c.rms, rel=1e-6)
