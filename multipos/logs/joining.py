"""The rests of one or several logs together: their labels, their faults, their positions.

Which position of a scheme each rest is: the nearest direction, or the next of the list.

The raw readings of three outputs show a direction once bias and scale factor are roughly known.
Both follow, output by output, from the readings themselves: first from their range against the
range of the scheme, then from the least-squares line through the positions found, until the
positions stay the same. Misalignment and orientation error remain as the distance, an angle. A rest
is doubtful where that angle is large, or the second-nearest direction is not twice as far.

Fewer than three outputs read the same of two directions. Their rests are taken as the positions of
the scheme in order, one each, and are doubtful where they are far from what the scheme makes them.

Rests whose means do not settle have a law of noise in common.

One rest hardly tells flicker noise or a random walk from white noise where white noise is the
larger; many rests of one sensor do. The slowest cosines of a rest of b batch means z, equivalent to
n samples of standard deviation s,

    ρ_k = 2/b² [ Σ_i z_i cos π k (i − ½)/b ]² / (g s²/n),     k = 1 … 8,                    (1)

with g the median of n/n_eff of the rests, are independent, each χ² on one degree of freedom times

    m_k = α + A λ^γ φ_k.                                                                    (2)

Where samples remember nothing beyond a tenth of a rest that is 1. Flicker noise has γ = 1 and φ_k
nearly 1/k, a random walk γ = 2 and φ_k = 1/k², λ being the length of a rest over the median length.

White noise is rejected where the mean of ρ_k, weighted by k^−3/2, which is nearly as good as the
best weights for either law, is beyond chance; or where ρ_1 and ρ_2 are so against ρ_5 … ρ_8 and a
memory, m_k = a/(1 + k²/κ²), explains less. It must be rejected without the rest that speaks loudest
as well, so that one disturbed rest says nothing about the others, and what sticks out far takes no
part at all. Outputs are taken together unless they differ beyond chance. α, 1 or below it, A and
the law then follow by maximum likelihood [1]_, and

    u² = (g s²/n) (α + μ A λ^γ)                                                             (3)

is the variance of a mean about that of a stretch sixteen times as long with the rest in its middle,
μ = 2.39 of flicker noise and 11.6 of a walk: this is what is promised where no mean settles. Its
degrees of freedom are those that the likelihood leaves to A.

References
----------
.. [1] P. Whittle, Ark. Mat. 2 (1953), 423–434 (the likelihood of ρ_k).
.. [2] C. A. Greenhall, W. J. Riley, 35th PTTI Meeting, 2003: phases of flicker noise and of a walk
   have the generalised covariances t² ln|t| and |t|³, from which φ_k and μ follow.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from math import pi, sqrt
from pathlib import Path
from typing import NamedTuple

import numpy as np

from multipos.errors import MultiposError
from multipos.files.spelling import listed
from multipos.finding import Finding, Findings, about, in_order
from multipos.logs.averages import Averages, RestAverage
from multipos.logs.faults import (
    common_noise,
    compare_scales,
    differ_in_unit,
    find_faults,
    find_stuck,
)
from multipos.logs.rest_means import COSINES, RestMean, with_rounding
from multipos.logs.still import Still, StillLog, found_so_far, would_take
from multipos.numerics.arrays import Array, Mask, median
from multipos.numerics.quantiles import chi2_quantile, chi2_tail, f_tail
from multipos.positions.attitudes import Convention
from multipos.positions.headers import named_axes
from multipos.positions.scheme import Scheme

FARTHEST_DEG = 20.0
_STEPS = 20
_ROUNDED = 1e-9  # of a rate
_SPREAD = 0.5  # [g] a scheme must move an axis by, to show its scale factor


class Match(NamedTuple):
    """For each rest the row of the scheme and the angles to the nearest two directions."""

    rows: list[int]
    distance_deg: Array
    second_deg: Array

    @property
    def doubtful(self) -> Mask:
        """Where the nearest direction may be the wrong one."""
        far = self.distance_deg > FARTHEST_DEG
        return np.asarray(far | (2.0 * self.distance_deg > self.second_deg))


def match_rests(
    means: Array,
    axes: Sequence[int],
    labels: Sequence[str],
    where: Sequence[str],
    scheme: Scheme,
    convention: Convention,
) -> Match:
    """Match rests to the positions of a scheme: by label, by direction, or in order.

    Parameters
    ----------
    means : (n, M) array
        Mean outputs.
    axes : sequence of M int
        The axis, 0 to 2, that each senses.
    labels : sequence of str
        What the user calls each rest, '' where nothing. Where all are labels of the scheme they
        tell the positions.
    where : sequence of str
        Where the rests are, in messages.
    scheme : Scheme
    convention : str
        'specific-force' or 'gravity'.

    Raises
    ------
    MultiposError
        A rest is far from its position, or as near to another; or rests of fewer than three
        outputs are not as many as the positions.
    """
    known = scheme.names
    if all(label in known for label in labels):
        rows = [known.index(label) for label in labels]
        match = _match_rows(means, axes, rows, scheme, convention)
    elif means.shape[1] == 3:
        match = match_directions(means[:, np.argsort(axes)], scheme, convention)
    else:
        match = _match_in_order(means, axes, scheme, convention)
    bad = np.flatnonzero(match.doubtful).tolist()
    if not bad:
        return match
    i = bad[0]
    second = ""
    if np.isfinite(match.second_deg[i]):
        second = f" and {match.second_deg[i]:.1f} from the next"
    raise MultiposError(
        f"{len(bad)} of {len(means)} rests match no position of scheme '{scheme.name}': rest "
        f"'{labels[i] or i + 1}' {where[i]} lies {match.distance_deg[i]:.1f} degrees from position "
        f"'{known[match.rows[i]]}'{second} (the nearest must be within {FARTHEST_DEG:g} degrees "
        "and twice as near as the next); name the right rests with --only, or leave --scheme out "
        "and use fit --unknown-orientation."
    )


def _match_in_order(
    means: Array, axes: Sequence[int], scheme: Scheme, convention: Convention
) -> Match:
    """Match rests of fewer than three outputs to all positions of a scheme, in order."""
    count, outputs = means.shape
    if count != len(scheme):
        raise MultiposError(
            f"{outputs} outputs do not show a direction, so that rests are taken as the positions "
            f"in order, but {count} rests were found and scheme '{scheme.name}' has "
            f"{len(scheme)} positions; choose the rests with --only, --min-duration or "
            "--threshold, or name them with --sections."
        )
    return _match_rows(means, axes, [*range(count)], scheme, convention)


def _match_rows(
    means: Array, axes: Sequence[int], rows: list[int], scheme: Scheme, convention: Convention
) -> Match:
    """Return how far rests are from positions that are known, after a line of each output."""
    targets = (-1.0 if convention == "gravity" else 1.0) * scheme.up[rows][:, list(axes)]
    off = np.zeros(len(rows))
    for mean, target in zip(means.T, targets.T, strict=True):
        if np.ptp(target) <= _SPREAD:
            continue
        line = np.column_stack([np.ones(len(rows)), target])
        (bias, scale), *_ = np.linalg.lstsq(line, mean, rcond=None)
        if not scale:
            raise _nothing_moves()
        off += ((mean - bias) / scale - target) ** 2
    chord = np.minimum(np.sqrt(off) / 2.0, 1.0)
    return Match(rows, np.degrees(2.0 * np.arcsin(chord)), np.full(len(rows), np.inf))


def _nothing_moves() -> MultiposError:
    return MultiposError(
        "the rests do not move any output as the scheme does; check --scheme and --outputs."
    )


def match_directions(means: Array, scheme: Scheme, convention: Convention) -> Match:
    """Match rests to the positions of a scheme by direction.

    Parameters
    ----------
    means : (n, 3) array
        Mean outputs, on axes x, y, z.
    scheme : Scheme
    convention : str
        'specific-force' or 'gravity'.
    """
    targets = (-1.0 if convention == "gravity" else 1.0) * scheme.up
    bias, scale = _from_ranges(means, targets)
    rows: list[int] = []
    for _ in range(_STEPS):
        direction = (means - bias) / scale
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        cosine = direction @ targets.T
        nearest = np.argmax(cosine, axis=1).tolist()
        if nearest == rows:
            break
        rows = nearest
        bias, scale = _from_lines(means, targets[rows], scale)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    distance = angle[np.arange(len(rows)), rows]
    # Shared directions are one: the second-nearest is the nearest that points elsewhere.
    same = scheme.up[rows] @ scheme.up.T > 1.0 - 1e-9
    second = np.where(same, np.inf, angle).min(axis=1)
    return Match(_spread_over(rows, scheme), distance, second)


def _from_ranges(means: Array, targets: Array) -> tuple[Array, Array]:
    span, wanted = np.ptp(means, axis=0), np.ptp(targets, axis=0)
    shown = wanted > _SPREAD
    if not shown.any() or not span[shown].all():
        raise _nothing_moves()
    scale = np.ones(3)
    scale[shown] = span[shown] / wanted[shown]
    scale[~shown] = scale[shown].mean()
    middle, centre = means.min(axis=0) + span / 2.0, targets.min(axis=0) + wanted / 2.0
    return middle - scale * centre, scale


def _from_lines(means: Array, targets: Array, scale: Array) -> tuple[Array, Array]:
    deviation = targets - targets.mean(axis=0)
    square = (deviation**2).sum(axis=0)
    slope = (deviation * (means - means.mean(axis=0))).sum(axis=0)
    shown = (np.ptp(targets, axis=0) > _SPREAD) & (slope > 0.0)
    scale = np.where(shown, slope / np.where(shown, square, 1.0), scale)
    return means.mean(axis=0) - scale * targets.mean(axis=0), scale


def _spread_over(rows: list[int], scheme: Scheme) -> list[int]:
    """Give rests of one direction to the scheme's positions of that direction one after another."""
    taken: dict[int, int] = {}
    result = []
    for row in rows:
        twins = np.flatnonzero(scheme.up @ scheme.up[row] > 1.0 - 1e-9).tolist()
        first = twins[0]
        result.append(twins[taken.get(first, 0) % len(twins)])
        taken[first] = taken.get(first, 0) + 1
    return result


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
            f"--sections{would_take(found.short, found.shortest, found.rate)}"
            f"{found_so_far([each for each in found.findings if each.level == 'note'])}."
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
    said += _other_unit(list(dict.fromkeys(each.log.log.source for each in chosen)), chosen)
    scale = compare_scales(outputs, np.array([each.mean for each in found]))
    return said if scale is None else [*said, scale]


