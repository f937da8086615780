"""Consumers of exported files, as tests hold files to them.

`read_back` reads a file as its consumer does, by the consumer's own equation, and says what it
makes of the readings of the calibration; `replay` compiles the C of regressions and runs it on
rows, `corrected_rows` on given ones.
"""

import json
import re
import shutil
import subprocess
import tempfile
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from string import Template

import numpy as np

from multipos.exports import c_fixed, laws
from multipos.exports.c_correction import correction_source, declarations
from multipos.exports.laws import DIAGONAL, LINEAR, Correction, Drift
from multipos.exports.target_autopilots import (
    _GAUSS,
    _INAV_NAMES,
    _INAV_UNITY,
    _MILLIGAUSS,
    _REFERENCE,
    _UNIT,
    _UPPER,
    _ardupilot_limits,
    _ardupilot_mag_names,
    _ardupilot_names,
    _ardupilot_slopes,
    _px4_limits,
    _px4_mag_names,
    _px4_names,
    _px4_slopes,
)
from multipos.exports.target_c import signature
from multipos.exports.target_correction import Drive, _allowed, expected_rows, generated_rows
from multipos.files.tables import read_table
from multipos.sensor.nominal import read_nominal
from multipos.units import STANDARD_GRAVITY

HERE = Path(__file__).parent / "exports"
COMPILERS = ("cc", "gcc", "clang")
_REPLAYED = 20_000  # rows that are made up


@dataclass
class ReadBack:
    """What a consumer makes of the readings of a calibration."""

    target: str
    residuals: np.ndarray  # (n, K) force less reference
    rms: float
    difference: float  # largest, from what export writes; of C from the calibration

    @property
    def max(self):
        return float(np.abs(self.residuals).max())


# --- C


def fill(template, **words):
    return Template((HERE / template).read_text(encoding="utf-8")).substitute(words)


def compile_and_run(text, main, rows, columns):
    """What a program makes of rows of numbers: it reads ``readings`` and writes ``forces``."""
    compiler = next(filter(None, map(shutil.which, COMPILERS)))
    with tempfile.TemporaryDirectory() as folder:
        inside = Path(folder)
        (inside / "main.c").write_text(main, encoding="utf-8")
        (inside / "export.c").write_text(text, encoding="utf-8")
        (inside / "readings").write_bytes(np.ascontiguousarray(rows).tobytes())
        command = [compiler, "-std=c99", "-O2", "-o", "main", "main.c", "export.c", "-lm"]
        subprocess.run(command, cwd=inside, check=True, timeout=60)
        subprocess.run([str(inside / "main")], cwd=inside, check=True, timeout=60)
        return np.frombuffer((inside / "forces").read_bytes()).reshape(-1, columns)


def run_c(text, calibration, declaration, rows):
    """What the function of a C file makes of rows (n, M + E)."""
    kind, axes = declaration.split("const ")[1].split()[0], len(calibration.model.sensed_axes)
    raw, count = len(calibration.outputs), len(calibration.model.environment)
    main = fill(
        "run.c",
        declaration=declaration,
        columns=raw + count,
        axes=axes,
        kind=kind,
        raw=raw,
        environment=(
            f"{kind} env[{count}]; for (int j = 0; j < {count}; ++j) "
            f"env[j] = ({kind})row[{raw} + j];"
            if count
            else ""
        ),
        between="env, " if count else "",
        name=declaration.split("_compensate")[0].removeprefix("void "),
    )
    return compile_and_run(text, main, rows, axes)


SIGNATURE = re.compile(
    r"^void (?P<name>\w+)_compensate\(const (?P<type>double|float) raw\[(?P<raw>\d+)\]"
    r"(?:, const \w+ env\[(?P<env>\d+)\])?, \w+ (?:accel|field)\[(?P<accel>\d+)\]\)",
    re.MULTILINE,
)
C_OF_WHOLE = re.compile(r"^void (\w+)_compensate\(const int32_t raw", re.MULTILINE)


