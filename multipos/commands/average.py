"""``multipos average``."""

import argparse

from multipos.commands.answers import Answer, Output, answer_of
from multipos.commands.options import declare, file_progress, options_of
from multipos.files.tables import format_csv
from multipos.logs.averages import averages_sentence, averages_text
from multipos.logs.readers import formats_read

INPUTS = ("logs", "sections", "scheme")
OUTPUT = Output("READINGS.csv", "write the readings to READINGS.csv", "table", ("json", "text"))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    declare(parser, "average", formats=formats_read())


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    with file_progress(arguments.logs, "reading") as progress:
        from multipos.logs.averaging import average  # with the search for rests

        found = average(*arguments.logs, progress=progress, **options_of(arguments, "average"))
    forms = {"table": lambda: format_csv(found.columns())}
    return answer_of(found, averages_sentence, averages_text, forms=forms)
