"""Rolls of open angle, estimated with the sensor: against the truth, a dense search, and chance."""

import numpy as np
import pytest
from findings_bench import texts
from numpy.testing import assert_allclose
from scipy.optimize import least_squares

import multipos as mp
from multipos.estimation.gains import estimator_gain
from multipos.estimation.likelihood import eliminate
from multipos.estimation.problem import circle_basis, over_circle, turn_about

BIAS = np.array([0.02, -0.01, 0.03])
MATRIX = np.array([[1.02, 0.012, -0.02], [0.015, 0.98, 0.01], [-0.008, 0.02, 1.01]])
SD = 1e-4  # [g] of a reading
NAMES = ("ax", "ay", "az")


def on_cone(axis, angle, beta=0.0):
    """Up vectors (n, 3) of rolls about an axis that points up by beta [rad]."""
    i = "xyz".index(axis)
    p, q = (k for k in range(3) if k != i)
    up = np.zeros((len(angle), 3))
    up[:, i], up[:, p] = np.sin(beta), np.cos(beta) * np.cos(angle)
    up[:, q] = np.cos(beta) * np.sin(angle)
    return up


def anywhere(rng, n):
    up = rng.standard_normal((n, 3))
    return up / np.linalg.norm(up, axis=1)[:, None]


def angles(rng, n):
    return rng.uniform(0.0, 2.0 * np.pi, n)


def read(up, noise=0.0):
    return dict(zip(NAMES, (up @ MATRIX.T + BIAS + noise).T, strict=True))


def pointer(rng, leans=(-0.15, 0.3)):
    """Eight shots anywhere, and eight about y at each of two marks, as of a cave pointer."""
    up = np.concatenate([anywhere(rng, 8), *(on_cone("y", angles(rng, 8), b) for b in leans)])
    said = {
        "roll_axis": [""] * 8 + ["y"] * 16,
        "orientation_sd_deg": [""] * 8 + ["0"] * 16,
        "group": [""] * 8 + ["a"] * 8 + ["b"] * 8,
    }
    return up, said


def level(rng):
    """Rolls about level axes, eight about each."""
    up = np.concatenate([on_cone(axis, angles(rng, 8)) for axis in "xyz"])
    return up, {"roll_axis": ["x"] * 8 + ["y"] * 8 + ["z"] * 8}


def beside_known(rng):
    """Four known rolls about each axis, and twelve about x whose axis is level to one degree."""
    quarters = np.radians([0, 90, 180, 270])
    off = np.radians(1.0) * rng.standard_normal(12)
    open_ = [on_cone("x", angles(rng, 1), beta) for beta in off]
    up = np.concatenate([*(on_cone(axis, quarters) for axis in "xyz"), *open_])
    said = {
        "roll_axis": ["x"] * 4 + ["y"] * 4 + ["z"] * 4 + ["x"] * 12,
        "angle_deg": ["0", "90", "180", "270"] * 3 + [""] * 12,
        "orientation_sd_deg": ["0"] * 12 + ["1"] * 12,
    }
    return up, said


def truth(cal):
    """The parameters in the frame of a fit: a rotation about the axis of all rolls is free."""
    gauge = cal.model.gauge
    matrix = MATRIX if gauge is None else MATRIX @ turn_about(gauge[-1], MATRIX).T
    whole = {
        (name, term): value
        for name, row in zip(NAMES, np.column_stack([BIAS, matrix]), strict=True)
        for term, value in zip(("1", "x", "y", "z"), row, strict=True)
    }
    return np.array([whole[output, str(term)] for output, term in cal.model.keys])


@pytest.mark.parametrize("convention", ["specific-force", "gravity"])
@pytest.mark.parametrize(
    ("session", "gauge"), [(pointer, "roll-y"), (level, None), (beside_known, None)]
)
def test_the_truth_is_found_without_noise(session, gauge, convention):
    up, said = session(np.random.default_rng(5))
    sign = 1.0 if convention == "specific-force" else -1.0
    if session is beside_known:
        said = {**said, "orientation_sd_deg": ["0"] * 24}
        up = np.concatenate([up[:12], on_cone("x", angles(np.random.default_rng(2), 12))])
    cal = mp.fit({**said, **read(sign * up)}, convention=convention)
    assert cal.model.gauge == gauge
    # rounding of the readings, some 1e-16, through a search that ends at 1e-8 of a rounding's u
    assert_allclose(cal.parameters, truth(cal), atol=1e-9)
    if gauge is None:
        assert_allclose(cal.reference, sign * up, atol=1e-9)
    else:
        found = cal.orientations.inclination_deg
        assert_allclose([found["a"], found["b"]], np.degrees([-0.15, 0.3]), atol=1e-6)


