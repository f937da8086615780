"""Known orientations: linear least squares of every output, of one unit or of many.

`solve_known` fits one unit and `estimate_known` many, of which `share_design` is what they share,
`solve_units` the fits and `fit_output` those of one output; `cofactors` are the covariances of
weighted ones. `overstated` is the warning where residuals are far below the stated noise.

With the reference known, eq. (1) of `multipos.sensor.model` is linear in the coefficients of each
output. B units that were read at the same positions share its design X = Q R (n, p); with the
readings of the output as rows, Y (B, n),

    b = Y X⁺',    r = Y − b X',    cov b = s² C,    C = R⁻¹ R⁻ᵀ,    s² = r r'/(n − p).       (1)

b is the exact answer for the numbers given but for a relative κε of the *residuals*, κ the
condition of X: with b₀ = Y X⁺' rounded to a grid of 20 bits and X = X₁ + X₂ split at 26, no sum of
products b₀ X₁' rounds, and

    r = ((Y − b₀ X₁') − b₀ X₂') − (b − b₀) X',   error below 2⁻⁷⁰ |Y|.                        (2)

Stated uncertainties u (B, n) give every unit weights of its own. About (1) the weighted solution is

    b + R⁻¹ d,    (Q'WQ) d = Q'W r,    W = diag 1/(u² + τ²),    cov = R⁻¹ (Q'WQ)⁻¹ R⁻ᵀ,      (3)

whose rounding is relative to the residuals. It is worked out with τ = 0; the excess variance τ² of
readings from position to position is integrated over by `multipos.estimation.excess_variance`, of
all units at once; and (3) again with the τ² that was found. Where χ² = r'W r at τ = 0 passes its
99.9 % point the stated uncertainty is rejected, which `multipos.diagnostics.residuals` reports with
its cause; below the 0.1 % point it is called overstated.

A condition beyond 1e6, or weights further apart than 1e6, leave too few digits to (2) and (3):
these problems are solved one by one by `multipos.numerics.least_squares`. Correlated readings are
one problem of all outputs of one unit.

References
----------
JCGM 100:2008, clauses 4.2 and 6.2. Å. Björck, *Numerical Methods for Least Squares Problems*, SIAM
1996, section 2.9 (fixed design, iterative refinement). K. Ozaki, T. Ogita, S. Oishi, S. M. Rump,
Numer. Algorithms 59, 2012 (products of split matrices without rounding).
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.errors import RankError
from multipos.estimation.batches import Estimates, join_estimates, rms_of
from multipos.estimation.identifiability import formal_only
from multipos.estimation.problem import Solution
from multipos.estimation.stated_uncertainty import StatedNoise, combined_dof, taken_by_blocks
from multipos.files.records import LARGEST
from multipos.finding import Finding, Findings
from multipos.numerics import factoring, least_squares, quantiles, separability
from multipos.numerics.arrays import COMPONENTS, Array, Mask
from multipos.numerics.terms import linear_term
from multipos.positions.readings import Readings, add_variances
from multipos.results import frozen
from multipos.sensor import fit_diagnostics, studentised
from multipos.sensor.found import RestToRest, VarianceComponents
from multipos.sensor.model import Model

if TYPE_CHECKING:
    from multipos.estimation.excess_variance import ExcessVariance


ZERO_NORM = 1e-9  # [g], absolute norm below which a column of the design is zero
REJECTED = 0.999  # χ² point beyond which the residuals reject a stated noise
ROUNDING = 1e-9  # residuals below this part of the readings are those of a search or of rounding
_COARSE = 20  # bits of the coefficients that multiply without rounding
_FINEST = -1000  # power of two of a grid
_SPLIT = 26  # bits of the design that they multiply
_WORST = 1e6  # condition, or ratio of variances, beyond which (2) and (3) lack digits
_REFINEMENTS = 2  # of eq. (3), the second for the rounding of the first
_ROWS = 10_000  # at which (2) is worked out at once
_KEPT, _MANY = 16, 1000  # factored designs, of no more positions than so many
_AT_ONCE = 8000  # readings of an output, so that the weights of eq. (3) stay in cache
_UNSUPPORTED = Finding(
    "unequal-pool",
    "warning",
    (
        "residual variances of the outputs differ (Bartlett's test at 5 %); with one pooled "
        "variance U of the noisiest is too small"
    ),
    "Fit without --pool.",
)
_NOTHING_LEFT = Finding(
    "no-dof",
    "warning",
    "as many terms as readings: there are no residuals to estimate the uncertainty from",
    "State --reading-sd, or add positions.",
)


@frozen
class Design:
    """The design X = Q R of outputs that share it.

    Attributes
    ----------
    outputs : list of m int
    design, Q : (n, p) arrays
    root, cofactor : (p, p) arrays
        R⁻¹ and C.
    inverse : (p, n) array
        X⁺.
    leverage : (n,) array
    condition : float
    """

    outputs: list[int]
    design: Array
    Q: Array
    root: Array
    cofactor: Array
    inverse: Array
    leverage: Array
    condition: float

    @property
    def products(self) -> Array:
        """Products of the columns of Q (n, p²)."""
        return np.asarray(self.Q[:, :, None] * self.Q[:, None, :]).reshape(len(self.Q), -1)

    @cached_property
    def pieces(self) -> "list[_Piece]":
        """The rows of X, split for eq. (2)."""
        return list(_pieces(self.design))


@frozen
class SharedDesign:
    """The designs of a model at positions that units share.

    Attributes
    ----------
    model : Model
    reference : (n, 3) array [g]
    environment : mapping of str to (n,) array
        Other columns of the model.
    basis : (n, T) array
        Columns of all outputs.
    groups : tuple of Design
    """

    model: Model
    reference: Array
    environment: Mapping[str, Array]
    basis: Array
    groups: tuple[Design, ...]

    @cached_property
    def by_output(self) -> list[Design]:
        """The design of every output."""
        found = {i: each for each in self.groups for i in each.outputs}
        return [found[i] for i in range(len(found))]

    @property
    def designs(self) -> list[Array]:
        """X of every output."""
        return [each.design for each in self.by_output]

    @property
    def inverses(self) -> list[Array]:
        """X⁺ of every output."""
        return [each.inverse for each in self.by_output]

    @cached_property
    def dof(self) -> Array:
        """Degrees of freedom n − p of every output (M,)."""
        shapes = [each.design.shape for each in self.by_output]
        return np.array([n - p for n, p in shapes], dtype=np.float64)

    @cached_property
    def cofactor(self) -> Array:
        """The cofactor (p, p) of all parameters, of equal weights of one."""
        whole = np.zeros((len(self.model.keys), len(self.model.keys)))
        for mine, each in zip(self.model.slices, self.by_output, strict=True):
            whole[mine, mine] = each.cofactor
        return whole

    @cached_property
    def magnitude(self) -> float:
        """Mean size of the reference [g]."""
        return float(np.linalg.norm(self.reference, axis=1).mean())

    @property
    def well_posed(self) -> bool:
        """Whether every output leaves a degree of freedom, and (2) has enough digits."""
        return bool(self.dof.min() > 0.0) and all(g.condition <= _WORST for g in self.groups)


def share_design(
    model: Model,
    reference: Array,
    environment: Mapping[str, Array],
    basis: Array | None = None,
) -> SharedDesign:
    """Return the factored designs of a model at positions.

    Parameters
    ----------
    model : Model
    reference : (n, 3) array [g]
    environment : mapping of str to (n,) array
        Other columns that the model uses.
    basis : (n, T) array, optional
        Columns of all outputs, where these are not the model's own terms.

    Raises
    ------
    RankError
        The positions cannot separate the parameters; the message names them and a way out.
    """
    if basis is not None or type(model) is not Model or len(reference) > _MANY:
        return _shared(model, reference, environment, basis)
    return _kept(_Positions(model, reference, environment))


class _Positions:
    """A model at positions, equal where it is the same one and these are equal."""

    def __init__(self, model: Model, reference: Array, environment: Mapping[str, Array]) -> None:
        self.model = model
        self.reference = reference
        self.environment = environment
        used = (environment.get(name) for name in model.fitted_columns)
        columns = (None if each is None else each.tobytes() for each in used)
        self._key = id(model), reference.tobytes(), *columns

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Positions) and self._key == other._key


@lru_cache(maxsize=_KEPT)
def _kept(at: _Positions) -> SharedDesign:
    """Return designs that are kept from one fit to the next."""
    return _shared(at.model, at.reference, at.environment, None)


def _shared(
    model: Model, reference: Array, environment: Mapping[str, Array], basis: Array | None
) -> SharedDesign:
    phi = model.basis(reference, environment) if basis is None else basis
    equal: dict[tuple[int, ...], list[int]] = {}
    for output, columns in enumerate(model.columns):
        equal.setdefault(tuple(columns.tolist()), []).append(output)
    of_size: dict[int, list[list[int]]] = {}
    for terms, outputs in equal.items():
        of_size.setdefault(len(terms), []).append(outputs)
    groups = [each for stack in of_size.values() for each in _factored(model, phi, stack)]
    used = {name: environment[name] for name in model.environment if name in environment}
    return SharedDesign(model, reference, used, phi, tuple(groups))


def _factored(model: Model, phi: Array, stack: Sequence[list[int]]) -> list[Design]:
    """Return the designs of groups of outputs, of as many terms each."""
    firsts = [outputs[0] for outputs in stack]
    designs = phi.T[np.array([model.columns[output] for output in firsts])].transpose(0, 2, 1)
    names = [model.names[model.slices[output]] for output in firsts]
    try:
        found = least_squares.factor_alike(designs, least_norm=ZERO_NORM, names=names)
    except least_squares.DependentColumnsError as error:
        raise _not_separable(error, model, phi, firsts[error.problem]) from None
    inverses = found.inverse @ found.Q.transpose(0, 2, 1)
    leverage = found.leverage
    return [
        Design(
            outputs=outputs,
            design=designs[i],
            Q=found.Q[i],
            root=found.inverse[i],
            cofactor=found.cofactors[i],
            inverse=inverses[i],
            leverage=leverage[i],
            condition=found.conditions[i],
        )
        for i, outputs in enumerate(stack)
    ]


class Fits(NamedTuple):
    """Least squares of every output of B units.

    Attributes
    ----------
    parameters, u : (B, p) arrays
    dof : (B, M) array
        Of the variance of a reading.
    residuals, plain : (M, B, n) arrays
        As fitted, and of the fit without weights.
    variances : (M, B, n) array or None
        Stated variances with the excess variance, where there are any.
    excess : ExcessVariance or None
        The excess variance, where readings state a noise and leave degrees of freedom.
    chi2 : (B,) array or None
        Of the residuals under the stated noise alone, where there is one.
    """

    parameters: Array
    u: Array
    dof: Array
    residuals: Array
    plain: Array
    variances: Array | None = None
    excess: "ExcessVariance | None" = None
    chi2: Array | None = None


def solve_units(
    shared: SharedDesign, values: Array, stated: Array | None = None, *, pool: bool = False
) -> Fits:
    """Fit B units, eqs. (1)–(3).

    Parameters
    ----------
    shared : SharedDesign
    values : (M, B, n) array
        Readings.
    stated : (M, B, n) array, optional
        Stated variances.
    pool : bool
        One variance, or excess variance, of all outputs of a unit.
    """
    plain = _fit_plain(shared, values)
    if stated is None:
        return _from_residuals(shared, *plain, pool)
    stated_variance = np.moveaxis(stated, 0, 2)
    start, residuals = _weigh(shared, values, *plain, stated)
    chi2 = np.sum(residuals**2 / stated, axis=(0, 2))
    if shared.dof.sum() == 0.0:
        u = np.sqrt(np.einsum("bpp->bp", cofactors(shared, stated)[0]))
        dof = np.full(stated_variance.shape[::2], np.inf)
        return Fits(start, u, dof, residuals, plain[1], stated, None, chi2)
    from multipos.estimation.excess_variance import estimate_excess

    excess = estimate_excess(
        shared.designs, np.moveaxis(residuals, 0, 2), stated_variance, pool=pool
    )
    variances = stated + excess.variance.T[:, :, None]
    parameters, residuals = _weigh(shared, values, *plain, variances)
    u = excess.standard_uncertainty(parameters - start, shared.model.per_parameter(excess.dof))
    return Fits(parameters, u, excess.dof, residuals, plain[1], variances, excess, chi2)


def _from_residuals(shared: SharedDesign, parameters: Array, residuals: Array, pool: bool) -> Fits:
    """Take the noise of every output from its residuals, eq. (1)."""
    squares = np.einsum("mbn,mbn->bm", residuals, residuals)
    dof = np.broadcast_to(shared.dof, squares.shape)
    if pool and shared.dof.min() > 0.0:
        squares = np.broadcast_to(squares.sum(axis=1, keepdims=True), squares.shape)
        dof = np.full(squares.shape, shared.dof.sum())
    variance = np.where(dof > 0.0, squares / np.maximum(dof, 1.0), np.nan)
    u = np.sqrt(shared.model.per_parameter(variance) * np.diag(shared.cofactor))
    return Fits(parameters, u, dof, residuals, residuals)


def _fit_plain(shared: SharedDesign, values: Array) -> tuple[Array, Array]:
    """Return parameters (B, p) and residuals (M, B, n) without weights, eqs. (1) and (2)."""
    m, count, n = values.shape
    parameters, residuals = np.empty((count, len(shared.model.keys))), np.empty((m, count, n))
    for each in shared.groups:
        y = values[each.outputs].reshape(-1, n)
        if each.condition <= _WORST:
            few = n <= _MANY
            b, r = fit_output(each.design, each.inverse, y, each.pieces if few else None)
        else:
            found = least_squares.solve(each.design, y.T, least_norm=ZERO_NORM)
            b, r = found.coefficients.T, found.residuals.T
        _put(shared, each, b, r, parameters, residuals)
    return parameters, residuals


def _put(
    shared: SharedDesign, group: Design, b: Array, r: Array, parameters: Array, residuals: Array
) -> None:
    """Put the coefficients and residuals of the outputs of a group in their places."""
    count = len(parameters)
    for row, output in enumerate(group.outputs):
        parameters[:, shared.model.slices[output]] = b[row * count : (row + 1) * count]
    residuals[group.outputs] = r.reshape(len(group.outputs), count, -1)


class _Piece(NamedTuple):
    """Rows of X', columns below 1 by powers of two: X₁', then X₂' and both."""

    rows: slice
    high: Array
    beside: Array


