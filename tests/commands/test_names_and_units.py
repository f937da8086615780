"""Names of columns in letters of any case, and units behind them, for every command."""

import numpy as np
import pytest
from cli_bench import run

import multipos as mp

UP = mp.read_scheme("faces-corners-14").up
G = 9.80665
SCHEME = ("--scheme", "faces-corners-14")


def write(path, columns):
    mp.write_table(path, columns)
    return path


def readings(names=("ax", "ay", "az"), size=1.0, noise=1e-4):
    rng = np.random.default_rng(4)
    y = size * (1.01 * UP + 0.02 + noise * rng.standard_normal(UP.shape))
    return {"position": np.arange(1, 15), **dict(zip(names, y.T, strict=True))}


@pytest.fixture(scope="module")
def calibrations(tmp_path_factory):
    folder = tmp_path_factory.mktemp("names")
    for name, size, unit in (("g", 1.0, "g"), ("m", G, "m/s^2")):
        table = readings(size=size)
        mp.fit(table, scheme="faces-corners-14", unit=unit).save(folder / f"{name}.json")
    return folder


@pytest.mark.parametrize(
    ("names", "size", "unit", "status"),
    [
        (("AX", "AY", "AZ"), 1.0, "g", 0),
        (("Ax", "Ay", "Az"), G, "m", 0),
        (("AX (m/s^2)", "AY (m/s^2)", "AZ (m/s^2)"), G, "m", 0),
        (("AX (m/s^2)", "AY (m/s^2)", "AZ (m/s^2)"), G, "g", 1),
        (("ax [g]", "ay [g]", "az [g]"), 1.0, "m", 1),
    ],
)
def test_apply_and_check_read_names_of_any_case_and_refuse_other_units(
    names, size, unit, status, calibrations, tmp_path, capsys
):
    path = write(tmp_path / "in.csv", readings(names, size))
    cal = calibrations / f"{unit}.json"
    out = tmp_path / "out.csv"
    assert run(capsys, "apply", cal, path, "-o", out)[0] == status
    assert run(capsys, "check", cal, path, *SCHEME)[0] == status
    noise = 1e-4 * np.random.default_rng(3).standard_normal((3, 300))
    static = dict(zip(names, size * (np.array([[0.0], [0.0], [1.0]]) + noise), strict=True))
    static = {"time": np.arange(300.0), **static}
    still = write(tmp_path / "still.csv", static)
    assert run(capsys, "stability", still, "--calibration", cal)[0] == status
    if status == 0:
        header = out.read_text().splitlines()[0]
        assert header.startswith(",".join(["position", *names]))  # as it was given
        force = mp.apply(mp.load(cal), readings(names, size))
        found = np.column_stack([force[f"f_{axis}"] for axis in "xyz"])
        np.testing.assert_allclose(found, UP, atol=1e-3)


def test_a_record_in_another_unit_than_the_calibration_is_refused(calibrations, tmp_path, capsys):
    # noise of a record in m/s² by a calibration in g would be ten times too large, or too small
    rng = np.random.default_rng(1)
    for unit, size in (("g", G), ("m", 1.0)):
        y = size * (np.array([0.0, 0.0, 1.0]) + 1e-4 * rng.standard_normal((2000, 3)))
        table = {"time": np.arange(2000.0), **dict(zip(("ax", "ay", "az"), y.T, strict=True))}
        path = write(tmp_path / "still.csv", table)
        status, _, err = run(
            capsys, "stability", path, "--calibration", calibrations / f"{unit}.json"
        )
        assert status == 1
        assert "at rest, where 1 g is meant" in err


@pytest.mark.parametrize(
    ("names", "size"),
    [
        (("F_X", "F_Y", "F_Z"), 1.0),
        (("F_X", "fy", "f_z"), 1.0),
        (("f_x [m/s^2]", "f_y [m/s^2]", "f_z [m/s^2]"), G),
        (("fx (mg)", "fy (mg)", "fz (mg)"), 1e3),
    ],
)
def test_known_forces_of_any_name_and_unit(names, size, tmp_path):
    force = 3.0 * UP
    table = dict(zip(names, (size * force).T, strict=True))
    y = 1.01 * force + 0.02
    table |= dict(zip(("ax", "ay", "az"), y.T, strict=True))
    cal = mp.fit(table, unit="g")
    np.testing.assert_allclose(cal["bias_ax"].value, 0.02, atol=1e-9)
    np.testing.assert_allclose(cal["scale_az"].value, 1.01, atol=1e-9)
    scheme = {"position": np.arange(1, 15), **dict(zip(names[:3], (size * UP).T, strict=True))}
    if names[0].startswith("f_x"):
        np.testing.assert_allclose(mp.read_scheme(scheme).force, UP, atol=1e-12)


@pytest.mark.parametrize(("unit", "factor"), [("deg", 180.0 / np.pi), ("rad", 1.0)])
def test_angles_in_the_unit_of_their_header(unit, factor):
    roll, pitch = np.arctan2(-UP[:, 1], -UP[:, 2]), np.arcsin(UP[:, 0])
    table = {f"Roll [{unit}]": factor * roll, f"Pitch [{unit}]": factor * pitch, **readings()}
    found = mp.fit(table, unit="g")
    np.testing.assert_allclose(found.readings.up, UP, atol=1e-12)


@pytest.mark.parametrize(
    ("names", "zero"),
    [
        (("Temperature", "BIAS"), 0.0),
        (("temperature [°C]", "bias [g]"), 0.0),
        (("TEMPERATURE [K]", "bias"), 273.15),
    ],
)
def test_regressions_read_names_of_any_case_and_kelvin(names, zero):
    T = np.linspace(-10.0, 50.0, 80)
    bias = 1e-3 * T + 1e-5 * np.random.default_rng(2).standard_normal(80)
    plain, other = {"temperature": T, "bias": bias}, {names[0]: T + zero, names[1]: bias}
    how = {"response": "bias", "variables": "temperature"}
    first, second = mp.regress(plain, **how), mp.regress(other, **how)
    one, two = (each.to_dict()["segments"][0]["terms"] for each in (first, second))
    np.testing.assert_allclose([t["value"] for t in two], [t["value"] for t in one], rtol=1e-9)
    left = mp.correct(first, other)
    assert list(left)[:2] == list(names)
    np.testing.assert_allclose(left["corrected"], mp.correct(first, plain)["corrected"], atol=1e-15)
    assert (
        mp.check(first, other).to_dict()["findings"] == mp.check(first, plain).to_dict()["findings"]
    )
