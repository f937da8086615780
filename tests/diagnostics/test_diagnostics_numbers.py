"""Numbers behind findings by hand or by a second route, at points without symmetry."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from findings_bench import EXACT
from numpy.testing import assert_allclose
from scipy.stats import chi2
from scipy.stats import f as fisher

import multipos as mp
from multipos.diagnostics import (
    examination,
    gross_errors,
    magnetic,
    model_error,
    projections,
    repairs,
    residuals,
    row_order,
    scales,
    score_tests,
)
from multipos.diagnostics.columns import (
    _clipped,
    _has_common_ends,
    _shows_noise,
    counter_column,
)
from multipos.diagnostics.examination import _gain_without
from multipos.diagnostics.gross_errors import _is_skew, _is_slight, _known_to, _silent
from multipos.diagnostics.magnetic import _left, _size_in_tesla, field_size, moving_iron
from multipos.diagnostics.model_error import are_better_with
from multipos.diagnostics.projections import _whitener
from multipos.diagnostics.repairs import (
    View,
    _many_factors,
    _many_flips,
    _radians,
    _wrap_of,
    look,
)
from multipos.diagnostics.residuals import _separable
from multipos.diagnostics.row_order import _correlation, _judge_slow, _limit, _traces
from multipos.diagnostics.scales import (
    _stands_apart,
    _times,
    factor_in_words,
    reversed_or_permuted,
)
from multipos.diagnostics.score_tests import ratios_of
from multipos.sensor.found import Estimator
from multipos.sensor.model import build_model

K = np.array([[2.0, 0.1, -0.2], [0.05, 1.5, 0.15], [-0.1, 0.2, 1.1]])
UP = mp.read_scheme("fibonacci-14").up


def view_of(values, reference=UP):
    return View(np.ones((len(reference), 1)), reference, values)


def readings(seed=1, sd=0.002):
    return 0.3 + UP @ K.T + sd * np.random.default_rng(seed).normal(size=UP.shape)


# --- rows in time


@pytest.mark.parametrize("beside", [False, True])
def test_traces_of_correlated_rows_by_dense_matrices(beside):
    rng = np.random.default_rng(3)
    n, rho = 17, _correlation(17)
    Q = np.linalg.qr(rng.normal(size=(n, 4)))[0]
    across = rng.normal(size=(n, 2)) if beside else None
    Omega = rho ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    if beside:
        Omega = Omega * (across @ across.T)
    once = (np.eye(n) - Q @ Q.T) @ Omega
    powers = [once.trace(), (once @ once).trace(), (once @ once @ once).trace()]
    assert_allclose(_traces(Q, across), powers, rtol=1e-9)


def test_the_correlation_of_slow_noise_is_that_of_a_fifth_of_the_rows():
    assert [_correlation(n) for n in (8, 20, 200)] == pytest.approx([0.5, 0.75, 0.95])


@pytest.mark.parametrize("beside", [False, True])
def test_slow_noise_is_judged_by_a_chi_square_of_its_first_moments(beside, monkeypatch):
    """T = e'Ωe above mean and sd by a gamma law of the skewness; units that are not whole not."""
    rng = np.random.default_rng(5)
    n, rho = 30, _correlation(30)
    e = np.cumsum(rng.normal(size=(n, 2, 3)), axis=0)
    e[:, :, 2] = rng.normal(size=(n, 2))
    e /= np.sqrt(np.sum(e**2, axis=0))
    across = rng.uniform(0.5, 1.5, (n, 2)) if beside else None
    Omega = rho ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    w = e if across is None else across[:, :, None] * e
    T = np.einsum("icb,ij,jcb->b", w, Omega, w)
    mean, sd, skewness = 2.0, (T[0] - 2.0) / 5.5, 0.8
    plan = SimpleNamespace(slow=(mean, sd, skewness), across=across, codes=3, freedom=7.0)
    monkeypatch.setattr(row_order, "_slow_gains", lambda plan, e: np.arange(5.0, 5.0 + e.shape[2]))
    score, p = np.zeros(3), np.ones(3)
    _judge_slow(plan, e, np.array([True, False, True]), score, p)
    k = 8.0 / 0.8**2
    assert p[0] == pytest.approx(3 * chi2.sf(k + math.sqrt(2 * k) * 5.5, k), rel=1e-6)
    assert p[0] < row_order.LEVEL
    assert score[0] == pytest.approx(5.0 - math.log(7.0))
    assert (score[1:].tolist(), p[1:].tolist()) == ([0.0, 0.0], [1.0, 1.0])


# --- repairs


def test_several_rows_upside_down_are_found_from_a_guess():
    values = readings()
    turned = [1, 4, 9, 12]
    values[turned] = 0.3 - UP[turned] @ K.T
    found = list(_many_flips(view_of(values), np.diag([1.0, 1.0, 1.0])))
    best = min(found, key=lambda repair: repair.view.misfit)
    assert best.rows == (1, 4, 9, 12)
    assert all(2 * len(repair.rows) <= 14 for repair in found)


@pytest.mark.parametrize(
    ("rows", "size"), [((0, 3, 7), 9.80665), (tuple(range(3, 14)), 1 / 9.80665)]
)
def test_rows_in_another_unit_are_found_by_their_size(rows, size):
    """Of more than half the others are the exception, by the inverse of the factor."""
    values = readings()
    values[list(rows)] *= 9.80665
    found = min(_many_factors(view_of(values)), key=lambda repair: repair.view.misfit)
    few = rows if len(rows) < 7 else tuple(sorted({*range(14)} - {*rows}))
    assert (found.rows, found.size) == (few, pytest.approx(size))
    assert found.shrunk == pytest.approx(len(rows) * 3 * math.log(9.80665))
    # larger sets of 2 to 12, in steps of 1, by two orders
    assert found.tried == 22


def test_a_converter_that_ran_over_is_set_right_by_its_step():
    values = readings(sd=1e-4)
    over = values[:, 0] > 1.9
    assert 1 <= over.sum() <= 3
    values[over, 0] -= 4.096
    view = view_of(values)
    M = np.eye(14) - view.basis @ view.basis.T
    rows, step = _wrap_of(view, M, 0)
    assert step == pytest.approx(4.096, abs=0.01)
    assert np.flatnonzero(rows).tolist() == np.flatnonzero(over).tolist()
    assert (rows[over] > 0.0).all()
    assert _wrap_of(view, M, 1) is None
    values = readings(sd=1e-4)  # beyond both ends of a range of 1.9, nine of fourteen
    v = (values[:, 0] > 0.7).astype(float) - (values[:, 0] < -1.2)
    values[:, 0] -= 1.9 * v
    rows, step = _wrap_of(view_of(values), M, 0)
    assert rows.tolist() == v.tolist()
    assert step == pytest.approx(1.9, abs=0.01)


def test_what_is_put_back_is_the_difference_of_the_readings():
    c = SimpleNamespace(
        readings=SimpleNamespace(values=np.full((4, 2), 0.5), labels=("p", "q", "r", "s")),
        outputs=("a", "b"),
    )
    for added, cells, way in (
        ([[4, 0], [0, 0], [0, 4], [4, 0]], "p, s of a; r of b", "Add 4 to these readings"),
        ([[0, 0], [-4, -4], [0, 0], [0, 0]], "q of a; q of b", "Subtract 4 from these readings"),
        ([[0, 4], [0, 0], [0, 0], [-4, 0]], "s of a; p of b", "Add 4 to the low ones of these"),
    ):
        view = SimpleNamespace(values=c.readings.values + added)
        repair = SimpleNamespace(view=view, outputs=(0, 1), size=4.0)
        assert gross_errors._cells(c, repair) == cells
        assert gross_errors._unwrap(c, repair).startswith(way)


