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

from multipos.files.numbers import chance, number, uncertain
from multipos.files.pipes import is_folder, is_there
from multipos.files.spelling import StrPath
from multipos.files.tables import Table, read_table
from multipos.finding import serious
from multipos.numerics.arrays import Array, Places
from multipos.plots.fits import complete_rows, corrected_rows, draw_path
from multipos.plots.style import COLOURS
from multipos.regression.junctions import Junction
from multipos.regression.regression import (
    Regression,
    Regressions,
    all_of,
    format_span,
    regression_sentence,
    require_same_data,
)
from multipos.regression.segment import Segment
from multipos.reports.certificate import Content, lab_fields, read_lab
from multipos.reports.sections import (
    LONG_TABLE,
    Figure,
    Language,
    PageTable,
    Section,
    Translator,
    draw_svg,
    method_section,
    with_annex,
)

_DRAWN = 1000  # rows of a figure, about: a page of 4000 would have 1.8 MB
_GOLDEN = 0.5 * (5.0**0.5 - 1.0)
Rows = Places
Titled = Callable[[str], str]  # the title of a section in a language, of a response


def regression_content(
    regression: Regression | Regressions,
    *,
    lab: "StrPath | Mapping[str, Any] | None" = None,
    data: StrPath | None = None,
    beside: StrPath | None = None,
    language: Language = "en",
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
    language : str
        'en' or 'zh'.

    Raises
    ------
    MultiposError
        The lab file is at fault, or `data` are not those of the fit.
    """
    tr = Translator(language)
    said = read_lab(lab)
    several = all_of(regression)
    table = _rows_of_fit(several[0], data, beside)
    sections: list[Section] = []
    results = []
    for r in several:
        of = partial(_titled, tr, r.response if len(several) > 1 else None)
        result, rest = _first(r, [_figures(r, table, of, tr), _tests(r, of, tr), _terms(r, of, tr)])
        results.append(replace(result, title=of("Result")))
        sections += [*results[1:][-1:], _knowledge(r, of, tr), *rest, *_paths(r, of, tr)]
    return Content(
        language=language,
        title=tr("Regression report"),
        subtitle=tr(
            "{responses} by {variables}",
            responses=tr.listed([r.response for r in several]),
            variables=tr.listed(several[0].variables),
        ),
        sentence=" ".join(tr.message(regression_sentence(r)) for r in several),
        unfit=False,
        result=results[0],
        findings=tuple(tr.message(each.text) for each in serious(regression.findings)),
        fields=lab_fields(said, tr),
        sections=with_annex((*sections, _method(several, tr)), tr),
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
    return first, [each for each in rest if each.figures or each.tables]


def _titled(tr: Translator, response: str | None, title: str) -> str:
    """Return the title of a section, of one response where there are several."""
    if response is None:
        return tr(title)
    return tr("{title} of {response}", title=tr(title), response=response)


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


def _knowledge(r: Regression, of: Titled, tr: Translator) -> Section:
    """Say what a user must know before relying on it."""
    first = tr(
        "The response {response} was described over {n} rows in {count} segments; valid only "
        "within the ranges in the tables.",
        response=r.response,
        n=str(r.n),
        count=str(len(r.segments)),
    )
    sentences = [first]
    between = next((s.between for s in r.segments if s.between is not None), None)
    if between is not None:
        sentences.append(
            tr(
                "{runs} switch-ons are separated by '{column}'; U includes the change of bias to "
                "the next.",
                runs=str(between.runs),
                column=str(r.run),
            )
        )
    worth = [
        tr("{rows} of {n}", rows=f"{s.robust.n_effective:.3g}", n=str(s.n))
        for s in r.segments
        if s.robust is not None
    ]
    if worth:
        said = "Noise of rows is correlated in time; independent rows: {rows}, by segment."
        sentences.append(tr(said, rows=tr.listed(worth)))
    if r.rates and not r.causal:
        sentences.append(tr("Rates need rows that come later: for a device fit it with --causal."))
    if r.cross_validation is not None:
        said = "On blocks of time, each left out once, the error is {rms} rms."
        sentences.append(tr(said, rms=f"{r.cross_validation['rms']:.3g}"))
    return Section(of("Notes"), paragraphs=tuple(sentences))


def _tests(r: Regression, of: Titled, tr: Translator) -> Section:
    """Return the paper's table: F of every segment against its critical value."""
    ends = (f"F_{r.confidence:g}", "F_robust", "R²", tr("rms"))
    header = (tr("segment"), "n", "k", "n − k − 1", "F", *ends)
    rows = []
    for s in r.segments:
        robust = "-" if s.robust is None else number(s.robust.F)
        mark = "" if s.significant else f" ({tr('not significant')})"
        rows.append(
            (
                f"{_span(r, s, tr)}{mark}",
                str(s.n),
                str(s.dof[0]),
                str(s.dof[1]),
                number(s.F),
                f"{s.F_critical:.4f}",
                robust,
                number(s.r2),
                number(s.rms, 3),
            )
        )
    caption = tr("F of every segment, against what chance exceeds")
    tables = [PageTable(caption, header, tuple(rows))]
    if r.junctions:
        jumps = tuple(
            (f"{j.edge:.6g}{_branch(j, tr)}", uncertain(j.jump, j.u), number(j.U, 2))
            for j in r.junctions
        )
        said = "Largest jump at every edge of {variable}"
        caption = tr(said, variable=str(r.segment_variable))
        tables.append(PageTable(caption, (tr("edge"), tr("jump(u)"), "U"), jumps))
    return Section(of("Tests"), tables=tuple(tables))


def _branch(j: Junction, tr: Translator) -> str:
    return f", {tr(j.branch)}" if j.branch else ""


def _terms(r: Regression, of: Titled, tr: Translator) -> Section:
    tables = []
    for s in r.segments:
        rows = tuple(
            (
                c.term,
                uncertain(c.value, c.u if c.u_robust is None else c.u_robust),
                number(c.t if c.t_robust is None else c.t_robust),
                chance(c.p if c.p_robust is None else c.p_robust),
            )
            for c in s.coefficients
        )
        caption = tr("Segment {span}", span=_span(r, s, tr))
        tables.append(PageTable(caption, (tr("term"), tr("value(u)"), "t", "p"), rows))
        limits = tuple((v, number(low, 6), number(high, 6)) for v, (low, high) in s.limits.items())
        header = (tr("variable"), tr("from"), tr("to"))
        tables.append(PageTable(tr("fitted over"), header, limits))
    return Section(of("Terms"), tables=tuple(tables))


def _paths(r: Regression, of: Titled, tr: Translator) -> list[Section]:
    """Return how the terms were chosen, drawn and in numbers."""
    chosen = [s for s in r.segments if s.path][: 1 if r.continuous else None]
    if not chosen:
        return []
    figures, tables = [], []
    for s in chosen:
        span = tr("all segments") if r.continuous else _span(r, s, tr)
        height = 0.8 + 0.22 * len(s.path)
        figures.append(
            Figure(
                tr("Path of terms, {span}", span=span),
                tr("F of every step; a diamond is the runner-up."),
                partial(draw_svg, tr, height, partial(draw_path, s)),
            )
        )
        rows = tuple(
            (
                str(step.step),
                f"{'+' if step.action == 'add' else '−'} {step.term}",
                number(step.F, 5),
                chance(step.p),
                "-" if step.runner_up is None else f"{step.runner_up.term} {step.runner_up.F:.4g}",
            )
            for step in s.path
        )
        header = (tr("step"), tr("term"), "F", "p", tr("runner-up"))
        tables.append(PageTable(tr("Steps, {span}", span=span), header, rows, left=2))
    return [Section(of("Path"), figures=tuple(figures), tables=tuple(tables))]


def _figures(r: Regression, table: Table | None, of: Titled, tr: Translator) -> Section:
    """Return before and after against the variable of the segments and against time."""
    if table is None:
        said = "The rows of the fit ({source}) are not here; --data draws before and after."
        sentences = tr(said, source=str(r.source))
        return Section(of("Before and after"), paragraphs=(sentences,))
    complete = complete_rows(r, table)
    _, before, after, variable, x = corrected_rows(r, complete)
    against: list[tuple[str, Array, Sequence[float]]] = [(variable, x, r.edges)]
    if r.time is not None and r.time != variable:
        against.append((r.time, complete.number(r.time), ()))
    shown = _rows_to_draw(after)
    which = ""
    if len(shown) < len(after):
        which = tr(" ({shown} of {n} rows)", shown=str(len(shown)), n=str(len(after)))

    def panels(label: str, x: Array, edges: Sequence[float]) -> Iterator[Callable[[Any], None]]:
        for y, word, below in ((before, "before", ""), (after, "after", label)):
            yield partial(_draw_one, x[shown], y[shown], edges, f"{r.response}, {word}", below)

    figures = tuple(
        Figure(
            tr("Before and after against {label}", label=label) + which,
            tr("Above before, below after, each on its own scale."),
            partial(draw_svg, tr, 1.9, *panels(label, values, edges)),
        )
        for label, values, edges in against
    )
    most, left = (float(np.abs(values).max()) for values in (before, after))
    rms, rms_left = (float(np.sqrt(np.mean(values**2))) for values in (before, after))
    sentences = tr(
        "Largest |{response}| {most} before and {left} after, rms {rms} and {rms_left}, on the "
        "rows of the fit; an independent run is what proves it (check).",
        response=r.response,
        most=f"{most:.4g}",
        left=f"{left:.4g}",
        rms=f"{rms:.4g}",
        rms_left=f"{rms_left:.4g}",
    )
    return Section(of("Before and after"), paragraphs=(sentences,), figures=figures)


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
    axes.set_ylabel(name)  # in English, as `Translator.svg` expects words
    axes.ticklabel_format(axis="y", scilimits=(-3, 4))
    axes.set_xlabel(below)


def _method(several: Sequence[Regression], tr: Translator) -> Section:
    r = several[0]
    rows = [
        (tr("Data"), r.source or tr("from memory")),
        (tr("SHA-256 of the data"), r.sha256 or "-"),
        (tr("Rows, left out"), f"{r.n}, {r.dropped}"),
        (tr("Method"), r.method + "".join(f", {k} {v:g}" for k, v in r.thresholds.items())),
        (tr("Candidates"), ", ".join(r.candidates)),
        *(
            (tr("Rate {name}", name=name), tr("window {width}", width=f"{w:.6g}"))
            for name, w in r.rates.items()
        ),
        (tr("Rates"), tr("of past rows") if r.causal else tr("of rows before and after")),
        (tr("Confidence"), f"{r.confidence:g}"),
        (tr("Computed"), f"{r.created}, multipos {r.version}"),
    ]
    return method_section(rows, tr)


def _span(r: Regression, s: Segment, tr: Translator) -> str:
    span = format_span(r.range_variable, s.range, None if s.branch is None else tr(s.branch))
    return span.replace(" to ", tr(" to "))
