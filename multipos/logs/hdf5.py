"""HDF5, which MATLAB's version 7.3 is too: the data sets of a file, under their names."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

_MATLAB = b"MATLAB 7.3"  # stores matrices column by column, so that they come out transposed


def load_hdf(path: os.PathLike[str]) -> Mapping[str, Any]:
    """Return the data sets of numbers, and the columns of tables."""
    import h5py

    with Path(path).open("rb") as stream:
        transposed = stream.read(len(_MATLAB)) == _MATLAB
    found: dict[str, Any] = {}

    def take(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or item.attrs.get("MATLAB_class") == b"char":
            return
        if item.dtype.names:
            found.update({f"{name}/{part}": item[part] for part in item.dtype.names})
        elif item.dtype.kind in "fiub" and item.ndim in (1, 2):
            found[name] = np.asarray(item).T if transposed else np.asarray(item)

    with h5py.File(os.fspath(path), "r") as file:
        file.visititems(take)
    rows = max((len(column) for column in found.values()), default=0)
    samples = {name: column for name, column in found.items() if len(column) == rows}
    last = [name.rpartition("/")[2] for name in samples]
    if len(set(last)) == len(last):
        return dict(zip(last, samples.values(), strict=True))
    return samples
