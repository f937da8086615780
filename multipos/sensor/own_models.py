"""From a user-defined model as it is written to the model that is fitted.

`build_parsed` gives every output the formula that is its own, or that of `each`; names that are
neither components nor columns are its parameters. `hold` holds some of them at values.
`load_parsed` makes it of the formulas in the file of a calibration.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from multipos.files.spelling import near
from multipos.numerics.arrays import COMPONENTS
from multipos.sensor.compiled import OutputFormula, Source
from multipos.sensor.expressions import ExpressionModel, Symbol
from multipos.sensor.formulas import Formula
from multipos.sensor.model import Model, check_axes
from multipos.sensor.model_text import EACH, SHARED, ParsedModel, StatedParameter, parsed_from_dict

Fixed = Sequence[tuple[str, str, float]]  # output, name, value


def build_parsed(
    parsed: ParsedModel,
    outputs: tuple[str, ...],
    axes: tuple[str, ...],
    inputs: tuple[str, ...],
    unit: str,
    columns: tuple[str, ...],
    fixed: Fixed = (),
) -> ExpressionModel:
    """Return the model that a parsed model describes, for outputs.

    Parameters
    ----------
    parsed : ParsedModel
    outputs, axes, inputs, unit
        As in `Model`.
    columns : tuple of str
        Names in the formulas that are columns of the readings.
    fixed : sequence of (output, name, value)
        Parameters that are held.

    Raises
    ------
    UsageError
        An output without a line, a line without an output, or a component that is no input.
    """
    known = outputs, axes, inputs, unit, columns, tuple(fixed)
    if known in parsed.built:  # what a model knows of itself is found once
        found: ExpressionModel = parsed.built[known]
        return found
    check_axes(outputs, axes, inputs)
    formulas = _formula_of_each(parsed, outputs)
    for formula in formulas:
        _require_inputs(formula, inputs)
    held = {(output, name): value for output, name, value in fixed}
    own, shared = _free_names(dict(zip(outputs, formulas, strict=True)), columns, held)
    functions, used = [], []
    for output, axis, formula, names in zip(outputs, axes, formulas, own, strict=True):
        mine = [n for n in shared if n in formula.names]
        places = _places(axis, columns, [*names, *mine])
        places |= {n: v for (who, n), v in held.items() if who in (output, SHARED)}
        sources = tuple((name, places[name]) for name in formula.names)
        functions.append(OutputFormula(formula.steps, sources))
        used.append(tuple(shared.index(n) for n in mine))
    names = [*(n for part in own for n in part), *shared]
    if not names:
        raise parsed.fault(f"{parsed.where}: no parameter to fit other than x, y, z and own.")
    parsed.built[known] = model = ExpressionModel(
        parsed.text,
        outputs,
        axes,
        inputs,
        unit,
        tuple(tuple(Symbol(name=n) for n in part) for part in own),
        parsed=parsed,
        functions=tuple(functions),
        columns_used=columns,
        shared=tuple(Symbol(name=n) for n in shared),
        shared_by=tuple(used),
        quantities=tuple(parsed.stated.get(n, StatedParameter(n)) for n in names),
        fixed=tuple(fixed),
    )
    return model


def _free_names(
    formulas: Mapping[str, Formula], columns: tuple[str, ...], held: Mapping[tuple[str, str], float]
) -> tuple[list[list[str]], list[str]]:
    """Return the parameters of each output's own, and those shared, but for those that are held."""
    known = {*COMPONENTS, "own", *columns}
    own: list[list[str]] = []
    shared: dict[str, None] = {}
    for output, formula in formulas.items():
        own.append([])
        for name in formula.names:
            common = name.startswith(f"{SHARED}_")
            if name in known or (SHARED if common else output, name) in held:
                continue
            if common:
                shared[name] = None
            else:
                own[-1].append(name)
    return own, list(shared)


def _places(axis: str, columns: Sequence[str], parameters: Sequence[str]) -> dict[str, Source]:
    """Return where an output finds what its formula names: components, columns, parameters."""
    places: dict[str, Source] = {component: (0, i) for i, component in enumerate(COMPONENTS)}
    places["own"] = places[axis]
    places |= {name: (1, j) for j, name in enumerate(columns)}
    places |= {name: (2, i) for i, name in enumerate(parameters)}
    return places


def _formula_of_each(parsed: ParsedModel, outputs: tuple[str, ...]) -> list[Formula]:
    """Return the formula of every output."""
    formulas = parsed.formulas
    strange = [name for name in formulas if name not in (*outputs, EACH)]
    if strange:
        raise parsed.fault(
            f"{parsed.where}: '{strange[0]}' is no output{near(strange[0], (*outputs, EACH))} "
            f"The outputs are {', '.join(outputs)}; '{EACH}' stands for all that have no line."
        )
    without = [name for name in outputs if name not in formulas and EACH not in formulas]
    if without:
        raise parsed.fault(
            f"{parsed.where}: output '{without[0]}' has no line; add '{without[0]} = …', or "
            f"'{EACH} = …' for all that have none."
        )
    return [formulas.get(name) or formulas[EACH] for name in outputs]


def _require_inputs(formula: Formula, inputs: tuple[str, ...]) -> None:
    for name, character in formula.names.items():
        if name in COMPONENTS and name not in inputs:
            formula.fail(character, f"'{name}' is not among --inputs {','.join(inputs)}")


def hold(model: Model, fixed: Fixed) -> Model:
    """Return a user-defined model with parameters held at values, which fixes its gauge."""
    assert isinstance(model, ExpressionModel)
    built = build_parsed(
        model.parsed,
        model.outputs,
        model.axes,
        model.inputs,
        model.unit,
        model.columns_used,
        (*model.fixed, *fixed),
    )
    return replace(built, gauge="lower")


def load_parsed(
    own: Mapping[str, Any],
    outputs: tuple[str, ...],
    axes: tuple[str, ...],
    inputs: tuple[str, ...],
    unit: str,
    gauge: Any,
) -> ExpressionModel:
    """Return the model whose formulas a calibration's file holds; they are parsed again.

    Raises
    ------
    MultiposError
        Formulas that cannot be parsed, or parameters that are none.
    """
    built = build_parsed(
        parsed_from_dict({key: own[key] for key in ("parameters", "outputs")}),
        outputs,
        axes,
        inputs,
        unit,
        tuple(own["columns"]),
        [(part["output"], part["name"], part["value"]) for part in own["fixed"]],
    )
    return replace(built, gauge=gauge)
