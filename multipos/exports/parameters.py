"""Targets that take parameters: a matrix and an offset, or an offset and a scale an axis.

Their consumers compute corrected = T (raw − o), eq. (1) of `multipos.exports.laws`, or with a
drift (2) of the offset, raw in m/s² or in the unit of the readings. Writing, reading back and what
the files share are here; each target has a file of its own.
"""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import MultiposError, UsageError
from multipos.exports import laws
from multipos.exports.target import Exported, GivenFile, Target, Verification, Wish, find_strange
from multipos.files.spelling import visible
from multipos.files.trees import to_json
from multipos.finding import Finding, forced, in_order
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.sensor.calibration import Calibration, hidden_turn, rms_before
from multipos.sensor.gravity import FieldKind
from multipos.sensor.nominal import read_nominal

Written = tuple[str, list[Finding]]  # the text of a file, and what is said of it

_LARGEST_ID = 2**31 - 1  # autopilots keep it as a whole number of 32 bits with a sign
_NOMINAL = re.compile(
    r"^# nominal conversion of the readings: \(reading - (\S+)\) / (\S+) in (?:g|uT)$", re.MULTILINE
)
_CALLED = {"px4": "PX4", "ardupilot": "ArduPilot", "inav": "INAV"}
_SAME = 1e-6  # how far the forces of a file may be from those of its law [g]


def parameter_target(
    name: str,
    formula: str,
    *,
    raw: Literal["readings", "counts", "m/s^2"],
    write: Callable[[Calibration, laws.Correction, Wish], Written],
    recognises: Callable[[str], bool],
    read: Callable[[str, str], laws.Correction],
    suffix: str,
    thermal: bool = False,
    takes: tuple[str, ...] = (),
    same: Callable[[Calibration], float] = lambda _: _SAME,
    tesla: float | None = None,
    offset_alone: bool = False,
) -> Target:
    """Return a target whose consumer applies a matrix and an offset.

    Parameters
    ----------
    name : str
    formula : str
        Terms of its law: LINEAR or DIAGONAL of `multipos.exports.laws`.
    raw : str
        What the consumer holds: the readings, counts from the zero of its driver, or m/s².
    write : function
        Return the text of a file and findings from a calibration, its law in the consumer's unit,
        and what the user asks for.
    recognises : function
        Tell from its text whether a file is one of this target.
    read : function
        Return the law in the consumer's unit from the path and the text of a file.
    suffix : str
        Of its files.
    thermal : bool
        Whether the consumer lets the offset drift with temperature.
    takes : tuple of str
        Options of `export` that it has.
    same : function
        How far [g] the forces of a file may be from those of the law, which it may hold rounded.
    tesla : float, optional
        The consumer's unit of a magnetic field, of a target for magnetometers.
    offset_alone : bool
        Whether it takes the offset and no matrix.
    """
    of_target = partial(laws.reduce_to, thermal=thermal, tesla=tesla, offset_alone=offset_alone)

    def conversion(calibration: Calibration) -> tuple[float, float]:
        """Return what the consumer holds for a unit of the readings, and the reading of its 0."""
        laws.check_inputs(calibration, name, thermal=thermal)
        metres = laws.in_metres(calibration, name, tesla) if raw == "m/s^2" else 1.0
        return metres, 0.0 if raw == "readings" else laws.raw_zero(calibration)

    def write_file(calibration: Calibration, wish: Wish) -> Exported:
        metres, zero = conversion(calibration)
        law = of_target(calibration, formula, name, allow_lossy=wish.allow_lossy)
        text, found = write(calibration, law.correction.of_raw_in(metres, zero), wish)
        if law.lost:
            said = _residual_error(calibration, law, _CALLED.get(name, name), tesla)
            found = [Finding("lossy", "warning", said), *found]
        if calibration.convention == "gravity":
            said = f"the sign of the force is that of specific force, which {name} uses"
            found.append(Finding("convention-turned", "note", said))
        return Exported(name, text, findings=in_order(found))

    def read_file(file: GivenFile, calibration: Calibration) -> Verification:
        given = read(file.path, file.text)
        if (stated := _NOMINAL.search(file.text)) is not None:
            calibration = replace(calibration, nominal=read_nominal([*map(float, stated.groups())]))
        expected = of_target(calibration, formula, name, allow_lossy=True).correction
        metres, zero = conversion(calibration)
        with np.errstate(over="ignore", invalid="ignore"):  # any numbers may stand in the file
            law = given.of_raw_in(1.0 / metres, -zero * metres)._replace(turn=expected.turn)
            residuals = laws.law_residuals(calibration, law, tesla)
            should = laws.law_residuals(calibration, expected, tesla)
            thermal_too = (given.drift is None) == (expected.drift is None)
            difference = float(np.abs(residuals - should).max()) if thermal_too else np.inf
            rms = laws.rms_left(calibration, residuals)
        return Verification(
            target=name,
            axes=COMPONENTS,
            positions=calibration.readings.labels,
            residuals=residuals,
            rms=rms,
            calibration_rms=calibration.rms,
            difference=difference if math.isfinite(difference) else None,
            findings=find_strange(
                file.path, difference, same(calibration) * size_of(calibration), calibration.field
            ),
            field=calibration.field,
        )

    field: FieldKind = "gravity" if tesla is None else "magnetic"
    return Target(name, write_file, recognises, read_file, suffix, takes=takes, fields=(field,))


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


def size_of(calibration: Calibration) -> float:
    """Return the size of a magnetic reference, 1 of gravity, to which roundings are relative."""
    return calibration.field.full_scale


def read_named(path: str, text: str, names: tuple[str, ...]) -> Array:
    """Return the values of parameters from lines of names and values.

    Raises
    ------
    MultiposError
        One is missing, no number, or given twice.
    """
    values: dict[str, str] = {}
    for line in text.splitlines():
        if line.startswith("#"):
            continue
        cells = re.split(r"[\s,]+", line.strip())
        for name, value in pairwise(cells):
            if name not in names:
                continue
            if values.get(name, value) != value:
                raise MultiposError(
                    f"{path}: parameter {name} is given twice, as {values[name]!r:.40} and "
                    f"{value!r:.40}; leave one."
                )
            values[name] = value
    missing = [name for name in names if name not in values]
    if missing:
        raise MultiposError(f"{path}: parameter {missing[0]} is missing; export again.")
    return read_numbers(path, names[0], [values[name] for name in names], len(names))


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


def solve(path: str, key: str, matrix: Array, right: Array) -> Array:
    """Return the inverse of a matrix that a file holds, times what stands to its right."""
    try:
        return np.asarray(np.linalg.solve(matrix, right))
    except np.linalg.LinAlgError:
        raise MultiposError(f"{path}: {key} has no inverse; export again.") from None


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


def read_numbers(path: str, key: str, cells: list[str], count: int) -> Array:
    """Return the finite numbers that so many cells of a file hold."""
    try:
        values = np.array([float(cell) for cell in cells])
    except ValueError:
        values = np.empty(0)
    if len(values) != count or not np.isfinite(values).all():
        raise MultiposError(f"{path}: {key} needs {count} numbers; export again.")
    return values
