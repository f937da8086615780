"""Schemes assessed and made: analytic optima, textbook designs, simulated calibrations."""

import contextlib
import io
import itertools
import json
import math
from functools import cache

import numpy as np
import pytest
from amounts import rest_slow
from known_noise import with_known_noise
from numpy.testing import assert_allclose

import multipos as mp
from multipos.cli import main
from multipos.designs import exchange
from multipos.designs.assessment import schemes_text
from multipos.designs.criteria import (
    Criterion,
    kernels,
    least_eigenvalue,
    make_criterion,
    objective,
    sensitivity,
)
from multipos.designs.exchange import _bordered, _descend, _State, choose
from multipos.designs.information import Setting, inform, log_det, make_setting
from multipos.designs.optimum import (
    _FINE,
    _derivatives,
    maxima,
    optimise_candidates,
    optimise_sphere,
    solve_definite,
)
from multipos.designs.prospects import _variances, rank_positions
from multipos.designs.ranges import range_directions
from multipos.positions.benches import read_bench
from multipos.positions.scheme import read_scheme
from multipos.sensor.model import build_model

pytestmark = pytest.mark.usefixtures("optima_once")
AXES = ("x", "y", "z")
OUTPUTS = ("ax", "ay", "az")


def setting(model, **options):
    return make_setting(build_model(model, OUTPUTS, AXES, AXES, known=()), **options)


