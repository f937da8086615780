"""The array that every signature speaks of."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
