"""Least squares against certified digits, exact rational arithmetic and itself."""

import math
from fractions import Fraction

import nist
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nist import digits
from numpy.testing import assert_allclose

from multipos.errors import MultiposError, RankError
from multipos.numerics import factoring, least_squares
from multipos.numerics.least_squares import factor_alike, solve
from multipos.numerics.separability import name_combinations, separability

EPS = 2.0**-53  # relative error of one rounding


# --- NIST StRD

ORDERS = 22  # of the rows: as published, reversed, and twenty at random


def orders(n):
    rng = np.random.default_rng(20)
    yield np.arange(n)
    yield np.arange(n)[::-1]
    for _ in range(ORDERS - 2):
        yield rng.permutation(n)


@pytest.mark.parametrize("data", nist.DATASETS, ids=str)
def test_data_are_typed_as_published(data):
    X, y = data.exact()
    b, C, rss = exact_least_squares(X, y)
    variance = rss / (len(y) - len(b))
    intercept = data.powers is None or 0 in data.powers
    mean = sum(y) / len(y) if intercept else 0
    r_squared = 1 - rss / sum((value - mean) ** 2 for value in y)
    # fifteen digits printed, and one rounding in each of the few steps that leave the rationals
    assert_allclose([float(v) for v in b], data.coefficients, rtol=6e-15)
    sd = [math.sqrt(C[j][j] * variance) for j in range(len(b))]
    assert_allclose(sd, data.sd, rtol=6e-15)
    assert_allclose(math.sqrt(variance), data.residual_sd, rtol=6e-15)
    assert_allclose(float(r_squared), data.r_squared, rtol=6e-15)


@pytest.mark.parametrize("data", nist.DATASETS, ids=str)
def test_certified_digits_in_any_order_of_the_rows(data):
    for order in orders(len(data.response)):
        X, y = data.design[order], data.response[order]
        fit = solve(X, y)
        assert digits(fit.coefficients, data.coefficients) >= data.digits
        s = math.sqrt(fit.rss / fit.dof)
        sd = s * np.sqrt(np.diag(fit.cofactor))
        if data.residual_sd > 0.0:
            assert digits(s, data.residual_sd) >= data.digits_sd
            assert digits(sd, data.sd) >= data.digits_sd
        else:
            # Certified zero. The columns are integers and exact; the response is rounded when it
            # is read, by ε |y| a row at most, and residuals are a projection of that.
            bound = EPS * float(np.linalg.norm(y)) / math.sqrt(fit.dof)
            assert s <= bound
            assert (sd <= bound * np.sqrt(np.diag(fit.cofactor))).all()
        if data.powers is None or 0 in data.powers:
            total = float(((y - y.mean()) ** 2).sum())
        else:
            total = float((y**2).sum())
        # R² is 1 − rss/total: the certified sd carries over, the rest is rounding of the sums
        assert 1.0 - fit.rss / total == pytest.approx(data.r_squared, rel=1e-9)


@pytest.mark.parametrize("data", nist.DATASETS, ids=str)
def test_coefficients_are_those_of_the_doubles_given(data):
    """What is lost to the certified digits is lost where decimals and powers become doubles."""
    X, y = data.design, data.response
    exact = [float(v) for v in exact_least_squares(fractions(X), fractions(y))[0]]
    for order in orders(len(y)):
        fit = solve(X[order], y[order])
        assert_allclose(fit.coefficients, exact, rtol=2 * EPS, atol=0)


@pytest.mark.parametrize("data", [nist.FILIP, nist.LONGLEY, nist.WAMPLER5], ids=str)
def test_refinement_beats_plain_qr(data):
    # eq. (3) of numerics.least_squares
    X, y = data.design, data.response
    exact = [float(v) for v in exact_least_squares(fractions(X), fractions(y))[0]]
    plain = []
    for order in orders(len(y)):
        Q, R = np.linalg.qr(X[order])
        plain.append(digits(np.linalg.solve(R, Q.T @ y[order]), exact))
    assert min(plain) < 11.0
    assert digits(solve(X, y).coefficients, exact) > 15.0


# --- exact rational arithmetic


