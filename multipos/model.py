"""The measurement equation: terms, formulas, names and units of an accelerometer's parameters.

Each output i is a sum of coefficients times terms of the reference f (components x, y, z in g)
and of other columns of the readings,

    y_i = sum_t Theta_it phi_t(f, e),                                                       (1)

where a term is a product such as ``1``, ``x``, ``x^2``, ``x*y``, ``x*|x|``, ``temperature*x``.
The six-position paper's model is, per output, ``1 + x + y + z + own^2``, its eq. (1), with `own`
the component along the output's own axis.

Terms are evaluated on components, so the same lines take NumPy arrays and CasADi symbols.
Formulas are parsed, never evaluated: `formula = term ('+' term)*`, `term = factor ('*' factor)*`,
`factor = '1' | name ['^' power] | '|' name '|' ['^' power]`.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from multipos.errors import UsageError
from multipos.files import LARGEST
from multipos.units import unit_per

Array = NDArray[np.float64]
Block = tuple[NDArray[np.intp], Array]  # places in the parameter vector, and dy/dp (n, p_i)

COMPONENTS = ("x", "y", "z")
NAMED = {
    "linear": "1 + x + y + z",
    "own-quadratic": "1 + x + y + z + own^2",
    "own-cubic": "1 + x + y + z + own^2 + own^3",
    "cross-quadratic": "1 + x + y + z + own^2 + OWN*OTHER",
    "ieee": "1 + x + y + z + own^2 + own^3 + OWN*OTHER",
    "ieee-odd": "1 + x + y + z + own^2 + own^3 + OWN*OTHER + own*|own|",
    "full-quadratic": "1 + x + y + z + x^2 + y^2 + z^2 + x*y + x*z + y*z",
}
_LARGEST_POWER = 100.0  # log10 of what a term may reach: its square is a number still
HIGHEST_POWER = 9  # beyond it a term of specific force within 1 g says nothing new


@dataclass(frozen=True, order=True)
class Factor:
    """A variable to a power, times its modulus where `modulus` is set: v^power |v|."""

    variable: str
    power: int
    modulus: bool = False

    def __str__(self) -> str:
        parts = []
        if self.power:
            parts.append(self.variable if self.power == 1 else f"{self.variable}^{self.power}")
        if self.modulus:
            parts.append(f"|{self.variable}|")
        return "*".join(parts)

    @property
    def degree(self) -> int:
        """Power, the modulus counted."""
        return self.power + self.modulus


@dataclass(frozen=True)
class Term:
    """A product of factors in alphabetical order; no factor is the constant ``1``."""

    factors: tuple[Factor, ...] = ()

    def __str__(self) -> str:
        return "*".join(map(str, self.factors)) or "1"

    @property
    def force_degree(self) -> int:
        """Degree in specific force: 0 for a bias, 1 for a scale factor, 2 for second order."""
        return sum(factor.degree for factor in self.factors if factor.variable in COMPONENTS)

    @property
    def along(self) -> str | None:
        """The component of specific force that it is proportional to, if it is to one."""
        force = [factor for factor in self.factors if factor.variable in COMPONENTS]
        if len(force) == 1 and force[0] == Factor(force[0].variable, 1):
            return force[0].variable
        return None

    def turned(self, axis: str) -> "Term":
        """Return the term that is along another axis."""
        mine = next(factor for factor in self.factors if factor.variable == self.along)
        rest = (factor for factor in self.factors if factor is not mine)
        return Term(tuple(sorted((*rest, Factor(axis, 1)))))

    @property
    def environment(self) -> tuple[tuple[str, int], ...]:
        """Other columns of the readings in the term, with their degrees."""
        return tuple((f.variable, f.degree) for f in self.factors if f.variable not in COMPONENTS)

    def evaluate(self, variables: Mapping[str, Any]) -> Any:
        """Return the term's value on components: arrays, floats or CasADi symbols."""
        value: Any = 1.0
        for factor in self.factors:
            v = variables[factor.variable]
            for _ in range(factor.power):
                value = value * v
            if factor.modulus:
                value = value * abs(v)
        return value

    def derivative(self, variables: Mapping[str, Any], by: str) -> Any:
        """Return the partial derivative by one variable: d(v^m|v|)/dv = (m+1) v^(m-1) |v|."""
        mine = next((factor for factor in self.factors if factor.variable == by), None)
        if mine is None:
            return 0.0
        rest = tuple(factor for factor in self.factors if factor is not mine)
        if not mine.power:
            return np.sign(variables[by]) * Term(rest).evaluate(variables)
        return mine.degree * self.lowered(mine).evaluate(variables)

    def lowered(self, factor: Factor) -> "Term":
        """Return the term with one power of a factor less, which has a power to lose."""
        lower = Factor(factor.variable, factor.power - 1, factor.modulus)
        others = tuple(lower if other is factor else other for other in self.factors)
        return Term(tuple(other for other in others if other.degree))


