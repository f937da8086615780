"""Many units whose readings state their noise, on positions that they share.

Units share the design X = Q R of an output, and not the stated uncertainties u (B, n), so that
every unit has weights of its own. From the plain fit b₀ with exact residuals r
(`multipos.estimation.batches`), the weighted one is

    b = b₀ + R⁻¹ d,    (Q'WQ) d = Q'W r,    W = diag 1/(u² + τ²),                           (1)

whose rounding is relative to the residuals. It is worked out with τ = 0; what units scatter beside
their claims, τ², is integrated over by `multipos.estimation.scatter`, of all units at once; and (1)
again with the τ² that was found. Uncertainties with degrees of freedom d go through
`multipos.estimation.claimed_noise` on their way in and out.

A unit is left to `fit` where its weights differ by more than double precision takes.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from multipos.estimation.batches import (
    ROUNDING,
    Estimates,
    SharedDesign,
    fit_output,
    join_estimates,
    rms_of,
)
from multipos.estimation.claimed_noise import carried_dof, take_claims
from multipos.estimation.known import per_parameter
from multipos.estimation.scatter import find_scatter
from multipos.files.records import LARGEST
from multipos.numerics.arrays import Array

_AT_ONCE = 12_000  # readings of an output, so that what they need stays small
_TURNS = 2  # of eq. (1), the second for what the first one rounded


def estimate_stated(
    shared: SharedDesign,
    values: Sequence[Array],
    stated: Sequence[Array],
    claimed: Sequence[Array],
    *,
    pool: bool = False,
) -> Estimates:
    """Fit B units by weighted least squares, eq. (1), with the scatter beside what they state.

    Parameters
    ----------
    shared : SharedDesign
    values, stated : sequences of M arrays (B, n)
        Readings of each output, and their standard uncertainties u.
    claimed : sequence of M arrays (B, n), or of none
        Degrees of freedom of u.
    pool : bool
        One scatter for all outputs of a unit.
    """
    count, n = values[0].shape
    step = max(1, _AT_ONCE // n)
    factors = [_factor(design) for design in shared.designs]
    parts = []
    for first in range(0, count, step):
        rows = slice(first, first + step)
        mine = [tuple(each[rows] for each in arrays) for arrays in (values, stated, claimed)]
        parts.append(_estimate(shared, factors, *mine, pool=pool))
    return join_estimates(parts)


class _Factors(NamedTuple):
    """A design as Q (n, p) R (p, p), and the products of the columns of Q (n, p²)."""

    Q: Array
    R: Array
    squares: Array


def _factor(design: Array) -> _Factors:
    Q, R = np.linalg.qr(design)
    return _Factors(Q, R, (Q[:, :, None] * Q[:, None, :]).reshape(len(Q), -1))


def _estimate(
    shared: SharedDesign,
    factors: Sequence[_Factors],
    values: Sequence[Array],
    stated: Sequence[Array],
    claimed: Sequence[Array],
    *,
    pool: bool,
) -> Estimates:
    model = shared.model
    u, dof, sound = take_claims(stated, claimed)
    floor = u**2
    designs = zip(shared.designs, shared.inverses, values, strict=True)
    plain = [fit_output(design, inverse, y) for design, inverse, y in designs]
    for (_, r), y in zip(plain, values, strict=True):
        sound &= np.einsum("bn,bn->b", r, r) > ROUNDING**2 * np.einsum("bn,bn->b", y, y)
    first = _weigh(factors, plain, floor)
    residuals = np.stack([r for _, r in first], axis=2)
    found = find_scatter(shared.designs, residuals, floor, pool=pool)
    second = _weigh(factors, plain, floor + found.variance[:, None])
    parameters = np.concatenate([b for b, _ in second], axis=1)
    moves = parameters - np.concatenate([b for b, _ in first], axis=1)
    known = per_parameter(model, found.dof)
    own = found.standard_uncertainty(moves, known)
    if dof is not None:
        known = per_parameter(model, carried_dof(found.dof, floor, dof, found.variance))
    rms, inverse, inverted = rms_of(shared, parameters, values, [r for _, r in second])
    sound &= inverted & (np.abs(parameters).max(axis=1) <= LARGEST)
    left = tuple(r for _, r in plain)
    chi2 = np.sum(residuals**2 / floor, axis=(1, 2))
    return Estimates(parameters, own, known, rms, left, inverse, sound, chi2)


def _weigh(
    factors: Sequence[_Factors], plain: Sequence[tuple[Array, Array]], variances: Array
) -> list[tuple[Array, Array]]:
    """Return coefficients (B, p) and residuals (B, n) of every output, eq. (1)."""
    weighed = []
    for i, ((Q, R, squares), (b, r)) in enumerate(zip(factors, plain, strict=True)):
        weight = 1.0 / variances[:, :, i]
        if not np.ptp(weight, axis=1).any():  # alike: as the plain fit
            weighed.append((b, r))
            continue
        p = len(R)
        information = (weight @ squares).reshape(-1, p, p)
        d = np.zeros((len(b), p))
        left = r
        for _ in range(_TURNS):
            d += np.linalg.solve(information, ((weight * left) @ Q)[:, :, None])[:, :, 0]
            left = r - d @ Q.T
        weighed.append((b + np.linalg.solve(R, d.T).T, left))
    return weighed
