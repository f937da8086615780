"""How input quantities of the measurement move the parameters of a calibration.

`parameter_effects` returns how a quantity moves the parameters, `reading_moves` how it moves the
readings, `turn_axes` the axes about which it turns positions and `turn_readings` what turns do to
readings; `is_bounded` tells whether only a bound of its effect is known.

Every estimator is described near its solution by its gain, how the parameters follow the
readings (output running fastest),

    G = dp/dy  (p, n M),      `multipos.estimation.gains`.                                  (1)

An input quantity x (gravity, the level of the table, the gain of a voltmeter) enters by how it
would move the readings y = h(f; p), so for every estimator and every scheme

    dp/dx = G dy/dx,                                                                        (2)

============  =========================================  =====================================
gravity g     dy = J f / g, or dp = d p / g at once       rows at rest; d the degree in force
level         dy = J (a × f)                             J = dh/df; a = east, north, case axes
orientation   dy_k = J_k (e × f_k), one k alone          e = the case axes
index         dy = J (a × f) cos mt, … sin mt            a = the shaft, t the angle about it
gain, offset  dy = y, dy = 1
temperature   dy = dh/dT
stability     dy = s, or J e s of compensated force       s = sd of each zero, e its axis
============  =========================================  =====================================

Where positions have no headings, east is anywhere at each of them, by a rotation R_k about up. With
g_k how a tilt at position k alone moves any quantity that is linear in p, the tilt t of all moves
it by Σ g_k' R_k t, whose variance is at most

    u² |Σ R_k' g_k|² ≤ n u² Σ |g_k|²,                                                       (2b)

as an independent orientation error of √n u at each position has it. So level is taken, whatever
the headings were.

References
----------
JCGM 100:2008, clause 5.1; docs/theory/budget.md.
"""

import math

import numpy as np

from multipos.errors import MultiposError
from multipos.estimation.gains import gravity_effect
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.sensor.calibration import Calibration
from multipos.uncertainty.budgets import Quantity, zero_moves
from multipos.uncertainty.unseen_terms import term_moves

_DEGREE = 1e-2  # [degC] of central differences: exact for terms up to the second degree


def parameter_effects(c: Calibration, gain: Array, quantity: Quantity) -> Array:
    """Return d p / d x (p, q) for the q independent components of a quantity, by eq. (2).

    Parameters
    ----------
    c : Calibration
    gain : (p, n M) array
        From `multipos.estimation.gains.estimator_gain`.
    quantity : Quantity

    Returns
    -------
    (p, q) array
        Per unit of the quantity.
    """
    n, m = c.readings.values.shape
    if quantity.name == "resolution":
        return gain
    if quantity.name == "gravity" and c.gravity is not None:
        return gravity_effect(c)[:, None]
    if quantity.name in c.estimator.unaffected_by:
        return np.zeros((len(gain), 1))
    if quantity.name == "orientation" or is_bounded(c, quantity):
        size = math.sqrt(n) if quantity.name == "level" else 1.0  # eq. (2b)
        moved = turn_readings(c, np.broadcast_to(size * np.eye(3), (n, 3, 3)))  # (n, M, 3 axes)
        by_position = gain.reshape(-1, n, m)
        effects = np.einsum("pnm,nma->pna", by_position, moved)
        return np.asarray(effects.reshape(len(gain), -1))
    moves = reading_moves(c, quantity)  # (n, M, q)
    return np.asarray(gain @ moves.reshape(n * m, -1))


def reading_moves(calibration: Calibration, quantity: Quantity) -> Array:
    """Return dy/dx (n, M, q): how the q components of a common quantity move the readings.

    Per unit of the quantity: m/s², degrees, one (a relative gain), the reading unit, degC.

    Raises
    ------
    MultiposError
        The quantity needs what the calibration does not know.
    """
    c = calibration
    n, m = c.readings.values.shape
    if quantity.name in ("level", "index"):
        return turn_readings(c, turn_axes(c, quantity))
    if quantity.name == "cross":
        return term_moves(c, {"other": 1.0}, c.reference)
    if quantity.name == "stability":
        return zero_moves(c, quantity.settings)
    if quantity.name == "temperature":
        return _temperature_moves(c, quantity)[:, :, None]
    moved = c.readings.values if quantity.name == "gain" else np.ones((n, m))
    if quantity.settings.get("each_output", False):
        return np.asarray(moved[:, :, None] * np.eye(m))
    return moved[:, :, None]


