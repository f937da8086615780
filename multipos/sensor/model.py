"""The measurement equation: the terms of each output, and the names and units of its parameters.

`build_model` makes a `Model` of a name or a formula and of outputs; `default_axes` gives them the
case axes that they sense, `stated_facing` which way they face, `check_axes` refuses what does not
fit. `parameter_name` is what a parameter is called in files and commands, `parameter_label` in
reports, `paper_symbol` in the six-position paper. What kind a model is nobody asks: a `Model`
answers what estimation, findings and files need of it, and a user-defined one
(`multipos.sensor.expressions`) answers the same.

Each output i is a sum of coefficients times terms of the reference f (components x, y, z in g)
and of other columns of the readings,

    y_i = sum_t Theta_it phi_t(f, e),                                                       (1)

where the terms phi are those of `multipos.numerics.terms`. The six-position paper's model is, per
output, ``1 + x + y + z + own^2``, its eq. (1), with `own` the component along the output's own
axis.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import field as declared
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import UsageError
from multipos.files.records import LONGEST
from multipos.files.spelling import Names, listed, near, split_names
from multipos.numerics.arrays import COMPONENTS, Array, Environment, Mask, Places
from multipos.numerics.factors import MODULUS, Factor, function_forms
from multipos.numerics.terms import (
    CONSTANT,
    NAMED,
    Term,
    expand_others,
    linear_term,
    parse_term,
    sees_only,
    split_terms,
)
from multipos.positions.headers import axes_by_name
from multipos.results import frozen
from multipos.sensor.gravity import GRAVITY, Field
from multipos.sensor.model_text import StatedParameter
from multipos.sensor.stated_parameters import StatedModel
from multipos.units import unit_per

DRIFT = "drift"  # the column and term of a session's drift
_DRIFT = parse_term(DRIFT, DRIFT, COMPONENTS[0])
_LINEAR = tuple(Factor(axis, 1) for axis in COMPONENTS)
# What a power of one component, and a function of it, is called: of an output's own, of another.
_ALONG_OWN = {(1, ""): "scale", (2, ""): "quad", (3, ""): "cubic", (1, MODULUS): "odd"}
_ACROSS = {(1, ""): "cross", (2, ""): "square"}


def parameter_name(output: str, axis: str, term: Term) -> str:
    """Return the name of a parameter, as INTERFACE lists them: bias_ax, scale_ax, cross_ax_y."""
    if not term.factors:
        return f"bias_{output}"
    if len(term.factors) == 1:
        named = _of_one_factor(output, axis, term.factors[0])
        if named:
            return named
    if len(term.factors) == 2 and all(factor in _LINEAR for factor in term.factors):
        return f"product_{output}_{''.join(factor.variable for factor in term.factors)}"
    return f"{term}_{output}"


def _of_one_factor(output: str, axis: str, factor: Factor) -> str:
    """Return the name of a power of one component, '' where it has none of its own."""
    form = (factor.power, factor.function)
    if factor.variable == axis and form in _ALONG_OWN:
        return f"{_ALONG_OWN[form]}_{output}"
    if factor.variable in COMPONENTS and factor.variable != axis and form in _ACROSS:
        return f"{_ACROSS[form]}_{output}_{factor.variable}"
    return ""


def parameter_label(output: str, axis: str, term: Term, field: Field = GRAVITY) -> str:
    """Return a parameter in plain words, for reports."""
    name = parameter_name(output, axis, term)
    kind = name.partition("_")[0]
    words = {
        "bias": f"output of {output} at zero specific force",
        "scale": f"scale factor of {output} along {axis}",
        "cross": f"sensitivity of {output} to force along {term}",
        "quad": f"second-order coefficient of {output} along {axis}",
        "cubic": f"third-order coefficient of {output} along {axis}",
        "odd": f"odd second-order coefficient of {output} along {axis}",
        "product": f"cross-coupling of {output} with {term}",
        "square": f"sensitivity of {output} to {term}",
    }
    return field.worded(words.get(kind, f"coefficient of {term} in {output}"))


Block = tuple[Places, Array]  # places in the parameter vector, and dy/dp (n, p_i)

Gauge = Literal["lower", "symmetric"]
GAUGES: tuple[Gauge, ...] = get_args(Gauge)
RollGauge = Literal["roll-x", "roll-y", "roll-z"]  # only the rotation about that axis is free
ROLL_GAUGES: tuple[RollGauge, ...] = get_args(RollGauge)


@frozen(eq=True)
class Model(StatedModel):
    """The terms of each output, with the names and units of the parameters.

    Attributes
    ----------
    text : str
        The name or formula it was built from.
    outputs, axes : tuples of M str
        Outputs, and the case axis each one is meant to sense.
    inputs : tuple of str
        Reference components the model sees.
    unit : str
        Unit of the readings.
    terms : tuple of M tuples of Term
    gauge : str or None
        'lower' or 'symmetric' where the orientation of the case is a convention (see
        `multipos.estimation.likelihood`), which fixes the upper triangle of the linear terms.
    drift_per : str or None
        'h' or 'row' where a drift of the session is among the terms, which is no part of the
        sensor: zero in the middle of the session, and wherever readings are compensated.
    drift_tau : (float, float) or None
        Time constant [s, or rows] of a drift exp(−t/τ), t from the first row, and its standard
        uncertainty; None where it is a line. Biases are then those of the settled sensor.
    field : Field
        What the outputs sense; its unit is that of the reference.

    Examples
    --------
    >>> import multipos as mp
    >>> model = mp.demo().calibration.model
    >>> model.text, model.axes, len(model.names)
    ('own-quadratic', ('x', 'y', 'z'), 15)
    """

    text: str
    outputs: tuple[str, ...]
    axes: tuple[str, ...]
    inputs: tuple[str, ...]
    unit: str
    terms: tuple[tuple[Term, ...], ...]
    gauge: Gauge | RollGauge | None = None
    drift_per: Literal["h", "row"] | None = declared(default=None, kw_only=True)
    drift_tau: tuple[float, float] | None = declared(default=None, kw_only=True)
    field: Field = declared(default=GRAVITY, kw_only=True)

    @property
    def own_formulas(self) -> Mapping[str, Any] | None:
        """What a file needs to build a user-defined model again; None of any other."""
        return None

    @cached_property
    def keys(self) -> tuple[tuple[str, Term], ...]:
        """(output, term) of each parameter, outputs in order."""
        return tuple(
            (output, term)
            for output, terms in zip(self.outputs, self.terms, strict=True)
            for term in terms
        )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Parameter names such as ``bias_ax``, ``cross_ax_y``."""
        return tuple(
            parameter_name(output, axis, term)
            for output, axis, terms in zip(self.outputs, self.axes, self.terms, strict=True)
            for term in terms
        )

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Parameter units such as ``V/g``."""
        drift = self.unit if self.drift_tau else f"{self.unit}/{self.drift_per}"
        return tuple(
            drift
            if self.drift_per is not None and term == _DRIFT
            else unit_per(self.unit, term.force_degree, term.environment, self.field.unit)
            for _, term in self.keys
        )

    @property
    def drift(self) -> dict[str, Any] | None:
        """The drift of the session as a file has it: its kind, and the time constant."""
        if self.drift_tau is None:
            return None if self.drift_per is None else {"kind": "linear", "tau": None}
        unit = "s" if self.drift_per == "h" else "row"
        tau = dict(zip(("value", "u"), self.drift_tau, strict=True)) | {"unit": unit}
        return {"kind": "exponential", "tau": tau}

    @property
    def equation(self) -> str:
        """What each output reads, as a report says it above the table of parameters."""
        return (
            "The model of output i is y_i = sum of coefficients times terms of the reference "
            "in g; the terms of each output are in the table."
        )

    @cached_property
    def sensed_axes(self) -> tuple[int, ...]:
        """Case axes that at least one output has as its own, in the order x, y, z."""
        return tuple(i for i, axis in enumerate(COMPONENTS) if axis in self.axes)

    @cached_property
    def unseen_axes(self) -> tuple[int, ...]:
        """Case axes that no output has as its own."""
        return tuple(i for i, axis in enumerate(COMPONENTS) if axis not in self.axes)

    @cached_property
    def output_of(self) -> Places:
        """The output of each parameter (p,), M for what outputs share."""
        places = {output: i for i, output in enumerate(self.outputs)}
        last = len(self.outputs)
        return np.array([places.get(output, last) for output, _ in self.keys], dtype=np.intp)

    def per_parameter(self, values: Array, shared: ArrayLike = np.nan) -> Array:
        """Return one value an output (…, M) as one a parameter (…, p), `shared` where shared."""
        last = np.broadcast_to(shared, (*values.shape[:-1], 1))
        return np.concatenate([values, last], axis=-1).take(self.output_of, axis=-1)

    @cached_property
    def own_scales(self) -> tuple[int, ...]:
        """Where the own-axis scale factors stand in the parameter vector."""
        axes = dict(zip(self.outputs, self.axes, strict=True))
        return tuple(i for i, (output, term) in enumerate(self.keys) if str(term) == axes[output])

    @cached_property
    def scaled(self) -> tuple[list[int], list[int]]:
        """Where linear terms stand, and the own-axis scale factor of the output of each."""
        own = {self.keys[i][0]: i for i in self.own_scales}
        places = enumerate(self.keys)
        linear = [i for i, (output, term) in places if term.along is not None and output in own]
        return linear, [own[self.keys[i][0]] for i in linear]

    @cached_property
    def force_degrees(self) -> Places:
        """Degree in specific force of each parameter's term, (p,)."""
        return np.array([term.force_degree for _, term in self.keys], dtype=np.intp)

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Where each output's parameters stand in the parameter vector."""
        ends = np.cumsum([len(terms) for terms in self.terms]).tolist()
        return tuple(
            slice(end - len(terms), end) for end, terms in zip(ends, self.terms, strict=True)
        )

    @cached_property
    def places(self) -> tuple[Places, ...]:
        """Where the parameters of each output stand, those that it shares last."""
        return tuple(np.arange(part.start, part.stop) for part in self.slices)

    @cached_property
    def basis_terms(self) -> tuple[Term, ...]:
        """The different terms of all outputs, phi of eq. (1)."""
        return tuple(dict.fromkeys(term for terms in self.terms for term in terms))

    @cached_property
    def environment(self) -> tuple[str, ...]:
        """Columns other than the reference that the terms use."""
        names = dict.fromkeys(name for term in self.basis_terms for name, _ in term.environment)
        return tuple(name for name in names if name not in self.of_session)

    @property
    def of_session(self) -> tuple[str, ...]:
        """Columns of the session, that compensation goes without."""
        return () if self.drift_per is None else (DRIFT,)

    @property
    def fitted_columns(self) -> tuple[str, ...]:
        """Columns beside the reference that a fit takes from the readings."""
        return *self.environment, *self.of_session

    @cached_property
    def columns(self) -> tuple[Places, ...]:
        """For each output, where its terms stand in `basis_terms`."""
        index = {term: column for column, term in enumerate(self.basis_terms)}
        return tuple(np.array([index[t] for t in terms], dtype=np.intp) for terms in self.terms)

    @cached_property
    def contributions(self) -> tuple[tuple[Places, Places], ...]:
        """For each output, the basis terms it is made of and the parameters that multiply them."""
        result = []
        for output, (part, columns) in enumerate(zip(self.slices, self.columns, strict=True)):
            extra = [(c, source) for target, c, source in self.mirrored if target == output]
            terms = [*columns.tolist(), *(c for c, _ in extra)]
            places = [*range(part.start, part.stop), *(source for _, source in extra)]
            result.append((np.array(terms, dtype=np.intp), np.array(places, dtype=np.intp)))
        return tuple(result)

    def variables(self, force: Array, environment: Environment) -> dict[str, Any]:
        """Return the components by name, from force (n, 3) [g] and other columns."""
        missing = [name for name in self.environment if name not in environment]
        if missing:
            raise UsageError(
                f"the model needs column '{missing[0]}', which the data do not have; add it."
            )
        values: dict[str, Any] = {axis: force[:, i] for i, axis in enumerate(COMPONENTS)}
        for name in self.environment:
            values[name] = np.asarray(environment[name], dtype=np.float64)
        for name in self.of_session:
            values[name] = np.asarray(environment.get(name, 0.0), dtype=np.float64)
        return values

    def basis(self, force: Array, environment: Environment) -> Array:
        """Return phi (n, T) at force (n, 3) [g]."""
        variables = self.variables(force, environment)
        phi = np.empty((len(self.basis_terms), len(force)))  # positions run fastest in memory
        for column, term in enumerate(self.basis_terms):
            phi[column] = term.evaluate(variables)
        return phi.T

    def coefficients(self, parameters: Array) -> Array:
        """Return Theta (…, M, T) of eq. (1) of parameters (…, p).

        A symmetric gauge mirrors its lower triangle.
        """
        outputs, columns, copies = self.rows
        theta = np.zeros((*parameters.shape[:-1], len(self.outputs), len(self.basis_terms)))
        theta[..., outputs, columns] = parameters
        for parameter, output, column in copies:
            theta[..., output, column] = parameters[..., parameter]
        return theta

    def respond(
        self, parameters: Array, force: Array, environment: Environment
    ) -> tuple[Array, tuple[Block, ...]]:
        """Return the outputs (n, M), and per output its parameters with dy/dp (n, p_i).

        Of parameters (B, p) the positions are those of B units, one after the other.
        """
        phi = self.basis(force, environment)
        blocks = tuple(
            (places, phi.T.take(columns, axis=0).T) for columns, places in self.contributions
        )
        theta = self.coefficients(parameters)
        of_units = phi.T.reshape(theta.shape[-1], *theta.shape[:-2], -1)
        outputs = theta @ of_units.swapaxes(0, -2)
        return outputs.swapaxes(0, -2).reshape(theta.shape[-2], -1).T, blocks

    def force_jacobian(self, parameters: Array, force: Array, environment: Environment) -> Array:
        """Return dy/df (n, M, 3) at force (n, 3) [g], of B units as in `respond`."""
        theta = self.coefficients(np.atleast_2d(parameters))
        slopes = self.force_slopes(theta, force.T.reshape(3, len(theta), -1), environment)
        return slopes.reshape(*slopes.shape[:2], -1).transpose(2, 0, 1)

    def force_slopes(self, coefficients: Array, force: Array, environment: Environment) -> Array:
        """Return dy/df (M, 3, B, n) of B units with coefficients (B, M, T) at force (3, B, n) [g].

        The environment is (n,) of every unit, or (B n,).
        """
        _, count, n = force.shape
        environment = {name: np.resize(column, count * n) for name, column in environment.items()}
        result = np.empty((len(self.outputs), 3, count, n))  # positions run fastest in memory
        result[:] = (coefficients @ self.constant_slopes).transpose(1, 2, 0)[..., None]
        if not self.varying_slopes:
            return result
        variables = self.variables(force.reshape(3, -1).T, environment)
        used: list[list[bool]] = (coefficients != 0.0).any(axis=0).T.tolist()
        for column, axis, factor, lower in self.varying_slopes:
            if lower is None:
                slope = self.basis_terms[column].derivative(variables, COMPONENTS[axis])
            else:
                slope = factor * np.asarray(lower.evaluate(variables), dtype=np.float64)
            slope = slope.reshape(count, n) if np.ndim(slope) else slope
            for output, present in enumerate(used[column]):
                if present:
                    result[output, axis] += coefficients[:, output, column, None] * slope
        return result

    @cached_property
    def constant_slopes(self) -> Array:
        """Derivatives of the basis terms by the force where they are constant (T, 3), else 0."""
        result = np.zeros((len(self.basis_terms), 3))
        for column, axis, factor, lower in self.slopes:
            if lower is not None and not lower.factors:
                result[column, axis] += factor
        return result

    @cached_property
    def varying_slopes(self) -> tuple[tuple[int, int, int, Term | None], ...]:
        """Those of `slopes` that are not constant."""
        return tuple(each for each in self.slopes if each[3] is None or each[3].factors)

    @cached_property
    def slopes(self) -> tuple[tuple[int, int, int, Term | None], ...]:
        """Derivatives of the basis terms by the force: term, component, number times lower term.

        None stands for a function alone, whose derivative is no term.
        """
        return tuple(
            (
                column,
                COMPONENTS.index(factor.variable),
                factor.degree,
                term.lowered(factor) if factor.power else None,
            )
            for column, term in enumerate(self.basis_terms)
            for factor in term.factors
            if factor.variable in COMPONENTS
        )

    @cached_property
    def rows(self) -> tuple[Places, Places, tuple[tuple[int, int, int], ...]]:
        """For each parameter its output and basis term, and what a gauge copies as in `mirrored`.

        The copies are (parameter, output, basis term).
        """
        outputs = np.repeat(np.arange(len(self.outputs)), [len(terms) for terms in self.terms])
        copies = tuple((source, target, column) for target, column, source in self.mirrored)
        return outputs, np.concatenate(self.columns), copies

    def predict(self, parameters: Array, force: Array, environment: Environment) -> Array:
        """Return the outputs (n, M) at force (n, 3) [g]."""
        return self.basis(force, environment) @ self.coefficients(parameters).T

    @cached_property
    def is_linear(self) -> bool:
        """Whether the outputs are linear in the force, with constant coefficients."""
        bare = {CONSTANT, *(linear_term(axis) for axis in COMPONENTS)}
        return all(term in bare for term in self.basis_terms)

    @cached_property
    def has_all_linear(self) -> bool:
        """Whether every output has its own bias and scale factor, so that it can be described."""
        return all(
            CONSTANT in terms and linear_term(axis) in terms
            for axis, terms in zip(self.axes, self.terms, strict=True)
        )

    def linear_map(self, environment: Mapping[str, float]) -> Array:
        """Return how bias and linear coefficients are made of the parameters, (M, 4, p).

        ``linear_map(e) @ parameters`` holds per output the constant and the coefficients of x, y
        and z, each summed over its terms in the environment at the values given.
        """
        places, others = self.linear_terms
        result = np.zeros((len(self.outputs), 4, len(self.keys)))
        values = {DRIFT: 0.0, **environment}
        result[places] = [other.evaluate(values) for other in others]
        return result

    @cached_property
    def linear_terms(self) -> tuple[tuple[Places, ...], tuple[Term, ...]]:
        """Where in `linear_map` there is something, and the term of the environment that it is."""
        places, others = [], []
        for output, (columns, parameters) in enumerate(self.contributions):
            for column, parameter in zip(columns.tolist(), parameters.tolist(), strict=True):
                term = self.basis_terms[column]
                force = [f for f in term.factors if f.variable in COMPONENTS]
                if not force or term.along is not None:
                    axis = 1 + COMPONENTS.index(force[0].variable) if force else 0
                    places.append((output, axis, parameter))
                    others.append(Term(tuple(f for f in term.factors if f not in force)))
        return tuple(np.array(places, dtype=np.intp).reshape(-1, 3).T), tuple(others)

    @property
    def has_terms(self) -> bool:
        """Whether parameters are coefficients of the terms of eq. (1), to be tested one by one."""
        return True

    @property
    def linear(self) -> Mask:
        """Which parameters enter linearly together (p,)."""
        return np.ones(len(self.keys), dtype=bool)

    @property
    def all_linear(self) -> bool:
        """Whether each output is linear in its parameters, and nothing more is said of them."""
        return True

    @property
    def shares_parameters(self) -> bool:
        """Whether outputs have parameters in common."""
        return bool((self.output_of == len(self.outputs)).any())

    @property
    def ties_outputs(self) -> bool:
        """Whether shared parameters or priors forbid to fit output by output."""
        return self.shares_parameters or bool(self.beliefs.any())

    @property
    def apart(self) -> bool:
        """Whether nothing but readings says anything of parameters, of each output its own."""
        return not (self.bounded or self.ties_outputs)

    @cached_property
    def quantities(self) -> tuple[StatedParameter, ...]:
        """What is stated of each parameter: nothing where they are coefficients of terms."""
        return tuple(map(StatedParameter, self.names))

    def second_derivatives(
        self, parameters: Array, force: Array, environment: Environment
    ) -> Array:
        """Return d²y/dp² (n, M, p, p)."""
        p = len(parameters)
        return np.zeros((len(force), len(self.outputs), p, p))

    def own_slopes(
        self, parameters: Array, force: Array, environment: Environment
    ) -> dict[str, float]:
        """Return the mean slope along its own axis of each output that has a scale factor."""
        return {self.keys[i][0]: float(parameters[i]) for i in self.own_scales}

    def label(self, index: int) -> str:
        """Return a parameter in plain words, for reports."""
        output, term = self.keys[index]
        return parameter_label(output, self.axes[self.outputs.index(output)], term, self.field)

    def linear_part(self, parameters: Array, environment: Mapping[str, float]) -> Array:
        """Return the constant and the coefficients of x, y and z (M, 4) of each output."""
        result: Array = self.linear_map(environment) @ parameters
        return result

    def only(self, output: str) -> "Model":
        """Return the model of one output alone."""
        i = self.outputs.index(output)
        return replace(self, outputs=(output,), axes=(self.axes[i],), terms=(self.terms[i],))

    def with_drift(
        self, per: Literal["h", "row"], tau: tuple[float, float] | None = None
    ) -> "Model":
        """Return the model with a drift of the session, of every output."""
        terms = tuple((*own, _DRIFT) for own in self.terms)
        return replace(self, terms=terms, drift_per=per, drift_tau=tau)

    def without_drift(self) -> "Model":
        """Return the model of the sensor alone."""
        terms = tuple(tuple(term for term in own if term != _DRIFT) for own in self.terms)
        return replace(self, terms=terms, drift_per=None, drift_tau=None)

    def with_gauge(self, gauge: Gauge | RollGauge) -> "Model":
        """Return the model without the linear terms that a gauge fixes: the upper triangle.

        Where only the rotation about one axis is free, that is the one term that joins the two
        others. Terms such as ``temperature*y`` go with ``y``: a rotation may change with
        temperature.
        """
        return self._gauged[gauge] if gauge in GAUGES else self._fixed_by(gauge)

    @cached_property
    def _gauged(self) -> dict[str, "Model"]:
        """The model under each gauge, kept as what they derive is."""
        return {gauge: self._fixed_by(gauge) for gauge in GAUGES}

    def _fixed_by(self, gauge: Gauge | RollGauge) -> "Model":
        fixed = {axis: self.axes[i + 1 :] for i, axis in enumerate(self.axes)}
        if gauge in ROLL_GAUGES:
            free = [axis for axis in self.axes if axis != gauge.removeprefix("roll-")]
            fixed = {free[0]: tuple(free[1:])}
        terms = tuple(
            tuple(term for term in own if term.along not in fixed.get(axis, ()))
            for axis, own in zip(self.axes, self.terms, strict=True)
        )
        return replace(self, terms=terms, gauge=gauge)

    def keeping(self, keys: Sequence[tuple[str, str]]) -> "Model":
        """Return the model with only the parameters named, (output, term) each."""
        terms = tuple(
            tuple(term for term in own if (output, str(term)) in keys)
            for output, own in zip(self.outputs, self.terms, strict=True)
        )
        return replace(self, terms=terms)

    def named(self, name: str) -> int:
        """Return the place of a parameter by its name, such as ``scale_ax``."""
        if name not in self.names:
            raise KeyError(
                f"no parameter '{name}'{near(name, self.names)} The model has "
                f"{', '.join(self.names)}."
            )
        return self.names.index(name)

    def index(self, output: str, term: "str | Term") -> int:
        """Return the place of a parameter by output and term."""
        try:
            known = [(name, str(own)) for name, own in self.keys]
            if (output, str(term)) not in known:  # `own^2`, or factors in another order
                axis = self.axes[self.outputs.index(output)]
                term = parse_term(str(term), str(term), axis)
            return known.index((output, str(term)))
        except ValueError:
            raise KeyError(
                f"no parameter ({output!r}, {str(term)!r}); the model has "
                + ", ".join(f"({o!r}, {str(t)!r})" for o, t in self.keys)
            ) from None

    @cached_property
    def mirrored(self) -> tuple[tuple[int, int, int], ...]:
        """Coefficients that a symmetric gauge copies: (output, basis term, parameter)."""
        if self.gauge != "symmetric":
            return ()
        mirrored = []
        for source, (output, term) in enumerate(self.keys):
            i = self.outputs.index(output)
            if term.along is None or term.along not in self.axes[:i]:
                continue
            copy = term.turned(self.axes[i])
            if copy in self.basis_terms:
                target = self.axes.index(term.along)
                mirrored.append((target, self.basis_terms.index(copy), source))
        return tuple(mirrored)


