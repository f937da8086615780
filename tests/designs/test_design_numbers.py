"""Numbers of designs by hand or by a second route, at points without symmetry."""

import math
from itertools import combinations_with_replacement
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import multipos as mp
from multipos.designs.aliases import find_aliases
from multipos.designs.assessment import (
    Assessor,
    _dof,
    positions_table,
    schemes_sentence,
)
from multipos.designs.criteria import Criterion, kernels, make_criterion
from multipos.designs.designing import (
    _efficiency,
    _order,
    _search,
)
from multipos.designs.exchange import polish
from multipos.designs.information import Setting
from multipos.designs.optimum import gap_of_least
from multipos.designs.prospects import begin, information_of, measured, rank_positions
from multipos.positions.scheme import read_scheme
from multipos.sensor.model import build_model

AXES = ("x", "y", "z")
OUTPUTS = ("ax", "ay", "az")
LINEAR = build_model("linear", OUTPUTS, AXES)
# a bias and three sensitivities of each output
SENSOR = np.array([0.03, 1.1, 0.06, -0.04, -0.02, 0.05, 0.9, 0.07, 0.01, -0.03, 0.08, 1.2])


def away_from_zero(shape, seed=1):
    return np.random.default_rng(seed).normal(size=shape)


@pytest.mark.parametrize("name", ["tilt:±25", "force:±0.4"])
def test_weights_of_a_range_by_differences_of_what_is_compensated(name):
    """Mean square of what each parameter does to tilt of x and y, or to their force."""
    (B,) = make_criterion(name, Setting(LINEAR, orientation_sd=0.1, parameters=SENSOR)).weight
    size = math.sin(math.radians(25.0)) if name.startswith("tilt") else 0.4
    angles = np.radians(np.linspace(-25.0, 25.0, 13))
    line = np.sin(angles) if name.startswith("tilt") else np.linspace(-size, size, 13)
    x, y = (each.ravel() for each in np.meshgrid(line, line))
    up = np.column_stack([x, y, np.sqrt(1.0 - x**2 - y**2)])
    y = LINEAR.predict(SENSOR, up, {})

    def found(parameters):
        rows = parameters.reshape(3, 4)
        force = np.linalg.solve(rows[:, 1:], (y - rows[:, 0]).T).T
        if name.startswith("force"):
            return force[:, :2]
        return np.arcsin(force[:, :2] / np.linalg.norm(force, axis=1, keepdims=True))

    steps = 1e-6 * np.eye(12)
    slopes = np.array([(found(SENSOR + s) - found(SENSOR - s)) / 2e-6 for s in steps])
    wanted = np.einsum("ink,jnk->ij", slopes, slopes) / len(up)
    wanted += 1e-4 * np.trace(wanted) / 12 * np.eye(12)
    assert_allclose(B, wanted, atol=2e-7)


def test_one_parameter_weighs_ten_thousand_times_the_others():
    blocks = make_criterion("u:ay:z", Setting(LINEAR)).weight
    wanted = np.full(12, 1e-4)
    wanted[7] = 1.0
    assert_allclose(np.concatenate([np.diag(B) for B in blocks]), wanted)


def test_terms_that_a_model_has_or_cannot_sense_are_no_aliases():
    """Of x in a plane: z is no input, and x² is in the model."""
    model = build_model("1 + own + other + own^2", ("ax",), ("x",), inputs=("x", "y"))
    found = find_aliases(Setting(model), read_scheme("roll-x-8+roll-y-8").up)
    assert [alias["term"] for alias in found] == ["y^2", "x*y", "x^3", "x*|x|"]


