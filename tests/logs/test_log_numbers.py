"""Numbers of logs by hand or by a second route, at points without symmetry."""

import math
from dataclasses import replace
from datetime import UTC, datetime
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import chi2

import multipos as mp
from multipos.logs import (
    common_noise,
    faults,
    log_columns,
    opening,
    rest_means,
    rests,
    text_logs,
    waved,
)
from multipos.logs.clock import read_dates, unwrap
from multipos.logs.common_noise import _alike, _are_usual
from multipos.logs.ellipsoids import off_the_ellipsoid
from multipos.logs.faults import find_stuck, find_wrapped
from multipos.logs.matching import _match_rows
from multipos.logs.rest_means import (
    RestMean,
    _allan_line,
    _centred_batches,
    _cosines,
    _edge,
    _lines,
    with_rounding,
)
from multipos.logs.rests import (
    Grid,
    Limits,
    Rest,
    Run,
    Spikes,
    _valley,
    is_long,
    long_enough,
)
from multipos.logs.samples import Samples, Store, Timing, good_rows
from multipos.logs.still import _find_spikes, would_take
from multipos.logs.text_logs import _decode, open_lines
from multipos.logs.waved import find_cut_off

# --- clocks and cells


def test_times_that_wrap_go_on():
    time = np.array([7.0, 9.5, 1.5, 4.0])
    found = unwrap(time, np.nan, 0.0, 2.5, (5.0, 10.0, 100.0))
    assert (found.size, found.wraps) == (10.0, 1)
    assert_allclose(found.time, [7.0, 9.5, 11.5, 14.0])
    assert unwrap(time[2:], 9.5, 10.0, 2.5, ()).time.tolist() == [11.5, 14.0]
    assert unwrap(time, np.nan, 0.0, 0.019, (10.0,)).size == 0.0  # 2 is beyond 100 usual steps
    assert unwrap(time, np.nan, 0.0, 0.021, (10.0,)).size == 10.0
    assert unwrap(time, np.nan, 0.0, 2.5, (7.9,)).size == 0.0  # it would go back


@pytest.mark.parametrize(
    "cell",
    [
        "2026-11-21 13:04:05.25", "2026/11/21 13:04:05.25", "21.11.2026 13:04:05,25",
        "11/21/2026 13:04:05.25", "2026-11-21T13:04:05.25", "2026-11-21 13:04:05.25 +01:00",
    ],
)  # fmt: skip
def test_dates_are_seconds_since_1970(cell):
    truth = datetime(2026, 11, 21, 13, 4, 5, 250_000, tzinfo=UTC).timestamp()
    found = read_dates([cell, "nothing"])
    assert found[0] == pytest.approx(truth, abs=1e-6)
    assert math.isnan(found[1])


def test_times_without_a_date_are_seconds_since_midnight():
    assert_allclose(read_dates(["9:04:05.5", "23:59:59"]), [32645.5, 86399.0])
    assert_allclose(read_dates(["9:04:05:500", "9:04:05:50000"]), [32645.5, np.nan])


def test_an_hour_behind_a_date_may_have_one_digit():
    assert_allclose(np.diff(read_dates(["1/2/2026 9:04", "2026-01-02 10:05"])), [3660.0])


# --- rests


def test_rests_are_as_long_as_those_of_the_log():
    """Of 900, 100, 110 and 20 samples the usual without the longest is 100: .4 of it."""
    rests = [Rest(0, 900), Rest(1000, 1100), Rest(1200, 1310), Rest(1400, 1420), Rest(1500, 1539)]
    long, short, shortest = long_enough(rests, Grid(2, 120, True))
    by_hand = int(0.4 * np.median([100, 110, 20, 39]))
    assert shortest == max(24, by_hand) == 27
    assert [rest.start for rest in long] == [0, 1000, 1200, 1500]
    assert [rest.start for rest in short] == [1400]
    long, short, shortest = long_enough(rests, Grid(2, 120, False))
    assert (shortest, [rest.start for rest in long]) == (120, [0])
    assert is_long(Rest(0, 117), 120, Grid(2, 120))
    assert not is_long(Rest(0, 116), 120, Grid(2, 120))


def mean_of(n=100, **given):
    ones = np.ones(2)
    fields = dict.fromkeys(RestMean.__dataclass_fields__, ones) | {"n": n} | given
    return RestMean(**fields)


def test_rounding_adds_what_noise_does_not_average_out():
    """Noise of .03 q²: B by eq. (4), and samples vary by v + 1/12 − B."""
    # eq. (4) of logs.rest_means
    v, q = 0.03, 0.5
    k = np.arange(1, 60)
    B = np.sum(np.exp(-4 * np.pi**2 * k**2 * v) / (2 * np.pi**2 * k**2))
    sd = q * math.sqrt(v + 1.0 / 12.0 - B)
    rests = [mean_of(sd=np.array([sd, sd]), u=np.array([0.01, 1.0])) for _ in range(6)]
    found = with_rounding(rests, np.array([q, 0.0]))
    rounding = q * math.sqrt(B)
    assert_allclose(found[2].u, [math.hypot(0.01, rounding), 1.0], rtol=1e-3)
    for u, raised in ((9.0 * rounding, True), (11.0 * rounding, False)):
        rests = [mean_of(sd=np.array([sd, sd]), u=np.array([u, 1.0])) for _ in range(6)]
        (one, *_) = with_rounding(rests, np.array([q, 0.0]))
        assert one.u[0] == pytest.approx(math.hypot(u, rounding) if raised else u, rel=1e-3)


@pytest.mark.filterwarnings("error")
def test_steps_of_one_log_may_be_nothing_beside_another():
    sizes = (1.0, 1e-150, 0.5)
    rests = [mean_of(sd=np.full(2, sd), u=np.full(2, sd)) for sd in sizes]
    for step in (1e-153, 5e-324):
        found = with_rounding(rests, np.full(2, step))
        assert tuple(each.u[0] for each in found) == sizes


