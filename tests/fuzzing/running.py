"""Run a case as a user would: a process of its own, real streams, limits on time and memory.

The process is forked from one that has all libraries loaded, which costs some 10 ms where a start
costs a second, and leaves nothing behind for the next case. What kills it is seen from outside.
"""

import atexit
import contextlib
import faulthandler
import gc
import os
import resource
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import multipos

from .kinds import OLD_OUTPUT, Case

PACKAGE = str(Path(multipos.__file__).parent)
Main = Callable[[Sequence[str]], int]
Snapshot = dict[str, tuple[str, object]]
OLD_TIME = 1_000_000_000  # [s] so that a file that was touched has another time


@dataclass(frozen=True)
class Limits:
    """What a run may take: CPU [s], wall clock [s] (some wait for ever), memory [bytes]."""

    cpu: int = 20
    wall: int = 240
    memory: int = 2 << 30


@dataclass(frozen=True)
class Run:
    """What a case did.

    Attributes
    ----------
    status : int or None
        Exit status, None where a signal ended it.
    signal : str or None
    stdout, stderr, fault : bytes
        `fault` is where it was when a signal ended it.
    cpu : float
        [s], with the programs that it started.
    memory : int
        [bytes] at the most.
    before, after : dict
        Everything in its folder, by name.
    folder : Path
        Where it ran.
    """

    status: int | None
    signal: str | None
    stdout: bytes
    stderr: bytes
    fault: bytes
    cpu: float
    memory: int
    before: Snapshot
    after: Snapshot
    folder: Path


@dataclass(frozen=True)
class Started:
    """A case under way."""

    process: int
    root: Path
    before: Snapshot
    resident: int


def prepare() -> None:
    """Get this process ready to be forked often: what is there now is not collected again."""
    gc.collect()
    gc.freeze()


def start(case: Case, root: Path, main: Main, limits: Limits) -> Started:
    """Start a case in an empty folder of its own; `finish` takes it over when it has ended."""
    # ".." of the folder that it runs in is watched as well.
    place = root / "place"
    for folder in (place / "work", root / "tmp"):
        folder.mkdir(parents=True)
    _lay_out(case, place / "work")
    before = _snapshot(place)
    feeding = _feed(case.stdin)
    process = os.fork()
    if not process:
        _be(case, root, main, limits, feeding)
    if feeding is not None:
        os.close(feeding)
    return Started(process, root, before, _resident())


