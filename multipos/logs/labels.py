"""Positions that a column of the log names: the rows of one label are a rest."""

from collections.abc import Sequence
from itertools import pairwise

from multipos.errors import MultiposError
from multipos.logs.rests import Rest


class Runs:
    """Where a column has which label; rows without one belong to no position.

    Attributes
    ----------
    column : str
    """

    def __init__(self, source: str, column: str) -> None:
        self.column = column
        self._source = source
        self._runs: list[tuple[str, int, int]] = []
        self._rows = 0

    def feed(self, labels: Sequence[str]) -> None:
        """Add the labels of the rows that follow."""
        edges = [0, *(i for i in range(1, len(labels)) if labels[i] != labels[i - 1]), len(labels)]
        for start, end in pairwise(edges):
            if start == end:
                continue
            first, last = self._rows + start, self._rows + end
            if self._runs and self._runs[-1][0] == labels[start]:
                self._runs[-1] = (labels[start], self._runs[-1][1], last)
            else:
                self._runs.append((labels[start], first, last))
        self._rows += len(labels)

    def rests(self) -> list[tuple[str, Rest]]:
        """Return the rests with their labels, in the order of the log; a label may come again.

        Raises
        ------
        MultiposError
            No row has a label, or a label stands on a single row.
        """
        found = [(label, Rest(start, end)) for label, start, end in self._runs if label]
        if not found:
            raise MultiposError(
                f"{self._source}: column '{self.column}' has no label; a row without one belongs "
                "to no position."
            )
        for label, rest in found:
            if rest.end - rest.start < 2:
                raise MultiposError(
                    f"{self._source}: label '{label}' of column '{self.column}' is on row "
                    f"{rest.start} alone, counted from 0; a position needs at least two rows."
                )
        return found
