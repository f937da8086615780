"""Advice is followed: the finding is gone, and compensated force is no worse.

Every case makes readings that raise a finding, does what its action says, with the numbers and
options that stand in it, and fits again. The error is the rms of compensated force over fresh
directions, against a sensor that the case has made itself.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

import numpy as np
import pytest

import multipos as mp
from multipos.sensor.found import Estimator

UP = mp.read_scheme("fibonacci-24").up
ZERO = np.array([0.012, -0.02, 0.007])
K = np.array([[1.01, 0.004, -0.003], [0.002, 0.98, 0.005], [-0.004, 0.001, 1.02]])
NOISE = 2e-4


@dataclass
class Data:
    """Readings as a case has made them, options of the fit, and the sensor behind them."""

    values: np.ndarray
    up: np.ndarray = field(default_factory=lambda: UP.copy())
    options: dict[str, Any] = field(default_factory=dict)
    columns: dict[str, Any] = field(default_factory=dict)
    sensor: Callable[[np.ndarray], np.ndarray] = lambda f: ZERO + f @ K.T
    unit: str = "g"
    table: dict[str, Any] = field(default_factory=dict)  # where orientations are not `up`

    def fit(self) -> mp.Calibration:
        if self.table:
            outputs = dict(zip(("ax", "ay", "az"), self.values.T, strict=True))
            return mp.fit(self.table | outputs, outputs=list(outputs), **self.options)
        readings = mp.Readings(self.values, up=self.up, unit=self.unit, **self.columns)
        return mp.fit(readings, **self.options)


def sense(rng, up=UP, sd=NOISE):
    return ZERO + up @ K.T + sd * rng.standard_normal((len(up), 3))


def error(cal, data, rng):
    """Return the rms error [g] of compensated force over fresh directions."""
    fresh = rng.standard_normal((400, 3))
    fresh /= np.linalg.norm(fresh, axis=1, keepdims=True)
    force = cal.sign * cal.compensate(data.sensor(fresh))
    if cal.estimator is Estimator.UNKNOWN:  # in axes of the sensor: sizes alone compare
        return float(np.sqrt(np.mean((np.linalg.norm(force, axis=1) - 1.0) ** 2)))
    return float(np.sqrt(np.mean((force - fresh) ** 2)))


def option(finding, pattern):
    found = re.search(pattern, finding.action)
    assert found, finding.action
    return found[1]


def rows_of(data, finding):
    return [int(label) - 1 for label in finding.rows]


# --- what is wrong, and what the action says


def interchanged(rng):
    values = sense(rng)
    values[[3, 11]] = values[[11, 3]]
    return Data(values)


def exchange(data, finding):
    i, j = rows_of(data, finding)
    values = data.values.copy()
    values[[i, j]] = values[[j, i]]
    return replace(data, values=values)


def upside_down(rng):
    up = UP.copy()
    up[5] *= -1.0
    return Data(sense(rng), up)


def reverse(data, finding):
    up = data.up.copy()
    up[rows_of(data, finding)] *= -1.0
    return replace(data, up=up)


def other_unit(rng):
    values = sense(rng)
    values[7] *= 9.80665
    return Data(values)


def convert(data, finding):
    values = data.values.copy()
    values[rows_of(data, finding)] /= 9.80665
    return replace(data, values=values)


def in_metres(rng):
    return Data(9.80665 * sense(rng), sensor=lambda f: 9.80665 * (ZERO + f @ K.T))


def state_unit(data, finding):
    return replace(data, unit=option(finding, r"--unit (\S+?)\."))


def gravity_convention(rng):
    return Data(-sense(rng), sensor=lambda f: -(ZERO + f @ K.T))


def state_axes(data, finding):
    return replace(data, options={**data.options, "axes": option(finding, r"--axes (\S+?)\.")})


def swapped(rng):
    order = [1, 0, 2]
    return Data(sense(rng)[:, order], sensor=lambda f: (ZERO + f @ K.T)[:, order])


def turned(rng):
    signs = np.array([1.0, -1.0, 1.0])
    return Data(
        (sense(rng) * signs)[:, [1, 0, 2]],
        sensor=lambda f: ((ZERO + f @ K.T) * signs)[:, [1, 0, 2]],
    )


ASLANT = np.array([[0.75**0.5, -0.5, 0.0], [0.5, 0.75**0.5, 0.0], [0.0, 0.0, 1.0]])  # 30° about z


def aslant(rng):
    return Data(sense(rng, UP @ ASLANT.T), sensor=lambda f: ZERO + f @ ASLANT.T @ K.T)


def mount_square(data, finding):
    assert finding.action == "Mount it square in its case."
    return Data(sense(np.random.default_rng(int(1e6 * abs(data.values[0, 0])))))


def squared(rng):
    bend = lambda f: ZERO + f @ K.T + 3e-3 * f**2  # noqa: E731
    return Data(bend(UP) + NOISE * rng.standard_normal(UP.shape), sensor=bend)


def state_model(data, finding):
    return replace(data, options={**data.options, "model": option(finding, r"--model '([^']+)'")})


def blunder(rng):
    values = sense(rng)
    values[9] += [0.02, -0.01, 0.015]
    return Data(values, options={"exclude": "none"})


def exclude(data, finding):
    return replace(
        data, options={**data.options, "exclude": option(finding, r"--exclude (\S+?)\.")}
    )


def by_hand(rng):
    up = UP + np.radians(0.3) * rng.standard_normal(UP.shape)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    return Data(sense(rng, up), options={"orientation_sd": 0})


def estimate_orientations(data, finding):
    assert "--orientation-sd auto" in finding.action
    return replace(data, options={**data.options, "orientation_sd": "auto"})


def drifting(rng):
    up = rng.permutation(UP)  # a spiral takes a drift for the sensor
    return Data(sense(rng, up) + 5e-3 * np.linspace(-0.5, 0.5, len(UP))[:, None], up)


def fit_drift(data, finding):
    assert "--drift" in finding.action
    return replace(data, options={**data.options, "drift": True})


def copied(rng):
    values = sense(rng)
    return Data(np.vstack([values, values[:6]]), np.vstack([UP, UP[:6]]))


def remove_copies(data, finding):
    return replace(data, values=data.values[:24], up=data.up[:24])


def overstated(rng):
    return Data(sense(rng), options={"reading_sd": 20 * NOISE})


def state_less(data, finding):
    return replace(data, options={**data.options, "reading_sd": NOISE})


def understated(rng):
    return Data(sense(rng), options={"reading_sd": NOISE / 8.0})


def unequal(rng):
    noise = NOISE * np.array([1.0, 1.0, 12.0])
    values = ZERO + UP @ K.T + noise * rng.standard_normal(UP.shape)
    return Data(values, options={"pool": True})


def unequal_by_hand(rng):
    up = mp.read_scheme("fibonacci-48").up
    values = ZERO + up @ K.T + NOISE * np.array([1.0, 1.0, 12.0]) * rng.standard_normal(up.shape)
    return Data(values, up, options={"unknown_orientation": True})


def state_each(data, finding):
    assert "each output with --reading-sd" in finding.action
    sd = [NOISE, NOISE, 12.0 * NOISE]
    return replace(data, options={**data.options, "reading_sd": sd})


def slipped(rng):
    up = rng.permutation(mp.read_scheme("fibonacci-48").up)
    turn = np.radians([0.4, -0.3, 0.2])
    stood = np.vstack([up[:24], up[24:] + np.cross(turn, up[24:])])
    return Data(sense(rng, stood), up)


def name_the_group(data, finding):
    first = int(option(finding, r"rows from (\d+) on in a column `group`")) - 1
    group = tuple("" if row < first else "slipped" for row in range(len(data.up)))
    return replace(data, columns={"group": group})


def without_pool(data, finding):
    assert "without --pool" in finding.action
    return replace(data, options={})


def kelvin(rng):
    warm = np.tile([250.0, 280.0, 310.0, 330.0], 6)
    values = sense(rng) + 1e-4 * (warm - 298.15)[:, None]
    options = {"model": "1 + x + y + z + temperature"}
    return Data(values, options=options, columns={"environment": {"temperature": warm}})


def subtract(data, finding):
    assert "Subtract 273.15" in finding.action
    warm = data.columns["environment"]["temperature"] - 273.15
    return replace(data, columns={"environment": {"temperature": warm}})


def state_convention(data, finding):
    stated = option(finding, r"--convention (\S+?)\.")
    return replace(data, options={**data.options, "convention": stated})


def in_radians(rng):
    roll, pitch = rng.uniform(-3.1, 3.1, 24), rng.uniform(-1.5, 1.5, 24)
    up = np.array([np.sin(pitch), -np.sin(roll) * np.cos(pitch), -np.cos(roll) * np.cos(pitch)])
    return Data(sense(rng, up.T), table={"roll_deg": roll, "pitch_deg": pitch})


def convert_angles(data, finding):
    assert "Convert the angles to degrees" in finding.action
    return replace(data, table={name: np.degrees(angle) for name, angle in data.table.items()})


def exchanged(rng):
    up = rng.permutation(mp.read_scheme("fibonacci-48").up)
    values = sense(rng, up)
    values[24:] += 0.01 + up[24:] @ (0.01 * rng.standard_normal((3, 3)))
    return Data(values, up)


def fit_those_before(data, finding):
    row = int(option(finding, r"the rows before (\d+) and those from it on separately")) - 1
    return replace(data, values=data.values[:row], up=data.up[:row])


def filtered(rng):
    up = rng.permutation(UP)
    values = ZERO + up @ K.T
    values[1:] = 0.98 * values[1:] + 0.02 * values[:-1]
    return Data(values + NOISE * rng.standard_normal(up.shape), up)


def wait(data, finding):
    assert "Wait longer at each position" in finding.action
    noise = NOISE * np.random.default_rng(len(finding.text)).standard_normal(data.up.shape)
    return replace(data, values=data.sensor(data.up) + noise)


def from_one_side(f):
    return ZERO + 5e-4 + f @ K.T


def from_both_sides(rng):
    side = rng.permutation(np.repeat([-1.0, 1.0], 12))
    values = from_one_side(UP) + 5e-4 * (side - 1.0)[:, None]
    values += NOISE * rng.standard_normal(UP.shape)
    table = dict(zip(("up_x", "up_y", "up_z"), UP.T, strict=True)) | {"approach": side}
    return Data(values, table=table, sensor=from_one_side)


def approach_from_one_side(data, finding):
    assert "Approach all positions from one side" in finding.action
    noise = NOISE * np.random.default_rng(len(finding.text)).standard_normal(UP.shape)
    table = data.table | {"approach": np.ones(24)}
    return replace(data, values=from_one_side(UP) + noise, table=table)


def shaken(rng):
    sd = (1e-3 + 0.03 * (rng.permutation(24) < 6))[:, None] * np.ones(3)
    return Data(sense(rng) + sd**2, columns={"sd": sd})


def leave_out_named(data, finding):
    assert "--exclude" in finding.action
    return replace(data, options={**data.options, "exclude": ",".join(finding.rows)})


def on_a_tilted_table(rng):
    turns = np.linalg.qr(rng.standard_normal((24, 3, 3)))[0]
    turns *= np.linalg.det(turns)[:, None, None]
    plumb = np.array([np.sin(np.radians(0.1)), 0.0, np.cos(np.radians(0.1))])
    return Data(sense(rng, turns @ plumb), turns[:, :, 2], columns={"rotation": turns})


def state_level(data, finding):
    level = float(option(finding, r"--level-sd ([\d.]+?)\.$"))
    return replace(data, options={**data.options, "level_sd": level})


def on_a_dividing_head(rng):
    angle = np.tile(np.arange(0.0, 360.0, 15.0), 2)
    axis = np.repeat(["x", "y"], 24)
    p, q = rng.uniform(0.0, 2.0 * np.pi, 2)
    t = np.radians(angle)
    t = t + np.radians(0.1) * (np.sin(t + p) + 0.5 * np.cos(2.0 * t + q))
    zero, s, c = np.zeros(48), np.sin(t), np.cos(t)
    up = np.where(axis == "x", [zero, c, s], [c, zero, s]).T
    return Data(sense(rng, up), table={"roll_axis": axis, "angle_deg": angle})


def state_table_error(data, finding):
    off = float(option(finding, r"--orientation-sd ([\d.]+?)\.$"))
    return replace(data, options={**data.options, "orientation_sd": off})


CASES = {
    "convention": (gravity_convention, state_convention),
    "angles-in-radians": (in_radians, convert_angles),
    "replaced": (exchanged, fit_those_before),
    "settling": (filtered, wait),
    "hysteresis": (from_both_sides, approach_from_one_side),
    "vibration": (shaken, leave_out_named),
    "level": (on_a_tilted_table, state_level),
    "table": (on_a_dividing_head, state_table_error),
    "interchanged-rows": (interchanged, exchange),
    "flipped-row": (upside_down, reverse),
    "row-unit": (other_unit, convert),
    "unit": (in_metres, state_unit),
    "permuted-outputs": (swapped, state_axes),
    "turned": (turned, state_axes),
    "turned by 30 degrees": (aslant, mount_square),
    "missing-term": (squared, state_model),
    "outlier": (blunder, exclude),
    "placement": (by_hand, estimate_orientations),
    "drift": (drifting, fit_drift),
    "repeated-rows": (copied, remove_copies),
    "overstated-noise": (overstated, state_less),
    "denied-noise": (understated, state_less),
    "unequal-pool": (unequal, without_pool),
    "unequal-noise": (unequal_by_hand, state_each),
    "slipped": (slipped, name_the_group),
    "temperature-kelvin": (kelvin, subtract),
}


def follow(code, seed):
    """Return whether the finding came and went, and the errors before and after."""
    rng = np.random.default_rng(seed)
    made, advised = CASES[code]
    code = code.partition(" ")[0]
    data = made(rng)
    before = data.fit()
    found = [each for each in before.findings if each.code == code]
    if not found:
        return None
    after_data = advised(data, found[0])
    after = after_data.fit()
    gone = code not in [each.code for each in after.findings]
    if code == "temperature-kelvin":  # force at one temperature needs its column
        return gone, 0.0, 0.0
    fresh = np.random.default_rng(1000 + seed)
    first = error(before, data, fresh)
    return gone, first, error(after, after_data, np.random.default_rng(1000 + seed))


def judge(code, first, count):
    tried = (follow(code, seed) for seed in range(first, first + 3 * count))
    found = list(islice((each for each in tried if each is not None), count))
    assert len(found) == count, "the data do not raise it"
    # a test at 1 % may speak again by chance
    assert sum(gone for gone, _, _ in found) >= 0.95 * len(found)
    before, after = (np.array([each[i] for each in found]) for i in (1, 2))
    more = after**2 - before**2  # of pairs: zero or less, but for 2.6 standard errors of the mean
    assert more.mean() <= 2.6 * more.std(ddof=1) / np.sqrt(len(more)) + 1e-6 * np.mean(before**2)


@pytest.mark.parametrize("code", CASES)
def test_advice_that_is_followed_helps(code):
    judge(code, 0, 3)


@pytest.mark.slow
@pytest.mark.parametrize("code", CASES)
def test_advice_that_is_followed_helps_in_twenty_sets(code):
    judge(code, 100, 20)
