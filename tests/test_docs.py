"""Every code block of README.md and docs/ is run, and what it prints is compared.

- ```` ```python ```` with `>>>` is a doctest; without, it is executed. One namespace a page.
- ```` ```console ```` holds `$ command` lines (`> ` or a backslash continues one), each followed by
  all that it prints on stdout and stderr. A command may fail only where the page shows its line
  `multipos: error: …`.
- Any block after `<!-- file: NAME -->` is written to that file first.
- After `<!-- continues: PAGE -->` the blocks of that page are run before those of this one.
- ```` ```sh ```` after `<!-- command: NAME -->` sets a machine up: `.ci/run` runs it, not this.

All of a page happens in one temporary folder, from top to bottom. Plain commands of `multipos` run
in this process, which has the libraries loaded; whatever needs a shell runs in one.
"""

import difflib
import doctest
import importlib
import inspect
import io
import os
import pkgutil
import re
import runpy
import shlex
import subprocess
import sys
import sysconfig
import textwrap
import traceback
from contextlib import chdir, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest
from amounts import slow_where
from docs_programs import load

import multipos
from multipos.cli import main

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted(path for path in ROOT.glob("docs/**/*.md") if "_build" not in path.parts),
]
MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(multipos.__path__, "multipos.")
    if not module.name.endswith(".__main__")
)
RUN = [
    page
    for page in PAGES
    if page.name != "names.md"  # what it shows is run where it is from
]
# Logs, designs and comparisons of seconds; what their commands print is tested with the commands.
LONG = {"static-records", "temperature", "report-uncertainty", "choose-a-scheme", "six-positions"}
# What users import, as docs/reference/api.md says: all else moves without a word.
PUBLIC_MODULES = {"multipos", "multipos.plots"}
FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS | doctest.REPORT_UDIFF
TIMEOUT = 300  # [s] for one command: a hang must end, a slow machine must not fail

FENCE = re.compile(r"(?P<indent> *)(?P<ticks>`{3,})(?P<language>[^`\s]*)")
NOTE = re.compile(r"\s*<!-- (?P<kind>command|file): (?P<name>.+?) -->\s*$")
CONTINUES = re.compile(r"^<!-- continues: (\S+) -->$", re.MULTILINE)
EQUATION = re.compile(r"^\$\$ \([\w-]*?(?P<number>\d+)\)\s*$", re.MULTILINE)
IMPORT = re.compile(r"^[>.\s]*(?:from|import) (?P<module>multipos[\w.]*)", re.MULTILINE)
FILE = re.compile(r"`((?:multipos|tests)/[a-z_/]+(?:\.py)?)`")
CITATION = re.compile(r"eqs?\. (?P<numbers>\(\d+\)[^a-z]*?) of (?P<page>docs/[\w/-]+\.md)")


@dataclass(frozen=True)
class Block:
    page: Path
    line: int  # of the first line inside the fence, from 1
    language: str
    note: tuple[str, str] | None  # kind and name of the comment right above the block
    text: str

    def where(self, offset: int = 0) -> str:
        page = self.page.relative_to(ROOT) if self.page.is_relative_to(ROOT) else self.page.name
        return f"{page}:{self.line + offset}"


def blocks(page: Path) -> list[Block]:
    """Fenced code blocks of a page, in order."""
    found = []
    note = None
    lines = iter(enumerate(page.read_text(encoding="utf-8").splitlines(), start=1))
    for number, line in lines:
        if fence := FENCE.match(line):
            inside = []
            for _, content in lines:
                if content.strip() == fence["ticks"]:
                    break
                inside.append(content)
            else:
                pytest.fail(f"{page}:{number}: the block is never closed", pytrace=False)
            text = textwrap.dedent("\n".join(inside)) + "\n"
            found.append(Block(page, number + 1, fence["language"], note, text))
            note = None
        elif comment := NOTE.match(line):
            note = comment["kind"], comment["name"]
        elif line.strip():
            note = None
    return found


