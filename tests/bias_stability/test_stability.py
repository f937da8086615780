"""Static records: what is told of simulated ones, with calibration and without, and what is not."""

import json
import math
import re
import tracemalloc
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from findings_bench import texts
from noise_bench import walk, white
from numpy.testing import assert_allclose
from scipy.linalg import null_space
from scipy.stats import multivariate_normal

import multipos as mp
from multipos import plots
from multipos.bias_stability import trends
from multipos.bias_stability.noise_laws import Laws
from multipos.bias_stability.stability_text import stability_sentence
from multipos.cli import main
from multipos.errors import MultiposError, UsageError

RATE = 50.0
N = 16_384


def record(rng, *, zero=0.0, drift=0.0, amplitude=0.0, constant=20.0, n=N, k=0.0, step=0.0):
    """One output [g] at 50 Hz with 1 mg of noise a sample; drift per second, k per degree."""
    t = np.arange(n) / RATE
    temperature = 25.0 + 3.0 * np.sin(t / 30.0) + t / 200.0
    y = zero + drift * t + amplitude * np.exp(-t / constant) + k * (temperature - 25.0)
    return {
        "time": t,
        "ax": y + white(rng, n, 1e-3) + walk(rng, n, step),
        "temperature": temperature,
    }


def without(columns, name):
    return {key: column for key, column in columns.items() if key != name}


@cache
def calibration():
    up = mp.read_scheme("faces-6").up
    noise = 1e-5 * np.random.default_rng(1).standard_normal(up.shape)
    values = (
        2.5 + 0.8 * up @ np.array([[1.0, 0.01, 0.0], [0.0, 1.1, 0.0], [0.0, 0.02, 0.9]]) + noise
    )
    return mp.fit(mp.Readings(values, unit="V"), scheme="faces-6")


@cache
def of_four():
    return mp.stability(switched_on(), calibration=calibration())


@cache
def switched_on(zeros=(4e-4, -3e-4, 1e-4, 0.0)):
    """Four switch-ons of a triad in volts, at rest with z up, by their true force."""
    rng = np.random.default_rng(2)
    t = np.arange(4000) / 10.0
    found = []
    for zero in zeros:
        force = np.array([zero, 0.5 * zero, 1.0 - zero]) + 2e-4 * rng.standard_normal((4000, 3))
        raw = calibration().predict(force)
        found.append({"time": t, **dict(zip(("ax", "ay", "az"), raw.T, strict=True))})
    return found


def test_the_curve_of_one_record_is_that_of_allantools():
    allantools = pytest.importorskip("allantools")
    log = without(record(np.random.default_rng(1), drift=1e-5, amplitude=0.01), "temperature")
    found = mp.stability(log, unit="g")
    taus, adev, _, _ = allantools.oadev(log["ax"], rate=RATE, data_type="freq", taus=found.tau)
    assert_allclose(found.tau, taus, rtol=1e-9)
    assert_allclose(found.outputs["ax"].adev, adev, rtol=1e-9)


def test_white_noise_has_its_density_and_nothing_else():
    # eq. (1) of bias_stability.stability_result
    found = mp.stability(without(record(np.random.default_rng(1)), "temperature"), unit="g")
    each = found.outputs["ax"]
    N_ = each.white_noise
    assert N_.unit == "g/sqrt(Hz)"
    assert abs(N_.value - 1e-3 / np.sqrt(RATE)) <= 2.0 * N_.U
    assert N_.U / N_.value < 0.02
    units = {"bias_instability": "g", "random_walk": "g/sqrt(s)", "drift": "g/s"}
    for law, unit in units.items():
        estimate = getattr(each, law)
        assert estimate.unit == unit
        assert abs(estimate.value) <= 1.5 * estimate.U
    assert each.warm_up is None
    assert each.temperature_coefficient is None
    assert_allclose(each.u, each.adev / np.sqrt(2.0 * each.dof))
    assert found.run_to_run == {}


