"""A reader finds by search every code, every option and every word of a message."""

import json
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from types import ModuleType

import pytest
from docs_programs import load

from multipos.cli import COMMANDS, command_parser

pytestmark = pytest.mark.slow
DOCS = Path(__file__).resolve().parents[1] / "docs"
FILES = sorted((DOCS.parent / "multipos").rglob("*.py"))


@pytest.fixture(scope="module")
def program() -> ModuleType:
    return load("generated")


class Index:
    """What the search of the built pages looks through, asked as its script does."""

    def __init__(self, built: Path) -> None:
        from sphinx.search.en import SearchEnglish

        text = (built / "searchindex.js").read_text("utf-8")
        self.content = json.loads(text.removeprefix("Search.setIndex(").removesuffix(")"))
        self.language = SearchEnglish({})

    def pages_of(self, term: str) -> set[str]:
        """Return the pages with a term; with a longer word that holds it where none has it."""
        found: set[int] = set()
        for part in ("terms", "titleterms"):
            known = self.content[part]
            like = [term] if term in known else []
            if not like and len(term) > 2:
                like = [each for each in known if term in each]
            for each in like:
                found |= {known[each]} if isinstance(known[each], int) else set(known[each])
        return {self.content["docnames"][page] for page in found}

    def terms(self, query: str) -> set[str]:
        words = re.split(r"[^\w]+", query.lower())
        asked = (word for word in words if word and not re.fullmatch(r"\d+", word))
        return {self.language.stem(word) for word in asked if word not in self.language.stopwords}

    def finds(self, query: str) -> set[str]:
        """Return the pages that hold all terms of a query, or all of three letters and more.

        Without a term in it, those that have the query among their index entries.
        """
        terms = self.terms(query)
        if not terms:
            entries = self.content["indexentries"].get(query.lower(), ())
            return {self.content["docnames"][entry[0]] for entry in entries}
        held = Counter(page for term in terms for page in self.pages_of(term))
        enough = {len(terms), sum(len(term) > 2 for term in terms)}
        return {page for page, count in held.items() if count in enough}


@pytest.fixture(scope="module")
def index(tmp_path_factory) -> Index:
    for library in ("sphinx", "myst_parser", "furo", "sphinx_copybutton"):
        pytest.importorskip(library)
    built = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-b", "html", str(DOCS), str(built)]
    subprocess.run(command, check=True)
    return Index(built)


def test_every_code_is_found(index, program):
    codes = {code for made in program.messages(FILES, "…") for code in made.codes}
    assert not [code for code in codes if "reference/messages" not in index.finds(code)]


def test_every_option_is_found(index):
    options = {
        option
        for name in COMMANDS
        for action in command_parser(name)._actions
        for option in action.option_strings
        if action.dest != "help"
    }
    assert not [each for each in options if "reference/commands" not in index.finds(each)]


def test_every_word_of_a_finding_is_found(index, program):
    made = program.messages(FILES, "…")
    said = {text for each in made for text in (*each.texts, *each.actions) if index.terms(text)}
    assert not [text for text in said if "reference/messages" not in index.finds(text)]


@pytest.mark.parametrize(
    "typed",
    [
        "no numeric column can be an output; see --columns",
        "6 positions give 6 equations for 9 parameters: out of reach; add positions",
        "all positions lie on one circle",
        "the readings deviate by 31 % about the ellipsoid",
        "px4 cannot express cross_ax_y; accept it with --allow-lossy",
        "no such file; check the path",
        "8 of 9 parameters of ax can be separated",
        "--positions 3 is too few: the model has 4 parameters per output",
        "the file is damaged, run stability again",
        "residuals exceed the stated noise (p < 1e-6); U includes an excess",
    ],
)
def test_a_common_message_is_found_as_it_is_printed(index, typed):
    assert index.finds(typed)
