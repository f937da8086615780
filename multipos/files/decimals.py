"""Columns of numbers as text, all rows at once.

A positive double a with decimal exponent e is the 17-digit integer M = a 10^(16−e), rounded: the
product of a and a power of ten, which is a double up to 10^22, is had exactly as the sum of two
doubles (Veltkamp and Dekker [1]_), so that M is right. The shortest text that is read as a again
has 15, 16 or 17 digits (fewer are zeros at their end): the first of them whose nearest decimal lies
within half a unit in the last place of a, which is what `repr` writes (Steele and White [2]_). Near
a tie, at powers of two and beyond 10^-6 to 10^8 a cell goes through `repr` itself.

Rows are made as a matrix of bytes, whose empty places are 0 and taken out at the end.

References
----------
.. [1] T. J. Dekker, A floating-point technique for extending the available precision, 1971.
.. [2] G. L. Steele, J. L. White, How to print floating-point numbers accurately, 1990.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from multipos.numerics.arrays import Array, Mask, Places

Bytes = NDArray[np.uint8]

_LOW, _HIGH = -6, 7  # exponents for which 10^(16 - e) is a double
_LOWEST = -18  # of rounded ones
_POWERS = np.array([float(f"1e{e}") for e in range(23)])
_EDGES = np.array([float(f"1e{e}") for e in range(_LOWEST, _HIGH + 2)])
_EXPONENTS = np.array([list(b"e-%02d" % -e) for e in range(_LOWEST, 0)], dtype=np.uint8)
_DIGITS = 17
_SPLIT = 2.0**27 + 1.0
_DOUBT = 1e-6  # relative: so near to a tie `repr` decides
_QUADS = np.frombuffer(b"".join(b"%04d" % i for i in range(10_000)), dtype=np.uint32)
_ROWS = 1 << 13  # at a time, whose matrices stay in the processor's cache
_ZERO, _POINT, _MINUS = b"0.-"


def format_numbers(
    columns: Sequence[NDArray[np.generic]], delimiter: str, digits: Sequence[int | None]
) -> str:
    """Return columns of numbers as lines of text; NaN is an empty cell.

    Parameters
    ----------
    columns : sequence of (n,) arrays of floats or whole numbers
    delimiter : str
        Between cells; with semicolons numbers have decimal commas.
    digits : sequence of int or None
        Significant digits of every column; None of all that tell a number from others.
    """
    count = len(columns[0])
    parts = []
    for start in range(0, count, _ROWS):
        cells = [_cells(c[start : start + _ROWS], d) for c, d in zip(columns, digits, strict=True)]
        between = np.full((len(cells[0]), 1), ord(delimiter), dtype=np.uint8)
        ends = [between] * (len(cells) - 1) + [np.full_like(between, ord("\n"))]
        rows = np.hstack([part for pair in zip(cells, ends, strict=True) for part in pair])
        parts.append(rows.tobytes().translate(None, b"\0"))
    text = b"".join(parts).decode()
    return text.replace(".", ",") if delimiter == ";" else text


def _cells(column: NDArray[np.generic], digits: int | None) -> Bytes:
    """Return the cells of a column, a row of bytes each."""
    if column.dtype.kind in "iub":
        small = column.astype(np.uint8)
        if column.dtype.kind == "b" or (small != column).any() or (small > 9).any():
            return _bytes([str(cell) for cell in column.tolist()])
        return (small + np.uint8(_ZERO))[:, None]
    values = column.astype(np.float64, copy=False)
    size = np.abs(values)
    e = np.searchsorted(_EDGES, size, side="right") + (_LOWEST - 1)
    plain = (e >= (_LOW if digits is None else _LOWEST)) & (e <= _HIGH)
    if not plain.all():
        e, size = np.where(plain, e, 0), np.where(plain, size, 1.0)
    whole, sure = _shortest(size, e) if digits is None else _rounded(size, e, digits)
    cells = _laid_out(whole, e, np.signbit(values), digits or _DIGITS)
    others = np.flatnonzero(~(plain & sure))
    if len(others):
        texts = _bytes([_text(value, digits) for value in values[others].tolist()])
        cells = np.pad(cells, ((0, 0), (0, max(texts.shape[1] - cells.shape[1], 0))))
        cells[others] = 0
        cells[others, : texts.shape[1]] = texts
    return cells


def _text(value: float, digits: int | None) -> str:
    if value != value:
        return ""
    return repr(value) if digits is None else repr(float(f"{value:.{digits - 1}e}"))


def _bytes(texts: Sequence[str]) -> Bytes:
    array = np.array([text.encode() for text in texts])
    return array.view(np.uint8).reshape(len(texts), -1)


def _shortest(a: Array, e: Places) -> tuple[NDArray[np.int64], Mask]:
    """Return M of the shortest text, and where that is certain."""
    power = _POWERS[16 - e]
    high = a * power
    t, s = _SPLIT * a, _SPLIT * power
    a1, p1 = t - (t - a), s - (s - power)
    a2, p2 = a - a1, power - p1
    low = ((a1 * p1 - high) + a1 * p2 + a2 * p1) + a2 * p2
    down = np.floor(low)
    part = low - down
    below = high.astype(np.int64) + down.astype(np.int64)
    half = 0.5 * np.spacing(a) * power
    whole = below + (part > 0.5)
    sure = np.abs(part - 0.5) > _DOUBT
    for step in (10, 100):
        nearest = (below + step // 2) // step * step
        off = np.abs((nearest - below) - part)
        whole = np.where(off < half, nearest, whole)
        sure &= (np.abs(off - half) > _DOUBT * half) & (np.abs(off - step / 2) > _DOUBT)
    sure &= (np.frexp(a)[0] != 0.5) & (whole < 10**_DIGITS)
    return whole, sure


def _rounded(a: Array, e: Places, digits: int) -> tuple[NDArray[np.int64], Mask]:
    """Return M of so many digits, and where it has no more."""
    at = digits - 1 - e
    scaled = np.where(at >= 0, a * _POWERS[np.maximum(at, 0)], a / _POWERS[np.maximum(-at, 0)])
    whole = np.rint(scaled).astype(np.int64)
    return whole, whole < 10**digits


def _laid_out(whole: NDArray[np.int64], e: Places, negative: Mask, count: int) -> Bytes:
    """Return numbers of so many digits as text, with the point where their exponents have it."""
    digits = _digits_of(whole, count)
    before = max(int(e.max(initial=-1)) + 1, 0)  # digits before the point
    alive = np.ones(len(e), dtype=bool)
    for place in range(count - 1, 0, -1):  # zeros at the end, but 2.0 keeps one
        alive &= (digits[:, place] == _ZERO) & (place > e + 1)
        if not alive.any():
            break
        digits[alive, place] = 0
    if before > count - 2:
        digits = np.pad(digits, ((0, 0), (0, before + 2 - count)), constant_values=_ZERO)
        digits[:, count:][np.arange(count, before + 2) > e[:, None] + 1] = 0
    width, small = digits.shape[1], np.flatnonzero(e < -4)
    nulls = min(max(-1 - int(e.min(initial=-1)), 0), 3)  # zeros between point and digits
    point = 2 + before
    begin = point + 1 + nulls
    cells = np.zeros((len(e), begin + width + 4 * bool(len(small))), dtype=np.uint8)
    cells[:, 0] = np.where(negative, _MINUS, 0)
    cells[:, 1] = np.where(e < 0, _ZERO, 0)
    cells[:, point] = _POINT
    for null in range(1, nulls + 1):
        cells[:, point + null] = np.where(e < -null, _ZERO, 0)
    cells[:, begin : begin + width] = digits
    if before:
        here = np.arange(before) <= e[:, None]
        cells[:, 2:point] = np.where(here, digits[:, :before], 0)
        cells[:, begin : begin + before] = np.where(here, 0, digits[:, :before])
    if len(small):
        cells[small, 1] = digits[small, 0]
        cells[small, point] = np.where(digits[small, 1] > 0, _POINT, 0)
        cells[small, point + 1 : begin + 1] = 0
        cells[small, begin + width :] = _EXPONENTS[e[small] - _LOWEST]
    return cells


def _digits_of(whole: NDArray[np.int64], count: int) -> Bytes:
    """Return the digits (n, count) of whole numbers."""
    quads = -(-count // 4)
    words = np.empty((len(whole), quads), dtype=np.uint32)
    left = whole
    for place in range(quads - 1, -1, -1):
        left, last = left // 10_000, left % 10_000
        words[:, place] = _QUADS[last]
    return words.view(np.uint8)[:, 4 * quads - count :]
