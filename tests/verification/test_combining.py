"""Sessions combined: the covariance by hand, coverage on sessions never seen, what is refused."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from findings_bench import texts
from numpy.testing import assert_allclose
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.stats import chi2, multivariate_normal, norm
from scipy.stats import t as student

import multipos as mp
from multipos.cli import main
from multipos.errors import MultiposError, UsageError
from multipos.uncertainty.propagation import evaluate_budget
from multipos.verification import combining

FACES = mp.read_scheme("faces-6").up
SD, ZERO, TURN = 3e-4, 2e-3, 1e-3  # noise [g], and how sessions differ: zero [g], mounting [rad]


def session(rng, scheme="faces-6", **options):
    """Return a session's fit and the true parameters on that day."""
    up = mp.read_scheme(scheme).up
    zero = [0.01, -0.02, 0.0] + ZERO * rng.standard_normal(3)
    x, y, z = TURN * rng.standard_normal(3)
    K = np.diag([1.01, 0.99, 1.0]) @ np.array([[1, -z, y], [z, 1, -x], [-y, x, 1]])
    values = zero + up @ K.T + SD * rng.standard_normal(up.shape)
    truth = np.column_stack([zero, K]).ravel()
    return mp.fit(mp.Readings(values, unit="g"), scheme=scheme, **options), truth


def sessions(seed, count, **options):
    rng = np.random.default_rng(seed)
    return [session(rng, **options)[0] for _ in range(count)]


def combined(found):
    return mp.compare(*found, combine=True).combined


def test_sessions_that_differ_by_far_more_than_their_noise_by_hand():
    """The mean, and Student's t of all three zeros together on 3 (R − 1) degrees of freedom."""
    # eq. (2) of verification.combining
    found = sessions(1, 4, reading_sd=SD)
    values = np.array([c.parameters for c in found])
    one = combined(found)
    assert_allclose(one.parameters, values.mean(axis=0), rtol=0, atol=1e-13)
    pooled = np.sqrt(1.25 * np.mean(values[:, [0, 4, 8]].var(axis=0, ddof=1)))
    t = 2.262157  # at 0.975 on 9, of any table
    assert_allclose(one.U[[0, 4, 8]], t * pooled, rtol=0.01)
    assert (one.parameter_dof[[0, 4, 8]] == 9.0).all()
    assert one.sessions.runs == 4
    assert_allclose(one.sessions.sd["bias_ax"], values[:, 0].std(ddof=1))
    assert mp.compare(*found).combined is None


@pytest.mark.usefixtures("without_findings")
def test_sessions_that_agree_are_no_four_times_too_long():
    """Three sessions of one truth: U covers it, and is less than twice as long as need be."""
    rng = np.random.default_rng(11)
    up = mp.read_scheme("fibonacci-24").up
    hits, ratios = [], []
    best = 1.96 * SD / math.sqrt(24 * 3)  # of the mean of all readings of a zero
    for _ in range(30):
        each = [mp.Readings(up + SD * rng.standard_normal((24, 3)), up=up) for _ in range(3)]
        one = combined([mp.fit(readings) for readings in each])
        biases = [0, 4, 8]
        hits.append(np.abs(one.parameters[biases]) <= one.U[biases])
        ratios.append(one.U[biases] / best)
    assert np.mean(hits) >= 0.93
    assert np.mean(ratios) < 2.0


@pytest.mark.parametrize(("count", "least"), [(2, 2.05), (4, 1.64), (8, 1.65)])
def test_u_of_the_next_session_covers_however_much_sessions_differ(count, least):
    """U depends on the spread of three parameters alone, which follows chi-square: no draws.

    `least` is the bound of a linear program over all rules of U that cover 93 %.
    """
    # eq. (1) of verification.combining
    nu, even = 3 * (count - 1), (np.arange(60) + 0.5) / 60
    pattern = np.zeros((count, 3))
    pattern[:2] = [[1.0], [-1.0]]  # of a sum of squares of 6
    one, share = np.ones((count, 3)), np.full((count, 3), 1.0 / count)
    for size in (0.0, 0.5, 1.0, 2.0, 5.0):  # of the u that one session has
        squares = (1.0 + size**2) * chi2.ppf(even, nu)
        each = [np.sqrt(q / 6.0) * pattern for q in squares]
        U = [combining.predict_next(p, one, share, 1e6)[0][0] for p in each]
        sd = math.sqrt(size**2 + (1.0 + size**2) / count)
        held = np.mean(2.0 * norm.cdf(np.array(U) / sd) - 1.0)
        assert 0.93 <= held <= (0.97 if size >= 1.0 and count > 2 else 1.0)
        if size == 0.0:
            assert np.mean(U) / (1.959964 * sd) < 1.1 * least


