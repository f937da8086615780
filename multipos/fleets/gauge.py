"""Gauge repeatability and reproducibility: what readings of one unit differ by, and from what.

A number y of unit i at station j in repeat k, each of p units r times at each of s stations, is

    y_ijk = μ + a_i + b_j + c_ij + e_ijk,                                                    (1)

of variances σ_a² of units, σ_b² of stations, σ_c² of how stations differ from unit to unit, and
σ_e² of repeats. The mean squares of the four have the expectations

    λ_e = σ_e²,   λ_c = λ_e + r σ_c²,   λ_b = λ_c + p r σ_b²,   λ_a = λ_c + s r σ_a².          (2)

Solved for variances as they stand they are those of the analysis of variance, without bias, of
which some may be negative. Restricted likelihood keeps them from that: it pools a mean square that
is smaller than the one it must not be smaller than. Repeatability is σ_e, reproducibility
√(σ_b² + σ_c²), the gauge both.

A sum Σ c_q MS_q with ν_q degrees of freedom lies between, with q₋ and q₊ the quantiles of χ²,

    γ − √(Σ₊ (1 − ν/q₊)² c² MS² + Σ₋ (ν/q₋ − 1)² c² MS²)   and the same above,                (3)

Σ₊ over c > 0 and Σ₋ over c < 0; above they change places.

Sources: R. K. Burdick, C. M. Borror, D. C. Montgomery, Journal of Quality Technology 35, 2003,
342–354 (model, intervals of Graybill and Wang). W. A. Thompson, Annals of Mathematical Statistics
33, 1962, 273–289 (restricted likelihood by pooling). AIAG, Measurement Systems Analysis, chapter 3.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import chi2_quantile, f_tail

UNITS, STATIONS, BOTH, REPEATS = "units", "stations", "stations x units", "repeats"
_ABOVE = {UNITS: BOTH, STATIONS: BOTH, BOTH: REPEATS}  # which mean square none is smaller than
_CATEGORIES = 1.41  # √2: distinct categories of AIAG
_MOST = 1e6  # categories, beyond which a gauge has no spread but rounding


class MeanSquare(NamedTuple):
    """A sum of squares and its degrees of freedom."""

    squares: float
    dof: float

    @property
    def value(self) -> float:
        """The mean square."""
        return self.squares / self.dof


def analyse_variance(values: Array) -> dict[str, MeanSquare]:
    """Return the mean squares of values (p, s, r), each at least two."""
    p, s, r = values.shape
    of_unit, of_station = values.mean(axis=(1, 2)), values.mean(axis=(0, 2))
    of_both, mean = values.mean(axis=2), values.mean()
    crossed = of_both - of_unit[:, None] - of_station + mean
    return {
        UNITS: MeanSquare(s * r * float(np.sum((of_unit - mean) ** 2)), p - 1.0),
        STATIONS: MeanSquare(p * r * float(np.sum((of_station - mean) ** 2)), s - 1.0),
        BOTH: MeanSquare(r * float(np.sum(crossed**2)), (p - 1.0) * (s - 1.0)),
        REPEATS: MeanSquare(float(np.sum((values - of_both[:, :, None]) ** 2)), p * s * (r - 1.0)),
    }


def pool_restricted(found: Mapping[str, MeanSquare]) -> dict[str, float]:
    """Return λ of eq. (2) by restricted likelihood.

    The smallest is right if nothing must be smaller, else it is pooled with what must (Thompson).
    """
    left = dict(found)
    members = {name: [name] for name in found}
    above = dict(_ABOVE)
    settled: dict[str, float] = {}
    while left:
        least = min(left, key=lambda name: left[name].value)
        pooled = left.pop(least)
        over = above.get(least)
        if over is None or over not in left:
            settled |= dict.fromkeys(members[least], pooled.value)
            continue
        known = left[over]
        left[over] = MeanSquare(known.squares + pooled.squares, known.dof + pooled.dof)
        members[over] += members.pop(least)
        above = {name: over if each == least else each for name, each in above.items()}
    return settled


def coefficients(p: int, s: int, r: int) -> dict[str, dict[str, float]]:
    """Return by name what each variance is in mean squares, eq. (2) solved."""
    repeat = {REPEATS: 1.0}
    crossed = {BOTH: 1.0 / r, REPEATS: -1.0 / r}
    station = {STATIONS: 1.0 / (p * r), BOTH: -1.0 / (p * r)}
    unit = {UNITS: 1.0 / (s * r), BOTH: -1.0 / (s * r)}
    between = _sum(station, crossed)
    return {
        "repeatability": repeat,
        "station": station,
        "interaction": crossed,
        "reproducibility": between,
        "gauge": _sum(repeat, between),
        "units": unit,
    }


def _sum(one: Mapping[str, float], other: Mapping[str, float]) -> dict[str, float]:
    return {name: one.get(name, 0.0) + other.get(name, 0.0) for name in {**one, **other}}


def interval_of(
    shares: Mapping[str, float], found: Mapping[str, MeanSquare], confidence: float
) -> tuple[float, float]:
    """Return the interval of eq. (3) of a sum of mean squares, from 0 on."""
    tail = (1.0 - confidence) / 2.0
    middle = below = above = 0.0
    for name, share in shares.items():
        mean = found[name]
        part = share * mean.value
        near = 1.0 - mean.dof / chi2_quantile(1.0 - tail, mean.dof)
        far = mean.dof / chi2_quantile(tail, mean.dof) - 1.0
        down, up = (near, far) if share > 0.0 else (far, near)
        middle, below, above = middle + part, below + (down * part) ** 2, above + (up * part) ** 2
    return max(middle - below**0.5, 0.0), max(middle + above**0.5, 0.0)


def describe_gauge(
    values: Array, width: float | None = None, confidence: float = 0.95
) -> dict[str, Any]:
    """Return what repeats of units at stations tell of one number.

    Parameters
    ----------
    values : (p, s, r) array
        Of every unit, station and repeat.
    width : float, optional
        From the lower to the upper limit.
    confidence : float
    """
    found = analyse_variance(values)
    pooled = pool_restricted(found)
    components = {
        name: {
            "sd": max(sum(share * pooled[each] for each, share in shares.items()), 0.0) ** 0.5,
            "variance_anova": sum(share * found[each].value for each, share in shares.items()),
            "low": low**0.5,
            "high": high**0.5,
        }
        for name, shares in coefficients(*values.shape).items()
        for low, high in [interval_of(shares, found, confidence)]
    }
    gauge, units = components["gauge"]["sd"], components["units"]["sd"]
    total = float(np.hypot(gauge, units))
    return {
        "anova": [_line(found, name) for name in (UNITS, STATIONS, BOTH, REPEATS)],
        **components,
        "share": gauge / total if total > 0.0 else None,
        "distinct": int(min(_CATEGORIES * units / gauge, _MOST)) if gauge > 0.0 else None,
        "tolerance": None if width is None else 6.0 * gauge / width,
    }


def _line(found: Mapping[str, MeanSquare], name: str) -> dict[str, Any]:
    """Return a line of the analysis of variance, tested against what it must not be below."""
    mean = found[name]
    line = {"source": name, "dof": mean.dof, "squares": mean.squares, "mean_square": mean.value}
    below = None if name == REPEATS else found[_ABOVE[name]]
    if below is None or not below.value > 0.0:
        return {**line, "F": None, "p": None}
    ratio = mean.value / below.value
    return {**line, "F": ratio, "p": f_tail(ratio, mean.dof, below.dof)}