def _other_unit(sources: Sequence[str], chosen: Sequence[Chosen]) -> list[Finding]:
    surveys = {each.log.log.source: each.log.survey for each in chosen}
    other = differ_in_unit([surveys[source] for source in sources])
    if other is None:
        return []
    which, ratio = other
    text = f"readings of {sources[which]} are {ratio:.3g} times those of {sources[0]}: two units"
    return [Finding("two-units", "warning", text, "Convert one of the files.")]


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
    fact, action = _OF_RESTS.get(first.code, ("", ""))
    first = replace(first, action=first.action or action)
    if len(labels) > 1 and fact:
        named = ", ".join(labels[:_SHOWN])
        more = ", …" if len(labels) > _SHOWN else ""
        text = f"{len(labels)} of {count} rests {fact}: positions {named}{more}"
        first = replace(first, action=action)
    return replace(first, text=text, rows=labels, outputs=outputs)


_SHOWN = 6  # labels of positions
# What several rests have in common, and what to do about it.
_OF_RESTS = {
    "slow-drift": (
        "drifted slowly (typical when held by hand); their u includes it",
        "Rest the sensor on something for a smaller U.",
    ),
    "correlated-samples": (
        "have correlated noise, thus few independent samples; their dof include it",
        "Record longer rests.",
    ),
    "unsteady": ("are noisier than usual; their u includes it", ""),
    "in-motion": (
        "are partly in motion",
        "Correct their rows in --sections, or record them again.",
    ),
    "motion-at-edge": (
        "contain motion at the beginning or end",
        "Give fewer rows of them with --sections.",
    ),
    "quantized": (
        "are one code in an output; their u is resolution/sqrt(12)",
        "Record more digits.",
    ),
    "stuck": ("repeat one value", "Check the sensor and its resolution."),
    "time-gap": ("have gaps in their time", "Check the logger."),
}


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
    """Return the findings about each log, with its name where there are several."""
    if len(logs) == 1:
        return said(logs[0])
    return tuple(found for log in logs for found in about(_name(log), said(log)))


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


