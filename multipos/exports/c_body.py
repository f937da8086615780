"""The model's inverse as lines of C.

`function_body` returns the body of the function. `needed_steps` and `counted_steps` return how many
steps it takes, over the forces of `force_grid`, and `steps_in_words` says so; `exact_inverse`
returns a matrix correctly rounded; `stepped` writes steps and `written_factors` terms; `is_linear`
tells which model takes none; `environment_range` and `slope_in_the_middle` return where a column
lies and dh/df there.

A linear model is one matrix product, f = T (raw − o). Another with as many outputs as axes is
solved by a fixed number of steps of

    f <- P (d - n(f, e)),    d = raw - o,    P = K0⁻¹,                                     (1)

where o and K0 are bias and linear coefficients in the middle of the calibrated environment and n
all the rest of the model.

Single precision subtracts a bias in two parts, the second being what the first cannot hold.

The error of (1) shrinks at least by rho, the largest norm of 1 − P dh/df over twice the calibrated
force and the calibrated environment; where rho exceeds one half nothing is written. Steps are taken
on a grid of forces up to a third beyond what was calibrated, and as many are written as bring all
of it within the tolerance: 1e-13 g, in single precision half a digit, in whole numbers half a bit.
"""

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from multipos.errors import MultiposError
from multipos.exports.c_text import Real, Statement, literal
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.numerics.factors import FUNCTIONS, Code, Factor
from multipos.numerics.terms import CONSTANT, Term, linear_term
from multipos.sensor.calibration import Calibration
from multipos.sensor.model import Model

_HEADROOM = 2.0  # times the largest calibrated force, over which rho is taken
_SLOWEST = 0.5
_REACH = 4.0 / 3.0  # times it, over which steps are counted one by one
_TOLERANCE = 1e-13  # [g], in double precision
_ROUNDING = 2.0**-48  # of the largest reading: beyond it steps gain nothing
_SINGLE = 3e-8  # of the largest calibrated force: half a digit of single precision
_GRID = 9
_MOST = 40  # steps


def environment_range(calibration: Calibration, name: str) -> tuple[float, float]:
    """Return the smallest and largest value of a column at calibration."""
    seen = calibration.readings.environment[name]
    return float(seen.min()), float(seen.max())


def slope_in_the_middle(calibration: Calibration) -> Array:
    """Return dh/df (M, 3) at no force, in the middle of the calibrated environment."""
    model = calibration.model
    middle = {n: np.array([np.mean(environment_range(calibration, n))]) for n in model.environment}
    return np.asarray(model.force_jacobian(calibration.parameters, np.zeros((1, 3)), middle)[0])


def needed_steps(calibration: Calibration, slope: Array, *, single: bool) -> tuple[int, float]:
    """Return the number of steps and rho; `slope` (M, K) is K0.

    Raises
    ------
    MultiposError
        They would not converge.
    """
    largest = float(np.linalg.norm(calibration.reference, axis=1).max())
    rho = _contraction(calibration, slope)
    if not rho <= _SLOWEST:
        raise MultiposError(
            f"the inverse of this model does not converge in fixed steps over "
            f"{_HEADROOM * largest:.3g} g (contraction {rho:.2g}, at most {_SLOWEST} is safe); "
            "drop terms whose coefficient is not significant, or use apply."
        )
    raw = np.abs(calibration.readings.values).max()
    rounding = _ROUNDING * float(raw * np.linalg.norm(np.linalg.pinv(slope), ord=2))
    tolerance = _SINGLE * largest if single else max(_TOLERANCE, rounding)
    return counted_steps(calibration, slope, tolerance), rho


def counted_steps(calibration: Calibration, slope: Array, tolerance: float) -> int:
    """Return how many steps of eq. (1) bring every force of a grid within a tolerance [g]."""
    model, parameters = calibration.model, calibration.parameters
    sensed = list(model.sensed_axes)
    force, columns = force_grid(calibration, _REACH)
    size = np.linalg.norm(force, axis=1)
    within = size <= np.abs(force).max() * (1.0 + 1e-9)
    force, columns = force[within], {name: column[within] for name, column in columns.items()}
    raw, found = model.predict(parameters, force, columns), np.zeros_like(force)
    normal = np.linalg.inv(slope.T @ slope)
    for step in range(1, _MOST):
        left = raw - model.predict(parameters, found, columns)
        found[:, sensed] += left @ slope @ normal
        if np.abs(found - force).max() <= tolerance:
            return step
    return _MOST


