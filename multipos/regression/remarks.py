"""What a reader should know before relying on a regression, as findings.

`find_in_choice` says what the choice of terms and each segment leave open, `find_in_segments`
where nothing tests a segment and where its rows are correlated, `find_collinear` which variables
nearly follow from others, `find_jumps` where the model jumps, `find_imbalance` where nothing was
measured in thermal balance, `find_switch_on` that one switch-on says nothing of the next.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from multipos.files.numbers import p_in_words
from multipos.finding import Finding, Findings
from multipos.numerics.terms import CONSTANT, linear_term
from multipos.regression.junctions import Junction
from multipos.regression.observations import Data
from multipos.regression.piecewise import Plan
from multipos.regression.regression import Balance, Regression
from multipos.regression.runs import within_runs
from multipos.regression.segment import Segment
from multipos.regression.variation import variance_inflation

_MOST_NAMED = 3  # variables
_INFLATED = 10.0  # variance of a coefficient, over what its column alone would give
_ENDS = 0.1  # share of the points in balance that may be outside, at the ends of the range


def find_in_choice(plan: Plan, segments: Sequence[Segment]) -> list[Finding]:
    """Say what the choice of terms and each segment leave open."""
    said = []
    if plan.limits is not None:
        text = "terms were chosen by the data that test them: F and p of the model are optimistic"
        action = "Confirm it by another run with check."
        said.append(Finding("selected-terms", "note", text, action))
    for where, segment in _named(segments):
        said += _find_in_segment(plan, segment, where)
    return said


def find_in_segments(segments: Sequence[Segment]) -> Findings:
    """Find segments that nothing tests, and rows whose noise is correlated, once for all."""
    found, fewer = [], []
    for where, segment in _named(segments):
        robust = segment.robust
        if segment.dof[0] > 0 and segment.dof[1] == 0:
            text = f"{where}: as many terms as rows, so there are no residuals to test it"
            action = "Add rows, or drop terms."
            found.append(Finding("no-redundancy", "warning", text, action))
        if robust is not None and robust.n_effective != segment.n:
            fewer.append((segment.n, robust.n_effective, robust.lag_one))
    if fewer:
        rows, equal, lag = (list(each) for each in zip(*fewer, strict=True))
        count = equal[0] if len(set(equal)) == 1 else sum(equal)  # one number is of all segments
        text = (
            f"noise of neighbouring rows is correlated ({max(lag):.2f}); {sum(rows)} rows equal "
            f"about {count:.0f} independent ones"
        )
        action = "Judge terms by F_robust."
        found.append(Finding("time-correlated", "warning", text, action))
    return tuple(found)


def _named(segments: Sequence[Segment]) -> Iterator[tuple[str, Segment]]:
    """Yield segments with what they are called."""
    for number, segment in enumerate(segments, start=1):
        yield f"segment {number}" if len(segments) > 1 else "the model", segment


def find_collinear(result: Regression, data: Data) -> Findings:
    """Name the variable of each segment that nearly follows from others, where none tells it.

    Judged by their linear terms: products and powers of one variable depend on where its zero is.
    """
    place = result.segment_of(data.columns)
    found = []
    for number, (where, segment) in enumerate(_named(result.segments)):
        linear = [v for v in result.variables if linear_term(v) in segment.terms]
        if not segment.significant or CONSTANT not in segment.terms or len(linear) < 2:
            continue
        rows = data.take(np.flatnonzero(place == number))
        columns = within_runs(np.column_stack([rows.columns[v] for v in linear]), rows)[0]
        inflation = dict(zip(linear, variance_inflation(columns).tolist(), strict=True))
        tested = {c.term: c.p if c.p_robust is None else c.p_robust for c in segment.coefficients}
        beyond = [v for v in linear if inflation[v] > _INFLATED]
        weak = [v for v in beyond if tested[v] > 1.0 - result.confidence]
        if weak:
            name = max(weak, key=inflation.__getitem__)
            others = ", ".join([v for v in beyond if v != name][:_MOST_NAMED])
            text = (
                f"{where}: {name} nearly follows from {others}: the variance of its coefficient is "
                f"{inflation[name]:.3g} times as large, and its value undetermined"
            )
            found.append(Finding("collinear-terms", "warning", text, f"Leave out {name}."))
    return tuple(found)


def find_jumps(variable: str | None, junctions: Sequence[Junction]) -> Findings:
    """Name the largest jump that is none by chance, and the way without."""
    clear = [j for j in junctions if j.clear]
    if not clear:
        return ()
    most = max(clear, key=lambda j: abs(j.jump))
    text = (
        f"the model jumps at {variable} = {most.edge:.6g} by up to {abs(most.jump):.2g} "
        f"(U {most.U:.2g})"
    )
    return (Finding("jump", "warning", text, "Leave out --free to fit without a jump."),)


def find_imbalance(balance: Balance | None) -> Findings:
    """Say where nothing was measured in thermal balance, which is how most sensors are used."""
    if balance is None or balance.outside.mean() <= _ENDS:
        return ()
    outside, points = int(balance.outside.sum()), len(balance.at)
    text = (
        f"in thermal balance (rate 0) {outside} of {points} points over {balance.variable} are "
        "outside the data; predictions there are extrapolated"
    )
    return (Finding("balance", "warning", text, "Add soaks at these temperatures."),)


def find_switch_on(data: Data) -> tuple[Finding, ...]:
    """Say that one switch-on cannot tell what the next one has."""
    if data.run is not None:
        return ()
    text = "the change of bias from one switch-on to the next is not in U"
    action = "Measure several switch-ons and name their column with --run."
    return (Finding("turn-on", "warning", text, action),)


def _find_in_segment(plan: Plan, segment: Segment, where: str) -> list[Finding]:
    said = []
    k, nu = segment.dof
    if k == 0:
        text = f"{where}: no term is supported by the data; the model is the mean alone"
        if not plan.constant:
            text = f"{where}: no term is supported by the data; the model is zero, as it lacks 1"
        said.append(Finding("mean-only", "warning", text))
    elif nu > 0 and not segment.significant:
        text = f"{where} is not significant: F = {segment.F:.3g} is below {segment.F_critical:.3g}"
        said.append(Finding("not-significant", "warning", text, p=segment.p))
    if segment.collinear:
        text = f"{where}: {', '.join(segment.collinear)} cannot be separated from the model"
        said.append(Finding("collinear-terms", "note", text))
    robust = segment.robust
    if robust is not None and segment.significant and not robust.p < 1.0 - plan.confidence:
        text = f"{where}: significant by F, not by F_robust ({p_in_words(robust.p)})"
        action = ""
        if robust.n_effective == segment.n:
            text += f", as {segment.n} rows cannot separate white from slow noise"
            action = "Record more rows, or several runs."
        said.append(Finding("not-robust", "warning", text, action, p=robust.p))
    return said