_LEAST = 64  # samples of a rest, below which eight cosines are no longer like χ²
_LEVEL = 0.045  # at which the weighted mean rejects white noise
_FALL = 0.01  # at which ρ_1 and ρ_2 do
_MANY = 36  # means, of which fewer must speak louder, as their u would be raised by more
_OTHERS = 2.5  # times these levels are enough without the loudest rest
_DIFFER = 0.01  # at which outputs are each for itself
_APART = 1e-3  # chance at which a rest is so far beyond the median that it takes no part
_WALK, _LOWER = 1.0, 2.0  # of the log likelihood, that a walk and α below 1 must explain more
_MEMORIES = np.geomspace(3.0, 100.0, 12)  # κ: of a memory up to a tenth of a rest
_RATIOS = np.geomspace(0.03, 1e4, 80)  # A/α
_STEP = float(np.log(_RATIOS[1] / _RATIOS[0])) / sqrt(12.0)  # what lies between two of them
_STRETCH = 16.0  # rest lengths, to whose mean u refers
_NOTHING = 1e-9  # of the slow cosines, below which the others are rounding
_BLOCKS = 128  # enough for integrals over a rest

_ORDER = np.arange(1, COSINES + 1)
_WEIGHT = _ORDER**-1.5 / np.sum(_ORDER**-1.5)
_DOF = 1.0 / float(_WEIGHT @ _WEIGHT)  # of the weighted mean of one rest
_NEEDED = ("n", "sd", "u", "drift_factor")  # of a rest


