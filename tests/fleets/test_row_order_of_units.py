"""Rows of units that stand together, apart, in several files or packed: units are the same."""

import csv
import gzip
import hashlib
import json
import re
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
import multipos.files.csv_columns as columns
from multipos.cli import main
from multipos.errors import MultiposError
from multipos.files import tables
from multipos.files.csv_columns import arrange_cells
from multipos.fleets import folder

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


def in_short_texts(monkeypatch):
    """Split texts in the middle of units."""
    monkeypatch.setattr(columns, "_PIECE", 997)
    monkeypatch.setattr(columns, "_TOGETHER", 11)


def same(found, whole):
    """Units in their order, numbers but for the order in which batches are summed."""
    assert list(found) == list(whole)
    for name, column in whole.items():
        if column.dtype.kind == "f":
            assert_allclose(found[name], column, rtol=1e-10, atol=1e-13)
        elif name != "reason":
            assert_array_equal(found[name], column)
    # which names file and line
    assert [bool(text) for text in found["reason"]] == [bool(text) for text in whole["reason"]]


@pytest.mark.parametrize(
    ("kind", "files"), [("csv", 1), ("csv", 3), ("parquet", 3), ("parquet", 1)]
)
def test_files_of_any_order_are_the_whole(tmp_path, monkeypatch, kind, files):
    table, whole = ragged(), at_once()
    in_short_texts(monkeypatch)
    same(mp.fit_many(write(tmp_path / "together", table, kind, files), **APART), whole)
    same(mp.fit_many(write(tmp_path / "apart", by_position(table), kind, files), **APART), whole)
    same(mp.fit_many(by_position(table), **APART), whole)


@settings(max_examples=5)
@given(seed=st.integers(0, 2**32 - 1))
def test_rows_in_any_order_give_every_unit_its_numbers(tmp_path_factory, seed):
    table = line(12, stations=2, scheme="faces-corners-14", seed=5)
    whole = mp.fit_many(table, **APART)
    order = np.random.default_rng(seed).permutation(12 * N)
    mixed = {name: column[order] for name, column in table.items()}
    with pytest.MonkeyPatch.context() as patch:
        in_short_texts(patch)
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
    in_short_texts(monkeypatch)
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
    in_short_texts(monkeypatch)
    found = mp.fit_many(lots, **APART)
    (reason,) = (text for text in found["reason"] if "ax" in text)
    assert "0.csv: row 4 (line 133), column 'ax'" in reason
    lines = (lots / "0.csv").read_text().splitlines()
    assert lines[132].startswith("U0011,")
    assert lines[132].split(",")[2] == "4"


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


def test_a_damaged_parquet_file_is_named(tmp_path):
    lots = write(tmp_path / "lots", line(30, scheme="faces-corners-14"), "parquet")
    path, parquet = lots / "0.parquet", pytest.importorskip("pyarrow.parquet")
    raw = bytearray(path.read_bytes())
    place = parquet.read_metadata(path).row_group(6).column(7).data_page_offset
    raw[place : place + 12] = b"\xff" * 12
    path.write_bytes(bytes(raw))
    with pytest.raises(MultiposError, match=r"0\.parquet: cannot be read"):
        mp.fit_many(path, unit_column="unit")


@settings(max_examples=40)
@given(
    rows=st.integers(1, 30),
    piece=st.sampled_from([1, 20, 90]),
    seed=st.integers(0, 99),
    end=st.sampled_from(["\n", "\r\n"]),
)
def test_cells_are_arranged_as_lists_are(tmp_path_factory, rows, piece, seed, end):
    folder = tmp_path_factory.mktemp("cells")
    texts = [f"{i},é{i} , {i}.5" for i in range(rows)]
    (folder / "t.csv").write_bytes(end.join(["# é", "a,b,c", *texts]).encode())
    rng = np.random.default_rng(seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(columns, "_PIECE", piece)
        patch.setattr(columns, "_TOGETHER", 4)
        table = tables.open_table(folder / "t.csv", "table")
        order = rng.permutation(rows)[: max(1, rows // 2)]
        arranged = arrange_cells(table.columns, order)
    assert table.number("c").tolist() == [i + 0.5 for i in range(rows)]
    assert list(arranged["b"]) == [f"é{i}" for i in order]
    assert list(arranged["a"]) == [str(i) for i in order]


@pytest.mark.parametrize("form", ["parquet", "csv"])
def test_what_is_written_in_pieces_is_the_whole(tmp_path, monkeypatch, form, capsys):
    if form == "csv":
        monkeypatch.setattr(folder, "find_spec", lambda name: None)
    table = ragged()
    mp.write_table(tmp_path / "line.csv", table)
    monkeypatch.setattr(folder, "_ROWS", 7)
    run = ["fleet", str(tmp_path / "line.csv"), "--unit-column", "unit", "--station-column"]
    assert main([*run, "station", "-o", str(tmp_path / "out")]) == 0
    whole = mp.fleet(tmp_path / "line.csv", unit_column="unit", station_column="station")
    if form == "parquet":
        parquet = pytest.importorskip("pyarrow.parquet")
        file = parquet.ParquetFile(tmp_path / "out" / "calibrations.parquet")
        assert file.metadata.num_row_groups == 6
        columns = file.read().to_pydict()
    else:
        with (tmp_path / "out" / "calibrations.csv").open(encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream))
        columns = {name: [row[name] for row in rows] for name in rows[0]}
    assert list(columns) == list(whole.calibrations)
    for name, column in whole.calibrations.items():
        if column.dtype.kind == "f":
            read = [float("nan" if cell in ("", None) else cell) for cell in columns[name]]
            assert_allclose(read, column, rtol=1e-10, atol=1e-13)
        else:
            assert columns[name] == column.tolist()
    with (tmp_path / "out" / "units.csv").open(encoding="utf-8") as stream:
        verdicts = [row["verdict"] for row in csv.DictReader(stream)]
    assert verdicts == whole.verdicts["verdict"].tolist()
    assert json.loads((tmp_path / "out" / "fleet.json").read_text("utf-8"))["units"] == 40