def test_radians_that_were_read_as_degrees_are_turned_back():
    """Roll and pitch with z down, and turns about x, y and z, as schemes have them."""
    roll, pitch = np.radians([40.0, -75.0, 160.0]), np.radians([25.0, 60.0, -10.0])

    def direction(roll, pitch):
        x = np.sin(pitch)
        return np.column_stack([x, -np.sin(roll) * np.cos(pitch), -np.cos(roll) * np.cos(pitch)])

    def meant(up, sign=1.0):
        view = SimpleNamespace(odd=sign * 1.3 * up, at=lambda reference: reference)
        return [repair.view for repair in _radians(view)]

    as_read = direction(np.radians(roll), np.radians(pitch))
    (found,) = meant(as_read)
    assert_allclose(found, 1.3 * direction(roll, pitch), atol=1e-9)
    assert_allclose(meant(as_read, -1.0)[0], -1.3 * direction(roll, pitch), atol=1e-9)
    angle = np.radians([30.0, 50.0, 100.0])
    places = ((1, 2), (0, 2), (0, 1))
    as_read, truth = np.zeros((3, 3)), np.zeros((3, 3))
    for row, (first, second) in enumerate(places):
        small = math.radians(angle[row])
        as_read[row, [first, second]] = math.cos(small), math.sin(small)
        truth[row, [first, second]] = math.cos(angle[row]), math.sin(angle[row])
    assert_allclose(meant(as_read)[0], 1.3 * truth, atol=1e-9)
    assert meant(UP) == []


# --- a magnetometer


def test_misfits_of_a_field_are_freed_of_what_a_calibration_takes():
    rng = np.random.default_rng(4)
    b = rng.normal(size=(60, 3))
    b *= rng.normal(1.0, 0.01, (60, 1)) / np.linalg.norm(b, axis=1, keepdims=True)
    relative = SimpleNamespace(compensate=lambda values, environment: values)
    c = SimpleNamespace(
        estimator=Estimator.UNKNOWN, readings=range(60), robust_weight=None, rms=0.01,
        relative=relative, effective_rows={"a": 30.0, "b": 24.0},
    )  # fmt: skip
    u, design, left, fewer = _left(c, SimpleNamespace(values=b, environment={}))
    x, y, z = (b / np.linalg.norm(b, axis=1, keepdims=True)).T
    X = np.column_stack([x, y, z, x * x, x * y, x * z, y * y, y * z, z * z])
    misfit = np.linalg.norm(b, axis=1) - 1.0
    assert_allclose(u, np.column_stack([x, y, z]))
    assert_allclose(left, misfit - X @ np.linalg.pinv(X) @ misfit, atol=1e-12)
    assert fewer == pytest.approx(60 / 24)
    assert design.shape == (60, 9)


def test_what_is_mostly_one_reading_s_is_no_iron_that_moved():
    """Of what the squares fall by in six rows a share in one, just below and above the limit."""
    added = np.zeros(10)
    added[3:9] = 0.5
    for share in (magnetic._OF_ONE_ROW * 0.98, magnetic._OF_ONE_ROW * 1.02):
        left = np.zeros(10)  # a row falls by 2 left .5 − .25
        rest = (1.0 - share) / 5.0
        left[3:9] = np.array([share, *[rest] * 5]) + 0.25
        found = magnetic._of_one_row(left, added)
        assert found is (share > magnetic._OF_ONE_ROW)


def test_what_a_step_adds_is_what_its_columns_take_beside_the_design():
    """By one fit of both, the columns of the step in rows 12 to 29 only."""
    rng = np.random.default_rng(6)
    u, design = rng.normal(size=(50, 3)), rng.normal(size=(50, 4))
    left = rng.normal(size=50)
    left -= design @ np.linalg.pinv(design) @ left
    inside = np.zeros((50, 3))
    inside[12:30] = u[12:30]
    both = np.column_stack([design, inside])
    added = magnetic._of_step(u, design, magnetic._sums(u, design, left), 12, 30)
    assert_allclose(added, both @ np.linalg.pinv(both) @ left, atol=1e-12)


@pytest.mark.parametrize(
    ("left", "fewer"),
    [
        ([3.0, 2.0, 1.0, 0.0, 0.0, 0.0] * 10, 1.0 + 2.0 * (8.0 + 3.0) / 14.0),  # up to the first 0
        ([2.0, -1.0, 0.0] * 10, 1.0),
        ([1.0] * 12, 1.0 + 2.0 * (11.0 + 10.0) / 12.0),  # lags below a quarter of the rows
        ([1.0, 0.05, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], 1.0),  # by 0.05/1.0025, below 0.05
        ([1.0, 0.051, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], 1.0 + 2.0 * 0.051 / 1.002601),
        ([0.0] * 40, 1.0),
    ],
)
def test_rows_that_are_correlated_exceed_independent_ones(left, fewer):
    """By 1 + 2 Σ r over lags, until the correlation r is faint; turning over changes nothing."""
    left = np.array(left)
    u = np.tile([0.0, 0.6, -0.8], (len(left), 1))
    assert magnetic._times_fewer(u, left) == pytest.approx(fewer, rel=1e-12)
    over = np.where(np.arange(len(left)) % 2, -1.0, 1.0)
    assert magnetic._times_fewer(over[:, None] * u, over * left) == pytest.approx(fewer, rel=1e-12)


def test_rows_in_directions_at_right_angles_are_not_correlated():
    """x, x, y, y, z, z, … of the same misfit: 10 of 20 rows have a neighbour alike."""
    u = np.repeat(np.vstack([np.eye(3)] * 4)[:10], 2, axis=0)
    assert magnetic._times_fewer(u, np.full(20, -0.3)) == pytest.approx(1.0 + 2.0 * 10.0 / 20.0)


@pytest.mark.parametrize(("gained", "end"), [(0.9, 60), (0.9, 50), (0.02, 60)])
def test_iron_that_moves_is_judged_by_f_of_the_rows_that_count(gained, end, monkeypatch):
    """Three numbers of 80 rows that are worth 40 by what the step leaves: the part is one of 45.

    Of 1, 1, 0, 0, … half the squares are products of neighbours, and none at the next lag; the
    rows with the step in them, all alike, would be worth hardly more than two.
    """
    left = np.full(80, 0.1)
    added = 0.1 * np.tile([0.0, 0.0, 1.0, 1.0], 20)
    field = SimpleNamespace(size=None)
    labels = tuple(str(i) for i in range(60))
    c = SimpleNamespace(field=field, readings=SimpleNamespace(labels=labels))
    found = np.tile([0.0, 0.6, -0.8], (80, 1)), np.zeros((80, 9)), left, 7.0
    refined = 21, end + 20 * (end == 60)
    of_step = {(20, end): added, refined: 0.5 * added}
    judged = []
    monkeypatch.setattr(magnetic, "_left", lambda c, readings: found)
    monkeypatch.setattr(magnetic, "_sums", lambda *_: None)
    monkeypatch.setattr(magnetic, "_likeliest", lambda sums: (20, end, gained * 0.8))
    step = np.array([[0.018, 0.0, -0.024]])
    monkeypatch.setattr(magnetic, "_refined", lambda sums, start, end: refined)
    monkeypatch.setattr(magnetic, "_moved", lambda sums, start, end: (step, None))
    monkeypatch.setattr(magnetic, "_of_step", lambda u, design, sums, *run: of_step[run])
    monkeypatch.setattr(magnetic, "_of_one_row", lambda *rows: bool(judged.append(rows)))
    f = gained * 0.8 / 3.0 / 2.0 / ((1.0 - gained) * 0.8 / (80 - 12))
    p = 45 * fisher.sf(f, 3, 28)
    said = moving_iron(c)
    if gained < 0.1:
        assert said is None
        return
    assert said.p == pytest.approx(p, rel=1e-6)
    where = "from row 21 on" if end == 60 else "from row 21 to row 49"
    assert said.text.startswith(f"hard iron changes by 3 % of the field {where}")
    assert_allclose(judged, [(left, 0.5 * added)])