CONSTANT = Term()


def evaluate_terms(terms: Sequence[Term], columns: Mapping[str, Array], n: int) -> Array:
    """Return the design (n, q) of terms; powers by repeated multiplication, each rounded once."""
    design = np.empty((n, len(terms)))
    for column, term in enumerate(terms):
        design[:, column] = term.evaluate(columns)
    return design


def largest_value(terms: Iterable[Term], variable: str) -> float:
    """Return how large a variable may be for its powers in terms to be squared and summed."""
    factors = (factor for term in terms for factor in term.factors)
    degree = max((f.degree for f in factors if f.variable == variable), default=1)
    return min(LARGEST, math.pow(10.0, _LARGEST_POWER / degree))


def linear_term(variable: str) -> Term:
    """Return the bare variable as a term."""
    return Term((Factor(variable, 1),))


@dataclass(frozen=True)
class Model:
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
        `multipos.likelihood`), which fixes the upper triangle of the linear terms.
    """

    text: str
    outputs: tuple[str, ...]
    axes: tuple[str, ...]
    inputs: tuple[str, ...]
    unit: str
    terms: tuple[tuple[Term, ...], ...]
    gauge: str | None = None

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
        return tuple(unit_per(self.unit, t.force_degree, t.environment) for _, t in self.keys)

    @cached_property
    def own_scales(self) -> tuple[int, ...]:
        """Where the own-axis scale factors stand in the parameter vector."""
        axes = dict(zip(self.outputs, self.axes, strict=True))
        return tuple(i for i, (output, term) in enumerate(self.keys) if str(term) == axes[output])

    @cached_property
    def force_degrees(self) -> NDArray[np.intp]:
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
    def basis_terms(self) -> tuple[Term, ...]:
        """The different terms of all outputs, phi of eq. (1)."""
        return tuple(dict.fromkeys(term for terms in self.terms for term in terms))

    @cached_property
    def environment(self) -> tuple[str, ...]:
        """Columns other than the reference that the terms use."""
        return tuple(
            dict.fromkeys(name for term in self.basis_terms for name, _ in term.environment)
        )

    @cached_property
    def columns(self) -> tuple[NDArray[np.intp], ...]:
        """For each output, where its terms stand in `basis_terms`."""
        index = {term: column for column, term in enumerate(self.basis_terms)}
        return tuple(np.array([index[t] for t in terms], dtype=np.intp) for terms in self.terms)

    @cached_property
    def contributions(self) -> tuple[tuple[NDArray[np.intp], NDArray[np.intp]], ...]:
        """For each output, the basis terms it is made of and the parameters that multiply them."""
        result = []
        for output, (part, columns) in enumerate(zip(self.slices, self.columns, strict=True)):
            extra = [(c, source) for target, c, source in self.mirrored if target == output]
            terms = [*columns.tolist(), *(c for c, _ in extra)]
            places = [*range(part.start, part.stop), *(source for _, source in extra)]
            result.append((np.array(terms, dtype=np.intp), np.array(places, dtype=np.intp)))
        return tuple(result)

    def variables(self, force: Array, environment: Mapping[str, ArrayLike]) -> dict[str, Any]:
        """Return the components by name, from force (n, 3) [g] and other columns."""
        missing = [name for name in self.environment if name not in environment]
        if missing:
            raise UsageError(
                f"the model needs column '{missing[0]}', which the data do not have; add it."
            )
        values: dict[str, Any] = {axis: force[:, i] for i, axis in enumerate(COMPONENTS)}
        for name in self.environment:
            values[name] = np.asarray(environment[name], dtype=np.float64)
        return values

    def basis(self, force: Array, environment: Mapping[str, ArrayLike]) -> Array:
        """Return phi (n, T) at force (n, 3) [g]."""
        variables = self.variables(force, environment)
        phi = np.empty((len(self.basis_terms), len(force)))  # positions run fastest in memory
        for column, term in enumerate(self.basis_terms):
            phi[column] = term.evaluate(variables)
        return phi.T

    def coefficients(self, parameters: Array) -> Array:
        """Return Theta (M, T) of eq. (1); a symmetric gauge mirrors its lower triangle."""
        theta = np.zeros((len(self.outputs), len(self.basis_terms)))
        for output, (part, columns) in enumerate(zip(self.slices, self.columns, strict=True)):
            theta[output, columns] = parameters[part]
        for target, column, source in self.mirrored:
            theta[target, column] = parameters[source]
        return theta

    def respond(
        self, parameters: Array, force: Array, environment: Mapping[str, ArrayLike]
    ) -> tuple[Array, tuple[Block, ...]]:
        """Return the outputs (n, M), and per output its parameters with dy/dp (n, p_i)."""
        phi = self.basis(force, environment)
        blocks = tuple((places, phi.T[columns].T) for columns, places in self.contributions)
        return (self.coefficients(parameters) @ phi.T).T, blocks

    def force_jacobian(
        self, parameters: Array, force: Array, environment: Mapping[str, ArrayLike]
    ) -> Array:
        """Return dy/df (n, M, 3) at force (n, 3) [g]."""
        theta = self.coefficients(parameters)
        constant = np.zeros((len(self.outputs), 3))
        variables = self.variables(force, environment)
        varying = []
        for column, axis, factor, lower in self.slopes:
            if lower is None:
                slope = self.basis_terms[column].derivative(variables, COMPONENTS[axis])
            elif lower.factors:
                slope = factor * lower.evaluate(variables)
            else:
                constant[:, axis] += factor * theta[:, column]
                continue
            varying.append((axis, slope, theta[:, column].tolist()))
        result = np.empty((*constant.shape, len(force)))  # positions run fastest in memory
        result[:] = constant[:, :, None]
        for axis, slope, coefficients in varying:
            for output, coefficient in enumerate(coefficients):
                if coefficient:
                    result[output, axis] += coefficient * slope
        return result.transpose(2, 0, 1)

    @cached_property
    def slopes(self) -> tuple[tuple[int, int, int, Term | None], ...]:
        """Derivatives of the basis terms by the force: term, component, number times lower term.

        None stands for a modulus alone, whose derivative is no term.
        """
        return tuple(
            (column, COMPONENTS.index(factor.variable), factor.degree,
             term.lowered(factor) if factor.power else None)
            for column, term in enumerate(self.basis_terms)
            for factor in term.factors
            if factor.variable in COMPONENTS
        )  # fmt: skip

    @cached_property
    def rows(self) -> tuple[NDArray[np.intp], NDArray[np.intp], tuple[tuple[int, int, int], ...]]:
        """For each parameter its output and basis term, and what a gauge copies as in `mirrored`.

        The copies are (parameter, output, basis term).
        """
        outputs = np.repeat(np.arange(len(self.outputs)), [len(terms) for terms in self.terms])
        copies = tuple((source, target, column) for target, column, source in self.mirrored)
        return outputs, np.concatenate(self.columns), copies

    def predict(
        self, parameters: Array, force: Array, environment: Mapping[str, ArrayLike]
    ) -> Array:
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
        unit = np.eye(len(self.keys))
        theta = np.array([self.coefficients(row) for row in unit])  # (p, M, T)
        result = np.zeros((len(self.outputs), 4, len(unit)))
        for column, term in enumerate(self.basis_terms):
            force = tuple(f for f in term.factors if f.variable in COMPONENTS)
            if force and term.along is None:
                continue
            place = 1 + COMPONENTS.index(force[0].variable) if force else 0
            weight = Term(tuple(f for f in term.factors if f not in force)).evaluate(environment)
            result[:, place] += weight * theta[:, :, column].T
        return result

    def only(self, output: str) -> "Model":
        """Return the model of one output alone."""
        i = self.outputs.index(output)
        return replace(self, outputs=(output,), axes=(self.axes[i],), terms=(self.terms[i],))

    def with_gauge(self, gauge: str) -> "Model":
        """Return the model without the linear terms that a gauge fixes: the upper triangle.

        Terms such as ``temperature*y`` go with ``y``: a rotation may change with temperature.
        """
        terms = tuple(
            tuple(term for term in own if term.along not in self.axes[i + 1 :])
            for i, own in enumerate(self.terms)
        )
        return replace(self, terms=terms, gauge=gauge)

    def keeping(self, keys: Sequence[tuple[str, str]]) -> "Model":
        """Return the model with only the parameters named, (output, term) each."""
        terms = tuple(
            tuple(term for term in own if (output, str(term)) in keys)
            for output, own in zip(self.outputs, self.terms, strict=True)
        )
        return replace(self, terms=terms)

    def index(self, output: str, term: "str | Term") -> int:
        """Return the place of a parameter by output and term."""
        try:
            known = [(name, str(own)) for name, own in self.keys]
            if (output, str(term)) not in known:  # `own^2`, or factors in another order
                axis = self.axes[self.outputs.index(output)]
                term = _parse_term(str(term), str(term), axis)
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
        A name of `NAMED`, or a formula over x, y, z, own, |own| and other columns.
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
    _check_axes(outputs, axes, inputs)
    name = text.strip()
    formula = NAMED.get(name, name)
    words = (*NAMED, *COMPONENTS, "1", "own", *(known or ()))
    if re.fullmatch(r"[\w-]+", name) and name not in words:
        raise UsageError(
            f"unknown model '{name}'; give {', '.join(NAMED)} "
            "or a formula such as '1 + x + y + z + own^2'."
        )
    terms = []
    for axis in axes:
        parsed = dict.fromkeys(
            _parse_term(part, text, axis) for part in _split(_expand(formula, axis), text)
        )
        seen = [t for t in parsed if _sees_only(t, inputs)]
        if len(seen) < len(parsed) and name not in NAMED:
            hidden = next(str(t) for t in parsed if t not in seen)
            raise UsageError(
                f"term '{hidden}' of the formula needs a component that is not among "
                f"--inputs {','.join(inputs)}; drop the term or name the input."
            )
        terms.append(tuple(seen))
    model = Model(name, outputs, axes, inputs, unit, tuple(terms))
    if known is not None:
        columns = set(known)
        for variable in model.environment:
            if variable not in columns:
                raise UsageError(
                    f"unknown term '{variable}' in model '{text}'; a term is made of x, y, z, own, "
                    + ", ".join(["|own|", *sorted(columns)])
                    + "."
                )
    return model


def parse_terms(text: str, *, highest: int = HIGHEST_POWER) -> tuple[Term, ...]:
    """Return the terms of a formula over any columns, in order, each once.

    Raises
    ------
    UsageError
        The formula cannot be read, or a power is above `highest`.
    """
    # With 'own' for the own axis, a column of that name stays what it is.
    parts = _split(text, text)
    return tuple(dict.fromkeys(_parse_term(part, text, "own", highest) for part in parts))


def formula_columns(text: str) -> tuple[str, ...]:
    """Return the columns other than x, y, z and own that a model's text uses."""
    name = text.strip()
    if name in NAMED:
        return ()
    words = re.findall(r"[^\W\d]\w*", name)
    return tuple(dict.fromkeys(w for w in words if w not in (*COMPONENTS, "own")))


