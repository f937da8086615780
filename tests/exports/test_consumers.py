"""Files of autopilots and other consumers, each through the consumer's own law written out here."""

import json
import re
import shutil

import numpy as np
import pytest
from cli_bench import run
from consumers import read_back
from findings_bench import texts

import multipos as mp
from multipos.exports.laws import Drift

G = 9.80665
UP = mp.read_scheme("faces-corners-14").up
K = np.array([[9.9, 0.1, -0.2], [0.05, 9.7, 0.15], [-0.1, 0.2, 10.1]])
OFFSET = np.array([0.3, -0.2, 0.15])
# Of the offset, about 0 °C: first to third power, a row each.
SLOPES = np.array([[4e-3, -3e-3, 2e-3], [5e-5, -2e-5, 4e-5], [-4e-7, 6e-7, 2e-7]])
AT = np.linspace(-5.0, 55.0, 5)


def fitted(unit="m/s^2", scale=1.0, model="linear", noise=1e-5):
    values = UP @ K.T + OFFSET
    values = scale * (values + noise * np.random.default_rng(1).normal(size=values.shape))
    return mp.fit(mp.Readings(values, up=UP, unit=unit), model=model)


def warmed(response=K, model="1 + own + temperature + temperature^2 + temperature^3"):
    """Readings in m/s² at five temperatures, and a calibration that knows how the zero drifts."""
    up, t = np.tile(UP, (len(AT), 1)), np.repeat(AT, len(UP))
    values = up @ response.T + OFFSET + t[:, None] ** np.arange(1, 4) @ SLOPES
    readings = mp.Readings(values, up=up, unit="m/s^2", environment={"temperature": t})
    return mp.fit(readings, model=model), readings


def pairs(text):
    """Return names and values of a parameter file of either ground station."""
    lines = [re.split(r"[\t,]", line) for line in text.splitlines() if not line.startswith("#")]
    return {
        (cells[2] if len(cells) == 5 else cells[0]): (cells[3] if len(cells) == 5 else cells[1])
        for cells in lines
    }


def numbers(found, *names):
    return np.array([float(found[name]) for name in names])


@pytest.mark.parametrize(("instance", "device"), [(None, 1310988), (2, 2490378)])
def test_px4_finds_its_sensor(instance, device, tmp_path):
    cal = fitted()
    exported = mp.export(cal, "px4", allow_lossy=True, instance=instance, device_id=device)
    found = pairs(exported.text)
    number = instance or 0
    assert found[f"CAL_ACC{number}_ID"] == str(device)
    kinds = [line.split("\t")[4] for line in exported.text.splitlines() if "_ID\t" in line]
    assert kinds == ["6"]  # MAV_PARAM_TYPE_INT32: a float would not hold every ID
    assert f"CAL_ACC{number}_XOFF" in found
    assert not any("--device-id" in note for note in texts(exported))
    exported.save(tmp_path / "file.params")
    assert read_back(tmp_path / "file.params", cal).target == "px4"


@pytest.mark.parametrize("target", ["px4", "ardupilot"])
def test_without_the_id_it_is_said_what_the_autopilot_does(target):
    notes = texts(mp.export(fitted(), target, allow_lossy=True))
    assert any("--device-id" in note for note in notes)


def test_ardupilot_counts_from_one_and_the_first_has_no_number(tmp_path):
    cal = fitted()
    first, second = (
        pairs(mp.export(cal, "ardupilot", allow_lossy=True, instance=i, device_id=7).text)
        for i in (1, 2)
    )
    assert list(first)[:2] == ["INS_ACC_ID", "INS_ACCOFFS_X"]
    assert list(second)[:2] == ["INS_ACC2_ID", "INS_ACC2OFFS_X"]
    assert list(first.values()) == list(second.values())
    mp.export(cal, "ardupilot", allow_lossy=True, instance=2).save(tmp_path / "a.parm")
    assert read_back(tmp_path / "a.parm", cal).target == "ardupilot"


@pytest.mark.parametrize(
    ("target", "options", "says"),
    [
        ("px4", {"instance": 4}, "--instance takes 0 to 3 for --to px4, got 4"),
        ("ardupilot", {"instance": 0}, "--instance takes 1 to 3 for --to ardupilot, got 0"),
        ("px4", {"device_id": 0}, "--device-id takes 1 to 2147483647, got 0"),
    ],
)
def test_no_such_accelerometer(target, options, says):
    with pytest.raises(mp.UsageError, match=says):
        mp.export(fitted(), target, allow_lossy=True, **options)


