"""`check` of a regression on an independent run, and the figures that `-o FILE.svg` draws."""

import json
import math
import xml.etree.ElementTree as ET
from types import SimpleNamespace

import numpy as np
import pytest
from cli_bench import run
from findings_bench import texts
from numpy.testing import assert_allclose
from scipy import stats
from scipy.stats import f

import multipos as mp
from multipos.errors import MultiposError, UsageError
from multipos.files.tables import format_csv
from multipos.numerics.quantiles import coverage_factor
from multipos.reports.check_text import check_text
from multipos.verification import regression_checks
from multipos.verification.regression_checks import _judge_by, _weighed


def chamber(seed, n=80, noise=1e-3):
    """An error that bends at 20 °C, and the reading that carries it."""
    rng = np.random.default_rng(seed)
    t = rng.uniform(-40.0, 60.0, n)
    error = 0.01 + 3e-4 * t + 2e-4 * np.maximum(t - 20.0, 0.0) + noise * rng.standard_normal(n)
    return {"temperature": t, "V": 1.0 + error, "error": error}


def fitted(seed=1, **options):
    options = {"variables": "temperature", "segment": "temperature:20", "free": True} | options
    return mp.regress(chamber(seed), response="error", **options)


def write(path, columns):
    path.write_text(format_csv(columns), encoding="utf-8")
    return str(path)


@pytest.fixture
def files(tmp_path):
    model = tmp_path / "model.json"
    fitted(confidence=0.9).save(model)
    return model, write(tmp_path / "run.csv", chamber(2, 60)), tmp_path


def test_before_after_and_u_by_hand():
    # eq. (1) of verification.regression_checks
    columns, later = chamber(1), chamber(2, 40)
    found = mp.check(fitted(), later, limit_g=0.01)
    assert_allclose(found.before[:, 0], later["error"])
    for cold, rows, new in (
        (True, columns["temperature"] < 20, later["temperature"] < 20),
        (False, columns["temperature"] >= 20, later["temperature"] >= 20),
    ):
        assert new.any(), cold
        X = np.column_stack([np.ones(rows.sum()), columns["temperature"][rows]])
        b, rss, *_ = np.linalg.lstsq(X, columns["error"][rows], rcond=None)
        s2 = float(rss[0]) / (rows.sum() - 2)
        Z = np.column_stack([np.ones(new.sum()), later["temperature"][new]])
        u = np.sqrt(s2 * (1.0 + np.einsum("ij,jk,ik->i", Z, np.linalg.inv(X.T @ X), Z)))
        assert_allclose(found.after[new, 0], later["error"][new] - Z @ b, rtol=0, atol=1e-14)
        assert_allclose(found.u[new, 0], u, rtol=1e-9)
        assert_allclose(found.U[new, 0], coverage_factor(0.95, float(rows.sum() - 2)) * u)
    fewest = min((columns["temperature"] < 20).sum(), (columns["temperature"] >= 20).sum()) - 2.0
    of_all = stats.t.ppf(1.0 - 0.025 / found.counted.sum(), fewest) / stats.t.ppf(0.975, fewest)
    assert_allclose(found.U_family, found.U * of_all, rtol=1e-6)
    left = np.asarray(mp.correct(fitted(), later, column="V")["corrected"]) - 1.0
    assert_allclose(found.after[:, 0], left, rtol=0, atol=1e-14)  # the corrected output's error


@pytest.mark.slow
def test_the_guard_band_covers_what_is_left():
    """At 95 %: new rows are normal about the truth, so the share within U is known of every fit."""
    held = []
    for seed in range(50):
        found = mp.check(fitted(seed), chamber(1000 + seed, 12, noise=0.0))
        off, U = (
            np.asarray(each)[found.counted[:, 0], 0] / 1e-3 for each in (found.after, found.U)
        )
        held.append(np.mean(stats.norm.cdf(U - off) - stats.norm.cdf(-U - off)))
    assert abs(np.mean(held) - 0.95) < 4.0 * np.std(held, ddof=1) / math.sqrt(len(held))
    assert np.std(held) < 0.05  # what 400 single rows would tell is known as well by 50 fits


