"""Budget files: what is known of the measurement beside its readings.

`read_budget` reads and checks one, `resolve` replaces the file that a table names by what it says,
and `zero_moves` returns how zeros that repeat from switch-on to switch-on move readings.

A budget is a small TOML file, one table for each input quantity, all optional:

===============  ==========================================================================
``gravity``      ``value`` [m/s²], or ``latitude_deg`` and ``height_m`` (WGS 84)
``level``        tilt of the table or base, common to all positions, about each of two
                 horizontal axes [degrees]
``orientation``  error of each position, independent, about each axis [degrees]
``index``        periodic error of an index or dividing head [degrees]: the standard deviation
                 at an angle taken at random; ``harmonics`` = [1, 2], ``axis`` where the
                 positions do not tell which case axis lies along the shaft
``gain``         ADC or voltmeter, relative; ``each_output`` where each has one of its own
``offset``       ADC or voltmeter [reading unit]; ``each_output`` likewise
``resolution``   of the readings [reading unit], independent; ``step`` is the whole step
``temperature``  of the sensor [degC], common; ``bias_per_degC`` [reading unit/degC] and
                 ``scale_per_degC`` [relative/degC] where the model has no temperature terms
``third_order``  own-axis third-order coefficient that the positions did not show, relative to
                 the scale factor [1/g²]: as ``"own^3"`` of ``unseen``, instead of it
``cross``        cross terms that the model leaves out, each relative to the scale factor
``stability``    zero from switch-on to switch-on: ``file``, a result of `multipos stability` of
                 several records, or its standard deviations ``u_<output>``, and ``dof``
``unseen``       terms that the positions did not show: standard uncertainty [g] of each kind,
                 ``"own^2"``, ``"own^3"``, ``"own*|own|"``, ``"own*other"``
===============  ==========================================================================

How large a quantity is, is said in one of three ways (angles with ``_deg`` behind the name): the
standard uncertainty ``u``; ``U`` with its coverage factor ``k``, as certificates have it; or
``half_width`` with a ``distribution``, for which

    u = a/√3 rectangular,   a/√6 triangular,   a/√2 arcsine                                (1)

(JCGM 100, 4.3.7 and 4.3.9). ``dof`` are its degrees of freedom, infinite where not given.

The zeros of the next switch-on differ from those of the calibration by the standard deviations
from run to run, each output by its own. Of raw outputs they move the readings as they are; of
compensated force they act along its axis, dy = J e_axis.
"""

import math
from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.files.records import is_number
from multipos.files.spelling import StrPath
from multipos.files.trees import read_toml
from multipos.numerics.arrays import COMPONENTS, FEWEST, LARGEST, Array
from multipos.results import Result, frozen
from multipos.sensor.calibration import Calibration
from multipos.units import normal_gravity

_SIZE = "u_"  # as in readings: the standard uncertainty of the output that follows
_FORCES = tuple(f"f_{axis}" for axis in COMPONENTS)


def resolve(where: str, table: Any, beside: str) -> dict[str, Any]:
    """Return the table in numbers: ``u_<output>`` of each zero, and ``dof``.

    Parameters
    ----------
    where : str
        For messages.
    table : mapping
        As it stands in the budget.
    beside : str
        The budget's file, in whose folder ``file`` is sought.

    Raises
    ------
    MultiposError
        A key is unknown, missing or no number, or the file is of one record only.
    """
    if not isinstance(table, Mapping):
        raise MultiposError(f"{where}: write it as a table, such as [stability] and file = …")
    if "file" in table:
        if len(table) > 1:
            raise MultiposError(f"{where}: 'file' states everything; leave out the others.")
        return _from_file(where, table["file"], beside)
    sizes = [key for key in table if key.startswith(_SIZE) and key != _SIZE]
    unknown = [key for key in table if key not in sizes and key != "dof"]
    if unknown or not sizes:
        found = f"there is '{unknown[0]}'" if unknown else "there is none of them"
        raise MultiposError(
            f"{where}: give 'file', or standard deviations by output, 'u_ax' and so on, with "
            f"'dof'; {found}."
        )
    for name, value in table.items():
        least, most = (1.0, math.inf) if name == "dof" else (0.0, LARGEST)
        if not is_number(value) or not least <= value <= most:
            raise MultiposError(
                f"{where}: '{name}' must be a number of at least {least:g}, got {value!r}."
            )
    return {"dof": math.inf, **table}