def paper_symbol(model: Model, index: int) -> str | None:
    """Return the six-position paper's symbol of a parameter (a_x0, S_ax, K_ax1 …), or None.

    The paper numbers the other axes in order (K_ax1 on y, K_ax2 on z; K_ay1 on x, K_ay2 on z;
    K_az1 on x, K_az2 on y) and the square of the own axis 3.
    """
    of_paper = model.text in ("linear", "own-quadratic") and model.field.unit == "g"
    if not of_paper or model.axes != COMPONENTS:
        return None
    output, term = model.keys[index]
    axis = model.axes[model.outputs.index(output)]
    if not term.factors:
        return f"a_{axis}0"
    factor = term.factors[0]
    if factor.variable not in COMPONENTS:
        return None
    if factor.power == 2:
        return f"K_a{axis}3"
    if factor.variable == axis:
        return f"S_a{axis}"
    others = [other for other in COMPONENTS if other != axis]
    return f"K_a{axis}{others.index(factor.variable) + 1}"


@lru_cache(maxsize=64)
def build_model(
    text: str,
    outputs: tuple[str, ...],
    axes: tuple[str, ...],
    inputs: tuple[str, ...] = COMPONENTS,
    unit: str = "reading",
    known: tuple[str, ...] | None = None,
) -> Model:
    """Return a model from its name or formula.

    Parameters
    ----------
    text : str
        A name of `NAMED`, or a formula over x, y, z, own, |own|, other and other columns.
    outputs, axes, inputs : tuples of str
        See `Model`.
    unit : str
        Unit of the readings.
    known : tuple of str, optional
        Columns that a formula may use beside the components.

    Raises
    ------
    UsageError
        Unknown model or column, a formula that cannot be parsed, axes that are not x, y, z.
    """
    check_axes(outputs, axes, inputs)
    name = " ".join(text.split())  # what is said of it stands on one line
    if len(name) > LONGEST:
        raise UsageError(
            f"the formula has {len(name)} characters, and the file of a calibration holds at most "
            f"{LONGEST}; write every term once."
        )
    formula = NAMED.get(name, name)
    words = (*NAMED, *COMPONENTS, "1", "own", "other", *(known or ()))
    if re.fullmatch(r"[\w-]+", name) and name not in words:
        raise UsageError(
            f"unknown model '{name}'; give {', '.join(NAMED)} "
            "or a formula such as '1 + x + y + z + own^2'."
        )
    terms = tuple(_seen_terms(formula, text, axis, inputs) for axis in axes)
    model = Model(name, outputs, axes, inputs, unit, terms)
    if known is not None:
        _check_columns(model, set(known), text)
    return model


