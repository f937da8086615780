"""Choosing terms, against one least-squares solve of the full model."""

import numpy as np

from benchmarks.timing import Ratio, paired_ratio
from multipos.fitting.regress_columns import regress
from multipos.numerics.least_squares import solve
from multipos.numerics.selection import Thresholds, compress, select_stepwise


def run() -> list[Ratio]:
    rng = np.random.default_rng(1)
    return [stepwise(rng), whole_command(rng)]


def stepwise(rng: np.random.Generator) -> Ratio:
    X = np.column_stack((np.ones(1_000_000), rng.standard_normal((1_000_000, 20))))
    y = X[:, [2, 5, 9, 14]].sum(axis=1) + rng.standard_normal(1_000_000)
    names = [str(j) for j in range(21)]

    def choose() -> None:
        found = select_stepwise(compress(X, y), names, Thresholds(), forced=[0])
        solve(X[:, list(found.columns)], y)

    pairs = paired_ratio(choose, lambda: solve(X, y), repeats=3, inner=1)
    return Ratio("stepwise, 21 terms, 1,000,000 rows", "one solve of the full model", pairs, 10)


def whole_command(rng: np.random.Generator) -> Ratio:
    columns = {name: rng.standard_normal(200_000) for name in "abcde"}
    columns["y"] = columns["a"] * columns["b"] + columns["c"] + rng.standard_normal(200_000)
    columns["time"] = np.arange(200_000.0)
    X = rng.standard_normal((200_000, 21))

    def ours() -> None:
        regress(columns, response="y", variables="a,b,c,d,e", degree=2, stepwise=True)

    pairs = paired_ratio(ours, lambda: solve(X, columns["y"]), repeats=3, inner=1)
    return Ratio("regress, 21 terms, 200,000 rows", "one solve of the full model", pairs, 10)
