"""How often a good calibration is called implausible, and how often a grossly wrong one is not.

Good calibrations are drawn in wide variety: six to 52 positions, one to three outputs, in g, m/s²,
counts with offsets or the volts of an inclinometer, bias to .5 g, scale ±50 %, misalignment to
10°, chips turned in their case, placement to 2°, quantised readings, second and third order to a
few mg, and in every second set one true outlier to half a g; fitted as `linear`, `own-quadratic` or
`own-cubic`, with orientations known, uncertain and unknown. Absurdities are planted one by one in
good sets of orientations known; found is one that is called implausible at all, or refused with
an error, named one that has a code whose repair explains the data.

Some gross errors are the same data as something else: on six faces a converter that wraps both ends
of two outputs gives what a sensor turned by 180° gives. An oracle that knows the noise tells which,
by least squares of its own over other readings of the data: as they are, with two rows
interchanged, with one row upside down. What a plausible sensor explains as it is, within the noise,
cannot be told, and is left out; and a code is right too where its own reading explains the data.
"""

import argparse
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import chdtri

import multipos as mp

G = 9.80665
TRIADS = (
    "faces-6",
    "song-qin-6",
    "corners-8",
    "edges-12",
    "icosahedron-12",
    "faces-corners-14",
    "faces-edges-18",
    "dodecahedron-20",
    "all-26",
    "dual-axis-48",
)
Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Bench:
    """A set of readings and how they are fitted."""

    up: Array
    values: Array
    one_g: float  # in reading units
    options: dict[str, Any]
    noise: float = 0.0  # of an output [reading units], placement included

    def fit(self) -> mp.Calibration:
        options = dict(self.options)
        unit = options.pop("unit", "reading")
        readings = mp.Readings(self.values, up=self.up, unit=unit)
        if "unknown_orientation" not in options:
            options = {"orientation_sd": 0} | options
        return mp.fit(readings, **{"exclude": "none"} | options)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.findings", description=__doc__)
    parser.add_argument("--good", type=int, default=10000, help="good calibrations")
    parser.add_argument("--runs", type=int, default=200, help="of each gross error")
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    warnings.simplefilter("ignore", mp.CalibrationWarning)
    if chosen.good:
        print_good(chosen.good, chosen.seed)
    if chosen.runs:
        print_gross(chosen.runs, chosen.seed)


def print_good(runs: int, seed: int) -> None:
    """Print what is said of good calibrations; each has a seed of its own, to be looked at."""
    said: Counter[str] = Counter()
    fitted = implausible = drawn = 0
    while fitted < runs:
        drawn += 1
        bench = good(np.random.default_rng([seed, drawn]))
        try:
            findings = bench.fit().diagnostics.findings
        except mp.MultiposError:  # too few positions for the model, told as an error
            continue
        fitted += 1
        codes = [finding.code for finding in findings if finding.level == "error"]
        if codes:
            implausible += 1
            print(f"draw {drawn} of seed {seed}: {', '.join(codes)}", flush=True)
        said.update({f"{finding.level} {finding.code}" for finding in findings})
    print(f"{fitted} good calibrations, {implausible} called implausible\n")
    print("| finding | % of good calibrations |\n|---|---|")
    for name, count in sorted(said.items()):
        print(f"| {name} | {100.0 * count / fitted:.2f} |")
    print(flush=True)


def print_gross(runs: int, seed: int) -> None:
    print("| planted | positions | cannot be told % | found % | named % | as |")
    print("|---|---|---|---|---|---|")
    for name, (codes, plant) in GROSS.items():
        for scheme in ("faces-6", "all-26"):
            said: Counter[str] = Counter()
            drawn = fitted = told = found = named = 0
            while fitted < runs:
                drawn += 1
                rng = np.random.default_rng([seed, drawn])
                good_one = plain(rng, scheme)
                spoilt = plant(good_one, rng)
                if spoilt is None:
                    continue
                fitted += 1
                code = verdict(spoilt)
                said[code] += 1
                others = set() if spoilt.options else explanations(spoilt, good_one.noise)
                if "a sensor" in others:
                    continue
                told += 1
                found += code != ""
                named += code in (*codes, *others, "an error")
            said.pop("", 0)
            names = ", ".join(code for code, _ in said.most_common(3))
            print(
                f"| {name} | {len(mp.read_scheme(scheme))} | {100 * (1 - told / runs):.1f} | "
                f"{100 * found / told:.1f} | {100 * named / told:.1f} | {names} |",
                flush=True,
            )


