r"""Characters that act instead of being read, and text in which they are only shown.

Labels, names and file names come from elsewhere. A control character in one would move the cursor
of a terminal, begin a line of its own in a parameter file or end a comment; here it becomes the
escape that JSON has for it, ``\u001b``, so that in JSON it stays the same character.
"""

import unicodedata

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
    if text.isprintable():
        return text
    return "".join(
        escaped(mark) if mark not in "\n\t" and _is_control(mark) else mark for mark in text
    )


def one_line(text: str) -> str:
    """Return text as one line, white space of any length and kind as one blank."""
    return visible(" ".join(text.split()))


def escaped(text: str) -> str:
    r"""Return each character as ``\uXXXX``, as JSON does, in two where one does not suffice."""
    raw = text.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{raw[i : i + 2].hex()}" for i in range(0, len(raw), 2))


def _is_control(mark: str) -> bool:
    return unicodedata.category(mark) in ("Cc", "Cs", "Zl", "Zp") or mark in _TURNS
