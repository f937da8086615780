"""Uncertainty with unknown orientations where the noise of the three axes may be unequal.

Where nothing is known of any position of a triad, a position is one number r, what is left along
the normal m of `multipos.estimation.unknown_orientations`, and the noise e of that number is made
of those of three axes. With c_kj the fraction of axis j in it where all axes are equal, s_j how
much more there is of it, c_k0 the fraction that is stated (s_0 = 1), the rows a = A'm and
S = sum a a',

    Var e_k = sum_j s_j c_kj,     p − p₀ = S⁻¹ sum a e,     Cov p = sum_j s_j K_j,          (1)
    K_j = S⁻¹ (sum c_kj a a') S⁻¹,     V_kj = (1 − 2h_k) c_kj + a_k'K_j a_k,                (2)

h = a'S⁻¹a, and sum_j s_j V_kj is the variance of r_k. Readings determine the ratios of the s_j
poorly: that axes are equal is seldom rejected, and U that assumes it covers too few of the
parameters that depend on one axis. So ratios are integrated over. With v_k = sum_j s_j V_kj, the
weights w = 1 − h, whose sum is the degrees of freedom ν, and q = sum w r²/v / ν, their likelihood
is

    ln L = −½ sum w ln v − ½ ν ln q,                                                         (3)

that of residuals taken for independent, and of a size common to all axes integrated over. Given
the ratios, a parameter is Student's t_ν of variance q Cov p, and U is that of their mixture at
95 %: S⁻¹ F/ν and t_ν where axes are equal. The logarithms of the s_j are normal about each other
beforehand, by a factor e² of a standard deviation, and the mixture is a sum over a lattice about
the most likely ratios, to some 3 % of U. docs/theory/orientations.md has what it covers.

Source: C. Varin, N. Reid, D. Firth, Statistica Sinica 21, 2011 (likelihoods of parts).
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from multipos.numerics.arrays import Array

_SPREAD = 4.0  # sd of ln s beforehand, a factor of 7 in noise
_STEPS = 12  # of scoring
_NEAR = 0.03  # a step of ln s after which it ends: nodes are weighted, wherever they are
_LONGEST = 2.0  # step of ln s
_NOTHING = 1e-9  # a fraction that is rounding: of what is stated, and 1 − h of a position that one
# parameter fits alone, which has no information
_COVERAGE = 0.95  # at which U is taken
_MOST_DOF = 1000.0  # beyond which Student's t is normal to a thousandth
_STEPS_OF_TABLE = 4096
_CONVERGED = 1e-6  # relative change of U; the next one is a thousandth of it

# Coordinates x of the ratios, ln s = x AXES: that of what is stated is 0, and so is the sum.
_AXES = np.array([[0.0, 1.0, -1.0, 0.0], [0.0, 1.0, 1.0, -2.0]]) / np.sqrt([[2.0], [6.0]])
# A hexagonal lattice in units of their standard deviations, whose sums are integrals: 19 nodes.
_SPACING, _RADIUS = 1.5, 3.0
_SIDES = np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]]) * _SPACING
_LATTICE = np.array([[i, j] for i in range(-2, 3) for j in range(-2, 3)]) @ _SIDES
_NODES = _LATTICE[np.linalg.norm(_LATTICE, axis=1) < _RADIUS + 0.1]


class _Parts(NamedTuple):
    """What the parts of the noise mean to B units, eq. (2)."""

    K: Array  # (B, J, p, p), J = 4, or 3 where nothing is stated
    V: Array  # (B, J, n)
    squares: Array  # r², (B, n)
    weight: Array  # w, (B, n)
    dof: float


def allow_for_axes(rows: Array, height: Array, unstated: Array, inverse: Array) -> Array:
    """Return S⁻¹ widened for axes of unequal noise, (B, p, p): times F/ν a covariance.

    Its diagonal is (U/k)² over F/ν, with k of Student's t at ν = n − p degrees of freedom.

    Parameters
    ----------
    rows : (B, p, n) array
        a of each position.
    height : (B, n) array
        r.
    unstated : (B, 3, n) array
        c of the axes: fractions of the variance of e, which is 1 in all, that are not stated.
    inverse : (B, p, p) array
        S⁻¹.
    """
    parts = _divide(rows, height, unstated, inverse)
    weights, s = _mixture(parts)
    variances = s @ np.einsum("bjpp->bjp", parts.K)
    u = _half_interval(weights, variances, min(parts.dof, _MOST_DOF))
    mean = np.einsum("bg,bgj,bjpq->bpq", weights, s, parts.K)
    scale = u / np.sqrt(np.einsum("bpp->bp", mean))
    return np.asarray(mean * scale[:, :, None] * scale[:, None])


def _divide(rows: Array, height: Array, unstated: Array, inverse: Array) -> _Parts:
    """Return eq. (2), r with a mean square of 1 over ν."""
    _, p, n = rows.shape
    moved = inverse @ rows
    left = 1.0 - (rows * moved).sum(axis=1)
    informative = left > _NOTHING
    stated = 1.0 - unstated.sum(axis=1, keepdims=True)
    # any(), as a unit that is no number must not decide for the others
    c = np.concatenate([stated, unstated], axis=1) if (stated > _NOTHING).any() else unstated
    K = (moved[:, None] * c[:, :, None]) @ np.swapaxes(moved, 1, 2)[:, None]
    V = (2.0 * left - 1.0)[:, None] * c + (rows[:, None] * (K @ rows[:, None])).sum(axis=2)
    V = np.where(informative[:, None], np.maximum(V, 0.0), 1.0)
    squares = height**2
    squares *= (n - p) / squares.sum(axis=1, keepdims=True)
    return _Parts(K, V, squares, np.where(informative, left, 0.0), float(n - p))


def _axes(parts: _Parts) -> Array:
    return _AXES[:, -parts.V.shape[1] :]


def _mixture(parts: _Parts) -> tuple[Array, Array]:
    """Return the probabilities (B, G) of nodes, and the s (B, G, J) there, times q."""
    x, root = _most_likely(parts)
    nodes = x[:, None] + _NODES @ np.swapaxes(root, 1, 2)
    s = np.exp(nodes @ _axes(parts))
    v = s @ parts.V
    weight = parts.weight[:, :, None]
    q = (parts.squares[:, None] / v @ weight)[:, :, 0] / parts.dof
    log = (np.log(v) @ weight)[:, :, 0] + parts.dof * np.log(q)
    log = -0.5 * (log + (nodes**2).sum(axis=2) / _SPREAD**2)
    weights = np.exp(log - log.max(axis=1, keepdims=True))
    return weights / weights.sum(axis=1, keepdims=True), s * q[:, :, None]


def _most_likely(parts: _Parts) -> tuple[Array, Array]:
    """Return the most likely ratios x (B, 2), and a root (B, 2, 2) of their covariance."""
    axes = _axes(parts)
    x = np.zeros((len(parts.squares), 2))
    searched = np.ones((len(x), 1), dtype=np.bool_)
    weight = parts.weight[:, None]
    for _ in range(_STEPS):
        s = np.exp(x @ axes)[:, :, None]
        shares = parts.V * s
        v = shares.sum(axis=1)
        slopes = axes @ (shares / v[:, None])
        weighted = slopes * weight
        mean = weighted.sum(axis=2, keepdims=True)
        information = weighted @ np.swapaxes(slopes, 1, 2)
        information -= mean * np.swapaxes(mean, 1, 2) / parts.dof
        # the inverse of [[a, b], [b, c]], whatever they are
        a, b, c = (information[:, i, j, None] / 2.0 for i, j in ((0, 0), (0, 1), (1, 1)))
        a, c = (np.maximum(each, 0.0) + 1.0 / _SPREAD**2 for each in (a, c))
        # no less than that of what is known beforehand, but for rounding
        determinant = np.maximum(a * c - b**2, 1.0 / _SPREAD**4)
        if not searched.any():
            break
        z = (parts.squares / v)[:, :, None]
        score = weighted @ z
        score *= parts.dof / (weight @ z)
        right = (score - mean)[:, :, 0] / 2.0 - x / _SPREAD**2
        move = (np.hstack([c, a]) * right - b * right[:, ::-1]) / determinant
        length = np.hypot(move[:, :1], move[:, 1:])
        x = x + searched * move * (_LONGEST / np.maximum(length, _LONGEST))
        searched &= length > _NEAR
    root = np.zeros((len(x), 2, 2))
    root[:, :1, 0], root[:, 1:, 1] = np.sqrt(c / determinant), 1.0 / np.sqrt(c)
    root[:, 1:, 0] = -b / np.sqrt(c * determinant)
    return x, root


def _half_interval(weights: Array, variances: Array, dof: float) -> Array:
    """Return U/k of mixtures of t: (B, G) weights of variances (B, G, p)."""
    table = _student(dof)
    scale = np.sqrt(variances * dof)
    chance = weights[:, None]
    U = table.k * np.sqrt((chance @ variances)[:, 0])
    for _ in range(30):
        whole = U[:, None] + scale
        place = U[:, None] / whole * _STEPS_OF_TABLE
        step = np.minimum(place, _STEPS_OF_TABLE - 1.0).astype(np.intp)
        # clipped for units that are not numbers
        rise = table.rise.take(step, mode="clip")
        inside = chance @ (table.inside.take(step, mode="clip") + (place - step) * rise)
        slope = chance @ (rise * scale / whole**2) * _STEPS_OF_TABLE
        move = ((_COVERAGE - inside) / slope)[:, 0]
        U = np.maximum(U + move, 0.5 * U)
        if not (np.abs(move) > _CONVERGED * U).any():  # nan has no end
            break
    return np.asarray(U / table.k)


class _Student(NamedTuple):
    """Student's t at even steps of r/(1 + r), r = t/√ν."""

    inside: Array  # probability between −t and t
    rise: Array  # of it, to the next step
    k: float


@lru_cache(16)
def _student(dof: float) -> _Student:
    """Return the law that has the density cos^(ν − 1) of the angle whose tangent is r."""
    place = np.linspace(0.0, 1.0, _STEPS_OF_TABLE + 1)
    angle = np.arctan2(place, 1.0 - place)
    density = np.cos(angle) ** (dof - 1.0)
    rise = (density[1:] + density[:-1]) * np.diff(angle)
    rise /= rise.sum()
    inside = np.concatenate([[0.0], np.cumsum(rise)])
    at = np.interp(_COVERAGE, inside, place)
    return _Student(inside, rise, float(np.sqrt(dof) * at / (1.0 - at)))
