"""Rows of a text log, apart from the lines that are none."""

import csv
from collections.abc import Sequence
from typing import NamedTuple

from multipos.errors import MultiposError
from multipos.logs.layout import COMMENTS, Layout, is_comment


class Part(NamedTuple):
    """Consecutive lines of a text from its first row on."""

    content: str
    line: int  # of the first of them in the file

    def lines(self) -> list[str]:
        """Return the lines, without their ends."""
        return self.content.removesuffix("\n").split("\n") if self.content else []


class Rows(NamedTuple):
    """Rows of text without header, comments and empty lines."""

    lines: list[str]
    numbers: Sequence[int]  # of the lines in the file
    delimiters: int | None  # in all of them, where they have been counted
    quotes: bool  # whether one of them holds a quote that it does not close


def table_text(layout: Layout, content: str, first: int) -> Part:
    """Return lines of the table, the number of whose first is given."""
    if layout.decimal_comma and layout.delimiter != ";":
        content = content.replace(",", ".")
    return Part(content, first)


def rows_only(layout: Layout, part: Part) -> Rows:
    """Return the rows among lines, without a separator behind their last cell."""
    content, lines = part.content, part.lines()
    rows = _without_comments(lines, part.line, content, layout.width)
    if layout.trailing:
        bare = [line.rstrip().removesuffix(layout.delimiter) for line in rows.lines]
        return rows._replace(lines=bare)
    if len(rows.lines) == len(lines):
        return rows._replace(delimiters=content.count(layout.delimiter or " "))
    return rows


def _without_comments(lines: list[str], first: int, content: str, width: int) -> Rows:
    """Return the lines that are rows, and their numbers, the first of which is given."""
    numbers: Sequence[int] = range(first, first + len(lines))
    quotes = '"' in content and any(line.count('"') % 2 for line in lines)
    # A row has a character for every cell and separator; shorter ones may be empty lines.
    short = min(map(len, lines), default=0) < 2 * width - 1
    if short or any(mark in content for mark in COMMENTS) or any(map(str.isspace, lines)):
        kept = [i for i, line in enumerate(lines) if is_row(line)]
        numbers = [first + i for i in kept]
        lines = [lines[i] for i in kept]
    return Rows(lines, numbers, None, quotes)


def is_row(line: str) -> bool:
    """Tell whether a line is neither empty nor a comment."""
    return bool(line.strip()) and not is_comment(line)


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
