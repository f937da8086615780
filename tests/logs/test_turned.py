"""Logs of an accelerometer that is turned all the time: what is fitted of them, and its U."""

import numpy as np
import pytest
from log_bench import hand_turned
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import multipos as mp
from multipos.errors import MultiposError
from multipos.logs.ellipsoids import covers, fit_ellipsoid, usual_turn
from multipos.logs.turned import _middles, _samples_of_a_window, _turn_rates, _without_arm
from multipos.units import STANDARD_GRAVITY

OUTPUTS = ("ax", "ay", "az")


def columns(values, *, timed=True):
    time = {"time": np.arange(len(values)) / 100.0} if timed else {}
    return time | dict(zip(OUTPUTS, values.T, strict=True))


def by_all_samples(values):
    """The same parameters by least squares of |f| over all samples alike (Gauss and Newton)."""
    theta = np.array([0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])

    def misfit(p):
        bias, M = p[[0, 2, 5]], np.array([[p[1], 0, 0], [p[3], p[4], 0], p[6:]])
        return np.linalg.norm(np.linalg.solve(M, (values - bias).T), axis=0) - 1.0

    for _ in range(12):
        e = misfit(theta)
        slopes = np.column_stack([(misfit(theta + d) - e) / 1e-6 for d in 1e-6 * np.eye(9)])
        theta = theta - np.linalg.lstsq(slopes, e, rcond=None)[0]
    return theta


@pytest.fixture(scope="module")
def turned():
    return hand_turned(np.random.default_rng(2))


def test_u_covers_and_the_error_is_below_that_of_all_samples_alike():
    rng = np.random.default_rng(66)
    off, others, U = [], [], []
    for _ in range(30):
        values, truth = hand_turned(rng)
        cal = mp.calibrate(columns(values), unit="g")
        assert [each.code for each in cal.findings if each.level != "note"] == ["no-rests"]
        off.append(cal.parameters - truth)
        others.append(by_all_samples(values) - truth)
        U.append(cal.U)
    covered = np.abs(off) <= U
    # of 30 logs of nine parameters: 90 and 80 % less two standard deviations
    assert 0.86 < covered.mean() < 0.995
    assert covered.mean(axis=0).min() > 0.66
    rms = [np.sqrt(np.mean(np.square(each), axis=0)) for each in (off, others)]
    assert np.mean(rms[0] / rms[1]) < 0.7


def test_neither_time_nor_unit_is_needed(turned):
    values, _ = turned
    cal = mp.calibrate(columns(values), unit="g")
    plain = mp.calibrate(columns(STANDARD_GRAVITY * values, timed=False), unit="m/s^2")
    assert_allclose(plain.parameters, STANDARD_GRAVITY * cal.parameters, rtol=1e-7)
    assert_allclose(plain.U, STANDARD_GRAVITY * cal.U, rtol=1e-6)
    assert cal.dof.tolist() == [12.0] * 3  # 24 blocks, nine parameters and the arm
    assert cal.effective_rows["ax"] < len(cal.readings)
    (found,) = [each for each in cal.findings if each.code == "no-rests"]
    assert "weighted by how slowly it turns; U is 19 to 79 times that of rests" in found.text


def test_a_fleet_has_the_numbers_of_each(turned, tmp_path):
    values, _ = turned
    path = tmp_path / "one.csv"
    mp.write_table(path, columns(values))
    cal = mp.calibrate(path)
    fleet = mp.fleet([path], raw=True).calibrations
    for each in cal.entries:
        assert_allclose(fleet[each.name], each.value, rtol=1e-9)
        assert_allclose(fleet[f"u_{each.name}"], each.u, rtol=1e-9)


def test_rests_that_turn_are_no_rests(turned):
    values, _ = turned
    with pytest.raises(MultiposError, match="no rest"):
        mp.average(columns(values))
    with pytest.raises(MultiposError, match="no rest"):  # of several logs each has a rest, or more
        mp.calibrate(columns(values), columns(values[::-1]))
    with pytest.raises(MultiposError, match="no rest"):  # 240 windows at least
        mp.calibrate(columns(values[:400]))


