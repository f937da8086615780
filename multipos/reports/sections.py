"""What a report is made of: sections of paragraphs, figures and tables.

Numbers are text here, with the digits that their uncertainty leaves. Figures are functions and
drawn only where they are wanted.

Words of the reports in other languages than English.

English is the key: a language is a TOML file in `templates`, with the table ``words`` of whole
sentences, where ``{name}`` stands for what is put in, and ``messages``, patterns for what the
fits say, where ``{name}`` matches whatever stands there. What a language lacks stays English.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from multipos.errors import UsageError
from multipos.files.numbers import largest_rows
from multipos.results import frozen
from multipos.sensor.gravity import GRAVITY, Field, worded, worded_chinese

Language = Literal["en", "zh"]
LANGUAGES: tuple[Language, ...] = get_args(Language)


class Translator:
    """Return a sentence in a language: ``tr("Offset of {output}", output="ax")``."""

    def __init__(self, language: Language, field: Field = GRAVITY) -> None:
        if language not in LANGUAGES:
            raise UsageError(f"--language takes {' or '.join(LANGUAGES)}, got '{language}'.")
        self.language = language
        content = {} if language == "en" else _read(language)
        self.words: dict[str, str] = content.get("words", {})
        self.messages: dict[str, str] = content.get("messages", {})
        self.field = field
        if field.magnetic:
            self.words, self.messages = map(self._in_field, (self.words, self.messages))

    def _in_field(self, table: dict[str, str]) -> dict[str, str]:
        return {worded(key, self.field): worded_chinese(said) for key, said in table.items()}

    def __call__(self, text: str, **put_in: str) -> str:
        """Return a sentence with what is put in."""
        text = worded(text, self.field)
        return self.words.get(text, text).format(**put_in) if put_in else self.words.get(text, text)

    def message(self, text: str) -> str:
        """Return what a fit said: a sentence with numbers and names in it."""
        text = worded(text, self.field)
        for pattern, translated in self.messages.items():
            match = _regular(pattern).fullmatch(text)
            if match:
                inside = {name: self.message(part) for name, part in match.groupdict().items()}
                return translated.format(**inside)
        return self(text)

    def listed(self, parts: Sequence[str]) -> str:
        """Return a list in words."""
        return ("、" if self.language == "zh" else ", ").join(parts)

    def label(self, text: str) -> str:
        """Return a label of a figure; a unit in brackets stays."""
        words, bracket, unit = text.partition(" [")
        return self.message(words) + bracket + unit


@lru_cache(None)
def _regular(pattern: str) -> "re.Pattern[str]":
    parts = re.split(r"\{(\w+)\}", pattern)
    texts = (re.escape(part) if i % 2 == 0 else f"(?P<{part}>.+?)" for i, part in enumerate(parts))
    return re.compile("".join(texts))


@lru_cache
def _read(language: str) -> dict[str, Any]:
    import tomllib

    return tomllib.loads(template(f"{language}.toml"))


def template(name: str) -> str:
    """Return a file of the folder of templates."""
    return (Path(__file__).parent / "templates" / name).read_text(encoding="utf-8")


_WIDTH = 4.5  # inches of a figure, whose type can be read on a telephone
LONG_TABLE = 24  # rows of a table in the body of a report; a longer one stands in its annex
_WHOLE = 400  # rows of a table in the annex


@frozen(eq=True)
class PageTable:
    """A table: its caption, header and rows of text; the first `left` columns hold words.

    Of a long one the body of the report shows the rows `kept`, else the first, and the last `foot`.
    What follows from what stands elsewhere is not `on_paper`.
    """

    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    left: int = 1
    on_paper: bool = True
    kept: tuple[int, ...] = ()
    foot: int = 0


@frozen(eq=True)
class Figure:
    """A figure: caption, what it shows in words, and the function that draws it as SVG."""

    caption: str
    description: str
    draw: Callable[[], str]


@frozen(eq=True)
class Section:
    """A section of the report, in the order paragraphs, figures, tables."""

    title: str
    paragraphs: tuple[str, ...] = ()
    figures: tuple[Figure, ...] = ()
    tables: tuple[PageTable, ...] = ()


def method_section(rows: Iterable[tuple[str, str]], tr: Translator) -> Section:
    """Return the section on how something was done."""
    header = (tr("Item"), tr("Value"))
    table = PageTable(tr("How it was done"), header, tuple(rows), left=2)
    return Section(tr("Method and data"), tables=(table,))


def draw_svg(tr: Translator, height: float, *panels: Callable[[Any], object]) -> str:
    """Return a figure of panels of a height, each drawn on its own axes, as SVG translated."""
    # Imported here: a sentence on the screen needs no figure.
    from multipos.plots.style import figure_of, to_svg

    return to_svg(figure_of(panels, width=_WIDTH, height=height), tr.label)


def chosen_rows(
    tr: Translator, sizes: NDArray[np.float64]
) -> tuple[list[int], tuple[int, ...], str]:
    """Return the rows that a table takes, those that its body keeps, and what its caption adds."""
    largest = tuple(largest_rows(sizes.tolist(), LONG_TABLE, LONG_TABLE))
    if len(sizes) <= _WHOLE:
        return list(range(len(sizes))), largest if len(sizes) > LONG_TABLE else (), ""
    more = " (the {shown} largest of {count}; the calibration file has all)"
    return list(largest), (), tr(more, shown=str(LONG_TABLE), count=str(len(sizes)))


def with_annex(sections: Iterable[Section], tr: Translator) -> tuple[Section, ...]:
    """Return the sections with the largest rows of long tables, which an annex has in full."""
    whole: list[PageTable] = []

    def short(grid: PageTable) -> PageTable:
        count = len(grid.rows) - grid.foot
        if count <= LONG_TABLE:
            return grid
        whole.append(grid)
        kept = [*(grid.kept or range(LONG_TABLE)), *range(count, len(grid.rows))]
        more = " (the {shown} largest of {count}; all in the annex)"
        if not grid.kept:
            more = " (the first {shown} of {count}; all in the annex)"
        caption = grid.caption + tr(more, shown=str(LONG_TABLE), count=str(count))
        return replace(grid, caption=caption, rows=tuple(grid.rows[row] for row in kept))

    body = tuple(replace(part, tables=tuple(map(short, part.tables))) for part in sections)
    return (*body, Section(tr("Annex"), tables=tuple(whole))) if whole else body
