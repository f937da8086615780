"""NumPy is enough: commands run where nothing else is installed, and say what is missing."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import multipos as mp

LEFT_OUT = (
    "scipy",
    "casadi",
    "matplotlib",
    "jinja2",
    "markupsafe",
    "pandas",
    "pyarrow",
    "openpyxl",
    "xlrd",
)
PROGRAM = f"""
import contextlib, io, json, sys
sys.modules.update(dict.fromkeys({LEFT_OUT!r}))  # as if they were not installed
from multipos.cli import main
answers = []
for line in sys.stdin:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main(json.loads(line))
    answers.append([status, out.getvalue(), err.getvalue()])
print(json.dumps(answers))
"""
WORKING = [
    "fit run.csv -o cal.json",
    "fit run.csv --unknown-orientation --json",
    "fit run.csv --orientation-sd auto --json",
    "fit run.csv --robust huber --json",
    "fit run.csv --reading-sd 1e-4 --stepwise --model own-quadratic --json",
    "calibrate log.csv -o logged.json --to c --to px4 --allow-lossy",
    "average log.csv -o means.csv",
    "apply cal.json run.csv --uncertainty --tilt -o out.csv",
    "check cal.json run.csv --limit-g 0.01",
    "export cal.json --to c --fixed -o imu.c",
    "schemes --model own-quadratic",
    "design --model own-quadratic --positions 14",
    "design --include cal.json --positions 30",
    "simulate cal.json --scheme all-26 --seed 1 -o simulated.csv",
    "tumble run.csv --json",
    "compare cal.json again.json",
    "regress table.csv --response y --variables a,b --degree 2 --stepwise",
    "stability still.csv --json",
    "capture replay:log.csv:0 --headless",
    "fleet units.csv --unit-column unit -o fleet",
    "report cal.json -o report.md",
    "report cal.json -o report.txt",
    "demo -o demo",
]
MISSING = {
    "fit run.csv -o run.png": "pip install matplotlib",
    "report cal.json -o report.html": "pip install",
    "fit run.csv --model 'each = b + s*own/(1 + k*own^2)'": "pip install casadi",
}


def columns(seed):
    rng = np.random.default_rng(seed)
    up = mp.read_scheme("fibonacci-24").up
    values = up * [1.01, 0.99, 1.02] + [0.02, -0.01, 0.03] + 1e-4 * rng.standard_normal((24, 3))
    return dict(zip(("up_x", "up_y", "up_z", "ax", "ay", "az"), (*up.T, *values.T), strict=True))


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """Exit status, stdout and stderr of every command, all in one process without the libraries."""
    folder = tmp_path_factory.mktemp("small")
    rng = np.random.default_rng(3)
    mp.write_table(folder / "run.csv", columns(1))
    cal = mp.fit(columns(2))
    cal.save(folder / "again.json")
    log = mp.simulate_log(cal, "all-26", rate=50, rest=4, sample_sd=1e-3, seed=1)
    mp.write_table(folder / "log.csv", log)
    a, b = rng.normal(size=(2, 60))
    y = 1.0 + 2.0 * a - b**2 + 0.1 * rng.normal(size=60)
    mp.write_table(folder / "table.csv", {"a": a, "b": b, "y": y})
    still = {"time": np.arange(6000) / 50.0, "ax": 1e-3 * rng.normal(size=6000)}
    mp.write_table(folder / "still.csv", still)
    lots = [columns(seed) | {"unit": np.repeat(f"u{seed}", 24)} for seed in range(30)]
    table = {name: np.concatenate([one[name] for one in lots]) for name in lots[0]}
    mp.write_table(folder / "units.csv", table)
    asked = [*WORKING, *MISSING]
    import shlex

    done = subprocess.run(
        [sys.executable, "-W", "error::ImportWarning", "-c", PROGRAM],
        input="".join(json.dumps(shlex.split(each)) + "\n" for each in asked),
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    return dict(zip(asked, json.loads(done.stdout.splitlines()[-1]), strict=True)), folder


@pytest.mark.parametrize("command", WORKING)
def test_numpy_is_enough(command, answers):
    status, out, err = answers[0][command]
    assert status == 0, err
    assert "fault of multipos" not in err
    assert out or "-o" in command


def test_the_numbers_are_the_same(answers):
    small = json.loads(answers[0]["fit run.csv --unknown-orientation --json"][1])
    whole = mp.fit(mp.read_readings(answers[1] / "run.csv"), unknown_orientation=True)
    for entry, p in zip(small["parameters"], whole.entries, strict=True):
        assert entry["value"] == pytest.approx(p.value, abs=1e-9 * p.u)
        assert entry["U"] == pytest.approx(p.U, rel=1e-9)


def test_a_fleet_writes_what_it_can_and_says_what_is_left_out(answers):
    out = answers[0]["fleet units.csv --unit-column unit -o fleet"][1]
    assert "pip install jinja2 matplotlib" in out
    written = {path.name for path in Path(answers[1] / "fleet").iterdir()}
    assert {"calibrations.csv", "units.csv", "fleet.json", "report.md"} <= written


@pytest.mark.parametrize("command", MISSING)
def test_what_is_missing_is_said_in_one_line(command, answers):
    status, out, err = answers[0][command]
    assert (status, out) == (1, "")
    assert err.count("\n") == 1
    assert err.startswith("multipos: error: ")
    assert MISSING[command] in err


def test_without_matplotlib_a_view_says_so(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    found = mp.demo().calibration
    assert "pip install matplotlib" in found._repr_html_()
    with pytest.raises(mp.MultiposError, match="pip install matplotlib"):
        found.plot()
