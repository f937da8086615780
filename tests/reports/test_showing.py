"""Results that show themselves: HTML of every type, figures, tables and correlated numbers."""

import re
import sys
from html.parser import HTMLParser

import numpy as np
import pytest
from amounts import slow_where
from matplotlib.figure import Figure
from numpy.testing import assert_allclose
from test_results import RESULTS, calibrated, checked, result_of, sensor, tumbled, tumbled_all

import multipos as mp
from multipos.files.numbers import in_unit
from multipos.results import Columns, Drawn, Result

VOID = {"meta", "link", "br", "img", "input", "use", "path", "rect"}


class Balanced(HTMLParser):
    """Asserts that every element that opens closes, and collects what a reader sees."""

    def __init__(self):
        super().__init__()
        self.open, self.words, self.ids = [], [], []

    def handle_starttag(self, tag, attrs):
        assert tag not in ("script", "style", "link") or "svg" in self.open
        self.ids += [value for name, value in attrs if name == "id"]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def seen(found):
    return words_of(found._repr_html_())


def words_of(html):
    """Return what a reader sees of a page whose elements are closed and whose names are unique."""
    page = Balanced()
    page.feed(html)
    page.close()
    assert page.open == []
    assert len(set(page.ids)) == len(page.ids)
    return " ".join(page.words)


# Their kinds are among the quick ones, or they take seconds to make.
LONG = {"Calibration, robust", "Calibration with uncertain orientations", "Tumbles", "Curves"}


@pytest.mark.usefixtures("without_drawing")
@pytest.mark.parametrize("name", slow_where(LONG.__contains__, RESULTS))
def test_every_result_shows_itself_in_a_notebook_and_in_print(name):
    found = result_of(name)
    for one in found if isinstance(found, tuple) else [found]:
        assert isinstance(one, Result | Columns)
        html = one._repr_html_()
        assert words_of(html)
        assert len(html) < 250_000
        assert str(one)


def test_what_no_command_prints_is_a_line_a_field():
    scheme = mp.read_scheme("all-26")
    lines = str(scheme).splitlines()
    assert lines[0] == "Scheme"
    assert lines[1].split() == ["name", "all-26"]
    assert lines[2].split(maxsplit=1) == ["up", "array 26 × 3"]
    assert len(lines) == 1 + len(scheme.__dataclass_fields__)
    assert str(mp.demo()).startswith("Table 2 of Song and Qin (2009)")


@pytest.mark.usefixtures("without_drawing")
def test_doubts_come_first_and_nothing_is_markup():
    up = np.tile(mp.read_scheme("faces-6").up, (2, 1))
    names = ("<b>x", "<b>y", "<b>z")
    cal = mp.fit(mp.Readings(up * [1.0, 0.0, 1.0] + 1e-3, outputs=names, up=up, unit="g"))
    words = seen(cal)
    finding = cal.diagnostics.findings[0].text[:20]
    assert words.index("Not fit for use") < words.index(finding) < words.index("bias_")
    assert "<b>" not in cal._repr_html_()
    assert seen(checked()).startswith("Check")


@pytest.mark.usefixtures("without_drawing")
def test_a_calibration_shows_parameters_rms_and_one_figure():
    found = calibrated()
    html = found._repr_html_()
    words = words_of(html)
    assert all(name in words for name in found.names)
    assert re.search(f"rms error .*{in_unit(found.rms, 'g')}", words)
    table = {row[0]: row for row in re.findall(r"(\w+_\w+) (\S+) (\S+) (\S+) (\S+)", words)}
    _, value, _, U, unit = table["bias_ax"]
    factor = {"mg": 1e3, "µg": 1e6}[unit]
    assert float(value) == pytest.approx(factor * found["bias_ax"].value, abs=0.02 * float(U))
    assert float(U) == pytest.approx(factor * found["bias_ax"].U, rel=0.05)
    assert f"largest error {in_unit(np.abs(checked().after).max(), 'g')}" in seen(checked())
    assert " parameters agree with the first" in seen(mp.compare(calibrated(1), calibrated(2)))
    assert html.count("<svg") == 1


@pytest.mark.parametrize(
    ("make", "panels"), [(calibrated, 1), (checked, 3), (tumbled, 2), (tumbled_all, 2)]
)
def test_plot_returns_the_axes_and_draws_on_given_ones(make, panels):
    found = make()
    axes = found.plot()
    assert isinstance(found, Drawn)
    assert len(axes if panels > 1 else [axes]) == panels
    own = Figure().subplots(panels, 1)
    again = found.plot(own)
    assert (list(own) == again) if panels > 1 else (own is again)
    assert all(one.lines or one.patches for one in np.atleast_1d(again))
    with pytest.raises(mp.UsageError, match=rf"`ax` must be {panels} axes, a panel each, got 7"):
        found.plot([None] * 7)


def test_tables_are_data_frames():
    frame = calibrated().to_pandas()
    assert frame["name"].tolist() == list(calibrated().names)
    assert_allclose(frame["U"], calibrated().U)
    errors = checked().to_pandas()
    assert len(errors) == 14 * 3
    assert errors["axis"].tolist()[:3] == ["x", "y", "z"]
    assert_allclose(errors["after"].to_numpy().reshape(-1, 3), checked().after)
    runs = mp.compare(calibrated(1), calibrated(2)).to_pandas()
    assert_allclose(runs["run 2"], calibrated(2).parameters)
    assert_allclose(runs["mean"], (runs["run 1"] + runs["run 2"]) / 2)
    coefficients = tumbled().to_pandas()
    assert coefficients["name"].tolist() == list(tumbled().coefficients)
    assert coefficients["value"].tolist() == [c.value for c in tumbled().coefficients.values()]


def test_terms_of_a_regression_are_a_data_frame():
    """y = 2 + 3 x below 0, 5 - x from there, without noise."""
    x = np.array([-4.0, -3.0, -2.0, -1.0, 1.0, 2.0, 3.0, 4.0])
    y = np.where(x < 0.0, 2.0 + 3.0 * x, 5.0 - x) + 1e-9 * np.array([1, -2, 1, 0, 0, 1, -2, 1])
    found = mp.regress({"x": x, "y": y}, response="y", variables="x", segment="x:0", free=True)
    frame = found.to_pandas()
    assert frame["segment"].tolist() == [1, 1, 2, 2]
    assert frame["term"].tolist() == ["1", "x", "1", "x"]
    assert_allclose(frame["value"], [2.0, 3.0, 5.0, -1.0], atol=1e-7)
    assert frame["u"].tolist() == [c.u for s in found.segments for c in s.coefficients]


def test_ufloats_carry_the_covariance():
    pytest.importorskip("uncertainties")
    cal = calibrated()
    numbers = cal.to_ufloats()
    ratio = numbers["bias_ax"] / numbers["scale_ax"]
    i, j = cal.names.index("bias_ax"), cal.names.index("scale_ax")
    b, s = cal.parameters[i], cal.parameters[j]
    slope = np.array([1.0 / s, -b / s**2])
    variance = slope @ cal.covariance[np.ix_([i, j], [i, j])] @ slope
    assert_allclose([ratio.nominal_value, ratio.std_dev], [b / s, np.sqrt(variance)], rtol=1e-9)


def test_without_the_package_ufloats_name_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "uncertainties", None)
    with pytest.raises(mp.MultiposError, match="needs the package uncertainties"):
        sensor().to_ufloats()
