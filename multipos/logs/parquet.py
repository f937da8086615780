"""Tables of Arrow: Parquet and Feather."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np


def load_arrow(path: os.PathLike[str]) -> Mapping[str, Any]:
    """Return the columns that are numbers, times or texts."""
    from pyarrow import feather, parquet

    with Path(path).open("rb") as stream:
        whole = parquet if stream.read(4) == b"PAR1" else feather
        stream.seek(0)
        table = whole.read_table(stream)
    columns = {}
    for name, column in zip(table.column_names, table.columns, strict=True):
        array = column.to_numpy()
        if array.dtype.kind == "O" and all(isinstance(cell, str | None) for cell in array):
            array = np.array([cell or "" for cell in array], dtype=np.str_)
        columns[name] = array
    return columns
