"""Outliers by studentised residuals.

- `find_outliers` names readings of a fit, `find_correlated_outliers` those of rows that are
  correlated, `find_outlying_positions` whole positions.
- `studentised_squares` gives r²/s² of eq. (1), `square_beyond` and `largest_square` its limits.

With the leverage h_k and residual degrees of freedom ν,

    r_k = e_k / (s sqrt(1 - h_k)),    t_k = r_k sqrt((ν - 1) / (ν - r_k²)),                (1)

t_k follows Student's t with ν − 1 degrees of freedom [1]_; a position is an outlier where it
passes the 1 % point divided by the number of readings (Bonferroni). Where some rows are noisier
than others, all outputs together, that names them too often. So, where there are two outputs and
eight degrees of freedom of each to tell, what passes must also be beyond that point by the p value
of `multipos.sensor.unlike_rows`, whose rows may be alike or not.

References
----------
.. [1] R. D. Cook, S. Weisberg, *Residuals and Influence in Regression*, 1982, section 2.2.1.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np

from multipos.numerics import quantiles
from multipos.numerics.arrays import Array, Places
from multipos.sensor.unlike_rows import p_values

OUTLIER_LEVEL = 0.01  # chance that a clean data set has an outlier named
_SUSPECT = 4.0  # squared studentised residual, below which no position is an outlier
ROWS_NAMED = 8.0  # degrees of freedom of an output, from which on rows tell that they are unlike


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
