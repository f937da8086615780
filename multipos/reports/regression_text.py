"""Regressions as people read them: the tables of a text, which those of a page are as well.

`regression_text` returns the tests of every segment and its terms, `regression_sentence` how much
of the response is described, and by what. `tests_table`, `terms_table` and `path_table` are the
tables, `outline` says of what a regression is made, `jumps_and_balance` what it does at its edges
and where nothing heats or cools. `has_own_path` tells which segments were chosen by themselves.
"""

import math

import numpy as np

from multipos.files.numbers import chance, number, p_in_words, uncertain
from multipos.regression.regression import Regression, Regressions, all_of
from multipos.regression.segment import Segment, format_span
from multipos.reports.sections import PageTable

_Named = list[tuple[str, str]]  # what is said, each with what it is of


def regression_text(found: Regression | Regressions) -> str:
    """Return regressions as people read them: what each is made of, its tests, and its terms."""
    return "\n\n".join("\n".join(_text(r)) for r in all_of(found))


def _text(r: Regression) -> list[str]:
    said = [*outline(r), *jumps_and_balance(r)]
    lines = [*(f"{name:<10} {text}" for name, text in said), "", str(tests_table(r))]
    for i, segment in enumerate(r.segments):
        lines += ["", span_of(r, i), str(terms_table(segment, "")), *_runs_text(segment)]
        if segment.left_out:
            lines.append(f"left out: {', '.join(one.term for one in segment.left_out)}")
        if has_own_path(r, i):
            lines += _path_text(segment)
    return lines


def span_of(r: Regression, i: int) -> str:
    """Return a segment in words, with its number."""
    s = r.segments[i]
    return f"Segment {i + 1}: {format_span(r.range_variable, s.range, s.branch)}"


def has_own_path(r: Regression, i: int) -> bool:
    """Tell whether the path of a segment is shown: of those fitted together that of the last."""
    last = i + 1 == len(r.segments) or r.segments[i + 1].branch != r.segments[i].branch
    return last or not r.continuous


def outline(r: Regression) -> _Named:
    """Say of what the regression is made."""
    counted = f"{r.n} rows" + (f", {r.dropped} dropped" if r.dropped else "")
    limits = ", ".join(f"{k} {v:g}" for k, v in r.thresholds.items())
    method = f"{r.method} ({limits})" if limits else r.method
    past = ", of past rows" if r.causal else ""
    said = [
        ("response", f"{r.response}, {counted}"),
        ("terms", f"{len(r.candidates)} candidates, {method}"),
        ("time", r.time or "none: rows are taken as consecutive"),
        *(("rate", f"{name}: window {w:.6g}{past}") for name, w in r.rates.items()),
    ]
    if r.edges:
        edges = ", ".join(f"{edge:.6g}" for edge in r.edges)
        joined = ", continuous" if r.continuous else ""
        said.append(("edges", f"{r.segment_variable} = {edges}{joined}"))
    return said


def jumps_and_balance(r: Regression) -> _Named:
    """Say by how much segments differ where they meet, and what is predicted in balance."""
    said = []
    for j in r.junctions:
        where = f"{r.segment_variable} = {j.edge:.6g}" + (f", {j.branch}" if j.branch else "")
        said.append(("jump", f"at {where}: up to {uncertain(j.jump, j.u)}, U {number(j.U, 2)}"))
    return said if r.balance is None else [*said, ("balance", f"at rate 0{_balanced(r)}")]


def _balanced(r: Regression) -> str:
    """Say what is predicted where nothing heats or cools."""
    assert r.balance is not None  # which there is to say of
    b, inside = r.balance, ~r.balance.outside
    if not inside.any():
        return " nothing was measured: every prediction there is outside"
    ends = (float(v) for v in (b.predicted[inside].min(), b.predicted[inside].max()))
    low, high = (number(value, 4) for value in ends)
    beyond = int(b.outside.sum())
    said = f": {low} to {high}, U up to {number(float(b.U[inside].max()), 2)}"
    return said + (f"; {beyond} of {len(b.at)} temperatures are outside" if beyond else "")


