"""Guided capture: rests as they happen, poses, what is met, and what is kept."""

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import log_bench
import numpy as np
import pytest
from amounts import rest_slow
from numpy.testing import assert_allclose

import multipos as mp
from multipos.capturing import next_pose as next_pose_module
from multipos.capturing.arrivals import _whole_lines
from multipos.capturing.evaluation import SessionPlan
from multipos.capturing.keeping import Kept
from multipos.capturing.live_rests import LiveRests
from multipos.capturing.live_rows import LiveRows
from multipos.capturing.next_pose import _state
from multipos.capturing.poses import (
    Frame,
    find_turn,
    refuse_repeat,
    refuse_rest,
    refuse_unit,
)
from multipos.capturing.read_ahead import read_ahead
from multipos.capturing.running import _goes_on, make_plan, make_reading, run_session
from multipos.capturing.screen import (
    _SHOWN,
    _listed,
    obey,
    picture_of,
)
from multipos.capturing.session import Session
from multipos.capturing.sources import open_source
from multipos.capturing.state import state_of
from multipos.capturing.targets import read_targets, spread_targets
from multipos.cli import main
from multipos.logs.opening import open_log
from multipos.logs.rests import Rest
from multipos.logs.samples import Timing, rows_in_log
from multipos.positions.attitudes import pose_words

RATE = 100.0


def log_of(path, scheme="all-26", **options):
    return log_bench.write_csv(path, log_bench.columns_of(scheme=scheme, **options))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("capture")


@pytest.fixture(scope="module")
def log(folder):
    return log_of(folder / "log.csv", seed=3)


def lines_of(capsys):
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def started(path, *, scheme=None, positions=None, target=(), threshold=None, told=None):
    """A session that has seen all of a log and is not finished."""
    plan = make_plan(target, positions, scheme, {})
    session = Session(plan, make_reading(None, None, None, None, None, threshold), told)
    for arrival in open_source(f"replay:{path}:0").arrivals(None):
        if arrival.log is not None:
            session.begin(arrival.log, arrival.columns)
            continue
        for first in range(0, arrival.columns.shape[1], 50):
            if session.is_enough:
                return session
            session.feed(arrival.columns[:, first : first + 50])
    return session


@pytest.mark.parametrize("at_once", [1, 7, 100, 5000])
@pytest.mark.parametrize("threshold", [None, 2.5e-3])
def test_rests_row_by_row_are_those_of_average(folder, at_once, threshold):
    path = log_of(folder / "short.csv", "faces-6", seed=5)
    source = open_log(path)
    (piece,) = source.read((), source.numeric)
    table = np.array([piece.table.columns[name] for name in source.numeric])
    rows = LiveRows(source, table[:, :40], None, Timing())
    rests = LiveRests(rows, None, threshold)
    for first in range(0, table.shape[1], at_once):
        rests.feed(rows.take(table[:, first : first + at_once])[0])
    rests.finish()
    whole = mp.average(path, threshold=rests.threshold, rate=rows.rate)
    assert [still.rows for still in rests.settled] == [rest.rows for rest in whole.rests]
    for still, rest in zip(rests.settled, whole.rests, strict=True):
        for name in ("mean", "sd", "u"):  # sums in another order: a few roundings
            assert_allclose(getattr(still.found, name), getattr(rest.found, name), rtol=1e-9)


def test_rows_that_are_no_longer_needed_are_let_go(folder):
    path = log_of(folder / "short.csv", "faces-6", seed=5)
    session = started(path, threshold=3e-3)
    kept = sum(piece.shape[1] for _, piece in session.rows.pieces())
    assert kept < 0.5 * session.rows.rows


@pytest.mark.parametrize(
    ("asked", "stated", "unit"),
    [("V", " [mg]", "V"), (None, " [mg]", "mg"), ("V", "", "V"), (None, "", "reading")],
)
def test_readings_are_in_the_unit_asked_for_or_that_of_the_log(asked, stated, unit, tmp_path):
    head = np.array([np.arange(40) / 100.0, *np.tile([[0.1], [0.2], [0.9]], 40)])
    names = ("time", *(f"{name}{stated}" for name in ("ax", "ay", "az")))
    log = log_bench.write_csv(tmp_path / "log.csv", dict(zip(names, head, strict=True)))
    fitting = {} if asked is None else {"unit": asked}
    session = Session(make_plan((), None, None, fitting), make_reading(*[None] * 6))
    session.begin(open_log(log), head)
    assert session.model.unit == unit


