"""Uncertain orientations, off by a few degrees at most: B units on positions that they share.

`share_orientations` is what units share, and `estimate_uncertain` fits them: from the listed
directions by the search of `multipos.estimation.descent`, all of them in step, and their variance
components are integrated over (`multipos.estimation.variances`). A unit is left to the fit of one
where a search has not ended, where the positions separate parameters badly or noise leaves scale
factors open, where a position sticks out, and where readings are too noisy.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from multipos.estimation.batches import Estimates, compensated, join_estimates
from multipos.estimation.descent import WIDE, maximise
from multipos.estimation.known import ROUNDING, share_design
from multipos.estimation.likelihood import evaluate
from multipos.estimation.problem import RELATIVE_NOISE
from multipos.estimation.stated_uncertainty import StatedNoise, combined_jointly, taken_by_blocks
from multipos.estimation.units import Units, by_unit, pose_units, solution_of, state_of
from multipos.estimation.variances import SEPARATING, StatedComponents, estimate
from multipos.files.records import LARGEST
from multipos.numerics.arrays import COMPONENTS, Array, Mask
from multipos.numerics.quantiles import coverage_factors
from multipos.numerics.rotations import directions
from multipos.results import frozen
from multipos.sensor.model import Model
from multipos.sensor.studentised import find_outlying_positions, square_beyond, studentised_squares

_STICKS_OUT = 5e-4  # probability that chance makes the largest residual of an output as large
_FREE = 3.0  # degrees of freedom without which none sticks out


_AT_ONCE = 3000  # readings of an output, so that what they need stays small
_WORST = 1e-8  # eigenvalue of the scaled information below which a fit is doubted for it
_NOISY = 0.01  # of a scale factor: noise or U from which on a unit is fitted singly


@frozen
class SharedOrientations:
    """What units at uncertain orientations share.

    Attributes
    ----------
    model : Model
    reference : (n, 3) array [g]
        As listed.
    orientation_sd : (n,) array [rad]
    environment : mapping of str to (n,) array
        Other columns of the model.
    estimated : bool
        The size of the orientation sds is to be estimated.
    inverses : tuple of M (p_i, n) arrays
        Of the designs at the listed positions.
    leverage : (M, n) array
        There.
    """

    model: Model
    reference: Array
    orientation_sd: Array
    environment: Mapping[str, Array]
    estimated: bool
    inverses: tuple[Array, ...]
    leverage: Array

    @property
    def dof(self) -> float:
        """Degrees of freedom that the parameters leave."""
        return float(len(COMPONENTS) * len(self.reference) - len(self.model.keys))

    def given(self, *, stated: bool) -> StatedComponents:
        """Return what is stated of the noise."""
        few = len(self.reference) < SEPARATING
        return StatedComponents(stated, "free" if self.estimated else "centre", few)


def share_orientations(
    model: Model,
    reference: Array,
    orientation_sd: Array,
    environment: Mapping[str, Array],
    *,
    estimated: bool,
) -> SharedOrientations | None:
    """Return what units share, or None where a batch does not do what the fit of one does.

    Parameters
    ----------
    model : Model
    reference : (n, 3) array [g]
        As listed.
    orientation_sd : (n,) array [rad]
    environment : mapping of str to (n,) array
        Other columns that the model uses.
    estimated : bool
        The size of the orientation sds is to be estimated.

    Raises
    ------
    RankError
        The positions cannot separate the parameters.
    """
    triad = sorted(model.axes) == list(COMPONENTS) and model.inputs == COMPONENTS
    uncertain = (orientation_sd <= WIDE).all() and orientation_sd.any()
    if not (triad and uncertain and model.has_all_linear):
        return None
    design = share_design(model, reference, environment)
    spare = len(COMPONENTS) * len(reference) - len(model.keys)
    if not design.well_posed or spare < 1 or len(reference) < SEPARATING:
        return None
    inverses = tuple(design.inverses)
    leverage = np.array(
        [np.einsum("np,pn->n", *each) for each in zip(design.designs, inverses, strict=True)]
    )
    return SharedOrientations(
        model, reference, orientation_sd, design.environment, estimated, inverses, leverage
    )


def estimate_uncertain(
    shared: SharedOrientations,
    values: Sequence[Array],
    stated: Sequence[Array],
    stated_dof: Sequence[Array],
) -> Estimates:
    """Fit B units at uncertain orientations.

    Parameters
    ----------
    shared : SharedOrientations
    values : sequence of 3 arrays (B, n)
        Readings of each output.
    stated : sequence of 3 arrays (B, n), or of none
        Their standard uncertainties.
    stated_dof : sequence of 3 arrays (B, n), or of none
        Degrees of freedom of those.
    """
    parts = []
    for y, noise in taken_by_blocks(values, stated, stated_dof, _AT_ONCE):
        with np.errstate(all="ignore"):  # a unit may run away, and is then left out
            part, scatter = _estimate(shared, y, noise)
            u = part.u / coverage_factors(0.95, part.dof)
            if noise is not None:
                part = part._replace(dof=combined_jointly(part.dof, noise, scatter))
        parts.append(part._replace(u=u))
    return join_estimates(parts)


def _estimate(
    shared: SharedOrientations, values: Array, noise: StatedNoise | None
) -> tuple[Estimates, Array]:
    """Return estimates, whose u are yet U at 95 %, and the noise beside what is stated (B, M)."""
    model = shared.model
    _, count, n = values.shape
    valid = (np.ptp(values, axis=2) > 0.0).all(axis=0)
    if noise is not None:
        valid &= noise.sound
    variance = _any_noise(values) if noise is None else np.moveaxis(noise.u**2, 2, 0).copy()
    where = shared.reference, shared.orientation_sd, shared.environment
    problem = pose_units(model, *where, values, variance)
    theta = np.concatenate(
        [y @ inverse.T for y, inverse in zip(values, shared.inverses, strict=True)], axis=1
    )
    start = state_of(problem, theta, directions(problem.reference))
    listed = by_unit(evaluate(problem, start).residuals, count)
    valid &= ~_stick_out(shared, listed)
    least = ROUNDING**2 * np.einsum("mbn,mbn->b", values, values)
    valid &= np.einsum("mbn,mbn->b", listed, listed) > least
    optimum = maximise(problem, start)
    valid &= optimum.converged
    units, chi2 = Units(problem, problem, optimum, stated=noise is not None), None
    try:
        found = estimate(units, valid, shared.given(stated=noise is not None))
        valid, U, dof, excess = found.valid, found.U, found.dof, found.noise
        if noise is not None:  # of what the stated noise alone leaves
            alone, _ = units.searched(np.zeros_like(excess), found.factor)
            chi2 = np.asarray(alone.optimum.point.objective)
    except np.linalg.LinAlgError:  # some unit is as good as singular
        valid = np.zeros_like(valid)
        U, dof = np.full((2, *theta.shape), np.nan)
        excess = np.full((count, len(values)), np.nan)
    theta, point = units.optimum.state.theta, units.optimum.point
    residuals, force = by_unit(point.residuals, count), by_unit(point.force, count)
    there, coefficients = force.transpose(1, 2, 0), model.coefficients(theta)
    left = compensated(model, shared.environment, there, coefficients, values, residuals)
    rms = np.sqrt(np.einsum("bnk,bnk->b", left.force, left.force) / n)
    valid &= left.inverted.sound & (np.abs(theta).max(axis=1) <= LARGEST)
    valid &= np.einsum("mbn,mbn->b", residuals, residuals) > least
    some, solution = np.flatnonzero(valid), solution_of(units.problem, units.optimum)
    if len(some):
        valid[some] = _are_clear(shared, units.of(some), U[some], solution.information[some])
    of_units = Estimates(theta, U, dof, rms, residuals, *left.inverted[:2], valid, chi2)
    return of_units._replace(solutions=(solution,)), excess


def _stick_out(shared: SharedOrientations, residuals: Array) -> Mask:
    """Return of which units (B,) a reading sticks out from those at the positions as listed.

    Where positions are better than was stated they would take up what it is off.
    """
    sd, h = shared.orientation_sd, shared.leverage
    dof = np.rint(h.shape[1] - h.sum(axis=1))[:, None]
    if np.ptp(sd) > 0.0 or dof.min() < _FREE:
        return np.zeros(residuals.shape[1], dtype=np.bool_)
    most = [[square_beyond(_STICKS_OUT / h.size, nu)] for nu in dof[:, 0].tolist()]
    largest = studentised_squares(residuals, h[:, None], dof[:, None]).max(axis=2)
    return np.asarray((largest > most).any(axis=0))


def _any_noise(values: Array) -> Array:
    """Return variances (3, B, n) of any size, as the search takes them where none are stated."""
    spread = values - values.mean(axis=2, keepdims=True)
    size = np.sqrt(np.mean(spread**2, axis=(0, 2)))
    return np.broadcast_to((RELATIVE_NOISE * size[:, None]) ** 2, values.shape).copy()


def _are_clear(shared: SharedOrientations, units: Units, U: Array, information: Array) -> Mask:
    """Return of which units residuals, U (B, p) and S (B, p, p) raise no doubt."""
    state, count = units.optimum.state, len(U)
    variance = by_unit(1.0 / units.problem.precision, count)
    scale = np.sqrt(np.einsum("bpp->bp", information))
    sizes = np.linalg.eigvalsh(information / (scale[:, :, None] * scale[:, None, :]))
    clear = sizes[:, 0] > _WORST * sizes[:, -1]
    own = list(shared.model.own_scales)
    length = np.abs(state.theta[:, own])
    clear &= (U[:, own] < _NOISY * length).all(axis=1)
    sd = np.sqrt(variance.mean(axis=2))
    clear &= (sd < _NOISY * length.min(axis=1)).all(axis=0)
    q = units.optimum.point.q.reshape(count, -1)
    n = q.shape[1]
    labels, degrees = [""] * n, np.full(n, float(len(COMPONENTS)))
    for unit in np.flatnonzero(q.max(axis=1) > 4.0 * degrees[0]).tolist():
        clear[unit] &= not find_outlying_positions(q[unit], degrees, shared.dof, labels)
    return np.asarray(clear)
