"""Numbers of checks and comparisons by hand or by a second route, at points without symmetry."""

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from known_noise import with_known_noise
from numpy.testing import assert_allclose
from scipy.stats import chi2, linregress, norm, t
from scipy.stats import f as fisher

import multipos as mp
from multipos.results import Frozen
from multipos.sensor.model import build_model
from multipos.sensor.nominal import Nominal
from multipos.sensor.tilt import ZerosOfForce
from multipos.verification import (
    agreement,
    checks,
    consistency,
    error_columns,
    recalibration,
    regression_checks,
    regression_repeats,
    verdicts,
)
from multipos.verification.agreement import _orientation_error, _taken, no_agreement
from multipos.verification.checks import RunNoise, force_errors, run_noise, tilt_errors
from multipos.verification.coefficients import ratios_to_k1
from multipos.verification.comparison_text import change_rows
from multipos.verification.consistency import _by_days, _quadratic, _scatter, is_apart
from multipos.verification.recalibration import Change, Rate, _clock, _in_unit
from multipos.verification.regression_checks import _family_factor
from multipos.verification.regression_repeats import compare_regressions
from multipos.verification.verdicts import Check

RNG = np.random.default_rng(12)


def definite(n, seed):
    A = np.random.default_rng(seed).normal(size=(n, n + 2))
    return A @ A.T


# --- repeats


def test_the_sum_of_squares_of_repeats_is_that_of_least_squares():
    values = RNG.normal(size=(3, 2)) * [1.0, 1e-5]
    scale = np.outer([1.0, 1e-5], [1.0, 1e-5])
    covariances = np.array([definite(2, seed) * scale for seed in range(3)])
    roots = [np.linalg.inv(np.linalg.cholesky(C)) for C in covariances]
    rows, right = (
        np.vstack(roots),
        np.concatenate([W @ x for W, x in zip(roots, values, strict=True)]),
    )
    left = right - rows @ np.linalg.solve(rows.T @ rows, rows.T @ right)
    assert _quadratic(values, covariances)[0] == pytest.approx(left @ left, rel=1e-8)


def test_days_that_differ_by_their_level_are_judged_as_one_covariance_of_all_repeats():
    """Two repeats of one day and one of another: L is between those of a day as well."""
    values, day = np.random.default_rng(11).normal(size=(3, 2)), np.array([0, 0, 1])
    covariances, L = np.array([definite(2, seed) for seed in range(3)]), definite(2, 7)
    V = np.kron(day[:, None] == day, L)
    for r in range(3):
        V[2 * r : 2 * r + 2, 2 * r : 2 * r + 2] += covariances[r]
    W = np.linalg.inv(np.linalg.cholesky(V))
    rows, right = W @ np.tile(np.eye(2), (3, 1)), W @ values.ravel()
    left = right - rows @ np.linalg.solve(rows.T @ rows, rows.T @ right)
    found = _by_days(values, covariances, np.array([L] * 3), day)
    assert found == pytest.approx(left @ left, rel=1e-8)


@pytest.mark.parametrize(
    ("weighed", "dof", "across", "apart"),
    [
        (False, (17.0, 18.0), 1e-10, True),
        (False, (17.0, 18.0), 1e-8, False),
        (False, (35.0, 35.0), 0.0, False),
        (False, (math.inf, 18.0), 0.0, True),
        (True, (9.0, 8.0), 0.0, True),
        (True, (9.0, 9.0), 0.0, False),
        (True, (math.inf, math.inf), 0.0, True),
    ],
)
def test_outputs_are_apart_that_have_their_own_scatter(weighed, dof, across, apart):
    """Twenty readings less three and two terms; variances of 4 and 9, correlated by so much."""
    model = SimpleNamespace(terms=(("1", "x", "y"), ("1", "y")))
    c = SimpleNamespace(readings=range(20), model=model, weighed=weighed, dof=np.array(dof))
    C = np.array([[4.0, 3.9, 6.0 * across], [3.9, 4.0, 0.0], [6.0 * across, 0.0, 9.0]])
    assert is_apart(c, C, np.array([0, 0, 1])) is apart
    if not across:
        single = SimpleNamespace(**{**vars(c), "dof": np.array(dof[:1])})
        single.model = SimpleNamespace(terms=model.terms[:1])
        assert is_apart(single, C[:2, :2], np.array([0, 0])) is (dof[0] != 35.0)


