"""The log of a session: every row as it came, at once, so that nothing is lost.

Rows without numbers are kept as comments: read again, the log has the rows that the session had.
"""

import csv
import io
import os
from pathlib import Path
from typing import IO

from multipos.errors import MultiposError
from multipos.logs.table import Log


class RawLog:
    """A log that is written row by row."""

    def __init__(self, path: str | os.PathLike[str], *, going_on: bool) -> None:
        self._path = path
        self._going_on = going_on
        self._delimiter = ","
        try:
            self._stream: IO[str] = Path(path).open(  # noqa: SIM115
                "a" if going_on else "w", encoding="utf-8", newline="", errors="backslashreplace"
            )
        except OSError as error:
            raise MultiposError(
                f"{path}: cannot write: {error.strerror or error}; check the folder and "
                "permissions."
            ) from None

    def begin(self, log: Log) -> None:
        """Write the header, where the columns have names."""
        self._delimiter = log.delimiter
        if self._going_on or log.headless:
            return
        text = io.StringIO()
        csv.writer(text, delimiter=log.delimiter or ",", lineterminator="\n").writerow(log.header)
        self._write(text.getvalue())

    def write(self, lines: list[str], good: list[bool]) -> None:
        """Write rows, those that are not good as comments."""
        if not lines:
            return
        kept = [
            self._row(line) if fine else f"# {line.encode('unicode_escape').decode()}"
            for line, fine in zip(lines, good, strict=True)
        ]
        self._write("\n".join(kept) + "\n")

    def _row(self, line: str) -> str:
        return line if self._delimiter else ",".join(line.split())

    def _write(self, text: str) -> None:
        try:
            self._stream.write(text)
            self._stream.flush()
        except OSError as error:
            raise MultiposError(
                f"{self._path}: cannot write: {error.strerror or error}; check the disk."
            ) from None

    def close(self) -> None:
        """Close the log."""
        self._stream.close()
