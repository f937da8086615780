"""Findings about a magnetic field: its size, directions that are missing, iron near and moving.

`field_size` finds a field of another size than Earth's, `disturbance` part of the sphere that has
another and `moving_iron` hard iron that changes. `sphere_gap` finds directions that no reading is
near, which `missing_directions` lists.

Of unknown orientations a reading leaves m = |b| − 1, in the relative field. To first order in an
error of the calibration it is linear in products of the direction u: the columns u (hard
iron) and u u' (soft iron), which the fit has taken up. What is left after these, r with the
standard deviation s, is judged for what no calibration of one sensor in one field explains.

*A disturbance* acts in part of the sphere: the mean of r over the k readings nearest to one of
them, k a twentieth of all, over s/√k, is beyond what the largest of n such means has by chance.

*Moving iron* changes the hard iron from a row on, or from one row to another: r falls by F on 3 and
n − 12 degrees of freedom where the columns u are added in these rows, whose ends are one of 45
pairs of tenths. The rows named are those around the best pair by which r falls most. Of what r'r
falls by, one row has no more than three fifths: of an outlier in a run it has nearly twice all.

Both take rows as worth fewer where their noise is correlated: a disturbance by `effective_rows`,
moving iron by 1 + 2 Σ ρ of the correlations ρ of u r that its step leaves, as it correlates rows.

Field sizes at the surface of the Earth: 22 to 67 µT, NOAA, World Magnetic Model 2025.
"""

import numpy as np

from multipos.files.numbers import in_unit, p_in_words
from multipos.finding import Finding
from multipos.numerics.arrays import Array, Places, median
from multipos.numerics.quantiles import f_tail, normal_quantile
from multipos.numerics.rotations import directions
from multipos.positions.readings import Readings
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
_FAINT = 0.05  # correlation of rows that are as good as independent
_CENTRES = 600  # rows around which others are averaged, even in time
_LEAST = 0.002  # relative: what nobody need look for
_TENTHS = np.arange(11) / 10.0
_RUNS = np.triu_indices(10, 1)  # between edges: what begins at the first is a complement
_DIRECTIONS = "all-26"
_OF_ONE_ROW = 0.6  # of a fall of r'r
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


def _left(c: Calibration, readings: Readings) -> tuple[Array, Array, Array, float] | None:
    """Return directions (n, 3), columns of a calibration, what they leave, and n over rows' worth.

    None where orientations are known, or readings are few.
    """
    if c.estimator is not Estimator.UNKNOWN or len(c.readings) < _FEWEST:
        return None
    if c.robust_weight is not None or not np.isfinite(c.rms):
        return None
    r = c.relative
    b = r.compensate(readings.values, readings.environment)
    u = directions(b)
    second = [u[:, i] * u[:, j] for i in range(3) for j in range(i, 3)]
    design = np.column_stack([u, *second])
    misfit = np.linalg.norm(b, axis=1) - 1.0
    left = misfit - design @ np.linalg.lstsq(design, misfit, rcond=None)[0]
    worth = c.effective_rows
    fewer = 1.0 if not worth else max(1.0, len(c.readings) / max(min(worth.values()), 1.0))
    return u, design, left, fewer


