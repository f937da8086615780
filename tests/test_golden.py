"""Every kind of result on fixed data, against the numbers of the version in golden.json.

Only public names are used, so that the test stands whatever becomes of the package inside. Values
and u are held to 1e-10 of the larger of |value| and u, those of iterated estimators to 1e-6 of u.
Only numbers are held, no texts or findings, and only those in the file: a result may say more.

``python tests/test_golden.py [CASE …]`` writes the numbers of this version, of all cases or of
those named, for a change that is meant to move them.
"""

import json
import math
import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from amounts import slow_where

import multipos as mp
from multipos.designs.prospects import begin, information_of
from multipos.positions.benches import read_bench

GOLDEN = Path(__file__).with_name("golden.json")
SHARED = Path(__file__).resolve().parents[1].parent / "shared" / "data"
EXACT, ITERATED, SEARCHED = 1e-10, 1e-6, 1e-4
ROUNDING = 1e-15  # of numbers that should be zero
LONGEST = 24  # numbers of a list that are held one by one; of longer ones their sums
PROBABILITIES = frozenset(("p", "p_total", "p_robust", "drift_p"))

# texts, provenance, what was given, and what is rounding alone
LEFT_OUT = frozenset(
    [
        "aliases",
        "at",
        "calibration",
        "calibrations",
        "harmonics",
        "condition",
        "confidence",
        "created",
        "cross_check",
        "customary",
        "findings",
        "environment",
        "file",
        "findings",
        "hidden",
        "input",
        "k",
        "model",
        "multipos_version",
        "notes",
        "outliers",
        "positions",
        "attitude",
        "reading_dof",
        "reading_sd",
        "reading_u",
        "readings",
        "reference_environment",
        "residual_harmonics",
        "rows",
        "samples",
        "schema",
        "scheme",
        "sha256",
        "source",
        "status",
        "symbol",
        "tested",
        "text",
        "unidentifiable",
        "up",
        "version",
        "warnings",
    ]
)

# of a calibration, what follows from its parameters is held in these cases alone
WHOLE = frozenset(("closed_form", "few_or_many_outputs", "forces_uncertain", "used"))
DERIVED = frozenset(("intrinsic", "installation_deg", "linearity", "reference"))
DIAGNOSED = ("rank", "leverage", "lack_of_fit", "model_tests")

CASES = {}


def case(tolerance=EXACT, needs=None):
    """Return a decorator that registers a function that returns named results."""

    def register(function):
        CASES[function.__name__] = (function, tolerance, needs)
        return function

    return register


# --- data: fixed seeds, and sums written out, so that no library's kernel has a part in it


def noise(seed, *shape):
    """Nearly normal numbers of variance 1: twelve uniform ones of a stream that never changes."""
    total = np.zeros(shape)
    stream = np.random.RandomState(seed)
    for _ in range(12):
        total = total + stream.random_sample(shape)
    return total - 6.0


def unit(v):
    return v / np.sqrt(v[:, :1] ** 2 + v[:, 1:2] ** 2 + v[:, 2:] ** 2)


BIAS = (0.012, -0.020, 0.030)
ROWS = ((0.990, 0.012, -0.008), (-0.015, 1.015, 0.011), (0.009, -0.013, 1.004))


def sensed(up, seed=1, sd=1e-4, quadratic=0.0, cubic=0.0, product=0.0):
    """Readings (n, 3) of a triad."""
    x, y, z = up[:, 0], up[:, 1], up[:, 2]
    columns = []
    for i, (b, row) in enumerate(zip(BIAS, ROWS, strict=True)):
        own, other = (x, y, z)[i], (x, y, z)[(i + 1) % 3]
        column = b + row[0] * x + row[1] * y + row[2] * z
        columns.append(column + quadratic * own**2 + cubic * own**3 + product * own * other)
    return np.stack(columns, axis=1) + sd * noise(seed, len(up), 3)


def turned(up, sd_deg, seed=11):
    """Up vectors that are off by about sd_deg about each axis."""
    return unit(up + math.radians(sd_deg) * noise(seed, len(up), 3))


def table(up, values, names=("ax", "ay", "az"), **columns):
    found = dict(zip(names, values.T, strict=True)) | columns
    return found if up is None else dict(zip(("up_x", "up_y", "up_z"), up.T, strict=True)) | found


def at(scheme):
    return mp.read_scheme(scheme).up


def triad(scheme="fibonacci-24", off=0.0, **options):
    up = at(scheme)
    return table(up, sensed(turned(up, off) if off else up, **options))


def rolled(off=0.0, **options):
    """Readings of two rolls, without the up vectors: the scheme has their whole attitude."""
    up = at("dual-axis-48")
    return table(None, sensed(turned(up, off) if off else up, **options))


# --- fits


def fit(readings, **options):
    """Fit with all rows, and at exact orientations where a case says nothing of them."""
    said = {"unknown_orientation", "closed_form", "orientation_sd"} & options.keys()
    columns = readings if isinstance(readings, dict) else {}
    listed = not isinstance(readings, mp.Readings) or readings.orientation_sd is None
    if not said and listed and "orientation_sd_deg" not in columns:
        options["orientation_sd"] = 0
    return mp.fit(readings, exclude="none", **options)


@case()
def known():
    quadratic = {"quadratic": 8e-4, "cubic": 3e-4, "product": 2e-4}
    for scheme in ("faces-6", "faces-edges-18", "all-26", "dual-axis-48"):
        yield f"linear {scheme}", fit(triad(scheme))
    yield (
        "own-quadratic song-qin-6",
        fit(triad("song-qin-6", **quadratic), model="own-quadratic"),
    )
    yield "own-quadratic all-26", fit(triad("all-26", **quadratic), model="own-quadratic")
    yield "own-cubic all-26", fit(triad("all-26", **quadratic), model="own-cubic")
    yield "cross-quadratic", fit(triad("fibonacci-40", **quadratic), model="cross-quadratic")
    for scheme in ("fibonacci-60", "dual-axis-48+roll-z-24"):
        yield f"ieee {scheme}", fit(triad(scheme, **quadratic), model="ieee")
    yield "ieee-odd", fit(triad("fibonacci-60", **quadratic), model="ieee-odd")
    formula = "1 + x + y + z + own^2 + own*|own|"
    yield "formula", fit(triad("fibonacci-40", **quadratic), model=formula)
    yield "pool", fit(triad("faces-edges-18"), pool=True)
    gravity = table(-at("fibonacci-24"), sensed(at("fibonacci-24")))
    yield "convention gravity", fit(gravity, convention="gravity", confidence=0.99)
    yield "gravity", fit(triad(), gravity=9.81234, gravity_u=3e-4)
    yield "latitude", fit(triad(**quadratic), latitude=48.0, height=300.0, model="own-quadratic")
    repeated = triad("faces-6+faces-6+faces-6", seed=4)
    repeated["position"] = [str(1 + i % 6) for i in range(18)]
    yield "repeats", fit(repeated)
    yield "nominal", fit(triad(), nominal=(0.01, 1.02), unit="V")
    yield "demo", mp.demo().calibration


