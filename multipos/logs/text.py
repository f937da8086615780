"""Logs that are text, with or without a header."""

import csv
import os
from collections.abc import Iterator, Sequence
from functools import partial
from operator import methodcaller
from pathlib import Path
from typing import NamedTuple

import numpy as np

from multipos.errors import MultiposError
from multipos.files.tables import Table
from multipos.logs.readers import formats_read
from multipos.logs.table import Log, Piece, name_columns
from multipos.numerics.arrays import Array

HEAD = 1 << 16  # bytes that must hold the header and the first row
_PIECE = 1 << 22  # bytes read at a time
_SAMPLE = 50  # first rows, which tell numbers from text


class _Text(NamedTuple):
    """How the rows of a text file are laid out."""

    path: os.PathLike[str]
    columns: tuple[str, ...]
    numeric: tuple[str, ...]
    delimiter: str
    header_line: int  # 0 where the first row is a sample


def open_text(path: os.PathLike[str], head: bytes, columns: Sequence[str] | None) -> Log:
    """Return a log of text, whose first bytes are given."""
    first = [
        (number, line)
        for number, line in enumerate(_decode(path, head).split("\n"), start=1)
        if _is_row(line)
    ]
    if len(head) == HEAD:
        first = first[:-1]  # its last line may be cut
    if not first:
        raise MultiposError(f"{path}: no rows in the first {HEAD} bytes; a log needs samples.")
    line_number, line = first[0]
    delimiter = next((mark for mark in ";\t," if mark in line), "")
    cells = split_rows(str(path), [line], [line_number], delimiter)[0]
    headless = all(_is_number(cell, delimiter) or not cell for cell in cells)
    samples = dict((first if headless else first[1:])[:_SAMPLE])
    if not samples:
        raise MultiposError(f"{path}: only a header, no rows; a log needs samples.")
    names = name_columns(str(path), None if headless else cells, len(cells), columns)
    found = split_rows(str(path), list(samples.values()), list(samples), delimiter)
    rows = [row for row in found if len(row) == len(names)]
    # The first cell that is not empty tells; a bad one further down is then an error, if used.
    first_cells = [next((row[i] for row in rows if row[i]), "") for i in range(len(names))]
    numeric = tuple(
        name for name, cell in zip(names, first_cells, strict=True) if _is_number(cell, delimiter)
    )
    text = _Text(path, names, numeric, delimiter, 0 if headless else line_number)
    return Log(str(path), names, numeric, delimiter, True, partial(_read_text, text))


def _read_text(text: _Text, names: Sequence[str], optional: Sequence[str]) -> Iterator[Piece]:
    first = 0
    for rows, done in _text_rows(text):
        if rows.lines:
            yield Piece(_parse(text, rows, first, names, optional), rows.lines, done)
            first += len(rows.lines)


class _Rows(NamedTuple):
    """Rows of text without header, comments and empty lines."""

    lines: list[str]
    numbers: Sequence[int]  # of the lines in the file
    delimiters: int  # in all of them
    quotes: bool  # whether one of them holds a quote that it does not close


def _text_rows(text: _Text) -> Iterator[tuple[_Rows, float]]:
    line, rest = 1, b""
    with Path(text.path).open("rb") as stream:
        size = max(os.fstat(stream.fileno()).st_size, 1)
        while block := stream.read(_PIECE):
            block = rest + block
            end = max(block.rfind(b"\n"), block.rfind(b"\r", 0, -1)) + 1
            block, rest = block[:end], block[end:]
            if block:
                content = _decode(text.path, block)
                yield _rows_only(text, content, line), min(stream.tell() / size, 1.0)
                line += content.count("\n")
        if rest:
            yield _rows_only(text, _decode(text.path, rest), line), 1.0


def _rows_only(text: _Text, content: str, first: int) -> _Rows:
    lines = content.split("\n")
    if not lines[-1]:
        lines.pop()
    skipped = max(text.header_line - first + 1, 0)
    numbers: Sequence[int] = range(first + skipped, first + len(lines))
    gone, lines = lines[:skipped], lines[skipped:]
    # A row has a character for every cell and separator; shorter ones may be empty lines.
    if "#" in content or min(map(len, lines), default=0) < 2 * len(text.columns) - 1:
        rows = [_is_row(line) for line in lines]
        gone += [line for line, row in zip(lines, rows, strict=True) if not row]
        numbers = [i for i, row in zip(numbers, rows, strict=True) if row]
        lines = [line for line, row in zip(lines, rows, strict=True) if row]
    mark = text.delimiter or " "
    delimiters = content.count(mark) - sum(line.count(mark) for line in gone)
    quotes = '"' in content and any(line.count('"') % 2 for line in lines)
    return _Rows(lines, numbers, delimiters, quotes)


