"""Terms: products of columns to powers and functions of them, and the formulas that list them.

`parse_terms` reads a formula over any columns; `split_terms` and `parse_term` read the terms of one
output, and `expand_others` and `kind_terms` write out those that stand for several.
`evaluate_terms` gives the design of terms, `linear_term` a bare variable, `largest_value` what
their powers can bear, `formula_columns` the columns that a text uses, and `sees_only` tells whether
a term has no other components than some.

A term is a product such as ``1``, ``x``, ``x^2``, ``x*y``, ``x*|x|``, ``temperature*x``: of the
components x, y, z of a reference in models of a sensor, of any columns in a regression. Terms are
evaluated on components, so the same lines take NumPy arrays and CasADi symbols.

Formulas are parsed, never evaluated: `formula = term ('+' term)*`, `term = factor ('*' factor)*`,
`factor = '1' | form ['^' power]`, where a form is a name or a function of one
(`multipos.numerics.factors`). In models of a sensor `own` is the component along the output's own
axis, and a term of `other` stands for one with each of the others.
"""

import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property, lru_cache
from typing import Any, Literal

import numpy as np

from multipos.errors import UsageError
from multipos.numerics.arrays import COMPONENTS, LARGEST, Array
from multipos.numerics.factors import FUNCTIONS, Factor, function_forms, read_factor, variables_in
from multipos.results import frozen

NamedModel = Literal[
    "linear",
    "own-quadratic",
    "own-cubic",
    "cross-quadratic",
    "ieee",
    "ieee-odd",
    "full-quadratic",
]


class Formula(str):
    """A model as a formula or a line of one's own: a text that type checkers let through.

    Where a model is taken, a checker knows the names, paths and this, so that a misspelt name is
    a type error; when the program runs any text is taken.

    Examples
    --------
    >>> import multipos as mp
    >>> readings = dict(mp.simulate(mp.demo().calibration, "faces-corners-14", seed=1))
    >>> mp.fit(readings, model=mp.Formula("1 + own")).names
    ('bias_ax', 'scale_ax', 'bias_ay', 'scale_ay', 'bias_az', 'scale_az')
    """

    __slots__ = ()


ModelText = NamedModel | Formula | os.PathLike[str]
NAMED: dict[str, str] = {
    "linear": "1 + x + y + z",
    "own-quadratic": "1 + x + y + z + own^2",
    "own-cubic": "1 + x + y + z + own^2 + own^3",
    "cross-quadratic": "1 + x + y + z + own^2 + own*other",
    "ieee": "1 + x + y + z + own^2 + own^3 + own*other",
    "ieee-odd": "1 + x + y + z + own^2 + own^3 + own*other + own*|own|",
    "full-quadratic": "1 + x + y + z + x^2 + y^2 + z^2 + x*y + x*z + y*z",
}
_LARGEST_POWER = 100.0  # log10 of what a term may reach: its square is a number still
_OTHER = re.compile(r"\bother\b")
HIGHEST_POWER = 9  # beyond it a term of specific force within 1 g says nothing new


@frozen(eq=True)
class Term:
    """A product of factors in alphabetical order; no factor is the constant ``1``."""

    factors: tuple[Factor, ...] = ()

    def __str__(self) -> str:
        return "*".join(map(str, self.factors)) or "1"

    @cached_property
    def force_degree(self) -> int:
        """Degree in specific force: 0 for a bias, 1 for a scale factor, 2 for second order."""
        return sum(factor.degree for factor in self.factors if factor.variable in COMPONENTS)

    @cached_property
    def along(self) -> str | None:
        """The component of specific force that it is proportional to, if it is to one."""
        force = [factor for factor in self.factors if factor.variable in COMPONENTS]
        if len(force) == 1 and force[0] == Factor(force[0].variable, 1):
            return force[0].variable
        return None

    def turned(self, axis: str) -> "Term":
        """Return the term that is along another axis."""
        mine = next(factor for factor in self.factors if factor.variable == self.along)
        rest = (factor for factor in self.factors if factor is not mine)
        return Term(tuple(sorted((*rest, Factor(axis, 1)))))

    @property
    def environment(self) -> tuple[tuple[str, int], ...]:
        """Other columns of the readings in the term, with their degrees."""
        return tuple((f.variable, f.degree) for f in self.factors if f.variable not in COMPONENTS)

    def evaluate(self, variables: Mapping[str, Any]) -> Any:
        """Return the term's value on components: arrays, floats or CasADi symbols."""
        value: Any = 1.0
        for factor in self.factors:
            v = variables[factor.variable]
            for _ in range(factor.power):
                value = value * v
            if factor.function:
                value = value * FUNCTIONS[factor.function].value(v)
        return value

    def derivative(self, variables: Mapping[str, Any], by: str) -> Any:
        """Return the partial derivative by one variable, (m + d) v^(m-1) g(v)."""
        mine = next((factor for factor in self.factors if factor.variable == by), None)
        if mine is None:
            return 0.0
        rest = tuple(factor for factor in self.factors if factor is not mine)
        if not mine.power:
            slope = FUNCTIONS[mine.function].slope(variables[by])
            return slope * Term(rest).evaluate(variables)
        return mine.degree * self.lowered(mine).evaluate(variables)

    def lowered(self, factor: Factor) -> "Term":
        """Return the term with one power of a factor less, which has a power to lose."""
        lower = Factor(factor.variable, factor.power - 1, factor.function)
        others = tuple(lower if other is factor else other for other in self.factors)
        return Term(tuple(other for other in others if other.is_variable))


