"""The readings of a calibration as they might have been, drawn by the laws of its budget: `Draws`.

Every input quantity is drawn from its law and acts in full, not to first order: gravity scales the
force, level, orientation error and index turn it, voltmeter and temperature move the readings.

Noise estimated from residuals on ν degrees of freedom is drawn from Student's t (JCGM 101, 6.4.9),
as one scale for all readings of an output. Where orientations were uncertain or unknown, positions,
and a table that is not level, are turned by what the likelihood of the fit allows them, and
their standard deviations, where they were estimated, are drawn about the estimate, none below zero.
"""

import math
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.estimation.gains import estimator_gain, noise_factor, restate, return_to_optimum
from multipos.estimation.problem import circle_basis
from multipos.numerics.arrays import Array, median
from multipos.numerics.rotations import directions
from multipos.sensor.calibration import Calibration
from multipos.sensor.simulation import turned
from multipos.uncertainty.budgets import Quantity, read_budget
from multipos.uncertainty.propagation import evaluate_budget, find_quantities
from multipos.uncertainty.sensitivities import is_bounded, reading_moves, turn_axes


class Draws:
    """Readings as they might have been, all quantities of the budget drawn from their laws."""

    def __init__(self, calibration: Calibration, rng: np.random.Generator) -> None:
        self.c: Calibration = calibration
        self.rng: np.random.Generator = rng
        c = calibration
        self.n, self.m = c.readings.values.shape
        self.quantities = _quantities_to_draw(c)
        self.model_readings = c.model.predict(c.parameters, c.reference, c.readings.environment)
        budget = evaluate_budget(c)
        scatter = [row for row in budget.rows if row.quantity == "readings"]
        self.dof = budget.cleared.dof
        self.joint = len(scatter) == 1 and self.m > 1
        self.spread, self.level, self.spread_u = np.zeros(self.n), 0.0, 0.0
        if not c.estimator.exact:
            self._take_from_likelihood()
        else:
            self.noise = _noise_root(c, sum(row.covariance for row in scatter))
        if np.isnan(self.noise).any() or not (self.dof > 0.0).all():
            raise MultiposError(
                "there are no residuals, so the noise that trials draw is unknown; state it, "
                "as with --reading-sd, or add positions."
            )

    def _take_from_likelihood(self) -> None:
        """Take noise and sds of positions from the likelihood of the fit."""
        c, problem = self.c, restate(self.c)
        root = math.sqrt(noise_factor(c, problem, return_to_optimum(c, problem)))
        if problem.precision.ndim == 2:
            self.noise = root / np.sqrt(problem.precision).ravel()
        else:
            blocks = np.linalg.cholesky(np.linalg.inv(problem.precision))
            whole = np.zeros((self.n, self.m, self.n, self.m))
            whole[np.arange(self.n), :, np.arange(self.n), :] = root * blocks
            self.noise = whole.reshape(self.n * self.m, -1)
        self.spread = np.where(
            np.isfinite(problem.orientation_sd), root * problem.orientation_sd, 0.0
        )
        if any(each.code == "inseparable" for each in c.findings):
            self.spread[:] = 0.0  # of own axes, whose U holds where orientations are exact
        self.level, self.attitude = root * problem.level_sd, problem.attitude
        self.rolls = problem.rolls
        estimated = c.orientation_spread
        if estimated is not None and estimated.value > 0.0:
            self.spread_u = estimated.u / estimated.value

    def __call__(self, trials: int) -> Array:
        """Return readings (trials, n, M) about the fitted model."""
        readings = self._without_noise(trials)
        for quantity in self.quantities:
            if quantity.name in ("gain", "offset", "temperature", "stability"):
                moves = reading_moves(self.c, quantity)
                drawn = self._law(quantity, (trials, moves.shape[2]))
                readings = readings + np.einsum("nmq,tq->tnm", moves, drawn)
            elif quantity.name == "resolution":
                readings = readings + self._law(quantity, readings.shape)
        noise = self._noise(trials)
        noise += readings
        return noise

    def _without_noise(self, trials: int) -> Array:
        """Readings of the model at the forces that may have acted."""
        tilts = [q for q in self.quantities if q.name in ("level", "orientation", "index")]
        scaled = [q for q in self.quantities if q.name == "gravity"]
        if tilts or scaled or self.spread.any() or self.level:
            return self._acted(trials, tilts, scaled)
        return np.broadcast_to(self.model_readings, (trials, self.n, self.m))

    def _acted(self, trials: int, tilts: list[Quantity], scaled: list[Quantity]) -> Array:
        """Readings of the model at the forces that really act, turned and scaled in full."""
        c = self.c
        vectors = np.zeros((trials, self.n, 3))  # rotation vectors of up, in case axes
        for quantity in tilts:
            if quantity.name == "orientation" or is_bounded(c, quantity):
                size = math.sqrt(self.n) if quantity.name == "level" else 1.0
                vectors += size * np.radians(self._law(quantity, (trials, self.n, 3)))
                continue
            axes = turn_axes(c, quantity)
            vectors += np.einsum(
                "tq,nqi->tni", np.radians(self._law(quantity, (trials, axes.shape[1]))), axes
            )
        vectors += self._allowed(trials)
        force = turned(c.reference, vectors)
        for quantity in scaled:
            assert c.gravity is not None
            at_rest = ~c.readings.forced[:, None]
            force = force * (1.0 + at_rest * self._law(quantity, (trials, 1, 1)) / c.gravity.value)
        flat = force.reshape(-1, 3)
        environment = {
            name: np.tile(c.readings.environment[name], trials) for name in c.model.environment
        }
        return c.model.predict(c.parameters, flat, environment).reshape(trials, self.n, self.m)

    def _allowed(self, trials: int) -> Array:
        """Turns of the positions (trials, n, 3) [rad] as the likelihood of the fit allows them."""
        turns = np.zeros((trials, self.n, 3))
        if self.spread.any():
            turns += self.rng.standard_normal(turns.shape) * self.spread[:, None]
            if self.rolls is not None:  # only across their circles
                rows = self.rolls.rows
                direction = directions(self.c.reference[rows])
                along = circle_basis(direction, self.rolls.vectors[rows])[:, :, 0]
                across = np.einsum("tni,ni->tn", turns[:, rows], along)
                turns[:, rows] = across[:, :, None] * along
            if self.spread_u > 0.0:
                drawn = 1.0 + self.spread_u * self.rng.standard_normal((trials, 1, 1))
                turns *= np.maximum(drawn, 0.0)
        if self.level and self.attitude is not None:
            tilt = self.level * self.rng.standard_normal((trials, 2))
            turns += np.einsum("tq,niq->tni", tilt, self.attitude[:, :, :2])
        return turns

    def _noise(self, trials: int) -> Array:
        drawn = self.rng.standard_normal((trials, self.n * self.m))
        if self.noise.ndim == 2:
            drawn = drawn @ self.noise.T
        else:
            drawn *= self.noise
        noise = drawn.reshape(trials, self.n, self.m)
        for output, dof in enumerate(self.dof.tolist()):
            if math.isfinite(dof) and (output == 0 or not self.joint):
                scale = np.sqrt(dof / self.rng.chisquare(dof, trials))[:, None]
                if self.joint:
                    return np.asarray(noise * scale[:, :, None])
                noise[:, :, output] *= scale
        return noise

    def _law(self, quantity: Quantity, shape: tuple[int, ...]) -> Array:
        u, rng = quantity.u, self.rng
        if quantity.distribution == "rectangular":
            return rng.uniform(-1.0, 1.0, shape) * (u * math.sqrt(3.0))
        if quantity.distribution == "triangular":
            return rng.triangular(-1.0, 0.0, 1.0, shape) * (u * math.sqrt(6.0))
        if quantity.distribution == "arcsine":
            return np.sin(rng.uniform(0.0, 2.0 * math.pi, shape)) * (u * math.sqrt(2.0))
        if math.isfinite(quantity.dof):
            return rng.standard_t(quantity.dof, shape) * u
        return rng.standard_normal(shape) * u


def _quantities_to_draw(c: Calibration) -> list[Quantity]:
    """Return what of the budget is drawn: all that the scatter does not contain already."""
    contained = {r.quantity for r in evaluate_budget(c).rows if r.contained.all()} - {"gravity"}
    contained |= c.estimator.unaffected_by
    return [q for q in find_quantities(c, read_budget(c.budget_tables)) if q.name not in contained]


def _noise_root(c: Calibration, covariance: Any) -> Array:
    """A root of the covariance of the readings: sds (n M,), or (n M, n M).

    The stated noise times the factor by which the residuals scaled it, or residual sds.
    """
    n, m = c.readings.values.shape
    gain = estimator_gain(c)
    noise = np.ones(n * m) if c.noise is None else c.noise
    if noise.ndim == 2:
        root = np.linalg.cholesky(noise)
        unscaled = gain @ root
    else:
        root = np.sqrt(noise)
        unscaled = gain * root
    stated_dof = np.sqrt(np.diag(covariance))
    plain = np.linalg.norm(unscaled, axis=1)
    factor = [float(median(stated_dof[part] / plain[part])) for part in c.model.slices]
    scale = np.tile(factor, n)
    return np.asarray(root * (scale[:, None] if root.ndim == 2 else scale))
