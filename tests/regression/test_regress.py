"""`multipos regress`: certified digits, published F, segments, and what it refuses."""

import json
import math
from pathlib import Path

import hald
import nist
import numpy as np
import pytest
from cli_bench import run
from findings_bench import texts
from nist import digits
from numpy.testing import assert_allclose

import multipos as mp
from multipos.errors import MultiposError, UsageError
from multipos.files.tables import format_csv, read_table
from multipos.numerics.least_squares import solve
from multipos.numerics.quantiles import coverage_factor, f_quantile
from multipos.regression.prediction import predict_uncertainty
from multipos.regression.region import region_factor
from multipos.reports.regression_text import regression_text


def write(path, columns):
    path.write_text(format_csv(columns), encoding="utf-8")
    return str(path)


@pytest.fixture
def hald_csv(tmp_path):
    return write(tmp_path / "hald.csv", hald.COLUMNS)


def broken(seed=1, n=600, noise=0.01):
    """A response that bends at 0, with a second variable."""
    rng = np.random.default_rng(seed)
    t, v = rng.uniform(-40, 60, n), rng.standard_normal(n)
    y = 0.1 + 0.02 * t + 0.5 * v + np.where(t > 0, 0.03 * t, 0.0) + rng.normal(0, noise, n)
    return {"t": t, "v": v, "y": y}


# --- truth


@pytest.mark.parametrize("data", nist.DATASETS, ids=str)
def test_nist_certified_digits(data, tmp_path, capsys):
    words = [line.split() for line in data.rows.splitlines() if line.strip()]
    names = ["y", *(f"x{j}" for j in range(1, len(words[0])))]
    path = tmp_path / "data.csv"
    path.write_text("\n".join(map(",".join, [names, *words])), encoding="utf-8")
    if data.powers is None:
        model = ["--variables", ",".join(names[1:])]
    elif 0 in data.powers:
        model = ["--variables", "x1", "--degree", max(data.powers)]
    else:
        model = ["--terms", "x1"]
    status, out, _ = run(capsys, "regress", path, "--response", "y", *model, "--json")
    assert status == 0
    segment = json.loads(out)["segments"][0]
    value = [entry["value"] for entry in segment["terms"]]
    u = [entry["u"] for entry in segment["terms"]]
    assert digits(value, data.coefficients) >= data.digits
    if data.residual_sd:
        assert digits(segment["rms"], data.residual_sd) >= data.digits_sd
        assert digits(u, data.sd) >= data.digits_sd
    assert segment["r2"] == pytest.approx(data.r_squared, rel=1e-9)


def test_paper_table_1_case():
    """n = 21, k = 7: F is judged against F_0.90(7, 13) = 2.2341."""
    rng = np.random.default_rng(1)
    columns = {f"v{i}": rng.standard_normal(21) for i in range(7)}
    columns["error"] = columns["v1"] + rng.standard_normal(21)
    found = mp.regress(
        columns, response="error", variables=[f"v{i}" for i in range(7)], confidence=0.90
    )
    segment = found.segments[0]
    assert segment.dof == (7, 13)
    assert segment.F_critical == pytest.approx(2.2341, abs=5e-5)
    assert segment.significant == (segment.F > 2.2341)


def test_five_variables_make_21_terms():
    rng = np.random.default_rng(2)
    columns = {name: rng.standard_normal(60) for name in "abcde"} | {"y": rng.standard_normal(60)}
    found = mp.regress(columns, response="y", variables="a,b,c,d,e", degree=2)
    assert len(found.candidates) == 21
    assert found.candidates[:7] == ("1", "a", "b", "c", "d", "e", "a^2")
    assert len(found.segments[0].terms) == 21


