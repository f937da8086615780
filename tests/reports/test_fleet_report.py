"""The report of a fleet in Chinese: every sentence, heading and word."""

import re

import numpy as np
import pytest

import multipos as mp
from multipos.cli import main
from multipos.reports.several import fleet_content

SCHEME = "faces-corners-14"
UP = mp.read_scheme(SCHEME).up
# Names, symbols, units and what is typed stay.
KEPT = re.compile(
    r"(bias|scale|cross)_a[xyz_]+|\ba[xyz]\b|Cpk|Ppk|EWMA|SHA-256|reading|rms|mg|deg|\de-\d|"
    r"fleet\.json|stations/NAME\.csv|NAME\.toml|multipos report DIR --unit ID -o ID\.html"
)


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
            if section.title not in ("Data", "数据"):
                yield from (cell for row in table.rows for cell in row)


def test_every_word_of_a_fleet_is_chinese(found):
    english, chinese = (fleet_content(found, language=language) for language in ("en", "zh"))
    assert len(english.sections) == 8
    assert {"A", "Cpk", "bias_ax", "u31"} < set(said(english))
    left = {
        word for text in said(chinese) for word in re.findall("[A-Za-z]{2,}", KEPT.sub("", text))
    }
    assert left == set()
    assert re.findall("[A-Za-z]{4,}", KEPT.sub("", english.sentence.rpartition(": ")[2])) == [
        "pass",
        "fail",
    ]


@pytest.mark.usefixtures("without_drawing")
def test_the_command_takes_the_language(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    values = UP + 1e-3 * np.random.default_rng(5).standard_normal((4, *UP.shape))
    columns = rows_of(values, unit=np.array(["A", "B", "C", "D"]))
    line = mp.fleet(columns, unit_column="unit", scheme=SCHEME)
    mp.report(line, "python.md", language="zh")
    mp.write_table("line.csv", columns)
    made = ["fleet", "line.csv", "--unit-column", "unit", "--scheme", SCHEME, "-o", "line"]
    assert main(made) == 0
    assert main(["report", "line", "--language", "zh", "-o", "command.md"]) == 0
    for name in ("python.md", "command.md"):
        text = (tmp_path / name).read_text("utf-8")
        assert text.startswith("# 批量校准报告\n\n计算于 ")
        assert "**4 个单元的合格率 100.00 %" in text
        assert "## 参数" in text
    with pytest.raises(mp.UsageError, match="en or zh"):
        mp.report(line, "r.md", language="de")