def test_the_scatter_of_an_output_by_hand():
    left, V = RNG.normal(size=(4, 2)), definite(8, 5)
    c = SimpleNamespace(
        readings=SimpleNamespace(values=left), noise=None, weighed=False, residuals=left,
        dof=np.array([3.0, 2.5]), sd_of_readings=np.abs(left),
    )  # fmt: skip
    own = left[:, 1]
    assert _scatter(c, [1]) == pytest.approx(np.sum(own**2) / 2.5)
    c.noise = np.diag(V)
    assert _scatter(c, [1]) == pytest.approx(np.sum(own**2 / np.diag(V)[1::2]) / 2.5)
    c.noise = V
    assert _scatter(c, [1]) == pytest.approx(own @ np.linalg.inv(V[1::2, 1::2]) @ own / 2.5)
    assert _scatter(c, [0, 1]) == pytest.approx(left.ravel() @ np.linalg.inv(V) @ left.ravel() / 3)
    c.weighed = True
    assert _scatter(c, [1]) == pytest.approx(np.mean(own**2))
    c.weighed, c.dof = False, np.array([3.0, 0.0])
    assert math.isnan(_scatter(c, [1]))


@dataclass
class Part:
    quantity: str
    axes: tuple
    reference: np.ndarray
    before: np.ndarray
    after: np.ndarray
    u: np.ndarray
    U: np.ndarray
    U_family: np.ndarray
    verdicts: np.ndarray
    counted: np.ndarray
    linearity_percent: dict
    findings: tuple
    segments: dict


# --- a run that is checked


def test_errors_of_force_and_their_u_by_the_inverse_of_the_matrix(monkeypatch):
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
    # zeros of soaks: what the noise has of them already goes, before theirs comes
    part = np.broadcast_to(1e-6 * np.eye(3), (5, 3, 3))
    monkeypatch.setattr(
        checks, "zeros_of_force", lambda *_: ZerosOfForce(4 * part, 16 * part, part)
    )
    *_, more, U_more = force_errors(cal, data, known, nominal, noise)
    assert_allclose(more**2, u**2 + 3e-6, rtol=1e-9)
    assert_allclose(U_more**2, (U / u) ** 2 * (u**2 - 1e-6) + 16e-6, rtol=1e-9)


def test_noise_of_a_run_that_is_stated_or_not():
    values = np.zeros((2, 2))
    parts = {"ax": SimpleNamespace(value=0.3), "ay": SimpleNamespace(value=0.4)}
    c = SimpleNamespace(outputs=("ax", "ay"), variance_components=None)
    data = SimpleNamespace(values=values, u=np.array([[0.4, 0.3], [1.6, 1.2]]))
    assert run_noise(c, data, None).whole is data.u
    c.variance_components = SimpleNamespace(rest_to_rest=parts)
    whole, estimated = run_noise(c, data, None)
    assert_allclose(whole, np.hypot(data.u, [0.3, 0.4]))
    assert_allclose(estimated, [[0.3, 0.4]] * 2)
    assert_allclose(run_noise(c, data, [0.1, 0.2]).whole, [[0.1, 0.2]] * 2)


def test_what_placement_and_reference_add_to_a_run():
    """Of a turn about every axis the cross product with what is known, and its square."""
    known, u = RNG.normal(size=(3, 3)), RNG.uniform(0.1, 0.2, (3, 3))
    sd = np.array([0.02, 0.05, math.inf])
    data = SimpleNamespace(orientation_sd=sd, reference_u=u)
    for row, T in enumerate(_orientation_error(data, known)):
        moved = np.cross(np.eye(3), known[row])
        s = sd[row] if row < 2 else 0.0
        assert_allclose(T, s**2 * moved.T @ moved + np.diag(u[row] ** 2), atol=1e-14)