@case()
def closed_form():
    yield "demo", mp.demo().closed_form
    yield "linear", fit(triad("faces-6"), closed_form=True)
    yield "own-quadratic", fit(triad("song-qin-6"), closed_form=True, model="own-quadratic")


@case()
def chosen_terms():
    yield "stepwise", fit(triad("all-26", quadratic=8e-4), model="ieee", stepwise=True)
    yield (
        "stepwise two",
        fit(triad("fibonacci-60", cubic=2e-3, product=1e-3), model="ieee", stepwise=True),
    )


@case(ITERATED)
def stated_noise():
    data = triad("faces-edges-18")
    for name, sd in (("right", 1e-4), ("denied", 2e-5), ("overstated", 1e-3)):
        yield name, fit(data, reading_sd=sd)
    yield "denied quadratic", fit(triad("all-26"), reading_sd=2e-5, model="own-quadratic")
    yield "each output", fit(data, reading_sd=[1e-4, 3e-5, 2e-4])
    yield "pool", fit(data, reading_sd=5e-5, pool=True)
    n = len(data["ax"])
    u = 1e-4 * (1.0 + 0.5 * noise(5, n, 3) ** 2)
    stated = table(None, u, ("u_ax", "u_ay", "u_az"))
    yield "columns", fit(data | stated)
    dof = {f"dof_a{axis}": 5.0 + np.arange(n) % 4 for axis in "xyz"}
    yield "columns with dof", fit(data | stated | dof)
    small = {name: 0.2 * column for name, column in stated.items()}
    yield "columns denied with dof", fit(data | small | dof)
    values = table(None, sensed(at("fibonacci-24"), seed=8))
    share = np.full((72, 72), 4e-9) + np.diag(np.full(72, 1e-8))
    together = mp.Readings(
        np.stack(list(values.values()), axis=1),
        outputs=("ax", "ay", "az"),
        up=at("fibonacci-24"),
        covariance=share,
    )
    yield "covariance", fit(together)


@case(ITERATED)
def uncertain():
    data = triad("fibonacci-24", off=0.1)
    yield "fixed", fit(data, orientation_sd=0.1)
    yield "fixed reading_sd", fit(data, orientation_sd=0.1, reading_sd=1e-4)
    yield "fixed reading_sd denied", fit(data, orientation_sd=0.1, reading_sd=1e-5)
    yield (
        "fixed quadratic",
        fit(triad("all-26", off=0.1, quadratic=3e-3), orientation_sd=0.1, model="own-quadratic"),
    )
    yield "auto", fit(data, orientation_sd="auto", reading_sd=1e-4)
    yield "auto alone", fit(triad("all-26", off=0.2), orientation_sd="auto")
    sd = np.where(np.arange(24) % 3, 0.1, 0.02)
    yield "column", fit(data | {"orientation_sd_deg": sd}, reading_sd=1e-4)
    exact = np.where(np.arange(24) % 2, 0.1, 0.0)
    yield "column with exact rows", fit(data | {"orientation_sd_deg": exact})
    yield "level", fit(rolled(), scheme="dual-axis-48", level_sd=0.05)
    both = {"level_sd": 0.05, "orientation_sd": 0.05, "reading_sd": 1e-4}
    yield "level uncertain", fit(rolled(0.05), scheme="dual-axis-48", **both)
    yield "gravity", fit(data, orientation_sd=0.1, gravity=9.81234, gravity_u=3e-4)


@case(ITERATED)
def unknown():
    up = at("fibonacci-24")
    data = table(None, sensed(up))
    for gauge in ("lower", "symmetric"):
        yield gauge, fit(data, unknown_orientation=True, gauge=gauge)
        yield (
            f"{gauge} reading_sd",
            fit(data, unknown_orientation=True, gauge=gauge, reading_sd=1e-4),
        )
    yield "denied", fit(data, unknown_orientation=True, reading_sd=2e-5)
    yield "overstated", fit(data, unknown_orientation=True, reading_sd=1e-3)
    uneven = sensed(up, sd=0.0) + noise(6, 24, 3) * np.array([1e-4, 5e-4, 2e-3])
    yield "unequal axes", fit(table(None, uneven), unknown_orientation=True)
    yield (
        "unequal axes stated",
        fit(table(None, uneven), unknown_orientation=True, reading_sd=[1e-4, 5e-4, 2e-3]),
    )
    bent = table(None, sensed(at("fibonacci-40"), quadratic=3e-3))
    yield "own-quadratic", fit(bent, unknown_orientation=True, model="own-quadratic")
    yield "gravity", fit(data, unknown_orientation=True, gravity=9.81234, gravity_u=3e-4)


@case(ITERATED)
def robust():
    data = triad("faces-edges-18")
    data["ax"] = data["ax"] + np.where(np.arange(18) == 7, 5e-3, 0.0)
    for loss in ("huber", "soft-l1", "cauchy"):
        yield loss, fit(data, robust=loss)
        yield f"{loss} reading_sd", fit(data, robust=loss, reading_sd=1e-4)
    free = {name: data[name] for name in ("ax", "ay", "az")}
    yield "unknown", fit(free, robust="huber", unknown_orientation=True)
    yield "uncertain", fit(data, robust="huber", orientation_sd=0.05, reading_sd=1e-4)
    yield "quadratic", fit(data, robust="cauchy", model="own-quadratic")


