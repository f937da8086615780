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
L(d, v) √(1 + (M + 2)/d), the second factor the width of L in ln v, times what is believed before:
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
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from multipos.files.records import ANY_TEXT, NOT_NEGATIVE, P_VALUE, Fields, Listed, Named, Number
from multipos.finding import Findings
from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import chi2_quantile, chi2_tail, f_quantile, f_tail, t_tail
from multipos.numerics.terms import COMPONENTS
from multipos.results import Result, plain
from multipos.sensor.model import Model

_ALIKE = 0.7  # chance, before anything is seen, that rows are alike
_DS = np.append(np.geomspace(1.0, 60.0, 8), 1e6)  # the last as good as alike
_BELIEVED = np.append(np.full(8, (1.0 - _ALIKE) / 8.0), _ALIKE)
_STEPS = 20  # towards the best v: within 1e-8 of it where rows are of 4:2:1, 2e-3 at 10:1
_NOTHING = 1e-9  # of a reading whose row alone fixes a parameter


def p_values(
    errors: Array, leverage: Array, designs: Sequence[Array], questioned: NDArray[np.bool_]
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
    e2, factor = errors**2, 1.0 - leverage
    for m in np.flatnonzero(questioned.any(axis=0)).tolist():
        without = _without(errors[:, m], designs[m], ~questioned[:, m])
        if without is None:
            return None
        e2[:, m], factor[:, m] = without
    weight = np.where(questioned, 0.0, np.maximum(factor, 0.0))
    nu = weight.sum(axis=0)
    r2 = e2 / np.maximum(factor, _NOTHING)
    c = np.sum(weight * r2, axis=0)
    if not (nu > 0.5).all() or not (c > 0.0).all():
        return None
    r2 *= nu / c
    left = np.sum(~questioned, axis=1).astype(np.float64)
    q = np.sum(np.where(questioned, 0.0, r2), axis=1)
    chances, v = _law(q, left, weight.sum(axis=1) / np.maximum(left, 1.0), errors.shape[1])
    found = []
    for k, m in np.argwhere(questioned).tolist():
        own = _DS + left[k]
        t = np.sqrt(r2[k, m] * own / (_DS * v + q[k])).tolist()
        dof = (1.0 / (1.0 / own + 1.0 / nu[m])).tolist()
        found.append(sum(map(math.prod, zip(chances, map(t_tail, t, dof), strict=True))))
    return np.array(found)


def _without(error: Array, design: Array, kept: NDArray[np.bool_]) -> tuple[Array, Array] | None:
    """Return the squared errors and variance factors 1 ± h' (n,) of one output, eq. (3)."""
    if not np.count_nonzero(kept) > design.shape[1]:
        return None
    R = np.asarray(np.linalg.qr(design[kept], mode="r"))
    size = np.abs(np.diag(R))
    if not size.min() > _NOTHING * size.max():
        return None
    basis = np.linalg.solve(R.T, design.T).T
    e = error - basis @ (basis[kept].T @ error[kept])
    h = np.sum(basis**2, axis=1)
    return e**2, np.where(kept, 1.0 - h, 1.0 + h)


def _law(q: Array, left: Array, weight: Array, outputs: int) -> tuple[list[float], Array]:
    """Return the chance of every d, and the v that is best with it, eq. (4)."""
    d = _DS[:, None]
    v = np.full(len(_DS), (weight @ q) / (weight @ left))
    for _ in range(_STEPS):  # of a parameter-expanded EM, whose w has the mean one
        w = (d + left) / (d + q / v[:, None])
        v = (w @ (weight * q)) / (weight @ left) * weight.sum() / (w @ weight)
    log = np.empty(len(_DS))
    counts, place = np.unique(left, return_inverse=True)
    for i, (each, best) in enumerate(zip(_DS.tolist(), v.tolist(), strict=True)):
        gammas = [math.lgamma((each + m) / 2.0) for m in counts.tolist()]
        constant = np.array(gammas) - math.lgamma(each / 2.0)
        constant -= 0.5 * counts * math.log(math.pi * each * best)
        tails = 0.5 * (each + left) * np.log1p(q / (each * best))
        log[i] = weight @ (constant[place] - tails)
    log += 0.5 * np.log1p((outputs + 2.0) / _DS) + np.log(_BELIEVED)
    chances = np.exp(log - log.max())
    return (chances / chances.sum()).tolist(), v


_LEAST = 1e-300  # of a probability, whose logarithm is a number still
_DOF = Number(0.0, above=True)
MODEL_TESTS = Listed(
    Fields(
        {
            "term": ANY_TEXT,
            "statistic": NOT_NEGATIVE,
            "dof": Listed(_DOF, 1, 2),
            "p": P_VALUE,
        },
        {"outputs": Named(Fields({"F": NOT_NEGATIVE, "dof": Listed(_DOF, 2, 2)}))},
    )
)


@dataclass(frozen=True, eq=False)
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
        tails = (f_tail(f, *dof) for f, dof in zip(self.ratios, self.dofs, strict=True))
        return -2.0 * sum(math.log(max(p, _LEAST)) for p in tails)

    @property
    def dof(self) -> tuple[float, ...]:
        """Degrees of freedom: one of chi², two of F."""
        return self.dofs[0] if len(self.ratios) == 1 else (2.0 * len(self.ratios),)

    @cached_property
    def p(self) -> float:
        """How often chance alone does the same."""
        if len(self.ratios) == 1:
            return f_tail(self.ratios[0], *self.dofs[0])
        return chi2_tail(self.statistic, *self.dof)

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
            enough = math.exp(-0.5 * chi2_quantile(1.0 - level, 2.0 * count) / count)
        pairs = zip(self.ratios, self.dofs, strict=True)
        return any(f > f_quantile(1.0 - enough, *dof) for f, dof in pairs) and self.p < level

    def to_dict(self) -> dict[str, Any]:
        """Return the test as what JSON can carry."""
        said = {"term": self.term, "statistic": self.statistic, "dof": self.dof, "p": self.p}
        if self.outputs:
            triples = zip(self.outputs, self.ratios, self.dofs, strict=True)
            said["outputs"] = {output: {"F": f, "dof": dof} for output, f, dof in triples}
        result: dict[str, Any] = plain(said)
        return result


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
ROWS_TOLD = 8.0  # degrees of freedom of an output, from which on rows tell that they are unlike


class Claim(NamedTuple):
    """chi² of the residuals under the stated noise alone, on its degrees of freedom."""

    chi2: float
    dof: float


@dataclass(frozen=True, eq=False)
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
    claim : Claim or None
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
    claim: Claim | None = None


def find_outliers(
    residuals: Array,
    leverage: Array,
    dof: Sequence[float],
    outputs: Sequence[str],
    labels: Sequence[str],
    sd: Array | None = None,
    *,
    design: Array,
    columns: Sequence[NDArray[np.intp]],
) -> tuple[str, ...]:
    """Name the positions whose studentised residual, eq. (1), is beyond chance.

    Parameters
    ----------
    residuals, leverage : (n, M) arrays
    dof : M numbers
        Residual degrees of freedom.
    outputs, labels : names of the columns and rows
    sd : (n, M) array, optional
        Stated standard uncertainty of each reading; all are alike if not given.
    design : (n, K) array
    columns : of every output, which columns of the design its terms are
    """
    nu = np.asarray(dof, dtype=np.float64)
    error = residuals if sd is None else residuals / sd
    s2 = np.einsum("nm,nm->m", error, error) / np.maximum(nu, 1.0)
    judged = (nu >= 2.0) & (s2 > 0.0)
    left = 1.0 - leverage
    # A position that alone fixes a parameter (leverage 1) has no residual to judge.
    r2 = error**2 / (np.where(judged, s2, 1.0) * np.maximum(left, 1e-9))
    suspect = judged & (left > 1e-9) & (r2 > 4.0)  # below 2 sd no position can be one
    beyond = []
    for column in np.flatnonzero(suspect.any(axis=0)).tolist():
        suspects = np.flatnonzero(suspect[:, column])
        sizes = r2[suspects, column]
        for place in np.argsort(-sizes, kind="stable").tolist():
            if not _is_outlier(float(sizes[place]), float(nu[column]), residuals.size):
                break  # and none that is smaller is beyond chance
            beyond.append((column, int(suspects[place])))
    if beyond and error.shape[1] > 1 and judged.all() and nu.min() >= ROWS_TOLD:
        weighed = [design[:, own] for own in columns]
        if sd is not None:
            weighed = [each / sd[:, [m]] for m, each in enumerate(weighed)]
        beyond = _beyond_unlike_rows(error, leverage, weighed, beyond)
    return tuple(
        f"position {labels[row]}: {outputs[column]} is off by {residuals[row, column]:.3g}, "
        f"{np.sqrt(r2[row, column]):.1f} times its standard deviation"
        for column, row in sorted(beyond)
    )


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
    rest = nu - r2
    t = math.inf if rest <= 0.0 else math.sqrt(r2 * (nu - 1.0) / rest)
    level = OUTLIER_LEVEL / readings
    # the normal law has the shorter tails, and settles most without Student's
    return math.erfc(t / math.sqrt(2.0)) < level and t_tail(t, nu - 1.0) < level


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
    told = np.diag(Q) > 1e-9 * np.diag(inverse)
    r2 = np.where(told, shift**2 / np.where(told, np.diag(Q), 1.0), 0.0) / s2
    found = []
    for place in np.flatnonzero(r2 > 4.0).tolist():
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
            p = chi2_tail(value, m)
        elif robust:
            p = f_tail(value / m, m, dof)
        elif dof > m:
            # without the position itself, as t_k of eq. (1): the rest is what it is judged by
            rest = max(dof - value, 1e-300)
            p = f_tail(value / m / (rest / (dof - m)), m, dof - m)
        else:
            continue
        if p < OUTLIER_LEVEL / (len(q) * parts):
            said = f"position {labels[row]} does not fit: {np.sqrt(value / m):.1f} times the noise"
            found.append((row, said))
        elif alike:
            break
    return tuple(said for _, said in sorted(found))


def linearity(
    model: Model, reference: Array, values: Array, residuals: Array, *, forced: bool = False
) -> dict[str, dict[str, float]]:
    """Return {output: {without_model_percent, with_model_percent}}; NaN where no line fits.

    The span is that of ±1 g, of `forced` readings that of the largest force along the axis.
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
        largest = float(np.abs(own).max()) if forced else 1.0
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
    m, total = rss.size, float(dof.sum())
    if m < 2 or not (dof > 0.0).all() or not rss.any():
        return float("nan")
    if (rss == 0.0).any():
        return 0.0
    variances = rss / dof
    statistic = total * np.log(rss.sum() / total) - (dof * np.log(variances)).sum()
    correction = 1.0 + ((1.0 / dof).sum() - 1.0 / total) / (3.0 * (m - 1))
    return chi2_tail(float(statistic / correction), m - 1)


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
    total = np.bincount(index, weights=weight)
    dof_lack, dof_pure = len(total) - parameters, len(r) - len(total)
    if dof_lack <= 0 or dof_pure <= 0:
        return None
    mean = np.bincount(index, weights=weight * r) / total
    pure = float((weight * (r - mean[index]) ** 2).sum()) / dof_pure
    lack = float((total * mean**2).sum()) / dof_lack
    f = lack / pure if pure > 0.0 else float("inf") if lack > 0.0 else float("nan")
    return f, dof_lack, dof_pure, f_tail(f, dof_lack, dof_pure)
