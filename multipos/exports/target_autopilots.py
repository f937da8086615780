"""Autopilots: accelerometers and magnetometers of PX4 and ArduPilot, accelerometers of INAV.

PX4 [1]_: ``CAL_ACC0_XOFF`` … and ``CAL_ACC0_XSCALE`` …, in the form of QGroundControl. It takes
corrected = (raw − OFF − thermal offset) SCALE axis by axis, raw in m/s², so that OFF = o at the
mean temperature and SCALE = T_ii. The thermal offset [2]_ is Σ X_k (t − TREF)^k, k = 0 to 3, with t
held to TMIN … TMAX, so that ``TC_A0_X1_0`` … are c_1 … of the x axis and X0 is 0.

ArduPilot [3]_: ``INS_ACCOFFS_X`` … and ``INS_ACCSCAL_X`` …, in the form of Mission Planner. It
takes corrected = (raw − p(t) + p(CALTEMP) − OFFS) SCAL axis by axis, raw in m/s², so that OFFS = o
at the temperature CALTEMP and SCAL = T_ii. The drift [4]_ is

    p(t) = 1e-6 [ACC1 (t − 35) + ACC2 (t − 35)² + ACC3 (t − 35)³],                          (1)

t in °C and held to TMIN … TMAX.

Of a magnetometer they correct hard iron, and the symmetric root of soft iron: PX4 [5]_, in gauss,
corrected = S (raw − OFF), and ArduPilot [6]_, in milligauss and after the turn of its board,
corrected = S (raw + OFS), so that OFF = o and OFS = −o, with

    S = [[SCALE_x, ODIAG_x, ODIAG_y], [·, SCALE_y, ODIAG_z], [·, ·, SCALE_z]],             (2)

which ArduPilot calls DIA and ODI.

PX4 looks a calibration up by the ID of the sensor's device: what stands under another ID, or none,
is not used. ArduPilot takes an accelerometer for calibrated where the saved ``INS_ACC_ID`` is that
of its device [7]_.

INAV [8]_ and Betaflight [9]_: lines for the command line of the flight controller. INAV finds
g = (raw − acczero) accgain/(4096 · 1G) axis by axis, raw in counts of the sensor, whole numbers all
of them, with 1G the counts that its driver takes for a g; so that acczero = o and
accgain = 4096 · 1G · T_ii, T_ii in g per count. 1G is that of the known drivers which is nearest
to the calibrated scale factor, and is said; where a nominal conversion is stated, its scale, and
raw counts from its bias. Rounding leaves up to half a count and 1/8192 g. Betaflight has an offset
alone: ``acc_calibration`` is o, in the axes of the board.

References
----------
.. [1] PX4-Autopilot, ``sensor_calibration/Accelerometer.hpp``, ``Correct``, and
   ``Accelerometer.cpp``, ``ParametersUpdate``.
.. [2] PX4-Autopilot, ``TemperatureCompensation.cpp``, ``calc_thermal_offsets_3D``.
.. [3] ArduPilot, ``AP_InertialSensor_Backend::_rotate_and_correct_accel``.
.. [4] ArduPilot, ``AP_InertialSensor_tempcal.cpp``, ``correct_sensor``.
.. [5] PX4-Autopilot, ``sensor_calibration/Magnetometer.hpp``, ``Correct``, and
   ``Magnetometer.cpp``, ``ParametersUpdate``.
.. [6] ArduPilot, ``AP_Compass_Backend.cpp``, ``correct_field``; limits: ``CompassCalibrator.cpp``,
   ``fit_acceptable``, and ``COMPASS_OFFS_MAX``.
.. [7] ArduPilot, ``AP_InertialSensor::accel_calibrated_ok_all``.
.. [8] iNavFlight/inav, ``sensors/acceleration.c``, ``applyAccelerationZero``.
.. [9] betaflight, ``sensors/acceleration.c``, ``applyAccelerationTrims``.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from multipos.errors import MultiposError
from multipos.exports import parameters
from multipos.exports.laws import DIAGONAL, LINEAR, Correction, Drift, scale_per_g
from multipos.exports.target import Wish
from multipos.finding import Finding
from multipos.sensor.calibration import Calibration
from multipos.units import STANDARD_GRAVITY

_Values = list[tuple[str, float | int]]  # of parameters, by name
_Naming = Callable[[int], tuple[str, ...]]  # of the parameters of an instance

_GAUSS, _MILLIGAUSS = 1e-4, 1e-7
_UPPER = ((0, 1), (0, 2), (1, 2))  # of eq. (2), where x, y, z of the off-diagonals stand
_REFERENCE = 35.0  # [°C], t of eq. (1) is counted from it
_UNIT = 1e-6
_REAL32, _INT32 = 9, 6  # MAV_PARAM_TYPE
_BESIDE = 1.0  # what ground stations accept beside the diagonal of a magnetometer's matrix


# --- PX4 and ArduPilot: a table of what each calls its parameters and does with them


def _numbered(instance: int) -> str:
    return "" if instance == 1 else str(instance)  # the first has none


def _names(templates: str) -> _Naming:
    """Return what names the parameters of an instance, each that has an axis for all three."""

    def names(i: int) -> tuple[str, ...]:
        every = [
            template.format(i=i, n=_numbered(i), axis=axis, place=place)
            for template in templates.split()
            for place, axis in enumerate("XYZ")
        ]
        return tuple(dict.fromkeys(every))

    return names


_px4_names = _names("CAL_ACC{i}_{axis}OFF CAL_ACC{i}_{axis}SCALE")
_px4_mag_names = _names("CAL_MAG{i}_{axis}OFF CAL_MAG{i}_{axis}SCALE CAL_MAG{i}_{axis}ODIAG")
_px4_slopes = _names("TC_A{i}_X1_{place} TC_A{i}_X2_{place} TC_A{i}_X3_{place}")
_px4_limits = _names("TC_A{i}_TREF TC_A{i}_TMIN TC_A{i}_TMAX")
_ardupilot_names = _names("INS_ACC{n}OFFS_{axis} INS_ACC{n}SCAL_{axis}")
_ardupilot_mag_names = _names("COMPASS_OFS{n}_{axis} COMPASS_DIA{n}_{axis} COMPASS_ODI{n}_{axis}")
_ardupilot_slopes = _names(
    "INS_TCAL{i}_ACC1_{axis} INS_TCAL{i}_ACC2_{axis} INS_TCAL{i}_ACC3_{axis}"
)
_ardupilot_limits = _names("INS_ACC{i}_CALTEMP INS_TCAL{i}_TMIN INS_TCAL{i}_TMAX")


def _px4_thermal(drift: Drift, instance: int, device_id: int | None) -> _Values:
    """Return the parameters of the thermal offset."""
    limits = (drift.reference, drift.low, drift.high)
    return [
        ("TC_A_ENABLE", 1),
        *([] if device_id is None else [(f"TC_A{instance}_ID", device_id)]),
        *((f"TC_A{instance}_X0_{axis}", 0.0) for axis in range(3)),
        *zip(_px4_slopes(instance), drift.slopes.ravel().tolist(), strict=True),
        *zip(_px4_limits(instance), limits, strict=True),
    ]


def _ardupilot_thermal(drift: Drift, instance: int, _: int | None) -> _Values:
    """Return the parameters of eq. (1)."""
    slopes = (drift.about(_REFERENCE).slopes / _UNIT).ravel().tolist()
    limits = (drift.reference, drift.low, drift.high)
    return [
        (f"INS_TCAL{instance}_ENABLE", 1),
        *zip(_ardupilot_limits(instance), limits, strict=True),
        *zip(_ardupilot_slopes(instance), slopes, strict=True),
    ]


class _Stack(NamedTuple):
    """How a flight stack writes the parameters of all its sensors."""

    name: str
    suffix: str
    instances: range
    without_id: str  # what it does then
    columns: tuple[str, ...]  # of its file
    line: str  # of a value
    thermal: Callable[[Drift, int, int | None], _Values]
    drift: str  # of the offset, in its equation


class _Sensed(NamedTuple):
    """How a flight stack holds a kind of sensor."""

    names: _Naming
    device: str  # the parameter with its ID
    equation: str
    sign: float = 1.0  # of the offset
    offset: float = np.inf  # the largest that ground stations accept [m/s², milligauss]
    scale: tuple[float, float] = (-np.inf, np.inf)  # between which they accept it
    turned_by: str = "convention"  # what else may be wrong where it is beyond


_PX4 = _Stack(
    name="PX4",
    suffix=".params",
    instances=range(4),
    without_id="PX4 will ignore the file",
    columns=("#", "# Vehicle-Id Component-Id Name Value Type"),
    line="1\t1\t{name}\t{value!r}\t{kind}",
    thermal=_px4_thermal,
    drift=" - sum of X_k (t - {reference:.6g})^k",
)
_ARDUPILOT = _Stack(
    name="ArduPilot",
    suffix=".parm",
    instances=range(1, 4),
    without_id="ArduPilot will ask for a calibration",
    columns=(),
    line="{name},{value!r}",
    thermal=_ardupilot_thermal,
    drift=" - p(t) + p(CALTEMP)",
)
_PX4_ACCELEROMETER = _Sensed(
    _px4_names, "CAL_ACC{i}_ID", "corrected = (raw - OFF{thermal}) SCALE, in m/s^2"
)
_PX4_MAGNETOMETER = _Sensed(
    _px4_mag_names,
    "CAL_MAG{i}_ID",
    "corrected = S (raw - OFF), in gauss, S = SCALE on its diagonal, ODIAG off it",
)
_ARDUPILOT_ACCELEROMETER = _Sensed(
    _ardupilot_names,
    "INS_ACC{n}_ID",
    "corrected = (raw - OFFS{thermal}) SCAL, in m/s^2",
    offset=3.5,
    scale=(0.8, 1.2),
)
_ARDUPILOT_MAGNETOMETER = _Sensed(
    _ardupilot_mag_names,
    "COMPASS_DEV_ID{n}",
    "corrected = S (raw + OFS), in milligauss, S = DIA on its diagonal, ODI off it",
    sign=-1.0,
    offset=1800.0,
    scale=(0.2, 5.0),
    turned_by="axes",
)


def _values(
    calibration: Calibration, law: Correction, names: tuple[str, ...], sign: float = 1.0
) -> _Values:
    """Return offset, diagonal and, where named, off-diagonals, that single precision is to hold."""
    beside = [law.matrix[place] for place in _UPPER]
    values = np.concatenate([sign * law.offset, np.diag(law.matrix), beside])[: len(names)].tolist()
    for name, value in zip(names, values, strict=True):
        if value or "ODI" not in name:
            parameters.require_writable(calibration, name, value, np.finfo(np.float32))
    return list(zip(names, values, strict=True))


def _turned(law: Correction) -> list[str]:
    """Return what is said of the turn that a symmetric matrix leaves open."""
    if np.allclose(law.turn, np.eye(3)):
        return []
    return ["the matrix is the symmetric root: orientations were unknown, and so is a turn"]


def _beyond(found: _Values, sensed: _Sensed) -> list[Finding]:
    """Return what the ground stations do not accept; those of PX4 take anything."""
    if not np.isfinite(sensed.offset):
        return []
    offset, (low, high) = sensed.offset, sensed.scale
    bad = [name for name, value in found[:3] if abs(value) > offset]
    bad += [name for name, value in found[3:6] if not low <= value <= high]
    bad += [name for name, value in found[6:] if abs(value) >= _BESIDE]
    text = f"{', '.join(bad)} exceed what ArduPilot accepts"
    action = f"Check the unit and the {sensed.turned_by}."
    return [Finding("beyond-target", "warning", text, action)] if bad else []


def _of_stack(stack: _Stack, sensed: _Sensed) -> parameters.Write:
    """Return what writes the parameters of a kind of sensor of a flight stack."""

    def write(calibration: Calibration, law: Correction, wish: Wish) -> parameters.Written:
        instance = parameters.require_instance(wish, stack.name.lower(), stack.instances)
        found = _values(calibration, law, sensed.names(instance), sensed.sign)
        findings = _beyond(found, sensed)
        device = sensed.device.format(i=instance, n=_numbered(instance))
        if wish.device_id is None:
            text = f"{device} is missing; {stack.without_id}"
            findings.append(Finding("no-device-id", "warning", text, "Add --device-id."))
        else:
            found.insert(0, (device, wish.device_id))
        thermal = ""
        if law.drift is not None:
            found += stack.thermal(law.drift, instance, wish.device_id)
            thermal = stack.drift.format(reference=law.drift.reference)
        equation = sensed.equation.format(thermal=thermal)
        head = [*parameters.origin(calibration), *_turned(law), equation]
        lines = [*(f"# {line}" for line in head), *stack.columns]
        for name, value in found:
            kind = _INT32 if isinstance(value, int) else _REAL32
            lines.append(stack.line.format(name=name, value=value, kind=kind))
        return "\n".join(lines) + "\n", findings

    return write


PX4 = parameters.parameter_target(
    "px4",
    _PX4.suffix,
    parameters.Form(DIAGONAL, _of_stack(_PX4, _PX4_ACCELEROMETER), thermal=True),
    parameters.Form(LINEAR, _of_stack(_PX4, _PX4_MAGNETOMETER), tesla=_GAUSS),
    takes=("instance", "device_id"),
)
ARDUPILOT = parameters.parameter_target(
    "ardupilot",
    _ARDUPILOT.suffix,
    parameters.Form(DIAGONAL, _of_stack(_ARDUPILOT, _ARDUPILOT_ACCELEROMETER), thermal=True),
    parameters.Form(LINEAR, _of_stack(_ARDUPILOT, _ARDUPILOT_MAGNETOMETER), tesla=_MILLIGAUSS),
    takes=("instance", "device_id"),
)


# --- INAV

_INAV_UNITY = 4096  # accgain of a sensor that needs none
_GAINS = range(1, 8193)
_ZEROS = range(-(2**15), 2**15)
# Counts of a g in the drivers: powers of two, and 1365 of a sensor of 24 g.
_ONE_G = (256, 512, 1024, 1365, 2048, 4096, 8192, 16384)
_FEWEST = 100.0  # counts of a g; less is no unit of counts
_INAV_NAMES = tuple(f"acc{kind}_{axis}" for kind in ("zero", "gain") for axis in "xyz")


def _counts_of_g(calibration: Calibration) -> int:
    """Return what the driver of the flight controller takes for a g."""
    scale = scale_per_g(calibration)
    if calibration.model.unit not in ("reading", "count", "counts", "LSB") or scale < _FEWEST:
        raise MultiposError(
            f"inav holds raw values in counts of the sensor, but the readings are in "
            f"'{calibration.model.unit}' with a scale factor of {scale:.4g} per g; log counts, "
            "with acczero 0 and accgain 4096, or state --unit count in fit."
        )
    if calibration.nominal is not None:
        return round(abs(calibration.nominal.scale))
    return min(_ONE_G, key=lambda counts: abs(np.log(scale / counts)))


def _rounded_for_inav(calibration: Calibration, law: Correction) -> Correction:
    """Return the law of whole numbers: half a count of zero, half a step of gain."""
    unity = _INAV_UNITY * _counts_of_g(calibration) / STANDARD_GRAVITY
    gains = np.rint(unity * np.diag(law.matrix))
    return Correction(np.diag(gains) / unity, np.rint(law.offset))


def _write_inav(calibration: Calibration, law: Correction, _: Wish) -> parameters.Written:
    counts = _counts_of_g(calibration)
    gains = np.rint(_INAV_UNITY * counts * np.diag(law.matrix) / STANDARD_GRAVITY)
    values = [*law.offset.tolist(), *gains.tolist()]
    for name, value in zip(_INAV_NAMES, values, strict=True):
        allowed = _ZEROS if "zero" in name else _GAINS
        if not allowed.start <= value < allowed.stop:
            raise MultiposError(
                f"{name} would be {value:.6g}, but inav takes {allowed.start} to "
                f"{allowed.stop - 1}; an axis that is reversed or far from its nominal scale has "
                "no place there."
            )
    whole = [int(value) for value in values]
    lines = [
        *(f"# {line}" for line in parameters.origin(calibration)),
        f"# 1G = {counts} counts, corrected = (raw - acczero) accgain / (4096 1G) in g",
        *(f"set {name} = {value}" for name, value in zip(_INAV_NAMES, whole, strict=True)),
        "save",
        f"# Betaflight, offsets alone: set acc_calibration = {','.join(map(str, whole[:3]))},1",
    ]
    if calibration.nominal is not None:
        return "\n".join(lines) + "\n", []
    text = (
        f"1 g of the flight controller is taken as {counts} counts; forces are wrong by the ratio "
        "if its driver uses another number"
    )
    return "\n".join(lines) + "\n", [Finding("assumed-counts", "note", text)]


INAV = parameters.parameter_target(
    "inav",
    ".txt",
    parameters.Form(DIAGONAL, _write_inav, raw="counts", rounded=_rounded_for_inav),
)