def test_hald_through_the_command(hald_csv, tmp_path, capsys):
    saved = tmp_path / "hald.json"
    status, out, err = run(
        capsys,
        "regress",
        hald_csv,
        "--response",
        "y",
        "--variables",
        "x1,x2,x3,x4",
        "--stepwise",
        "--enter",
        ".06",
        "--remove",
        ".10",
        "--json",
        "-o",
        saved,
    )
    assert status == 0
    found = json.loads(out)
    assert found["schema"] == "multipos/regression/1"
    assert json.loads(saved.read_text("utf-8")) == found
    segment = found["segments"][0]
    assert [(s["action"], s["term"]) for s in segment["path"]] == [p[:2] for p in hald.PATH]
    assert_allclose([s["F"] for s in segment["path"]], [p[2] for p in hald.PATH], atol=0.5e-4)
    values = {entry["term"]: entry["value"] for entry in segment["terms"]}
    assert values == pytest.approx(hald.COEFFICIENTS, abs=5e-6)
    assert segment["runner_up"]["term"] == "x4"
    assert segment["dof"] == [2, 10]
    assert segment["n"] == 13
    assert segment["range"] == [1, 21]
    assert any("optimistic" in each["text"] for each in found["findings"])
    assert err == ""
    for entry in segment["terms"]:
        assert entry["t"] == pytest.approx(entry["value"] / entry["u"])
    F = (2715.76308 - 57.90448) / 2 / (57.90448 / 10)
    assert segment["F"] == pytest.approx(F, rel=1e-6)
    assert segment["F_critical"] == pytest.approx(f_quantile(0.95, 2, 10))
    assert segment["significant"] is True


def test_press_aicc_and_adjusted_r2_by_their_definitions(hald_csv):
    segment = mp.regress(hald_csv, response="y", variables="x1,x2").segments[0]
    X, y = hald.DESIGN[:, :3], hald.RESPONSE
    left_out = []
    for i in range(13):
        rest = np.arange(13) != i
        left_out.append(y[i] - X[i] @ solve(X[rest], y[rest]).coefficients)
    assert segment.press == pytest.approx(np.sqrt(np.mean(np.square(left_out))), rel=1e-10)
    rss = float(solve(X, y).rss)
    assert segment.aicc == pytest.approx(13 * np.log(rss / 13) + 8 + 2 * 4 * 5 / 8, rel=1e-12)
    tss = ((y - y.mean()) ** 2).sum()
    assert segment.adjusted_r2 == pytest.approx(1 - (rss / 10) / (tss / 12), rel=1e-12)


def test_no_intercept_is_uncentred():
    x = np.arange(1.0, 9.0)
    y = 2 * x + np.tile([0.1, -0.1], 4)
    found = mp.regress({"x": x, "y": y}, response="y", terms="x")
    segment = found.segments[0]
    assert segment.dof == (1, 7)
    rss = ((y - segment.values[0] * x) ** 2).sum()
    assert segment.r2 == pytest.approx(1 - rss / (y @ y), rel=1e-12)
    assert pytest.approx((y @ y - rss) / (rss / 7), rel=1e-9) == segment.F


def test_four_rows_by_hand():
    """x = 1 … 4 and y = 1, 3, 2, 4: slope 4/5, 5 · 0.8² = 3.2 explained, 1.8 left on 2."""
    # eqs. (1), (2) of regression.segment
    columns = {"x": np.array([1.0, 2.0, 3.0, 4.0]), "y": np.array([1.0, 3.0, 2.0, 4.0])}
    segment = mp.regress(columns, response="y", variables="x").segments[0]
    slope = segment.coefficients[1]
    assert segment.dof == (1, 2)
    assert pytest.approx(3.2 / 0.9, rel=1e-12) == segment.F
    # with two degrees p is 1 − t/√(2 + t²), here 1 − 0.8
    assert segment.p == pytest.approx(0.2, rel=1e-9)
    assert (slope.value, slope.u) == (pytest.approx(0.8), pytest.approx(np.sqrt(0.9 / 5)))
    assert slope.t == pytest.approx(np.sqrt(32 / 9))
    assert segment.rms == pytest.approx(np.sqrt(0.9))
    assert segment.r2 == pytest.approx(0.64)
    assert segment.adjusted_r2 == pytest.approx(1 - 0.9 / (5 / 3))
    # residuals −0.3, 0.9, −0.9, 0.3 over 1 − h = 0.3, 0.7, 0.7, 0.3
    assert segment.press == pytest.approx(np.sqrt(65 / 49))
    # without an intercept 29/30 is the slope and 29²/30 of 30 are explained, on 1 and 3
    through = mp.regress(columns, response="y", terms="x").segments[0]
    assert through.dof == (1, 3)
    assert pytest.approx(841 / 30 / (59 / 90), rel=1e-12) == through.F


# --- segments


