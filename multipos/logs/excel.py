"""Workbooks: the sheet that was open when it was saved, as the text it would be."""

import csv
import datetime
import io
import os
from pathlib import Path
from typing import Any

from multipos.files.packed import Unpacked
from multipos.logs.arrays import loaded
from multipos.logs.extras import require_extra


def unpack_workbook(path: os.PathLike[str]) -> Unpacked:
    """Return a workbook's sheet as a file of text, row by row."""
    require_extra(path, "an Excel workbook", "openpyxl", "excel")
    rows = loaded(path, lambda: _rows(path))
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return Unpacked(str(path), io.BytesIO(text.getvalue().encode()), ".csv")


def _rows(path: os.PathLike[str]) -> list[list[str]]:
    from openpyxl import load_workbook

    with Path(path).open("rb") as stream:
        book = load_workbook(stream, read_only=True, data_only=True)
        return [[_cell(cell) for cell in row] for row in book.active.iter_rows(values_only=True)]


def _cell(value: Any) -> str:
    if isinstance(value, datetime.datetime):
        return value.isoformat(sep=" ", timespec="microseconds")
    return "" if value is None else str(value)
