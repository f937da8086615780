"""Known orientations: linear least squares of every output.

With the reference known, eq. (1) of `multipos.sensor.model` is linear in the coefficients of each
output, y = X p + e, and is solved by `multipos.numerics.least_squares`. The covariance is

    cov p = s² (X'X)⁻¹      where the residuals give the noise, s² = r'r/(n − p)           (1)
    cov p = (X'V⁻¹X)⁻¹      where the readings state it, V their covariance                (2)

A stated noise is a floor: V is it and what readings scatter from rest to rest beside it
(`multipos.estimation.excess_variance`). Where χ² = r'V⁻¹r under the stated part alone passes its
99.9 % point it is denied, which `multipos.diagnostics.residuals` says with its cause; below its 0.1
% point it is called overstated.

References
----------
JCGM 100:2008, clauses 4.2 and 6.2.
"""

from dataclasses import dataclass, replace

import numpy as np

from multipos.errors import RankError
from multipos.estimation.excess_variance import find_scatter
from multipos.estimation.identifiability import formal_only
from multipos.estimation.solution import Solution
from multipos.numerics.arrays import Array
from multipos.numerics.least_squares import (
    DependentColumnsError,
    LinearFit,
    block_design,
    solve,
    solve_alike,
)
from multipos.numerics.quantiles import chi2_quantile
from multipos.numerics.separability import separability
from multipos.numerics.terms import COMPONENTS, linear_term
from multipos.positions.readings import Readings, add_variances, diagonal, stated_sd
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.fit_diagnostics import (
    UNEQUAL,
    Claim,
    bartlett,
    find_correlated_outliers,
    find_outliers,
)
from multipos.sensor.found import RestToRest, VarianceComponents
from multipos.sensor.model import Model

FLOOR = 1e-9  # [g], absolute norm below which a column of the design is zero
_UNSUPPORTED = (
    "the outputs' residual variances differ (Bartlett's test at 5 %), so pooling them is not "
    "supported by the data"
)
_NOTHING_LEFT = (
    "as many terms as readings: nothing is left to estimate the uncertainty from; give "
    "--reading-sd or more positions"
)
DENIED = 0.999  # χ² point beyond which the residuals deny a stated noise


def solve_known(
    model: Model,
    reference: Array,
    readings: Readings,
    *,
    pool: bool = False,
    claimed: bool = True,
    tangent: tuple[Array, Array] | None = None,
) -> Solution:
    """Fit every output by linear least squares, eqs. (1) and (2).

    The noise of the readings is held to their residuals where it is `claimed` by somebody;
    `tangent` are the columns of all outputs (n, T) and what they shall give (n, M), where these
    are not the model's own terms and the readings.

    Raises
    ------
    RankError
        The positions cannot separate the parameters; the message names them and a way out.
    """
    phi, values = tangent or (model.basis(reference, readings.environment), readings.values)
    noise = readings.noise
    fits = _solve(model, phi, values, noise)
    n = len(readings)
    dof = np.array([n - len(terms) for terms in model.terms], dtype=np.float64)
    if noise is None:
        found = _from_residuals(model, fits, dof, pool)
    else:
        found = _beside_stated(model, phi, values, readings, fits, pool)
        found = found if claimed else replace(found, warnings=(), claim=None)
    fits = found.fits
    covariance = fits.cofactor * np.outer(found.inflation, found.inflation)
    square = np.einsum("nm,nm->m", fits.residuals, fits.residuals)
    return Solution(
        model=model,
        reference=reference,
        parameters=fits.parameters,
        covariance=covariance,
        parameter_dof=per_parameter(model, found.dof),
        inflation=found.inflation,
        dof=found.dof,
        residuals=fits.residuals,
        residual_sd=np.where(dof > 0, np.sqrt(square / np.maximum(dof, 1.0)), np.nan),
        leverage=fits.leverage,
        outliers=_outliers(model, phi, readings, found, dof),
        condition=fits.condition,
        warnings=found.warnings,
        unidentifiable=formal_only(
            model,
            fits.parameters,
            np.sqrt(np.diag(covariance)),
            float(np.linalg.norm(reference, axis=1).mean()),
        ),
        variance_components=found.components,
        claim=found.claim,
    )


