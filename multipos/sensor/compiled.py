"""A model's compiled functions: the outputs, and how they change with parameters and force.

The instructions of all outputs (`multipos.sensor.compiled`) become CasADi functions

    (f, e, p)  ->  (y, dy/dp),  dy/df,  d²y/dp²,        f (3,) [g], e columns, p (p,)       (1)

with exact derivatives, each made when it is first asked for and evaluated on all rows of readings
at once (`multipos.sensor.compiled`); of dy/dp only the parameters that an output has.
Functions are kept by their content.

CasADi expressions as lists of elementary instructions, which a file can carry safely.

CasADi can serialise its functions, but reading such a text may load libraries, and a calibration
may come from somebody else. An expression is therefore kept as what it computes, one elementary
operation a line on numbered places,

    ["input", place, argument, component]   ["const", place, value]
    ["mul", place, first, second]           ["output", place]                               (2)

with CasADi's names of operations. Reading it builds the expression again from arithmetic and
elementary functions alone; anything else is refused.

A CasADi function over all rows of readings at once, by NumPy.

CasADi takes a function apart into elementary operations,

    w_o = operation(w_a, w_b),    w_o = input,    result_k = w_a,                           (3)

and evaluates them one row after the other. Here each operation is done once, on all rows, so
that what one costs is a few numbers in a processor's register and not a step of an interpreter:
at a thousand rows a tenth. What is of parameters alone stays one number. Rows come in blocks whose
intermediate values stay in the processor's cache.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, lru_cache
from itertools import accumulate, pairwise
from typing import Any

import numpy as np

from multipos.numerics.arrays import Array, Mask
from multipos.numerics.quantiles import erf

Instruction = tuple[Any, ...]


def _truth(compare: Callable[..., Any]) -> Callable[..., Any]:
    """Return a comparison as CasADi has it, of numbers that are 0 or 1."""

    def as_number(*operands: Any) -> Any:
        return np.multiply(compare(*operands), 1.0)

    return as_number


# Operations of one and two arguments, by NumPy; names as casadi.OP_* in lower case.
_UNARY: dict[str, Callable[..., Any]] = {
    "neg": np.negative,
    "exp": np.exp,
    "log": np.log,
    "sqrt": np.sqrt,
    "sq": np.square,
    "twice": lambda x: np.add(x, x),
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "tanh": np.tanh,
    "asinh": np.arcsinh,
    "acosh": np.arccosh,
    "atanh": np.arctanh,
    "fabs": np.fabs,
    "sign": np.sign,
    "inv": lambda x: np.divide(1.0, x),
    "not": _truth(np.logical_not),
    "floor": np.floor,
    "ceil": np.ceil,
    "erf": lambda x: erf(np.asarray(x, dtype=np.float64)),
    "log1p": np.log1p,
    "expm1": np.expm1,
}
_BINARY: dict[str, Callable[..., Any]] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "pow": np.power,
    "constpow": np.power,
    "lt": _truth(np.less),
    "le": _truth(np.less_equal),
    "eq": _truth(np.equal),
    "ne": _truth(np.not_equal),
    "and": _truth(np.logical_and),
    "or": _truth(np.logical_or),
    "fmin": np.fmin,
    "fmax": np.fmax,
    "atan2": np.arctan2,
    "copysign": np.copysign,
    "if_else_zero": lambda condition, x: np.where(condition, x, 0.0),
    "hypot": np.hypot,
}
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


_BLOCK = 2048  # rows

# Operation, the register that it fills, and its operands; no operation: the result that it fills.
_Step = tuple[Callable[..., Any] | None, int, int, int | None]


class RowFunction:
    """Eq. (3) of a CasADi SX function of (f, e, p) with one column of results.

    Nothing is kept between calls, which may come from several threads at once.
    """

    def __init__(self, function: Any) -> None:
        names, sizes = operations(), [function.size1_in(i) for i in range(function.n_in())]
        self._count = function.size1_out(0)
        self._registers: int = function.sz_w()
        self._constants: list[float] = []
        self._steps: list[_Step] = []
        first = [self._registers, *(self._registers + sum(sizes[: i + 1]) for i in range(3))]
        place = list(range(self._registers))  # of what stands in each register
        nothing = set()  # places of zeros, which results hold from the beginning
        for k in range(function.n_instructions()):
            name = names[function.instruction_id(k)]
            read, written = function.instruction_input(k), function.instruction_output(k)
            if name == "output":
                if place[read[0]] in nothing:
                    continue
                self._steps.append((None, written[1], place[read[0]], None))
            elif name == "input":
                place[written[0]] = first[read[0]] + read[1]
            elif name == "const":
                place[written[0]] = first[3] + len(self._constants)
                self._constants.append(float(function.instruction_constant(k)))
                if not self._constants[-1]:
                    nothing.add(place[written[0]])
            else:
                operation = _UNARY.get(name) or _BINARY[name]
                a, b = (*(place[register] for register in read), None)[:2]
                place[written[0]] = written[0]
                self._steps.append((operation, written[0], a, b))

    def __call__(self, force: Array, columns: Array, parameters: Array) -> Array:
        """Return the results (K, n) at n rows.

        Parameters
        ----------
        force : (n, 3) array [g]
        columns : (n, E) array
        parameters : (p,) or (n, p) array
            Of all rows, or of each.
        """
        known: list[Any] = parameters.tolist() if parameters.ndim == 1 else []
        result = np.zeros((self._count, len(force)))
        with np.errstate(all="ignore"):
            for begin in range(0, len(force), _BLOCK):
                rows = slice(begin, begin + _BLOCK)
                of_rows = known or parameters[rows].T
                self._run([*force[rows].T, *columns[rows].T, *of_rows], result[:, rows])
        return result

    def _run(self, given: list[Any], result: Array) -> None:
        """Fill the results of rows of a block."""
        w = [*([None] * self._registers), *given, *self._constants]
        for operation, place, a, b in self._steps:
            if operation is None:
                result[place] = w[a]
            elif b is None:
                w[place] = operation(w[a])
            else:
                w[place] = operation(w[a], w[b])


Program = tuple[Instruction, ...]


class Compiled:
    """Eq. (1) for any number of rows.

    Parameters
    ----------
    programs : tuple of M programs
        Of each output, of force, columns and its own parameters.
    places : tuple of M tuples of int
        Where these stand among all parameters.
    columns, count : int
        How many columns and parameters there are.

    Attributes
    ----------
    symbols : tuple of SX
        The force, columns and parameters.
    outputs : list of SX
        The expressions of the outputs.
    """

    def __init__(
        self,
        programs: tuple[Program, ...],
        places: tuple[tuple[int, ...], ...],
        columns: int,
        count: int,
    ) -> None:
        import casadi

        ends = [*accumulate(map(len, places), initial=0)]
        self._slopes = [slice(*pair) for pair in pairwise(ends)]
        self._places = places
        sizes = {"f": 3, "e": columns, "p": count}
        force, surroundings, unknown = (casadi.SX.sym(*each) for each in sizes.items())
        self.symbols: tuple[Any, Any, Any] = (force, surroundings, unknown)
        self.outputs: list[Any] = [
            casadi.SX(read_instructions(program, (force, surroundings, unknown[list(own)])))
            for program, own in zip(programs, places, strict=True)
        ]

    def evaluate(
        self, force: Array, columns: Array, parameters: Array
    ) -> tuple[Array, tuple[Array, ...]]:
        """Return the outputs (n, M) at n rows, and of each output dy/dp (n, p_i).

        Positions run fastest in memory.

        Parameters
        ----------
        force : (n, 3) array [g]
        columns : (n, E) array
        parameters : (p,) or (n, p) array
            Of all rows, or of each.
        """
        found = self._values(force, columns, parameters)
        slopes = found[len(self.outputs) :]
        return found[: len(self.outputs)].T, tuple(slopes[own].T for own in self._slopes)

    def predict(self, force: Array, columns: Array, parameters: Array) -> Array:
        """Return the outputs (n, M) alone, of the same arguments."""
        return self._predicted(force, columns, parameters).T

    def by_force(self, force: Array, columns: Array, parameters: Array) -> Array:
        """Return dy/df (n, M, 3), of the same arguments."""
        found = self._by_force(force, columns, parameters)
        return found.reshape(len(self.outputs), 3, len(force)).transpose(2, 0, 1)

    def bends(self, force: Array, columns: Array, parameters: Array) -> Array:
        """Return the second derivatives d²y/dp² (n, M, p, p), of the same arguments."""
        p = len(parameters)
        found = self._bends(force, columns, parameters)
        return found.T.reshape(len(force), len(self.outputs), p, p)

    @cached_property
    def _values(self) -> RowFunction:
        import casadi

        _, _, unknown = self.symbols
        slopes = [
            casadi.jacobian(y, unknown)[:, list(own)].T
            for y, own in zip(self.outputs, self._places, strict=True)
        ]
        return self._over_rows([*self.outputs, *slopes])

    @cached_property
    def _predicted(self) -> RowFunction:
        return self._over_rows(self.outputs)

    @cached_property
    def _by_force(self) -> RowFunction:
        import casadi

        force, _, _ = self.symbols
        return self._over_rows([casadi.jacobian(y, force).T for y in self.outputs])

    @cached_property
    def _bends(self) -> RowFunction:
        import casadi

        _, _, unknown = self.symbols
        return self._over_rows([casadi.vec(casadi.hessian(y, unknown)[0]) for y in self.outputs])

    def _over_rows(self, parts: list[Any]) -> RowFunction:
        """Return expressions, one below the other, as a function of rows."""
        import casadi

        column = casadi.densify(casadi.vertcat(*parts))
        return RowFunction(casadi.Function("rows", list(self.symbols), [column], {"cse": True}))

    @cached_property
    def curved(self) -> Mask:
        """Which pairs of parameters d²y/dp² can be other than zero for, (p, p)."""
        import casadi

        _, _, unknown = self.symbols
        weights = casadi.SX.sym("w", len(self.outputs))
        total = casadi.dot(weights, casadi.vertcat(*self.outputs))
        pattern = np.array(casadi.DM(casadi.hessian(total, unknown)[0].sparsity(), 1.0))
        return np.asarray(pattern != 0.0)

    @cached_property
    def linear(self) -> Mask:
        """Which parameters enter linearly together, (p,): as many as can."""
        curved = self.curved
        chosen: list[int] = []
        for place in np.argsort(curved.sum(axis=1), kind="stable").tolist():
            if not curved[place, place] and not curved[place, chosen].any():
                chosen.append(place)
        return np.isin(np.arange(len(curved)), chosen)


compile_model = lru_cache(maxsize=64)(Compiled)  # the same function for models of one content
