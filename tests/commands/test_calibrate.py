"""From raw logs to a calibration and its exports, in one go."""

import json
import subprocess
import sys
from inspect import signature

import numpy as np
import pytest
from consumers import read_back
from findings_bench import texts
from log_bench import columns_of, sensor, shared, write_csv

import multipos as mp
from multipos.cli import command_parser, main

OUTPUTS = ("ax", "ay", "az")


@pytest.fixture(scope="module")
def log():
    return columns_of(scheme="faces-corners-14")


@pytest.fixture
def path(log, tmp_path):
    return write_csv(tmp_path / "log.csv", log)


def test_it_is_average_and_fit_in_one(log):
    found = mp.average(log)
    expected = mp.fit(found.readings, unknown_orientation=True)
    cal = mp.calibrate(log)
    np.testing.assert_array_equal(cal.parameters, expected.parameters)
    np.testing.assert_array_equal(cal.covariance, expected.covariance)
    assert cal.estimator == "unknown-orientation"
    known = mp.calibrate(log, scheme="faces-corners-14", model="own-quadratic")
    matched = mp.average(log, scheme="faces-corners-14").readings
    same = mp.fit(matched, model="own-quadratic")
    assert known.estimator == "uncertain-orientation"
    np.testing.assert_array_equal(known.parameters, same.parameters)
    linear = mp.calibrate(log, scheme="faces-corners-14")
    assert np.abs((linear.parameters - sensor().parameters) / linear.u).max() < 4.5  # 12 of them


def test_outputs_sense_the_axes_they_name(log):
    expected = mp.calibrate(log, scheme="faces-corners-14")
    turned = mp.calibrate(log, scheme="faces-corners-14", outputs="az,ax,ay")
    for output, axis in zip(OUTPUTS, "xyz", strict=True):
        assert turned[output, axis].value == pytest.approx(expected[output, axis].value, rel=1e-9)
    pair = {name: log[name] for name in ("time", "ay", "az")}
    cal = mp.calibrate(pair, scheme="faces-corners-14")
    assert cal.model.axes == ("y", "z")
    same = expected["az", "z"]  # of rests that end a little elsewhere
    assert cal["az", "z"].value == pytest.approx(same.value, abs=5.0 * same.u)


def test_the_means_are_taken_wherever_readings_are(log):
    found = mp.average(log, scheme="faces-corners-14")
    np.testing.assert_array_equal(mp.fit(found).parameters, mp.fit(found.readings).parameters)
    assert mp.fit(found).outputs == OUTPUTS


def test_every_option_of_average_and_fit_is_one_of_calibrate():
    options = {action.dest for action in command_parser("calibrate")._actions}
    for name in ("average", "fit", "export"):
        theirs = {action.dest for action in command_parser(name)._actions}
        # a regression is corrected, and calibrate makes none; a log has no angles
        assert theirs - {"readings", "calibration", "correct", "angle_zero"} <= options


def test_the_command_writes_the_calibration_and_the_exports_beside_it(path, tmp_path, capsys):
    out = tmp_path / "cal.json"
    targets = ["c", "px4", "ros-imu-calib", "ardupilot"]
    assert main(["calibrate", str(path), "--to", *targets, "--allow-lossy", "-o", str(out)]) == 0
    printed, warned = capsys.readouterr()
    assert printed.startswith("ax, ay, az calibrated from 14 hand-held positions: rms error ")
    assert "Parameters" in printed
    names = ["cal.c", "cal_test.c", "cal_px4.params", "cal_ros-imu-calib.yaml"]
    for name in [*names, "cal_ardupilot.parm"]:
        assert (tmp_path / name).exists()
        assert str(tmp_path / name) in printed.splitlines()[-1]
    assert "gravity reads" not in warned  # it is a note
    cal = mp.load(out)
    assert "likely-unit" in {found.code for found in cal.findings}
    np.testing.assert_array_equal(cal.parameters, mp.calibrate(path).parameters)
    assert (tmp_path / "cal.c").read_text() == mp.export(cal, "c").text
    verified = read_back(tmp_path / "cal_px4.params", cal)
    assert verified.target == "px4"


