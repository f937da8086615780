"""CSV tables and JSON, in and out, whole or not at all.

A table is one row a line, comma separated, or semicolon separated with decimal commas, or tab
separated; ``#`` starts a comment line; UTF-8 with or without byte-order mark. Wherever a file
is taken, a mapping of columns or a data frame (anything with ``columns`` and ``[name]``) is
taken too. Cells stay text until a column is asked for, so that a column nobody uses can hold
anything and a bad cell is reported by file, row and column.
"""

import csv
import hashlib
import io
import json
import math
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.columns import Cells, read_plain
from multipos.errors import MultiposError

Column = Sequence[Any] | NDArray[Any]
SMALLEST = 1e-40  # of an uncertainty, and of the largest of some measured numbers
_LONGEST = 100  # characters of a number, in an array of cells
_CELLS = 1 << 14  # of a column in a piece of JSON
_LONG = 1 << 20  # bytes: a longer text stays bytes until its cells are asked for
LARGEST = 1e40  # of what is measured, in any unit: of less, squares of cubes are numbers still
Source = str | os.PathLike[str] | Mapping[str, Any] | Any  # a file, columns, or a data frame


@dataclass(frozen=True)
class Table:
    """Columns by name, with what is needed to say where a cell came from."""

    source: str
    columns: Mapping[str, Column]
    rows: int
    lines: Sequence[int] | None = None  # line of the file each row ends on
    sha256: str | None = None
    delimiter: str = ","
    first: int = 0  # rows of the source that came before these, where it is read piece by piece

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def select(self, rows: Sequence[int]) -> "Table":
        """Return the table with some of its rows; messages still name the lines of the file."""
        columns = {name: [column[row] for row in rows] for name, column in self.columns.items()}
        lines = None if self.lines is None else [self.lines[row] for row in rows]
        return replace(self, columns=columns, rows=len(rows), lines=lines)

    @property
    def decimal_comma(self) -> bool:
        """Whether numbers may be written 1,5: semicolons stand between the cells."""
        return self.delimiter == ";"

    def text(self, name: str) -> tuple[str, ...]:
        """Return a column as labels; whole numbers lose a trailing ``.0``."""
        return tuple(_label(cell) for cell in self.columns[name])

    def number(
        self, name: str, *, empty: bool = False, largest: float = math.inf
    ) -> NDArray[np.float64]:
        """Return a column as finite numbers (n,); with `empty`, empty cells become NaN.

        Raises
        ------
        MultiposError
            A cell is text, empty, not finite or beyond `largest`; the message names file, row and
            column.
        """
        cells = self.columns[name]
        values = self._numbers(cells)
        bad = ~np.isfinite(values)
        if empty and isinstance(cells, np.ndarray) and cells.dtype.kind == "f":
            bad &= ~np.isnan(values)
        if bad.any():
            for row in np.flatnonzero(bad).tolist():
                cell = _label(cells[row])
                if cell in ("", "nan") and empty:
                    continue
                raise MultiposError(f"{self.where(row, name)}: {_fault(cell, self.decimal_comma)}")
        far = np.abs(values) > largest
        if far.any():  # a float with a flipped bit, whose square may be no number
            row = int(np.argmax(far))
            raise MultiposError(
                f"{self.where(row, name)}: {values[row]:g} is no number that is measured (beyond "
                f"{largest:g}); correct it or leave the row out."
            )
        return values

    def is_text(self, name: str) -> bool:
        """Tell whether no cell of the column is a number."""
        return not np.isfinite(self._numbers(self.columns[name])).any()

    def where(self, row: int, name: str) -> str:
        """Return the place of a cell in words."""
        line = "" if self.lines is None else f" (line {self.lines[row]})"
        return f"{self.source}: row {self.first + row + 1}{line}, column '{name}'"

    def _numbers(self, cells: Column) -> NDArray[np.float64]:
        if isinstance(cells, Cells):
            return cells.numbers(self._parse, decimal_comma=self.decimal_comma)
        return self._parse(cells)

    def _parse(self, cells: Column) -> NDArray[np.float64]:
        if isinstance(cells, np.ndarray) and cells.dtype.kind in "fiub":
            return cells.astype(np.float64)
        try:
            if self.decimal_comma:
                cells = [cell.replace(",", ".") for cell in cells]
            if any("_" in cell for cell in cells):  # float() would take 1_000
                raise ValueError
            if max(map(len, cells), default=0) > _LONGEST:  # every cell would take as much
                raise ValueError
            return np.array(cells, dtype=np.str_).astype(np.float64)
        except (ValueError, TypeError, AttributeError):
            return np.array([_float(cell) for cell in cells], dtype=np.float64)


