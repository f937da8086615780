"""Are terms warranted in all outputs together? Nested tests for every estimator.

A sensor whose outputs are of one make has a second-order term in all of them or in none. With
chi²₀ of the model without the terms and chi²₁ with them, q parameters apart, on nu₁ degrees of
freedom,

    F = ((chi²₀ − chi²₁)/q) / (chi²₁/nu₁)                                                  (1)

follows the F distribution on q and nu₁ if nothing is in the terms.

- Uncertain and unknown orientations: chi² is the minimum F of `multipos.estimation.likelihood`,
  each model with orientations of its own, both with the noise that was stated or found. Where
  noise was integrated over it is that of the model with the terms, chi²₁/nu₁ is then taken as 1,
  and the degrees of freedom are those of its posterior.

- Known orientations: each output has a scatter of its own, and so an F of its own; the p values
  P_i are independent and combine to −2 sum ln P_i, chi² on 2M degrees of freedom. Outputs whose
  readings are correlated are tested together by (1).

References
----------
R. A. Fisher, *Statistical Methods for Research Workers*, 1932, section 21.1.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from multipos.diagnostics.criticism import force_components, residual_sum
from multipos.errors import MultiposError, RankError
from multipos.estimation.descent import maximise
from multipos.estimation.gains import estimated_variances, restate, return_to_optimum
from multipos.estimation.identifiability import condition
from multipos.estimation.likelihood import linearise
from multipos.estimation.noise import judge_noise
from multipos.estimation.problem import Optimum, Problem
from multipos.estimation.starts import reduced_information
from multipos.numerics.least_squares import block_design, solve
from multipos.numerics.quantiles import chi2_tail, f_tail
from multipos.results import Result, require
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.model import Model
from multipos.sensor.stating import build_model

_GROUPS = ("own^2", "own^3", "own*|own|", "own*other")  # K2, K3, Koq, Kip with Kio


@dataclass(frozen=True, eq=False)
class JointTest(Result):
    """A nested test of terms in all outputs; `inside` tells whether the model has them.

    Attributes
    ----------
    terms : str
        As in a formula, with `own` and `other` for the axes.
    inside : bool
    statistic : float
        F, or Fisher's chi².
    dof : tuple of float
        Two of F, one of chi².
    p : float
    """

    terms: str
    inside: bool
    statistic: float
    dof: tuple[float, ...]
    p: float

    def __str__(self) -> str:
        law = "F" if len(self.dof) == 2 else "chi2"
        return f"{law}({', '.join(f'{v:.4g}' for v in self.dof)}) = {self.statistic:.3g}"


def judge_terms_jointly(calibration: Calibration) -> list[JointTest]:
    """Test second- and third-order terms over all outputs, out of the model or into it.

    Terms that the positions cannot tell, or with which the search finds no end, are left out.

    Returns
    -------
    list of JointTest

    Raises
    ------
    MultiposError
        A robust loss, or a model that is an expression: neither has nested tests of terms.

    Examples
    --------
    >>> import multipos as mp
    >>> cal = mp.demo().calibration
    >>> for test in mp.judge_terms_jointly(cal):
    ...     print(test.terms, test.inside, round(test.p, 2))
    own^2 True 0.81
    """
    require(calibration, Calibration)
    c = calibration
    if c.robust_weight is not None or isinstance(c.model, ExpressionModel):
        raise MultiposError(
            "joint tests of terms need a formula fitted without --robust; fit again without it."
        )
    test = _by_output
    if not c.estimator.exact:
        test = _by_likelihood
    elif (noise := c.noise) is not None and noise.ndim == 2:
        test = _by_covariance
    return list(test(c))


def _nested(model: Model) -> Iterator[tuple[str, bool, Model, Model]]:
    """Yield the name of each group of terms, whether the model has it, and both models."""
    for formula in _GROUPS:
        built = build_model(formula, model.outputs, model.axes).terms
        group = tuple(
            tuple(term for term in terms if set(force_components(term)) <= set(model.inputs))
            for terms in built
        )
        pairs = list(zip(model.terms, group, strict=True))
        inside = all(set(new) <= set(own) for own, new in pairs)
        small = tuple(tuple(t for t in own if t not in new) for own, new in pairs)
        large = tuple(tuple(dict.fromkeys((*own, *new))) for own, new in pairs)
        other = replace(model, terms=small if inside else large)
        if any(group):
            yield formula, inside, *((other, model) if inside else (model, other))


def _by_likelihood(c: Calibration) -> Iterator[JointTest]:
    """Test by eq. (1) on the likelihood of uncertain and unknown orientations."""
    problem = restate(c)
    best = return_to_optimum(c, problem)
    free = estimated_variances(c)
    for name, inside, small, large in _nested(c.model):
        nu = float(problem.degrees.sum()) - problem.unknowns - len(large.keys) + len(c.model.keys)
        wide, found = _fitted(problem, best, large)
        if nu <= 0 or not _is_told(wide, found):
            continue
        q = len(large.keys) - len(small.keys)
        scale, dof = found.point.objective / nu, nu
        if free.any():
            wide, found, worth = judge_noise(
                wide, found, nu, stated=not free[0], estimate_sd=bool(free[1])
            )
            scale, dof = 1.0, worth.dof
        chi2 = _fitted(wide, found, small)[1].point.objective
        f = (chi2 - found.point.objective) / q / scale
        yield JointTest(name, inside, f, (float(q), dof), f_tail(f, float(q), dof))


def _fitted(problem: Problem, optimum: Optimum, model: Model) -> tuple[Problem, Optimum]:
    """Return problem and optimum of another model, searched from an optimum."""
    before = dict(zip(problem.model.keys, optimum.state.theta.tolist(), strict=True))
    theta = np.array([before.get(key, 0.0) for key in model.keys])
    changed = replace(problem, model=model)
    return changed, maximise(changed, replace(optimum.state, theta=theta))


def _is_told(problem: Problem, optimum: Optimum) -> bool:
    """Tell whether the positions separate all parameters."""
    normal = linearise(problem, optimum.state, optimum.point)
    p = len(problem.model.keys)
    return optimum.converged and math.isfinite(
        condition(reduced_information(normal.information, p))
    )


def _by_output(c: Calibration) -> Iterator[JointTest]:
    """Test each output by its F and combine their p values."""
    n = len(c.readings)
    for name, inside, small, large in _nested(c.model):
        found = []
        try:
            for column, (few, many) in enumerate(zip(small.terms, large.terms, strict=True)):
                q, nu = float(len(many) - len(few)), float(n - len(many))
                if q == 0.0:
                    continue
                chi2 = [residual_sum(c, column, terms) for terms in (few, many)]
                f = (
                    (chi2[0] - chi2[1]) / q / (chi2[1] / nu)
                    if chi2[1] > 0.0 and nu > 0
                    else (math.nan)
                )
                found.append((f, (q, nu), f_tail(f, q, nu)))
        except RankError:
            continue
        if not found or any(math.isnan(p) for _, _, p in found):
            continue
        if len(found) == 1:
            yield JointTest(name, inside, *found[0])
            continue
        total = -2.0 * sum(math.log(max(p, np.finfo(float).tiny)) for _, _, p in found)
        dof = 2.0 * len(found)
        yield JointTest(name, inside, total, (dof,), chi2_tail(total, dof))


def _by_covariance(c: Calibration) -> Iterator[JointTest]:
    """Test outputs whose readings are correlated, at known orientations, together by eq. (1)."""
    noise = c.noise
    n, m = c.readings.values.shape
    for name, inside, small, large in _nested(c.model):
        chi2 = []
        try:
            for model in (small, large):
                phi = model.basis(c.reference, c.readings.environment)
                design = block_design([phi[:, columns] for columns in model.columns])
                found = solve(
                    design.reshape(n * m, -1),
                    c.readings.values.ravel(),
                    covariance=noise,
                    names=model.names,
                )
                chi2.append(float(found.rss))
        except RankError:
            continue
        q, nu = float(len(large.keys) - len(small.keys)), float(n * m - len(large.keys))
        if nu > 0 and chi2[1] > 0.0:
            f = (chi2[0] - chi2[1]) / q / (chi2[1] / nu)
            yield JointTest(name, inside, f, (q, nu), f_tail(f, q, nu))
