"""Sizes that findings say, and where they begin: by hand, a little on either side of each limit."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import chi2, norm

import multipos as mp
from multipos.diagnostics import (
    columns,
    examination,
    magnetic,
    projections,
    repairs,
    residuals,
    row_order,
    scales,
    score_tests,
)
from multipos.errors import MultiposError
from multipos.estimation.known import REJECTED
from multipos.files.numbers import p_in_words
from multipos.sensor.fit_diagnostics import ModelTest
from multipos.sensor.found import Estimator
from multipos.sensor.model import build_model

UP = mp.read_scheme("fibonacci-14").up
AXES = ("x", "y", "z")


class Rows(SimpleNamespace):
    """Readings that have a length."""

    def __len__(self):
        return len(self.labels)


def rows(count, **more):
    labels = tuple(f"r{i}" for i in range(count))
    return Rows(labels=labels, **{"environment": {}, "sd": None, **more})


# --- sizes of causes


@pytest.mark.parametrize(
    ("code", "sizes", "more", "said"),
    [
        # the largest of the outputs, over four steps
        ("drift", [[2e-3], [-5e-3], [1e-3]], {}, "drift by 0.02 V from"),
        ("slipped", np.radians([[0.2, -0.3, 0.6]]), {"row": 3}, "from row r3 on the case is rot"),
        ("slipped", np.radians([[0.2, -0.3, 0.6]]), {"row": 3}, "by 0.7 degrees"),
        ("replaced", [[0.02], [-0.05]], {"row": 2}, "row r2 on readings have other biases, by up "),
        ("replaced", [[0.02], [-0.05]], {"row": 2}, "up to 0.05 V ("),
        ("settling", [[0.031]], {}, "contain 3.1 % of the previous row"),
        ("hysteresis", [[0.02], [-0.035]], {}, "differ by 0.07 V with"),
        ("level", np.radians([[0.3, -0.4]]), {}, "table tilt of 0.5 degrees"),
        ("table", np.radians([[0.02, -0.06, 0.01]]), {}, "table errors of 0.06 degrees"),
    ],
)
def test_the_size_of_a_cause_is_said(code, sizes, more, said):
    c = SimpleNamespace(readings=rows(5), model=SimpleNamespace(unit="V"))
    cause = row_order.Cause(code, 9.0, 1e-3, more.get("row"))
    columns = np.arange(5.0)[:, None]
    assert said in examination._SAID[code](c, cause, np.array(sizes), columns)[0]


def test_all_readings_after_an_exchange_are_others():
    c = SimpleNamespace(readings=rows(9), model=SimpleNamespace(unit="V"))
    cause = row_order.Cause("replaced", 9.0, 1e-3, 4)
    text, action, named = examination._SAID["replaced"](c, cause, np.ones((3, 4)), np.ones((9, 4)))
    assert ("biases" in text, named) == (False, ("r4",))
    assert "before r4 and those from it on" in action


def test_rests_that_vibrate_are_twice_as_loud_as_the_median():
    """|sd| of 5, 10.1, 4.9, 9.9 and 5: of the last one alone; 2 of its square is 204."""
    size = np.array([5.0, 10.1, 4.9, 9.9, 5.0]) / 5.0
    c = SimpleNamespace(
        readings=rows(5, sd=np.array([3.0, 4.0]) * size[:, None]), model=SimpleNamespace(unit="V")
    )
    cause = row_order.Cause("vibration", 9.0, 1e-3)
    text, _, named = examination._SAID["vibration"](
        c, cause, np.array([[-2.0], [1.5]]), size[:, None]
    )
    assert named == ("r1",)
    assert f"by up to {2.0 * 10.1**2:.2g} V" in text


# --- what nothing checks


LINEAR = build_model("linear", ("a", "b", "c"), AXES)


@pytest.mark.parametrize(("stated", "spread"), [(False, 1.0), (True, 1.0), (False, 0.05)])
def test_what_noise_does_to_as_many_parameters_as_positions(stated, spread):
    """Of X b = y, b moves by |X⁻¹| sd row by row; said as a share of the output's own scale."""
    up = np.array([[0.0, 0.0, 1.0], [0.9, 0.0, 0.0], [0.0, -0.8, 0.0], [0.4, 0.5, -0.6]])
    up = up * spread + (1.0 - spread) * np.array([0.0, 0.0, 1.0])
    up /= np.linalg.norm(up, axis=1)[:, None]
    K = np.array([[2.0, 0.1, 0.0], [0.0, 0.5, 0.02], [0.1, 0.0, 1.2]])
    sd = np.random.default_rng(2).uniform(5e-4, 2e-3, (4, 3)) if stated else None
    c = mp.fit(mp.Readings(0.02 + up @ K.T, up=up, unit="g", u=sd))
    sd = np.full((4, 3), 1e-3 * math.hypot(2.0, 0.1)) if sd is None else sd
    inverse = np.linalg.inv(np.column_stack([np.ones(4), up]))
    share = np.sqrt(inverse**2 @ sd**2)[1:].T / np.diag(K)[:, None]  # (output, axis)
    name, moved = examination._moved_by_noise(c)
    assert moved == pytest.approx(share.max(), rel=1e-6)
    output, axis = divmod(int(share.argmax()), 3)
    wanted = next(k for k, key in enumerate(c.model.keys)
                  if (key[0], str(key[1])) == (c.outputs[output], AXES[axis]))  # fmt: skip
    assert name == c.names[wanted]
    said = examination.no_redundancy(c)
    assert said.code == ("no-residuals" if share.max() > 0.1 else "no-redundancy")
    assert (share.max() > 0.1) == (spread < 1.0)
    assert said.text.startswith("4 positions for")


