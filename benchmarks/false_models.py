"""How often a regression calls a model significant that is none, and finds one that is there.

Four variables, first-order processes with one lag-1 correlation, stand in a table with a column of
time; the response is slow noise of sd 1 with white noise beside it, or white noise alone. Nothing
is there to find, or, in the last two columns, a slope of the first variable of 4.5 standard
deviations of the noise over the square root of the rows. Printed is the share of tables at 5 % in
which F, F_robust of the likeliest law of the noise alone, and F_robust of all plausible laws (F,
where `regress` gives none) call the model significant. Run by `python -m benchmarks.false_models`.
"""

import argparse
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray

import multipos as mp
from multipos.regression import cutting
from multipos.regression.whitening import Noise, find_noise

# name: correlation of the slow noise, its sd, sd of the white noise, correlation of the variables
CASES = {
    "white; fast variables": (0.0, 0.0, 1.0, 0.0),
    "white": (0.0, 0.0, 1.0, 0.9),
    ".5": (0.5, 1.0, 0.0, 0.5),
    ".9": (0.9, 1.0, 0.0, 0.9),
    ".99": (0.99, 1.0, 0.0, 0.99),
    ".9 + white .75": (0.9, 1.0, 0.75, 0.9),
    ".9 + white 3": (0.9, 1.0, 3.0, 0.9),
    ".95 + white .75": (0.95, 1.0, 0.75, 0.95),
    ".95 + white 1": (0.95, 1.0, 1.0, 0.95),
    ".99 + white .75": (0.99, 1.0, 0.75, 0.99),
    ".99 + white 3": (0.99, 1.0, 3.0, 0.99),
}
SLOPE = 4.5
LEVEL = 0.05


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.false_models", description=__doc__)
    parser.add_argument("--runs", type=int, default=250)
    parser.add_argument("--rows", type=int, nargs="+", default=[100, 200, 300])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--case", choices=CASES, nargs="+", default=list(CASES))
    chosen = parser.parse_args()
    print("| noise | rows | F | likeliest law | `F_robust` | a slope: F | `F_robust` |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for name in chosen.case:
        for n in chosen.rows:
            rng = np.random.default_rng([chosen.seed, n, list(CASES).index(name)])
            false = np.mean([judge(n, CASES[name], 0.0, rng) for _ in range(chosen.runs)], axis=0)
            true = np.mean(
                [judge(n, CASES[name], SLOPE, rng) for _ in range(chosen.runs // 5)], axis=0
            )
            cells = [f"{100.0 * share:.1f} %" for share in (*false, true[0], true[2])]
            print(f"| {name} | {n} | {' | '.join(cells)} |", flush=True)


def judge(
    n: int, case: tuple[float, float, float, float], slope: float, rng: np.random.Generator
) -> tuple[bool, bool, bool]:
    """Return whether F, the likeliest law and F_robust call the model of one table significant."""
    rho, sd, white, variables = case
    x = drift_factor(n, variables, rng, 4)
    y = sd * drift_factor(n, rho, rng, 1)[:, 0] + white * rng.standard_normal(n)
    y = y + slope * np.hypot(sd, white) / np.sqrt(n) * x[:, 0]
    table = {f"x{j}": x[:, j] for j in range(4)} | {"y": y, "time": np.arange(float(n))}
    told: list[Noise | None] = []

    def remember(*rows: Any) -> Noise | None:
        told.append(find_noise(*rows))
        return told[-1]

    def likeliest(*_: Any) -> Noise | None:
        (noise,) = told
        if noise is None:
            return None
        return noise._replace(plausible=() if noise.law is None else (noise.law,))

    with mock.patch.object(cutting, "find_noise", remember):
        significant, robust = regressed(table)
    with mock.patch.object(cutting, "find_noise", likeliest):
        return significant, regressed(table)[1], robust


def regressed(table: dict[str, NDArray[np.float64]]) -> tuple[bool, bool]:
    """Return whether F is significant, and F_robust where there is one."""
    found = mp.regress(table, response="y", variables="x0,x1,x2,x3")
    assert isinstance(found, mp.Regression)  # of one response
    (segment,) = found.segments
    robust = segment.robust
    return segment.significant, (segment.p if robust is None else robust.p) < LEVEL


def drift_factor(n: int, rho: float, rng: np.random.Generator, columns: int) -> NDArray[np.float64]:
    """Return columns of a stationary first-order process of unit variance."""
    found = rng.standard_normal((n, columns))
    for i in range(1, n):
        found[i] = rho * found[i - 1] + np.sqrt(1.0 - rho**2) * found[i]
    return found


if __name__ == "__main__":
    main()
