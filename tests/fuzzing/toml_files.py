"""Damage to TOML files: budgets and what a laboratory states."""

import random
from collections.abc import Callable

from . import hostile, raw
from .hostile import listed

Lines = list[str]
Mutator = Callable[[random.Random, Lines], Lines]

KEYS = (
    *listed(
        "u U u_deg U_deg k dof value step half_width half_width_deg distribution harmonics axis"
    ),
    *listed("each_output latitude_deg height_m name x bias_per_degC number issued serial 1 a.b"),
    *listed("each ax start sd low high unit rms b common_k own"),
    *('"own^2"', '""', '"a b"'),
)
SECTIONS = (
    *listed("[gravity] [level] [orientation] [index] [gain] [resolution] [temperature] [unseen]"),
    *listed('[third_order] [voltmeter] [x] [[level]] [level.x] [""] [report] [laboratory] [ ='),
    *("[customer]", "[item]", "[measurement]", "report = 5", "level = 3"),
    *("[parameters]", "[outputs]", "[parameters.b]", "outputs = 3", 'outputs = "b*own"'),
)
VALUES = (
    *listed('true false "x" "" [] [0] [-1] [1000000] [1.5] ["x"] {a=1} {} 1979-05-27 07:32:00 "z"'),
    *listed('1979-05-27T07:32:00Z "rectangular" "triangular" "normal" "u-shaped" "*/" "a|b" 0x10'),
    *("[1, 2]", "[1000000000000000000000]", '"""\n<b>&\n"""', '"\\u001b[31m"', '"a\\nb"', "1_000"),
    *("'</style><script>alert(1)</script>'", "+1", "0o7", "[[[[[]]]]]", "[" * 5000, "1e400"),
    *("9" * 400, "9" * 5000, "[0.98, inf]", "[nan, 1]", "[2, 1]", '"b + s*own"', '"b"', '"own"'),
    *("{start = 1, sd = 0}", "{start = nan}", "{low = 1, high = 1}", "{start = 5, high = 2}"),
    *('"exp(exp(exp(b)))*own"', '"b/0"', '"sqrt(-1)"', '"atan2(own"', '"b+s*own+b/(s-s)"', "inf"),
)


def _value(rng: random.Random) -> str:
    draw = rng.random()
    if draw < 0.25:
        return rng.choice(VALUES)
    if draw < 0.75:
        return rng.choice(hostile.PLAIN_NUMBERS + hostile.EXTREME_NUMBERS)
    if draw < 0.9:
        return hostile.number(rng)
    quoted = hostile.text_with_controls(rng).encode("unicode_escape").decode().replace('"', '\\"')
    return f'"{quoted}"'


def _line(rng: random.Random, lines: Lines) -> int:
    return rng.randrange(len(lines))


def _replace_value(rng: random.Random, lines: Lines) -> Lines:
    i = rng.choice([i for i, line in enumerate(lines) if "=" in line] or [0])
    return [*lines[:i], f"{lines[i].split('=')[0]}= {_value(rng)}", *lines[i + 1 :]]


def _add_value(rng: random.Random, lines: Lines) -> Lines:
    i = _line(rng, lines)
    return [*lines[: i + 1], f"{rng.choice(KEYS)} = {_value(rng)}", *lines[i + 1 :]]


def _rename_key(rng: random.Random, lines: Lines) -> Lines:
    i = rng.choice([i for i, line in enumerate(lines) if "=" in line] or [0])
    rest = lines[i].partition("=")[2]
    return [*lines[:i], f"{rng.choice(KEYS)} ={rest}", *lines[i + 1 :]]


def _drop_line(rng: random.Random, lines: Lines) -> Lines:
    i = _line(rng, lines)
    return lines[:i] + lines[i + 1 :]


def _repeat_line(rng: random.Random, lines: Lines) -> Lines:
    i = _line(rng, lines)
    return lines[: i + 1] + lines[i:]


def _add_section(rng: random.Random, lines: Lines) -> Lines:
    i = _line(rng, lines)
    return [*lines[:i], rng.choice(SECTIONS), *lines[i:]]


def _rename_section(rng: random.Random, lines: Lines) -> Lines:
    i = rng.choice([i for i, line in enumerate(lines) if line.startswith("[")] or [0])
    return [*lines[:i], rng.choice(SECTIONS), *lines[i + 1 :]]


def _only_one_section(rng: random.Random, lines: Lines) -> Lines:
    i = rng.choice([i for i, line in enumerate(lines) if line.startswith("[")] or [0])
    end = next((j for j in range(i + 1, len(lines)) if lines[j].startswith("[")), len(lines))
    return lines[i:end]


# How often each is drawn.
MUTATORS: tuple[Mutator, ...] = (  # each as often as it stands here
    *(_replace_value, _replace_value, _replace_value, _replace_value, _replace_value),
    *(_replace_value, _replace_value, _replace_value, _add_value, _add_value, _rename_key),
    *(_drop_line, _repeat_line, _add_section, _rename_section, _only_one_section),
)


def mutate(rng: random.Random, data: bytes) -> bytes:
    """Return a TOML document with one to three lines changed, now and then damaged as bytes."""
    lines = data.decode().splitlines()
    for _ in range(rng.choice((1, 1, 2, 3))):
        if lines:
            lines = rng.choice(MUTATORS)(rng, lines)
    changed = ("\n".join(lines) + "\n").encode("utf-8", "surrogatepass")
    return raw.damage(rng, changed) if rng.random() < 0.1 else changed