def test_an_output_of_texts_is_refused_by_name(tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("time,ax,ay,az\n" + "".join(f"{k / 100},0.1,0.2,up\n" for k in range(40)))
    head = np.array([np.arange(40) / 100.0, *np.tile([[0.1], [0.2]], 40)])
    with pytest.raises(mp.MultiposError, match=r"log\.csv: column 'az' holds no numbers\."):
        LiveRows(open_log(log), head, ("ax", "az"), Timing())


def test_rows_of_the_log_are_counted_with_those_left_out_and_let_go(folder):
    path = log_of(folder / "short.csv", "faces-6", seed=5)
    source = open_log(path)
    (piece,) = source.read((), source.numeric)
    table = np.array([piece.table.columns[name] for name in source.numeric])
    bad = np.random.default_rng(4).choice(table.shape[1], 200, replace=False)
    table[1, bad] = np.nan
    bad = np.sort(bad).tolist()
    rows = LiveRows(source, table[:, :40], None, Timing())
    for first in range(0, table.shape[1], 37):
        rows.take(table[:, first : first + 37])
        rows.forget(rows.rows - 100)
        late = Rest(rows.rows - 90, rows.rows - 3)
        seen = [row for row in bad if row < first + 37]
        assert rows.in_log(late) == rows_in_log(late, seen)
    assert rows.bad == 200


def test_one_line_a_rest_with_what_follows_from_it(log, capsys):
    assert main(["capture", f"replay:{log}:0", "--headless"]) == 0
    lines = lines_of(capsys)
    last = lines[-1]
    whole = mp.average(log, threshold=last["threshold"], rate=last["rate"])
    assert [(line["start"], line["end"]) for line in lines] == [rest.rows for rest in whole.rests]
    assert [line["position"] for line in lines] == [rest.position for rest in whole.rests]
    truth = mp.read_scheme("all-26").up
    directions = np.array([line["direction"] for line in lines])
    assert np.abs(directions - truth).max() < 0.03  # bias and cross-axis of the sensor
    assert np.abs(directions[-10:] - truth[-10:]).max() < 0.02  # orientation is up to the gauge
    assert [len(line["parameters"]) for line in lines][:8] == [0] * 8
    assert all(line["next"]["gain"] > 0.0 for line in lines[:-1])
    assert {p["name"] for p in last["parameters"]} == set(mp.calibrate(log).names)


def test_a_line_comes_at_the_first_rest_without_a_threshold(folder):
    path = log_of(folder / "short.csv", "faces-6", seed=5)
    heard = []

    def told(session):
        pose = session.poses[-1]
        heard.append((pose.position, pose.still.rows, session.threshold, session.rows.rows))

    session = started(path, told=told)
    first, second = session.poses[0].still, session.poses[1].still
    position, rows, threshold, when = heard[0]
    assert (position, threshold) == ("1", None)
    assert rows[1] < when < second.rows[0] + 0.5 * (second.rows[1] - second.rows[0])
    assert abs(rows[0] - first.rows[0]) + abs(rows[1] - first.rows[1]) < 0.2 * (rows[1] - rows[0])
    # each pose once, and again only where the threshold moved its rest; the last word holds
    assert len(heard) == len(set(heard)) <= len(session.poses) + 2
    last = {position: rows for position, rows, *_ in heard}
    assert last == {pose.position: pose.still.rows for pose in session.poses}


def test_it_ends_when_the_target_is_met_and_confirmed(log, tmp_path, capsys):
    command = ["capture", f"replay:{log}:0", "--headless", "--target", "bias=0.002"]
    assert main([*command, "-o", str(tmp_path / "run.csv"), "--to", "c"]) == 0
    lines = lines_of(capsys)
    # nine parameters and six degrees of freedom, and one pose more that confirms
    assert len(lines) == 16
    met = [p["met"] for p in lines[-1]["parameters"] if p["name"].startswith("bias")]
    assert met == [True] * 3
    assert [p["met"] for p in lines[-1]["parameters"] if p["target"] is None] == [None] * 6
    assert not any(p["met"] for p in lines[-2]["parameters"])
    cal = mp.load(tmp_path / "run.json")
    for entry in lines[-1]["parameters"]:
        assert entry["value"] == cal[entry["name"]].value
        assert entry["U"] == cal[entry["name"]].U
    again = mp.fit(mp.read_readings(tmp_path / "run.csv"), unknown_orientation=True)
    assert_allclose(again.parameters, cal.parameters, rtol=1e-9)
    assert (tmp_path / "run.c").read_text().count("multipos_compensate")
    assert "<html" in (tmp_path / "run.html").read_text()


def test_positions_end_it_and_python_does_the_same(log):
    seen = []
    found = mp.capture(f"replay:{log}:0", positions=16, told=seen.append)
    assert len(seen) == len(found.averages.rests) == 16
    assert found.state["finished"]
    fixed = {"threshold": seen[-1]["threshold"], "rate": seen[-1]["rate"]}
    expected = mp.calibrate(log, only=[str(i + 1) for i in range(16)], **fixed)
    assert_allclose(found.calibration.parameters, expected.parameters, rtol=1e-6)


def test_gain_is_what_the_next_pose_brings(log):
    """The fall of log det C is ln(1 + z'Cz/s²), z the slopes of |f| by the parameters."""
    session = started(log, positions=17)
    cal = session.evaluation.calibration

    def size(parameters, reading):
        bias, matrix = np.zeros(3), np.zeros((3, 3))
        for value, (output, term) in zip(parameters, cal.model.keys, strict=True):
            i = cal.outputs.index(output)
            if str(term) == "1":
                bias[i] = value
            else:
                matrix[i, "xyz".index(str(term))] = value
        return float(np.linalg.norm(np.linalg.solve(matrix, reading - bias)))

    def slopes(reading):
        p, step = cal.parameters, 1e-6
        ends = [(size(p + step * e, reading), size(p - step * e, reading)) for e in np.eye(9)]
        return np.array([(high - low) / (2.0 * step) for high, low in ends])

    Z = np.array([slopes(reading) for reading in cal.readings.values])
    z = slopes(cal.predict(session.next.direction[None])[0])
    expected = np.log1p(z @ np.linalg.solve(Z.T @ Z, z))
    assert_allclose(session.next.gain, expected, rtol=0.03)  # scale factors differ by 1 %


def test_refusals_name_their_reason(folder, capsys):
    columns = log_bench.columns_of(scheme="faces-6+edges-12", seed=8)
    twice = {name: np.concatenate([c, c[:600]]) for name, c in columns.items()}
    twice["time"] = np.arange(len(twice["time"])) / RATE
    path = log_bench.write_csv(folder / "twice.csv", twice)
    assert main(["capture", f"replay:{path}:0", "--headless"]) == 0
    lines = lines_of(capsys)
    refused = [line for line in lines if not line["accepted"]]
    assert [line["reason"].split(",")[0] for line in refused] == ["repeats pose 1"]
    assert refused[0]["residual"] is None


def test_saturated_moving_and_other_units_are_refused(folder):
    columns = log_bench.columns_of(scheme="faces-6+corners-8", seed=9, sample_sd=3e-3)
    columns = {name: column.copy() for name, column in columns.items()}
    rest, whole = 400, 600  # rows of a rest, and of it with the turn that follows
    columns["ax"] = np.minimum(columns["ax"], np.median(columns["ax"][:rest]))
    turned = slice(8 * whole, 8 * whole + rest)
    columns["ay"][turned] += np.linspace(0.0, 0.1, rest)
    scaled = slice(10 * whole - 150, 10 * whole + rest + 150)
    for name in ("ax", "ay", "az"):
        columns[name][scaled] *= 9.80665
    path = log_bench.write_csv(folder / "bad.csv", columns)
    taken = state_of(started(path, threshold=0.05))["taken"]
    reasons = {
        round(pose["start"] / whole): pose["reason"] for pose in taken if not pose["accepted"]
    }
    told = {key: text.split(":")[0] for key, text in reasons.items()}
    assert told == {0: "saturated", 8: "moving", 10: "another unit"}
    assert "gravity 9.9" in reasons[10]  # 9.8, and what the clipping takes off


@pytest.mark.slow
def test_undo_and_redo_leave_no_trace(log):
    session = started(log, positions=18)
    before = state_of(session)
    assert session.undo() == "18"
    shorter = state_of(session)
    assert shorter["taken"][-1]["reason"] == "taken back"
    assert shorter["parameters"] != before["parameters"]
    alone = state_of(started(log, positions=17))
    assert shorter["parameters"] == alone["parameters"]
    assert session.redo("18")
    assert state_of(session)["parameters"] == before["parameters"]
    assert session.redo("3")  # it is to be taken again, and that is where it leads now
    again = state_of(session)
    assert again["next"]["label"] == "3"
    assert_allclose(again["next"]["direction"], before["taken"][2]["direction"], atol=0.01)
    assert not again["taken"][2]["accepted"]
    assert not session.redo("99")


def test_a_target_is_met_only_with_a_pose_that_confirms(log):
    # eq. (1) of capturing.evaluation
    session = started(log, positions=15, target=["scale=0.01"])
    assert not any(p["met"] for p in state_of(session)["parameters"])
    assert not session.evaluation.enough


def test_targets_by_kind_and_by_name():
    model = mp.fit(mp.Readings(mp.read_scheme("all-26").up, up=mp.read_scheme("all-26").up)).model
    targets = read_targets(["bias=1e-3", "bias_ay=2e-3"])
    found = spread_targets(targets, model)
    assert found == {"bias_ax": 1e-3, "bias_ay": 2e-3, "bias_az": 1e-3}
    for wrong in (["bias"], ["bias=x"], ["bias=0"], ["bias=-1"]):
        with pytest.raises(mp.UsageError, match="--target"):
            read_targets(wrong)
    with pytest.raises(mp.UsageError, match="did you mean 'bias_ay'"):
        spread_targets({"bias_ayy": 1.0}, model)


def test_it_leads_through_a_scheme_and_sees_where_the_sensor_is(folder, capsys):
    path = log_of(folder / "faces.csv", "faces-6", seed=2)
    order = [line.split(",")[0] for line in path.read_text().splitlines()[:1]]
    assert order == ["time"]
    command = ["capture", f"replay:{path}:0", "--headless", "--scheme", "faces-6"]
    assert main(command) == 0
    lines = lines_of(capsys)
    accepted = [line["position"] for line in lines if line["accepted"]]
    assert sorted(accepted) == ["1", "2", "3", "4", "5", "6"]
    fixed = {"threshold": lines[-1]["threshold"], "rate": lines[-1]["rate"]}
    known = mp.calibrate(path, scheme="faces-6", **fixed)
    assert_allclose([p["value"] for p in lines[-1]["parameters"]], known.parameters, rtol=1e-6)
    assert lines[-1]["next"] is None


def test_a_pose_that_is_nowhere_in_the_scheme_is_refused(folder, capsys):
    path = log_of(folder / "edges.csv", "faces-6+edges-12", seed=2)
    assert main(["capture", f"replay:{path}:0", "--headless", "--scheme", "faces-6"]) == 0
    lines = lines_of(capsys)
    assert len([line for line in lines if line["accepted"]]) == 6
    session = started(folder / "edges.csv", scheme="corners-8")
    reasons = [pose.reason for pose in session.poses if not pose.accepted]
    assert any("at none of the scheme" in reason for reason in reasons)


def test_what_was_taken_back_stays_so_when_it_goes_on(log, tmp_path, capsys):
    """A session of two halves is the session of both, without what was taken back."""
    rows = log.read_text().splitlines(keepends=True)
    first, second = tmp_path / "first.csv", tmp_path / "second.csv"
    first.write_text("".join(rows[:8000]))
    second.write_text("".join([rows[0], *rows[8000:]]))
    out = tmp_path / "run.csv"
    session_file = tmp_path / "run_session.json"
    with stdin_of(first):
        assert main(["capture", "-", "--headless", "-o", str(out)]) == 1  # half the sphere
    one = lines_of(capsys)
    kept = json.loads(session_file.read_text())
    kept["taken_back"] = {str(one[1]["start"]): "taken back"}
    session_file.write_text(json.dumps(kept))
    with stdin_of(second):
        assert main(["capture", "-", "--headless", "--resume", "-o", str(out)]) == 0
    assert (tmp_path / "run_log.csv").read_text() == log.read_text()
    both = lines_of(capsys)
    assert [line["accepted"] for line in both[:3]] == [True, False, True]
    whole = mp.average(log, threshold=kept["threshold"], rate=kept["rate"])
    assert [(line["start"], line["end"]) for line in both] == [rest.rows for rest in whole.rests]
    assert len(mp.read_readings(out).values) == 25


@pytest.mark.slow
def test_it_goes_on_after_a_row_half_written_and_without_a_header(log, tmp_path, capsys):
    """A device says the names of its columns when it starts, and goes on without us."""
    rows = log.read_text().splitlines(keepends=True)
    first, second = tmp_path / "first.csv", tmp_path / "second.csv"
    first.write_text("".join(rows[:8000]))
    second.write_text("".join(rows[8000:]))
    kept, command = tmp_path / "run_log.csv", ["capture", "-", "--headless"]
    with stdin_of(first):
        assert main([*command, "-o", str(tmp_path / "run.csv")]) == 1  # half the sphere
    with kept.open("a") as stream:
        stream.write(rows[8000][:-9])  # as many cells as a row
    with stdin_of(second):
        assert main([*command, "--resume", "-o", str(tmp_path / "run.csv")]) == 0
    assert "is cut off and left out" in capsys.readouterr().err
    assert kept.read_text() == log.read_text()
    assert len(mp.read_readings(tmp_path / "run.csv").values) == 26
    second.write_text("".join(f"{row[:-1]},1\n" for row in rows[8000:]))
    with stdin_of(second):
        assert main([*command, "--resume", "-o", str(tmp_path / "run.csv")]) == 1
    assert "the columns are 1, 2, 3, 4, 5, but the session began" in capsys.readouterr().err


def test_rows_of_earlier_sessions_are_never_written_over(log, tmp_path, capsys):
    rows = log.read_text().splitlines(keepends=True)
    (tmp_path / "few.csv").write_text("".join(rows[:1200]))
    for _ in range(3):
        with stdin_of(tmp_path / "few.csv"):
            assert main(["capture", "-", "--headless", "-o", str(tmp_path / "run.csv")]) == 1
    kept = {path.name: path.read_text() for path in tmp_path.glob("run_log*.csv")}
    assert set(kept) == {"run_log.csv", "run_log.old1.csv", "run_log.old2.csv"}
    assert set(kept.values()) == {"".join(rows[:1200])}


@contextlib.contextmanager
def stdin_of(path):
    before = sys.stdin
    with path.open() as stream:
        sys.stdin = stream
        try:
            yield
        finally:
            sys.stdin = before


@pytest.mark.parametrize(
    "model",
    rest_slow(["1 + x + y + z + temperature", "own-quadratic", "each = b + s*own + c*own^3"]),
)
def test_other_models_come_after_the_linear_one(folder, model, capsys):
    columns = log_bench.columns_of(scheme="fibonacci-16", seed=3)
    time_ = columns["time"]
    warm = {**columns, "temperature": 20.0 + 1e-3 * time_ + np.sin(time_ / 10.0)}
    path = log_bench.write_csv(folder / "warm.csv", warm)
    command = ["capture", f"replay:{path}:0", "--headless", "--model", model]
    assert main(command) == 0
    lines = lines_of(capsys)
    assert len(lines) == 16
    fixed = {"threshold": lines[-1]["threshold"], "rate": lines[-1]["rate"]}
    assert {p["name"] for p in lines[-1]["parameters"]} == set(
        mp.calibrate(path, model=model, **fixed).names
    )


def test_garbage_is_counted_and_kept_as_comments(log, tmp_path, capsys):
    rows = log.read_text().splitlines(keepends=True)
    dirty = [*rows[:3000], "0.1,garb\x00age\n", "\xff\n", "1,2\n", *rows[3000:8000]]
    path = tmp_path / "dirty.csv"
    path.write_text("".join(dirty), encoding="utf-8")
    out = tmp_path / "run.csv"
    with stdin_of(path):
        assert main(["capture", "-", "--headless", "-o", str(out), "--json"]) == 1
    capsys.readouterr()
    found = json.loads((tmp_path / "run_session.json").read_text())
    clean = mp.average(tmp_path / "run_log.csv", threshold=found["threshold"])
    (tmp_path / "clean.csv").write_text("".join(rows[:8000]))
    expected = mp.average(tmp_path / "clean.csv", threshold=found["threshold"])
    assert [r.rows for r in clean.rests] == [r.rows for r in expected.rests]
    assert (tmp_path / "run_log.csv").read_text().count("\n# ") == 3


def test_quotes_and_endless_lines_are_one_bad_row_each(log, tmp_path, capsys):
    rows = log.read_text().splitlines(keepends=True)
    bad = ['0.1,"1,2,3\n', '"\n', '0.1,1,2,3"\n', "9" * 200_000 + ",1,2,3\n", "x" * 70_000 + "\n"]
    path, out = tmp_path / "dirty.csv", tmp_path / "run.csv"
    path.write_text("".join([*rows[:3000], *bad, *rows[3000:8000]]))
    with stdin_of(path):
        assert main(["capture", "-", "--headless", "-o", str(out)]) == 1
    (tmp_path / "clean.csv").write_text("".join(rows[:8000]))
    threshold = json.loads((tmp_path / "run_session.json").read_text())["threshold"]
    expected = mp.average(tmp_path / "clean.csv", threshold=threshold)
    assert len(out.read_text().splitlines()) == 1 + len(expected.rests)
    kept = (tmp_path / "run_log.csv").read_text().splitlines()
    assert sum(not line.startswith("#") for line in kept) == 8000


@pytest.mark.parametrize(
    "error", [ValueError("a fault"), mp.MultiposError("no disk"), SystemExit()]
)
def test_what_was_taken_is_written_whatever_ends_the_run(log, tmp_path, monkeypatch, error):
    real = Session.feed

    def fails(self, columns, **state):
        if len(self.poses) == 7:
            raise error
        return real(self, columns, **state)

    monkeypatch.setattr(Session, "feed", fails)
    out = tmp_path / "run.csv"
    command = ["capture", f"replay:{log}:0", "--headless", "-o", str(out)]
    if isinstance(error, SystemExit):
        with pytest.raises(SystemExit):
            main(command)
    else:
        assert main(command) == 1
    taken = out.read_text().splitlines()[1:]
    assert len(taken) >= 7
    assert not (tmp_path / "run_session.lock").exists()


def test_what_stands_beside_the_readings_is_no_input(log, tmp_path, capsys):
    for name, option in (("run.json", "--stability"), ("run.html", "--budget")):
        (tmp_path / name).write_text("{}")
        target = ["--to", "kalibr"] if option == "--stability" else []
        command = ["capture", f"replay:{log}:0", "--headless", "-o", str(tmp_path / "run.csv")]
        assert main([*command, *target, option, str(tmp_path / name)]) == 2
        assert f"would write over {tmp_path / name}" in capsys.readouterr().err
        assert (tmp_path / name).read_text() == "{}"


def test_one_session_at_a_time_keeps_its_files_at_a_place(log, tmp_path, capsys):
    lock, command = tmp_path / "run_session.lock", ["capture", f"replay:{log}:0", "--headless"]
    command += ["--positions", "2", "-o", str(tmp_path / "run.csv")]
    lock.write_text(f"{os.getpid()}\n")
    assert main(command) == 1
    assert f"process {os.getpid()} keeps a session there" in capsys.readouterr().err
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    lock.write_text(f"{ended.pid}\n")
    assert main(command) == 1  # of two poses
    assert f"process {ended.pid} has ended without its session" in capsys.readouterr().err
    assert not lock.exists()


def test_a_place_that_cannot_be_written_is_refused_before_the_first_pose(log, tmp_path, capsys):
    place = tmp_path / "missing" / "run.csv"
    assert main(["capture", f"replay:{log}:0", "--headless", "-o", str(place)]) == 1
    assert capsys.readouterr().out == ""


def test_a_log_that_grows_is_read_as_it_grows(log, tmp_path):
    rows = log.read_text().splitlines(keepends=True)
    path = tmp_path / "growing.csv"
    path.write_text("".join(rows[:2000]))
    plan, seen = make_plan((), 5, None, {}), []
    session = Session(plan, make_reading(None, None, None, None, None, 3e-3), seen.append)

    def write():
        for i in range(2000, 8000, 501):
            time.sleep(0.01)
            with path.open("a") as stream:
                stream.write("".join(rows[i : i + 501]))
        for _ in range(3000):  # a busy machine reads late
            if len(seen) == 5:
                break
            time.sleep(0.1)
        session.asked_to_finish = True

    writer = threading.Thread(target=write)
    writer.start()
    run_session(session, open_source(str(path)), kept=Kept())
    writer.join()
    assert len(seen) == 5
    assert session.finished


def test_rows_by_udp(log, tmp_path):
    import socket

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    rows = log.read_text().splitlines()
    session = Session(make_plan((), 3, None, {}), make_reading(None, None, None, None, None, 3e-3))
    stop = threading.Event()

    def send():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for row in rows:
                if stop.is_set():
                    return
                sender.sendto(row.encode(), ("127.0.0.1", port))
                time.sleep(2e-5)
        session.asked_to_finish = True

    sender = threading.Timer(0.2, send)
    sender.start()
    run_session(session, open_source(f"udp:{port}"))
    stop.set()
    sender.join()
    assert len(session.accepted) == 3


def test_a_speed_beyond_all_numbers_is_as_fast_as_it_goes(log):
    fast, fastest = (
        [a.columns for a in open_source(f"replay:{log}:{speed}").arrivals(None)]
        for speed in ("0", "1e308")
    )
    np.testing.assert_array_equal(np.hstack(fastest), np.hstack(fast))


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("udp:x", "no port"),
        ("serial:", "no port"),
        ("replay:log.csv:-1", "SPEED"),
        ("", "empty"),
    ],
)
def test_what_is_no_source_is_said(source, said):
    with pytest.raises(mp.UsageError, match=said):
        open_source(source)


