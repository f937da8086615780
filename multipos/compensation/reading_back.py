"""Read an exported file back as its consumer would, and show what is left of the readings.

The consumer's own law is applied to the readings of the calibration: parameters by their formula,
C by compiling the function with the machine's compiler and running it. A C file may come from
somebody else, and to compile and run it is to do what it says. So the file is written again from
the calibration, and where both are the same to the byte, it is the text of this program that is
compiled. Any other C runs only where the user says so, in a folder of its own, for a limited time.
"""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import tempfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from multipos import __version__
from multipos.compensation.c_source import SIGNATURE, WRITTEN_BY, c_source, signature
from multipos.compensation.laws import (
    DIAGONAL,
    LINEAR,
    in_metres,
    law_residuals,
    reduce_to,
    rms_left,
)
from multipos.compensation.parameters import ARDUPILOT, PX4, read_parameters, read_ros
from multipos.errors import MultiposError
from multipos.files.characters import visible
from multipos.files.numbers import table
from multipos.files.tables import read_bytes
from multipos.numerics.arrays import Array
from multipos.numerics.terms import COMPONENTS
from multipos.results import Result, plain
from multipos.sensor.calibration import Calibration
from multipos.sensor.inverse import sensed_axes

_COMPILERS = ("cc", "gcc", "clang")
_SECONDS = 60
_MEMORY = 4 << 30  # [byte], of the compiler and of the program each
_LONGEST = 10 << 20  # [byte], far above any file that export writes
_SHOWN = 60  # characters of a line in a message
# How far a file may be from the calibration it came from [g].
_SAME = {"double": 1e-9, "float": 5e-7, "parameters": 1e-6}

# Readings and forces go through files, so that nothing the function prints comes between them.
_MAIN = """\
#include <stdio.h>
{declaration};
int main(void)
{{
    double row[{columns}], out[{axes}];
    FILE *readings = fopen("readings", "rb"), *forces = fopen("forces", "wb");
    if (readings == NULL || forces == NULL) return 1;
    while (fread(row, sizeof row, 1, readings) == 1) {{
        {kind} raw[{raw}], accel[{axes}];
        for (int i = 0; i < {raw}; ++i) raw[i] = ({kind})row[i];
        {environment}
        {name}_compensate(raw, {between}accel);
        for (int k = 0; k < {axes}; ++k) out[k] = (double)accel[k];
        if (fwrite(out, sizeof out, 1, forces) != 1) return 1;
    }}
    return fclose(forces) ? 1 : 0;
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
    foreign : bool
        Whether C was run that is not what `export` writes of this calibration.
    """

    target: str
    axes: tuple[str, ...]
    positions: tuple[str, ...]
    residuals: Array
    rms: float
    calibration_rms: float
    difference: float | None
    foreign: bool = False

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
                "foreign": self.foreign,
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
        if self.foreign:
            lines.append("the file is not what export writes of this calibration; it was run as is")
        return "\n".join(lines) + "\n"


def verify_export(
    path: str | os.PathLike[str], calibration: Calibration, *, run_foreign_code: bool = False
) -> Verification:
    """Apply an exported file to the readings of a calibration, by the consumer's own law.

    Parameters
    ----------
    path : path
    calibration : Calibration
    run_foreign_code : bool
        Compile and run C that is not what `export` writes of this calibration.

    Raises
    ------
    MultiposError
        The file is of no known kind, does not come from this calibration, or is C and there is
        no compiler.
    """
    raw = read_bytes(path, "export")
    where = str(path)
    if len(raw) > _LONGEST:
        raise MultiposError(
            f"{where}: {len(raw)} bytes are more than any file of multipos export has."
        )
    text = raw.decode("utf-8", errors="replace")
    found = SIGNATURE.search(text)
    if found:
        return _verify_c(where, raw, found, calibration, run_foreign_code)
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
    with np.errstate(over="ignore", invalid="ignore"):  # any numbers may stand in the file
        matrix, offset = law[0] * metres, law[1] / metres
        residuals = law_residuals(calibration, matrix, offset)
        should = law_residuals(calibration, expected.matrix, expected.offset)
        _refuse_strange(where, float(np.abs(residuals - should).max()), "parameters")
    return Verification(
        target=target,
        axes=COMPONENTS,
        positions=calibration.readings.labels,
        residuals=residuals,
        rms=rms_left(calibration, residuals),
        calibration_rms=calibration.rms,
        difference=None,
    )


