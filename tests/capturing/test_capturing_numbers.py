"""Numbers of a session by hand or by a second route, at points without symmetry."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import t

import multipos as mp
from multipos.capturing import poses
from multipos.capturing.poses import _find_frame, _ratios, _score, _State, best_pose, gain_of
from multipos.designs.information import Setting
from multipos.sensor.model import build_model

MODEL = build_model("linear", ("ax", "ay", "az"), ("x", "y", "z"))
TAKEN = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.0, -0.8, 0.6], [-0.6, 0.0, -0.8]])


def state(dof=7.0):
    rng = np.random.default_rng(3)
    X = [np.append(1.0, up) for up in TAKEN]
    present = np.kron(np.eye(3), sum(np.outer(x, x) for x in X) + 0.1 * np.eye(4))
    return _State(Setting(MODEL), present, rng.uniform(1, 2, 12), rng.uniform(0.01, 0.02, 12), dof)


def ratios_by_hand(now, up, targets, dof):
    own = np.kron(np.eye(3), np.outer(np.append(1.0, up), np.append(1.0, up)))
    u = np.sqrt(np.diag(np.linalg.inv(now.present + own)) * now.scale + now.fixed)
    k = t.ppf(0.975, dof if dof > 0.0 else 1.0)
    return [k * u[MODEL.names.index(name)] / target for name, target in targets.items()]


def test_what_a_pose_would_make_of_targets_and_of_the_whole():
    targets, up = {"bias_ay": 0.3, "scale_az": 0.7, "bias_ax": 0.2}, np.array([0.48, -0.64, 0.6])
    now = state()
    own = np.kron(np.eye(3), np.outer(np.append(1.0, up), np.append(1.0, up)))
    assert_allclose(_ratios(now, own[None], targets, 7.0)[0], ratios_by_hand(now, up, targets, 7.0))
    assert_allclose(_ratios(now, own[None], targets, 0.0)[0], ratios_by_hand(now, up, targets, 0.0))
    by_hand = -math.log(sum(r**8 for r in ratios_by_hand(now, up, targets, 7.0)))
    assert _score(now, up[None], targets)[0] == pytest.approx(by_hand)
    whole = np.linalg.slogdet(now.present + own)[1]
    assert _score(now, up[None], {})[0] == pytest.approx(whole)
    assert gain_of(now, up, {}) == pytest.approx(whole - np.linalg.slogdet(now.present)[1])
    u = np.sqrt(np.diag(np.linalg.inv(now.present)) * now.scale + now.fixed)
    worst = t.ppf(0.975, 7.0) * max(u[MODEL.names.index(n)] / w for n, w in targets.items())
    then = max(ratios_by_hand(now, up, targets, 8.0))
    assert gain_of(now, up, targets) == pytest.approx(worst - then)


@pytest.mark.parametrize(("share", "fine"), [(0.97, True), (0.99, False)])
def test_an_easy_direction_is_taken_where_it_is_nearly_the_best(share, fine, monkeypatch):
    """Of what the best would gain 98 % are enough; none is near a pose that was taken."""
    seen = []

    def scored(now, up, led_by):
        if up is None:
            return np.zeros(1)
        seen.append(up)
        return np.linspace(0.1, share if len(up) < 26 else 1.0, len(up))

    monkeypatch.setattr(poses, "_score", scored)
    found = best_pose(MODEL, None, TAKEN, {})
    assert_allclose(found.direction, seen[1][-1] if fine else seen[0][-1])
    for up in seen:
        assert (up @ TAKEN.T).max() < math.cos(math.radians(20.0))
    every = mp.read_scheme("fibonacci-2000").up
    assert best_pose(MODEL, None, every, {}) is None


@pytest.mark.parametrize(
    ("size", "found"),
    [(9.0, True), (11.1, True), (8.2, False), (11.5, False), (1.1, True), (900.0, True)],
)
def test_a_frame_without_a_centre_is_of_a_known_g(size, found):
    """Within 15 % of 9.80665, 1 or 1000; of many poses their centre tells it."""
    up = mp.read_scheme("fibonacci-3").up
    frame = _find_frame(size * up, (2, 0, 1), "gravity", None)
    assert (frame is not None) is found
    if found:
        assert (frame.size, frame.order, frame.sign) == (pytest.approx(size), (1, 2, 0), -1.0)
    many = mp.read_scheme("fibonacci-12").up
    frame = _find_frame(7.0 * many + [3.0, -2.0, 1.0], (0, 1, 2), "force", None)
    assert_allclose(frame.centre, [3.0, -2.0, 1.0], atol=1e-9)
    assert (frame.size, frame.sign) == (pytest.approx(7.0), 1.0)
    assert _find_frame(many[:, :2], (0, 1), "force", None) is None
