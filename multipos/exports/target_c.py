"""A C99 function, see `multipos.exports.c_source`; read back by compiling and running it.

A C file may come from somebody else, and to compile and run it is to do what it says. So the file
is written again from the calibration, and where both are the same to the byte, it is the text of
this program that is compiled. Any other C runs only where the user says so.
"""

import re

import numpy as np

from multipos import __version__
from multipos.errors import MultiposError
from multipos.exports.c_fixed import (
    FIXED,
    find_fixed_point,
    fixed_forces,
    fixed_signature,
    fixed_test,
)
from multipos.exports.c_running import run_c
from multipos.exports.c_source import (
    METRES,
    SIGNATURE,
    WRITTEN_BY,
    c_source,
    c_test,
    fixed_source,
    of_field,
    signature,
)
from multipos.exports.laws import rms_left
from multipos.exports.parameters import size_of
from multipos.exports.target import (
    Exported,
    GivenFile,
    Target,
    Verification,
    Wish,
    find_strange,
)
from multipos.files.spelling import visible
from multipos.finding import Findings
from multipos.numerics.arrays import Array
from multipos.numerics.terms import COMPONENTS
from multipos.sensor.calibration import Calibration
from multipos.sensor.inverse import sensed_axes
from multipos.units import STANDARD_GRAVITY

_SHOWN = 60  # characters of a line in a message
_SAME = {"double": 1e-9, "float": 5e-7}  # how far the forces may be from the calibration's [g]


def _write(calibration: Calibration, wish: Wish) -> Exported:
    if wish.fixed:
        fixed = find_fixed_point(calibration)
        test = of_field(fixed_test(fixed, wish.name), calibration)
        return Exported(C.name, fixed_source(fixed, wish.name), test)
    form = {"single": wish.single, "in_metres": wish.in_metres, "tilt": wish.tilt}
    text = c_source(calibration, wish.name, **form)
    return Exported(C.name, text, c_test(calibration, wish.name, **form))


def _read_back(file: GivenFile, calibration: Calibration) -> Verification:
    path, raw = file.path, file.raw
    if FIXED.search(file.text):
        return _read_back_fixed(file, calibration)
    found = SIGNATURE.search(file.text)
    assert found is not None  # or another target would have been asked
    _check_sizes(path, found, calibration)
    names = calibration.model.environment
    name, single = found["name"], found["type"] == "float"
    in_metres = METRES.search(file.text) is not None
    tilt = f"void {name}_tilt(" in file.text
    own = c_source(calibration, name, single=single, in_metres=in_metres, tilt=tilt).encode()
    foreign = raw != own
    if foreign and not file.run_foreign_code:
        raise MultiposError(f"{path}: {difference_of(raw, own)}")
    readings = calibration.readings
    columns = {name: readings.environment[name] for name in names}
    rows = np.column_stack([readings.values, *columns.values()])
    if single:
        rows = rows.astype(np.float32).astype(np.float64)
    declared = signature(calibration, name, single)
    force = run_c(path, raw if foreign else own, calibration, declared, rows)
    if in_metres:
        force = force / STANDARD_GRAVITY
    should = calibration.compensate(
        rows[:, : len(calibration.outputs)],
        dict(zip(names, rows[:, len(calibration.outputs) :].T, strict=True)),
    )
    difference = float(np.abs(force - should).max())
    target = f"{C.name}, single precision" if single else C.name
    allowed = _SAME[found["type"]] * size_of(calibration)
    findings = find_strange(path, difference, allowed, calibration.field)
    return _verified(target, calibration, force, difference, foreign, findings)


def _read_back_fixed(file: GivenFile, calibration: Calibration) -> Verification:
    """Return what a function of whole numbers makes of the readings, to the bit as Python does."""
    found = FIXED.search(file.text)
    assert found is not None
    _check_sizes(file.path, found, calibration)
    fixed = find_fixed_point(calibration)
    own = fixed_source(fixed, found["name"]).encode()
    foreign = file.raw != own
    if foreign and not file.run_foreign_code:
        raise MultiposError(f"{file.path}: {difference_of(file.raw, own)}")
    rows = fixed.whole(calibration.readings.values)
    declared = fixed_signature(calibration, found["name"])
    text = file.raw if foreign else own
    whole = run_c(file.path, text, calibration, declared, rows.astype(np.float64))
    findings = find_strange(
        file.path,
        float(np.abs(whole - fixed_forces(fixed, rows)).max()) / fixed.accel_per_g,
        0.0,
        calibration.field,
    )
    force = whole / fixed.accel_per_g
    difference = float(np.abs(force - calibration.compensate(calibration.readings.values)).max())
    target = f"{C.name}, whole numbers"
    return _verified(target, calibration, force, difference, foreign, findings)


def _verified(
    target: str,
    calibration: Calibration,
    force: Array,
    difference: float,
    foreign: bool,
    findings: Findings,
) -> Verification:
    sensed = list(sensed_axes(calibration.model))
    all_axes = np.zeros_like(calibration.reference)
    all_axes[:, sensed] = force - calibration.reference[:, sensed]
    return Verification(
        target=target,
        axes=tuple(COMPONENTS[i] for i in sensed),
        positions=calibration.readings.labels,
        residuals=all_axes[:, sensed],
        rms=rms_left(calibration, all_axes),
        calibration_rms=calibration.rms,
        difference=difference,
        foreign=foreign,
        findings=findings,
        field=calibration.field,
    )


def _check_sizes(path: str, found: re.Match[str], calibration: Calibration) -> None:
    model = calibration.model
    sizes = (len(calibration.outputs), len(model.environment), len(sensed_axes(model)))
    env = found.groupdict().get("env")
    if (int(found["raw"]), int(env or 0), int(found["accel"])) != sizes:
        raise MultiposError(
            f"{path}: {found['name']}_compensate is not made for the outputs of this calibration; "
            "export again."
        )


def difference_of(raw: bytes, own: bytes) -> str:
    """Return how a file differs from what export writes, and what to do about it."""
    way = "; export again, or compile and run it with --run-foreign-code, whatever it does."
    if raw.replace(b"\r\n", b"\n") == own:
        return (
            f"its lines end in CR LF, and in nothing else it differs from what export writes{way}"
        )
    given, written = (text.decode("utf-8", errors="replace") for text in (raw, own))
    version = WRITTEN_BY.search(given)
    if version and version["version"] != __version__:
        return (
            f"it was written by multipos {visible(version['version'])[:_SHOWN]}, and this is "
            f"{__version__}, which may write it otherwise{way}"
        )
    lines = (given.split("\n"), written.split("\n"))
    number = next(
        (i for i, pair in enumerate(zip(*lines, strict=False)) if pair[0] != pair[1]),
        min(map(len, lines)),
    )
    here, there = (
        f"'{visible(text[number])[:_SHOWN]}'" if number < len(text) else "nothing" for text in lines
    )
    return (
        f"line {number + 1} is {here} where export writes {there} of this calibration, so it was "
        f"exported from another or changed since{way}"
    )


C = Target(
    name="c",
    write=_write,
    recognises=lambda text: any(form.search(text) for form in (SIGNATURE, FIXED)),
    read_back=_read_back,
    suffix=".c",
    is_code=True,
    takes=("output_unit", "tilt", "fixed"),
    magnetic=None,
)