def test_px4_with_temperature_by_its_law(tmp_path):
    # eq. (2) of exports.laws
    cal, readings = warmed(np.diag(np.diag(K)))
    exported = mp.export(cal, "px4", device_id=1310988)
    assert texts(exported) == ()  # nothing is lost
    found = pairs(exported.text)
    assert (found["TC_A_ENABLE"], found["TC_A0_ID"]) == ("1", "1310988")
    off, scale = (numbers(found, *(f"CAL_ACC0_{a}{k}" for a in "XYZ")) for k in ("OFF", "SCALE"))
    reference, low, high = numbers(found, "TC_A0_TREF", "TC_A0_TMIN", "TC_A0_TMAX")
    x = [numbers(found, *(f"TC_A0_X{power}_{i}" for i in range(3))) for power in range(4)]
    t = readings.environment["temperature"]
    delta = (np.clip(t, low, high) - reference)[:, None]  # calc_thermal_offsets_3D
    thermal = x[0] + x[1] * delta + x[2] * delta**2 + x[3] * delta**3
    force = (readings.values - thermal - off) * scale  # Accelerometer::Correct
    np.testing.assert_allclose(force / G, readings.up, atol=1e-12)
    assert (low, high) == (-5.0, 55.0)
    exported.save(tmp_path / "file.params")
    assert read_back(tmp_path / "file.params", cal).max < 1e-9


def test_ardupilot_with_temperature_by_its_law(tmp_path):
    # eq. (1) of exports.target_autopilots
    cal, readings = warmed(np.diag(np.diag(K)))
    exported = mp.export(cal, "ardupilot", device_id=7, instance=3)
    found = pairs(exported.text)
    assert found["INS_TCAL3_ENABLE"] == "1"
    off, scale = (numbers(found, *(f"INS_ACC3{k}_{a}" for a in "XYZ")) for k in ("OFFS", "SCAL"))
    low, high, at = numbers(found, "INS_TCAL3_TMIN", "INS_TCAL3_TMAX", "INS_ACC3_CALTEMP")
    c = [numbers(found, *(f"INS_TCAL3_ACC{power}_{a}" for a in "XYZ")) for power in (1, 2, 3)]

    def polynomial(temperature):  # polynomial_eval, from TEMP_REFERENCE
        d = (np.clip(temperature, low, high) - 35.0)[:, None]
        return (c[0] + (c[1] + c[2] * d) * d) * d * 1e-6

    t = readings.environment["temperature"]
    v = readings.values - polynomial(t) + polynomial(np.full_like(t, at))  # correct_sensor
    np.testing.assert_allclose((v - off) * scale / G, readings.up, atol=1e-12)
    exported.save(tmp_path / "file.parm")
    assert read_back(tmp_path / "file.parm", cal).max < 1e-9


def test_terms_beyond_the_offset_are_let_go_by_name():
    cal, _ = warmed(model="linear + temperature + temperature*own".replace("linear", "1 + x+y+z"))
    with pytest.raises(mp.MultiposError, match=r"px4 cannot express .*temperature\*"):
        mp.export(cal, "px4")
    text = mp.export(cal, "px4", allow_lossy=True).text
    assert "TC_A0_X1_0" in text


def test_a_drift_is_the_same_about_any_temperature():
    drift = Drift(SLOPES, 0.0, -5.0, 55.0)
    t = np.linspace(-20.0, 70.0, 10)
    gained, about = drift.offset(21.0), drift.about(21.0)
    np.testing.assert_allclose(gained + about.offset(t), drift.offset(t), atol=1e-12)
    held = np.clip(t, -5.0, 55.0)[:, None]
    np.testing.assert_allclose(drift.offset(t), held ** np.arange(1, 4) @ SLOPES, atol=1e-12)


@pytest.mark.parametrize(("unit", "scale"), [("m/s^2", 1.0), ("g", 1 / G), ("count", 200.0)])
def test_imucal_by_its_law(unit, scale, tmp_path):
    cal = fitted(unit, scale)
    exported = mp.export(cal, "imucal")
    held = json.loads(exported.text)
    # CalibrationInfo.from_json_file: the version, the type, and what the constructor takes
    assert (held.pop("_format_version"), held.pop("cal_type")) == ("2.0.0", "Ferraris")
    keys = {"acc_unit", "gyr_unit", "from_acc_unit", "from_gyr_unit", "comment"}
    assert set(held) == keys | {"K_a", "R_a", "b_a", "K_g", "R_g", "K_ga", "b_g"}
    assert (held["acc_unit"], held["from_acc_unit"]) == ("m/s^2", unit)
    K_a, R_a, b_a = (np.array(held[key]) for key in ("K_a", "R_a", "b_a"))
    raw = cal.readings.values
    corrected = (np.linalg.inv(R_a) @ np.linalg.inv(K_a) @ (raw - b_a).T).T  # _calibrate_acc
    np.testing.assert_allclose(corrected / G, cal.compensate(raw), atol=1e-12)
    assert np.count_nonzero(K_a) == 3
    np.testing.assert_allclose(np.linalg.norm(R_a, axis=1), 1.0, rtol=1e-12)
    gyro = np.array([1.0, 2.0, 3.0])
    d_ga = np.array(held["K_ga"]) @ corrected[0]
    left = np.linalg.inv(np.array(held["R_g"])) @ np.linalg.inv(np.array(held["K_g"]))
    np.testing.assert_array_equal(left @ (gyro - d_ga - np.array(held["b_g"])), gyro)
    exported.save(tmp_path / "cal_imucal.json")
    assert read_back(tmp_path / "cal_imucal.json", cal).rms == pytest.approx(cal.rms)


