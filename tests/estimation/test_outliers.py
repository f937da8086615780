"""Rows that hide each other: readings of a generator of its own, with errors put in by hand."""

import math

import numpy as np
import pytest
from amounts import exactly, few_and_many
from numpy.testing import assert_allclose
from scipy.special import betainc

import multipos as mp
from multipos.estimation.outliers import (
    Part,
    _are_beyond,
    _left_of,
    _log_beta_tail,
    _off_ellipsoid,
    find_outlying_rows,
)
from multipos.estimation.robustness import huber_factors

K = np.array([[1.012, 0.0, 0.0], [0.003, 0.991, 0.0], [0.004, -0.007, 1.008]])
ZERO = np.array([0.012, -0.021, 0.034])
SD = 1e-4  # [g]


def directions(n):
    height = 1.0 - 2.0 * (np.arange(n) + 0.5) / n
    angle = np.pi * (1.0 + 5.0**0.5) * np.arange(n)
    flat = np.sqrt(1.0 - height**2)
    return np.column_stack([np.cos(angle) * flat, np.sin(angle) * flat, height])


def readings(rng, n, off=(), size=0.0, weight=None, up=None):
    """Return readings of which some rows are off along gravity."""
    up = directions(n) if up is None else up
    sd = SD if weight is None else SD * weight[:, None]
    values = ZERO + up @ K.T + sd * rng.standard_normal((n, 3))
    values[list(off)] += size * up[list(off)]
    u = None if weight is None else np.tile(sd, 3)
    return mp.Readings(values, outputs=("ax", "ay", "az"), up=up, u=u, unit="g")


@pytest.mark.parametrize("unknown", [False, True])
@pytest.mark.parametrize(
    ("off", "size"),
    [
        ((3, 17), 0.01),
        ((3, 17), 0.1),
        ((1, 2, 3, 8, 20), 0.04),
        ((1, 2, 3, 8, 13, 17, 20), 0.04),
    ],
)
def test_rows_that_hide_each_other_are_named_all_at_once(unknown, off, size):
    given = readings(np.random.default_rng(1), 24, off, size)
    labels = tuple(str(row + 1) for row in off)
    with pytest.warns(mp.CalibrationWarning):
        plain = exactly(given, unknown_orientation=unknown)
    (finding,) = (each for each in plain.diagnostics.findings if each.code == "outlier")
    assert finding.rows == labels
    assert f"--exclude {','.join(labels)}" in finding.action
    cal = exactly(given, unknown_orientation=unknown, exclude="auto")
    (note,) = (each for each in cal.findings if each.code == "excluded")
    assert (note.level, note.rows) == ("note", labels)
    assert note.text.startswith(f"{len(off)} of 24 positions set aside: {labels[0]} (")
    assert tuple(each.label for each in cal.excluded) == labels
    assert_allclose([each.off for each in cal.excluded], size, rtol=0.02, atol=4 * SD)
    kept = [row for row in range(24) if row not in off]
    same = mp.Readings(given.values[kept], outputs=given.outputs, up=given.up[kept], unit="g")
    assert_allclose(
        cal.parameters, exactly(same, unknown_orientation=unknown).parameters, rtol=1e-12
    )


def test_of_two_rows_that_explain_the_same_none_is_named():
    """Six axes seen from both ends determine a quadric: a row off looks like its opposite."""
    t = (1.0 + 5.0**0.5) / 2.0
    corners = [[0.0, s, u * t] for s in (1.0, -1.0) for u in (1.0, -1.0)]
    up = np.vstack([np.roll(corners, k, axis=1) for k in range(3)]) / math.hypot(1.0, t)
    for row in range(12):
        given = readings(np.random.default_rng(row), 12, [row], 0.02, up=up)
        assert not exactly(given, unknown_orientation=True, exclude="auto").excluded
        known = exactly(given, exclude="auto")
        assert [each.row for each in known.excluded] == [row + 1]


@pytest.mark.parametrize("unknown", [False, True])
@pytest.mark.parametrize("n", [12, 24, 48])
@pytest.mark.parametrize("stated", [False, True])
@pytest.mark.parametrize(("sets", "most"), few_and_many((15, 2), (150, 6)))
@pytest.mark.usefixtures("without_findings")
def test_good_sets_keep_their_rows(unknown, n, stated, sets, most):
    # 1 % is allowed; of 150 sets more than 6 have a chance of 0.3 %, of 15 more than 2 of 0.04 %
    named = 0
    rng = np.random.default_rng([n, unknown, stated])
    for _ in range(sets):
        weight = rng.choice([1.0, 2.0, 4.0], n) if stated else None
        given = readings(rng, n, weight=weight)
        cal = mp.fit(given, unknown_orientation=unknown, exclude="auto", confidence=0.95)
        named += bool(cal.excluded)
    assert named <= most


