"""Columns of labels as numbers: a text that comes a million times is kept once.

- `labels_of` numbers a column, `Labels`; `joined_labels` and `joined_columns` put several together.
"""

from collections.abc import Iterator, Sequence
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from multipos.files.tables import Column, Table

Codes = NDArray[np.int32]


class Labels(Sequence[str]):
    """A column of texts: `codes` (n,), places in `names`, which are all different."""

    def __init__(self, codes: Codes, names: Sequence[str]) -> None:
        self.codes = codes
        self.names: tuple[str, ...] = tuple(names)

    def __len__(self) -> int:
        return len(self.codes)

    @overload
    def __getitem__(self, row: int) -> str: ...

    @overload
    def __getitem__(self, row: slice) -> "Labels": ...

    def __getitem__(self, row: int | slice) -> "str | Labels":
        if isinstance(row, slice):
            return Labels(self.codes[row], self.names)
        name: str = self.names[self.codes[row]]
        return name

    def __iter__(self) -> Iterator[str]:
        return map(self.names.__getitem__, self.codes.tolist())


def labels_of(table: Table, name: str, *, checked: bool = True) -> Labels:
    """Return a column of a table as labels, in the order in which they first come.

    Without `checked` they may hold control characters: those are compared, and never printed.
    """
    column = table.columns[name]
    if isinstance(column, Labels):
        return column
    if isinstance(column, np.ndarray) and len(column):
        # a label that stays for many rows is looked at once
        changes = (column[1:] != column[:-1]).nonzero()[0] + 1
        bounds = np.concatenate(([0], changes, [len(column)]))
        short = _coded(table, name, column[bounds[:-1]].tolist(), checked)
        return Labels(short.codes.repeat(bounds[1:] - bounds[:-1]), short.names)
    cells = column if isinstance(column, Sequence) else column.tolist()
    return _coded(table, name, cells, checked)


def _coded(table: Table, name: str, cells: Sequence[Any], checked: bool) -> Labels:
    places = {cell: place for place, cell in enumerate(dict.fromkeys(cells))}
    codes = np.fromiter(map(places.__getitem__, cells), dtype=np.int32, count=len(cells))
    different = Table(table.source, {name: list(places)}, len(places))
    return joined_labels(
        [Labels(codes, different.text(name) if checked else different.unchecked(name))]
    )


def joined_labels(parts: Sequence[Labels]) -> Labels:
    """Return labels one after another, each name once."""
    if len(parts) == 1 and len(set(parts[0].names)) == len(parts[0].names):
        return parts[0]
    places: dict[str, int] = {}
    codes = []
    for part in parts:
        there = [places.setdefault(name, len(places)) for name in part.names]
        codes.append(np.array(there, dtype=np.int32)[part.codes])
    return Labels(np.concatenate(codes), tuple(places))


def joined_columns(parts: Sequence[Column]) -> Column:
    """Return parts of a column one after another."""
    if len(parts) == 1:
        return parts[0]
    if all(isinstance(part, np.ndarray) and part.dtype.kind in "fiub" for part in parts):
        return np.concatenate([np.asarray(part) for part in parts])
    return [cell for part in parts for cell in part]