def hilbert(n, p):
    return np.array([[1.0 / (i + j + 1) for j in range(p)] for i in range(n)])


VARIANCES = np.array([0.5, 3.0, 1e-3, 40.0, 0.1, 2.0, 7.0, 1e-2, 5.0, 0.3])
FULL = np.diag(np.arange(2.0, 12.0)) + 0.5 * np.eye(10, k=1) + 0.5 * np.eye(10, k=-1) + 0.25


@pytest.mark.parametrize("p", [3, 5, 8])  # conditions 2e2, 5e4 and 2e9
@pytest.mark.parametrize("covariance", [None, VARIANCES, FULL], ids=["unit", "variances", "full"])
def test_coefficients_and_cofactor_against_exact_arithmetic(p, covariance):
    # eqs. (1), (2) of numerics.least_squares
    n = 10
    X = hilbert(n, p)
    y = np.array([1.0, -2.0, 3.0, 0.5, -1.0, 2.0, -4.0, 1.5, 0.25, 7.0])
    V = np.eye(n) if covariance is None else np.diag(covariance) if covariance.ndim == 1 else FULL
    fit = solve(X, y, covariance=covariance)
    b, C, rss = exact_least_squares(fractions(X), fractions(y), fractions(V))
    assert_allclose(fit.coefficients, [float(v) for v in b], rtol=4 * EPS)
    # The cofactor is refined above a condition of 1e6 to some p roundings; below it loses κ ε.
    lost = 1.0 if fit.condition > 1e6 else fit.condition
    exact = np.array([[float(v) for v in row] for row in C])
    assert_allclose(fit.cofactor, exact, rtol=10 * p * EPS * lost, atol=0)
    # residuals are refined with the coefficients; their squares sum without cancellation
    assert fit.rss == pytest.approx(float(rss), rel=1e-13)
    exact_residuals = [
        float(value - sum(x * c for x, c in zip(row, b, strict=True)))
        for row, value in zip(fractions(X), fractions(y), strict=True)
    ]
    assert_allclose(fit.residuals, exact_residuals, rtol=1e-13, atol=1e-14)
    assert fit.dof == n - p
    assert fit.leverage.sum() == pytest.approx(p, rel=1e-13)
    assert ((fit.leverage >= 0.0) & (fit.leverage <= 1.0 + 1e-14)).all()


def exact_least_squares(X, y, V=None):
    """Coefficients, cofactor and rss of fractions, by the normal equations."""
    n, p = len(X), len(X[0])
    W = None if V is None else exact_inverse(V)
    WX = X if W is None else exact_product(W, X)
    A = [[sum(X[i][j] * WX[i][k] for i in range(n)) for k in range(p)] for j in range(p)]
    C = exact_inverse(A)
    z = [sum(WX[i][j] * y[i] for i in range(n)) for j in range(p)]
    b = [sum(C[j][k] * z[k] for k in range(p)) for j in range(p)]
    r = [y[i] - sum(X[i][j] * b[j] for j in range(p)) for i in range(n)]
    Wr = r if W is None else [sum(W[i][k] * r[k] for k in range(n)) for i in range(n)]
    return b, C, sum(u * v for u, v in zip(r, Wr, strict=True))


def exact_product(A, B):
    columns = list(zip(*B, strict=True))
    return [[sum(a * b for a, b in zip(row, c, strict=True)) for c in columns] for row in A]


def exact_inverse(A):
    n = len(A)
    M = [[*row, *(Fraction(int(i == j)) for j in range(n))] for i, row in enumerate(A)]
    for c in range(n):
        pivot = next(i for i in range(c, n) if M[i][c] != 0)
        M[c], M[pivot] = M[pivot], M[c]
        M[c] = [v / M[c][c] for v in M[c]]
        for i in range(n):
            if i != c and M[i][c] != 0:
                M[i] = [a - M[i][c] * b for a, b in zip(M[i], M[c], strict=True)]
    return [row[n:] for row in M]


def exact_rank(A):
    M, rank = [list(row) for row in A], 0
    for c in range(len(M[0])):
        pivot = next((i for i in range(rank, len(M)) if M[i][c] != 0), None)
        if pivot is None:
            continue
        M[rank], M[pivot] = M[pivot], M[rank]
        for i in range(rank + 1, len(M)):
            factor = M[i][c] / M[rank][c]
            M[i] = [a - factor * b for a, b in zip(M[i], M[rank], strict=True)]
        rank += 1
    return rank


