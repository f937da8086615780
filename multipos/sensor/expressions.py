"""User-defined models: what a formula says that each output reads.

    y_i = h_i(f, e, p),    f the reference [g], e other columns of the readings, p parameters (1)

An `ExpressionModel` answers what every `Model` does.

Formulas come as a line of text or a file (`multipos.sensor.model_text`). Exact derivatives
(`multipos.sensor.compiled`) take them through the same likelihood as every other model, bounds and
priors through the same search (`multipos.sensor.stated_parameters`).
"""

from collections.abc import Mapping
from dataclasses import KW_ONLY, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from multipos.errors import UsageError
from multipos.numerics.arrays import COMPONENTS, Array, Environment, Mask, Places
from multipos.numerics.terms import Term
from multipos.results import frozen
from multipos.sensor.compiled import Compiled, OutputFormula, compile_model
from multipos.sensor.model import Block, Gauge, Model, RollGauge
from multipos.sensor.model_text import SHARED, ParsedModel, StatedParameter, parsed_dict
from multipos.units import unit_per


@frozen(eq=True)
class Symbol(Term):
    """A parameter of an expression, in the place of a term."""

    name: str = ""

    def __str__(self) -> str:
        return self.name


@frozen(eq=True)
class ExpressionModel(Model):
    """A model whose outputs are expressions; see `Model` for the other attributes.

    Attributes
    ----------
    parsed : ParsedModel
        The formulas as they were written.
    functions : tuple of M OutputFormula
        y(f, e, p) of eq. (1), p the output's own parameters and then those that it shares.
    columns_used : tuple of str
        Columns of the readings, e.
    shared : tuple of Symbol
        Parameters that outputs share, last among all.
    shared_by : tuple of M tuples of int
        Which of these each output uses.
    quantities : tuple of p StatedParameter
        What is known of each parameter.
    fixed : mapping of (output, name) to float
        Parameters that are held at a value, and so are none.
    """

    _: KW_ONLY
    parsed: ParsedModel
    functions: tuple[OutputFormula, ...]
    columns_used: tuple[str, ...] = ()
    shared: tuple[Symbol, ...] = ()
    shared_by: tuple[tuple[int, ...], ...] = ()
    quantities: tuple[StatedParameter, ...] = ()
    fixed: tuple[tuple[str, str, float], ...] = ()

    @cached_property
    def keys(self) -> tuple[tuple[str, Term], ...]:
        """(output, parameter) of each parameter; those that outputs share are of 'common'."""
        own = zip(self.outputs, self.terms, strict=True)
        keys: list[tuple[str, Term]] = [(output, term) for output, terms in own for term in terms]
        return (*keys, *((SHARED, symbol) for symbol in self.shared))

    @property
    def own_formulas(self) -> Mapping[str, Any]:
        """What a file needs to build it again."""
        fixed = [{"output": o, "name": n, "value": v} for o, n, v in self.fixed]
        return {**parsed_dict(self.parsed), "columns": self.columns_used, "fixed": fixed}

    @property
    def environment(self) -> tuple[str, ...]:
        """Columns other than the reference that the expressions use."""
        return self.columns_used

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Parameter names such as ``limit_ax``."""
        return tuple(
            str(term) if output == SHARED else f"{term}_{output}" for output, term in self.keys
        )

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Parameter units: as stated, known for bias and scale, else left open."""
        known = {"bias": self.unit, "scale": unit_per(self.unit, 1, (), self.field.unit)}
        return tuple(q.unit or known.get(q.name, "-") for q in self.quantities)

    @property
    def equation(self) -> str:
        """What each output reads: the formulas as they were written."""
        return (
            "Each output reads, in the reference x, y, z and that along its own axis "
            f"[{self.field.printed}]: {self.text}."
        )

    def label(self, index: int) -> str:
        """Return a parameter in plain words, for reports."""
        output, term = self.keys[index]
        return f"parameter {term} of {'all outputs' if output == SHARED else output}"

    @property
    def has_terms(self) -> bool:
        """No parameter is the coefficient of a term."""
        return False

    @property
    def own_scales(self) -> tuple[int, ...]:
        """No parameter is known to be a scale factor."""
        return ()

    def own_slopes(
        self, parameters: Array, force: Array, environment: Environment
    ) -> dict[str, float]:
        """Return the mean slope of each output along its own axis."""
        mean = self.force_jacobian(parameters, force, environment).mean(axis=0)
        along = [COMPONENTS.index(axis) for axis in self.axes]
        return dict(zip(self.outputs, mean[range(len(along)), along].tolist(), strict=True))

    @property
    def is_linear(self) -> bool:
        """Whether the outputs are linear in the force."""
        return False

    @property
    def has_all_linear(self) -> bool:
        """Whether bias and scale factor mean what they do in a polynomial."""
        return False

    @cached_property
    def places(self) -> tuple[Places, ...]:
        """Where the parameters of each output stand, those that it shares last."""
        first = len(self.keys) - len(self.shared)
        return tuple(
            np.array([*range(part.start, part.stop), *(first + i for i in used)], dtype=np.intp)
            for part, used in zip(self.slices, self.shared_by, strict=True)
        )

    @cached_property
    def compiled(self) -> Compiled:
        """The compiled functions of all outputs."""
        places = tuple(tuple(own.tolist()) for own in self.places)
        return compile_model(self.functions, places, len(self.columns_used), len(self.keys))

    def _columns(self, force: Array, environment: Environment) -> Array:
        columns = np.empty((len(force), len(self.columns_used)))
        if not self.columns_used:
            return columns
        variables = self.variables(force, environment)
        for j, name in enumerate(self.columns_used):
            columns[:, j] = variables[name]
        return columns

    def respond(
        self, parameters: Array, force: Array, environment: Environment
    ) -> tuple[Array, tuple[Block, ...]]:
        """Return the outputs (n, M), and per output its parameters with dy/dp (n, p_i)."""
        outer, slope = self.outward(parameters)[:2] if self.inner else (parameters, None)
        outputs, slopes = self.compiled.evaluate(force, self._columns(force, environment), outer)
        if slope is not None:
            slopes = tuple(s * slope[own] for s, own in zip(slopes, self.places, strict=True))
        return outputs, tuple(zip(self.places, slopes, strict=True))

    def force_jacobian(self, parameters: Array, force: Array, environment: Environment) -> Array:
        """Return dy/df (n, M, 3)."""
        outer = self.outward(parameters)[0] if self.inner else parameters
        return self.compiled.by_force(force, self._columns(force, environment), outer)

    def predict(self, parameters: Array, force: Array, environment: Environment) -> Array:
        """Return the outputs (n, M)."""
        outer = self.outward(parameters)[0] if self.inner else parameters
        return self.compiled.predict(force, self._columns(force, environment), outer)

    def second_derivatives(
        self, parameters: Array, force: Array, environment: Environment
    ) -> Array:
        """Return d²y/dp² (n, M, p, p)."""
        return self.compiled.bends(force, self._columns(force, environment), parameters)

    def linear_part(self, parameters: Array, environment: Mapping[str, float]) -> Array:
        """Return the constant and the slopes by x, y and z (M, 4) of each output, at no force."""
        force = np.zeros((1, 3))
        columns = {name: np.array([value]) for name, value in environment.items()}
        outputs = self.predict(parameters, force, columns)[0]
        return np.column_stack([outputs, self.force_jacobian(parameters, force, columns)[0]])

    @property
    def linear(self) -> Mask:
        """Which parameters enter linearly together (p,): as many as can."""
        return self.compiled.linear

    @cached_property
    def all_linear(self) -> bool:
        """Whether each output is linear in its parameters, and nothing more is said of them."""
        return self.apart and not self.compiled.curved.any()

    @cached_property
    def columns(self) -> tuple[Places, ...]:
        """For each output, where its parameters stand among the columns of all outputs."""
        return tuple(np.arange(part.start, part.stop) for part in self.slices)

    def only(self, output: str) -> "ExpressionModel":
        """Return the model of one output alone, which shares no parameter."""
        i = self.outputs.index(output)
        return replace(
            self,
            outputs=(output,),
            axes=(self.axes[i],),
            terms=(self.terms[i],),
            functions=(self.functions[i],),
            shared_by=((),),
            quantities=self.quantities[self.slices[i]],
        )

    def with_gauge(self, gauge: Gauge | RollGauge) -> "Model":
        """Refuse: `multipos.estimation.user_models` finds what fixes such a model."""
        raise UsageError(
            f"a user-defined model has no gauge '{gauge}'; what a rotation leaves free of it is "
            "held, parameter by parameter."
        )

    def with_drift(
        self, per: Literal["h", "row"], tau: tuple[float, float] | None = None
    ) -> "Model":
        """Refuse: a drift is a term."""
        raise UsageError(
            "--drift adds a term `drift` to a formula; write it into a user-defined model."
        )
