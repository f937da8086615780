"""How often U of a tumble holds the truth on benches whose turntable is off.

A triad makes a roll about z, y and x. On every roll each quantity of the table (zero of the
encoder, two harmonics of its circle, level and wobble of the shaft) is drawn anew from a normal
law, as the sensor's noise is. Printed is the share of benches on which U (95 %) holds the truth,
by coefficient: of the plain fit, of the fit beside the table, where that coefficient can be told,
and of a fit to which the bench was stated (`state_bench`).
"""

import argparse
import warnings
from collections import defaultdict

import numpy as np

import multipos as mp

TRUTH = {"K0": 1e-3, "K1": 1.3, "delta_o": 250e-6, "delta_p": -90e-6, "K2": 1e-5, "K3": 8e-6}
TRUTH |= {"Kip": 5e-6, "Kio": -4e-6, "Koq": -3e-6}
NOISE = 1e-6  # [g]
TABLE = 5e-6  # [rad], sd of every quantity of the table: one second of arc


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.coverage_tumble", description=__doc__
    )
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--steps", type=int, default=12)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    rng = np.random.default_rng(chosen.seed)
    warnings.simplefilter("ignore", mp.CalibrationWarning)  # a zero that shifts is no news here
    held: dict[str, dict[str, list[bool]]] = defaultdict(lambda: defaultdict(list))
    for _ in range(chosen.runs):
        for way, coefficients in one(chosen.steps, rng):
            for name, found in coefficients.items():
                held[name][way].append(abs(found.value - TRUTH[name]) <= found.U)
    ways = ("plain", "beside", "stated")
    print(f"| coefficient | {' | '.join(ways)} |\n|---|---|---|---|")
    for name in TRUTH:
        cells = [
            f"{100.0 * np.mean(held[name][way]):.1f}" if held[name][way] else "–" for way in ways
        ]
        print(f"| {name} | {' | '.join(cells)} |")


def one(steps: int, rng: np.random.Generator):
    """Yield the coefficients of each output of one bench, by each way."""
    scheme = mp.read_scheme("+".join(f"roll-{axis}-{steps}" for axis in "zyx"))
    values = sense(stand(steps, rng)) + TRUTH["K1"] * NOISE * rng.standard_normal((3 * steps, 3))
    found = mp.tumble(dict(zip(("ax", "ay", "az"), values.T, strict=True)), scheme=scheme)
    for output, tumble in found.outputs.items():
        yield "plain", tumble.coefficients
        yield "beside", found.beside_table.get(output, {})
    first = mp.fit(mp.Readings(values), scheme=scheme)
    sd = np.degrees(TABLE)
    known = mp.state_bench(
        first,
        reading_sd=TRUTH["K1"] * NOISE,
        offset_sd_deg=sd,
        first_sd_deg=sd,
        second_sd_deg=sd,
        level_sd_deg=sd,
        wobble_sd_deg=sd,
    )
    for tumble in mp.tumble(known).outputs.values():
        yield "stated", tumble.coefficients


def stand(steps: int, rng: np.random.Generator) -> np.ndarray:
    """Return where gravity really was (n, 3) on the three rolls."""
    t = 2.0 * np.pi * np.arange(steps) / steps
    waves = np.array([np.ones(steps), np.cos(t), np.sin(t), np.cos(2 * t), np.sin(2 * t)])
    rolls = []
    for shaft in (2, 1, 0):
        first, second = (i for i in range(3) if i != shaft)
        angle = t + TABLE * rng.standard_normal(5) @ waves
        along = TABLE * rng.standard_normal(3) @ waves[:3]
        up = np.zeros((steps, 3))
        up[:, first], up[:, second] = np.cos(angle) * np.cos(along), np.sin(angle) * np.cos(along)
        up[:, shaft] = np.sin(along)
        rolls.append(up)
    return np.concatenate(rolls)


def sense(up: np.ndarray) -> np.ndarray:
    """Return the outputs (n, 3), the model equation of the standard written out."""
    c = TRUTH
    outputs = []
    for axis in range(3):
        i, p, o = np.roll(up, -axis, axis=1).T
        E = c["K0"] + i + c["K2"] * i**2 + c["K3"] * i**3 + c["Koq"] * i * np.abs(i)
        E += c["Kip"] * i * p + c["Kio"] * i * o + c["delta_o"] * p - c["delta_p"] * o
        outputs.append(c["K1"] * E)
    return np.column_stack(outputs)


if __name__ == "__main__":
    main()