def test_what_a_parameter_takes_of_the_sum_of_squares():
    X, y = RNG.normal(size=(9, 4)), RNG.normal(size=9)
    gram, right = X.T @ X, X.T @ y

    def square(columns):
        left = y - X[:, columns] @ np.linalg.lstsq(X[:, columns], y, rcond=None)[0]
        return left @ left

    assert_allclose(_taken(gram, right, [], np.zeros(0)), [y @ y - square([j]) for j in range(4)])
    chosen = [2, 0]
    steps = np.linalg.lstsq(X[:, chosen], y, rcond=None)[0]
    taken = _taken(gram, right, chosen, steps)
    assert_allclose(taken[[1, 3]], [square(chosen) - square([*chosen, j]) for j in (1, 3)])
    assert_allclose(taken[chosen], 0.0, atol=1e-12)


# --- changes, clocks and units


def test_the_clock_of_repeats():
    def at(*times):
        return [
            SimpleNamespace(readings=SimpleNamespace(environment={"time": np.array(each)}))
            for each in times
        ]

    assert _clock(at([1e8, 1e8 + 4], [3e8, 3e8 + 2]))[1] == "absolute"
    values, clock = _clock(at([1e8 - 1, 1e8 + 4], [1e8 + 5, 3e8]))
    assert clock == "ordered"
    assert_allclose(values, [1e8 + 1.5, (1e8 + 5 + 3e8) / 2])
    together = at([0.0, 5.0], [5.0, 7.0])
    assert _clock(together)[0].tolist() == [1.0, 2.0]
    assert _clock([*at([3.0, 9.0]), SimpleNamespace(readings=SimpleNamespace(environment={}))])[
        0
    ].tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    ("value", "unit", "name", "own"),
    [
        (7.0, "V", "bias_a", 7.0),
        (7.0, "", "scale_a", 7.0),
        (7.0, "mg", "bias_a", 7e-3 * 2.5),
        (7.0, "ppm", "bias_a", 7e-6 * 2.5),
        (7.0, "%", "scale_a", 0.07 * 2.5),
        (7.0, "mrad", "cross_a_y", 7e-3 * 2.5),
    ],
)
def test_a_limit_in_the_unit_of_a_parameter(value, unit, name, own):
    model = build_model("1 + x + y", ("a",), ("x",), unit="V")
    c = SimpleNamespace(names=model.names, model=model, parameters=np.array([0.3, -2.5, 0.1]))
    assert _in_unit(value, unit, name, c) == pytest.approx(own)


def test_a_limit_of_a_field_in_another_of_its_units():
    model = SimpleNamespace(units=("nT", ""), keys=(("m", "1"), ("m", "x")))
    c = SimpleNamespace(names=("bias_m", "scale_m"), model=model, parameters=np.array([3.0, 0.9]))
    assert _in_unit(7.0, "uT", "bias_m", c) == pytest.approx(7000.0)


def test_changes_of_one_unit_keep_the_unit_that_the_largest_has():
    def change(name, value, U, rate, limit, within, due):
        return Change("", "", name, value, U, abs(value) / U, 0.0, rate, limit, within, due)

    model = SimpleNamespace(names=("b", "c", "s"), units=("g", "g", ""))
    found = SimpleNamespace(
        calibrations=[SimpleNamespace(model=model)],
        changes=[
            change("b", -3.1e-3, 5e-4, Rate(2e-4, 1e-4), 2e-3, False, "2031-01-01"),
            change("c", 4.2e-5, 5.1e-4, None, (-1e-3, None), True, None),
        ],
    )
    header, rows = change_rows(found)
    assert len(header) == 10
    first, second = (dict(zip(header[:5], row[:5], strict=True)) for row in rows)
    assert (first["unit"], second["unit"]) == ("mg", "mg")
    assert (first["change"], first["U"], first["E_n"]) == ("-3.10", "0.50", "6.2")
    assert (second["change"], second["E_n"]) == ("0.04", "0.082")
    assert rows[0][5:] == ["0.20", "0.10", "2.00", "NO", "2031-01-01"]
    assert rows[1][5:] == ["", "", "-1.00 … ", "yes", ""]


