"""The first command in ordinary situations, against the truth and the peers of `benchmarks`."""

import re
from dataclasses import replace

import numpy as np
import pytest
from amounts import rest_slow

import multipos as mp
from benchmarks.ordinary import RATE, ROWS, error_of, line_from, measured, solved

SEEN = ("two-off-10mg", "one-off-102mg", "two-off-102mg", "five-off-41mg")


@pytest.fixture
def few_peers(name, monkeypatch):
    """Of the peers one is asked, which takes no time."""
    monkeypatch.setitem(ROWS, name, replace(ROWS[name], peers=("LM",)))


@pytest.mark.parametrize("name", rest_slow(SEEN))
@pytest.mark.usefixtures("few_peers")
def test_rests_that_are_off_are_named_and_cost_nothing(name):
    found = measured(name, 6, 1)
    assert found.named == [True] * 6
    assert found.error("multipos") <= ROWS[name].wanted


@pytest.mark.parametrize("name", ["faces-1deg", "faces-3deg"])
@pytest.mark.usefixtures("few_peers")
def test_six_faces_put_down_by_hand_are_answered(name):
    found = measured(name, 10, 1)
    assert not found.failures
    assert found.error("multipos") <= ROWS[name].wanted
    assert np.mean(found.held) >= 0.93


@pytest.mark.parametrize("name", rest_slow(["tremor-unequal", "tremor", "unequal"]))
@pytest.mark.usefixtures("few_peers")
def test_weights_that_few_samples_tell_are_no_worse_than_none(name):
    found = measured(name, 10, 1)
    assert found.ratio("LM") <= 1.05
    assert np.mean(found.held) >= 0.9


def test_edges_of_rests_in_strong_noise_are_those_of_the_truth():
    """Noise of .5 m/s²: .95 of a rest, no more than .1 s of a turn, the error of true edges."""
    ratios = []
    for seed in range(3):
        made = ROWS["noise"].make(np.random.default_rng([seed, 9]))
        rests = mp.average(made.log).to_dict()["positions"]
        assert len(rests) == len(made.up)
        kept = []
        for k, found in enumerate(rests):
            (true,) = np.nonzero(made.rest == k)
            first, end = true[0], true[-1] + 1
            assert found["start"] > first - 0.1 * RATE
            assert found["end"] < end + 0.1 * RATE
            kept.append((min(found["end"], end) - max(found["start"], first)) / (end - first))
        assert np.median(kept) >= 0.95
        means = np.array([made.values[made.rest == k].mean(axis=0) for k in range(len(made.up))])
        errors = [
            error_of(line, made, ROWS["noise"])
            for line in (line_from(mp.calibrate(made.log)), solved(means))
        ]
        ratios.append(errors[0] / errors[1])
    assert np.exp(np.mean(np.log(ratios))) <= 1.05


def test_saturated_rests_are_set_aside_and_the_others_answer():
    """A range of 1.01 g cuts off what stands near an axis: of 24 rests one or two."""
    found = measured("saturated", 4, 1)
    assert not found.failures
    assert found.ratio("soft_l1") <= 0.5
    made = ROWS["saturated"].make(np.random.default_rng([1, 2, *b"saturated"]))
    cut = {int(k) for k in made.rest[np.abs(made.values).max(axis=1) >= 9.9] if k >= 0}
    cal = mp.calibrate(made.log)
    assert {int(each.label) - 1 for each in cal.excluded} == cut
    assert [f.level for f in cal.findings if f.code == "saturated"] == ["warning"] * len(cut)
    for options in ({"exclude": "none"}, {"scheme": "fibonacci-24"}):
        with pytest.raises(mp.MultiposError, match=r"is saturated at 9\.9"):
            mp.calibrate(made.log, **options)


def test_many_saturated_rests_are_refused():
    made = ROWS["plain"].make(np.random.default_rng(3))
    log = {name: np.clip(values, -6.0, 6.0) for name, values in made.log.items()}
    with pytest.raises(mp.MultiposError, match="is saturated"):
        mp.calibrate(log | {"time": made.log["time"]})


def test_a_model_that_is_named_is_not_changed():
    made = ROWS["faces-1deg"].make(np.random.default_rng(1))
    cal = mp.calibrate(made.log)
    assert cal.model.text == "1 + own"
    assert cal.budget.tables == {"cross": {"u": 0.02}}
    # cross terms of 2 % stand in U of force between the faces, where two axes see .71 g each
    edge = mp.apply(cal, {"ax": [7.1], "ay": [6.7], "az": [0.3]}, uncertainty=True)["u_f_x"]
    assert edge == pytest.approx(0.02 * np.sqrt(0.5), rel=0.05)
    with pytest.raises(mp.RankError):
        mp.calibrate(made.log, model="linear")


def test_the_advice_for_six_faces_by_hand_is_followed():
    """Whoever states exact orientations is told; to name the scheme is no worse than not to."""
    row, before, after, unsaid, unnamed = ROWS["faces-1deg"], [], [], [], []
    for seed in range(5):
        made = row.make(np.random.default_rng(seed))
        plain = mp.calibrate(made.log, scheme="faces-6", orientation_sd=0)
        (said,) = (f for f in plain.findings if f.code == "denied-noise")
        advised = re.search(r"--orientation-sd ([\d.]+) if the sensor", str(said))
        cal = mp.calibrate(made.log, scheme="faces-6", orientation_sd=float(advised[1]))
        default = mp.calibrate(made.log, scheme="faces-6")
        without = mp.calibrate(made.log)
        codes = [{f.code for f in c.findings if f.level == "warning"} for c in (default, without)]
        assert codes[0] <= codes[1]
        parts = ((plain, before), (cal, after), (default, unsaid), (without, unnamed))
        for found, errors in parts:
            errors.append(error_of(line_from(found), made, row))
    assert np.median(after) < 0.1 * np.median(before)
    assert np.median(unsaid) <= 1.1 * np.median(unnamed)