def force_grid(calibration: Calibration, headroom: float) -> tuple[Array, dict[str, Array]]:
    """Return forces (n, 3) [g] up to so many times the calibrated one, and columns with them."""
    model = calibration.model
    sensed = list(model.sensed_axes)
    reach = headroom * float(np.linalg.norm(calibration.reference, axis=1).max())
    line, still = np.linspace(-reach, reach, _GRID), np.zeros(1)
    axes = [line if i in sensed else still for i in range(3)]
    names = model.environment
    environment = [np.linspace(*environment_range(calibration, name), 5) for name in names]
    grid = np.array(list(itertools.product(*axes, *environment)))
    return grid[:, :3], dict(zip(names, grid[:, 3:].T, strict=True))


def _contraction(calibration: Calibration, slope: Array) -> float:
    model = calibration.model
    sensed = list(model.sensed_axes)
    grid, columns = force_grid(calibration, _HEADROOM)
    jacobian = model.force_jacobian(calibration.parameters, grid, columns)[:, :, sensed]
    try:
        moved = np.linalg.inv(slope) @ jacobian
    except np.linalg.LinAlgError:  # where no step begins, none shrinks an error
        return np.inf
    return float(np.linalg.norm(np.eye(len(sensed)) - moved, ord=2, axis=(1, 2)).max())


# Output, product of force components, and its coefficient: a number times a named constant.
_RestTerm = tuple[int, Term, tuple[float, str]]


class Body(NamedTuple):
    """Statements of a function, in words how it computes, and whether it calls the C library."""

    statements: list[Statement]
    how: str
    library: bool = False


def function_body(calibration: Calibration, *, single: bool) -> Body:
    """Return the body of the function.

    Raises
    ------
    MultiposError
        The steps of eq. (1) would not converge.
    """
    writer = _Writer(calibration, single)
    return writer.linear() if is_linear(calibration.model) else writer.polynomial()


def is_linear(model: Model) -> bool:
    """Tell whether one matrix product inverts a model."""
    bare: set[Term] = {CONSTANT, *(linear_term(axis) for axis in COMPONENTS)}
    return model.has_terms and all(term in bare for term in model.basis_terms)


def steps_in_words(steps: int, rho: float) -> str:
    """Return how a function with so many steps computes."""
    return f"{steps} steps, each shrinking the error at least {1.0 / max(rho, 1e-16):.3g} times"


def stepped(
    real: Real, unknowns: Sequence[str], steps: int, inner: list[Statement], ends: Sequence[str]
) -> list[Statement]:
    """Return the statements of so many steps from zero, and of what is given in the end."""
    zeros = ", ".join(f"{name} = {real.number(0.0)}" for name in unknowns)
    loop = (f"for (int step = 0; step < {steps}; ++step)", inner)
    return [f"{real.kind} {zeros};", loop, *(f"accel[{k}] = {end};" for k, end in enumerate(ends))]


def exact_inverse(A: Array) -> Array:
    """Return A⁻¹, or of a tall A its least-squares inverse (AᵀA)⁻¹Aᵀ, correctly rounded.

    Kernels of linear algebra differ in the last digit; a file that is verified on another machine,
    or was written in a browser, must be the same there.
    """
    exact = np.array([[Fraction(value) for value in row] for row in A.tolist()], dtype=object)
    rows = np.hstack([exact.T @ exact, exact.T])
    for i in range(len(rows)):  # a normal matrix, whose pivots are above zero unless it is singular
        if not rows[i, i]:
            raise np.linalg.LinAlgError("Singular matrix")
        rows[i] = rows[i] / rows[i, i]
        for j in range(len(rows)):
            if j != i:
                rows[j] = rows[j] - rows[j, i] * rows[i]
    return rows[:, A.shape[1] :].astype(np.float64)


