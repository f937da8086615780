"""A shell asks by the variables of argcomplete, and is answered with commands, options, files."""

import os
import subprocess
import sys

import pytest
from cli_bench import MULTIPOS, run

from multipos.commands.parsers import COMMANDS, command_parser

pytest.importorskip("argcomplete")


@pytest.fixture
def asked(tmp_path):
    """Ask what completes a line, as the shell's function of argcomplete does."""
    (tmp_path / "readings.csv").write_text("")
    (tmp_path / "folder").mkdir()

    def ask(line, program=(MULTIPOS,)):
        answer = tmp_path / "answer"
        environment = os.environ | {
            "_ARGCOMPLETE": "1",
            "_ARGCOMPLETE_IFS": "\n",
            "_ARGCOMPLETE_STDOUT_FILENAME": str(answer),
            "COMP_LINE": line,
            "COMP_POINT": str(len(line)),
        }
        done = subprocess.run(
            program, env=environment, cwd=tmp_path, capture_output=True, timeout=60, check=True
        )
        assert (done.stdout, done.stderr) == (b"", b"")
        words = answer.read_text().split("\n")
        answer.unlink()
        return {word.strip() for word in words}

    return ask


def test_commands_are_completed(asked):
    assert asked("multipos ave") == {"average"}
    assert asked("multipos ") == {*COMMANDS, "--help", "-h", "--version"}


def test_every_option_of_a_command_is_completed(asked):
    assert asked("multipos fit --orie") == {"--orientation-sd"}
    known = command_parser("apply")._option_string_actions
    assert asked("multipos apply cal.json -") == set(known)


def test_files_are_completed_as_files(asked):
    assert asked("multipos fit read") == {"readings.csv"}
    assert asked("multipos fit fol") == {"folder/"}
    assert asked("multipos fit readings.csv --scheme r") == {"readings.csv"}


def test_the_module_is_completed_as_the_program_is(asked):
    assert asked("multipos ave", [sys.executable, "-m", "multipos"]) == {"average"}


def test_the_marker_stands_where_argcomplete_looks_for_it():
    check = [sys.executable, "-m", "argcomplete._check_console_script", MULTIPOS]
    assert subprocess.run(check, capture_output=True, check=False).returncode == 0
    check = [sys.executable, "-m", "argcomplete._check_module", "multipos"]
    assert subprocess.run(check, capture_output=True, check=False).returncode == 0


def test_who_is_asked_by_no_shell_imports_nothing_of_it(monkeypatch):
    monkeypatch.delenv("_ARGCOMPLETE", raising=False)
    seen = "import sys; from multipos.cli import main; main(['--version']); print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", seen], capture_output=True, text=True, timeout=60, check=True
    )
    assert not {"argcomplete", "multipos.commands.completing"} & set(done.stdout.split())


def test_without_argcomplete_a_shell_is_answered_nothing(capsys, monkeypatch):
    monkeypatch.setenv("_ARGCOMPLETE", "1")
    monkeypatch.setitem(sys.modules, "argcomplete", None)
    line = "multipos: error: completion needs argcomplete, which is not installed; "
    assert run(capsys, "--version") == (1, "", line + "pip install argcomplete.\n")
