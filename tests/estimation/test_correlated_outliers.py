"""Outliers among correlated readings: named at their nominal rate, and alone."""

import numpy as np
import pytest

import multipos as mp
from multipos.sensor.studentised import OUTLIER_LEVEL, find_correlated_outliers

N, M, P = 10, 2, 6


@pytest.fixture(scope="module")
def case():
    rng = np.random.default_rng(1)
    A = rng.standard_normal((N * M, N * M))
    return rng.standard_normal((N * M, P)), np.eye(N * M) + 30.0 * A @ A.T / (N * M)


def residuals(case, readings):
    """Those of generalised least squares, by whitening."""
    X, C = case
    L = np.linalg.cholesky(C)
    b = np.linalg.lstsq(np.linalg.solve(L, X), np.linalg.solve(L, readings), rcond=None)[0]
    return (readings - X @ b).reshape(N, M)


def named(case, readings):
    labels = [str(i) for i in range(N)]
    return find_correlated_outliers(*case[:1], residuals(case, readings), case[1], "ab", labels)


def test_good_readings_are_named_at_the_nominal_rate(case):
    rng = np.random.default_rng(2)
    L = np.linalg.cholesky(case[1])
    runs = 2000
    rate = sum(bool(named(case, 7.0 * L @ rng.standard_normal(N * M))) for _ in range(runs)) / runs
    # Bonferroni: at most the level, and nearly that; 3.3 standard deviations of the count
    spread = 3.3 * np.sqrt(OUTLIER_LEVEL / runs)
    assert 0.5 * OUTLIER_LEVEL - spread < rate < OUTLIER_LEVEL + spread


def test_a_shifted_reading_is_named_alone(case):
    rng = np.random.default_rng(3)
    readings = np.linalg.cholesky(case[1]) @ rng.standard_normal(N * M)
    readings[4 * M + 1] += 60.0
    (said,) = named(case, readings)
    assert said.startswith("position 4: b is off by")


def test_a_fit_of_correlated_readings_names_no_good_position():
    """A common mode from one reading to the next made every fourteenth set look bad."""
    rng = np.random.default_rng(8)
    up = mp.read_scheme("faces-edges-18").up
    A = rng.standard_normal((54, 54))
    C = 1e-8 * (np.eye(54) + 30.0 * A @ A.T / 54)
    L = np.linalg.cholesky(C)
    sets = [up + (L @ rng.standard_normal(54)).reshape(18, 3) for _ in range(25)]
    found = [mp.fit(mp.Readings(values, up=up, covariance=C)) for values in sets]
    assert sum(bool(cal.diagnostics.outliers) for cal in found) <= 3  # 0.4 expected


def test_a_shift_is_as_large_as_a_column_of_its_own_says(case):
    """w² over the scale is what leaving the reading's shift free takes off r'C⁻¹r."""
    # eq. (2) of sensor.studentised
    X, C = case
    L = np.linalg.cholesky(C)
    readings = L @ np.random.default_rng(3).standard_normal(N * M)
    readings[9] += 60.0
    rest = []
    for design in (X, np.column_stack([X, np.eye(N * M)[9]])):
        white = np.linalg.solve(L, np.column_stack([design, readings]))
        b = np.linalg.lstsq(white[:, :-1], white[:, -1], rcond=None)[0]
        rest.append(float(np.sum((white[:, -1] - white[:, :-1] @ b) ** 2)))
    times = np.sqrt((rest[0] - rest[1]) / (rest[0] / (N * M - P)))
    (said,) = named(case, readings)
    assert f", {times:.1f} times its standard deviation" in said
