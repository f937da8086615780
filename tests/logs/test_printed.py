"""Logs as programs print them: whatever stands around the numbers, the calibration is the same."""

import json
from itertools import pairwise

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


def _rows():
    """Return time [s] and readings as text: 16 rests of 3 s, turned by hand between them."""
    rng = np.random.default_rng(20)
    parts = []
    for up in UP:
        mean = MATRIX @ up + BIAS
        parts += [mean + rng.normal(0.0, 0.002, (REST, 3)), mean + rng.normal(0, 0.4, (TURN, 3))]
    data = np.vstack(parts)
    return [(i / RATE, *(f"{each:.4f}" for each in row)) for i, row in enumerate(data.tolist())]


ROWS = _rows()


def _counts(text):
    return round(float(text) * 16384)


def _clock(t):
    return f"12:{int(t // 60):02d}:{t % 60:06.3f}"


def _ros(t, x, y, z):
    covariance = ", ".join(["0.0"] * 9)
    return (
        f"header: \n  seq: {round(t * RATE)}\n  stamp: \n    secs: {1500 + int(t)}\n"
        f'    nsecs: {round(t % 1.0 * 1e9)}\n  frame_id: "imu"\norientation: \n  x: 0.0\n  y: 0.0\n'
        f"  z: 0.0\n  w: 1.0\norientation_covariance: [{covariance}]\nangular_velocity: \n"
        f"  x: 0.01\n  y: 0.02\n  z: {0.03 + t % 0.07:.4f}\nlinear_acceleration: \n  x: {x}\n"
        f"  y: {y}\n  z: {z}\n---"
    )


# Lines by time and readings, and whether they carry the time.
LINES = {
    "names": (lambda t, x, y, z: f"ax: {x} ay: {y} az: {z}", False),
    "names and commas": (lambda t, x, y, z: f"ax: {x}, ay: {y}, az: {z}", False),
    "equal signs": (lambda t, x, y, z: f"ax={x} ay={y} az={z}", False),
    "tabulators": (lambda t, x, y, z: f"ax:\t{x}\tay:\t{y}\taz:\t{z}", False),
    "names without marks": (lambda t, x, y, z: f"ax {x} ay {y} az {z}", False),
    "units": (lambda t, x, y, z: f"Accel X: {x} g, Y: {y} g, Z: {z} g", False),
    "units that are glued": (lambda t, x, y, z: f"X: {x}g Y: {y}g Z: {z}g", False),
    "two sensors": (
        lambda t, x, y, z: f"Accel: x={x} y={y} z={z} | Gyro: x=0.1 y={t % 3:.2f} z=0.3",
        False,
    ),
    "a temperature": (lambda t, x, y, z: f"X: {x} Y: {y} Z: {z} T: {20 + t % 4:.1f} °C", False),
    "a name and three numbers": (
        lambda t, x, y, z: f"accel: {x} {y} {z} gyro: 0.1 {t % 3:.2f} 0",
        False,
    ),
    "a tuple": (lambda t, x, y, z: f"({x}, {y}, {z})", False),
    "a named tuple": (lambda t, x, y, z: f"acc = ({x}, {y}, {z})", False),
    "an array": (lambda t, x, y, z: f"[{x} {y} {z}]", False),
    "angle brackets": (lambda t, x, y, z: f"<{x},{y},{z}>", False),
    "a dictionary": (lambda t, x, y, z: f"{{'ax': {x}, 'ay': {y}, 'az': {z}}}", False),
    "bars": (lambda t, x, y, z: f"| {x} | {y} | {z} |", False),
    "decimal commas": (lambda t, x, y, z: f"ax: {x} ay: {y} az: {z}".replace(".", ","), False),
    "an index": (
        lambda t, x, y, z: f"accSmooth[0]: {x} accSmooth[1]: {y} accSmooth[2]: {z}",
        False,
    ),
    "three lines": (lambda t, x, y, z: f"Accel X: {x}\nAccel Y: {y}\nAccel Z: {z}\n", False),
    "lines under a heading": (
        lambda t, x, y, z: f"Accel:\n  X: {x}\n  Y: {y}\n  Z: {z}\nGyro:\n  X: 1\n  Y: 2\n  Z: 3",
        False,
    ),
    "milliseconds before": (lambda t, x, y, z: f"t={round(t * 1e3)} ms, a=[{x}, {y}, {z}]", True),
    "Teleplot": (
        lambda t, x, y, z: "\n".join(
            f">a{name}:{round(t * 1e3)}:{each}" for name, each in zip("xyz", (x, y, z), strict=True)
        ),
        True,
    ),
    "ESP-IDF": (
        lambda t, x, y, z: f"\x1b[0;32mI ({round(t * 1e3)}) imu: ax={x} ay={y} az={z}\x1b[0m",
        True,
    ),
    "InfluxDB": (
        lambda t, x, y, z: f"imu,host=a ax={x},ay={y},az={z} {1465839830 * 10**9 + round(t * 1e9)}",
        True,
    ),
    "rostopic echo": (_ros, True),
    "a serial monitor": (lambda t, x, y, z: f"{_clock(t)} -> {x},{y},{z}", True),
    "a log of Python": (
        lambda t, x, y, z: f"2026-05-06 {_clock(t).replace('.', ',')} INFO imu: x={x} y={y} z={z}",
        True,
    ),
    "JSON lines": (
        lambda t, x, y, z: json.dumps(
            {"t": t, "acc": {"x": float(x), "y": float(y), "z": float(z)}}
        ),
        True,
    ),
    "JSON lines of lists": (
        lambda t, x, y, z: json.dumps({"t": t, "acc": [float(x), float(y), float(z)]}),
        True,
    ),
    "no header": (lambda t, x, y, z: f"{x},{y},{z}", False),
    "a minus sign": (lambda t, x, y, z: f"{x},{y},{z}".replace("-", "\N{MINUS SIGN}"), False),
    "wide digits": (
        lambda t, x, y, z: f"{x},{y},{z}".translate({48 + i: 0xFF10 + i for i in range(10)}),
        False,
    ),
    "decimal commas between semicolons": (
        lambda t, x, y, z: f"{x};{y};{z}".replace(".", ","),
        False,
    ),
}

