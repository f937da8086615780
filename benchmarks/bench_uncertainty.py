"""Budgets, Monte Carlo and reports, against the work that nothing can avoid and another program."""

import numpy as np

import multipos as mp
from benchmarks.timing import Ratio, paired_ratio
from multipos.estimation.gains import estimator_gain
from multipos.numerics.least_squares import solve
from multipos.reports.certificate import build_content
from multipos.reports.documents import html_report
from multipos.uncertainty.monte_carlo import simulate_budget
from multipos.uncertainty.propagation import evaluate_budget

TRIALS = 100_000
THERMOMETER = np.array(
    [21.521, 22.012, 22.512, 23.003, 23.507, 23.999, 24.513, 25.002, 25.503, 26.010, 26.511]
)
CORRECTION = -np.array(
    [0.171, 0.169, 0.166, 0.159, 0.164, 0.165, 0.156, 0.157, 0.159, 0.161, 0.160]
)


def run() -> list[Ratio]:
    return [budget(), monte_carlo(), report(), *outside()]


def readings(scheme: str) -> mp.Readings:
    up = mp.read_scheme(scheme).up
    noise = 1e-4 * np.random.default_rng(1).standard_normal(up.shape)
    return mp.Readings(up + noise, unit="g")


def budget() -> Ratio:
    data = readings("fibonacci-24")
    options = {"scheme": "fibonacci-24", "orientation_sd": 0.1}
    tables = {"gravity": {"value": 9.81, "u": 1e-5}, "gain": {"u": 1e-5}, "offset": {"u": 1e-5}}
    found = mp.fit(data, **options, budget=tables)
    pairs = paired_ratio(
        lambda: evaluate_budget(found), lambda: mp.fit(data, **options), repeats=7, inner=2
    )
    return Ratio("budget, 24 uncertain orientations", "its fit", pairs, 10)


def monte_carlo() -> Ratio:
    """The peer draws the readings and multiplies them by the gain, all at once, in NumPy."""
    exact = {"reading_sd": 1e-4, "orientation_sd": 0}
    found = mp.fit(readings("fibonacci-24"), scheme="fibonacci-24", **exact)
    gain = estimator_gain(found)
    rng = np.random.default_rng(1)

    def bare() -> object:
        return (1e-4 * rng.standard_normal((TRIALS, gain.shape[1]))) @ gain.T

    pairs = paired_ratio(lambda: simulate_budget(found, trials=TRIALS), bare, repeats=7, inner=1)
    return Ratio("100,000 Monte Carlo trials", "drawing and the matrix product", pairs, 3)


def report() -> Ratio:
    exact = {"model": "own-quadratic", "orientation_sd": 0}
    found = mp.fit(readings("dual-axis-48"), scheme="dual-axis-48", **exact)

    def figures() -> object:
        sections = build_content(found).sections
        return [figure.draw() for section in sections for figure in section.figures]

    pairs = paired_ratio(lambda: html_report(build_content(found)), figures, repeats=5, inner=1)
    return Ratio("HTML report", "drawing its figures", pairs, 1.5)


def outside() -> list[Ratio]:
    """GTC, where it is installed."""
    try:
        from GTC import type_a
    except ImportError:
        return []
    x, y = THERMOMETER - 20.0, CORRECTION
    design = np.column_stack([np.ones(11), x])
    line = paired_ratio(
        lambda: solve(design, y), lambda: type_a.line_fit(list(x), list(y)), inner=50
    )
    return [Ratio("straight line with covariance", "GTC", line, 5)]
