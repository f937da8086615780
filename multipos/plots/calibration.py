"""Figures of a calibration: residuals, errors at positions, budget.

`draw_residuals` draws what is left of one output, `draw_size_residuals` what is left of the size of
the force where orientations are unknown, and `residual_panels` returns what draws either;
`residual_series` and `size_residuals` are the numbers. `draw_errors` draws the errors before and
after compensation, of which `compensated_error` and `compensated_errors` are those after.
`draw_budget` draws `variance_shares`, what each input quantity has of a variance.
"""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from multipos.numerics.arrays import Array
from multipos.numerics.rotations import directions
from multipos.plots.marks import draw_points
from multipos.plots.style import COLOURS, HATCHES, name_axis, name_series, scale_by_powers
from multipos.sensor.calibration import Calibration, has_nominal, nominal_error
from multipos.sensor.found import Estimator
from multipos.sensor.inverse import sensitivities
from multipos.uncertainty.propagation import Evaluation

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_TICKS = 26  # labels that fit below a figure


def draw_residuals(calibration: Calibration, axes: "Axes", *, output: str) -> None:
    """Draw the residuals of an output at every position, with ±2 standard deviations of each.

    The band is that of the residuals themselves, s sqrt(1 − h), narrow where the leverage h is
    large.
    """
    c = calibration
    i = c.outputs.index(output)
    _draw_series(c, axes, found=_series_of_outputs(c)[i], place=i)


Series = tuple[str, str, Array, Array]  # name, unit, residuals (n,) and ±2 sd of each


def residual_series(calibration: Calibration) -> list[Series]:
    """Return the residuals that a calibration has: of its outputs, or `size_residuals`."""
    c = calibration
    if c.estimator is not Estimator.UNKNOWN:
        return _series_of_outputs(c)
    sizes, sd = size_residuals(c)
    return [(c.field.worded("size of the force"), c.field.printed, sizes, 2.0 * sd)]


def _series_of_outputs(c: Calibration) -> list[Series]:
    bands = 2.0 * c.sd_of_readings * np.sqrt(np.maximum(1.0 - c.diagnostics.leverage, 0.0))
    columns = zip(c.outputs, c.residuals.T, bands.T, strict=True)
    return [(output, c.model.unit, left, band) for output, left, band in columns]


def _draw_series(c: Calibration, axes: "Axes", *, found: Series, place: int) -> None:
    name, unit, values, band = found
    at = np.arange(len(values))
    axes.axhline(0.0, color="#000000", linewidth=0.6)
    if np.isfinite(band).all():
        axes.vlines(at, -band, band, color=COLOURS[5], linewidth=5.0, label="±2 sd")
    draw_points(axes, at, values, place, name)
    _name_positions(axes, c.readings.labels)
    name_axis(axes.yaxis, name, unit)
    name_series(axes, 2)


def size_residuals(calibration: Calibration) -> tuple[Array, Array]:
    """Return by how much the size of each compensated force is off, and its sd, (n,) [g].

    That is all an orientation that is unknown leaves of a position: the residual along the normal
    of the surface of readings at |f| = 1 g, which is w·r with w = u'S⁻¹ of the up vector u and the
    sensitivity S at it. Its variance is Σ w²σ² (1 − h), h the leverage of the position.
    """
    c = calibration
    inverse, _ = sensitivities(c.model, c.parameters, c.reference, c.readings.environment)
    w = np.einsum("ni,nij->nj", directions(c.reference), inverse)
    left = np.maximum(1.0 - c.diagnostics.leverage.sum(axis=1), 0.0)
    sd = np.sqrt(np.sum((w * c.sd_of_readings) ** 2, axis=1) * left)
    return np.sum(w * c.residuals, axis=1), sd


def draw_size_residuals(calibration: Calibration, axes: "Axes") -> None:
    """Draw `size_residuals` at every position, with ±2 standard deviations of each."""
    (found,) = residual_series(calibration)
    _draw_series(calibration, axes, found=found, place=0)


def residual_panels(calibration: Calibration) -> "list[Callable[[Axes], None]]":
    """Return what draws the residuals: a panel for each output, or what a position has."""
    series = residual_series(calibration)
    return [
        partial(_draw_series, calibration, found=each, place=i) for i, each in enumerate(series)
    ]


def draw_errors(calibration: Calibration, axes: "Axes") -> None:
    """Draw the size of the error at every position before and after compensation [g].

    Before: `nominal_error` where a reading has a nominal size, after: compensated force less
    reference.
    """
    c = calibration
    after = compensated_error(c)
    before = nominal_error(c) if has_nominal(c) else None
    at = np.arange(len(after))
    tiny = 1e-3 * max(float(np.nanmax(after if before is None else before)), 1e-12)
    if before is not None:
        draw_points(axes, at, np.maximum(before, tiny), 1, "before")
    draw_points(axes, at, np.maximum(after, tiny * 1e-3), 0, "after")
    scale_by_powers(axes, "y", c.field.printed)
    axes.set_ylabel("error")
    _name_positions(axes, c.readings.labels)
    name_series(axes, 2)


def compensated_error(calibration: Calibration) -> Array:
    """Return the size (n,) [g] of what is left after compensation."""
    return np.asarray(np.linalg.norm(compensated_errors(calibration), axis=1))


def compensated_errors(calibration: Calibration) -> Array:
    """Return compensated force less reference (n, 3) [g], nothing along what is not sensed."""
    c, sensed = calibration, list(calibration.model.sensed_axes)
    errors = np.zeros(c.reference.shape)
    force = c.compensate(c.readings.values, c.readings.environment)
    errors[:, sensed] = force - c.reference[:, sensed]
    return errors


def draw_budget(evaluation: Evaluation, axes: "Axes") -> None:
    """Draw what share of each parameter's variance every input quantity has [%]."""
    quantities, share = variance_shares(evaluation)
    at = np.arange(len(evaluation.names))
    left = np.zeros(len(at))
    for i, (quantity, part) in enumerate(zip(quantities, share, strict=True)):
        look: dict[str, Any] = {
            "color": COLOURS[i % 8],
            "hatch": HATCHES[i % 8],
            "edgecolor": "#ffffff",
        }
        axes.barh(at, part, left=left, label=quantity, linewidth=0.3, **look)
        left = left + part
    axes.set_yticks(at, list(evaluation.names))
    axes.invert_yaxis()
    axes.set_xlim(0.0, 100.0)
    axes.set_xlabel("share of the variance [%]")
    name_series(axes, 3)


def variance_shares(evaluation: Evaluation) -> tuple[list[str], Array]:
    """Return the quantities and their share (quantities, p) of each variance [%]."""
    added = np.array([np.diag(row.added) for row in evaluation.rows])
    names = list(dict.fromkeys(row.quantity for row in evaluation.rows))
    total = np.maximum(added.sum(axis=0), np.finfo(float).tiny)
    parts = [
        sum(added[i] for i, row in enumerate(evaluation.rows) if row.quantity == name)
        for name in names
    ]
    return names, 100.0 * np.array(parts) / total


def _name_positions(axes: "Axes", names: tuple[str, ...]) -> None:
    step = -(-len(names) // _TICKS)
    at = np.arange(0, len(names), step)
    long = max(map(len, names)) > 3 and len(at) > 8
    axes.set_xticks(at, [names[i] for i in at], rotation=90 if long else 0)
    axes.set_xlim(-0.6, len(names) - 0.4)
    axes.set_xlabel("position")
