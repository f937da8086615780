"""The C99 file of a calibration, and the program that tests it.

`c_source` returns the file and `fixed_source` that in whole numbers, `c_test` the program;
`declaration`, `signature`, `tilt_signature`, `tilt_header` and `tilt_function` return parts of
them; `require_identifier` refuses a name, `of_field` renames the result of a magnetometer,
`comment` keeps a text on its line, and `array` writes an array of rows.

The file holds one function and nothing else: no library, memory or state, so that it can be
called from any firmware. What the function does is in `multipos.exports.c_body`.

A second function, on request, gives tilt: the angles of `multipos.sensor.tilt`, from
NAME_compensate. Three axes need no size of gravity; one or two take the arcsine of f/g, and NAN
where |f| exceeds g by more than `beyond_vertical` says of that axis. With two axes the third
component w follows from |f| = g; what it does to the outputs, d(f, w), is taken off the readings
before they are compensated again,

    f <- compensate(raw - d(f, w)),    w = ±sqrt(g² - |f|²),                                (1)

as often as `multipos.sensor.inverse` does.
"""

import re
from collections.abc import Sequence
from textwrap import wrap
from typing import get_args

import numpy as np

from multipos import __version__
from multipos.errors import MultiposError, UsageError
from multipos.exports import c_expression, c_fixed, c_text
from multipos.exports.c_body import (
    environment_range,
    function_body,
    is_linear,
    slope_in_the_middle,
    written_factors,
)
from multipos.exports.c_text import Real, Statement, fill, function, literal
from multipos.exports.target import Exported, Target, Wish
from multipos.files.numbers import number, table, uncertain
from multipos.files.spelling import visible
from multipos.finding import forced
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.sensor.calibration import Calibration
from multipos.sensor.gravity import FieldKind
from multipos.sensor.inverse import STEPS, XTOL
from multipos.sensor.tilt import at_rest, beyond_vertical, magnitude_of, tilt_at_rest
from multipos.uncertainty.validity import applied
from multipos.units import STANDARD_GRAVITY


def declaration(calibration: Calibration, function: str, result: str, single: bool) -> str:
    """Return the declaration of a function of raw outputs to one number an axis, without `;`."""
    kind = "float" if single else "double"
    env = len(calibration.model.environment)
    between = f", const {kind} env[{env}]" if env else ""
    axes = len(calibration.model.sensed_axes)
    raw = f"const {kind} raw[{len(calibration.outputs)}]"
    return f"void {function}({raw}{between}, {kind} {result}[{axes}])"


def tilt_signature(calibration: Calibration, name: str, single: bool) -> str:
    """Return the declaration of NAME_tilt, without a semicolon."""
    return declaration(calibration, f"{name}_tilt", "tilt_deg", single)


def tilt_header(calibration: Calibration) -> list[str]:
    """Return what the comment of the file says of the angles."""
    sensed = [COMPONENTS[i] for i in calibration.model.sensed_axes]
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


def tilt_function(calibration: Calibration, name: str, real: Real, *, in_metres: bool) -> str:
    """Return the function.

    Raises
    ------
    MultiposError
        Two axes of a model whose third component C cannot write.
    """
    axes = calibration.model.sensed_axes
    kind, f = real.kind, real.f
    env = ", env" if calibration.model.environment else ""
    unit = STANDARD_GRAVITY if in_metres else 1.0
    degrees = real.number(180.0 / np.pi)
    sign = "" if calibration.sign > 0.0 else "-"
    lines: list[Statement] = [f"{kind} f[{len(axes)}];", f"{name}_compensate(raw{env}, f);"]
    if len(axes) == len(COMPONENTS):
        for k in range(3):
            i, j = (other for other in range(3) if other != k)
            across = f"sqrt{f}(f[{i}] * f[{i}] + f[{j}] * f[{j}])"
            lines.append(f"tilt_deg[{k}] = {degrees} * atan2{f}({sign}f[{k}], {across});")
        return function(tilt_signature(calibration, name, real.single), lines)
    if len(axes) == 2:
        lines += _third(calibration, name, real, unit)
    one, size = real.number(1.0), magnitude_of(calibration)
    for k, room in enumerate((beyond_vertical(calibration) / size).tolist()):
        limit = real.number(1.0 + room)
        clipped = f"fmax{f}(-{one}, fmin{f}({one}, s{k}))"
        lines += [
            f"const {kind} s{k} = {sign}f[{k}] / {real.number(size * unit)};",
            f"const int seen{k} = s{k} <= {limit} && -s{k} <= {limit};",
            f"tilt_deg[{k}] = seen{k} ? {degrees} * asin{f}({clipped}) : NAN;",
        ]
    return function(tilt_signature(calibration, name, real.single), lines)


