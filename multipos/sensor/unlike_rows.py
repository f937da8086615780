"""Whether a reading is beyond chance where some rows may be noisier than others.

- `p_values` gives the chance of each reading of one fit, `p_values_of_units` of many at once.

All outputs of a row are noisier together: output m of row k has the variance c_m w_k, and
w_k = v d/χ²_d varies the more from row to row the smaller d is; rows alike have d = ∞. Readings in
question are left out of the fit. Let e be what is left of the others, or what those in question
are off by, h' the leverage and ν_m the degrees of freedom without them, and m_k the outputs of row
k that are not in question:

    c_m = Σ e²/ν_m,    r² = e²/(c_m (1 ∓ h')),    q_k = Σ r²,    + of those in question,    (1)
    ln L(d, v) = Σ (1 − h'_k) ln t(q_k; m_k, d, v),                                         (2)

t the density of m_k normal numbers of common variance w_k, h'_k the mean of the row. The reading is
off by t standard deviations on D degrees of freedom (Welch and Satterthwaite: its row and output),

    t² = r² (d + m_k)/(d v + q_k),    1/D = 1/(d + m_k) + 1/ν_m,                            (3)

and its p value is the mean of those of all d by their chance given the readings, v at its best:
L(d, v) √(1 + (M + 2)/d), the second factor the width of L in ln v, times what is assumed before:
.7 that rows are alike, and else d even in its logarithm from 1 to 60. With d = ∞ alone it would be
eq. (1) of `multipos.sensor.studentised`.

References
----------
G. K. Smyth, *Linear models and empirical Bayes methods for assessing differential expression in
microarray experiments*, Stat. Appl. Genet. Mol. Biol. 3 (2004) 3: variances with a common χ²_d.
"""

import math
from collections.abc import Sequence

import numpy as np

from multipos.numerics import quantiles
from multipos.numerics.arrays import Array, Mask

_ALIKE = 0.7  # chance, before anything is seen, that rows are alike
_DS = np.append(np.geomspace(1.0, 60.0, 8), 1e6)  # the last as good as alike
_PRIOR = np.append(np.full(8, (1.0 - _ALIKE) / 8.0), _ALIKE)
_STEPS = 20  # towards the best v: within 1e-8 of it where rows are of 4:2:1, 2e-3 at 10:1
_DIGITS = 9  # of degrees of freedom, so that there are few of them
_SINGULAR = 1e-12  # eigenvalue of G, below which the other readings lack a parameter
_NOTHING = 1e-9  # of a reading whose row alone fixes a parameter


def p_values(
    errors: Array, leverage: Array, designs: Sequence[Array], questioned: Mask
) -> Array | None:
    """Return the p value of every reading that is questioned, eq. (3), row by row.

    Parameters
    ----------
    errors, leverage : (n, M) arrays
        Residuals of the fit, over their stated uncertainty where there is one.
    designs : M arrays (n, p_m)
        Of every output, weighted likewise.
    questioned : (n, M) array of bool

    Returns
    -------
    array or None
        None where the other readings do not determine the fit.
    """
    each_once = {id(design): design for design in designs}
    Q = {key: np.linalg.qr(design)[0] for key, design in each_once.items()}
    bases = [Q[id(design)] for design in designs]
    (found,) = p_values_of_units(errors[None], leverage, bases, questioned[None])
    return None if np.isnan(found[questioned]).any() else found[questioned]


def p_values_of_units(
    errors: Array, leverage: Array, bases: Sequence[Array], questioned: Mask
) -> Array:
    """Return the p values (B, n, M) of eq. (3) of B units; NaN of what is not questioned.

    NaN as well where the other readings of a unit do not determine the fit.

    Parameters
    ----------
    errors : (B, n, M) array
        As in `p_values`.
    leverage : (n, M) array
    bases : M arrays (n, p_m)
        Orthonormal columns of the designs.
    questioned : (B, n, M) array of bool
    """
    e2, factor, whole = _without(errors, leverage, bases, questioned)
    weight = np.where(questioned, 0.0, np.maximum(factor, 0.0))
    nu = weight.sum(axis=1)
    r2 = e2 / np.maximum(factor, _NOTHING)
    c = np.sum(weight * r2, axis=1)
    whole &= ((nu > 0.5) & (c > 0.0)).all(axis=1)
    r2 *= (nu / np.where(c > 0.0, c, 1.0))[:, None]
    left = np.sum(~questioned, axis=2).astype(np.float64)
    q = np.sum(np.where(questioned, 0.0, r2), axis=2)
    result = np.full(errors.shape, np.nan)
    units = np.flatnonzero(whole)
    if not len(units):
        return result
    rows = weight[units].sum(axis=2) / np.maximum(left[units], 1.0)
    chances, v = _law(q[units], left[units], rows, errors.shape[2])
    b, k, m = np.nonzero(questioned[units])
    unit = units[b]
    own = _DS + left[unit, k, None]
    t2 = r2[unit, k, m][:, None] * own / (_DS * v[b] + q[unit, k, None])
    dof = np.round(1.0 / (1.0 / own + 1.0 / nu[unit, m][:, None]), _DIGITS)
    result[unit, k, m] = np.einsum("kd,kd->k", chances[b], quantiles.t_tails(t2, dof))
    return result


