"""How stable a sensor at rest is: the result of `multipos.stability`.

- `Stability` holds an `OutputStability` of every output, each number an `Estimate` (a `WarmUp`, a
  `TemperatureCoefficient`), the `Spread` of the zeros and every `StaticRecord`.
- `load_stability` reads its file; what every key means is in `docs/howto/static-records`.

Of every output, over all records together: the overlapping Allan deviation σ(τ) with its standard
uncertainty, the coefficients of the noise laws

    σ = N/√τ  white noise,    σ_min = .664 B  bias instability,    σ = K √(τ/3)  random walk,   (1)

drift, warm-up A exp(−t/T) and temperature coefficient; and how the zero repeats from record to
record.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import field
from functools import partial
from typing import Annotated, Any

import numpy as np

from multipos.files.records import (
    DOF,
    NOT_NEGATIVE,
    POSITIVE,
    Listed,
    Maybe,
    NotNegative,
    Positive,
    Share,
    Whole,
)
from multipos.files.schema import Saved, Stored, read_saved, renamed, schema_of
from multipos.files.spelling import StrPath
from multipos.files.tables import Column
from multipos.finding import Findings, findings_upgraded
from multipos.numerics.arrays import Array
from multipos.results import Drawn, Result, Tabular, frozen


@frozen
class Estimate(Result):
    """A number with its standard and expanded uncertainty, degrees of freedom and unit."""

    value: float
    u: NotNegative
    U: NotNegative
    dof: Annotated[float, Maybe(DOF, math.inf)]
    unit: str

    def scaled(self, factor: float, unit: str) -> "Estimate":
        """Return it in another unit, `factor` of which make one."""
        size = abs(factor)
        return Estimate(factor * self.value, size * self.u, size * self.U, self.dof, unit)


_AMPLITUDE = renamed(
    Estimate,
    value="amplitude",
    u="amplitude_u",
    U="amplitude_U",
    dof="amplitude_dof",
    unit="unit",
)
_TIME_CONSTANT = renamed(
    partial(Estimate, dof=math.inf, unit="s"),
    value="time_constant",
    u="time_constant_u",
    U="time_constant_U",
)


@frozen
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

    amplitude: Annotated[Estimate, _AMPLITUDE, Stored(flat=True)]
    time_constant: Annotated[Estimate, _TIME_CONSTANT, Stored(flat=True)]
    settled_after: NotNegative


@frozen
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

    change: Annotated[Estimate, Stored(flat=True)]
    micro_g: Estimate | None
    ppm: Estimate | None


_ALLAN = Stored(rows="allan")


@frozen
class OutputStability(Result):
    """One output: its Allan deviation and what follows from it.

    Attributes
    ----------
    tau : (T,) array [s]
        Averaging times.
    adev, u, dof : (T,) arrays
        At these; `dof` are equivalent degrees of freedom.
    white_noise, bias_instability, random_walk, drift : Estimate
    warm_up : WarmUp or None
    temperature_coefficient : TemperatureCoefficient or None
    """

    tau: Annotated[Array, POSITIVE, _ALLAN]
    adev: Annotated[Array, NOT_NEGATIVE, _ALLAN]
    u: Annotated[Array, NOT_NEGATIVE, _ALLAN]
    dof: Annotated[Array, DOF, _ALLAN]
    white_noise: Estimate
    bias_instability: Estimate
    random_walk: Estimate
    drift: Estimate
    warm_up: WarmUp | None
    temperature_coefficient: TemperatureCoefficient | None


@frozen
class Spread(Result):
    """How values repeat: their standard deviation, range and degrees of freedom."""

    sd: NotNegative
    range: NotNegative
    dof: Annotated[int, Whole(1)]


@frozen
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

    source: Annotated[str, Stored("file")] = field(compare=False)
    samples: Annotated[int, Whole(1)]
    time: Array
    zero: Mapping[str, Array]
    settled: Mapping[str, float]
    temperature: Array | None


@frozen
class Stability(Saved, Drawn, Tabular):
    """How stable a sensor at rest is, from one static record or several.

    Attributes
    ----------
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
    findings : tuple of Finding

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

    schema = "multipos/stability/1"
    called = "stability"
    again = "run stability again"
    _upgraded = staticmethod(findings_upgraded)

    outputs: Mapping[str, OutputStability]
    run_to_run: Mapping[str, Spread]
    turn_on: Mapping[str, Spread]
    records: Annotated[tuple[StaticRecord, ...], Listed(schema_of(StaticRecord), 1)]
    sample_rate: Positive
    unit: str
    confidence: Share
    calibration: str | None = field(compare=False)
    findings: Findings

    @property
    def tau(self) -> Array:
        """Averaging times (T,) [s], the same of all outputs."""
        return next(iter(self.outputs.values())).tau

    @classmethod
    def _from_file(cls, **values: Any) -> "Stability":
        """Return the result that a file holds.

        Raises
        ------
        ValueError
            It is not about the same outputs and times all through.
        """
        found = cls(**values)
        if not _is_whole(found):
            raise ValueError("its outputs, averaging times or records do not go together")
        return found

    def columns(self) -> dict[str, Column]:
        """Return the Allan deviations as a table: `tau`, then `adev_<output>` and `u_<output>`."""
        found: dict[str, Column] = {"tau": self.tau}
        for name, output in self.outputs.items():
            found |= {f"adev_{name}": output.adev, f"u_{name}": output.u}
        return found


def _is_whole(found: Stability) -> bool:
    """Tell whether there is an output, and everything is about the same outputs and times."""
    names = found.outputs.keys()
    if not names or any(not np.array_equal(each.tau, found.tau) for each in found.outputs.values()):
        return False
    spreads = [each.keys() for each in (found.run_to_run, found.turn_on) if each]
    return all(each == names for each in spreads) and all(
        _is_record_whole(each, names) for each in found.records
    )


def _is_record_whole(record: StaticRecord, names: Collection[str]) -> bool:
    columns = [record.time if record.temperature is None else record.temperature]
    columns += record.zero.values()
    alike = all(len(column) == len(record.time) for column in columns)
    return alike and record.zero.keys() == record.settled.keys() == names


def load_stability(path: StrPath) -> Stability:
    """Read a stability result written by `multipos stability` or `Stability.save`.

    Raises
    ------
    MultiposError
        The file is missing, truncated, of another schema, or holds what no stability does.

    Examples
    --------
    >>> import numpy as np
    >>> import multipos as mp
    >>> rng = np.random.default_rng(1)
    >>> record = {"time": np.arange(4000) / 10.0, "ax": 0.01 + 2e-4 * rng.standard_normal(4000)}
    >>> mp.stability(record).save("zero.json")
    >>> list(mp.load_stability("zero.json").outputs)
    ['ax']
    """
    return read_saved(Stability, path)