class _Writer:
    """Turn the model into lines of C."""

    def __init__(self, calibration: Calibration, single: bool) -> None:
        self._calibration = calibration
        self._model = calibration.model
        self._single = single
        self._real = Real(single)
        self._sensed = [COMPONENTS[i] for i in self._model.sensed_axes]
        self._theta = self._model.coefficients(calibration.parameters)
        self._middle = {
            name: _held_by_both(float(np.mean(environment_range(calibration, name))))
            for name in self._model.environment
        }
        linear = self._model.linear_map(self._middle) @ calibration.parameters
        self._bias = linear[:, 0]
        self._slope = linear[:, [1 + i for i in self._model.sensed_axes]]
        self._inverse = exact_inverse(self._slope)

    def linear(self) -> Body:
        lines: list[Statement] = [*self._offsets()]
        for k, row in enumerate(self._inverse):
            lines.append(f"accel[{k}] = {self._total(row, 'd')};")
        return Body(lines, "one matrix product")

    def polynomial(self) -> Body:
        steps, rho = needed_steps(self._calibration, self._slope, single=self._single)
        constants, coefficients = self._coefficients()
        inner = [*self._functions(coefficients), *self._square(coefficients)]
        named = [f"const {self._real.kind} {each};" for each in self._shifts(constants) + constants]
        lines = stepped(self._real, self._sensed, steps, [*inner], self._sensed)
        return Body([*self._offsets(), *named, *lines], steps_in_words(steps, rho))

    def _total(self, weights: Array, name: str) -> str:
        """Return the sum of numbers times variables that are counted."""
        return self._real.sum((value, f"{name}{i}") for i, value in enumerate(weights))

    def _functions(self, coefficients: list[_RestTerm]) -> list[str]:
        """Name the values of the functions of each axis that stand in the terms."""
        used = [f for _, term, _ in coefficients for f in term.factors if f.function]
        lines = []
        for axis in self._sensed:
            for factor in {f.function: f for f in used if f.variable == axis}.values():
                value = self._written(_code(factor).value, axis)
                lines.append(f"const {self._real.kind} {_code(factor).prefix}{axis} = {value};")
        return lines

    def _written(self, template: str, variable: str) -> str:
        return template.format(v=variable, zero=self._real.number(0.0), one=self._real.number(1.0))

    def _square(self, coefficients: list[_RestTerm]) -> list[str]:
        lines = []
        for i in range(len(self._bias)):
            rest = self._rest_of(i, coefficients)
            less = f" - ({self._real.sum(rest)})" if any(value for value, _ in rest) else ""
            lines.append(f"const {self._real.kind} r{i} = d{i}{less};")
        for k, axis in enumerate(self._sensed):
            lines.append(f"{axis} = {self._total(self._inverse[k], 'r')};")
        return lines

    def _rest_of(self, i: int, coefficients: list[_RestTerm]) -> list[tuple[float, str]]:
        """Return n of eq. (1) for one output, as numbers times products."""
        return [(c, self._product(name, term)) for j, term, (c, name) in coefficients if j == i]

    def _offsets(self) -> list[str]:
        """Write all that is read before anything is written: raw and accel may be one array."""
        lines = []
        for i, bias in enumerate(self._bias.tolist()):
            held = float(np.float32(bias)) if self._single else bias
            text = f"raw[{i}] {self._less(held)}" if held else f"raw[{i}]"
            if bias != held:
                text = f"({text})" if held else text
                text = f"{text} {self._less(bias - held)}"
            lines.append(f"const {self._real.kind} d{i} = {text};")
        return lines

    def _less(self, value: float) -> str:
        return f"{'-' if value > 0.0 else '+'} {self._real.number(abs(value))}"

    def _shifts(self, constants: list[str]) -> list[str]:
        """Write the other columns about their middle, those that the constants use."""
        lines = []
        for j, middle in enumerate(self._middle.values()):
            if any(re.search(rf"\bt{j}\b", line) for line in constants):
                lines.append(f"t{j} = env[{j}] {self._less(middle)}")
        return lines

    def _coefficients(self) -> tuple[list[str], list[_RestTerm]]:
        """Return n of eq. (1): per output and product of force, a number or a named constant."""
        constants: list[str] = []
        coefficients: list[_RestTerm] = []
        for i, row in enumerate(self._theta):
            for force, parts in self._by_force(row).items():
                varying = [(value, rest) for value, rest in parts if rest.factors]
                fixed = sum(value for value, rest in parts if not rest.factors)
                if varying:
                    name = f"c{len(constants)}"
                    total = self._constant(varying, None if self._is_bare(force) else fixed)
                    constants.append(f"{name} = {total}")
                    coefficients.append((i, force, (1.0, name)))
                elif not self._is_bare(force):
                    coefficients.append((i, force, (fixed, "")))
        return constants, coefficients

    def _is_bare(self, force: Term) -> bool:
        """Tell whether o and K0 hold the coefficient of a product of force."""
        return force in {CONSTANT, *(linear_term(axis) for axis in self._sensed)}

    def _constant(self, varying: list[tuple[float, Term]], fixed: float | None) -> str:
        """Return a sum of products of other columns; without `fixed`, less its middle value.

        That of bias and scale factors is in o and K0.
        """
        shifted = [part for value, rest in varying for part in self._about_middle(value, rest)]
        if fixed is None:
            shifted = [part for part in shifted if part[1]]
        else:
            shifted.append((fixed, ""))
        return self._real.sum(_collected(shifted))

    def _by_force(self, row: Array) -> dict[Term, list[tuple[float, Term]]]:
        """Return an output's coefficients by product of force, each with its other columns."""
        grouped: dict[Term, list[tuple[float, Term]]] = {}
        for value, term in zip(row.tolist(), self._model.basis_terms, strict=True):
            force = Term(tuple(f for f in term.factors if f.variable in COMPONENTS))
            rest = Term(tuple(f for f in term.factors if f.variable not in COMPONENTS))
            if value and all(f.variable in self._sensed for f in force.factors):
                grouped.setdefault(force, []).append((value, rest))
        return grouped

    def _about_middle(self, value: float, term: Term) -> list[tuple[float, str]]:
        """Expand a product of other columns about the middle: numbers times products of t.

        The rest of the model is then small where the columns are near the middle, and little is
        lost in single precision. A function has no such expansion: its value there is taken off.
        """
        index = {name: j for j, name in enumerate(self._middle)}
        if any(factor.function for factor in term.factors):
            named = {name: f"env[{j}]" for name, j in index.items()}
            there = value * float(term.evaluate(self._middle))
            product = " * ".join(written_factors(term, named, self._single))
            return [(value, product), (-there, "1"), (there, "")]
        parts = [(value, "")]
        for factor in term.factors:
            middle, t = self._middle[factor.variable], f"t{index[factor.variable]}"
            parts = [
                (
                    weight * math.comb(factor.power, q) * middle ** (factor.power - q),
                    " * ".join([*([product] if product else []), *[t] * q]),
                )
                for weight, product in parts
                for q in range(factor.power + 1)
            ]
        return parts

    def _product(self, name: str, term: Term) -> str:
        factors = [name] if name else []
        for factor in term.factors:
            factors += [factor.variable] * factor.power
            if factor.function:
                factors.append(f"{_code(factor).prefix}{factor.variable}")
        return " * ".join(factors)


