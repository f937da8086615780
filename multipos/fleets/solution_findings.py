"""Findings of units at uncertain or unknown orientations, about the solution of each.

- `lacking_in_units` returns which terms the units' models lack, `find_about_solutions` what is
  found of each.

Each unit has weights and slopes of its own there, about which its missing terms
(`multipos.diagnostics.score_tests`) and unequal outputs (`multipos.diagnostics.residuals`) are
tested. A unit in which a position sticks out is left to the fit of one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from multipos.diagnostics import projections, row_order
from multipos.diagnostics.residuals import FEW, MOST, score_equality
from multipos.diagnostics.score_tests import CLEAR, LEVEL, ratios_of
from multipos.estimation.batches import Estimates, Solution
from multipos.fleets.unit_findings import DOUBTED, UnitFindings, beyond_limit
from multipos.numerics.arrays import COMPONENTS, Array, Mask
from multipos.numerics.quantiles import chi2_quantile
from multipos.positions.headers import TEMPERATURE
from multipos.sensor.calibration import Calibration
from multipos.sensor.studentised import square_beyond

_ROUNDING = 1e-14  # of what is one: no inverse is asked of nothing
_LEAST = 1e-300  # of a sum of squares
_FREE = 3  # equations without which no position sticks out
_STICKS_OUT = 5e-4  # of a probability that the largest of all squares is chance


def lacking_in_units(c: Calibration) -> tuple[projections.Kind, ...]:
    """Return the kinds that a model lacks, of temperature wherever readings have one."""
    environment = dict(c.readings.environment)
    if TEMPERATURE in environment:
        environment[TEMPERATURE] = np.arange(float(len(c.readings)))
    return projections.lacking(replace(c, readings=replace(c.readings, environment=environment)))


@np.errstate(all="ignore")  # a unit without numbers is fitted singly
def find_about_solutions(
    kinds: Sequence[projections.Kind],
    found: Estimates,
    environment: Mapping[str, Array],
    like: Calibration | None = None,
) -> UnitFindings:
    """Return of which units (B,) at uncertain or unknown orientations terms are missing.

    And of which outputs are unequally noisy. Those near a limit are fitted singly, as are those in
    which a term that the positions hardly show is significant, a position sticks out, or causes of
    time explain what is left.

    Parameters
    ----------
    kinds : sequence of Kind
    found : Estimates
    environment : mapping of str to (n,) or (B, n) array
        Of what units do not share, powers above the first are not asked for.
    like : Calibration, optional
        The unit that was fitted, at unknown orientations: a position is one equation there, and
        has no prior that a degree of freedom may not undercut; causes of time are asked.
    """
    count, first, unknown = len(found.sound), 0, like is not None
    of_force = [kind.name in projections.OF_FORCE for kind in kinds]
    missing, unequal, singly = np.zeros((3, count), dtype=np.bool_)
    for solution in found.solutions:
        some = np.flatnonzero(found.sound[first : first + len(solution.objective)])
        units = first + some
        first += len(solution.objective)
        if not len(some):
            continue
        (m, among, n), of = solution.push.shape, solution
        if len(some) < among:
            of = solution.of(some)
        dof = float((n if unknown else m * n) - solution.slopes.shape[1])
        columns = {
            name: each[units] - each[units, :1]
            if each.ndim == 2
            else np.broadcast_to(each, (len(units), n))
            for name, each in environment.items()
        }
        inverse = np.asarray(np.linalg.inv(of.information), dtype=np.float64)
        tested = _score_kinds(kinds, of, inverse, columns)
        ratio, free, asked = ratios_of(
            tested.explained, of.objective[:, None], tested.q, dof, np.full(1, float(not unknown))
        )
        significant, close = beyond_limit(ratio, tested.q, free, asked)
        missing[units] = significant.any(axis=1)
        faint = significant & (tested.least < CLEAR)
        singly[units] = close.any(axis=1) | faint[:, of_force].any(axis=1) | _stick_out(of)
        if dof >= FEW and n * m <= MOST:
            follows = (inverse @ of.slopes.transpose(0, 2, 1, 3)).transpose(0, 2, 1, 3)
            given = of.weights, of.slopes, follows, of.push, of.variance
            statistic, limit = score_equality(*given)[0], chi2_quantile(1.0 - LEVEL, m - 1.0)
            unequal[units] = (statistic > limit) & ~missing[units]
            singly[units] |= ~(np.abs(statistic - limit) >= DOUBTED * limit)
        if like is not None and row_order.asked(like):
            singly[units] |= row_order.search_solutions(like, of, found.sensitivity[units])
    return UnitFindings({"missing-term": missing, "unequal-noise": unequal}, singly)


def _stick_out(of: Solution) -> Mask:
    """Return in which units (B,) a position has more of the squares than chance leaves it.

    The n − p equations along the forces leave each of n as much, so that n s/(n − p) of a share s
    is t²/(t² + n − p − 1) of a studentised residual t.
    """
    square = np.einsum("ibn,ibn->bn", of.push**2, of.variance)
    n = square.shape[1]
    free = n - of.slopes.shape[1]
    if free < _FREE:
        return np.zeros(len(square), dtype=np.bool_)
    share = square.max(axis=1) / np.maximum(square.sum(axis=1), _LEAST)
    return np.asarray(share * n > square_beyond(_STICKS_OUT / n, free))


class _Scored(NamedTuple):
    """Δ, q and the least part that is left of a term, (B, K) each."""

    explained: Array
    q: Array
    least: Array


def _score_kinds(
    kinds: Sequence[projections.Kind],
    of: Solution,
    inverse: Array,
    environment: Mapping[str, Array],
) -> _Scored:
    """Return the score tests of `multipos.diagnostics.score_tests` about solutions."""
    variables = dict(zip(COMPONENTS, of.force, strict=True)) | dict(environment)
    terms = [(k, i, t) for k, kind in enumerate(kinds) for i, e in enumerate(kind.terms) for t in e]
    kind_of, outputs = np.array([each[:2] for each in terms], dtype=np.intp).reshape(-1, 2).T
    shape = of.push.shape[1:]
    Z = np.empty((len(terms), *shape))  # of a model that lacks none, none
    for row, (_, _, term) in zip(Z, terms, strict=True):
        row[...] = term.evaluate(variables)
    score = np.einsum("rbn,rbn->br", Z, of.push[outputs])
    rows: Array | None = None
    cross: Array = np.empty((shape[0], of.slopes.shape[1], len(terms)))
    if of.normal is None or of.rows is None:
        for i, each in enumerate(of.slopes):
            mine = np.flatnonzero(outputs == i)
            cross[:, :, mine] = each.transpose(1, 0, 2) @ Z[mine].transpose(1, 2, 0)
    else:
        rows = np.ascontiguousarray((of.normal[outputs] * Z).transpose(1, 0, 2))
        cross = of.rows @ rows.swapaxes(1, 2)
    lost = cross.swapaxes(1, 2) @ (inverse @ cross)
    scored = _Scored(*np.zeros((3, shape[0], len(kinds))))
    for k in range(len(kinds)):
        mine = np.flatnonzero(kind_of == k)
        if rows is None:
            WZ = of.weights[outputs[mine, None], outputs[mine]] * Z[mine]  # (R, R, B, n)
            gram = np.einsum("rsbn,rbn->brs", WZ, Z[mine])
        else:
            gram = rows[:, mine] @ rows[:, mine].swapaxes(1, 2)
        size = np.einsum("brr->br", gram)
        scale = np.where(size > 0.0, np.sqrt(np.maximum(size, 0.0)), 1.0)
        unit = (gram - lost[:, mine[:, None], mine]) / (scale[:, :, None] * scale[:, None])
        found = _explained_of(unit, score[:, mine] / scale)
        scored.explained[:, k], scored.q[:, k], scored.least[:, k] = found
    return scored


def _explained_of(gram: Array, score: Array) -> tuple[Array, Array, Array]:
    """Return Δ, q and the least eigenvalue (B,), or less, of V'V (B, R, R) and V'e (B, R).

    No eigenvalue is less than that of the inverse's trace, 1/tr (V'V)⁻¹.
    """
    r = score.shape[1]
    inverse = np.linalg.inv(gram + _ROUNDING * np.eye(r))
    least = 1.0 / np.einsum("brr->b", inverse)
    q, faint = np.full(len(gram), float(r)), np.flatnonzero(~(least > CLEAR))
    explained = np.sum((inverse @ score[:, :, None])[:, :, 0] * score, axis=1)
    if len(faint):
        values, vectors = np.linalg.eigh(gram[faint])
        seen = values > projections.IDENTIFIABLE
        along = np.einsum("br,brs->bs", score[faint], vectors)
        explained[faint] = np.sum(along**2 / np.where(seen, values, np.inf), axis=1)
        q[faint], least[faint] = seen.sum(axis=1), values[:, 0]
    return explained, q, least
