"""Reports of a calibration, for people: a summary, and the whole as HTML, Markdown or text.

`text_report` is the summary that a fit prints: what was done, warnings first, the parameters as
value(u) with U, k and degrees of freedom, the residuals of every position, and how the result was
checked. `write_report` writes everything that `multipos.certificate` has to say. The HTML is one
file: figures are inline SVG, nothing is fetched and no script runs, and the same calibration gives
the same bytes.
"""

import math
import os
import re
import textwrap
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

from multipos.calibration import Calibration, labels, parameter_rows
from multipos.certificate import Content, build_content
from multipos.errors import UsageError
from multipos.files import write_text
from multipos.findings import Figure, Grid
from multipos.formatting import markdown_table, number, table
from multipos.monte_carlo import MonteCarlo
from multipos.plots.style import COLOURS

_Table = Callable[[Sequence[str], Sequence[Sequence[str]]], str]


def text_report(calibration: Calibration) -> str:
    """Return the report as plain text."""
    parts = []
    for title, body in _sections(calibration, table):
        parts.append(f"{title}\n{'-' * len(title)}\n{body}\n")
    return "\n".join(parts)


def html_report(content: Content) -> str:
    """Return a report as one self-contained HTML page."""
    import jinja2
    from markupsafe import Markup

    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, keep_trailing_newline=True
    )
    template = files("multipos").joinpath("templates", "report.html").read_text(encoding="utf-8")

    def svg(figure: Figure, section: int, place: int) -> Any:
        return Markup(_inline(figure, f"f{section}-{place}"))

    return environment.from_string(template).render(
        content=content, number=content.fields[0][1] or "", svg=svg
    )


def markdown_report(content: Content) -> str:
    """Return a report as Markdown."""
    parts = [f"# {content.title}", content.subtitle]
    parts += [f"## {title}\n\n{_bullets(lines)}" for title, lines in _front(content)]
    for section in content.sections:
        parts.append(f"## {section.title}")
        parts += section.paragraphs
        for grid in section.tables:
            rows = [[cell.replace("|", "\\|") for cell in row] for row in grid.rows]
            parts.append(f"**{grid.caption}**\n\n{markdown_table(grid.header, rows)}")
    return "\n\n".join(parts) + "\n"


def plain_report(content: Content) -> str:
    """Return a report as plain text."""
    parts = [_underlined(content.title, "="), content.subtitle]
    parts += [f"{_underlined(title, '-')}\n{_bullets(lines)}" for title, lines in _front(content)]
    for section in content.sections:
        parts.append(_underlined(section.title, "-"))
        parts += [textwrap.fill(paragraph, 96) for paragraph in section.paragraphs]
        parts += [f"{grid.caption}\n{_aligned(grid)}" for grid in section.tables]
    return "\n\n".join(parts) + "\n"


def write_report(
    calibration: Calibration,
    path: str | os.PathLike[str],
    *,
    lab: "str | os.PathLike[str] | Mapping[str, Any] | None" = None,
    language: str = "en",
    simulated: MonteCarlo | None = None,
) -> None:
    """Write the report in the form that the file's ending asks for: .html, .md or .txt.

    Parameters
    ----------
    calibration : Calibration
    path : path
    lab : path or mapping, optional
        TOML file of what only the laboratory knows (`multipos.certificate.LAB_FIELDS`).
    language : str
        'en' or 'zh'.
    simulated : MonteCarlo, optional
        What `multipos.monte_carlo` found, for the checks.

    Raises
    ------
    UsageError
        Another ending or language.
    MultiposError
        The lab file is at fault, or the report cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _FORMS:
        raise UsageError(
            f"the report's ending '{suffix}' is unknown; write it to a {', '.join(_FORMS)} file."
        )
    content = build_content(calibration, lab=lab, language=language, simulated=simulated)
    write_text(path, _FORMS[suffix](content))


_FORMS: dict[str, Callable[[Content], str]] = {
    ".html": html_report,
    ".md": markdown_report,
    ".txt": plain_report,
}


def _front(content: Content) -> list[tuple[str, list[str]]]:
    """Return warnings and administrative data as lines."""
    words = content.words
    open_field = f"[{words['to be filled in by the laboratory']}]"
    said = list(content.warnings) or [words["There is nothing to warn of."]]
    fields = [f"{label}: {text or open_field}" for label, text in content.fields]
    return [(words["Warnings"], said), (words["Administrative data"], fields)]


def _bullets(lines: Sequence[str]) -> str:
    return "\n".join(f"- {line}" for line in lines)


def _underlined(title: str, mark: str) -> str:
    return f"{title}\n{mark * _columns(title)}"


def _columns(text: str) -> int:
    """Return how many columns a terminal needs: Chinese characters take two."""
    return sum(2 if unicodedata.east_asian_width(mark) in "WF" else 1 for mark in text)


def _aligned(grid: Grid) -> str:
    cells = [grid.header, *grid.rows]
    widths = [max(_columns(row[i]) for row in cells) for i in range(len(grid.header))]
    lines = []
    for row in cells:
        parts = []
        for i, (cell, width) in enumerate(zip(row, widths, strict=True)):
            space = " " * (width - _columns(cell))
            parts.append(cell + space if i < grid.left else space + cell)
        lines.append("  ".join(parts).rstrip())
    return "\n".join(lines)


def _inline(figure: Figure, prefix: str) -> str:
    """Return a figure as inline SVG: own ids, the page's colours, and a text alternative."""
    text = figure.draw()
    text = re.sub(r'(id="|url\(#|xlink:href="#)', rf"\1{prefix}-", text)
    for i, colour in enumerate(COLOURS[:7], start=1):
        text = text.replace(colour, f"var(--c{i})")
    text = text.replace("#000000", "currentColor").replace(
        "stroke: #ffffff", "stroke: var(--paper)"
    )
    text = re.sub(r'<svg ([^>]*?)width="[^"]*" ', r"<svg \1", text, count=1)
    text = re.sub(r'<svg ([^>]*?)height="[^"]*" ', r"<svg \1", text, count=1)
    named = f'<svg role="img" aria-label="{escape(f"{figure.caption}. {figure.description}")}" '
    return text.replace("<svg ", named, 1)


