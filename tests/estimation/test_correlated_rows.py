"""Rows that are correlated in time: the algebra by dense matrices, coverage on noise made here."""

import math

import numpy as np
import pytest
from amounts import exactly
from numpy.testing import assert_allclose
from scipy import stats

import multipos as mp
from multipos.estimation import correlated_rows
from multipos.estimation.correlated_rows import half_of_mixture, spread_in_time

FACES = mp.read_scheme("faces-6").up
SD = 1e-3  # [g]


def record(rng, correlation, *, up=FACES, rows=30):
    """Return readings of a perfect triad, many rows a position, and their directions."""
    n = rows * len(up)
    noise = rng.standard_normal((n, 3))
    for k in range(1, n):
        noise[k] = correlation * noise[k - 1] + math.sqrt(1.0 - correlation**2) * noise[k]
    where = np.repeat(up, rows, axis=0)
    return mp.Readings(where + SD * noise, up=where)


def test_likelihood_and_covariance_against_dense_matrices():
    """Every node beside ln det, the residual and B R B' of a covariance written out in full."""
    # eqs. (2), (3), (5) of estimation.correlated_rows
    rng = np.random.default_rng(3)
    n, p = 30, 3
    X, e = rng.standard_normal((n, p)), rng.standard_normal(n)
    Q = np.linalg.qr(X)[0]
    e -= Q @ (Q.T @ e)
    gains = X @ np.linalg.inv(X.T @ X)
    logs, variances, of_row = correlated_rows._at_nodes(Q, e, gains)
    lag = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    expected = []
    for rho in 1.0 - np.geomspace(0.9, 0.4 / n, 12):
        for theta in rho * np.array(correlated_rows._SHARES):
            r = 1.0 + (rho - theta) ** 2 / (1.0 - rho**2)  # the sum of squared weights of w
            # ψ_0 ψ_l + Σ ψ_j ψ_j+l with ψ_j = (ρ − θ) ρ^(j−1)
            beside = (rho - theta) * rho ** (lag - 1.0)
            beside += (rho - theta) ** 2 * rho**lag / (1.0 - rho**2)
            V = np.where(lag == 0, r, beside)
            inverse = np.linalg.inv(V)
            inside = np.linalg.inv(Q.T @ inverse @ Q)
            left = e @ inverse @ e - e @ inverse @ Q @ inside @ Q.T @ inverse @ e
            log = -0.5 * np.linalg.slogdet(V)[1] + 0.5 * np.linalg.slogdet(inside)[1]
            s2 = left / (n - p - 2.0)
            whole = log - (n - p) / 2.0 * math.log(left) + 0.5 * math.log(1.0 - rho)
            expected.append((whole, *(s2 * np.diag(gains.T @ V @ gains)), s2 * r))
    found = np.column_stack([logs, variances, of_row])
    slow = np.arange(len(found)) % len(correlated_rows._SHARES) == 0  # θ = 0, filtered exactly
    # fifteen digits less a condition of 1e4: 1 − ρ is .01 at the last nodes
    assert_allclose(found[slow], np.array(expected)[slow], rtol=1e-9, atol=1e-9)
    # elsewhere the filter forgets its start: some of thirty rows, a hundredth of a variance
    assert_allclose(found[:, 1:], np.array(expected)[:, 1:], rtol=0.01)
    assert_allclose(found[:, 0], np.array(expected)[:, 0], rtol=0, atol=0.5)


def test_independent_rows_keep_what_they_had():
    """Once in a hundred outputs rows are called correlated; elsewhere u is s √(X'X)⁻¹."""
    rng = np.random.default_rng(5)
    found = 0
    for _ in range(40):
        data = record(rng, 0.0)
        cal = mp.fit(data)
        if cal.effective_rows:
            found += 1
            continue
        H = np.column_stack([np.ones(len(data)), data.up])
        u = cal.residual_sd[0] * np.sqrt(np.diag(np.linalg.inv(H.T @ H)))
        assert_allclose(cal.u[:4], u, rtol=1e-9)
        assert (cal.dof == len(data) - 4).all()
    assert found <= 5  # of a mean of 1.2, with a chance of .001


@pytest.mark.parametrize("correlation", [0.5, 0.9])
def test_u_covers_where_neighbours_are_alike(correlation):
    """Of 20 records of three outputs; independent rows would cover 75 and 35 % of the biases."""
    rng = np.random.default_rng(7)
    held, before = [], []
    for _ in range(20):
        data = record(rng, correlation)
        with pytest.warns(mp.CalibrationWarning, match="neighbouring rows"):
            cal = mp.fit(data)
        error = np.abs(cal.parameters - np.eye(3, 4, 1).ravel())
        held.append(error <= cal.U)
        before.append(error <= 1.96 * np.tile(cal.residual_sd[0] / math.sqrt(len(data)), 12))
    # 60 biases of which 95 % are held: fewer than 87 % once in a hundred such tests
    assert np.mean(held, axis=0)[[0, 4, 8]].mean() >= 0.87
    assert np.mean(held) >= 0.9
    assert np.mean(before, axis=0)[[0, 4, 8]].mean() < 0.87