def default_axes(outputs: Sequence[str], axes: Sequence[str] | str | None) -> tuple[str, ...]:
    """Return the case axis of each output: as given, or x, y, z in order."""
    if axes is not None:
        named = axes.split(",") if isinstance(axes, str) else axes
        return tuple(axis.strip() for axis in named)
    if len(outputs) > 3:
        raise UsageError(
            f"{len(outputs)} columns could be outputs: {', '.join(outputs)}; name them with "
            "--outputs, or say with --axes which axis each one senses."
        )
    return COMPONENTS[: len(outputs)]


def parameter_name(output: str, axis: str, term: Term) -> str:
    """Return the name of a parameter, as INTERFACE lists them: bias_ax, scale_ax, cross_ax_y."""
    if not term.factors:
        return f"bias_{output}"
    if len(term.factors) == 1:
        factor = term.factors[0]
        own = factor.variable == axis
        if factor == Factor(factor.variable, 1) and factor.variable in COMPONENTS:
            return f"scale_{output}" if own else f"cross_{output}_{factor.variable}"
        if factor == Factor(factor.variable, 2) and factor.variable in COMPONENTS:
            return f"quad_{output}" if own else f"square_{output}_{factor.variable}"
        if own and factor == Factor(axis, 3):
            return f"cubic_{output}"
        if own and factor == Factor(axis, 1, modulus=True):
            return f"odd_{output}"
    pair = [f.variable for f in term.factors if f.degree == 1 and f.variable in COMPONENTS]
    if len(pair) == len(term.factors) == 2 and not any(f.modulus for f in term.factors):
        return f"product_{output}_{''.join(pair)}"
    return f"{term}_{output}"