def test_mistakes_end_in_one_line(log, tmp_path, capsys):
    wordy = tmp_path / "wordy.csv"
    wordy.write_text("place,note\n" + "here,still\n" * 50)
    for command, status in (
        (["capture", "replay:nothing.csv"], 1),
        (["capture", f"replay:{wordy}:0", "--headless"], 1),
        (["capture", f"replay:{log}:0", "--positions", "0"], 2),
        (["capture", f"replay:{log}:0", "--headless", "--target", "nonsense=1"], 2),
        (["capture", f"replay:{log}:0", "--headless", "-o", str(log)], 2),
        (["capture", f"replay:{log}:0", "--headless", "--resume"], 2),
        (["capture", f"replay:{log}:0", "--headless", "--outputs", "ax,ay"], 2),
        (["capture", f"replay:{log}:0", "--headless", "--threshold", "1e-9"], 1),
    ):
        assert main(command) == status, command
        last = capsys.readouterr().err.strip().splitlines()[-1:]
        assert last[0].startswith("multipos: error: ")
        assert "report it" not in last[0]  # as a fault of the program's own is


def test_five_degrees_are_a_repeat():
    taken = np.array([[0.0, 0.0, 1.0]])
    for degrees, repeats in ((4.9, True), (5.1, False)):
        angle = np.radians(degrees)
        said = refuse_repeat(np.array([np.sin(angle), 0.0, np.cos(angle)]), taken, ["7"])
        assert (said is not None) == repeats
        assert not repeats or "pose 7, 4.9 degrees" in said


