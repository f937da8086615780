"""`fit` against the least squares it stands for: checks, names and diagnostics make the rest."""

import numpy as np

import multipos as mp
from benchmarks.timing import Ratio, paired_ratio


def run() -> list[Ratio]:
    rng = np.random.default_rng(0)
    up = mp.read_scheme("fibonacci-24").up
    values = 0.1 + up @ (np.eye(3) + 0.01 * rng.standard_normal((3, 3))).T
    values += 1e-3 * rng.standard_normal(values.shape)
    readings = mp.Readings(values, up=up)
    stated = mp.Readings(values, up=up, u=np.full(values.shape, 1e-3))

    def by_hand() -> list[tuple[np.ndarray, np.ndarray]]:
        """Coefficients and covariance of the three outputs, as one writes it without a package."""
        found = []
        for axis in range(3):
            design = np.column_stack([np.ones(24), up, up[:, axis] ** 2])
            b, rss, *_ = np.linalg.lstsq(design, values[:, axis], rcond=None)
            found.append((b, np.linalg.inv(design.T @ design) * rss[0] / (24 - 5)))
        return found

    peer = "numpy.linalg.lstsq, covariance"
    same = {"model": "own-quadratic", "orientation_sd": 0, "exclude": "none"}
    plain = paired_ratio(lambda: mp.fit(readings, **same), by_hand)
    with_u = paired_ratio(lambda: mp.fit(stated, **same), by_hand)
    return [
        Ratio("fit, 24 positions, own-quadratic", peer, plain, 15),
        Ratio("the same, u of the readings stated", peer, with_u, 30),
    ]