def finish(started: Started, wait_status: int, usage: resource.struct_rusage) -> Run:
    """Return what a case did, of which `os.wait4` has told the end; its folder is still there."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(started.process, signal.SIGKILL)  # what it started and left running
    root = started.root
    died = os.WIFSIGNALED(wait_status)
    peak = usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    after = _snapshot(root / "place")
    after |= {f"TMPDIR/{name}": state for name, state in _snapshot(root / "tmp").items()}
    return Run(
        status=None if died else os.WEXITSTATUS(wait_status),
        signal=signal.Signals(os.WTERMSIG(wait_status)).name if died else None,
        stdout=_content(root / "stdout"),
        stderr=_content(root / "stderr"),
        fault=_content(root / "fault"),
        cpu=usage.ru_utime + usage.ru_stime,
        memory=peak - started.resident,
        before=started.before,
        after=after,
        folder=root / "place" / "work",
    )


def run(case: Case, root: Path, main: Main, limits: Limits) -> Run:
    """Run one case to its end."""
    started = start(case, root, main, limits)
    _, status, usage = os.wait4(started.process, 0)
    return finish(started, status, usage)


def _content(path: Path) -> bytes:
    return path.read_bytes() if path.exists() else b""


def _lay_out(case: Case, work: Path) -> None:
    for name in case.folders:
        (work / name).mkdir()
    for name, data in case.files.items():
        with contextlib.suppress(OSError):  # a name that no file can have stays missing
            (work / name).write_bytes(data)
    for name in case.old:
        (work / name).write_bytes(OLD_OUTPUT)
    for path in work.iterdir():
        os.utime(path, (OLD_TIME, OLD_TIME))
    for name, target in case.links.items():
        (work / name).symlink_to(target)


def _snapshot(place: Path) -> Snapshot:
    """Kind and content of everything below a folder, with the time of what is no folder."""
    found: Snapshot = {}
    for folder, folders, files in os.walk(place):
        for name in (*folders, *files):
            path = Path(folder, name)
            short = str(path.relative_to(place)).removeprefix("work/")
            if path.is_symlink():
                found[short] = ("link", path.readlink())
            elif path.is_dir():
                found[short] = ("folder", None)
            else:
                found[short] = ("file", (path.stat().st_mtime_ns, path.read_bytes()))
    return found


def _feed(data: bytes | None) -> int | None:
    """A pipe with these bytes in it, written by a process of its own; None without bytes."""
    if data is None:
        return None
    reading, writing = os.pipe()
    if os.fork():
        os.close(writing)
        return reading
    os.close(reading)
    with contextlib.suppress(OSError), open(writing, "wb") as stream:  # noqa: PTH123
        stream.write(data)
    os._exit(0)


def _be(case: Case, root: Path, main: Main, limits: Limits, stdin: int | None) -> NoReturn:
    """Be the process of a case, from the fork to its exit."""
    status = 1
    try:
        os.setsid()
        os.chdir(root / "place" / "work")
        os.environ.update(TMPDIR=str(root / "tmp"), MULTIPOS_DEBUG="1")
        tempfile.tempdir = None
        fault = open(root / "fault", "wb")  # noqa: PTH123, SIM115
        _limit(limits, fault)
        _redirect(case, root, stdin)
        status = _call(main, case.argv)
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(status)


def _limit(limits: Limits, fault) -> None:
    """Let signals end what takes too long, and tell where it was."""
    faulthandler.enable(fault, all_threads=False)
    for number in (signal.SIGXCPU, signal.SIGALRM):
        faulthandler.register(number, fault, all_threads=False, chain=True)
    signal.alarm(limits.wall)
    spent = resource.getrusage(resource.RUSAGE_SELF)
    cpu = int(spent.ru_utime + spent.ru_stime) + 1 + limits.cpu
    resource.setrlimit(resource.RLIMIT_CPU, (cpu, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (_address_space() + limits.memory,) * 2)


def _address_space() -> int:
    """What this process has mapped already [bytes]: the libraries, mostly."""
    return _pages(0, 1 << 30)


def _resident() -> int:
    """What this process holds in memory [bytes], which a case is born with."""
    return _pages(1, 0)


def _pages(field: int, unknown: int) -> int:
    statm = Path("/proc/self/statm")
    if not statm.exists():
        return unknown
    return int(statm.read_text().split()[field]) * resource.getpagesize()


def _redirect(case: Case, root: Path, stdin: int | None) -> None:
    """Put the streams of the case where those of this process are."""
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null if stdin is None else stdin, 0)
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    sys.stdin = open(0, encoding="utf-8", closefd=False)  # noqa: SIM115
    for place, state, name in ((1, case.stdout, "stdout"), (2, case.stderr, "stderr")):
        _connect(place, state, root / name)
        errors = "strict" if place == 1 else "backslashreplace"
        stream = None
        if state != "closed":
            stream = open(place, "w", encoding="utf-8", errors=errors, closefd=False)  # noqa: SIM115
        setattr(sys, name, stream)


def _connect(place: int, state: str, path: Path) -> None:
    if state == "closed":
        os.close(place)
        return
    if state == "broken":
        reading, target = os.pipe()
        os.close(reading)
    else:
        name = "/dev/full" if state == "full" else path
        target = os.open(name, os.O_WRONLY | os.O_CREAT, 0o600)
    os.dup2(target, place)
    os.close(target)


def _call(main: Main, argv: Sequence[str]) -> int:
    """Call the command line as the interpreter does, up to its exit."""
    _show_warnings()
    try:
        status = main(list(argv))
    except SystemExit as leaving:
        status = leaving.code if isinstance(leaving.code, int) else int(bool(leaving.code))
    except BaseException:
        traceback.print_exc()
        status = 1
    atexit._run_exitfuncs()
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError:
        status = 120  # as the interpreter does
    with contextlib.suppress(OSError):
        if sys.stderr is not None:
            sys.stderr.flush()
    return status


def _show_warnings() -> None:
    """Show what a fresh interpreter shows, whatever was shown or caught before the fork."""
    warnings.resetwarnings()
    for category in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
        warnings.simplefilter("ignore", category)

    def show(message, category, filename, lineno, file=None, line=None):
        # A library's warning is told where the package called it.
        frame = sys._getframe(1)
        while frame is not None and not frame.f_code.co_filename.startswith(PACKAGE):
            frame = frame.f_back
        if frame is not None:
            filename, lineno = frame.f_code.co_filename, frame.f_lineno
        if sys.stderr is not None:
            sys.stderr.write(warnings.formatwarning(message, category, filename, lineno, line))

    warnings.showwarning = show


def clear(root: Path) -> None:
    """Remove the folder of a case."""
    shutil.rmtree(root, ignore_errors=True)
