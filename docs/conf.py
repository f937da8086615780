"""Sphinx settings: `sphinx-build -W docs docs/_build/html`."""

import multipos

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
exclude_patterns = ["_build"]
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