def test_lines_edges_and_cosines_of_batch_means():
    rng = np.random.default_rng(7)
    b = 40
    means = rng.normal(size=(1, 1, b)) + 0.1 * np.arange(b)
    means -= means.mean()
    count = np.array([[b]])
    rise, left = _lines(means, count)
    slope, start = np.polyfit(np.arange(b), means[0, 0], 1)
    assert rise[0, 0] == pytest.approx(slope * b)
    assert_allclose(left[0, 0], means[0, 0] - start - slope * np.arange(b), atol=1e-12)
    phases = np.concatenate([[[[0.0]]], np.cumsum(means, axis=2)], axis=2)
    tenth = max(abs(means[0, 0, :4].mean()), abs(means[0, 0, -4:].mean()))
    found = _edge(phases, count, np.array([[2.5]]))
    assert found[0, 0] == pytest.approx(tenth / math.sqrt(2.5 / 4))
    k = np.arange(64.0)
    ends = np.rint(b * np.arange(65) / 64).astype(int)
    sums = np.diff(np.concatenate([[0.0], np.cumsum(means[0, 0])])[ends])
    cosine = np.array([np.cos(np.pi * j * (k + 0.5) / 64) for j in range(1, 9)])
    by_hand = 2.0 * (cosine @ sums) ** 2 / (b**2 * 0.3)
    assert_allclose(_cosines(phases, count, np.array([[0.3]]))[0, 0], by_hand, rtol=1e-9)


# --- faults


def test_an_output_that_never_changes_is_stuck_or_saturated():
    def rest(sd, longest, low, at_low):
        return mean_of(
            sd=np.array([sd, 1.0]), longest=np.array([longest, 3.0]), low=np.array([low, 0.0]),
            high=np.array([9.0, 1.0]), at_low=np.array([at_low, 1.0]), at_high=np.array([4.0, 2.0]),
        )  # fmt: skip

    survey = SimpleNamespace(
        resolution=np.array([0.5, np.nan]),
        lowest=np.array([2.0, -1.0]),
        highest=np.array([9.0, 5.0]),
    )
    rests = [
        rest(0.3, 49, 3.0, 5),
        rest(0.3, 51, 3.0, 5),
        rest(0.3, 51, 2.0, 4),
        rest(0.3, 51, 3.0, 3),
    ]
    said = find_stuck(("a", "b"), rests, [survey] * 4)
    assert [len(each) for each in said] == [0, 1, 1, 1]
    words = ["stuck" if "stuck" in each[0] else "saturated" for each in said[1:]]
    assert words == ["stuck", "saturated", "saturated"]
    quiet = [replace(each, sd=np.array([0.24, 1.0])) for each in rests]
    assert find_stuck(("a", "b"), quiet, [survey] * 4) == [[], [], [], []]


def test_numbers_that_wrap_are_told_by_their_bits(monkeypatch):
    """Eight bits, of which .9 in one step is no motion: 231 is, 230 is not."""
    monkeypatch.setattr(faults, "_bits", lambda low, high, step: 8 if high > 200 else 0)
    pieces = [
        (0, np.array([[5.0, 10.0, 241.0, 10.0], [1.0, 2.0, 1.0, 2.0]])),
        (4, np.array([[10.0, 241.0, 11.0, 241.0], [1.0, 2.0, 1.0, 2.0]])),
    ]
    source = SimpleNamespace(
        spikes=SimpleNamespace(found=[(3, 0, 250.0)]),
        outputs=("a", "b"),
        raw_outputs=lambda: pieces,
    )
    survey = SimpleNamespace(
        lowest=np.array([5.0, 1.0]), highest=np.array([243.0, 2.0]), resolution=np.array([1.0, 1.0])
    )
    (said,) = find_wrapped(source, survey)
    assert said.text == "output 'a' wraps around 3 times in 8 bits (5 to 250), first at row 2"
    assert said.action == "Read it with --signed 8."


# --- readings by hand


def test_rows_off_an_ellipsoid_and_their_directions():
    rng = np.random.default_rng(5)
    u = mp.read_scheme("fibonacci-400").up
    C = np.diag([30.0, 40.0, 50.0]) @ (np.eye(3) + 0.1 * rng.normal(size=(3, 3)))
    size = np.ones(400)
    size[77] = 1.02
    misfit, away = off_the_ellipsoid((size[:, None] * u) @ C.T + [7.0, -20.0, 11.0])
    assert misfit[77] == pytest.approx(0.02, abs=1e-3)
    assert np.abs(np.delete(misfit, 77)).max() < 1e-3
    assert_allclose(np.linalg.norm(away, axis=1), 1.0)
    # but for a turn they are those of the field
    turn = np.linalg.lstsq(u, away, rcond=None)[0]
    assert_allclose(turn @ turn.T, np.eye(3), atol=5e-3)
    t, a = rng.normal(size=(2, 30))  # of a hyperboloid there are none
    saddle = np.column_stack([np.cosh(t) * np.cos(a), np.cosh(t) * np.sin(a), np.sinh(t)])
    assert not off_the_ellipsoid(saddle)[0].any()


@pytest.mark.parametrize(("run", "found"), [(3, False), (4, True)])
def test_readings_cut_off_at_an_end(run, found):
    rng = np.random.default_rng(3)
    values = rng.uniform(-1.0, 1.0, (20, 3))
    values[6 : 6 + run, 1] = -2.0
    said = find_cut_off(("a", "b", "c"), values)
    assert bool(said) is found
    if found:
        assert said[0].text == "readings of 'b' are saturated in rows 7 to 10"
        values[6:10, 2] = 0.3  # the others did not move
        assert not find_cut_off(("a", "b", "c"), values)


# --- rests and positions


def test_how_far_rests_are_from_known_positions():
    """After a line of each output, the chord as an angle; axes that hardly move do not count."""
    up = mp.read_scheme("fibonacci-9").up
    scheme = SimpleNamespace(up=up)
    rows = [8, 1, 3, 6, 0]
    target = -up[rows][:, [2, 0]]
    means = 0.3 + target * [2.0, -1.5]
    means[2] += [0.2, 0.1]
    found = _match_rows(means, (2, 0), rows, scheme, "gravity")
    off = np.zeros(5)
    for mean, own in zip(means.T, target.T, strict=True):
        scale, bias = np.polyfit(own, mean, 1)
        off += ((mean - bias) / scale - own) ** 2
    assert_allclose(found.distance_deg, np.degrees(2 * np.arcsin(np.sqrt(off) / 2)), rtol=1e-9)
    assert np.isinf(found.second_deg).all()
    level = SimpleNamespace(up=np.array([[0.0, 0.3, 0.9], [0.0, -0.19, 0.9], [0.0, 0.1, 0.9]]))
    near = _match_rows(np.array([[1.0], [5.0], [2.0]]), (1,), [0, 1, 2], level, "force")
    assert near.distance_deg.tolist() == [0.0, 0.0, 0.0]  # .49 g is too little