def way_to(page: Path) -> list[Path]:
    """Return the pages that this one goes on from, the first of them first, and this one."""
    before = CONTINUES.search(page.read_text(encoding="utf-8"))
    return [*(way_to(page.parent / before[1]) if before else []), page]


def run_page(page: Path, folder: Path) -> list[str]:
    """Run all blocks of a page in a folder; return what went wrong, a text each."""
    namespace: dict[str, object] = {"__name__": "__main__"}
    problems: list[str] = []
    for block in [block for each in way_to(page) for block in blocks(each)]:
        match block.note, block.language:
            case ("file", name), _:
                (folder / name).write_text(block.text, encoding="utf-8")
            case ("command", _), "sh":
                pass
            case _, "python":
                problems += run_python(block, namespace)
            case _, "console":
                problems += run_console(block, folder)
            case _, "sh" | "bash" | "shell" | "pycon" | "py":
                problems.append(
                    f"{block.where()}: a {block.language} block is not run; "
                    "write `console` or `python`, or put `<!-- command: NAME -->` above it"
                )
    return problems


def run_python(block: Block, namespace: dict[str, object]) -> list[str]:
    if ">>>" in block.text:
        test = doctest.DocTestParser().get_doctest(
            block.text, namespace, block.where(), str(block.page), block.line - 1
        )
        report = io.StringIO()
        doctest.DocTestRunner(optionflags=FLAGS).run(test, out=report.write, clear_globs=False)
        namespace.update(test.globs)
        return [f"{block.where()}:\n{report.getvalue()}"] if report.getvalue() else []
    # The newlines give tracebacks the line numbers of the page.
    source = "\n" * (block.line - 1) + block.text
    try:
        exec(compile(source, block.page, "exec"), namespace)
    except (Exception, SystemExit):
        return [f"{block.where()}:\n{traceback.format_exc()}"]
    return []


def run_console(block: Block, folder: Path) -> list[str]:
    problems = []
    for offset, command, expected in commands(block):
        done = printed(command, folder)
        want, got = tidy(expected), tidy(done.stdout)
        where = f"{block.where(offset)}: $ {command}"
        if want != got:
            difference = difflib.unified_diff(
                want.splitlines(), got.splitlines(), "the page", "the command", lineterm=""
            )
            problems.append("\n".join([where, *difference, f"(exit status {done.returncode})"]))
        elif done.returncode != 0 and not re.search("^multipos: error: ", want, re.MULTILINE):
            problems.append(f"{where}\nexit status {done.returncode}, and the page shows no error")
    return problems


PLAIN = re.compile(r"(?P<program>multipos|python) (?P<rest>[^|;&<>$`]+?)( > (?P<file>[\w.]+))?")


