"""The array that every signature speaks of, how large its numbers may be, and rows as keys."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SMALLEST = 1e-40  # of an uncertainty, and of the largest of some measured numbers
LARGEST = 1e40  # of what is measured, in any unit: of less, squares of cubes are numbers still


def row_keys(rows: Array) -> list[bytes]:
    """Return each row of an array (n, m) as bytes, equal where all numbers of two rows are."""
    whole = np.ascontiguousarray(rows + 0.0)  # a zero has one sign
    keys: list[bytes] = whole.view(f"V{whole[0].nbytes}").ravel().tolist()
    return keys
