"""Named schemes against models, held to the optimum, and predicted u against simulation.

`python -m benchmarks.studies.schemes` prints figures, and draws in the folder.
"""

import math

import numpy as np

import multipos as mp
from multipos.plots import draw_efficiency, draw_scheme, new_figure


def main() -> None:
    models = ["linear", "own-quadratic", "own-cubic", "cross-quadratic", "ieee"]
    for model in models:
        found = mp.design(model, 14)
        proof = found["certificate"]
        print(
            f"{model:16}{proof['parameters']:3}{found['optimum_log_det']:12.6f}",
            proof["gap"] < 1e-6,
        )
    unknown = mp.design("linear", 12, unknown_orientation=True)
    print(f"{unknown['optimum_log_det']:.6f}")
    for model in ["own-cubic", "ieee"]:
        best = mp.design(model, 14)["optimum"]
        face = np.abs(best["positions"]).max(axis=1) > 0.999
        print(
            f"{model:10} faces {best['weights'][face].sum():.3f}"
            f" corners {best['weights'][~face].sum():.3f}"
        )
    schemes = [
        "faces-6",
        "edges-12",
        "icosahedron-12",
        "faces-corners-14",
        "faces-edges-18",
        "dodecahedron-20",
        "roll-x-8+roll-y-8+roll-z-8",
        "all-26",
        "dual-axis-48",
        "roll-z-24",
    ]

    def row(model, **options):
        entries = mp.schemes(*schemes, model=model, **options)["schemes"]
        return [e["d_efficiency"] for e in entries]

    columns = {model: row(model) for model in models}
    columns["norm only"] = row("linear", unknown_orientation=True)

    def cell(share):
        return "-" if share is None else f"{share:.3f}"

    print(" " * 27 + " ".join(f"{name[:9]:>9}" for name in columns))
    for i, name in enumerate(schemes):
        print(f"{name:27}" + " ".join(f"{cell(shares[i]):>9}" for shares in columns.values()))
    figure, axes = new_figure(2, height=2.8)
    draw_scheme("faces-6", axes[0], model="own-quadratic")
    draw_scheme("faces-corners-14", axes[1], model="own-quadratic")
    figure.savefig("scheme-maps.png", dpi=110)
    counts = range(8, 25, 2)
    designs = {model: [mp.design(model, n) for n in counts] for model in ["own-quadratic", "ieee"]}
    figure, (axes,) = new_figure()
    draw_efficiency(designs, axes)
    figure.savefig("scheme-efficiency.png", dpi=110)
    print(" ".join(f"{found['efficiency']:.3f}" for found in designs["own-quadratic"]))
    print(" ".join(f"{found['efficiency']:.3f}" for found in designs["ieee"]))
    rng, sd = np.random.default_rng(1), 1e-4
    scheme = mp.read_scheme("icosahedron-12")
    (entry,) = mp.schemes(scheme, unknown_orientation=True, reading_sd=sd)["schemes"]
    values = scheme.up + sd * rng.standard_normal((200, 12, 3))
    readings = dict(zip(("ax", "ay", "az"), values.reshape(-1, 3).T, strict=True))
    readings["unit"] = np.repeat(np.arange(200), 12)
    found = mp.fit_many(readings, unit_column="unit", unknown_orientation=True, reading_sd=sd)
    parameters = [found[name] for name in found if f"u_{name}" in found]
    ratio = np.std(parameters, axis=1, ddof=1) / list(entry["u"].values())
    print(bool(abs(ratio - 1).max() < 3.5 / math.sqrt(2 * 200)))


if __name__ == "__main__":
    main()
