"""Profiles of a model of one's own at known orientations, with exact second derivatives.

With residuals r_k = y_k − h_k(p), weights w_k of the fit and priors b about m, a parameter is held
at t and

    S(p) = Σ w_k r_k² + Σ b_j (p_j − m_j)²,                                                  (1)

is made least over the others by Newton's iteration, with half the gradient and half the curvature

    g = −Σ w_k r_k a_k + b (p − m),      H = Σ w_k (a_k a_k' − r_k ∂²h_k/∂p²) + diag(b),      (2)

a = ∂h/∂p. The term of second derivatives is what Gauss and Newton leave out; far from the estimate,
where an interval ends, residuals are no longer small. Where H is not positive definite that
term is left out for the step.
"""

import numpy as np

from multipos.numerics.arrays import Array
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.inverse import parameter_jacobian

_STEPS = 50
_FLAT = 1e-12  # of S, from which on a step takes nothing off


class OwnProfile:
    """S of eq. (1) with one parameter held: called with its value, the rise over the least S."""

    def __init__(self, c: Calibration, index: int, sd: Array) -> None:
        assert isinstance(c.model, ExpressionModel)
        self.c, self.model, self.index = c, c.model, index
        self.weight = 1.0 / np.broadcast_to(sd, c.residuals.shape) ** 2
        self.others = np.arange(len(c.parameters)) != index
        self.best = c.parameters
        g, H, self.least = self._at(self.best)
        self.slope = np.zeros(len(g))  # how the others follow the parameter
        self.slope[index] = 1.0
        self.slope[self.others] = -np.linalg.solve(
            H[np.ix_(self.others, self.others)], H[self.others, index]
        )

    def __call__(self, value: float) -> float:
        """Return the rise of S where the parameter has a value."""
        p = self.best + (value - self.best[self.index]) * self.slope
        g, H, S = self._at(p)
        for _ in range(_STEPS):
            step = np.zeros(len(p))
            if self.others.any():
                step[self.others] = -np.linalg.solve(
                    H[np.ix_(self.others, self.others)], g[self.others]
                )
            fall = -2.0 * float(g @ step)
            trial = self._at(p + step)
            while trial[2] > S and fall > _FLAT * S:  # too long: shorter, until it is lower
                step, fall = step / 2.0, fall / 2.0
                trial = self._at(p + step)
            if fall <= _FLAT * S:
                break
            p = p + step
            g, H, S = trial
        return S - self.least

    def _at(self, p: Array) -> tuple[Array, Array, float]:
        """Return g and H of eq. (2), and S."""
        c = self.c
        environment = c.readings.environment
        r = c.readings.values - self.model.predict(p, c.reference, environment)
        A = parameter_jacobian(self.model, p, c.reference, environment)
        bend = self.model.second_derivatives(p, c.reference, environment)
        excess, slope = self.model.belief(p)
        wr = self.weight * r
        g = -np.einsum("nm,nmp->p", wr, A) + slope * excess
        plain = np.einsum("nmp,nm,nmq->pq", A, self.weight, A) + np.diag(slope**2)
        H = plain - np.einsum("nm,nmpq->pq", wr, bend)
        inner = H[np.ix_(self.others, self.others)]
        if inner.size and np.linalg.eigvalsh(inner)[0] <= 0.0:
            H = plain
        return g, H, float(np.sum(wr * r)) + float(excess @ excess)
