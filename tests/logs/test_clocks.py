"""Clocks, interleaved sensors, registers and encodings: one simulated log written in many ways."""

from types import SimpleNamespace

import numpy as np
import pytest
from log_bench import columns_of

import multipos as mp
from multipos.logs.clock import _turns_slowly, read_clock, usual_step
from multipos.logs.opening import open_log, read_log
from multipos.logs.samples import rises

OUTPUTS = ("ax", "ay", "az")
RATE = 100.0


@pytest.fixture(scope="module")
def log():
    return columns_of(scheme="faces-6", rate=RATE)


def written(path, header, rows, encoding="utf-8"):
    lines = [",".join(map(str, row)) for row in rows]
    path.write_bytes(("\n".join([header, *lines]) + "\n").encode(encoding))
    return path


def stamped(path, log, stamp, name="time"):
    values = np.column_stack([log[output] for output in OUTPUTS]).tolist()
    rows = ([stamp(i), *row] for i, row in enumerate(values))
    return written(path, ",".join([name, *OUTPUTS]), rows)


def clock(i, first=36_000_000):
    """A time of a day, of row i, from 10 o'clock or another millisecond on."""
    seconds, ms = divmod(first + 10 * i, 1000)
    return f"{seconds // 3600 % 24:02}:{seconds // 60 % 60:02}:{seconds % 60:02}.{ms:03}"


@pytest.mark.parametrize(
    ("name", "stamp"),
    [
        ("time", lambda i: 150_000_000 + 10_000 * i),  # µs since power came, not 1974
        ("time", lambda i: 108_000_000 + 10 * i),  # ms
        ("time", lambda i: 108_000_000_000_000 + 10_000_000 * i),  # ns
        ("ustime", lambda i: 20_000_000 + 10_000 * i),
        ("time", lambda i: 10 * i % 2**16),  # wraps after 65.5 s
        ("time", lambda i: (4_290_000_000 + 10_000 * i) % 2**32),
        ("timestamp", lambda i: (4_290_000_000 + 10_000 * i) % 2**32),
        ("time_ms", lambda i: 10 * i % 2**16),
        ("uptime", lambda i: 150_000_000 + 10_000 * i),
        ("uptime_ms", lambda i: 108_000_000 + 10 * i),
        ("time", clock),
        ("time", lambda i: clock(i, 86_390_000)),  # over midnight
        ("time", lambda i: f"11/21/2026 {clock(i)}"),
        ("time", lambda i: f"21.11.2026 {clock(i)}"),
        ("time", lambda i: 1_700_000_000_000 + 10 * i),
    ],
)
def test_clocks_of_any_kind_tell_the_time(name, stamp, log, tmp_path):
    found = mp.average(stamped(tmp_path / "log.csv", log, stamp, name))
    assert found.sample_rate == pytest.approx(RATE, rel=1e-4)
    first, last = found.rests[0].time[0], found.rests[-1].time[1]
    assert last - first == pytest.approx((len(log["ax"]) - 1) / RATE, rel=1e-3)


def test_a_column_that_counts_rows_is_no_time(log, tmp_path):
    found = mp.average(stamped(tmp_path / "log.csv", log, lambda i: i))
    assert found.sample_rate is None
    assert any("a row counter" in each.text for each in found.findings)


@pytest.mark.parametrize("turn", [2.0, 5.0])
def test_a_sample_a_second_is_a_time_where_the_sensor_turns_within_few_rows(turn, tmp_path):
    log = columns_of(scheme="fibonacci-24", rate=1.0, rest=60.0, turn=turn)
    found = mp.average(stamped(tmp_path / "log.csv", log, lambda i: i))
    assert found.sample_rate == 1.0
    assert len(found.rests) == 24


def test_interchanged_rows_are_refused(log, tmp_path):
    path = stamped(tmp_path / "log.csv", log, lambda i: (i ^ 1 if i in (700, 701) else i) / RATE)
    with pytest.raises(mp.MultiposError, match=r"row 702 .* runs backwards.*interchanged"):
        mp.average(path)


