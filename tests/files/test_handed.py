"""One table, handed in in every form: the same calibration comes out."""

import gzip
import io
import json
import lzma
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import multipos as mp
from multipos.files import handed

CAL = mp.demo().calibration
TABLE = dict(mp.simulate(CAL, "fibonacci-24", reading_sd=1e-3, seed=3))
COLUMNS = {name: np.asarray(column).tolist() for name, column in TABLE.items()}
ROWS = [dict(zip(COLUMNS, row, strict=True)) for row in zip(*COLUMNS.values(), strict=True)]
FRAME = pd.DataFrame(COLUMNS)
TEXT = FRAME.to_csv(index=False)
OUTPUTS = ("ax", "ay", "az")


class Lazy:
    """What polars and narwhals call a lazy frame: nothing but a plan to make one."""

    def collect_schema(self):
        return dict.fromkeys(FRAME.columns)

    def collect(self):
        return FRAME


class Stream:
    def __arrow_c_stream__(self, requested_schema=None):
        return arrow().__arrow_c_stream__(requested_schema)


class Interchange:
    def __dataframe__(self, *_, **__):
        return arrow().__dataframe__()


def arrow():
    return pytest.importorskip("pyarrow").table(COLUMNS)


def opened(tmp_path, mode):
    (tmp_path / "readings.csv").write_text(TEXT)
    return (tmp_path / "readings.csv").open(mode)


def written(name, content):
    def write(tmp_path):
        path = tmp_path / name
        path.write_bytes(content() if callable(content) else content)
        return path

    return write


def zstd():
    if sys.version_info >= (3, 14):
        from compression import zstd as library
    else:
        library = pytest.importorskip("backports.zstd")
    return library.compress(TEXT.encode())


def arrow_file(module, write):
    stream = io.BytesIO()
    getattr(pytest.importorskip(f"pyarrow.{module}"), write)(arrow(), stream)
    return stream.getvalue()


FORMS = {
    "pandas": lambda _: FRAME,
    "lazy frame": lambda _: Lazy(),
    "pyarrow": lambda _: arrow(),
    "record batch": lambda _: arrow().to_batches()[0],
    "Arrow C stream": lambda _: pytest.importorskip("pyarrow") and Stream(),
    "interchange": lambda _: pytest.importorskip("pyarrow") and Interchange(),
    "polars": lambda _: pytest.importorskip("polars").DataFrame(COLUMNS).lazy(),
    "StringIO": lambda _: io.StringIO(TEXT),
    "BytesIO": lambda _: io.BytesIO(TEXT.encode()),
    "open": lambda tmp_path: opened(tmp_path, "r"),
    "open, bytes": lambda tmp_path: opened(tmp_path, "rb"),
    "gzip": written("r.csv.gz", gzip.compress(TEXT.encode())),
    "xz": written("r.csv.xz", lzma.compress(TEXT.encode())),
    "Zstandard": written("r.csv.zst", zstd),
    "JSON records": written("r.json", json.dumps(ROWS).encode()),
    "JSON columns": written("r.json", json.dumps(COLUMNS).encode()),
    "JSON of pandas": written("r.json", FRAME.to_json(double_precision=15).encode()),
    "JSON of --json": written("r.json", json.dumps({"rows": 24, "columns": COLUMNS}).encode()),
    "JSON lines": written("r.jsonl", "\n".join(map(json.dumps, ROWS)).encode()),
    "Parquet": written("r.parquet", lambda: arrow_file("parquet", "write_table")),
    "Feather": written("r.feather", lambda: arrow_file("feather", "write_feather")),
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_is_the_same_table(form, tmp_path):
    given = FORMS[form](tmp_path)
    np.testing.assert_allclose(mp.fit(given).parameters, mp.fit(TABLE).parameters, atol=1e-10)
    if hasattr(given, "close"):
        given.close()


@pytest.mark.parametrize("form", ["lazy frame", "pyarrow", "Arrow C stream", "StringIO", "xz"])
def test_in_every_function(form, tmp_path):
    """Tables, logs, schemes and fleets come through one door."""

    def given():
        return FORMS[form](tmp_path)

    np.testing.assert_array_equal(mp.read_scheme(given()).up, mp.read_scheme(TABLE).up)
    np.testing.assert_array_equal(mp.apply(CAL, given()).f_x, mp.apply(CAL, TABLE).f_x)
    assert mp.check(CAL, given()).verdict == mp.check(CAL, TABLE).verdict
    plain = mp.regress(TABLE, response="ax", variables="up_x").segments[0]
    assert mp.regress(given(), response="ax", variables="up_x").segments[0].rms == plain.rms
    assert list(mp.fit_many(given(), unit_column="position")["unit"]) == list(COLUMNS["position"])


def test_a_log_in_an_open_file_is_calibrated():
    log = dict(mp.simulate_log(CAL, "faces-corners-14", sample_sd=1e-3, seed=1))
    text = pd.DataFrame(log).to_csv(index=False)
    found, expected = mp.calibrate(io.StringIO(text)), mp.calibrate(log)
    np.testing.assert_array_equal(found.parameters, expected.parameters)


def test_arrays_are_named_by_outputs():
    values = np.column_stack([TABLE[name] for name in OUTPUTS])
    up = np.column_stack([TABLE[f"up_{axis}"] for axis in "xyz"])
    found = mp.fit(values, scheme=up, outputs=OUTPUTS)
    np.testing.assert_array_equal(found.parameters, mp.fit(TABLE).parameters)
    assert mp.fit(values, scheme=up).outputs == ("1", "2", "3")
    np.testing.assert_array_equal(mp.apply(CAL, values).f_x, mp.apply(CAL, TABLE).f_x)
    with pytest.raises(mp.UsageError, match="2 names, but the array has 3 columns"):
        mp.fit(values, scheme=up, outputs="ax,ay")
    log = mp.simulate_log(CAL, "faces-6", sample_sd=1e-3, seed=1)
    samples = np.column_stack([log[name] for name in OUTPUTS])
    rate = 1.0 / float(log["time"][1] - log["time"][0])
    means = mp.average(samples, outputs=OUTPUTS, rate=rate, scheme="faces-6").readings.values
    np.testing.assert_allclose(means, mp.average(log, scheme="faces-6").readings.values)
    assert mp.stability(samples[:400], outputs=OUTPUTS, rate=rate).outputs.keys() == {*OUTPUTS}


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("cal.json", b'{"schema": "x", "a": [1]}', "the JSON is no table; give records"),
        ("rests.json", b'{"positions": [{}], "findings": []}', "the JSON is no table; give rec"),
        ("cut.json", b'{"ax": [1, 2', "not valid JSON"),
        ("bytes.json", b'[{"ax": "\xe4"}]', "not UTF-8 text"),
        ("cut.csv.xz", lzma.compress(TEXT.encode())[:-40], "cannot unpack: .* cut off"),
        ("cut.parquet", b"PAR1" + bytes(40), "cannot be read"),
    ],
)
def test_what_is_no_table_is_said(name, content, message, tmp_path):
    if name.endswith(".parquet"):
        pytest.importorskip("pyarrow")
    path: Path = written(name, content)(tmp_path)
    with pytest.raises(mp.MultiposError, match=message):
        mp.fit(path)


