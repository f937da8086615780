"""`check`: errors before and after, verdicts with a guard band, for pairs and for triads."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from known_noise import with_known_noise
from numpy.testing import assert_allclose
from scipy.stats import norm

import multipos as mp
from multipos import cli
from multipos.positions.scheme import read_scheme
from multipos.reports.check_text import check_text
from multipos.sensor.nominal import Nominal
from multipos.verification.checks import RunNoise, _expanded, force_errors, line_departure
from multipos.verification.verdicts import judge_errors

FACES = read_scheme("faces-corners-14").up
SD = 1e-4


def triad(seed=0, sd=SD, scheme="faces-corners-14", **options):
    up = read_scheme(scheme).up
    matrix = np.array([[1.01, 0.002, 0.0], [0.0, 0.99, 0.001], [0.003, 0.0, 1.0]])
    raw = [0.01, -0.02, 0.005] + up @ matrix.T
    raw += sd * np.random.default_rng(seed).standard_normal(raw.shape)
    return dict(zip(("ax", "ay", "az"), raw.T, strict=True)), scheme


@pytest.fixture
def calibration():
    columns, scheme = triad()
    return mp.fit(columns, scheme=scheme, unit="g")


def test_triad_before_and_after(calibration):
    # eq. (1) of verification.checks
    columns, scheme = triad(seed=1)
    found = mp.check(calibration, columns, scheme=scheme, limit_g=0.002)
    raw = np.column_stack(list(columns.values()))
    assert_allclose(found.before, raw - FACES)
    assert_allclose(found.after, calibration.compensate(raw) - FACES, rtol=0, atol=1e-14)
    summary = found.summary()
    assert_allclose(summary["before"]["maximum"], np.abs(raw - FACES).max())
    assert_allclose(summary["after"]["rms"], np.sqrt(np.mean(found.after**2)))
    assert found.verdict == "pass"
    assert summary["before"]["maximum"] > 10 * summary["after"]["maximum"]


def test_nominal_conversion(calibration):
    # eq. (1) of verification.error_columns
    columns, scheme = triad(seed=1)
    found = mp.check(calibration, columns, scheme=scheme, nominal=(0.5, 2.0))
    assert_allclose(found.before[:, 0], (columns["ax"] - 0.5) / 2.0 - FACES[:, 0])
    assert found.limit is None
    assert found.verdict is None


def test_verdict_has_the_uncertainty_as_guard_band(calibration):
    columns, scheme = triad(seed=1)
    worst = mp.check(calibration, columns, scheme=scheme)
    size = np.abs(worst.after)
    for limit, verdict in (
        (float((size + worst.U).max()) * 1.001, "pass"),
        (float((size + worst.U).max()) * 0.999, "indeterminate"),
        (float((size - worst.U).max()) * 1.001, "indeterminate"),
    ):
        if limit > 0:
            assert mp.check(calibration, columns, scheme=scheme, limit_g=limit).verdict == verdict
    columns["ay"][3] += 0.01
    assert mp.check(calibration, columns, scheme=scheme, limit_g=0.002).verdict == "fail"


def test_coverage_factor_of_a_sum_by_hand():
    """Half of u on 2 degrees and the rest known: ν = 2 · 2⁴ = 32; t at 0.975 from any table."""
    own, dof = np.array([[1.0, 2.0, 0.0]]), np.array([[2.0, 2.0, 2.0]])
    k = _expanded(SimpleNamespace(confidence=0.95), own, np.full((1, 3), 2.0), dof)
    assert_allclose(k, [[2.0369, 4.3027, 1.9600]], rtol=0, atol=5e-5)


@pytest.mark.parametrize(
    ("error", "U", "verdict"),
    [
        (0.6, 0.4, "pass"),
        (-0.6, 0.41, "indeterminate"),
        (-1.3, 0.3, "indeterminate"),
        (1.4, 0.3, "fail"),
        (math.nan, 0.1, "fail"),
    ],
)
def test_verdicts_by_hand(error, U, verdict):
    """Eq. (1) of the verdicts at L = 1; what has no answer fails."""
    # eqs. (1), (2) of verification.verdicts
    counted = np.array([[True, False]])
    found = judge_errors(np.array([[error, error]]), np.array([[U, U]]), 1.0, counted)
    assert found.tolist() == [[verdict, ""]]


@pytest.mark.usefixtures("without_findings")
def test_u_covers_the_error_of_an_independent_run():
    """u has the calibration and the run's noise in it: normalised errors have unit variance."""
    z = []
    for seed in range(75):
        columns, scheme = triad(seed=2 * seed)
        cal = mp.fit(columns, scheme=scheme, reading_sd=SD)
        found = mp.check(cal, triad(seed=2 * seed + 1)[0], scheme=scheme)
        z.append(np.mean((found.after / found.u) ** 2))
    # each run's mean of 42 squares scatters by less than sqrt(2/20)
    assert abs(np.mean(z) - 1.0) < 4 * math.sqrt(2 / 20) / math.sqrt(75)


