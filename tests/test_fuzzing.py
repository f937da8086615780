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


def keeps_its_promise(argv):
    return complain()


def keeps_it_with_a_result(argv):
    Path("o.json").write_text("{}")
    print('{"a": null}')
    print("multipos: warning: few rows", file=sys.stderr)
    return 0


def raises(argv):
    return {}["missing"]


def dies(argv):
    os.kill(os.getpid(), signal.SIGSEGV)


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


def ends_in_another_status(argv):
    return complain(status=4)


def says_nothing(argv):
    return 2


def hides_what_it_did_not_expect(argv):
    return complain("an unexpected KeyError; set MULTIPOS_DEBUG=1.")


def prints_before_it_fails(argv):
    print("half a table")
    return complain()


def warns_as_python_does(argv):
    warnings.warn("divide by zero", RuntimeWarning, stacklevel=1)
    return complain()


def talks(argv):
    print("now reading", file=sys.stderr)
    return complain()


def colours(argv):
    return complain("\x1b[31mred.")


def makes_a_file_and_fails(argv):
    Path("o_test.c").write_text("")
    return complain()


def touches_the_output_and_fails(argv):
    Path("o.json").touch()
    return complain()


def changes_its_input(argv):
    Path("in.csv").write_text("")
    return complain()


def leaves_a_temporary_file(argv):
    tempfile.mkstemp()
    return keeps_it_with_a_result(argv)


def leaves_a_neighbour(argv):
    Path(".o.json.tmp").touch()
    return keeps_it_with_a_result(argv)


def prints_nan(argv):
    Path("o.json").write_text("{}")
    print('{"a": NaN}')
    return 0


def prints_a_list(argv):
    Path("o.json").write_text("{}")
    print("[]")
    return 0


def writes_half_a_file(argv):
    Path("o.json").write_text('{"a": ')
    print("{}")
    return 0


def prints_what_others_refuse(argv):
    Path("o.json").write_text("{}")
    print('{"schema": "multipos/calibration/1"}')
    return 0


def does_not_write(argv):
    print("{}")
    return 0


FORKS = pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")  # beside threads


@FORKS
@pytest.mark.parametrize(
    ("main", "signature"),
    [
        (keeps_its_promise, None),
        (keeps_it_with_a_result, None),
        (raises, "traceback: KeyError"),
        (dies, "killed: SIGSEGV"),
        (works_for_ever, "slow: more than 1 s"),
        (takes_memory, "memory: more than 256 MB"),
        (ends_in_another_status, "status: 4"),
        (says_nothing, "stderr: does not end"),
        (hides_what_it_did_not_expect, "unexpected: "),
        (prints_before_it_fails, "stdout: not empty on 1"),
        (warns_as_python_does, "warning: RuntimeWarning"),
        (talks, "stderr: a strange line"),
        (colours, "stderr: a control character"),
        (makes_a_file_and_fails, "files: made on failure"),
        (touches_the_output_and_fails, "files: touched on failure, the output"),
        (changes_its_input, "files: an input is changed"),
        (leaves_a_temporary_file, "files: beside the output, a temporary file"),
        (leaves_a_neighbour, "files: beside the output, a hidden file"),
        (prints_nan, "json: stdout of fit is no JSON: not finite"),
        (prints_a_list, "json: stdout of fit is no object"),
        (prints_what_others_refuse, "json: stdout of fit is refused: : the key"),
        (writes_half_a_file, "json: the file of fit"),
        (does_not_write, "files: the output was not written"),
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
