"""Many units against a loop of `fit`: what the user calls, side by side.

The loop is timed on some units and counted up, as a loop over all of them would take minutes.
"""

import warnings
from typing import Any

import numpy as np

import multipos as mp
from benchmarks.timing import Ratio, paired_ratio
from multipos.estimation.known import fit_output, share_design

_LOOPED = 10
_BLOCK = 8000  # units, as many as a task has


def run() -> list[Ratio]:
    warnings.simplefilter("ignore", mp.CalibrationWarning)
    default = {"scheme": "fibonacci-24"}
    known = default | {"orientation_sd": 0, "exclude": "none"}
    return [
        _bandwidth(100_000),
        _paired("linear", 20_000, 1 / 200, known),
        _paired("by default", 1000, 1 / 30, default),
        _paired("own-quadratic", 20_000, 1 / 100, known | {"model": "own-quadratic"}),
        _paired("unknown orientation", 4000, 1 / 20, {"unknown_orientation": True}),
        _paired(
            "unknown orientation, --reading-sd",
            4000,
            1 / 20,
            {"unknown_orientation": True, "reading_sd": 3e-4},
        ),
        _paired("--reading-sd", 4000, 1 / 20, known | {"reading_sd": 3e-4}),
        _paired("--robust huber", 2000, 1 / 10, known | {"robust": "huber"}),
        _paired("u of every reading", 4000, 1 / 20, known, stated=True),
        _paired("--orientation-sd 0.1", 1000, 1 / 10, known | {"orientation_sd": 0.1}),
        _paired("--orientation-sd auto", 200, 1 / 10, known | {"orientation_sd": "auto"}),
    ]


def _bandwidth(count: int) -> Ratio:
    """Parameters and residuals by the kernel, against a copy that moves as many bytes."""
    table = _line(count)
    up = mp.read_scheme("fibonacci-24").up
    model = mp.fit(_rows(table, 0), scheme="fibonacci-24").model
    shared = share_design(model, up, {})
    assert shared is not None
    values = [table[output].reshape(count, len(up)) for output in model.outputs]
    given = sum(each.nbytes for each in values)
    found = given + 8 * count * len(model.keys)
    source = np.ones((given + found) // 16)  # half of them read, half written
    target = np.empty_like(source)

    def solve() -> object:
        blocks = [slice(first, first + _BLOCK) for first in range(0, count, _BLOCK)]
        outputs = zip(shared.designs, shared.inverses, values, strict=True)
        return [fit_output(X, inverse, y[rows]) for X, inverse, y in outputs for rows in blocks]

    pairs = paired_ratio(solve, lambda: np.copyto(target, source), repeats=7, inner=1)
    what = f"parameters and residuals, {count} units, 24 positions"
    return Ratio(what, "a copy of as many bytes", pairs, 2.0)


def _paired(
    name: str, count: int, goal: float, options: dict[str, Any], *, stated: bool = False
) -> Ratio:
    table = _line(count)
    if stated:
        rng = np.random.default_rng(1)
        u = {f"u_a{axis}": rng.uniform(2e-4, 4e-4, 24 * count) for axis in "xyz"}
        table |= u
    units = [_rows(table, i) for i in range(_LOOPED)]

    def loop() -> list[mp.Calibration]:
        return [mp.fit(unit, **options) for unit in units]

    def batch() -> object:
        return mp.fit_many(table, unit_column="unit", **options)

    pairs = paired_ratio(batch, loop, repeats=7, inner=1)
    scaled = [pair * _LOOPED / count for pair in pairs]
    return Ratio(f"fit_many, {count} units, 24 positions, {name}", "a loop of fit", scaled, goal)


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
