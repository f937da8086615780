"""Uncertain and unknown orientations on the command line: options, columns, and bad input."""

import json
import warnings

import numpy as np
import pytest
from cli_bench import run
from numpy.testing import assert_allclose
from orientation_bench import Sensor, readings_of

import multipos as mp
from multipos.positions.scheme import read_scheme

UP = read_scheme("fibonacci-24").up
LISTED = ("--scheme", "fibonacci-24")


def table(up=UP, *, sd=1e-5, off_deg=0.01, columns=None):
    """Return a readings file; `columns` maps names to n cells of text."""
    values = readings_of(Sensor(), up, np.random.default_rng(3), sd=sd, off_deg=off_deg).values
    cells = {f"a{axis}": [repr(v) for v in values[:, i].tolist()] for i, axis in enumerate("xyz")}
    cells |= columns or {}
    rows = zip(*cells.values(), strict=True)
    return "\n".join([",".join(cells), *(",".join(row) for row in rows)]) + "\n"


def ups(up=UP):
    return {f"up_{axis}": [repr(v) for v in up[:, i].tolist()] for i, axis in enumerate("xyz")}


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def fitted(capsys, *options):
    status, out, err = run(capsys, "fit", "r.csv", *options, "--json")
    assert status == 0, err
    return json.loads(out), err