@pytest.mark.slow
@pytest.mark.parametrize(("noises", "size"), [((SD, SD), 2.0), ((SD, 2 * SD, 3 * SD, SD), 1.0)])
@pytest.mark.usefixtures("without_findings")
def test_whole_fits_of_sessions_that_differ_cover_the_next(noises, size):
    """Zeros that move by so many of the u that sessions have of them, equal and unequal."""
    rng, hits = np.random.default_rng(8), []
    between = size * math.sqrt(np.mean(np.square(noises)) / 6.0)
    for _ in range(150):
        zeros = between * rng.standard_normal((len(noises) + 1, 3))
        each = [
            mp.fit(
                mp.Readings(b + FACES + sd * rng.standard_normal((6, 3)), up=FACES), reading_sd=sd
            )
            for b, sd in zip(zeros, noises, strict=False)
        ]
        one = combined(each)
        hits.append(np.abs(one.parameters[[0, 4, 8]] - zeros[-1]) <= one.U[[0, 4, 8]])
    assert np.mean(hits) >= 0.93 - 3.0 * math.sqrt(0.93 * 0.07 / 150)


def test_a_longer_session_counts_for_more():
    """Twelve faces beside six count two to one, in p and in its part of U."""
    stated = {"reading_sd": SD}
    short, again = sessions(2, 2, **stated)
    (long,) = sessions(3, 1, scheme="faces-6+faces-6", **stated)
    one = combined([short, again, long])
    share = np.array([0.25, 0.25, 0.5])
    values = np.array([short.parameters, again.parameters, long.parameters])
    assert_allclose(one.parameters, share @ values, rtol=0, atol=1e-13)
    pooled = np.sqrt((1.0 + share @ share) * np.mean(values[:, [0, 4, 8]].var(axis=0, ddof=1)))
    assert_allclose(one.U[[0, 4, 8]], 2.446912 * pooled, rtol=0.1)  # t at 0.975 on 6


def test_values_are_correlated_as_their_sessions_and_what_these_state():
    """The mean covariance and that of the values, at the u that eq. (2) gives; S has R − 1."""
    short, again = sessions(2, 2, reading_sd=SD)
    (long,) = sessions(3, 1, scheme="faces-6+faces-6", reading_sd=SD)
    found = [short, again, long]
    one = combined(found)
    values = np.array([c.parameters for c in found])
    S = np.cov(values.T)
    whole = np.mean([c.covariance for c in found], axis=0) + S
    sd, u = np.sqrt(np.diag(whole)), np.sqrt(np.diag(one.covariance))
    assert_allclose(one.covariance / np.outer(u, u), whole / np.outer(sd, sd), atol=1e-9)
    assert_allclose(list(one.sessions.sd.values()), np.sqrt(np.diag(S)))
    assert (one.sessions.runs, one.dof.tolist()) == (3, [2.0] * 3)
    own = np.array([np.diag(c.covariance) for c in found]) * combining._shrunk(found)
    share, biases = np.array([[0.25], [0.25], [0.5]]) * np.ones(3), [0, 4, 8]
    known = min(sum(c.dof for c in found))
    U, dof = combining.predict_next(values[:, biases], own[:, biases], share, known)
    assert_allclose(u[biases], U / student.ppf(0.975, dof), rtol=1e-6)
    assert_allclose(one.parameter_dof[biases], dof)


def test_what_sessions_share_is_added():
    """Gravity does not show in how sessions differ: its u is in every scale factor besides."""
    gravity = {"gravity": 9.81, "gravity_u": 9.81e-3}
    plain, known = combined(sessions(4, 3, gravity=9.81)), combined(sessions(4, 3, **gravity))
    scale = known["scale_ax"].value
    assert_allclose(
        known["scale_ax"].u ** 2 - plain["scale_ax"].u ** 2, (1e-3 * scale) ** 2, rtol=1e-9
    )
    assert known["scale_ax"].dof > plain["scale_ax"].dof
    assert_allclose(known["bias_ax"].u, plain["bias_ax"].u, rtol=1e-12)


