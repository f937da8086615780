"""A zero that differs from soak to soak, and a curve fitted straight."""

import numpy as np
import pytest

import multipos as mp
from multipos.diagnostics.model_error import judge_soaks
from multipos.positions.scheme import read_scheme
from multipos.sensor.temperature import find_soaks, soaks_of
from tests.diagnostics.test_model_error import BIAS, MATRIX

MODEL = "1 + x + y + z + temperature + temperature*own"
LEVELS = np.linspace(-40.0, 80.0, 7)


def over_temperature(seed, *, zero=0.0, curve=0.0, sd=1e-4):
    """Six faces at each of seven soaks: a straight drift of bias and scale, and what is asked."""
    rng = np.random.default_rng(seed)
    up = np.vstack([read_scheme("faces-6").up] * len(LEVELS))
    soak = np.repeat(np.arange(len(LEVELS)), 6)
    warm = LEVELS[soak] + 0.3 * rng.standard_normal(len(soak))
    values = BIAS + up @ MATRIX.T + 1e-4 * (warm[:, None] - 20.0) * (1.0 + up)
    values += zero * rng.standard_normal((len(LEVELS), 3))[soak]
    values += curve * ((warm[:, None] - 20.0) / 60.0) ** 2
    values += sd * rng.standard_normal(up.shape)
    return mp.Readings(
        values, outputs=("ax", "ay", "az"), up=up, environment={"temperature": warm}, unit="g"
    )


def found(c):
    beside = ("hidden-terms", "inseparable")  # orientations are exact beside soaks
    return [finding.code for finding in c.diagnostics.findings if finding.code not in beside]


def test_soaks_are_levels_or_stays_in_order():
    assert find_soaks(np.array([20.1, 20.0, 40.0, 40.2, 60.0, 60.1, 80.0, 80.1])).tolist() == [
        *(0, 0, 1, 1, 2, 2, 3, 3)
    ]
    up_and_down = np.repeat([20.0, 40.0, 60.0, 40.0, 20.0], 3)
    assert find_soaks(up_and_down).tolist() == np.repeat(np.arange(5), 3).tolist()
    by_position = np.tile([20.0, 40.0, 60.0, 80.0], 6)  # every position at all levels in turn
    assert find_soaks(by_position).tolist() == np.tile([0, 1, 2, 3], 6).tolist()
    assert find_soaks(np.linspace(20.0, 60.0, 40)) is None  # a ramp has no soaks
    assert find_soaks(np.full(12, 25.0)) is None


def test_a_zero_of_each_soak_is_named_with_its_size():
    # eq. (1) of diagnostics.model_error
    c = mp.fit(over_temperature(1, zero=5e-4), model=MODEL)
    assert found(c) == ["zero-per-soak"]
    test, sizes = judge_soaks(c)
    assert test.p < 1e-10
    # 7 soaks less 3 of the curve: to a third in one output, 68 %; the three together
    assert np.sqrt(np.mean(sizes**2)) == pytest.approx(5e-4, rel=0.6)


def test_a_curve_fitted_straight_is_a_missing_term():
    c = mp.fit(over_temperature(2, curve=5e-4), model=MODEL)
    assert found(c) == ["missing-term"]
    told = next(d.action for d in c.diagnostics.findings if d.code == "missing-term")
    assert f"Fit with --model '{MODEL} + temperature^2'" in told
    assert found(mp.fit(over_temperature(2, curve=5e-4), model=f"{MODEL} + temperature^2")) == []


def test_good_soaks_are_not_doubted():
    """1 % of 40 for each of two findings; more than 4 has a chance of one in 1,000."""
    named = [found(mp.fit(over_temperature(seed), model=MODEL)) for seed in range(40)]
    assert sum(map(bool, named)) <= 4


@pytest.mark.parametrize("wander", [0.0, 1e-5, 6e-5, 1.5e-4])
@pytest.mark.parametrize("sets", [12, pytest.param(80, marks=pytest.mark.slow)])
def test_u_of_parameters_holds_what_eight_soaks_differ_by(wander, sets):
    """.1 mg of noise: at 60 µg of wander U of least squares held a third; 95 %, less 4 sd.

    The terms of an output are off together, so that it counts once.
    """
    truth = {"1": 0.0, "temperature": 1e-5, "temperature^2": 2e-7}
    T = np.repeat(np.linspace(-20.0, 60.0, 8), 12)
    soak, up = np.repeat(np.arange(8), 12), np.tile(read_scheme("edges-12").up, (8, 1))
    inside = []
    for seed in range(sets):
        rng = np.random.default_rng([seed, 8])
        values = up + (1e-5 * T + 2e-7 * T**2)[:, None] + 1e-4 * rng.standard_normal(up.shape)
        values += wander * rng.standard_normal((8, 3))[soak]
        readings = mp.Readings(values, up=up, unit="g", environment={"temperature": T})
        c = mp.fit(readings, model="1 + x + y + z + temperature + temperature^2")
        inside += [abs(p.value - truth[p.term]) <= p.U for p in c.entries if p.term in truth]
    assert np.mean(inside) > 0.95 - 4.0 * np.sqrt(0.05 / (3.0 * sets))


