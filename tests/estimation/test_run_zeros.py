"""Rows of several runs: a zero of its own in each, by hand, by coverage, and where it is not."""

import json

import numpy as np
import pytest
from amounts import exactly
from numpy.testing import assert_allclose
from scipy import stats

import multipos as mp

NOISE = 1e-3  # g


def runs_of(zeros, scheme="faces-6", *, noise=NOISE, seed=0, label="run"):
    """Return the readings of runs (R, 3) of a scheme, each with its zero."""
    one = mp.read_scheme(scheme).up
    run, up = np.repeat(np.arange(len(zeros)), len(one)), np.tile(one, (len(zeros), 1))
    rng = np.random.default_rng(seed)
    values = up + np.asarray(zeros)[run] + noise * rng.standard_normal(up.shape)
    return mp.Readings(values, up=up, unit="g", environment={label: run.astype(float)})


def codes(c):
    return {finding.code for finding in c.findings}


def test_the_bias_is_a_mean_of_runs_with_the_u_of_that_mean():
    """Zeros far beyond the noise: t s/√R of four means on 3 degrees of freedom, by hand."""
    # eq. (2) of estimation.run_zeros
    zeros = np.array([[3, -1, 0], [-2, 4, 1], [1, -3, 2], [5, 2, -4]]) * 0.1
    readings = runs_of(zeros)
    c = mp.fit(readings)
    means = readings.values.reshape(4, 6, 3).mean(axis=1)
    wanted = stats.t.ppf(0.975, 3) * means.std(axis=0, ddof=1) / 2.0
    biases = [c[f"bias_a{axis}"] for axis in "xyz"]
    assert_allclose([p.value for p in biases], means.mean(axis=0))
    assert_allclose([p.U for p in biases], wanted, rtol=0.01)
    # what runs differ by is in no scale factor: as with a bias of each run, 24 − 4 − 3 left
    of_run = np.repeat(means - means.mean(axis=0), 6, axis=0)
    left = readings.values - c.predict(readings.up) - of_run
    sd = np.sqrt(np.sum(left**2, axis=0) / 17.0)
    assert_allclose(
        [c[f"scale_a{axis}"].U for axis in "xyz"],
        stats.t.ppf(0.975, 17) * sd / np.sqrt(8.0),
        rtol=0.06,
    )
    (note,) = (finding for finding in c.findings if finding.code == "zero-per-soak")
    assert note.text.startswith("bias is the mean of 4 runs, whose zeros differ by ax 0.3,")
    assert not codes(c) & {"outlier", "replaced", "drift", "slipped"}
    assert not mp.fit(readings, exclude="auto").excluded


@pytest.mark.parametrize("sd", [0.0, 0.3, 1.0, 10.0])
@pytest.mark.parametrize(("runs", "scheme"), [(2, "edges-12"), (4, "faces-6"), (8, "faces-6")])
def test_u_covers_bias_and_scale_whatever_the_runs_differ_by(sd, runs, scheme):
    """Zeros of 0 to 10 times the noise; of 180 biases 87 % are five of their sd below 95 %."""
    # eq. (1) of estimation.run_zeros
    rng = np.random.default_rng(int(10 * sd) + runs)
    inside = []
    for _ in range(60):
        zeros = sd * NOISE * rng.standard_normal((runs, 3))
        c = mp.fit(runs_of(zeros, scheme, seed=rng))
        off = np.abs(c.parameters.reshape(3, 4) - np.eye(3, 4, k=1)) <= c.U.reshape(3, 4)
        inside.append([off[:, 0].mean(), off[:, 1:].mean()])
    bias, others = np.mean(inside, axis=0)
    assert bias > 0.87
    assert others > 0.92


def test_the_next_run_has_its_zero_in_u_of_force_and_in_its_check():
    rng = np.random.default_rng(5)
    up = mp.read_scheme("faces-6").up
    inside, rejected = [], 0
    for _ in range(40):
        c = mp.fit(runs_of(5.0 * NOISE * rng.standard_normal((5, 3)), seed=rng))
        new = up + 5.0 * NOISE * rng.standard_normal(3) + NOISE * rng.standard_normal(up.shape)
        table = dict(zip(c.outputs, new.T, strict=True))
        applied = mp.apply(c, table, uncertainty=True)
        force = np.column_stack([applied[f"f_{axis}"] for axis in "xyz"])
        U = np.column_stack([applied[f"U_f_{axis}"] for axis in "xyz"])
        inside.append(np.mean(np.abs(force - up) <= U))
        rejected += "run-disagrees" in codes(mp.check(c, mp.Readings(new, up=up, unit="g")))
    assert np.mean(inside) > 0.88
    assert rejected <= 6  # of 40 at 1 %, by a variance of few runs; 14 without the zeros