def _parse(
    text: _Text, rows: _Rows, first: int, names: Sequence[str], optional: Sequence[str]
) -> Table:
    """Return the named columns of rows of text: by NumPy's reader, by ours where it stumbles."""
    wanted = list(dict.fromkeys((*names, *optional)))
    index = [text.columns.index(name) for name in wanted]
    table = partial(
        Table,
        str(text.path),
        rows=len(rows.lines),
        lines=rows.numbers,
        first=first,
        delimiter=text.delimiter or " ",
    )
    try:
        columns = dict(zip(wanted, _fast(text, rows, index), strict=True))
        if all(np.isfinite(columns[name]).all() for name in names):
            return table(columns)
    except ValueError:
        pass
    cells = split_rows(str(text.path), rows.lines, rows.numbers, text.delimiter)
    width = len(text.columns)
    for i, row in enumerate(cells):
        if len(row) != width:
            raise MultiposError(
                f"{text.path}: row {first + i + 1} (line {rows.numbers[i]}) has {len(row)} cells "
                f"where there are {width} columns, the last '{text.columns[-1]}'; a log that was "
                "cut off may end in half a row, remove it."
            )
    texts = table({name: [row[i] for row in cells] for name, i in zip(wanted, index, strict=True)})
    parsed = {name: texts.number(name) for name in names}
    for name in optional:
        if name not in parsed:
            column = [_lenient(cell, text.delimiter) for cell in texts.columns[name]]
            parsed[name] = np.array(column)
    return table(parsed)


def _fast(text: _Text, rows: _Rows, index: list[int]) -> Array:
    if rows.quotes:
        raise ValueError
    mark, width = text.delimiter, len(text.columns)
    lines = [line.replace(",", ".") for line in rows.lines] if mark == ";" else rows.lines
    if not mark:
        # White space may come in any amount, so here NumPy counts the cells of every row.
        values = np.loadtxt(lines, dtype=np.float64, comments=None, ndmin=2)
        if values.shape[1] != width:
            raise ValueError
        return np.ascontiguousarray(values.T[index])
    # With as many separators as there must be, no row can have more cells than it should, unless
    # another has less; and that one stumbles over the last column.
    last = width - 1
    even = rows.delimiters == last * len(rows.lines) and last in index
    if not even and set(map(methodcaller("count", mark), lines)) != {last}:
        raise ValueError  # a ragged row, or quotes
    values = np.loadtxt(
        lines, dtype=np.float64, delimiter=mark, usecols=index, comments=None, ndmin=2
    )
    return np.ascontiguousarray(values.T)


def _decode(path: os.PathLike[str], block: bytes) -> str:
    try:
        text = block.decode("utf-8").removeprefix("\ufeff")
    except UnicodeDecodeError as error:
        if len(block) == HEAD and error.start > HEAD - 4:  # the head may end inside a letter
            return _decode(path, block[: error.start])
        raise MultiposError(
            f"{path}: byte 0x{block[error.start]:02x} is not UTF-8; save the log as UTF-8 text."
        ) from None
    if "\0" in text:
        raise MultiposError(
            f"{path}: neither text nor a format that is read ({formats_read()}); "
            "convert the log to CSV."
        )
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


def split_rows(
    source: str, lines: Sequence[str], numbers: Sequence[int], delimiter: str
) -> list[list[str]]:
    """Return the cells of rows of text, whose line numbers are given; a row is one line."""
    if not delimiter:
        return [line.split() for line in lines]
    reader = csv.reader(lines, delimiter=delimiter, strict=True)
    rows: list[list[str]] = []
    reason = ""
    try:
        for row in reader:
            if reader.line_num > len(rows) + 1:
                break
            rows.append([cell.strip() for cell in row])
    except csv.Error as error:
        reason = "" if "end of data" in str(error) else str(error)
    if len(rows) < len(lines):  # a quote that is not closed has swallowed what follows it
        raise MultiposError(
            f"{source}: line {numbers[len(rows)]}: {reason or 'a quote is not closed'}; check the "
            "quotes of that line."
        )
    return rows


def _is_row(line: str) -> bool:
    stripped = line.lstrip()
    return bool(stripped) and not stripped.startswith("#")


def _is_number(cell: str, delimiter: str) -> bool:
    return not np.isnan(_lenient(cell, delimiter)) or cell.lower() == "nan"


def _lenient(cell: str, delimiter: str) -> float:
    try:
        return float(cell.replace(",", ".") if delimiter == ";" else cell)
    except ValueError:
        return float("nan")
