"""C in whole numbers: to the bit as Python has it, and near the calibration at every corner."""

import itertools
import re
import shutil
import subprocess
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from consumers import read_back
from numpy.testing import assert_allclose

import multipos as mp
from multipos.errors import MultiposError, UsageError
from multipos.exports import c_fixed
from multipos.exports.c_fixed import _shift, find_fixed_point, fixed_forces
from multipos.exports.target_c import fixed_source
from multipos.numerics.terms import parse_terms

UP = mp.read_scheme("fibonacci-24").up
MATRIX = np.array([[1.02, 0.01, -0.02], [-0.015, 0.98, 0.01], [0.02, 0.005, 1.01]])
compiler = shutil.which("gcc") or shutil.which("clang")
needs_compiler = pytest.mark.skipif(compiler is None, reason="no C compiler")


def calibration(model="linear", unit="count", scale=16384.0, second=5e-3):
    values = scale * (UP @ MATRIX.T + [0.02, -0.03, 0.01] + second * UP**2)
    values = np.rint(values) if unit == "count" else values
    return mp.fit(mp.Readings(values, unit=unit, up=UP), model=model)


CASES = [("linear", "count", 16384.0), ("linear", "V", 2.5), ("own-quadratic", "count", 4096.0)]
CASES += [("cross-quadratic", "V", 0.33), ("own-quadratic", "m/s^2", 9.8)]


@pytest.mark.parametrize(("model", "unit", "scale"), CASES)
def test_every_reading_of_the_range_is_within_what_the_comment_says(model, unit, scale):
    cal = calibration(model, unit, scale)
    fixed = find_fixed_point(cal)
    ends = list(zip(cal.readings.values.min(0), cal.readings.values.max(0), strict=True))
    corners = np.array(list(itertools.product(*ends)))
    raw = np.rint(corners * fixed.raw_per_unit).astype(np.int64)
    off = fixed_forces(fixed, raw) / fixed.accel_per_g - cal.compensate(raw / fixed.raw_per_unit)
    said = float(re.search(r"range: ([\d.e-]+) µg", mp.export(cal, to="c", fixed=True).text)[1])
    assert 1e6 * np.abs(off).max() <= said
    # readings of any kind within the range, of which the most that are measured have as much
    raw = fixed.whole(np.random.default_rng(9).uniform(*np.transpose(ends), (50_000, 3)))
    off = fixed_forces(fixed, raw) / fixed.accel_per_g - cal.compensate(raw / fixed.raw_per_unit)
    assert 1e6 * np.abs(off).max() <= 1.01 * said
    assert said < 2.0  # two of the last bit, 1 µg


def test_the_error_is_measured_at_corners_readings_and_between(monkeypatch):
    values = np.array([[10.0, -4.0], [2.0, 6.0], [-8.0, 1.0]])
    asked = []
    monkeypatch.setattr(c_fixed, "fixed_forces", lambda fixed, rows: 3.0 * rows)
    fixed = SimpleNamespace(
        calibration=SimpleNamespace(
            readings=SimpleNamespace(values=values),
            compensate=lambda rows: asked.append(rows) or 0.0 * rows,
        ),
        whole=lambda rows: 2.0 * rows, raw_per_unit=2.0, accel_per_g=4.0,
    )  # fmt: skip
    assert c_fixed.FixedPoint.error.func(fixed) == pytest.approx(3.0 * 2.0 * 10.0 / 4.0)
    corners = [[-8.0, -4.0], [-8.0, 6.0], [10.0, -4.0], [10.0, 6.0]]
    assert asked[0][:7].tolist() == [*corners, *values.tolist()]
    between = asked[0][7:]
    assert len(between) == 20_000
    assert_allclose(
        np.quantile(between, [0.25, 0.75], axis=0), [[-3.5, -1.5], [5.5, 3.5]], atol=0.2
    )
    monkeypatch.setattr(c_fixed, "fill", lambda file, **given: given)
    monkeypatch.setattr(c_fixed, "fixed_signature", lambda calibration, name: "")
    fixed.linear = np.eye(2)
    given = c_fixed.fixed_test(fixed, "imu")  # readings, and as far beyond each as the one before
    assert (given["count"], given["axes"]) == (6, 2)
    assert "    {56.0, -18.0},\n    {-12.0, 32.0},\n    {-36.0, -8.0}\n" in given["arrays"]


@pytest.mark.parametrize(
    ("model", "how"), [("linear", "one matrix product"), ("own-quadratic", "")]
)
def test_how_whole_numbers_are_made_is_said(model, how):
    fixed = find_fixed_point(calibration(model))
    how = how or f"{1 + fixed.steps} steps"
    assert how in fixed_source(fixed, "imu").partition("*/")[0]


