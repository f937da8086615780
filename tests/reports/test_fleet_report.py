"""The report of a fleet: its sections and words, from Python and by the command."""

import re

import numpy as np
import pytest

import multipos as mp
from multipos.cli import main
from multipos.reports.fleet_report import fleet_content

SCHEME = "faces-corners-14"
UP = mp.read_scheme(SCHEME).up


def rows_of(values, **columns):
    """A table of units (U, 14, 3), one after the other."""
    found = dict(zip(("ax", "ay", "az"), values.reshape(-1, 3).T, strict=True))
    found |= {name: np.repeat(column, len(UP)) for name, column in columns.items()}
    return found | {"position": np.tile(np.arange(1, len(UP) + 1), len(values))}


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """A line of two stations that drifts, with limits and outliers."""
    rng = np.random.default_rng(3)
    bias = 3e-3 * rng.standard_normal((120, 3)) + 8e-3 * (np.arange(120) > 70)[:, None]
    bias[31, 0] = 0.3
    values = UP + bias[:, None, :] + 1e-4 * rng.standard_normal((120, *UP.shape))
    names = np.array([f"u{i}" for i in range(120)])
    line = mp.fleet(
        rows_of(values, unit=names, station=np.where(np.arange(120) % 2, "B", "A")),
        unit_column="unit",
        station_column="station",
        scheme=SCHEME,
        limits={"bias_ax": (-0.01, 0.01)},
        orientation_sd=0,
    )
    return line.to_dict()


def said(content):
    """Everything a page says, but the cells of numbers and names."""
    yield from (content.title, content.subtitle, content.sentence)
    for section in content.sections:
        yield section.title
        yield from section.paragraphs
        for figure in section.figures:
            yield from (figure.caption, figure.description)
            yield from re.findall(r"<text[^>]*>([^<]*)</text>", figure.draw())
        for table in section.tables:
            yield from (table.caption, *table.header)
            if section.title != "Data":
                yield from (cell for row in table.rows for cell in row)


def test_the_sections_of_a_fleet(found):
    content = fleet_content(found)
    assert len(content.sections) == 8
    assert {"A", "Cpk", "bias_ax", "u31"} < set(said(content))
    assert re.findall("[a-z]{4,}", content.sentence.rpartition(": ")[2]) == ["pass", "fail"]


@pytest.mark.usefixtures("without_drawing")
def test_the_command_writes_what_python_does(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    values = UP + 1e-3 * np.random.default_rng(5).standard_normal((4, *UP.shape))
    columns = rows_of(values, unit=np.array(["A", "B", "C", "D"]))
    line = mp.fleet(columns, unit_column="unit", scheme=SCHEME)
    mp.report(line, "python.md")
    mp.write_table("line.csv", columns)
    made = ["fleet", "line.csv", "--unit-column", "unit", "--scheme", SCHEME, "-o", "line"]
    assert main(made) == 0
    assert main(["report", "line", "-o", "command.md"]) == 0
    for name in ("python.md", "command.md"):
        text = (tmp_path / name).read_text("utf-8")
        assert text.startswith("# Report of a fleet\n\nComputed ")
        assert "**Yield 100.00 %" in text
        assert "## Parameters" in text
