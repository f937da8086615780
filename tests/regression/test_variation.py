"""Terms that a segment supports, the region its rows fill, and thermal balance."""

import shutil

import numpy as np
import pytest
from consumers import corrected_rows
from numpy.testing import assert_allclose

import multipos as mp
from multipos.exports.parts import Correction
from multipos.exports.target_correction import Drive
from multipos.numerics.terms import parse_terms
from multipos.regression.variation import Contributions, term_variances, varying

FACES = np.vstack([np.eye(3), -np.eye(3)])
VARIABLES = "f_x,f_y,f_z,temperature,temperature_rate,ambient,ambient_rate"
EDGES = "temperature:-20,20"


def truth(f, temperature, rate, ambient):
    """Return the error [g] of a sensor that bends, lags and feels its chamber."""
    t = temperature - 20.0
    of_force = 2e-5 * t * f[:, 0] + 1e-3 * f[:, 1]
    return 0.01 + 4e-4 * t + 3e-6 * t**2 + of_force + 4e-3 * rate + 2e-4 * (ambient - temperature)


def programme(seed):
    """Return a switch-on of the paper: 25 to 60, −45 and 60 °C by 1 °C/min, soaks between."""
    rng = np.random.default_rng(seed)
    corners = np.array([25.0, 60.0, 60.0, -45.0, -45.0, 60.0, 60.0])
    minutes = np.concatenate([[0.0], np.cumsum([35.0, 10.0, 105.0, 15.0, 105.0, 10.0])])
    fine = np.arange(0.0, minutes[-1], 0.1)
    chamber, case = np.interp(fine, minutes, corners), np.empty(len(fine))
    case[0] = chamber[0]
    for k in range(1, len(fine)):
        case[k] = case[k - 1] + (chamber[k] - case[k - 1]) * 0.1 / 4.0
    rate, chamber_rate = np.gradient(case, 0.1), np.gradient(chamber, 0.1)
    at = slice(0, None, 20)
    n = len(fine[at])
    f = FACES[rng.permutation(n) % 6] + rng.normal(0.0, 1e-3, (n, 3))
    error = truth(f, case[at], rate[at], chamber[at]) + rng.normal(0.0, 2e-4, n)
    return {
        "time": fine[at],
        **{f"f_{axis}": f[:, i] for i, axis in enumerate("xyz")},
        "temperature": case[at],
        "temperature_rate": rate[at] + rng.normal(0.0, 3e-4, n),
        "ambient": chamber[at],
        "ambient_rate": chamber_rate[at] + rng.normal(0.0, 3e-4, n),
        "error": error + 5e-4 * rng.standard_normal(),
    }


def switch_ons(seeds):
    runs = [programme(seed) for seed in seeds]
    joined = {name: np.concatenate([one[name] for one in runs]) for name in runs[0]}
    return joined | {"run": np.repeat(np.arange(len(runs)), [len(one["time"]) for one in runs])}


def in_balance(n=43):
    """Return rows that neither heat nor cool, z up, and their true error."""
    t, none = np.linspace(-44.0, 59.0, n), np.zeros(n)
    columns = {"f_x": none, "f_y": none, "f_z": none + 1.0, "temperature": t, "ambient": t}
    columns |= {"temperature_rate": none, "ambient_rate": none}
    return columns, truth(np.tile([0.0, 0.0, 1.0], (n, 1)), t, none, t)


@pytest.mark.parametrize("seed", [0, 5])
@pytest.mark.parametrize("free", [False, True])
def test_nothing_wrong_inside_the_region_in_thermal_balance(seed, free):
    """Five switch-ons, 36 candidates: rate² is constant in the middle, and was off by .65 g."""
    model = mp.regress(
        switch_ons(range(seed, seed + 5)),
        response="error",
        variables=VARIABLES,
        degree=2,
        stepwise=True,
        segment=EDGES,
        run="run",
        free=free,
    )
    columns, expected = in_balance()
    found = mp.correct(model, columns, uncertainty=True)
    off, U = np.abs(found["predicted"] - expected), np.asarray(found["U_predicted"])
    inside = ~np.asarray(found["outside"]).astype(bool)
    assert off[inside].max(initial=0.0) < 1.5e-3
    assert (off[inside] <= U[inside]).mean() >= (0.95 if inside.any() else 0.0)
    middle = np.abs(columns["temperature"]) < 15.0
    assert inside[middle].all() == (not free)  # where ±1 °C/min was all that was measured
    assert model.balance is not None
    still = ~model.balance.outside
    assert ("balance" in [one.code for one in model.findings]) == (still.mean() < 0.9)
    if free:
        left = {one.term for one in model.segments[1].left_out}
        assert "temperature_rate^2" in left
    for row in model.to_dict()["balance"]:
        assert set(row) == {"temperature", "predicted", "U", "outside"}
    said = next(line for line in str(model).splitlines() if line.startswith("balance"))
    predicted = model.balance.predicted[still]
    assert f"{predicted.min():.4g} to {predicted.max():.4g}" in said


