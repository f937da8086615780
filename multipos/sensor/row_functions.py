"""A CasADi function over all rows of readings at once, by NumPy.

CasADi takes a function apart into elementary operations,

    w_o = operation(w_a, w_b),    w_o = input,    result_k = w_a,                           (1)

and evaluates them one row after the other. Here each operation is done once, on all rows, so
that what one costs is a few numbers in a processor's register and not a step of an interpreter:
at a thousand rows a tenth. What is of parameters alone stays one number. Rows come in blocks whose
intermediate values stay in the processor's cache.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from multipos.numerics.arrays import Array
from multipos.sensor.instructions import operations

_BLOCK = 2048  # rows


def _truth(compare: Callable[..., Any]) -> Callable[..., Any]:
    """Return a comparison as CasADi has it, of numbers that are 0 or 1."""

    def as_number(*operands: Any) -> Any:
        return np.multiply(compare(*operands), 1.0)

    return as_number


def _erf(x: Any) -> Any:
    from scipy.special import erf

    return erf(x)


# CasADi's operations by NumPy, those of another name.
_NAMED: dict[str, Callable[..., Any]] = {
    "neg": np.negative,
    "sq": np.square,
    "twice": lambda x: np.add(x, x),
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "asinh": np.arcsinh,
    "acosh": np.arccosh,
    "atanh": np.arctanh,
    "inv": lambda x: np.divide(1.0, x),
    "not": _truth(np.logical_not),
    "erf": _erf,
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
    "atan2": np.arctan2,
    "if_else_zero": lambda condition, x: np.where(condition, x, 0.0),
}

# Operation, the register that it fills, and its operands; no operation: the result that it fills.
_Step = tuple[Callable[..., Any] | None, int, int, int | None]


class RowFunction:
    """Eq. (1) of a CasADi SX function of (f, e, p) with one column of results.

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
                operation = _NAMED.get(name) or getattr(np, name)
                a, b = (*(place[register] for register in read), None)[:2]
                place[written[0]] = written[0]
                self._steps.append((operation, written[0], a, b))

    def __call__(self, force: Array, columns: Array, parameters: Array) -> Array:
        """Return the results (K, n) at n rows.

        Parameters
        ----------
        force : (n, 3) array [g]
        columns : (n, E) array
        parameters : (p,) array
        """
        known = parameters.tolist()
        result = np.zeros((self._count, len(force)))
        with np.errstate(all="ignore"):
            for begin in range(0, len(force), _BLOCK):
                rows = slice(begin, begin + _BLOCK)
                self._run([*force[rows].T, *columns[rows].T, *known], result[:, rows])
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
