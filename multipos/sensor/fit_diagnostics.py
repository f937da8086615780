"""What the residuals say of a fit: outliers, linearity, lack of fit, equal variances.

Studentised residuals: with the leverage h_k and residual degrees of freedom ν,

    r_k = e_k / (s sqrt(1 - h_k)),    t_k = r_k sqrt((ν - 1) / (ν - r_k²)),                (1)

t_k follows Student's t with ν − 1 degrees of freedom [1]_; a position is an outlier where it
passes the 1 % point divided by the number of readings (Bonferroni). Where some rows are noisier
than others, all outputs together, that names them too often. So, where there are two outputs and
eight degrees of freedom of each to tell, what passes must also be beyond that point by the p value
of `multipos.sensor.fit_diagnostics`, whose rows may be alike or not.

Linearity of an output against its own reference: with the least-squares line through the
readings and its span S from −1 to +1 g (where forces are known, to the largest), the largest
|reading − line| and the largest |residual of the model|, both over S, in percent.

Whether a reading is beyond chance where some rows may be noisier than others.

All outputs of a row are noisier together: output m of row k has the variance c_m w_k, and
w_k = v d/χ²_d varies the more from row to row the smaller d is; rows alike have d = ∞. Readings in
question are left out of the fit. Let e be what is left of the others, or what those in question
are off by, h' the leverage and ν_m the degrees of freedom without them, and m_k the outputs of row
k that are not in question:

    c_m = Σ e²/ν_m,    r² = e²/(c_m (1 ∓ h')),    q_k = Σ r²,    + of those in question,    (3)
    ln L(d, v) = Σ (1 − h'_k) ln t(q_k; m_k, d, v),                                         (4)

t the density of m_k normal numbers of common variance w_k, h'_k the mean of the row. The reading is
off by t standard deviations on D degrees of freedom (Welch and Satterthwaite: its row and output),

    t² = r² (d + m_k)/(d v + q_k),    1/D = 1/(d + m_k) + 1/ν_m,                            (5)

and its p value is the mean of those of all d by their chance given the readings, v at its best:
L(d, v) √(1 + (M + 2)/d), the second factor the width of L in ln v, times what is assumed before:
.7 that rows are alike, and else d even in its logarithm from 1 to 60. With d = ∞ alone it would be
eq. (1) of `multipos.sensor.fit_diagnostics`.

A test of a term that a model lacks: what it says, and its form in files.

Each output by itself has a ratio R_i that follows F(q_i, ν_i) if nothing is in the term. Their
p values P_i combine to

    X = −2 sum ln P_i,   chi² on 2M degrees of freedom,                                     (6)

(R. A. Fisher, *Statistical Methods for Research Workers*, 1932, section 21.1); outputs that are
tested together have one R ~ F(q, ν). `multipos.diagnostics.score_tests` says how R comes about.

References
----------
.. [1] R. D. Cook, S. Weisberg, *Residuals and Influence in Regression*, 1982, section 2.2.1.
G. K. Smyth, *Linear models and empirical Bayes methods for assessing differential expression in
microarray experiments*, Stat. Appl. Genet. Mol. Biol. 3 (2004) 3: variances with a common χ²_d.
"""

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from multipos.files.records import ANY_TEXT, DOF, NOT_NEGATIVE, P_VALUE, Fields, Listed, Named
from multipos.finding import Findings
from multipos.numerics import quantiles
from multipos.numerics.arrays import COMPONENTS, Array, Mask, Places
from multipos.results import Result, frozen, plain_dict
from multipos.sensor.model import Model

_ALIKE = 0.7  # chance, before anything is seen, that rows are alike
_DS = np.append(np.geomspace(1.0, 60.0, 8), 1e6)  # the last as good as alike
_PRIOR = np.append(np.full(8, (1.0 - _ALIKE) / 8.0), _ALIKE)
_STEPS = 20  # towards the best v: within 1e-8 of it where rows are of 4:2:1, 2e-3 at 10:1
_DIGITS = 9  # of degrees of freedom, so that there are few of them
_SINGULAR = 1e-12  # eigenvalue of G, below which the other readings lack a parameter
_NOTHING = 1e-9  # of a reading whose row alone fixes a parameter


