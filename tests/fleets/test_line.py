"""What only a fleet can tell, against simulated lines whose truth is known."""

from types import SimpleNamespace

import numpy as np
import pytest
from fleet_bench import line
from numpy.testing import assert_allclose
from scipy import stats

import multipos as mp
from multipos.fleets.line import find_drift, find_step, normal_scores
from multipos.fleets.outlying_units import (
    _concentrated,
    _covariance,
    _squared,
    _tail,
    discoveries,
    find_outliers,
)
from multipos.fleets.stations import (
    _CLEAR,
    _LEVEL,
    _OF_UNITS,
    _OFF,
    find_off,
    is_off,
    near_median,
    station_effects,
)

pytestmark = pytest.mark.filterwarnings("ignore::multipos.errors.CalibrationWarning")
APART = {"unit_column": "unit", "station_column": "station"}


def test_level_and_shift_have_the_sign_and_size_of_the_truth():
    # eqs. (1), (2) of fleets.stations
    level = np.radians([[0.5, 0.0, -0.2], [-0.1, 0.3, 0.0], [0.0, 0.0, 0.4]])
    shift = np.array([[0.02, 0.0, 0.0], [0.0, -0.01, 0.0], [0.0, 0.0, 0.03]])
    table = line(300, stations=3, level=level, shift=shift, lot=1e-3, noise=1e-4)
    found = mp.fleet(table, **APART)
    for each in found["stations"]:
        place = int(each["station"][1:])
        turned = np.degrees(level - level.mean(axis=0))[place]
        moved = (shift - shift.mean(axis=0))[place]
        for i, axis in enumerate("xyz"):
            level_deg, zero = each["level_deg"][axis], each["shift"][f"a{axis}"]
            assert abs(level_deg["value"] - turned[i]) < 4.0 * level_deg["u"]
            assert abs(zero["value"] - moved[i]) < 4.0 * zero["u"]
            # lot sd 1e-3: of an antisymmetric half 0.7e-3 rad, a hundred units a station
            assert level_deg["u"] == pytest.approx(np.degrees(0.71e-3 * np.sqrt(2 / 300)), rel=0.2)
            assert zero["u"] == pytest.approx(1e-3 * np.sqrt(2 / 300), rel=0.2)


def test_one_station_tells_neither_level_nor_shift():
    (station,) = mp.fleet(line(20), unit_column="unit")["stations"]
    assert (station["station"], station["level_deg"], station["shift"]) == ("", None, None)
    assert len(station["positions_deg"]) == 24


def test_angles_of_a_nest_but_for_the_common_rotation():
    # eq. (1) of fleets.fixtures
    rng = np.random.default_rng(4)
    up = mp.read_scheme("fibonacci-24").up
    turned = np.radians(0.2) * rng.standard_normal((1, 24, 3))
    table = line(200, turned=turned, noise=2e-4)
    (station,) = mp.fleet(table, unit_column="unit")["stations"]
    value = np.array([[row[axis]["value"] for axis in "xyz"] for row in station["positions_deg"]])
    u = np.array([[row[axis]["u"] for axis in "xyz"] for row in station["positions_deg"]])
    error = np.radians(value) - turned[0]
    # what is left must be one rotation of all positions, and turns about each f
    across = error - np.sum(error * up, axis=1)[:, None] * up
    design = np.concatenate([np.eye(3) - np.outer(f, f) for f in up])
    common = np.linalg.lstsq(design, across.ravel(), rcond=None)[0]
    left = np.degrees(across - (design @ common).reshape(24, 3))
    assert np.abs(left).max() < 5.0 * u.max()
    assert u.max() < 0.003  # 2e-4 rad over the root of 200 units, and what the geometry adds


def test_at_the_six_faces_no_angle_is_told():
    (station,) = mp.fleet(line(20, scheme="faces-6"), unit_column="unit")["stations"]
    assert all(row[axis] is None for row in station["positions_deg"] for axis in "xyz")


def test_station_effects_cover_with_what_units_differ_by():
    rng = np.random.default_rng(8)
    runs, n = 400, 40
    inside = 0
    for _ in range(runs):
        stations = rng.integers(0, 2, n)
        values = rng.normal(size=n) + 0.01 * rng.normal(size=n)
        effect, covariance = station_effects(values, stations, np.arange(n))
        difference = effect[1] - effect[0]
        u = np.sqrt(covariance[0, 0] + covariance[1, 1] - 2.0 * covariance[0, 1])
        inside += abs(difference) < 2.02 * u  # t of 38 degrees of freedom
    assert 0.95 - 0.044 < inside / runs < 0.95 + 0.044  # four binomial sd


