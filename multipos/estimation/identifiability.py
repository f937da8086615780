"""Parameters that a set of positions cannot determine, in words, and positions that would.

`condition` is that of an information matrix and `require_separable` refuses a singular one.
`plausible_range` is how large u may be, `formal_only` names parameters beyond it, and
`least_determined` those left over. `helpful_positions` would help most, and `position_words` says
where they are.

The information S (p, p) of the parameters is judged with its diagonal scaled to one; directions
whose eigenvalue is below 1e-12 of the largest are not seen at all, and are named. A parameter
can also be estimable only formally: at one g its uncertainty exceeds half a scale factor, more
than any real sensor could be off, so the data say nothing about it.
"""

from collections.abc import Sequence

import numpy as np

from multipos.errors import RankError
from multipos.numerics.arrays import SMALLEST, Array
from multipos.numerics.factoring import log_determinant
from multipos.numerics.separability import join_combinations, name_combinations, separability
from multipos.sensor.model import Model

UNSEEN = 1e-12  # eigenvalue of the scaled information: sd a million times that of the best
_PLAUSIBLE = 0.5  # of a scale factor, at one g
CANDIDATES = np.array(
    [[x, y, z] for x in (1, 0, -1) for y in (1, 0, -1) for z in (1, 0, -1) if x or y or z],
    dtype=np.float64,
)
CANDIDATES /= np.linalg.norm(CANDIDATES, axis=1)[:, None]


def condition(information: Array) -> float:
    """Return the 2-norm condition of the scaled problem whose information is given."""
    diagonal = np.diag(information)
    if not (diagonal > 0.0).all():
        return np.inf
    scale = np.sqrt(diagonal)
    eigenvalues = np.linalg.eigvalsh(information / np.outer(scale, scale))
    if eigenvalues[0] <= UNSEEN * eigenvalues[-1]:
        return np.inf
    return float(np.sqrt(eigenvalues[-1] / eigenvalues[0]))


def require_separable(information: Array, names: Sequence[str], way_out: str) -> None:
    """Refuse an information matrix that leaves combinations of parameters unseen.

    Raises
    ------
    RankError
        Naming the combinations.
    """
    if np.isfinite(condition(information)):
        return
    scale = np.sqrt(np.maximum(np.diag(information), 0.0))
    safe = np.where(scale > 0.0, scale, 1.0)
    eigenvalues, vectors = np.linalg.eigh(information / np.outer(safe, safe))
    seen = eigenvalues > UNSEEN * eigenvalues[-1]
    root = np.sqrt(np.where(seen, eigenvalues, 0.0))[:, None] * vectors.T * scale
    found = separability(root)
    said = name_combinations(found.null, names)
    raise RankError(
        f"{int(seen.sum())} of {len(names)} parameters can be separated: "
        f"{join_combinations(said)}; {way_out}.",
        rank=int(seen.sum()),
        parameters=len(names),
        combinations=said,
    )


def plausible_range(model: Model, parameters: Array, magnitude: float) -> Array | None:
    """Return the largest plausible size of each parameter's u (p,), None without scale factors."""
    if not model.own_scales:
        return None
    own = float(np.abs(parameters[list(model.own_scales)]).mean())
    return np.asarray(_PLAUSIBLE * own * magnitude ** (1.0 - model.force_degrees))


def formal_only(model: Model, parameters: Array, u: Array, magnitude: float) -> tuple[str, ...]:
    """Name the parameters that are estimable only formally: their u exceeds what is plausible."""
    limit = plausible_range(model, parameters, magnitude)
    if limit is None or (u <= limit).all() or not np.isfinite(u).all():
        return ()
    return tuple(
        f"`{name}` is estimable only formally: its u = {sd:.2g} exceeds its plausible range"
        for name, sd, bad in zip(model.names, u.tolist(), (u > limit).tolist(), strict=True)
        if bad
    )


def least_determined(information: Array, rank: int) -> list[int]:
    """Return the parameters left over when the best determined `rank` ones are picked first."""
    rest = information.copy()
    left = list(range(len(information)))
    for _ in range(rank):
        pivot = max(left, key=lambda i: rest[i, i])
        if rest[pivot, pivot] <= 0.0:
            break
        left.remove(pivot)
        column = rest[:, pivot] / np.sqrt(rest[pivot, pivot])
        rest -= np.outer(column, column)
    return left


def helpful_positions(information: Array, gains: Array, count: int) -> list[int]:
    """Return which candidate positions add most information, picked one by one.

    Parameters
    ----------
    information : (p, p) array
        What is known already.
    gains : (c, p, p) array
        What each candidate would add; one without finite slopes adds nothing.
    count : int
    """
    gains = np.where(np.isfinite(gains).all(axis=(1, 2), keepdims=True), gains, 0.0)
    largest = np.maximum(np.abs(information).max(axis=1), np.abs(gains).max(axis=(0, 2)))
    seen = np.maximum(np.diag(gains.sum(axis=0)), SMALLEST * largest)
    scale = np.sqrt(np.maximum(seen, 1e-300))
    unit = np.outer(scale, scale)
    # A ridge far below any real information lets the determinant rank singular ones.
    current = information / unit + 1e-9 * np.eye(len(scale))
    scaled = gains / unit
    chosen: list[int] = []
    for _ in range(count):
        best = int(np.argmax(log_determinant(current + scaled)[1]))
        chosen.append(best)
        current = current + scaled[best]
    return chosen


def position_words(directions: Array) -> str:
    """Return up vectors in words: ``up (0.71, 0.71, 0)``."""
    return ", ".join(
        "up (" + ", ".join(f"{value + 0.0:.2g}" for value in row) + ")"
        for row in directions.tolist()
    )