# --- columns


@pytest.mark.parametrize(
    ("step", "short", "found"),
    [(0.002, 0.0105, False), (0.002, 0.0115, True), (0.004, 0.0155, False), (0.004, 0.0165, True)],
)
def test_a_saturated_reading_falls_short_of_what_the_others_say(step, short, found):
    """By a hundredth of the signal, 1.1 here, or four of the least steps, at the least."""
    x = np.array([0.3, 1.0, -0.9, 0.3 + step / 1.1, -0.2, 0.998, 0.7, -0.5])
    values = 0.2 + 1.1 * x
    values[[1, 5]] = 1.3 - short
    clipped = _clipped(x[:, None], values)
    assert (clipped is not None) is found
    if found:
        assert clipped.tolist() == [1, 5]
    values[5] = 0.2 + 1.1 * 0.99  # one alone is the largest of all
    assert _clipped(x[:, None], values) is None


def test_a_column_that_counts_the_rows():
    def c(values, residuals):
        return SimpleNamespace(
            readings=SimpleNamespace(values=values), outputs=("a", "b"), residuals=residuals
        )

    count = np.arange(7.0) * 0.25 + 3.0
    values = np.column_stack([count, np.cos(count)])
    assert counter_column(c(values, np.full((7, 2), 1e-3))).outputs == ("a",)
    assert counter_column(c(values, np.full((7, 2), 2.4e-7))) is None
    assert counter_column(c(values, np.full((7, 2), 2.6e-7))).outputs == ("a",)
    assert counter_column(c(values[:4], np.ones((4, 2)))) is None
    off = values.copy()
    off[5, 0] += 1e-9
    assert counter_column(c(off, np.ones((7, 2)))) is None


@pytest.mark.parametrize(("scatter", "common"), [(0.8, True), (0.7, False)])
def test_ends_that_outputs_share_are_a_limit(scatter, common):
    """Three tops and three bottoms are one: four more than two; (.1/(4 s))^4 is 1e-6 at s = .79."""
    values = np.array([[5.0, 5.0, 5.0], [-5.0, -5.0, -5.0], [0.1, 0.2, 0.4]])
    c = SimpleNamespace(
        readings=SimpleNamespace(values=values), residual_sd=np.array([0.3, scatter, np.nan])
    )
    assert _has_common_ends(c) is common
    values[0, 0] = values[0, 1] = 4.9
    assert not _has_common_ends(c)


@pytest.mark.parametrize(("scatter", "shows"), [(0.21, True), (0.19, False)])
def test_noise_shows_where_a_step_is_half_of_it(scatter, shows):
    """Steps of .1; the median size of a residual is .6745 sd, of which terms take their part."""
    values = np.round(np.random.default_rng(2).normal(size=(8, 2)), 1)
    left = 1.0 - 6 / 2 / 8
    size = scatter * 0.6745 * math.sqrt(left)
    residuals = size * np.array([[0.2, -1.0]] * 4 + [[1.0, -3.0]] * 4)
    c = SimpleNamespace(
        readings=SimpleNamespace(values=values), parameters=np.zeros(6), residuals=residuals
    )
    assert _shows_noise(c) is shows


# --- gross errors


@pytest.mark.parametrize(
    ("own", "sd", "silent"),
    [(0.019, 0.16, True), (0.021, 0.16, False), (0.019, 0.10, False), (0.019, 0.21, False)],
)
def test_an_output_that_only_scatters_as_the_others_do(own, sd, silent):
    """Below a fiftieth of their response, its scatter above √.019 of theirs and below a fifth."""
    sensitivity = np.array([[1.0, 0.0, 0.0], [0.0, own, 0.0], [0.0, 0.6, 0.8]])
    for unit in (1.0, 40.0, 0.03):
        c = SimpleNamespace(
            sensitivity=unit * sensitivity, residual_sd=unit * np.array([0.9, sd, 0.9]),
            outputs=("a", "b", "c"),
        )  # fmt: skip
        found = _silent(c)
        assert (found is not None and found.outputs == ("b",)) is silent


@pytest.mark.parametrize(
    ("sd", "residual", "slight"), [(0.019, 0.22, True), (0.021, 0.1, False), (0.019, 0.25, False)]
)
def test_residuals_are_slight_below_half_of_a_gross_error(sd, residual, slight):
    """.3 g of .25 V/g times what a leverage of a fifth leaves: .06 of .08 V; here of 1 V/g .24."""
    c = SimpleNamespace(
        estimator=SimpleNamespace(exact=True), robust_weight=None,
        sensitivity=np.array([[0.6, 0.8, 0.0]]), residual_sd=np.array([sd]),
        diagnostics=SimpleNamespace(leverage=np.array([[0.2], [0.1]])),
        residuals=np.array([[residual], [0.0]]),
    )  # fmt: skip
    assert _is_slight(c) is slight
    c.robust_weight = 1
    assert not _is_slight(c)


def test_outputs_of_a_triad_far_from_right_angles():
    unit = np.array([[1.0, 0.0, 0.0], [0.49, math.sqrt(1 - 0.49**2), 0.0], [0.0, 0.0, 1.0]])
    assert not _is_skew(unit)
    unit[1, :2] = 0.51, math.sqrt(1 - 0.51**2)
    assert _is_skew(unit)
    c = SimpleNamespace(
        model=SimpleNamespace(own_scales=(1, 3)), outputs=("a", "b"),
        U=np.array([9.0, 0.3, 9.0, 0.7]), residual_sd=np.array([0.2, 0.3]),
    )  # fmt: skip
    assert_allclose(_known_to(c), [0.3, 0.6])
    c.model.own_scales = (1,)
    assert_allclose(_known_to(c), [0.0, 0.0])


def test_a_misfit_is_gross_by_its_own_limit_or_that_of_orientations():
    for misfit, but_one, sd, gross in (
        (0.39, 0.24, 0.0, False), (0.41, 0.0, 0.0, True), (0.0, 0.26, 0.0, True),
        (0.51, 0.49, 0.21, False), (0.53, 0.0, 0.21, True), (0.0, 0.53, 0.21, True),
    ):  # fmt: skip
        view = SimpleNamespace(misfit=misfit, misfit_but_one=but_one)
        assert gross_errors.is_gross(view, sd) is gross


# --- scales


def test_factors_between_units_are_named():
    assert factor_in_words(9.807) == "9.807 (m/s^2 for g)"
    assert factor_in_words(1 / 9.8) == "0.102 (g for m/s^2)"
    assert factor_in_words(1000.5) == "1000 (a thousandth for the unit)"
    assert factor_in_words(1.3e-3) == "0.0013 (the unit for a thousandth)"
    assert factor_in_words(57.3) == "57.3 (degrees for radians)"
    assert factor_in_words(0.0174) == "0.0174 (radians for degrees)"
    assert factor_in_words(3.7) == "3.7"