@pytest.mark.parametrize("size", [1.0, -1.7])
@pytest.mark.parametrize("turned", [0.0, 0.4])
def test_aliases_by_least_squares(size, turned):
    """What z² of ay does to bias, scale and cross terms of ay, or to all where outputs share."""
    up = away_from_zero((9, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    mine = Setting(LINEAR, orientation_sd=turned, size=size)
    (alias,) = (a for a in find_aliases(mine, up) if (a["output"], a["term"]) == ("ay", "z^2"))
    f = size * up
    X = np.zeros((9, 3, 12))
    for i in range(3):
        X[:, i, 4 * i : 4 * i + 4] = np.column_stack([np.ones(9), f])
    c = np.zeros((9, 3))
    c[:, 1] = f[:, 2] ** 2
    V = np.eye(3) + (turned * size) ** 2 * (np.eye(3) - np.einsum("ni,nj->nij", up, up))
    W = np.linalg.inv(np.linalg.cholesky(V))
    rows, column = (W @ X).reshape(27, 12), np.einsum("nij,nj->ni", W, c).ravel()
    a = np.linalg.lstsq(rows, column, rcond=None)[0]
    left = np.linalg.norm(column - rows @ a) / np.linalg.norm(column)
    assert alias["seen"] == pytest.approx(left, rel=1e-9)
    into = dict(zip(LINEAR.names, a.tolist(), strict=True))
    assert alias["into"] == pytest.approx({n: v for n, v in into.items() if abs(v) > 1e-9})


def test_what_a_least_eigenvalue_may_fall_short_by_by_hand():
    """Of ½ and 1 % more x = 1.01^−100 = .36971 counts, tr G = (2 + 2x/1.01)/(1 + x) = 1.994655."""
    # eq. (3) of designs.optimum
    M = (np.diag([0.5, 0.505]),)
    found = gap_of_least(M, kernels(M, make_criterion("E", Setting(LINEAR))), 0.2)
    assert found == pytest.approx(1.2 / (0.5 * 1.994655) - 1.0, abs=1e-5)


def test_efficiency_time_and_degrees_of_freedom_by_hand():
    sphere, best = SimpleNamespace(value=-2.5), SimpleNamespace(value=-2.8)
    assert _efficiency("D", -3.0, sphere, best) == pytest.approx((math.exp(-0.5), math.exp(-0.2)))
    assert _efficiency("A", -2.4, sphere, best) == (1.0, 1.0)
    assert _efficiency("G", -0.3, sphere, best) == (pytest.approx(math.exp(-0.3)), None)
    assert _efficiency("G", 0.3, sphere, best) == (1.0, None)
    timed = mp.design(positions=4, candidates="faces-6", move_time=(20.0, 0.3))
    assert timed.time_s == pytest.approx(20.0 * 4 + 0.3 * timed.travel_deg)
    model = SimpleNamespace(outputs=("ax", "ay"), terms=("12", "123"), keys="12345")
    assert _dof(SimpleNamespace(model=model, orientation_sd=0.3), 11) == {"ax": 9, "ay": 8}
    assert _dof(SimpleNamespace(model=model, orientation_sd=math.inf), 11) == {"all": 6}


@pytest.mark.parametrize(
    ("count", "rows", "across", "pages", "digits"),
    [(24, 24, 1, 1, 6), (25, 13, 2, 1, 4), (50, 17, 3, 1, 4), (73, 24, 3, 2, 4)],
)
def test_many_positions_stand_beside_each_other(count, rows, across, pages, digits):
    text = positions_table([(f"p{i}", (0.1234567, 0.0, -1.0)) for i in range(count)])
    tables = [page.splitlines() for page in text.split("\n\n")]
    assert len(tables) == pages
    assert len(tables[0]) == rows + 1
    assert tables[0][0].count("up x") == across
    cells = tables[0][1].split()
    assert cells[:2] == ["p0", f"{0.1234567:.{digits}f}"]
    if across > 1:
        assert cells[4] == f"p{rows}"


def test_rank_of_a_scheme_that_leaves_parameters_open():
    """A roll about z does not tell z of any output: nine of twelve."""
    found = Assessor(Setting(LINEAR)).describe(read_scheme("roll-z-7"))
    assert (found.rank, found.parameters, len(found.unidentifiable)) == (9, 12, 3)
    assert not found.identifiable
    assert found.dof == {"ax": 3, "ay": 3, "az": 3}


def test_drift_that_a_model_absorbs_of_one_output():
    """The most that a line of one axis takes of row numbers: the square of a correlation."""
    up = np.array([[0.6, 0.0, -0.8], [0.0, 1.0, 0.0], [0.8, 0.0, 0.6], [0.0, 0.0, 1.0]])
    model = build_model("1 + own", ("ax", "az"), ("x", "z"))
    row = np.arange(4.0)
    wanted = max(np.corrcoef(row, up[:, i])[0, 1] ** 2 for i in (0, 2))
    assert Setting(model).drift_absorbed(up) == pytest.approx(wanted, rel=1e-9)


def test_what_all_parameters_gain_is_a_geometric_mean():
    up = read_scheme("all-26").up
    values = 1.1 * up + 0.02 + 1e-3 * away_from_zero((26, 3))
    cal = mp.fit(mp.Readings(values, up=up, unit="g"))
    best, fall = rank_positions(cal)
    begun = begin(cal)
    then = begun.u(information_of(begun.setting, best[:1]))[0]
    assert fall[0] == pytest.approx(1.0 - math.prod(then / cal.u) ** (1.0 / 12.0), rel=1e-9)
    assert (np.diff(fall) <= 0.0).all()


def test_the_drift_of_a_session_is_as_well_known_as_it_is():
    """One position more says nothing of it: on its diagonal stands 1/u² beside the readings'."""
    up = np.tile(read_scheme("all-26").up, (2, 1))
    values = 1.1 * up + 0.02 + 1e-3 * away_from_zero((52, 3))
    values += 1e-3 * np.arange(52.0)[:, None]
    cal = mp.fit(mp.Readings(values, up=up, unit="g"), drift=True, orientation_sd=0)
    setting, present, _ = measured(cal)
    drifts = [i for i, key in enumerate(cal.model.keys) if str(key[1]) == "drift"]
    assert len(drifts) == 3
    without = information_of(setting, up).sum(axis=0)
    known = np.zeros(len(cal.u))
    known[drifts] = 1.0 / cal.u[drifts] ** 2
    assert_allclose(present - without, np.diag(known), rtol=1e-9, atol=1e-3)


def test_the_order_of_travel_starts_at_the_last_position_that_is_given():
    """From z down the short way: edge, x, edge, z up."""
    up = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.7, 0.0, -0.7], [0.7, 0.0, 0.7]])
    given = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    assert _order(Setting(LINEAR), up, given, "travel").tolist() == [2, 1, 3, 0]


