"""What U covers, and what is said, where time, order or the table spoil readings.

Readings come from a generator of their own: a sensor with bias, scale factors and cross terms,
normal noise of .1 mg, and one world each that the fit does not know. Printed are how often U (95 %)
holds the parameters, all together and the worst of them, how often the right cause is named, and
any other; then what U holds once the named advice is followed. The second table is of healthy sets:
how often each finding of the data comes up, and any.
"""

import argparse
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import multipos as mp

BIAS = np.array([0.012, -0.021, 0.034])
MATRIX = np.array([[1.008, 0.004, -0.007], [-0.003, 0.991, 0.006], [0.005, -0.002, 1.012]])
NOISE = 1e-4
OUTPUTS = ("ax", "ay", "az")
LSB = 8e-3
# Constant for a scheme, or statements about what the data are not asked for.
CONSTANT = frozenset({"hidden-terms", "drift-absorbed", "no-dof", "no-redundancy", "axes"})


@dataclass
class Readings:
    """Readings (n, 3) at listed directions (n, 3), columns beside them, and the truth (12,)."""

    values: np.ndarray
    up: np.ndarray | None
    beside: dict[str, Any] = field(default_factory=dict)
    truth: np.ndarray = field(default_factory=lambda: truth_of(BIAS, MATRIX))

    def fit(self, **options: Any) -> mp.Calibration:
        columns = dict(zip(OUTPUTS, self.values.T, strict=True)) | self.beside
        if self.up is not None and "unknown_orientation" not in options:
            columns |= dict(zip(("up_x", "up_y", "up_z"), self.up.T, strict=True))
            options = {"orientation_sd": 0} | options
        return mp.fit(columns, outputs=OUTPUTS, unit="g", **{"exclude": "none"} | options)


World = Callable[[np.random.Generator], Readings]
Advice = Callable[[Readings, mp.Finding], dict[str, Any]]