def verdict(bench: Bench) -> str:
    """Return what a fit finds implausible, the first of it; nothing where it finds nothing."""
    try:
        findings = bench.fit().diagnostics.findings
    except mp.MultiposError:
        return "an error"
    return next((finding.code for finding in findings if finding.level == "error"), "")


def explanations(bench: Bench, noise: float) -> set[str]:
    """Return the codes of what explains the readings within the noise, by least squares.

    'a sensor' where the readings as they are do, one of the right hand or with all outputs
    reversed, which is the other convention. Outputs of which no more is known than that they are
    a triad respond alike within a factor of two, and at right angles within 30°.
    """
    found: set[str] = set()
    n = len(bench.values)
    residual, K = straight(bench.up, bench.values)
    if residual <= noise and is_a_triad(K):
        handed = float(np.linalg.det(K))
        reversed_all = handed < 0.0 and bool((np.diag(K) < 0.0).all())
        found |= {"a sensor"} if handed > 0.0 or reversed_all else {"sign", "permuted-outputs"}
    for i in range(n):
        up = bench.up.copy()
        up[i] *= -1.0
        residual, K = straight(up, bench.values)
        if residual <= noise and is_a_triad(K):
            found.add("flipped-row")
        for j in range(i):
            values = bench.values.copy()
            values[[i, j]] = values[[j, i]]
            residual, K = straight(bench.up, values)
            if residual <= noise and is_a_triad(K):
                found.add("interchanged-rows")
    return found


def straight(up: Array, values: Array) -> tuple[float, Array]:
    """Return what bias and response leave, over what noise of one unit leaves once in 1000, and K.

    Nothing can be said of too few positions, or of positions that separate too little.
    """
    design = np.column_stack([np.ones(len(up)), up])
    left, size, right = np.linalg.svd(design, full_matrices=False)
    if size[-1] < 1e-6 * size[0]:
        return np.inf, np.zeros((values.shape[1], 3))
    K = (right.T @ ((left.T @ values) / size[:, None]))[1:].T
    residual = values - left @ (left.T @ values)
    dof = values.size - 4 * values.shape[1]
    return float(np.sqrt(np.sum(residual**2) / chdtri(dof, 1e-3))), np.asarray(K)


def is_a_triad(K: Array) -> bool:
    size = np.linalg.norm(K, axis=1)
    if not size.min() > 0.5 * size.max():
        return False
    unit = K / size[:, None]
    return bool(np.abs(unit @ unit.T - np.eye(len(unit))).max() < 0.5)


def good(rng: np.random.Generator) -> Bench:
    """Draw a good calibration."""
    outputs = int(rng.choice([3, 3, 3, 3, 2, 1]))
    scheme = str(rng.choice(TRIADS)) if rng.random() < 0.7 else f"fibonacci-{rng.integers(8, 53)}"
    if outputs < 3 and rng.random() < 0.4:
        scheme = str(rng.choice(["tumble-24", "tumble-12", "dual-axis-48"]))
    up = mp.read_scheme(scheme).up
    one_g, bias, unit = units(rng, outputs)
    scale = rng.uniform(0.5, 1.5, outputs) if unit != "g" else rng.uniform(0.7, 1.3, outputs)
    matrix = one_g * scale[:, None] * leaning(rng, outputs, np.radians(rng.uniform(0.0, 10.0)))
    if outputs == 3 and rng.random() < 0.1:
        matrix = matrix @ some_turn(rng)
    stated_up = np.radians(10.0 ** rng.uniform(-3.0, np.log10(2.0)))
    second = 10.0 ** rng.uniform(-5.0, np.log10(5e-3)) * one_g * rng.standard_normal(outputs)
    true_up = placed(up, stated_up, rng)
    sign = 1.0
    options: dict[str, Any] = {"model": str(rng.choice(["linear"] * 3 + ["own-quadratic"]))}
    if len(up) >= 14 and rng.random() < 0.2:
        options["model"] = "own-cubic"
    if rng.random() < 0.15:
        options["convention"], sign = "gravity", -1.0
    values = bias + sign * true_up @ matrix.T + second * (true_up @ np.eye(3)[:, :outputs]) ** 2
    noise = one_g * 10.0 ** rng.uniform(-5.0, np.log10(5e-3))
    values = values + noise * rng.standard_normal(values.shape)
    if rng.random() < 0.5:
        size = one_g * 10.0 ** rng.uniform(-2.0, np.log10(0.5))
        values[rng.integers(len(up)), rng.integers(outputs)] += rng.choice([-1.0, 1.0]) * size
    if rng.random() < 0.6:
        step = one_g * 10.0 ** rng.uniform(-5.0, np.log10(0.02))
        values = np.round(values / step) * step
    if unit == "count":
        values = np.round(values)
    if unit != "V":
        options["unit"] = unit
    chance = rng.random()
    if chance < 0.1:
        options["orientation_sd"] = max(float(np.degrees(stated_up)), 0.01)
    elif chance < 0.2 and outputs == 3 and len(up) >= 12 and options["model"] == "linear":
        options["unknown_orientation"] = True
    return Bench(up, values, one_g, options)


