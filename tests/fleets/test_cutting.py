"""A fleet in pieces: of any size, from any kind of file, with rows of a unit together or apart."""

import gzip
import hashlib
import re
import signal
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from fleet_bench import line
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import multipos as mp
from multipos.errors import MultiposError
from multipos.files import csv_columns as columns
from multipos.files import tables
from multipos.files.csv_columns import arrange_cells, spread_cells
from multipos.fleets import cutting
from multipos.fleets import workers as running
from multipos.fleets.grouping import group_rows
from multipos.fleets.sources import read_rows

pytestmark = pytest.mark.filterwarnings("ignore::multipos.errors.CalibrationWarning")
KNOWN = {"orientation_sd": 0, "exclude": "none"}  # least squares of the listed orientations
APART = {"unit_column": "unit", "station_column": "station"} | KNOWN
UNITS, N = 40, 14


def ragged():
    """A line with times, two stations, an empty cell, a bad unit and one of fewer rows."""
    table = line(UNITS, stations=2, scheme="faces-corners-14", seed=3)
    table["time"] = np.arange(1.0 * N * UNITS)
    table["ax"][N * 11 + 3] = np.nan
    table["ay"][N * 23 : N * 24] = 0.25
    keep = np.ones(N * UNITS, dtype=bool)
    keep[N * 30 + 5] = False
    return {name: column[keep] for name, column in table.items()}


@cache
def at_once():
    return mp.fit_many(ragged(), **APART)


def by_position(table):
    """The same rows, those of the first position of all units first."""
    order = np.argsort([int(label) for label in table["position"]], kind="stable")
    return {name: column[order] for name, column in table.items()}


def write(folder, table, kind, files=1):
    """Write a table as files of a folder, cut anywhere, and return the folder."""
    folder.mkdir()
    rows = len(table["unit"])
    ends = np.linspace(0, rows, files + 1).astype(int)
    for i, (start, stop) in enumerate(pairwise(ends)):
        part = {name: column[start:stop] for name, column in table.items()}
        if kind == "csv":
            mp.write_table(folder / f"{i}.csv", part)
        else:
            pa = pytest.importorskip("pyarrow")
            from pyarrow import parquet

            parquet.write_table(pa.table(part), folder / f"{i}.parquet", row_group_size=50)
    return folder


def in_pieces(monkeypatch, rows):
    monkeypatch.setattr(cutting, "_PIECE", rows)
    monkeypatch.setattr(columns, "_PIECE", 997)  # bytes, in the middle of a unit
    monkeypatch.setattr(columns, "_TOGETHER", 11)


def same(found, whole, *, alone=False):
    """Units in their order, numbers but for the order in which batches are summed.

    A unit that is fitted alone has its cautions told, which a batch leaves out.
    """
    assert list(found) == list(whole)
    for name, column in whole.items():
        if column.dtype.kind == "f":
            assert_allclose(found[name], column, rtol=1e-10, atol=1e-13)
        elif name != "reason" and not (alone and name == "findings"):
            assert_array_equal(found[name], column)
    # which names file and line
    assert [bool(text) for text in found["reason"]] == [bool(text) for text in whole["reason"]]


@pytest.mark.parametrize(
    ("kind", "files", "rows"),
    [("csv", 1, 100), ("csv", 3, 333), ("csv", 1, 1), ("parquet", 3, 100), ("parquet", 1, 333)],
)
def test_pieces_of_any_size_are_the_whole(tmp_path, monkeypatch, kind, files, rows):
    table, whole = ragged(), at_once()
    in_pieces(monkeypatch, rows)
    together = mp.fit_many(write(tmp_path / "together", table, kind, files), **APART)
    apart = mp.fit_many(write(tmp_path / "apart", by_position(table), kind, files), **APART)
    same(together, whole, alone=rows < N)
    same(apart, whole, alone=rows < N)
    if kind == "csv":  # the same pieces, whose groups of rows of Parquet may not be
        for name, column in together.items():
            if name != "reason":
                assert_array_equal(apart[name], column)


def test_rows_in_memory_are_cut_as_well(monkeypatch):
    table, whole = ragged(), at_once()
    in_pieces(monkeypatch, 100)
    same(mp.fit_many(table, **APART), whole)
    same(mp.fit_many(by_position(table), **APART), whole)


