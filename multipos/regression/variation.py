"""Which terms a segment supports: those that vary there, and do not cancel each other.

`term_variances` returns the variance of every term over the table, `varying` the columns that vary
enough, and `by_degree` the order in which they are asked. `Contributions` tells whether
coefficients cancel. `variance_inflation` says how far columns follow from each other.

**Variation.** A chamber that heats and cools by 1 °C/min holds rate² constant between its soaks. A
coefficient of it is then found from the noise of the thermometer, takes the place of the constant,
and says at rate 0 what nobody measured. So a term φ is a candidate on the n rows of a segment only
where what it has there beyond the terms K of the model,

    |φ − P_K φ|²/n ≥ 1e-4 v(φ),                                                             (1)

is a share of v(φ), its variance over the whole table, formed of variables about their means there
(so that kelvin or degrees Celsius make no difference); without a constant, its mean square. Where
terms are not chosen one by one, K are the candidates of lower degree, or before it in the list.
Other terms are left out by name; their effect is then part of the constant and of the terms kept.

**Cancelling.** With variables about their means over the rows, Σ b φ = Σ c ψ, ψ products of these.
Terms of degree D that follow a response of range r need no more than

    |c| max|ψ| ≤ 2^(D−1) r,                                                                 (2)

about what Chebyshev's polynomials need, the wildest of that range. Coefficients beyond it cancel
each other where the rows are and nowhere else: a term that makes them so is not taken, whatever
its F.

**Segments that join.** Where they are fitted without a jump, terms of all rows are judged over all
rows, and a coefficient may change at an edge where its term varies, by (1), on both sides.

**Inflation.** With R_j² of column j by the others, u² of its coefficient is 1/(1 − R_j²) times that
of the column alone: the diagonal of the inverse of their correlations.

Source of the inflation: D. W. Marquardt, Technometrics 12, 1970 (ten and more is too much).
"""

from collections.abc import Mapping, Sequence
from math import comb

import numpy as np

from multipos.numerics.arrays import Array
from multipos.numerics.factors import Factor
from multipos.numerics.terms import CONSTANT, Term

LEAST = 1e-4  # share of a term's variance over the table that a segment must have


def term_variances(terms: Sequence[Term], columns: Mapping[str, Array]) -> Array:
    """Return v of eq. (1) of every term, over all rows of a table's columns."""
    used = {f.variable for term in terms for f in term.factors}
    if CONSTANT not in terms:
        return np.array([float(np.mean(term.evaluate(columns) ** 2)) for term in terms])
    about = {name: columns[name] - columns[name].mean() for name in used}
    return np.array([float(np.var(_evaluate(term, about, columns))) for term in terms])


def _evaluate(term: Term, about: Mapping[str, Array], columns: Mapping[str, Array]) -> Array:
    """Return a term of variables about their means, functions of them as they are."""
    plain = Term(tuple(f for f in term.factors if not f.function))
    bent = Term(tuple(f for f in term.factors if f.function))
    return np.asarray(plain.evaluate(about) * bent.evaluate(columns))


def varying(design: Array, variances: Array, order: Sequence[int]) -> list[int]:
    """Return the columns that vary by eq. (1), each beyond those before it in an order.

    Parameters
    ----------
    design : (n, p) array
    variances : (p,) array
        v of every column.
    order : sequence of int
    """
    least = np.sqrt(LEAST * len(design) * variances)
    basis: list[Array] = []
    kept = []
    for j in order:
        left = design[:, j]
        for _ in range(2):  # rounding of the first pass goes with the second
            left = left - sum((q * (q @ left) for q in basis), start=np.zeros(len(left)))
        length = float(np.linalg.norm(left))
        if length > 0.0 and length >= least[j]:
            kept.append(j)
            basis.append(left / length)
    return kept


def variance_inflation(columns: Array) -> Array:
    """Return 1/(1 − R²) (m,) of columns (n, m), about their means, that do not depend linearly."""
    about = columns - columns.mean(axis=0)
    R = np.linalg.qr(about / np.linalg.norm(about, axis=0), mode="r")
    return np.asarray((np.linalg.inv(R) ** 2).sum(axis=1))


def by_degree(terms: Sequence[Term]) -> list[int]:
    """Return the places of terms in the order of their degrees, the constant first."""
    return sorted(range(len(terms)), key=lambda j: _degree(terms[j]))


def _degree(term: Term) -> int:
    return sum(factor.degree for factor in term.factors)


class Contributions:
    """What terms add to the response on some rows, each variable about its mean there."""

    def __init__(self, columns: Mapping[str, Array], span: float) -> None:
        self._columns, self._span = columns, span
        self._means: dict[str, float] = {}
        self._largest: dict[Term, float] = {}

    def cancel(self, terms: Sequence[Term], values: Array) -> bool:
        """Tell whether coefficients are beyond eq. (2)."""
        about: dict[Term, float] = {}
        for term, value in zip(terms, values.tolist(), strict=True):
            for product, weight in self._expanded(term).items():
                about[product] = about.get(product, 0.0) + value * weight
        degree = max((_degree(term) for term in terms), default=0)
        limit = 2.0 ** max(degree - 1, 0) * self._span
        return any(
            abs(value) * self._size(product) > limit
            for product, value in about.items()
            if product != CONSTANT
        )

    def _mean(self, name: str) -> float:
        if name not in self._means:
            self._means[name] = float(self._columns[name].mean())
        return self._means[name]

    def _expanded(self, term: Term) -> dict[Term, float]:
        """Return a term as products of variables about their means, with their weights."""
        found = {CONSTANT: 1.0}
        for f in term.factors:
            parts = {f: 1.0}
            if not f.function:
                mean = self._mean(f.variable)
                parts = {
                    Factor(f.variable, k): comb(f.power, k) * mean ** (f.power - k)
                    for k in range(f.power + 1)
                }
            found = {
                Term((*product.factors, part)) if part.is_variable else product: weight * share
                for product, weight in found.items()
                for part, share in parts.items()
            }
        return found

    def _size(self, product: Term) -> float:
        """Return the largest a product of variables about their means is on the rows."""
        if product not in self._largest:
            used = {f.variable for f in product.factors}
            about = {name: self._columns[name] - self._mean(name) for name in used}
            size = np.abs(_evaluate(product, about, self._columns)).max()
            self._largest[product] = float(size)
        return self._largest[product]
