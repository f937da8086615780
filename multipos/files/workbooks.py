"""Excel workbooks as text, row by row."""

import csv
import datetime
import io
import os
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from multipos.errors import MultiposError
from multipos.files.pipes import Unpacked

ZIP = b"PK\x03\x04"


def require_extra(
    path: str | os.PathLike[str], kind: str, library: str, extra: str, does: str = "reads"
) -> None:
    """Refuse a file whose library, which reads or writes it, is not installed.

    Raises
    ------
    MultiposError
        Names the kind of the file and the extra.
    """
    try:
        there = find_spec(library) is not None
    except ModuleNotFoundError:  # of the package above it
        there = False
    if not there:
        raise MultiposError(
            f"{path}: {kind}, which {library} {does}; install it with "
            f"pip install 'multipos[{extra}]'."
        )


def broken(path: str | os.PathLike[str], error: ImportError) -> MultiposError:
    """Return what is said of a library that is installed and cannot be loaded."""
    name = (error.name or "a library").partition(".")[0]
    said = " ".join(str(error).split())[:100]
    return MultiposError(
        f"{path}: {name} is installed but cannot be loaded ({said}); install it again."
    )


def workbook_text(path: str | os.PathLike[str]) -> str:
    """Return a workbook's sheet as comma separated text.

    Raises
    ------
    MultiposError
        It cannot be read, or `openpyxl` is not installed.
    """
    require_extra(path, "an Excel workbook", "openpyxl", "excel")
    from openpyxl import load_workbook

    text = io.StringIO()
    try:
        with Path(path).open("rb") as stream:
            book = load_workbook(stream, read_only=True, data_only=True)
            rows = book.active.iter_rows(values_only=True)
            csv.writer(text, lineterminator="\n").writerows(map(_cells, rows))
    except Exception as error:  # of a damaged file whatever its library raises
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise MultiposError(
            f"{path}: cannot read the workbook: {reason}; save it again as .xlsx or CSV."
        ) from None
    return text.getvalue()


def unpack_workbook(path: os.PathLike[str]) -> Unpacked:
    """Return a workbook's sheet as a file of text."""
    return Unpacked(str(path), io.BytesIO(workbook_text(path).encode()), ".csv")


def _cells(row: tuple[Any, ...]) -> list[str]:
    return [_cell(cell) for cell in row]


def _cell(value: Any) -> str:
    if isinstance(value, datetime.datetime):
        return value.isoformat(sep=" ", timespec="microseconds")
    return "" if value is None else str(value)
