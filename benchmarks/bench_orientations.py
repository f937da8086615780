"""Unknown and uncertain orientations against general solvers, and how they grow.

The peer fits what people fit by hand: the compensation in closed form, with z = T (y - b) and T
lower triangular, f = z + k z² by components, residuals |f| - 1 with their analytic Jacobian, and
MINPACK's Levenberg-Marquardt. Both start from the same ellipsoid.

*What a user writes* is the same without a Jacobian and without an ellipsoid: `least_squares` from
zero bias and unit matrix with `method="lm"`, and the covariance from its Jacobian. Beside it stands
the whole of `multipos.fit`, which also reads and checks, finds its start in any unit, has the noise
and its degrees of freedom, asks every finding and tests every term that the model lacks.
"""

import tracemalloc
import warnings
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

import multipos as mp
from benchmarks.timing import Ratio, paired_ratio
from multipos.estimation.descent import maximise
from multipos.estimation.problem import Problem, State, start_state
from multipos.estimation.starts import ellipsoid_start
from multipos.numerics.arrays import COMPONENTS
from multipos.positions.scheme import read_scheme
from multipos.sensor.model import build_model

Array = NDArray[np.float64]

NOISE = 1e-4  # [g]
MATRIX = np.array([[0.98, 0.0, 0.0], [0.01, 1.02, 0.0], [-0.02, 0.015, 1.01]])
BIAS = np.array([0.01, -0.02, 0.03])
QUADRATIC = np.array([1e-3, -2e-3, 5e-4])
LOWER = np.tril_indices(3)


def run() -> list[Ratio]:
    small, large = 24, 10_000
    return [
        Ratio(
            f"unknown orientation, {small} positions",
            "scipy least_squares lm",
            paired_ratio(ours(small), peer(small), repeats=15, inner=20),
            2,
        ),
        Ratio(
            f"unknown orientation, {large} positions",
            "scipy least_squares lm",
            paired_ratio(ours(large), peer(large), repeats=7, inner=1),
            1,
        ),
        Ratio(
            f"uncertain orientation, {small} positions",
            "unknown orientation",
            paired_ratio(ours(small, uncertain=True), ours(small), repeats=15, inner=20),
            3,
        ),
        Ratio(
            f"uncertain orientation, {large} positions",
            "unknown orientation",
            paired_ratio(ours(large, uncertain=True), ours(large), repeats=7, inner=1),
            3,
        ),
        growth(100, 100_000, goal=1),
        growth(1000, 100_000, goal=2),
        Ratio(
            "memory of a position of 100,000",
            "of one of 1,000",
            [peak_memory(ours(100_000)) / peak_memory(ours(1000)) / 100],
            1.5,
        ),
        Ratio(
            f"the whole fit, unknown orientation, {small} positions",
            "least_squares as a user writes it",
            paired_ratio(whole(small), written(small), repeats=15, inner=5),
            3,
        ),
        Ratio(
            f"the whole fit, unknown orientation, {large} positions",
            "least_squares as a user writes it",
            paired_ratio(whole(large), written(large), repeats=5, inner=1),
            1.5,
        ),
        *against_ceres(small, large),
    ]


def growth(few: int, many: int, *, goal: float) -> Ratio:
    """Return the time of a position among many over that of one among few."""
    pairs = paired_ratio(ours(many), ours(few), repeats=5, inner=1)
    return Ratio(
        f"a position of {many:,}", f"a position of {few:,}", [r * few / many for r in pairs], goal
    )


def simulate(n: int) -> tuple[Array, Array]:
    """Return up vectors and readings (n, 3)."""
    up = read_scheme(f"fibonacci-{n}").up
    noise = NOISE * np.random.default_rng(3).standard_normal((n, 3))
    return up, BIAS + up @ MATRIX.T + QUADRATIC * up**2 + noise


def ours(n: int, *, uncertain: bool = False) -> Callable[[], object]:
    problem, state = stated(n, uncertain)
    return lambda: maximise(problem, state)