def truth_of(bias: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return bias and slopes of every output, in the order of the parameters."""
    return np.column_stack([bias, matrix]).ravel()


def directions(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return the directions of a scheme in random order."""
    name = {6: "faces-6", 12: "icosahedron-12"}.get(n, f"fibonacci-{n}")
    return rng.permutation(mp.read_scheme(name).up)


def turned(up: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return directions turned by a rotation vector [rad], by Rodrigues' formula."""
    angle = float(np.linalg.norm(vector))
    axis = vector / angle
    along = (up @ axis)[:, None] * axis
    return along + np.cos(angle) * (up - along) + np.sin(angle) * np.cross(axis, up)


def sensed(up: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return BIAS + up @ MATRIX.T + NOISE * rng.standard_normal(up.shape)


def healthy(n: int, *, timed: bool = False) -> World:
    def make(rng: np.random.Generator) -> Readings:
        up = directions(n, rng)
        return Readings(sensed(up, rng), up, {"time": 60.0 * np.arange(n)} if timed else {})

    return make


def drift(size: float, n: int = 24, *, spread: bool = False) -> World:
    def make(rng: np.random.Generator) -> Readings:
        up = mp.read_scheme(f"fibonacci-{n}", order="spread").up if spread else directions(n, rng)
        course = size * np.linspace(-0.5, 0.5, n)[:, None]
        return Readings(sensed(up, rng) + course, up)

    return make


def slow(n: int, repeats: int = 1) -> World:
    def make(rng: np.random.Generator) -> Readings:
        up = np.tile(
            mp.read_scheme({6: "faces-6", 12: "icosahedron-12"}.get(n, f"fibonacci-{n}")).up,
            (repeats, 1),
        )
        noise = rng.standard_normal(up.shape)
        for k in range(1, len(up)):
            noise[k] = 0.9 * noise[k - 1] + np.sqrt(0.19) * noise[k]
        values = BIAS + up @ MATRIX.T + NOISE * noise
        return Readings(values, up, {"time": 60.0 * np.arange(len(up))})

    return make


def slipped(rng: np.random.Generator) -> Readings:
    up = directions(24, rng)
    vector = rng.standard_normal(3)
    stood = up.copy()
    stood[12:] = turned(up[12:], np.radians(0.3) * vector / np.linalg.norm(vector))
    return Readings(sensed(stood, rng), up)


def replaced(n: int) -> World:
    def make(rng: np.random.Generator) -> Readings:
        up = directions(n, rng)
        values, half = sensed(up, rng), n // 2
        other = np.eye(3) + 0.01 * rng.standard_normal((3, 3))
        zero = 0.02 * rng.standard_normal(3)
        values[half:] = zero + up[half:] @ other.T + NOISE * rng.standard_normal((n - half, 3))
        return Readings(values, up)

    return make


def hysteresis(rng: np.random.Generator) -> Readings:
    up = directions(24, rng)
    side = rng.choice([-1.0, 1.0], 24)
    return Readings(sensed(up, rng) + 5e-4 * side[:, None], up, {"approach": side})


def settling(rng: np.random.Generator) -> Readings:
    up = directions(24, rng)
    values = BIAS + up @ MATRIX.T
    values[1:] = 0.98 * values[1:] + 0.02 * values[:-1]
    return Readings(values + NOISE * rng.standard_normal((24, 3)), up)


def vibration(rng: np.random.Generator) -> Readings:
    up = directions(24, rng)
    sd = np.full(24, 1e-3)
    sd[rng.permutation(24)[:6]] = 0.03 * rng.uniform(0.7, 1.3, 6)
    seen = sd[:, None] * np.sqrt(rng.chisquare(50, (24, 3)) / 50)
    beside = {f"sd_{output}": seen[:, i] for i, output in enumerate(OUTPUTS)}
    return Readings(sensed(up, rng) + sd[:, None] ** 2, up, beside)


def coarse(rng: np.random.Generator) -> Readings:
    matrix = np.diag([1.008, 0.991, 1.012]) + LSB * rng.uniform(-1.0, 1.0, (3, 3))
    bias = 0.02 * rng.standard_normal(3)
    up = mp.read_scheme("faces-6").up
    values = bias + up @ matrix.T + NOISE * rng.standard_normal((6, 3))
    return Readings(LSB * np.round(values / LSB), up, truth=truth_of(bias, matrix))


def encoder(error_deg: float) -> World:
    def make(rng: np.random.Generator) -> Readings:
        turn = np.arange(24) * 2.0 * np.pi / 24
        phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        wave = np.sin(turn + phase[0]) + 0.5 * np.cos(2.0 * turn + phase[1])
        stood, zero = turn + np.radians(error_deg) * wave, np.zeros(24)
        about_x = np.column_stack([zero, np.cos(stood), np.sin(stood)])
        about_y = np.column_stack([np.cos(stood), zero, np.sin(stood)])
        angles = {"roll_axis": ["x"] * 24 + ["y"] * 24, "angle_deg": np.degrees(np.tile(turn, 2))}
        return Readings(sensed(np.vstack([about_x, about_y]), rng), None, angles)

    return make


def off(rng: np.random.Generator) -> Readings:
    up = mp.read_scheme("faces-6").up
    stood = up + np.cross(np.radians(0.1) * rng.standard_normal((6, 3)), up)
    return Readings(sensed(stood / np.linalg.norm(stood, axis=1)[:, None], rng), up)


def with_group(readings: Readings, finding: mp.Finding) -> dict[str, Any]:
    """Give the rows from the one named on a group."""
    first = int(finding.rows[0]) - 1
    readings.beside["group"] = ["" if row < first else "late" for row in range(24)]
    return {}


def with_drift(_: Readings, __: mp.Finding) -> dict[str, Any]:
    return {"drift": True}


def with_budget(_: Readings, finding: mp.Finding) -> dict[str, Any]:
    """State what the finding says of the table."""
    return {"orientation_sd": float(finding.action.split("--orientation-sd ")[1].rstrip("."))}


def first_part(readings: Readings, finding: mp.Finding) -> dict[str, Any]:
    """Leave the rows from the one named on out."""
    kept = int(finding.rows[0]) - 1
    readings.values = readings.values[:kept]
    readings.up = None if readings.up is None else readings.up[:kept]
    return {}


def without_loud(readings: Readings, finding: mp.Finding) -> dict[str, Any]:
    return {"exclude": list(finding.rows)}


# world, options of fit, the code that is right, the advice
WORLDS: dict[str, tuple[World, dict[str, Any], str, Advice | None]] = {
    "drift .3 mg, fibonacci-24 laid out against drift": (
        drift(3e-4, spread=True),
        {},
        "drift",
        with_drift,
    ),
    "drift .3 mg, 24 in random order": (drift(3e-4), {}, "drift", with_drift),
    "drift 5 mg, 24 in random order": (drift(5e-3), {}, "drift", with_drift),
    "drift 1 mg, icosahedron-12, own-quadratic": (
        drift(1e-3, 12),
        {"model": "own-quadratic"},
        "drift",
        with_drift,
    ),
    "drift 1 mg, icosahedron-12": (drift(1e-3, 12), {}, "drift", with_drift),
    "slow noise .9 in time, 12": (slow(12), {}, "time-correlated", None),
    "slow noise .9 in time, 24": (slow(24), {}, "time-correlated", None),
    "slow noise .9 in time, 48": (slow(48), {}, "time-correlated", None),
    "slow noise .9 in time, six faces six times": (slow(6, 6), {}, "time-correlated", None),
    "slow noise .9 in time, unknown 24": (
        slow(24),
        {"unknown_orientation": True},
        "time-correlated",
        None,
    ),
    "slow noise .9 in time, unknown 60": (
        slow(60),
        {"unknown_orientation": True},
        "time-correlated",
        None,
    ),
    "slow noise .9 in time, unknown 90": (
        slow(90),
        {"unknown_orientation": True},
        "time-correlated",
        None,
    ),
    "slow noise .9 in time, unknown 120": (
        slow(120),
        {"unknown_orientation": True},
        "time-correlated",
        None,
    ),
    "slipped .3° after row 12 of 24": (slipped, {}, "slipped", with_group),
    "replaced after half of 24": (replaced(24), {}, "replaced", first_part),
    "replaced after half of 12": (replaced(12), {}, "replaced", first_part),
    "replaced after half of 6": (replaced(6), {}, "replaced", None),
    "hysteresis ±.5 mg by approach, 24": (hysteresis, {}, "hysteresis", None),
    "filter holds 2 % of the row before, 24": (settling, {}, "settling", None),
    "vibration in a quarter of 24 rests": (vibration, {}, "vibration", without_loud),
    "six faces on a grid of 8 mg": (coarse, {}, "quantized", None),
    "encoder .05°, dual-axis-48": (encoder(0.05), {}, "table", with_budget),
    "encoder .02°, dual-axis-48": (encoder(0.02), {}, "table", with_budget),
    "directions off .1°, six faces": (off, {}, "placement", None),
}
GOOD: dict[str, tuple[World, dict[str, Any]]] = {
    "six faces": (healthy(6), {}),
    "icosahedron-12": (healthy(12), {}),
    "12 in time": (healthy(12, timed=True), {}),
    "fibonacci-24": (healthy(24), {}),
    "24 in time": (healthy(24, timed=True), {}),
    "fibonacci-48": (healthy(48), {}),
    "dual-axis-48": (encoder(0.0), {}),
    "unknown 24": (healthy(24), {"unknown_orientation": True}),
    "unknown 48 in time": (healthy(48, timed=True), {"unknown_orientation": True}),
}


def held(calibration: mp.Calibration, readings: Readings) -> np.ndarray:
    """Return which parameters (p,) are within U, those of the lower triangle where it is free."""
    truth = readings.truth.reshape(3, 4)
    if calibration.model.gauge is not None:
        truth = np.column_stack([truth[:, 0], np.linalg.cholesky(truth[:, 1:] @ truth[:, 1:].T)])
    places = {"x": 1, "y": 2, "z": 3, "1": 0}
    kept = [
        (i, truth[OUTPUTS.index(entry.output), places[entry.term]])
        for i, entry in enumerate(calibration.entries)
        if entry.term in places
    ]
    rows, true = zip(*kept, strict=True)
    rows = list(rows)
    return np.abs(calibration.parameters[rows] - np.array(true)) <= calibration.U[rows]


def of_data(calibration: mp.Calibration) -> list[mp.Finding]:
    """Return the findings that these data show."""
    return [each for each in calibration.findings if each.code not in CONSTANT]


def print_world(name: str, runs: int, seed: int) -> None:
    world, options, right, advice = WORLDS[name]
    hits, followed, named = [], [], 0
    others: Counter[str] = Counter()
    for run in range(runs):
        readings = world(np.random.default_rng([seed, run]))
        calibration = readings.fit(**options)
        hits.append(held(calibration, readings))
        found = {each.code: each for each in of_data(calibration)}
        others.update(set(found) - {right})
        named += right in found
        if advice is not None and right in found:
            after = readings.fit(**{**options, **advice(readings, found[right])})
            followed.append(held(after, readings))
    mean = np.mean(hits, axis=0)
    after = f"{100.0 * np.mean(followed):.0f}" if followed else "–"
    other = ", ".join(
        f"`{code}` {100.0 * count / runs:.0f}" for code, count in others.most_common(3)
    )
    print(
        f"| {name} | {100.0 * mean.mean():.0f} ({100.0 * mean.min():.0f}) "
        f"| `{right}` {100.0 * named / runs:.0f} | {other or '–'} | {after} |",
        flush=True,
    )


def print_tumble(runs: int, seed: int, error_deg: float = 0.02, steps: int = 24) -> None:
    """Print what U of one output's tumble holds whose encoder is off, and with it stated.

    Counted is how often the table is named: as a cause, or as what U leaves out and by how much.
    """
    turn = np.arange(steps) * 2.0 * np.pi / steps
    truth = {"K0": BIAS[0], "K2": 0.0}
    given: dict[str, list[bool]] = {name: [] for name in truth}
    stated: dict[str, list[bool]] = {name: [] for name in truth}
    named = 0
    for run in range(runs):
        rng = np.random.default_rng([seed, 9, run])
        phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        wave = np.sin(turn + phase[0]) + 0.5 * np.cos(2.0 * turn + phase[1])
        stood = turn + np.radians(error_deg) * wave
        values = BIAS[0] + np.cos(stood) + NOISE * rng.standard_normal(steps)
        table = {"roll_axis": ["z"] * steps, "angle_deg": np.degrees(turn), "ax": values}
        found = mp.tumble(table, outputs=["ax"], unit="g")
        named += any(each.code in ("table", "hidden-table") for each in found.findings)
        bench = mp.state_bench(
            found.calibration,
            reading_sd=NOISE,
            first_sd_deg=error_deg / np.sqrt(2.0),
            second_sd_deg=0.5 * error_deg / np.sqrt(2.0),
        )
        for each, hits in ((found, given), (mp.tumble(bench), stated)):
            for name, true in truth.items():
                coefficient = each.coefficients[name]
                if np.isfinite(coefficient.U):
                    hits[name].append(abs(coefficient.value - true) <= coefficient.U)
    shares = [
        ", ".join(f"{k} {100.0 * np.mean(v):.0f}" for k, v in h.items()) for h in (given, stated)
    ]
    print(
        f"| tumble-{steps}, encoder {error_deg:g}°, one output: {shares[0]}, in "
        f"{100.0 * len(given['K0']) / runs:.0f} % of sets | `table`, `hidden-table` "
        f"{100.0 * named / runs:.0f} | – | {shares[1]} |"
    )


def print_good(name: str, runs: int, seed: int) -> None:
    world, options = GOOD[name]
    hits, found, any_of_it = [], Counter[str](), 0
    for run in range(runs):
        readings = world(np.random.default_rng([seed, 7, run]))
        calibration = readings.fit(**options)
        hits.append(held(calibration, readings))
        codes = {each.code for each in of_data(calibration) if each.level != "note"}
        found.update(codes)
        any_of_it += bool(codes)
    said = ", ".join(f"`{code}` {100.0 * count / runs:.1f}" for code, count in found.most_common(6))
    share = f"{100.0 * np.mean(hits):.1f}"
    print(f"| {name} | {share} | {100.0 * any_of_it / runs:.1f} | {said or '–'} |", flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.coverage_time", description=__doc__)
    parser.add_argument("--runs", type=int, default=40, help="of every world; 400 for the page")
    parser.add_argument("--good", type=int, default=200, help="healthy sets; 2000 for the page")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="worlds whose name has this in it")
    chosen = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    print("| world | U holds % (worst) | named % | others % | U holds, advice followed % |")
    print("|---|---|---|---|---|")
    for name in WORLDS:
        if chosen.only in name:
            print_world(name, chosen.runs, chosen.seed)
    print("\n| one roll: U holds % | named % | – | table stated |\n|---|---|---|---|")
    if chosen.only in "tumble-24":
        print_tumble(chosen.runs, chosen.seed)
    print("\n| healthy sets | U holds % | any warning % | of them |\n|---|---|---|---|")
    for name in GOOD:
        if chosen.only in name:
            print_good(name, chosen.good, chosen.seed)


if __name__ == "__main__":
    main()
