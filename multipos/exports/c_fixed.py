"""The model's inverse in whole numbers, for processors without floating point.

`find_fixed_point` finds the whole numbers and `fixed_forces` runs them in Python;
`fixed_signature`, `fixed_notes`, `fixed_defines` and `fixed_body` return the parts of the file,
`fixed_test` the program that tests it.

Readings and forces are 32-bit integers, raw = R y and accel = A f with a power of ten R (1 where
readings are counts) and A of units, and products have 64 bits. With f₀ = P (y − b), the linear
part, and D = P q for the second-order coefficients q of products φ of forces,

    f₀ = (Σ_i L_ki raw_i + c_k) / 2^s,        f <- f₀ − Σ_q D_kq φ_q(f) / 2^r,             (1)

with L, c, D whole numbers, rounded once. The shift s is the largest for which

    Σ_i |L_ki| ≤ 2^30    and    |c_k| ≤ 2^61,                                               (2)

so that no reading of 32 bits overflows; φ = (f_a f_b)/2^t of forces that are held within four times
what was calibrated, with t so that φ stays below 2^30, and r by a bound like (2). What is beyond 32
bits in the end is saturated. Python runs the same whole numbers (`fixed_forces`), and both are the
same to the last bit.
"""

import itertools
import math
from functools import cached_property
from itertools import compress
from textwrap import wrap

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError
from multipos.exports.c_body import counted_steps, exact_inverse, slope_in_the_middle
from multipos.exports.c_text import Statement, array, fill
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.numerics.terms import Term
from multipos.results import frozen
from multipos.sensor.calibration import Calibration

COUNTS = ("count", "counts", "LSB", "lsb")  # units of readings that are whole numbers
_LARGEST = 2**31 - 1
_SUM = 2**30  # bound of eq. (2)
_CONSTANT = 2**61
_HELD = 4.0  # times the largest calibrated force, within which products are taken
_TOLERANCE = 0.5  # of the last bit, that steps leave
_MOST_STEPS = 8
_MEASURED = 20_000  # readings over the calibrated range: more add less than 1 % to the error

Whole = NDArray[np.int64]


@frozen
class FixedPoint:
    """The numbers of eq. (1).

    Attributes
    ----------
    calibration : Calibration
    raw_per_unit, accel_per_g : int
        R and A.
    linear : (K, M) array
    constant : (K,) array
    shift : int
        s.
    products : tuple of pairs of int
        The two axes of each φ, as places among the K that are sensed.
    quadratic : (K, Q) array
    product_shift, quadratic_shift : int
        t and r.
    held : int
        Largest force in a product.
    steps : int
    """

    calibration: Calibration
    raw_per_unit: int
    accel_per_g: int
    linear: Whole
    constant: Whole
    shift: int
    products: tuple[tuple[int, int], ...]
    quadratic: Whole
    product_shift: int
    quadratic_shift: int
    held: int
    steps: int

    @cached_property
    def error(self) -> float:
        """Largest error [g] against the calibration over the range of its readings, as measured.

        At the corners, at the readings, and at `_MEASURED` places between them.
        """
        values = self.calibration.readings.values
        low, high = values.min(axis=0), values.max(axis=0)
        corners = np.array(list(itertools.product(*zip(low, high, strict=True))))
        between = np.random.default_rng(0).uniform(low, high, (_MEASURED, len(low)))
        rows = self.whole(np.concatenate([corners, values, between]))
        exact = self.calibration.compensate(rows / self.raw_per_unit)
        difference = fixed_forces(self, rows) / self.accel_per_g - exact
        return float(np.abs(difference[np.isfinite(exact).all(axis=1)]).max())

    def whole(self, values: Array) -> Whole:
        """Return readings (n, M) as the function takes them."""
        return np.rint(values * self.raw_per_unit).astype(np.int64)