def _sections(calibration: Calibration, draw: _Table) -> list[tuple[str, str]]:
    sections = [("Calibration", _summary(calibration))]
    said = [*calibration.diagnostics.warnings, *calibration.diagnostics.outliers]
    if said:
        sections.append(("Warnings", "\n".join(f"- {line}" for line in said)))
    header, rows = parameter_rows(calibration)
    sections.append(("Parameters", draw(header, rows)))
    sections.append(("Residuals", _residuals(calibration, draw)))
    sections.append(("Checks", _checks(calibration)))
    return sections


def _summary(calibration: Calibration) -> str:
    c = calibration
    gravity = "local, one g" if c.gravity is None else (
        f"{c.gravity.value:.10g} m/s^2, u = {c.gravity.u:.3g} m/s^2"
    )  # fmt: skip
    readings = c.readings
    counted = f"{len(readings)} of {', '.join(c.outputs)} [{c.model.unit}]"
    lines = [
        f"readings    {readings.source or 'from memory'}: {counted}",
        f"model       {c.model.text}, inputs {', '.join(c.model.inputs)}",
        f"convention  {c.convention}",
        f"gravity     {gravity}",
        *(f"at          {name} 0, where its terms vanish" for name in c.model.environment),
        f"estimator   {c.estimator}: {c.criterion}",
        f"created     {c.created}, multipos {c.version}",
    ]
    return "\n".join(lines)


def _residuals(calibration: Calibration, draw: _Table) -> str:
    c = calibration
    header = ["position", "x", "y", "z", *(f"{output} [{c.model.unit}]" for output in c.outputs)]
    rows = [
        [label, *(f"{value:.4g}" for value in reference), *(f"{value:+.3e}" for value in residual)]
        for label, reference, residual in zip(
            labels(c.readings), c.reference.tolist(), c.residuals.tolist(), strict=True
        )
    ]
    sd = ["s", "", "", "", *(number(value, 3) for value in c.residual_sd.tolist())]
    dof = ["dof", "", "", "", *(number(value) for value in c.dof.tolist())]
    return draw(header, [*rows, sd, dof])


def _checks(calibration: Calibration) -> str:
    c = calibration
    lines = [f"rms of what is left after compensation: {c.rms:.3e} g"]
    for output, found in c.linearity.items():
        lines.append(
            f"linearity of {output}: {number(found['without_model_percent'])} % without, "
            f"{number(found['with_model_percent'])} % with the model"
        )
    if c.cross_check is not None:
        lines.append(f"closed form against least squares: {c.cross_check:.1e} of a reading")
    lines.append(
        f"rank {c.diagnostics.rank} of {c.diagnostics.parameters}, "
        f"condition {c.diagnostics.condition:.3g}"
    )
    for output, test in c.diagnostics.lack_of_fit.items():
        p = test["p"]
        if isinstance(p, float) and math.isfinite(p):
            lines.append(f"lack of fit of {output} against repeats: p = {p:.3g}")
    return "\n".join(lines)
