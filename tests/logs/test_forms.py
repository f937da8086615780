"""Logs in every form that people have: the calibration is that of the plain table."""

import datetime
import json
import tomllib
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import multipos as mp
from multipos.files.printed import Records, find_printed

DIAGONALS = [(a, b, c) for a in (1, -1) for b in (1, -1) for c in (1, -1)]
FACES = [*np.eye(3), *-np.eye(3)]
UP = np.array([*FACES, *DIAGONALS, (1, 1, 0), (1, -1, 0)], dtype=float)
UP /= np.linalg.norm(UP, axis=1)[:, None]
MATRIX = np.array([[1.01, 0.01, -0.004], [0.003, 0.99, 0.006], [0.002, -0.005, 1.02]])
BIAS = np.array([0.02, -0.01, 0.03])
RATE, REST, TURN = 100, 300, 60  # [Hz] and rows
BEGIN = datetime.datetime(2026, 5, 6, 12)


def _rows():
    """Return readings: 16 rests of 3 s, turned by hand between them."""
    rng = np.random.default_rng(20)
    parts = []
    for up in UP:
        mean = MATRIX @ up + BIAS
        parts += [mean + rng.normal(0.0, 0.002, (REST, 3)), mean + rng.normal(0, 0.4, (TURN, 3))]
    return np.vstack(parts).round(4).tolist()


ROWS = _rows()


class Words(dict):
    """What a line may say: readings, in mg and in counts, times in many forms, another sensor."""

    def __init__(self, i, row):
        t = i / RATE
        now = BEGIN + datetime.timedelta(seconds=t)
        counts = [round(16384 * each) for each in row]
        self |= dict(zip("xyz", (f"{each:.4f}" for each in row), strict=True))
        self |= dict(zip("abc", (f"{1000.0 * each:.1f}" for each in row), strict=True))
        self |= dict(zip("XYZ", counts, strict=True))
        self |= dict(zip("ABC", (n & 0xFFFF for n in counts), strict=True))
        self |= {"i": i, "t": t, "ms": 10 * i, "us": 10**6 + 10**4 * i, "s": f"{int(t):02d}"}
        self |= {"unix": 1.5e9 + t, "ns": 1465839830 * 10**9 + 10**7 * i, "nsec": i % 100 * 10**7}
        self |= {"clock": now.isoformat(timespec="milliseconds")[11:], "day": 46148.5 + t / 86400.0}
        self |= {"comma": self["clock"].replace(".", ","), "secs": 1500 + int(t), "sum": i % 256}
        self |= {"p": 0.1, "q": round(t % 3, 2), "r": round(0.03 + t % 0.07, 4), "warm": 25 + i % 4}


with Path(__file__).with_name("forms.toml").open("rb") as stream:
    FORMS = tomllib.load(stream)
IN_G = [(kind, form) for kind in ("lines", "tables") for form in FORMS[kind]]
UNITS = {"counts": 16384.0, "mg": 1000.0}
IN_UNITS = [(kind, form) for kind in UNITS for form in FORMS[kind]]

OTHERS = {
    "a minus sign": ("{x},{y},{z}", lambda text: text.replace("-", "\N{MINUS SIGN}")),
    "wide digits": (
        "{x},{y},{z}",
        lambda text: text.translate({48 + i: 0xFF10 + i for i in range(10)}),
    ),
    "brackets of NumPy": ("[{x} {y} {z}]", lambda text: f"[{text.strip()}]"),
    "comments between": ("{t},{x},{y},{z}", lambda text: text.replace("9.5,", "9.5,", 1) + "# end"),
    "a header again": (
        "{t},{x},{y},{z}",
        lambda text: "time,ax,ay,az\n" + text.replace("\n30.0,", "\ntime,ax,ay,az\n30.0,"),
    ),
}
ENCODINGS = {"UTF-16": "utf-16", "GB 18030": "gb18030", "Windows-1252": "cp1252"}

