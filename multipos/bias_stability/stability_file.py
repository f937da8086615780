"""Stability in files: what the file holds, key by key, its writing and its reading.

What every key means is in `docs/reference/stability`.
"""

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from multipos.bias_stability.result import (
    Estimate,
    OutputStability,
    Spread,
    Stability,
    StaticRecord,
    TemperatureCoefficient,
    WarmUp,
)
from multipos.errors import MultiposError
from multipos.files.records import (
    ANY_NUMBER,
    ANY_TEXT,
    NOT_NEGATIVE,
    POSITIVE,
    SHARE,
    TEXTS,
    Fields,
    Listed,
    Maybe,
    Named,
    Numbers,
    Whole,
    require,
)
from multipos.files.trees import read_json
from multipos.results import plain

SCHEMA = "multipos/stability/1"

_ESTIMATE = Fields(
    {
        "value": ANY_NUMBER,
        "u": NOT_NEGATIVE,
        "U": NOT_NEGATIVE,
        "dof": Maybe(POSITIVE),
        "unit": ANY_TEXT,
    }
)
_POINT = Fields({"tau": POSITIVE, "adev": NOT_NEGATIVE, "u": NOT_NEGATIVE, "dof": POSITIVE})
_WARM_UP = Fields(
    {
        "amplitude": ANY_NUMBER,
        "amplitude_u": NOT_NEGATIVE,
        "amplitude_U": NOT_NEGATIVE,
        "amplitude_dof": Maybe(POSITIVE),
        "unit": ANY_TEXT,
        "time_constant": POSITIVE,
        "time_constant_u": NOT_NEGATIVE,
        "time_constant_U": NOT_NEGATIVE,
        "settled_after": NOT_NEGATIVE,
    }
)
_TEMPERATURE = Fields(
    {**_ESTIMATE.needed, "micro_g": Maybe(_ESTIMATE), "ppm": Maybe(_ESTIMATE)},
)
_LAWS = ("white_noise", "bias_instability", "random_walk", "drift")
_SPREAD = Fields({"sd": NOT_NEGATIVE, "range": NOT_NEGATIVE, "dof": Whole(1)})

STABILITY = Fields(
    {
        "outputs": Named(
            Fields(
                {
                    "allan": Listed(_POINT, 1),
                    **dict.fromkeys(_LAWS, _ESTIMATE),
                    "warm_up": Maybe(_WARM_UP),
                    "temperature_coefficient": Maybe(_TEMPERATURE),
                }
            )
        ),
        "run_to_run": Named(_SPREAD),
        "turn_on": Named(_SPREAD),
        "records": Listed(
            Fields(
                {
                    "file": ANY_TEXT,
                    "samples": Whole(1),
                    "time": Numbers(),
                    "zero": Named(Numbers()),
                    "settled": Named(ANY_NUMBER),
                    "temperature": Maybe(Numbers()),
                }
            ),
            1,
        ),
        "sample_rate": POSITIVE,
        "unit": ANY_TEXT,
        "confidence": SHARE,
        "calibration": Maybe(ANY_TEXT),
        "warnings": TEXTS,
    }
)


def stability_dict(found: Stability) -> dict[str, Any]:
    """Return a result as JSON carries it."""
    result: dict[str, Any] = plain(
        {
            "schema": SCHEMA,
            "outputs": {name: _output(found, each) for name, each in found.outputs.items()},
            "run_to_run": {name: vars(each) for name, each in found.run_to_run.items()},
            "turn_on": {name: vars(each) for name, each in found.turn_on.items()},
            "records": [
                {"file": each.source, **{k: v for k, v in vars(each).items() if k != "source"}}
                for each in found.records
            ],
            "sample_rate": found.sample_rate,
            "unit": found.unit,
            "confidence": found.confidence,
            "calibration": found.calibration,
            "warnings": found.warnings,
        }
    )
    return result