def command(*arguments):
    """Return exit status, stdout and stderr of a command, run in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main(arguments)
    return status, out.getvalue(), err.getvalue()


# --- the continuous optimum


@pytest.mark.parametrize(
    ("model", "log_det_best"),
    [
        # by hand: M = diag(1, 1/3, 1/3, 1/3) for each output of the linear model
        ("linear", 9 * math.log(1 / 3)),
        ("own-quadratic", -14.3997428),
        ("cross-quadratic", -33.311718),
        ("own-cubic", -25.856998),
        ("ieee", -43.406893),
    ],
)
def test_optimum_on_the_sphere_is_the_analytic_one(model, log_det_best):
    # eq. (2) of designs.optimum
    best = optimise_sphere(setting(model), Criterion("D"))
    assert best.log_det == pytest.approx(log_det_best, abs=1e-6)
    assert best.gap <= 1e-6


def test_own_quadratic_optimum_by_hand():
    # six faces: per output the block of (1, own²) is [[1, 1/3], [1/3, 1/3]], the rest 1/3 each
    assert 3 * math.log(2 / 9 / 27) == pytest.approx(-14.3997428, abs=1e-6)
    best = optimise_sphere(setting("own-quadratic"), Criterion("D"))
    heavy = best.weights > 1e-6
    assert_allclose(best.weights[heavy], 1 / 6, atol=1e-6)
    assert_allclose(np.abs(best.up[heavy]).max(axis=1), 1.0, atol=1e-9)


@pytest.mark.parametrize(("model", "faces"), [("own-cubic", 2 / 3), ("ieee", 0.4)])
def test_optimum_shares_faces_and_corners(model, faces):
    best = optimise_sphere(setting(model), Criterion("D"))
    on_face = np.abs(best.up).max(axis=1) > 1 - 1e-6
    on_corner = np.abs(np.abs(best.up) - 3**-0.5).max(axis=1) < 1e-6
    assert best.weights[on_face].sum() == pytest.approx(faces, abs=1e-4)
    assert best.weights[on_corner].sum() == pytest.approx(1 - faces, abs=1e-4)


def test_unknown_orientation_optimum_is_the_icosahedron():
    unknown = setting("linear", unknown_orientation=True)
    assert len(unknown.model.keys) == 9
    best = optimise_sphere(unknown, Criterion("D"))
    assert best.log_det == pytest.approx(-16.548406, abs=1e-6)
    rows = unknown.rows(read_scheme("icosahedron-12").up)
    assert log_det(inform(rows)) == pytest.approx(best.log_det, abs=1e-7)


# Every model and every criterion at once; their other combinations take long.
CERTIFIED = [("linear", "D"), ("ieee", "A"), ("ieee-odd", "I"), ("1 + x + y + z + own*|own|", "D")]
MODELS, CRITERIA = (tuple(dict.fromkeys(each)) for each in zip(*CERTIFIED, strict=True))
OTHERS = sorted({*itertools.product(MODELS, CRITERIA)} - {*CERTIFIED})


@pytest.mark.parametrize(("model", "name"), rest_slow([*CERTIFIED, *OTHERS], quick=len(CERTIFIED)))
def test_certificate_holds_on_directions_it_never_saw(model, name):
    # eq. (1) of designs.optimum
    known = setting(model)
    criterion = make_criterion(name, known)
    best = optimise_sphere(known, criterion)
    kernel = kernels(inform(known.rows(best.up), best.weights), criterion)
    unseen = np.random.default_rng(1).standard_normal((10_000, 3))
    unseen /= np.linalg.norm(unseen, axis=1, keepdims=True)
    assert sensitivity(known.rows(unseen), kernel).max() - 1.0 <= 1e-6


@pytest.mark.parametrize("name", ["D", "A", "E", "I", "u:ay:y^2"])
@pytest.mark.parametrize("options", [{}, {"unknown_orientation": True}, {"orientation_sd": 40.0}])
def test_sensitivity_is_the_gradient_of_the_criterion(name, options):
    # eq. (2) of designs.criteria
    asked = setting("own-quadratic", **options)
    criterion = make_criterion(name, asked)
    rows = asked.rows(read_scheme("fibonacci-40").up)
    w = np.random.default_rng(2).dirichlet(np.ones(40))
    s = sensitivity(rows, kernels(inform(rows, w), criterion))
    assert w @ s == pytest.approx(1.0, rel=1e-10)
    h = 1e-6
    for k in (0, 7, 39):
        toward = np.eye(40)[k]
        up, down = (objective(inform(rows, w + t * (toward - w)), criterion) for t in (h, -h))
        assert (up - down) / (2 * h) == pytest.approx(s[k] - 1.0, abs=1e-5 * max(1.0, s[k]))


def test_one_parameter_alone_leaves_candidates_for_the_others():
    """Two faces of x carry all but 2 % of the weight; without the rest the information is 0."""
    alone = make_setting(build_model("linear", ("ax",), ("x",), AXES, known=()))
    rows = alone.rows(read_scheme("all-26").up)
    found = optimise_candidates(rows, make_criterion("u:ax:x", alone))
    information = inform([block[found.chosen] for block in rows], found.weights)[0]
    assert found.gap <= 1e-7
    # least tr(M⁻¹ B) at M_xx + M_yy + M_zz = 1: they are as the roots of B, 1 : 0.01 : 0.01
    assert_allclose(np.diag(information)[1:], np.array([100, 1, 1]) / 102, atol=1e-4)


def test_candidates_and_sphere_agree_where_the_candidates_hold_the_optimum():
    known = setting("ieee")
    listed = optimise_candidates(known.rows(read_bench("all-26")), Criterion("D"))
    assert listed.log_det == pytest.approx(-43.406893, abs=1e-6)
    # many candidates: near the sphere's optimum, never above
    many = optimise_candidates(known.rows(read_scheme("fibonacci-30000").up), Criterion("D"))
    assert many.gap <= 1e-7
    assert -43.409 < many.log_det < -43.406892


# --- information


def test_moments_of_the_sphere_against_quadrature():
    asked = setting("1 + x + y + z + own^2 + x*|x| + y*z")
    (exact, *_) = make_criterion("I", asked).weight
    (near, *_) = make_criterion("I", asked, read_scheme("fibonacci-200000").up).weight
    assert_allclose(near, exact, atol=1e-5)


def test_uncertain_orientation_lies_between_known_and_unknown():
    up = read_scheme("all-26").up
    exact = inform(setting("linear").rows(up))
    nearly = inform(setting("linear", orientation_sd=1e-5).rows(up))[0]
    for part, M in zip(setting("linear").blocks, exact, strict=True):
        assert_allclose(nearly[part, part], M, atol=1e-12)
    # of an sd without bound only the norm is left, in the parameters of the lower gauge
    unknown = setting("linear", unknown_orientation=True)
    full = setting("linear", orientation_sd=1e9)
    kept = [full.model.keys.index(key) for key in unknown.model.keys]
    assert_allclose(
        inform(full.rows(up))[0][np.ix_(kept, kept)], inform(unknown.rows(up))[0], atol=1e-12
    )


@pytest.mark.parametrize("size", [2.0, -2.0])
def test_information_of_one_position_by_hand(size):
    """Eq. (1) at u = x: across it a turn of s moves the outputs by s g, along it by nothing.

    V = diag(σ², σ² + s² g², σ² + s² g²) with σ = 0.3, s = 0.1, g = 2: 0.09 and 0.09 + 0.04.
    """
    # eq. (1) of designs.information
    model = build_model("linear", OUTPUTS, AXES)
    stated = Setting(model, orientation_sd=0.1, sd=np.full(3, 0.3), size=size)
    (M,) = inform(stated.rows(np.array([[1.0, 0.0, 0.0]])))
    wanted = np.zeros((12, 12))
    for output, variance in zip(OUTPUTS, (0.09, 0.13, 0.13), strict=True):
        pair = [model.index(output, "1"), model.index(output, "x")]
        wanted[np.ix_(pair, pair)] = np.array([[1.0, size], [size, 4.0]]) / variance
    assert_allclose(M, wanted, atol=1e-12)


def test_norm_row_by_difference():
    unknown = setting("own-quadratic", unknown_orientation=True)
    model = unknown.model
    up = read_scheme("fibonacci-5").up
    nominal = np.array([1.0 if f"{t}" == o[1] else 0.0 for o, t in model.keys])
    for j in range(len(nominal)):
        step = 1e-6 * np.eye(len(nominal))[j]
        ahead, behind = (
            np.linalg.norm(model.predict(nominal + sign * step, up, {}), axis=1) for sign in (1, -1)
        )
        assert_allclose(unknown.rows(up)[0][:, 0, j], (ahead - behind) / 2e-6, atol=1e-8)


# --- schemes


@pytest.mark.parametrize(
    ("scheme", "efficiency"),
    [
        ("faces-6", 1.0),
        ("edges-12", 0.758),
        ("icosahedron-12", 0.833),
        ("faces-corners-14", 0.844),
        ("faces-edges-18", 0.871),
        ("roll-x-8+roll-y-8+roll-z-8", 0.910),
        ("all-26", 0.809),
    ],
)
def test_d_efficiency_for_own_quadratic(scheme, efficiency):
    (entry,) = mp.schemes(scheme, model="own-quadratic")["schemes"]
    assert entry["d_efficiency"] == pytest.approx(efficiency, abs=5e-4)


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("count", [4, 24, 360])
def test_a_single_roll_plane_is_singular_for_the_linear_model(axis, count):
    (entry,) = mp.schemes(f"roll-{axis}-{count}")["schemes"]
    assert not entry["identifiable"]
    assert entry["log_det"] is entry["d_efficiency"] is entry["u"] is None
    assert any(f"cross_ay_{axis}" in text or "scale_ay" in text for text in entry["unidentifiable"])


def test_efficiencies_of_six_faces_by_hand():
    (entry,) = mp.schemes("faces-6")["schemes"]
    for key in ("d_efficiency", "a_efficiency", "e_efficiency", "g_efficiency", "i_efficiency"):
        assert entry[key] == pytest.approx(1.0, abs=1e-9)
    assert entry["log_det"] == pytest.approx(9 * math.log(1 / 3), abs=1e-12)
    assert entry["u"]["ax:1"] == pytest.approx(6**-0.5)
    assert entry["u"]["ax:x"] == pytest.approx(2**-0.5)
    assert entry["dof"] == {"ax": 2, "ay": 2, "az": 2}


@pytest.mark.parametrize(
    ("scheme", "model", "least", "efficiency"),
    [
        ("faces-6", "linear", 1 / 3, 1.0),
        ("dual-axis-48", "linear", 1 / 4, 0.75),
        # (1, own²): [[1, 1/3], [1/3, 1/3]] of the faces, [[1, 1/3], [1/3, 1/6]] of the edges
        ("faces-6", "own-quadratic", (4 / 3 - math.sqrt(8) / 3) / 2, 1.0),
        ("edges-12", "own-quadratic", (7 / 6 - math.sqrt(25 / 36 + 4 / 9)) / 2, 0.2547),
    ],
)
def test_e_efficiency_by_hand(scheme, model, least, efficiency):
    # eq. (3) of designs.criteria
    mine = setting(model)
    assert least_eigenvalue(inform(mine.rows(read_scheme(scheme).up))) == pytest.approx(least)
    (entry,) = mp.schemes(scheme, model=model).schemes
    assert entry.e_efficiency == pytest.approx(efficiency, abs=1e-4)


def test_efficiencies_of_uneven_faces_by_hand():
    """Eight positions, x faces twice: M = diag(1, 1/2, 1/4, 1/4), at best diag(1, 1/3, 1/3, 1/3).

    A: 1 + 2 + 4 + 4 against 1 + 9; I, with 1 and 1/3 as weights: 1 + 10/3 against 1 + 3; G: four
    parameters over the largest 1 + 2 x² + 4 y² + 4 z², which is 5.
    """
    # eq. (1) of designs.assessment
    (entry,) = mp.schemes("faces-6+roll-z-2", reading_sd=0.002)["schemes"]
    assert entry["log_det"] == pytest.approx(3 * math.log(1 / 32), abs=1e-9)
    assert entry["d_efficiency"] == pytest.approx((27 / 32) ** 0.25, abs=1e-9)
    assert entry["a_efficiency"] == pytest.approx(10 / 11, abs=1e-9)
    assert entry["i_efficiency"] == pytest.approx(4 / (13 / 3), abs=1e-9)
    assert entry["g_efficiency"] == pytest.approx(4 / 5, abs=1e-9)
    # eq. (1): σ sqrt([M⁻¹]_jj/n)
    assert entry["u"]["ay:1"] == pytest.approx(0.002 / math.sqrt(8))
    assert entry["u"]["ay:x"] == pytest.approx(0.002 * math.sqrt(2 / 8))
    assert entry["u"]["ay:y"] == pytest.approx(0.002 * math.sqrt(4 / 8))


def test_a_scheme_alone_is_printed_with_its_positions_and_u():
    alone, both = (schemes_text(mp.schemes("faces-6", *more)) for more in ((), ("all-26",)))
    rows = [line.split() for line in alone.splitlines()]
    assert ["4", "0.000000", "-1.000000", "0.000000"] in rows
    assert ["az", "x", "0.7071"] in rows  # √½
    assert "0.7071" not in both


def test_the_largest_u_of_each_kind_by_hand():
    """Eight positions, x faces twice: u is σ √(M⁻¹/8) with 1/M of 1, 2, 4, 4."""
    text = schemes_text(mp.schemes("faces-6+roll-z-2", "roll-x-24", reading_sd=0.002))
    rows = [line.split() for line in text.split("largest u of each kind\n")[1].splitlines()]
    assert rows[0] == ["scheme", "positions", "bias", "scale", "cross", "quad"]
    assert rows[1][1:] == ["8", "0.000707", "0.00141", "0.00141", "-"]
    assert rows[2] == ["roll-x-24", "24", "-", "-", "-", "-"]


def test_a_scheme_alone_says_what_drift_it_absorbs_in_both_orders():
    (entry,) = mp.schemes("fibonacci-24").schemes
    found = entry.drift_absorbed_by_order
    assert found["spread"] == entry.drift_absorbed < 0.01
    (published,) = mp.schemes("fibonacci-24", order="paper").schemes
    assert found["paper"] == published.drift_absorbed > 0.9
    text = schemes_text(mp.schemes("fibonacci-24"))
    assert "is absorbed to 0% in order spread, 100% as published" in text
    assert mp.schemes("faces-6", "all-26").schemes[0].drift_absorbed_by_order is None


def test_all_named_schemes_come_best_first():
    found = mp.schemes(model="ieee")["schemes"]
    shares = [round(entry["d_efficiency"] or 0.0, 9) for entry in found]
    assert shares == sorted(shares, reverse=True)
    assert not found[-1]["identifiable"]


def test_efficiency_ignores_rotation_for_linear_and_axes_order():
    turn = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))[0]
    turned = dict(zip(("up_x", "up_y", "up_z"), (read_scheme("all-26").up @ turn).T, strict=True))
    a, b = mp.schemes("all-26", turned)["schemes"]
    assert a["log_det"] == pytest.approx(b["log_det"], abs=1e-10)
    (c,) = mp.schemes("dual-axis-48", model="own-cubic", axes="x,y,z")["schemes"]
    (d,) = mp.schemes("dual-axis-48", model="own-cubic", axes="z,x,y")["schemes"]
    assert c["d_efficiency"] == pytest.approx(d["d_efficiency"], rel=1e-9)


def test_fewer_outputs_and_redundant_ones_are_described():
    (one,) = mp.schemes("roll-x-8+roll-y-8", axes="x", inputs="x,y")["schemes"]
    assert set(one["u"]) == {"ax:1", "ax:x", "ax:y"}
    (four,) = mp.schemes("faces-6", axes="x,y,z,x")["schemes"]
    assert {"ax:1", "ax2:1"} <= set(four["u"])


def test_what_six_faces_cannot_see():
    # eq. (1) of designs.aliases
    (entry,) = mp.schemes("faces-6", model="linear")["schemes"]
    seen = {(a["output"], a["term"]): a for a in entry["aliases"]}
    # x³ = x and x|x| = x on the faces; x y = 0 there; x² is a third, and shows: ‖x² − 1/3‖/‖x²‖
    assert seen["ax", "x^3"]["into"] == {"scale_ax": pytest.approx(1.0)}
    assert seen["ax", "x^3"]["seen"] == 0.0
    assert seen["ax", "x*y"] == {"output": "ax", "term": "x*y", "seen": 0.0, "into": {}}
    assert seen["ax", "x^2"]["seen"] == pytest.approx((2 / 3) ** 0.5)
    assert seen["ax", "x^2"]["into"] == {"bias_ax": pytest.approx(1 / 3)}
    assert "`x^3 of ax` passes for `+1 scale_ax`" in entry["hidden"]


# --- predicted uncertainties against simulated calibrations


def scatter_ratio(estimates, u):
    return estimates.std(axis=0, ddof=1) / u


def test_predicted_u_is_the_scatter_of_simulated_calibrations():
    rng, runs, sd = np.random.default_rng(4), 2000, 0.003
    scheme = read_scheme("faces-edges-18")
    (entry,) = mp.schemes(scheme, model="own-quadratic", reading_sd=sd)["schemes"]
    model = build_model("own-quadratic", OUTPUTS, AXES)
    truth = rng.standard_normal(15)
    readings = model.predict(truth, scheme.up, {})
    estimates = np.empty((runs, 15))
    phi = model.basis(scheme.up, {})
    for part, columns, i in zip(model.slices, model.columns, range(3), strict=True):
        noisy = readings[:, [i]] + sd * rng.standard_normal((18, runs))
        estimates[:, part] = np.linalg.lstsq(phi[:, columns], noisy, rcond=None)[0].T
    ratio = scatter_ratio(estimates, np.array(list(entry["u"].values())))
    # a standard deviation of 2000 runs is known to 1/√4000; four of that
    assert_allclose(ratio, 1.0, atol=4 / math.sqrt(2 * runs))


def test_predicted_u_of_uncertain_orientation_is_the_scatter():
    rng, runs, sd, tilt_deg = np.random.default_rng(5), 2000, 0.002, 0.3
    scheme = read_scheme("faces-corners-14")
    (entry,) = mp.schemes(scheme, orientation_sd=tilt_deg, reading_sd=sd)["schemes"]
    model = build_model("linear", OUTPUTS, AXES)
    up, n = scheme.up, len(scheme)
    delta = math.radians(tilt_deg) * rng.standard_normal((runs, n, 3))
    # first order, where the prediction is exact: f = u − δ × u
    turned = up - np.cross(delta, up)
    y = turned + sd * rng.standard_normal((runs, n, 3))
    X = np.zeros((n, 3, 12))
    for i in range(3):
        X[:, i, 4 * i : 4 * i + 4] = model.basis(up, {})[:, model.columns[i]]
    V = sd**2 * np.eye(3) + math.radians(tilt_deg) ** 2 * (
        np.eye(3) - np.einsum("ni,nj->nij", up, up)
    )
    W = np.linalg.inv(V)
    M = np.einsum("nip,nij,njq->pq", X, W, X)
    estimates = np.linalg.solve(M, np.einsum("nip,nij,rnj->pr", X, W, y)).T
    ratio = scatter_ratio(estimates, np.array(list(entry["u"].values())))
    assert_allclose(ratio, 1.0, atol=4 / math.sqrt(2 * runs))


def test_predicted_u_of_unknown_orientation_is_the_scatter():
    rng, runs, sd = np.random.default_rng(6), 1000, 1e-4
    scheme = read_scheme("icosahedron-12")
    (entry,) = mp.schemes(scheme, unknown_orientation=True, reading_sd=sd)["schemes"]
    rows = setting("linear", unknown_orientation=True).rows(scheme.up)[0][:, 0, :]
    estimates = np.empty((runs, 9))
    for run in range(runs):
        y = scheme.up + sd * rng.standard_normal((12, 3))
        # one Gauss–Newton step from the truth: at 1e-4 g the second changes nothing
        estimates[run] = np.linalg.lstsq(rows, np.linalg.norm(y, axis=1) - 1.0, rcond=None)[0]
    ratio = scatter_ratio(estimates, np.array(list(entry["u"].values())))
    assert_allclose(ratio, 1.0, atol=4 / math.sqrt(2 * runs))


@pytest.mark.parametrize("options", [{"orientation_sd": 0}, {"unknown_orientation": True}])
def test_predicted_u_is_what_the_fit_states(options):
    rng, sd = np.random.default_rng(10), 1e-4
    up = read_scheme("all-26").up
    table = dict(zip(("up_x", "up_y", "up_z"), up.T, strict=True))
    table |= dict(zip(OUTPUTS, (up + sd * rng.standard_normal(up.shape)).T, strict=True))
    cal = mp.fit(table, reading_sd=sd, **options)
    (entry,) = mp.schemes("all-26", reading_sd=sd, **options)["schemes"]
    # beside a claim that is right the residuals leave room for some more, alike for all
    ratio = cal.u / list(entry["u"].values())
    assert 0.95 < ratio.mean() < 1.1
    assert_allclose(ratio / ratio.mean(), 1.0, rtol=3e-3)
    if "orientation_sd" in options:  # the sensor is nominal to some 1e-4
        known = with_known_noise(cal)
        assert_allclose(known.u, list(entry["u"].values()), rtol=1e-3)


def test_predicted_u_is_what_the_fit_states_where_it_finds_orientation_errors():
    """The sd of 52 angles is known to a tenth, and u is of a mixture over what it may be."""
    rng, sd = np.random.default_rng(10), 1e-4
    up = read_scheme("all-26").up
    stood = up + np.cross(np.radians(0.05) * rng.standard_normal(up.shape), up)
    values = stood / np.linalg.norm(stood, axis=1)[:, None] + sd * rng.standard_normal(up.shape)
    table = dict(zip(("up_x", "up_y", "up_z"), up.T, strict=True))
    table |= dict(zip(OUTPUTS, values.T, strict=True))
    cal = mp.fit(table, reading_sd=sd)
    found = cal.orientation_spread.value
    (entry,) = mp.schemes("all-26", reading_sd=sd, orientation_sd=found)["schemes"]
    assert_allclose(cal.u / list(entry["u"].values()), 1.0, atol=0.12)


# --- exact designs


def quadratic(points):
    n, k = points.shape
    products = [points[:, i] * points[:, j] for i in range(k) for j in range(i, k)]
    return np.column_stack([np.ones(n), *points.T, *products])[:, np.newaxis, :]


def test_fourteen_runs_of_a_quadratic_in_three_factors():
    # AlgDesign's vignette: D = .4630447 of 14 runs on the 3³ grid; the continuous optimum there
    # makes its true efficiency .976
    points = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=3)))
    rows = (quadratic(points),)
    rng = np.random.default_rng(0)
    value, choice = choose(rows, 14, Criterion("D"), starts=200, rng=rng)[0]
    assert math.exp(value) == pytest.approx(0.4630447, abs=5e-8)
    assert len(choice) == 14
    best = optimise_candidates(rows, Criterion("D"))
    assert math.exp(value - best.value) == pytest.approx(0.976, abs=5e-4)


def test_eight_runs_of_least_average_variance():
    # eq. (1) of designs.criteria
    # skpr: 1 + a + b + a² + b² on the 3² grid, moments of the square; 167/360
    points = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=2)))
    X = np.column_stack([np.ones(9), points, points**2])[:, np.newaxis, :]
    moments = np.diag([1.0, 1 / 3, 1 / 3, 1 / 5, 1 / 5])
    moments[0, 3:] = moments[3:, 0] = 1 / 3
    moments[3, 4] = moments[4, 3] = 1 / 9
    criterion = Criterion("I", (moments,))
    value, _ = choose((X,), 8, criterion, rng=np.random.default_rng(0))[0]
    assert math.exp(-value) / 8 == pytest.approx(167 / 360, rel=1e-9)


def test_exchange_meets_every_choice_there_is():
    # eq. (1) of designs.exchange
    asked = setting("linear", orientation_sd=30.0)
    rows = asked.rows(read_bench("faces-corners-14"))
    criterion = make_criterion("A", asked)
    every = itertools.combinations_with_replacement(range(14), 5)
    best = max(objective(inform([Z[list(each)] for Z in rows]), criterion) for each in every)
    rng = np.random.default_rng(0)
    assert choose(rows, 5, criterion, rng=rng)[0][0] == pytest.approx(best, rel=1e-9)


@pytest.mark.parametrize(
    ("model", "positions", "best"),
    [("linear", 4, 1.0), ("linear", 6, 1.0), ("own-quadratic", 6, 1)],
)
def test_exact_designs_that_reach_the_optimum(model, positions, best):
    found = mp.design(model, positions)
    assert found["efficiency"] == pytest.approx(best, abs=1e-8)
    assert found["log_det"] == pytest.approx(found["optimum_log_det"], abs=1e-7)


def test_unknown_orientation_design_of_twelve_is_as_good_as_the_icosahedron():
    found = mp.design("linear", 12, unknown_orientation=True)
    assert found["efficiency"] == pytest.approx(1.0, abs=1e-7)
    assert found["certificate"]["parameters"] == 9


def test_design_keeps_its_promises():
    found = mp.design("own-quadratic", 14)
    p = found["certificate"]["parameters"]
    assert p == 15
    assert found["certificate"]["gap"] <= 1e-6
    assert found["certificate"]["max_variance"] == pytest.approx(
        p * (1 + found["certificate"]["gap"]), rel=1e-14
    )
    share = math.exp((found["log_det"] - found["optimum_log_det"]) / p)
    assert found["efficiency"] == pytest.approx(share, rel=1e-8)
    assert found["efficiency"] > 0.9848  # four faces twice, two three times: .98440
    assert_allclose(np.linalg.norm(found["positions"], axis=1), 1.0, atol=1e-12)
    (entry,) = mp.schemes(
        dict(zip(("up_x", "up_y", "up_z"), np.array(found["positions"]).T, strict=True)),
        model="own-quadratic",
    )["schemes"]
    assert entry["log_det"] == pytest.approx(found["log_det"], abs=1e-10)
    again = mp.design("own-quadratic", 14)
    assert_allclose(again["positions"], found["positions"])


@cache
def best_of_eight(criterion):
    return mp.design("own-quadratic", 8, criterion=criterion)


@pytest.mark.parametrize(
    "criterion", ["D", "A", "E", "I", pytest.param("G", marks=pytest.mark.slow), "u:ax:x^2"]
)
def test_each_criterion_is_best_at_its_own(criterion):
    designs = {name: best_of_eight(name) for name in ("D", criterion)}
    mine, other = designs[criterion]["scheme"], designs["D"]["scheme"]
    if criterion.startswith("u"):
        assert mine["u"]["ax:x^2"] <= other["u"]["ax:x^2"] + 1e-9
    else:
        key = f"{criterion.lower()}_efficiency"
        assert mine[key] >= other[key] - 1e-9
        assert designs[criterion]["efficiency"] == pytest.approx(mine[key], rel=1e-6)
    assert 0.0 < designs[criterion]["efficiency"] <= 1.0
    assert designs[criterion]["certificate"]["gap"] <= 1e-6


def test_included_positions_stay_and_count():
    found = mp.design("own-quadratic", 9, include="faces-6")
    assert_allclose(found["positions"][:6], read_scheme("faces-6").up)
    assert (len(found["positions"]), found["included"]) == (9, 6)
    # the next best one after six faces: every direction adds at most what a face does
    one = mp.design("own-quadratic", 7, include="faces-6", candidates="all-26")
    assert np.abs(one["positions"][6]).max() == 1.0


def test_candidates_hold_the_design_and_the_certificate():
    found = mp.design("own-quadratic", 14, candidates="two-axis-30")
    reachable = read_bench("two-axis-30")
    for up in found["positions"]:
        assert np.abs(reachable - up).max(axis=1).min() < 1e-12
    assert found["certificate"]["over"] == "candidates"
    tilted = mp.design("linear", 6, candidates="tilt-30")
    assert tilted["efficiency"] < tilted["bench_efficiency"] <= 1.0
    assert tilted["positions"][:, 2].min() >= math.cos(math.radians(30)) - 1e-12


def test_a_criterion_that_asks_nothing_of_a_parameter_is_refused():
    """At the optimum for forces across x nothing tells x: what is singular hangs on rounding."""
    from multipos.designs.criteria import Criterion, kernels

    with pytest.raises(mp.MultiposError, match="give a wider --region, or criterion D"):
        kernels((np.diag([1.0, 1.0, 0.0]),), Criterion("I", (np.diag([1.0, 1.0, 0.0]),)))


def test_region_of_criterion_i():
    # directions near z up: the scheme that predicts best there is better there than the other
    cap = read_bench("tilt-20")
    here = mp.design("own-quadratic", 8, criterion="I", region="tilt-20")
    everywhere = mp.design("own-quadratic", 8, criterion="I")
    asked = setting("own-quadratic")
    criterion = make_criterion("I", asked, cap)
    value = [objective(inform(asked.rows(d["positions"])), criterion) for d in (here, everywhere)]
    assert value[0] > value[1]


def test_orientation_error_changes_the_best_scheme():
    exact = mp.design("linear", 8)
    robust = mp.design("linear", 8, orientation_sd=1.0, reading_sd=0.001)
    judged = mp.schemes(
        *(
            dict(zip(("up_x", "up_y", "up_z"), np.array(d["positions"]).T, strict=True))
            for d in (exact, robust)
        ),
        orientation_sd=1.0,
        reading_sd=0.001,
    )["schemes"]
    assert judged[1]["d_efficiency"] >= judged[0]["d_efficiency"]


# --- benches and travel


def test_benches_reach_what_they_say():
    assert len(read_bench("two-axis-90")) == 6
    assert len(read_bench("roll-90-x")) == 4
    assert len(read_bench("cube+faces-6")) == 6
    assert len(read_bench("dodecahedron")) == 12
    near = read_bench("near-faces-10")
    assert np.abs(near).max(axis=1).min() == pytest.approx(math.cos(math.radians(10)))
    wide = read_bench("near-faces-32")  # in rings no more than 5 degrees apart
    rings = np.unique(np.round(np.degrees(np.arccos(np.clip(wide[wide[:, 2] > 0.8, 2], 0, 1))), 3))
    assert (rings[0], rings[-1]) == (0.0, 32.0)
    assert np.diff(rings).max() <= 5.0
    assert read_bench("tilt-30")[:, 2].min() == pytest.approx(math.cos(math.radians(30)))
    assert read_bench("tilt-30-x")[:, 0].min() == pytest.approx(math.cos(math.radians(30)))


# --- what further positions bring to a calibration


def readings(scheme, rng, sd=0.001):
    up = read_scheme(scheme).up
    values = up + 0.01 + sd * rng.standard_normal(up.shape)
    table = dict(zip(("up_x", "up_y", "up_z"), up.T, strict=True))
    return table | dict(zip(OUTPUTS, values.T, strict=True))


def after(found):
    return np.array([entry["after"] for entry in found.u])


def before(found):
    return np.array([entry["before"] for entry in found.u])


def measured_at(up, scale=1.0):
    """Readings at the positions of a design, without noise."""
    columns = dict(zip(("up_x", "up_y", "up_z"), up.T, strict=True))
    return columns | dict(zip(OUTPUTS, (scale * (up + 0.01)).T, strict=True))


def test_u_after_is_what_a_calibration_with_the_positions_states():
    # eq. (1) of designs.prospects
    rng = np.random.default_rng(8)
    options = {"model": "own-quadratic", "reading_sd": 0.001, "orientation_sd": 0}
    cal = with_known_noise(mp.fit(readings("faces-corners-14", rng), **options))
    found = mp.design(positions=17, include=cal, criterion="u:ay:y^2")
    assert (found.model, found.included) == ("own-quadratic", 14)
    assert_allclose(found.positions[:14], read_scheme("faces-corners-14").up, atol=1e-12)
    assert [(entry["output"], entry["term"]) for entry in found.u] == [
        (output, str(term)) for output, term in cal.model.keys
    ]
    assert [(entry["name"], entry["unit"]) for entry in found.u] == [
        (p.name, p.unit) for p in cal.entries
    ]
    assert_allclose(before(found), cal.u, rtol=1e-9)
    then = with_known_noise(mp.fit(measured_at(found.positions), **options))
    assert_allclose(after(found), then.u, rtol=1e-9)
    assert list(found.scheme.u.values()) == after(found).tolist()
    nothing = mp.design("own-quadratic", 9, include="faces-6")
    assert nothing.u == ()


@pytest.mark.parametrize(
    "options",
    [
        {"unknown_orientation": True, "gauge": "symmetric"},
        {"unknown_orientation": True, "convention": "gravity"},
        {"orientation_sd": 0.05},
        {"model": "each = b + s*own + c*x*y"},
    ],
)
def test_u_after_where_orientations_are_not_exact_or_the_model_is_ones_own(options):
    rng = np.random.default_rng(11)
    rows = readings("all-26", rng, 1e-4)
    if "convention" in options:
        rows |= {name: -rows[name] for name in OUTPUTS}
    cal = mp.fit(rows, reading_sd=1e-4, **options)
    found = mp.design(positions=30, include=cal)
    assert_allclose(before(found), cal.u, rtol=1e-9)
    up = found.positions
    more = dict(zip(("up_x", "up_y", "up_z"), up.T, strict=True))
    values = up + 0.01 + 1e-4 * rng.standard_normal(up.shape)
    values *= -1.0 if "convention" in options else 1.0
    then = mp.fit(more | dict(zip(OUTPUTS, values.T, strict=True)), reading_sd=1e-4, **options)
    # the further readings determine the noise as well, which was not foreseen
    assert_allclose(after(found), then.u, rtol=0.2)
    assert (after(found) <= (1.0 + 1e-12) * before(found)).all()
    assert after(found).sum() < 0.99 * before(found).sum()


def test_u_after_is_about_what_the_fit_states_where_it_finds_orientation_errors():
    """Fourteen positions know the sd of their .1 degrees to an eighth."""
    rng = np.random.default_rng(12)

    def placed(up):
        stood = up + np.cross(np.radians(0.1) * rng.standard_normal(up.shape), up)
        stood /= np.linalg.norm(stood, axis=1)[:, None]
        columns = dict(zip(("up_x", "up_y", "up_z"), up.T, strict=True))
        values = stood + 1e-4 * rng.standard_normal(up.shape)
        return columns | dict(zip(OUTPUTS, values.T, strict=True))

    cal = mp.fit(placed(read_scheme("faces-corners-14").up))
    found = mp.design(positions=30, include=cal)
    assert_allclose(before(found), cal.u, rtol=1e-9)
    then = mp.fit(placed(np.array(found.positions)))
    assert_allclose(after(found) / then.u, 1.0, atol=0.35)
    assert (after(found) < 0.85 * before(found)).all()


def test_what_positions_share_no_position_lowers():
    options = {"reading_sd": 0.001, "gravity": 9.8, "gravity_u": 0.01}
    cal = mp.fit(readings("faces-6", np.random.default_rng(9)), **options)
    found = mp.design(positions=200, include=cal)
    shared = 0.01 / 9.8 * cal["ax", "x"].value
    entry = found.u[cal.model.index("ax", "x")]
    assert shared < entry["after"] < 1.02 * shared


def test_a_drift_ends_with_its_session():
    up = np.tile(read_scheme("all-26").up, (2, 1))
    noise = 1e-4 * np.random.default_rng(4).standard_normal(up.shape)
    values = up + noise + 1e-4 * np.arange(len(up))[:, np.newaxis]
    cal = mp.fit(mp.Readings(values, up=up), drift=True)
    found = mp.design(positions=60, include=cal)
    kept = [i for i, (_, term) in enumerate(cal.model.keys) if str(term) != "drift"]
    assert_allclose(before(found), cal.u[kept], rtol=1e-9)
    assert all("drift" not in entry["name"] for entry in found.u)


def test_noise_that_is_stated_beside_a_calibration_wins():
    cal = mp.fit(readings("faces-corners-14", np.random.default_rng(9)), reading_sd=0.001)
    noisy = mp.design(positions=20, include=cal, reading_sd=0.01)
    assert_allclose(before(noisy), 10.0 * before(mp.design(positions=20, include=cal)), rtol=0.4)
    then = mp.fit(measured_at(noisy.positions), reading_sd=0.01)
    assert_allclose(after(noisy), with_known_noise(then).u, rtol=0.03)
    turned = mp.design(positions=20, include=cal, orientation_sd=1.0)
    assert (turned.scheme.parameters, turned.orientation) == (12, "uncertain")
    with pytest.raises(mp.UsageError, match="--reading-sd must be above 0, got 0"):
        mp.design(positions=20, include=cal, reading_sd=0.0)


@pytest.mark.parametrize(
    "typed",
    [{"model": "linear"}, {"axes": "x,y,z"}, {"inputs": "x,y"}, {"unknown_orientation": True}],
)
def test_a_model_beside_a_calibration_is_refused(typed):
    cal = mp.fit(readings("faces-corners-14", np.random.default_rng(9)), reading_sd=0.001)
    with pytest.raises(mp.UsageError, match="has model, axes and inputs of its own"):
        mp.design(positions=20, include=cal, **typed)


def test_a_calibration_is_included_by_the_path_of_its_file(tmp_path):
    cal = mp.fit(readings("faces-corners-14", np.random.default_rng(9)), reading_sd=0.001)
    path = tmp_path / "cal.json"
    cal.save(path)
    found = mp.design(positions=20, include=cal)
    assert mp.design(positions=20, include=path) == found
    status, out, err = command("design", "--include", str(path), "--positions", "20")
    assert (status, err) == (0, "")
    assert "20 positions reach" in out.splitlines()[0]
    assert "6 more lower u by" in out.splitlines()[0]
    assert "u before" in out
    status, out, _ = command("design", "--include", str(path), "--positions", "20", "--json")
    assert json.loads(out)["u"] == json.loads(json.dumps(found.to_dict()))["u"]
    figure = tmp_path / "design.svg"
    assert command("design", "--include", str(path), "--positions", "16", "-o", str(figure))[0] == 0
    assert "<svg" in figure.read_text(encoding="utf-8")


# --- the command line, and what it refuses


def test_design_writes_a_scheme_that_schemes_reads(tmp_path):
    path = tmp_path / "scheme.csv"
    status, out, err = command(
        "design", "--model", "linear", "--positions", "6", "--json", "-o", str(path)
    )
    assert (status, err) == (0, "")
    found = json.loads(out)
    assert path.read_text().splitlines()[0] == "position,up_x,up_y,up_z"
    status, out, _ = command("schemes", str(path), "--json")
    (entry,) = json.loads(out)["schemes"]
    assert entry["log_det"] == pytest.approx(found["log_det"], abs=1e-10)
    for key in ("d_efficiency", "a_efficiency", "g_efficiency", "condition", "u"):
        assert entry[key]


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        ("design --model linear --positions 3", 2, "at least 4 positions are needed"),
        ("design --model linear --positions 8 --unknown-orientation", 2, "9 parameters in all"),
        ("design --model linear --positions 6 --include faces-6", 2, "counts the 6 included"),
        ("design --model linear --positions 6 --criterion Z", 2, "unknown criterion 'Z'"),
        ("design --model linear --positions 6 --criterion u:ax:x^2", 2, "no parameter"),
        ("design --model linear --positions 6 --criterion u:ax", 2, "unknown criterion"),
        ("design --model linear --positions 6 --region cube", 2, "criterion I averages"),
        ("design --model linear --positions 6 --candidates nowhere", 2, "or a bench: two-axis-A"),
        ("design --model linear --positions 6 --candidates two-axis-7", 2, "does not divide"),
        ("design --model linear --positions 6 --candidates near-faces-60", 2, "at most 45"),
        ("design --model linear --positions 6 --candidates gone.csv", 1, "no such file"),
        ("design --model linear --positions 24 --candidates roll-15-x", 1, "`cross_ay_x`"),
        (
            "design --model own-quadratic --positions 9 --candidates corners-8",
            1,
            "separated from `3 quad_ax`",
        ),
        ("design --model full-quadratic --positions 24", 1, "no static positions can separate"),
        ("design --model linear --positions 6 --orientation-sd -1", 2, "must be 0 or more"),
        ("design --model linear --positions 9 --unknown-orientation --orientation-sd 1", 2, "not"),
        ("design --model linear --positions 9 --unknown-orientation --axes x,y", 2, "three outp"),
        ("design --model linear --positions 6 --move-time 3", 2, "two times"),
        ("design --model linear --positions 6 --seed -1", 2, "--seed must be 0"),
        ("design --model linear", 2, "--positions"),
        ("design --model linear --positions 5000", 2, "at most 200 are searched for"),
        ("design --model linear --positions 207 --include faces-6", 2, "201 new positions"),
        ("schemes faces-6 --reading-sd 0", 2, "--reading-sd must be above 0"),
        ("schemes faces-6 --reading-sd 1e308", 2, "--reading-sd must be above 0, from 1e-40"),
        ("schemes faces-6 --orientation-sd 1e308", 2, "give --unknown-orientation"),
        ("schemes faces-6 --orientation-sd 1 --reading-sd 1e-20", 2, "below 1e-11, got 1.0"),
        ("design --include gone.json --positions 8", 1, "no such file"),
    ],
)
def test_bad_input_is_one_clear_line(arguments, status, message):
    found, out, err = command(*arguments.split())
    line = err.strip().splitlines()[-1]
    assert (found, out) == (status, "")
    assert line.startswith("multipos: error: ")
    assert message in line


def test_what_no_prediction_comes_from_is_refused():
    rows = readings("faces-6", np.random.default_rng(9))
    saturated = mp.fit(rows, model="1+x+y+z+own^2+y^2")
    for predict in (rank_positions, lambda cal: mp.design(positions=20, include=cal)):
        with pytest.raises(mp.MultiposError, match="--reading-sd"):
            predict(saturated)
    rows = readings("all-26", np.random.default_rng(9))
    warm = mp.fit(rows | {"temperature": np.arange(26.0)}, model="1 + x + y + z + temperature")
    with pytest.raises(mp.MultiposError, match="column 'temperature', which a position does not"):
        mp.design(positions=30, include=warm)
    for other in (2.0, 1.0):  # −1/3 of a variance, and none at all
        with pytest.raises(mp.MultiposError, match="leave a parameter open"):
            _variances(np.array([[[1.0, other], [other, 1.0]]]))


def test_an_orientation_sd_beside_a_whole_g_warns():
    status, _, err = command("schemes", "faces-6", "--orientation-sd", "0.1")
    assert status == 0
    assert "State --reading-sd in g" in err


def test_the_model_of_a_calibration_is_designed_for():
    cal = mp.demo().calibration
    found = mp.design(cal.model, 6)
    assert found.efficiency == mp.design("own-quadratic", 6).efficiency
    assert found.certificate["parameters"] == len(cal.model.names)
    both = [mp.schemes("faces-6", model=model) for model in (cal.model, "own-quadratic")]
    assert both[0] == both[1]


@pytest.mark.parametrize(
    ("name", "axes"), [("tilt:±30", "xyz"), ("tilt:±30", "xz"), ("force:±0.4", "xyz")]
)
def test_how_tilt_follows_force_by_differences(name, axes):
    # eq. (1) of designs.ranges
    up, directions = range_directions(name, tuple(axes))
    sensed = ["xyz".index(axis) for axis in axes]
    for i, along in zip([0, 1] if axes == "xyz" else [0], directions, strict=True):

        def angle(force, i=i):
            length = np.linalg.norm(force, axis=1) if axes == "xyz" else 1.0
            return np.arcsin(force[:, i] / length) if name.startswith("tilt") else force[:, i]

        for place, j in enumerate(sensed):
            step = 1e-6 * np.eye(3)[j]
            slope = (angle(up + step) - angle(up - step)) / 2e-6
            assert_allclose(along[:, place], slope, atol=1e-8)


def test_maxima_of_a_function_of_directions():
    """Of u'Au those along ± the first eigenvector alone; of a sum of two hills both tops."""
    axis = np.array([0.3, -0.5, 0.81])
    axis /= np.linalg.norm(axis)
    A = 3.0 * np.outer(axis, axis) + np.diag([0.1, 0.2, 0.3])
    values, vectors = np.linalg.eigh(A)
    up, height = maxima(lambda u: np.einsum("ni,ij,nj->n", u, A, u))
    best = height >= height.max() - 1e-9
    np.testing.assert_allclose(height[best], values[2], rtol=1e-12)
    assert best.sum() == 2
    np.testing.assert_allclose(np.abs(up[best] @ vectors[:, 2]), 1.0, atol=1e-9)
    up, height = maxima(
        lambda u: np.exp(20.0 * (u @ axis - 1.0)) + 0.5 * np.exp(20.0 * (u[:, 0] - 1.0))
    )
    assert np.abs(up @ axis).max() == pytest.approx(1.0, abs=1e-8)
    assert height.max() == pytest.approx(1.0, abs=1e-5)