def _outliers(
    model: Model, phi: Array, readings: Readings, found: "_Weighed", dof: Array
) -> tuple[str, ...]:
    """Return which readings are beyond chance, by what they were weighed with."""
    fits, noise = found.fits, readings.noise
    if noise is None or noise.ndim == 1:
        return find_outliers(
            fits.residuals,
            fits.leverage,
            dof.tolist(),
            model.outputs,
            readings.labels,
            found.sd,
            design=phi,
            columns=model.columns,
        )
    assert found.sd is not None  # what is stated, with the scatter beside it
    more = found.sd.ravel() ** 2 - np.diag(noise)
    design = block_design([phi[:, columns] for columns in model.columns])
    return find_correlated_outliers(
        design.reshape(noise.shape[0], -1),
        fits.residuals,
        add_variances(noise, np.maximum(more, 0.0)),
        model.outputs,
        readings.labels,
    )


@dataclass(frozen=True, eq=False)
class _Fits:
    """Least squares of all outputs together; `chi2` is of whitened residuals, per output."""

    parameters: Array
    cofactor: Array
    residuals: Array
    chi2: Array
    leverage: Array
    condition: float


@dataclass(frozen=True, eq=False)
class _Weighed:
    """Fits with the noise that was found; u is `inflation` times the cofactor's root."""

    fits: _Fits
    inflation: Array  # (p,)
    dof: Array  # (M,)
    sd: Array | None  # (n, M), that the readings were weighed by
    warnings: tuple[str, ...] = ()
    components: VarianceComponents | None = None
    claim: Claim | None = None


def _from_residuals(model: Model, fits: _Fits, dof: Array, pool: bool) -> _Weighed:
    """Take all noise from the residuals, eq. (1)."""
    variance = np.where(dof > 0, fits.chi2 / np.maximum(dof, 1.0), np.nan)
    said: tuple[str, ...] = ()
    if pool and dof.min() > 0:
        if len(dof) > 1 and bartlett(fits.chi2, dof) < UNEQUAL:
            said = (_UNSUPPORTED,)
        variance = np.full(len(dof), fits.chi2.sum() / dof.sum())
        dof = np.full(len(dof), dof.sum())
    if dof.min() == 0:
        said = (_NOTHING_LEFT,)
    return _Weighed(fits, np.sqrt(per_parameter(model, variance)), dof, None, said)


def _beside_stated(
    model: Model, phi: Array, values: Array, readings: Readings, fits: _Fits, pool: bool
) -> _Weighed:
    """Add to the stated noise what readings scatter from rest to rest (`scatter`)."""
    n, m = values.shape
    noise = readings.noise
    assert noise is not None
    left = n * m - len(model.keys)
    if left == 0:
        return _Weighed(fits, np.ones(len(model.keys)), np.full(m, np.inf), stated_sd(readings))
    designs = [phi[:, columns] for columns in model.columns]
    stated = noise if noise.ndim == 2 else noise.reshape(1, n, m)
    found = find_scatter(designs, fits.residuals[None], stated, pool=pool)  # of one unit
    (variance,), (u_tau,), (known,) = found.variance, found.u, found.dof
    weighed = _weigh_again(model, phi, values, noise, fits, variance)
    moves = weighed.parameters - fits.parameters
    (u,) = found.standard_uncertainty(moves[None], per_parameter(model, known)[None])
    components = VarianceComponents(
        rest_to_rest={
            output: RestToRest(float(np.sqrt(variance[i])), float(u_tau[i]), float(known[i]))
            for i, output in enumerate(model.outputs)
        }
    )
    sd = np.sqrt(diagonal(noise).reshape(n, m) + variance)
    claim = Claim(float(fits.chi2.sum()), float(left))
    inflation = u / np.sqrt(np.diag(weighed.cofactor))
    said = overstated(claim)
    return _Weighed(weighed, inflation, known, sd, said, components, claim)


