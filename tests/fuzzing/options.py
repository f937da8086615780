"""Options drawn from the parser of each command, so that a new one is tried without a word here.

What an option takes is learnt by trying its type: a whole number, a number, several, names, or any
text. Plausible words come from its own help and metavar ("huber, soft-l1 or cauchy"), from the
files of the case and from names of columns and schemes; the rest is hostile.
"""

import argparse
import functools
import random
import re
from collections.abc import Callable

from multipos.cli import command_parser

from . import formulas, hostile
from .hostile import listed

COLUMNS = listed(
    "ax ay az a4 time temperature T H y T_rate position direction up_x n 1 2 x z -x AX group"
)
SCHEMES = (
    *listed(
        "faces-6 song-qin-6 all-26 faces-6+corners-8 tumble-24 roll-x-8 dual-axis-48 FACES-6 . +"
    ),
    *listed("fibonacci-7 fibonacci-1 fibonacci-0 fibonacci--3 fibonacci-٣ tumble-1e3 tumble-999"),
    *("faces-6+", "roll-x-" + "9" * 20, "nope", "/dev/null"),
)
TERMS = listed(
    """
    ax:x ax:1 ay:x^2 az:own u:ax:x u:q:1 u: ax : T:10,20 T:auto T:20,10 T: q:1 T:nan time:50,100
    T:1e308
    """
)
# What -o may name: an ending of every kind, and places that cannot be written.
OUTPUTS = listed(
    """
    o o.json o.csv o.md o.txt o.c o.params o.parm o.yaml o.dat o.JSON o.xml o.xlsx o.parquet -o.txt
    o.c.c
    """
)
DRAWN_OUTPUTS = ("o.svg", "o.png", "o.pdf", "o.html")  # seconds, some of them
LARGE_ODDS = 0.02  # of a whole number that asks for much work


@functools.cache
def actions(command: str) -> tuple[argparse.Action, ...]:
    """The options of a command, without --help, the positional arguments and -o."""
    return tuple(
        action
        for action in command_parser(command)._actions
        if action.option_strings and action.dest not in ("help", "output")
    )


def draw(rng: random.Random, command: str, files: tuple[str, ...]) -> list[str]:
    """One option of the command with a value, as words of the command line."""
    action = rng.choice(actions(command))
    name = rng.choice(action.option_strings)
    if action.nargs == 0:
        return [name]
    value = _value(rng, action, files)
    return [f"{name}={value}"] if value.startswith("-") or rng.random() < 0.2 else [name, value]


def _value(rng: random.Random, action: argparse.Action, files: tuple[str, ...]) -> str:
    if rng.random() < 0.1:
        return hostile.text(rng)
    return _SORTS[_sort(action)](rng, action, files)


def _sort(action: argparse.Action) -> str:
    """What an option takes, by what its type makes of a number."""
    if action.type is None or not callable(action.type):
        return "text"
    try:
        made = action.type("2")
    except (ValueError, TypeError, argparse.ArgumentTypeError):
        return "text"
    if isinstance(made, int | float):
        return "integer" if isinstance(made, int) else "number"
    if isinstance(made, tuple | list) and made:
        return "numbers" if isinstance(made[0], int | float) else "names"
    return "text"


def _integer(rng: random.Random, action: argparse.Action, files: tuple[str, ...]) -> str:
    draw = rng.random()
    if draw < LARGE_ODDS:  # a trial may be a fit, and a million are done if they are asked for
        most = () if action.dest == "monte_carlo" else (5000, 10**6)
        return str(rng.choice((*most, 10**9, 2**31, 2**63, 10**30)))
    if draw < 0.7:
        return str(rng.choice((-1, 0, 1, 2, 3, 4, 5, 6, 7, 9, 12, 20, 60)))
    value = hostile.number(rng)
    return value if not value.isdecimal() or len(value) > 12 else value[:2]


def _number(rng: random.Random, action: argparse.Action, files: tuple[str, ...]) -> str:
    draw = rng.random()
    if draw < 0.5:
        return rng.choice(hostile.PLAIN_NUMBERS)
    if draw < 0.6:
        return rng.choice(_words(action))
    return hostile.number(rng)


def _numbers(rng: random.Random, action: argparse.Action, files: tuple[str, ...]) -> str:
    return ",".join(_number(rng, action, files) for _ in range(rng.choice((1, 1, 2, 3, 3, 4))))


def _names(rng: random.Random, action: argparse.Action, files: tuple[str, ...]) -> str:
    if rng.random() < 0.2:
        return ",".join(rng.sample("xyz", rng.choice((1, 2, 3))))
    return ",".join(rng.choices(COLUMNS, k=rng.choice((1, 1, 2, 3, 3, 4))))


def _text(rng: random.Random, action: argparse.Action, files: tuple[str, ...]) -> str:
    named = (action.metavar or "").split("|") if isinstance(action.metavar, str) else []
    if len(named) > 1 and rng.random() < 0.6:
        return rng.choice(named)
    if rng.random() < 0.2:
        return rng.choice((formulas.draw, hostile.text, hostile.number))(rng)
    pools = (_words(action), files, COLUMNS, SCHEMES, TERMS)
    return rng.choice(rng.choices(pools, (3, 1, 1, 1, 1))[0])


_SORTS: dict[str, Callable[[random.Random, argparse.Action, tuple[str, ...]], str]] = {
    "integer": _integer,
    "number": _number,
    "numbers": _numbers,
    "names": _names,
    "text": _text,
}


@functools.cache
def _words(action: argparse.Action) -> tuple[str, ...]:
    """The words of an option's help, metavar and default: its choices are among them."""
    said = f"{action.help or ''} {action.metavar or ''}"
    words = re.findall(r"[A-Za-z0-9][A-Za-z0-9^*_.:-]*[A-Za-z0-9]|[A-Za-z0-9]", said)
    chosen = [str(choice) for choice in action.choices or ()]
    return tuple(dict.fromkeys([*chosen, str(action.default), *words]))


def output(rng: random.Random, inputs: tuple[str, ...]) -> str:
    """A name for -o: of every ending, now and then one of the inputs."""
    draw = rng.random()
    if draw < 0.03:
        return rng.choice(DRAWN_OUTPUTS)
    if draw < 0.15 and inputs:
        return rng.choice(inputs)
    return rng.choice(OUTPUTS)