@pytest.mark.parametrize("cell", [10**30, "100000000000000000000000000000"])
def test_whole_numbers_beyond_64_bits_are_numbers(cell, tmp_path):
    (tmp_path / "r.json").write_text(json.dumps([{"a": cell}, {"a": None}]))
    column = handed.read_json_columns(tmp_path / "r.json", "data")["a"]
    assert column[0] in (float(cell), cell)
    assert column.dtype.kind in "fU"


def test_a_missing_library_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(handed, "find_spec", lambda name: None)
    (tmp_path / "r.csv.zst").write_bytes(b"\x28\xb5\x2f\xfd" + bytes(9))
    if sys.version_info < (3, 14):
        with pytest.raises(mp.MultiposError, match=r"backports\.zstd reads.*'multipos\[zst\]'"):
            mp.fit(tmp_path / "r.csv.zst")
    with pytest.raises(mp.MultiposError, match=r"a Stream, which pyarrow reads"):
        mp.fit(Stream())


def test_an_open_file_is_read_once_by_those_who_ask_it_twice(tmp_path):
    up = mp.read_scheme("faces-6").up
    rows = [f"{i},{x},{y},{z}" for i, (x, y, z) in enumerate(up.tolist())]
    text = "\n".join(["position,up_x,up_y,up_z", *rows, ""])
    cal = mp.demo().calibration
    assert list(mp.simulate(cal, io.StringIO(text), seed=1)["position"]) == list("012345")
    found = mp.design(model="linear", positions=8, include=io.StringIO(text))
    np.testing.assert_allclose(found.positions[:6], up, atol=1e-12)
    sections = tmp_path / "sections.json"
    sections.write_text('[{"position": "a", "start": 0, "end": 99}]', encoding="utf-8")
    still = {"ax": 1.0 + 1e-3 * np.sin(np.arange(100.0) ** 2)}
    assert len(mp.average(still, sections=sections).rests) == 1


def test_a_masked_cell_is_empty():
    masked = np.ma.masked_greater(TABLE["ax"], 0.9)
    for table in (TABLE | {"ax": masked}, FRAME.assign(ax=masked.filled(np.nan))):
        with pytest.raises(mp.MultiposError, match="column 'ax': 'nan' is not finite"):
            mp.fit(table)
    named = mp.read_table({"a": np.ma.masked_equal(["x", "-"], "-")})
    assert named.text("a") == ("x", "")


def test_one_column_is_no_table():
    pytest.importorskip("pyarrow")
    with pytest.raises(TypeError, match="readings is one column, a Series; give a data frame"):
        mp.fit(FRAME["ax"])


def test_directions_of_a_design_are_an_array():
    up = mp.read_scheme("faces-corners-14").up
    found = mp.design(positions=7, include=up[:3], candidates=up)
    np.testing.assert_allclose(found.positions[:3], up[:3], atol=1e-12)
    assert (found.positions @ up.T > 1.0 - 1e-12).any(axis=1).all()


def test_a_unit_that_is_no_number_is_empty():
    rows = pd.concat([FRAME.assign(unit=np.nan), FRAME.assign(unit=1.0)], ignore_index=True)
    with pytest.raises(mp.MultiposError, match="row 1, column 'unit': the cell is empty"):
        mp.fit_many(rows, unit_column="unit")
