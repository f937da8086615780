"""What broke the promise: grouped by signature, counted, and kept with its files."""

import hashlib
import os
import re
import shlex
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from .kinds import KINDS, Case
from .running import Run

KEPT = 2  # cases of one signature whose files are kept


@dataclass(frozen=True)
class Identity:
    """From which a case can be made again."""

    kind: str
    seed: int
    number: int

    @property
    def command(self) -> str:
        """The command that runs the case again."""
        return f"python -m tests.fuzzing {self.kind} --seed {self.seed} --only {self.number}"


@dataclass
class Findings:
    """All cases so far: how they ended, and those that should have ended otherwise."""

    keep: Path | None
    ends: Counter = field(default_factory=Counter)  # (kind, end) to number of cases
    counts: Counter = field(default_factory=Counter)  # signature to number of cases
    first: dict[str, tuple[Identity, str]] = field(default_factory=dict)
    slowest: dict[str, tuple[float, int]] = field(default_factory=dict)
    cpu: float = 0.0

    def add(self, identity: Identity, case: Case, run: Run, signatures: list[str]) -> None:
        """Count a case; keep its files where it is among the first of its signature."""
        end = run.signal or str(run.status)
        self.ends[identity.kind, end] += 1
        self.cpu += run.cpu
        self.slowest[identity.kind] = max(
            (run.cpu, identity.number), self.slowest.get(identity.kind, (0.0, 0))
        )
        for signature in dict.fromkeys(signatures):
            self.counts[signature] += 1
            self.first.setdefault(signature, (identity, shown(case)))
            if self.keep is not None and self.counts[signature] <= KEPT:
                _keep(self.keep, identity, case, run, signature)

    def summary(self) -> str:
        """Cases by kind and end, then the findings, the most frequent first."""
        ends = sorted({end for _, end in self.ends})
        kinds = [kind for kind in KINDS if kind in self.slowest]
        lines = ["".join([f"{'kind':<14}", *(f"{end:>9}" for end in ends), "   most CPU [s]"])]
        for kind in kinds:
            counts = "".join(f"{self.ends[kind, end]:>9}" for end in ends)
            cpu, number = self.slowest[kind]
            lines.append(f"{kind:<14}{counts}   {cpu:.1f} (case {number})")
        total = sum(self.ends.values())
        lines.append(f"\n{total} cases, {self.cpu:.0f} s of CPU, {len(self.counts)} findings")
        for signature, count in self.counts.most_common():
            identity, words = self.first[signature]
            lines += [f"\n{count:>6} × {signature}", f"{'':9}{words}", f"{'':9}{identity.command}"]
        return "\n".join(lines)


def shown(case: Case) -> str:
    """The command line of a case, as a shell takes it, at most 300 characters."""
    words = " ".join(shlex.quote(word) for word in case.argv).encode("unicode_escape").decode()
    states = {
        "stdin": "open" if case.stdin is None else "a pipe",
        "stdout": case.stdout,
        "stderr": case.stderr,
    }
    streams = "".join(f" [{name}: {state}]" for name, state in states.items() if state != "open")
    return f"multipos {words[:300]}{streams}"


def _keep(keep: Path, identity: Identity, case: Case, run: Run, signature: str) -> None:
    digest = hashlib.sha256(signature.encode()).hexdigest()[:6]
    name = re.sub(r"\W+", "-", signature)[:60].strip("-")
    folder = keep / f"{name}-{digest}" / f"{identity.kind}-{identity.seed}-{identity.number}"
    folder.mkdir(parents=True, exist_ok=True)
    said = f"{signature}\n{shown(case)}\n{identity.command}\nargv {list(case.argv)!r}\n"
    contents = {
        **case.files,
        "stdout.txt": run.stdout,
        "stderr.txt": run.stderr,
        "fault.txt": run.fault,
        "finding.txt": said.encode("utf-8", "backslashreplace"),
    }
    if case.stdin is not None:
        contents["stdin"] = case.stdin
    for index, (file, data) in enumerate(contents.items()):
        plain = file if re.fullmatch(r"[\w.-]+", file) and len(file) < 100 else f"file-{index}"
        (folder / os.path.basename(plain)).write_bytes(data)  # noqa: PTH119
