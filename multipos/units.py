"""The few units of the field, exact trigonometry of degrees, and normal gravity.

`normal_gravity` is that of a latitude and a height, `gravity_ratio` the size of the reference in g.
`unit_of_gravity` is the unit in which gravity has a size. `sin_deg` and `cos_deg` are exact at
multiples of 30°, and `unit_per` is the unit of a coefficient.

Inside the package angles are radians and specific force is in g, where one g is the local
gravity unless a gravity was stated, and then the standard gravity ``g_n = 9.80665 m/s²``.

Normal gravity on the WGS 84 ellipsoid follows Somigliana, with the second-order free-air
formula for the height [1]_, eqs. (4-1) and (4-3):

    gamma(phi)    = gamma_e (1 + k sin²phi) / sqrt(1 - e² sin²phi)
    gamma(phi, h) = gamma(phi) [1 - 2/a (1 + f + m - 2 f sin²phi) h + 3 h²/a²]

References
----------
.. [1] NIMA TR8350.2, *Department of Defense World Geodetic System 1984*, 3rd ed., chapter 4.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

STANDARD_GRAVITY = 9.80665  # g_n [m/s²], exact by definition
MICRO_G = {"g": 1e6, "mg": 1e3, "m/s^2": 1e6 / STANDARD_GRAVITY}  # [µg]
_BIASED = 0.15  # relative: how far a bias moves the size of gravity

# WGS 84: equatorial gravity [m/s²], Somigliana's k, e², semi-major axis [m], flattening, m.
_GAMMA_E = 9.7803253359
_K = 0.00193185265241
_E2 = 6.69437999014e-3
_A = 6378137.0
_F = 1.0 / 298.257223563
_M = 0.00344978650684


def unit_of_gravity(size: float) -> str | None:
    """Return the unit in which gravity is of about a size; None where it is that of none."""
    near = (unit for unit, one in MICRO_G.items() if abs(size * one / 1e6 - 1.0) < _BIASED)
    return next(near, None)


def normal_gravity(latitude_deg: float, height: float = 0.0) -> float:
    """Return the WGS 84 normal gravity.

    Parameters
    ----------
    latitude_deg : float [degrees]
        Geodetic latitude, −90 to 90.
    height : float [m]
        Height above the ellipsoid, −1000 to 100 000.

    Returns
    -------
    float [m/s²]

    Examples
    --------
    >>> import multipos as mp
    >>> round(mp.normal_gravity(45.0, 0.0), 5)
    9.8062
    """
    if not abs(latitude_deg) <= 90.0:
        raise ValueError(f"`latitude` must lie between -90 and 90 degrees, got {latitude_deg}.")
    if not -1000.0 <= height <= 100_000.0:
        raise ValueError(f"`height` must lie between -1000 and 100000 m, got {height}.")
    s2 = math.sin(math.radians(latitude_deg)) ** 2
    on_ellipsoid = _GAMMA_E * (1.0 + _K * s2) / math.sqrt(1.0 - _E2 * s2)
    free_air = 1.0 - 2.0 / _A * (1.0 + _F + _M - 2.0 * _F * s2) * height + 3.0 * (height / _A) ** 2
    return on_ellipsoid * free_air


def sin_deg(angle_deg: ArrayLike) -> NDArray[np.float64]:
    """Return the sine of an angle in degrees, exact at multiples of 30° where it is rational.

    ``sin(pi)`` is 1.2e-16 in floating point; such a stray component would pass for a tilt of the
    position, so the angle is reduced in degrees, where the reduction is exact.
    """
    angle = np.asarray(angle_deg, dtype=np.float64)
    # Of |angle|, where the remainder is exact; the sine is odd.
    turn = np.remainder(np.abs(angle), 360.0)
    sign = np.where((turn >= 180.0) == (angle < 0.0), 1.0, -1.0)
    half = np.where(turn >= 180.0, turn - 180.0, turn)
    acute = np.where(half > 90.0, 180.0 - half, half)
    # Above 45° the cosine of the complement makes sin 45° and cos 45° the same number.
    value = np.where(
        acute > 45.0, np.cos(np.radians(90.0 - acute)), np.sin(np.radians(np.minimum(acute, 45.0)))
    )
    value = np.where(acute == 45.0, math.sqrt(0.5), value)
    return sign * np.where(acute == 30.0, 0.5, value) + 0.0


def cos_deg(angle_deg: ArrayLike) -> NDArray[np.float64]:
    """Return the cosine of an angle in degrees, exact at multiples of 30° where it is rational."""
    # |angle| first: the cosine is even, and adding 90° to a negative angle could round.
    return sin_deg(np.remainder(np.abs(np.asarray(angle_deg, dtype=np.float64)), 360.0) + 90.0)


def gravity_ratio(gravity: float | None) -> float:
    """Return the magnitude of the reference in g: 1 for local gravity, gravity/g_n if stated."""
    return 1.0 if gravity is None else gravity / STANDARD_GRAVITY


def unit_per(
    unit: str,
    force_degree: int,
    environment: tuple[tuple[str, int], ...] = (),
    reference: str = "g",
) -> str:
    """Return the unit of a coefficient: reading unit per reference to a degree and other columns.

    ``unit_per("V", 2)`` is ``V/g^2``. Readings in g cancel: ``unit_per("g", 2)`` is ``1/g``.
    A reference without a unit has none in the result.
    """
    numerator = unit
    if unit == reference and force_degree:
        numerator, force_degree = "1", force_degree - 1
    parts = [numerator]
    if force_degree and reference:
        parts.append(reference if force_degree == 1 else f"{reference}^{force_degree}")
    for name, power in environment:
        symbol = "degC" if name == "temperature" else name
        parts.append(symbol if power == 1 else f"{symbol}^{power}")
    return "/".join(parts)
