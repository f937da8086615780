"""The readings of a calibration as they might have been, drawn by the laws of its budget: `Draws`.

Every input quantity is drawn from its law and acts in full, not to first order: gravity scales the
force, level, orientation error and index turn it, voltmeter and temperature move the readings.

Noise estimated from residuals on ν degrees of freedom is drawn from Student's t (JCGM 101, 6.4.9),
as one scale for all readings of an output. Where orientations were uncertain or unknown, positions
are turned as well, and a table that is not level. What the fit knows of noise and turns is spread
over many sizes of each; drawn are those whose covariance by the gain G of the estimator,

    cov p = G (Σ a_i V_i) G',      V_i the noise of each output, the turns of each position and
                                   those that a label shares,                               (1)

gives U nearest to that of the fit, a_i ≥ 0, with one scale of Student's t for all of them.
"""

import math

import numpy as np

from multipos.errors import MultiposError
from multipos.estimation.gains import estimator_gain, restate
from multipos.estimation.problem import circle_basis
from multipos.numerics.arrays import Array, Places, median
from multipos.numerics.quantiles import coverage_factor
from multipos.numerics.rotations import directions
from multipos.positions.open_rolls import OpenRolls
from multipos.sensor.calibration import Calibration
from multipos.sensor.simulation import turned
from multipos.uncertainty.budgets import Quantity, read_budget
from multipos.uncertainty.propagation import evaluate_budget, find_quantities
from multipos.uncertainty.sensitivities import is_bounded, reading_moves, turn_axes, turn_readings


