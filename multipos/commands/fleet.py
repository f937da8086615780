"""``multipos fleet``."""

import argparse
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from shutil import rmtree

from multipos.commands.answers import Answer, Output, same_file
from multipos.commands.options import declare, options_of, progress_bar
from multipos.errors import MultiposError, UsageError
from multipos.files.trees import to_json
from multipos.files.whole import no_folder
from multipos.finding import Finding, Findings, read_findings
from multipos.fleets.fleet import Fleet, fleet
from multipos.fleets.fleet_text import fleet_sentence, fleet_text
from multipos.fleets.folder import (
    CSV,
    STATIONS,
    file_names,
    has_corrections,
    has_page,
    has_parquet,
    progress_folder,
    write_fleet,
)
from multipos.fleets.verdicts import PASS
from multipos.fleets.workers import ENGINES
from multipos.reports.documents import html_report, markdown_report
from multipos.reports.fleet_report import fleet_content

INPUTS = ("tables", "scheme", "budget", "limits")
OUTPUT = Output(
    "DIR",
    "folder for calibrations.parquet, units.csv, fleet.json, report.html and stations",
    "folder",
    required=True,
    beside=lambda arguments: _written(Path(arguments.output)),
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    declare(parser, "fleet", engines="|".join(ENGINES))


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    folder = Path(arguments.output)
    _check_place(folder, arguments.tables)
    options = options_of(arguments, "fleet")
    with progress_bar("units", 0) as advance, _kept_if_stopped(folder) as kept:
        found = fleet(*arguments.tables, progress_folder=kept, progress=advance, **options)
        content = fleet_content(found.to_dict())
        page = html_report(content) if has_page() else markdown_report(content)
        write_fleet(found, folder, page)
    return Answer(
        sentence=lambda: fleet_sentence(found.to_dict()),
        text=lambda: (
            f"{fleet_text(found.to_dict())}\nWritten to {folder}: {', '.join(_names(found))}\n"
            + ("" if has_page() else "For report.html: pip install jinja2 matplotlib\n")
        ),
        json=lambda: to_json(found.to_dict()),
        negative=lambda _: found["verdicts"].get(PASS, 0) == 0,
        findings=lambda: (*read_findings(found.summary), *_without_parquet()),
    )


def _written(folder: Path) -> list[Path]:
    """Return what may be written over: also what stands among the corrections of stations."""
    there: list[Path] = []
    with suppress(OSError):
        there = list((folder / STATIONS).iterdir())
    return [*(folder / name for name in file_names()), *there]


def _names(found: Fleet) -> tuple[str, ...]:
    return (*file_names(), f"{STATIONS}/") if has_corrections(found) else file_names()


def _check_place(folder: Path, tables: Sequence[str]) -> None:
    """Refuse a folder that is read, or that cannot be one, before any work is done."""
    if any(same_file(folder, table) for table in map(str, tables)):
        raise UsageError(f"-o {folder} is the folder that is read; give another.")
    try:
        taken = not stat.S_ISDIR(folder.stat().st_mode)
    except FileNotFoundError:
        if folder.is_symlink():
            raise MultiposError(
                f"{folder}: a link to a folder that is not there; give another with -o."
            ) from None
        return
    except OSError as error:
        raise no_folder(folder, error) from None
    if taken:
        raise MultiposError(f"{folder}: a file of this name is there; give a folder with -o.")


@contextmanager
def _kept_if_stopped(folder: Path) -> Iterator[Path]:
    """Yield where finished tasks are kept; they stay where the run is stopped, and only then."""
    kept, was_there = progress_folder(folder), folder.exists()
    try:
        yield kept
    except Exception:
        rmtree(kept, ignore_errors=True)
        if not was_there:
            with suppress(OSError):
                folder.rmdir()
        raise


def _without_parquet() -> Findings:
    """Say that the table is no Parquet, where that is not installed."""
    if has_parquet():
        return ()
    text = f"the table is {CSV}, as Parquet is not installed; pip install 'multipos[parquet]'"
    return (Finding("no-parquet", "note", text),)