def test_a_rest_is_refused_by_what_it_read():
    """Drifts count from five of their u and the threshold on; one output alone may be stuck."""

    def refused(sd=(1e-3, 1e-3), drift=(0.0, 0.0), u=1e-3, saturated=()):
        found = SimpleNamespace(
            n=400,
            sd=np.array(sd),
            low=np.array([0.25, 0.0]),
            drift=np.array(drift),
            drift_u=np.array([u, u]),
        )
        return refuse_rest(SimpleNamespace(found=found, saturated=saturated), ("ax", "ay"), 0.02)

    assert refused() is None
    assert refused(sd=(0.0, 1e-3)).startswith("saturated or stuck: ")
    assert "0.25" in refused(sd=(0.0, 1e-3))
    assert refused(sd=(0.0, 0.0)) is None  # readings without noise
    assert refused(saturated=("'ay' stands at its end",)).startswith("saturated: 'ay'")
    assert refused(drift=(0.0, -0.021)).startswith("moving: 'ay' drifted by -0.021 ")
    assert refused(drift=(0.0, -0.019)) is None  # below the threshold
    assert refused(drift=(0.021, 0.0), u=0.0041) is not None
    assert refused(drift=(0.021, 0.0), u=0.0043) is None  # less than five of its u


def test_a_pose_in_words():
    assert pose_words(np.array([0.0, 0.0, -1.0])) == "−z straight up"
    lean = np.radians(35.0)
    words = pose_words(np.array([np.sin(lean), 0.0, np.cos(lean)]))
    assert words == "+z up, leaning 35° so that +x rises"
    assert "+x and −y rise" in pose_words(np.array([0.5, -0.5, np.sqrt(0.5)]))


