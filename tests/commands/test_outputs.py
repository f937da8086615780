"""What `-o` writes and what it refuses: inputs, endings, pairs of files, stdout, signals."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import chdir
from importlib.util import find_spec
from pathlib import Path

import browser
import numpy as np
import pytest
from amounts import few_and_many
from cli_bench import MULTIPOS, SIX, make_once, run, snapshot

import multipos as mp
from multipos import cli
from multipos.errors import MultiposError
from multipos.files.tables import format_csv
from multipos.files.whole import write_text, written

LAB = """
report = {number = "1", authorised_by = "N."}
laboratory = {name = "Bench", address = "Street 1", country = "DE"}
customer = {name = "C.", address = "Street 2"}
item = {description = "triad", serial = "1"}
measurement = {performed = 2026-03-01}
"""
SECTIONS = '{"a": {"start": 0, "end": 90}, "b": {"start": 100, "end": 190}}'


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with an input of every kind, made once."""
    folder = tmp_path_factory.mktemp("made")
    with chdir(folder):
        write_text("six.csv", SIX)
        cal = mp.fit("six.csv")
        cal.save("cal.json")
        up = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        rng = np.random.default_rng(1)
        samples = np.repeat(up, 100, axis=0) + 1e-3 * rng.standard_normal((200, 3))
        time = np.arange(200) / 100
        log = dict(zip(("time", "ax", "ay", "az"), [time, *samples.T], strict=True))
        write_text("log.csv", format_csv(log))
        write_text("sections.json", SECTIONS)
        session = {"rate": 20.0, "rest": 3.0, "turn": 1.0, "sample_sd": 1e-3, "seed": 1}
        write_text("session.csv", format_csv(mp.simulate_log(cal, "faces-6", **session)))
        write_text("budget.toml", "[level]\nu_deg = 0.01\n")
        write_text("lab.toml", LAB)
        mp.check(cal, "six.csv").save("check.json")
        mp.export(cal, "c").save("imu.c")
        angles = [(30 * k, np.cos(np.radians(30 * k)) + 1e-4 * np.sin(40 * k)) for k in range(12)]
        rows = "".join(f"z,{angle},{value:.6f}\n" for angle, value in angles)
        write_text("tumble.csv", f"roll_axis,angle_deg,ax\n{rows}")
    return folder


