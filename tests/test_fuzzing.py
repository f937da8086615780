"""The fuzzer sees each breach of the promise, makes a case again, and finds none."""

import os
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import pytest
from fuzzing import bases
from fuzzing.judging import judge
from fuzzing.kinds import KINDS, Case, case
from fuzzing.recipes import file_of
from fuzzing.running import Limits, run

ROOT = Path(__file__).resolve().parents[1]
LIMITS = Limits(cpu=1, wall=600, memory=256 << 20)
CASE = Case(("fit", "in.csv", "--json", "-o", "o.json"), {"in.csv": b"1\n"}, old=("o.json",))


def complain(text="nothing is right.", status=1):
    print(f"multipos: error: {text}", file=sys.stderr)
    return status


def failing(act, text="nothing is right.", status=1):
    """A command that does something and complains."""
    return lambda argv: (act(), complain(text, status))[1]


def giving(printed="{}", written="{}", act=lambda: None):
    """A command that writes its output, prints, and does something."""

    def main(argv):
        if written is not None:
            Path("o.json").write_text(written)
        print(printed)
        act()
        return 0

    return main


def raises(argv):
    return {}["missing"]


def works_for_ever(argv):
    while True:
        pass


def waits_for_ever(argv):
    time.sleep(100)


def takes_memory(argv):
    try:
        return len(bytearray(LIMITS.memory * 2))
    except MemoryError:
        return complain("the data do not fit into memory; give fewer rows.")


def say(text):
    print(text, file=sys.stderr)


def nothing():
    """Do nothing."""


def warn():
    warnings.warn("divide by zero", RuntimeWarning, stacklevel=1)


FORKS = pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")  # beside threads


@FORKS
@pytest.mark.parametrize(
    ("main", "signature"),
    [
        (failing(nothing), None),
        (giving('{"a": null}', act=lambda: say("multipos: warning: few rows")), None),
        (raises, "traceback: KeyError"),
        (lambda _: os.kill(os.getpid(), signal.SIGSEGV), "killed: SIGSEGV"),
        (works_for_ever, "slow: more than 1 s"),
        (takes_memory, "memory: more than 256 MB"),
        (failing(nothing, status=4), "status: 4"),
        (lambda _: 2, "stderr: does not end"),
        (failing(nothing, "an unexpected KeyError; set MULTIPOS_DEBUG=1."), "unexpected: "),
        (failing(lambda: print("half a table")), "stdout: not empty on 1"),
        (failing(warn), "warning: RuntimeWarning"),
        (failing(lambda: say("now reading")), "stderr: a strange line"),
        (failing(nothing, "\x1b[31mred."), "stderr: a control character"),
        (failing(Path("o_test.c").touch), "files: made on failure"),
        (failing(Path("o.json").touch), "files: touched on failure, the output"),
        (failing(lambda: Path("in.csv").write_text("")), "files: an input is changed"),
        (giving(act=tempfile.mkstemp), "files: beside the output, a temporary file"),
        (giving(act=Path(".o.json.tmp").touch), "files: beside the output, a hidden file"),
        (giving('{"a": NaN}'), "json: stdout of fit is no JSON: not finite"),
        (giving("[]"), "json: stdout of fit is no object"),
        (
            giving('{"schema": "multipos/calibration/1"}'),
            "json: stdout of fit is refused: : the key",
        ),
        (giving(written='{"a": '), "json: the file of fit"),
        (giving(written=None), "files: the output was not written"),
    ],
)
def test_each_breach_has_its_signature(main, signature, tmp_path):
    found = judge(CASE, run(CASE, tmp_path, main, LIMITS), LIMITS)
    assert [text.startswith(signature) for text in found] == ([True] if signature else []), found


@FORKS
@pytest.mark.parametrize(
    ("line", "found"),
    [
        (b"    {0.1f, -inff},\n", ["export: inf is written as a number"]),
        (b"CAL_ACC0_XOFF nan\n", ["export: nan is written as a number"]),
        (b"/* a sensor\n * of unit nan, inf */\n    {0.1f, 1e30f},\n", []),
    ],
)
def test_an_export_holds_numbers(line, found, tmp_path):
    def writes(argv):
        Path("o.c").write_bytes(line)
        return 0

    made = Case(("export", "in.json", "-o", "o.c"), {})
    assert judge(made, run(made, tmp_path, writes, LIMITS), LIMITS) == found


@FORKS
def test_what_waits_for_ever_is_ended(tmp_path):
    limits = Limits(wall=1)
    (found,) = judge(CASE, run(CASE, tmp_path, waits_for_ever, limits), limits)
    assert found.startswith("waits: more than 1 s")


@FORKS
def test_streams_are_what_the_case_says(tmp_path):
    def copies(argv):
        return 0 if sys.stdin.read() == "x" * 100_000 and sys.stdout is None else 2

    made = Case(("fit",), {}, stdin=b"x" * 100_000, stdout="closed")
    done = run(made, tmp_path, copies, LIMITS)
    assert (done.status, done.stdout, done.stderr) == (0, b"", b"")


@pytest.mark.slow
def test_a_case_depends_on_its_kind_seed_and_number_alone(tmp_path):
    valid = bases.make(tmp_path)
    forward = [case(kind, 5, number, valid) for kind in KINDS for number in range(40)]
    kinds = list(KINDS)[::-1]
    backward = [case(kind, 5, number, valid) for kind in kinds for number in range(39, -1, -1)]
    assert backward[::-1] == forward
    assert len({(made.argv, *made.files.values(), made.stdin) for made in forward}) > 600
    linked = [(made.links["link"], made.argv) for made in forward if made.links]
    assert linked
    assert all(target in ("nothing", *map(file_of, argv)) for target, argv in linked)


@pytest.mark.slow
def test_damaged_inputs_end_as_promised(tmp_path):
    found = subprocess.run(
        [sys.executable, "-m", "tests.fuzzing", "all", "--cases", "12", "--keep", tmp_path],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stdout + found.stderr
    assert f"{12 * len(KINDS)} cases" in found.stdout