def _seen_terms(formula: str, text: str, axis: str, inputs: tuple[str, ...]) -> tuple[Term, ...]:
    """Return the terms of an output that its inputs let act; a name leaves the others out."""
    parts = expand_others(split_terms(formula, text), axis, inputs)
    if not parts:
        raise UsageError(
            f"model '{text}': there is no other component than {axis} among --inputs "
            f"{','.join(inputs)}; drop the term or name the input."
        )
    parsed = dict.fromkeys(parse_term(part, text, axis) for part in parts)
    seen = tuple(term for term in parsed if sees_only(term, inputs))
    if len(seen) < len(parsed) and text.strip() not in NAMED:
        hidden = next(str(term) for term in parsed if term not in seen)
        raise UsageError(
            f"term '{hidden}' of the formula needs a component that is not among "
            f"--inputs {','.join(inputs)}; drop the term or name the input."
        )
    return seen


def _check_columns(model: Model, columns: set[str], text: str) -> None:
    for variable in model.environment:
        if variable not in columns:
            raise UsageError(
                f"unknown term '{variable}' in model '{text}'; a term is made of x, y, z, own, "
                + ", ".join([*function_forms("own"), *sorted(columns)])
                + "."
            )


def default_axes(outputs: Sequence[str], axes: Names | None) -> tuple[str, ...]:
    """Return the case axis of each output: as given, as it names it, or x, y, z in order.

    An axis that is given may have a minus before it, which tells which way the output faces and
    is no part of what is returned (`stated_facing`).
    """
    if axes is not None:
        return tuple(axis.removeprefix("-") for axis in split_names(axes, "--axes"))
    named = axes_by_name(tuple(outputs))
    if named is not None:
        return named
    if len(outputs) > 3:
        raise UsageError(
            f"{len(outputs)} columns could be outputs: {listed(outputs, 12)}; name them with "
            "--outputs, or state with --axes which axis each one senses."
        )
    return COMPONENTS[: len(outputs)]


def stated_facing(axes: Names | None) -> tuple[str, ...] | None:
    """Return what `--axes` says, as x or -y; None where it is not given."""
    return None if axes is None else split_names(axes, "--axes")


def check_axes(outputs: tuple[str, ...], axes: tuple[str, ...], inputs: tuple[str, ...]) -> None:
    """Raise `UsageError` where axes and inputs are not components, or do not fit the outputs."""
    for option, names in (("--axes", axes), ("--inputs", inputs)):
        strange = [name for name in names if name not in COMPONENTS]
        if strange or not names:
            raise UsageError(f"{option} takes x, y and z, got '{','.join(names)}'.")
    if len(set(inputs)) < len(inputs):
        raise UsageError(f"--inputs names a component twice: {','.join(inputs)}.")
    if len(axes) != len(outputs):
        raise UsageError(
            f"--axes names {len(axes)} axes for {len(outputs)} outputs "
            f"({', '.join(outputs)}); give one axis per output."
        )
    for output, axis in zip(outputs, axes, strict=True):
        if axis not in inputs:
            raise UsageError(
                f"output '{output}' senses axis {axis}, which is not among "
                f"--inputs {','.join(inputs)}; name it there, or choose the outputs with --outputs."
            )
