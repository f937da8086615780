"""How a figure is written as SVG and in pixels: hatches and fonts."""

import re
import warnings

import numpy as np
import pytest
from matplotlib.figure import Figure

import multipos as mp
from multipos.plots import draw_zero, fonts, new_figure, render, to_svg
from multipos.plots.hemispheres import draw_map, everywhere
from multipos.plots.svg import hatch_lines

ENDS = [
    ("--", [(0, 0), (10, 0), (0, 6), (10, 6)]),
    ("||", [(0, 0), (0, 6), (6, 0), (6, 6)]),
    ("//", [(0, 0), (6, 6)]),
    ("\\\\", [(0, 0), (0, 0), (6, 6), (10, 2)]),
    ("xx", [(0, 0), (6, 6), (0, 0), (0, 0), (6, 6), (10, 2)]),
    ("++", [(0, 0), (10, 0), (0, 6), (10, 6), (0, 0), (0, 6), (6, 0), (6, 6)]),
]


@pytest.mark.parametrize(("hatch", "ends"), ENDS, ids=[hatch for hatch, _ in ENDS])
def test_lines_of_a_hatch_end_where_the_rectangle_does(hatch, ends):
    """By hand in 10 by 6 points: lines every 6, slanting ones every 12 along an axis."""
    lines = hatch_lines(hatch, (0.0, 0.0), (10.0, 6.0))
    np.testing.assert_allclose(lines.vertices, ends, atol=1e-12)
    assert lines.codes.tolist() == [1, 2] * (len(ends) // 2)


def test_a_narrow_bar_between_the_lines_has_none():
    assert len(hatch_lines("||", (1.0, 0.0), (2.0, 6.0))) == 1


def test_hatches_are_lines_and_no_pattern():
    figure, (axes,) = new_figure()
    axes.bar([0.0, 1.0], [1.0, 2.0], hatch="//", edgecolor="#ffffff")
    assert "<pattern" not in to_svg(figure)
    assert to_svg(figure).count("stroke-width: 0.6") == 2


def chinese():
    figure, (axes,) = new_figure()
    axes.set_xlabel("位置")
    return figure


def test_pixels_of_chinese_come_from_a_font_that_has_it(monkeypatch):
    if not fonts._chinese_fonts():
        pytest.skip("needs a font of Chinese")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for ending in (".png", ".pdf"):
            assert render(chinese(), ending)


def test_without_a_font_of_chinese_pixels_are_refused_and_svg_is_not(monkeypatch):
    dejavu = fonts.font_of("x", 9.0)
    from matplotlib.font_manager import findfont

    monkeypatch.setattr(fonts, "_chinese_fonts", lambda: (findfont(dejavu),))
    with pytest.raises(mp.MultiposError, match=r"characters '位置' .* write a \.svg file"):
        render(chinese(), ".png")
    assert ">位置<" in to_svg(chinese())


def test_a_map_of_one_value_shows_no_rounding():
    """u of a linear model by six faces is the same in all directions, but for the last digits."""
    axes = Figure().subplots()
    noise = 1e-12 * np.random.default_rng(1).standard_normal(len(everywhere()))
    draw_map(2.0 + noise, "u", axes)
    for mesh in axes.collections:
        assert np.ptp(mesh.get_array()) == 0.0
        assert mesh.get_clim() == pytest.approx((1.0, 3.0))


def test_a_zero_without_a_unit_stands_clear_of_what_its_axis_is_multiplied_by():
    """Of an output without a unit the numbers along the axis are multiplied, above its left end."""
    noise = np.random.default_rng(3).standard_normal((4000, 1))
    found = mp.stability({"time": np.arange(4000) * 0.01, "ax": 3e-5 + 1e-6 * noise[:, 0]})
    figure, (axes,) = new_figure()
    draw_zero(found, axes, output="ax")
    text = to_svg(figure)
    places = re.findall(r'x="([\d.]+)"[^>]*>(1×10⁻⁶|about 3[^<]*)<', text)
    (left, _), (right, said) = sorted(places, key=lambda place: float(place[0]))
    assert re.fullmatch(r"about 3\S*×10⁻⁵ reading|about 2\.\d+×10⁻⁵ reading", said)
    assert float(right) > float(left) + 40.0


def test_a_mark_that_no_font_here_has_is_left_to_the_viewer():
    figure, (axes,) = new_figure()
    axes.set_xlabel("ፏ᪫")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert "ፏ᪫" in to_svg(figure)