def read_table(source: Source, *, what: str = "table") -> Table:
    """Read a table from a CSV file, a mapping of columns, or a data frame.

    Parameters
    ----------
    source : path, mapping of name to (n,) array, or data frame
    what : str
        What the table is for, in messages.

    Returns
    -------
    Table

    Raises
    ------
    MultiposError
        Missing, empty, unreadable, ragged, or with duplicate or unnamed columns.
    """
    if isinstance(source, Table):
        return source
    if isinstance(source, str | os.PathLike):
        return _read_csv(Path(source), what)
    if isinstance(source, Mapping):
        names: Iterable[Any] = source.keys()
    elif hasattr(source, "columns") and hasattr(source, "__getitem__"):
        names = source.columns
    else:
        raise TypeError(
            f"{what} must be a path, a mapping of columns or a data frame, "
            f"got {type(source).__name__}."
        )
    columns: dict[str, Column] = {}
    for name in names:
        column = np.asarray(source[name])
        if column.ndim != 1:
            raise MultiposError(
                f"column '{name}' of the {what} must be one-dimensional, got shape {column.shape}."
            )
        columns[str(name)] = column
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise MultiposError(f"the columns of the {what} differ in length: {lengths}.")
    if not columns or not next(iter(lengths.values())):
        raise MultiposError(f"the {what} has no rows; give one row per position.")
    return Table(source=what, columns=columns, rows=next(iter(lengths.values())))


