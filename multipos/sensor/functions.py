"""Models written as Python functions, for what a formula cannot say.

The function is called once with CasADi symbols, and its file keeps the elementary instructions
(`multipos.sensor.compiled`) that it is made of.
"""

from collections.abc import Mapping, Sequence
from inspect import Parameter, signature
from typing import Any

from multipos.errors import UsageError
from multipos.numerics.terms import COMPONENTS
from multipos.sensor.compiled import Instruction, require_instructions, write_instructions
from multipos.sensor.expressions import Expression, ExpressionModel, Symbol, load_casadi
from multipos.sensor.formulas import StatedParameter
from multipos.sensor.stating import check_axes


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
