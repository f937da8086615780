"""What is wrong with rests and logs: cut off, wrapped around, in two units."""

import numpy as np
import pytest
from findings_bench import texts
from log_bench import columns_of, sensor

import multipos as mp
from multipos.logs.faults import _bits, find_second_unit, is_factor, is_saturated
from multipos.logs.rests import Grid, Survey, Windows

OUTPUTS = ("ax", "ay", "az")


def in_counts(log, per_g, change=lambda counts: counts):
    """The log in whole counts."""
    counts = {name: change(np.round(per_g * log[name])) for name in OUTPUTS}
    return {"time": log["time"], **counts}


@pytest.fixture(scope="module")
def log():
    return columns_of(scheme="faces-corners-14", sample_sd=5e-3)


# --- saturation


@pytest.mark.parametrize(
    ("counts", "saturated"),
    [
        ([9, 7, 1, 11, 9, 10], False),  # codes of differing width
        ([11, 7, 9, 1], False),
        ([50, 7, 9, 1], True),  # 41 more than the 9, five times √59 is 38
        ([46, 7, 9, 1], False),  # 37 more, five times √55 is 37.1
        ([1600, 1100, 900], False),  # 500 more, which is significant, but not by half
        ([1700, 1100, 900], True),
        ([30], True),  # and nothing else
    ],
)
def test_an_extreme_is_compared_with_what_stands_beside_it(counts, saturated):
    assert is_saturated(counts) is saturated


def test_a_few_codes_are_not_saturated(log):
    """Noise of 1.6 counts: six codes in a rest, each of them many times, the extreme too."""
    found = mp.average(in_counts(log, 320.0))
    assert not any("saturated" in text for text in texts(found))
    assert len(found.rests) == 14


@pytest.mark.parametrize("per_g", [1024.0, 16384.0])
def test_half_of_the_noise_cut_off_is_saturated(per_g, log):
    """A range that ends in the middle of the noise of the position with z up."""
    counts = in_counts(log, per_g)
    top = float(np.median(counts["az"][counts["az"] > 0.95 * per_g]))
    cut = counts | {"az": np.minimum(counts["az"], top)}
    with pytest.raises(mp.MultiposError, match=rf"output 'az' is saturated at {top:g} \(\d+ of"):
        mp.average(cut)
    found = mp.average(cut, accept_faults=True)
    assert len(found.rests) == 14
    assert any("'az' is saturated" in text for text in texts(found))


# --- wrap-around


@pytest.mark.parametrize("offset", [0, 2**15])
def test_numbers_that_wrap_around_are_named(offset, log):
    """1 g is 32,767.5 counts of 16 bits: the noise of ±1 g comes out at the other end."""

    def wrap(counts):
        whole = counts.astype(np.int64)
        return ((whole + 2**15) % 2**16 - 2**15 + offset).astype(float)

    wrapped = in_counts(log, 32767.5, wrap)
    with pytest.raises(mp.MultiposError, match=r"'a[xyz]' wraps around \d+ times in 16 bits"):
        mp.average(wrapped)
    with pytest.raises(mp.MultiposError, match=r"in 16 bits \(.*\), first at row \d+;"):
        mp.average(wrapped)
    row = int(np.argmax(np.abs(np.diff(wrapped["ax"])) > 60000)) + 1
    said = texts(mp.average(wrapped, accept_faults=True))
    assert any("'ax' wraps around " in t and f"first at row {row}" in t for t in said)
    assert not any("wraps" in text for text in texts(mp.average(in_counts(log, 25000.0))))


# --- units


@pytest.mark.parametrize("factor", [9.80665, 1 / 9.80665, 1000.0, 101.97])
def test_a_log_that_goes_on_in_another_unit_is_named(factor, log):
    half = len(log["time"]) // 2
    changed = {n: np.r_[c[:half], c[half:] * factor] for n, c in log.items() if n != "time"}
    with pytest.raises(mp.MultiposError, match="from about row") as raised:
        mp.average({"time": log["time"], **changed})
    said = str(raised.value)
    row = int(said.split("about row ")[1].split()[0])
    assert abs(row - half) < len(log["time"]) / 20  # of the places where a cut is tried
    larger = "larger" if factor > 1.0 else "smaller"
    told = float(said.split("readings are ")[1].split()[0])
    assert told == pytest.approx(max(factor, 1 / factor), rel=0.02)
    assert f"times {larger}: two units in one log" in said


@pytest.mark.parametrize(
    ("ratio", "units"),
    [(9.8, True), (1 / 9.8, True), (10.7, True), (10.9, False), (1000.0, True), (2.0, False)],
)
def test_factors_between_units(ratio, units):
    """g and m/s² are 9.80665 apart, and a bias moves the ratio by a tenth at most."""
    assert is_factor(ratio) is units


def test_motion_and_a_large_bias_are_no_second_unit(log):
    for bias in (0.5, 3.0, 30.0):
        shifted = {n: c + (bias if n != "time" else 0.0) for n, c in log.items()}
        assert not any("two units" in text for text in texts(mp.average(shifted)))
    survey, windows = Survey(3, Grid(4, 64)), Windows(4)
    rng = np.random.default_rng(0)
    samples = rng.normal(size=(3, 4000)) * np.repeat([1.0, 9.8], 2000)  # motion, without gravity
    survey.add(samples, *windows.feed(samples))
    assert find_second_unit(survey) == []


def test_sizes_are_of_windows_without_samples_in_common():
    survey, windows = Survey(3, Grid(2, 32)), Windows(2)
    samples = np.repeat(np.arange(40.0), 16) * np.array([[1.0], [2.0], [2.0]])
    for start in range(0, 640, 100):  # pieces that end inside a window
        part = samples[:, start : start + 100]
        survey.add(part, *windows.feed(part))
    np.testing.assert_allclose(survey.sizes(), 3.0 * np.arange(40.0), rtol=1e-12)


def test_a_sensor_of_any_unit_is_fine():
    for size in (1e-3, 1.0, 9.8, 1e3, 2.0**14):
        log = {n: c * (size if n != "time" else 1.0) for n, c in columns_of(sensor()).items()}
        assert texts(mp.average(log)) == ()


@pytest.mark.parametrize(
    ("low", "high", "step", "bits"),
    [
        (-2048.0, 2047.0, 1.0, 12),
        (0.0, 4095.0, 1.0, 12),
        (-32700.0, 32700.0, 2.0, 16),
        (0.0, 4000.0, 1.0, 0),  # of 4095 less than 98 %
        (-2049.0, 2047.0, 1.0, 0),
        (-2048.0, 2050.0, 1.0, 0),
        (-1.5, 4095.0, 1.0, 0),
        (0.0, 4095.5, 1.0, 0),
        (0.0, 4095.0, 0.5, 0),
    ],
)
def test_how_many_bits_an_output_fills(low, high, step, bits):
    assert _bits(low, high, step) == bits
