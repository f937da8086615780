"""What the project's files say of it is the same in all of them."""

import json
import re
import shutil
import subprocess
import tomllib
from pathlib import Path
from typing import get_args

import pytest

import multipos
from multipos.exports.target_matrices import NOISE_TARGETS
from multipos.exports.targets import TARGETS, TargetName
from multipos.numerics.terms import NAMED, Formula, NamedModel

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
RECIPE = (ROOT / "conda/recipe.yaml").read_text("utf-8")
CITATION = (ROOT / "CITATION.cff").read_text("utf-8")
WORKFLOW = (ROOT / ".github/workflows/ci.yml").read_text("utf-8")
IN_CONDA = {"matplotlib": "matplotlib-base"}  # the same without its windows


def test_the_version_is_the_same_everywhere():
    assert re.findall(r'^ *version: "?([\d.]+)"?$', RECIPE, re.MULTILINE) == [multipos.__version__]
    assert re.findall(r"^version: (.+)$", CITATION, re.MULTILINE) == [multipos.__version__]
    versions = re.findall(
        r"^## .*?(\d+\.\d+\.\d+)", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE
    )
    assert versions[0] == multipos.__version__


def test_the_licence_is_the_same_everywhere():
    for text in (RECIPE, CITATION):
        assert re.findall(r"license: (.+)", text) == [PROJECT["license"]]


def test_the_recipe_asks_for_what_the_package_asks_for():
    needed = re.search(r"  run:\n((?:    - .+\n)+)", RECIPE)[1]
    found = dict(re.findall(r"- ([\w-]+) (\S+)", needed))
    asked = dict(re.match(r"([\w-]+)(\S+)", one).groups() for one in PROJECT["dependencies"])
    expected = {IN_CONDA.get(name, name): version for name, version in asked.items()}
    assert found == {"python": PROJECT["requires-python"], **expected}
    (command,) = PROJECT["scripts"].items()
    assert f"- {command[0]} = {command[1]}\n" in RECIPE


def test_the_recipe_renders():
    rattler = pytest.importorskip("rattler_build")
    (variant,) = rattler.Stage0Recipe.from_file(ROOT / "conda/recipe.yaml").render()
    assert str(variant.recipe.package.name) == "multipos"


def test_classifiers_and_the_public_run_name_the_same_pythons():
    prefix = "Programming Language :: Python :: 3."
    named = [one.removeprefix(prefix) for one in PROJECT["classifiers"] if one.startswith(prefix)]
    assert f">=3.{named[0]}" == PROJECT["requires-python"]
    assert named == [str(minor) for minor in range(int(named[0]), int(named[-1]) + 1)]
    (matrix,) = re.findall(r"^ +python: \[(.+)\]$", WORKFLOW, re.MULTILINE)
    assert re.findall(r'"3\.(\d+)"', matrix) == named
    assert "bash .ci/run" in WORKFLOW


def test_the_readme_names_the_commands_that_set_a_machine_up():
    readme = (ROOT / "README.md").read_text("utf-8")
    for name in ("test", "demo"):
        assert len(re.findall(rf"<!-- command: {name} -->\n```sh\n.+\n```\n", readme)) == 1


def test_the_paper_has_its_parts_and_cites_what_its_bibliography_holds():
    paper = (ROOT / "paper/paper.md").read_text("utf-8")
    parts = ["Summary", "Statement of need", "State of the field", "Mathematics", "Validation"]
    assert re.findall(r"^# (.+)$", paper, re.MULTILINE)[:5] == parts
    bibliography = (ROOT / "paper/paper.bib").read_text("utf-8")
    held = re.findall(r"^@\w+\{(\w+),$", bibliography, re.MULTILINE)
    assert set(re.findall(r"@(\w+)", paper)) == set(held)
    assert len(held) == len(set(held))


@pytest.mark.skipif(not shutil.which("pandoc"), reason="pandoc is not installed")
def test_the_paper_is_typeset():
    """Pandoc is what the journal's own tools run; a key without its work would be a warning."""
    command = ["pandoc", "--citeproc", "--fail-if-warnings", "-s", "paper.md"]
    done = subprocess.run(
        [*command, "-t", "json"], cwd=ROOT / "paper", capture_output=True, text=True, check=False
    )
    assert done.stderr == ""
    document = json.loads(done.stdout)
    needed = {"title", "tags", "authors", "affiliations", "date", "bibliography"}
    assert needed <= set(document["meta"])
    assert '"refs"' in json.dumps(document["blocks"][-1])  # the works, set from the bibliography
    subprocess.run(
        [*command, "-t", "latex"], cwd=ROOT / "paper", stdout=subprocess.DEVNULL, check=True
    )


def test_a_page_for_a_reader_has_three_commands_and_the_same_parts():
    pages = sorted((ROOT / "docs/for").glob("*.md"))
    assert len(pages) == 1
    for page in pages:
        text = page.read_text("utf-8")
        parts = re.findall(r"^## (.+)$", text, re.MULTILINE)
        assert parts == ["Three commands", "Which number to read", "What can go wrong"]
        assert len(re.findall(r"^\$ multipos ", text, re.MULTILINE)) == 3
        assert f"for/{page.stem}.md)" in (ROOT / "README.md").read_text("utf-8")


def test_literals_are_what_the_program_takes():
    """Type checkers know the names of models and targets; any other text is a `Formula`."""
    assert get_args(NamedModel) == tuple(NAMED)
    known = {target.name for target in TARGETS} | {*NOISE_TARGETS}
    assert {*get_args(TargetName)} == known
    assert Formula("1 + own") == "1 + own"
