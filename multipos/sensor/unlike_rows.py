"""Whether a reading is beyond chance where some rows may be noisier than others.

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
L(d, v) √(1 + (M + 2)/d), the second factor the width of L in ln v, times what is believed before:
.7 that rows are alike, and else d even in its logarithm from 1 to 60. With d = ∞ alone it would be
eq. (1) of `multipos.sensor.diagnostics`.

References
----------
G. K. Smyth, *Linear models and empirical Bayes methods for assessing differential expression in
microarray experiments*, Stat. Appl. Genet. Mol. Biol. 3 (2004) 3: variances with a common χ²_d.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import t_tail

_ALIKE = 0.7  # chance, before anything is seen, that rows are alike
_DS = np.append(np.geomspace(1.0, 60.0, 8), 1e6)  # the last as good as alike
_BELIEVED = np.append(np.full(8, (1.0 - _ALIKE) / 8.0), _ALIKE)
_STEPS = 20  # towards the best v: within 1e-8 of it where rows are of 4:2:1, 2e-3 at 10:1
_NOTHING = 1e-9  # of a reading whose row alone fixes a parameter


def p_values(
    errors: Array, leverage: Array, designs: Sequence[Array], questioned: NDArray[np.bool_]
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
    e2, factor = errors**2, 1.0 - leverage
    for m in np.flatnonzero(questioned.any(axis=0)).tolist():
        without = _without(errors[:, m], designs[m], ~questioned[:, m])
        if without is None:
            return None
        e2[:, m], factor[:, m] = without
    weight = np.where(questioned, 0.0, np.maximum(factor, 0.0))
    nu = weight.sum(axis=0)
    r2 = e2 / np.maximum(factor, _NOTHING)
    c = np.sum(weight * r2, axis=0)
    if not (nu > 0.5).all() or not (c > 0.0).all():
        return None
    r2 *= nu / c
    left = np.sum(~questioned, axis=1).astype(np.float64)
    q = np.sum(np.where(questioned, 0.0, r2), axis=1)
    chances, v = _law(q, left, weight.sum(axis=1) / np.maximum(left, 1.0), errors.shape[1])
    found = []
    for k, m in np.argwhere(questioned).tolist():
        own = _DS + left[k]
        t = np.sqrt(r2[k, m] * own / (_DS * v + q[k])).tolist()
        dof = (1.0 / (1.0 / own + 1.0 / nu[m])).tolist()
        found.append(sum(map(math.prod, zip(chances, map(t_tail, t, dof), strict=True))))
    return np.array(found)


def _without(error: Array, design: Array, kept: NDArray[np.bool_]) -> tuple[Array, Array] | None:
    """Return the squared errors and variance factors 1 ± h' (n,) of one output, eq. (1)."""
    if not np.count_nonzero(kept) > design.shape[1]:
        return None
    R = np.asarray(np.linalg.qr(design[kept], mode="r"))
    size = np.abs(np.diag(R))
    if not size.min() > _NOTHING * size.max():
        return None
    basis = np.linalg.solve(R.T, design.T).T
    e = error - basis @ (basis[kept].T @ error[kept])
    h = np.sum(basis**2, axis=1)
    return e**2, np.where(kept, 1.0 - h, 1.0 + h)


def _law(q: Array, left: Array, weight: Array, outputs: int) -> tuple[list[float], Array]:
    """Return the chance of every d, and the v that is best with it, eq. (2)."""
    d = _DS[:, None]
    v = np.full(len(_DS), (weight @ q) / (weight @ left))
    for _ in range(_STEPS):  # of a parameter-expanded EM, whose w has the mean one
        w = (d + left) / (d + q / v[:, None])
        v = (w @ (weight * q)) / (weight @ left) * weight.sum() / (w @ weight)
    log = np.empty(len(_DS))
    counts, place = np.unique(left, return_inverse=True)
    for i, (each, best) in enumerate(zip(_DS.tolist(), v.tolist(), strict=True)):
        gammas = [math.lgamma((each + m) / 2.0) for m in counts.tolist()]
        constant = np.array(gammas) - math.lgamma(each / 2.0)
        constant -= 0.5 * counts * math.log(math.pi * each * best)
        tails = 0.5 * (each + left) * np.log1p(q / (each * best))
        log[i] = weight @ (constant[place] - tails)
    log += 0.5 * np.log1p((outputs + 2.0) / _DS) + np.log(_BELIEVED)
    chances = np.exp(log - log.max())
    return (chances / chances.sum()).tolist(), v
