"""Uncertainty of the force of one reading: whose noise, by hand, and as a claim that is kept."""

import json
import pickle
from types import SimpleNamespace

import numpy as np
import pytest
from amounts import exactly
from cli_bench import run
from findings_bench import texts

import multipos as mp
from multipos.compensation.reading_noise import ReadingUncertainty
from multipos.errors import MultiposError, UsageError

SD = 2e-3
K = np.array([[1.02, 0.01, -0.02], [0.005, 0.98, 0.015], [-0.01, 0.02, 1.01]])
BIAS = np.array([0.03, -0.02, 0.01])
FACES = np.vstack([np.eye(3), -np.eye(3)])


def readings(rng, positions, **others):
    values = positions @ K.T + BIAS + SD * rng.standard_normal(positions.shape)
    return mp.Readings(values, up=positions, **others)


@pytest.fixture(scope="module")
def cal():
    rng = np.random.default_rng(3)
    return mp.fit(readings(rng, np.vstack([FACES, FACES])))


def data(rng, n=5):
    up = rng.standard_normal((n, 3))
    up /= np.linalg.norm(up, axis=1)[:, None]
    raw = up @ K.T + BIAS + SD * rng.standard_normal(up.shape)
    return up, dict(zip(("ax", "ay", "az"), raw.T, strict=True))


def stacked(found, prefix):
    return np.column_stack([found[f"{prefix}_{axis}"] for axis in "xyz"])


def test_u_is_that_of_parameters_and_noise_by_finite_differences(cal):
    # eq. (1) of compensation.reading_noise
    raw = np.array([0.4, -0.5, 0.8])
    one = {name: [value] for name, value in zip(cal.outputs, raw, strict=True)}
    found = stacked(mp.apply(cal, one, uncertainty=True, reading_sd=[1e-3, 2e-3, 3e-3]), "u_f")[0]

    def force(parameters, values):
        theta = parameters.reshape(3, 4)
        return np.linalg.solve(theta[:, 1:], values - theta[:, 0])

    step = 1e-6
    by_parameter = np.column_stack(
        [
            (force(cal.parameters + d, raw) - force(cal.parameters - d, raw)) / (2 * step)
            for d in step * np.eye(12)
        ]
    )
    by_reading = np.linalg.inv(cal.parameters.reshape(3, 4)[:, 1:])
    C = by_parameter @ cal.covariance @ by_parameter.T
    C += by_reading @ np.diag(np.array([1e-3, 2e-3, 3e-3]) ** 2) @ by_reading.T
    np.testing.assert_allclose(found, np.sqrt(np.diag(C)), rtol=1e-7)  # second order of the steps
    alone = stacked(mp.apply(cal, one, uncertainty=True, parameters_only=True), "u_f")[0]
    at = by_parameter @ cal.covariance @ by_parameter.T
    np.testing.assert_allclose(alone, np.sqrt(np.diag(at)), rtol=1e-7)


def test_k_is_of_the_residuals_where_both_stand_on_them(cal):
    """K is diagonal here, so every axis has the 12 − 4 degrees of freedom of its own output."""
    values = np.vstack([FACES, FACES]) + BIAS
    values += 1e-3 * np.random.default_rng(1).standard_normal(values.shape)
    readings = mp.Readings(values, up=np.vstack([FACES, FACES]))
    plain = exactly(readings, model="1 + own")
    one = {"ax": [0.3], "ay": [0.2], "az": [0.9]}
    found = mp.apply(plain, one, uncertainty=True)
    k = (stacked(found, "U_f") / stacked(found, "u_f"))[0]
    np.testing.assert_allclose(k, 2.2281, atol=1e-4)  # t at 0.975 with 12 − 2 = 10, by table
    stated = mp.apply(plain, one, uncertainty=True, reading_sd=1.0)
    assert stated["U_f_x"][0] / stated["u_f_x"][0] == pytest.approx(1.95996, abs=1e-4)


