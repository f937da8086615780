"""A simulated production line, and what `multipos.fleet` finds of what was put into it.

Three stations with nests of 14 positions: B is not level and its zero drifts, C has a position that
is off. One unit in a hundred is bad: a reading of the wrong sign, a dead output, or another kind of
sensor. `python -m benchmarks.line 1000000` prints what was put in and found.
"""

import argparse
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

import multipos as mp

NAMES = ("A", "B", "C")
LEVEL = np.radians([[0.0, 0.0, 0.0], [0.10, -0.05, 0.0], [0.0, 0.0, 0.0]])
TILTED, ANGLE = 6, np.radians([0.0, 0.0, 0.15])  # position of C, and by how much
DRIFT = 0.004  # [g], of the zero of ay at B from the first unit to the last
LOT, NOISE = 0.01, 3e-4  # what units differ by, and the noise of a reading [g]
BAD = {"flipped": 0.004, "dead": 0.003, "odd": 0.003}
CHUNK = 20_000
LIMITS = {"bias_ax": (-0.03, 0.03), "scale_ax": (0.96, 1.04), "rms": (None, 0.003)}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.line", description=__doc__)
    parser.add_argument("units", nargs="?", type=int, default=100_000)
    units = parser.parse_args().units
    warnings.simplefilter("ignore", mp.CalibrationWarning)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "line.parquet"
        kinds = simulate(path, units)
        start, used = time.perf_counter(), time.process_time()
        found = mp.fleet(
            path,
            unit_column="unit",
            station_column="station",
            scheme="faces-corners-14",
            limits=LIMITS,
            orientation_sd=0,
            exclude="none",
        )
        spent = f"{time.perf_counter() - start:.0f} s, {time.process_time() - used:.0f} s CPU"
    report(found, kinds, spent)


def simulate(path: Path, units: int) -> np.ndarray:
    """Write the line as Parquet, and return what kind every unit is."""
    import pyarrow as pa
    from pyarrow import parquet

    rng = np.random.default_rng(1)
    kinds = rng.choice(["good", *BAD], units, p=[1.0 - sum(BAD.values()), *BAD.values()])
    writer = None
    for start in range(0, units, CHUNK):
        mine = np.arange(start, min(start + CHUNK, units))
        table = pa.table(_rows(rng, mine, kinds[mine], units))
        writer = writer or parquet.ParquetWriter(path, table.schema)
        writer.write_table(table)
    assert writer is not None
    writer.close()
    return kinds


def _rows(
    rng: np.random.Generator, mine: np.ndarray, kinds: np.ndarray, units: int
) -> dict[str, Any]:
    up = mp.read_scheme("faces-corners-14").up
    n, count = len(up), len(mine)
    station = rng.integers(0, 3, count)
    turned = np.repeat(LEVEL[:, None], n, axis=1)
    turned[2, TILTED] += ANGLE
    force = up + np.cross(turned, up)
    matrix = np.eye(3) + LOT * rng.standard_normal((count, 3, 3))
    bias = LOT * rng.standard_normal((count, 3))
    bias[:, 1] += np.where(station == 1, DRIFT * mine / units, 0.0)
    bias[kinds == "odd", 2] += 0.1
    values = bias[:, None] + np.einsum("bni,bji->bnj", force[station], matrix)
    values += NOISE * rng.standard_normal(values.shape)
    values[kinds == "flipped", 3] *= -1.0
    values[kinds == "dead", :, 0] = 0.5
    return {
        "unit": np.repeat([f"U{i:07d}" for i in mine], n),
        "station": np.repeat(np.array(NAMES)[station], n),
        "position": np.tile([str(k + 1) for k in range(n)], count),
        **{f"a{axis}": values[:, :, i].ravel() for i, axis in enumerate("xyz")},
    }


def report(found: mp.Fleet, kinds: np.ndarray, spent: str) -> None:
    """Print what was put in beside what was found."""
    print(f"{found['units']} units: {spent}")
    verdicts = found.verdicts["verdict"]
    for kind in ("good", *BAD):
        counted = Counter(verdicts[kinds == kind].tolist())
        print(f"  {kind:8s} {dict(counted)}")
    good = found["yield"]
    print(f"yield {good['value']:.5f} [{good['low']:.5f}, {good['high']:.5f}]")
    named = {each["unit"] for each in found["outliers"]}
    odd = {f"U{i:07d}" for i in np.flatnonzero(kinds == "odd")}
    print(f"units that do not belong: {len(named)}, of {len(odd)} odd ones {len(named & odd)}")
    level = np.degrees(LEVEL - LEVEL.mean(axis=0))
    for each in found["stations"]:
        place = NAMES.index(each["station"])
        for i, axis in enumerate("xyz"):
            said = each["level_deg"][axis]
            put_in = level[place, i]
            print(
                f"level {each['station']} {axis} {put_in:8.4f} {said['value']:8.4f} {said['u']:.4f}"
            )
        position = each["positions_deg"][TILTED]
        print(f"position {TILTED + 1} of {each['station']}", {k: position[k] for k in "xyz"})
    for each in found["drift"]:
        print(
            each["station"], each["name"], each["kind"], f"{each['value']:.5f}", f"{each['u']:.5f}"
        )


if __name__ == "__main__":
    main()