# --- tumbles and regressions


def test_ratios_to_k1_by_the_law_of_propagation():
    """Of each ratio the gradient by differences; o of x is z, whose coefficient is turned round."""
    model = build_model("1 + x + y + z + x^2", ("a",), ("x",), unit="V")
    parameters, C = np.array([0.3, -2.5, 0.04, 0.07, 0.02]), 1e-6 * definite(5, 8)
    k, dof = np.array([2.1, 2.2, 2.3, 2.4, 2.6]), np.array([9.0, 8.0, 7.0, 6.0, 5.0])
    found = ratios_to_k1(model, parameters, C, k, dof, "x")
    wanted = {"K0": (0, 1), "delta_o": (2, 1), "delta_p": (3, -1), "K2": (4, 1)}
    for name, (j, sign) in wanted.items():
        gradient = np.zeros(5)
        gradient[j], gradient[1] = 1.0 / -2.5, -parameters[j] / 2.5**2
        u, one = math.sqrt(gradient @ C @ gradient), found[name]
        assert one.value == pytest.approx(sign * parameters[j] / -2.5)
        assert (one.u, one.U) == (pytest.approx(u), pytest.approx(k[j] * u))
        assert (one.k, one.dof, one.customary["u"]) == (k[j], dof[j], pytest.approx(1e6 * u))
    one = found["K1"]
    assert (one.value, one.u) == (-2.5, pytest.approx(math.sqrt(C[1, 1])))
    assert one.customary["u"] == pytest.approx(1e6 * one.u / 2.5)
    assert one.customary["U"] == pytest.approx(2.2e6 * one.u / 2.5)


def test_u_of_many_rows_together_by_bonferroni():
    r = SimpleNamespace(
        segments=[SimpleNamespace(dof=(3.0, 40.0)), SimpleNamespace(dof=(5.0, 6.0))], confidence=0.9
    )
    by_hand = t.ppf(1.0 - 0.05 / 7, 6.0) / t.ppf(0.95, 6.0)
    assert _family_factor(r, 7) == pytest.approx(by_hand, rel=1e-9)


@pytest.mark.parametrize(("p", "consistent"), [(0.0249, False), (0.0251, True), (None, True)])
def test_regressions_agree_whose_smallest_p_times_their_number_does(p, consistent, monkeypatch):
    tested = [math.nan] if p is None else [0.5, p, math.nan]
    terms = [SimpleNamespace(p=each, term="t", values=np.ones(2)) for each in tested]
    monkeypatch.setattr(regression_repeats, "_compared", lambda repeats, s: terms)
    monkeypatch.setattr(regression_repeats, "_check_alike", lambda *_: None)
    monkeypatch.setattr(regression_repeats, "find_repeated_regressions", lambda runs: ())
    run = [SimpleNamespace(segments=[0], created="", run="run")]
    assert compare_regressions([run, run], ("a", "b"), 0.95).consistent is consistent