def test_segments_are_fits_of_their_own_rows():
    columns = broken()
    found = mp.regress(columns, response="y", variables="t,v", segment="t:0", free=True)
    assert [s.range for s in found.segments] == [
        (columns["t"].min(), 0.0),
        (0.0, columns["t"].max()),
    ]
    for segment, rows in zip(found.segments, (columns["t"] < 0, columns["t"] >= 0), strict=True):
        X = np.column_stack((np.ones(rows.sum()), columns["t"][rows], columns["v"][rows]))
        assert_allclose(segment.values, solve(X, columns["y"][rows]).coefficients, rtol=1e-12)
        assert segment.n == rows.sum()
    slopes = [dict(zip(map(str, s.terms), s.values, strict=True))["t"] for s in found.segments]
    assert_allclose(slopes, (0.02, 0.05), atol=5e-4)


def test_edges_found_are_near_the_bend():
    found = mp.regress(broken(), response="y", variables="t,v", segment="t:auto")
    assert len(found.edges) == 1
    assert abs(found.edges[0]) < 5.0


@pytest.mark.parametrize(
    "options", [{}, {"stepwise": True}, {"degree": 3}, {"terms": "1 + t^2 + t*v"}]
)
def test_continuous_segments_meet(options):
    options = {"variables": "t,v", **options}
    found = mp.regress(broken(), response="y", segment="t:-10,0,30", continuous=True, **options)
    for edge in found.edges:
        for v in (-2.0, 0.0, 3.0):
            beside = np.array([np.nextafter(edge, -np.inf), edge])
            below, above = found.predict({"t": beside, "v": np.full(2, v)})
            assert below == pytest.approx(above, abs=1e-11)


def test_continuous_fit_is_constrained_least_squares():
    """The same by Lagrange multipliers: two lines that meet at the edge."""
    # eq. (3) of regression.segmentation
    columns = broken(n=80)
    t, y = columns["t"], columns["y"]
    low = t < 0
    X = np.column_stack((low, low * t, ~low, ~low * t)).astype(float)
    A = np.array([[1.0, 0.0, -1.0, 0.0]])
    K = np.block([[X.T @ X, A.T], [A, np.zeros((1, 1))]])
    truth = np.linalg.solve(K, np.concatenate((X.T @ y, [0.0])))[:4]
    found = mp.regress(columns, response="y", terms="1 + t", segment="t:0", continuous=True)
    assert_allclose(np.concatenate([s.values for s in found.segments]), truth, rtol=1e-9)
    s2 = ((y - X @ truth) ** 2).sum() / (80 - 3)
    covariance = np.linalg.inv(K)[:4, :4] * s2
    assert_allclose(found.segments[1].covariance, covariance[2:, 2:], rtol=1e-8, atol=1e-15)
    assert found.segments[0].dof == (1, 77)
    # the scatter of a segment is on its rows less their leverage
    leverage = np.einsum("ij,jk,ik->i", X, np.linalg.inv(K)[:4, :4], X)
    for segment, rows in zip(found.segments, (low, ~low), strict=True):
        rss = ((y - X @ truth)[rows] ** 2).sum()
        assert segment.rms == pytest.approx(np.sqrt(rss / (rows.sum() - leverage[rows].sum())))


def test_rates_are_formed_from_time_and_used_again(tmp_path, capsys):
    time = np.arange(400.0)
    rate = np.cos(time / 30) * 50 / 30
    y = 0.1 * rate + np.random.default_rng(4).normal(0, 0.001, 400)
    columns = {"time": time, "t": 50 * np.sin(time / 30), "y": y}
    data, model = write(tmp_path / "log.csv", columns), tmp_path / "model.json"
    status, out, _ = run(
        capsys,
        "regress",
        data,
        "--response",
        "y",
        "--variables",
        "t_rate",
        "--rate-window",
        9,
        "-o",
        model,
    )
    assert status == 0
    assert "rate       t_rate: window 9" in out
    found = mp.load_regression(model)
    assert found.rates == {"t_rate": 9.0}
    assert found.segments[0].values[1] == pytest.approx(0.1, rel=0.01)
    left = np.array(mp.correct(found, data)["corrected"])
    assert left.std() < 0.002


# --- honest tests


