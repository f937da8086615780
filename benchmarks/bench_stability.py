"""Static records against allantools, which takes the same octaves from samples in memory."""

import allantools
import numpy as np

import multipos as mp
from benchmarks.timing import Ratio, paired_ratio
from multipos.bias_stability.allan import Phases, octaves

ROWS = 10_000_000
RATE = 1000.0


def run() -> list[Ratio]:
    samples = 1e-4 * np.random.default_rng(1).standard_normal(ROWS)
    log, taus = {"ax": samples}, np.array(octaves(ROWS)) / RATE

    def theirs() -> None:
        allantools.oadev(samples, rate=RATE, data_type="freq", taus=taus)

    def ours() -> None:
        with Phases() as phases:
            phases.feed(samples.copy())
            phases.sums(octaves(ROWS))

    curve = paired_ratio(ours, theirs, repeats=5, inner=1)
    whole = paired_ratio(lambda: mp.stability(log, rate=RATE), theirs, repeats=5, inner=1)
    return [
        Ratio("Allan curve, 1e7 samples", "allantools.oadev", curve, 1.0),
        Ratio("stability, 1e7 samples", "allantools.oadev", whole, 2.0),
    ]
