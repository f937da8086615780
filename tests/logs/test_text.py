"""Text logs as they come: preambles, headers behind marks, units, times, and bad rows."""

import gzip
import json
from types import SimpleNamespace

import numpy as np
import pytest
from findings_bench import texts
from log_bench import sensor, shared

import multipos as mp
from multipos.cli import main
from multipos.files.layout import find_layout
from multipos.logs.clock import read_clock
from multipos.logs.opening import open_log

OUTPUTS = ("ax", "ay", "az")


@pytest.fixture(scope="module")
def log():
    found = mp.simulate_log(sensor(), "faces-6", sample_sd=1e-3, seed=2, rest=4.0)
    return {name: np.round(column, 6) for name, column in found.items()}


@pytest.fixture(scope="module")
def expected(log):
    return mp.average(log).readings.values


def rows_of(log, names=("time", *OUTPUTS), mark=",", end="", comma=False):
    rows = zip(*(log[name].tolist() for name in names), strict=True)
    text = "\n".join(mark.join(map(repr, row)) + end for row in rows) + "\n"
    return text.replace(".", ",") if comma else text


def written(tmp_path, text):
    path = tmp_path / "log.txt"
    path.write_text(text, encoding="utf-8")
    return path


LAYOUTS = {
    "a preamble of sentences": ("My logger, v2\nStarted today\n\nTime,ax,ay,az\n", {}),
    "a preamble of keys": ("sensor,BMI160\nrate,100\n\ntime,ax,ay,az\n", {}),
    "a header behind #": ("# made by hand\n# time,ax,ay,az\n", {}),
    "a header behind // of another kind": ("// run 7\n// time ax ay az\n", {}),
    "a header behind %": ("%time, ax, ay, az\n", {}),
    "a line of units": ("time,ax,ay,az\ns,g,g,g\n", {}),
    "units in brackets": ("Time (s),ax [g],ay [g],az [g]\n", {}),
    "quotes": ('"time","ax","ay","az"\n', {}),
    "sep=": ("sep=;\ntime;ax;ay;az\n", {"mark": ";", "comma": True}),
    "a separator behind the rows": ("time,ax,ay,az\n", {"end": ","}),
    "a separator behind all": ("time,ax,ay,az,\n", {"end": ","}),
    "a separator behind the header": ("time,ax,ay,az,\n", {}),
    "decimal commas between tabs": ("time\tax\tay\taz\n", {"mark": "\t", "comma": True}),
    "decimal commas between blanks": ("time ax ay az\n", {"mark": "  ", "comma": True}),
    "sep= and a tab": ('"sep=\t"\ntime\tax\tay\taz\n', {"mark": "\t"}),
    "a line of units and of none": ("time,ax,ay,az\n(s),-,[no_units],n/a\n", {}),
    "comments of all kinds": ("% a\n// b\n# c\ntime,ax,ay,az\n", {}),
}


@pytest.mark.parametrize("case", LAYOUTS, ids=str)
def test_the_table_is_found(case, log, expected, tmp_path):
    above, form = LAYOUTS[case]
    found = mp.average(written(tmp_path, above + rows_of(log, **form)))
    assert found.outputs == OUTPUTS
    assert found.sample_rate == pytest.approx(100.0)
    assert found.rests[0].rows.start == 0
    np.testing.assert_allclose(found.readings.values, expected, rtol=1e-12)


def test_where_the_table_begins_is_said(log, tmp_path):
    path = written(tmp_path, "My logger\nrate 100\n\n# time,ax,ay,az\n" + rows_of(log))
    assert texts(mp.average(path)) == ("the table begins on line 5, its header on line 4",)
    path = written(tmp_path, "My logger\nby hand\n" + rows_of(log))
    found = mp.average(path)
    assert found.outputs == ("2", "3", "4")
    assert texts(found) == (
        "the table begins on line 3, without a header",
        "column '1' is the time, in s by its steps",
    )
    assert texts(mp.average(written(tmp_path, "# c\ntime,ax,ay,az\n" + rows_of(log)))) == ()