@pytest.fixture
def here(made, tmp_path, monkeypatch):
    """A folder of its own with these."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


# A command line of each command, and the inputs that -o must not name.
COMMANDS = {
    "fit": (
        ["six.csv", "--scheme", "six.csv", "--budget", "budget.toml"],
        ["six.csv", "budget.toml"],
    ),
    "average": (
        ["log.csv", "--sections", "sections.json", "--scheme", "six.csv"],
        ["log.csv", "sections.json", "six.csv"],
    ),
    "calibrate": (
        ["log.csv", "session.csv", "--scheme", "six.csv", "--budget", "budget.toml"],
        ["log.csv", "session.csv", "six.csv", "budget.toml"],
    ),
    "apply": (["cal.json", "log.csv"], ["cal.json", "log.csv"]),
    "check": (["cal.json", "six.csv", "--scheme", "faces-6+six.csv"], ["cal.json", "six.csv"]),
    "compare": (["cal.json", "check.json"], ["cal.json", "check.json"]),
    "regress": (["log.csv", "--response", "ax", "--variables", "ay"], ["log.csv"]),
    "stability": (["log.csv", "--calibration", "cal.json"], ["log.csv", "cal.json"]),
    "fleet": (
        ["log.csv", "--unit-column", "t", "--scheme", "six.csv", "--limits", "tumble.csv"],
        ["log.csv", "six.csv", "tumble.csv"],
    ),
    "tumble": (["tumble.csv", "--scheme", "six.csv"], ["tumble.csv", "six.csv"]),
    "simulate": (["cal.json", "--scheme", "six.csv"], ["cal.json", "six.csv"]),
    "report": (
        ["cal.json", "--lab", "lab.toml", "--check", "check.json"],
        ["cal.json", "lab.toml", "check.json"],
    ),
    "export": (["cal.json", "--to", "c"], ["cal.json"]),
    "schemes": (["six.csv"], ["six.csv"]),
    "design": (
        [
            "--positions",
            "8",
            "--candidates",
            "six.csv",
            "--include",
            "log.csv",
            "--region",
            "tumble.csv",
        ],
        ["six.csv", "log.csv", "tumble.csv"],
    ),
}


def test_every_command_says_what_it_reads():
    assert {*COMMANDS, "demo", "capture", "page"} == set(cli.COMMANDS)  # these read no file


@pytest.mark.parametrize("link", ["itself", "symbolic", "hard"])
@pytest.mark.parametrize(
    ("command", "given"),
    [(command, name) for command, (_, names) in COMMANDS.items() for name in names],
)
def test_an_output_that_is_an_input_is_refused(command, given, link, here, capsys):
    output = given
    if link != "itself":
        output = "other" + Path(given).suffix
        (here / output).symlink_to(given) if link == "symbolic" else os.link(given, output)
    before = snapshot(here)
    status, out, err = run(capsys, command, *COMMANDS[command][0], "-o", output)
    assert (status, out) == (2, "")
    assert f"multipos: error: -o would write over {output}" in err
    assert snapshot(here) == before


def test_the_self_test_of_a_c_file_is_an_output_too(here, capsys):
    (here / "cal.json").rename("cal_test.c")
    before = snapshot(here)
    status, out, err = run(capsys, "export", "cal_test.c", "--to", "c", "-o", "cal.c")
    assert (status, out) == (2, "")
    assert "write over cal_test.c, which this command reads" in err
    assert snapshot(here) == before


def test_stdin_from_a_file_is_an_input(here):
    done = subprocess.run(
        f"{MULTIPOS} average - -o log.csv < log.csv",
        shell=True,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert "-o would write over log.csv" in done.stderr
    assert len((here / "log.csv").read_text().splitlines()) == 201


WRITTEN = {
    "fit": {".json", ".txt", ".svg", ".png", ".pdf"},
    "average": {".csv", ".json", ".txt"},
    "calibrate": {".json", ".txt"},
    "apply": {".csv", ".json", ".parquet", ".txt"},
    "check": {".json", ".csv", ".txt", ".svg", ".png", ".pdf"},
    "compare": {".json", ".txt", ".svg", ".png", ".pdf"},
    "regress": {".json", ".txt", ".svg", ".png", ".pdf"},
    "stability": {".json", ".csv", ".txt", ".svg", ".png", ".pdf"},
    "tumble": {".json", ".txt", ".svg", ".png", ".pdf"},
    "simulate": {".csv", ".json", ".txt"},
    "report": {".html", ".pdf", ".md", ".txt", ".xml"},
    "export": {".json"},
    "schemes": {".json", ".txt", ".csv", ".svg", ".png", ".pdf"},
    "design": {".csv", ".json", ".txt", ".svg", ".png", ".pdf"},
    "demo": set(),
    "fleet": set(),
}
RUNS = {
    **{command: [command, *options] for command, (options, _) in COMMANDS.items()},
    "average": ["average", "log.csv", "--sections", "sections.json"],
    "calibrate": ["calibrate", "session.csv", "--scheme", "faces-6"],
    "check": ["check", "cal.json", "six.csv"],
    "compare": ["compare", "cal.json", "cal.json"],
    "report": ["report", "cal.json", "--lab", "lab.toml"],
    "tumble": ["tumble", "tumble.csv"],
    "design": ["design", "--positions", "6", "--candidates", "all-26"],
    "schemes": ["schemes", "faces-6"],
    "demo": ["demo"],
}
BEGINNINGS = {
    ".xml": b"<?xml",
    ".svg": b"<svg",
    ".png": b"\x89PNG",
    ".pdf": b"%PDF",
    ".html": b"<!DOCTYPE html>",
    ".parquet": b"PAR1",
}


LONG_TO_MAKE = {
    "design": "multipos.designs.designing.design",
    "schemes": "multipos.commands.schemes.schemes",
    "stability": "multipos.commands.stability.stability",
}


@pytest.mark.parametrize("left_out", few_and_many({".png", ".pdf"}, set()))
@pytest.mark.parametrize("command", WRITTEN)
def test_known_endings_are_written_as_what_they_are_or_refused(
    command, left_out, here, capsys, monkeypatch
):
    if command in LONG_TO_MAKE:
        make_once(monkeypatch, LONG_TO_MAKE[command])
    if command == "schemes":
        left_out = set()  # one of them writes what any figure is written as
    known = {".json", ".csv", ".svg", ".png", ".pdf", ".html", ".md", ".xml", ".xlsx", ".parquet"}
    said = " ".join(cli.command_parser(command).format_help().split())
    for ending in sorted((known | {".txt"}) - (left_out & WRITTEN[command])):
        before = snapshot(here)
        status, out, err = run(capsys, *RUNS[command], "-o", f"out{ending.upper()}")
        printed = find_spec("weasyprint") is not None or browser.find() is not None
        if (command, ending) == ("report", ".pdf") and not printed:
            assert (status, out) == (1, "")
            assert "pip install 'multipos[pdf]'" in err
            assert snapshot(here) == before
            continue
        if (command, ending) == ("apply", ".parquet") and find_spec("pyarrow") is None:
            assert (status, out) == (1, "")
            assert "a Parquet file, which pyarrow writes; install it with pip install" in err
            assert snapshot(here) == before
            continue
        if ending in WRITTEN[command]:
            assert status == 0, err
            assert ending in said
            raw = Path(f"out{ending.upper()}").read_bytes()
            assert raw.startswith(BEGINNINGS.get(ending, b""))
            if ending == ".json":
                assert isinstance(json.loads(raw), dict)
        elif ending in known:
            assert (status, out) == (2, "")
            assert f"this command does not write {ending} files" in err
            assert snapshot(here) == before


def test_any_other_ending_is_the_commands_own_format(here, capsys):
    for name in ("own", "own.dat", "own.json.old"):
        assert run(capsys, "fit", "six.csv", "-o", name)[0] == 0
        assert mp.load(name).outputs == ("ax", "ay", "az")
    assert run(capsys, "report", "cal.json", "-o", "own")[0] == 0
    assert Path("own").read_text().startswith("<!DOCTYPE html>")
    _, printed, _ = run(capsys, "fit", "six.csv", "-o", "own.txt")
    whole = Path("own.txt").read_text()
    assert whole.startswith(printed)
    assert "Residuals" in whole
    assert "Residuals" not in printed
    _, printed, _ = run(capsys, "check", "cal.json", "six.csv", "--json", "-o", "own")
    assert Path("own").read_text() == printed  # what is printed, and nothing else
    assert isinstance(json.loads(printed), dict)


@pytest.mark.parametrize(
    "ending", ["svg", *(pytest.param(each, marks=pytest.mark.slow) for each in ("png", "pdf"))]
)
def test_the_same_figure_gives_the_same_bytes(ending, here, capsys):
    for name in "ab":
        assert run(capsys, "tumble", "tumble.csv", "-o", f"{name}.{ending}")[0] == 0
    assert Path(f"a.{ending}").read_bytes() == Path(f"b.{ending}").read_bytes()


# --- stdout


@pytest.mark.parametrize(
    "arguments",
    [
        ["fit", "six.csv"],
        ["average", "log.csv", "--sections", "sections.json"],
        ["calibrate", "session.csv", "--scheme", "faces-6"],
        ["simulate", "cal.json", "--scheme", "faces-6"],
        ["apply", "cal.json", "log.csv"],
        ["export", "cal.json", "--to", "c"],
        ["report", "cal.json"],
        ["schemes", "faces-6"],
    ],
    ids=lambda arguments: arguments[0],
)
def test_a_dash_is_stdout_and_gets_the_file_alone(arguments, here, capsys, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    if arguments[0] == "simulate":
        arguments = [*arguments, "--seed", "1"]
    assert run(capsys, *arguments, "-o", "out")[0] == 0
    status, out, _ = run(capsys, *arguments, "-o", "-")
    assert status == 0
    assert out == Path("out").read_text()
    assert not Path("-").exists()


def test_a_dash_and_json_are_one_thing_or_refused(here, capsys):
    status, out, _ = run(
        capsys, "average", "log.csv", "--sections", "sections.json", "--json", "-o", "-"
    )
    assert status == 0
    assert len(json.loads(out)["positions"]) == 2
    status, out, err = run(capsys, "report", "cal.json", "--json", "-o", "-")
    assert (status, out) == (2, "")
    assert "would both go to stdout" in err
    assert "a folder cannot go to stdout" in run(capsys, "demo", "-o", "-")[2]
    assert "-o needs a name" in run(capsys, "fit", "six.csv", "-o", "")[2]


def shell(command):
    return subprocess.run(
        command.replace("multipos", MULTIPOS, 1),
        shell=True,
        text=True,
        capture_output=True,
        check=False,
    )


@pytest.mark.parametrize("name", ["/dev/stdout", "both.json"])
def test_an_output_that_is_where_stdout_goes_is_written_once(name, here):
    done = shell(f"multipos fit six.csv -o {name} > both.json")
    assert done.returncode == 0
    assert done.stderr.startswith("multipos: ax, ay, az calibrated from 6 positions")
    assert json.loads(Path("both.json").read_text())["outputs"] == ["ax", "ay", "az"]


def test_no_file_where_stdout_cannot_be_written_and_nothing_printed_where_a_device_cannot(here):
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full on this system")
    done = shell("multipos fit six.csv -o new.json > /dev/full")
    assert done.returncode == 1
    said = done.stderr
    assert said == "multipos: error: cannot write to stdout: No space left on device.\n"
    assert not Path("new.json").exists()
    done = shell("multipos fit six.csv -o /dev/full")
    assert (done.returncode, done.stdout) == (1, "")
    assert "/dev/full: cannot write: No space left" in done.stderr
    assert "cannot write to stdout" in shell("multipos fit --help > /dev/full").stderr


def test_an_export_in_json_is_one_file_with_both_texts(here, capsys):
    assert run(capsys, "export", "cal.json", "--to", "c", "-o", "new.c")[0] == 0
    command = ["export", "cal.json", "--to", "c", "-o"]
    assert run(capsys, *command, "new.json")[1] == "Written to new.json.\n"
    assert run(capsys, *command, "-")[2] == "multipos: Written to stdout.\n"
    content = json.loads(Path("new.json").read_text())
    assert content["text"] == Path("new.c").read_text()
    assert content["test"] == Path("new_test.c").read_text()
    assert json.loads(run(capsys, *command, "-", "--json")[1]) == content
    assert not Path("new_test.json").exists()


# --- whole or not at all


def test_the_two_files_of_c_appear_together_or_not_at_all(here, capsys):
    (here / "new_test.c").mkdir()
    status, out, err = run(capsys, "export", "cal.json", "--to", "c", "-o", "new.c")
    assert (status, out) == (1, "")
    assert "new_test.c: cannot write: it is a folder" in err
    assert not Path("new.c").exists()
    assert run(capsys, "export", "cal.json", "--to", "c", "-o", ".")[::2] == (
        1,
        "multipos: error: .: cannot write: it is a folder; check the folder and permissions.\n",
    )


@pytest.mark.parametrize("existing", [False, True])
def test_several_files_are_put_back_where_the_last_cannot_take_its_place(
    existing, tmp_path, monkeypatch
):
    first, second = tmp_path / "a", tmp_path / "b"
    if existing:
        first.write_text("old")
    before = snapshot(tmp_path)
    replace = Path.replace

    def failing(self, target):
        if target == second:
            raise OSError(1, "not permitted")
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", failing)
    with (
        pytest.raises(MultiposError, match="b: cannot write: not permitted"),
        written({first: "new", second: "new"}),
    ):
        pass
    assert snapshot(tmp_path) == before


def test_nothing_appears_where_the_block_fails(tmp_path):
    with pytest.raises(ZeroDivisionError), written({tmp_path / "a": "new"}):
        _ = 1 // 0
    assert list(tmp_path.iterdir()) == []


def test_the_longest_name_can_be_written(tmp_path):
    path = tmp_path / ("x" * 255)
    write_text(path, "all of it")
    assert path.read_text() == "all of it"
    with pytest.raises(MultiposError, match="File name too long"):
        write_text(tmp_path / ("x" * 256), "")


def test_a_name_that_is_too_long_is_refused_with_a_self_test_as_without(here, capsys):
    for arguments in (["export", "cal.json", "--to", "c"], ["fit", "six.csv"], ["page"]):
        status, out, error = run(capsys, *arguments, "-o", "x" * 256)
        assert (status, out) == (1, "")
        assert error.startswith("multipos: error: x")
        assert "cannot write: File name too long" in error


@pytest.mark.parametrize(
    "before", [["fit"], ["average"], ["apply", "cal.json"], ["average", "six.csv"]]
)
def test_an_input_of_too_long_a_name_is_refused_by_name(before, here, capsys):
    status, out, error = run(capsys, *before, "x" * 256)
    assert (status, out) == (1, "")
    assert error.startswith(f"multipos: error: {'x' * 256}: cannot read")


def test_links_that_lead_nowhere(here, capsys):
    (here / "loop").symlink_to("loop")
    for arguments in (["six.csv", "-o", "loop"], ["loop"]):
        status, out, err = run(capsys, "fit", *arguments)
        assert (status, out) == (1, "")
        assert "Too many levels of symbolic links" in err
    assert Path("loop").is_symlink()
    (here / "dangling").symlink_to("target")
    assert run(capsys, "fit", "six.csv", "-o", "dangling")[0] == 0
    assert Path("target").is_file()
    assert "it is a folder" in run(capsys, "fit", "six.csv", "-o", "new/")[2]


def test_file_names_that_are_no_text(here, capsys):
    name = os.fsdecode(b"caf\xe9")
    (here / f"{name}.csv").write_text(SIX)
    command = ["fit", f"{name}.csv", "--unit", "g", "--json", "-o", f"{name}.json"]
    status, out, err = run(capsys, *command)
    assert (status, err) == (0, "")
    assert json.loads(out)["input"]["file"] == r"caf\udce9.csv"
    Path(f"{name}.json").read_text(encoding="utf-8")  # strict: any program can read it
    for ending in ("html", "md", "txt"):
        assert run(capsys, "report", f"{name}.json", "-o", f"{name}.{ending}")[0] == 0
    for target in ("c", "ros-imu-calib"):
        command = ["export", f"{name}.json", "--to", target, "-o", f"{name}.{target}"]
        status, out, _ = run(capsys, *command)
        assert status == 0
        assert rf"Written to caf\udce9.{target}" in out
    assert r"no\udce9.csv: no such file" in shell("multipos fit $(printf 'no\\351.csv')").stderr


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_signal_leaves_no_file(name, here):
    """A pipe keeps the command waiting with its temporary files; it dies by the signal."""
    folder = here / "out"
    folder.mkdir()
    os.mkfifo(here / "pipe")
    environment = os.environ | {"TMPDIR": str(folder)}
    with subprocess.Popen(
        [MULTIPOS, "fit", "pipe", "-o", "out/cal.json"],
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
        # under nohup it would be born deaf to one of them
        preexec_fn=lambda: signal.signal(getattr(signal, name), signal.SIG_DFL),
    ) as child:
        with (here / "pipe").open("w") as pipe:
            pipe.write(SIX)
            pipe.flush()
            while not list(folder.iterdir()):
                time.sleep(0.01)
            while child.poll() is None:  # a signal right before a read waits for the next
                child.send_signal(getattr(signal, name))
                time.sleep(0.1)
        assert child.returncode == -getattr(signal, name)
        assert child.stderr.read() == ""
    assert list(folder.iterdir()) == []


def test_a_signal_while_a_file_is_written_leaves_the_old_one(tmp_path):
    code = (
        "import os, signal, sys\n"
        "from multipos import cli\n"
        "from multipos.files.whole import write_text\n"
        "def pieces():\n"
        "    yield 'half'\n"
        "    assert len(os.listdir('.')) == 2\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "    yield 'the rest'\n"
        "cli._run = lambda argv: write_text('out', pieces())\n"
        "sys.exit(cli.main(['fit']))\n"
    )
    (tmp_path / "out").write_text("old")
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=False)
    assert done.returncode == -signal.SIGTERM
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"out": "old"}


def test_a_signal_that_is_ignored_stays_ignored(tmp_path):
    code = (
        "import os, signal, sys\n"
        "from multipos import cli\n"
        "signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"  # as nohup does
        "cli._run = lambda argv: os.kill(os.getpid(), signal.SIGHUP)\n"
        "sys.exit(cli.main(['fit']))\n"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
