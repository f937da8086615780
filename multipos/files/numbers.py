"""Numbers and tables as people read them: ``0.99647(74)`` and aligned columns.

`uncertain` and `beside` show a value with its u or U, `number`, `plain_number`, `fixed` and
`in_unit` one alone, to the `decimals_of` its u; `chance` and `p_in_words` a probability.
`readable_unit`, `common_units` and `pretty_unit` choose and print units, by the size that `most_of`
gives; `beyond_rounding` leaves rounding out. `table`, `markdown_table`, `largest_rows` and
`columns_of` lay out rows, `titled`, `markdown_text` and `markdown_line` text.

The digits in brackets are the standard uncertainty in units of the last digits shown, two of
them (JCGM 100, 7.2.2); a value without a usable uncertainty is shown with ten digits.
"""

import heapq
import math
import re
import sys
import unicodedata
from collections.abc import Iterable, Sequence

from multipos.files.spelling import visible

_SHORTEST = -5  # decimal exponents below this are written as such
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_RATIO = 0.01  # ratios below are read in ppm
_SHORT, _RARE = 1e-4, 1e-6  # of probabilities: below, a text says only that
_ROUNDING = 1e-13  # an uncertainty below, in a unit that people read, is that of the arithmetic
_PREFIXES = {"k": 3, "": 0, "m": -3, "µ": -6, "n": -9}
# exponents that people still read
_SMALLEST = {"T": -9, "G": -3, "g": -6, "V": -9, "A": -9, "rad": -6, "m": -6}


def uncertain(value: float, u: float) -> str:
    """Return a value with its standard uncertainty, as in ``-0.00079(52)``."""
    if not (math.isfinite(value) and math.isfinite(u) and u >= sys.float_info.min):
        return _plain(value)  # of fewer than 53 bits two digits are none
    exponent = 0
    largest = max(abs(value), u)
    if math.log10(largest) < _SHORTEST or math.log10(u) >= 6:
        exponent = math.floor(math.log10(largest))
    scaled, scaled_u = value / 10.0**exponent, u / 10.0**exponent
    decimals = 1 - math.floor(math.log10(scaled_u))
    if round(scaled_u * 10.0**decimals) >= 100:  # 0.0996 has become 0.10
        decimals -= 1
    digits = round(scaled_u * 10.0**decimals)
    if decimals > 0:
        text = f"{scaled:.{decimals}f}({digits})"
    else:
        unit = 10**-decimals
        text = f"{round(scaled / unit) * unit}({digits * unit})"
    return text if not exponent else f"{text}e{exponent:+03d}"


def _plain(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.10g}"


def beside(value: float, u: float, U: float) -> tuple[str, str]:
    """Return a value and its U to the digits that u supports, both without exponent.

    Two digits of u decide; without a usable one ten digits are shown, and no U.
    """
    decimals = decimals_of(u)
    if decimals is None or not math.isfinite(value):
        return _plain(value), "-"
    shown = f"{U:.{decimals}f}" if math.isfinite(U) else "-"
    return f"{value:z.{decimals}f}", shown


def readable_unit(size: float, unit: str) -> tuple[float, str]:
    """Return the unit that people read a quantity of this size in, and its factor.

    A prefix before g, V, A, rad and m/s², ppm for small ratios, ° for degrees: (1e3, 'mg/°C') for
    .02 g/degC. Any other unit stays.
    """
    factor, shown = _scaled_unit(size, unit)
    return factor, pretty_unit(shown)


def common_units(sizes: Iterable[tuple[str, float]]) -> dict[str, tuple[float, str]]:
    """Return of each unit the one that people read its largest size in, as `readable_unit`."""
    largest: dict[str, float] = {}
    for unit, size in sizes:
        largest[unit] = max(largest.get(unit, 0.0), abs(size) if math.isfinite(size) else 0.0)
    return {unit: readable_unit(size, unit) for unit, size in largest.items()}


def most_of(value: float, U: float) -> float:
    """Return the size in whose unit a value and its U are read."""
    return max((size for size in (abs(value), U) if math.isfinite(size)), default=0.0)


def beyond_rounding(value: float, scale: float = 1.0) -> float:
    """Return a value, and 0 for one that is the rounding of numbers of size `scale`."""
    return 0.0 if abs(value) <= _ROUNDING * scale else value


def pretty_unit(unit: str) -> str:
    """Return a unit as it is printed: V/g² and not V/g^2, °C and not degC."""
    unit = re.sub(r"\bdeg(C?)\b", r"°\1", re.sub(r"\buT\b", "µT", unit))
    return re.sub(r"(?<=[A-Za-z])\^(\d)(?!\d)", lambda m: m[1].translate(SUPERSCRIPT), unit)


