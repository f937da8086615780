"""Formulas: sensible ones, ones that nearly are, and sizes that nobody writes by hand."""

import random

from . import hostile
from .hostile import listed

NAMED = listed("linear own-quadratic own-cubic cross-quadratic ieee ieee-odd full-quadratic")
OF_SENSORS = ("x", "y", "z", "own", "|x|", "|own|", "temperature")
OF_DATA = ("T", "H", "T_rate", "|T|")
TOKENS = (
    *listed(
        "x own other |own| temperature T H T_rate ax time y 1 0 + * | ^ 2 9 10 99999999999 ( )"
    ),
    *listed("9223372036854775808 __class__ (). lambda - / 1.5 é x^-1 x^0 ２ x^２ OWN*OTHER ++ **"),
    *("", " ", "\n", ";", "own own", "`id`", "=", "each = b + s*own", "sin(x)"),
)


def _sensible(rng: random.Random, factors: tuple[str, ...]) -> str:
    terms = ["1"] if rng.random() < 0.8 else []
    for _ in range(rng.randrange(1, 7)):
        chosen = rng.choices(factors, k=rng.choice((1, 1, 1, 2, 3)))
        power = rng.choices(("", "^2", "^3", f"^{rng.randrange(40)}"), (20, 4, 4, 1))[0]
        terms.append("*".join(chosen) + power)
    return " + ".join(terms)


def _tokens(rng: random.Random, _: tuple[str, ...]) -> str:
    return rng.choice(("", " ")).join(rng.choices(TOKENS, k=rng.randrange(1, 12)))


def _damaged(rng: random.Random, factors: tuple[str, ...]) -> str:
    formula = _sensible(rng, factors)
    at = rng.randrange(len(formula) + 1)
    return formula[:at] + rng.choice(TOKENS) + formula[at + rng.randrange(2) :]


def _large(rng: random.Random, _: tuple[str, ...]) -> str:
    n = rng.choice((20, 50, 500, 3000))
    sums = (
        ["x*y"] * n,
        [f"a{i}" for i in range(n)],
        [f"x^{i % 9 + 1}*y^{i // 9 % 9 + 1}" for i in range(n)],
        [f"temperature^{i % 9 + 1}*x^{i // 9 % 9}" for i in range(n)],
        [f"T^{i + 1}" for i in range(n)],
    )
    texts = ("*".join(["x"] * n), "(" * n, "|" * n, "x^" + "9" * n, "x^1" * n, "+" * n, "１" * n)
    return " + ".join(rng.choice(sums)) if rng.random() < 0.5 else rng.choice(texts)


def draw(rng: random.Random, factors: tuple[str, ...] = OF_SENSORS) -> str:
    """Return a formula or the name of a model, as it would stand on the command line."""
    draw = rng.random()
    if draw < 0.1:
        return rng.choice(NAMED)
    if draw < 0.15:
        return hostile.text(rng)
    made = rng.choices((_sensible, _damaged, _tokens, _large), (5, 3, 2, 1))[0]
    return made(rng, factors)
