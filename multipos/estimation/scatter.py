"""What readings scatter beyond the uncertainty they state, and what that leaves of the parameters.

A stated uncertainty is a floor: a reading of output i at position k has variance

    V_ki = u_ki² + τ²,                                                                      (1)

u what is stated (the scatter within a rest, a data sheet) and τ what readings differ by from rest
to rest. τ is not decided upon but integrated over. Its posterior is the restricted likelihood

    ln L(τ²) = −½ [Σ ln V + ln det X'V⁻¹X + e'V⁻¹e − e'V⁻¹X (X'V⁻¹X)⁻¹ X'V⁻¹e]              (2)

times Jeffreys' prior, dτ² (Σ V⁻²)^½, which is d ln V where all u are alike, plus a chance that the
claim is right, τ = 0, which weighs as much as `_BELIEF` of such a logarithm. Without a stated part
the posterior of V is that of r'r/χ²_ν, and parameters follow Student's t; with one it is cut off at
the floor. Parameters then are a mixture of normal laws, and

- the fit is weighted by u² + τ² at the τ² for which 1/V, of a typical u, is its posterior mean;
- U is half the interval about the estimate that holds the mixture with the confidence of 95 %;
- the degrees of freedom are those of the posterior of V,

      ν = 2 (E 1/V)² / var(1/V),                                                            (3)

  and u = U/k, with k of Student's t at ν.

The belief was chosen by coverage: with 6 degrees of freedom U is 23 % larger than where u is right
and known to be, and covers 94 % or more whatever part of the noise u is; a test that believes or
denies covers 73 % where u is half the noise (`docs/studies/noise`).

References
----------
D. A. Harville 1977, J. Am. Stat. Assoc. 72, eq. (2); H. Jeffreys, *Theory of Probability*, 1961,
section 3.10.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.numerics.arrays import Array
from multipos.numerics.least_squares import block_design
from multipos.numerics.quantiles import coverage_factor
from multipos.sensor.diagnostics import UNEQUAL, bartlett

_BELIEF = 1.4  # what "the claim is right" weighs, in units of ln V, from six degrees of freedom on
_FEW = 6.0  # degrees of freedom below which the claim must weigh more, or U is too long
_RISE = 2.0  # power of 1/ν by which it does
_COVERAGE = 0.95  # at which U and Student's t are made to agree
_INNER = 0.68  # beside it, what tells how heavy the tails are
# Below so many degrees of freedom, so many nodes: a posterior of many is nearly normal, of which
# the trapezoidal rule asks for one node a standard deviation.
_NODES = ((100.0, 48), (1000.0, 32), (math.inf, 24))
_NARROWED = 3  # times that the range is cut to where something is probable
NEGLIGIBLE = 30.0  # of -2 ln: one part in three million of the posterior
_ROWS = 20_000  # readings worked on at once
_MOST_DOF = 1000.0  # beyond which Student's t is normal to a thousandth
_SHAPES = 64  # steps of degrees of freedom, between which tails are nearly straight
_SAME = 1e-9  # relative difference of mixtures that are one
_ROOT = np.sqrt(2.0)
# Element by element: SciPy's takes longer to import than a fit that needs a few hundred values.
_erf = np.frompyfunc(math.erf, 1, 1)
_RIDGE = 1e-13  # of rounding, so that floors of any size leave a matrix that can be inverted


class Part(NamedTuple):
    """Outputs that share a design and floors, as a linear model about its solution.

    Attributes
    ----------
    basis : (n, p) array
        Orthonormal columns Q of the design X = Q R.
    inverse : (p, p) array
        R⁻¹.
    residuals : (n, m) array
        e of every output.
    floor : (n,) array
        Stated variances u².
    """

    basis: Array
    inverse: Array
    residuals: Array
    floor: Array

    @property
    def parameters(self) -> int:
        """Number of parameters of each output."""
        return int(self.basis.shape[1])


class Found(NamedTuple):
    """The posterior density of ln(τ² + size) at nodes (G,), moves and variances (G, p)."""

    log: Array
    moves: Array
    variances: Array


@dataclass(frozen=True)
class Posterior:
    """What is known of τ² and with it of the parameters.

    Attributes
    ----------
    nodes, weights : (G,) arrays
        Values of τ² and their probability.
    moves, variances : (G, p) arrays
        By how much the parameters of all parts move with τ², and their variances c; those of one
        output after those of another.
    size : float
        Of the floors, their harmonic mean: the most precise readings are the first to feel τ.
    """

    nodes: Array
    weights: Array
    moves: Array
    variances: Array
    size: float

    @property
    def summary(self) -> tuple[float, float, float]:
        """τ² whose V is the posterior mean of 1/V, u of τ, and the degrees of freedom of V."""
        precision = 1.0 / (self.size + self.nodes)
        mean = float(self.weights @ precision)
        spread = float(self.weights @ (precision - mean) ** 2)
        dof = 2.0 * mean**2 / spread if spread > 0.0 else np.inf
        sd = np.sqrt(self.nodes)
        u = float(np.sqrt(self.weights @ (sd - self.weights @ sd) ** 2))
        return max(1.0 / mean - self.size, 0.0), u, min(dof, _MOST_DOF)

    def expanded(self, moves: Array) -> Array:
        """Return U (p,) about estimates that moved by `moves` (p,), at 95 %."""
        return self._half(moves, _COVERAGE)

    def _half(self, moves: Array, share: float) -> Array:
        return _half_interval(self.moves - moves, np.sqrt(self.variances), self.weights, share)

    @property
    def shape(self) -> float:
        """Degrees of freedom of the Student's t whose tails are those of the parameters."""
        moves = np.zeros(self.moves.shape[1])
        ratio = float(np.median(self.expanded(moves) / self._half(moves, _INNER)))
        low, high = 0, _SHAPES
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if _tail(middle) > ratio else (low, middle)
        share = (_tail(low) - ratio) / (_tail(low) - _tail(high))
        return float(_MOST_DOF ** ((low + min(max(share, 0.0), 1.0)) / _SHAPES))


