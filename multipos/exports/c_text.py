"""C as a tree of statements, from which all functions are written, and the numbers in them.

`Real` writes numbers and sums in single or double precision, `literal` one number. `function`
writes a function of statements, `fill` puts words into a program of the folder `templates`, and
`array` writes a constant array.

A statement is a line, or a block: heads and what stands in their braces by turns, so that
``("if (x > 0)", [...], "else", [...])`` is one block, and an empty head braces alone.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import numpy as np

from multipos.errors import MultiposError

Statement = str | tuple[Any, ...]


def literal(value: float, single: bool) -> str:
    """Return a number as C reads it back, to the last digit.

    Raises
    ------
    MultiposError
        The precision cannot hold it.
    """
    with np.errstate(over="ignore"):
        held = np.float32(value) if single else np.float64(value)
    if not np.isfinite(held):
        raise MultiposError(
            f"a number of the C file would be {value:.3g}, beyond "
            f"{'single' if single else 'double'} precision; fit readings in a unit nearer to "
            f"their size{', or leave out --float' if single else ''}."
        )
    return f"{held!s}f" if single else repr(float(held))


class Real(NamedTuple):
    """How numbers are written."""

    single: bool

    @property
    def kind(self) -> str:
        """The type of a number."""
        return "float" if self.single else "double"

    @property
    def f(self) -> str:
        """The end of the names of functions of the C library."""
        return "f" if self.single else ""

    def number(self, value: float) -> str:
        """Return a number as C reads it back."""
        return literal(value, self.single)

    def sum(self, parts: Iterable[tuple[float, str]]) -> str:
        """Return a sum of numbers times products, in the order it is given."""
        pieces = [
            f"{'-' if value < 0.0 else '+'} {self._piece(abs(float(value)), product)}"
            for value, product in parts
            if value
        ]
        signed = " ".join(pieces).removeprefix("+ ")
        if signed[:1] == "-":
            return f"-{signed[2:]}"
        return signed or self.number(0.0)

    def _piece(self, size: float, product: str) -> str:
        if product and size == 1.0:
            return product
        return " * ".join(filter(None, (self.number(size), product)))


def function(signature: str, statements: Sequence[Statement]) -> str:
    """Return a function of statements."""
    return "\n".join([signature, "{", *_lines(statements, "    "), "}"]) + "\n"


def _lines(statements: Sequence[Statement], pad: str) -> list[str]:
    lines = []
    for statement in statements:
        if isinstance(statement, str):
            lines.append(f"{pad}{statement}" if statement else "")
            continue
        before = pad
        for head, inner in zip(statement[::2], statement[1::2], strict=True):
            lines += [f"{before}{head} {{" if head else f"{before}{{", *_lines(inner, f"{pad}    ")]
            before = f"{pad}}} "
        lines.append(f"{pad}}}")
    return lines


def fill(template: str, **words: object) -> str:
    """Return a program of the folder `templates` with its words filled in."""
    text = Path(__file__).with_name("templates").joinpath(template).read_text(encoding="utf-8")
    return Template(text).substitute(words)


def array(name: str, kind: str, rows: Sequence[Sequence[object]]) -> str:
    """Return a constant array of rows of numbers, of length ``COUNT``, of a kind of C."""
    lines = ",\n".join(f"    {{{', '.join(map(str, row))}}}" for row in rows)
    return f"static const {kind} {name}[COUNT][{len(rows[0])}] = {{\n{lines}\n}};"
