#!/usr/bin/env python3

# /// script
# dependencies = ["nox>=2024.10.9"]
# ///

"""The project's chores, each in an environment of its own: `nox`, or one as in `nox -s tests`.

What follows `--` goes to the program, as in `nox -s tests -- -m slow`. `OPENBLAS_CORETYPE=Nehalem
nox -s tests` tests another kernel of the linear algebra library. `.ci/run` runs all of it.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import nox

nox.needs_version = ">=2024.10.9"
nox.options.default_venv_backend = "uv|venv"  # a tenth of the time where uv is installed

PROJECT = nox.project.load_toml("pyproject.toml")["project"]
EXTRAS = PROJECT["optional-dependencies"]

Version = tuple[int, int]


def pythons() -> dict[Version, str]:
    """Return every Python from 3.11 on, of PATH and of pyenv, the oldest first."""
    folders = [Path(folder) for folder in os.environ["PATH"].split(os.pathsep)]
    if shutil.which("pyenv"):
        root = subprocess.run(["pyenv", "root"], capture_output=True, text=True, check=False)
        folders += Path(root.stdout.strip()).glob("versions/*/bin")
    found = {sys.version_info[:2]: sys.executable}
    for folder in folders:
        for path in folder.glob("python3.*"):
            minor = re.fullmatch(r"python3\.(\d+)", path.name)
            version = (3, int(minor[1]) if minor else 0)
            if version >= (3, 11) and version not in found and _makes_environments(path):
                found[version] = str(path)
    return dict(sorted(found.items()))


def _makes_environments(python: Path) -> bool:
    """Tell whether this is a finished release that works; the shims of pyenv may not."""
    asked = "import ensurepip, sys, venv; sys.exit(sys.version_info.releaselevel != 'final')"
    return subprocess.run([python, "-c", asked], capture_output=True, check=False).returncode == 0


# Files that other services read, and whose schema they are held to.
FORMS = {
    "github-workflows": ".github/workflows/*.yml",
    "github-issue-forms": ".github/ISSUE_TEMPLATE/[!c]*.yml",
    "github-issue-config": ".github/ISSUE_TEMPLATE/config.yml",
    "dependabot": ".github/dependabot.yml",
    "readthedocs": ".readthedocs.yaml",
    "citation-file-format": "CITATION.cff",
}
RECIPE = """
from rattler_build import Stage0Recipe, VariantConfig
(built,) = Stage0Recipe.from_file("conda/recipe.yaml").render(VariantConfig())
print("conda/recipe.yaml:", built)
"""
PYTHONS = pythons()
OLDEST, NEWEST = min(PYTHONS), max(PYTHONS)


@nox.session
def lint(session: nox.Session) -> None:
    session.install(*EXTRAS["lint"])
    session.run("ruff", "check")
    session.run("ruff", "format", "--check")
    session.run("codespell")


@nox.session
def types(session: nox.Session) -> None:
    session.install("-e", ".[types]")
    session.run("mypy")


@nox.session
def tests(session: nox.Session) -> None:
    session.install("-e", ".[logs,test,oracles]")
    session.run("pytest", "-n", "auto", "--dist=worksteal", *session.posargs)


@nox.session(python=PYTHONS[OLDEST], default=False)
def lowest(session: nox.Session) -> None:
    """Test with the oldest versions that pyproject.toml promises to work with."""
    if OLDEST > (3, 12):
        session.skip("NumPy 1.26, the oldest promised, is not made for a Python beyond 3.12")
    oldest = [requirement.replace(">=", "==") for requirement in PROJECT["dependencies"]]
    # A pyparsing newer than the oldest Matplotlib warns of it, and warnings are errors.
    session.install("-e", ".[test]", *oldest, "pyparsing<3.3")
    session.run("pytest", "-n", "auto", "--dist=worksteal", *session.posargs)


@nox.session(python=PYTHONS[NEWEST], default=False)
def newest(session: nox.Session) -> None:
    """Test with the newest Python to be found, and the newest versions of everything."""
    if sys.version_info[:2] == NEWEST:
        session.skip(f"no Python newer than {sys.version.split()[0]} was found here")
    needed = [*PROJECT["dependencies"], *EXTRAS["test"], *EXTRAS["oracles"]]
    try:
        session.install("--only-binary=:all:", *needed)
    except nox.command.CommandFailed:
        session.skip(f"not everything is made for {PYTHONS[NEWEST]} yet, see above")
    session.install("-e", ".")
    session.run("pytest", "-n", "auto", "--dist=worksteal", *session.posargs)


@nox.session
def docs(session: nox.Session) -> None:
    session.install("-e", ".[docs,test]")
    session.run("sphinx-build", "-W", "--keep-going", "-q", "docs", "docs/_build/html")
    session.run("pytest", "-q", "-m", "slow", "tests/test_search.py")


@nox.session(default=False)
def benchmarks(session: nox.Session) -> None:
    session.install(".")
    session.run("python", "-m", "benchmarks", *session.posargs)


@nox.session(default=False)
def review(session: nox.Session) -> None:
    """Hold the project's files to what scientific Python asks of them."""
    session.install("repo-review[cli]", "sp-repo-review", "validate-pyproject", "zizmor")
    session.install("check-jsonschema", "py-rattler-build")
    session.run("repo-review", ".")
    session.run("zizmor", "--offline", ".github")
    for schema, pattern in FORMS.items():
        files = map(str, Path().glob(pattern))
        session.run("check-jsonschema", "--builtin-schema", f"vendor.{schema}", *files)
    session.run("python", "-c", RECIPE)


if __name__ == "__main__":
    nox.main()