@pytest.mark.parametrize("turned", [0.0, 0.5])
@pytest.mark.parametrize("name", ["D", "A", "I", "u:ay:z"])
def test_positions_of_a_bench_are_the_best_of_all_choices(name, turned):
    """Four of seven beside two, with repeats: all 210, by X'V⁻¹X of each."""
    bench, given = read_scheme("fibonacci-7").up, read_scheme("roll-z-2").up
    choices = [list(each) for each in combinations_with_replacement(range(7), 4)]
    up = np.array([np.concatenate([bench[each], given]) for each in choices])
    X = np.einsum("ab,cnk->cnabk", np.eye(3), np.concatenate([np.ones((210, 6, 1)), up], axis=2))
    X = X.reshape(210, 6, 3, 12)
    V = np.eye(3) + turned**2 * (np.eye(3) - np.einsum("cni,cnj->cnij", up, up))
    M = np.einsum("cnap,cnab,cnbq->cpq", X, np.linalg.inv(V), X) / 6.0
    least = np.where(np.linalg.cond(M) < 1e12, 1.0, np.nan)
    if name == "D":
        value = least * np.linalg.slogdet(M)[1] / 12.0
    else:
        others = {"A": np.ones(12), "I": np.tile([1.0, 1 / 3, 1 / 3, 1 / 3], 3)}
        weight = others.get(name, np.where(np.arange(12) == 7, 1.0, 1e-4))
        inverse = np.linalg.pinv(M, hermitian=True)
        value = -np.log(least * (np.diagonal(inverse, axis1=1, axis2=2) @ weight))
    setting = Setting(LINEAR, orientation_sd=turned)
    best, found = _search(
        setting, make_criterion(name, setting), 4, bench, given, None, np.random.default_rng(0)
    )
    assert best == pytest.approx(np.nanmax(value), rel=1e-9)
    places = sorted(int(np.argmax(bench @ each)) for each in found)
    assert value[choices.index(places)] == pytest.approx(best, rel=1e-9)


def test_positions_that_show_too_little_are_no_design():
    """2e-10 own² is a column of norm 6e-10 at 9 positions or less; 1e-9 counts as an effect."""
    with pytest.raises(mp.MultiposError, match="no 9 positions were found that separate"):
        mp.design("each = b + s*own + k*2e-10*own^2", 9, axes="x")
    assert mp.design("each = b + s*own + k*2e-10*own^2", 60, axes="x").log_det is not None


def test_sentences_count_schemes_and_positions():
    def scheme(name, efficiency):
        return SimpleNamespace(
            name=name, identifiable=efficiency is not None, d_efficiency=efficiency, positions=9
        )

    three = [scheme("a", 0.7), scheme("b", None), scheme("c", 0.8), scheme("d", None)]
    said = schemes_sentence(SimpleNamespace(schemes=three, model="linear"))
    assert said.startswith("Best of 4 schemes for linear: c, 80.0 %")
    assert said.endswith("; 2 cannot determine it.")
    three[0] = scheme("a", 0.8)  # all that are best are named
    said = schemes_sentence(SimpleNamespace(schemes=three, model="linear"))
    assert said.startswith("Best of 4 schemes for linear: a, c, 80.0 %")


def test_positions_that_nothing_improves_stay_as_they_were():
    """Faces turned anyhow are the best six for the linear model; of others the criterion rises."""
    turn = np.linalg.qr(away_from_zero((3, 3)))[0]
    known, nothing = Setting(LINEAR), np.empty((0, 3))
    faces = read_scheme("faces-6").up @ turn
    value, up = polish(known, faces, Criterion("D"), nothing)
    assert up is faces
    assert value == pytest.approx(9.0 * math.log(1.0 / 3.0) / 12.0)
    off = faces + 0.05 * away_from_zero((6, 3), 2)
    off /= np.linalg.norm(off, axis=1, keepdims=True)
    better, up = polish(known, off, Criterion("D"), nothing)
    assert better == pytest.approx(value, abs=1e-9)
    assert up is not off
