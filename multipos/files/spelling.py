r"""Names and numbers as people list them: 'ax, ay, az', or a sequence; and as they are printed.

`split_names`, `split_numbers`, `tuple_of`, `spread` and `numbered` take lists, `near`, `quoted`,
`require_columns` and `listed` name things in messages. `control_characters` finds those that act
instead of being read, `visible`, `visible_lines`, `one_line` and `escaped` show them; `as_cell` and
`of_cell` keep a spreadsheet from running a cell that `is_risky`; `packaged_pairs` reads words that
the package has in a table.

Labels, names and file names come from elsewhere. A control character in one would move the cursor
of a terminal, begin a line of its own in a parameter file or end a comment; here it becomes the
escape that JSON has for it, ``\u001b``, so that in JSON it stays the same character.
"""

import csv
import os
import re
import unicodedata
from collections.abc import Collection, Iterable, Sequence
from collections.abc import Set as AbstractSet
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

from multipos.errors import MultiposError, UsageError

Names = str | Sequence[str]
StrPath = str | os.PathLike[str]
T = TypeVar("T")


def tuple_of(given: Iterable[T], what: str) -> tuple[T, ...]:
    """Return what is handed over in order, and refuse a set, which has none.

    Raises
    ------
    UsageError
        It has no order, or is no sequence at all.
    """
    if isinstance(given, AbstractSet) or not isinstance(given, Iterable):
        raise UsageError(f"{what} takes a list, which has an order, got {type(given).__name__}.")
    return tuple(given)


def split_names(given: Names, option: str = "") -> tuple[str, ...]:
    """Return names given as a sequence, or as text with commas between them; blanks do not count.

    Raises
    ------
    UsageError
        A name is empty, or there is none; the message begins with the option.
    TypeError
        Something is no name.
    """
    parts = given.split(",") if isinstance(given, str) else tuple_of(given, option or "names")
    where = f"{option}: " if option else ""
    for part in parts:
        if not isinstance(part, str):
            raise TypeError(f"{where}a name must be text, got {part!r}.")
    names = tuple(part.strip() for part in parts)
    if not names or not all(names):
        raise UsageError(f"{where}'{','.join(parts)}' names nothing next to a comma.")
    return names


def split_numbers(text: str) -> tuple[float, ...]:
    """Return numbers that commas separate.

    Raises
    ------
    UsageError
        One of them is no number.
    """
    try:
        return tuple(float(number) for number in text.split(","))
    except ValueError:
        raise UsageError(f"'{text}' is not a number or numbers.") from None


def spread(given: Sequence["T | Sequence[T]"]) -> tuple[T, ...]:
    """Return what a function was given one by one, or as one list or tuple."""
    if len(given) == 1 and isinstance(given[0], list | tuple):
        return tuple(given[0])
    return tuple(given)  # type: ignore[arg-type]


@lru_cache(maxsize=1)
def numbered(count: int, start: int = 1) -> tuple[str, ...]:
    """Return 1, 2, … as labels of what has none; the last ones are kept."""
    return tuple(map(str, range(start, start + count)))


def near(name: str, known: Collection[str]) -> str:
    """Return the end of a sentence: "; did you mean 'scale_ax'?", or "." where none is like it."""
    from difflib import get_close_matches  # as slow to import as all of argparse

    folded = {other.casefold(): other for other in known}
    close = get_close_matches(name.casefold(), folded, n=1)
    return f"; did you mean '{folded[close[0]]}'?" if close else "."


def require_columns(names: Sequence[str], columns: Collection[str], where: str) -> None:
    """Refuse names of which a table, named by `where`, has no column."""
    missing = [name for name in names if name not in columns]
    if missing:
        way = near(missing[0], columns).removesuffix(".")
        raise MultiposError(
            f"{where}: no column {quoted(missing)}{way}; the columns are {quoted(columns)}."
        )


def quoted(names: Iterable[object]) -> str:
    """Return the first dozen names in quotes, separated by commas."""
    return listed([f"'{name}'" for name in names], 12)


def listed(texts: Sequence[str], most: int = 4) -> str:
    """Return the first texts, separated by commas, and how many more there are."""
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return ", ".join(texts[:most]) + more


# Marks that turn the direction of the text after them, so that it reads as what it is not.
_TURNS = "\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"


def control_characters(text: str) -> bool:
    """Tell whether a text moves more than the cursor: controls, line ends, turns, half a pair."""
    if text.isprintable():
        return False
    return any(_is_control(mark) for mark in text)


def visible(text: str) -> str:
    """Return text on one line, its control characters as escapes."""
    if text.isprintable():
        return text
    return "".join(escaped(mark) if _is_control(mark) else mark for mark in text)


def visible_lines(text: str) -> str:
    """Return text that keeps its line feeds and tabs, other control characters as escapes."""
    return _CONTROLS.sub(lambda mark: escaped(mark[0]), text)


# Behind a sign, by which a spreadsheet takes a cell for a formula: a number, a signed axis.
_SIGNED = re.compile(r"[+-](?:[\d.,]+(?:[eE][+-]?\d+)?|inf|nan|[xyzXYZ](?: \w+)?)")
_NUMBER = r"[\d.]+(?:[eE][+-]?\d+)?[\"']?\s*(?:[,;]|$)"
_RISKY = re.compile(rf"(?:^|[,;])\s*[\"']?(?:[=@]|[+-](?!{_NUMBER}))", re.MULTILINE)
_OF_NUMBERS = b"0123456789.,;+-eE \t\n"  # of which a formula can be no more than a sum
_CONTROLS = re.compile(f"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029{_TURNS}\ud800-\udfff]")


def is_risky(lines: str) -> bool:
    """Tell whether cells may hold what moves a terminal or what a spreadsheet runs."""
    if not lines.encode("utf-8", "surrogatepass").translate(None, _OF_NUMBERS):  # as most are
        return False
    return _CONTROLS.search(lines) is not None or _RISKY.search(lines) is not None


def as_cell(text: str) -> str:
    """Return text as a cell of CSV: controls as escapes, an apostrophe before a formula."""
    shown = visible(text)
    runs = shown[:1] in ("=", "@") or (shown[:1] in ("+", "-") and not _SIGNED.fullmatch(shown))
    return f"'{shown}" if runs else shown


def of_cell(text: str) -> str:
    """Return what `as_cell` made a cell of, but for escapes."""
    return text[1:] if text[:1] == "'" and as_cell(text[1:]) == text else text


def one_line(text: str) -> str:
    """Return text as one line, white space of any length and kind as one blank."""
    return visible(" ".join(text.split()))


def escaped(text: str) -> str:
    r"""Return each character as ``\uXXXX``, as JSON does, in two where one does not suffice."""
    raw = text.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{raw[i : i + 2].hex()}" for i in range(0, len(raw), 2))


def _is_control(mark: str) -> bool:
    return unicodedata.category(mark) in ("Cc", "Cs", "Zl", "Zp") or mark in _TURNS


def packaged_pairs(module: str, name: str) -> dict[str, str]:
    """Return the two columns of a table that stands beside a module's file."""
    with Path(module).with_name(name).open(encoding="utf-8", newline="") as stream:
        return dict(csv.reader(stream))