@pytest.mark.parametrize(("limit", "verdict"), [(0.02, "pass"), (0.003, "indeterminate")])
def test_verdict_against_the_limit(limit, verdict):
    found = mp.check(fitted(), chamber(2, 60), limit_g=limit)
    assert found.verdict == verdict
    assert found.summary()["before"]["maximum"] > 5 * found.summary()["after"]["maximum"]


def test_a_fault_in_one_segment_fails_there_alone():
    later = chamber(2, 60)
    row = int(np.flatnonzero((later["temperature"] > 25) & (later["temperature"] < 55))[0])
    later["error"][row] += 0.02
    found = mp.check(fitted(), later, limit_g=0.01)
    verdicts = [found.summary(segment=name)["verdict"] for name in found.segments]
    assert verdicts == ["pass", "fail"]
    assert found.verdict == "fail"
    assert found.verdicts[row, 0] == "fail"


def test_rows_outside_are_not_counted_and_said():
    later = chamber(2, 60)
    later["temperature"][4], later["error"][4] = 90.0, 5.0
    found = mp.check(fitted(), later, limit_g=0.02)
    assert not found.counted[4, 0]
    assert found.verdict == "pass"
    assert found.summary()["before"]["maximum"] < 0.1
    assert texts(found) == (
        "1 of 60 rows are outside the range of the regression and were not counted",
    )
    later["temperature"][:] = 90.0
    with pytest.raises(MultiposError, match="all 60 rows are outside"):
        mp.check(fitted(), later)


def test_correlated_rows_have_the_robust_covariance_and_dof():
    rng = np.random.default_rng(5)
    time = np.arange(400.0)
    noise = np.zeros(400)
    for i in range(1, 400):
        noise[i] = 0.8 * noise[i - 1] + 1e-3 * rng.standard_normal()
    t = 20.0 + 30.0 * np.sin(time / 60.0)
    columns = {"time": time, "temperature": t, "error": 1e-4 * t + noise}
    regression = mp.regress(columns, response="error", variables="temperature")
    (segment,) = regression.segments
    found = mp.check(regression, columns)
    k = coverage_factor(0.95, segment.robust.t_dof)
    assert_allclose(found.U, k * found.u)
    X = np.column_stack([np.ones(400), t])
    variance = np.einsum("ij,jk,ik->i", X, segment.robust.covariance, X) + segment.rms**2
    assert_allclose(found.u[:, 0], np.sqrt(variance))


def test_json_has_the_keys_of_a_check(files, capsys):
    model, later, folder = files
    status, out, err = run(capsys, "check", model, later, "--limit-g", "0.01", "--json")
    assert (status, err) == (0, "")
    found = json.loads(out)
    assert found["schema"] == "multipos/check/1"
    assert (found["quantity"], found["against"], found["unit"]) == ("error", "temperature", "g")
    assert found["confidence"] == 0.9
    assert (found["axes"], found["nominal"]) == (["error"], None)
    assert set(found["before"]) == {"maximum", "rms", "linearity_percent"}
    assert found["before"]["linearity_percent"] is None
    assert set(found["by_axis"]) == {"error"}
    cold = int((chamber(2, 60)["temperature"] < 20).sum())
    assert [entry["rows"] for entry in found["by_segment"].values()] == [cold, 60 - cold]
    row = found["positions"][0]
    assert set(row) == {
        "position",
        "reference",
        "before",
        "after",
        "u",
        "U",
        "En",
        "U_family",
        "verdict",
        "counted",
    }
    assert row["position"] == "1"
    assert row["reference"]["error"] == chamber(2, 60)["temperature"][0]
    assert run(capsys, "check", model, later, "-o", folder / "check.json")[0] == 0
    assert json.loads((folder / "check.json").read_text("utf-8"))["unit"] is None


