"""The inverse of a user-defined model, or of more outputs than axes, as lines of C.

`expression_body` writes it, `unseen_part` what the component that no output senses adds to it.

CasADi takes the expressions of all outputs apart into elementary operations. They are written out
one by one inside the same fixed number of steps as for every other model,

    f <- f + P (raw - h(f, e)),    P = K0^-1,    K0 = dh/df                                (1)

at zero force in the middle of the calibrated environment, see `multipos.exports.c_body`. Where
these would not converge, or there are more outputs than axes, the steps are Newton's,

    f <- f + (J'J)^-1 J' (raw - h(f, e)),    J = dh/df at f,                               (2)

with exact derivatives, as many as settle wherever the force is a third beyond what was calibrated.
A reading at which they do not settle is of no force, and gives NAN.
"""

from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.exports.c_body import (
    Body,
    force_grid,
    needed_steps,
    slope_in_the_middle,
    stepped,
    steps_in_words,
)
from multipos.exports.c_text import Real
from multipos.files.spelling import packaged_pairs
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel

_BEYOND = 4.0 / 3.0  # times the largest calibrated force, up to which Newton's steps settle
_SETTLED = {False: 1e-10, True: 1e-5}  # [g], the last step, by single precision
_MOST = 30
# CasADi's operations as C: those of formulas, and those that slopes and Newton's steps are made of,
# with those that CasADi 3.6 takes for them (lt, not, if_else_zero, constpow). The suffix f of the
# functions of the C library is that of single precision.
_OPERATIONS = packaged_pairs(__file__, "operations.csv")


def expression_body(calibration: Calibration, *, single: bool) -> Body:
    """Return the body of the function.

    Raises
    ------
    MultiposError
        The steps would not converge.
    """
    model, real = calibration.model, Real(single)
    sensed = list(model.sensed_axes)
    slope = slope_in_the_middle(calibration)[:, sensed]
    axes = [COMPONENTS[i] for i in sensed]
    try:
        if len(model.outputs) > len(sensed):
            raise MultiposError("more outputs than axes")  # whose steps are Newton's
        steps, rho = needed_steps(calibration, slope, single=single)
        lines, library = _write_step(calibration, np.asarray(np.linalg.inv(slope)), real)
        how, unknowns, ends = steps_in_words(steps, rho), axes, axes
    except MultiposError:
        steps = _newton_steps(calibration, single)
        lines, _ = _write_step(calibration, None, real)
        how, library = f"{steps} steps of Newton's; NAN where they do not converge", True
        unknowns = [*axes, "moved"]
        ends = [f"moved < {real.number(_SETTLED[single])} ? {axis} : NAN" for axis in axes]
    offsets = [f"const {real.kind} d{i} = raw[{i}];" for i in range(len(model.outputs))]
    return Body([*offsets, *stepped(real, unknowns, steps, [*lines], ends)], how, library)


def unseen_part(calibration: Calibration, real: Real) -> tuple[list[str], list[str]]:
    """Return what the one component that no output senses adds to the outputs.

    Returns
    -------
    (lines, parts)
        Lines of C from the components and `env`, and for each output what they add to it, '' for
        nothing.
    """
    import casadi

    model = calibration.model
    (third,) = model.unseen_axes
    force = casadi.SX.sym("f", 3)
    env = casadi.SX.sym("e", len(model.environment))
    without = casadi.vertcat(*(0 if i == third else force[i] for i in range(3)))
    with_it, less = (_outputs_at(calibration, at, env) for at in (force, without))
    added = [i for i in range(with_it.numel()) if casadi.depends_on(with_it[i], force[third])]
    parts = [f"part{i}" if i in added else "" for i in range(with_it.numel())]
    if not added:
        return [], parts
    names = [list(COMPONENTS), [f"env[{j}]" for j in range(len(model.environment))]]
    part = casadi.densify(with_it[added] - less[added])
    function = casadi.Function("part", [force, env], [part], {"cse": True})
    lines, _ = _write(function, names, [f"const {real.kind} part{i}" for i in added], real)
    return lines, parts