@pytest.mark.parametrize(
    ("lines", "first", "header"),
    [
        (["1,2", "3,4"], 1, None),
        (["n,1,2,3", "0,1,2,3", "1,5,6,7"], 2, ("n", "1", "2", "3")),  # columns with numbers
        (["1.5,x,3.5", "4,5,6", "7,8,9", "1,2,3"], 1, None),  # a bad cell is no header
        (["# ax was turned by hand", "1 2 3 4 5", "6 7 8 9 0"], 2, None),  # a sentence
        (["# ax ay az", "1 2 3", "6 7 8"], 2, ("ax", "ay", "az")),
        (["a,b", "", "# c", "1,2", "3,4"], 4, ("a", "b")),
        (["inf,1", "inf,2", "1e308,3", "-1e308,4"], 1, None),  # steps that are no numbers
        (["k,v", "a;b", "1,5;2,5", "3,5;4,5"], 3, ("a", "b")),
    ],
)
def test_rows_tell_where_the_table_begins(lines, first, header):
    found = find_layout("log", lines)
    assert (found.first, found.header) == (first, header)


def test_a_column_without_a_name_is_not_used(log, expected, tmp_path):
    """As a data frame with its index is written."""
    rows = rows_of(log).splitlines()
    text = ",time,ax,ay,az\n" + "\n".join(f"{i},{row}" for i, row in enumerate(rows))
    found = mp.average(written(tmp_path, text))
    np.testing.assert_array_equal(found.readings.values, expected)
    assert texts(found) == ("column 1 has no name and is not used",)


def test_an_empty_column_with_a_name_is_a_column(tmp_path):
    path = written(tmp_path, "ax,note\n" + "1.5,\n2.5,\n3.5,\n")
    assert open_log(path).columns == ("ax", "note")


def test_units_leave_the_names(log, tmp_path):
    text = "Time [ms],ax (m/s²),ay (m/s^2),az (m/s2)\n"
    changed = {name: log[name] * (1000.0 if name == "time" else 9.80665) for name in log}
    path = written(tmp_path, text + rows_of(changed))
    found = mp.average(path)
    assert found.outputs == OUTPUTS
    assert found.readings.unit == "m/s^2"
    assert found.sample_rate == pytest.approx(100.0)
    assert texts(found) == ("column 'Time' is the time, in ms by its name",)
    assert mp.average(path, outputs="ax (m/s²), AY", time_column="time [MS]").outputs == (
        "ax",
        "ay",
    )
    with pytest.raises(mp.MultiposError, match=r"no column 'axx'; did you mean 'ax'\? The columns"):
        mp.average(path, outputs="axx")


def test_a_number_in_brackets_is_no_unit(log, tmp_path):
    names = "timestamp," + ",".join(f"accelerometer_m_s2[{i}]" for i in range(3))
    found = mp.average(written(tmp_path, f"{names}\n{rows_of(log)}"))
    assert found.outputs == tuple(f"accelerometer_m_s2[{i}]" for i in range(3))
    assert found.unit is None


def test_apply_keeps_the_header_as_it_stands(log, tmp_path, capsys):
    path = written(tmp_path, "logger 7\nTime (s),ax (g),ay (g),az (g),\n" + rows_of(log, end=","))
    sensor().save(tmp_path / "cal.json")
    assert main(["apply", str(tmp_path / "cal.json"), str(path), "-o", "-"]) == 0
    first, second, *_ = capsys.readouterr().out.splitlines()
    assert first == "Time (s),ax (g),ay (g),az (g),f_x,f_y,f_z,outside"
    assert second.startswith(rows_of(log).splitlines()[0])
    assert second.count(",") == 7


# --- time

TIMES = {
    "t": (1.0, "s by its steps"),
    "timestamp": (1e3, "ms by its steps"),
    "TimeUS": (1e6, "us by its name"),
    "time_ms": (1e3, "ms by its name"),
    "seconds_elapsed": (1.0, "s by its name"),
    "millis": (1e3, "ms by its name"),
    "time stamp": (1e6, "us by its steps"),
    "timestamp_sample": (1e9, "ns by its steps"),
    "SampleTimeFine": (1e4, "100 us by its name"),
    "Elapsed Time (s)": (1.0, "s by its name"),
}


@pytest.mark.parametrize("name", TIMES)
def test_the_unit_of_time_is_recognised(name, log, tmp_path):
    per_second, said = TIMES[name]
    scaled = log | {"time": np.round(log["time"] * per_second, 6)}
    found = mp.average(written(tmp_path, f"{name},ax,ay,az\n{rows_of(scaled)}"))
    assert found.sample_rate == pytest.approx(100.0)
    column = name.partition(" (")[0]
    assert texts(found) == (f"column '{column}' is the time, in {said}",)