def test_run_states_its_own_noise_and_placement(calibration):
    columns, scheme = triad(seed=1)
    plain = mp.check(calibration, columns, scheme=scheme)
    louder = mp.check(calibration, columns, scheme=scheme, reading_sd=1e-3)
    assert_allclose(louder.u, 1e-3, rtol=0.02)
    placed = columns | {"orientation_sd_deg": np.full(14, 0.1)}
    turned = mp.check(calibration, placed, scheme=scheme)
    across = np.sqrt(1 - FACES**2) * np.radians(0.1)
    assert_allclose(turned.u, np.hypot(plain.u, across), rtol=1e-12)
    stated = columns | {f"u_{name}": np.full(14, 1e-3) for name in columns}
    assert_allclose(mp.check(calibration, stated, scheme=scheme).u, louder.u)


def test_tilt_of_a_triad(calibration):
    columns, scheme = triad(seed=1)
    found = mp.check(calibration, columns, scheme=scheme, limit_deg=0.05)
    assert found.quantity == "tilt"
    assert_allclose(found.reference, np.degrees(np.arcsin(FACES)), rtol=0, atol=1e-12)
    assert np.abs(found.after).max() < 0.05


def test_linearity_by_hand():
    t = np.radians(np.arange(0, 360, 30))
    up = np.column_stack([np.cos(t), np.sin(t), 0 * t])
    values = 0.1 + 2.0 * up[:, 0] + 0.02 * up[:, 0] ** 2
    cal = mp.fit({"E": values}, scheme="tumble-12", inputs="x")
    found = mp.check(cal, {"E": values}, scheme="tumble-12")
    # the parabola 0.02 c² about its mean 0.01 departs by 0.01; the span is 4 (line), 2 (force)
    assert_allclose(found.linearity_percent["before"], [100 * 0.01 / 4])
    assert_allclose(found.linearity_percent["after"], [100 * 0.005 / 2], rtol=1e-6)


def test_an_output_that_does_not_answer_has_no_linearity(calibration):
    columns, scheme = triad(seed=1)
    found = mp.check(calibration, columns | {"ay": np.full(14, 0.5)}, scheme=scheme)
    for which in ("before", "after"):
        known = np.isfinite(found.linearity_percent[which])
        assert known.tolist() == [True, which == "after", True]


def test_temperature_model_is_checked_at_its_temperatures():
    rng = np.random.default_rng(3)
    up = np.tile(read_scheme("faces-6").up, (3, 1))
    temperature = np.repeat([-20.0, 20.0, 60.0], 6)
    values = 0.01 + 1e-4 * temperature + up[:, 0] + 1e-5 * rng.standard_normal(18)
    columns = {
        "up_x": up[:, 0],
        "up_y": up[:, 1],
        "up_z": up[:, 2],
        "ax": values,
        "temperature": temperature,
    }
    cal = mp.fit(columns, model="1 + x + y + z + temperature")
    found = mp.check(cal, columns, limit_g=1e-4)
    assert found.verdict == "pass"
    assert found.summary()["before"]["maximum"] > 0.01
    warm = mp.Readings(values, outputs=("ax",), up=up, environment={"Temperature": temperature})
    other = mp.fit(warm, model="1 + x + y + z + Temperature")
    assert_allclose(mp.check(other, columns, limit_g=1e-4).after, found.after, atol=1e-12)


