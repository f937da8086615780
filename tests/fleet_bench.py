"""A simulated line: many units on the same positions, at stations that are not level."""

import numpy as np

import multipos as mp


def line(
    units=40,
    *,
    scheme="fibonacci-24",
    noise=1e-3,
    stations=1,
    level=None,
    shift=None,
    turned=None,
    lot=1e-2,
    seed=0,
):
    """Columns of a table; `level` and `turned` are rotation vectors [rad] (S, 3) and (S, n, 3)."""
    rng = np.random.default_rng(seed)
    up = mp.read_scheme(scheme).up
    n = len(up)
    at = rng.integers(0, stations, units)
    rotation = np.zeros((stations, n, 3))
    if level is not None:
        rotation += np.asarray(level)[:, None]
    if turned is not None:
        rotation += turned
    force = up + np.cross(rotation, up)
    matrix = np.eye(3) + lot * rng.standard_normal((units, 3, 3))
    bias = lot * rng.standard_normal((units, 3))
    if shift is not None:
        bias = bias + np.asarray(shift)[at]
    values = bias[:, None] + np.einsum("bni,bji->bnj", force[at], matrix)
    values += noise * rng.standard_normal(values.shape)
    return {
        "unit": np.repeat([f"U{i:04d}" for i in range(units)], n),
        "station": np.repeat(np.array([f"S{i}" for i in range(stations)])[at], n),
        "position": np.tile([str(k + 1) for k in range(n)], units),
        **{f"up_{axis}": np.tile(up[:, i], units) for i, axis in enumerate("xyz")},
        **{f"a{axis}": values[:, :, i].ravel() for i, axis in enumerate("xyz")},
    }


def rows_of(table, unit):
    """The rows of one unit, without the columns that name unit and station."""
    mine = table["unit"] == unit
    return {name: np.asarray(column)[mine] for name, column in table.items() if name not in APART}


APART = ("unit", "station")