def test_a_part_of_the_sphere_does_not_do(turned):
    values, _ = turned
    assert covers(values)
    assert not covers(values[values[:, 0] > 0.9])
    assert not covers(np.random.default_rng(1).standard_normal((500, 3)))
    assert not covers(values[:, :2])


def test_single_poses_are_sent_to_fit(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(3)
    up = rng.standard_normal((300, 3))
    up /= np.linalg.norm(up, axis=1)[:, None]
    rows = [0.04, -0.03, 0.06] + up * [1.01, 0.99, 1.02] + 2e-3 * rng.standard_normal((300, 3))
    np.savetxt("points.csv", rows, delimiter=",")
    line = "multipos fit points.csv --unknown-orientation"
    for command in (mp.calibrate, mp.average):
        with pytest.raises(MultiposError, match=f"each is a position.*type {line}"):
            command("points.csv")
    cal = mp.fit("points.csv", unknown_orientation=True)
    assert_allclose(cal.parameters[[0, 2, 5]], [0.04, -0.03, 0.06], atol=1e-3)


# --- equations by hand


def test_an_ellipsoid_and_what_grows_with_the_square_of_the_turn_rate():
    up = mp.read_scheme("fibonacci-400").up
    square = np.random.default_rng(4).random(400)
    M = np.array([[30.0, 2.0, 0.0], [0.0, 40.0, 3.0], [1.0, 0.0, 50.0]])
    arm = np.array([0.3, -0.2, 0.5])
    values = [7.0, -20.0, 11.0] + np.outer(square, arm) + up @ M.T
    found = fit_ellipsoid(values, square=square)
    found = fit_ellipsoid(values, square=square, about=found.centre)
    assert_allclose(found.centre, [7.0, -20.0, 11.0], atol=0.01)
    assert_allclose(found.arm, arm, atol=0.02)
    assert_allclose(found.root @ found.root.T, np.linalg.inv(M @ M.T), rtol=2e-3)


def test_an_ellipsoid_by_its_equation():
    """Rows that solve the equation to the last digit, about the centre itself."""
    # eq. (1) of logs.ellipsoids
    up = mp.read_scheme("fibonacci-100").up
    square = np.random.default_rng(6).random(100)
    M = np.array([[3.0, 0.2, 0.0], [0.0, 4.0, 0.3], [0.1, 0.0, 5.0]])
    b, a, A = np.array([0.7, -2.0, 1.1]), np.array([0.5, -0.7, 0.9]), np.linalg.inv(M @ M.T)
    # (y − b − ω² a)'A (y − b − ω² a) = 1 + ω⁴ a'A a, the square made complete
    d = np.outer(square, a) + np.sqrt(1.0 + square**2 * (a @ A @ a))[:, None] * (up @ M.T)
    left = np.einsum("ki,ij,kj->k", d, A, d) - 2.0 * square * (d @ A @ a)
    assert_allclose(left, 1.0, rtol=1e-12)
    found = fit_ellipsoid(b + d, square=square, about=b)
    assert_allclose(found.centre, b, rtol=1e-9)
    assert_allclose(found.arm, a, rtol=1e-9)
    assert_allclose(found.root @ found.root.T, A, rtol=1e-9, atol=1e-12)


def path_of_a_proof_mass(arm, seconds=400.0, rate=100.0):
    """The force (n, 3) [g] on a proof mass at an arm [m], in the axes of a case that turns."""

    def case(t):
        phase = t + 3.0 * np.sin(t / 5.0)  # at 0.4 to 1.6 of the mean rate
        one, other = Rotation.from_rotvec(np.outer(0.61 * phase, [1.0, 0.0, 0.0])), 0.23 * phase
        return (one * Rotation.from_rotvec(np.outer(other, [0.0, 0.0, 1.0]))).as_matrix()

    t, d = np.arange(seconds * rate) / rate, 1e-3
    speeding = (case(t + d) - 2.0 * case(t) + case(t - d)) @ arm / d**2  # of the path in the room
    turned_back = case(t).transpose(0, 2, 1)
    return turned_back[:, :, 2] + np.einsum("kij,kj->ki", turned_back, speeding) / STANDARD_GRAVITY


def test_the_arm_of_a_proof_mass_by_its_path():
    """Its acceleration is that of its path in the room; along −r grows what does not average."""
    # eq. (1) of logs.turned
    r = np.array([0.04, -0.03, 0.05])
    M = np.array([[1.02, 0.0, 0.0], [0.03, 0.97, 0.0], [-0.02, 0.01, 1.01]])
    values = [0.05, -0.02, 0.03] + path_of_a_proof_mass(r) @ M.T
    h = _samples_of_a_window(values)
    middles = _middles(values, h)
    at_rest, _, turn = _without_arm(middles, fit_ellipsoid(middles))
    a = np.linalg.lstsq(turn[:, None] ** 2, middles - at_rest, rcond=None)[0][0]
    per_window = np.radians(100.0 / h)  # of a degree a window, in rad/s
    assert_allclose(a, -(per_window**2) * (M @ r) / STANDARD_GRAVITY, rtol=0.1)


def windows_of_a_path(count):
    """Directions (k, 3) that turn by 1 to 4 degrees each, and their ω (k,) [degrees]."""
    k = np.arange(count)
    phase = np.cumsum(np.radians(np.clip(2.5 + 2.0 * np.sin(k / 7.0), 1.0, 4.0)))
    tilt = 0.13 * phase
    f = np.column_stack([np.cos(phase), np.sin(phase) * np.cos(tilt), np.sin(phase) * np.sin(tilt)])
    over_two = np.degrees(np.arccos(np.einsum("ki,ki->k", f[2:], f[:-2])))
    return f, np.concatenate([over_two[:1], over_two, over_two[-1:]]) / 2.0


def test_readings_without_what_grows_with_the_square_of_the_turn_rate():
    # eq. (3) of logs.turned
    f, turn = windows_of_a_path(1200)
    M = np.array([[1.02, 0.0, 0.0], [0.03, 0.97, 0.0], [-0.02, 0.01, 1.01]])
    a = np.array([3e-5, -2e-5, 4e-5])
    turn = np.minimum(turn, np.quantile(turn, 0.99))
    still = [0.05, -0.02, 0.03] + f @ M.T
    middles = still + np.outer(turn**2, a)
    at_rest, _, found = _without_arm(middles, fit_ellipsoid(middles))
    assert_allclose(found, turn, rtol=1e-6)
    # the second order of a ω² is left, (7e-4)²/2
    assert_allclose(at_rest, still, rtol=0, atol=3e-7)


def test_u_of_windows_by_groups_of_their_turn_rate():
    # eq. (4) of logs.turned
    rng = np.random.default_rng(8)
    f, turn = windows_of_a_path(1200)
    size = 1e-3 * turn * rng.standard_t(3.0, 1200)  # as a hand gives jolts
    middles = [0.05, -0.02, 0.03] + (1.0 + size)[:, None] * f * [1.02, 0.97, 1.01]
    values, u, found = _without_arm(middles, fit_ellipsoid(middles))
    form = fit_ellipsoid(values, weight=1.0 / u[:, 0])
    r = np.linalg.norm((values - form.centre) @ form.root, axis=1) - 1.0
    by_hand = np.empty(1200)
    for group in np.argsort(found, kind="stable").reshape(12, 100):
        sigma = np.median(np.abs(r[group])) / 0.6745
        by_hand[group] = sigma * np.maximum(1.0, np.abs(r[group]) / (1.5 * sigma)) ** 0.5
    c = np.sqrt(np.sum((r / by_hand) ** 2) / (1200 - 12))  # nine parameters and a
    of_misfit = u * np.linalg.norm(form.root, axis=1)
    assert_allclose(of_misfit, np.tile(c * by_hand[:, None], 3), rtol=0.01)
    assert by_hand.max() > 5.0 * by_hand.min()


def test_a_window_in_its_middle_and_its_turn_rate(turned):
    # eq. (2) of logs.turned
    angle = 0.01 * np.arange(8000)  # per row
    values = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    middles = _middles(values, 8)
    middle = 0.01 * (8.0 * np.arange(1, 999) + 3.5)
    along = np.column_stack([np.cos(middle), np.sin(middle)])
    # terms of the fourth order in the turn of a window are left, 0.08⁴/500
    assert_allclose(middles[:, :2], along, atol=2e-7)
    assert_allclose(_turn_rates(middles), np.degrees(0.08), rtol=1e-3)
    values, _ = turned
    h = _samples_of_a_window(values)
    rows = len(values) // (2 * h) * 2 * h
    turn = [usual_turn(values[:rows].reshape(-1, k, 3).mean(axis=1)) for k in (h, 2 * h)]
    assert turn[0] < 4.0 < turn[1]


def test_u_is_that_of_leaving_blocks_out(turned):
    # eq. (6) of estimation.correlated_rows
    values, _ = turned
    cal = mp.calibrate(columns(values), unit="g")
    readings = cal.readings
    still = readings.columns() | {"turn_rate": 0.0 * readings.environment["turn_rate"]}
    whole = mp.fit(still, unit="g", unknown_orientation=True)
    moved = []
    for block in np.array_split(np.arange(len(readings)), 24):
        left = {n: np.delete(np.asarray(c, dtype=float), block) for n, c in still.items()}
        moved.append(mp.fit(left, unit="g", unknown_orientation=True).parameters - whole.parameters)
    by_hand = np.sqrt(23.0 / 24.0 * np.sum(np.square(moved), axis=0))
    assert_allclose([each.u for each in whole.entries], by_hand, rtol=0.03)


def test_u_with_an_uncertain_arm_by_leaving_blocks_out(turned):
    """Twelve columns by differences, and least squares of the rows that are left."""
    # eq. (6) of estimation.correlated_rows
    cal = mp.calibrate(columns(turned[0]), unit="g")
    y, square = cal.readings.values, cal.readings.environment["turn_rate"] ** 2
    square = square / square.max()

    def field(p):
        M = np.array([[p[1], 0, 0], [p[3], p[4], 0], p[6:9]])
        return np.linalg.solve(M, (y - p[[0, 2, 5]] - np.outer(square, p[9:])).T)

    def misfit(p):
        return np.linalg.norm(field(p), axis=0) - 1.0

    p = np.append(cal.parameters, np.zeros(3))
    M = np.array([[p[1], 0, 0], [p[3], p[4], 0], p[6:9]])
    along = field(p) / (1.0 + misfit(p))
    u = np.linalg.norm(np.linalg.solve(M.T, along).T * cal.readings.u, axis=1)
    X = np.column_stack([(misfit(p - d) - misfit(p + d)) / 2e-6 for d in 1e-6 * np.eye(12)])
    X, e = X / u[:, None], misfit(p) / u
    moved = []
    for block in np.array_split(np.arange(len(e)), 24):
        left = np.setdiff1d(np.arange(len(e)), block)
        inverse = np.linalg.inv(X[left].T @ X[left])
        moved.append((inverse @ X[block].T @ e[block])[:9])
    by_hand = np.sqrt(23.0 / 24.0 * np.sum(np.square(moved), axis=0))
    assert_allclose([each.u for each in cal.entries], by_hand, rtol=0.01)


@pytest.mark.parametrize(
    ("size", "line"),
    [
        (48.0, "log.csv --field magnetic."),
        (0.48, "log.csv --field magnetic."),
        (150.0, "log.csv --field magnetic, or multipos calibrate log.csv --unit count for an "),
        (256.0, ""),
        (9.8, ""),
    ],
)
def test_a_sphere_without_names_is_known_by_its_radius(size, line, turned, tmp_path):
    values = size * turned[0]
    path = tmp_path / "log.csv"
    np.savetxt(path, values, delimiter=",", header="x,y,z", comments="")
    if not line:
        assert "no-rests" in {each.code for each in mp.calibrate(path).findings}
        return
    with pytest.raises(mp.MultiposError, match="sphere of radius") as refused:
        mp.calibrate(path)
    assert f"type multipos calibrate {line}" in str(refused.value)
    assert "hold" not in str(refused.value)
    assert mp.calibrate(path, field="magnetic").field.kind == "magnetic"