def test_a_target_that_is_refused_is_named_and_no_other_is_written(path, tmp_path, capsys):
    out = tmp_path / "cal.json"
    asked = ["calibrate", str(path), "--to", "px4", "--to", "c", "-o", str(out)]
    assert main(asked) == 1
    assert out.exists()
    assert not (tmp_path / "cal.c").exists()
    capsys.readouterr()
    assert main([*asked, "--keep-going"]) == 1
    printed, err = capsys.readouterr()
    assert printed == ""
    last = err.splitlines()[-1]
    assert last.startswith("multipos: error: px4 cannot express cross_ay_x")
    assert "grows from" in last
    assert last.endswith("accept it with --allow-lossy.")
    assert mp.load(out).outputs == OUTPUTS
    assert (tmp_path / "cal.c").exists()
    assert not (tmp_path / "cal_px4.params").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--to", "c"], "--to writes files into the folder of CAL.json; name it with -o."),
        (["--to", "c", "-o", "-"], "--to writes files into the folder of CAL.json"),
        (["--to", "bash", "-o", "cal.json"], "imucal, kalibr, inav, got 'bash'"),
        (["--to", "c", "--name", "1x", "-o", "cal.json"], "1x"),
        (["--scheme", "faces", "-o", "cal.json"], "unknown scheme"),
    ],
)
def test_wrong_options(options, message, path, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["calibrate", str(path), *options]) == 2
    assert message in capsys.readouterr().err.splitlines()[-1]
    assert [each.name for each in tmp_path.iterdir()] == ["log.csv"]


def test_an_export_does_not_go_over_a_log(log, tmp_path, capsys):
    path = write_csv(tmp_path / "cal.c", log)
    before = path.read_bytes()
    out = str(tmp_path / "cal.json")
    assert main(["calibrate", str(path), "--to", "c", "-o", out]) == 2
    assert "would write over" in capsys.readouterr().err
    assert path.read_bytes() == before


