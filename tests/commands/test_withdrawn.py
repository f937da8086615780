"""A command or option that was withdrawn answers in one line with what to use instead."""

import pytest
from cli_bench import run

from multipos.commands import withdrawn
from multipos.commands.options import listed
from multipos.commands.parsers import COMMANDS, command_parser

GONE = [(name, option) for name in COMMANDS for option in listed(f"withdrawn {name}")]


@pytest.mark.parametrize("name", withdrawn.COMMANDS)
def test_a_withdrawn_command_names_what_to_use_instead(name, capsys):
    line = f"multipos: error: '{name}' was withdrawn: {withdrawn.COMMANDS[name]}.\n"
    assert run(capsys, name) == (2, "", line)
    assert run(capsys, name, "cal.json", "--help") == (2, "", line)


@pytest.mark.parametrize(("name", "option"), GONE)
@pytest.mark.parametrize("value", ["", "=2"])
def test_a_withdrawn_option_names_what_to_use_instead(name, option, value, capsys):
    instead = listed(f"withdrawn {name}")[option]
    line = f"multipos: error: '{name} {option}' was withdrawn: {instead}.\n"
    assert run(capsys, name, f"{option}{value}") == (2, "", line)


def test_what_is_withdrawn_is_gone():
    assert len(GONE) > 8
    assert not withdrawn.COMMANDS.keys() & COMMANDS.keys()
    assert not [each for each in GONE if each[1] in command_parser(each[0])._option_string_actions]


def test_options_of_other_commands_stay(capsys):
    status, _, err = run(capsys, "fit", "none.csv", "--robust", "huber")
    assert status == 1
    assert "withdrawn" not in err