@pytest.mark.parametrize(("by", "together"), [(0.97, True), (1.03, False)])
def test_outputs_are_judged_together_unless_they_differ(by, together):
    """Cube roots of means on ν are normal: 4.5 ν (∛(s/s̄) − 1)² against χ² of one at 1 %."""
    usable = np.ones((10, 3), dtype=bool)
    usable[:, 1] = False
    dof = common_noise._DOF * 10

    def off(x):
        mean = (x + 1.0) / 2.0
        return 4.5 * dof * ((np.cbrt(x / mean) - 1) ** 2 + (np.cbrt(1 / mean) - 1) ** 2)

    low, high = 1.0, 100.0
    for _ in range(80):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if off(middle) < chi2.isf(0.01, 1) else (low, middle)
    size = np.ones((10, 3))
    size[:, 0] = low**by
    assert _alike(size, usable) == ([[0, 2]] if together else [[0], [2]])
    assert _alike(size[:, :1], usable[:, :1]) == [[0]]


@pytest.mark.parametrize("few", [True, False])
@pytest.mark.parametrize("by", [0.9, 1.1])
def test_a_rest_far_beyond_the_others_takes_no_part(few, by):
    """By the mean of its outputs: one of four rests has three where the others have one, or one."""
    usable = np.zeros((4, 3), dtype=bool)
    usable[:, 0] = True
    usable[1:] |= few
    usable[0] |= not few
    dof = common_noise._DOF * usable[0].sum()
    limit = chi2.isf(1e-3, dof) / chi2.ppf(0.5, dof)
    size = np.where(usable, [[by * limit], [0.9], [1.0], [1.0]], 77.0)
    assert _are_usual(size, usable).tolist() == [by < 1.0, True, True, True]


def test_what_a_memory_makes_likely():
    """Cosines with the density of a first-order process; each its own level."""
    rows = np.random.default_rng(1).chisquare(1.0, (6, common_noise.COSINES)) + 0.1
    logs = []
    for memory in common_noise._MEMORIES:
        shape = 1.0 / (1.0 + (common_noise._ORDER / memory) ** 2)
        level = np.mean(rows.mean(axis=0) / shape)
        logs.append(np.sum(np.log(level * shape) + 1.0))
    assert common_noise._with_memory(rows) == pytest.approx(-0.5 * 6 * min(logs), rel=1e-9)


def test_what_would_take_in_short_stretches():
    short = [Rest(0, 57), Rest(100, 138)]
    assert would_take([], 60, 50.0) == ""
    assert would_take(short, 60, None).startswith(
        "; 2 more stretches stood still for less than 60 s"
    )
    assert would_take(short[1:], 60, 50.0) == (
        "; 1 more stretch stood still for less than 1.2 s; --min-duration 0.76 takes them in"
    )
    assert "--min-duration 0.77 " in would_take([Rest(0, 54)], 60, 70.0)


# --- text and samples


def test_single_samples_far_from_their_neighbours_are_taken_out():
    """Their place, output and value are kept; three in a row are motion."""
    rng = np.random.default_rng(3)
    data = np.round(rng.normal(size=(3, 102)), 3)
    clean = data.copy()
    data[0, 37], data[1, [61, 62]], data[0, 80:83] = 40.0, -35.0, 60.0
    spikes = Spikes(2)
    parts = [spikes.feed(data[:, :50]), spikes.feed(data[:, 50:]), spikes.finish()]
    kept = np.concatenate(parts, axis=1)
    assert sorted(spikes.found) == [(37, 0, 40.0), (61, 1, -35.0), (62, 1, -35.0)]
    assert kept[0, 80:83].tolist() == [60.0] * 3
    assert kept[0, 37] in clean[0, 32:48]
    assert abs(kept[0, 37] - np.median(clean[0, 32:48])) < 0.5
    others = np.ones((3, 102), dtype=bool)
    others[0, [37, 80, 81, 82]] = others[1, [61, 62]] = False
    assert (kept == clean)[others].all()


def test_spikes_in_rests_are_counted(monkeypatch):
    found = [(5, 0, 1.0), (12, 1, 1.0), (19, 0, 1.0), (20, 0, 1.0), (45, 1, 1.0)]
    source = SimpleNamespace(spikes=SimpleNamespace(found=found), outputs=("a", "b"))
    (said,) = _find_spikes(source, [Rest(5, 20), Rest(40, 75)])
    assert said.text.startswith("4 samples at rest (4 %) are spikes")
    assert _find_spikes(source, [Rest(21, 40)]) == []


def test_rows_that_sensors_cannot_have_read_are_left_out():
    """A million times the median, or more than any sensor; the last column is the time."""
    data = np.array(
        [
            [1.0, 2.0, 3.0, np.nan, 2.0, 2.9e6, 3.1e6, 2.5],
            [5.0, 5.0, 5.0, 5.0, 5.0, 5.0, 5.0, 5.0],
            [9.0, np.nan, 8.0, 7.0, 7.0, 7.0, 7.0, 7.0],
            [1.0, 2.0, 3.0, 4.0, np.inf, 6.0, 7.0, 8.0],
        ]
    )
    usual = np.array([3.0, 5.0, 7.0, 4.0])
    timed = good_rows(data, 2, timed=True, usual=usual)
    assert timed.tolist() == [True, True, True, False, False, True, False, True]
    loose = good_rows(data[:3], 2, timed=False, usual=usual[:3])
    assert loose.tolist() == [True, True, True, False, True, True, False, True]
    middle = np.array([2.5, 5.0, 7.0, 4.0])
    own = good_rows(data, 2, timed=True)
    assert own.tolist() == good_rows(data, 2, timed=True, usual=middle).tolist()
    assert not good_rows(np.full((3, 4), 1e308), 2, timed=True).any()  # their median's product


