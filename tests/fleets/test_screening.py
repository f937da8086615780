"""A unit of a batch that is not fit for use is found so, with all that a fit of it alone says."""

import numpy as np
import pytest
from amounts import rest_slow
from fleet_bench import line, rows_of

import multipos as mp

pytestmark = pytest.mark.filterwarnings("ignore::multipos.errors.CalibrationWarning")


def flipped(values, i, j):
    values[:, i] *= -1.0


def interchanged(values, i, j):
    values[:, [i, j]] = values[:, [j, i]]


def in_another_unit(values, i, j):
    values[:, i] *= 9.80665


def permuted(values, i, j):
    values[:] = values[[1, 0, 2]]


def reversed_output(values, i, j):
    values[1] *= -1.0


def clipped(values, i, j):
    np.clip(values[2], -0.9 * abs(values).max(), 0.9 * abs(values).max(), out=values[2])


def copied(values, i, j):
    values[:, i] = values[:, j]


def output_in_another_unit(values, i, j):
    values[0] *= 9.80665


def dead(values, i, j):
    values[0] = values[0, 0]


def shaken(values, i, j):
    values[0, i] += 0.01 * abs(values).max()


FAULTS = (
    *(flipped, interchanged, in_another_unit, permuted, reversed_output, clipped),
    *(copied, output_in_another_unit, dead, shaken),
)


@pytest.mark.parametrize(
    ("each", "scheme", "noise", "counts", "options"),
    rest_slow(
        [
            (1, "fibonacci-24", 3e-4, 0.0, {}),
            (1, "faces-corners-14", 2e-3, 16384.0, {}),
            (1, "song-qin-6", 1e-3, 0.0, {}),
            (2, "fibonacci-24", 3e-4, 0.0, {}),
            (2, "faces-corners-14", 2e-3, 16384.0, {}),
            (2, "song-qin-6", 1e-3, 0.0, {}),
            (2, "fibonacci-24", 3e-4, 16384.0, {"orientation_sd": 0.5}),
            (2, "faces-corners-14", 3e-4, 0.0, {"orientation_sd": 0.1, "reading_sd": 3e-4}),
        ],
        quick=3,
    ),
)
def test_no_doubt_of_a_fit_is_lost(each, scheme, noise, counts, options):
    faulty = each * len(FAULTS)
    units = faulty + 2 * each
    table = line(units, scheme=scheme, noise=noise, seed=3)
    if counts:
        for axis in "xyz":
            table[f"a{axis}"] = np.round(counts * table[f"a{axis}"])
    n = len(table["unit"]) // units
    rng = np.random.default_rng(4)
    for unit in range(faulty):
        rows = slice(unit * n, unit * n + n)
        values = np.array([table[f"a{axis}"][rows] for axis in "xyz"])
        FAULTS[unit % len(FAULTS)](values, *rng.choice(n, 2, replace=False))
        for axis, column in zip("xyz", values, strict=True):
            table[f"a{axis}"][rows] = column
    found = mp.fit_many(table, unit_column="unit", station_column="station", **options)
    doubted = 0
    for row, unit in enumerate(found["unit"]):
        if found["reason"][row]:  # a dead output, where outputs are fitted together
            continue
        findings = mp.fit(rows_of(table, unit), **options).diagnostics.findings
        if any(finding.level == "error" for finding in findings):
            doubted += 1
            serious = [each.code for each in findings if each.level != "note"]
            assert found["findings"][row].split(";") == list(dict.fromkeys(serious))
    assert doubted  # a dead output at least
