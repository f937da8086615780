"""Every finding of the program is on its page, and its text has a Chinese one."""

import ast
import itertools
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from multipos.reports.page import Translator

ROOT = Path(__file__).resolve().parents[2]
PUT_IN = "7"  # where a text has a number or a name
FILES = [p for p in sorted((ROOT / "multipos").rglob("*.py")) if "Finding(" in p.read_text("utf-8")]
FILES_OF_FITS = [path for path in FILES if path.parent.name == "diagnostics"]


def assigned(tree: ast.AST) -> dict[str, list[ast.expr]]:
    """Return what is assigned to every name of a function, wherever that is."""
    found: dict[str, list[ast.expr]] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            found.setdefault(node.targets[0].id, []).append(node.value)
    return found


def texts_of(node: ast.expr, names: dict[str, list[ast.expr]]) -> list[str]:
    """Return the texts that an expression may be, numbers and names put in."""
    match node:
        case ast.Constant(value=str(text)):
            return [text]
        case ast.JoinedStr(values=parts):
            each = [texts_of(part, names) for part in parts]
            return ["".join(choice) for choice in itertools.product(*each)]
        case ast.FormattedValue(value=value):
            return texts_of(value, names)
        case ast.IfExp(body=one, orelse=other):
            return texts_of(one, names) + texts_of(other, names)
        case ast.BinOp(left=left, right=right):
            pairs = itertools.product(texts_of(left, names), texts_of(right, names))
            return [a + b for a, b in pairs]
        case ast.Dict(values=values):
            return [text for value in values for text in texts_of(value, names)]
        case ast.Name(id=name) if name in names:
            rest = {other: values for other, values in names.items() if other != name}
            return [text for value in names[name] for text in texts_of(value, rest)]
        case ast.Subscript(value=value):
            return texts_of(value, names)
    return [PUT_IN]


def findings(files: list[Path]) -> Iterator[tuple[list[str], str, list[str]]]:
    """Yield the codes, level and texts of every finding that is made."""
    for path in files:
        tree = ast.parse(path.read_text("utf-8"))
        functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
        for function in functions:
            names = assigned(function)
            for node in ast.walk(function):
                if not (isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Finding"):
                    continue
                if len(node.args) < 3:
                    continue  # read from a file
                code, level, text = node.args[:3]
                if not isinstance(level, ast.Constant):
                    continue  # read from a file
                codes = texts_of(code, {})
                if codes == [PUT_IN]:  # one of several repairs
                    table = next(v for v in names["texts"] if isinstance(v, ast.Dict))
                    codes = [key.value for key in table.keys if isinstance(key, ast.Constant)]
                yield codes, str(level.value), texts_of(text, names)


MADE = list(findings(FILES))


def on_the_page() -> dict[str, str]:
    page = (ROOT / "docs/findings.md").read_text("utf-8")
    found = {}
    for level, part in (("error", "## Errors"), ("warning", "## Warnings"), ("note", "## Notes")):
        body = page.split(part)[1].split("\n## ")[0]
        found |= dict.fromkeys(re.findall(r"^\| `([a-z-]+)` \|", body, re.MULTILINE), level)
    return found


def test_every_code_of_the_program_is_on_the_page_and_no_other():
    made = {(code, level) for codes, level, _ in MADE for code in codes}
    shown = set(on_the_page().items())
    assert len(made) > 25
    assert shown <= made
    assert {code for code, level in made if level == "error"} <= {code for code, _ in shown}


SHOWN = [(codes, texts) for codes, _, texts in findings(FILES_OF_FITS)]


@pytest.mark.parametrize("texts", [t for _, t in SHOWN], ids=[codes[0] for codes, _ in SHOWN])
def test_every_text_of_a_finding_has_a_chinese_one(texts):
    words = Translator("zh")
    for text in texts:
        if text == PUT_IN:  # made elsewhere, of what a run of a check has moved
            continue
        said = words.message(text)
        assert re.search(r"[\u4e00-\u9fff]", said), text
        left = re.sub(r"--[a-z-]+|\[[a-z]+\]|_deg|[a-z]+/s\^2", "", said)
        assert not re.search(r"[a-z]{4,} [a-z]{2,} [a-z]{2,}", left), said


def test_a_chinese_text_keeps_what_is_put_in():
    said = Translator("zh").message(
        "positions 2, 5 look interchanged: with their readings exchanged the rms falls from "
        "0.5 g to 0.001 g; exchange them, or measure both again"
    )
    assert said.startswith("位置 2, 5 的读数像是互换了：交换后均方根由 0.5 g 降至 0.001 g；")