def is_bounded(c: Calibration, quantity: Quantity) -> bool:
    """Tell whether a level enters by eq. (2b), as the positions have no headings."""
    rotation = c.readings.rotation
    return quantity.name == "level" and (rotation is None or not np.isfinite(rotation).all())


def turn_axes(calibration: Calibration, quantity: Quantity) -> Array:
    """Return the axes (n, q, 3), in case axes, about which level or index turn up, per unit.

    Raises
    ------
    MultiposError
        As in `reading_moves`.
    """
    if quantity.name == "index":
        return _index_turns(calibration, quantity)
    # Two horizontal axes, east and north; about up nothing moves.
    return np.asarray(_attitudes(calibration, quantity)[:, :, :2].transpose(0, 2, 1))


def turn_readings(c: Calibration, axes: Array) -> Array:
    """Return the change of the readings (n, M, q) per degree of turn about axes (n, q, 3)."""
    change = np.cross(axes, c.reference[:, None, :])
    J = c.model.force_jacobian(c.parameters, c.reference, c.readings.environment)
    return np.asarray(np.radians(np.einsum("nmi,nqi->nmq", J, change)))


def _attitudes(c: Calibration, quantity: Quantity) -> Array:
    rotation = c.readings.rotation
    if rotation is None or not np.isfinite(rotation).all():
        raise MultiposError(
            f"[{quantity.name}] in the budget needs the heading of every position, which up "
            "vectors and roll and pitch without yaw do not have; name the axis along the shaft "
            "with 'axis', or give whole attitudes (direction, yaw_deg, a quaternion or roll_axis)."
        )
    return rotation


def _index_turns(c: Calibration, quantity: Quantity) -> Array:
    """Return the turns (n, q, 3) in case axes per degree of each coefficient of the index error."""
    n = len(c.readings)
    if "axis" in quantity.settings:
        shaft = np.broadcast_to(np.eye(3)[COMPONENTS.index(quantity.settings["axis"])], (n, 3))
    else:
        shaft = _attitudes(c, quantity)[:, :, 0]  # schemes turn about a shaft that points east
    along = np.abs(shaft).argmax(axis=1)
    if not np.allclose(np.abs(shaft), np.eye(3)[along], atol=1e-6):
        raise MultiposError(
            "[index] in the budget: the positions do not turn about one case axis that points "
            "east; name the axis along the shaft with 'axis'."
        )
    up = c.reference * c.sign
    first = np.where(along == 0, 1, 0)
    second = np.where(along == 2, 1, 2)
    rows = np.arange(n)
    angle = np.arctan2(up[rows, second], up[rows, first])
    orders = quantity.settings["harmonics"]
    waves = [f(order * angle) for order in orders for f in (np.cos, np.sin) if order or f is np.cos]
    # u is of the error at any one angle: shared evenly by the orders, cos² + sin² = 1.
    size = np.sqrt(1.0 / len(orders))
    turn = np.array([1.0, -1.0, 1.0])[along, None] * np.eye(3)[along]  # from first to second
    return np.asarray(size * np.array(waves).T[:, :, None] * turn[:, None, :])


def _temperature_moves(c: Calibration, quantity: Quantity) -> Array:
    """Return dy/dT (n, M): the model's own terms, or the coefficients that the budget states."""
    environment = c.readings.environment
    if "temperature" in c.model.environment:
        sides = [
            c.model.predict(
                c.parameters,
                c.reference,
                {**environment, "temperature": environment["temperature"] + step},
            )
            for step in (_DEGREE, -_DEGREE)
        ]
        return np.asarray((sides[0] - sides[1]) / (2.0 * _DEGREE))
    known = [key for key in ("bias_per_degC", "scale_per_degC") if key in quantity.settings]
    if not known:
        raise MultiposError(
            "[temperature] in the budget: the model has no temperature terms; state what a degree "
            "does with 'bias_per_degC' or 'scale_per_degC'."
        )
    force = c.model.predict(c.parameters, c.reference, c.readings.environment)
    at_rest = c.model.predict(c.parameters, 0.0 * c.reference, c.readings.environment)
    bias, scale = (
        float(quantity.settings.get(key, 0.0)) for key in ("bias_per_degC", "scale_per_degC")
    )
    return np.asarray(bias + scale * (force - at_rest))
