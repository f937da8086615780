"""Which reader serves which log.

`open_log` opens one log, `less_copies` leaves out files that hold what others do; `read_log`
returns all columns at once, `joined` one of its pieces.

A log is a table of samples, one row a sample. Text comes with commas, semicolons (and decimal
commas), tabs or white space between the cells, with or without a header; without one the columns
are called 1, 2, 3, …. Which reader serves a file is decided by its first bytes and then by its
suffix (`multipos.logs.readers`); whatever is neither is text. Only what was asked for of a text is
turned into numbers, in pieces of some megabytes, so that its length does not matter.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.files.handed import content_of, find_copies, take_in
from multipos.files.layout import Layout, cells_of, find_layout
from multipos.files.marks import Marks, may_have_marks, read_marks
from multipos.files.pipes import Unpacked, is_folder, lines_of, rereadable, unpack_text
from multipos.files.printed import is_comment, unpack_printed
from multipos.files.spelling import Names, StrPath, split_names
from multipos.files.tables import Column, Source, read_table
from multipos.files.whole import reading
from multipos.finding import Finding, Findings, repeated_files
from multipos.logs.array_logs import log_of_columns, refuse_without_gravity
from multipos.logs.extras import NOTES
from multipos.logs.readers import read_bag, reader_of
from multipos.logs.table import Log
from multipos.logs.text_logs import HEAD, head_lines, open_text

_WIDE, _LINES = 1 << 22, 4  # bytes of a head that may hold only so many lines


def less_copies(sources: Sequence["Source | Log"]) -> tuple[list["Source | Log"], Findings]:
    """Return logs without the files that hold what one before them holds, and which these are."""
    contents = [content_of(source) if len(sources) > 1 else None for source in sources]
    again = find_copies(contents, [str(source) for source in sources])
    kept = [source for place, source in enumerate(sources) if place not in again]
    return kept, repeated_files(again.values())


def open_log(
    source: "Source | Log", *, columns: Names | None = None, outputs: Names | None = None
) -> Log:
    """Return a log from a file, the folder of a ROS 2 bag, columns in memory, or a data frame.

    Parameters
    ----------
    source : path, open file, mapping of name to (n,) array, data frame, (n, columns) array, or Log
    columns : names, optional
        Names of the columns, instead of those the file gives.
    outputs : names, optional
        Names of the columns of an array, where `columns` gives none.

    Returns
    -------
    Log

    Raises
    ------
    MultiposError
        The file is missing, empty, or of a kind that is not read.
    UsageError
        `columns` does not name each column once.
    """
    if isinstance(source, Log):
        return source
    names = None if columns is None else split_names(columns, "--columns")
    apart = None if outputs is None else split_names(outputs, "--outputs")
    given = take_in(source, "log", names or apart)
    if isinstance(given, Mapping):
        table = read_table(given, what="log")
        return log_of_columns(table.source, table.columns, names)
    if is_folder(given):
        return _with_notes(given, read_bag(Path(given)), names)
    path = rereadable(given)
    head = _read_head(path)
    reader = reader_of(path, head)
    while reader is not None and reader.unpack is not None:
        path = reader.unpack(path)
        head = _read_head(path)
        reader = reader_of(path, head)
    if reader is None or reader.columns is None:
        if not _is_utf8(head):
            path = unpack_text(path)
            head = _read_head(path)
        return refuse_without_gravity(_open_text(path, head, names))
    return replace(_with_notes(path, reader.columns(path), names), layout=reader.listed)


def _open_text(path: os.PathLike[str], head: bytes, names: Sequence[str] | None) -> Log:
    """Return a log of text: rows, or the records that a program printed, without marks."""
    lines = head_lines(path, head)
    layout = find_layout(str(path), lines)
    laid_out = layout.in_words
    said = [*filter(None, [getattr(path, "said", "")])]
    if layout.printed is not None:
        said.append(layout.printed.said)
        path = unpack_printed(path, layout.printed)
        head = _read_head(path)
        lines = head_lines(path, head)
    marks = _marks_of(path, lines, layout, names)
    if marks:
        said.append(marks.said(names or layout.names))
        cleaned = (_cleaned(line, layout, marks) for line in lines_of(path))
        path = Unpacked(str(path), cleaned, ".tsv")
        head = _read_head(path)
        layout = replace(layout, delimiter="\t", trailing=False, decimal_comma=False)
    log = open_text(path, head, layout, names)
    bits = zip(log.columns, marks.bits if marks else (), strict=False)
    return replace(
        log,
        layout=laid_out,
        notes=(*log.notes, *(Finding("log-source", "note", text) for text in said)),
        registers={name: each for name, each in bits if each > 0},
    )


def _marks_of(
    path: os.PathLike[str], lines: Sequence[str], layout: Layout, names: Sequence[str] | None
) -> Marks | None:
    """Return the marks of numbers in rows, None where the first rows show none."""
    rows = (cells_of(line, layout.delimiter) for line in lines[layout.first - 1 :])
    if not may_have_marks(zip(*(row for row in rows if len(row) == layout.width), strict=True)):
        return None
    every = (cells_of(line, layout.delimiter) for line in lines_of(path))
    columns = names or layout.names
    return read_marks(str(path), columns, every, commas_between=layout.delimiter == ",") or None


def _cleaned(line: str, layout: Layout, marks: Marks) -> bytes:
    """Return a line with tabulators between its cells, and without marks in its numbers."""
    if is_comment(line):
        return f"{line}\n".encode()
    cells = marks.clean(cells_of(line, layout.delimiter)[: layout.width])
    return ("\t".join(cells) + "\n").encode()


def _with_notes(path: StrPath, found: Mapping[str, Any], names: Sequence[str] | None) -> Log:
    """Return the log of columns of a file, with what its reader says of them."""
    log = log_of_columns(str(path), {n: each for n, each in found.items() if n != NOTES}, names)
    said = map(str, found.get(NOTES, ()))
    return replace(log, notes=tuple(Finding("log-source", "note", text) for text in said))


def read_log(log: Log) -> dict[str, Column]:
    """Return all columns of a log at once: numbers, NaN where a cell is none, and texts."""
    texts = [name for name in log.columns if name not in log.numeric]
    columns: dict[str, list[Any]] = {name: [] for name in log.columns}
    for piece in log.read((), log.numeric, texts):
        for name in log.columns:
            columns[name].append(piece.table.columns[name])
    return {name: joined(parts) for name, parts in columns.items() if parts}


def joined(parts: list[Any]) -> Column:
    """Return the column that its pieces make: an array, or a list of texts."""
    if isinstance(parts[0], np.ndarray):
        return np.concatenate(parts)
    return list(chain.from_iterable(parts))


def _is_utf8(head: bytes) -> bool:
    try:
        head.decode()
    except UnicodeDecodeError as error:
        return len(head) >= HEAD and error.start > len(head) - 4  # it may end inside a letter
    return True


def _read_head(path: os.PathLike[str]) -> bytes:
    with reading(path, "log"), Path(path).open("rb") as stream:
        head = stream.read(HEAD)
        while len(head) % HEAD == 0 and 0 < len(head) < _WIDE and head.count(b"\n") < _LINES:
            more = stream.read(HEAD)  # of thousands of columns
            if not more:
                break
            head += more
    if not head.strip():
        raise MultiposError(f"{path}: the file is empty; a log needs rows of samples.")
    return head