def test_a_unit_at_both_stations_compares_them_within_itself():
    rng = np.random.default_rng(9)
    lot, noise, n = 1.0, 0.01, 30
    own = lot * rng.normal(size=n)
    values = np.concatenate([own, own + 0.5]) + noise * rng.normal(size=2 * n)
    stations, who = np.repeat([0, 1], n), np.tile(np.arange(n), 2)
    effect, covariance = station_effects(values, stations, who)
    u = np.sqrt(covariance[0, 0] + covariance[1, 1] - 2.0 * covariance[0, 1])
    # paired: sd of a difference √2 noise, over √30
    assert u == pytest.approx(noise * np.sqrt(2.0 / n), rel=0.3)
    assert abs(effect[1] - effect[0] - 0.5) < 4.0 * u
    # the information has a condition of 2 lot²/noise², so ε of it
    rounding = 2.0 * (lot / noise) ** 2 * 2.0**-52
    paired = np.mean(values[n:] - values[:n])
    assert effect[1] - effect[0] == pytest.approx(paired, abs=2.0 * rounding)


def test_a_step_is_found_where_it_was():
    rng = np.random.default_rng(10)
    values = rng.normal(size=400)
    values[250:] += 0.8
    after, chance = find_step(normal_scores(values))
    assert abs(after - 250) < 15
    assert chance < 1e-6


@pytest.mark.parametrize("n", [30, 300])
def test_without_a_step_its_chance_is_no_smaller_than_it_says(n):
    # eqs. (1), (2) of fleets.line
    rng = np.random.default_rng(11)
    runs = 1000
    alarms = sum(find_step(normal_scores(rng.normal(size=n)))[1] < 0.05 for _ in range(runs))
    assert 0.005 < alarms / runs < 0.05 + 0.028  # four binomial sd above; it errs to the safe side


def test_a_station_that_moves_is_named_and_the_others_are_not():
    table = line(300, stations=3, noise=3e-4, lot=3e-3)
    moved = (table["station"] == "S1") & (np.arange(len(table["unit"])) > 24 * 150)
    table["ay"] = table["ay"] + 0.02 + np.where(moved, 0.006, 0.0)
    found = mp.fleet(table, **APART)["drift"]
    assert {(each["station"], each["name"]) for each in found} == {("S1", "bias_ay")}
    (step,) = found
    assert step["kind"] == "step"
    assert abs(step["value"] - 0.006) < 4.0 * step["u"]
    assert abs(int(step["from_unit"][1:]) - 150) < 25


def test_units_that_do_not_belong():
    table = line(300, noise=3e-4, lot=3e-3)
    odd = [17, 150, 222]
    for unit in odd:
        table["az"][24 * unit : 24 * (unit + 1)] += 0.05
    found = mp.fleet(table, **APART)["outliers"]
    named = [each["unit"] for each in found]
    assert set(named) >= {f"U{unit:04d}" for unit in odd}
    assert len(named) <= 5  # at most one in a hundred is named by chance, in expectation
    assert found[0]["parameters"][0]["name"] == "bias_az"


def test_how_far_a_unit_is_by_hand():
    """T² of 40 units, two numbers each, on F(2, 38); against SciPy's and by simulation."""
    # eq. (1) of fleets.outlying_units
    rng = np.random.default_rng(5)
    covariance = np.array([[4.0, 1.2], [1.2, 1.0]])
    theta = rng.multivariate_normal([0.0, 0.0], covariance, 4000)
    found = _squared(theta, _concentrated(theta))
    by_hand = np.einsum("np,pq,nq->n", theta, np.linalg.inv(covariance), theta)
    assert_allclose(found, by_hand, rtol=0.15)
    near = by_hand + theta[:, 0] < 2.0  # whose mean is not zero
    assert_allclose(_covariance(theta, near), np.cov(theta[near].T), rtol=1e-9)
    tail = stats.f.sf(5.0 * 38 / (2 * 39), 2, 38)
    assert_allclose(_tail(np.array([5.0]), 40, 2), tail, rtol=1e-12)
    # of normal units with the covariance of the sample, as often as it says: binomial at 1e-3
    drawn = rng.standard_normal((4000, 12, 2))
    left = drawn - drawn.mean(axis=1, keepdims=True)
    inverse = np.linalg.inv(np.swapaxes(left, 1, 2) @ left / 11)
    new = rng.standard_normal((4000, 2))
    squares = np.einsum("np,npq,nq->n", new, inverse, new)
    assert abs(np.mean(_tail(squares, 12, 2) < 0.05) - 0.05) < 0.0115


