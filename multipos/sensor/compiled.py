"""Formulas as CasADi functions: the outputs, and how they change with parameters and force.

`compile_model` makes a `Compiled` of the formulas of all outputs, and keeps it by their content.

The postfix form of each formula (`multipos.sensor.formulas`) is run once with CasADi symbols, and
CasADi derives from the expressions y of all outputs

    (f, e, p)  ->  (y, dy/dp),  dy/df,  d²y/dp²,        f (3,) [g], e columns, p (p,)       (1)

each made when it is first asked for; of dy/dp only the parameters that an output has. A function
of one row becomes one of whole columns, in which CasADi does each operation on all rows of a block
at once: 18 µs for a thousand readings of three outputs, where `casadi.Function.map` takes 125. It
reads and fills NumPy's memory, since copies into its own matrices would cost 400. Blocks have
powers of two rows, so that few functions are ever made.
"""

from functools import cached_property, lru_cache, partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from multipos.numerics.arrays import Array, Mask
from multipos.sensor.formulas import CONSTANTS, Step

_BLOCK = 1024  # rows
_LEAST = 128

Source = tuple[int, int] | float  # argument and component of eq. (1), or a number


class OutputFormula(NamedTuple):
    """The steps of an output's formula, and where each of its names comes from.

    Its parameters, argument 2 of eq. (1), are counted among its own.
    """

    steps: tuple[Step, ...]
    names: tuple[tuple[str, Source], ...]


class RowFunction:
    """A CasADi function of (f, e, p) with one column of K results, over rows.

    Nothing is written that outlives a call, and calls may come from several threads at once.
    """

    def __init__(self, arguments: tuple[Any, ...], parts: list[Any]) -> None:
        import casadi

        column = casadi.densify(casadi.vertcat(*parts))
        function = casadi.Function("row", list(arguments), [column], {"cse": True})
        self._count: int = column.numel()
        self._of_rows: Any = lru_cache(maxsize=16)(partial(_over_rows, function))

    def __call__(self, force: Array, columns: Array, parameters: Array) -> Array:
        """Return the results (K, n) at n rows, which run fastest in memory.

        Parameters
        ----------
        force : (n, 3) array [g]
        columns : (n, E) array
        parameters : (p,) or (n, p) array
            Of all rows, or of each.
        """
        by_row = parameters.ndim == 2
        result = np.empty((self._count, len(force)))
        for begin in range(0, len(force), _BLOCK):
            rows = slice(begin, begin + _BLOCK)
            own = parameters[rows] if by_row else parameters[None]
            result[:, rows] = self._run([force[rows], columns[rows]], own, by_row)
        return result

    def _run(self, given: list[Array], parameters: Array, by_row: bool) -> Array:
        """Return the results (K, n) at the rows of a block, computed at the next power of two."""
        n = len(given[0])
        size = max(_LEAST, 1 << (n - 1).bit_length())
        filled = [_filled(each, size) for each in given]
        filled.append(_filled(parameters, size if by_row else 1))
        result = np.empty((self._count, size))
        buffer, run = self._of_rows(size, by_row).buffer()
        for place, each in enumerate(filled):
            buffer.set_arg(place, each.data)
        buffer.set_res(0, result.data)
        run()
        return result[:, :n]


def _filled(rows: Array, size: int) -> Array:
    """Return rows (n, k) as columns (k, size), filled up with zeros."""
    result = np.zeros((rows.shape[1], size))
    result[:, : len(rows)] = rows.T
    return result


