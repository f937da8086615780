"""A simulated bench for a dual-axis inclinometer: the figures of the inclinometer paper.

Liu Wei, Li Jie, Liu Yiming, *Research of MEMS digital inclinometer calibration compensation
method*, 2016, give a 5 V supply, 2.5 V at zero, about 40 mV from crest to trough on the other
channel as gravity goes by, 24 positions of 10 s a roll about each axis, ±0.1° before and ±0.05°
after. Their tables do not survive, so the bench is simulated: every number here is one of theirs
or a stated size, and seeds are fixed.

=====================  ===========================================================
zero and scale factor  2.5 V and 1 V/g, off so that the own-axis error is 0.1° at ±60°
cross axes             20 mV/g on the other channel; the third component optional
table                  0.005° standard deviation at each position
reading                0.1 mV rms, the mean of 10 s
zero drift             0.3 mV from one roll to the next, either way, see `ZERO_DRIFT`
=====================  ===========================================================
"""

from dataclasses import dataclass

import numpy as np

import multipos as mp

ROLL = np.arange(0.0, 360.0, 15.0)
CHECK = np.arange(-60.0, 61.0, 15.0)
READING = 1e-4  # [V]
TABLE_DEG = 0.005
# The zero of each run lies anywhere within a band of this width, so that from one roll to the next
# it moves by 0.3 mV at most and by 0.1 mV in the mean [V].
ZERO_DRIFT = 3e-4
DRIFT_SD = ZERO_DRIFT / np.sqrt(12.0)


@dataclass(frozen=True)
class Bench:
    """One inclinometer: U = zero + matrix @ (f_x, f_y, f_z)."""

    zero: np.ndarray  # (2,) [V]
    matrix: np.ndarray  # (2, 3) [V/g]


def make_bench(rng, *, third=0.0):
    """An inclinometer whose own axes are off by 0.1° at +60° or −60°, the worse of the two.

    Nominally f = U − 2.5 V: an error b + k sin 60° of the force is an error of the tilt of
    (b + k sin 60°)/cos 60°; zero and scale share it in a random proportion.
    """
    size = np.radians(0.1) * 0.5
    share = rng.uniform(0.2, 0.8, 2)
    sign = rng.choice([-1.0, 1.0], (2, 2))
    zero = 2.5 + sign[0] * share * size
    scale = 1.0 + sign[1] * (1.0 - share) * size / np.sin(np.radians(60.0))
    cross = 0.02 * rng.choice([-1.0, 1.0], 2)
    matrix = np.array([[scale[0], cross[0], third], [cross[1], scale[1], -third]])
    return Bench(zero, matrix)


def run(bench, axis, angles_deg, rng, *, reading=READING, table_deg=TABLE_DEG, drift=ZERO_DRIFT):
    """Readings (n, 2) [V] of a run about one axis; the table stands near the angles it shows."""
    angles = np.radians(angles_deg)
    zero = bench.zero + drift * rng.uniform(-0.5, 0.5, 2)
    stood = angles + np.radians(table_deg) * rng.standard_normal(len(angles))
    readings = zero + _up(axis, stood) @ bench.matrix.T
    return readings + reading * rng.standard_normal(readings.shape)


def _up(axis, angles):
    own = {"y": 0, "x": 1}[axis]
    up = np.zeros((len(angles), 3))
    up[:, own], up[:, 2] = np.cos(angles), np.sin(angles)
    return up


def calibration_run(bench, rng, **options):
    """Columns of a readings file: a roll about y (main axis x), then one about x."""
    main_x = run(bench, "y", ROLL, rng, **options)
    main_y = run(bench, "x", ROLL, rng, **options)
    values = np.concatenate([main_x, main_y])
    return {
        "roll_axis": np.repeat(["y", "x"], len(ROLL)),
        "angle_deg": np.tile(ROLL, 2),
        "Ux": values[:, 0],
        "Uy": values[:, 1],
    }


def check_run(bench, rng, table_deg=TABLE_DEG, **options):
    """An independent run over ±60° of tilt on each axis, the table angle being 90° less tilt.

    With `table_deg` 0 the angles are the truth, so that errors are those of the inclinometer.
    """
    angles = 90.0 - CHECK
    main_x = run(bench, "y", angles, rng, table_deg=table_deg, **options)
    main_y = run(bench, "x", angles, rng, table_deg=table_deg, **options)
    values = np.concatenate([main_x, main_y])
    return {
        "roll_axis": np.repeat(["y", "x"], len(angles)),
        "angle_deg": np.tile(angles, 2),
        "orientation_sd_deg": np.full(2 * len(angles), table_deg),
        "Ux": values[:, 0],
        "Uy": values[:, 1],
    }


def calibrated(bench, rng, inputs="x,y"):
    """The bench's own way: a first fit, and the fit that knows the bench."""
    first = mp.fit(calibration_run(bench, rng), inputs=inputs, unit="V")
    known = mp.state_bench(first, reading_sd=READING, zero_drift=DRIFT_SD, angle_sd_deg=TABLE_DEG)
    return mp.fit(known, inputs=inputs, unit="V")
