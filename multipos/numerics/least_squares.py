"""Linear least squares: every linear problem of the package, positions and temperature alike.

`solve` fits a response by a design, `factor_alike` factors several designs of one size to be solved
for many responses, and `block_design` joins the designs of several outputs.

The n rows of a design X (n, p) explain a response y (n,) through p coefficients b,

    y = X b + r,    cov r = V,    b minimises r' V⁻¹ r.                                     (1)

V = L L' is the unit matrix, the variances of the rows, or a full covariance. The rows are whitened
and factored, L⁻¹ X = Q R (`multipos.numerics.factoring`):

    b = R⁻¹ Q' L⁻¹ y,    C = (X' V⁻¹ X)⁻¹ = R⁻¹ R⁻ᵀ,    leverage h = diag Q Q'.             (2)

C, the cofactor, is the covariance of b where V is the covariance of the rows, and C s² with
s² = rss/(n − p) is where V is known up to a factor. A residual sum is a sum of squared residuals,
never a difference of sums. What the rows cannot separate is named, and not solved
(`multipos.numerics.separability`).

**Refinement.** QR loses κε of the coefficients (κ the condition of the scaled design, ε = 1.1e-16):
half of all digits on a tenth-degree polynomial, how many depends on the order of the rows.
So the augmented system

    V λ + X b = y,    X' λ = 0,    r = V λ                                                  (3)

is solved by iteration: residuals f = y − V λ − X b and g = −X' λ in twice the working precision
(`multipos.numerics.exact_sums`), corrections from the same Q and R. Each step multiplies the error
by about κε, until b is the exact answer for X, y and V as given, correctly rounded or nearly so, in
any order of the rows. One step does it below κ of some 1e6. (3) is stated in the rows as given
because whitening rounds.

**Cofactor.** R⁻¹ R⁻ᵀ loses κε as well, which no quoted uncertainty shows below κ = 1e6 (nine digits
left). Above, with T ≈ R⁻¹ and Z = L⁻¹ X T formed in twice the working precision, C = T (Z' Z)⁻¹ T'
holds for any T, and Z' Z is so near the unit matrix that plain double forms and inverts it safely.

Sources: Å. Björck, Numerical Methods for Least Squares Problems, SIAM 1996 (augmented system and
its iterative refinement). The NIST StRD linear sets, which judge the result in the tests.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import MultiposError, RankError
from multipos.numerics import exact_sums
from multipos.numerics.arrays import Array
from multipos.numerics.factoring import (
    BLOCK,
    RANK,
    Covariance,
    column_norms,
    design_matrix,
    factor,
    singular_values,
)
from multipos.numerics.separability import join_combinations, name_combinations, separability

_REFINE_COFACTOR = 1e6  # condition from which the cofactor takes twice the working precision
_STEPS = 7  # of refinement at most; Filip takes two


class DependentColumnsError(RankError):
    """The columns of one of the problems that are solved together depend on each other.

    Attributes
    ----------
    problem : int
        Which of them it is, from 0.
    """

    def __init__(self, message: str, *, problem: int, **found: Any) -> None:
        super().__init__(message, **found)
        self.problem = problem


@dataclass(frozen=True, eq=False, slots=True)
class LinearFit:
    """Least-squares estimate with what its uncertainty needs.

    Attributes
    ----------
    coefficients : (p,) or (p, k) array
        One column per response; responses share design and covariance.
    cofactor : (p, p) array
        Covariance of a column of `coefficients` for unit variance of the whitened rows, eq. (2).
    residuals : (n,) or (n, k) array
        Response minus model, in units of the response (not whitened).
    rss : float or (k,) array
        Sum of squared whitened residuals.
    dof : int
        n − p.
    leverage : (n,) array
        Share of each whitened row in its own fit, 0 … 1; they sum to p.
    condition : float
        2-norm condition of the whitened design with columns scaled to unit length.
    """

    coefficients: Array
    cofactor: Array
    residuals: Array
    rss: float | Array
    dof: int
    leverage: Array
    condition: float


def solve(
    design: ArrayLike,
    response: ArrayLike,
    *,
    covariance: ArrayLike | None = None,
    least_norm: float = 0.0,
    names: Sequence[str] | None = None,
    rows: str = "positions",
) -> LinearFit:
    """Fit `response = design @ coefficients` by weighted least squares, eqs. (1)–(3).

    Parameters
    ----------
    design : (n, p) array
    response : (n,) or (n, k) array
        k responses may share the design and the covariance.
    covariance : (n,) or (n, n) array, optional
        Variances of the rows or their full covariance; unit variances if not given.
    least_norm : float
        A column whose Euclidean norm does not exceed this counts as zero.
    names : sequence of p str, optional
        Names of the coefficients, for messages.
    rows : str
        What rows are called in messages.

    Returns
    -------
    LinearFit

    Raises
    ------
    RankError
        The rows cannot separate the coefficients; the message names the combinations.
    MultiposError
        A number is not finite, a shape does not fit, or the covariance is not positive definite.
    """
    X, y = _checked(design, response)
    V = Covariance(covariance, len(X))
    found = _factored(X[np.newaxis], V, least_norm, [names], rows)
    b, s = _refined(
        found.design, y.reshape(1, len(X), -1), V, found.Q, found.inverse, column_norms(found.R)
    )
    rss = np.einsum("nk,nk->k", s[0], s[0])
    one = (0, ..., 0) if y.ndim == 1 else 0
    return LinearFit(
        coefficients=b[one],
        cofactor=found.cofactors[0],
        residuals=V.coloured(s)[one],
        rss=rss if y.ndim == 2 else float(rss[0]),
        dof=len(X) - X.shape[1],
        leverage=found.leverage[0],
        condition=found.conditions[0],
    )


@dataclass(frozen=True, eq=False, slots=True)
class Factored:
    """A stack of designs (G, n, p), whitened and factored, L⁻¹ X = Q R.

    Attributes
    ----------
    design, Q : (G, n, p) arrays
    R, inverse : (G, p, p) arrays
        R and R⁻¹.
    cofactors : (G, p, p) array
        C of eq. (2).
    conditions : G floats
        2-norm conditions of the whitened designs with columns scaled to unit length.
    """

    design: Array
    Q: Array
    R: Array
    inverse: Array
    cofactors: Array
    conditions: list[float]

    @property
    def leverage(self) -> Array:
        """The diagonals of Q Q' (G, n)."""
        return np.asarray(np.einsum("gij,gij->gi", self.Q, self.Q))


