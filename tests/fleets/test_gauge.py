"""Repeatability and reproducibility, against published studies and a likelihood written out."""

import json

import numpy as np
import pytest
from fleet_bench import line
from scipy.stats import chi2

import multipos as mp
from multipos.fleets.fleet_text import fleet_text
from multipos.fleets.gauge import (
    MeanSquare,
    analyse_variance,
    coefficients,
    describe_gauge,
    interval_of,
    pool_restricted,
)
from multipos.reports.several import fleet_content

pytestmark = pytest.mark.filterwarnings("ignore::multipos.errors.CalibrationWarning")
NAMES = ("units", "stations", "stations x units", "repeats")

# The example of AIAG, Measurement Systems Analysis, 4th edition, 2010, chapter III: three
# appraisers (three rows each, a trial a row) and ten parts.
MSA = """
 0.29 -0.56 1.34 0.47 -0.80  0.02 0.59 -0.31 2.26 -1.36
 0.41 -0.68 1.17 0.50 -0.92 -0.11 0.75 -0.20 1.99 -1.25
 0.64 -0.58 1.27 0.64 -0.84 -0.21 0.66 -0.17 2.01 -1.31
 0.08 -0.47 1.19 0.01 -0.56 -0.20 0.47 -0.63 1.80 -1.68
 0.25 -1.22 0.94 1.03 -1.20  0.22 0.55  0.08 2.12 -1.62
 0.07 -0.68 1.34 0.20 -1.28  0.06 0.83 -0.34 2.19 -1.50
 0.04 -1.38 0.88 0.14 -1.46 -0.29 0.02 -0.46 1.77 -1.49
-0.11 -1.13 1.09 0.20 -1.07 -0.67 0.01 -0.56 1.45 -1.77
-0.15 -0.96 0.67 0.11 -1.45 -0.49 0.21 -0.49 1.87 -2.16
"""
# Gaskets, after ASQC/AIAG 1990, as the SAS/QC manual has them in table A.1 of its application to
# gauges: ten parts, each twice by three operators.
GASKETS = """
0.65 0.60 0.55 0.55 0.50 0.55
1.00 1.00 1.05 0.95 1.05 1.00
0.85 0.80 0.80 0.75 0.80 0.80
0.85 0.95 0.80 0.75 0.80 0.80
0.55 0.45 0.40 0.40 0.45 0.50
1.00 1.00 1.00 1.05 1.00 1.05
0.95 0.95 0.95 0.90 0.95 0.95
0.85 0.80 0.75 0.70 0.80 0.80
1.00 1.00 1.00 0.95 1.05 1.05
0.60 0.70 0.55 0.50 0.85 0.80
"""


def numbers(text):
    return np.array([row.split() for row in text.split("\n") if row], dtype=float)


def msa():
    return numbers(MSA).reshape(3, 3, 10).transpose(2, 0, 1)


def gaskets():
    return numbers(GASKETS).reshape(10, 3, 2)


def sds(found):
    keys = ("repeatability", "reproducibility", "interaction", "gauge", "units")
    return [found[key]["sd"] for key in keys]


def test_the_study_of_the_msa_manual():
    # eq. (1) of fleets.gauge
    found = describe_gauge(msa())
    lines = {each["source"]: each for each in found["anova"]}
    # its analysis of variance, as printed
    assert [lines[name]["dof"] for name in NAMES] == [9, 2, 18, 60]
    squares = [lines[name]["squares"] for name in NAMES]
    assert squares == pytest.approx([88.3619, 3.1673, 0.3590, 2.7589], abs=5e-5)
    assert lines["stations x units"]["F"] == pytest.approx(0.434, abs=5e-4)
    # as printed, where the interaction is pooled: EV, AV, interaction, GRR, PV
    assert sds(found) == pytest.approx([0.199933, 0.226838, 0.0, 0.302373, 1.042327], abs=2e-6)
    assert found["share"] == pytest.approx(0.279, abs=5e-4)
    assert found["distinct"] == 4


def test_the_study_of_gaskets_whose_operators_differ_from_part_to_part():
    found = describe_gauge(gaskets(), width=1.0)
    lines = {each["source"]: each for each in found["anova"]}
    # the same data in Minitab's help, "Two-Way ANOVA Table with Interaction", as printed
    squares = [lines[name]["squares"] for name in NAMES]
    assert squares == pytest.approx([2.05871, 0.04800, 0.10367, 0.03875], abs=5e-6)
    F = [lines[name]["F"] for name in NAMES[:3]]
    assert pytest.approx([39.7178, 4.1672, 4.4588], abs=5e-5) == F
    assert lines["stations"]["p"] == pytest.approx(0.033, abs=5e-4)
    # by hand from these: (0.024 − 0.00575926)/20, (0.00575926 − 0.00129167)/2 and so on
    variances = [found[key]["sd"] ** 2 for key in ("station", "interaction", "repeatability")]
    assert variances == pytest.approx([0.0009120, 0.0022338, 0.0012917], abs=5e-8)
    total = [found[key]["sd"] ** 2 for key in ("reproducibility", "gauge", "units")]
    assert total == pytest.approx([0.0031458, 0.0044375, 0.0371644], abs=5e-8)
    assert found["tolerance"] == pytest.approx(6.0 * np.sqrt(0.0044375))
    for key in ("repeatability", "station", "interaction", "gauge", "units"):
        # none is negative, so both routes are one
        assert found[key]["variance_anova"] == pytest.approx(found[key]["sd"] ** 2)


