"""Numbers and tables as people read them: ``0.99647(74)`` and aligned columns.

The digits in brackets are the standard uncertainty in units of the last digits shown, two of
them (JCGM 100, 7.2.2); a value without a usable uncertainty is shown with ten digits.
"""

import math
import re
from collections.abc import Sequence

_SHORTEST = -5  # decimal exponents below this are written as such
# Control characters but line feed and tab, separators of lines, and what turns the direction of
# writing: a terminal would obey them.
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]")


def visible(text: str) -> str:
    r"""Return text with control characters as escapes, ``\u001b``, which a terminal only shows.

    In JSON an escape is the same character.
    """
    return _CONTROL.sub(lambda found: escaped(found[0]), text)


def escaped(text: str) -> str:
    r"""Return each character as ``\uXXXX``, as JSON does, in two where one does not suffice."""
    raw = text.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{raw[i : i + 2].hex()}" for i in range(0, len(raw), 2))


def one_line(text: str) -> str:
    """Return text as one line that a terminal only shows."""
    return visible(" ".join(text.split()))


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


def number(value: float | None, digits: int = 4) -> str:
    """Return a number with so many significant digits; nothing where there is none."""
    if value is None or math.isnan(value):
        return "-"
    return "inf" if math.isinf(value) else f"{value:.{digits}g}"


def table(header: Sequence[str], rows: Sequence[Sequence[str]], *, left: int = 1) -> str:
    """Return rows as aligned text, the first `left` columns flush left, the others right."""
    cells = [list(header), *(list(row) for row in rows)]
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
    """Return rows as a Markdown table."""
    marks = ["---" if i < left else "---:" for i in range(len(header))]
    lines = [" | ".join(cells) for cells in (header, marks, *rows)]
    return "\n".join(f"| {line} |" for line in lines)
