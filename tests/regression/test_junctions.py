"""By how much segments differ where they meet, by hand and by the other fit."""

import numpy as np
import pytest

import multipos as mp
from multipos.numerics.quantiles import coverage_factor


def table(jump, noise=0.0):
    x = np.linspace(-1.0, 1.0, 81)[:-1] + 0.0125
    rng = np.random.default_rng(1)
    return {"x": x, "y": 2.0 + x + jump * (x > 0) + noise * rng.standard_normal(len(x))}


def test_a_jump_is_found():
    r = mp.regress(table(0.5), response="y", variables="x", segment="x:0", free=True)
    (junction,) = r.junctions
    assert (junction.edge, junction.branch) == (0.0, None)
    assert junction.jump == pytest.approx(0.5)
    assert junction.clear
    assert "jump" in [finding.code for finding in r.findings]
    assert "jump       at x = 0: up to 0.5" in str(r)


def test_u_of_a_jump_is_that_of_both_lines():
    """At x = 0 a line of forty points, steps h, middle 20 h away: s² (1/40 + 400 h²/Sxx)."""
    # eq. (1) of regression.junctions
    r = mp.regress(table(0.0, 0.1), response="y", variables="x", segment="x:0", free=True)
    (junction,) = r.junctions
    h, n = 0.025, 40
    spread = h**2 * n * (n**2 - 1) / 12
    variance = sum(s.rms**2 * (1 / n + (20 * h) ** 2 / spread) for s in r.segments)
    assert junction.u == pytest.approx(np.sqrt(variance))
    assert pytest.approx(coverage_factor(0.95, 38) * junction.u) == junction.U
    assert not junction.clear
    assert "jump" not in [finding.code for finding in r.findings]


def test_pieces_that_meet_have_none_and_files_keep_them(tmp_path):
    joined = mp.regress(table(0.5), response="y", variables="x", segment="x:0")
    assert joined.junctions == ()
    assert joined == mp.regress(
        table(0.5), response="y", variables="x", segment="x:0", continuous=True
    )
    edges = "x:-0.5,0"
    apart = mp.regress(table(0.5, 0.01), response="y", variables="x", segment=edges, free=True)
    apart.save(tmp_path / "reg.json")
    assert mp.load_regression(tmp_path / "reg.json") == apart
    assert [entry["edge"] for entry in apart.to_dict()["jumps"]] == [-0.5, 0.0]


def test_equal_thresholds_are_taken():
    equal = {"enter": 0.15, "remove": 0.15}
    found = mp.regress(table(0.0, 0.1), response="y", variables="x", stepwise=True, **equal)
    assert found.thresholds == equal
    by_f = mp.regress(
        table(0.0, 0.1), response="y", variables="x", stepwise=True, f_enter=4.0, f_remove=4.0
    )
    assert by_f.thresholds["f_remove"] == 4.0
