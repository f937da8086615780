"""Raw logs with known truth, for the tests of `average` and `apply`."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

import multipos as mp
from multipos.units import STANDARD_GRAVITY

SHARED = Path(__file__).resolve().parents[1].parent / "shared" / "data"


def shared(name):
    """Path of a real recording; the test skips where there is none."""
    path = SHARED / name
    if not path.exists():
        pytest.skip(f"no {path}")
    return path


@cache
def sensor(model="linear", *, bias=0.05, cross=0.01, size=1e-3, unit="g"):
    """A calibration fitted to noise-free readings of a sensor with these coefficients."""
    rng = np.random.default_rng(7)
    up = mp.read_scheme("fibonacci-40").up
    temperature = np.linspace(10.0, 40.0, 40)[rng.permutation(40)]
    exact = {"model": model, "unit": unit, "orientation_sd": 0.0, "exclude": "none"}
    built = mp.fit(mp.Readings(up, up=up, environment={"temperature": temperature}), **exact).model
    values = []
    for output, term in built.keys:
        own = str(term) == built.axes[built.outputs.index(output)]
        if not term.factors:
            values.append(bias * rng.uniform(-1, 1))
        elif term.environment:
            values.append(size * rng.uniform(-1, 1) / 10.0)
        elif own:
            values.append(1.0 + cross * rng.uniform(-1, 1))
        else:
            values.append((cross if term.force_degree == 1 else size) * rng.uniform(-1, 1))
    y = built.predict(np.array(values), up, {"temperature": temperature})
    y = y + 1e-5 * rng.normal(size=y.shape)
    return mp.fit(mp.Readings(y, up=up, environment={"temperature": temperature}), **exact)


def columns_of(cal=None, scheme="faces-6", **options):
    """A session of rests at the positions of a scheme: its columns."""
    options = {"sample_sd": 1e-3, "seed": 1, "rest": 4.0} | options
    return mp.simulate_log(cal or sensor(), scheme, **options)


def ar1(rng, shape, phi):
    """Stationary noise with y_i = φ y_{i-1} + …, of standard deviation 1, along the last axis."""
    white = rng.normal(size=shape)
    y = np.empty(shape)
    y[..., 0] = white[..., 0]
    for i in range(1, shape[-1]):
        y[..., i] = phi * y[..., i - 1] + np.sqrt(1.0 - phi**2) * white[..., i]
    return y


def write_csv(path, columns, header=True, delimiter=","):
    rows = zip(*columns.values(), strict=True)
    lines = [delimiter.join(columns)] if header else []
    lines += [delimiter.join(map(repr, map(float, row))) for row in rows]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


_RATE = 100.0  # [Hz]


def _slow(rng, n, seconds):
    """Smooth noise (n, 3) of variance one with a memory of so many seconds."""
    keep = np.exp(-1.0 / (_RATE * seconds))
    noise = rng.standard_normal((n + 2000, 3))
    for _ in range(2):
        noise = lfilter([1.0 - keep], [1.0, -keep], noise, axis=0)
    return noise[2000:] / noise[2000:].std()


def hand_turned(rng, seconds=90.0, tremor=0.12, lever=0.05):
    """Readings (n, 3) [g] by a hand at 10 to 60 °/s over the whole sphere, and the parameters.

    A tremor of `tremor` [m/s²] at 9 Hz, 2 mg of slow motion, both growing with the turn rate; the
    proof mass at `lever` [m] from the axes; white noise of 1.2 mg.
    """
    n = int(seconds * _RATE)
    far = mp.read_scheme("fibonacci-400").up
    while True:
        turn = _slow(rng, n, 1.5) * np.exp(0.5 * _slow(rng, n, 1.5)[:, [0]])
        turn *= np.radians(rng.uniform(10.0, 60.0)) / np.sqrt((turn**2).sum(axis=1).mean())
        steps = Rotation.from_rotvec(turn / _RATE).as_matrix()
        up = np.empty((n, 3))
        here = _direction(rng)
        for i in range(n):  # as the case sees it
            here = here @ steps[i]
            up[i] = here
        if (far @ up[::10].T).max(axis=1).min() > np.cos(np.radians(40.0)):
            break
    arm = lever * _direction(rng)
    moved = np.cross(turn, np.cross(turn, arm)) + np.cross(
        np.gradient(turn, 1 / _RATE, axis=0), arm
    )
    phase = 2.0 * np.pi * 9.0 * np.arange(n) / _RATE
    shaken = tremor * np.sqrt(2.0) * np.sin(phase)[:, None] * _slow(rng, n, 2.0) / np.sqrt(3.0)
    size = np.linalg.norm(turn, axis=1, keepdims=True)
    hand = (shaken / STANDARD_GRAVITY + 2e-3 * _slow(rng, n, 0.15)) * (
        0.3 + 0.7 * size / size.mean()
    )
    M = np.tril(np.eye(3) + 0.03 * rng.standard_normal((3, 3)))
    bias = 0.06 * rng.standard_normal(3)
    values = (
        bias + (up + moved / STANDARD_GRAVITY + hand) @ M.T + 1.2e-3 * rng.standard_normal((n, 3))
    )
    truth = [bias[0], M[0, 0], bias[1], *M[1, :2], bias[2], *M[2]]
    return values, np.array(truth)


def _direction(rng):
    vector = rng.standard_normal(3)
    return vector / np.linalg.norm(vector)
