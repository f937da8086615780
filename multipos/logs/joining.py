"""The rests of one or several logs together: their labels, their faults, their positions.

`require_alike` and `require_several` refuse logs that cannot be joined, `choose` gives the rests
their labels, `faults_of_means` tells what makes their means wrong, and `complete` returns the
averages with all that is to be said.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from multipos.errors import MultiposError
from multipos.files.spelling import listed, packaged_pairs
from multipos.finding import Finding, Findings, in_order
from multipos.logs.averages import Averages, RestAverage
from multipos.logs.common_noise import settle_together
from multipos.logs.faults import (
    common_noise,
    compare_scales,
    differ_in_unit,
    find_faults,
    find_stuck,
)
from multipos.logs.matching import Match, match_rests
from multipos.logs.rest_means import with_rounding
from multipos.logs.still import Still, StillLog, would_take
from multipos.positions.attitudes import Convention
from multipos.positions.headers import named_axes
from multipos.positions.scheme import Scheme

_ROUNDED = 1e-9  # of a rate


class Chosen(NamedTuple):
    """A rest, what it is called, and the log it is in."""

    label: str
    log: StillLog
    still: Still
    given: bool  # whether the user named it, or its file

    @property
    def where(self) -> str:
        """Its rows in words."""
        return f"(rows {self.still.rows.start} to {self.still.rows.end})"


def require_alike(found: Sequence[StillLog]) -> None:
    """Refuse logs whose outputs differ, or whose headers tell different units."""
    first = found[0]
    for each in found[1:]:
        if each.outputs != first.outputs:
            raise MultiposError(
                f"{each.log.source}: the outputs are {', '.join(each.outputs)}, but those of "
                f"{first.log.source} {', '.join(first.outputs)}; name them with --outputs."
            )
    units: dict[str, str] = {}
    for each in found:
        units |= {each.log.units[n]: n for n in each.outputs if n in each.log.units}
    if len(units) > 1:
        listed = ", ".join(f"'{name}' [{unit}]" for unit, name in units.items())
        raise MultiposError(f"the outputs {listed} have mixed units; convert them to one.")


def require_several(found: StillLog) -> None:
    """Refuse a single log with a single rest."""
    if len(found.rests) == 1:
        rows = found.rests[0].rows
        raise MultiposError(
            f"{found.log.source}: one rest only, rows {rows.start} to {rows.end} of "
            f"{found.survey.rows}, at threshold {found.threshold:.3g}; a calibration needs several "
            "positions: record them in one log, give a log for each, lower --threshold, or give "
            f"--sections{would_take(found.short, found.shortest, found.rate)}."
        )


def choose(found: Sequence[StillLog], only: tuple[str, ...] | None) -> list[Chosen]:
    """Return the rests with their labels, as given, by their file, or counted; or some of them.

    Raises
    ------
    MultiposError
        `only` names a label that there is not.
    """
    result = _labelled(found)
    if only is None:
        return result
    known = dict.fromkeys(each.label for each in result)
    strange = [label for label in only if label not in known]
    if strange:
        raise MultiposError(
            f"--only names '{strange[0]}', but the rests are {listed([*known], 12)}."
        )
    return [each for each in result if each.label in only]


def _labelled(found: Sequence[StillLog]) -> list[Chosen]:
    result: list[Chosen] = []
    for log in found:
        name = Path(log.log.source).name.partition(".")[0]
        by_file = name if len(found) > 1 and len(log.rests) == 1 else ""
        for still in log.rests:
            given = still.label or by_file
            result.append(Chosen(given or str(len(result) + 1), log, still, bool(given)))
    return result


def faults_of_means(chosen: Sequence[Chosen]) -> list[Finding]:
    """Return what makes means wrong, and the way out."""
    outputs = chosen[0].log.outputs
    found = [each.still.found for each in chosen]
    stuck = find_stuck(outputs, found, [each.log.survey for each in chosen])
    said: list[Finding] = []
    for each, constant in zip(chosen, stuck, strict=True):
        said += [
            Finding(
                "saturated",
                "warning",
                f"rest '{each.label}' {each.where}: {fault}; its mean is wrong",
                "Record it in a wider range, or omit the rest with --only.",
                rows=(each.label,),
            )
            for fault in (*constant, *each.still.saturated)
        ]
    said += differ_in_unit({each.log.log.source: each.log.survey for each in chosen})
    scale = compare_scales(outputs, np.array([each.mean for each in found]))
    return said if scale is None else [*said, scale]


def complete(
    logs: Sequence[StillLog],
    chosen: Sequence[Chosen],
    scheme: Scheme | None,
    convention: Convention,
    wrong: Sequence[Finding],
) -> Averages:
    """Return the averages of the rests, matched to a scheme, with all that is to be said."""
    chosen = _settled(chosen)
    match, labels, unseen = _matched(chosen, scheme, convention)
    stills = [each.still for each in chosen]
    faults, general = find_faults(
        logs[0].outputs,
        [still.found for still in stills],
        np.fmin.reduce([log.survey.resolution for log in logs]),
        [still.gaps for still in stills],
        [still.moving for still in stills],
        labels,
    )
    timed = len(logs) == 1 or _times_follow(stills)
    if not timed:
        text = "the times of the logs do not follow each other; they are not used"
        unseen = [*unseen, Finding("times-unused", "note", text)]
    distances = None if match is None else match.distance_deg.tolist()
    rests = _rests(chosen, labels, faults, distances, timed=timed)
    thresholds = {log.threshold for log in logs}
    left = _by_log(logs, lambda log: (*log.findings, *_find_short(log)))
    together = common_noise(logs[0].outputs, [still.found for still in stills])
    return Averages(
        source=", ".join(log.log.source for log in logs),
        outputs=logs[0].outputs,
        rests=tuple(rests),
        scheme_up=None if match is None or scheme is None else scheme.up[match.rows],
        sample_rate=_one_rate([log.rate for log in logs]),
        threshold=thresholds.pop() if len(thresholds) == 1 else None,
        findings=in_order((*left, *wrong, *unseen, *together, *_of_rests(rests), *general)),
        short=tuple((_name(log), rest) for log in logs for rest in log.short),
        unit=_unit(logs),
        layout="; ".join(dict.fromkeys(log.log.layout for log in logs)),
        time_column=next((log.clock.column for log in logs if log.clock is not None), None),
    )


def _settled(chosen: Sequence[Chosen]) -> list[Chosen]:
    """Return the rests with the u that all of them together ask for."""
    rates = [each.log.rate for each in chosen]
    rate = [1.0 if None in rates else (each or 1.0) for each in rates]
    lengths = np.array([each.still.found.n for each in chosen]) / rate
    resolution = np.fmin.reduce([each.log.survey.resolution for each in chosen])
    settled = settle_together([each.still.found for each in chosen], lengths)
    found = with_rounding(settled, resolution)
    return [
        each._replace(still=replace(each.still, found=new))
        for each, new in zip(chosen, found, strict=True)
    ]


def _of_rests(rests: Sequence[RestAverage]) -> list[Finding]:
    """Return what was found about single rests, of each kind the first, and how many have it."""
    every = [(rest, found) for rest in rests for found in rest.findings]
    kinds = dict.fromkeys(found.code for _, found in every)
    return [
        _of_kind([each for each in every if each[1].code == code], len(rests)) for code in kinds
    ]


def _of_kind(every: Sequence[tuple[RestAverage, Finding]], count: int) -> Finding:
    """Return one finding about all rests that have one of a kind."""
    rest, first = every[0]
    labels = tuple(dict.fromkeys(rest.position for rest, _ in every))
    outputs = tuple(dict.fromkeys(output for _, found in every for output in found.outputs))
    text = f"position '{rest.position}' (rows {rest.rows.start} to {rest.rows.end}): {first.text}"
    # What several rests have in common, and what to do about it.
    fact, _, action = packaged_pairs(__file__, "of_rests.csv").get(first.code, "").partition("|")
    first = replace(first, action=first.action or action)
    if len(labels) > 1 and fact:
        named = ", ".join(labels[:_SHOWN])
        more = ", …" if len(labels) > _SHOWN else ""
        text = f"{len(labels)} of {count} rests {fact}: positions {named}{more}"
        first = replace(first, action=action)
    return replace(first, text=text, rows=labels, outputs=outputs)


_SHOWN = 6  # labels of positions


def _matched(
    chosen: Sequence[Chosen], scheme: Scheme | None, convention: Convention
) -> tuple[Match | None, list[str], list[Finding]]:
    """Return which positions the rests are, what those are called, and which are missed."""
    labels = [each.label for each in chosen]
    if scheme is None:
        return None, labels, []
    match = match_rests(
        np.array([each.still.found.mean for each in chosen]),
        named_axes(chosen[0].log.outputs),
        [each.label * each.given for each in chosen],
        [each.where for each in chosen],
        scheme,
        convention,
    )
    known = scheme.names
    missed = sorted({*range(len(known))}.difference(match.rows))
    named = ", ".join(known[i] for i in missed[:_SHOWN])
    named += f" and {len(missed) - _SHOWN} more" if len(missed) > _SHOWN else ""
    text = f"{len(missed)} of {len(known)} positions of '{scheme.name}' have no rest: {named}"
    action = "Record the missing positions, or name another scheme."
    found = [Finding("missed-positions", "warning", text, action)] if missed else []
    return match, [known[row] for row in match.rows], found


def _rests(
    chosen: Sequence[Chosen],
    labels: Sequence[str],
    faults: Sequence[Sequence[Finding]],
    distances: Sequence[float] | None,
    *,
    timed: bool,
) -> list[RestAverage]:
    shared = set.intersection(*(set(each.still.environment) for each in chosen))
    return [
        RestAverage(
            position=label,
            rows=each.still.rows,
            time=each.still.time if timed else None,
            found=each.still.found,
            environment={n: v for n, v in each.still.environment.items() if n in shared},
            distance_deg=None if distances is None else distances[i],
            findings=tuple(faults[i]),
            log=_name(each.log),
        )
        for i, (each, label) in enumerate(zip(chosen, labels, strict=True))
    ]


def _unit(logs: Sequence[StillLog]) -> str | None:
    units = [log.log.units.get(name) for log in logs for name in log.outputs]
    return next((unit for unit in units if unit), None)


def _find_short(found: StillLog) -> Findings:
    if not found.short:
        return ()
    rows = listed([f"rows {rest.start} to {rest.end}" for rest in found.short], 2)
    said = would_take(found.short, found.shortest, found.rate)
    return (Finding("short-rests", "note", f"{said.removeprefix('; ')}: {rows}"),)


def _name(log: StillLog) -> str:
    return Path(log.log.source).name


def _by_log(logs: Sequence[StillLog], said: Callable[[StillLog], Findings]) -> Findings:
    """Return the findings about logs, of each kind those of the first that has it, by its name."""
    if len(logs) == 1:
        return said(logs[0])
    every = [(_name(log), said(log)) for log in logs]
    found: list[Finding] = []
    for code in dict.fromkeys(each.code for _, own in every for each in own):
        having = [(n, alike) for n, own in every if (alike := [f for f in own if f.code == code])]
        name, alike = having[0]
        count = f" (as {len(having)} of {len(logs)} logs)" if len(having) > 1 else ""
        found += [replace(each, text=f"{name}: {each.text}{count}") for each in alike]
    return tuple(found)


def _one_rate(rates: Sequence[float | None]) -> float | None:
    """Return the rate that logs have in common, to the rounding of their times."""
    known = [rate for rate in rates if rate is not None]
    alike = len(known) == len(rates) and max(known) - min(known) <= _ROUNDED * max(known)
    return known[0] if alike else None


def _times_follow(stills: Sequence[Still]) -> bool:
    """Tell whether rests of several logs have one clock: each begins when the last has ended."""
    times = [still.time for still in stills if still.time is not None]
    if len(times) < len(stills):
        return not times
    return all(last[1] <= next_[0] for last, next_ in pairwise(times))
