"""`mp.report` writes from Python what the command writes, whatever the result."""

import numpy as np
import pytest

import multipos as mp
from multipos.cli import main
from multipos.errors import UsageError


@pytest.fixture(scope="module")
def line():
    up = mp.read_scheme("faces-corners-14").up
    values = up + 1e-3 * np.random.default_rng(5).standard_normal((4, *up.shape))
    columns = dict(zip(("ax", "ay", "az"), values.reshape(-1, 3).T, strict=True))
    columns["unit"] = np.repeat(["A", "B", "C", "D"], len(up))
    columns["position"] = np.tile(np.arange(1, len(up) + 1), 4)
    return mp.fleet(columns, unit_column="unit", scheme="faces-corners-14")


def test_a_fleet(line, tmp_path):
    mp.report(line, tmp_path / "fleet.md")
    assert (tmp_path / "fleet.md").read_text(encoding="utf-8").startswith("# Report of a fleet")
    with pytest.raises(UsageError, match="has no `lab`"):
        mp.report(line, tmp_path / "lab.md", lab={})


def test_a_regression(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    t = np.linspace(-40.0, 60.0, 60)
    noise = 0.01 * np.random.default_rng(6).standard_normal(60)
    mp.write_table("rows.csv", {"t": t, "y": 1.0 + 0.02 * t + noise})
    mp.regress("rows.csv", response="y", variables="t").save("r.json")
    assert main(["report", "r.json", "-q", "-o", "command.txt"]) == 0
    mp.report(mp.load_regression("r.json"), "python.txt")
    assert (tmp_path / "python.txt").read_bytes() == (tmp_path / "command.txt").read_bytes()


def test_what_has_none(line, tmp_path):
    with pytest.raises(UsageError, match="int has no report"):
        mp.report(3, tmp_path / "r.txt")
    with pytest.raises(UsageError, match="of one calibration"):
        mp.report(line, tmp_path / "r.xml")


def test_a_comparison(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    cal = mp.demo().calibration
    cal.save("cal.json")
    assert main(["compare", "cal.json", "cal.json", "-q", "-o", "both.json"]) == 0
    capsys.readouterr()
    assert main(["report", "both.json", "-o", "r.txt"]) == 2
    assert "both.json: a comparison has no report; give the" in capsys.readouterr().err
    with pytest.raises(UsageError, match="Comparison has no report"):
        mp.report(mp.compare(cal, cal), tmp_path / "r.txt")
    assert main(["compare", "cal.json", "cal.json", "-o", "r.html"]) == 2
    assert not list(tmp_path.glob("r.*"))