CONSTANT = Term()


def evaluate_terms(terms: Sequence[Term], columns: Mapping[str, Array], n: int) -> Array:
    """Return the design (n, q) of terms; powers by repeated multiplication, each rounded once."""
    design = np.empty((n, len(terms)))
    for column, term in enumerate(terms):
        design[:, column] = term.evaluate(columns)
    return design


def largest_value(terms: Iterable[Term], variable: str) -> float:
    """Return how large a variable may be for its powers in terms to be squared and summed."""
    factors = (factor for term in terms for factor in term.factors)
    degree = max((1, *(f.degree for f in factors if f.variable == variable)))
    return min(LARGEST, math.pow(10.0, _LARGEST_POWER / degree))


def linear_term(variable: str) -> Term:
    """Return the bare variable as a term."""
    return Term((Factor(variable, 1),))


def parse_terms(text: str, *, highest: int = HIGHEST_POWER) -> tuple[Term, ...]:
    """Return the terms of a formula over any columns, in order, each once.

    Raises
    ------
    UsageError
        The formula cannot be read, or a power is above `highest`.
    """
    # With 'own' for the own axis, a column of that name stays what it is.
    parts = split_terms(text, text)
    return tuple(dict.fromkeys(parse_term(part, text, "own", highest) for part in parts))


def formula_columns(text: str) -> tuple[str, ...]:
    """Return the columns other than x, y, z and own that a model's text uses."""
    name = text.strip()
    if name in NAMED:
        return ()
    used = variables_in(name)
    return tuple(dict.fromkeys(v for v in used if v not in (*COMPONENTS, "own", "other")))


def sees_only(term: Term, inputs: tuple[str, ...]) -> bool:
    """Tell whether a term has no other components than these."""
    return all(f.variable in inputs for f in term.factors if f.variable in COMPONENTS)


def expand_others(parts: Iterable[str], axis: str, inputs: Sequence[str]) -> list[str]:
    """Write out terms of `other` for each component that is not the own one and is seen."""
    others = [other for other in inputs if other != axis]
    result = []
    for part in parts:
        made = [_OTHER.sub(other, part) for other in others] if _OTHER.search(part) else [part]
        result += made
    return result


@lru_cache(maxsize=128)
def kind_terms(kind: str, axis: str, inputs: tuple[str, ...]) -> tuple[Term, ...]:
    """Return the terms of a kind, such as `own*other`, for an output of an axis."""
    return tuple(parse_term(part, kind, axis) for part in expand_others([kind], axis, inputs))


def split_terms(formula: str, text: str) -> list[str]:
    """Return the terms of a formula as they are written; `text` is the model in messages."""
    parts = [part.strip() for part in formula.split("+")]
    if any(not part for part in parts):
        raise UsageError(f"model '{text}': a term is missing next to a '+'.")
    return parts


def parse_term(part: str, text: str, axis: str, highest: int = HIGHEST_POWER) -> Term:
    """Parse ``x*|own|`` for the output whose own axis is given."""
    exponents: dict[str, dict[str, int]] = {}  # by variable and function, '' for the bare one
    for factor in map(str.strip, part.split("*")):
        if factor != "1":
            name, function, power = _read_power(factor, part, text, highest)
            counts = exponents.setdefault(axis if name == "own" else name, {})
            counts[function] = counts.get(function, 0) + power
    factors = [_product(name, counts, text) for name, counts in sorted(exponents.items())]
    for f in factors:
        if f.power > highest:
            raise UsageError(
                f"model '{text}': the power of {f.variable} in '{part.strip()}' must lie between 1 "
                f"and {highest}."
            )
    return Term(tuple(factor for factor in factors if factor.is_variable))


def _read_power(factor: str, part: str, text: str, highest: int) -> tuple[str, str, int]:
    """Return variable, function and power of ``|x|^2`` in a term."""
    read = read_factor(factor)
    if read is None:
        forms = ", ".join(["own", *function_forms("own")])
        raise UsageError(
            f"model '{text}': cannot read '{factor or part}'; a term is a product of "
            f"1, x, y, z, {forms} and column names, each with ^power."
        )
    name, function, digits = read
    digits = digits or "1"
    # a number of more digits is above the highest, however many int() would take
    power = int(digits) if len(digits) <= len(str(highest)) else highest + 1
    if not 1 <= power <= highest:
        raise UsageError(
            f"model '{text}': the power in '{factor}' must lie between 1 and {highest}."
        )
    return name, function, power


def _product(name: str, exponents: dict[str, int], text: str) -> Factor:
    """Multiply the powers of a variable and of functions of it into one factor."""
    power, left = 0, []
    for function, count in exponents.items():
        if not function:
            power += count
            continue
        pairs, odd = divmod(count, 2)  # g^2 = v^(2d), so at most one g stays
        power += 2 * FUNCTIONS[function].degree * pairs
        left += [function] * odd
    if len(left) > 1:
        both = " and ".join(FUNCTIONS[function].form.format(name) for function in left)
        raise UsageError(f"model '{text}': {both} stand in one term; keep one of them.")
    return Factor(name, power, *left)
