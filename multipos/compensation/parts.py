"""What is exported together: a calibration, regressions, or a calibration and what corrects it."""

import os
from collections.abc import Sequence

from multipos.errors import UsageError
from multipos.files.trees import read_schema
from multipos.regression.regression_file import SCHEMA, load_regression
from multipos.regression.result import Regression
from multipos.regression.several import Regressions, all_of
from multipos.sensor.calibration import Calibration
from multipos.sensor.loading import load

Part = Calibration | Regression | Regressions
Parts = Part | Sequence[Part]


def load_parts(paths: Sequence[str | os.PathLike[str]]) -> tuple[Part, ...]:
    """Read calibrations and regressions, each told by its schema.

    Raises
    ------
    MultiposError
        A file is missing, damaged, or neither.
    """
    return tuple(
        load_regression(path) if read_schema(path) == SCHEMA else load(path) for path in paths
    )


def split_parts(parts: Parts) -> tuple[Calibration | None, tuple[Regression, ...]]:
    """Return the calibration, which comes first, and the regressions.

    Raises
    ------
    UsageError
        There is no part, or a calibration that is not the first.
    TypeError
        Something is neither.
    """
    given = (parts,) if isinstance(parts, Part) else tuple(parts)
    for part in given:
        if not isinstance(part, Part):
            raise TypeError(f"needs calibrations and regressions, got {type(part).__name__}.")
    if not given:
        raise UsageError("there is nothing to export; give a calibration or a regression.")
    first, rest = (given[0], given[1:]) if isinstance(given[0], Calibration) else (None, given)
    regressions: list[Regression] = []
    for part in rest:
        if isinstance(part, Calibration):
            raise UsageError(
                "one calibration can be exported, and it comes before the regressions."
            )
        regressions += all_of(part)
    return first, tuple(regressions)
