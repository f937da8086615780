"""Stability as people read it."""

import math
from collections.abc import Mapping

from multipos.files.numbers import number, table, uncertain
from multipos.sensor.stability import MICRO_G, Estimate, OutputStability, Spread, Stability

_HOUR = 3600.0
_LAWS = ("output", "white noise N", "bias instability B", "random walk K", "drift")


def stability_text(found: Stability) -> str:
    """Return a result as text; accelerations in µg, the standard uncertainty in brackets."""
    factor = MICRO_G.get(found.unit, 1.0)
    unit = "µg" if found.unit in MICRO_G else found.unit
    parts = [_records(found), _laws(found, factor, unit)]
    warm = {name: each.warm_up for name, each in found.outputs.items() if each.warm_up}
    if warm:
        header = ["warm-up", f"amplitude [{unit}]", "time constant [s]", "settled after [s]"]
        rows = [
            [
                name,
                _shown(each.amplitude, factor),
                _shown(each.time_constant, 1.0),
                number(each.settled_after),
            ]
            for name, each in warm.items()
        ]
        parts.append(table(header, rows))
    if any(each.temperature_coefficient for each in found.outputs.values()):
        parts.append(_temperature(found.outputs, factor, unit))
    if found.run_to_run:
        header = ["zero", f"run to run, sd [{unit}]", "range", "turn-on, sd", "range", "dof"]
        rows = [
            [name, *_spread(each, factor), *_spread(found.turn_on[name], factor), str(each.dof)]
            for name, each in found.run_to_run.items()
        ]
        parts.append(table(header, rows))
    parts += [f"warning: {warning}" for warning in found.warnings]
    return "\n\n".join(parts) + "\n"


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
    return table(_LAWS, [units, *rows])


def _temperature(outputs: Mapping[str, OutputStability], factor: float, unit: str) -> str:
    rows = []
    for name, each in outputs.items():
        coefficient = each.temperature_coefficient
        assert coefficient is not None
        ppm = "-" if coefficient.ppm is None else _shown(coefficient.ppm, 1.0)
        rows.append([name, _shown(coefficient.change, factor), ppm])
    return table(["temperature", f"change [{unit}/°C]", "[ppm/°C]"], rows)


def _spread(found: Spread, factor: float) -> list[str]:
    return [number(factor * found.sd, 3), number(factor * found.range, 3)]


def _shown(found: Estimate, factor: float) -> str:
    """Return value(u); a coefficient that is not told from zero as its upper bound."""
    value, u = factor * found.value, factor * found.u
    if found.value == 0.0 and math.isfinite(u):
        return f"< {number(factor * found.U, 2)}"
    return uncertain(value, u)