def restricted(values, variances):
    """The restricted log-likelihood of variances of units, stations, both and repeats."""
    p, s, r = values.shape
    unit, station, _ = (each.ravel() for each in np.indices(values.shape))
    V = variances[3] * np.eye(p * s * r)
    for variance, who in ((variances[0], unit), (variances[1], station)):
        V += variance * (who[:, None] == who)
    V += variances[2] * ((unit[:, None] == unit) & (station[:, None] == station))
    ones, y = np.ones(len(V)), values.ravel()
    solved = np.linalg.solve(V, np.column_stack((ones, y)))
    information = ones @ solved[:, 0]
    mean = ones @ solved[:, 1] / information
    left = (y - mean) @ np.linalg.solve(V, y - mean)
    return -0.5 * (np.linalg.slogdet(V)[1] + np.log(information) + left)


@pytest.mark.parametrize("seed", range(12))
def test_what_is_pooled_is_the_maximum_of_the_restricted_likelihood(seed):
    # eq. (2) of fleets.gauge
    from scipy.optimize import minimize

    rng = np.random.default_rng(seed)
    p, s, r = 4, 3, 2
    values = 1.0 * rng.standard_normal((p, s, r))  # repeats alone, so that much is at zero
    values += (seed % 3) * 0.7 * rng.standard_normal((p, 1, 1))
    values += (seed % 2) * 0.7 * rng.standard_normal((1, s, 1))
    found = describe_gauge(values)
    keys = ("units", "station", "interaction", "repeatability")
    mine = np.array([found[key]["sd"] ** 2 for key in keys])

    def cost(x):
        return -restricted(values, x)

    best = min(
        (
            minimize(cost, start, bounds=[(0.0, 20.0)] * 3 + [(1e-3, 20.0)], method="L-BFGS-B")
            for start in ([0.5, 0.5, 0.5, 1.0], [0.05, 0.05, 0.05, 1.5], [1.0, 0.01, 0.01, 0.7])
        ),
        key=lambda each: each.fun,
    )
    # the search ends within its own tolerance of the value; near the maximum 1e-2 costs 1e-4
    assert cost(mine) <= best.fun + 1e-7
    np.testing.assert_allclose(mine, best.x, atol=2e-2)


def test_intervals_cover_what_they_say():
    rng = np.random.default_rng(7)
    p, s, r, runs = 8, 3, 3, 1500
    sd = {"units": 2.0, "station": 0.7, "interaction": 0.4, "repeatability": 1.0}
    truth = {name: value**2 for name, value in sd.items()}
    truth["reproducibility"] = truth["station"] + truth["interaction"]
    truth["gauge"] = truth["reproducibility"] + truth["repeatability"]
    shares = coefficients(p, s, r)
    inside = dict.fromkeys(truth, 0)
    for _ in range(runs):
        values = sd["units"] * rng.standard_normal((p, 1, 1))
        values = values + sd["station"] * rng.standard_normal((1, s, 1))
        values = values + sd["interaction"] * rng.standard_normal((p, s, 1))
        values = values + sd["repeatability"] * rng.standard_normal((p, s, r))
        found = analyse_variance(values)
        for name, true in truth.items():
            low, high = interval_of(shares[name], found, 0.95)
            inside[name] += low <= true <= high
    for name, count in inside.items():
        # four binomial sd; that of repeatability is exact, sums are built to cover at least
        assert count / runs > 0.95 - 0.0225, name
    assert inside["repeatability"] / runs < 0.95 + 0.0225


def test_mean_squares_in_order_are_left_as_they_are():
    found = analyse_variance(gaskets())
    alone = {name: each.value for name, each in found.items()}
    assert pool_restricted(found) == pytest.approx(alone)


def study(units, stations, repeats, *, seed=0, shift=2e-3, again=5e-4):
    """Rows of units that were at every station several times, and their biases (p, s, r, 3)."""
    rng = np.random.default_rng(seed)
    up = mp.read_scheme("faces-corners-14").up
    shape = (units, stations, repeats)
    bias = 1e-2 * rng.standard_normal((units, 1, 1, 3))
    bias = bias + shift * rng.standard_normal((1, stations, 1, 3))
    bias = bias + again * rng.standard_normal((*shape, 3))
    values = bias[..., None, :] + up + 1e-4 * rng.standard_normal((*shape, 14, 3))
    at = np.indices((*shape, 14))
    columns = {
        "unit": np.array([f"U{i}" for i in range(units)])[at[0].ravel()],
        "station": np.array([f"S{i}" for i in range(stations)])[at[1].ravel()],
        "position": (at[3].ravel() + 1).astype(str),
    }
    return columns | {f"a{axis}": values[..., i].ravel() for i, axis in enumerate("xyz")}, bias