def _over_rows(function: Any, size: int, by_row: bool) -> Any:
    """Return a function of one row as one of columns (size,), operation by operation.

    Parameters
    ----------
    function : casadi.Function
        Of (f, e, p), with one column of K results.
    size : int
    by_row : bool
        Whether each row has parameters of its own.

    Returns
    -------
    casadi.Function
        Of f (size, 3), e (size, E) and p (1, p) or (size, p), with results (size, K).
    """
    import casadi

    heights = size, size, size if by_row else 1
    symbols = [casadi.MX.sym("a", n, function.size1_in(i)) for i, n in enumerate(heights)]
    held: dict[int, Any] = {}
    results = [casadi.MX()] * function.size1_out(0)
    for k in range(function.n_instructions()):
        code = function.instruction_id(k)
        read, written = function.instruction_input(k), function.instruction_output(k)
        if code == casadi.OP_OUTPUT:
            results[written[1]] = held[read[0]]
        elif code == casadi.OP_INPUT:
            held[written[0]] = symbols[read[0]][:, read[1]]
        elif code == casadi.OP_CONST:
            held[written[0]] = casadi.MX(function.instruction_constant(k))
        else:
            build = casadi.MX.unary if len(read) == 1 else casadi.MX.binary
            held[written[0]] = build(code, *(held[place] for place in read))
    different = {id(each): each for each in results}  # most second derivatives are one zero
    columns = {key: each * casadi.MX.ones(size, 1) for key, each in different.items()}
    whole = casadi.horzcat(*(columns[id(each)] for each in results))
    return casadi.Function("rows", symbols, [casadi.densify(whole)])


class Compiled:
    """Eq. (1) for any number of rows.

    Parameters
    ----------
    formulas : tuple of M OutputFormula
    places : tuple of M tuples of int
        Where the parameters of each stand among all.
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
        formulas: tuple[OutputFormula, ...],
        places: tuple[tuple[int, ...], ...],
        columns: int,
        count: int,
    ) -> None:
        import casadi

        sizes = {"f": 3, "e": columns, "p": count}
        force, surroundings, unknown = (casadi.SX.sym(*each) for each in sizes.items())
        self.symbols: tuple[Any, Any, Any] = (force, surroundings, unknown)
        self._places = places
        self.outputs: list[Any] = [
            _expression(formula, (force, surroundings, unknown[list(own)]))
            for formula, own in zip(formulas, places, strict=True)
        ]

    def evaluate(
        self, force: Array, columns: Array, parameters: Array
    ) -> tuple[Array, tuple[Array, ...]]:
        """Return the outputs (n, M) at n rows, and of each output dy/dp (n, p_i).

        Parameters
        ----------
        force : (n, 3) array [g]
        columns : (n, E) array
        parameters : (p,) or (n, p) array
            Of all rows, or of each.
        """
        found = self._values(force, columns, parameters)
        ends = np.cumsum([len(self.outputs), *map(len, self._places)]).tolist()
        slopes = [found[begin:end].T for begin, end in pairwise(ends)]
        return found[: len(self.outputs)].T, tuple(slopes)

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

        unknown = self.symbols[2]
        slopes = [
            casadi.jacobian(y, unknown)[:, list(own)].T
            for y, own in zip(self.outputs, self._places, strict=True)
        ]
        return RowFunction(self.symbols, [*self.outputs, *slopes])

    @cached_property
    def _predicted(self) -> RowFunction:
        return RowFunction(self.symbols, self.outputs)

    @cached_property
    def _by_force(self) -> RowFunction:
        import casadi

        force = self.symbols[0]
        return RowFunction(self.symbols, [casadi.jacobian(y, force).T for y in self.outputs])

    @cached_property
    def _bends(self) -> RowFunction:
        import casadi

        unknown = self.symbols[2]
        second = [casadi.vec(casadi.hessian(y, unknown)[0]) for y in self.outputs]
        return RowFunction(self.symbols, second)

    @cached_property
    def curved(self) -> Mask:
        """Which pairs of parameters d²y/dp² can be other than zero for, (p, p)."""
        import casadi

        unknown = self.symbols[2]
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


compile_model = lru_cache(maxsize=64)(Compiled)  # the same functions for formulas of one content


def _expression(formula: OutputFormula, arguments: tuple[Any, Any, Any]) -> Any:
    """Return the expression (SX) of a formula, of symbols f, e and the output's own p."""
    import casadi

    values: dict[str, Any] = dict(CONSTANTS)
    for name, source in formula.names:
        values[name] = arguments[source[0]][source[1]] if isinstance(source, tuple) else source
    stack: list[Any] = []
    for step in formula.steps:
        if isinstance(step, tuple):
            name, count = step
            build = casadi.SX.unary if count == 1 else casadi.SX.binary
            stack[-count:] = [build(getattr(casadi, f"OP_{name.upper()}"), *stack[-count:])]
        else:
            stack.append(casadi.SX(values[step] if isinstance(step, str) else step))
    return stack.pop()
