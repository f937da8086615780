"""The simulator does what it says: its noise, its positions, and back through fit."""

import json

import numpy as np
import pytest
from log_bench import sensor

import multipos as mp
from multipos.cli import main
from multipos.sensor import simulation


def matrix(columns, cal):
    return np.column_stack([columns[name] for name in cal.outputs])


def test_without_noise_the_readings_are_the_models():
    cal = sensor("own-quadratic")
    found = mp.simulate(cal, "faces-corners-14", order="paper")
    up = mp.read_scheme("faces-corners-14").up
    np.testing.assert_array_equal(matrix(found, cal), cal.predict(up))
    assert list(found)[:4] == ["position", "up_x", "up_y", "up_z"]


def test_the_noise_is_as_asked():
    cal = sensor()
    found = mp.simulate(cal, "fibonacci-3000", order="paper", reading_sd=[1e-3, 2e-3, 3e-3], seed=1)
    noise = matrix(found, cal) - cal.predict(mp.read_scheme("fibonacci-3000").up)
    # 3000 readings know a standard deviation to 1.3 %; 99.99 % lies within 5 %.
    np.testing.assert_allclose(noise.std(axis=0), [1e-3, 2e-3, 3e-3], rtol=0.05)


def test_the_orientation_error_is_per_axis():
    # eq. (1) of sensor.simulation
    cal = sensor(bias=0.0, cross=0.0)
    up = mp.read_scheme("fibonacci-3000").up
    found = mp.simulate(cal, "fibonacci-3000", order="paper", orientation_sd=0.5, seed=2)
    angle = np.arccos(np.clip((cal.compensate(matrix(found, cal)) * up).sum(axis=1), -1.0, 1.0))
    # Two of the three axes tilt a direction: the mean square is 2 s².
    assert np.sqrt(np.mean(angle**2) / 2.0) == pytest.approx(np.radians(0.5), rel=0.05)


def test_the_same_seed_gives_the_same():
    cal = sensor()
    for make, options in (
        (mp.simulate, {"reading_sd": 1.0}),
        (mp.simulate_log, {"sample_sd": 1.0}),
    ):
        one, two = (make(cal, "faces-6", seed=5, **options) for _ in range(2))
        np.testing.assert_array_equal(one["ax"], two["ax"])


def test_convention_and_gravity_are_the_calibrations():
    up = mp.read_scheme("faces-6").up
    y = -9.80 / 9.80665 * up * 1.01 + 0.1
    cal = mp.fit(mp.Readings(y, up=up), convention="gravity", gravity=9.80)
    found = mp.simulate(cal, "faces-6")
    np.testing.assert_allclose(matrix(found, cal), y, atol=1e-12)


def test_a_log_rests_and_remembers():
    # eq. (2) of sensor.simulation
    cal = sensor()
    log = mp.simulate_log(
        cal,
        "faces-6",
        rate=200.0,
        rest=100.0,
        turn=1.0,
        sample_sd=1e-3,
        correlation_time=0.02,
        seed=3,
    )
    assert len(log["time"]) == 6 * 20000 + 5 * 200
    assert log["time"][1] == pytest.approx(1.0 / 200.0)
    noise = matrix(log, cal)[:20000] - cal.predict(mp.read_scheme("faces-6").up[:1])
    assert noise.std() == pytest.approx(1e-3, rel=0.05)
    one = noise[:, 0]
    # Correlation at one step: exp(−τ/T) = exp(−1/4).
    assert one[1:] @ one[:-1] / (one @ one) == pytest.approx(np.exp(-0.25), abs=0.02)


def test_turns_pass_between_opposite_positions():
    cal = sensor(bias=0.0, cross=0.0)
    log = mp.simulate_log(cal, "faces-6", rate=100.0, rest=1.0, turn=2.0, seed=0)
    force = cal.compensate(matrix(log, cal))
    turn = force[100:300]
    assert np.linalg.norm(turn, axis=1).min() > 0.7  # around, not through the middle
    assert force[99, 0] == pytest.approx(1.0, abs=1e-4)
    assert force[300, 0] == pytest.approx(-1.0, abs=1e-4)