@case(ITERATED)
def mixed():
    up = at("fibonacci-24")
    sd = np.where(np.arange(24) < 6, 0.0, np.where(np.arange(24) < 16, 0.1, np.nan))
    listed = np.where(np.isnan(sd)[:, None], np.nan, up)
    values = sensed(turned(up, 0.0))
    names = ("ax", "ay", "az")
    yield (
        "some known, some not",
        fit(
            mp.Readings(values, outputs=names, up=listed, orientation_sd=np.radians(sd)),
            reading_sd=1e-4,
        ),
    )
    R = ((0.36, 0.48, -0.8), (-0.8, 0.6, 0.0), (0.48, 0.64, 0.6))
    x, y, z = up.T
    other = np.stack([r[0] * x + r[1] * y + r[2] * z for r in R], axis=1)
    group = ("",) * 24 + ("cube",) * 24
    both = np.concatenate([up, up])
    true = sensed(np.concatenate([up, other]), seed=3)
    yield "a group", fit(mp.Readings(true, outputs=names, up=both, group=group), reading_sd=1e-4)
    yield (
        "a group uncertain",
        fit(
            mp.Readings(true, outputs=names, up=both, group=group),
            orientation_sd=0.02,
            reading_sd=1e-4,
        ),
    )


@case(ITERATED)
def rolls():
    angle = np.concatenate([np.arange(4) * 90.0] * 3)
    lean = np.radians(noise(9, 12))
    free = np.radians(30.0 * np.arange(12) + 10.0 * noise(10, 12))
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    zero = np.zeros(12)
    axis = np.repeat(["x", "y", "z"], 4)
    up = np.stack(
        [
            np.where(axis == "x", zero, c),
            np.where(axis == "x", c, np.where(axis == "y", zero, s)),
            np.where(axis == "z", zero, s),
        ],
        axis=1,
    )
    open_ = np.stack([np.sin(lean), np.cos(lean) * np.cos(free), np.cos(lean) * np.sin(free)], 1)
    data = table(None, sensed(np.concatenate([up, open_])))
    data["roll_axis"] = [*axis, *["x"] * 12]
    data["angle_deg"] = [*(f"{a:.0f}" for a in angle), *[""] * 12]
    data["orientation_sd_deg"] = ["0"] * 12 + ["1"] * 12
    yield "beside known", fit(data)
    yield "beside known reading_sd", fit(data, reading_sd=1e-4)
    level = np.radians(45.0 * np.arange(8))
    c, s, zero = np.cos(level), np.sin(level), np.zeros(8)
    up = np.concatenate(
        [np.stack(one, axis=1) for one in ((zero, c, s), (c, zero, s), (c, s, zero))]
    )
    data = table(None, sensed(up)) | {"roll_axis": ["x"] * 8 + ["y"] * 8 + ["z"] * 8}
    yield "level", fit(data)
    yield "level stated", fit(data, reading_sd=1e-4)


@case(ITERATED)
def own_models():
    spring = "each = b + s*own/(1 + k*own^2)"
    data = triad("fibonacci-40", cubic=-2e-2)
    linear = "each = a + p*x + q*y + r*z"
    yield "linear", fit(data, model=linear)
    yield "linear stated", fit(data, model=linear, reading_sd=1e-4)
    yield (
        "linear unknown",
        fit(
            {name: data[name] for name in ("ax", "ay", "az")},
            model=linear,
            unknown_orientation=True,
        ),
    )
    yield "nonlinear", fit(data, model=spring + " + c*x + d*y + e*z", outputs="ax", axes="x")
    full = "each = b + s*own/(1 + common_k*own^2) + p*x*y + q*y*z"
    clean = at("fibonacci-40")
    read = np.stack([b + c / (1.0 + 0.05 * c**2) for b, c in zip(BIAS, clean.T, strict=True)], 1)
    clean = table(clean, read + 1e-4 * noise(12, 40, 3))
    yield "spring", fit(clean, model=spring)
    yield "spring stated", fit(clean, model=spring, reading_sd=1e-4)
    yield "spring uncertain", fit(clean, model=spring, orientation_sd=0.02, reading_sd=1e-4)
    yield "spring robust", fit(clean, model=spring, robust="huber")
    yield "common", fit(clean, model="each = b + s*own/(1 + common_k*own^2)")
    yield "common linear", fit(clean, model="each = b + s*own + common_k*own^3")
    yield "more terms", fit(clean, model=full)


def warm(scheme="fibonacci-24", seed=13):
    up = np.concatenate([at(scheme)] * 3)
    n = len(up) // 3
    T = np.repeat([0.0, 20.0, 45.0], n) + 0.5 * noise(seed, 3 * n)
    values = sensed(up, seed=seed) + (2e-5 * T[:, None] + 1e-4 * T[:, None] * up)
    return table(up, values) | {"temperature": T}


@case(ITERATED)  # zeros of soaks are integrated over
def temperature():
    cal = fit(warm(), model="1 + x + y + z + temperature + temperature*own")
    yield "fit", cal
    for curve in mp.over_temperature(cal, [0.0, 10.0, 30.0]):
        yield f"curve {curve.name}", {"value": curve.value, "u": curve.u, "U": curve.U}
    square = "1 + x + y + z + temperature + temperature^2 + temperature*own + temperature^2*own"
    yield "square", fit(warm("faces-6"), model=square)
    data = warm()
    chosen = ("ax", "ay", "az", "temperature")
    yield (
        "apply",
        mp.apply(cal, {name: data[name][::9] for name in chosen}, uncertainty=True, tilt=True),
    )


@case()
def few_or_many_outputs():
    data = triad("fibonacci-24")
    yield "one", fit(data, outputs="ay", axes="y")
    yield "one, two inputs", fit(triad("roll-z-12"), outputs="ax", axes="x", inputs="x,y")
    yield "two", fit(data, outputs="ax,az", axes="x,z")
    four = data | {"b": data["ax"] * 0.5 + 0.02 + 1e-4 * noise(14, 24)}
    four |= {"c": data["az"] * 1.5 - 0.01 + 2e-4 * noise(15, 24)}
    redundant = fit(four, outputs="ax,ay,az,b,c", axes="x,y,z,x,z")
    yield "redundant", redundant
    names = ("ax", "ay", "az", "b", "c")
    yield (
        "redundant applied",
        mp.apply(redundant, {name: four[name][:5] for name in names}, uncertainty=True),
    )
    two = fit(data, outputs="ax,ay", axes="x,y", inputs="x,y")
    yield "two inputs", two
    yield "two applied", mp.apply(two, {"ax": [0.1, 0.5], "ay": [0.7, 0.2]}, tilt=True)


