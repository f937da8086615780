"""A triad over temperature, from scheme to verified C: each output is the next input."""

import shutil

import numpy as np
import pytest
from cli_bench import run
from log_bench import sensor

import multipos as mp

NAMES = ("ax", "ay", "az")
MODEL = "1 + x + y + z + temperature + temperature*own"
SOAKS = (-10.0, 20.0, 50.0)


def record(path, cal, scheme, soak, seed):
    """A raw log of the positions of a scheme at one temperature of the chamber, as it drifts."""
    warm = (soak - 0.5, soak + 0.5)
    log = mp.simulate_log(
        cal,
        mp.read_scheme(scheme),
        rate=50.0,
        rest=3.0,
        sample_sd=1e-3,
        temperature=warm,
        seed=seed,
    )
    kept = ("time", *NAMES, "temperature")
    mp.write_table(path, {name: log[name] for name in kept})
    return path.name


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no compiler")
def test_from_a_scheme_to_verified_c_in_ten_commands(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    truth = sensor(MODEL, size=1e-2)
    commands = 0

    def multipos(*arguments, status=0):
        nonlocal commands
        commands += 1
        found = run(capsys, *arguments)
        assert found[0] == status, found[2]
        return found[1]

    multipos("schemes", "faces-corners-14", "-o", "scheme.csv")
    logs = [
        record(tmp_path / f"at{t:g}.csv", truth, "scheme.csv", t, i) for i, t in enumerate(SOAKS)
    ]
    how = ("--scheme", "scheme.csv")
    multipos("calibrate", *logs, *how, "--model", MODEL, "--unit", "g", "-o", "cal.json")
    between = record(tmp_path / "between.csv", truth, "scheme.csv", 35.0, 9)
    said = multipos("check", "cal.json", between, *how, "--limit-g", "0.001", "-o", "check.json")
    assert said.splitlines()[0].startswith("Pass")
    multipos("report", "cal.json", "--check", "check.json", "-o", "report.md")
    multipos("export", "cal.json", "--to", "c", "-o", "sensor.c")
    multipos("apply", "cal.json", between, "-o", "force.csv")
    assert commands <= 10
    # the force of the log at its positions is that of the scheme, at a temperature between soaks
    means = mp.average("force.csv", outputs="f_x,f_y,f_z", scheme="scheme.csv").readings
    np.testing.assert_allclose(means.values, means.up, atol=1e-3)
    found = mp.load("cal.json")
    for name in found.names:
        assert abs(found[name].value - truth[name].value) < 6.0 * found[name].u, name


def test_check_averages_a_raw_log_and_takes_its_columns_by_name(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    truth = sensor("linear")
    truth.save("cal.json")
    log = mp.simulate_log(truth, "faces-corners-14", sample_sd=1e-3, rest=3.0, seed=8)
    other = dict(zip(("p", "q", "r"), (log[name] for name in NAMES), strict=True))
    mp.write_table("log.csv", {name: log[name] for name in ("time", *NAMES)})
    mp.write_table("other.csv", {"time": log["time"], **other})
    mp.average("log.csv", scheme="faces-corners-14").save("means.csv")
    how = ("--scheme", "faces-corners-14")
    means = run(capsys, "check", "cal.json", "means.csv")[1]
    for command in (("log.csv", *how), ("other.csv", "--outputs", "p,q,r", *how)):
        status, out, err = run(capsys, "check", "cal.json", *command)
        assert (status, err) == (0, "")
        assert out == means
    status, _, err = run(capsys, "check", "cal.json", "log.csv")
    assert status == 1
    assert "give --scheme" in err
    status, _, err = run(capsys, "check", "cal.json", "other.csv", "--outputs", "p,q", *how)
    assert status == 2
    assert "name one for each" in err
