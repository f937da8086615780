"""Logs of a million rows, and the exported C function, against what nothing can avoid."""

import csv
import io
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

import multipos as mp
from benchmarks.bench_startup import write_session
from benchmarks.timing import Ratio, paired_ratio
from multipos.compensation.applying_logs import apply_log
from multipos.exports.targets import export
from multipos.files.whole import write_text
from multipos.logs.averaging import average
from multipos.logs.opening import open_log

ROWS = 1_000_000
OUTPUTS = ("ax", "ay", "az")


def run() -> list[Ratio]:
    cal = calibration("linear")
    log = session(cal)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        write_csv(path, log)
        ratios = [
            average_csv(path),
            average_and_fit(Path(folder)),
            apply_csv(cal, path, Path(folder)),
            apply_memory(cal, log),
        ]
        for model, hand in (("linear", HAND_LINEAR), ("own-quadratic", HAND_QUADRATIC)):
            ratios += compiled(calibration(model), model, hand, Path(folder))
    return ratios


def calibration(model: str) -> mp.Calibration:
    rng = np.random.default_rng(1)
    up = mp.read_scheme("faces-corners-14").up
    K = np.eye(3) + 0.01 * rng.normal(size=(3, 3))
    y = up @ K.T + 0.1 + 1e-3 * up**2 + 1e-5 * rng.normal(size=up.shape)
    return mp.fit(mp.Readings(y, outputs=OUTPUTS, up=up), model=model, orientation_sd=0)


def session(cal: mp.Calibration) -> dict[str, np.ndarray]:
    """A million samples, 100 rests; five columns as loggers write them."""
    found = mp.simulate_log(
        cal, "fibonacci-100", rate=1000.0, rest=9.0, turn=1.0, sample_sd=1e-3, seed=1
    )
    log = {name: np.round(np.resize(column, ROWS), 6) for name, column in found.items()}
    log["time"] = np.arange(ROWS) / 1000.0
    log["temperature"] = np.round(25.0 + np.linspace(0.0, 5.0, ROWS), 3)
    return log


def write_csv(path: Path, columns: dict[str, np.ndarray]) -> None:
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))


def average_csv(path: Path) -> Ratio:
    pairs = paired_ratio(
        lambda: average(path, outputs=OUTPUTS),
        lambda: np.loadtxt(path, delimiter=",", skiprows=1),
        repeats=5,
        inner=1,
    )
    return Ratio("average, CSV of 1e6 rows", "numpy.loadtxt", pairs, 1)


def average_and_fit(folder: Path) -> Ratio:
    """A log of 51,000 rows and 38 rests, warm; the peer in C++ takes three times `loadtxt`."""
    path = folder / "session.txt"
    write_session(path)
    pairs = paired_ratio(
        lambda: mp.fit(average(path).readings, unknown_orientation=True),
        lambda: np.loadtxt(path),
        repeats=9,
        inner=1,
    )
    return Ratio("average and fit, 51,000 rows", "numpy.loadtxt", pairs, 3)


def apply_csv(cal: mp.Calibration, path: Path, folder: Path) -> Ratio:
    """Read, compensate, write; the peer writes the digits of the very same table."""
    ours, theirs = folder / "ours.csv", folder / "theirs.csv"
    inverse, bias = matrix(cal)

    def peer() -> None:
        table = np.loadtxt(path, delimiter=",", skiprows=1)
        force = (table[:, 1:4] - bias) @ inverse.T
        outside = (np.linalg.norm(force, axis=1) > 1.01).astype(int)
        rows = zip(table.tolist(), force.tolist(), outside.tolist(), strict=True)
        with theirs.open("w") as stream:
            stream.write("time,ax,ay,az,temperature,f_x,f_y,f_z,outside\n")
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerows([*row, *f, out] for row, f, out in rows)

    pairs = paired_ratio(
        lambda: write_text(ours, apply_log(cal, open_log(path))), peer, repeats=5, inner=1
    )
    return Ratio("apply, CSV to CSV", "numpy.loadtxt, csv.writer", pairs, 1.5)


def apply_memory(cal: mp.Calibration, log: dict[str, np.ndarray]) -> Ratio:
    raw = np.column_stack([log[name] for name in OUTPUTS])
    inverse, bias = matrix(cal)
    pairs = paired_ratio(
        lambda: mp.apply(cal, log), lambda: (raw - bias) @ inverse.T, repeats=9, inner=1
    )
    return Ratio("apply, 1e6 rows in memory", "(raw - o) @ T'", pairs, 3)


