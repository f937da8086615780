"""Excel workbooks as text, row by row."""

import csv
import datetime
import io
import os
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from multipos.errors import MultiposError
from multipos.files.pipes import Unpacked
from multipos.files.whole import first_bytes

ZIP = b"PK\x03\x04"
OLE = b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"  # of .xls, as phyphox and old programs write it


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
        It cannot be read, or `openpyxl` or `xlrd`, which reads it, is not installed.
    """
    old = first_bytes(path, len(OLE)) == OLE
    require_extra(path, "an Excel workbook", "xlrd" if old else "openpyxl", "excel")
    text = io.StringIO()
    try:
        rows = _rows_of_xls(path) if old else _rows_of_xlsx(path)
        csv.writer(text, lineterminator="\n").writerows(map(_cells, rows))
    except Exception as error:  # of a damaged file whatever its library raises
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise MultiposError(
            f"{path}: cannot read the workbook: {reason}; save it again as .xlsx or CSV."
        ) from None
    return text.getvalue()


def _rows_of_xlsx(path: str | os.PathLike[str]) -> Iterator[tuple[Any, ...]]:
    from openpyxl import load_workbook

    with Path(path).open("rb") as stream:
        book = load_workbook(stream, read_only=True, data_only=True)
        yield from book.active.iter_rows(values_only=True)


def _rows_of_xls(path: str | os.PathLike[str]) -> Iterator[tuple[Any, ...]]:
    import xlrd

    with xlrd.open_workbook(path, logfile=io.StringIO()) as book:
        sheet = next(
            (each for each in book.sheets() if each.sheet_selected), book.sheet_by_index(0)
        )
        for row in sheet.get_rows():
            yield tuple(
                xlrd.xldate_as_datetime(cell.value, book.datemode)
                if cell.ctype == xlrd.XL_CELL_DATE
                else cell.value
                for cell in row
            )


def unpack_workbook(path: os.PathLike[str]) -> Unpacked:
    """Return a workbook's sheet as a file of text."""
    return Unpacked(str(path), io.BytesIO(workbook_text(path).encode()), ".csv")


def _cells(row: tuple[Any, ...]) -> list[str]:
    return [_cell(cell) for cell in row]


def _cell(value: Any) -> str:
    if isinstance(value, datetime.datetime):
        return value.isoformat(sep=" ", timespec="microseconds")
    return "" if value is None else str(value)