def _pieces(design: Array) -> Iterator[_Piece]:
    power = np.ldexp(1.0, -_shift(design))[:, None]
    for first in range(0, len(design), _ROWS):
        rows = slice(first, first + _ROWS)
        scaled = design[rows].T * power
        high = np.rint(scaled * 2.0**_SPLIT) * 2.0**-_SPLIT
        yield _Piece(rows, high, np.concatenate((scaled - high, scaled)))


def _shift(design: Array) -> NDArray[np.integer[Any]]:
    """Return powers of two (p,) beyond the columns."""
    return np.asarray(np.frexp(np.abs(design).max(axis=0))[1])


def fit_output(
    design: Array, inverse: Array, y: Array, pieces: Iterable[_Piece] | None = None
) -> tuple[Array, Array]:
    """Return coefficients (B, p) and exact residuals (B, n) of one output, eq. (2).

    Parameters
    ----------
    design, inverse : (n, p), (p, n) arrays
    y : (B, n) array
    pieces : as of `Design`, where they are kept
    """
    shift = _shift(design)
    b = y @ np.ldexp(inverse, shift[:, None]).T
    grid = np.frexp(np.abs(b).max(axis=1, keepdims=True))[1] - _COARSE
    unit = np.ldexp(1.0, np.maximum(grid, _FINEST))
    coarse = np.rint(b / unit) * unit
    both = np.hstack((coarse, b - coarse))
    r, step = np.empty(y.shape), np.zeros(b.shape)
    for rows, high, beside in _pieces(design) if pieces is None else pieces:
        left = y[:, rows] - coarse @ high
        left -= both @ beside
        step += left @ inverse[:, rows].T
        r[:, rows] = left
    for first in range(0, len(design), _ROWS):
        rows = slice(first, first + _ROWS)
        r[:, rows] -= step @ design[rows].T
    b *= np.ldexp(1.0, -shift)
    b += step
    return b, r


