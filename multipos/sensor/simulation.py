"""What a calibrated sensor would read: averaged readings, or the raw log of a session.

`simulate` returns readings as a `Simulation`, `simulate_log` a log as a `SimulatedLog`; `turned`
turns vectors by rotation vectors.

Position k has the up vector u_k of the scheme. The case stands where it was put, not where it
should be, so that the sensor feels

    f_k = ±γ Exp(-[δ_k]×) u_k,    δ_k ~ N(0, s² I),                                        (1)

γ = 1 or gravity/9.80665, and reads y_k = h(f_k, e_k) + ε_k with the calibration's own model h. In
a log each position rests for a while, the case is then turned along the shortest arc, smoothly
(zero speed and acceleration at both ends) and with the tremble of a hand, and the noise of the
samples may be white or remember the past,

    ε_i = exp(-τ/T) ε_{i-1} + sqrt(1 - exp(-2τ/T)) n_i,    n_i ~ N(0, σ²),                 (2)

with τ the time between samples and T the correlation time.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import UsageError
from multipos.files.tables import Source
from multipos.numerics.arrays import LARGEST, Array, as_numbers, require_rate
from multipos.numerics.recursions import recur
from multipos.positions.forces import OF_FIELD
from multipos.positions.order import Order
from multipos.positions.scheme import Scheme, lay_scheme, read_scheme
from multipos.results import Columns, require
from multipos.sensor.calibration import Calibration

_TREMBLE = 0.03  # [g], standard deviation of each component while a hand turns the case
_LARGEST = 200_000_000  # samples


class Simulation(Columns):
    """Readings of a simulated session, the columns of a readings file.

    They are position, up_x, up_y, up_z as the scheme has them (f_x, f_y, f_z where it has known
    forces; b_x, b_y, b_z of a magnetometer), the outputs, and the columns that the model uses.
    """


class SimulatedLog(Columns):
    """The raw log of a simulated session: time [s], the outputs, columns that the model uses."""


def simulate(
    calibration: Calibration,
    scheme: "Source | Scheme",
    *,
    order: Order | None = None,
    reading_sd: ArrayLike = 0.0,
    orientation_sd: float = 0.0,
    temperature: Sequence[float] | None = None,
    seed: "int | np.random.Generator | None" = None,
) -> Simulation:
    """Return readings of a calibrated sensor at the positions of a scheme.

    Parameters
    ----------
    calibration : Calibration
        The sensor.
    scheme : Scheme, name, path, mapping of columns, or data frame
    order : str
        'spread', 'travel' or 'paper': in which the rows stand (`multipos.positions.order`);
        'spread' for a name where not given, and else as written. A position has the same errors
        in every order.
    reading_sd : float or M floats
        Standard deviation of an averaged reading, in its unit.
    orientation_sd : float [degrees]
        How far a position is from where it should be, per axis.
    temperature : two floats, optional [°C]
        First and last temperature of an even run; the mean of the calibration's readings where
        the model needs one and none is given.
    seed : int or Generator, optional

    Returns
    -------
    Simulation

    Examples
    --------
    >>> import multipos as mp
    >>> run = mp.simulate(mp.demo().calibration, "faces-6", reading_sd=2e-4, seed=1)
    >>> list(run)
    ['position', 'up_x', 'up_y', 'up_z', 'ax', 'ay', 'az']
    """
    require(calibration, Calibration)
    rng = np.random.default_rng(seed)
    published = read_scheme(scheme)
    laid = lay_scheme(scheme if isinstance(scheme, str) else published, order)
    rows = [published.names.index(label) for label in laid.names]
    tilt = rng.normal(size=laid.up.shape)[rows]
    force, environment = _session(calibration, laid, orientation_sd, temperature, tilt)
    values = calibration.predict(force, environment)
    noise = rng.normal(size=values.shape)[rows]
    values = values + _sd(calibration, reading_sd, "--reading-sd") * noise
    columns = laid.columns()
    if calibration.field.towards == "field" and laid.force is None:
        columns = {"position": laid.names, **dict(zip(OF_FIELD, laid.up.T, strict=True))}
    return Simulation(
        {
            **columns,
            **dict(zip(calibration.outputs, values.T, strict=True)),
            **environment,
        }
    )


def simulate_log(
    calibration: Calibration,
    scheme: "Source | Scheme",
    *,
    order: Order = "paper",
    rate: float = 100.0,
    rest: float = 5.0,
    turn: float = 2.0,
    sample_sd: ArrayLike = 0.0,
    correlation_time: float = 0.0,
    orientation_sd: float = 0.0,
    temperature: Sequence[float] | None = None,
    seed: "int | np.random.Generator | None" = None,
) -> SimulatedLog:
    """Return the raw log of a session: rests at the positions of a scheme, turns between them.

    Parameters
    ----------
    calibration, scheme, orientation_sd, temperature, seed
        As for `simulate`; the temperature runs evenly with time.
    order : str
        As for `simulate`; a log names no positions, so that they stand as published.
    rate : float [Hz]
    rest, turn : float [s]
        Duration of each rest and of each turn.
    sample_sd : float or M floats
        Standard deviation of the noise of a sample, in its unit.
    correlation_time : float [s]
        T of eq. (2); 0 is white noise.

    Returns
    -------
    SimulatedLog

    Examples
    --------
    >>> import multipos as mp
    >>> log = mp.simulate_log(mp.demo().calibration, "faces-6", rate=50, rest=4, sample_sd=1e-3)
    >>> list(log), len(log["ax"])
    (['time', 'ax', 'ay', 'az'], 1700)
    """
    require(calibration, Calibration)
    require_rate(rate)
    if not 0.0 < rest < math.inf:
        raise UsageError(f"--rest must be above 0, got {rest:g}.")
    for option, value in (("--turn", turn), ("--correlation-time", correlation_time)):
        if not 0.0 <= value < math.inf:
            raise UsageError(f"{option} must be 0 or more, got {value:g}.")
    rng = np.random.default_rng(seed)
    known = read_scheme(scheme, order=order)
    most = 2.0 * _LARGEST  # so that what is infinite can be counted
    still, moving = max(round(min(rest * rate, most)), 1), round(min(turn * rate, most))
    if len(known) * (still + moving) > _LARGEST:
        raise UsageError(f"the log would have more than {_LARGEST} samples; lower --rate.")
    tilt = rng.normal(size=known.up.shape)
    standing, environment = _session(calibration, known, orientation_sd, temperature, tilt)
    force = _motion(standing, still, moving, rng)
    time = np.arange(len(force)) / rate
    run = np.linspace(0.0, len(known) - 1.0, len(force))
    environment = {
        name: np.interp(run, np.arange(len(known)), column) for name, column in environment.items()
    }
    noise = _noise(len(force), len(calibration.outputs), correlation_time * rate, rng)
    values = calibration.predict(force, environment)
    values = values + _sd(calibration, sample_sd, "--sample-sd") * noise
    outputs = dict(zip(calibration.outputs, values.T, strict=True))
    return SimulatedLog({"time": time, **outputs, **environment})


def _session(
    calibration: Calibration,
    scheme: Scheme,
    orientation_sd: float,
    temperature: Sequence[float] | None,
    tilt: Array,
) -> tuple[Array, dict[str, Array]]:
    """Return the force (n, 3) [g] of eq. (1), and the columns of the model, at each position.

    `tilt` (n, 3) is in units of `orientation_sd`.
    """
    if not 0.0 <= orientation_sd < 180.0:
        raise UsageError(
            f"--orientation-sd must be 0 or more and below 180 degrees, got {orientation_sd:g}."
        )
    sign = calibration.sign
    size = calibration.field.magnitude
    force = size * scheme.up
    if scheme.force is not None:
        force = np.where(np.isfinite(scheme.force), scheme.force, force)
    return sign * turned(force, -np.radians(orientation_sd) * tilt), _surroundings(
        calibration, len(scheme), temperature
    )


def _surroundings(
    calibration: Calibration, count: int, temperature: Sequence[float] | None
) -> dict[str, Array]:
    columns = {name: np.full(count, mean) for name, mean in calibration.mean_environment.items()}
    if temperature is not None:
        if len(temperature) != 2 or not (np.abs(temperature) <= LARGEST).all():
            raise UsageError("--temperature takes the first and the last temperature, as 20,40.")
        columns["temperature"] = np.linspace(temperature[0], temperature[1], count)
    return columns


def turned(vectors: Array, rotation: Array) -> Array:
    """Return vectors (…, 3) turned by rotation vectors (…, 3) [rad] (Rodrigues)."""
    angle = np.linalg.norm(rotation, axis=-1, keepdims=True)
    axis = rotation / np.where(angle > 0.0, angle, 1.0)
    along = axis * (axis * vectors).sum(axis=-1, keepdims=True)
    across = np.cross(axis, vectors)
    return np.asarray(along + (vectors - along) * np.cos(angle) + across * np.sin(angle))


def _motion(standing: Array, still: int, moving: int, rng: np.random.Generator) -> Array:
    """Return the force of a session: each position for a while, and the turns between them."""
    parts = [np.repeat(standing[:1], still, axis=0)]
    for before, after in pairwise(standing):
        if moving:
            parts.append(_turn(before, after, moving, rng))
        parts.append(np.repeat(after[None], still, axis=0))
    return np.concatenate(parts)


def _turn(before: Array, after: Array, count: int, rng: np.random.Generator) -> Array:
    axis = np.cross(before, after)
    size = np.linalg.norm(axis)
    square = float(before @ before)
    if size <= 1e-9 * square:  # the same direction, or opposite: any axis across will do
        axis = np.cross(before, np.eye(3)[int(np.argmin(np.abs(before)))])
        size = np.linalg.norm(axis)
    angle = math.atan2(float(np.linalg.norm(np.cross(before, after))), float(before @ after))
    t = (np.arange(count) + 1.0) / (count + 1.0)
    swing = t**3 * (10.0 - 15.0 * t + 6.0 * t**2)  # of least jerk
    path = turned(np.repeat(before[None], count, axis=0), np.outer(swing * angle, axis / size))
    strength = np.sqrt(square) * _TREMBLE * np.sin(np.pi * t)
    return np.asarray(path + strength[:, None] * rng.normal(size=path.shape))


def _noise(rows: int, outputs: int, memory: float, rng: np.random.Generator) -> Array:
    """Return noise (n, M) of standard deviation 1 whose correlation time is `memory` samples."""
    white = rng.normal(size=(rows, outputs))
    if memory <= 0.0:
        return white
    keep = math.exp(-1.0 / memory)
    fresh = math.sqrt(-math.expm1(-2.0 / memory))
    # The first sample has the full standard deviation, so that the noise is stationary.
    white[1:] *= fresh
    return recur(white, keep)


def _sd(calibration: Calibration, given: ArrayLike, option: str) -> Array:
    sd = as_numbers(given, option, UsageError).ravel()
    outputs = len(calibration.outputs)
    if len(sd) not in (1, outputs):
        raise UsageError(f"{option} takes 1 or {outputs} values, got {len(sd)}.")
    if not ((sd >= 0.0) & (sd <= LARGEST)).all():
        raise UsageError(f"{option} must be 0 or more, and no more than {LARGEST:g}.")
    return sd
