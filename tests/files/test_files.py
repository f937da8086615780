"""Tables and JSON, in and out: every form that is promised and every fault that is named."""

import json
import os
import stat
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from multipos.errors import MultiposError
from multipos.files.tables import format_csv, read_table, write_table
from multipos.files.trees import read_json, read_json_value, read_schema, read_toml, to_json
from multipos.files.whole import write_text


def table(tmp_path, text, encoding="utf-8"):
    path = tmp_path / "data.csv"
    path.write_bytes(text.encode(encoding))
    return read_table(path, what="readings")


@pytest.mark.parametrize(
    "text",
    [
        "position,ax\n1,1.5\n2,-2e-3\n",
        "position;ax\n1;1,5\n2;-2e-3\n",
        "position;ax\n1;1.5\n2;-0,002\n",
        "position\tax\n1\t1.5\n2\t-2e-3\n",
        "# bench 4\n\nposition,ax\n# warm-up over\n1,1.5\n\n2,-2e-3",
        "position , ax\r\n 1 , 1.5 \r\n 2 ,-2e-3\r\n",
        '"position","ax"\n"1","1.5"\n"2","-2e-3"\n',
    ],
    ids=["comma", "semicolon", "mixed decimals", "tab", "comments", "CRLF and blanks", "quoted"],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_every_form_reads_the_same(tmp_path, text, encoding):
    found = table(tmp_path, text, encoding)
    assert list(found.columns) == ["position", "ax"]
    assert found.text("position") == ("1", "2")
    assert_array_equal(found.number("ax"), [1.5, -0.002])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty"),
        ("# only a comment\n\n", "the file is empty"),
        ("ax,ay\n", "only a header, no rows"),
        ("ax,ay\n1,2\n1\n", r"row 2 \(line 3\) has 1 cells where the header names 2"),
        ("ax,ay\n# c\n1,2,3\n", r"row 1 \(line 3\) has 3 cells"),
        ("ax,ax\n1,2\n", "column 'ax' appears twice"),
        ("ax,,az\n1,2,3\n", "column 2 has no name"),
        ('ax,ay\n1,"2\n', "line 2: .*check the quotes"),
    ],
)
def test_a_faulty_table_is_refused_by_name(tmp_path, text, message):
    with pytest.raises(MultiposError, match=message) as error:
        table(tmp_path, text)
    assert "data.csv: " in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ax\nx1\n", "'x1' is not a number"),
        ("ax,b\n,1\n", "the cell is empty"),
        ("ax\nnan\n", "'nan' is not finite"),
        ("ax\n-inf\n", "'-inf' is not finite"),
        ("ax\n1_000\n", "'1_000' is not a number; write it without underscores"),
        ('ax,b\n"1,5",2\n', r"decimal commas need semicolons"),
    ],
)
def test_a_faulty_cell_is_named_by_file_row_and_column(tmp_path, text, message):
    found = table(tmp_path, "# note\n" + text)
    with pytest.raises(MultiposError, match=message) as error:
        found.number("ax")
    assert "data.csv: row 1 (line 3), column 'ax': " in str(error.value)


def test_missing_and_unreadable_files_are_named(tmp_path):
    with pytest.raises(MultiposError, match="no such file; check the path of the readings"):
        read_table(tmp_path / "none.csv", what="readings")
    with pytest.raises(MultiposError, match="cannot read the readings"):
        read_table(tmp_path, what="readings")
    (tmp_path / "cut.csv").write_bytes(b"\xff\xfea\0x\0\n\0001")
    with pytest.raises(MultiposError, match="byte 0 is not UTF-8"):
        read_table(tmp_path / "cut.csv")
    assert list(table(tmp_path, "ax\n1\n", "utf-16").columns) == ["ax"]


def test_mappings_and_data_frames_are_tables():
    columns = {"position": ["a", "b"], "ax": [1.0, 2.0], "n": np.array([5, 6])}
    for source in (columns, pd.DataFrame(columns), pd.DataFrame(columns).convert_dtypes()):
        found = read_table(source, what="readings")
        assert found.text("position") == ("a", "b")
        assert_array_equal(found.number("ax"), [1.0, 2.0])
        assert found.number("n").dtype == np.float64
        assert found.sha256 is None


def test_labels_of_a_data_frame_are_those_of_the_file():
    frame = pd.DataFrame({"position": [1.0, 2.0, 2.5], "ax": [1, 2, 3]})
    assert read_table(frame).text("position") == ("1", "2", "2.5")


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ({}, "has no rows"),
        ({"ax": []}, "has no rows"),
        ({"ax": [1, 2], "ay": [1]}, "differ in length"),
        ({"ax": [[1, 2]]}, "must be one-dimensional"),
    ],
)
def test_faulty_columns_are_refused(source, message):
    with pytest.raises(MultiposError, match=message):
        read_table(source)


def test_what_is_no_table_is_a_type_error():
    with pytest.raises(TypeError, match="must be a path, an open file, a mapping of columns"):
        read_table(3.0)


@pytest.mark.parametrize("missing", [None, np.nan, pd.NA, "", "nan"], ids=repr)
def test_missing_cells_of_a_data_frame_are_empty(missing):
    frame = pd.DataFrame({"s": [0.5, missing, 1.0]}, dtype=object)
    assert_array_equal(read_table(frame).number("s", empty=True), [0.5, np.nan, 1.0])
    with pytest.raises(MultiposError, match="row 2, column 's'"):
        read_table(frame).number("s")