def test_text_is_by_segment(files, capsys):
    model, later, _ = files
    status, out, _ = run(capsys, "check", model, later, "--limit-g", "0.01")
    assert status == 0
    found = mp.check(mp.load_regression(model), later, limit_g=0.01)
    answer, _, rest = out.partition("\n\n")
    assert answer.startswith("Pass: largest error ")
    assert rest == check_text(found)
    lines = rest.splitlines()
    assert lines[0] == "Errors before and after correction"
    assert [line[:14] for line in lines[3:6]] == [
        "1: temperature",
        "2: temperature",
        "all" + 11 * " ",
    ]
    assert int(lines[5].split()[1]) == found.counted.sum()
    assert f"with U (90 %) as guard band: {found.counted.sum()} pass" in out
    assert "[g]" not in run(capsys, "check", model, later)[1]


def test_an_empty_model_is_checked_row_by_row():
    columns = {"a": np.arange(30.0), "y": np.random.default_rng(1).standard_normal(30)}
    empty = mp.regress(columns, response="y", variables="a", stepwise=True, enter=1e-6)
    found = mp.check(empty, {"y": columns["y"][:5]})
    assert found.against == "row"
    assert found.reference[:, 0].tolist() == [1, 2, 3, 4, 5]
    assert_allclose(found.after[:, 0], columns["y"][:5] - columns["y"].mean())


@pytest.mark.parametrize(
    ("options", "status", "message"),
    [
        (["--scheme", "faces-6"], 2, "--scheme goes with a calibration"),
        (["--tilt"], 2, "--tilt goes with a calibration"),
        (["--limit-deg", "1"], 2, "goes with a calibration"),
        (["--within-deg", "60"], 2, "--within-deg goes with a calibration"),
        (["--nominal", "2.5,1"], 2, "--nominal goes with a calibration"),
        (["--reading-sd", "1"], 2, "--reading-sd goes with a calibration"),
        (["--range", "-1,1"], 2, "--range goes with a calibration"),
        (["--limit-g", "0"], 2, "--limit-g must be above 0"),
        (["-o", "no/folder/check.svg"], 1, "cannot write"),
    ],
)
def test_options_at_fault(files, capsys, options, status, message):
    model, later, _ = files
    found = run(capsys, "check", model, later, *options)
    assert found[:2] == (status, "")
    last = found[2].strip().splitlines()[-1]
    assert last.startswith("multipos: error: ")
    assert message in last


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"error": None}, "no column 'error', the response; a check needs the error"),
        ({"temperature": None}, "no column 'temperature', which this regression needs"),
        ({"error": np.append(np.nan, np.zeros(59))}, "row 1 (line 2), column 'error': the cell"),
        ({"temperature": np.full(60, 500.0)}, "all 60 rows are outside"),
        ({"predicted": np.zeros(60)}, "column 'predicted' is there already"),
    ],
)
def test_runs_at_fault(files, capsys, change, message):
    model, _, folder = files
    columns = chamber(2, 60) | change
    later = write(folder / "bad.csv", {k: v for k, v in columns.items() if v is not None})
    status, out, err = run(capsys, "check", model, later, "-o", folder / "check.svg")
    assert (status, out) == (1, "")
    assert message in err.strip().splitlines()[-1]
    assert not (folder / "check.svg").exists()


# --- which function reads and applies what


def test_a_regression_is_sent_to_its_own_functions(files, capsys):
    model, later, folder = files
    with pytest.raises(MultiposError, match=r"a regression is read by multipos\.load_regression"):
        mp.load(model)
    with pytest.raises(TypeError, match=r"got Regression; for a regression call `multipos\.corr"):
        mp.apply(mp.load_regression(model), later)
    assert run(capsys, "report", model, "-o", folder / "r.html")[0] == 0
    mp.demo(folder)
    with pytest.raises(MultiposError, match=r"a calibration is read by multipos\.load\."):
        mp.load_regression(folder / "calibration.json")


