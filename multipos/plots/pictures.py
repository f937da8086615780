"""The two figures that every report has, written as SVG without Matplotlib.

`error_picture` is the sphere of errors before and after, of which `split_errors` are the numbers;
`residual_picture` has a panel of residuals for each output.

A report holds the errors of all positions on its first screen and the residuals below. Importing
Matplotlib and laying out with it takes longer than all else that a report does.

Lengths are units of the view box, which is as wide as a telephone, so that type keeps its size.
"""

import math
from collections.abc import Sequence
from html import escape
from typing import Literal

import numpy as np

from multipos.files.numbers import number, readable_unit
from multipos.numerics.arrays import Array, Places
from multipos.numerics.rotations import directions
from multipos.plots.calibration import Series, compensated_errors, residual_series
from multipos.plots.hemispheres import flat
from multipos.plots.style import COLOURS
from multipos.sensor.calibration import Calibration, has_nominal, nominal_errors
from multipos.sensor.found import Estimator

_WIDTH, _TYPE, _INK = 360, 11, "#000000"
_DRAWN = 500  # positions: of more than twice as many the largest of equal parts
_RADIUS, _LONGEST = 58.0, 0.32  # of a disc, and of the largest error as a share of it
_ROW = 182  # height of a sphere
_PANEL, _MIDDLE, _HALF = 102, 59, 36  # height of residuals, their zero, and how far they reach
_LEFT, _FOOT = 48, 30
_ROUND = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)  # times a power of ten


class _Picture:
    """An SVG element in the making."""

    def __init__(self, height: float) -> None:
        self._parts = [
            f'<svg viewBox="0 0 {_WIDTH} {height:g}" xmlns="http://www.w3.org/2000/svg">'
        ]

    def path(self, steps: str, colour: str, width: float) -> None:
        self._parts.append(
            f'<path d="{steps}" fill="none" stroke="{colour}" stroke-width="{width:g}" '
            'stroke-linecap="round" stroke-linejoin="round"/>'
        )

    def circle(self, x: float, y: float, r: float, colour: str, *, filled: bool = False) -> None:
        paint = colour if filled else "none"
        self._parts.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{r:.1f}" fill="{paint}" stroke="{colour}" '
            'stroke-width=".8"/>'
        )

    def write(
        self, x: float, y: float, text: str, anchor: Literal["start", "middle", "end"] = "middle"
    ) -> None:
        self._parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" font-size="{_TYPE}" text-anchor="{anchor}">'
            f"{escape(text)}</text>"
        )

    def __str__(self) -> str:
        return "".join([*self._parts, "</svg>"])


def _largest(sizes: Array) -> Places:
    """Return the places of all sizes, of very many those of the largest in equal parts."""
    places = np.arange(len(sizes))
    if len(sizes) <= 2 * _DRAWN:
        return places
    return np.array([part[np.argmax(sizes[part])] for part in np.array_split(places, _DRAWN)])


def error_picture(calibration: Calibration) -> str:
    """Return the error of every position before and after, each on two halves of the sphere.

    Before only where a reading has a nominal size. Equal-area, seen from +z and from −z. The arrow
    at a position is the part of the error across its up vector; the ring is the part along it,
    filled where it points out. Before and after have scales of their own, by the largest error,
    which is written above. Where the orientations are unknown, errors along are all there is.
    """
    c = calibration
    stages = ("before", "after") if has_nominal(c) else ("after",)
    picture = _Picture(len(stages) * _ROW)
    up = c.sign * directions(c.reference)
    for i, when in enumerate(stages):
        colour = COLOURS[when == "before"]
        across, along = split_errors(c, when)
        size = np.hypot(np.linalg.norm(across, axis=1), along)
        largest = float(np.nanmax(size, initial=0.0))
        scale = _LONGEST / largest if largest > 0.0 else 0.0
        picture.write(0.5 * _WIDTH, i * _ROW + 12, f"{when}: largest {c.field.shown(largest)}")
        length = np.array([_LONGEST * _RADIUS * across.any(), 0.0])  # how long that is drawn
        _draw_arrow(picture, 0.5 * _WIDTH + 84.0, i * _ROW + 8.0, length, colour)
        shown = _largest(size)[np.isfinite(size[_largest(size)])]
        for side in (1.0, -1.0):
            centre = np.array([0.5 * _WIDTH - 82.0 * side, i * _ROW + 104.0])
            _draw_half(picture, side, centre)
            on = shown[side * up[shown, 2] >= -1e-12]
            steps = _moved(up[on], across[on] * scale, side)
            for place, step, part in zip(flat(up[on], side), steps, along[on] * scale, strict=True):
                x, y = centre + _RADIUS * place * (1.0, -1.0)
                r = 1.0 + 0.5 * _RADIUS * abs(part)
                picture.circle(x, y, r, colour, filled=part > 0.0)
                _draw_arrow(picture, x, y, _RADIUS * step * (1.0, -1.0), colour)
    return str(picture)