def test_a_triad_that_no_turn_gives_is_reversed_or_interchanged():
    def c(facing=None):
        model = SimpleNamespace(axes=("x", "y", "z"))
        return SimpleNamespace(outputs=("a", "b", "c"), model=model, facing=facing)

    own = np.array([[1.0, 0.1, 0.2], [0.1, 2.0, -0.1], [0.1, 0.2, 3.0]])
    signs = np.array([[1.0], [-1.0], [1.0]])
    assert reversed_or_permuted(c(), own) is None
    assert reversed_or_permuted(c(), own[[1, 2, 0]]) is None  # the sensor was turned
    assert reversed_or_permuted(c(), -own) is None  # the other convention
    said = reversed_or_permuted(c(), signs * own)
    assert (said.code, said.outputs) == ("sign", ("b",))
    said = reversed_or_permuted(c(), own[[1, 0, 2]])
    assert (said.code, said.outputs) == ("permuted-outputs", ("a", "b"))
    assert reversed_or_permuted(c(("x", "-y", "z")), signs * own) is None
    said = reversed_or_permuted(c(("x", "-y", "z")), own)
    assert (said.code, said.outputs) == ("sign", ("b",))


# --- terms that are tested


def test_ratios_of_scores_and_where_there_is_such_a_test():
    """R = explained ν/(q rest), ν = left − q; no test on nothing, or where ν is below one."""
    explained, whole = np.array([3.0, 3.0, 3.0, 3.0, np.nan]), 10.0
    q, left = np.array([2.0, 0.0, 4.5, 4.0, 1.0]), 5.0
    ratio, nu, tested = ratios_of(explained, whole, q, left, np.array([0.1]))
    assert tested.tolist() == [True, False, False, True, False]
    assert_allclose(nu, [3.0, 5.0, 0.5, 1.0, 4.0])
    assert_allclose(ratio[[0, 3]], [3.0 * 3.0 / (2.0 * 7.0), 3.0 / (4.0 * 7.0)])
    ratio, _, _ = ratios_of(np.array([9.9]), whole, np.array([2.0]), left, np.array([0.1]))
    assert ratio[0] == pytest.approx(9.9 * 3.0 / (2.0 * 0.3))  # what is left is no less than noise


def test_rows_that_are_left_out_gain_what_a_fit_without_them_does():
    rng = np.random.default_rng(7)
    n, rows = 12, [2, 9]
    X = np.column_stack([np.ones(n), rng.normal(size=(n, 2))])
    y, sd = rng.normal(size=(n, 2)), rng.uniform(0.5, 2.0, (n, 2))
    residuals, gain = np.empty((n, 2)), 0.0
    columns = (np.array([0, 1]), np.array([0, 1, 2]))
    for i, own in enumerate(columns):
        A, b = X[:, own] / sd[:, [i]], y[:, i] / sd[:, i]
        residuals[:, i] = y[:, i] - X[:, own] @ np.linalg.lstsq(A, b, rcond=None)[0]
        kept = [row for row in range(n) if row not in rows]
        part = np.linalg.lstsq(A[kept], b[kept], rcond=None)[0]
        before, after = (residuals[:, i] / sd[:, i]) ** 2, (b[kept] - A[kept] @ part) ** 2
        gain -= (n - len(own)) * math.log(after.sum() / before.sum())
    model = SimpleNamespace(basis=lambda *_: X, columns=columns)
    c = SimpleNamespace(
        model=model, reference=None, readings=SimpleNamespace(environment={}),
        sd_of_readings=sd, residuals=residuals,
    )  # fmt: skip
    assert _gain_without(c, rows) == pytest.approx(gain, rel=1e-9)


def test_further_terms_are_better_where_rows_left_out_are_nearer():
    """By leaving out row by row."""
    rng = np.random.default_rng(3)
    n, B = 10, 40
    X, Z = rng.normal(size=(n, 3)), rng.normal(size=(n, 1))
    Q = np.linalg.qr(X)[0]
    y = rng.normal(size=(n, B)) + Z * rng.normal(size=B)
    e = y - Q @ (Q.T @ y)

    def left_out(design, column):
        total = 0.0
        for i in range(n):
            rest = np.arange(n) != i
            b = np.linalg.lstsq(design[rest], column[rest], rcond=None)[0]
            total += (column[i] - design[i] @ b) ** 2
        return total

    both = np.hstack([X, Z])
    wanted = [left_out(both, column) < left_out(X, column) for column in y.T]
    assert 5 < sum(wanted) < 35
    assert are_better_with([Q], [Z], [e]).tolist() == wanted
    assert not are_better_with([Q], [X[:, :1]], [e]).any()


def test_what_whitens_residuals_and_how_much_they_count():
    rng = np.random.default_rng(9)
    e, root = rng.normal(size=(3, 2)), rng.normal(size=(6, 8))
    own = rng.uniform(0.5, 2.0, 6)
    weight = np.array([1.0, 0.25, 0.64])

    def c(noise, robust):
        return SimpleNamespace(residuals=e, noise=noise, robust_weight=robust, readings=range(3))

    by, counted = _whitener(c(None, None))
    assert_allclose((by, counted), 1.0)
    by, counted = _whitener(c(None, weight))
    assert_allclose(by, np.sqrt(weight)[:, None] * np.ones((3, 2)))
    assert_allclose(counted, weight[:, None] * np.ones((3, 2)))
    by, _ = _whitener(c(own, weight))
    assert_allclose(by, np.sqrt(weight[:, None] / own.reshape(3, 2)))
    V = root @ root.T
    by, _ = _whitener(c(V, weight))
    scale = np.sqrt(np.repeat(weight, 2))
    assert_allclose(by @ V @ by.T, np.outer(scale, scale) * np.eye(6), atol=1e-9)


# --- outputs, units and temperatures


def test_outputs_in_a_unit_of_their_own():
    assert _stands_apart(9.0, lone=True)  # 9.8 within 15 %
    assert not _stands_apart(8.0, lone=True)
    assert _stands_apart(4.1, lone=False)
    assert not _stands_apart(3.9, lone=False)
    assert _stands_apart(0.24, lone=False)
    assert not _stands_apart(0.26, lone=False)
    assert _times(9.5) == "9.5 times, as by a factor 9.807 (m/s^2 for g)"
    assert _times(4.0) == "4 times"


def test_the_size_of_a_field_in_tesla():
    def c(size, unit, own, K):
        field = SimpleNamespace(size=size, size_unit=unit)
        return SimpleNamespace(field=field, model=SimpleNamespace(unit=own), sensitivity=K)

    K = np.array([[2.0, 0.1, 0.0], [0.0, 3.0, 0.2], [0.1, 0.0, -4.0]]) * 10.0
    assert _size_in_tesla(c(48.0, "uT", "count", K)) == pytest.approx(48e-6)
    assert _size_in_tesla(c(48.0, "times", "count", K)) is None
    size = abs(np.linalg.det(K)) ** (1 / 3)
    assert _size_in_tesla(c(None, "", "uT", K)) == pytest.approx(size * 1e-6)
    assert _size_in_tesla(c(None, "", "count", K)) is None
    assert _size_in_tesla(c(None, "", "uT", K[:2])) is None
    for tesla, said in ((19.9e-6, True), (20.1e-6, False), (73.6e-6, False), (73.8e-6, True)):
        assert (field_size(c(tesla * 1e6, "uT", "count", K)) is not None) is said


def test_a_view_of_a_model_of_temperature_keeps_the_response_of_the_day():
    """Columns of temperature about their mean; of temperature times force, less of the force."""
    t = np.linspace(-20.0, 60.0, 14) ** 1.0 + np.cos(np.arange(14.0))
    model = build_model(
        "1 + x + y + z + temperature + temperature*own + temperature*own^2",
        ("a", "b", "c"), ("x", "y", "z"), known=("temperature",),
    )  # fmt: skip
    readings = SimpleNamespace(values=UP @ K.T, environment={"temperature": t})
    c = SimpleNamespace(
        estimator=SimpleNamespace(exact=True), reference=UP, model=model, readings=readings
    )
    view = look(c)
    assert_allclose(view.even, np.column_stack([np.ones(14), t - t.mean()]))
    columns = [t * x - (t * x) @ x / (x @ x) * x for x in UP.T]
    assert_allclose(view.odd, np.column_stack([UP, *columns]), atol=1e-12)


