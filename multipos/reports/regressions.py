"""The page of a regression: what to know first, tests in the paper's form, terms, path, figures.

The figures need the rows of the fit, which a regression does not hold: they are drawn from the file
that stands beside it and has its checksum, or that is named. Before and after have an axis each,
because an error that is corrected a hundredfold is a flat line on the other's scale.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from multipos.files.numbers import number
from multipos.files.pipes import is_folder, is_there
from multipos.files.spelling import StrPath
from multipos.files.tables import Table, read_table
from multipos.finding import serious
from multipos.numerics.arrays import Array, Places
from multipos.plots.regressions import complete_rows, corrected_rows, draw_path
from multipos.plots.style import COLOURS
from multipos.regression.regression import Regression, Regressions, all_of, require_same_data
from multipos.reports.certificate import Content
from multipos.reports.laboratory import lab_fields, read_lab
from multipos.reports.regression_text import (
    has_own_path,
    jumps_and_balance,
    outline,
    path_table,
    regression_sentence,
    span_of,
    terms_table,
    tests_table,
)
from multipos.reports.sections import (
    LONG_TABLE,
    Figure,
    PageTable,
    Section,
    draw_svg,
    method_section,
    with_annex,
)

_DRAWN = 1000  # rows of a figure, about: a page of 4000 would have 1.8 MB
_GOLDEN = 0.5 * (5.0**0.5 - 1.0)
Rows = Places


def regression_content(
    regression: Regression | Regressions,
    *,
    lab: "StrPath | Mapping[str, Any] | None" = None,
    data: StrPath | None = None,
    beside: StrPath | None = None,
) -> Content:
    """Return what the report of a regression says.

    Parameters
    ----------
    regression : Regression or Regressions
    lab : path or mapping, optional
        What only the laboratory knows.
    data : path, optional
        The rows of the fit, for the figures.
    beside : path, optional
        A file in whose folder they are looked for otherwise.

    Raises
    ------
    MultiposError
        The lab file is at fault, or `data` are not those of the fit.
    """
    said = read_lab(lab)
    several = all_of(regression)
    table = _rows_of_fit(several[0], data, beside)
    sections: list[Section] = []
    results = []
    for r in several:
        of = f" of {r.response}" if len(several) > 1 else ""
        result, rest = _first(r, [_figures(r, table, of), _tests(r, of), _terms(r, of)])
        results.append(replace(result, title=f"Result{of}"))
        sections += [*results[1:][-1:], _knowledge(r, of), *rest, *_paths(r, of)]
    return Content(
        title="Regression report",
        subtitle=f"{', '.join(r.response for r in several)} by {', '.join(several[0].variables)}",
        sentence=" ".join(regression_sentence(r) for r in several),
        unfit=False,
        result=results[0],
        findings=tuple(each.text for each in serious(regression.findings)),
        fields=lab_fields(said),
        sections=with_annex((*sections, _method(several))),
        lab=said,
    )


def _first(r: Regression, sections: list[Section]) -> tuple[Section, list[Section]]:
    """Return what comes first of before and after, tests and terms, and the sections of the rest.

    The table is that of the terms where there is one segment, else that of the segments.
    """
    place = 2 if len(r.segments) == 1 else 1
    figures, holds = sections[0], sections[place]
    rest = [*sections]
    rest[0] = replace(figures, paragraphs=(), figures=figures.figures[1:])
    rest[place] = replace(holds, tables=holds.tables[1:])
    first = replace(figures, figures=figures.figures[:1], tables=holds.tables[:1])
    return first, [each for each in rest if each.paragraphs or each.figures or each.tables]


def _rows_of_fit(r: Regression, data: StrPath | None, beside: StrPath | None) -> Table | None:
    """Return the table of the fit, known by its checksum; None where it is not to be found."""
    if data is None:
        if r.source is None or beside is None:
            return None
        there = Path(beside).parent / r.source
        if not is_there(there) or is_folder(there):
            return None
        found = read_table(there, what="data")
        return found if found.sha256 == r.sha256 else None
    found = read_table(data, what="data")
    require_same_data(r, found.source, found.sha256)
    return found


def _knowledge(r: Regression, of: str) -> Section:
    """Say what a user must know before relying on it."""
    sentences = [
        f"The response {r.response} was described over {r.n} rows in {len(r.segments)} segments.",
        "It is valid only within the ranges in the tables.",
    ]
    between = next((s.between for s in r.segments if s.between is not None), None)
    if between is not None:
        sentences.append(
            f"{between.runs} switch-ons are separated by '{r.run}'; U includes the change of bias "
            "to the next."
        )
    worth = [f"{s.robust.n_effective:.3g} of {s.n}" for s in r.segments if s.robust is not None]
    if worth:
        said = "Noise of rows is correlated in time; independent rows"
        sentences.append(f"{said}: {', '.join(worth)}, by segment.")
    if r.rates and not r.causal:
        sentences.append("Rates need rows that come later: for a device fit it with --causal.")
    return Section(f"Notes{of}", paragraphs=tuple(sentences))


def _tests(r: Regression, of: str) -> Section:
    said = tuple(f"{name.capitalize()} {text}." for name, text in jumps_and_balance(r))
    return Section(f"Tests{of}", paragraphs=said, tables=(tests_table(r),))


def _terms(r: Regression, of: str) -> Section:
    tables = []
    for i, s in enumerate(r.segments):
        tables.append(terms_table(s, span_of(r, i)))
        limits = tuple((v, number(low, 6), number(high, 6)) for v, (low, high) in s.limits.items())
        tables.append(PageTable("fitted over", ("variable", "from", "to"), limits))
    return Section(f"Terms{of}", tables=tuple(tables))


def _paths(r: Regression, of: str) -> list[Section]:
    """Return how the terms were chosen, drawn and in numbers."""
    figures, tables = [], []
    for i, s in enumerate(r.segments):
        if not (s.path and has_own_path(r, i)):
            continue
        span = "all segments" if r.continuous else span_of(r, i)
        draw = partial(draw_svg, 0.8 + 0.22 * len(s.path), partial(draw_path, s))
        said = "F of every step; a diamond is the runner-up."
        figures.append(Figure(f"Path of terms, {span}", said, draw))
        tables.append(path_table(s, f"Steps, {span}"))
    return [Section(f"Path{of}", figures=tuple(figures), tables=tuple(tables))] if tables else []


def _figures(r: Regression, table: Table | None, of: str) -> Section:
    """Return before and after against the variable of the segments and against time."""
    if table is None:
        sentences = f"The rows of the fit ({r.source}) are not here; --data draws before and after."
        return Section(f"Before and after{of}", paragraphs=(sentences,))
    complete = complete_rows(r, table)
    _, before, after, variable, x = corrected_rows(r, complete)
    against: list[tuple[str, Array, Sequence[float]]] = [(variable, x, r.edges)]
    if r.time is not None and r.time != variable:
        against.append((r.time, complete.number(r.time), ()))
    shown = _rows_to_draw(after)
    which = ""
    if len(shown) < len(after):
        which = f" ({len(shown)} of {len(after)} rows)"

    def panels(label: str, x: Array, edges: Sequence[float]) -> Iterator[Callable[[Any], None]]:
        for y, word, below in ((before, "before", ""), (after, "after", label)):
            yield partial(_draw_one, x[shown], y[shown], edges, f"{r.response}, {word}", below)

    figures = tuple(
        Figure(
            f"Before and after against {label}{which}",
            "Above before, below after, each on its own scale.",
            partial(draw_svg, 1.9, *panels(label, values, edges)),
        )
        for label, values, edges in against
    )
    most, left = (float(np.abs(values).max()) for values in (before, after))
    rms, rms_left = (float(np.sqrt(np.mean(values**2))) for values in (before, after))
    sentences = (
        f"Largest |{r.response}| {most:.4g} before and {left:.4g} after, rms {rms:.4g} and "
        f"{rms_left:.4g}, on the rows of the fit; an independent run is what proves it (check)."
    )
    return Section(f"Before and after{of}", paragraphs=(sentences,), figures=figures)


def _rows_to_draw(after: Array) -> Rows:
    """Return the rows of a figure: all, or some evenly in time with those of largest |error|.

    Every k-th row would show one phase of what repeats: multiples of the golden ratio do not.
    """
    if len(after) <= _DRAWN:
        return np.arange(len(after))
    even = np.flatnonzero((np.arange(len(after)) * _GOLDEN) % 1.0 < _DRAWN / len(after))
    largest = np.argsort(-np.abs(after), kind="stable")[:LONG_TABLE]
    return np.union1d(even, largest)


def _draw_one(
    x: Array, values: Array, edges: Sequence[float], name: str, below: str, axes: Any
) -> None:
    colour = COLOURS[0] if below else COLOURS[6]
    axes.plot(x, values, color=colour, marker=".", linestyle="none", markersize=3.0)
    axes.axhline(0.0, color="#000000", linewidth=0.5)
    for edge in edges:
        axes.axvline(edge, color="#000000", linewidth=0.8, linestyle="--")
    axes.set_ylabel(name)
    axes.ticklabel_format(axis="y", scilimits=(-3, 4))
    axes.set_xlabel(below)


def _method(several: Sequence[Regression]) -> Section:
    r = several[0]
    rows = [
        ("Data", r.source or "from memory"),
        ("SHA-256 of the data", r.sha256 or "-"),
        *((name.capitalize(), text) for name, text in outline(r)),
        ("Candidates", ", ".join(r.candidates)),
        ("Confidence", f"{r.confidence:g}"),
        ("Computed", f"{r.created}, multipos {r.version}"),
    ]
    return method_section(rows)
