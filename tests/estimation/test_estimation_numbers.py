"""Numbers of estimation by hand or by a second route, at points without symmetry."""

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from amounts import exactly
from numpy.testing import assert_allclose
from scipy.optimize import brentq, least_squares
from scipy.spatial.transform import Rotation
from scipy.special import betainc, betaln
from scipy.stats import chi2

import multipos as mp
from multipos.estimation import (
    batches,
    known,
    noise,
    outliers,
    robustness,
    starts,
    stated_uncertainty,
    uncertain,
    uncertain_orientations,
    units,
    user_models,
)
from multipos.estimation.identifiability import CANDIDATES, least_determined
from multipos.estimation.information import FisherInformation
from multipos.estimation.known import REJECTED, fit_output
from multipos.estimation.noise import NoiseEstimate
from multipos.estimation.outliers import _outlying, find_outlying_rows, view_of
from multipos.estimation.problem import (
    OpenRolls,
    eliminate_free,
    state_problem,
    turn_to_axes,
)
from multipos.estimation.robustness import _middle
from multipos.estimation.starts import reduced_information, search
from multipos.estimation.stated_uncertainty import (
    add_reference_noise,
    combined_dof,
    with_stated_dof,
)
from multipos.estimation.uncertain import _scale_bias
from multipos.estimation.unknown_orientations import fit_ellipsoids
from multipos.estimation.user_models import _moved_by_rotations
from multipos.fitting.options import Options
from multipos.numerics.losses import EFFICIENCY, counted, loss_slope, loss_weight
from multipos.positions.orientations import orient, place, without_orientation
from multipos.sensor.fit_diagnostics import bartlett
from multipos.sensor.model import build_model

# --- orientations


