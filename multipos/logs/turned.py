"""Logs of an accelerometer that is turned all the time: windows of them, the slow ones first.

`turned` makes readings of a log that never rests. Their orientations are unknown, their u is that
of how fast they turn, and a column `turn_rate` says how fast that is, by which the fit knows that
rows follow each other (`multipos.estimation.correlated_rows`). No time is needed for it.

A sensor that is turned by hand at ω(t), its proof mass at r from the axis, reads

    y = b + M [f + (ω × (ω × r) + ω' × r)/g + e],      |f| = 1 g,                           (1)

e being the tremor and other acceleration of the hand. Samples are averaged in windows of h, the
largest power of two of which windows turn by less than `_WITHIN` from one to the next; with m_k
their means, the reading at the middle of a window is, but for terms of fourth order in its turn,

    y_k = m_k − (1 − 1/h²) (m_k−1 − 2 m_k + m_k+1)/24.                                      (2)

The turn rate ω_k is half the angle from window k − 1 to window k + 1. Of ω × (ω × r) what does not
average out over the directions of ω is a bias along −r that grows with ω², three columns of

    y_k = b + a ω_k² + M f_k;                                                               (3)

ω' × r and e average out slowly, and grow with the turn rate. So the misfit r_k = |f_k| − 1 has a
standard deviation σ(ω), the median of |r|/0.6745 in each of `_GROUPS` groups of windows in order of
ω_k. With the weights of Huber's loss, as a hand gives jolts,

    u_k = c σ(ω_k) max(1, |r_k|/(1.5 σ))^½,                                                 (4)

the ellipsoid through the y_k by eqs. (3), (4) is found again and again; c makes the mean of
(r_k/u_k)² one. The readings of the fit are y_k − a ω_k², and its U allows for an uncertain a.

References
----------
P. J. Huber, Ann. Math. Statist. 35 (1964), 73–101.
"""

from pathlib import Path

import numpy as np

from multipos.errors import MultiposError
from multipos.finding import Finding
from multipos.logs.ellipsoids import Ellipsoid, angles, covers, fit_ellipsoid, usual_turn
from multipos.logs.table import Log
from multipos.logs.waved import Waved, find_cut_off, read_rows
from multipos.numerics.arrays import Array, median
from multipos.positions.headers import TURN_RATE, component
from multipos.positions.readings import Readings
from multipos.units import STANDARD_GRAVITY

_WITHIN = 4.0  # degrees from one window to the next
_FEWEST = 240  # windows
_MOST = 4000  # windows that a fit is made of
_GROUPS = 12
_HUBER = 1.5
_ROUNDS = 10
_FASTEST = 0.99  # of the windows: those that turn faster are taken as turning so fast
_GRAVITY = (1.0, STANDARD_GRAVITY, 1000.0)  # in g, m/s², mg
_OFF_GRAVITY, _OFF_POWER = 0.15, 0.03  # relative
_COUNTS = 16.0  # of one g, at least
_EARTH = ((22.0, 67.0), (220.0, 670.0), (0.22, 0.67))  # magnetic field in µT, mG, G
_UNKNOWNS = 12  # nine parameters and a


