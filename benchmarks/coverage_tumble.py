"""How often U of a tumble holds the truth on benches whose turntable is off.

A triad makes a roll about z, y and x. On every roll each quantity of the table (zero of the
encoder, two harmonics of its circle, level and wobble of the shaft), or those of one `--kind`, is
drawn anew from a normal law, as the sensor's noise is. Printed is the share of benches on which U
(95 %) holds the truth, by coefficient: of the plain fit, of what `tumble` gives, of a fit to which
the bench was stated (`state_bench`), and of what `tumble` gives where the circle is one for all
rolls, the angle of the head is in the file and a fourth roll, about z, goes round the other way.
Behind it, on how many of three outputs of all benches a U was given.
"""

import argparse
import warnings
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np

import multipos as mp
from multipos.verification.coefficients import fitted_coefficients

TRUTH = {"K0": 1e-3, "K1": 1.3, "delta_o": 250e-6, "delta_p": -90e-6, "K2": 1e-5, "K3": 8e-6}
TRUTH |= {"Kip": 5e-6, "Kio": -4e-6, "Koq": -3e-6}
NOISE = 1e-6  # [g]
TABLE = 5e-6  # [rad], sd of every quantity of the table: one second of arc
KINDS = {"zero": [0], "first": [1, 2], "second": [3, 4], "level": [5], "wobble": [6, 7]}
WAYS = ("plain", "given", "stated", "head")


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.coverage_tumble", description=__doc__
    )
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--steps", type=int, default=12)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kind", choices=KINDS, default=None)
    parser.add_argument("--ways", choices=WAYS, nargs="+", default=WAYS)
    chosen = parser.parse_args()
    rng = np.random.default_rng(chosen.seed)
    warnings.simplefilter("ignore", mp.CalibrationWarning)  # a zero that shifts is no news here
    sd = np.zeros(8)
    sd[list(range(8)) if chosen.kind is None else KINDS[chosen.kind]] = TABLE
    held: dict[str, dict[str, list[bool]]] = defaultdict(lambda: defaultdict(list))
    for _ in range(chosen.runs):
        for way, coefficients in one(chosen.steps, sd, chosen.ways, rng):
            for name, found in coefficients.items():
                if np.isfinite(found.U):
                    held[name][way].append(abs(found.value - TRUTH[name]) <= found.U)
    print(f"| coefficient | {' | '.join(chosen.ways)} |\n|---|{'---|' * len(chosen.ways)}")
    for name in TRUTH:
        cells = []
        for way in chosen.ways:
            each = held[name][way]
            share = 100.0 * len(each) / (3 * chosen.runs)
            cells.append(f"{100.0 * np.mean(each):.1f} ({share:.0f} %)" if each else "–")
        print(f"| {name} | {' | '.join(cells)} |")


def one(steps: int, sd: np.ndarray, ways: Sequence[str], rng: np.random.Generator):
    """Yield the coefficients of each output of one bench, by each way."""
    rolls = [("z", 1.0), ("y", 1.0), ("x", 1.0)]
    if {"plain", "given", "stated"} & set(ways):
        drawn = [sd * rng.standard_normal(8) for _ in rolls]
        table = readings(rolls, drawn, steps, rng)
        del table["head_deg"]
        for tumble in mp.tumble(table, model="ieee-odd").outputs.values():
            yield "plain", fitted_coefficients(tumble.calibration, tumble.calibration.model.axes[0])
            yield "given", tumble.coefficients
        if "stated" in ways:
            first = mp.fit(table, orientation_sd=0, exclude="none")
            zero, circle, second, level, wobble = np.degrees(sd[[0, 1, 3, 5, 6]]).tolist()
            known = mp.state_bench(
                first,
                reading_sd=TRUTH["K1"] * NOISE,
                offset_sd_deg=zero,
                first_sd_deg=circle,
                second_sd_deg=second,
                level_sd_deg=level,
                wobble_sd_deg=wobble,
            )
            for tumble in mp.tumble(known, model="ieee-odd").outputs.values():
                yield "stated", tumble.coefficients
    if "head" in ways:
        rolls = [*rolls, ("z", -1.0)]
        drawn = [sd * rng.standard_normal(8) for _ in rolls]
        for each in drawn:
            each[1:5] = drawn[0][1:5]  # one circle
        table = readings(rolls, drawn, steps, rng)
        for tumble in mp.tumble(table, model="ieee-odd").outputs.values():
            yield "head", tumble.coefficients


def readings(
    rolls: Sequence[tuple[str, float]],
    drawn: Sequence[np.ndarray],
    steps: int,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Return a table of rolls about axes, one way or the other, on a bench that is so far off."""
    head = 2.0 * np.pi * np.arange(steps) / steps
    waves = [np.ones(steps), np.cos(head), np.sin(head), np.cos(2 * head), np.sin(2 * head)]
    columns: dict[str, Any] = {"roll_axis": [], "angle_deg": [], "head_deg": []}
    stood = []
    for (axis, way), off in zip(rolls, drawn, strict=True):
        shaft = "xyz".index(axis)
        first, second = (i for i in range(3) if i != shaft)
        angle = way * (head + off[1:5] @ waves[1:]) + off[0]
        along = off[5:] @ waves[:3]
        up = np.zeros((steps, 3))
        up[:, first], up[:, second] = np.cos(angle) * np.cos(along), np.sin(angle) * np.cos(along)
        up[:, shaft] = np.sin(along)
        stood.append(up)
        columns["roll_axis"] += [axis] * steps
        columns["angle_deg"] += np.degrees(way * head).tolist()
        columns["head_deg"] += np.degrees(head).tolist()
    values = sense(np.concatenate(stood))
    values += TRUTH["K1"] * NOISE * rng.standard_normal(values.shape)
    return columns | dict(zip(("ax", "ay", "az"), values.T, strict=True))


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