def factor_alike(
    designs: Array, *, least_norm: float = 0.0, names: Sequence[Sequence[str] | None]
) -> Factored:
    """Factor several designs of one size (G, n, p), as `solve` does each, in less time.

    Parameters
    ----------
    designs : (G, n, p) array
    least_norm : float
        As in `solve`.
    names : G sequences of p str
        Names of the coefficients of each problem, for messages.

    Raises
    ------
    MultiposError
        As in `solve`; of columns that depend on each other it is a `DependentColumnsError`.
    """
    design_matrix(designs[0])  # refuses one without columns
    _require_finite(designs, "design")
    return _factored(designs, Covariance(None, 0), least_norm, names, "positions")


def _factored(
    X: Array, V: Covariance, least_norm: float, names: Sequence[Sequence[str] | None], rows: str
) -> Factored:
    """Factor a stack of designs (G, n, p), and refuse dependent columns."""
    n, p = X.shape[1:]
    if n < p:
        raise DependentColumnsError(
            f"{n} readings cannot determine {p} terms; give at least {p}, or drop terms.",
            rank=n,
            parameters=p,
            problem=0,  # all have as many
        )
    Q, R = factor(V, X)
    singular = singular_values(R)
    judged = singular if V.full is None else singular_values(X)  # see `separability`
    dependent = judged[:, -1] <= RANK * judged[:, 0]
    if least_norm > 0.0:
        dependent |= column_norms(X).min(axis=1) <= least_norm
    if dependent.any():
        first = int(np.argmax(dependent))
        _refuse(X[first], V, least_norm, names[first], rows, first)
    conditions = (singular[:, 0] / singular[:, -1]).tolist()
    T: Array = np.asarray(np.linalg.inv(R), dtype=np.float64)  # triangular: back substitution
    cofactors = T @ T.transpose(0, 2, 1)
    for i, condition in enumerate(conditions):
        if condition > _REFINE_COFACTOR:
            cofactors[i] = _precise_cofactor(X[i], V, T[i])
    return Factored(X, Q, R, T, cofactors, conditions)


