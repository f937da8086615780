"""A session's drift: a line or an exponential, by dense least squares and by coverage."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

import multipos as mp
from multipos.sensor.calibration_file import from_dict

EXACT = {"orientation_sd": 0, "exclude": "none"}
NOISE = 1e-4  # g
WARM = 1e-3 * np.array([1.0, 0.7, -0.5])


def session(seed, *, n=24, tau=0.2, warm=WARM, rho=0.0, timed=True):
    """Return columns of rows a minute apart, τ as a share of the session, and the truth."""
    rng = np.random.default_rng([seed, n])
    up = rng.permutation(mp.read_scheme(f"fibonacci-{n}").up)
    K = np.eye(3) + 0.01 * rng.standard_normal((3, 3))
    zero = 0.02 * rng.standard_normal(3)
    t = np.linspace(0.0, 1.0, n)
    noise = rng.standard_normal((n, 3))
    for k in range(1, n):
        noise[k] = rho * noise[k - 1] + np.sqrt(1.0 - rho**2) * noise[k]
    values = zero + up @ K.T + NOISE * noise + np.exp(-t / tau)[:, None] * warm
    names = ("ax", "ay", "az", "up_x", "up_y", "up_z")
    columns = dict(zip(names, np.hstack([values, up]).T, strict=True))
    if timed:
        columns["time"] = 60.0 * (n - 1.0) * t + 5000.0
    return columns, zero, K


def test_tau_is_that_of_dense_least_squares_and_u_holds_it():
    # eqs. (1), (2), (3) of estimation.session_drift
    columns, *_ = session(1, timed=False)
    c = mp.fit(columns, unit="g", drift=True, **EXACT)
    (tau, u), t = c.model.drift_tau, np.arange(24.0)
    y = np.column_stack([columns[name] for name in ("ax", "ay", "az")])
    X = np.column_stack([np.ones(24), *(columns[f"up_{axis}"] for axis in "xyz")])

    def left(column):
        whole = np.column_stack([X, column])
        return np.sum((y - whole @ np.linalg.lstsq(whole, y, rcond=None)[0]) ** 2, axis=0)

    grid = np.linspace(np.log(0.25 * tau), np.log(4.0 * tau), 2001)
    sizes = left(np.exp(-t / tau))  # by which outputs are weighed
    q = np.array([np.sum(left(np.exp(-t / np.exp(each))) / sizes) for each in grid])
    weight = q**-28.5 / np.sum(q**-28.5)
    mean = weight @ grid
    assert_allclose(np.log(tau), mean, atol=0.02 * u / tau)
    assert_allclose(u / tau, np.sqrt(weight @ (grid - mean) ** 2), rtol=0.02)
    B = np.linalg.pinv(np.column_stack([X, np.exp(-t / tau)]))
    plain = np.sqrt(sizes / 19.0 * (B[0] @ B[0]))
    moved = (B[0] @ (np.exp(-t / tau) * t / tau)) * c.parameters[4::5] * u / tau
    assert_allclose(c.u[::5], np.hypot(plain, moved), rtol=1e-8)


@pytest.mark.parametrize(("timed", "unit"), [(True, "s"), (False, "row")])
def test_the_drift_is_in_files_and_left_out_of_the_sensor(timed, unit, tmp_path):
    columns, zero, K = session(2, timed=timed)
    c = mp.fit(columns, unit="g", drift=True)
    c.save(tmp_path / "c.json")
    said = json.loads((tmp_path / "c.json").read_text())
    tau = said["drift"]["tau"]
    assert (said["drift"]["kind"], tau["unit"]) == ("exponential", unit)
    assert abs(tau["value"] - 0.2 * 23.0 * (60.0 if timed else 1.0)) < 3.0 * tau["u"]
    assert mp.load(tmp_path / "c.json") == c
    settled = zero + 0.5 * K[:, 0]
    assert_allclose(c.compensate(settled[None])[0], [0.5, 0.0, 0.0], rtol=0, atol=2e-4)
    assert "drift" not in mp.export(c, "c").text
    mp.report(c, tmp_path / "c.md")
    assert "exponential, tau = " in (tmp_path / "c.md").read_text()
    line = mp.fit(session(3, warm=0.0 * WARM)[0], unit="g", drift=True)
    content = line.to_dict()
    assert content["drift"] == {"kind": "linear", "tau": None}
    del content["drift"]  # as files were
    assert from_dict(content).to_dict()["drift"] == line.to_dict()["drift"]


def test_a_bad_row_is_no_drift_and_a_warm_up_no_bad_row():
    columns, zero, _ = session(4)
    columns["ay"][14] += 0.02
    c = mp.fit(columns, unit="g", drift=True)
    assert [each.row for each in c.excluded] == [15]
    assert c.model.drift["kind"] == "exponential"
    assert (np.abs(c.parameters[::5] - zero) < 1.5 * c.U[::5]).all()


def test_units_of_a_fleet_drift_as_by_themselves():
    parts = [session(seed)[0] | {"unit": np.repeat(f"u{seed}", 24)} for seed in (6, 7)]
    table = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    found = mp.fit_many(table, unit_column="unit", drift=True)
    for i, part in enumerate(parts):
        c = mp.fit({name: each for name, each in part.items() if name != "unit"}, drift=True)
        assert_allclose([found[name][i] for name in c.names], c.parameters, rtol=1e-9)
        assert_allclose([found[f"u_{name}"][i] for name in c.names], c.u, rtol=1e-9)


@pytest.mark.parametrize(
    ("n", "options"),
    [
        *((12, EXACT), (24, EXACT), (24, {}), (24, {"unknown_orientation": True})),
        *((24, {"robust": "huber"}), (24, {"orientation_sd": 0.02})),
    ],
    ids=str,
)
@pytest.mark.parametrize("sets", [10, pytest.param(60, marks=pytest.mark.slow)])
def test_u_covers_the_settled_sensor(n, options, sets):
    """A warm-up of 1 mg over a fifth of the session; of 30 and 180 biases 95 %, less 4 sd."""
    inside = []
    for seed in range(sets):
        columns, zero, _ = session(seed, n=n, timed=seed % 2 == 0)
        if "unknown_orientation" in options:
            columns = {name: each for name, each in columns.items() if "up" not in name}
        c = mp.fit(columns, unit="g", drift=True, **options)
        if c.model.drift_tau is None:  # a line, in mid-session
            zero = zero + np.exp(-2.5) * WARM
        place = [c.names.index(f"bias_a{axis}") for axis in "xyz"]
        inside.append(np.abs(c.parameters[place] - zero) <= c.U[place])
    assert np.mean(inside) > 0.95 - 4.0 * np.sqrt(0.95 * 0.05 / (3.0 * sets))


@pytest.mark.parametrize("sets", [12, pytest.param(80, marks=pytest.mark.slow)])
def test_a_line_stays_one(sets):
    """A fall of 1 mg, of an exponential of a hundred sessions; one in ten bends by chance."""
    lines = [session(seed, tau=100.0, warm=100.0 * WARM)[0] for seed in range(sets)]
    drifts = [mp.fit(each, unit="g", drift=True, **EXACT).model.drift for each in lines]
    assert [each["kind"] for each in drifts].count("exponential") <= 0.1 * sets + 1


@pytest.mark.parametrize(("n", "options"), [(12, EXACT), (12, {}), (24, EXACT), (24, {})], ids=str)
@pytest.mark.parametrize("sets", [12, pytest.param(60, marks=pytest.mark.slow)])
def test_u_keeps_the_correlation_of_timed_rows(n, options, sets):
    """Noise of .9 from row to row; biases covered 39 and 93 % by default."""
    inside = []
    for seed in range(sets):
        columns, zero, _ = session(seed, n=n, warm=0.0 * WARM, rho=0.9)
        c = mp.fit(columns, unit="g", drift=True, **options)
        inside.append(np.abs(c.parameters[::5] - zero) <= c.U[::5])
    assert np.mean(inside) > 0.84 - 0.6 / np.sqrt(sets)
