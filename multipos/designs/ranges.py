"""Ranges of tilt and force, for designs that make small what matters in use.

`range_directions` returns the directions of a range, and by what each axis reads them.

A sensor stands with z up, and every other axis that it has leans up to a range either way, alone
and together (of a sensor of z alone, z leans from level). At a position that points up along u the
tilt of axis e and its force change by

    dtilt = t·df,    t = (e − u (u·e))/cos tilt;        df_e = e·df;                         (1)

with fewer than three axes tilt is asin f_e, so that t = e/cos tilt. The variances of both, over the
range on average, are what `multipos.designs.criteria` weighs parameters by.
"""

import numpy as np

from multipos.errors import UsageError
from multipos.numerics.arrays import COMPONENTS, Array

_LEANS = 13  # tilts of an axis over a range, whose mean stands for all


def range_directions(name: str, axes: tuple[str, ...]) -> tuple[Array, list[Array]]:
    """Return up vectors (n, 3) of a range, and t or e (n, K) of each axis that leans, eq. (3).

    Parameters
    ----------
    name : str
        'tilt:±DEGREES' or 'force:±G'.
    axes : tuple of str
        The axes of the outputs; K of them are different.

    Raises
    ------
    UsageError
        No such range.
    """
    kind, _, text = name.partition(":")
    try:
        size = abs(float(text.replace("±", "").replace("+-", "")))
    except ValueError:
        size = 0.0
    largest, unit = (89.0, "degrees") if kind == "tilt" else (1.0, "g")
    if not 0.0 < size <= largest:
        raise UsageError(
            f"criterion '{name}': give {kind}:±SIZE with a size above 0 and up to {largest:g} "
            f"{unit}, such as {kind}:±{'30' if kind == 'tilt' else '0.5'}."
        )
    sensed = [i for i, axis in enumerate(COMPONENTS) if axis in axes]
    up, leaning = _leaning(kind, size, sensed)
    directions = []
    for i in leaning:
        along = np.tile(np.eye(3)[i], (len(up), 1))
        if kind == "tilt":
            level = np.sqrt(1.0 - up[:, [i]] ** 2)
            away = along - up * up[:, [i]] if len(sensed) == len(COMPONENTS) else along
            along = away / level
        directions.append(along[:, sensed])
    return up, directions


def _leaning(kind: str, size: float, sensed: list[int]) -> tuple[Array, list[int]]:
    """Return up vectors (n, 3) of a range, and the axes that lean in it."""
    upright = COMPONENTS.index("z")
    leaning = [i for i in sensed if i != upright]
    if not leaning:
        leaning, upright = [upright], 0
    line = np.linspace(-size, size, _LEANS)
    sines = np.sin(np.radians(line)) if kind == "tilt" else line
    grid = np.stack(np.meshgrid(*[sines] * len(leaning)), axis=-1).reshape(-1, len(leaning))
    grid = grid[np.sum(grid**2, axis=1) < 1.0 - 1e-9]
    up = np.zeros((len(grid), 3))
    up[:, leaning] = grid
    up[:, upright] = np.sqrt(1.0 - np.sum(grid**2, axis=1))
    return up, leaning