@pytest.mark.parametrize(("power", "unit"), [(0, "s"), (3, "ms"), (6, "us"), (9, "ns")])
def test_a_time_since_1970_tells_its_unit_by_its_size(power, unit, log, tmp_path):
    """A sample every ten seconds, which by its steps would be of another unit."""
    stamps = (1_700_000_000 + 10 * np.arange(len(log["time"]))) * 10**power
    path = written(tmp_path, f"time,ax,ay,az\n{rows_of(log | {'time': stamps})}")
    found = mp.average(path, min_duration=2000.0)
    assert found.sample_rate == pytest.approx(0.1)
    assert found.rests[0].time[0] == pytest.approx(1.7e9)
    assert unit == "s" or "by its size, since 1970" in texts(found)[0]


@pytest.mark.parametrize(
    "pattern",
    [
        "{}",
        "{}Z",
        "{}+02:00",
        "{},",  # a decimal comma
        "{} ",  # a blank for the T
        "{}:",  # milliseconds behind a colon
        "{}/",
    ],
)
def test_dates_tell_the_time(pattern, log, expected, tmp_path):
    stamps = np.datetime64("2024-02-28T23:59:58.000") + np.round(1e3 * log["time"]).astype(int)
    changes = {",": (".", ","), " ": ("T", " "), ":": (".", ":"), "/": ("-", "/")}
    old, new = changes.get(pattern[2:], ("", ""))
    cells = [f"{stamp}{pattern[2:] if not old else ''}".replace(old, new) for stamp in stamps]
    rows = rows_of(log, OUTPUTS, mark=";").splitlines()
    text = "\n".join(f"{cell};{row}" for cell, row in zip(cells, rows, strict=True))
    found = mp.average(written(tmp_path, f"when;ax;ay;az\n{text}\n"))
    np.testing.assert_allclose(found.readings.values, expected, rtol=1e-12)
    assert found.sample_rate == pytest.approx(100.0, rel=1e-4)  # 1.7e9 s to 2e-7
    assert found.rests[0].time[0] == pytest.approx(1709164798.0, abs=1e-6)  # date -u +%s


@pytest.mark.parametrize("bad", ["", "2024-02-28", "2024-13-28T00:00:00", "0.5", "12:00 Z", "now"])
def test_a_bad_date_is_an_error_or_left_out(bad, log, tmp_path):
    stamps = np.datetime64("2024-02-28T23:59:58.000") + np.round(1e3 * log["time"]).astype(int)
    cells = [str(stamp) for stamp in stamps]
    cells[700] = bad
    rows = rows_of(log, OUTPUTS).splitlines()
    text = "\n".join(f"{cell},{row}" for cell, row in zip(cells, rows, strict=True))
    path = written(tmp_path, f"time,ax,ay,az\n{text}\n")
    with pytest.raises(mp.MultiposError, match=r"row 701 \(line 702\), column 'time'"):
        mp.average(path)
    assert texts(mp.average(path, drop_bad=True)) == (f"1 bad row was omitted of {len(rows)}",)


def test_a_log_without_a_whole_row_is_refused(tmp_path):
    """Every column holds numbers, but no row does in most of them."""
    path = written(tmp_path, "1,x,y\nx,2,y\nx,y,3\nz\n")
    with pytest.raises(mp.MultiposError, match="no row has all its numbers"):
        mp.average(path)


def test_time_unit_decides(log, tmp_path):
    path = written(tmp_path, f"t_ms,ax,ay,az\n{rows_of(log | {'time': 1e4 * log['time']})}")
    assert mp.average(path, time_unit="ms").sample_rate == pytest.approx(10.0)
    fast = mp.average(path, time_unit="us", min_duration=0.02)
    assert fast.sample_rate == pytest.approx(10000.0)
    with pytest.raises(mp.UsageError, match="--time-unit takes s, ms, us, ns, got 'h'"):
        mp.average(path, time_unit="h")


def test_an_unknown_rate_is_said_and_a_stated_one_taken(log, expected, tmp_path):
    path = written(tmp_path, "ax,ay,az\n" + rows_of(log, OUTPUTS))
    (warning,) = [text for text in texts(mp.average(path)) if "the log has no time" in text]
    assert "a rest is at least 192 samples" in warning
    path = written(tmp_path, "Device at 100 Hz\nax,ay,az\n" + rows_of(log, OUTPUTS))
    found = mp.average(path)
    assert found.sample_rate == 100.0
    assert "the log states a sample rate of 100 Hz" in texts(found)
    assert not any("has no time" in text for text in texts(found))
    assert mp.average(path, rate=50.0).sample_rate == 50.0


