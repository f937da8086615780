"""Repeated regressions: Welch's test by hand and by simulation, and what is refused."""

import json
import math

import numpy as np
import pytest
from findings_bench import texts

import multipos as mp
from multipos.cli import main
from multipos.errors import MultiposError, UsageError
from multipos.numerics.quantiles import f_tail, normal_quantile
from multipos.verification.regression_repeats import welch


def table(seed, slope=2.0, zero=0.0, n=60):
    rng = np.random.default_rng(seed)
    x = np.linspace(-1.0, 1.0, n)
    return {"x": x, "y": zero + slope * x + rng.normal(0.0, 0.1, n)}


def fitted(seed, **options):
    return mp.regress(table(seed, **options), response="y", variables="x")


def test_welch_by_hand():
    """b = 1, 3 with u = 1, 1 on 10 dof: F = 2/1 = 2 on 1 and 3/(3·2·(1/4)/10) = 20."""
    # eq. (1) of verification.regression_repeats
    F, p = welch(np.array([1.0, 3.0]), np.ones(2), np.full(2, 10.0))
    assert pytest.approx(2.0) == F
    assert p == pytest.approx(f_tail(2.0, 1, 20.0))
    # three: F = 1/(1 + 2 Λ/8), Λ = 3 (2/3)²/10
    F, p = welch(np.array([0.0, 1.0, 2.0]), np.ones(3), np.full(3, 10.0))
    assert pytest.approx(1.0 / (1.0 + 0.25 * 3 * (4 / 9) / 10)) == F
    assert p == pytest.approx(f_tail(F, 2, 20.0))  # 8/(3 Λ)
    for u, dof in (([1.0, 0.0, 1.0], 10.0), ([1.0, 1.0, np.nan], 10.0), ([1.0, 1.0, 1.0], 0.0)):
        found = welch(np.array([0.0, 1.0, 2.0]), np.array(u), np.array([10.0, dof, 10.0]))
        assert np.isnan(found).all()


def test_false_alarms_are_as_stated():
    """1000 trials of four repeats on 5, 10, 20 and 40 dof; binomial at 1e-3 about 6 %."""
    rng = np.random.default_rng(1)
    dof, sd, alarms = np.array([5.0, 10.0, 20.0, 40.0]), np.array([1.0, 2.0, 1.0, 3.0]), 0
    for _ in range(1000):
        u = sd * np.sqrt(rng.chisquare(dof) / dof)
        alarms += welch(rng.normal(0.0, sd), u, dof)[1] < 0.05
    assert alarms <= 60 + normal_quantile(0.999) * math.sqrt(1000 * 0.06 * 0.94)


def test_repeats_agree_and_a_moved_one_does_not(tmp_path, capsys):
    found = mp.compare(fitted(1), fitted(2), fitted(3))
    assert found.consistent
    assert [t.term for t in found.terms] == ["1", "x"]
    slopes = [fitted(seed).segments[0].coefficients[1].value for seed in (1, 2, 3)]
    np.testing.assert_array_equal(found.terms[1].values, slopes)
    assert found.terms[1].sd == pytest.approx(np.std(slopes, ddof=1))
    paths = []
    for seed, zero in ((1, 0.0), (2, 0.0), (3, 0.5)):
        paths.append(str(tmp_path / f"{seed}.json"))
        fitted(seed, zero=zero).save(paths[-1])
    assert main(["compare", *paths, "--json"]) == 0
    out, _ = capsys.readouterr()
    moved = json.loads(out)
    assert moved["consistent"] is False
    assert [entry["file"] for entry in moved["regressions"]] == paths
    assert set(moved["terms"][0]) >= {"segment", "term", "values", "sd", "p"}
    assert "--run" in moved["findings"][0]["action"]
    assert main(["compare", *paths, "-o", str(tmp_path / "terms.svg")]) == 0
    assert "do not agree" in capsys.readouterr().out
    assert "<svg" in (tmp_path / "terms.svg").read_text()


def test_a_repeat_that_is_given_twice_is_doubted_and_repeats_keep_their_findings():
    found = mp.compare(fitted(1), fitted(2), fitted(1))
    assert [finding.code for finding in found.findings] == ["repeated-runs"]
    assert "runs 1 and 3" in found.findings[0].text
    assert found.findings[0].text.startswith("the coefficients of runs 1 and 3 are identical")
    assert found.to_dict()["findings"][0]["code"] == "repeated-runs"
    assert mp.compare(fitted(1), fitted(2)).findings == ()
    slow = table(5, n=200)
    slow["y"] += np.cumsum(np.random.default_rng(6).normal(0.0, 0.1, 200))
    drifting = mp.regress(slow, response="y", variables="x")
    found = mp.compare(fitted(1), drifting)
    assert [finding.code for finding in found.findings] == ["time-correlated"]
    assert found.findings[0].text == f"run 2: {drifting.findings[0].text}"
    assert texts(found)[0] == str(found.findings[0])


def test_a_term_that_one_repeat_lacks_is_not_tested():
    curved = table(1) | {"y": table(1)["y"] + table(1)["x"] ** 2}
    options = {"response": "y", "variables": "x", "degree": 2, "stepwise": True}
    found = mp.compare(mp.regress(curved, **options), mp.regress(table(2), **options))
    assert math.isnan(next(t.p for t in found.terms if t.term == "x^2"))


def test_refusals():
    other = mp.regress(table(1) | {"z": table(2)["y"]}, response="z", variables="x")
    cut = mp.regress(table(1), response="y", variables="x", segment="x:0")
    with pytest.raises(MultiposError, match="compare repeats of one response"):
        mp.compare(fitted(1), other)
    with pytest.raises(MultiposError, match="its segments are others"):
        mp.compare(fitted(1), cut)
    with pytest.raises(UsageError, match="compare one kind"):
        mp.compare(fitted(1), mp.demo().calibration)
    with pytest.raises(UsageError, match="two or more"):
        mp.compare(fitted(1))