def test_terms_that_u_leaves_open():
    """U over the own scale factor: of linear terms beyond .02, of own ones from .2 to 1."""
    parameters = np.tile([0.1, 0.03, 0.03, 0.03], 3)
    parameters[[1, 6, 11]] = 2.0, -0.5, 1.0
    for place, size, poor, opened in (
        (1, 0.041, True, False), (1, 0.039, False, False), (4, 9.0, False, False),
        (5, 0.011, True, False), (5, 0.009, False, False), (6, 0.101, True, True),
        (6, 0.099, True, False), (6, 0.499, True, True), (6, 0.501, True, False),
        (7, 0.3, True, False),
    ):  # fmt: skip
        U = np.full(12, 1e-4)
        U[place] = size
        both = np.stack([np.full(12, 1e-4), U])
        twice = np.stack([parameters, parameters])
        assert examination.are_poorly_known(LINEAR, twice, both).tolist() == [False, poor]
        assert examination.are_open(LINEAR, twice, both).tolist() == [False, opened]
        c = SimpleNamespace(
            model=LINEAR, parameters=parameters, U=U, names=LINEAR.names,
            diagnostics=SimpleNamespace(condition=9999.0),
        )  # fmt: skip
        said = examination.poorly_determined(c)
        assert (said is not None) is opened
        if said:
            assert f"{LINEAR.names[place]} (U = {100.0 * size / 0.5:.2g} %)" in said.text
        said = examination._poorly_known(c)
        assert (said is not None) is poor
        if said:
            own = {0: 2.0, 1: 0.5, 2: 1.0}[place // 4]
            assert f"{LINEAR.names[place]} (U = {1e3 * size / own:.2g} mrad)" in said.text
    c.diagnostics.condition = 10_001.0
    assert "condition 1.0e+04" in examination.poorly_determined(c).text
    lost = parameters.copy()
    lost[6] = 0.0  # U of a scale factor that is nothing is no share of it
    assert examination._shares(LINEAR, lost[None], U[None])[0, [4, 5, 6, 7]].tolist() == [
        0.0, math.inf, math.inf, math.inf,
    ]  # fmt: skip


@pytest.mark.parametrize("drift", [0.4, 0.5])
def test_a_drift_that_an_order_absorbs(drift):
    """A fifth of the variance of time in one component, by the square of a correlation."""
    time = np.array([0.0, 1.0, 2.0, 4.0, 8.0, 9.0])
    course = time - time.mean()
    across = np.array([1.0, -2.0, 1.0, 0.5, -1.0, 0.5])
    across -= across.mean() + across @ course / (course @ course) * course
    course, across = course / np.linalg.norm(course), across / np.linalg.norm(across)
    own = drift * course + math.sqrt(1.0 - drift**2) * across
    design = np.column_stack([np.ones(6), own])
    model = SimpleNamespace(
        drift_per=None, respond=lambda *_: (None, [(None, design[:, :1]), (None, design)])
    )
    c = SimpleNamespace(
        readings=rows(6, environment={"time": time}), estimator=SimpleNamespace(exact=True),
        model=model, parameters=None, reference=None,
    )  # fmt: skip
    said = examination.drift_absorbed(c)
    assert (said is not None) is (drift**2 > 0.2)
    if said:
        assert "absorbs 25 % of a linear drift" in said.text
        model.drift_per = "row"
        assert examination.drift_absorbed(c) is None


def test_a_level_is_the_worst_of_all_headings():
    """√16 times its u; not where attitudes are stated, or nothing is known."""
    budget = SimpleNamespace(rows=[{"quantity": "axes"}, {"quantity": "level", "u": 0.03}])
    c = SimpleNamespace(readings=rows(16, rotation=None), budget=budget, estimator="x")
    assert "error of 0.12 degrees" in examination.open_headings(c).text
    c.estimator = Estimator.UNKNOWN
    assert examination.open_headings(c) is None
    c.estimator, c.readings.rotation = "x", np.full((16, 3, 3), np.nan)
    assert examination.open_headings(c) is not None
    c.readings.rotation = np.zeros((16, 3, 3))
    assert examination.open_headings(c) is None


def test_noise_from_rests_is_allowed_three_times_itself():
    def c(chi2):
        return SimpleNamespace(diagnostics=SimpleNamespace(claim=chi2))

    near, far = (SimpleNamespace(chi2=square, dof=7.0) for square in (62.9, 63.1))
    assert examination._is_allowed_for(c(near), "denied-noise")
    assert not examination._is_allowed_for(c(far), "denied-noise")
    assert not examination._is_allowed_for(c(None), "denied-noise")
    assert not examination._is_allowed_for(c(near), "outlier")
    assert examination._is_allowed_for(c(far), "overstated-noise")


# --- columns


@pytest.mark.parametrize(("span", "found"), [(0.49, False), (0.51, True)])
def test_an_output_that_stands_still_while_its_axis_turns(span, found):
    reference = np.zeros((4, 3))
    reference[:, 1] = np.array([0.0, 0.3, 1.0, 0.7]) * span
    reference[:, 2] = np.array([0.0, 0.3, 1.0, 0.7])
    values = np.column_stack([[0.1, 0.2, 0.1, 0.3], [0.4] * 4])
    c = SimpleNamespace(
        readings=rows(4, values=values), outputs=("a", "b"), reference=reference,
        model=SimpleNamespace(axes=("z", "y")),
    )  # fmt: skip
    said = columns.dead_output(c)
    assert (said.outputs if said else None) == (("b",) if found else None)
    values[0, 1] = 0.4001
    assert columns.dead_output(c) is None


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [(200.0, 400.0, True), (199.0, 300.0, False), (250.0, 401.0, False), (250.0, 299.0, True)],
)
def test_temperatures_that_look_like_kelvin(low, high, said):
    c = SimpleNamespace(
        readings=rows(2, environment={"temperature": np.array([low, high])}),
        model=SimpleNamespace(environment=("temperature",)),
    )
    assert (columns.temperature_kelvin(c) is not None) is said
    c.model.environment = ()
    assert columns.temperature_kelvin(c) is None


