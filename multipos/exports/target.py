"""A target: a consumer of calibrations, how a file for it is written and how it is read back.

Each target is a `Target` in a file of this room, with its like, and one line in the list of
`multipos.exports.targets`. Consumers that take a matrix and an offset are made by
`multipos.exports.parameters.parameter_target`.
"""

from collections.abc import Callable
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from multipos.bias_stability.stability_result import Stability
from multipos.files.numbers import number, table
from multipos.files.spelling import StrPath
from multipos.files.whole import written
from multipos.finding import Finding, Findings, errors_of
from multipos.numerics.arrays import Array
from multipos.results import Result, frozen, plain_dict
from multipos.sensor.calibration import Calibration
from multipos.sensor.gravity import GRAVITY, Field, FieldKind

_ROUNDING = 1e-12  # of a difference, in units of the field: that of double precision


class Wish(NamedTuple):
    """What the user of `export` asks for.

    Attributes
    ----------
    name : str
        Of a function.
    single, allow_lossy : bool
        Single precision; terms let go.
    instance, device_id : int or None
        Which of the autopilot's accelerometers it is: its number, and the ID of its device.
    in_metres : bool
        Force in m/s² instead of g.
    stability : Stability or None
        Of the sensor, for consumers that want its noise.
    tilt : bool
        A function of the angles above the horizon as well.
    fixed : bool
        Whole numbers instead of floating point.
    """

    name: str
    single: bool
    allow_lossy: bool
    instance: int | None = None
    device_id: int | None = None
    in_metres: bool = False
    stability: Stability | None = None
    tilt: bool = False
    fixed: bool = False


class GivenFile(NamedTuple):
    """A file to read back: where it is, what it holds, and whether foreign code in it may run."""

    path: str
    raw: bytes
    text: str
    run_foreign_code: bool


@frozen
class Exported(Result):
    """A calibration in the form of a target.

    Attributes
    ----------
    target : str
    text : str
        Content of the file.
    test : str or None
        C program that checks the function, for a file beside it.
    findings : tuple of Finding
        What is lost, and what the consumer needs beside it.
    """

    target: str
    text: str
    test: str | None = None
    findings: Findings = ()

    def save(self, path: StrPath) -> tuple[str, ...]:
        """Write the file, for C also ``…_test.c`` beside it; return the names written."""
        files = self.files(path)
        with written(files):
            pass
        return tuple(map(str, files))

    def files(self, path: StrPath) -> dict[StrPath, str]:
        """Return the files to write, and what they hold."""
        beside = () if self.test is None else self_test(path)
        return {path: self.text, **dict.fromkeys(beside, self.test or "")}


def self_test(path: StrPath) -> tuple[Path, ...]:
    """Return where the self-test of a C file goes; a folder or a device has none beside it."""
    path = Path(path)
    with suppress(OSError):  # a name that cannot be there is refused where it is written
        if not path.name or (path.exists() and not path.is_file()):
            return ()
    return (path.with_name(f"{path.stem}_test{path.suffix}"),)