def test_the_text_screen_shows_the_state(log):
    session = started(log, positions=17, target=["bias=0.002"])
    state = state_of(session)
    text = "\n".join(picture_of(state))
    assert f"next: {state['next']['words']}" in text
    rows = [line.split() for line in text.splitlines()]
    for entry in state["parameters"]:
        (row,) = (cells for cells in rows if cells[:1] == [entry["name"]])
        assert float(row[2]) == pytest.approx(entry["U"], rel=0.06)
        assert (row[-1] == "met") == bool(entry["met"])
    obey(session, "u\n")
    assert state_of(session)["taken"][-1]["reason"] == "taken back"
    obey(session, f"r {state['taken'][-1]['position']}\n")
    assert state_of(session)["parameters"] == state["parameters"]
    obey(session, "f\n")
    assert session.asked_to_finish


def test_a_board_that_is_turned_or_mirrored_is_known_by_three_poses_in_four():
    mirrored = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    asked = mp.read_scheme("fibonacci-24").up[:8]
    shown = asked @ mirrored.T
    shown[:2] *= -1.0
    assert_allclose(find_turn(asked, shown), mirrored)
    shown[2] *= -1.0
    assert find_turn(asked, shown) is None
    assert_allclose(find_turn(asked, asked), np.eye(3))


