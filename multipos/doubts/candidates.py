"""The terms that a model could have: the standard ones up to third order that it lacks.

Kinds of terms are written for an output of any axis, `own` and `other` standing for components:

    1, own, other · own², own|own|, own³, own·other · and of every column, the next power of it
    alone and with own, up to the third.                                                    (1)

They are those of the standard models (IEEE Std 1293: K0, K1 and misalignment; K2, Koq, K3, Kip and
Kio). Squares and products of the other components are not among them: x² + y² + z² = 1 at rest.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from multipos.numerics.terms import NAMED, Term, kind_terms
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.model import Model

OF_FORCE = ("1", "own", "other", "own^2", "own*|own|", "own^3", "own*other")
_HIGHEST = 3
_COLUMN = "temperature"  # the column that is asked of though the model does not use it


class Kind(NamedTuple):
    """A kind of term, and what of it each output lacks."""

    name: str
    terms: tuple[tuple[Term, ...], ...]


class Setting(NamedTuple):
    """What the kinds depend on, in a form that can be looked up fast."""

    names: tuple[str, ...]  # of the parameters
    axes: tuple[str, ...]
    inputs: tuple[str, ...]
    columns: tuple[str, ...]
    adrift: bool


def lacking(c: Calibration) -> tuple[Kind, ...]:
    """Return the kinds of terms that a calibration's model lacks, wholly or in part."""
    model = c.model
    used = model.environment
    if _COLUMN not in used and _varies(c, _COLUMN):
        used = (*used, _COLUMN)
    setting = Setting(model.names, model.axes, model.inputs, used, model.gauge is not None)
    return _kinds(setting, _Unhashed(model))


def formula_with(model: Model, kinds: tuple[str, ...]) -> str:
    """Return the formula of a model with more terms."""
    return " + ".join((NAMED.get(model.text, model.text), *kinds))


class _Unhashed:
    """A model beside the setting that says it all, so that looking up costs no hash of it."""

    def __init__(self, model: Model) -> None:
        self.model = model

    def __hash__(self) -> int:
        return 0

    def __eq__(self, other: object) -> bool:
        return True


@lru_cache(maxsize=64)
def _kinds(setting: Setting, unhashed: _Unhashed) -> tuple[Kind, ...]:
    model = unhashed.model
    names = [*OF_FORCE, *(name for column in setting.columns for name in _powers(model, column))]
    if setting.adrift:  # what lies along other axes is a rotation of the case
        names.remove("other")
    own: tuple[tuple[Term, ...], ...] = model.terms
    if isinstance(model, ExpressionModel):
        own = ((),) * len(model.outputs)  # its derivatives tell what it has
    found = (
        Kind(
            name,
            tuple(
                tuple(term for term in kind_terms(name, axis, model.inputs) if term not in has)
                for axis, has in zip(model.axes, own, strict=True)
            ),
        )
        for name in names
    )
    return tuple(kind for kind in found if any(kind.terms))


def _powers(model: Model, column: str) -> list[str]:
    """Return the next power of a column alone, and with the own component."""
    result = []
    for along in (False, True):
        powers = [
            dict(term.environment).get(column, 0)
            for axis, terms in zip(model.axes, model.terms, strict=True)
            for term in terms
            if term.force_degree == along and term.along == (axis if along else None)
        ]
        power = max(powers, default=0) + 1
        if power <= _HIGHEST:
            name = column if power == 1 else f"{column}^{power}"
            result.append(f"{name}*own" if along else name)
    return result


def _varies(c: Calibration, name: str) -> bool:
    column = c.readings.environment.get(name)
    return column is not None and bool(np.isfinite(column).all()) and bool(np.ptp(column) > 0.0)
