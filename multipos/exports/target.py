"""A target: a consumer of calibrations, and how a file for it is written.

Each target is a `Target` in a file of this room, with its like, and one line in the list of
`multipos.exports.targets`. Consumers that take a matrix and an offset are made by
`multipos.exports.parameters.parameter_target`.
"""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from multipos.bias_stability.stability_result import Stability
from multipos.files.numbers import number
from multipos.files.spelling import StrPath
from multipos.files.whole import written
from multipos.finding import Findings
from multipos.results import Result, frozen
from multipos.sensor.calibration import Calibration
from multipos.sensor.gravity import FieldKind

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
    single: bool = False
    allow_lossy: bool = False
    instance: int | None = None
    device_id: int | None = None
    in_metres: bool = False
    stability: Stability | None = None
    tilt: bool = False
    fixed: bool = False


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
    difference : float or None [g]
        Largest difference of what the file gives from what the calibration gives, at the
        calibration's own readings, of whole numbers over all their range; of a magnetometer in
        the unit of its field. None where
        Python has not the file's arithmetic: of C in floating point, which its self-test holds.
    unit : str
        Of the difference.
    """

    target: str
    text: str
    test: str | None = None
    findings: Findings = ()
    difference: float | None = None
    unit: str = "g"

    @property
    def residual(self) -> str:
        """The difference in words; nothing where there is none.

        Rounding, whose last digits differ from machine to machine, has no number.
        """
        if self.difference is None:
            return ""
        size = "at most " + number(self.difference, 2)
        if self.difference < _ROUNDING:
            size = f"less than {_ROUNDING:g}"
        return f"It differs from the calibration by {size} {self.unit}".rstrip() + "."

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


@frozen(eq=True)
class Target:
    """A consumer of calibrations.

    Attributes
    ----------
    name : str
        What ``--to`` takes.
    write : function
        Return the file for a calibration; raise `MultiposError` where it cannot express it.
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
    suffix: str
    is_code: bool = False
    takes: tuple[str, ...] = ()
    fields: tuple[FieldKind, ...] = ("gravity",)
