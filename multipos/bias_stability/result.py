"""How stable a sensor at rest is: the result of `multipos.stability`.

Of every output, over all records together: the overlapping Allan deviation σ(τ) with its standard
uncertainty, the coefficients of the noise laws

    σ = N/√τ  white noise,    σ_min = .664 B  bias instability,    σ = K √(τ/3)  random walk,   (1)

drift, warm-up A exp(−t/T) and temperature coefficient; and how the zero repeats from record to
record.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from multipos.files.tables import Column
from multipos.files.trees import to_json
from multipos.files.whole import write_text
from multipos.numerics.arrays import Array
from multipos.results import Drawn, Result, Tabular
from multipos.units import STANDARD_GRAVITY

# What a unit of the readings is in µg, where it is one of acceleration.
MICRO_G = {"g": 1e6, "mg": 1e3, "m/s^2": 1e6 / STANDARD_GRAVITY}


@dataclass(frozen=True, eq=False)
class Estimate(Result):
    """A number with its standard and expanded uncertainty, degrees of freedom and unit."""

    value: float
    u: float
    U: float
    dof: float
    unit: str

    def scaled(self, factor: float, unit: str) -> "Estimate":
        """Return it in another unit, `factor` of which make one."""
        size = abs(factor)
        return Estimate(factor * self.value, size * self.u, size * self.U, self.dof, unit)


@dataclass(frozen=True, eq=False)
class WarmUp(Result):
    """What settles after switching on.

    Attributes
    ----------
    amplitude : Estimate
        Of the transient at the begin of a record, in the unit of the output.
    time_constant : Estimate [s]
    settled_after : float [s]
        When the transient has fallen below the smallest Allan deviation of the noise.
    """

    amplitude: Estimate
    time_constant: Estimate
    settled_after: float


@dataclass(frozen=True, eq=False)
class TemperatureCoefficient(Result):
    """Change with temperature.

    Attributes
    ----------
    change : Estimate
        In the unit of the output, per degree.
    micro_g : Estimate or None
        The same in µg per degree, where the unit is one of acceleration.
    ppm : Estimate or None
        Relative to what the output reads, in 10⁻⁶ per degree; None where it reads next to nothing.
    """

    change: Estimate
    micro_g: Estimate | None
    ppm: Estimate | None


@dataclass(frozen=True, eq=False)
class OutputStability(Result):
    """One output: its Allan deviation and what follows from it.

    Attributes
    ----------
    adev, u, dof : (T,) arrays
        At the averaging times of the whole; `dof` are equivalent degrees of freedom.
    white_noise, bias_instability, random_walk, drift : Estimate
    warm_up : WarmUp or None
    temperature_coefficient : TemperatureCoefficient or None
    """

    adev: Array
    u: Array
    dof: Array
    white_noise: Estimate
    bias_instability: Estimate
    random_walk: Estimate
    drift: Estimate
    warm_up: WarmUp | None
    temperature_coefficient: TemperatureCoefficient | None


@dataclass(frozen=True, eq=False)
class Spread(Result):
    """How values repeat: their standard deviation, range and degrees of freedom."""

    sd: float
    range: float
    dof: int


@dataclass(frozen=True, eq=False)
class StaticRecord(Result):
    """One record, in some hundred blocks.

    Attributes
    ----------
    source : str
    samples : int
    time : (b,) array [s]
        Of the middles of the blocks, from the begin of the record.
    zero : dict of str to (b,) array
        Mean of every output over each block.
    settled : dict of str to float
        Mean over the record, without the warm-up.
    temperature : (b,) array or None
    """

    source: str = field(compare=False)
    samples: int
    time: Array
    zero: Mapping[str, Array]
    settled: Mapping[str, float]
    temperature: Array | None


@dataclass(frozen=True, eq=False)
class Stability(Result, Drawn, Tabular):
    """How stable a sensor at rest is, from one static record or several.

    Attributes
    ----------
    tau : (T,) array [s]
        Averaging times.
    outputs : dict of str to OutputStability
    run_to_run, turn_on : dict of str to Spread
        Of the settled zeros of the records, and of the zeros just after switching on; empty for
        one record.
    records : tuple of StaticRecord
    sample_rate : float [Hz]
    unit : str
        Of the outputs.
    confidence : float
    calibration : str or None
        When the calibration was made that the records were compensated with.
    warnings : tuple of str

    Examples
    --------
    >>> import numpy as np
    >>> import multipos as mp
    >>> rng = np.random.default_rng(1)
    >>> record = {"time": np.arange(4000) / 10.0, "ax": 0.01 + 2e-4 * rng.standard_normal(4000)}
    >>> found = mp.stability(record)
    >>> round(found.sample_rate, 6), found.tau[:3].round(6).tolist()
    (10.0, [0.1, 0.2, 0.4])
    >>> bool(abs(found.outputs["ax"].white_noise.value / 6.3e-5 - 1.0) < 0.1)
    True
    """

    tau: Array
    outputs: Mapping[str, OutputStability]
    run_to_run: Mapping[str, Spread]
    turn_on: Mapping[str, Spread]
    records: tuple[StaticRecord, ...]
    sample_rate: float
    unit: str
    confidence: float
    calibration: str | None = field(compare=False)
    warnings: tuple[str, ...]

    def columns(self) -> dict[str, Column]:
        """Return the Allan deviations as a table: `tau`, then `adev_<output>` and `u_<output>`."""
        found: dict[str, Column] = {"tau": self.tau}
        for name, output in self.outputs.items():
            found |= {f"adev_{name}": output.adev, f"u_{name}": output.u}
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON carries it, keys as in docs/reference/stability.md."""
        # Imported here, for the file's module makes this type and so imports this one.
        from multipos.bias_stability.stability_file import stability_dict

        return stability_dict(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result as JSON, whole or not at all."""
        write_text(path, to_json(self.to_dict()))
