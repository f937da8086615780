"""Values that nobody expects: numbers at the ends of their range, texts that mean something else.

Nothing here names a place outside the folder of the case: what is drawn may end up behind ``-o``.
"""

import random


def listed(text: str) -> tuple[str, ...]:
    """The words of a text: how long lists are written here."""
    return tuple(text.split())


PLAIN_NUMBERS = ("0", "1", "2", "3", "5", "0.5", "0.01", "0.001", "0.95", "9.81", "20", "100", "-1")

EXTREME_NUMBERS = listed(
    """
    nan -nan inf -inf 1e308 -1e308 1.8e308 5e-324 1e-310 1e-300 1e300 1e155 1e-155 1e30 1e-30 1e16
    1e9 -0 1e400 1e-400 2147483647 2147483648 -2147483649 9223372036854775807 9223372036854775808
    18446744073709551616 0.9999999999999999 1.0000000000000002 90 180 360 -273.15
    """
)

NEAR_NUMBERS = (
    *("", " ", "1 2", "1 g"),
    *listed("1_000 0x10 1,5 1.5.2 --1 +5 1d3 1e e5 . - ١٢ １ ½ 1;2 True None null NaN Infinity 1%"),
    *listed("−1 '1 =1+1"),
)

TEXTS = (
    *("", " ", "a b", "*/ int evil; /*", "import os", "# x", "{% raw %}", "\ufeff", "\u2028"),
    *listed('x - ax nan 0 own 1 a,b , ; \' " "a""b" =cmd() <script>alert(1)</script> a|b'),
    *listed("</style><b> `id` $(id) %s%n%d {0} {{7*7}} \\ \\n a\\ 日本 é e\u0301 \u202e 😀 ß ǅ 𝟏"),
    *listed("__class__ ../x x/y . .. ~ CON null # // [x] {} &amp; $x$ \\frac{1}{0} $\\alpha"),
)

CONTROL_TEXTS = (
    *("\n", "\t", "\x07", "\x7f", "\x85", "\x1c", "a\nb", "a\r\nb", "a\tb", "a\x0bb"),
    *("\x1b[31mred", "\x1b]0;title\x07", "x\n#include <stdio.h>", "x\nPARAM 1"),
)


def number(rng: random.Random) -> str:
    """A number as text, mostly one that strains what reads it."""
    draw = rng.random()
    if draw < 0.2:
        return rng.choice(PLAIN_NUMBERS)
    if draw < 0.55:
        return rng.choice(EXTREME_NUMBERS)
    if draw < 0.75:
        return rng.choice(NEAR_NUMBERS)
    if draw < 0.85:
        return f"{rng.uniform(-10, 10):.6g}e{rng.randrange(-330, 310)}"
    if draw < 0.95:
        return repr(rng.choice((-1, 1)) * 2.0 ** rng.randrange(-60, 70))
    return rng.choice("-19") + rng.choice("09") * rng.choice((30, 400, 5000))


def text(rng: random.Random) -> str:
    """A text, mostly short, that means something to one of those who handle it."""
    draw = rng.random()
    if draw < 0.7:
        return rng.choice(TEXTS)
    if draw < 0.8:
        return number(rng)
    if draw < 0.9:
        last = rng.choice((0x7F, 0x2FFF))
        return "".join(chr(rng.randrange(0x21, last)) for _ in range(rng.randrange(1, 12)))
    return rng.choice("aZ9é ") * rng.choice((50, 300, 5000))


def text_with_controls(rng: random.Random) -> str:
    """A text for files, where control characters can stand too."""
    return rng.choice(CONTROL_TEXTS) if rng.random() < 0.3 else text(rng)