def _third(calibration: Calibration, name: str, real: Real, unit: float) -> list[Statement]:
    """Return eq. (1), where the model has the component that no output senses."""
    if not calibration.model.has_terms:
        lines, parts = c_expression.unseen_part(calibration, real)
    else:
        lines, parts = [], _of_third(calibration, real)
    if not any(parts):
        return []
    kind, f = real.kind, real.f
    env = ", env" if calibration.model.environment else ""
    third = COMPONENTS[calibration.model.unseen_axes[0]]
    sensed = [COMPONENTS[i] for i in calibration.model.sensed_axes]
    size, zero = real.number(magnitude_of(calibration) ** 2), real.number(0.0)
    sign = "" if calibration.sign > 0.0 else "-"
    scale = "" if unit == 1.0 else f" / {real.number(unit)}"
    left = " - ".join([size, *(f"{axis} * {axis}" for axis in sensed)])
    less = [f"raw[{i}] - ({part})" if part else f"raw[{i}]" for i, part in enumerate(parts)]
    inner = [
        *(f"const {kind} {axis} = f[{k}]{scale};" for k, axis in enumerate(sensed)),
        f"const {kind} {third} = {sign}sqrt{f}(fmax{f}({zero}, {left}));",
        f"if (fabs{f}({third} - before) <= {real.number(XTOL)})",
        "    break;",
        f"before = {third};",
        *lines,
        f"const {kind} less[{len(less)}] = {{{', '.join(less)}}};",
        f"{name}_compensate(less{env}, f);",
    ]
    return [f"{kind} before = {zero};", (f"for (int turn = 0; turn < {STEPS}; ++turn)", inner)]


def _of_third(calibration: Calibration, real: Real) -> list[str]:
    """Return what terms with the unseen component add to each output, in C; '' for nothing."""
    model = calibration.model
    third = COMPONENTS[model.unseen_axes[0]]
    theta = model.coefficients(calibration.parameters)
    index = {column: f"env[{j}]" for j, column in enumerate(model.environment)}
    result = []
    for row in theta.tolist():
        parts = [
            " * ".join([real.number(value), *written_factors(term, index, real.single)])
            for value, term in zip(row, model.basis_terms, strict=True)
            if value and any(factor.variable == third for factor in term.factors)
        ]
        result.append(" + ".join(parts))
    return result


_WIDTH = 90  # of a comment
_NEGLIGIBLE = 1e-9  # of the largest linear coefficient: what a precision may lose


def require_identifier(name: str) -> None:
    """Refuse a name that is no C identifier."""
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name):
        raise UsageError(f"--name '{name}' is no C identifier; use letters, digits and _.")


def c_source(calibration: Calibration, wish: Wish) -> str:
    """Return the C99 file of a calibration, its force in g or in m/s², and its tilt.

    Raises
    ------
    UsageError
        The name is no C identifier.
    MultiposError
        The steps would not converge, or a coefficient is beyond the precision.
    """
    name, single, in_metres, tilt = wish.name, wish.single, wish.in_metres, wish.tilt
    require_identifier(name)
    _require_held(calibration, single)
    _vectors(calibration, single)  # which says why, where the model has no inverse
    real, model = Real(single), calibration.model
    by_terms = model.has_terms and len(model.outputs) == len(model.sensed_axes)
    write = function_body if by_terms or is_linear(model) else c_expression.expression_body
    body = write(calibration, single=single)
    lines, unit = body.statements, "m/s^2" if in_metres else _unit(calibration)
    if in_metres:
        metres = real.number(STANDARD_GRAVITY)
        lines = [*lines, *(f"accel[{k}] *= {metres};" for k in range(len(model.sensed_axes)))]
    if tilt and calibration.field.angle != "tilt":
        raise UsageError("--tilt is of accelerometers; a magnetic field is not level.")
    if in_metres and calibration.field.unit != "g":
        raise UsageError("--output-unit is of forces; a field is in the unit of its size.")
    include = "#include <math.h>\n\n" if body.library or tilt else ""
    head = _header(calibration, name, body.how, unit, tilt)
    text = f"{head}\n{include}{function(signature(calibration, name, single), lines)}"
    if tilt:
        text += "\n" + tilt_function(calibration, name, real, in_metres=in_metres)
    return of_field(text, calibration)


def of_field(text: str, calibration: Calibration) -> str:
    """Return C of a magnetometer, whose result is called field and not accel; any other as it is.

    Called where the calibration's own words, which may be any, are not in the text or are alike.
    """
    return re.sub(r"\baccel\b", calibration.field.in_c, text)


