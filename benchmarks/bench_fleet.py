"""Many units against a loop of `fit`: what the user calls, side by side.

The loop is timed on some units and counted up, as a loop over all of them would take minutes.
"""

import warnings

import numpy as np

import multipos as mp
from benchmarks.timing import Ratio, paired_ratio

_UNITS, _LOOPED = 20_000, 10


def run() -> list[Ratio]:
    warnings.simplefilter("ignore", mp.CalibrationWarning)
    return [_known("linear", 1 / 200), _known("own-quadratic", 1 / 100)]


def _known(model: str, goal: float) -> Ratio:
    table = _line(_UNITS)
    units = [_rows(table, i) for i in range(_LOOPED)]

    def loop() -> list[mp.Calibration]:
        return [mp.fit(unit, scheme="fibonacci-24", model=model) for unit in units]

    def batch() -> object:
        return mp.fit_many(table, unit_column="unit", scheme="fibonacci-24", model=model)

    pairs = paired_ratio(batch, loop, repeats=7, inner=1)
    scaled = [pair * _LOOPED / _UNITS for pair in pairs]
    return Ratio(f"fit_many, {_UNITS} units, 24 positions, {model}", "a loop of fit", scaled, goal)


def _line(units: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    up = mp.read_scheme("fibonacci-24").up
    matrix = np.eye(3) + 0.01 * rng.standard_normal((units, 3, 3))
    values = 0.02 * rng.standard_normal((units, 1, 3)) + np.einsum("ni,bji->bnj", up, matrix)
    values += 3e-4 * rng.standard_normal(values.shape)
    return {
        "unit": np.repeat(np.arange(units), len(up)),
        "position": np.tile(np.arange(1, len(up) + 1), units),
        **{f"a{axis}": values[:, :, i].ravel() for i, axis in enumerate("xyz")},
    }


def _rows(table: dict[str, np.ndarray], unit: int) -> dict[str, np.ndarray]:
    rows = slice(24 * unit, 24 * (unit + 1))
    return {name: column[rows] for name, column in table.items() if name != "unit"}
