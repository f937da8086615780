"""Links between pages lead somewhere, and the table of terms uses the words of the reports."""

import re
from pathlib import Path

import pytest

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


# Of the standards and the papers; no report need have them.
OF_THE_FIELD = {"六位置测试法", "信息矩阵", "效率", "包含因子"}


def test_chinese_terms_are_those_of_reports_and_capture():
    used = "".join(
        (ROOT / "multipos" / name).read_text(encoding="utf-8")
        for name in ("reports/templates/zh.toml", "capturing/page.html")
    )
    rows = re.findall(r"^\| .+? \| (.+?) \|", prose(ROOT / "docs/reference/terms.md"), re.MULTILINE)
    terms = {term for row in rows for term in re.split(r"[,: ]+", re.sub(r" \(.*\)", "", row))}
    assert len(terms) > 50
    assert {term for term in terms if term not in used} <= OF_THE_FIELD