def test_an_output_that_is_said_to_face_down_does_where_rolls_alone_tell_the_case():
    """Rolls leave the sense of each axis open, and with it that of their inclination."""
    rng = np.random.default_rng(3)
    leans = {"x": 0.2, "y": -0.1, "z": 0.3}
    up = np.concatenate([on_cone(axis, angles(rng, 8), beta) for axis, beta in leans.items()])
    matrix = MATRIX * [1.0, 1.0, -1.0]
    values = dict(zip(NAMES, (up @ matrix.T + BIAS).T, strict=True))
    rolled = {"roll_axis": [*"xxxxxxxxyyyyyyyyzzzzzzzz"], "group": [*"xxxxxxxxyyyyyyyyzzzzzzzz"]}
    cal = mp.fit({**rolled, **values}, axes="x,y,-z")
    assert_allclose(cal.sensitivity, matrix, atol=1e-9)
    assert_allclose(cal.reference, up, atol=1e-9)
    found = cal.orientations.inclination_deg
    assert_allclose([found[axis] for axis in leans], np.degrees([*leans.values()]), atol=1e-6)
    assert not any(each.level == "error" for each in cal.findings)


def test_all_angles_as_unknowns_of_one_search_give_the_same():
    # eq. (1) of estimation.problem
    rng = np.random.default_rng(8)
    up, said = pointer(rng)
    noise = SD * rng.standard_normal((24, 3))
    cal = mp.fit({**said, **read(up, noise)})
    values = np.column_stack(list(read(up, noise).values()))
    places = [(NAMES.index(o), ("1", "x", "y", "z").index(str(t))) for o, t in cal.model.keys]
    force = cal.reference
    free = np.column_stack([np.arccos(force[:8, 2]), np.arctan2(force[:8, 1], force[:8, 0])])
    rolled = np.arctan2(force[8:, 2], force[8:, 0])
    lean = np.arcsin(force[[8, 16], 1])

    def residuals(unknown):
        theta, two, roll, beta = np.split(unknown, [11, 27, 43])
        table = np.zeros((3, 4))
        for place, value in zip(places, theta, strict=True):
            table[place] = value
        polar, azimuth = two.reshape(8, 2).T
        sphere = np.column_stack(
            [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
        )
        cones = [on_cone("y", roll[:8], beta[0]), on_cone("y", roll[8:], beta[1])]
        up = np.concatenate([sphere, *cones])
        return (values - table[:, 0] - up @ table[:, 1:].T).ravel()

    start = np.concatenate([cal.parameters, free.ravel(), rolled, lean])
    found = least_squares(residuals, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    u = np.sqrt(np.diag(cal.covariance))
    assert np.abs(found.x[:11] - cal.parameters).max() < 1e-3 * u.min()  # of finite differences
    dof = 72 - len(start)
    whole = np.linalg.inv(found.jac.T @ found.jac) * np.sum(found.fun**2) / dof
    assert cal.dof[0] == dof == 27
    assert_allclose(np.sqrt(np.diag(whole)[:11]), u, rtol=1e-4)


@pytest.mark.parametrize("session", [pointer, beside_known])
def test_parameters_follow_readings_of_rolls_that_lean_as_fits_of_changed_readings_do(session):
    rng = np.random.default_rng(8)
    up, said = session(rng)
    noise = SD * rng.standard_normal(up.shape)

    def parameters(k, j, change):
        moved = noise.copy()
        moved[k, j] += change
        return mp.fit({**said, **read(up, moved)}, reading_sd=SD).parameters

    cal = mp.fit({**said, **read(up, noise)}, reading_sd=SD)
    gain = estimator_gain(cal).reshape(-1, len(up), 3)
    for k, j in ((0, 1), (12, 0), (14, 1), (20, 2)):
        slope = (parameters(k, j, 1e-6) - parameters(k, j, -1e-6)) / 2e-6
        # second order: residuals times the curvature of the sphere, some 1e-4 of a slope
        assert_allclose(gain[:, k, j], slope, atol=1e-3)


def test_an_angle_that_is_free_is_eliminated_as_by_a_wide_prior():
    # eq. (2) of estimation.problem
    rng = np.random.default_rng(4)
    A = rng.standard_normal((6, 3, 3))
    precision = A @ A.transpose(0, 2, 1)
    J = rng.standard_normal((6, 3, 2))
    s = 0.3
    found = eliminate(
        precision, J, precision @ J, np.full(6, s**-2), np.zeros(6, bool), np.ones(6, bool)
    )
    # the inverse of what readings scatter by, with an sd of 1e5 for the first angle: the rest is
    # 1e-10 of that, and the inverse of so ill a matrix is good to some 1e-6
    variance = np.linalg.inv(precision) + J @ np.diag([1e10, s**2]) @ J.transpose(0, 2, 1)
    assert_allclose(found.marginal, np.linalg.inv(variance), atol=2e-4)
    H = J.transpose(0, 2, 1) @ precision @ J + np.diag([0.0, s**-2])
    assert_allclose(found.inverse @ H, np.tile(np.eye(2), (6, 1, 1)), atol=1e-9)
    assert_allclose(found.gain, precision @ J @ np.linalg.inv(H), rtol=1e-8)


def test_a_direction_stands_over_its_circle():
    up = on_cone("z", np.array([0.3, 2.0]), 0.4)
    axis = np.tile([0.0, 0.0, 1.0], (2, 1))
    foot, latitude = over_circle(up, axis)
    assert_allclose(foot, on_cone("z", np.array([0.3, 2.0])), atol=1e-15)
    assert_allclose(latitude, 0.4)
    along, towards = np.moveaxis(circle_basis(foot, axis), 2, 0)
    assert_allclose(towards, axis, atol=1e-15)
    assert_allclose(along, on_cone("z", np.array([0.3, 2.0]) + np.pi / 2), atol=1e-15)


def test_rolls_carry_the_alignment_and_are_kept_in_a_file(tmp_path):
    rng = np.random.default_rng(7)
    up, said = pointer(rng)
    columns = read(up, SD * rng.standard_normal((24, 3)))
    cal = mp.fit({**said, **columns})
    blind = mp.fit(columns, unknown_orientation=True)
    assert "cross_ay_z" in cal.model.names  # how the y sensor leans from the axis of the rolls
    assert "cross_ay_z" not in blind.model.names
    cal.save(tmp_path / "cal.json")
    again = mp.load(tmp_path / "cal.json")
    assert again.to_dict() == cal.to_dict()
    assert again.readings.open_roll == cal.readings.open_roll
    assert again.orientations.inclination_deg == cal.orientations.inclination_deg
    # the problem as stated again has its minimum where the fit ended: JCGM 101 from the file agrees
    trials = mp.simulate_budget(again, trials=150, rng=1)
    u = np.sqrt(np.diag(cal.covariance))
    ratio = np.asarray(trials.u) / u  # 1.04 of t with 27 degrees of freedom, to 6 % in 150 trials
    assert np.all((ratio > 0.8) & (ratio < 1.3))


def test_a_model_of_ones_own_holds_what_the_rolls_leave_free():
    """Rolls about x beside free positions: the formula's fit, with one slope held."""
    rng = np.random.default_rng(3)
    up = np.concatenate([on_cone("x", angles(rng, 12)), anywhere(rng, 14)])
    said = {"roll_axis": ["x"] * 12 + [""] * 14, "orientation_sd_deg": ["0"] * 12 + [""] * 14}
    columns = {**said, **read(up, SD * rng.standard_normal(up.shape))}
    plain = mp.fit(columns)
    own = mp.fit(columns, model="each = b + p*x + q*y + r*z")
    assert plain.model.gauge == "roll-x"
    assert len(own.parameters) == len(plain.parameters) == 11
    assert any("a rotation of the case is free" in text for text in texts(own))
    names = {"1": "b", "x": "p", "y": "q", "z": "r"}
    for output, term in plain.model.keys:
        same = own[output, names[str(term)]]
        assert abs(same.value - plain[output, str(term)].value) < 1e-3 * same.u


@pytest.mark.slow
@pytest.mark.parametrize("session", [pointer, level, beside_known])
@pytest.mark.usefixtures("without_findings")
def test_the_truth_is_covered(session):
    rng = np.random.default_rng(11)
    hits = []
    for _ in range(120):
        up, said = session(rng)
        cal = mp.fit({**said, **read(up, SD * rng.standard_normal(up.shape))})
        U = np.array([cal[output, str(term)].U for output, term in cal.model.keys])
        hits.append(np.abs(cal.parameters - truth(cal)) <= U)
    # nominal .95; of 120 fits with some five independent parameters 600: ± .03 is three sigma
    assert 0.92 < np.mean(hits) < 0.98
