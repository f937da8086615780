"""Commands and options that this version withdraws, and what to use instead.

`instead_of_command` answers for a name that is no command, `refuse_options` for options that their
command had. They stand in `options.csv`, in groups that begin with "withdrawn".
"""

from collections.abc import Sequence

from multipos.commands.options import listed
from multipos.errors import UsageError

COMMANDS = listed("withdrawn commands")


def instead_of_command(name: str) -> str | None:
    """Return one sentence on a command that was withdrawn, None where there was none."""
    return f"'{name}' was withdrawn: {COMMANDS[name]}." if name in COMMANDS else None


def refuse_options(name: str, words: Sequence[str]) -> None:
    """Refuse what is typed after a command where an option of it was withdrawn.

    Raises
    ------
    UsageError
        One of the words is such an option.
    """
    withdrawn = listed(f"withdrawn {name}")
    for word in words:
        option = word.partition("=")[0]
        if option in withdrawn:
            raise UsageError(f"'{name} {option}' was withdrawn: {withdrawn[option]}.")
