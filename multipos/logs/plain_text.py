"""Text that is nothing but numbers with one separator, read by arithmetic on its bytes.

The digits of a number, without its point, are an integer M; the number is M / 10^k with k decimals.
That is the nearest double, as `float` gives it, where M and 10^k are doubles, for then only the
division rounds (W. D. Clinger, How to read floating point numbers accurately, PLDI 1990): for M up
to 2^53 and k up to 22; and where k = 0. Numbers with an exponent or more digits go through `float`.

Eight digits are read as one 64-bit word of bytes 48 + d, the first digit lowest: pairs 10 d + d',
pairs of pairs, and their pair are summed in place, each in one step for all of them.
"""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.numerics.arrays import Array

_SEPARATORS = ("", ",", ";", "\t")
_BLOCK = 1 << 17  # bytes at a time, whose arrays stay in the processor's cache
_WORD = 8  # digits of a 64-bit word
_OTHERS = (8 * np.arange(_WORD, -1, -1)).astype(np.uint64)  # bits of a word that are no digits
_DIGITS = 19  # a 64-bit integer holds any number of so many
_EXACT = 1 << 53
_SHARE = 4  # one number in four may be written otherwise; beyond, NumPy's reader is quicker
_OTHERWISE = re.compile(rb"(?:[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?\n)*")
_POWERS = np.array([float(10**k) for k in range(_DIGITS + 1)])  # exact, as no `power` promises


class _Cells(NamedTuple):
    """Cells of numbers, row by row, and where they stand in a block of text."""

    block: bytes
    end: NDArray[np.int64]  # of each, in bytes
    last: NDArray[np.int64]  # end of each in the block without points
    length: NDArray[np.int64]
    digits: NDArray[np.int64]
    decimals: NDArray[np.int64]
    negative: NDArray[np.bool_]
    odd: NDArray[np.bool_]  # neither digits alone nor digits with a point and a minus

    def texts(self, which: NDArray[np.bool_]) -> list[bytes]:
        """Return what some cells hold."""
        pairs = zip(self.end[which].tolist(), self.length[which].tolist(), strict=True)
        return [self.block[end - length : end] for end, length in pairs]

    def of_columns(self, width: int, columns: Sequence[int]) -> "_Cells":
        """Return the cells of some columns."""
        which = np.arange(len(self.odd)).reshape(-1, width)[:, columns].ravel()
        return _Cells(
            self.block,
            self.end[which],
            self.last[which],
            self.length[which],
            self.digits[which],
            self.decimals[which],
            self.negative[which],
            self.odd[which],
        )


def read_plain(text: bytes, delimiter: str, width: int, columns: Sequence[int]) -> Array | None:
    """Return columns of numbers (k, n), None where text holds anything else.

    Parameters
    ----------
    text : bytes
        Rows, a line each.
    delimiter : str
        '' is white space; a comma, a semicolon or a tabulator otherwise.
    width : int
        Cells of a row.
    columns : sequence of int
        Which of them are wanted.
    """
    if not text or delimiter not in _SEPARATORS:
        return None
    every = [*columns] == [*range(width)]
    found = np.empty((len(columns), text.count(b"\n") + (not text.endswith(b"\n"))))
    start = row = 0
    while start < len(text):
        end = text.rfind(b"\n", start, start + _BLOCK) + 1 or len(text)
        cells = _find_cells(text[start:end], delimiter.encode(), width)
        if cells is None:
            return None
        rows = len(cells.odd) // width
        wanted = cells if every else cells.of_columns(width, columns)
        found[:, row : row + rows] = _values(wanted).reshape(rows, len(columns)).T
        start, row = end, row + rows
    return found


def _find_cells(rows: bytes, mark: bytes, width: int) -> _Cells | None:
    """Return the cells of rows, None where one is no number, missing or too many, or many odd."""
    block = b"\n" * _WORD + rows + b"\n" * (not rows.endswith(b"\n"))
    cells = _between(block, mark or b" ", width)
    if cells is None and (b" " in block or b"\t" in block):
        return _between(_even(block, mark), mark or b" ", width)
    return cells