def test_false_discoveries_are_as_rare_as_they_say():
    rng = np.random.default_rng(12)
    runs = 300
    wrong = 0.0
    for _ in range(runs):
        p = rng.random(500)
        p[:20] *= 1e-6
        found = discoveries(p)
        wrong += np.mean(found >= 20) if len(found) else 0.0
    assert wrong / runs < 0.02


def test_the_commonest_cause_comes_first():
    table = line(5, scheme="faces-corners-14")
    table["ax"][14 * 2 : 14 * 3] = 0.5
    table["ay"][[1, 14 * 4 + 1]] = np.nan
    causes = mp.fleet(table, **APART)["causes"]
    assert next(iter(causes.items())) == ("no calibration", 2)
    assert causes["dead-output"] == 1


def test_verdicts_of_units_that_fail_or_are_doubted():
    table = line(6, scheme="faces-corners-14")
    table["ax"][14 * 2 : 14 * 3] = 0.5  # U0002: an output that stands still
    table["ay"][14 * 4 + 1] = np.nan
    found = mp.fleet(table, limits={"rms": (None, 1.0)}, **APART)
    verdicts = dict(zip(found.verdicts["unit"], found.verdicts["verdict"], strict=True))
    assert verdicts["U0002"] == "unfit"
    assert "dead-output" in found.calibrations["findings"][2]
    assert verdicts["U0004"] == "failed"
    assert [verdicts[f"U000{i}"] for i in (0, 1, 3, 5)] == ["pass"] * 4
    assert (found["units"], found["fitted"], found["failed"], found["counted"]) == (6, 5, 1, 4)
    assert found["yield"]["value"] == pytest.approx(4 / 6)
    # one long reason does not make a million others as long
    assert found.verdicts["reasons"].nbytes <= 8 * 6
    assert found.calibrations["reason"].nbytes <= 8 * 6


def test_station_effects_are_generalised_least_squares():
    """Six units at both stations, four and three at one, by the covariance of eq. (1) in full."""
    rng = np.random.default_rng(3)
    who = np.concatenate([np.repeat(np.arange(6), 2), np.arange(6, 13)])
    stations = np.concatenate([np.tile([0, 1], 6), [0, 0, 0, 0, 1, 1, 1]])
    values = rng.normal(size=13)[who] + 0.5 * stations + 0.3 * rng.normal(size=19)
    X = np.eye(2)[stations]
    total = np.sum((values - X @ np.linalg.lstsq(X, values, rcond=None)[0]) ** 2) / 17
    within = np.var(values[1:12:2] - values[0:12:2], ddof=1) / 2.0
    V = within * np.eye(19) + (total - within) * (who[:, None] == who)
    covariance = np.linalg.inv(X.T @ np.linalg.solve(V, X))
    effect = covariance @ X.T @ np.linalg.solve(V, values)
    found = station_effects(values, stations, who)
    assert_allclose(found[0], effect, rtol=1e-9)
    assert_allclose(found[1], covariance, rtol=1e-9)


def test_one_unit_at_two_stations_does_not_tell_what_is_left_within_units():
    values = np.array([1.0, 2.0, 4.0, 3.0, 7.0])
    stations, who = np.array([0, 0, 0, 1, 1]), np.array([0, 1, 2, 0, 3])
    effect, covariance = station_effects(values, stations, who)
    assert effect == pytest.approx([7.0 / 3.0, 5.0])
    # (4/3² + 1/3² + 5²/3² + 2² + 2²)/(5 − 2), over three units and two
    variance = (16.0 / 9.0 + 1.0 / 9.0 + 25.0 / 9.0 + 8.0) / 3.0
    assert np.diag(covariance) == pytest.approx([variance / 3.0, variance / 2.0])


