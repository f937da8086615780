"""Models written as Python expressions, for sensors that no polynomial describes.

A model is a function of the reference components and of the parameters to be found, one output
at a time; its arguments say which is which:

    def saturating(own, x, y, z, bias, scale, limit=0.0):
        linear = bias + scale * own
        return linear / (1 + limit * linear**2)

`own`, `x`, `y`, `z` and columns of the readings are variables, every other argument is a
parameter, which each output has for itself. The function is called once with CasADi symbols, and
CasADi's exact derivatives take it through the same likelihood as every other model. The search
starts where ``bias`` and ``scale`` are those of a straight line through the readings and every
other parameter has its default, or zero.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from inspect import Parameter, signature
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import UsageError
from multipos.numerics.arrays import Array
from multipos.numerics.terms import COMPONENTS, Term
from multipos.sensor.instructions import (
    Instruction,
    read_instructions,
    require_instructions,
    write_instructions,
)
from multipos.sensor.model import Block, Gauge, Model, check_axes
from multipos.units import unit_per

Expression = Callable[..., Any]


def load_casadi() -> Any:
    """Return CasADi, with symbols that take ``abs``: by themselves they do from 3.8 on."""
    import casadi

    if not hasattr(casadi.SX, "__abs__"):
        casadi.SX.__abs__ = casadi.SX.fabs  # type: ignore[method-assign]
    return casadi


@dataclass(frozen=True)
class Symbol(Term):
    """A parameter of an expression, in the place of a term."""

    name: str = ""

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True)
class ExpressionModel(Model):
    """A model whose outputs are expressions; see `Model` for the other attributes.

    Attributes
    ----------
    functions : tuple of M tuples
        Instructions (`multipos.sensor.instructions`) of y(f, e, p).
    columns_used : tuple of str
        Columns of the readings, e.
    start : tuple of float
        Where the parameters of an output start, beside bias and scale.
    """

    functions: tuple[tuple[Instruction, ...], ...] = ()
    columns_used: tuple[str, ...] = ()
    start: tuple[float, ...] = ()

    @property
    def environment(self) -> tuple[str, ...]:
        """Columns other than the reference that the expressions use."""
        return self.columns_used

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Parameter names such as ``limit_ax``."""
        return tuple(f"{term}_{output}" for output, term in self.keys)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Parameter units: known for bias and scale, else left open."""
        known = {"bias": self.unit, "scale": unit_per(self.unit, 1)}
        return tuple(known.get(str(term), "-") for _, term in self.keys)

    @property
    def is_linear(self) -> bool:
        """Whether the outputs are linear in the force."""
        return False

    @property
    def has_all_linear(self) -> bool:
        """Whether bias and scale factor mean what they do in a polynomial."""
        return False

    def respond(
        self, parameters: Array, force: Array, environment: Mapping[str, ArrayLike]
    ) -> tuple[Array, tuple[Block, ...]]:
        """Return the outputs (n, M), and per output its parameters with dy/dp (n, p_i)."""
        found = self._evaluate(parameters, force, environment)
        outputs = np.column_stack([y for y, _, _ in found])
        blocks = tuple(
            (np.arange(part.start, part.stop), slope)
            for part, (_, slope, _) in zip(self.slices, found, strict=True)
        )
        return outputs, blocks

    def force_jacobian(
        self, parameters: Array, force: Array, environment: Mapping[str, ArrayLike]
    ) -> Array:
        """Return dy/df (n, M, 3)."""
        found = self._evaluate(parameters, force, environment)
        return np.stack([by_force for _, _, by_force in found], axis=1)

    def predict(
        self, parameters: Array, force: Array, environment: Mapping[str, ArrayLike]
    ) -> Array:
        """Return the outputs (n, M)."""
        return self.respond(parameters, force, environment)[0]

    def first_guess(self, values: Array, force: Array) -> Array:
        """Return where the search starts, (p,), from readings (n, M) at force (n, 3)."""
        theta = np.tile(self.start, len(self.outputs)).astype(np.float64)
        for output, (axis, part) in enumerate(zip(self.axes, self.slices, strict=True)):
            own = force[:, COMPONENTS.index(axis)]
            slope, level = np.polyfit(own, values[:, output], 1)
            for place, term in zip(range(part.start, part.stop), self.terms[output], strict=True):
                theta[place] = {"bias": level, "scale": slope}.get(str(term), theta[place])
        return theta

    def only(self, output: str) -> "ExpressionModel":
        """Return the model of one output alone."""
        i = self.outputs.index(output)
        return ExpressionModel(
            self.text,
            (output,),
            (self.axes[i],),
            self.inputs,
            self.unit,
            (self.terms[i],),
            None,
            (self.functions[i],),
            self.columns_used,
            self.start,
        )

    def with_gauge(self, gauge: Gauge) -> "Model":
        """Refuse: which parameters a rotation of the case mixes is not known of an expression."""
        raise UsageError(
            "a model written as an expression needs positions whose orientation is listed; "
            "give --orientation-sd for those that are uncertain."
        )

    @cached_property
    def compiled(self) -> tuple[Any, ...]:
        """CasADi functions (f, e, p) -> (y, dy/dp, dy/df), one for each output."""
        sizes = (len(COMPONENTS), len(self.columns_used), len(self.terms[0]))
        return tuple(_differentiated(program, sizes) for program in self.functions)

    def _evaluate(
        self, parameters: Array, force: Array, environment: Mapping[str, ArrayLike]
    ) -> list[tuple[Array, Array, Array]]:
        n = len(force)
        variables = self.variables(force, environment)
        columns = np.array([variables[name] for name in self.columns_used]).reshape(-1, n)
        result = []
        for function, part in zip(self.compiled, self.slices, strict=True):
            own = np.repeat(parameters[part][:, None], n, axis=1)
            y, by_parameter, by_force = function.map(n)(force.T, columns, own)
            result.append(
                (
                    np.asarray(y).ravel(),
                    np.asarray(by_parameter).T,
                    np.asarray(by_force).T,
                )
            )
        return result


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
    columns, parameters = _told_apart(arguments, known)
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
    start = tuple(0.0 if a.default is Parameter.empty else float(a.default) for a in parameters)
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
        start,
    )


def _told_apart(
    arguments: Sequence[Parameter], known: tuple[str, ...]
) -> tuple[tuple[str, ...], list[Parameter]]:
    """Return the columns of the readings among the arguments, and the parameters to be found."""
    if any(a.kind in (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD) for a in arguments):
        raise UsageError("the model's function must name each of its arguments.")
    columns = tuple(a.name for a in arguments if a.name in known)
    parameters = [a for a in arguments if a.name not in (*COMPONENTS, "own", *columns)]
    if not parameters:
        raise UsageError("the model's function has no parameter to fit beside x, y, z and own.")
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


def _differentiated(program: Sequence[Sequence[Any]], sizes: tuple[int, int, int]) -> Any:
    """Return the CasADi function (f, e, p) -> (y, dy/dp, dy/df) of a program."""
    import casadi

    force, surroundings, unknown = (casadi.SX.sym("a", size) for size in sizes)
    y = read_instructions(program, (force, surroundings, unknown))
    slopes = (casadi.jacobian(y, unknown).T, casadi.jacobian(y, force).T)
    dense = [casadi.densify(item) for item in (y, *slopes)]
    return casadi.Function("output", [force, surroundings, unknown], dense)


def expression_dict(model: Model) -> dict[str, Any]:
    """Return what a calibration's file needs to rebuild an expression; nothing for others."""
    if not isinstance(model, ExpressionModel):
        return {}
    return {
        "expression": {
            "functions": model.functions,
            "columns": model.columns_used,
            "parameters": [str(term) for term in model.terms[0]],
        }
    }


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
        (0.0,) * len(symbols),
    )