def p_values(
    errors: Array, leverage: Array, designs: Sequence[Array], questioned: Mask
) -> Array | None:
    """Return the p value of every reading that is questioned, eq. (5), row by row.

    Parameters
    ----------
    errors, leverage : (n, M) arrays
        Residuals of the fit, over their stated uncertainty where there is one.
    designs : M arrays (n, p_m)
        Of every output, weighted likewise.
    questioned : (n, M) array of bool

    Returns
    -------
    array or None
        None where the other readings do not determine the fit.
    """
    each_once = {id(design): design for design in designs}
    Q = {key: np.linalg.qr(design)[0] for key, design in each_once.items()}
    bases = [Q[id(design)] for design in designs]
    (found,) = p_values_of_units(errors[None], leverage, bases, questioned[None])
    return None if np.isnan(found[questioned]).any() else found[questioned]


def p_values_of_units(
    errors: Array, leverage: Array, bases: Sequence[Array], questioned: Mask
) -> Array:
    """Return the p values (B, n, M) of eq. (5) of B units; NaN of what is not questioned.

    NaN as well where the other readings of a unit do not determine the fit.

    Parameters
    ----------
    errors : (B, n, M) array
        As in `p_values`.
    leverage : (n, M) array
    bases : M arrays (n, p_m)
        Orthonormal columns of the designs.
    questioned : (B, n, M) array of bool
    """
    e2, factor, whole = _without(errors, leverage, bases, questioned)
    weight = np.where(questioned, 0.0, np.maximum(factor, 0.0))
    nu = weight.sum(axis=1)
    r2 = e2 / np.maximum(factor, _NOTHING)
    c = np.sum(weight * r2, axis=1)
    whole &= ((nu > 0.5) & (c > 0.0)).all(axis=1)
    r2 *= (nu / np.where(c > 0.0, c, 1.0))[:, None]
    left = np.sum(~questioned, axis=2).astype(np.float64)
    q = np.sum(np.where(questioned, 0.0, r2), axis=2)
    result = np.full(errors.shape, np.nan)
    units = np.flatnonzero(whole)
    if not len(units):
        return result
    rows = weight[units].sum(axis=2) / np.maximum(left[units], 1.0)
    chances, v = _law(q[units], left[units], rows, errors.shape[2])
    b, k, m = np.nonzero(questioned[units])
    unit = units[b]
    own = _DS + left[unit, k, None]
    t2 = r2[unit, k, m][:, None] * own / (_DS * v[b] + q[unit, k, None])
    dof = np.round(1.0 / (1.0 / own + 1.0 / nu[unit, m][:, None]), _DIGITS)
    result[unit, k, m] = np.einsum("kd,kd->k", chances[b], quantiles.t_tails(t2, dof))
    return result


def _without(
    errors: Array, leverage: Array, bases: Sequence[Array], questioned: Mask
) -> tuple[Array, Array, Mask]:
    """Return squared errors and variance factors 1 ± h' (B, n, M), eq. (3), and where they exist.

    With Q'e = 0 the fit of the others is off by −G⁻¹ Σ Q_k e_k, G = 1 − Σ Q_k Q_k' over those that
    are questioned, and their leverage is h' = Q G⁻¹ Q'.
    """
    e2, factor = errors**2, np.broadcast_to(1.0 - leverage, errors.shape).copy()
    whole = np.ones(len(errors), dtype=np.bool_)
    for own in _sharing(bases):
        units, place = np.nonzero(questioned[:, :, own].any(axis=1))
        if not len(units):
            continue
        Q, m = bases[own[0]], np.array(own)[place]
        mine, e = questioned[units, :, m], errors[units, :, m]
        p = Q.shape[1]
        products = (Q[:, :, None] * Q[:, None, :]).reshape(len(Q), -1)
        G = np.eye(p) - (mine @ products).reshape(-1, p, p)
        regular = (np.linalg.eigvalsh(G)[:, 0] > _SINGULAR) & (np.sum(~mine, axis=1) > p)
        whole[units[~regular]] = False
        inverse = np.linalg.inv(np.where(regular[:, None, None], G, np.eye(p)))
        lost = np.einsum("bpq,bq->bp", inverse, (mine * e) @ Q)
        e2[units, :, m] = (e + lost @ Q.T) ** 2
        h = inverse.reshape(-1, p * p) @ products.T
        factor[units, :, m] = np.where(mine, 1.0 + h, 1.0 - h)
    return e2, factor, whole