def test_f_robust_stands_where_rows_are_correlated():
    rng = np.random.default_rng(5)
    n = 400
    noise, x = rng.standard_normal((2, n))
    for i in range(1, n):
        noise[i] += 0.9 * noise[i - 1]
        x[i] += 0.9 * x[i - 1]
    columns = {"time": np.arange(float(n)), "x": x, "y": noise}
    found = mp.regress(columns, response="y", variables="x")
    segment = found.to_dict()["segments"][0]
    assert segment["F_robust"] < segment["F"]
    assert segment["n_effective"] < 100
    assert segment["terms"][1]["u_robust"] > 2 * segment["terms"][1]["u"]
    assert any("equal about" in said for said in texts(found))
    without = {name: column for name, column in columns.items() if name != "time"}
    by_row = mp.regress(without, response="y", variables="x")
    assert by_row.segments[0].robust == found.segments[0].robust
    assert "rows are taken as consecutive" in str(by_row)
    named = without | {"timestamp": columns["time"]}
    assert mp.regress(named, response="y", variables="x").time == "timestamp"
    white = columns | {"y": rng.standard_normal(n)}
    assert mp.regress(white, response="y", variables="x").segments[0].robust is None


def test_empty_model_is_said():
    rng = np.random.default_rng(8)
    columns = {"a": rng.standard_normal(50), "y": rng.standard_normal(50)}
    found = mp.regress(columns, response="y", variables="a", stepwise=True, enter=1e-6)
    assert [str(t) for t in found.segments[0].terms] == ["1"]
    assert found.segments[0].dof == (0, 49)
    assert not found.segments[0].significant
    assert found.to_dict()["segments"][0]["F"] is None
    assert any("mean alone" in said for said in texts(found))


def test_an_f_near_one_means_nothing():
    a = np.linspace(-1.0, 1.0, 50)
    columns = {"a": a, "y": a**2}  # nothing in it is odd, so nothing follows a
    found = mp.regress(columns, response="y", variables="a")
    assert not found.segments[0].significant
    assert any("not significant" in said for said in texts(found))


# --- apply


@pytest.fixture
def fitted(tmp_path):
    columns = broken() | {"raw": np.arange(600.0)}
    data, model = write(tmp_path / "data.csv", columns), tmp_path / "model.json"
    found = mp.regress(data, response="y", variables="t,v", segment="t:0", stepwise=True)
    found.save(model)
    return found, data, model


def test_result_survives_its_file(fitted):
    found, _, model = fitted
    loaded = mp.load_regression(model)
    assert loaded.to_dict() == found.to_dict()
    assert str(loaded) == str(found)


def test_apply_adds_predicted_and_corrected(fitted, capsys, tmp_path):
    # eq. (1) of compensation.correction
    found, data, model = fitted
    out = tmp_path / "out.csv"
    status, text, _ = run(
        capsys, "apply", model, data, "--correct", "raw", "--uncertainty", "-o", out
    )
    assert status == 0
    assert text.startswith("600 rows compensated")

    table = read_table(out)
    assert list(table.columns) == [
        "t",
        "v",
        "y",
        "raw",
        "predicted",
        "corrected",
        "u_predicted",
        "U_predicted",
        "u_corrected",
        "U_corrected",
        "outside",
    ]
    assert_allclose(table.number("corrected"), table.number("raw") - table.number("predicted"))
    left = table.number("y") - table.number("predicted")
    assert left.std() == pytest.approx(0.01, rel=0.1)
    assert not table.number("outside").any()
    default = mp.correct(found, data)
    assert_allclose(np.array(default["corrected"]), left)


def test_rows_outside_are_flagged_clamped_or_refused(fitted, capsys, tmp_path):
    found, _, model = fitted
    high = found.segments[1].limits["t"][1]
    beyond = write(tmp_path / "new.csv", {"t": [10.0, high + 50], "v": [0.0, 0.0], "y": [0.0, 0.0]})
    flagged = mp.correct(found, beyond)
    clamped = mp.correct(found, beyond, outside="clamp")
    assert list(flagged["outside"]) == list(clamped["outside"]) == [0, 1]
    at_edge = mp.correct(found, {"t": [high], "v": [0.0], "y": [0.0]})
    assert clamped["predicted"][1] == pytest.approx(at_edge["predicted"][0])
    status, out, err = run(capsys, "apply", model, beyond, "--outside", "refuse")
    assert (status, out) == (1, "")
    assert "row 2 (line 3), column 't': the row is outside" in err
    status, out, err = run(capsys, "apply", model, beyond)
    assert status == 0
    assert "1 of 2 rows are outside" in err


