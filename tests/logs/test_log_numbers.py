"""Numbers of logs by hand or by a second route, at points without symmetry."""

import math
from dataclasses import replace
from datetime import UTC, datetime
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import chi2, ortho_group

import multipos as mp
from multipos.logs import faults, joining, opening
from multipos.logs.clock import read_dates, unwrap
from multipos.logs.faults import find_stuck, find_wrapped
from multipos.logs.joining import _alike, _from_lines, _match_rows
from multipos.logs.log_columns import _variation
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
    Finder,
    Grid,
    Rest,
    Run,
    Spikes,
    _first_peak,
    _valley,
    is_long,
    long_enough,
)
from multipos.logs.samples import Samples, _turns, good_rows
from multipos.logs.still import _find_spikes, would_take
from multipos.logs.text_logs import _decode, open_lines, read_plain
from multipos.logs.waved import _cut_off, _off_the_ellipsoid, _squares_of, worth_keeping

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
        "11/21/2026 13:04:05.25", "2026-11-21T13:04:05.25",
    ],
)  # fmt: skip
def test_dates_are_seconds_since_1970(cell):
    truth = datetime(2026, 11, 21, 13, 4, 5, 250_000, tzinfo=UTC).timestamp()
    found = read_dates([cell, "nothing"])
    assert found[0] == pytest.approx(truth, abs=1e-6)
    assert math.isnan(found[1])


def test_times_without_a_date_are_seconds_since_midnight():
    assert_allclose(read_dates(["9:04:05.5", "23:59:59"]), [32645.5, 86399.0])


def test_a_column_that_begins_again_has_so_many_turns():
    cells = np.array(["a", "b", "c"] * 32)
    assert _turns(cells) == 3
    assert _turns(cells[:-1]) == 0  # fewer than 32 rounds
    assert _turns(np.array(["a", "a", "b"] * 40)) == 0
    lost = np.array(["a", "b", "c"] * 60)
    lost[[30, 90]] = "x"  # four of 177 pairs
    assert _turns(lost) == 0
    lost[90] = "a"
    assert _turns(lost) == 3


def test_whole_numbers_get_their_sign():
    state = SimpleNamespace(signed=8, _column=lambda table, name, largest: table)
    assert Samples._output(state, np.array([0.0, 127.0, 128.0, 255.0]), "a").tolist() == [
        0.0, 127.0, -128.0, -1.0]  # fmt: skip
    cells = type("Cells", (np.ndarray,), {"where": lambda self, row, name: f"row {row}"})
    for bad in (256.0, -1.0, 3.5):
        column = np.array([1.0, bad]).view(cells)
        with pytest.raises(mp.MultiposError, match=r"row 1: .* is no number of 8 bits"):
            Samples._output(state, column, "a")


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


def test_the_first_peak_is_the_leftmost_that_is_high_enough():
    density = np.array([0.0, 1.0, 0.5, 3.0, 7.0, 7.0, 2.0, 20.0, 9.0, 30.0, 1.0])
    from multipos.logs.rests import _PEAK

    least = _PEAK * 30.0
    expected = next(i for i in (1, 5, 7, 9) if density[i] >= least)
    assert _first_peak(density) == expected


def test_frozen_parts_are_left_out_of_a_run():
    grid = Grid(5, 10)
    state = SimpleNamespace(_grid=grid, _frozen=SimpleNamespace(found=[(2, 3), (20, 24), (50, 60)]))
    found = Finder._without_frozen(state, 8, 40)
    assert [(run.start, run.end, run.begins, run.ends) for run in found] == [
        (40, 100, True, False), (120, 200, False, Run(0, 1).ends)]  # fmt: skip
    state._frozen.found = [(12, 13)]  # four blocks before it are less than a window of eight
    assert [run.start for run in Finder._without_frozen(state, 8, 40)] == [65]


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
    misfit, away = _off_the_ellipsoid((size[:, None] * u) @ C.T + [7.0, -20.0, 11.0])
    assert misfit[77] == pytest.approx(0.02, abs=1e-3)
    assert np.abs(np.delete(misfit, 77)).max() < 1e-3
    assert_allclose(np.linalg.norm(away, axis=1), 1.0)
    # but for a turn they are those of the field
    turn = np.linalg.lstsq(u, away, rcond=None)[0]
    assert_allclose(turn @ turn.T, np.eye(3), atol=5e-3)
    t, a = rng.normal(size=(2, 30))  # of a hyperboloid there are none
    saddle = np.column_stack([np.cosh(t) * np.cos(a), np.cosh(t) * np.sin(a), np.sinh(t)])
    assert not _off_the_ellipsoid(saddle)[0].any()