def units(rng: np.random.Generator, outputs: int) -> tuple[float, Array, str]:
    """Draw what one g reads, the bias, and the unit."""
    bias = rng.uniform(-0.5, 0.5, outputs)
    kind = rng.integers(4)
    if kind == 0:
        return 1.0, bias, "g"
    if kind == 1:
        return G, G * bias, "m/s^2"
    if kind == 2:
        one_g = 10.0 ** rng.uniform(2.0, 4.5)
        return one_g, one_g * (bias + rng.choice([0.0, 2.0, 8.0])), "count"
    return float(rng.uniform(0.3, 3.0)), 2.5 + 0.1 * bias, "V"


def leaning(rng: np.random.Generator, outputs: int, angle: float) -> Array:
    """Return the directions of outputs that lean from x, y, z by an angle."""
    axes = np.eye(3)[:outputs]
    across = np.cross(axes, rng.standard_normal(axes.shape))
    across /= np.linalg.norm(across, axis=1)[:, None]
    return np.asarray(np.cos(angle) * axes + np.sin(angle) * across)


def some_turn(rng: np.random.Generator) -> Array:
    """Return one of the 24 turns of a cube."""
    while True:
        turn = np.eye(3)[rng.permutation(3)] * rng.choice([-1.0, 1.0], (3, 1))
        if np.linalg.det(turn) > 0.0:
            return np.asarray(turn)


def placed(up: Array, sd: float, rng: np.random.Generator) -> Array:
    moved = up + np.cross(sd * rng.standard_normal(up.shape), up)
    return np.asarray(moved / np.linalg.norm(moved, axis=1)[:, None])


def plain(rng: np.random.Generator, scheme: str) -> Bench:
    """Draw a good set in g at known positions, for a gross error to be planted in."""
    up = mp.read_scheme(scheme).up
    scale = rng.uniform(0.8, 1.2, 3)
    matrix = scale[:, None] * leaning(rng, 3, np.radians(rng.uniform(0.0, 3.0)))
    stated_up = np.radians(rng.uniform(0.0, 0.3))
    values = rng.uniform(-0.1, 0.1, 3) + placed(up, stated_up, rng) @ matrix.T
    noise = 10.0 ** rng.uniform(-4.0, np.log10(2e-3))
    values += noise * rng.standard_normal(values.shape)
    return Bench(up, values, 1.0, {}, float(np.hypot(noise, stated_up * scale.max())))


Plant = Callable[[Bench, np.random.Generator], Bench | None]


def changed(edit: Callable[[Array, np.random.Generator], Array | None]) -> Plant:
    """Return what edits the readings of a bench."""

    def plant(bench: Bench, rng: np.random.Generator) -> Bench | None:
        values = edit(bench.values.copy(), rng)
        return None if values is None else replace(bench, values=values)

    return plant


def interchange(values: Array, rng: np.random.Generator) -> Array:
    i, j = rng.choice(len(values), 2, replace=False)
    values[[i, j]] = values[[j, i]]
    return values


def flip_row(bench: Bench, rng: np.random.Generator) -> Bench:
    up = bench.up.copy()
    up[rng.integers(len(up))] *= -1.0
    return replace(bench, up=up)


def flip_every_second(bench: Bench, _: np.random.Generator) -> Bench:
    up = bench.up.copy()
    up[1::2] *= -1.0
    return replace(bench, up=up)


def one_row(values: Array, rng: np.random.Generator) -> Array:
    values[rng.integers(len(values))] *= rng.choice([G, 1000.0, 1e-3, 1.0 / G])
    return values


