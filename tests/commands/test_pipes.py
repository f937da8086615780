"""Pipes and stdin: they work wherever files do."""

import io
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from contextlib import chdir
from pathlib import Path

import numpy as np
import pytest
from amounts import slow_where
from cli_bench import MULTIPOS, SIX, run
from numpy.testing import assert_array_equal

import multipos as mp
from multipos.errors import MultiposError
from multipos.files.pipes import Pipe, rereadable
from multipos.files.tables import format_csv, read_table
from multipos.files.whole import write_text


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with an input of every kind, made once."""
    folder = tmp_path_factory.mktemp("made")
    with chdir(folder):
        write_text("six.csv", SIX)
        mp.fit("six.csv").save("cal.json")
        rng = np.random.default_rng(1)
        samples = np.repeat([[1.0, 0, 0], [0, 1.0, 0]], 2000, axis=0)
        samples += 1e-3 * rng.standard_normal(samples.shape)
        columns = [np.arange(4000) / 100, *samples.T]
        log = dict(zip(("time", "ax", "ay", "az"), columns, strict=True))
        write_text("log.csv", format_csv(log))
        np.savez("log.npz", **log)
        np.save("log.npy", np.column_stack(columns))
        rests = '{"a": {"start": 0, "end": 1900}, "b": {"start": 2100, "end": 4000}}'
        write_text("rests.json", rests)
        write_text("budget.toml", "[level]\nu_deg = 0.01\n")
        write_text("lab.toml", "[laboratory]\nname = 'Bench'\n")
        mp.check(mp.load("cal.json"), "six.csv").save("check.json")
        mp.regress("log.csv", response="ax", variables="ay").save("reg.json")
    return folder


@pytest.fixture
def here(made, tmp_path, monkeypatch):
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))  # what is kept there must go
    return tmp_path


def feed(path, content):
    """Make a pipe and write into it once somebody reads."""
    os.mkfifo(path)
    thread = threading.Thread(target=Path(path).write_bytes, args=[content], daemon=True)
    thread.start()
    return thread


# Every input of every command; # stands before the one that comes through the pipe.
INPUTS = [
    "fit #six.csv",
    "fit six.csv --scheme #six.csv",
    "fit six.csv --budget #budget.toml",
    "average #log.csv --sections rests.json",
    "average log.csv --sections #rests.json",
    "average #log.npz --sections rests.json",
    "average #log.npy --sections rests.json --columns time,ax,ay,az",
    "apply #cal.json log.csv",
    "apply cal.json #log.csv",
    "apply cal.json #log.csv --json",
    "apply #reg.json log.csv",
    "check #cal.json six.csv",
    "check #reg.json log.csv",
    "check cal.json #six.csv",
    "check cal.json six.csv --scheme #six.csv",
    "compare cal.json #cal.json",
    "regress #log.csv --response ax --variables ay",
    "regress #log.csv --response ax --variables ay -o out.svg",
    "stability #log.csv --calibration cal.json --json",
    "stability log.csv --calibration #cal.json",
    "simulate #cal.json --scheme faces-6 --seed 1",
    "simulate cal.json --scheme #six.csv --seed 1",
    "report #cal.json -o out.txt",
    "report cal.json --lab #lab.toml -o out.txt",
    "report cal.json --check #check.json -o out.txt",
    "export #cal.json --to c -o out.c",
    "schemes #six.csv --json",
    "design --positions 7 --include #six.csv",
    "design --positions 8 --include #cal.json",
]


@pytest.mark.parametrize(
    "command", slow_where(lambda command: command.startswith("stability"), INPUTS)
)
def test_a_pipe_gives_what_the_file_gives(command, here, capsys, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    expected = run(capsys, *command.replace("#", "").split())
    assert expected[0] == 0, expected[2]
    figure = Path("out.svg").read_bytes() if "out.svg" in command else b""
    arguments = command.split()
    place = next(i for i, word in enumerate(arguments) if word.startswith("#"))
    name = arguments[place][1:]
    arguments[place] = "pipe"
    thread = feed("pipe", Path(name).read_bytes())
    before = set(here.iterdir())
    found = run(capsys, *arguments)
    thread.join()
    assert set(here.iterdir()) == before  # and no temporary file
    for got, want in zip(found, expected, strict=True):
        assert str(got).replace("pipe", name) == str(want)
    if figure:
        assert Path("out.svg").read_bytes() == figure


def test_stdin_is_read_by_every_name(here, capsys):
    """More than the 64 KiB that a pipe holds, so that nothing can be sought."""
    assert Path("log.csv").stat().st_size > 1 << 16
    expected = run(capsys, "apply", "cal.json", "log.csv")[1].encode()
    assert expected.count(b"\n") == 4001
    for command in (
        "cat log.csv | multipos apply cal.json /dev/stdin",
        "cat log.csv | multipos apply cal.json -",
        "multipos apply cal.json - < log.csv",
        "multipos apply <(cat cal.json) <(cat log.csv)",
    ):
        done = subprocess.run(
            ["bash", "-c", command.replace("multipos", MULTIPOS)], check=True, capture_output=True
        )
        assert done.stdout == expected, command
    done = subprocess.run(
        [MULTIPOS, "apply", "cal.json", "/dev/stdin"],
        capture_output=True,
        text=True,
        input="",
        check=False,
    )
    assert done.returncode == 1
    assert (
        done.stderr
        == "multipos: error: /dev/stdin: the file is empty; a log needs rows of samples.\n"
    )


def test_what_is_said_of_stdin(here, capsys, monkeypatch):
    monkeypatch.setattr(
        sys, "stdin", io.TextIOWrapper(io.BytesIO(SIX.replace("0.0064", "").encode()))
    )
    status, out, err = run(capsys, "fit", "-")
    assert (status, out) == (1, "")
    assert "stdin: row 3 (line 4), column 'ay': the cell is empty" in err
    monkeypatch.setattr(sys, "stdin", None)
    assert "stdin: cannot read the readings: it is closed" in run(capsys, "fit", "-")[2]


@pytest.mark.parametrize(
    ("first", "second"), [("-", "-"), ("-", "/dev/stdin"), ("/dev/stdin", "-")]
)
def test_one_pipe_cannot_be_two_inputs(first, second, here):
    done = subprocess.run(
        [MULTIPOS, "apply", first, second], input="x", capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert f"multipos: error: {second} is given for two inputs" in done.stderr


# --- from Python


def test_functions_take_pipes(here):
    thread = feed("pipe", Path("log.csv").read_bytes())
    found = mp.average("pipe", sections="rests.json")
    thread.join()
    assert_array_equal(
        found.readings.values, mp.average("log.csv", sections="rests.json").readings.values
    )
    assert found.readings.source == "pipe"


def test_a_pipe_can_be_read_again_until_it_is_let_go(here):
    thread = feed("pipe", SIX.encode())
    pipe = rereadable("pipe")
    thread.join(0.01)
    assert rereadable(pipe) is pipe
    assert read_table(pipe).columns == read_table(pipe).columns == read_table("six.csv").columns
    assert str(pipe) == "pipe"
    kept = Path(pipe)
    pipe.close()
    assert not kept.exists()
    with pytest.raises(MultiposError, match="the pipe has been read already"):
        read_table(pipe)
    again = Pipe("six.csv")
    kept = Path(again)
    assert kept.read_text() == SIX
    del again
    assert not kept.exists()
