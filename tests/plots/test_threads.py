"""Figures are the same from any thread and under any settings, and change no setting."""

import threading
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import matplotlib
import matplotlib.style
import numpy as np
import pytest
from amounts import rest_slow

import multipos as mp
from multipos import plots
from multipos.reports.certificate import build_content
from multipos.reports.documents import html_report

# What people set, and what would show; `text.usetex` needs programs that may not be there.
SETTINGS = {
    "fonts": {
        "font.size": 20.0,
        "font.family": ["serif"],
        "font.weight": "bold",
        "font.style": "italic",
        "text.usetex": True,
        "text.color": "red",
        "axes.unicode_minus": False,
        "mathtext.fontset": "stix",
        "axes.labelsize": 30.0,
        "axes.labelcolor": "red",
        "axes.labelpad": 20.0,
        "axes.titlesize": 30.0,
        "axes.titlecolor": "red",
        "legend.fontsize": 20.0,
        "xtick.labelsize": 3.0,
        "ytick.labelsize": 3.0,
    },
    "axes": {
        "axes.grid": True,
        "axes.spines.top": True,
        "axes.spines.left": False,
        "axes.edgecolor": "red",
        "axes.linewidth": 5.0,
        "axes.facecolor": "yellow",
        "axes.xmargin": 0.3,
        "axes.ymargin": 0.3,
        "axes.axisbelow": True,
        "axes.formatter.limits": [-1, 1],
        "axes.formatter.use_mathtext": True,
        "xtick.direction": "in",
        "ytick.direction": "in",
        "xtick.top": True,
        "ytick.right": True,
        "xtick.color": "red",
        "ytick.color": "red",
        "xtick.minor.visible": True,
        "ytick.minor.visible": True,
        "xtick.major.size": 10.0,
        "ytick.major.pad": 10.0,
        "ytick.minor.size": 9.0,
    },
    "lines": {
        "lines.linewidth": 7.0,
        "lines.markersize": 20.0,
        "lines.markeredgewidth": 5.0,
        "lines.color": "red",
        "lines.solid_capstyle": "round",
        "patch.linewidth": 6.0,
        "patch.edgecolor": "red",
        "patch.force_edgecolor": True,
        "hatch.linewidth": 5.0,
        "legend.frameon": True,
        "legend.loc": "upper left",
        "legend.handlelength": 9.0,
        "errorbar.capsize": 9.0,
        "path.simplify": False,
        "axes.prop_cycle": matplotlib.cycler(color=["red"], linewidth=[5.0]),
    },
    "files": {
        "figure.figsize": [3.0, 3.0],
        "figure.dpi": 33.0,
        "figure.facecolor": "red",
        "figure.autolayout": True,
        "savefig.facecolor": "red",
        "savefig.dpi": 33.0,
        "savefig.bbox": "tight",
        "savefig.format": "pdf",
        "svg.fonttype": "path",
        "svg.hashsalt": "another",
    },
}
ENDINGS = (".svg", ".png")
# All at once shows in as many places as each part of them would.
AT_ONCE = {key: value for settings in SETTINGS.values() for key, value in settings.items()}
STYLES = ("dark_background", "fivethirtyeight", "seaborn-v0_8", "fast")


@cache
def results():
    rng = np.random.default_rng(1)

    def run():
        up = mp.read_scheme("roll-z-12").up[:, :1]
        return mp.Readings(1.01 * up + 1e-3 * rng.standard_normal(up.shape), unit="g")

    how = {"scheme": "roll-z-12", "inputs": "x,y", "budget": {"gain": {"u": 1e-3}}}
    runs = [mp.fit(run(), **how) for _ in range(2)]
    # With errors far beyond the limit, which are drawn logarithmically.
    check = mp.check(runs[0], run(), scheme="roll-z-12", limit_g=2e-3, nominal=(0.1, 1.0))
    t = np.linspace(-40.0, 80.0, 40)
    data = {"t": t, "y": 0.3 + 0.02 * t + 0.01 * rng.standard_normal(40)}
    rest = mp.stability({"ax": rng.standard_normal(500)}, rate=10.0, unit="g")
    return runs, check, rest, mp.regress(data, response="y", variables="t", stepwise=True), data


def draw(endings=ENDINGS):
    """Return every kind of figure, and where they are drawn as pixels too, a report."""
    runs, check, rest, regression, data = results()
    page = html_report(build_content(runs[0], check=check)) if endings == ENDINGS else ""
    figures = (
        plots.runs_figure(mp.compare(runs)),
        plots.regression_figure(regression, data),
        plots.check_figure(check),
        plots.stability_figure(rest),
    )
    return page, *(plots.render(figure, ending) for figure in figures for ending in endings)


@cache
def drawn(endings=ENDINGS):
    return draw(endings)


@pytest.mark.slow
def test_reports_from_four_threads_are_those_from_one_and_no_setting_changes():
    alone, before = drawn(), dict(matplotlib.rcParams)
    seen, done = [], threading.Event()

    def watch():
        while not done.wait(1e-3):  # without a pause it takes half of the time of those who draw
            seen.append(dict(matplotlib.rcParams) == before)

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        with ThreadPoolExecutor(4) as pool:
            for found in pool.map(lambda _: draw(), range(4)):
                assert found == alone
    finally:
        done.set()
        watcher.join()
    assert dict(matplotlib.rcParams) == before
    assert len(seen) > 10
    assert all(seen)


@pytest.mark.parametrize(
    ("settings", "endings"),
    rest_slow(
        [
            (AT_ONCE, ENDINGS[:1]),
            (AT_ONCE, ENDINGS),
            *((matplotlib.style.library[name], ENDINGS[:1]) for name in STYLES),
        ]
    ),
    ids=["at once, lines alone", "at once", *STYLES],
)
def test_settings_of_the_program_around_change_no_figure(settings, endings):
    alone = drawn(endings)
    with matplotlib.rc_context(settings):
        found = draw(endings)
    for one, other in zip(found, alone, strict=True):
        assert one == other


def test_powers_of_ten_are_written_with_signs_and_digits():
    figure, (axes,) = plots.new_figure()
    axes.plot([1.0, 2.0], [-0.2, 3e-3])
    plots.style.scale_by_powers(axes, "y", linthresh=1e-3)
    svg = plots.to_svg(figure)
    for label in ("−10⁻¹", "−10⁻²", "−10⁻³", "0", "10⁻³"):
        assert f">{label}</text>" in svg
    figure, (axes,) = plots.new_figure()
    axes.plot([1.0, 2.0], [2.0, 5.0])
    plots.style.scale_by_powers(axes, "y")
    assert ">3×10⁰</text>" in plots.to_svg(figure)


def test_a_figure_is_left_as_it_was():
    figure, (axes,) = plots.new_figure()
    axes.plot([1.0, 2.0], [1.0, 2.0], label="$not^mathematics$")
    plots.style.name_series(axes, 1)
    canvas, dpi, colour = figure.canvas, figure.dpi, axes.get_facecolor()
    assert ">$not^mathematics$</text>" in plots.to_svg(figure)
    assert (figure.canvas, figure.dpi, axes.get_facecolor()) == (canvas, dpi, colour)
