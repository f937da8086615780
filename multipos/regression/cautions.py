"""What a reader should know before believing a regression: what was chosen, jumps, too few rows."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from multipos.doubt import Doubt
from multipos.regression.junctions import Junction
from multipos.regression.observations import Observations
from multipos.regression.piecewise import Plan
from multipos.regression.result import Regression
from multipos.regression.segment import Segment


def order_said(read: Observations, result: Regression) -> tuple[str, ...]:
    """Say by what rows are neighbours, where that was of any consequence."""
    return read.order if any(s.robust is not None for s in result.segments) else ()


def state_cautions(
    plan: Plan,
    segments: Sequence[Segment],
    hysteresis: Mapping[str, Any] | None,
    validation: Mapping[str, Any] | None,
) -> list[str]:
    """Say what the choice of terms, the branches and each segment leave to doubt."""
    said = []
    if not plan.constant:
        said.append("no intercept: F and R² are about zero, not about the mean, dof n − k")
    if plan.method != "full":
        said.append(
            "the terms were chosen by the same data that test them: F and p of the chosen model "
            "are optimistic"
            + ("" if validation else "; --cross-validate checks it by blocks of time")
        )
    if hysteresis is not None and not hysteresis["significant"]:
        p = hysteresis["p"]
        said.append(
            f"heating and cooling do not differ (p = {p:.2g}): one model for both"
            if p == p
            else "too few independent rows to tell heating from cooling: one model for both"
        )
    for where, segment in _named(segments):
        said += _segment_warnings(plan, segment, where)
    return said


def doubt_segments(segments: Sequence[Segment]) -> tuple[Doubt, ...]:
    """Return the doubts about a regression: nothing to test it with, or rows that are not apart."""
    found = []
    for where, segment in _named(segments):
        robust = segment.robust
        if segment.dof[0] > 0 and segment.dof[1] == 0:
            text = f"{where}: as many terms as rows, nothing is left to test it with"
            found.append(Doubt("no-redundancy", "caution", text))
        apart = robust is None or robust.kind == "cluster" or robust.n_effective == segment.n
        if robust is not None and not apart:
            text = (
                f"{where}: neighbouring rows are correlated ({robust.lag_one:.2f}); {segment.n} "
                f"rows are worth about {robust.n_effective:.3g}, see F_robust"
            )
            found.append(Doubt("time-correlated", "caution", text))
    return tuple(found)


def _named(segments: Sequence[Segment]) -> Iterator[tuple[str, Segment]]:
    """Yield segments with what they are called."""
    for number, segment in enumerate(segments, start=1):
        yield f"segment {number}" if len(segments) > 1 else "the model", segment


def jumps_said(variable: str | None, junctions: Sequence[Junction]) -> tuple[str, ...]:
    """Name the largest jump that is none by chance, and the way without."""
    clear = [j for j in junctions if j.clear]
    if not clear:
        return ()
    most = max(clear, key=lambda j: abs(j.jump))
    said = (
        f"the model jumps at {variable} = {most.edge:.6g} by up to {abs(most.jump):.2g} "
        f"(U {most.U:.2g}); --continuous fits without a jump"
    )
    return (said,)


def _segment_warnings(plan: Plan, segment: Segment, where: str) -> list[str]:
    said = []
    k, nu = segment.dof
    if k == 0:
        said.append(f"{where}: no term is supported by the data, the model is the mean alone")
    elif nu > 0 and not segment.significant:
        said.append(f"{where} means nothing: F = {segment.F:.3g} is below {segment.F_critical:.4g}")
    if segment.collinear:
        said.append(
            f"{where}: {', '.join(segment.collinear)} cannot be told from the terms in the model"
        )
    robust = segment.robust
    if robust is not None and segment.significant and not robust.p < 1.0 - plan.confidence:
        said.append(f"{where}: significant by F, not by F_robust (p = {robust.p:.2g})")
        if robust.kind != "cluster" and robust.n_effective == segment.n:
            said.append(
                f"{where}: {segment.n} rows cannot tell slow noise beside white noise from white "
                f"noise alone: F (p = {segment.p:.2g}) stands if theirs is white, F_robust if it "
                "is as slow as they leave open; more rows, or several runs, tell"
            )
    return said