def test_a_term_varies_by_its_share_of_the_table():
    """Two columns about a mean: parts of 1.1e-2 and .9e-2 of their sd over the table."""
    # eq. (1) of regression.variation
    table = np.tile([1.0, -1.0], 50)
    columns = {"a": table, "T": np.linspace(250.0, 350.0, 100)}
    (a, square) = term_variances(parse_terms("1 + a + T^2"), columns)[1:]
    assert a == pytest.approx(1.0)
    assert square == pytest.approx(np.var((columns["T"] - 300.0) ** 2))
    one = np.ones(100)
    for share, kept in ((1.1e-2, [0, 1]), (0.9e-2, [0])):
        design = np.column_stack([one, 7.0 + share * table])
        assert varying(design, np.array([0.0, 1.0]), [0, 1]) == kept


def test_coefficients_that_cancel_by_hand():
    """On x = 9 … 11: 100 (x − 10)² has a range of 100; 5,000 x² less the same line 2 · 5,000."""
    # eq. (2) of regression.variation
    columns = {"x": np.linspace(9.0, 11.0, 21)}
    terms = parse_terms("1 + x + x^2")
    square = np.array([100.0, -20.0, 1.0])
    assert not Contributions(columns, 100.0).cancel(terms, 100.0 * square)
    assert Contributions(columns, 100.0).cancel(terms, 201.0 * square)
    assert not Contributions(columns, 100.0).cancel(terms[:2], np.array([-1000.0, 100.0]))
    assert Contributions(columns, 100.0).cancel(terms[:2], np.array([-1000.0, 101.0]))


def test_true_curves_whose_terms_are_larger_than_their_range_do_not_cancel():
    """Eq. (2) is no bound of 1: x² on four even points has 9/8, 4x³ − 3x on −1 … 1 has 2."""
    even = {"x": np.array([-1.0, -1.0 / 3.0, 1.0 / 3.0, 1.0])}
    assert not Contributions(even, 8.0 / 9.0).cancel(parse_terms("1 + x^2"), np.array([0.0, 1.0]))
    fine = {"x": np.linspace(-1.0, 1.0, 21)}
    cubic = parse_terms("x + x^3"), np.array([-3.0, 4.0])
    assert not Contributions(fine, 2.0).cancel(*cubic)
    assert Contributions(fine, 0.99).cancel(*cubic)  # 4 times the range of a cubic, no more


def test_region_is_the_leverage_of_least_squares():
    """Free segments by their own hat matrix, joined ones by that of the constrained fit."""
    # eq. (1) of regression.region
    rng = np.random.default_rng(3)
    t, v = rng.uniform(-40.0, 60.0, 80), rng.standard_normal(80)
    columns = {"t": t, "v": v, "y": 0.1 + 0.02 * t + 0.5 * v + rng.normal(0.0, 0.01, 80)}
    hinge = np.where(t > 0.0, t, 0.0)
    joined = np.column_stack([np.ones(80), t, v, hinge])
    below = np.column_stack([np.ones(80), t, v])
    for free, X, rows in ((False, joined, t > -50.0), (True, below, t < 0.0)):
        model = mp.regress(columns, response="y", variables="t,v", segment="t:0", free=free)
        C = np.linalg.inv(X[rows].T @ X[rows])
        at = {"t": np.array([-30.0, -5.0]), "v": np.array([0.3, -2.0])}
        x = np.column_stack([np.ones(2), at["t"], at["v"], np.zeros(2)])[:, : X.shape[1]]
        region = model.segments[0].region
        assert_allclose(region.leverage(at, 2), np.einsum("ij,jk,ik->i", x, C, x), rtol=1e-10)
        limit = np.einsum("ij,jk,ik->i", X[rows], C, X[rows]).max()
        assert region.limit == pytest.approx(limit, rel=2e-9)


@pytest.mark.parametrize("free", [False, True])
def test_a_corner_of_the_box_is_outside_in_python_and_in_c(free, tmp_path):
    """Ambient follows the case: the corners of their box hold no row."""
    if shutil.which("gcc") is None:
        pytest.skip("no gcc on this machine")
    data = switch_ons(range(3))
    names = ("temperature", "temperature_rate", "ambient")
    options = {"degree": 2, "stepwise": True, "segment": EDGES, "free": free}
    model = mp.regress(data, response="error", variables=names, time="time", **options)
    c = Correction(None, (model,))
    rng = np.random.default_rng(1)
    wide = [rng.uniform(data[name].min(), data[name].max(), 4000) for name in c.inputs]
    seen = np.column_stack([data[name] for name in c.inputs])
    rows = np.vstack([np.column_stack(wide), seen])
    table = {name: rows[:, i] for i, name in enumerate(c.inputs)}
    flagged = np.asarray(mp.correct(model, table)["outside"])
    assert 0.3 < flagged[:4000].mean() < 1.0
    assert not flagged[4000:].any()
    drive = Drive(np.arange(len(rows)), np.arange(float(len(rows))), rows)
    back = corrected_rows(mp.export(model, "c").text, c, drive)
    assert (back[:, 0] == flagged).all()


def test_the_region_of_segments_that_join_has_a_term_once():
    """T says nothing beside its changes below and above 0, of which each segment's T is made."""
    T = np.linspace(-40.0, 60.0, 200)
    table = {"T": T, "y": 1e-3 * np.abs(T) + 1e-4 * np.random.default_rng(0).normal(size=200)}
    found = mp.regress(table, response="y", variables="T", stepwise=True, segment="T:0")
    for segment in found.segments:
        assert [str(term) for term in segment.region.terms] == ["1", "T"]
