"""The report of repeated calibrations, from the file that `compare` wrote and from Python."""

import json
import re

import numpy as np
import pytest

import multipos as mp
from multipos.cli import main
from multipos.plots.style import new_figure
from multipos.reports import several
from multipos.reports.several import comparison_content
from multipos.results import plain

UP = mp.read_scheme("faces-edges-18").up


def one(seed, moved=0.0):
    values = UP + 1e-3 * np.random.default_rng(seed).standard_normal(UP.shape)
    values[:, 1] += moved
    return mp.fit(mp.Readings(values, up=UP, unit="g"))


@pytest.fixture
def compared(tmp_path):
    found = mp.compare(*(one(seed, 0.02 * (seed == 4)) for seed in range(1, 5)))
    (tmp_path / "compared.json").write_text(json.dumps(plain(found.to_dict())), encoding="utf-8")
    return found


@pytest.mark.usefixtures("without_drawing")
def test_the_report_says_what_moved_and_every_value(compared, tmp_path, capsys):
    for ending in ("html", "md", "txt"):
        target = tmp_path / f"r.{ending}"
        assert main(["report", str(tmp_path / "compared.json"), "-o", str(target)]) == 0
        text = target.read_text("utf-8")
        assert re.search(
            r"\d+ of 12 parameters agree with the first calibration.{1,5}s within U", text
        )
        assert "Together 4 calibrations do not agree" in text
        assert "Moved beyond chance: bias_ay." in text
        assert text.index("do not agree") < text.index("Moved beyond chance")
        mp.report(compared, tmp_path / f"p.{ending}")
        assert (tmp_path / f"p.{ending}").read_text("utf-8") == text
    _, line = (row for row in text.splitlines() if row.startswith("bias_ay"))
    unit = line.split()[1]
    values = [float(cell.replace("−", "-")) for cell in line.split()[2:6]]
    place = compared.calibrations[0].names.index("bias_ay")
    factor = {"mV": 1e3, "mg": 1e3, "V": 1.0}[unit]
    # to three digits of the standard deviation over the runs
    sd = float(factor * compared.sd[place])
    assert values == pytest.approx(factor * compared.values[:, place], abs=0.006 * sd)
    chinese = tmp_path / "zh.txt"
    argv = ["report", str(tmp_path / "compared.json"), "--language", "zh", "-o", str(chinese)]
    assert main(argv) == 0
    assert "变化超出偶然的参数：bias_ay。" in chinese.read_text("utf-8")
    assert "Bias" not in chinese.read_text("utf-8")


def test_the_figure_has_the_u_of_each_run(compared, monkeypatch):
    drawn = []

    def keep(tr, height, draw):
        axes = new_figure()[1]
        draw(axes[0])
        drawn.append(axes[0])

    monkeypatch.setattr(several.sections, "draw_svg", keep)
    of_file = json.loads(json.dumps(plain(compared.to_dict())))
    before_u = [{k: v for k, v in entry.items() if k != "U"} for entry in of_file["parameters"]]
    for content, said, has in (
        (of_file, "Biases by run, each less its mean, with U", True),
        ({**of_file, "parameters": before_u}, "Biases by run, each less its mean", False),
    ):
        (figure,) = comparison_content(content).result.figures
        assert figure.caption == said
        figure.draw()
        bars = drawn[-1].containers
        assert len(bars) == 3
        for i, bar in enumerate(bars):
            place = compared.calibrations[0].names.index(f"bias_a{'xyz'[i]}")
            values = compared.values[:, place] - compared.mean[place]
            assert bar[0].get_ydata() == pytest.approx(values, abs=1e-12)
            U = np.array([c.U[place] for c in compared.calibrations]) if has else np.zeros(4)
            ends = [segment[:, 1] for segment in bar[2][0].get_segments()]
            assert np.ptp(ends, axis=1) == pytest.approx(2.0 * U, abs=1e-12)


def test_a_damaged_file_and_options_of_one_calibration_are_refused(compared, tmp_path, capsys):
    content = plain(compared.to_dict())
    content["parameters"][2]["values"].pop()
    (tmp_path / "bad.json").write_text(json.dumps(content), encoding="utf-8")
    target = str(tmp_path / "r.html")
    for argv, status, said in (
        (["bad.json", "-o", target], 1, "it has not a value for each of 4 runs; compare again."),
        (["compared.json", "--monte-carlo", "1000", "-o", target], 2, "are of one calibration"),
        (["compared.json", "-o", str(tmp_path / "r.xml")], 2, "is of one calibration"),
    ):
        assert main(["report", str(tmp_path / argv[0]), *argv[1:]]) == status
        assert said in capsys.readouterr().err.splitlines()[-1]
        assert not (tmp_path / "r.html").exists()
    with pytest.raises(mp.UsageError, match="are of one calibration"):
        mp.report(compared, tmp_path / "r.xml")


def test_repeated_regressions(tmp_path):
    t = np.linspace(-20.0, 60.0, 60)
    runs = []
    for seed in (1, 2, 3):
        noise = 1e-3 * np.random.default_rng(seed).standard_normal(60)
        runs.append(mp.regress({"t": t, "y": 0.01 * t + noise}, response="y", variables="t"))
    found = mp.compare(*runs)
    mp.report(found, tmp_path / "r.txt")
    text = (tmp_path / "r.txt").read_text("utf-8")
    assert "3 regressions agree; smallest p of a term" in text
    assert "Terms by run" in text