def _read_c(text, calibration):
    name, kind = SIGNATURE.search(text).group("name", "type")
    readings = calibration.readings
    columns = [readings.environment[each] for each in calibration.model.environment]
    rows = np.column_stack([readings.values, *columns])
    if kind == "float":
        rows = rows.astype(np.float32).astype(np.float64)
    force = run_c(text, calibration, signature(calibration, name, kind == "float"), rows)
    if "[m/s^2], convention" in text:
        force = force / STANDARD_GRAVITY
    values, *env = np.split(rows, np.arange(len(calibration.outputs), rows.shape[1]), axis=1)
    given = {
        each: column[:, 0] for each, column in zip(calibration.model.environment, env, strict=True)
    }
    target = "c, single precision" if kind == "float" else "c"
    return _of_c(target, calibration, force, calibration.compensate(values, given))


def _read_c_fixed(text, calibration):
    """Whole numbers, to the bit as Python has them."""
    fixed = c_fixed.find_fixed_point(calibration)
    rows = fixed.whole(calibration.readings.values)
    declared = c_fixed.fixed_signature(calibration, C_OF_WHOLE.search(text)[1])
    whole = run_c(text, calibration, declared, rows.astype(np.float64))
    assert (whole == c_fixed.fixed_forces(fixed, rows)).all()
    should = calibration.compensate(calibration.readings.values)
    return _of_c("c, whole numbers", calibration, whole / fixed.accel_per_g, should)


def _of_c(target, calibration, force, should):
    sensed = list(calibration.model.sensed_axes)
    left = np.zeros_like(calibration.reference)
    left[:, sensed] = force - calibration.reference[:, sensed]
    difference = float(np.abs(force - should).max())
    return ReadBack(target, left[:, sensed], laws.rms_left(calibration, left), difference)


# --- the C of regressions


@dataclass
class Replay:
    """What C made of rows: `difference` from Python (K,), and what rounding allows."""

    rows: int
    difference: np.ndarray
    allowed: np.ndarray


def corrected_rows(text, c, drive, *, single=False):
    """What NAME_correct of a file returns and gives, (n, 1 + K), for rows."""
    state, start, correct = declarations(c, "multipos", single=single)
    rows = np.column_stack([drive.begins.astype(float), drive.time, drive.values])
    main = fill(
        "run_correction.c",
        name="multipos",
        state=state,
        start=start,
        correct=correct,
        kind="float" if single else "double",
        columns=rows.shape[1],
        inputs=len(c.inputs),
        outputs=len(c.regressions),
    )
    return compile_and_run(text, main, rows, len(c.regressions) + 1)


def replay(c, *, single=False, data=None):
    """Hold the C of regressions to what Python makes of the same rows."""
    drive = generated_rows(c, _REPLAYED) if data is None else fitted_rows(c, read_table(data))
    drive = drive.rounded() if single else drive
    out, beyond, certain = expected_rows(c, drive, single=single)
    back = corrected_rows(correction_source(c, "multipos", single=single), c, drive, single=single)
    assert (back[certain, 0] == beyond[certain]).all()
    difference = np.abs(back[:, 1:] - out)[certain].max(axis=0, initial=0.0)
    return Replay(len(out), difference, _allowed(c, drive, out, single))


def fitted_rows(c, table):
    """The rows of a table that are complete, run by run."""
    (run,) = {r.run for r in c.regressions}
    (clock,) = {r.time for r in c.regressions}
    values = np.column_stack([table.number(name, empty=True) for name in c.inputs])
    time = np.arange(float(table.rows)) if clock is None else table.number(clock, empty=True)
    labels = [""] * table.rows if run is None else table.text(run)
    number = np.unique(np.array(labels), return_inverse=True)[1]
    complete = np.flatnonzero(np.isfinite(values).all(axis=1) & np.isfinite(time))
    rows = complete[np.argsort(number[complete], kind="stable")]
    return Drive(number[rows], time[rows], values[rows])


