"""The inverse of a model written as an expression, as lines of C.

CasADi takes the expressions of all outputs apart into elementary operations. They are written out
one by one inside the same fixed number of steps as for every other model,

    f <- f + P (raw - h(f, e)),    P = K0^+,    K0 = dh/df                                 (1)

at zero force in the middle of the calibrated environment, see `multipos.compensation.c_body`.
"""

from typing import Any

import numpy as np

from multipos.compensation.c_body import environment_range, literal, needed_steps, steps_in_words
from multipos.errors import MultiposError
from multipos.numerics.terms import COMPONENTS
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.instructions import read_instructions
from multipos.sensor.inverse import sensed_axes

# CasADi's operations as C: of one operand, of two, and functions of the library.
_UNARY = {
    "OP_ASSIGN": "{0}",
    "OP_NEG": "-{0}",
    "OP_SQ": "{0} * {0}",
    "OP_TWICE": "{0} + {0}",
    "OP_INV": "{one} / {0}",
    "OP_NOT": "{0} == {zero} ? {one} : {zero}",
    "OP_SIGN": "{0} > {zero} ? {one} : ({0} < {zero} ? -{one} : {zero})",
}
_BINARY = {
    "OP_ADD": "{0} + {1}",
    "OP_SUB": "{0} - {1}",
    "OP_MUL": "{0} * {1}",
    "OP_DIV": "{0} / {1}",
    "OP_LT": "{0} < {1} ? {one} : {zero}",
    "OP_LE": "{0} <= {1} ? {one} : {zero}",
    "OP_IF_ELSE_ZERO": "{0} > {zero} || {0} < {zero} ? {1} : {zero}",
    "OP_FMIN": "{0} < {1} ? {0} : {1}",
    "OP_FMAX": "{0} > {1} ? {0} : {1}",
    "OP_POW": "pow{f}({0}, {1})",
    "OP_CONSTPOW": "pow{f}({0}, {1})",
    "OP_ATAN2": "atan2{f}({0}, {1})",
}
_FUNCTIONS = (
    "EXP",
    "LOG",
    "SQRT",
    "SIN",
    "COS",
    "TAN",
    "ASIN",
    "ACOS",
    "ATAN",
    "SINH",
    "COSH",
    "TANH",
    "ASINH",
    "ACOSH",
    "ATANH",
    "FABS",
    "FLOOR",
    "CEIL",
)


def expression_body(calibration: Calibration, *, single: bool) -> tuple[str, str, bool]:
    """Return the body, in words how it computes, and whether it calls the C library's math.

    Raises
    ------
    MultiposError
        The steps would not converge, an operation has no counterpart in C, or there are more
        outputs than axes.
    """
    model = calibration.model
    assert isinstance(model, ExpressionModel)
    sensed = list(sensed_axes(model))
    if len(model.outputs) > len(sensed):
        raise MultiposError(
            "an expression of more outputs than axes is not exported; use apply, or fit each "
            "axis with one output."
        )
    middle = {n: np.array([np.mean(environment_range(calibration, n))]) for n in model.environment}
    slope = model.force_jacobian(calibration.parameters, np.zeros((1, 3)), middle)[0][:, sensed]
    steps, rho = needed_steps(calibration, slope, single=single)
    lines, library = _step(calibration, np.linalg.inv(slope), single)
    kind, axes = "float" if single else "double", [COMPONENTS[i] for i in sensed]
    start = ", ".join(f"{axis} = {literal(0.0, single)}" for axis in axes)
    body = [
        "{",
        *(f"    const {kind} d{i} = raw[{i}];" for i in range(len(model.outputs))),
        f"    {kind} {start};",
        f"    for (int step = 0; step < {steps}; ++step) {{",
        *(f"        {line}" for line in lines),
        "    }",
        *(f"    accel[{k}] = {axis};" for k, axis in enumerate(axes)),
        "}",
    ]
    return "\n".join(body) + "\n", steps_in_words(steps, rho), library


def _step(calibration: Calibration, inverse: Any, single: bool) -> tuple[list[str], bool]:
    """Return one step of eq. (1) as lines of C."""
    import casadi

    model = calibration.model
    assert isinstance(model, ExpressionModel)
    sensed = list(sensed_axes(model))
    force, raw = casadi.SX.sym("f", len(sensed)), casadi.SX.sym("raw", len(model.outputs))
    env = casadi.SX.sym("e", len(model.environment))
    full = casadi.SX.zeros(3)
    full[sensed] = force
    outputs = [
        read_instructions(program, (full, env, casadi.SX(calibration.parameters[part])))
        for program, part in zip(model.functions, model.slices, strict=True)
    ]
    moved = force + casadi.DM(inverse) @ (raw - casadi.vertcat(*outputs))
    names = [
        [COMPONENTS[i] for i in sensed],
        [f"env[{j}]" for j in range(len(model.environment))],
        [f"d{i}" for i in range(len(model.outputs))],
    ]
    step = casadi.Function("step", [force, env, raw], [casadi.densify(moved)], {"cse": True})
    return _write(step, names, single)


def _write(step: Any, names: list[list[str]], single: bool) -> tuple[list[str], bool]:
    """Write out CasADi's operations, each result under a name of its own."""
    codes = _codes()
    words = {"one": literal(1.0, single), "zero": literal(0.0, single), "f": "f" * single}
    kind = "float" if single else "double"
    held: dict[int, str] = {}
    lines, results, library = [], [], False
    for k in range(step.n_instructions()):
        code = codes[step.instruction_id(k)]
        into, operands = step.instruction_output(k), step.instruction_input(k)
        if code == "OP_INPUT":
            held[into[0]] = names[operands[0]][operands[1]]
            continue
        if code == "OP_CONST":
            number = literal(step.instruction_constant(k), single)
            held[into[0]] = f"({number})" if number.startswith("-") else number
            continue
        if code == "OP_OUTPUT":
            results.append((names[0][into[1]], held[operands[0]]))
            continue
        template = _template(code)
        library |= "{f}" in template
        text = template.format(*(held[i] for i in operands), **words)
        lines.append(f"const {kind} v{k} = {text};")
        held[into[0]] = f"v{k}"
    # All of a step is computed from the force before it.
    lines += [f"{axis} = {value};" for axis, value in results]
    return lines, library


def _codes() -> dict[int, str]:
    """Return the names of CasADi's operations by their numbers."""
    import casadi

    return {getattr(casadi, name): name for name in dir(casadi) if name.startswith("OP_")}


def _template(code: str) -> str:
    """Return an operation in C; {f} stands behind the name of a function of the C library.

    Raises
    ------
    MultiposError
        It has no counterpart in C.
    """
    function = code.removeprefix("OP_")
    if function in _FUNCTIONS:
        return f"{function.lower()}{{f}}({{0}})"
    if code in _UNARY or code in _BINARY:
        return _UNARY.get(code) or _BINARY[code]
    raise MultiposError(
        f"the expression uses CasADi's {function.lower()}, which has no counterpart in "
        "the C file; write it with other operations."
    )