@pytest.mark.parametrize(("size", "said"), [(9.80665, "9.81 times"), (1.02, None), (0.0, None)])
def test_a_rest_in_another_unit_is_refused(size, said):
    frame, means = Frame(np.zeros(3), 1.0, (0, 1, 2), 1.0), 2.0 * np.eye(3)
    still = SimpleNamespace(found=SimpleNamespace(mean=np.array([0.0, 0.0, 2.0 * size])))
    refused = refuse_unit(still, frame, means)
    assert refused is None if said is None else said in refused
    assert refuse_unit(still, frame, means[:1]) is None


def test_lines_are_whole_and_a_silent_source_is_heard():
    assert _whole_lines(b"1,2", b"3\r\n4,5\r6") == ("1,23\n4,5\n", b"6")
    assert _whole_lines(b"", b"4,5\r") == ("", b"4,5\r")  # a line feed may follow
    assert _whole_lines(b"1,2", None) == ("", b"")
    silent, heard = threading.Event(), []

    def chunks():
        heard.append(silent.wait(300))
        yield from (b"a", b"b", None, b"c")

    found = []
    for chunk in read_ahead(chunks()):
        if chunk == b"":
            silent.set()
        found.append("|" if chunk is None else chunk.decode())
    assert heard == [True]
    assert "".join(found) == "ab|c"