class Law(NamedTuple):
    """Eq. (2) of some outputs: whether it is a walk, α, A, and the standard deviation of A."""

    walk: bool
    lowest: float
    amplitude: float
    spread: float

    def square(self, length: Array) -> tuple[Array, Array]:
        """Return eq. (3) over g s²/n for every λ (R,), and its degrees of freedom."""
        slow = _growths()[self.walk] * length ** (1 + self.walk)
        square = self.lowest + slow * self.amplitude
        return square, 2.0 * (square / (slow * self.spread)) ** 2


def settle_together(found: Sequence[RestMean], lengths: Array) -> list[RestMean]:
    """Return rests with the u by the law that they have in common, where it is the larger.

    Parameters
    ----------
    found : sequence of R RestMean
        Of one sensor.
    lengths : (R,) array
        Of the rests, in one unit.
    """
    n, sd, u, drift_factor = (np.array([getattr(r, k) for r in found]) for k in _NEEDED)
    white = sd**2 / n[:, None]
    cosines = np.array([each.cosines for each in found])
    usable = (white > 0.0) & (u > 0.0) & cosines.any(axis=2) & (n >= _LEAST)[:, None]
    if len(found) < 2 or not usable.any():
        return list(found)
    memory = _medians((u / drift_factor) ** 2 / np.where(usable, white, 1.0), usable)
    rho = cosines / memory[:, None]
    size = rho @ _WEIGHT
    usable &= _are_usual(size / _medians(size, usable), usable)[:, None]
    length = lengths / float(median(lengths))
    square, dof = np.zeros(sd.shape), np.ones(sd.shape)
    for outputs in _alike(size, usable):
        law = find_law(rho[:, outputs], usable[:, outputs], length)
        if law is not None:
            by, own = law.square(length)
            square[:, outputs] = by[:, None] * (memory * white)[:, outputs]
            dof[:, outputs] = own[:, None]
    more = (square > u**2) & (u > 0.0)
    return [
        _raised(each, more[i], square[i], dof[i]) if more[i].any() else each
        for i, each in enumerate(found)
    ]


def _raised(each: RestMean, more: Mask, square: Array, dof: Array) -> RestMean:
    u = np.where(more, np.sqrt(square), each.u)
    ratio = np.ones_like(u)
    ratio[more] = (u * each.drift_factor)[more] / each.u[more]
    dof = np.where(more, np.clip(dof, 1.0, each.dof), each.dof)
    return replace(each, u=u, dof=dof, common=ratio)


def _medians(values: Array, usable: Mask) -> Array:
    """Return the median of the usable of each output (M,), 1 where nothing is."""
    columns = zip(values.T, usable.T, strict=True)
    return np.array([float(median(v[t])) if t.any() else 1.0 for v, t in columns])


def _are_usual(size: Array, usable: Mask) -> Mask:
    """Tell of which rests (R,) the outputs together are not far beyond the median of all."""
    count = np.maximum(usable.sum(axis=1), 1)
    most = {c: _most(_DOF * c) for c in set(count.tolist())}
    limit = np.array([most[c] for c in count.tolist()])
    mean = np.where(usable, size, 0.0).sum(axis=1) / count
    return np.asarray(mean <= limit * float(median(mean[usable.any(axis=1)])))


@cache
def _most(dof: float) -> float:
    return chi2_quantile(1.0 - _APART, dof) / chi2_quantile(0.5, dof)


def _alike(size: Array, usable: Mask) -> list[list[int]]:
    """Return the outputs that are judged together: all that tell something, or each."""
    count = usable.sum(axis=0)
    outputs = np.flatnonzero(count).tolist()
    each = (size * usable).sum(axis=0)[outputs] / count[outputs]
    dof = _DOF * count[outputs]
    together = float(each @ dof / dof.sum())
    off = float(4.5 * dof @ (np.cbrt(each / together) - 1.0) ** 2)  # as a cube root is normal
    if len(outputs) == 1 or chi2_tail(off, len(outputs) - 1.0) > _DIFFER:
        return [outputs]
    return [[j] for j in outputs]


