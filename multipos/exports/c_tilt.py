"""The C function that tells tilt: the angles of `multipos.sensor.tilt`, from NAME_compensate.

Three axes need no size of gravity; one or two take the arcsine of f/g, and NAN where |f| exceeds g
by more than `beyond_vertical` says of that axis. With two axes the third component w follows from
|f| = g; what it does to the outputs, d(f, w), is taken off the readings before they are compensated
again,

    f <- compensate(raw - d(f, w)),    w = ±sqrt(g² - |f|²),                                (1)

as often as `multipos.sensor.inverse` does.
"""

import numpy as np

from multipos.errors import MultiposError
from multipos.exports.c_body import literal
from multipos.exports.c_expression import unseen_part
from multipos.numerics.factors import FUNCTIONS, Factor
from multipos.numerics.terms import COMPONENTS
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.inverse import STEPS, XTOL, sensed_axes, unseen_axes
from multipos.sensor.tilt import beyond_vertical, magnitude_of
from multipos.units import STANDARD_GRAVITY


def declaration(calibration: Calibration, function: str, result: str, single: bool) -> str:
    """Return the declaration of a function of raw outputs to one number an axis, without `;`."""
    kind = "float" if single else "double"
    env = len(calibration.model.environment)
    between = f", const {kind} env[{env}]" if env else ""
    axes = len(sensed_axes(calibration.model))
    raw = f"const {kind} raw[{len(calibration.outputs)}]"
    return f"void {function}({raw}{between}, {kind} {result}[{axes}])"


def tilt_signature(calibration: Calibration, name: str, single: bool) -> str:
    """Return the declaration of NAME_tilt, without a semicolon."""
    return declaration(calibration, f"{name}_tilt", "tilt_deg", single)


def tilt_header(calibration: Calibration) -> list[str]:
    """Return what the comment of the file says of the angles."""
    sensed = [COMPONENTS[i] for i in sensed_axes(calibration.model)]
    named = f"tilt_deg[{len(sensed)}] = {', '.join(sensed)}"
    lines = [f"{named} above the horizon [degrees], at rest, positive where the axis points up"]
    if len(sensed) < len(COMPONENTS):
        room = beyond_vertical(calibration)
        limits = ", ".join(
            f"{axis} {value:.9g} g" for axis, value in zip(sensed, room.tolist(), strict=True)
        )
        lines.append(
            f"NAN where |f| is beyond {magnitude_of(calibration):.9g} g by more than {limits}"
        )
    return lines


def tilt_function(calibration: Calibration, name: str, *, single: bool, in_metres: bool) -> str:
    """Return the function.

    Raises
    ------
    MultiposError
        Two axes of a model whose third component C cannot write.
    """
    axes = sensed_axes(calibration.model)
    kind, f = ("float", "f") if single else ("double", "")
    env = ", env" if calibration.model.environment else ""
    unit = STANDARD_GRAVITY if in_metres else 1.0
    lines = ["{", f"    {kind} f[{len(axes)}];", f"    {name}_compensate(raw{env}, f);"]
    degrees = literal(180.0 / np.pi, single)
    sign = "" if calibration.sign > 0.0 else "-"
    if len(axes) == len(COMPONENTS):
        for k in range(3):
            i, j = (other for other in range(3) if other != k)
            across = f"sqrt{f}(f[{i}] * f[{i}] + f[{j}] * f[{j}])"
            lines.append(f"    tilt_deg[{k}] = {degrees} * atan2{f}({sign}f[{k}], {across});")
        return _closed(calibration, name, single, lines)
    size = magnitude_of(calibration) * unit
    if len(axes) == 2:
        lines += _third(calibration, name, single, unit)
    one, rooms = literal(1.0, single), beyond_vertical(calibration) / magnitude_of(calibration)
    for k, room in enumerate(rooms.tolist()):
        limit = literal(1.0 + room, single)
        clipped = f"fmax{f}(-{one}, fmin{f}({one}, s{k}))"
        lines += [
            f"    const {kind} s{k} = {sign}f[{k}] / {literal(size, single)};",
            f"    const int seen{k} = s{k} <= {limit} && -s{k} <= {limit};",
            f"    tilt_deg[{k}] = seen{k} ? {degrees} * asin{f}({clipped}) : NAN;",
        ]
    return _closed(calibration, name, single, lines)


def _closed(calibration: Calibration, name: str, single: bool, lines: list[str]) -> str:
    return "\n".join([tilt_signature(calibration, name, single), *lines, "}"]) + "\n"


def _third(calibration: Calibration, name: str, single: bool, unit: float) -> list[str]:
    """Return eq. (1), where the model has the component that no output senses."""
    if isinstance(calibration.model, ExpressionModel):
        lines, parts = unseen_part(calibration, single=single)
    else:
        lines, parts = [], _of_third(calibration, single)
    if not any(parts):
        return []
    kind, f = ("float", "f") if single else ("double", "")
    env = ", env" if calibration.model.environment else ""
    (third,) = unseen_axes(calibration.model)
    sensed = [COMPONENTS[i] for i in sensed_axes(calibration.model)]
    size = literal(magnitude_of(calibration) ** 2, single)
    sign = "" if calibration.sign > 0.0 else "-"
    scale = "" if unit == 1.0 else f" / {literal(unit, single)}"
    seen = [f"        const {kind} {axis} = f[{k}]{scale};" for k, axis in enumerate(sensed)]
    left = " - ".join([size, *(f"{axis} * {axis}" for axis in sensed)])
    zero, tolerance = literal(0.0, single), literal(XTOL, single)
    less = [f"raw[{i}] - ({part})" if part else f"raw[{i}]" for i, part in enumerate(parts)]
    return [
        f"    {kind} before = {zero};",
        f"    for (int turn = 0; turn < {STEPS}; ++turn) {{",
        *seen,
        f"        const {kind} {COMPONENTS[third]} = {sign}sqrt{f}(fmax{f}({zero}, {left}));",
        f"        if (fabs{f}({COMPONENTS[third]} - before) <= {tolerance})",
        "            break;",
        f"        before = {COMPONENTS[third]};",
        *(f"        {line}" for line in lines),
        f"        const {kind} less[{len(less)}] = {{{', '.join(less)}}};",
        f"        {name}_compensate(less{env}, f);",
        "    }",
    ]


def _of_third(calibration: Calibration, single: bool) -> list[str]:
    """Return what terms with the unseen component add to each output, in C; '' for nothing."""
    model = calibration.model
    third = COMPONENTS[unseen_axes(model)[0]]
    theta = model.coefficients(calibration.parameters)
    index = {column: f"env[{j}]" for j, column in enumerate(model.environment)}
    result = []
    for row in theta.tolist():
        parts = [
            " * ".join([literal(value, single), *_written(term.factors, index, single)])
            for value, term in zip(row, model.basis_terms, strict=True)
            if value and any(factor.variable == third for factor in term.factors)
        ]
        result.append(" + ".join(parts))
    return result


def _written(factors: tuple[Factor, ...], index: dict[str, str], single: bool) -> list[str]:
    zero, one = literal(0.0, single), literal(1.0, single)
    result = []
    for factor in factors:
        variable = index.get(factor.variable, factor.variable)
        result += [variable] * factor.power
        if factor.function:
            code = FUNCTIONS[factor.function].code
            if code is None:
                raise MultiposError(f"the C file has no form for '{factor}'; use apply.")
            result.append(f"({code.value.format(v=variable, zero=zero, one=one)})")
    return result