def test_batch_means_of_rests_side_by_side():
    parts = [[np.array([[1.0, 2.0]]), np.array([[6.0]])], [np.array([[4.0, 8.0]])]]
    sums = [SimpleNamespace(batches=each, sum=np.zeros(1)) for each in parts]
    batches, count = _centred_batches(sums)
    assert count.tolist() == [[3], [2]]
    assert batches[:, 0].tolist() == [[-2.0, -1.0, 3.0], [-2.0, 2.0, 0.0]]


def test_a_line_through_allan_variances_in_logarithms():
    """Weighted by degrees of freedom; its height at the end, and how well that is known."""
    rng = np.random.default_rng(4)
    b = 24
    phases = np.concatenate([[0.0], np.cumsum(rng.normal(size=b))])
    lengths, weights = np.array([[2, 4, 8]]), np.array([9.0, 4.0, 1.5])
    y = []
    for m in lengths[0]:
        second = [phases[i + 2 * m] - 2 * phases[i + m] + phases[i] for i in range(b + 1 - 2 * m)]
        y.append(math.log(np.mean(np.square(second)) / (2.0 * m**2)))
    X = np.column_stack([np.ones(3), np.log(lengths[0] / b)])
    W = np.diag(weights)
    C = np.linalg.inv(X.T @ W @ X)
    start, slope = C @ X.T @ W @ y
    found = _allan_line(phases[None, None], lengths, weights, np.array([b]))
    assert_allclose([found[0][0, 0], found[1][0, 0], found[2][0]], [slope, start, C[0, 0]])


def histogram(**counts):
    bins = np.zeros(3600)
    for place, count in counts.items():
        bins[int(place[1:])] = count
    return bins


def at_bin(place):
    return 10.0 ** (-18 + (place + 0.5) / 100)


def test_the_limit_of_rest_lies_in_the_valley_above_the_first_peak():
    """Hundred bins a decade: 2.5 to 4 times the peak is 40 to 60 bins above, in the middle 50."""
    quietest = 10.0**-12
    noise, limit = _valley(histogram(b1500=100, b1700=80), 0, quietest)
    assert (noise, limit) == (pytest.approx(at_bin(1500)), pytest.approx(at_bin(1550)))
    # windows in the middle of the valley: its end that is farther from the hill beyond is lower
    noise, limit = _valley(histogram(b1500=100, b1552=40), 0, quietest)
    assert limit == pytest.approx(at_bin(1540))
    noise, limit = _valley(histogram(b1500=100, b1548=40), 0, quietest)
    assert limit == pytest.approx(at_bin(1560))
    noise, limit = _valley(histogram(b1500=100), 0, quietest, (1.7, 2.8))  # 23 to 45 above
    assert limit == pytest.approx(at_bin(1534))
    # what is below the quietest, and windows that never change, are counted with it
    counts = histogram(b1400=30, b1450=30, b1530=70)
    assert _valley(counts, 50, at_bin(1460))[0] == pytest.approx(at_bin(1460))
    assert _valley(counts, 0, at_bin(1380))[0] == pytest.approx(at_bin(1400))
    low = histogram(b1400=10, b1530=70)  # less than a fifth of the highest is no peak
    assert _valley(low, 0, at_bin(1380))[0] == pytest.approx(at_bin(1530))


def test_a_text_that_still_comes_is_read_from_its_first_lines():
    live = open_lines("live", ["# of a logger", "time,ax,ay", "0.5,1.25,-2", "1,3,4"], None)
    assert (live.log.source, tuple(live.log.columns)) == ("live", ("time", "ax", "ay"))
    (piece,) = live.log.read((), ("ay", "time"), ())
    assert piece.table.columns["ay"].tolist() == [-2.0, 4.0]
    assert piece.table.columns["time"].tolist() == [0.5, 1.0]


def test_the_head_of_a_log_of_many_columns_has_its_first_lines(tmp_path):
    (tmp_path / "wide.csv").write_bytes(b"x," * (opening.HEAD + 7) + b"y\n1\n")
    head = opening._read_head(tmp_path / "wide.csv")
    assert len(head) == 2 * (opening.HEAD + 7) + 4
    assert head.endswith(b"y\n1\n")


def test_pieces_that_were_kept_in_a_file_come_back(monkeypatch):
    monkeypatch.setattr("multipos.logs.samples._IN_MEMORY", 240)
    table = np.random.default_rng(1).normal(size=(4, 13))
    store = Store()
    for first, last in ((0, 5), (5, 5), (5, 8), (8, 10), (10, 11), (11, 13)):
        store.add(table[:, first:last])
    found = list(store.pieces())
    store.close()
    assert [first for first, _ in found] == [0, 5, 8, 10, 11]
    assert (np.concatenate([piece for _, piece in found], axis=1) == table).all()


def test_a_head_may_end_inside_a_letter():
    """Of three bytes at most, and only where it was cut."""
    full = b"a" * (opening.HEAD - 2) + "\u20ac".encode()[:2]
    assert _decode("p", full) == "a" * (opening.HEAD - 2)
    for bad in (full[1:], b"a" + "\u20ac".encode()[:2] + full[3:]):
        with pytest.raises(mp.MultiposError, match="byte 0xe2 is not UTF-8"):
            _decode("p", bad)


@pytest.mark.parametrize("outputs", [1, 2])
def test_rests_far_beyond_the_median_take_no_part(outputs):
    """At one in a thousand of χ²/ν over its median, whose ν is that of all usable outputs."""
    nu = outputs / float(common_noise._WEIGHT @ common_noise._WEIGHT)
    limit = chi2.isf(1e-3, nu) / chi2.median(nu)
    size = np.tile([1.0, 1.3, 0.8, 1.0, 1.1, 0.9, 1.0], (2, 1)).T
    size[3] = 0.99 * limit
    usable = np.ones((7, 2), dtype=bool)
    usable[:, outputs:] = False
    size[:, outputs:] = 1e9
    assert common_noise._are_usual(size, usable).tolist() == [True] * 7
    size[3, :outputs] = 1.01 * limit
    assert np.flatnonzero(~common_noise._are_usual(size, usable)).tolist() == [3]


