"""Six faces and 24 positions set by hand: the error of the bias, beside 20 lines of SciPy.

`python -m benchmarks.by_hand [--sets N]` prints the median size of the error of the three biases
[mg] over simulated sets: readings f K' + b of a triad with noise of .1 mg, its positions turned
from the directions listed by normal angles of so many degrees about each axis. Beside `mp.fit` the
plain fit of all rows, which takes the directions as exact, by `scipy.optimize.least_squares`, and
of six faces the means of opposite ones, as imucal.
"""

import argparse
import warnings

import numpy as np
from scipy.optimize import least_squares

import multipos as mp

NOISE = 1e-4  # [g]
DEGREES = (0.0, 0.05, 0.2, 1.0)


def turned(rng, up, degrees):
    """Return directions turned by normal angles about each axis."""
    off = up + np.cross(np.radians(degrees) * rng.normal(size=up.shape), up)
    return off / np.linalg.norm(off, axis=1, keepdims=True)


def plain_bias(up, readings):
    """Return the biases of the plain fit."""

    def residuals(theta):
        return (theta[:3] + up @ theta[3:].reshape(3, 3).T - readings).ravel()

    start = np.concatenate([np.zeros(3), np.eye(3).ravel()])
    return least_squares(residuals, start, method="lm").x[:3]


def fitted_bias(up, readings):
    """Return the biases of multipos by default."""
    cal = mp.fit(mp.Readings(readings, outputs=("ax", "ay", "az"), up=up, unit="g"))
    return np.array([cal[f"bias_{output}"].value for output in cal.outputs])


def opposite_bias(up, readings):
    """Return the biases of opposite faces; NaN of any other directions."""
    if len(up) != 6:
        return np.full(3, np.nan)
    return np.array([readings[np.abs(each) > 0.5, i].mean() for i, each in enumerate(up.T)])


def median_errors(up, degrees, sets, seed=1):
    """Return the median size of the error [mg] by each."""
    rng = np.random.default_rng(seed)
    errors = []
    for _ in range(sets):
        bias, K = 0.02 * rng.normal(size=3), np.eye(3) + 0.01 * rng.normal(size=(3, 3))
        readings = bias + turned(rng, up, degrees) @ K.T + NOISE * rng.normal(size=up.shape)
        found = [of(up, readings) for of in (fitted_bias, plain_bias, opposite_bias)]
        errors.append([1e3 * np.linalg.norm(each - bias) for each in found])
    return np.median(errors, axis=0)


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.by_hand", description=__doc__)
    parser.add_argument("--sets", type=int, default=200)
    sets = parser.parse_args().sets
    warnings.simplefilter("ignore", mp.CalibrationWarning)
    print("| positions | off by | multipos | SciPy | up/down |\n|---|---:|---:|---:|---:|")
    for name in ("faces-6", "fibonacci-24"):
        for degrees in DEGREES:
            each = median_errors(mp.read_scheme(name).up, degrees, sets)
            print(f"| {name} | {degrees:g}° | {' | '.join(f'{one:.3f}' for one in each)} |")


if __name__ == "__main__":
    main()