def test_tilt_of_one_axis_before_and_after_in_degrees():
    """A tilt is asin f; before, of what 1.3 V/g and .02 V make of a reading."""
    up = mp.read_scheme("roll-y-9").up
    K, b = 1.1, 0.03
    cal = mp.fit(mp.Readings(b + K * up[:, :1], up=up, unit="V"), axes="x", model="1 + x")
    sines = np.array([0.3, -0.5])
    known = np.column_stack([sines, np.zeros(2), np.sqrt(1.0 - sines**2)])
    data = mp.Readings(
        b + K * (known[:, :1] + 0.01), up=known, unit="V", orientation_sd=[0.01, 0.02]
    )
    noise = RunNoise(np.array([[0.003], [0.002]]), np.zeros((2, 1)))
    reference, before, after, u, U = tilt_errors(cal, data, Nominal(0.02, 1.3), noise)
    true = np.degrees(np.arcsin(sines))[:, None]
    assert_allclose(reference, true)
    assert_allclose(before, np.degrees(np.arcsin((data.values - 0.02) / 1.3)) - true)
    assert_allclose(after, np.degrees(np.arcsin(sines + 0.01))[:, None] - true, atol=1e-6)
    of_noise = np.array([0.003, 0.002]) / K / np.sqrt(1.0 - (sines + 0.01) ** 2)
    assert_allclose(u[:, 0], np.degrees(np.hypot(of_noise, [0.01, 0.02])), rtol=1e-3)
    assert_allclose(U, 1.96 * u, rtol=0.03)
    turned = replace(cal, convention="gravity")
    assert_allclose(
        tilt_errors(turned, data, Nominal(0.02, 1.3), noise)[1],
        np.degrees(np.arcsin(-(data.values - 0.02) / 1.3)) - true,
    )


def test_a_table_of_errors_is_row_by_row(monkeypatch):
    columns = {}
    monkeypatch.setattr(verdicts, "data_frame", columns.update)
    numbers = {n: RNG.normal(size=(3, 2)) for n in ("reference", "before", "u", "U", "En")}
    check = SimpleNamespace(
        positions=("p", "q", "r"), axes=("x", "y"), verdicts=np.full((3, 2), ""),
        after=np.arange(6.0).reshape(3, 2), counted=np.ones((3, 2), dtype=bool), **numbers,
    )  # fmt: skip
    Check.to_pandas(check)
    assert list(columns["position"]) == ["p", "p", "q", "q", "r", "r"]
    assert list(columns["axis"]) == ["x", "y"] * 3
    assert columns["after"].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert columns["En"].tolist() == numbers["En"].ravel().tolist()


@pytest.mark.parametrize(
    ("p", "moved", "said"),
    [(0.0049, (), True), (0.0051, (), False), (0.0051, ("bias_a",), True), (0.0049, ("b",), True)],
)
def test_a_run_disagrees_as_a_whole_or_by_what_moved(p, moved, said, monkeypatch):
    """Half of a hundredth each."""
    run = SimpleNamespace(r=np.ones((4, 2)), free=np.zeros((4, 2, 0)), nu=np.ones((4, 2)))
    told = []
    monkeypatch.setattr(agreement, "_whiten", lambda *_: run)
    monkeypatch.setattr(agreement, "_judge", lambda run: SimpleNamespace(p=p))
    monkeypatch.setattr(agreement, "_moved", lambda c, run: moved)

    def in_words(found, moved, *, whole):
        told.append(whole)
        return "!"

    monkeypatch.setattr(agreement, "_in_words", in_words)
    c = SimpleNamespace(
        diagnostics=SimpleNamespace(findings=()), covariance=np.eye(2), outputs=("a",),
        model=SimpleNamespace(gauge=None),
    )  # fmt: skip
    noise = np.ones((4, 2))
    found, findings = agreement.judge_run(c, None, None, noise, noise)
    assert bool(findings) is said
    assert told == ([p < 0.005] if said else [])
    run.r, run.free = np.ones((1, 2)), np.zeros((1, 2, 3))
    assert agreement.judge_run(c, None, None, noise, noise)[1] == ()
    noise[2, 1] = 0.0
    found, findings = agreement.judge_run(c, None, None, noise, noise)
    assert findings == ()
    assert "not known" in found.test


def test_rows_that_are_as_many_as_a_scheme_s_positions():
    data = range(6)
    assert checks._fits("faces-6", data)
    assert not checks._fits("edges-12", data)
    assert not checks._fits(None, data)