def test_what_is_common_to_rests_raises_their_u():
    """Where it is more than their own, with degrees of freedom from one to what they had."""
    each = mean_of(
        u=np.array([0.2, 0.3]), dof=np.array([9.0, 5.0]), drift_factor=np.array([2.0, 1.0])
    )
    found = common_noise._raised(
        each, np.array([True, False]), np.array([0.25, 0.01]), np.array([4.0, 2.0])
    )
    assert_allclose(found.u, [0.5, 0.3])
    assert_allclose(found.common, [0.5 * 2.0 / 0.2, 1.0])
    assert_allclose(found.dof, [4.0, 5.0])
    found = common_noise._raised(
        each, np.ones(2, dtype=bool), np.array([0.25, 0.16]), np.array([0.3, 70.0])
    )
    assert_allclose(found.dof, [1.0, 5.0])


def test_rests_begin_and_end_where_their_middle_changes(monkeypatch):
    """Of blocks of 5 a fourth of a run at each end may be motion, eight blocks at the most."""
    changes, asked, moved = [], [], iter([7, 3, None, 40, None, None, None, 2, 9])

    def change(samples, reach, limits):
        changes.append((*samples[0, [0, -1]].tolist(), reach))
        return next(moved)

    def read(regions):
        asked.extend((start, end) for start, end in regions)
        return [np.arange(start, end)[None] for start, end in regions]

    monkeypatch.setattr(rests, "_change", change)
    runs = [Run(40, 160), Run(170, 230, begins=False), Run(240, 313, ends=True)]
    found = rests.find_edges(runs, 315, Grid(5, 10), Limits(0.1), read)
    assert asked == [(25, 130), (70, 175), (155, 215), (185, 245), (225, 298), (255, 315)]
    assert changes == [
        (129, 25, 60), (70, 174, 60), (185, 244, 30), (297, 225, 43), (255, 314, 43)]  # fmt: skip
    # what begins behind the end of the one before; one row short of a block is at rest
    assert found == [Rest(63, 133), Rest(170, 230), Rest(230, 315)]
    asked.clear()
    runs = [Run(3, 18), Run(1000, 1600)]
    found = rests.find_edges(runs, 1605, Grid(5, 10), Limits(0.1), read, after=6)
    assert asked == [(0, 13), (8, 33), (985, 1120), (1480, 1605)]
    assert found == [Rest(6, 18), Rest(1038, 1569)]


@pytest.mark.parametrize(("walk", "size", "amplitude"), [(0, 0.6, 9.0), (1, 1.0, 2.0), (0, 1.1, 0)])
def test_the_law_that_cosines_make_likeliest(walk, size, amplitude):
    """χ² of one about α + A λ^(1 + walk) φ_k; A as its mean and sd say, by its likelihood."""
    rng = np.random.default_rng(2)
    length = rng.uniform(0.5, 2.0, 9)
    shapes = common_noise._shapes()
    grown = np.outer(length ** (1 + walk), shapes[walk])
    rows = (size + amplitude * grown) * rng.chisquare(1.0, (9, common_noise.COSINES))
    wanted = []
    for kind, phi in enumerate(shapes):
        for free in (0, 1):
            logs, sizes = [], []
            for ratio in common_noise._RATIOS:
                m = 1.0 + ratio * np.outer(length ** (1 + kind), phi)
                alpha = min(1.0, np.mean(rows / m)) if free else 1.0
                logs.append(-0.5 * np.sum(np.log(alpha * m) + rows / (alpha * m)))
                sizes.append(alpha)
            best = int(np.argmax(logs))
            A = np.array(sizes) * common_noise._RATIOS
            weight = np.exp(np.array(logs) - max(logs)) * common_noise._RATIOS
            mean = np.average(A, weights=weight)
            sd = math.sqrt(np.average((A - mean) ** 2, weights=weight))
            law = (bool(kind), sizes[best], A[best], max(sd, common_noise._STEP * A[best]))
            wanted.append((max(logs) - free * common_noise._LOWER - kind * common_noise._WALK, law))
    score, law = max(wanted)
    found, likelihood = common_noise._most_likely(rows, length)
    assert_allclose(found, law, rtol=1e-6)
    assert likelihood == pytest.approx(score)


def test_what_the_samples_of_rests_say(monkeypatch):
    """Mean and sd by NumPy; u of what is common to white noise and the spectrum; a line's rise."""
    rng = np.random.default_rng(6)
    samples = [np.array([[3.0], [-7.0]]) + rng.normal(size=(2, n)) for n in (12, 9)]
    samples[1][1] = 5.3  # never changes
    sums = [rest_means.RestSum(x.shape[1], 2) for x in samples]
    for each, x in zip(sums, samples, strict=True):
        each.feed(x)
    density, around = np.array([[9.0, 0.3], [2.0, 0.0]]), np.array([[0.7, 0.4], [0.2, 0.9]])
    dof, factor = np.array([[4.0, 99.0], [6.0, 3.0]]), np.array([[1.5, 1.0], [1.0, 1.0]])
    seen = {}

    def drifting(phases, count, square, dof):
        seen.update(square=square, dof=dof.copy(), phases=phases, count=count)
        return 4.0 * square, np.array([[0.3, 99.0], [6.0, 8.0]]), factor

    def edge(phases, count, around):
        return around + 1.0

    def cosines(phases, count, white):
        return np.repeat(white[..., None], 8, axis=2)

    monkeypatch.setattr(rest_means, "_densities", lambda *_: ((density, around), (dof, None)))
    monkeypatch.setattr(rest_means, "_drifting", drifting)
    monkeypatch.setattr(rest_means, "_edge", edge)
    monkeypatch.setattr(rest_means, "_cosines", cosines)
    found = rest_means.rest_means(sums)
    n = np.array([[12], [9]])
    variance = np.array([x.var(axis=1, ddof=1) for x in samples])
    variance[1, 1] = 0.0
    square = np.maximum(variance / n, density / n * (variance > 0.0))
    assert_allclose(seen["square"], square)
    assert seen["dof"].tolist() == [[4.0, 99.0], [6.0, 8.0]]
    assert seen["count"].tolist() == [12, 9]
    for i, (each, x) in enumerate(zip(found, samples, strict=True)):
        count = x.shape[1]
        left = x - x.mean(axis=1, keepdims=True)
        assert_allclose(seen["phases"][i, :, 1 : count + 1], left.cumsum(axis=1), atol=1e-12)
        assert_allclose(each.mean, x.mean(axis=1))
        assert_allclose(each.sd, np.sqrt(variance[i]))
        assert_allclose(each.u, np.sqrt(4.0 * square[i]))
        assert_allclose(each.drift, count * np.polyfit(np.arange(count), x.T, 1)[0], atol=1e-12)
        assert_allclose(each.drift_u, np.sqrt(12.0 * around[i] / count))
        assert_allclose(each.edge, around[i] + 1.0)
        assert_allclose(each.cosines[:, 3], variance[i] / count)
        assert (each.low.tolist(), each.high.tolist()) == (
            x.min(axis=1).tolist(), x.max(axis=1).tolist())  # fmt: skip
        assert each.drift_factor.tolist() == factor[i].tolist()
    assert (found[0].dof.tolist(), found[1].dof.tolist()) == ([1.0, 11.0], [6.0, 8.0])
    assert (found[1].at_low.tolist(), found[1].at_high.tolist()) == ([1, 9], [1, 9])


