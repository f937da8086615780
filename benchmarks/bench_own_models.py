"""Time of models of one's own: against polynomials written both ways, and against SciPy.

    python benchmarks/bench_own_models.py

The saturating model of three outputs, b + s f/(1 + k f²), by `mp.fit` and by one call of
`scipy.optimize.least_squares` on its nine parameters with finite differences; and a linear model by
name and as a formula. Processor time, medians of repeats: `fit` also weighs, tests and describes
what it found.
"""

import statistics
import time
from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

import multipos as mp

REPEATS = 25
TRUTH = np.array([[0.02, 1.01, 0.03], [0.01, 0.99, 0.02], [-0.03, 1.02, 0.05]])
SATURATING = "each = b + s*own/(1 + k*own^2)"
LINEAR = "each = a + p*x + q*y + r*z"


def seconds(run: Callable[[], object]) -> float:
    """Return the median time of a call that was made once before."""
    run()
    taken = []
    for _ in range(REPEATS):
        start = time.process_time()
        run()
        taken.append(time.process_time() - start)
    return statistics.median(taken)


def main() -> None:
    """Print a line for each number of readings."""
    print("readings   own [ms]   SciPy [ms]  ratio    linear as formula [ms]  by name [ms]  ratio")
    for n in (24, 1000):
        up = mp.read_scheme(f"fibonacci-{n}").up
        noise = 1e-4 * np.random.default_rng(1).standard_normal((n, 3))
        b, s, k = TRUTH.T
        values = b + s * up / (1 + k * up**2) + noise
        data = mp.Readings(values, up=up)

        def left(p: np.ndarray, values: np.ndarray = values, up: np.ndarray = up) -> np.ndarray:
            b, s, k = p.reshape(3, 3).T
            return (b + s * up / (1 + k * up**2) - values).ravel()

        def by_scipy(left: Callable[[np.ndarray], np.ndarray] = left) -> object:
            return least_squares(left, np.tile([0.0, 1.0, 0.0], 3))

        own = seconds(lambda data=data: mp.fit(data, model=SATURATING))
        scipy = seconds(by_scipy)
        formula = seconds(lambda data=data: mp.fit(data, model=LINEAR))
        named = seconds(lambda data=data: mp.fit(data, model="linear"))
        print(
            f"{n:8d} {1e3 * own:10.1f} {1e3 * scipy:12.1f} {own / scipy:6.2f} "
            f"{1e3 * formula:25.1f} {1e3 * named:13.1f} {formula / named:6.2f}"
        )


if __name__ == "__main__":
    main()