def test_json_holds_both_and_the_text_too(path, tmp_path, capsys):
    assert main(["calibrate", str(path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["schema"] == "multipos/calibration/1"
    assert len(found["average"]["positions"]) == 14
    assert found["exports"] == []
    assert main(["calibrate", str(path), "-o", "-"]) == 0
    (tmp_path / "cal.json").write_text(capsys.readouterr().out)
    assert mp.load(tmp_path / "cal.json").outputs == OUTPUTS


@pytest.mark.parametrize(("size", "unit"), [(1.0, "g"), (9.80665, "m/s^2"), (1000.0, "mg")])
def test_the_unit_is_what_gravity_shows(size, unit, log):
    scaled = {name: column * (1.0 if name == "time" else size) for name, column in log.items()}
    cal = mp.calibrate(scaled)
    assert cal.model.unit == unit
    assert any(f"the unit is taken to be {unit}" in text for text in texts(cal))
    assert mp.calibrate(scaled, unit="V").model.unit == "V"
    counts = {name: column * (1.0 if name == "time" else 2**14) for name, column in log.items()}
    assert mp.calibrate(counts).model.unit == "reading"


def test_positions_that_cannot_tell_everything_ask_for_a_scheme():
    faces = columns_of(scheme="faces-6")
    with pytest.raises(mp.RankError, match="Name the positions with --scheme") as raised:
        mp.calibrate(faces, model="linear")
    assert raised.value.parameters == 9
    assert mp.calibrate(faces, scheme="faces-6").estimator == "uncertain-orientation"
    assert mp.calibrate(faces, scheme="faces-6", orientation_sd=0).estimator == "linear"
    with pytest.raises(mp.RankError) as raised:
        mp.calibrate(faces, unknown_orientation=True, model="linear")
    assert "say so with --scheme" not in str(raised.value)


def test_what_averaging_says_is_among_the_warnings(log):
    plain = {name: column for name, column in log.items() if name != "time"}
    assert any("the log has no time" in w for w in texts(mp.calibrate(plain)))


def test_the_real_logs_in_one_command(tmp_path, capsys):
    """As they are, without an option but what nobody can guess: how the session was placed."""
    log = shared("mpu9150_imu0.log")
    out = tmp_path / "cal.json"
    assert main(["calibrate", str(log), "--to", "c", "-o", str(out)]) == 0
    cal = mp.load(out)
    np.testing.assert_allclose(
        [cal[name, "1"].value for name in "123"], [0.1024, 0.0966, 0.3435], atol=1.5e-3
    )
    assert 100e-6 < cal.rms < 188e-6  # of rests that are shorter
    assert cal.model.unit == "m/s^2"
    session = shared("ferraris_session.csv")
    assert main(["calibrate", str(session), "--scheme", "faces-6", "-o", str(out)]) == 0
    bias = [mp.load(out)[name, "1"].value for name in ("acc_x", "acc_y", "acc_z")]
    # Of more rests than the six of the published figures, which differ by the placement, 3 mrad.
    np.testing.assert_allclose(bias, [0.551, -0.620, 0.386], atol=0.03)
    capsys.readouterr()


# --- several logs


def one_a_position(log, tmp_path):
    """The rests of a log, each in a file of its own."""
    paths = []
    for rest in mp.average(log).rests:
        part = {name: column[slice(*rest.rows)] for name, column in log.items()}
        paths.append(write_csv(tmp_path / f"pose {rest.position}.csv", part))
    return paths


def test_logs_with_one_rest_are_a_position_each(log, tmp_path):
    paths = one_a_position(log, tmp_path)
    found = mp.average(*paths)
    assert found.readings.positions == tuple(f"pose {i + 1}" for i in range(14))
    expected = mp.average(log).readings.values
    np.testing.assert_allclose(found.readings.values, expected, atol=3e-4)
    assert "time" in found.readings.environment  # they follow each other
    same = mp.average(paths, scheme="faces-corners-14")
    assert [rest.position for rest in same.rests] == [str(i + 1) for i in range(14)]
    assert mp.calibrate(paths).estimator == "unknown-orientation"


def test_files_named_as_the_positions_tell_them(log, tmp_path):
    """Two outputs and files called 1, 2, …: in any order, with one missing."""
    log = {name: log[name] for name in ("time", "ax", "ay")}
    rests = mp.average(log).rests
    paths = [
        write_csv(
            tmp_path / f"{rest.position}.csv",
            {name: column[slice(*rest.rows)] for name, column in log.items()},
        )
        for rest in rests
    ]
    found = mp.average([*paths[:0:-1]], scheme="faces-corners-14")
    assert [rest.position for rest in found.rests] == [str(i) for i in range(14, 1, -1)]
    assert texts(found)[0].startswith("1 of 14 positions of 'faces-corners-14' have no rest: 1.")


def test_logs_with_more_are_joined_and_clocks_that_begin_again_are_not_used(log, tmp_path):
    half = len(log["time"]) // 2
    parts = [{n: c[:half] for n, c in log.items()}, {n: c[half:] for n, c in log.items()}]
    parts[1]["time"] = parts[1]["time"] - parts[1]["time"][0]
    paths = [write_csv(tmp_path / f"{i}.csv", part) for i, part in enumerate(parts)]
    found = mp.average(*paths)
    assert [rest.position for rest in found.rests] == [str(i + 1) for i in range(len(found.rests))]
    assert {rest.log for rest in found.rests} == {"0.csv", "1.csv"}
    assert len(found.rests) in (14, 15)
    assert "the times of the logs do not follow each other; they are not used" in texts(found)
    assert "time" not in found.readings.environment


def test_logs_that_differ_are_refused(log, tmp_path):
    first = write_csv(tmp_path / "a.csv", log)
    metres = {n: c * (1.0 if n == "time" else 9.80665) for n, c in log.items()}
    second = write_csv(tmp_path / "b.csv", metres)
    with pytest.raises(mp.MultiposError, match=r"readings of .*b\.csv are 9\.8\d? times those of"):
        mp.average(first, second)
    assert len(mp.average(first, second, accept_faults=True).rests) == 28
    other = write_csv(
        tmp_path / "c.csv", {f"b{n}" if n != "time" else n: c for n, c in log.items()}
    )
    with pytest.raises(mp.MultiposError, match=r"c\.csv: the outputs are bax, bay, baz, but those"):
        mp.average(first, other)
    with pytest.raises(mp.UsageError, match="--sections are rows of one log, but several"):
        mp.average(first, second, sections={"a": {"start": 0, "end": 9}})


# --- labels


@pytest.mark.parametrize("form", ["text", "numbers", "memory"])
def test_a_label_column_names_the_positions(form, log, tmp_path):
    labels = np.full(len(log["time"]), "", dtype="<U9")
    rests = mp.average(log).rests
    for rest in rests:
        name = rest.position if form == "numbers" else f"face {rest.position}"
        labels[slice(*rest.rows)] = name
    if form == "memory":
        source = {**log, "where": labels}
    else:
        rows = zip(*(log[name].tolist() for name in log), labels.tolist(), strict=True)
        source = tmp_path / "log.csv"
        text = "\n".join(f"{t!r},{x!r},{y!r},{z!r},{label}" for t, x, y, z, label in rows)
        source.write_text(f"time,ax,ay,az,where\n{text}\n")
    found = mp.average(source, label_column="where")
    np.testing.assert_allclose(found.readings.values, mp.average(log).readings.values, rtol=1e-12)
    expected = [str(i + 1) if form == "numbers" else f"face {i + 1}" for i in range(14)]
    assert [rest.position for rest in found.rests] == expected
    assert [rest.rows for rest in found.rests] == [rest.rows for rest in rests]
    assert texts(found) == ()


def test_a_label_that_comes_again_repeats_its_position():
    rng = np.random.default_rng(0)
    labels = ["a"] * 100 + [""] * 50 + ["b"] * 100 + ["a"] * 100
    found = mp.average({"x": rng.normal(size=350), "what": labels}, label_column="what", rate=50.0)
    assert found.readings.positions == ("a", "b", "a")


def test_wrong_labels(log):
    labels = np.full(len(log["time"]), "", dtype="<U9")
    with pytest.raises(mp.MultiposError, match="column 'where' has no label"):
        mp.average({**log, "where": labels}, label_column="where")
    labels[7] = "up"
    with pytest.raises(mp.MultiposError, match="label 'up' of column 'where' is on row 7 alone"):
        mp.average({**log, "where": labels}, label_column="where")
    with pytest.raises(mp.MultiposError, match="no column 'place'"):
        mp.average(log, label_column="place")
    with pytest.raises(mp.UsageError, match="--sections and --label-column both state"):
        mp.average(log, label_column="where", sections={"a": {"start": 0, "end": 9}})


# --- short stretches


def test_short_stretches_are_listed_with_what_takes_them_in():
    """Nine rests of 4 s and five of .9 s: the shortest that was meant is .4 of 4 s."""
    rng = np.random.default_rng(3)
    up = mp.read_scheme("faces-6").up
    parts = []
    for k in range(14):
        still = np.repeat(up[k % 6 : k % 6 + 1], 400 if k < 9 else 90, axis=0)
        parts += [still + 1e-3 * rng.normal(size=still.shape), 0.3 * rng.normal(size=(100, 3))]
    data = dict(zip(OUTPUTS, np.concatenate(parts).T, strict=True))
    found = mp.average(data, rate=100.0)
    assert len(found.rests) == 9
    assert len(found.short) == 5
    (note,) = [text for text in texts(found) if "more stretches" in text]
    assert note.startswith("5 more stretches stood still for less than 1.6 s; --min-duration ")
    assert "and 3 more" in note
    taken = float(note.split("--min-duration ")[1].split()[0])
    assert len(mp.average(data, rate=100.0, min_duration=taken).rests) == 14
    (note,) = [text for text in texts(mp.average(data)) if "more stretches" in text]
    assert "less than 160 samples; --rate HZ --min-duration S takes them in" in note


# --- start-up


def test_no_scipy_on_the_way_from_a_log_to_c(path, tmp_path):
    """Importing `scipy.special` takes longer than all the rest after NumPy."""
    code = (
        "import sys\n"
        "from multipos.cli import main\n"
        f"assert main(['calibrate', {str(path)!r}, '--to', 'c', '-o', 'cal.json']) == 0\n"
        "print([name for name in ('scipy', 'casadi', 'matplotlib') if name in sys.modules])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[]"


def test_every_keyword_of_average_and_fit_is_one_of_calibrate():
    theirs = {**signature(mp.average).parameters, **signature(mp.fit).parameters}
    ours = signature(mp.calibrate).parameters
    assert set(theirs) - {"readings", "angle_zero"} == set(ours)
    for name, parameter in ours.items():
        # a rest of a log is one of many, a row of a table is somebody's
        own = {"exclude": "auto", "model": None}
        assert parameter.default == own.get(name, theirs[name].default)
        if name != "model":  # of too few rests, none is another one
            assert parameter.annotation == theirs[name].annotation
