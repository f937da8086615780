"""The excess variance of readings beyond the uncertainty they state, and U of the parameters.

`estimate_excess` returns the excess variance of B units, and `integrate_parts` that of parts that
share it.

A stated uncertainty is a lower bound: a reading of output i at position k has variance

    V_ki = u_ki² + τ²,                                                                      (1)

u as stated (the spread within a rest, a data sheet) and τ² the excess variance (dark uncertainty)
from rest to rest. τ is not estimated by a number but integrated over. Its posterior is the
restricted likelihood

    ln L(τ²) = −½ [Σ ln V + ln det X'V⁻¹X + e'V⁻¹e − e'V⁻¹X (X'V⁻¹X)⁻¹ X'V⁻¹e]              (2)

times Jeffreys' prior, dτ² (Σ V⁻²)^½, which is d ln V where all u are equal, with a prior chance
that τ = 0, which weighs as much as 1.4 of such a logarithm (more below 6 degrees of freedom,
`multipos.estimation.posteriors`). Without a stated part the
posterior of V is that of r'r/χ²_ν, and parameters follow Student's t; with one it is truncated at
the stated variance. Parameters then are a mixture of normal laws, and

- the fit is weighted by u² + τ² at the τ² for which 1/V, of a typical u, is its posterior mean;
- U is half the interval about the estimate that holds the mixture with the confidence of 95 %;
- the degrees of freedom are those of the posterior of V,

      ν = 2 (E 1/V)² / var(1/V),                                                            (3)

  and u = U/k, with k of Student's t at ν.

The prior chance was chosen by coverage: with 6 degrees of freedom U is 23 % longer than where u is
right and known to be, and covers 94 % or more whatever part of the noise u is; a χ² test that
either accepts or rejects u covers 73 % where u is half the noise (`docs/results`).

References
----------
D. A. Harville 1977, J. Am. Stat. Assoc. 72, eq. (2); H. Jeffreys, *Theory of Probability*, 1961,
section 3.10.
"""

from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from multipos.estimation.posteriors import Found, Posterior, integrate, standard_uncertainty
from multipos.numerics.arrays import Array, Places
from multipos.numerics.least_squares import block_design
from multipos.results import frozen
from multipos.sensor.fit_diagnostics import are_unequal

_ROWS = 20_000  # readings of a unit worked on at once
_AT_ONCE = 40_000  # variances of readings of several units, so that they stay in the cache
_EXPONENTS = 1000.0  # of two, within those of numbers
_RIDGE = 1e-13  # of rounding, so that variances of any size leave a matrix that can be inverted


@frozen
class Part:
    """Outputs that share a design and floors, as linear models about the solutions of B units.

    Attributes
    ----------
    basis : (n, p) array
        Orthonormal columns Q of the design X = Q R.
    inverse : (p, p) array
        R⁻¹.
    residuals : (B, n, m) array
        e of every output.
    stated_variance : (B, n) array
        Stated variances u².
    """

    basis: Array
    inverse: Array
    residuals: Array
    stated_variance: Array

    @property
    def parameters(self) -> int:
        """Number of parameters of each output."""
        return int(self.basis.shape[1])

    @property
    def degrees(self) -> float:
        """Degrees of freedom of all its outputs."""
        n, m = self.residuals.shape[1:]
        return float(m * (n - self.parameters))

    def of(self, units: slice) -> "Part":
        """Return it of some units."""
        return Part(self.basis, self.inverse, self.residuals[units], self.stated_variance[units])

    @cached_property
    def equal(self) -> bool:
        """Whether the stated variances of every unit are equal."""
        return not np.ptp(self.stated_variance, axis=1).any()

    @cached_property
    def square(self) -> Array:
        """Squared residuals (B, n) of all outputs."""
        return np.asarray(np.einsum("bnm,bnm->bn", self.residuals, self.residuals))

    @cached_property
    def along(self) -> Array:
        """What is left of residuals along the design, Q'e (B, p, m)."""
        return np.asarray(self.basis.T @ self.residuals)

    @cached_property
    def across(self) -> Array:
        """The rest of them, squared and summed (B, 1)."""
        whole, along = (np.sum(e**2, axis=(1, 2)) for e in (self.residuals, self.along))
        return np.asarray(whole - along)[:, None]

    @cached_property
    def moves(self) -> Array:
        """What Q'e makes of the parameters where stated variances are equal (B, 1, p m)."""
        return (self.inverse @ self.along).transpose(0, 2, 1).reshape(len(self.along), 1, -1)

    @cached_property
    def lengths(self) -> Array:
        """Variances of the parameters for readings of variance one (p m,), all equal."""
        own = np.einsum("ip,ip->i", self.inverse, self.inverse)
        return np.tile(own, self.residuals.shape[2])


