"""CasADi expressions as lists of elementary instructions, which a file can carry safely.

CasADi can serialise its functions, but reading such a text may load libraries, and a calibration
may come from somebody else. An expression is therefore kept as what it computes, one elementary
operation a line on numbered places,

    ["input", place, argument, component]   ["const", place, value]
    ["mul", place, first, second]           ["output", place]                               (1)

with CasADi's names of operations. Reading it builds the expression again from arithmetic and
elementary functions alone; anything else is refused.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

Instruction = tuple[Any, ...]

# Operations of one and two arguments; names as casadi.OP_* in lower case.
_UNARY = (
    "neg",
    "exp",
    "log",
    "sqrt",
    "sq",
    "twice",
    "sin",
    "cos",
    "tan",
    "asin",
    "acos",
    "atan",
    "sinh",
    "cosh",
    "tanh",
    "asinh",
    "acosh",
    "atanh",
    "fabs",
    "sign",
    "inv",
    "not",
    "floor",
    "ceil",
    "erf",
    "log1p",
    "expm1",
)
_BINARY = (
    "add",
    "sub",
    "mul",
    "div",
    "pow",
    "constpow",
    "lt",
    "le",
    "eq",
    "ne",
    "and",
    "or",
    "fmin",
    "fmax",
    "atan2",
    "copysign",
    "if_else_zero",
    "hypot",
)

# How many numbers follow an operation's name.
_OPERANDS: Mapping[str, int] = {
    "input": 3,
    "const": 2,
    "output": 1,
    **dict.fromkeys(_UNARY, 2),
    **dict.fromkeys(_BINARY, 3),
}
_MOST = 10_000  # instructions, and places, of one output


def write_instructions(function: Any) -> tuple[Instruction, ...]:
    """Return the instructions of a CasADi SX function with one scalar output."""
    names = operations()
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


def require_instructions(program: Sequence[Sequence[Any]], sizes: Sequence[int]) -> None:
    """Hold a program from a file to what `read_instructions` can read.

    Parameters
    ----------
    program : sequence of instructions (1)
    sizes : sequence of int
        How many components each argument has.

    Raises
    ------
    ValueError
        An operation that is not known, a place that is not filled yet, a component that is not
        there, a constant that is not a finite number, no output, or more than can be meant.
    """
    if len(program) > _MOST:
        raise ValueError(f"the expression has {len(program)} instructions, {_MOST} are the most")
    filled: set[int] = set()
    for line, (name, *rest) in enumerate(program, start=1):
        if not isinstance(name, str) or name not in _OPERANDS:
            raise ValueError(f"the expression has an unknown instruction {name!r:.40}")
        if not (_has_operands(name, rest) and _is_filled(name, rest, filled, sizes)):
            raise ValueError(f"instruction {line} of the expression, '{name}', has operands amiss")
        if name != "output":
            filled.add(rest[0])
    if not any(name == "output" for name, *_ in program):
        raise ValueError("the expression has no output")


def _has_operands(name: str, operands: Sequence[Any]) -> bool:
    """Tell whether an instruction has as many numbers as it needs, places where they belong."""
    places = operands[:1] if name == "const" else operands
    whole = all(type(place) is int and 0 <= place < _MOST for place in places)
    return whole and len(operands) == _OPERANDS[name]


def _is_filled(name: str, operands: Sequence[Any], filled: set[int], sizes: Sequence[int]) -> bool:
    """Tell whether all that an instruction reads is there."""
    if name == "input":
        _, argument, component = operands
        return bool(argument < len(sizes) and component < sizes[argument])
    if name == "const":
        return isinstance(operands[1], int | float) and math.isfinite(operands[1])
    return filled.issuperset(operands if name == "output" else operands[1:])


def read_instructions(program: Sequence[Sequence[Any]], arguments: Sequence[Any]) -> Any:
    """Return the expression (SX) of a program in terms of its arguments.

    The program is one that `write_instructions` wrote or `require_instructions` let through.
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
        else:
            operation = getattr(casadi, f"OP_{name.upper()}")
            build = casadi.SX.unary if name in _UNARY else casadi.SX.binary
            places[rest[0]] = build(operation, *(places[place] for place in rest[1:]))
    return result


def operations() -> dict[int, str]:
    """Return CasADi's numbers of the operations that are known, with their names."""
    import casadi

    return {getattr(casadi, f"OP_{name.upper()}"): name for name in _OPERANDS}
