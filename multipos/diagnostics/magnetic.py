"""Findings about a magnetic field: its size, directions that are missing, iron near and moving.

Of unknown orientations a reading leaves m = |b| − 1, in the relative field. To first order in an
error of the calibration it is linear in products of the direction u: the columns u (hard
iron) and u u' (soft iron), which the fit has taken up. What is left after these, r with the
standard deviation s, is judged for what no calibration of one sensor in one field explains.

*A disturbance* acts in part of the sphere: the mean of r over the k readings nearest to one of
them, k a twentieth of all, over s/√k, is beyond what the largest of n such means has by chance.

*Moving iron* changes the hard iron from a row on: r falls by F on 3 and n − 12 degrees of freedom
where the columns u H(t − t_0) are added, t_0 one of nine.

Both take rows as worth fewer where their noise is correlated (`effective_rows`).

Field sizes at the surface of the Earth: 22 to 67 µT, NOAA, World Magnetic Model 2025.
"""

import numpy as np

from multipos.files.numbers import in_unit, p_in_words
from multipos.finding import Finding
from multipos.numerics.arrays import Array, median
from multipos.numerics.quantiles import f_tail, normal_quantile
from multipos.numerics.rotations import directions
from multipos.positions.scheme import read_scheme
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator
from multipos.sensor.gravity import in_tesla

_EARTH = (22e-6, 67e-6)  # [T]
_ROOM = 1.1  # on either side
_GAP_DEG = 60.0
_FEWEST, _FEWEST_IN_TIME = 24, 40  # readings
_CHANCE = 0.002  # of a healthy set, for each finding
_SHARE = 20  # of the readings, that are neighbours
_LEAST = 0.002  # relative: what nobody need look for
_STEPS = np.arange(1, 10) / 10.0
_DIRECTIONS = "all-26"
_SHOWN = 8  # rows that a sentence names


def field_size(c: Calibration) -> Finding | None:
    """Find a field of another size than Earth's: a wrong unit, or iron."""
    size = _size_in_tesla(c)
    if size is None or _EARTH[0] / _ROOM <= size <= _EARTH[1] * _ROOM:
        return None
    text = f"the field is {in_unit(1e6 * size, 'uT')}, but 22 to 67 µT at the surface of the Earth"
    action = "Correct --unit or --field-size, or go away from iron."
    return Finding("field-size", "warning", text, action)


def _size_in_tesla(c: Calibration) -> float | None:
    """Return the size that is stated, or that the readings have in their unit."""
    if c.field.size is not None:
        unit = in_tesla(c.field.size_unit)
        return None if unit is None else c.field.size * unit
    unit = in_tesla(c.model.unit)
    if unit is None or len(c.sensitivity) != len(c.sensitivity.T):
        return None
    return unit * float(np.cbrt(abs(np.linalg.det(c.sensitivity))))


def sphere_gap(c: Calibration) -> Finding | None:
    """Find directions of the field that no reading is near."""
    missing, widest = missing_directions(directions(c.reference))
    if not len(missing):
        return None
    listed = ", ".join(f"({x:.1f}, {y:.1f}, {z:.1f})" for x, y, z in (missing + 0.0).tolist()[:3])
    text = f"no reading is within {widest:.0f} degrees of some directions of the field"
    action = f"Add readings with the field along {listed} in case axes."
    return Finding("sphere-gap", "warning", text, action)


def missing_directions(seen: Array) -> tuple[Array, float]:
    """Return of 26 even directions those (k, 3) over 60° from any of (n, 3), and the gap [deg]."""
    every = read_scheme(_DIRECTIONS).up
    near = (every @ seen.T).max(axis=1, initial=-1.0)
    far = near < np.cos(np.radians(_GAP_DEG))
    order = np.argsort(near[far])
    return every[far][order], float(np.degrees(np.arccos(np.clip(near.min(), -1.0, 1.0))))


