"""User-defined models: where their search starts, their fit at known orientations, their gauge.

`first_guesses` are where searches start, and `nominal_parameters` where positions are assessed.
`solve_own_known` fits at known orientations where `is_untied`, and `share_expression` and
`estimate_expression` do so for many units, with their `cofactors`. `rotations_to_hold` is what a
gauge holds, and `hold_free_rotations` the model with it.

**Start.** No guess is asked for but what is stated. Parameters enter linearly where no second
derivative joins two of them. Given the others, q, they are those of least squares,

    l(q) = argmin |y − h(q, 0) − A l|,    A = dh/dl at q,                                   (1)

and where q has no stated start it is tried at a few values, all together and one by one; what
leaves the least misfit after Gauss–Newton steps on all that is not stated is where the search
starts. The first that explains the readings ends the trials. Means of priors are starts.

**Known orientations.** Where no prior or shared parameter ties the outputs, all are searched for
together; weights of whole outputs change none of them. About the end p, A = dh/dp, the readings are
those of a linear model,

    y − h(p) + A p = A p' + e,                                                              (2)

whose least squares are at p' = p: covariance, degrees of freedom, leverage and what cannot be
separated are those of `multipos.estimation.known`. A model that is linear in its parameters is (2)
everywhere, and needs no search. To second order the estimate is off by

    E p − p = −½ C Σ_k a_k tr(C ∂²h_k/∂p²)/s²,    C its covariance, a_k = ∂h_k/∂p,           (3)

as noise moves h by its curvature and least squares take that for parameters; a bias of more than a
tenth of u is reported.

**Gauge.** Where no position is listed, a common rotation w of all directions, df = w × f, can be
undone by the parameters if some change d of them moves every reading as it does,

    A d = J (w × f)   at all positions,    J = dh/df:                                       (4)

the null space of [A, −J (e_a × f)], and what is as good as that: a small square of the own axis
determines the axis a thousand times worse than linear terms determine the rest, so that a rotation
counts as free there as it does in a polynomial model. Its dimension along w is how many rotations
are free; as many parameters are held, by choice those that a lower triangular matrix of
sensitivities has as zeros, slopes along a later axis. Where no rotation leaves a model as it is,
the model itself fixes its axes, and nothing is held.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from multipos.errors import ConvergenceError, MultiposError, UsageError
from multipos.estimation.batches import Estimates
from multipos.estimation.descent import maximise, resume
from multipos.estimation.known import ROUNDING, solve_known
from multipos.estimation.problem import Optimum, Problem, Solution, State, start_state
from multipos.files.records import LARGEST
from multipos.finding import Finding, Findings
from multipos.numerics.arrays import COMPONENTS, Array, Mask
from multipos.numerics.rotations import cross_matrix
from multipos.positions.readings import Readings
from multipos.positions.scheme import read_scheme
from multipos.results import frozen
from multipos.sensor.calibration import Calibration
from multipos.sensor.inverse import inverses, invert, parameter_jacobian
from multipos.sensor.model import Block, Gauge, Model
from multipos.sensor.own_models import Fixed, hold

_TRIED = (0.0, 1.0, 0.1, 10.0)  # values of what has no start
_ALONE = 3  # parameters of an output up to which all their combinations are tried
_STEPS = 2  # on each, where one does not explain the readings
_KEPT = 3  # guesses from which a search starts
_EXPLAINED = 1e-3  # of the readings' variance: what is left of it where no other is needed
_RANK = 1e-9  # of the largest, a direction that least squares of a guess leaves alone


class _Weighted(NamedTuple):
    """Readings (n, M), their force and surroundings, and the weight (M,) of each output.

    Each output counts by its spread: what they share must not be that of the largest alone.
    """

    values: Array
    force: Array
    environment: Mapping[str, Array]
    weight: Array


def first_guesses(
    model: Model,
    values: Array,
    force: Array,
    environment: Mapping[str, Array],
    *,
    keep: bool = False,
) -> list[Array]:
    """Return where searches start, the best first, (p,) each.

    Parameters
    ----------
    model : Model
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
    linear = model.linear
    stated = np.isfinite(model.starts)
    free = ~stated & ~linear
    sought = (linear & (model.beliefs == 0.0) & ~(stated & keep)) | free
    readings = _Weighted(
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
        if not names:
            with np.errstate(all="ignore"):
                there = model.respond(model.within(start), force, environment)
            _require_values(model, *there)
        which = ", ".join(f"`{name}`" for name in names) or "its parameters"
        raise MultiposError(
            f"the model has no value at the start of the search; state a start for {which} in "
            "[parameters] of a TOML file."
        )
    found.sort(key=lambda each: each[0])
    sure = not free.any() or found[0][0] <= enough
    return [theta for _, theta in found[: 1 if sure else _KEPT]]


def nominal_parameters(model: Model) -> Array:
    """Return the parameters at which positions are assessed (p,), before any reading.

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


def _trials(model: Model, start: Array, free: Mask) -> Iterator[Array]:
    """Yield starts whose free parameters have values to be tried, the same for all outputs."""
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


def _improved(model: Model, theta: Array, sought: Mask, readings: _Weighted) -> Array:
    """Return parameters after a step of Gauss and Newton on those that are sought, eq. (1)."""
    outputs, blocks = model.respond(theta, readings.force, readings.environment)
    left = readings.values - outputs
    rows = []
    for output, (places, slopes) in enumerate(blocks):
        whole = np.concatenate([slopes.T, left[None, :, output]]).T
        if not np.isfinite(np.einsum("np,np->", whole, whole)):  # as LAPACK needs
            return theta
        R = np.linalg.qr(whole, mode="r") * readings.weight[output]  # equivalent to all rows
        rows.append(np.zeros((len(R), len(theta) + 1)))
        rows[-1][:, places], rows[-1][:, -1] = R[:, :-1], R[:, -1]
    reduced = np.concatenate(rows)
    A = reduced[:, :-1][:, sought]
    size = np.sqrt(np.einsum("np,np->p", A, A))
    scale = np.where(size > 0.0, size, 1.0)
    moved = theta.copy()
    moved[sought] += np.linalg.lstsq(A / scale, reduced[:, -1], rcond=_RANK)[0] / scale
    return model.within(moved)


def _misfit(model: Model, theta: Array, readings: _Weighted) -> float:
    outputs, blocks = model.respond(theta, readings.force, readings.environment)
    if not all(np.isfinite(slopes).all() for _, slopes in blocks):
        return np.inf
    return float(np.sum(((readings.values - outputs) * readings.weight) ** 2))


_ROUNDS = 8  # of excess variance and solution
_CONVERGED = 1e-4  # of u
_MANY = 200  # readings from which on the bias (3) is not computed
_STATED = 0.1  # of u
_EQUAL = 5.0  # of ln: residuals that differ by so much leave each output its digits in one search
_LEAST = 1e-14  # of an output's spread, below which no residual is known
_NONE = 1e-150  # of a reading, whose square and its inverse are numbers yet
_WELL_POSED = 1e4  # condition up to which normal equations keep the digits of a step
_MOST_STEPS = 12  # from the parameters of a unit beside it
_SETTLED = 1e-8  # of u: the next step is less by as much as residuals bend the model
_MAY_BE = 0.5  # of the bias that is stated, which differs from unit to unit by more than its noise


def is_untied(model: Model, readings: Readings) -> bool:
    """Return whether a user-defined model can be fitted as `solve_own_known` does."""
    noise = readings.noise
    return model.all_linear or (model.apart and (noise is None or noise.ndim == 1))


def solve_own_known(
    model: Model,
    reference: Array,
    readings: Readings,
    *,
    pool: bool = False,
    tested: bool = True,
) -> Solution:
    """Fit a user-defined model at known orientations, by (2); options as in `solve_known`.

    Raises
    ------
    MultiposError
        A formula has no value at a position.
    RankError
        The positions cannot separate the parameters, which are named.
    ConvergenceError
        No start led to a minimum.
    """

    def about(theta: Array, residuals: Array, blocks: tuple[Block, ...]) -> Solution:
        """Return the least squares of the model (2) about parameters."""
        reached = [slopes @ theta[places] for places, slopes in blocks]
        design = np.concatenate([slopes.T for _, slopes in blocks]).T
        tangent = design, residuals + np.array(reached).T
        return solve_known(model, reference, readings, tangent=tangent, pool=pool, tested=tested)

    if model.all_linear:
        start = np.zeros(len(model.keys))
        outputs, blocks = model.respond(start, reference, readings.environment)
        _require_values(model, outputs, blocks, readings.labels)
        return about(start, readings.values - outputs, blocks)
    problem, best = _searched(model, reference, readings)
    solution = about(best.state.theta, best.point.residuals, best.point.blocks)
    noise = readings.noise
    if noise is not None and np.ptp(noise.reshape(readings.values.shape), axis=0).any():
        for _ in range(_ROUNDS):  # excess variance changes weights
            before = best.state.theta
            variance = noise.reshape(readings.values.shape) + _excess(solution)
            best = resume(replace(problem, precision=1.0 / variance), best)
            solution = about(best.state.theta, best.point.residuals, best.point.blocks)
            moved = np.abs(best.state.theta - before)
            if (moved <= _CONVERGED * np.sqrt(np.diag(solution.covariance))).all():
                break
    said = _curvature_bias(model, best, reference, readings, solution)
    return replace(solution, status=best.status, findings=(*solution.findings, *said))


def _require_values(
    model: Model, outputs: Array, blocks: Sequence[Block], labels: Sequence[str] = ()
) -> None:
    """Raise where a formula that is linear in what is free has no value at a position."""
    for name, response, (_, slopes) in zip(model.outputs, outputs.T, blocks, strict=True):
        none = np.flatnonzero(~(np.isfinite(response) & np.isfinite(slopes).all(axis=1)))
        if len(none):
            count, n = len(none), len(response)
            if not labels:
                raise MultiposError(
                    f"the formula of {name} has no value at {count} of {n} positions; "
                    "change the formula."
                )
            raise MultiposError(
                f"the formula of {name} has no value at {count} of {n} positions, first at "
                f"{labels[none[0]]}; change the formula, or omit these positions."
            )


def _excess(solution: Solution) -> Array:
    """Return the variance (M,) of each output in excess of the stated noise."""
    found = solution.variance_components
    if found is None or found.rest_to_rest is None:
        return np.zeros(len(solution.model.outputs))
    return np.array([found.rest_to_rest[o].value ** 2 for o in solution.model.outputs])


def _curvature_bias(
    model: Model, best: Optimum, reference: Array, readings: Readings, solution: Solution
) -> Findings:
    """State the bias (3) of parameters where it matters; of many readings it is far below u.

    It falls with their number, and u with the root of it.
    """
    sd = solution.residual_sd
    if len(readings) > _MANY or not (np.isfinite(sd) & (sd > 0.0)).all():
        return ()
    bend = model.second_derivatives(best.state.theta, reference, readings.environment)
    bias = _bias(bend, best.point.blocks, solution.covariance, sd)
    u = np.sqrt(np.diag(solution.covariance))
    far = np.abs(bias) > _STATED * u
    return tuple(
        Finding(
            "model-bias",
            "warning",
            (
                f"`{name}` is too {'large' if off > 0.0 else 'small'} by about "
                f"{abs(off):.2g}, as the model is nonlinear within its uncertainty"
            ),
            "Average longer, or add positions.",
        )
        for name, off, stated in zip(model.names, bias.tolist(), far.tolist(), strict=True)
        if stated
    )


def _bias(bend: Array, blocks: Sequence[Block], covariance: Array, sd: Array) -> Array:
    """Return E p − p (p,) of eq. (3), by d²y/dp² (n, M, p, p); `sd` (M,) are of residuals."""
    moved = np.tensordot(bend, covariance) / sd**2
    right = np.zeros(len(covariance))
    for output, (places, slopes) in enumerate(blocks):
        right[places] += moved[:, output] @ slopes
    return np.asarray(-0.5 * covariance @ right)


@frozen
class SharedExpression:
    """A user-defined model at positions that units share, about the parameters of one of them.

    Attributes
    ----------
    model : Model
    reference : (n, 3) array [g]
    environment : mapping of str to (n,) array
        Other columns of the model.
    start : (p,) array
        Parameters of that unit.
    bias : (p,) array
        Size of eq. (3) in u, for a residual standard deviation of 1.
    """

    model: Model
    reference: Array
    environment: Mapping[str, Array]
    start: Array
    bias: Array

    def respond(self, parameters: Array) -> tuple[Array, list[Array]]:
        """Return the outputs (B, n, M) and dy/dp (B, n, p_i) of parameters (B, p)."""
        count, n = len(parameters), len(self.reference)
        rows = np.repeat(parameters, n, axis=0), *self.rows(count)
        outputs, blocks = self.model.respond(*rows)
        slopes = [each.reshape(count, n, -1) for _, each in blocks]
        return outputs.reshape(count, n, -1), slopes

    def rows(self, count: int) -> tuple[Array, dict[str, Array]]:
        """Return the reference and the environment of so many units, one after the other."""
        columns = {name: np.tile(each, count) for name, each in self.environment.items()}
        return np.tile(self.reference, (count, 1)), columns


def share_expression(c: Calibration) -> SharedExpression | None:
    """Return what units share with one whose outputs were fitted apart, without stated noise.

    None where their search cannot begin at its parameters, or where the bias (3) is not known.
    """
    model, sd = c.model, c.residual_sd
    posed = model.apart and c.diagnostics.condition <= _WELL_POSED
    if not posed or c.noise is not None or not (np.isfinite(sd) & (sd > 0.0)).all():
        return None
    columns = {name: c.readings.environment[name] for name in model.environment}
    bias = np.zeros(len(c.parameters))
    if len(c.readings) <= _MANY:
        at = c.parameters, c.reference, columns
        bias = _bias(model.second_derivatives(*at), model.respond(*at)[1], c.covariance, sd)
    per_sd = np.abs(bias) / (c.u * model.per_parameter(sd))
    return SharedExpression(model, c.reference, columns, c.parameters, per_sd)


def estimate_expression(shared: SharedExpression, values: Sequence[Array]) -> Estimates:
    """Fit B units, as `fit` each of them, by steps of Gauss and Newton from the shared start.

    Those whose steps do not settle are not sound, nor is one whose bias (3) may be stated.

    Parameters
    ----------
    shared : SharedExpression
    values : sequence of M arrays (B, n)
    """
    model, n, y = shared.model, len(shared.reference), np.stack(list(values), axis=2)
    theta = np.tile(shared.start, (len(y), 1))
    u, step = np.ones(theta.shape), np.full(theta.shape, np.inf)
    with np.errstate(all="ignore"):
        for _ in range(_MOST_STEPS):
            outputs, slopes = shared.respond(theta)
            left = y - outputs
            for i, (places, A) in enumerate(zip(model.places, slopes, strict=True)):
                cofactor = cofactors(A)
                r = left[:, :, i, None]
                step[:, places] = (cofactor @ (A.transpose(0, 2, 1) @ r))[:, :, 0]
                variance = np.einsum("bnk,bnk->b", r, r) / (n - len(places))
                u[:, places] = np.sqrt(variance[:, None] * np.einsum("bpp->bp", cofactor))
            theta += step
            moving = np.abs(step) > _SETTLED * u
            if not moving.any():
                break
        sound = ~moving.any(axis=1) & (np.abs(theta).max(axis=1) <= LARGEST)
        theta[~sound] = shared.start
        left = y - shared.respond(theta)[0]
        square = np.einsum("bnm,bnm->bm", left, left)
        sound &= (square > ROUNDING**2 * np.einsum("bnm,bnm->bm", y, y)).all(axis=1)
        dof = np.array([float(n - len(places)) for places in model.places])
        sd = np.sqrt(square / dof)
        sound &= (shared.bias * model.per_parameter(sd) < _MAY_BE * _STATED).all(axis=1)
        rms, sensitivity = _compensated(shared, theta, y)
    return Estimates(
        parameters=theta,
        u=u,
        dof=model.per_parameter(dof),
        rms=rms,
        residuals=np.moveaxis(left, 2, 0),
        sensitivity=sensitivity,
        inverse=inverses(sensitivity),
        sound=sound,
    )


def cofactors(A: Array) -> Array:
    """Return (A'A)⁻¹ (B, p, p) of designs (B, n, p), NaN where there is none."""
    size = np.sqrt(np.einsum("bnp,bnp->bp", A, A))
    scaled = A / size[:, None]
    gram = scaled.transpose(0, 2, 1) @ scaled
    good = np.isfinite(gram).all(axis=(1, 2))
    good[good] = np.linalg.det(gram[good]) > _WELL_POSED**-2.0
    gram[~good] = np.eye(gram.shape[1])
    result = np.linalg.inv(gram) / (size[:, :, None] * size[:, None])
    result[~good] = np.nan
    return np.asarray(result)


def _compensated(shared: SharedExpression, theta: Array, y: Array) -> tuple[Array, Array]:
    """Return what is left after compensation (B,) [g], and sensitivities (B, M, K)."""
    model, count, n = shared.model, len(theta), len(shared.reference)
    sensed = list(model.sensed_axes)
    force, columns = shared.rows(count)
    raw = y.reshape(count * n, -1)
    own = np.repeat(theta, n, axis=0)
    found = invert(model, own, raw, columns, unseen=force, start=force)
    off = (found - force[:, sensed]).reshape(count, -1)
    means = {name: np.full(count, np.mean(each)) for name, each in shared.environment.items()}
    slopes = model.force_jacobian(theta, np.zeros((count, 3)), means)
    return np.sqrt(np.einsum("br,br->b", off, off) / n), slopes[:, :, sensed]


def _searched(model: Model, reference: Array, readings: Readings) -> tuple[Problem, Optimum]:
    """Return the problem and its best optimum over the starts."""
    values, n = readings.values, len(readings)
    noise = None if readings.noise is None else readings.noise.reshape(values.shape)
    spread = np.maximum(np.ptp(values, axis=0), np.abs(values).max(axis=0) * _LEAST + _NONE)
    problem = Problem(
        model=model,
        values=values,
        environment=readings.environment,
        precision=np.tile(spread**-2.0, (n, 1)) if noise is None else 1.0 / noise,
        reference=reference,
        orientation_sd=np.zeros(n),
        group=np.full(n, -1),
        weight=np.ones(n),
    )
    guesses = first_guesses(model, values, reference, readings.environment)
    found = [maximise(problem, start_state(problem, theta)) for theta in guesses]
    best = min(found, key=lambda one: (not one.converged, one.point.objective))
    if not best.converged:
        raise ConvergenceError(
            f"no convergence after {best.iterations} iterations; the last step moved the "
            f"parameters by {best.last_step:.1e} of their size. State a start for them in "
            "[parameters] of a TOML file, check the readings for blunders (--robust huber names "
            "them), or choose a model with fewer parameters."
        )
    left = np.sqrt(np.mean(best.point.residuals**2, axis=0))
    if noise is not None or np.ptp(np.log(np.maximum(left / spread, _LEAST))) < _EQUAL:
        return problem, best
    known = np.maximum(left, np.maximum(_LEAST * spread, _NONE))
    weighed = replace(problem, precision=np.tile(known**-2.0, (n, 1)))
    return weighed, resume(weighed, best)


_NULL = 1e-3  # of the largest singular value, scaled: what moves no reading, or as good as none
_LEAST_SHARE = (
    1e-6  # share of a null direction below which it has no rotation, or no such parameter
)
_FIXING = 0.1  # share of the most that a rotation moves, from which a parameter fixes it
_ALONG = 0.99  # cosine from which a slope is along a component


def rotations_to_hold(problem: Problem, state: State, gauge: Gauge) -> Fixed:
    """Return what is to be held of the parameters, (output, name, value) each; empty if nothing.

    Raises
    ------
    UsageError
        The symmetric gauge, which is not one of single parameters.
    """
    model = problem.model
    force = problem.magnitude[:, None] * state.centre
    slopes = parameter_jacobian(model, state.theta, force, problem.environment)
    by_force = model.force_jacobian(state.theta, force, problem.environment)
    # of one axis alone, what the rotation about it hardly moves would fix it badly
    least = _LEAST_SHARE if problem.rolls is None else _FIXING
    moved = _moved_by_rotations(slopes, (by_force @ cross_matrix(force))[..., _free_axes(problem)])
    held = _held(model, _chosen(moved, _upper_first(model, slopes, force), least))
    if held and gauge != "lower":
        raise UsageError(
            "--gauge symmetric is one of polynomial models; a user-defined model is fixed by "
            "parameters that are held, --gauge lower."
        )
    return held


def hold_free_rotations(model: Model, parameters: Array) -> Model:
    """Return a model whose gauge is fixed where all orientations are unknown, before any reading.

    Parameters
    ----------
    model : Model
        Of specific force alone.
    parameters : (p,) array
        Of the sensor; which rotations are free is determined there, all over the sphere.
    """
    force = read_scheme("fibonacci-100").up
    slopes = parameter_jacobian(model, parameters, force, {})
    moved = _moved_by_rotations(
        slopes, model.force_jacobian(parameters, force, {}) @ cross_matrix(force)
    )
    held = _held(model, _chosen(moved, _upper_first(model, slopes, force), _LEAST_SHARE))
    return hold(model, held) if held else model


def _moved_by_rotations(slopes: Array, rotated: Array) -> Array:
    """Return the changes of parameters (p, r), scaled, that undo r rotations, eq. (4).

    Parameters
    ----------
    slopes : (n, M, p) array
    rotated : (n, M, t) array
        J (f × w) of each rotation w that the positions leave open.
    """
    n, m, p = slopes.shape
    design = np.concatenate([slopes, rotated], axis=2).reshape(n * m, -1)
    scale = np.linalg.norm(design, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    _, sizes, rows = np.linalg.svd(design / scale, full_matrices=True)
    sizes = np.append(sizes, np.zeros(len(rows) - len(sizes)))
    null = (rows[sizes <= _NULL * sizes[0]] / scale).T  # (p + t, d)
    if not null.size:
        return np.zeros((p, 0))
    # directions with a rotation in them: the others are parameters that nothing separates
    _, rotations, inner = np.linalg.svd(null[p:])
    free = int((rotations > _LEAST_SHARE * max(float(np.abs(null).max()), 1e-300)).sum())
    return np.asarray((null @ inner[:free].T)[:p] * scale[:p, None])


def _held(model: Model, chosen: list[int]) -> Fixed:
    """Return parameters with the values that they are held at: those stated, else 0."""
    held = []
    for i in chosen:
        output, name = model.keys[i]
        held.append((output, str(name), float(np.nan_to_num(model.starts[i]))))
    return held


def _free_axes(problem: Problem) -> list[int]:
    """Return the axes that the positions may rotate about: of rolls about one axis that axis."""
    if problem.rolls is None:
        return [0, 1, 2]
    return [i for i, axis in enumerate(COMPONENTS) if axis == problem.free_axis]


def _upper_first(model: Model, slopes: Array, force: Array) -> list[int]:
    """Return the parameters in the order in which they are held: upper triangle first."""
    order = {axis: i for i, axis in enumerate(COMPONENTS)}
    length = np.linalg.norm(force, axis=0)
    upper = []
    for output, (axis, places) in enumerate(zip(model.axes, model.places, strict=True)):
        for i in places.tolist():
            column = slopes[:, output, i]
            size = max(float(np.linalg.norm(column)), 1e-300)
            along = np.abs(column @ force) / (size * np.where(length > 0.0, length, 1.0))
            if along.max() > _ALONG and int(along.argmax()) > order[axis]:
                upper.append(i)
    rest = [i for i in range(len(model.keys)) if i not in upper]
    return [*upper, *rest]


def _chosen(moved: Array, order: list[int], share: float) -> list[int]:
    """Return as many parameters as there are directions (p, r), which fix all of them."""
    chosen: list[int] = []
    if not moved.shape[1]:
        return chosen
    for i in order:
        trial = moved[[*chosen, i]]
        least = np.linalg.svd(trial, compute_uv=False)[-1]
        if len(chosen) < moved.shape[1] and least > share * np.abs(moved).max():
            chosen.append(i)
    return chosen