def test_imucal_files_are_their_own_json(tmp_path, capsys):
    cal = fitted()
    cal.save(tmp_path / "cal.json")
    out = tmp_path / "cal_imucal.json"
    status, _, _ = run(capsys, "export", tmp_path / "cal.json", "--to", "imucal", "-o", out)
    assert status == 0
    assert json.loads(out.read_text())["cal_type"] == "Ferraris"


def resting(unit="m/s^2", sd=0.02, walk=2e-3, rate=100.0):
    """Five minutes at rest: white noise of sd [unit] a sample, and a random walk [unit/√s]."""
    rng = np.random.default_rng(5)
    n = int(300 * rate)
    values = sd * rng.standard_normal((n, 3))
    values += np.cumsum(walk / np.sqrt(rate) * rng.standard_normal((n, 3)), axis=0)
    log = {"time": np.arange(n) / rate}
    log |= dict(zip(("ax", "ay", "az"), values.T, strict=True))
    return mp.stability(log, unit=unit)


def test_kalibr_by_its_law_with_noise_densities(tmp_path):
    cal = fitted("g", 1 / G)
    found = resting("g", sd=0.02 / G, walk=2e-3 / G)
    exported = mp.export(cal, "kalibr", stability=found)
    text = exported.text
    M, C = kalibr_matrices(text)
    b = np.array(json.loads(re.search(r"bias: (.*)", text)[1]))
    raw = cal.readings.values * G
    np.testing.assert_allclose(raw, G * cal.compensate(raw / G) @ C.T @ M.T + b, atol=1e-11)
    held = dict(re.findall(r"^  (\w+): ([\d.e+-]+)  #", text, re.MULTILINE))
    # N = sd/√rate in m/s²/√Hz, by definition; of three outputs, 30,000 samples
    assert float(held["accelerometer_noise_density"]) == pytest.approx(0.02 / 10.0, rel=0.03)
    assert float(held["accelerometer_random_walk"]) == pytest.approx(2e-3, rel=0.6)  # 5 minutes
    assert float(held["update_rate"]) == pytest.approx(100.0)
    assert "C_i_case turns case axes into them" in texts(exported)[0]
    exported.save(tmp_path / "imu.yaml")
    assert read_back(tmp_path / "imu.yaml", cal).rms == pytest.approx(cal.rms)
    bare = mp.export(cal, "kalibr")
    assert "noise_density" not in bare.text
    assert "--stability" in texts(bare)[0]


def kalibr_matrices(text):
    """M and C_i_case of a file, the second I where it is not there."""
    rows = [json.loads(row) for row in re.findall(r"^    - (\[.*\])$", text, re.MULTILINE)]
    return np.array(rows[:3]), np.array(rows[3:] or np.eye(3))


