"""Scripts of completion: shells take them, and complete what the commands have."""

import shutil
import subprocess

import pytest

from multipos import cli


def script(capsys, shell):
    assert cli.main(["completion", shell]) == 0
    return capsys.readouterr().out


def bash(text, *line):
    """Return what bash offers for the last word of a line."""
    words = " ".join(f"'{word}'" for word in line)
    asked = (
        f"COMP_WORDS=({words}); COMP_CWORD={len(line) - 1}; _multipos; "
        'printf "%s\\n" "${COMPREPLY[@]}"'
    )
    done = subprocess.run(
        ["bash", "-c", f"{text}\n{asked}"], capture_output=True, text=True, check=True
    )
    assert done.stderr == ""
    return done.stdout.split()


@pytest.mark.skipif(not shutil.which("bash"), reason="bash is not installed")
def test_bash_completes_commands_options_and_choices(capsys):
    text = script(capsys, "bash")
    assert bash(text, "multipos", "ave") == ["average"]
    assert set(bash(text, "multipos", "")) == {*cli.COMMANDS, "--help", "--version"}
    assert bash(text, "multipos", "fit", "--orie") == ["--orientation-sd"]
    assert bash(text, "multipos", "fit", "--gravity", "") == []  # a number, or a file's name
    assert bash(text, "multipos", "completion", "f") == ["fish"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_every_command_and_option_is_in_the_script(shell, capsys):
    text = script(capsys, shell)
    for name in cli.COMMANDS:
        assert name in text
        for action in cli.command_parser(name)._actions:
            for option in action.option_strings:
                assert (
                    f"-l {option[2:]}" if shell == "fish" and option[2:] else option[1:]
                ) in text


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_a_shell_takes_its_script(shell, capsys):
    if not shutil.which(shell):
        pytest.skip(f"{shell} is not installed")
    subprocess.run([shell, "-n", "-c", script(capsys, shell)], check=True)


def test_an_unknown_shell_is_refused(capsys):
    assert cli.main(["completion", "tcsh"]) == 2
    assert "choose from" in capsys.readouterr().err