@pytest.mark.parametrize(
    ("axes", "rank", "forced", "triad"),
    [("xyz", 3, False, True), ("zxy", 3, False, True), ("xyy", 3, False, False),
     ("xyz", 2, False, False), ("xyz", 3, True, False)],
)  # fmt: skip
def test_three_outputs_that_sense_a_rotation(axes, rank, forced, triad):
    slopes = np.diag([1.0, 2.0, 3.0])
    if rank == 2:
        slopes[2] = slopes[0] + slopes[1]
    at = []
    model = SimpleNamespace(
        axes=tuple(axes), has_terms=True,
        linear_part=lambda b, mean: at.append((b, mean)) or np.column_stack([np.ones(3), slopes]),
    )  # fmt: skip
    c = SimpleNamespace(
        model=model, parameters="b", mean_environment="mean",
        readings=SimpleNamespace(forced=np.array([False, forced])),
        estimator=SimpleNamespace(exact=True), robust_weight=None,
    )  # fmt: skip
    assert _separable(c) is triad
    assert all(each == ("b", "mean") for each in at)


def test_unequal_noise_of_outputs_is_seen_in_their_residuals(monkeypatch):
    """Scores ½ (e'e/common − tr P) of each against ½ P∘P, in one dense P."""
    rng = np.random.default_rng(4)
    n = 30
    e, V = rng.normal(size=(n, 3)) * [1.0, 1.0, 2.0], rng.uniform(0.5, 2.0, (n, 3))
    A, W = rng.normal(size=(n, 3, 5)), np.zeros((n, 3, n, 3))
    W[np.arange(n), :, np.arange(n)] = np.eye(3) / V[:, None] - 0.05
    WA = W.reshape(3 * n, -1) @ A.reshape(3 * n, 5)
    S = A.reshape(3 * n, 5).T @ WA
    P = (W.reshape(3 * n, -1) - WA @ np.linalg.solve(S, WA.T)).reshape(n, 3, n, 3)
    optimum = SimpleNamespace(
        weighted=lambda: (
            W[np.arange(n), :, np.arange(n)].transpose(1, 2, 0),
            WA.reshape(n, 3, 5).transpose(1, 2, 0),
        ),
        information=S, point=SimpleNamespace(residuals=e),
    )  # fmt: skip
    problem = SimpleNamespace(precision=1.0 / V, degrees=np.full(n, 3.0), unknowns=12)
    monkeypatch.setattr(residuals, "information_at_solution", lambda c: (problem, optimum))
    c = SimpleNamespace(readings=SimpleNamespace(values=e), residuals=e, outputs="abc")
    p, sizes = residuals.judge_equality(c)
    rows, root = np.arange(n), np.sqrt(V)
    P *= root[:, :, None, None] * root
    traces = np.sum(np.diagonal(P[rows, :, rows], axis1=1, axis2=2), axis=0)
    squares = np.sum(e**2 / V, axis=0)
    common = squares.sum() / traces.sum()
    U = 0.5 * (squares / common - traces)
    solved = np.linalg.solve(0.5 * np.einsum("kilj,kilj->ij", P, P), U)
    assert p == pytest.approx(chi2.sf(U @ solved, 2), rel=1e-6)
    assert_allclose(sizes, np.sqrt(V.mean(axis=0) * common * np.maximum(1.0 + solved, 0.05)))


def test_what_outliers_and_repeats_explain_of_residuals(monkeypatch):
    """ν ln of the sums of squares before and after, less ln ν a number and twice ln of choices."""
    found = SimpleNamespace(rows=range(3), dof=24.0, ratio=2.5)
    monkeypatch.setattr(examination, "outlying_rows", lambda c: found)
    c = SimpleNamespace(
        estimator=SimpleNamespace(exact=False), residuals=np.zeros((40, 3)),
        outputs="abc", diagnostics=SimpleNamespace(lack_of_fit={}),
    )  # fmt: skip
    outlier = SimpleNamespace(code="outlier", rows=())
    before, after = 27.0 * 2.5**2, 24.0  # of one residual sd, of 27 and of 24 degrees of freedom
    gain = 27.0 * math.log(before / after) - 3 * math.log(27.0) - 2 * math.log(math.comb(40, 3))
    assert examination._score(c, outlier, 27.0, None) == pytest.approx(gain)
    tests = {"a": {"F": 4.0, "dof": (3, 9)}, "b": {"F": 2.0, "dof": (2, 5)}}
    c.diagnostics.lack_of_fit = tests
    gain = 12 * math.log(1 + 3 * 4 / 9) + 7 * math.log(1 + 2 * 2 / 5) - 5 * math.log(27.0)
    found = examination._score(c, SimpleNamespace(code="lack-of-fit"), 27.0, None)
    assert found == pytest.approx(gain)


def test_limits_and_scores_of_rows_in_time(monkeypatch):
    """Λ at the F of a hundredth over so many steps; S less ln ν for one number more."""
    f = fisher.ppf(1.0 - 0.01 / 12, 3.0, 17.0)
    assert _limit(3.0, 20.0, 12) == pytest.approx(20.0 * math.log1p(3.0 * f / 17.0), rel=1e-6)
    assert _limit(3.0, 3.9, 12) == math.inf
    assert _limit(0.5, 20.0, 12) == math.inf
    plan = SimpleNamespace(slow=(1.0, 1.0, 1.0), order=np.array([1, 0]), freedom=20.0)
    monkeypatch.setattr(
        row_order, "residuals_in_order", lambda c: (plan, np.array([[3.0], [5.0]]), None)
    )
    monkeypatch.setattr(row_order, "_slow_gains", lambda plan, e: 7.0 + e[0, :, 0])
    assert row_order.slow_score(None) == pytest.approx(12.0 - math.log(20.0))
    plan.slow = None
    assert row_order.slow_score(None) == math.inf


@pytest.mark.parametrize("beside", [False, True])
def test_the_gain_of_correlated_rows_by_dense_covariances(beside):
    """Restricted likelihoods of two outputs over ρ, less that of independent rows, twice."""
    rng = np.random.default_rng(6)
    n, nu = 16, 13.0
    X = np.column_stack([np.ones(n), rng.normal(size=(n, 2))])
    Q = np.linalg.qr(X)[0]
    e = np.cumsum(rng.normal(size=(n, 2, 3)), axis=0)
    e -= np.einsum("np,pmb->nmb", Q, np.einsum("np,nmb->pmb", Q, e))
    across = rng.normal(size=(n, n + 2)) if beside else None
    plan = SimpleNamespace(groups=[(np.array([0, 1]), Q)], across=across, nu=nu)
    wanted = np.zeros(3)
    for rho in row_order._CORRELATIONS:
        V = rho ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
        V = V * (across @ across.T) if beside else V
        W = np.linalg.inv(V)
        P = W - W @ Q @ np.linalg.solve(Q.T @ W @ Q, Q.T @ W)
        det = np.linalg.slogdet(V)[1] + np.linalg.slogdet(Q.T @ W @ Q)[1]
        square = np.einsum("nmb,nk,kmb->mb", e, P, e) / np.einsum("nmb,nmb->mb", e, e)
        wanted = np.maximum(wanted, -nu * np.log(square).sum(axis=0) - 2.0 * det)
    assert_allclose(row_order._slow_gains(plan, e), wanted, rtol=1e-8)


# --- causes by the order of rows


