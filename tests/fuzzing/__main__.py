"""``python -m tests.fuzzing KIND… --seed S --cases N``: see the package."""

import argparse
import itertools
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from multipos import cli

from . import bases, running, visits
from .findings import Findings, Identity, shown
from .judging import judge
from .kinds import KINDS, Case, case
from .running import Limits

PROGRESS = 30.0  # [s] between two lines that tell how far it is


def main(argv: Sequence[str] | None = None) -> int:
    """Run the cases that were asked for; return 1 where one broke the promise."""
    arguments = _parser().parse_args(argv)
    kinds = list(KINDS) if "all" in arguments.kinds else arguments.kinds
    # Threads of the linear algebra library would count several times, and would not be forked.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    sys.path.append(str(Path(__file__).parents[1]))  # where the writers of logs are
    folder = Path(tempfile.mkdtemp(prefix="multipos-fuzzing-"))
    try:
        start_from = folder / "bases"
        start_from.mkdir()
        valid = bases.make(start_from)
        running.prepare()
        if arguments.only is not None:
            return _run_one(Identity(kinds[0], arguments.seed, arguments.only), valid, folder)
        findings = Findings(arguments.keep)
        identities = _identities(kinds, arguments)
        _run_all(identities, valid, folder, findings, arguments.jobs)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    print(findings.summary())
    return 1 if findings.counts else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m tests.fuzzing",
        description="Damage every kind of input and hold the command line to its promise.",
    )
    add = parser.add_argument
    known = f"all, or some of {', '.join(KINDS)}"
    add("kinds", nargs="+", choices=["all", *KINDS], metavar="KIND", help=known)
    add("--seed", type=int, default=1, help="of the cases (default 1)")
    add("--cases", type=int, default=100, metavar="N", help="of each kind (default 100)")
    add("--first", type=int, default=0, metavar="N", help="number of the first case (default 0)")
    add("--only", type=int, metavar="N", help="run case N of KIND alone and show it")
    add("--keep", type=Path, metavar="DIR", help="folder for the files of what was found")
    add("-j", "--jobs", type=int, default=1, metavar="N", help="cases at a time (default 1)")
    return parser


def _identities(kinds: list[str], arguments: argparse.Namespace) -> Iterator[Identity]:
    """The cases in the order that they are run: each number in every kind, then the next."""
    for number in range(arguments.first, arguments.first + arguments.cases):
        for kind in kinds:
            yield Identity(kind, arguments.seed, number)


def _run_all(
    identities: Iterator[Identity],
    valid: dict[str, bytes],
    folder: Path,
    findings: Findings,
    jobs: int,
) -> None:
    """Run the cases, so many at a time."""
    limits, under_way = Limits(), {}
    told = time.monotonic()
    for index, identity in enumerate(itertools.chain(identities, itertools.repeat(None))):
        while len(under_way) >= jobs or (identity is None and under_way):
            _take_one(under_way, findings, limits)
        if identity is None:
            return
        made = case(identity.kind, identity.seed, identity.number, valid)
        started = running.start(made, folder / str(index), _main_of(made), limits)
        under_way[started.process] = (identity, made, started)
        if time.monotonic() - told > PROGRESS:
            told = time.monotonic()
            print(f"{index} cases, {len(findings.counts)} findings", file=sys.stderr)


def _main_of(made: Case) -> running.Main:
    """Return what a case calls: the command line, or the page."""
    return visits.main if made.argv[:1] == (visits.VISIT,) else cli.main


def _take_one(under_way: dict, findings: Findings, limits: Limits) -> None:
    """Wait for the next case to end, and judge it."""
    process, status, usage = os.wait4(-1, 0)
    if process not in under_way:  # it fed a pipe
        return
    identity, made, started = under_way.pop(process)
    run = running.finish(started, status, usage)
    findings.add(identity, made, run, judge(made, run, limits))
    running.clear(started.root)


def _run_one(identity: Identity, valid: dict[str, bytes], folder: Path) -> int:
    """Run one case and show all of it."""
    made, limits = case(identity.kind, identity.seed, identity.number, valid), Limits()
    run = running.run(made, folder / "only", _main_of(made), limits)
    signatures = judge(made, run, limits)
    print(shown(made))
    for name, text in (("stdout", run.stdout), ("stderr", run.stderr), ("fault", run.fault)):
        print(f"--- {name}\n{text.decode('utf-8', 'replace')[-4000:]}")
    end = run.signal or f"exit status {run.status}"
    print(f"--- {end}, {run.cpu:.2f} s of CPU, {run.memory >> 20} MB")
    print("\n".join(signatures) or "as promised")
    return 1 if signatures else 0


if __name__ == "__main__":
    sys.exit(main())
