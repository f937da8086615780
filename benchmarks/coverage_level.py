"""How often U holds the truth where a table leans that was stated to be level to so much.

A perfect sensor at attitudes even over all of them, which are known; a table that leans about its
two horizontal axes, by one normal draw a session of the standard deviation that the budget states;
normal noise. Printed are the mean coverage of all parameters and that of the worst, of U by the
residuals as they are with the level added in full, and by what `multipos` leaves of them; and the
length of U over 1.96 times what the errors are, the median over the parameters.
"""

import argparse
import warnings
from typing import Any, NamedTuple

import numpy as np

import multipos as mp
from multipos.numerics.quantiles import coverage_factor
from multipos.uncertainty.propagation import evaluate_budget, welch_satterthwaite

NORMAL = 1.959964  # 95 % of a noise that is known
Array = np.ndarray[Any, Any]


class Held(NamedTuple):
    """Which parameters U holds in every run, and how long it is."""

    inside: Array  # (runs, p)
    U: Array

    def shown(self, errors: Array) -> str:
        share = 100.0 * np.mean(self.inside, axis=0)
        size = NORMAL * np.sqrt(np.mean(errors**2, axis=0))
        length = np.median(self.U.mean(axis=0) / size)
        return f"{share.mean():.1f} | {share.min():.1f} | {length:.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.coverage_level")
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--positions", type=int, nargs="+", default=[12, 24, 48])
    parser.add_argument("--outputs", type=int, nargs="+", default=[1, 3])
    parser.add_argument("--levels", type=float, nargs="+", default=[0.01, 0.03, 0.1, 1.0])
    parser.add_argument("--noise", type=float, nargs="+", default=[30.0, 300.0], help="micro-g")
    parser.add_argument("--claim", type=float, help="state this much of the noise")
    chosen = parser.parse_args()
    warnings.simplefilter("ignore", mp.CalibrationWarning)
    print(
        "| positions | outputs | level | noise | as they are % | worst | U | left % | worst | U |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    rng = np.random.default_rng(chosen.seed)
    for n in chosen.positions:
        rotation = attitudes(n, rng)
        for outputs in chosen.outputs:
            for level in chosen.levels:
                for noise in chosen.noise:
                    one = (rotation, outputs, level, 1e-6 * noise, chosen.claim)
                    whole, left, errors = runs(rng, chosen.runs, *one)
                    print(
                        f"| {n} | {outputs} | {level:g}° | {noise:g} µg | "
                        f"{whole.shown(errors)} | {left.shown(errors)} |",
                        flush=True,
                    )


def attitudes(n: int, rng: np.random.Generator) -> Array:
    """Return rotations (n, 3, 3) from level to case, even over all of them."""
    Q, R = np.linalg.qr(rng.standard_normal((n, 3, 3)))
    Q = Q * np.sign(np.einsum("nii->ni", R))[:, None, :]
    return np.asarray(Q * np.linalg.det(Q)[:, None, None])


def runs(
    rng: np.random.Generator,
    count: int,
    rotation: Array,
    outputs: int,
    level: float,
    noise: float,
    claim: float | None,
) -> tuple[Held, Held, Array]:
    """Return what U holds without and with what is taken out, and the errors (runs, p)."""
    found = []
    stated = {} if claim is None else {"u": np.full((len(rotation), outputs), claim * noise)}
    for _ in range(count):
        east, north = np.radians(level) * rng.standard_normal(2)
        up = np.array([north, -east, 1.0]) / np.sqrt(1.0 + east**2 + north**2)
        values = (rotation @ up)[:, :outputs]
        values = values + noise * rng.standard_normal(values.shape)
        readings = mp.Readings(values, rotation=rotation, up=rotation[:, :, 2], unit="g", **stated)
        cal = mp.fit(readings, orientation_sd=0, exclude="none")
        budget = evaluate_budget(cal, {"level": {"u_deg": level}})
        added = np.diag(budget.rows[-1].covariance)
        nu = welch_satterthwaite(
            np.array([cal.u, np.sqrt(added)]),
            np.array([cal.parameter_dof, np.full(len(added), np.inf)]),
        )
        truth = [1.0 if name.startswith("scale") else 0.0 for name in cal.names]
        whole = expanded(cal.covariance.diagonal() + added, nu)
        left = expanded(budget.covariance.diagonal(), budget.dof)
        found.append((cal.parameters - truth, whole, left))
    errors, *U = (np.array(part) for part in zip(*found, strict=True))
    whole, left = (Held(np.abs(errors) <= each, each) for each in U)
    return whole, left, errors


def expanded(variance: Array, dof: Array) -> Array:
    """Return U (p,) at 95 %."""
    return np.sqrt(variance) * [coverage_factor(0.95, nu) for nu in dof.tolist()]


if __name__ == "__main__":
    main()
