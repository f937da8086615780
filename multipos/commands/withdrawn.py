"""Commands and options that this version withdraws, and what to use instead.

`instead_of_command` answers for a name that is no command, `refuse_options` for options that their
command had.
"""

from collections.abc import Sequence

from multipos.errors import UsageError

COMMANDS = {
    "completion": (
        "argcomplete does it; after pip install 'multipos[completion]' put "
        "'eval \"$(register-python-argcomplete multipos)\"' into the shell's start-up file"
    ),
    "verify-export": (
        "'export' prints the residual of what it wrote, and C has its self-test NAME_test.c"
    ),
    "worth": "'design --include CAL.json --positions N' gives every u before and after",
}

OPTIONS = {
    "compare": {
        "--combine": "'fit' all rows in one table, with a column 'run' that numbers the sessions",
    },
    "regress": {
        "--backward": "--stepwise removes terms as well, with --enter and --remove",
        "--branches": "--segment RATE:0 --free, with RATE among --variables, parts its signs",
        "--cluster": "--run COLUMN has the variance between its values in every u",
        "--criterion": "--stepwise chooses terms by --enter and --remove",
        "--cross-validate": "'check REG.json DATA.csv' judges it by rows that it was not fitted to",
        "--robust": "F_robust is always by the covariance of correlated rows",
        "--subsets": "--stepwise chooses terms by --enter and --remove",
    },
    "report": {
        "--language": "leave it out; reports are in English",
    },
}


def instead_of_command(name: str) -> str | None:
    """Return one sentence on a command that was withdrawn, None where there was none."""
    if name not in COMMANDS:
        return None
    return f"'{name}' was withdrawn: {COMMANDS[name]}."


def refuse_options(name: str, words: Sequence[str]) -> None:
    """Refuse what is typed after a command where an option of it was withdrawn.

    Raises
    ------
    UsageError
        One of the words is such an option.
    """
    withdrawn = OPTIONS.get(name, {})
    for word in words:
        option = word.partition("=")[0]
        if option in withdrawn:
            raise UsageError(f"'{name} {option}' was withdrawn: {withdrawn[option]}.")
