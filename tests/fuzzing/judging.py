"""Hold the promise against what a case did; each breach is a signature that groups its like."""

import json
import os
import re
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from pathlib import Path, PurePath

from multipos.errors import MultiposError
from multipos.regression.regression import Regression, load_regression
from multipos.sensor import calibration_file
from multipos.verification import verdicts

from . import visits
from .kinds import Case
from .running import PACKAGE, Limits, Run

_FRAME = re.compile(rf'File "{re.escape(PACKAGE)}/([^"]+)", line (\d+),? in (\S+)')
_WARNING = re.compile(r"^(\S+\.py):(\d+): (\w*Warning): (.*)$", re.MULTILINE)
# As the command line itself shows them, to who looks for faults.
_SHOWN_WARNING = re.compile(r"\((\w*Warning) at (\S+\.py) line \d+\)$", re.MULTILINE)
# How the command line's last handler speaks of what it did not foresee.
_LAST_HANDLER = re.compile(r"error: unexpected|unexpected \w*([Ee]rror|Exception)\b")
# In a line that is no comment, where a number stands in C or in a file of parameters.
_NO_NUMBER = re.compile(r"^(?! ?[#*/]).*[\s,={(\[-](inf|nan)f?(?![\w.])", re.MULTILINE)
# What is written is read again by other commands.
_READERS = {
    calibration_file.Calibration.schema: calibration_file.load,
    Regression.schema: load_regression,
    verdicts.Check.schema: verdicts.load_check,
}
_FOLDERS = {"demo": "multipos-demo", visits.VISIT: visits.FOLDER}  # that they write by themselves
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f\x80-\x9f]")


def judge(case: Case, run: Run, limits: Limits) -> list[str]:
    """Return the signatures of all that is wrong; an empty list where the promise was kept."""
    return [*_process(case, run, limits), *_folder(case, run)]


def _process(case: Case, run: Run, limits: Limits) -> Iterator[str]:
    """What is wrong with the end of the process, its streams and its cost."""
    stderr = run.stderr.decode("utf-8", "replace")
    if run.signal == "SIGXCPU" or (run.signal is None and run.cpu > limits.cpu):
        yield f"slow: more than {limits.cpu} s of CPU in {_innermost(run.fault)}"
    elif run.signal == "SIGALRM":
        yield f"waits: more than {limits.wall} s in {_innermost(run.fault)}"
    elif run.signal is not None:
        yield f"killed: {run.signal} in {_innermost(run.fault)}"
    elif "Traceback (most recent call last)" in stderr:
        yield _traceback(stderr)
    elif run.status not in (0, 1, 2, 3):
        yield f"status: {run.status}"
    elif run.status in (1, 2):
        yield from _failure(case, run, stderr)
    else:
        yield from _success(case, run, stderr)
    for category, file in _SHOWN_WARNING.findall(stderr):
        yield f"warning: {category} at {file}"
    for file, line, category, text in _WARNING.findall(stderr):
        where = file.removeprefix(f"{PACKAGE}/") if file.startswith(PACKAGE) else Path(file).name
        yield f"warning: {category} at {where}:{line}: {text[:60]}"
    if run.memory > limits.memory or "fit into memory" in stderr:
        yield f"memory: more than {limits.memory >> 20} MB asked for by {case.argv[0]}"


def _traceback(stderr: str) -> str:
    """The exception and the innermost line of the package."""
    raised = [line for line in stderr.splitlines() if re.match(r"[A-Za-z_][\w.]*(:|$)", line)]
    raised = [line for line in raised if not line.startswith("multipos:")]
    name, _, text = (raised[-1] if raised else "?").partition(":")
    return f"traceback: {name}: {_masked(text)[:60]} at {_innermost(stderr.encode(), last=True)}"


def _innermost(text: bytes, last: bool = False) -> str:
    frames = _FRAME.findall(text.decode("utf-8", "replace"))
    if not frames:
        return "?"
    file, line, function = frames[-1 if last else 0]
    return f"{file}:{line} {function}"


def _masked(text: str) -> str:
    """Without what differs from case to case."""
    return re.sub(r"'[^']*'|\"[^\"]*\"", "'…'", re.sub(r"\d+", "N", text)).strip()


def _failure(case: Case, run: Run, stderr: str) -> Iterator[str]:
    if run.stdout and not _is_live(case):
        yield f"stdout: not empty on {run.status}"
    if case.stderr != "open":
        return
    lines = stderr.splitlines()
    if not lines or not lines[-1].startswith("multipos: error: "):
        yield "stderr: does not end in 'multipos: error: '"
    elif _LAST_HANDLER.search(lines[-1]):
        yield f"unexpected: {_masked(lines[-1])[:80]}"
    yield from _strange_lines(case, lines[:-1])
    if _CONTROL.search(stderr):
        yield "stderr: a control character"


def _success(case: Case, run: Run, stderr: str) -> Iterator[str]:
    if case.stderr == "open":
        yield from _strange_lines(case, stderr.splitlines())
        if _CONTROL.search(stderr):
            yield "stderr: a control character"
    if "--json" not in case.argv or case.stdout != "open" or _to_stdout(case):
        return
    for text in run.stdout.splitlines() if _is_live(case) else (run.stdout,):
        fault = _json_fault(text)
        if fault:
            yield f"json: stdout of {case.argv[0]} is {fault}"


def _is_live(case: Case) -> bool:
    """Whether lines are printed, and rows are kept, as they come."""
    return "capture" in case.argv[:1]