@pytest.mark.parametrize("names", [(7, 9), ("left", "right")])
def test_sensors_that_take_turns_are_told_apart(names, log, tmp_path):
    rows = []
    for i, row in enumerate(np.column_stack([log[output] for output in OUTPUTS])):
        rows += [[i / RATE, names[0], *row], [i / RATE, names[1], *(1.02 * row + 0.1)]]
    path = written(tmp_path / "log.csv", "time,id,ax,ay,az", rows)
    refused = rf"2 sensors take turns.*'id'.*--only id={names[0]}"
    with pytest.raises(mp.MultiposError, match=refused):
        mp.average(path)
    one, other = (mp.average(path, only=f"id={value}") for value in names)
    alone = mp.average(log)
    np.testing.assert_allclose(one.readings.values, alone.readings.values, rtol=1e-9)
    np.testing.assert_allclose(other.readings.values, 1.02 * alone.readings.values + 0.1, rtol=1e-3)
    assert len(mp.average(path, only=[f"id={names[1]}", "1", "2"]).rests) == 2
    with pytest.raises(mp.MultiposError, match="no row has 'id' = 8"):
        mp.average(path, only="id=8")


def test_a_counter_of_a_packet_is_no_sensor(log):
    assert len(mp.average(log | {"n": np.arange(len(log["ax"])) % 4}).rests) == 6


def test_registers_without_a_sign(log):
    counts = {name: np.round(16384 * log[name]) for name in OUTPUTS}
    bare = {name: column % 2**16 for name, column in counts.items()}
    with pytest.raises(mp.MultiposError, match="--signed 16"):
        mp.average(bare)
    signed, right = mp.average(bare, signed=16), mp.average(counts)
    np.testing.assert_array_equal(signed.readings.values, right.readings.values)
    with pytest.raises(mp.MultiposError, match="is no number of 16 bits"):
        mp.average(counts, signed=16)


@pytest.mark.parametrize(
    ("header", "encoding"),
    [("时间,加速度X,加速度Y,加速度Z", "gb18030"), ("Zeit (µs),ax,ay,az", "cp1252")],
)
@pytest.mark.parametrize("utf16", [False, True])
def test_text_in_other_encodings(header, encoding, utf16, log, tmp_path):
    values = np.column_stack([log[output] for output in OUTPUTS]).tolist()
    rows = [[10_000 * i, *row] for i, row in enumerate(values)]
    path = written(tmp_path / "log.csv", header, rows, "utf-16" if utf16 else encoding)
    outputs = [name.split(" ")[0] for name in header.split(",")[1:]]
    found = mp.average(path, outputs=outputs, rate=RATE)
    np.testing.assert_allclose(found.readings.values, mp.average(log).readings.values, rtol=1e-9)


@pytest.mark.parametrize("before", range(3))
def test_a_letter_at_the_end_of_what_is_looked_at_first_stays_whole(before, tmp_path):
    """Of three bytes each, on from any of them at byte 65,536."""
    rows = [["0", "0", "0", "1", "x" * before]] * 4 + [["0", "0", "0", "1", "角" * 22_000]]
    path = written(tmp_path / "log.csv", "time,ax,ay,az,Gerät", rows)
    assert read_log(open_log(path))["Gerät"] == [row[-1] for row in rows]


# --- what a rest is


