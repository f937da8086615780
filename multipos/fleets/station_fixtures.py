"""The angle of every position of a station's fixture, and the correction that it asks for.

- `describe_fixtures` returns both for every station.

A fixture's angles δ_k come from `multipos.fleets.fixtures`, their mean over the units of a station.
The correction lists each position where it was,

    u_k = R(δ_k) u_k,listed,                                                                 (1)

as the columns of a scheme, and what is left of doubt about it as a budget: `orientation`, of which
the standard uncertainty is

    u² = mean over positions of (u_x² + u_y² + u_z²)/2,                                      (2)

half, because a turn about what is up does not show. A rotation that all positions share is not in
it: units take it for cross terms, and no fleet can determine it.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from multipos.fleets.fixtures import FixtureSums
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.numerics.rotations import rotation_matrix

_VERTICAL = 1e-9  # 1 − cosine, nearer than which an axis is the vertical
FEWEST = 10  # units that a correction rests on: of fewer it adds as much doubt as it takes away


def describe_fixtures(fixtures: Sequence[FixtureSums]) -> dict[int, dict[str, Any]]:
    """Return `positions_deg` and `correction` of every station, of its commonest positions."""
    joined: dict[tuple[int, tuple[str, ...], bytes], list[FixtureSums]] = {}
    for each in fixtures:
        key = (each.station, each.labels, each.identifiable.tobytes())
        joined.setdefault(key, []).append(each)
    most: dict[int, list[FixtureSums]] = {}
    for (station, _, _), parts in joined.items():
        known = most.get(station, [])
        if sum(p.units for p in parts) > sum(p.units for p in known):
            most[station] = parts
    return {station: _described(parts) for station, parts in most.items()}


def _described(parts: Sequence[FixtureSums]) -> dict[str, Any]:
    count = sum(part.units for part in parts)
    mean = np.asarray(sum(part.total for part in parts) / count)
    square = sum(part.square for part in parts) / count
    u = np.sqrt(np.maximum(square - mean**2, 0.0) / max(count - 1, 1))
    return {
        "positions_deg": _angles(parts[0], np.degrees(mean), np.degrees(u), count),
        "correction": _correction(parts, mean, u, count),
    }


def _angles(fixture: FixtureSums, value: Array, u: Array, count: int) -> list[dict[str, Any]]:
    """Return the angles of positions, none about the vertical: such a turn changes no reading."""
    seen = fixture.identifiable[:, None] & (np.abs(fixture.up) < 1.0 - _VERTICAL) & (count > 1)
    return [
        {"position": label}
        | {
            axis: {"value": float(value[row, i]), "u": float(u[row, i])} if seen[row, i] else None
            for i, axis in enumerate(COMPONENTS)
        }
        for row, label in enumerate(fixture.labels)
    ]


def _correction(
    parts: Sequence[FixtureSums], mean: Array, u: Array, count: int
) -> dict[str, Any] | None:
    """Return eqs. (1) and (2) as a scheme and a budget; None where an angle is not identifiable."""
    first = parts[0]
    alike = all(np.array_equal(part.up, first.up) for part in parts)
    if count < FEWEST or not first.identifiable.all() or not alike:
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