def _strange_lines(case: Case, lines: list[str]) -> Iterator[str]:
    """Lines that are neither a warning of the program nor its usage."""
    told = "multipos: "  # the answer stands there where stdout is data
    usage = False
    for line in lines:
        usage = line.startswith("usage: ") or (usage and line.startswith(" "))
        if not usage and not line.startswith(told) and not _WARNING.match(line):
            if line.startswith("  "):  # the source line that Python shows below its warning
                continue
            yield f"stderr: a strange line, {_masked(line)[:60]!r}"
            return


def _to_stdout(case: Case) -> bool:
    return case.output in ("-", "/dev/stdout")


def _json_fault(data: bytes) -> str | None:
    def refuse(constant: str) -> None:
        raise ValueError(f"not finite: {constant}")

    try:
        value = json.loads(data.decode(), parse_constant=refuse)
    except ValueError as error:
        return f"no JSON: {_masked(str(error))[:40]}"
    if not isinstance(value, dict):
        return "no object"
    reader = None if value.get("against") else _READERS.get(value.get("schema"))
    return None if reader is None else _refusal(reader, data)


def _refusal(reader: Callable[[Path], object], data: bytes) -> str | None:
    """What a command says of the file that another has written."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "written.json"
        path.write_bytes(data)
        try:
            reader(path)
        except MultiposError as error:
            return f"refused: {_masked(str(error).removeprefix(str(path)))[:80]}"
    return None


def _folder(case: Case, run: Run) -> Iterator[str]:
    """What is wrong with the files: inputs, outputs, and what was left."""
    names = run.before.keys() | run.after.keys()
    changed = {name for name in names if run.before.get(name) != run.after.get(name)}
    for name in sorted(changed & case.files.keys()):
        what = "gone" if name not in run.after else "changed"
        yield f"files: an input is {what} (status {run.status}, {case.argv[0]})"
    changed -= case.files.keys()
    if run.signal is not None:
        return  # what was cut short cannot tidy up
    if run.status in (0, 3):
        strange = changed - _expected(case, run, changed)
        if strange:
            yield f"files: beside the output, {_shape(case, min(strange))} ({case.argv[0]})"
        yield from _written(case, run)
    elif case.output in changed and case.stdout != "open":
        yield from _written(case, run)  # the output was whole before stdout failed
    elif changed := changed - _kept(case):
        what = "made" if min(changed) not in run.before else "touched"
        yield f"files: {what} on failure, {_shape(case, min(changed))} ({case.argv[0]})"


def _expected(case: Case, run: Run, changed: set[str]) -> set[str]:
    """Of the names that changed, those that the output accounts for."""
    output = case.output or _FOLDERS.get(case.argv[0], "")
    if not output:
        return set()
    allowed = set()
    for path in (output, os.path.realpath(run.folder / output)):
        short = os.path.relpath(run.folder / path, run.folder)
        own = PurePath(short)
        # An export to C has its self-test beside it.
        companion = str(own.with_name(f"{own.stem}_test{own.suffix}")) if own.name else short
        allowed |= {short, companion}
        if case.argv[0] == "calibrate":  # several targets, each named after the calibration
            allowed |= {name for name in changed if name.startswith(f"{own.with_suffix('')}_")}
    # What lies in the folder above goes by its bare name, as what lies in the folder itself does.
    inside = {
        name
        for name in changed
        for path in allowed
        if case.argv[0] in ("fleet", "page", *_FOLDERS)
        and (path in (".", "..") or name.startswith(f"{path}/"))
    }
    # A fleet makes the folders above its own.
    above = {str(each) for each in PurePath(output).parents} if case.argv[0] == "fleet" else set()
    return (changed & (allowed | above | _kept(case))) | inside


def _kept(case: Case) -> set[str]:
    """What may be left on failure, as a refused target loses neither readings nor calibration."""
    targets = case.argv[0] == "calibrate" and any(word.startswith("--to") for word in case.argv)
    if not (_is_live(case) or targets) or not case.output or case.output == "-":
        return set()
    own = PurePath(os.path.normpath(case.output))
    if not own.name:
        return set()
    endings = (".csv", ".json", ".html", ".c", ".params", ".parm", ".yaml", ".txt", ".md")
    parts = ("", "_log", "_session", "_cal", "_test", "_cal_test")
    beside = {str(own.with_name(f"{own.stem}{a}{b}")) for a in parts for b in endings}
    return {str(own), *beside}


def _shape(case: Case, name: str) -> str:
    """A name that is the same for all cases of a kind."""
    if name.startswith("TMPDIR/"):
        return "a temporary file"
    if PurePath(name).name.startswith(".") and name != case.output:
        return "a hidden file"
    return "the output" if name == case.output else f"*{PurePath(name).suffix[:10]}"


def _written(case: Case, run: Run) -> Iterator[str]:
    """What a run that succeeded has written must be there, and whole."""
    state = run.after.get(case.output or "")
    if state is None or state[0] != "file":
        return
    _, data = state[1]
    suffix = PurePath(case.output).suffix
    if run.before.get(case.output) == state:
        yield f"files: the output was not written ({case.argv[0]})"
    elif case.argv[0] == "export" and (
        number := _NO_NUMBER.search(data.decode("utf-8", "replace"))
    ):
        yield f"export: {number[1]} is written as a number"
    elif suffix == ".json" and (fault := _json_fault(data)):
        yield f"json: the file of {case.argv[0]} is {fault}"
    elif suffix == ".svg":
        try:
            ET.fromstring(data)
        except ET.ParseError as error:
            yield f"svg: {_masked(str(error))[:40]} ({case.argv[0]})"