# --- parameters


_NOMINAL = re.compile(
    r"^# nominal conversion of the readings: \(reading - (\S+)\) / (\S+) in (?:g|uT)$", re.MULTILINE
)
_ROW = r"\[[^\]\n]*\]"
_MAG_BIAS = tuple(f"mag_bias_{axis}" for axis in "xyz")


def _named(text, names):
    """The values of parameters from lines of names and values, each given once."""
    values = {}
    for line in text.splitlines():
        cells = [] if line.startswith("#") else re.split(r"[\s,]+", line.strip())
        for name, value in pairwise(cells):
            if name in names:
                assert values.setdefault(name, value) == value
    return np.array([float(values[name]) for name in names])


def _correction(numbers, sign=1.0, drift=None):
    """The law of offset, diagonal and off-diagonals."""
    matrix = np.diag(numbers[3:6])
    for (i, j), value in zip(_UPPER, numbers[6:].tolist(), strict=False):
        matrix[i, j] = matrix[j, i] = value
    return Correction(matrix, sign * numbers[:3], drift)


def _instance(given, text):
    return min(int(found["instance"] or 1) for found in given.finditer(text))


def _drift(text, slopes, limits):
    """The drift of the offset in a file's own units, about the first of its limits."""
    if not any(name in text for name in slopes):
        return None
    return Drift(_named(text, slopes).reshape(3, 3), *_named(text, limits).tolist())


_PX4 = re.compile(r"^(?!#).*\bCAL_ACC(?P<instance>\d)_[XYZ]", re.MULTILINE)
_PX4_MAG = re.compile(r"^(?!#).*\bCAL_MAG(?P<instance>\d)_[XYZ]", re.MULTILINE)
_ARDUPILOT = re.compile(r"^(?!#).*\bINS_ACC(?P<instance>[23]?)(?:OFFS|SCAL)_", re.MULTILINE)
_ARDUPILOT_MAG = re.compile(r"^(?!#).*\bCOMPASS_(?:OFS|DIA|ODI)(?P<instance>[23]?)_", re.MULTILINE)


def _read_px4(text):
    instance = _instance(_PX4, text)
    drift = _drift(text, _px4_slopes(instance), _px4_limits(instance))
    return _correction(_named(text, _px4_names(instance)), drift=drift)


def _read_px4_mag(text):
    return _correction(_named(text, _px4_mag_names(_instance(_PX4_MAG, text))))


def _read_ardupilot(text):
    instance = _instance(_ARDUPILOT, text)
    numbers = _named(text, _ardupilot_names(instance))
    drift = _drift(text, _ardupilot_slopes(instance), _ardupilot_limits(instance))
    if drift is not None:
        at = drift.reference
        drift = drift.scaled(_UNIT)._replace(reference=_REFERENCE)
        numbers[:3] -= drift.offset(at)
    return _correction(numbers, drift=drift)


def _read_ardupilot_mag(text):
    return _correction(_named(text, _ardupilot_mag_names(_instance(_ARDUPILOT_MAG, text))), -1.0)


def _read_inav(text):
    counts = int(re.search(r"^# 1G = (\d+) counts", text, re.MULTILINE)[1])
    given = re.sub(r"^\s*set\s+(\w+)\s*=", r"\1 ", text, flags=re.MULTILINE)
    numbers = _named(given, _INAV_NAMES)
    gain = numbers[3:] / (_INAV_UNITY * counts)
    return Correction(np.diag(gain * STANDARD_GRAVITY), numbers[:3])


def _read_kalibr(text):
    def matrix(key):
        found = re.search(rf"^ +{key}:\s*\n((?:\s*- {_ROW}\s*\n){{3}})", text, re.MULTILINE)
        rows = np.eye(3).tolist() if found is None else map(json.loads, re.findall(_ROW, found[1]))
        return np.array(list(rows))

    bias = json.loads(re.search(rf"^ +bias: ({_ROW})", text, re.MULTILINE)[1])
    return Correction(np.linalg.inv(matrix("M") @ matrix("C_i_case")), np.array(bias))