def test_how_many_rows_they_are_worth_is_said_and_kept(tmp_path):
    cal = mp.fit(record(np.random.default_rng(11), 0.5, rows=200))
    rows = cal.effective_rows
    # a correlation ρ leaves (1 − ρ)/(1 + ρ) of the rows: 400 of 1200, to a quarter
    assert rows == pytest.approx(dict.fromkeys(cal.outputs, 400.0), rel=0.25)
    finding = next(d for d in cal.diagnostics.findings if d.code == "time-correlated")
    assert finding.outputs == cal.outputs
    said = f"1200 rows equal fewer independent ones (ax {rows['ax']:.2g}"
    assert said in finding.text
    cal.save(tmp_path / "cal.json")
    again = mp.load(tmp_path / "cal.json")
    assert again.variance_components == cal.variance_components
    assert again.diagnostics.findings == cal.diagnostics.findings


def test_no_term_is_asked_for_because_rows_are_alike():
    rng = np.random.default_rng(13)
    data = record(rng, 0.9, up=mp.read_scheme("icosahedron-12").up, rows=40)
    codes = {finding.code for finding in mp.fit(data).diagnostics.findings}
    assert "time-correlated" in codes
    assert not codes & {"missing-term", "lack-of-fit"}


def test_a_misplaced_position_is_no_correlation():
    """Rows of one position share its error: that is told by their repeats, and not here."""
    rng = np.random.default_rng(17)
    data = record(rng, 0.0)
    off = np.repeat(3e-3 * rng.standard_normal((6, 3)), 30, axis=0)
    cal = mp.fit(mp.Readings(data.values + off, up=data.up))
    assert not cal.effective_rows
    assert "lack-of-fit" in {finding.code for finding in cal.diagnostics.findings}


def test_unknown_orientation_is_judged_by_its_misfit():
    rng = np.random.default_rng(19)
    up = mp.read_scheme("dodecahedron-20").up
    data = record(rng, 0.9, up=up, rows=20)
    cal = mp.fit(mp.Readings(data.values), unknown_orientation=True)
    assert len(set(cal.effective_rows.values())) == 1
    assert cal.effective_rows["ax"] < 200.0  # of 400
    assert cal.dof.max() < 390.0
    plain = mp.fit(mp.Readings(record(rng, 0.0, up=up, rows=20).values), unknown_orientation=True)
    assert plain.effective_rows is None


def test_rounding_is_no_noise():
    """Rows of a perfect triad, and rows that repeat to the last digit."""
    up = np.repeat(mp.read_scheme("icosahedron-12").up, 20, axis=0)
    assert mp.fit(mp.Readings(up.copy(), up=up)).effective_rows is None
    bent = up + np.repeat(1e-3 * np.random.default_rng(1).standard_normal((12, 3)), 20, axis=0)
    assert mp.fit(mp.Readings(bent, up=up)).effective_rows is None


def test_sums_of_neighbours_are_rejected_as_often_as_chance_says():
    """Two thousand records of independent rows, three a position; and of rows that are alike."""
    # eq. (1) of estimation.correlated_rows
    rng = np.random.default_rng(9)
    place = np.repeat(np.arange(20), 24)
    rows = rng.standard_normal((2000, 480))
    within = rows - rows.reshape(2000, 20, 24).mean(axis=2).repeat(24, axis=1)
    said = correlated_rows._are_beyond_chance(within, place, 460.0)
    level = correlated_rows._LEVEL
    assert abs(said.mean() - level) < 0.5 * level + 3.0 * math.sqrt(level / 2000)
    rows[:, 1:] += 0.8 * rows[:, :-1]
    within = rows - rows.reshape(2000, 20, 24).mean(axis=2).repeat(24, axis=1)
    assert correlated_rows._are_beyond_chance(within, place, 460.0).mean() > 0.9
    # by hand: runs of four of rows at places 0 0 1 1 1 0, of which three and three
    met = np.array([0, 0, 1, 1, 1, 0])
    by_hand = (2**2 + 2**2) / 3 + (1 + 1) / 3
    assert correlated_rows._of_means(met, 4, np.array([1 / 3, 1 / 3])) == pytest.approx(by_hand)


