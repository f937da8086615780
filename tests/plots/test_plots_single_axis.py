"""The figures of tumble and check show what the results hold."""

import numpy as np
import pytest
from inclinometer_bench import calibrated, check_run, make_bench
from tumble_bench import tumble

import multipos as mp
from multipos.plots import (
    check_figure,
    draw_check,
    draw_residual_harmonics,
    draw_signal,
    new_figure,
)


@pytest.fixture
def axes():
    from matplotlib.figure import Figure

    return Figure(figsize=(6, 3), layout="constrained").subplots()


def test_signal_passes_through_the_readings(axes):
    found = tumble("roll-z-12+roll-y-12", sd=1e-3)
    draw_signal(found, axes)
    curve, points = axes.lines[0], axes.lines[1]
    assert points.get_ydata().tolist() == found.calibration.readings.values[:12, 0].tolist()
    at_points = np.interp(points.get_xdata(), curve.get_xdata(), curve.get_ydata())
    np.testing.assert_allclose(at_points, points.get_ydata(), atol=1e-9)


def test_named_harmonics_are_marked(axes):
    t = 2 * np.pi * np.arange(24) / 24
    noise = 1e-6 * np.random.default_rng(1).standard_normal(24)
    found = mp.tumble({"E": np.cos(t) + 1e-4 * np.sin(5 * t) + noise}, scheme="tumble-24")
    draw_residual_harmonics(found, axes)
    assert len(axes.patches) == len(found.residual_harmonics)
    assert [text.get_position()[0] for text in axes.texts] == [5.0]


def test_check_is_drawn_with_its_limits(axes):
    rng = np.random.default_rng(1)
    bench = make_bench(rng)
    cal = calibrated(bench, rng)
    found = mp.check(cal, check_run(bench, rng), limit_deg=0.05, nominal=(2.5, 1.0))
    draw_check(found, axes, axis="x")
    heights = [line.get_ydata()[0] for line in axes.lines if len(line.get_ydata()) == 2]
    assert heights == [0.0, -0.05, 0.05]
    assert "limit ±0.05°" in [text.get_text() for text in axes.get_legend().get_texts()]


def test_positions_of_one_angle_stand_where_they_are():
    rng = np.random.default_rng(1)
    bench = make_bench(rng)
    found = mp.check(calibrated(bench, rng), check_run(bench, rng), limit_deg=0.05)
    _, (axes,) = new_figure()
    draw_check(found, axes, axis="x", when="after")
    (drawn,) = (line.get_xdata() for line in axes.lines if len(line.get_xdata()) == 18)
    np.testing.assert_allclose(drawn, np.sort(found.reference[:, 0]))


def test_before_has_axes_of_its_own_where_it_would_hide_what_is_left():
    rng = np.random.default_rng(1)
    bench = make_bench(rng)
    cal = calibrated(bench, rng)
    run = check_run(bench, rng)
    for nominal, panels in (((2.5, 1.0), 4), ((0.0, 1.0), 4)):
        found = mp.check(cal, run, limit_deg=0.05, nominal=nominal)
        figure = check_figure(found)
        assert len(figure.axes) == panels
        assert {one.get_yscale() for one in figure.axes} == {"linear"}
    # A limit of 5° would hide errors of .05° as well: it is named, and not drawn.
    wide = check_figure(mp.check(cal, run, limit_deg=5.0, nominal=(2.5, 1.0)))
    assert len(wide.axes) == 4
    after = wide.axes[1]
    assert max(map(abs, after.get_ylim())) < 0.5
    named = [text.get_text() for text in after.get_legend().get_texts()]
    assert "limit ±5°, outside" in named