def rests_of(still, turning, noise, rng, spikes=0.0, vibration=0.0):
    """Rests at directions by chance, cosine turns between; samples (n, 3), and where rests are."""
    parts, edges, at = [], [], 0
    before = rng.normal(size=3)
    for _ in range(12):
        after = rng.normal(size=3)
        ramp = (1.0 - np.cos(np.linspace(0.0, np.pi, turning))) / 2.0
        parts += [before + ramp[:, None] * (after - before), np.tile(after, (still, 1))]
        edges.append((at + turning, at + turning + still))
        at, before = at + turning + still, after
    f = np.concatenate(parts)
    f = 9.8 * f / np.linalg.norm(f, axis=1)[:, None] + noise * rng.normal(size=f.shape)
    wave = np.sin(2.0 * np.pi * 0.237 * np.arange(len(f)))
    f += vibration * wave[:, None] * np.array([0.6, 0.6, 0.5])
    return f + 5.0 * (rng.random(f.shape) < spikes), edges


@pytest.mark.parametrize(
    ("still", "noise", "more"),
    [
        (400, 0.02, {}),
        (400, 0.02, {"spikes": 0.003}),
        (120, 0.02, {}),
        (400, 0.5, {}),
        (400, 0.02, {"vibration": 1.0}),
    ],
    ids=["plain", "spikes", "1.2 s", "noise", "vibration"],
)
def test_rests_are_kept_whole(still, noise, more):
    samples, edges = rests_of(still, 150, noise, np.random.default_rng(3), **more)
    data = dict(zip(OUTPUTS, samples.T, strict=True))
    found = mp.average(data, rate=RATE)
    assert len(found.rests) == len(edges)
    kept = []
    for rest, (start, end) in zip(found.rests, edges, strict=True):
        into = max(start - rest.rows.start, rest.rows.end - end)
        assert into <= (10 if noise < 0.1 and not more.get("vibration") else 50)
        kept.append((min(rest.rows.end, end) - max(rest.rows.start, start)) / still)
        if "spikes" in more:  # the mean without them: .02/√400 = 1e-3, and spikes of 5/400
            truth = samples[start:end][np.abs(samples[start:end]).max(axis=1) < 1e9]
            assert np.abs(rest.found.mean - np.median(truth, axis=0)).max() < 6e-3
    assert np.median(kept) >= 0.95


@pytest.mark.parametrize(("first", "last", "rests"), [(4, 4, 11), (0, 3, 8), (8, 11, 8)])
def test_a_frozen_stretch_is_no_rest_and_named(first, last, rests):
    samples, edges = rests_of(400, 150, 0.02, np.random.default_rng(5))
    frozen = slice(max(edges[first][0] - 100, 0), min(edges[last][1] + 100, len(samples)))
    samples[frozen] = samples[frozen.start]
    found = mp.average(dict(zip(OUTPUTS, samples.T, strict=True)), rate=RATE)
    assert len(found.rests) == rests
    (said,) = [each for each in found.findings if each.code == "frozen"]
    first, last = (int(cell.rstrip(":")) for cell in said.text.split()[1:4:2])
    assert abs(first - frozen.start) < 12
    assert abs(last - frozen.stop) < 12


# --- as a user brings it


@pytest.mark.parametrize(
    "form", ["ax: {}\tay: {}\taz: {}", "ax={}, ay={}, az={}", "ax:{} ay:{} az:{}"]
)
def test_names_before_the_numbers_of_a_serial_monitor(form, log, tmp_path):
    rows = np.column_stack([log[output] for output in OUTPUTS]).tolist()
    lines = ["MPU6050 init ok", *(form.format(*row) for row in rows)]
    (tmp_path / "log.txt").write_text("\n".join(lines) + "\n")
    found = mp.average(tmp_path / "log.txt", rate=RATE)
    assert found.outputs == OUTPUTS
    np.testing.assert_allclose(found.readings.values, mp.average(log).readings.values, rtol=1e-9)


@pytest.mark.parametrize(
    ("column", "way"), [("position", "--scheme NAME"), ("direction", "m.csv.")]
)
def test_a_table_of_means_is_told_from_a_log(column, way, tmp_path):
    rows = [["+X", 1.0, 0.0, 0.0], ["-X", -1.0, 0.0, 0.0], ["+Y", 0.0, 1.0, 0.0]] * 4
    path = written(tmp_path / "m.csv", f"{column},ax,ay,az", rows)
    with pytest.raises(mp.MultiposError, match=r"table of means.*multipos fit m\.csv") as raised:
        mp.calibrate(path)
    assert way in str(raised.value)