def test_scores_and_a_step_by_hand():
    """Ranks 1, 2.5, 2.5, 4 of four; then Z = 20/√(20·20/40), edges at 2 of 40, on φ(b)."""
    # eqs. (1), (2) of fleets.line
    scores = normal_scores(np.array([3.0, 1.0, 3.0, 7.0]))
    assert_allclose(scores, np.sqrt(2.0) * np.array([0.0, -1.0, 0.0, 1.0]), atol=1e-12)
    after, chance = find_step(np.repeat([-1.0, 1.0], 20))
    b = 20.0 / np.sqrt(10.0)
    by_hand = stats.norm.pdf(b) * ((b - 1.0 / b) * 2.0 * np.log(19.0) + 4.0 / b)
    assert after == 20
    assert chance == pytest.approx(by_hand, rel=1e-12)
    assert find_step(np.tile([1.0, -1.0], 20))[1] == 1.0  # Z is below 1 all along


@pytest.mark.parametrize(
    ("kind", "moved", "size", "inverse"),
    [
        ("step", np.repeat([0.0, 10.0], 20), 10.0, 1 / 20 + 1 / 20),
        # Σx² of forty from −1/2 to 1/2: n(n + 1)/12(n − 1)
        ("trend", 30.0 * (np.arange(40) / 39 - 0.5), 30.0, 12 * 39 / (40 * 41)),
    ],
)
def test_the_size_of_a_drift_by_hand(kind, moved, size, inverse):
    """What is left is ±1, across steps and lines: variance 40/(40 − 2)."""
    left = np.tile([1.0, -1.0, -1.0, 1.0], 10)
    units = SimpleNamespace(
        names=("bias_ax", "scale_ax"),
        parameters=np.column_stack([moved + left, left]),
        station=["S"] * 40,
        unit=[f"U{i}" for i in range(40)],
        time=np.full(40, np.nan),
        first=np.arange(40),
    )
    (found,) = find_drift(units, np.ones(40, dtype=bool))
    assert (found["name"], found["kind"], found["order"]) == ("bias_ax", kind, "rows")
    assert found["from_unit"] == "U20" or kind == "trend"
    assert found["value"] == pytest.approx(size, rel=1e-9)
    assert found["u"] == pytest.approx(np.sqrt(40 / 38 * inverse), rel=1e-9)
    units.time = np.arange(40.0)[::-1]
    (back,) = find_drift(units, np.ones(40, dtype=bool))
    assert (back["order"], back["value"]) == ("time", pytest.approx(-size, rel=1e-9))


def test_a_unit_that_was_measured_worse_is_nearer():
    """θ' (S + D)⁻¹ θ with D its u² above the median, of two numbers on the scale of the rest."""
    # eq. (1) of fleets.outlying_units
    rng = np.random.default_rng(21)
    value, rms, u = rng.normal(size=60), 1.0 + 0.1 * rng.random(60), np.full(60, 0.1)
    value[7] = 30.0
    theta = np.column_stack([value, np.cbrt(rms**2)])
    theta -= np.median(theta, axis=0)
    scale = 1.482602218505602 * np.median(np.abs(theta), axis=0)
    theta /= scale
    S = _concentrated(theta)
    for u7, added in ((0.1, 0.0), (3.0, (3.0**2 - 0.1**2) / scale[0] ** 2)):
        u[7] = u7
        units = SimpleNamespace(
            names=("a",),
            parameters=value[:, None],
            u=u[:, None],
            rms=rms,
            unit=np.arange(60),
            station=["S"] * 60,
        )
        first = find_outliers(units, np.ones(60, dtype=bool))[0]
        squared = theta[7] @ np.linalg.solve(S + np.diag([added, 0.0]), theta[7])
        assert (first["unit"], first["statistic"]) == (7, pytest.approx(squared, rel=1e-9))
        p = stats.f.sf(squared * 58 / (2 * 59), 2, 58)
        assert first["p"] == pytest.approx(p, rel=1e-9)
        away = first["parameters"][0]
        assert away["name"] == "a"
        assert away["deviation"] == pytest.approx(theta[7, 0] / np.sqrt(S[0, 0]))