@case(ITERATED)
def few_or_many_outputs_searched():
    four = triad("fibonacci-24")
    four["b"] = four["ax"] * 0.5 + 0.02 + 1e-4 * noise(14, 24)
    options = {"outputs": "ax,ay,az,b", "axes": "x,y,z,x", "reading_sd": 1e-4}
    yield "redundant", fit(four, orientation_sd=0.02, **options)
    yield (
        "one uncertain",
        fit(triad(off=0.1), outputs="ay", axes="y", orientation_sd=0.1, reading_sd=1e-4),
    )


@case()
def forces():
    f = np.concatenate([4.0 * at("fibonacci-24"), at("faces-6")])
    data = table(None, sensed(f, quadratic=8e-4, cubic=3e-4))
    data |= dict(zip(("f_x", "f_y", "f_z"), f.T, strict=True))
    yield "linear", fit(data)
    yield "own-cubic", fit(data, model="own-cubic")
    yield "gravity", fit(data, gravity=9.80123, gravity_u=1e-4, model="own-quadratic")


@case(ITERATED)
def forces_uncertain():
    f = np.concatenate([4.0 * at("fibonacci-24"), at("faces-6")])
    data = table(None, sensed(f))
    data |= dict(zip(("f_x", "f_y", "f_z"), f.T, strict=True))
    stated = {f"reference_u_{axis}": np.full(30, 2e-4) for axis in "xyz"}
    yield "reference u", fit(data | stated)
    yield "reference u reading_sd", fit(data | stated, reading_sd=1e-4)


@case(ITERATED)
def rows_correlated():
    up = np.concatenate([at("fibonacci-24")] * 4)
    slow = np.zeros((96, 3))
    for i, step in enumerate(noise(16, 96, 3)):
        slow[i] = 0.9 * slow[i - 1] + 3e-4 * step
    data = table(up, sensed(up) + slow) | {"time": 30.0 * np.arange(96)}
    yield "known", fit(data)
    yield "stated", fit(data, reading_sd=1e-4)
    free = {name: data[name] for name in ("ax", "ay", "az", "time")}
    yield "unknown", fit(free, unknown_orientation=True)


BENCH = {
    "gravity": {"value": 9.80123, "u": 1e-4},
    "level": {"half_width_deg": 0.00056, "distribution": "rectangular"},
    "index": {"u_deg": 0.00028, "harmonics": [1, 2]},
    "orientation": {"u_deg": 0.0002},
    "gain": {"U": 1e-5, "k": 2},
    "offset": {"u": 2e-6, "each_output": True},
    "resolution": {"step": 1e-6},
    "temperature": {"u": 0.1, "bias_per_degC": 1e-6, "scale_per_degC": 3e-5},
    "unseen": {"own^2": 1e-4, "own^3": 2e-4, "own*other": 1e-4},
}


@case()
def budgets():
    two = {"scheme": "dual-axis-48", "budget": BENCH}
    cal = fit(rolled(sd=1e-5), **two)
    yield "fit", cal
    found = mp.evaluate_budget(cal)
    yield "evaluated", {"covariance": found.covariance, "dof": found.dof}
    yield "lines", found.columns()
    yield "sphere", mp.evaluate_sphere(cal)
    later = {"level": {"u_deg": 0.01}}
    yield "later", mp.state_budget(fit(rolled(), scheme="dual-axis-48"), later)
    yield "pool", fit(rolled(), pool=True, model="own-quadratic", **two)
    apply_to = {"ax": [0.1, 0.9], "ay": [-0.3, 0.2], "az": [0.94, -0.4]}
    yield "applied", mp.apply(cal, apply_to, uncertainty=True, tilt=True)
    stable = {"stability": {"u_ax": 1e-4, "u_ay": 2e-4, "u_az": 1e-4, "dof": 5}}
    yield "stability", fit(triad("faces-edges-18"), budget=stable)


@case(ITERATED)
def budgets_searched():
    two = {"scheme": "dual-axis-48", "budget": BENCH, "reading_sd": 1e-4}
    turned_ = fit(rolled(0.02), orientation_sd=0.02, **two)
    yield "uncertain", turned_
    yield "sphere", mp.evaluate_sphere(turned_)
    free = table(None, sensed(at("fibonacci-24")))
    stated = {"gravity": BENCH["gravity"], "gain": BENCH["gain"], "unseen": BENCH["unseen"]}
    yield "unknown", fit(free, unknown_orientation=True, budget=stated)
    cal = fit(rolled(), **two)
    yield "stated", cal
    yield "simulated", {"u": mp.simulate_budget(cal, trials=200, rng=1).u}


# --- logs


@case(ITERATED)
def logs():
    cal = fit(triad("faces-edges-18"))
    log = mp.simulate_log(cal, "faces-edges-18", sample_sd=1e-3, seed=3, rest=4.0)
    yield "log", {name: column for name, column in log.items() if name != "position"}
    yield "averages", rests(mp.average(log))
    yield "averages by scheme", rests(mp.average(log, scheme="faces-edges-18"))
    yield "known", mp.calibrate(log, scheme="faces-edges-18")
    yield "known quadratic", mp.calibrate(log, scheme="faces-edges-18", model="own-quadratic")
    yield "unknown", mp.calibrate(log, unknown_orientation=True)
    yield "uncertain", mp.calibrate(log, scheme="faces-edges-18", orientation_sd=0.1)
    slow = mp.simulate_log(
        cal, "faces-6", sample_sd=1e-3, correlation_time=0.1, orientation_sd=0.1, seed=4
    )
    yield "slow noise", rests(mp.average(slow))
    yield "slow noise fitted", mp.calibrate(slow, scheme="faces-6")


def rests(averages):
    columns = averages.columns()
    return {n: c for n, c in columns.items() if np.asarray(c).dtype.kind in "fi"}


