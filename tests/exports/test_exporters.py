"""Exported files against Python: C compiled and run, parameters through the consumers' laws."""

import json
import re
import shutil
import subprocess
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from amounts import rest_slow
from consumers import SIGNATURE, read_back
from findings_bench import texts
from log_bench import sensor, shared

import multipos as mp
from multipos.cli import main
from multipos.exports.c_body import needed_steps
from multipos.exports.laws import (
    Correction,
    in_metres,
    raw_zero,
    reduce_to,
)
from multipos.exports.target_autopilots import _counts_of_g, _rounded_for_inav
from multipos.exports.target_c import signature
from multipos.exports.targets import export
from multipos.numerics.rotations import rotation_matrix
from multipos.sensor.model import build_model

READINGS = 100_000
WARNINGS = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Werror"]
# clang's sanitizer needs no library where it traps; gcc brings its own.
SANITIZERS = {
    "gcc": ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"],
    "clang": ["-fsanitize=undefined", "-fsanitize-trap=undefined"],
}

exactly = partial(mp.fit, orientation_sd=0)

# name: (formula, axes, size of the terms beyond linear [g per g^n], bias [g])
SENSORS = {
    "linear": ("linear", "xyz", 0.0, 0.3),
    "linear, two axes": ("linear", "xz", 0.0, 0.3),
    "linear, four outputs": ("linear", "xyzx", 0.0, 0.3),
    "own-quadratic": ("own-quadratic", "xyz", 2e-3, 0.3),
    "own-quadratic, one axis": ("1 + own + own^2", "y", 2e-3, 2.5),
    "ieee": ("1 + x + y + z + own^2 + own^3 + x*y", "xyz", 2e-3, 0.3),
    "odd": ("1 + x + y + z + own*|own|", "xyz", 2e-3, 0.3),
    "four outputs, odd": ("1 + x + y + z + own^2 + own*|own|", "xyzz", 2e-3, 0.3),
    "temperature": (
        "1 + x + y + z + own^2 + temperature + temperature^2 + temperature*own",
        "xyz",
        1e-3,
        0.3,
    ),
    "modulus of a column": ("1 + x + y + z + |temperature|*own", "xyz", 1e-4, 0.3),
}


def made(formula, axes, size, bias, *, unit=1.0, count=80):
    """A calibration of known coefficients, fitted to readings that are nearly free of noise."""
    rng = np.random.default_rng(1)
    up = mp.read_scheme(f"fibonacci-{count}").up
    temperature = rng.uniform(-10.0, 50.0, size=count)
    outputs = tuple(f"a{i + 1}" for i in range(len(axes)))
    inputs = tuple(sorted(set(axes)))
    formula = formula if len(inputs) == 3 or formula != "linear" else f"1 + {' + '.join(inputs)}"
    model = build_model(formula, outputs, tuple(axes), inputs, known=("temperature",))
    values = []
    for output, term in model.keys:
        axis = axes[outputs.index(output)]
        scale = unit * rng.uniform(-1.0, 1.0)
        if not term.factors:
            values.append(unit * bias)
        elif str(term) == axis:
            values.append(unit * 1.02)
        elif term.environment:
            values.append(size * scale / 30.0)
        else:
            values.append((0.02 if term.force_degree == 1 else size) * scale)
    environment = {"temperature": temperature}
    y = model.predict(np.array(values), up, environment)
    y = y + 1e-6 * unit * rng.normal(size=y.shape)
    readings = mp.Readings(y, outputs=outputs, up=up, environment=environment)
    return exactly(readings, model=formula, axes=tuple(axes), inputs=inputs)


def random_readings(cal):
    """Raw readings of random forces up to 1.2 g an axis, and random surroundings."""
    rng = np.random.default_rng(2)
    force = rng.uniform(-1.2, 1.2, size=(READINGS, 3))
    for i, axis in enumerate("xyz"):
        force[:, i] *= axis in cal.model.axes
    environment = {
        name: rng.uniform(column.min(), column.max(), size=READINGS)
        for name, column in cal.readings.environment.items()
        if name in cal.model.environment
    }
    return np.column_stack([cal.predict(force, environment), *environment.values()])


HARNESS = """\
#include <stdio.h>
{declaration};
int main(void)
{{
    {kind} row[{columns}], accel[{axes}];
    while (fread(row, sizeof row, 1, stdin) == 1) {{
        {name}_compensate(row, {between}accel);
        if (fwrite(accel, sizeof accel, 1, stdout) != 1) return 1;
    }}
    return 0;
}}
"""