@needs_compiler
@pytest.mark.parametrize(("model", "unit", "scale"), CASES)
def test_c_and_python_are_the_same_to_the_bit(model, unit, scale, tmp_path):
    # eq. (1) of exports.c_fixed
    cal = calibration(model, unit, scale)
    path = tmp_path / "imu.c"
    mp.export(cal, to="c", fixed=True, name="imu").save(path)
    assert " double" not in path.read_text("utf-8").partition("*/")[2]
    found = read_back(path, cal)
    assert found.target == "c, whole numbers"
    assert found.difference < 3e-6  # bits of the last place
    command = [compiler, "-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2"]
    command += ["-fsanitize=undefined", "-fno-sanitize-recover", "imu.c", "imu_test.c", "-o", "t"]
    subprocess.run(command, cwd=tmp_path, check=True)
    done = subprocess.run([tmp_path / "t"], capture_output=True, text=True, check=True)
    assert "all values met" in done.stdout


def test_no_reading_overflows():
    """The sums of eq. (1) in integers without a bound, for the largest readings there are."""
    # eq. (2) of exports.c_fixed
    assert [_shift(3.0, 2**30), _shift(5.0, 2**20)] == [28, 17]
    assert _shift(0.0, 2**30) == 62
    for model, unit, scale in CASES:
        fixed = find_fixed_point(calibration(model, unit, scale))
        largest = np.abs(fixed.linear).sum(axis=1).max()
        assert 2 * largest > 2**30 or 2 * np.abs(fixed.constant).max() > 2**61
        for row, c in zip(fixed.linear.tolist(), fixed.constant.tolist(), strict=True):
            assert sum(abs(v) for v in row) * 2**31 + abs(c) + 2**fixed.shift < 2**63
        for row in fixed.quadratic.tolist():
            largest = fixed.held**2 >> fixed.product_shift
            assert sum(abs(v) for v in row) * largest + 2**fixed.quadratic_shift < 2**63


def test_no_more_steps_are_taken_than_it_needs():
    """Of half the last bit at 4/3 of the force; two less are not enough for the readings."""
    cal = calibration("own-quadratic", "count", 4096.0)
    fixed = find_fixed_point(cal)
    raw = fixed.whole(cal.readings.values)
    expected = fixed.accel_per_g * cal.compensate(raw / fixed.raw_per_unit)
    for less, enough in ((0, True), (2, False)):
        found = fixed_forces(replace(fixed, steps=fixed.steps - less), raw)
        assert bool(np.abs(found - expected).max() < 2.0) is enough


def test_what_is_beyond_32_bits_is_saturated():
    fixed = find_fixed_point(calibration(scale=16.0))
    far = np.full((1, 3), 2**31 - 1)
    assert fixed_forces(fixed, far).max() == 2**31 - 1
    assert fixed_forces(fixed, -far).min() == -(2**31)


def test_the_scale_factors_are_definitions():
    counts = mp.export(calibration(), to="c", fixed=True, name="imu").text
    volts = mp.export(calibration(unit="V", scale=2.5), to="c", fixed=True, name="imu").text
    assert " * accel[3] = x, y, z [g], convention specific-force\n" in counts
    assert "#define imu_ACCEL_PER_G 1000000\n" in counts
    assert "RAW_PER_UNIT" not in counts.partition("*/")[2]
    assert "#define imu_RAW_PER_UNIT 100000000\n" in volts
    assert "void imu_compensate(const int32_t raw[3], int32_t accel[3])" in volts


def test_other_models_and_options_are_refused():
    with pytest.raises(MultiposError, match="linear and quadratic models"):
        mp.export(calibration("own-cubic"), to="c", fixed=True)
    with pytest.raises(MultiposError, match="linear and quadratic models"):
        mp.export(calibration("each = b + s*own"), to="c", fixed=True)
    with pytest.raises(UsageError, match="--fixed"):
        mp.export(calibration(), to="c", fixed=True, float=True)
    with pytest.raises(UsageError, match="--fixed is for --to c"):
        mp.export(calibration(), to="px4", fixed=True)


@pytest.mark.parametrize(
    ("terms", "outputs", "fits"),
    [("1 + x + y", 2, True), ("1 + x + y*z", 3, True), ("1 + x + y^2", 2, False),
     ("1 + x^3", 3, False), ("1 + x*y^2", 3, False), ("1 + x*|x|", 3, False), ("1 + t", 3, False)],
)  # fmt: skip
def test_second_degree_needs_as_many_outputs_as_axes(terms, outputs, fits):
    basis = parse_terms(terms)
    model = SimpleNamespace(has_terms=True, environment=(), basis_terms=basis, text=terms)
    c = SimpleNamespace(model=model, outputs="abc"[:outputs])
    if fits:
        c_fixed._require_quadratic(c, [0, 1, 2])
        return
    with pytest.raises(MultiposError, match="--fixed writes linear and quadratic models"):
        c_fixed._require_quadratic(c, [0, 1, 2])


def test_single_precision_takes_no_step_that_it_cannot_hold():
    cal = calibration("own-quadratic", "V", 2.5)
    steps = {
        float_: int(re.search(r"step < (\d+)", mp.export(cal, to="c", float=float_).text)[1])
        for float_ in (False, True)
    }
    assert steps[True] <= 4 < steps[False]
