"""A fleet that is read, solved and written in pieces is the same as one that is not."""

import csv
import json

import numpy as np
import pytest
from fleet_bench import line
from numpy.testing import assert_allclose, assert_array_equal

import multipos as mp
from multipos.cli import main
from multipos.errors import MultiposError
from multipos.fleets import cutting, fit_many, folder

pytestmark = pytest.mark.filterwarnings("ignore::multipos.errors.CalibrationWarning")
pa = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")
APART = {"unit_column": "unit", "station_column": "station"}


def ragged(units=40):
    """A line with times, two stations, a failed unit, a bad one and one of fewer rows."""
    table = line(units, stations=2, scheme="faces-corners-14", seed=3)
    table["time"] = np.arange(14.0 * units)
    table["ax"][14 * 11 + 3] = np.nan
    table["ay"][14 * 23 : 14 * 24] = 0.25
    keep = np.ones(14 * units, dtype=bool)
    keep[14 * 30 + 5] = False
    return {name: column[keep] for name, column in table.items()}


def write(path, table, rows_of_group):
    parquet.write_table(pa.table(table), path, row_group_size=rows_of_group)
    return path


def pieces_taken(monkeypatch):
    """A list that fills with the units of each piece."""
    taken = []
    made = fit_many.Piece

    def noted(rows, grouped, stations, first, known):
        taken.append((first, first + len(grouped)))
        return made(rows, grouped, stations, first, known)

    monkeypatch.setattr(fit_many, "Piece", noted)
    return taken


def same(found, whole):
    """Columns are the same, numbers but for the order in which batches are summed."""
    assert list(found) == list(whole)
    for name, column in whole.items():
        if column.dtype.kind == "f":
            assert_allclose(found[name], column, rtol=1e-10, atol=1e-13)
        elif name == "reason":  # it begins with the table's name
            said, expected = (
                [text.partition(":")[2] for text in each] for each in (found[name], column)
            )
            assert said == expected
        else:
            assert_array_equal(found[name], column)


@pytest.mark.parametrize("rows_of_group", [50, 101])
def test_pieces_of_files_are_the_whole(tmp_path, monkeypatch, rows_of_group):
    table = ragged()
    whole = mp.fleet(table, **APART)
    half = 14 * 20 + 6  # in the middle of a unit
    lots = tmp_path / "lots"
    lots.mkdir()
    for name, part in (("a", slice(None, half)), ("b", slice(half, None))):
        cells = {column: values[part] for column, values in table.items()}
        write(lots / f"{name}.parquet", cells, rows_of_group)
    monkeypatch.setattr(cutting, "_PIECE", 100)
    taken = pieces_taken(monkeypatch)
    found = mp.fleet(str(lots), **APART)
    # seven units at most of 14 rows, none twice and none left out
    assert len(taken) == 6
    assert [first for first, _ in taken[1:]] == [last for _, last in taken[:-1]]
    assert (taken[0][0], taken[-1][1]) == (0, 40)
    same(found.calibrations, whole.calibrations)
    assert_array_equal(found.verdicts["verdict"], whole.verdicts["verdict"])
    assert_allclose(found.time, whole.time)
    for key in ("units", "failed", "counted", "verdicts"):
        assert found[key] == whole[key]
    for one, other in zip(found["stations"], whole["stations"], strict=True):
        assert (one["station"], one["units"]) == (other["station"], other["units"])
        for axis in "xyz":
            for row, expected in zip(one["positions_deg"], other["positions_deg"], strict=True):
                assert (row[axis] is None) == (expected[axis] is None)
                if row[axis] is not None:
                    assert row[axis] == pytest.approx(expected[axis], rel=1e-6, abs=1e-12)


def test_what_cannot_be_cut_is_taken_whole(tmp_path, monkeypatch):
    table = ragged()
    whole = mp.fit_many(table, **APART)
    monkeypatch.setattr(cutting, "_PIECE", 100)
    taken = pieces_taken(monkeypatch)
    one = mp.fit_many(write(tmp_path / "one.parquet", table, 10**6), **APART)
    assert taken == [(0, 40)]
    same(one, whole)


def test_a_file_whose_later_rows_are_damaged_is_named(tmp_path, monkeypatch):
    path = write(tmp_path / "line.parquet", line(30, scheme="faces-corners-14"), 50)
    raw = bytearray(path.read_bytes())
    place = parquet.read_metadata(path).row_group(6).column(7).data_page_offset
    raw[place : place + 12] = b"\xff" * 12
    path.write_bytes(bytes(raw))
    monkeypatch.setattr(cutting, "_PIECE", 100)
    with pytest.raises(MultiposError, match=r"line\.parquet: cannot be read as Parquet"):
        mp.fit_many(path, unit_column="unit")


@pytest.mark.parametrize("form", ["parquet", "csv"])
def test_what_is_written_in_pieces_is_the_whole(tmp_path, monkeypatch, form, capsys):
    if form == "csv":
        monkeypatch.setattr(folder, "find_spec", lambda name: None)
    table = ragged()
    mp.write_table(tmp_path / "line.csv", table)
    monkeypatch.setattr(folder, "_ROWS", 7)
    run = ["fleet", str(tmp_path / "line.csv"), "--unit-column", "unit", "--station-column"]
    assert main([*run, "station", "-o", str(tmp_path / "out")]) == 0
    whole = mp.fleet(tmp_path / "line.csv", **APART)
    if form == "parquet":
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