def _even(block: bytes, mark: bytes) -> bytes:
    """Return rows with one mark between cells, and no white space around it or a line."""
    if not mark:
        block, mark = block.replace(b"\t", b" "), b" "
    while b"  " in block:
        block = block.replace(b"  ", b" ")
    for each in {mark, b"\n"} - {b" "}:
        block = block.replace(b" " + each, each).replace(each + b" ", each)
    return block


def _between(block: bytes, mark: bytes, width: int) -> _Cells | None:
    """Return what stands between separators, behind a word of line ends."""
    characters = np.frombuffer(block, dtype=np.uint8)
    places = np.flatnonzero(characters - np.uint8(ord("0")) > 9)[_WORD - 1 :]  # of no digits
    kinds = characters[places]
    between = np.flatnonzero((kinds == ord(mark)) | (kinds == ord("\n")))
    after = between[1:]
    row = mark * (width - 1) + b"\n"
    if kinds[after].tobytes() != row * (len(after) // width):
        return None
    points = kinds == ord(".")
    ends = places[between]
    end, length = ends[1:], np.diff(ends) - 1
    others = np.diff(between) - 1  # characters that are no digits
    digits = length - others
    pointed = points[after - 1]
    # A minus stands right behind a separator: the first character there that is no digit.
    first = between[:-1] + 1
    negative = (kinds[first] == ord("-")) & (places[first] == ends[:-1] + 1)
    odd = (others != pointed.astype(np.int64) + negative) | (digits < 1) | (digits > _DIGITS)
    if _SHARE * np.count_nonzero(odd) > len(odd):
        return None
    cells = _Cells(
        block,
        end,
        last=end - np.cumsum(points)[after],
        length=length,
        digits=digits,
        decimals=(end - places[after - 1] - 1) * pointed,
        negative=negative,
        odd=odd,
    )
    written_otherwise = b"".join(text + b"\n" for text in cells.texts(odd))
    return cells if _OTHERWISE.fullmatch(written_otherwise) else None


def _values(cells: _Cells) -> Array:
    """Return the numbers of cells."""
    words = _words(cells.block.translate(None, b"."))
    digits, decimals, odd = cells.digits, cells.decimals, cells.odd
    if odd.any():
        digits, decimals = np.where(odd, 0, digits), np.where(odd, 0, decimals)
    whole = _eight(words, cells.last, digits)
    for place in range(_WORD, _DIGITS, _WORD):
        longer = np.flatnonzero(digits > place)
        if not len(longer):
            break
        more = _eight(words, cells.last[longer] - place, digits[longer] - place)
        whole[longer] += more * np.uint64(10**place)
    values = whole.astype(np.float64)
    values /= _POWERS[decimals]
    np.negative(values, out=values, where=cells.negative)
    other = odd | ((whole > _EXACT) & (decimals > 0))
    values[other] = [float(text) for text in cells.texts(other)]
    return values


def _words(text: bytes) -> NDArray[np.uint64]:
    """Return the words that begin at each byte of a text, its characters rising in value."""
    return np.ndarray(len(text) - _WORD + 1, dtype="<u8", buffer=text, strides=(1,))


def _eight(
    words: NDArray[np.uint64], end: NDArray[np.int64], digits: NDArray[np.int64]
) -> NDArray[np.uint64]:
    """Return the integers of up to eight digits that end at given bytes."""
    word = words[end - _WORD] & np.uint64(0x0F0F0F0F0F0F0F0F)
    before = _OTHERS[np.minimum(digits, _WORD)]
    word = (word >> before) << before
    word = (word * np.uint64(10) + (word >> np.uint64(8))) & np.uint64(0x00FF00FF00FF00FF)
    word = (word * np.uint64(100) + (word >> np.uint64(16))) & np.uint64(0x0000FFFF0000FFFF)
    return (word * np.uint64(10_000) + (word >> np.uint64(32))) & np.uint64(0xFFFFFFFF)
