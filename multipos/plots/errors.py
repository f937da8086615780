"""The errors of a calibration on the sphere: what it says of itself in one picture."""

from typing import TYPE_CHECKING

import numpy as np

from multipos.files.numbers import in_unit
from multipos.numerics.arrays import Array
from multipos.numerics.rotations import directions
from multipos.numerics.terms import COMPONENTS
from multipos.plots.calibration import nominal_errors
from multipos.plots.hemispheres import flat
from multipos.plots.style import COLOURS, write
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LONGEST = 0.32  # of the largest error, in radii of the disc
_NAMES = 1.0 + _LONGEST + 0.1  # where the names of the axes stand, beyond an arrow on the rim
_RING = 26.0  # points of a ring as large as a radius
_APART = 1.2  # of the middles of two halves of one sphere, from its own
_SIDES = (("before", -2.65), ("after", 2.65))  # where the two spheres stand


def draw_error_sphere(calibration: Calibration, axes: "Axes") -> None:
    """Draw the error of every position before and after, each on two halves of the sphere.

    Equal-area, seen from +z and from −z. The arrow at a position is the part of the error across
    its up vector; the ring is the part along it, filled where it points out. Before and after have
    scales of their own, by the largest error, which is written below. Where the orientations are
    unknown, errors along are all there is.
    """
    c = calibration
    up = c.sign * directions(c.reference)
    for i, (when, middle) in enumerate(_SIDES):
        error = c.sign * (nominal_errors(c) if when == "before" else _left(c))
        along = np.einsum("ni,ni->n", error, up)
        across = error - along[:, None] * up
        if c.estimator is Estimator.UNKNOWN:
            across[:] = 0.0
        size = np.hypot(np.linalg.norm(across, axis=1), along)
        largest = float(np.nanmax(size, initial=0.0))
        scale = _LONGEST / largest if largest > 0.0 else 0.0
        shown = np.isfinite(size)
        for side in (1.0, -1.0):
            centre = middle - side * _APART
            _draw_half(axes, side, centre)
            on = (side * up[:, 2] >= -1e-12) & shown
            at = flat(up[on], side) + np.array([centre, 0.0])
            _draw_arrows(axes, at, _moved(up[on], across[on] * scale, side), COLOURS[1 - i])
            _draw_rings(axes, at, along[on] * scale, COLOURS[1 - i])
        write(
            axes, middle, -1.6, f"{when}: largest {in_unit(largest, 'g')}", ha="center", va="center"
        )
    axes.set_aspect("equal")
    axes.set_xlim(-5.1, 5.5)
    axes.set_ylim(-1.75, 1.55)
    axes.set_axis_off()


def _draw_arrows(axes: "Axes", at: Array, step: Array, colour: str) -> None:
    if not len(at):
        return
    axes.quiver(
        *at.T,
        *step.T,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        color=colour,
        width=0.003,
        headwidth=4.0,
        headlength=5.0,
        headaxislength=4.5,
    )


def _draw_rings(axes: "Axes", at: Array, along: Array, colour: str) -> None:
    for (x, y), part in zip(at.tolist(), along.tolist(), strict=True):
        axes.plot(
            x,
            y,
            "o",
            markersize=1.5 + _RING * abs(part),
            markerfacecolor=colour if part > 0.0 else "none",
            markeredgecolor=colour,
            markeredgewidth=0.7,
        )


def _draw_half(axes: "Axes", side: float, centre: float) -> None:
    circle = np.linspace(0.0, 2.0 * np.pi, 121)
    axes.plot(centre + np.cos(circle), np.sin(circle), color="#000000", linewidth=0.7)
    r = np.sqrt(1.0 - np.sin(np.radians(45.0)))
    axes.plot(centre + r * np.cos(circle), r * np.sin(circle), color=COLOURS[6], linewidth=0.4)
    write(axes, centre - 1.0, 1.15, "+z" if side > 0 else "−z", ha="center", va="center")
    names = [("+y", 0.0, _NAMES)]
    if side < 0.0:  # the half on the right: between the two an arrow may stand
        names.append(("+x", _NAMES, 0.0))
    for name, px, py in names:
        write(axes, centre + px, py, name, ha="center", va="center", fontsize=7)


def _moved(up: Array, step: Array, side: float) -> Array:
    """Return a step (n, 3) across `up` in the map (n, 2), its direction kept and its length too."""
    small = 1e-4 / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-12)
    moved = flat(directions(up + small * step), side) - flat(up, side)
    length = np.linalg.norm(moved, axis=1, keepdims=True)
    return np.asarray(
        moved / np.maximum(length, 1e-12) * np.linalg.norm(step, axis=1, keepdims=True)
    )


def _left(c: Calibration) -> Array:
    """Return compensated force less reference (n, 3) [g], nothing along what is not sensed."""
    sensed = [i for i, axis in enumerate(COMPONENTS) if axis in c.model.axes]
    error = np.zeros(c.reference.shape)
    force = c.compensate(c.readings.values, c.readings.environment)
    error[:, sensed] = force - c.reference[:, sensed]
    return error
