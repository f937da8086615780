"""What was found in samples as numbers in seconds, with their units and U.

- `Values` makes of the description of an output its `OutputStability`.
"""

from collections.abc import Sequence

import numpy as np

from multipos.bias_stability import trends
from multipos.bias_stability.allan import pooled_variances
from multipos.bias_stability.noise_laws import degrees_of_freedom
from multipos.bias_stability.stability_result import (
    Estimate,
    OutputStability,
    TemperatureCoefficient,
    WarmUp,
)
from multipos.bias_stability.static_records import RawRecord
from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import coverage_factor
from multipos.units import MICRO_G

_NOTHING = 0.1  # of the largest mean reading: an output that reads less has no ppm


class Values:
    """Numbers of several records in the units of time and of the outputs."""

    def __init__(
        self, raw: Sequence[RawRecord], lengths: Sequence[int], unit: str, confidence: float
    ) -> None:
        self._unit = unit
        self._rate, self._confidence = raw[0].rate, confidence
        self._raw, self._lengths = raw, lengths
        self._samples = [each.samples for each in raw]
        self._means = np.mean([each.blocks.mean(axis=1) for each in raw], axis=0)

    def output(self, index: int, found: trends.Description) -> OutputStability:
        """Return the stability of one output."""
        adev = self._deviation(index)
        dof = degrees_of_freedom(found.laws, self._lengths, self._samples)
        root = np.sqrt(self._rate)
        return OutputStability(
            tau=np.array(self._lengths) / self._rate,
            adev=adev,
            u=adev / np.sqrt(2.0 * dof),
            dof=dof,
            white_noise=self._law(found, 0, 1.0 / root, f"{self._unit}/sqrt(Hz)"),
            bias_instability=self._law(found, 1, 1.0, self._unit),
            random_walk=self._law(found, 2, root, f"{self._unit}/sqrt(s)"),
            drift=self._estimate(found.coefficients[trends.DRIFT], self._rate, f"{self._unit}/s"),
            warm_up=self._warm_up(found),
            temperature_coefficient=self._temperature(found, index),
        )

    def _deviation(self, index: int) -> Array:
        sums = np.zeros(len(self._lengths))
        for each in self._raw:
            sums[: each.sums.shape[1]] += each.sums[index]
        return np.asarray(np.sqrt(pooled_variances(sums, self._lengths, self._samples)))

    def _law(self, found: trends.Description, law: int, factor: float, unit: str) -> Estimate:
        value, u = found.laws.root(law, 1.0)
        U = found.laws.root(law, coverage_factor(self._confidence, np.inf))[1]
        return Estimate(value, u, U, np.inf, unit).scaled(factor, unit)

    def _estimate(self, found: trends.TrendEstimate, factor: float, unit: str) -> Estimate:
        U = coverage_factor(self._confidence, found.dof) * found.u
        return Estimate(found.value, found.u, U, found.dof, unit).scaled(factor, unit)

    def _warm_up(self, found: trends.Description) -> WarmUp | None:
        if found.time_constant is None:
            return None
        amplitude = self._estimate(found.coefficients[trends.WARM_UP], 1.0, self._unit)
        constant = self._estimate(found.time_constant, 1.0 / self._rate, "s")
        lowest = float(found.laws.deviation(np.array(self._lengths, dtype=np.float64)).min())
        times = np.log(max(abs(amplitude.value) / lowest, 1.0))
        return WarmUp(amplitude, constant, float(constant.value * times))

    def _temperature(self, found: trends.Description, index: int) -> TemperatureCoefficient | None:
        if trends.TEMPERATURE not in found.coefficients:
            return None
        change = self._estimate(found.coefficients[trends.TEMPERATURE], 1.0, f"{self._unit}/degC")
        micro_g = ppm = None
        if self._unit in MICRO_G:
            micro_g = change.scaled(MICRO_G[self._unit], "ug/degC")
        mean = float(self._means[index])
        if abs(mean) >= _NOTHING * np.abs(self._means).max() and mean != 0.0:
            ppm = change.scaled(1e6 / mean, "ppm/degC")
        return TemperatureCoefficient(change, micro_g, ppm)
