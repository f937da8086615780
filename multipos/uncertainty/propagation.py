"""The uncertainty budget of a calibration: what each input quantity does to each parameter.

`evaluate_budget` evaluates it and `state_budget` returns a calibration whose covariance follows
from it; `budget_rows` returns its lines as files have them, `find_quantities` the quantities that
count, and `row_dof` and `welch_satterthwaite` the degrees of freedom of a line and of a sum.

With the sensitivities c_x = dp/dx of `multipos.uncertainty.sensitivities`, for every estimator,

    cov p = sum_x c_x c_x' u(x)².                                                           (1)

The first rows of the budget are the covariance that the residuals, or the readings' own
uncertainties, gave. Quantities common to all positions are systematic: repeats do not average them.
Independent ones (orientation error, resolution) scatter the residuals, so where the noise was
estimated from residuals they are in the first rows already: listed, not added again (JCGM 100,
4.3.10).

A common quantity scatters the residuals too, as far as the model cannot follow it: a table that is
not level does so at positions of several headings. What occurred of it is estimated from its
pattern and taken out of the first rows (`multipos.uncertainty.common_causes`), so that (1) is added
in full. The degrees of freedom of the sum are Welch's and Satterthwaite's,

    ν_eff = u_c⁴ / sum_x (u_x⁴ / ν_x).                                                      (2)

References
----------
JCGM 100:2008, clauses 4.3, 5.1 and G.4.1; docs/theory/budget.md.
"""

import math
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from multipos.estimation.gains import estimator_gain
from multipos.numerics.arrays import LARGEST, Array, Mask, quadratic
from multipos.results import Drawn, Result, Tabular, frozen, require
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator, StatedBudget
from multipos.uncertainty.budgets import OF_FORCE_ALONE, Budget, BudgetSource, Quantity, read_budget
from multipos.uncertainty.common_causes import Cleared, clear_scatter
from multipos.uncertainty.sensitivities import is_bounded, parameter_effects

GRAVITY = "gravity"


@frozen
class Row(Result):
    """One line of the budget.

    Attributes
    ----------
    quantity, text : str
    evaluation : str
        'A' from the scatter of the readings, 'B' otherwise.
    u : float
        Standard uncertainty, in `unit`; NaN for the readings, which have many.
    unit, distribution : str
    dof : (p,) array
    common : bool
        Whether it is the same at all positions, and in calibrations repeated on one day.
    contained : (p,) bool array
        Where the residual noise holds it already, so that it is not added.
    sensitivity : (p,) array
        Of each parameter, per `unit`; the root sum of squares where the quantity has several
        independent components. NaN for the readings.
    covariance : (p, p) array
        What it contributes, as if it were not contained.
    """

    quantity: str
    text: str
    evaluation: str
    u: float
    unit: str
    distribution: str
    dof: Array
    common: bool
    contained: Mask
    sensitivity: Array
    covariance: Array

    @property
    def contribution(self) -> Array:
        """Standard uncertainty (p,) that the quantity gives each parameter."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def added(self) -> Array:
        """What enters the sum: the covariance (p, p) without what is contained elsewhere."""
        return np.where(np.logical_or.outer(self.contained, self.contained), 0.0, self.covariance)


@frozen
class Evaluation(Result, Drawn, Tabular):
    """A budget evaluated for one calibration: its rows, and their sum.

    Attributes
    ----------
    rows : tuple of Row
    names : tuple of p str
        Of the parameters.
    cleared : Cleared
        What common causes leave of the residual noise, which is the first rows.
    """

    rows: tuple[Row, ...]
    names: tuple[str, ...]
    cleared: Cleared

    @cached_property
    def covariance(self) -> Array:
        """Covariance (p, p) of the parameters."""
        return np.asarray(sum(row.added for row in self.rows))

    def apart(self, *, same_day: bool) -> "Evaluation":
        """Return the budget of what a calibration does not share with another.

        Gravity is shared by all; level, and what else is common to all positions, on one day only.
        """

        def is_shared(row: Row) -> bool:
            return row.common and (same_day or row.quantity == GRAVITY)

        return replace(self, rows=tuple(row for row in self.rows if not is_shared(row)))

    @cached_property
    def dof(self) -> Array:
        """Effective degrees of freedom (p,) of the parameters."""
        return self.combine(np.eye(len(self.names)))[1]

    def columns(self) -> dict[str, Any]:
        """Return what each quantity contributes to u of each parameter, in the parameter's unit."""
        pairs = [(row, i) for row in self.rows for i in range(len(self.names))]
        return {
            "quantity": [row.quantity for row, _ in pairs],
            "parameter": [self.names[i] for _, i in pairs],
            "contribution": [float(np.sqrt(row.covariance[i, i])) for row, i in pairs],
            "contained": [bool(row.contained[i]) for row, i in pairs],
            "dof": [float(row.dof[i]) for row, i in pairs],
            "common": [row.common for row, _ in pairs],
            "evaluation": [row.evaluation for row, _ in pairs],
            "distribution": [row.distribution for row, _ in pairs],
        }

    def combine(self, gradient: Array) -> tuple[Array, Array, Array]:
        """Return what the budget means for quantities derived from the parameters.

        Parameters
        ----------
        gradient : (q, p) array
            Derivatives of the quantities by the parameters.

        Returns
        -------
        u, dof : (q,) arrays
            Combined standard uncertainty, and its degrees of freedom by eq. (2).
        contributions : (rows, q) array
        """
        variance = np.array([quadratic(gradient, row.added) for row in self.rows])
        contributions = np.sqrt(np.maximum(variance, 0.0))
        dof = np.array([row_dof(row, gradient) for row in self.rows])
        u = np.sqrt(np.sum(contributions**2, axis=0))
        return u, welch_satterthwaite(contributions, dof), contributions


