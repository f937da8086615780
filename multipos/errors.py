"""What can go wrong, in the user's words.

Two families, because the command line ends differently for each: `MultiposError` when the data or
the fit is at fault (exit status 1), `UsageError` when the command line or an option is (exit status
2). Both are `ValueError`, so a caller who does not care may catch that.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path

_PACKAGE = str(Path(__file__).parent)


class MultiposError(ValueError):
    """The data or the fit is at fault."""


class RankError(MultiposError):
    """The rows cannot separate the parameters.

    Attributes
    ----------
    rank, parameters : int
        How many parameters can be separated, and how many there are.
    combinations : tuple of str
        What cannot be told apart, one sentence each; empty where there are simply too few rows.
    """

    def __init__(
        self, message: str, *, rank: int, parameters: int, combinations: Sequence[str] = ()
    ) -> None:
        super().__init__(message)
        self.rank = rank
        self.parameters = parameters
        self.combinations = tuple(combinations)


class ConvergenceError(MultiposError):
    """An iteration ended before its criterion was met."""


class UsageError(ValueError):
    """The command line or an option is at fault."""


class CalibrationWarning(UserWarning):
    """What a fit warns of; its doubts come first."""


def warn_of(texts: Iterable[str]) -> None:
    """Raise each text as a `CalibrationWarning` of the line that called this package."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PACKAGE):
        level, frame = level + 1, frame.f_back
    for text in texts:
        warnings.warn(text, CalibrationWarning, stacklevel=level)