# Two sensors whose rows take turns, with what the refusal says to type.
TURNS = {
    "sensors by name": ("time,sensor,ax,ay,az", "{t},A,{x},{y},{z}\n{t},B,{p},{q},{r}", "sensor=A"),
    "kinds by name": ("time,kind,x,y,z", "{t},acc,{x},{y},{z}\n{t},gyr,{p},{q},{r}", "kind=acc"),
    "kinds without a header": ("ACC 0 0 0", "ACC {x} {y} {z}\nGYR {p} {q} {r}", "1=ACC"),
}


def _documents():
    number = [(i / RATE, *row) for i, row in enumerate(ROWS)]
    t, x, y, z = zip(*number, strict=True)
    names = ("time", "ax", "ay", "az")
    flat = [dict(zip(names, row, strict=True)) for row in number]
    records = [{"timestamp": r[0], "accel": dict(zip("xyz", r[1:], strict=True))} for r in number]
    sensors = [{"name": f"acc{each}", "units": "m/s2"} for each in "XYZ"]
    return {
        "arrays in objects": {"device": "a", "samples": {"t": t, "acc": {"x": x, "y": y, "z": z}}},
        "objects in an array": {"meta": {"version": 1}, "data": records},
        "rows": number,
        "texts": [{name: str(cell) for name, cell in row.items()} for row in flat],
        "split by pandas": {"columns": names, "index": [*range(len(t))], "data": number},
        "an index of pandas": {str(i): row for i, row in enumerate(flat)},
        "columns of pandas": {
            name: {str(i): row[name] for i, row in enumerate(flat)} for name in names
        },
        "a table of pandas": {"schema": {"fields": [{"name": "time"}]}, "data": flat},
        "vectors": [{"ts": round(1e3 * r[0]), "values": r[1:]} for r in number],
        "Edge Impulse": {"payload": {"interval_ms": 10, "sensors": sensors, "values": ROWS}},
    }


def _table(form):
    """Return rows of the last line of a form below the others."""
    head, mark, row = form.rpartition("\n")
    return head + mark + _rows_of(row)


def _rows_of(row):
    return "".join(f"{row.format_map(Words(*each))}\n" for each in enumerate(ROWS))


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    path = tmp_path_factory.mktemp("plain") / "log.csv"
    path.write_text(_table("time,ax,ay,az\n{t},{x},{y},{z}"), encoding="utf-8")
    return mp.calibrate(path).parameters


@pytest.fixture
def calibrated(tmp_path, plain):
    """Return what holds the calibration of a text to that of the plain table."""

    def hold(text, unit=1.0, encoding="utf-8", name="log.txt", **options):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode(encoding))
        found = mp.calibrate(path, **options)
        assert len(found.readings) == len(UP)
        assert found.parameters / unit == pytest.approx(plain, abs=1e-4)

    return hold


@pytest.mark.parametrize(("kind", "form"), IN_G)
def test_a_log_gives_the_calibration_of_the_plain_one(kind, form, calibrated):
    text = FORMS[kind][form]
    calibrated(_rows_of(text) if kind == "lines" else _table(text))


@pytest.mark.parametrize("form", FORMS["commas"])
def test_decimal_commas_give_it(form, calibrated):
    calibrated(_table(FORMS["commas"][form]).replace(".", ","))


@pytest.mark.parametrize(("kind", "form"), IN_UNITS)
def test_other_units_give_it(kind, form, calibrated):
    """Rounding to a count moves a mean of 300 rows by less than .1 count."""
    text = _table(FORMS[kind][form])
    calibrated(text.replace(",", ".") if form.startswith("points") else text, UNITS[kind])


@pytest.mark.parametrize("form", OTHERS)
def test_other_signs_and_lines_give_it(form, calibrated):
    line, change = OTHERS[form]
    calibrated(change(_table(line)))


@pytest.mark.parametrize("name", ENCODINGS)
def test_encodings_give_it(name, calibrated):
    header = (
        "Zeit;ax (m/s²);ay (m/s²);az (m/s²)"
        if name != "GB 18030"
        else FORMS["tables"]["Chinese"].split("\n")[0]
    )
    mark = ";" if ";" in header else ","
    text = _table(header + "\n" + mark.join(("{t}", "{x}", "{y}", "{z}")))
    calibrated(text, encoding=ENCODINGS[name])


