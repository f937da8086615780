"""What the order of the rows shows: drift, a slip, another unit, a filter, a table, slow noise.

Residuals e of rows in the order of time, whitened, are what a fit left of the readings. A cause
that the model does not know adds columns Z of q unknown sizes to it; with V = Z − QQ'Z what the
fit leaves of them, Δ = e'V(V'V)⁻¹V'e and ν degrees of freedom of an output,

    Λ = −Σ ν ln(1 − Δ_i/e_i'e_i)    outputs apart,    Λ = −N ln(1 − Δ/e'e)    together,      (1)

N = Σ ν, is twice the logarithm of the ratio of likelihoods. With f_k the force at row k, K the
slopes of the outputs and s_k = 1 from row j on, the columns are

    drift       t_k, outputs apart            replaced    s_k, or s_k times every term, apart
    slipped     s_k K (ω × f_k)               settling    a K (f_k−1 − f_k)
    hysteresis  ±1 by approach, apart         vibration   the rests' own variance, apart
    level       K (R_k east, R_k north)       table       two harmonics of the angle of each roll.

Each is judged alone, a search over j by the union bound: together by F of (1), apart by Fisher's
sum over F of each output, which are exact. Slow noise of correlation ρ = 1 − 5/n from row to row
is judged by its score,

    T = Σ e_i'Ω e_i / e_i'e_i,    Ω_jk = ρ^|j − k|,                                         (2)

whose law is nearly that of a Beta variable with the mean and variance of (2) between its least
and largest value.

Several causes explain the same residuals, more or less. In one likelihood, the terms that the model
lacks, orientation error and outliers among them, the best has the largest

    S = Λ − q ln N − 2 ln (number tried),                                                   (3)

and it alone is named.

Sources: J. Durbin, G. S. Watson, Biometrika 37, 1950 (2); G. Schwarz, Ann. Statist. 6, 1978 (3).
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from multipos.finding import Finding
from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import f_quantile, f_tail
from multipos.positions.harmonics import find_rolls
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.fit_diagnostics import ModelTest
from multipos.sensor.found import Estimator
from multipos.sensor.inverse import parameter_jacobian
from multipos.uncertainty.turntable import table_effects

LEVEL = 0.0025  # of every cause by itself
_LEAST = 2  # rows before and after a change
_IDENTIFIABLE = 1e-3  # of a column's square, which a fit must leave of it
_GRID = 0.05  # of directions, to which plans are kept
_KEPT = 16
_TURN = 12  # positions of a roll on a table
_UNEQUAL = 2.0  # of the rests' own sd, largest over median, from which vibration is asked
_MOST = 400  # rows, beyond which steps are tried at so many of them
_ROUNDS = 5  # of alternation of weights
_ROUNDING = 1e-12
_TIME, APPROACH, SLOW = "time", "approach", "time-correlated"
_OF_ATTITUDE = ("slipped", "level", "table")  # where a turn of the case is free, nothing

Rows = NDArray[np.intp]


@dataclass(frozen=True)
class Cause:
    """One explanation of the residuals.

    Attributes
    ----------
    code : str
        Of its finding.
    gain : float
        Λ of eq. (1).
    columns, tried : int
    p : float
        Chance of it where there is nothing, searches included.
    row : int or None
        The first row after a change.
    wholly : bool
        Whether every term changes there.
    """

    code: str
    gain: float
    columns: int
    tried: int
    p: float
    row: int | None = None
    wholly: bool = False

    @property
    def chance(self) -> str:
        """p as a text."""
        return f"{max(self.p, 1e-99):.0e}"

    def score(self, freedom: float) -> float:
        """Return S of eq. (3) with N degrees of freedom."""
        return self.gain - self.columns * math.log(freedom) - 2.0 * math.log(self.tried)


@dataclass(frozen=True, eq=False)
class _Family:
    """Columns of one cause, times a step at each of some rows where it has any.

    `base` is (n, q) where outputs are apart, else (n, M, q).
    """

    code: str
    base: Array
    steps: Rows | None = None

    @property
    def wholly(self) -> bool:
        """Whether it is every term of the outputs."""
        return self.code == "replaced" and self.base.shape[-1] > 1


@dataclass(frozen=True, eq=False)
class Plan:
    """What eq. (1) needs of the positions, kept from one fit to the next.

    Attributes
    ----------
    apart : tuple of (outputs, rows (B q, n))
        Orthonormal rows, of the outputs that share a design.
    together : (B' q', n M) array
    widths, joint_widths : (q, q')
    ranks : (B + B',) array
    limits : (B + B',) array
        Of Λ, below which nothing is said.
    places : tuple of (code, row or None, number tried, whether every term changes)
        Of each block.
    nu, freedom : float
        ν of an output, and N.
    slow : tuple of (outputs, Ω (n, n))
    slow_limit : float
        Of T, below which nothing is said.
    """

    order: Rows
    apart: tuple[tuple[Rows, Array], ...]
    together: Array
    widths: tuple[int, int]
    ranks: Array
    limits: Array
    places: tuple[tuple[str, int | None, int, bool], ...]
    nu: float
    freedom: float
    slow: tuple[tuple[Rows, Array], ...]
    slow_limit: float


def time_order(c: Calibration) -> Rows:
    """Return the rows (n,) in the order of time, by their column or as they stand."""
    time = c.readings.environment.get(_TIME)
    if time is None or not np.isfinite(time).all():
        return np.arange(len(c.readings))
    return np.argsort(time, kind="stable")


def asked(c: Calibration) -> bool:
    """Tell whether residuals can be held against their order."""
    noise = c.noise
    plain = c.robust_weight is None and not isinstance(c.model, ExpressionModel)
    known = c.estimator is Estimator.LINEAR or (
        c.estimator is Estimator.UNKNOWN and len(c.outputs) == 3
    )
    if not np.isfinite(c.residual_sd).all():
        return False
    nothing = _ROUNDING * np.abs(c.readings.values).max(axis=0)
    identifiable = bool((c.residual_sd > nothing).all())
    return plain and known and identifiable and (noise is None or noise.ndim == 1)


def search(c: Calibration) -> tuple[Cause, ...]:
    """Return the causes of time and table that chance alone passes rarely, the best of each.

    Parameters
    ----------
    c : Calibration
        With `asked(c)`.
    """
    if c.estimator is Estimator.UNKNOWN:
        plan, e = _at_unknown(c)
    else:
        plan = _plan_of(_Setting(c))
        e = c.residuals / c.sd_of_readings
    if plan is None:
        return ()
    square = np.einsum("nm,nm->m", e, e)
    if not (square > 0.0).all():
        return ()
    gains, lost, slow = _gains(plan, (e / np.sqrt(square)).T[:, None])
    found = []
    if (gains > plan.limits[:, None]).any():
        found = _best(plan, gains[:, 0], lost[:, :, 0])
    if slow[0] > plan.slow_limit:
        found.append(Cause(SLOW, slow_gain(c, plan.order), 1, 1, LEVEL))
    return tuple(found)


def plan_of(c: Calibration) -> Plan | None:
    """Return what units at the positions of one, at known orientations, share; None for none."""
    return _plan_of(_Setting(c)) if asked(c) and c.estimator is Estimator.LINEAR else None


def shown_in_units(plan: Plan, residuals: Array) -> NDArray[np.bool_]:
    """Return of which units (B,) residuals (M, B, n) show a cause, at a first sight."""
    size = np.sqrt(np.einsum("mbn,mbn->mb", residuals, residuals))
    whole = (size > 0.0).all(axis=0)
    gains, _, slow = _gains(plan, residuals / np.where(size > 0.0, size, 1.0)[:, :, None])
    return np.asarray(
        whole & ((gains > plan.limits[:, None]).any(axis=0) | (slow > plan.slow_limit))
    )


def _gains(plan: Plan, e: Array) -> tuple[Array, Array, Array]:
    """Return Λ of every block (K, B), Δ_i/e_i'e_i (K, M, B) and T (B,), of unit e_i (M, B, n)."""
    m, count, _ = e.shape
    q, joint = plan.widths
    blocks = len(plan.apart[0][1]) // q if q else 0
    explained = np.empty((len(plan.places), m, count))
    for outputs, rows in plan.apart if q else ():
        for output in outputs.tolist():
            along = (rows @ e[output].T).reshape(blocks, q, count)
            explained[:blocks, output] = np.einsum("kqb,kqb->kb", along, along)
    if joint:
        flat = e.transpose(2, 0, 1).reshape(-1, count)
        along = (plan.together @ flat).reshape(-1, joint, count)
        explained[blocks:] = np.einsum("kqb,kqb->kb", along, along)[:, None] / m
    lost = np.minimum(explained, 1.0 - 1e-15)
    slow = np.zeros(count)
    for outputs, omega in plan.slow:
        for output in outputs.tolist():
            slow += np.einsum("bn,bn->b", e[output], e[output] @ omega)
    return -plan.nu * np.log1p(-lost).sum(axis=1), lost, slow


def _best(plan: Plan, gains: Array, lost: Array) -> list[Cause]:
    """Return the most likely place of every cause that is beyond chance."""
    found: dict[str, Cause] = {}
    blocks = len(plan.apart[0][1]) // plan.widths[0] if plan.widths[0] else 0
    for place in np.flatnonzero(gains > plan.limits).tolist():
        code, row, tried, wholly = plan.places[place]
        rank = float(plan.ranks[place])
        if place < blocks:
            q, nu = rank / lost.shape[1], plan.nu
            ratios = tuple(x / q / ((1.0 - x) / (nu - q)) for x in lost[place].tolist())
            outputs = tuple(map(str, range(len(ratios))))
            p = ModelTest(code, outputs, ratios, ((q, nu - q),) * len(ratios)).p
        else:
            p = _joint_p(float(gains[place]), rank, plan.freedom)
        cause = Cause(code, float(gains[place]), int(rank), tried, min(p * tried, 1.0), row, wholly)
        before = found.get(code)
        if cause.p < LEVEL and (
            before is None or cause.score(plan.freedom) > before.score(plan.freedom)
        ):
            found[code] = cause
    return list(found.values())


def _joint_p(gain: float, q: float, freedom: float) -> float:
    left = freedom - q
    return f_tail(math.expm1(min(gain / freedom, 600.0)) * left / q, q, left)


class _Setting:
    """What a plan depends on, equal where these are."""

    def __init__(self, c: Calibration) -> None:
        self.calibration = c
        noise, S = c.noise, c.sensitivity
        level = noise is None or not np.ptp(noise.reshape(len(c.readings), -1), axis=0).any()
        own = np.maximum(np.sqrt(np.einsum("mi,mi->m", S, S)), _ROUNDING * np.abs(S).max())
        size = own / c.residual_sd
        weight = np.exp2(np.rint(np.log2(size * (len(own) / size.sum()))))
        # cross terms of a few percent and sd by chance give the same plan
        self.slopes = np.rint(S / (_GRID * own)[:, None]) * (_GRID * weight)[:, None] + 0.0
        self.weight = None
        if noise is not None and not level:
            self.weight = 1.0 / np.sqrt(noise).reshape(c.residuals.shape)
        columns, sd = c.readings.environment, c.readings.sd
        self._key = (
            *(c.model.names, c.reference.tobytes(), self.slopes.tobytes()),
            *(columns[name].tobytes() for name in sorted(columns)),
            b"" if self.weight is None else self.weight.tobytes(),
            b"" if sd is None else sd.tobytes(),
        )

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Setting) and self._key == other._key


@lru_cache(maxsize=_KEPT)
def _plan_of(setting: _Setting) -> Plan | None:
    """Return the plan at known orientations."""
    c = setting.calibration
    n, m = c.residuals.shape
    phi = c.model.basis(c.reference, c.readings.environment)
    weight = np.ones((n, m)) if setting.weight is None else setting.weight
    alike: dict[tuple[bytes, bytes], list[int]] = {}
    for i, columns in enumerate(c.model.columns):
        alike.setdefault((columns.tobytes(), weight[:, i].tobytes()), []).append(i)
    groups = [np.array(outputs, dtype=np.intp) for outputs in alike.values()]
    bases = []
    for outputs in groups:
        i = int(outputs[0])
        bases.append(np.linalg.qr(phi[:, c.model.columns[i]] * weight[:, [i]])[0])
    p = max(Q.shape[1] for Q in bases)
    families = _families(c, setting.slopes, p)
    return _planned(c, families, groups, bases, weight)


def _planned(
    c: Calibration,
    families: list[_Family],
    groups: list[Rows],
    bases: list[Array],
    weight: Array,
    alike: Array | float = 1.0,
) -> Plan | None:
    """Return the plan of families, Q of each group of outputs, and what whitens readings (n, M).

    `alike` (n, n) is by how much rows have the same noise in them.
    """
    n, m = weight.shape
    order = time_order(c)
    rank = np.empty(n, dtype=np.intp)
    rank[order] = np.arange(n)
    nu = float(n - max(Q.shape[1] for Q in bases))
    freedom = nu * m
    if nu < 1.0:
        return None
    apart = [family for family in families if family.base.ndim == 2]
    joint = [family for family in families if family.base.ndim == 3]
    shared: list[tuple[Rows, Array]] = []
    ranks: Array = np.zeros(0)
    q = max((family.base.shape[1] for family in apart), default=0)
    for outputs, Q in zip(groups, bases, strict=True):
        scale = weight[:, [int(outputs[0])]]
        parts = []
        for family in apart:
            base = family.base @ np.eye(family.base.shape[1], q)
            Z = _stepped(base * scale, family.steps, rank)
            parts.append(_orthonormal(Z - Q @ (Q.T @ Z), Z))
        rows = np.concatenate(parts) if parts else np.zeros((0, q, n))
        ranks = np.count_nonzero(rows.any(axis=2), axis=1).astype(np.float64)
        shared.append((outputs, rows.reshape(-1, n)))
    wide = max((family.base.shape[2] for family in joint), default=0)
    together = []
    for family in joint:
        base = (family.base * weight[:, :, None]) @ np.eye(family.base.shape[2], wide)
        Z = _stepped(base, family.steps, rank)
        V = Z.copy()
        for outputs, Q in zip(groups, bases, strict=True):
            for i in outputs.tolist():
                V[:, :, i] -= Q @ (Q.T @ Z[:, :, i])
        size = len(Z), n * m, wide
        together.append(_orthonormal(V.reshape(size), Z.reshape(size)))
    rows = np.concatenate(together) if together else np.zeros((0, wide, n * m))
    joint_ranks = np.count_nonzero(rows.any(axis=2), axis=1)
    all_ranks = np.concatenate([ranks * m, joint_ranks])
    places: list[tuple[str, int | None, int, bool]] = []
    for family in (*apart, *joint):
        steps = [None] if family.steps is None else order[family.steps].tolist()
        tried = len(steps) * sum(f.code == family.code for f in families)
        places += [(family.code, row, tried, family.wholly) for row in steps]
    limits = [
        _limit(q_, freedom, tried) for q_, (_, _, tried, _) in zip(all_ranks, places, strict=True)
    ]
    slow, slow_limit = _slow(groups, bases, rank, alike)
    return Plan(
        order=order,
        apart=tuple(shared),
        together=rows.reshape(-1, n * m),
        widths=(q, wide),
        ranks=all_ranks,
        limits=np.array(limits),
        places=tuple(places),
        nu=nu,
        freedom=freedom,
        slow=slow,
        slow_limit=slow_limit,
    )


def _limit(q: float, freedom: float, tried: int) -> float:
    """Return Λ that chance alone seldom passes; a first sight, which p decides upon."""
    left = freedom - q
    if q < 1.0 or left < 1.0:
        return math.inf
    f = f_quantile(1.0 - LEVEL / tried, q, left)
    return freedom * math.log1p(q * f / left) if math.isfinite(f) else math.inf


def _stepped(base: Array, steps: Rows | None, rank: Rows) -> Array:
    """Return columns (K, n, …) times a step at each of K rows."""
    if steps is None:
        return base[None]
    after = (rank >= steps[:, None]).astype(np.float64)
    return np.asarray(after.reshape(*after.shape, *(1,) * (base.ndim - 1)) * base)


def _orthonormal(V: Array, Z: Array) -> Array:
    """Return orthonormal rows (K, q, r) of V (K, r, q); of what is no more than rounding, zeros."""
    scale = np.sqrt(np.einsum("krq,krq->kq", Z, Z))[:, None]
    U = V / np.where(scale > 0.0, scale, 1.0)
    U = np.where(np.isfinite(U), U, 0.0)  # of readings beyond all numbers
    values, vectors = np.linalg.eigh(U.transpose(0, 2, 1) @ U)
    identifiable = values > _IDENTIFIABLE
    roots = np.where(identifiable, 1.0 / np.sqrt(np.where(identifiable, values, 1.0)), 0.0)
    return np.asarray((U @ vectors * roots[:, None]).transpose(0, 2, 1))


def _families(c: Calibration, slopes: Array, p: int) -> list[_Family]:
    """Return the columns of every cause that these rows can have, p terms an output."""
    n = len(c.readings)
    f, order = c.reference, time_order(c)
    time = c.readings.environment.get(_TIME, np.zeros(0))
    t = np.empty(n)
    t[order] = np.arange(n)
    if len(time) and np.isfinite(time).all() and np.ptp(time) > 0.0:
        t = np.asarray(time, dtype=np.float64)
    t = t - t.mean()
    after = _some(_LEAST, n - _LEAST)
    families = [_Family("drift", t[:, None])]
    if len(after):
        turn = np.cross(f[:, None, :], slopes[None])  # K_i (ω × f) = ω (f × K_i)
        families += [_Family("replaced", np.ones((n, 1)), after), _Family("slipped", turn, after)]
    wholly = _some(p + 1, n - p - 1)
    if len(wholly):
        phi = c.model.basis(f, c.readings.environment)
        families.append(_Family("replaced", phi, wholly))
    before = f[order[np.maximum(np.arange(n) - 1, 0)]]
    held = np.empty_like(f)
    held[order] = before
    families.append(_Family("settling", ((held - f) @ slopes.T)[:, :, None]))
    return families + list(_stated(c, slopes))


def _stated(c: Calibration, slopes: Array) -> Iterable[_Family]:
    """Yield the columns of causes that need more than the order: approach, sd, attitudes, rolls."""
    n = len(c.readings)
    approach = c.readings.environment.get(APPROACH)
    if approach is not None and np.isfinite(approach).all() and np.ptp(approach) > 0.0:
        yield _Family("hysteresis", approach[:, None])
    sd = c.readings.sd
    if sd is not None:
        own = np.sqrt(np.einsum("nm,nm->n", sd, sd))
        if own.max() > _UNEQUAL * np.median(own) > 0.0:
            yield _Family("vibration", own[:, None] ** 2)
    rotation = c.readings.rotation
    if rotation is not None and np.isfinite(rotation).all():
        level = np.einsum("mi,nij->nmj", slopes, rotation[:, :, :2])
        yield _Family("level", level)
    rolls = () if c.readings.up is None else find_rolls(c.readings)
    rolls = tuple(roll for roll in rolls if len(roll.rows) >= _TURN)
    if rolls:
        yield _Family("table", table_effects(c, rolls, slopes).reshape(n, len(slopes), -1))


def _some(first: int, end: int) -> Rows:
    """Return rows from first to before end, no more than so many."""
    if end - first <= _MOST:
        return np.arange(first, max(end, first))
    return np.unique(np.linspace(first, end - 1, _MOST).astype(np.intp))


def _slow(
    groups: list[Rows], bases: list[Array], rank: Rows, alike: Array | float
) -> tuple[tuple[tuple[Rows, Array], ...], float]:
    """Return Ω of eq. (2), and the T that chance alone seldom passes."""
    n = len(rank)
    rho = min(max(1.0 - 5.0 / n, 0.5), 0.95)
    omega = rho ** np.abs(rank[:, None] - rank) * alike
    mean = variance = low = high = 0.0
    for outputs, Q in zip(groups, bases, strict=True):
        nu = n - Q.shape[1]
        P = np.eye(n) - Q @ Q.T
        values = np.linalg.eigvalsh(P @ omega @ P)[n - nu :]
        k = len(outputs)
        mean += k * float(values.mean())
        variance += k * 2.0 * float(values.var()) / (nu + 2.0)
        low, high = low + k * float(values[0]), high + k * float(values[-1])
    span = high - low
    x = (mean - low) / span if span > 0.0 else 0.5
    spread = variance / span**2 if span > 0.0 else 0.0
    if not spread > 0.0:
        return (), math.inf
    size = x * (1.0 - x) / spread - 1.0
    f = f_quantile(1.0 - LEVEL, 2.0 * x * size, 2.0 * (1.0 - x) * size)
    share = x * f / ((1.0 - x) + x * f)
    return tuple((outputs, omega) for outputs in groups), low + span * share


def slow_gain(c: Calibration, order: Rows) -> float:
    """Return twice the gain in restricted likelihood of rows correlated as ρ^|j − k|."""
    n = len(order)
    rank = np.empty(n, dtype=np.intp)
    rank[order] = np.arange(n)
    gap = np.abs(rank[:, None] - rank)
    if c.estimator is Estimator.UNKNOWN:
        X, e, across = _along_normals(c)
        problems = [(X, e, across @ across.T)]
    else:
        phi = c.model.basis(c.reference, c.readings.environment)
        sd = c.sd_of_readings
        error = c.residuals / sd
        problems = [
            (phi[:, columns] / sd[:, [i]], error[:, i], np.ones((n, n)))
            for i, columns in enumerate(c.model.columns)
        ]
    best = 0.0
    for rho in (0.5, 0.7, 0.8, 0.9, 0.95, 0.98):
        R = rho**gap
        best = max(best, sum(_restricted(X, e, R * alike) for X, e, alike in problems))
    return best


def _restricted(X: Array, e: Array, R: Array) -> float:
    """Return twice the logarithm of the restricted likelihood of R over that of white noise."""
    n, p = X.shape
    both = np.column_stack([X, e])
    plain = np.abs(np.diag(np.linalg.qr(both, mode="r")))
    L = np.linalg.cholesky(R)
    size = np.abs(np.diag(np.linalg.qr(np.linalg.solve(L, both), mode="r")))
    logs = float(np.log(np.diag(L)).sum() + np.log(size[:p] / plain[:p]).sum())
    return float(-2.0 * (logs + (n - p) * math.log(float(size[p] / plain[p]))))


def _along_normals(c: Calibration) -> tuple[Array, Array, Array]:
    """Return design (n, p), misfit (n,) and whitening vectors (n, M) of unknown orientations."""
    f = c.reference
    H = c.model.force_jacobian(c.parameters, f, c.readings.environment)
    normal = np.linalg.solve(H.transpose(0, 2, 1), f[:, :, None])[:, :, 0]
    sd = c.sd_of_readings
    across = normal * sd
    size = np.sqrt(np.einsum("nm,nm->n", across, across))[:, None]
    jacobian = parameter_jacobian(c.model, c.parameters, f, c.readings.environment)
    weight = normal / size
    return (
        np.einsum("nm,nmp->np", weight, jacobian),
        np.einsum("nm,nm->n", weight, c.residuals),
        across / size,
    )


def _at_unknown(c: Calibration) -> tuple[Plan | None, Array]:
    """Return the plan of misfits along the force, as of one output, and these (n, 1)."""
    X, e, across = _along_normals(c)
    n, p = X.shape
    if n - p < 1:
        return None, e[:, None]
    Q = np.linalg.qr(X)[0]
    weight = across / c.sd_of_readings
    families = [
        replace(family, base=_on_normals(family, X, weight))
        for family in _families(c, c.sensitivity, p)
        if family.code not in _OF_ATTITUDE
    ]
    one = [np.zeros(1, dtype=np.intp)]
    plan = _planned(c, families, one, [Q], np.ones((n, 1)), across @ across.T)
    return plan, (e - Q @ (Q.T @ e))[:, None]


def _on_normals(family: _Family, X: Array, weight: Array) -> Array:
    """Return what columns do to misfits along the force (n, 1, q), by the design X (n, p) there."""
    if family.wholly:  # but for a turn
        return X[:, None]
    base = family.base
    if base.ndim == 2:
        return np.asarray(base[:, :, None] * weight[:, None])
    return np.asarray(np.einsum("nmq,nm->nq", base, weight)[:, None])


def estimate(c: Calibration, cause: Cause) -> tuple[Cause, Array]:
    """Return a cause with Λ by outputs of a scatter each, and its sizes (q,) or (q, M).

    Sizes are in reading units per unit of the column; outputs that move together are weighted in
    turn by what they scatter beside the cause.
    """
    families = _families(c, c.sensitivity, max(map(len, c.model.terms)))
    family = next(f for f in families if (f.code, f.wholly) == (cause.code, cause.wholly))
    order, sd = time_order(c), c.sd_of_readings
    after = np.ones(len(order))
    if cause.row is not None:
        after[order] = np.arange(len(order)) >= int(np.flatnonzero(order == cause.row)[0])
    if c.estimator is Estimator.UNKNOWN:
        X, error, across = _along_normals(c)
        Z = _on_normals(family, X, across / sd) * after[:, None, None]
        return cause, _joint_sizes([np.linalg.qr(X)[0]], Z, error[:, None])[0]
    base = family.base if family.base.ndim == 3 else family.base[:, None]
    base = base * after[:, None, None]
    phi = c.model.basis(c.reference, c.readings.environment)
    bases = [
        np.linalg.qr(phi[:, columns] / sd[:, [i]])[0] for i, columns in enumerate(c.model.columns)
    ]
    if base.shape[1] == 1:
        apart = [
            _joint_sizes([Q], base / sd[:, [i], None], c.residuals[:, [i]] / sd[:, [i]])[0]
            for i, Q in enumerate(bases)
        ]
        return cause, np.column_stack(apart)
    sizes, gain = _joint_sizes(bases, base / sd[:, :, None], c.residuals / sd)
    return replace(cause, gain=gain), sizes


def _joint_sizes(bases: list[Array], Z: Array, e: Array) -> tuple[Array, float]:
    """Return the sizes (q,) of columns Z (n, M, q) common to outputs, and Λ."""
    V = Z.copy()
    for i, Q in enumerate(bases):
        V[:, i] -= Q @ (Q.T @ Z[:, i])
    nu = len(e) - np.array([Q.shape[1] for Q in bases])
    before = now = np.einsum("nm,nm->m", e, e)
    sizes = np.zeros(Z.shape[2])
    for _ in range(_ROUNDS):
        weight = np.sqrt(nu / now)
        rows = (V * weight[:, None]).reshape(-1, V.shape[2])
        sizes = np.linalg.lstsq(rows, (e * weight).ravel(), rcond=_ROUNDING)[0]
        left = e - V @ sizes
        now = np.maximum(np.einsum("nm,nm->m", left, left), _ROUNDING**2 * before)
    return sizes, float(nu @ np.log(before / now))


def describe(c: Calibration, cause: Cause, sizes: Array | None) -> Finding:
    """Return what is said of a cause, with its size and what to do."""
    return _SAID[cause.code](c, cause, np.zeros(0) if sizes is None else sizes)


def _label(c: Calibration, cause: Cause) -> str:
    assert cause.row is not None
    return c.readings.labels[cause.row]


def _say_drift(c: Calibration, cause: Cause, sizes: Array) -> Finding:
    time = c.readings.environment.get(_TIME)
    timed = time is not None and np.isfinite(time).all() and np.ptp(time) > 0.0
    span = float(np.ptp(time)) if time is not None and timed else len(c.readings) - 1.0
    whole = float(np.abs(sizes).max()) * span
    return Finding(
        "drift",
        "warning",
        f"readings drift by {whole:.2g} {c.model.unit} from the first row to the last "
        f"(p = {cause.chance})",
        "Fit the drift with --drift.",
        p=cause.p,
    )


def _say_slipped(c: Calibration, cause: Cause, sizes: Array) -> Finding:
    row = _label(c, cause)
    degrees = math.degrees(float(np.linalg.norm(sizes)))
    return Finding(
        "slipped",
        "warning",
        f"from row {row} on the case is turned by {degrees:.2g} degrees, as one that slipped "
        f"(p = {cause.chance}), and U leaves that out",
        f"Give the rows from {row} on a name in a column `group`, the others none.",
        (row,),
        p=cause.p,
    )


def _say_replaced(c: Calibration, cause: Cause, sizes: Array) -> Finding:
    row = _label(c, cause)
    what = f"zeros, by up to {float(np.abs(sizes[0]).max()):.2g} {c.model.unit}"
    what = "parameters" if cause.wholly else what
    return Finding(
        "replaced",
        "warning",
        f"from row {row} on the readings follow other {what} (p = {cause.chance}), as those of "
        "another unit or switch-on",
        f"Fit the rows before {row} and those from it on apart.",
        (row,),
        p=cause.p,
    )


def _say_settling(c: Calibration, cause: Cause, sizes: Array) -> Finding:
    share = 100.0 * float(sizes.item())
    return Finding(
        "settling",
        "warning",
        f"readings hold {share:.2g} % of the row before (p = {cause.chance}), as a filter does "
        "that has not settled",
        "Wait longer at each position before it is read.",
        p=cause.p,
    )


def _say_hysteresis(c: Calibration, cause: Cause, sizes: Array) -> Finding:
    both = 2.0 * float(np.abs(sizes).max())
    return Finding(
        "hysteresis",
        "warning",
        f"readings differ by {both:.2g} {c.model.unit} with the side from which a position is "
        f"approached (p = {cause.chance})",
        "Approach all positions from one side, or each from both.",
        p=cause.p,
    )


def _say_vibration(c: Calibration, cause: Cause, sizes: Array) -> Finding:
    sd = c.readings.sd
    assert sd is not None
    own = np.sqrt(np.einsum("nm,nm->n", sd, sd))
    loud = np.flatnonzero(own > _UNEQUAL * np.median(own))
    moved = float(np.abs(sizes).max() * own.max() ** 2)
    return Finding(
        "vibration",
        "warning",
        f"readings move by up to {moved:.2g} {c.model.unit} with the variance of their rests "
        f"(p = {cause.chance}), as vibration is rectified",
        "Measure these rests again with less of it, or set them aside with --exclude.",
        tuple(c.readings.labels[i] for i in loud.tolist()),
        p=cause.p,
    )


def _say_level(c: Calibration, cause: Cause, sizes: Array) -> Finding:
    degrees = math.degrees(float(np.linalg.norm(sizes)))
    return Finding(
        "level",
        "warning",
        f"the attitudes show a table that is tilted by {degrees:.2g} degrees (p = {cause.chance})",
        f"Level it, or fit with --level-sd {degrees:.1g}.",
        p=cause.p,
    )


def _say_table(c: Calibration, cause: Cause, sizes: Array) -> Finding:
    degrees = math.degrees(float(np.abs(sizes).max()))
    return Finding(
        "table",
        "warning",
        f"the residuals follow the angles of the rolls, as a table does that is off by "
        f"{degrees:.1g} degrees (p = {cause.chance})",
        f"Correct its angles by `multipos tumble`, or fit with --orientation-sd {degrees:.1g}.",
        p=cause.p,
    )


def _say_slow(c: Calibration, cause: Cause, sizes: Array) -> Finding:
    return Finding(
        "time-correlated",
        "warning",
        "residuals are alike from one row to the next though the positions are not, and U is too "
        "small",
        "Give the rows a column `time`, of which U follows, or take the positions in random order.",
        p=cause.p,
    )


_SAID: dict[str, Callable[[Calibration, Cause, Array], Finding]] = {
    "drift": _say_drift,
    "slipped": _say_slipped,
    "replaced": _say_replaced,
    "settling": _say_settling,
    "hysteresis": _say_hysteresis,
    "vibration": _say_vibration,
    "level": _say_level,
    "table": _say_table,
    SLOW: _say_slow,
}
