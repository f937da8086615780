"""Every finding of the program is on its page, and its text is short."""

import ast
import re
import tomllib
from functools import cache
from pathlib import Path

import pytest
from docs_programs import load

import multipos as mp
from multipos.finding import short_text

ROOT = Path(__file__).resolve().parents[2]
PUT_IN = "7"  # where a text has a number or a name
FILES = [p for p in sorted((ROOT / "multipos").rglob("*.py")) if "Finding(" in p.read_text("utf-8")]


PROGRAM = load("generated")


@cache
def made_here():
    """Return every finding of the program, whose files are read once."""
    return list(PROGRAM.messages(FILES, PUT_IN))


def on_the_page() -> set[tuple[str, str]]:
    page = (ROOT / "docs/reference/messages.md").read_text("utf-8")
    found = re.findall(r"^### `([a-z-]+)`\n\n\*([a-z, ]+)\*$", page, re.MULTILINE)
    return {(code, level) for code, levels in found for level in levels.split(", ")}


def test_every_code_of_the_program_is_on_the_page_and_no_other():
    made = {(code, level) for m in made_here() for code in m.codes for level in m.levels}
    assert len(made) > 25
    assert on_the_page() == made


def test_what_is_kept_of_a_code_is_of_one_that_there_is():
    codes = {code for m in made_here() for code in m.codes}
    for name in PROGRAM.KEPT:
        assert set(tomllib.loads((ROOT / "docs" / name).read_text("utf-8"))) <= codes


def test_every_code_has_an_example_that_the_program_says():
    texts: dict[str, list[str]] = {}
    for made in PROGRAM.messages(FILES, "…"):
        for code in made.codes:
            texts.setdefault(code, []).extend(made.texts)
    examples = tomllib.loads((ROOT / "docs/examples.toml").read_text("utf-8"))
    assert [
        text for text in examples.values() if re.search(r"p = (0\b(?!\.)|[\d.]+e-)", text)
    ] == []
    said = {code for code, text in examples.items() if PROGRAM.is_said(text, texts[code])}
    if missing := sorted(texts.keys() - said):
        pytest.fail(f"no example of {', '.join(missing)}; run `python docs/examples.py TEST`")


def test_no_text_is_longer_than_160_characters():
    texts = [text for made in made_here() for text in (*made.texts, *made.actions)]
    assert [text for text in texts if len(text) > 160] == []


def test_a_text_of_long_names_is_cut_at_160_characters():
    """Names of files and columns have any length; of a list there is as much as has room."""
    text = mp.Finding("repeated-file", "warning", "omitted: " + 200 * "a").text
    assert len(text) == 160
    assert text.endswith("a…")
    parts = [30 * letter for letter in "abcdef"]
    said = short_text(lambda count: ", ".join(parts[:count]), len(parts))
    assert said == ", ".join(parts[:5])
    assert short_text(lambda count: count * 170 * "a", 3) == 170 * "a"


# STYLE, "Plain words": what only this package says. Options, names and keys are apart.
PRIVATE = re.compile(
    r"\b(told|tells?|worth|floors?|scatter(s|ed)?|claim(s|ed)?|den(y|ies|ied)|belie(f|ves?|ved)|"
    r"placements?|leans?|nests?|wander(s|ed)?|wolf|weigh(s|ed)?|speaks?|in turn|sketch|appraisal|"
    r"alike|unlike|apart|calm|absurd|looked|drawn|across|beside|judg(e|ed|ing)|pieces?|hidden|"
    r"unseen|settles?|settled|says?|knows?|facing|stating|carry|carries|resume|repair|"
    r"of one's own)\b"
)
NAMES = re.compile(r"\[\w+\]|--[\w-]+|`[^`]*`|\w*_\w*")
# What new users had to read twice, as it was printed.
RIDDLES = (
    "does not fall as that of noise",
    "independent samples only",
    "drawn towards what they have in common",
    "so that means do not settle",
    "positions cannot show",
    "lie across the force",
    "far smaller than the stated noise",
    "U leaves scale factors open",
    "the outputs scatter unequally",
    "the run as a whole: undecided",
    "differs from soak to soak",
    "it is as if this had moved",
    "stands turned in its case",
    "leaves of the calibration's own readings",
    "the file names no sensor",
    "of what one g does to the output",
    "Numbers of the line are those",
    "a polynomial says nothing",
    "were not told apart",
    "readings repeat worse than they claim",
)


def sentences() -> dict[str, str]:
    """Return every text of the program with a space in it that is no docstring, by its place."""
    found = {}
    for path in sorted((ROOT / "multipos").rglob("*.py")):
        nodes = PROGRAM.parsed(path)[1]
        apart: set[int] = set()
        for node in nodes:
            if isinstance(node, ast.JoinedStr):
                apart |= {id(part) for part in node.values}
            if isinstance(node, ast.Expr):
                apart.add(id(node.value))
        for node in nodes:
            if id(node) in apart or not isinstance(node, ast.JoinedStr | ast.Constant):
                continue
            parts = node.values if isinstance(node, ast.JoinedStr) else [node]
            texts = [part.value if isinstance(part, ast.Constant) else PUT_IN for part in parts]
            text = "".join(each for each in texts if isinstance(each, str))
            if " " in text.strip():
                found[f"{path.relative_to(ROOT)}:{node.lineno}"] = text
    return found


def test_no_sentence_of_the_program_has_private_words():
    every = sentences()
    assert len(every) > 2000
    private = {
        place: (word[0], text)
        for place, text in every.items()
        if (word := PRIVATE.search(NAMES.sub("", text)))
    }
    assert private == {}
    left = [(riddle, text) for text in every.values() for riddle in RIDDLES if riddle in text]
    assert left == []


def test_an_action_is_one_sentence_with_its_full_stop():
    for action in (action for made in made_here() for action in made.actions):
        if re.search("[a-z]", action):
            assert re.fullmatch(r"[A-Z`][^;]*[^.;]\.", action), action
            assert ". " not in action
