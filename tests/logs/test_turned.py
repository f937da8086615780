"""Logs of an accelerometer that is turned all the time: what is fitted of them, and its U."""

import numpy as np
import pytest
from log_bench import hand_turned
from numpy.testing import assert_allclose

import multipos as mp
from multipos.errors import MultiposError
from multipos.logs.ellipsoids import covers, fit_ellipsoid, usual_turn
from multipos.logs.turned import (
    _middles,
    _samples_of_a_window,
    _sd_by_rate,
    _turn_rates,
    _without_arm,
)
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
    # eq. (1) of logs.turned: the generator has a lever arm, a tremor and a hand
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
    # eq. (3) of logs.turned
    # eq. (1) of logs.ellipsoids
    values = [7.0, -20.0, 11.0] + np.outer(square, arm) + up @ M.T
    found = fit_ellipsoid(values, square=square)
    found = fit_ellipsoid(values, square=square, about=found.centre)
    assert_allclose(found.centre, [7.0, -20.0, 11.0], atol=0.01)
    assert_allclose(found.arm, arm, atol=0.02)
    assert_allclose(found.root @ found.root.T, np.linalg.inv(M @ M.T), rtol=2e-3)


def test_a_window_in_its_middle_and_its_turn_rate(turned):
    angle = 0.01 * np.arange(8000)  # per row
    values = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    middles = _middles(values, 8)
    # eq. (2) of logs.turned
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


def test_u_of_windows_by_how_fast_they_turn():
    """Twelve groups of three: σ is the middle one of each, and a jolt of nine σ counts as three."""
    rng = np.random.default_rng(9)
    up = mp.read_scheme("fibonacci-36").up
    rate = np.arange(36.0)
    misfit = np.tile([0.5, 1.0, 2.0], 12) * np.repeat(np.arange(1.0, 13.0), 3) * 1e-3
    order = rng.permutation(36)
    sigma = _sd_by_rate(misfit[order], rate[order])
    by_hand = np.repeat(np.arange(1.0, 13.0), 3) * 1e-3 / 0.6745
    assert_allclose(sigma, by_hand[order])
    # eq. (4) of logs.turned, of a sphere of equal misfits but one
    values = (
        np.repeat(up, 10, axis=0) * (1.0 + 1e-6 * np.where(np.arange(360) % 2, 1.0, -1.0))[:, None]
    )
    form = fit_ellipsoid(values)
    _, u, _ = _without_arm(values, form)
    field = form.field(values)
    r = np.linalg.norm(field, axis=1) - 1.0
    assert np.mean((r / (u[:, 0] * np.linalg.norm(form.root, axis=1)[0])) ** 2) == pytest.approx(
        (360 - 12) / 360, rel=0.02
    )


def test_u_is_that_of_leaving_blocks_out(turned):
    values, _ = turned
    cal = mp.calibrate(columns(values), unit="g")
    readings = cal.readings
    still = readings.columns() | {"turn_rate": 0.0 * readings.environment["turn_rate"]}
    whole = mp.fit(still, unit="g", unknown_orientation=True)
    moved = []
    for block in np.array_split(np.arange(len(readings)), 24):
        left = {n: np.delete(np.asarray(c, dtype=float), block) for n, c in still.items()}
        moved.append(mp.fit(left, unit="g", unknown_orientation=True).parameters - whole.parameters)
    # eq. (6) of estimation.correlated_rows
    by_hand = np.sqrt(23.0 / 24.0 * np.sum(np.square(moved), axis=0))
    assert_allclose([each.u for each in whole.entries], by_hand, rtol=0.03)


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
