"""Links between pages lead somewhere, and the table of terms uses the words of the reports."""

import re
from pathlib import Path

import pytest

from multipos.numerics.terms import NAMED
from multipos.sensor.model import build_model
from multipos.uncertainty.budgets import DIVISORS, KINDS

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted(
    path
    for path in [
        *ROOT.glob("*.md"),
        *ROOT.glob("docs/**/*.md"),
        *ROOT.glob(".github/**/*.md"),
        *ROOT.glob("paper/*.md"),
    ]
    if "_build" not in path.parts
)
FENCED = re.compile(r"^( *)(`{3,}).*?^\1\2 *$", re.MULTILINE | re.DOTALL)
IN_LINE = re.compile(r"`[^`\n]*`")
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ +(.+?) *$", re.MULTILINE)
ELSEWHERE = ("https://", "http://")


def prose(page):
    return FENCED.sub("", page.read_text(encoding="utf-8"))


def anchors(page):
    """Return the anchors of headings, as Sphinx and forges of code make them."""
    titles = [re.sub(r"[`*]|\]\([^)]*\)|\[", "", title) for title in HEADING.findall(prose(page))]
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def broken(page):
    for link in LINK.findall(IN_LINE.sub("", prose(page))):
        if link.startswith(ELSEWHERE):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        if not target.exists():
            yield f"{link}: no such file"
        elif anchor and anchor not in anchors(target):
            yield f"{link}: no such heading"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_and_headings(page):
    assert not list(broken(page))


def test_a_broken_link_is_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "# One `two`: three\n[a](#one-two-three) [b](page.md#four) [c](none.md) `[d](e)`\n"
        "```text\n# no heading\n[f](g)\n```\n[h](#no-heading)\n",
        encoding="utf-8",
    )
    assert list(broken(page)) == [
        "page.md#four: no such heading",
        "none.md: no such file",
        "#no-heading: no such heading",
    ]


def terms():
    """Return the part of the page of conventions that has the terms."""
    return prose(ROOT / "docs/conventions.md").split("## Terms in English and Chinese")[1]


def test_the_table_of_terms_lacks_none_that_a_result_names():
    """Kinds of parameters, input quantities and their laws, verdicts: each in both languages."""
    rows = re.findall(
        r"^\| (?!English|---)(.+?) \| (.+?) \| (.+?) \| (.*?) \|$", terms(), re.MULTILINE
    )
    assert all(english.strip() and chinese.strip() for english, chinese, _, _ in rows)
    code = " ".join(named for *_, named in rows)
    models = [build_model(name, ("ax", "ay", "az"), ("x", "y", "z")) for name in NAMED]
    kinds = {re.match("[a-z]+", name)[0] for model in models for name in model.names}
    assert not [kind for kind in kinds if f"`{kind}_" not in code]
    words = " ".join(english for english, *_ in rows)
    stated = {"third_order": "third-order", "unseen": "term", "stability": "zero stability"}
    assert not [name for name in KINDS if stated.get(name, name) not in words]
    assert not [law for law in DIVISORS if law not in words]
    assert not [verdict for verdict in ("pass", "fail", "indeterminate") if verdict not in words]


# Other sites are not visited by a test: that would fail where there is no network, and on the day
# that somebody else moves a page. Their form is held: most dead links are typed.
ADDRESS = re.compile(r"https?://[^\s)\"'>}\]`]+")
DOI = re.compile(r"^10\.\d{4,9}/[\w.()/:;-]+$")


def addresses():
    files = [ROOT / name for name in ("pyproject.toml", "CITATION.cff", "paper/paper.bib")]
    for path in [*files, *PAGES, *ROOT.glob("conda/*"), *ROOT.glob(".github/**/*.yml")]:
        for found in ADDRESS.findall(path.read_text("utf-8")):
            yield path.name, found.rstrip(".,;")


def test_addresses_of_other_sites_are_well_formed_and_written_one_way():
    found = list(addresses())
    assert found
    assert not [each for each in found if not each[1].startswith("https://")]
    hosts = {address.split("/")[2] for _, address in found}
    assert not [host for host in hosts if not re.fullmatch(r"[a-z0-9-]+(\.[a-z0-9-]+)+", host)]
    assert not [each for each in found if "//" in each[1].removeprefix("https://")]
    ways = {}
    for _, address in found:
        plain = address.lower().removesuffix("/").removesuffix(".git").replace("://www.", "://")
        ways.setdefault(plain, set()).add(address)
    assert not [each for each in ways.values() if len(each) > 1]


def test_identifiers_of_papers_have_their_form():
    text = (ROOT / "paper/paper.bib").read_text("utf-8")
    found = re.findall(r"doi\s*=\s*\{(.+?)\}", text)
    assert found
    assert not [each for each in found if not DOI.match(each)]