def test_u_of_the_bias_holds_what_soaks_differ_by():
    """Zeros of 1 mg at three and five soaks, .3 mg of noise: U held 42 to 49 % of them."""
    at = np.linspace(-20.0, 50.0, 8)
    for soaks, least in ((3, 0.85), (5, 0.9)):
        rng = np.random.default_rng(7)
        levels, inside, named = np.linspace(-20.0, 50.0, soaks), [], 0
        soak, up = np.repeat(np.arange(soaks), 6), np.tile(read_scheme("faces-6").up, (soaks, 1))
        for _ in range(40):
            values = 1e-4 * levels[soak, None] + up + 1e-3 * rng.standard_normal((soaks, 3))[soak]
            values += 3e-4 * rng.standard_normal(up.shape)
            warm = {"temperature": levels[soak]}
            c = mp.fit(mp.Readings(values, up=up, unit="g", environment=warm), model=MODEL)
            named += "zero-per-soak" in found(c)
            for curve in mp.over_temperature(c, at):
                if curve.name.startswith("bias"):
                    assert curve.soak_sd is not None
                    inside.append(np.abs(curve.value - 1e-4 * at) <= curve.U)
        assert np.mean(inside) >= least
        assert named >= 35


def test_soaks_and_hysteresis_by_hand():
    """Zeros of 1, 1, 0, −1, −1 mg at 20, 40, 60, 40, 20 °C: no line takes any of it.

    Falling less rising is −2 mg at both levels.
    """
    # eqs. (2), (3) of sensor.temperature
    # eq. (2) of diagnostics.model_error
    warm = np.array([20.0, 40.0, 60.0, 40.0, 20.0])
    zero = np.array([1.0, 1.0, 0.0, -1.0, -1.0]) * 1e-3
    up = np.tile(read_scheme("faces-6").up, (5, 1))
    soak = np.repeat(np.arange(5), 6)
    rng = np.random.default_rng(1)
    values = up + zero[soak, None] + 1e-6 * rng.standard_normal(up.shape)
    readings = mp.Readings(values, up=up, unit="g", environment={"temperature": warm[soak]})
    c = mp.fit(readings, model="1 + x + y + z + temperature")
    bias = mp.over_temperature(c, [20.0])[0]
    assert bias.hysteresis["value"] == pytest.approx(-2e-3, abs=2e-6)
    assert bias.hysteresis["unit"] == "g"
    # two levels: Student's factor of one degree of freedom
    assert bias.hysteresis["U"] == pytest.approx(12.706205 * bias.hysteresis["u"], rel=1e-6)
    # 4 mg² of soaks in squares of rows: Δ = 6 · 4e-6 on three, tr = 6 · 3
    assert bias.soak_sd == pytest.approx(np.sqrt(4e-6 / 3), rel=1e-2)


@pytest.mark.parametrize("stated", [1e-4, 5e-3])
def test_how_the_zero_repeats_is_in_u_once(stated):
    """Soaks differ by 1 mg; of that and of what the budget states of the zero U has the larger."""
    soak, up = np.repeat(np.arange(5), 6), np.tile(read_scheme("faces-6").up, (5, 1))
    zero = np.array([1.0, -1.0, 0.4, -1.2, 0.8]) * 1e-3
    rng = np.random.default_rng(3)
    values = up + zero[soak, None] + 1e-6 * rng.standard_normal(up.shape)
    warm = {"temperature": np.array([10.0, 20.0, 30.0, 40.0, 50.0])[soak]}
    readings = mp.Readings(values, up=up, unit="g", environment=warm)
    budget = {"stability": {f"u_{name}": stated for name in readings.outputs}}
    plain, told = (
        mp.over_temperature(mp.fit(readings, model=MODEL, budget=b), [30.0])[0]
        for b in (None, budget)
    )
    assert plain.u[0] > 3e-4  # a tenth of what soaks differ by, at least, over five soaks
    assert told.u[0] == pytest.approx(max(plain.u[0], stated), rel=0.02)


def test_a_column_says_which_rows_are_a_soak():
    """Two soaks at every temperature: by temperature alone five, by their labels ten."""
    level, up = np.repeat(np.arange(10), 6), np.tile(read_scheme("faces-6").up, (10, 1))
    rng = np.random.default_rng(5)
    values = (
        up + (1e-3 * rng.standard_normal((10, 3)))[level] + 1e-5 * rng.standard_normal(up.shape)
    )
    order = rng.permutation(60)  # rows in no order, so that temperature shows levels alone
    table = {"soak": np.array([f"S{k}" for k in level]), "temperature": 20.0 * (level // 2)}
    table |= dict(zip(("Ux", "Uy", "Uz"), values.T, strict=True))
    table |= dict(zip(("up_x", "up_y", "up_z"), up.T, strict=True))
    table = {name: column[order] for name, column in table.items()}
    c = mp.fit(table, model=MODEL)
    assert c.outputs == ("Ux", "Uy", "Uz")
    assert len(np.unique(soaks_of(c.readings))) == 10
    bare = mp.fit({n: column for n, column in table.items() if n != "soak"}, model=MODEL)
    assert len(np.unique(soaks_of(bare.readings))) == 5