def disturbance(c: Calibration) -> Finding | None:
    """Find part of the sphere whose field has another size."""
    found = _left(c, c.readings)
    if found is None:
        return None
    u, _, left, fewer = found
    n = len(u)
    k = max(5, n // _SHARE)
    sd = float(median(np.abs(left - median(left)))) / 0.6745
    if not sd > 0.0:
        return None
    centres = ((np.arange(min(n, _CENTRES)) + 0.5) * n / min(n, _CENTRES)).astype(np.intp)
    means = np.array([left[np.argpartition(-(u @ v), k - 1)[:k]].mean() for v in u[centres]])
    score = means * np.sqrt(k / fewer) / sd
    worst = int(np.argmax(np.abs(score)))
    limit = normal_quantile(1.0 - _CHANCE / (2.0 * len(centres)))
    if abs(score[worst]) <= limit or abs(means[worst]) < _LEAST:
        return None
    side = np.sign(means[worst])
    middle = u[centres[worst]]
    rows = centres[(side * score > limit / 2.0) & (u[centres] @ middle > 0.5)]
    named = tuple(c.readings.labels[row] for row in rows.tolist())
    listed = ", ".join(named[:_SHOWN])
    if len(named) > _SHOWN:
        listed += f" and {len(named) - _SHOWN} more"
    x, y, z = (middle + 0.0).tolist()
    how = "larger" if side > 0.0 else "smaller"
    text = (
        f"the field is {100.0 * abs(means[worst]):.2g} % {how} than elsewhere along "
        f"({x:.1f}, {y:.1f}, {z:.1f}), rows {listed}"
    )
    action = "Keep iron and currents away while turning, or leave the rows out with --exclude."
    return Finding("disturbance", "warning", text, action, rows=named)


def moving_iron(c: Calibration, readings: Readings | None = None) -> Finding | None:
    """Find hard iron that is another one from a row on, or in a run of rows.

    Parameters
    ----------
    c : Calibration
    readings : Readings, optional
        Those that it was made of, with the rows that were set aside; by default without them.
    """
    readings = c.readings if readings is None else readings
    found = _left(c, readings)
    if found is None or len(found[0]) < _FEWEST_IN_TIME:
        return None
    u, design, left, _ = found
    n = len(u)
    sums = _sums(u, design, left)
    start, end, gained = _likeliest(sums)
    fewer = _times_fewer(u, left - _of_step(u, design, sums, start, end))
    dof = n / fewer - 12.0
    if dof < 1.0:
        return None
    after = float(left @ left) - gained
    f = gained / 3.0 / fewer / (after / (n - 12.0)) if after > 0.0 else 0.0
    p = min(1.0, len(_RUNS[0]) * f_tail(f, 3.0, dof)) if f > 0.0 else 1.0
    start, end = _refined(sums, start, end)
    step = _moved(sums, np.array([start]), np.array([end]))[0][0]
    size = float(np.linalg.norm(step))
    if p > _CHANCE or size < _LEAST or _of_one_row(left, _of_step(u, design, sums, start, end)):
        return None
    scale = c.field.size if c.field.size is not None else None
    said = f"{100.0 * size:.2g} % of the field" if scale is None else c.field.shown(scale * size)
    rows = readings.labels[start:end] if end < n else (readings.labels[start],)
    where = f"from row {rows[0]} to row {rows[-1]}" if end < n else f"from row {rows[0]} on"
    text = f"hard iron changes by {said} {where} ({p_in_words(p)})"
    action = "Fix what moved near the sensor (cable, battery, screw), and record again."
    return Finding("moving-iron", "warning", text, action, rows=rows, p=p)


def _sums(u: Array, design: Array, left: Array) -> Array:
    """Return sums (n + 1, 3, 13) over the first rows, for steps of hard iron in runs of rows.

    With Q an orthonormal basis of the design, they are of the products of u with what is left, u,
    and Q.
    """
    q = np.linalg.qr(design)[0]
    products = u[:, :, None] * np.column_stack([left, u, q])[:, None, :]
    return np.concatenate([np.zeros((1, *products.shape[1:])), products.cumsum(axis=0)])


def _moved(sums: Array, start: Places, end: Places) -> tuple[Array, Array]:
    """Return steps (k, 3) in k runs of rows, and what the sum of squares falls by (k,).

    The columns u of a run, less what the design takes, have the products
    A = Σ u u' − (Σ u q')(Σ u q')' among each other and g = Σ u r with what is left: the step is
    A⁻¹ g, and r'r falls by g'A⁻¹ g.
    """
    inside = sums[end] - sums[start]
    g, within, across = inside[..., 0], inside[..., 1:4], inside[..., 4:]
    A = within - across @ across.swapaxes(1, 2)
    step = np.einsum("kij,kj->ki", np.linalg.pinv(A, rcond=1e-9, hermitian=True), g)
    return step, np.einsum("ki,ki->k", step, g)


def _likeliest(sums: Array) -> tuple[int, int, float]:
    """Return the run between tenths of the rows by which r'r falls most, and by how much."""
    edges = (_TENTHS * (len(sums) - 1)).astype(np.intp)[1:]
    start, end = edges[_RUNS[0]], edges[_RUNS[1]]
    gained = _moved(sums, start, end)[1]
    best = int(np.argmax(gained))
    return int(start[best]), int(end[best]), float(gained[best])


def _of_step(u: Array, design: Array, sums: Array, start: int, end: int) -> Array:
    """Return what a step of hard iron in a run of rows leaves beside the design (n,)."""
    step = _moved(sums, np.array([start]), np.array([end]))[0][0]
    added = np.zeros(len(u))
    added[start:end] = u[start:end] @ step
    return np.asarray(added - design @ np.linalg.lstsq(design, added, rcond=None)[0])


def _times_fewer(u: Array, left: Array) -> float:
    """Return by how many times rows (n,) exceed independent ones, by the correlation of u r.

    Slow noise of the axes has misfits whose signs turn with u (n, 3), but no sign in u r.
    """
    rows = u * left[:, None]
    square, fewer = float((rows**2).sum()), 1.0
    for lag in range(1, len(rows) // 4):
        correlation = float((rows[:-lag] * rows[lag:]).sum()) / square if square > 0.0 else 0.0
        if correlation < _FAINT:
            break
        fewer += 2.0 * correlation
    return fewer


def _of_one_row(left: Array, added: Array) -> bool:
    """Tell whether most of what r'r falls by is one reading's, and no step of a run of rows."""
    fall = left**2 - (left - added) ** 2
    return float(fall.max()) > _OF_ONE_ROW * float(fall.sum())


def _refined(sums: Array, start: int, end: int) -> tuple[int, int]:
    """Return a run whose ends are moved by up to a tenth to where r'r is least."""
    n = len(sums) - 1
    reach = n // 10
    for _ in range(2):
        rows = np.arange(max(start - reach, 1), min(start + reach + 1, end - 2))
        start = int(rows[np.argmax(_moved(sums, rows, np.full_like(rows, end))[1])])
        if end < n:
            rows = np.arange(max(end - reach, start + 3), min(end + reach, n - 1))
            end = int(rows[np.argmax(_moved(sums, np.full_like(rows, start), rows)[1])])
    return start, end


OF_FIELD = (field_size, sphere_gap, disturbance, moving_iron)
