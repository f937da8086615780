"""How stable a sensor at rest is: the result of `multipos.stability`.

Of every output, over all records together: the overlapping Allan deviation σ(τ) with its standard
uncertainty, the coefficients of the noise laws

    σ = N/√τ  white noise,    σ_min = .664 B  bias instability,    σ = K √(τ/3)  random walk,   (1)

drift, warm-up A exp(−t/T) and temperature coefficient; and how the zero repeats from record to
record.

Stability in files: what the file holds, key by key, its writing and its reading.

What every key means is in `docs/howto/static-records`.

Stability as people read it.
"""

import math
from collections.abc import Mapping
from dataclasses import field
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.files.numbers import number, table, uncertain
from multipos.files.records import (
    ANY_NUMBER,
    ANY_TEXT,
    DOF,
    NOT_NEGATIVE,
    POSITIVE,
    SHARE,
    Fields,
    Listed,
    Maybe,
    Named,
    Record,
    Whole,
    require,
)
from multipos.files.spelling import StrPath
from multipos.files.tables import Column
from multipos.files.trees import read_json, to_json
from multipos.files.whole import write_text
from multipos.finding import FINDINGS, Findings, read_findings
from multipos.numerics.arrays import Array
from multipos.results import Drawn, Result, Tabular, frozen, plain_dict
from multipos.units import MICRO_G

# What a unit of the readings is in µg, where it is one of acceleration.


@frozen
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

    amplitude: Estimate
    time_constant: Estimate
    settled_after: float


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

    change: Estimate
    micro_g: Estimate | None
    ppm: Estimate | None


@frozen
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


@frozen
class Spread(Result):
    """How values repeat: their standard deviation, range and degrees of freedom."""

    sd: float
    range: float
    dof: int


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

    source: str = field(compare=False)
    samples: int
    time: Array
    zero: Mapping[str, Array]
    settled: Mapping[str, float]
    temperature: Array | None


