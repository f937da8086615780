"""Repeated regressions: whether their terms agree within their uncertainties.

`compare_regressions` compares repeats of one response term by term, by the test of `welch`.

R coefficients b_i of one term in one segment, with standard uncertainties u_i on ν_i degrees of
freedom and weights w_i = 1/u_i², are compared by Welch's test, which needs no equal variances:

    F = Σ w_i (b_i − b̃)²/(R − 1) / (1 + 2 (R − 2) Λ/(R² − 1)),   b̃ = Σ w_i b_i/Σ w_i,      (1)
    Λ = Σ (1 − w_i/Σ w)²/ν_i,       on R − 1 and (R² − 1)/(3 Λ) degrees of freedom.

All terms together are called inconsistent where the smallest p times their number is below
1 − confidence. A term that is not in every repeat has no p.

A regression of one switch-on knows nothing of the next: its constant is expected to move, and
``regress --run`` puts that into its u.

Sources: B. L. Welch, Biometrika 38, 1951.
"""

import math
from collections.abc import Sequence
from dataclasses import field
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.files.numbers import chance, number, table
from multipos.finding import Finding, Findings, in_order
from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import f_tail
from multipos.regression.regression import Regression
from multipos.regression.segment import Segment, format_span
from multipos.results import Drawn, Result, Tabular, frozen, plain_dict
from multipos.verification.repeat_findings import find_repeated_regressions


@frozen
class ComparedTerm(Result):
    """One term of one segment over the repeats.

    Attributes
    ----------
    response, segment, term : str
    values, u : (R,) arrays
        NaN where a repeat has not the term.
    sd, F, p : float
        Scatter of the values, and Welch's test of eq. (1).
    """

    response: str
    segment: str
    term: str
    values: Array
    u: Array
    sd: float
    F: float
    p: float


@frozen
class RegressionComparison(Result, Drawn, Tabular):
    """Repeated regressions.

    Attributes
    ----------
    files, created : tuple of R str
    terms : tuple of ComparedTerm
    confidence : float
    consistent : bool
    findings : tuple of Finding
        Those about each repeat, then ``repeated-runs``.
    """

    files: tuple[str, ...] = field(compare=False)
    created: tuple[str, ...] = field(compare=False)
    terms: tuple[ComparedTerm, ...]
    confidence: float
    consistent: bool
    findings: Findings = ()

    def columns(self) -> dict[str, Any]:
        """Return the terms: their values by run, sd, F and p."""
        of_terms = {
            name: [getattr(term, name) for term in self.terms]
            for name in ("response", "segment", "term", "sd", "F", "p")
        }
        runs = {
            f"run {i + 1}": [float(term.values[i]) for term in self.terms]
            for i in range(len(self.files))
        }
        return of_terms | runs

    def to_dict(self) -> dict[str, Any]:
        """Return everything as what JSON can carry."""
        runs = zip(self.files, self.created, strict=True)
        return plain_dict(
            {
                "regressions": [{"file": file, "created": made} for file, made in runs],
                "terms": [vars(term) for term in self.terms],
                "findings": self.findings,
                "consistent": self.consistent,
            }
        )

    def __str__(self) -> str:
        header = ["segment", "term", *(str(i + 1) for i in range(len(self.files))), "sd", "p"]
        rows = [
            [
                t.segment,
                t.term,
                *("-" if math.isnan(v) else number(v, 4) for v in t.values.tolist()),
                number(t.sd, 2),
                chance(t.p),
            ]
            for t in self.terms
        ]
        verdict = "agree" if self.consistent else "do not agree"
        named = [f"{i}: {file}" for i, file in enumerate(self.files, start=1)]
        closing = f"The repeats {verdict} at {100 * self.confidence:g} %, all terms together."
        shown = [*named, "", table(header, rows, left=2), "", closing]
        return "\n".join(shown) + "\n"


