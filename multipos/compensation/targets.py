"""Write a calibration in the form that a target takes."""

import os
from pathlib import Path
from typing import Literal

from multipos.compensation.parts import Parts, split_parts
from multipos.compensation.target import Exported, Target, Wish
from multipos.compensation.target_ardupilot import ARDUPILOT
from multipos.compensation.target_c import C
from multipos.compensation.target_correction import correction_of, write_correction
from multipos.compensation.target_px4 import PX4
from multipos.compensation.target_ros import ROS
from multipos.errors import UsageError
from multipos.files.lists import Names

# In the order of the documentation; the first that recognises a file reads it back.
TARGETS: tuple[Target, ...] = (C, ROS, PX4, ARDUPILOT)
Name = Literal["c", "ros-imu-calib", "px4", "ardupilot"]  # for those who check types


def export(
    calibration: Parts,
    to: Name,
    *,
    name: str = "multipos",
    float: bool = False,
    allow_lossy: bool = False,
    correct: Names | None = None,
) -> Exported:
    """Return a calibration in the form of a target.

    Parameters
    ----------
    calibration : Calibration or Regression, or a sequence of them
        Regressions go to C; a calibration before them compensates first.
    to : str
        Name of one of `TARGETS`, as ``multipos export --help`` lists them.
    name : str
        The function of a target that is code is called ``NAME_compensate``.
    float : bool
        Single instead of double precision, of a target that is code.
    allow_lossy : bool
        Let go of terms that the target cannot express; the rest is fitted again.
    correct : names, optional
        The column that each regression corrects; without, C gives the predicted responses.

    Returns
    -------
    Exported

    Raises
    ------
    MultiposError
        The target cannot express the model, its inverse does not converge in fixed steps, or a
        regression has rates that are not causal.
    UsageError
        An unknown target, a name that is no C identifier, or an option of another target.
    """
    target = named_target(to)
    if target is None:
        names = ", ".join(target.name for target in TARGETS)
        raise UsageError(f"--to takes {names}, got '{to}'.")
    if float and not target.is_code:
        codes = ", ".join(target.name for target in TARGETS if target.is_code)
        raise UsageError(f"--float is for --to {codes}; {to} has a precision of its own.")
    first, regressions = split_parts(calibration)
    if regressions:
        if target is not C:
            raise UsageError(f"a regression is exported --to {C.name}; {to} has no place for it.")
        return write_correction(correction_of(first, regressions, correct), name, single=float)
    if correct is not None:
        raise UsageError("--correct goes with a regression; a calibration gives forces.")
    assert first is not None  # or there would be no regression either
    return target.write(first, Wish(name, float, allow_lossy))


def named_target(name: str) -> Target | None:
    """Return the target of a name, None where there is none."""
    return next((target for target in TARGETS if target.name == name), None)


def beside(calibration: str | os.PathLike[str], target: Target) -> Path:
    """Return where an export goes beside the file of its calibration: CAL.c, CAL_px4.params, …."""
    path = Path(calibration)
    ending = target.suffix if target.is_code else f"_{target.name}{target.suffix}"
    return path.with_name(f"{path.stem}{ending}")


def recognised_target(text: str) -> Target | None:
    """Return the first target that takes a text for a file of its own, None where none does."""
    return next((target for target in TARGETS if target.recognises(text)), None)