@pytest.mark.parametrize("labels", ["one run", "a run each", "another name"])
def test_what_is_no_run_moves_nothing(labels):
    zeros = 5.0 * NOISE * np.random.default_rng(1).standard_normal((4, 3))
    plain = exactly(runs_of(zeros, label="lot"))
    readings = runs_of(zeros, label="lot" if labels == "another name" else "run")
    if labels != "another name":
        own = np.zeros(24) if labels == "one run" else np.arange(24.0)
        readings = mp.Readings(readings.values, up=readings.up, unit="g", environment={"run": own})
    c = exactly(readings)
    assert_allclose(c.U, plain.U, rtol=1e-12)
    assert "zero-per-soak" not in codes(c)


@pytest.mark.parametrize(
    "options",
    [
        {"unknown_orientation": True},
        {"orientation_sd": 0.1},
        {"robust": "huber"},
        {"model": "each = b + s*own"},
    ],
)
def test_fits_that_leave_runs_aside_say_so(options):
    c = mp.fit(runs_of(np.zeros((4, 3)), "edges-12"), **options)
    (said,) = (f for f in c.findings if "column 'run'" in f.text)
    assert (said.code, said.level) == ("run-unused", "warning")


def test_runs_of_a_file_are_labels_and_no_output(tmp_path):
    readings = runs_of(5.0 * NOISE * np.random.default_rng(1).standard_normal((4, 3)))
    columns = {f"up_{axis}": readings.up[:, i] for i, axis in enumerate("xyz")}
    columns |= {"Run": np.repeat(["Mon", "Tue", "Wed", "Thu"], 6)}
    columns |= {f"a{axis}": readings.values[:, i] for i, axis in enumerate("xyz")}
    mp.write_table(tmp_path / "all.csv", columns)
    c = mp.fit(tmp_path / "all.csv", unit="g")
    assert c.outputs == ("ax", "ay", "az")
    assert_allclose(c.U, mp.fit(readings).U, rtol=1e-9)
    c.save(tmp_path / "c.json")
    again = mp.load(tmp_path / "c.json")
    assert_allclose(again.covariance, c.covariance)
    assert_allclose(again.readings.environment["run"], np.repeat(np.arange(4.0), 6))
    with pytest.raises(mp.UsageError, match="from run to run"):
        mp.simulate_budget(c)


def test_units_of_several_runs_in_a_fleet_are_fitted_as_by_themselves():
    rng = np.random.default_rng(2)
    up, rows = mp.read_scheme("faces-6").up, []
    for unit in range(12):
        for run in range(3 if unit % 2 else 1):
            values = up + 2e-3 * rng.standard_normal(3) + 1e-4 * rng.standard_normal(up.shape)
            rows += [(f"u{unit}", run, *f, *y) for f, y in zip(up, values, strict=True)]
    names = ("unit", "run", "up_x", "up_y", "up_z", "ax", "ay", "az")
    table = dict(zip(names, map(np.array, zip(*rows, strict=True)), strict=True))
    found = mp.fit_many(table, unit_column="unit")
    for i, unit in enumerate(found["unit"]):
        mine = table["unit"] == unit
        c = mp.fit({name: column[mine] for name, column in table.items() if name != "unit"})
        assert_allclose([found[f"u_{name}"][i] for name in c.names], c.u, rtol=1e-9)


def test_a_file_of_combined_sessions_is_read(tmp_path):
    """Version 0.2 wrote `sessions`, which nothing asks for any more."""
    c = mp.fit(runs_of(np.zeros((2, 3)), label="lot"))
    content = json.loads(json.dumps(c.to_dict(), default=list))
    content["sessions"] = {"runs": 2, "files": ["a.json", "b.json"], "sd": {"bias_ax": 1e-3}}
    (tmp_path / "c.json").write_text(json.dumps(content), encoding="utf-8")
    assert_allclose(mp.load(tmp_path / "c.json").covariance, c.covariance)
