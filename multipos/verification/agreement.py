"""Does a run agree with the calibration? One test of all its errors, and what has moved.

- `judge_run` returns the `Agreement` of a run and what has moved, as findings.
- `no_agreement` is what is said of a run that nothing can be tested of.
- `stated_orientation_sd` is how well the positions of a run are known, `root_of` a square root of a
  covariance.

The run reads y at known references f; the calibration expects h(p, f). With X = dh/dp,
J = dh/df and C the covariance of the parameters, r = y − h has the covariance

    V = D + L L',    L = (X C^(1/2), unseen terms, soaks),    D = diag(s²) + J T J',         (1)

row by row in D, where s is the noise of the run's readings and T what is not known of where they
were taken: the orientation error σ² f² (I − uu') of ``orientation_sd_deg``, and ``reference_u_x`` …
squared. Where zeros differ from soak to soak (`multipos.sensor.temperature`) those of calibration
and run are columns of L. As long as as many outputs as components are sensed, r and the errors e of
`multipos.verification.checks` are one and the same to first order, e = J⁻¹ r, and so is the
statistic

    Q = r' V⁻¹ r    on N = n M degrees of freedom,                                           (2)

which is χ² where the noise is known. Errors of one run share those of the parameters: a zero that
has moved by much of its U hides in the U of every single error, and not in Q. Where an output's
noise was estimated, with ν degrees of freedom, V holds it as a factor and Q/N follows F on N and
ν, exactly where all of V does; where only shares w of V were estimated, 1/Σ w²/ν is taken. Outputs
whose noise is their own are judged each by its own F, together by Fisher's method
(`multipos.verification.consistency`, eq. (3)); where V ties them, by the fewest of their ν.

Where the calibration left the rotation of the case free, the run has one of its own: three columns
J (a × f) are taken out of r before, and N is less by three.

What has moved is asked parameter by parameter: the step δ_j that takes most of Q,

    δ_j = x_j'V⁻¹r / x_j'V⁻¹x_j,    Q − Q_j = δ_j² x_j'V⁻¹x_j,                               (3)

is named while it is beyond chance among all of them (Bonferroni), at most three. Against one such
step (3) is sharper than (2), so either is a finding, each at half a per cent: of a hundred runs
that agree, one at most is said to disagree.

References
----------
JCGM 100:2008, F.1.2.4; ISO 13528:2015, 9.7 (E_n); `docs/reference/formats`.
"""

import math
from typing import Annotated, NamedTuple

import numpy as np

from multipos.files.numbers import p_in_words, plain_number
from multipos.files.records import (
    NOT_NEGATIVE,
    P_VALUE,
    POSITIVE,
    AnyOf,
    Entries,
    Figure,
    Maybe,
)
from multipos.files.schema import As
from multipos.finding import Finding, Findings, errors_of, short_text
from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import f_tail
from multipos.numerics.rotations import rotation_matrix
from multipos.positions.readings import Readings
from multipos.results import Keyed, frozen
from multipos.sensor.calibration import Calibration
from multipos.sensor.inverse import parameter_jacobian
from multipos.sensor.temperature import has_zeros, zeros_of_soaks
from multipos.uncertainty.unseen_terms import unseen_moves
from multipos.verification.consistency import Words, is_apart, judge_together

RATE = 0.01  # of runs that agree, the share that is said to disagree: half by each test
_MOST_NAMED = 3
_ROUNDING = 1e-14  # of the variances of a row, beside which noise that is less has no digits
_IDENTIFIABLE = 1e-9  # of its own information, which a parameter keeps beside others
_TURNS, _SETTLED = 50, 1e-12  # steps of a rotation, and when it stands still [rad]


def _dof_of_file(value: float | list[float | None] | None) -> float | list[float]:
    """Return degrees of freedom; of two an unlimited one is null in the file."""
    if isinstance(value, list):
        return [math.inf if each is None else float(each) for each in value]
    return math.nan if value is None else float(value)


_DOFS = Entries((POSITIVE, Maybe(POSITIVE)))
_DOF = As(AnyOf((Maybe(NOT_NEGATIVE), _DOFS)), _dof_of_file)