def _newton_steps(calibration: Calibration, single: bool) -> int:
    """Return how many steps of eq. (2) settle from no force, wherever force is a third beyond.

    Raises
    ------
    MultiposError
        They do not settle.
    """
    model = calibration.model
    sensed = list(model.sensed_axes)
    grid, columns = force_grid(calibration, _BEYOND)
    true, found = grid[:, sensed], np.zeros(grid.shape)
    raw = model.predict(calibration.parameters, grid, columns)
    with np.errstate(all="ignore"):
        steps, size = 0, np.inf
        while steps < _MOST and not size < _SETTLED[single]:
            steps += 1
            left = raw - model.predict(calibration.parameters, found, columns)
            jacobian = model.force_jacobian(calibration.parameters, found, columns)[:, :, sensed]
            inverse = np.linalg.pinv(np.nan_to_num(jacobian))
            step = np.einsum("nkm,nm->nk", inverse, left)
            found[:, sensed] += step
            size = float(np.abs(step).max())
    off = float(np.abs(found[:, sensed] - true).max())
    if not off < 1e3 * _SETTLED[single]:
        largest = float(np.linalg.norm(calibration.reference, axis=1).max())
        raise MultiposError(
            f"Newton's steps from no force do not find every force up to {_BEYOND * largest:.3g} g "
            f"(off by {off:.2g} g): the outputs turn back, or bend too much; use apply."
        )
    return steps + 1


def _write_step(
    calibration: Calibration, inverse: Array | None, real: Real
) -> tuple[list[str], bool]:
    """Return one step as lines of C: of eq. (1) with P, of eq. (2) without."""
    import casadi

    model = calibration.model
    sensed = list(model.sensed_axes)
    force, raw = casadi.SX.sym("f", len(sensed)), casadi.SX.sym("raw", len(model.outputs))
    env = casadi.SX.sym("e", len(model.environment))
    full = casadi.SX.zeros(3)
    full[sensed] = force
    outputs = _outputs_at(calibration, full, env)
    left = raw - outputs
    axes = results = [COMPONENTS[i] for i in sensed]
    if inverse is not None:
        moved = force + casadi.DM(inverse) @ left
    else:
        slope = casadi.jacobian(outputs, force)
        if slope.shape[0] > slope.shape[1]:
            slope, left = slope.T @ slope, slope.T @ left
        step = casadi.inv_minor(slope) @ left
        moved = casadi.vertcat(force + step, casadi.sum1(casadi.fabs(step)))
        results = [*axes, "moved"]
    names = [
        axes,
        [f"env[{j}]" for j in range(len(model.environment))],
        [f"d{i}" for i in range(len(model.outputs))],
    ]
    function = casadi.Function("step", [force, env, raw], [casadi.densify(moved)], {"cse": True})
    return _write(function, names, results, real)


def _outputs_at(calibration: Calibration, force: Any, env: Any) -> Any:
    """Return the outputs as CasADi's expressions of a force (3,) and other columns."""
    import casadi

    model = calibration.model
    if isinstance(model, ExpressionModel):
        at = [force, env, casadi.SX(calibration.parameters)]
        outputs, symbols = model.compiled.outputs, model.compiled.symbols
        return casadi.substitute([casadi.vertcat(*outputs)], list(symbols), at)[0]
    values = [*casadi.vertsplit(force), *casadi.vertsplit(env)]
    variables = dict(zip((*COMPONENTS, *model.environment), values, strict=True))
    basis = casadi.vertcat(*(term.evaluate(variables) for term in model.basis_terms))
    return casadi.DM(model.coefficients(calibration.parameters)) @ basis


def _write(
    step: Any, names: list[list[str]], ends: list[str], real: Real
) -> tuple[list[str], bool]:
    """Write out CasADi's operations, each result under a name of its own."""
    codes = _codes()
    words = {"one": real.number(1.0), "zero": real.number(0.0), "f": real.f}
    held: dict[int, str] = {}
    lines, results, library = [], [], False
    for k in range(step.n_instructions()):
        code = codes[step.instruction_id(k)]
        into, operands = step.instruction_output(k), step.instruction_input(k)
        if code == "input":
            held[into[0]] = names[operands[0]][operands[1]]
            continue
        if code == "const":
            number = real.number(step.instruction_constant(k))
            held[into[0]] = f"({number})" if number.startswith("-") else number
            continue
        if code == "output":
            results.append((ends[into[1]], held[operands[0]]))
            continue
        template = _OPERATIONS[code]
        library |= "{f}" in template
        text = template.format(*(held[i] for i in operands), **words)
        lines.append(f"const {real.kind} v{k} = {text};")
        held[into[0]] = f"v{k}"
    # All of a step is computed from the force before it.
    lines += [f"{axis} = {value};" for axis, value in results]
    return lines, library


def _codes() -> dict[int, str]:
    """Return the names of CasADi's operations by their numbers."""
    import casadi

    return {getattr(casadi, name): name[3:].lower() for name in dir(casadi) if name[:3] == "OP_"}