def parameter_label(output: str, axis: str, term: Term) -> str:
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
    return words.get(kind, f"coefficient of {term} in {output}")


def paper_symbol(model: Model, index: int) -> str | None:
    """Return the six-position paper's symbol of a parameter (a_x0, S_ax, K_ax1 …), or None.

    The paper numbers the other axes in order (K_ax1 on y, K_ax2 on z; K_ay1 on x, K_ay2 on z;
    K_az1 on x, K_az2 on y) and the square of the own axis 3.
    """
    if model.text not in ("linear", "own-quadratic") or model.axes != COMPONENTS:
        return None
    output, term = model.keys[index]
    axis = model.axes[model.outputs.index(output)]
    if not term.factors:
        return f"a_{axis}0"
    factor = term.factors[0]
    if factor.power == 2:
        return f"K_a{axis}3"
    if factor.variable == axis:
        return f"S_a{axis}"
    others = [other for other in COMPONENTS if other != axis]
    return f"K_a{axis}{others.index(factor.variable) + 1}"


def _check_axes(outputs: tuple[str, ...], axes: tuple[str, ...], inputs: tuple[str, ...]) -> None:
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


def _sees_only(term: Term, inputs: tuple[str, ...]) -> bool:
    return all(f.variable in inputs for f in term.factors if f.variable in COMPONENTS)


