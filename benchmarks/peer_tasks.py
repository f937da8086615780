"""What multipos and its peers are given: simulations with a truth, and recordings without one.

A simulated sensor answers raw = offset + gain (b + M f + q f²) [reading unit] to the force f [g].
Recordings are files of a folder that the user names; those that are missing are left out.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import multipos as mp

Array = NDArray[np.float64]
ORDER = ("x_p", "x_a", "y_p", "y_a", "z_p", "z_a")  # the faces of faces-6, named as imucal does
TURNS = ("x_rot", "y_rot", "z_rot")
ACC, GYR = ("acc_x", "acc_y", "acc_z"), ("gyr_x", "gyr_y", "gyr_z")
BIAS = np.array([0.012, -0.021, 0.034])  # [g]
MATRIX = np.array([[1.012, 0.007, -0.003], [0.005, 0.99, 0.007], [-0.007, 0.004, 1.003]])


@dataclass(frozen=True)
class Truth:
    """The sensor that was simulated."""

    matrix: Array = field(default_factory=lambda: MATRIX)
    square: float = 0.0  # q of every output [g/g²]
    gain: float = 1.0
    offset: float = 0.0

    @property
    def zero(self) -> Array:
        """What the sensor reads without force [reading unit]."""
        return self.offset + self.gain * BIAS

    def read(self, force: Array) -> Array:
        told = BIAS + force @ self.matrix.T + self.square * force**2
        return np.asarray(self.offset + self.gain * told)


@dataclass(frozen=True)
class Task:
    """One recording, as every program gets it."""

    name: str
    kind: str  # 'rests': means alone; 'faces': a log and its sections; 'worn': a log of days
    rests: Array  # (n, 3) means of the rests [reading unit], by which all are judged
    per_g: float = 1.0  # nominal reading of one g
    log: dict[str, Array] = field(default_factory=dict)
    rate: float = 0.0  # [Hz]
    sections: dict[str, dict[str, int]] = field(default_factory=dict)
    truth: Truth | None = None


def directions(n: int, rng: np.random.Generator) -> Array:
    drawn = rng.standard_normal((n, 3))
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True))


def simulated(seed: int) -> Iterator[Task]:
    """Yield every simulation, once more with each seed."""
    rng = np.random.default_rng(seed)
    spread = mp.read_scheme("fibonacci-24").up
    upper = directions(200, rng)
    upper = upper[upper[:, 2] > -0.2][:18]
    yield rests("24 rests, .2 mg", Truth(), spread, 2e-4, rng)
    counts = Truth(gain=819.2, offset=2048.0)
    yield rests("24 rests, 12-bit counts about 2048", counts, spread, 2e-4, rng, step=1.0 / 256)
    yield rests("12 rests, 2 mg", Truth(), directions(12, rng), 2e-3, rng)
    yield rests("18 rests, never upside down, .2 mg", Truth(), upper, 2e-4, rng)
    yield rests("24 rests, K2 of 2 mg/g²", Truth(square=2e-3), spread, 2e-4, rng)
    yield faces("six faces placed to .2°", rng)
    straight = Truth(matrix=np.diag(np.diag(MATRIX)))
    yield worn("worn for 13 h, axes straight", straight, rng)
    yield worn("worn for 13 h, axes askew", Truth(), rng)


def rests(
    name: str, truth: Truth, up: Array, noise: float, rng: np.random.Generator, step: float = 0.0
) -> Task:
    """Return averaged readings with their noise [g], rounded to a step [reading unit]."""
    values = truth.read(up) + truth.gain * noise * rng.standard_normal(up.shape)
    if step:
        values = step * np.round(values / step)
    return Task(name, "rests", values, per_g=truth.gain, truth=truth)


def faces(name: str, rng: np.random.Generator) -> Task:
    """Return a log of six faces and three turns, at 100 Hz with 3 mg of noise a sample."""
    truth = Truth(gain=9.81)
    up = mp.read_scheme("faces-6").up
    up = up + np.cross(np.radians(0.2) * rng.standard_normal((6, 3)), up)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    force = np.vstack([up, np.tile([0.0, 0.0, 1.0], (3, 1))])
    raw = truth.read(np.repeat(force, 500, axis=0))
    raw += truth.gain * 3e-3 * rng.standard_normal(raw.shape)
    rates = np.zeros_like(raw)
    for k in range(3):
        rates[3000 + 500 * k : 3500 + 500 * k, k] = -72.0  # a turn of 360° in 5 s
    log = dict(zip(ACC, raw.T, strict=True)) | dict(zip(GYR, rates.T, strict=True))
    ends = {
        label: {"start": 500 * i, "end": 500 * (i + 1)} for i, label in enumerate(ORDER + TURNS)
    }
    means = raw[:3000].reshape(6, 500, 3).mean(axis=1)
    return Task(name, "faces", means, 9.81, log, 100.0, ends, truth)


def worn(name: str, truth: Truth, rng: np.random.Generator) -> Task:
    """Return a log of 13 h at 5 Hz: now and then another attitude, moving for a minute between."""
    rate, rest, turn = 5.0, 250, 50
    up = directions(156, rng)
    force = np.tile(np.repeat(up, rest + turn, axis=0), (5, 1))
    moving = np.arange(len(force)) % (rest + turn) >= rest
    force[moving] += 0.2 * rng.standard_normal((int(moving.sum()), 3))
    raw = truth.read(force) + 3e-3 * rng.standard_normal(force.shape)
    log = dict(zip(ACC, raw.T, strict=True)) | {"time": np.arange(len(raw)) / rate}
    still = raw.reshape(-1, rest + turn, 3)[:, :rest].mean(axis=1)
    return Task(name, "worn", still, log=log, rate=rate, truth=truth)


def recorded(folder: Path) -> Iterator[Task]:
    """Yield the recordings of a folder."""
    for stem, name in (
        ("innalabs_24", "Innalabs triad, 24 rests"),
        ("pointer_ee_24", "cave pointer ee, 24 rests"),
        ("pointer_ab_24", "cave pointer ab, 24 rests"),
    ):
        path = folder / f"{stem}.csv"
        if path.is_file():
            yield Task(name, "rests", mp.read_readings(path).values)
    path = folder / "mpu9150_imu0.log"
    if path.is_file():
        columns = "ax,ay,az,wx,wy,wz"
        found = mp.average(path, columns=columns, outputs="ax,ay,az", rate=100.0)
        yield Task("MPU-9150, 23 rests of a log", "rests", found.readings.values, per_g=9.81)
    path, ends = folder / "ferraris_session.csv", folder / "ferraris_session_sections.json"
    if path.is_file() and ends.is_file():
        table = np.loadtxt(path, delimiter=",", skiprows=1)[:, 1:]
        log = dict(zip(GYR + ACC, table.T, strict=True))
        sections = json.loads(ends.read_text("utf-8"))
        found = [table[slice(*sections[face].values()), 3:].mean(axis=0) for face in ORDER]
        means = np.array(found)
        yield Task("six-position session (Ferraris)", "faces", means, 9.81, log, 102.4, sections)