def test_the_zero_of_a_budget_is_not_added_again():
    budget = {"stability": {"u_ax": 0.5}, "gain": {"u": 1e-2}}
    found = sessions(5, 3, budget=budget)
    one, plain = combined(found), combined(sessions(5, 3))
    assert_allclose(one["bias_ax"].u, plain["bias_ax"].u, rtol=1e-2)
    assert one["scale_ax"].u > 9e-3
    rows = {row.quantity: row for row in evaluate_budget(one).rows}
    assert set(rows) == {"sessions", "gain"}
    assert rows["sessions"].text == "variation from session to session"


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 4])
@pytest.mark.usefixtures("without_findings")
def test_u_covers_a_session_never_seen(count):
    """The three zeros of a session tell one spread between sessions."""
    rng = np.random.default_rng(count)
    runs, hits = 120, []
    for _ in range(runs):
        one = combined([session(rng)[0] for _ in range(count)])
        _, truth = session(rng)
        hits.append(np.abs(one.parameters - truth) <= one.U)
    biases = np.mean(np.array(hits)[:, [0, 4, 8]])  # three independent outputs
    assert abs(biases - 0.95) <= 4.0 * math.sqrt(0.95 * 0.05 / (3 * runs))
    # a scale factor that no session changes is known better than claimed
    assert np.mean(np.array(hits)[:, [1, 6, 11]]) >= 0.95


@pytest.mark.parametrize(
    "options",
    [
        {"reading_sd": SD},
        {"orientation_sd": 0.05},
        {"unknown_orientation": True},
        {"orientation_sd": "auto"},
    ],
    ids=str,
)
def test_every_estimator_is_combined(options):
    found = sessions(6, 3, scheme="icosahedron-12", **options)
    one = combined(found)
    mean = np.mean([c.parameters for c in found], axis=0)
    spread = np.std([c.parameters for c in found], axis=0, ddof=1)
    # the pooled fit is not the mean where it is not linear, but near it for the spread
    assert (np.abs(one.parameters - mean) < 0.2 * spread + SD / 3.0).all()
    biases = [one.names.index(f"bias_{output}") for output in one.outputs]
    pooled = math.sqrt(4 / 3 * np.mean(spread[biases] ** 2))
    assert_allclose(one.u[biases], pooled, rtol=0.2)
    if options != {"orientation_sd": "auto"}:  # where none is found, the fit is linear
        assert one.estimator is found[0].estimator
    assert len(one.readings) == 36