def test_errors_beside_the_columns_of_a_run():
    run = {"ax": np.array([0.1, 0.2]), "ay": np.array([0.3, 0.4])}
    found = SimpleNamespace(
        quantity="force", axes=("x", "y"), reference=np.array([[1.0, 2.0], [3.0, 4.0]]),
        after=np.array([[0.1, 0.2], [0.3, 0.4]]), before=np.array([[0.5, 0.6], [0.7, 0.8]]),
    )  # fmt: skip
    table = error_columns.errors_table(None, run, found)
    assert list(table) == [
        "ax", "ay", "f_x", "f_y", "error_x", "error_y", "nominal_error_x", "nominal_error_y"
    ]  # fmt: skip
    assert_allclose((table["f_x"], table["f_y"]), [[1.1, 3.3], [2.2, 4.4]])
    assert_allclose((table["error_y"], table["nominal_error_x"]), [[0.2, 0.4], [0.5, 0.7]])
    with pytest.raises(mp.MultiposError, match="column 'f_x' is there already"):
        error_columns.errors_table(None, {**run, "f_x": run["ax"]}, found)
    found.quantity = "tilt"
    with pytest.raises(mp.UsageError):
        error_columns.errors_table(None, run, found)


def test_several_regressions_are_checked_side_by_side(monkeypatch):
    """All rows of both together have a U of their own, by the degrees of freedom of each."""

    def part(r, table):
        dof = r.segments[0].dof[1]
        column, inside = np.array([1.0, 2.0, 3.0]) * dof, np.array([True, True, dof < 9])
        segments = Frozen({"1": np.array([dof > 0] * 3)})
        return regression_checks._Part(
            column, column, column, column, column, inside, "t", segments, no_agreement("no test")
        )

    monkeypatch.setattr(regression_checks, "_check_one", part)
    both = [
        SimpleNamespace(
            response=name,
            confidence=0.9,
            created="",
            run=None,
            segments=[SimpleNamespace(dof=(1.0, nu))],
        )
        for name, nu in (("a", 6.0), ("b", 9.0))
    ]
    monkeypatch.setattr(regression_checks, "all_of", lambda given: given)
    found = regression_checks.check_regression(both, {"a": [1.0] * 3}, limit_g=0.1)
    assert (found.quantity, found.axes) == ("a, b", ("a", "b"))
    assert found.after.tolist() == [[6.0, 9.0], [12.0, 18.0], [18.0, 27.0]]
    k = [t.ppf(1.0 - 0.05 / 5, nu) / t.ppf(0.95, nu) for nu in (6.0, 9.0)]
    assert_allclose(found.U_family, found.U * k, rtol=1e-6)
    assert list(found.segments) == ["1"]
    assert np.isnan(found.linearity_percent["after"]).tolist() == [True, True]
    assert [each.code for each in found.findings] == ["outside"]
    both[1].segments[0].dof = (1.0, -9.0)
    found = regression_checks.check_regression(both, {"a": [1.0] * 3})
    assert (dict(found.segments), found.U_family) == ({}, None)


def test_rows_of_a_run_stand_under_their_segment_and_their_switch_on():
    t_ = np.array([0.5, -1.0, 2.0, 3.0, 4.0])

    def segment(columns, C):
        between = SimpleNamespace(columns=lambda at, mine: np.column_stack([mine + 1.0]))
        return SimpleNamespace(
            terms=range(columns), robust_covariance=C, between=between,
            design=lambda at, mine: t_[mine, None] ** np.arange(columns),
        )  # fmt: skip

    C = [np.array([[0.4, 0.1], [0.1, 0.3]]), np.array([[0.25]])]
    r = SimpleNamespace(segments=[segment(2, C[0]), segment(1, C[1])])
    place, run, e = np.array([0, 0, 1, 1, 0]), np.array([0, 1, 1, 0, 1]), np.arange(5.0)
    found = regression_checks._rows(r, {}, place, e, run)
    assert_allclose(found.X, [[1, 0.5, 0], [1, -1, 0], [0, 0, 1], [0, 0, 1], [1, 4, 0]])
    assert_allclose(found.Z, [[1, 0], [0, 2], [0, 3], [4, 0], [0, 5]])
    whole = np.zeros((3, 3))
    whole[:2, :2], whole[2, 2] = C[0], 0.25
    assert_allclose(found.L @ found.L.T, found.X @ whole @ found.X.T)