@case(ITERATED, needs="mpu9150_imu0.log")
def recorded_mpu9150():
    names = "ax,ay,az,wx,wy,wz"
    log = SHARED / "mpu9150_imu0.log"
    options = {"columns": names, "outputs": "ax,ay,az", "rate": 100.0, "unit": "m/s^2"}
    cal = mp.calibrate(log, unknown_orientation=True, **options)
    yield "fit", cal
    yield "averages", rests(mp.average(log, **{k: v for k, v in options.items() if k != "unit"}))
    yield "symmetric", fit(cal.readings, unknown_orientation=True, gauge="symmetric")
    yield "robust", fit(cal.readings, unknown_orientation=True, robust="huber")


@case(ITERATED, needs="ferraris_session.csv")
def recorded_ferraris():
    log = SHARED / "ferraris_session.csv"
    sections = json.loads((SHARED / "ferraris_session_sections.json").read_text("utf-8"))
    sections = {name: rows for name, rows in sections.items() if re.match("[xyz]_[pa]$", name)}
    signs = {f"{axis}_{s}": (axis, 1.0 - 2.0 * (s == "a")) for axis in "xyz" for s in "pa"}
    scheme = {"position": list(signs)} | {
        f"up_{axis}": [sign if axis == own else 0.0 for own, sign in signs.values()]
        for axis in "xyz"
    }
    options = {"sections": sections, "outputs": "acc_x,acc_y,acc_z", "rate": 102.4}
    yield "averages", rests(mp.average(log, **options))
    yield "fit", mp.calibrate(log, scheme=scheme, unit="m/s^2", **options)
    yield "uncertain", mp.calibrate(log, scheme=scheme, unit="m/s^2", orientation_sd=0.2, **options)


@case(ITERATED, needs="innalabs_24.csv")
def recorded_readings():
    for name in ("innalabs_24", "pointer_ee_24", "pointer_ab_24"):
        path = SHARED / f"{name}.csv"
        yield name, fit(path, unknown_orientation=True)
        yield f"{name} quadratic", fit(path, unknown_orientation=True, model="own-quadratic")
        yield f"{name} stated", fit(path, unknown_orientation=True, reading_sd=3e-4)
        yield f"{name} robust", fit(path, unknown_orientation=True, robust="soft-l1")


# --- what is done with calibrations


def checked(*given, **options):
    found = mp.check(*given, **options)
    arrays = {"errors": found.after, "u_errors": found.u, "U_errors": found.U, "En": found.En}
    return found.to_dict() | arrays


@case()
def used():
    cal = fit(triad("faces-edges-18"))
    data = triad("fibonacci-24", seed=21)
    raw = {name: data[name][:6] for name in ("ax", "ay", "az")}
    yield "apply", mp.apply(cal, raw, tilt=True, uncertainty=True)
    yield "apply reading_sd", mp.apply(cal, raw, tilt=True, uncertainty=True, reading_sd=1e-3)
    yield "apply parameters", mp.apply(cal, raw, uncertainty=True, parameters_only=True)
    bent = fit(triad("all-26", quadratic=8e-4), model="own-quadratic", gravity=9.81)
    yield "apply bent", mp.apply(bent, raw, tilt=True, uncertainty=True)
    yield "check", checked(cal, data, limit_g=5e-4)
    yield "check tilt", checked(cal, data, tilt=True, limit_deg=0.05, within_deg=60.0)
    yield "check bent", checked(bent, data, nominal=(0.0, 1.02), reading_sd=1e-4)
    yield "simulate", mp.simulate(bent, "fibonacci-12", order="paper", reading_sd=1e-4, seed=5)
    yield "simulate turned", mp.simulate(cal, "faces-6", orientation_sd=0.1, seed=6)
    yield "sphere", mp.evaluate_sphere(bent)
    yield "sphere 2 g", mp.evaluate_sphere(bent, size=2.0)
    others = [fit(triad("faces-edges-18", seed=seed)) for seed in (22, 23)]
    yield "compare", mp.compare(cal, *others)


@case(ITERATED)
def used_searched():
    options = {"unknown_orientation": True, "reading_sd": 1e-4}
    many = [fit(table(None, sensed(at("fibonacci-24"), seed=s)), **options) for s in (1, 2, 3)]
    yield "compare", mp.compare(*many)
    raw = {"ax": [0.1, 0.9], "ay": [-0.3, 0.2], "az": [0.94, -0.4]}
    yield "apply", mp.apply(many[0], raw, tilt=True, uncertainty=True)
    yield "sphere", mp.evaluate_sphere(many[0])
    data = triad("fibonacci-12", seed=31)
    turned_ = fit(triad(off=0.1), orientation_sd=0.1, reading_sd=1e-4)
    yield "check", checked(turned_, data, limit_g=1e-3)
    yield "check tilt", checked(turned_, data, tilt=True, limit_deg=0.1)
    for name, cal in (("stated", turned_), ("free", many[0])):
        begun = begin(cal)
        keys = [f"{output}:{term}" for output, term in cal.model.keys]
        now = begun.u(np.zeros_like(begun.present))
        then = begun.u(information_of(begun.setting, read_bench("all-26")))
        best = then[np.argmin(then[:, 0])]
        yield f"prospects {name}", {"u": dict(zip(keys, now, strict=True))}
        fall = 1.0 - best[0] / now[0]
        yield (
            f"prospects {name} best",
            {"fall": fall, "u": dict(zip(keys, best, strict=True))},
        )


