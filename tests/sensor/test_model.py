"""Models: names, formulas, terms, and what a formula must never do."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from multipos.errors import UsageError
from multipos.numerics.terms import NAMED, formula_columns
from multipos.sensor.model import build_model, paper_symbol, parameter_label

OUTPUTS, AXES = ("ax", "ay", "az"), ("x", "y", "z")


def build(text, outputs=OUTPUTS, axes=AXES, **options):
    return build_model(text, outputs, axes, **options)


def terms(text, axis="x", **options):
    return [str(t) for t in build(text, ("a",), (axis,), **options).terms[0]]


# INTERFACE, "Models", for an output whose own axis is x
@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("linear", "1 x y z"),
        ("own-quadratic", "1 x y z x^2"),
        ("own-cubic", "1 x y z x^2 x^3"),
        ("cross-quadratic", "1 x y z x^2 x*y x*z"),
        ("ieee", "1 x y z x^2 x^3 x*y x*z"),
        ("ieee-odd", "1 x y z x^2 x^3 x*y x*z x*|x|"),
        ("full-quadratic", "1 x y z x^2 y^2 z^2 x*y x*z y*z"),
    ],
)
def test_named_models(name, expected):
    assert terms(name) == expected.split()
    assert set(NAMED) >= {name}


def test_own_is_the_axis_of_the_output():
    assert terms("ieee-odd", "z") == ["1", "x", "y", "z", "z^2", "z^3", "x*z", "y*z", "z*|z|"]
    model = build("own-quadratic", ("p", "q"), ("y", "y"))
    assert [str(t) for t in model.terms[1]] == ["1", "x", "y", "z", "y^2"]
    assert model.names[:5] == ("bias_p", "cross_p_x", "scale_p", "cross_p_z", "quad_p")


@pytest.mark.parametrize(
    ("formula", "expected"),
    [
        ("1 + x + y + z + own^2", "1 x y z x^2"),
        ("  1+own +  own*|own| ", "1 x x*|x|"),
        ("z*y + x*x", "y*z x^2"),
        ("y*x*|x|*x", "x^2*|x|*y"),
        ("|x|^2 + |x|^3", "x^2 x^2*|x|"),
        ("|x|", "|x|"),
        ("x + own", "x"),
        ("1 + x*temperature + temperature^2", "1 temperature*x temperature^2"),
        ("1*1 + x*1", "1 x"),
        ("own ^ 2 + | own |", "x^2 |x|"),
    ],
)
def test_formulas(formula, expected):
    assert terms(formula) == expected.split()


@pytest.mark.parametrize(
    ("formula", "message"),
    [
        ("", "a term is missing"),
        ("1 + + x", "a term is missing next to a '\\+'"),
        ("1 + x +", "a term is missing"),
        ("x - y", "cannot read 'x - y'"),
        ("2*x", "cannot read '2'"),
        ("x**2", "cannot read"),
        ("x^0", "power in 'x\\^0' must lie between 1 and 9"),
        ("x^99999999999", "must lie between 1 and 9"),
        ("x^" + 5000 * "9", "must lie between 1 and 9"),
        ("x*" * 9 + "x", "the power of x in .* must lie between 1 and 9"),
        ("own^5*|own|^6", "the power of x in .* must lie between 1 and 9"),
        ("own*|own|^5*|x|^5", "the power of x in .* must lie between 1 and 9"),
        ("x^-1", "cannot read"),
        ("x^1.5", "cannot read"),
        ("|x", "cannot read"),
        ("sin(x)", "cannot read 'sin\\(x\\)'"),
        ("__import__('os').system('true')", "cannot read"),
        ("().__class__.__bases__", "cannot read"),
        ("(lambda: 0)()", "cannot read"),
        ("x; import os", "cannot read"),
        ("own-kwadratic", "unknown model 'own-kwadratic'; give linear, own-quadratic"),
        ("quartic", "unknown model 'quartic'"),
        (" + ".join(["x*y"] * 2_000), "the formula has 11997 characters"),
        ("1 + x + humidity", "unknown term 'humidity' in model"),
    ],
)
def test_what_is_no_formula_is_refused(formula, message):
    with pytest.raises(UsageError, match=message):
        build(formula, known=("temperature",))


# Every kind of character that is read apart; the table of all of Unicode takes two seconds to make.
ANY = "".join(map(chr, range(0x500))) + "\u2028\u2212\u00d7\u2124\u4e2d\uff11\U0001d7d8\U0001f600"


@given(st.text(alphabet=ANY, max_size=30))
def test_any_text_is_a_model_or_one_clear_refusal(text):
    try:
        model = build(text, known=())
    except UsageError:
        return
    assert len(model.keys) >= 3


def test_names_units_and_labels():
    model = build("ieee-odd", unit="V")
    assert model.names[:9] == (
        "bias_ax",
        "scale_ax",
        "cross_ax_y",
        "cross_ax_z",
        "quad_ax",
        "cubic_ax",
        "product_ax_xy",
        "product_ax_xz",
        "odd_ax",
    )
    assert model.units[:9] == (
        "V",
        "V/g",
        "V/g",
        "V/g",
        "V/g^2",
        "V/g^3",
        "V/g^2",
        "V/g^2",
        "V/g^2",
    )
    full = build("full-quadratic")
    assert full.names[4:10] == (
        "quad_ax",
        "square_ax_y",
        "square_ax_z",
        "product_ax_xy",
        "product_ax_xz",
        "product_ax_yz",
    )
    warm = build("1 + x + temperature + temperature^2 + temperature*x", unit="V")
    assert warm.names[2:5] == ("temperature_ax", "temperature^2_ax", "temperature*x_ax")
    assert warm.units[2:5] == ("V/degC", "V/degC^2", "V/g/degC")
    for m in (model, full, warm):
        for output, term in m.keys:
            axis = m.axes[m.outputs.index(output)]
            assert output in parameter_label(output, axis, term)
        assert len(set(m.names)) == len(m.names)


def test_the_symbols_are_those_of_the_paper():
    # eq. (1) of the paper, row by row, in the order 1, x, y, z, own²
    assert [paper_symbol(build("own-quadratic"), i) for i in range(15)] == [
        "a_x0",
        "S_ax",
        "K_ax1",
        "K_ax2",
        "K_ax3",
        "a_y0",
        "K_ay1",
        "S_ay",
        "K_ay2",
        "K_ay3",
        "a_z0",
        "K_az1",
        "K_az2",
        "S_az",
        "K_az3",
    ]
    assert paper_symbol(build("ieee"), 0) is None
    assert paper_symbol(build("linear", ("a", "b", "c"), ("z", "y", "x")), 0) is None


def test_inputs_restrict_what_a_named_model_sees():
    assert terms("ieee", inputs=("x", "y")) == ["1", "x", "y", "x^2", "x^3", "x*y"]
    with pytest.raises(UsageError, match="term 'z' of the formula needs a component"):
        build("1 + x + y + z", ("ax",), ("x",), inputs=("x", "y"))
    with pytest.raises(UsageError, match="senses axis z, which is not among --inputs x,y"):
        build("linear", inputs=("x", "y"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"axes": ("x", "y")}, "--axes names 2 axes for 3 outputs"),
        ({"axes": ("x", "y", "w")}, "--axes takes x, y and z, got 'x,y,w'"),
        ({"inputs": ("x", "q")}, "--inputs takes x, y and z"),
        ({"inputs": ()}, "--inputs takes x, y and z"),
        ({"inputs": ("x", "x", "y", "z")}, "--inputs names a component twice"),
    ],
)
def test_faulty_axes_are_refused(options, message):
    with pytest.raises(UsageError, match=message):
        build("linear", **options)


def test_columns_of_a_formula():
    assert formula_columns("ieee") == ()
    assert formula_columns("1 + x + own*|own| + temperature*x + p_2^2") == ("temperature", "p_2")


EVERYTHING = "1 + x + y^3 + z*|z| + x*y*z + |y| + temperature*x^2 + temperature^2"
component = st.floats(-2, 2).filter(lambda v: abs(v) > 1e-3)  # |v| has no derivative at 0


@given(st.tuples(component, component, component), component)
def test_terms_against_their_arithmetic_and_finite_differences(force, temperature):
    # eq. (1) of sensor.model
    model = build(EVERYTHING, ("a",), ("x",))
    x, y, z = force
    f = np.array([force])
    t = {"temperature": [temperature]}
    expected = [1, x, y**3, z * abs(z), x * y * z, abs(y), temperature * x**2, temperature**2]
    assert_allclose(model.basis(f, t)[0], expected, rtol=1e-14)
    parameters = np.arange(1.0, 9.0)
    gradient = model.force_jacobian(parameters, f, t)[0, 0]
    for i in range(3):
        step = np.zeros(3)
        step[i] = 1e-5  # keeps every sign
        rise = model.predict(parameters, f + step, t) - model.predict(parameters, f - step, t)
        assert_allclose(gradient[i], rise[0, 0] / 2e-5, atol=1e-7)


def test_coefficients_put_parameters_in_their_place():
    model = build("own-quadratic")
    parameters = np.arange(1.0, 16.0)
    force = np.array([[0.2, -0.5, 0.7]])
    x, y, z = force[0]
    expected = [
        1 + 2 * x + 3 * y + 4 * z + 5 * x * x,
        6 + 7 * x + 8 * y + 9 * z + 10 * y * y,
        11 + 12 * x + 13 * y + 14 * z + 15 * z * z,
    ]
    assert_allclose(model.predict(parameters, force, {})[0], expected, rtol=1e-15)
    assert model.index("ay", "y^2") == 9
    assert model.index("ay", "own^2") == 9
    with pytest.raises(KeyError, match=r"no parameter \('ay', 'x\^2'\)"):
        model.index("ay", "x^2")
    with pytest.raises(KeyError, match="no parameter"):
        model.index("ay", "x(")
    with pytest.raises(KeyError, match="no parameter"):
        model.index("aq", "1")


def test_the_gauges_fix_the_upper_triangle():
    lower = build("linear").with_gauge("lower")
    assert [name for name in lower.names if "cross" in name] == [
        "cross_ay_x",
        "cross_az_x",
        "cross_az_y",
    ]
    parameters = np.arange(1.0, 10.0)  # bx, sx, by, yx, sy, bz, zx, zy, sz
    assert_array_equal(
        lower.linear_map({}) @ parameters, [[1, 2, 0, 0], [3, 4, 5, 0], [6, 7, 8, 9]]
    )
    symmetric = build("linear").with_gauge("symmetric")
    assert symmetric.names == lower.names
    assert_array_equal(
        symmetric.linear_map({}) @ parameters, [[1, 2, 4, 7], [3, 4, 5, 8], [6, 7, 8, 9]]
    )


def test_the_linear_map_sums_terms_at_a_temperature():
    model = build("1 + x + temperature + temperature*x + x^2", ("a",), ("x",))
    b = np.array([1.0, 2, 3, 4, 5])
    assert_allclose(model.linear_map({"temperature": 10.0}) @ b, [[31, 42, 0, 0]])


def test_a_missing_column_is_named():
    model = build("1 + x + temperature", ("a",), ("x",))
    with pytest.raises(UsageError, match="needs column 'temperature'"):
        model.predict(np.ones(3), np.zeros((1, 3)), {})


def test_a_formula_of_two_lines_is_one():
    model = build_model("1 + x\n + y", ("ax",), ("x",))
    assert model.text == "1 + x + y"