# --- bad rows


def test_a_last_row_that_is_cut_off_is_left_out(log, tmp_path, capsys):
    text = "time,ax,ay,az\n" + rows_of(log)
    whole = mp.average(written(tmp_path, text))
    for end in ("34.0,0.1", "34.0,0.1,0.2,-", "34.0,0.1\n"):
        found = mp.average(written(tmp_path, text + end))
        assert texts(found)[0] == f"the last row, '{end.strip()}', is incomplete and was omitted"
        assert found.rests[-1].rows == whole.rests[-1].rows
    for end in ("", "\n\n", "   \n", "# the end\n"):
        assert texts(mp.average(written(tmp_path, text + end))) == ()
    written(tmp_path, text + "34.0,0.1")
    sensor().save(tmp_path / "cal.json")
    assert (
        main(["apply", str(tmp_path / "cal.json"), str(tmp_path / "log.txt"), "-o", "-", "-v"]) == 0
    )
    out, err = capsys.readouterr()
    assert len(out.splitlines()) == len(log["time"]) + 1
    assert "is incomplete and was omitted" in err


@pytest.mark.parametrize("bad", ["oops", "", "nan", "inf", "1e30", "-4.6e12", None])
def test_bad_rows_are_an_error_or_left_out_and_counted(bad, log, tmp_path, capsys):
    lines = ("time,ax,ay,az\n" + rows_of(log)).splitlines()
    cells = lines[700].split(",")
    lines[700] = ",".join(cells[:2]) if bad is None else ",".join([*cells[:2], bad, cells[3]])
    path = written(tmp_path, "\n".join(lines) + "\n")
    if bad != "-4.6e12":  # of a size that counts of some sensor might have
        assert main(["average", str(path)]) == 1
        assert "row 700 (line 701)" in capsys.readouterr().err
    found = mp.average(path, drop_bad=True)
    assert texts(found) == (f"1 bad row was omitted of {len(log['time'])}",)
    rows = found.rests[1].rows
    assert rows.start < 699 < rows.end
    assert found.rests[1].found.n == rows.end - rows.start - 1
    kept = np.r_[rows.start : 699, 700 : rows.end]
    np.testing.assert_allclose(found.rests[1].found.mean[0], log["ax"][kept].mean(), rtol=1e-12)
    by_rows = mp.average(path, drop_bad=True, sections={"a": rows._asdict()})
    np.testing.assert_allclose(by_rows.rests[0].found.mean, found.rests[1].found.mean, rtol=1e-13)
    assert by_rows.rests[0].rows == rows
    with pytest.raises(mp.MultiposError, match="of section 'b' fewer than two rows are not bad"):
        mp.average(path, drop_bad=True, sections={"b": {"start": 698, "end": 700}})


@pytest.mark.parametrize("bad", ["oops", "1e30"])
def test_a_bad_first_row_is_a_row_all_the_same(bad, log, tmp_path, capsys):
    rows = rows_of(log).splitlines()
    rows[0] = f"0.0,{bad},0.1,0.2"
    path = written(tmp_path, "time,ax,ay,az\n" + "\n".join(rows) + "\n")
    assert main(["average", str(path)]) == 1
    assert "row 1 (line 2), column 'ax'" in capsys.readouterr().err
    found = mp.average(path, drop_bad=True)
    assert texts(found) == (f"1 bad row was omitted of {len(rows)}",)
    assert found.rests[0].rows.start == 1


def test_an_output_that_is_text_is_an_error(log, tmp_path):
    rows = rows_of(log, ("time", "ax", "ay")).splitlines()
    path = written(tmp_path, "time,ax,ay,az\n" + "".join(f"{row},n/a\n" for row in rows))
    with pytest.raises(mp.MultiposError, match="column 'az' is an output by its name, but holds"):
        mp.average(path)


# --- outputs