def _scaled_unit(size: float, unit: str) -> tuple[float, str]:
    head, slash, per = unit.partition("/")
    of_force = (head, per.partition("/")[0]) == ("g", "g")
    if of_force or (head == "1" and not per.startswith("g")):
        rest = per.partition("/")[2] if of_force else per
        below = f"/{rest}" if rest else ""
        small = 0.0 < size < _RATIO
        return (1e6, f"ppm{below}") if small else (1.0, f"1{below}")
    found = re.fullmatch("([kmuµn]?)(g|V|A|rad|T|G)", head)
    own, base = (found[1], found[2]) if found else ("", head)
    if base not in _SMALLEST or (base == "m" and not per.startswith("s^2")):
        return 1.0, unit
    exponent = shown = _PREFIXES["µ" if own == "u" else own]
    while 0.0 < size * 10.0 ** (exponent - shown) < 1.0 and shown > _SMALLEST[base]:
        shown -= 3
    prefix = next(name for name, power in _PREFIXES.items() if power == shown)
    return 10.0 ** (exponent - shown), f"{prefix}{base}{slash}{per}"


def in_unit(size: float, unit: str) -> str:
    """Return a size to three digits in a unit that people read: 2 mg."""
    size = beyond_rounding(size)
    factor, shown = readable_unit(abs(size), unit)
    said = f"{float(f'{size * factor:.3g}'):g}"
    return f"{said}°" if shown == "°" else f"{said} {shown}".rstrip()


def plain_number(value: float | None, digits: int = 3) -> str:
    """Return a number to so many digits without exponent; nothing where there is none."""
    if value is None or not math.isfinite(value) or value == 0.0:
        return number(value)
    rounded = float(f"{value:.{digits - 1}e}")
    exponent = math.floor(math.log10(abs(rounded)))
    if not _SHORTEST <= exponent <= -2 * _SHORTEST:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(0, digits - 1 - exponent)}f}"


def chance(p: float | None) -> str:
    """Return a probability to two digits, or six decimals; of the smallest only that it is."""
    if p is None or not 0.0 <= p < _SHORT:
        return plain_number(p, 2)
    return f"{p:.6f}" if p >= _RARE else "< 1e-6"


def p_in_words(p: float | None) -> str:
    """Return a probability as a text says it: p = 0.05, p < 1e-6."""
    said = chance(p)
    return f"p {said}" if said.startswith("<") else f"p = {said}"


def fixed(value: float, decimals: int, *, signed: bool = False) -> str:
    """Return a number to so many decimals, zero without a sign; others with one where asked."""
    rounded = round(value, decimals) + 0.0
    return f"{'+' if signed and rounded > 0.0 else ''}{rounded:.{decimals}f}"


def decimals_of(u: float) -> int | None:
    """Return the decimals that two digits of an uncertainty need; None where it has none."""
    if not (math.isfinite(u) and u > _ROUNDING):
        return None
    return max(0, 1 - math.floor(math.log10(float(f"{u:.1e}"))))


def number(value: float | None, digits: int = 4) -> str:
    """Return a number with so many significant digits; nothing where there is none."""
    if value is None or math.isnan(value):
        return "-"
    return "inf" if math.isinf(value) else f"{value:.{digits}g}"


def largest_rows(sizes: Sequence[float], shown: int) -> list[int]:
    """Return the rows of a long table to show, the largest first; of a shorter one all, in order.

    NaN counts as the largest.
    """
    if len(sizes) <= shown:
        return list(range(len(sizes)))
    key = [math.inf if math.isnan(size) else size for size in sizes]
    return heapq.nlargest(shown, range(len(key)), key=key.__getitem__)


def table(header: Sequence[str], rows: Sequence[Sequence[str]], *, left: int = 1) -> str:
    """Return rows as aligned text, the first `left` columns flush left, the others right."""
    cells = [[visible(cell) for cell in row] for row in (header, *rows)]
    widths = [max(columns_of(row[i]) for row in cells) for i in range(len(header))]
    lines = []
    for row in cells:
        spaces = [" " * (width - columns_of(cell)) for cell, width in zip(row, widths, strict=True)]
        pairs = zip(row, spaces, strict=True)
        aligned = [c + space if i < left else space + c for i, (c, space) in enumerate(pairs)]
        lines.append("  ".join(aligned).rstrip())
    return "\n".join(lines)


def columns_of(text: str) -> int:
    """Return how many columns a terminal needs: Chinese characters take two."""
    return sum(2 if unicodedata.east_asian_width(mark) in "WF" else 1 for mark in text)


def titled(title: str, body: str) -> str:
    """Return a part of a text under its underlined title."""
    return f"{title}\n{'-' * len(title)}\n{body}\n"


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]], *, left: int = 1) -> str:
    """Return rows of text as a Markdown table."""
    marks = ["---" if i < left else "---:" for i in range(len(header))]
    cells = [[markdown_text(cell) for cell in row] for row in (header, *rows)]
    lines = [" | ".join(line) for line in (cells[0], marks, *cells[1:])]
    return "\n".join(f"| {line} |" for line in lines)


def markdown_text(text: str) -> str:
    """Return text that Markdown shows as it is inside a line: no HTML, link, emphasis or cell."""
    text = visible(text).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    text = re.sub(r"([\\`*|])|(\](?=[(\[:]))", r"\\\g<0>", text)
    # Inside a word, as in scale_ax, it is no mark.
    return re.sub(r"(?<!\w)_|_(?!\w)", r"\_", text)


def markdown_line(text: str) -> str:
    """Return text that Markdown shows as it is on a line of its own: no heading, list or rule."""
    return re.sub(r"^(\s*\d*)([#+~=.)-])", r"\1\\\2", markdown_text(text))