@frozen
class Verification(Result):
    """What a consumer makes of the readings that the calibration was made from.

    Attributes
    ----------
    target : str
    axes : tuple of K str
    positions : tuple of n str
    residuals : (n, K) array [g]
        Force as the consumer finds it, less the reference.
    rms, calibration_rms : float [g]
        Root mean square of what is left by the consumer, and by the calibration itself; of the
        magnitude where the orientation was unknown, of the vector otherwise.
    difference : float or None [g]
        Largest difference from what the calibration gives; None where the target says less.
    foreign : bool
        Whether C was run that is not what `export` writes of this calibration.
    findings : tuple of Finding
        An error where the file is not what `export` writes of this calibration.
    field : Field
        What the calibration is of; of a magnetic field the numbers are in its unit.
    """

    target: str
    axes: tuple[str, ...]
    positions: tuple[str, ...]
    residuals: Array
    rms: float
    calibration_rms: float
    difference: float | None
    foreign: bool = False
    findings: Findings = ()
    field: Field = GRAVITY

    @cached_property
    def max(self) -> float:
        """Largest residual [g]."""
        return float(np.abs(self.residuals).max())

    @property
    def sentence(self) -> str:
        """Whether the file holds, and the largest difference."""
        return in_a_sentence(self.target, self.findings, self.difference, self.field.unit)

    def to_dict(self) -> dict[str, Any]:
        """Return what JSON can carry."""
        residuals = [
            {"position": label, **dict(zip(self.axes, row, strict=True))}
            for label, row in zip(self.positions, self.residuals.tolist(), strict=True)
        ]
        return plain_dict(
            {
                "target": self.target,
                "residuals": residuals,
                "rms": self.rms,
                "max": self.max,
                "calibration_rms": self.calibration_rms,
                "difference": self.difference,
                "foreign": self.foreign,
                "findings": self.findings,
            }
        )

    def __str__(self) -> str:
        return f"{self.in_short}\n\n{self.by_position}\n"

    @property
    def in_short(self) -> str:
        """What is left of the calibration's own readings, in a line or two."""
        small, unit = self._unit
        rms, largest = f"{small * self.rms:.3g} {unit}", f"{small * self.max:.3g} {unit}"
        said = f"Residual error with the {self.target} file: {rms} rms, largest {largest} "
        said += f"(calibration: {small * self.calibration_rms:.3g} {unit} rms)."
        if self.foreign:
            said += "\nThe file is not what export writes of this calibration; it was run as is."
        return said

    @property
    def by_position(self) -> str:
        """What is left at every position, as a table."""
        small, unit = self._unit
        header = ["position", *(f"{axis} [{unit}]" for axis in self.axes)]
        rows = [
            [label, *(f"{small * value:+.4g}" for value in row)]
            for label, row in zip(self.positions, self.residuals.tolist(), strict=True)
        ]
        return table(header, rows)

    @property
    def _unit(self) -> tuple[float, str]:
        """What residuals are multiplied by for people, and their unit then."""
        if self.field.unit == "g":
            return 1e3, "mg"
        return (1.0, self.field.unit) if self.field.unit else (100.0, "%")


@frozen(eq=True)
class Target:
    """A consumer of calibrations.

    Attributes
    ----------
    name : str
        What ``--to`` takes.
    write : function
        Return the file for a calibration; raise `MultiposError` where it cannot express it.
    recognises : function
        Tell from its text whether a file is one of this target.
    read_back : function
        Return what the consumer makes of the calibration's own readings with a file.
    suffix : str
        Of its files.
    is_code : bool
        Whether it is a function with a name, a precision and a self-test beside it.
    takes : tuple of str
        Options of `export` that not every target has.
    fields : tuple of str
        The kinds of field whose sensors it takes.
    """

    name: str
    write: Callable[[Calibration, Wish], Exported]
    recognises: Callable[[str], bool]
    read_back: Callable[[GivenFile, Calibration], Verification]
    suffix: str
    is_code: bool = False
    takes: tuple[str, ...] = ()
    fields: tuple[FieldKind, ...] = ("gravity",)


def find_strange(path: str, difference: float, allowed: float, field: Field = GRAVITY) -> Findings:
    """Return an error where forces differ [g] from the calibration's by more than digits do."""
    if difference <= allowed:
        return ()
    size = f"{difference:.2g} {field.unit}".rstrip()
    text = (
        f"{Path(path).name} differs from this calibration by {size}: it was exported from another, "
        "or changed since"
    )
    return (Finding("export-differs", "error", text, "Export again."),)


def in_a_sentence(target: str, findings: Findings, largest: float | None, of: str) -> str:
    """Return whether a file holds what its calibration gives, and the largest difference of what.

    Rounding, whose last digits differ from machine to machine, has no number.
    """
    holds = "does not hold" if errors_of(findings) else "holds"
    if largest is None:
        return f"The file for {target} {holds}."
    size = f"below {_ROUNDING:g}" if largest < _ROUNDING else number(largest, 2)
    difference = f"{size} {of}".rstrip()
    return f"The file for {target} {holds}: largest difference from multipos {difference}."
