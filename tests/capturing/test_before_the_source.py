"""What `capture` refuses, it refuses before its source is opened; what ends it loses no reading."""

import json
import sys
from contextlib import nullcontext
from importlib import import_module

import log_bench
import numpy as np
import pytest

import multipos as mp
from multipos.capturing.arrivals import Arrival, RowSource
from multipos.capturing.keeping import Kept, keep
from multipos.capturing.rehearsal import rehearse
from multipos.capturing.running import make_plan, make_reading, run_session, teller
from multipos.capturing.session import Session
from multipos.capturing.sources import open_source
from multipos.cli import main
from multipos.logs.opening import open_log

BOARDS = {
    "plain": np.eye(3),
    "turned": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "mirrored": np.diag([1.0, -1.0, 1.0]),
}


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    columns = log_bench.columns_of(scheme="faces-6+corners-8", seed=3)
    return log_bench.write_csv(tmp_path_factory.mktemp("before") / "log14.csv", columns)


@pytest.mark.parametrize(
    ("options", "status", "said"),
    [
        ("--budget nope.toml", 1, "nope.toml: no such file"),
        ("--closed-form", 1, "no orientation"),
        ("--height 100", 2, "--height needs --latitude"),
        ("--model nope", 2, "unknown model 'nope'"),
        ("--robust x", 2, "unknown loss 'x'"),
        ("--nominal 0,0", 2, "--nominal"),
        ("--gravity-u .1", 2, "--gravity-u needs --gravity"),
        ("--inputs x", 2, "--inputs"),
        ("--pool --unknown-orientation", 2, "contradict each other"),
        ("--scheme corners-8 --closed-form", 1, ""),
        ("--scheme faces-6 --model own-cubic", 1, "can be separated"),
        ("--target slope=1", 2, "--target 'slope' is no parameter"),
        ("--outputs ax,ay", 2, "with 2 outputs a direction does not show"),
        ("-o run.csv --to c --fixed --float", 2, "--fixed"),
        ("-o run.csv --stability nope.json --to kalibr", 1, "nope.json: no such file"),
        ("-o run.csv --to px4", 1, "accept it with --allow-lossy"),
        ("-o run.csv --to px4 --allow-lossy --instance 9", 2, "--instance takes"),
    ],
)
def test_nothing_is_opened_or_written(options, status, said, tmp_path, monkeypatch, capsys):
    """The source is not there: whoever opened it would say so."""
    monkeypatch.chdir(tmp_path)
    assert main(["capture", "serial:/dev/none", "--headless", *options.split()]) == status
    printed = capsys.readouterr()
    assert said in printed.err.splitlines()[-1]
    assert "cannot open" not in printed.err
    assert "pyserial" not in printed.err
    assert printed.out == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("scheme", "fitting"),
    [
        (None, {"model": "own-cubic"}),
        (None, {"model": "1 + own + own^2 + own^3 + own^4 + own^5"}),  # more than 14 show
        (None, {"model": "each = b + s*own/(1 + k*own^2)"}),
        (None, {"model": "1 + x + y + z + temperature"}),
        (None, {"field": "magnetic"}),
        (None, {"unit": "uT"}),
        (None, {"range": [0.0, 4095.0]}),
        (None, {"axes": "y,x,-z", "robust": "huber"}),
        ("faces-6", {"closed_form": True, "convention": "gravity"}),
        ("all-26", {"drift": True, "orientation_sd": "auto"}),
    ],
)
def test_what_can_be_fitted_later_is_not_refused(scheme, fitting):
    rehearse(make_plan((), None, scheme, fitting), None)
    if fitting == {"range": [0.0, 4095.0]}:
        with pytest.raises(mp.UsageError, match="--range takes"):
            rehearse(make_plan((), None, scheme, {"range": [10.0, 10.0]}), None)