@settings(max_examples=5)
@given(seed=st.integers(0, 2**32 - 1), rows=st.integers(3 * N, 160))
def test_rows_in_any_order_give_every_unit_its_numbers(tmp_path_factory, seed, rows):
    table = line(12, stations=2, scheme="faces-corners-14", seed=5)
    whole = mp.fit_many(table, **APART)
    order = np.random.default_rng(seed).permutation(12 * N)
    mixed = {name: column[order] for name, column in table.items()}
    with pytest.MonkeyPatch.context() as patch:
        in_pieces(patch, rows)
        found = mp.fit_many(
            write(tmp_path_factory.mktemp("mixed") / "line", mixed, "csv", 2), **APART
        )
    assert found["unit"].tolist() == list(dict.fromkeys(mixed["unit"].tolist()))
    places = [whole["unit"].tolist().index(unit) for unit in found["unit"].tolist()]
    for name, column in whole.items():
        if column.dtype.kind == "f":  # positions in another order are summed in another order
            assert_allclose(found[name], column[places], rtol=1e-9, atol=1e-12)
        elif name != "findings":  # every unit with its own order of positions is fitted alone
            assert_array_equal(found[name], column[places])


@pytest.mark.parametrize("arranged", [lambda table: table, by_position], ids=["together", "apart"])
def test_a_bad_cell_names_its_file_and_line(tmp_path, monkeypatch, arranged):
    lots = write(tmp_path / "lots", arranged(ragged()), "csv", 2)
    for path in lots.iterdir():  # comments in between, so that lines are not rows
        lines = path.read_text().splitlines()
        lines[100:100] = ["# a note", ""]
        path.write_text("\n".join(lines))
    in_pieces(monkeypatch, 100)
    found = mp.fit_many(lots, **APART)
    (reason,) = (text for text in found["reason"] if "ax" in text)
    if arranged is by_position:  # its rows are in both files
        assert "is empty" in reason
        return
    path, number = re.match(
        r"(.*\.csv): row 4 \(line (\d+)\), column 'ax': .* empty", reason
    ).groups()
    cells = Path(path).read_text().splitlines()[int(number) - 1].split(",")
    assert (cells[0], cells[2], cells[6]) == ("U0011", "4", "")


def test_a_bad_cell_of_rows_apart_names_its_line(tmp_path, monkeypatch):
    lots = write(tmp_path / "lots", by_position(ragged()), "csv")
    in_pieces(monkeypatch, 100)
    found = mp.fit_many(lots, **APART)
    (reason,) = (text for text in found["reason"] if "ax" in text)
    assert "0.csv: row 4 (line 133), column 'ax'" in reason
    lines = (lots / "0.csv").read_text().splitlines()
    assert lines[132].startswith("U0011,")
    assert lines[132].split(",")[2] == "4"


@pytest.mark.parametrize("arranged", [lambda table: table, by_position], ids=["together", "apart"])
def test_a_stopped_run_goes_on_in_pieces(tmp_path, monkeypatch, arranged):
    lots = write(tmp_path / "lots", arranged(line(6, scheme="faces-corners-14")), "csv")
    in_pieces(monkeypatch, 3 * N)
    monkeypatch.setattr("multipos.fleets.pieces._READINGS", 2 * N)
    kept = tmp_path / "out" / ".progress"
    solve, solved = running.solve_task, []

    def stop_after_three(task):
        if len(solved) == 3:
            raise KeyboardInterrupt
        solved.append(task.units.tolist())
        return solve(task)

    monkeypatch.setattr(running, "solve_task", stop_after_three)
    with ThreadPoolExecutor(1) as executor, pytest.raises(KeyboardInterrupt):
        mp.fleet(lots, executor=executor, progress_folder=kept, **APART)
    assert [path.suffix for path in kept.iterdir()] == [".npz"] * 3  # and no copy of rows
    again = []
    monkeypatch.setattr(running, "solve_task", lambda t: again.append(t.units.tolist()) or solve(t))
    with ThreadPoolExecutor(1) as executor:
        found = mp.fleet(lots, executor=executor, progress_folder=kept, **APART)
    assert solved + again == [[0, 1], [2], [3, 4], [5]]
    same(found.calibrations, mp.fit_many(line(6, scheme="faces-corners-14"), **APART))


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_copies_of_rows_are_gone_afterwards(tmp_path, monkeypatch, kind):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    lots = write(tmp_path / "lots", by_position(ragged()), kind)
    in_pieces(monkeypatch, 100)
    rows, owners = read_rows([lots], "unit", "station")
    grouped = group_rows(owners)
    with cutting.cut_rows(rows, grouped) as cuts:
        assert len([next(cuts), *cuts]) == 6
        (room,) = temporary.iterdir()
        assert [path.name for path in room.iterdir()] == ["0"]
    assert not [*temporary.iterdir()]

    def stopped():
        with cutting.cut_rows(rows, grouped) as cuts:
            next(cuts)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stopped()
    assert not [*temporary.iterdir()]