@dataclass(frozen=True)
class Scatter:
    """What readings of M outputs scatter beyond what they state, and how well that is known.

    Attributes
    ----------
    variance, u, dof : (M,) arrays
        τ² as the fit takes it, the standard uncertainty of τ, and the degrees of freedom of the
        variance of a reading, u² + τ².
    posteriors : tuple of (members, Posterior)
        Which parameters a posterior is of, in its order.
    """

    variance: Array
    u: Array
    dof: Array
    posteriors: tuple[tuple[NDArray[np.intp], Posterior], ...]

    def standard_uncertainty(self, moves: Array, dof: Array) -> Array:
        """Return u (p,) of estimates that moved by (p,) from the solution at τ = 0."""
        expanded = np.empty(len(moves))
        for members, posterior in self.posteriors:
            expanded[members] = posterior.expanded(moves[members])
        return standard_uncertainty(expanded, dof)


def find_scatter(
    designs: Sequence[Array], residuals: Array, noise: Array, *, pool: bool = False
) -> Scatter:
    """Return the scatter of readings beyond the noise that they state.

    All outputs share one where their equality is not rejected, or where they are correlated.

    Parameters
    ----------
    designs : sequence of M (n, p_i) arrays
    residuals : (n, M) array
        Of the fit weighted by the stated noise.
    noise : (n M,) or (n M, n M) array
        Stated, as `Readings.noise` has it.
    pool : bool
        One scatter whatever the outputs say.
    """
    n, m = residuals.shape
    dof = np.array([n - design.shape[1] for design in designs], dtype=np.float64)
    if noise.ndim == 2:
        return _gather([(np.arange(m), [_rotated(designs, residuals, noise)])], designs)
    floor = noise.reshape(n, m)
    found = _gather([(np.arange(m), _parts(designs, residuals, floor, range(m)))], designs)
    if pool or m == 1 or dof.min() <= 0.0:
        return found
    chi2 = np.sum(residuals**2 / (floor + found.variance), axis=0)
    if not bartlett(chi2, dof) < UNEQUAL:
        return found
    apart = [(np.array([i]), _parts(designs, residuals, floor, [i])) for i in range(m)]
    return _gather(apart, designs)