def test_two_angles_are_eliminated_as_by_dense_matrices():
    """Σ⁻¹ − Σ⁻¹J (J'Σ⁻¹J + diag(0, 1/s²))⁻¹ J'Σ⁻¹; the second angle may be held."""
    # eq. (2) of estimation.problem
    rng = np.random.default_rng(3)
    root = rng.normal(size=(4, 3, 5))
    precision = root @ root.transpose(0, 2, 1)
    jacobian, prior = rng.normal(size=(4, 3, 2)), np.array([0.7, 2.0, 0.0, 5.0])
    jacobian[3, :, 1] = 0.0  # held
    weighted = precision @ jacobian
    gain, inverse, marginal = eliminate_free(precision, jacobian, weighted, prior)
    for i in range(4):
        A = jacobian[i].T @ weighted[i] + np.diag([0.0, prior[i]])
        assert_allclose(inverse[i], np.linalg.inv(A), rtol=1e-9, atol=1e-12)
        assert_allclose(gain[i], weighted[i] @ np.linalg.inv(A), rtol=1e-9, atol=1e-12)
        taken = weighted[i] @ np.linalg.solve(A, weighted[i].T)
        assert_allclose(marginal[i], precision[i] - taken, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_rolls_and_a_listed_position_say_how_a_frame_is_turned(mirror):
    angle = np.radians(np.arange(0.0, 360.0, 45.0))
    c, s, level = np.cos(angle), np.sin(angle), np.zeros(8)
    inclined = np.column_stack([0.8 * s, level + 0.6, 0.8 * c])  # of y, alike in all
    reference = np.concatenate([np.column_stack([level, c, s]), inclined, [[0.6, 0.0, 0.8]]])
    rolls = OpenRolls(np.repeat([0, 1, -1], [8, 8, 1]), np.repeat([-1, 0, -1], [8, 8, 1]))
    rows = rolls.rows
    turn = Rotation.from_rotvec([0.7, -0.4, 1.1]).as_matrix()
    direction = mirror * reference @ turn
    found = turn_to_axes(rolls, direction, ~rows, reference)
    assert_allclose(found, mirror * turn, atol=1e-5)


def test_changes_of_parameters_undo_a_rotation():
    """Of three rotations one does what two parameters do, another nothing that any does."""
    rng = np.random.default_rng(4)
    slopes = rng.normal(size=(8, 3, 4))
    c = np.array([0.5, 0.0, -1.2, 0.0])
    rotated = np.stack([slopes @ c, rng.normal(size=(8, 3))], axis=2)
    found = _moved_by_rotations(slopes, rotated)
    assert found.shape == (4, 1)
    scale = np.linalg.norm(slopes.reshape(24, 4), axis=0)
    assert_allclose(np.abs(found[:, 0] / scale @ c) / np.linalg.norm(found[:, 0] / scale), 1.3)
    assert _moved_by_rotations(slopes, rotated[:, :, 1:]).shape == (4, 0)


@pytest.mark.parametrize("crossed", [True, False])
def test_an_ellipsoid_gives_its_centre_and_its_triangle(crossed):
    L = np.array([[2.0, 0.0, 0.0], [0.3, 1.5, 0.0], [-0.2, 0.1, 1.1]]) * (
        1 if crossed else np.eye(3)
    )
    u = mp.read_scheme("fibonacci-20").up
    values = (np.array([0.4, -0.3, 0.2]) + u @ L.T).T[None]
    found = fit_ellipsoids(values, crossed=crossed)
    assert_allclose(found.bias[0], [0.4, -0.3, 0.2], atol=1e-9)
    assert_allclose(found.lower[0], L, atol=1e-9)
    assert found.clear[0]
    extent = np.linalg.eigvalsh(np.cov(values[0], bias=True))
    assert found.thickness[0] == pytest.approx(extent[0] / extent[2])
    change = values[0].std(axis=1).min() / np.abs(values).max()
    assert found.change[0] == pytest.approx(change)


# --- noise


# --- degrees of freedom and residuals


@dataclass
class Found:
    model: object
    dof: np.ndarray
    parameter_dof: np.ndarray
    variance_components: object = None


@pytest.mark.parametrize("joint", [False, True])
def test_degrees_of_freedom_of_stated_variances_join_those_of_residuals(joint):
    # eq. (3) of estimation.stated_uncertainty
    u, nu = np.array([[0.3, 0.2], [0.4, 0.1], [0.5, 0.6]]), np.array([[9.0, 5.0]] * 3)
    rests = {"a": SimpleNamespace(value=0.2), "b": SimpleNamespace(value=0.5)}
    model = build_model("1 + own", ("a", "b"), ("x", "y"))
    solution = Found(model, np.array([12.0, math.inf]), np.array([12.0, 11.0, 8.0, 7.0]))
    solution.variance_components = SimpleNamespace(rest_to_rest=rests)
    spread = []
    for i, excess in enumerate((0.04, 0.25)):
        v = u[:, i] ** 2
        stated = v.sum() ** 2 / np.sum(v**2 / nu[:, i])
        spread.append((v.mean() / (v.mean() + excess)) ** 2 / stated)
    if joint:
        spread = [max(spread)] * 2
    found = with_stated_dof(solution, SimpleNamespace(u=u, dof=nu), joint=joint)
    assert_allclose(found.dof, [1.0 / (1.0 / 12.0 + spread[0]), math.inf])
    each = np.array([spread[0], spread[0], spread[1], spread[1]])
    assert_allclose(found.parameter_dof, 1.0 / (1.0 / solution.parameter_dof + each))
    of_units = combined_dof(
        np.array([[12.0, 6.0]]), (u**2)[None], nu[None], np.array([[0.04, 0.25]])
    )
    own = stated_uncertainty._spread((u**2)[None], nu[None], np.array([[0.04, 0.25]]))[0]
    assert_allclose(of_units[0], 1.0 / (1.0 / np.array([12.0, 6.0]) + own))


def test_coefficients_of_an_output_and_what_they_leave_exactly():
    """Columns of very different size; residuals of readings near a thousand to the last digit."""
    rng = np.random.default_rng(9)
    design = np.column_stack([np.ones(11), rng.normal(size=(11, 2)) * [1e-3, 40.0]])
    y = 1000.0 + rng.normal(size=(2, 11))
    b, left = fit_output(design, np.linalg.pinv(design), y)
    for own, r, values in zip(b, left, y, strict=True):
        assert_allclose(own, np.linalg.lstsq(design, values, rcond=None)[0], rtol=1e-9)
        exact = values.astype(np.longdouble) - design.astype(np.longdouble) @ own
        assert_allclose(r, exact.astype(float), atol=1e-14)


# --- outliers


@pytest.mark.parametrize("axes", ["xyz", "zxy"])
@pytest.mark.parametrize("terms", ["linear", "own-quadratic", "1 + own"])
def test_a_row_off_an_ellipsoid_is_off_by_its_share(axes, terms):
    """Of squares or none, crossed or not, and with outputs in any order: 4 % too short."""
    rng = np.random.default_rng(2)
    up = mp.read_scheme("fibonacci-40").up
    K = np.array([[2.2, 0.0, 0.0], [0.05, 0.9, 0.0], [-0.02, 0.03, 1.4]])
    values = up * np.diag(K) if terms == "1 + own" else up @ K.T
    if terms == "own-quadratic":
        values = values + np.diag(K) * 0.01 * up**2
    values = values[:, ["xyz".index(axis) for axis in axes]] + [0.3, -0.2, 0.1]
    values[11] = 0.96 * (values[11] - [0.3, -0.2, 0.1]) + [0.3, -0.2, 0.1]
    values += 1e-4 * rng.normal(size=values.shape)
    model = build_model(terms, ("a", "b", "c"), tuple(axes))
    u = np.full((40, 3), 1e-4)
    for own in (None, u):
        given = mp.Readings(values, outputs=("a", "b", "c"), unit="g", u=own)
        found = find_outlying_rows(model, given, None)
        assert found.rows.tolist() == [11]
        assert found.off[0] == pytest.approx(0.04, rel=0.05)


def test_a_row_off_a_line_is_off_by_its_error_over_the_response():
    """Two outputs off by .06 V and −.05 V, of 2.0 and 1.25 V/g: √(.03² + .04²) g."""
    rng = np.random.default_rng(3)
    up = mp.read_scheme("fibonacci-30").up
    values = 0.3 + up[:, :2] * [2.0, -1.25] + 1e-4 * rng.normal(size=(30, 2))
    values[17] += [0.06, -0.05]
    model = build_model("linear", ("a", "b"), ("x", "y"))
    given = mp.Readings(values, up=up, outputs=("a", "b"), unit="V")
    found = find_outlying_rows(model, given, given.up)
    assert found.rows.tolist() == [17]
    assert found.off[0] == pytest.approx(0.05, rel=0.01)
    assert_allclose(found.errors, [[0.06, -0.05]], atol=3e-4)
    assert found.dof == 30 - 4 - 1


def test_a_view_is_the_regression_of_whitened_readings():
    rng = np.random.default_rng(4)
    X, y, variance = rng.normal(size=(9, 3)), rng.normal(size=(9, 2)), rng.uniform(0.3, 2.0, (9, 2))
    (plain,) = view_of([X, X], y)
    H = X @ np.linalg.pinv(X)
    assert_allclose(plain.both[0, 3:].T, y - H @ y, atol=1e-12)
    assert_allclose(plain.both[0, :3].T @ plain.both[0, :3], H, atol=1e-12)
    (weighted,) = view_of([X, X], y, variance)
    for both, column, own in zip(weighted.both, y.T, variance.T, strict=True):
        W = X / np.sqrt(own)[:, None]
        H = W @ np.linalg.pinv(W)
        assert_allclose(both[3], column / np.sqrt(own) - H @ (column / np.sqrt(own)), atol=1e-12)
        assert_allclose(both[:3].T @ both[:3], H, atol=1e-12)
    twice = np.column_stack([X, X[:, 0] + X[:, 2]])
    (fewer,) = view_of([twice], y[:, :1])
    assert fewer.both.shape[1] == 3 + 1
    kept = np.array([True] * 7 + [False] * 2)
    view = view_of([X, X], y)
    found = _outlying(view, np.array([7, 8]), np.zeros(2), None, kept)
    ratios = []
    for column in y.T:
        after = column[kept] - X[kept] @ np.linalg.lstsq(X[kept], column[kept], rcond=None)[0]
        before = column - X @ np.linalg.lstsq(X, column, rcond=None)[0]
        ratios.append(before @ before / (after @ after) * (9 - 3 - 2) / (9 - 3))
    assert found.ratio == pytest.approx(math.sqrt(max(ratios)), rel=1e-9)
    assert found.dof == 4


def test_medians_of_misfits_by_degrees_of_freedom():
    found = _middle(np.array([1.0, 2.0, 2.25, 3.0, 0.4]))
    wanted = [*chi2.ppf(0.5, [1.0, 2.0, 2.25, 3.0]), 0.4 * chi2.ppf(0.5, 1.0)]
    assert_allclose(found, wanted, rtol=1e-6)


# --- grids of a posterior


def density_of(middle, sd, at):
    return -0.5 * ((at - middle) / sd) ** 2


# --- rows that are correlated


@pytest.mark.parametrize(("u", "said"), [(9.9e-3, True), (1.1e-2, False)])
def test_the_bias_of_a_scale_by_the_noise_across_it(u, said):
    """σ² of 1e-4, 4e-4, 9e-4 g²: half of the sum of the two others, by s²/(s² + σ²) = .3."""
    model = build_model("linear", ("a", "b", "c"), ("x", "y", "z"))
    theta = np.zeros(12)
    theta[[1, 6, 11]] = 2.0, -0.5, 1.0
    size, mean = 1.3, 14e-4 / 3
    sd = np.array([0.01, 0.02, 0.03]) * np.array([2.0, 0.5, 1.0]) * size
    s = math.sqrt(mean * 0.3 / 0.7)
    problem = SimpleNamespace(model=model, orientation_sd=np.full(4, s))
    wide = np.full(12, 1.0)
    bias = 0.3 * np.array([13e-4, 10e-4, 5e-4]) / 2.0 * [2.0, 0.5, 1.0]
    wide[1] = bias[0] / (1.96 / 3.0) * u / 1e-2
    found = _scale_bias(problem, theta, wide, sd, size)
    assert bool(found) is said
    if said:
        assert found[0].text.startswith(f"`scale_a` is too large by about {bias[0]:.2g}")


@pytest.mark.parametrize("across", [0.0, 0.05, 0.3])
def test_what_uncertain_forces_add_to_the_noise_of_readings(across):
    """U + J diag(u²) J'; a share below a hundredth of correlation is none."""
    # eq. (4) of estimation.stated_uncertainty
    rng = np.random.default_rng(2)
    up = mp.read_scheme("fibonacci-5").up
    J = np.diag([2.0, 1.5, 1.1]) + across * rng.uniform(0.5, 1.0, (3, 3)) * (1.0 - np.eye(3))
    u, reference_u = rng.uniform(0.01, 0.02, (5, 3)), rng.uniform(0.002, 0.005, (5, 3))
    model = SimpleNamespace(force_jacobian=lambda b, f, env: np.tile(J, (5, 1, 1)))
    solution = SimpleNamespace(
        model=model, parameters=None, reference=up, residual_sd=np.array([0.3, 0.2, 0.4])
    )
    blocks = [J @ np.diag(each**2) @ J.T for each in reference_u]
    given = mp.Readings(up, up=up, u=u, reference_u=reference_u)
    found = add_reference_noise(given, solution)
    V = [np.diag(own**2) + block for own, block in zip(u, blocks, strict=True)]
    scale = [np.sqrt(np.diag(each)) for each in V]
    beside = max(
        np.abs(v / np.outer(s, s) - np.eye(3)).max() for v, s in zip(V, scale, strict=True)
    )
    if beside <= 0.01:
        assert_allclose(found.u, scale)
        assert found.covariance is None
    else:
        whole = found.covariance.reshape(5, 3, 5, 3)
        for i in range(5):
            assert_allclose(whole[i, :, i, :], V[i], rtol=1e-12)
        assert not whole[0, :, 1, :].any()
        assert found.u is None
    # without stated noise it is a thousandth of what residuals show
    plain = add_reference_noise(mp.Readings(up, up=up, reference_u=reference_u), solution)
    variance = np.diag(blocks[3]) + 1e-6 * solution.residual_sd**2
    own = plain.u[3] ** 2 if plain.u is not None else np.diag(plain.covariance)[9:12]
    assert_allclose(own, variance, rtol=1e-12)


@pytest.mark.parametrize(("times", "found"), [(1.0, 0), (8.0, 1)])
def test_outputs_that_share_a_scatter_by_bartlett_s_test(times, found):
    """Sums of squares of 9 and 20 degrees of freedom, of variances that are alike or as 1 to 8."""
    residuals = np.zeros((30, 2))
    residuals[0] = 0.1 * np.sqrt([9.0, 20.0 * times])
    shared = SimpleNamespace(dof=np.array([9.0, 20.0]))
    one = SimpleNamespace(sd=None, residuals=residuals)
    squares = np.array([0.09, 0.2 * times])
    p = bartlett(squares, shared.dof)
    pooled = squares.sum() / 29.0
    statistic = 29.0 * math.log(pooled) - shared.dof @ np.log(squares / shared.dof)
    statistic /= 1.0 + (1.0 / 9.0 + 1.0 / 20.0 - 1.0 / 29.0) / 3.0
    assert p == pytest.approx(chi2.sf(statistic, 1), rel=1e-6)
    assert len(known._of_noise(shared, one, True)) == found
    assert known._of_noise(shared, one, False) == ()
    shared.dof[0] = 0.0
    assert len(known._of_noise(shared, one, True)) == 1


# --- several outliers


def test_what_is_beyond_chance_by_the_incomplete_beta_function():
    """A bound of ln I_x(a, b), near where that is small; a set by its part that is least so."""
    # eq. (1) of estimation.outliers
    for x, a, b in ((0.02, 4.5, 1.5), (0.3, 9.0, 0.5), (0.1, 6.0, 3.0), (0.05, 2.5, 2.0)):
        exact = math.log(betainc(a, b, x))
        slope = a - max(b - 1.0, 0.0) * x / (1.0 - x)
        by_hand = a * math.log(x) + (b - 1.0) * math.log(1.0 - x) - math.log(slope) - betaln(a, b)
        found = outliers._log_beta_tail(x, a, b)
        assert found == pytest.approx(by_hand)
        assert exact <= found + 1e-12 < exact + 0.3
    assert outliers._log_beta_tail(0.9, 2.0, 9.0) == 0.0
    assert outliers._log_beta_tail(-1e-9, 2.0, 9.0) == -math.inf
    assert outliers._log_choices(23, 5) == pytest.approx(math.log(math.comb(23, 5)))
    n, i, j, most = 23, 5, 2, 7
    parts = ((2, 18), (1, 16))
    view = [outliers.Part(np.zeros((1, n - d + m, n)), np.zeros((1, m))) for m, d in parts]
    limit = math.log(0.0075 / most / 3) - math.log(math.comb(n - j, i - j))

    def root(dof):
        log = lambda x: outliers._log_beta_tail(x, 0.5 * (dof - i), 0.5 * (i - j))  # noqa: E731
        return brentq(lambda x: log(x) - limit, 1e-6, 0.4)

    first, last = root(18), root(16)
    x = np.array([[0.9, first * 0.999, 0.9], [first * 1.001, 0.9, last * 1.001],
                  [0.9, 0.9, last * 0.999]])  # fmt: skip
    found = outliers._are_beyond(view, x, [i] * 3, [j] * 3, most)
    assert found.tolist() == [True, False, True]


@pytest.mark.parametrize(("ratio", "weighted"), [(1.19, False), (1.21, True)])
def test_readings_of_like_noise_are_looked_at_once(ratio, weighted):
    rng = np.random.default_rng(2)
    variance = 0.3 * np.linspace(1.0, ratio**2, 9)[:, None] ** np.array([0.5, 1.0])
    X, y = rng.normal(size=(9, 2)), rng.normal(size=(9, 2))
    views = outliers._views([X, X], y, variance)
    assert len(views) == 1 + weighted
    left = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
    assert_allclose(views[-1][0].values[0], left.T, atol=1e-12)


def _with_rows_off(X, more, kept, ratio):
    """Return readings whose second output leaves so many times the sum of squares of those kept."""

    def left(design, values):
        return values - design @ np.linalg.lstsq(design, values, rcond=None)[0]

    y = np.random.default_rng(7).normal(size=(len(X), 2))
    least = (left(X[kept], y[kept]) ** 2).sum(axis=0)
    e, d = left(more, y[:, 1]), left(more, 1.0 * ~kept)
    y[~kept, 1] += np.roots([d @ d, 2.0 * e @ d, e @ e - ratio * least[1]]).max()
    return y


@pytest.mark.parametrize(("ratio", "explained"), [(3.95, True), (4.05, False)])
def test_terms_that_explain_nearly_what_rows_do(ratio, explained):
    """Variance with a term up to four times that without three rows, of every output."""
    X, more = np.split(np.random.default_rng(8).normal(size=(14, 5)), [3], axis=1)
    more, kept = np.column_stack([X, more]), np.ones(14, dtype=bool)
    kept[[2, 5, 11]] = False
    y = _with_rows_off(X, more, kept, ratio * (14 - 5) / (14 - 3 - 3))
    assert outliers._is_explained(view_of([X, X], y), kept, y, [[more, more]]) is explained


@pytest.mark.parametrize(("ratio", "explained"), [(3.95, True), (4.05, False)])
def test_rows_off_that_any_term_explains(ratio, explained):
    """Variance with a term of no size, up to four times the least that some of the rows leave."""
    X, kept = np.random.default_rng(8).normal(size=(14, 3)), np.ones(14, dtype=bool)
    kept[[2, 5, 11]] = False
    y = _with_rows_off(X, X, kept, ratio * (14 - 3 - 1) / (14 - 3))
    view = view_of([X, X], y)
    assert outliers._is_explained_by_any(view, kept) is explained
    if explained:
        more = np.column_stack([X, np.random.default_rng(9).normal(size=14)])
        for some in ([2], [5], [11], [2, 5], [2, 11], [5, 11]):
            some_kept = outliers._without(np.array(some), 14)
            assert outliers._is_explained(view, some_kept, y, [[more, more]])


# --- robust fits


def test_the_factor_of_a_robust_fit_is_the_spread_of_its_equations():
    # eq. (1) of estimation.robustness
    rng = np.random.default_rng(3)
    q, weight = rng.chisquare(2.0, 9), rng.uniform(0.4, 1.0, 9)
    slope, degrees = rng.uniform(0.2, 1.0, 9), rng.choice([1.0, 3.0], 9)
    nu, mean = 11.0, slope.mean()
    used = 1.0 - nu / degrees.sum()  # p/N
    K = 1.0 + used * np.mean((slope - mean) ** 2) / mean**2
    wanted = K**2 * np.sum(weight**2 * q) / nu / mean**2
    found = robustness.huber_factors(q, degrees, weight, slope, np.array(nu))
    assert found == pytest.approx(wanted)
    low = robustness.huber_factors(q, degrees, weight, 0.0 * slope + 0.04, np.array(nu))
    assert low == pytest.approx(np.sum(weight**2 * q) / nu / 0.05**2)


def a_problem(off=(), sd=0.0, n=20, size=0.98, stated=1e-3, robust="huber", by=2e-3):
    """A triad at listed directions, some readings of which are off."""
    rng = np.random.default_rng(5)
    up = size * mp.read_scheme(f"fibonacci-{n}").up
    K = np.array([[2.0, 0.05, -0.02], [0.03, 1.3, 0.04], [0.01, -0.06, 0.9]])
    values = np.array([0.3, -0.2, 0.1]) + up @ K.T + by * rng.normal(size=(n, 3))
    for row, by in off:
        values[row] += by
    model = build_model("linear", ("a", "b", "c"), ("x", "y", "z"))
    u = np.full((n, 3), stated)
    given = mp.Readings(values, up=up / size, outputs=("a", "b", "c"), unit="g", u=u)
    up_stated = place(orient(given, None), size, **Options(orientation_sd=sd).spread)
    return state_problem(model, given, up_stated, robust), K


def found_of(problem):
    return search(problem)[0]


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_a_robust_fit_sets_aside_what_is_beyond_doubt_by_the_median(loss):
    """Of 20 positions five are off by .1; the others' median misfit is that of χ² on three."""
    off = {2: [0.0, 0.0, 0.3], 4: [0.2, 0.0, 0.0], 9: [0.0, 0.25, 0.0],
           13: [0.0, -0.2, 0.1], 16: [-0.2, 0.0, 0.2]}  # fmt: skip
    problem, _ = a_problem(off.items())
    names = [f"p{i}" for i in range(20)]
    optimum = found_of(problem)
    q = robustness._settle_noise(problem, optimum)[1].point.q
    after, optimum, noise = robustness.judge_robustly(problem, optimum, loss, names, stated=False)
    assert after.robust == loss
    assert {f.rows[0] for f in noise.findings} == {names[i] for i in off}
    assert f"{names[q.argmax()]} was set aside" in noise.findings[0].text
    assert f"is {math.sqrt(q.max() / 3.0):.3g} times the noise" in noise.findings[0].text
    kept = np.delete(np.arange(20), [*off])
    assert_allclose(after.weight[[*off]], 1e-12)
    q, three = optimum.point.q[kept], np.full(15, 3.0)
    ratio = np.median(q) / chi2.ppf(0.5, 3) * 45.0 / (45.0 - 12.0)
    assert ratio == pytest.approx(1.0, rel=2e-4 if loss == "huber" else 0.3)
    weight, slope = loss_weight(loss, q, three), loss_slope(loss, q, three)
    every = np.zeros(20)
    every[kept] = weight
    nu = float(counted(loss, every, np.full(20, 3.0))) - 12.0
    wanted = robustness.huber_factors(q, three, weight, slope, np.array(nu))
    assert noise.dof == pytest.approx(nu)
    assert noise.factor == pytest.approx(float(wanted))
    assert noise.claim is None
    assert noise.weight[[*off]].tolist() == [0.0] * 5


@pytest.mark.parametrize(("stated", "denied"), [(1e-3, True), (2.2e-3, False)])
def test_a_robust_fit_of_a_stated_noise_asks_it(stated, denied):
    problem, _ = a_problem(stated=stated)
    _, optimum, noise = robustness.judge_robustly(
        problem, found_of(problem), "huber", [""] * 20, stated=True
    )
    weight = loss_weight("huber", optimum.point.q, np.full(20, 3.0))
    statistic = np.sum(optimum.point.q * weight**2)
    assert bool(statistic > chi2.ppf(REJECTED, 48.0)) is denied
    if denied:
        assert (noise.claim.chi2, noise.claim.dof) == (pytest.approx(statistic), 48.0)
    else:
        assert (noise.factor, noise.dof) == (pytest.approx(1.0 / EFFICIENCY), math.inf)


@pytest.mark.parametrize(("n", "refused"), [(12, True), (13, False)])
def test_a_noise_that_vanishes_is_what_orientation_errors_leave_of_digits(n, refused):
    """A millionth of .3° of the largest reading; n contrasts beside two angles each, p = 12."""
    problem, _ = a_problem(sd=0.3, n=n, by=0.0)
    optimum = found_of(problem)
    if refused:
        with pytest.raises(mp.MultiposError, match="may explain the residuals"):
            robustness._settle_noise(problem, optimum)
        return
    after, _ = robustness._settle_noise(problem, optimum)
    finest = (1e-15 + 1e-6 * math.radians(0.3)) * np.abs(problem.values).max()
    assert_allclose(after.precision, finest**-2.0, rtol=1e-3)


def test_what_readings_show_of_their_noise_beside_orientation_errors():
    """r'Σ⁻¹r, tr Σ W and Σ t − tr S⁻¹ Σ A'W Σ W A, by dense matrices."""
    # eq. (2) of estimation.robustness
    problem, K = a_problem(sd=0.3, stated=4e-3)
    optimum = found_of(problem)
    own = robustness._of_readings(problem, optimum)
    Sigma, s = 16e-6 * np.eye(3), math.radians(0.3)
    S, taken, degrees, misfits = np.zeros((12, 12)), np.zeros((12, 12)), [], []
    K = optimum.state.theta.reshape(3, 4)[:, 1:]
    for force, r in zip(optimum.point.force, optimum.point.residuals, strict=True):
        J = K @ (np.linalg.norm(force) ** 2 * np.eye(3) - np.outer(force, force)) @ K.T
        W = np.linalg.inv(Sigma + s**2 * J)
        A = np.kron(np.eye(3), np.append(1.0, force))
        S += A.T @ W @ A
        taken += A.T @ W @ Sigma @ W @ A
        degrees.append(np.trace(Sigma @ W))
        misfits.append(r @ r / 16e-6)
    assert_allclose(own.misfits, misfits, rtol=1e-9)
    assert_allclose(own.degrees, degrees, rtol=1e-6)
    assert own.lost == pytest.approx(np.trace(np.linalg.solve(S, taken)), rel=1e-5)


# --- starts


@pytest.mark.parametrize("sd", [0.0, 0.4])
def test_what_a_candidate_position_would_add(sd):
    """X' (Σ + s² K (f²1 − ff') K')⁻¹ X at the mean precision."""
    problem, K = a_problem(sd=sd, stated=4e-3)
    theta = np.column_stack([[0.3, -0.2, 0.1], K]).ravel()
    precision = problem.precision * np.array([1.0, 2.0, 3.0]) * np.linspace(0.5, 2.0, 20)[:, None]
    gains = starts._candidate_gains(replace(problem, precision=precision), theta)
    Sigma, s = np.diag(1.0 / precision.mean(axis=0)), math.radians(sd)
    for up, found in zip(CANDIDATES, gains, strict=True):
        force = 0.98 * up
        J = K @ (0.98**2 * np.eye(3) - np.outer(force, force)) @ K.T
        X = np.kron(np.eye(3), np.append(1.0, force))
        assert_allclose(found, X.T @ np.linalg.inv(Sigma + s**2 * J) @ X, rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize("mirror", [1.0, -1.0])
@pytest.mark.parametrize("robust", [None, "huber"])
def test_an_ellipsoid_is_turned_to_the_listed_directions(mirror, robust):
    """Outputs in any order; of a robust start one position is far off."""
    up = mirror * mp.read_scheme("fibonacci-24").up
    K = np.array([[2.0, 0.05, -0.02], [0.03, 1.3, 0.04], [0.01, -0.06, 0.9]])
    values = np.array([0.3, -0.2, 0.1]) + 0.98 * up @ K.T
    if robust:
        values[7] += 0.4 * (values[7] - [0.3, -0.2, 0.1])
    order = [2, 0, 1]
    model = build_model("linear", ("c", "a", "b"), ("z", "x", "y"))
    given = mp.Readings(values[:, order], up=mirror * up, outputs=("c", "a", "b"), unit="g")
    stated = place(orient(given, None), 0.98, **Options(orientation_sd=3.0).spread)
    seen = starts._on_ellipsoid(state_problem(model, given, stated, robust))
    whole = np.column_stack([[0.3, -0.2, 0.1], mirror * K])[order]
    assert_allclose(seen.linear, whole, atol=1e-6)
    assert_allclose(seen.direction, mirror * up, atol=1e-6)


@pytest.mark.parametrize(("by", "refused"), [(0.995, False), (1.005, True)])
def test_readings_that_are_far_from_their_ellipsoid_are_refused(by, refused):
    """Median residual/.6745 √(n/ν) over size times scale, above a fifth."""
    model = SimpleNamespace(own_slopes=lambda theta, *_: dict(zip("xyz", theta, strict=True)))
    residuals = np.random.default_rng(2).normal(size=(9, 3))
    scale, size, nu = (0.7 + 1.1 + 1.9) / 3.0, 1.7, 9.0 - 4.0
    spread = np.median(np.linalg.norm(residuals, axis=1)) / 0.6745 * math.sqrt(9 / nu)
    residuals *= 0.2 * scale * size / spread * by
    problem = SimpleNamespace(
        model=model, environment={}, orientation_sd=np.full(9, math.inf),
        degrees=np.ones(9), unknowns=4,
        values=residuals, reference=np.full((9, 3), 1.7 / math.sqrt(3.0)),
    )  # fmt: skip
    optimum = SimpleNamespace(
        state=SimpleNamespace(theta=np.array([0.7, -1.1, 1.9])),
        point=SimpleNamespace(force=None, residuals=residuals),
    )
    if refused:
        with pytest.raises(mp.MultiposError, match="deviate by 20 %"):
            starts._require_sphere(problem, optimum)
    else:
        starts._require_sphere(problem, optimum)
    problem.orientation_sd[2] = 1.0
    starts._require_sphere(problem, optimum)


def test_too_few_positions_name_what_they_leave_open():
    """Seven of a triad with nine parameters, never tilted about one axis: y sees little."""
    rng = np.random.default_rng(2)
    angle = rng.uniform(0.0, 6.0, 7)
    up = np.column_stack([np.cos(angle), 0.1 * np.sin(3.0 * angle), np.sin(angle)])
    values = np.array([3.0, -2.0, 1.0]) + up * [2.0, 1.5, 1.1]
    model = build_model("linear", ("a", "b", "c"), ("x", "y", "z")).with_gauge("lower")
    given = mp.Readings(values, outputs=("a", "b", "c"), unit="g")
    up_stated = place(without_orientation(given, None), 1.0, **Options().spread)
    problem = state_problem(model, given, up_stated, None)
    error = starts.too_few(problem)
    assert (error.rank, error.parameters) == (7, 9)
    assert str(error).startswith("7 positions give 7 equations for 9 parameters: ")
    centre = (values.max(axis=0) + values.min(axis=0)) / 2.0
    seen = (values - centre) / ((values.max(axis=0) - values.min(axis=0)) / 2.0)
    f = seen / np.linalg.norm(seen, axis=1)[:, None]
    rows = [np.concatenate([f[k, i] * np.append(1.0, f[k, : i + 1]) for i in range(3)])
            for k in range(7)]  # fmt: skip
    missing = least_determined(np.array(rows).T @ rows, 7)
    assert all(f"`{model.names[i]}`" in str(error) for i in missing)
    assert str(error).count("`") == 2 * len(missing) == 4


# --- noise of tied outputs and of likelihoods


class Tied:
    """Outputs that share two parameters, with a prior on one of them."""

    def __init__(self):
        rng = np.random.default_rng(6)
        self.slopes = rng.normal(size=(7, 2, 3))
        self.precision = np.tile([4.0, 0.7], (7, 1))
        self.prior = np.diag([0.0, 3.0, 0.0])
        weighted = self.slopes * self.precision[:, :, None]
        self.information = np.einsum("nmp,nmq->pq", self.slopes, weighted) + self.prior
        self.values = rng.normal(size=(7, 2))
        self.residuals = 0.3 * rng.normal(size=(7, 2))
        self.problem = SimpleNamespace(
            values=self.values, exact=np.ones(7, dtype=bool), model=None, environment={},
            precision=self.precision, degrees=np.full(7, 2.0), unknowns=3,
        )  # fmt: skip
        point = SimpleNamespace(force=None, residuals=self.residuals)
        self.optimum = SimpleNamespace(state=SimpleNamespace(theta=np.zeros(3)), point=point)


def test_degrees_of_freedom_of_outputs_that_share_parameters(monkeypatch):
    """n − tr of each output's hat matrix; of a parameter as its variance comes from the outputs."""
    tied = Tied()
    monkeypatch.setattr(noise, "_information", lambda problem, optimum: tied.information)
    monkeypatch.setattr(noise, "parameter_jacobian", lambda *given: tied.slopes)
    inverse = np.linalg.inv(tied.information)
    dof = [
        7.0 - np.trace(tied.slopes[:, m] @ inverse @ tied.slopes[:, m].T) * w
        for m, w in enumerate((4.0, 0.7))
    ]
    assert_allclose(noise._degrees(tied.problem, tied.optimum), dof)
    covariance = 1.2 * inverse

    @dataclass
    class Of:
        covariance: np.ndarray
        parameter_dof: object = None
        dof: object = None

    found = noise.with_degrees(Of(covariance), tied.problem, tied.optimum, np.array(dof))
    parts = np.array([
        np.diag(inverse @ tied.slopes[:, m].T @ tied.slopes[:, m] @ inverse) * w
        for m, w in enumerate((4.0, 0.7))
    ])  # fmt: skip
    total = parts.sum(axis=0)
    own = total**2 / (parts[0] ** 2 / dof[0] + parts[1] ** 2 / dof[1])
    assert_allclose(found.parameter_dof, own * (np.diag(covariance) / total) ** 2)
    assert found.dof.tolist() == dof
    same = Of(covariance)
    assert noise.with_degrees(same, tied.problem, tied.optimum, np.array([3.0, 0.0])) is same
    tied.problem.exact[3] = False
    assert noise.with_degrees(same, tied.problem, tied.optimum, np.array([3.0, 2.0])) is same
    beliefs = np.array([0.0, 3.0, 0.0])
    tied.problem.model = SimpleNamespace(beliefs=beliefs)
    together = 14.0 - 3.0 + inverse[1, 1] * 3.0
    assert_allclose(noise._degrees(tied.problem, tied.optimum), [together] * 2)


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("kind", ["alike", "unlike", "correlated"])
def test_combinations_that_free_angles_do_not_move(count, kind):
    """What is left of readings of three outputs keeps information about everything else."""
    rng = np.random.default_rng(9)
    error, design, spread = rng.normal(size=(4, 3)), rng.normal(size=(4, 3, 5)), np.zeros((4, 3, 2))
    free = rng.normal(size=(4, 3, count))
    root = rng.normal(size=(4, 3, 6))
    full = {
        "alike": np.full((4, 3), 0.7), "unlike": rng.uniform(0.5, 2.0, (4, 3)),
        "correlated": root @ root.transpose(0, 2, 1),
    }[kind]  # fmt: skip
    block = units._without_free(error, design, spread, full, free, 1)
    for k in range(4):
        V = full[k] if kind == "correlated" else np.diag(full[k])
        P = np.linalg.inv(V)
        F = free[k]
        P = P - P @ F @ np.linalg.inv(F.T @ P @ F) @ F.T @ P
        v = block.variance[0, k]
        inner = np.linalg.inv(v) if v.ndim == 2 else np.diag(1.0 / v)
        X = np.column_stack([design[k], error[k]])
        Y = np.column_stack([block.design[0, k], block.error[0, k]])
        assert_allclose(Y.T @ inner @ Y, X.T @ P @ X, atol=1e-9)


@pytest.mark.parametrize("robust", [None, "huber"])
@pytest.mark.parametrize(("dof", "factor"), [(9.3, 1.7), (math.inf, 1.0)])
def test_a_solution_has_the_inverse_of_its_information_and_what_noise_makes_of_it(
    robust, dof, factor, monkeypatch
):
    # S = Σ A' (Σ + s² K (f²1 − ff') K')⁻¹ A, by dense matrices
    problem, _ = a_problem(sd=0.3, stated=4e-3, robust=robust)
    optimum = found_of(problem)
    S, K = np.zeros((12, 12)), optimum.state.theta.reshape(3, 4)[:, 1:]
    for force in optimum.point.force:
        J = K @ (0.98**2 * np.eye(3) - np.outer(force, force)) @ K.T
        A = np.kron(np.eye(3), np.append(1.0, force))
        S += A.T @ np.linalg.inv(16e-6 * np.eye(3) + math.radians(0.3) ** 2 * J) @ A
    weight = np.where(np.arange(20) == 7, 1e-12, 1.0)
    asked = replace(problem, weight=weight, precision=problem.precision * weight[:, None])
    given = SimpleNamespace(labels=tuple("abcdefghijklmnopqrst"), group=None, values=problem.values)
    seen = []
    monkeypatch.setattr(
        uncertain, "find_outlying_positions", lambda *those, **more: seen.append(those) or ()
    )
    fisher = FisherInformation(problem.plain, optimum.state, optimum.point)
    found = uncertain._solution(asked, optimum, fisher, given, 48.0, NoiseEstimate(factor, dof), 1)
    assert_allclose(found.covariance, factor * np.linalg.inv(S), rtol=1e-4, atol=1e-12)
    assert_allclose(found.inflation, math.sqrt(factor))
    assert_allclose(seen[0][0], optimum.point.q / weight / factor)
    assert seen[0][2] == (dof if robust else 48.0)
    sd = 4e-3 * (1.0 if robust else math.sqrt(factor))
    if not robust and math.isinf(dof):
        sd *= math.sqrt(optimum.point.objective / 48.0)
    assert_allclose(found.residual_sd, sd, rtol=1e-9)
    own = np.linspace(1.0, 3.0, 12) * 1e-3
    stated = uncertain._solution(
        asked, optimum, fisher, given, 48.0, NoiseEstimate(factor, dof, u=own), 1
    )
    formal = np.sqrt(np.diag(np.linalg.inv(S)))
    assert_allclose(np.sqrt(np.diag(stated.covariance)), own, rtol=1e-9)
    assert_allclose(stated.inflation, own / formal, rtol=1e-4)
    off = np.arccos(np.sum(problem.reference * optimum.point.force, axis=1) / 0.98**2)
    assert_allclose(found.orientations.orientation_error_deg, np.degrees(off), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("terms", ["linear", "1 + own"])
def test_correlated_outputs_are_fitted_as_one_problem(terms):
    """Generalised least squares of 27 readings; what is left is asked for more."""
    rng = np.random.default_rng(4)
    up = mp.read_scheme("fibonacci-9").up
    root = 1e-3 * rng.normal(size=(27, 40)) / math.sqrt(40.0)
    noise_of = root @ root.T
    y = up + (np.linalg.cholesky(noise_of) @ rng.normal(size=27)).reshape(9, 3)
    model = build_model(terms, ("a", "b", "c"), ("x", "y", "z"))
    given = mp.Readings(y, up=up, outputs=("a", "b", "c"), unit="g", covariance=noise_of)
    shared = known.share_design(model, up, {})
    found = known._solve_jointly(shared, y, given, False)
    X = np.zeros((27, len(model.names)))
    for i, (where, design) in enumerate(zip(model.slices, shared.designs, strict=True)):
        X[i::3, where] = design
    V = noise_of + np.diag(np.tile(found.excess.variance[0], 9))
    W = np.linalg.inv(V)
    C = np.linalg.inv(X.T @ W @ X)
    assert_allclose(found.parameters, C @ X.T @ W @ y.ravel(), atol=1e-9)
    assert_allclose(found.cofactor, C, rtol=1e-6, atol=1e-15)
    assert_allclose(found.residuals.ravel(), y.ravel() - X @ found.parameters, atol=1e-12)
    assert_allclose(found.sd.ravel(), np.sqrt(np.diag(V)))
    W = np.linalg.inv(noise_of)
    first = y.ravel() - X @ np.linalg.solve(X.T @ W @ X, X.T @ W @ y.ravel())
    assert found.chi2 == pytest.approx(first @ W @ first, rel=1e-6)
    moves = found.parameters - np.linalg.solve(X.T @ W @ X, X.T @ W @ y.ravel())
    u = found.excess.standard_uncertainty(moves[None], model.per_parameter(found.excess.dof))[0]
    assert_allclose(found.inflation, u / np.sqrt(np.diag(C)), rtol=1e-6)
    assert np.isfinite(found.dof).all()


def test_what_weights_make_of_outputs_of_one_design():
    rng = np.random.default_rng(6)
    up = mp.read_scheme("fibonacci-9").up
    model = build_model("linear", ("a", "b", "c"), ("x", "y", "z"))
    shared = known.share_design(model, up, {})
    (group,) = shared.groups
    X = shared.designs[0]
    y, variance = rng.normal(size=(3, 9)), rng.uniform(0.2, 3.0, (3, 9))
    variance[1] *= np.where(np.arange(9) == 4, 1e9, 1.0)  # too unlike for the short way
    plain = np.array([np.linalg.lstsq(X, each, rcond=None)[0] for each in y])
    b, r = known._weigh_group(shared, group, y, plain, y - plain @ X.T, variance)
    for own, left, values, v in zip(b, r, y, variance, strict=True):
        root = np.sqrt(v)
        wanted = np.linalg.lstsq(X / root[:, None], values / root, rcond=None)[0]
        assert_allclose(own, wanted, rtol=1e-7)
        assert_allclose(left, values - X @ wanted, atol=1e-7)


def test_which_weights_the_short_way_has_digits_for():
    worst = known._WORST
    variance = 0.2 * np.array([[1.0, 0.99 * worst, 3.0], [1.0, 1.01 * worst, 3.0]])
    for condition, fine in ((0.99 * worst, True), (1.01 * worst, False)):
        group = SimpleNamespace(condition=condition)
        assert known._are_regular(group, variance).tolist() == [fine, False]
        assert known._are_regular(group, 1e-9 * variance).tolist() == [fine, False]


@pytest.mark.parametrize(("near", "clear"), [(1e-7, True), (1e-9, False)])
def test_a_unit_is_clear_whatever_the_size_of_its_parameters(near, clear):
    """Two parameters with a correlation of 1 − near, of eigenvalues near and 2, in units of 10⁶."""
    scale = np.array([1e-6, 1e6])
    information = np.array([[1.0, 1.0 - near], [1.0 - near, 1.0]]) * np.outer(scale, scale)
    state, point = SimpleNamespace(theta=np.array([[0.5, 3.0]])), SimpleNamespace(q=np.full(4, 2.5))
    problem = SimpleNamespace(precision=np.full((4, 3), 1e6))
    units = SimpleNamespace(problem=problem, optimum=SimpleNamespace(state=state, point=point))
    shared = SimpleNamespace(model=SimpleNamespace(own_scales=(1,)), dof=9.0)
    U = np.array([[1.0, 1e-3]])
    found = uncertain_orientations._are_clear(shared, units, U, information[None])
    assert found.tolist() == [clear]


def test_outputs_beside_three_axes_are_not_compensated_by_steps():
    """A fourth output with a square: no steps of an inverse end at the force that acts."""
    model = build_model("1 + own + own^2", ("ax", "ay", "az", "a2"), ("x", "y", "z", "x"))
    theta = np.zeros((2, 4, len(model.basis_terms)))
    for column, term in enumerate(model.basis_terms):
        theta[:, :, column] = [str(term) == axis for axis in "xyzx"]
    force = np.eye(3)
    values = np.repeat(force[:, [0, 1, 2, 0]].T[:, None], 2, axis=1)
    left, inverted = batches.compensated(model, {}, force, theta, values, 0.0 * values)
    assert np.isnan(left).all()
    assert left.shape == (2, 3, 3)
    assert inverted.sound.tolist() == [False, False]


def test_units_of_a_model_of_ones_own_end_at_the_least_squares():
    """b + s f/(1 + k f²) of three units by SciPy's search: parameters, u, rms of what is left."""
    up = mp.read_scheme("fibonacci-24").up
    rng = np.random.default_rng(3)
    values = 0.01 + 1.1 * up / (1.0 + 0.2 * up**2) + 2e-3 * rng.standard_normal((3, 24, 3))
    one = exactly(mp.Readings(values[0], up=up), model="each = b + s*own/(1 + k*own^2)")
    shared = user_models.share_expression(one)
    found = user_models.estimate_expression(shared, list(np.moveaxis(values[1:], 2, 0)))
    assert found.sound.all()
    for unit, y in enumerate(values[1:]):
        for i, places in enumerate(one.model.places):
            names = [one.model.names[place][0] for place in places]
            f = up[:, i]

            def left(p, names=names, f=f, y=y[:, i]):
                q = dict(zip(names, p, strict=True))
                return q["b"] + q["s"] * f / (1.0 + q["k"] * f**2) - y

            best = least_squares(left, [{"b": 0.0, "s": 1.0, "k": 0.1}[name] for name in names],
                                 xtol=1e-14, ftol=1e-14, gtol=1e-14)  # fmt: skip
            assert_allclose(found.parameters[unit, places], best.x, rtol=1e-5, atol=1e-8)
            variance = 2.0 * best.cost / 21.0
            u = np.sqrt(variance * np.diag(np.linalg.inv(best.jac.T @ best.jac)))
            assert_allclose(found.u[unit, places], u, rtol=1e-4)
            assert_allclose(found.residuals[i, unit], -best.fun, atol=1e-7)
    assert (found.dof == 21.0).all()


def test_shared_unknowns_are_eliminated_whatever_their_units():
    """1 − (5e-4)²/1e-6 = .75, beside an unknown whose information is 1e24 times as large."""
    full = np.array([[1.0, 0.0, 5e-4], [0.0, 1e18, 0.0], [5e-4, 0.0, 1e-6]])
    assert reduced_information(full, 1) == pytest.approx(0.75)
    full[2] = full[:, 2] = 0.0  # nothing is known of it, and it takes nothing
    assert reduced_information(full, 1) == pytest.approx(1.0)