@pytest.mark.parametrize(
    ("argv", "status", "message"),
    [
        (["{model}", "{data}", "--correct", "nothing"], 1, "no column 'nothing' to correct"),
        (["{model}", "{data}", "--outside", "guess"], 2, "--outside takes flag, clamp, refuse"),
    ],
)
def test_apply_refuses(fitted, capsys, argv, status, message):
    _, data, model = fitted
    found = run(capsys, "apply", *(a.format(model=model, data=data) for a in argv))
    assert found[:2] == (status, "")
    assert message in found[2]


def test_calibrations_have_nothing_to_correct(tmp_path, capsys):
    mp.demo(tmp_path)
    status, out, err = run(
        capsys, "apply", tmp_path / "calibration.json", tmp_path / "readings.csv", "--correct", "ax"
    )
    assert (status, out) == (2, "")
    assert "--correct goes with a regression" in err


# --- bad input

GOOD = broken(n=60)
REGRESS = ["--response", "y", "--variables", "t,v"]


@pytest.mark.parametrize(
    ("change", "argv", "status", "message"),
    [
        ({"v": np.full(60, 7.0)}, REGRESS, 1, "column 'v' is constant (7)"),
        ({"y": np.full(60, 2.5)}, REGRESS, 1, "the response 'y' is constant (2.5)"),
        ({}, [*REGRESS, "--terms", "t^9223372036854775808"], 2, "must lie between 1 and 30"),
        ({"y": 1e300 * GOOD["y"]}, REGRESS, 1, "row 1 (line 2), column 'y': "),
        ({"v": 1e20 * GOOD["v"]}, [*REGRESS, "--degree", "9"], 1, "(beyond 1.29155e+11)"),
        (
            {"time": 1e-39 * np.arange(60.0), "t": 1e35 * GOOD["t"]},
            [*REGRESS, "--variables", "t_rate"],
            1,
            "column 't': the rate there is",
        ),
        (
            {"time": 1e-310 * np.arange(60.0)},
            [*REGRESS, "--variables", "t_rate"],
            1,
            "the time column steps by 1e-310, too little to be squared",
        ),
        (
            {"t": 1e-38 * GOOD["t"]},
            ["--response", "y", "--terms", "1 + t^3"],
            1,
            "column 't' is 5.80737e-37 at most, too small a number to be squared",
        ),
        (
            {"t": 1e-32 * GOOD["t"], "y": 1e30 * GOOD["y"]},
            ["--response", "y", "--terms", "1 + t^3"],
            1,
            "the table: the coefficient of 't^3' is ",
        ),
        ({"v": GOOD["t"]}, REGRESS, 1, "columns 't' and 'v' are the same"),
        ({"v": 1.8 * GOOD["t"] + 32}, REGRESS, 1, "columns 't' and 'v' are the same"),
        ({}, [*REGRESS, "--segment", "t:-37", "--free"], 1, "rows for 3 terms"),
        ({}, [*REGRESS, "--segment", "t:500"], 1, "the edge t = 500 is outside the data"),
        ({}, [*REGRESS, "--segment", "t:5,-5"], 2, "edges must be finite and increase"),
        (
            {"t": np.where(np.abs(GOOD["t"]) < 5.0, 20.0, GOOD["t"])},
            [*REGRESS, "--segment", "t:-5,5", "--continuous"],
            1,
            "segment 2 (t -5 to 5) has no rows; move the edge",
        ),
        (
            {"t": np.where(np.abs(GOOD["t"]) < 5.0, 20.0, GOOD["t"])},
            [*REGRESS, "--segment", "t:-5,5", "--free"],
            1,
            "segment 2 (t -5 to 5) has no rows; move the edge",
        ),
        ({}, [*REGRESS, "--segment", "t"], 2, "VARIABLE:EDGE,EDGE or VARIABLE:auto"),
        ({}, [*REGRESS, "--segment", "t:warm"], 2, "not a list of numbers"),
        ({}, [*REGRESS, "--segment", "q:1"], 1, "no column 'q'"),
        ({}, [*REGRESS, "--continuous"], 2, "--continuous joins segments"),
        ({}, [*REGRESS, "--free"], 2, "--free parts segments"),
        ({"n": GOOD["t"] ** 2}, [*REGRESS, "--segment", "n:5"], 2, "no term has 'n'"),
        ({}, ["--response", "y", "--variables", "t,y"], 2, "'y' is among the variables"),
        ({}, ["--response", "y", "--variables", "t,t"], 2, "names a column twice"),
        ({}, ["--response", "y"], 2, "needs --variables A,B,C or --terms"),
        ({}, [*REGRESS, "--run", ""], 2, "--run names no column"),
        ({}, [*REGRESS, "--run", "y"], 2, "--run names the response 'y'"),
        ({}, ["--response", "q", "--variables", "t"], 1, "no column 'q'"),
        ({}, [*REGRESS, "--degree", "0"], 2, "--degree must lie between 1 and 30"),
        ({}, [*REGRESS, "--degree", "2", "--terms", "1 + t"], 2, "--degree and --terms both"),
        ({}, [*REGRESS, "--terms", "1 + q"], 2, "'q', which is not among --variables"),
        ({}, [*REGRESS, "--terms", "1 + "], 2, "a term is missing"),
        ({}, [*REGRESS, "--stepwise", "--enter", ".2", "--remove", ".1"], 2, "for ever"),
        ({}, [*REGRESS, "--confidence", "95"], 2, "between 0 and 1"),
        ({}, [*REGRESS, "--confidence", "5e-324"], 2, "between 0 and 1"),
        ({}, [*REGRESS, "--variables", "v_rate"], 1, "no time column of numbers to form it from"),
        ({}, [*REGRESS, "--variables", "t,t_rate", "--time", "v"], 1, "does not increase"),
        ({}, [*REGRESS, "--run", "group"], 1, "no column 'group'"),
    ],
)
def test_bad_input_is_named(tmp_path, capsys, change, argv, status, message):
    data = write(tmp_path / "data.csv", GOOD | change)
    saved = tmp_path / "never.json"
    found = run(capsys, "regress", data, *argv, "-o", saved)
    assert found[:2] == (status, ""), found[2]
    last = found[2].strip().splitlines()[-1]
    assert last.startswith("multipos: error: ")
    assert message in last
    assert not saved.exists()


