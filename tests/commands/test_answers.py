"""The first line of every command is its answer, and no result is longer than a screen."""

import re

import numpy as np
import pytest
from amounts import rest_slow
from cli_bench import make_once, run
from fleet_bench import line

import multipos as mp

SENSITIVITY = np.array([[1.2, 0.004, -0.002], [0.001, 1.21, 0.003], [-0.002, 0.001, 1.19]])
NINE = "1 + x + y + z + x^2 + y^2 + x*y + x*z + y*z"  # 27 parameters of three outputs
FIT = r"ax, ay, az calibrated from 24 positions: rms error \S+ \S+; U \(95 %\) up to .*warning.*"


def readings(seed, sd=1e-4, **spoilt):
    """24 positions in volts; `spoilt` are rows with the factor of their readings."""
    rng = np.random.default_rng(seed)
    up = mp.read_scheme("fibonacci-24").up
    values = [0.01, -0.02, 0.025] + up @ SENSITIVITY.T + sd * rng.standard_normal(up.shape)
    for row, factor in spoilt.items():
        values[int(row.removeprefix("row"))] *= factor
    columns = {f"up_{axis}": up[:, i] for i, axis in enumerate("xyz")}
    return {**columns, **{f"a{axis}": values[:, i] for i, axis in enumerate("xyz")}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    here = tmp_path_factory.mktemp("answers")
    tables = {"a": readings(1), "b": readings(9), "off": readings(3, row7=1.05)}
    rng = np.random.default_rng(2)
    t = np.linspace(-20.0, 60.0, 300)
    tables["rows"] = {"t": t, "y": 0.3 + 0.01 * t + 0.01 * rng.standard_normal(300)}
    angles = np.tile(np.arange(0.0, 360.0, 15.0), 2)
    force = np.cos(np.radians(angles))
    tables["roll"] = {
        "roll_axis": np.repeat(["z", "y"], 24),
        "angle_deg": angles,
        "ax": 0.01 + 1.2 * force + 2e-3 * force**2 + 1e-4 * rng.standard_normal(48),
    }
    still = 1e-3 * rng.standard_normal((3000, 3)) + [0.0, 0.0, 1.0]
    outputs = dict(zip(("ax", "ay", "az"), still.T, strict=True))
    tables["still"] = {"time": np.arange(3000) / 50.0, **outputs}
    tables["line"] = line(16, stations=2, noise=2e-4)
    for name in ("a", "b"):
        mp.write_table(here / f"{name}.csv", tables[name])
        mp.fit(here / f"{name}.csv", unit="V").save(here / f"{name}.json")
    log = {"rate": 50.0, "rest": 3.0, "turn": 1.0, "sample_sd": 1e-3, "seed": 1}
    tables["log"] = mp.simulate_log(mp.load(here / "a.json"), "fibonacci-24", **log)
    for name, table in tables.items():
        mp.write_table(here / f"{name}.csv", table)
    mp.export(mp.load(here / "a.json"), "c").save(here / "a.c")
    return here


ANSWERS = {
    "fit a.csv --unit V": FIT,
    f"fit a.csv --unit V --model={NINE}": FIT,
    "fit off.csv --unit V": FIT.replace("24 positions", "23 of 24 positions"),
    "fit off.csv --unit V --exclude none": f"Not fit for use: {FIT.replace('warning', 'error')}",
    "calibrate log.csv --scheme fibonacci-24 -o k.json": FIT,
    "average log.csv": r"24 rests of log.csv averaged; u up to .*",
    "apply a.json b.csv -o f.csv": r"24 rows compensated, 0 of them outside .*",
    "check a.json b.csv": r"Errors of .* rms, largest error .* the run (dis)?agrees with the .*",
    "check a.json b.csv --limit-g 0.01": r"Pass: largest error .* against a limit of 10 mg\.",
    "check a.json b.csv --limit-g 1e-5": r"Fail: largest error .* against a limit of 10 µg\.",
    "check a.json b.csv --tilt --limit-deg 1": r"Pass: largest error .*° .* a limit of 1°\.",
    "compare a.json b.json": r"\d+ of 12 parameters agree with .*largest E_n .*",
    "export a.json --to c -o k.c": r"Written to k\.c, k_test\.c\.",
    "export a.json --to ros-imu-calib -o k.yaml": r"Written .* It differs from .*",
    "stability still.csv": r"ax, ay, az over 1 record: white noise up to .*",
    "regress rows.csv --response y --variables t": r"y by t: R² 0\.99\d+, residual sd .*",
    "tumble roll.csv": r"ax: K1 = 1\.2\S+ reading/g, K0 = .*",
    "design --include a.json --positions 26": r"26 positions .*; 2 more lower u by .* %\.",
    "design --positions 12": r"12 positions reach [\d.]+ % of the best D efficiency .*",
    "design --positions 24 --model cross-quadratic": r"24 positions reach .*",
    "schemes": r"Best of \d+ schemes for linear: .*",
    "schemes faces-6 --model own-quadratic": r"faces-6: .*",
    "simulate a.json --scheme fibonacci-24 -o s.csv": r"24 readings simulated\.",
    "fleet line.csv --unit-column unit -o line": r"Yield .* of 16 units: .*",
    "report a.json -o r.md": r"Written to r\.md\.",
    "demo": r"ax, ay, az calibrated from 6 positions: rms error .*",
}


@pytest.mark.usefixtures("without_drawing")
@pytest.mark.parametrize("command", ANSWERS)
def test_the_first_line_is_the_answer_and_nothing_is_said_twice(
    command, folder, capsys, monkeypatch
):
    monkeypatch.chdir(folder)
    words = command.split() if NINE not in command else [*command.split()[:4], f"--model={NINE}"]
    status, out, err = run(capsys, *words)
    assert status in (0, 3), err
    lines = [*out.splitlines(), *err.splitlines()]
    assert re.fullmatch(ANSWERS[command], lines[0]), lines[0]
    assert lines[0].endswith(".")
    assert len(lines) <= 40
    sentences = [each for each in lines if re.search(r"[a-z]{3,} [a-z]{3,}.*[.:]$", each)]
    assert len(sentences) == len(set(sentences))
    assert not any(lines[0].removesuffix(".") in each for each in lines[1:])
    assert (status == 3) is lines[0].startswith(("Not fit for use", "Fail"))


LONG = {  # and the rows that their first table has
    "tumble roll.csv": 8,
    "design --positions 40 --model own-cubic": 40,
    "schemes all-26+fibonacci-24": 50,
    "design --positions 100": 72,
}


@pytest.mark.parametrize("command", rest_slow([*LONG], quick=3))
def test_a_long_result_ends_with_a_whole_table(command, folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    make_once(monkeypatch, "multipos.designs.designing.design")
    _, short, _ = run(capsys, *command.split())
    _, whole, _ = run(capsys, *command.split(), "-v")
    *shown, last = short.splitlines()
    assert len(shown) < 40
    left = int(re.fullmatch(r"… (\d+) more lines; -v prints all", last)[1])
    everything = whole.splitlines()
    assert everything[: len(shown)] == shown
    assert len(everything) == len(shown) + left
    assert not everything[len(shown)]  # between two tables
    labels = r"(?:^|  )\d+ +-?[01]\.\d+" if "tumble" not in command else r"^[Kd]\w+ "
    assert len(re.findall(labels, short, re.MULTILINE)) == LONG[command]
