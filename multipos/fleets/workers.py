"""All tasks of a fleet, by whatever engine, and where a run that was stopped goes on.

- `open_engine` opens what runs tasks, `solve_all` yields what they find.

A task is some thousand units, so that memory does not grow with their number beyond the table and
the result. Its content has a name, the SHA-256 of all that its numbers depend on; what it found is
kept under that name until the run has ended, and a task that is found there is not solved again.
"""

import hashlib
import io
import json
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from multipos import __version__
from multipos.errors import MultiposError, UsageError
from multipos.files.whole import write_text
from multipos.fleets.fixtures import FixtureSums
from multipos.fleets.solving import Solved, Task, solve_task

Engine = Literal["threads", "processes", "dask"]
ENGINES: tuple[Engine, ...] = ("threads", "processes", "dask")
_AHEAD = 2  # tasks a worker has waiting


@contextmanager
def open_engine(engine: str, scheduler: str | None = None) -> Iterator[Executor]:
    """Open an executor by its name.

    Parameters
    ----------
    engine : str
        'threads', 'processes' or 'dask'.
    scheduler : str, optional
        Address of a Dask scheduler, such as tcp://10.0.0.1:8786; a cluster on this machine if not
        given.

    Raises
    ------
    UsageError
        There is no such engine, or a scheduler is named for another one.
    MultiposError
        Dask is not installed, or its scheduler does not answer.
    """
    if engine not in ENGINES:
        raise UsageError(f"--engine takes {', '.join(ENGINES)}, got '{engine}'.")
    if scheduler is not None and engine != "dask":
        raise UsageError("--scheduler is the address of a Dask scheduler; it needs --engine dask.")
    workers = max(1, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 2)
    if engine == "threads":
        with ThreadPoolExecutor(workers) as executor:
            yield executor
    elif engine == "processes":
        from concurrent.futures import ProcessPoolExecutor
        from multiprocessing import get_context

        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as processes:
            yield processes
    else:
        with _dask_client(scheduler) as client:
            yield client.get_executor()


def _dask_client(scheduler: str | None) -> Any:
    try:
        from distributed import Client
    except ImportError:
        raise MultiposError(
            "--engine dask needs Dask, which is not installed; install it with "
            "pip install 'multipos[dask]', or use --engine threads."
        ) from None
    try:
        return Client(scheduler, dashboard_address=None) if scheduler is None else Client(scheduler)
    except (OSError, ValueError) as error:
        raise MultiposError(
            f"--scheduler {scheduler}: no Dask scheduler answers there ({error}); check it."
        ) from None


def solve_all(
    tasks: Iterable[Task],
    executor: Executor | None,
    *,
    folder: Path | None = None,
    report: Callable[[int], object] = lambda done: None,
) -> Iterator[Solved]:
    """Yield what every task found, in their order.

    Parameters
    ----------
    tasks : iterable of Task
    executor : concurrent.futures.Executor or None
        None: this thread.
    folder : path, optional
        Where finished tasks are kept, and found again.
    report : callable
        Called with how many units are done.
    """
    waiting: deque[tuple[Path | None, Solved | Future[Solved]]] = deque()
    most = _AHEAD * int(getattr(executor, "_max_workers", 8)) + 1
    done = 0
    try:
        for task in tasks:
            path = None if folder is None else folder / f"{_name(task)}.npz"
            kept = None if path is None else _load(path)
            if kept is None:
                begun = executor.submit(solve_task, task) if executor else solve_task(task)
                waiting.append((path, begun))
            else:
                waiting.append((None, kept))
            while len(waiting) >= most:
                solved = _finish(*waiting.popleft())
                done += len(solved.units)
                report(done)
                yield solved
        while waiting:
            solved = _finish(*waiting.popleft())
            done += len(solved.units)
            report(done)
            yield solved
    finally:
        for _, each in waiting:
            if isinstance(each, Future):
                each.cancel()


def _finish(path: Path | None, each: "Solved | Future[Solved]") -> Solved:
    solved = each.result() if isinstance(each, Future) else each
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, _packed(solved))
    return solved


def _name(task: Task) -> str:
    """Return the SHA-256 of all that the numbers of a task depend on."""
    digest = hashlib.sha256(f"{__version__} {_said(task.options)}".encode())
    stated = (*task.stated, *task.stated_dof)
    for array in (task.units, task.stations, *task.values, *stated, *task.temperature):
        digest.update(np.ascontiguousarray(array).tobytes())
    if task.pattern is not None:
        shared = task.pattern.shared
        digest.update(repr((shared.model.text, shared.model.names, task.pattern.gravity)).encode())
        for name in shared.__dataclass_fields__:
            digest.update(_said(getattr(shared, name)).encode())
    for table in task.tables.values():
        for name, column in table.columns.items():
            digest.update(f"{name}={[str(cell) for cell in column]}".encode())
    return digest.hexdigest()


def _said(value: Any) -> str:
    """Return an option as text that tells it from every other, arrays by their content."""
    if isinstance(value, Mapping):
        return repr(sorted((str(name), _said(each)) for name, each in value.items()))
    if isinstance(value, np.ndarray):
        return f"{value.shape}{value.dtype}{hashlib.sha256(value.tobytes()).hexdigest()}"
    if is_dataclass(value):
        return repr([_said(getattr(value, field.name)) for field in fields(value)])
    if isinstance(value, list | tuple):
        return repr([_said(each) for each in value])
    return repr(value)


_WORDS, _OF_FIXTURE = ("names", "findings", "reasons", "unfit"), ("station", "labels", "units")
_ARRAYS = ("units", "parameters", "u", "dof", "rms")
_ARRAYS_OF_FIXTURE = ("up", "identifiable", "total", "square")


def _packed(solved: Solved) -> bytes:
    """Return what a task found as the bytes of a file."""
    stream = io.BytesIO()
    words = {name: getattr(solved, name) for name in _WORDS}
    words["fixtures"] = [
        {name: getattr(each, name) for name in _OF_FIXTURE} for each in solved.fixtures
    ]
    arrays = {name: getattr(solved, name) for name in _ARRAYS}
    for i, each in enumerate(solved.fixtures):
        arrays |= {f"{name}{i}": getattr(each, name) for name in _ARRAYS_OF_FIXTURE}
    np.savez(stream, words=np.frombuffer(json.dumps(words).encode(), dtype=np.uint8), **arrays)
    return stream.getvalue()


def _load(path: Path) -> Solved | None:
    """Return what a finished task found; None where it is not there, or not whole."""
    from zipfile import BadZipFile

    try:
        with np.load(path, allow_pickle=False) as kept:
            words = json.loads(kept["words"].tobytes())
            fixtures = tuple(
                FixtureSums(
                    **{**each, "labels": tuple(each["labels"])},
                    **{name: kept[f"{name}{i}"] for name in _ARRAYS_OF_FIXTURE},
                )
                for i, each in enumerate(words["fixtures"])
            )
            words |= {"names": tuple(words["names"]), "fixtures": fixtures}
            return Solved(**words, **{name: kept[name] for name in _ARRAYS})
    except (OSError, ValueError, KeyError, BadZipFile):
        return None