def test_steps_of_a_change_are_judged_by_their_ratio_to_chance(monkeypatch):
    """Apart by Fisher's sum over F of each output, together by one F; S of eq. (3)."""
    # eq. (3) of diagnostics.row_order
    place, ranks = np.array([1, 0, 1]), np.array([2.0, 3.0])
    explained = np.array([[0.7, 0.6, 0.1], [0.5, 0.8, 0.05]])
    gain = np.array([40.0, 50.0, 3.0])
    plan = SimpleNamespace(nu=17.0, freedom=31.0, codes=4)
    test = SimpleNamespace(ranks=ranks, tried=6, family=SimpleNamespace(apart=True))
    at, p, score = row_order._judge(plan, test, np.zeros((9, 2, 3)), None, place, explained, gain)
    for k, q in enumerate(ranks[place]):
        delta = explained[:, k]
        tails = fisher.sf(delta / (1.0 - delta) * (17.0 - q) / q, q, 17.0 - q)
        wanted = min(1.0, 24.0 * chi2.sf(-2.0 * np.log(tails).sum(), 4))
        assert p[k] == pytest.approx(wanted, rel=1e-6)
        S = gain[k] - 2.0 * q * math.log(31.0) - 2.0 * math.log(6.0)
        assert score[k] == (pytest.approx(S) if wanted < 0.01 else -math.inf)
    assert np.isinf(score).tolist() == [False, False, True]
    test.family.apart = False
    refined = np.array([0, 1, 1]), gain + 0.3
    monkeypatch.setattr(row_order, "_refined", lambda *_: refined)
    at, p, score = row_order._judge(plan, test, np.zeros((9, 2, 3)), None, place, None, gain)
    assert at.tolist() == [0, 1, 1]
    for k, q in enumerate(ranks[place]):
        ratio = (math.exp(gain[k] / 31.0) - 1.0) * (31.0 - q) / q
        wanted = min(1.0, 24.0 * fisher.sf(ratio, q, 31.0 - q))
        assert p[k] == pytest.approx(wanted, rel=1e-6)
        S = gain[k] + 0.3 - q * math.log(31.0) - 2.0 * math.log(6.0)
        assert score[k] == (pytest.approx(S) if wanted < 0.01 else -math.inf)


def test_a_step_is_refined_among_its_neighbours(monkeypatch):
    """The largest Λ of three; what is no number, of readings beyond all, is least."""
    gains = np.array(
        [[3.0, np.nan, 1.0, np.nan], [4.0, 5.0, np.nan, np.nan], [2.0, 9.0, 0.5, np.nan]]
    )
    asked = []
    monkeypatch.setattr(
        row_order, "fit_sizes", lambda bases, Z, e: asked.append(Z) or (None, gains.ravel())
    )
    steps = np.array([2, 3, 5, 6])
    family = SimpleNamespace(base=np.ones((9, 1, 1)), steps=steps)
    test = SimpleNamespace(family=family, limits=steps)
    plan = SimpleNamespace(weight=np.ones((1, 2)), bases=())
    place, gain = row_order._refined(
        plan, test, np.zeros((9, 2, 4)), np.zeros((4, 2, 3)), np.array([1, 0, 3, 2])
    )
    assert place[:3].tolist() == [0, 1, 3]  # before it, behind it, as it was
    assert gain.tolist() == [4.0, 9.0, 1.0, -math.inf]
    first = (asked[0][:, :, 0, 0] == 0.0).sum(axis=1)
    assert first.tolist() == steps[[1, 0, 3, 2, 0, 0, 2, 1, 2, 1, 3, 3]].tolist()


@pytest.mark.parametrize("apart", [True, False])
def test_the_step_of_a_change_is_where_most_is_left_above_its_limit(apart):
    rng = np.random.default_rng(8)
    limits, m, nu, count = np.array([3.0, 1.0, 4.0, 0.5]), 3, 11.0, 40
    shares = rng.uniform(0.1, 0.5, (4, m if apart else 1, count))
    roots = np.sqrt(shares / 2.0)  # of two columns each
    parts = [
        SimpleNamespace(outputs=np.array(mine), matrix=None, seen=lambda e, mine=mine: np.stack(
            [roots[:, mine[int(e.flat[0])]] if apart else roots[:, 0]] * 2, axis=1))
        for mine in (([0, 2], [1]) if apart else ([0, 1, 2],))
    ]  # fmt: skip
    # what a part sees names which of its outputs it is asked of
    e = np.zeros((5, m, count))
    e[:, 2] = 1.0
    test = SimpleNamespace(limits=limits, family=SimpleNamespace(apart=apart), parts=parts)
    place, gain, there = row_order._best_steps(test, e, np.zeros((3, 5, count)), nu)
    whole = shares if apart else np.repeat(shares / m, m, axis=1)
    Lambda = -nu * np.log(1.0 - whole).sum(axis=1)
    best = np.argmax(Lambda - limits[:, None], axis=0)
    assert len(set(best.tolist())) > 2
    assert place.tolist() == best.tolist()
    units = np.arange(count)
    assert_allclose(gain, Lambda[best, units])
    assert_allclose(there, whole[best, :, units].T)


class Rows(SimpleNamespace):
    def __len__(self):
        return len(self.values)


def test_slopes_of_a_plan_are_rounded_and_weighed_by_powers_of_two():
    """To a twentieth of each response; of responses over sd relative to their mean."""
    S = np.array([[1.0, 0.13, -0.06], [0.2, 7.0, 0.0], [0.01, 0.0, 2.1]])
    sd, noise = np.array([0.02, 0.05, 0.003]), np.tile([4e-4, 25e-4, 9e-6], 5)
    c = SimpleNamespace(
        noise=None, sensitivity=S, residual_sd=sd, readings=range(5), residuals=np.zeros((5, 3))
    )
    own = np.linalg.norm(S, axis=1)
    ratio = own / sd / np.mean(own / sd)
    weight = 2.0 ** np.round(np.log2(ratio))
    assert weight.tolist() == [0.125, 0.5, 2.0]
    wanted = np.round(S / own[:, None] * 20.0) / 20.0 * weight[:, None]
    found = row_order._Setting(c)
    assert_allclose(found.slopes, wanted, atol=1e-12)
    assert found.weight is None
    c.noise = noise  # the same in all rows
    assert row_order._Setting(c).weight is None
    c.noise = noise * np.repeat([1.0, 1.3, 1.0, 0.7, 1.0], 3)
    assert_allclose(row_order._Setting(c).weight, 1.0 / np.sqrt(c.noise).reshape(5, 3))


# --- terms that a model lacks


def linear(u=None, seed=3):
    values = readings(seed, sd=0.004) + 0.05 * np.sin(np.arange(42.0)).reshape(14, 3)
    return mp.fit(mp.Readings(values, up=UP, unit="g", u=u), **EXACT)


@pytest.mark.parametrize("name", ["own^2", "own*other"])
def test_the_size_of_a_tested_term_is_that_of_a_fit_with_it(name):
    c = linear()
    (kind,) = [kind for kind in projections.lacking(c) if kind.name == name]
    response = np.array([2.0, 1.5, 0.7])
    found, wanted = projections._tested(c, kind, response), []
    for i in range(3):
        others = [k for k in range(3) if k != i]
        Z = UP[:, [i]] ** 2 if name == "own^2" else UP[:, [i]] * UP[:, others]
        X = np.column_stack([np.ones(14), UP, Z])
        b, rss = np.linalg.lstsq(X, c.readings.values[:, i], rcond=None)[:2]
        C = np.linalg.inv(X.T @ X) * rss / (14 - X.shape[1])
        wanted += ((b[4:] ** 2 + np.diag(C)[4:]) / response[i] ** 2).tolist()
    assert_allclose(found, wanted, rtol=1e-9)


