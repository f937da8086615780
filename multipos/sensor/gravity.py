"""The local gravity: what options state of it, and what its uncertainty does to a calibration.

An uncertain gravity scales the reference of every position at rest alike. Where all are, a
coefficient of degree d in force is proportional to g^-d, so that its sensitivity (of every case:
`multipos.estimation.gains`) and the covariance that all parameters share are

    c_j = d_j p_j / g,       cov p += c c' u_g²,                                            (1)

with infinite degrees of freedom; the effective ones of the sum are Welch and Satterthwaite's,

    ν_eff = ν (u_c² / u_A²)²,     u_A from the readings, u_c combined.                      (2)

References
----------
JCGM 100:2008, clause 5.1 and G.4.1.
"""

from typing import NamedTuple

import numpy as np

from multipos.errors import UsageError
from multipos.numerics.arrays import LARGEST, Array
from multipos.units import gravity_ratio, normal_gravity


class Gravity(NamedTuple):
    """Local gravity and its standard uncertainty [m/s²]."""

    value: float
    u: float


def resolve_gravity(
    gravity: float | None, gravity_u: float | None, latitude: float | None, height: float | None
) -> Gravity | None:
    """Return the local gravity [m/s²] that the options state, or None.

    Raises
    ------
    UsageError
        Options that contradict each other, or a number that is no gravity on Earth.
    """
    if gravity is not None and latitude is not None:
        raise UsageError("--gravity and --latitude both state the gravity; give one.")
    if height is not None and latitude is None:
        raise UsageError("--height needs --latitude.")
    if gravity_u is not None and gravity is None:
        raise UsageError("--gravity-u needs --gravity.")
    if latitude is not None:
        return _of_place(latitude, height or 0.0)
    return None if gravity is None else _measured(gravity, gravity_u)


def _of_place(latitude: float, height: float) -> Gravity:
    try:
        return Gravity(normal_gravity(latitude, height), 0.0)
    except ValueError as error:
        raise UsageError(str(error)) from None


def _measured(gravity: float, gravity_u: float | None) -> Gravity:
    if gravity_u is not None and not 0.0 <= gravity_u <= LARGEST:
        raise UsageError(
            f"--gravity-u must be 0 or more, and no more than {LARGEST:g}, got {gravity_u}."
        )
    if not 1.0 <= gravity <= 100.0:
        raise UsageError(f"--gravity must be in m/s², such as 9.81, got {gravity}.")
    return Gravity(gravity, gravity_u or 0.0)


def signed_size(gravity: Gravity | None, convention: str) -> float:
    """Return the magnitude of the reference [g], negative under the gravity convention."""
    size = gravity_ratio(None if gravity is None else gravity.value)
    return -size if convention == "gravity" else size


def add_gravity(
    covariance: Array, dof: Array, gravity: Gravity, sensitivity: Array
) -> tuple[Array, Array]:
    """Return covariance and degrees of freedom with the common term of gravity, eqs. (1), (2).

    Parameters
    ----------
    covariance, dof : (p, p), (p,) arrays
    gravity : Gravity
    sensitivity : (p,) array
        c of eq. (1).
    """
    combined = covariance + np.outer(sensitivity, sensitivity) * gravity.u**2
    before, after = np.diag(covariance), np.diag(combined)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        effective = np.where(before > 0.0, dof * (after / before) ** 2, np.inf)
    effective[effective > LARGEST] = np.inf
    return combined, np.where(np.isnan(before), dof, effective)