class Draws:
    """Readings as they might have been, all quantities of the budget drawn from their laws."""

    def __init__(self, c: Calibration, rng: np.random.Generator) -> None:
        self.c, self.rng = c, rng
        self.n, self.m = c.readings.values.shape
        budget = evaluate_budget(c)
        # all that the scatter does not contain already
        contained = {row.quantity for row in budget.rows if row.contained.all()} - {"gravity"}
        stated = find_quantities(c, read_budget(c.budget_tables))
        left_out = contained | c.estimator.unaffected_by
        self.quantities = [each for each in stated if each.name not in left_out]
        scatter = [row for row in budget.rows if row.quantity == "readings"]
        self.dof = budget.cleared.dof
        self.joint = len(scatter) == 1 and self.m > 1
        self.spread, self.level = np.zeros(self.n), 0.0
        self.attitude: Array | None = None
        self.rolls: OpenRolls | None = None
        self.label: Places | None = None
        variance = np.diag(np.asarray(sum(row.covariance for row in scatter)))
        gain, turns = estimator_gain(c), []
        if not c.estimator.exact:
            dof = float(median(c.dof_of_outputs))
            self.dof = np.full(self.m, dof)
            longer = np.divide(c.U, c.u, out=np.ones(len(c.u)), where=c.u > 0.0)
            variance = variance * (longer / coverage_factor(c.confidence, dof)) ** 2
            turns = self._turns(gain)
        self._size(gain, turns, variance)
        if np.isnan(self.noise).any() or not (self.dof > 0.0).all():
            raise MultiposError(
                "there are no residuals, so the noise that trials draw is unknown; state it, "
                "as with --reading-sd, or add positions."
            )

    def _size(self, gain: Array, turns: list[Array], variance: Array) -> None:
        """Give noise and turns the sizes by which they are nearest to variances, eq. (1)."""
        noise = _noise_root(self.c)
        together = noise.ndim == 2  # of correlated outputs
        by_noise = (gain @ noise if together else gain * noise) ** 2
        by_output = by_noise.reshape(len(gain), self.n, self.m).sum(axis=1).T
        parts = [by_output.sum(axis=0)] if together else [*by_output]
        sizes = np.sqrt(_nearest(np.stack([*parts, *turns]), variance))
        self.noise: Array = noise * (sizes[0] if together else np.tile(sizes[: self.m], self.n))
        own, *shared = sizes[len(parts) :] if turns else (0.0,)
        self.shared = (shared[0] if shared else 0.0) * self.spread
        self.spread, self.level = own * self.spread, own * self.level

    def _turns(self, gain: Array) -> list[Array]:
        """Return the variances (p,) by turns of each position, and by those that a label shares."""
        c, problem = self.c, restate(self.c)
        self.attitude, self.rolls, self.label = problem.attitude, problem.rolls, problem.label
        self.level = problem.level_sd
        if all(each.code != "inseparable" for each in c.findings):
            finite = np.isfinite(problem.orientation_sd)
            self.spread = np.where(finite, problem.orientation_sd, 0.0)
        # of own axes U holds where orientations are exact
        moves = np.degrees(turn_readings(c, np.broadcast_to(np.eye(3), (self.n, 3, 3))))
        moved = np.einsum("pnm,nma->pna", gain.reshape(-1, self.n, self.m), moves)
        moved = self._across(moved) * self.spread[:, None]
        own = (moved**2).sum(axis=(1, 2))
        if self.level and self.attitude is not None:
            axes = self.attitude[:, :, :2].transpose(0, 2, 1)
            moves = self.level * np.degrees(turn_readings(c, axes)).reshape(gain.shape[1], -1)
            own += ((gain @ moves) ** 2).sum(axis=1)
        if self.label is None or not problem.repeats:
            return [own]
        of_label = np.eye(self.label.max() + 1)[self.label]
        return [own, (np.einsum("pna,nl->pla", moved, of_label) ** 2).sum(axis=(1, 2))]

    def _across(self, turns: Array) -> Array:
        """Return turns (…, n, 3), those of rolls of open angle only across their circles."""
        if self.rolls is None:
            return turns
        rows = self.rolls.rows
        direction = directions(self.c.reference[rows])
        along = circle_basis(direction, self.rolls.vectors[rows])[:, :, 0]
        kept = turns.copy()
        kept[..., rows, :] = np.sum(turns[..., rows, :] * along, axis=-1, keepdims=True) * along
        return kept

    def __call__(self, trials: int) -> Array:
        """Return readings (trials, n, M) about the fitted model."""
        exact = self.c.estimator.exact  # else turns have the scale, too
        scale = np.ones((trials, self.m)) if exact else self._scales(trials)
        readings = self._acted(trials, scale)
        for quantity in self.quantities:
            if quantity.name in ("gain", "offset", "temperature", "stability"):
                moves = reading_moves(self.c, quantity)
                drawn = self._law(quantity, (trials, moves.shape[2]))
                readings = readings + np.einsum("nmq,tq->tnm", moves, drawn)
            elif quantity.name == "resolution":
                readings = readings + self._law(quantity, readings.shape)
        drawn = self.rng.standard_normal((trials, self.n * self.m))
        drawn = drawn @ self.noise.T if self.noise.ndim == 2 else drawn * self.noise
        noise = drawn.reshape(trials, self.n, self.m)
        noise *= (self._scales(trials) if exact else scale)[:, None]
        noise += readings
        return noise

    def _acted(self, trials: int, scale: Array) -> Array:
        """Return readings of the model at forces that may have acted, turned and scaled in full."""
        tilts = [q for q in self.quantities if q.name in ("level", "orientation", "index")]
        scaled, c = [q for q in self.quantities if q.name == "gravity"], self.c
        if not (tilts or scaled or self.spread.any() or self.shared.any() or self.level):
            fitted = c.model.predict(c.parameters, c.reference, c.readings.environment)
            return np.asarray(np.broadcast_to(fitted, (trials, self.n, self.m)))
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
        vectors += self._allowed(trials) * scale[:, :1, None]
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
        """Return turns of the positions (trials, n, 3) [rad] as the fit allows them."""
        turns = np.zeros((trials, self.n, 3))
        if self.spread.any():
            turns += self.rng.standard_normal(turns.shape) * self.spread[:, None]
        if self.label is not None and self.shared.any():
            drawn = self.rng.standard_normal((trials, self.label.max() + 1, 3))
            turns += drawn[:, self.label] * self.shared[:, None]
        turns = self._across(turns)
        if self.level and self.attitude is not None:
            tilt = self.level * self.rng.standard_normal((trials, 2))
            turns += np.einsum("tq,niq->tni", tilt, self.attitude[:, :, :2])
        return turns

    def _scales(self, trials: int) -> Array:
        """Return what makes Student's t (trials, M) of normal draws."""
        scales = np.ones((trials, self.m))
        for output, dof in enumerate(self.dof.tolist()):
            if self.joint and output:
                scales[:, output] = scales[:, 0]
            elif math.isfinite(dof):
                scales[:, output] = np.sqrt(dof / self.rng.chisquare(dof, trials))
        return scales

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


def _nearest(parts: Array, variance: Array) -> Array:
    """Return a ≥ 0 (k,) by which parts (k, p) are nearest to variances (p,), relatively."""
    if not np.isfinite(variance).all():
        return np.full(len(parts), math.nan)
    relative = (parts[:, variance > 0.0] / variance[variance > 0.0]).T
    kept = np.asarray(relative.any(axis=0))
    while True:
        sizes = np.zeros(len(parts))
        sizes[kept] = np.linalg.lstsq(relative[:, kept], np.ones(len(relative)), rcond=None)[0]
        if (sizes >= 0.0).all():
            return sizes
        kept = kept & (np.arange(len(parts)) != np.argmin(sizes))


def _noise_root(c: Calibration) -> Array:
    """Return a root of the covariance of readings: sds (n M,), or (n M, n M); its size is open."""
    if c.noise is None:
        sd = np.where(c.residual_sd > 0.0, c.residual_sd, 1.0)
        return np.tile(sd, len(c.readings))
    return np.asarray(np.sqrt(c.noise) if c.noise.ndim == 1 else np.linalg.cholesky(c.noise))
