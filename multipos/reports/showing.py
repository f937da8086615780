"""Results that show themselves: in a notebook as HTML, printed as a summary, drawn on axes.

`show_text` prints one as its command does, `show_html` is compact: findings first, then a table or
the summary, and one figure, without styles or scripts of a page around it; `draw` draws the figure
alone. `Result` finds this module by its name, for results stand above all reports and know none.
"""

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from hashlib import sha256
from html import escape
from types import UnionType
from typing import Any

import numpy as np

from multipos.bias_stability.stability_result import Stability
from multipos.bias_stability.stability_text import stability_sentence, stability_text
from multipos.designs.assessment import Schemes, scheme_rows, schemes_sentence, schemes_text
from multipos.designs.designing import Design, design_sentence, design_text
from multipos.errors import MultiposError, UsageError
from multipos.files.numbers import number
from multipos.files.spelling import visible
from multipos.finding import NOT_FIT, Findings, errors_of, serious
from multipos.fleets.fleet import Fleet
from multipos.fleets.fleet_text import fleet_sentence, fleet_text
from multipos.logs.averages import Averages, averages_sentence, averages_text
from multipos.plots import (
    calibration,
    checks,
    curves,
    fleets,
    runs,
    schemes,
    stability,
    style,
    tumble,
)
from multipos.positions.scheme import Scheme
from multipos.regression.regression import Regression, Regressions
from multipos.reports.check_text import check_sentence, check_tables, check_text, run_conclusions
from multipos.reports.quantities import parameter_cells
from multipos.reports.regression_text import regression_sentence, regression_text
from multipos.reports.summary import calibration_sentence
from multipos.reports.tumble_text import tumble_sentence, tumble_text
from multipos.reports.turntable_text import table_errors_text
from multipos.results import Columns, Result
from multipos.sensor.calibration import Calibration
from multipos.sensor.temperature import Curve
from multipos.uncertainty.propagation import Evaluation
from multipos.uncertainty.turntable import TableErrors
from multipos.verification import comparison_text
from multipos.verification.comparison import Comparison
from multipos.verification.regression_repeats import RegressionComparison
from multipos.verification.tumbling import Tumble, Tumbles
from multipos.verification.verdicts import Check

_LINES = 60  # of a summary that a notebook shows
_ROWS = 10  # of a table of columns, half of them from its end
_WIDE = 12  # columns
_PARAMETERS = 3  # of a fleet that are drawn
_PAPER = "background:#ffffff;color:#000000;max-width:46rem"  # also where the notebook is dark
_TEXTS: dict[type, Callable[[Any], str]] = {
    Averages: averages_text,
    Check: check_text,
    Comparison: comparison_text.comparison_text,
    Design: design_text,
    Fleet: lambda found: f"{fleet_sentence(found.summary)}\n\n{fleet_text(found.summary)}",
    Regression: regression_text,
    Regressions: regression_text,
    Schemes: schemes_text,
    Stability: stability_text,
    TableErrors: table_errors_text,
    Tumble: tumble_text,
    Tumbles: tumble_text,
}
_SENTENCES: dict[type | UnionType, Callable[[Any], str]] = {
    Averages: averages_sentence,
    Calibration: calibration_sentence,
    Check: check_sentence,
    Comparison | RegressionComparison: comparison_text.comparison_sentence,
    Design: design_sentence,
    Fleet: lambda found: fleet_sentence(found.summary),
    Regression | Regressions: regression_sentence,
    Schemes: schemes_sentence,
    Stability: stability_sentence,
    Tumble | Tumbles: tumble_sentence,
}


def show_text(found: Result) -> str:
    """Return a result as its command prints it; one that no command prints as a line a field."""
    write = _TEXTS.get(type(found))
    if write is not None:
        return write(found).rstrip("\n")
    fields = _fields(found)
    width = max((len(name) for name, _ in fields), default=0)
    lines = [f"  {name:{width}}  {visible(text)}" for name, text in fields]
    return "\n".join([type(found).__name__, *lines])


def show_html(found: Result | Columns) -> str:
    """Return a result as a notebook shows it."""
    if isinstance(found, Columns):
        return _columns(found)
    say = next((say for kind, say in _SENTENCES.items() if isinstance(found, kind)), None)
    said = "" if say is None else f" {_text(say(found))}"
    head = f"<p><strong>{type(found).__name__}</strong>{said}</p>"
    parts = [head, *_findings(found), _body(found)]
    panels = _panels(found)
    if panels:
        try:
            figure = style.to_svg(style.figure_of(panels))
        except MultiposError as error:  # the rest is worth more than its figure
            return f'<div class="multipos">{"".join(parts)}<p>{_text(str(error))}</p></div>'
        parts.append(f'<div style="{_PAPER}">{_own_ids(figure)}</div>')
    return f'<div class="multipos">{"".join(parts)}</div>'


def draw(found: Result, axes: Any = None) -> Any:
    """Draw a result, and return the axes: one, or as many as it has panels.

    Parameters
    ----------
    found : Result
    axes : Axes or sequence of them, optional
        As many as there are panels; those of a new figure where not given.

    Raises
    ------
    UsageError
        There is no figure of it, or the axes are too many or too few.
    """
    panels = _panels(found)
    if not panels:
        raise UsageError(f"there is no figure of this {type(found).__name__}.")
    if axes is None:
        axes = style.new_figure(len(panels))[1]
    given = list(axes) if isinstance(axes, Iterable) else [axes]
    if len(given) != len(panels):
        raise UsageError(
            f"`ax` must be {len(panels)} axes, a panel each, got {len(given)}; leave it out for "
            "a new figure."
        )
    for panel, one in zip(panels, given, strict=True):
        panel(one)
    return given[0] if len(given) == 1 else given