@pytest.mark.parametrize(
    ("beside", "outputs"),
    [
        ("g{x}", "a{x}"),
        ("gyr_{x}", "acc_{x}"),
        ("Gyro{X}", "Accel{X}"),
        ("magnetic_field.{x}", "linear_acceleration.{x}"),
        ("Light {X}", "Accelerometer {X}"),
        ("imu0_w{x}", "imu0_a{x}"),
        ("motionUserAcceleration{X}(G)", "accelerometerAcceleration{X}"),
        ("Unit_7_Gyro_{X}_CAL", "Unit_7_Accel_LN_{X}_CAL"),
    ],
)
@pytest.mark.parametrize("order", ["xyz", "zyx"])
def test_acceleration_is_told_by_its_name(beside, outputs, order, log, tmp_path):
    names = [f.format(x=x, X=x.upper()) for f in (beside, outputs) for x in order]
    many = {"Timestamp": log["time"], **dict.fromkeys(names[:3], np.zeros_like(log["time"]))}
    many |= {name: log[f"a{x}"] for name, x in zip(names[3:], order, strict=True)}
    found = mp.average(written(tmp_path, ",".join(many) + "\n" + rows_of(many, tuple(many))))
    assert found.outputs == tuple(outputs.format(x=x, X=x.upper()) for x in "xyz")
    assert found.sample_rate == pytest.approx(100.0)
    assert "by their names" in texts(found)[-1]


def test_two_accelerometers_are_not_chosen_between(log, tmp_path):
    rows = rows_of(log, ("time", *OUTPUTS, *OUTPUTS))
    path = written(tmp_path, f"time,a_x,a_y,a_z,acc_x,acc_y,acc_z\n{rows}")
    with pytest.raises(mp.UsageError, match="6 columns could be outputs: a_x, a_y, a_z, acc_x"):
        mp.average(path)


def test_gravity_tells_the_outputs_of_a_log_without_names(tmp_path):
    """The first three of six columns, which are told from a gyro with a bias by what they show."""
    rng = np.random.default_rng(2)
    log = mp.simulate_log(sensor(), "faces-corners-14", sample_sd=1e-3, seed=1, rest=4.0)
    force = np.column_stack([log[name] for name in OUTPUTS])
    turning = np.gradient(force, axis=0)[:, [1, 2, 0]] * 10.0
    rate = 0.02 + turning + 1e-3 * rng.normal(size=force.shape)
    for columns, outputs in ((force, rate), "123"), ((rate, force), "456"):
        path = tmp_path / "log.txt"
        np.savetxt(path, np.column_stack(columns), fmt="%.6f")
        found = mp.average(path)
        assert found.outputs == tuple(outputs)
        assert "by what they show of gravity" in texts(found)[-1]


def test_the_real_log_needs_no_option():
    assert mp.average(shared("mpu9150_imu0.log")).outputs == ("1", "2", "3")
    session = mp.average(shared("ferraris_session.csv"))
    assert session.outputs == ("acc_x", "acc_y", "acc_z")
    assert any("n_samples, gyr_x, gyr_y, gyr_z are not used" in n for n in texts(session))


# --- packed


def test_gzip_is_read(log, expected, tmp_path):
    path = tmp_path / "log.csv.gz"
    path.write_bytes(gzip.compress(("time,ax,ay,az\n" + rows_of(log)).encode()))
    np.testing.assert_array_equal(mp.average(path).readings.values, expected)
    np.savez(tmp_path / "log.npz", **log)
    path.write_bytes(gzip.compress((tmp_path / "log.npz").read_bytes()))
    assert len(mp.average(path).rests) == 6
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(mp.MultiposError, match=r"log\.csv\.gz: cannot unpack"):
        mp.average(path)