def test_a_random_walk_has_its_coefficient_in_seconds():
    log = without(record(np.random.default_rng(3), step=1e-4), "temperature")
    K = mp.stability(log, unit="g").outputs["ax"].random_walk
    assert abs(K.value - 1e-4 * np.sqrt(RATE)) <= 1.5 * K.U
    assert K.U / K.value < 0.3


def test_drift_and_its_unit():
    log = without(record(np.random.default_rng(4), drift=2e-6), "temperature")
    found = mp.stability(log, unit="g").outputs["ax"]
    assert abs(found.drift.value - 2e-6) <= 1.5 * found.drift.U
    assert found.drift.U < 1e-6
    # The ramp is in the curve, and not in the laws.
    assert found.random_walk.value <= found.random_walk.U


def test_a_warm_up_is_found_with_its_time_and_its_end():
    # eq. (1) of bias_stability.trends
    log = without(record(np.random.default_rng(5), amplitude=5e-3, constant=25.0), "temperature")
    found = mp.stability(log, unit="g").outputs["ax"]
    warm = found.warm_up
    assert abs(warm.amplitude.value - 5e-3) <= 1.5 * warm.amplitude.U
    assert abs(warm.time_constant.value - 25.0) <= 1.5 * warm.time_constant.U
    assert warm.amplitude.U < 5e-4
    # The transient has then the size of the smallest deviation of the noise, at a third of it all.
    floor = found.white_noise.value / np.sqrt(N / RATE / 3.0)
    left = warm.amplitude.value * np.exp(-warm.settled_after / warm.time_constant.value)
    assert floor / 1.5 < left < 2.5 * floor
    assert found.random_walk.value <= found.random_walk.U  # it is no walk


@pytest.mark.slow
@pytest.mark.parametrize("step", [0.0, 2e-5])
def test_noise_alone_shows_no_warm_up_and_drifts_as_often_as_said(step):
    rng = np.random.default_rng(6)
    runs = 60
    warm = covered = 0
    for _ in range(runs):
        found = mp.stability(without(record(rng, step=step, n=4096), "temperature")).outputs["ax"]
        warm += found.warm_up is not None
        covered += abs(found.drift.value) <= found.drift.U
    assert warm <= 1
    assert covered >= 50  # of 60 at 95 %: fewer once in 2000 runs


def test_a_temperature_coefficient_stands_beside_drift_and_warm_up():
    rng = np.random.default_rng(7)
    log = record(rng, zero=0.5, drift=1e-6, amplitude=5e-3, k=2e-5)
    found = mp.stability(log, unit="g").outputs["ax"]
    coefficient = found.temperature_coefficient
    assert abs(coefficient.change.value - 2e-5) <= 1.5 * coefficient.change.U
    assert coefficient.change.U < 1e-5
    assert coefficient.micro_g.value == pytest.approx(1e6 * coefficient.change.value)
    mean = float(log["ax"].mean())
    assert coefficient.ppm.value == pytest.approx(1e6 * coefficient.change.value / mean, rel=1e-3)
    assert abs(found.warm_up.amplitude.value - 5e-3) <= 1.5 * found.warm_up.amplitude.U


def test_a_temperature_is_known_in_letters_of_whatever_case():
    log = record(np.random.default_rng(7), k=2e-4)  # 0.2 mg a degree
    log["Temperature (°C)"] = log.pop("temperature")
    (found,) = mp.stability(log, unit="g").outputs.values()  # the temperature is no output
    change = found.temperature_coefficient.change
    assert abs(change.value - 2e-4) < 5.0 * change.u


