"""Archives that phones export: one table a sensor; the accelerometer's, with gravity, is taken.

phyphox puts one experiment into ``Raw Data.csv``. Sensor Logger has ``TotalAcceleration.csv`` with
gravity, while its ``Accelerometer.csv`` has had gravity taken away, which no calibration can use.
"""

import os
import re
from pathlib import PurePosixPath

from multipos.errors import MultiposError
from multipos.files.packed import Unpacked
from multipos.logs.arrays import loaded

# In the order in which they are looked for.
_WITH_GRAVITY = [
    re.compile(pattern, re.IGNORECASE)
    for pattern in (
        r"total ?acc.*",
        r"acc.*uncalibrated.*",
        r"acc.*with.?g.*",
        r"acc.*",
        r"raw data",
    )
]
_TABLES = (".csv", ".tsv", ".txt")


def tables_in(path: os.PathLike[str]) -> list[str]:
    """Return the tables in an archive, in its first folder."""
    from zipfile import ZipFile

    with ZipFile(path) as archive:
        names = [PurePosixPath(name) for name in archive.namelist()]
    return [str(each) for each in names if each.suffix.lower() in _TABLES and len(each.parts) <= 1]


def unpack_phone(path: os.PathLike[str]) -> Unpacked:
    """Return the accelerometer's table of an archive.

    Raises
    ------
    MultiposError
        There is none, or only one without gravity.
    """
    names: list[str] = loaded(path, lambda: tables_in(path))
    stems = {PurePosixPath(name).stem: name for name in names}
    found = next((s for p in _WITH_GRAVITY for s in stems if p.fullmatch(s)), None)
    if found is None and len(stems) == 1:
        found = next(iter(stems))
    if found is None:
        raise MultiposError(
            f"{path}: none of {', '.join(names)} looks like an accelerometer's; unpack the one."
        )
    if found == "Accelerometer" and "Gravity" in stems:
        raise MultiposError(
            f"{path}: Accelerometer.csv has gravity taken away, as Gravity.csv beside it says; "
            "record total acceleration, or the uncalibrated accelerometer."
        )
    return loaded(path, lambda: _unpacked(path, stems[found]))  # type: ignore[no-any-return]


def _unpacked(path: os.PathLike[str], name: str) -> Unpacked:
    from zipfile import ZipFile

    with ZipFile(path) as archive, archive.open(name) as stream:
        return Unpacked(str(path), stream, PurePosixPath(name).suffix)