@pytest.mark.parametrize("apart", [0.9e-6, 1.1e-6, None])
def test_rows_that_are_copies_of_others(apart, monkeypatch):
    """Of three copies one stands elsewhere, or all in the same place, or positions are unknown."""
    monkeypatch.setattr(columns, "_shows_noise", lambda c: True)
    values = np.array([[1.0, 2.0], [3.0, 4.0], [1.0, 2.0], [5.0, 6.0], [3.0, 4.0], [1.0, 2.0]])
    reference = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.6, 0.8], [0.0, 1.0], [1.0, 0.0]])
    if apart is not None:
        reference[4] += [0.1 * apart, -apart]
    monkeypatch.setattr(columns, "listed_reference", lambda c: None if apart is None else reference)
    c = SimpleNamespace(readings=rows(6, values=values))
    said = columns.repeated_rows(c)
    assert said.rows == ("r0", "r2", "r1", "r4", "r5")
    if apart == 1.1e-6:
        assert said.text.startswith("positions r4 and r1 have")
    else:
        assert said.text.startswith("3 of 6 rows are")
    c.readings.values[:, 0] += np.arange(6.0)
    assert columns.repeated_rows(c) is None


@pytest.mark.parametrize(("tops", "others"), [(1, 6), (2, 3), (2, 6)])
def test_one_largest_reading_is_no_limit_and_few_others_say_nothing(tops, others):
    """Short by a third of the signal, of two and of more others than parameters."""
    x = np.array([1.0, 0.98, 0.4, -0.9, 0.1, -0.3, 0.05, -0.6])[: 2 + others]
    reference = np.column_stack([x, x**2, np.roll(x, 1)])
    values = 0.1 + reference @ [1.0, 0.02, 0.03]
    values[:2] = 0.7, 0.7 if tops == 2 else 0.69
    found = columns._clipped(reference, values)
    assert (found is not None) is (tops == 2 and others == 6)