@frozen
class Agreement(Keyed):
    """What is said of a run as a whole.

    Attributes
    ----------
    statistic : float
        Q of eq. (2), an F, or Fisher's sum; NaN where there is no test.
    dof : float or list of two
    p : float
        Chance of as much, or more, in a run that agrees.
    test : str
        Which test, in words.
    """

    statistic: Figure
    dof: Annotated[float | list[float], _DOF]
    p: Annotated[float, Maybe(P_VALUE.kind, math.nan)]
    test: str


class _Moved(NamedTuple):
    """A parameter, by how much it moved [unit], and that over its U."""

    name: str
    by: float
    over: float
    unit: str


class _Run(NamedTuple):
    """A run whitened by D; all (n, M, …) but `nu` (M,)."""

    r: Array
    L: Array
    X: Array
    free: Array  # the columns of a free rotation
    nu: Array  # (M,) degrees of freedom of an output's variance
    soaks: int  # columns of L, the last, that are zeros of soaks
    q: Array  # (M,) their degrees of freedom
    apart: bool


_WORDS = Words(
    "chi-square of the run against its covariance",
    "F of the run against the residual variance of the calibration",
    "F of the run against the residual variance of each output, combined by Fisher's method",
)


def no_agreement(why: str) -> Agreement:
    """Return that there is no test, and why."""
    return Agreement(np.nan, np.nan, np.nan, f"none: {why}")


def judge_run(
    calibration: Calibration, data: Readings, known: Array, noise: Array, estimated: Array
) -> tuple[Agreement, Findings]:
    """Return the test of a run, and the findings about it; those about the calibration first.

    Parameters
    ----------
    calibration : Calibration
    data : Readings
    known : (n, 3) array [g]
        The references, in the calibration's convention.
    noise : (n, M) array
        Standard uncertainty of the readings of the run.
    estimated : (n, M) array
        The part of it that was estimated with the calibration, and is not stated.
    """
    c = calibration
    carried = errors_of(c.diagnostics.findings)
    if not (np.isfinite(noise).all() and (noise > 0.0).all() and np.isfinite(c.covariance).all()):
        return no_agreement("the noise of the readings is not known"), carried
    if c.model.gauge is not None:
        known = _turned(c, data, known)
    run = _whiten(c, data, known, noise, estimated)
    if run.r.size <= run.free.shape[2] or not np.isfinite(run.r).all():
        return no_agreement("too few rows at which the model has a value"), carried
    if not (run.nu > 0.0).all():
        return no_agreement("the noise of the readings is not known"), carried
    found, moved = _judge(run), _moved(c, run)
    whole = found.p < RATE / 2.0
    if not (whole or moved):
        return found, carried
    text = _in_words(found, moved, whole=whole)
    return found, (
        *carried,
        Finding("run-disagrees", "warning", text, _WAY_OUT, outputs=c.outputs, p=found.p),
    )


def _turned(c: Calibration, data: Readings, known: Array) -> Array:
    """Return the references in the frame that the calibration fixed for itself, by least squares.

    Turned step by step, for a case may be mounted any way.
    """
    for _ in range(_TURNS):
        left = data.values - c.model.predict(c.parameters, known, data.environment)
        turns = _turns(c, data, known)
        solved = np.linalg.lstsq(turns.reshape(-1, 3), left.ravel(), rcond=None)[0]
        step = np.asarray(solved, dtype=np.float64)
        known = np.asarray(known @ rotation_matrix(step).T)
        if np.abs(step).max() < _SETTLED:
            break
    return known


def _turns(c: Calibration, data: Readings, known: Array) -> Array:
    """Return how turning the references about x, y and z moves the readings (n, M, 3)."""
    J = c.model.force_jacobian(c.parameters, known, data.environment)
    return np.asarray(np.einsum("nmi,nai->nma", J, np.cross(np.eye(3), known[:, None, :])))


