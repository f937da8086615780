"""``multipos demo``."""

import argparse

from multipos.commands.answers import Answer, Output
from multipos.files.trees import to_json
from multipos.reports.summary import calibration_sentence
from multipos.song_qin import demo, demo_dict, demo_text

INPUTS = ()
OUTPUT = Output("DIR", "folder for readings, calibration, report (default multipos-demo)", "folder")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command: there are none."""


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    folder = arguments.output or "multipos-demo"
    found = demo(folder)
    said = f"{demo_text(found)}\nWritten to {folder}: readings.csv, calibration.json, report.txt\n"
    return Answer(
        sentence=lambda: calibration_sentence(found.calibration),
        text=lambda: said,
        json=lambda: to_json(demo_dict(found)),
        findings=lambda: found.calibration.findings,
    )