def fixed_source(fixed: c_fixed.FixedPoint, name: str) -> str:
    """Return the C99 file of a calibration in whole numbers."""
    require_identifier(name)
    how = "one matrix product" if not fixed.products else f"{1 + fixed.steps} steps"
    unit = _unit(fixed.calibration)
    head = _header(fixed.calibration, name, how, unit, False, c_fixed.fixed_notes(fixed, name))
    text = f"{head}\n#include <stdint.h>\n\n{c_fixed.fixed_defines(fixed, name)}\n" + function(
        c_fixed.fixed_signature(fixed.calibration, name), c_fixed.fixed_body(fixed)
    )
    return of_field(text, fixed.calibration)


def _unit(calibration: Calibration) -> str:
    return calibration.field.unit or "1 where the field is as at calibration"


def signature(calibration: Calibration, name: str, single: bool) -> str:
    """Return the declaration, without a semicolon."""
    return of_field(declaration(calibration, f"{name}_compensate", "accel", single), calibration)


def c_test(calibration: Calibration, wish: Wish) -> str:
    """Return a C99 program that checks the function against values from Python."""
    name, single = wish.name, wish.single
    real, field = Real(single), calibration.field
    raw, env, force = _vectors(calibration, single)
    tolerance, unit = "5e-7f" if single else "1e-9", field.unit
    if unit != "g":
        size = float(f"{field.magnitude:.0e}")
        tolerance = real.number((5e-7 if single else 1e-9) * size)
    if wish.in_metres:
        force = force * STANDARD_GRAVITY
        tolerance, unit = "5e-6f" if single else "1e-8", "m/s^2"
    arrays = [("raw", raw), *([("env", env)] if env.shape[1] else []), ("expected", force)]
    words = {"name": name, "kind": real.kind, "call": ", ".join(f"{k}[i]" for k, _ in arrays[:-1])}
    declared, checked, library = f"{signature(calibration, name, single)};", "", ""
    if wish.tilt:
        arrays.append(("angle", _angles(calibration, raw, env)))
        declared += f"\n{tilt_signature(calibration, name, single)};"
        checked, library = _tilt_check(real, words), "#include <math.h>\n"
    filled = fill(
        "test.c",
        **words,
        unit=unit,
        tolerance=tolerance,
        declared=declared,
        checked=checked,
        library=library,
        arrays="\n".join(array(key, values, single) for key, values in arrays),
        count=len(raw),
        axes=force.shape[1],
    )
    return of_field(filled, calibration)


def _angles(calibration: Calibration, raw: Array, env: Array) -> Array:
    """Return the tilt (n, K) [degrees] of readings as Python tells it."""
    columns = dict(zip(calibration.model.environment, env.T, strict=True))
    rest = at_rest(calibration, raw, columns)
    return np.asarray(np.degrees(tilt_at_rest(calibration, rest, columns).tilt))


def _tilt_check(real: Real, words: dict[str, str]) -> str:
    """Return the lines that hold the sines of the angles to those of Python, NAN to NAN."""
    tolerance = "2e-6f" if real.single else "1e-9"
    turn = real.number(np.pi / 180.0)
    return fill("test_tilt.c", **words, f=real.f, turn=turn, tolerance=tolerance)


def _require_held(calibration: Calibration, single: bool) -> None:
    """Refuse, by name, what a precision cannot hold."""
    model = calibration.model
    limits = np.finfo(np.float32 if single else np.float64)
    largest, smallest = float(limits.max), float(limits.tiny)
    precision = "single" if single else "double"
    way = ("leave out --float, or " if single else "") + "fit in a unit nearer to its size"
    needed = _negligible(calibration)
    for name, value, least in zip(calibration.names, calibration.parameters, needed, strict=True):
        size = abs(float(value))
        if size > largest or least < size < smallest:
            lost = "overflows" if size > largest else "vanishes"
            raise MultiposError(f"'{name}' = {value:.3g} {lost} in {precision} precision; {way}.")
    for name in model.environment:
        if max(map(abs, environment_range(calibration, name))) > largest:
            raise MultiposError(f"column '{name}' overflows in {precision} precision; {way}.")


def _negligible(calibration: Calibration) -> Array:
    """Return how small each parameter (p,) may be and be nothing, in its output."""
    sizes = _NEGLIGIBLE * np.abs(slope_in_the_middle(calibration)).max(axis=1)
    return calibration.model.per_parameter(sizes, sizes.min())