@pytest.mark.parametrize("form", TURNS)
def test_a_sensor_of_two_gives_it_by_what_the_refusal_says(form, calibrated):
    header, rows, only = TURNS[form]
    text = _rows_of(rows) if form.endswith("header") else f"{header}\n{_rows_of(rows)}"
    with pytest.raises(mp.MultiposError, match=f"--only {only}"):
        calibrated(text)
    calibrated(text, only=only)


@pytest.mark.parametrize("form", _documents())
def test_json_of_any_depth_gives_it(form, calibrated):
    calibrated(json.dumps(_documents()[form]), name="log.json")


def test_an_array_with_a_row_for_each_output_is_turned(tmp_path, calibrated):
    np.save(tmp_path / "array.npy", np.array(ROWS).T)
    calibrated((tmp_path / "array.npy").read_bytes(), name="log.npy")


def test_rows_keep_the_numbers_of_their_lines(calibrated):
    lines = _rows_of(FORMS["lines"]["names"]).split("\n")
    lines[500] = "imu: sensor was reset"
    calibrated("\n".join(lines))


@pytest.mark.parametrize("line", ["{x}/{y}/{z}", "{x}:{y}:{z}", "{A:04x} {B:04x} {C:04x}"])
def test_lines_that_are_not_read_are_shown(line, tmp_path):
    (tmp_path / "log.txt").write_text(_table(line))
    with pytest.raises(mp.MultiposError, match=r"lines like '[^']+'.; give a file of numbers"):
        mp.calibrate(tmp_path / "log.txt")


PRINTED = {
    "ax: 1 ay: 2 az: 3": ("ax", "ay", "az"),
    "Accel X: 1.5 g, Y: 2 g, Z: -3 g": ("Accel.X [g]", "Accel.Y [g]", "Accel.Z [g]"),
    "X: 1m/s^2 Y: 2m/s^2 Z: 3m/s^2": ("X [m/s^2]", "Y [m/s^2]", "Z [m/s^2]"),
    "acc = (1, 2, 3)": ("acc_x", "acc_y", "acc_z"),
    "(1, 2, 3)": (),
    ">ax:100:1§g": ("time [ms]", "ax [g]"),
    "I (100) imu: acc: 1, 2, 3": ("time [ms]", "acc_x", "acc_y", "acc_z"),
    "imu,host=a ax=1i,ay=2i 1465839830100400200": ("ax", "ay", ""),
}


@pytest.mark.parametrize("line", PRINTED)
def test_what_stands_before_a_number_names_it(line):
    printed = find_printed([line] * 5)
    assert printed is not None
    assert printed.names == PRINTED[line]


@pytest.mark.parametrize(
    "lines",
    [
        ["ax,ay,az", "1,2,3", "4,5,6"],
        ["1,2,3", "4,5,6"],
        ["position;ax;ay", "1a;1,5;2", "2b;1,25;3"],
        ["t,sensor,x,y,z", "0,A,1,2,3", "1,G,1,2,3"],
        ["$IMU,1,2,3", "$IMU,4,5,6"],
        ["2026-05-06T12:00:00.5Z,1,2,3", "2026-05-06T12:00:00.6Z,1,2,3"],
        ["direction,ax,ay,az", "+X,1,2,3", "E-U-S,1,2,3"],
        ["1.5  2.5 -3", "4 5 6"],
        ["position,x (2g),y (2g)", *["45deg,1,2"] * 9, "90deg,1"],
        ["position,x,y", *["45deg,1,2,"] * 9],
    ],
)
def test_a_table_is_not_printed(lines):
    assert find_printed(lines) is None


def test_records_of_several_lines_that_are_cut_off_are_left_out():
    whole = ["ax: 1", "ay: 2", "az: 3"]
    printed = find_printed(whole * 5)
    found = [*Records(printed).text(["ay: 8", "az: 9", *whole, "ax: 4", "ay: 5", *whole])]
    assert [line for line in found if line] == ["1\t2\t3"] * 2
    ends = [place for place, line in enumerate(found) if line]
    assert [after - before for before, after in pairwise(ends)] == [5]
