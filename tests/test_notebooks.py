"""Notebooks of docs/ run without Jupyter, and give what is kept in them."""

import json
from pathlib import Path

import pytest
from docs_programs import load

DOCS = Path(__file__).resolve().parents[1] / "docs"


NOTEBOOKS = load("notebooks")


@pytest.mark.parametrize("path", NOTEBOOKS.NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_runs_and_gives_what_it_keeps(path, tmp_path):
    pytest.importorskip("pandas")
    pytest.importorskip("uncertainties")
    notebook = json.loads(path.read_text("utf-8"))
    assert notebook["nbformat"] == 4
    cells = list(NOTEBOOKS.run_notebook(notebook, tmp_path))
    assert len(cells) > 5
    for place, (cell, outputs) in enumerate(cells, start=1):
        where = f"{path.name}, cell {place}"
        assert cell["execution_count"] == place, where
        assert NOTEBOOKS.said(outputs) == NOTEBOOKS.said(cell["outputs"]), where
        kinds = [
            [list(each.get("data", ())) for each in part] for part in (outputs, cell["outputs"])
        ]
        assert kinds[0] == kinds[1], where


def test_a_notebook_is_to_be_found():
    for path in NOTEBOOKS.NOTEBOOKS:
        name = path.relative_to(DOCS).as_posix()
        assert f"]({name})" in (DOCS / "index.md").read_text("utf-8")


def test_what_a_cell_gives(tmp_path):
    cells = ["x = 2\nprint('a')", "%matplotlib inline\nx + 1", "{'half': 0.5}", "x = 1"]
    notebook = {"cells": [{"cell_type": "code", "source": [text]} for text in cells]}
    found = [NOTEBOOKS.said(outputs) for _, outputs in NOTEBOOKS.run_notebook(notebook, tmp_path)]
    assert found == [["a"], ["3"], [], []]
    (tmp_path / "kept").mkdir()
    notebook["cells"].append({"cell_type": "code", "source": ["1 / 0"]})
    with pytest.raises(ZeroDivisionError):
        list(NOTEBOOKS.run_notebook(notebook, tmp_path))
    assert Path.cwd() != tmp_path