def _refined(
    X: Array, y: Array, V: Covariance, Q: Array, T: Array, norms: Array
) -> tuple[Array, Array]:
    """Coefficients (G, p, k) and whitened residuals (G, n, k) by iterating on eq. (3).

    The first one is the plain QR solution. A correction solves (3) with f and g on the right, in
    factors of the whitened design: u = Q' L⁻¹ f − R⁻ᵀ g, δb = R⁻¹ u, δs = L⁻¹ f − Q u.
    """
    Q_turned, T_turned = Q.transpose(0, 2, 1), T.transpose(0, 2, 1)
    white = V.whitened(y)
    u = Q_turned @ white
    b, s = T @ u, white - Q @ u
    multiplier = V.multiplier(s)
    last = np.ones((len(X), 1, 1))
    for _ in range(_STEPS):
        white = V.whitened(V.residual(y, X, b, multiplier))
        u = Q_turned @ white - T_turned @ exact_sums.cross_residual(X, multiplier)
        db = T @ u
        size = _relative(db, b, norms)
        better = size < 0.5 * last
        if not better.any():  # rounding is all that is left
            break
        ds = white - Q @ u
        if not better.all():
            db, ds = np.where(better, db, 0.0), np.where(better, ds, 0.0)
        b = b + db
        s = s + ds
        # Corrections shrink in a fixed ratio: the next would be size²/last. Negligible is a
        # thousandth of an ulp of the largest coefficient, so that small ones get their digits too.
        if not (better & (size * size > 1e-19 * last)).any():
            break
        multiplier = multiplier + V.multiplier(ds)
        last = np.where(better, size, last)
    return b, s


def _relative(db: Array, b: Array, norms: Array) -> Array:
    """Largest correction over largest coefficient of its response (G, 1, 1), of scaled columns."""
    scale = norms[:, :, np.newaxis]
    correction = (np.abs(db) * scale).max(axis=1, keepdims=True)
    size = (np.abs(b) * scale).max(axis=1, keepdims=True)
    relative = correction / np.where(size > 0.0, size, 1.0)
    return np.asarray(relative.max(axis=2, keepdims=True))


def _precise_cofactor(X: Array, V: Covariance, T: Array) -> Array:
    """(X' V⁻¹ X)⁻¹ to full precision where T = R⁻¹ has lost too much of it."""
    n, p = X.shape
    information = np.zeros((p, p))
    step = n if V.full is not None else BLOCK
    for i in range(0, n, step):
        rows = slice(i, i + step)
        Z = V.whitened(exact_sums.product(X[rows], T), rows)
        information += Z.T @ Z
    half = np.linalg.inv(np.linalg.cholesky(information)) @ T.T
    return np.asarray(half.T @ half)


def _checked(design: ArrayLike, response: ArrayLike) -> tuple[Array, Array]:
    X = design_matrix(design)
    y = np.asarray(response, dtype=np.float64)
    if y.ndim not in (1, 2) or len(y) != len(X):
        raise MultiposError(
            f"`response` must have one row per row of `design`: {len(X)}, got {y.shape}."
        )
    _require_finite(X, "design")
    _require_finite(y, "response")
    return X, y


def _require_finite(numbers: Array, name: str) -> None:
    if not np.isfinite(numbers).all():
        raise MultiposError(f"`{name}` has a number that is not finite.")


def _refuse(
    X: Array,
    V: Covariance,
    least_norm: float,
    names: Sequence[str] | None,
    rows: str,
    problem: int,
) -> None:
    found = separability(
        X, least_norm=least_norm, covariance=V.variances if V.full is None else V.full
    )
    if names is None:
        names = [f"column {j + 1}" for j in range(found.parameters)]
    combinations = name_combinations(found.null, names, rows=rows)
    raise DependentColumnsError(
        f"{found.rank} of {found.parameters} parameters can be separated: "
        f"{join_combinations(combinations)}. Add {rows} that separate them, or drop a term.",
        rank=found.rank,
        parameters=found.parameters,
        combinations=combinations,
        problem=problem,
    )


def block_design(designs: Sequence[Array]) -> Array:
    """Return the design (n, M, p) of M outputs together, of which output i has (n, p_i) of its own.

    Reshaped to (n M, p) it is that of the readings row by row, output running fastest.
    """
    ends = np.cumsum([0, *(design.shape[1] for design in designs)])
    result = np.zeros((len(designs[0]), len(designs), ends[-1]))
    for i, design in enumerate(designs):
        result[:, i, ends[i] : ends[i + 1]] = design
    return result