def test_directions_are_counted_by_squares_of_a_cube():
    from multipos.logs.waved import _SQUARES

    turn = ortho_group.rvs(3, random_state=1)
    along = mp.read_scheme("fibonacci-200").up @ turn
    for direction, square in zip(along, _squares_of(along), strict=True):
        axis = int(np.argmax(np.abs(direction)))
        place = [(direction[(axis + k) % 3] / abs(direction[axis]) + 1) / 2 for k in (1, 2)]
        cells = [min(int(each * _SQUARES), _SQUARES - 1) for each in place]
        face = 2 * axis + (direction[axis] > 0)
        assert square == (face * _SQUARES + cells[0]) * _SQUARES + cells[1]


def test_rows_that_are_kept_are_spread_over_directions():
    """Of 3000 rows of which two thirds stay in one direction, 600, and no square far above."""
    u = mp.read_scheme("fibonacci-1000").up
    still = np.tile([0.6, 0.1, 0.79], (2000, 1))
    still /= np.linalg.norm(still, axis=1, keepdims=True)
    values = np.concatenate([u, still]) * 48.0 + 1e-3 * np.random.default_rng(2).normal(
        size=(3000, 3)
    )
    rows, stride = worth_keeping(values)
    assert (np.diff(rows) > 0).all()
    assert stride >= 1
    assert len(rows) < 600
    assert np.sum(rows >= 1000) <= 24
    rows, stride = worth_keeping(np.ones((900, 1)))
    assert (len(rows), rows[-1], stride) == (600, 899, 1)


@pytest.mark.parametrize(("run", "found"), [(3, False), (4, True)])
def test_readings_cut_off_at_an_end(run, found):
    rng = np.random.default_rng(3)
    values = rng.uniform(-1.0, 1.0, (20, 3))
    values[6 : 6 + run, 1] = -2.0
    said = _cut_off(("a", "b", "c"), values)
    assert bool(said) is found
    if found:
        assert said[0].text == "readings of 'b' are saturated in rows 7 to 10"
        values[6:10, 2] = 0.3  # the others did not move
        assert not _cut_off(("a", "b", "c"), values)


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


def test_lines_from_positions_to_means():
    targets = np.array([[0.9, 0.1], [-0.6, 0.2], [0.2, -0.1], [0.5, 0.0]])
    means = targets * [2.0, 3.0] + [0.3, 0.4] + 0.01 * np.arange(8.0).reshape(4, 2)
    bias, scale = _from_lines(means, targets, np.array([7.0, 1.7]))
    slope, start = np.polyfit(targets[:, 0], means[:, 0], 1)
    assert_allclose((bias[0], scale[0]), (start, slope))
    assert scale[1] == 1.7  # .3 g is too little to show it
    assert bias[1] == pytest.approx(means[:, 1].mean() - 1.7 * targets[:, 1].mean())
    turned = _from_lines(means * [-1.0, 1.0], targets, np.array([7.0, 1.7]))
    assert turned[1][0] == 7.0


@pytest.mark.parametrize(("by", "together"), [(0.97, True), (1.03, False)])
def test_outputs_are_judged_together_unless_they_differ(by, together):
    """Cube roots of means on ν are normal: 4.5 ν (∛(s/s̄) − 1)² against χ² of one at 1 %."""
    usable = np.ones((10, 3), dtype=bool)
    usable[:, 1] = False
    dof = joining._DOF * 10

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


def test_what_a_memory_makes_likely():
    """Cosines with the density of a first-order process; each its own level."""
    rows = np.random.default_rng(1).chisquare(1.0, (6, joining.COSINES)) + 0.1
    logs = []
    for memory in joining._MEMORIES:
        shape = 1.0 / (1.0 + (joining._ORDER / memory) ** 2)
        level = np.mean(rows.mean(axis=0) / shape)
        logs.append(np.sum(np.log(level * shape) + 1.0))
    assert joining._with_memory(rows) == pytest.approx(-0.5 * 6 * min(logs), rel=1e-9)