def fractions(a):
    return np.vectorize(Fraction, otypes=[object])(a).tolist()


# --- two routes must meet


def problem(n=30, p=4, k=1, seed=0):
    rng = np.random.default_rng(seed)
    X, y = rng.standard_normal((n, p)), rng.standard_normal((n, k))
    return X, y[:, 0] if k == 1 else y


def test_variance_is_repetition():
    X, y = problem(8, 3)
    times = np.array([1, 2, 5, 1, 3, 1, 1, 4])
    weighted = solve(X, y, covariance=1.0 / times)
    repeated = solve(np.repeat(X, times, axis=0), np.repeat(y, times))
    # a fifth is not a double: the variances differ by ε, and so may everything
    assert_allclose(weighted.coefficients, repeated.coefficients, rtol=1e-14)
    assert_allclose(weighted.cofactor, repeated.cofactor, rtol=1e-13, atol=1e-15)
    assert weighted.rss == pytest.approx(repeated.rss, rel=1e-13)
    assert repeated.dof - weighted.dof == times.sum() - len(times)
    shares = np.add.reduceat(repeated.leverage, np.r_[0, times.cumsum()[:-1]])
    assert_allclose(weighted.leverage, shares, rtol=1e-13)


def test_full_covariance_is_whitening_by_hand():
    X, y = problem(12, 4, k=2)
    A = np.random.default_rng(1).standard_normal((12, 12))
    V = A @ A.T + np.eye(12)
    L = np.linalg.cholesky(V)
    direct = solve(X, y, covariance=V)
    whitened = solve(np.linalg.solve(L, X), np.linalg.solve(L, y))
    # the hand-whitened rows are rounded at κ(L) ε, some 1e-14
    assert_allclose(direct.coefficients, whitened.coefficients, rtol=1e-12)
    assert_allclose(direct.cofactor, whitened.cofactor, rtol=1e-12)
    assert_allclose(direct.residuals, L @ whitened.residuals, rtol=1e-11, atol=1e-13)
    assert_allclose(direct.rss, whitened.rss, rtol=1e-12)
    assert_allclose(direct.leverage, whitened.leverage, rtol=1e-12)
    assert direct.condition == pytest.approx(whitened.condition, rel=1e-12)


def test_diagonal_covariance_is_variances():
    X, y = problem(10, 3)
    a = solve(X, y, covariance=VARIANCES)
    b = solve(X, y, covariance=np.diag(VARIANCES))
    assert_allclose(a.coefficients, b.coefficients, rtol=4 * EPS)
    assert_allclose(a.cofactor, b.cofactor, rtol=1e-13)
    assert_allclose(a.residuals, b.residuals, rtol=1e-13)


def test_responses_are_fitted_one_by_one():
    X, Y = problem(20, 5, k=3)
    together = solve(X, Y)
    assert together.coefficients.shape == (5, 3)
    assert together.residuals.shape == (20, 3)
    for j in range(3):
        alone = solve(X, Y[:, j])
        assert isinstance(alone.rss, float)
        assert_allclose(together.coefficients[:, j], alone.coefficients, rtol=4 * EPS)
        assert_allclose(together.residuals[:, j], alone.residuals, rtol=1e-14, atol=1e-15)
        assert together.rss[j] == pytest.approx(alone.rss, rel=1e-14)


def test_alike_problems_are_factored_as_each_alone():
    """One is so badly conditioned that its cofactor takes twice the digits."""
    rng = np.random.default_rng(7)
    hard = rng.uniform(-8.8, -3.1, (20, 1)) ** np.arange(9)
    designs = np.array([rng.standard_normal((20, 9)), hard, rng.standard_normal((20, 9))])
    together = factor_alike(designs, names=[None] * 3)
    for i, design in enumerate(designs):
        alone = solve(design, rng.standard_normal(20))
        assert_allclose(together.cofactors[i], alone.cofactor, rtol=1e-13)
        assert_allclose(together.leverage[i], alone.leverage, rtol=1e-9)  # Q loses κε, κ is 1e9
        assert together.conditions[i] == pytest.approx(alone.condition, rel=1e-6)
    assert together.conditions[1] > 1e6 > together.conditions[0]


