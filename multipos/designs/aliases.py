"""Aliases: what a scheme cannot see of the terms that a model lacks.

`find_aliases` returns what higher terms would do to the parameters, `in_parameters` the amounts
that are worth a word, and `say_hidden` the sentence on a term that the residuals do not show.

A term that the model lacks has the column c at the positions, the model the columns Z. Its
coefficient is added to the parameters by the factors a and shows in the residuals by the part r,

    a = (Z'Z)⁻¹ Z'c,        r = ‖c − Z a‖ / ‖c‖;                                            (1)

where r = 0 the data hide it wholly.

Source: A. C. Atkinson, A. N. Donev, R. D. Tobias, Optimum Experimental Designs, with SAS, 2007
(alias matrix).
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from multipos.designs.information import Setting
from multipos.estimation.known import ZERO_NORM
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.numerics.terms import Term, sees_only
from multipos.sensor.model import build_model

UNSEEN = 1e-9  # share of a term in the residuals below which they hide it
_HIGHER = "x^2 + y^2 + z^2 + x*y + x*z + y*z + own^3 + own*|own|"


def find_aliases(setting: Setting, up: Array) -> list[dict[str, Any]]:
    """Return what higher terms would do to the parameters, eq. (2).

    Returns
    -------
    list of dict
        {output, term, seen: the part that shows in the residuals (0 … 1), into: {parameter name:
        amount per unit of the term}}, for squares, products, the own cube and own·|own|.
    """
    model = setting.model
    higher = build_model(_HIGHER, model.outputs, model.axes)
    rows = setting.rows(up)
    factors = [np.linalg.pinv(Z.reshape(-1, Z.shape[2])) for Z in rows]
    found = []
    for i, (output, own) in enumerate(zip(model.outputs, model.terms, strict=True)):
        block = i if len(rows) > 1 else 0
        Z = rows[block].reshape(-1, rows[block].shape[2])
        names = model.names[setting.blocks[block]]
        for term in higher.terms[i]:
            if term in own or not sees_only(term, model.inputs):
                continue
            column = _column_of(setting, up, i, term)
            a = factors[block] @ column
            seen = _share_left(column, Z @ a)
            amounts = zip(names, a[:, 0].tolist(), strict=True)
            found.append(
                {
                    "output": output,
                    "term": str(term),
                    "seen": seen,
                    "into": {name: value for name, value in amounts if abs(value) > UNSEEN},
                }
            )
    return found


def _column_of(setting: Setting, up: Array, output: int, term: Term) -> Array:
    """Return what a term of one output adds to the rows of its block, as a column."""
    variables = {axis: setting.size * up[:, i] for i, axis in enumerate(COMPONENTS)}
    X = np.zeros((len(up), len(setting.model.outputs), 1))
    X[:, output, 0] = term.evaluate(variables)
    whitened = setting.whiten(up, X)
    return whitened[:, output] if len(setting.blocks) > 1 else whitened.reshape(-1, 1)


def _share_left(column: Array, explained: Array) -> float:
    """Return the share of a column that is left beside what explains it, 0 where none to see."""
    size = float(np.linalg.norm(column))
    share = float(np.linalg.norm(column - explained)) / size if size > ZERO_NORM else 0.0
    return share if share >= UNSEEN else 0.0


def say_hidden(alias: Mapping[str, Any]) -> str:
    """Return as a sentence what becomes of a term that the residuals do not show."""
    name = f"{alias['term']} of {alias['output']}"
    if not alias["into"]:
        return f"`{name}` has no effect at these positions"
    return f"`{name}` passes for `{in_parameters(alias['into'])}`"


def in_parameters(amounts: Mapping[str, float], least: float = 0.0) -> str:
    """Return what a term adds to the parameters, those amounts that are above `least`."""
    return " ".join(f"{value:+.3g} {name}" for name, value in amounts.items() if abs(value) > least)