def tests_table(r: Regression) -> PageTable:
    """Return the paper's table: F of every segment against its critical value."""
    robust = any(s.robust is not None for s in r.segments)
    fit = ("segment", "n", "k", "dof", "R²", "rms", "PRESS", "AICc", "F", f"F_{r.confidence:g}")
    header = (*fit, *(("F_robust", "p_robust") if robust else ()), "significant")
    rows = []
    for i, s in enumerate(r.segments, start=1):
        counts = (str(each) for each in (i, s.n, *s.dof))
        sizes = (number(s.r2), number(s.rms), number(s.press), number(s.aicc, 5), number(s.F))
        critical = "-" if math.isnan(s.F_critical) else f"{s.F_critical:.4f}"
        row = [*counts, *sizes, critical]
        if robust:
            row += ["-", "-"] if s.robust is None else [number(s.robust.F), chance(s.robust.p)]
        rows.append((*row, "yes" if s.significant else "no"))
    caption = "F of every segment on k and n − k − 1, against what chance exceeds"
    return PageTable(caption, header, tuple(rows))


def terms_table(s: Segment, caption: str) -> PageTable:
    """Return the terms of a segment with their tests."""
    robust = s.robust is not None
    header = ("term", "value(u)", "t", "p", *(("u_robust", "p_robust") if robust else ()))
    rows = []
    for c in s.coefficients:
        row = [c.term, uncertain(c.value, c.u), number(c.t), chance(c.p)]
        rows.append((*row, *((number(c.u_robust, 2), chance(c.p_robust)) if robust else ())))
    return PageTable(caption, header, tuple(rows))


def path_table(s: Segment, caption: str) -> PageTable:
    """Return how the terms of a segment were chosen, step by step."""
    rows = []
    for x in s.path:
        runner_up = ""
        if x.runner_up is not None:
            tested = x.runner_up
            runner_up = f"{tested.term} (F = {number(tested.F)}, {p_in_words(tested.p)})"
        step = f"{'+' if x.action == 'add' else '-'}{x.term}"
        rows.append((str(x.step), step, number(x.F, 6), chance(x.p), runner_up))
    return PageTable(caption, ("step", "term", "F", "p", "runner-up"), tuple(rows), left=2)


def _runs_text(s: Segment) -> list[str]:
    """Say by what runs differ."""
    if s.between is None:
        return []
    b = s.between
    listed = f"between {b.runs} runs: the constant by {b.sd:.2g} (sd on {b.runs - 1} dof)"
    if b.slope_sd is not None:
        listed += f", the slope of {b.variable} by {b.slope_sd:.2g}"
    return [listed]


def _path_text(s: Segment) -> list[str]:
    lines = ["", str(path_table(s, ""))] if s.path else []
    if s.runner_up is not None:
        lines.append(
            f"next: {s.runner_up.term}, F = {number(s.runner_up.F)} where "
            f"{number(s.runner_up.F_to_enter)} is needed, {p_in_words(s.runner_up.p)}"
        )
    return lines


def regression_sentence(found: Regression | Regressions) -> str:
    """Return how much of the response is described, and by what."""
    return " ".join(_described(r) for r in all_of(found))


def _described(r: Regression) -> str:
    n = np.array([s.n for s in r.segments], dtype=np.float64)
    rms = math.sqrt(float(n @ np.array([s.rms**2 for s in r.segments])) / float(n.sum()))
    least = min(s.r2 for s in r.segments)
    pieces = f"{len(r.segments)} segments" if len(r.segments) > 1 else "1 segment"
    significant = all(s.significant for s in r.segments)
    verdict = "" if significant else "; not significant"
    return (
        f"{r.response} by {', '.join(r.variables)}: R² {'at least ' if n.size > 1 else ''}"
        f"{number(least, 4)}, residual sd {number(rms, 3)}, {r.n} rows, {pieces}{verdict}."
    )