def test_missing_cells_are_named_counted_and_dropped_on_request(tmp_path, capsys):
    columns = {name: column.copy() for name, column in GOOD.items()}
    columns["t"][4] = columns["v"][[4, 9]] = np.nan
    data = write(tmp_path / "data.csv", columns)
    status, out, err = run(capsys, "regress", data, *REGRESS)
    assert (status, out) == (1, "")
    assert "row 5" in err
    assert "2 of 60 rows have an empty cell (1 in 't', 2 in 'v'; rows 5, 10)" in err
    assert "--drop-missing" in err
    status, out, err = run(capsys, "regress", data, *REGRESS, "--drop-missing", "--json")
    assert status == 0
    found = json.loads(out)
    assert (found["n"], found["dropped"]) == (58, 2)
    assert any("2 of 60 rows were omitted" in each["text"] for each in found["findings"])
    columns["t"][:] = np.nan
    with pytest.raises(MultiposError, match="every row has an empty cell"):
        mp.regress(columns, response="y", variables="t,v", drop_missing=True)


def test_constant_alone_is_refused():
    with pytest.raises(UsageError, match="holds no variable"):
        mp.regress(GOOD, response="y", terms="1")


@pytest.mark.parametrize("column", ["t", "y"])
def test_a_corrupt_number_is_not_corrected(column):
    found = mp.regress(GOOD, response="y", variables="t,v")
    bad = {name: values.copy() for name, values in GOOD.items()}
    bad[column][7] = -1e155
    with pytest.raises(MultiposError, match=rf"row 8, column '{column}': -1e\+155 is no number"):
        mp.correct(found, bad)


def test_one_row_has_no_rate():
    one = {name: column[:1] for name, column in GOOD.items()} | {"time": [0.0]}
    with pytest.raises(MultiposError, match="does not increase at row 1"):
        mp.regress(one, response="y", variables="t_rate")