def _header(
    calibration: Calibration,
    name: str,
    how: str,
    unit: str,
    tilt: bool,
    notes: tuple[str, ...] = (),
) -> str:
    c = calibration
    model = c.model
    axes = model.sensed_axes
    env = [
        f"env[{j}] = {n}, calibrated from {low:.6g} to {high:.6g}"
        for j, n in enumerate(model.environment)
        for low, high in [environment_range(c, n)]
    ]
    sensed = [COMPONENTS[i] for i in axes]
    rows = [[p.name, p.unit, uncertain(p.value, p.u), number(p.U, 2)] for p in c.entries]
    convention = f", convention {c.convention}" if c.field.unit == "g" else ""
    sensor, what = c.field.sensor.lower(), c.field.vector(c.convention)
    lines = [
        f"{name}_compensate: raw {sensor} readings to {what} [{unit}].",
        *(line for said in forced(c.diagnostics.findings) for line in wrap(said, _WIDTH)),
        "",
        f"raw[{len(c.outputs)}] = {', '.join(c.outputs)} [{model.unit}]",
        *env,
        f"accel[{len(sensed)}] = {', '.join(sensed)} [{unit}]{convention}",
        "raw and accel may be the same array.",
        *notes,
        *(tilt_header(c) if tilt else ()),
        "",
        f"model       {model.text}",
        f"computed by {how}",
        f"calibrated  {c.created} by multipos {c.version}, {len(c.readings)} readings",
        f"written by  multipos {__version__}",
        f"residual    rms {c.field.shown(c.rms, '.3g', 'mg')} after compensation",
        f"valid       {_validity(c, axes)}; beyond it the model extrapolates",
        f"U           {100 * c.confidence:g} % coverage, of the parameters; model error is extra",
        "",
        *table(["parameter", "unit", "value(u)", "U"], rows).splitlines(),
    ]
    if c.field.unit != "g":
        lines += ["", "hard iron: the bias of each output; soft iron: the matrix"]
    elif unit != "g":
        one = "one g, the local gravity, is taken as" if c.gravity is None else "one g is"
        lines.insert(1, f"{one} 9.80665 m/s^2.")
    return "/*\n" + "\n".join(f" * {comment(line)}".rstrip() for line in lines) + "\n */"


def _validity(calibration: Calibration, axes: Sequence[int]) -> str:
    words = applied(calibration).in_words(axes)
    return words if calibration.readings.forced.any() else f"|accel| {words}"


def comment(text: str) -> str:
    """Return text that stays on its line of a comment: it ends none, begins none, continues none.

    A backslash goes first, since it becomes a slash; ``??/`` is a backslash too, a trigraph.
    """
    text = visible(text).replace("\\", "/").replace("*/", "* /").replace("/*", "/ *")
    return re.sub(r"\?(?=\?)", "? ", text)


def _vectors(calibration: Calibration, single: bool) -> tuple[Array, Array, Array]:
    """Return readings of the calibration and some between them, with what Python makes of them."""
    readings = calibration.readings
    names = calibration.model.environment
    rows = np.linspace(0, len(readings) - 1, min(len(readings), 12)).round().astype(int)
    raw = readings.values[rows]
    env = np.empty((len(rows), len(names)))
    for j, name in enumerate(names):
        env[:, j] = readings.environment[name][rows]
    between = (raw + np.roll(raw, 1, axis=0)) / 2.0
    raw = np.concatenate([raw, between])
    env = np.concatenate([env, (env + np.roll(env, 1, axis=0)) / 2.0])
    if single:
        raw, env = raw.astype(np.float32).astype(float), env.astype(np.float32).astype(float)
    force = calibration.compensate(raw, dict(zip(names, env.T, strict=True)))
    sound = np.isfinite(force).all(axis=1)
    return raw[sound], env[sound], force[sound]


def array(name: str, values: Array, single: bool) -> str:
    """Return a constant array of rows, of length ``COUNT``."""
    cells = [
        ["NAN" if value != value else literal(value, single) for value in row]
        for row in values.tolist()
    ]
    return c_text.array(name, Real(single).kind, cells)


def _write(calibration: Calibration, wish: Wish) -> Exported:
    if wish.fixed:
        fixed = c_fixed.find_fixed_point(calibration)
        test = of_field(c_fixed.fixed_test(fixed, wish.name), calibration)
        text, unit = fixed_source(fixed, wish.name), calibration.field.unit
        return Exported(C.name, text, test, difference=fixed.error, unit=unit)
    return Exported(C.name, c_source(calibration, wish), c_test(calibration, wish))


C = Target(
    name="c",
    write=_write,
    suffix=".c",
    is_code=True,
    takes=("output_unit", "tilt", "fixed"),
    fields=get_args(FieldKind),
)