def test_a_turn_is_the_one_of_least_jerk_by_hand(monkeypatch):
    """10 t³ − 15 t⁴ + 6 t⁵ of a quarter turn: 53/512 at a quarter of the time, half at half."""
    monkeypatch.setattr(simulation, "_TREMBLE", 0.0)
    x, y = np.eye(3)[:2]
    path = simulation._turn(2.0 * x, 2.0 * y, 3, np.random.default_rng(0))
    angle = np.pi / 2 * np.array([53 / 512, 1 / 2, 459 / 512])
    wanted = 2.0 * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    np.testing.assert_allclose(path, wanted, atol=1e-12)


def test_temperature_runs():
    cal = sensor("1 + x + y + z + temperature")
    found = mp.simulate(cal, "faces-6", temperature=(10.0, 40.0))
    np.testing.assert_allclose(found["temperature"], np.linspace(10.0, 40.0, 6))
    flat = mp.simulate(cal, "faces-6")
    assert set(flat["temperature"]) == {np.mean(cal.readings.environment["temperature"])}
    drift = matrix(found, cal) - matrix(flat, cal)
    slope = [cal[name, "temperature"].value for name in cal.outputs]
    np.testing.assert_allclose(drift, np.outer(found["temperature"] - flat["temperature"], slope))
    log = mp.simulate_log(cal, "faces-6", temperature=(10.0, 40.0))
    assert (log["temperature"][0], log["temperature"][-1]) == (10.0, 40.0)


@pytest.mark.usefixtures("without_findings")
def test_fit_covers_the_truth():
    """Errors of 40 fits over their u: of 480, as many within U as 95 % intervals promise."""
    cal = sensor()
    inside = 0
    for seed in range(40):
        readings = mp.simulate(cal, "faces-corners-14", reading_sd=1e-3, seed=seed)
        found = mp.fit(readings)
        inside += int((np.abs(found.parameters - cal.parameters) < found.U).sum())
    # Binomial(480, 0.95): 456 ± 3.3 · 4.8, and the 12 of a fit are nearly independent.
    assert 436 <= inside <= 474


def test_command_writes_what_python_gives(tmp_path, capsys):
    cal = sensor()
    cal.save(tmp_path / "cal.json")
    out = tmp_path / "readings.csv"
    argv = ["simulate", str(tmp_path / "cal.json"), "--scheme", "faces-6", "--seed", "4"]
    assert main([*argv, "--reading-sd", "1e-3", "-o", str(out)]) == 0
    assert capsys.readouterr().out == "6 readings simulated.\n"
    expected = mp.simulate(cal, "faces-6", reading_sd=1e-3, seed=4)
    np.testing.assert_array_equal(mp.read_readings(out).values, matrix(expected, cal))
    assert main([*argv, "--log", "--rate", "50", "--json"]) == 0
    assert "time" in json.loads(capsys.readouterr().out)["columns"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--log", "--reading-sd", "1"], "--reading-sd is for averaged readings"),
        (["--rate", "100"], "--rate is for a log; add --log"),
        (["--reading-sd", "-1"], "--reading-sd must be 0 or more"),
        (["--reading-sd", "1,2"], "--reading-sd takes 1 or 3 values, got 2"),
        (["--orientation-sd", "-1"], "--orientation-sd must be 0 or more"),
        (["--reading-sd", "1e308"], "--reading-sd must be 0 or more, and no more than 1e+40"),
        (["--orientation-sd", "180"], "below 180 degrees, got 180"),
        (["--temperature", "20"], "--temperature takes the first and the last"),
        (["--log", "--rate", "0"], "--rate must be above 0"),
        (["--log", "--rate", "1e-308"], "--rate must be above 0, from 1e-12 to 1e+07 Hz"),
        (["--log", "--rest", "1e308"], "the log would have more than 200000000 samples"),
        (["--log", "--turn", "1e308"], "the log would have more than 200000000 samples"),
        (["--temperature", "1e308,-1e308"], "--temperature takes the first and the last"),
        (["--log", "--turn", "-1"], "--turn must be 0 or more"),
        (["--log", "--rate", "1e7"], "more than 200000000 samples"),
        (["--seed", "-1"], "--seed must be 0 or more"),
    ],
)
def test_bad_options(options, message, tmp_path, capsys):
    sensor().save(tmp_path / "cal.json")
    out = tmp_path / "out.csv"
    argv = ["simulate", str(tmp_path / "cal.json"), "--scheme", "faces-6", "-o", str(out)]
    assert main([*argv, *options]) == 2
    printed, error = capsys.readouterr()
    assert printed == ""
    assert message in error.splitlines()[-1]
    assert not out.exists()