def test_where_a_rest_is_in_a_scheme():
    """Within ten degrees of the position that is asked for, or of another that is left."""
    scheme = mp.Scheme("mine", np.eye(3), np.full((3, 3, 3), np.nan), ("a", "b", "c"))

    def placed(degrees, *, asked="a", done=()):
        angle = np.radians(degrees)  # from a towards b
        session = SimpleNamespace(
            plan=SimpleNamespace(scheme=scheme),
            next=SimpleNamespace(label=asked) if asked else None,
            direction=lambda mean: np.array([np.cos(angle), np.sin(angle), 0.0]),
            accepted=[SimpleNamespace(position=label) for label in done],
        )
        return Session._place(session, SimpleNamespace(found=SimpleNamespace(mean=None)))

    assert placed(9.9) == ("a", None)
    assert placed(80.1) == ("b", None)
    assert placed(20.0) == (
        "",
        "20 degrees from position a, and at none of the scheme: the nearest, a, is 20 degrees away",
    )
    assert placed(89.0, done=("b",)) == ("", "repeats position b of the scheme; a is next")
    assert placed(0.0, asked="") == ("", "every position of the scheme has been taken")


def test_what_an_earlier_session_fixed_and_what_was_asked_for():
    kept = Kept(earlier={"threshold": 3e-3, "rate_by_arrival": 50.0})
    found = kept.as_before(make_reading(None, None, None, None, None, None))
    assert (found.threshold, found.timing.rate) == (3e-3, 50.0)
    found = kept.as_before(make_reading(None, None, None, 80.0, None, 1e-2))
    assert (found.threshold, found.timing.rate) == (1e-2, 80.0)
    found = Kept().as_before(make_reading(None, "t", None, None, None, 1e-2))
    assert (found.threshold, found.timing) == (1e-2, Timing("t"))
    plan = SessionPlan({"convention": "gravity"}, {}, None, None, None)
    assert plan.convention == "gravity"
    assert SessionPlan({}, {}, None, None, None).convention == "specific-force"