def test_within_counts_only_the_axes_near_level(calibration):
    columns, scheme = triad(seed=1)
    columns["ax"][0] += 0.01  # x up: 90 degrees from level
    found = mp.check(calibration, columns, scheme=scheme, limit_g=0.002, within_deg=60.0)
    assert found.verdict == "pass"
    assert not found.counted[0, 0]
    assert found.counted[0, 1]


def test_json_and_text(tmp_path, capsys, calibration):
    calibration.save(tmp_path / "cal.json")
    columns, scheme = triad(seed=1)
    path = tmp_path / "run.csv"
    rows = zip(*(c.tolist() for c in columns.values()), strict=True)
    path.write_text("ax,ay,az\n" + "\n".join(",".join(map(str, r)) for r in rows) + "\n")
    arguments = ["check", str(tmp_path / "cal.json"), str(path), "--scheme", scheme]
    assert cli.main([*arguments, "--limit-g", "0.002", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["schema"] == "multipos/check/1"
    assert found["verdict"] == "pass"
    assert set(found["before"]) == {"maximum", "rms", "linearity_percent"}
    assert set(found["by_axis"]) == {"x", "y", "z"}
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
    assert row["verdict"] == "pass"
    assert cli.main([*arguments, "--limit-g", "0.002"]) == 0
    text = capsys.readouterr().out
    assert "pass against 2 mg with U (95 %) as guard band: 42 pass" in text
    assert text.startswith("Pass: largest error ")
    found = mp.check(calibration, str(path), scheme=scheme, limit_g=0.002)
    assert text.partition("\n\n")[2] == check_text(found)
    assert cli.main([*arguments, "--nominal", "-0.1,1"]) == 0  # a list that begins with a minus


def fails(capsys, arguments, status, *words):
    assert cli.main(arguments) == status
    said = capsys.readouterr()
    assert said.out == ""
    last = said.err.strip().splitlines()[-1]
    assert last.startswith("multipos: error: ")
    for word in words:
        assert word in last


def test_bad_input(tmp_path, capsys, calibration):
    calibration.save(tmp_path / "cal.json")
    path = tmp_path / "run.csv"
    path.write_text("up_x,up_y,up_z,ax,ay,az\n1,0,0,1,0,0\n0,1,0,0,1,7\n")
    start = ["check", str(tmp_path / "cal.json"), str(path)]
    fails(capsys, [*start, "--tilt", "--limit-g", "1"], 2, "--limit-deg")
    fails(capsys, [*start, "--limit-deg", "1", "--limit-g", "1"], 2, "not allowed with")
    fails(capsys, [*start, "--limit-deg", "0"], 2, "--limit-deg must be above 0")
    fails(capsys, [*start, "--limit-deg", "1e155"], 2, "from 1e-40 to 1e+40, got 1e+155")
    fails(capsys, [*start, "--limit-deg", "1e-300"], 2, "from 1e-40 to 1e+40, got 1e-300")
    fails(capsys, [*start, "--nominal", "1"], 2, "--nominal takes BIAS,SCALE")
    fails(capsys, [*start, "--nominal", "1,5e-316"], 2, "the scale from 1e-40 on")
    fails(capsys, [*start, "--nominal", "0,1e308"], 2, "in reading units, up to 1e+40")
    fails(capsys, [*start, "--reading-sd", "1,2"], 2, "--reading-sd takes 1 or 3 values")
    fails(capsys, [*start, "--range", "-2,2"], 1, "row 2", "'az'", "7")
    path.write_text("ax,ay,az\n1,0,0\n")
    fails(capsys, start, 1, "no orientation")
    path.write_text("up_x,up_y,up_z,ax,ay\n1,0,0,1,0\n")
    fails(capsys, start, 1, "no column 'az'")
    fails(capsys, [*start[:2], str(tmp_path / "none.csv")], 1, "no such file")


def test_a_run_without_a_column_of_the_model_is_refused():
    up = mp.read_scheme("all-26").up
    heat = np.linspace(10.0, 30.0, 26)
    values = up + 1e-3 * heat[:, None]
    readings = mp.Readings(values, up=up, environment={"temperature": heat})
    model = "1 + x + y + z + own^2 + temperature"
    cal = mp.fit(readings, model=model)
    with pytest.raises(mp.MultiposError, match="no column 'temperature', which the model"):
        mp.check(cal, mp.Readings(values, up=up))


def test_the_departure_from_a_line_by_hand():
    """y = x + (0, .3, 0): .2 from its line, over a span of 2, or of ±2."""
    x = np.column_stack([[-1.0, 0.0, 1.0, 5.0], [1.0] * 4, [-1.0, 0.0, 1.0, 5.0]])
    error = np.column_stack([[0.0, 0.3, 0.0, 9.0], [0.0] * 4, [1.0, 0.0, -1.0, np.nan]])
    counted = np.array([[True, True, True]] * 3 + [[False, True, True]])
    found = line_departure(x, error, counted, None)
    np.testing.assert_allclose(found, [10.0, np.nan, np.nan], rtol=1e-12)  # no span; no slope
    np.testing.assert_allclose(line_departure(x, error, counted, 2.0)[0], 5.0, rtol=1e-12)


def test_errors_of_force_and_their_u_by_the_inverse_of_the_matrix():
    """f = K⁻¹(y − b): C of K and b by its derivatives, noise by K⁻¹, placement across f."""
    rng = np.random.default_rng(4)
    K, b = (
        np.array([[1.1, 0.06, -0.04], [0.05, 0.9, 0.07], [-0.03, 0.08, 1.2]]),
        [0.03, -0.02, 0.01],
    )
    up = mp.read_scheme("fibonacci-9").up
    noisy = 3e-3 * rng.normal(size=up.shape)
    cal = with_known_noise(
        mp.fit(mp.Readings(b + up @ K.T + noisy, up=up, unit="g"), reading_sd=3e-3)
    )
    K, b = cal.parameters.reshape(3, 4)[:, 1:], cal.parameters.reshape(3, 4)[:, 0]
    known = mp.read_scheme("fibonacci-5").up
    values = b + known @ K.T + 0.01 * rng.normal(size=known.shape)
    orientation, reference_u = np.linspace(0.002, 0.01, 5), 1e-3 * rng.uniform(1, 5, (5, 3))
    data = mp.Readings(
        values, up=known, unit="g", orientation_sd=orientation, reference_u=reference_u
    )
    noise = RunNoise(np.array([2e-3, 4e-3, 1e-3]) * np.ones((5, 1)), np.zeros((5, 3)))
    nominal = Nominal(0.02, 1.3)
    reference, before, after, u, U = force_errors(cal, data, known, nominal, noise)
    inverse = np.linalg.inv(K)
    force = (values - b) @ inverse.T
    assert_allclose(reference, known)
    assert_allclose(before, (values - 0.02) / 1.3 - known, atol=1e-12)
    assert_allclose(after, force - known, atol=1e-8)
    for row in range(5):
        X = np.kron(np.eye(3), np.append(1.0, force[row]))
        D = X @ cal.covariance @ X.T + np.diag(noise.whole[row] ** 2)
        square = np.diag(inverse @ D @ inverse.T)
        square = square + (1.0 - known[row] ** 2) * orientation[row] ** 2 + reference_u[row] ** 2
        assert_allclose(u[row], np.sqrt(square), rtol=1e-4)
    assert_allclose(U, u * norm.ppf(0.975), rtol=0.025)  # or by a k of 2