@pytest.mark.parametrize("name", ["branches", "subsets", "backward"])
def test_a_file_of_version_0_2_predicts_as_it_did(name, tmp_path):
    """What that version wrote and predicted, of fits that are made no more."""
    kept = json.loads(Path(__file__).with_name("regressions_0_2.json").read_text("utf-8"))
    (tmp_path / "reg.json").write_text(json.dumps(kept[name]["file"]), "utf-8")
    found = mp.load_regression(tmp_path / "reg.json")
    after = mp.correct(found, kept["rows"], uncertainty=True)
    assert_allclose(after["predicted"], kept[name]["predicted"], rtol=1e-12)
    assert_allclose(after["U_predicted"], kept[name]["U"], rtol=1e-10)
    assert list(after["outside"]) == kept[name]["outside"]
    found.save(tmp_path / "again.json")
    assert mp.load_regression(tmp_path / "again.json") == found


@pytest.mark.parametrize("text", ["{", '{"schema": "multipos/regression/1"}'])
def test_damaged_file_is_refused(tmp_path, capsys, text):
    path = tmp_path / "model.json"
    path.write_text(text, encoding="utf-8")
    data = write(tmp_path / "data.csv", GOOD)
    status, out, err = run(capsys, "apply", path, data)
    assert (status, out) == (1, "")
    assert str(path) in err


def test_a_regression_of_a_file_called_anything_is_read_back(tmp_path):
    path = tmp_path / "\x1b[31m.csv"
    path.write_text("y,t\n1,0\n2,1\n3.5,2\n4,3\n")
    mp.regress(path, response="y", variables="t").save(tmp_path / "r.json")
    assert mp.load_regression(tmp_path / "r.json").source.endswith(r"\u001b[31m.csv")


def test_rows_that_are_not_apart_are_a_doubt_first_of_what_is_said(tmp_path):
    """Rows with AR(.9) noise, no time column: their finding is kept by the file, and by several."""
    rng = np.random.default_rng(4)
    noise = np.empty(200)
    noise[0] = rng.standard_normal()
    for i in range(1, 200):
        noise[i] = 0.9 * noise[i - 1] + rng.standard_normal()
    table = {"T": np.linspace(0.0, 50.0, 200), "y": noise, "z": noise + 1.0}
    found = mp.regress(table, response="y", variables="T")
    finding = found.findings[0]
    assert "turn-on" in [one.code for one in found.findings]
    assert (finding.code, finding.level) == ("time-correlated", "warning")
    assert texts(found)[0] == str(finding)
    assert texts(found).count(str(finding)) == 1
    found.save(tmp_path / "reg.json")
    assert mp.load_regression(tmp_path / "reg.json").findings == found.findings
    both = mp.regress(table, response="y,z", variables="T")
    assert both.findings[0].text == f"y: {finding.text}"
    white = {"T": table["T"], "y": rng.standard_normal(200)}
    said = mp.regress(white, response="y", variables="T").findings
    assert "time-correlated" not in [one.code for one in said]


def test_as_many_terms_as_rows_is_a_finding():
    table = {"T": [0.0, 1.0], "y": [1.0, 3.0]}
    assert [d.code for d in mp.regress(table, response="y", variables="T").findings] == [
        "no-redundancy",
        "turn-on",
    ]


def test_u_of_a_stated_noise_by_hand():
    """A mean of n rows with s², and a stated noise: Welch and Satterthwaite, JCGM 100 G.4.1."""
    # eq. (1) of regression.prediction
    y = np.array([1.0, 2.0, 4.0, 5.0])  # mean 3, s² = 10/3 on 3 degrees of freedom
    table = {"x": np.array([0.0, 1.0, 2.0, 3.0]), "y": y}
    fitted = mp.regress(table, response="y", variables="x", terms="1")
    own, noise = 10.0 / 3.0 / 4.0, 0.5**2
    u, U = predict_uncertainty(fitted, {"x": np.ones(1)}, np.zeros(1, int), np.full(1, 0.5))
    assert u == pytest.approx(math.sqrt(own + noise), rel=1e-12)
    dof = 3.0 * ((own + noise) / own) ** 2  # 5.07: t of 5 and of 5.1 differ by .5 %
    assert U / u == pytest.approx(coverage_factor(0.95, dof), rel=5e-3)


