"""A stability result in a budget makes the bias as uncertain as its zero repeats."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

import multipos as mp
from multipos.errors import MultiposError
from multipos.uncertainty.budgets import read_budget
from multipos.uncertainty.monte_carlo import simulate_budget
from multipos.uncertainty.propagation import evaluate_budget


def fitted(budget=None, unit="g", scale=1.0, seed=1):
    up = mp.read_scheme("faces-corners-14").up
    noise = 1e-5 * np.random.default_rng(seed).standard_normal(up.shape)
    readings = mp.Readings(scale * (up + noise), unit=unit)
    return mp.fit(readings, scheme="faces-corners-14", budget=budget)


def four_runs(zeros=(1e-3, 2e-3, 4e-3, 5e-3)):
    rng = np.random.default_rng(2)
    logs = [{"ax": z + 1e-5 * rng.standard_normal(500)} for z in zeros]
    return mp.stability(logs, rate=1.0, unit="g")


def test_the_bias_gets_the_standard_deviation_of_its_output():
    stated = {"stability": {"u_ax": 1e-3, "u_az": 2e-3, "dof": 3}}
    plain, found = fitted(), fitted(stated)
    grown = np.sqrt(np.maximum(np.diag(found.covariance - plain.covariance), 0.0))
    expected = dict.fromkeys(plain.names, 0.0) | {"bias_ax": 1e-3, "bias_az": 2e-3}
    assert_allclose(grown, list(expected.values()), atol=1e-8)
    (row,) = [row for row in evaluate_budget(found).rows if row.quantity == "stability"]
    assert (row.u, row.unit) == (1.0, "1")
    assert not row.contained.any()  # it is the same at all positions: no residual shows it
    assert not row.common  # yet another in every repeat
    assert found["bias_ax"].dof == pytest.approx(3.0, rel=1e-3)


def test_repeats_that_differ_by_what_the_zero_does_are_consistent():
    rng = np.random.default_rng(3)
    stated = {"stability": {"u_ax": 1e-3, "u_ay": 1e-3, "u_az": 1e-3}}
    up = mp.read_scheme("faces-corners-14").up
    runs = []
    for _ in range(4):
        values = up + 1e-5 * rng.standard_normal(up.shape) + 1e-3 * rng.standard_normal(3)
        runs.append(mp.Readings(values, unit="g"))
    plain = [mp.fit(run, scheme="faces-corners-14") for run in runs]
    assert not mp.compare(plain).consistent
    known = [mp.fit(run, scheme="faces-corners-14", budget=stated) for run in runs]
    assert mp.compare(known).consistent


def test_of_compensated_force_it_acts_along_the_axis():
    # 2 V per g: 1 mg along x moves ax by 2 mV.
    stated = {"stability": {"u_f_x": 1e-3, "dof": 3}}
    plain, found = (fitted(b, unit="V", scale=2.0) for b in (None, stated))
    grown = np.sqrt(np.maximum(np.diag(found.covariance - plain.covariance), 0.0))
    assert grown[found.names.index("bias_ax")] == pytest.approx(2e-3, rel=1e-4)
    assert grown[found.names.index("bias_ay")] < 1e-7


def test_a_file_is_read_beside_the_budget_and_goes_along(tmp_path):
    run = four_runs()
    run.save(tmp_path / "zero.json")
    (tmp_path / "budget.toml").write_text('[stability]\nfile = "zero.json"\n')
    found = fitted(tmp_path / "budget.toml")
    sd = run.run_to_run["ax"].sd
    assert sd == pytest.approx(np.std([1e-3, 2e-3, 4e-3, 5e-3], ddof=1), rel=1e-2)
    assert found["bias_ax"].u == pytest.approx(sd, rel=1e-4)
    found.save(tmp_path / "cal.json")
    (tmp_path / "zero.json").unlink()  # the numbers are in the calibration
    again = mp.load(tmp_path / "cal.json")
    assert_allclose(again.covariance, found.covariance, rtol=1e-12)
    assert_allclose(evaluate_budget(again).covariance, found.covariance, rtol=1e-12)


def test_monte_carlo_agrees():
    stated = {"stability": {"u_ax": 1e-3, "u_f_y": 2e-3}}
    found = fitted(stated)
    drawn = simulate_budget(found, trials=20_000, rng=1)
    # A standard deviation of 20 000 trials is good to half a percent.
    assert_allclose(drawn.u[[0, 4]], found.u[[0, 4]], rtol=0.02)


def one_run(folder):
    mp.stability({"ax": np.random.default_rng(1).standard_normal(99)}, rate=1.0).save(
        folder / "one.json"
    )


FAULTS = {
    "neither": ({}, "give 'file', or standard deviations by output"),
    "no table": (3, "write it as a table"),
    "both": ({"file": "a.json", "dof": 3}, "'file' states everything"),
    "unknown": ({"u": 1.0, "u_ax": 1.0}, "there is 'u'"),
    "no number": ({"u_ax": "x"}, "'u_ax' must be a number"),
    "negative": ({"u_ax": -1.0}, "'u_ax' must be a number of at least 0"),
    "no freedom": ({"u_ax": 1.0, "dof": 0}, "'dof' must be a number of at least 1"),
    "no name": ({"file": 3}, "must be the name of a file"),
    "no such file": ({"file": "none.json"}, "none.json"),
    "one record": ({"file": "one.json"}, "is of one record"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_what_states_nothing_is_refused(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    one_run(tmp_path)
    table, words = FAULTS[name]
    with pytest.raises(MultiposError, match=words):
        read_budget({"stability": table})


def test_another_sensor_is_refused():
    with pytest.raises(MultiposError, match="is of 'bx', but this calibration has ax, ay, az"):
        fitted({"stability": {"u_bx": 1e-3}})


def test_without_degrees_of_freedom_json_has_none():
    stated = read_budget({"stability": {"u_ax": 1e-3}})
    assert "dof" not in stated.tables["stability"]
    assert json.dumps(fitted(stated).to_dict())
