"""What is wrong with rests: saturated or stuck outputs, mixed units, motion, drift, gaps, twins."""

import re
from collections.abc import Sequence

import numpy as np

from multipos.errors import MultiposError
from multipos.logs.rest_means import RestMean
from multipos.logs.rests import Rest, Survey
from multipos.numerics.arrays import Array

# A share of the samples at one value, the extreme of the log, that noise does not explain.
_SATURATED = 0.01
_SATURATED_SAMPLES = 5
_NOISY = 1.5  # steps of resolution: with less noise many samples share one value anyway
_STUCK = 20  # equal samples in a row
_UNITS = 3.0  # times the scale factor of another output: no pair of one unit differs so much
_SPREAD = 50.0  # condition of the ellipsoid: worse where the positions do not span the sphere
_SIGNIFICANT = 5.0  # times its standard uncertainty
_UNSTEADY = 3.0  # times the usual standard deviation of a rest
_TWIN_DEG = 2.0
_EDGE = 0.1  # of the windows of a section may be its edges


def check_units(outputs: Sequence[str], means: Array | None) -> None:
    """Refuse outputs of different units, by their names or by the ellipsoid of their means.

    Raises
    ------
    MultiposError
        Two outputs are named with different units, or one spans several times what another does.
    """
    units = {name: found[1] for name in outputs if (found := re.search(r"[\[(](.+?)[\])]", name))}
    if len(set(units.values())) > 1:
        listed = ", ".join(f"'{name}'" for name in units)
        raise MultiposError(f"the outputs {listed} have mixed units; convert them to one.")
    scale = None if means is None else _semi_axes(means)
    if scale is not None and scale.max() > _UNITS * scale.min():
        large, small = outputs[int(np.argmax(scale))], outputs[int(np.argmin(scale))]
        raise MultiposError(
            f"1 g moves '{large}' {scale.max() / scale.min():.3g} times as far as '{small}': "
            "mixed units? Convert the outputs to one unit, or average them one at a time "
            "with --outputs."
        )


def _semi_axes(means: Array) -> Array | None:
    """Return the semi-axes of the ellipsoid along the axes that the means (n, 3) lie on."""
    if means.shape[1] != 3 or len(means) < 6:
        return None
    half = np.ptp(means, axis=0) / 2.0
    if not half.all():
        return None
    y = (means - means.min(axis=0)) / half - 1.0
    rows = np.column_stack([y**2, y])
    if np.linalg.cond(rows) > _SPREAD:
        return None
    a, b = np.split(np.linalg.lstsq(rows, np.ones(len(rows)), rcond=None)[0], 2)
    if not (a > 0.0).all():
        return None
    return np.asarray(half / np.sqrt(a / (1.0 + float((b**2 / (4.0 * a)).sum()))))


def refuse_saturated(
    outputs: Sequence[str],
    rests: Sequence[tuple[str, Rest]],
    found: Sequence[RestMean],
    survey: Survey,
) -> None:
    """Refuse rests in which an output is saturated or stuck.

    Raises
    ------
    MultiposError
        Names the rest, the output, the value and how many samples are there.
    """
    usual = np.median([each.sd for each in found], axis=0)
    resolution = np.nan_to_num(survey.resolution)
    for (label, rest), each in zip(rests, found, strict=True):
        for j, output in enumerate(outputs):
            value, count, fault = None, 0, "saturated"
            noisy = each.sd[j] >= _NOISY * resolution[j] > 0.0
            enough = max(_SATURATED_SAMPLES, _SATURATED * each.n)
            if each.sd[j] == 0.0 and usual[j] > 0.5 * resolution[j]:
                value, count = each.low[j], each.n
                if value not in (survey.lowest[j], survey.highest[j]):
                    fault = "stuck"
            elif noisy and each.high[j] == survey.highest[j] and each.at_high[j] >= enough:
                value, count = each.high[j], each.at_high[j]
            elif noisy and each.low[j] == survey.lowest[j] and each.at_low[j] >= enough:
                value, count = each.low[j], each.at_low[j]
            if value is not None:
                raise MultiposError(
                    f"rest '{label}' (rows {rest.start} to {rest.end}): output '{output}' is "
                    f"{fault} at {value:.10g} ({count} of {each.n} samples), so its mean is "
                    "wrong; record it with a larger range, or leave the rest out with --only."
                )


def find_faults(
    outputs: Sequence[str],
    found: Sequence[RestMean],
    resolution: Array,
    gaps: Sequence[int],
    moving: Sequence[float | None],
    labels: Sequence[str],
) -> tuple[list[list[str]], list[str]]:
    """Return what is to be said of each rest, and of all of them together."""
    usual = np.median([each.sd for each in found], axis=0)
    faults: list[list[str]] = []
    for each, gap, moved in zip(found, gaps, moving, strict=True):
        notes = []
        if moved is not None and moved > _EDGE:
            notes.append(f"in motion during {100 * moved:.0f} % of the time")
        elif moved:
            notes.append("motion at its edges; give fewer rows")
        if gap:
            notes.append(f"{gap} gaps in the time" if gap > 1 else "a gap in the time")
        for j, output in enumerate(outputs if not moved else ()):
            notes += _output_faults(output, j, each, usual[j], float(resolution[j]))
        faults.append(notes)
    still = [i for i, moved in enumerate(moving) if not moved]
    return faults, _twins([found[i] for i in still], [labels[i] for i in still])


def _output_faults(
    output: str, j: int, each: RestMean, usual: float, resolution: float
) -> list[str]:
    notes = []
    noisy = each.sd[j] >= _NOISY * resolution
    if noisy and each.longest[j] >= max(_STUCK, each.n / 10):
        notes.append(f"'{output}' repeats one value {each.longest[j]} times")
    if usual > 0.0 and each.sd[j] > _UNSTEADY * usual:
        notes.append(f"'{output}' is unsteady, its sd {each.sd[j] / usual:.1f} times the usual")
    if each.drift_u[j] > 0.0 and abs(each.drift[j]) > _SIGNIFICANT * each.drift_u[j]:
        notes.append(f"'{output}' drifts by {each.drift[j]:+.3g}")
    elif each.edge[j] > _SIGNIFICANT:
        notes.append(f"'{output}' is off at an edge; motion there?")
    return notes


def _twins(found: Sequence[RestMean], labels: Sequence[str]) -> list[str]:
    if len(found) < 3:
        return []
    means = np.array([each.mean for each in found])
    half_range = float(np.ptp(means, axis=0).max()) / 2.0
    if not half_range:
        return []
    near = np.radians(_TWIN_DEG) * half_range
    pairs = [
        f"{labels[i]} and {labels[k]}"
        for i in range(len(means))
        for k in range(i + 1, len(means))
        if labels[i] != labels[k] and np.linalg.norm(means[i] - means[k]) < near
    ]
    if not pairs:
        return []
    listed = ", ".join(pairs[:6]) + (f" and {len(pairs) - 6} more pairs" if len(pairs) > 6 else "")
    note = (
        f"nearly the same position, within about {_TWIN_DEG:g} degrees: {listed}; they say little "
        "more than one, unless repeats are meant"
    )
    return [note]