def _weigh_again(
    model: Model, phi: Array, values: Array, noise: Array, fits: _Fits, scatter: Array
) -> _Fits:
    """Return the fits with a scatter (M,) added to the stated noise."""
    n, m = values.shape
    if noise.ndim == 1 and not np.ptp(noise.reshape(n, m), axis=0).any():
        # where readings of an output are alike, no weight changes
        ratio = per_parameter(model, (noise[:m] + scatter) / noise[:m])
        return replace(fits, cofactor=fits.cofactor * np.sqrt(np.outer(ratio, ratio)))
    return _solve(model, phi, values, add_variances(noise, np.tile(scatter, n)))


def _solve(model: Model, phi: Array, values: Array, noise: Array | None) -> _Fits:
    if noise is not None and noise.ndim == 2:
        return _solve_jointly(model, phi, values, noise)
    return _solve_each(model, phi, values, noise)


def _solve_each(model: Model, phi: Array, values: Array, variances: Array | None) -> _Fits:
    """One problem per output; outputs that share design and weights share the factorisation."""
    n, m = values.shape
    p = len(model.keys)
    parameters, cofactor = np.empty(p), np.zeros((p, p))
    residuals, leverage, chi2 = np.empty((n, m)), np.empty((n, m)), np.empty(m)
    condition = 1.0
    stated = None if variances is None else variances.reshape(n, m)
    alike: dict[tuple[tuple[int, ...], bytes], list[int]] = {}
    for output, columns in enumerate(model.columns):
        weights = b"" if stated is None else stated[:, output].tobytes()
        alike.setdefault((tuple(columns.tolist()), weights), []).append(output)
    of_size: dict[tuple[int, int], list[list[int]]] = {}
    for group in alike.values():
        of_size.setdefault((len(model.columns[group[0]]), len(group)), []).append(group)
    for groups in of_size.values():
        solved = _solve_groups(model, phi, values, stated, groups)
        for group, found in zip(groups, solved, strict=True):
            for column, output in enumerate(group):
                mine = model.slices[output]
                parameters[mine] = found.coefficients[:, column]
                cofactor[mine, mine] = found.cofactor
                residuals[:, output] = found.residuals[:, column]
                leverage[:, output] = found.leverage
                chi2[output] = np.asarray(found.rss)[column]
            condition = max(condition, found.condition)
    return _Fits(parameters, cofactor, residuals, chi2, leverage, condition)


def _solve_groups(
    model: Model,
    phi: Array,
    values: Array,
    variances: Array | None,
    groups: list[list[int]],
) -> list[LinearFit]:
    """Solve the problems of groups of outputs, of as many terms and outputs each."""
    firsts = [group[0] for group in groups]
    designs = phi.T[np.array([model.columns[output] for output in firsts])]
    try:
        return solve_alike(
            designs.transpose(0, 2, 1),
            values.T[np.array(groups)].transpose(0, 2, 1),
            variances=None if variances is None else variances.T[firsts],
            floor=FLOOR,
            names=[model.names[model.slices[output]] for output in firsts],
        )
    except DependentColumnsError as error:
        raise _not_separable(error, model, phi, firsts[error.problem]) from None


def _solve_jointly(model: Model, phi: Array, values: Array, covariance: Array) -> _Fits:
    """One problem for all outputs, whose readings are correlated."""
    n, m = values.shape
    p = len(model.keys)
    # each output's own design must be sound before they are taken together
    _solve_each(model, phi, values, None)
    design = block_design([phi[:, columns] for columns in model.columns])
    found = solve(
        design.reshape(n * m, p), values.ravel(), covariance=covariance, names=model.names
    )
    residuals = found.residuals.reshape(n, m)
    return _Fits(
        found.coefficients,
        found.cofactor,
        residuals,
        chi_squares(residuals, covariance),
        found.leverage.reshape(n, m),
        found.condition,
    )


