"""JSON and TOML, in and out.

`to_json`, `to_json_line` and `json_table` write, `read_json`, `read_json_value` and `read_toml`
read; `read_schema` tells which file it is.
"""

import json
import re
from collections.abc import Iterator, Mapping
from itertools import islice
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.files.csv_columns import Column
from multipos.files.pipes import text_of
from multipos.files.spelling import StrPath, packaged_pairs
from multipos.files.whole import read_bytes
from multipos.results import plain

_CELLS = 1 << 14  # of a column in a piece of JSON
_SURROGATE = re.compile("[\ud800-\udfff]")  # what UTF-8 does not have, a byte of a file name
_DIGITS = 18  # that a whole number of 64 bits surely holds


def to_json(value: Any) -> str:
    """Return one JSON object as text; what is not finite becomes null.

    Of a file name that is no text, each byte that is none is written as an escape.
    """
    write = json.JSONEncoder(ensure_ascii=False, indent=1, allow_nan=False, default=plain).encode
    try:
        text = write(value)
    except ValueError:  # not finite
        text = write(plain(value))
    return f"{_escaped(text)}\n"


def to_json_line(value: Any) -> str:
    """Return one JSON object as a line of text; what is not finite becomes null."""
    return _escaped(json.dumps(plain(value), ensure_ascii=False, allow_nan=False)) + "\n"


def _escaped(text: str) -> str:
    return _SURROGATE.sub(lambda found: f"\\\\u{ord(found[0]):04x}", text)


def json_table(
    columns: Mapping[str, Column], rows: int, said: Mapping[str, Any] | None = None
) -> Iterator[str]:
    """Yield one JSON object of columns in pieces, {"rows": …, "columns": {name: [..]}}.

    Together they are what `to_json` would return, without all of it in memory. What is `said` of
    the table stands between.
    """
    head = to_json({"rows": rows, **(said or {})}).removesuffix("}\n").rstrip()
    yield f'{head},\n "columns": {{'
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


def read_schema(path: StrPath) -> str | None:
    """Return the schema that a JSON file names; None where it is not such a file, or not there."""
    try:
        value = read_json_value(path, "file")
    except MultiposError:
        return None
    found = value.get("schema") if isinstance(value, dict) else None
    return found if isinstance(found, str) else None


def read_json(path: StrPath, schema: str) -> dict[str, Any]:
    """Read a JSON object and check that its ``schema`` is the one expected.

    Raises
    ------
    MultiposError
        Missing, truncated, not JSON, or of another kind.
    """
    value = read_json_value(path, "calibration" if "calibration" in schema else "result")
    found = value.get("schema") if isinstance(value, dict) else None
    if found != schema:
        # what to do with a file of another schema than the one needed
        other = packaged_pairs(__file__, "schemas.csv").get(str(found), "")
        raise MultiposError(
            f"{path}: the schema is {found!r}, but '{schema}' is needed here{other}."
        )
    assert isinstance(value, dict)
    return value


def read_json_value(path: StrPath, what: str) -> Any:
    """Read any JSON; whole numbers of more digits than 64 bits hold become floats.

    Raises
    ------
    MultiposError
        Missing, truncated, or not JSON.
    """
    try:
        return json.loads(text_of(read_bytes(path, what)), parse_int=_whole)
    except UnicodeDecodeError:
        raise MultiposError(f"{path}: not UTF-8 text; give the {what} as JSON.") from None
    except RecursionError:
        raise MultiposError(f"{path}: nested too deeply; write the {what} again.") from None
    except json.JSONDecodeError as error:
        raise MultiposError(
            f"{path}: line {error.lineno}, column {error.colno}: not valid JSON ({error.msg}); "
            f"the file is truncated or of another kind; give the {what} as JSON, or write it again."
        ) from None


def _whole(digits: str) -> int | float:
    return int(digits) if len(digits) <= _DIGITS else float(digits)


def read_toml(path: StrPath, what: str) -> dict[str, Any]:
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
        found = tomllib.loads(text_of(raw))
    except UnicodeDecodeError:
        raise MultiposError(f"{path}: not UTF-8 text; save the {what} as UTF-8.") from None
    except RecursionError:
        raise MultiposError(f"{path}: nested too deeply; write the {what} again.") from None
    except tomllib.TOMLDecodeError as error:
        raise MultiposError(f"{path}: not valid TOML: {error}; correct the {what}.") from None
    except ValueError:  # Python's own limit, of 4300 digits
        raise _too_large(path, "a whole number") from None
    _refuse_large(path, found)
    return found


def _refuse_large(path: StrPath, found: Mapping[str, Any]) -> None:
    inner: list[tuple[str, Any]] = list(found.items())
    while inner:
        name, value = inner.pop()
        if isinstance(value, dict):
            inner += value.items()
        elif isinstance(value, list):
            inner += [(name, each) for each in value]
        elif isinstance(value, int) and not -(2**63) <= value < 2**63:
            raise _too_large(path, f"'{name}'")


def _too_large(path: StrPath, which: str) -> MultiposError:
    return MultiposError(
        f"{path}: {which} has more digits than 64 bits hold; write a large number as 1e30."
    )
