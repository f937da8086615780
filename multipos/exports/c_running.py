"""Compile the function of a C file with the machine's compiler, and run it on readings.

It runs in a folder of its own, for a limited time, with limited memory.
"""

import contextlib
import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from string import Template

import numpy as np

from multipos.errors import MultiposError
from multipos.files.spelling import visible
from multipos.numerics.arrays import Array
from multipos.sensor.calibration import Calibration

_COMPILERS = ("cc", "gcc", "clang")
_SECONDS = 60
_MEMORY = 4 << 30  # [byte], of the compiler and of the program each

# Readings and forces go through files, so that nothing the function prints comes between them.


def fill(template: str, **words: object) -> str:
    """Return a program of the folder `templates` with its words filled in."""
    text = Path(__file__).with_name("templates").joinpath(template).read_text(encoding="utf-8")
    return Template(text).substitute(words)


def array(name: str, kind: str, rows: Sequence[Sequence[object]]) -> str:
    """Return a constant array of rows of numbers, of length ``COUNT``, of a kind of C."""
    lines = ",\n".join(f"    {{{', '.join(map(str, row))}}}" for row in rows)
    return f"static const {kind} {name}[COUNT][{len(rows[0])}] = {{\n{lines}\n}};"


def run_c(path: str, text: bytes, calibration: Calibration, declaration: str, rows: Array) -> Array:
    """Return what the function of a C file makes of rows (n, M + E), in a folder of its own.

    `declaration` is that of its function, as `multipos.exports.target_c` writes it.
    """
    kind, axes = declaration.split("const ")[1].split()[0], len(calibration.model.sensed_axes)
    raw, count = len(calibration.outputs), len(calibration.model.environment)
    environment = (
        f"{kind} env[{count}]; for (int j = 0; j < {count}; ++j) env[j] = ({kind})row[{raw} + j];"
        if count
        else ""
    )
    main = fill(
        "run.c",
        declaration=declaration,
        columns=raw + count,
        axes=axes,
        kind=kind,
        raw=raw,
        environment=environment,
        between="env, " if count else "",
        name=declaration.split("_compensate")[0].removeprefix("void "),
    )
    return compile_and_run(path, text, main, rows, axes)


def compile_and_run(path: str, text: bytes, main: str, rows: Array, columns: int) -> Array:
    """Return what a program makes of rows of numbers, `columns` for each, in a folder of its own.

    The program reads the file ``readings`` and writes ``forces``.
    """
    compiler = next(filter(None, map(shutil.which, _COMPILERS)), None)
    if compiler is None:
        raise MultiposError(
            f"no C compiler ({', '.join(_COMPILERS)}) was found to run {path}; install one."
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
        if not forces.is_file() or forces.stat().st_size != 8 * columns * len(rows):
            raise MultiposError(f"{path}: the compiled function stopped; export again.")
        return np.frombuffer(forces.read_bytes()).reshape(-1, columns)


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
        raise _too_slow(path) from None
    except OSError as error:
        raise MultiposError(f"{path}: cannot compile or run it: {error}.") from None
    if posix and status == -signal.SIGXCPU:  # the bound on its own time came first
        raise _too_slow(path)
    if status:
        with said.open("rb") as errors:
            first = errors.read(4096).decode(errors="replace").strip().splitlines()
        reason = visible(first[0])[:200] if first else "no message"
        raise MultiposError(f"{path}: does not compile or run ({reason}); export again.")


def _too_slow(path: str) -> MultiposError:
    return MultiposError(
        f"{path}: compiled or ran for more than {_SECONDS} s and was stopped; export again."
    )


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
        # A second later than the signal that says why, the one that says nothing.
        last = most if what != resource.RLIMIT_CPU or most == hard else most + 1
        with contextlib.suppress(OSError, ValueError):  # not every system bounds all of these
            resource.setrlimit(what, (most, last))
