"""Every gross error, planted in readings otherwise good, and good readings that are strange."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from findings_bench import texts, warned
from scipy.stats import f

import multipos as mp
from multipos.diagnostics import gross_errors
from multipos.diagnostics.repairs import (
    Repair,
    View,
    _interchanges,
    _single_rows,
    _wrapped,
    look,
    rows_in_another_unit,
)
from multipos.diagnostics.scales import facing, turned

MATRIX = np.array([[0.98, 0.01, -0.005], [0.004, 1.02, 0.01], [-0.01, 0.003, 0.99]])
G = 9.80665


def sense(up, seed=5, noise=1e-3):
    rng = np.random.default_rng(seed)
    return np.array([0.02, -0.03, 0.05]) + up @ MATRIX.T + noise * rng.standard_normal(up.shape)


def codes(values, up, level="error", **options):
    unit = options.pop("unit", "reading")
    options = {"exclude": "none", **options}  # which names the rows and says no more
    cal = mp.fit(mp.Readings(values, up=up, unit=unit), **options)
    return [d.code for d in cal.diagnostics.findings if d.level == level], cal


def finding(values, up, **options):
    (_, cal) = codes(values, up, **options)
    (found,) = [d for d in cal.diagnostics.findings if d.level == "error"]
    return found


def edited(name, scheme, edit):
    up = mp.read_scheme(scheme).up.copy()
    values = sense(up)
    edit(values, up)
    return pytest.param(values, up, name, id=f"{name} {scheme}")


def swap(values, up):
    values[[0, 1]] = values[[1, 0]]


def far(values, up):
    """Exchange rows of two axes."""
    values[[1, 4]] = values[[4, 1]]


def flip(values, up):
    up[2] *= -1.0


def slant(values, up):
    up[-1, 1] *= -1.0


def negate(values, up):
    values[2, np.argmax(np.abs(values[2]))] *= -1.0


def flip_half(values, up):
    up[len(up) // 2 :] *= -1.0


def one_row(values, up):
    values[2] *= G


def half(values, up):
    values[: len(values) // 2] *= G


def one_output(values, up):
    values[:, 1] *= G


def reverse(values, up):
    values[:, 0] *= -1.0


def exchange(values, up):
    values[:, [0, 1]] = values[:, [1, 0]]


def stuck(values, up):
    values[:, 2] = 0.05


def noise(values, up):
    values[:, 2] = 0.05 + 1e-3 * np.random.default_rng(1).standard_normal(len(values))


def wired(values, up):
    values[:, 1] = values[:, 0]


def count(values, up):
    values[:, 1] = np.arange(1.0, len(values) + 1.0)


def clip(values, up):
    np.clip(values, -0.95, 0.95, out=values)


def wrap(values, up):
    values[values > 0.9] -= 2.0


def all_noise(values, up):
    values[:] = np.random.default_rng(2).standard_normal(values.shape)


PLANTED = [
    edited(name, scheme, edit)
    for name, edit in (
        ("interchanged-rows", swap),
        ("flipped-row", flip),
        ("flipped-row", flip_half),
        ("flipped-row", negate),
        ("flipped-direction", slant),
        ("row-unit", one_row),
        ("row-unit", half),
        ("output-unit", one_output),
        ("sign", reverse),
        ("permuted-outputs", exchange),
        ("dead-output", stuck),
        ("no-signal", noise),
        ("no-signal", wired),
        ("counter-column", count),
        ("saturated", clip),
        ("wrapped", wrap),
        ("no-signal", all_noise),
    )
    for scheme in ("song-qin-6", "all-26")
    # of opposite faces half the rows leave nothing to tell, and a wrap by 2 g looks upside down
    if scheme == "all-26" or edit not in (flip_half, wrap, negate, slant)
]


@pytest.mark.parametrize(("values", "up", "code"), PLANTED)
def test_a_planted_gross_error_is_named(values, up, code):
    assert codes(values, up)[0] == [code]


@pytest.mark.parametrize("scheme", ["song-qin-6", "all-26", "dual-axis-48"])
def test_good_readings_raise_no_doubt_of_the_data(scheme):
    up = mp.read_scheme(scheme).up
    assert codes(sense(up), up)[0] == []


def test_a_spiral_of_positions_without_noise_is_no_counter():
    up = mp.read_scheme("fibonacci-40").up  # z falls by one step from row to row
    assert codes(0.01 + 1.02 * up, up)[0] == []


def test_a_repair_names_rows_and_the_rms_before_and_after():
    up = mp.read_scheme("song-qin-6").up
    values = sense(up)
    values[[0, 1]] = values[[1, 0]]
    found = finding(values, up)
    before = mp.fit(mp.Readings(values, up=up)).rms
    assert found.rows == ("1", "2")
    said = f"rms falls from {before:.2g} g to 0.000" if before < 10.0 else "rms is 0.000"
    assert said in found.text


def test_wrapping_tells_the_step():
    up = mp.read_scheme("all-26").up
    values = np.round(1000.0 * sense(up))
    values[values > 900.0] -= 2048.0
    found = finding(values, up)
    assert found.outputs == ("ax", "ay", "az")
    step = float(found.text.split("with ")[1].split(" ")[0])
    # one reading an output wrapped: its noise of 1 is that of the step, times sqrt(1/(1 - h))
    assert step == pytest.approx(2048.0, abs=6.0)


@pytest.mark.parametrize(("factor", "named"), [(G, "--unit m/s^2"), (1000.0, "--unit mg")])
def test_another_unit_is_named(factor, named):
    up = mp.read_scheme("all-26").up
    found = finding(factor * sense(up), up, unit="g")
    assert (found.code, named in found.action) == ("unit", True)
    assert codes(sense(up), up, unit="g")[0] == []
    assert codes(factor * sense(up), up)[0] == []  # no unit was stated


def test_angles_in_radians_are_named():
    rng = np.random.default_rng(3)
    roll, pitch = rng.uniform(-3.1, 3.1, 12), rng.uniform(-1.5, 1.5, 12)
    up = np.column_stack(
        [np.sin(pitch), -np.sin(roll) * np.cos(pitch), -np.cos(roll) * np.cos(pitch)]
    )
    columns = {"roll_deg": roll, "pitch_deg": pitch, **dict(zip("xyz", sense(up).T, strict=True))}
    assert warned(mp.fit(columns)) == ["angles-in-radians"]
    columns |= {"roll_deg": np.degrees(roll), "pitch_deg": np.degrees(pitch)}
    assert warned(mp.fit(columns)) == []


@pytest.mark.parametrize("scheme", ["faces-6", "fibonacci-24"])
@pytest.mark.parametrize(("edit", "code"), [(far, "interchanged-rows"), (flip, "flipped-row")])
def test_it_is_named_where_orientation_errors_are_estimated_and_rows_set_aside(scheme, edit, code):
    """An error of the whole fit, or a warning beside that of the others."""
    up = mp.read_scheme(scheme).up.copy()
    values = sense(up)
    edit(values, up)
    cal = mp.fit(mp.Readings(values, up=up))
    (found,) = (each for each in cal.findings if each.code == code)
    assert found.level == ("warning" if cal.excluded else "error")
    if scheme == "fibonacci-24":
        assert {each.label for each in cal.excluded} == {*found.rows}
        truth = np.column_stack([[0.02, -0.03, 0.05], MATRIX]).ravel()
        assert np.mean(np.abs(cal.parameters - truth) <= cal.U) > 0.8


@pytest.mark.parametrize(("gravity", "said"), [(32.17, True), (9.79, False), (1.0, True)])
def test_gravity_of_another_world(gravity, said):
    up = mp.read_scheme("all-26").up
    assert ("gravity" in codes(sense(up), up, gravity=gravity)[0]) == said


def test_a_chip_turned_in_its_case_is_no_gross_error():
    up = mp.read_scheme("faces-6").up
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # ax along y, ay along -x
    found, cal = codes(sense(up @ turn.T), up, level="warning")
    assert found[0] == "turned"
    said = cal.diagnostics.findings[0]
    assert "by 90 degrees about (0.00, 0.00, 1.00): ax senses y, ay senses -x, az senses z" in (
        said.text
    )
    assert np.abs(cal.compensate(sense(up @ turn.T)) - up).max() < 0.005


def test_the_other_convention_is_a_warning_and_no_gross_error():
    up = mp.read_scheme("faces-6").up
    found, cal = codes(sense(-up), up)
    assert found == []
    assert any("--convention gravity" in said for said in texts(cal))
    assert turned(cal, 0.1 * cal.sensitivity) is None  # in whatever unit


def test_one_outlier_is_no_gross_error():
    up = mp.read_scheme("all-26").up
    values = sense(up)
    values[4, 1] += 0.5
    assert codes(values, up)[0] == []


def test_copies_are_told_from_repeats():
    up = np.tile(mp.read_scheme("faces-6").up, (4, 1))
    once = sense(up[:6])
    copied, _ = codes(np.tile(once, (4, 1)), up, "warning")
    assert copied[0] == "repeated-rows"
    assert "lack-of-fit" not in copied
    assert "repeated-rows" not in codes(sense(up), up, "warning")[0]
    # repeats of a converter so coarse that noise does not show are repeats all the same
    coarse, _ = codes(np.round(sense(up, noise=1e-4), 2), up, "warning")
    assert not {"repeated-rows", "lack-of-fit"} & set(coarse)


def test_the_linear_view_is_least_squares():
    # eqs. (4), (5) of diagnostics.repairs
    up = mp.read_scheme("all-26").up
    values = sense(up)
    view = look(mp.fit(mp.Readings(values, up=up), model="ieee"))
    design = np.column_stack([np.ones(26), up])
    beta, square, *_ = np.linalg.lstsq(design, values, rcond=None)
    assert view.sensitivity == pytest.approx(beta[1:].T, abs=1e-14)
    size = np.linalg.norm(beta[1:], axis=0)
    assert view.misfit == pytest.approx(np.sqrt(np.mean(square / 22 / size**2)), rel=1e-10)
    without = [np.delete(np.arange(26), row) for row in range(26)]
    rest = [np.linalg.lstsq(design[rows], values[rows], rcond=None)[1] for rows in without]
    least = min(float(np.sum(each / size**2)) for each in rest)
    assert view.misfit_but_one == pytest.approx(np.sqrt(least / 3 / 21), rel=1e-10)


def test_an_interchange_is_found_under_a_formula_that_is_nearly_linear():
    up = mp.read_scheme("fibonacci-24").up
    values = sense(up / (1.0 + 0.05 * up**2))
    assert codes(values, up, model="each = a + p*x + q*y + r*z + c*own^3")[0] == []
    swap(values, up)
    found = finding(values, up, model="each = a + p*x + q*y + r*z + c*own^3")
    assert (found.code, found.rows) == ("interchanged-rows", ("1", "2"))


@pytest.mark.parametrize("known", [{}, {"orientation_sd": 0.5}, {"unknown_orientation": True}])
def test_a_reading_in_which_all_others_drown_leaves_no_result(known):
    up = mp.read_scheme("all-26").up
    values = sense(up)
    values[5, 2] = 1e17
    readings = mp.Readings(values, up=None if "unknown_orientation" in known else up)
    with pytest.raises(mp.MultiposError, match=r"position 6: .* is 1e\+17, next to which"):
        mp.fit(readings, **known, reading_sd=1e-3, exclude="none")


@pytest.mark.parametrize(("size", "calm"), [(0.19, True), (0.21, False), (-0.21, False)])
def test_terms_of_a_fifth_of_the_signal_are_looked_at(size, calm):
    up = mp.read_scheme("fibonacci-24").up
    noise = 1e-4 * np.random.default_rng(1).standard_normal(up.shape)
    values = 5.0 * (up + size * up**2 + noise)
    c = mp.fit(mp.Readings(values, up=up, unit="V"), model="own-quadratic", orientation_sd=0)
    assert gross_errors._is_calm(c) == calm


@pytest.mark.parametrize(
    ("tried", "fitted", "gross", "said"),
    [
        (9, False, False, True),  # 9 (.05/.5)^6 below 1e-5
        (11, False, False, False),
        (4990, False, True, True),  # below .005
        (5010, False, True, False),
        (499, True, True, True),  # a number is fitted: to the fifth power
        (501, True, True, False),
    ],
)
def test_a_repair_is_accepted_by_its_chance_by_hand(tried, fitted, gross, said, monkeypatch):
    # eq. (1) of diagnostics.gross_errors
    monkeypatch.setattr(gross_errors, "_sticks_out", lambda *_: False)
    view = SimpleNamespace(misfit=0.5, misfit_but_one=0.5, dof=2, values=np.zeros((6, 3)))
    after = SimpleNamespace(misfit=0.05)
    repair = Repair("interchanged-rows", (0, 1), after, outputs=(1,), fitted=fitted)
    assert gross_errors.explains(repair, view, tried, gross=gross) == said


def test_of_several_repairs_the_least_probable_by_hand():
    # eq. (2) of diagnostics.gross_errors: log 7 + 4 log(.1) + 3 log(.2 √(4/3)) + log 9
    view = SimpleNamespace(residuals=np.array([[1.0, 3.0]]), values=np.ones((6, 2)), dof=4)
    after = SimpleNamespace(residuals=np.array([[0.1, 0.6]]))
    repair = Repair("wrapped", (0,), after, (1,), tried=7, fitted=True, shrunk=math.log(9.0))
    by_hand = math.log(7 * 0.1**4 * (0.2 * math.sqrt(4 / 3)) ** 3 * 9)
    assert gross_errors._chance(repair, view) == pytest.approx(by_hand, rel=1e-12)
    # within 1.5 of the best for each degree of freedom, 8 in all
    other = [Repair("wrapped", (0,), after, (1,), 1.0, tried, True) for tried in (1, 25, 26)]
    kept = gross_errors.as_good_as_best(other, view)
    assert [each.tried for each in kept] == [1, 25]  # 1.5⁸ = 25.6


def test_repairs_of_rows_are_the_best_of_all_that_one_may_try():
    """Every interchange and factor refitted: the least sum of squares over variances."""
    # eq. (1) of diagnostics.repairs
    rng = np.random.default_rng(3)
    up = rng.permutation(mp.read_scheme("fibonacci-12").up)
    values = up @ np.array([[1.0, 0.02, 0.0], [0.0, 0.9, 0.01], [0.03, 0.0, 1.1]]) + 0.02
    values += 0.01 * rng.standard_normal(values.shape)
    values[[2, 7]] = values[[7, 2]]
    view = View(np.ones((12, 1)), up, values)
    design = np.column_stack([np.ones(12), up])

    def total(changed):
        left = changed - design @ np.linalg.lstsq(design, changed, rcond=None)[0]
        return float(np.sum(left**2, axis=0) @ (1.0 / np.var(values, axis=0)))

    def exchanged(i, j):
        rows = np.arange(12)
        rows[[i, j]] = j, i
        return total(values[rows])

    sums = {(i, j): exchanged(i, j) for i in range(12) for j in range(i + 1, 12)}
    found, tried = _interchanges(view, np.arange(12))
    assert tried == len(sums) == 66
    assert [each.rows for each in found] == sorted(sums, key=sums.__getitem__)[:6]
    assert found[0].rows == (2, 7)
    values[[2, 7]] = values[[7, 2]]
    values[5] *= 9.80665
    view = View(np.ones((12, 1)), up, values)
    best = next(e for e in _single_rows(view, np.arange(12))[0] if e.code == "row-unit")
    assert (best.rows, best.shrunk) == ((5,), pytest.approx(3.0 * math.log(9.80665)))
    assert best.size == pytest.approx(9.80665)


@pytest.mark.parametrize(("code", "output"), [("flipped-direction", None), ("flipped-row", 1)])
def test_a_change_of_one_row_is_the_best_of_all_refits(code, output):
    """Every sign of a direction's component, or of a reading, turned in every row and refitted."""
    # eq. (2) of diagnostics.repairs
    rng = np.random.default_rng(6)
    up = rng.permutation(mp.read_scheme("fibonacci-12").up)
    values = 0.02 + up @ MATRIX.T + 0.01 * rng.standard_normal(up.shape)
    if output is None:
        up[4, 1] *= -1.0
    else:
        values[4, output] *= -1.0

    def total(up, values):
        X = np.column_stack([np.ones(12), up])
        left = values - X @ np.linalg.lstsq(X, values, rcond=None)[0]
        return float(np.sum(left**2, axis=0) @ (1.0 / weight))

    weight, sums = np.var(values, axis=0), {}
    for k, i in np.ndindex(12, 3):
        signs = np.ones((12, 3))
        signs[k, i] = -1.0
        sums[k, i] = total(up * signs, values) if output is None else total(up, values * signs)
    found = _single_rows(View(np.ones((12, 1)), up, values), np.arange(12))[0]
    (best,) = (each for each in found if each.code == code)
    assert best.rows == (min(sums, key=sums.__getitem__)[0],) == (4,)
    assert (best.component if output is None else best.outputs) == (1 if output is None else (1,))
    assert np.sum(best.view.residuals**2, axis=0) @ (1.0 / weight) == pytest.approx(
        min(sums.values()), rel=1e-9
    )


