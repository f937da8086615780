"""Sphinx settings: `sphinx-build -W docs docs/_build/html`."""

import importlib.util
import re
import sys
from pathlib import Path

import multipos

sys.path.insert(0, str(Path(__file__).parent))

from pictures import least_width  # after the path to it

project = "multipos"
author = "the multipos developers"
copyright = f"2026, {author}"
version = release = multipos.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.mathjax",
    "sphinx_copybutton",
]
# Why things are as they are, and where they stand, is of the repository and not of the site.
exclude_patterns = ["_build", "architecture.md", "decisions.md"]
html_theme = "furo"
html_title = "multipos"

# A laboratory may have no network: MathJax comes with a package, one file of it, and no fonts.
found = importlib.util.find_spec("sphinx-mathjax-offline")
mathjax = Path(found.submodule_search_locations[0], "static", "mathjax", "tex-svg.js")
html_static_path = [str(mathjax)]
mathjax_path = mathjax.name

# Who searches for what a fit said wants the page of messages first.
html_search_scorer = str(Path(__file__).with_name("scorer.js"))

# What is copied of a block is what one types, not what comes out.
copybutton_prompt_text = r">>> |\.\.\. |\$ |> "
copybutton_prompt_is_regexp = True
copybutton_line_continuation_character = "\\"

myst_enable_extensions = ["amsmath", "deflist", "dollarmath"]
myst_heading_anchors = 3
# Equations are numbered page by page, in the order of the page: code cites them by that number.
math_eqref_format = "({number})"


# Commands, and what they say in sentences, wrap on a narrow screen; tables are scrolled.
SENTENCE = re.compile(r'<span class="go">((?:(?!  |</span>).){40,})</span>')
COMMAND = re.compile(r'^((?:<div.*<pre>(?:<span></span>)?)?)(<span class="gp">.*)$', re.MULTILINE)
WRAPPED = (
    ".sentence {display: inline-block; max-width: 100%; white-space: pre-wrap}"
    "@media (max-width: 46em) {.highlight-text pre {white-space: pre-wrap}}"
)
# A figure is as wide as the page, or scrolled in its box where its labels would be too small;
# touched, it is shown by itself and can be made larger.
BOXED = "a.figure {display: block; overflow-x: auto}"
FIGURE = re.compile(r'<img [^>]*?src="([^"]+)"[^>]*/>')


def wrap_sentences(app, pagename, templatename, context, doctree):
    """Mark commands, answers and messages, to be wrapped, and link figures to their files."""
    if body := context.get("body"):
        body = SENTENCE.sub(r'<span class="go sentence">\1</span>', body)
        body = FIGURE.sub(_boxed, body)
        context["body"] = COMMAND.sub(_wrapped, body)
        context["body"] += f"<style>{WRAPPED}{BOXED}</style>"


def _boxed(image):
    kept = next(Path(__file__).parent.rglob(Path(image[1]).name))
    wide = image[0].replace("<img ", f'<img style="min-width: {least_width(kept)}px" ', 1)
    return f'<a class="figure" href="{image[1]}">{wide}</a>'


def _wrapped(line):
    if line[2].count("<span") != line[2].count("</span>"):  # a text goes on in the next line
        return line[0]
    return f'{line[1]}<span class="sentence">{line[2]}</span>'


def write_page(app, error):
    """Put the page that `docs/howto/page.md` embeds beside the built pages."""
    if error is None and app.builder.name == "html":
        from multipos.page.site import make_site, write_site

        write_site(Path(app.outdir) / "page", make_site())


def setup(app):
    app.connect("html-page-context", wrap_sentences)
    app.connect("build-finished", write_page)
