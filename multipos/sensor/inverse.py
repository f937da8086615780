"""Compensation: the model's inverse, from raw readings back to specific force.

- `invert` solves for the force, `invert_at_rest` with one component that no output senses.
- `has_other_solutions` tells which readings a second force explains; `require_response` refuses
  parameters by which no force can be found.
- `sensitivities`, `parameter_jacobian`, `unseen_leak` and `inverses` are slopes of eqs. (1), (2).

The measurement equation `y = h(f)` of `multipos.sensor.model` is solved for the components that the
sensor has (the own axes of its outputs; the others, unseen, are taken as zero unless they are
known). Where h is linear the answer is one matrix product; otherwise Newton's iteration starts
from it,

    f <- f + J(f)^+ (y - h(f)),    J = dh/df,                                              (1)

row by row in one vectorised pass. With more outputs than axes `J^+` is the least-squares
inverse. To first order the parameters' covariance C reaches the answer through

    df/dp = -J^+ dh/dp,            cov(f) = (df/dp) C (df/dp)'.                             (2)

At rest |f| = g, which gives one unseen component w up to its sign,

    w = ±sqrt(max(0, g² - |f_seen|²)),                                                      (3)

and (1), (3) are solved by alternation: the error shrinks by about (cross term/scale factor) f/w a
turn.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import MultiposError
from multipos.numerics.arrays import Array, Environment, Mask, median
from multipos.numerics.factoring import is_regular
from multipos.sensor.model import Model

STEPS = 50  # quadratic convergence needs five; more means there is no solution
XTOL = 1e-13  # [g], where a step is only rounding
_APART = 1e-6  # [g], from which on two solutions are two
_CUBE = 9  # forces along an axis at which it is looked for a turning point


def invert(
    model: Model,
    parameters: Array,
    raw: Array,
    environment: Environment,
    *,
    unseen: Array | None = None,
    start: Array | None = None,
) -> Array:
    """Return the force (n, K) [g] that explains raw readings (n, M); NaN where none does.

    Parameters
    ----------
    model, parameters, raw, environment
        Of the calibration, and the readings to compensate; of a user-defined model each reading
        may have parameters (n, p) of its own.
    unseen : (n, 3) array, optional [g]
        Force whose components that no output senses are taken as known; zero otherwise.
    start : (3,) or (n, 3) array, optional [g]
        Where eq. (1) starts instead of zero.

    Raises
    ------
    MultiposError
        The linear part cannot be inverted.
    """
    sensed = list(model.sensed_axes)
    if model.is_linear:
        return _solve_linear(model, parameters, raw, unseen)
    force = np.zeros((len(raw), 3))
    if start is not None:
        force[:, sensed] = start[..., sensed]
    if unseen is not None:
        others = list(model.unseen_axes)
        force[:, others] = unseen[:, others]
    active = np.arange(len(raw))
    used = [*model.environment, *(name for name in model.of_session if name in environment)]
    columns = {name: np.asarray(environment[name], dtype=np.float64) for name in used}
    for _ in range(STEPS):
        here = {name: column[active] for name, column in columns.items()}
        own = parameters if parameters.ndim == 1 else parameters[active]
        misfit = raw[active] - model.predict(own, force[active], here)
        jacobian = model.force_jacobian(own, force[active], here)[:, :, sensed]
        step = _apply_inverse(jacobian, misfit)
        force[active[:, None], sensed] += step
        size = np.abs(step).max(axis=1)
        # A row that runs away has no solution near the linear one; NaN ends it below.
        moving = (size > XTOL * np.maximum(1.0, np.abs(force[active]).max(axis=1))) & (size < 1e6)
        stuck = ~np.isfinite(size) | (size >= 1e6)
        force[active[stuck]] = np.nan
        active = active[moving]
        if not len(active):
            break
    force[active] = np.nan
    return np.asarray(force[:, sensed])


def has_other_solutions(
    model: Model,
    parameters: Array,
    raw: Array,
    environment: Environment,
    *,
    found: Array,
    reach: float,
) -> Mask:
    """Tell which readings (n,) a second force within reach explains as well as the one found.

    Only a model that turns back has any: where det dh/df, relative to that at no force, keeps its
    sign over the cube of ± reach, no row is looked at. Elsewhere eq. (1) starts from either end of
    every axis as well.

    Parameters
    ----------
    model, parameters, raw, environment
        As in `invert`.
    found : (n, K) array [g]
        By `invert`.
    reach : float [g]
        What was calibrated.
    """
    sensed = list(model.sensed_axes)
    several = np.zeros(len(raw), dtype=bool)
    if not len(raw) or not _turns_back(model, parameters, environment, reach):
        return several
    for axis in sensed:
        for side in (-reach, reach):
            other = invert(model, parameters, raw, environment, start=side * np.eye(3)[axis])
            with np.errstate(invalid="ignore"):
                apart = np.abs(other - found).max(axis=1) > _APART
                several |= apart & (np.abs(other) <= reach * (1.0 + _APART)).all(axis=1)
    return several


def _turns_back(model: Model, parameters: Array, environment: Environment, reach: float) -> bool:
    """Tell whether the outputs turn back somewhere in the cube of ± reach."""
    sensed = list(model.sensed_axes)
    line = np.linspace(-reach, reach, _CUBE)
    axes = [line if i in sensed else np.zeros(1) for i in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    middle = {
        name: np.full(len(grid), median(np.asarray(environment[name])))
        for name in model.environment
    }
    jacobian = model.force_jacobian(parameters, grid, middle)[:, :, sensed]
    first = {name: column[:1] for name, column in middle.items()}
    nominal = np.linalg.pinv(model.force_jacobian(parameters, grid[:1] * 0.0, first)[0])
    determinant = np.linalg.det(nominal[sensed] @ jacobian)
    return not bool((determinant > 0.0).all())


def invert_at_rest(
    model: Model,
    parameters: Array,
    raw: Array,
    environment: Environment,
    *,
    magnitude: float,
    sign: ArrayLike,
) -> Array:
    """Return the force (n, 3) [g] of a sensor at rest, by eqs. (1) and (3).

    Two axes leave one component unseen, which (3) gives; one axis leaves two, of which nothing is
    known but their size, and they stay zero.

    Parameters
    ----------
    model, parameters, raw, environment
        As in `invert`.
    magnitude : float [g]
    sign : float or (n,) array
        Of the unseen component.
    """
    sensed, others = list(model.sensed_axes), list(model.unseen_axes)
    force = np.zeros((len(raw), 3))
    force[:, sensed] = invert(model, parameters, raw, environment)
    if len(others) != 1:
        return force
    for _ in range(STEPS):
        before = force[:, others[0]].copy()
        left = magnitude**2 - np.einsum("nk,nk->n", force[:, sensed], force[:, sensed])
        force[:, others[0]] = np.sign(sign) * np.sqrt(np.maximum(left, 0.0))
        if not (np.abs(force[:, others[0]] - before) > XTOL).any():
            break
        force[:, sensed] = invert(model, parameters, raw, environment, unseen=force)
    return force


def sensitivities(
    model: Model, parameters: Array, force: Array, environment: Environment
) -> tuple[Array, Array]:
    """Return J^+ (n, K, M) and dh/dp (n, M, p) of eqs. (1), (2) at force (n, 3) [g]."""
    jacobian = model.force_jacobian(parameters, force, environment)
    inverse = inverses(jacobian[:, :, list(model.sensed_axes)])
    return np.asarray(inverse), parameter_jacobian(model, parameters, force, environment)


def unseen_leak(model: Model, parameters: Array, force: Array, environment: Environment) -> Array:
    """Return J^+ dh/dw (n, K): what a unit of the one unseen component w does to the others."""
    jacobian = model.force_jacobian(parameters, force, environment)
    inverse = inverses(jacobian[:, :, list(model.sensed_axes)])
    leak: Array = inverse @ jacobian[:, :, list(model.unseen_axes)]
    return leak[:, :, 0]


def parameter_jacobian(
    model: Model, parameters: Array, force: Array, environment: Environment
) -> Array:
    """Return dh/dp (n, M, p) at force (n, 3) [g], of B units as in `Model.respond`."""
    _, blocks = model.respond(parameters, force, environment)
    result = np.zeros((len(force), len(model.outputs), len(model.keys)))
    for output, (places, slopes) in enumerate(blocks):
        result[:, output, places] = slopes
    return result


def inverses(jacobian: Array) -> Array:
    """Return J^+ (n, K, M) of J (n, M, K): the inverse where it is one, as pinv takes longer."""
    if len(jacobian) > 1 and (jacobian == jacobian[0]).all():  # of a linear model
        one = inverses(jacobian[:1])
        return np.broadcast_to(one, (len(jacobian), *one.shape[1:]))
    if jacobian.shape[1] == jacobian.shape[2]:
        try:
            return np.asarray(np.linalg.inv(jacobian))
        except np.linalg.LinAlgError:  # one that is singular must not cost the others theirs
            pass
    return np.asarray(np.linalg.pinv(jacobian))


def _apply_inverse(jacobian: Array, misfit: Array) -> Array:
    rows, columns = jacobian.shape[1:]
    if rows < columns:
        raise MultiposError(f"{rows} outputs cannot give {columns} components of force.")
    if rows > columns:
        transposed = jacobian.transpose(0, 2, 1)
        misfit = np.einsum("nij,nj->ni", transposed, misfit)
        jacobian = transposed @ jacobian
    try:
        return np.asarray(np.linalg.solve(jacobian, misfit[:, :, None])[:, :, 0])
    except np.linalg.LinAlgError:
        # One singular row must not cost the others their answer.
        sound: Mask = np.asarray(np.isfinite(jacobian).all(axis=(1, 2)))
        sound[sound] = np.linalg.matrix_rank(jacobian[sound]) == columns
        step = np.full(misfit.shape, np.nan)
        step[sound] = np.linalg.solve(jacobian[sound], misfit[sound][:, :, None])[:, :, 0]
        return step


def _rank(matrix: Array) -> int:
    """Return the rank of a matrix by powers of two of its largest entry, which overflow nowhere."""
    if is_regular(matrix):
        return len(matrix)
    exponent = int(np.frexp(np.abs(matrix).max())[1])
    return int(np.linalg.matrix_rank(np.ldexp(matrix, -exponent)))


def _solve_linear(model: Model, parameters: Array, raw: Array, unseen: Array | None) -> Array:
    sensed = [1 + axis for axis in model.sensed_axes]
    linear = model.linear_part(parameters, {})
    matrix = linear[:, sensed]
    if _rank(matrix) < matrix.shape[1]:
        raise MultiposError(
            "the scale factors and cross terms form a singular matrix, so no force can be found "
            "from readings; every output needs its own axis in the model, and must respond to it."
        )
    inverse = np.linalg.pinv(matrix) if len(matrix) > len(sensed) else np.linalg.inv(matrix)
    known = linear[:, 0]
    others = list(model.unseen_axes)
    if unseen is not None and others:
        known = known + unseen[:, others] @ linear[:, [1 + axis for axis in others]].T
    force: Array = (raw - known) @ inverse.T
    return force


def require_response(model: Model, parameters: Array, environment: Mapping[str, float]) -> None:
    """Refuse parameters by which an output does not respond to its axis: a file may say so.

    Parameters
    ----------
    model : Model
    parameters : (p,) array
    environment : mapping of column to its mean

    Raises
    ------
    MultiposError
        A scale factor is zero, or scale factors and cross terms are a singular matrix.
    """
    flat = [model.names[i] for i in model.own_scales if parameters[i] == 0.0]
    if flat:
        raise MultiposError(
            f"`{flat[0]}` is 0: the output does not respond to force, so that none can be found "
            "from it; calibrate again."
        )
    if not model.has_all_linear:
        return
    linear = model.linear_part(parameters, environment)
    matrix = linear[:, [1 + axis for axis in model.sensed_axes]]
    if _rank(matrix) < min(matrix.shape):
        raise MultiposError(
            "the scale factors and cross terms form a singular matrix, so no force can be found "
            "from readings; calibrate again."
        )