def test_which_axes_outputs_face_by_hand():
    # eq. (1) of diagnostics.scales: .8 + .9 + .7 against 0 + .1 + .3 and all others
    seen = np.array([[0.1, -1.6, 1.2], [0.0, 0.3, 0.9], [0.9, -0.3, 0.3]])
    found = facing(seen)
    assert (found.axes, found.signs, found.text) == ((1, 2, 0), (-1.0, 1.0, 1.0), "-y,z,x")
    assert found.least == pytest.approx(1.6 / math.sqrt(0.01 + 2.56 + 1.44))


def test_rows_of_another_unit_by_their_size():
    """A bias of .49 g leaves sizes of .51 to 1.49: none is in another unit; two times 9.8 are."""
    # eq. (3) of diagnostics.repairs
    up = mp.read_scheme("faces-corners-14").up
    values = up + np.array([0.49, 0.0, 0.0])
    assert rows_in_another_unit(mp.Readings(values, up=up)) == ((), 1.0)
    values[[3, 8]] *= 9.80665
    rows, factor = rows_in_another_unit(mp.Readings(values, up=up))
    assert (rows, factor) == (("4", "9"), pytest.approx(9.80665))
    values[3] /= 3.0  # between two units
    assert rows_in_another_unit(mp.Readings(values, up=up))[0] == ()