def test_what_was_found_is_in_the_json(log, tmp_path, capsys):
    path = written(tmp_path, f"logger\ntimestamp,ax (g),ay (g),az (g)\n{rows_of(log)}")
    assert main(["average", str(path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["findings"][0]["text"] == "the table begins on line 3, its header on line 2"
    assert found["unit"] == "g"
    assert found["positions"][0]["log"] == "log.txt"
    assert found["short"] == []


def test_a_clock_of_steps_that_are_no_numbers_has_a_unit():
    """What is wrong with it is said where the sample rate is formed."""
    clock = read_clock(SimpleNamespace(dates=(), units={}), "ticks", np.array([0.0, np.inf]), None)
    assert clock.unit == "s"


def test_numbers_that_no_sensor_gives_do_not_end_the_search_for_gravity(tmp_path):
    rng = np.random.default_rng(0)
    rows = 1.0 + 1e-3 * rng.standard_normal((600, 7))
    rows[:, 0] = 0.02 * np.arange(600)
    rows[::3, 2] = -3.6e210
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",")
    with pytest.raises(mp.UsageError, match="6 columns could be outputs"):
        mp.average(tmp_path / "log.csv")


@pytest.mark.parametrize("mark", [" ", "\t", ",", ";"])
def test_a_long_line_of_blanks_is_no_row(mark, tmp_path):
    # As long as a row, so that its length does not tell.
    rows = [mark.join(f"{x:.6f}" for x in (0.01 * k, 0.01, 0.02, 1.0)) for k in range(200)]
    path = tmp_path / "bare.log"
    path.write_text("\n".join([*rows[:90], " " * 60, *rows[90:]]) + "\n", encoding="utf-8")
    (piece,) = open_log(path, columns="time,ax,ay,az").read(("ax", "time"))
    assert piece.table.rows == len(piece.lines()) == 200
    np.testing.assert_allclose(piece.table.columns["time"], 0.01 * np.arange(200), atol=1e-12)


def test_a_refusal_says_what_was_taken(log, tmp_path):
    four = {name: column[:2350] for name, column in log.items()}
    with pytest.raises(mp.MultiposError, match=r"Outputs are ax, ay, az; rest: rows 0 to .*\(4\)"):
        mp.calibrate(four)
    path = tmp_path / "seven.txt"
    np.savetxt(path, np.random.default_rng(1).normal(size=(1200, 7)))
    said = r"1,200 lines, 7 numbers each, no names; type multipos calibrate seven.txt --outputs"
    with pytest.raises(mp.UsageError, match=said):
        mp.calibrate(path)


def test_bad_rows_of_one_of_two_sensors_are_dropped(log, expected, tmp_path):
    rows = rows_of(log).splitlines()
    lines = [f"{row},{name}" for row in rows for name in ("A", "G")]
    lines[12] = "5,A"
    path = written(tmp_path, "\n".join(["time,ax,ay,az,which", *lines]))
    found = mp.average(path, only="which=A", drop_bad=True)
    np.testing.assert_allclose(found.readings.values, expected, atol=1e-4)


def test_logs_of_one_rest_each_have_one_warning_of_a_kind(log, tmp_path):
    cuts = [each.rows for each in mp.average(log).rests]
    paths = [tmp_path / f"{first}.csv" for first, _ in cuts]
    for path, (first, last) in zip(paths, cuts, strict=True):
        part = {name: column[first:last] for name, column in log.items()}
        path.write_text("ax,ay,az\n" + rows_of(part, OUTPUTS))
    said = [each.text for each in mp.average(*paths).findings if each.code == "no-time"]
    assert len(said) == 1
    assert said[0].endswith("(as 6 of 6 logs)")


def test_days_of_a_spreadsheet_are_a_time(log, expected, tmp_path):
    days = dict(log, time=45417.5 + log["time"] / 86400.0)
    found = mp.average(written(tmp_path, "Zeit,ax,ay,az\n" + rows_of(days)))
    np.testing.assert_allclose(found.readings.values, expected, atol=1e-9)
    assert found.sample_rate == pytest.approx(100.0, rel=1e-3)
    said = found.to_dict()
    assert said["layout"] == "4 columns between commas, header above line 2"
    assert said["taken"] == {"time": "Zeit", "outputs": ["ax", "ay", "az"]}


def test_the_first_sheet_that_holds_readings_is_taken_and_said(log, expected, tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for row in (["Bench", 4], ["Serial", 12]):
        book.active.append(row)
    sheet = book.create_sheet("Run 1")
    for row in ([*log], *zip(*(column.tolist() for column in log.values()), strict=True)):
        sheet.append([*row])
    book.save(tmp_path / "log.xlsx")
    found = mp.average(tmp_path / "log.xlsx")
    np.testing.assert_allclose(found.readings.values, expected, rtol=1e-12)
    assert "taken from sheet 'Run 1', of 2" in texts(found)
    assert mp.read_table(tmp_path / "log.xlsx").read_as == "taken from sheet 'Run 1', of 2"


def test_a_magnetometer_of_two_outputs_has_bias_and_scale_named(tmp_path):
    turn = np.radians(np.arange(720.0))
    rows = np.column_stack([12.0 + 30.0 * np.cos(turn), 28.0 * np.sin(turn) - 5.0])
    np.savetxt(tmp_path / "m.csv", rows, delimiter=",", header="mx [uT],my [uT]", comments="")
    with pytest.raises(mp.MultiposError, match=r"mx 12 and 30, my -5 and 28, which are bias"):
        mp.calibrate(tmp_path / "m.csv")
