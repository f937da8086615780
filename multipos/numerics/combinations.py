"""Words for what a design cannot tell apart: combinations of parameters, as sums of their names."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from multipos.numerics.arrays import Array


def name_combinations(
    null: Array, names: Sequence[str], *, rows: str = "positions"
) -> tuple[str, ...]:
    """What cannot be separated, one sentence for each column of `null`.

    Where X v = 0, the terms with positive v do together exactly what those with negative v do.
    The side of fewer terms is named first, the earlier one where they are equal, and its first
    term has factor one.

    Parameters
    ----------
    null : (p, m) array
        As in `Separability`.
    names : sequence of p str
    rows : str
        What rows of the design are called.

    Returns
    -------
    tuple of m str

    Examples
    --------
    >>> import numpy as np
    >>> name_combinations(np.array([[-1.0], [1.0], [1.0]]), ["bias", "cos²", "sin²"])
    ('`bias` cannot be told from `cos² + sin²`',)
    """
    return tuple(_sentence(v, names, rows) for v in np.asarray(null, dtype=np.float64).T)


def _sentence(v: Array, names: Sequence[str], rows: str) -> str:
    used = np.flatnonzero(v)
    if len(used) == 1:
        return f"`{names[used[0]]}` has no effect at these {rows}"
    left, right = used[v[used] > 0.0], used[v[used] < 0.0]
    if len(left) == 0 or len(right) == 0:  # one does what the others undo
        left, right = used[:1], used[1:]
    if (len(right), right[0]) < (len(left), left[0]):
        left, right = right, left
    v = v / v[left[0]]
    return f"`{_sum(v, left, names)}` cannot be told from `{_sum(-v, right, names)}`"


def _sum(v: Array, used: NDArray[np.intp], names: Sequence[str]) -> str:
    text = ""
    for j in used:
        size = f"{abs(v[j]):.3g}"
        sign = "-" if v[j] < 0.0 else "+"
        text += f" {sign} " if text else sign.strip("+")
        text += names[j] if size == "1" else f"{size} {names[j]}"
    return text
