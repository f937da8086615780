"""How the zero repeats, as a budget states it: by a file of `multipos stability`, or in numbers.

The zeros of the next switch-on differ from those of the calibration by the standard deviations
from run to run, each output by its own. Of raw outputs they move the readings as they are; of
compensated force they act along its axis, dy = J e_axis.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.numerics.arrays import LARGEST, Array
from multipos.numerics.terms import COMPONENTS
from multipos.sensor.calibration import Calibration

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
            raise MultiposError(f"{where}: 'file' says it all; leave out the others.")
        return _from_file(where, table["file"], beside)
    _check_numbers(where, table)
    return {"dof": math.inf, **table}


def _check_numbers(where: str, table: Mapping[str, Any]) -> None:
    _check_keys(where, table)
    for name, value in table.items():
        least, most = (1.0, math.inf) if name == "dof" else (0.0, LARGEST)
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not least <= value <= most:
            raise MultiposError(
                f"{where}: '{name}' must be a number of at least {least:g}, got {value!r}."
            )


def _check_keys(where: str, table: Mapping[str, Any]) -> None:
    sizes = [key for key in table if key.startswith(_SIZE) and key != _SIZE]
    unknown = [key for key in table if key not in sizes and key != "dof"]
    if unknown or not sizes:
        found = f"there is '{unknown[0]}'" if unknown else "there is none of them"
        raise MultiposError(
            f"{where}: give 'file', or standard deviations by output, 'u_ax' and so on, with "
            f"'dof'; {found}."
        )


def _from_file(where: str, name: Any, beside: str) -> dict[str, Any]:
    if not isinstance(name, str):
        raise MultiposError(f"{where}: 'file' must be the name of a file, got {name!r}.")
    # Imported here, for a budget seldom names such a file, and every fit may have a budget.
    from multipos.bias_stability.stability_file import load_stability

    found = load_stability(Path(beside).parent / name)
    if not found.run_to_run:
        raise MultiposError(
            f"{where}: {name} is of one record, which says nothing about how the zero repeats; "
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
