"""What differs from one switch-on to the next: zeros by hand, coverage on runs never seen."""

import hashlib
import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

import multipos as mp
from multipos.cli import main
from multipos.errors import MultiposError, UsageError
from multipos.numerics.quantiles import coverage_factor, normal_quantile, t_tail
from multipos.numerics.terms import linear_term
from multipos.regression.observations import join_runs
from multipos.regression.runs import find_between
from multipos.regression.segment import Coefficient, Segment

# y = x + a, a = 0 in run 1 (two rows) and 2 in run 2 (four rows)
TWO = {
    "x": np.array([0.0, 1.0, 0.0, 1.0, 2.0, 3.0]),
    "y": np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0]),
    "run": ["first"] * 2 + ["second"] * 4,
}


def test_the_constant_is_the_mean_of_the_zeros_by_hand():
    # eqs. (1), (2), (3) of regression.runs
    r = mp.regress(TWO, response="y", variables="x", run="run")
    (segment,) = r.segments
    a, b = segment.coefficients
    assert (a.value, b.value) == (pytest.approx(1.0, abs=1e-14), pytest.approx(1.0, abs=1e-14))
    assert segment.dof == (1, 3)  # 6 rows, 2 coefficients, 1 zero more
    assert segment.between.runs == 2
    assert segment.between.sd == pytest.approx(math.sqrt(2.0))  # of zeros −1 and 1 about 1
    assert a.u == pytest.approx(1.0)  # √(2/2), the fit itself is exact
    assert b.u == pytest.approx(0.0, abs=1e-12)
    found = mp.correct(r, {"x": [0.0, 5.0], "y": [0.0, 0.0]}, uncertainty=True)
    np.testing.assert_allclose(found["predicted"], [1.0, 6.0], rtol=1e-14)
    np.testing.assert_allclose(found["u_predicted"], math.sqrt(3.0), rtol=1e-12)  # 2 + 2/2
    k = coverage_factor(0.95, 1.0)  # t on one degree of freedom, 12.7
    np.testing.assert_allclose(found["U_predicted"], k * math.sqrt(3.0), rtol=1e-12)


def runs(seed, m, *, zero=0.3, slope=0.0, n=120):
    """Runs of a straight line with a zero and a slope of their own, and white noise of 0.5."""
    rng = np.random.default_rng(seed)
    t = np.tile(np.linspace(-1.0, 1.0, n), m)
    run = np.repeat(np.arange(m), n)
    y = 1.0 + 2.0 * t + rng.normal(0.0, zero, m)[run] + rng.normal(0.0, slope, m)[run] * t
    return {"t": t, "y": y + rng.normal(0.0, 0.5, m * n), "run": run}


def test_a_slope_that_differs_is_told_and_one_that_does_not_is_not():
    differs = mp.regress(runs(1, 8, slope=1.0), response="y", variables="t", run="run")
    same = mp.regress(runs(1, 8), response="y", variables="t", run="run")
    # 8 slopes: the sd is known to about a quarter
    assert differs.segments[0].between.slope_sd == pytest.approx(1.0, rel=0.6)
    assert same.segments[0].between.slope_sd is None
    assert differs.segments[0].coefficients[1].u > 5 * same.segments[0].coefficients[1].u
    assert "the slope of t by" in str(differs)


def test_segments_without_a_jump_share_what_runs_differ_by():
    r = mp.regress(
        runs(2, 4), response="y", variables="t", run="run", segment="t:0", continuous=True
    )
    below, above = r.segments
    assert below.between == above.between
    left, right = (
        s.values @ [1.0, 0.0][: len(s.values)] for s in (below, above)
    )  # both lines at t = 0
    assert left == pytest.approx(right)