def _verify_c(
    path: str, raw: bytes, found: re.Match[str], calibration: Calibration, run_foreign_code: bool
) -> Verification:
    names = calibration.model.environment
    sensed = list(sensed_axes(calibration.model))
    sizes = (len(calibration.outputs), len(names), len(sensed))
    if (int(found["raw"]), int(found["env"] or 0), int(found["accel"])) != sizes:
        raise MultiposError(
            f"{path}: {found['name']}_compensate is not made for the outputs of this calibration; "
            "export again."
        )
    name, single = found["name"], found["type"] == "float"
    own = c_source(calibration, name, single=single).encode()
    foreign = raw != own
    if foreign and not run_foreign_code:
        raise MultiposError(f"{path}: {_difference(raw, own)}")
    readings = calibration.readings
    columns = {name: readings.environment[name] for name in names}
    rows = np.column_stack([readings.values, *columns.values()])
    if single:
        rows = rows.astype(np.float32).astype(np.float64)
    force = _run_c(path, raw if foreign else own, calibration, name, single, rows)
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
        positions=readings.labels,
        residuals=residuals,
        rms=rms_left(calibration, all_axes),
        calibration_rms=calibration.rms,
        difference=difference,
        foreign=foreign,
    )


def _difference(raw: bytes, own: bytes) -> str:
    """Return how a file differs from what export writes, and what to do about it."""
    way = (
        "; export again, or compile and run it as it stands with --run-foreign-code, which does "
        "whatever it says."
    )
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


def _refuse_strange(path: str, difference: float, kind: str) -> None:
    if not difference <= _SAME[kind]:
        raise MultiposError(
            f"{path}: differs from this calibration by {difference:.2g} g, so it was exported from "
            "another or changed since; export again."
        )


def _run_c(
    path: str, text: bytes, calibration: Calibration, name: str, single: bool, rows: Array
) -> Array:
    """Return what the function of a C file makes of rows (n, M + E), in a folder of its own."""
    compiler = next(filter(None, map(shutil.which, _COMPILERS)), None)
    if compiler is None:
        raise MultiposError(
            f"no C compiler ({', '.join(_COMPILERS)}) was found to run {path}; install one."
        )
    kind, axes = "float" if single else "double", len(sensed_axes(calibration.model))
    raw, count = len(calibration.outputs), len(calibration.model.environment)
    environment = (
        f"{kind} env[{count}]; for (int j = 0; j < {count}; ++j) env[j] = ({kind})row[{raw} + j];"
        if count
        else ""
    )
    main = _MAIN.format(
        declaration=signature(calibration, name, single),
        columns=raw + count,
        axes=axes,
        kind=kind,
        raw=raw,
        environment=environment,
        between="env, " if count else "",
        name=name,
    )
    with tempfile.TemporaryDirectory() as folder:
        inside = Path(folder)
        (inside / "main.c").write_text(main, encoding="utf-8")
        (inside / "export.c").write_bytes(text)
        (inside / "readings").write_bytes(np.ascontiguousarray(rows).tobytes())
        command = [
            str(Path(compiler).absolute()),
            "-std=c99",
            "-O2",
            "-o",
            "main",
            "main.c",
            "export.c",
        ]
        _call([*command, "-lm"], inside, path)
        _call([str(inside / "main")], inside, path)
        forces = inside / "forces"
        if not forces.is_file() or forces.stat().st_size != 8 * axes * len(rows):
            raise MultiposError(f"{path}: the compiled function stopped; export again.")
        return np.frombuffer(forces.read_bytes()).reshape(-1, axes)


def _call(command: list[str], folder: Path, path: str) -> None:
    """Run a program in a folder, with bounds on time, memory and what it writes."""
    said = folder / "said"
    posix = os.name == "posix"
    try:
        with said.open("wb") as errors:
            process = subprocess.Popen(
                command,
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=errors,
                start_new_session=posix,
                preexec_fn=_bound if posix else None,
                env={**os.environ, "TMPDIR": str(folder)},
            )
            try:
                status = process.wait(timeout=_SECONDS)
            finally:
                if posix:  # with all that it started
                    with contextlib.suppress(ProcessLookupError):
                        os.killpg(process.pid, signal.SIGKILL)
                process.kill()
                process.wait()
    except subprocess.TimeoutExpired:
        raise MultiposError(
            f"{path}: compiled or ran for more than {_SECONDS} s and was stopped; export again."
        ) from None
    except OSError as error:
        raise MultiposError(f"{path}: cannot compile or run it: {error}.") from None
    if status:
        with said.open("rb") as errors:
            first = errors.read(4096).decode(errors="replace").strip().splitlines()
        reason = visible(first[0])[:200] if first else "no message"
        raise MultiposError(f"{path}: does not compile or run ({reason}); export again.")


def _bound() -> None:
    """Bound the memory, the time and the files of the process that is about to start."""
    import resource

    for what, most in (
        (resource.RLIMIT_AS, _MEMORY),
        (resource.RLIMIT_CPU, _SECONDS),
        (resource.RLIMIT_FSIZE, _MEMORY // 16),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(what)[1]
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        with contextlib.suppress(OSError, ValueError):  # not every system bounds all of these
            resource.setrlimit(what, (most, most))