def _panels(found: Result) -> list[Callable[[Any], None]]:
    """Return what draws each panel of the figure of a result; none where there is none."""
    if isinstance(found, Calibration):
        if math.isfinite(found.rms):  # else an output does not respond
            return [partial(calibration.draw_errors, found)]
        return calibration.residual_panels(found)
    if isinstance(found, Check):
        return checks.check_panels(found)
    if isinstance(found, Tumble):
        return [partial(tumble.draw_signal, found), partial(tumble.draw_residual_harmonics, found)]
    if isinstance(found, Tumbles):
        return [partial(tumble.draw_signal, one) for one in found.outputs.values()]
    if isinstance(found, Design):
        return [partial(schemes.draw_scheme, found.columns())]
    if isinstance(found, Fleet):
        drawn = fleets.limited(found.summary["parameters"], _PARAMETERS)
        return [partial(fleets.draw_histogram, each) for each in drawn]
    one = _ONE_PANEL.get(type(found))
    return [] if one is None else [partial(one, found)]


_ONE_PANEL: dict[type, Callable[[Any, Any], None]] = {
    Comparison: runs.draw_runs,
    Curve: curves.draw_curve,
    Evaluation: calibration.draw_budget,
    RegressionComparison: runs.draw_terms,
    Scheme: schemes.draw_scheme,
    Stability: stability.draw_allan,
}


def _findings(found: Result) -> list[str]:
    """Return errors and warnings as a list, that it is not fit for use before."""
    findings: Findings = getattr(found, "findings", ())
    lines = "".join(f"<li>{_text(str(each))}</li>" for each in serious(findings))
    said = errors_of(findings) and not isinstance(found, tuple(_SENTENCES))
    head = [f"<p><strong>{NOT_FIT}</strong></p>"] if said else []
    return [*head, *([f"<ul>{lines}</ul>"] if lines else [])]


def _body(found: Result) -> str:
    """Return the table of a result, or its summary."""
    if isinstance(found, Calibration):
        cells = parameter_cells(found.entries)
        rows = [(p.name, *row) for p, row in zip(found.entries, cells, strict=True)]
        return _table(("parameter", "value", "u", "U", "unit"), rows)
    if isinstance(found, Check):
        by_axis = check_tables(found)[0]
        said = "".join(f"<p>{_text(line)}</p>" for line in run_conclusions(found))
        return _table(by_axis.header, by_axis.rows) + said
    if isinstance(found, Comparison) and found.changes:
        return f"<pre>{_text(comparison_text.changes_text(found))}</pre>"
    if isinstance(found, Schemes):
        return _table(*scheme_rows(found.schemes))
    if type(found) in _TEXTS or type(found).__str__ is not Result.__str__:
        lines = str(found).splitlines()
        more = ["…"] if len(lines) > _LINES else []
        return f"<pre>{_text(chr(10).join([*lines[:_LINES], *more]))}</pre>"
    return _table(("", ""), _fields(found), left=2)


def _fields(found: Result) -> list[tuple[str, str]]:
    """Return the fields of a result, each in a few words."""
    return [(name, _short(getattr(found, name))) for name in found.__dataclass_fields__]


def _columns(found: Mapping[str, Any]) -> str:
    """Return the first and last rows of a table of columns."""
    names = list(found)
    shown = names[:_WIDE]
    rows = len(found[names[0]]) if names else 0
    half = _ROWS // 2
    places = range(rows) if rows <= _ROWS else [*range(half), *range(rows - half, rows)]
    cells = [[str(place), *(_short(found[name][place]) for name in shown)] for place in places]
    if rows > _ROWS:
        cells.insert(half, ["…"] * (1 + len(shown)))
    more = "" if len(shown) == len(names) else f", of which {len(shown)} are shown"
    return (
        f'<div class="multipos">{_table(("", *shown), cells)}'
        f"<p>{rows} rows, {len(names)} columns{more}</p></div>"
    )


def _short(value: Any) -> str:
    if isinstance(value, float):
        return number(value, 6)
    if isinstance(value, np.ndarray) and value.size > _ROWS:
        return f"array {' × '.join(map(str, value.shape))}"
    if isinstance(value, Result):
        return type(value).__name__
    text = value if isinstance(value, str) else repr(value)
    return text if len(text) <= _LINES else f"{text[: _LINES - 1]}…"


def _table(header: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> str:
    head = "".join(f"<th>{_text(cell)}</th>" for cell in header)
    lines = []
    for row in rows:
        cells = (
            f'<td style="text-align:{"left" if i < left else "right"}">{_text(cell)}</td>'
            for i, cell in enumerate(row)
        )
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table>"


def _text(text: str) -> str:
    return escape("\n".join(map(visible, text.split("\n"))))


def _own_ids(svg: str) -> str:
    """Return a figure whose ids are its own, for a notebook is one page with many figures."""
    prefix = "m" + sha256(svg.encode()).hexdigest()[:8]
    return re.sub(r'(id="|url\(#|xlink:href="#)', rf"\1{prefix}-", svg)
