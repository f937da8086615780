"""The arrays that signatures speak of, how large their numbers may be, and rows of equal kind.

`as_numbers` lets arrays in, and refuses what only looks like numbers.
`places_of_kinds` yields where the rows of each kind stand, `row_keys` makes rows comparable and
`count_different` counts those that differ. `median` is NumPy's, which imports all of its masked
arrays at the first call. `coarse_steps`, `computed_steps` and `resolution` find the grid that
numbers lie on, `quadratic` is g'Ag of many vectors, and `require_rate` refuses a rate out of range.
"""

import math
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from multipos.errors import MultiposError, UsageError

Array = NDArray[np.float64]
Places = NDArray[np.intp]  # of rows or units among others
Mask = NDArray[np.bool_]
Environment = Mapping[str, ArrayLike]  # columns of the readings beside the outputs, by name
COMPONENTS = ("x", "y", "z")  # of a vector, the last axis of an array

SMALLEST = 1e-40  # of an uncertainty, and of the largest of some measured numbers
_LEVELS = 100  # readings of which the resolution is found
FEWEST = 0.1  # degrees of freedom: with fewer k is beyond 1e12, and nothing is said
LARGEST_SAMPLE = 1e15  # no sensor counts so far, and sums of squares are far from overflow
LARGEST = 1e40  # of what is measured, in any unit: of less, squares of cubes are numbers still


def as_numbers(given: ArrayLike, what: str, fault: type[ValueError] = MultiposError) -> Array:
    """Return an array of the caller's as one of our own, which runs by columns in memory.

    NumPy would take a masked number through its mask, a date as nanoseconds, and of a complex
    number the real part.

    Raises
    ------
    MultiposError
        Or another `fault`: a number is masked, complex, a date, beyond double precision, or none.
    """
    parts = given if isinstance(given, list | tuple) else [given]
    if any(np.any(mask) for each in parts if not callable(mask := getattr(each, "mask", False))):
        raise fault(f"{what} hides numbers behind a mask; leave their rows out, or fill them.")
    try:
        with np.errstate(all="ignore"):  # a NaN that signals is one
            found = np.asarray(given)
            if found.dtype.kind not in "cmM":
                # by columns, along which NumPy finds extremes five times as fast
                return np.array(found, dtype=np.float64, order="F")
    except (TypeError, ValueError, OverflowError):
        raise fault(f"{what} must hold numbers, in double precision.") from None
    raise fault(f"{what} must hold real numbers, got {found.dtype.name}; convert them first.")


def places_of_kinds(kinds: NDArray[np.integer[Any]], count: int) -> Iterator[tuple[int, Places]]:
    """Yield the kinds from 0 to count that there are, and where each stands, rising."""
    order = np.argsort(kinds, kind="stable")
    ends = np.searchsorted(kinds[order], np.arange(count + 1))
    for kind in np.flatnonzero(np.diff(ends)).tolist():
        yield kind, order[ends[kind] : ends[kind + 1]]


def row_keys(rows: Array) -> list[bytes]:
    """Return each row of an array (n, m) as bytes, equal where all numbers of two rows are."""
    whole = np.ascontiguousarray(rows + 0.0)  # a zero has one sign
    keys: list[bytes] = whole.view(f"V{whole[0].nbytes}").ravel().tolist()
    return keys


def count_different(rows: Array) -> int:
    """Return how many rows of an array (n, m) differ from each other, by all numbers."""
    if len(rows) > _SEEN and np.diff(np.sort(rows[:, 0])).all():
        return len(rows)
    return len(set(row_keys(rows)))