# --- scales


@pytest.mark.parametrize(
    ("sizes", "unit", "found"),
    [
        ([1.0, 3.9], "V", True), ([1.0, 4.1], "V", False), ([0.34, 1.3], "g", True),
        ([0.32, 1.2], "g", False), ([0.8, 2.9], "g", True), ([0.8, 3.1], "g", False),
        ([335.0, 1000.0], "mg", True), ([9.0, 29.0], "m/s^2", True), ([9.0, 30.0], "m/s^2", False),
    ],
)  # fmt: skip
def test_outputs_that_respond_as_their_unit_says(sizes, unit, found):
    """Alike within four, and within three of what 1 g reads."""
    assert scales.are_of_unit(sizes, unit) is found


@pytest.mark.parametrize(
    ("value", "u", "said"),
    [(9.749, 0.0, True), (9.751, 0.0, False), (9.849, 0.0, False), (9.851, 0.0, True),
     (9.742, 0.01, False), (9.858, 0.01, False), (9.738, 0.01, True), (9.862, 0.01, True)],
)  # fmt: skip
def test_gravity_of_this_earth(value, u, said):
    c = SimpleNamespace(
        gravity=SimpleNamespace(value=value, u=u), field=SimpleNamespace(kind="gravity")
    )
    assert (scales.gravity(c) is not None) is said
    c.field.kind = "magnetic"
    assert scales.gravity(c) is None


@pytest.mark.parametrize(("value", "feet"), [(32.17, True), (31.8, False), (32.55, False)])
def test_gravity_in_feet(value, feet):
    c = SimpleNamespace(
        gravity=SimpleNamespace(value=value, u=0.0), field=SimpleNamespace(kind="gravity")
    )
    assert ("feet" in scales.gravity(c).text) is feet


