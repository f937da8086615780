"""The sensor and the table of one or several calibrations of the same positions, as columns."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from multipos.estimation.known import FLOOR
from multipos.numerics.arrays import Array
from multipos.numerics.least_squares import solve
from multipos.numerics.quantiles import coverage_factor, f_tail
from multipos.numerics.separability import separability
from multipos.numerics.terms import COMPONENTS
from multipos.positions.harmonics import Roll, find_rolls
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.inverse import parameter_jacobian
from multipos.sensor.model import Model
from multipos.uncertainty.table_findings import BesideTable
from multipos.uncertainty.table_motion import shaft_effects, table_effects

_ROUNDING = 1e-12  # of the largest reading


class Bench:
    """The sensor and the table of one or several calibrations of the same positions, as columns."""

    def __init__(self, parts: tuple[Calibration, ...]) -> None:
        self.parts, self.first = parts, parts[0]
        self.models = tuple(part.model for part in parts)
        self.rolls = find_rolls(self.first.readings)
        self.names = tuple(name for model in self.models for name in model.names)
        self.keys = tuple((out, str(term)) for model in self.models for out, term in model.keys)
        self.outputs = tuple(output for model in self.models for output in model.outputs)
        self.values = np.concatenate([_response(part) for part in parts], axis=1)
        self.weight = np.tile(
            np.concatenate([_precision(part) for part in parts]), len(self.first.readings)
        )
        slopes = [
            part.model.linear_part(part.parameters, part.mean_environment)[:, 1:] for part in parts
        ]
        axes = [axis for model in self.models for axis in model.axes]
        own = np.array([[float(axis == name) for name in COMPONENTS] for axis in axes])
        self.linear, self.own = np.concatenate(slopes), own
        self.sensor = self.design(self.models)
        self.shifts = _shifts(self.outputs, len(self.first.readings), self.rolls)
        # What can be told is a matter of structure: small cross terms must not seem to tell it.
        self.effect, self.nominal = (
            table_effects(self.first, self.rolls, m) for m in (self.linear, own)
        )
        self.shaft, self.shaft_nominal = (
            shaft_effects(self.first, self.rolls, m) for m in (self.linear, own)
        )

    def design(self, models: Sequence[Model]) -> Array:
        """Return the design of models over all outputs (n M, p), output running fastest."""
        parts = [_slopes(m, part) for m, part in zip(models, self.parts, strict=True)]
        n, m, p = len(self.first.readings), len(self.outputs), sum(part.shape[2] for part in parts)
        whole, row, column = np.zeros((n, m, p)), 0, 0
        for part in parts:
            rows, columns = part.shape[1:]
            whole[:, row : row + rows, column : column + columns] = part
            row, column = row + rows, column + columns
        return whole.reshape(n * m, p)


def _slopes(model: Model, calibration: Calibration) -> Array:
    """Return the derivative of readings by the parameters of a model (n, M, p)."""
    own = model is calibration.model
    parameters = calibration.parameters if own else np.zeros(len(model.keys))
    return parameter_jacobian(
        model, parameters, calibration.reference, calibration.readings.environment
    )


def _response(calibration: Calibration) -> Array:
    """Return the readings (n, M) as a linear model has them."""
    c = calibration
    if not isinstance(c.model, ExpressionModel):
        return c.readings.values
    # about its solution, where it is linear
    return np.asarray(c.residuals + _slopes(c.model, c) @ c.parameters)


def _shifts(
    outputs: Sequence[str], n: int, rolls: tuple[Roll, ...]
) -> dict[tuple[str, str], Array]:
    """Return the columns (n M,) of a zero shift of each output on each roll after the first."""
    columns = {}
    for roll in rolls[1:]:
        for place, name in enumerate(outputs):
            member = np.zeros((n, len(outputs)))
            member[roll.rows, place] = 1.0
            columns[roll.plane, name] = member.ravel()
    return columns


def _precision(calibration: Calibration) -> Array:
    """Return the inverse standard deviation of each output (M,), one where none is known."""
    sd = calibration.residual_sd
    usable = np.isfinite(sd).all() and (sd > 0.0).all()
    return 1.0 / sd if usable else np.ones(len(sd))


def separable(design: Array, effects: Array) -> list[int]:
    """Return the columns of `effects` that the design does not explain, the earlier first."""
    kept: list[int] = []
    for column in range(effects.shape[1]):
        trial = np.column_stack([design, effects[:, [*kept, column]]])
        if np.abs(effects[:, column]).max() > FLOOR and (
            separability(trial, floor=FLOOR).rank == trial.shape[1]
        ):
            kept.append(column)
    return kept


Sizes = dict[int, tuple[float, float, float]]  # value, u and U of columns by their place


def solve_beside(bench: Bench, design: Array, told: NDArray[np.bool_]) -> tuple[BesideTable, Sizes]:
    """Return the sensor beside errors of the table, and every column of the design with its U.

    Parameters
    ----------
    bench : Bench
    design : (n M, q) array
        The p columns of the sensor first, then those of the errors, fewer than there are rows.
    told : (p,) array of bool
        Which parameters no error does the same as.
    """
    p, more = len(bench.keys), design.shape[1] - len(bench.keys)
    values = bench.values.ravel() * bench.weight
    found = solve(design * bench.weight[:, None], values)
    alone = solve(bench.sensor * bench.weight[:, None], values)
    dof = float(found.dof)
    variance = float(found.rss) / dof
    covariance = found.cofactor * variance
    gain = max(float(alone.rss) - float(found.rss), 0.0) / more
    floor = (_ROUNDING * float(np.abs(values).max())) ** 2  # of residuals that are rounding alone
    chance = f_tail(gain / variance, more, dof) if variance > floor else 1.0
    u = np.sqrt(np.diag(covariance))
    k = coverage_factor(bench.first.confidence, dof)
    sizes = {i: (float(found.coefficients[i]), float(u[i]), k * float(u[i])) for i in range(len(u))}
    flags = tuple(map(bool, told.tolist()))
    coefficients = found.coefficients[:p]
    return BesideTable(bench.keys, coefficients, covariance[:p, :p], flags, dof, chance), sizes