def _read_csv(path: Path, what: str) -> Table:
    raw = read_bytes(path, what)
    plain = read_plain(raw) if len(raw) > _LONG else None
    if plain is not None:
        _check_header(path, plain.header)
        return Table(
            source=str(path),
            columns=dict(zip(plain.header, plain.columns, strict=True)),
            rows=len(plain.lines),
            lines=plain.lines,
            sha256=hashlib.sha256(raw).hexdigest(),
            delimiter=plain.delimiter,
        )
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise MultiposError(
            f"{path}: byte {error.start} is not UTF-8; save the {what} as UTF-8 text."
        ) from None
    numbered = [
        (number, line)
        for number, line in enumerate(io.StringIO(text, newline=None), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not numbered:
        raise MultiposError(f"{path}: the file is empty; the {what} needs a header and rows.")
    delimiter = next((mark for mark in ";\t" if mark in numbered[0][1]), ",")
    reader = csv.reader((line for _, line in numbered), delimiter=delimiter, strict=True)
    try:
        header = [cell.strip() for cell in next(reader)]
        _check_header(path, header)
        cells: list[list[str]] = []
        lines: list[int] = []
        for row in reader:
            line = numbered[reader.line_num - 1][0]
            if len(row) != len(header):
                raise MultiposError(
                    f"{path}: row {len(cells) + 1} (line {line}) has {len(row)} cells where the "
                    f"header names {len(header)}; give one cell per column, "
                    f"last column '{header[-1]}'."
                )
            cells.append(row)
            lines.append(line)
    except csv.Error as error:
        raise MultiposError(
            f"{path}: line {numbered[min(reader.line_num, len(numbered)) - 1][0]}: {error}; "
            "check the quotes."
        ) from None
    if not cells:
        raise MultiposError(f"{path}: only a header, no rows; give one row per position.")
    columns = {
        name: [cell.strip() for cell in column]
        for name, column in zip(header, zip(*cells, strict=True), strict=True)
    }
    return Table(
        source=str(path),
        columns=columns,
        rows=len(cells),
        lines=lines,
        sha256=hashlib.sha256(raw).hexdigest(),
        delimiter=delimiter,
    )


def _check_header(path: Path, header: list[str]) -> None:
    seen = set()
    for index, name in enumerate(header):
        if not name:
            raise MultiposError(
                f"{path}: column {index + 1} has no name; name it or remove the separator."
            )
        if name in seen:
            raise MultiposError(f"{path}: column '{name}' appears twice; rename or remove one.")
        seen.add(name)
    if all(math.isfinite(_float(name)) for name in header):
        raise MultiposError(
            f"{path}: the first row holds only numbers; the first row must name the columns."
        )


def _float(cell: Any) -> float:
    text = _label(cell)
    try:
        return math.nan if "_" in text else float(text)
    except ValueError:
        return math.nan


def _label(cell: Any) -> str:
    if cell is None or str(cell) == "<NA>":  # pandas.NA
        return ""
    if isinstance(cell, float | np.floating) and float(cell).is_integer():
        return str(int(cell))
    return str(cell).strip()


def _fault(cell: str, decimal_comma: bool) -> str:
    if cell == "":
        return "the cell is empty; a number is needed there."
    try:
        number = float(cell.replace(",", ".") if decimal_comma else cell)
    except ValueError:
        comma = (
            " (decimal commas need semicolons between the cells)"
            if "," in cell and not decimal_comma
            else ""
        )
        return f"'{cell}' is not a number{comma}; a number is needed there."
    if math.isfinite(number):
        return f"'{cell}' is not a number; write it without underscores."
    return f"'{cell}' is not finite; a finite number is needed there."


def read_bytes(path: str | os.PathLike[str], what: str) -> bytes:
    """Return the content of a file, or say in one line why it cannot be read."""
    try:
        return Path(path).read_bytes()
    except FileNotFoundError:
        raise MultiposError(f"{path}: no such file; check the path of the {what}.") from None
    except OSError as error:
        raise MultiposError(
            f"{path}: cannot read the {what}: {error.strerror or error}; "
            "check the path and its permissions."
        ) from None


def write_text(path: str | os.PathLike[str], text: str | Iterable[str]) -> None:
    """Write a file whole or not at all: into a temporary neighbour that then takes its name.

    The text may come in pieces; where making one fails, nothing is written.

    Raises
    ------
    MultiposError
        The file cannot be written; an existing one is left as it was.
    """
    target = Path(path)
    try:
        if target.exists() and not os.access(target, os.W_OK):
            raise PermissionError(None, "it is read-only")
        if target.exists() and not target.is_file():  # a device or a pipe has no neighbour
            if target.is_dir():
                raise IsADirectoryError(None, "it is a folder")
            with target.open("w", encoding="utf-8") as stream:
                stream.writelines([text] if isinstance(text, str) else text)
            return
        target = target.resolve()  # a link stays, what it points to is written
        mode = target.stat().st_mode & 0o777 if target.exists() else 0o666 & ~_umask()
        handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.")
        try:
            with os.fdopen(handle, "w", encoding="utf-8", newline="") as stream:
                stream.writelines([text] if isinstance(text, str) else text)
            Path(temporary).chmod(mode)
            Path(temporary).replace(target)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise MultiposError(
            f"{path}: cannot write: {error.strerror or error}; check the folder and permissions."
        ) from None


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def format_csv(columns: Mapping[str, Column], delimiter: str = ",") -> str:
    """Return columns as CSV text; numbers keep all their digits, NaN is an empty cell.

    With semicolons between the cells, numbers get decimal commas.
    """
    stream = io.StringIO()
    writer = csv.writer(stream, delimiter=delimiter, lineterminator="\n")
    writer.writerow(columns)
    lists = []
    for column in columns.values():
        cells = column.tolist() if isinstance(column, np.ndarray) else list(column)
        if any(isinstance(cell, float) for cell in cells):
            cells = ["" if cell != cell else repr(cell) for cell in cells]
            if delimiter == ";":
                cells = [cell.replace(".", ",") for cell in cells]
        lists.append(cells)
    writer.writerows(zip(*lists, strict=True))
    return stream.getvalue()


def to_json(value: Any) -> str:
    """Return one JSON object as text; what is not finite becomes null."""
    return json.dumps(plain(value), ensure_ascii=False, indent=1, allow_nan=False) + "\n"


def json_table(columns: Mapping[str, Column], rows: int) -> Iterator[str]:
    """Yield one JSON object of columns in pieces, {"rows": …, "columns": {name: [..]}}.

    Together they are what `to_json` would return, without all of it in memory.
    """
    yield f'{{\n "rows": {rows},\n "columns": {{'
    between = "\n  "
    for name, column in columns.items():
        yield f"{between}{json.dumps(str(name), ensure_ascii=False)}: ["
        between = ",\n  "
        cells = iter(column)
        for start in range(0, rows, _CELLS):
            whole = isinstance(column, np.ndarray)
            part = column[start : start + _CELLS] if whole else list(islice(cells, _CELLS))
            text = json.dumps(
                plain(part), ensure_ascii=False, allow_nan=False, separators=(",\n   ", ": ")
            )
            yield f"{',' if start else ''}\n   {text[1:-1]}"
        yield "\n  ]"
    yield "\n }\n}\n"


def plain(value: Any) -> Any:
    """Return nested mappings, sequences and arrays as what JSON can carry."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def read_schema(path: str | os.PathLike[str]) -> str | None:
    """Return the schema that a JSON file names; None where it is not such a file, or not there."""
    try:
        value = json.loads(Path(path).read_bytes())
    except (OSError, ValueError):
        return None
    found = value.get("schema") if isinstance(value, dict) else None
    return found if isinstance(found, str) else None


_READERS = {
    "multipos/calibration/1": "; a calibration is read by multipos.load",
    "multipos/regression/1": "; a regression is read by multipos.load_regression and used by "
    "multipos apply and check",
    "multipos/check/1": "; a check is read by multipos.load_check and used by multipos report "
    "--check",
}  # what to do with a file of another schema than the one needed


def read_json(path: str | os.PathLike[str], schema: str) -> dict[str, Any]:
    """Read a JSON object and check that its ``schema`` is the one expected.

    Raises
    ------
    MultiposError
        Missing, truncated, not JSON, or of another kind.
    """
    raw = read_bytes(path, "calibration" if "calibration" in schema else "result")
    try:
        value = json.loads(raw.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise MultiposError(f"{path}: not UTF-8 text; give a file of schema '{schema}'.") from None
    except RecursionError:
        raise MultiposError(f"{path}: nested too deeply for a file of schema '{schema}'.") from None
    except json.JSONDecodeError as error:
        raise MultiposError(
            f"{path}: line {error.lineno}, column {error.colno}: not valid JSON ({error.msg}); "
            "the file is truncated or of another kind, write it again."
        ) from None
    found = value.get("schema") if isinstance(value, dict) else None
    if found != schema:
        other = _READERS.get(str(found), "")
        raise MultiposError(
            f"{path}: the schema is {found!r}, but '{schema}' is needed here{other}."
        )
    assert isinstance(value, dict)
    return value


def read_toml(path: str | os.PathLike[str], what: str) -> dict[str, Any]:
    """Read a TOML file.

    Raises
    ------
    MultiposError
        Missing, not UTF-8, or not TOML; the message names file, line and column.
    """
    import tomllib

    try:
        return tomllib.loads(read_bytes(path, what).decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise MultiposError(f"{path}: not UTF-8 text; save the {what} as UTF-8.") from None
    except tomllib.TOMLDecodeError as error:
        raise MultiposError(f"{path}: not valid TOML: {error}; correct the {what}.") from None