@pytest.mark.parametrize(
    ("size", "unit", "said", "action"),
    [
        ((2.9, 3.05), "g", None, None),
        ((2.99, 3.05), "g", "not in g: 1 g reads 3.02, where 1 is expected", "no --unit."),
        ((0.32, 0.33), "g", "1 g reads 0.325, where 1 is", "no --unit."),
        ((0.335, 0.34), "g", None, None),
        ((6.2, 6.2), "g", "1 g reads 6.2", "State --unit m/s^2."),
        ((6.1, 6.1), "g", "1 g reads 6.1", "no --unit."),
        ((1.1, 1.1), "m/s^2", "1 g reads 1.1, where 9.80665 is", "State --unit g."),
        ((0.9, 1.6), "mg", "1 g reads 1.2, where 1000 is", "State --unit g."),
        ((0.9, 3.7), "mg", None, None),  # of unequal outputs one is to be mended first
        ((6.2, 6.2), "V", None, None),
    ],
)
def test_readings_in_another_unit_than_the_one_stated(size, unit, said, action):
    """Beyond three times what 1 g reads, by the geometric mean; within 1.6 of a unit that is it."""
    c = SimpleNamespace(model=SimpleNamespace(unit=unit))
    found = scales.unit(c, np.array([[0.6, 0.8, 0.0], [0.0, -0.6, 0.8]]) * np.array([size]).T)
    assert (found is None) is (said is None)
    if found:
        assert said in found.text
        assert action in found.action


def test_a_turn_in_words():
    vector = np.radians(50.0) * np.array([0.6, -0.8, 0.0])
    assert scales._rotation_in_words(vector) == "by 50 degrees about (0.60, -0.80, 0.00)"


# --- rows in another unit


@pytest.mark.parametrize(
    ("large", "count", "drowned"),
    [(1.1e12, 1, True), (0.9e12, 1, False), (1.1e12, 2, True), (1.1e12, 3, False)],
)
def test_readings_that_leave_others_no_digit_are_refused(large, count, drowned):
    """Beyond 10¹² times the median of what is not zero, which two of five do not move."""
    values = np.array([[1.0, 2.0], [2.0, 0.0], [4.0, 0.0]])
    values.flat[:count] = 2.0 * large
    values.flat[count:5] = 2.0
    readings = SimpleNamespace(values=values, source="", labels=("p", "q", "r"), outputs=("a", "b"))
    if not drowned:
        repairs.refuse_drowned(readings)
        return
    with pytest.raises(MultiposError, match=r"the readings: position p: a is 2\.2e\+12"):
        repairs.refuse_drowned(readings)


def test_rows_are_upside_down_that_are_nearer_to_the_other_side():
    """Σ ((y − ŷ)/|K|)² of each row as it is and turned, by least squares; of unlike outputs."""
    rng = np.random.default_rng(6)
    values = 0.3 + UP @ np.array([[2.0, 0.3], [0.2, 60.0], [0.5, -20.0]])
    values += [0.9, 25.0] * rng.standard_normal((14, 2))
    turned = np.array([1, 4, 9])
    values[[4, 9, 12]] -= 2.0 * (values[[4, 9, 12]] - 0.3)
    sign = np.ones(14)
    sign[turned] = -1.0
    X = np.column_stack([np.ones(14), sign[:, None] * UP])
    b = np.linalg.lstsq(X, values, rcond=None)[0]
    size = np.linalg.norm(b[1:], axis=0)
    here = np.sum(((values - X @ b) / size) ** 2, axis=1)
    there = np.sum(((values - X * [1.0, -1.0, -1.0, -1.0] @ b) / size) ** 2, axis=1)
    view = repairs.View(np.ones((14, 1)), UP, values)
    found = repairs._upside_down(view, turned)
    assert found.tolist() == np.where(there < here, sign > 0.0, sign < 0.0).tolist()
    assert 0 < found.sum() < 14


# --- a field


