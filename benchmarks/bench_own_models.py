"""User-defined models: against SciPy's least squares, and polynomials by name.

The saturating model of three outputs, b + s f/(1 + k f²), beside `scipy.optimize.least_squares` on
its nine parameters with finite differences, and a linear model written as a formula beside the
same by name. SciPy runs twice: told where to start, a few 1e-2 from the truth, for nothing but the
parameters; and for what `fit` is asked for, from no start, with slopes that scale themselves, the
scatter of every output and u. Nobody tells `fit` a start, and it also finds outliers, tests the
terms that the model lacks and asks what does not look right.
"""

import numpy as np
from scipy.optimize import least_squares

import multipos as mp
from benchmarks.timing import Ratio, paired_ratio

TRUTH = np.array([[0.02, 1.01, 0.03], [0.01, 0.99, 0.02], [-0.03, 1.02, 0.05]])
SATURATING = "each = b + s*own/(1 + k*own^2)"
LINEAR = "each = a + p*x + q*y + r*z"


def run() -> list[Ratio]:
    goals = ((24, 2.0, 2.0), (1000, 2.5, 1.0))
    return [ratio for n, told, goal in goals for ratio in ratios(n, told, goal)]


def ratios(n: int, goal_told: float, goal: float) -> list[Ratio]:
    up = mp.read_scheme(f"fibonacci-{n}").up
    b, s, k = TRUTH.T
    noise = 1e-4 * np.random.default_rng(1).standard_normal((n, 3))
    values = b + s * up / (1 + k * up**2) + noise
    readings = mp.Readings(values, up=up)

    def left(p: np.ndarray) -> np.ndarray:
        b, s, k = p.reshape(3, 3).T
        return np.ravel(b + s * up / (1 + k * up**2) - values)

    def told() -> object:
        return least_squares(left, np.tile([0.0, 1.0, 0.0], 3))

    def with_u() -> object:
        found = least_squares(left, np.zeros(9), x_scale="jac")
        scatter = np.sum(found.fun.reshape(n, 3) ** 2, axis=0) / (n - 3)
        slopes = [found.jac[i::3, 3 * i : 3 * i + 3] for i in range(3)]
        covariances = [s * np.linalg.inv(A.T @ A) for s, A in zip(scatter, slopes, strict=True)]
        return found.x, np.sqrt([np.diag(covariance) for covariance in covariances])

    def own() -> object:
        return mp.fit(readings, model=SATURATING, orientation_sd=0)

    named = paired_ratio(
        lambda: mp.fit(readings, model=LINEAR, orientation_sd=0),
        lambda: mp.fit(readings, model="linear", orientation_sd=0),
    )
    what, peer = f"fit of a formula, {n} readings", "scipy.optimize.least_squares"
    return [
        Ratio(what, f"{peer}, told its start", paired_ratio(own, told), goal_told),
        Ratio(what, f"{peer}, no start, with u", paired_ratio(own, with_u), goal),
        Ratio(f"linear as a formula, {n} readings", "fit, linear", named, 5),
    ]