# The same in counts of 1/16384 g.
COUNTS = {
    "points between thousands": lambda a: ";".join(f"{n:,}".replace(",", ".") for n in a),
    "commas between thousands": lambda a: ";".join(f"{n:,}" for n in a),
    "quoted commas between thousands": lambda a: ",".join(f'"{n:,}"' for n in a),
    "registers": lambda a: ",".join(f"0x{n & 0xFFFF:04X}" for n in a),
    "named registers": lambda a: " ".join(
        f"a{name}=0x{n & 0xFFFFFF:06x}" for name, n in zip("xyz", a, strict=True)
    ),
}


def _documents():
    number = [(t, *map(float, row)) for t, *row in ROWS]
    t, x, y, z = zip(*number, strict=True)
    records = [{"timestamp": r[0], "accel": dict(zip("xyz", r[1:], strict=True))} for r in number]
    return {
        "arrays in objects": {"device": "a", "samples": {"t": t, "acc": {"x": x, "y": y, "z": z}}},
        "objects in an array": {"meta": {"version": 1}, "data": records},
        "rows": number,
    }


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    path = tmp_path_factory.mktemp("plain") / "log.csv"
    rows = [",".join(map(str, row)) for row in ROWS]
    path.write_text("\n".join(["time,ax,ay,az", *rows]) + "\n", encoding="utf-8")
    return mp.calibrate(path).parameters


def calibrated(path, *, timed=True, unit=1.0, **options):
    if not timed:
        options["rate"] = RATE
    found = mp.calibrate(path, **options)
    assert len(found.readings) == len(UP)
    return found.parameters / unit


@pytest.mark.parametrize("form", LINES)
def test_a_printed_log_gives_the_calibration_of_the_plain_one(form, plain, tmp_path):
    line, timed = LINES[form]
    path = tmp_path / "log.txt"
    path.write_text("\n".join(line(*row) for row in ROWS) + "\n", encoding="utf-8")
    assert calibrated(path, timed=timed) == pytest.approx(plain, abs=1e-4)


@pytest.mark.parametrize("form", COUNTS)
def test_marks_in_counts_are_no_decimals(form, plain, tmp_path):
    """Rounding to a count moves a mean of 300 rows by less than .1 count."""
    lines = [COUNTS[form](list(map(_counts, row[1:]))) for row in ROWS]
    path = tmp_path / "log.txt"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    found = calibrated(path, timed=False, unit=16384.0)
    assert found == pytest.approx(plain, abs=1e-4)


@pytest.mark.parametrize("form", _documents())
def test_json_of_any_depth_is_a_log(form, plain, tmp_path):
    path = tmp_path / "log.json"
    path.write_text(json.dumps(_documents()[form]), encoding="utf-8")
    assert calibrated(path) == pytest.approx(plain, abs=1e-4)


def test_an_array_with_a_row_for_each_output_is_turned(plain, tmp_path):
    path = tmp_path / "log.npy"
    np.save(path, np.array([list(map(float, row[1:])) for row in ROWS]).T)
    assert calibrated(path, timed=False) == pytest.approx(plain, abs=1e-4)


def test_rows_keep_the_numbers_of_their_lines(tmp_path):
    lines = [LINES["names"][0](*row) for row in ROWS]
    lines[500] = "imu: sensor was reset"
    (tmp_path / "log.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    found = mp.calibrate(tmp_path / "log.txt", rate=RATE)
    assert len(found.readings) == len(UP)


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
