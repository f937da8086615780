"""Every numbered equation of a docstring is held by a test with a number from elsewhere.

A test that holds an equation by a number from elsewhere (by hand, published, by a second route)
says so in a comment: ``# eq. (3) of estimation.known``, several as ``# eqs. (1), (2) of …``.
"""

import ast
import re
from pathlib import Path

from docs_programs import load

_NUMBERED = re.compile(r"\S.*\s{2,}\((\d+[a-z]?)\)$")  # at the end of a line of its own
_MARK = re.compile(r"# eqs?\. ((?:\(\w+\)(?:, )?)+) of ([a-z_]+(?:\.[a-z_]+)+)")


def test_every_equation_has_a_test():
    found, marked = _equations(), _marks()
    assert not marked - found, "tests hold equations that are in no docstring"
    assert not found - marked, "equations without a test"


def _equations() -> set[tuple[str, str]]:
    found = set()
    for path in Path("multipos").rglob("*.py"):
        module = ".".join(path.relative_to("multipos").with_suffix("").parts)
        for node in load("generated").parsed(path.resolve())[1]:
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                lines = (ast.get_docstring(node) or "").splitlines()
                numbers = [_NUMBERED.match(line.strip()) for line in lines if line[:4] == "    "]
                found |= {(module, number[1]) for number in numbers if number}
    return found


def _marks() -> set[tuple[str, str]]:
    return {
        (module, number)
        for path in Path("tests").rglob("test_*.py")
        for numbers, module in _MARK.findall(path.read_text(encoding="utf-8"))
        for number in re.findall(r"\((\w+)\)", numbers)
        if path.name != Path(__file__).name
    }
