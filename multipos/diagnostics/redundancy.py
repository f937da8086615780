"""Cautions about what nothing checks: as many parameters as readings, or hardly fewer.

A fit with no degrees of freedom passes through every reading, right or wrong, and its residuals,
zero to rounding, say nothing. With orientations unknown a position is one equation, however
many outputs it has. Positions that are much alike separate the parameters badly: at a condition of
10⁴ four of sixteen digits are gone, and every error of the model is as much larger. And a scale
factor that U leaves open by a fifth is no result, however it came about. Where nothing is left to
contradict it, a fit that the noise stated, or else one of 1 mg, moves by a tenth of a g or of a
scale factor is an error: with the gain G of the estimator by √(Σ G² u²).
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from multipos.estimation.gains import estimator_gain
from multipos.finding import Finding
from multipos.numerics.arrays import Array
from multipos.positions.order import share_absorbed
from multipos.positions.readings import diagonal
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator
from multipos.sensor.model import Model

_POOR = 0.02  # U of a linear term, as a share of the scale factor of its output
_OPEN = 0.2  # likewise of an own scale factor, where the positions are known
_ILL_CONDITIONED = 1e4
_TYPICAL = 1e-3  # [g], noise of a reading of which nothing is stated
_ABSORBED = 0.2  # share of a drift from which on it is said
_BEYOND = 0.1  # standard deviations of a linear term in scale factors, beyond any sensor


def no_redundancy(c: Calibration) -> Finding | None:
    """Find fits that nothing checks."""
    n = len(c.readings)
    if c.estimator == Estimator.UNKNOWN:
        spare = n - len(c.parameters)
    elif c.estimator.exact:
        spare = n - max(len(terms) for terms in c.model.terms)
    else:
        return None
    if spare <= 0:
        name, moved = _moved_by_noise(c)
        if moved > _BEYOND:
            noise = "the stated noise" if c.readings.noise is not None else "noise of 1 mg"
            return Finding(
                "no-residuals",
                "error",
                f"{n} positions for as many parameters: nothing checks the fit, and {noise} "
                f"changes {name} by {100.0 * moved:.2g} % of 1 g",
                "Add positions that differ more.",
            )
        return Finding(
            "no-redundancy",
            "warning",
            (
                f"{n} positions for as many parameters: there are no residuals, so nothing checks "
                "the fit"
            ),
            "Add positions.",
        )
    return _poorly_known(c) if c.estimator == Estimator.UNKNOWN else None


def _moved_by_noise(c: Calibration) -> tuple[str, float]:
    """Return the linear term that noise moves most, and by how much of the scale factor."""
    readings = c.readings
    response = np.linalg.norm(c.sensitivity, axis=1)
    sd = np.full(readings.values.shape, _TYPICAL * float(response.max()))
    if readings.noise is None:
        c = replace(c, readings=replace(readings, u=sd), variance_components=None)
    else:
        sd = np.sqrt(diagonal(readings.noise)).reshape(readings.values.shape)
    u = np.sqrt(np.sum((estimator_gain(c) * sd.ravel()) ** 2, axis=1))
    share = _shares(c.model, c.parameters[None], u[None])[0]
    return c.names[int(np.argmax(share))], float(share.max())


def poorly_determined(c: Calibration) -> Finding | None:
    """Find positions that are much alike, and own scale factors that U leaves open, if not zero."""
    if c.diagnostics.condition > _ILL_CONDITIONED:
        return Finding(
            "no-redundancy",
            "warning",
            "parameters are nearly inseparable at these positions (condition "
            f"{c.diagnostics.condition:.1e})",
            "Add positions that differ more.",
        )
    share = _shares(c.model, c.parameters[None], c.U[None])[0]
    found = [(c.names[i], share[i]) for i in c.model.own_scales if _OPEN < share[i] < 1.0]
    if not found:
        return None
    said = ", ".join(f"{name} (U = {100.0 * each:.2g} %)" for name, each in found)
    return Finding(
        "no-redundancy",
        "warning",
        f"scale factors are poorly determined: {said}",
        "Average longer, or add positions.",
    )


def _poorly_known(c: Calibration) -> Finding | None:
    """Find linear terms that positions of unknown orientation leave nearly open."""
    share = _shares(c.model, c.parameters[None], c.U[None])[0]
    poor = [
        (name, each) for name, each in zip(c.names, share.tolist(), strict=True) if each > _POOR
    ]
    if not poor:
        return None
    said = ", ".join(f"{name} (U = {1e3 * each:.2g} mrad)" for name, each in poor[:4])
    return Finding(
        "no-redundancy",
        "warning",
        f"parameters are poorly determined: {said}",
        "Add positions that differ more.",
    )


def are_poorly_known(model: Model, parameters: Array, U: Array) -> NDArray[np.bool_]:
    """Tell which units (B,) have a linear term that is nearly open; of many at once.

    Parameters
    ----------
    model : Model
    parameters, U : (B, p) arrays
        Expanded uncertainties.
    """
    return np.asarray((_shares(model, parameters, U) > _POOR).any(axis=1))


def are_open(model: Model, parameters: Array, U: Array) -> NDArray[np.bool_]:
    """Return of which units (B,) U leaves an own scale factor open, if that is not zero."""
    share = _shares(model, parameters, U)[:, list(model.own_scales)]
    return np.asarray(((share > _OPEN) & (share < 1.0)).any(axis=1))


def _shares(model: Model, parameters: Array, U: Array) -> Array:
    """Return U of linear terms as a share of the own scale factor (B, p), of others 0."""
    linear, own = model.scaled
    size = np.abs(parameters[:, own])
    share = np.zeros_like(U)
    share[:, linear] = np.where(size > 0.0, U[:, linear] / np.where(size > 0.0, size, 1.0), np.inf)
    return share


def drift_absorbed(c: Calibration) -> Finding | None:
    """Find an order of the rows in time in which the model takes a drift for the sensor."""
    time = c.readings.environment.get("time")
    if time is None or not c.estimator.exact or not np.isfinite(time).all():
        return None
    if c.model.drift_per is not None:  # it is estimated
        return None
    course = time - time.mean()
    _, blocks = c.model.respond(c.parameters, c.reference, c.readings.environment)
    share = max(share_absorbed(slopes, course) for _, slopes in blocks)
    if share <= _ABSORBED:
        return None
    return Finding(
        "drift-absorbed",
        "note",
        f"The order of the positions absorbs {100.0 * share:.0f} % of a linear drift: that part of "
        "one would stand in the parameters, and neither in the residuals nor in U.",
    )


def open_headings(c: Calibration) -> Finding | None:
    """Say what is assumed of a level that the budget states where positions have no headings."""
    rows = () if c.budget is None else c.budget.rows
    level = next((row for row in rows if row["quantity"] == "level"), None)
    rotation = c.readings.rotation
    known = rotation is not None and np.isfinite(rotation).all()
    if level is None or known or c.estimator is Estimator.UNKNOWN:
        return None
    each = math.sqrt(len(c.readings)) * level["u"]
    return Finding(
        "open-headings",
        "note",
        "no headings are stated: U includes [level] at its worst headings, as an orientation "
        f"error of {each:.2g} degrees at each position",
        "State whole attitudes for its own effect.",
    )