def test_directions_that_no_reading_is_near():
    """Of 26 those over 60° from any, the farthest first, and how far that is."""
    seen = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    every = mp.read_scheme("all-26").up
    angle = np.degrees(np.arccos(np.clip(every @ seen.T, -1.0, 1.0))).min(axis=1)
    found, gap = magnetic.missing_directions(seen)
    assert len(found) == np.count_nonzero(angle > 60.0 + 1e-9)
    far = np.degrees(np.arccos(np.clip(found @ seen.T, -1.0, 1.0))).min(axis=1)
    assert_allclose(far, np.sort(angle[angle > 60.0 + 1e-9])[::-1], atol=1e-6)
    assert gap == pytest.approx(angle.max())
    assert len(magnetic.missing_directions(every)[0]) == 0
    c = SimpleNamespace(reference=48.0 * seen)
    assert f"within {angle.max():.0f} degrees" in magnetic.sphere_gap(c).text
    assert magnetic.sphere_gap(SimpleNamespace(reference=every)) is None


@pytest.mark.parametrize(
    ("bump", "fewer", "said"),
    [(0.02, 1.0, "larger"), (-0.02, 1.0, "smaller"), (0.02, 16.0, None), (0.0025, 1.0, None)],
)
def test_a_part_of_the_sphere_whose_field_is_another(bump, fewer, said, monkeypatch):
    """Means of the five nearest of sixty over their noise; half of the limit names a row."""
    u = mp.read_scheme("fibonacci-60").up
    left = 3e-3 * np.cos(1.7 * np.arange(60.0)) + bump * (u @ u[20] > 0.85)
    monkeypatch.setattr(magnetic, "_left", lambda c, readings: (u, None, left, fewer))
    found = magnetic.disturbance(SimpleNamespace(readings=rows(60)))
    sd = np.median(np.abs(left - np.median(left))) / 0.6745
    near = np.argsort(-(u @ u.T), axis=1)[:, :5]
    means = left[near].mean(axis=1)
    score = means * math.sqrt(5.0 / fewer) / sd
    worst, limit = int(np.argmax(np.abs(score))), norm.isf(0.002 / 120.0)
    assert (abs(score[worst]) > limit) == (said is not None)
    assert (found is not None) == (said is not None)
    if found:
        side = math.copysign(1.0, bump)
        named = np.flatnonzero((side * score > limit / 2.0) & (u @ u[worst] > 0.5))
        assert found.rows == tuple(f"r{row}" for row in named)
        assert f"field is {100.0 * abs(means[worst]):.2g} % {said} than" in found.text


# --- terms as one


def test_what_terms_explain_by_kinds():
    """b'G⁻¹b of each kind's columns, however long they are; what is nothing counts as none."""
    rng = np.random.default_rng(4)
    V = rng.normal(size=(20, 6)) * [1.0, 1e3, 1.0, 1e-2, 1.0, 1.0]
    V[:, 5] = 0.0
    e, kind_of = rng.normal(size=20), np.array([0, 1, 0, 2, 2, 2])
    size = np.sum(V**2, axis=0) * 4.0
    explained, q, least = score_tests._explained(V.T @ V, V.T @ e, size, kind_of, 3)
    for kind in range(3):
        mine = V[:, kind_of == kind] / np.where(size > 0.0, np.sqrt(size), 1.0)[kind_of == kind]
        values = np.linalg.eigvalsh(mine.T @ mine)
        assert explained[kind] == pytest.approx(e @ mine @ np.linalg.pinv(mine) @ e, rel=1e-8)
        assert q[kind] == np.count_nonzero(values > 1e-8)
        assert least[kind] == pytest.approx(values[0], abs=1e-12)
        T = score_tests._identifiable(V.T @ V, size, kind_of == kind)
        assert_allclose(T.T @ V.T @ V @ T, np.eye(int(q[kind])), atol=1e-9)
        assert not T[kind_of != kind].any()


