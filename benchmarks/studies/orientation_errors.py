"""What orientation errors cost, by fits that know of them and fits that do not.

`python -m benchmarks.studies.orientation_errors` prints figures, and draws in the folder.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import multipos as mp
from multipos.plots import to_svg


def main() -> None:

    UP = mp.read_scheme("fibonacci-24").up
    BIAS = np.array([0.012, -0.020, 0.030])
    MATRIX = np.array([[0.990, 0.012, -0.008], [-0.015, 1.015, 0.011], [0.009, -0.013, 1.004]])
    LOWER = np.linalg.cholesky(MATRIX @ MATRIX.T)  # the same sensor in the lower gauge
    NOISE = 1e-5  # [g]

    def turn(sd_deg, rng):
        angles = np.radians(sd_deg) * rng.standard_normal((24, 3))  # the one about up does nothing
        turned = UP + np.cross(angles, UP)
        return turned / np.linalg.norm(turned, axis=1, keepdims=True)

    def errors(sd_deg, runs, matrix=MATRIX, noise=NOISE, seed=3, **how):
        """Errors of the parameters (runs, 3, 4) of as many calibrations; exact where none said."""
        how = how or {"orientation_sd": 0, "exclude": "none"}
        rng = np.random.default_rng(seed)
        values = np.array(
            [
                BIAS + turn(sd_deg, rng) @ matrix.T + noise * rng.standard_normal((24, 3))
                for _ in range(runs)
            ]
        )
        table = {"unit": np.repeat(np.arange(runs), 24)}
        table |= dict(zip(("ax", "ay", "az"), values.reshape(-1, 3).T, strict=True))
        if "unknown_orientation" not in how:
            table |= dict(zip(("up_x", "up_y", "up_z"), np.tile(UP, (runs, 1)).T, strict=True))
        found = mp.fit_many(table, unit_column="unit", **how)
        model = mp.fit(mp.Readings(values[0], up=UP), **how).model
        linear = model.linear_map({}) @ np.array([found[name] for name in model.names])
        return np.moveaxis(linear, -1, 0) - np.column_stack([BIAS, matrix])

    def rms_bias(rows):
        return np.sqrt(np.mean(rows[:, :, 0] ** 2))

    def rms_scale(rows):
        return np.sqrt(np.mean(rows[:, range(3), range(1, 4)] ** 2))

    plain = errors(0.01, 100)
    likely = errors(0.01, 100, orientation_sd=0.01, reading_sd=NOISE)
    print(f"bias  {rms_bias(plain) / rms_bias(likely):.0f} times better")
    print(f"scale {rms_scale(plain) / rms_scale(likely):.0f} times better")

    def rms_cross(rows):
        return np.sqrt(
            np.mean([rows[:, i, 1 + j] ** 2 for i in range(3) for j in range(3) if i != j])
        )

    print(f"cross terms {rms_cross(plain) / rms_cross(likely):.1f} times better")
    claimed = NOISE / np.sqrt(len(UP))  # of a bias, which is a mean
    for sd_deg in (0.01, 0.1):
        print(f"{sd_deg:4} degrees: too small by {rms_bias(errors(sd_deg, 100)) / claimed:.0f}")
    for sd_deg in (0.0001, 0.001, 0.01, 0.1, 1.0):
        known = errors(sd_deg, 40)
        given = errors(sd_deg, 40, orientation_sd=sd_deg, reading_sd=NOISE)
        auto = errors(sd_deg, 40, orientation_sd="auto")
        thrown = errors(sd_deg, 40, matrix=LOWER, unknown_orientation=True)
        row = [1e6 * rms_bias(rows) for rows in (known, given, auto, thrown)]
        print(f"{sd_deg:6} degrees {row[0]:8.1f} {row[1]:6.1f} {row[2]:6.1f} {row[3]:6.1f}")

    figure = Figure(figsize=(6, 3), layout="constrained")
    axes = figure.subplots()
    for label, (how, matrix) in {
        "least squares": ({}, MATRIX),
        "orientation sd estimated": ({"orientation_sd": "auto"}, MATRIX),
        "orientations thrown away": ({"unknown_orientation": True}, LOWER),
    }.items():
        angles = [0.0001, 0.001, 0.01, 0.1]
        rms = [1e6 * rms_bias(errors(sd_deg, 20, matrix, **how)) for sd_deg in angles]
        axes.loglog(angles, rms, "o-", label=label)
    axes.set(xlabel="placement [degrees]", ylabel="rms error of the bias [µg]")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.legend()
    Path("placement.svg").write_text(to_svg(figure), encoding="utf-8")
    unequal = np.array([1e-5, 1e-5, 1e-4])
    alike = errors(0.0, 200, LOWER, unequal, unknown_orientation=True)
    stated = errors(0.0, 200, LOWER, unequal, unknown_orientation=True, reading_sd=unequal)
    for i, axis in enumerate("xyz"):
        ratio = np.std(alike[:, i, 0]) / np.std(stated[:, i, 0])
        print(f"bias of {axis}: {ratio:.1f} times")


if __name__ == "__main__":
    main()