def welch_satterthwaite(contributions: ArrayLike, dof: ArrayLike) -> Array:
    """Return effective degrees of freedom by eq. (2).

    Parameters
    ----------
    contributions : (m,) or (m, q) array
        Standard uncertainties that m independent quantities contribute.
    dof : array of the same shape, or that broadcasts to it
        Their degrees of freedom; inf where known for certain.

    Returns
    -------
    () or (q,) array
        Infinite where nothing of finite degrees of freedom contributes that would count.
    """
    u = np.asarray(contributions, dtype=np.float64)
    nu = np.broadcast_to(np.asarray(dof, dtype=np.float64), u.shape)
    total = np.sum(u**2, axis=0)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        share = np.where(total > 0.0, u**2 / total, 0.0)
        summed = np.sum(
            np.where(share > 0.0, share**2 / nu, np.where(np.isnan(u), np.inf, 0.0)), axis=0
        )
        effective = 1.0 / summed
    return np.where(effective > LARGEST, np.inf, effective)


def row_dof(row: Row, gradient: Array) -> Array:
    """Degrees of freedom of a row for derived quantities: the fewest of what it is made of."""
    held = np.flatnonzero(np.diag(row.added) > 0.0)
    dof = np.broadcast_to(row.dof, len(row.added))[held]
    used = gradient[:, held] != 0.0
    if len(dof) and (dof == dof[0]).all():
        return np.where(used.any(axis=1), dof[0], np.inf)
    return np.asarray(np.min(np.where(used, dof, np.inf), axis=1, initial=np.inf))


def evaluate_budget(
    calibration: Calibration, budget: "BudgetSource | Budget | None" = None
) -> Evaluation:
    """Return the budget of a calibration, line by line.

    Parameters
    ----------
    calibration : Calibration
    budget : path, tables or Budget, optional
        What is known beside the readings; otherwise what the calibration was made with. The
        gravity is the calibration's own in either case.

    Returns
    -------
    Evaluation

    Raises
    ------
    MultiposError
        A quantity needs what the calibration does not know, such as the heading of its positions.

    Examples
    --------
    >>> import multipos as mp
    >>> found = mp.evaluate_budget(mp.demo().calibration, {"level": {"u_deg": 0.01}})
    >>> [(row.quantity, row.evaluation) for row in found.rows][-1]
    ('level', 'B')
    """
    require(calibration, Calibration)
    return _evaluate(calibration, budget)[0]


def state_budget(calibration: Calibration, budget: "BudgetSource | Budget") -> Calibration:
    """Return a calibration whose covariance and degrees of freedom follow from a budget.

    Parameters
    ----------
    calibration : Calibration
    budget : path, tables or Budget
        What is known beside the readings, in place of what the calibration was made with.

    Returns
    -------
    Calibration

    Raises
    ------
    MultiposError
        As in `evaluate_budget`.

    Examples
    --------
    >>> import multipos as mp
    >>> cal = mp.demo().calibration
    >>> level = mp.state_budget(cal, {"level": {"u_deg": 0.1}})
    >>> round(float(level["bias_ax"].u / cal["bias_ax"].u), 2)
    1.56
    """
    require(calibration, Calibration)
    stated = read_budget(budget)
    found, scatter = _evaluate(calibration, stated)
    return replace(
        calibration,
        covariance=found.covariance,
        parameter_dof=found.dof,
        budget=StatedBudget(stated.tables, tuple(budget_rows(found)), scatter),
    )


def _evaluate(c: Calibration, budget: "BudgetSource | Budget | None") -> tuple[Evaluation, Array]:
    """Return the budget, and the covariance (p, p) by the scatter that nothing was taken out of."""
    own = read_budget(c.budget_tables)
    stated = own if budget is None else read_budget(budget)
    gain = estimator_gain(c)
    scatter = _scatter(c, [_row(c, gain, quantity) for quantity in find_quantities(c, own)])
    quantities = find_quantities(c, stated)
    cleared = clear_scatter(c, gain, quantities)
    rows = [_row(c, gain, quantity) for quantity in quantities]
    first = [_without_causes(c, row, cleared) for row in scatter]
    whole = np.asarray(sum(row.covariance for row in scatter))
    return Evaluation((*first, *rows), c.names, cleared), whole