def find_fixed_point(calibration: Calibration) -> FixedPoint:
    """Return the whole numbers that compensate as a calibration does.

    Raises
    ------
    MultiposError
        The model is not linear or quadratic in the forces alone, or its numbers do not fit.
    """
    c, model = calibration, calibration.model
    sensed = list(model.sensed_axes)
    _require_quadratic(c, sensed)
    theta = model.coefficients(c.parameters)
    slope = slope_in_the_middle(c)[:, sensed]
    bias = model.predict(c.parameters, np.zeros((1, 3)), {})[0]
    pairs = [_pair(term, sensed) for term in model.basis_terms]
    second = theta[:, [pair is not None for pair in pairs]]
    P = exact_inverse(slope)
    R, per = _raw_per_unit(c), _per_unit(c)
    largest = float(np.linalg.norm(c.reference, axis=1).max())
    scaled, offset = P * (per / R), -(P @ bias) * per
    shift = _shift(np.abs(scaled).sum(axis=1).max(), _SUM)
    shift = min(shift, _shift(np.abs(offset).max(), _CONSTANT))
    held = int(np.ceil(_HELD * largest * per))
    if shift < 1 or held > _LARGEST:
        raise MultiposError(
            "--fixed: one reading moves the force by more than 32-bit numbers resolve; state the "
            "unit of the readings with --unit, or leave out --fixed."
        )
    t = max(0, (held * held // _SUM).bit_length())
    D = P @ second * (2.0**t / per)
    r = _shift(np.abs(D).sum(axis=1).max(), _SUM)
    quadratic = _whole(D, r)
    used = np.asarray(quadratic.any(axis=0))
    steps = counted_steps(c, slope, _TOLERANCE / per) if used.any() else 0
    if steps > _MOST_STEPS:
        raise MultiposError(
            f"--fixed: the second order of this model takes more than {_MOST_STEPS} steps; drop "
            "terms whose coefficient is not significant, or leave out --fixed."
        )
    return FixedPoint(
        calibration=c,
        raw_per_unit=R,
        accel_per_g=per,
        linear=_whole(scaled, shift),
        constant=_whole(offset, shift),
        shift=shift,
        products=tuple(compress(filter(None, pairs), used.tolist())),
        quadratic=quadratic[:, used],
        product_shift=t,
        quadratic_shift=r,
        held=held,
        steps=max(steps - 1, 0),  # the linear part is the first
    )


def _require_quadratic(c: Calibration, sensed: list[int]) -> None:
    model, axes = c.model, {COMPONENTS[i] for i in sensed}
    fits = model.has_terms and not model.environment
    second = False
    for term in model.basis_terms if fits else ():
        degree = sum(f.power for f in term.factors)
        fits &= degree <= 2 and all(not f.function and f.variable in axes for f in term.factors)
        second |= degree == 2
    if not fits or (second and len(c.outputs) != len(sensed)):
        raise MultiposError(
            f"--fixed writes linear and quadratic models of the force alone, and this one is "
            f"'{model.text}' of {len(c.outputs)} outputs; fit another, or leave out --fixed."
        )


def _pair(term: Term, sensed: list[int]) -> tuple[int, int] | None:
    """Return the two axes of a term of second order."""
    axes = [f.variable for f in term.factors for _ in range(f.power)]
    if len(axes) != 2:
        return None
    a, b = (sensed.index(COMPONENTS.index(axis)) for axis in axes)
    return a, b


def _raw_per_unit(c: Calibration) -> int:
    """Return R: 1 of counts, else the largest power of ten with a bit to spare."""
    if c.model.unit in COUNTS:
        return 1
    largest = float(np.abs(c.readings.values).max())
    return int(10 ** max(0, int(np.floor(np.log10(_LARGEST / 2.0 / largest)))))


def _shift(size: float, bound: int) -> int:
    """Return the largest s with size 2^s ≤ bound, at most 62."""
    return min(62, int(np.floor(np.log2(bound / size)))) if size > 0.0 else 62


def _whole(values: Array, shift: int) -> Whole:
    return np.rint(np.ldexp(values, shift)).astype(np.int64)


def fixed_forces(fixed: FixedPoint, raw: Whole) -> Whole:
    """Return the forces (n, K) of readings (n, M) in whole numbers, to the bit what C gives."""
    first = _rounded(raw @ fixed.linear.T + fixed.constant, fixed.shift)
    force = first
    for _ in range(fixed.steps):
        held = np.clip(force, -fixed.held, fixed.held)
        products = np.column_stack(
            [(held[:, a] * held[:, b]) >> fixed.product_shift for a, b in fixed.products]
        )
        force = first - _rounded(products @ fixed.quadratic.T, fixed.quadratic_shift)
    return np.clip(force, -_LARGEST - 1, _LARGEST)


def _rounded(total: Whole, shift: int) -> Whole:
    return (total + (1 << shift >> 1)) >> shift


_PER = {"gravity": "ACCEL_PER_G", "magnetic": "FIELD_PER_UNIT"}  # by kind of field


def _per_unit(c: Calibration) -> int:
    """Return the whole numbers in a g, or in the unit of a field, whose size has seven digits."""
    return int(10 ** max(0, 6 - math.floor(math.log10(c.field.full_scale))))


def fixed_signature(c: Calibration, name: str) -> str:
    """Return the declaration, without a semicolon."""
    axes = len(c.model.sensed_axes)
    raw = f"const int32_t raw[{len(c.outputs)}]"
    return f"void {name}_compensate({raw}, int32_t {c.field.in_c}[{axes}])"


def fixed_notes(fixed: FixedPoint, name: str) -> tuple[str, ...]:
    """Return what the comment of the file says of the whole numbers, as lines."""
    unit, field = fixed.calibration.model.unit, fixed.calibration.field
    size = 10.0 ** (math.floor(math.log10(fixed.error)) - 1)  # of the second digit, rounded up
    error = field.shown(math.ceil(fixed.error / size) * size, ".2g", "µg")
    raw = "counts" if unit in COUNTS else f"readings [{unit}] times {name}_RAW_PER_UNIT, rounded"
    return (
        f"In 32-bit whole numbers: raw are {raw};",
        f"accel is the {field.quantity} times {name}_{_PER[field.kind]}, saturated.",
        "Shifts of negative numbers are arithmetic, as compilers have them.",
        f"Largest error, of {_MEASURED} readings over the calibrated range: {error}.",
    )


def fixed_defines(fixed: FixedPoint, name: str) -> str:
    """Return the scale factors as definitions of the preprocessor."""
    scale = _PER[fixed.calibration.field.kind]
    lines = [f"#define {name}_{scale} {fixed.accel_per_g}"]
    if fixed.calibration.model.unit not in COUNTS:
        lines.append(f"#define {name}_RAW_PER_UNIT {fixed.raw_per_unit}")
    return "\n".join(lines) + "\n"


def fixed_test(fixed: FixedPoint, name: str) -> str:
    """Return a C99 program that checks the function against Python, to the bit."""
    values = fixed.calibration.readings.values
    rows = fixed.whole(np.concatenate([values, 2.0 * values - np.roll(values, 1, axis=0)])[:24])
    both = (("raw", rows), ("expected", fixed_forces(fixed, rows)))
    arrays = "\n".join(array(key, "int32_t", numbers.tolist()) for key, numbers in both)
    return fill(
        "test_fixed.c",
        name=name,
        declaration=fixed_signature(fixed.calibration, name),
        count=len(rows),
        axes=len(fixed.linear),
        arrays=arrays,
    )


def fixed_body(fixed: FixedPoint) -> list[Statement]:
    """Return the statements of the function."""
    K, M = fixed.linear.shape
    lines: list[Statement] = [f"int64_t f[{K}];"]
    if fixed.products:
        lines.append(f"int64_t first[{K}];")
    to = "first" if fixed.products else "f"
    half = 1 << fixed.shift >> 1
    for k in range(K):
        parts = [_times(int(fixed.linear[k, i]), f"raw[{i}]") for i in range(M)]
        parts.append(f"INT64_C({int(fixed.constant[k]) + half})")
        lines += _wrapped(f"{to}[{k}] = ({' + '.join(parts)}) >> {fixed.shift};", 1)
    if fixed.products:
        lines += _steps(fixed, K)
    return [
        *lines,
        f"for (int k = 0; k < {K}; ++k)",
        "    accel[k] = f[k] > INT32_MAX   ? INT32_MAX",
        "               : f[k] < INT32_MIN ? INT32_MIN",
        "                                  : (int32_t)f[k];",
    ]


def _times(factor: int, what: str) -> str:
    return f"(int64_t){factor} * {what}"


def _wrapped(text: str, depth: int) -> list[str]:
    return wrap(text, 90 - 4 * depth, subsequent_indent="    ", break_long_words=False)


def _steps(fixed: FixedPoint, K: int) -> list[Statement]:
    held = fixed.held
    inner = [
        f"for (int k = 0; k < {K}; ++k)",
        f"    f[k] = f[k] > {held} ? {held} : f[k] < -{held} ? -{held} : f[k];",
    ]
    for q, (a, b) in enumerate(fixed.products):
        inner.append(f"const int64_t p{q} = (f[{a}] * f[{b}]) >> {fixed.product_shift};")
    half = f"INT64_C({1 << fixed.quadratic_shift >> 1})"
    for k, row in enumerate(fixed.quadratic.tolist()):
        parts = [*(_times(v, f"p{q}") for q, v in enumerate(row) if v), half]
        text = f"f[{k}] = first[{k}] - (({' + '.join(parts)}) >> {fixed.quadratic_shift});"
        inner += _wrapped(text, 2)
    return [
        f"for (int k = 0; k < {K}; ++k)",
        "    f[k] = first[k];",
        (f"for (int step = 0; step < {fixed.steps}; ++step)", inner),
    ]
