"""Rows in another unit, or of another size altogether, where the fit ends with an error.

Wherever a triad at rest points, its readings are of one size, but for bias and scale factors:

    |y_k| = |b + K f_k|,    a third to three times the median for a bias below half a g.    (1)

A row beyond that by a factor that two units have between them is in another one. Such a row leaves
no ellipsoid on which the readings could lie, so the estimator fails, and this says why.
"""

import numpy as np

from multipos.doubts.repairs import FACTORS
from multipos.errors import MultiposError
from multipos.numerics.medians import median
from multipos.positions.readings import Readings

_APART = 3.0  # times the median size of a row
_NEAR = 1.6  # times a known factor
_SHOWN = 6
_DROWNED = 1e12  # times the median reading: doubles hold 16 digits, and a fit needs some of them


def explain_failure(error: MultiposError, readings: Readings) -> MultiposError:
    """Return an error that names the rows in another unit, if there are any; else the same."""
    rows, factor = rows_in_another_unit(readings)
    if not rows:
        return error
    some = ", ".join(rows[:_SHOWN]) + (f" and {len(rows) - _SHOWN} more" if rows[_SHOWN:] else "")
    named = f"position {some} looks" if len(rows) == 1 else f"positions {some} look"
    return MultiposError(
        f"{readings.source or 'the readings'}: {named} to be in another unit, {factor:.4g} times "
        f"the others; bring all rows to one unit (otherwise: {str(error).rstrip('.')})."
    )


def explain_breakdown(
    error: np.linalg.LinAlgError, readings: Readings
) -> MultiposError | np.linalg.LinAlgError:
    """Return an error that names the largest reading, if the others drown in it; else the same."""
    size = np.abs(readings.values)
    largest, typical = float(size.max()), float(median(size[size > 0.0]))
    if not largest > _DROWNED * typical:
        return error
    row, column = divmod(int(size.argmax()), size.shape[1])
    return MultiposError(
        f"{readings.source or 'the readings'}: position {readings.labels[row]}: "
        f"{readings.outputs[column]} is {largest:.3g}, beside which no digit is left of the other "
        f"readings, of {typical:.3g} as a rule; leave such rows out, or look at the file."
    )


def rows_in_another_unit(readings: Readings) -> tuple[tuple[str, ...], float]:
    """Return the labels of rows by eq. (1), and the factor; none where no factor is known."""
    size = np.linalg.norm(readings.values, axis=1)
    middle = float(np.sort(size)[(len(size) - 1) // 2])  # of halves the smaller
    if not middle > 0.0:
        return (), 1.0
    ratio = size / middle
    odd = np.flatnonzero((ratio > _APART) | (ratio < 1.0 / _APART))
    if not len(odd) or 2 * len(odd) > len(size):
        return (), 1.0
    typical = float(np.exp(np.mean(np.log(np.maximum(ratio[odd], np.finfo(float).tiny)))))
    known = np.array(FACTORS)
    nearest = float(known[np.argmin(np.abs(np.log(known / typical)))])
    spread = np.abs(np.log(np.maximum(ratio[odd], np.finfo(float).tiny) / nearest))
    if float(spread.max()) > np.log(_NEAR):
        return (), 1.0
    return tuple(readings.labels[i] for i in odd.tolist()), nearest