def test_of_alike_problems_the_first_that_cannot_be_solved_is_named():
    sound = np.column_stack([np.ones(4), np.arange(4.0)])
    designs = np.array([sound, np.ones((4, 2)), np.ones((4, 2))])
    names = [("a", "b"), ("p", "q"), ("r", "s")]
    with pytest.raises(RankError, match="p") as caught:
        factor_alike(designs, names=names)
    assert caught.value.problem == 1
    with pytest.raises(MultiposError, match=r"\(n, p\) with p > 0, got \(4, 0\)"):
        factor_alike(np.ones((3, 4, 0)), names=[()] * 3)


@pytest.mark.parametrize("covariance", [False, True])
def test_blocks_of_rows_change_nothing(monkeypatch, covariance):
    """One QR, and several levels of blocks, on a design hard enough for both refinements."""
    rng = np.random.default_rng(5)
    X = rng.uniform(-8.8, -3.1, (700, 1)) ** np.arange(9)
    y = rng.standard_normal(700)
    v = rng.uniform(0.5, 2.0, 700) if covariance else None
    whole = solve(X, y, covariance=v)
    assert whole.condition > 1e6
    for module in (factoring, least_squares):
        monkeypatch.setattr(module, "BLOCK", 200)  # 22 rows of 9
    blocks = solve(X, y, covariance=v)
    assert_allclose(blocks.coefficients, whole.coefficients, rtol=4 * EPS)
    assert_allclose(blocks.cofactor, whole.cofactor, rtol=1e-13)
    assert_allclose(blocks.leverage, whole.leverage, atol=1e-13)
    assert blocks.condition == pytest.approx(whole.condition, rel=1e-5)  # κ ε of the smallest


@given(seed=st.integers(0, 10**6), n=st.integers(6, 40), p=st.integers(1, 6))
def test_order_of_rows_does_not_matter(seed, n, p):
    X, y = problem(n, p, seed=seed)
    order = np.random.default_rng(seed).permutation(n)
    a, b = solve(X, y), solve(X[order], y[order])
    # both are the exact answer, rounded to an ulp of the largest coefficient or better
    size = np.abs(a.coefficients).max()
    assert_allclose(a.coefficients, b.coefficients, rtol=0, atol=4 * EPS * size)
    assert_allclose(a.residuals[order], b.residuals, rtol=0, atol=1e-14 * np.abs(y).max())
    assert_allclose(a.leverage[order], b.leverage, rtol=0, atol=1e-13)


@given(seed=st.integers(0, 10**6), powers=st.lists(st.integers(-12, 12), min_size=4, max_size=4))
def test_units_of_columns_do_not_matter(seed, powers):
    X, y = problem(seed=seed)
    unit = 10.0 ** np.array(powers)
    a, b = solve(X, y), solve(X * unit, y)
    # κ of some 2: scaling rounds the columns by ε, the coefficients move by a few ε of the largest
    size = np.abs(a.coefficients).max()
    assert_allclose(b.coefficients * unit, a.coefficients, rtol=0, atol=40 * EPS * size)
    assert b.condition == pytest.approx(a.condition, rel=1e-12)


@given(seed=st.integers(0, 10**6), n=st.integers(5, 30))
def test_residuals_are_orthogonal_and_leverages_sum(seed, n):
    X, y = problem(n, 4, seed=seed)
    fit = solve(X, y)
    assert_allclose(X.T @ fit.residuals, 0.0, atol=1e-13 * np.abs(X).max() * np.abs(y).sum())
    assert fit.leverage.sum() == pytest.approx(4.0, rel=1e-13)
    assert_allclose(fit.residuals, y - X @ fit.coefficients, atol=1e-12 * np.abs(y).max())


