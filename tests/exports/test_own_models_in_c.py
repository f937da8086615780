"""Models of one's own in C: compiled, and held to what Python finds."""

import casadi
import numpy as np
import pytest
from consumers import read_back
from numpy.testing import assert_allclose

import multipos as mp
from multipos.exports import c_expression
from multipos.exports.target import Wish
from multipos.exports.target_c import c_source
from multipos.positions.scheme import read_scheme
from multipos.sensor.formulas import UNARY
from multipos.sensor.model_text import read_model
from multipos.sensor.own_models import build_parsed

UP = read_scheme("all-26").up


def noisy(values, seed=1):
    return values + 1e-5 * np.random.default_rng(seed).standard_normal(values.shape)


def diagonals():
    axes = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    along = [f"({a:+d}*x {b:+d}*y {c:+d}*z)/sqrt(3)" for a, b, c in axes.tolist()]
    model = "; ".join(
        f"s{i} = b + s*({one})/(1 + common_k*({one})^2)" for i, one in enumerate(along)
    )
    seen = UP @ axes.T / 3**0.5
    values = noisy(0.01 + seen / (1 + 0.03 * seen**2))
    data = mp.Readings(values, up=UP, outputs=("s0", "s1", "s2", "s3"))
    return mp.fit(data, model=model, axes="x,y,z,x")


def bending():
    model = "each = b + a*tanh(own/w)"
    return mp.fit(mp.Readings(noisy(0.02 + 1.5 * np.tanh(UP / 1.2)), up=UP), model=model)


def slightly():
    return mp.fit(
        mp.Readings(noisy(0.02 + UP - 0.01 * UP**3), up=UP), model="each = b+s*own+k*own^3"
    )


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize(
    ("make", "how"),
    [(slightly, "shrinking"), (bending, "Newton's"), (diagonals, "Newton's")],
)
def test_c_does_what_python_does(make, how, single, tmp_path):
    # eq. (1) of exports.c_expression
    cal = make()
    assert how in c_source(cal, Wish("m", single))
    mp.export(cal, "c", float=single).save(tmp_path / "m.c")
    found = read_back(tmp_path / "m.c", cal)
    # the last step of Newton's is below a tolerance; single precision rounds at 6e-8
    assert found.difference < (5e-7 if single else 1e-9)


def test_the_inverse_of_more_outputs_than_axes_is_the_least_squares_one():
    # eq. (2) of exports.c_expression
    cal = diagonals()
    assert_allclose(cal.compensate(cal.predict(UP)), UP, rtol=0, atol=1e-12)


def test_a_model_that_turns_back_is_not_exported():
    own = UP[:, [0]]
    cal = mp.fit(
        mp.Readings(noisy(own - 0.3 * own**3), up=UP), model="each = b + s*own + k*own^3", axes="x"
    )
    with pytest.raises(mp.MultiposError, match="turn back"):
        c_source(cal, Wish("m"))


def test_a_target_of_numbers_alone_says_what_a_formula_loses():
    with pytest.raises(mp.MultiposError, match="cannot express b_ax, a_ax, w_ax"):
        mp.export(bending(), "ros-imu-calib")


@pytest.mark.parametrize(("single", "settled"), [(False, 1e-10), (True, 1e-5)])
def test_newtons_steps_are_counted_from_no_force(single, settled):
    """Of y = b + s f + k f², from 0 to a third beyond either end, each axis by itself."""
    up = read_scheme("faces-6").up
    y = 0.01 + up + 0.04 * up**2
    cal = mp.fit(mp.Readings(y, up=up), model="each = b + s*own + k*own^2")
    _, s, k = np.reshape(cal.parameters, (3, 3))[0]
    needed = 0
    for true in np.linspace(-4.0 / 3.0, 4.0 / 3.0, 401):
        f, steps, step = 0.0, 0, 1.0
        while abs(step) >= settled:
            step = (s * true + k * true**2 - s * f - k * f**2) / (s + 2.0 * k * f)
            f, steps = f + step, steps + 1
        needed = max(needed, steps)
    assert c_expression._newton_steps(cal, single) == needed + 1
    bent = mp.fit(mp.Readings(0.01 + up + 0.4 * up**2, up=up), model="each = b + s*own + k*own^2")
    with pytest.raises(mp.MultiposError, match=r"up to 1\.33 g"):
        c_expression._newton_steps(bent, single)


FORMS = [*(f"{name}(x + y)" for name in UNARY), "atan2(x, y)", "min(x, y)", "max(x, y)"]


@pytest.mark.parametrize("formula", [*FORMS, "(x + y)^y", "(x + y)^3", "x/y"])
def test_every_operation_of_a_formula_and_its_newton_step_has_c(formula):
    model = build_parsed(
        read_model(f"u = p + {formula}; v = p + own"), ("u", "v"), ("x", "y"), tuple("xyz"), "V", ()
    )
    y, (f, e, p) = casadi.vertcat(*model.compiled.outputs), model.compiled.symbols
    slope = casadi.jacobian(y, f[:2])
    step = casadi.vertcat(y, casadi.inv_minor(slope) @ y)
    function = casadi.Function("step", [f, e, p], [casadi.densify(step)], {"cse": True})
    codes = c_expression._codes()
    used = {codes[function.instruction_id(k)] for k in range(function.n_instructions())}
    assert used <= {"input", "const", "output", *c_expression._OPERATIONS}
