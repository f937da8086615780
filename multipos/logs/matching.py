"""Which position of a scheme each rest is: the nearest direction, or the next of the list.

`match_rests` matches by label, by direction or in order, and refuses what is doubtful;
`match_directions` matches by direction alone.

The raw readings of three outputs show a direction once bias and scale factor are roughly known.
Both follow, output by output, from the readings themselves: first from their range against the
range of the scheme, then from the least-squares line through the positions found, until the
positions stay the same. Misalignment and orientation error remain as the distance, an angle. A rest
is doubtful where that angle is large, or the second-nearest direction is not twice as far.

Fewer than three outputs read the same of two directions. Their rests are taken as the positions of
the scheme in order, one each, and are doubtful where they are far from what the scheme makes them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from multipos.errors import MultiposError
from multipos.numerics.arrays import Array, Mask
from multipos.positions.attitudes import Convention
from multipos.positions.scheme import Scheme

FARTHEST_DEG = 20.0
_STEPS = 20
_SPREAD = 0.5  # [g] a scheme must move an axis by, to show its scale factor


class Match(NamedTuple):
    """For each rest the row of the scheme and the angles to the nearest two directions."""

    rows: list[int]
    distance_deg: Array
    second_deg: Array

    @property
    def doubtful(self) -> Mask:
        """Where the nearest direction may be the wrong one."""
        far = self.distance_deg > FARTHEST_DEG
        return np.asarray(far | (2.0 * self.distance_deg > self.second_deg))


def match_rests(
    means: Array,
    axes: Sequence[int],
    labels: Sequence[str],
    where: Sequence[str],
    scheme: Scheme,
    convention: Convention,
) -> Match:
    """Match rests to the positions of a scheme: by label, by direction, or in order.

    Parameters
    ----------
    means : (n, M) array
        Mean outputs.
    axes : sequence of M int
        The axis, 0 to 2, that each senses.
    labels : sequence of str
        What the user calls each rest, '' where nothing. Where all are labels of the scheme they
        tell the positions.
    where : sequence of str
        Where the rests are, in messages.
    scheme : Scheme
    convention : str
        'specific-force' or 'gravity'.

    Raises
    ------
    MultiposError
        A rest is far from its position, or as near to another; or rests of fewer than three
        outputs are not as many as the positions.
    """
    known = scheme.names
    if all(label in known for label in labels):
        rows = [known.index(label) for label in labels]
        match = _match_rows(means, axes, rows, scheme, convention)
    elif means.shape[1] == 3:
        match = match_directions(means[:, np.argsort(axes)], scheme, convention)
    else:
        match = _match_in_order(means, axes, scheme, convention)
    bad = np.flatnonzero(match.doubtful).tolist()
    if not bad:
        return match
    i = bad[0]
    second = ""
    if np.isfinite(match.second_deg[i]):
        second = f" and {match.second_deg[i]:.1f} from the next"
    raise MultiposError(
        f"{len(bad)} of {len(means)} rests match no position of scheme '{scheme.name}': rest "
        f"'{labels[i] or i + 1}' {where[i]} lies {match.distance_deg[i]:.1f} degrees from position "
        f"'{known[match.rows[i]]}'{second} (the nearest must be within {FARTHEST_DEG:g} degrees "
        "and twice as near as the next); name the right rests with --only, or leave --scheme out "
        "and use fit --unknown-orientation."
    )


def _match_in_order(
    means: Array, axes: Sequence[int], scheme: Scheme, convention: Convention
) -> Match:
    """Match rests of fewer than three outputs to all positions of a scheme, in order."""
    count, outputs = means.shape
    if count != len(scheme):
        raise MultiposError(
            f"{outputs} outputs do not show a direction, so that rests are taken as the positions "
            f"in order, but {count} rests were found and scheme '{scheme.name}' has "
            f"{len(scheme)} positions; choose the rests with --only, --min-duration or "
            "--threshold, or name them with --sections."
        )
    return _match_rows(means, axes, [*range(count)], scheme, convention)


def _match_rows(
    means: Array, axes: Sequence[int], rows: list[int], scheme: Scheme, convention: Convention
) -> Match:
    """Return how far rests are from positions that are known, after a line of each output."""
    targets = (-1.0 if convention == "gravity" else 1.0) * scheme.up[rows][:, list(axes)]
    off = np.zeros(len(rows))
    for mean, target in zip(means.T, targets.T, strict=True):
        if np.ptp(target) <= _SPREAD:
            continue
        line = np.column_stack([np.ones(len(rows)), target])
        (bias, scale), *_ = np.linalg.lstsq(line, mean, rcond=None)
        if not scale:
            raise _nothing_moves()
        off += ((mean - bias) / scale - target) ** 2
    chord = np.minimum(np.sqrt(off) / 2.0, 1.0)
    return Match(rows, np.degrees(2.0 * np.arcsin(chord)), np.full(len(rows), np.inf))


def _nothing_moves() -> MultiposError:
    return MultiposError(
        "the rests do not move any output as the scheme does; check --scheme and --outputs."
    )


def match_directions(means: Array, scheme: Scheme, convention: Convention) -> Match:
    """Match rests to the positions of a scheme by direction.

    Parameters
    ----------
    means : (n, 3) array
        Mean outputs, on axes x, y, z.
    scheme : Scheme
    convention : str
        'specific-force' or 'gravity'.
    """
    targets = (-1.0 if convention == "gravity" else 1.0) * scheme.up
    bias, scale = _from_ranges(means, targets)
    rows: list[int] = []
    for _ in range(_STEPS):
        direction = (means - bias) / scale
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        cosine = direction @ targets.T
        nearest = np.argmax(cosine, axis=1).tolist()
        if nearest == rows:
            break
        rows = nearest
        bias, scale = _from_lines(means, targets[rows], scale)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    distance = angle[np.arange(len(rows)), rows]
    # Shared directions are one: the second-nearest is the nearest that points elsewhere.
    same = scheme.up[rows] @ scheme.up.T > 1.0 - 1e-9
    second = np.where(same, np.inf, angle).min(axis=1)
    return Match(_spread_over(rows, scheme), distance, second)


def _from_ranges(means: Array, targets: Array) -> tuple[Array, Array]:
    span, wanted = np.ptp(means, axis=0), np.ptp(targets, axis=0)
    shown = wanted > _SPREAD
    if not shown.any() or not span[shown].all():
        raise _nothing_moves()
    scale = np.ones(3)
    scale[shown] = span[shown] / wanted[shown]
    scale[~shown] = scale[shown].mean()
    middle, centre = means.min(axis=0) + span / 2.0, targets.min(axis=0) + wanted / 2.0
    return middle - scale * centre, scale


def _from_lines(means: Array, targets: Array, scale: Array) -> tuple[Array, Array]:
    deviation = targets - targets.mean(axis=0)
    square = (deviation**2).sum(axis=0)
    slope = (deviation * (means - means.mean(axis=0))).sum(axis=0)
    shown = (np.ptp(targets, axis=0) > _SPREAD) & (slope > 0.0)
    scale = np.where(shown, slope / np.where(shown, square, 1.0), scale)
    return means.mean(axis=0) - scale * targets.mean(axis=0), scale


def _spread_over(rows: list[int], scheme: Scheme) -> list[int]:
    """Give rests of one direction to the scheme's positions of that direction one after another."""
    taken: dict[int, int] = {}
    result = []
    for row in rows:
        twins = np.flatnonzero(scheme.up @ scheme.up[row] > 1.0 - 1e-9).tolist()
        first = twins[0]
        result.append(twins[taken.get(first, 0) % len(twins)])
        taken[first] = taken.get(first, 0) + 1
    return result