def _gather(
    groups: Sequence[tuple[NDArray[np.intp], list[tuple[list[int], Part]]]],
    designs: Sequence[Array],
) -> Scatter:
    """Return the scatter of groups of outputs, each of which has its own."""
    m = len(designs)
    variance, u, dof = np.empty(m), np.empty(m), np.empty(m)
    ends = np.cumsum([0, *(design.shape[1] for design in designs)])
    posteriors = []
    for outputs, parts in groups:
        posterior = integrate_parts([part for _, part in parts])
        order = [np.arange(ends[i], ends[i + 1]) for members, _ in parts for i in members]
        posteriors.append((np.concatenate(order), posterior))
        variance[outputs], u[outputs], dof[outputs] = posterior.summary
    return Scatter(variance, u, dof, tuple(posteriors))


def _parts(
    designs: Sequence[Array], residuals: Array, floor: Array, outputs: Iterable[int]
) -> list[tuple[list[int], Part]]:
    """Return outputs by the part they belong to: those of equal design and floors share one."""
    alike: dict[tuple[bytes, bytes], list[int]] = {}
    for i in outputs:
        alike.setdefault((designs[i].tobytes(), floor[:, i].tobytes()), []).append(i)
    return [
        (members, _part(designs[members[0]], residuals[:, members], floor[:, members[0]]))
        for members in alike.values()
    ]


def _rotated(
    designs: Sequence[Array], residuals: Array, covariance: Array
) -> tuple[list[int], Part]:
    """Return correlated readings in the axes in which they are not, where τ² adds to each."""
    n, m = residuals.shape
    variances, axes = np.linalg.eigh(covariance)
    design = block_design(designs).reshape(n * m, -1)
    turned = axes.T @ np.column_stack([design, residuals.ravel()])
    least = np.finfo(float).eps * variances[-1]
    return list(range(m)), _part(turned[:, :-1], turned[:, -1:], np.maximum(variances, least))


def _part(design: Array, residuals: Array, floor: Array) -> Part:
    length = np.linalg.norm(design, axis=0)
    Q, R = np.linalg.qr(design / length)
    return Part(Q, np.linalg.inv(R) / length[:, None], residuals, floor)


def integrate_parts(parts: Sequence[Part]) -> Posterior:
    """Return the posterior of a scatter that parts share, and of their parameters.

    Parameters
    ----------
    parts : sequence of Part
        With more readings than parameters, all together.
    """
    dof = float(sum(p.residuals.size - p.parameters * p.residuals.shape[1] for p in parts))
    size = 1.0 / float(np.mean(np.concatenate([1.0 / part.floor for part in parts])))
    weighted = sum(float(np.sum(p.residuals**2 / p.floor[:, None])) for p in parts) * size
    plain = sum(float(np.sum(p.residuals**2)) for p in parts)
    return integrate(lambda nodes: _evaluate(parts, nodes, size), dof, size, (weighted, plain))


def belief(dof: float) -> float:
    """Return what "the claim is right" weighs at so many degrees of freedom, in units of ln V."""
    return float(_BELIEF * max(_FEW / dof, 1.0) ** _RISE)


