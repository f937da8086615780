"""Movement in a static record: found where there is one, and in no kind of noise or warm-up."""

import numpy as np
import pytest
from findings_bench import texts

import multipos as mp
from multipos.bias_stability.movement import find_movement


def noise(rng, kind, n=300):
    white = rng.standard_normal(n)
    if kind == "walk":
        return np.cumsum(white)
    if kind == "flicker":
        frequency = np.fft.rfftfreq(n)
        frequency[0] = 1.0
        return np.fft.irfft(np.fft.rfft(white) / np.sqrt(frequency), n)
    return white


@pytest.mark.parametrize("kind", ["white", "walk", "flicker"])
def test_noise_drift_and_warm_up_are_no_movement_and_steps_are(kind):
    rng = np.random.default_rng(3)
    block = np.arange(300.0)
    for time_constant in (1.0, 3.0, 10.0, 50.0, 100.0) * 4:
        means = noise(rng, kind) + 2000.0 * np.exp(-block / time_constant) + 0.1 * block
        means += 50.0 * np.sin(block / 30.0)
        assert find_movement(means) is None
        step = 30.0 * np.std(np.diff(means))
        moved = means + step * (block >= 150.0)
        found = find_movement(moved)
        assert found.count == 1
        assert abs(found.block - 150) <= 1
        assert found.jump == pytest.approx(step, rel=0.5)
        knocked = means + step * (block == 150.0)
        assert abs(find_movement(knocked).block - 150) <= 2


def test_a_record_that_is_short_or_of_few_codes_says_nothing():
    assert find_movement(np.zeros(20)) is None
    codes = np.zeros(300)
    codes[200:] = 1.0
    assert find_movement(codes) is None


def test_stability_says_what_was_moved():
    rng = np.random.default_rng(5)
    values = 1e-4 * rng.standard_normal(20_000)
    record = {"time": np.arange(20_000) / 100.0, "ax": values}
    assert not any("moved" in text for text in texts(mp.stability(record, unit="g")))
    values = values + 0.01 * (record["time"] > 120.0)
    said = texts(mp.stability({**record, "ax": values}, unit="g"))
    (text,) = (text for text in said if "moved or knocked" in text)
    assert "ax jumps by 0.01 near 120 s" in text


def test_a_movement_is_eight_standard_deviations_by_hand():
    # eq. (1) of bias_stability.movement
    means = np.random.default_rng(2).standard_normal(200) + 5.0 * np.arange(200.0)  # a drift
    jumps = means[2:] - means[:-2]
    usual = 1.4826 * np.median(np.abs(jumps - np.median(jumps)))
    both = max(jumps[100:102]) - np.median(jumps)  # over the blocks before and after the step
    for times, found in ((7.6, None), (8.4, 1)):
        knocked = means.copy()
        knocked[102:] += times * usual - both
        movement = find_movement(knocked)
        assert (movement and movement.count) == found
    assert movement.jump == knocked[movement.block + 1] - knocked[movement.block - 1]