def test_a_wrapped_output_is_one_of_all_that_were_tried():
    """Four orders of 24 rows, 13 by 13 counts of the top and the bottom, and two signs."""
    up = mp.read_scheme("fibonacci-24").up
    noise = 1e-4 * np.random.default_rng(2).standard_normal(up.shape)
    values = up * [1.02, 0.97, 1.0] + noise
    top = int(np.argmax(up[:, 1]))
    values[top, 1] -= 2.0
    (found,) = _wrapped(View(np.ones((24, 1)), up, values))
    assert (found.rows, found.outputs, found.tried) == ((top,), (1,), 4 * 2 * 13**2)
    assert found.size == pytest.approx(2.0, abs=2e-3)
    assert found.fitted


def test_an_output_without_a_signal_is_as_far_off_as_least_squares_says():
    up = mp.read_scheme("fibonacci-24").up
    rng = np.random.default_rng(8)
    values = up + 1e-3 * rng.standard_normal(up.shape)
    values[:, 1] = rng.permutation(values[:, 1])
    (found,) = (f for f in mp.fit(mp.Readings(values, up=up)).findings if f.code == "no-signal")
    design = np.column_stack([np.ones(24), up])
    beta, square, *_ = np.linalg.lstsq(design, values, rcond=None)
    share = np.sqrt(square[1] / 20.0) / np.linalg.norm(beta[1:, 1])
    assert f" of 'ay' are {100.0 * share:.0f} % of one g" in found.text
    assert found.outputs == ("ay",)


@pytest.mark.parametrize(("by", "sticks"), [(0.98, False), (1.02, True)])
def test_a_row_that_sticks_out_even_so_is_none_that_was_changed(by, sticks, monkeypatch):
    """Of six degrees of freedom: its square over a fifth of the others', by F on 3 and 15."""
    monkeypatch.setattr(gross_errors, "_changes", lambda repair, before: np.array([1e-9]))
    residuals = np.full((8, 3), 0.5)
    limit = f.isf(1e-4, 3, 15) * 7 * 0.75 / 5.0
    residuals[2] = np.sqrt(by * limit / 3.0)
    view = SimpleNamespace(
        values=residuals, dof=6, basis=np.zeros((8, 4)), residuals=2.0 * residuals, response=2.0
    )
    repair = SimpleNamespace(view=view, rows=(2,), tried=8, code="row-unit")
    assert gross_errors._sticks_out(repair, view) is sticks
