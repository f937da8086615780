"""What can go wrong, in the user's words.

Two families, because the command line ends differently for each: `MultiposError` when the data or
the fit is at fault (exit status 1), `UsageError` when the command line or an option is (exit status
2). Both are `ValueError`, so a caller who does not care may catch that.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

_PACKAGE = str(Path(__file__).parent)


class MultiposError(ValueError):
    """The data or the fit is at fault.

    Examples
    --------
    >>> import multipos as mp
    >>> try:
    ...     mp.fit({"up_x": [0.0, 0.0], "up_y": [0.0, 0.0], "up_z": [1.0, -1.0], "az": [1.01, "-"]})
    ... except mp.MultiposError as error:
    ...     print(error)
    readings: row 2, column 'az': '-' is not a number; a number is needed there.
    """


@contextmanager
def refused_with(seen: Callable[[], str]) -> Iterator[None]:
    """Add to a refusal in the block what was seen of the data before it."""
    try:
        yield
    except MultiposError as error:
        error.args = (f"{error} {seen()}", *error.args[1:])
        raise


class RankError(MultiposError):
    """The rows cannot separate the parameters.

    Attributes
    ----------
    rank, parameters : int
        How many parameters can be separated, and how many there are.
    combinations : tuple of str
        What cannot be separated, one sentence each; empty where there are simply too few rows.

    Examples
    --------
    >>> import multipos as mp
    >>> try:
    ...     mp.fit({"direction": ["E-U-S", "E-D-N"], "ay": [1.002, -0.998]}, axes="y")
    ... except mp.RankError as error:
    ...     print(error.rank, "of", error.parameters)
    2 of 4
    """

    def __init__(
        self, message: str, *, rank: int, parameters: int, combinations: Sequence[str] = ()
    ) -> None:
        super().__init__(message)
        self.rank = rank
        self.parameters = parameters
        self.combinations: tuple[str, ...] = tuple(combinations)

    def __reduce__(self) -> tuple[Any, ...]:  # so that a pool of processes hands it on
        return partial(type(self), **vars(self)), self.args


class ConvergenceError(MultiposError):
    """An iteration ended before its criterion was met.

    Examples
    --------
    >>> import multipos as mp
    >>> issubclass(mp.ConvergenceError, mp.MultiposError)
    True
    """


class UsageError(ValueError):
    """The command line or an option is at fault.

    Examples
    --------
    >>> import multipos as mp
    >>> try:
    ...     mp.fit({"up_z": [1.0, -1.0], "az": [1.0, -1.0]}, gauge="upper")
    ... except mp.UsageError as error:
    ...     print(error)
    unknown gauge 'upper'; give lower or symmetric.
    """


class CalibrationWarning(UserWarning):
    """An error or a warning among the findings of a result.

    Examples
    --------
    >>> import warnings
    >>> import multipos as mp
    >>> with warnings.catch_warnings(record=True) as caught:
    ...     warnings.simplefilter("always")
    ...     cal = mp.fit(
    ...         {"up_x": [0, 0], "up_y": [0, 0], "up_z": [1, -1], "az": [1.0, -1.0]},
    ...         axes="z",
    ...         inputs="z",
    ...     )
    >>> caught[0].category is mp.CalibrationWarning, [found.code for found in cal.findings]
    (True, ['no-redundancy', 'hidden-terms', 'inseparable'])
    """


def warn_of(texts: Iterable[str]) -> None:
    """Raise each text as a `CalibrationWarning` of the line that called this package."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PACKAGE):
        level, frame = level + 1, frame.f_back
    for text in texts:
        warnings.warn(text, CalibrationWarning, stacklevel=level)
