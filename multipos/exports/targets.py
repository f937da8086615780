"""Write a calibration in the form that a target takes: `export`, by the list `TARGETS`.

`named_target` returns a target of the list, and `beside` where its file goes.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

from multipos.bias_stability.stability_result import Stability, load_stability
from multipos.errors import MultiposError, UsageError
from multipos.exports.parts import Parts, split_parts
from multipos.exports.target import Exported, Target, Wish
from multipos.exports.target_autopilots import ARDUPILOT, INAV, PX4
from multipos.exports.target_c import C
from multipos.exports.target_correction import correction_of, write_correction
from multipos.exports.target_matrices import IMUCAL, KALIBR, ROS, ROS_MAGNETOMETER, write_noise
from multipos.files.spelling import Names, StrPath
from multipos.finding import refuse_unfit
from multipos.sensor.gravity import GRAVITY, Field
from multipos.sensor.inverse import require_response
from multipos.sensor.nominal import read_nominal

# In the order of the documentation.
TARGETS: tuple[Target, ...] = (C, ROS, PX4, ARDUPILOT, ROS_MAGNETOMETER, IMUCAL, KALIBR, INAV)
TargetName = Literal["c", "ros-imu-calib", "px4", "ardupilot", "imucal", "kalibr", "inav", "ros"]
Unit = Literal["g", "m/s^2"]


def export(
    calibration: "Parts | Stability",
    to: TargetName,
    *,
    name: str = "multipos",
    float: bool = False,
    fixed: bool = False,
    allow_lossy: bool = False,
    force: bool = False,
    output_unit: Unit | None = None,
    instance: int | None = None,
    device_id: int | None = None,
    stability: "Stability | StrPath | None" = None,
    correct: Names | None = None,
    tilt: bool = False,
    nominal: Sequence[float] | None = None,
) -> Exported:
    """Return a calibration in the form of a target.

    Parameters
    ----------
    calibration : Calibration or Regression, or a sequence of them, or Stability
        Noise parameters of a stability go to 'kalibr' and 'ros'. Regressions go to C; a
        calibration before them compensates first.
    to : str
        Name of one of `TARGETS`, as ``multipos export --help`` lists them.
    name : str
        The function of a target that is code is called ``NAME_compensate``.
    float : bool
        Single instead of double precision, of a target that is code.
    fixed : bool
        32-bit whole numbers instead of floating point, in C, of linear and quadratic models.
    allow_lossy : bool
        Let go of terms that the target cannot express; the rest is fitted again.
    force : bool
        Export a calibration with implausible findings all the same; the file says so.
    output_unit : str, optional
        'g' or 'm/s^2', of C; one g of a calibration without gravity is taken as 9.80665 m/s².
    instance, device_id : int, optional
        Which of an autopilot's accelerometers it is, and the ID of its device, without which the
        autopilot ignores the file.
    stability : Stability or path, optional
        Of the sensor, whose noise densities go to Kalibr.
    tilt : bool
        Write ``NAME_tilt`` as well, in C: the angles of `apply` with tilt.
    nominal : (bias, scale), optional
        The conversion of the consumer's driver, force [g] = (reading − bias)/scale, of readings in
        counts; that of the calibration if not given.
    correct : names, optional
        The column that each regression corrects; without, C gives the predicted responses.

    Returns
    -------
    Exported

    Raises
    ------
    MultiposError
        The calibration is not fit for use, the target cannot express the model, its inverse does
        not converge in fixed steps, or a regression has rates that are not causal.
    UsageError
        An unknown target, a name that is no C identifier, or an option of another target.

    Examples
    --------
    >>> import multipos as mp
    >>> found = mp.export(mp.demo().calibration, to="c", name="imu")
    >>> [line for line in found.text.splitlines() if line.startswith("void")]
    ['void imu_compensate(const double raw[3], double accel[3])']
    """
    if isinstance(calibration, Stability):
        return write_noise(calibration, to)
    first, regressions = split_parts(calibration)
    first = first and first.of_sensor
    target = _target(to, single=float, field=GRAVITY if first is None else first.field)
    if first is not None and nominal is not None:
        first = replace(first, nominal=read_nominal(nominal))
    others = {
        "output_unit": output_unit,
        "instance": instance,
        "device_id": device_id,
        "stability": stability,
        "tilt": tilt or None,
        "fixed": fixed or None,
    }
    if fixed and (float or tilt or output_unit is not None):
        raise UsageError("--fixed has whole numbers of its own: no --float, --tilt, --output-unit.")
    _check_options(target, {name: value for name, value in others.items() if value is not None})
    if first is not None:
        require_response(first.model, first.parameters, first.mean_environment)
        if not force and not math.isfinite(first.rms):
            raise MultiposError(
                f"the export to {to} is refused, as the model gives no force from its own "
                "readings; drop terms whose coefficient is not significant."
            )
    if first is not None and not force:
        refuse_unfit(first.diagnostics.findings, f"the export to {to}")
    if regressions:
        _check_correction(target, tilt, output_unit, fixed)
        return write_correction(correction_of(first, regressions, correct), name, single=float)
    if correct is not None:
        raise UsageError("--correct goes with a regression; a calibration gives forces.")
    assert first is not None  # or there would be no regression either
    if stability is not None and not isinstance(stability, Stability):
        stability = load_stability(stability)
    in_metres = output_unit == "m/s^2"
    wish = Wish(name, float, allow_lossy, instance, device_id, in_metres, stability, tilt, fixed)
    return target.write(first, wish)


def _target(to: str, *, single: bool, field: Field) -> Target:
    """Return the target that is asked for, of magnetometers or of accelerometers."""
    target = named_target(to)
    if target is None:
        names = ", ".join(each.name for each in TARGETS)
        raise UsageError(f"--to takes {names}, got '{to}'.")
    if field.kind not in target.fields:
        names = ", ".join(each.name for each in TARGETS if field.kind in each.fields)
        raise MultiposError(f"{to} takes no {field.sensor.lower()}; export it --to {names}.")
    if single and not target.is_code:
        codes = ", ".join(target.name for target in TARGETS if target.is_code)
        raise UsageError(f"--float is for --to {codes}; {to} has a precision of its own.")
    return target


def _check_correction(target: Target, tilt: bool, output_unit: Unit | None, fixed: bool) -> None:
    """Refuse what is of a calibration alone where regressions are exported."""
    if fixed:
        raise UsageError("--fixed is of a calibration; a correction takes --float.")
    if tilt:
        raise UsageError("--tilt is of a calibration alone; a correction has no angles.")
    if output_unit is not None:
        raise UsageError("--output-unit is of a calibration alone; a regression has its own.")
    if target is not C:
        name = target.name
        raise UsageError(f"a regression is exported --to {C.name}; {name} has no place for it.")


def _check_options(target: Target, given: dict[str, Any]) -> None:
    """Refuse options that are of other targets, and a unit that is none."""
    for option in given:
        if option not in target.takes:
            owners = ", ".join(each.name for each in TARGETS if option in each.takes)
            name = option.replace("_", "-")
            raise UsageError(f"--{name} is for --to {owners}; {target.name} has no such thing.")
    unit = given.get("output_unit", "g")
    if unit not in get_args(Unit):
        raise UsageError(f"--output-unit takes g or m/s^2, got '{unit}'.")


def named_target(name: str) -> Target | None:
    """Return the target of a name, None where there is none."""
    return next((target for target in TARGETS if target.name == name), None)


def beside(calibration: StrPath, target: Target) -> Path:
    """Return where an export goes beside the file of its calibration: CAL.c, CAL_px4.params, …."""
    path = Path(calibration)
    ending = target.suffix if target.is_code else f"_{target.name}{target.suffix}"
    return path.with_name(f"{path.stem}{ending}")