def test_a_warm_up_that_follows_the_temperature_is_one_all_the_same():
    rng = np.random.default_rng(8)
    t = np.arange(N) / RATE
    temperature = 25.0 + 8.0 * (1.0 - np.exp(-t / 40.0))
    log = {"time": t, "ax": 1e-3 * (temperature - 33.0) + white(rng, N, 1e-3), "t": temperature}
    found = mp.stability(log, temperature="t", unit="g").outputs["ax"]
    change = found.temperature_coefficient.change
    assert abs(change.value - 1e-3) <= 1.5 * change.U
    warm = found.warm_up
    assert abs(warm.amplitude.value + 8e-3) <= 1.5 * warm.amplitude.U
    assert abs(warm.time_constant.value - 40.0) <= 1.5 * warm.time_constant.U


def test_temperature_in_volts_has_no_micro_g_and_a_small_output_no_ppm():
    rng = np.random.default_rng(9)
    log = record(rng, n=2048)
    log["ay"] = 1.0 + white(rng, 2048, 1e-3)
    found = mp.stability(log, outputs="ax,ay", unit="V").outputs
    assert found["ax"].temperature_coefficient.micro_g is None
    assert found["ax"].temperature_coefficient.ppm is None
    assert found["ay"].temperature_coefficient.ppm is not None
    assert found["ay"].temperature_coefficient.change.unit == "V/degC"


def test_the_papers_drift_test_by_hand():
    zeros = (4e-4, -3e-4, 1e-4, 0.0)
    found = of_four()
    assert list(found.outputs) == ["f_x", "f_y", "f_z"]
    assert found.unit == "g"
    truth = {"f_x": np.array(zeros), "f_y": 0.5 * np.array(zeros), "f_z": 1.0 - np.array(zeros)}
    for name, expected in truth.items():
        spread = found.run_to_run[name]
        # A mean of 4000 samples of .2 mg is good to 3 µg.
        assert spread.sd == pytest.approx(np.std(expected, ddof=1), abs=1e-5)
        assert spread.range == pytest.approx(np.ptp(expected), abs=2e-5)
        assert spread.dof == 3
        settled = [each.settled[name] for each in found.records]
        assert_allclose(settled, expected, rtol=0, atol=3e-5)  # and the calibration's own
        # The first hundredth is forty samples: 32 µg.
        assert found.turn_on[name].sd == pytest.approx(np.std(expected, ddof=1), abs=1e-4)


def test_turning_on_differs_from_the_settled_zero():
    rng = np.random.default_rng(10)
    logs = [
        without(record(rng, zero=zero, amplitude=a, n=8192), "temperature")
        for zero, a in ((0.0, 0.02), (1e-3, 0.01), (-1e-3, 0.03), (0.0, 0.02))
    ]
    found = mp.stability(logs, unit="g")
    assert found.run_to_run["ax"].sd == pytest.approx(np.std([0, 1e-3, -1e-3, 0], ddof=1), rel=0.1)
    # At once they are .02, .011, .029, .02, less the decay over a hundredth of the record.
    at_once = np.std([0.02, 0.011, 0.029, 0.02], ddof=1)
    assert found.turn_on["ax"].sd == pytest.approx(at_once, rel=0.1)
    warm = found.outputs["ax"].warm_up
    assert warm.amplitude.dof == 3  # the runs differ by more than their noise
    assert abs(warm.amplitude.value - 0.02) <= warm.amplitude.U


def test_compensation_uses_the_columns_of_the_model():
    rng = np.random.default_rng(11)
    up = np.tile(mp.read_scheme("faces-6").up, (3, 1))
    T = np.repeat([0.0, 20.0, 40.0], 6)
    columns = dict(zip(("up_x", "up_y", "up_z"), up.T, strict=True))
    values = up[:, 2] + 1e-3 * T + 1e-6 * rng.standard_normal(len(T))
    cal = mp.fit({**columns, "az": values, "temperature": T}, model="1+x+y+z+temperature", axes="z")
    t = np.arange(4096) / RATE
    temperature = 20.0 + 10.0 * np.sin(t / 10.0)
    log = {"time": t, "az": 1.0 + 1e-3 * temperature + white(rng, 4096, 1e-4)}
    log["temperature"] = temperature
    raw = mp.stability(log, unit="g").outputs["az"].temperature_coefficient.change
    assert abs(raw.value - 1e-3) <= 1.5 * raw.U
    left = mp.stability(log, calibration=cal).outputs["f_z"].temperature_coefficient.change
    assert abs(left.value) <= 1.5 * left.U
    assert left.U < 1e-5