def _output(found: Stability, each: OutputStability) -> dict[str, Any]:
    points = zip(found.tau, each.adev, each.u, each.dof, strict=True)
    coefficient, warm_up = each.temperature_coefficient, each.warm_up
    return {
        "allan": [dict(zip(("tau", "adev", "u", "dof"), row, strict=True)) for row in points],
        **{law: vars(getattr(each, law)) for law in _LAWS},
        "warm_up": None if warm_up is None else _warm_up(warm_up),
        "temperature_coefficient": None
        if coefficient is None
        else {
            **vars(coefficient.change),
            "micro_g": None if coefficient.micro_g is None else vars(coefficient.micro_g),
            "ppm": None if coefficient.ppm is None else vars(coefficient.ppm),
        },
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


def load_stability(path: str | os.PathLike[str]) -> Stability:
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
    outputs, records = content["outputs"], content["records"]
    taus = [[point["tau"] for point in each["allan"]] for each in outputs.values()]
    if not _is_whole(content, taus):
        raise MultiposError(
            f"{path}: its outputs, averaging times or records do not go together; the file is "
            "damaged, run stability again."
        )
    return Stability(
        tau=np.array(taus[0], dtype=np.float64),
        outputs={name: _read_output(each) for name, each in outputs.items()},
        run_to_run=_spreads(content["run_to_run"]),
        turn_on=_spreads(content["turn_on"]),
        records=tuple(map(_read_record, records)),
        sample_rate=content["sample_rate"],
        unit=content["unit"],
        confidence=content["confidence"],
        calibration=content["calibration"],
        warnings=tuple(content["warnings"]),
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


def _spreads(content: Mapping[str, Any]) -> dict[str, Spread]:
    return {name: Spread(**_own(each, _SPREAD)) for name, each in content.items()}


def _own(content: Mapping[str, Any], kind: Fields) -> dict[str, Any]:
    return {name: content[name] for name in kind.needed}


def _estimate(content: Mapping[str, Any]) -> Estimate:
    dof = content["dof"]
    return Estimate(**{**_own(content, _ESTIMATE), "dof": np.inf if dof is None else dof})


def _read_output(content: Mapping[str, Any]) -> OutputStability:
    adev, u, dof = (
        np.array([point[name] for point in content["allan"]], dtype=np.float64)
        for name in ("adev", "u", "dof")
    )
    laws = {law: _estimate(content[law]) for law in _LAWS}
    warm, temperature = content["warm_up"], content["temperature_coefficient"]
    return OutputStability(
        adev=adev,
        u=u,
        dof=dof,
        **laws,
        warm_up=None if warm is None else _read_warm_up(warm),
        temperature_coefficient=None if temperature is None else _read_temperature(temperature),
    )


def _read_warm_up(content: Mapping[str, Any]) -> WarmUp:
    size = {key: content[f"amplitude_{key}"] for key in ("u", "U", "dof")}
    spread = {key: content[f"time_constant_{key}"] for key in ("u", "U")}
    return WarmUp(
        _estimate({"value": content["amplitude"], "unit": content["unit"], **size}),
        _estimate({"value": content["time_constant"], "unit": "s", "dof": None, **spread}),
        content["settled_after"],
    )


def _read_temperature(content: Mapping[str, Any]) -> TemperatureCoefficient:
    others = {
        key: None if content[key] is None else _estimate(content[key]) for key in ("micro_g", "ppm")
    }
    return TemperatureCoefficient(_estimate(content), **others)


def _read_record(content: Mapping[str, Any]) -> StaticRecord:
    temperature = content["temperature"]
    return StaticRecord(
        source=content["file"],
        samples=content["samples"],
        time=np.array(content["time"], dtype=np.float64),
        zero={name: np.array(zero, dtype=np.float64) for name, zero in content["zero"].items()},
        settled=content["settled"],
        temperature=None if temperature is None else np.array(temperature, dtype=np.float64),
    )
