"""Every command of the page "From your log" works on a file of its kind."""

import re
import shlex
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from log_bench import columns_of
from log_files import (
    OUTPUTS,
    archive,
    csv_of,
    write_actigraph,
    write_bag,
    write_flight,
    write_geneactiv,
    write_phyphox,
    write_workbook,
    write_xsens,
)
from numpy.testing import assert_allclose

import multipos as mp
from multipos.cli import main

PAGE = Path(__file__).resolve().parents[2] / "docs" / "howto" / "from-your-log.md"
ROW = re.compile(r"^\|[^|]+\| `(multipos calibrate [^`]+)` \|$", re.MULTILINE)
COMMANDS = ROW.findall(PAGE.read_text(encoding="utf-8"))
G = 9.80665
NEEDED = {
    ".ulg": "pyulog",
    ".bin": "pymavlink",
    ".bag": "rosbags",
    ".mcap": "rosbags",
    ".xlsx": "openpyxl",
    ".parquet": "pyarrow",
}


@pytest.fixture(scope="module")
def log():
    found = columns_of(scheme="faces-corners-14")
    return {name: np.round(c * (1.0 if name == "time" else G), 5) for name, c in found.items()}


@pytest.fixture(scope="module")
def truth(log):
    return mp.calibrate(log)


def force(log):
    return np.column_stack([log[name] for name in OUTPUTS])


def write_serial(path, log):
    """What an Arduino prints: milliseconds since it was switched on, and counts; no header."""
    rows = np.column_stack([1e3 * log["time"] + 2041.0, 16384.0 / G * force(log)])
    np.savetxt(path, rows, fmt="%d", delimiter=",")


def write_commas(path, log):
    """As a spreadsheet saves it where people write decimal commas."""
    text = csv_of(log, ("time", *OUTPUTS), "t [s];ax [m/s²];ay [m/s²];az [m/s²]")
    rows = text.split("\n")
    changed = [row.replace(",", ";").replace(".", ",") for row in rows[1:]]
    path.write_text("\n".join(["sep=;", rows[0], *changed]), encoding="utf-8")


def write_mat(path, log):
    from scipy.io import savemat

    savemat(path, {"t": log["time"], "acc": force(log)})


def write_parquet(path, log):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    parquet.write_table(pyarrow.table(log), path)


def write_poses(folder, log):
    for i, rest in enumerate(mp.average(log).rests):
        part = {name: column[slice(*rest.rows)] for name, column in log.items()}
        path = folder / f"pose{i + 1}.csv"
        path.write_text(csv_of(part, ("time", *OUTPUTS), "time,ax,ay,az"))


def write_labelled(path, log):
    labels = np.full(len(log["time"]), "", dtype="<U9")
    for rest in mp.average(log).rests:
        labels[slice(*rest.rows)] = f"pose {rest.position}"
    rows = csv_of(log, ("time", *OUTPUTS), "time,ax,ay,az").splitlines()
    text = [f"{row},{label}" for row, label in zip(rows, ["pose", *labels.tolist()], strict=True)]
    path.write_text("\n".join(text) + "\n")


def write_sensorlogger(path, log):
    header = "time,seconds_elapsed,z,y,x"
    stamps = 1_700_000_000_000_000_000 + np.round(1e9 * log["time"]).astype(int)
    table = csv_of(log | {"n": stamps}, ("n", "time", "az", "ay", "ax"), header)
    return archive(path, {"TotalAcceleration.csv": table, "Metadata.csv": "a,b\nc,d\n"})


WRITERS = {
    "flight.ulg": lambda path, log: write_flight(path, log, {}),
    "flight.bin": lambda path, log: write_flight(path, log, {"INS_ACCOFFS_X": 0.0}),
    "imu.bag": lambda path, log: write_bag(path, force(log)),
    "imu/imu.mcap": lambda path, log: write_bag(path.parents[1] / path.name, force(log)),
    "phyphox.zip": write_phyphox,
    "sensorlogger.zip": write_sensorlogger,
    "MT_0001.txt": write_xsens,
    "serial.txt": write_serial,
    "board.xlsx": write_workbook,
    "board.csv": write_commas,
    "session.mat": write_mat,
    "session.parquet": write_parquet,
    "pose1.csv": lambda path, log: write_poses(path.parent, log),
    "labelled.csv": write_labelled,
    "actigraph.csv": lambda path, log: write_actigraph(path, force(log) / G, ""),
    "geneactiv.csv": write_geneactiv,
}


def test_every_row_has_a_file():
    assert [shlex.split(command)[2] for command in COMMANDS] == list(WRITERS)


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: shlex.split(command)[2])
def test_a_command_of_the_page_works(command, log, truth, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    _, *arguments = shlex.split(command)
    path = Path(arguments[1])
    library = NEEDED.get(path.suffix)
    if library is not None and find_spec(library) is None:
        pytest.skip(f"no {library}")
    WRITERS[arguments[1]](tmp_path / path, log)
    assert main(arguments) == 0, capsys.readouterr().err
    printed = capsys.readouterr().out
    written = re.findall(r"^Written to (.*)$", printed, re.MULTILINE)
    assert bool(written) == ("--to" in arguments)
    assert all(Path(name).exists() for each in written for name in each.split(", "))
    cal = mp.load(arguments[-1])
    assert len(cal.readings) == 14
    # The bias [g] is the same whatever the log came in, within its uncertainty.
    u = max(truth[name, "1"].u for name in OUTPUTS) / G
    assert_allclose(bias_in_g(cal), bias_in_g(truth), atol=5.0 * u)


def bias_in_g(cal):
    own = zip(cal.outputs, "xyz", strict=True)
    return [cal[output, "1"].value / cal[output, axis].value for output, axis in own]
