"""The folder that `multipos fleet` writes: its files, and where a run that was stopped left off.

- `write_fleet` writes the folder, `read_summary` reads `fleet.json`, `file_names` names the files.
- `progress_folder` is where finished tasks are kept until a run has ended.
- `has_page`, `has_parquet` and `has_corrections` say which files there are.

Where the angles of a station's fixture are identifiable, `stations` in it has two files of the
station's name: the positions where they are, as a scheme (.csv), and how well that is known, as a
budget (.toml).
"""

import shutil
from collections.abc import Iterator, Mapping
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from multipos.errors import MultiposError
from multipos.files import pipes, spelling, tables, trees
from multipos.files.spelling import StrPath
from multipos.files.whole import Content, Pieces, make_folder, written
from multipos.fleets.fleet import SCHEMA, Fleet

PARQUET, CSV = "calibrations.parquet", "calibrations.csv"
UNITS, SUMMARY = "units.csv", "fleet.json"
PAGE, TEXT = "report.html", "report.md"  # the second where the page's libraries are missing
STATIONS = "stations"
_PROGRESS = ".progress"
_UNNAMED = "all"  # files of the one station that has no name
_ROWS = 100_000  # units that are written at a time, a row group of Parquet
_LONGEST = 60  # characters of a file name that a station gives

Files = dict[StrPath, Pieces]


def file_names() -> tuple[str, ...]:
    """Return the names of the files that are written on this machine."""
    return (PARQUET if has_parquet() else CSV, UNITS, SUMMARY, PAGE if has_page() else TEXT)


def has_page() -> bool:
    """Tell whether what makes an HTML report is installed."""
    return all(find_spec(library) is not None for library in ("jinja2", "matplotlib"))


def has_parquet() -> bool:
    """Tell whether what writes Parquet is installed."""
    return find_spec("pyarrow") is not None


def progress_folder(folder: StrPath) -> Path:
    """Return where finished tasks of a run are kept until it has ended."""
    return Path(folder) / _PROGRESS


def write_fleet(fleet: Fleet, folder: StrPath, page: Content) -> None:
    """Write the files of a fleet into a folder, all of them or none.

    Parameters
    ----------
    fleet : Fleet
    folder : path
        Made where it is not there.
    page : text
        The report.

    Raises
    ------
    MultiposError
        The folder cannot be made, or a file cannot be written.
    """
    place = Path(folder)
    make_folder(place)
    corrections: Files = dict(_corrections(fleet, place / STATIONS))
    table: Pieces = _csv_pieces(fleet.calibrations)
    if has_parquet():
        table = tables.to_parquet(_parts(fleet.calibrations))
    files: Files = {
        place / (PARQUET if has_parquet() else CSV): table,
        place / UNITS: _csv_pieces(fleet.verdicts),
        place / SUMMARY: trees.to_json(fleet.to_dict()),
        place / (PAGE if has_page() else TEXT): page,
        **corrections,
    }
    try:
        if corrections:
            make_folder(place / STATIONS)
        with written(files):
            pass
    except MultiposError:
        with suppress(OSError):
            (place / STATIONS).rmdir()  # if it is empty
        raise
    shutil.rmtree(progress_folder(place), ignore_errors=True)


def _corrections(fleet: Fleet, place: Path) -> Iterator[tuple[Path, str]]:
    """Yield the files of every station whose correction is identifiable."""
    taken: set[str] = set()
    for station in fleet["stations"]:
        name = _file_name(station["station"], taken)
        found = station["correction"]
        if found is None:
            continue
        called = spelling.visible(station["station"]) or "one station"
        count = int(found["budget"]["orientation"]["dof"]) + 1
        yield (
            place / f"{name}.csv",
            f"# {called}: up at every position, from {count} units, but for a turn of all\n"
            + tables.format_csv(found["scheme"]),
        )
        yield (
            place / f"{name}.toml",
            f"# {called}: how well {name}.csv is known, from {count} units\n"
            "# A turn that all positions share is not in it: state it as [level].\n"
            + "".join(
                f"\n[{table}]\n" + "".join(f"{key} = {value!r}\n" for key, value in keys.items())
                for table, keys in found["budget"].items()
            ),
        )


def _file_name(station: str, taken: set[str]) -> str:
    """Return the name of a station's files, which no other has, in capitals or not."""
    marks = [mark if mark.isalnum() or mark in "-_" else "_" for mark in station[:_LONGEST]]
    name = "".join(marks) or _UNNAMED
    while name.casefold() in taken:
        name += "_"
    taken.add(name.casefold())
    return name


def has_corrections(fleet: Fleet) -> bool:
    """Tell whether there is a correction for any station."""
    return any(station["correction"] is not None for station in fleet["stations"])


def _parts(columns: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield columns so many rows at a time."""
    rows = len(next(iter(columns.values())))
    for start in range(0, rows, _ROWS):
        yield {name: column[start : start + _ROWS] for name, column in columns.items()}


def _csv_pieces(columns: Mapping[str, Any]) -> Iterator[str]:
    """Yield columns as CSV piece by piece."""
    for number, part in enumerate(_parts(columns)):
        text = tables.format_csv(part)
        yield text.partition("\n")[2] if number else text


def read_summary(source: StrPath) -> dict[str, Any]:
    """Return what `fleet.json` holds, from the file or its folder.

    Raises
    ------
    MultiposError
        There is no such file, or it is of another kind.
    """
    path = Path(source)
    return trees.read_json(path / SUMMARY if pipes.is_folder(path) else path, SCHEMA)