def _whiten(c: Calibration, data: Readings, known: Array, noise: Array, estimated: Array) -> _Run:
    environment = data.environment
    r = data.values - c.model.predict(c.parameters, known, environment)
    X = parameter_jacobian(c.model, c.parameters, known, environment)
    J = c.model.force_jacobian(c.parameters, known, environment)
    unseen = unseen_moves(c, known, environment)
    soaks, q, _ = zeros_of_soaks(c, X, data, estimated)
    L = np.concatenate([X @ root_of(c.covariance), unseen, soaks], axis=2)
    of_orientation = _orientation_error(data, known)
    D = noise[:, :, None] ** 2 * np.eye(noise.shape[1]) + np.einsum(
        "nmi,nij,nkj->nmk", J, of_orientation, J
    )
    size = np.einsum("nmm->n", D)[:, None, None]
    W = np.linalg.inv(np.linalg.cholesky(D + _ROUNDING * size * np.eye(noise.shape[1])))
    by_parameters = np.einsum("nmp,pq,nmq->nm", X, c.covariance, X)
    whole = np.einsum("nmm->nm", D) + np.sum(L**2, axis=2)
    free = np.zeros((*r.shape, 0)) if c.model.gauge is None else _turns(c, data, known)
    of_noise = np.mean((by_parameters + estimated**2) / whole, axis=0)
    of_zeros = np.mean(by_parameters / whole, axis=0)
    of_soaks = np.mean(np.sum(soaks**2, axis=2) / whole, axis=0)
    with np.errstate(divide="ignore"):
        least = [c.parameter_dof[own].min() for own in c.model.slices] if has_zeros(c) else c.dof
        more = np.maximum(1.0 / np.asarray(least) - 1.0 / c.dof, 0.0)
        nu = 1.0 / (of_noise**2 / c.dof + of_zeros**2 * more + of_soaks**2 / q)
    tied = of_orientation.any() or unseen.size or free.size
    return _Run(
        r=(W @ r[:, :, None])[:, :, 0],
        L=W @ L,
        X=W @ X,
        free=W @ free,
        nu=nu,
        soaks=soaks.shape[2],
        q=q,
        apart=not tied and is_apart(c, c.covariance, c.model.output_of),
    )


def stated_orientation_sd(data: Readings) -> Array:
    """Return how well each position of a run is known (n,) [rad]; exact where not stated."""
    sd = np.zeros(len(data)) if data.orientation_sd is None else data.orientation_sd
    return np.where(np.isfinite(sd), sd, 0.0)


def _orientation_error(data: Readings, known: Array) -> Array:
    """Return T of eq. (1), (n, 3, 3) [g²]."""
    square = stated_orientation_sd(data) ** 2
    across = np.einsum("ni,ni->n", known, known)[:, None, None] * np.eye(3)
    of_orientation = square[:, None, None] * (across - known[:, :, None] * known[:, None, :])
    if data.reference_u is not None:
        of_orientation = of_orientation + data.reference_u[:, :, None] ** 2 * np.eye(3)
    return np.asarray(of_orientation)


def root_of(covariance: Array) -> Array:
    """Return C^(1/2) (p, p), of parameters of any units and of combinations that are exact."""
    scale = np.sqrt(np.diag(covariance))
    scale = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def _judge(run: _Run) -> Agreement:
    nu_of, parts = [float(run.nu.min())], [slice(None)]
    if run.apart and not np.isinf(run.nu).all():
        nu_of, parts = run.nu.tolist(), [slice(i, i + 1) for i in range(len(run.nu))]
    outcome = []
    for part, of_it in zip(parts, nu_of, strict=True):
        r = run.r[:, part].reshape(-1, 1)
        free, L = (a[:, part].reshape(len(r), -1) for a in (run.free, run.L))
        weighed = _Weights(L, free)
        outcome.append((float(weighed.product(r, r)[0, 0]), float(len(r) - free.shape[1]), of_it))
    return Agreement(*judge_together(outcome, _WORDS))