@frozen
class ExcessVariance:
    """The excess variance of readings of M outputs, and how well it is known.

    Attributes
    ----------
    variance, u, dof : (B, M) arrays
        τ² as the fit takes it, the standard uncertainty of τ, and the degrees of freedom of the
        variance of a reading, u² + τ².
    posteriors : tuple of (units, members, Posterior)
        Which parameters of which units a posterior is of, in its order.
    """

    variance: Array
    u: Array
    dof: Array
    posteriors: tuple[tuple[Places, Places, Posterior], ...]

    def standard_uncertainty(self, moves: Array, dof: Array) -> Array:
        """Return u (B, p) of estimates that moved by (B, p) from the solution at τ = 0."""
        expanded = np.empty(moves.shape)
        for units, members, posterior in self.posteriors:
            here = np.ix_(units, members)
            expanded[here] = posterior.expanded(moves[here])
        return standard_uncertainty(expanded, dof)


def estimate_excess(
    designs: Sequence[Array], residuals: Array, noise: Array, *, pool: bool = False
) -> ExcessVariance:
    """Return the excess variance of readings of B units beyond their stated noise.

    All outputs of a unit share one where their equality is not rejected, or where they are
    correlated.

    Parameters
    ----------
    designs : sequence of M (n, p_i) arrays
    residuals : (B, n, M) array
        Of the fit weighted by the stated noise.
    noise : (B, n, M) array, or (n M, n M) of one unit
        Stated variances, or their covariance.
    pool : bool
        One excess variance of all outputs, without a test of their equality.
    """
    count, n, m = residuals.shape
    everyone = np.arange(count)
    dof = np.array([n - design.shape[1] for design in designs], dtype=np.float64)
    if noise.ndim == 2:
        return _gather([_share(everyone, designs, [_rotated(designs, residuals[0], noise)])])
    pooled = _share(everyone, designs, _parts(designs, residuals, noise, range(m)))
    found = _gather([pooled])
    if pool or m == 1 or dof.min() <= 0.0:
        return found
    chi2 = np.sum(residuals**2 / (noise + found.variance[:, None]), axis=1)
    unequal = are_unequal(chi2, dof)
    if not unequal.any():
        return found
    units = np.flatnonzero(unequal)
    groups = [] if unequal.all() else [pooled.of(np.flatnonzero(~unequal))]
    for i in range(m):
        parts = _parts(designs, residuals[units], noise[units], [i])
        groups.append(_share(units, designs, parts))
    return _gather(groups)


class _Sharing(NamedTuple):
    """Units and outputs that share an excess variance, and the places of their parameters."""

    units: Places
    outputs: Places
    members: Places
    posterior: Posterior

    def of(self, units: Places) -> "_Sharing":
        """Return some of the units, of all of them."""
        return self._replace(units=units, posterior=self.posterior.of(units))


def _share(
    units: Places, designs: Sequence[Array], parts: list[tuple[list[int], Part]]
) -> _Sharing:
    ends = np.cumsum([0, *(design.shape[1] for design in designs)])
    outputs = [i for members, _ in parts for i in members]
    members = np.concatenate([np.arange(ends[i], ends[i + 1]) for i in outputs])
    posterior = integrate_parts([part for _, part in parts])
    return _Sharing(units, np.array(outputs), members, posterior)


