"""Whole calls on ordinary data, in processor time.

A set with something to say of it (positions off by .2°, a missing term, an outlier) beside the same
set without; batches of what `fit` does least quickly beside a loop of it; growth with positions and
outputs; and calls of which a time is asked, where the peer is that time.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

import multipos as mp
from benchmarks.bench_orientations import jacobian, natural_start, residuals, simulate
from benchmarks.timing import Ratio, paired_process_ratio, paired_ratio, time_of_children

Array = NDArray[np.float64]

NOISE = 3e-4  # [g]
FOUND = {"off by .2°": "off", "a missing term": "cubic", "an outlier": "outlier"}
# All rows at the orientations that are listed, which is what its peers do.
LISTED: dict[str, Any] = {"orientation_sd": 0, "exclude": "none"}
WAYS: dict[str, dict[str, Any]] = {
    "known": {},
    "u of every reading": {},
    "stepwise": {"stepwise": True, "model": "full-quadratic"},
}
OWN = "each = b + p*x + q*y + r*z + k*(p*x + q*y + r*z)^2"
LARGE = """
import time
from pathlib import Path
import numpy as np
import multipos as mp
rng = np.random.default_rng(0)
up = rng.standard_normal((1_000_000, 3))
up /= np.linalg.norm(up, axis=1)[:, None]
values = 0.02 + up @ (np.eye(3) + 0.01) + 3e-4 * rng.standard_normal(up.shape)
begun = time.process_time()
mp.fit(mp.Readings(values, up=up), orientation_sd=0, exclude="none")
took = time.process_time() - begun
# Of this program alone: ru_maxrss has that of whoever started it, where it was larger.
peak = Path("/proc/self/status").read_text().partition("VmHWM:")[2].split()[0]
print(took, float(peak) / 1024)
"""
REPORT = """
import tempfile, time
import numpy as np
import multipos as mp
from multipos.cli import main
up = mp.read_scheme("fibonacci-24").up
values = 0.02 + 1.01 * up + 3e-4 * np.random.default_rng(0).standard_normal(up.shape)
with tempfile.TemporaryDirectory() as folder:
    mp.fit(mp.Readings(values, up=up)).save(f"{folder}/cal.json")
    begun = time.process_time()
    main(["report", f"{folder}/cal.json", "-o", f"{folder}/report.html"])
    print(time.process_time() - begun)