@pytest.mark.parametrize(("slope", "variable"), [(0.0, None), (1.0, "t")])
def test_a_file_keeps_what_runs_differ_by(tmp_path, slope, variable):
    r = mp.regress(runs(1, 8, slope=slope), response="y", variables="t", run="run")
    path = tmp_path / "reg.json"
    r.save(path)
    assert mp.load_regression(path) == r
    entry = r.to_dict()["segments"][0]["between_runs"]
    assert (entry["runs"], entry["dof"], entry.get("variable")) == (8, 7, variable)
    if variable:
        path.write_text(path.read_text().replace('"variable": "t"', '"variable": "q"'))
        with pytest.raises(MultiposError, match="'between_runs' of a segment does not fit"):
            mp.load_regression(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("zero", "m", "trials"), [(0.05, 10, 20), (0.3, 5, 30), (2.0, 3, 130), (2.0, 10, 40)]
)
def test_the_next_run_is_covered(m, zero, trials):
    """At least 95 % over runs never seen, by t of each part.

    The next run is normal about the line, so the share that U holds is known of every fit: it
    scatters from fit to fit alone, and these trials know it as well as 250 runs drawn once each.
    """
    t, held = np.linspace(-1.0, 1.0, 20), []
    middle, sd = {"t": t, "y": 1.0 + 2.0 * t, "run": np.zeros(20)}, math.hypot(zero, 0.5)
    for seed in range(trials):
        r = mp.regress(runs(seed, m, zero=zero, n=40), response="y", variables="t", run="run")
        found = mp.correct(r, middle, uncertainty=True)
        off, U = np.asarray(found["corrected"]), np.asarray(found["U_corrected"])
        held.append(np.mean(norm.cdf((U - off) / sd) - norm.cdf((-U - off) / sd)))
    standard_error = np.std(held, ddof=1) / math.sqrt(trials)
    assert np.mean(held) >= 0.95 - normal_quantile(0.999) * standard_error


def test_refusals():
    with pytest.raises(UsageError, match="--run is about the constant"):
        mp.regress(TWO, response="y", terms="x", run="run")
    with pytest.raises(MultiposError, match="holds one run only"):
        mp.regress(TWO | {"run": ["a"] * 6}, response="y", variables="x", run="run")
    with pytest.raises(MultiposError, match="rows of one run only"):
        mp.regress(TWO, response="y", variables="x", run="run", segment="x:1.5", free=True)


def test_files_are_runs(tmp_path, capsys):
    """Two files are one table with a column that tells them apart."""
    run = np.array(TWO["run"])
    for name in np.unique(run).tolist():
        rows = run == name
        mp.write_table(tmp_path / f"{name}.csv", {k: np.array(TWO[k])[rows] for k in ("x", "y")})
    files = sorted(map(str, tmp_path.glob("*.csv")))
    found = mp.regress(files, response="y", variables="x")
    joined = mp.regress(TWO, response="y", variables="x", run="run")
    assert found.run == "run"
    np.testing.assert_allclose(found.segments[0].values, joined.segments[0].values, rtol=1e-14)
    assert found.segments[0].between == joined.segments[0].between
    status = main(["regress", *files, "--response", "y", "--variables", "x", "-v"])
    assert (status, "between 2 runs" in capsys.readouterr().out) == (0, True)
    mp.write_table(tmp_path / "c.csv", {"x": [1.0, 2.0]})
    with pytest.raises(MultiposError, match="no column 'y'"):
        mp.regress([*files, str(tmp_path / "c.csv")], response="y", variables="x")


def test_rows_that_depend_on_each_other_keep_what_runs_differ_by():
    """u of the constant is the scatter of four zeros over √4, whatever covariance the rows have."""
    rng = np.random.default_rng(5)
    data = runs(3, 4, zero=3.0)
    noise = rng.standard_normal(len(data["y"]))
    for k in range(1, len(noise)):
        noise[k] += 0.9 * noise[k - 1]
    data["y"] = data["y"] + 0.1 * noise
    (segment,) = mp.regress(data, response="y", variables="t", run="run").segments
    assert segment.robust is not None
    zeros = [np.mean((data["y"] - 2.0 * data["t"])[data["run"] == i]) for i in range(4)]
    for covariance in (segment.covariance, segment.robust.covariance):
        assert math.sqrt(covariance[0, 0]) == pytest.approx(np.std(zeros, ddof=1) / 2.0, rel=0.05)


def between_three(offsets, slopes, terms, noise=0.0):
    """Three runs of 32 rows, t within one of 5, but of the third, whose rows lie higher by one."""
    t = np.concatenate([5.0 + np.linspace(-1.0, 1.0, 32) + more for more in (0.0, 0.0, 1.0)])
    run = np.repeat([0, 1, 2], 32)
    left = np.array(offsets)[run] + np.array(slopes)[run] * (t - t.mean())
    left = left + noise * np.tile([1.0, -1.0, -1.0, 1.0], 24)
    data = SimpleNamespace(columns={"t": t}, run=run, response=left + 3.0)
    return find_between(np.ones((96, 1)), data, terms, np.array([3.0]), "t", 96.0)