def _gather(groups: Sequence[_Sharing]) -> ExcessVariance:
    """Return the excess variance of all units and outputs."""
    count = 1 + max(int(group.units[-1]) for group in groups)
    m = 1 + max(int(group.outputs.max()) for group in groups)
    variance, u, dof = np.empty((3, count, m))
    for group in groups:
        here = np.ix_(group.units, group.outputs)
        variance[here], u[here], dof[here] = (each[:, None] for each in group.posterior.summary)
    return ExcessVariance(
        variance, u, dof, tuple((g.units, g.members, g.posterior) for g in groups)
    )


def _parts(
    designs: Sequence[Array], residuals: Array, stated_variance: Array, outputs: Iterable[int]
) -> list[tuple[list[int], Part]]:
    """Return outputs by the part they belong to: those of equal design and floors share one."""
    equal: dict[tuple[bytes, bytes], list[int]] = {}
    for i in outputs:
        equal.setdefault((designs[i].tobytes(), stated_variance[:, :, i].tobytes()), []).append(i)
    return [
        (
            members,
            _part(designs[members[0]], residuals[:, :, members], stated_variance[:, :, members[0]]),
        )
        for members in equal.values()
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
    stated_variance = np.maximum(variances, least)
    return list(range(m)), _part(turned[:, :-1], turned[None, :, -1:], stated_variance[None])


def _part(design: Array, residuals: Array, stated_variance: Array) -> Part:
    length = np.linalg.norm(design, axis=0)
    Q, R = np.linalg.qr(design / length)
    return Part(Q, np.linalg.inv(R) / length[:, None], residuals, stated_variance)


def integrate_parts(parts: Sequence[Part]) -> Posterior:
    """Return the posterior of an excess variance that parts share, and of their parameters.

    Parameters
    ----------
    parts : sequence of Part
        Of the same units, with more readings than parameters, all together.
    """
    dof = sum(part.degrees for part in parts)
    precisions = np.concatenate([1.0 / part.stated_variance for part in parts], axis=1)
    size = 1.0 / np.mean(precisions, axis=1)
    weighted = size * sum(np.sum(part.square / part.stated_variance, axis=1) for part in parts)
    plain = np.sum(np.concatenate([part.square for part in parts], axis=1), axis=1)

    def evaluate(nodes: Array, *, whole: bool) -> Found:
        return _evaluate(parts, nodes, size, whole=whole)

    return integrate(evaluate, dof, size, (weighted, plain))


def _evaluate(parts: Sequence[Part], nodes: Array, size: Array, *, whole: bool) -> Found:
    log = np.log(nodes + size[:, None])
    information = np.zeros(nodes.shape)  # of τ², twice
    moves, variances = [], []
    for part in parts:
        own = _equal(part, nodes) if part.equal else _unequal(part, nodes, whole=whole)
        log += own.log
        information += own.information
        moves.append(own.moves)
        variances.append(own.variances)
    log += 0.5 * np.log(information)
    return Found(log, np.concatenate(moves, axis=2), np.concatenate(variances, axis=2))


class _Terms(NamedTuple):
    """Terms of eq. (2) and Σ V⁻² (B, G) of a part, shifts and variances of its parameters."""

    log: Array
    information: Array
    moves: Array
    variances: Array


def _equal(part: Part, nodes: Array) -> _Terms:
    """Return the terms of equal stated variances: Q'V⁻¹Q is 1/V, whatever V the same estimates."""
    (n, p), m = part.basis.shape, part.residuals.shape[2]
    variance = part.stated_variance[:, :1] + nodes
    return _Terms(
        log=-0.5 * (m * (n - p) * np.log(variance) + part.across / variance),
        information=m * n / variance**2,
        moves=np.broadcast_to(part.moves, (*nodes.shape, m * p)),
        variances=variance[:, :, None] * part.lengths,
    )


def _unequal(part: Part, nodes: Array, *, whole: bool) -> _Terms:
    """Return the terms of unequal stated variances, of the parameters only if `whole`."""
    (count, n), G = part.stated_variance.shape, nodes.shape[1]
    step = max(1, _AT_ONCE // (n * G))
    some = [slice(first, first + step) for first in range(0, count, step)]
    terms = [_unequal_terms(part.of(k), nodes[k], whole=whole) for k in some]
    return terms[0] if len(terms) == 1 else _Terms(*map(np.concatenate, zip(*terms, strict=True)))


def _unequal_terms(part: Part, nodes: Array, *, whole: bool) -> _Terms:
    """By Q'V⁻¹Q = L D L', nodes in step: g'(Q'V⁻¹Q)⁻¹g is the sum of (L⁻¹g)²/D."""
    p, m = part.parameters, part.residuals.shape[2]
    sums = _sums(part, nodes)
    columns = sums.right
    if whole:  # and R⁻¹ (Q'V⁻¹Q)⁻¹ R⁻ᵀ of the parameters
        root = np.broadcast_to(part.inverse.T[:, :, None, None], (p, p, *nodes.shape))
        columns = np.concatenate([columns, root], axis=1)
    pivots = _eliminate(sums.square, columns)
    right, over = columns[:, :m], columns / pivots[:, None]
    gained = np.einsum("pmbg,pmbg->bg", right, over[:, :m])
    log = 0.5 * (m * (sums.log_weight - _log_of_product(pivots)) - sums.misfit + gained)
    if not whole:
        return _Terms(log, m * sums.weight2, *np.empty((2, *nodes.shape, 0)))
    own = np.einsum("kpbg,kpbg->bgp", columns[:, m:], over[:, m:])
    moves = np.einsum("kmbg,kpbg->bgmp", right, over[:, m:]).reshape(*nodes.shape, -1)
    return _Terms(log, m * sums.weight2, moves, np.tile(own, (1, 1, m)))


def _eliminate(A: Array, columns: Array) -> Array:
    """Return the pivots D (p, B, G) of A = L D L' (p, p, B, G), and put L⁻¹ before columns."""
    np.einsum("ppbg->pbg", A)[...] *= 1.0 + _RIDGE
    for k in range(len(A) - 1):
        factor = A[k + 1 :, k] / A[k, k]
        A[k + 1 :, k + 1 :] -= factor[:, None] * A[k, k + 1 :]
        columns[k + 1 :] -= factor[:, None] * columns[k]
    return np.asarray(np.einsum("ppbg->pbg", A))


def _log_of_product(values: Array) -> Array:
    """Return the logarithms of the products of positive values (k, …) along their first axis."""
    largest = np.abs(np.log2([values.max(), values.min()])).max()
    step = max(1, int(_EXPONENTS / max(1.0, largest)))
    firsts = np.arange(0, len(values), step)
    return np.asarray(np.log(np.multiply.reduceat(values, firsts, axis=0)).sum(axis=0))


class _Sums(NamedTuple):
    """Sums over readings at every node of τ²."""

    square: Array  # Q'V⁻¹Q, (p, p, B, G)
    right: Array  # Q'V⁻¹e, (p, m, B, G)
    misfit: Array  # e'V⁻¹e over outputs, (B, G)
    log_weight: Array  # −Σ ln V, (B, G)
    weight2: Array  # Σ V⁻², (B, G)


def _sums(part: Part, nodes: Array) -> _Sums:
    p, m = part.parameters, part.residuals.shape[2]
    n, shape = part.stated_variance.shape[1], nodes.shape
    square, right = np.zeros((p * p, nodes.size)), np.zeros((p, m, nodes.size))
    misfit, log_weight, weight2 = np.zeros((3, *shape))
    for first in range(0, n, _ROWS):
        rows = slice(first, first + _ROWS)
        Q = part.basis[rows]
        weight = np.add(part.stated_variance.T[rows, :, None], nodes, order="C")  # (n, B, G)
        np.reciprocal(weight, out=weight)
        square += (Q[:, :, None] * Q[:, None, :]).reshape(len(Q), -1).T @ weight.reshape(len(Q), -1)
        for i in range(m):
            e = part.residuals[:, rows, i].T[:, :, None]
            weighted = np.multiply(e, weight, order="C")
            right[:, i] += Q.T @ weighted.reshape(len(Q), -1)
            weighted *= e
            misfit += weighted.sum(axis=0)
        log_weight += _log_of_product(weight)
        weight2 += np.einsum("nbg,nbg->bg", weight, weight)
    return _Sums(
        square=square.reshape(p, p, *shape),
        right=right.reshape(p, m, *shape),
        misfit=misfit,
        log_weight=log_weight,
        weight2=weight2,
    )
