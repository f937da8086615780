"""How much of a simulation runs: at once enough to fail for the same fault, and all as slow."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import pytest


def few_and_many(few: object, many: object) -> list[object]:
    """Return two values of a parameter, or of several, of which the second is slow."""
    several = many if isinstance(many, tuple) else (many,)
    return [few, pytest.param(*several, marks=pytest.mark.slow)]


def rest_slow(values: Sequence[object], quick: int = 1) -> list[object]:
    """Return values of a parameter, or of several, of which all but the first are slow."""
    slow = [each if isinstance(each, tuple) else (each,) for each in values[quick:]]
    return [*values[:quick], *(pytest.param(*each, marks=pytest.mark.slow) for each in slow)]


def slow_where(long: Callable[[Any], bool], values: Iterable[object]) -> list[object]:
    """Return values of a parameter, of which those that take long are slow."""
    return [pytest.param(each, marks=pytest.mark.slow) if long(each) else each for each in values]
