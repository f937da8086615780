"""Monte Carlo: the budget propagated as distributions, to check what was propagated to first order.

`simulate_budget` does so and returns a `MonteCarlo`; `numerical_tolerance` is the δ below.

Each trial draws every input quantity (noise, gravity, level, orientation error, voltmeter) from its
law (`multipos.uncertainty.draws`), lets it act on the readings in full, not to first order, and
estimates the parameters again; their spread is the answer of JCGM 101, and U of JCGM 100 is valid
where it agrees with it.

- The number of trials is adaptive (JCGM 101, 7.9): blocks of trials are added until twice the
  standard deviation, over the blocks, of mean, u and both ends of the interval is below δ/5, with δ
  half of the last significant digit of u. One digit is the default.
- Intervals are probabilistically symmetric, or the shortest (7.7).
- Validation (8.1): with the ends of the Monte Carlo interval, d_low = |y − U − y_low| and
  d_high = |y + U − y_high| must both be below δ.
- Noise estimated from residuals on ν ≤ 2 degrees of freedom has no u, and only the intervals are
  judged.

With known orientations an estimate is one matrix product with the readings, however many trials.
With uncertain and unknown ones the likelihood is searched in every trial, with the noise of the fit
as its weights.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from multipos.errors import UsageError
from multipos.estimation.descent import maximise
from multipos.estimation.gains import estimator_gain, restate
from multipos.estimation.problem import start_state
from multipos.numerics.arrays import Array, Mask
from multipos.numerics.rotations import directions
from multipos.results import Result, Tabular, frozen, require
from multipos.sensor.calibration import Calibration
from multipos.sensor.temperature import runs_of
from multipos.uncertainty.draws import Draws

Solve = Callable[[Array], Array]  # readings (trials, n, M) -> parameters (trials, p)

_BLOCK = 10_000  # trials of a block (JCGM 101, 7.9.4)
_FEW = 100  # of an estimator that runs once a trial, so that progress shows
_MOST = 1_000_000  # all are kept until they are sorted


@frozen
class MonteCarlo(Result, Tabular):
    """What the trials gave.

    Attributes
    ----------
    names : tuple of p str
    trials : int
    stable : bool
        Whether the adaptive procedure ended by itself; False where it ran out of trials or
        their number was given.
    mean, u : (p,) arrays
        `u` is NaN where the law has none (Student's t on two degrees of freedom or fewer).
    symmetric, shortest : (p, 2) arrays
        Coverage intervals.
    tolerance : (p,) array
        δ of the validation.
    valid : (p,) bool array
        Whether U of the budget is valid, by the symmetric interval.
    """

    names: tuple[str, ...]
    trials: int
    stable: bool
    mean: Array
    u: Array
    symmetric: Array
    shortest: Array
    tolerance: Array
    valid: Mask

    def columns(self) -> dict[str, Any]:
        """Return the parameters: mean, u and both coverage intervals, tolerance and verdict."""
        return {
            "name": self.names,
            "mean": self.mean,
            "u": self.u,
            "low": self.symmetric[:, 0],
            "high": self.symmetric[:, 1],
            "shortest_low": self.shortest[:, 0],
            "shortest_high": self.shortest[:, 1],
            "tolerance": self.tolerance,
            "valid": self.valid,
        }

    def to_dict(self) -> dict[str, Any]:
        """Return everything as what JSON can carry."""
        keys = ("mean", "u", "symmetric", "shortest", "tolerance", "valid")
        figures = zip(*(getattr(self, key).tolist() for key in keys), strict=True)
        return {
            "trials": self.trials,
            "stable": self.stable,
            "parameters": [
                {"name": name, **dict(zip(keys, mine, strict=True))}
                for name, mine in zip(self.names, figures, strict=True)
            ],
        }


def simulate_budget(
    calibration: Calibration,
    *,
    trials: int | None = None,
    digits: int = 1,
    rng: "int | np.random.Generator" = 0,
    estimator: Solve | None = None,
    progress: Callable[[int], object] | None = None,
) -> MonteCarlo:
    """Propagate the budget of a calibration by Monte Carlo.

    Parameters
    ----------
    calibration : Calibration
    trials : int, optional
        Their number, from a hundred to a million; adaptive where not given.
    digits : int
        Significant digits of u that are to be meaningful: 1 or 2.
    rng : seed or Generator
    estimator : callable, optional
        Takes readings (trials, n, M), returns parameters (trials, p); by default the
        calibration's own.
    progress : callable, optional
        Called with the number of trials done.

    Returns
    -------
    MonteCarlo

    Raises
    ------
    UsageError
        An option is out of range, the calibration needs an `estimator`, or is of several runs.
    MultiposError
        The noise of the readings is unknown.

    Examples
    --------
    >>> import multipos as mp
    >>> cal = mp.state_budget(mp.demo().calibration, {"level": {"u_deg": 0.1}})
    >>> found = mp.simulate_budget(cal, trials=2000, rng=1)
    >>> found.trials, found.names[0]
    (2000, 'bias_ax')
    """
    require(calibration, Calibration)
    _check_options(trials, digits)
    c = calibration
    if runs_of(c.readings, c.model) is not None:
        raise UsageError(
            "U of the biases holds how the zero differs from run to run, which trials do not draw; "
            "simulate the fit of one run."
        )
    generator = np.random.default_rng(rng)
    solve = estimator or _own_estimator(c)
    draw = Draws(c, generator)
    delta = numerical_tolerance(c.u, digits)
    dof = c.model.per_parameter(draw.dof, draw.dof.sum())
    exists = np.where(dof > 2.0, 1.0, math.nan)
    at_once = estimator is not None or _is_product(c) or trials is None
    size = _BLOCK if at_once else _FEW
    blocks = _blocks(solve, draw, trials or _MOST, size, progress)
    if trials is None:
        done, stable = _until_stable(blocks, c.confidence, exists, delta)
    else:
        done, stable = list(blocks), False
    values = _sorted(np.concatenate(done))
    low, high = _symmetric(values, c.confidence)
    off = np.maximum(np.abs(c.parameters - c.U - low), np.abs(c.parameters + c.U - high))
    return MonteCarlo(
        names=c.names,
        trials=sum(map(len, done)),
        stable=stable,
        mean=values.mean(axis=1),
        u=values.std(axis=1, ddof=1) * exists,
        symmetric=np.column_stack([low, high]),
        shortest=_shortest(values, c.confidence),
        tolerance=delta,
        valid=off <= delta,
    )


def _check_options(trials: int | None, digits: int) -> None:
    if trials is not None and not 100 <= trials <= _MOST:
        raise UsageError(
            f"`trials` must lie between 100 and {_MOST}, got {trials}; a million determine the "
            "ends of an interval to three digits, beyond which it is the budget that is not known "
            "so well."
        )
    if digits not in (1, 2):
        raise UsageError(f"`digits` must be 1 or 2, got {digits}.")


def _blocks(
    solve: Solve,
    draw: Draws,
    most: int,
    size: int,
    progress: Callable[[int], object] | None,
) -> Iterator[Array]:
    """Yield the parameters (trials, p) of so many trials at a time."""
    count = 0
    while count < most:
        block = solve(draw(min(size, most - count)))
        count += len(block)
        if progress is not None:
            progress(count)
        yield block


def _until_stable(
    blocks: Iterator[Array], confidence: float, exists: Array, delta: Array
) -> tuple[list[Array], bool]:
    """Return blocks until their averages are stable to δ/5, and whether they became so."""
    least = max(_BLOCK, math.ceil(100.0 / (1.0 - confidence)))
    done: list[Array] = []
    summaries: list[Array] = []
    for block in blocks:
        done.append(block)
        low, high = _symmetric(_sorted(block), confidence)
        spread = block.std(axis=0, ddof=1) * exists
        summaries.append(np.array([block.mean(axis=0) * exists, spread, low, high]))
        if len(summaries) < 2 or sum(map(len, done)) < least:
            continue
        rest = np.std(summaries, axis=0, ddof=1) / math.sqrt(len(summaries))
        if (np.nan_to_num(2.0 * rest) <= delta / 5.0).all():
            return done, True
    return done, False


def numerical_tolerance(u: Array, digits: int) -> Array:
    """Return δ, half a unit of the last of so many significant digits of u (JCGM 101, 7.9.2)."""
    with np.errstate(divide="ignore"):
        exponent = np.floor(np.log10(u)) - (digits - 1)
    return np.asarray(0.5 * 10.0**exponent)


def _own_estimator(c: Calibration) -> Solve:
    """The calibration's own estimator, run in full."""
    if _is_product(c):
        gain = estimator_gain(c)
        return lambda readings: np.asarray(readings.reshape(len(readings), -1) @ gain.T)
    if c.robust_weight is not None:
        raise UsageError("give `estimator`, a function of the readings, for a robust calibration.")
    # About the solution itself: its reference is the listed one, already turned and stepped.
    problem = replace(restate(c), reference=c.reference)
    direction = directions(c.reference)

    def estimate(values: Array) -> Array:
        drawn = replace(problem, values=values)
        return maximise(drawn, start_state(drawn, c.parameters.copy(), direction)).state.theta

    return lambda readings: np.array([estimate(one) for one in readings])


def _is_product(c: Calibration) -> bool:
    """Whether the estimate is one matrix product with the readings."""
    return c.estimator.exact and c.model.has_terms


def _sorted(trials: Array) -> Array:
    """Trials (p, N) in order, one contiguous row for each parameter: sorting goes faster."""
    rows = np.ascontiguousarray(trials.T)
    rows.sort(axis=1)
    return rows


def _symmetric(values: Array, confidence: float) -> tuple[Array, Array]:
    """Ends of the probabilistically symmetric interval, from sorted trials (JCGM 101, 7.7.2)."""
    count = values.shape[1]
    inside = int(confidence * count + 0.5)
    first = (count - inside) // 2
    return values[:, first], values[:, min(first + inside, count - 1)]


def _shortest(values: Array, confidence: float) -> Array:
    """Ends (p, 2) of the shortest interval, from sorted trials (JCGM 101, 7.7.4)."""
    count = values.shape[1]
    inside = min(int(confidence * count + 0.5), count - 1)
    width = values[:, inside:] - values[:, : count - inside]
    first = width.argmin(axis=1)
    rows = np.arange(len(values))
    return np.column_stack([values[rows, first], values[rows, first + inside]])
