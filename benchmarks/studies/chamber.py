"""A chamber run over temperature: segments, averages at each temperature, the next switch-on.

`python -m benchmarks.studies.chamber` prints figures, and draws in the folder.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import multipos as mp
from benchmarks.chamber_run import run
from multipos.plots import to_svg


def main() -> None:
    modelled, independent = run(1), run(2)
    options = {
        "response": "error",
        "degree": 2,
        "stepwise": True,
        "rate_window": 5,
        "confidence": 0.9,
        "variables": "V,temperature,temperature_rate,ambient,ambient_rate",
        "segment": "temperature:-20,20",
        "free": True,
    }
    model = mp.regress(modelled, **options)
    print(model)

    def figures(left):
        return (
            f"max {1e3 * np.abs(left).max():.1f} mg, rms {1e3 * np.sqrt(np.mean(left**2)):.2f} mg"
        )

    for data in (modelled, independent):
        print(figures(np.asarray(mp.correct(model, data)["corrected"])))

    left = np.asarray(mp.correct(model, independent)["corrected"])
    figure = Figure(figsize=(6, 3), layout="constrained")
    axes = figure.subplots()
    for name, values in (("before", independent["error"]), ("after", left)):
        axes.plot(independent["temperature"][::4], 1e3 * values[::4], ".", label=name)
    axes.set(xlabel="temperature of the case [°C]", ylabel="error [mg]")
    axes.legend()
    Path("chamber-run.svg").write_text(to_svg(figure), encoding="utf-8")
    grid = [
        "temperature",
        "temperature^2",
        "temperature_rate",
        "ambient",
        "ambient^2",
        "ambient_rate",
    ]
    terms = "1 + " + " + ".join(grid)
    for power in ("V", "V^2"):
        terms += f" + {power} + " + " + ".join(f"{power}*{one}" for one in grid)
    second = mp.regress(
        modelled,
        response="error",
        terms=terms,
        stepwise=True,
        rate_window=5,
        confidence=0.9,
        segment="temperature:-20,20",
        free=True,
    )
    print(len(second.candidates))
    print(figures(np.asarray(mp.correct(second, independent)["corrected"])))
    whole = mp.regress(
        modelled,
        response="error",
        degree=2,
        stepwise=True,
        rate_window=5,
        confidence=0.9,
        variables="V,temperature,temperature_rate,ambient,ambient_rate",
    )
    print(figures(np.asarray(mp.correct(whole, independent)["corrected"])))

    def two_stage(data, degree):
        lap = (data["time"] // 12.0).astype(int)
        means = []
        for i in np.unique(lap):
            rows = lap == i
            if len(np.unique(data["force"][rows])) == 3:
                X = np.column_stack([np.ones(rows.sum()), data["force"][rows]])
                bias, scale = np.linalg.lstsq(X, data["V"][rows], rcond=None)[0]
                means.append((data["temperature"][rows].mean(), bias, scale))
        t, bias, scale = np.array(means).T
        return np.polyfit(t, bias, degree), np.polyfit(t, scale, degree)

    def left_by(polynomials, data):
        bias, scale = (np.polyval(p, data["temperature"]) for p in polynomials)
        return (data["V"] - bias) / scale - data["force"]

    for degree in (2, 3, 4):
        polynomials = two_stage(modelled, degree)
        print(
            degree,
            "|",
            figures(left_by(polynomials, modelled)),
            "|",
            figures(left_by(polynomials, independent)),
        )

    def one_problem(data, degree):
        terms = "1 + own"
        for power in range(1, degree + 1):
            terms += f" + temperature^{power} + temperature^{power}*own"
        columns = {
            "up_x": 1.0 - np.abs(data["force"]),
            "up_y": np.zeros(len(data["V"])),
            "up_z": data["force"],
            "temperature": data["temperature"],
            "V": data["V"],
        }
        return mp.fit(columns, model=terms, axes="z", inputs="z", unit="g")

    t = np.linspace(-40.0, 58.0, 50)
    truth = 1.0 + 1.5e-4 * (t - 20.0) + 8e-7 * (t - 20.0) ** 2
    for degree in (2, 3, 4):
        calibration = one_problem(modelled, degree)
        one = mp.over_temperature(calibration, t)[1].value
        two = np.polyval(two_stage(modelled, degree)[1], t)
        print(
            degree,
            "|",
            *(f"{1e3 * np.sqrt(np.mean((scale - truth) ** 2)):.2f}" for scale in (one, two)),
        )
    raw, other = independent["V"][:, None], {"temperature": independent["temperature"]}
    print(figures(calibration.compensate(raw, other)[:, 0] - independent["force"]))

    figure = Figure(figsize=(6, 3), layout="constrained")
    axes = figure.subplots()
    for degree, line in ((2, "-"), (4, "--")):
        together = mp.over_temperature(one_problem(modelled, degree), t)[1].value
        axes.plot(t, 1e3 * (together - truth), f"C0{line}", label=f"one problem, degree {degree}")
        apart = np.polyval(two_stage(modelled, degree)[1], t)
        axes.plot(
            t, 1e3 * (apart - truth), f"C1{line}", label=f"at each temperature, degree {degree}"
        )
    axes.set(xlabel="temperature [°C]", ylabel="error of the scale [mg/g]")
    axes.legend()
    Path("chamber-scale.svg").write_text(to_svg(figure), encoding="utf-8")

    def joined(seeds):
        parts = [run(seed) for seed in seeds]
        columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        return columns | {"run": np.repeat(seeds, [len(part["time"]) for part in parts])}

    unseen = [run(seed) for seed in range(9000, 9012)]

    def covered(regression):
        share = []
        for data in unseen:
            found = mp.correct(regression, data, uncertainty=True)
            inside = np.asarray(found["outside"]) == 0
            held = np.abs(np.asarray(found["corrected"])) <= np.asarray(found["U_corrected"])
            share.append(held[inside].mean())
        return f"{100 * np.mean(share):.0f} % covered, {100 * min(share):.0f} % in the worst run"

    options = {
        "response": "error",
        "degree": 2,
        "stepwise": True,
        "rate_window": 5,
        "causal": True,
        "variables": "V,temperature,temperature_rate,ambient,ambient_rate",
        "segment": "temperature:-20,20",
        "free": True,
    }
    print("one run    |", covered(mp.regress(run(100), **options)))
    for m in (3, 5, 10):
        print(m, "runs |", covered(mp.regress(joined(range(100, 100 + m)), run="run", **options)))

    figure = Figure(figsize=(6, 3), layout="constrained")
    axes = figure.subplots()
    for m, mark in ((1, "s"), (5, "o")):
        several = {"run": "run"} if m > 1 else {}
        found = mp.regress(joined(range(100, 100 + m)), **several, **options)
        zeros, U = [], []
        for data in unseen:
            told = mp.correct(found, data, uncertainty=True)
            zeros.append(1e3 * np.mean(told["corrected"]))
            U.append(1e3 * np.mean(told["U_corrected"]))
        at = np.arange(1, 13) + 0.1 * (m > 1)
        axes.errorbar(at, zeros, U, fmt=mark, capsize=2, label=f"{m} fitted")
    axes.axhline(0.0, color="0.6")
    axes.set(xlabel="unseen run", ylabel="mean error, and U of a row [mg]")
    axes.legend()
    Path("chamber-unseen.svg").write_text(to_svg(figure), encoding="utf-8")


if __name__ == "__main__":
    main()