def _sharing(bases: Sequence[Array]) -> list[list[int]]:
    """Return the outputs of each array of a basis."""
    found: dict[int, list[int]] = {}
    for m, Q in enumerate(bases):
        found.setdefault(id(Q), []).append(m)
    return list(found.values())


def _law(q: Array, left: Array, weight: Array, outputs: int) -> tuple[Array, Array]:
    """Return the chance of every d, and the v that is best with it, eq. (4), (B, D) each."""
    d, q, m = _DS[:, None], q[:, None], left[:, None]
    total = np.einsum("bn,bn->b", weight, left)[:, None]
    v = np.repeat(np.einsum("bn,bn->b", weight, q[:, 0])[:, None] / total, len(_DS), axis=1)
    mean = total / weight.sum(axis=1)[:, None]
    both = np.stack([weight * q[:, 0] / mean, weight], axis=2)
    dofs, w = d + m, np.empty(np.broadcast_shapes(d.shape, q.shape))
    for _ in range(_STEPS):  # of a parameter-expanded EM, whose w has the mean one
        np.divide(dofs, np.add(d * v[:, :, None], q, out=w), out=w)  # over v, which cancels
        sums = w @ both
        v = sums[:, :, 0] / sums[:, :, 1]
    gammas = [[math.lgamma((each + k) / 2.0) for k in range(outputs + 1)] for each in _DS.tolist()]
    constant = (np.array(gammas) - np.array(gammas)[:, :1])[:, left.astype(np.intp)]
    size = d * v[:, :, None]
    constant = constant.transpose(1, 0, 2) - 0.5 * m * np.log(np.pi * size)
    tails = 0.5 * (d + m) * np.log1p(q / size)
    log = np.einsum("bn,bdn->bd", weight, constant - tails)
    log += 0.5 * np.log1p((outputs + 2.0) / _DS) + np.log(_PRIOR)
    chances = np.exp(log - log.max(axis=1, keepdims=True))
    return chances / chances.sum(axis=1, keepdims=True), v


_LEAST = 1e-300  # of a probability, whose logarithm is a number still
MODEL_TESTS = Listed(
    Fields(
        {
            "term": ANY_TEXT,
            "statistic": NOT_NEGATIVE,
            "dof": Listed(DOF, 1, 2),
            "p": P_VALUE,
        },
        {"outputs": Named(Fields({"F": NOT_NEGATIVE, "dof": Listed(DOF, 2, 2)}))},
    )
)