def test_a_target_may_be_of_outputs_that_have_no_name_yet():
    rehearse(make_plan(["bias_acc_x=1"], None, None, {}), None)
    with pytest.raises(mp.UsageError, match="bias_acc_x"):
        rehearse(make_plan(["bias_acc_x=1"], None, None, {}), ("ax", "ay", "az"))


def piped(text, tmp_path, *options):
    path = tmp_path / "piped.csv"
    path.write_text(text)
    before = sys.stdin
    with path.open() as stream:
        sys.stdin = stream
        try:
            return main(["capture", "-", "--headless", *options])
        finally:
            sys.stdin = before


def test_of_an_empty_source_nothing_is_written_and_nothing_moved(log, tmp_path, capsys):
    out = tmp_path / "run.csv"
    assert piped("", tmp_path, "-o", str(out)) == 1
    assert "nothing came" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["piped.csv"]
    few = "".join(log.read_text().splitlines(keepends=True)[:1300])
    assert piped(few, tmp_path, "-o", str(out)) == 1
    names = {path.name for path in tmp_path.iterdir()}
    assert piped("", tmp_path, "-o", str(out)) == 1
    assert {path.name for path in tmp_path.iterdir()} == names


def test_a_session_without_a_calibration_keeps_its_readings(log, tmp_path, capsys):
    out = tmp_path / "run.csv"
    command = ["capture", f"replay:{log}:0", "--headless", "--positions", "5"]
    assert main([*command, "-o", str(out)]) == 1
    said = capsys.readouterr().err.splitlines()
    assert said[-1].startswith("multipos: error: no calibration: 5 positions give 5 equations")
    assert len(said) == 2  # the reason once, and how many rests there are
    assert len(mp.read_readings(out).values) == 5
    assert not (tmp_path / "run.json").exists()
    assert main([*command, "-o", "-"]) == 1
    assert capsys.readouterr().out.count("\n") >= 6  # lines of rests, and the readings


def test_a_report_that_cannot_be_made_costs_no_reading(log, tmp_path, monkeypatch, capsys):
    command = ["capture", f"replay:{log}:0", "--headless", "--to", "c"]
    monkeypatch.setattr("multipos.commands.capture.html_report", lambda _: 1 / 0)
    assert main([*command, "-o", str(tmp_path / "run.csv")]) == 1
    assert "ZeroDivisionError" in capsys.readouterr().err
    assert len(mp.read_readings(tmp_path / "run.csv").values) == 14
    assert mp.load(tmp_path / "run.json").names

    monkeypatch.setattr("multipos.commands.capture.html_report", lambda _: import_module("none"))
    assert main([*command, "-o", str(tmp_path / "two.csv")]) == 0
    assert "no report is written: it needs none" in capsys.readouterr().err
    assert {path.suffix for path in tmp_path.glob("two*")} == {".csv", ".json", ".c"}


