"""Read an exported file back as its consumer would, and show what is left of the readings.

The consumer's own law is applied to the readings of the calibration: parameters by their formula,
C by compiling the function with the machine's compiler and running it.
"""

import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.calibration import Calibration, labels
from multipos.errors import MultiposError
from multipos.exporters.c_source import SIGNATURE
from multipos.exporters.laws import (
    DIAGONAL,
    LINEAR,
    in_metres,
    law_residuals,
    reduce_to,
    rms_left,
)
from multipos.exporters.parameters import ARDUPILOT, PX4, read_parameters, read_ros
from multipos.files import plain, read_bytes
from multipos.formatting import table
from multipos.inverse import sensed_axes
from multipos.model import COMPONENTS
from multipos.results import Result

Array = NDArray[np.float64]

_COMPILERS = ("cc", "gcc", "clang")
_SECONDS = 60
# How far a file may be from the calibration it came from [g].
_SAME = {"double": 1e-9, "float": 5e-7, "parameters": 1e-6}

_MAIN = """\
#include <stdio.h>
{declaration};
int main(void)
{{
    double row[{columns}], out[{axes}];
    while (fread(row, sizeof row, 1, stdin) == 1) {{
        {kind} raw[{raw}], accel[{axes}];
        for (int i = 0; i < {raw}; ++i) raw[i] = ({kind})row[i];
        {environment}
        {name}_compensate(raw, {between}accel);
        for (int k = 0; k < {axes}; ++k) out[k] = (double)accel[k];
        if (fwrite(out, sizeof out, 1, stdout) != 1) return 1;
    }}
    return 0;
}}
"""


@dataclass(frozen=True, eq=False)
class Verification(Result):
    """What a consumer makes of the readings that the calibration was made from.

    Attributes
    ----------
    target : str
    axes : tuple of K str
    positions : tuple of n str
    residuals : (n, K) array [g]
        Force as the consumer finds it, less the reference.
    rms, calibration_rms : float [g]
        Root mean square of what is left by the consumer, and by the calibration itself; of the
        magnitude where the orientation was unknown, of the vector otherwise.
    difference : float or None [g]
        Largest difference from what the calibration gives; None where the target says less.
    """

    target: str
    axes: tuple[str, ...]
    positions: tuple[str, ...]
    residuals: Array
    rms: float
    calibration_rms: float
    difference: float | None

    @cached_property
    def max(self) -> float:
        """Largest residual [g]."""
        return float(np.abs(self.residuals).max())

    def to_dict(self) -> dict[str, Any]:
        """Return what JSON can carry."""
        residuals = [
            {"position": label, **dict(zip(self.axes, row, strict=True))}
            for label, row in zip(self.positions, self.residuals.tolist(), strict=True)
        ]
        result: dict[str, Any] = plain(
            {
                "target": self.target,
                "residuals": residuals,
                "rms": self.rms,
                "max": self.max,
                "calibration_rms": self.calibration_rms,
                "difference": self.difference,
            }
        )
        return result

    def __str__(self) -> str:
        header = ["position", *(f"{axis} [mg]" for axis in self.axes)]
        rows = [
            [label, *(f"{1e3 * value:+.4g}" for value in row)]
            for label, row in zip(self.positions, self.residuals.tolist(), strict=True)
        ]
        largest = f"rms {1e3 * self.rms:.4g} mg, largest {1e3 * self.max:.4g} mg"
        lines = [
            f"What the consumer ({self.target}) leaves of the calibration's own readings:",
            "",
            table(header, rows),
            "",
            f"{largest}; the calibration itself leaves {1e3 * self.calibration_rms:.4g} mg",
        ]
        if self.difference is not None:
            lines.append(f"largest difference from multipos apply: {self.difference:.2g} g")
        return "\n".join(lines) + "\n"


