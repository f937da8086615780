"""Does a state pay? Lag and hysteresis fitted with the terms, against rates.

The chamber is that of `benchmarks.chamber_run`, as it is and once more with a
sensor that does have states: an element whose bias follows its own temperature s, behind the
case by 15 min, and a hysteresis h of 1 mg. The state model replaces rates by

    s_k = (s_{k-1} + T_k dt/tau)/(1 + dt/tau),                                              (1)
    h_k = (h_{k-1} + dT/w)/(1 + |dT|/w),         dT = T_k − T_{k-1},                        (2)

a first-order lag and Dahl's friction of width w. Terms are all products of at most two of V, T,
T − s, ambient (and h), in the segments of the study, and tau, w and all coefficients are one
least-squares problem: CasADi gives the recursion and its derivatives, Gauss and Newton's steps do
the rest. Every model is fitted to the first run (or to five, with a zero for each) and judged on
eight that it has not seen. Run by `python -m benchmarks.temperature_state`.
"""

from collections.abc import Callable
from itertools import combinations_with_replacement
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

import multipos as mp
from benchmarks import chamber_run

Array = NDArray[np.float64]
Run = dict[str, Array]

EDGES = (-20.0, 20.0)
UNSEEN = range(9000, 9008)
LAG, WIDTH = 6.0, 15.0  # [min], [degC]: where the search starts


def with_states(run: Run) -> Run:
    """Return a run of a sensor with lag and hysteresis beside what it does."""
    T, dt = run["temperature"], np.diff(run["time"], prepend=run["time"][0])
    s, h = np.empty_like(T), np.zeros_like(T)
    s[0] = T[0]
    for k in range(1, len(T)):
        s[k] = (s[k - 1] + T[k] * dt[k] / 15.0) / (1.0 + dt[k] / 15.0)
        move = (T[k] - T[k - 1]) / 10.0
        h[k] = (h[k - 1] + move) / (1.0 + abs(move))
    added = 0.4e-3 * (s - T) + 1e-3 * h
    return run | {"V": run["V"] + added, "error": run["error"] + added}


def states(runs: list[Run], hysteresis: bool) -> casadi.Function:
    """Return (tau, w) to the states of all rows, eqs. (1), (2)."""
    p, before, row = casadi.SX.sym("p", 2), casadi.SX.sym("x", 2), casadi.SX.sym("r", 3)
    T, dt, dT = row[0], row[1], row[2]
    lag = (before[0] + T * dt / p[0]) / (1.0 + dt / p[0])
    turn = (before[1] + dT / p[1]) / (1.0 + casadi.fabs(dT) / p[1]) if hysteresis else 0.0
    step = casadi.Function("step", [before, row, p], [casadi.vertcat(lag, turn)])
    parameters, found = casadi.MX.sym("p", 2), []
    for run in runs:
        T_of, time = run["temperature"], run["time"]
        rows = np.array([T_of, np.diff(time, prepend=time[0]), np.diff(T_of, prepend=T_of[0])])
        n = len(time)
        start = casadi.DM([T_of[0], 0.0])
        walk = step.mapaccum("walk", n)
        found.append(walk(start, rows, casadi.repmat(parameters, 1, n)))
    whole = casadi.horzcat(*found)
    slopes = [casadi.jacobian(whole[i, :], parameters) for i in (0, 1)]
    return casadi.Function("states", [parameters], [whole, *slopes])


def design(runs: list[Run], x: Array, hysteresis: bool) -> tuple[Array, Array, Array]:
    """Return the columns of all terms, and their slopes by both states."""
    one = {name: np.concatenate([run[name] for run in runs]) for name in runs[0]}
    T = one["temperature"]
    quantities = [one["V"], T / 50.0, (T - x[0]) / 5.0, one["ambient"] / 50.0]
    by_lag = [np.zeros_like(T), np.zeros_like(T), np.full_like(T, -0.2), np.zeros_like(T)]
    by_turn = [np.zeros_like(T)] * 4
    if hysteresis:
        quantities, by_lag = [*quantities, x[1]], [*by_lag, np.zeros_like(T)]
        by_turn = [*by_turn, np.ones_like(T)]
    columns, lags, turns = [np.ones_like(T)], [np.zeros_like(T)], [np.zeros_like(T)]
    for k in range(len(quantities)):
        columns.append(quantities[k])
        lags.append(by_lag[k])
        turns.append(by_turn[k])
    for i, j in combinations_with_replacement(range(len(quantities)), 2):
        a, b = quantities[i], quantities[j]
        columns.append(a * b)
        lags.append(by_lag[i] * b + a * by_lag[j])
        turns.append(by_turn[i] * b + a * by_turn[j])
    where = np.digitize(T, EDGES)
    inside = [(where == k)[:, None] for k in range(len(EDGES) + 1)]
    zeros = np.repeat(np.arange(len(runs)), [len(run["time"]) for run in runs])
    # a zero for each run about the mean of all, which is what an unseen run is given
    own = (zeros[:, None] == np.arange(1, len(runs))) - 1.0 / len(runs)
    X, L, H = (
        np.hstack([np.column_stack(c) * rows for rows in inside]) for c in (columns, lags, turns)
    )
    none = np.zeros_like(own)
    return np.hstack([X, own]), np.hstack([L, none]), np.hstack([H, none])