# --- figures


def words(path):
    root = ET.fromstring(path.read_text("utf-8"))
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    return [e.text for e in root.iter("{http://www.w3.org/2000/svg}text")]


def test_check_draws_the_errors(files, capsys):
    model, later, folder = files
    figure = folder / "check.SVG"
    status, out, _ = run(capsys, "check", model, later, "--limit-g", "0.005", "-o", figure)
    assert status == 0
    assert out.startswith("Pass: largest error ")
    said = words(figure)
    for text in ("temperature", "error [mg]", "before", "after, with U", "limit ±5 mg"):
        assert text in said


def test_regress_draws_correction_and_paths(tmp_path, capsys):
    data = write(tmp_path / "data.csv", chamber(1))
    options = ["regress", data, "--response", "error", "--variables", "temperature", "--stepwise"]
    figure = tmp_path / "model.svg"
    options += ["--segment", "temperature:20", "--free"]
    status, out, _ = run(capsys, *options, "-o", figure)
    assert status == 0
    assert out.startswith("error by temperature: ")
    assert "80 rows, 2 segments" in out.splitlines()[0]
    said = words(figure)
    assert said.count("+ temperature") == 2
    high = chamber(1)["temperature"].max()
    assert f"temperature 20 to {high:.5g}" in said
    assert run(capsys, *options[:-1], "--hierarchy", "-o", figure)[0] == 0
    assert "all segments" in words(figure)


def test_regress_draws_without_the_rows_it_dropped_and_with_formed_rates(tmp_path, capsys):
    columns = chamber(1) | {"time": np.arange(80.0)}
    columns["temperature"] = 20.0 + 30.0 * np.sin(columns["time"] / 12.0)
    columns["error"][3] = np.nan
    data = write(tmp_path / "data.csv", columns)
    figure = tmp_path / "model.svg"
    options = ["regress", data, "--response", "error", "--variables"]
    options += ["temperature_rate,temperature", "--drop-missing", "-o", figure]
    assert run(capsys, *options)[0] == 0
    assert "temperature_rate" in words(figure)


def test_tumble_draws_signal_and_harmonics(tmp_path, capsys):
    t = 2.0 * np.pi * np.arange(12) / 12
    rng = np.random.default_rng(1)
    data = write(tmp_path / "t.csv", {"E": np.cos(t) + 1e-5 * rng.standard_normal(12)})
    figure = tmp_path / "t.svg"
    status, out, _ = run(capsys, "tumble", data, "--scheme", "tumble-12", "-o", figure)
    assert (status, out[:6]) == (0, "E: K1 ")
    assert {"angle [°]", "order", "plane xy"} <= set(words(figure))


def test_options_of_a_calibration_are_refused_in_python_too():
    with pytest.raises(UsageError, match="--nominal goes with a calibration"):
        mp.check(fitted(), chamber(2), nominal=(0.0, 2.0))


def switch_on(seed, zero, n=120):
    rng = np.random.default_rng(seed)
    t = np.linspace(-40.0, 60.0, n)
    noise = np.zeros(n)
    for i in range(1, n):
        noise[i] = 0.5 * noise[i - 1] + rng.normal(0.0, 1e-4)
    return {"time": np.arange(float(n)), "t": t, "error": 1e-3 + 2e-4 * t + noise + zero}


