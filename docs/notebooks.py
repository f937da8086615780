"""Runs notebooks without Jupyter, and keeps what their cells give: `python docs/notebooks.py`.

The cells of code are run in order, in one folder and one namespace. What a cell gives is what it
prints, then the value of its last line as it shows itself: HTML, a figure, or text. Lines that
begin with % are Jupyter's own. The tests run the same and compare the lines of text without a
decimal point, as other kernels of algebra round otherwise.
"""

import ast
import contextlib
import io
import json
import os
import re
import sys
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from multipos.plots import to_svg

DOCS = Path(__file__).resolve().parent
NOTEBOOKS = sorted(path for path in DOCS.rglob("*.ipynb") if "_build" not in path.parts)

Output = dict[str, Any]


def run_notebook(notebook: dict[str, Any], folder: Path) -> Iterator[tuple[dict[str, Any], Any]]:
    """Run a notebook in a folder; yield each cell of code with its outputs, as a notebook has them.

    What goes wrong in a cell goes on from here.
    """
    namespace: dict[str, Any] = {"__name__": "__main__"}
    before = Path.cwd()
    os.chdir(folder)
    try:
        for cell in notebook["cells"]:
            if cell["cell_type"] == "code":
                yield cell, _run_cell("".join(cell["source"]), namespace)
    finally:
        os.chdir(before)


def _run_cell(source: str, namespace: dict[str, Any]) -> list[Output]:
    tree = ast.parse(re.sub("^%.*$", "", source, flags=re.MULTILINE))
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    value = None
    with (
        contextlib.redirect_stdout(io.StringIO()) as printed,
        warnings.catch_warnings(record=True),
    ):
        warnings.simplefilter("always")
        exec(compile(tree, "<cell>", "exec"), namespace)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "<cell>", "eval"), namespace)
    outputs = []
    if printed.getvalue():
        outputs.append(
            {"name": "stdout", "output_type": "stream", "text": _lines(printed.getvalue())}
        )
    if value is not None:
        kind, text = _shown(value)
        data = {kind: _lines(text)}
        outputs.append(
            {"data": data, "execution_count": None, "metadata": {}, "output_type": "execute_result"}
        )
    return outputs


def _shown(value: Any) -> tuple[str, str]:
    """Return a value as it shows itself, and the kind of text that is."""
    if isinstance(value, Figure):
        return "image/svg+xml", to_svg(value)
    if hasattr(value, "_repr_html_"):
        return "text/html", value._repr_html_()
    return "text/plain", repr(value)


def _lines(text: str) -> list[str]:
    return text.splitlines(keepends=True)


def said(outputs: list[Output]) -> list[str]:
    """Return the lines of text that a cell gave, but for those with a decimal point."""
    parts = [
        "".join(each["text"] if "text" in each else each["data"].get("text/plain", ""))
        for each in outputs
    ]
    return [line for line in "\n".join(parts).splitlines() if "." not in line]


def main() -> None:
    for path in NOTEBOOKS:
        notebook = json.loads(path.read_text("utf-8"))
        with tempfile.TemporaryDirectory() as folder:
            for place, (cell, outputs) in enumerate(run_notebook(notebook, Path(folder)), start=1):
                cell |= {"execution_count": place, "outputs": outputs}
                for output in outputs:
                    if "execution_count" in output:
                        output["execution_count"] = place
        text = json.dumps(notebook, ensure_ascii=False, indent=1)
        path.write_text(text + "\n", encoding="utf-8")
        print(path.relative_to(DOCS), path.stat().st_size, file=sys.stdout)


if __name__ == "__main__":
    main()
