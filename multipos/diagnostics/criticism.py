"""Is the model right, and which positions decide it? Criticism of a fit at known orientations.

`judge_terms` tests terms of higher order in and out, `aicc` is Akaike's criterion, `find_influence`
what each position does to the fit, and `fourier_residuals` the harmonics of residuals along each
roll. `residual_sum` is what other terms would leave, `force_components` what a term uses.

With residuals e, leverage h, s² = e'e/ν of n readings and p terms of one output:

- a term or several: F = ((rss₀ − rss₁)/q) / (rss₁/ν₁) of the smaller model in the larger one, q
  terms apart, on q and ν₁ degrees of freedom. Terms of the model are tested out, terms that the
  positions could tell and the model lacks are tested in;
- Akaike's criterion for few data, AICc = n ln(rss/n) + 2k + 2k(k + 1)/(n − k − 1), k = p + 1,
  lower is better;
- influence of a position:

      r = e / (s sqrt(1 − h)),                                                              (1)
      Cook's D = r² h / (p (1 − h)),   leave-one-out error = e/(1 − h),                      (2)

  the last what the position reads less what all others predict for it;
- the Fourier view of residuals along a roll: amplitude of each order of the angle, where an error
  of the dividing head (orders 1, 2), a misplaced shaft or a missing term (order 2, 3) shows itself.

References
----------
R. D. Cook, S. Weisberg, *Residuals and Influence in Regression*, 1982, chapters 2 and 3.
N. Sugiura, Communications in Statistics A7, 1978 (AICc).
"""

import math
from typing import Any

import numpy as np

from multipos.errors import MultiposError, RankError
from multipos.estimation.known import ZERO_NORM
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.numerics.least_squares import solve
from multipos.numerics.quantiles import f_tail
from multipos.numerics.selection import akaike_criterion
from multipos.numerics.terms import Term
from multipos.results import Result, frozen
from multipos.sensor.calibration import Calibration
from multipos.sensor.model import build_model

_CANDIDATES = "1 + x + y + z + own^2 + own^3 + own*other"  # what a reader asks of: K2, K3, Kip
_ORDERS = 4
_FEWEST = 8  # positions of a roll that make a Fourier view


@frozen
class TermTest(Result):
    """An F-test of one term; `inside` tells whether the model has it.

    `aicc` is the criterion of the model without it (inside) or with it (outside); NaN where
    there are too few readings for it.
    """

    output: str
    term: str
    inside: bool
    f: float
    dof: tuple[float, float]
    p: float
    aicc: float


@frozen
class Influence(Result):
    """What each position does to the fit; all (n, M).

    Attributes
    ----------
    studentised : array
        r of eq. (1); NaN where the leverage is one or degrees of freedom are missing.
    cook, left_out : arrays
        Of eq. (2); `left_out` in reading units.
    """

    studentised: Array
    cook: Array
    left_out: Array


def judge_terms(calibration: Calibration) -> list[TermTest]:
    """Test every second- and higher-order term of the model out, and those it lacks in.

    Raises
    ------
    MultiposError
        The orientations were not known exactly.
    """
    c = calibration
    _require_known(c)
    if not c.model.has_terms:
        return []  # its parameters are no terms, and what it lacks is no term of it
    result = []
    for column, (output, axis) in enumerate(zip(c.outputs, c.model.axes, strict=True)):
        terms = c.model.terms[column]
        n, p = len(c.readings), len(terms)
        if n <= p:
            continue
        own = residual_sum(c, column, terms)
        wider = build_model(_CANDIDATES, (output,), (axis,)).terms[0]
        for term in dict.fromkeys((*terms, *wider)):
            if term.force_degree < 2:
                continue
            inside = term in terms
            changed = tuple(t for t in terms if t != term) if inside else (*terms, term)
            if n - len(changed) < 1 or not set(force_components(term)) <= set(c.model.inputs):
                continue
            try:
                other = residual_sum(c, column, changed)
            except RankError:
                continue  # the positions cannot tell it
            small, large = (other, own) if inside else (own, other)
            dof = n - max(p, len(changed))
            f = max(small - large, 0.0) / (large / dof) if large > 0.0 else math.inf
            result.append(
                TermTest(
                    output,
                    str(term),
                    inside,
                    f,
                    (1.0, float(dof)),
                    f_tail(f, 1.0, float(dof)),
                    aicc(other, n, len(changed)),
                )
            )
    return result