def compare_regressions(
    runs: Sequence[Sequence[Regression]], files: Sequence[str], confidence: float
) -> RegressionComparison:
    """Compare repeats, each of the same responses and segments.

    Parameters
    ----------
    runs : sequence of R sequences of Regression
        The responses of each repeat.
    files : sequence of R str
    confidence : float

    Raises
    ------
    MultiposError
        Their responses, edges or branches are not the same.
    """
    for run, file in zip(runs[1:], files[1:], strict=True):
        _check_alike(runs[0], run, file)
    terms = [
        term
        for repeats in zip(*runs, strict=True)
        for s in range(len(repeats[0].segments))
        for term in _compared(repeats, s)
    ]
    tested = [t.p for t in terms if not math.isnan(t.p)]
    consistent = not tested or min(tested) * len(tested) >= 1.0 - confidence
    findings = find_repeated_regressions(runs)
    if not consistent and not all(r.run for run in runs for r in run):
        text = "the change of bias from one switch-on to the next is not in U"
        action = "Fit several switch-ons with --run."
        findings += (Finding("turn-on", "warning", text, action),)
    return RegressionComparison(
        files=tuple(files),
        created=tuple(run[0].created for run in runs),
        terms=tuple(terms),
        confidence=confidence,
        consistent=consistent,
        findings=in_order(findings),
    )


def _check_alike(first: Sequence[Regression], other: Sequence[Regression], file: str) -> None:
    if len(first) != len(other) or any(
        a.response != b.response for a, b in zip(first, other, strict=True)
    ):
        raise MultiposError(
            f"{file}: describes {', '.join(r.response for r in other)} where the first describes "
            f"{', '.join(r.response for r in first)}; compare repeats of one response."
        )
    for a, b in zip(first, other, strict=True):
        if (a.segment_variable, a.edges, a.branch_column) != (
            b.segment_variable,
            b.edges,
            b.branch_column,
        ):
            raise MultiposError(
                f"{file}: its segments are others than those of the first; fit both with the same "
                "--segment."
            )


def _compared(repeats: Sequence[Regression], place: int) -> list[ComparedTerm]:
    segments = [r.segments[place] for r in repeats]
    names = list(dict.fromkeys(c.term for s in segments for c in s.coefficients))
    first = repeats[0]
    where = "all"
    if len(first.segments) > 1:
        s = first.segments[place]
        where = format_span(first.range_variable, s.range, s.branch)
    found: list[ComparedTerm] = []
    for name in names:
        estimates = zip(*(_of_term(s, name) for s in segments), strict=True)
        values, u, dof = (np.array(column, dtype=np.float64) for column in estimates)
        F, p = welch(values, u, dof)
        here = values[~np.isnan(values)]
        sd = float(here.std(ddof=1)) if len(here) > 1 else math.nan
        found.append(ComparedTerm(first.response, where, name, values, u, sd, F, p))
    return found


def _of_term(segment: Segment, name: str) -> tuple[float, float, float]:
    """Return value, u and degrees of freedom of a term; NaN where the segment has none such."""
    for c in segment.coefficients:
        if c.term == name:
            u = c.u if c.u_robust is None else c.u_robust
            return c.value, u, segment.robust_dof if c.dof is None else c.dof
    return math.nan, math.nan, math.nan


def welch(values: Array, u: Array, dof: Array) -> tuple[float, float]:
    """Return F and p of eq. (1); NaN where a value is missing or without uncertainty."""
    if np.isnan(values).any() or not (u > 0.0).all() or not (dof > 0.0).all():
        return math.nan, math.nan
    R, w = len(values), 1.0 / u**2
    mean = float(w @ values / w.sum())
    spread = float(((1.0 - w / w.sum()) ** 2 / dof).sum())
    F = float(w @ (values - mean) ** 2) / (R - 1)
    F /= 1.0 + 2.0 * (R - 2) * spread / (R**2 - 1)
    return F, f_tail(F, R - 1, (R**2 - 1) / (3.0 * spread))
