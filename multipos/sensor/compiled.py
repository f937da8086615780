"""A model's compiled functions: the outputs, and how they change with parameters and force.

The instructions of all outputs (`multipos.sensor.instructions`) become CasADi functions

    (f, e, p)  ->  (y, dy/dp),  dy/df,  d²y/dp²,        f (3,) [g], e columns, p (p,)       (1)

with exact derivatives, each made when it is first asked for and evaluated on all rows of readings
at once (`multipos.sensor.row_functions`); of dy/dp only the parameters that an output has.
Functions are kept by their content.
"""

from functools import cached_property, lru_cache
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.numerics.arrays import Array
from multipos.sensor.instructions import Instruction, read_instructions
from multipos.sensor.row_functions import RowFunction

Program = tuple[Instruction, ...]


class Values(NamedTuple):
    """The outputs (n, M), and of each output dy/dp (n, p_i)."""

    outputs: Array
    slopes: tuple[Array, ...]


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

    def evaluate(self, force: Array, columns: Array, parameters: Array) -> Values:
        """Return the values at n rows, positions running fastest in memory.

        Parameters
        ----------
        force : (n, 3) array [g]
        columns : (n, E) array
        parameters : (p,) array
        """
        found = self._values(force, columns, parameters)
        slopes = found[len(self._outputs) :]
        return Values(found[: len(self._outputs)].T, tuple(slopes[own].T for own in self._slopes))

    def predict(self, force: Array, columns: Array, parameters: Array) -> Array:
        """Return the outputs (n, M) alone, of the same arguments."""
        return self._predicted(force, columns, parameters).T

    def by_force(self, force: Array, columns: Array, parameters: Array) -> Array:
        """Return dy/df (n, M, 3), of the same arguments."""
        found = self._by_force(force, columns, parameters)
        return found.reshape(len(self._outputs), 3, len(force)).transpose(2, 0, 1)

    def bends(self, force: Array, columns: Array, parameters: Array) -> Array:
        """Return the second derivatives d²y/dp² (n, M, p, p), of the same arguments."""
        p = len(parameters)
        found = self._bends(force, columns, parameters)
        return found.T.reshape(len(force), len(self._outputs), p, p)

    @cached_property
    def _values(self) -> RowFunction:
        import casadi

        _, _, unknown = self._symbols
        slopes = [
            casadi.jacobian(y, unknown)[:, list(own)].T
            for y, own in zip(self._outputs, self._places, strict=True)
        ]
        return self._over_rows([*self._outputs, *slopes])

    @cached_property
    def _predicted(self) -> RowFunction:
        return self._over_rows(self._outputs)

    @cached_property
    def _by_force(self) -> RowFunction:
        import casadi

        force, _, _ = self._symbols
        return self._over_rows([casadi.jacobian(y, force).T for y in self._outputs])

    @cached_property
    def _bends(self) -> RowFunction:
        import casadi

        _, _, unknown = self._symbols
        return self._over_rows([casadi.vec(casadi.hessian(y, unknown)[0]) for y in self._outputs])

    def _over_rows(self, parts: list[Any]) -> RowFunction:
        """Return expressions, one below the other, as a function of rows."""
        import casadi

        column = casadi.densify(casadi.vertcat(*parts))
        return RowFunction(casadi.Function("rows", list(self._symbols), [column], {"cse": True}))

    @cached_property
    def curved(self) -> NDArray[np.bool_]:
        """Which pairs of parameters d²y/dp² can be other than zero for, (p, p)."""
        import casadi

        _, _, unknown = self._symbols
        weights = casadi.SX.sym("w", len(self._outputs))
        total = casadi.dot(weights, casadi.vertcat(*self._outputs))
        pattern = np.array(casadi.DM(casadi.hessian(total, unknown)[0].sparsity(), 1.0))
        return np.asarray(pattern != 0.0)

    @cached_property
    def linear(self) -> NDArray[np.bool_]:
        """Which parameters enter linearly together, (p,): as many as can."""
        curved = self.curved
        chosen: list[int] = []
        for place in np.argsort(curved.sum(axis=1), kind="stable").tolist():
            if not curved[place, place] and not curved[place, chosen].any():
                chosen.append(place)
        return np.isin(np.arange(len(curved)), chosen)

    @property
    def outputs(self) -> list[Any]:
        """The expressions of the outputs (SX), of `symbols`."""
        return self._outputs

    @property
    def symbols(self) -> tuple[Any, Any, Any]:
        """The force, columns and parameters of `outputs`."""
        return self._symbols


def _symbols(columns: int, count: int) -> tuple[Any, Any, Any]:
    import casadi

    return casadi.SX.sym("f", 3), casadi.SX.sym("e", columns), casadi.SX.sym("p", count)


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