def test_on_the_command_line(tmp_path, capsys):
    names = []
    for i, c in enumerate(sessions(7, 4)):
        names.append(str(tmp_path / f"run{i}.json"))
        c.save(names[-1])
    out = tmp_path / "pooled.json"
    assert main(["compare", *names, "--combine", "-v", "-o", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "combined" in printed
    assert "bias stability" in printed
    one = mp.load(out)
    assert json.loads(out.read_text())["sessions"]["files"] == names
    assert_allclose(one.U, combined([mp.load(name) for name in names]).U)
    assert main(["compare", *names, "--combine", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["combined"]["schema"] == "multipos/calibration/1"
    assert main(["report", str(out), "-o", str(tmp_path / "report.txt")]) == 0
    assert "variation from session to session" in (tmp_path / "report.txt").read_text()


def test_what_sessions_state_unlike_is_left_out():
    """One that states its u, unlike from row to row, counts as if it did not, and so does S."""
    a, b, c = sessions(8, 3)
    u = np.resize([1.0, 2.0, 4.0, 1.0], (6, 3)) * SD
    stated = mp.fit(replace(b.readings, u=u))
    assert np.abs(stated.parameters - b.parameters).max() > 1e-5
    one, all_plain = combined([a, stated, c]), combined([a, b, c])
    assert_allclose(one.parameters, all_plain.parameters, rtol=0, atol=1e-13)
    assert_allclose(one.covariance, all_plain.covariance, rtol=1e-9, atol=1e-15)
    assert_allclose(one.residual_sd, all_plain.residual_sd, rtol=1e-9)
    assert "fitted again with equal weights" in texts(one)[-1]
    assert not any("equal weights" in said for said in texts(all_plain))
    correlated = mp.fit(replace(b.readings, covariance=SD**2 * (np.eye(18) + 0.2)))
    again = combined([a, correlated, c])
    assert_allclose(again.covariance, all_plain.covariance, rtol=1e-9, atol=1e-15)
    assert again.readings.covariance is None


def test_sessions_of_many_rows_are_no_record():
    """What sessions differ by is in S, and not a correlation from row to row."""
    rng = np.random.default_rng(21)
    found = [session(rng, scheme="faces-6+faces-6+faces-6")[0] for _ in range(4)]
    assert combined(found).effective_rows is None


def test_what_cannot_be_combined():
    a, b = sessions(8, 2)
    with pytest.raises(MultiposError, match="has the readings of calibration 1"):
        combined([a, b, a])
    with pytest.raises(MultiposError, match="its gravity is not that of calibration 1"):
        combined([a, sessions(9, 1, gravity=9.81)[0]])
    with pytest.raises(MultiposError, match="its estimator is not that"):
        combined([a, sessions(9, 1, orientation_sd=0.1)[0]])
    with pytest.raises(MultiposError, match="robust"):
        combined([a, replace(b, robust_weight=np.ones(6))])
    x = np.arange(8.0)
    regression = mp.regress({"x": x, "y": 2 * x + np.sin(9 * x)}, response="y", variables="x")
    with pytest.raises(UsageError, match="--run"):
        mp.compare(regression, regression, combine=True)


def test_u_of_the_next_session_by_quadrature():
    """Two sessions of one bias: SciPy's integral over κ, even in ln (1 + κ), beside a lump at 0."""
    # eq. (1) of verification.combining
    p, v, w = np.array([[0.0], [3.0]]), np.array([[1.0], [2.0]]), np.array([[0.6], [0.4]])
    c = SimpleNamespace(names=("bias_ax",))
    found = [SimpleNamespace(dof_of_outputs=np.array([1e3]))] * 2
    U, dof = combining._expand(c, p, v, w, found)

    def log_likelihood(kappa):
        V = kappa * 1.5 + v[:, 0]
        return multivariate_normal([0.0], [[V.sum()]]).logpdf(3.0)  # of the difference alone

    def variance(kappa):
        return kappa * 1.5 + float(np.sum(w**2 * (kappa * 1.5 + v)))

    def outside(x, half):
        kappa = math.expm1(x)
        return math.exp(log_likelihood(kappa)) * 2.0 * norm.sf(half / math.sqrt(variance(kappa)))

    end = math.log1p(100.0 * 2.25 / 1.5) + 5.0
    lump = 1.8 * 3.0**0.7 * math.exp(log_likelihood(0.0))
    whole = quad(lambda x: math.exp(log_likelihood(math.expm1(x))), 0.0, end)[0] + lump

    def excess(half):
        at_zero = lump * 2.0 * norm.sf(half / math.sqrt(variance(0.0)))
        return (quad(outside, 0.0, end, args=(half,))[0] + at_zero) / whole - 0.05

    assert U[0] == pytest.approx(brentq(excess, 1.0, 1e3), rel=0.02)  # 61 nodes, t on 2,000
    assert dof[0] == 2.0


@pytest.mark.parametrize(
    ("sources", "source"), [(("a.csv", "b.csv", "a.csv"), "a.csv, b.csv"), ((None,) * 3, None)]
)
def test_readings_of_all_sessions_name_their_files_once(sources, source):
    one = session(np.random.default_rng(2))[0].readings
    joined = combining._joined([replace(one, source=each) for each in sources])
    assert joined.source == source
    assert joined.labels == one.labels * 3


def test_u_of_the_next_session_is_the_same_in_any_unit():
    rng = np.random.default_rng(3)
    p, own, share = rng.standard_normal((3, 4)), np.full((3, 4), 0.2), np.full((3, 4), 1.0 / 3.0)
    U, dof = combining.predict_next(p, own, share, 30.0)
    for unit in (1e-6, 1e5):
        again = combining.predict_next(unit * p, unit**2 * own, share, 30.0)
        assert_allclose(again[0], unit * U, rtol=1e-9)
        assert again[1] == pytest.approx(dof, rel=1e-9)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_sessions_that_agree_exactly_leave_next_to_no_u():
    p = np.full((3, 4), 2.0)
    U, _ = combining.predict_next(p, np.zeros((3, 4)), np.full((3, 4), 1.0 / 3.0), 30.0)
    assert (U < 1e-30).all()


def test_how_sessions_differ_is_not_simulated():
    one = combined(sessions(1, 3, reading_sd=SD))
    with pytest.raises(UsageError, match=r"how its sessions differ, .* of one session"):
        mp.simulate_budget(one, trials=100)