@case()
def tumbles():
    for name in ("tumble-24", "roll-z-12+roll-x-12"):
        up = at(name)
        E = 0.01 + 1.3 * up[:, 0] + 1e-3 * up[:, 1] + 1e-4 * up[:, 0] ** 2 - 4e-5 * up[:, 0] ** 3
        E = E + 1e-5 * noise(41, len(up))
        two = "z + " if "+" in name else ""
        model = f"1 + x + y + {two}x^2 + x^3 + x*y + x*|x|"  # with Koq
        found = mp.tumble({"E": E}, scheme=name, unit="V", model=model)
        yield name, found
        yield f"{name} harmonics", {"by order": found.to_dict()["harmonics"]}
        stated = mp.tumble({"E": E}, scheme=name, unit="V", reading_sd=1e-5, model=model)
        yield f"{name} stated", stated
    name = "roll-z-12+roll-y-12+roll-x-12"
    values = table(None, sensed(at(name), sd=1e-5))
    yield "triad", mp.tumble(values, scheme=name, model="ieee-odd")
    first = fit(values, scheme=name)
    bench = {"reading_sd": 1e-5, "first_sd_deg": 1e-3, "level_sd_deg": 1e-3}
    stated = mp.state_bench(first, **bench)
    yield "bench", {"covariance": stated.covariance}
    yield (
        "bench all",
        {
            "covariance": mp.state_bench(
                first,
                **bench,
                zero_drift=1e-5,
                angle_sd_deg=1e-3,
                offset_sd_deg=2e-3,
                second_sd_deg=1e-3,
                wobble_sd_deg=5e-4,
            ).covariance
        },
    )
    yield "triad on a bench", mp.tumble(stated, model="ieee-odd")
    yield "table errors", mp.table_errors(first)
    head = np.tile(30.0 * np.arange(12), 3)
    yield "head", mp.tumble(values | {"head_deg": head}, scheme=name, model="ieee-odd")


@case(ITERATED)
def bench_fitted():
    name = "roll-z-12+roll-y-12+roll-x-12"
    first = fit(table(None, sensed(at(name), sd=1e-5)), scheme=name)
    stated = mp.state_bench(first, reading_sd=1e-5, first_sd_deg=1e-3, level_sd_deg=1e-3)
    yield "fit", fit(stated)
    yield "fit ieee", fit(stated, model="own-cubic")


def chamber(seed=51, n=240):
    time = np.arange(float(n))
    T = 20.0 + 40.0 * np.sin(time / 30.0)
    V = np.cos(time / 7.0)
    bend = np.where(T > 20.0, 2e-4 * (T - 20.0), 0.0)
    error = 0.01 + 3e-4 * T + 2e-6 * T**2 + bend + 1e-4 * V * T + 2e-4 * noise(seed, n)
    return {"time": time, "temperature": T, "V": V, "error": error}


@case()
def regressions():
    data = chamber()
    options = {"response": "error", "variables": "V,temperature"}
    yield "plain", mp.regress(data, **options)
    yield "degree 2", mp.regress(data, degree=2, **options)
    yield "stepwise", mp.regress(data, degree=3, stepwise=True, **options)
    cut = mp.regress(data, degree=2, segment="temperature:0,20", **options)
    yield "segments", cut
    yield "continuous", mp.regress(data, segment="temperature:20", continuous=True, **options)
    yield "auto", mp.regress(data, segment="temperature:auto", min_rows=40, **options)
    both = {name: np.concatenate([data[name], chamber(52)[name]]) for name in data}
    both["run"] = np.repeat(["a", "b"], 240)
    rates = {"response": "error", "variables": "V,temperature,temperature_rate"}
    runs = mp.regress(both, run="run", causal=True, rate_window=5.0, **rates)
    yield "runs", runs
    yield "rates", mp.regress(data, rate_window=9.0, **rates)
    yield "terms", mp.regress(data, response="error", terms="1 + temperature + V*|temperature|")
    yield "several", mp.regress(data, response="error,V", variables="temperature")
    later = {name: column[:8] for name, column in chamber(53).items()}
    yield "corrected", mp.correct(cut, later, uncertainty=True)
    yield "check", checked(cut, chamber(53), limit_g=1e-3)
    repeat = mp.regress(chamber(53), degree=2, segment="temperature:0,20", **options)
    yield "compare", mp.compare(cut, repeat)


@case()
def records():
    white, slow = 1e-4 * noise(61, 4000, 3), np.cumsum(1e-6 * noise(62, 4000, 3), axis=0)
    log = {"time": 0.01 * np.arange(4000)} | table(None, white + slow + np.array([0.0, 0.0, 1.0]))
    yield "stability", mp.stability(log, unit="g")
    two = {"time": log["time"]} | table(None, 1e-4 * noise(63, 4000, 3))
    yield "several", mp.stability(log, two, unit="g")


@case()
def designs():
    plain = ("faces-6", "corners-8", "faces-edges-18", "all-26", "dual-axis-48")
    yield "linear", judged(mp.schemes(*plain))
    yield "quadratic", judged(mp.schemes(*plain, model="own-quadratic"))
    yield "ieee", judged(mp.schemes("fibonacci-60", "all-26", model="ieee"))
    yield "unknown", judged(mp.schemes("all-26", "fibonacci-24", unknown_orientation=True))
    yield "uncertain", judged(mp.schemes("all-26", orientation_sd=0.1, reading_sd=1e-4))
    yield "own", judged(mp.schemes("all-26", model="each = b + s*own + common_k*own^2"))
    yield "up", {name: at(name) for name in (*plain, "song-qin-6", "fibonacci-60", "edges-12")}


def judged(found):
    return {one["name"]: one for one in found.to_dict()["schemes"]}


@case(SEARCHED)
def designs_searched():
    for name, options in {
        "linear": {"positions": 8},
        "quadratic": {"model": "own-quadratic", "positions": 12},
        "from all-26": {"model": "own-quadratic", "positions": 12, "candidates": "all-26"},
        "A": {"positions": 9, "criterion": "A"},
        "beside": {"positions": 9, "include": "faces-6"},
    }.items():
        found = mp.design(**options).to_dict()
        yield name, {key: found[key] for key in ("log_det", "optimum_log_det", "efficiency")}


# --- many units, files, the command line


def lot(seed, units=6, off=0.0, known=True, scheme="fibonacci-24"):
    up = at(scheme)
    values = [
        sensed(turned(up, off, seed + i) if off else up, seed=seed + 10 * i) * (1 + 0.01 * i)
        for i in range(units)
    ]
    columns = table(np.concatenate([up] * units) if known else None, np.concatenate(values))
    return columns | {"unit": np.repeat([f"U{i}" for i in range(units)], len(up))}


