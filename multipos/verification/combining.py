"""One calibration from several sessions: pooled parameters, and U for a session yet to come.

Sessions differ by more than the noise of each: the sensor is switched on and mounted anew, the
table is levelled. Parameter j of session r is p_rj = p_j + b_rj + e_rj with e of the variance c_rj
that the session states of itself, and b of the variance κ c_j, c_j the mean of c_rj, one κ for the
biases, one for the scale factors and so on. With w = 1/(κ c_j + c_rj) and p̄ the mean weighted by w,

    ln L(κ) = −½ Σ_j [Σ_r ln (κ c_j + c_rj) + ln Σ_r w_rj + Σ_r w_rj (p_rj − p̄_j)²],           (1)

to the power of 3 over the number of j where these are more: what a mounting turns moves cross terms
in pairs. ln (1 + κ) is flat, but that κ = 0 has a weight of its own, that of a stated noise
(`multipos.estimation.posteriors`). The pooled fit takes the readings of all sessions as one set, so
with W_r = G_r X_r, the part of session r in its gain G and design X,

    p = Σ W_r p_r,   Σ W_r = 1,
    var (p_j of the next session − p_j) = κ c_j + Σ_r W_r,jj² (κ c_j + c_rj),               (2)

and U is half the interval that holds 95 % of the mixture of Student's t over κ. So sessions that
agree as well as each states pay 1.8 (four and more, three parameters of a kind) to 2.2 times (two)
the U of their mean: no rule that covers 93 % at any κ has a mean U below 2.05, 1.64 and 1.65 times
(two, four, eight sessions: a linear program over all of them). Where they differ by far more, κ
follows from their differences alone. Values
are correlated as by the mean covariance of sessions and S = Σ (p_r − p̄)(p_r − p̄)'/(R − 1).

Of a stated noise c_rj has no more excess than the χ²/ν of all sessions leaves: what few residuals
of one leave open would be taken from b.

Where readings are correlated, or only some sessions state their uncertainty, all are fitted again
with equal weights, and c_rj is that of these fits.

What all sessions share (gravity, the level of the table) does not show in how they differ and is
added as in any fit. How the zero repeats, `[stability]` in a budget, does, and is not added again.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.estimation.correlated_rows import half_of_mixture
from multipos.estimation.gains import estimator_gain, gravity_effect
from multipos.finding import Finding, Findings, in_order
from multipos.fitting.fit_readings import calibrate_at
from multipos.fitting.options import Options
from multipos.numerics.arrays import SMALLEST, Array
from multipos.numerics.quantiles import coverage_factors
from multipos.positions.orientations import place
from multipos.positions.readings import Readings, diagonal
from multipos.sensor.calibration import Calibration
from multipos.sensor.fit_diagnostics import Diagnostics
from multipos.sensor.found import Estimator, RestToRest, Sessions
from multipos.sensor.gravity import add_gravity, signed_size
from multipos.sensor.inverse import parameter_jacobian
from multipos.uncertainty.propagation import state_budget

_COVERAGE = 0.95  # at which U is found
# Weight that sessions agree, at three degrees of freedom, and the power of ν by which it falls: the
# largest at which U covers the next session in 93 %, however much sessions differ.
_AGREE, _FALL = 1.8, 0.7
_PRIOR = 8.0  # degrees of freedom
_KNOWN = 1000.0  # degrees of freedom beyond which a noise is known
_APART = 3  # parameters of a kind that sessions move apart
_NODES = 61  # of ln (1 + κ), and one more
_WIDE, _LEAST = 100.0, 5.0  # beyond the largest difference, in variance and in its logarithm
_IN_S = "stability"  # the table of a budget that sessions show by themselves
_PLAIN = Finding(
    "unequal-sessions",
    "note",
    "sessions state no uncertainty of their readings, or correlated ones: each was fitted again "
    "with equal weights, and U follows from their differences",
)


def combine_sessions(found: Sequence[Calibration], files: Sequence[str]) -> Calibration:
    """Return one calibration of the readings of R sessions, with U by eq. (2).

    Parameters
    ----------
    found : sequence of R Calibration
        Of one unit, model, convention and gravity.
    files : sequence of R str
        What they are called in messages.

    Raises
    ------
    MultiposError
        The sessions are not alike, are robust fits, or some have the same readings.
    """
    _require_alike(found, files)
    first = found[0]
    alike = _state_alike([c.readings for c in found])
    readings = _joined([c.readings if alike else _plain(c.readings) for c in found])
    level = first.orientations.level_sd_deg if first.orientations else None
    options = Options(
        convention=first.convention,
        gauge="symmetric" if first.model.gauge == "symmetric" else "lower",
        confidence=first.confidence,
        unknown_orientation=first.estimator is Estimator.UNKNOWN,
        level_sd=level or 0.0,
    )

    exact = replace(first.model, field=replace(first.field, u=0.0))

    def solved(readings: Readings) -> Calibration:
        size = signed_size(first.gravity, first.convention)
        stated_up = place(readings, size, **options.spread)
        # rows of one session are alike by what S holds
        return calibrate_at(exact, readings, stated_up, options, ordered=False)

    pooled = solved(readings)
    each = found if alike else [solved(_plain(c.readings)) for c in found]
    pooled = replace(
        pooled,
        model=replace(pooled.model, field=first.field),
        selection=first.selection,
        nominal=first.nominal,
        facing=first.facing,
        diagnostics=_diagnosed(found, pooled.diagnostics, () if alike else (_PLAIN,)),
        residual_sd=_within(each, lambda c: c.residual_sd),
    )
    return _with_budget(_with_spread(_with_scatter(pooled, each), each, files), first)


def _require_alike(found: Sequence[Calibration], files: Sequence[str]) -> None:
    first = found[0]
    for i, (c, file) in enumerate(zip(found, files, strict=True)):
        if c.robust_weight is not None:
            raise MultiposError(
                f"{file}: a robust fit has weights of its own; leave out the positions that it set "
                "aside, fit without --robust, and combine those."
            )
        if c.readings.rolled.any():
            raise MultiposError(
                f"{file}: has rolls whose angle nobody read, which is estimated in each session; "
                "combine sessions at positions that are known."
            )
        for other, name in zip(found[:i], files, strict=False):
            if np.array_equal(c.readings.values, other.readings.values):
                raise MultiposError(
                    f"{file}: has the readings of {name}, which is no further session; leave one "
                    "out."
                )
        if c.estimator.exact != first.estimator.exact or c.field != first.field:
            what = "gravity" if c.field != first.field else "estimator"
            raise MultiposError(
                f"{file}: its {what} is not that of {files[0]}; fit all sessions equally to "
                "combine them."
            )


def _joined(sessions: Sequence[Readings]) -> Readings:
    """Return the readings of all sessions as one set; a group is one of its session."""
    first = sessions[0]
    shared = [n for n in first.environment if all(n in r.environment for r in sessions)]
    sources = dict.fromkeys(r.source for r in sessions if r.source is not None)
    names = ("up", "rotation", "u", "dof", "samples", "sd", "orientation_sd", "force")
    arrays: dict[str, Any] = {name: _stacked(sessions, name) for name in (*names, "reference_u")}
    return Readings(
        values=np.concatenate([r.values for r in sessions]),
        outputs=first.outputs,
        positions=tuple(label for r in sessions for label in r.labels),
        group=_groups(sessions),
        environment={n: np.concatenate([r.environment[n] for r in sessions]) for n in shared},
        unit=first.unit,
        source=", ".join(sources) or None,
        **arrays,
    )


def _stacked(sessions: Sequence[Readings], name: str) -> Array | None:
    """Return an array of the readings, of all sessions; None where one has none."""
    parts = [getattr(r, name) for r in sessions]
    return None if any(part is None for part in parts) else np.concatenate(parts)


def _state_alike(sessions: Sequence[Readings]) -> bool:
    """Tell whether all sessions state their noise, reading by reading, or none does."""
    correlated = any(r.covariance is not None for r in sessions)
    return not correlated and len({r.u is not None for r in sessions}) == 1


def _plain(readings: Readings) -> Readings:
    """Return readings without what they state of their noise: U follows from S all the same."""
    return replace(readings, u=None, dof=None, covariance=None)


def _groups(sessions: Sequence[Readings]) -> tuple[str, ...] | None:
    """Return the group of each reading, of its session by name; None without any."""
    found = [
        f"{i}:{label}" if label else ""
        for i, r in enumerate(sessions, start=1)
        for label in r.group or ("",) * len(r)
    ]
    return tuple(found) if any(found) else None


def _diagnosed(found: Sequence[Calibration], pooled: Diagnostics, said: Findings) -> Diagnostics:
    """Return what is said of the sessions; the pooled residuals show how sessions differ."""
    each = [c.diagnostics for c in found]
    findings = {finding.code: finding for d in reversed(each) for finding in d.findings}
    return replace(
        pooled,
        lack_of_fit={},
        outliers=(),
        findings=in_order((*findings.values(), *said)),
        hidden=tuple(kind for kind in each[0].hidden if all(kind in d.hidden for d in each)),
        claim=None,
    )


def _within(found: Sequence[Calibration], sd_of: Callable[[Calibration], Array]) -> Array:
    """Return standard deviations within sessions (M,), pooled over those that tell them."""
    squares = np.array([sd_of(c) ** 2 for c in found])
    dof = np.array([np.where(np.isinf(c.dof), len(c.readings), c.dof) for c in found])
    weights = np.where(np.isfinite(squares), dof, 0.0)
    with np.errstate(invalid="ignore"):
        mean = np.sum(np.nan_to_num(squares) * weights, axis=0) / weights.sum(axis=0)
        return np.asarray(np.sqrt(mean))


def _with_scatter(pooled: Calibration, found: Sequence[Calibration]) -> Calibration:
    """Return the pooled calibration with the scatter from rest to rest within the sessions."""
    components = pooled.variance_components
    if components is None or components.rest_to_rest is None:
        return pooled
    parts = [c.variance_components.rest_to_rest for c in found if c.variance_components is not None]
    scatter = {}
    for output, own in components.rest_to_rest.items():
        sizes = [part[output].value for part in parts if part is not None]
        value = math.sqrt(sum(size**2 for size in sizes) / len(sizes)) if sizes else 0.0
        scatter[output] = RestToRest(min(value, own.value), own.u, own.dof)
    return replace(pooled, variance_components=replace(components, rest_to_rest=scatter))


def _with_spread(
    pooled: Calibration, found: Sequence[Calibration], files: Sequence[str]
) -> Calibration:
    """Return the pooled calibration with the covariance of eq. (2), and gravity beside it."""
    c, R = pooled, len(found)
    values = np.array([one.parameters for one in found])
    left = values - values.mean(axis=0)
    S = left.T @ left / (R - 1)
    n, m = c.readings.values.shape
    design = parameter_jacobian(c.model, c.parameters, c.reference, c.readings.environment)
    by_row = estimator_gain(c).reshape(-1, n, m)
    ends = np.cumsum([0, *(len(one.readings) for one in found)]).tolist()
    shares = [
        np.einsum("pnm,nmp->p", by_row[:, low:high], design[low:high])
        for low, high in pairwise(ends)
    ]
    own = np.array([_covariance_within(one) for one in found])
    variances = np.einsum("rpp->rp", own) * _shrunk(found)
    U, dof = _expand(c, values, variances, np.array(shares), found)
    u = U / coverage_factors(_COVERAGE, dof)
    whole = own.mean(axis=0) + S
    scale = u / np.sqrt(np.diag(whole))
    covariance = whole * np.outer(scale, scale)
    if c.gravity is not None and c.gravity.u > 0.0:
        covariance, dof = add_gravity(covariance, dof, c.gravity, gravity_effect(c))
    sd = dict(zip(c.names, np.sqrt(np.diag(S)).tolist(), strict=True))
    return replace(
        c,
        covariance=(covariance + covariance.T) / 2.0,
        parameter_dof=dof,
        dof=np.full(m, R - 1.0),
        sessions=Sessions(R, tuple(files), sd),
    )


def _covariance_within(one: Calibration) -> Array:
    """Return the covariance (p, p) of a session without what all sessions share."""
    if one.budget is not None and one.budget.scatter is not None:
        return one.budget.scatter
    if one.gravity is None or not one.gravity.u > 0.0:
        return one.covariance
    moved = gravity_effect(one) * one.gravity.u
    return np.asarray(one.covariance - np.outer(moved, moved))


def _shrunk(found: Sequence[Calibration]) -> Array:
    """Return what variances (R, p) of sessions are multiplied by, so that few readings agree.

    The noise of a session without a stated one is drawn to that of all, as by `_PRIOR` readings.
    """
    factors = np.ones((len(found), len(found[0].names)))
    if any(one.readings.noise is not None for one in found):
        return factors * _by_stated(found)[:, None]
    pooled = _within(found, lambda one: one.residual_sd) ** 2
    for factor, one in zip(factors, found, strict=True):
        own, nu = one.residual_sd**2, one.dof
        if np.isfinite(own).all() and (own > 0.0).all():
            drawn = (nu * own + _PRIOR * pooled) / (nu + _PRIOR) / own
            factor *= one.model.per_parameter(drawn, drawn.mean())
    return factors


def _by_stated(found: Sequence[Calibration]) -> Array:
    """Return what variances of sessions (R,) that state their noise are multiplied by.

    That of six faces has in it what so few residuals leave open of an excess: a third more in the
    mean, which how sessions differ would lack. All sessions together leave less open: by their
    χ²/ν, drawn as above, and no less than stated.
    """
    tests = [one.diagnostics.claim for one in found]
    factors = np.ones(len(found))
    said = [test for test in tests if test is not None]
    if len(said) < len(found):
        return factors
    pooled = sum(test.chi2 for test in said) / sum(test.dof for test in said)
    for i, (one, test) in enumerate(zip(found, said, strict=True)):
        if one.readings.noise is None or not math.isfinite(pooled):
            continue
        stated = estimator_gain(one) ** 2 @ diagonal(one.readings.noise)
        level = max((test.chi2 + _PRIOR * pooled) / (test.dof + _PRIOR), 1.0)
        factors[i] = level / np.mean(np.diag(_covariance_within(one)) / stated)
    return factors


def _expand(
    c: Calibration, values: Array, own: Array, shares: Array, found: Sequence[Calibration]
) -> tuple[Array, Array]:
    """Return U (p,) of the next session, of every kind of parameter, and its dof (p,).

    Parameters
    ----------
    c : Calibration
    values, own, shares : (R, p) arrays
        Parameters of the sessions, their variances, and the diagonals of W_r.
    found : sequence of R Calibration
    """
    known = np.sum([np.minimum(one.dof_of_outputs, _KNOWN) for one in found], axis=0)
    kinds = [name.partition("_")[0] for name in c.names]
    U, dof = np.empty(len(kinds)), np.empty(len(kinds))
    for kind in dict.fromkeys(kinds):
        mine = np.array([each == kind for each in kinds])
        few = float(np.min(known[mine]))
        U[mine], dof[mine] = predict_next(values[:, mine], own[:, mine], shares[:, mine], few)
    return U, dof


def predict_next(p: Array, v: Array, w: Array, known: float) -> tuple[Array, float]:
    """Return U (q,) of the next session by eqs. (1) and (2), and the degrees of freedom of κ.

    Parameters
    ----------
    p, v, w : (R, q) arrays
        Parameters of one kind of every session, their variances, and the diagonals of W_r.
    known : float
        Degrees of freedom of the variances.
    """
    v = np.maximum(v, SMALLEST**2)  # sessions without residuals have none
    mean = v.mean(axis=0)
    free = min(p.shape[1], _APART) * (len(p) - 1.0)
    spread = float(np.max((p - p.mean(axis=0)) ** 2 / mean))
    steps = np.linspace(0.0, math.log1p(_WIDE * spread) + _LEAST, _NODES)
    kappa = np.concatenate([[0.0], np.expm1(0.5 * (steps[1:] + steps[:-1]))])
    total = kappa[:, None, None] * mean + v  # (G, R, q)
    weight = 1.0 / total
    middle = np.sum(weight * p, axis=1) / weight.sum(axis=1)
    log = np.sum(np.log(total), axis=1) + np.log(weight.sum(axis=1))
    log = -0.5 * np.sum(log + np.sum(weight * (p - middle[:, None]) ** 2, axis=1), axis=1)
    log *= min(1.0, _APART / p.shape[1])
    density = np.exp(log - log.max())
    density[1:] *= steps[1]
    density[0] *= _AGREE * (_APART / free) ** _FALL
    density /= density.sum()
    variances = kappa[:, None] * mean + np.sum(w**2 * total, axis=1)
    return half_of_mixture(density[None], variances[None], known)[0], max(free, 2.0)


def _with_budget(pooled: Calibration, first: Calibration) -> Calibration:
    """Return the pooled calibration with what the sessions' budget states that all share."""
    tables = {name: table for name, table in first.budget_tables.items() if name != _IN_S}
    return state_budget(pooled, tables) if tables else pooled