def aicc(rss: float, n: int, terms: int) -> float:
    """Return Akaike's criterion for few data; NaN where n − k − 1 is not positive."""
    value = akaike_criterion(rss, n, terms)
    return value if math.isfinite(value) else math.nan


def find_influence(calibration: Calibration) -> Influence:
    """Return what each position does to the fit, eqs. (1) and (2).

    Raises
    ------
    MultiposError
        The orientations were not known exactly.
    """
    c = calibration
    _require_known(c)
    n, m = c.readings.values.shape
    noise = c.noise
    sd = np.ones((n, m)) if noise is None or noise.ndim == 2 else np.sqrt(noise).reshape(n, m)
    h = c.diagnostics.leverage
    left = np.where(1.0 - h > 1e-9, 1.0 - h, math.nan)
    terms = np.array([len(t) for t in c.model.terms], dtype=np.float64)
    nu = n - terms
    e = c.residuals / sd
    with np.errstate(divide="ignore", invalid="ignore"):
        s2 = np.sum(e**2, axis=0) / np.where(nu > 0.0, nu, math.nan)
        r = e / np.sqrt(s2 * left)
    cook = r**2 * h / (terms * left)
    return Influence(studentised=r, cook=cook, left_out=c.residuals / left)


def fourier_residuals(calibration: Calibration) -> list[dict[str, Any]]:
    """Return the harmonics of the residuals along each roll about a case axis.

    Returns
    -------
    list of dict
        {"roll": axis, "positions": labels, "output", "harmonics": [{"order", "cos", "sin",
        "amplitude", "p"}]}; `p` is how often noise alone would give such an amplitude. Rolls of
        fewer than eight positions are left out.
    """
    c = calibration
    _require_known(c)
    names = c.readings.labels
    result = []
    for along, axis in enumerate(COMPONENTS):
        rows = np.flatnonzero(np.abs(c.reference[:, along]) < 1e-9)
        first, second = (i for i in range(3) if i != along)
        sign = c.sign
        angle = np.arctan2(sign * c.reference[rows, second], sign * c.reference[rows, first])
        # Of the distinct ones: rolls share faces, and −180° is 180°.
        distinct = len(np.unique(np.round(np.exp(1j * angle), 9)))
        if distinct < _FEWEST:
            continue
        orders = range(1, min(_ORDERS, (distinct - 1) // 2) + 1)
        for column, output in enumerate(c.outputs):
            s2 = float(c.residual_sd[column]) ** 2
            entries = []
            for order in orders:
                X = np.column_stack([np.cos(order * angle), np.sin(order * angle)])
                found = solve(X, c.residuals[rows, column], rows="positions of the roll")
                a, b = found.coefficients.tolist()
                explained = float(np.sum((X @ found.coefficients) ** 2)) / 2.0
                nu = float(len(c.readings) - len(c.model.terms[column]))
                p = f_tail(explained / s2, 2.0, nu) if s2 > 0.0 else math.nan
                entries.append(
                    {"order": order, "cos": a, "sin": b, "amplitude": math.hypot(a, b), "p": p}
                )
            result.append(
                {
                    "roll": axis,
                    "positions": [names[row] for row in rows.tolist()],
                    "output": output,
                    "harmonics": entries,
                }
            )
    return result


def _require_known(c: Calibration) -> None:
    if not c.estimator.exact:
        raise MultiposError(
            f"criticism of the terms needs known orientations, not the estimator '{c.estimator}'."
        )


def residual_sum(c: Calibration, column: int, terms: tuple[Term, ...]) -> float:
    """Return the weighted residual sum of squares of one output fitted by other terms."""
    variables = c.model.variables(c.reference, c.readings.environment)
    n = len(c.readings)
    design = np.column_stack([np.broadcast_to(t.evaluate(variables), (n,)) for t in terms])
    noise = c.noise
    m = len(c.outputs)
    variances = None if noise is None or noise.ndim == 2 else noise.reshape(n, m)[:, column]
    names = [str(term) for term in terms]
    found = solve(
        design,
        c.readings.values[:, column],
        covariance=variances,
        least_norm=ZERO_NORM,
        names=names,
    )
    return float(found.rss)


def force_components(term: Term) -> list[str]:
    """Return the components of the reference that a term uses."""
    return [factor.variable for factor in term.factors if factor.variable in COMPONENTS]