@case()
def many_exact():
    yield "known", mp.fit_many(lot(71), unit_column="unit")
    yield "quadratic", mp.fit_many(lot(72), unit_column="unit", model="own-quadratic")
    yield "pool", mp.fit_many(lot(73), unit_column="unit", pool=True, gravity=9.81, gravity_u=1e-3)
    two = lot(74, scheme="dual-axis-48", known=False)
    yield "budget", mp.fit_many(two, unit_column="unit", scheme="dual-axis-48", budget=BENCH)


@case(ITERATED)
def many_searched():
    for name, data, options in (
        ("stated", lot(75), {"reading_sd": 1e-4}),
        ("denied", lot(75), {"reading_sd": 2e-5}),
        ("robust", lot(76), {"robust": "huber"}),
        ("uncertain", lot(77, off=0.1), {"orientation_sd": 0.1}),
        ("uncertain stated", lot(77, off=0.1), {"orientation_sd": 0.1, "reading_sd": 1e-4}),
        ("auto", lot(78, off=0.1, units=3), {"orientation_sd": "auto", "reading_sd": 1e-4}),
        ("unknown", lot(79, known=False), {"unknown_orientation": True}),
        ("unknown stated", lot(79, known=False), {"unknown_orientation": True, "reading_sd": 1e-4}),
        ("symmetric", lot(79, known=False), {"unknown_orientation": True, "gauge": "symmetric"}),
        ("spring", lot(80, units=3), {"model": "each = b + s*own/(1 + k*own^2) + c*x + d*y + e*z"}),
    ):
        if name == "spring":
            options = options | {"outputs": "ax", "axes": "x"}
        yield name, mp.fit_many(data, unit_column="unit", **options)
    stations = lot(81, units=8) | {"station": np.repeat(["s", "t"], 96)}
    found = mp.fleet(stations, unit_column="unit", station_column="station").to_dict()
    yield "fleet", {name: found[name] for name in ("units", "fitted", "stations")}


@case()
def exports():
    """Numbers of the files, in their order, whatever the words around them."""
    cal = fit(triad("faces-edges-18"), gravity=9.80665, unit="g")
    for to in ("c", "px4", "ardupilot", "ros-imu-calib", "imucal"):
        yield to, {"numbers": numbers(mp.export(cal, to=to, allow_lossy=True).text)}
    up = at("faces-edges-18")
    counts = fit(table(up, 4096.0 * sensed(up)), unit="count")
    yield "inav", {"numbers": numbers(mp.export(counts, to="inav", allow_lossy=True).text)}
    bent = fit(triad("all-26", quadratic=8e-4), model="own-quadratic")
    yield "c bent", {"numbers": numbers(mp.export(bent, to="c").text)}
    warmed = fit(warm(), model="1 + x + y + z + temperature + temperature*own")
    yield "c warm", {"numbers": numbers(mp.export(warmed, to="c").text)}
    regression = mp.regress(chamber(), response="error", variables="V,temperature", degree=2)
    yield "c regression", {"numbers": numbers(mp.export(regression, to="c").text)}


def numbers(text):
    """The numbers of a file that have at least five digits behind the point."""
    return [float(one) for one in re.findall(r"-?\d+\.\d{5,}(?:[eE][-+]?\d+)?", text)]


@case()
def command_line():
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        mp.write_table(path / "r.csv", triad("faces-edges-18"))
        mp.write_table(path / "d.csv", {"ax": [0.1, 0.9], "ay": [-0.3, 0.2], "az": [0.94, -0.4]})
        yield "fit", run(path, "fit", "r.csv", "--model", "own-quadratic", "-o", "cal.json")
        yield "read back", mp.load(path / "cal.json")
        yield "apply", run(path, "apply", "cal.json", "d.csv", "--uncertainty", "--tilt")


def run(folder, *arguments):
    done = subprocess.run(
        [sys.executable, "-m", "multipos", *arguments, "--json"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(Path(mp.__file__).resolve().parents[1])},
    )
    assert done.stdout, done.stderr
    return json.loads(done.stdout)


# --- the numbers of a result


def content(result, whole=True):
    """Return the numbers of a result as nested dictionaries; derived ones where it is `whole`."""
    found = result if isinstance(result, dict) else result.to_dict()
    if "diagnostics" in found:
        kept = DIAGNOSED if whole else DIAGNOSED[:2]
        found = found | {"diagnostics": {key: found["diagnostics"].get(key) for key in kept}}
    if not whole:
        found = {key: one for key, one in found.items() if key not in DERIVED}
    return tidy(found) or {}