def verify_export(path: str | os.PathLike[str], calibration: Calibration) -> Verification:
    """Apply an exported file to the readings of a calibration, by the consumer's own law.

    Raises
    ------
    MultiposError
        The file is of no known kind, does not come from this calibration, or is C and there is
        no compiler.
    """
    text = read_bytes(path, "export").decode("utf-8", errors="replace")
    where = str(path)
    if SIGNATURE.search(text):
        return _verify_c(where, text, calibration)
    if "CAL_ACC0_" in text:
        target, formula, law = "px4", DIAGONAL, read_parameters(where, text, PX4)
    elif "INS_ACC" in text:
        target, formula, law = "ardupilot", DIAGONAL, read_parameters(where, text, ARDUPILOT)
    elif "SM:" in text and "bias:" in text:
        target, formula, law = "ros-imu-calib", LINEAR, read_ros(where, text)
    else:
        raise MultiposError(
            f"{path}: neither C nor parameters that export writes; give a file of multipos export."
        )
    expected = reduce_to(calibration, formula, target, allow_lossy=True)
    metres = 1.0 if formula == LINEAR else in_metres(calibration, target)
    matrix, offset = law[0] * metres, law[1] / metres
    residuals = law_residuals(calibration, matrix, offset)
    should = law_residuals(calibration, expected.matrix, expected.offset)
    _refuse_strange(where, float(np.abs(residuals - should).max()), "parameters")
    return Verification(
        target=target,
        axes=COMPONENTS,
        positions=labels(calibration.readings),
        residuals=residuals,
        rms=rms_left(calibration, residuals),
        calibration_rms=calibration.rms,
        difference=None,
    )


def _verify_c(path: str, text: str, calibration: Calibration) -> Verification:
    found = SIGNATURE.search(text)
    assert found is not None
    names = calibration.model.environment
    sensed = list(sensed_axes(calibration.model))
    sizes = (len(calibration.outputs), len(names), len(sensed))
    if (int(found["raw"]), int(found["env"] or 0), int(found["accel"])) != sizes:
        raise MultiposError(
            f"{path}: {found['name']}_compensate is not made for the outputs of this calibration; "
            "export again."
        )
    readings = calibration.readings
    columns = {name: readings.environment[name] for name in names}
    rows = np.column_stack([readings.values, *columns.values()])
    single = found["type"] == "float"
    if single:
        rows = rows.astype(np.float32).astype(np.float64)
    force = _run_c(path, found, rows)
    should = calibration.compensate(
        rows[:, : len(calibration.outputs)],
        dict(zip(names, rows[:, len(calibration.outputs) :].T, strict=True)),
    )
    difference = float(np.abs(force - should).max())
    _refuse_strange(path, difference, found["type"])
    residuals = force - calibration.reference[:, sensed]
    all_axes = np.zeros_like(calibration.reference)
    all_axes[:, sensed] = residuals
    return Verification(
        target="c, single precision" if single else "c",
        axes=tuple(COMPONENTS[i] for i in sensed),
        positions=labels(readings),
        residuals=residuals,
        rms=rms_left(calibration, all_axes),
        calibration_rms=calibration.rms,
        difference=difference,
    )


def _refuse_strange(path: str, difference: float, kind: str) -> None:
    if not difference <= _SAME[kind]:
        raise MultiposError(
            f"{path}: differs from this calibration by {difference:.2g} g, so it was exported from "
            "another or changed since; export again."
        )


def _run_c(path: str, found: Any, rows: Array) -> Array:
    compiler = next(filter(None, map(shutil.which, _COMPILERS)), None)
    if compiler is None:
        raise MultiposError(
            f"no C compiler ({', '.join(_COMPILERS)}) was found to run {path}; install one."
        )
    kind, raw, axes = found["type"], int(found["raw"]), int(found["accel"])
    count = int(found["env"] or 0)
    environment = (
        f"{kind} env[{count}]; for (int j = 0; j < {count}; ++j) env[j] = ({kind})row[{raw} + j];"
        if count
        else ""
    )
    main = _MAIN.format(
        declaration=found[0], columns=raw + count, axes=axes, kind=kind, raw=raw,
        environment=environment, between="env, " if count else "", name=found["name"],
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        source, program = Path(folder) / "main.c", Path(folder) / "main"
        source.write_text(main, encoding="utf-8")
        _call(
            [compiler, "-std=c99", "-O2", "-o", str(program), "-x", "c", str(source), path, "-lm"],
            path,
        )
        out = _call([str(program)], path, np.ascontiguousarray(rows).tobytes())
    force = np.frombuffer(out).reshape(-1, axes)
    if len(force) != len(rows):
        raise MultiposError(f"{path}: the compiled function stopped; export again.")
    return force


def _call(command: list[str], path: str, given: bytes = b"") -> bytes:
    try:
        done = subprocess.run(command, input=given, capture_output=True, timeout=_SECONDS,
                              check=False)  # fmt: skip
    except (OSError, subprocess.TimeoutExpired) as error:
        raise MultiposError(f"{path}: cannot compile or run it: {error}.") from None
    if done.returncode:
        first = done.stderr.decode(errors="replace").strip().splitlines()
        raise MultiposError(
            f"{path}: does not compile or run ({first[0] if first else 'no message'}); export "
            "again."
        )
    return done.stdout
