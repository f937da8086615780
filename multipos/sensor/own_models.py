"""From a model of one's own as it is written to the model that is fitted, and to its file.

Every output gets the formula that is its own, or that of `each`; names that are neither components
nor columns are its parameters. The file of a calibration holds the formulas, which are parsed again
when it is read.

A Python function, for what a formula cannot say, is called once with CasADi symbols, and the file
keeps the elementary instructions (`multipos.sensor.compiled`) that it is made of.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from inspect import Parameter, signature
from typing import Any

from multipos.errors import UsageError
from multipos.files.spelling import near
from multipos.numerics.arrays import COMPONENTS
from multipos.sensor.compiled import Instruction, require_instructions, write_instructions
from multipos.sensor.expressions import Expression, ExpressionModel, Symbol, load_casadi
from multipos.sensor.formulas import (
    EACH,
    SHARED,
    Formula,
    ParsedModel,
    StatedParameter,
    instruct,
    parsed_dict,
    parsed_from_dict,
)
from multipos.sensor.model import check_axes

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
        functions.append(tuple(instruct(formula, places)))
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
        None,
        tuple(functions),
        columns,
        tuple(Symbol(name=n) for n in shared),
        tuple(used),
        tuple(parsed.stated.get(n, StatedParameter(n)) for n in names),
        parsed,
        tuple(fixed),
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


def _places(
    axis: str, columns: Sequence[str], parameters: Sequence[str]
) -> dict[str, tuple[int, int] | float]:
    """Return where an output finds what its formula names: components, columns, parameters."""
    places: dict[str, tuple[int, int] | float] = {
        component: (0, i) for i, component in enumerate(COMPONENTS)
    }
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


def hold(model: ExpressionModel, fixed: Fixed) -> ExpressionModel:
    """Return a model with parameters held at values, which fixes its gauge.

    Raises
    ------
    UsageError
        The model is a Python function, whose parameters stay what they are.
    """
    if model.parsed is None:
        names = ", ".join(f"{name} of {output}" for output, name, _ in fixed)
        raise UsageError(
            "a rotation of the case leaves the readings of this function as they are, so some of "
            f"its parameters must be held: write it as a formula, or leave out {names}."
        )
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


def expression_dict(model: ExpressionModel) -> dict[str, Any]:
    """Return what a calibration's file needs to rebuild an expression."""
    if model.parsed is not None:
        fixed = [{"output": o, "name": n, "value": v} for o, n, v in model.fixed]
        content = {**parsed_dict(model.parsed), "columns": model.columns_used, "fixed": fixed}
        return {"own_model": content}
    return {
        "expression": {
            "functions": model.functions,
            "columns": model.columns_used,
            "parameters": [str(term) for term in model.terms[0]],
        }
    }


def load_parsed(content: Mapping[str, Any]) -> ExpressionModel:
    """Return the model whose formulas a calibration's file holds; they are parsed again.

    Raises
    ------
    MultiposError
        Formulas that cannot be parsed, or parameters that are none.
    """
    own = content["own_model"]
    built = build_parsed(
        parsed_from_dict({key: own[key] for key in ("parameters", "outputs")}),
        tuple(content["outputs"]),
        tuple(content["axes"]),
        tuple(content["inputs"]),
        content["unit"],
        tuple(own["columns"]),
        [(part["output"], part["name"], part["value"]) for part in own["fixed"]],
    )
    return replace(built, gauge=content["gauge"])