class _Weights:
    """a'V⁻¹b of whitened columns, less what free columns explain.

    With the singular values s and vectors U of L, (I + LL')⁻¹ = I − U diag(s²/(1 + s²)) U'.
    """

    def __init__(self, L: Array, free: Array) -> None:
        self._free = np.linalg.qr(free)[0]
        vectors, values, _ = np.linalg.svd(self._without(L), full_matrices=False)
        self._vectors = vectors * (values / np.sqrt(1.0 + values**2))

    def product(self, a: Array, b: Array) -> Array:
        """Return a'V⁻¹b of columns (N, i) and (N, j)."""
        a, b = self._without(a), self._without(b)
        return np.asarray(a.T @ b - (a.T @ self._vectors) @ (self._vectors.T @ b))

    def _without(self, columns: Array) -> Array:
        return np.asarray(columns - self._free @ (self._free.T @ columns))


def _moved(c: Calibration, run: _Run) -> list[_Moved]:
    """Return the parameters that have moved beyond chance, eq. (3), those that tell most first."""
    flat = [a.reshape(run.r.size, -1) for a in (run.L, run.free, run.X, run.r)]
    weighed = _Weights(*flat[:2])
    gram, right = weighed.product(flat[2], flat[2]), weighed.product(flat[2], flat[3])[:, 0]
    nu = _dof_of_steps(c, run, weighed, flat)
    chosen: list[int] = []
    steps: Array = np.zeros(0)
    while len(chosen) < _MOST_NAMED:
        taken = _taken(gram, right, chosen, steps)
        best = int(np.argmax(taken))
        if not f_tail(float(taken[best]), 1.0, float(nu[best])) < RATE / 2.0 / len(right):
            break
        chosen.append(best)
        steps = np.asarray(
            np.linalg.solve(gram[np.ix_(chosen, chosen)], right[chosen]), dtype=np.float64
        )
    U = np.where(c.U > 0.0, c.U, np.nan)  # of a calibration without residuals there is none
    return [
        _Moved(c.names[j], float(by), float(abs(by) / U[j]), c.model.units[j])
        for j, by in zip(chosen, steps, strict=True)
    ]


def _dof_of_steps(c: Calibration, run: _Run, weighed: _Weights, flat: list[Array]) -> Array:
    """Return the degrees of freedom (p,) of the variance of each step: by its share from soaks."""
    nu = np.full(len(c.parameters), float(np.min(c.dof)))
    if not run.soaks:
        return nu
    nu = np.minimum(nu, c.parameter_dof)
    L, free, X, _ = flat
    without = _Weights(L[:, : -run.soaks], free)
    known, whole = (np.diag(each.product(X, X)) for each in (without, weighed))
    share = 1.0 - np.divide(whole, known, out=np.ones_like(known), where=known > 0.0)
    q = run.q[np.asarray(c.model.output_of)]
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / (share**2 / q + (1.0 - share) ** 2 / nu))


def _taken(gram: Array, right: Array, chosen: list[int], steps: Array) -> Array:
    """Return how much of Q each parameter takes (p,) beside those that are chosen."""
    left, own = right.copy(), np.diag(gram).copy()
    if chosen:
        left -= gram[:, chosen] @ steps
        mine = np.linalg.solve(gram[np.ix_(chosen, chosen)], gram[chosen])
        own -= np.einsum("jp,jp->p", gram[chosen], mine)
    predicted = own > _IDENTIFIABLE * np.diag(gram)
    return np.where(predicted, left**2 / np.where(predicted, own, 1.0), 0.0)


_WAY_OUT = "Calibrate again, or find what differs: warm-up, temperature, mounting or level."


def _in_words(found: Agreement, moved: list[_Moved], *, whole: bool) -> str:
    chance = f" ({p_in_words(found.p)})" if whole else ""
    said = f"the run disagrees with the calibration beyond chance{chance}"
    if not moved:
        return said
    steps = [_step_in_words(m) for m in moved]
    cause = f"{said}; probable cause: a change of "
    return short_text(lambda count: cause + ", ".join(steps[:count]), len(steps))


def _step_in_words(moved: _Moved) -> str:
    step = f"{moved.name} by {moved.by:+.3g} {moved.unit}".removesuffix(" 1")
    return f"{step} ({plain_number(moved.over, 2)} U)" if moved.over > 0.0 else step
