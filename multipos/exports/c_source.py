"""The C99 file of a calibration, and the program that tests it.

The file holds one function and nothing else: no library, memory or state, so that it can be
called from any firmware. What the function does is in `multipos.exports.c_body`.
"""

import re
from collections.abc import Sequence
from textwrap import wrap

import numpy as np

from multipos import __version__
from multipos.doubt import accepted
from multipos.errors import MultiposError, UsageError
from multipos.exports.c_body import function_body, literal
from multipos.exports.c_expression import expression_body
from multipos.exports.c_steps import environment_range
from multipos.exports.c_tilt import declaration, tilt_function, tilt_header, tilt_signature
from multipos.files.characters import visible
from multipos.files.numbers import number, table, uncertain
from multipos.numerics.arrays import Array
from multipos.numerics.terms import COMPONENTS
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.inverse import sensed_axes
from multipos.sensor.tilt import at_rest, tilt_at_rest
from multipos.uncertainty.validity import applied
from multipos.units import STANDARD_GRAVITY

SIGNATURE = re.compile(
    r"^void (?P<name>[A-Za-z_]\w*)_compensate\(const (?P<type>double|float) raw\[(?P<raw>\d{1,6})\]"
    r"(?:, const \w+ env\[(?P<env>\d{1,6})\])?, \w+ accel\[(?P<accel>\d{1,6})\]\)",
    re.MULTILINE | re.ASCII,
)
METRES = re.compile(r"^ \* accel\[\d+\] = [^\n]*\[m/s\^2\], convention", re.MULTILINE)
WRITTEN_BY = re.compile(r"^ \* written by +multipos (?P<version>\S+)$", re.MULTILINE)
_WIDTH = 90  # of a comment
_NEGLIGIBLE = 1e-9  # of the largest linear coefficient: what a precision may lose


def require_identifier(name: str) -> None:
    """Refuse a name that is no C identifier."""
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name):
        raise UsageError(f"--name '{name}' is no C identifier; use letters, digits and _.")


def c_source(
    calibration: Calibration,
    name: str,
    *,
    single: bool,
    in_metres: bool = False,
    tilt: bool = False,
) -> str:
    """Return the C99 file of a calibration, its force in g or in m/s², and its tilt.

    Raises
    ------
    UsageError
        `name` is no C identifier.
    MultiposError
        The steps would not converge, or a coefficient is beyond the precision.
    """
    require_identifier(name)
    _require_held(calibration, single)
    _vectors(calibration, single)  # which says why, where the model has no inverse
    if isinstance(calibration.model, ExpressionModel):
        body, how, library = expression_body(calibration, single=single)
    else:
        (body, how), library = function_body(calibration, single=single), False
    include = "#include <math.h>\n\n" if library or tilt else ""
    if in_metres:
        body = _in_metres(body, calibration, single)
    head = _header(calibration, name, how, "m/s^2" if in_metres else "g", tilt)
    text = f"{head}\n{include}{signature(calibration, name, single)}\n{body}"
    if tilt:
        text += "\n" + tilt_function(calibration, name, single=single, in_metres=in_metres)
    return text


def _in_metres(body: str, calibration: Calibration, single: bool) -> str:
    """Return the body of the function with its answer turned from g to m/s² at the end."""
    axes = len(sensed_axes(calibration.model))
    last = "\n".join(f"    accel[{k}] *= {literal(STANDARD_GRAVITY, single)};" for k in range(axes))
    return f"{body.rstrip().removesuffix('}')}{last}\n}}\n"


def signature(calibration: Calibration, name: str, single: bool) -> str:
    """Return the declaration, without a semicolon."""
    return declaration(calibration, f"{name}_compensate", "accel", single)


