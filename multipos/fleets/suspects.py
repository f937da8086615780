"""Which units of a batch may not be fit for use: each is fitted alone, and looked at in full.

- `find_suspects` returns them, of readings at known or estimated positions; `Sought` finds those
  of which `fit` sets rows aside.

Errors of `multipos.diagnostics` need something to begin with, and each bound here is
passed by far less than any of them needs:

- residuals of half a percent of a g, or one of eight tenths (rows interchanged, flipped, in another
  unit, saturated; they need two percent, or one);
- an output that leans more than 14° from its axis, or is reversed (permuted, turned, reversed);
- a sensitivity that is not within a fifth of that of the other units (units mixed up), or one of
  the others that is not what the stated unit says (all in another unit);
- two rows that are the same in all outputs (copied).

At uncertain orientations residuals are small wherever positions take up what is wrong, so that an
output that has one end of its range twice, or in common with another (saturated), is asked as well;
positions that stick out are left to the fit of one unit by the batch itself.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from multipos.diagnostics.scales import are_of_unit
from multipos.estimation.batches import Estimates
from multipos.estimation.outliers import find_outlying_rows
from multipos.estimation.stated_uncertainty import shrink_variances
from multipos.numerics.arrays import COMPONENTS, Array, Mask, coarse_steps, median
from multipos.positions.readings import Readings
from multipos.results import frozen
from multipos.sensor.model import Model

_RMS = 0.005  # [g]
CALM = 0.015  # [g], below which orientations as listed hide no error of the two percent above
_LARGEST = 0.008  # [g]
_LEANS = 0.97  # cosine
_OTHER = 1.2  # times the sensitivity of the units beside it
_WEIGHTS = (1.0, 0.7071067811865476, 0.5773502691896257)  # that make one number of a row


@frozen
class Sought:
    """How rows that do not fit are looked for in each unit.

    Attributes
    ----------
    model : Model
    readings : Readings
        Of one unit.
    reference : (n, 3) array [g] or None
        As listed; None where nothing is known of the orientations.
    orientation_sd : (n,) array [rad] or None
    """

    model: Model
    readings: Readings
    reference: Array | None
    orientation_sd: Array | None = None

    def find(
        self,
        values: Sequence[Array],
        stated: Sequence[Array],
        stated_dof: Sequence[Array],
        asked: Mask,
    ) -> Mask:
        """Return which of the units asked for (B,) have a row that `fit` sets aside.

        Parameters
        ----------
        values, stated, stated_dof : sequences of M (B, n) arrays
            Readings, what is stated of their uncertainty, and its degrees of freedom, if anything.
        asked : (B,) array of bool
        """
        found = np.zeros_like(asked)
        for unit in np.flatnonzero(asked).tolist():
            y, u, dof = (
                np.column_stack([each[unit] for each in columns]) if columns else None
                for columns in (values, stated, stated_dof)
            )
            assert y is not None
            readings = shrink_variances(replace(self.readings, values=y, u=u, dof=dof))
            rows = find_outlying_rows(self.model, readings, self.reference, self.orientation_sd)
            found[unit] = rows is not None
        return found


def find_suspects(
    model: Model,
    values: tuple[Array, ...],
    found: Estimates,
    *,
    uncertain_orientation: bool = False,
) -> Mask:
    """Tell which units (B,) are to be looked at in full.

    Parameters
    ----------
    model : Model
    values : M arrays (B, n)
    found : Estimates
    uncertain_orientation : bool
        Orientations are uncertain.
    """
    matrix = found.sensitivity
    length = np.asarray(np.linalg.norm(matrix, axis=2))
    usual = median(length, axis=0).tolist()
    suspect = ~(found.rms <= _RMS) | _repeats(values) | _leans(model, matrix, length)
    if uncertain_orientation:
        suspect |= _ends_repeat(values)
    for i, residuals in enumerate(found.residuals):
        size = length[:, i]
        suspect |= coarse_steps(values[i].T, np.sqrt(np.mean(residuals**2, axis=1))) > 0.0
        suspect |= ~((size < _OTHER * usual[i]) & (size > usual[i] / _OTHER))
        suspect |= np.abs(residuals).max(axis=1) > _LARGEST * size
    if not are_of_unit([min(usual) / _OTHER, max(usual) * _OTHER], model.unit):
        suspect[:] = True
    return suspect


def _leans(model: Model, matrix: Array, length: Array) -> Mask:
    """Tell of which units an output leans from its axis; `matrix` are their sensitivities."""
    sensed = model.sensed_axes
    leans = np.zeros(len(matrix), dtype=np.bool_)
    for i, axis in enumerate(model.axes):
        own = matrix[:, i, sensed.index(COMPONENTS.index(axis))]
        leans |= ~(own > _LEANS * length[:, i])
    return leans


def _ends_repeat(values: tuple[Array, ...]) -> Mask:
    """Tell which units have an end of the range of an output twice, or in two outputs."""
    repeat = np.zeros(len(values[0]), dtype=np.bool_)
    for ends in (np.max, np.min):
        found = np.stack([ends(column, axis=1) for column in values])
        for column, end in zip(values, found, strict=True):
            repeat |= (column == end[:, None]).sum(axis=1) > 1
        repeat |= (np.diff(np.sort(found, axis=0), axis=0) == 0.0).any(axis=0)
    return np.asarray(repeat)


def _repeats(values: tuple[Array, ...]) -> Mask:
    """Tell which units have two rows that are alike."""
    number = np.zeros_like(values[0])
    for i, column in enumerate(values):
        number += _WEIGHTS[i % 3] * column
    number.sort(axis=1)
    return np.asarray((np.diff(number, axis=1) == 0.0).any(axis=1))
