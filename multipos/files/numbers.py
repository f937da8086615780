"""Numbers and tables as people read them: ``0.99647(74)`` and aligned columns.

The digits in brackets are the standard uncertainty in units of the last digits shown, two of
them (JCGM 100, 7.2.2); a value without a usable uncertainty is shown with ten digits.
"""

import heapq
import math
import re
from collections.abc import Sequence

from multipos.files.characters import visible

_MOST_ROWS, _LARGEST_ROWS = 100, 20  # of a table: beyond the former only so many are shown
_SHORTEST = -5  # decimal exponents below this are written as such


def uncertain(value: float, u: float) -> str:
    """Return a value with its standard uncertainty, as in ``-0.00079(52)``."""
    if not (math.isfinite(value) and math.isfinite(u) and u > 0.0):
        return f"{value:.10g}"
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


def beside(value: float, u: float, U: float) -> tuple[str, str]:
    """Return a value and its U to the digits that u supports, both without exponent.

    Two digits of u decide; without a usable one ten digits are shown, and no U.
    """
    if not (math.isfinite(value) and math.isfinite(u) and u > 0.0):
        return f"{value:.10g}", "-"
    decimals = max(0, 1 - math.floor(math.log10(u)))
    shown = f"{U:.{decimals}f}" if math.isfinite(U) else "-"
    return f"{value + 0.0:.{decimals}f}", shown


def readable_g(size: float) -> tuple[float, str]:
    """Return the unit that people read an acceleration of so many g in, and its factor."""
    if not size > 0.0 or size >= 1.0:
        return 1.0, "g"
    return (1e3, "mg") if size >= 1e-3 else (1e6, "µg")


def in_g(size: float) -> str:
    """Return a size [g] to three digits in a unit that people read."""
    factor, unit = readable_g(size)
    return f"{float(f'{size * factor:.3g}'):g} {unit}"


def number(value: float | None, digits: int = 4) -> str:
    """Return a number with so many significant digits; nothing where there is none."""
    if value is None or math.isnan(value):
        return "-"
    return "inf" if math.isinf(value) else f"{value:.{digits}g}"


def largest_rows(sizes: Sequence[float]) -> list[int]:
    """Return the rows of a long table to show, the largest first: twenty of more than a hundred.

    Of fewer all are shown, in order. NaN counts as the largest.
    """
    if len(sizes) <= _MOST_ROWS:
        return list(range(len(sizes)))
    key = [math.inf if math.isnan(size) else size for size in sizes]
    return heapq.nlargest(_LARGEST_ROWS, range(len(key)), key=key.__getitem__)


def table(header: Sequence[str], rows: Sequence[Sequence[str]], *, left: int = 1) -> str:
    """Return rows as aligned text, the first `left` columns flush left, the others right."""
    cells = [[visible(cell) for cell in row] for row in (header, *rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(header))]
    lines = []
    for row in cells:
        aligned = [
            cell.ljust(width) if i < left else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(aligned).rstrip())
    return "\n".join(lines)


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
