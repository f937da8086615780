"""The page of a regression: what it says first, its table, and figures on scales that show both."""

import re
import shutil
from contextlib import chdir
from pathlib import Path

import numpy as np
import pytest

import multipos as mp
from multipos.cli import main
from multipos.reports.regressions import _rows_to_draw, regression_content


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a regression and its page, made once."""
    folder = tmp_path_factory.mktemp("regression")
    rng = np.random.default_rng(1)
    time = np.arange(200.0)
    t = 20.0 * np.sin(time / 15.0)
    error = 2e-3 * t + 5e-3 * (t > 0) + rng.normal(0.0, 1e-4, 200)
    mp.write_table(folder / "data.csv", {"time": time, "temperature": t, "error": error})
    options = ["--variables", "temperature", "--stepwise", "--segment", "temperature:0", "--free"]
    with chdir(folder):
        assert main(["regress", "data.csv", "--response", "error", *options, "-o", "reg.json"]) == 0
        assert main(["report", "reg.json", "-o", "r.html"]) == 0
    return folder


@pytest.fixture
def folder(made, tmp_path, monkeypatch):
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def page(name):
    return Path(name).read_text("utf-8")


def test_report_of_a_regression(folder, capsys):
    html = page("r.html")
    # before and after against temperature and against time, and a path for each segment
    assert html.count("<svg") == 4
    for said in (
        "Notes",
        "the next is not in U",
        "the model jumps at",
        "F_0.95",
        "n − k − 1",
        "Path of",
    ):
        assert said in html
    assert main(["report", "reg.json", "-o", "r.txt"]) == 0
    assert "Largest |error|" in page("r.txt")
    assert main(["report", "reg.json", "-o", "r.md"]) == 0
    model = mp.load_regression("reg.json")
    for s in model.segments:
        assert f"{s.F_critical:.4f}" in page("r.md")


def test_before_and_after_have_scales_of_their_own(folder):
    """A flat line on the other's scale: the ticks of the two panels differ by ten at least."""
    first = re.search(r"<svg.*?</svg>", page("r.html"), re.DOTALL)[0]
    heights = [float(y) for y in re.findall(r'<use [^>]*y="([\d.]+)"', first)]
    assert len(heights) > 2 * 200  # every row in both panels, and ticks
    labels = re.findall(r"<text[^>]*>([^<]*)</text>", first)
    assert "error, before" in labels
    assert "error, after" in labels


@pytest.mark.usefixtures("without_drawing")
def test_without_the_rows_there_are_no_figures_of_them(folder, capsys):
    (folder / "data.csv").rename(folder / "else.csv")
    assert main(["report", "reg.json", "-o", "r.txt"]) == 0
    assert "--data draws before and after" in page("r.txt")
    assert main(["report", "reg.json", "--data", "else.csv", "-o", "else.html"]) == 0
    assert page("else.html").count("<svg") == 4
    mp.write_table("other.csv", {"time": [0.0], "temperature": [1.0], "error": [0.0]})
    capsys.readouterr()
    assert main(["report", "reg.json", "--data", "other.csv", "-o", "no.html"]) == 1
    assert "not the data that the regression" in capsys.readouterr().err
    assert not (folder / "no.html").exists()


def test_runs_and_several_responses(folder):
    table = mp.read_table("data.csv")
    columns = {name: np.tile(table.number(name), 3) for name in table.columns}
    columns |= {"run": np.repeat([1, 2, 3], 200), "other": -columns["error"]}
    found = mp.regress(columns, response="error,other", variables="temperature", run="run")
    found.save("both.json")
    assert main(["report", "both.json", "-o", "r.txt"]) == 0
    text = page("r.txt")
    assert "3 switch-ons are separated by 'run'" in text
    assert "Tests of other" in text


@pytest.mark.parametrize("segments", [1, 2])
def test_the_first_table_is_of_the_terms_or_of_the_segments(folder, segments):
    if segments == 1:
        options = ["--terms", "1 + temperature", "-o", "reg.json"]
        assert main(["regress", "data.csv", "--response", "error", *options]) == 0
    content = regression_content(mp.load_regression("reg.json"), beside="reg.json")
    assert content.result is not None
    (table,) = content.result.tables
    assert table.header[:2] == (("term", "value(u)"), ("segment", "n"))[segments - 1]
    assert len(table.rows) == 2
    assert len(content.result.figures) == 1
    later = [each.caption for section in content.sections for each in section.tables]
    assert table.caption not in later  # once


def test_a_figure_of_many_rows_shows_some_of_every_phase_and_the_largest():
    """By hand: a quarter of 4,000 rows, and of each of the six phases of a repeated pattern."""
    errors = np.random.default_rng(7).standard_normal(4000)
    shown = _rows_to_draw(errors)
    assert len(shown) == pytest.approx(1000, abs=30)
    assert set(np.argsort(-np.abs(errors))[:24]) <= set(shown)
    assert np.bincount(shown % 6) == pytest.approx(1000 / 6, abs=20)
    assert _rows_to_draw(errors[:1000]).tolist() == list(range(1000))


def test_a_page_of_many_rows_is_small(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    time = np.arange(4000.0)
    t = 20.0 * np.sin(time / 300.0)
    error = 2e-3 * t + np.random.default_rng(8).normal(0.0, 1e-4, 4000)
    mp.write_table("long.csv", {"time": time, "temperature": t, "error": error})
    options = ["--response", "error", "--variables", "temperature"]
    assert main(["regress", "long.csv", *options, "-o", "long.json"]) == 0
    assert main(["report", "long.json", "-o", "long.html"]) == 0
    assert Path("long.html").stat().st_size < 6e5
    assert re.search(r"Before and after against \w+ \(\d+ of 4000 rows\)", page("long.html"))