def median(values: ArrayLike, *, axis: int | None = None) -> Array:
    """Return the median of all values, or along an axis; NaN where one is, or where none is there.

    Examples
    --------
    >>> float(median([3.0, 1.0, 2.0, 10.0]))
    2.5
    """
    array = np.asarray(values, dtype=np.float64)
    array = array.ravel() if axis is None else np.moveaxis(array, axis, 0)
    count = len(array)
    if not count:
        return np.asarray(np.full(array.shape[1:], np.nan))
    middle = [(count - 1) // 2, count // 2]
    low, high = np.partition(array, middle, axis=0)[middle]
    return np.where(np.isnan(array).any(axis=0), np.nan, low / 2.0 + high / 2.0)


_DIVISORS = 16  # of the least difference, that a grid is sought at
_FINE = 0.05  # of the span: where no two readings are nearer, no grid is seen
_ON_GRID = 1e-4  # of a step
_SEEN = 1000  # readings that are looked at first
_ROUNDINGS = 2.0  # steps of rounding, some sixteen units in the last place, that readings scatter


def coarse_steps(values: Array, scatter: Array) -> Array:
    """Return the steps (C,) of columns on a grid coarser than their scatter, 0 of any other.

    Double precision is such a grid to numbers that were computed (`computed_steps`).

    Parameters
    ----------
    values : (n, C) array
    scatter : (C,) array
        Standard deviation of the readings about their model.
    """
    if len(values) <= _SEEN:  # a fit asks twice
        return _kept_steps(values.tobytes(), values.shape, scatter.tobytes())
    return _seen_or_computed(values, scatter)


def computed_steps(values: Array) -> Array:
    """Return the steps (C,) of which step/√12 holds the rounding of columns (n, C) in a mean.

    Roundings of computed numbers may be alike in all n, so that step/√12 is √n times half a unit
    in the last place of the largest number.
    """
    last_place = np.finfo(float).eps * np.abs(values).max(axis=0)
    return np.asarray(math.sqrt(3.0 * len(values)) * last_place)


def _seen_or_computed(values: Array, scatter: Array) -> Array:
    steps, computed = _coarse_steps(values, scatter), computed_steps(values)
    exact = (scatter < _ROUNDINGS * computed) & (np.ptp(values, axis=0) > _ROUNDINGS * computed)
    return np.where((steps == 0.0) & exact, computed, steps)


@lru_cache(maxsize=2)
def _kept_steps(values: bytes, shape: tuple[int, int], scatter: bytes) -> Array:
    steps = _seen_or_computed(np.frombuffer(values).reshape(shape), np.frombuffer(scatter))
    steps.setflags(write=False)
    return steps


def _coarse_steps(values: Array, scatter: Array) -> Array:
    if len(values) > _SEEN:  # the gaps of all are no larger than those of some
        some = np.sort(values[:_SEEN], axis=0)
        gaps = np.diff(some, axis=0)
        gaps = np.where(gaps > 1e-6 * np.abs(values).max(axis=0), gaps, np.inf)
        if (gaps.min(axis=0) <= 2.0 * scatter).all():
            return np.zeros(values.shape[1])
    ordered = np.ascontiguousarray(np.sort(values, axis=0))
    gaps = np.diff(ordered, axis=0)
    span = ordered[-1] - ordered[0]
    equal = 1e-9 * np.abs(ordered[[0, -1]]).max(axis=0)
    least = gaps.min(axis=0)
    tied = np.flatnonzero(least <= equal)
    least[tied] = np.where(gaps[:, tied] > equal[tied], gaps[:, tied], np.inf).min(axis=0)
    asked = (least <= _FINE * span) & (least > 2.0 * scatter)
    steps, columns = np.zeros(values.shape[1]), np.flatnonzero(asked)
    if not len(columns):
        return steps
    # most of what is on no grid shows it in its largest gap
    largest = gaps[:, columns].max(axis=0, initial=0.0) / least[columns]
    parts = np.arange(1.0, _DIVISORS + 1.0)[:, None] * largest
    columns = columns[(np.abs(parts - np.rint(parts)) < 2.0 * _ON_GRID).any(axis=0)]
    gaps[gaps <= equal] = 0.0
    for column in columns.tolist():
        tried = least[column] / np.arange(1.0, _DIVISORS + 1.0)
        tried = tried[tried > 2.0 * scatter[column]]
        parts = gaps[:, column] / tried[:, None]
        whole = (np.abs(parts - np.rint(parts)) < _ON_GRID).all(axis=1)
        steps[column] = tried[int(np.argmax(whole))] if whole.any() else 0.0
    if steps.any():  # columns of one converter: too few different readings show none of their own
        common = float(steps[steps > 0.0].min())
        parts = gaps / common
        same = (np.abs(parts - np.rint(parts)) < _ON_GRID).all(axis=0) & (2.0 * scatter < common)
        steps = np.where((steps == 0.0) & same, common, steps)
    return steps


def resolution(values: Array) -> float:
    """Return the step that readings are multiples of, 0 where there is none to be seen."""
    levels = np.unique(values)
    if len(levels) > _LEVELS:
        levels = np.sort(np.random.default_rng(0).choice(levels, _LEVELS, replace=False))
    least = 1e-9 * float(np.abs(levels).max())
    step = 0.0
    for difference in np.diff(levels).tolist():
        larger, smaller = max(step, difference), min(step, difference)
        while smaller > least:  # Euclid's algorithm, up to rounding
            rest = math.remainder(larger, smaller)
            larger, smaller = smaller, abs(rest)
        step = larger
        if least < step <= 100.0 * least:
            break  # no difference makes it larger
    return 0.0 if step <= 100.0 * least else step


def quadratic(vectors: Array, matrix: Array) -> Array:
    """Return g'Ag (...) of vectors g (..., p) and one symmetric A (p, p), by what of A is not 0."""
    used = np.flatnonzero(matrix.any(axis=0))
    if not len(used):
        return np.zeros(vectors.shape[:-1])
    kept = np.ascontiguousarray(vectors[..., used]).reshape(-1, len(used))
    along = kept @ matrix[np.ix_(used, used)]
    return np.asarray(np.einsum("np,np->n", along, kept).reshape(vectors.shape[:-1]))


SLOWEST, FASTEST = 1e-12, 1e7  # [Hz]


def require_rate(rate: float) -> None:
    """Refuse a rate [Hz] out of range.

    Raises
    ------
    UsageError
        The message begins with the option.
    """
    if not SLOWEST <= rate <= FASTEST:
        raise UsageError(
            f"--rate must be above 0, from {SLOWEST:g} to {FASTEST:g} Hz, got {rate:g}."
        )