APART = {"unit_column": "unit", "station_column": "station", "scheme": "faces-corners-14"}


def test_repeats_in_a_table_are_a_study_of_every_parameter():
    table, bias = study(6, 3, 2)
    found = mp.fleet(table, limits={"bias_ax": (-0.05, 0.05)}, **APART)
    gauge = found["gauge"]
    assert (gauge["units"], gauge["stations"]) == (
        tuple(f"U{i}" for i in range(6)),
        ("S0", "S1", "S2"),
    )
    assert gauge["repeats"] == 2
    by_name = {each["name"]: each for each in gauge["parameters"]}
    for i, axis in enumerate("xyz"):
        # what was put in, but for 27 ug of noise of a fit of 14 readings
        true = describe_gauge(bias[..., i])
        for key in ("repeatability", "reproducibility", "gauge", "units"):
            assert by_name[f"bias_a{axis}"][key]["sd"] == pytest.approx(true[key]["sd"], rel=0.1)
    assert by_name["bias_ax"]["tolerance"] == pytest.approx(
        6.0 * by_name["bias_ax"]["gauge"]["sd"] / 0.1
    )
    assert by_name["bias_ay"]["tolerance"] is None
    plain = found.to_dict()
    assert json.loads(json.dumps(plain["gauge"])) == plain["gauge"]
    title = "Repeatability and reproducibility, 6 units x 3 stations x 2 repeats"
    assert title in fleet_text(plain)
    page = fleet_content(plain).sections
    assert "Repeatability and reproducibility" in [section.title for section in page]


def test_rows_of_repeats_may_stand_anywhere():
    table, _ = study(4, 2, 2, seed=3)
    whole = mp.fleet(table, **APART)["gauge"]
    # position by position instead of run by run: the first of each is still the first run
    order = np.argsort(np.array([int(label) for label in table["position"]]), kind="stable")
    mixed = {name: np.asarray(column)[order] for name, column in table.items()}
    again = mp.fleet(mixed, **APART)["gauge"]
    for one, other in zip(whole["parameters"], again["parameters"], strict=True):
        assert one["gauge"]["sd"] == pytest.approx(other["gauge"]["sd"], rel=1e-9)


def test_units_that_were_not_everywhere_or_failed_are_left_out():
    table, _ = study(6, 3, 3, seed=4)
    unit, station = table["unit"], table["station"]
    trial = np.tile(np.repeat(np.arange(3), 14), 18)
    gone = (unit == "U1") & (station == "S2")  # never there
    gone |= (unit == "U2") & (trial == 2)  # twice only, and so all of them
    kept = {name: np.asarray(column)[~gone].copy() for name, column in table.items()}
    flipped = (kept["unit"] == "U4") & (kept["station"] == "S1")
    kept["ax"][np.flatnonzero(flipped)[0]] *= -1.0
    gauge = mp.fleet(kept, **APART)["gauge"]
    assert gauge["units"] == ("U0", "U2", "U3", "U5")
    assert gauge["repeats"] == 2


@pytest.mark.parametrize("size", [(4, 1, 3), (4, 2, 1), (1, 2, 2)])
def test_without_repeats_at_several_stations_there_is_none(size):
    table, _ = study(*size)
    found = mp.fleet(table, **APART)
    assert found["gauge"] is None
    assert "reproducibility" not in fleet_text(found.to_dict())


def test_a_table_without_labels_has_no_repeats():
    table = line(20, stations=2, scheme="faces-corners-14")
    table["unit"] = np.repeat(np.arange(20) // 4, 14)
    del table["position"]
    assert mp.fleet(table, unit_column="unit", station_column="station")["gauge"] is None


def test_interval_of_a_difference_by_hand():
    """Eq. (3) of 20 on 5 less 2 on 10 with χ² of tables: 0.831 and 12.833, 3.247 and 20.483."""
    # eq. (3) of fleets.gauge
    found = {"a": MeanSquare(100.0, 5.0), "b": MeanSquare(20.0, 10.0)}
    low = 18.0 - np.hypot((1 - 5 / 12.833) * 20, (10 / 3.247 - 1) * 2)
    high = 18.0 + np.hypot((5 / 0.831 - 1) * 20, (1 - 10 / 20.483) * 2)
    interval = interval_of({"a": 1.0, "b": -1.0}, found, 0.95)
    assert interval == pytest.approx((low, high), rel=1e-3)


def test_repeatability_has_the_interval_of_a_standard_deviation():
    values = np.random.default_rng(8).normal(5.0, 0.3, (4, 3, 3))
    found = describe_gauge(values, confidence=0.9)["repeatability"]
    square = np.sum((values - values.mean(axis=2, keepdims=True)) ** 2)
    assert found["low"] == pytest.approx(np.sqrt(square / chi2.isf(0.05, 24)), rel=1e-9)
    assert found["high"] == pytest.approx(np.sqrt(square / chi2.ppf(0.05, 24)), rel=1e-9)