@frozen
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

    tau: Array
    outputs: Mapping[str, OutputStability]
    run_to_run: Mapping[str, Spread]
    turn_on: Mapping[str, Spread]
    records: tuple[StaticRecord, ...]
    sample_rate: float
    unit: str
    confidence: float
    calibration: str | None = field(compare=False)
    findings: Findings

    def columns(self) -> dict[str, Column]:
        """Return the Allan deviations as a table: `tau`, then `adev_<output>` and `u_<output>`."""
        found: dict[str, Column] = {"tau": self.tau}
        for name, output in self.outputs.items():
            found |= {f"adev_{name}": output.adev, f"u_{name}": output.u}
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON carries it, keys as in docs/howto/static-records.md."""
        # Imported here, for the file's module makes this type and so imports this one.

        return stability_dict(self)

    def save(self, path: StrPath) -> None:
        """Write the result as JSON, whole or not at all."""
        write_text(path, to_json(self.to_dict()))


SCHEMA = "multipos/stability/1"

_ESTIMATE = Record.of(Estimate, {"u": NOT_NEGATIVE, "U": NOT_NEGATIVE, "dof": Maybe(DOF, math.inf)})
_POINT = Fields({"tau": POSITIVE, "adev": NOT_NEGATIVE, "u": NOT_NEGATIVE, "dof": DOF})
_WARM_UP = Fields(
    {
        "amplitude": ANY_NUMBER,
        "amplitude_u": NOT_NEGATIVE,
        "amplitude_U": NOT_NEGATIVE,
        "amplitude_dof": Maybe(DOF),
        "unit": ANY_TEXT,
        "time_constant": POSITIVE,
        "time_constant_u": NOT_NEGATIVE,
        "time_constant_U": NOT_NEGATIVE,
        "settled_after": NOT_NEGATIVE,
    }
)
_RELATIVE = Record({"micro_g": Maybe(_ESTIMATE), "ppm": Maybe(_ESTIMATE)})
_TEMPERATURE = Fields({**_ESTIMATE.needed, **_RELATIVE.needed})
_LAWS = Record(
    dict.fromkeys(("white_noise", "bias_instability", "random_walk", "drift"), _ESTIMATE)
)
_SPREAD = Record.of(Spread, {"sd": NOT_NEGATIVE, "range": NOT_NEGATIVE, "dof": Whole(1)})
_RECORD = Record.of(StaticRecord, {"samples": Whole(1)}, names={"file": "source"})
_OUTPUT = Fields(
    {
        "allan": Listed(_POINT, 1),
        **_LAWS.needed,
        "warm_up": Maybe(_WARM_UP),
        "temperature_coefficient": Maybe(_TEMPERATURE),
    }
)
# What a result has under its own name; the Allan deviations stand by output.
_WHOLE = Record(
    {
        "run_to_run": Named(_SPREAD),
        "turn_on": Named(_SPREAD),
        "records": Listed(_RECORD, 1),
        "sample_rate": POSITIVE,
        "unit": ANY_TEXT,
        "confidence": SHARE,
        "calibration": Maybe(ANY_TEXT),
    }
)
STABILITY = Fields({"outputs": Named(_OUTPUT), **_WHOLE.needed}, FINDINGS)


def stability_dict(found: Stability) -> dict[str, Any]:
    """Return a result as JSON carries it."""
    return plain_dict(
        {
            "schema": SCHEMA,
            "outputs": {name: _output(found, each) for name, each in found.outputs.items()},
            **_WHOLE.write(found),
            "findings": found.findings,
        }
    )


def _output(found: Stability, each: OutputStability) -> dict[str, Any]:
    points = zip(found.tau, each.adev, each.u, each.dof, strict=True)
    coefficient, warm_up = each.temperature_coefficient, each.warm_up
    return {
        "allan": [dict(zip(("tau", "adev", "u", "dof"), row, strict=True)) for row in points],
        **_LAWS.write(each),
        "warm_up": None if warm_up is None else _warm_up(warm_up),
        "temperature_coefficient": None
        if coefficient is None
        else {**_ESTIMATE.write(coefficient.change), **_RELATIVE.write(coefficient)},
    }


def _warm_up(found: WarmUp) -> dict[str, Any]:
    amplitude, constant = found.amplitude, found.time_constant
    return {
        "amplitude": amplitude.value,
        "amplitude_u": amplitude.u,
        "amplitude_U": amplitude.U,
        "amplitude_dof": amplitude.dof,
        "unit": amplitude.unit,
        "time_constant": constant.value,
        "time_constant_u": constant.u,
        "time_constant_U": constant.U,
        "settled_after": found.settled_after,
    }


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
    content = read_json(path, SCHEMA)
    require(content, STABILITY, str(path), "run stability again")
    outputs = content["outputs"]
    taus = [[point["tau"] for point in each["allan"]] for each in outputs.values()]
    if not _is_whole(content, taus):
        raise MultiposError(
            f"{path}: its outputs, averaging times or records do not go together; the file is "
            "damaged, run stability again."
        )
    return Stability(
        tau=np.array(taus[0], dtype=np.float64),
        outputs={name: _read_output(each) for name, each in outputs.items()},
        findings=read_findings(content),
        **_WHOLE.read(content),
    )


def _is_whole(content: Mapping[str, Any], taus: list[list[float]]) -> bool:
    """Tell whether there is an output, and everything is about the same outputs and times."""
    names = set(content["outputs"])
    if not names or any(tau != taus[0] for tau in taus):
        return False
    spreads = [set(content[key]) for key in ("run_to_run", "turn_on") if content[key]]
    return all(each == names for each in spreads) and all(
        _is_record_whole(each, names) for each in content["records"]
    )


def _is_record_whole(content: Mapping[str, Any], names: set[str]) -> bool:
    columns = [content["temperature"] or content["time"], *content["zero"].values()]
    alike = all(len(column) == len(content["time"]) for column in columns)
    return alike and set(content["zero"]) == set(content["settled"]) == names


def _read_output(content: Mapping[str, Any]) -> OutputStability:
    adev, u, dof = (
        np.array([point[name] for point in content["allan"]], dtype=np.float64)
        for name in ("adev", "u", "dof")
    )
    warm, temperature = content["warm_up"], content["temperature_coefficient"]
    return OutputStability(
        adev=adev,
        u=u,
        dof=dof,
        **_LAWS.read(content),
        warm_up=None if warm is None else _read_warm_up(warm),
        temperature_coefficient=None
        if temperature is None
        else TemperatureCoefficient(_ESTIMATE.read(temperature), **_RELATIVE.read(temperature)),
    )


def _read_warm_up(content: Mapping[str, Any]) -> WarmUp:
    size = {key: content[f"amplitude_{key}"] for key in ("u", "U", "dof")}
    spread = {key: content[f"time_constant_{key}"] for key in ("u", "U")}
    return WarmUp(
        _ESTIMATE.read({"value": content["amplitude"], "unit": content["unit"], **size}),
        _ESTIMATE.read({"value": content["time_constant"], "unit": "s", "dof": None, **spread}),
        content["settled_after"],
    )


_HOUR = 3600.0
_LAWS_TEXT = ("output", "white noise N", "bias instability B", "random walk K", "drift")


def stability_text(found: Stability) -> str:
    """Return a result as text; accelerations in µg, the standard uncertainty in brackets."""
    factor = MICRO_G.get(found.unit, 1.0)
    unit = "µg" if found.unit in MICRO_G else found.unit
    parts = [
        _laws(found, factor, unit),
        _warm_up_text(found, factor, unit),
        _temperature(found, factor, unit),
        _repeats(found, factor, unit),
        _records(found),
    ]
    return "\n\n".join(filter(None, parts)) + "\n"


def _records(found: Stability) -> str:
    rows = [
        [each.source, str(each.samples), number(each.samples / found.sample_rate, 6)]
        for each in found.records
    ]
    return table([f"record, {found.sample_rate:.6g} Hz", "samples", "duration [s]"], rows)


def _laws(found: Stability, factor: float, unit: str) -> str:
    units = ["", f"[{unit}/√Hz]", f"[{unit}]", f"[{unit}/√s]", f"[{unit}/h]"]
    rows = [
        [
            name,
            _shown(each.white_noise, factor),
            _shown(each.bias_instability, factor),
            _shown(each.random_walk, factor),
            _shown(each.drift, _HOUR * factor),
        ]
        for name, each in found.outputs.items()
    ]
    return table(_LAWS_TEXT, [units, *rows])


def _warm_up_text(found: Stability, factor: float, unit: str) -> str:
    rows = [
        [
            name,
            _shown(each.warm_up.amplitude, factor),
            _shown(each.warm_up.time_constant, 1.0),
            number(each.warm_up.settled_after),
        ]
        for name, each in found.outputs.items()
        if each.warm_up is not None
    ]
    header = ["warm-up", f"amplitude [{unit}]", "time constant [s]", "warm-up [s]"]
    return table(header, rows) if rows else ""


def _temperature(found: Stability, factor: float, unit: str) -> str:
    rows = []
    for name, each in found.outputs.items():
        if (coefficient := each.temperature_coefficient) is not None:
            ppm = "-" if coefficient.ppm is None else _shown(coefficient.ppm, 1.0)
            rows.append([name, _shown(coefficient.change, factor), ppm])
    header = ["temperature", f"change [{unit}/°C]", "[ppm/°C]"]
    return table(header, rows) if rows else ""


def _repeats(found: Stability, factor: float, unit: str) -> str:
    rows = [
        [name, *_spread(each, factor), *_spread(found.turn_on[name], factor), str(each.dof)]
        for name, each in found.run_to_run.items()
    ]
    header = ["zero", f"run to run, sd [{unit}]", "range", "turn-on, sd", "range", "dof"]
    return table(header, rows) if rows else ""


def _spread(found: Spread, factor: float) -> list[str]:
    return [number(factor * found.sd, 3), number(factor * found.range, 3)]


def _shown(found: Estimate, factor: float) -> str:
    """Return value(u); a coefficient that is not distinguishable from zero as its upper bound."""
    value, u = factor * found.value, factor * found.u
    if found.value == 0.0 and math.isfinite(u):
        return f"< {number(factor * found.U, 2)}"
    return uncertain(value, u)


def stability_sentence(found: Stability) -> str:
    """Return the largest white noise and bias instability of any output."""
    factor = MICRO_G.get(found.unit, 1.0)
    unit = "µg" if found.unit in MICRO_G else found.unit
    parts = []
    for name, per in (("white_noise", "/√Hz"), ("bias_instability", "")):
        values = {o: getattr(each, name).value for o, each in found.outputs.items()}
        values = {o: value for o, value in values.items() if value is not None and value == value}
        if values:
            worst = max(values, key=lambda output: values[output])
            size = f"up to {number(factor * values[worst], 3)}"
            if not values[worst]:  # as the table has it
                bounds = {o: getattr(found.outputs[o], name).U for o in values}
                worst = max(bounds, key=lambda output: bounds[output])
                size = f"below {number(factor * bounds[worst], 2)}"
            parts.append(f"{name.replace('_', ' ')} {size} {unit}{per} ({worst})")
    records = len(found.records)
    return f"{', '.join(found.outputs)} over {records} record{'s' if records > 1 else ''}: " + (
        f"{', '.join(parts)}." if parts else "no noise was found."
    )
