"""Sphinx settings: `sphinx-build -W docs docs/_build/html`."""

import inspect
import os
from pathlib import Path

import multipos
from multipos.cli import COMMANDS, command_parser

project = "multipos"
author = "the multipos developers"
copyright = f"2026, {author}"
version = release = multipos.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "numpydoc",
]
exclude_patterns = ["_build", "reference/generated"]
html_theme = "furo"
html_title = "multipos"

myst_enable_extensions = ["amsmath", "deflist", "dollarmath"]
myst_heading_anchors = 3
# Equations are numbered page by page, in the order of the page: code cites them by that number.
math_eqref_format = "({number})"

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # numpydoc sections say shape and unit, which annotations cannot
autosummary_generate = True
numpydoc_show_class_members = False


def write_generated(app):
    """Write what the reference includes: the help of every command and all public names."""
    folder = Path(app.srcdir) / "reference" / "generated"
    folder.mkdir(exist_ok=True)
    os.environ["COLUMNS"] = "100"  # the width of argparse's help
    commands = [
        f"### multipos {name}\n\n```text\n{command_parser(name).format_help()}```\n"
        for name in COMMANDS
    ]
    names = sorted(set(multipos.__all__) - {"__version__"}, key=str.swapcase)
    directives = []
    for name in names:
        kind = "class" if inspect.isclass(getattr(multipos, name)) else "function"
        directives.append(
            f".. auto{kind}:: multipos.{name}\n{'   :members:' * (kind == 'class')}\n"
        )
    (folder / "commands.md").write_text("\n".join(commands), encoding="utf-8")
    (folder / "names.rst").write_text("\n".join(directives), encoding="utf-8")


def setup(app):
    app.connect("builder-inited", write_generated)
