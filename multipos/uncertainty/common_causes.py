"""The scatter of the residuals without what a common cause left in them.

`clear_scatter` returns, as `Cleared`, what of the residual variance of each output is left.

A cause that is one draw for all positions, such as the tilt t of a table of u(t), moves readings by
D t. The fit follows some of it, and its residuals hold the rest, with D taken per u(t),

    e = A t + ε,    A = D − X G D,    t ~ N(0, 1),    ε_m ~ N(0, s_m²) of output m,          (1)

one t of few components for the readings of all outputs. What occurred is so in the residual
variance, whatever was expected of it: two tilts by which a scatter of ν degrees of freedom is too
large, and not by a part that could be known beforehand. It is estimated with the scatter, as
restricted likelihood has it [1]_, from W = diag(s_m²):

    P = (A'W⁻¹A + I)⁻¹,    t = P A'W⁻¹e,                                                     (2)
    s_m² = [|e_m − A_m t|² + tr A_m P A_m'] / ν_m,    ν'_m = ν_m − tr P A_m'W⁻¹A_m           (3)

by alternation until nothing changes. Of a cause far below the noise nothing is taken, of one far
above it the pattern A is projected out, and ν' is less by the number of its components, shared by
the outputs that show it. So that two residuals of an output are not explained whole by two tilts, W
has each s_m² shrunk towards that of all outputs, by two degrees of freedom; an output that keeps
less than one keeps its residuals as they are, and the cause is in U twice.

Beside a stated noise d_mk the scatter is τ_m² from rest to rest, W = diag(d_mk + τ_m²), and (1) is
`multipos.estimation.excess_variance` of e − A t, made as long as (1) has it. Estimates stay what
they are; only their variance follows what is left. Not looked for is a cause where robust weights
follow it themselves, and where U holds how runs differ.

References
----------
.. [1] D. A. Harville 1977, J. Am. Stat. Assoc. 72, section 5; docs/theory/budget.md.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from multipos.estimation.excess_variance import ExcessVariance, estimate_excess
from multipos.estimation.stated_uncertainty import combined_dof
from multipos.numerics.arrays import Array, Places
from multipos.positions.readings import diagonal
from multipos.results import Result, frozen
from multipos.sensor.calibration import Calibration
from multipos.sensor.inverse import parameter_jacobian
from multipos.sensor.temperature import runs_of
from multipos.uncertainty.budgets import Quantity
from multipos.uncertainty.sensitivities import is_bounded, reading_moves

_LEAST_SHARE = 1e-3  # of the residual variance, below which a cause is not looked for


_COMMON = 2.0  # degrees of freedom by which outputs share their scatter in W


_ALL = 1e20  # of it, beyond which what is left of residuals is their rounding


_LEAST = 1.0  # of degrees of freedom, below which an output keeps its residuals


_SETTLED, _ROUNDS = 1e-7, 500  # of the residual variance
_SETTLED_BESIDE, _ROUNDS_BESIDE = 1e-2, 20  # each is a search
_NOTHING = 1e-12  # of the residual variance, below which all of it is the cause


Find = Callable[[Array], Array]  # residuals (n, M) -> their variance beyond the stated one (M,)


@frozen
class Cleared(Result):
    """What is left of the scatter of the outputs without common causes.

    Attributes
    ----------
    ratio : (M,) array
        Of the variance of a reading without them, to that with them; 1 where none was found.
    dof : (M,) array
        Degrees of freedom of what is left.
    """

    ratio: Array
    dof: Array


@frozen
class _Shown:
    """The residuals of the outputs that tell a scatter, and what common causes make of them.

    Attributes
    ----------
    outputs : (m,) array of int
    residuals : (n, m) array
    pattern : (n, m, q) array
        A of eq. (1), per standard uncertainty.
    nu : (m,) array
    """

    outputs: Places
    residuals: Array
    pattern: Array
    nu: Array


class _Found(NamedTuple):
    """As `Cleared`, of some outputs, and what is left of their residuals' degrees of freedom."""

    ratio: Array
    dof: Array
    left: Array


