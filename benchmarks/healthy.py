"""What is said of healthy data: how many sets of sixteen ordinary kinds show a warning or an error.

A sensor of ordinary faults (bias to 5 %, scale factors to 2 %, axes to .5°, noise of a tenth to one
mg) at positions of every kind that the pages speak of, written out here without the package. None
of these sets has anything wrong with it, so that whatever is said of the data beyond a note is a
false alarm. Printed, of each kind: the share of sets with a warning and with an error, the codes,
and of logs the largest number of findings with notes.

`python -m benchmarks.healthy --sets 100` takes some twenty minutes; --sets 10 two.
"""

import argparse
import collections
import itertools
import warnings

import numpy as np
from numpy.typing import NDArray

import multipos as mp

Array = NDArray[np.float64]
_STANDARD = 9.80665


def sensor(rng: np.random.Generator) -> tuple[Array, Array]:
    """Return bias [g] and response of a triad."""
    K = np.diag(1.0 + 0.02 * rng.uniform(-1.0, 1.0, 3))
    K += np.radians(0.5) * rng.uniform(-1.0, 1.0, (3, 3)) * (1.0 - np.eye(3))
    return 0.05 * rng.uniform(-1.0, 1.0, 3), K


def cube(count: int) -> Array:
    """Return the first of faces, edges and corners of a cube as up vectors."""
    every = [v for v in itertools.product((-1, 0, 1), repeat=3) if any(v)]
    every.sort(key=lambda v: sum(map(abs, v)))
    up = np.array(every, dtype=np.float64)
    up /= np.linalg.norm(up, axis=1)[:, None]
    return np.asarray(np.concatenate([up] * (1 + count // 26))[:count])


def turned(up: Array, degrees: float, rng: np.random.Generator) -> Array:
    """Return directions off by so many degrees, per axis."""
    moved = up + np.cross(np.radians(degrees) * rng.standard_normal(up.shape), up)
    return np.asarray(moved / np.linalg.norm(moved, axis=1)[:, None])


def table(up: Array, listed: Array, noise: float, rng: np.random.Generator) -> dict[str, Array]:
    """Return readings at positions that are listed."""
    bias, K = sensor(rng)
    values = up @ K.T + bias + noise * rng.standard_normal(up.shape)
    columns = dict(zip(("up_x", "up_y", "up_z"), listed.T, strict=True))
    return columns | dict(zip(("ax", "ay", "az"), values.T, strict=True))


def known(count: int, rng: np.random.Generator) -> mp.Calibration:
    """Fit known positions."""
    up = cube(count)
    return mp.fit(table(up, up, 10.0 ** rng.uniform(-4.0, -3.0), rng), unit="g")


def repeated(rng: np.random.Generator) -> mp.Calibration:
    """Fit six faces four times over, placed by hand to .3°, which is stated."""
    up = np.concatenate([cube(6)] * 4)
    return mp.fit(table(turned(up, 0.3, rng), up, 3e-4, rng), unit="g", orientation_sd=0.3)


def stated(rng: np.random.Generator) -> mp.Calibration:
    """Fit known positions whose noise is stated."""
    up = cube(18)
    return mp.fit(table(up, up, 2e-4, rng), unit="g", reading_sd=2e-4)


def free(count: int, rng: np.random.Generator) -> mp.Calibration:
    """Fit positions that nobody knows."""
    up = turned(cube(count), 5.0, rng)
    given = table(up, up, 3e-4, rng)
    readings = {name: _STANDARD * given[name] for name in ("ax", "ay", "az")}
    return mp.fit(readings, unit="m/s^2", unknown_orientation=True)


def rolls(rng: np.random.Generator) -> mp.Calibration:
    """Fit rolls about two axes."""
    up = np.concatenate([mp.read_scheme(name).up for name in ("roll-x-12", "roll-z-12")])
    return mp.fit(table(up, up, 2e-4, rng), unit="g")


def inclinometer(rng: np.random.Generator) -> mp.Calibration:
    """Fit two axes in volts over two rolls."""
    angle = np.radians(np.arange(0.0, 360.0, 15.0))
    zero = np.zeros(24)
    up = np.vstack([np.c_[np.cos(angle), zero], np.c_[zero, np.cos(angle)]])
    K = 1.0 + 0.01 * rng.uniform(-1.0, 1.0, 2)
    volts = 2.5 + up * K + 1e-4 * rng.standard_normal(up.shape)
    degrees = np.tile(np.arange(0.0, 360.0, 15.0), 2)
    given = {"roll_axis": ["y"] * 24 + ["x"] * 24, "angle_deg": degrees}
    return mp.fit(given | {"Ux": volts[:, 0], "Uy": volts[:, 1]}, inputs="x,y", unit="V")


def soaks(rng: np.random.Generator) -> mp.Calibration:
    """Fit eight positions at each of six temperatures, the zero drifting with temperature."""
    up = np.concatenate([cube(26)[18:]] * 6)
    t = np.repeat(np.linspace(-20.0, 60.0, 6), 8)
    given: dict[str, Array] = table(up, up, 2e-4, rng)
    for name in ("ax", "ay", "az"):
        given[name] = given[name] + 1e-4 * rng.uniform(-1.0, 1.0) * t
    return mp.fit(given | {"temperature": t}, unit="g", model="1 + x + y + z + temperature")


def own(rng: np.random.Generator) -> mp.Calibration:
    """Fit a sensor with a square of its own axis by that model."""
    up = cube(26)
    given = table(up, up, 1e-4, rng)
    for name, axis in zip(("ax", "ay", "az"), up.T, strict=True):
        given[name] = given[name] + 2e-3 * axis**2
    return mp.fit(given, unit="g", model="own-quadratic")


def log(
    rng: np.random.Generator,
    rate: float,
    rest: float,
    *,
    white: float,
    slow: float = 0.0,
    tremor: float = 0.0,
    sway: float = 0.0,
) -> mp.Calibration:
    """Calibrate from a log of twenty rests: turned in a second each, held still or by hand."""
    bias, K = sensor(rng)
    up = turned(np.concatenate([cube(26)[:6], rng.permutation(cube(26)[6:])[:14]]), 5.0, rng)
    force: list[Array] = []
    for here, there in itertools.zip_longest(up, up[1:]):
        count = int(rate * (rest + rng.uniform(-0.5, 0.5)))
        t = np.arange(count) / rate
        phase = rng.uniform(0.0, 2.0 * np.pi, (2, 3))
        off = np.radians(sway) * np.sin(2.0 * np.pi * 0.3 * t[:, None] + phase[0])
        held = here + np.cross(off, here)
        held /= np.linalg.norm(held, axis=1)[:, None]
        force.append(held + tremor * np.sin(2.0 * np.pi * 9.0 * t[:, None] + phase[1]))
        if there is not None:
            share = np.linspace(0.0, 1.0, int(rate))[:, None]
            way = (1.0 - share) * here + share * there + 0.3 * np.sin(np.pi * share)
            force.append(way)
    every = np.concatenate(force)
    n = len(every)
    spectrum = rng.standard_normal((n // 2 + 1, 3)) + 1j * rng.standard_normal((n // 2 + 1, 3))
    spectrum[1:] /= np.sqrt(np.arange(1, n // 2 + 1))[:, None]
    spectrum[0] = 0.0
    pink = np.fft.irfft(spectrum, n, axis=0)
    values = every @ K.T + bias + white * rng.standard_normal(every.shape)
    values = values + slow * pink / pink.std(axis=0)
    columns = dict(zip(("ax", "ay", "az"), values.T, strict=True))
    return mp.calibrate({"time": np.arange(n) / rate} | columns, unit="g")


KINDS = {
    "known 6": lambda rng: known(6, rng),
    "known 12": lambda rng: known(12, rng),
    "known 24": lambda rng: known(24, rng),
    "known 48": lambda rng: known(48, rng),
    "faces by hand": repeated,
    "stated u": stated,
    "unknown 12": lambda rng: free(12, rng),
    "unknown 24": lambda rng: free(24, rng),
    "rolls": rolls,
    "inclinometer": inclinometer,
    "soaks": soaks,
    "own model": own,
    "log, 25 Hz": lambda rng: log(rng, 25.0, 5.0, white=1e-3, slow=2e-4),
    "log, 100 Hz": lambda rng: log(rng, 100.0, 5.0, white=3e-3),
    "log, 400 Hz": lambda rng: log(rng, 400.0, 4.0, white=3e-3, slow=6e-4),
    "log by hand": lambda rng: log(rng, 100.0, 6.0, white=3e-3, slow=6e-4, tremor=4e-3, sway=0.2),
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.healthy", description=__doc__)
    parser.add_argument("--sets", type=int, default=10, help="of each kind")
    parser.add_argument("--seed", type=int, default=0, help="other sets than those of another")
    parser.add_argument("--kind", help="one of them alone")
    asked = parser.parse_args()
    warnings.simplefilter("ignore", mp.CalibrationWarning)
    print("| kind | warning | error | findings at most | codes of warnings and errors |")
    print("|---|---|---|---|---|")
    shown = total = 0
    for kind, make in KINDS.items():
        if asked.kind not in (None, kind):
            continue
        warned = failed = most = 0
        codes: collections.Counter[str] = collections.Counter()
        for run in range(asked.sets):
            seeds = [run, sum(map(ord, kind)), *([asked.seed] if asked.seed else [])]
            found = make(np.random.default_rng(seeds)).findings
            levels = [each.level for each in found]
            warned += "warning" in levels
            failed += "error" in levels
            most = max(most, len(found))
            codes.update(each.code for each in found if each.level != "note")
        shown, total = shown + warned, total + asked.sets
        named = ", ".join(f"{code} {count}" for code, count in codes.most_common())
        shares = f"{100 * warned / asked.sets:.0f} % | {100 * failed / asked.sets:.0f} %"
        print(f"| {kind} | {shares} | {most} | {named} |", flush=True)
    print(f"\nA warning in {100 * shown / total:.1f} % of {total} sets.")


if __name__ == "__main__":
    main()