def test_means_that_drift_by_the_slopes_of_their_allan_variances(monkeypatch):
    """Beyond −.45 without a memory, beyond .6 with one: then u² is twice the end of the line."""
    slope = np.array([[-0.44, -0.46], [0.61, 0.59], [-0.4, -0.4]])
    end, spread = np.log([[0.7, 0.7], [0.9, 0.9], [0.3, 0.0001]]), np.array([0.25, 0.4, 0.2])
    rise = {130: [0.09, 0.09], 300: [0.11, 0.11], 140: [0.0, 0.0]}
    calls = []

    def line(phases, lengths, weights, end_at):
        calls.append((lengths.tolist(), weights.tolist()))
        if len(end_at) == 3:
            assert phases[:, 0, 0].tolist() == [0.0, 2.0, 4.0]
            return slope, end, spread
        return np.array([rise[int(end_at[0])]]), None, None

    monkeypatch.setattr(rest_means, "_allan_line", line)
    square = np.array([[0.5, 0.5], [0.5, 0.5], [0.5, 0.5], [0.0, 0.0], [0.5, 0.5]])
    dof = np.arange(10.0).reshape(5, 2) + 20.0
    phases = np.arange(5.0)[:, None, None] * np.ones((5, 2, 501))
    found, left, factor = rest_means._drifting(
        phases, np.array([130, 127, 300, 500, 140]), square, dof
    )
    wanted = square.copy()
    wanted[0, 0], wanted[2, 0], wanted[4, 0] = 1.4, 1.8, 0.6
    assert_allclose(found, wanted)
    assert_allclose(factor[[0, 2, 4], 0], np.sqrt([2.8, 3.6, 1.2]))
    assert (np.delete(factor, [0, 4, 8]) == 1.0).all()
    wanted_dof = dof.copy()
    wanted_dof[[0, 2, 4], 0] = 4.0, 2.5, 5.0
    assert_allclose(left, wanted_dof)
    assert calls[0][0][:2] == [[2, 4, 8, 16, 32], [4, 9, 18, 37, 75]]
    assert calls[2] == ([[1, 2, 4]], [1.0, 0.5, 0.25])


@pytest.mark.parametrize(
    ("given", "codes"),
    [
        ({}, []),
        ({"longest": 24}, ["stuck"]),
        ({"longest": 22}, []),
        ({"longest": 24, "sd": 0.29}, []),
        ({"longest": 22, "n": 150}, ["stuck"]),
        ({"longest": 19, "n": 150}, []),
        ({"longest": 230, "sd": 0.0}, ["quantized"]),
        ({"longest": 229, "sd": 0.0}, []),
        ({"sd": 0.74}, []),
        ({"sd": 0.76}, ["unsteady"]),
        ({"drift": -1.05}, ["slow-drift"]),
        ({"drift": 0.95}, []),
        ({"drift": 0.95, "edge": 5.1}, ["motion-at-edge"]),
        ({"drift": 1.05, "edge": 5.1}, ["slow-drift"]),
        ({"drift": 0.95, "edge": 4.9}, []),
    ],
)
def test_faults_of_an_output_in_a_rest(given, codes, monkeypatch):
    """20 samples or a tenth equal beyond 1.5 steps of .2; three times the usual .25; 5 u of .2."""
    monkeypatch.setattr(faults, "_settled", lambda *_: [])
    fields = {"longest": 3, "sd": 0.31, "drift": 0.1, "drift_u": 0.2, "edge": 0.4} | given
    n = fields.pop("n", 230)
    each = mean_of(n, **{name: np.array([7.0, value]) for name, value in fields.items()})
    found = faults._output_faults("a", 1, each, 0.25, 0.2)
    assert [finding.code for finding in found] == codes
    if codes == ["unsteady"]:
        assert "3.0 times" in found[0].text
        assert faults._output_faults("a", 1, each, 0.0, 0.2) == []
    if codes == ["quantized"]:
        assert [f.code for f in faults._output_faults("a", 1, each, 0.25, 0.0)] == ["stuck"]


@pytest.mark.parametrize(
    ("last", "cut"),
    [("5,6", True), ("5,6.5,z\n", False), ("5,6.x,z", True), ("5,6.x,z\n", False), ("5,,z", False)],
)
def test_a_last_row_that_isfind_cut_off(last, cut, tmp_path):
    layout = SimpleNamespace(delimiter=",", width=3, numeric=(True, True, False))
    path = tmp_path / "log.csv"
    for above in ("a,b,c\n1,2,x\n", "a,b,c\n" + "1,2,x\n" * 12_000):
        path.write_text(above + last)
        end, found = text_logs._cut_row(path, layout)
        assert end == len(above) + (0 if cut else len(last))
        assert bool(found) is cut
    path.write_text("a,b,c\n5,6")  # nothing is a row above it
    assert text_logs._cut_row(path, layout)[0] == 9
    for width in (40, 41):
        path.write_text("a,b,c\n1,2,x\n" + "7" * width)
        shown = "7" * 40 + "…" * (width > 40)
        assert f"'{shown}'" in text_logs._cut_row(path, layout)[1][0].text
    tabbed = SimpleNamespace(delimiter="\t", width=3, numeric=(True, True, False))
    path.write_text("a\tb\tc\n1\t2\tx\n5\t6\0")  # what is said holds no control characters
    assert r"'5 6\u0000'" in text_logs._cut_row(path, tabbed)[1][0].text