def stated(n: int, uncertain: bool) -> tuple[Problem, State]:
    up, values = simulate(n)
    model = build_model("own-quadratic", ("ax", "ay", "az"), COMPONENTS)
    if not uncertain:
        model = model.with_gauge("lower")
    problem = Problem(
        model=model,
        values=values,
        environment={},
        precision=np.full((n, 3), NOISE**-2),
        reference=up,
        orientation_sd=np.full(n, np.radians(0.1) if uncertain else np.inf),
        group=np.full(n, -1),
        weight=np.ones(n),
    )
    bias, matrix = ellipsoid_start(values, 1.0, crossed=True)
    linear = np.column_stack([bias, matrix])
    columns = {"1": 0, "x": 1, "y": 2, "z": 3}
    theta = np.array(
        [
            linear[model.outputs.index(o), columns[str(t)]] if str(t) in columns else 0.0
            for o, t in model.keys
        ]
    )
    direction = np.linalg.solve(matrix, (values - bias).T).T
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    return problem, start_state(problem, theta, direction)


def peer(n: int) -> Callable[[], object]:
    _, values = simulate(n)
    start = natural_start(values)
    return lambda: least_squares(
        residuals,
        start,
        jac=jacobian,
        method="lm",
        args=(values,),
        xtol=1e-10,
        ftol=1e-10,
        gtol=1e-10,
    )


def whole(n: int) -> Callable[[], object]:
    _, values = simulate(n)

    def fit() -> object:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", mp.CalibrationWarning)
            readings = mp.Readings(values, unit="g")
            return mp.fit(readings, model="own-quadratic", unknown_orientation=True)

    return fit


def written(n: int) -> Callable[[], object]:
    _, values = simulate(n)
    start = np.concatenate([np.eye(3)[LOWER], np.zeros(6)])

    def fit() -> object:
        found = least_squares(residuals, start, method="lm", args=(values,))
        return found.x, np.linalg.inv(found.jac.T @ found.jac) * 2.0 * found.cost / (n - 12)

    return fit


def natural_start(values: Array) -> Array:
    bias, matrix = ellipsoid_start(values, 1.0, crossed=True)
    return np.concatenate([np.linalg.inv(matrix)[LOWER], bias, np.zeros(3)])


def compensate(p: Array, values: Array) -> tuple[Array, Array, Array, Array]:
    T = np.zeros((3, 3))
    T[LOWER] = p[:6]
    left = values - p[6:9]
    linear = left @ T.T
    return linear + p[9:] * linear**2, linear, left, T


def residuals(p: Array, values: Array) -> Array:
    return np.linalg.norm(compensate(p, values)[0], axis=1) - 1.0


def jacobian(p: Array, values: Array) -> Array:
    force, linear, left, T = compensate(p, values)
    unit = force / np.linalg.norm(force, axis=1)[:, None]
    through = unit * (1.0 + 2.0 * p[9:] * linear)
    return np.hstack([through[:, LOWER[0]] * left[:, LOWER[1]], -through @ T, unit * linear**2])


def peak_memory(work: Callable[[], object]) -> int:
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def against_ceres(*sizes: int) -> list[Ratio]:
    """Compare with Ceres through its Python bindings, where they are installed."""
    try:
        import pyceres
    except ImportError:
        print("pyceres is not installed: no comparison with Ceres")
        return []

    class Cost(pyceres.CostFunction):
        def __init__(self, values: Array) -> None:
            super().__init__()
            self.values = values
            self.set_num_residuals(len(values))
            self.set_parameter_block_sizes([12])

        def Evaluate(self, parameters, left, jacobians):  # noqa: N802
            left[:] = residuals(parameters[0], self.values)
            if jacobians is not None:
                jacobians[0][:] = jacobian(parameters[0], self.values).ravel()
            return True

    def solver(n: int) -> Callable[[], object]:
        _, values = simulate(n)
        options = pyceres.SolverOptions()
        options.logging_type = pyceres.LoggingType.SILENT
        options.function_tolerance = options.parameter_tolerance = 1e-10
        start = natural_start(values)

        def solve() -> None:
            found, problem = start.copy(), pyceres.Problem()
            problem.add_residual_block(Cost(values), None, [found])
            pyceres.solve(options, problem, pyceres.SolverSummary())

        return solve

    return [
        Ratio(
            f"unknown orientation, {n} positions",
            "Ceres (pyceres)",
            paired_ratio(ours(n), solver(n), repeats=7, inner=1),
            3,
        )
        for n in sizes
    ]
