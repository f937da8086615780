"""What every reader gives: a table of samples that comes in pieces."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from multipos.errors import MultiposError, UsageError
from multipos.files.tables import Table


class Piece(NamedTuple):
    """Consecutive rows of a log."""

    table: Table  # the columns that were asked for, as numbers
    lines: list[str] | None  # the rows as they stand in a text file
    done: float  # how much of the log has been read, 0 to 1


@dataclass(frozen=True)
class Log:
    """A log that can be read from its beginning, more than once.

    Attributes
    ----------
    source : str
    columns : tuple of str
    numeric : tuple of str
        Columns whose first rows hold numbers.
    delimiter : str
        What stands between the cells of the text; '' is white space; ',' where it is no text.
    text : bool
        Whether pieces have rows of text.
    read : callable
        ``read(names, optional)`` yields pieces with those columns. A cell of `names` that is no
        finite number is an error, in `optional` it is NaN.
    """

    source: str
    columns: tuple[str, ...]
    numeric: tuple[str, ...]
    delimiter: str
    text: bool
    read: Callable[[Sequence[str], Sequence[str]], Iterator[Piece]]


def name_columns(
    source: str, header: list[str] | None, width: int, given: Sequence[str] | None
) -> tuple[str, ...]:
    """Return the names of the columns: as given, by the header, or 1, 2, 3, …."""
    if given is not None:
        if len(given) != width:
            raise UsageError(
                f"--columns names {len(given)} columns, but {source} has {width}; name each."
            )
        header = list(given)
    if header is None:
        return tuple(str(i + 1) for i in range(width))
    seen = set()
    for i, name in enumerate(header):
        if not name:
            raise MultiposError(f"{source}: column {i + 1} has no name; name it or give --columns.")
        if name in seen:
            raise MultiposError(
                f"{source}: column '{name}' appears twice; rename one or give --columns."
            )
        seen.add(name)
    return tuple(header)
