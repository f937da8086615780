"""What rolls tell of the turntable, and of the sensor beside it: results of `turntable`."""

from dataclasses import dataclass
from typing import Any

from multipos.numerics.arrays import Array
from multipos.results import Result, Tabular

_FOUND = 1e-3  # chance of a table's errors where there are none


@dataclass(frozen=True, eq=False)
class TableError(Result):
    """One quantity of the table on one roll; value, u, U are None where it cannot be told.

    `confounded_with` names the terms of the sensor that do the same to the readings, whether the
    model has them or leaves them out.
    """

    plane: str
    quantity: str
    value_deg: float | None
    u_deg: float | None
    U_deg: float | None
    confounded_with: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class ZeroShift(Result):
    """How far the zero of an output lies, on one roll, from where it was on the first."""

    plane: str
    output: str
    value: float
    u: float
    U: float
    unit: str
    p: float


@dataclass(frozen=True, eq=False)
class BesideTable(Result):
    """The parameters of the sensor, estimated together with every error of the table.

    Attributes
    ----------
    keys : tuple of (output, term)
    parameters, covariance : (p,), (p, p) arrays
    told : tuple of bool
        Which of them no error of the table does the same as.
    dof : float
    p : float
        Chance of residuals that shrink as much by a table without errors.
    """

    keys: tuple[tuple[str, str], ...]
    parameters: Array
    covariance: Array
    told: tuple[bool, ...]
    dof: float
    p: float

    @property
    def off(self) -> bool:
        """Whether the errors of the table are beyond chance."""
        return self.p < _FOUND


@dataclass(frozen=True, eq=False)
class TableErrors(Result, Tabular):
    """What the rolls of a calibration tell of the table, and of the sensor's zero between them.

    `errors` are of the angle, `shaft` is of the shaft; a plane is a roll, or a mounting on a head
    whose own angle is known, such as ``xy+0``, and ``head``.
    """

    errors: tuple[TableError, ...]
    zero_shifts: tuple[ZeroShift, ...]
    dof: float
    shaft: tuple[TableError, ...] = ()
    beside: BesideTable | None = None

    def columns(self) -> dict[str, Any]:
        """Return the errors of the angle and of the shaft; None where one cannot be told."""
        found = (*self.errors, *self.shaft)
        of = ["angle"] * len(self.errors) + ["shaft"] * len(self.shaft)
        names = ("plane", "quantity", "value_deg", "u_deg", "U_deg", "confounded_with")
        return {"of": of, **{name: [getattr(error, name) for error in found] for name in names}}

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON carries it."""
        return {
            "errors": [vars(error) for error in self.errors],
            "shaft": [vars(error) for error in self.shaft],
            "zero_shifts": [vars(shift) for shift in self.zero_shifts],
            "dof": self.dof,
        }
