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
import re
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError
from multipos.files.characters import control_characters, visible
from multipos.files.columns import Cells, read_plain
from multipos.results import plain

Column = Sequence[Any] | NDArray[Any]
_LONGEST = 100  # characters of a number, in an array of cells
_CELLS = 1 << 14  # of a column in a piece of JSON
_LONG = 1 << 20  # bytes: a longer text stays bytes until its cells are asked for
Source = str | os.PathLike[str] | Mapping[str, Any] | Any  # a file, columns, or a data frame

_SURROGATE = re.compile("[\ud800-\udfff]")  # what UTF-8 does not have, a byte of a file name
_DIGITS = 18  # that a whole number of 64 bits surely holds


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
        return _read_csv(source, what)
    own = getattr(source, "columns", None)
    if callable(own):  # a result that is written as a table
        return read_table(own(), what=what)
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


def _read_csv(path: str | os.PathLike[str], what: str) -> Table:
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
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise MultiposError(
            f"{path}: line {line} holds a NUL byte; the file is damaged or no text, save the "
            f"{what} as UTF-8 text."
        )
    numbered = [
        (number, line)
        for number, line in enumerate(io.StringIO(text, newline=None), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not numbered:
        raise MultiposError(f"{path}: the file is empty; the {what} needs a header and rows.")
    delimiter = next((mark for mark in ";\t" if mark in numbered[0][1]), ",")
    records = _records(path, numbered, delimiter)
    header = [cell.strip() for cell in next(records).cells]
    _check_header(path, header)
    cells: list[list[str]] = []
    lines: list[int] = []
    for record in records:
        if len(record.cells) != len(header):
            raise MultiposError(
                f"{path}: row {len(cells) + 1} ({record.where}) has {len(record.cells)} cells "
                f"where the header names {len(header)}; give one cell per column, "
                f"last column '{header[-1]}'."
            )
        cells.append(record.cells)
        lines.append(record.end)
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


class _Record(NamedTuple):
    """The cells of one row, and the lines of the file from which to which it goes."""

    cells: list[str]
    begin: int
    end: int

    @property
    def where(self) -> str:
        return f"line{'' if self.begin == self.end else f's {self.begin} to'} {self.end}"


def _records(
    path: str | os.PathLike[str], numbered: Sequence[tuple[int, str]], delimiter: str
) -> Iterator[_Record]:
    """Yield the rows of numbered lines; a quoted cell may go on over several of them."""
    reader = csv.reader((line for _, line in numbered), delimiter=delimiter, strict=True)
    begin = 0
    try:
        for cells in reader:
            yield _Record(cells, numbered[begin][0], numbered[reader.line_num - 1][0])
            begin = reader.line_num
    except csv.Error as error:  # a quote that nobody closes has swallowed what follows it
        reason = "a quote is not closed" if "end of data" in str(error) else str(error)
        raise MultiposError(
            f"{path}: line {numbered[begin][0]}: {reason}; check the quotes of the row that "
            "begins there."
        ) from None


def _check_header(path: str | os.PathLike[str], header: list[str]) -> None:
    seen = set()
    for index, name in enumerate(header):
        if not name:
            raise MultiposError(
                f"{path}: column {index + 1} has no name; name it or remove the separator."
            )
        if name in seen:
            raise MultiposError(f"{path}: column '{name}' appears twice; rename or remove one.")
        seen.add(name)
        if control_characters(name):
            raise MultiposError(
                f"{path}: the name of column {index + 1}, '{visible(name)}', has a control "
                "character; rename it."
            )
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


Content = str | bytes | Iterable[str]  # of a file: text in UTF-8, as a whole or in pieces


class _Draft(NamedTuple):
    """A file on its way: made beside its target, or anywhere where that is no regular file."""

    path: str | os.PathLike[str]  # as it was given
    target: Path
    temporary: Path
    regular: bool

    @property
    def before(self) -> Path:
        """What the target was, where several files must appear together."""
        return self.temporary.with_suffix(".before")


def write_text(path: str | os.PathLike[str], text: Content) -> None:
    """Write one file whole or not at all, as `written` does."""
    with written({path: text}):
        pass


@contextmanager
def written(files: Mapping[str | os.PathLike[str], Content]) -> Iterator[None]:
    """Have files ready when the block begins, and in their places when it has ended well.

    Each is made as a temporary neighbour that then takes its name, or not at all; several appear
    together or not at all. Where making a piece fails, or the block, nothing has been touched; but
    a device or a pipe, which nothing can take the place of, is written before the block. A
    character that UTF-8 does not have (of a file name that is no text) is written as an escape.

    Raises
    ------
    MultiposError
        A file cannot be written; existing ones are left as they were.
    """
    drafts: list[_Draft] = []
    try:
        for path, content in files.items():
            with _writing(path):
                drafts.append(_draft(path))
            _fill(drafts[-1], content)
        for draft in drafts:
            if not draft.regular:
                with _writing(draft.path):
                    _copy(draft.temporary, draft.target)
        yield
        _put_in_place([draft for draft in drafts if draft.regular])
    finally:
        for draft in drafts:
            draft.temporary.unlink(missing_ok=True)
            draft.before.unlink(missing_ok=True)


@contextmanager
def _writing(path: str | os.PathLike[str]) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise MultiposError(
            f"{path}: cannot write: {error.strerror or error}; check the folder and permissions."
        ) from None


def _draft(path: str | os.PathLike[str]) -> _Draft:
    """Return where a file goes: a link stays, what it points to is written."""
    regular, folder = True, os.fspath(path).endswith("/")
    with suppress(FileNotFoundError):
        mode = Path(path).stat().st_mode
        regular, folder = stat.S_ISREG(mode), folder or stat.S_ISDIR(mode)
        if not os.access(path, os.W_OK):
            raise PermissionError(None, "it is read-only")
    if folder:
        raise IsADirectoryError(None, "it is a folder")
    target = Path(os.path.realpath(path) if regular else path)
    # The name is short, because that of the target may be as long as a name can be, and chosen
    # before the file is there, so that a signal in between leaves nothing behind.
    beside = target.parent if regular else Path(tempfile.gettempdir())
    return _Draft(path, target, beside / f".multipos-{secrets.token_hex(8)}", regular)


def _fill(draft: _Draft, content: Content) -> None:
    pieces = [content] if isinstance(content, str | bytes) else content
    with _writing(draft.path):
        stream = draft.temporary.open("xb")
    with stream:
        for piece in pieces:
            raw = piece if isinstance(piece, bytes) else piece.encode("utf-8", "backslashreplace")
            with _writing(draft.path):
                stream.write(raw)
        with _writing(draft.path):
            stream.flush()
            if draft.regular and draft.target.exists():
                draft.temporary.chmod(stat.S_IMODE(draft.target.stat().st_mode))


def _put_in_place(drafts: Sequence[_Draft]) -> None:
    with ExitStack() as undo:
        for draft in drafts:
            with _writing(draft.path):
                if len(drafts) > 1:
                    if draft.target.exists():
                        shutil.copy2(draft.target, draft.before)
                    undo.callback(_restore, draft)
                draft.temporary.replace(draft.target)
        undo.pop_all()


def _copy(source: Path, device: Path) -> None:
    with source.open("rb") as stream, device.open("wb") as target:
        shutil.copyfileobj(stream, target)


def _restore(draft: _Draft) -> None:
    if draft.before.exists():
        draft.before.replace(draft.target)
    elif not draft.temporary.exists():  # it had taken the place of nothing
        draft.target.unlink(missing_ok=True)


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


def write_table(path: str | os.PathLike[str], columns: Source) -> None:
    """Write columns as a CSV file, whole or not at all; numbers keep all their digits.

    Parameters
    ----------
    path : path
    columns : mapping of name to (n,) array, or data frame
        NaN becomes an empty cell.

    Raises
    ------
    MultiposError
        The columns are empty or differ in length, or the file cannot be written.
    """
    write_text(path, format_csv(read_table(columns).columns))


def to_json(value: Any) -> str:
    """Return one JSON object as text; what is not finite becomes null.

    Of a file name that is no text, each byte that is none is written as an escape.
    """
    text = json.dumps(plain(value), ensure_ascii=False, indent=1, allow_nan=False) + "\n"
    return _escaped(text)


def _escaped(text: str) -> str:
    return _SURROGATE.sub(lambda found: f"\\\\u{ord(found[0]):04x}", text)


def json_table(columns: Mapping[str, Column], rows: int) -> Iterator[str]:
    """Yield one JSON object of columns in pieces, {"rows": …, "columns": {name: [..]}}.

    Together they are what `to_json` would return, without all of it in memory.
    """
    yield f'{{\n "rows": {rows},\n "columns": {{'
    between = "\n  "
    for name, column in columns.items():
        yield f"{between}{_escaped(json.dumps(str(name), ensure_ascii=False))}: ["
        between = ",\n  "
        cells = iter(column)
        for start in range(0, rows, _CELLS):
            whole = isinstance(column, np.ndarray)
            part = column[start : start + _CELLS] if whole else list(islice(cells, _CELLS))
            text = json.dumps(
                plain(part), ensure_ascii=False, allow_nan=False, separators=(",\n   ", ": ")
            )
            yield f"{',' if start else ''}\n   {_escaped(text[1:-1])}"
        yield "\n  ]"
    yield "\n }\n}\n"


def read_schema(path: str | os.PathLike[str]) -> str | None:
    """Return the schema that a JSON file names; None where it is not such a file, or not there."""
    try:
        value = read_json_value(path, "file")
    except MultiposError:
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
    value = read_json_value(path, "calibration" if "calibration" in schema else "result")
    found = value.get("schema") if isinstance(value, dict) else None
    if found != schema:
        other = _READERS.get(str(found), "")
        raise MultiposError(
            f"{path}: the schema is {found!r}, but '{schema}' is needed here{other}."
        )
    assert isinstance(value, dict)
    return value


def read_json_value(path: str | os.PathLike[str], what: str) -> Any:
    """Read any JSON; whole numbers of more digits than 64 bits hold become floats.

    Raises
    ------
    MultiposError
        Missing, truncated, or not JSON.
    """
    try:
        return json.loads(read_bytes(path, what).decode("utf-8-sig"), parse_int=_whole)
    except UnicodeDecodeError:
        raise MultiposError(f"{path}: not UTF-8 text; give the {what} as JSON.") from None
    except RecursionError:
        raise MultiposError(f"{path}: nested too deeply; write the {what} again.") from None
    except json.JSONDecodeError as error:
        raise MultiposError(
            f"{path}: line {error.lineno}, column {error.colno}: not valid JSON ({error.msg}); "
            "the file is truncated or of another kind, write it again."
        ) from None


def _whole(digits: str) -> int | float:
    return int(digits) if len(digits) <= _DIGITS else float(digits)


def read_toml(path: str | os.PathLike[str], what: str) -> dict[str, Any]:
    """Read a TOML file.

    Raises
    ------
    MultiposError
        Missing, not UTF-8, not TOML, or with a whole number that 64 bits do not hold; the message
        names file, line and column where there is one.
    """
    import tomllib

    raw = read_bytes(path, what)
    try:
        found = tomllib.loads(raw.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise MultiposError(f"{path}: not UTF-8 text; save the {what} as UTF-8.") from None
    except RecursionError:
        raise MultiposError(f"{path}: nested too deeply; write the {what} again.") from None
    except tomllib.TOMLDecodeError as error:
        raise MultiposError(f"{path}: not valid TOML: {error}; correct the {what}.") from None
    except ValueError:  # Python's own limit, of 4300 digits
        raise _too_large(path, "a whole number") from None
    inner: list[tuple[str, Any]] = list(found.items())
    while inner:
        name, value = inner.pop()
        if isinstance(value, dict):
            inner += value.items()
        elif isinstance(value, list):
            inner += [(name, each) for each in value]
        elif isinstance(value, int) and not -(2**63) <= value < 2**63:
            raise _too_large(path, f"'{name}'")
    return found


def _too_large(path: str | os.PathLike[str], which: str) -> MultiposError:
    return MultiposError(
        f"{path}: {which} has more digits than 64 bits hold; write a large number as 1e30."
    )