def find_law(rho: Array, usable: Mask, length: Array) -> Law | None:
    """Return the law that rests have in common; None where they may have white noise.

    Parameters
    ----------
    rho : (R, M, 8) array
    identifiable : (R, M) array
        Which of them take part.
    length : (R,) array
        λ.
    """
    others = usable.copy()
    others[int(np.where(usable, rho @ _WEIGHT, 0.0).sum(axis=1).argmax())] = False
    rows, without = rho[usable], rho[others]
    if not len(without):
        return None
    level = min(1.0, len(rows) / _MANY) ** 2
    grown = _is_large(rows, level * _LEVEL) and _is_large(without, level * _OTHERS * _LEVEL)
    falls = _falls(rows, level * _FALL) and _falls(without, level * _OTHERS * _FALL)
    if not grown and not falls:
        return None
    law, likelihood = _most_likely(rows, np.broadcast_to(length[:, None], usable.shape)[usable])
    return law if grown or likelihood > _with_memory(rows) + _LOWER else None


def _is_large(rows: Array, level: float) -> bool:
    dof = _DOF * len(rows)
    return chi2_tail(dof * float(rows.mean(axis=0) @ _WEIGHT), dof) < level


def _falls(rows: Array, level: float) -> bool:
    mean = rows.mean(axis=0)
    slow, quick = float(mean[:2].mean()), float(mean[4:].mean())
    ratio = slow / max(quick, _NOTHING * slow) if slow else 0.0
    return f_tail(ratio, 2.0 * len(rows), 4.0 * len(rows)) < level


def _with_memory(rows: Array) -> float:
    """Return the log likelihood of the best memory, whatever it is at zero frequency."""
    shape = 1.0 / (1.0 + (_ORDER / _MEMORIES[:, None]) ** 2)
    level = (rows.mean(axis=0) / shape).mean(axis=1)
    logs = COSINES * np.log(level) + np.log(shape).sum(axis=1) + COSINES
    return float(-0.5 * len(rows) * logs.min())


def _most_likely(rows: Array, length: Array) -> tuple[Law, float]:
    """Return the law of rows (N, 8) of lengths (N,), and its log likelihood less what it costs."""
    found = []
    for walk, phi in enumerate(_shapes()):
        shape = length[:, None] ** (1 + walk) * phi
        means = (1.0 + ratio * shape for ratio in _RATIOS.tolist())  # one by one: logs may be long
        plain, left = np.array([(np.log(m).sum(), (rows / m).sum()) for m in means]).T
        lower = np.minimum(left / rows.size, 1.0)  # the likeliest α
        for lowest, cost in ((np.ones_like(lower), 0.0), (lower, _LOWER)):
            logs = -0.5 * (rows.size * np.log(lowest) + plain + left / lowest)
            best, amplitude = int(logs.argmax()), lowest * _RATIOS
            weight = np.exp(logs - logs[best]) * _RATIOS  # of A, even in A
            weight /= weight.sum()
            spread = sqrt(float(weight @ (amplitude - weight @ amplitude) ** 2))
            spread = max(spread, _STEP * float(amplitude[best]))
            law = Law(bool(walk), float(lowest[best]), float(amplitude[best]), spread)
            found.append((law, float(logs[best]) - cost - walk * _WALK))
    return max(found, key=lambda each: each[1])


@cache
def _shapes() -> tuple[Array, Array]:
    """Return φ_k of flicker noise and of a walk."""
    lag = np.subtract.outer(np.arange(_BLOCKS), np.arange(_BLOCKS))
    between = 2.0 * _square_log(lag) - _square_log(lag + 1) - _square_log(lag - 1)
    cosine = np.cos(np.pi * np.outer(np.arange(_BLOCKS) + 0.5, _ORDER) / _BLOCKS)
    flicker = np.einsum("ik,ij,jk->k", cosine, between, cosine) / _BLOCKS**2
    return flicker, 1.0 / _ORDER**2


@cache
def _growths() -> tuple[float, float]:
    """Return μ of flicker noise and of a walk: the mean of a rest less that of its stretch."""
    ends = np.array([0.5, -0.5, _STRETCH / 2.0, -_STRETCH / 2.0])
    weight = np.array([1.0, -1.0, -1.0 / _STRETCH, 1.0 / _STRETCH])
    lag = np.subtract.outer(ends, ends)
    return (
        float(weight @ _square_log(lag) @ weight) / 2.0,
        float(weight @ np.abs(lag) ** 3 @ weight) * pi**2 / 12.0,
    )


def _square_log(t: Array) -> Array:
    """Return t² ln|t|."""
    return np.asarray(t**2 * np.log(np.where(t == 0.0, 1.0, np.abs(t))))
