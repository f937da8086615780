"""Units in headers: what is read in them, what they refuse, and what is no output by them."""

import numpy as np
import pytest
from findings_bench import texts
from numpy.testing import assert_allclose

import multipos as mp
from multipos.cli import main
from multipos.errors import MultiposError
from multipos.units import STANDARD_GRAVITY

UP = mp.read_scheme("faces-corners-14").up
HEADED = {
    f"{name} (m/s^2)": STANDARD_GRAVITY * UP[:, i] for i, name in enumerate(("ax", "ay", "az"))
}
LISTED = {f"up_{axis}": UP[:, i] for i, axis in enumerate("xyz")}


def written(path, columns):
    rows = zip(*(np.asarray(column).tolist() for column in columns.values()), strict=True)
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return str(path)


@pytest.fixture(scope="module")
def calibration():
    return mp.fit(HEADED | LISTED)


def test_headers_with_units_are_read_wherever_data_are(calibration, tmp_path, capsys):
    assert calibration.model.unit == "m/s^2"
    found = mp.apply(calibration, HEADED)
    assert list(found)[:4] == [*HEADED, "f_x"]
    assert_allclose(np.column_stack([found.f_x, found.f_y, found.f_z]), UP, rtol=0, atol=1e-12)
    calibration.save(tmp_path / "cal.json")
    assert main(["apply", str(tmp_path / "cal.json"), written(tmp_path / "d.csv", HEADED)]) == 0
    assert capsys.readouterr().out.startswith("ax (m/s^2),ay (m/s^2),az (m/s^2),f_x")


def test_another_unit_in_the_header_is_refused(calibration, tmp_path, capsys):
    other = {name.replace("m/s^2", "g"): column for name, column in HEADED.items()}
    said = "column 'ax' in g, and the calibration is in m/s\\^2"
    with pytest.raises(MultiposError, match=said):
        mp.apply(calibration, other)
    with pytest.raises(MultiposError, match=said):
        mp.check(calibration, other | LISTED)
    calibration.save(tmp_path / "cal.json")
    assert main(["apply", str(tmp_path / "cal.json"), written(tmp_path / "d.csv", other)]) == 1
    assert "the header gives column 'ax' in g" in capsys.readouterr().err
    nameless = mp.fit({name[:2]: column for name, column in HEADED.items()} | LISTED)
    assert mp.apply(nameless, HEADED).f_x[0] == pytest.approx(1.0)  # no unit that contradicts it


def test_a_temperature_in_kelvin_is_read_in_celsius():
    # eq. (1) of positions.headers
    celsius = np.linspace(10.0, 40.0, len(UP))
    model = "1 + x + y + z + temperature"
    cold = mp.fit(HEADED | LISTED | {"temperature (K)": celsius + 273.15}, model=model)
    plain = mp.fit(HEADED | LISTED | {"temperature (degC)": celsius}, model=model)
    assert_allclose(cold.readings.environment["temperature"], celsius, rtol=0, atol=1e-12)
    assert_allclose(cold.parameters, plain.parameters, rtol=0, atol=1e-10)
    assert "273.15 was subtracted" in " ".join(texts(cold))
    assert "temperature-kelvin" not in {finding.code for finding in cold.diagnostics.findings}
    with pytest.raises(MultiposError, match=r"in K, and the calibration takes degrees Celsius"):
        mp.apply(cold, HEADED | {"temperature (K)": celsius + 273.15})


@pytest.mark.parametrize("name", ["temp (K)", "chip [degC]", "p (hPa)", "t (ms)"])
def test_a_column_of_the_surroundings_is_no_output(name):
    values = np.linspace(290.0, 300.0, len(UP))
    found = mp.fit(HEADED | LISTED | {name: values})
    assert found.outputs == ("ax", "ay", "az")
    assert f"'{name.partition(' ')[0]}' is in" in " ".join(texts(found))


def test_such_a_column_serves_a_model_that_names_it():
    values = np.linspace(290.0, 300.0, len(UP))
    found = mp.fit(HEADED | LISTED | {"temp (K)": values}, model="1 + x + y + z + temp")
    assert_allclose(found.readings.environment["temp"], values - 273.15)
    assert not any("no output" in text for text in texts(found))


@pytest.mark.parametrize("ask", [mp.fit, mp.tumble])
@pytest.mark.parametrize("outputs", [1, 2])
def test_angles_that_begin_level_are_said_and_taken(ask, outputs):
    t = np.arange(0.0, 360.0, 30.0)
    own, across = np.sin(np.radians(t)), np.cos(np.radians(t))
    noise = np.random.default_rng(4).normal(0.0, 1e-4, (2, 12))
    volts = {"Ex": 0.1 + 2.5 * own + noise[0], "Ey": 0.2 + 2.4 * across + noise[1]}
    data = {"angle": t, **dict([*volts.items()][:outputs])}
    options = {"orientation_sd": 0} if ask is mp.fit else {}
    with pytest.warns(mp.CalibrationWarning, match="follow the sine of the angle"):
        ask(data, unit="V", **options)
    level = mp.fit(data, unit="V", angle_zero="level", orientation_sd=0)
    turned = mp.fit(data | {"angle": 90.0 - t}, unit="V", orientation_sd=0)
    np.testing.assert_array_equal(level.parameters, turned.parameters)
    assert level["scale_Ex"].value == pytest.approx(2.5, rel=1e-3)
    assert not [each for each in level.findings if each.level != "note"]


def test_where_an_angle_begins_is_up_or_level_and_of_angles():
    faces = {"face": ["+x", "-x"], "ax": [1.0, -1.0]}
    with pytest.raises(mp.UsageError, match="takes up or level, got 'down'"):
        mp.read_readings(faces, angle_zero="down")
    with pytest.raises(mp.UsageError, match="of tables with a column angle_deg"):
        mp.read_readings(faces, angle_zero="level")


def test_the_side_of_approach_may_be_told_of_each_output():
    up = mp.read_scheme("fibonacci-24").up
    rng = np.random.default_rng(6)
    sides = [rng.permutation(np.repeat([-1.0, 1.0], 12)) for _ in "zx"]
    values = up + 1e-5 * rng.normal(size=up.shape)
    values[:, 2] += 5e-4 * sides[0]
    data = dict(zip(("up_x", "up_y", "up_z"), up.T, strict=True))
    data |= dict(zip(("ax", "ay", "az"), values.T, strict=True))
    found = mp.fit(data | {"approach_az": sides[0], "approach_ax": sides[1]}, unit="g")
    assert found.outputs == ("ax", "ay", "az")
    assert "hysteresis" in {each.code for each in found.findings}