def _weigh(
    shared: SharedDesign, values: Array, plain: Array, first: Array, variances: Array
) -> tuple[Array, Array]:
    """Return parameters (B, p) and residuals (M, B, n) under variances (M, B, n), eq. (3)."""
    parameters, residuals = plain.copy(), first.copy()
    for each in shared.groups:
        variance = variances[each.outputs].reshape(-1, variances.shape[2])
        if not np.ptp(variance, axis=1).any():  # equal weights change nothing
            continue
        b = np.concatenate([plain[:, shared.model.slices[i]] for i in each.outputs])
        r = first[each.outputs].reshape(variance.shape)
        b, r = _weigh_group(shared, each, values[each.outputs].reshape(r.shape), b, r, variance)
        _put(shared, each, b, r, parameters, residuals)
    return parameters, residuals


def _weigh_group(
    shared: SharedDesign, group: Design, y: Array, plain: Array, first: Array, variance: Array
) -> tuple[Array, Array]:
    """Return coefficients and residuals of problems of one design, (K, p) and (K, n)."""
    regular = _are_regular(group, variance)
    weight = np.where(regular[:, None], 1.0 / variance, 1.0)
    information = _information(group, weight)
    d, r = np.zeros(plain.shape), first
    for _ in range(_REFINEMENTS):
        d += np.linalg.solve(information, ((weight * r) @ group.Q)[:, :, None])[:, :, 0]
        r = first - d @ group.Q.T
    b = plain + d @ group.root.T
    for row in np.flatnonzero(~regular).tolist():
        output = group.outputs[row * len(group.outputs) // len(y)]
        found = _solve_refined(shared, output, y[row], variance[row])
        b[row], r[row] = found.coefficients, found.residuals
    return b, r


def _are_regular(group: Design, variance: Array) -> Mask:
    """Return for which variances (K, n) eq. (3) has enough digits."""
    near = variance.max(axis=1) <= _WORST * variance.min(axis=1)
    return np.asarray(near & (group.condition <= _WORST))


def _information(group: Design, weight: Array) -> Array:
    """Return Q'WQ (K, p, p) of weights (K, n)."""
    p = group.Q.shape[1]
    if len(weight) == 1:
        return np.asarray((group.Q.T * weight) @ group.Q)[None]
    return np.asarray(weight @ group.products).reshape(-1, p, p)


def _solve_refined(
    shared: SharedDesign, output: int, y: Array, variance: Array
) -> least_squares.LinearFit:
    """Return the fit of an output of one unit, in twice the working precision."""
    model, design = shared.model, shared.by_output[output].design
    names = model.names[model.slices[output]]
    try:
        return least_squares.solve(
            design, y, covariance=variance, least_norm=ZERO_NORM, names=names
        )
    except RankError as error:
        raise _not_separable(error, model, shared.basis, output) from None


def cofactors(shared: SharedDesign, variances: Array | None) -> tuple[Array, Array]:
    """Return the cofactors (B, p, p) and leverages (M, B, n) of variances (M, B, n).

    Without variances those of equal weights of one, of one unit.
    """
    model, n = shared.model, len(shared.reference)
    if variances is None:
        return shared.cofactor[None], np.stack([each.leverage for each in shared.by_output])[
            :, None
        ]
    p, (m, count, _) = len(model.keys), variances.shape
    whole, leverage = np.zeros((count, p, p)), np.empty((m, count, n))
    for each in shared.groups:
        own, h = _cofactors_of(shared, each, variances[each.outputs].reshape(-1, n))
        leverage[each.outputs] = h.reshape(-1, count, n)
        for row, output in enumerate(each.outputs):
            mine = model.slices[output]
            whole[:, mine, mine] = own[row * count : (row + 1) * count]
    return whole, leverage


def _cofactors_of(shared: SharedDesign, group: Design, variance: Array) -> tuple[Array, Array]:
    """Return cofactors (K, p, p) and leverages (K, n) of problems of one design."""
    if not np.ptp(variance, axis=1).any():
        size = variance[:, 0, None, None]
        return size * group.cofactor, np.broadcast_to(group.leverage, variance.shape)
    regular = _are_regular(group, variance)
    weight = np.where(regular[:, None], 1.0 / variance, 1.0)
    inverse = np.linalg.inv(_information(group, weight))
    h = weight * np.einsum("np,kpq,nq->kn", group.Q, inverse, group.Q, optimize=True)
    own = group.root @ inverse @ group.root.T
    for row in np.flatnonzero(~regular).tolist():
        output = group.outputs[row * len(group.outputs) // len(variance)]
        found = _solve_refined(shared, output, np.zeros(variance.shape[1]), variance[row])
        own[row], h[row] = found.cofactor, found.leverage
    return own, h


def estimate_known(
    shared: SharedDesign,
    values: Sequence[Array],
    stated: Sequence[Array] = (),
    dof: Sequence[Array] = (),
    *,
    pool: bool = False,
) -> Estimates:
    """Fit B units, as `fit` each of them by itself.

    Parameters
    ----------
    shared : SharedDesign
    values, stated : sequences of M arrays (B, n), the second may be empty
        Readings of each output, and their standard uncertainties u.
    dof : sequence of M arrays (B, n), or of none
        Degrees of freedom of u.
    pool : bool
        As in `solve_units`.
    """
    if not stated:
        return _estimates(shared, np.stack(list(values)), None, pool)
    blocks = taken_by_blocks(values, stated, dof, _AT_ONCE)
    return join_estimates([_estimates(shared, *block, pool) for block in blocks])


def _estimates(
    shared: SharedDesign, values: Array, stated_noise: StatedNoise | None, pool: bool
) -> Estimates:
    model = shared.model
    variances = None if stated_noise is None else np.moveaxis(stated_noise.u, 2, 0) ** 2
    found = solve_units(shared, values, variances, pool=pool)
    square = np.einsum("mbn,mbn->mb", found.plain, found.plain)
    sound = (square > ROUNDING**2 * np.einsum("mbn,mbn->mb", values, values)).all(axis=0)
    dof = found.dof
    if stated_noise is not None:
        sound &= stated_noise.sound
        if stated_noise.dof is not None and found.excess is not None:
            dof = combined_dof(dof, stated_noise.u**2, stated_noise.dof, found.excess.variance)
    rms, inverted = rms_of(
        model, shared.environment, shared.reference, found.parameters, values, found.residuals
    )
    sound &= inverted.sound & (np.abs(found.parameters).max(axis=1) <= LARGEST)
    return Estimates(
        parameters=found.parameters,
        u=found.u,
        dof=model.per_parameter(dof),
        rms=rms,
        residuals=found.plain,
        sensitivity=inverted.sensitivity,
        inverse=inverted.inverse,
        sound=sound,
        chi2=found.chi2,
        variance=_level_of(found.variances),
        variances=found.variances,
        weighted=found.residuals,
    )


def _level_of(variances: Array | None) -> Array | None:
    """Return the variances (M, B, n) of outputs whose readings have one each, (B, M)."""
    if variances is None or np.ptp(variances, axis=2).any():
        return None
    return np.asarray(variances[:, :, 0].T)


def solve_known(
    model: Model,
    reference: Array,
    readings: Readings,
    *,
    pool: bool = False,
    tested: bool = True,
    tangent: tuple[Array, Array] | None = None,
) -> Solution:
    """Fit every output of one unit by linear least squares.

    The stated noise of the readings is `tested` by their residuals where a user stated it;
    `tangent` are the columns of all outputs (n, T) and what they shall give (n, M), where these
    are not the model's own terms and the readings.

    Raises
    ------
    RankError
        The positions cannot separate the parameters; the message names them and a way out.
    """
    basis, values = tangent or (None, readings.values)
    shared = share_design(model, reference, readings.environment, basis)
    noise = readings.noise
    if noise is not None and noise.ndim == 2:
        found = _solve_jointly(shared, values, readings, pool)
    else:
        found = _solve_apart(shared, values, readings, pool)
    dof = shared.dof
    covariance = found.cofactor * np.outer(found.inflation, found.inflation)
    square = np.einsum("nm,nm->m", found.residuals, found.residuals)
    chi2 = found.chi2 if tested else None
    claim = None if chi2 is None else fit_diagnostics.NoiseTest(chi2, float(dof.sum()))
    return Solution(
        model=model,
        reference=reference,
        parameters=found.parameters,
        covariance=covariance,
        parameter_dof=model.per_parameter(found.dof),
        inflation=found.inflation,
        dof=found.dof,
        residuals=found.residuals,
        residual_sd=np.where(dof > 0, np.sqrt(square / np.maximum(dof, 1.0)), np.nan),
        leverage=found.leverage,
        outliers=_outliers(shared, readings, found),
        condition=found.condition,
        findings=_of_noise(shared, found, pool) if claim is None else overstated(claim),
        unidentifiable=formal_only(
            model,
            found.parameters,
            np.sqrt(np.diag(covariance)),
            shared.magnitude,
        ),
        variance_components=_components(model, found.excess),
        claim=claim,
    )


@frozen
class _One:
    """The fit of one unit; u is `inflation` times the root of the cofactor."""

    parameters: Array  # (p,)
    cofactor: Array  # (p, p)
    inflation: Array  # (p,)
    dof: Array  # (M,)
    residuals: Array  # (n, M)
    leverage: Array  # (n, M)
    condition: float
    sd: Array | None = None  # (n, M), of the readings as weighted
    excess: "ExcessVariance | None" = None
    chi2: float | None = None  # where there is an excess variance


def _solve_apart(shared: SharedDesign, values: Array, readings: Readings, pool: bool) -> _One:
    """Fit outputs that are not correlated, as a batch of one."""
    n, m = values.shape
    stated = None if readings.noise is None else readings.noise.reshape(n, m).T[:, None]
    found = solve_units(shared, np.asarray(values).T[:, None], stated, pool=pool)
    (cofactor,), leverage = cofactors(shared, found.variances)
    return _One(
        parameters=found.parameters[0],
        cofactor=cofactor,
        inflation=found.u[0] / np.sqrt(np.diag(cofactor)),
        dof=found.dof[0],
        residuals=found.residuals[:, 0].T,
        leverage=leverage[:, 0].T,
        condition=_condition(shared, found.variances),
        sd=None if found.variances is None else np.sqrt(found.variances[:, 0].T),
        excess=found.excess,
        chi2=None if found.excess is None or found.chi2 is None else float(found.chi2[0]),
    )


def _condition(shared: SharedDesign, variances: Array | None) -> float:
    """Return the largest condition of the whitened designs with columns of unit length."""
    worst = 1.0
    for each in shared.groups:
        for i in each.outputs:
            own = each.condition
            if variances is not None and np.ptp(variances[i, 0]):
                white = each.design / np.sqrt(variances[i, 0])[:, None]
                sizes = factoring.singular_values(np.asarray(np.linalg.qr(white, mode="r")))
                own = float(sizes[0] / sizes[-1])
            worst = max(worst, own)
    return worst


def _solve_jointly(shared: SharedDesign, values: Array, readings: Readings, pool: bool) -> _One:
    """Fit outputs whose readings are correlated, as one problem."""
    model, noise, (n, m) = shared.model, readings.noise, values.shape
    assert noise is not None
    design = least_squares.block_design(shared.designs).reshape(n * m, -1)
    first = least_squares.solve(design, values.ravel(), covariance=noise, names=model.names)
    chi2, excess, found = None, None, first
    inflation, dof = np.ones(len(model.keys)), np.full(m, np.inf)
    total = noise
    if shared.dof.sum() > 0.0:
        from multipos.estimation.excess_variance import estimate_excess

        excess = estimate_excess(shared.designs, first.residuals.reshape(1, n, m), noise, pool=pool)
        total = add_variances(noise, np.tile(excess.variance[0], n))
        found = least_squares.solve(design, values.ravel(), covariance=total, names=model.names)
        moves, (dof,) = (found.coefficients - first.coefficients)[None], excess.dof
        u = excess.standard_uncertainty(moves, model.per_parameter(excess.dof))[0]
        inflation = u / np.sqrt(np.diag(found.cofactor))
        chi2 = float(first.residuals @ np.linalg.solve(noise, first.residuals))
    return _One(
        parameters=found.coefficients,
        cofactor=found.cofactor,
        inflation=inflation,
        dof=dof,
        residuals=found.residuals.reshape(n, m),
        leverage=found.leverage.reshape(n, m),
        condition=found.condition,
        sd=np.sqrt(np.diag(total)).reshape(n, m),
        excess=excess,
        chi2=chi2,
    )


def _of_noise(shared: SharedDesign, found: _One, pool: bool) -> Findings:
    """Return the findings about a noise that the residuals alone give."""
    if found.sd is not None:
        return ()
    dof = shared.dof
    if dof.min() == 0:
        return (_NOTHING_LEFT,)
    squares = np.einsum("nm,nm->m", found.residuals, found.residuals)
    unequal = (
        pool and len(dof) > 1 and fit_diagnostics.bartlett(squares, dof) < fit_diagnostics.UNEQUAL
    )
    return (_UNSUPPORTED,) if unequal else ()


def _components(model: Model, excess: "ExcessVariance | None") -> VarianceComponents | None:
    """Return the excess standard deviation of every output."""
    if excess is None:
        return None
    columns = (each[0].tolist() for each in (np.sqrt(excess.variance), excess.u, excess.dof))
    parts = [RestToRest(*each) for each in zip(*columns, strict=True)]
    return VarianceComponents(rest_to_rest=dict(zip(model.outputs, parts, strict=True)))


def _outliers(shared: SharedDesign, readings: Readings, found: _One) -> tuple[str, ...]:
    """Return which readings are beyond chance, by the variances that weighted them."""
    noise, model = readings.noise, shared.model
    if noise is None or noise.ndim == 1:

        def per_g() -> Array | None:
            """Return the responses to one g, None where one is none, or of a magnetometer."""
            means = {name: float(np.mean(readings.environment[name])) for name in model.environment}
            slopes = model.linear_part(found.parameters, means)[:, 1:]
            size = np.linalg.norm(slopes, axis=1)
            in_force = model.field.unit == "g" and np.isfinite(size).all() and (size > 0.0).all()
            return size if in_force else None

        return studentised.find_outliers(
            found.residuals,
            found.leverage,
            shared.dof.tolist(),
            model.outputs,
            readings.positions,
            found.sd,
            design=shared.basis,
            columns=model.columns,
            per_g=per_g,
        )
    assert found.sd is not None  # of the stated noise and the excess variance
    more = found.sd.ravel() ** 2 - np.diag(noise)
    design = least_squares.block_design(shared.designs)
    return studentised.find_correlated_outliers(
        design.reshape(noise.shape[0], -1),
        found.residuals,
        add_variances(noise, np.maximum(more, 0.0)),
        model.outputs,
        readings.labels,
    )


def overstated(claim: fit_diagnostics.NoiseTest) -> Findings:
    """Return a warning where the residuals of all outputs are far below the stated noise."""
    if claim.chi2 >= quantiles.chi2_quantile(1.0 - REJECTED, claim.dof):
        return ()
    seen = f"(chi-square {claim.chi2:.4g} on {claim.dof:g} dof)"
    text = f"residuals are smaller than the stated noise implies {seen}; U is probably too large"
    return (Finding("overstated-noise", "warning", text, "State a smaller --reading-sd."),)


def _not_separable(error: RankError, model: Model, phi: Array, output: int) -> RankError:
    """Return the error with the model named and a way out: the terms that can be separated."""
    name = model.outputs[output]
    terms = model.terms[output]
    if not model.has_terms:
        said = separability.join_combinations(error.combinations)
        said = said or f"{len(phi)} readings for {len(terms)} parameters"
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
        if separability.separability(design[:, trial], least_norm=ZERO_NORM).rank == len(trial):
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
        f"{separability.join_combinations(error.combinations)}; {way_out}.",
        rank=error.rank,
        parameters=error.parameters,
        combinations=error.combinations,
    )


def _missing_positions(model: Model, phi: Array) -> str:
    """Return what to add: for positions that never excite one input, a roll about another axis."""
    components = [linear_term(axis) for axis in model.inputs]
    seen = [model.basis_terms.index(term) for term in components if term in model.basis_terms]
    silent = [column for column in seen if np.abs(phi[:, column]).max() <= ZERO_NORM]
    if len(silent) == 1 and len(seen) > 1:
        return "a roll about another axis, as all positions lie in one plane"
    return "positions that differ more"