def _from_file(where: str, name: Any, beside: str) -> dict[str, Any]:
    if not isinstance(name, str):
        raise MultiposError(f"{where}: 'file' must be the name of a file, got {name!r}.")
    # Imported here, for a budget seldom names such a file, and every fit may have a budget.
    from multipos.bias_stability.stability_result import load_stability

    found = load_stability(Path(beside).parent / name)
    if not found.run_to_run:
        raise MultiposError(
            f"{where}: {name} is of one record, which does not determine turn-on repeatability; "
            "give stability several, a switch-on each."
        )
    spreads = {f"{_SIZE}{name}": spread.sd for name, spread in found.run_to_run.items()}
    return {"dof": float(next(iter(found.run_to_run.values())).dof), **spreads}


def zero_moves(calibration: Calibration, table: Mapping[str, float]) -> Array:
    """Return dy (n, M, q) of one standard deviation of each of q zeros that a table states.

    Raises
    ------
    MultiposError
        A name is neither an output of the calibration nor a compensated force.
    """
    c = calibration
    n, m = c.readings.values.shape
    outputs = {key.removeprefix(_SIZE): sd for key, sd in table.items() if key != "dof"}
    moves = np.zeros((n, m, len(outputs)))
    for q, (name, sd) in enumerate(outputs.items()):
        if name in c.outputs:
            moves[:, c.outputs.index(name), q] = sd
        elif name in _FORCES:
            J = c.model.force_jacobian(c.parameters, c.reference, c.readings.environment)
            moves[:, :, q] = sd * J[:, :, _FORCES.index(name)]
        else:
            raise MultiposError(
                f"[stability] in the budget is of '{name}', but this calibration has "
                f"{', '.join(c.outputs)}; take the stability of this sensor, raw or compensated."
            )
    return moves


BudgetSource = StrPath | Mapping[str, Any]

DIVISORS = {
    "rectangular": math.sqrt(3.0),
    "triangular": math.sqrt(6.0),
    "arcsine": math.sqrt(2.0),
}
UNSEEN = ("own^2", "own^3", "own*|own|", "own*other")
OF_FORCE_ALONE = ("third_order", "unseen")  # no part of the uncertainty of parameters
_SPREAD = ("u", "U", "k", "half_width", "distribution", "dof")


@frozen(eq=True)
class QuantityKind:
    """What a table of the budget is about.

    Attributes
    ----------
    text : str
        In plain words.
    unit : str
        '' stands for the unit of the readings.
    common : bool
        Whether it is the same at all positions and in every repeated calibration.
    settings : tuple of str
        Keys beside its size.
    shared : bool
        Whether it is the same at all positions, but not in repeated calibrations.
    """

    text: str
    unit: str
    common: bool
    settings: tuple[str, ...] = ()
    shared: bool = False


KINDS = {
    "gravity": QuantityKind("local gravity", "m/s^2", True, ("value", "latitude_deg", "height_m")),
    "level": QuantityKind("level of the table, two axes", "deg", True),
    "orientation": QuantityKind("orientation of each position", "deg", False),
    "index": QuantityKind(
        "periodic error of the dividing head", "deg", True, ("harmonics", "axis")
    ),
    "gain": QuantityKind("gain of the ADC or voltmeter", "1", True, ("each_output",)),
    "offset": QuantityKind("offset of the ADC or voltmeter", "", True, ("each_output",)),
    "resolution": QuantityKind("resolution of the readings", "", False, ("step",)),
    "temperature": QuantityKind(
        "temperature of the sensor", "degC", True, ("bias_per_degC", "scale_per_degC")
    ),
    "cross": QuantityKind("cross terms that the model leaves out", "1", True),
    "third_order": QuantityKind("third-order term beyond the positions", "1/g^2", True),
    "unseen": QuantityKind("terms that the positions did not show", "g", True, UNSEEN),
    "stability": QuantityKind(
        "zero from switch-on to switch-on", "1", False, ("file", "u_<output>"), True
    ),
}


@frozen
class Quantity(Result):
    """One input quantity: its standard uncertainty in `unit`, its law, its degrees of freedom."""

    name: str
    u: float
    unit: str
    distribution: str
    dof: float
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def kind(self) -> QuantityKind:
        """What the quantity is about."""
        return KINDS[self.name]