def test_rows_that_are_noisier_than_others_keep_their_place():
    """A third of them, six times, in all outputs: 1 % of sets are allowed to have one named."""
    named, rng, up = 0, np.random.default_rng(9), directions(16)
    model = mp.fit(readings(rng, 16)).model
    for _ in range(200):
        sd = SD * rng.permutation(np.repeat([6.0, 1.0], [5, 11]))
        values = up @ K.T + sd[:, None] * rng.standard_normal((16, 3))
        given = mp.Readings(values, outputs=("ax", "ay", "az"), up=up, unit="g")
        named += find_outlying_rows(model, given, up) is not None
    assert named <= 7  # of 200 sets more have a chance of 0.1 %


@pytest.mark.parametrize(("sets", "least"), few_and_many((40, 0.86), (200, 0.93)))
@pytest.mark.usefixtures("without_findings")
def test_u_holds_after_rows_were_set_aside(sets, least):
    # of 120 numbers, fewer than 86 % have a chance of 1e-4 at 95 %
    rng, held = np.random.default_rng(5), []
    truth = dict(zip(("bias_ax", "bias_ay", "bias_az"), ZERO, strict=True))
    for _ in range(sets):
        off = rng.choice(24, 2, replace=False)
        cal = mp.fit(readings(rng, 24, off, 0.04), unknown_orientation=True, exclude="auto")
        held += [abs(cal[name].value - value) <= cal[name].U for name, value in truth.items()]
    assert least <= np.mean(held) <= (0.97 if sets == 200 else 1.0)


def test_a_lost_sign_is_named_and_is_unfit():
    given = readings(np.random.default_rng(2), 30)
    for row in (4, 14, 25):
        values = given.values.copy()
        values[row, 2] *= -1.0
        with pytest.warns(mp.CalibrationWarning):
            cal = exactly(mp.Readings(values, outputs=given.outputs, up=given.up, unit="g"))
        (finding, *_) = cal.diagnostics.findings
        assert (finding.code, finding.level) == ("flipped-row", "error")
        assert (finding.rows, finding.outputs) == ((str(row + 1),), ("az",))


def test_rows_are_set_aside_by_label():
    given = readings(np.random.default_rng(3), 24)
    cal = mp.fit(given, exclude=["2", "5"])
    assert [each.label for each in cal.excluded] == ["2", "5"]
    assert cal.to_dict()["excluded"][0]["unit"] == "g"
    assert cal.readings.labels[:3] == ("1", "3", "4")
    with pytest.raises(mp.MultiposError, match="no position is called '99'"):
        mp.fit(given, exclude="99")


def test_a_fleet_sets_aside_as_fit_does():
    rng = np.random.default_rng(4)
    sets = [readings(rng, 24, off, 0.1) for off in ((), (2, 9))]
    table = {"unit": np.repeat(["A", "B"], 24), "position": np.tile(np.arange(24), 2)}
    for i, name in enumerate(("ax", "ay", "az")):
        table[name] = np.concatenate([each.values[:, i] for each in sets])
        table[f"up_{name[1]}"] = np.tile(sets[0].up[:, i], 2)
    found = mp.fit_many(table, unit_column="unit", exclude="auto", unit="g")
    for row, each in enumerate(sets):
        alone = mp.fit(each, exclude="auto")
        assert_allclose(found["bias_ax"][row], alone["bias_ax"].value, atol=1e-12)


@pytest.mark.parametrize(("x", "a", "b"), [(0.02, 3.0, 0.5), (0.3, 7.0, 0.5), (0.2, 9.0, 2.5)])
def test_the_bound_of_the_tail_is_one(x, a, b):
    exact = math.log(betainc(a, b, x))
    assert exact <= _log_beta_tail(x, a, b) <= exact + 0.3


@pytest.mark.parametrize("scheme", ["faces-edges-18", "fibonacci-24"])
@pytest.mark.parametrize("unknown", [False, True])
def test_a_missing_term_is_no_outlier(scheme, unknown):
    # own^3 of 5 mg leaves most at the faces, which set aside would take nearly all of it
    up = mp.read_scheme(scheme).up
    given = readings(np.random.default_rng(6), len(up), up=up)
    bent = mp.Readings(given.values + 5e-3 * up**3, outputs=given.outputs, up=up, unit="g")
    cal = mp.fit(bent, unknown_orientation=unknown, exclude="auto")
    assert not cal.excluded
    assert "missing-term" in {each.code for each in cal.findings}


