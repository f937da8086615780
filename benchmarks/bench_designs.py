"""Optimal schemes against a conic programme and a coordinate exchange that do the same.

Both peers are optional: without cvxpy or pyoptex its row is left out, with a word on stderr.
"""

import contextlib
import io
import sys
import time
import warnings
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from benchmarks.timing import Ratio, paired_ratio
from multipos.designs.criteria import Criterion, kernels, objective, sensitivity
from multipos.designs.exchange import choose
from multipos.designs.information import Blocks, inform, make_setting
from multipos.designs.optimum import optimise_candidates
from multipos.positions.benches import read_bench
from multipos.positions.scheme import read_scheme
from multipos.sensor.model import build_model

MODEL = build_model("own-quadratic", ("ax", "ay", "az"), ("x", "y", "z"))
SETTING = make_setting(MODEL)
D = Criterion("D")
GAP = 1e-5  # that the conic solver reaches at its tightest settings; ours goes on to 1e-7
STARTS = 10


def run() -> list[Ratio]:
    ratios = []
    for peer in (against_cvxpy, against_pyoptex):
        try:
            ratios.append(peer())
        except ImportError as error:
            print(f"left out: {error}", file=sys.stderr)
    return [*ratios, growth()]


def against_cvxpy() -> Ratio:
    import cvxpy as cp

    rows = SETTING.rows(read_scheme("fibonacci-1000").up)

    def programme() -> NDArray[np.float64]:
        w = cp.Variable(1000, nonneg=True)
        parts = []
        for Z in rows:
            X = Z[:, 0]
            p = X.shape[1]
            products = np.einsum("ni,nj->ijn", X, X).reshape(p * p, -1)
            parts.append(cp.log_det(cp.reshape(products @ w, (p, p), order="C")))
        problem = cp.Problem(cp.Maximize(sum(parts)), [cp.sum(w) == 1])
        problem.solve(solver=cp.CLARABEL, tol_gap_abs=1e-10, tol_gap_rel=1e-10)
        return np.asarray(w.value)

    reached = gap(rows, programme())
    assert reached < GAP, reached
    assert optimise_candidates(rows, D).gap < GAP
    pairs = paired_ratio(lambda: optimise_candidates(rows, D), programme, repeats=9, inner=2)
    return Ratio("D-optimum on 1000 candidates", "cvxpy, Clarabel", pairs, 0.2)


def gap(rows: Blocks, weights: NDArray[np.float64]) -> float:
    w = np.maximum(weights, 0.0)
    information = inform(rows, w / w.sum())
    return float(sensitivity(rows, kernels(information, D)).max()) - 1.0


def against_pyoptex() -> Ratio:
    exchange = pyoptex_exchange()
    rows = SETTING.rows(read_bench("two-axis-15"))

    def ours() -> float:
        rng = np.random.default_rng(0)
        return choose(rows, 14, D, starts=STARTS, rng=rng)[0][0]

    theirs, mine = exchange(), ours()
    assert mine >= theirs - 1e-9, (mine, theirs)
    pairs = paired_ratio(ours, exchange, repeats=5, inner=1)
    return Ratio("14 positions, 10 starts", "pyoptex, coordinate exchange", pairs, 0.2)


def pyoptex_exchange() -> Callable[[], float]:
    """Return the same search in pyoptex: tilt and roll in steps of 15 degrees, three outputs."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from pyoptex.doe.fixed_structure import (
            Factor,
            create_fixed_structure_design,
            create_parameters,
            default_fn,
        )
        from pyoptex.doe.fixed_structure.metric import Dopt

    def model_matrix(Y: NDArray[np.float64]) -> NDArray[np.float64]:
        tilt, roll = np.pi / 2 * (1.0 + Y[:, 0]), np.pi * (1.0 + Y[:, 1])
        x, y, z = np.sin(tilt) * np.cos(roll), np.sin(tilt) * np.sin(roll), np.cos(tilt)
        return np.column_stack([np.ones(len(Y)), x, y, z, x * x, y * y])

    # the columns of each output; pyoptex refuses dependent ones, so z² is 1 − x² − y²
    outputs = np.zeros((3, 6, 5))
    outputs[:, :4, :4] = np.eye(4)
    outputs[0, 4, 4] = outputs[1, 5, 4] = outputs[2, 0, 4] = 1.0
    outputs[2, 4, 4] = outputs[2, 5, 4] = -1.0

    class AllOutputs(Dopt):
        def call(self, Y, X, params):
            parts = np.linalg.det(outputs.transpose(0, 2, 1) @ (X.T @ X / len(X)) @ outputs)
            return float(np.prod(np.maximum(parts, 0.0)) ** (1 / 15))

    factors = [
        Factor("tilt", type="continuous", min=-1, max=1, levels=np.linspace(-1, 1, 13)),
        Factor("roll", type="continuous", min=-1, max=1, levels=np.linspace(-1, 1, 25)[:-1]),
    ]

    def search() -> float:
        with contextlib.redirect_stderr(io.StringIO()):
            functions = default_fn(factors, AllOutputs(), model_matrix)
            parameters = create_parameters(factors, functions, 14)
            _, state = create_fixed_structure_design(parameters, n_tries=STARTS)
        return float(np.log(state.metric))

    return search


def growth() -> Ratio:
    """A hundred times the candidates, per candidate: at most what one of a few costs."""
    few = SETTING.rows(read_scheme("fibonacci-1000").up)
    many = SETTING.rows(read_scheme("fibonacci-100000").up)
    pairs = []
    for _ in range(7):
        times = []
        for rows in (many, few):
            start = time.perf_counter()
            optimise_candidates(rows, D)
            times.append(time.perf_counter() - start)
        pairs.append(times[0] / times[1] / 100.0)
    assert objective(inform(few), D) < 0.0
    return Ratio("100,000 candidates, each", "one of 1000", pairs, 1.0)