@pytest.mark.parametrize(
    ("options", "estimator", "gauge", "parameters"),
    [
        (("--unknown-orientation",), "unknown-orientation", "lower", 9),
        (("--unknown-orientation", "--gauge", "symmetric"), "unknown-orientation", "symmetric", 9),
        (("--unknown-orientation", "--model", "own-cubic"), "unknown-orientation", "lower", 15),
        (LISTED, "uncertain-orientation", None, 12),
        ((*LISTED, "--orientation-sd", "0"), "linear", None, 12),
        ((*LISTED, "--orientation-sd", "0.01"), "uncertain-orientation", None, 12),
        ((*LISTED, "--orientation-sd", "auto"), "uncertain-orientation", None, 12),
        ((*LISTED, "--robust", "huber"), "linear", None, 12),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else None,
)
def test_options_choose_the_estimator(options, estimator, gauge, parameters, here, capsys):
    (here / "r.csv").write_text(table())
    found, _ = fitted(capsys, *options)
    assert found["estimator"] == estimator
    assert found["gauge"] == gauge
    assert len(found["parameters"]) == parameters
    assert len(found["covariance"]) == parameters
    assert found["status"]["converged"]
    if estimator == "unknown-orientation":
        assert found["dof"]["ax"] == 24 - parameters
        assert found["cross_check"] is None


def test_a_column_chooses_the_uncertain_estimator(here, capsys):
    sd = ["0.01"] * 20 + ["0", "0", "", ""]
    cells = ups()
    for name in cells:
        cells[name][22] = cells[name][23] = ""
    (here / "r.csv").write_text(table(off_deg=0.0, columns=cells | {"orientation_sd_deg": sd}))
    found, _ = fitted(capsys, "--reading-sd", "1e-5")
    assert found["estimator"] == "uncertain-orientation"
    size = found["orientation_sd_deg"][0]
    assert 0.0 < size < 0.005  # the likely 0.01 of positions that are exact
    assert found["orientation_sd_deg"] == pytest.approx([size] * 20 + [0, 0, None, None])
    spread = found["variance_components"]["orientation_sd_deg"]
    assert spread["source"] == "stated"
    assert spread["value"] == pytest.approx(size)
    assert spread["high"] < 0.01
    assert found["orientation_error_deg"][22:] == [None, None]
    ignored, _ = fitted(capsys, "--reading-sd", "1e-5", "--unknown-orientation")
    assert ignored["estimator"] == "unknown-orientation"
    assert any("ignored" in text for text in map(str, ignored["diagnostics"]["findings"]))


def test_a_group_in_the_file(here, capsys):
    (here / "r.csv").write_text(table(off_deg=0.0, columns=ups() | {"group": ["cube"] * 24}))
    found, _ = fitted(capsys)
    assert found["gauge"] == "lower"
    assert np.abs(found["group_rotation_deg"]["cube"]).max() < 5.0


def test_the_options_that_have_no_effect_are_said(here, capsys):
    (here / "r.csv").write_text(table(columns=ups()))
    _, _, err = run(capsys, "fit", "r.csv", "--gauge", "symmetric")
    assert "--gauge symmetric has no effect" in err
    options = ("--unknown-orientation", "--scheme", "fibonacci-24")
    _, _, err = run(capsys, "fit", "r.csv", *options)
    assert "orientation columns are ignored" in err
    assert "--scheme is ignored" in err


def test_the_file_of_a_calibration_comes_back_whole(here, capsys):
    (here / "r.csv").write_text(table(columns=ups()))
    assert run(capsys, "fit", "r.csv", "--orientation-sd", "auto", "-o", "cal.json")[0] == 0
    loaded = mp.load("cal.json")
    again = loaded.to_dict()
    written = json.loads((here / "cal.json").read_text())
    # Degrees become radians and degrees again, each time rounded.
    degrees = again.pop("orientation_sd_deg"), written.pop("orientation_sd_deg")
    assert_allclose(*degrees, rtol=4 * np.finfo(float).eps)
    assert json.loads(json.dumps(again)) == written


BAD = {
    "few unknown": (
        table(UP[:6]),
        ("--unknown-orientation",),
        1,
        "6 positions give 6 equations for 9 parameters",
    ),
    "few uncertain": (
        table(UP[:3], columns=ups(UP[:3])),
        ("--orientation-sd", "0.1"),
        1,
        "3 positions give 9 equations for 12 parameters; add positions",
    ),
    "one circle": (
        table(read_scheme("roll-x-24").up, off_deg=0.0),
        ("--unknown-orientation",),
        1,
        "all positions lie on one circle, so the readings are flat; add positions off it.",
    ),
    "one circle, uncertain": (
        table(read_scheme("roll-x-24").up),
        ("--scheme", "roll-x-24", "--orientation-sd", "0.1"),
        1,
        "3 of 4 parameters can be separated: `scale_ax` has no effect",
    ),
    "identical": (
        table(np.tile(UP[:1], (24, 1)), off_deg=0.0),
        ("--unknown-orientation",),
        1,
        "Turn the sensor to different positions",
    ),
    "zero": (
        "ax,ay,az\n" + "0,0,0\n" * 24,
        ("--unknown-orientation",),
        1,
        "the readings of ax never change; turn the sensor",
    ),
    "no rows": ("ax,ay,az\n", ("--unknown-orientation",), 1, "r.csv"),
    "two outputs": (
        table(),
        ("--unknown-orientation", "--outputs", "ax,ay"),
        1,
        "unknown orientations and open rolls need three outputs, one along each axis; got ax, ay ",
    ),
    "no orientation": (table(), ("--orientation-sd", "0.1"), 1, "no orientation; give --scheme"),
    "negative sd in the file": (
        table(columns=ups() | {"orientation_sd_deg": ["-1"] * 24}),
        (),
        1,
        "'orientation_sd_deg': -1 is not 0 or more",
    ),
    "zero u in the file": (
        table(columns=ups() | {f"u_a{axis}": ["0"] * 24 for axis in "xyz"}),
        ("--unknown-orientation",),
        1,
        "column 'u_ax': 0 is not above 0",
    ),
    "closed form and uncertain": (
        table(columns=ups() | {"orientation_sd_deg": ["0.1"] * 24}),
        ("--closed-form",),
        1,
        "--closed-form takes exact orientations",
    ),
    "negative orientation sd": (
        table(),
        ("--orientation-sd", "-0.1"),
        2,
        "between 0 and 180 degrees, got -0.1",
    ),
    "half a turn": (table(), ("--orientation-sd", "180"), 2, "between 0 and 180 degrees"),
    "no number": (table(), ("--orientation-sd", "small"), 2, "--orientation-sd"),
    "nan": (table(), ("--orientation-sd", "nan"), 2, "between 0 and 180 degrees, got nan"),
    "zero reading sd": (table(), ("--unknown-orientation", "--reading-sd", "0"), 2, "above 0"),
    "two reading sds": (
        table(),
        ("--unknown-orientation", "--reading-sd", "1,2"),
        2,
        "takes 1 or 3 values, got 2",
    ),
    "negative level": (table(), ("--level-sd", "-1"), 2, "--level-sd must lie between 0 and 90"),
    "unknown and uncertain": (
        table(),
        ("--unknown-orientation", "--orientation-sd", "1"),
        2,
        "--unknown-orientation and --orientation-sd contradict each other; give one.",
    ),
    "unknown and level": (
        table(),
        ("--unknown-orientation", "--level-sd", "1"),
        2,
        "contradict each other",
    ),
    "closed form and unknown": (
        table(),
        ("--closed-form", "--unknown-orientation"),
        2,
        "contradict each other",
    ),
    "closed form and robust": (
        table(),
        ("--closed-form", "--robust", "huber"),
        2,
        "contradict each other",
    ),
    "robust and auto": (
        table(),
        ("--orientation-sd", "auto", "--robust", "huber"),
        2,
        "cannot be estimated from the same",
    ),
    "gauge": (table(), ("--unknown-orientation", "--gauge", "upper"), 2, "unknown gauge 'upper'"),
    "loss": (table(), ("--robust", "tukey"), 2, "--robust takes huber, soft-l1, cauchy"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_gets_one_line(name, here, capsys):
    content, options, status, message = BAD[name]
    (here / "r.csv").write_text(content)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ended, out, err = run(capsys, "fit", "r.csv", *options, "--json", "-o", "cal.json")
    assert (ended, out) == (status, "")
    last = err.strip().splitlines()[-1]
    assert last.startswith("multipos: error: ")
    assert message in last
    assert not (here / "cal.json").exists()
    if status == 1:
        assert len(err.strip().splitlines()) == 1