def chi_squares(residuals: Array, noise: Array | None) -> Array:
    """Return r'V⁻¹r of each output by itself (M,), V as `Readings.noise` has it; 1 where None.

    Parameters
    ----------
    residuals : (n, M) array
    noise : (n M,) or (n M, n M) array, optional
    """
    n, m = residuals.shape
    if noise is None or noise.ndim == 1:
        variances = np.ones((n, m)) if noise is None else noise.reshape(n, m)
        return np.asarray(np.sum(residuals**2 / variances, axis=0))
    blocks = noise.reshape(n, m, n, m)
    return np.array(
        [residuals[:, i] @ np.linalg.solve(blocks[:, i, :, i], residuals[:, i]) for i in range(m)]
    )


def overstated(claim: Claim) -> tuple[str, ...]:
    """Say where the residuals of all outputs are far below the stated noise."""
    if claim.chi2 >= chi2_quantile(1.0 - DENIED, claim.dof):
        return ()
    seen = f"(chi-square {claim.chi2:.4g} on {claim.dof:g} degrees of freedom)"
    return (f"the residuals are far smaller than the stated noise {seen}: it may be overstated",)


def per_parameter(model: Model, values: Array) -> Array:
    """Return one value an output (…, M) as one a parameter (…, p)."""
    return np.asarray(values[..., model.rows[0]])


def _not_separable(error: RankError, model: Model, phi: Array, output: int) -> RankError:
    """Return the error with the model named and a way out: the terms that can be separated."""
    name = model.outputs[output]
    terms = model.terms[output]
    if isinstance(model, ExpressionModel):
        said = "; ".join(error.combinations) or f"{len(phi)} readings for {len(terms)} parameters"
        return RankError(
            f"{error.rank} of {error.parameters} parameters of {name} can be separated: {said}; "
            "add positions that differ more, or drop a parameter.",
            rank=error.rank,
            parameters=error.parameters,
            combinations=error.combinations,
        )
    design = phi[:, model.columns[output]]
    kept: list[int] = []
    for column in range(len(terms)):
        trial = [*kept, column]
        if separability(design[:, trial], floor=FLOOR).rank == len(trial):
            kept = trial
    formula = " + ".join(str(terms[column]) for column in kept)
    way_out = (
        f"x^2 + y^2 + z^2 = 1 at rest, so no static positions can; for {name} use '{formula}'"
        if model.text == "full-quadratic" and set(model.inputs) == set(COMPONENTS)
        else f"add {_missing_positions(model, phi)}, or for {name} fit '{formula}'"
    )
    if len(design) < len(terms):
        return RankError(
            f"{len(design)} readings cannot determine the {len(terms)} terms of {name}; {way_out}.",
            rank=error.rank,
            parameters=error.parameters,
        )
    return RankError(
        f"{error.rank} of {error.parameters} parameters of {name} can be separated: "
        f"{'; '.join(error.combinations)}; {way_out}.",
        rank=error.rank,
        parameters=error.parameters,
        combinations=error.combinations,
    )


def _missing_positions(model: Model, phi: Array) -> str:
    """Return what to add: for positions that never excite one input, a roll about another axis."""
    components = [linear_term(axis) for axis in model.inputs]
    seen = [model.basis_terms.index(term) for term in components if term in model.basis_terms]
    silent = [column for column in seen if np.abs(phi[:, column]).max() <= FLOOR]
    if len(silent) == 1 and len(seen) > 1:
        return "a roll about another axis, as all positions lie in one plane"
    return "positions that differ more"