def test_what_is_known_before_a_fit_of_the_same_terms(monkeypatch):
    """A prior of .3 g on each parameter, until a fit of these parameters is there."""
    monkeypatch.setattr(next_pose_module, "_known_state", lambda calibration, taken: "known")
    up = mp.read_scheme("fibonacci-24").up
    cal = mp.fit(mp.Readings(up + 1e-3 * np.random.default_rng(2).normal(size=up.shape), up=up))
    other = mp.fit(cal.readings, model="own-quadratic")
    none = np.empty((0, 3))
    assert _state(cal.model, cal, none, unknown_orientation=False) == "known"
    for before in (None, other):
        state = _state(cal.model, before, none, unknown_orientation=False)
        assert_allclose(state.present, np.eye(12) / 0.09, rtol=1e-12)
        assert (state.scale.tolist(), state.fixed.tolist(), state.dof) == (
            [1] * 12,
            [0] * 12,
            np.inf,
        )
    assert_allclose(
        _state(cal.model, None, none, unknown_orientation=True).present, np.eye(9) / 0.09
    )


def test_a_device_that_has_started_before_says_its_columns_no_more():
    """Without names columns are the same where as many stand and the numbers among them too."""

    def log(columns, numeric, headless=True):
        return SimpleNamespace(columns=columns, numeric=numeric, headless=headless)

    named = log(("t", "ax", "at"), ("t", "ax"), headless=False)
    assert _goes_on(named, log(("1", "2", "3"), ("1", "2")))
    assert not _goes_on(named, log(("1", "2", "3"), ("1", "3")))
    assert not _goes_on(named, log(("1", "2"), ("1", "2")))
    assert not _goes_on(named, log(("1", "2", "3"), ("1", "2"), headless=False))


def test_of_many_directions_the_first_are_listed_and_the_others_counted():
    some = [(0.6, -0.8, 0.0)] * _SHOWN
    said = ", ".join(["(0.6, -0.8, 0.0)"] * _SHOWN)
    assert _listed(some) == said
    assert _listed([*some, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]) == f"{said} + 2"