@pytest.mark.parametrize(("third", "level", "count"), [(0.0, 0.01, 1), (9.0, 0.02, 2)])
def test_repeats_are_judged_each_by_holm_and_together(third, level, count, monkeypatch):
    """F of a pooled scatter, χ² of a known one."""
    rng = np.random.default_rng(3)
    values = rng.normal(size=(4, 3))
    values[2] += [14.0, 0.3, third]
    K, known = (np.array([definite(n, 5 * n + r) for r in range(4)]) for n in (2, 1))
    variances, dof = np.array([0.3, 0.02, 0.5, 0.9]), np.array([7.0, 9.0, 8.0, 12.0])
    families = [
        consistency._Family(np.array([0, 2]), K, variances, dof, 0.0 * K),
        consistency._Family(np.array([1]), known, np.ones(4), np.full(4, np.inf), 0.0 * known),
    ]
    outcome = []

    def together(found, words):
        outcome.extend(found)
        return 5.5, 4.0, 0.012, "test"

    monkeypatch.setattr(consistency, "_families", lambda found, day: families)
    monkeypatch.setattr(consistency, "judge_together", together)
    named, day = [SimpleNamespace(names=("p", "q", "r"))], np.zeros(4)
    found = consistency.judge_repeats(named, values, day, level)
    pooled = dof @ variances / dof.sum()
    Q, p = np.empty(3), np.empty(3)
    for i, v in ((0, pooled * K[:, 0, 0]), (2, pooled * K[:, 1, 1]), (1, known[:, 0, 0])):
        Q[i] = np.sum((values[:, i] - np.average(values[:, i], weights=1 / v)) ** 2 / v)
        p[i] = chi2.sf(Q[i], 3) if i == 1 else fisher.sf(Q[i] / 3.0, 3.0, 36.0)
    assert_allclose(found.chi2, Q)
    assert_allclose(found.p, p, rtol=1e-6)
    assert_allclose(found.scatter_dof, [36.0, np.inf, 36.0])
    assert found.dof.tolist() == [3.0] * 3
    assert outcome[0][0] == pytest.approx(_quadratic(values[:, [0, 2]], pooled * K)[0])
    assert [each[1:] for each in outcome] == [(6.0, 36.0), (3.0, math.inf)]
    assert outcome[1][0] == pytest.approx(Q[1])
    order, moved = np.argsort(p), []
    while len(moved) < 3 and p[order[len(moved)]] < level / (3 - len(moved)):
        moved.append(order[len(moved)])
    assert len(moved) == count
    assert found.moved == tuple("pqr"[i] for i in sorted(moved))
    assert found.consistent is (level < 0.012)


def test_drift_of_repeats_is_the_slope_of_a_line(monkeypatch):
    at = np.array([2.0, 3.5, 9.0, 11.0])
    values = np.random.default_rng(4).normal(size=(4, 2)) + np.outer(at, [0.4, -3.0])
    monkeypatch.setattr(recalibration, "_clock", lambda found: (at, recalibration.GIVEN))
    found = recalibration.find_drift([], values)
    lines = [linregress(at, column) for column in values.T]
    assert_allclose(found.drift, [line.slope for line in lines])
    assert_allclose(found.drift_u, [line.stderr for line in lines])
    assert_allclose(found.drift_p, [line.pvalue for line in lines], rtol=1e-6)
    assert found.per == "run"
    at = at[:2]
    found = recalibration.find_drift([], values[:2])
    assert_allclose(found.drift, (values[1] - values[0]) / 1.5)
    assert np.isnan([found.drift_u, found.drift_p]).all()
    at = np.array([2.0, 3.5, 9.0])
    assert np.isfinite(recalibration.find_drift([], values[:3]).drift_p).all()
