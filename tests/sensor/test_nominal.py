"""The nominal conversion, that reports and checks compare a calibration with."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import multipos as mp
from multipos.cli import main
from multipos.errors import UsageError
from multipos.plots import nominal_error

UP = mp.read_scheme("faces-6").up


def volts():
    noise = 1e-5 * np.random.default_rng(1).standard_normal((6, 3))
    return mp.Readings(2.5 + UP * [1.01, 0.99, 1.0] + [0.01, 0, 0] + noise, up=UP, unit="V")


def test_error_before_is_that_of_the_nominal_conversion(tmp_path):
    # eq. (1) of sensor.nominal
    cal = mp.fit(volts(), nominal=(2.5, 1.0))
    # x up and down: 0.01 g of bias and of scale; z nothing but the bias of x
    assert_allclose(nominal_error(cal)[:2], [0.02, 0.0], atol=5e-5)
    assert_allclose(nominal_error(cal)[4:], 0.01, atol=5e-5)
    cal.save(tmp_path / "cal.json")
    again = mp.load(tmp_path / "cal.json")
    assert again.nominal == (2.5, 1.0)
    run = mp.check(again, volts())
    assert (run.bias, run.scale) == (2.5, 1.0)
    assert (mp.check(again, volts(), nominal=(0.0, 1.0)).bias) == 0.0
    assert (mp.check(mp.fit(volts()), volts()).bias) == 0.0


def test_fit_and_report_take_it(tmp_path, capsys):
    rows = ["ax,ay,az", *(",".join(map(repr, row)) for row in volts().values.tolist())]
    path = tmp_path / "r.csv"
    path.write_text("\n".join(rows) + "\n")
    cal, page = str(tmp_path / "cal.json"), tmp_path / "page.md"
    fit = ["fit", str(path), "--scheme", "faces-6", "--unit", "V", "-o", cal]
    assert main([*fit, "--nominal", "2.5,1"]) == 0
    assert " before, " in capsys.readouterr().out.splitlines()[0]  # by that conversion
    assert main(["report", cal, "-o", str(page)]) == 0
    assert "Before: (reading − 2.5)/1, the nominal conversion" in page.read_text()
    assert main(["report", cal, "--nominal", "2.4,1.1", "-o", str(page)]) == 0
    assert "(reading − 2.4)/1.1" in page.read_text()
    capsys.readouterr()
    assert main([*fit, "--nominal", "2.5,0"]) == 2
    assert "--nominal takes BIAS,SCALE" in capsys.readouterr().err
    with pytest.raises(UsageError):
        mp.fit(volts(), nominal=(1.0,))
