"""The numbers of all units, and where they are gathered while tasks come in.

- `Units` holds the numbers, `UnitsFound` takes them up task by task.
"""

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.finding import Findings
from multipos.fleets.fixtures import FixtureSums
from multipos.fleets.labels import Labels
from multipos.fleets.solving import Solved
from multipos.numerics.arrays import Array, Mask, Places
from multipos.results import Columns, frozen
from multipos.sensor.model import Model

# texts as they are: of one width, all would be as long as the longest
Texts = NDArray[np.object_]


@frozen
class Units:
    """Every unit's numbers, (B,) or (B, p); NaN and a reason where a unit failed.

    Attributes
    ----------
    unit : Labels
        Of every unit (B,).
    station : tuple of B str
        '' where no column names them.
    model : Model or None
        None where every unit failed.
    names : tuple of p str
    parameters, u, dof : (B, p) arrays
    rms : (B,) array [g]
    findings : (B,) array of str
        Codes of errors and warnings, with `;` between them.
    why_unfit : (B,) array of str
        Why a calibration is not fit for use; '' where it is.
    reasons : (B,) array of str
        Why a unit failed; '' where it did not.
    first, time : (B,) arrays
        The first row of each unit in the tables, and the mean of its column `time`, NaN without.
    fixtures : tuple of FixtureSums
    confidence : float
    gravity_u : float
        Relative uncertainty of gravity, which all units have in common.
    sources : tuple of (name, SHA-256)
    counted : bool
        Units are whole numbers in the tables.
    key : str or None
        The column of units; None where files name them.
    notes : tuple of Finding
        About the tables.
    """

    unit: Labels
    station: tuple[str, ...]
    model: Model | None
    names: tuple[str, ...]
    parameters: Array
    u: Array
    dof: Array
    rms: Array
    findings: Texts
    why_unfit: Texts
    reasons: Texts
    first: Places
    time: Array
    fixtures: tuple[FixtureSums, ...]
    confidence: float
    gravity_u: float
    sources: tuple[tuple[str, str | None], ...]
    counted: bool
    key: str | None = None
    notes: Findings = ()

    def __len__(self) -> int:
        return len(self.unit)

    @property
    def failed(self) -> Mask:
        """Which units have no numbers."""
        return np.array([bool(reason) for reason in self.reasons])

    @property
    def unfit(self) -> Mask:
        """Which units have a calibration that is not fit for use."""
        return np.array([bool(why) for why in self.why_unfit])

    @cached_property
    def unit_column(self) -> NDArray[Any]:
        """The units as the tables name them, texts or whole numbers (B,)."""
        return np.array(list(self.unit), dtype=np.int64 if self.counted else np.str_)

    def columns(self) -> Columns:
        """Return the table of calibrations, one row a unit."""
        columns: dict[str, Any] = {
            "unit": self.unit_column,
            "station": np.array(self.station, dtype=np.str_),
        }
        for kind, numbers in (("", self.parameters), ("u_", self.u), ("dof_", self.dof)):
            names = [kind + name for name in self.names]
            columns.update(zip(names, numbers.T, strict=True))
        columns |= {"rms": self.rms, "findings": self.findings, "reason": self.reasons}
        return Columns(columns)


class UnitsFound:
    """What tasks have found so far, by unit."""

    def __init__(self, count: int) -> None:
        """Begin with nothing known of so many units."""
        self.names: tuple[str, ...] = ()
        self.parameters = self.u = self.dof = np.empty((count, 0))
        self.rms = np.full(count, np.nan)
        texts: tuple[Texts, ...] = tuple(np.full((3, count), "", dtype=np.object_))
        self.findings, self.reasons, self.why_unfit = texts
        self.fixtures: tuple[FixtureSums, ...] = ()

    def take(self, solved: Solved) -> None:
        """Take up what a task found."""
        if solved.names and not self.names:
            self.names = solved.names
            shape = (3, len(self.rms), len(solved.names))
            self.parameters, self.u, self.dof = np.full(shape, np.nan)
        same = solved.names == self.names
        other = "" if same else "its columns give other parameters than those of the other units."
        reasons = [reason or other for reason in solved.reasons]
        self.reasons[solved.units] = reasons
        good = np.flatnonzero([not reason for reason in reasons])
        units = solved.units[good]
        texts = np.array([solved.findings, solved.unfit], dtype=np.object_)
        self.findings[units], self.why_unfit[units] = texts[:, good]
        if len(units):
            self.parameters[units] = solved.parameters[good]
            self.u[units], self.dof[units] = solved.u[good], solved.dof[good]
            self.rms[units] = solved.rms[good]
        self.fixtures += solved.fixtures