def compile_c(compiler, folder, *options):
    if shutil.which(compiler) is None:
        pytest.skip(f"no {compiler} on this machine")
    program = folder / f"run-{compiler}"
    command = [compiler, *WARNINGS, "-O2", *options, *sorted(folder.glob("*.c"))]
    command += ["-o", program, "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return program


def run_c(compiler, cal, exported, rows, folder):
    found = SIGNATURE.search(exported.text)
    columns, axes = rows.shape[1], int(found["accel"])
    (folder / "calibration.c").write_text(exported.text)
    main_c = HARNESS.format(
        declaration=found[0],
        kind=found["type"],
        columns=columns,
        axes=axes,
        name=found["name"],
        between=f"row + {found['raw']}, " if found["env"] else "",
    )
    (folder / "main.c").write_text(main_c)
    program = compile_c(compiler, folder, *SANITIZERS[compiler])
    done = subprocess.run([program], input=rows.tobytes(), capture_output=True, check=True)
    assert done.stderr == b""
    return np.frombuffer(done.stdout, dtype=rows.dtype).reshape(-1, axes).astype(float)


def builds():
    """Return every sensor, with precisions and compilers in turn, then with the other of both."""
    ways = [(single, compiler) for single in (False, True) for compiler in SANITIZERS]
    turns = [*ways, *ways[::-1]]
    every = [(case, *turns[4 * k + i % 4]) for k in range(2) for i, case in enumerate(SENSORS)]
    return rest_slow(every, quick=len(SENSORS))


@pytest.mark.parametrize(("case", "single", "compiler"), builds())
def test_compiled_c_agrees_with_python(case, single, compiler, tmp_path):
    # eq. (1) of exports.c_body
    cal = made(*SENSORS[case])
    rows = random_readings(cal).astype(np.float32 if single else np.float64)
    exported = export(cal, "c", name="imu", float=single)
    found = run_c(compiler, cal, exported, rows, tmp_path)
    raw, environment = np.split(rows.astype(float), [len(cal.outputs)], axis=1)
    expected = cal.compensate(raw, dict(zip(cal.model.environment, environment.T, strict=True)))
    off = np.abs(found - expected)
    if single:
        assert off.max() < 5e-7
    elif case.startswith("linear"):
        assert (off.max(axis=1) / np.linalg.norm(expected, axis=1)).max() < 1e-12
    else:
        assert off.max() < 1e-9


LINEAR_PART = "(bias + scale*own + slope*(temperature - 20) + 0.01*(x + y + z))"
SATURATING = f"each = {LINEAR_PART}/(1 + limit*{LINEAR_PART}^2)^0.5 + 1e-4*abs(own)"


def saturating(own, force, temperature, bias, scale, limit, slope):
    linear = bias + scale * own + slope * (temperature - 20.0) + 0.01 * force.sum(axis=1)
    return linear / (1.0 + limit * linear**2) ** 0.5 + 1e-4 * abs(own)


@pytest.mark.parametrize(
    ("single", "compiler"),
    rest_slow(
        [(False, "gcc"), (True, "clang"), (False, "clang"), (True, "gcc")],
        quick=2,
    ),
)
def test_a_model_written_as_an_expression(single, compiler, tmp_path):
    rng = np.random.default_rng(0)
    up = mp.read_scheme("fibonacci-80").up
    temperature = rng.uniform(10.0, 40.0, size=80)
    values = np.column_stack(
        [saturating(up[:, i], up, temperature, 0.05 * i, 1.0, 0.01, 1e-3) for i in range(3)]
    )
    values += 1e-6 * rng.normal(size=values.shape)
    readings = mp.Readings(values, up=up, environment={"temperature": temperature})
    cal = mp.fit(readings, model=SATURATING)
    rows = random_readings(cal).astype(np.float32 if single else np.float64)
    exported = export(cal, "c", name="imu", float=single)
    found = run_c(compiler, cal, exported, rows, tmp_path)
    raw, environment = np.split(rows.astype(float), [3], axis=1)
    expected = cal.compensate(raw, {"temperature": environment[:, 0]})
    assert np.abs(found - expected).max() < (5e-7 if single else 1e-9)


@pytest.mark.parametrize("compiler", SANITIZERS)
@pytest.mark.parametrize("single", [False, True], ids=["double", "float"])
def test_the_self_test_passes_and_can_fail(single, compiler, tmp_path):
    exported = export(made(*SENSORS["temperature"]), "c", float=single)
    assert exported.save(tmp_path / "cal.c") == (
        str(tmp_path / "cal.c"),
        str(tmp_path / "cal_test.c"),
    )
    done = subprocess.run([compile_c(compiler, tmp_path)], capture_output=True, check=False)
    assert (done.returncode, done.stdout) == (0, b"multipos_compensate: all values met\n")
    (tmp_path / "cal.c").write_text(exported.text.replace("accel[0] = x", "accel[0] = x + x"))
    done = subprocess.run([compile_c(compiler, tmp_path)], capture_output=True, check=False)
    assert done.returncode == 1
    assert b"FAILED" in done.stdout


def test_the_file_has_one_symbol_and_needs_none(tmp_path):
    if shutil.which("gcc") is None or shutil.which("nm") is None:
        pytest.skip("no gcc or no nm on this machine")
    for case in ("linear", "temperature"):
        export(made(*SENSORS[case]), "c", name="k1").save(tmp_path / "cal.c")
        object_file = tmp_path / "cal.o"
        options = [*WARNINGS, "-ffreestanding", "-c", str(tmp_path / "cal.c"), "-o", object_file]
        subprocess.run(["gcc", *options], check=True)
        symbols = subprocess.run(["nm", object_file], capture_output=True, text=True, check=True)
        assert [line.split()[1:] for line in symbols.stdout.splitlines()] == [
            ["T", "k1_compensate"]
        ]


def test_signature_is_the_promised_one():
    cal = made(*SENSORS["linear"])
    assert signature(cal, "imu", False) == (
        "void imu_compensate(const double raw[3], double accel[3])"
    )
    hot = made(*SENSORS["temperature"])
    text = export(hot, "c", name="imu", float=True).text
    assert "void imu_compensate(const float raw[3], const float env[1], float accel[3])\n{" in text
    assert "env[0] = temperature, calibrated from" in text


def test_raw_and_accel_may_be_one_array():
    body = export(made(*SENSORS["linear"]), "c").text.partition("{")[2]
    reads, _, writes = body.partition("accel[0]")
    assert "raw[2]" in reads
    assert "raw" not in writes


def test_the_comment_cannot_be_ended_from_inside():
    up = mp.read_scheme("faces-6").up
    readings = mp.Readings(up, outputs=("a*/b", "c\\", "d??/"), up=up)
    head = export(mp.fit(readings), "c").text
    assert head.count("*/") == 1
    assert "\\" not in head
    assert "??/" not in head


def test_an_inverse_that_would_not_converge_is_refused():
    up = mp.read_scheme("fibonacci-40").up
    cal = mp.fit(mp.Readings(up + 0.2 * up**2, up=up), model="own-quadratic")
    with pytest.raises(mp.MultiposError, match="does not converge in fixed steps"):
        export(cal, "c")
    # an output without a slope where steps begin
    cal = mp.fit(mp.Readings(0.01 + up**3, up=up), model="each = b + s*own^3")
    with pytest.raises(mp.MultiposError, match="Newton's steps from no force do not find"):
        export(cal, "c", force=True)


# --- parameters, each through the consumer's law written out here


def session():
    """Readings in m/s² of a sensor with cross terms."""
    cal = sensor(bias=0.05, cross=0.02)
    up = mp.read_scheme("faces-corners-14").up
    y = 9.80665 * cal.predict(up) + 1e-4 * np.random.default_rng(0).normal(size=up.shape)
    return mp.Readings(y, up=up, unit="m/s^2"), up


def parameters(text):
    pairs = [line.replace(",", "\t").split("\t") for line in text.splitlines() if line[0] != "#"]
    return {
        cells[-3] if len(cells) == 5 else cells[0]: float(cells[-2 if len(cells) == 5 else 1])
        for cells in pairs
    }


def test_ros_imu_calib_by_its_law():
    # eq. (1) of exports.laws
    readings, _ = session()
    cal = mp.fit(readings)
    text = export(cal, "ros-imu-calib").text
    lines = dict(line.split(": ", 1) for line in text.splitlines() if line[0] != "#")
    matrix = np.array(json.loads(lines["SM"])).reshape(3, 3)
    bias = np.array(json.loads(lines["bias"]))
    corrected = readings.values @ matrix.T - bias  # AccelCalib::applyCalib
    np.testing.assert_allclose(corrected / 9.80665, cal.compensate(readings.values), atol=1e-12)
    K = np.array([[cal[o, t].value for t in "xyz"] for o in cal.outputs]) / 9.80665
    o = np.array([cal[o, "1"].value for o in cal.outputs])
    np.testing.assert_allclose(matrix, np.linalg.inv(K), rtol=1e-12)
    np.testing.assert_allclose(bias, np.linalg.solve(K, o), rtol=1e-12)


@pytest.mark.parametrize(
    ("target", "offset", "scale"),
    [
        ("px4", "CAL_ACC0_{}OFF", "CAL_ACC0_{}SCALE"),
        ("ardupilot", "INS_ACCOFFS_{}", "INS_ACCSCAL_{}"),
    ],
)
@pytest.mark.parametrize("unit", ["m/s^2", "g"])
def test_autopilots_by_their_law(target, offset, scale, unit):
    readings, up = session()
    metres = {"m/s^2": 1.0, "g": 9.80665}[unit]
    cal = exactly(mp.Readings(readings.values / metres, up=up, unit=unit))
    exported = export(cal, target, allow_lossy=True)
    found = parameters(exported.text)
    o = np.array([found[offset.format(axis)] for axis in "XYZ"])
    s = np.array([found[scale.format(axis)] for axis in "XYZ"])
    # The least-squares line of each output against its own axis, by hand.
    for i in range(3):
        slope, bias = np.polyfit(up[:, i], readings.values[:, i], 1)
        assert o[i] == pytest.approx(bias, abs=1e-10)
        assert s[i] == pytest.approx(9.80665 / slope, rel=1e-10)
    left = (readings.values - o) * s / 9.80665 - up
    rms = np.sqrt(np.mean((left**2).sum(axis=1)))
    said = re.search(r"parameters: ([\d.]+) mg rms", texts(exported)[0])[1]
    assert float(said) == pytest.approx(1e3 * rms, abs=0.005)  # printed to two places


def test_a_diagonal_calibration_loses_nothing():
    readings, _ = session()
    cal = mp.fit(readings, model="1 + own")
    exported = export(cal, "px4", device_id=1310988)
    assert texts(exported) == ()
    found = parameters(exported.text)
    assert found["CAL_ACC0_XOFF"] == pytest.approx(cal["ax", "1"].value)
    assert found["CAL_ACC0_ZSCALE"] == pytest.approx(9.80665 / cal["az", "z"].value)


def test_force_is_turned_for_consumers():
    readings, up = session()
    gravity = mp.fit(mp.Readings(readings.values, up=-up, unit="m/s^2"), convention="gravity")
    same = mp.fit(mp.Readings(readings.values, up=-up, unit="m/s^2"))
    one, two = (export(cal, "ros-imu-calib") for cal in (gravity, same))
    assert "that of specific force" in texts(one)[0]
    lines = [line for line in one.text.splitlines() if line.startswith("SM")]
    other = [line for line in two.text.splitlines() if line.startswith("SM")]
    np.testing.assert_allclose(json.loads(lines[0][4:]), json.loads(other[0][4:]), rtol=1e-9)


def test_arducopter_limits_are_named():
    up = mp.read_scheme("faces-6").up
    cal = exactly(mp.Readings(9.8 * up + 5.0, up=up, unit="m/s^2"), model="1 + own")
    (note,) = texts(export(cal, "ardupilot", device_id=2753036))
    assert "INS_ACCOFFS_X, INS_ACCOFFS_Y, INS_ACCOFFS_Z exceed what ArduPilot accepts" in note


# --- read back


@pytest.mark.parametrize("target", ["ros-imu-calib", "px4", "ardupilot", "kalibr", "imucal"])
def test_what_export_prints_is_what_the_consumer_is_off(target, tmp_path):
    readings, up = session()
    cal = exactly(readings)
    exported = export(cal, target, allow_lossy=True)
    exported.save(tmp_path / "file")
    force = read_back(tmp_path / "file", cal).residuals + up
    left = np.abs(force - cal.compensate(readings.values)).max()
    assert exported.difference == pytest.approx(left, rel=1e-6, abs=1e-12)
    full = target in ("ros-imu-calib", "kalibr", "imucal")
    said = "less than 1e-12 g." if full else "at most "
    assert exported.residual.startswith(f"It differs from the calibration by {said}")


def test_c_in_floating_point_is_held_by_its_self_test(tmp_path):
    cal = made(*SENSORS["linear"])
    assert export(cal, "c").difference is None
    assert export(cal, "c").residual == ""


# --- bad input


@pytest.mark.parametrize(
    ("case", "options", "status", "message"),
    [
        ("linear", ["--to", "c", "--name", "1st"], 2, "is no C identifier"),
        ("linear", ["--to", "c", "--name", "a b"], 2, "is no C identifier"),
        ("linear", ["--to", "c", "--name", "é"], 2, "is no C identifier"),
        ("linear", ["--to", "matlab"], 2, "--to takes c, ros-imu-calib, px4, ardupilot"),
        ("linear", ["--to", "ros-imu-calib", "--float"], 2, "--float is for --to c"),
        ("linear", ["--to", "px4"], 1, "--nominal BIAS,SCALE"),
        ("temperature", ["--to", "px4", "--allow-lossy"], 1, "--nominal BIAS,SCALE"),
        ("temperature", ["--to", "inav", "--allow-lossy"], 1, "has no such input"),
        ("linear", ["--to", "c", "--instance", "1"], 2, "--instance is for --to px4, ardupilot"),
        ("linear", ["--to", "px4", "--output-unit", "g"], 2, "--output-unit is for --to c"),
        ("linear", ["--to", "c", "--output-unit", "gal"], 2, "takes g or m/s^2, got 'gal'"),
        ("linear", ["--to", "px4", "--stability", "s.json"], 2, "--stability is for --to kalibr"),
        ("linear", ["--to", "px4", "--device-id", "x"], 2, "'x' is no whole number"),
        ("temperature", ["--to", "ros-imu-calib"], 1, "uses column 'temperature'"),
        ("own-quadratic", ["--to", "ros-imu-calib"], 1, "accept it with --allow-lossy"),
        ("linear, two axes", ["--to", "ardupilot"], 1, "takes three outputs"),
    ],
)
def test_bad_exports(case, options, status, message, tmp_path, capsys):
    formula, axes, size, bias = SENSORS[case]
    made(formula, axes, size, bias, unit=50.0).save(tmp_path / "cal.json")
    out = tmp_path / "out.c"
    assert main(["export", str(tmp_path / "cal.json"), *options, "-o", str(out)]) == status
    printed, error = capsys.readouterr()
    assert printed == ""
    assert error.splitlines()[-1].startswith("multipos: error: ")
    assert message in error.splitlines()[-1]
    assert sorted(each.name for each in tmp_path.iterdir()) == ["cal.json"]


def test_a_temperature_of_another_name_is_to_be_renamed():
    up = np.vstack([mp.read_scheme("faces-6").up] * 2)
    warm = {"Temp": np.repeat([20.0, 40.0], 6)}
    readings = mp.Readings(9.8 * up, unit="m/s^2", up=up, environment=warm)
    cal = mp.fit(readings, model="1 + x + y + z + Temp", reading_sd=1e-3)
    with pytest.raises(mp.MultiposError, match="px4 takes 'temperature' alone; name a temperature"):
        export(cal, "px4")


def test_export_needs_a_file(tmp_path, capsys):
    made(*SENSORS["linear"]).save(tmp_path / "cal.json")
    assert main(["export", str(tmp_path / "cal.json"), "--to", "c"]) == 2
    assert "-o FILE" in capsys.readouterr().err


def test_the_real_session_reaches_c(tmp_path, capsys):
    if shutil.which("cc") is None:
        pytest.skip("no cc on this machine")
    path = shared("ferraris_session.csv")
    readings, cal, code = tmp_path / "r.csv", tmp_path / "cal.json", tmp_path / "accel.c"
    outputs = "acc_x,acc_y,acc_z"
    for argv in (
        [
            "average",
            path,
            "--outputs",
            outputs,
            "--rate",
            "102.4",
            "--scheme",
            "faces-6",
            "-o",
            readings,
        ],
        ["fit", readings, "--unit", "m/s^2", "-o", cal],
        ["export", cal, "--to", "c", "-o", code],
    ):
        assert main([*map(str, argv)]) == 0
    assert read_back(code, mp.load(cal)).difference < 1e-12


@pytest.mark.parametrize("of_export", [False, True])
def test_counts_reach_an_autopilot_by_its_drivers_conversion(of_export, tmp_path):
    # ±2 g over 2^16 counts: the driver makes (counts - 100)/16384 g of a reading. A reading of
    # 1.01 g and -0.01 g on an axis is an offset of 0, a scale of 1/1.01 about it.
    bias, gain = np.array([164.0, -82.0, 33.0]), np.array([1.01, 0.99, 1.02]) * 16384
    up = mp.read_scheme("faces-corners-14").up
    rng = np.random.default_rng(1)
    table = dict(zip(("up_x", "up_y", "up_z"), up.T, strict=True))
    counts = 100 + bias + gain * up + rng.normal(scale=1.0, size=up.shape)
    table |= dict(zip(("ax", "ay", "az"), counts.T, strict=True))
    mp.write_table(tmp_path / "in.csv", table)
    cal, out = str(tmp_path / "cal.json"), tmp_path / "out.params"
    stated = ["--nominal", "100,16384"]
    fit = ["fit", str(tmp_path / "in.csv"), "--model", "1 + own", "--unit", "count", "-o", cal]
    assert main(fit + ([] if of_export else stated)) == 0
    export_it = ["export", cal, "--to", "px4", "-o", str(out)]
    if not of_export:  # a sensor of 1 % misalignment loses it, which is said
        table |= {"ax": table["ax"] + 164.0 * up[:, 1]}
        lossy = mp.export(
            mp.fit(table, unit="count", nominal=(100, 16384)), "px4", allow_lossy=True
        )
        assert "CAL_ACC0_XOFF" in lossy.text
        said = {each.code: str(each) for each in lossy.findings}
        left = re.fullmatch(
            r"Residual error with the PX4 parameters: (\S+) mg rms "
            r"\(uncalibrated: (\S+) mg, full model: 0\.0\d mg\)\.",
            said["lossy"],
        )
        expected = 10.0 / np.sqrt(3)  # 10 mg times the rms of up_y over the positions
        assert float(left[1]) == pytest.approx(expected, rel=0.1)
        # bias, scale errors of 1, -1, 2 % and the misalignment, all square to these positions
        offset = float(bias @ bias) / 16384**2
        before = 1e3 * np.sqrt(offset + (1e-4 + 1e-4 + 4e-4 + 1e-4) / 3)
        assert float(left[2]) == pytest.approx(before, rel=0.02)
        missing = "CAL_ACC0_ID is missing; PX4 will ignore the file. Add --device-id."
        assert said["no-device-id"] == missing
    assert main(export_it + (stated if of_export else [])) == 0
    rows = [line.split() for line in out.read_text().splitlines() if line[0] != "#"]
    values = [float(row[3]) for row in rows]
    np.testing.assert_allclose(values[:3], bias / 16384 * 9.80665, atol=2e-3)
    np.testing.assert_allclose(values[3:], 16384 / gain, atol=2e-4)
    assert read_back(out, mp.load(cal)).difference < 1e-6
    # the same in the words of a data sheet; inav keeps counts
    words = ["--full-scale", "2", "--bits", "16", "-o", str(tmp_path / "o.txt")]
    assert main(["export", cal, "--to", "inav", *words]) == 0
    text = (tmp_path / "o.txt").read_text()
    assert "# 1G = 16384 counts" in text
    if not of_export:  # the driver takes the nominal bias away: its raw values begin at 100
        assert main(["export", cal, "--to", "inav", "-o", str(tmp_path / "p.txt")]) == 0
        text = (tmp_path / "p.txt").read_text()
        zeros = [int(value) for value in re.findall(r"^set acczero_. = (\S+)", text, re.MULTILINE)]
        np.testing.assert_allclose(zeros, bias, atol=2)
        assert read_back(tmp_path / "p.txt", mp.load(cal)).difference < 1e-3
    assert main(["export", cal, "--to", "inav", *words, "--nominal", "0,1"]) == 2


@pytest.mark.parametrize("sd", [0.0, 3.0])
def test_the_error_of_a_target_has_no_hand_placement_in_it(sd):
    # of 2 mg/g misalignment and non-orthogonality PX4 leaves both where positions are known;
    # where they are not, the turn of all of them with the hand's mean error is not its own
    rng = np.random.default_rng(5)
    up = mp.read_scheme("fibonacci-24").up
    said, true = [], []
    for _ in range(8):
        cross = 2e-3 * rng.standard_normal((3, 3)) * (1.0 - np.eye(3))
        turn = np.radians(sd) * rng.standard_normal(up.shape)
        stood = np.array([rotation_matrix(t) @ each for t, each in zip(turn, up, strict=True)])
        y = stood @ (np.eye(3) + cross).T + 1e-4 * rng.standard_normal(up.shape)
        options = {"orientation_sd": sd} if sd else {}
        cal = mp.fit(mp.Readings(y, up=up, unit="g"), **options)
        said.append(1e3 * reduce_to(cal, "1 + own", "px4", allow_lossy=True).rms)
        text = str(mp.export(cal, "px4", allow_lossy=True).findings[0])
        shown, before = map(float, re.findall(r"([0-9.]+) mg(?= rms|, full)", text))
        assert shown == pytest.approx(said[-1], abs=0.005)
        assert ("a rotation that hand positioning hides" in text) == (sd > 0.0)
        assert before == pytest.approx(shown, abs=0.2)  # there is neither bias nor scale error
        left = cross if not sd else (cross + cross.T) / 2.0  # without its rotation
        true.append(1e3 * np.sqrt(np.mean(np.sum((up @ left.T) ** 2, axis=1))))
    assert np.median(np.array(said) / true) == pytest.approx(1.0, abs=0.15)


SIZES = {"mg": 1e-3, "µg": 1e-6, "1": 1.0, "ppm": 1e-6, "mg/°C": 1e-3, "µg/°C": 1e-6}


def test_a_number_is_the_same_in_python_json_c_and_on_pages(tmp_path, capsys):
    """To the last digit in files and tables, rounded in C, to the digits of u where people read."""
    rng = np.random.default_rng(3)
    up = np.tile(mp.read_scheme("faces-corners-14").up, (3, 1))
    temperature = np.repeat([20.0, 30.0, 40.0], 14)
    matrix = np.array([[1.01, 0.003, 0.0], [0.008, 0.99, 0.0], [-0.005, 0.006, 1.02]])
    values = up @ matrix.T + [0.03, -0.02, 0.05] + 1e-4 * (temperature - 30.0)[:, None]
    values += 3e-4 * rng.standard_normal(values.shape)
    table = dict(zip(("up_x", "up_y", "up_z"), up.T, strict=True)) | {"temperature": temperature}
    table |= dict(zip(("ax", "ay", "az"), values.T, strict=True))
    source, kept = tmp_path / "in.csv", tmp_path / "cal.json"
    mp.write_table(source, table)
    formula = "1 + x + y + z + temperature"
    cal = mp.fit(source, unit="g", model=formula)

    assert main(["fit", str(source), "--unit", "g", "--model", formula, "-o", str(kept)]) == 0
    screen = capsys.readouterr().out
    stored = {each["name"]: each for each in json.loads(kept.read_text("utf-8"))["parameters"]}
    many = mp.fit_many(table | {"unit": ["A"] * len(up)}, unit="g", model=formula)
    for p in cal.entries:
        held = stored[p.name]
        assert [held[k] for k in ("value", "u", "U", "unit")] == [p.value, p.u, p.U, p.unit]
        np.testing.assert_allclose(many[p.name][0], p.value, rtol=0, atol=1e-9 * p.u)
        np.testing.assert_allclose(many[f"u_{p.name}"][0], p.u, rtol=1e-9)

    pages = {}
    for ending in ("md", "html"):
        assert main(["report", str(kept), "-o", str(tmp_path / f"r.{ending}")]) == 0
        pages[ending] = (tmp_path / f"r.{ending}").read_text("utf-8")
        pages[ending] = pages[ending].replace("−", "-").replace("\u2007", "").replace("\u2008", "")
    for p in cal.entries:
        name = re.escape(p.name)
        row = re.search(rf"^{name} +(\S+) +(\S+?)\((\d+)\) +(\S+)", screen, re.MULTILINE)
        unit, value, u, U = row.groups()
        size, decimals = SIZES[unit], len(value.partition(".")[2])
        assert 10 <= int(u) <= 99
        assert value == f"{p.value / size:.{decimals}f}"
        assert int(u) == round(p.u / size * 10**decimals)
        assert f"{p.U / size:.{decimals}f}" == U
        cells = re.search(rf"^\| {name} \| (.+) \|$", pages["md"], re.MULTILINE)[1].split(" | ")
        assert (cells[1], cells[3], cells[4]) == (value, U, unit)
        place = pages["html"].index(f">{p.name}</th>")
        cells = re.findall(r'data-of="\w+">([^<]*)</td>', pages["html"][place:])[:5]
        assert (cells[1], cells[3], cells[4]) == (value, U, unit)

    rows = np.column_stack([values, temperature])
    found = run_c("gcc", cal, export(cal, "c", name="imu"), rows, tmp_path)
    stated = np.array([stored[p.name]["value"] for p in cal.entries]).reshape(3, 5)
    raw = values - stated[:, 0] - temperature[:, None] * stated[:, 4]
    by_hand = np.linalg.solve(stated[:, 1:4], raw.T).T
    np.testing.assert_allclose(found, by_hand, rtol=0, atol=1e-14)


@pytest.mark.parametrize("to", ["px4", "imucal", "c"])
def test_a_calibration_whose_rms_is_no_number_is_not_exported(to):
    # of y = f + f^2 the reading at f < -1/2 is that of another f: the inverse leaves the branch
    up = mp.read_scheme("fibonacci-24").up
    noise = 1e-3 * np.random.default_rng(0).standard_normal(up.shape)
    cal = mp.fit(mp.Readings(up + up**2 + noise, up=up, unit="g"), model="own-quadratic")
    assert np.isnan(cal.rms)
    with pytest.raises(mp.MultiposError, match="no force from its own readings; drop terms"):
        export(cal, to, allow_lossy=to != "c")


def test_how_many_steps_by_hand():
    """2 · .02 · 2 g = .08 a step at most; at 4/3 g and at -4/3 g step by step to 1e-13 g."""
    up = mp.read_scheme("faces-6").up
    cal = mp.fit(mp.Readings(up + 0.02 * up**2, up=up), model="1 + x + y + z + own^2")
    steps, rho = needed_steps(cal, cal.sensitivity, single=False)
    needed = 0
    for true in (4.0 / 3.0, -4.0 / 3.0):
        f = [0.0]
        while abs(f[-1] - true) > 1e-13:
            f.append(true + 0.02 * true**2 - 0.02 * f[-1] ** 2)
        needed = max(needed, len(f) - 1)
    assert (steps, rho) == (needed, pytest.approx(0.08, rel=1e-9))


@pytest.mark.parametrize(
    ("size", "how", "metres"),
    [
        (9.8, {"unit": "m/s^2"}, 1.0),
        (1.0, {"unit": "g"}, 9.80665),
        (4096.0, {"unit": "count", "nominal": (3.0, 4096.0)}, 9.80665 / 4096.0),
        (5.0, {}, 1.0),  # not stated, but within two of 9.80665
        (19.0, {}, 1.0),
        (4.8, {}, None),
        (20.0, {}, None),
        (9.8, {"unit": "V"}, None),
    ],
)
def test_the_metres_of_a_unit_of_the_readings(size, how, metres):
    up = mp.read_scheme("faces-6").up
    nominal = how.get("nominal")
    found = mp.fit(mp.Readings(size * up, up=up, unit=how.get("unit", "reading")), nominal=nominal)
    if metres is None:
        with pytest.raises(mp.MultiposError, match="state the driver's conversion"):
            in_metres(found, "px4")
    else:
        assert in_metres(found, "px4") == pytest.approx(metres, rel=1e-12)
    assert raw_zero(found) == (3.0 if nominal else 0.0)


def test_sensitivities_next_to_nothing_have_no_inverse():
    cal = made(*SENSORS["linear"])
    parameters = cal.parameters.copy()
    parameters[cal.model.slices[-1]] *= 1e-300
    with pytest.raises(mp.MultiposError, match="an output does not sense its axis"):
        reduce_to(replace(cal, parameters=parameters), "1 + x + y + z", "px4", allow_lossy=True)


@pytest.mark.parametrize(
    ("scale", "how", "counts"),
    [(1450.0, {}, 1365), (5700.0, {}, 4096), (5900.0, {}, 8192), (101.0, {}, 256),
     (99.0, {}, None), (2000.0, {"nominal": (3.0, -2047.6)}, 2048)],
)  # fmt: skip
def test_the_counts_of_a_g_of_a_flight_controller(scale, how, counts):
    """The nearest in ratio: 5793 lies between 4096 and 8192. Zero and gain are whole."""
    up = mp.read_scheme("faces-6").up
    found = mp.fit(mp.Readings(scale * up, up=up, unit="count"), **how)
    found = replace(found, reference=1.3 * found.reference)  # of a centrifuge
    if counts is None:
        with pytest.raises(mp.MultiposError, match="scale factor of 99 per g"):
            _counts_of_g(found)
        return
    assert _counts_of_g(found) == counts
    law = Correction(np.diag([0.97, 1.0, 1.02]) * 9.80665 / counts, np.array([-3.4, 0.6, 8.0]))
    held = _rounded_for_inav(found, law)
    assert held.offset.tolist() == [-3.0, 1.0, 8.0]
    steps = 4096 * counts * np.diag(held.matrix) / 9.80665
    np.testing.assert_allclose(steps, [3973.0, 4096.0, 4178.0], rtol=1e-12)