@given(st.lists(st.floats(allow_infinity=False), min_size=1), st.sampled_from([",", ";", "\t"]))
def test_csv_keeps_all_digits(tmp_path_factory, values, delimiter):
    path = tmp_path_factory.getbasetemp() / "digits.csv"
    write_text(
        path, format_csv({"n": range(len(values)), "a": values, "b": np.array(values)}, delimiter)
    )
    found = read_table(path)
    for name in "ab":
        assert_array_equal(found.number(name, empty=True), values)


# --- JSON


def test_json_has_no_numbers_that_are_not():
    content = {"a": np.array([[1.0, np.nan], [np.inf, -0.1]]), "b": (np.float64(2), np.int64(3))}
    assert json.loads(to_json(content)) == {"a": [[1.0, None], [None, -0.1]], "b": [2.0, 3]}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"schema": "multipos/calibration/1", ', "line 1, column 38: not valid JSON"),
        ("", "line 1, column 1: not valid JSON"),
        ("[1, 2]", "the schema is None, but 'multipos/calibration/1' is needed here"),
        ('{"schema": "other/1"}', "the schema is 'other/1', but"),
        ("[" * 100_000, "nested too deeply"),
        (f'{{"schema": {"9" * 5000}}}', "the schema is inf, but"),
    ],
)
def test_foreign_json_is_refused(tmp_path, text, message):
    path = tmp_path / "cal.json"
    path.write_text(text)
    with pytest.raises(MultiposError, match=message):
        read_json(path, "multipos/calibration/1")


def test_json_that_is_no_text_is_refused(tmp_path):
    path = tmp_path / "cal.json"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(MultiposError, match="not UTF-8 text"):
        read_json(path, "multipos/calibration/1")


def test_whole_numbers_too_large_for_64_bits_become_floats(tmp_path):
    path = tmp_path / "a.json"
    path.write_text(f"[123456789012345678, 12345678901234567890, -{'9' * 400}]")
    whole, large, infinite = read_json_value(path, "file")
    assert (whole, type(whole)) == (123456789012345678, int)
    assert (large, type(large)) == (12345678901234567890.0, float)
    assert infinite == -np.inf


def test_a_schema_is_looked_for_in_any_file(tmp_path):
    path = tmp_path / "a.json"
    for text in ("[" * 100_000, "9" * 5000, "{}", "", "[1]", '{"schema": 1}'):
        path.write_text(text)
        assert read_schema(path) is None
    assert read_schema(tmp_path) is None
    path.write_text('{"schema": "other/1"}')
    assert read_schema(path) == "other/1"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a = " + "[" * 100_000, "nested too deeply; write the budget again"),
        ("a = " + "1" * 5000, "a whole number has more digits than 64 bits hold"),
        ("[level]\nu_deg = " + "1" * 400, "'u_deg' has more digits than 64 bits hold"),
        ("a = [1, [2, 9223372036854775808]]", "'a' has more digits than 64 bits hold"),
        ("a = \0", "not valid TOML"),
    ],
)
def test_faulty_toml_is_refused(tmp_path, text, message):
    path = tmp_path / "budget.toml"
    path.write_text(text)
    with pytest.raises(MultiposError, match=message):
        read_toml(path, "budget")


def test_toml_takes_all_of_64_bits(tmp_path):
    path = tmp_path / "budget.toml"
    path.write_text("a = [9223372036854775807, -9223372036854775808]")
    assert read_toml(path, "budget") == {"a": [2**63 - 1, -(2**63)]}


# --- writing, whole or not at all


def test_a_table_is_written_from_columns_and_read_back(tmp_path):
    path = tmp_path / "out.csv"
    columns = {"a": [0.1, float("nan")], "name": ["one, two", "three"]}
    for source in (columns, pd.DataFrame(columns)):
        write_table(path, source)
        assert path.read_text() == 'a,name\n0.1,"one, two"\n,three\n'
    assert read_table(path).text("name") == ("one, two", "three")
    with pytest.raises(MultiposError, match="differ in length"):
        write_table(path, {"a": [1.0], "b": [1.0, 2.0]})


def test_a_file_that_cannot_be_written_stays_as_it_was(tmp_path, monkeypatch):
    path = tmp_path / "out.txt"
    path.write_text("before")
    with pytest.raises(ZeroDivisionError):
        write_text(path, ("half of it" if i else str(1 // i) for i in (1, 0)))
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(MultiposError, match=r"cannot write: it is a folder"):
        write_text(tmp_path, "text")
    with pytest.raises(MultiposError, match=r"none/out.txt: cannot write: No such file"):
        write_text(tmp_path / "none" / "out.txt", "text")
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write anything
    with pytest.raises(MultiposError, match="cannot write: it is read-only"):
        write_text(path, "after")
    assert path.read_text() == "before"


def test_permissions_and_links_are_kept(tmp_path):
    path, link = tmp_path / "out.txt", tmp_path / "link.txt"
    path.write_text("before")
    path.chmod(0o640)
    link.symlink_to(path)
    write_text(link, "after")
    assert link.is_symlink()
    assert path.read_text() == "after"
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


def test_a_device_is_written_to():
    code = "from multipos.files.whole import write_text; write_text('/dev/stdout', 'seen')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "seen"