class _Settled(NamedTuple):
    """Where eqs. (2) and (3) came to rest."""

    variance: Array  # beyond the stated variance (m,)
    left: Array  # degrees of freedom ν' (m,)
    residuals: Array  # e − A t, as long as (3) has it (n, m)


def clear_scatter(c: Calibration, gain: Array, quantities: Sequence[Quantity]) -> Cleared:
    """Return what common causes leave of the scatter of a calibration, eqs. (2) and (3).

    Parameters
    ----------
    c : Calibration
    gain : (p, n M) array
        From `multipos.estimation.gains.estimator_gain`.
    quantities : sequence of Quantity
        All that is stated.
    """
    ratio, dof = np.ones(len(c.outputs)), c.dof.copy()
    causes = [q for q in quantities if _is_looked_for(c, q)]
    shown = _shown(c, gain, causes) if causes else None
    if shown is not None:
        found = _from_residuals(c, shown) if c.noise is None else _beside_stated(c, shown)
        kept = found.left >= _LEAST
        places = shown.outputs[kept]
        ratio[places], dof[places] = found.ratio[kept], found.dof[kept]
    return Cleared(ratio, dof)


def _is_looked_for(c: Calibration, quantity: Quantity) -> bool:
    """Tell whether the residuals of a calibration may show what occurred of a quantity."""
    kind = quantity.kind
    if not (kind.common or kind.shared) or quantity.name == "gravity" or not quantity.u > 0.0:
        return False
    if not c.estimator.exact or c.robust_weight is not None:
        return False
    if runs_of(c.readings, c.model) is not None:
        return False
    if is_bounded(c, quantity):
        return False  # no one pattern is known of it
    if c.noise is None:
        return True
    found = c.variance_components
    stated = found is not None and found.rest_to_rest is not None
    return stated and not c.model.ties_outputs


def _shown(c: Calibration, gain: Array, causes: Sequence[Quantity]) -> _Shown | None:
    """Return what residuals show of common causes; None where it is nothing beside the noise."""
    n, m = c.residuals.shape
    X = parameter_jacobian(c.model, c.parameters, c.reference, c.readings.environment)
    nu = n - np.einsum("nmp,pnm->m", X, gain.reshape(-1, n, m))
    variance = np.mean(c.sd_of_readings**2, axis=0)
    estimated_here = (
        np.isfinite(c.dof) & (c.dof > 0.0) & (variance > 0.0)
    )  # NaN is not identifiable
    if not estimated_here.any():
        return None
    patterns = []
    for quantity in causes:
        moves = reading_moves(c, quantity).reshape(n * m, -1)
        left = (moves - X.reshape(n * m, -1) @ (gain @ moves)).reshape(n, m, -1)[:, estimated_here]
        left *= quantity.u / np.sqrt(variance[estimated_here, None])
        part = np.einsum("nmq,nmq->m", left, left) / nu[estimated_here]
        if part.max() > _LEAST_SHARE and part.max() < _ALL:
            patterns.append(left * np.sqrt(variance[estimated_here, None]))
    if not patterns:
        return None
    outputs = np.flatnonzero(estimated_here)
    return _Shown(
        outputs,
        c.residuals[:, estimated_here],
        np.concatenate(patterns, axis=2),
        nu[estimated_here],
    )


def _from_residuals(c: Calibration, shown: _Shown) -> _Found:
    """Return what is left of variances that the residuals alone gave."""
    nu, e, pattern = shown.nu, shown.residuals, shown.pattern
    pooled = len(nu) > 1 and bool((c.dof[shown.outputs] > nu + 0.5).all())

    def variance(residuals: Array) -> Array:
        square = np.sum(residuals**2, axis=0)
        return np.full(len(nu), square.sum() / nu.sum()) if pooled else square / nu

    settled = _settle(e, pattern, np.zeros(e.shape), nu, variance, (_SETTLED, _ROUNDS))
    left = nu * settled.left.sum() / nu.sum() if pooled else settled.left
    ratio = settled.variance / variance(e)
    return _Found(ratio, c.dof[shown.outputs] * left / nu, left)