def test_how_the_size_of_means_varies():
    means = np.random.default_rng(4).normal(size=(3, 30))
    size = np.linalg.norm(means, axis=0)
    by_hand = (np.quantile(size, 0.9) - np.quantile(size, 0.1)) / np.median(size)
    assert _variation(means) == pytest.approx(by_hand)
    assert _variation(np.array([[3.0, 3.0], [0.0, 1.49], [0.0, 0.0]])) == np.inf
    assert _variation(np.zeros((3, 4))) == np.inf


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


@pytest.mark.parametrize("mark", [",", ";", "\t", ""])
def test_numbers_of_a_text_are_what_python_reads(mark):
    """Digits up to nineteen, points and minus signs, exponents, and white space about them."""
    rng = np.random.default_rng(8)
    sizes, digits = rng.normal(size=30) * 300.0, [0, 1, 3, 7, 12, 15] * 5
    cells = [f"{x:.{d}f}" for x, d in zip(sizes, digits, strict=True)]
    cells[4:8] = ["-0.5", "123456789012345678", "-9007199254740993.5", "7."]
    cells[11], cells[17] = "1.5e-3", "-2E4"
    between = mark or " "
    lines = [between.join(cells[i : i + 3]) for i in range(0, 30, 3)]
    text = ("\n".join(lines) + "\n").encode()
    found = read_plain(text, mark, 3, [0, 1, 2])
    assert_allclose(found.T.ravel(), [float(cell) for cell in cells], rtol=0, atol=0)
    assert read_plain(text, mark, 3, [2]).tolist() == [found[2].tolist()]
    spaced = text.replace(between.encode(), (f" {mark} " if mark else "  ").encode())
    assert (read_plain(spaced, mark, 3, [0, 1, 2]) == found).all()
    assert read_plain(text, mark, 4, [0, 1, 2]) is None
    assert read_plain(text.replace(b"-0.5", b"0-.5"), mark, 3, [0, 1, 2]) is None
    assert read_plain(text.replace(b"-0.5", b""), mark, 3, [0, 1, 2]) is None


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


def test_pieces_that_were_kept_in_a_file_come_back(tmp_path):
    rng = np.random.default_rng(1)
    pieces = [rng.normal(size=(4, 5)), rng.normal(size=(4, 3))]
    with (tmp_path / "kept").open("w+b") as stream:
        for piece in pieces:
            stream.write(piece.tobytes())
        state = SimpleNamespace(
            _file=stream, _sizes=[5, 3], outputs=("a", "b"), others=("t",), clock=1
        )
        found = list(Samples._in_file(state))
    assert all((a == b).all() for a, b in zip(found, pieces, strict=True))


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
    nu = outputs / float(joining._WEIGHT @ joining._WEIGHT)
    limit = chi2.isf(1e-3, nu) / chi2.median(nu)
    size = np.tile([1.0, 1.3, 0.8, 1.0, 1.1, 0.9, 1.0], (2, 1)).T
    size[3] = 0.99 * limit
    usable = np.ones((7, 2), dtype=bool)
    usable[:, outputs:] = False
    size[:, outputs:] = 1e9
    assert joining._are_usual(size, usable).tolist() == [True] * 7
    size[3, :outputs] = 1.01 * limit
    assert np.flatnonzero(~joining._are_usual(size, usable)).tolist() == [3]


def test_what_is_common_to_rests_raises_their_u():
    """Where it is more than their own, with degrees of freedom from one to what they had."""
    each = mean_of(
        u=np.array([0.2, 0.3]), dof=np.array([9.0, 5.0]), drift_factor=np.array([2.0, 1.0])
    )
    found = joining._raised(
        each, np.array([True, False]), np.array([0.25, 0.01]), np.array([4.0, 2.0])
    )
    assert_allclose(found.u, [0.5, 0.3])
    assert_allclose(found.common, [0.5 * 2.0 / 0.2, 1.0])
    assert_allclose(found.dof, [4.0, 5.0])
    found = joining._raised(
        each, np.ones(2, dtype=bool), np.array([0.25, 0.16]), np.array([0.3, 70.0])
    )
    assert_allclose(found.dof, [1.0, 5.0])