def test_the_search_for_positions_ends_at_the_least_value():
    def valley(x):  # H. H. Rosenbrock, Computer Journal 3, 1960
        a, b = 1.0 - x[0], x[1] - x[0] ** 2
        return a**2 + 100.0 * b**2, np.array([-2.0 * a - 400.0 * x[0] * b, 200.0 * b])

    assert_allclose(_descend(valley, np.array([-1.2, 1.0]))[0], [1.0, 1.0], atol=1e-5)


@pytest.mark.parametrize("kind", ["D", "L", "E"])
def test_slopes_and_curvature_of_a_criterion_by_differences(kind):
    rng = np.random.default_rng(5)
    rows = (rng.normal(size=(6, 1, 2)), rng.normal(size=(6, 2, 3)))
    weight = tuple(B @ B.T for B in (rng.normal(size=(2, 2)), rng.normal(size=(3, 3))))
    criterion = Criterion("mine", weight if kind == "L" else None, 7.0 if kind == "E" else None)
    w = rng.dirichlet(np.ones(6))
    slope, curvature = _derivatives(rows, w, criterion)
    d = rng.normal(size=6)
    d -= d.mean()
    h = 1e-4 * w.min()

    def at(t):
        return objective(inform(rows, w + t * d), criterion)

    first, second = (at(h) - at(-h)) / (2 * h), (at(h) - 2.0 * at(0.0) + at(-h)) / h**2
    assert slope @ d == pytest.approx(first, rel=1e-5)
    assert d @ curvature @ d == pytest.approx(-second, rel=1e-2)