@pytest.mark.parametrize("mounted", ["as it is", "quarter turn", "mirrored"])
def test_kalibr_has_a_lower_triangle_and_a_rotation_beside_it(mounted, tmp_path):
    # eq. (1) of exports.target_matrices
    # raw = K a with K = M C: M M' = K K', of which Cholesky's factor is M but for a common sign
    turn = {"quarter turn": [[0, -1, 0], [1, 0, 0], [0, 0, 1]], "mirrored": -np.eye(3)}
    response = K @ np.array(turn.get(mounted, np.eye(3)))
    cal = mp.fit(mp.Readings(UP @ response.T + OFFSET, up=UP, unit="m/s^2"))
    exported = mp.export(cal, "kalibr")
    M, C = kalibr_matrices(exported.text)
    sign = -1.0 if mounted == "mirrored" else 1.0
    lower = np.linalg.cholesky(response @ response.T) / G
    np.testing.assert_allclose(M, sign * lower, rtol=0, atol=1e-14)  # zeros above the diagonal
    assert (M[np.triu_indices(3, 1)] == 0.0).all()
    np.testing.assert_allclose(C @ C.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(C) == pytest.approx(1.0)
    exported.save(tmp_path / "imu.yaml")
    found = read_back(tmp_path / "imu.yaml", cal)
    assert found.difference < 1e-12
    without = re.sub(r"    C_i_case:\n(    - .*\n){3}", "", exported.text)
    (tmp_path / "imu.yaml").write_text(without)  # the rotation is read
    assert read_back(tmp_path / "imu.yaml", cal).difference > 1e-3


def test_kalibr_of_unknown_orientation_needs_no_rotation():
    cal = mp.fit(mp.Readings(UP @ K.T + OFFSET, unit="m/s^2"), unknown_orientation=True)
    exported = mp.export(cal, "kalibr")
    assert "C_i_case" not in exported.text
    assert [found.code for found in exported.findings] == ["no-noise-density"]


def test_kalibr_takes_the_stability_of_this_sensor():
    cal = fitted()
    with pytest.raises(mp.MultiposError, match="the stability is in 'V', but Kalibr takes m/s"):
        mp.export(cal, "kalibr", stability=resting("V"))


def test_inav_in_whole_numbers_by_its_law(tmp_path):
    cal = fitted("count", 2048 / G, model="1 + own", noise=1e-3)
    exported = mp.export(cal, "inav")
    assert "1 g of the flight controller is taken as 2048 counts" in texts(exported)[0]
    held = dict(re.findall(r"^set (\w+) = (-?\d+)$", exported.text, re.MULTILINE))
    zero, gain = (
        np.array([int(held[f"acc{kind}_{axis}"]) for axis in "xyz"]) for kind in ("zero", "gain")
    )
    raw = np.rint(cal.readings.values)
    force = (raw - zero) * gain / 4096 / 2048  # applyAccelerationZero, accUpdate
    # half a count each of reading and zero, half a step of gain
    assert np.abs(force - cal.compensate(raw)).max() < 0.5 / 2048 + 0.5 / 4096 * 1.1
    assert exported.text.splitlines()[-2] == "save"
    assert f"set acc_calibration = {','.join(map(str, zero))},1" in exported.text
    exported.save(tmp_path / "cli.txt")
    found = read_back(tmp_path / "cli.txt", cal)
    assert found.target == "inav"
    # what is printed is of the whole numbers in the file
    of_file = (cal.readings.values - zero) * gain / 4096 / 2048
    left = np.abs(of_file - cal.compensate(cal.readings.values)).max()
    assert exported.difference == pytest.approx(left, rel=1e-9)
    assert left > 1e-5


@pytest.mark.parametrize(
    ("unit", "scale", "says"),
    [
        ("g", 1 / G, "inav holds raw values in counts"),
        ("count", 20.0 / G, "with a scale factor of 20"),
        ("count", -2048 / G, "accgain_x would be -"),
    ],
)
def test_what_inav_cannot_hold(unit, scale, says):
    with pytest.raises(mp.MultiposError, match=says):
        mp.export(fitted(unit, scale, model="1 + own"), "inav")


@pytest.mark.skipif(shutil.which("cc") is None, reason="no cc on this machine")
@pytest.mark.parametrize("single", [False, True])
def test_c_in_metres(single, tmp_path):
    cal = fitted(model="own-quadratic")
    exported = mp.export(cal, "c", float=single, output_unit="m/s^2")
    assert "[m/s^2], convention" in exported.text
    assert "one g, the local gravity, is taken as 9.80665 m/s^2" in exported.text
    exported.save(tmp_path / "cal.c")
    found = read_back(tmp_path / "cal.c", cal)
    assert found.difference < (5e-7 if single else 1e-9)
    assert mp.export(cal, "c").text == mp.export(cal, "c", output_unit="g").text


def test_calibrate_passes_options_to_the_targets_that_have_them(tmp_path, capsys):
    rng = np.random.default_rng(2)
    rows = np.repeat(UP @ K.T + OFFSET, 300, axis=0)
    rows = rows + 1e-3 * rng.standard_normal(rows.shape)
    t = np.arange(len(rows)) / 100.0
    header = "time,ax (m/s^2),ay (m/s^2),az (m/s^2)"
    log = tmp_path / "log.csv"
    np.savetxt(log, np.column_stack([t, rows]), delimiter=",", header=header, comments="")
    targets = ["c", "px4", "kalibr", "imucal"]
    options = ["--allow-lossy", "--device-id", "0x14010C", "--output-unit", "m/s^2"]
    out = tmp_path / "cal.json"
    status, _, err = run(capsys, "calibrate", log, "--to", *targets, *options, "-o", out)
    assert status == 0, err
    assert "CAL_ACC0_ID\t1310988\t6" in (tmp_path / "cal_px4.params").read_text()
    assert "[m/s^2], convention" in (tmp_path / "cal.c").read_text()
    cal = mp.load(out)
    for name in ("cal_px4.params", "cal_kalibr.yaml", "cal_imucal.json"):
        read_back(tmp_path / name, cal)
    status, printed, err = run(capsys, "calibrate", log, "--to", "c", "--instance", 1, "-o", out)
    assert (status, printed) == (2, "")
    assert "--instance is for --to px4, ardupilot" in err
