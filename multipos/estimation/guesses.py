"""Where the search for the parameters of a model of one's own starts: no guess but what is stated.

Parameters enter linearly where no second derivative joins two of them. Given the others, q, they
are those of least squares,

    l(q) = argmin |y - h(q, 0) - A l|,    A = dh/dl at q,                                    (1)

and where q has no stated start it is tried at a few values, all together and one by one; what
leaves the least misfit after steps of Gauss and Newton on all that is not stated is where the
search starts. The first that explains the readings ends the trials. Priors are starts.
"""

from collections.abc import Iterator, Mapping
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError
from multipos.numerics.arrays import Array
from multipos.numerics.terms import COMPONENTS
from multipos.positions.scheme import read_scheme
from multipos.sensor.expressions import ExpressionModel

_TRIED = (0.0, 1.0, 0.1, 10.0)  # values of what has no start
_ALONE = 3  # parameters of an output up to which all their combinations are tried
_STEPS = 2  # on each, where one does not explain the readings
_KEPT = 3  # guesses that are worth a search
_EXPLAINED = 1e-3  # of the readings' variance: what is left of it where no other is needed
_RANK = 1e-9  # of the largest, a direction that least squares of a guess leaves alone


class _Weighed(NamedTuple):
    """Readings (n, M), their force and surroundings, and the weight (M,) of each output.

    Each output counts by its spread: what they share must not be that of the largest alone.
    """

    values: Array
    force: Array
    environment: Mapping[str, Array]
    weight: Array


def first_guesses(
    model: ExpressionModel,
    values: Array,
    force: Array,
    environment: Mapping[str, Array],
    *,
    keep: bool = False,
) -> list[Array]:
    """Return where searches start, the best first, (p,) each.

    Parameters
    ----------
    model : ExpressionModel
    values : (n, M) array
        Readings.
    force : (n, 3) array [g]
    environment : mapping of str to (n,) array
    keep : bool
        Leave every parameter that has a start there.

    Raises
    ------
    MultiposError
        The model has no value at any of them.
    """
    linear = model.compiled.linear
    stated = np.isfinite(model.starts)
    free = ~stated & ~linear
    sought = (linear & (model.beliefs == 0.0) & ~(stated & keep)) | free
    readings = _Weighed(
        values, force, environment, 1.0 / np.maximum(np.std(values, axis=0), 1e-300)
    )
    found: list[tuple[float, Array]] = []
    enough = _EXPLAINED * values.size
    with np.errstate(all="ignore"):
        for start in _trials(model, np.where(stated, model.starts, 0.0), free):
            theta, misfit = model.within(start), np.inf
            for _ in range(_STEPS):
                theta = _improved(model, theta, sought, readings)
                misfit = _misfit(model, theta, readings)
                if misfit <= enough:
                    break
            if not np.isfinite(misfit):  # the steps left where the model has values
                theta = model.within(start)
                misfit = _misfit(model, theta, readings)
            if np.isfinite(misfit):
                found.append((misfit, theta))
            if misfit <= enough:
                break
    if not found:
        names = [name for name, one in zip(model.names, free.tolist(), strict=True) if one]
        which = ", ".join(f"`{name}`" for name in names) or "its parameters"
        raise MultiposError(
            f"the model has no value at the start of the search; state a start for {which} in "
            "[parameters] of a TOML file."
        )
    found.sort(key=lambda each: each[0])
    sure = not free.any() or found[0][0] <= enough
    return [theta for _, theta in found[: 1 if sure else _KEPT]]


def nominal_parameters(model: ExpressionModel) -> Array:
    """Return the parameters at which positions are judged (p,), before any reading.

    Those that are stated, and with them what comes nearest to an output of one per g along its own
    axis, and nothing at zero.

    Raises
    ------
    MultiposError
        As `first_guesses`.
    """
    force = read_scheme("fibonacci-100").up
    own = force[:, [COMPONENTS.index(axis) for axis in model.axes]]
    return first_guesses(model, own, force, {}, keep=True)[0]


def _trials(model: ExpressionModel, start: Array, free: NDArray[np.bool_]) -> Iterator[Array]:
    """Yield starts whose free parameters have values to be tried, alike for all outputs."""
    names = list(dict.fromkeys(str(model.keys[i][1]) for i in np.flatnonzero(free)))
    if len(names) <= _ALONE:
        values = list(product(_TRIED, repeat=len(names)))
    else:
        values = [(value,) * len(names) for value in _TRIED]
    for tried in values:
        theta = start.copy()
        for name, value in zip(names, tried, strict=True):
            for i in np.flatnonzero(free).tolist():
                if str(model.keys[i][1]) == name:
                    theta[i] = value
        yield theta


def _improved(
    model: ExpressionModel,
    theta: Array,
    sought: NDArray[np.bool_],
    readings: _Weighed,
) -> Array:
    """Return parameters after a step of Gauss and Newton on those that are sought, eq. (1)."""
    outputs, blocks = model.respond(theta, readings.force, readings.environment)
    left = readings.values - outputs
    rows = []
    for output, (places, slopes) in enumerate(blocks):
        whole = np.concatenate([slopes.T, left[None, :, output]]).T
        if not np.isfinite(whole).all():
            return theta
        R = np.linalg.qr(whole, mode="r") * readings.weight[output]  # tells what all rows do
        rows.append(np.zeros((len(R), len(theta) + 1)))
        rows[-1][:, places], rows[-1][:, -1] = R[:, :-1], R[:, -1]
    reduced = np.concatenate(rows)
    A = reduced[:, :-1][:, sought]
    size = np.sqrt(np.einsum("np,np->p", A, A))
    scale = np.where(size > 0.0, size, 1.0)
    moved = theta.copy()
    moved[sought] += np.linalg.lstsq(A / scale, reduced[:, -1], rcond=_RANK)[0] / scale
    return model.within(moved)


def _misfit(model: ExpressionModel, theta: Array, readings: _Weighed) -> float:
    outputs, blocks = model.respond(theta, readings.force, readings.environment)
    if not all(np.isfinite(slopes).all() for _, slopes in blocks):
        return np.inf
    return float(np.sum(((readings.values - outputs) * readings.weight) ** 2))
