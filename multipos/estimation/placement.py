"""What is known of the positions: listed, uncertain, unknown, in groups, on a tilted table.

Readings and options together say, position by position, where the reference should be and how
far it may be from there. `place` gathers that, and `state_problem` adds the readings with their
noise: the problem of `multipos.estimation.likelihood`.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError
from multipos.estimation.losses import Loss
from multipos.estimation.problem import Problem
from multipos.numerics.arrays import Array
from multipos.positions.readings import Readings
from multipos.sensor.model import Model

_RELATIVE_NOISE = 1e-3  # of the readings' spread: any value serves where only ratios matter
_FIRST_SPREAD = np.radians(0.1)  # where the estimate of an orientation sd starts
_EXACT = 2.0**-52  # [rad], rounding of a unit vector: nearer than that no position is known


@dataclass(frozen=True)
class Placement:
    """What is known of the positions.

    Attributes
    ----------
    reference : (n, 3) array [g]
        Listed ±g u; anything where `spread` is infinite.
    spread : (n,) array [rad]
        Standard deviation per axis; 0 exact, inf unknown.
    group : (n,) array of int
        Number of the group that shares an unknown rotation, −1 for none.
    attitude : (n, 3, 3) array or None
        Level to case, where `level_sd` is above 0.
    level_sd : float [rad]
    estimate_spread : bool
        `spread` is relative; its size is estimated.
    """

    reference: Array
    spread: Array
    group: NDArray[np.intp]
    attitude: Array | None = None
    level_sd: float = 0.0
    estimate_spread: bool = False

    @property
    def exact(self) -> bool:
        """Whether every position is known exactly, so that the fit is linear."""
        return not self.spread.any() and not self.groups and not self.level_sd

    @property
    def groups(self) -> int:
        """Number of groups."""
        return int(self.group.max()) + 1

    @property
    def listed(self) -> NDArray[np.bool_]:
        """Positions whose direction is listed in the world's axes, (n,)."""
        return np.isfinite(self.spread) & (self.group < 0)


def place(
    readings: Readings,
    signed: float,
    orientation_sd: float | Literal["auto"] | None,
    level_sd_deg: float,
) -> Placement:
    """Return what readings and options say of the positions.

    Parameters
    ----------
    readings : Readings
        With up vectors; NaN where a position's `orientation_sd` is NaN, unknown.
    signed : float [g]
        Magnitude of the reference, negative under the gravity convention.
    orientation_sd : float [degrees], 'auto' or None
        Instead of the readings' own. Below the rounding of a unit vector it counts as exact.
    level_sd_deg : float [degrees]
    """
    n = len(readings)
    labelled = dict.fromkeys(label for label in readings.group or () if label)
    number = {label: i for i, label in enumerate(labelled)}
    group = np.array([number.get(label, -1) for label in readings.group or [""] * n])
    estimate = orientation_sd == "auto"
    if orientation_sd is not None and not estimate:
        spread = np.full(n, np.radians(float(orientation_sd)))
    elif readings.orientation_sd is not None:
        # Within a group an empty cell means that only the group's rotation is unknown.
        own = readings.orientation_sd
        spread = np.where(np.isnan(own), np.where(group >= 0, 0.0, np.inf), own)
    else:
        spread = np.zeros(n)
    spread = np.where(spread < _EXACT, 0.0, spread)
    level = float(np.radians(level_sd_deg))
    level = 0.0 if level < _EXACT else level
    if estimate and not (np.isfinite(spread) & (spread > 0.0)).any():
        spread = np.where(np.isinf(spread), spread, _FIRST_SPREAD)
    up = np.full((n, 3), np.nan) if readings.up is None else readings.up
    unknown = np.isinf(spread)
    missing = np.isnan(up).any(axis=1) & ~unknown
    if missing.any():
        raise MultiposError(
            f"position '{readings.labels[int(np.argmax(missing))]}' has no orientation; give it, "
            "or leave its orientation_sd_deg empty for unknown."
        )
    reference = signed * np.where(unknown[:, None], [1.0, 0.0, 0.0], up) + 0.0
    return Placement(
        reference=reference,
        spread=spread,
        group=group,
        attitude=_attitude(readings, unknown) if level else None,
        level_sd=level,
        estimate_spread=estimate,
    )


def _attitude(readings: Readings, unknown: NDArray[np.bool_]) -> Array:
    rotation = (
        np.full((len(readings), 3, 3), np.nan) if readings.rotation is None else (readings.rotation)
    )
    open_heading = np.isnan(rotation).any(axis=(1, 2)) & ~unknown
    if open_heading.any():
        names = [readings.labels[row] for row in np.flatnonzero(open_heading)[:6].tolist()]
        raise MultiposError(
            f"--level-sd needs the heading, and position {', '.join(map(repr, names))} has none; "
            "give direction, roll_deg pitch_deg yaw_deg, a quaternion, or roll_axis angle_deg."
        )
    return np.where(unknown[:, None, None], np.eye(3), rotation)


def state_problem(
    model: Model, readings: Readings, placement: Placement, robust: Loss | None
) -> Problem:
    """Return the problem of the likelihood; without stated noise, with one of arbitrary size.

    Raises
    ------
    MultiposError
        An output never changes, or positions are correlated with each other.
    """
    values = readings.values
    n, m = values.shape
    still = np.ptp(values, axis=0) == 0.0
    if still.any() and n > 1:
        raise MultiposError(
            f"the readings of {readings.outputs[int(np.argmax(still))]} never change; turn the "
            "sensor between them, so that every axis points up, down and level."
        )
    noise = readings.noise
    if noise is None:
        size = np.sqrt(np.mean((values - values.mean(axis=0)) ** 2)) or 1.0  # of one position
        precision = np.full((n, m), 1.0 / (_RELATIVE_NOISE * size) ** 2)
    elif noise.ndim == 1:
        precision = 1.0 / noise.reshape(n, m)
    else:
        precision = _block_precision(noise, n, m)
    return Problem(
        model=model,
        values=values,
        environment=readings.environment,
        precision=precision,
        reference=placement.reference,
        spread=placement.spread,
        group=placement.group,
        weight=np.ones(n),
        groups=placement.groups,
        attitude=placement.attitude,
        level_spread=placement.level_sd,
        robust=robust,
    )


def _block_precision(covariance: Array, n: int, m: int) -> Array:
    blocks = covariance.reshape(n, m, n, m)
    own = blocks[np.arange(n), :, np.arange(n), :]
    rest = covariance.copy().reshape(n, m, n, m)
    rest[np.arange(n), :, np.arange(n), :] = 0.0
    if rest.any():
        raise MultiposError(
            "readings correlated between positions cannot be combined with uncertain or unknown "
            "orientations; give a covariance within each position only."
        )
    return np.asarray(np.linalg.inv(own))
