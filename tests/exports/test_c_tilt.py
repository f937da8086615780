"""The C function of tilt: the angles of `apply --tilt`, compiled and run, and its comment."""

import re
import shutil
import subprocess

import numpy as np
import pytest
from numpy.testing import assert_allclose

import multipos as mp
from multipos.cli import main
from multipos.errors import UsageError
from multipos.sensor.tilt import beyond_vertical

UP = mp.read_scheme("dual-axis-48").up
MATRIX = np.array([[1.2, 0.01, 0.02], [0.015, 1.1, 0.03], [0.0, -0.02, 1.0]])
KINDS = [
    (3, "own-quadratic", "specific-force", {}),
    (2, "linear", "specific-force", {}),
    (2, "1 + x + y + z + own^2 + own*z", "gravity", {"output_unit": "m/s^2"}),
    (2, "1 + x + y", "specific-force", {"float": True}),
    (1, "1 + x + x^2", "specific-force", {}),
    (2, "each = b + s*x + c*y + d*tanh(z) + k*own*z", "gravity", {"output_unit": "m/s^2"}),
    (2, "each = b + s*x + c*y + d*z", "specific-force", {"float": True}),
    (2, "each = b + s*x + c*y + k*own^2", "specific-force", {}),
]


def calibrated(outputs, model, convention):
    sign = -1.0 if convention == "gravity" else 1.0
    values = 2.5 + sign * (UP @ MATRIX.T)[:, :outputs] + 1e-3 * UP[:, :outputs] ** 2
    values += 1e-4 * np.random.default_rng(1).standard_normal(values.shape)
    names = ("ax", "ay", "az")[:outputs]
    inputs = "x" if outputs == 1 else "x,y,z"
    readings = mp.Readings(values, up=UP, outputs=names, unit="V")
    return mp.fit(readings, model=model, convention=convention, inputs=inputs)


def angles_by_c(tmp_path, cal, exported, raw):
    """Run NAME_tilt on rows that a program of its own reads, as text."""
    axes, kind = raw.shape[1], "float" if "const float raw" in exported.text else "double"
    (tmp_path / "t.c").write_text(exported.text)
    (tmp_path / "main.c").write_text(
        "#include <stdio.h>\n"
        f"void multipos_tilt(const {kind} raw[{axes}], {kind} tilt_deg[{axes}]);\n"
        f"int main(void) {{ double in; {kind} raw[{axes}], out[{axes}]; for (;;) {{\n"
        f'for (int i = 0; i < {axes}; ++i) {{ if (scanf("%lf", &in) != 1) return 0; '
        f"raw[i] = ({kind})in; }}\n"
        "multipos_tilt(raw, out);\n"
        f'for (int i = 0; i < {axes}; ++i) printf("%.17g ", (double)out[i]); }} }}\n'
    )
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
    sources = [str(tmp_path / "t.c"), str(tmp_path / "main.c")]
    program = str(tmp_path / "t")
    subprocess.run(["cc", *flags, *sources, "-lm", "-o", program], check=True)
    text = "\n".join(" ".join(map(repr, row)) for row in raw.tolist())
    said = subprocess.run([program], input=text, capture_output=True, text=True, check=True)
    return np.array(said.stdout.split(), dtype=float).reshape(-1, axes)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no cc on this machine")
@pytest.mark.parametrize(("outputs", "model", "convention", "options"), KINDS)
def test_c_tells_the_angles_of_apply(tmp_path, outputs, model, convention, options):
    # eq. (1) of exports.target_c
    cal = calibrated(outputs, model, convention)
    exported = mp.export(cal, "c", tilt=True, **options)
    size = np.array([0.99, 1.0, 1.0 + 0.5 * beyond_vertical(cal)[0], 1.2])
    sign = -1.0 if convention == "gravity" else 1.0
    beyond = 2.5 + sign * MATRIX[0, 0] * np.append(size, -size)  # upright and upside down
    raw = np.vstack([cal.readings.values, np.full((8, outputs), 2.5)])
    raw[48:, 0] = beyond
    if options.get("float"):
        raw = raw.astype(np.float32).astype(float)
    found = angles_by_c(tmp_path, cal, exported, raw)
    table = mp.apply(cal, dict(zip(cal.outputs, raw.T, strict=True)), tilt=True)
    should = np.column_stack([table[f"tilt_{axis}_deg"] for axis in "xyz"[:outputs]])
    assert (np.isnan(found) == np.isnan(should)).all()
    assert np.isnan(found).any() == (outputs < 3)
    # of the sine, as the arcsine has no slope at the vertical: rounding of a force of 1 g
    tolerance = 2e-6 if options.get("float") else 1e-12
    kept = ~np.isnan(should)
    sines = [np.sin(np.radians(angles[kept])) for angles in (found, should)]
    assert_allclose(sines[0], sines[1], rtol=0, atol=tolerance)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no cc on this machine")
@pytest.mark.parametrize("off", ["0.01", "-0.01"])
def test_the_self_test_sees_an_angle_that_is_off_either_way(tmp_path, off):
    exported = mp.export(calibrated(2, "linear", "specific-force"), "c", tilt=True)
    exported.save(tmp_path / "cal.c")
    text = exported.text.replace("seen0 ? ", f"seen0 ? {off} + ")
    (tmp_path / "cal.c").write_text(text)
    program, sources = str(tmp_path / "t"), [str(tmp_path / "cal.c"), str(tmp_path / "cal_test.c")]
    subprocess.run(["cc", "-std=c99", *sources, "-lm", "-o", program], check=True)
    done = subprocess.run([program], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "axis 1" in done.stdout


def test_how_far_beyond_one_g_still_counts_is_one_number_an_axis():
    cal = calibrated(2, "linear", "specific-force")
    room = beyond_vertical(cal)
    text = mp.export(cal, "c", tilt=True).text
    said = re.search(r"beyond 1 g by more than x (\S+) g, y (\S+) g", text)
    assert_allclose([float(each) for each in said.groups()], room, rtol=1e-8)
    # by hand: U of the force along x, upright, from parameters and one reading
    inverse = np.linalg.inv(
        [[cal["ax", "x"].value, cal["ax", "y"].value], [cal["ay", "x"].value, cal["ay", "y"].value]]
    )
    leak = inverse @ [cal["ax", "z"].value, cal["ay", "z"].value]  # of the unseen component
    noise = np.hypot(*(inverse[0] * cal.residual_sd))
    # eq. (4) of `tilt` at the vertical; the parameters of 48 readings add some 3/48 of the variance
    assert_allclose(room[0], 2.0 * np.hypot(noise, 2.0 * leak[0] ** 2), rtol=0.1)


def test_the_command_writes_tilt(tmp_path, capsys):
    cal = calibrated(2, "linear", "specific-force")
    cal.save(tmp_path / "cal.json")
    files = str(tmp_path / "cal.json"), str(tmp_path / "t.c")
    assert main(["export", files[0], "--to", "c", "--tilt", "-o", files[1]]) == 0
    assert "void multipos_tilt(const double raw[2], double tilt_deg[2])" in (
        (tmp_path / "t.c").read_text()
    )
    assert main(["export", files[0], "--to", "px4", "--tilt", "-o", files[1]]) == 2
    assert "--tilt is for --to c" in capsys.readouterr().err
    with pytest.raises(UsageError, match="--tilt is for --to c"):
        mp.export(cal, "ros-imu-calib", tilt=True)
