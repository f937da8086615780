"""Targets that take parameters: a matrix and an offset, or an offset and a scale an axis.

Their consumers compute corrected = T (raw − o), eq. (1) of `multipos.compensation.laws`, raw in
m/s² or in the unit of the readings. Writing, reading back and what the files share are here; each
target has a file of its own.
"""

import re
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np

from multipos.compensation.laws import Law, in_metres, law_residuals, loss_text, reduce_to, rms_left
from multipos.compensation.target import (
    Exported,
    GivenFile,
    Target,
    Verification,
    Wish,
    refuse_strange,
)
from multipos.errors import MultiposError
from multipos.files.characters import visible
from multipos.files.trees import to_json
from multipos.numerics.arrays import Array
from multipos.numerics.terms import COMPONENTS
from multipos.sensor.calibration import Calibration

_SAME = 1e-6  # how far the forces of a file may be from those of its law [g]


def parameter_target(
    name: str,
    formula: str,
    *,
    raw_in_metres: bool,
    write: Callable[[Calibration, Law], tuple[str, list[str]]],
    recognises: Callable[[str], bool],
    read: Callable[[str, str], tuple[Array, Array]],
    suffix: str,
) -> Target:
    """Return a target whose consumer applies a matrix and an offset.

    Parameters
    ----------
    name : str
    formula : str
        Terms of its law: LINEAR or DIAGONAL of `multipos.compensation.laws`.
    raw_in_metres : bool
        Whether the consumer holds raw values in m/s², not in the unit of the readings.
    write : function
        Return the text of a file and notes from a calibration and its law in the consumer's unit.
    recognises : function
        Tell from its text whether a file is one of this target.
    read : function
        Return T (3, 3) and o (3,) in the consumer's unit from the path and the text of a file.
    suffix : str
        Of its files.
    """

    def write_file(calibration: Calibration, wish: Wish) -> Exported:
        metres = in_metres(calibration, name) if raw_in_metres else 1.0
        law = reduce_to(calibration, formula, name, allow_lossy=wish.allow_lossy)
        text, notes = write(calibration, law.of_raw_in(metres))
        if law.lost:
            notes = [loss_text(calibration, law, name), *notes]
        if calibration.convention == "gravity":
            turned = "the force is turned from gravity to specific force"
            notes.append(f"{turned}, which {name} works in")
        return Exported(name, text, notes=tuple(notes))

    def read_file(file: GivenFile, calibration: Calibration) -> Verification:
        matrix, offset = read(file.path, file.text)
        expected = reduce_to(calibration, formula, name, allow_lossy=True)
        metres = in_metres(calibration, name) if raw_in_metres else 1.0
        with np.errstate(over="ignore", invalid="ignore"):  # any numbers may stand in the file
            residuals = law_residuals(calibration, matrix * metres, offset / metres)
            should = law_residuals(calibration, expected.matrix, expected.offset)
            refuse_strange(file.path, float(np.abs(residuals - should).max()), _SAME)
        return Verification(
            target=name,
            axes=COMPONENTS,
            positions=calibration.readings.labels,
            residuals=residuals,
            rms=rms_left(calibration, residuals),
            calibration_rms=calibration.rms,
            difference=None,
        )

    return Target(name, write_file, recognises, read_file, suffix)


def diagonal_values(calibration: Calibration, law: Law, names: tuple[str, ...]) -> list[float]:
    """Return the offsets and scales of a law, six, that single precision is to hold."""
    values: list[float] = [*law.offset.tolist(), *np.diag(law.matrix).tolist()]
    for name, value in zip(names, values, strict=True):
        require_writable(calibration, name, value, np.finfo(np.float32))
    return values


def gives(prefix: str, text: str) -> bool:
    """Tell whether a parameter whose name begins so stands in a text, outside its comments."""
    return any(prefix in line for line in text.splitlines() if not line.startswith("#"))


def read_diagonal(names: tuple[str, ...], path: str, text: str) -> tuple[Array, Array]:
    """Return T and o from the parameters of an autopilot, in m/s²."""
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
    numbers = read_numbers(path, names[0], [values[name] for name in names], 6)
    return np.diag(numbers[3:]), numbers[:3]


def require_writable(
    calibration: Calibration, name: str, value: float, precision: "np.finfo[Any]"
) -> None:
    """Refuse, by name, a number that the consumer's precision cannot hold, or a scale it loses."""
    least = float(precision.tiny) if "SCAL" in name else 0.0
    if not least <= abs(value) <= float(precision.max):
        raise MultiposError(
            f"{name} would be {value:.3g}, which the consumer cannot hold; fit readings in a unit "
            f"nearer to their size than '{calibration.model.unit}'."
        )


def origin(calibration: Calibration) -> list[str]:
    """Return what a file is of, as lines of comments: each stays on its line."""
    source = to_json(calibration.readings.source or "readings").strip()
    lines = [
        f"Accelerometer calibration of {source}, model {calibration.model.text}",
        f"made {calibration.created} by multipos {calibration.version}",
    ]
    if calibration.gravity is None:
        lines.append("one g of the calibration, the local gravity, is taken as 9.80665 m/s^2")
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
