"""How much of a simulation runs, at once enough to fail for the same fault, and exact fits."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import pytest

import multipos as mp


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


def exactly(readings: Any, **options: Any) -> mp.Calibration:
    """Fit all rows, at exact orientations where nothing else is said of them."""
    said = {"unknown_orientation", "closed_form", "orientation_sd"} & options.keys()
    column = isinstance(readings, dict) and "orientation_sd_deg" in readings
    uncertain = isinstance(readings, mp.Readings) and readings.orientation_sd is not None
    if not (said or column or uncertain):
        options["orientation_sd"] = 0
    return mp.fit(readings, **{"exclude": "none", **options})
