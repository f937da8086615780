"""Words of the reports in other languages than English.

English is the key: a language is a TOML file in `templates`, with the table ``words`` of whole
sentences, where ``{name}`` stands for what is put in, and ``messages``, patterns for what the
fits say, where ``{name}`` matches whatever stands there. What a language lacks stays English.
"""

import re
from collections.abc import Sequence
from functools import lru_cache
from importlib.resources import files
from typing import Any, Literal, get_args

from multipos.errors import UsageError

Language = Literal["en", "zh"]
LANGUAGES: tuple[Language, ...] = get_args(Language)


class Translator:
    """Return a sentence in a language: ``tr("Offset of {output}", output="ax")``."""

    def __init__(self, language: Language) -> None:
        if language not in LANGUAGES:
            raise UsageError(f"--language takes {' or '.join(LANGUAGES)}, got '{language}'.")
        self.language = language
        content = {} if language == "en" else _read(language)
        self.words: dict[str, str] = content.get("words", {})
        self.messages: dict[str, str] = content.get("messages", {})

    def __call__(self, text: str, **put_in: str) -> str:
        """Return a sentence with what is put in."""
        return self.words.get(text, text).format(**put_in) if put_in else self.words.get(text, text)

    def message(self, text: str) -> str:
        """Return what a fit said: a sentence with numbers and names in it."""
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

    text = (
        files("multipos.reports")
        .joinpath("templates", f"{language}.toml")
        .read_text(encoding="utf-8")
    )
    return tomllib.loads(text)