def test_response_of_zeros_and_exact_fit():
    X, _ = problem(6, 3)
    fit = solve(X, np.zeros(6))
    assert not fit.coefficients.any()
    assert fit.rss == 0.0
    square = solve(np.diag([1.0, 2.0, 4.0]), [1.0, 1.0, 1.0])
    assert square.dof == 0
    assert square.rss == 0.0
    assert_allclose(square.coefficients, [1.0, 0.5, 0.25], rtol=0, atol=0)
    assert_allclose(square.leverage, 1.0, rtol=4 * EPS)


def test_input_is_left_alone():
    X, y = problem(10, 3)
    before = X.copy(), y.copy()
    X.setflags(write=False)
    y.setflags(write=False)
    solve(X, y, covariance=np.ones(10))
    assert_allclose(X, before[0], rtol=0, atol=0)
    assert_allclose(y, before[1], rtol=0, atol=0)


# --- rank

SPHERE = ("bias_ax", "scale_ax", "square_ax_x", "square_ax_y", "square_ax_z")


def sphere(n=20):
    u = np.random.default_rng(7).standard_normal((n, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return np.column_stack((np.ones(n), u[:, 0], u**2))


def test_bias_and_squares_on_the_sphere():
    with pytest.raises(RankError) as caught:
        solve(sphere(), np.zeros(20), names=SPHERE, least_norm=1e-9)
    sentence = "`bias_ax` cannot be separated from `square_ax_x + square_ax_y + square_ax_z`"
    assert caught.value.combinations == (sentence,)
    assert (caught.value.rank, caught.value.parameters) == (4, 5)
    assert str(caught.value) == (
        f"4 of 5 parameters can be separated: {sentence}. "
        "Add positions that separate them, or drop a term."
    )


@pytest.mark.parametrize("covariance", ["variances", "full"])
def test_weights_do_not_hide_a_dependence(covariance):
    rng = np.random.default_rng(2)
    sd = 10.0 ** rng.uniform(-4, 4, 20)
    A = rng.standard_normal((20, 20)) * sd
    V = sd**2 if covariance == "variances" else A @ A.T + np.diag(sd**2)
    found = separability(sphere(), covariance=V)
    assert found.rank == 4
    assert found.condition == np.inf
    with pytest.raises(RankError, match="`bias_ax` cannot be separated from"):
        solve(sphere(), np.zeros(20), covariance=V, names=SPHERE)


def test_column_of_rounding_is_zero_below_the_floor():
    angle = np.deg2rad(np.arange(0, 360, 30))
    X = np.column_stack((np.ones(12), np.cos(angle), np.full(12, np.cos(np.pi / 2))))
    X[::2, 2] *= -1.0
    assert separability(X).rank == 3
    with pytest.raises(RankError, match="`cross_ax_z` has no effect at these positions") as caught:
        solve(X, np.zeros(12), least_norm=1e-9, names=("bias_ax", "scale_ax", "cross_ax_z"))
    assert caught.value.rank == 2
    # the floor is for the column as given: the weights have no say
    with pytest.raises(RankError, match="no effect"):
        solve(X, np.zeros(12), least_norm=1e-9, covariance=np.full(12, 1e-30))


def test_floor_spares_what_is_above_it():
    X, y = problem(10, 2)
    X[:, 1] *= 2e-9 / np.linalg.norm(X[:, 1])
    assert solve(X, y, least_norm=1e-9).dof == 8


@pytest.mark.parametrize("unit", [1.0, 1e-12, 1e12])
def test_dependences_are_named_in_the_units_of_the_coefficients(unit):
    rng = np.random.default_rng(4)
    a, b = rng.standard_normal((2, 15))
    X = np.column_stack((a, b, unit * (2.5 * a - b)))
    found = separability(X)
    assert found.rank == 2
    assert_allclose(found.null[:, 0], [-2.5 * unit, unit, 1.0], rtol=1e-12)
    assert (
        name_combinations(found.null, "abc")[0]
        in {
            1.0: ("`a` cannot be separated from `0.4 b + 0.4 c`",),
            1e-12: ("`a` cannot be separated from `0.4 b + 4e+11 c`",),
            1e12: ("`a` cannot be separated from `0.4 b + 4e-13 c`",),
        }[unit]
    )


def test_several_dependences_are_told_apart():
    rng = np.random.default_rng(4)
    a, b = rng.standard_normal((2, 15))
    found = separability(np.column_stack((a, b, a, np.zeros(15), -b, a)))
    assert found.rank == 2
    assert set(name_combinations(found.null, "abcdef")) == {
        "`a` cannot be separated from `c`",
        "`a` cannot be separated from `f`",
        "`d` has no effect at these positions",
        "`b` cannot be separated from `-e`",
    }


def test_a_message_names_three_dependences():
    a, b = np.random.default_rng(4).standard_normal((2, 15))
    with pytest.raises(RankError, match=r"; and 1 more\. Add positions") as caught:
        solve(np.column_stack((a, b, a, np.zeros(15), -b, a)), a)
    assert len(caught.value.combinations) == 4


def test_names_say_what_rows_are():
    with pytest.raises(RankError, match="`column 2` has no effect at these readings") as caught:
        solve(np.eye(3)[:, :2] * [1.0, 0.0], np.zeros(3), rows="readings")
    assert "Add readings" in str(caught.value)


def test_too_few_rows():
    with pytest.raises(RankError, match="6 readings cannot determine 7 terms"):
        solve(np.ones((6, 7)), np.ones(6))
    X = np.random.default_rng(0).standard_normal((3, 5))
    found = separability(X)
    assert (found.rank, found.null.shape) == (3, (5, 2))
    assert_allclose(X @ found.null, 0.0, atol=1e-13)


def test_full_rank_has_no_null():
    X, y = problem(9, 3)
    found = separability(X)
    assert (found.rank, found.parameters, found.null.shape) == (3, 3, (3, 0))
    assert found.condition == pytest.approx(solve(X, y).condition, rel=1e-14)
    assert name_combinations(found.null, "abc") == ()


def test_filip_is_of_full_rank_and_an_exact_duplicate_is_not():
    X = nist.FILIP.design
    assert separability(X).rank == 11
    assert separability(np.column_stack((X, X[:, 3]))).rank == 11
    assert separability(np.column_stack((X, 1e-8 * X[:, 3] + 7.0 * X[:, 9]))).rank == 11


@given(st.integers(0, 10**6), st.integers(1, 8), st.integers(1, 6), st.integers(1, 6))
def test_rank_of_integer_matrices_is_exact(seed, n, p, inner):
    rng = np.random.default_rng(seed)
    X = rng.integers(-3, 4, (n, inner)) @ rng.integers(-3, 4, (inner, p)) * 1.0
    found = separability(X)
    assert found.rank == exact_rank(fractions(X))
    assert found.null.shape == (p, p - found.rank)
    assert_allclose(X @ found.null, 0.0, atol=1e-11 * (1.0 + np.abs(found.null).max(initial=0.0)))
    assert np.linalg.matrix_rank(found.null) == p - found.rank if found.null.size else True


# --- bad input


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"design": np.ones(5)}, ValueError, r"`design` must have shape \(n, p\)"),
        ({"design": [[np.nan]] * 5}, MultiposError, "`design` has a number that is not finite"),
        ({"response": [1, 2, 3, 4, np.inf]}, MultiposError, "`response` has a number that is not"),
        ({"response": np.ones(4)}, ValueError, r"one row per row of `design`: 5, got \(4,\)"),
        ({"covariance": np.ones(4)}, ValueError, r"shape \(5,\) or \(5, 5\), got \(4,\)"),
        ({"covariance": [1, 1, 0, 1, 1]}, MultiposError, "positive and finite in every row"),
        ({"covariance": [1, 1, np.nan, 1, 1]}, MultiposError, "positive and finite in every row"),
        ({"covariance": np.tri(5)}, MultiposError, "symmetric"),
        ({"covariance": np.full((5, 5), np.nan)}, MultiposError, "symmetric and finite"),
        ({"covariance": -np.eye(5)}, MultiposError, "positive definite"),
    ],
)
def test_bad_input_is_said(changes, error, message):
    arguments = {"design": np.ones((5, 1)), "response": np.arange(5.0), "covariance": None}
    arguments |= changes
    with pytest.raises(error, match=message):
        solve(arguments["design"], arguments["response"], covariance=arguments["covariance"])


# --- variances compared