@pytest.mark.usefixtures("without_findings")
def test_u_covers_the_force_on_new_readings():
    """Six positions twice, a reading of the same noise: U of u_f_… holds 95 % of forces."""
    rng = np.random.default_rng(20)
    runs, inside, alone = 150, 0, 0
    for _ in range(runs):
        cal = mp.fit(readings(rng, np.vstack([FACES, FACES])))
        up, table = data(rng, 1)
        found = mp.apply(cal, table, uncertainty=True)
        error = np.abs(stacked(found, "f") - up)
        inside += int((error <= stacked(found, "U_f")).sum())
        only = mp.apply(cal, table, uncertainty=True, parameters_only=True)
        alone += int((error <= stacked(only, "U_f")).sum())
    sd = np.sqrt(0.95 * 0.05 / (3 * runs))
    assert abs(inside / (3 * runs) - 0.95) < 3.3 * sd  # 1 in 1000 by chance
    assert alone / (3 * runs) < 0.75  # what it was without the noise of the reading


def test_the_noise_of_the_data_comes_first(cal):
    rng = np.random.default_rng(4)
    _, table = data(rng)
    beside = table | {f"u_{name}": np.full(5, 0.01) for name in cal.outputs}
    told = mp.apply(cal, beside, uncertainty=True, reading_sd=0.5)
    stated = mp.apply(cal, table, uncertainty=True, reading_sd=0.01)
    own = mp.apply(cal, table, uncertainty=True)
    np.testing.assert_allclose(stacked(told, "u_f"), stacked(stated, "u_f"), rtol=1e-12)
    assert told.noise == "u_ax, u_ay, u_az of the data"
    assert stated.noise == "--reading-sd"
    assert own.noise == "that of an averaged reading of the calibration"
    assert mp.apply(cal, table).noise is None
    assert "noise" not in mp.apply(cal, table).to_dict()
    assert pickle.loads(pickle.dumps(own)).noise == own.noise
    with pytest.raises(MultiposError, match="column 'u_az' is missing next to 'u_ax', 'u_ay'"):
        mp.apply(cal, {k: v for k, v in beside.items() if k != "u_az"}, uncertainty=True)
    beside["u_ay"] = np.array([0.01, 0.01, 0.0, 0.01, 0.01])
    with pytest.raises(MultiposError, match=r"row 3, column 'u_ay'"):
        mp.apply(cal, beside, uncertainty=True)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"reading_sd": 1.0}, "--reading-sd goes with --uncertainty"),
        ({"parameters_only": True}, "--parameters-only goes with --uncertainty"),
        ({"uncertainty": True, "reading_sd": 1.0, "parameters_only": True}, "leaves out"),
        ({"uncertainty": True, "reading_sd": [1.0, 2.0]}, "takes 1 or 3 values"),
    ],
)
def test_options_that_say_nothing_are_refused(cal, options, says):
    with pytest.raises(UsageError, match=says):
        mp.apply(cal, {"ax": [0.0], "ay": [0.0], "az": [1.0]}, **options)


def test_tilt_holds_the_same_noise(cal):
    one = {"ax": [0.05], "ay": [0.02], "az": [0.99]}
    small, large = (
        mp.apply(cal, one, tilt=True, uncertainty=True, reading_sd=sd) for sd in (1e-5, 1e-2)
    )
    assert small["tilt_x_deg"] == large["tilt_x_deg"]
    # near level the tilt of x is f_x/f_z
    level = np.degrees(large["u_f_x"] / large["f_z"])[0]
    assert large["u_tilt_x_deg"][0] == pytest.approx(level, rel=0.01)
    assert large["U_tilt_x_deg"][0] > 1.9 * large["u_tilt_x_deg"][0]
    assert large["u_tilt_x_deg"][0] > 5.0 * small["u_tilt_x_deg"][0]  # which parameters are left


def test_a_calibration_without_residuals_tells_no_noise():
    bare = mp.fit(
        mp.Readings(FACES[:4] @ K.T, up=FACES[:4] + np.array([0, 0, 0.1])), model="linear"
    )
    one = {"ax": [0.05], "ay": [0.02], "az": [0.99]}
    found = mp.apply(bare, one, uncertainty=True)
    assert np.isnan(found["u_f_x"]).all()
    assert any("State it with --reading-sd" in text for text in texts(found))