def fit_states(runs: list[Run], hysteresis: bool) -> tuple[Array, Array]:
    """Return coefficients and (tau, w), by steps of Gauss and Newton on both together."""
    walk = states(runs, hysteresis)
    y = np.concatenate([run["error"] for run in runs])
    p, damping, best = np.array([LAG, WIDTH]), 1e-3, np.inf
    theta = np.zeros(0)
    for _ in range(60):
        x, by_lag, by_turn = (np.asarray(part) for part in walk(p))
        X, L, H = design(runs, x, hysteresis)
        theta = np.linalg.lstsq(X, y, rcond=1e-10)[0]  # the coefficients follow at once
        left = y - X @ theta
        slopes = (L @ theta)[:, None] * by_lag + (H @ theta)[:, None] * by_turn
        slopes = slopes[:, : 1 + hysteresis] * p[: 1 + hysteresis]  # of ln tau, ln w
        Q = np.linalg.qr(X)[0]
        inner = slopes - Q @ (Q.T @ slopes)
        normal = inner.T @ inner
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), inner.T @ left)
        total = float(left @ left)
        if abs(best - total) < 1e-10 * total:
            break
        damping = damping * 0.3 if total < best else damping * 10.0
        best = min(best, total)
        p = p * np.append(np.exp(np.clip(step, -0.5, 0.5)), np.ones(1 - hysteresis))
    return theta, p


def left_by_states(theta: Array, p: Array, run: Run, hysteresis: bool) -> Array:
    x = np.asarray(states([run], hysteresis)(p)[0])
    X = design([run], x, hysteresis)[0]
    return np.asarray(run["error"] - X @ theta[: X.shape[1]])


def joined(runs: list[Run]) -> Run:
    columns = {name: np.concatenate([run[name] for run in runs]) for name in runs[0]}
    return columns | {"run": np.repeat(np.arange(len(runs)), [len(run["time"]) for run in runs])}


def left_by_regression(runs: list[Run], run: list[Run], **more: Any) -> list[Array]:
    options: dict[str, Any] = {
        "response": "error",
        "degree": 2,
        "rate_window": 5,
        "causal": True,
        "segment": "temperature:-20,20",
        "variables": "V,temperature,temperature_rate,ambient,ambient_rate",
    } | more
    if len(runs) > 1:
        options["run"] = "run"
    found = mp.regress(joined(runs), **options)
    return [np.asarray(mp.correct(found, one)["corrected"]) for one in run]


def figures(left: list[Array]) -> str:
    rms = [1e3 * float(np.sqrt(np.mean(one**2))) for one in left]
    apart = [1e3 * float(np.std(one)) for one in left]
    return f"{np.mean(rms):.3f} {np.max(rms):.3f} {np.mean(apart):.3f}"


def main() -> None:
    kinds: dict[str, Callable[[Run], Run]] = {"the page's sensor": lambda run: run}
    kinds["one with lag and hysteresis"] = with_states
    print("error on unseen runs [mg]: rms, that of the worst run, rms about each run's own mean")
    for name, changed in kinds.items():
        unseen = [changed(chamber_run.run(seed)) for seed in UNSEEN]
        for count in (1, 5):
            runs = [changed(chamber_run.run(seed)) for seed in range(100, 100 + count)]
            print(f"\n{name}, fitted to {count}")
            print(
                "  rates, stepwise     ", figures(left_by_regression(runs, unseen, stepwise=True))
            )
            print("  rates, all terms    ", figures(left_by_regression(runs, unseen)))
            for hysteresis in (False, True):
                theta, p = fit_states(runs, hysteresis)
                left = [left_by_states(theta, p, run, hysteresis) for run in unseen]
                said = f"tau {p[0]:.2f} min" + (f", w {p[1]:.1f} degC" if hysteresis else "")
                label = "lag and hysteresis" if hysteresis else "lag"
                print(f"  state: {label:<14}", figures(left), f"({said})")


if __name__ == "__main__":
    main()
