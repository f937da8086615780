"""Pictures of schemes: what is drawn where."""

import numpy as np
import pytest

import multipos as mp
from multipos.plots import draw_efficiency, draw_scheme, new_figure


def markers(axes):
    """The positions; the other lines are the rims."""
    return [line for line in axes.lines if len(line.get_xdata()) == 1]


def test_scheme_map_shows_every_position_and_the_largest_variance():
    figure, (axes,) = new_figure()
    draw_scheme("faces-corners-14", axes, model="own-quadratic")
    places = np.array([line.get_xydata()[0] for line in markers(axes)])
    # 2 poles, 8 corners, and 4 faces on the rim of both hemispheres
    assert len(places) == 2 + 8 + 2 * 4
    meshes = axes.collections
    (entry,) = mp.schemes("faces-corners-14", model="own-quadratic")["schemes"]
    # the grid passes through the poles, where the variance is largest
    assert max(mesh.get_array().max() for mesh in meshes) == pytest.approx(
        1.0 / entry["g_efficiency"]
    )
    figure.canvas.draw()


def test_scheme_map_counts_repeats():
    _, (axes,) = new_figure()
    draw_scheme("faces-6+faces-6", axes)
    assert {text.get_text() for text in axes.texts} >= {"2", "z up", "z down"}


def test_lambert_map_keeps_areas():
    _, (axes,) = new_figure()
    up = np.array([[0.0, np.sin(t), np.cos(t)] for t in (0.3, 0.9, 1.4)])
    table = dict(zip(("up_x", "up_y", "up_z"), np.vstack([up, np.eye(3)]).T, strict=True))
    draw_scheme(table, axes)
    radius = {round(float(np.hypot(*line.get_xydata()[0])), 9) for line in markers(axes)}
    # a cap of height 1 − cos t has the share 1 − cos t of the hemisphere
    for t in (0.3, 0.9, 1.4):
        assert min(abs(r**2 - (1.0 - np.cos(t))) for r in radius) < 1e-5


def test_efficiency_curve():
    figure, (axes,) = new_figure()
    draw_efficiency({"linear": [mp.design("linear", n) for n in (4, 5, 6)]}, axes)
    curve = axes.lines[0]
    assert curve.get_xdata().tolist() == [4, 5, 6]
    assert curve.get_ydata()[0] == pytest.approx(1.0)
    figure.canvas.draw()
