"""The array that every signature speaks of, and how large and small its numbers may be."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SMALLEST = 1e-40  # of an uncertainty, and of the largest of some measured numbers
LARGEST = 1e40  # of what is measured, in any unit: of less, squares of cubes are numbers still
