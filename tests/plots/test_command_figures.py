"""Figures that commands write show what the results hold."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import multipos as mp
from multipos import plots
from multipos.cli import main
from multipos.designs.designing import smaller_designs


@pytest.fixture(scope="module")
def warmed():
    rng = np.random.default_rng(1)
    up = np.tile(mp.read_scheme("faces-6").up, (3, 1))
    T = np.repeat([-20.0, 20.0, 60.0], 6)
    columns = dict(zip(("up_x", "up_y", "up_z"), up.T, strict=True))
    columns |= {"ax": up[:, 0] + 1e-3 * T + 1e-5 * rng.standard_normal(18), "temperature": T}
    return columns


def test_a_fit_draws_residuals_and_what_changes_over_temperature(
    warmed, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    mp.write_table("warm.csv", warmed)
    model = "1 + x + y + z + temperature"
    assert main(["fit", "warm.csv", "--model", model, "--unit", "g", "-o", "fit.svg"]) == 0
    drawn = (tmp_path / "fit.svg").read_text()
    assert "bias_ax [mg]" in drawn
    assert "band, all temperatures" in drawn
    assert "scale_ax" not in drawn  # which does not change
    figure = plots.calibration_figure(mp.fit("warm.csv", model=model, unit="g"))
    assert len(figure.axes) == 2
    curve = figure.axes[1].lines[-1]
    assert_allclose(np.ptp(curve.get_ydata()), 0.08, rtol=1e-2)
    plain = plots.calibration_figure(mp.fit("warm.csv", unit="g"))
    assert len(plain.axes) == 1


def test_schemes_are_drawn_one_below_the_other(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    given = ["faces-6", "tumble-12", "--model", "own-quadratic", "-o", "s.svg"]
    assert main(["schemes", *given]) == 0
    drawn = (tmp_path / "s.svg").read_text()
    assert "faces-6: 6 positions, D-efficiency 1.000" in drawn
    assert "tumble-12: 12 positions, cannot separate the parameters" in drawn


def test_a_scheme_that_tells_nothing_has_positions_and_no_colours():
    _, (axes,) = plots.new_figure()
    plots.draw_scheme("tumble-12", axes)
    assert not axes.collections
    # twelve on the rim of both hemispheres, and the two rims
    assert len(axes.lines) == 2 * 12 + 2


def test_the_map_is_of_the_axes_that_are_sensed():
    # One output of two inputs has three parameters, told by four positions in a plane.
    _, (axes,) = plots.new_figure()
    plots.draw_scheme("roll-z-4", axes, sensed="x", inputs="x,y")
    assert len(axes.collections) == 2


def test_a_design_is_drawn_with_what_fewer_positions_would_do(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["design", "--positions", "6", "-o", "d.svg"]) == 0
    assert "efficiency per position" in (tmp_path / "d.svg").read_text()
    sizes = []

    def make(count):
        sizes.append(count)
        return mp.design("linear", count)

    found = smaller_designs(make, mp.design("linear", 6))
    assert [len(each.positions) for each in found] == [4, 5, 6]
    assert sizes == [5, 4, 3]  # three cannot tell four parameters, and end it
    figure = plots.design_figure(found)
    assert figure.axes[1].lines[0].get_xdata().tolist() == [4, 5, 6]