def test_what_differs_between_runs_by_hand():
    """Offsets 1, 2, 6 and slopes 0, 1, 5: variances and covariance are 7."""
    # eq. (2) of regression.runs
    found = between_three([1.0, 2.0, 6.0], [0.0, 1.0, 5.0], [None, linear_term("t")])
    assert (found.runs, found.variable, found.dof) == (3, "t", 2)
    assert found.centre == pytest.approx(16 / 3)
    np.testing.assert_allclose(found.covariance, np.full((2, 2), 7.0), rtol=1e-12)
    assert between_three([1.0, 2.0, 6.0], [0.0, 1.0, -1.0], [linear_term("t")], 1.0).variable == "t"
    for terms, slopes, noise in (
        ([None], [0.0, 1.0, 5.0], 0.0),
        ([linear_term("t")], [0.0] * 3, 0.0),
        # 0, 1, −1 are what noise of ±10 over Σx² = 32·33/93 gives: F = 1/9.4; of ±1 it is 10
        ([linear_term("t")], [0.0, 1.0, -1.0], 10.0),
    ):
        found = between_three([1.0, 2.0, 6.0], slopes, terms, noise)
        assert found.variable is None
        # the third run lies at 2/3 beyond the centre, the others at 1/3 below it
        off = np.array([1.0, 2.0, 6.0]) + np.array(slopes) * np.array([-1 / 3, -1 / 3, 2 / 3])
        np.testing.assert_allclose(found.covariance, [[off.var(ddof=1)]], rtol=1e-12)


def test_a_coefficient_of_few_runs_has_their_degrees_of_freedom():
    """u² = .09, of it .04 on four runs more, the rest on 20: .0081/(.04²/4 + .05²/20)."""
    between = SimpleNamespace(of_coefficients=lambda terms: np.array([[0.04]]), runs=5)
    segment = SimpleNamespace(between=between, terms=(), robust_dof=20.0)
    found = Segment._judged_by_runs(segment, Coefficient("x", 0.6, 0.3, 2.0, 0.05), 0)
    assert found.dof == pytest.approx(0.0081 / 0.000525, rel=1e-12)
    assert found.p == pytest.approx(t_tail(2.0, 0.0081 / 0.000525), rel=1e-12)
    assert found.p_robust is None
    segment.robust_dof = 10.0
    robust = Coefficient("x", 0.6, 0.1, 6.0, 0.05, 0.3, 2.0, 0.1)
    found = Segment._judged_by_runs(segment, robust, 0)
    assert found.dof == pytest.approx(0.0081 / 0.00065, rel=1e-12)
    assert found.p_robust == pytest.approx(t_tail(2.0, 0.0081 / 0.00065), rel=1e-12)


def test_tables_of_several_runs_are_named_as_they_can_be_told_apart(tmp_path):
    """By their files' names, else by their paths, else by number; with what stood there before."""
    for folder, name, value in (("a", "x", 1), ("a", "y", 2), ("b", "x", 3)):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / f"{name}.csv").write_text(f"v,run\n{value},p\n{value},\n")
    ax, ay, bx = (tmp_path / name for name in ("a/x.csv", "a/y.csv", "b/x.csv"))
    table, run = join_runs([ax, ay], "run")
    assert list(table.text(run)) == ["x p", "x", "y p", "y"]
    table, run = join_runs([ax, bx], "run")
    assert list(table.text(run)) == [f"{ax} p", str(ax), f"{bx} p", str(bx)]
    each = [hashlib.sha256(path.read_bytes()).hexdigest() for path in (ax, bx)]
    assert table.sha256 == hashlib.sha256("".join(each).encode()).hexdigest()
    columns = [{"v": [4.0, 5.0], "run": ["q", "q"]}, {"v": [6.0, 7.0], "run": ["q", "q"]}]
    table, run = join_runs(columns, "run")
    assert list(table.text(run)) == ["1 q", "1 q", "2 q", "2 q"]
    assert table.sha256 is None  # of what is no file
