"""Simulated users who do what the guide asks, each in a way of their own, to the end."""

import itertools

import numpy as np
import pytest

import multipos as mp
from multipos.capturing.running import make_plan, make_reading
from multipos.capturing.session import Session
from multipos.logs.opening import open_log
from multipos.numerics.rotations import rotation_matrix

RATE, REST, TURN = 50.0, 3.0, 1.0
LONGEST = 15.0  # [s] that anybody waits for the guide
POSES = 12
PIECE = 5  # rows that come at once
SIZE = {"counts": 16384.0, "m/s^2": 9.80665}
BOARDS = {
    "plain": np.eye(3),
    "turned": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "mirrored": np.diag([1.0, -1.0, 1.0]),
    "upside": -np.eye(3),
    "swapped": np.eye(3)[[1, 0, 2]],
}
HABITS = ("exact", "repeats", "tilts")
USERS = [*itertools.product(SIZE, BOARDS, HABITS)]
# Every unit, board and habit at once; their other combinations take long.
FIRST = {USERS[row % len(USERS)] for row in range(0, 2 * len(USERS), 11)}
ORDERED = [u if u in FIRST else pytest.param(*u, marks=pytest.mark.slow) for u in USERS]


class User:
    """One who turns the case from direction to direction, by hand."""

    def __init__(self, unit, board, habit, seed):
        self.rng = np.random.default_rng(seed)
        self.habit, self.size = habit, SIZE[unit]
        cross = 0.01 * self.rng.standard_normal((3, 3))
        self.matrix = self.size * (np.eye(3) + cross) @ BOARDS[board]
        self.bias = 0.03 * self.size * self.rng.standard_normal(3)
        self.up = np.array([0.0, 0.6, 0.8])
        self.asked = []

    def rows(self, ups):
        y = ups @ self.matrix.T + self.bias
        return y + 1e-3 * self.size * self.rng.standard_normal(y.shape)

    def obey(self, asked):
        """Turn to what is asked for; return the rows (n, 3) of the turn, and of a long rest."""
        self.asked.append(asked)
        target = asked
        if self.habit == "repeats" and len(self.asked) in (3, 6):
            target = self.up  # does not turn the sensor at all
        elif self.habit == "tilts":
            axis = np.cross(asked, self.rng.standard_normal(3))
            turn = rotation_matrix(np.radians(20.0) * axis / np.linalg.norm(axis))
            target = turn @ asked
        away = self.up + 0.5 * self.rng.standard_normal(3)
        path = np.linspace(0.0, 1.0, round(RATE * TURN / 2))[:, None]
        ways = [self.up + path * (away - self.up), away + path * (target - away)]
        moving = np.concatenate([way / np.linalg.norm(way, axis=1)[:, None] for way in ways])
        self.up = target
        return self.rows(np.concatenate([moving, np.tile(target, (round(RATE * LONGEST), 1))]))


@pytest.mark.parametrize(("unit", "board", "habit"), ORDERED)
def test_a_user_is_led_to_the_end(unit, board, habit, tmp_path):
    user = User(unit, board, habit, seed=USERS.index((unit, board, habit)))
    session = Session(
        make_plan((), POSES, None, {}), make_reading(None, None, None, None, None, None)
    )
    still = user.rows(np.tile(user.up, (40, 1)))
    time = np.arange(40) / RATE
    mp.write_table(
        tmp_path / "log.csv", dict(zip(("time", "ax", "ay", "az"), [time, *still.T], strict=True))
    )
    log = open_log(tmp_path / "log.csv")
    session.begin(log, np.array([time, *still.T]))
    count = 40
    for _ in range(POSES + 8):
        if session.is_enough:
            break
        rows = user.obey(session.next.direction)
        times = (count + np.arange(len(rows))) / RATE
        begun = session.rows.rows + round(RATE * TURN)
        for first in range(0, len(rows), PIECE):
            session.feed(np.array([times, *rows.T])[:, first : first + PIECE])
            resting = session.rows.rows - begun
            if session.under_way is not None and resting >= RATE * REST:
                break  # the guide goes on
        count += first + PIECE
    session.finish()
    assert len(session.accepted) == POSES
    refused = [pose.reason for pose in session.poses if not pose.accepted]
    assert len(refused) <= (3 if habit == "repeats" else 0), refused
    # what was asked for is new each time, and what is shown is where the case stood
    asked = np.array(user.asked)
    near = np.degrees(np.arccos(np.clip(asked @ asked.T, -1.0, 1.0)))[
        np.triu_indices(len(asked), 1)
    ]
    assert habit == "repeats" or near.min() > 15.0
    calibration = session.evaluation.calibration
    scale = np.linalg.norm(user.matrix, axis=1)
    np.testing.assert_allclose(
        [calibration[f"bias_a{axis}"].value for axis in "xyz"], user.bias, atol=4e-3 * user.size
    )
    np.testing.assert_allclose(np.linalg.norm(calibration.sensitivity, axis=1), scale, rtol=6e-3)