"""
COMMAND = """
import sys, time
from multipos.cli import main  # which sets the threads where nobody did
begun = time.process_time()
status = main(["stability", sys.argv[1], "--rate", "100", "-o", sys.argv[2]])
assert status == 0
print(time.process_time() - begun)
"""


def run() -> list[Ratio]:
    warnings.simplefilter("ignore", mp.CalibrationWarning)
    return [
        *(
            with_finding(way, n, name)
            for way in WAYS
            for n in (24, 400, 4000)
            for name in FOUND
            if not (way == "stepwise" and n > 400)
        ),
        one_unit({}),
        one_unit({"reading_sd": NOISE}),
        one_unit({"robust": "huber"}),
        own_models(),
        beside_lm(),
        *(auto(n, goal) for n, goal in ((24, 0.3), (400, 0.3), (10_000, 0.2))),
        many_outputs(),
        *large(),
        threads(),
        report(),
        *compensation_in_c(),
    ]


def cpu(ours: Callable[[], object], peer: Callable[[], object], repeats: int, inner: int) -> Any:
    return paired_ratio(ours, peer, repeats=repeats, inner=inner, timer=time.process_time)


def readings(n: int, kind: str, *, stated: bool = False, seed: int = 0) -> mp.Readings:
    """Return readings at n positions in which something is to be found, or nothing."""
    rng = np.random.default_rng(seed)
    up = mp.read_scheme(f"fibonacci-{n}").up
    turned = np.radians(0.2) * rng.standard_normal((n, 3)) if kind == "off" else np.zeros((n, 3))
    force = up + np.cross(turned, up)
    values = 0.02 + force @ (np.eye(3) + 0.01 * rng.standard_normal((3, 3))).T
    values += 2e-3 * force**3 if kind == "cubic" else 0.0
    values += NOISE * rng.standard_normal(values.shape)
    values[7, 1] += 1e-2 if kind == "outlier" else 0.0
    u = np.random.default_rng(9).uniform(0.8, 1.2, values.shape) * NOISE
    return mp.Readings(values, up=up, u=u if stated else None)


def with_finding(way: str, n: int, name: str) -> Ratio:
    stated, options = way.startswith("u"), WAYS[way]
    sets = [
        [readings(n, kind, stated=stated, seed=seed) for seed in range(4)]
        for kind in (FOUND[name], "clean")
    ]
    work = [lambda mine=mine: [mp.fit(each, **LISTED, **options) for each in mine] for mine in sets]
    pairs = cpu(*work, repeats=5, inner=1)
    return Ratio(f"fit, {way}, {n:,} positions, {name}", "the same without", pairs, 3)


def table(units: int) -> dict[str, Array]:
    """Return the rows of units at 24 positions."""
    rows = [readings(24, "clean", seed=seed).values for seed in range(units)]
    columns = dict(zip(("ax", "ay", "az"), np.concatenate(rows).T, strict=True))
    return {"unit": np.repeat(np.arange(units), 24), **columns}


def one_unit(options: dict[str, Any]) -> Ratio:
    said = ", ".join(options) or "known"
    options = {"scheme": "fibonacci-24", **LISTED, **options}
    both = table(1)
    rows = {name: column for name, column in both.items() if name != "unit"}
    pairs = cpu(
        lambda: mp.fit_many(both, unit_column="unit", **options),
        lambda: mp.fit(rows, **options),
        15,
        5,
    )
    return Ratio(f"fit_many of one unit, {said}", "fit", pairs, 1.2)


def own_models() -> Ratio:
    units, looped, options = 1000, 20, {"scheme": "fibonacci-24", "model": OWN, **LISTED}
    both = table(units)
    rows = [
        {name: column[24 * i : 24 * i + 24] for name, column in both.items() if name != "unit"}
        for i in range(looped)
    ]
    pairs = cpu(
        lambda: mp.fit_many(both, unit_column="unit", **options),
        lambda: [mp.fit(each, **options) for each in rows],
        5,
        1,
    )
    scaled = [pair * looped / units for pair in pairs]
    return Ratio(f"fit_many, {units} units, a user-defined model", "a loop of fit", scaled, 1 / 20)


def beside_lm() -> Ratio:
    _, values = simulate(24)

    def peer() -> object:
        found = least_squares(
            residuals, natural_start(values), jac=jacobian, method="lm", args=(values,)
        )
        return found.x, np.linalg.inv(found.jac.T @ found.jac) * 2.0 * found.cost / 12

    def ours() -> object:
        given = mp.Readings(values, unit="g")
        return mp.fit(given, model="own-quadratic", unknown_orientation=True)

    what, by = "fit, 24 unknown orientations", "scipy lm, analytic slopes, with covariance"
    return Ratio(what, by, cpu(ours, peer, 15, 10), 3)


def seconds(work: Callable[[], object]) -> float:
    begun = time.process_time()
    work()
    return time.process_time() - begun


def auto(n: int, goal: float) -> Ratio:
    """Return the time of `--orientation-sd auto`, in milliseconds a position."""
    given = readings(n, "off")
    each = [1e3 / n * seconds(lambda: mp.fit(given, orientation_sd="auto")) for _ in range(4)]
    what = f"fit, --orientation-sd auto, a position of {n:,}"
    return Ratio(what, "a millisecond", each[1:], goal)


def many_outputs() -> Ratio:
    def fit(outputs: int) -> Callable[[], object]:
        rng = np.random.default_rng(2)
        up = mp.read_scheme("fibonacci-24").up
        values = np.tile(up, outputs // 3) + NOISE * rng.standard_normal((24, outputs))
        names = [f"a{i}" for i in range(outputs)]
        given = mp.Readings(values, up=up, outputs=names)
        axes = ["x", "y", "z"] * (outputs // 3)
        return lambda: mp.fit(given, axes=axes, orientation_sd=0.1)

    pairs = cpu(fit(48), fit(12), 3, 1)
    return Ratio("fit, uncertain orientations, 48 outputs", "12 outputs", pairs, 4**1.3)


def printed(program: str, *arguments: str, **environment: str) -> list[float]:
    """Return the numbers of the last line that a program prints, in a process of its own."""
    kept = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    found = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", program, *arguments],
        env={**kept, **environment},
        stdout=subprocess.PIPE,
        check=True,
        text=True,
    )
    return [float(each) for each in found.stdout.splitlines()[-1].split()]


def large() -> list[Ratio]:
    times, sizes = zip(*(printed(LARGE, OMP_NUM_THREADS="1") for _ in range(3)), strict=True)
    what = "fit, 1,000,000 known positions"
    return [
        Ratio(what, "a second", times, 1.5),
        Ratio(f"{what}, memory", "500 MB", [size / 500 for size in sizes], 1),
    ]


def report() -> Ratio:
    times = [printed(REPORT, OMP_NUM_THREADS="1")[0] for _ in range(3)]
    return Ratio("report of 24 positions as .html, with Matplotlib", "a second", times, 1.2)


DRIVER = """\
#include <stdio.h>
void multipos_compensate(const NUMBER raw[3], NUMBER accel[3]);
int main(void)
{
    NUMBER sum = 0, raw[3], accel[3];
    for (int i = 0; i < 20000000; ++i) {
        for (int k = 0; k < 3; ++k) raw[k] = (NUMBER)((i * (k + 3)) % 1999 - 999) / 1000;
        multipos_compensate(raw, accel);
        sum += accel[0] + accel[1] + accel[2];
    }
    printf("%g\\n", (double)sum);
    return 0;
}
"""


def compensation_in_c() -> list[Ratio]:
    """Return the time of C in single precision over that in double, where there is a compiler."""
    if shutil.which("gcc") is None:
        return []
    found = []
    for model, goal in (("linear", 1.05), ("own-quadratic", 0.67)):
        given = readings(24, "clean")
        calibration = mp.fit(given, model=model, **LISTED)
        with tempfile.TemporaryDirectory() as name:
            programs = [
                compiled_in(Path(name), number, mp.export(calibration, "c", float=single).text)
                for number, single in (("float", True), ("double", False))
            ]
            pairs = paired_process_ratio(*([each] for each in programs), timer=time_of_children)
        what = f"C, {model}, --float, with its loop"
        found.append(Ratio(what, "the same in double", pairs, goal))
    return found


def compiled_in(folder: Path, number: str, text: str) -> str:
    """Return a program that compensates twenty million readings."""
    sources = {"export": text, "driver": DRIVER.replace("NUMBER", number)}
    for name, source in sources.items():
        (folder / f"{name}_{number}.c").write_text(source, encoding="utf-8")
    files = [str(folder / f"{name}_{number}.c") for name in sources]
    program = str(folder / number)
    subprocess.run(["gcc", "-std=c99", "-O2", *files, "-lm", "-o", program], check=True)
    return program


def threads() -> Ratio:
    """Return the time of a command with threads as it sets them, over that with one."""
    with tempfile.TemporaryDirectory() as folder:
        record, found = Path(folder) / "record.csv", f"{folder}/found.json"
        values = np.random.default_rng(0).standard_normal(1_000_000)
        np.savetxt(record, values, fmt="%.6g", header="ax", comments="")
        program = COMMAND, str(record), found
        pairs = [printed(*program)[0] / printed(*program, OMP_NUM_THREADS="1")[0] for _ in range(5)]
    return Ratio("multipos stability, 10⁶ rows, threads by default", "one thread", pairs, 1.1)
