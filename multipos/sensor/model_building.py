"""Models as users state them: names, formulas and axes, checked against each other."""

import re
from collections.abc import Sequence
from functools import lru_cache

from multipos.errors import UsageError
from multipos.files.records import LONGEST
from multipos.files.spelling import Names, listed, split_names
from multipos.numerics.terms import (
    COMPONENTS,
    NAMED,
    Term,
    expand_others,
    function_forms,
    parse_term,
    sees_only,
    split_terms,
)
from multipos.positions.headers import axes_by_name
from multipos.sensor.model import Model


@lru_cache(maxsize=64)
def build_model(
    text: str,
    outputs: tuple[str, ...],
    axes: tuple[str, ...],
    inputs: tuple[str, ...] = COMPONENTS,
    unit: str = "reading",
    known: tuple[str, ...] | None = None,
) -> Model:
    """Return a model from its name or formula.

    Parameters
    ----------
    text : str
        A name of `NAMED`, or a formula over x, y, z, own, |own|, other and other columns.
    outputs, axes, inputs : tuples of str
        See `Model`.
    unit : str
        Unit of the readings.
    known : tuple of str, optional
        Columns that a formula may use beside the components.

    Raises
    ------
    UsageError
        Unknown model or column, a formula that cannot be parsed, axes that are not x, y, z.
    """
    check_axes(outputs, axes, inputs)
    name = " ".join(text.split())  # what is said of it stands on one line
    if len(name) > LONGEST:
        raise UsageError(
            f"the formula has {len(name)} characters, and the file of a calibration holds at most "
            f"{LONGEST}; write every term once."
        )
    formula = NAMED.get(name, name)
    words = (*NAMED, *COMPONENTS, "1", "own", "other", *(known or ()))
    if re.fullmatch(r"[\w-]+", name) and name not in words:
        raise UsageError(
            f"unknown model '{name}'; give {', '.join(NAMED)} "
            "or a formula such as '1 + x + y + z + own^2'."
        )
    terms = tuple(_seen_terms(formula, text, axis, inputs) for axis in axes)
    model = Model(name, outputs, axes, inputs, unit, terms)
    if known is not None:
        _check_columns(model, set(known), text)
    return model


def _seen_terms(formula: str, text: str, axis: str, inputs: tuple[str, ...]) -> tuple[Term, ...]:
    """Return the terms of an output that its inputs let act; a name leaves the others out."""
    parts = expand_others(split_terms(formula, text), axis, inputs)
    if not parts:
        raise UsageError(
            f"model '{text}': there is no other component than {axis} among --inputs "
            f"{','.join(inputs)}; drop the term or name the input."
        )
    parsed = dict.fromkeys(parse_term(part, text, axis) for part in parts)
    seen = tuple(term for term in parsed if sees_only(term, inputs))
    if len(seen) < len(parsed) and text.strip() not in NAMED:
        hidden = next(str(term) for term in parsed if term not in seen)
        raise UsageError(
            f"term '{hidden}' of the formula needs a component that is not among "
            f"--inputs {','.join(inputs)}; drop the term or name the input."
        )
    return seen


def _check_columns(model: Model, columns: set[str], text: str) -> None:
    for variable in model.environment:
        if variable not in columns:
            raise UsageError(
                f"unknown term '{variable}' in model '{text}'; a term is made of x, y, z, own, "
                + ", ".join([*function_forms("own"), *sorted(columns)])
                + "."
            )


def default_axes(outputs: Sequence[str], axes: Names | None) -> tuple[str, ...]:
    """Return the case axis of each output: as given, as it names it, or x, y, z in order.

    An axis that is given may have a minus before it, which tells which way the output faces and
    is no part of what is returned (`stated_facing`).
    """
    if axes is not None:
        return tuple(axis.removeprefix("-") for axis in split_names(axes, "--axes"))
    named = axes_by_name(tuple(outputs))
    if named is not None:
        return named
    if len(outputs) > 3:
        raise UsageError(
            f"{len(outputs)} columns could be outputs: {listed(outputs, 12)}; name them with "
            "--outputs, or state with --axes which axis each one senses."
        )
    return COMPONENTS[: len(outputs)]


def stated_facing(axes: Names | None) -> tuple[str, ...] | None:
    """Return what `--axes` says, as x or -y; None where it is not given."""
    return None if axes is None else split_names(axes, "--axes")


def check_axes(outputs: tuple[str, ...], axes: tuple[str, ...], inputs: tuple[str, ...]) -> None:
    """Raise `UsageError` where axes and inputs are not components, or do not fit the outputs."""
    for option, names in (("--axes", axes), ("--inputs", inputs)):
        strange = [name for name in names if name not in COMPONENTS]
        if strange or not names:
            raise UsageError(f"{option} takes x, y and z, got '{','.join(names)}'.")
    if len(set(inputs)) < len(inputs):
        raise UsageError(f"--inputs names a component twice: {','.join(inputs)}.")
    if len(axes) != len(outputs):
        raise UsageError(
            f"--axes names {len(axes)} axes for {len(outputs)} outputs "
            f"({', '.join(outputs)}); give one axis per output."
        )
    for output, axis in zip(outputs, axes, strict=True):
        if axis not in inputs:
            raise UsageError(
                f"output '{output}' senses axis {axis}, which is not among "
                f"--inputs {','.join(inputs)}; name it there, or choose the outputs with --outputs."
            )