def budget_rows(evaluation: Evaluation) -> list[dict[str, Any]]:
    """Return the lines of a budget as what JSON can carry, contributions by parameter name."""
    return [
        {
            "quantity": row.quantity,
            "evaluation": row.evaluation,
            "distribution": row.distribution,
            "u": None if math.isnan(row.u) else row.u,
            "unit": row.unit,
            "common": row.common,
            "contained": bool(row.contained.all()),
            "dof": float(row.dof.min()),
            "sensitivity": None
            if row.evaluation == "A"
            else dict(zip(evaluation.names, row.sensitivity.tolist(), strict=True)),
            "contribution": dict(zip(evaluation.names, row.contribution.tolist(), strict=True)),
        }
        for row in evaluation.rows
    ]


def find_quantities(calibration: Calibration, budget: Budget) -> list[Quantity]:
    """Return the quantities that reach the parameters, gravity first and as it was used."""
    found = [q for name, q in budget.quantities.items() if name not in ("gravity", *OF_FORCE_ALONE)]
    gravity = calibration.gravity
    if gravity is None or not gravity.u > 0.0:
        return found
    stated = budget.quantities.get("gravity")
    same = stated is not None and stated.u == gravity.u
    law, dof = (stated.distribution, stated.dof) if stated and same else ("normal", math.inf)
    return [Quantity(GRAVITY, gravity.u, gravity.size_unit, law, dof), *found]


def _scatter(calibration: Calibration, others: list[Row]) -> list[Row]:
    """Return the rows of the readings themselves: what is left of the covariance without others."""
    c = calibration
    kept = None if c.budget is None else c.budget.scatter
    added = sum(row.added for row in others)
    rest = c.covariance - added if kept is None else kept
    dof = c.dof_of_outputs
    stated = bool(np.isinf(c.dof).all())
    text = "noise of the readings, as stated" if stated else "residual noise"
    if c.estimator is Estimator.UNCERTAIN:
        text += " and orientation errors"
    return [
        Row(
            quantity="readings",
            text=text,
            evaluation="A",
            u=math.nan,
            unit=c.model.unit,
            distribution="normal" if stated else "t",
            dof=np.where(block, dof, np.inf),
            common=False,
            contained=np.zeros(len(dof), bool),
            sensitivity=np.full(len(dof), math.nan),
            covariance=np.where(np.outer(block, block), rest, 0.0),
        )
        for block in _blocks(c, rest)
    ]


def _blocks(c: Calibration, covariance: Array) -> list[Mask]:
    """Return which parameters (p,) are in one row: those of an output, all where any covary."""
    output_of = c.model.output_of
    apart = output_of[:, None] != output_of
    scale = np.sqrt(np.abs(np.diag(covariance)))
    if (np.abs(covariance) > 1e-9 * np.outer(scale, scale))[apart].any():
        return [np.ones(len(output_of), bool)]
    return [output_of == i for i in range(len(c.outputs))]


def _without_causes(c: Calibration, row: Row, cleared: Cleared) -> Row:
    """Return a row of the readings without what common causes left in their residuals."""
    if (cleared.ratio == 1.0).all():
        return row
    finite = np.isfinite(c.dof) & (c.dof > 0.0)
    kept = np.divide(cleared.dof, c.dof, out=np.ones(len(c.dof)), where=finite)
    by_output = np.array([np.sqrt(cleared.ratio), kept])
    factor, kept = c.model.per_parameter(by_output, by_output.mean(axis=1, keepdims=True))
    return replace(
        row,
        text="residual noise without common causes",
        dof=row.dof * kept,
        covariance=row.covariance * np.outer(factor, factor),
    )


_AT_WORST = "level of the table, at its worst headings"


def _row(calibration: Calibration, gain: Array, quantity: Quantity) -> Row:
    """Return the row of a quantity."""
    c, kind = calibration, quantity.kind
    effects = parameter_effects(c, gain, quantity)
    contained = np.isfinite(c.dof_of_outputs)
    if quantity.name in c.estimator.contains:
        contained[:] = True
    contained &= not (kind.common or kind.shared)
    return Row(
        quantity=quantity.name,
        text=_AT_WORST if is_bounded(c, quantity) else kind.text,
        evaluation="B",
        u=quantity.u,
        unit=quantity.unit if quantity.name == "gravity" else kind.unit or c.model.unit,
        distribution=quantity.distribution,
        dof=np.full(len(c.parameters), quantity.dof),
        common=kind.common,
        contained=contained,
        sensitivity=effects[:, 0] if effects.shape[1] == 1 else np.linalg.norm(effects, axis=1),
        covariance=effects @ effects.T * quantity.u**2,
    )
