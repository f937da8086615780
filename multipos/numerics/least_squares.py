"""Linear least squares: every linear problem of the package, positions and temperature alike.

The n rows of a design X (n, p) explain a response y (n,) through p coefficients b,

    y = X b + r,    cov r = V,    b minimises r' V⁻¹ r.                                     (1)

V = L L' is the unit matrix, the variances of the rows, or a full covariance. The rows are whitened
and factored, L⁻¹ X = Q R (`multipos.numerics.factoring`):

    b = R⁻¹ Q' L⁻¹ y,    C = (X' V⁻¹ X)⁻¹ = R⁻¹ R⁻ᵀ,    leverage h = diag Q Q'.             (2)

C, the cofactor, is the covariance of b where V is the covariance of the rows, and C s² with
s² = rss/(n − p) is where V is known up to a factor. A residual sum is a sum of squared residuals,
never a difference of sums. What the rows cannot tell apart is named, and not solved
(`multipos.numerics.separability`).

**Refinement.** QR loses κε of the coefficients (κ the condition of the scaled design, ε = 1.1e-16):
half of all digits on a tenth-degree polynomial, how many depends on the order of the rows.
So the augmented system

    V λ + X b = y,    X' λ = 0,    r = V λ                                                  (3)

is solved by iteration: residuals f = y − V λ − X b and g = −X' λ in twice the working precision
(`extended`), corrections from the same Q and R. Each step multiplies the error by about κε, until b
is the exact answer for X, y and V as given, correctly rounded or nearly so, in any order
of the rows. One step does it below κ of some 1e6. (3) is stated in the rows as given because
whitening rounds.

**Cofactor.** R⁻¹ R⁻ᵀ loses κε as well, which no quoted uncertainty shows below κ = 1e6 (nine digits
left). Above, with T ≈ R⁻¹ and Z = L⁻¹ X T formed in twice the working precision, C = T (Z' Z)⁻¹ T'
holds for any T, and Z' Z is so near the unit matrix that plain double forms and inverts it safely.

Sources: Å. Björck, Numerical Methods for Least Squares Problems, SIAM 1996 (augmented system and
its iterative refinement). The NIST StRD linear sets, which judge the result in the tests.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import MultiposError, RankError
from multipos.numerics import extended
from multipos.numerics.arrays import Array
from multipos.numerics.combinations import name_combinations
from multipos.numerics.factoring import (
    BLOCK,
    RANK,
    Covariance,
    column_norms,
    design_matrix,
    factor,
    singular_values,
)
from multipos.numerics.separability import Separability, separability

_REFINE_COFACTOR = 1e6  # condition from which the cofactor takes twice the working precision
_STEPS = 8  # of refinement at most; Filip takes three


@dataclass(frozen=True, slots=True)
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
    floor: float = 0.0,
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
    floor : float
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
    n, p = X.shape
    if n < p:
        raise RankError(
            f"{n} readings cannot determine {p} terms; give at least {p}, or drop terms.",
            rank=n,
            parameters=p,
        )
    V = Covariance(covariance, n)
    Q, R = factor(V, X)
    norms = column_norms(R)
    singular = singular_values(R)
    judged = singular if V.full is None else singular_values(X)  # see `separability`
    if judged[-1] <= RANK * judged[0] or (floor > 0.0 and column_norms(X).min() <= floor):
        _refuse(separability(X, floor=floor, covariance=covariance), names, rows)
    condition = float(singular[0] / singular[-1])

    T: Array = np.asarray(np.linalg.inv(R), dtype=np.float64)  # triangular: back substitution
    b, s = _refined(X, y.reshape(n, -1), V, Q, T, norms)
    residuals = V.coloured(s)
    rss = np.einsum("nk,nk->k", s, s)
    single = y.ndim == 1
    return LinearFit(
        coefficients=b[:, 0] if single else b,
        cofactor=_cofactor(X, V, T, condition),
        residuals=residuals[:, 0] if single else residuals,
        rss=float(rss[0]) if single else rss,
        dof=n - p,
        leverage=np.einsum("ij,ij->i", Q, Q),
        condition=condition,
    )


def _refined(
    X: Array, y: Array, V: Covariance, Q: Array, T: Array, norms: Array
) -> tuple[Array, Array]:
    """Coefficients (p, k) and whitened residuals (n, k) by iterating on eq. (3).

    A correction solves (3) with f and g on the right, in factors of the whitened design:
    u = Q' L⁻¹ f − R⁻ᵀ g, δb = R⁻¹ u, δs = L⁻¹ f − Q u. The first one starts from nothing, with
    f = y and g = 0, and is the plain QR solution.
    """
    b = np.zeros((X.shape[1], y.shape[1]))
    s = multiplier = np.zeros_like(y)
    f, g = y, np.zeros_like(b)
    last = np.inf
    for step in range(_STEPS):
        white = V.whitened(f)
        u = Q.T @ white - T.T @ g
        db = T @ u
        size = 1.0 if step == 0 else _relative(db, b, norms)
        if not size < 0.5 * last:  # rounding is all that is left
            break
        ds = white - Q @ u
        b = b + db
        s = s + ds
        multiplier = multiplier + V.multiplier(ds)
        # Corrections shrink in a fixed ratio: the next would be size²/last. Negligible is a
        # thousandth of an ulp of the largest coefficient, so that small ones get their digits too.
        if step > 0 and size * size <= 1e-19 * last:
            break
        last = size
        f = V.residual(y, X, b, multiplier)
        g = extended.cross_residual(X, multiplier)
    return b, s


def _relative(db: Array, b: Array, norms: Array) -> float:
    """Largest correction over largest coefficient of its response, for scaled columns."""
    scale = norms[:, np.newaxis]
    correction = (np.abs(db) * scale).max(axis=0)
    size = (np.abs(b) * scale).max(axis=0)
    return float((correction / np.where(size > 0.0, size, 1.0)).max())


def _cofactor(X: Array, V: Covariance, T: Array, condition: float) -> Array:
    """(X' V⁻¹ X)⁻¹ from T = R⁻¹, to full precision where R⁻¹ has lost too much of it."""
    if condition <= _REFINE_COFACTOR:
        return np.asarray(T @ T.T)
    n, p = X.shape
    information = np.zeros((p, p))
    step = n if V.full is not None else BLOCK
    for i in range(0, n, step):
        rows = slice(i, i + step)
        Z = V.whitened(extended.product(X[rows], T), rows)
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
    if not np.isfinite(y).all():
        raise MultiposError("`response` has a number that is not finite.")
    return X, y


def _refuse(found: Separability, names: Sequence[str] | None, rows: str) -> None:
    if names is None:
        names = [f"column {j + 1}" for j in range(found.parameters)]
    combinations = name_combinations(found.null, names, rows=rows)
    raise RankError(
        f"{found.rank} of {found.parameters} parameters can be separated: "
        f"{'; '.join(combinations)}. Add {rows} that tell them apart, or drop a term.",
        rank=found.rank,
        parameters=found.parameters,
        combinations=combinations,
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
