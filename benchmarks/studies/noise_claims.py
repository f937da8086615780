"""What U covers against the noise that is stated; the table is of `benchmarks.coverage`.

`python -m benchmarks.studies.noise_claims` prints figures, and draws in the folder.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import multipos as mp
from multipos.plots import to_svg


def main() -> None:

    up = mp.read_scheme("icosahedron-12").up
    H = np.column_stack([np.ones(12), up])
    claims = (1.0, 0.7, 0.5, 0.3, 0.1)
    rng = np.random.default_rng(1)
    held = {"multipos": [], "the stated noise alone": []}
    for claim in claims:
        trusted_u = 1.96e-4 * claim * np.sqrt(np.diag(np.linalg.inv(H.T @ H)))
        found, trusted = [], []
        for _ in range(40):
            values = up + 1e-4 * rng.standard_normal((12, 3))
            stated = {"reading_sd": 1e-4 * claim, "orientation_sd": 0, "exclude": "none"}
            cal = mp.fit(mp.Readings(values, up=up), **stated)
            error = cal.parameters - np.eye(3, 4, 1).ravel()
            found.append(abs(error) <= cal.U)
            trusted.append(abs(error) <= np.tile(trusted_u, 3))
        held["multipos"].append(100 * np.mean(found))
        held["the stated noise alone"].append(100 * np.mean(trusted))

    figure = Figure(figsize=(6, 2.8), layout="constrained")
    axes = figure.subplots()
    for (name, share), mark in zip(held.items(), "os", strict=True):
        axes.plot(claims, share, f"{mark}-", label=name)
    axes.axhline(95.0, color="0.6", linestyle="--")
    axes.set(xlabel="stated noise over the noise", ylabel="held by U (95 %) [%]", ylim=(0, 105))
    axes.legend()
    Path("noise-claims.svg").write_text(to_svg(figure), encoding="utf-8")


if __name__ == "__main__":
    main()