def test_the_effective_number_of_rows_by_dense_matrices():
    # eq. (4) of estimation.correlated_rows
    rng = np.random.default_rng(5)
    n = 40
    design = np.column_stack([np.ones(n), rng.standard_normal(n)])
    noise = rng.standard_normal(n)
    for k in range(1, n):
        noise[k] += 0.7 * noise[k - 1]
    Q = np.linalg.qr(design)[0]
    e = noise - Q @ (Q.T @ noise)
    logs, _, _ = correlated_rows._at_nodes(Q, e, np.full((n, 1), 1.0 / n))
    p = np.exp(logs - logs.max())
    lag = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    total = []
    for rho in 1.0 - np.geomspace(0.9, 0.4 / n, 12):
        for theta in rho * np.array(correlated_rows._SHARES):
            # θ = 0 to 1 of AR(1) beside white noise: r_k/r_0 = c ρ^k
            r = (1.0 - 2.0 * rho * theta + theta**2) / (1.0 - rho**2)
            c = (1.0 - rho * theta) * (rho - theta) / (rho * r * (1.0 - rho**2))
            R = np.where(lag == 0, 1.0, c * rho**lag)
            total.append(n**2 / R.sum())
    expected = float(p @ total / p.sum())
    assert correlated_rows._judge(design, e).rows == pytest.approx(expected, rel=0.01)
    assert 4.0 < expected < 20.0


def test_rows_in_order_of_time_count_as_fewer_where_noise_is_slow():
    """AR(.95) at 24 known positions: less than half of them; exact readings keep all."""
    rng = np.random.default_rng(3)
    up = mp.read_scheme("fibonacci-24").up[rng.permutation(24)]
    noise = rng.standard_normal((24, 3))
    for k in range(1, 24):
        noise[k] = 0.95 * noise[k - 1] + math.sqrt(1.0 - 0.95**2) * noise[k]
    columns = {f"up_{axis}": up[:, i] for i, axis in enumerate("xyz")}
    columns |= {"time": np.arange(24.0)}
    for sd, fewer in ((1e-3, True), (0.0, False)):
        readings = {f"a{axis}": up[:, i] + sd * noise[:, i] for i, axis in enumerate("xyz")}
        cal = exactly({**columns, **readings}, outputs=["ax", "ay", "az"], unit="g")
        assert bool(cal.effective_rows) == fewer
        assert all(rows < 12.0 for rows in (cal.effective_rows or {}).values())


def test_correlation_in_time_by_dense_matrices():
    """Restricted likelihood, OLS covariance and equal rows of every ρ^|j − k|, written out."""
    # eq. (5) of estimation.correlated_rows
    rng = np.random.default_rng(7)
    n, k, below = 16, 12, 6
    X = np.column_stack([np.ones(n), rng.normal(size=n)])
    errors = rng.normal(size=(2, n)).cumsum(axis=1) * [[1.0], [0.0]] + rng.normal(size=(2, n))
    errors -= errors @ X @ np.linalg.inv(X.T @ X) @ X.T
    low = np.sqrt(0.4 / n)
    x = low + (1.0 - low) * (np.arange(k) + 0.5) / k
    rho = np.concatenate([1.0 - x**2, -(np.arange(below) + 0.5) / below])
    prior = np.concatenate([x / x.sum(), np.full(below, 1.0 / below)])
    B = np.linalg.inv(X.T @ X) @ X.T
    logs, variances = np.zeros((2, len(rho))), np.zeros((2, len(rho), 2))
    rows = np.zeros(len(rho))
    for g, r in enumerate(rho):
        R = r ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
        W = np.linalg.inv(R)
        K = W - W @ X @ np.linalg.inv(X.T @ W @ X) @ X.T @ W
        s2 = np.einsum("bi,ij,bj->b", errors, K, errors) / (n - 2)
        dets = np.linalg.slogdet(R)[1] + np.linalg.slogdet(X.T @ W @ X)[1]
        logs[:, g] = np.log(prior[g]) - 0.5 * (dets + (n - 2) * np.log(s2))
        variances[:, g] = s2[:, None] * np.diag(B @ R @ B.T)
        rows[g] = n**2 / R.sum()
    weight = np.exp(logs - logs.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    plain = np.sqrt(np.sum(errors**2, axis=1)[:, None] / (n - 2) * np.diag(B @ B.T))
    U = half_of_mixture(weight, variances, np.full((1, 1), n - 2.0))
    expected = np.maximum(U / (stats.t.isf(0.025, n - 2) * plain), 1.0)
    (ratios,), worth = spread_in_time([X], [errors])
    assert_allclose(ratios, expected, rtol=1e-6)
    assert ratios[0].max() > 1.2
    slow = weight[:, rho > 0.2].sum(axis=1) > 0.99
    assert slow[0]
    assert_allclose(worth, np.where(slow, np.minimum(weight @ rows, n), n), rtol=1e-6)