def c_test(
    calibration: Calibration,
    name: str,
    *,
    single: bool,
    in_metres: bool = False,
    tilt: bool = False,
) -> str:
    """Return a C99 program that checks the function against values from Python."""
    kind = "float" if single else "double"
    raw, env, force = _vectors(calibration, single)
    tolerance, unit = "5e-7f" if single else "1e-9", "g"
    if in_metres:
        force = force * STANDARD_GRAVITY
        tolerance, unit = "5e-6f" if single else "1e-8", "m/s^2"
    arrays = [("raw", raw), *([("env", env)] if env.shape[1] else []), ("expected", force)]
    text = "\n".join(array(key, values, single) for key, values in arrays)
    call = ", ".join(f"{key}[i]" for key, _ in arrays[:-1])
    declared, checked, library = "", "", ""
    if tilt:
        text += "\n" + array("angle", _angles(calibration, raw, env), single)
        declared = f"\n{tilt_signature(calibration, name, single)};"
        checked, library = _tilt_check(name, call, kind, single), "#include <math.h>\n"
    return f"""\
/* Self-test of {name}_compensate: compile with the file that holds it, and run.
   Exits with 0 where every value is met within {tolerance} {unit}. */
{library}#include <stdio.h>

{signature(calibration, name, single)};{declared}

enum {{ COUNT = {len(raw)}, AXES = {force.shape[1]} }};

{text}

int main(void)
{{
    int failed = 0;
    for (int i = 0; i < COUNT; ++i) {{
        {kind} accel[AXES];
        {name}_compensate({call}, accel);
        for (int k = 0; k < AXES; ++k) {{
            const {kind} off = accel[k] - expected[i][k];
            if (!(off < {tolerance} && -off < {tolerance})) {{
                printf("vector %d, axis %d: off by %g {unit}\\n", i + 1, k + 1, (double)off);
                failed = 1;
            }}
        }}
{checked}    }}
    puts(failed ? "FAILED" : "{name}_compensate: all values met");
    return failed;
}}
"""


def _angles(calibration: Calibration, raw: Array, env: Array) -> Array:
    """Return the tilt (n, K) [degrees] of readings as Python tells it."""
    columns = dict(zip(calibration.model.environment, env.T, strict=True))
    rest = at_rest(calibration, raw, columns)
    return np.asarray(np.degrees(tilt_at_rest(calibration, rest, columns).tilt))


def _tilt_check(name: str, call: str, kind: str, single: bool) -> str:
    """Return the lines that hold the sines of the angles to those of Python, NAN to NAN."""
    f, tolerance = ("f", "2e-6f") if single else ("", "1e-9")
    turn = literal(np.pi / 180.0, single)
    return f"""\
        {kind} tilt[AXES];
        {name}_tilt({call}, tilt);
        for (int k = 0; k < AXES; ++k) {{
            const {kind} off = sin{f}({turn} * tilt[k]) - sin{f}({turn} * angle[i][k]);
            if (isnan(tilt[k]) != isnan(angle[i][k]) || off > {tolerance} || -off > {tolerance}) {{
                printf("vector %d, axis %d: %g and not %g degrees\\n", i + 1, k + 1,
                       (double)tilt[k], (double)angle[i][k]);
                failed = 1;
            }}
        }}
"""


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
    model = calibration.model
    middle = {n: np.array([np.mean(environment_range(calibration, n))]) for n in model.environment}
    slope = model.force_jacobian(calibration.parameters, np.zeros((1, 3)), middle)[0]
    sizes = _NEGLIGIBLE * np.abs(slope).max(axis=1)
    return np.append(sizes, sizes.min())[model.output_of]


def _header(calibration: Calibration, name: str, how: str, unit: str, tilt: bool) -> str:
    c = calibration
    model = c.model
    axes = sensed_axes(model)
    env = [
        f"env[{j}] = {n}, calibrated from {low:.6g} to {high:.6g}"
        for j, n in enumerate(model.environment)
        for low, high in [environment_range(c, n)]
    ]
    sensed = [COMPONENTS[i] for i in axes]
    rows = [[p.name, p.unit, uncertain(p.value, p.u), number(p.U, 2)] for p in c.entries]
    what = "specific force" if c.convention == "specific-force" else "gravity"
    lines = [
        f"{name}_compensate: raw accelerometer readings to {what} [{unit}].",
        *(line for said in accepted(c.diagnostics.doubts) for line in wrap(said, _WIDTH)),
        "",
        f"raw[{len(c.outputs)}] = {', '.join(c.outputs)} [{model.unit}]",
        *env,
        f"accel[{len(sensed)}] = {', '.join(sensed)} [{unit}], convention {c.convention}",
        "raw and accel may be the same array.",
        *(tilt_header(c) if tilt else ()),
        "",
        f"model       {model.text}",
        f"computed by {how}",
        f"calibrated  {c.created} by multipos {c.version}, {len(c.readings)} readings",
        f"written by  multipos {__version__}",
        f"residual    rms {1e3 * c.rms:.3g} mg after compensation",
        f"valid       {_validity(c, axes)}; beyond it the model extrapolates",
        f"U           {100 * c.confidence:g} % coverage, of the parameters; model error is extra",
        "",
        *table(["parameter", "unit", "value(u)", "U"], rows).splitlines(),
    ]
    if unit != "g":
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
    kind = "float" if single else "double"
    cells = [
        ["NAN" if value != value else literal(value, single) for value in row]
        for row in values.tolist()
    ]
    rows = ",\n".join(f"    {{{', '.join(row)}}}" for row in cells)
    return f"static const {kind} {name}[COUNT][{values.shape[1]}] = {{\n{rows}\n}};"
