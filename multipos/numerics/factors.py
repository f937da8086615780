"""Factors: a variable to a power, times a function of it.

`read_factor` takes a factor of a formula apart, `variables_in` names the variables of a formula,
and `function_forms` the functions that may be written. `factor_to_list` and `factor_from_list` are
what JSON holds of a `Factor`.

    v^m g(v),    |g(v)| = |v|^d    wherever v is not zero                                  (1)

Powers are repeated multiplications. Every function g that may stand beside one is an entry of
`FUNCTIONS`, and all that is to be known of it stands there: its value and slope, how formulas, JSON
and C write it. From (1) follow what the rest needs: the derivative (m + d) v^(m-1) g(v), the square
v^(2d), and the mean over the sphere, which is that of |v|^(m+d), or zero where m and g together
are odd.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np


class Code(NamedTuple):
    """A function in C: {v} is the variable, {zero} and {one} are numbers in the precision."""

    prefix: str  # of the constant that holds its value, before the variable
    value: str


class Function(NamedTuple):
    """A function g of eq. (1)."""

    form: str  # in a formula, {} is the variable
    json: bool | str  # third entry of a factor; false is a power alone
    degree: int  # d
    is_odd: bool  # whether g(-v) = -g(v)
    value: Callable[[Any], Any]  # of arrays, floats and CasADi symbols
    slope: Callable[[Any], Any]
    code: Code | None  # None where the C file has no form for it


MODULUS = "modulus"
FUNCTIONS = {
    MODULUS: Function(
        form="|{}|",
        json=True,
        degree=1,
        is_odd=False,
        value=abs,
        slope=np.sign,
        code=Code("a", "{v} < {zero} ? -{v} : {v}"),
    ),
}
_NAME = r"[^\W\d]\w*"


@dataclass(frozen=True, order=True)
class Factor:
    """A variable to a power, times a function of it by its name in `FUNCTIONS`, '' for none.

    Raises
    ------
    ValueError
        No such function.
    """

    variable: str
    power: int
    function: str = ""

    def __post_init__(self) -> None:
        if self.function and self.function not in FUNCTIONS:
            known = ", ".join(FUNCTIONS)
            raise ValueError(f"unknown function '{self.function}' in a factor; there is {known}.")

    def __str__(self) -> str:
        parts = []
        if self.power:
            parts.append(self.variable if self.power == 1 else f"{self.variable}^{self.power}")
        if self.function:
            parts.append(FUNCTIONS[self.function].form.format(self.variable))
        return "*".join(parts)

    @property
    def degree(self) -> int:
        """Power, with that of the function."""
        return self.power + (FUNCTIONS[self.function].degree if self.function else 0)

    @property
    def is_variable(self) -> bool:
        """Whether it is not 1."""
        return bool(self.power or self.function)

    @property
    def is_odd(self) -> bool:
        """Whether it changes sign with its variable."""
        turns = bool(self.function) and FUNCTIONS[self.function].is_odd
        return (self.power + turns) % 2 == 1


def function_forms(variable: str) -> list[str]:
    """Return the functions of a variable as formulas write them."""
    return [function.form.format(variable) for function in FUNCTIONS.values()]


def read_factor(text: str) -> tuple[str, str, str] | None:
    """Return variable, function and exponent ('' for none) of ``|x|^2``; None where it is none."""
    match = _pattern().fullmatch(text)
    return None if match is None else _parts(match)


def variables_in(text: str) -> list[str]:
    """Return the variables of the factors in a formula, in order, each time they stand there."""
    return [_parts(match)[0] for match in _pattern().finditer(text)]


def factor_to_list(factor: Factor) -> list[Any]:
    """Return what JSON holds of a factor: variable, power, and what stands for its function."""
    function = FUNCTIONS[factor.function].json if factor.function else False
    return [factor.variable, factor.power, function]


def factor_from_list(entry: list[Any]) -> Factor:
    """Return the factor that `factor_to_list` described.

    Raises
    ------
    ValueError
        A function that is not known.
    """
    variable, power, function_name = entry
    if function_name is False:
        return Factor(variable, power)
    named = [name for name, function in FUNCTIONS.items() if function.json == function_name]
    if not named:
        raise ValueError(
            f"a factor of '{variable}' has a function that is not known, '{function_name}'"
        )
    return Factor(variable, power, *named)


def _pattern() -> re.Pattern[str]:
    forms = []
    for name, function in FUNCTIONS.items():
        before, after = map(re.escape, function.form.split("{}"))
        forms.append(rf"{before}\s*(?P<{name}>{_NAME})\s*{after}")
    forms.append(rf"(?P<alone>{_NAME})")
    return re.compile(rf"(?:{'|'.join(forms)})(?:\s*\^\s*(?P<exponent>\d+))?")


def _parts(match: re.Match[str]) -> tuple[str, str, str]:
    function = next((name for name in FUNCTIONS if match[name]), "")
    return match[function or "alone"], function, match["exponent"] or ""
