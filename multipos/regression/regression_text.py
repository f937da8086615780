"""Regressions as people read them.

`regression_text` returns the tests of every segment and its terms, `regression_sentence` how much
of the response is described, and by what.
"""

import math

import numpy as np

from multipos.files.numbers import chance, number, p_in_words, table, uncertain
from multipos.numerics.selection import Tested
from multipos.regression.regression import Regression, Regressions, all_of
from multipos.regression.segment import Segment, format_span


def regression_text(found: Regression | Regressions) -> str:
    """Return regressions as people read them: what each is made of, its tests, and its terms."""
    return "\n\n".join("\n".join(_text(r)) for r in all_of(found))


def _text(r: Regression) -> list[str]:
    lines = [*_outline(r), *_jumps(r), *_balanced(r), "", _overview(r)]
    for i, segment in enumerate(r.segments, start=1):
        span = format_span(r.range_variable, segment.range, segment.branch)
        lines += ["", f"Segment {i}: {span}", *_segment_text(segment), *_runs_text(segment)]
        if segment.left_out:
            lines.append(f"left out: {', '.join(one.term for one in segment.left_out)}")
        last = i == len(r.segments) or r.segments[i].branch != segment.branch
        if last or not r.continuous:  # segments fitted together share their path
            lines += _path_text(segment)
    return lines


def _outline(r: Regression) -> list[str]:
    """Say of what the regression is made."""
    counted = f"{r.n} rows" + (f", {r.dropped} dropped" if r.dropped else "")
    limits = ", ".join(f"{k} {v:g}" for k, v in r.thresholds.items())
    method = f"{r.method} ({limits})" if limits else r.method
    lines = [
        f"response   {r.response}, {counted}",
        f"terms      {len(r.candidates)} candidates, {method}",
    ]
    past = ", of past rows" if r.causal else ""
    lines += [f"rate       {name}: window {w:.6g}{past}" for name, w in r.rates.items()]
    if r.edges:
        edges = ", ".join(f"{edge:.6g}" for edge in r.edges)
        joined = ", continuous" if r.continuous else ""
        lines.append(f"edges      {r.segment_variable} = {edges}{joined}")
    return lines


def _jumps(r: Regression) -> list[str]:
    """Say by how much segments differ where they meet."""
    lines = []
    for j in r.junctions:
        where = f"{r.segment_variable} = {j.edge:.6g}" + (f", {j.branch}" if j.branch else "")
        lines.append(f"jump       at {where}: up to {uncertain(j.jump, j.u)}, U {number(j.U, 2)}")
    return lines


def _balanced(r: Regression) -> list[str]:
    """Say what is predicted where nothing heats or cools."""
    if r.balance is None:
        return []
    b, inside = r.balance, ~r.balance.outside
    if not inside.any():
        return ["balance    at rate 0 nothing was measured: every prediction there is outside"]
    low, high = (
        number(float(v), 4) for v in (b.predicted[inside].min(), b.predicted[inside].max())
    )
    said = f"balance    at rate 0: {low} to {high}, U up to {number(float(b.U[inside].max()), 2)}"
    beyond = int(b.outside.sum())
    return [said + (f"; {beyond} of {len(b.at)} temperatures are outside" if beyond else "")]


def _overview(r: Regression) -> str:
    robust = any(s.robust is not None for s in r.segments)
    header = [
        "segment",
        "n",
        "k",
        "dof",
        "R²",
        "rms",
        "PRESS",
        "AICc",
        "F",
        f"F_{r.confidence:g}",
        *(["F_robust", "p_robust"] if robust else []),
        "significant",
    ]
    rows = []
    for i, s in enumerate(r.segments, start=1):
        row = [
            str(i),
            str(s.n),
            str(s.dof[0]),
            str(s.dof[1]),
            number(s.r2),
            number(s.rms),
            number(s.press),
            number(s.aicc, 5),
            number(s.F),
            f"{s.F_critical:.4f}",
        ]
        if robust:
            row += ["-", "-"] if s.robust is None else [number(s.robust.F), chance(s.robust.p)]
        rows.append([*row, "yes" if s.significant else "no"])
    return table(header, rows)


def _segment_text(s: Segment) -> list[str]:
    robust = s.robust is not None
    header = ["term", "value(u)", "t", "p", *(["u_robust", "p_robust"] if robust else [])]
    rows = [
        [
            c.term,
            uncertain(c.value, c.u),
            number(c.t),
            chance(c.p),
            *([number(c.u_robust, 2), chance(c.p_robust)] if robust else []),
        ]
        for c in s.coefficients
    ]
    return [table(header, rows)]


def _tested_text(tested: Tested) -> str:
    return f"{tested.term} (F = {number(tested.F)}, {p_in_words(tested.p)})"


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
    lines = []
    if s.path:
        steps = [
            [
                str(x.step),
                f"{'+' if x.action == 'add' else '-'}{x.term}",
                number(x.F, 6),
                chance(x.p),
                "" if x.runner_up is None else _tested_text(x.runner_up),
            ]
            for x in s.path
        ]
        lines += ["", table(["step", "term", "F", "p", "runner-up"], steps, left=2)]
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
