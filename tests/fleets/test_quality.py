"""Yield, capability and risks against published figures and simulation."""

import numpy as np
import pytest

from multipos.fleets.quality import capability, proportion, spread_of, wrong_verdicts


def test_the_interval_of_a_yield_is_that_of_the_beta_laws():
    # by hand: of n without a failure the lower end is (α/2)^(1/n), the upper one 1
    none = proportion(20, 20)
    assert none.high == 1.0
    assert none.low == pytest.approx(0.025 ** (1 / 20), rel=1e-12)
    assert proportion(0, 20).high == pytest.approx(1.0 - 0.025 ** (1 / 20), rel=1e-12)
    # Newcombe, Statistics in Medicine 17, 1998, table I, method 5: 81 of 263, 15 of 148
    assert tuple(round(x, 4) for x in proportion(81, 263)[1:]) == (0.2527, 0.3676)
    assert tuple(round(x, 4) for x in proportion(15, 148)[1:]) == (0.0578, 0.1617)


def test_capability_is_that_of_the_handbook():
    # eq. (1) of fleets.quality
    # NIST/SEMATECH e-Handbook, 6.1.6: USL 20, LSL 8, mean 16, sd 2: Cpk .6667
    x = np.array([-1.0, 1.0])
    stretched = 16.0 + 2.0 * x / x.std(ddof=1)
    found = capability(spread_of(stretched, None, np.zeros(2, dtype=int)), 8.0, 20.0, "sd")
    assert found.value == pytest.approx(2.0 / 3.0, rel=1e-12)


def test_the_interval_is_bissells():
    # eq. (2) of fleets.quality
    rng = np.random.default_rng(3)
    x = rng.normal(size=50)
    spread = spread_of(x, None, np.zeros(50, dtype=int))
    found = capability(spread, -3.0, 4.0, "sd")
    half = 1.959963984540054 * np.sqrt(1 / (9 * 50) + found.value**2 / (2 * 49))
    assert found.high - found.value == pytest.approx(half, rel=1e-12)
    assert found.value - found.low == pytest.approx(half, rel=1e-12)


def test_spreads_within_stations_and_without_the_measurement_by_hand():
    x = np.array([0.0, 2.0, 10.0, 12.0])
    spread = spread_of(x, np.full(4, 1.0), np.array([0, 0, 1, 1]))
    assert spread.mean == 6.0
    assert spread.sd == pytest.approx(np.sqrt((36 + 16 + 16 + 36) / 3))
    assert spread.within == pytest.approx(np.sqrt(2.0))  # (1 + 1 + 1 + 1)/2
    assert spread.dof_within == 2.0
    assert spread.true == pytest.approx(np.sqrt(104 / 3 - 1.0))
    cpk = capability(spread, 0.0, 20.0, "within")
    assert cpk.value == pytest.approx(6.0 / (3.0 * np.sqrt(2.0)))
    ratio = (104 / 3) / 2.0  # of the squares, on the two degrees of freedom within stations
    half = 1.959963984540054 * np.sqrt(ratio / 36.0 + cpk.value**2 / 4.0)
    assert cpk.high - cpk.value == pytest.approx(half, rel=1e-12)
    assert capability(spread, -np.inf, np.inf, "sd") is None
    assert np.isnan(spread_of(x, np.full(4, 100.0), np.zeros(4, dtype=int)).true)


@pytest.mark.parametrize("which", ["sd", "true"])
def test_intervals_of_capability_cover(which):
    rng = np.random.default_rng(5)
    n, runs, u = 80, 600, 0.8
    sigma = 1.0 if which == "true" else np.hypot(1.0, u)
    truth = 3.0 / (3.0 * sigma)
    inside = 0
    for _ in range(runs):
        x = rng.normal(size=n) + u * rng.normal(size=n)
        spread = spread_of(x, np.full(n, u), np.zeros(n, dtype=int))
        found = capability(spread, -3.0, 4.0, which)
        inside += found.low <= truth <= found.high
    # a normal interval of 80 units: 0.93 at least; four binomial sd at 600 runs are 0.036
    assert 0.93 - 0.036 < inside / runs < 0.99


def test_risks_are_those_of_a_simulation():
    # eq. (3) of fleets.quality
    rng = np.random.default_rng(6)
    true = 0.3 + rng.normal(size=400_000)
    u = 0.4
    measured = true + u * rng.normal(size=len(true))
    spread = spread_of(measured[:], np.full(len(true), u), np.zeros(len(true), dtype=int))
    found = wrong_verdicts(spread, u, -1.5, 2.0)
    good, passed = (true > -1.5) & (true < 2.0), (measured > -1.5) & (measured < 2.0)
    # binomial: shares of some percent of 400,000 are good to 5e-4 (two sd)
    assert found["consumer"] == pytest.approx(np.mean(passed & ~good), abs=1e-3)
    assert found["producer"] == pytest.approx(np.mean(~passed & good), abs=1e-3)
