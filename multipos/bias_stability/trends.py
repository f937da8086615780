"""What moves a static output besides noise: warm-up, drift, temperature.

- `describe` returns the `Description` of an output over records of `Blocks`, each part of it a
  `TrendEstimate`.

The means y of blocks of L samples, several hundred a record, at the times t since its begin:

    y = c + R t + k (T − T_0) + A exp(−t/T_w) + e,                                          (1)

with c, R, k and A of every record its own and T_w common. e are blocks of noise by the laws of
`multipos.bias_stability.allan`, so cov e follows from N², B², K² (its eq. (3)): generalised least
squares with it, and the laws from the Allan curve without R, k, A, are found by alternation. Noise
that walks looks like drift and warm-up. Whether there is one of them is therefore judged by the
likelihood of both explanations, each with the noise that it leaves:

    −2 ln L = ln det C + ln 1'C⁻¹1 + r'C⁻¹r.                                                 (2)

Over several records a coefficient is the weighted mean, its u the larger of what noise explains and
what the records scatter.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from multipos.bias_stability.allan import phase_covariance, pooled_variances, starts
from multipos.bias_stability.noise_laws import Laws, fit_laws
from multipos.bias_stability.static_records import Blocks
from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import chi2_quantile

DRIFT, TEMPERATURE, WARM_UP = "drift", "temperature", "warm_up"

_TURNS = 8  # of alternation of coefficients and noise
_FARTHEST = 0.5  # of the logarithm of the time constant, in one step
_SETTLED = 1e-4  # relative change of the time constant
_CERTAIN = 1.0 - 1e-4  # a drift or warm-up that noise would feign more often is none
_TRIED = 40  # time constants to begin with
_LONGEST = 3  # a share of the record: 1/3; what takes longer is a drift
_SHORTEST = 2  # blocks
_USED = 8  # a share of the record: longer averages, of which there are few, tell no law
_WHITE = Laws(np.array([1.0, 0.0, 0.0]), np.zeros((3, 3)), 0, 0.0, 0)  # to begin with
_TOGETHER = 1e-13  # of a column: what the others leave of it when it is one with them
_LEAST = 1e-3  # of a variance that is left where a trend is taken off


class TrendEstimate(NamedTuple):
    """A coefficient over all records: value, standard uncertainty, degrees of freedom."""

    value: float
    u: float
    dof: float


class Description(NamedTuple):
    """Trends and noise of one output, in samples and one sample time.

    Attributes
    ----------
    coefficients : dict of str to TrendEstimate
        Of `drift`, `temperature`, `warm_up` (its amplitude), those in the model.
    time_constant : TrendEstimate or None
    trends : tuple of (b,) array
        Of every record, without its constant.
    transients : tuple of (b,) array
        The warm-up of every record; zero where there is none.
    square, likelihood : float
        r'C⁻¹r and −2 ln L of eq. (2), over all records.
    step : float
        Of ln T_w, by which least squares would move it.
    laws : Laws
        Of the noise, by which it was fitted.
    """

    coefficients: dict[str, TrendEstimate]
    time_constant: TrendEstimate | None
    trends: tuple[Array, ...]
    transients: tuple[Array, ...]
    square: float
    likelihood: float
    step: float
    laws: Laws

    @property
    def moved(self) -> float | None:
        """The time constant after the step."""
        if self.time_constant is None:
            return None
        return self.time_constant.value * math.exp(self.step)


def describe(records: Sequence[Blocks], lengths: Sequence[int]) -> Description:
    """Return the trends and the noise of one output."""
    known = (TEMPERATURE,) if records[0].temperature is not None else ()
    plain = _describe(records, lengths, known)
    drifting = _describe(records, lengths, (*known, DRIFT))
    count = len(records)
    chosen = drifting if _better(drifting, plain, count) else plain
    warm = _warming(records, lengths, known)
    if warm is not None and _better(warm, chosen, 2 * count + 1):
        return warm
    if chosen is plain:  # a drift that is none has its U all the same
        found = _least_squares(records, (*known, DRIFT), None, plain.laws)
        plain.coefficients[DRIFT] = found.coefficients[DRIFT]
    return chosen


def _better(richer: Description, poorer: Description, more: int) -> bool:
    gain = poorer.likelihood - richer.likelihood
    return gain > chi2_quantile(_CERTAIN, more)


def _warming(
    records: Sequence[Blocks], lengths: Sequence[int], known: tuple[str, ...]
) -> Description | None:
    """Return the description with a warm-up, or None where nothing settles inside the records."""
    low = float(_SHORTEST * max(record.length for record in records))
    high = max(record.samples for record in records) / _LONGEST
    if not low < high:
        return None
    names = (*known, DRIFT, WARM_UP)
    tried = np.geomspace(low, high, _TRIED).tolist()
    left = [sum(_left_white(record, names, constant) for record in records) for constant in tried]
    found = _describe(records, lengths, names, tried[int(np.argmin(left))])
    assert found.time_constant is not None
    return found if low <= found.time_constant.value <= high else None


def _left_white(record: Blocks, names: tuple[str, ...], constant: float) -> float:
    """Return the squares that eq. (1) leaves of white noise of one sample's variance 1.

    As `_least_squares` gives them, without its factor: 40 of these are a sixth of all the time.
    """
    X = _columns(record, names, constant)
    rest = record.values - X @ np.linalg.lstsq(X, record.values, rcond=None)[0]
    return record.length * float(rest @ rest)


def _describe(
    records: Sequence[Blocks],
    lengths: Sequence[int],
    names: tuple[str, ...],
    constant: float | None = None,
) -> Description:
    """Find coefficients and noise by alternation."""
    fit = _least_squares(records, names, constant, _WHITE)
    laws = _noise(records, lengths, fit.trends)
    for _ in range(_TURNS):
        fit = _least_squares(records, names, fit.moved, laws)
        laws = _noise(records, lengths, fit.trends)
        if constant is None or abs(fit.step) < _SETTLED:
            break
    return _least_squares(records, names, fit.moved, laws)


def _least_squares(
    records: Sequence[Blocks], names: tuple[str, ...], constant: float | None, laws: Laws
) -> Description:
    """Fit eq. (1), linear but for the time constant, which takes one step of Gauss and Newton."""
    designs = [_columns(record, names, constant) for record in records]
    white, logs = [], 0.0
    for record, design in zip(records, designs, strict=True):
        rows, log = _whitened(record, np.column_stack([design, record.values]), laws.squares)
        logs += log + math.log(float(rows[:, 0] @ rows[:, 0]))
        white.append(rows)
    own = [np.asarray(np.linalg.lstsq(r[:, :-1], r[:, -1], rcond=None)[0]) for r in white]
    left: list[Array] = [rows[:, -1] - rows[:, :-1] @ b for rows, b in zip(white, own, strict=True)]
    square = sum(float(r @ r) for r in left)
    # The warm-up comes last, where there is one.
    warm = [0.0 if constant is None else float(b[-1]) for b in own]
    step, u_step, covariances = _step(records, constant, laws.squares, white, own, left)
    time_constant = (
        None if constant is None else TrendEstimate(constant, constant * u_step, math.inf)
    )
    return Description(
        coefficients=_coefficients(names, own, covariances),
        time_constant=time_constant,
        trends=tuple(X[:, 1:] @ b[1:] for X, b in zip(designs, own, strict=True)),
        transients=tuple(a * X[:, -1] for a, X in zip(warm, designs, strict=True)),
        square=square,
        likelihood=logs + square,
        step=min(max(step, -_FARTHEST), _FARTHEST),
        laws=laws,
    )


def _step(
    records: Sequence[Blocks],
    constant: float | None,
    squares: Array,
    white: list[Array],
    own: list[Array],
    left: list[Array],
) -> tuple[float, float, list[Array]]:
    """Return the step of ln T_w, its standard uncertainty, and the covariances of all others."""
    covariances = [_covariance_of(rows[:, :-1]) for rows in white]
    if constant is None:
        return 0.0, 0.0, covariances
    upward = weight = 0.0
    slopes = []
    for record, rows, b, r in zip(records, white, own, left, strict=True):
        slope = b[-1] * record.time / constant * np.exp(-record.time / constant)  # by ln T_w
        slope = _whitened(record, slope, squares)[0]
        along = np.linalg.lstsq(rows[:, :-1], slope, rcond=None)[0]
        rest = slope - rows[:, :-1] @ along
        slopes.append(along)
        upward += float(rest @ r)
        weight += float(rest @ rest)
    if not weight > 0.0:
        return 0.0, math.inf, covariances
    widened = [C + np.outer(a, a) / weight for C, a in zip(covariances, slopes, strict=True)]
    return upward / weight, 1.0 / math.sqrt(weight), widened


def _covariance_of(rows: Array) -> Array:
    """Return the covariance of coefficients; of those that go together it is huge, not infinite."""
    R: Array = np.array(np.linalg.qr(rows, mode="r"))
    least = _TOGETHER * np.linalg.norm(R, axis=0)
    small = np.abs(np.diag(R)) < least
    R[small, small] = least[small]
    inverse = np.linalg.inv(R)
    return np.asarray(inverse @ inverse.T)


def _columns(record: Blocks, names: tuple[str, ...], constant: float | None) -> Array:
    """Return the columns of eq. (1), the constant first and the warm-up last."""
    time = record.time
    columns = [np.ones(len(time))]
    for name in names:
        if name == DRIFT:
            columns.append(time - time.mean())
        elif name == TEMPERATURE:
            assert record.temperature is not None
            columns.append(record.temperature - record.temperature.mean())
        else:
            assert constant is not None
            columns.append(np.exp(-time / constant))
    return np.column_stack(columns)


def _whitened(record: Blocks, columns: Array, squares: Array) -> tuple[Array, float]:
    """Return columns whose noise is white and of size one, and ln det C."""
    factor = _factor(len(record.values), record.length, tuple(squares.tolist()))
    rows = _solve_lower(factor, columns)
    return rows, 2.0 * float(np.log(np.diag(factor)).sum())


def _solve_lower(factor: Array, columns: Array) -> Array:
    try:
        from scipy.linalg import solve_triangular
    except ImportError:  # which does not know that half of it is zero, and takes longer
        return np.asarray(np.linalg.solve(factor, columns))
    return np.asarray(solve_triangular(factor, columns, lower=True, check_finite=False))


@lru_cache(maxsize=8)
def _factor(count: int, length: int, squares: tuple[float, ...]) -> Array:
    return np.asarray(np.linalg.cholesky(_covariance(count, length, np.array(squares))))


def _covariance(count: int, length: int, squares: Array) -> Array:
    """Return cov e of so many blocks; to flicker and walk a constant is added, which c takes up."""
    lags = np.arange(count, dtype=np.float64)
    R = [phase_covariance((lags + by) * length) for by in (-1.0, 0.0, 1.0)]
    kernels = (2.0 * R[1] - R[0] - R[2]) / length**2
    kernel = squares[:3] @ kernels
    if len(squares) > 3:
        kernel[:2] += squares[3] / length**2 * np.array([2.0, -1.0])[:count]
    kernel[0] *= 1.0 + 1e-9  # what rounding may have taken
    index = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    return np.asarray(kernel[index] + 2.0 * np.abs(squares[1:3] @ kernels[1:3]).max())


def _coefficients(
    names: tuple[str, ...], own: list[Array], covariances: list[Array]
) -> dict[str, TrendEstimate]:
    return {
        name: _pooled([b[i] for b in own], [C[i, i] for C in covariances])
        for i, name in enumerate(names, start=1)
    }


def _pooled(values: list[float], variances: list[float]) -> TrendEstimate:
    """Return the weighted mean over records, u by noise or by scatter."""
    weight = 1.0 / np.array(variances)
    mean = float(weight @ values / weight.sum())
    u, dof = 1.0 / math.sqrt(float(weight.sum())), math.inf
    if len(values) > 1:
        ratio = float(weight @ (np.array(values) - mean) ** 2) / (len(values) - 1)
        if ratio > 1.0:
            u, dof = u * math.sqrt(ratio), len(values) - 1.0
    return TrendEstimate(mean, u, dof)


def _noise(records: Sequence[Blocks], lengths: Sequence[int], trends: Sequence[Array]) -> Laws:
    """Return the laws of the Allan curve that is left without the trends."""
    samples = [record.samples for record in records]
    longest = max(samples)
    used = [m for m in lengths if m <= max(longest / _USED, lengths[min(3, len(lengths) - 1)])]
    left = [_left_over(*each, used) for each in zip(records, trends, strict=True)]
    return fit_laws(used, pooled_variances(left, used, samples), samples)


def _left_over(record: Blocks, trend: Array, lengths: Sequence[int]) -> Array:
    """Return the sums of the squared second differences of one record without its trend.

    Over short times the trend is a slope, whose square is taken off; over long ones the blocks
    without the trend give the sum.
    """
    L = record.length
    slope = float(np.mean(np.gradient(trend) ** 2)) / L**2 if len(trend) > 1 else 0.0
    phases = np.concatenate([[0.0], np.cumsum(record.values - record.values.mean() - trend)]) * L
    found = np.zeros(min(len(lengths), len(record.sums)))
    for i, m in enumerate(lengths[: len(found)]):
        count = starts(record.samples, m)
        k = m // L
        if k < 2 or 2 * k >= len(phases):
            whole = record.sums[i]
            found[i] = max(whole - count * slope * m**4, _LEAST * whole)
        else:
            z = phases[2 * k :] - 2.0 * phases[k:-k] + phases[: -2 * k]
            found[i] = count * float(np.mean(z**2))
    return found
