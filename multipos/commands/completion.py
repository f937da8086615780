"""``multipos completion``: scripts that let a shell complete commands and options.

A script holds the words themselves, so that completing starts no Python; what is no option is
completed as a file.
"""

import argparse
import json
from collections.abc import Callable, Iterable, Mapping

from multipos.commands.answers import Answer, Output
from multipos.commands.parsers import COMMANDS, command_parser

INPUTS = ()
OUTPUT = Output("FILE", "write the script to FILE as well", "text")

Parsers = Mapping[str, argparse.ArgumentParser]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument("shell", choices=list(SHELLS), help="whose script to print")
    parser.epilog = (
        'bash and zsh: eval "$(multipos completion bash)" in ~/.bashrc or ~/.zshrc; '
        "fish: multipos completion fish > ~/.config/fish/completions/multipos.fish"
    )


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    script = SHELLS[arguments.shell]({name: command_parser(name) for name in COMMANDS})
    return Answer(
        sentence=lambda: f"Completion of multipos in {arguments.shell}.",
        text=lambda: script,
        json=lambda: json.dumps({"shell": arguments.shell, "script": script}) + "\n",
        verbatim=True,
    )


def _options(parser: argparse.ArgumentParser) -> Iterable[argparse.Action]:
    return (action for action in parser._actions if action.option_strings)


def _words(action: argparse.Action) -> list[str]:
    return [str(choice) for choice in action.choices or ()]


def bash(parsers: Parsers) -> str:
    """Return the script for bash."""
    cases = "".join(
        f"    {name})\n{_bash_case(parser)}        ;;\n" for name, parser in parsers.items()
    )
    return (
        "# Completion of multipos in bash.\n"
        "_multipos() {\n"
        '    local word="${COMP_WORDS[COMP_CWORD]}" before="${COMP_WORDS[COMP_CWORD-1]}" words=""\n'
        f'    if [ "$COMP_CWORD" -eq 1 ]; then\n'
        f'        words="{" ".join(parsers)} --help --version"\n'
        "    fi\n"
        '    case "${COMP_WORDS[1]}" in\n'
        f"{cases}"
        "    esac\n"
        '    COMPREPLY=($(compgen -W "$words" -- "$word"))\n'
        "}\n"
        "complete -o default -F _multipos multipos\n"
    )


def _bash_case(parser: argparse.ArgumentParser) -> str:
    """Return what follows a command: its options, or what the option before takes."""
    options = sorted(text for action in _options(parser) for text in action.option_strings)
    named = [
        word for action in parser._actions if not action.option_strings for word in _words(action)
    ]
    lines = [f'words="{" ".join([*named, *options])}"', 'case "$before" in']
    for action in _options(parser):
        if action.nargs != 0:
            pattern, words = "|".join(action.option_strings), " ".join(_words(action))
            lines.append(f'    {pattern}) words="{words}" ;;')
    return "".join(f"        {line}\n" for line in [*lines, "esac"])


def zsh(parsers: Parsers) -> str:
    """Return the script for zsh, which takes what bash has."""
    return f"autoload -U +X bashcompinit && bashcompinit\n{bash(parsers)}"


def fish(parsers: Parsers) -> str:
    """Return the script for fish."""
    first = "not __fish_seen_subcommand_from $multipos_commands"
    lines = [
        "# Completion of multipos in fish.",
        f"set -g multipos_commands {' '.join(parsers)}",
        f"complete -c multipos -n '{first}' -f",
        f"complete -c multipos -n '{first}' -l version -d 'print the version'",
        f"complete -c multipos -n '{first}' -l help -d 'list the commands'",
    ]
    for name, parser in parsers.items():
        lines.append(
            f"complete -c multipos -n '{first}' -a {name} -d {_quoted(parser.description or '')}"
        )
        here = f"complete -c multipos -n '__fish_seen_subcommand_from {name}'"
        lines += [line for action in parser._actions for line in _fish_lines(here, action)]
    return "\n".join(lines) + "\n"


def _fish_lines(here: str, action: argparse.Action) -> list[str]:
    """Return the line of an option or of words that are asked for, none for other words."""
    words = f" -a {_quoted(' '.join(_words(action)))}" if action.choices else ""
    if not action.option_strings:
        return [f"{here}{words}"] if words else []
    names = " ".join(
        f"-l {text[2:]}" if text.startswith("--") else f"-s {text[1:]}"
        for text in action.option_strings
    )
    value = "" if action.nargs == 0 else " -r"
    said = _quoted((action.help or "").replace("%%", "%"))
    return [f"{here} {names}{value}{words} -d {said}"]


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace("'", "\\'")
    return f"'{escaped}'"


SHELLS: dict[str, Callable[[Parsers], str]] = {"bash": bash, "zsh": zsh, "fish": fish}