def _read_imu_calib(text):
    found = dict(re.findall(rf"^(SM|bias):\s*({_ROW})", text, re.MULTILINE))
    matrix = np.array(json.loads(found["SM"])).reshape(3, 3)
    return Correction(matrix, np.linalg.solve(matrix, json.loads(found["bias"])))


def _read_imucal(text):
    held = json.loads(text)
    assert held["_format_version"] == "2.0.0"
    K, R, b = (np.array(held[key]) for key in ("K_a", "R_a", "b_a"))
    return Correction(np.linalg.inv(R) @ np.linalg.inv(K), b)


def _read_ros_magnetometer(text):
    return Correction(np.eye(3), _named(text.replace(":", " "), _MAG_BIAS))


# How each consumer's file is known, its name, the terms of its law, what its raw values are, its
# reader, and further options of `laws.reduce_to`.
CONSUMERS = [
    (re.compile(r"^SM:", re.MULTILINE), "ros-imu-calib", LINEAR, "readings", _read_imu_calib, {}),
    (_PX4, "px4", DIAGONAL, "m/s^2", _read_px4, {"thermal": True}),
    (_ARDUPILOT, "ardupilot", DIAGONAL, "m/s^2", _read_ardupilot, {"thermal": True}),
    (
        re.compile(r"^\s*mag_bias_x:", re.MULTILINE),
        "ros",
        LINEAR,
        "m/s^2",
        _read_ros_magnetometer,
        {"tesla": 1.0, "offset_alone": True},
    ),
    (re.compile(r'"K_a"', re.MULTILINE), "imucal", LINEAR, "readings", _read_imucal, {}),
    (re.compile(r"^ +accelerometers:", re.MULTILINE), "kalibr", LINEAR, "m/s^2", _read_kalibr, {}),
    (re.compile(r"^\s*set acczero_x", re.MULTILINE), "inav", DIAGONAL, "counts", _read_inav, {}),
    (_PX4_MAG, "px4", LINEAR, "m/s^2", _read_px4_mag, {"tesla": _GAUSS}),
    (_ARDUPILOT_MAG, "ardupilot", LINEAR, "m/s^2", _read_ardupilot_mag, {"tesla": _MILLIGAUSS}),
]


def read_back(path, calibration):
    """What the consumer of a file makes of the readings of a calibration."""
    text = Path(path).read_text(encoding="utf-8")
    calibration = calibration.of_sensor
    if SIGNATURE.search(text):
        return _read_c(text, calibration)
    if C_OF_WHOLE.search(text):
        return _read_c_fixed(text, calibration)
    consumer = next(each for each in CONSUMERS if each[0].search(text))
    return read_parameters(text, calibration, *consumer[1:])


def read_parameters(text, calibration, target, formula, raw, read, options):
    """What a consumer of a matrix and an offset makes of the readings of a calibration."""
    if (stated := _NOMINAL.search(text)) is not None:
        calibration = replace(calibration, nominal=read_nominal([*map(float, stated.groups())]))
    tesla = options.get("tesla")
    expected = laws.reduce_to(calibration, formula, target, allow_lossy=True, **options).correction
    metres = laws.in_metres(calibration, target, tesla) if raw == "m/s^2" else 1.0
    zero = 0.0 if raw == "readings" else laws.raw_zero(calibration)
    given = read(text)
    assert (given.drift is None) == (expected.drift is None)
    law = given.of_raw_in(1.0 / metres, -zero * metres)._replace(turn=expected.turn)
    residuals = laws.law_residuals(calibration, law, tesla)
    difference = np.abs(residuals - laws.law_residuals(calibration, expected, tesla)).max()
    rms = laws.rms_left(calibration, residuals)
    return ReadBack(target, residuals, rms, float(difference))
