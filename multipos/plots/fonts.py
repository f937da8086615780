"""Which font draws the text of a figure in pixels or on paper.

`font_of` returns the font of a text, and `is_wide` tells which characters need one of their own.

DejaVu Sans comes with Matplotlib, so that a figure is measured alike everywhere, and has no
Chinese. A text with characters that are as wide as high takes the first font of the system that
has them all. Matplotlib's own list of fonts is kept from an earlier day and may lack it, so that
the files are looked up.
"""

import unicodedata
from functools import cache
from pathlib import Path
from typing import Any

from multipos.errors import MultiposError

FONT = "DejaVu Sans"
# How the names of the files begin that hold sans-serif fonts of Chinese, the free ones first.
_CHINESE = (
    *("notosanscjk-regular", "notosanscjksc-regular", "notosanssc-regular", "notosanssc["),
    *("sourcehansanssc-regular", "sourcehansanscn-regular", "wqy-zenhei", "wqy-microhei"),
    *("droidsansfallback", "pingfang", "hiragino sans gb", "stheiti", "msyh.", "simhei"),
    *("simsun", "arial unicode"),
)


def is_wide(mark: str) -> bool:
    """Return whether a character is as wide as it is high."""
    return unicodedata.east_asian_width(mark) in "WF"


def font_of(text: str, size: float) -> Any:
    """Return the font of a text as Matplotlib's properties; size in points.

    Raises
    ------
    MultiposError
        No font of this machine has its Chinese characters.
    """
    from matplotlib.font_manager import FontProperties

    wide = frozenset(filter(is_wide, text))
    if not wide:
        plain: dict[str, Any] = dict.fromkeys(("style", "variant", "weight", "stretch"), "normal")
        return FontProperties(family=[FONT], size=size, **plain)
    return FontProperties(fname=_font_with(wide), size=size)


def _font_with(marks: frozenset[str]) -> str:
    """Return the file of the first font that has all of these characters."""
    for path in _chinese_fonts():
        if all(ord(mark) in _characters(path) for mark in marks):
            return path
    raise MultiposError(
        f"no font of this machine has the characters '{''.join(sorted(marks))[:20]}' of the "
        "figure; install one, such as Noto Sans CJK, or write a .svg file, whose text the "
        "reader's fonts draw."
    )


@cache
def _chinese_fonts() -> tuple[str, ...]:
    from matplotlib.font_manager import findSystemFonts

    places: dict[str, int] = {}
    for path in sorted(findSystemFonts()):
        name = Path(path).name.lower()
        place = next((i for i, start in enumerate(_CHINESE) if name.startswith(start)), None)
        if place is not None:
            places[path] = place
    return tuple(sorted(places, key=places.__getitem__))


@cache
def _characters(path: str) -> frozenset[int]:
    from matplotlib.ft2font import FT2Font

    return frozenset(FT2Font(path).get_charmap())