def test_the_command_writes_every_form(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    calibration().save("cal.json")
    names = []
    for i, log in enumerate(switched_on((4e-4, -3e-4))):
        names.append(f"run{i + 1}.csv")
        mp.write_table(names[-1], log)
    given = [*names, "--calibration", "cal.json"]
    assert main(["stability", *given, "--json", "-o", "s.json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((tmp_path / "s.json").read_text())
    assert set(printed["outputs"]["f_x"]["allan"][0]) >= {"tau", "adev", "u"}
    for key in ("white_noise", "bias_instability", "random_walk", "drift"):
        assert set(printed["outputs"]["f_x"][key]) == {"value", "u", "U", "dof", "unit"}
    assert printed["outputs"]["f_x"]["warm_up"] is None
    assert printed["outputs"]["f_x"]["temperature_coefficient"] is None
    assert set(printed["run_to_run"]["f_z"]) == {"sd", "range", "dof"}
    found = mp.stability(*names, calibration="cal.json")
    assert mp.load_stability("s.json") == found
    monkeypatch.setattr("multipos.commands.stability.stability", lambda *_, **__: found)
    assert main(["stability", *given, "-o", "s.csv"]) == 0
    shown = capsys.readouterr().out
    table = mp.read_table("s.csv")
    assert list(table.columns) == list(found.columns()) == list(found.to_pandas())
    assert_allclose(table.number("adev_f_y"), found.outputs["f_y"].adev)
    assert "run to run, sd [µg]" in shown
    assert "run1.csv" in shown
    assert main(["stability", *given, "-o", "s.svg"]) == 0
    figure = (tmp_path / "s.svg").read_text()
    for words in ("Allan deviation [µg]", "f_z [µg]", "run 2", "time since switching on [s]"):
        assert words in figure


def test_the_figure_shows_four_runs_of_three_axes():
    found = of_four()
    figure, axes = plots.new_figure(2)
    plots.draw_zero(found, axes[0], output="f_x")
    lines = [line for line in axes[0].get_lines() if len(line.get_xdata()) > 2]
    assert len(lines) == 4
    middle = np.mean([each.settled["f_x"] for each in found.records])
    assert_allclose(lines[0].get_ydata(), 1e6 * (found.records[0].zero["f_x"] - middle))
    assert_allclose(lines[0].get_xdata(), found.records[0].time)
    plots.draw_allan(found, axes[1])
    assert len(plots.stability_figure(found).axes) == 4
    plots.to_svg(figure)


def test_a_text_says_upper_bounds_and_hours(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    mp.write_table("log.csv", record(np.random.default_rng(1), drift=1e-5, n=4096))
    assert main(["stability", "log.csv", "--unit", "g"]) == 0
    shown = capsys.readouterr().out
    assert "[µg/√Hz]" in shown
    assert "[µg/h]" in shown
    assert "change [µg/°C]" in shown
    row = next(line for line in shown.splitlines() if line.startswith("ax  "))
    assert "< " in row


def test_a_temperature_that_is_the_time_tells_neither():
    n = 4096
    log = {"time": np.arange(n) / RATE, "ax": white(np.random.default_rng(1), n)}
    log["temperature"] = np.arange(n) / 64.0  # exact in floating point, in every block
    found = mp.stability(log, unit="g").outputs["ax"]
    assert found.drift.u > 1e3 * abs(found.drift.value)


def test_time_in_milliseconds_and_bad_rows_are_read_as_average_reads_them():
    log = without(record(np.random.default_rng(1), n=4096), "temperature")
    whole = mp.stability(log, unit="g")
    told = {"time_ms": 1e3 * log["time"], "ax": log["ax"]}
    assert_allclose(mp.stability(told, unit="g").tau, whole.tau, rtol=1e-9)
    assert_allclose(mp.stability({**log, "time": 1e3 * log["time"]}, time_unit="ms").tau, whole.tau)
    broken = {**log, "ax": log["ax"].copy()}
    broken["ax"][[7, 8]] = np.nan
    with pytest.raises(MultiposError, match="row 8"):
        mp.stability(broken)
    found = mp.stability(broken, drop_bad=True)
    assert found.records[0].samples == 4094
    assert any("2 of 4096 rows are bad and were omitted" in text for text in texts(found))


def short():
    return {"time": np.arange(50) / RATE, "ax": np.arange(50.0)}


REFUSED = {
    "no log": ((), {}, UsageError, "needs one static record or more"),
    "too short": ((short(),), {}, MultiposError, "50 samples are too few for stability"),
    "no time": (({"ax": np.arange(100.0)},), {}, MultiposError, "give --rate"),
    "no such output": ((short(),), {"outputs": "ay"}, MultiposError, "no column 'ay'"),
    "an empty name": ((short(),), {"time_column": ""}, MultiposError, "no column ''"),
    "no such temperature": ((short(),), {"temperature": "temp"}, MultiposError, "no column 'temp'"),
    "an output as temperature": (
        ({"ax": np.sin(np.arange(100.0)), "t": np.arange(100.0), "time": np.arange(100) / RATE},),
        {"outputs": "ax,t", "temperature": "t"},
        MultiposError,
        "so no temperature",
    ),
    "stuck": (
        ({"time": np.arange(100) / RATE, "ax": np.ones(100)},),
        {},
        MultiposError,
        "'ax' never changes",
    ),
    "two rates": (
        ({"ax": np.sin(np.arange(100.0)), "time": np.arange(100) / r} for r in (10.0, 20.0)),
        {},
        MultiposError,
        "need one sample rate",
    ),
    "other outputs": (
        ({name: np.sin(np.arange(100.0))} for name in ("ax", "ay")),
        {"rate": 1.0},
        MultiposError,
        "its outputs are ay",
    ),
    "one temperature": (
        (
            {"ax": np.sin(np.arange(100.0)), "temperature": np.arange(100.0)},
            {"ax": np.sin(np.arange(100.0))},
        ),
        {"rate": 1.0},
        MultiposError,
        "no temperature, which",
    ),
    "time told twice": ((short(),), {"rate": 1.0, "time_column": "time"}, UsageError, "give one"),
    "rate": ((short(),), {"rate": 0.0}, UsageError, "--rate must be above 0"),
    "a rate beyond all": ((short(),), {"rate": 1e308}, UsageError, "from 1e-12 to 1e\\+07 Hz"),
    "confidence": ((short(),), {"confidence": 1.0}, UsageError, "between 0 and 1"),
    "unit of what is compensated": (
        (short(),),
        {"calibration": "cal.json", "unit": "V"},
        UsageError,
        "--unit is of raw outputs",
    ),
    "outputs of what is compensated": (
        (short(),),
        {"calibration": "cal.json", "outputs": "ax"},
        UsageError,
        "--outputs names raw columns",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_told_is_refused_in_words(name):
    logs, options, kind, words = REFUSED[name]
    with pytest.raises(kind, match=words):
        mp.stability(list(logs) if name != "no log" else [], **options)


@pytest.mark.parametrize(
    "samples",
    [
        np.arange(100.0),
        np.tile([0.0, 1.0], 500),
        np.sin(np.arange(5000) / 50.0),
        np.concatenate([np.zeros(500), np.ones(500)]),
        np.append(np.zeros(999), 1.0),
        1e-30 * np.arange(1000.0) ** 2,
    ],
    ids=["ramp", "alternating", "wave", "step", "one that differs", "tiny parabola"],
)
def test_what_is_no_noise_gives_numbers_all_the_same(samples):
    each = mp.stability({"ax": samples}, rate=10.0).outputs["ax"]
    for law in (each.white_noise, each.bias_instability, each.random_walk, each.drift):
        assert np.isfinite([law.value, law.u, law.U]).all()
    assert np.isfinite(each.u).all()


def test_too_many_columns_ask_for_outputs():
    log = {name: np.sin(np.arange(100.0)) for name in "abcd"}
    with pytest.raises(UsageError, match="name them with --outputs"):
        mp.stability(log, rate=1.0)


def test_cautions_say_what_is_missing():
    rng = np.random.default_rng(12)
    logs = [
        without(record(rng, n=4096, amplitude=0.02, constant=20.0), "temperature") for _ in range(2)
    ]
    notes = " ".join(texts(mp.stability(logs, unit="g")))
    assert "warm-up takes" in notes  # at 82 s of noise at 20 s a time constant
    gappy = {"time": np.arange(100.0), "ax": rng.standard_normal(100)}
    gappy["time"][50:] += 10.0
    gappy["temperature"] = np.full(100, 20.0)
    notes = " ".join(texts(mp.stability(gappy)))
    assert "the time has 1 gaps; samples are taken as evenly spaced" in notes


def test_a_long_record_goes_through_blocks_of_many_samples():
    # 100 003 samples make blocks of 256, of which the last is not whole.
    log = without(record(np.random.default_rng(13), n=100_003), "temperature")
    (kept,) = mp.stability(log).records
    assert len(kept.time) == 100_003 // 256
    assert_allclose(kept.time[:2], [128 / RATE, 384 / RATE])
    whole = log["ax"][: 256 * len(kept.time)].reshape(-1, 256).mean(axis=1)
    assert_allclose(kept.zero["ax"], whole, rtol=0, atol=1e-15)


def test_memory_does_not_grow_with_the_record(tmp_path):
    peaks = []
    for rows in (400_000, 1_600_000):
        np.save(tmp_path / "log.npy", np.random.default_rng(1).standard_normal(rows))
        tracemalloc.start()
        mp.stability(tmp_path / "log.npy", rate=1000.0)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # The samples are 3 and 13 MB; what is kept in memory is pieces, blocks and a first 4 MB.
    assert peaks[1] < 1.2 * peaks[0]
    assert peaks[1] < 25e6


def test_a_calibration_finds_its_columns_in_any_case_and_in_its_unit_alone(tmp_path):
    rng = np.random.default_rng(2)
    up = mp.read_scheme("faces-corners-14").up
    values = 0.01 + up + 1e-4 * rng.standard_normal(up.shape)
    names = ("ax", "ay", "az")
    cal = mp.fit(mp.Readings(values, outputs=names, up=up, unit="g"))
    still = {"time": np.arange(600) / 50.0}
    noise = {name: 0.01 + 1e-3 * rng.standard_normal(600) for name in names}
    for unit, path in (("", "plain.csv"), (" [m/s^2]", "si.csv")):
        mp.write_table(tmp_path / path, still | {n.upper() + unit: v for n, v in noise.items()})
    found = mp.stability(tmp_path / "plain.csv", calibration=cal)
    assert list(found.outputs) == ["f_x", "f_y", "f_z"]
    with pytest.raises(MultiposError, match="the calibration is in g"):
        mp.stability(tmp_path / "si.csv", calibration=cal)


def test_the_likelihood_of_a_trend_by_a_normal_density():
    """−2 ln of SciPy's density of contrasts that no constant moves, but for ln det of these."""
    # eq. (2) of bias_stability.trends
    rng = np.random.default_rng(4)
    blocks = trends.Blocks(640, 16, rng.standard_normal(40), None, np.zeros(1))
    squares = np.array([3.0, 0.0, 0.02])
    found = trends._least_squares(
        [blocks], ("drift",), None, Laws(squares, np.zeros((3, 3)), 0, 0.0, 0)
    )
    C = trends._covariance(40, 16, squares)
    X = np.column_stack([np.ones(40), blocks.time - blocks.time.mean()])
    b = np.linalg.solve(X.T @ np.linalg.solve(C, X), X.T @ np.linalg.solve(C, blocks.values))
    K = null_space(np.ones((1, 40)))
    left = K.T @ (blocks.values - X @ b)
    density = multivariate_normal(np.zeros(39), K.T @ C @ K).logpdf(left)
    expected = -2.0 * density - 39.0 * np.log(2.0 * np.pi) + np.log(40.0)
    assert found.likelihood == pytest.approx(expected, rel=1e-6)


def test_a_bias_instability_that_is_not_shown_is_below_its_bound():
    """The sentence says what the table says: < U, and not 0."""
    noise = 1e-3 * np.random.default_rng(3).standard_normal((60000, 3))
    found = mp.stability({"time": 0.01 * np.arange(60000), "ax": noise[:, 0]}, unit="g")
    assert found.outputs["ax"].bias_instability.value == 0.0
    bound = re.search(r"bias instability below (\S+) µg \(ax\)", stability_sentence(found))
    assert bound
    assert f"< {bound[1]}" in str(found)


def test_block_means_covary_by_hand():
    """A constant is added to flicker and walk, which the mean takes up: 2 · 3 L / 2 of walk."""
    index = np.abs(np.subtract.outer(range(4), range(4)))
    next_to = np.where(index == 0, 2.0, np.where(index == 1, -1.0, 0.0))
    by_hand = {  # of the squares 2 at L = 5: N²/L, L (−k/2) and −L/6 at k = 0, Q²/L²
        (2.0, 0.0, 0.0): 2.0 / 5.0 * np.eye(4),
        (0.0, 0.0, 2.0): 2.0 * 5.0 * (3.0 - index / 2.0 - np.eye(4) / 6.0),
        (0.0, 0.0, 0.0, 2.0): 2.0 / 25.0 * next_to,
    }
    for squares, expected in by_hand.items():
        found = trends._covariance(4, 5, np.array(squares))
        assert_allclose(found, expected, rtol=1e-8, atol=1e-8)


def test_a_time_constant_moves_and_is_known_as_in_one_fit_of_all():
    """Its step and u by the normal equations of Gauss and Newton, ln T_w among their unknowns."""
    rng = np.random.default_rng(6)
    blocks = trends.Blocks(640, 16, np.zeros(40), None, np.zeros(1))
    values = 3.0 * np.exp(-blocks.time / 130.0) + 0.3 * rng.standard_normal(40)
    squares = np.array([2.0, 0.3, 0.01])
    names = (trends.DRIFT, trends.WARM_UP)
    found = trends._least_squares(
        [replace(blocks, values=values)], names, 150.0, Laws(squares, np.eye(3), 0, 0.0, 0)
    )
    late = np.exp(-blocks.time / 150.0)
    X = np.column_stack([np.ones(40), blocks.time - blocks.time.mean(), late])
    W = np.linalg.inv(trends._covariance(40, 16, squares))
    b = np.linalg.solve(X.T @ W @ X, X.T @ W @ values)
    J = np.column_stack([X, b[-1] * blocks.time / 150.0 * late])
    V = np.linalg.inv(J.T @ W @ J)
    assert found.time_constant.u == pytest.approx(150.0 * math.sqrt(V[-1, -1]), rel=1e-6)
    assert found.step == pytest.approx((V @ J.T @ W @ (values - X @ b))[-1], rel=1e-6)
