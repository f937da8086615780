"""What the nests of stations are: the angle of every position, and the correction that it asks for.

A nest's angles δ_k come from `multipos.fleets.nests`, their mean over the units of a station. The
correction lists each position where it was,

    u_k = R(δ_k) u_k,listed,                                                                 (1)

as the columns of a scheme, and what is left of doubt about it as a budget: `orientation`, of which
the standard uncertainty is

    u² = mean over positions of (u_x² + u_y² + u_z²)/2,                                      (2)

half, because a turn about what is up does not show. A rotation that all positions share is not in
it: units take it for cross terms, and no fleet can tell it.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from multipos.fleets.nests import NestSums
from multipos.numerics.arrays import Array
from multipos.numerics.rotations import rotation_matrix
from multipos.numerics.terms import COMPONENTS

FEWEST = 10  # units that a correction rests on: of fewer it adds as much doubt as it takes away


def describe_nests(nests: Sequence[NestSums]) -> dict[int, dict[str, Any]]:
    """Return `positions_deg` and `correction` of every station, of its commonest positions."""
    joined: dict[tuple[int, tuple[str, ...], bytes], list[NestSums]] = {}
    for each in nests:
        key = (each.station, each.labels, each.told.tobytes())
        joined.setdefault(key, []).append(each)
    most: dict[int, list[NestSums]] = {}
    for (station, _, _), parts in joined.items():
        known = most.get(station, [])
        if sum(p.units for p in parts) > sum(p.units for p in known):
            most[station] = parts
    return {station: _described(parts) for station, parts in most.items()}


def _described(parts: Sequence[NestSums]) -> dict[str, Any]:
    count = sum(part.units for part in parts)
    mean = np.asarray(sum(part.total for part in parts) / count)
    square = sum(part.square for part in parts) / count
    u = np.sqrt(np.maximum(square - mean**2, 0.0) / max(count - 1, 1))
    return {
        "positions_deg": _angles(parts[0], np.degrees(mean), np.degrees(u), count),
        "correction": _correction(parts, mean, u, count),
    }


def _angles(nest: NestSums, value: Array, u: Array, count: int) -> list[dict[str, Any]]:
    found = []
    for row, (label, told) in enumerate(zip(nest.labels, nest.told, strict=True)):
        angles = {
            axis: {"value": float(value[row, i]), "u": float(u[row, i])} if count > 1 else None
            for i, axis in enumerate(COMPONENTS)
        }
        found.append({"position": label, **(angles if told else dict.fromkeys(COMPONENTS))})
    return found


def _correction(
    parts: Sequence[NestSums], mean: Array, u: Array, count: int
) -> dict[str, Any] | None:
    """Return eqs. (1) and (2) as a scheme and a budget; None where an angle is not told."""
    first = parts[0]
    alike = all(np.array_equal(part.up, first.up) for part in parts)
    if count < FEWEST or not first.told.all() or not alike:
        return None
    labels = list(dict.fromkeys(first.labels))
    member = np.array([labels.index(label) for label in first.labels])
    heads = np.array([first.labels.index(label) for label in labels])
    if not np.array_equal(first.up, first.up[heads][member]):
        return None  # one label, two positions
    # rows that repeat a position share its angle
    angle = np.array([mean[member == place].mean(axis=0) for place in range(len(labels))])
    up = np.array([rotation_matrix(a) @ f for a, f in zip(angle, first.up[heads], strict=True)])
    size = float(np.degrees(np.sqrt(np.sum(u**2) / (2 * len(u)))))
    columns = {f"up_{axis}": up[:, i].tolist() for i, axis in enumerate(COMPONENTS)}
    return {
        "scheme": {"position": labels, **columns},
        "budget": {"orientation": {"u_deg": size, "dof": float(count - 1)}},
    }
