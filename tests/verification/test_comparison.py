"""Repeated calibrations: the false-alarm rate, sums by hand, and what is refused."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from known_noise import with_known_noise
from numpy.testing import assert_allclose
from scipy import optimize, special

import multipos as mp
from multipos.cli import main
from multipos.errors import MultiposError, UsageError
from multipos.finding import serious
from multipos.numerics.quantiles import chi2_tail, f_tail
from multipos.positions.scheme import read_scheme
from multipos.sensor.fit_diagnostics import ModelTest
from multipos.verification.comparison_text import comparison_text
from multipos.verification.consistency import _by_days, judge_together

TWO = math.radians(2.0)

SD = np.array([1e-3, 1e-2, 3e-3])  # the outputs differ


def repeats(rng, count=4, *, scheme="faces-6", sd=SD, shift=None, **options):
    up = read_scheme(scheme).up
    found = []
    for run in range(count):
        values = up + sd * rng.standard_normal(up.shape)
        if shift is not None:
            values = values + run * np.asarray(shift)
        exact = {"orientation_sd": 0, "exclude": "none"}
        options = {"model": "own-quadratic"} | exact | options
        found.append(mp.fit(mp.Readings(values, unit="g"), scheme=scheme, **options))
    return found


def within(hits, runs, level):
    """Whether a count agrees with a binomial law, at four standard deviations."""
    return abs(hits / runs - level) <= 4 * math.sqrt(level * (1 - level) / runs)


def at_most(hits, runs, level):
    """Whether a count is no more than a binomial law allows."""
    return hits / runs <= level + 4 * math.sqrt(level * (1 - level) / runs)


@pytest.mark.slow
@pytest.mark.usefixtures("without_findings")
@pytest.mark.parametrize(
    ("count", "options"),
    [
        (4, {}),
        (2, {"model": "linear"}),
        (4, {"pool": True, "sd": 1e-3}),
        (3, {"reading_sd": SD}),
        (5, {"scheme": "icosahedron-12"}),
    ],
    ids=["four six-position repeats", "two linear", "pooled", "noise stated", "twelve positions"],
)
def test_false_alarms_come_as_often_as_said(count, options):
    rng = np.random.default_rng(42)
    runs = 200
    found = [mp.compare(*repeats(rng, count, **options)) for _ in range(runs)]
    p = np.array([c.p_total for c in found])
    # a claim that is right is not taken on trust, so that differences look a little smaller
    agrees = at_most if "reading_sd" in options else within
    for level in (0.05, 0.2, 0.5):
        assert agrees(np.sum(p < level), runs, level)
    assert agrees(sum(not c.consistent for c in found), runs, 0.05)
    single = np.array([c.p[0] for c in found])
    assert agrees(np.sum(single < 0.05), runs, 0.05)
    # Holm: any parameter named falsely at most as often as said
    moved = sum(bool(c.moved) for c in found) / runs
    assert moved <= 0.05 + 4 * math.sqrt(0.05 * 0.95 / runs)


@pytest.mark.slow
@pytest.mark.usefixtures("without_findings")
def test_plain_chi_square_would_cry_wolf():
    """The reason for the F statistic: four repeats, one degree of freedom each."""
    rng = np.random.default_rng(7)
    runs, alarms = 150, 0
    for _ in range(runs):
        found = repeats(rng)
        value = np.array([c.parameters[0] for c in found])
        weight = np.array([c.u[0] for c in found]) ** -2.0
        mean = weight @ value / weight.sum()
        alarms += chi2_tail(float(weight @ (value - mean) ** 2), 3) < 0.05
    assert alarms / runs > 0.35  # where 0.05 is meant


def test_f_by_hand_for_equal_schemes():
    found = repeats(np.random.default_rng(3), pool=False)
    c = mp.compare(*found)
    value = np.array([f.parameters[0] for f in found])
    pooled = np.mean([f.u[0] ** 2 for f in found])  # one degree of freedom each
    f = value.var(ddof=1) / pooled
    assert c.chi2[0] / 3 == pytest.approx(f, rel=1e-9)
    assert c.p[0] == pytest.approx(f_tail(f, 3, 4), rel=1e-9)
    assert (c.dof[0], c.scatter_dof[0]) == (3, 4)
    tails = []
    for output in range(3):
        part = found[0].model.slices[output]
        values = np.array([f.parameters[part] for f in found])
        covariance = np.mean([f.covariance[part, part] for f in found], axis=0)
        left = values - values.mean(axis=0)
        q = np.einsum("ri,ij,rj->", left, np.linalg.inv(covariance), left)
        tails.append(f_tail(q / 15, 15, 4))
    assert c.statistic == pytest.approx(-2 * sum(map(math.log, tails)), rel=1e-9)
    assert c.dof_total == 6


def test_f_by_hand_for_unequal_degrees_of_freedom():
    """Two readings a side, then four: s² is pooled by degrees of freedom, eq. (2).

    Run 1 has bias 0, scale 1, rss 4 · 0.02² = 16e-4 on 2; run 2 has bias 0.02, scale 1.02, rss
    8 · 0.01² = 8e-4 on 6. So s² = 24e-4/8 = 3e-4, and either parameter differs by 0.02 with the
    variance (1/4 + 1/8) s²: Q = 4e-4/1.125e-4 = 32/9.
    """
    # eqs. (1), (2) of verification.consistency
    side = np.array([1.0, 1.0, -1.0, -1.0])
    first = side + 0.02 * np.array([1, -1, 1, -1])
    second = np.tile(0.02 + 1.02 * side, 2) + 0.01 * np.tile([1, -1], 4)
    found = [
        mp.fit(
            mp.Readings(
                values[:, np.newaxis],
                outputs=("ax",),
                up=np.outer(np.resize(side, len(values)), [1.0, 0.0, 0.0]),
            ),
            model="1 + x",
        )
        for values in (first, second)
    ]
    c = mp.compare(*found)
    assert_allclose(c.chi2, 32 / 9, rtol=1e-9)
    assert c.scatter_dof.tolist() == [8.0, 8.0]
    assert c.statistic == pytest.approx(64 / 9 / 2, rel=1e-9)
    assert c.dof_total == [2, 8]
    # the tail of F on 2 and 8 is (1 + 2 F/8)^-4 = (17/9)^-4
    assert c.p_total == pytest.approx(6561 / 83521, rel=1e-9)


def test_chi_square_where_the_noise_is_known():
    found = [with_known_noise(c) for c in repeats(np.random.default_rng(5), 3, reading_sd=SD)]
    c = mp.compare(*found)
    left = c.values - c.values.mean(axis=0)
    inverse = np.linalg.inv(found[0].covariance)
    assert c.statistic == pytest.approx(np.einsum("ri,ij,rj->", left, inverse, left), rel=1e-9)
    assert c.dof_total == 30
    assert c.p_total == pytest.approx(chi2_tail(c.statistic, 30), rel=1e-12)
    assert "chi-square" in c.test


def test_pooled_outputs_are_one_family():
    c = mp.compare(*repeats(np.random.default_rng(5), pool=True, sd=1e-3))
    assert c.dof_total == [45, 12]
    assert c.test.startswith("F of the repeats")


def test_gravity_and_other_common_quantities_do_not_enter():
    rng = np.random.default_rng(9)
    plain = repeats(rng, scheme="icosahedron-12", gravity=9.81)
    budget = {"gravity": {"value": 9.81, "u": 0.1}, "gain": {"u": 0.01}}
    rng = np.random.default_rng(9)
    common = repeats(rng, scheme="icosahedron-12", budget=budget)
    assert common[0].u[1] > 5 * plain[0].u[1]
    one, two = mp.compare(*plain), mp.compare(*common)
    assert_allclose(two.chi2, one.chi2, rtol=1e-6)
    assert two.p_total == pytest.approx(one.p_total, rel=1e-6)


def test_a_bias_that_moves_is_found_and_named():
    found = repeats(np.random.default_rng(1), 4, scheme="icosahedron-12", shift=[0.02, 0, 0])
    c = mp.compare(*found)
    assert not c.consistent
    assert c.moved == ("bias_ax",)
    assert c.drift[0] == pytest.approx(0.02, abs=1e-3)
    assert (c.per, c.times) == ("run", "as given")
    assert c.to_dict()["parameters"][0]["drift_unit"] == "g/run"
    assert c.drift_p[0] < 0.01
    assert c.bias_stability["ax"] == pytest.approx(0.02 * math.sqrt(5 / 3), rel=0.1)


def drifting(begins, duration=600.0, unit="g", shift=3e-4):
    """Calibrations whose bias moves by `shift` from one to the next, by the times of readings."""
    up = read_scheme("icosahedron-12").up
    return [
        mp.fit(
            mp.Readings(
                up + shift * i,
                unit=unit,
                environment={"time": begin + np.linspace(0.0, duration, 12)},
            ),
            scheme="icosahedron-12",
            reading_sd=1e-5,
        )
        for i, begin in enumerate(begins)
    ]


CLOCKS = {
    "one that runs on": ((0.0, 1000.0, 2000.0, 3000.0), "ordered", 3e-7),
    "in another order": ((3000.0, 2000.0, 1000.0, 0.0), "ordered", -3e-7),
    "absolute, overlapping": ((1.7e9, 1.7e9 + 300, 1.7e9 + 600, 1.7e9 + 900), "absolute", 1e-6),
    "each its own": ((0.0, 0.1, 0.0, 0.2), "as given", 3e-4),
    "the same": ((0.0, 0.0, 0.0, 0.0), "as given", 3e-4),
}


@pytest.mark.parametrize("name", CLOCKS)
def test_drift_is_against_a_common_clock_or_the_order_given(name, tmp_path, capsys):
    begins, times, slope = CLOCKS[name]
    found = drifting(begins)
    c = mp.compare(*found)
    assert (c.per, c.times) == ("run" if times == "as given" else "time", times)
    assert c.drift[0] == pytest.approx(slope, rel=1e-6)
    entry = c.to_dict()["parameters"][0]
    assert entry["drift_unit"] == ("g/run" if times == "as given" else "g/s")
    assert c.to_dict()["drift_times"] == times
    files = [str(tmp_path / f"{i}.json") for i in range(4)]
    for calibration, file in zip(found, files, strict=True):
        calibration.save(file)
    assert main(["compare", *files, "-v"]) == 0
    shown = capsys.readouterr().out
    if times == "as given":
        assert "drift per run" in shown
        assert "no common clock" in shown
    else:
        assert "drift per day" in shown
        row = [line for line in shown.splitlines() if line.startswith("bias_ax")][-1]
        assert f"{86400.0 * slope:.2g}" in row


def test_a_calibration_without_times_leaves_the_order_given():
    found = drifting((0.0, 1000.0, 2000.0))
    without = mp.fit(
        mp.Readings(read_scheme("icosahedron-12").up, unit="g"), scheme="icosahedron-12"
    )
    assert mp.compare(*found, without).times == "as given"


def half_of_stated_noise(contrasts):
    """Return U over u of parameters whose readings have the sd that is stated, and no residuals.

    With a probability of a half the sd is as stated; else readings have r times it beside it, ln r
    even between .3 and 300. Residuals of zero have the likelihood (1 + r²)^(−contrasts/2).
    """
    r = np.geomspace(0.3, 300.0, 100_001)
    likelihood = (1.0 + r**2) ** (-contrasts / 2)
    weights = np.append(1.0, likelihood / len(r))
    sds = np.append(1.0, np.sqrt(1.0 + r**2))

    def left_out(U):
        return float(weights @ special.erfc(U / sds / math.sqrt(2)) / weights.sum()) - 0.05

    return optimize.brentq(left_out, 1.0, 10.0)


def test_drift_and_spread_of_three_runs_by_hand():
    """Biases 0, 3, 3 at hours 0, 1, 5: about the means 2 and 2 the slope is (−3 + 9)/14 = 3/7.

    −8/7, 10/7 and −2/7 are left: 24/7 on one degree, u² = 24/7/14 = 12/49, t = √3/2.
    """
    up = read_scheme("faces-6").up
    found = [
        mp.fit(
            mp.Readings(up + bias, environment={"time": np.full(6, hour)}),
            scheme="faces-6",
            reading_sd=1e-3,
            orientation_sd=0,
        )
        for hour, bias in ((0.0, 0.0), (1.0, 3.0), (5.0, 3.0))
    ]
    c = mp.compare(*found)
    bias = found[0].model.index("ax", "1")
    assert c.drift[bias] == pytest.approx(3 / 7, rel=1e-9)
    assert c.drift_u[bias] == pytest.approx(math.sqrt(12) / 7, rel=1e-9)
    # Student's t on one degree of freedom is Cauchy's law
    assert c.drift_p[bias] == pytest.approx(1 - 2 / math.pi * math.atan(math.sqrt(3) / 2), rel=1e-9)
    assert c.mean[bias] == pytest.approx(2.0, rel=1e-9)
    assert c.range[bias] == pytest.approx(3.0, rel=1e-9)
    assert c.bias_stability["ax"] == pytest.approx(math.sqrt(3), rel=1e-9)
    changes, *rest = comparison_text(c).split("\n\n")
    *moved, U, by_U = changes.splitlines()[1].split()
    assert moved == ["bias_ax", "reading", "3.0000"]
    # U of both, root of the sum of squares; the fit has a grid of 14 excesses, good to .1 %
    expected = math.sqrt(2) * half_of_stated_noise(contrasts=6) * 1e-3 / math.sqrt(6)
    assert float(U) == pytest.approx(expected, abs=5e-5)
    assert float(by_U) == pytest.approx(3.0 / expected, rel=1e-3)
    lines = [line.split() for line in "\n".join(rest).splitlines()]
    (row,) = (line for line in lines if line[:1] == ["bias_ax"])
    assert row[3:8] == ["3", "3", "2.0(17)", "3.7e+04", "0.55"]  # 3/7 a second is 37,029 a day
    assert ["ax", "1.73"] in lines


def test_two_methods_on_the_same_readings():
    rng = np.random.default_rng(4)
    readings = mp.Readings(read_scheme("faces-6").up + 1e-3 * rng.standard_normal((6, 3)), unit="g")
    both = [
        mp.fit(readings, scheme="faces-6", model="own-quadratic", closed_form=closed)
        for closed in (True, False)
    ]
    c = mp.compare(*both)
    assert c.consistent
    assert math.isnan(c.p_total)
    assert "same" in c.test
    assert np.abs(np.diff(c.values, axis=0)).max() < 1e-14
    spoiled = replace(both[0], parameters=both[0].parameters + 1.0)
    assert not mp.compare(spoiled, both[1]).consistent


@pytest.mark.parametrize(
    ("bias", "scale", "moved"),
    [
        (2.3263, 2.0537, ("bias_ax", "scale_ax")),  # p = 0.02 < 0.05/2, then 0.04 < 0.05/1
        (2.3263, 1.8808, ("bias_ax",)),  # 0.02, then 0.06
        (2.1701, 2.0537, ()),  # 0.03 > 0.05/2
    ],
)
def test_what_moved_by_holm_s_method_by_hand(bias, scale, moved):
    """Four readings of sd √2: bias and scale factor have u² = 1/2, their differences 1."""
    side = np.array([1.0, 1.0, -1.0, -1.0])
    found = [
        mp.fit(
            mp.Readings(values[:, None], outputs=("ax",), up=np.outer(side, [1.0, 0.0, 0.0])),
            model="1 + x",
            reading_sd=math.sqrt(2),
        )
        for values in (side, bias + (1.0 + scale) * side)
    ]
    c = mp.compare(*map(with_known_noise, found))
    assert_allclose(c.chi2, [bias**2, scale**2], rtol=1e-9)
    assert c.moved == moved


def test_the_same_calibration_twice():
    (found,) = repeats(np.random.default_rng(1), 1)
    c = mp.compare(found, found)
    assert (c.statistic, c.p_total, c.consistent) == (pytest.approx(0), pytest.approx(1), True)


def test_no_degree_of_freedom_is_no_test():
    found = repeats(np.random.default_rng(1), 4, model="1 + x + y + z + x^2 + y^2")
    c = mp.compare(*found)
    assert math.isnan(c.p_total)
    assert c.consistent
    assert "no degrees of freedom" in c.test


def test_json_has_the_promised_keys(tmp_path, capsys):
    for i, c in enumerate(repeats(np.random.default_rng(6))):
        c.save(tmp_path / f"{i}.json")
    files = [str(tmp_path / f"{i}.json") for i in range(4)]
    assert main(["compare", *files, "--json"]) == 0
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert err == ""
    assert [entry["file"] for entry in found["calibrations"]] == files
    assert set(found["parameters"][0]) >= {
        "output",
        "term",
        "name",
        "unit",
        "values",
        "mean",
        "sd",
        "range",
        "chi2",
        "dof",
        "p",
    }
    assert set(found) >= {"bias_stability", "statistic", "dof", "p", "test", "consistent"}
    assert set(found["bias_stability"]) == {"ax", "ay", "az"}
    first = found["parameters"][0]
    assert first["range"] == pytest.approx(np.ptp(first["values"]))
    assert main(["compare", *files, "-v"]) == 0
    text = capsys.readouterr().out
    assert "bias stability" in text


def test_what_cannot_be_compared():
    rng = np.random.default_rng(1)
    (one,) = repeats(rng, 1)
    with pytest.raises(UsageError, match="two or more"):
        mp.compare(one)
    with pytest.raises(UsageError, match="between 0 and 1"):
        mp.compare(one, one, confidence=2.0)
    for options, what in (
        ({"model": "linear"}, "terms"),
        ({"convention": "gravity"}, "convention"),
        ({"unit": "V"}, "unit"),
    ):
        (other,) = repeats(rng, 1, **options)
        with pytest.raises(MultiposError, match=f"calibration 2: its {what} differ"):
            mp.compare(one, other)


@pytest.mark.parametrize(
    ("argv", "status", "message"),
    [
        (["compare"], 2, "CAL.json"),
        (["compare", "one.json"], 2, "two or more calibrations"),
        (["compare", "one.json", "none.json"], 1, "no such file"),
    ],
)
def test_command_lines_at_fault(argv, status, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    repeats(np.random.default_rng(1), 1)[0].save("one.json")
    assert main(argv) == status
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines()[-1].startswith("multipos: error: ")
    assert message in err


def test_a_combination_that_is_known_exactly_has_no_statistic():
    """Of a covariance that no inverse has, nothing is tested, and that is said."""
    found = [with_known_noise(c) for c in repeats(np.random.default_rng(5), 3, reading_sd=SD)]
    p = len(found[0].parameters)
    tied = [replace(c, covariance=np.full((p, p), 1e-6)) for c in found]
    assert math.isnan(mp.compare(*tied).p_total)


def run_of(zero, K, rng, scheme="faces-6"):
    up = read_scheme(scheme).up
    values = zero + up @ K.T + 1e-3 * rng.standard_normal(up.shape)
    return mp.fit(mp.Readings(values, unit="g"), scheme=scheme, model="linear")


def codes(found):
    return [finding.code for finding in serious(found.findings)]


def test_a_run_given_twice_is_no_repeat():
    rng = np.random.default_rng(1)
    first, second = (run_of(np.zeros(3), np.eye(3), rng) for _ in range(2))
    assert codes(mp.compare(first, second)) == []
    told = mp.compare(first, second, first)
    assert codes(told) == ["repeated-runs"]
    assert "runs 1 and 3" in told.findings[0].text


def test_what_makes_a_calibration_unfit_is_said_of_the_comparison():
    rng = np.random.default_rng(1)
    good = run_of(np.zeros(3), np.eye(3), rng)
    told = mp.compare(good, run_of(np.zeros(3), np.diag([1.0, -1.0, 1.0]), rng))
    assert codes(told)[0] == "sign"
    assert told.findings[0].text.startswith("run 2: 'ay' decreases")


def test_tests_of_several_outputs_are_combined_by_hand():
    """F(2, ν) is exceeded with (1 + 2 F/ν)^(−ν/2): 2 on 4 and 3 on 2 with 1/4 each, X = 4 ln 4.

    χ² on four degrees is above X with (1 + X/2) exp(−X/2).
    """
    # eq. (3) of verification.consistency
    # eq. (1) of sensor.fit_diagnostics
    chance = (1.0 + 2.0 * math.log(4.0)) / 16.0
    words = SimpleNamespace(known="known", one="one", several="several")
    found = judge_together([(4.0, 2.0, 4.0), (6.0, 2.0, 2.0)], words)
    assert found == (pytest.approx(4.0 * math.log(4.0)), 4.0, pytest.approx(chance), "several")
    test = ModelTest("own^2", ("ax", "ay"), (2.0, 3.0), ((2.0, 4.0), (2.0, 2.0)))
    assert (test.statistic, test.p) == (pytest.approx(4.0 * math.log(4.0)), pytest.approx(chance))
    assert test.dof == (4.0,)


def definite(n, seed):
    A = np.random.default_rng(seed).normal(size=(n, n + 2))
    return A @ A.T


def test_days_that_differ_by_their_level_are_judged_as_one_covariance_of_all_repeats():
    """Two repeats of one day and one of another: L is between those of a day as well."""
    values, day = np.random.default_rng(11).normal(size=(3, 2)), np.array([0, 0, 1])
    covariances, L = np.array([definite(2, seed) for seed in range(3)]), definite(2, 7)
    V = np.kron(day[:, None] == day, L)
    for r in range(3):
        V[2 * r : 2 * r + 2, 2 * r : 2 * r + 2] += covariances[r]
    W = np.linalg.inv(np.linalg.cholesky(V))
    rows, right = W @ np.tile(np.eye(2), (3, 1)), W @ values.ravel()
    left = right - rows @ np.linalg.solve(rows.T @ rows, rows.T @ right)
    found = _by_days(values, covariances, np.array([L] * 3), day)
    assert found == pytest.approx(left @ left, rel=1e-8)
