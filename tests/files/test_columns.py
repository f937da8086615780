"""Long tables stay bytes, and say the same as short ones, which are lists of cells."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from multipos.errors import MultiposError
from multipos.files import csv_columns as columns
from multipos.files import tables as files
from multipos.files.csv_columns import Cells

CELLS = st.sampled_from(
    ["1", " 2.5", "-3e-4 ", "", "x", "1_0", "nan", "inf", "1e400", "٣", "é", "1d3", "0x10", "-"]
)


@st.composite
def texts(draw):
    mark = draw(st.sampled_from(",;\t"))
    width = draw(st.integers(1, 4))
    names = [f"c{i}" for i in range(width)]
    rows = draw(st.lists(st.lists(CELLS, min_size=width, max_size=width), max_size=12))
    if mark == ";":
        rows = [[cell.replace(".", ",") for cell in row] for row in rows]
    lines = [mark.join(row) for row in [names, *rows]]
    for _ in range(draw(st.integers(0, 3))):
        at = draw(st.integers(0, len(lines)))
        lines.insert(at, draw(st.sampled_from(["", "  ", "# a,b", "#c0", "x,y", '"'])))
    end = draw(st.sampled_from(["\n", "\r\n", "\r"]))
    text = end.join(lines) + draw(st.sampled_from(["", end]))
    return text.encode(draw(st.sampled_from(["utf-8", "utf-8-sig", "latin-1"])), "replace")


def told(path):
    """Return all that a table says of a file: its cells, numbers and errors."""
    try:
        table = files.read_table(path)
    except MultiposError as error:
        return str(error)
    said = {"lines": list(table.lines), "rows": table.rows, "mark": table.delimiter}
    for name, column in table.columns.items():
        try:
            number = table.number(name, empty=True).tobytes()
        except MultiposError as error:
            number = str(error)
        try:
            text = table.text(name)
        except MultiposError as error:  # a control character
            text = str(error)
        said[name] = (list(column), number, text, table.is_text(name))
    return said


@settings(max_examples=100)
@given(content=texts(), piece=st.sampled_from([1, 7, 40]))
def test_long_and_short_tables_say_the_same(content, piece, tmp_path_factory):
    path = tmp_path_factory.mktemp("tables") / "t.csv"
    path.write_bytes(content)
    short = told(path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "_LONG", -1)
        patch.setattr(columns, "_PIECE", piece)
        long = told(path)
    assert long == short


def test_a_column_of_a_long_table_is_a_sequence(tmp_path):
    path = tmp_path / "t.csv"
    lines = [f"{i}, {i}.5 ,name {i}" for i in range(60_000)]
    path.write_text("\n".join(["a,b,c", *lines[:30_000], "# half", *lines[30_000:]]) + "\n")
    table = files.read_table(path)
    cells = table.columns["c"]
    assert isinstance(cells, Cells)
    assert len(cells) == 60_000
    assert cells[-1] == "name 59999"
    assert cells[29_998:30_001] == ["name 29998", "name 29999", "name 30000"]
    assert_array_equal(table.number("b"), np.arange(60_000) + 0.5)
    assert table.where(29_999, "b").endswith("row 30000 (line 30001), column 'b'")
    assert table.where(30_000, "b").endswith("row 30001 (line 30003), column 'b'")
    some = table.select([59_999, 3])
    assert some.text("c") == ("name 59999", "name 3")
    with pytest.raises(IndexError):
        cells[60_000]


def test_a_long_cell_costs_only_itself(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("a\n" + "1\n" * 20_000 + "9" * 100_000 + "\n")
    table = files.read_table(path)
    tracemalloc.start()
    with pytest.raises(MultiposError, match="is not finite"):
        table.number("a")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20e6  # an array of cells takes 4 bytes a character for each: 8 GB


def test_a_header_of_many_columns_is_checked_in_one_pass(tmp_path, monkeypatch):
    names = [f"c{i}" for i in range(30_000)]
    compared = 0

    class Name(str):
        __hash__ = str.__hash__

        def __eq__(self, other):
            nonlocal compared
            compared += 1
            return str.__eq__(self, other)

    files._check_header(tmp_path, [Name(name) for name in names])
    assert compared < 2 * len(names)
    with pytest.raises(MultiposError, match="column 'c7' appears twice"):
        files._check_header(tmp_path, [*names, "c7"])


def test_a_wide_table_is_taken_apart_once(tmp_path, monkeypatch):
    path = tmp_path / "t.csv"
    row = ",".join(map(str, range(3_000)))
    path.write_text("\n".join([",".join(f"c{i}" for i in range(3_000)), *[row] * 300]) + "\n")
    monkeypatch.setattr(files, "_LONG", -1)
    split = 0
    kept = columns.rows_of_text

    def counted(text):
        nonlocal split
        split += 1
        return kept(text)

    monkeypatch.setattr(columns, "rows_of_text", counted)
    table = files.read_table(path)
    assert [table.number(name)[-1] for name in table.columns] == list(range(3_000))
    assert split == 1