@frozen
class ModelTest(Result):
    """A test of one kind of term, outputs together.

    Attributes
    ----------
    term : str
        As in a formula, with `own` and `other` for the axes.
    outputs : tuple of str
        Those tested by themselves; empty where all are tested as one.
    ratios : tuple of float
        R of each, or the one of all.
    dofs : tuple of (q, ν)
    """

    term: str
    outputs: tuple[str, ...]
    ratios: tuple[float, ...]
    dofs: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        """Tuples of numbers are frozen as they are."""

    @cached_property
    def statistic(self) -> float:
        """X of eq. (6), or R where there is one."""
        if len(self.ratios) == 1:
            return self.ratios[0]
        tails = (quantiles.f_tail(f, *dof) for f, dof in zip(self.ratios, self.dofs, strict=True))
        return -2.0 * sum(math.log(max(p, _LEAST)) for p in tails)

    @property
    def dof(self) -> tuple[float, ...]:
        """Degrees of freedom: one of chi², two of F."""
        return self.dofs[0] if len(self.ratios) == 1 else (2.0 * len(self.ratios),)

    @cached_property
    def p(self) -> float:
        """How often chance alone does the same."""
        if len(self.ratios) == 1:
            return quantiles.f_tail(self.ratios[0], *self.dofs[0])
        return quantiles.chi2_tail(self.statistic, *self.dof)

    def __str__(self) -> str:
        law = "F" if len(self.dof) == 2 else "chi2"
        return f"{law}({', '.join(f'{v:.4g}' for v in self.dof)}) = {self.statistic:.3g}"

    @property
    def gain(self) -> float:
        """What the term adds to twice the logarithm of the likelihood, less two a parameter."""
        pairs = zip(self.ratios, self.dofs, strict=True)
        return sum((q + nu) * math.log1p(q * f / nu) - 2.0 * q for f, (q, nu) in pairs)

    def is_below(self, level: float) -> bool:
        """Tell whether p is below a level; most often without working it out."""
        count = len(self.ratios)
        # X beyond its quantile needs one P at most as large as if all were equal.
        enough = level
        if count > 1:
            enough = math.exp(-0.5 * quantiles.chi2_quantile(1.0 - level, 2.0 * count) / count)
        pairs = zip(self.ratios, self.dofs, strict=True)
        return (
            any(f > quantiles.f_quantile(1.0 - enough, *dof) for f, dof in pairs) and self.p < level
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the test as what JSON can carry."""
        said = {"term": self.term, "statistic": self.statistic, "dof": self.dof, "p": self.p}
        if self.outputs:
            triples = zip(self.outputs, self.ratios, self.dofs, strict=True)
            said["outputs"] = {output: {"F": f, "dof": dof} for output, f, dof in triples}
        return plain_dict(said)


def model_test_from_dict(said: Mapping[str, Any]) -> ModelTest:
    """Return the test that `ModelTest.to_dict` described."""
    apart: Mapping[str, Any] = said.get("outputs", {})
    if not apart:
        return ModelTest(said["term"], (), (said["statistic"],), (_pair(said["dof"]),))
    dofs = tuple(_pair(found["dof"]) for found in apart.values())
    ratios = tuple(float(found["F"]) for found in apart.values())
    return ModelTest(said["term"], tuple(apart), ratios, dofs)


def _pair(dof: Sequence[float]) -> tuple[float, float]:
    q, nu = dof
    return float(q), float(nu)


UNEQUAL = 0.05  # level at which outputs are called unequally noisy
OUTLIER_LEVEL = 0.01  # chance that a clean data set has an outlier named
_SUSPECT = 4.0  # squared studentised residual, below which no position is an outlier
ROWS_NAMED = 8.0  # degrees of freedom of an output, from which on rows tell that they are unlike


class NoiseTest(NamedTuple):
    """chi² of the residuals under the stated noise alone, on its degrees of freedom."""

    chi2: float
    dof: float


@frozen
class Diagnostics(Result):
    """What was found about a fit.

    Attributes
    ----------
    rank, parameters : int
    condition : float
        Largest 2-norm condition of the column-scaled, whitened designs.
    leverage : (n, M) array
    lack_of_fit : mapping of output to {F, dof, p}
        Against the spread of repeated positions; empty where none repeats.
    outliers, unidentifiable : tuples of str
    findings : tuple of Finding
        The most serious first.
    model_tests : tuple of ModelTest
        Of every standard term up to third order that the model lacks and the positions show.
    hidden : tuple of str
        Terms of that set that the positions cannot show.
    claim : NoiseTest or None
        How the residuals stand to the stated noise, where there is one.
    """

    rank: int
    parameters: int
    condition: float
    leverage: Array
    lack_of_fit: dict[str, dict[str, object]] = field(default_factory=dict)
    outliers: tuple[str, ...] = ()
    unidentifiable: tuple[str, ...] = ()
    findings: Findings = ()
    model_tests: tuple[ModelTest, ...] = ()
    hidden: tuple[str, ...] = ()
    claim: NoiseTest | None = None


def find_outliers(
    residuals: Array,
    leverage: Array,
    dof: Sequence[float],
    outputs: Sequence[str],
    labels: Sequence[str] | None,
    sd: Array | None = None,
    *,
    design: Array,
    columns: Sequence[Places],
    per_g: Callable[[], Array | None] | None = None,
) -> tuple[str, ...]:
    """Name the positions whose studentised residual, eq. (1), is beyond chance.

    Parameters
    ----------
    residuals, leverage : (n, M) arrays
    dof : M numbers
        Residual degrees of freedom.
    outputs, labels : names of the columns, and of the rows, by number where there are none
    sd : (n, M) array, optional
        Stated standard uncertainty of each reading; all are alike if not given.
    design : (n, K) array
    columns : of every output, which columns of the design its terms are
    per_g : function of nothing, optional
        Returns how outputs (M,) respond to one g, in which deviations are in mg; where there is
        none they are in reading units.
    """
    nu = np.asarray(dof, dtype=np.float64)
    error = residuals if sd is None else residuals / sd
    r2 = studentised_squares(error.T, leverage.T, nu[:, None]).T
    beyond = []
    for column, largest in enumerate(np.fmax.reduce(r2, axis=0, initial=0.0).tolist()):
        if not _is_outlier(largest, float(nu[column]), residuals.size):
            continue
        for row in np.argsort(-r2[:, column], kind="stable").tolist():
            if not _is_outlier(float(r2[row, column]), float(nu[column]), residuals.size):
                break  # and none that is smaller is beyond chance
            beyond.append((column, row))
    if not beyond:
        return ()
    judged = nu.min() >= ROWS_NAMED and error.any(axis=0).all()
    if error.shape[1] > 1 and judged:
        each_once = {own.tobytes(): design[:, own] for own in columns}
        weighed = [each_once[own.tobytes()] for own in columns]
        if sd is not None:
            weighed = [each / sd[:, [m]] for m, each in enumerate(weighed)]
        beyond = _beyond_unlike_rows(error, leverage, weighed, beyond)
    response = None if per_g is None else per_g()
    sizes, unit = (residuals, "") if response is None else (1e3 * residuals / response, " mg")
    return tuple(
        f"position {labels[row] if labels else row + 1}: {outputs[column]} deviates by "
        f"{sizes[row, column]:.3g}{unit}, "
        f"{np.sqrt(r2[row, column]):.1f} times its standard deviation"
        for column, row in sorted(beyond)
    )


def studentised_squares(error: Array, leverage: Array, dof: Array) -> Array:
    """Return r²/s² of eq. (1) (…, n), 0 where a reading cannot be tested.

    Parameters
    ----------
    error, leverage : (…, n) arrays
        Residuals of equal variance, and their leverage.
    dof : (…, 1) array
    """
    s2 = np.einsum("...n,...n->...", error, error)[..., None] / np.maximum(dof, 1.0)
    left = 1.0 - leverage
    # A position that alone fixes a parameter (leverage 1) has no residual to test.
    scale = 1.0 / np.where((dof >= 2.0) & (s2 > 0.0), s2, np.inf)
    r2 = error**2 / np.where(left > 1e-9, left, np.inf)
    r2 *= scale
    return np.asarray(r2)


def square_beyond(chance: float, nu: float) -> float:
    """Return the r²/s² that a probability exceeds: ν t²/(t² + ν − 1), as s² contains r itself."""
    t2 = quantiles.f_quantile(1.0 - chance, 1.0, nu - 1.0)
    return nu * t2 / (t2 + nu - 1.0)


def largest_square(nu: float, readings: int) -> float:
    """Return the r²/s² beyond which `find_outliers` names one of so many readings."""
    low, high = _SUSPECT, nu
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _is_outlier(middle, nu, readings) else (middle, high)
    return high


def _beyond_unlike_rows(
    errors: Array, leverage: Array, designs: Sequence[Array], beyond: list[tuple[int, int]]
) -> list[tuple[int, int]]:
    """Return the outputs and rows that are beyond chance even if rows are unlike."""
    columns, rows = zip(*beyond, strict=True)
    questioned = np.zeros(errors.shape, dtype=np.bool_)
    questioned[rows, columns] = True
    p = p_values(errors, leverage, designs, questioned)
    if p is None:
        return beyond
    level = OUTLIER_LEVEL / errors.size
    places = np.argwhere(questioned)[p < level].tolist()
    return [(column, row) for row, column in places]


def _is_outlier(r2: float, nu: float, readings: int) -> bool:
    """Tell whether a squared studentised residual is beyond chance among so many readings."""
    if r2 <= _SUSPECT:
        return False
    rest = nu - r2
    t = math.inf if rest <= 0.0 else math.sqrt(r2 * (nu - 1.0) / rest)
    level = OUTLIER_LEVEL / readings
    # the normal law has the shorter tails, and settles most without Student's
    return math.erfc(t / math.sqrt(2.0)) < level and quantiles.t_tail(t, nu - 1.0) < level


def find_correlated_outliers(
    design: Array,
    residuals: Array,
    covariance: Array,
    outputs: Sequence[str],
    labels: Sequence[str],
) -> tuple[str, ...]:
    """Name the readings that are beyond chance where readings are correlated.

    With the covariance C, a shift of reading i alone is seen best by (Baarda's data snooping)

        w_i = (C⁻¹ r)_i / √Q_ii,    Q = C⁻¹ − C⁻¹ X (X' C⁻¹ X)⁻¹ X' C⁻¹,                   (2)

    of variance one where the reading is sound; r'C⁻¹r on its degrees of freedom scales it, as in
    eq. (1). Where C is diagonal both are the same.

    Parameters
    ----------
    design : (n M, p) array
        Output running fastest.
    residuals : (n, M) array
    covariance : (n M, n M) array
    outputs, labels : names of the columns and rows
    """
    n, m = residuals.shape
    nu = float(n * m - design.shape[1])
    inverse = np.linalg.inv(covariance)
    seen = inverse @ design
    Q = inverse - seen @ np.linalg.solve(design.T @ seen, seen.T)
    shift = inverse @ residuals.ravel()
    s2 = float(residuals.ravel() @ shift) / nu if nu > 0.0 else 0.0
    if nu < 2.0 or s2 == 0.0:
        return ()
    identifiable = np.diag(Q) > 1e-9 * np.diag(inverse)
    r2 = np.where(identifiable, shift**2 / np.where(identifiable, np.diag(Q), 1.0), 0.0) / s2
    found = []
    for place in np.flatnonzero(r2 > _SUSPECT).tolist():
        if _is_outlier(float(r2[place]), nu, n * m):
            row, column = divmod(place, m)
            found.append(
                f"position {labels[row]}: {outputs[column]} is off by "
                f"{residuals[row, column]:.3g}, {np.sqrt(r2[place]):.1f} times its standard "
                "deviation"
            )
    return tuple(found)


def find_outlying_positions(
    q: Array,
    degrees: Array,
    dof: float,
    labels: Sequence[str],
    *,
    robust: bool = False,
    parts: int = 1,
) -> tuple[str, ...]:
    """Name the positions whose misfit to all outputs together is beyond chance.

    Parameters
    ----------
    q : (n,) array
        Squared misfits in units of the noise variance.
    degrees : (n,) array
        Degrees of freedom of each position.
    dof : float
        Of the noise, where it was estimated from the same misfits; inf where it is known.
    labels : sequence of n str
    robust : bool
        The noise was found by a loss that does not let a single position move it.
    parts : int
        How many outputs are judged alike, one by one.
    """
    found = []
    suspects = np.flatnonzero(q > 4.0 * degrees)
    # Of many, from the largest on: where all are judged alike, no other is beyond the first within.
    suspects = suspects[np.argsort(-q[suspects], kind="stable")]
    alike = bool((degrees == degrees[:1]).all())
    for row in suspects.tolist():
        m, value = float(degrees[row]), float(q[row])
        if np.isinf(dof):
            p = quantiles.chi2_tail(value, m)
        elif robust:
            p = quantiles.f_tail(value / m, m, dof)
        elif dof > m:
            # without the position itself, as t_k of eq. (1): the rest is what it is judged by
            rest = max(dof - value, 1e-300)
            p = quantiles.f_tail(value / m / (rest / (dof - m)), m, dof - m)
        else:
            continue
        if p < OUTLIER_LEVEL / (len(q) * parts):
            said = f"position {labels[row]} does not fit: {np.sqrt(value / m):.1f} times the noise"
            found.append((row, said))
        elif alike:
            break
    return tuple(said for _, said in sorted(found))


def linearity(
    model: Model,
    reference: Array,
    values: Array,
    residuals: Array,
    *,
    reach: float | None = 1.0,
) -> dict[str, dict[str, float]]:
    """Return {output: {without_model_percent, with_model_percent}}; NaN where no line fits.

    The span is that of ± `reach`, where it is None of the largest force along the axis.
    """
    result = {}
    for column, (output, axis) in enumerate(zip(model.outputs, model.axes, strict=True)):
        own = reference[:, COMPONENTS.index(axis)]
        reading = values[:, column]
        centred = own - own.mean()
        square = float(centred @ centred)
        if square < 1e-18:
            result[output] = {"without_model_percent": np.nan, "with_model_percent": np.nan}
            continue
        slope = float(centred @ reading) / square
        from_line = reading - reading.mean() - slope * centred
        largest = float(np.abs(own).max()) if reach is None else reach
        span = abs(2.0 * slope) * largest or np.nan
        result[output] = {
            "without_model_percent": 100.0 * float(np.abs(from_line).max()) / span,
            "with_model_percent": 100.0 * float(np.abs(residuals[:, column]).max()) / span,
        }
    return result


def bartlett(rss: ArrayLike, dof: ArrayLike) -> float:
    """Bartlett's test: p value of the hypothesis that several residual variances are equal.

    Parameters
    ----------
    rss : (m,) array
        Sums of squared residuals.
    dof : float or (m,) array
        Their degrees of freedom.

    Returns
    -------
    float
        Small where equality is to be rejected; nan for fewer than two variances, where one has no
        degree of freedom, or where all are zero.
    """
    rss, dof = np.broadcast_arrays(
        np.asarray(rss, dtype=np.float64), np.asarray(dof, dtype=np.float64)
    )
    m = rss.size
    if m < 2 or not (dof > 0.0).all() or not rss.any():
        return float("nan")
    if (rss == 0.0).any():
        return 0.0
    return quantiles.chi2_tail(float(_statistic(rss, dof)), m - 1)


def are_unequal(rss: Array, dof: Array) -> Mask:
    """Tell of which units (B,) Bartlett's test rejects that variances are equal, rss (B, m)."""
    with np.errstate(divide="ignore", invalid="ignore"):  # inf where one is zero, nan where all are
        statistic = _statistic(rss, dof)
    return np.asarray(statistic > quantiles.chi2_quantile(1.0 - UNEQUAL, len(dof) - 1))


def _statistic(rss: Array, dof: Array) -> Array:
    """Return Bartlett's statistic (…), corrected, of (…, m) sums on (m,) degrees of freedom."""
    total = dof.sum()
    pooled = total * np.log(rss.sum(axis=-1) / total)
    correction = 1.0 + ((1.0 / dof).sum() - 1.0 / total) / (3.0 * (len(dof) - 1))
    return np.asarray((pooled - (dof * np.log(rss / dof)).sum(axis=-1)) / correction)


def lack_of_fit(
    residuals: ArrayLike,
    groups: Sequence[Hashable] | NDArray[np.generic],
    parameters: int,
    *,
    sd: ArrayLike = 1.0,
) -> tuple[float, int, int, float] | None:
    """F test of the model's own error against the scatter of repeated rows.

    Rows of one group share their row of the design, so their residuals scatter about the mean of
    the group by noise alone (pure error); the means scatter by noise and by what the model lacks.

    Parameters
    ----------
    residuals : (n,) array
    groups : sequence of n labels
    parameters : int
        Number of coefficients fitted.
    sd : float or (n,) array
        Standard deviation of each row, up to a common factor.

    Returns
    -------
    (F, dof_lack, dof_pure, p), or None where nothing repeats or the groups are no more than the
    parameters.
    """
    r = np.asarray(residuals, dtype=np.float64)
    numbers: dict[Hashable, int] = {}
    index = np.array([numbers.setdefault(label, len(numbers)) for label in groups], dtype=np.intp)
    weight = np.broadcast_to(np.asarray(sd, dtype=np.float64) ** -2.0, r.shape)
    found = lack_of_fit_ratios(r[None], index, parameters, weight)
    if found is None:
        return None
    (f,), dof_lack, dof_pure = found
    return float(f), dof_lack, dof_pure, quantiles.f_tail(float(f), dof_lack, dof_pure)


def lack_of_fit_ratios(
    residuals: Array, group: Places, parameters: int, weight: Array
) -> tuple[Array, int, int] | None:
    """Return F (B,) of `lack_of_fit` and its degrees of freedom, of residuals (B, n).

    Parameters
    ----------
    residuals : (B, n) array
    group : (n,) array of int
        From 0 on.
    parameters : int
    weight : (n,) array
    """
    total = np.bincount(group, weights=weight)
    dof_lack, dof_pure = len(total) - parameters, len(group) - len(total)
    if dof_lack <= 0 or dof_pure <= 0:
        return None
    order, count = np.argsort(group, kind="stable"), np.bincount(group)
    sums = np.add.reduceat((weight * residuals)[:, order], np.cumsum(count) - count, axis=1)
    mean = sums / total
    pure = (weight * (residuals - mean[:, group]) ** 2).sum(axis=1) / dof_pure
    lack = (total * mean**2).sum(axis=1) / dof_lack
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(lack / pure), dof_lack, dof_pure