@frozen
class Budget(Result):
    """The input quantities by name, and the tables they were read from."""

    quantities: Mapping[str, Quantity]
    tables: Mapping[str, Any]

    @property
    def gravity(self) -> tuple[float, float] | None:
        """Value and standard uncertainty of gravity [m/s²], where the budget states them."""
        found = self.quantities.get("gravity")
        return None if found is None else (float(found.settings["value"]), found.u)


def read_budget(source: "BudgetSource | Budget") -> Budget:
    """Return a budget from a TOML file or its tables as a mapping.

    Raises
    ------
    MultiposError
        The file is missing or not TOML, or a table or key is unknown, missing or out of range;
        the message names file, table and key.
    """
    if isinstance(source, Budget):
        return source
    if isinstance(source, Mapping):
        where, tables = "the budget", source
    else:
        where, tables = str(source), read_toml(source, "budget")
    if "stability" in tables:
        stated = resolve(f"{where}, [stability]", tables["stability"], where)
        tables = {**tables, "stability": stated}
    if "unseen" in tables and "third_order" in tables:
        raise MultiposError(
            f"{where}: [third_order] and [unseen] both state what the positions do not show; write "
            '[third_order] as "own^3" of [unseen].'
        )
    quantities = {
        name: _quantity(f"{where}, [{name}]", name, table) for name, table in tables.items()
    }
    plain = {name: dict(table) for name, table in tables.items()}
    for name, quantity in quantities.items():
        if math.isinf(quantity.dof):  # which is said by leaving it out, as JSON has no infinity
            plain[name].pop("dof", None)
    return Budget(quantities, plain)


def _quantity(where: str, name: str, table: Any) -> Quantity:
    if name not in KINDS:
        raise MultiposError(f"{where}: no such quantity; a budget has {', '.join(KINDS)}.")
    if not isinstance(table, Mapping):
        raise MultiposError(f"{where}: write it as a table, such as [{name}] and below it u = …")
    if name == "stability":
        return Quantity(name, 1.0, KINDS[name].unit, "normal", float(table["dof"]), dict(table))
    kind = KINDS[name]
    if name == "unseen":
        return Quantity(name, 1.0, kind.unit, "normal", math.inf, _unseen(where, table))
    suffix = "_deg" if kind.unit == "deg" else ""
    spread, settings = _split(where, table, kind, suffix)
    if name == "resolution" and "step" in settings:
        spread |= _from_step(where, spread, settings)
    u, distribution = _size(where, spread, suffix)
    dof = _number(where, spread, "dof") if "dof" in spread else math.inf
    if not dof >= FEWEST:
        raise MultiposError(f"{where}: 'dof' must be above 0, at least {FEWEST:g}, got {dof:g}.")
    _check_settings(where, name, settings)
    return Quantity(name, u, kind.unit, distribution, dof, settings)


def _unseen(where: str, table: Mapping[str, Any]) -> dict[str, float]:
    """Return the sizes [g] of kinds of terms."""
    unknown = [key for key in table if key not in UNSEEN]
    if unknown or not table:
        found = f"unknown kind of term '{unknown[0]}'" if unknown else "no kind of term"
        names = ", ".join(f'"{name}"' for name in UNSEEN)
        raise MultiposError(f"{where}: {found}; it takes {names}, each a standard uncertainty [g].")
    return {kind: _number(where, table, kind) for kind in UNSEEN if kind in table}


