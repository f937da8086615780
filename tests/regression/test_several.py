"""From a log and where the sensor stood to three regressions in C."""

import json
from pathlib import Path

import numpy as np
import pytest

import multipos as mp
from multipos.cli import main
from multipos.errors import MultiposError, UsageError
from multipos.verification.error_columns import errors_table

UP = mp.read_scheme("faces-corners-14").up


def calibration():
    return mp.fit(
        {"up_x": UP[:, 0], "up_y": UP[:, 1], "up_z": UP[:, 2], "ax": UP[:, 0], "ay": UP[:, 1]}
        | {"az": UP[:, 2] + 1e-6 * np.random.default_rng(1).standard_normal(14)},
        unit="g",
    )


def log(n=420):
    """A chamber log: every row says where the sensor stood; z drifts with temperature."""
    rng = np.random.default_rng(2)
    up = UP[np.arange(n) % 14]
    temperature = 20.0 + 30.0 * np.sin(np.arange(n) / 40.0)
    drift = 1e-4 * (temperature - 20.0)
    columns = {f"up_{a}": up[:, i] for i, a in enumerate("xyz")}
    for i, a in enumerate("xyz"):
        columns[f"a{a}"] = up[:, i] + (i + 1) * drift + rng.normal(0.0, 1e-5, n)
    labels = [f"p{k}" for k in range(n)]
    return {"position": labels, "time": np.arange(float(n)), **columns, "temperature": temperature}


def test_errors_of_a_run_are_what_regress_needs():
    cal, run = calibration(), log()
    found = mp.check(cal, run)
    table = errors_table(cal, run, found)
    assert list(table)[: len(run)] == list(run)
    force = np.column_stack([table[f"f_{a}"] for a in "xyz"])
    np.testing.assert_allclose(
        force, cal.compensate(np.column_stack([run[f"a{a}"] for a in "xyz"]))
    )
    by_hand = force[:, 2] - run["up_z"]
    np.testing.assert_allclose(table["error_z"], by_hand, atol=1e-15)
    np.testing.assert_allclose(table["nominal_error_z"], run["az"] - run["up_z"], atol=1e-15)
    with pytest.raises(UsageError, match="errors of tilt"):
        errors_table(cal, run, mp.check(cal, run, tilt=True))
    with pytest.raises(MultiposError, match="'f_x' is there already"):
        errors_table(cal, run | {"f_x": run["ax"]}, found)


def test_from_a_log_to_c(tmp_path, capsys, monkeypatch):
    """The whole way on the command line, three axes in one regress and one C file."""
    monkeypatch.chdir(tmp_path)
    calibration().save("cal.json")
    mp.write_table("log.csv", log())
    assert main(["check", "cal.json", "log.csv", "-o", "errors.csv"]) == 0
    responses = "error_x,error_y,error_z"
    regress = ["regress", "errors.csv", "--response", responses, "--variables", "temperature"]
    assert main([*regress, "-o", "reg.json"]) == 0
    capsys.readouterr()
    found = json.loads((tmp_path / "reg.json").read_text())
    assert found["schema"] == "multipos/regression/1"
    assert list(found["responses"]) == responses.split(",")
    slopes = [r["segments"][0]["terms"][1]["value"] for r in found["responses"].values()]
    np.testing.assert_allclose(slopes, [1e-4, 2e-4, 3e-4], rtol=1e-2)
    forces = ["--correct", "f_x,f_y,f_z"]
    assert main(["apply", "reg.json", "errors.csv", *forces, "-o", "done.csv"]) == 0
    done = mp.read_table("done.csv")
    left = done.number("corrected_error_z") - done.number("up_z")
    assert np.abs(left).max() < 1e-4  # of 9 mg; noise of 10 µg and the fit's own
    assert "predicted_error_x" in done
    capsys.readouterr()
    assert main(["check", "reg.json", "errors.csv", "--json"]) == 0
    checked = json.loads(capsys.readouterr().out)
    assert checked["axes"] == responses.split(",")
    assert main(["export", "cal.json", "reg.json", "--to", "c", *forces, "-o", "all.c"]) == 0
    assert "f_z, corrected by error_z" in Path("all.c").read_text(encoding="utf-8")


def test_several_are_one_by_one(tmp_path):
    run = log()
    columns = run | {"ex": run["ax"] - run["up_x"], "ez": run["az"] - run["up_z"]}
    found = mp.regress(columns, response="ex,ez", variables="temperature")
    alone = mp.regress(columns, response="ez", variables="temperature")
    assert isinstance(found, mp.Regressions)
    assert found["ez"] == alone
    assert tuple(found) == ("ex", "ez")
    assert mp.regress(columns, response=["ez"], variables="temperature") == alone
    found.save(tmp_path / "reg.json")
    assert mp.load_regression(tmp_path / "reg.json") == found
    assert str(alone) in str(found)
    with pytest.raises(UsageError, match="names a column twice"):
        mp.regress(columns, response="ex,ex", variables="temperature")
    with pytest.raises(UsageError, match="names 1 columns for 2 responses"):
        mp.correct(found, columns, column="ax")


def test_damaged_files_are_refused(tmp_path):
    path = tmp_path / "reg.json"
    for content, said in (
        ({"responses": {}}, "holds no regressions"),
        ({"responses": {"ex": {"response": "ex"}}}, "reg.json: ex"),
    ):
        path.write_text(json.dumps({"schema": "multipos/regression/1", **content}))
        with pytest.raises(MultiposError, match=said):
            mp.load_regression(path)
