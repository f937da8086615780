"""Numbers in every form of a report: units that people read, digits by u, no letters for powers."""

import re

import numpy as np
import pytest

import multipos as mp
from multipos.files.numbers import (
    chance,
    decimals_of,
    in_unit,
    p_in_words,
    plain_number,
    readable_unit,
    uncertain,
)
from multipos.plots.calibration import draw_size_residuals, residual_panels, size_residuals
from multipos.plots.style import name_axis, new_figure
from multipos.reports.certificate import build_content
from multipos.reports.documents import html_report, markdown_report, plain_report
from multipos.reports.quantities import column, with_u
from multipos.reports.readable import readable

pytestmark = pytest.mark.usefixtures("without_drawing")

ALL = mp.read_scheme("all-26").up


def fitted(*, noise=1e-4, up=ALL, unit="V", **options):
    """A triad in volts of 1.2 V/g, with a second order of 1 mV/g² on x."""
    rng = np.random.default_rng(7)
    values = [0.01, -0.02, 0.03] + 1.2 * up + noise * rng.standard_normal(up.shape)
    values[:, 0] += 1e-3 * up[:, 0] ** 2
    return mp.fit(mp.Readings(values, up=up), unit=unit, **{"model": "own-quadratic", **options})


@pytest.mark.parametrize(
    ("size", "unit", "factor", "shown"),
    [
        (0.02, "g", 1e3, "mg"),
        (3e-5, "g", 1e6, "µg"),
        (3e-9, "g", 1e6, "µg"),  # nobody reads ng
        (1.0, "g", 1.0, "g"),
        (2.0, "V/g", 1.0, "V/g"),
        (2e-3, "V/g^2", 1e3, "mV/g²"),
        (0.5, "mV", 1e3, "µV"),
        (0.5, "uV", 1e3, "nV"),
        (0.02, "g/degC", 1e3, "mg/°C"),
        (1e-3, "g/g", 1e6, "ppm"),
        (0.5, "g/g", 1.0, "1"),
        (1e-3, "g/g/degC", 1e6, "ppm/°C"),
        (1e-3, "g/g^2", 1e3, "mg/g²"),
        (1e-3, "1", 1e6, "ppm"),
        (1e-3, "rad", 1e3, "mrad"),
        (1e-3, "deg", 1.0, "°"),
        (1e-3, "m/s^2", 1e3, "mm/s²"),
        (1e-3, "m", 1.0, "m"),  # not of an acceleration
        (1e-3, "counts/g", 1.0, "counts/g"),
        (0.0, "g", 1.0, "g"),
        (float("nan"), "V", 1.0, "V"),
        (1e-3, "", 1.0, ""),
    ],
)
def test_units_that_people_read(size, unit, factor, shown):
    found, name = readable_unit(size, unit)
    assert (found, name) == (pytest.approx(factor, rel=1e-12), shown)


def test_numbers_by_hand():
    assert [plain_number(x) for x in (1.2345e-4, 0.0999999, 12345.6, 0.0, 1e-7, None)] == [
        "0.000123",
        "0.100",
        "12346",
        "0",
        "1.00e-07",
        "-",
    ]
    assert [chance(p) for p in (0.0, 3e-12, 9.99e-7, 2.3e-6, 0.00042)] == [
        *["< 1e-6"] * 3,
        "0.000002",
        "0.00042",
    ]
    assert [chance(p) for p in (0.05, 1.0, float("nan"))] == ["0.050", "1.0", "-"]
    assert (p_in_words(1e-9), p_in_words(0.25)) == ("p < 1e-6", "p = 0.25")
    assert [decimals_of(u) for u in (0.052, 5.2, 52.0, 0.0996, 0.0, float("inf"))] == [
        3,
        1,
        0,
        2,
        None,
        None,
    ]
    assert in_unit(2e-3, "g") == "2 mg"
    assert with_u(-0.0202347, 1.7e-4, 3.5e-4, "g") == ("-20.23", "0.17", "0.35", "mg")
    assert with_u(0.5, float("nan"), float("nan"), "V") == ("500", "-", "-", "mV")
    assert column([1e-4, -2e-4, 1e-9], "V", 1.3e-5, signed=True) == (
        "µV",
        ["+100", "-200", "0"],
    )


