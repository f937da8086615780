"""``python -m multipos`` is ``multipos``."""

import subprocess
import sys

import pytest

from multipos.cli import main


@pytest.mark.parametrize("argv", [["--help"], ["schemes", "faces-6"], ["fit", "--model"]], ids=str)
def test_the_module_does_what_the_command_does(argv, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    done = subprocess.run(
        [sys.executable, "-m", "multipos", *argv], capture_output=True, text=True, check=False
    )
    try:
        status = main(argv)
    except SystemExit as end:  # of --help
        status = end.code
    assert (done.returncode, done.stdout, done.stderr) == (status, *capsys.readouterr())
