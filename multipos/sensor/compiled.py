"""A model's one compiled function: the outputs, and how they change with parameters and force.

The instructions of all outputs (`multipos.sensor.instructions`) become one CasADi function

    (f, e, p)  ->  (y, dy/dp, dy/df),        f (3,) [g], e columns, p (p,)                  (1)

with exact derivatives, mapped once over all rows of readings; of dy/dp only the parameters that an
output has. Functions are kept by their content, maps by the number of rows, and the last values
by what they were asked for: a search asks for the slopes by force where it asked for the outputs.
"""

import threading
from collections.abc import Sequence
from functools import cached_property, lru_cache
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.numerics.arrays import Array
from multipos.sensor.instructions import Instruction, read_instructions

_MAPS = 8  # numbers of rows whose maps are kept

Program = tuple[Instruction, ...]


class Values(NamedTuple):
    """The outputs (n, M), of each output dy/dp (n, p_i), and dy/df (n, M, 3)."""

    outputs: Array
    slopes: tuple[Array, ...]
    by_force: Array


@lru_cache(maxsize=64)
def compile_model(
    programs: tuple[Program, ...], places: tuple[tuple[int, ...], ...], columns: int, count: int
) -> "Compiled":
    """Return the compiled function of a model.

    Parameters
    ----------
    programs : tuple of M programs
        Of each output, of force, columns and its own parameters.
    places : tuple of M tuples of int
        Where these stand among all parameters.
    columns, count : int
        How many columns and parameters there are.
    """
    return Compiled(programs, places, columns, count)


class Compiled:
    """Eq. (1) for any number of rows; see `compile_model`."""

    def __init__(
        self,
        programs: tuple[Program, ...],
        places: tuple[tuple[int, ...], ...],
        columns: int,
        count: int,
    ) -> None:
        ends = [*accumulate(map(len, places), initial=0)]
        self._slopes = [slice(*pair) for pair in pairwise(ends)]
        self._places = places
        self._symbols = _symbols(columns, count)
        self._outputs = _expressions(programs, places, self._symbols)
        self._function = _with_slopes(self._outputs, places, self._symbols)
        self._own = threading.local()  # buffers: threads must not write into each other's

    def evaluate(self, force: Array, columns: Array, parameters: Array) -> Values:
        """Return the values at n rows.

        Parameters
        ----------
        force : (n, 3) array [g]
        columns : (n, E) array
        parameters : (p,) array
        """
        mapped = self._map(self._function, len(force))
        return _split(mapped.call(force, columns, parameters), self._slopes)

    def _map(self, function: Any, n: int) -> "_Map":
        """Return a function over n rows; the last few are kept."""
        if not hasattr(self._own, "maps"):
            self._own.maps = {}
        maps: dict[tuple[str, int], _Map] = self._own.maps
        key = (function.name(), n)
        if key not in maps:
            if len(maps) >= _MAPS:
                maps.pop(next(iter(maps)))
            maps[key] = _Map(function, n)
        return maps[key]

    def bends(self, force: Array, columns: Array, parameters: Array) -> Array:
        """Return the second derivatives d²y/dp² (n, M, p, p)."""
        n, m, p = len(force), len(self._places), len(parameters)
        found = self._map(self._second, n).call(force, columns, parameters)
        return found.T.reshape(n, m, p, p)

    @cached_property
    def _second(self) -> Any:
        return _second_derivatives(self._outputs, self._symbols)

    @cached_property
    def curved(self) -> NDArray[np.bool_]:
        """Which pairs of parameters d²y/dp² can be other than zero for, (p, p)."""
        import casadi

        _, _, unknown = self._symbols
        weights = casadi.SX.sym("w", len(self._outputs))
        total = casadi.dot(weights, casadi.vertcat(*self._outputs))
        pattern = np.array(casadi.DM(casadi.hessian(total, unknown)[0].sparsity(), 1.0))
        return np.asarray(pattern != 0.0)

    @property
    def outputs(self) -> list[Any]:
        """The expressions of the outputs (SX), of `symbols`."""
        return self._outputs

    @property
    def symbols(self) -> tuple[Any, Any, Any]:
        """The force, columns and parameters of `outputs`."""
        return self._symbols


class _Map:
    """The function over n rows, with the memory that it reads and writes."""

    def __init__(self, function: Any, n: int) -> None:
        self.mapped = function.map("rows", "serial", max(n, 1), [2], []) if n != 1 else function
        rows = max(n, 1)
        sizes = [function.size1_in(i) for i in range(3)]
        self.given = [
            np.zeros((rows, sizes[0])),
            np.zeros((rows, max(sizes[1], 1))),
            np.zeros(max(sizes[2], 1)),
        ]
        self.result = np.zeros((rows, function.size1_out(0)))
        self.buffer, self.run = self.mapped.buffer()
        for i, array in enumerate(self.given):
            self.buffer.set_arg(i, array.data)
        self.buffer.set_res(0, self.result.data)
        self.last: Array | None = None

    def call(self, force: Array, columns: Array, parameters: Array) -> Array:
        """Return what the function gives, one column a row of readings."""
        given = (force, columns, parameters)
        if not len(force):
            return np.zeros((self.result.shape[1], 0))
        same = self.last is not None
        for held, new in zip(self.given, given, strict=True):
            if new.size and not (same and (held == new).all()):
                held[...] = new
                same = False
        if not same or self.last is None:
            self.run()
            self.last = np.ascontiguousarray(self.result.T)
            self.last.flags.writeable = False
        return self.last


def _split(found: Array, parts: Sequence[slice]) -> Values:
    """Return the rows of (1) by what they are; positions run fastest in memory."""
    m = len(parts)
    slopes, by_force = found[m : -3 * m], found[-3 * m :].reshape(m, 3, -1)
    return Values(found[:m].T, tuple(slopes[own].T for own in parts), by_force.transpose(2, 0, 1))


def _symbols(columns: int, count: int) -> tuple[Any, Any, Any]:
    import casadi

    return casadi.SX.sym("f", 3), casadi.SX.sym("e", max(columns, 1)), casadi.SX.sym("p", count)


def _expressions(
    programs: tuple[Program, ...],
    places: tuple[tuple[int, ...], ...],
    symbols: tuple[Any, Any, Any],
) -> list[Any]:
    import casadi

    force, surroundings, unknown = symbols
    return [
        casadi.SX(read_instructions(program, (force, surroundings, unknown[list(own)])))
        for program, own in zip(programs, places, strict=True)
    ]


def _with_slopes(
    outputs: list[Any], places: tuple[tuple[int, ...], ...], symbols: tuple[Any, Any, Any]
) -> Any:
    """Return (1) as one CasADi function with one column."""
    import casadi

    force, surroundings, unknown = symbols
    parts = list(outputs)
    for y, own in zip(outputs, places, strict=True):
        parts.append(casadi.jacobian(y, unknown)[:, list(own)].T)
    parts += [casadi.jacobian(y, force).T for y in outputs]
    column = casadi.densify(casadi.vertcat(*parts))
    return casadi.Function("model", [force, surroundings, unknown], [column], {"cse": True})


def _second_derivatives(outputs: list[Any], symbols: tuple[Any, Any, Any]) -> Any:
    import casadi

    force, surroundings, unknown = symbols
    parts = [casadi.vec(casadi.hessian(y, unknown)[0]) for y in outputs]
    column = casadi.densify(casadi.vertcat(*parts))
    return casadi.Function("bends", [force, surroundings, unknown], [column], {"cse": True})
