"""The report as one HTML page, on paper, as Markdown or plain text, or as a digital certificate.

`report` writes everything there is to say of a result. `html_report`, `pdf_report`,
`markdown_report`, `plain_report` and `xml_report` each give one form of the content that
`certificate`, `regressions` and `fleet_report` collect. The HTML is one file: figures are inline
SVG, nothing is fetched and no script runs, and the same calibration gives the same bytes.
"""

import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from multipos.errors import UsageError
from multipos.files import numbers, whole
from multipos.files.spelling import StrPath, visible
from multipos.fleets.fleet import Fleet
from multipos.plots.style import COLOURS
from multipos.regression.regression import Regression, Regressions
from multipos.reports.certificate import Content, build_content
from multipos.reports.dcc import dcc_report
from multipos.reports.fleet_report import fleet_content
from multipos.reports.paper import paper_report
from multipos.reports.readable import aligned_rows, readable
from multipos.reports.regressions import regression_content
from multipos.reports.sections import Figure, Section, template
from multipos.sensor.calibration import Calibration
from multipos.uncertainty.monte_carlo import MonteCarlo
from multipos.verification.verdicts import Check


def html_report(content: Content) -> str:
    """Return a report as one self-contained HTML page."""
    import jinja2
    from markupsafe import Markup

    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        keep_trailing_newline=True,
        finalize=_without_controls,
    )

    def svg(figure: Figure, section: int, place: int) -> Any:
        return Markup(_inline(figure, f"f{section}-{place}"))

    number = content.lab.get("report.number", "")
    return environment.from_string(template("report.html")).render(
        content=content,
        number=number,
        running=_css_text(f"{content.title} {number}".strip()),
        leaf=_css_text("page "),
        svg=svg,
        aligned=aligned_rows,
        readable=readable,
        widest=_LONG_TABLE,
    )


def markdown_report(content: Content) -> str:
    """Return a report as Markdown."""
    line = numbers.markdown_line
    head = [f"# {content.title}", line(content.subtitle), f"**{line(readable(content.sentence))}**"]

    def listed(title: str, entries: Sequence[str]) -> str:
        return f"## {title}\n\n{_bullets(entries, line, _MARKDOWN_BREAK)}"

    return _assembled(content, head, listed, _markdown_section)


def plain_report(content: Content) -> str:
    """Return a report as plain text."""
    sentence = textwrap.fill(visible(readable(content.sentence)), 96)
    head = [_underlined(content.title, "="), visible(content.subtitle), sentence]

    def listed(title: str, entries: Sequence[str]) -> str:
        return f"{_underlined(title, '-')}\n{_bullets(entries, visible, _BREAK)}"

    return _assembled(content, head, listed, _plain_section)


def _assembled(
    content: Content,
    head: Sequence[str],
    listed: Callable[[str, Sequence[str]], str],
    write: Callable[[Section], list[str]],
) -> str:
    """Return a report: its head, findings, first section, administrative data, and the others."""
    fields = [f"{label}: {text}" for label, text in content.fields]
    front = (("Findings", [*map(readable, content.findings)]), ("Administrative data", fields))
    findings, administrative = ([listed(*each)] if each[1] else [] for each in front)
    first = [] if content.result is None else write(content.result)
    rest = [part for section in content.sections for part in write(section)]
    return "\n\n".join([*head, *findings, *first, *administrative, *rest]) + "\n"


def pdf_report(content: Content, progress: Callable[[int], object] = lambda _: None) -> bytes:
    """Return a report as PDF, by the extra `pdf` or an installed Chromium."""
    return paper_report(html_report(content), progress)


Reported = Calibration | Regression | Regressions | Fleet


