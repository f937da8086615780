"""`multipos apply` of a long log to a file, beside pandas reading and writing the same columns.

In processor time, with all digits in pandas' frame, as its arithmetic leaves them.
"""

import contextlib
import io
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

import multipos as mp
from benchmarks.timing import Ratio, paired_ratio
from multipos.cli import main

ROWS = 1_000_000


def run() -> list[Ratio]:
    with tempfile.TemporaryDirectory() as folder:
        log, cal = Path(folder) / "log.csv", Path(folder) / "cal.json"
        write(log, cal)
        return [
            beside_pandas("", log, cal, (), 0.35),
            beside_pandas(", with u, U and tilt", log, cal, ("--uncertainty", "--tilt"), 0.26),
        ]


def write(log: Path, cal: Path) -> None:
    """Write a calibration, and raw readings with six decimals."""
    sensor = mp.demo().calibration
    found = mp.simulate(sensor, "fibonacci-24", reading_sd=1e-3, seed=3)
    mp.fit(dict(found), convention="gravity", orientation_sd=0).save(cal)
    rng = np.random.default_rng(0)
    up = rng.standard_normal((ROWS, 3))
    up /= np.linalg.norm(up, axis=1)[:, None]
    raw = sensor.model.predict(sensor.parameters, up, {})
    columns = {"time": np.arange(ROWS) / 100.0}
    columns |= {name: np.round(raw[:, i], 6) for i, name in enumerate(sensor.outputs)}
    mp.write_table(log, columns)


def beside_pandas(what: str, log: Path, cal: Path, options: Sequence[str], goal: float) -> Ratio:
    out = log.with_name("out.csv")

    def ours() -> None:
        said = io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            assert main(["apply", str(cal), str(log), *options, "-q", "-o", str(out)]) == 0

    how = {"uncertainty": bool(options), "tilt": bool(options)}
    written = pd.DataFrame(dict(mp.apply(mp.load(cal), log, **how)))

    def peer() -> None:
        pd.read_csv(log)
        written.to_csv(log.with_name("peer.csv"), index=False)

    pairs = paired_ratio(ours, peer, repeats=3, inner=1, timer=time.process_time)
    return Ratio(f"apply, {ROWS:,} rows{what}", "pandas read and write", pairs, goal)