def _without(
    errors: Array, leverage: Array, bases: Sequence[Array], questioned: Mask
) -> tuple[Array, Array, Mask]:
    """Return squared errors and variance factors 1 ± h' (B, n, M), eq. (1), and where they exist.

    With Q'e = 0 the fit of the others is off by −G⁻¹ Σ Q_k e_k, G = 1 − Σ Q_k Q_k' over those that
    are questioned, and their leverage is h' = Q G⁻¹ Q'.
    """
    e2, factor = errors**2, np.broadcast_to(1.0 - leverage, errors.shape).copy()
    whole = np.ones(len(errors), dtype=np.bool_)
    for own in _sharing(bases):
        units, place = np.nonzero(questioned[:, :, own].any(axis=1))
        if not len(units):
            continue
        Q, m = bases[own[0]], np.array(own)[place]
        mine, e = questioned[units, :, m], errors[units, :, m]
        p = Q.shape[1]
        products = (Q[:, :, None] * Q[:, None, :]).reshape(len(Q), -1)
        G = np.eye(p) - (mine @ products).reshape(-1, p, p)
        regular = (np.linalg.eigvalsh(G)[:, 0] > _SINGULAR) & (np.sum(~mine, axis=1) > p)
        whole[units[~regular]] = False
        inverse = np.linalg.inv(np.where(regular[:, None, None], G, np.eye(p)))
        lost = np.einsum("bpq,bq->bp", inverse, (mine * e) @ Q)
        e2[units, :, m] = (e + lost @ Q.T) ** 2
        h = inverse.reshape(-1, p * p) @ products.T
        factor[units, :, m] = np.where(mine, 1.0 + h, 1.0 - h)
    return e2, factor, whole


def _sharing(bases: Sequence[Array]) -> list[list[int]]:
    """Return the outputs of each array of a basis."""
    found: dict[int, list[int]] = {}
    for m, Q in enumerate(bases):
        found.setdefault(id(Q), []).append(m)
    return list(found.values())


def _law(q: Array, left: Array, weight: Array, outputs: int) -> tuple[Array, Array]:
    """Return the chance of every d, and the v that is best with it, eq. (2), (B, D) each."""
    d, q, m = _DS[:, None], q[:, None], left[:, None]
    total = np.einsum("bn,bn->b", weight, left)[:, None]
    v = np.repeat(np.einsum("bn,bn->b", weight, q[:, 0])[:, None] / total, len(_DS), axis=1)
    mean = total / weight.sum(axis=1)[:, None]
    both = np.stack([weight * q[:, 0] / mean, weight], axis=2)
    dofs, w = d + m, np.empty(np.broadcast_shapes(d.shape, q.shape))
    for _ in range(_STEPS):  # of a parameter-expanded EM, whose w has the mean one
        np.divide(dofs, np.add(d * v[:, :, None], q, out=w), out=w)  # over v, which cancels
        sums = w @ both
        v = sums[:, :, 0] / sums[:, :, 1]
    gammas = [[math.lgamma((each + k) / 2.0) for k in range(outputs + 1)] for each in _DS.tolist()]
    constant = (np.array(gammas) - np.array(gammas)[:, :1])[:, left.astype(np.intp)]
    size = d * v[:, :, None]
    constant = constant.transpose(1, 0, 2) - 0.5 * m * np.log(np.pi * size)
    tails = 0.5 * (d + m) * np.log1p(q / size)
    log = np.einsum("bn,bdn->bd", weight, constant - tails)
    log += 0.5 * np.log1p((outputs + 2.0) / _DS) + np.log(_PRIOR)
    chances = np.exp(log - log.max(axis=1, keepdims=True))
    return chances / chances.sum(axis=1, keepdims=True), v