def still(rng, n, sd):
    raw = np.array([0.0, 0.0, 1.0]) @ K.T + BIAS + sd * rng.standard_normal((n, 3))
    return dict(zip(("ax", "ay", "az"), raw.T, strict=True))


def test_single_samples_are_told_from_means(cal):
    rng = np.random.default_rng(6)
    samples = still(rng, 400, 20 * SD)
    says = texts(mp.apply(cal, samples, uncertainty=True))
    assert "look like single samples" in says[0]
    said = float(says[0].split("(noise ")[1].split(",")[0])
    assert said == pytest.approx(20 * SD, rel=0.15)  # of 400 differences
    quiet = (
        mp.apply(cal, still(rng, 400, SD), uncertainty=True),  # as averaged readings scatter
        mp.apply(cal, data(rng, 40)[1], uncertainty=True),  # positions
        mp.apply(cal, samples | {"n": np.full(400, 9)}, uncertainty=True),
        mp.apply(cal, samples, uncertainty=True, reading_sd=SD),
    )
    assert not any("single samples" in text for each in quiet for text in texts(each))


def test_the_command_says_which_noise(cal, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cal.save("cal.json")
    rng = np.random.default_rng(6)
    rows = np.column_stack(list(still(rng, 50, 20 * SD).values()))
    np.savetxt("log.csv", rows, delimiter=",", header="ax,ay,az", comments="")
    status, out, _ = run(capsys, "apply", "cal.json", "log.csv", "--uncertainty", "--json")
    assert status == 0
    assert json.loads(out)["noise"] == "that of an averaged reading of the calibration"
    said = " ".join(each["text"] for each in json.loads(out)["findings"])
    assert "include the noise of one reading: that of an averaged reading" in said
    assert "look like single samples" in said
    options = ["--uncertainty", "--reading-sd", "0.04", "--json"]
    status, out, _ = run(capsys, "apply", "cal.json", "log.csv", *options)
    assert (status, json.loads(out)["noise"]) == (0, "--reading-sd")
    assert "single samples" not in " ".join(each["text"] for each in json.loads(out)["findings"])
    status, out, _ = run(capsys, "apply", "cal.json", "log.csv", "--parameters-only")
    assert (status, out) == (2, "")


def test_a_regression_has_the_noise_of_its_rows():
    rng = np.random.default_rng(9)
    t = np.linspace(0.0, 10.0, 30)
    table = {"t": t, "y": 1.0 + 0.5 * t + 0.1 * rng.standard_normal(30)}
    fitted = mp.regress(table, response="y", variables="t")
    found = mp.correct(fitted, table, uncertainty=True)
    X = np.column_stack([np.ones(30), t])
    left = table["y"] - X @ np.linalg.lstsq(X, table["y"], rcond=None)[0]
    s = np.sqrt(left @ left / 28)
    of_mean = s**2 * np.einsum("ij,jk,ik->i", X, np.linalg.inv(X.T @ X), X)
    np.testing.assert_allclose(found["u_corrected"], np.sqrt(of_mean + s**2), rtol=1e-10)
    np.testing.assert_allclose(found["U_corrected"] / found["u_corrected"], 2.0484, atol=1e-4)
    only = mp.correct(fitted, table, uncertainty=True, parameters_only=True)
    np.testing.assert_allclose(only["u_predicted"], np.sqrt(of_mean), rtol=1e-10)
    stated = mp.correct(fitted, table | {"u_y": np.full(30, 0.3)}, uncertainty=True, reading_sd=9.0)
    np.testing.assert_allclose(stated["u_corrected"], np.sqrt(of_mean + 0.09), rtol=1e-10)
    assert stated.noise == "u_y of the data"
    assert found.to_dict()["noise"] == found.noise == "what the regression left of its own rows"
    new = mp.correct(fitted, {"t": [1.0, 2.0]}, uncertainty=True)
    assert list(new) == ["t", "predicted", "u_predicted", "U_predicted", "outside"]
    assert "there is no column 'y' to correct; only predictions are written" in texts(new)[0]


def test_rows_of_samples_are_told_of_models_of_ones_own_too():
    """The slope at no force is asked of every kind of model."""
    rng = np.random.default_rng(3)
    up = mp.read_scheme("faces-corners-14").up
    values = 0.01 + up / (1.0 + 0.02 * up**2) + 1e-4 * rng.standard_normal(up.shape)
    cal = mp.fit(mp.Readings(values, up=up), model="each = b + s*own/(1 + k*own^2)")
    samples = np.array([0.01, 0.01, 1.0]) + 5e-3 * rng.standard_normal((40, 3))
    columns = dict(zip(("ax", "ay", "az"), samples.T, strict=True))
    found = mp.apply(cal, columns, uncertainty=True)
    assert any("look like single samples" in text for text in texts(found))


@pytest.mark.parametrize(
    ("step", "sd", "rows", "more", "found"),
    [
        (0.02, 0.001, 40, (), True),
        (0.02, 0.0072, 40, (), False),  # a step of 0.02/√2 is not twice that
        (0.02, 0.0069, 40, (), True),
        (0.069, 0.001, 40, (), True),  # below and beyond .05 g from sample to sample
        (0.073, 0.001, 40, (), False),
        (1.5e308, 0.001, 40, (), False),  # is refused by its row elsewhere
        (0.02, 0.001, 19, (), False),
        (0.02, 0.001, 40, ("n",), False),
    ],
)
def test_rows_that_look_like_single_samples(step, sd, rows, more, found):
    column = step * (np.arange(rows) % 2 - 0.5) * (1.0 + (step > 1.0))
    table = SimpleNamespace(rows=rows, number=lambda name: column)
    c = SimpleNamespace(outputs=("ax", "ay"), sensitivity=np.eye(3)[:2])
    noise = SimpleNamespace(own=True, sd=np.full(2, sd))
    of = SimpleNamespace(calibration=c, noise=noise)
    said = ReadingUncertainty.find_samples(of, table, ("ax", "ay", *more))
    assert bool(said) == found
    if found:
        assert f"noise {step / np.sqrt(2.0):.2g}," in said[0].text


@pytest.mark.usefixtures("without_findings")
def test_a_reading_at_a_soak_of_its_own_has_its_zero_in_u():
    # Six soaks of 14 positions, zeros of 5 mg, seven times the noise: U held 80 % without them.
    up = mp.read_scheme("faces-corners-14").up
    held, leaning = [], []
    for seed in range(15):
        rng = np.random.default_rng(seed)
        T = np.repeat(rng.permutation(np.linspace(-20.0, 60.0, 6)), 14)
        own = np.repeat(5e-3 * rng.standard_normal((6, 3)), 14, axis=0)
        stood = np.tile(up, (6, 1))
        y = stood @ K.T + own + 1e-4 * T[:, None] + 7e-4 * rng.standard_normal(stood.shape)
        warm = {"temperature": T}
        c = mp.fit(mp.Readings(y, up=stood, environment=warm), model="1 + x + y + z + temperature")
        f = rng.standard_normal((20, 3))
        f /= np.linalg.norm(f, axis=1)[:, None]
        t = rng.uniform(-20.0, 60.0, 20)
        new = f @ K.T + 1e-4 * t[:, None] + rng.standard_normal(f.shape) * np.hypot(5e-3, 7e-4)
        table = dict(zip(c.outputs, new.T, strict=True)) | {"temperature": t}
        found = mp.apply(c, table, uncertainty=True, tilt=True)
        held += [abs(found[f"f_{a}"] - f[:, i]) < found[f"U_f_{a}"] for i, a in enumerate("xyz")]
        tilt = np.degrees(np.arcsin(f[:, 0]))
        leaning += [abs(found["tilt_x_deg"] - tilt) < found["U_tilt_x_deg"]]
    assert 0.88 < np.mean(held) < 0.99  # rows of a sensor share its errors
    assert 0.88 < np.mean(leaning) < 0.99
