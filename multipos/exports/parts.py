"""What is exported together: a calibration, regressions, or a calibration and what corrects it."""

from collections.abc import Sequence
from functools import cached_property

from multipos.errors import UsageError
from multipos.files.spelling import StrPath
from multipos.files.trees import read_schema
from multipos.numerics.arrays import COMPONENTS
from multipos.regression.regression import Regression, Regressions, all_of, load_regression
from multipos.results import frozen
from multipos.sensor.calibration import Calibration
from multipos.sensor.calibration_file import load

Part = Calibration | Regression | Regressions
Parts = Part | Sequence[Part]


@frozen(eq=True)
class Correction:
    """What ``NAME_correct`` computes.

    Attributes
    ----------
    calibration : Calibration or None
        Compensates first; its forces are inputs of the regressions.
    regressions : tuple of Regression
    corrected : tuple of str
        The column that each regression corrects; empty where they predict.
    """

    calibration: Calibration | None
    regressions: tuple[Regression, ...]
    corrected: tuple[str, ...] = ()

    @cached_property
    def forces(self) -> tuple[str, ...]:
        """Compensated columns, as `apply` names them."""
        if self.calibration is None:
            return ()
        symbol = self.calibration.field.symbol
        return tuple(f"{symbol}_{COMPONENTS[i]}" for i in self.calibration.model.sensed_axes)

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        """Columns that come in, in the order of ``in``."""
        names: list[str] = []
        if self.calibration is not None:
            names += [*self.calibration.outputs, *self.calibration.model.environment]
        for r in self.regressions:
            names += [name.removesuffix("_rate") if name in r.rates else name for name in r.needed]
        names += self.corrected
        return tuple(name for name in dict.fromkeys(names) if name not in self.forces)

    @cached_property
    def rates(self) -> tuple[tuple[str, float], ...]:
        """Columns that rates are formed of, each with the window of its rate."""
        found = [
            (name.removesuffix("_rate"), r.rates[name])
            for r in self.regressions
            for name in r.needed
            if name in r.rates
        ]
        return tuple(dict.fromkeys(found))

    @cached_property
    def branched(self) -> tuple[int, ...]:
        """Regressions that tell heating from cooling."""
        return tuple(k for k, r in enumerate(self.regressions) if r.branch_column is not None)


def load_parts(paths: Sequence[StrPath]) -> tuple[Part, ...]:
    """Read calibrations and regressions, each recognised by its schema.

    Raises
    ------
    MultiposError
        A file is missing, damaged, or neither.
    """
    return tuple(
        load_regression(path) if read_schema(path) == Regression.schema else load(path)
        for path in paths
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
            raise TypeError(
                f"needs calibrations and regressions, got {type(part).__name__}; `multipos.load` "
                "and `multipos.load_regression` read them from their files."
            )
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
