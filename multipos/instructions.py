"""CasADi expressions as lists of elementary instructions, which a file can carry safely.

CasADi can serialise its functions, but reading such a text may load libraries, and a calibration
may come from somebody else. An expression is therefore kept as what it computes, one elementary
operation a line on numbered places,

    ["input", place, argument, component]   ["const", place, value]
    ["mul", place, first, second]           ["output", place]                               (1)

with CasADi's names of operations. Reading it builds the expression again from arithmetic and
elementary functions alone; anything else is refused.
"""

from collections.abc import Sequence
from typing import Any

Instruction = tuple[Any, ...]

# Operations of one and two arguments; names as casadi.OP_* in lower case.
_UNARY = (
    "neg", "exp", "log", "sqrt", "sq", "twice", "sin", "cos", "tan", "asin", "acos", "atan",
    "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "fabs", "sign", "inv", "not", "floor",
    "ceil", "erf", "log1p", "expm1",
)  # fmt: skip
_BINARY = (
    "add", "sub", "mul", "div", "pow", "constpow", "lt", "le", "eq", "ne", "and", "or", "fmin",
    "fmax", "atan2", "copysign", "if_else_zero", "hypot",
)  # fmt: skip


def write_instructions(function: Any) -> tuple[Instruction, ...]:
    """Return the instructions of a CasADi SX function with one scalar output."""
    names = _operations()
    program: list[Instruction] = []
    for k in range(function.n_instructions()):
        name = names[function.instruction_id(k)]
        read, written = function.instruction_input(k), function.instruction_output(k)
        if name == "output":
            program.append((name, read[0]))
        elif name == "const":
            program.append((name, written[0], float(function.instruction_constant(k))))
        else:
            program.append((name, written[0], *read))
    return tuple(program)


def read_instructions(program: Sequence[Sequence[Any]], arguments: Sequence[Any]) -> Any:
    """Return the expression (SX) of a program in terms of its arguments.

    Raises
    ------
    ValueError
        An instruction that is not among those known, or does not fit.
    """
    import casadi

    places: dict[int, Any] = {}
    result = None
    for name, *rest in program:
        if name == "output":
            result = places[rest[0]]
        elif name == "input":
            place, argument, component = rest
            places[place] = arguments[argument][component]
        elif name == "const":
            places[rest[0]] = casadi.SX(float(rest[1]))
        elif name in _UNARY and len(rest) == 2:
            operation = getattr(casadi, f"OP_{name.upper()}")
            places[rest[0]] = casadi.SX.unary(operation, places[rest[1]])
        elif name in _BINARY and len(rest) == 3:
            operation = getattr(casadi, f"OP_{name.upper()}")
            places[rest[0]] = casadi.SX.binary(operation, places[rest[1]], places[rest[2]])
        else:
            raise ValueError(f"the expression has an unknown instruction '{name}'")
    if result is None:
        raise ValueError("the expression has no output")
    return result


def _operations() -> dict[int, str]:
    """Return CasADi's numbers of the operations that are known, with their names."""
    import casadi

    known = ("input", "const", "output", *_UNARY, *_BINARY)
    return {getattr(casadi, f"OP_{name.upper()}"): name for name in known}