def integrate(
    evaluate: Callable[[Array], Found],
    dof: float,
    size: float,
    squares: tuple[float, float],
    *,
    believed: bool = True,
) -> Posterior:
    """Return the posterior of a scatter, and of parameters.

    Parameters
    ----------
    evaluate : callable
        Takes values of τ² (G,).
    dof : float
        Degrees of freedom, above 0.
    size : float
        Of the floors.
    squares : tuple of two float
        Sums of squared residuals that bracket how noisy readings can be.
    believed : bool
        The floor is a claim that may be right, and not only where the search ends.
    """
    least = min(squares) / (dof + 10.0 * np.sqrt(dof) + 30.0)
    # Large V are unlikely as V^(−ν/2); a tail of 1e-6 is cut off.
    ends = (
        float(np.log(max(size, least))),
        float(np.log(max(*squares, size)) + 28.0 / dof + min(0.5, 10.0 / np.sqrt(dof))),
    )
    count = next(nodes for most, nodes in _NODES if dof < most)
    for _ in range(_NARROWED):
        x = np.linspace(*ends, count // 2)
        log = evaluate(np.maximum(np.exp(x) - size, 0.0)).log
        told = np.flatnonzero(log > log.max() - NEGLIGIBLE / 2.0)
        ends = float(x[max(told[0] - 1, 0)]), float(x[min(told[-1] + 1, len(x) - 1)])
        if 4 * len(told) > count // 2:
            break
    x = np.linspace(*ends, count)
    nodes = np.append(0.0, np.maximum(np.exp(x) - size, 0.0))
    found = evaluate(nodes)
    log = found.log[1:]
    weights = np.exp(log - log.max()) * (x[1] - x[0])
    weights[[0, -1]] /= 2.0
    weights = np.append(believed * belief(dof) * np.exp(found.log[0] - log.max()), weights)
    return Posterior(nodes, weights / weights.sum(), found.moves, found.variances, size)


def _evaluate(parts: Sequence[Part], nodes: Array, size: float) -> Found:
    log = np.log(nodes + size)
    information = np.zeros(len(nodes))  # of τ², twice
    moves, variances = [], []
    for part in parts:
        own = _equal(part, nodes) if not np.ptp(part.floor) else _unequal(part, nodes)
        log += own.log
        information += own.information
        moves.append(own.moves)
        variances.append(own.variances)
    log += 0.5 * np.log(information)
    return Found(log, np.concatenate(moves, axis=1), np.concatenate(variances, axis=1))


class _Share(NamedTuple):
    """What a part has of eq. (2) (G,), of Σ V⁻² (G,), and its own moves and variances (G, p m)."""

    log: Array
    information: Array
    moves: Array
    variances: Array


def _equal(part: Part, nodes: Array) -> _Share:
    """Return a part whose floors are alike: Q'V⁻¹Q is 1/V, and nothing moves with V."""
    (n, p), m = part.basis.shape, part.residuals.shape[1]
    right = part.basis.T @ part.residuals
    square = float(np.vdot(part.residuals, part.residuals) - np.vdot(right, right))
    variance = part.floor[0] + nodes
    lengths = np.tile(np.einsum("ip,ip->i", part.inverse, part.inverse), m)
    return _Share(
        log=-0.5 * (m * (n - p) * np.log(variance) + square / variance),
        information=m * n / variance**2,
        moves=np.tile((part.inverse @ right).T.ravel(), (len(nodes), 1)),
        variances=variance[:, None] * lengths,
    )


def _unequal(part: Part, nodes: Array) -> _Share:
    p, m = part.parameters, part.residuals.shape[1]
    sums = _sums(part, nodes)
    scale = 1.0 / np.sqrt(np.einsum("gpp->gp", sums.square))
    scaled = sums.square * scale[:, :, None] * scale[:, None, :] + _RIDGE * np.eye(p)
    inverse = np.linalg.inv(scaled) * scale[:, :, None] * scale[:, None, :]
    step = inverse @ sums.right  # (G, p, m)
    determinants = np.linalg.slogdet(scaled)[1] - 2.0 * np.log(scale).sum(axis=1)
    gained = np.einsum("gpm,gpm->g", sums.right, step)
    own = np.einsum("ip,gpq,iq->gi", part.inverse, inverse, part.inverse)
    return _Share(
        log=0.5 * (m * (sums.log_weight - determinants) - sums.misfit + gained),
        information=m * sums.weight2,
        moves=(part.inverse @ step).transpose(0, 2, 1).reshape(len(nodes), -1),
        variances=np.tile(own, (1, m)),
    )


class _Sums(NamedTuple):
    """Sums over readings at every node of τ²."""

    square: Array  # Q'V⁻¹Q, (G, p, p)
    right: Array  # Q'V⁻¹e, (G, p, m)
    misfit: Array  # e'V⁻¹e over outputs, (G,)
    log_weight: Array  # −Σ ln V, (G,)
    weight2: Array  # Σ V⁻², (G,)


def _sums(part: Part, nodes: Array) -> _Sums:
    p, m = part.parameters, part.residuals.shape[1]
    total = np.zeros((len(nodes), p * p + p * m + 1))
    log_weight, weight2 = np.zeros(len(nodes)), np.zeros(len(nodes))
    for first in range(0, len(part.floor), _ROWS):
        rows = slice(first, first + _ROWS)
        Q, e = part.basis[rows], part.residuals[rows]
        weight = 1.0 / (part.floor[rows] + nodes[:, None])  # (G, n)
        products = np.column_stack(
            [
                (Q[:, :, None] * Q[:, None, :]).reshape(len(Q), -1),
                (Q[:, :, None] * e[:, None, :]).reshape(len(Q), -1),
                np.einsum("nm,nm->n", e, e),
            ]
        )
        total += weight @ products
        log_weight += np.log(weight).sum(axis=1)
        weight2 += np.einsum("gn,gn->g", weight, weight)
    return _Sums(
        square=total[:, : p * p].reshape(-1, p, p),
        right=total[:, p * p : -1].reshape(-1, p, m),
        misfit=total[:, -1],
        log_weight=log_weight,
        weight2=weight2,
    )


def _half_interval(means: Array, sds: Array, weights: Array, share: float) -> Array:
    """Return half the intervals (p,) about zero that hold a share of mixtures of normals (G, p)."""
    shape = sds / sds[0]
    if np.ptp(shape, axis=1).max() > _SAME or (np.abs(means) > _SAME * sds).any():
        return _search_half(means, sds, weights, share)
    # where all floors are alike, all mixtures are one but for their size
    one = _search_half(means[:, :1], sds[:, :1], weights, share)
    return np.asarray(one * sds[0] / sds[0, 0])


def _search_half(means: Array, sds: Array, weights: Array, share: float) -> Array:
    low = np.zeros(means.shape[1])
    high = 2.0 * np.max(np.abs(means) + 2.0 * sds, axis=0)
    guess = 2.0 * np.sqrt(weights @ (sds**2 + means**2))
    for _ in range(60):
        above, below = (guess - means) / sds, (guess + means) / sds
        inside = weights @ (_erf(above / _ROOT) + _erf(below / _ROOT)).astype(np.float64) / 2.0
        low = np.where(inside < share, guess, low)
        high = np.where(inside < share, high, guess)
        density = weights @ ((_normal(above) + _normal(below)) / sds)
        following = guess + (share - inside) / np.maximum(density, 1e-300)
        bad = ~((following > low) & (following < high))
        following = np.where(bad, 0.5 * (low + high), following)
        if np.all(np.abs(following - guess) <= 1e-10 * guess):
            return following
        guess = following
    return guess


def _normal(z: Array) -> Array:
    return np.asarray(np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi))


def _tail(step: int) -> float:
    """Return how much wider the outer interval is than the inner one, at a step of dof."""
    dof = _MOST_DOF ** (step / _SHAPES)
    return coverage_factor(_COVERAGE, dof) / coverage_factor(_INNER, dof)


def standard_uncertainty(expanded: Array, dof: Array) -> Array:
    """Return u = U/k (p,) of U at 95 % with degrees of freedom (p,)."""
    factors = {nu: coverage_factor(_COVERAGE, nu) for nu in set(dof.tolist())}
    return np.asarray(expanded / np.array([factors[nu] for nu in dof.tolist()]))