def test_a_run_as_a_whole_is_judged_by_its_rows_and_its_switch_on():
    """Zeros of .5 mg from run to run: one run denies the next, four know it; 20 mg are none."""
    zeros = 5e-4 * np.array([0.3, -1.1, 1.2, -0.4])
    runs = [switch_on(seed, zero) for seed, zero in enumerate(zeros)]
    joined = {name: np.concatenate([one[name] for one in runs]) for name in runs[0]}
    joined["run"] = np.repeat(np.arange(4), 120)
    one = mp.regress(runs[0], response="error", variables="t")
    four = mp.regress(joined, response="error", variables="t", run="run")
    same, other, far = (switch_on(9, zero) for zero in (zeros[0], zeros[1], 2e-2))
    assert mp.check(one, same).consistency.p > 0.01
    denied = mp.check(one, other)
    assert denied.consistency.p < 0.01
    assert denied.findings[0].code == "run-disagrees"
    assert "without --run" in denied.findings[0].text
    assert mp.check(four, other).consistency.p > 0.05
    assert mp.check(four, far).consistency.p < 0.01


def test_runs_may_differ_by_a_slope_in_one_segment_alone():
    runs = [switch_on(seed, 1e-4 * seed) for seed in range(4)]
    for one, slope in zip(runs, (-3e-5, 1e-5, 4e-5, -2e-5), strict=True):
        one["error"] += slope * np.maximum(one["t"], 0.0)
    joined = {name: np.concatenate([one[name] for one in runs]) for name in runs[0]}
    joined["run"] = np.repeat(np.arange(4), 120)
    options = {"segment": "t:0", "free": True, "run": "run"}
    found = mp.regress(joined, response="error", variables="t", **options)
    assert [len(s.between.covariance) for s in found.segments] == [1, 2]
    assert mp.check(found, runs[2]).consistency.p > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("n", [60, 100])
def test_a_short_run_of_slow_noise_is_rarely_rejected(n):
    """Own generator: a second run of the same sensor, AR(.9); 5 and 1 % of 200 runs, + 3 sd."""
    p = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        runs = []
        for _ in range(2):
            t = np.linspace(-40.0, 60.0, n) + rng.normal(0.0, 0.3, n)
            noise = rng.normal(size=n)
            for row in range(1, n):
                noise[row] = 0.9 * noise[row - 1] + np.sqrt(0.19) * noise[row]
            error = 0.01 + 1e-4 * t + 1e-6 * t**2 + 1e-3 * noise
            runs.append({"time": np.arange(float(n)), "t": t, "error": error})
        found = mp.regress(runs[0], response="error", terms="1 + t + t^2", time="time")
        p.append(mp.check(found, runs[1]).consistency.p)
    assert np.mean(np.array(p) < 0.05) <= 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / 200)
    assert np.mean(np.array(p) < 0.01) <= 0.01 + 3.0 * np.sqrt(0.01 * 0.99 / 200)


def test_the_run_as_a_whole_by_hand(monkeypatch):
    """White noise, one switch-on: b'V⁻¹b of the two coefficients that the run itself shows."""
    # eq. (2) of verification.regression_checks
    rng = np.random.default_rng(12)
    runs = []
    for n in (60, 40):
        t = rng.permutation(np.linspace(-40.0, 60.0, n))
        runs.append({"t": t, "error": 1e-3 + 2e-4 * t + 1e-3 * rng.standard_normal(n)})
    monkeypatch.setattr(regression_checks, "find_noise", lambda *_: None)  # of white noise alone
    model = mp.regress(runs[0], response="error", terms="1 + t")
    found = mp.check(model, runs[1]).consistency
    X, Z = (np.column_stack([np.ones(len(one["t"])), one["t"]]) for one in runs)
    b, rss, *_ = np.linalg.lstsq(X, runs[0]["error"], rcond=None)
    C = float(rss[0]) / 58.0 * np.linalg.inv(X.T @ X)
    assert model.segments[0].robust is None
    B = np.linalg.qr(Z)[0]
    e = runs[1]["error"] - Z @ b
    s2 = float(np.sum((e - B @ (B.T @ e)) ** 2)) / 38.0
    V = s2 * np.eye(2) + B.T @ Z @ C @ Z.T @ B
    F = B.T @ e @ np.linalg.solve(V, B.T @ e) / 2.0
    assert found.p == pytest.approx(f.sf(F, 2, 38), rel=1e-6)


