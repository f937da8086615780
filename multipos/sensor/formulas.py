"""Formulas of a model of one's own: from a line of text to elementary instructions.

    sum     = product (('+' | '-') product)*
    product = sign (('*' | '/') sign)*
    sign    = ('+' | '-') sign | power
    power   = atom ['^' sign]                    from the right: -x^2 is -(x^2)             (1)
    atom    = number | name | function '(' sum (',' sum)* ')' | '(' sum ')' | '|' sum '|'

A formula is parsed, never evaluated: what comes out are the instructions of
`multipos.sensor.instructions`, of which CasADi makes values and derivatives. Every error names
the character at which it stands.
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

from multipos.errors import UsageError
from multipos.files.lists import near
from multipos.sensor.instructions import Instruction

CONSTANTS = {"pi": math.pi, "e": math.e}
# How each function is called among the instructions; min and max take two arguments or more.
UNARY = {
    "sin": "sin",
    "cos": "cos",
    "tan": "tan",
    "asin": "asin",
    "acos": "acos",
    "atan": "atan",
    "exp": "exp",
    "log": "log",
    "sqrt": "sqrt",
    "abs": "fabs",
    "sign": "sign",
    "tanh": "tanh",
}
BINARY = {"atan2": "atan2"}
FOLDED = {"min": "fmin", "max": "fmax"}
FUNCTIONS = (*UNARY, *BINARY, *FOLDED)
_OPERATORS = {"+": "add", "-": "sub", "*": "mul", "/": "div", "^": "pow"}
_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[^\W\d]\w*)"
    r"|(?P<mark>\*\*|[-+*/^(),|]))"
)
_DEEPEST = 60  # parentheses and signs within each other
_LONGEST = 4000  # characters

Tree = tuple[str, tuple[Any, ...]] | float | str  # operation and operands, a number, a name


@dataclass(frozen=True)
class Formula:
    """One line of a model.

    Attributes
    ----------
    text : str
        As it was written, without the name before the '='.
    tree : nested tuples
        (operation, operands), a number, or a name.
    names : mapping of str to int
        Names in the order in which they first stand, with their character, from 1.
    where, fault : str, type of error
        What an error begins with, and its type.
    """

    text: str
    tree: Tree
    names: Mapping[str, int]
    where: str
    fault: type[ValueError]

    def fail(self, character: int, said: str) -> NoReturn:
        """Raise the error of a place in the line."""
        raise self.fault(f"{self.where}, character {character}: {said}.")


def parse_formula(
    text: str, where: str, offset: int = 0, fault: type[ValueError] = UsageError
) -> Formula:
    """Return a formula parsed by (1).

    Parameters
    ----------
    text : str
    where : str
        What an error begins with.
    offset : int
        Characters of the line before the formula.
    fault : type of error
        `MultiposError` for a formula of a file.

    Raises
    ------
    UsageError
        It is none; the message names the character and what was expected there.
    """
    reader = _Reader(text, where, offset, fault)
    tree = reader.sum(0)
    if reader.kind != "end":
        reader.fail("expected an operator")
    return Formula(text.strip(), tree, reader.names, where, fault)


def instruct(formula: Formula, inputs: Mapping[str, tuple[int, int] | float]) -> list[Instruction]:
    """Return the instructions of a formula.

    Parameters
    ----------
    formula : Formula
    inputs : mapping of name to (argument, component), or to a number
        Every name of the formula that is no constant.
    """
    program: list[Instruction] = []
    known: dict[Tree, int] = {}  # what was written already stands at one place

    def write(tree: Tree) -> int:
        if tree not in known:
            known[tree] = _write(tree, inputs, program, write)
        return known[tree]

    program.append(("output", write(formula.tree)))
    return program


def _write(
    tree: Tree,
    inputs: Mapping[str, tuple[int, int] | float],
    program: list[Instruction],
    write: Callable[[Tree], int],
) -> int:
    """Add what a tree computes to a program, and return the place where it stands."""
    if isinstance(tree, str):
        source = inputs.get(tree, CONSTANTS.get(tree, 0.0))
        if isinstance(source, tuple):
            place = len(program)
            program.append(("input", place, *source))
            return place
        tree = float(source)
    if isinstance(tree, float):
        place = len(program)
        program.append(("const", place, tree))
        return place
    name, operands = tree
    places = [write(operand) for operand in operands]
    place = len(program)
    program.append((name, place, *places))
    return place


class _Reader:
    """The tokens of a line, and the rules of (1)."""

    def __init__(self, text: str, where: str, offset: int, fault: type[ValueError]) -> None:
        self.text, self.where, self.offset, self.fault = text, where, offset, fault
        self.names: dict[str, int] = {}
        self.at = self.end = 0
        self.kind, self.token = "", ""
        if len(text) > _LONGEST:
            self.fail_at(_LONGEST, f"a line has at most {_LONGEST} characters")
        self.next()

    def fail_at(self, at: int, said: str) -> NoReturn:
        raise self.fault(f"{self.where}, character {self.offset + at + 1}: {said}.")

    def fail(self, expected: str) -> NoReturn:
        found = f"'{self.token}'" if self.token else "the end of the line"
        self.fail_at(self.at, f"{expected}, found {found}")

    def next(self) -> None:
        match = _TOKEN.match(self.text, self.end)
        if match is None:
            rest = self.text[self.end :]
            self.at = self.end + len(rest) - len(rest.lstrip())
            self.kind, self.token = "end", self.text[self.at : self.at + 1]
            if self.token:
                self.fail_at(self.at, f"'{self.token}' has no meaning in a formula")
            return
        self.kind = str(match.lastgroup)
        self.token = match[self.kind]
        self.at, self.end = match.start(self.kind), match.end()
        self.token = "^" if self.token == "**" else self.token

    def sum(self, depth: int) -> Tree:
        if depth > _DEEPEST:
            self.fail(f"at most {_DEEPEST} parentheses within each other")
        return self._chain("+-", self._product, depth)

    def _product(self, depth: int) -> Tree:
        return self._chain("*/", self._sign, depth)

    def _chain(self, marks: str, inner: Callable[[int], Tree], depth: int) -> Tree:
        left = inner(depth)
        while self.kind == "mark" and self.token in marks:
            operation = _OPERATORS[self.token]
            self.next()
            left = (operation, (left, inner(depth)))
        return left

    def _sign(self, depth: int) -> Tree:
        if depth > _DEEPEST:
            self.fail(f"at most {_DEEPEST} signs within each other")
        if self.kind == "mark" and self.token in "+-":
            minus = self.token == "-"
            self.next()
            inner = self._sign(depth + 1)
            return ("neg", (inner,)) if minus else inner
        base = self._atom(depth)
        if self.kind == "mark" and self.token == "^":
            self.next()
            return ("pow", (base, self._sign(depth + 1)))
        return base

    def _atom(self, depth: int) -> Tree:
        kind, token, at = self.kind, self.token, self.at
        if kind == "number":
            self.next()
            value = float(token)
            if math.isinf(value):
                self.fail_at(at, f"{token} is larger than a number can be")
            return value
        if kind == "name":
            return self._named(token, at, depth)
        if kind == "mark" and token in "(|":
            self.next()
            inner = self.sum(depth + 1)
            self._close(")" if token == "(" else "|", token, at)
            return inner if token == "(" else ("fabs", (inner,))
        return self.fail("expected a number, a name or '('")

    def _named(self, name: str, at: int, depth: int) -> Tree:
        self.next()
        if self.kind == "mark" and self.token == "(":
            return self._call(name, at, depth)
        if name in FUNCTIONS:
            self.fail(f"expected '(' after {name}")
        if name not in CONSTANTS:
            self.names.setdefault(name, self.offset + at + 1)
        return name

    def _close(self, mark: str, opened: str, at: int) -> None:
        if self.kind != "mark" or self.token != mark:
            self.fail(f"expected '{mark}' for the '{opened}' at character {self.offset + at + 1}")
        self.next()

    def _call(self, name: str, at: int, depth: int) -> Tree:
        if name not in FUNCTIONS:
            self.fail_at(
                at,
                f"unknown function '{name}'{near(name, FUNCTIONS)} "
                f"There are {', '.join(FUNCTIONS)}; a product is written with '*'",
            )
        opened = self.at
        self.next()
        given = [self.sum(depth + 1)]
        while self.kind == "mark" and self.token == ",":
            self.next()
            given.append(self.sum(depth + 1))
        self._close(")", "(", opened)
        self._check_count(name, at, len(given))
        if name in UNARY:
            return (UNARY[name], (given[0],))
        operation = BINARY.get(name) or FOLDED[name]
        folded = given[0]
        for other in given[1:]:
            folded = (operation, (folded, other))
        return folded

    def _check_count(self, name: str, at: int, given: int) -> None:
        needs = 1 if name in UNARY else 2
        if given != needs and not (name in FOLDED and given > needs):
            more = " or more" if name in FOLDED else ""
            said = f"{name} takes {needs}{more} argument{'s' * (needs > 1)}, got {given}"
            self.fail_at(at, said)
