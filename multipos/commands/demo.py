"""``multipos demo``."""

import argparse

from multipos.commands.options import add_output
from multipos.files import to_json
from multipos.song_qin import demo, demo_dict, demo_text


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add_output(parser, "DIR", "folder for readings, calibration, report (default multipos-demo)")


def run(arguments: argparse.Namespace) -> str:
    """Return what the command prints."""
    folder = arguments.output or "multipos-demo"
    found = demo(folder)
    if arguments.json:
        return to_json(demo_dict(found))
    return f"{demo_text(found)}\nWritten to {folder}: readings.csv, calibration.json, report.txt\n"