@pytest.mark.parametrize("between", [False, True])
def test_the_agreement_of_a_run_by_dense_covariances(between):
    """Q of what the terms explain, on the fewer degrees of freedom; of runs each its own mean."""
    rng = np.random.default_rng(9)
    n, X = 24, rng.normal(size=(24, 3))
    Z = np.kron(np.eye(2), np.ones((12, 1))) if between else np.zeros((n, 0))
    e, root = rng.normal(size=n), 0.3 * rng.normal(size=(3, 3))
    unit = np.array([1e-3, 1.0, 1e3])  # that terms are in changes nothing
    X, root = X * unit, root / unit[:, None]
    runs = SimpleNamespace(covariance=np.array([[0.25]]), runs=5)
    segment = SimpleNamespace(robust_dof=15.0, between=runs if between else None)
    rows = (e, X, X @ root, Z)
    found = _judge_by(SimpleNamespace(segments=[segment]), rows, lambda both: both)
    K = np.eye(n) - Z @ np.linalg.pinv(Z)  # of what runs leave
    B = np.linalg.qr(K @ X)[0]
    nu = n - Z.shape[1] - 3
    s2 = (np.sum((K @ e) ** 2) - np.sum((B.T @ e) ** 2)) / nu
    V = s2 * np.eye(3) + B.T @ X @ root @ root.T @ X.T @ B
    Q = (B.T @ e) @ np.linalg.solve(V, B.T @ e)
    p = [stats.f.sf(Q / 3, 3, min(nu, 15))]
    if between:
        for k in range(2):
            mean, own = e[12 * k : 12 * k + 12].mean(), X[12 * k : 12 * k + 12].mean(axis=0)
            v = s2 / 12 + np.sum((own @ root) ** 2) + 0.25
            p.append(stats.f.sf(mean**2 / v, 1, 4))
        assert found.p == pytest.approx(stats.combine_pvalues(p).pvalue, rel=1e-6)
    else:
        assert found.statistic == pytest.approx(Q / 3, rel=1e-9)
        assert found.p == pytest.approx(p[0], rel=1e-9)


def test_a_variance_beside_which_no_noise_has_digits_agrees_with_everything():
    """V = s² I + v v' with v beyond 1e16 s: only what is across v is weighed, by s² alone."""
    a, v = np.array([3.0, 4.0]), np.array([1e20, 1e20])
    assert _weighed(a, np.eye(2) + np.outer(v, v)) <= (a @ [1.0, -1.0]) ** 2 / 2.0 * (1.0 + 1e-9)


def test_a_model_of_no_term_is_written_read_and_checked(tmp_path):
    """Noise shows no slope; without a constant nothing is left, and the error stays as it was."""
    rng = np.random.default_rng(4)
    columns = {"T": rng.standard_normal(40), "y": rng.standard_normal(40)}
    found = mp.regress(columns, response="y", variables="T", terms="T", stepwise=True)
    assert any("the model is zero, as it lacks 1" in text for text in texts(found))
    found.save(tmp_path / "r.json")
    r = mp.load_regression(tmp_path / "r.json")
    check = mp.check(r, columns)
    assert r.segments[0].terms == ()
    assert_allclose(np.ravel(check.after), columns["y"])
    with pytest.raises(MultiposError, match="is a constant, a function of no input"):
        mp.export(r, to="c")


@pytest.mark.filterwarnings("ignore::multipos.errors.CalibrationWarning")
def test_a_run_is_not_judged_where_the_fit_had_as_many_terms_as_rows():
    columns = {"T": np.array([1.0, 2.0, 4.0]), "H": [2.0, 1.0, 2.0], "y": [3.0, 1.0, 4.0]}
    r = mp.regress(columns, response="y", variables="T,H")
    assert r.segments[0].dof == (2, 0)
    assert mp.check(r, columns).consistency.test == "none: the noise of the readings is not known"