def _beside_stated(c: Calibration, shown: _Shown) -> _Found:
    """Return what is left of a scatter from rest to rest beside what the readings state."""
    noise = c.readings.noise
    assert noise is not None
    n, m = c.residuals.shape
    X = parameter_jacobian(c.model, c.parameters, c.reference, c.readings.environment)
    designs = [X[:, i, X[:, i].any(axis=0)] for i in shown.outputs]
    stated_variance = diagonal(noise).reshape(n, m)[:, shown.outputs]
    stated = stated_variance[None] if noise.ndim == 1 else noise

    def scatter(residuals: Array) -> ExcessVariance:
        return estimate_excess(designs, residuals[None], stated)

    if noise.ndim == 1:
        found = _settle(
            shown.residuals,
            shown.pattern,
            stated_variance,
            shown.nu,
            lambda e: scatter(e).variance[0],
            (_SETTLED_BESIDE, _ROUNDS_BESIDE),
        )
        after, left = scatter(found.residuals), found.left
    else:
        after, left = _correlated(shown, noise, scatter)
    dof = after.dof * (left / shown.nu)
    if c.readings.dof is not None:
        stated_dof = c.readings.dof[None, :, shown.outputs]
        dof = combined_dof(dof, stated_variance[None], stated_dof, after.variance)
    before = (c.sd_of_readings**2)[:, shown.outputs]  # by which the readings were weighed
    now = np.sum((stated_variance + after.variance[0]) / before**2, axis=0)
    return _Found(now / np.sum(1.0 / before, axis=0), dof[0], left)


def _correlated(
    shown: _Shown, noise: Array, scatter: Callable[[Array], ExcessVariance]
) -> tuple[ExcessVariance, Array]:
    """Return scatter and degrees of freedom left, in the axes in which readings are independent."""
    n, m = shown.residuals.shape
    stated_variance, axes = np.linalg.eigh(noise)
    found = _settle(
        axes.T @ shown.residuals.reshape(-1, 1),
        (axes.T @ shown.pattern.reshape(n * m, -1))[:, None],
        np.maximum(stated_variance, 0.0)[:, None],
        shown.nu.sum(keepdims=True),
        lambda e: scatter((axes @ e).reshape(n, m)).variance[0, :1],
        (_SETTLED_BESIDE, _ROUNDS_BESIDE),
    )
    left = shown.nu * found.left / shown.nu.sum()
    return scatter((axes @ found.residuals).reshape(n, m)), left


def _settle(
    e: Array,
    pattern: Array,
    stated_variance: Array,
    nu: Array,
    find: Find,
    until: tuple[float, int],
) -> _Settled:
    """Solve eqs. (2) and (3) by alternation, from the variance that holds the causes downward.

    Parameters
    ----------
    e, stated_variance : (n, m) arrays
    pattern : (n, m, q) array
    nu : (m,) array
    find : callable
        Takes residuals, returns their variance beyond the stated one.
    until : (float, int)
        The relative change of a variance below which it has settled, and the most rounds.
    """
    tolerance, rounds = until
    variance = find(e)
    typical = stated_variance.mean(axis=0)
    least = _NOTHING * (variance + typical)
    for _ in range(rounds):
        common = float(nu @ variance) / float(nu.sum())
        W = stated_variance + np.maximum((nu * variance + _COMMON * common) / (nu + _COMMON), least)
        weighted = pattern / W[:, :, None]
        information = np.einsum("nmq,nmk->mqk", weighted, pattern)
        P = np.linalg.inv(information.sum(axis=0) + np.eye(pattern.shape[2]))
        left = e - pattern @ (P @ np.einsum("nmq,nm->q", weighted, e))
        lost = np.einsum("mqk,kq->m", information, P)
        length = np.sum(left**2 / W, axis=0)
        left = left * np.sqrt(1.0 + lost / np.maximum(length, np.finfo(float).tiny))
        before, variance = variance, find(left)
        if (np.abs(variance - before) <= tolerance * (typical + before)).all():
            break
    return _Settled(variance, nu - lost, left)