@pytest.mark.parametrize("header", ["", "# time tx ty tz wx wy wz"])
@pytest.mark.parametrize("first", ["force", "rate"])
def test_three_columns_that_show_gravity_are_taken_and_said(header, first, log, tmp_path):
    """Rates of a gyro with a bias, and a temperature beside them where nothing names a column."""
    rng = np.random.default_rng(2)
    force = np.column_stack([log[output] for output in OUTPUTS])
    rate = [0.3, -0.2, 0.1] + 0.01 * rng.normal(size=force.shape)
    rate[1:] += 20.0 * np.diff(force, axis=0)
    groups = [force, rate] if first == "force" else [rate, force]
    columns = [log["time"], *groups, *([] if header else [25.0 + 0.0 * log["time"]])]
    np.savetxt(tmp_path / "log.txt", np.column_stack(columns), header=header, comments="")
    found = mp.average(tmp_path / "log.txt")
    np.testing.assert_allclose(found.readings.values, mp.average(log).readings.values, rtol=1e-9)
    assert any("by what they show of gravity" in each.text for each in found.findings)


def test_what_turns_in_small_steps_is_no_sample_a_second():
    """A turn over 400 rows, the same in eight poses of 50 rows, one at rest, and too few rows."""
    angle = 2.0 * np.pi * np.arange(400) / 400
    noise = 1e-3 * np.random.default_rng(2).standard_normal((2, 400))
    turning = np.array([np.cos(angle), np.sin(angle)]) + noise
    posed = np.repeat(turning[:, 25::50], 50, axis=1) + noise
    assert _turns_slowly(turning)
    assert not _turns_slowly(posed)
    assert not _turns_slowly(np.array([[1.0], [0.0]]) + noise)
    assert not _turns_slowly(turning[:, :5])


@pytest.mark.parametrize(
    ("first", "step", "unit", "since"),
    [
        (1.7e15, 5e5, "us", True),  # two a second: by their steps they were ns
        (1.7e12, 1500.0, "ms", True),
        (1.7e9, 30.0, "s", True),
        (1e9, 30.0, "ms", False),  # 2001: half a minute a row is of later logs
        (1.7e9, 90.0, "ms", False),
        (0.0, 0.5, "s", False),
        (5.0, 10.0, "ms", False),
        (5.0, 2e5, "ns", False),
    ],
)
def test_the_unit_of_a_time_by_its_size_or_its_steps(first, step, unit, since):
    log = SimpleNamespace(dates=(), units={})
    found = read_clock(log, "t", first + step * np.arange(9.0), None)
    expected = "its size, since 1970" if since else "its steps"
    assert (found.unit, found.by) == (unit, expected)


@pytest.mark.parametrize(
    ("time", "step"),
    [([0.0, 0.0, 0.0, 0.6], 0.2), ([-1e308, 1e308], np.inf), ([3.0], 0.0), ([2.0, 1.0], 0.0)],
)
def test_the_usual_step_of_bursts_is_their_mean_and_of_corrupt_times_no_number(time, step):
    assert usual_step(np.array(time)) == pytest.approx(step)


def test_what_no_clock_counts_to_is_left_out_of_its_steps():
    """Cells of ±1e308, whose differences have no size: the times between them rise, or do not."""
    assert rises([1.0, -1e308, 2.0, 1e308, 3.0])
    assert rises(np.array([0.0, 1.0, np.nan, 1.0, 2.0]))
    assert not any(rises(np.array(time)) for time in ([1.0, 1.0], [0.0, 2.0, 1.0, 3.0], [1.0], []))
    assert not rises([-1e308, 1e308, 5.0, -1e308])