def test_an_exchange_of_which_rounding_leaves_no_trace_gains_nothing():
    """The gain is ln t/(t − f); of candidates whose f is t or more it is −∞ and no number less."""
    rows = np.random.default_rng(4).normal(size=(9, 1, 3))
    criterion = Criterion("A", (np.diag([1.0, 2.0, 3.0]),))
    state = _State([rows], criterion, [np.zeros((3, 3))], np.arange(4))
    falls = state.trace * (1.0 - np.exp(-state.gains(2)))
    state.trace = np.sort(falls)[-2:].mean()
    assert state.trace > 0.0
    with np.errstate(invalid="ignore", divide="ignore"):
        wanted = -np.log1p(-falls / state.trace)
    wanted = np.where(falls < state.trace, wanted, -np.inf)
    assert_allclose(state.gains(2), wanted, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("k", [1, 2])
def test_bordered_matrices_are_what_they_stand_for(k):
    """W C W' of each candidate's rows above those that leave."""
    rng = np.random.default_rng(k)
    Z, C = rng.normal(size=(5, k, 4)), np.diag([1.0, 2.0, 3.0, 4.0])
    found = _bordered(Z @ C @ Z.transpose(0, 2, 1), Z @ C, Z[2], 2)
    for each, S in zip(Z, found, strict=True):
        W = np.concatenate([each, Z[2]])
        assert_allclose(S, W @ C @ W.T)


def test_large_definite_equations_are_solved_by_halves():
    rng = np.random.default_rng(2)
    A = rng.normal(size=(300, 310))
    A, B = A @ A.T, rng.normal(size=(300, 2))
    np.testing.assert_allclose(solve_definite(A, B), np.linalg.solve(A, B), rtol=1e-6)


def test_slopes_of_moving_positions_by_differences(monkeypatch):
    """Positions that are included weigh in the mean too."""
    # eq. (4) of designs.criteria
    falls = []
    monkeypatch.setattr(exchange, "_descend", lambda f, x: falls.append(f) or (x, f(x)[0]))
    up = mp.read_scheme("fibonacci-12").up[:6]
    mine, seen = setting("linear"), mp.read_scheme("icosahedron-12").up
    for criterion in (Criterion("D"), Criterion("G", power=20.0, seen=mine.rows(seen))):
        exchange.polish(mine, up, criterion, mp.read_scheme("faces-6").up[:4])
    x = 0.05 * np.random.default_rng(4).normal(size=12)
    for fall in falls:
        slope = fall(x)[1]
        for j in (0, 7):
            step = 1e-4 * np.eye(12)[j]
            by_differences = (fall(x + step)[0] - fall(x - step)[0]) / 2e-4
            assert slope[j] == pytest.approx(by_differences, rel=1e-3, abs=1e-6)
    monkeypatch.setattr(exchange, "objective", lambda information, criterion: -np.inf)
    # no step leads where a parameter is lost
    assert [fall(x)[0] for fall in falls] == [np.inf] * 2


def test_a_certificate_is_looked_at_closer_before_it_is_said(monkeypatch):
    looked = []
    monkeypatch.setattr(
        "multipos.designs.optimum.maxima",
        lambda sensed, *fine: looked.append(fine) or maxima(sensed, *fine),
    )
    optimise_sphere(setting("linear"), Criterion("D"))
    assert looked[-1] == (_FINE,)
    assert looked.count((_FINE,)) == 1  # as it takes longer


def test_included_positions_help_candidates_that_separate_nothing_by_themselves():
    """Corners show neither own^2 nor own^3 apart; beside the faces they do, and are the best."""
    found = mp.design("ieee", 14, candidates="corners-8", include="faces-6")
    assert found.certificate["gap"] < 1e-7
    assert 0.9 < found.bench_efficiency <= 1.0
    assert found.efficiency <= found.bench_efficiency * (1.0 + 1e-7)  # to the gaps of both optima


def test_weights_that_no_search_finds_are_refused(monkeypatch):
    monkeypatch.setattr("multipos.designs.optimum._ROUNDS", 1)
    with pytest.raises(mp.ConvergenceError, match="nearly inseparable"):
        optimise_candidates(setting("ieee").rows(read_bench("sphere")), Criterion("D"))


def test_weights_where_a_face_tells_a_millionth_of_its_own_axis_by_hand():
    """At 40 degrees w = 1/(1 + (0.7/0.001)²): A is least where 2/(t w) + 4/(1 − t) is."""
    noise = {"orientation_sd": 40.0, "reading_sd": 1e-3}
    found = mp.design("1 + x", 3, criterion="A", candidates="faces-6", **noise)
    small = math.sqrt(2.0) * 1e-3 / math.radians(40.0)
    assert_allclose(found.optimum["weights"][2:], small / (1.0 + small) / 4.0, rtol=3e-3)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_choice_without_an_inverse_by_rounding_is_left():
    """Orientation errors of 1e-4 degrees beside noise of 1e-12 g: squared, 12 digits between them.

    Saturated positions of a cubic take another two, so that none of the inverse's 16 is sure.
    """
    with pytest.raises((mp.MultiposError, mp.ConvergenceError)):
        mp.design("own-cubic", 6, criterion="I", orientation_sd=1e-4, reading_sd=1e-12)


def test_an_exchange_of_few_digits_takes_what_is_better_alone():
    """8 digits between orientation errors and noise: gains may be rounding, choices have inverses.

    So it is on any kernel; u agree with those of the same positions in 60 digits to 1e-6.
    """
    found = mp.design("own-cubic", 6, criterion="I", orientation_sd=1e-6, reading_sd=1e-12)
    assert 0.1 < found.efficiency < 0.2204  # the best known .2203, another .158


def test_no_positions_beside_a_line_of_them_separate_the_parameters():
    """Eight up and down, as near as numbers have it, and one more: all is singular."""
    include = np.tile([[0.6e-308, 0.3e-308, 1.0], [-0.2e-308, 0.7e-308, -1.0]], (4, 1))
    with pytest.raises(mp.MultiposError, match="no 9 positions were found that separate the"):
        mp.design(positions=9, include=include, candidates="all-26")
