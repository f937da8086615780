"""Linear least squares: every linear problem of the package, positions and temperature alike.

The n rows of a design X (n, p) explain a response y (n,) through p coefficients b,

    y = X b + r,    cov r = V,    b minimises r' V⁻¹ r.                                     (1)

V is the unit matrix, the variances of the rows, or a full covariance; V = L L'. The rows are
whitened and factored, L⁻¹ X = Q R, by Householder QR, which never squares the condition of X:

    b = R⁻¹ Q' L⁻¹ y,    C = (X' V⁻¹ X)⁻¹ = R⁻¹ R⁻ᵀ,    leverage h = diag Q Q'.             (2)

C, the cofactor, is the covariance of b where V is the covariance of the rows, and C s² with
s² = rss/(n − p) is where V is known up to a factor. A residual sum is a sum of squared residuals,
never a difference of sums.

**Rank.** Columns may be in any unit, so R is judged with its columns scaled to unit length:
singular values below `_RANK` of the largest count as zero. Columns dependent but for rounding leave
1e-16 to 1e-15; the hardest problem known to be worth solving (NIST's Filip) leaves 2e-10. `_RANK` =
1e-13 lies between, with two and three decades to either side. Scaling alone would promote a column
that is nothing but rounding, cos 90° = 6e-17, to a full member: a column whose Euclidean norm does
not exceed `floor` is zero. References in g have a floor of 1e-9; columns of a regression have units
of their own and no floor. What cannot be separated is named.

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

**Size.** Many rows are factored in small blocks and the triangles again (Demmel): as stable as one
Householder QR, several times faster, and Q is the only array as large as X that is made.

Sources: Å. Björck, Numerical Methods for Least Squares Problems, SIAM 1996 (augmented system and
its iterative refinement). J. Demmel, L. Grigori, M. Hoemmen, J. Langou, SIAM J. Sci. Comput. 34,
2012 (QR by blocks of rows). The NIST StRD linear sets, which judge the result in the tests.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import MultiposError, RankError
from multipos.numerics import extended
from multipos.numerics.arrays import Array
from multipos.numerics.combinations import name_combinations

_RANK = 1e-13  # singular values of the scaled design below this part of the largest are zero
_REFINE_COFACTOR = 1e6  # condition from which the cofactor takes twice the working precision
_STEPS = 8  # of refinement at most; Filip takes three
_BLOCK = 8192  # numbers factored at once: in cache, and below the size that BLAS starts threads for


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


@dataclass(frozen=True, slots=True)
class Separability:
    """What the rows of a design can tell apart.

    Attributes
    ----------
    rank, parameters : int
    condition : float
        As in `LinearFit`; infinite where the rank is short.
    null : (p, p − rank) array
        Combinations of coefficients that no row sees: adding a multiple of a column to the
        coefficients changes nothing. In units of the coefficients, in reduced echelon form.
    """

    rank: int
    parameters: int
    condition: float
    null: Array


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
    V = _Covariance(covariance, n)
    Q, R = _qr(V, X)
    norms = _norms(R)
    singular = _singular_values(R)
    judged = singular if V.full is None else _singular_values(X)  # see `separability`
    if judged[-1] <= _RANK * judged[0] or (floor > 0.0 and _norms(X).min() <= floor):
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


class _Covariance:
    """V of eq. (1), as unit matrix, variances or full; what whitens with it and colours again."""

    def __init__(self, covariance: ArrayLike | None, n: int) -> None:
        self.sd: Array | None = None
        self.full: Array | None = None
        if covariance is None:
            return
        V = np.asarray(covariance, dtype=np.float64)
        if V.shape == (n,):
            if not (np.isfinite(V).all() and (V > 0.0).all()):
                raise MultiposError("`covariance` must be positive and finite in every row.")
            self.variances = V
            self.sd = np.sqrt(V)
        elif V.shape == (n, n):
            # ten digits: a covariance computed as J S J' is symmetric to rounding, not exactly
            if not np.abs(V - V.T).max() <= 1e-10 * np.abs(V).max():
                raise MultiposError("`covariance` must be symmetric and finite.")
            try:
                self.L = np.linalg.cholesky(V)
            except np.linalg.LinAlgError:
                raise MultiposError("`covariance` must be positive definite.") from None
            self.inverse = np.linalg.inv(self.L)
            self.full = (V + V.T) / 2.0
        else:
            raise MultiposError(
                f"`covariance` must have shape ({n},) or ({n}, {n}), got {V.shape}; "
                "give one variance per row, or the covariance of the rows."
            )

    def whitened(self, a: Array, rows: slice = slice(None)) -> Array:
        """L⁻¹ a, where `a` holds the given rows."""
        if self.full is not None:
            return np.asarray(self.inverse[rows] @ a)
        return a if self.sd is None else a / self.sd[rows, np.newaxis]

    def multiplier(self, s: Array) -> Array:
        """λ = L⁻ᵀ s, from whitened residuals s."""
        if self.full is not None:
            return np.asarray(self.inverse.T @ s)
        return self.whitened(s)

    def coloured(self, s: Array) -> Array:
        """Residuals r = L s = V λ."""
        if self.full is not None:
            return np.asarray(self.L @ s)
        return s if self.sd is None else s * self.sd[:, np.newaxis]

    def residual(self, y: Array, X: Array, b: Array, multiplier: Array) -> Array:
        """`y − V λ − X b` in twice the working precision."""
        if self.full is not None:
            both = np.hstack((self.full, X))
            zero = np.zeros_like(y)
            return extended.residual(y, both, np.vstack((multiplier, b)), zero)
        return extended.residual(y, X, b, multiplier, None if self.sd is None else self.variances)


def _qr(V: _Covariance, X: Array) -> tuple[Array, Array]:
    """Q (n, p) and R (p, p) of the whitened design.

    Columns are not scaled beforehand: Householder QR commutes with that, and R is cheaper to scale.
    """
    n, p = X.shape
    limit = max(2 * p, _BLOCK // p)
    if V.full is not None or n <= limit:
        Q, R = np.linalg.qr(V.whitened(X))
        return Q, R
    edges = np.linspace(0, n, -(-n // limit) + 1).astype(int)
    blocks = [slice(i, j) for i, j in pairwise(edges)]
    Q = np.empty((n, p))
    triangles = np.empty((len(blocks), p, p))
    for i, block in enumerate(blocks):
        Q[block], triangles[i] = np.linalg.qr(V.whitened(X[block], block))
    top, R = _qr(_Covariance(None, 0), triangles.reshape(-1, p))
    for block, turn in zip(blocks, top.reshape(-1, p, p), strict=True):
        Q[block] = Q[block] @ turn
    return Q, R


def _refined(
    X: Array, y: Array, V: _Covariance, Q: Array, T: Array, norms: Array
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


def _cofactor(X: Array, V: _Covariance, T: Array, condition: float) -> Array:
    """(X' V⁻¹ X)⁻¹ from T = R⁻¹, to full precision where R⁻¹ has lost too much of it."""
    if condition <= _REFINE_COFACTOR:
        return np.asarray(T @ T.T)
    n, p = X.shape
    information = np.zeros((p, p))
    step = n if V.full is not None else _BLOCK
    for i in range(0, n, step):
        rows = slice(i, i + step)
        Z = V.whitened(extended.product(X[rows], T), rows)
        information += Z.T @ Z
    half = np.linalg.inv(np.linalg.cholesky(information)) @ T.T
    return np.asarray(half.T @ half)


def _norms(X: Array) -> Array:
    return np.asarray(np.sqrt(np.einsum("ij,ij->j", X, X)))


def _scales(R: Array) -> Array:
    norms = _norms(R)
    norms[norms == 0.0] = 1.0
    return norms


def _singular_values(R: Array) -> Array:
    return np.asarray(np.linalg.svd(R / _scales(R), compute_uv=False))


def _checked(design: ArrayLike, response: ArrayLike) -> tuple[Array, Array]:
    X = _matrix(design)
    y = np.asarray(response, dtype=np.float64)
    if y.ndim not in (1, 2) or len(y) != len(X):
        raise MultiposError(
            f"`response` must have one row per row of `design`: {len(X)}, got {y.shape}."
        )
    if not np.isfinite(y).all():
        raise MultiposError("`response` has a number that is not finite.")
    return X, y


def _matrix(design: ArrayLike) -> Array:
    X = np.asarray(design, dtype=np.float64)
    if X.ndim != 2 or X.shape[1] == 0:
        raise MultiposError(f"`design` must have shape (n, p) with p > 0, got {X.shape}.")
    if not np.isfinite(X).all():
        raise MultiposError("`design` has a number that is not finite.")
    return X


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


def separability(
    design: ArrayLike, *, floor: float = 0.0, covariance: ArrayLike | None = None
) -> Separability:
    """What the rows of a design can tell apart, whatever the response.

    Parameters
    ----------
    design : (n, p) array
        May have fewer rows than columns; the rank is then n at most.
    floor, covariance
        As in `solve`. The covariance bears on the condition; what rows of finite variance can
        tell apart does not depend on it.

    Returns
    -------
    Separability
    """
    X = _matrix(design)
    n, p = X.shape
    V = _Covariance(covariance, n)
    dead = _norms(X) <= floor
    if dead.any():
        X = np.where(dead, 0.0, X)
    R = _qr(V, X)[1] if n >= p else V.whitened(X)
    # Whitening by a full covariance rounds enough to hide a dependence; by variances it does not.
    judged = R if V.full is None else X
    scales = _scales(judged)
    _, singular, Vt = np.linalg.svd(judged / scales, full_matrices=n < p)
    rank = int((singular > _RANK * singular[0]).sum())
    null = _echelon(Vt[rank:]).T / scales[:, np.newaxis]
    for v in null.T:
        v /= v[np.flatnonzero(v)[-1]]
    whole = np.rint(null)
    condition = np.inf
    if rank == p:
        values = singular if V.full is None else _singular_values(R)
        condition = float(values[0] / values[-1])
    return Separability(
        rank=rank,
        parameters=p,
        condition=condition,
        null=np.where(np.abs(null - whole) <= 1e-10 * np.abs(null), whole, null),
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


def _echelon(N: Array) -> Array:
    """Reduced row echelon form of orthonormal rows (m, p), pivots from the right.

    From the right, so that later terms are explained by earlier ones. Columns are scaled, so
    entries compare; rows are good to 1e-13 or better, and 1e-8 is no part of a combination.
    """
    N = N.copy()
    row = len(N)  # rows from here on have their pivot
    for column in reversed(range(N.shape[1])):
        pivot = int(np.abs(N[:row, column]).argmax()) if row else 0
        if row == 0 or abs(N[pivot, column]) <= 1e-8:
            continue
        row -= 1
        N[[row, pivot]] = N[[pivot, row]]
        N[row] /= N[row, column]
        others = np.arange(len(N)) != row
        N[others] -= np.outer(N[others, column], N[row])
    N[np.abs(N) <= 1e-8 * np.abs(N).max(axis=1, keepdims=True, initial=0.0)] = 0.0
    return N
