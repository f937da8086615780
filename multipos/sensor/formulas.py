"""Formulas of a user-defined model: from a line of text to the steps that compute it.

`parse_formula` reads one line; the `Formula` that it returns names what stands in it.

    sum     = product (('+' | '-') product)*
    product = sign (('*' | '/') sign)*
    sign    = ('+' | '-') sign | power
    power   = atom ['^' sign]                    from the right: -x^2 is -(x^2)             (1)
    atom    = number | name | function '(' sum (',' sum)* ')' | '(' sum ')' | '|' sum '|'

A formula is parsed, never evaluated. What comes out is its postfix form, ``b + s*own`` as
``b s own mul add``: numbers, names and operations, each after its operands, so that a sum of any
length is computed without recursion. Parentheses within each other have a limit, 60, and a line
has one, 4000 characters. Every error names the character at which it stands.
"""

import math
import re
from collections.abc import Callable, Mapping
from typing import NoReturn

from multipos.errors import UsageError
from multipos.files.spelling import near
from multipos.results import frozen

CONSTANTS = {"pi": math.pi, "e": math.e}
# CasADi's name of each function; min and max take two arguments or more.
UNARY = {
    **{name: name for name in ("sin", "cos", "tan", "asin", "acos", "atan", "exp", "log", "sqrt")},
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
LONGEST_LINE = 4000  # characters

Step = tuple[str, int] | float | str  # operation and how many operands, a number, a name


@frozen(eq=True)
class Formula:
    """One line of a model.

    Attributes
    ----------
    text : str
        As it was written, without the name before the '='.
    steps : tuple of Step
        Its postfix form.
    names : mapping of str to int
        Names in the order in which they first stand, with their character, from 1.
    where, fault : str, type of error
        What an error begins with, and its type.
    """

    text: str
    steps: tuple[Step, ...]
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
    reader.sum(0)
    if reader.kind != "end":
        reader.fail("expected an operator")
    return Formula(text.strip(), tuple(reader.steps), reader.names, where, fault)


class _Reader:
    """The tokens of a line, and the rules of (1), which add steps."""

    def __init__(self, text: str, where: str, offset: int, fault: type[ValueError]) -> None:
        self.text, self.where, self.offset, self.fault = text, where, offset, fault
        self.names: dict[str, int] = {}
        self.steps: list[Step] = []
        self.at = self.end = 0
        self.kind, self.token = "", ""
        if len(text) > LONGEST_LINE:
            self.fail_at(LONGEST_LINE, f"a line has at most {LONGEST_LINE} characters")
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

    def sum(self, depth: int) -> None:
        if depth > _DEEPEST:
            self.fail(f"at most {_DEEPEST} parentheses within each other")
        self._chain("+-", self._product, depth)

    def _product(self, depth: int) -> None:
        self._chain("*/", self._sign, depth)

    def _chain(self, marks: str, inner: Callable[[int], None], depth: int) -> None:
        inner(depth)
        while self.kind == "mark" and self.token in marks:
            operation = _OPERATORS[self.token]
            self.next()
            inner(depth)
            self.steps.append((operation, 2))

    def _sign(self, depth: int) -> None:
        if depth > _DEEPEST:
            self.fail(f"at most {_DEEPEST} signs within each other")
        if self.kind == "mark" and self.token in "+-":
            minus = self.token == "-"
            self.next()
            self._sign(depth + 1)
            if minus:
                self.steps.append(("neg", 1))
            return
        self._atom(depth)
        if self.kind == "mark" and self.token == "^":
            self.next()
            self._sign(depth + 1)
            self.steps.append(("pow", 2))

    def _atom(self, depth: int) -> None:
        kind, token, at = self.kind, self.token, self.at
        if kind == "number":
            self._number(token, at)
        elif kind == "name":
            self._named(token, at, depth)
        elif kind == "mark" and token in "(|":
            self.next()
            self.sum(depth + 1)
            self._close(")" if token == "(" else "|", token, at)
            if token == "|":
                self.steps.append(("fabs", 1))
        else:
            self.fail("expected a number, a name or '('")

    def _number(self, token: str, at: int) -> None:
        self.next()
        value = float(token)
        if math.isinf(value):
            self.fail_at(at, f"{token} is larger than a number can be")
        self.steps.append(value)

    def _named(self, name: str, at: int, depth: int) -> None:
        self.next()
        if self.kind == "mark" and self.token == "(":
            self._call(name, at, depth)
            return
        if name in FUNCTIONS:
            self.fail(f"expected '(' after {name}")
        if name not in CONSTANTS:
            self.names.setdefault(name, self.offset + at + 1)
        self.steps.append(name)

    def _close(self, mark: str, opened: str, at: int) -> None:
        if self.kind != "mark" or self.token != mark:
            self.fail(f"expected '{mark}' for the '{opened}' at character {self.offset + at + 1}")
        self.next()

    def _call(self, name: str, at: int, depth: int) -> None:
        if name not in FUNCTIONS:
            self.fail_at(
                at,
                f"unknown function '{name}'{near(name, FUNCTIONS)} "
                f"There are {', '.join(FUNCTIONS)}; a product is written with '*'",
            )
        opened, count = self.at, 1
        self.next()
        self.sum(depth + 1)
        while self.kind == "mark" and self.token == ",":
            self.next()
            self.sum(depth + 1)
            count += 1
            if name not in UNARY:  # the result so far with each further argument
                self.steps.append((BINARY.get(name) or FOLDED[name], 2))
        self._close(")", "(", opened)
        self._check_count(name, at, count)
        if name in UNARY:
            self.steps.append((UNARY[name], 1))

    def _check_count(self, name: str, at: int, given: int) -> None:
        needs = 1 if name in UNARY else 2
        if given != needs and not (name in FOLDED and given > needs):
            more = " or more" if name in FOLDED else ""
            said = f"{name} takes {needs}{more} argument{'s' * (needs > 1)}, got {given}"
            self.fail_at(at, said)
