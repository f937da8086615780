"""Where a calibration holds: the forces that were applied, with a margin.

`applied` returns them. What was applied is a sphere of |f| = g, and known forces, which along an
axis go from the smallest component to the largest and in size to the largest of them. Terms that
the positions could not show are in the uncertainty as far as the budget states them
(`multipos.uncertainty.unseen_terms`): between the directions applied, and beyond what was applied.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from multipos.numerics.arrays import COMPONENTS, Array, Mask
from multipos.sensor.calibration import Calibration

# Noise and orientation error make |f| of a sensor at rest differ from 1 g; only more than this is
# outside.
_MARGIN = 0.01
_MARGIN_RMS = 4.0
_ELSEWHERE = 0.25


class ForcesSeen(NamedTuple):
    """The forces that a calibration has seen [g].

    Inside is what is no larger than `sphere`, and what is no larger than `largest` with components
    between `low` and `high`, all with a margin for noise and orientation error.
    """

    sphere: float
    largest: float
    low: Array  # (3,)
    high: Array  # (3,)
    margin: float
    unit: str = "g"

    def holds(self, force: Array, axes: Sequence[int]) -> Mask:
        """Tell which forces (n, K) along K axes are inside; NaN is not."""
        size = np.sqrt(np.einsum("ni,ni->n", force, force))
        if self.sphere == self.largest:
            return np.asarray(size <= self.limit(self.largest))
        low, high = self.box(axes)
        within = (force >= low) & (force <= high)
        seen = (size <= self.limit(self.largest)) & within.all(axis=1)
        return np.asarray((size <= self.limit(self.sphere)) | seen)

    def box(self, axes: Sequence[int]) -> tuple[Array, Array]:
        """Return between what the components along K axes may be, low (K,) and high (K,)."""
        room = self.margin + _MARGIN * self.largest
        return self.low[axes] - room, self.high[axes] + room

    def limit(self, size: float) -> float:
        """Return how large |f| may be where a size was applied."""
        return size * (1.0 + _MARGIN) + self.margin

    def in_words(self, axes: Sequence[int]) -> str:
        """Return what was applied, along K axes."""
        if self.sphere == self.largest:
            return f"up to {self.largest:.4g} {self.unit}".rstrip()
        parts = [f"{COMPONENTS[i]} {self.low[i]:.4g} to {self.high[i]:.4g}" for i in axes]
        return f"{', '.join(parts)} {self.unit}".rstrip()


def applied(calibration: Calibration) -> ForcesSeen:
    """Return the forces that a calibration has seen."""
    c = calibration
    forced = c.readings.forced
    size = np.linalg.norm(c.reference, axis=1)
    largest, margin = float(size.max()), _MARGIN_RMS * c.rms
    if not c.field.same_everywhere:
        margin += _ELSEWHERE * largest
    sphere = float(size[~forced].max(initial=0.0))
    known = c.reference[forced]
    low = known.min(axis=0, initial=-sphere)
    high = known.max(axis=0, initial=sphere)
    unit = c.field.unit or "times the local field"
    return ForcesSeen(sphere, largest, np.asarray(low), np.asarray(high), margin, unit)