def test_a_signal_leaves_no_copy_of_rows(tmp_path):
    lots = write(tmp_path / "lots", by_position(ragged()), "csv")
    code = (
        "import os, signal, sys\n"
        "from multipos import cli\n"
        "from multipos.fleets import cutting\n"
        "cutting._PIECE = 100\n"
        "def stop(columns, rows):\n"
        "    assert len(os.listdir('out/.progress')) == 1\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "cutting.arrange_cells = stop\n"
        f"sys.exit(cli.main(['fleet', {str(lots)!r}, '--unit-column', 'unit', '-o', 'out']))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=False)
    assert done.returncode == -signal.SIGTERM
    assert not [*(tmp_path / "out" / ".progress").iterdir()]


def test_packed_tables_are_read_as_what_is_in_them(tmp_path):
    table = line(8, scheme="faces-corners-14")
    lots = write(tmp_path / "lots", table, "csv", 2)
    whole = mp.fleet(lots, **APART)
    for path in [*lots.iterdir()]:
        packed = path.with_suffix(".csv.gz")
        packed.write_bytes(gzip.compress(path.read_bytes()))
        path.unlink()
    found = mp.fleet(lots, **APART)
    assert found.calibrations == whole.calibrations
    assert [each["file"] for each in found["input"]] == ["0.csv.gz", "1.csv.gz"]
    assert (
        found["input"][0]["sha256"] == hashlib.sha256((lots / "0.csv.gz").read_bytes()).hexdigest()
    )
    (lots / "1.csv.gz").write_bytes((lots / "1.csv.gz").read_bytes()[:-20])
    told = mp.fleet(lots, **APART).calibrations["reason"]
    assert [*filter(None, told)] == [told[-1]]
    assert "1.csv.gz: cannot unpack" in told[-1]


def test_rows_that_cannot_be_copied_are_told_with_a_way_out(tmp_path, monkeypatch):
    lots = write(tmp_path / "lots", by_position(ragged()), "csv")
    in_pieces(monkeypatch, 100)
    there = tmp_path / "there"
    there.write_text("a file")
    with pytest.raises(MultiposError, match=r"cannot be kept there.*sort the tables by unit"):
        mp.fleet(lots, progress_folder=there, **APART)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(cutting, "spread_cells", full)
    with pytest.raises(MultiposError, match="No space left on device; make room"):
        mp.fleet(lots, **APART)


def test_a_file_that_changes_while_it_is_read_is_refused(tmp_path, monkeypatch):
    lots = write(tmp_path / "lots", line(12, scheme="faces-corners-14"), "csv")
    in_pieces(monkeypatch, 100)
    rows, owners = read_rows([lots], "unit", "station")
    with cutting.cut_rows(rows, group_rows(owners)) as cuts:
        cut = next(cuts)
        with (lots / "0.csv").open("a") as stream:
            stream.write("\n")
        with pytest.raises(MultiposError, match=r"0\.csv: the file has changed while it was read"):
            cut.rows.numbers("ax")


@settings(max_examples=40)
@given(
    rows=st.integers(1, 30),
    piece=st.sampled_from([1, 20, 90]),
    seed=st.integers(0, 99),
    end=st.sampled_from(["\n", "\r\n"]),
)
def test_cells_are_cut_and_arranged_as_lists_are(tmp_path_factory, rows, piece, seed, end):
    folder = tmp_path_factory.mktemp("cells")
    texts = [f"{i},é{i} , {i}.5" for i in range(rows)]
    (folder / "t.csv").write_bytes(end.join(["# é", "a,b,c", *texts]).encode())
    rng = np.random.default_rng(seed)
    start, stop = sorted(rng.integers(0, rows + 1, 2).tolist())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(columns, "_PIECE", piece)
        patch.setattr(columns, "_TOGETHER", 4)
        table = tables.open_table(folder / "t.csv")
        kinds = rng.integers(-1, 3, rows).astype(np.int16)
        spread = spread_cells(table.columns, kinds, 3, folder / "spread")
        order = rng.permutation(rows)[: max(1, rows // 2)]
        arranged = arrange_cells(table.columns, order)
    assert table.number("c").tolist() == [i + 0.5 for i in range(rows)]
    if start < stop:
        part = table.columns["b"].part(start, stop)
        assert list(part) == [part[i] for i in range(len(part))]
        assert list(part) == [f"é{i}" for i in range(start, stop)]
        again = part.part(len(part) // 2, len(part))
        assert list(again) == list(part)[len(part) // 2 :]
    for kind in np.unique(kinds[kinds >= 0]).tolist():
        assert list(spread(kind)["b"]) == [f"é{i}" for i in np.flatnonzero(kinds == kind)]
    assert list(arranged["b"]) == [f"é{i}" for i in order]
    assert list(arranged["a"]) == [str(i) for i in order]