def split_errors(c: Calibration, when: str) -> tuple[Array, Array]:
    """Return the errors before or after across the up vector (n, 3) and along it (n,) [g]."""
    up = c.sign * directions(c.reference)
    error = c.sign * (nominal_errors(c) if when == "before" else compensated_errors(c))
    along = np.einsum("ni,ni->n", error, up)
    across = error - along[:, None] * up
    if c.estimator is Estimator.UNKNOWN:
        across[:] = 0.0
    return across, along


def _draw_arrow(picture: _Picture, x: float, y: float, step: Array, colour: str) -> None:
    length = float(np.hypot(*step))
    if length < 0.5:
        return
    (dx, dy), head = step, min(4.0, 0.6 * length) / length
    tip = f"M{x:.1f} {y:.1f}L{x + dx:.1f} {y + dy:.1f}"
    for turn in (0.5, -0.5):
        back = f"{x + dx - head * (dx - turn * dy):.1f} {y + dy - head * (dy + turn * dx):.1f}"
        tip += f"M{back}L{x + dx:.1f} {y + dy:.1f}"
    picture.path(tip, colour, 1.2)


def _draw_half(picture: _Picture, side: float, centre: Array) -> None:
    x, y = centre
    picture.circle(x, y, _RADIUS, _INK)
    picture.circle(x, y, _RADIUS * np.sqrt(1.0 - np.sin(np.radians(45.0))), COLOURS[6])
    picture.write(x - _RADIUS, y - _RADIUS, "+z" if side > 0 else "−z", "end")
    picture.write(x, y - 1.33 * _RADIUS, "+y")
    if side < 0.0:  # the half on the right: between the two an arrow may stand
        picture.write(x + 1.36 * _RADIUS, y + 4, "+x", "start")


def _moved(up: Array, step: Array, side: float) -> Array:
    """Return a step (n, 3) across `up` in the map (n, 2), its direction kept and its length too."""
    small = 1e-4 / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-12)
    moved = flat(directions(up + small * step), side) - flat(up, side)
    length = np.linalg.norm(moved, axis=1, keepdims=True)
    return np.asarray(
        moved / np.maximum(length, 1e-12) * np.linalg.norm(step, axis=1, keepdims=True)
    )


def residual_picture(calibration: Calibration) -> str:
    """Return the residuals of every position with ±2 standard deviations of each.

    A panel for each output; of unknown orientation one of the size of the force
    (`multipos.plots.calibration.size_residuals`). The bands are those of the residuals, narrow
    where the leverage is large.
    """
    c = calibration
    panels = residual_series(c)
    shown = _largest(np.max([np.abs(values) for _, _, values, _ in panels], axis=0))
    places = _LEFT + (shown + 0.5) * (_WIDTH - _LEFT - 4) / len(c.readings)
    picture = _Picture(len(panels) * _PANEL + _FOOT)
    for i, (name, unit, values, band) in enumerate(panels):
        _draw_panel(picture, i, places, (name, unit, values[shown], band[shown]))
    _name_positions(picture, len(panels) * _PANEL, [c.readings.labels[k] for k in shown], places)
    picture.write(0.5 * (_LEFT + _WIDTH), len(panels) * _PANEL + _FOOT - 4, "position")
    return str(picture)


def _draw_panel(picture: _Picture, place: int, places: Array, found: Series) -> None:
    """Draw the residuals of one output below its name, with three marks along the axis."""
    name, unit, values, band = found
    known = np.isfinite(band).all()
    reach = np.concatenate([values, band]) if known else values
    mark = _mark(float(np.max(np.abs(reach), initial=0.0)))
    factor, shown = readable_unit(mark, unit)
    top = place * _PANEL
    middle, scale = top + _MIDDLE, _HALF / (mark or 1.0)
    picture.write(0.0, top + 12.0, f"{name} [{shown}]", "start")
    for at in (-mark, 0.0, mark):
        y = middle - scale * at
        picture.path(f"M{_LEFT} {y:.1f}H{_WIDTH}", COLOURS[6], 0.4 if at else 0.8)
        if at or not mark:
            sign = "−" if at < 0.0 else ""
            picture.write(_LEFT - 4, y + 4, f"{sign}{number(abs(factor * at))}", "end")
    if known:
        bars = "".join(
            f"M{x:.1f} {middle - scale * b:.1f}V{middle + scale * b:.1f}"
            for x, b in zip(places.tolist(), band.tolist(), strict=True)
        )
        picture.path(bars, COLOURS[5], min(4.0, 0.5 * (_WIDTH - _LEFT) / len(places)))
    for x, value in zip(places.tolist(), values.tolist(), strict=True):
        picture.circle(x, middle - scale * value, 1.8, COLOURS[place % 5], filled=True)


def _mark(largest: float) -> float:
    """Return the least round number that nothing is beyond."""
    if not largest > 0.0:
        return 0.0
    power = 10.0 ** math.floor(math.log10(largest))
    return min(step * power for step in _ROUND if step * power >= largest * (1.0 - 1e-9))


def _name_positions(picture: _Picture, y: float, names: Sequence[str], places: Array) -> None:
    """Name as many positions as there is room for."""
    room = 7.0 * max(map(len, names)) + 4.0
    step = int(np.ceil(room / ((_WIDTH - _LEFT) / len(names))))
    for k in range(0, len(names), step):
        picture.write(float(places[k]), y + 11.0, names[k])