@pytest.mark.parametrize(
    "options",
    [{}, {"model": "linear", "unknown_orientation": True}, {"model": "linear", "unit": "count"}],
    ids=["volts", "unknown", "counts"],
)
def test_no_form_has_a_number_in_letters(options):
    content = build_content(fitted(**options))
    page = re.sub(
        r"<svg.*?</svg>|<style>.*?</style>|<[^>]*>", " ", html_report(content), flags=re.DOTALL
    )
    for text in (page, markdown_report(content), plain_report(content)):
        kept = re.sub(r"(?:<|&lt;) 1e-6", "", text)
        said = re.sub(r"\S*sha\S*|\d{4}-\d\d-\d\dT\S+", "", kept, flags=re.IGNORECASE)
        assert re.findall(r"\d[eE][-+]\d+", said) == []
        assert re.findall(r"(?<![\w.])(?:inf|nan)(?![\w.])", said) == []
        assert re.findall(r"/g\^\d|degC|\[deg\]", said) == []
        assert "°" in said


def test_plain_text_is_aligned_at_the_point():
    text = plain_report(build_content(fitted()))
    rows = text.partition("Parameters with uncertainty\n")[2].splitlines()[1:6]
    points = {row.index(re.search(r"\d\.\d", row)[0]) for row in rows if row.startswith("scale")}
    assert len(points) == 1
    assert rows[0].startswith("bias_ax")
    assert " mV " in rows[0]


def test_a_position_of_unknown_orientation_has_one_number():
    """An outer route: compensated readings are of size 1 g but for it, and its squares add up."""
    cal = fitted(model="linear", unknown_orientation=True)
    error, sd = size_residuals(cal)
    force = cal.compensate(cal.readings.values)
    off = np.linalg.norm(force, axis=1) - 1.0
    assert error == pytest.approx(off, abs=1e-6)  # of second order in errors of some 3e-4
    leverage = cal.diagnostics.leverage.sum(axis=1)
    assert leverage.sum() == pytest.approx(9.0, rel=1e-6)  # its parameters
    plain = error / (sd / np.sqrt(1.0 - leverage))
    assert np.sum(plain**2) == pytest.approx(26 - 9, rel=1e-4)  # of which s was taken
    assert len(residual_panels(cal)) == 1
    assert len(residual_panels(fitted())) == 3
    _, (axes,) = new_figure()
    draw_size_residuals(cal, axes)
    series = next(line for line in axes.lines if line.get_label() == "size of the force")
    assert series.get_ydata() == pytest.approx(error)
    assert axes.get_ylabel() == "size of the force [µg]"


def test_an_axis_has_the_unit_that_its_numbers_are_read_in():
    figure, (axes,) = new_figure()
    axes.plot([0.0, 1.0], [-0.0002, 0.0003])
    name_axis(axes.yaxis, "ax", "V/g^2")
    figure.canvas.draw()
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert axes.get_ylabel() == "ax [µV/g²]"
    assert {"−200", "0", "200"} <= set(labels)
    axes.set_ylim(0.0, 0.025)
    axes.set_yticks([0.0, 0.0125, 0.025])
    assert axes.yaxis.get_major_formatter().format_ticks([0.0, 12.5e-6, 25e-6]) == [
        "0.0",
        "12.5",
        "25.0",
    ]
    assert axes.yaxis.get_major_formatter().format_ticks([0.0, 3e70]) == ["0", "3e+76"]


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("-0", "0"),
        ("-0.0000(45)", "0.0000(45)"),
        ("[-0.00, -0.05]", "[0.00, −0.05]"),
        ("-0.0500", "−0.0500"),
        ("bias_ax -1.4, a-0", "bias_ax −1.4, a-0"),
    ],
)
def test_what_rounds_to_zero_has_no_sign(text, shown):
    assert readable(text) == shown


def test_an_uncertainty_without_two_digits_of_its_own_is_not_shown():
    """Below 2.2e-308 a float has fewer bits; above, value and u are shown with an exponent."""
    assert uncertain(3e-308, 2.5e-308) == "3.0(25)e-308"
    assert uncertain(5e-324, 5e-324) == "4.940656458e-324"
    assert uncertain(1.0, 1e-310) == "1"
