"""Raw logs with known truth, for the tests of `average` and `apply`."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

import multipos as mp

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
    built = mp.fit(
        mp.Readings(up, up=up, environment={"temperature": temperature}), model=model, unit=unit
    ).model
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
    return mp.fit(
        mp.Readings(y, up=up, environment={"temperature": temperature}), model=model, unit=unit
    )


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
