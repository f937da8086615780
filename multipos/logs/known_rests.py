"""Rests that the user knows: a file of the rows where each begins and ends."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from multipos.errors import MultiposError
from multipos.files.pipes import rereadable
from multipos.files.tables import Source, Table, read_table
from multipos.files.trees import read_json_value
from multipos.files.whole import read_bytes
from multipos.logs.rests import Rest


@dataclass(frozen=True)
class Sections:
    """Rests that the user knows, by label."""

    source: str
    rests: dict[str, Rest]

    def inside(self, rows: int) -> dict[str, Rest]:
        """Return the rests of a log of so many rows, or say which lies outside."""
        for label, rest in self.rests.items():
            if rest.start < 0 or rest.end > rows:
                raise MultiposError(
                    f"{self.source}: section '{label}' is rows {rest.start} to {rest.end}, but the "
                    f"log has {rows} rows, counted from 0."
                )
        return self.rests


def read_sections(source: Source) -> Sections:
    """Read where rests begin and end: rows of the log from 0, the end not included.

    Parameters
    ----------
    source : path of JSON or CSV, or mapping
        ``{label: {"start": row, "end": row}}``, or columns position, start, end.

    Raises
    ------
    MultiposError
        Missing, empty, of another form, or a section with fewer than two rows.
    """
    if isinstance(source, str | os.PathLike):
        source = rereadable(source)
    if isinstance(source, os.PathLike) and _is_json(source):
        where, found = str(source), _from_json(source)
    elif isinstance(source, Mapping) and "position" not in source:
        where, found = "sections", source
    else:
        where, found = _from_table(read_table(source, what="sections"))
    if not found:
        raise MultiposError(f"{where}: no sections; give a start and an end for each position.")
    return Sections(
        where, {str(label): _section(where, label, each) for label, each in found.items()}
    )


def _from_table(table: Table) -> tuple[str, Mapping[str, Any]]:
    where = table.source
    missing = [name for name in ("position", "start", "end") if name not in table]
    if missing:
        raise MultiposError(
            f"{where}: no column '{missing[0]}'; sections need position, start, end."
        )
    ends = zip(table.number("start").tolist(), table.number("end").tolist(), strict=True)
    labels = table.text("position")
    twice = next((label for label in labels if labels.count(label) > 1), None)
    if twice is not None:
        raise MultiposError(f"{where}: section '{twice}' appears twice; give each its label.")
    return where, {
        label: {"start": start, "end": end}
        for label, (start, end) in zip(labels, ends, strict=True)
    }


def _is_json(path: os.PathLike[str]) -> bool:
    """Tell by the ending, or by the brace it begins with: a pipe has no ending."""
    if str(path).lower().endswith(".json"):
        return True
    return read_bytes(path, "sections").lstrip().startswith(b"{")


def _from_json(path: os.PathLike[str]) -> Mapping[str, Any]:
    found = read_json_value(path, "sections")
    if not isinstance(found, dict):
        raise MultiposError(
            f'{path}: sections are {{"label": {{"start": row, "end": row}}}}, got another form.'
        )
    return found


def _section(where: str, label: str, each: Any) -> Rest:
    try:
        start, end = each["start"], each["end"]
        rest = Rest(int(start), int(end))
        whole = rest == (start, end)
    except (KeyError, TypeError, ValueError, OverflowError):
        whole = False
    if not whole:
        raise MultiposError(
            f"{where}: section '{label}' needs a start and an end that are whole numbers of rows."
        )
    if rest.end - rest.start < 2:
        raise MultiposError(
            f"{where}: section '{label}' goes from row {rest.start} to {rest.end}; the end must "
            "be at least two rows after the start."
        )
    return rest
