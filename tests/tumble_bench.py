"""A single axis turned on a dividing head: its truth, its output and its tumble."""

import numpy as np

import multipos as mp
from multipos.positions.scheme import read_scheme
from multipos.verification.coefficients import COEFFICIENTS

TRUTH = {
    "K0": 2e-3,
    "K1": 1.3,
    "K2": 1e-4,
    "K3": 3e-5,
    "Koq": -2e-5,
    "Kip": 5e-5,
    "Kio": -4e-5,
    "delta_o": 1e-3,
    "delta_p": -7e-4,
}


def output(a, truth=TRUTH):
    """The model equation of the standard, written out on a_i, a_p, a_o."""
    i, p, o = np.asarray(a, dtype=float).T
    t = dict.fromkeys(COEFFICIENTS, 0.0) | truth
    return t["K1"] * (
        t["K0"]
        + i
        + t["K2"] * i**2
        + t["K3"] * i**3
        + t["Koq"] * i * np.abs(i)
        + t["Kip"] * i * p
        + t["Kio"] * i * o
        + t["delta_o"] * p
        - t["delta_p"] * o
        + t["Kpp"] * p**2
        + t["Koo"] * o**2
    )


ONE_PLANE = "1 + x + y + x^2 + x^3 + x*y + x*|x|"  # what one roll shows, with Koq


def tumble(name, sd=0.0, seed=0, truth=TRUTH, **options):
    scheme = read_scheme(name)
    noise = sd * np.random.default_rng(seed).standard_normal(len(scheme))
    return mp.tumble({"E": output(scheme.up, truth) + noise}, scheme=name, unit="V", **options)


def triad(up, sd=0.0, seed=0, truth=TRUTH):
    """Three such outputs along x, y and z, at up vectors (n, 3)."""
    noise = sd * np.random.default_rng(seed).standard_normal((3, len(up)))
    return {
        f"a{axis}": output(np.roll(up, -i, axis=1), truth) + noise[i]
        for i, axis in enumerate("xyz")
    }