def half_of_the_rows(values: Array, _: np.random.Generator) -> Array:
    values[: len(values) // 2] *= G
    return values


def one_output(values: Array, rng: np.random.Generator) -> Array:
    values[:, rng.integers(3)] *= rng.choice([G, 1000.0, 1.0 / G, 1e-3])
    return values


def reverse(values: Array, rng: np.random.Generator) -> Array:
    values[:, rng.integers(3)] *= -1.0
    return values


def exchange_outputs(values: Array, rng: np.random.Generator) -> Array:
    i, j = rng.choice(3, 2, replace=False)
    values[:, [i, j]] = values[:, [j, i]]
    return values


def stuck(values: Array, rng: np.random.Generator) -> Array:
    values[:, rng.integers(3)] = 0.05
    return values


def only_noise(values: Array, rng: np.random.Generator) -> Array:
    values[:, rng.integers(3)] = 0.05 + 1e-3 * rng.standard_normal(len(values))
    return values


def counted(values: Array, rng: np.random.Generator) -> Array:
    values[:, rng.integers(3)] = np.arange(1.0, len(values) + 1.0)
    return values


def clip(values: Array, _: np.random.Generator) -> Array | None:
    clipped = np.clip(values, -0.75, 0.75)
    return clipped if np.sum(clipped != values) > 2 else None


def wrap(values: Array, _: np.random.Generator) -> Array | None:
    wrapped = (values + 1.1) % 2.0 - 1.1  # a range of 2 g, from -1.1 to .9
    return wrapped if np.abs(wrapped - values).max() > 1.0 else None


def noise_alone(values: Array, rng: np.random.Generator) -> Array:
    return np.asarray(rng.standard_normal(values.shape))


def shuffled(values: Array, rng: np.random.Generator) -> Array:
    return np.asarray(rng.permutation(values))


def in_g(factor: float) -> Plant:
    def plant(bench: Bench, _: np.random.Generator) -> Bench:
        return replace(bench, values=factor * bench.values, options={"unit": "g"})

    return plant


def radians(bench: Bench, rng: np.random.Generator) -> Bench:
    """Angles of roll and pitch in radians under the names of degrees."""
    roll, pitch = rng.uniform(-np.pi, np.pi, len(bench.up)), rng.uniform(-1.5, 1.5, len(bench.up))

    def up_of(factor: float) -> Array:
        r, p = factor * roll, factor * pitch
        columns = [np.sin(p), -np.sin(r) * np.cos(p), -np.cos(r) * np.cos(p)]
        return np.column_stack(columns)

    values = up_of(1.0) + 1e-3 * rng.standard_normal(bench.values.shape)
    return replace(bench, up=up_of(np.pi / 180.0), values=values)


def feet(bench: Bench, _: np.random.Generator) -> Bench:
    return replace(bench, options={"gravity": 32.17})


GROSS: dict[str, tuple[tuple[str, ...], Plant]] = {
    "two rows interchanged": (("interchanged-rows", "sign"), changed(interchange)),
    "one row upside down": (("flipped-row",), flip_row),
    "every second row upside down": (
        ("flipped-row", "sign", "permuted-outputs"),
        flip_every_second,
    ),
    "one row in another unit": (("row-unit",), changed(one_row)),
    "half the rows in m/s²": (("row-unit",), changed(half_of_the_rows)),
    "one output in another unit": (("output-unit",), changed(one_output)),
    "m/s² under --unit g": (("unit",), in_g(G)),
    "mg under --unit g": (("unit",), in_g(1000.0)),
    "two outputs interchanged": (("permuted-outputs",), changed(exchange_outputs)),
    "one output reversed": (("sign",), changed(reverse)),
    "one output dead": (("dead-output",), changed(stuck)),
    "one output noise": (("no-signal",), changed(only_noise)),
    "a counter for an output": (("counter-column",), changed(counted)),
    "saturated at .75 g": (("saturated",), changed(clip)),
    "wrapped around at .9 g": (("wrapped", "flipped-row", "sign"), changed(wrap)),
    "all noise": (("no-signal",), changed(noise_alone)),
    "rows in random order": (("no-signal",), changed(shuffled)),
    "radians for degrees": (("angles-in-radians",), radians),
    "feet per second squared": (("gravity",), feet),
}


if __name__ == "__main__":
    main()