def tidy(value):
    """Return what is a number in a value: numbers, lists of them, dictionaries of both."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, dict):
        kept = {str(key): tidy(one) for key, one in value.items() if key not in LEFT_OUT}
        if {"value", "u", "U"} <= kept.keys() and kept.get("dof", 0) is None:
            kept["dof"] = math.inf
        return {key: one for key, one in kept.items() if one is not None} or None
    if isinstance(value, list | tuple):
        if all(one is None for one in value):
            return None
        flat = flattened(value)
        if flat is not None:
            return summed(flat) if len(flat) > LONGEST else flat or None
        return tidy(by_name(value)) if all(isinstance(one, dict) for one in value) else None
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.number):
        return None
    return None if math.isnan(value) else float(value)


def by_name(entries):
    """Return a list of dictionaries as one, by their names; without, as columns."""
    if all("name" in one for one in entries):
        return {str(one["name"]): one for one in entries}
    if all(one.keys() == entries[0].keys() for one in entries) and "term" not in entries[0]:
        return {key: [one[key] for one in entries] for key in entries[0]}
    words = ("output", "term", "response")
    return {
        " ".join([str(i), *(str(one[key]) for key in words if key in one)]): one
        for i, one in enumerate(entries)
    }


def flattened(values):
    """Return the numbers of nested lists, or None where something else is among them."""
    found = []
    for one in values:
        if isinstance(one, list | tuple):
            inner = flattened(one)
            if inner is None:
                return None
            found += inner
        elif one is None or (isinstance(one, float | np.floating) and math.isnan(one)):
            found.append(0.0)
        elif isinstance(one, int | float | np.number) and not isinstance(one, bool | np.bool_):
            found.append(float(one))
        else:
            return None
    return found


def summed(values):
    """Return the sum of a list, a sum that knows its order, and the sum of sizes."""
    weights = [(0.6180339887498949 * (i + 1)) % 1.0 for i in range(len(values))]
    return {
        "sums": [
            math.fsum(values),
            math.fsum(w * v for w, v in zip(weights, values, strict=True)),
            math.fsum(map(abs, values)),
        ]
    }


def rounded(tree, tolerance, key=""):
    """Return a tree as it is written: as many digits as are held, and no infinite number."""
    if isinstance(tree, dict):
        return {name: rounded(one, tolerance, name) for name, one in tree.items()}
    if isinstance(tree, list):
        return [rounded(one, tolerance, key) for one in tree]
    short = tolerance > EXACT and re.match("u|U|dof|k$|sums", key)
    return float(f"{tree:.{9 if short else 13}g}") if math.isfinite(tree) else str(tree)


PACKED = ("value", "u", "dof", "U")


def packed(tree):
    """Return a result with its parameters as lists, which is how the file has them."""
    table = tree.get("parameters", {})
    if not table or any(tuple(entry) != PACKED for entry in table.values()):
        return tree
    return tree | {"parameters": {name: list(entry.values()) for name, entry in table.items()}}


def unpacked(tree):
    """Return the result that was `packed`."""
    table = tree.get("parameters", {})
    if any(isinstance(entry, dict) for entry in table.values()):
        return tree
    named = {name: dict(zip(PACKED, entry, strict=True)) for name, entry in table.items()}
    return tree | {"parameters": named} if named else tree


def numbers_of(name):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        function, tolerance, _ = CASES[name]
        return {
            key: rounded(content(result, name in WHOLE), tolerance) for key, result in function()
        }


# --- the comparison


def differences(golden, now, tolerance, path=""):
    """Yield path, golden number, number now and their difference over what is allowed."""
    if isinstance(golden, dict):
        if not isinstance(now, dict):
            yield path, "a table", now, math.inf
            return
        for key, one in golden.items():
            below = f"{path} > {key}" if path else key
            if key not in now:
                yield below, one if isinstance(one, float) else "…", "missing", math.inf
            elif isinstance(one, dict):
                yield from differences(one, now[key], tolerance, below)
            else:
                measures = scales(key, one, golden, tolerance)
                yield from beyond(below, one, now[key], tolerance, measures)


def scales(key, golden, siblings, tolerance):
    """Return what differences are measured by, one for each number."""
    found = sizes(golden)
    if key in PROBABILITIES:
        return [1.0] * len(found)
    u = siblings.get("u" if key == "value" else f"u_{key}")  # these of columns of a table
    u = [0.0] * len(found) if u is None or isinstance(u, dict) else sizes(u)
    if any(u) and len(u) == len(found):
        pairs = zip(found, u, strict=True)
        return [v if v and tolerance > EXACT else max(one, v) for one, v in pairs]
    return [max(found)] * len(found)


def sizes(one):
    """Return |numbers| of a number or a list; of infinite ones 0."""
    return [
        0.0 if isinstance(v, str) else abs(v) for v in (one if isinstance(one, list) else [one])
    ]


def beyond(path, golden, now, tolerance, measures):
    golden, now = (one if isinstance(one, list) else [one] for one in (golden, now))
    if len(golden) != len(now) or any(isinstance(one, dict) for one in now):
        yield path, f"{len(golden)} numbers", f"{len(now)} numbers", math.inf
        return
    for i, (one, other, size) in enumerate(zip(golden, now, measures, strict=True)):
        if isinstance(one, str) or isinstance(other, str):
            off = 0.0 if one == other else math.inf
        else:
            off = abs(one - other) / (tolerance * size + ROUNDING)
        if off > 1.0:
            yield path + (f"[{i}]" if len(golden) > 1 else ""), one, other, off


def moved_text(found, tolerance):
    worst = sorted(found, key=lambda one: -one[3])[:30]
    return "\n".join(
        [
            f"{len(found)} numbers moved by more than {tolerance:g} of what they are held to.",
            "The worst first: in golden.json -> now (the difference over what is allowed)",
            *(f"  {path}: {one} -> {other}  ({off:.3g} x)" for path, one, other, off in worst),
        ]
    )


@pytest.fixture(scope="module")
def golden():
    return json.loads(GOLDEN.read_text("utf-8"))


LONG = {"designs", "designs_searched", "records", "regressions", "tumbles"}  # seconds


@pytest.mark.parametrize("name", slow_where(LONG.__contains__, CASES))
def test_numbers_stay(name, golden):
    _, tolerance, needs = CASES[name]
    if needs and not (SHARED / needs).exists():
        pytest.skip(f"no {SHARED / needs}")
    held = {key: unpacked(tree) for key, tree in golden[name].items()}
    found = list(differences(held, numbers_of(name), tolerance))
    assert not found, moved_text(found, tolerance)


def test_a_moved_number_is_found():
    entry = {"p": {"value": 2.0, "u": 1e-3, "dof": 5.0}, "list": [1.0, 2.0]}
    moved = {"p": {"value": 2.0 + 3e-10, "u": 1e-3, "dof": 5.0}, "list": [1.0, 2.0 + 1e-9]}
    assert not list(differences(entry, entry, EXACT))
    assert [one[0] for one in differences(entry, moved, EXACT)] == ["p > value", "list[1]"]
    assert [one[0] for one in differences(entry, {"p": moved["p"]}, ITERATED)] == ["list"]
    (late,) = differences(entry["p"], {**entry["p"], "value": 2.0 + 3e-9}, ITERATED)
    assert late[3] == pytest.approx(3.0, rel=1e-3)


def write(names):
    """Write the numbers of this version, of all cases or of those named."""
    kept = json.loads(GOLDEN.read_text("utf-8")) if GOLDEN.exists() else {}
    for name, (_, _, needs) in CASES.items():
        if (not names or name in names) and not (needs and not (SHARED / needs).exists()):
            kept[name] = numbers_of(name)
    lines = []
    for name in sorted(kept.keys() & CASES.keys()):
        inside = (
            f"{json.dumps(key)}:{json.dumps(packed(one), separators=(',', ':'))}"
            for key, one in kept[name].items()
        )
        lines.append(f"{json.dumps(name)}:{{\n" + ",\n".join(inside) + "\n}")
    GOLDEN.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    write(sys.argv[1:])
