"""What a user of each program calls, and what it gives: force from readings, the zero, U of it.

A peer that is not installed is left out, and said. None is a dependency of multipos.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

import multipos as mp
from benchmarks.peer_tasks import ACC, ORDER, Array, Task


@dataclass(frozen=True)
class Found:
    """What a program made of a recording."""

    force: Callable[[Array], Array]  # readings (n, 3) to force [g]
    zero: Array  # (3,) reading without force [reading unit]
    U: Array | None = None  # (3,) of the zero, 95 % [reading unit]
    says: str = ""  # what it says against its own result


class NotDoneError(Exception):
    """The program ended without a result."""


class NoAdviceError(Exception):
    """Nothing is to be done again."""


@dataclass(frozen=True)
class Program:
    """One program and the kinds of recordings that it takes."""

    name: str
    package: str
    kinds: tuple[str, ...]
    run: Callable[[Task], Found]

    @property
    def version(self) -> str | None:
        try:
            return version(self.package)
        except PackageNotFoundError:
            return None


# --- multipos


def plain(task: Task) -> Found:
    """Fit without an option that says more than what was done."""
    return _found(_fit(task))


def as_it_advises(task: Task) -> Found:
    """Fit again with the formula that the caution `missing-term` prints, where there is one."""
    for finding in _fit(task).diagnostics.findings:
        if finding.code == "missing-term":
            formula = finding.action.split("--model '")[1].split("'")[0]
            return _found(_fit(task, model=formula))
    raise NoAdviceError


def exact(task: Task) -> Found:
    """Fit by least squares of exact orientations, all rows of them."""
    return _found(_fit(task, orientation_sd=0, exclude="none"))


def _fit(task: Task, **options: Any) -> mp.Calibration:
    if task.kind == "rests":
        return mp.fit(mp.Readings(task.rests), unknown_orientation=True, **options)
    if task.kind == "faces":
        found = mp.average(
            {name: task.log[name] for name in ACC},
            rate=task.rate,
            sections=task.sections,
            only=ORDER,
            scheme="faces-6",
        )
        return mp.fit(found, **options)
    return mp.fit(mp.average(task.log), unknown_orientation=True, **options)


def _found(cal: mp.Calibration) -> Found:
    zeros = [cal[output, "1"] for output in cal.outputs]
    codes = {d.code for d in cal.findings if d.level != "note"} - {"hidden-terms"}
    return Found(
        cal.compensate,
        np.array([p.value for p in zeros]),
        np.array([p.U for p in zeros]),
        ", ".join(sorted(codes)),
    )


# --- peers


def mag_cal(task: Task) -> Found:
    """CircuitPython_mag_cal: the ellipsoid by linear algebra, through the means of the rests."""
    from mag_cal.sensor import Sensor

    sensor = Sensor()
    error = sensor.fit_ellipsoid(task.rests)
    if not np.isfinite(error):
        raise NotDoneError("not a number")
    return Found(lambda raw: sensor.apply(raw.copy()), np.asarray(sensor.centre).ravel())


def imucal(task: Task) -> Found:
    """Run Ferraris' method of imucal: six faces and three turns in a log with its sections."""
    import pandas as pd
    from imucal import FerrarisCalibration, ferraris_regions_from_section_list

    sections = pd.DataFrame(task.sections).T
    regions = ferraris_regions_from_section_list(pd.DataFrame(task.log), sections)
    units = {"from_acc_unit": "m/s^2", "from_gyr_unit": "deg/s"}
    ferraris = FerrarisCalibration()
    cal = ferraris.compute(regions, sampling_rate_hz=task.rate, **units)
    back = np.linalg.inv(cal.R_a) @ np.linalg.inv(cal.K_a)
    return Found(lambda raw: (raw - cal.b_a) @ back.T / ferraris.grav, np.asarray(cal.b_a))


def actipy(task: Task) -> Found:
    """actipy's calibrate_gravity, after van Hees and others (2014)."""
    import pandas as pd
    from actipy.processing import calibrate_gravity

    table = pd.DataFrame({axis: task.log[name] for axis, name in zip("xyz", ACC, strict=True)})
    table.index = pd.to_datetime(task.log["time"], unit="s")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _, told = calibrate_gravity(table)
    if not told["CalibOK"] or "CalibxIntercept" not in told:
        raise NotDoneError("not calibrated")
    zero = np.array([told[f"Calib{axis}Intercept"] for axis in "xyz"])
    slope = np.array([told[f"Calib{axis}Slope"] for axis in "xyz"])
    return Found(lambda raw: zero + raw * slope, -zero / slope)


def skdh(task: Task) -> Found:
    """CalibrateAccelerometer of scikit-digital-health, after the same paper."""
    from skdh.preprocessing import CalibrateAccelerometer

    accel = np.column_stack([task.log[name] for name in ACC])
    told = CalibrateAccelerometer(min_hours=12).predict(time=task.log["time"], accel=accel)
    if "offset" not in told or not np.any(told["offset"]):
        raise NotDoneError("not calibrated")
    return Found(lambda raw: (raw + told["offset"]) * told["scale"], -told["offset"])


PROGRAMS = (
    Program("multipos", "multipos", ("rests", "faces", "worn"), plain),
    Program("multipos, then as it advises", "multipos", ("rests", "worn"), as_it_advises),
    Program("multipos --orientation-sd 0", "multipos", ("faces",), exact),
    Program("mag_cal", "circuitpython-mag-cal", ("rests",), mag_cal),
    Program("imucal", "imucal", ("faces",), imucal),
    Program("actipy", "actipy", ("worn",), actipy),
    Program("skdh", "scikit-digital-health", ("worn",), skdh),
)