def _left(c: Calibration) -> tuple[Array, Array, Array, float] | None:
    """Return directions (n, 3), columns of a calibration, what they leave, and n over rows' worth.

    None where orientations are known, or readings are few.
    """
    if c.estimator is not Estimator.UNKNOWN or len(c.readings) < _FEWEST:
        return None
    if c.robust_weight is not None or not np.isfinite(c.rms):
        return None
    r = c.relative
    b = r.compensate(r.readings.values, r.readings.environment)
    u = directions(b)
    second = [u[:, i] * u[:, j] for i in range(3) for j in range(i, 3)]
    design = np.column_stack([u, *second])
    misfit = np.linalg.norm(b, axis=1) - 1.0
    left = misfit - design @ np.linalg.lstsq(design, misfit, rcond=None)[0]
    worth = c.effective_rows
    fewer = 1.0 if not worth else max(1.0, len(b) / max(min(worth.values()), 1.0))
    return u, design, left, fewer


def disturbance(c: Calibration) -> Finding | None:
    """Find part of the sphere whose field has another size."""
    found = _left(c)
    if found is None:
        return None
    u, _, left, fewer = found
    n = len(u)
    k = max(5, n // _SHARE)
    sd = float(median(np.abs(left - median(left)))) / 0.6745
    if not sd > 0.0:
        return None
    near = np.argpartition(-(u @ u.T), k - 1, axis=1)[:, :k]
    means = left[near].mean(axis=1)
    score = means * np.sqrt(k / fewer) / sd
    worst = int(np.argmax(np.abs(score)))
    limit = normal_quantile(1.0 - _CHANCE / (2.0 * n))
    if abs(score[worst]) <= limit or abs(means[worst]) < _LEAST:
        return None
    side = np.sign(means[worst])
    rows = np.flatnonzero((side * score > limit / 2.0) & (u @ u[worst] > 0.5))
    named = tuple(c.readings.labels[row] for row in rows.tolist())
    listed = ", ".join(named[:_SHOWN])
    if len(named) > _SHOWN:
        listed += f" and {len(named) - _SHOWN} more"
    x, y, z = (u[worst] + 0.0).tolist()
    how = "larger" if side > 0.0 else "smaller"
    text = (
        f"the field is {100.0 * abs(means[worst]):.2g} % {how} than elsewhere along "
        f"({x:.1f}, {y:.1f}, {z:.1f}), rows {listed}"
    )
    action = "Keep iron and currents away while turning, or leave the rows out with --exclude."
    return Finding("disturbance", "warning", text, action, rows=named)


def moving_iron(c: Calibration) -> Finding | None:
    """Find hard iron that is another one from a row on."""
    found = _left(c)
    if found is None or len(found[0]) < _FEWEST_IN_TIME:
        return None
    u, design, left, fewer = found
    n, dof = len(u), len(u) / found[3] - 12.0
    if dof < 1.0:
        return None
    before, best = float(left @ left), (0.0, 0, np.zeros(3))
    for row in (_STEPS * n).astype(int).tolist():
        step = u * (np.arange(n) >= row)[:, None]
        step = step - design @ np.linalg.lstsq(design, step, rcond=None)[0]
        moved = np.linalg.lstsq(step, left, rcond=None)[0]
        gained = before - float(np.sum((left - step @ moved) ** 2))
        best = max(best, (gained, row, moved), key=lambda each: each[0])
    gained, row, moved = best
    f = gained / 3.0 / fewer / ((before - gained) / (n - 12.0)) if before > gained else 0.0
    p = min(1.0, len(_STEPS) * f_tail(f, 3.0, dof)) if f > 0.0 else 1.0
    size = float(np.linalg.norm(moved))
    if p > _CHANCE or size < _LEAST:
        return None
    scale = c.field.size if c.field.size is not None else None
    said = f"{100.0 * size:.2g} % of the field" if scale is None else c.field.shown(scale * size)
    label = c.readings.labels[row]
    text = f"hard iron changes by {said} about row {label} ({p_in_words(p)})"
    action = "Fix what moved near the sensor (cable, battery, screw), and record again."
    return Finding("moving-iron", "warning", text, action, rows=(label,), p=p)


OF_FIELD = (field_size, sphere_gap, disturbance, moving_iron)