def turned(
    log: Log,
    outputs: tuple[str, ...],
    *,
    unit: str | None = None,
    signed: int | None = None,
    drop_bad: bool = False,
) -> Waved | None:
    """Return the windows of a log that is turned through all directions, for long enough.

    None where it is not. Errors are those of `read_rows`; without names and unit also that of a
    sphere which is not gravity's.
    """
    values, environment = read_rows([log], outputs, signed=signed, drop_bad=drop_bad)
    if not covers(values):
        return None
    h = _samples_of_a_window(values)
    middles = _middles(values, h)
    form = fit_ellipsoid(middles)
    if len(middles) < _FEWEST or form is None:
        return None
    named = any(component(name).acceleration for name in outputs)
    if unit is None and not named and not any(log.units.get(name) for name in outputs):
        _require_gravity(log.source, form)
    at_rest, u, rate = _without_arm(middles, form)
    kept = slice(None, None, -(-len(middles) // _MOST))
    warm = {name: _middles(column[:, None], h)[kept, 0] for name, column in environment.items()}
    readings = Readings(
        values=at_rest[kept],
        outputs=outputs,
        positions=tuple(str(h * (k + 1) + 1) for k in range(len(middles)))[kept],
        u=u[kept],
        environment={TURN_RATE: rate[kept], **warm},
        source=log.source,
    )
    text = (
        f"no rest: {len(readings)} windows of {h} rows while it turns are fitted, weighted by how "
        "slowly it turns; U is 19 to 79 times that of rests of the same length"
    )
    no_rests = Finding("no-rests", "warning", text, "Hold it still in 10 or more directions.")
    findings = (no_rests, *find_cut_off(outputs, values), *log.left_out)
    units = {log.units.get(name) for name in outputs}
    unit = units.pop() if len(units) == 1 else None
    return Waved(log.source, outputs, len(values), readings, findings, unit)


def _require_gravity(source: str, form: Ellipsoid) -> None:
    """Refuse a sphere of another radius than gravity has in the units of accelerometers."""
    radius = float(np.cbrt(1.0 / np.linalg.det(form.root)))
    power = abs(np.log2(radius) - round(np.log2(radius))) < np.log2(1.0 + _OFF_POWER)
    if (radius >= _COUNTS and power) or any(abs(radius / g - 1.0) < _OFF_GRAVITY for g in _GRAVITY):
        return
    line = f"multipos calibrate {Path(source).name}"
    magnetic = f"{line} --field magnetic"
    if not any(low < radius < high for low, high in _EARTH):
        magnetic += f", or {line} --unit count for an accelerometer"
    raise MultiposError(
        f"{source}: readings without names lie on a sphere of radius {radius:.3g}, which is not "
        f"gravity in g, m/s^2 or mg; type {magnetic}."
    )


def _samples_of_a_window(values: Array) -> int:
    """Return h."""
    h = 1
    while len(values) // (2 * h) >= 2 * _FEWEST and usual_turn(_means(values, 2 * h)) < _WITHIN:
        h *= 2
    return h


def _means(values: Array, h: int) -> Array:
    """Return the means of h rows each."""
    count = len(values) // h
    return np.asarray(values[: count * h].reshape(count, h, -1).mean(axis=1))


def _middles(values: Array, h: int) -> Array:
    """Return the readings (k, M) at the middle of windows of h rows, by eq. (2)."""
    means = _means(values, h)
    bend = means[2:] - 2.0 * means[1:-1] + means[:-2]
    return np.asarray(means[1:-1] - (1.0 - 1.0 / h**2) * bend / 24.0)


def _without_arm(middles: Array, form: Ellipsoid) -> tuple[Array, Array, Array]:
    """Return readings (k, 3) without the arm, their u (k, 3), and ω (k,) [degrees a window]."""
    values = middles
    for _ in range(_ROUNDS):
        field = form.field(values)
        length = np.linalg.norm(field, axis=1)
        misfit, rate = length - 1.0, _turn_rates(field / length[:, None])
        sigma = _sd_by_rate(misfit, rate)
        u = sigma * np.sqrt(np.maximum(1.0, np.abs(misfit) / (_HUBER * sigma)))
        form = fit_ellipsoid(middles, weight=1.0 / u, square=rate**2, about=form.centre) or form
        values = middles - form.arm * rate[:, None] ** 2
    u *= np.sqrt(np.sum((misfit / u) ** 2) / (len(u) - _UNKNOWNS))
    return values, u[:, None] / np.linalg.norm(form.root, axis=1), rate


def _turn_rates(along: Array) -> Array:
    """Return ω (k,) [degrees a window] of windows in directions (k, 3)."""
    over_two = angles(along[2:], along[:-2])
    rate = np.degrees(np.concatenate([over_two[:1], over_two, over_two[-1:]]) / 2.0)
    return np.asarray(np.minimum(rate, np.quantile(rate, _FASTEST)))


def _sd_by_rate(misfit: Array, rate: Array) -> Array:
    """Return σ (k,) of misfits (k,)."""
    sd = np.empty(len(misfit))
    for group in np.array_split(np.argsort(rate, kind="stable"), _GROUPS):
        sd[group] = median(np.abs(misfit[group])) / 0.6745
    return np.maximum(sd, 1e-12)
