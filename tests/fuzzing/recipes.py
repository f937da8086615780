"""Valid command lines over the files of `bases`, where every case starts: `recipes.txt`.

The number in front is how often one is drawn; what costs more than some 50 ms is drawn seldom, so
that 100,000 cases fit in two hours of one core.
"""

import random
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

TEXT = Path(__file__).with_name("recipes.txt").read_text("utf-8")


@dataclass(frozen=True)
class Recipe:
    """A valid command line and how often it is drawn."""

    weight: float
    words: tuple[str, ...]

    @property
    def command(self) -> str:
        """The command's name."""
        return self.words[0]


def _read() -> tuple[Recipe, ...]:
    lines = [line.strip().partition(" ") for line in TEXT.strip().splitlines()]
    return tuple(Recipe(float(weight), tuple(shlex.split(words))) for weight, _, words in lines)


_REPLAY, _AT_ONCE = "replay:", ":0"
RECIPES = _read()


def draw(rng: random.Random, names: tuple[str, ...] | None = None) -> Recipe:
    """Draw a command line, or one that names one of these files."""
    fitting = [r for r in RECIPES if names is None or set(names) & set(map(file_of, r.words))]
    return rng.choices(fitting, [r.weight for r in fitting])[0]


def file_of(word: str) -> str:
    """The file that a word of a command line names, where it names one: also in replay:FILE:0."""
    return word.removeprefix(_REPLAY).removesuffix(_AT_ONCE)


def renamed(word: str, name: str) -> str:
    """The word with another file in its place; without `replay:` a log would be waited on."""
    return f"{_REPLAY}{name}{_AT_ONCE}" if word.startswith(_REPLAY) and name != "-" else name


def files_of(words: list[str], valid: Mapping[str, bytes]) -> dict[str, bytes]:
    """Those of the valid files that a command line names."""
    return {name: valid[name] for name in map(file_of, words) if name in valid}