def test_a_log_is_read_in_whole_lines(tmp_path, monkeypatch):
    """Blocks of seven bytes, each up to its last line end, which are made line feeds."""
    monkeypatch.setattr(text_logs, "_PIECE", 7)
    path = tmp_path / "log.csv"
    path.write_bytes(b"head\n1,2\r\n3,4\r\n5,6\r7,89")
    for end in (22, 23):
        text = SimpleNamespace(path=path, begin=5, end=end, layout=SimpleNamespace(first=2))
        blocks = list(text_logs._blocks(text))
        assert b"".join(each.content for each in blocks) == b"1,2\n3,4\n5,6\n7,89"[: end - 7]
        line = 2
        for each in blocks:
            assert each.line == line
            line += each.content.count(b"\n")
        done = [min(5 + 7 * k, end) / end for k in (1, 2, 3)]
        assert [each.done for each in blocks] == [*done[: len(blocks) - 1], 1.0]


@pytest.mark.parametrize(
    ("best", "rival", "blocks", "shown"),
    [(0.14, 0.43, 14, True), (0.14, 0.41, 14, False), (0.16, 9.0, 14, False),
     (0.14, 0.43, 12, True), (0.14, 0.43, 11, False)],
)  # fmt: skip
def test_columns_that_show_gravity_vary_least_at_rest(best, rival, blocks, shown, monkeypatch):
    """Over the third of the blocks that moves least, and three times less than the next triad."""
    noise = np.random.default_rng(1).permutation(blocks) + 1.0
    wiggle = np.tile([1.0, -1.0], 16)
    columns = {}
    for i, name in enumerate("abcdefgh"):
        column = (10.0 * i + 0.01 * np.arange(blocks)[:, None] + (i + 1.0) * np.outer(noise, wiggle)
        ).ravel()  # fmt: skip
        columns[name] = np.concatenate([[np.nan], column[:40], [1e16], column[40:], [3.0]])
    varies = {0: rival, 1: 5.0, 2: 1.2 * best, 3: best, 4: 1.1 * best, 5: 9.0}

    def variation(quiet):
        places = np.rint((quiet[0] % 10.0) / 0.01).astype(int)
        assert (noise[places] <= np.quantile(noise, 1.0 / 3.0)).all()
        assert len(places) == np.sum(noise <= np.quantile(noise, 1.0 / 3.0))
        return varies[int(quiet[0, 0] // 10)]

    monkeypatch.setattr(log_columns, "_variation", variation)
    log = SimpleNamespace(
        read=lambda *_, lenient: iter([SimpleNamespace(table=SimpleNamespace(columns=columns))])
    )
    found = log_columns.triad_of_gravity(log, tuple("abcdefgh"))
    assert found == (("d", "e", "f") if shown else None)


# --- rows and columns


@pytest.mark.parametrize(
    ("header", "cells", "timing", "rate", "clock", "counter"),
    [
        ("time_ms", lambda i: 300 + 20 * i, Timing(), 50.0, ("time_ms", 1e-3), None),
        ("time_ms", lambda i: 300 + 20 * i, Timing(rate=37.0), 37.0, None, None),
        ("tick", lambda i: 300 + 20 * i, Timing("tick", "us"), 5e4, ("tick", 1e-6), None),
        ("time_ms", lambda i: 300 - i, Timing(), None, None, None),
        ("time", lambda i: 7 + i, Timing(), None, None, "time"),
        ("time", lambda i: 7 + i, Timing(unit="s"), 1.0, ("time", 1.0), None),
        ("step", lambda i: 300 + 20 * i, Timing(), None, None, None),
    ],
)
def test_the_clock_of_a_log(header, cells, timing, rate, clock, counter):
    """As it is named, or by a name of time and values that rise; what counts rows is none."""
    angle = 0.02 * np.arange(90) + 0.3
    rows = [f"{cells(i)},{math.cos(a):.5f},{math.sin(a):.5f}" for i, a in enumerate(angle)]
    log = open_lines("live", [f"{header},ax,ay", *rows], None).log
    with Samples(log, ("ax", "ay"), timing) as samples:
        samples._read_clock(next(iter(log.read(("ax", "ay"), (header,), ()))).table)
        assert samples.rate == (rate and pytest.approx(rate))
        assert samples.counter == counter
        assert samples.others == (() if clock else (header,))
        if clock:
            assert (samples.clock.column, samples.clock.seconds) == (clock[0], clock[1])
            assert samples.step == pytest.approx(1.0 / rate)
        else:
            assert samples.clock is None


def test_rows_of_a_sensor_that_is_waved():
    """Two's complement of eight bits; a row that is bad goes, with its temperature."""
    rng = np.random.default_rng(2)
    raw = rng.integers(0, 256, (30, 2)).astype(float)
    raw[0, 0], raw[1, 0] = 128.0, 127.0
    warm = rng.normal(size=30)

    def rows(*parts, drop_bad=False, **options):
        columns = [
            {"a": raw[part, 0], "b": raw[part, 1], "temperature": warm[part]} for part in parts
        ]
        logs = [opening.open_log(each) for each in columns]
        return waved.read_rows(logs, ("a", "b"), drop_bad=drop_bad, **{"signed": None, **options})

    values, environment = rows(slice(17), slice(17, 30), signed=8)
    assert_allclose(values, np.where(raw >= 128, raw - 256, raw))
    assert_allclose(environment["temperature"], warm)
    with pytest.raises(mp.MultiposError, match="log: 11 rows, and"):
        rows(slice(11))
    raw[4, 0], raw[20, 1] = np.nan, -1.1e40
    values, environment = rows(slice(30), drop_bad=True)
    good = np.delete(np.arange(30), [4, 20])
    assert_allclose(values, raw[good])
    assert_allclose(environment["temperature"], warm[good])


@pytest.mark.parametrize(
    ("header", "outputs", "kind", "unit", "found"),
    [
        ("mx,my,mz", None, None, None, "mx,my,mz"),
        ("ax,ay,az", None, None, None, None),
        ("ax,ay,az,mx,my,mz", None, None, None, None),
        ("ax,ay,az,mx,my,mz", None, "magnetic", None, "mx,my,mz"),
        ("ax,ay,az,mx,my,mz", None, None, "uT", "mx,my,mz"),
        ("ax,ay,az,mx,my,mz", None, None, "G", None),
        ("x,y,z", None, None, "uT", "x,y,z"),
        ("x,y,z", None, None, "G", "x,y,z"),
        ("x,y,z", None, None, None, None),
        ("x,y,z", None, "magnetic", None, "x,y,z"),
        ("x [uT],y [uT],z [uT]", None, None, None, "x,y,z"),
        ("ax,ay,az,mx,my,mz", ("mx", "my", "mz"), None, None, "mx,my,mz"),
        ("ax,ay,az,mx,my,mz", ("ax", "ay", "az"), None, None, None),
    ],
)
def test_outputs_of_a_magnetometer_by_name_unit_or_wish(header, outputs, kind, unit, found):
    """Beside an accelerometer only where it is asked for; G may be meant for g."""
    width = header.count(",") + 1
    lines = [header, *(",".join(f"{i + k / 7:.3f}" for k in range(width)) for i in range(3))]
    log = open_lines("live", lines, None).log
    wanted = None if found is None else tuple(found.split(","))
    assert log_columns.magnetic_outputs(log, outputs, kind, unit) == wanted


def test_rests_of_one_sensor_have_the_law_of_their_cosines(monkeypatch):
    """Cosines over the median memory of usable rests; u² by the law, times memory and white."""
    rng = np.random.default_rng(3)
    n, lengths = np.array([100, 81, 64, 63]), np.array([5.0, 4.0, 3.5, 3.1])
    sd, u, factor = (rng.uniform(0.5, 2.0, (4, 2)) * size for size in (3.0, 0.4, 1.0))
    sd[1, 1] = 0.0
    cosines = rng.chisquare(1.0, (4, 2, 8))
    found = [
        mean_of(int(n[i]), sd=sd[i], u=u[i], drift_factor=factor[i], cosines=cosines[i],
                dof=np.full(2, 50.0), common=np.ones(2))
        for i in range(4)
    ]  # fmt: skip
    usable = np.array([[True, True], [True, False], [True, True], [False, False]])
    white = sd**2 / n[:, None]
    memory = np.array([
        np.median([(u[i, j] / factor[i, j]) ** 2 / white[i, j] for i in range(4) if usable[i, j]])
        for j in range(2)
    ])  # fmt: skip
    rho = cosines / memory[:, None]
    size = rho @ common_noise._WEIGHT
    usual = np.array([True, True, False, True])
    wide, nu = np.array([9.0, 0.01, 7.0, 5.0]), np.array([11.0, 12.0, 13.0, 14.0])
    seen = []

    def are_usual(shown, which):
        medians = [np.median(size[usable[:, j], j]) for j in range(2)]
        assert_allclose(shown, size / medians)
        assert (which == usable).all()
        return usual

    def find_law(shown, which, length):
        seen.append((shown, which, length))
        return SimpleNamespace(square=lambda length: (wide, nu)) if len(seen) == 1 else None

    monkeypatch.setattr(common_noise, "_are_usual", are_usual)
    monkeypatch.setattr(common_noise, "_alike", lambda size, usable: [[1], [0]])
    monkeypatch.setattr(common_noise, "find_law", find_law)
    settled = common_noise.settle_together(found, lengths)
    shown, which, length = seen[0]
    assert_allclose(shown, rho[:, [1]])
    assert which[:, 0].tolist() == (usable[:, 1] & usual).tolist()
    assert_allclose(length, lengths / 3.75)
    square = wide * memory[1] * white[:, 1]
    raised = square > u[:, 1] ** 2
    assert raised.tolist() == [True, False, True, False]
    for i, each in enumerate(settled):
        own = math.sqrt(square[i]) if raised[i] else u[i, 1]
        assert_allclose(each.u, [u[i, 0], own])
        assert each.dof.tolist() == [50.0, nu[i] if raised[i] else 50.0]
    assert common_noise.settle_together(found[:1], lengths[:1]) == found[:1]


@pytest.mark.parametrize(
    ("grown", "fallen", "beyond", "found"),
    [((1, 1), (0, 0), -1.0, True), ((1, 0), (0, 0), 1.0, False), ((0, 0), (1, 1), 0.01, True),
     ((0, 0), (1, 1), -0.01, False), ((0, 0), (1, 0), 1.0, False)],
)  # fmt: skip
def test_rests_have_a_law_in_common_by_all_and_without_the_loudest(
    grown, fallen, beyond, found, monkeypatch
):
    """Of few rests the levels shrink by the square of their share of 36; what falls must fit."""
    rng = np.random.default_rng(2)
    rho = rng.chisquare(2.0, (6, 2, common_noise.COSINES))
    usable = np.ones((6, 2), dtype=np.bool_)
    usable[1, 0] = usable[4, 1] = False
    rho[3, 1] *= 50.0
    rows, without = rho[usable], rho[usable & (np.arange(6) != 3)[:, None]]
    level, asked = (10 / 36) ** 2, []

    def answer(given, name, both):
        place = 0 if len(given) == 10 else 1
        assert_allclose(given, (rows, without)[place])
        asked.append((name, place))
        return bool(both[place])

    def large(given, at):
        assert at == pytest.approx(level * common_noise._LEVEL * (1.0 if len(given) == 10 else 2.5))
        return answer(given, "large", grown)

    def falls(given, at):
        assert at == pytest.approx(level * common_noise._FALL * (1.0 if len(given) == 10 else 2.5))
        return answer(given, "falls", fallen)

    monkeypatch.setattr(common_noise, "_is_large", large)
    monkeypatch.setattr(common_noise, "_falls", falls)
    monkeypatch.setattr(common_noise, "_with_memory", lambda rows: 7.0)
    monkeypatch.setattr(
        common_noise,
        "_most_likely",
        lambda rows, length: ("law", 7.0 + common_noise._LOWER + beyond),
    )
    law = common_noise.find_law(rho, usable, np.full(6, 9.0))
    assert (law == "law") is found
    assert ("large", 0) in asked
    alone = np.zeros((6, 2), dtype=np.bool_)
    alone[3, 1] = True
    assert common_noise.find_law(rho, alone, np.full(6, 9.0)) is None
