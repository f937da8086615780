"""Targets: how small the expanded uncertainty U of each parameter shall become.

`read_targets` reads ``bias_ax=0.001``, of a parameter, or ``bias=0.001``, of a kind of parameters,
in the unit of the parameter; `spread_targets` gives each parameter of a model its own.
"""

import math
from collections.abc import Mapping, Sequence

from multipos.errors import UsageError
from multipos.files.spelling import near
from multipos.sensor.model import Model

KINDS = ("bias", "scale", "cross", "quad")
Targets = Mapping[str, float]


def read_targets(given: "Targets | Sequence[str]") -> dict[str, float]:
    """Return targets from texts TERM=U, or as they are.

    Raises
    ------
    UsageError
        A text is no target, or U is not above 0.
    """
    pairs = given.items() if isinstance(given, Mapping) else map(_split, given)
    targets = {}
    for name, value in pairs:
        if not 0.0 < value < math.inf:
            raise UsageError(f"--target {name}: U must be above 0, got {value:g}.")
        targets[name] = float(value)
    return targets


def _split(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name.strip(), float(value)
    except ValueError:
        raise UsageError(
            f"--target takes TERM=U, as in bias=0.001 or scale_ax=1e-4, got '{text}'."
        ) from None


def spread_targets(targets: Targets, model: Model) -> dict[str, float]:
    """Return the target of each parameter that has one; that of a name goes before a kind's.

    Raises
    ------
    UsageError
        The model has no such parameter.
    """
    found: dict[str, float] = {}
    kinds = {name: name.partition("_")[0] for name in model.names}
    for name in targets:
        if name not in model.names and name not in kinds.values():
            known = [*KINDS, *model.names]
            raise UsageError(
                f"--target '{name}' is no parameter of the model{near(name, known)} They are "
                f"{', '.join(model.names)}, and kinds of them {', '.join(KINDS)}."
            )
    for name in model.names:
        value = targets.get(name) or targets.get(kinds[name])
        if value is not None:
            found[name] = value
    return found
