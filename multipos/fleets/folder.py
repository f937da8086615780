"""The folder that `multipos fleet` writes: its files, and where a run that was stopped left off."""

import io
import os
import shutil
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.files.pipes import is_folder
from multipos.files.tables import format_csv
from multipos.files.trees import read_json, to_json
from multipos.files.whole import Content, written
from multipos.fleets.fleet import SCHEMA, Fleet

PARQUET, CSV = "calibrations.parquet", "calibrations.csv"
UNITS, SUMMARY, PAGE = "units.csv", "fleet.json", "report.html"
_PROGRESS = ".progress"


def file_names() -> tuple[str, ...]:
    """Return the names of the files that are written on this machine."""
    return (PARQUET if has_parquet() else CSV, UNITS, SUMMARY, PAGE)


def has_parquet() -> bool:
    """Tell whether what writes Parquet is installed."""
    return find_spec("pyarrow") is not None


def progress_folder(folder: str | os.PathLike[str]) -> Path:
    """Return where finished tasks of a run are kept until it has ended."""
    return Path(folder) / _PROGRESS


def write_fleet(fleet: Fleet, folder: str | os.PathLike[str], page: Content) -> None:
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
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise MultiposError(
            f"{folder}: cannot make the folder: {error.strerror}; give another with -o."
        ) from None
    files: dict[str | os.PathLike[str], Content] = {
        place / (PARQUET if has_parquet() else CSV): _table_of(fleet),
        place / UNITS: format_csv(fleet.verdicts),
        place / SUMMARY: to_json(fleet.to_dict()),
        place / PAGE: page,
    }
    with written(files):
        pass
    shutil.rmtree(progress_folder(place), ignore_errors=True)


def _table_of(fleet: Fleet) -> Content:
    return to_parquet(fleet.calibrations) if has_parquet() else format_csv(fleet.calibrations)


def to_parquet(columns: Mapping[str, Any]) -> bytes:
    """Return columns as the bytes of a Parquet file; texts that repeat are kept once."""
    import pyarrow as pa
    from pyarrow import parquet

    arrays = {
        name: pa.array(np.asarray(column).astype(object) if column.dtype.kind == "U" else column)
        for name, column in columns.items()
    }
    stream = io.BytesIO()
    parquet.write_table(pa.table(arrays), stream)
    return stream.getvalue()


def read_summary(source: str | os.PathLike[str]) -> dict[str, Any]:
    """Return what `fleet.json` holds, from the file or its folder.

    Raises
    ------
    MultiposError
        There is no such file, or it is of another kind.
    """
    path = Path(source)
    return read_json(path / SUMMARY if is_folder(path) else path, SCHEMA)
