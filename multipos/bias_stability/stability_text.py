"""Stability as people read it.

- `stability_text` returns the tables of a result.
- `stability_sentence` returns its largest white noise and bias instability, as a sentence.
"""

import math

from multipos.bias_stability.stability_result import Estimate, Spread, Stability
from multipos.files.numbers import number, table, uncertain
from multipos.units import MICRO_G

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