def matrix(cal: mp.Calibration) -> tuple[np.ndarray, np.ndarray]:
    linear = cal.model.linear_map({}) @ cal.parameters
    return np.linalg.inv(linear[:, 1:]), linear[:, 0]


HAND_LINEAR = """
void hand(const double raw[3], double accel[3])
{{
    static const double T[3][3] = {{{T}}}, o[3] = {{{o}}};
    double d[3];
    for (int i = 0; i < 3; ++i) d[i] = raw[i] - o[i];
    for (int k = 0; k < 3; ++k) accel[k] = T[k][0] * d[0] + T[k][1] * d[1] + T[k][2] * d[2];
}}
"""
HAND_QUADRATIC = """
void hand(const double raw[3], double accel[3])
{{
    static const double T[3][3] = {{{T}}}, o[3] = {{{o}}}, q[3] = {{{q}}};
    double d[3], f[3] = {{0.0, 0.0, 0.0}};
    for (int i = 0; i < 3; ++i) d[i] = raw[i] - o[i];
    for (int step = 0; step < {steps}; ++step) {{
        double r[3];
        for (int i = 0; i < 3; ++i) r[i] = d[i] - q[i] * f[i] * f[i];
        for (int k = 0; k < 3; ++k) f[k] = T[k][0] * r[0] + T[k][1] * r[1] + T[k][2] * r[2];
    }}
    for (int k = 0; k < 3; ++k) accel[k] = f[k];
}}
"""
TIMER = """
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <time.h>
void ours_compensate(const double raw[3], double accel[3]);
void hand(const double raw[3], double accel[3]);
static double raw[4096][3];
static double seconds(void (*f)(const double *, double *))
{
    struct timespec a, b;
    double accel[3], sum = 0.0;
    clock_gettime(CLOCK_MONOTONIC, &a);
    for (int k = 0; k < 500; ++k)
        for (int i = 0; i < 4096; ++i) { f(raw[i], accel); sum += accel[0]; }
    clock_gettime(CLOCK_MONOTONIC, &b);
    if (sum == 0.125) puts("");  /* so that nothing is left out */
    return (double)(b.tv_sec - a.tv_sec) + 1e-9 * (double)(b.tv_nsec - a.tv_nsec);
}
int main(void)
{
    for (int i = 0; i < 4096; ++i)
        for (int j = 0; j < 3; ++j) raw[i][j] = (double)((i * 7 + j * 13) % 2001 - 1000) / 1000.0;
    seconds(ours_compensate), seconds(hand);
    for (int k = 0; k < 15; ++k) printf("%.6f\\n", seconds(ours_compensate) / seconds(hand));
    return 0;
}
"""


def compiled(cal: mp.Calibration, model: str, hand: str, folder: Path) -> list[Ratio]:
    """Call both functions through a pointer from one loop, compiled with -O2."""
    text = export(cal, "c", name="ours").text
    inverse, bias = matrix(cal)
    numbers = {
        "T": ", ".join("{" + ", ".join(map(repr, row)) + "}" for row in inverse.tolist()),
        "o": ", ".join(map(repr, bias.tolist())),
        "q": "0.0",
        "steps": 0,
    }
    if model == "own-quadratic":
        own = zip(cal.outputs, "xyz", strict=True)
        numbers["q"] = ", ".join(repr(cal[output, f"{axis}^2"].value) for output, axis in own)
        numbers["steps"] = int(text.partition("step < ")[2].partition(";")[0])
    ratios = []
    for compiler in filter(shutil.which, ("gcc", "clang")):
        for name, content in (
            ("ours.c", text),
            ("hand.c", hand.format(**numbers)),
            ("timer.c", TIMER),
        ):
            (folder / name).write_text(content)
        program = folder / "timer"
        sources = [str(folder / name) for name in ("ours.c", "hand.c", "timer.c")]
        subprocess.run([compiler, "-std=c99", "-O2", *sources, "-o", str(program)], check=True)
        out = subprocess.run([str(program)], capture_output=True, text=True, check=True).stdout
        pairs = np.loadtxt(io.StringIO(out)).tolist()
        ratios.append(Ratio(f"exported C, {model}", f"written by hand, {compiler} -O2", pairs, 1.1))
    return ratios
