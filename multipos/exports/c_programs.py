"""The programs of the folder `templates`, and arrays of numbers in them.

`fill` puts words into a program, `array` writes a constant array.
"""

from collections.abc import Sequence
from pathlib import Path
from string import Template


def fill(template: str, **words: object) -> str:
    """Return a program of the folder `templates` with its words filled in."""
    text = Path(__file__).with_name("templates").joinpath(template).read_text(encoding="utf-8")
    return Template(text).substitute(words)


def array(name: str, kind: str, rows: Sequence[Sequence[object]]) -> str:
    """Return a constant array of rows of numbers, of length ``COUNT``, of a kind of C."""
    lines = ",\n".join(f"    {{{', '.join(map(str, row))}}}" for row in rows)
    return f"static const {kind} {name}[COUNT][{len(rows[0])}] = {{\n{lines}\n}};"
