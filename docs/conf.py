"""Sphinx settings: `sphinx-build -W docs docs/_build/html`."""

import inspect
import os
from pathlib import Path

import multipos.plots
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
    (folder / "commands.md").write_text("\n".join(commands), encoding="utf-8")
    for module in (multipos, multipos.plots):
        name = module.__name__.rpartition(".")[2]
        (folder / f"{name}.rst").write_text(described(module), encoding="utf-8")


def described(module):
    """Return a table of the public names of a module, a line each, and then each in full."""
    names = sorted(set(module.__all__) - {"__version__"}, key=str.swapcase)
    table = [".. autosummary::", "   :nosignatures:", ""]
    table += [f"   {module.__name__}.{name}" for name in names]
    entries = []
    for name in names:
        kind = "class" if inspect.isclass(getattr(module, name)) else "function"
        entries += [f".. auto{kind}:: {module.__name__}.{name}"]
        entries += ["   :members:"] * (kind == "class") + [""]
    return "\n".join([*table, "", *entries])


def setup(app):
    app.connect("builder-inited", write_generated)