def report(
    calibration: Reported,
    path: StrPath,
    *,
    lab: "StrPath | Mapping[str, Any] | None" = None,
    simulated: MonteCarlo | None = None,
    check: Check | None = None,
) -> None:
    """Write the report in the form that the file's ending asks for.

    `.html` is one page, `.pdf` the same on paper (by the extra `pdf` or an installed Chromium),
    `.md` Markdown, `.txt` plain text, and `.xml` a digital calibration certificate
    (`multipos.reports.dcc`), which holds the page.

    Parameters
    ----------
    calibration : Calibration, or what `regress` or `fleet` returns
        Only a calibration has a digital certificate, `simulated` and `check`; the report of a fleet
        is without a laboratory.
    path : path
        The rows of a regression, for its figures, are looked for beside it.
    lab : path or mapping, optional
        TOML file of what only the laboratory knows (`multipos.reports.laboratory.LAB_FIELDS`).
    simulated : MonteCarlo, optional
        What `multipos.uncertainty.monte_carlo` found, for the checks.
    check : Check, optional
        Of this calibration on an independent run: its errors, with the curve and the verdict.

    Raises
    ------
    UsageError
        Another ending, or nothing that has a report.
    MultiposError
        The lab file is at fault or lacks what a digital certificate needs, the check is of another
        calibration, or the report cannot be written.

    Examples
    --------
    >>> from pathlib import Path
    >>> import multipos as mp
    >>> mp.report(mp.demo().calibration, "report.md")
    >>> Path("report.md").read_text(encoding="utf-8").splitlines()[0]
    '# Calibration report'
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (*_FORMS, _CERTIFICATE):
        raise UsageError(
            f"the report's ending '{suffix}' is unknown; write it to a "
            f"{', '.join((*_FORMS, _CERTIFICATE))} file."
        )
    if isinstance(calibration, Calibration):
        content = build_content(calibration, lab=lab, simulated=simulated, check=check)
        if suffix == _CERTIFICATE:
            return whole.write_text(path, xml_report(calibration, content))
        return whole.write_text(path, _FORMS[suffix](content))
    if suffix == _CERTIFICATE or simulated is not None or check is not None:
        raise UsageError(
            "a digital certificate, `simulated` and `check` are of one calibration; write "
            f"anything else to a {', '.join(_FORMS)} file."
        )
    return whole.write_text(path, _FORMS[suffix](_content(calibration, path, lab)))


def _content(found: Reported, path: StrPath, lab: "StrPath | Mapping[str, Any] | None") -> Content:
    """Return what the report of anything but a calibration says."""
    if isinstance(found, Regression | Regressions):
        return regression_content(found, lab=lab, beside=path)
    if not isinstance(found, Fleet):
        raise UsageError(
            f"{type(found).__name__} has no report; give what fit, regress or fleet returned."
        )
    if lab is not None:
        raise UsageError("the report of a fleet has no `lab`.")
    return fleet_content(found.to_dict())


def xml_report(calibration: Calibration, content: Content) -> str:
    """Return a report as a digital calibration certificate, with the page inside."""
    return dcc_report(calibration, content, html_report(content))


# Between the lines of an entry of a list.
_BREAK, _MARKDOWN_BREAK = "\n  ", "\\\n  "
_LONG_TABLE = 40  # rows: beyond, a table may break over pages
_CERTIFICATE = ".xml"
_FORMS: dict[str, Callable[[Content], str | bytes]] = {
    ".html": html_report,
    ".pdf": pdf_report,
    ".md": markdown_report,
    ".txt": plain_report,
}


def _markdown_section(section: Section) -> list[str]:
    parts = [f"## {section.title}"]
    parts += [numbers.markdown_line(readable(paragraph)) for paragraph in section.paragraphs]
    for grid in section.tables:
        caption = numbers.markdown_text(readable(grid.caption))
        shown = numbers.markdown_table(
            list(map(readable, grid.header)), aligned_rows(grid, "", ""), left=grid.left
        )
        parts.append(f"**{caption}**\n\n{shown}")
    return parts


def _plain_section(section: Section) -> list[str]:
    parts = [_underlined(section.title, "-")]
    parts += [textwrap.fill(visible(readable(paragraph)), 96) for paragraph in section.paragraphs]
    for grid in section.tables:
        rows = aligned_rows(grid, " ", " ")
        shown = numbers.table(list(map(readable, grid.header)), rows, left=grid.left)
        parts.append(f"{visible(readable(grid.caption))}\n{shown}")
    return parts


def _bullets(entries: Sequence[str], show: Callable[[str], str], line_end: str) -> str:
    """Return entries as a list; one of several lines, such as an address, keeps them."""
    return "\n".join(f"- {line_end.join(map(show, entry.splitlines()))}" for entry in entries)


def _css_text(text: str) -> Any:
    """Return text as a string of a style sheet, every character that could end it as its code."""
    from markupsafe import Markup

    kept = "".join(
        mark if mark.isalnum() or mark in " -_." else f"\\{ord(mark):06x}" for mark in visible(text)
    )
    return Markup(f'"{kept}"')


def _without_controls(value: Any) -> Any:
    """Return what the page shows, with control characters but line ends made visible."""
    if type(value) is not str:
        return value
    return "\n".join(map(visible, value.splitlines()))


def _underlined(title: str, mark: str) -> str:
    return f"{title}\n{mark * numbers.columns_of(title)}"


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
