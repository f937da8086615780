"""Lines are a budget: lines of code of the package, of each room and of the tests.

A line of code holds something other than a comment or a docstring. A ceiling is only ever lowered;
between rooms lines may be traded, the sums never rise. `python tests/test_size.py` prints what
stands today beside the ceilings.
"""

import ast
import io
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "multipos"

ALL, TESTS = 50_907, 45_183

# By room; what stands beside the rooms counts with the commands.
CEILINGS = {
    "bias_stability": 1168,
    "capturing": 2396,
    "commands": 2159,
    "compensation": 781,
    "designs": 1734,
    "diagnostics": 3921,
    "estimation": 5574,
    "exports": 2446,
    "files": 3029,
    "fitting": 1436,
    "fleets": 3310,
    "logs": 4119,
    "numerics": 1767,
    "page": 466,
    "plots": 1320,
    "positions": 2388,
    "regression": 2205,
    "reports": 2691,
    "sensor": 3737,
    "uncertainty": 1758,
    "verification": 2502,
}

_NO_CODE = (
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
)


def lines_of_code(path: Path) -> int:
    """Return how many lines of a file hold code."""
    source = path.read_text(encoding="utf-8")
    code: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in _NO_CODE:
            code.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(source)):
        text = node.value if isinstance(node, ast.Expr) else None
        if isinstance(text, ast.Constant) and isinstance(text.value, str):
            code.difference_update(range(node.lineno, (node.end_lineno or 0) + 1))
    return len(code)


def by_room() -> dict[str, int]:
    """Return the lines of code of each room."""
    lines = dict.fromkeys(CEILINGS, 0)
    for path in PACKAGE.rglob("*.py"):
        inside = path.relative_to(PACKAGE)
        room = inside.parts[0] if len(inside.parts) > 1 else "commands"
        lines[room] += lines_of_code(path)
    return lines


def of_tests() -> int:
    """Return the lines of code of all that stands under tests."""
    return sum(lines_of_code(path) for path in (ROOT / "tests").rglob("*.py"))


LINES = by_room()


@pytest.mark.parametrize("room", CEILINGS)
def test_a_room_keeps_below_its_ceiling(room):
    assert LINES[room] <= CEILINGS[room]


def test_the_package_keeps_below_its_ceiling():
    assert sum(LINES.values()) <= ALL


def test_the_tests_keep_below_their_ceiling():
    assert of_tests() <= TESTS


def test_docstrings_and_comments_are_no_code(tmp_path):
    path = tmp_path / "file.py"
    path.write_text('"""One.\n\nTwo."""\n\nx = 1  # three\n# four\ny = (\n    2\n)\n', "utf-8")
    assert lines_of_code(path) == 4


if __name__ == "__main__":
    for name, lines in LINES.items():
        print(f"{name:16}{lines:7,} of {CEILINGS[name]:7,}")
    print(f"{'all':16}{sum(LINES.values()):7,} of {ALL:7,}")
    print(f"{'tests':16}{of_tests():7,} of {TESTS:7,}")
