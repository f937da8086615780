"""Targets that take parameters: a matrix and an offset, or an offset and a scale an axis.

`parameter_target` makes one; `origin` returns what a file is of, `require_instance` and
`require_writable` refuse a number of sensor and numbers that the consumer cannot hold.

Their consumers compute corrected = T (raw − o), eq. (1) of `multipos.exports.laws`, or with a
drift (2) of the offset, raw in m/s² or in the unit of the readings. Writing and what the files
share are here; each target has a file of its own.
"""

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import MultiposError, UsageError
from multipos.exports import laws
from multipos.exports.target import Exported, Target, Wish
from multipos.files.spelling import visible
from multipos.files.trees import to_json
from multipos.finding import Finding, forced, in_order
from multipos.sensor.calibration import Calibration, hidden_turn, rms_before
from multipos.sensor.gravity import FieldKind

Written = tuple[str, list[Finding]]  # the text of a file, and what is said of it
Write = Callable[[Calibration, laws.Correction, Wish], Written]

_LARGEST_ID = 2**31 - 1  # autopilots keep it as a whole number of 32 bits with a sign
_CALLED = {"px4": "PX4", "ardupilot": "ArduPilot", "inav": "INAV"}


class Form(NamedTuple):
    """What a consumer does with a kind of sensor.

    Attributes
    ----------
    formula : str
        Terms of its law: LINEAR or DIAGONAL of `multipos.exports.laws`.
    write : function
        Return the text of a file and findings from a calibration, its law in the consumer's unit,
        and what the user asks for.
    raw : str
        What the consumer holds: the readings, counts from the zero of its driver, or m/s².
    thermal : bool
        Whether the consumer lets the offset drift with temperature.
    rounded : function
        Return a law in the consumer's unit as a file of whole numbers holds it.
    tesla : float, optional
        The consumer's unit of a magnetic field, of magnetometers.
    offset_alone : bool
        Whether it takes the offset and no matrix.
    """

    formula: str
    write: Write
    raw: Literal["readings", "counts", "m/s^2"] = "m/s^2"
    thermal: bool = False
    rounded: Callable[[Calibration, laws.Correction], laws.Correction] = lambda _, law: law
    tesla: float | None = None
    offset_alone: bool = False


def parameter_target(name: str, suffix: str, *forms: Form, takes: tuple[str, ...] = ()) -> Target:
    """Return a target whose consumer applies a matrix and an offset, of the kinds of its forms."""
    by_kind: dict[FieldKind, Form] = {
        "gravity" if form.tesla is None else "magnetic": form for form in forms
    }

    def write(calibration: Calibration, wish: Wish) -> Exported:
        return _written(name, by_kind[calibration.field.kind], calibration, wish)

    return Target(name, write, suffix, takes=takes, fields=tuple(by_kind))


def _written(name: str, form: Form, calibration: Calibration, wish: Wish) -> Exported:
    laws.check_inputs(calibration, name, thermal=form.thermal)
    metres = laws.in_metres(calibration, name, form.tesla) if form.raw == "m/s^2" else 1.0
    zero = 0.0 if form.raw == "readings" else laws.raw_zero(calibration)
    law = laws.reduce_to(
        calibration,
        form.formula,
        name,
        allow_lossy=wish.allow_lossy,
        thermal=form.thermal,
        tesla=form.tesla,
        offset_alone=form.offset_alone,
    )
    held = form.rounded(calibration, law.correction.of_raw_in(metres, zero))
    text, found = form.write(calibration, held, wish)
    if law.lost:
        said = _residual_error(calibration, law, _CALLED.get(name, name), form.tesla)
        found = [Finding("lossy", "warning", said), *found]
    if calibration.convention == "gravity":
        said = f"the sign of the force is that of specific force, which {name} uses"
        found.append(Finding("convention-turned", "note", said))
    given = held.of_raw_in(1.0 / metres, -zero * metres)
    return Exported(
        name,
        text,
        findings=in_order(found),
        difference=laws.largest_difference(calibration, given, form.tesla),
        unit=calibration.field.unit,
    )


def _residual_error(
    calibration: Calibration, law: laws.Law, called: str, tesla: float | None
) -> str:
    """Return in words what a law leaves of the readings, beside no calibration and a full one."""
    beside = {"uncalibrated": rms_before(calibration), "full model": calibration.rms}
    said = ", ".join(
        f"{name}: {_rms(calibration, rms)}"
        for name, rms in beside.items()
        if rms is not None and math.isfinite(rms)
    )
    residuals = laws.law_residuals(calibration, law.correction, tesla)
    turned = hidden_turn(calibration, calibration.sign * residuals) is not None
    left = ", without a rotation that hand positioning hides" if turned else ""
    return (
        f"Residual error with the {called} parameters: {_rms(calibration, law.rms)} rms"
        f"{f' ({said})' if said else ''}{left}."
    )


def _rms(calibration: Calibration, rms: float) -> str:
    return calibration.field.shown(rms, ".2f", "mg")


def require_instance(wish: Wish, target: str, allowed: range) -> int:
    """Return the number of the accelerometer, the first where none is asked for.

    Raises
    ------
    UsageError
        The target has no such number, or the ID is none.
    """
    instance = allowed.start if wish.instance is None else wish.instance
    if instance not in allowed:
        raise UsageError(
            f"--instance takes {allowed.start} to {allowed.stop - 1} for --to {target}, got "
            f"{instance}."
        )
    if wish.device_id is not None and not 0 < wish.device_id <= _LARGEST_ID:
        raise UsageError(f"--device-id takes 1 to {_LARGEST_ID}, got {wish.device_id}.")
    return instance


def require_writable(
    calibration: Calibration, name: str, values: ArrayLike, precision: "np.finfo[Any]"
) -> None:
    """Refuse, by name, numbers that the consumer's precision cannot hold, or a scale it loses."""
    least = float(precision.tiny) if "SCAL" in name else 0.0
    for value in np.ravel(values).tolist():
        if not least <= abs(value) <= float(precision.max):
            raise MultiposError(
                f"{name} would be {value:.3g}, which the consumer cannot hold; fit readings in a "
                f"unit nearer to their size than '{calibration.model.unit}'."
            )


def origin(calibration: Calibration) -> list[str]:
    """Return what a file is of, as lines of comments: each stays on its line."""
    source = to_json(calibration.readings.source or "readings").strip()
    lines = [
        f"{calibration.field.sensor} calibration of {source}, model {calibration.model.text}",
        f"made {calibration.created} by multipos {calibration.version}",
    ]
    if calibration.field.unit != "g":
        lines.append(f"field: {calibration.field.text}")
    elif calibration.gravity is None:
        lines.append("one g of the calibration, the local gravity, is taken as 9.80665 m/s^2")
    if calibration.nominal is not None:
        bias, scale = calibration.nominal
        unit = calibration.field.nominal_unit
        said = f"nominal conversion of the readings: (reading - {bias!r}) / {scale!r} in {unit}"
        lines.append(said)
    lines += forced(calibration.diagnostics.findings)
    return [visible(line) for line in lines]
