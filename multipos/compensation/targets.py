"""Write a calibration in the form that a target takes."""

import os
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

from multipos.compensation.c_source import c_source, c_test
from multipos.compensation.laws import loss_text
from multipos.compensation.parameters import write_ardupilot, write_px4, write_ros
from multipos.errors import UsageError
from multipos.files.tables import written
from multipos.results import Result
from multipos.sensor.calibration import Calibration

Target = Literal["c", "ros-imu-calib", "px4", "ardupilot"]
TARGETS: tuple[Target, ...] = get_args(Target)
_PARAMETER_WRITERS = {
    "ros-imu-calib": write_ros,
    "px4": write_px4,
    "ardupilot": write_ardupilot,
}


@dataclass(frozen=True, eq=False)
class Exported(Result):
    """A calibration in the form of a target.

    Attributes
    ----------
    target : str
    text : str
        Content of the file.
    test : str or None
        C program that checks the function, for a file beside it.
    notes : tuple of str
        What is lost or doubtful, in words.
    """

    target: str
    text: str
    test: str | None = None
    notes: tuple[str, ...] = field(default=())

    def save(self, path: str | os.PathLike[str]) -> tuple[str, ...]:
        """Write the file, for C also ``…_test.c`` beside it; return the names written."""
        files = self.files(path)
        with written(files):
            pass
        return tuple(map(str, files))

    def files(self, path: str | os.PathLike[str]) -> dict[str | os.PathLike[str], str]:
        """Return the files to write, and what they hold."""
        beside = () if self.test is None else self_test(path)
        return {path: self.text, **dict.fromkeys(beside, self.test or "")}


def self_test(path: str | os.PathLike[str]) -> tuple[Path, ...]:
    """Return where the self-test of a C file goes; a folder or a device has none beside it."""
    path = Path(path)
    with suppress(OSError):  # a name that cannot be there is refused where it is written
        if not path.name or (path.exists() and not path.is_file()):
            return ()
    return (path.with_name(f"{path.stem}_test{path.suffix}"),)


def export(
    calibration: Calibration,
    to: Target,
    *,
    name: str = "multipos",
    float: bool = False,
    allow_lossy: bool = False,
) -> Exported:
    """Return a calibration in the form of a target.

    Parameters
    ----------
    calibration : Calibration
    to : str
        'c', 'ros-imu-calib', 'px4' or 'ardupilot'.
    name : str
        The C function is called ``NAME_compensate``.
    float : bool
        Single instead of double precision, in C.
    allow_lossy : bool
        Let go of terms that the target cannot express; the rest is fitted again.

    Returns
    -------
    Exported

    Raises
    ------
    MultiposError
        The target cannot express the model, or its inverse does not converge in fixed steps.
    UsageError
        An unknown target, a name that is no C identifier, or an option of another target.
    """
    if to == "c":
        text = c_source(calibration, name, single=float)
        return Exported(to, text, c_test(calibration, name, single=float))
    if to not in TARGETS:
        raise UsageError(f"--to takes {', '.join(TARGETS)}, got '{to}'.")
    if float:
        raise UsageError(f"--float is for --to c; {to} has a precision of its own.")
    text, law, notes = _PARAMETER_WRITERS[to](calibration, allow_lossy=allow_lossy)
    if law.lost:
        notes = [loss_text(calibration, law, to), *notes]
    if calibration.convention == "gravity":
        notes.append(f"the force is turned from gravity to specific force, which {to} works in")
    return Exported(to, text, notes=tuple(notes))