def test_what_steps_and_tilt_add_to_the_objective():
    """Σ (step/sd)² and Σ (tilt/sd)², where there is a prior."""
    found = SimpleNamespace(
        orientation_error_deg=np.array([0.3, np.nan, -0.4]),
        level_tilt_deg=np.array([0.03, -0.04]), level_sd_deg=0.02,
    )  # fmt: skip
    problem = SimpleNamespace(has_prior=True, prior=np.array([100.0, 50.0, 400.0]))
    c = SimpleNamespace(orientations=found)
    steps = 100.0 * math.radians(0.3) ** 2 + 400.0 * math.radians(0.4) ** 2
    assert score_tests._of_priors(c, problem) == pytest.approx(steps + 1.5**2 + 2.0**2)
    found.level_sd_deg = None
    assert score_tests._of_priors(c, problem) == pytest.approx(steps)
    problem.has_prior = False
    assert score_tests._of_priors(c, problem) == 0.0


def test_tests_of_fewer_rows():
    test = ModelTest("own^2", ("a", "b"), (8.0, 6.0), ((1.0, 20.0), (2.0, 3.0)))
    fewer = score_tests._of_fewer(test, 0.25)
    assert fewer.ratios == (2.0, 1.5)
    assert fewer.dofs == ((1.0, 5.0), (2.0, 1.0))


def test_noise_of_outputs_that_is_the_same_in_all_rows():
    noise = np.tile([4.0, 0.25], 3)
    c = SimpleNamespace(noise=noise, readings=rows(3), residuals=np.zeros((3, 2)))
    assert projections.is_level(c)
    assert_allclose(projections.level_of(c), [0.5, 2.0])
    for other in (noise * [1.0, 1.0, 1.0, 1.01, 1.0, 1.0], np.diag(noise), None):
        c.noise = other
        assert not projections.is_level(c)
        assert projections.level_of(c) == 1.0


# --- noise beyond what was stated


@pytest.mark.parametrize(("share", "said"), [(0.99, False), (1.01, True)])
def test_a_stated_noise_is_rejected_by_chi_square(share, said, monkeypatch):
    monkeypatch.setattr(residuals, "_cause", lambda c: ("a cause", "An action."))
    claim = SimpleNamespace(chi2=share * chi2.isf(1.0 - REJECTED, 9.0), dof=9.0)
    scatter = {"a": SimpleNamespace(value=2e-4), "b": SimpleNamespace(value=3e-4)}
    c = SimpleNamespace(
        diagnostics=SimpleNamespace(claim=claim), model=SimpleNamespace(unit="V"),
        variance_components=SimpleNamespace(rest_to_rest=scatter),
    )  # fmt: skip
    found = residuals.rejected_noise(c)
    assert (found is not None) is said
    if said:
        assert found.p == pytest.approx(chi2.sf(claim.chi2, 9.0), rel=1e-9)
        assert f"({p_in_words(found.p)}); U includes up to 0.0003 V of it; a cause" in found.text
        scatter["a"] = scatter["b"]
        assert "; U includes an excess of 0.0003 V; a cause" in residuals.rejected_noise(c).text
        c.variance_components = None
        assert "; U was increased; a cause" in residuals.rejected_noise(c).text


@pytest.mark.parametrize(("p", "said"), [(0.009, True), (0.011, False)])
def test_the_noisiest_output_is_named_beside_the_quietest(p, said, monkeypatch):
    monkeypatch.setattr(residuals, "judge_equality", lambda c, _: (p, np.array([3.0, 0.5, 4.0])))
    monkeypatch.setattr(residuals, "significant", lambda tests: ())
    c = SimpleNamespace(
        estimator=SimpleNamespace(exact=False), robust_weight=None, outputs=("a", "b", "c"),
        diagnostics=SimpleNamespace(model_tests=()), readings=SimpleNamespace(noise=None),
    )  # fmt: skip
    found = residuals.unequal_noise(c)
    assert (found is not None) is said
    if said:
        assert found.text.startswith("c is 8 times as noisy as b (p = 0.0090); its U")
    c.outputs = ("a",)
    assert residuals.unequal_noise(c) is None