def printed(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Return what a command of a page prints, stdout and stderr in one."""
    plain = PLAIN.fullmatch(re.sub(r"\s*\\?\n\s*", " ", command))
    if plain:
        return printed_here(plain["program"], shlex.split(plain["rest"]), plain["file"], folder)
    return subprocess.run(
        ["sh", "-c", command],
        cwd=folder,
        env=environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
        timeout=TIMEOUT,
        check=False,
    )


def printed_here(
    program: str, arguments: list[str], file: str | None, folder: Path
) -> subprocess.CompletedProcess[str]:
    """Run a command of `multipos`, or a program of Python, in this process."""
    out = io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True)
    status = 0
    with pytest.MonkeyPatch.context() as patch, chdir(folder):
        for name, value in environment().items():
            patch.setenv(name, value)
        patch.setattr(sys, "argv", arguments)
        with redirect_stdout(io.StringIO() if file else out) as stdout, redirect_stderr(out):
            if program == "multipos":
                status = main(arguments)
            else:
                runpy.run_path(arguments[0], run_name="__main__")
        if file:
            Path(file).write_text(stdout.getvalue(), encoding="utf-8")
    text = out.buffer.getvalue().decode("utf-8")  # type: ignore[attr-defined]
    return subprocess.CompletedProcess(arguments, status, text)


def commands(block: Block) -> list[tuple[int, str, str]]:
    """Offset, command and expected output of each command of a console block."""
    found: list[tuple[int, list[str], list[str]]] = []
    for offset, line in enumerate(block.text.splitlines()):
        if line.startswith("$ "):
            found.append((offset, [line[2:]], []))
        elif not found:
            pytest.fail(f"{block.where(offset)}: output without a `$ command`", pytrace=False)
        else:
            _, command, output = found[-1]
            if not output and (command[-1].endswith("\\") or line.startswith("> ")):
                command.append(line.removeprefix("> "))
            else:
                output.append(line)
    return [(offset, "\n".join(command), "\n".join(output)) for offset, command, output in found]


def tidy(output: str) -> str:
    """Return an output without blanks at ends, and as it is where pyarrow is not installed."""
    lines = (line.rstrip() for line in output.splitlines())
    text = "\n".join(lines).strip("\n") + "\n"
    return text.replace("calibrations.parquet", "calibrations.csv")


def environment() -> dict[str, str]:
    """Environment in which commands print the same everywhere."""
    variables = {name: value for name, value in os.environ.items() if "COLOR" not in name}
    return variables | {
        "PATH": os.pathsep.join([sysconfig.get_path("scripts"), os.environ["PATH"]]),
        "COLUMNS": "100",
        "NO_COLOR": "1",
        "TERM": "dumb",
        "LC_ALL": "C.UTF-8",
        "PYTHONUTF8": "1",
        "PYTHONUNBUFFERED": "1",  # stdout and stderr in the order they were written
    }


@pytest.mark.parametrize(
    "page",
    slow_where(lambda page: page.stem in LONG, RUN),
    ids=lambda page: str(page.relative_to(ROOT)),
)
def test_page_prints_what_it_says(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    problems = run_page(page, tmp_path)
    for picture in load("pictures").pictures(page):
        drawn = tmp_path / picture.drawn
        if not drawn.is_file():
            problems.append(f"{page.name} shows {picture.drawn}, which nothing on it draws")
        elif drawn.suffix == ".svg" and written_in(drawn) != written_in(picture.kept):
            problems.append(f"{picture.kept.name} is old: python docs/pictures.py {page}")
    if problems:
        pytest.fail("\n\n".join(problems), pytrace=False)


def written_in(picture: Path) -> list[str]:
    """Return all text of a figure: its numbers along the axes, its names, its legend."""
    return re.findall(r"<text[^>]*>([^<]*)</text>", picture.read_text("utf-8"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_page_imports_only_what_is_public(page):
    imports = [
        (block.where(), match["module"])
        for block in blocks(page)
        for match in IMPORT.finditer(block.text)
    ]
    assert not [(where, module) for where, module in imports if module not in PUBLIC_MODULES]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_files_of_the_package_that_a_page_names_exist(page):
    named = set(FILE.findall(page.read_text("utf-8")))
    assert not [name for name in named if not (ROOT / name).exists()]


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples_print_what_they_say(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    report = io.StringIO()
    runner = doctest.DocTestRunner(optionflags=FLAGS)
    for test in doctest.DocTestFinder(exclude_empty=True).find(importlib.import_module(name)):
        runner.run(test, out=report.write)
    if report.getvalue():
        pytest.fail(report.getvalue(), pytrace=False)


def test_pictures_are_small_and_each_is_shown():
    shown = {
        (page.parent / name).resolve()
        for page in PAGES
        for name in re.findall(r"^!\[[^\]]*\]\((\S+)\)$", page.read_text("utf-8"), re.MULTILINE)
    }
    kept = set((ROOT / "docs/figures").iterdir())
    assert {path for path in shown if path.parent.name == "figures"} == kept
    assert max(path.stat().st_size for path in kept) < 100_000


# The programs whose pictures docs/results.md shows.
STUDIES = sorted((ROOT / "benchmarks/studies").glob("[!_]*.py"))


@pytest.mark.slow
@pytest.mark.parametrize("program", STUDIES, ids=lambda path: path.stem)
def test_a_study_draws_the_pictures_that_are_kept(program, tmp_path):
    subprocess.run(
        [sys.executable, "-W", "ignore", "-m", f"benchmarks.studies.{program.stem}"],
        cwd=tmp_path,
        env=environment() | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.DEVNULL,
        timeout=TIMEOUT,
        check=True,
    )
    drawn = [path for path in tmp_path.iterdir() if path.suffix in (".svg", ".png")]
    assert drawn
    for path in drawn:
        kept = ROOT / "docs/figures" / path.name
        assert kept.is_file()
        assert path.suffix == ".png" or written_in(path) == written_in(kept)


KEPT = sorted(
    path for path in ROOT.glob("docs/**/*.svg") if "_build" not in path.relative_to(ROOT).parts
)


@pytest.mark.parametrize("picture", KEPT, ids=lambda p: p.name)
def test_a_kept_picture_stands_on_white_and_is_the_same_whenever_it_is_drawn(picture):
    text = picture.read_text("utf-8")
    assert re.search(r'<rect width="(100%|760)" height="(100%|600)" fill="#ffffff"/>', text)
    assert "<dc:date>" not in text
    if picture.name != "architecture.svg":  # written by hand
        ids = re.findall(r'\bid="([^"]+)"', text)
        assert all(re.fullmatch(r"i\d+", one) for one in ids)  # else they are drawn by lot


def test_a_figure_is_as_wide_as_its_labels_need():
    """By hand: slip.svg is 432 wide, its smallest label 8.33; 9 px are 432 · 9/8.33 = 466.7."""
    assert load("pictures").least_width(ROOT / "docs/figures/slip.svg") == 467


# What a visitor reads and a maintainer can keep. Lists that the program writes are apart.
MOST_PAGES, MOST_WORDS = 35, 44_800
GENERATED = {"names.md", "commands.md", "messages.md", "errors.md"}
NOT_OF_THE_SITE = {"architecture.md", "decisions.md"}
SITE = [
    page
    for page in PAGES
    if page.is_relative_to(ROOT / "docs") and page.name not in GENERATED | NOT_OF_THE_SITE
]
LONGEST = {
    "README.md": 700,
    "docs/decisions.md": 4_000,
    "CHANGELOG.md": 2_000,
}  # it grows with versions
NOT_PROSE = re.compile(
    r"^ *(`{3,}).*?^ *\1|<!--.*?-->|^\$\$.*?^\$\$.*?$|\$[^$\n]+\$|`[^`\n]+`"
    r"|!\[[^\]]*\]\([^)]*\)|\]\([^)]*\)",
    re.MULTILINE | re.DOTALL,
)


def prose(page: Path) -> str:
    """Return what is read of a page: no code, equations, pictures nor addresses."""
    return NOT_PROSE.sub(" ", page.read_text("utf-8"))


def test_the_site_is_small_enough_to_be_read():
    assert len(SITE) <= MOST_PAGES
    assert sum(len(page.read_text("utf-8").split()) for page in SITE) <= MOST_WORDS


@pytest.mark.parametrize("name", LONGEST)
def test_a_page_of_the_repository_is_short(name):
    assert len((ROOT / name).read_text("utf-8").split()) <= LONGEST[name]


# Words that nobody but this project used for these things; the field's own are in their place.
OURS = re.compile(
    r"\b(tell|told|tells|claim(s|ed)?|den(y|ies|ied)|belie(ve|ves|ved|f)|lean(s|ing)?|floor|nests?|"
    r"wander(s|ed)?|wolf|scatters?|sketch(es)?|absurd\w*|placements?|placed|placing|worth|unseen|"
    r"hidden|alike|unlike|apart|hardly|in turn|looked at|drawn together|calm|loose(ly)?|"
    r"shares? (of|out)|laws?|pieces?|judge[ds]?|judging|repair\w*|push(es|ed)?|appraisal|doubts?|"
    r"weigh(s|ed|ing)?|speaks?|across|one's own)\b"
)


@pytest.mark.parametrize("page", [*SITE, ROOT / "README.md"], ids=lambda page: page.stem)
def test_a_page_uses_the_words_of_the_field(page):
    assert not [found[0] for found in OURS.finditer(prose(page))]


HOW_TO = [page for page in SITE if page.parent.name == "howto"]


@pytest.mark.parametrize("page", HOW_TO, ids=lambda page: page.stem)
def test_a_how_to_says_what_one_gets_and_has_a_picture(page):
    assert re.search(r"^\*\*You (get|have)\*\*", page.read_text("utf-8"), re.MULTILINE)
    assert re.search(r"^!\[[^\]]+\]\(\S+\.(svg|png)\)$", page.read_text("utf-8"), re.MULTILINE)


def test_every_public_name_has_an_example():
    said = {name: inspect.getdoc(getattr(multipos, name)) for name in multipos._PUBLIC}
    assert [name for name, text in said.items() if ">>> import multipos as mp" not in text] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_equation_labels_are_the_printed_numbers(page):
    """Code cites equations by number, so the label must be the number Sphinx prints."""
    numbers = [int(match["number"]) for match in EQUATION.finditer(page.read_text("utf-8"))]
    assert numbers == list(range(1, len(numbers) + 1))


def test_cited_equations_exist():
    wrong = []
    for path in ROOT.glob("multipos/**/*.py"):
        for citation in CITATION.finditer(path.read_text("utf-8")):
            page = ROOT / citation["page"]
            last = len(EQUATION.findall(page.read_text("utf-8"))) if page.exists() else 0
            cited = [int(number) for number in re.findall(r"\d+", citation["numbers"])]
            if max(cited) > last:
                wrong.append(f"{path.name}: {citation[0]}, which has {last} equations")
    assert not wrong


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("```python\n>>> 1 + 1\n3\n```", 'page.md", line 2'),
        ("```python\nx = 1\nassert x == 2\n```", 'page.md", line 3'),
        ("\n```console\n$ echo two\nthree\n```", "page.md:3: $ echo two\n--- the page"),
        ("```console\n$ false\n```", "exit status 1"),
        ("```sh\nmake\n```", "is not run"),
    ],
)
def test_a_wrong_page_is_reported(text, message, tmp_path):
    page = tmp_path / "page.md"
    page.write_text(text + "\n", encoding="utf-8")
    (problem,) = run_page(page, tmp_path)
    assert message in problem


def test_a_page_goes_on_from_another(tmp_path):
    (tmp_path / "first.md").write_text("```python\nx = 1\n```\n", encoding="utf-8")
    page = tmp_path / "second.md"
    page.write_text(
        "<!-- continues: first.md -->\n```python\nassert x == 1\n```\n", encoding="utf-8"
    )
    assert run_page(page, tmp_path) == []


def test_a_right_page_passes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = tmp_path / "page.md"
    page.write_text(
        textwrap.dedent(
            """
            <!-- command: test -->
            ```sh
            exit 1
            ```

            <!-- file: data.csv -->
            ```csv
            ax,ay
            1,2
            ```

            - In a list, and with names shared between blocks:

              ```python
              x = 2
              ```

            ```python
            >>> from pathlib import Path
            >>> Path("data.csv").read_text()[:2] * x
            'axax'
            ```

            ```console
            $ cat \\
            >   data.csv
            ax,ay
            1,2
            $ echo 'multipos: error: no' >&2; exit 1
            multipos: error: no
            ```
            """
        ),
        encoding="utf-8",
    )
    assert run_page(page, tmp_path) == []