@pytest.mark.parametrize("stated", [False, True])
def test_sums_of_scores_at_known_positions_by_dense_matrices(stated):
    """Z'MZ and Z'Me of terms in one output, away from the solution, weighed."""
    u = np.random.default_rng(1).uniform(0.5, 2.0, (14, 3)) if stated else None
    c = linear(u)
    c = replace(c, parameters=c.parameters + 0.01 * np.arange(1.0, 13.0))
    kinds = tuple(k for k in projections.lacking(c) if k.name in ("own^2", "own*other"))
    found = score_tests._sums_at_known(c, kinds)
    Z, output_of, kind_of = projections.terms_of(kinds, c.reference, {})
    X = np.column_stack([np.ones(14), UP])
    R = len(Z)
    gram, score, size, whole = np.zeros((R, R)), np.zeros(R), np.zeros(R), 0.0
    for i in range(3):
        variances = c.noise.reshape(14, 3)[:, i] if stated else np.full(14, c.residual_sd[i] ** 2)
        W = np.diag(1.0 / variances)
        M = W - W @ X @ np.linalg.inv(X.T @ W @ X) @ X.T @ W
        e = c.readings.values[:, i] - X @ c.parameters.reshape(3, 4)[i]
        mine = np.flatnonzero(output_of == i)
        gram[np.ix_(mine, mine)] = Z[mine] @ M @ Z[mine].T
        score[mine], size[mine] = Z[mine] @ M @ e, np.diag(Z[mine] @ W @ Z[mine].T)
        whole += e @ W @ e
        own = np.arange(4) + 4 * i
        assert_allclose(found.information[np.ix_(own, own)], X.T @ W @ X, rtol=1e-9, atol=1e-9)
    assert_allclose(found.gram, gram, rtol=1e-8, atol=1e-8 * gram.max())
    assert_allclose(found.score, score, rtol=1e-8, atol=1e-8 * np.abs(score).max())
    assert_allclose(found.size, size)
    assert (found.whole, found.left) == (pytest.approx(whole), 42.0 - 12.0)
    assert found.kind_of.tolist() == kind_of.tolist()


def test_the_score_of_the_best_of_significant_terms(monkeypatch):
    """Its gain and two a column, less ln N a column and twice ln of the tests."""
    best = SimpleNamespace(gain=31.0, dofs=((2.0, 9.0), (1.0, 8.0), (2.0, 9.0)))
    monkeypatch.setattr(score_tests, "significant", lambda tests: (best,))
    c = SimpleNamespace(
        estimator=Estimator.LINEAR, residuals=np.zeros((9, 3)), parameters=np.zeros(6)
    )
    tests = (best,) * 7
    S = 31.0 + 5.0 * (2.0 - math.log(21.0)) - 2.0 * math.log(7.0)
    assert score_tests.score_of_term(c, tests) == pytest.approx(S)
    c.estimator = Estimator.UNKNOWN
    S = 31.0 + 5.0 * (2.0 - math.log(3.0)) - 2.0 * math.log(7.0)
    assert score_tests.score_of_term(c, tests) == pytest.approx(S)


# --- orientation errors


# --- outputs that do not respond


@pytest.mark.parametrize(
    ("axes", "own", "lost", "silent"),
    [("xyz", 0.74, False, True), ("xyz", 0.76, False, False), ("xyz", 0.76, True, True),
     ("xx", 0.19, False, True), ("xx", 0.21, False, False)],
)  # fmt: skip
def test_outputs_that_do_not_respond_to_their_own_axis(axes, own, lost, silent, monkeypatch):
    """Of a triad that is skew by 41°, of others below a fifth, or as well as the scale is known."""
    sensitivity = np.eye(3)[: len(axes)] * 2.0
    sensitivity[1] = 2.0 * np.array([math.sqrt(1 - own**2), -own, 0.0])
    monkeypatch.setattr(gross_errors, "expected_directions", lambda c: np.eye(3)[: len(axes)])
    monkeypatch.setattr(
        gross_errors,
        "_known_to",
        lambda c: np.where(np.arange(len(axes)) == 1, 2.01 if lost else 1.99, 0),
    )
    monkeypatch.setattr(gross_errors, "is_triad", lambda c: len(axes) == 3)
    c = SimpleNamespace(outputs="abc"[: len(axes)], model=SimpleNamespace(axes=tuple(axes)))
    found = gross_errors._no_response(c, sensitivity)
    assert (found is not None) is silent
    if silent:
        assert found.outputs == ("b",)
        assert found.text.endswith(f"listed for them: b to {axes[1]}")


def test_outputs_in_a_unit_of_their_own_are_named(monkeypatch):
    monkeypatch.setattr(scales, "is_triad", lambda c: True)
    c = SimpleNamespace(outputs=("a", "b", "c"), model=SimpleNamespace(unit="count"))
    found = scales.output_unit(c, np.diag([20.0, 21.0, 206.0]))
    assert found.outputs == ("c",)
    assert "c 9.81 times, as by a factor 9.807 (m/s^2 for g)" in found.text
    assert scales.output_unit(c, np.diag([20.0, 21.0, 30.0])) is None
    assert scales.output_unit(c, np.diag([20.0, 21.0, 0.0])) is None
    assert scales.output_unit(c, np.diag([20.0, 206.0, 1.0])[:1]) is None


# --- what competes, and what is tried


@pytest.mark.parametrize(
    ("codes", "scores", "best", "kept"),
    [
        (["outlier", "placement"], [3.0, 5.1], ("drift", 5.0), ["other", "placement"]),
        (["outlier", "placement"], [3.0, 4.9], ("drift", 5.0), ["other", "drift"]),
        (["outlier", "placement"], [5.2, 5.1], ("drift", 9.0), ["other", "drift"]),
        (["outlier", "time-correlated"], [3.0, 5.1], ("time-correlated", 9.0),
         ["other", "time-correlated"]),
        ([], [], ("drift", -3.0), ["other", "drift"]),
    ],
)  # fmt: skip
def test_one_of_the_causes_of_residuals_is_named(codes, scores, best, kept, monkeypatch):
    """That of the largest S; ν is that of all readings, or one a row where nothing is known."""
    causes = [SimpleNamespace(code="slipped", score=best[1] - 1.0),
              SimpleNamespace(code=best[0], score=best[1])]  # fmt: skip
    found = [SimpleNamespace(code=code, level="note") for code in ["other", *codes]]
    freedom = []

    def score(c, finding, nu, residuals):
        freedom.append(nu)
        return dict(zip(codes, scores, strict=True))[finding.code]

    monkeypatch.setattr(examination.row_order, "asked", lambda c: True)
    monkeypatch.setattr(examination.row_order, "search", lambda c: causes)
    monkeypatch.setattr(examination, "_score", score)
    monkeypatch.setattr(examination, "_describe", lambda c, cause: cause)
    c = SimpleNamespace(
        residuals=np.zeros((9, 3)), parameters=np.zeros(4), estimator=Estimator.LINEAR
    )
    assert [each.code for each in examination.compete(c, found, None)] == kept
    c.estimator = Estimator.UNKNOWN
    examination.compete(c, found, None)
    assert freedom == [23.0] * len(codes) + [5.0] * len(codes)
    for code, level in (("zero-per-soak", "note"), ("other", "error")):
        wrong = [*found, SimpleNamespace(code=code, level=level)]
        assert examination.compete(c, wrong, None) is wrong
    causes.clear()
    assert examination.compete(c, found, None) is found