def _held_by_both(value: float) -> float:
    """Return a number that single precision holds, so that both are about the same middle."""
    with np.errstate(over="ignore"):  # what overflows is refused when it is written in single
        held = float(np.float32(value))
    return held if math.isfinite(held) else value


def _collected(parts: list[tuple[float, str]]) -> list[tuple[float, str]]:
    """Add up the numbers that stand before the same product."""
    total: dict[str, float] = {}
    for value, product in parts:
        key = "" if product == "1" else product
        total[key] = total.get(key, 0.0) + value
    return [(value, product) for product, value in total.items()]


def written_factors(term: Term, named: Mapping[str, str], single: bool) -> list[str]:
    """Return the factors of a term in C, with what its variables are called there."""
    zero, one = literal(0.0, single), literal(1.0, single)
    factors = []
    for factor in term.factors:
        variable = named.get(factor.variable, factor.variable)
        factors += [variable] * factor.power
        if factor.function:
            factors.append(f"({_code(factor).value.format(v=variable, zero=zero, one=one)})")
    return factors


def _code(factor: Factor) -> Code:
    """Return how C writes the function of a factor, which has one.

    Raises
    ------
    MultiposError
        It has no form in C.
    """
    code = FUNCTIONS[factor.function].code
    if code is None:
        raise MultiposError(
            f"the C file has no form for '{factor}'; use apply, or fit a model without it."
        )
    return code