def test_the_region_of_a_term_that_varied_too_little_by_hand():
    """Leverage of a line, and of what lies off it, over its length or over ℓ if that is more."""
    # eq. (2) of regression.region
    x = np.linspace(-1.0, 1.0, 11)
    z = 1e-3 * (x**2 - np.mean(x**2)) + 2.0 * x + 1.0
    kept = np.column_stack([np.ones(11), x])
    at = np.array([[1.0, 0.5, 3.0], [1.0, 2.0, 5.1]])
    line = 1.0 / 11.0 + np.array([0.5, 2.0]) ** 2 / np.sum(x**2)
    beyond = at[:, 2] - 1.0 - 2.0 * at[:, 1]  # what z has beside 1 + 2 x
    for shortest in (1e-9, 0.1):
        G = region_factor(kept, z[:, None], np.array([shortest]))
        length = max(shortest, 1e-3 * np.linalg.norm(x**2 - np.mean(x**2)))
        np.testing.assert_allclose(
            np.sum((at @ G.T) ** 2, axis=1), line + (beyond / length) ** 2, rtol=1e-6
        )


@pytest.mark.parametrize(
    ("terms", "kink", "rows"),
    [
        ("T", 0.0, (None, 1)),  # below the kink there is no term at all
        ("H + T", 10.0, (None, 1)),  # above it are 1 and T, of one column of the fit
    ],
)
def test_terms_that_share_a_column_and_a_segment_of_none(terms, kink, rows, tmp_path):
    rng = np.random.default_rng(3)
    t = np.linspace(-40.0, 60.0, 200)
    table = {"T": t, "H": rng.normal(size=200)}
    table["y"] = 0.01 * np.maximum(t - kink, 0.0) + 1e-4 * rng.normal(size=200)
    options = {"segment": f"T:{kink:g}", "stepwise": True}
    found = mp.regress(table, response="y", terms=terms, **options)
    assert tuple(s.region and len(s.region.factor) for s in found.segments) == rows
    found.save(tmp_path / "r.json")
    again = mp.load_regression(tmp_path / "r.json")
    assert_allclose(again.predict(table), found.predict(table))
    assert_allclose(found.predict(table)[t < kink], 0.0)
    after = mp.correct(again, {"T": [61.0, 59.0, -30.0], "H": [0.0] * 3})
    assert list(after["outside"]) == [1, 0, 0]


def test_a_variable_that_nearly_follows_from_others_is_named_and_left_out():
    """device = ambient − 5 × rate but for .01: the inflation is by R² of the others."""
    rng = np.random.default_rng(3)
    ambient, rate = rng.uniform(-20.0, 60.0, 200), rng.uniform(-1.0, 1.0, 200)
    device = ambient - 5.0 * rate + 0.01 * rng.standard_normal(200)
    columns = {"T": device, "ambient": ambient, "rate": rate}
    columns["y"] = 1.0 + 0.1 * ambient + 0.1 * rng.standard_normal(200)
    found = mp.regress(columns, response="y", variables="T,ambient,rate")
    (said,) = [each for each in found.findings if each.code == "collinear-terms"]
    assert found.segments[0].significant
    assert len(said.text) <= 160
    name = said.action.removeprefix("Leave out ").removesuffix(".")
    kept = [v for v in ("T", "ambient", "rate") if v != name]
    others = np.column_stack([np.ones(200), *(columns[v] for v in kept)])
    left = columns[name] - others @ np.linalg.lstsq(others, columns[name], rcond=None)[0]
    inflation = float(((columns[name] - columns[name].mean()) ** 2).sum() / (left @ left))
    assert said.level == "warning"
    assert f"{inflation:.3g} times" in said.text
    again = mp.regress(columns, response="y", variables=kept)
    assert "collinear-terms" not in {each.code for each in again.findings}
    u = [{c.term: c.u for c in r.segments[0].coefficients}[kept[0]] for r in (found, again)]
    assert u[1] < u[0] / 100.0


def test_a_mean_alone_prints_no_nan():
    rng = np.random.default_rng(4)
    columns = {"x": rng.standard_normal(50), "y": rng.standard_normal(50)}
    found = mp.regress(columns, response="y", variables="x", stepwise=True)
    assert [str(term) for term in found.segments[0].terms] == ["1"]
    assert "nan" not in regression_text(found)