def _expand(formula: str, axis: str) -> str:
    """Write out the products of the own component with each of the two others."""
    products = " + ".join(f"{axis}*{other}" for other in COMPONENTS if other != axis)
    return formula.replace("OWN*OTHER", products)


def _split(formula: str, text: str) -> list[str]:
    parts = [part.strip() for part in formula.split("+")]
    if any(not part for part in parts):
        raise UsageError(f"model '{text}': a term is missing beside a '+'.")
    return parts


_FACTOR = re.compile(
    r"(?:(?P<name>[^\W\d]\w*)|\|\s*(?P<modulus>[^\W\d]\w*)\s*\|)(?:\s*\^\s*(?P<power>\d+))?"
)


def _parse_term(part: str, text: str, axis: str, highest: int = HIGHEST_POWER) -> Term:
    """Parse ``x*|own|`` for the output whose own axis is given."""
    plain: dict[str, int] = {}
    modulus: dict[str, int] = {}
    refused = f"must lie between 1 and {highest}."
    for factor in part.split("*"):
        if factor.strip() == "1":
            continue
        match = _FACTOR.fullmatch(factor.strip())
        if match is None:
            raise UsageError(
                f"model '{text}': cannot read '{factor.strip() or part}'; a term is a product of "
                "1, x, y, z, own, |own| and column names, each with ^power."
            )
        digits = match["power"] or "1"
        power = int(digits) if len(digits) <= len(str(highest)) else highest + 1
        if not 1 <= power <= highest:
            raise UsageError(f"model '{text}': the power in '{factor.strip()}' {refused}")
        name = match["name"] or match["modulus"]
        counts = plain if match["name"] else modulus
        name = axis if name == "own" else name
        counts[name] = counts.get(name, 0) + power
        if counts[name] > highest:
            raise UsageError(f"model '{text}': the power of {name} in '{part.strip()}' {refused}")
    factors = []
    for name in sorted({*plain, *modulus}):
        # |v|^2 = v^2, so at most one modulus stays.
        pairs, odd = divmod(modulus.get(name, 0), 2)
        factors.append(Factor(name, plain.get(name, 0) + 2 * pairs, bool(odd)))
    return Term(tuple(factors))