def build_expression(
    expression: Expression,
    outputs: tuple[str, ...],
    axes: tuple[str, ...],
    unit: str,
    known: tuple[str, ...],
) -> ExpressionModel:
    """Return the model of a Python function of the components, one for each output.

    Raises
    ------
    UsageError
        The function takes no parameter, or does not return one expression.
    """
    casadi = load_casadi()
    arguments = tuple(signature(expression).parameters.values())
    columns, parameters = _separated(arguments, known)
    force = casadi.SX.sym("f", 3)
    surroundings = casadi.SX.sym("e", len(columns))
    unknown = casadi.SX.sym("p", len(parameters))
    values = {axis: force[i] for i, axis in enumerate(COMPONENTS)}
    values |= {name: surroundings[i] for i, name in enumerate(columns)}
    values |= {a.name: unknown[i] for i, a in enumerate(parameters)}
    functions = []
    for axis in axes:
        given = {**values, "own": values[axis]}
        y = _called(expression, {a.name: given[a.name] for a in arguments})
        functions.append(_program(y, [force, surroundings, unknown], expression))
    known_of = tuple(
        StatedParameter(a.name, None if a.default is Parameter.empty else float(a.default))
        for a in parameters
    )
    symbols = tuple(Symbol(name=a.name) for a in parameters)
    name = getattr(expression, "__name__", "expression")
    return ExpressionModel(
        f"expression {name}",
        outputs,
        axes,
        COMPONENTS,
        unit,
        (symbols,) * len(outputs),
        None,
        tuple(functions),
        columns,
        shared_by=((),) * len(outputs),
        quantities=known_of * len(outputs),
    )


def _separated(
    arguments: Sequence[Parameter], known: tuple[str, ...]
) -> tuple[tuple[str, ...], list[Parameter]]:
    """Return the columns of the readings among the arguments, and the parameters to be found."""
    if any(a.kind in (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD) for a in arguments):
        raise UsageError("the model's function must name each of its arguments.")
    columns = tuple(a.name for a in arguments if a.name in known)
    parameters = [a for a in arguments if a.name not in (*COMPONENTS, "own", *columns)]
    if not parameters:
        raise UsageError("the model's function has no parameter to fit other than x, y, z and own.")
    return columns, parameters


def _called(expression: Expression, arguments: Mapping[str, Any]) -> Any:
    """Return what the function makes of symbols, which must be one value (SX)."""
    casadi = load_casadi()
    try:
        y = casadi.SX(expression(**arguments))
    except (NotImplementedError, RuntimeError, TypeError) as error:
        why = str(error).partition("\n")[0]
        raise UsageError(
            f"the model's function must return one value made of its arguments: {why}; for a "
            "condition use casadi.if_else."
        ) from None
    if y.shape != (1, 1):
        raise UsageError(f"the model's function must return one value, got shape {y.shape}.")
    return y


def _program(y: Any, arguments: list[Any], expression: Expression) -> tuple[Instruction, ...]:
    import casadi

    try:
        function = casadi.Function("output", arguments, [casadi.densify(y)])
        return write_instructions(function)
    except (RuntimeError, KeyError):
        raise UsageError(
            f"{getattr(expression, '__name__', 'the model')} uses an operation or a symbol that "
            "a model cannot be made of; use arithmetic and elementary functions of its arguments."
        ) from None


def load_expression(content: Mapping[str, Any]) -> ExpressionModel:
    """Return the model that `expression_dict` described, from a calibration's file.

    Raises
    ------
    ValueError
        Instructions that cannot be read, or that do not fit the outputs.
    """
    outputs, expression = tuple(content["outputs"]), content["expression"]
    axes, inputs = tuple(content["axes"]), tuple(content["inputs"])
    check_axes(outputs, axes, inputs)
    if len(expression["functions"]) != len(outputs):
        raise ValueError(f"it has {len(expression['functions'])} expressions for its outputs")
    sizes = (len(COMPONENTS), len(expression["columns"]), len(expression["parameters"]))
    for program in expression["functions"]:
        require_instructions(program, sizes)
    symbols = tuple(Symbol(name=name) for name in expression["parameters"])
    return ExpressionModel(
        content["model"],
        outputs,
        axes,
        inputs,
        content["unit"],
        (symbols,) * len(outputs),
        None,
        tuple(tuple(map(tuple, program)) for program in expression["functions"]),
        tuple(expression["columns"]),
        shared_by=((),) * len(outputs),
        quantities=tuple(StatedParameter(str(symbol)) for symbol in symbols) * len(outputs),
    )
