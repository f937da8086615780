"""Movement in a static record: steps and knocks that neither noise nor a warm-up makes.

- `find_movement` returns the largest `Movement` of a record, and how many there are.

Of the means b_k of its blocks a record that lies still has differences

    J_k = b_{k+1} − b_{k−1},                                                               (1)

over the block in between, where a movement may have happened, of one law: that of its noise, with a
drift or warm-up which changes slowly from one to the next. A movement is where J is beyond 8 of
their standard deviation, 1.4826 times the median modulus about the median, and beyond four times
those three blocks before and after, so that the steep begin of a warm-up is none.
"""

import numpy as np

from multipos.numerics.arrays import Array, Places, median
from multipos.results import frozen

_FAR = 8.0  # standard deviations: of normal noise once in 1e15
_ALONE = 4.0  # times what is before and after
_BESIDE = 3  # blocks, so that neither is of the same movement
_FEWEST = 32  # blocks
_NORMAL = 1.4826  # standard deviation over median modulus


@frozen(eq=True)
class Movement:
    """The largest movement of an output: its block, its jump, and how many there are."""

    block: int
    jump: float
    count: int


def find_movement(means: Array) -> Movement | None:
    """Return the largest movement in the means (B,) of blocks; None where it lay still."""
    if len(means) < _FEWEST:
        return None
    jump = means[2:] - means[:-2]
    size = np.abs(jump - median(jump))
    sd = _NORMAL * float(median(size))
    beside = np.maximum(size[: -2 * _BESIDE], size[2 * _BESIDE :])
    if not sd:  # of a few codes only: nothing tells what is usual
        return None
    judged = size[_BESIDE:-_BESIDE]
    moved = np.flatnonzero((judged > _FAR * sd) & (judged > _ALONE * beside)) + _BESIDE
    if not len(moved):
        return None
    largest = int(moved[np.argmax(size[moved])])
    return Movement(largest + 1, float(jump[largest]), _separate(moved))


def _separate(moved: Places) -> int:
    """Return of how many movements blocks are: those nearer than three are of one."""
    return 1 + int((np.diff(moved) > _BESIDE).sum())