def test_an_export_refused_at_the_end_costs_no_reading(log, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("multipos.commands.capture.rehearse", lambda *_: None)
    command = ["capture", f"replay:{log}:0", "--headless", "--to", "px4", "--instance", "9"]
    assert main([*command, "--allow-lossy", "-o", str(tmp_path / "run.csv")]) == 1
    assert "--instance takes" in capsys.readouterr().err
    assert len(mp.read_readings(tmp_path / "run.csv").values) == 14
    assert (tmp_path / "run.html").exists()


@pytest.mark.parametrize(
    ("first", "second", "same"),
    [
        ("-", "-", True),
        ("serial:/dev/ttyUSB0:9600", "serial:/dev/ttyUSB0:115200", True),
        ("serial:/dev/ttyUSB0", "serial:/dev/ttyUSB1", False),
        ("udp:5555", "udp:127.0.0.1:5555", True),
        ("udp:5555", "udp:5556", False),
        ("udp:5555", "-", False),
        ("log.csv", "./log.csv", True),
        ("replay:log.csv:0", "replay:log.csv", True),
        ("replay:log.csv:0", "replay:other.csv", False),
        ("replay:log.csv:0", "log.csv", False),
    ],
)
def test_a_session_goes_on_with_its_own_source_alone(first, second, same, tmp_path):
    session = tmp_path / "run_session.json"
    (tmp_path / "run_log.csv").write_text("time,ax,ay,az\n")
    kept = {"schema": "multipos/capture/1", "opened": open_source(first).opened}
    session.write_text(json.dumps({**kept, "threshold": 0.1, "taken_back": {}}))
    how = nullcontext() if same else pytest.raises(mp.UsageError, match="give the same source")
    with how, keep(open_source(second), tmp_path / "run.csv", print, resume=True):
        pass


def test_a_session_file_says_which_source_it_is_of(log, tmp_path, capsys):
    out = tmp_path / "run.csv"
    assert main(["capture", f"replay:{log}:0", "--headless", "-o", str(out)]) == 0
    kept = json.loads((tmp_path / "run_session.json").read_text())
    assert kept["opened"] == f"replay:{log.resolve()}"
    capsys.readouterr()
    assert piped(log.read_text(), tmp_path, "--resume", "-o", str(out)) == 2
    assert "run_session.json is of replay:" in capsys.readouterr().err
    assert len(mp.read_readings(out).values) == 14


def test_a_port_that_is_pulled_out_is_said_once(log):
    whole = open_log(log)
    (piece,) = whole.read((), whole.numeric)
    table = np.array([piece.table.columns[name] for name in whole.numeric])

    def arrivals(columns):
        yield Arrival(whole, table[:, :40], [])
        for connected in (True, False, False, False, True, False, True):
            yield Arrival(None, table[:, :0], [], connected)

    lines = []
    session = Session(
        make_plan((), None, None, {}), make_reading(*[None] * 6), teller(lines.append)
    )
    with pytest.raises(mp.MultiposError):  # not a row
        run_session(session, RowSource("port", "port", None, arrivals), None, Kept())
    assert lines == [{"connected": state} for state in (False, True, False, True)]


def as_stream(board, seed):
    """A log in counts whose first rest has z up, and whose user does not look at the guide."""
    rng = np.random.default_rng(seed)
    columns = log_bench.columns_of(scheme="faces-6+corners-8", seed=seed)
    f = np.column_stack([columns[name] for name in ("ax", "ay", "az")])[:, [1, 2, 0]]  # z first
    f = f @ BOARDS[board].T + 0.03 * rng.standard_normal(3)
    outputs = dict(zip(("ax", "ay", "az"), np.rint(16384.0 * f.T), strict=True))
    return {"time": columns["time"], **outputs}


@pytest.mark.parametrize("board", BOARDS)
def test_who_does_not_follow_is_shown_as_he_stands(board, tmp_path, capsys):
    path = log_bench.write_csv(tmp_path / "stream.csv", as_stream(board, seed=4))
    assert piped(path.read_text(), tmp_path) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert np.abs(np.array(lines[0]["direction"]) - [0.0, 0.0, 1.0]).max() < 0.06
    assert [line["position"] for line in lines] == [str(k + 1) for k in range(14)]
    assert all(line["accepted"] for line in lines)
    assert len(lines[-1]["parameters"]) == 9
    assert all(line["next"]["direction"][0] < 0.98 for line in lines[:2])  # that was asked for


def test_a_target_that_is_met_ends_it(tmp_path, capsys):
    path = log_bench.write_csv(
        tmp_path / "log26.csv", log_bench.columns_of(scheme="all-26", seed=3)
    )
    out = tmp_path / "run.csv"
    options = ("--target", "bias=0.002", "-o", str(out))
    assert piped(path.read_text(), tmp_path, *options) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["position"] for line in lines] == [str(k + 1) for k in range(16)]
    assert mp.read_readings(out).labels == tuple(str(k + 1) for k in range(16))
