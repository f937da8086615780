"""What the residuals say of a fit: outliers, linearity, lack of fit, equal variances.

Studentised residuals: with the leverage h_k and residual degrees of freedom ν,

    r_k = e_k / (s sqrt(1 - h_k)),    t_k = r_k sqrt((ν - 1) / (ν - r_k²)),                (1)

t_k follows Student's t with ν − 1 degrees of freedom [1]_; a position is an outlier where it
passes the 1 % point divided by the number of readings (Bonferroni). Where some rows are noisier
than others, all outputs together, that names them too often. So, where there are two outputs and
eight degrees of freedom of each to tell, what passes must also be beyond that point by the p value
of `multipos.sensor.unlike_rows`, whose rows may be alike or not.

Linearity of an output against its own reference: with the least-squares line through the
readings and its span S from −1 to +1 g (where forces are known, to the largest), the largest
|reading − line| and the largest |residual of the model|, both over S, in percent.

References
----------
.. [1] R. D. Cook, S. Weisberg, *Residuals and Influence in Regression*, 1982, section 2.2.1.
"""

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from multipos.doubt import Doubt, besides
from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import chi2_tail, f_tail, t_tail
from multipos.numerics.terms import COMPONENTS
from multipos.results import Result
from multipos.sensor.model import Model
from multipos.sensor.term_tests import ModelTest
from multipos.sensor.unlike_rows import p_values

UNEQUAL = 0.05  # level at which outputs are called unequally noisy
OUTLIER_LEVEL = 0.01  # chance that a clean data set has an outlier named
_ROWS_TOLD = 8.0  # degrees of freedom of an output, from which on rows tell that they are unlike


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
    outliers, unidentifiable, warnings : tuples of str
        The texts of the doubts are the first warnings.
    doubts : tuple of Doubt
        What does not look right, the worst first.
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
    warnings: tuple[str, ...] = ()
    doubts: tuple[Doubt, ...] = ()
    model_tests: tuple[ModelTest, ...] = ()
    hidden: tuple[str, ...] = ()
    claim: Claim | None = None

    @property
    def said(self) -> tuple[str, ...]:
        """Warnings and outliers beside the texts of the doubts."""
        known = any(doubt.code == "outlier" for doubt in self.doubts)
        return besides((*self.warnings, *(() if known else self.outliers)), self.doubts)


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
    if beyond and error.shape[1] > 1 and judged.all() and nu.min() >= _ROWS_TOLD:
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
