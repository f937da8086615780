"""How large the terms of higher order are that the positions do show, for a guess at the others.

What is hidden can only be stated, in a budget's [unseen]; what nobody knows is guessed from its
kin. Of a term of second or third order, fitted or tested beside the model, with coefficients c_i
of standard uncertainty u_i in outputs that respond by |K_i|,

    size = sqrt(mean over i of (c_i² + u_i²) / |K_i|²)   [g],                                (1)

which holds what was found and what noise leaves open. For a tested one, c = (V'V)⁻¹V'e and
u² = s²(V'V)⁻¹ with V what the fit leaves of its column and s² of what it leaves of residuals e:
what a fit with the term would give, without the fit.
"""

import math

import numpy as np

from multipos.doubts.candidates import OF_FORCE, Kind, lacking
from multipos.doubts.projections import left_of, values_of
from multipos.numerics.arrays import Array
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel

_TOLD = 1e-3  # of a column's square, which must be left of it to tell a size
_LOWER = ("1", "own", "other")


def shown_sizes(c: Calibration) -> dict[str, float]:
    """Return eq. (1) by kind [g]; of known orientations with one noise an output, else nothing."""
    plain = c.estimator.exact and c.noise is None and c.robust_weight is None
    if not plain or isinstance(c.model, ExpressionModel):
        return {}
    response = np.linalg.norm(c.sensitivity, axis=1)
    if not response.all():
        return {}
    found: dict[str, list[float]] = {}
    for (output, term), value, u in zip(
        c.model.keys, c.parameters.tolist(), c.u.tolist(), strict=True
    ):
        if term.force_degree > 1 and math.isfinite(u):
            size = response[c.outputs.index(output)]
            found.setdefault(str(term), []).append((value**2 + u**2) / size**2)
    for kind in lacking(c):
        if kind.name in OF_FORCE and kind.name not in _LOWER:
            found |= {kind.name: squares} if (squares := _tested(c, kind, response)) else {}
    return {name: math.sqrt(float(np.mean(squares))) for name, squares in found.items()}


def _tested(c: Calibration, kind: Kind, response: Array) -> list[float]:
    """Return (c² + u²)/|K|² of each column of a kind that the positions tell."""
    phi = c.model.basis(c.reference, c.readings.environment)
    result = []
    for i, (columns, terms) in enumerate(zip(c.model.columns, kind.terms, strict=True)):
        if not terms:
            continue
        Z = values_of([Kind(kind.name, (terms,))], c.reference, c.readings.environment)[0][:, 0]
        Q = np.linalg.qr(phi[:, columns])[0]
        V = left_of(Q, Z)
        gram, nu = V.T @ V, len(Z) - Q.shape[1] - Z.shape[1]
        told = np.linalg.eigvalsh(gram)[0] > _TOLD * np.sum(Z**2, axis=0).max()
        if nu < 1 or not told:
            continue
        inverse = np.linalg.inv(gram)
        coefficients = inverse @ (V.T @ c.residuals[:, i])
        rest = c.residuals[:, i] - V @ coefficients
        square = coefficients**2 + float(rest @ rest) / nu * np.diag(inverse)
        result += (square / response[i] ** 2).tolist()
    return result