def test_two_of_eight_units_that_are_off_by_hand():
    """Grubbs's statistic of the one that was added last, beside the six that are left."""
    # eq. (2) of fleets.outlying_units
    value = np.array([1.2, -0.7, 0.3, 40.0, -1.1, 0.4, 43.0, -0.2])
    units = SimpleNamespace(
        names=("a",),
        parameters=value[:, None],
        u=np.where(value == 43.0, 5.0, 0.1)[:, None],
        rms=1.0 + 0.1 * np.arange(8) % 0.3,
        unit=list("abcdefgh"),
        station=["S"] * 8,
    )
    listed = find_outliers(units, np.ones(8, dtype=bool))
    assert listed[0]["statistic"] > listed[1]["statistic"]
    found = {each["unit"]: each for each in listed}
    left = value[np.abs(value) < 2.0]
    s2 = left.var(ddof=1)
    for unit, x, added in (("d", 40.0, 0.0), ("g", 43.0, 5.0**2 - 0.1**2)):
        t2 = (x - left.mean()) ** 2 / (s2 * (1.0 + 1.0 / 6.0) + added)
        assert found[unit]["statistic"] == pytest.approx(t2, rel=1e-9)
        p = 8 * 2 * stats.f.sf(t2, 1, 5)
        assert found[unit]["p"] == pytest.approx(p, rel=1e-6)
        away = found[unit]["parameters"][0]
        assert away["deviation"] == pytest.approx((x - np.median(value)) / np.sqrt(s2))
    assert set(found) == {"d", "g"}


def test_few_units_alike_are_seldom_called_off():
    """Of fleets of twelve units alike 1 % has one that is called off, binomial at 1e-3."""
    rng = np.random.default_rng(31)
    named = 0
    for _ in range(400):
        units = SimpleNamespace(
            names=("a", "b", "c"),
            parameters=rng.normal(size=(12, 3)),
            u=np.full((12, 3), 0.1),
            rms=np.sqrt(rng.chisquare(14, size=12) / 14),
            unit=list(range(12)),
            station=["S"] * 12,
        )
        named += bool(find_outliers(units, np.ones(12, dtype=bool)))
    assert named <= stats.binom.isf(1e-3, 400, 0.01)


def test_values_far_from_the_median_of_their_station_by_hand():
    """Half of −2 … 2 and one far is within 1.5 of .5: six times 1.4826 of that are 13.3."""
    values = np.array([-2.0, -1.0, 0.0, 1.0, 2.0, 13.5, 7.0, 7.0, 7.0, 8.0, 9.0])
    stations, usable = np.repeat([0, 1], [6, 5]), np.ones(11, dtype=bool)
    usable[10] = False
    assert near_median(values, usable, stations).tolist() == [True] * 10 + [False]
    values[5] = 14.5
    assert near_median(values, usable, stations).tolist() == [True] * 5 + [False] + [True] * 4 + [
        False
    ]


def test_what_is_off_at_a_station_by_its_limits():
    def found(level, shift, angle, kinds, u_shift=1e-3):
        station = {
            "station": "S1",
            "units": 100,
            "level_deg": {"x": {"value": -level, "u": 0.01}},
            "shift": {"ax": {"value": -shift, "u": u_shift}},
            "positions_deg": [{"position": "7", "y": {"value": -angle, "u": 0.001}}],
        }
        return find_off(station, {("level_deg", "x"), ("shift", "ax")} if kinds else set(), " g")

    level, shift = _LEVEL, _OF_UNITS * 10.0 * 1e-3
    assert not found(0.99 * level, 0.99 * shift, 0.0, True)
    assert not found(level, shift, 0.0, False)
    (of_level,) = found(1.01 * level, 0.99 * shift, 0.0, True)
    assert of_level.text.startswith("level of station S1 is off by ")
    (of_shift,) = found(0.99 * level, 1.01 * shift, 0.0, True)
    assert of_shift.text.startswith("zero of ax at station S1 is off by -")
    assert len(found(0.0, shift, 0.0, True, u_shift=0.0)) == 1  # of units that are all alike
    (of_position,) = found(1.01 * level, 0.0, 5.0 + level, True)
    assert of_position.text.startswith("position 7 of station S1 is off by ")
    assert of_position.text.endswith(", and 1 more")
    assert is_off({"value": -1.01 * max(_OFF, _CLEAR * 0.1), "u": 0.1})
    assert not is_off({"value": -0.99 * max(_OFF, _CLEAR * 0.1), "u": 0.1})
    assert not is_off({"value": 0.99 * _OFF, "u": 0.0})
    assert is_off({"value": 1.01 * _OFF, "u": 0.0})
    assert not is_off(None)