def test_four_rows_of_which_two_lie_beyond_by_hand():
    """ν = 16, i = 4, j = 2: I_x(6, 1) is x⁶, times M outputs and C(18, 2) = 153, and .75 %/m."""
    # eq. (1) of estimation.outliers
    for outputs in (1, 2):
        view = (Part(np.zeros((1, 4 + outputs, 20)), np.zeros((1, outputs))),)
        limit = (0.0075 / 5 / 153 / outputs) ** (1 / 6)
        for x, beyond in ((0.999 * limit, True), (1.001 * limit, False)):
            assert _are_beyond(view, np.array([[x, 0.99]])[:, :outputs], [4], [2], 5) == [beyond]


def test_an_ellipsoid_is_linear_in_its_form():
    """Readings exactly on one, but for a row 5 % too long: it alone is off, by 5 %."""
    # eq. (2) of estimation.outliers
    up = mp.read_scheme("fibonacci-24").up * [1.0, 1.4, 2.2]  # more of them near an axis
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    values = up @ np.array([[1.1, 0.0, 0.0], [0.02, 0.9, 0.0], [-0.01, 0.03, 1.05]]).T
    values[7] *= 1.05
    values += 1e-5 * np.random.default_rng(1).standard_normal(values.shape)
    given = mp.Readings(values, outputs=("ax", "ay", "az"), unit="g")
    found = find_outlying_rows(mp.fit(given, unknown_orientation=True).model, given, None)
    assert found.rows.tolist() == [7]
    assert found.off[0] == pytest.approx(0.05, rel=0.01)


@pytest.mark.parametrize("axis", range(3))
def test_an_ellipsoid_of_which_a_part_was_seen_has_its_own_centre(axis):
    """About which a row, of those of two thirds of it, is 5 % too long."""
    # eq. (2) of estimation.outliers
    up = directions(90)
    up = up[up[:, axis] > -0.4]
    values = up.copy()
    values[7] *= 1.05
    values += 1e-5 * np.random.default_rng(1).standard_normal(values.shape)
    given = mp.Readings(values, outputs=("ax", "ay", "az"), unit="g")
    found = find_outlying_rows(mp.fit(given, unknown_orientation=True).model, given, None)
    assert found.rows.tolist() == [7]
    assert found.off[0] == pytest.approx(0.05, rel=0.01)


@pytest.mark.parametrize(("steps", "named"), [(4.5, False), (6.5, True)])
def test_rows_off_an_ellipsoid_by_few_steps_are_not_named(steps, named):
    """Three steps of .001 over the rms of a reading, 1/√3 of its largest: 5.2 steps."""
    up = mp.read_scheme("fibonacci-48").up
    values = np.round(up * 1000.0) / 1000.0
    values[7] = np.round((1000.0 + steps) * up[7]) / 1000.0
    given = mp.Readings(values, outputs=("ax", "ay", "az"), unit="g")
    model = mp.fit(given, unknown_orientation=True).model
    found = _off_ellipsoid(model, given, None)
    assert (found is not None) is named
    if found is not None:
        assert (found.rows.tolist(), found.errors, found.dof) == ([7], None, 48 - 9 - 1)
        assert found.off[0] == pytest.approx(1e-3 * steps, abs=5e-4)
    values[:, 1] = 0.5
    still = mp.Readings(values, outputs=("ax", "ay", "az"), unit="g")
    assert _off_ellipsoid(model, still, None) is None


def test_hubers_factor_by_hand():
    """psi' 1 and 0: mean 1/2, variance 1/4; half of two degrees used: (3/2)² (1 + 4/4)/1/(1/4)."""
    # eq. (1) of estimation.robustness
    q, weight, slope = np.array([1.0, 4.0]), np.array([1.0, 0.5]), np.array([1.0, 0.0])
    found = huber_factors(q, np.ones(2), weight, slope, np.array(1.0))
    assert found == pytest.approx(18.0, rel=1e-12)


def test_what_fits_to_some_rows_leave_of_all():
    rng = np.random.default_rng(3)
    basis, values = np.linalg.qr(rng.normal(size=(20, 3)))[0], rng.normal(size=(20, 2))
    kept = rng.random((4, 20)) > 0.3
    both = np.concatenate([basis.T, values.T])
    part = Part(both[None], np.full((1, 2), 0.25))
    ((left, squares),) = _left_of((part,), kept)
    for one, e, square in zip(kept, left, squares, strict=True):
        b = np.linalg.lstsq(basis[one], values[one], rcond=None)[0]
        np.testing.assert_allclose(e.T, values - basis @ b, atol=1e-7)
        np.testing.assert_allclose(square, np.sum((values - basis @ b)[one] ** 2, axis=0) + 0.25)