def _split(
    where: str, table: Mapping[str, Any], kind: QuantityKind, suffix: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the keys of a quantity's size, without suffix, and its settings."""
    bare = ("k", "distribution", "dof")
    size = {key if key in bare else key + suffix: key for key in _SPREAD}
    unknown = [key for key in table if key not in size and key not in kind.settings]
    if unknown:
        raise MultiposError(
            f"{where}: unknown key '{unknown[0]}'; it takes {', '.join([*size, *kind.settings])}."
        )
    spread = {size[key]: value for key, value in table.items() if key in size}
    settings = {key: value for key, value in table.items() if key in kind.settings}
    return spread, settings


def _from_step(
    where: str, spread: Mapping[str, Any], settings: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the size of a resolution from its whole step."""
    if set(spread) - {"dof"}:
        raise MultiposError(f"{where}: 'step' states the size already; leave out the others.")
    step = _number(where, settings, "step")
    return {"half_width": step / 2.0, "distribution": "rectangular"}


def _size(where: str, spread: Mapping[str, Any], suffix: str) -> tuple[float, str]:
    """Return the standard uncertainty by eq. (1), and the law."""
    given = [key for key in ("u", "U", "half_width") if key in spread]
    if len(given) != 1:
        need = f"'u{suffix}', 'U{suffix}' with 'k', or 'half_width{suffix}'"
        found = " and ".join(f"'{key}{suffix}'" for key in given) or "none"
        raise MultiposError(f"{where}: give one of {need}; there is {found}.")
    law = _law(where, spread)
    value = _number(where, spread, given[0], given[0] + suffix)
    if given == ["U"]:
        return value / _coverage_factor(where, spread, suffix, value), law
    if "k" in spread:
        raise MultiposError(f"{where}: 'k' belongs to 'U{suffix}'; leave it out.")
    if given == ["u"]:
        return value, law
    if law == "normal":
        raise MultiposError(
            f"{where}: a normal distribution has no half-width; give 'u{suffix}', or 'U{suffix}' "
            "with 'k'."
        )
    return value / DIVISORS[law], law


def _law(where: str, spread: Mapping[str, Any]) -> str:
    usual = "rectangular" if "half_width" in spread else "normal"
    law = str(spread.get("distribution", usual))
    if law not in ("normal", *DIVISORS):
        raise MultiposError(
            f"{where}: unknown distribution '{law}'; give normal, {', '.join(DIVISORS)}."
        )
    return law


def _coverage_factor(where: str, spread: Mapping[str, Any], suffix: str, expanded: float) -> float:
    if "k" not in spread:
        raise MultiposError(f"{where}: 'U{suffix}' needs its coverage factor 'k'.")
    factor = _number(where, spread, "k")
    if not factor > 0.0:
        raise MultiposError(f"{where}: 'k' must be above 0, got {factor:g}.")
    if not expanded <= factor * LARGEST:
        raise MultiposError(f"{where}: 'k' is {factor:g}, too small for a coverage factor.")
    return factor


def _check_settings(where: str, name: str, settings: dict[str, Any]) -> None:
    """Hold the keys beside the size to what they may be, and set those that follow."""
    if name == "gravity":
        _settle_gravity(where, settings)
    if name == "index":
        _settle_index(where, settings)
    if not isinstance(settings.get("each_output", False), bool):
        raise MultiposError(f"{where}: 'each_output' must be true or false.")
    for key in ("bias_per_degC", "scale_per_degC"):
        if key in settings:
            _number(where, settings, key, signed=True)


def _settle_gravity(where: str, settings: dict[str, Any]) -> None:
    if ("value" in settings) == ("latitude_deg" in settings):
        raise MultiposError(f"{where}: give 'value' [m/s^2] or 'latitude_deg'.")
    if "height_m" in settings and "latitude_deg" not in settings:
        raise MultiposError(f"{where}: 'height_m' needs 'latitude_deg'.")
    if "latitude_deg" in settings:
        latitude = _number(where, settings, "latitude_deg", signed=True)
        height = _number(where, {"height_m": 0.0, **settings}, "height_m", signed=True)
        try:
            settings["value"] = normal_gravity(latitude, height)
        except ValueError as error:
            raise MultiposError(f"{where}: {error}") from None
    if not 1.0 <= _number(where, settings, "value") <= 100.0:
        raise MultiposError(
            f"{where}: 'value' must be in m/s^2, such as 9.81, got {settings['value']:g}."
        )


def _settle_index(where: str, settings: dict[str, Any]) -> None:
    harmonics = settings.setdefault("harmonics", [1, 2])
    whole = isinstance(harmonics, list) and all(type(order) is int for order in harmonics)
    if not (whole and harmonics and min(harmonics) >= 0):
        raise MultiposError(f"{where}: 'harmonics' must be whole numbers, such as [1, 2].")
    if settings.get("axis", "x") not in ("x", "y", "z"):
        raise MultiposError(f"{where}: 'axis' must be x, y or z, got '{settings['axis']}'.")


def _number(
    where: str, table: Mapping[str, Any], key: str, name: str | None = None, *, signed: bool = False
) -> float:
    value, called = table[key], name or key
    if not is_number(value) or math.isnan(value) or (math.isinf(value) and key != "dof"):
        raise MultiposError(f"{where}: '{called}' must be a number, got {value!r}.")
    if not signed and value < 0.0:
        raise MultiposError(f"{where}: '{called}' must be 0 or more, got {value:g}.")
    if abs(value) > LARGEST and not math.isinf(value):
        raise MultiposError(f"{where}: '{called}' must be no more than {LARGEST:g}, got {value:g}.")
    return float(value)
