"""Heating and cooling: rows by the sign of a rate, as files of versions 0.1 and 0.2 part them.

`branch_of` returns the branch of every row. Nothing is fitted so any more: a rate among the
variables describes what differs. A regression that was is still read, applied and exported.
"""

import numpy as np

from multipos.numerics.arrays import Array, Places
from multipos.regression.rates import rows_of_runs

BRANCHES = ("heating", "cooling")


def branch_of(rate: Array, run: Places | None = None) -> Places:
    """Return 0 where it heats and 1 where it cools.

    A row without change is as the one before in its run; before the first change it heats.
    """
    if run is not None:
        branch = np.empty(len(rate), dtype=np.intp)
        for rows in rows_of_runs(run):
            branch[rows] = branch_of(rate[rows])
        return branch
    sign = np.sign(rate)
    moving = np.concatenate(([0], np.flatnonzero(sign)))
    last = np.searchsorted(moving, np.arange(len(rate)), side="right") - 1
    return (sign[moving[last]] < 0.0).astype(np.intp)