@pytest.mark.parametrize("added", [(), ("own*other",)])
def test_rows_of_a_projection_span_what_a_fit_leaves_of_terms(added):
    """Of each kind and output by a dense projector, terms that are taken as fitted in it."""
    c = linear()
    kinds = projections.lacking(c)
    found = projections.project(projections.Setting(c, kinds, added))
    X = np.column_stack([np.ones(14), UP])
    ends = [*found.starts.tolist(), len(found.rows)]
    blocks = {int(place): slice(*ends[k : k + 2]) for k, place in enumerate(found.place)}
    assert set(found.names) == {kind.name for kind in kinds}
    for k, kind in enumerate(kinds):
        for i in range(3):
            others = [UP[:, i] * UP[:, j] for j in range(3) if j != i]
            design = np.column_stack([X, *others]) if added else X
            assert found.left[i] == 14 - design.shape[1]
            Z = projections.values_of([kind], UP, {})[0][:, i]
            Z = Z[:, np.abs(Z).max(axis=0) > 0.0]
            left = Z - design @ np.linalg.lstsq(design, Z, rcond=None)[0]
            rank = 0 if kind.name in added else np.linalg.matrix_rank(left, tol=1e-6)
            assert found.q[k, i] == rank
            if rank:
                rows = found.rows[blocks[k * 3 + i]]
                assert (found.output[blocks[k * 3 + i]] == i).all()
                U = np.linalg.svd(left)[0][:, :rank]
                assert_allclose(rows.T @ rows, U @ U.T, atol=1e-9)


@pytest.mark.parametrize("added", [(), ("own^2",)])
def test_terms_are_tested_alike_by_rows_and_by_sums(added):
    """Stated noise, all outputs as one: the projection that is kept, and sums about the fit."""
    c = linear(np.random.default_rng(1).uniform(0.02, 0.08, (14, 3)))
    kinds = projections.lacking(c)
    rows, sums = (ask(c, kinds, added) for ask in (score_tests._at_known, score_tests._as_one))
    assert [test.term for test in sums.tests] == [test.term for test in rows.tests]
    assert len(rows.tests) > 2
    for one, other in zip(rows.tests, sums.tests, strict=True):
        assert_allclose(other.ratios, one.ratios, rtol=1e-6)
        assert_allclose(other.dofs, one.dofs)
    assert rows.hidden == sums.hidden


def test_terms_that_would_fit_as_well_are_named(monkeypatch):
    """Within 6.6 of the best; what no sensor has is left out."""
    tests = [
        SimpleNamespace(term=term, gain=gain, p=1e-5, outputs=(), ratios=(), dofs=())
        for term, gain in (("bad", 50.0), ("a", 40.0), ("b", 33.5), ("c", 33.3), ("d", 39.0))
    ]
    monkeypatch.setattr(model_error, "significant", lambda found: tuple(tests))
    monkeypatch.setattr(model_error, "_is_admissible", lambda c, named: named != ("bad",))
    monkeypatch.setattr(model_error, "_named", lambda c, best: (best[0].term, "d"))
    monkeypatch.setattr(model_error, "_way_out", lambda c, named: "Fit.")
    monkeypatch.setattr(model_error, "_showing", lambda first: ())
    c = SimpleNamespace(diagnostics=SimpleNamespace(model_tests=()))
    said = model_error.missing_term(c)
    assert said.text.startswith("the model lacks a and d, which")
    assert "; b would fit as well)" in said.text
    del tests[1:]
    assert model_error.missing_term(c) is None


@pytest.mark.parametrize("slight", [True, False])
def test_repairs_that_are_tried(slight, monkeypatch):
    """Rows that fit worst, sixty at the most; of slight misfits only what may be so slight."""
    asked = {}

    def pairs(name, count):
        return lambda view, rows: asked.update({name: rows}) or ([name], count)

    for name, count in (("_interchanges", 100), ("_single_rows", 23)):
        monkeypatch.setattr(repairs, name, pairs(name, count))
    for name in ("_other_order", "_many_factors", "_wrapped", "_radians"):
        monkeypatch.setattr(repairs, name, lambda view, name=name: [name, name])
    monkeypatch.setattr(repairs, "_many_flips", lambda view, guess: [guess])
    residual = np.random.default_rng(4).normal(size=(70, 2))
    response = np.array([3.0, 0.2])
    view = SimpleNamespace(values=residual, residuals=residual, response=response)
    found, tried = repairs.candidates(view, "guess", slight=slight)
    size = np.sum((residual / response) ** 2, axis=1)
    rows = np.sort(np.argsort(size)[10:])
    assert asked["_interchanges"].tolist() == rows.tolist()
    if slight:
        assert found == ["_interchanges", "_radians", "_radians"]
        assert tried == 100 + (len(repairs.FACTORS) + 1) * 60
    else:
        assert found[:2] == ["_interchanges", "_single_rows"]
        assert (len(found), tried, found[4]) == (11, 100 + 23 + 9, "guess")
        assert asked["_single_rows"].tolist() == rows.tolist()


@pytest.mark.parametrize(
    ("share", "sd", "gross", "named"),
    [((0.05, 0.1, 0.9), 0.05, True, ("c",)), ((0.7, 0.8, 0.9), 0.05, True, ()),
     ((0.05, 0.1, 0.9), 0.03, True, None), ((0.05, 0.1, 0.9), 0.05, False, None)],
)  # fmt: skip
def test_residuals_as_large_as_the_signal(share, sd, gross, named, monkeypatch):
    """Beyond a fiftieth of the response, 2 here; outputs whose misfit is gross are named."""
    monkeypatch.setattr(gross_errors, "is_gross", lambda view, sd: gross)
    response = np.array([2.0, 0.5, 3.0])
    view = SimpleNamespace(
        residuals=np.array([[0.6], [-0.8]]) * share * response * math.sqrt(7.0),
        dof=7.0, response=response,
    )  # fmt: skip
    c = SimpleNamespace(
        residual_sd=np.array([0.01, sd, 0.01]),
        sensitivity=np.eye(3) * 2.0,
        outputs=("a", "b", "c"),
        readings=SimpleNamespace(orientation_sd=None),
    )  # fmt: skip
    found = gross_errors._no_signal(c, view)
    assert (found.outputs if found else None) == named
    if found:
        assert "are 90 % of one g" in found.text


def test_terms_beyond_the_linear_ones_that_are_large():
    """A fifth of the response of their output, 2 here."""

    def c(value, degree=2):
        keys = (("a", SimpleNamespace(force_degree=1)), ("b", SimpleNamespace(force_degree=degree)))
        model = SimpleNamespace(has_all_linear=True, keys=keys)
        return SimpleNamespace(model=model, parameters=np.array([9.0, value]))

    sizes = {"a": 30.0, "b": 2.0}
    assert gross_errors._bends(c(-0.41), sizes)
    assert not gross_errors._bends(c(-0.39), sizes)
    assert not gross_errors._bends(c(-0.41, 1), sizes)


def test_rows_in_another_unit_are_nearer_divided_by_outputs_of_any_size():
    """Σ ((y − ŷ)/|K|)² of each row as it is and divided, ŷ of a fit by least squares."""
    rng = np.random.default_rng(9)
    up = mp.read_scheme("fibonacci-24").up
    values = up[:, :2] * [1.0, 40.0] + [0.3, -9.0] + [0.2, 4.0] * rng.standard_normal((24, 2))
    view = repairs.View(np.ones((24, 1)), up, values)
    rows = np.array([2, 5])
    for factor in (1.2, 9.80665):
        trial = values.copy()
        trial[rows] /= factor
        X = np.column_stack([np.ones(24), up])
        fitted = np.linalg.lstsq(X, trial, rcond=None)[0]
        size = np.linalg.norm(fitted[1:], axis=0)
        as_is, divided = (
            (((y - X @ fitted) / size) ** 2).sum(axis=1) for y in (values, values / factor)
        )
        found = repairs._too_large(view, rows, factor)
        assert found.tolist() == (divided < as_is).tolist()
        assert 0 < found.sum() < 24
