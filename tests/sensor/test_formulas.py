"""Formulas of one's own: what they mean, and where they are wrong."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

import multipos as mp
from multipos.sensor.formulas import parse_formula
from multipos.sensor.model_text import ParsedModel, parsed_dict, parsed_from_dict, read_model
from multipos.sensor.own_models import build_parsed


def build(text, outputs=("ax",), axes=("x",), columns=()):
    parsed = read_model(text)
    assert isinstance(parsed, ParsedModel)
    return build_parsed(parsed, outputs, axes, ("x", "y", "z"), "V", columns)


def value(formula, force=(0.3, -0.2, 0.9), **parameters):
    model = build(f"each = {formula} + 0*p")
    theta = np.array([parameters.get(str(term), 0.0) for _, term in model.keys])
    return model.predict(theta, np.array([force]), {})[0, 0]


@pytest.mark.parametrize(
    ("formula", "expected"),
    [
        ("-2^2", -4.0),
        ("2^3^2", 512.0),
        ("2^-1", 0.5),
        ("2**3", 8.0),
        ("7 - 2 - 1", 4.0),
        ("12/2/3", 2.0),
        ("2 + 3*4", 14.0),
        ("--3", 3.0),
        ("|x - 1|*|-2|", 1.4),
        ("||y| - 1|", 0.8),
        ("own", 0.3),
        ("x + 10*y + 100*z", 0.3 - 2.0 + 90.0),
        ("min(3, 1, 2) + max(x, y)", 1.3),
        ("atan2(z, x)", math.atan2(0.9, 0.3)),
        ("sin(pi/6) + log(e)", 1.5),
        ("sqrt(2)^2 + tanh(0) + sign(-3)", 1.0),
        ("asin(1) + acos(1) + atan(0) + tan(0) + cos(0) + exp(0) + abs(-1)", math.pi / 2 + 3.0),
        ("1e3 + .5 + 2.", 1002.5),
        ("p", 0.0),
    ],
)
def test_a_formula_means_what_it_says(formula, expected):
    assert_allclose(value(formula), expected, rtol=1e-15)


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(0.1, 3))
def test_formulas_agree_with_python(a, b, c):
    # eq. (1) of sensor.formulas
    found = value("a*own - b/(c + x^2) + c^1.5*(a - b)^3", a=a, b=b, c=c)
    expected = a * 0.3 - b / (c + 0.3**2) + c**1.5 * (a - b) ** 3
    assert_allclose(found, expected, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("each = b + ", "character 11: expected a number, a name or '(', found the end"),
        ("each = b + s*own)", "character 17: expected an operator, found ')'"),
        ("each = (b + own", "character 16: expected ')' for the '(' at character 8"),
        ("each = 2x", "character 9: expected an operator, found 'x'"),
        ("each = b $ c", "character 10: '$' has no meaning"),
        ("each = b + sinn(own)", "character 12: unknown function 'sinn'; did you mean 'sin'?"),
        ("each = sin + b", "character 12: expected '(' after sin"),
        ("each = atan2(own)", "character 8: atan2 takes 2 arguments, got 1"),
        ("each = 1e999*b", "character 8: 1e999 is larger than a number can be"),
        ("each == b", "character 7: '=' has no meaning"),
        ("ax = b; each", "character 8: 'each' is no line of a model"),
        ("ax = b; ax = own", "'ax' has two lines"),
        ("each = " + "(" * 100 + "b" + ")" * 100, "at most 60 parentheses"),
        ("each = " + "-" * 100 + "b", "at most 60 signs"),
        ("each = b" + " + b" * 2000, "at most 4000 characters"),
        ("each = 2*own", "no parameter to fit"),
        ("ay = b", "'ay' is no output"),
        ("each = import(b)", "unknown function 'import'"),
        ("each = b.c", "character 9: '.' has no meaning"),
    ],
)
def test_an_error_names_the_place_in_the_line(text, said):
    with pytest.raises(mp.UsageError) as caught:
        build(text)
    assert said in str(caught.value)


@given(st.text(alphabet="abxyown012.+-*/^(),|= \n;e", max_size=30))
def test_any_text_is_a_model_or_a_plain_error(text):
    try:
        parsed = read_model(f"each = {text}")
        assert isinstance(parsed, ParsedModel)
        build_parsed(parsed, ("ax",), ("x",), ("x", "y", "z"), "V", ())
    except mp.UsageError:
        pass


def test_each_output_has_what_it_uses_and_shares_what_is_common():
    model = build("each = b + s*own + common_k*own^2; az = c*z", ("ax", "ay", "az"), tuple("xyz"))
    keys = [(output, str(term)) for output, term in model.keys]
    assert keys == [
        ("ax", "b"),
        ("ax", "s"),
        ("ay", "b"),
        ("ay", "s"),
        ("az", "c"),
        ("common", "common_k"),
    ]
    assert model.names == ("b_ax", "s_ax", "b_ay", "s_ay", "c_az", "common_k")
    _, blocks = model.respond(np.arange(1.0, 7.0), np.array([[0.5, 0.25, 2.0]]), {})
    assert [places.tolist() for places, _ in blocks] == [[0, 1, 5], [2, 3, 5], [4]]
    assert_allclose(blocks[0][1], [[1.0, 0.5, 0.25]])  # by hand: dy/db, dy/ds, dy/dk


def test_derivatives_are_those_of_the_complex_step():
    # eq. (1) of sensor.compiled
    model = build("each = b + s*sin(k*own)/(1 + q*y^2)")
    theta, force = np.array([0.1, 0.9, 1.3, 0.2]), np.array([[0.4, -0.7, 0.6]])
    _, ((_, slopes),) = model.respond(theta, force, {})
    by_force = model.force_jacobian(theta, force, {})[0, 0]

    def y(b, s, k, q, x, v):
        return b + s * np.sin(k * x) / (1 + q * v**2)

    at = [*theta, 0.4, -0.7]
    steps = [y(*(v + 1e-200j * (i == j) for j, v in enumerate(at))).imag / 1e-200 for i in range(6)]
    assert_allclose(slopes[0], steps[:4], rtol=1e-14)
    assert_allclose(by_force, [*steps[4:], 0.0], rtol=1e-14)
    second = model.second_derivatives(theta, force, {})[0, 0]
    # by hand: d²y/dk² = -s x² sin(kx)/(1 + q y²)
    assert_allclose(second[2, 2], -0.9 * 0.16 * np.sin(0.52) / (1 + 0.2 * 0.49), rtol=1e-14)
    assert_allclose(second, second.T)


TOML = """
[parameters]
k = 0.01
common_t = { start = 20, sd = 5, unit = "degC" }
c = { low = 0, high = inf }

[outputs]
each = "b + s*own/(1 + k*own^2) + c*common_t"
"""


def test_a_file_says_what_is_known_of_parameters(tmp_path):
    path = tmp_path / "own.toml"
    path.write_text(TOML)
    model = build(str(path))
    assert model.names == ("b_ax", "s_ax", "k_ax", "c_ax", "common_t")
    assert model.units == ("-", "-", "-", "-", "degC")
    assert_allclose(model.starts, [np.nan, np.nan, 0.01, np.nan, 20.0])
    assert_allclose(model.beliefs, [0, 0, 0, 0, 0.04])
    assert model.bounded
    again = parsed_from_dict(parsed_dict(read_model(path)))
    assert again == read_model(path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[outputs]\neach = 3", "[outputs] each must be text"),
        ("[parameters]\nk = 1", "no [outputs]"),
        ('[outputs]\neach = "b"\n[extra]\na = 1', "'extra' is no table"),
        ('[parameters]\nq = 1\n[outputs]\neach = "b"', "[parameters] q stands in no formula"),
        ('[parameters]\nb = "one"\n[outputs]\neach = "b"', "start must be a number"),
        ('[parameters]\nb = {strat = 1}\n[outputs]\neach = "b"', "did you mean 'start'?"),
        ('[parameters]\nb = {sd = 1}\n[outputs]\neach = "b"', "give start as well"),
        (
            '[parameters]\nb = {start = 1, sd = 0}\n[outputs]\neach = "b"',
            "sd must be at least 1e-40",
        ),
        (
            '[parameters]\nb = {start = 1, sd = 1e-200}\n[outputs]\neach = "b"',
            "sd must be at least 1e-40, got 1e-200",
        ),
        ('[parameters]\nb = {low = 1, high = 1}\n[outputs]\neach = "b"', "below high"),
        ('[parameters]\nb = {start = 3, high = 1}\n[outputs]\neach = "b"', "start 3 is not from"),
        (
            f'[parameters]\nb = {{unit = "{"V" * 4001}"}}\n[outputs]\neach = "b"',
            "unit has 4001 characters, above 4000",
        ),
        ('[parameters]\nx = 1\n[outputs]\neach = "b + x"', "no name for a parameter"),
        ('[outputs]\neach = "b + (own"', "[outputs] each, character 9: expected ')'"),
        ("[outputs\n", "not valid TOML"),
    ],
)
def test_a_file_that_is_no_model_says_where(tmp_path, text, said):
    path = tmp_path / "own.toml"
    path.write_text(text)
    with pytest.raises(mp.MultiposError) as caught:
        build(str(path))
    assert said in str(caught.value)


def test_steps_stand_after_their_operands():
    # by hand: b s own * + -k 2 ^ /
    found = parse_formula("(b + s*own)/-k^2 - min(1, |k|, 3)", "model")
    assert found.steps == (
        *("b", "s", "own", ("mul", 2), ("add", 2), "k", 2.0, ("pow", 2), ("neg", 1), ("div", 2)),
        *(1.0, "k", ("fabs", 1), ("fmin", 2), 3.0, ("fmin", 2), ("sub", 2)),
    )
    assert found.names == {"b": 2, "s": 6, "own": 8, "k": 14}


def test_a_sum_of_any_length_is_computed():
    """A line of 4000 characters is the limit, not the depth of its tree."""
    terms = [f"a{i}*own" for i in range(330)]
    model = build("each = " + " + ".join(terms))
    theta = np.arange(330.0)
    outputs, blocks = model.respond(theta, np.array([[0.5, 0.0, 0.0]]), {})
    assert_allclose(outputs, [[0.5 * theta.sum()]], rtol=1e-14)
    assert_allclose(blocks[0][1], np.full((1, 330), 0.5), rtol=1e-15)
    many = build("each = b" + "+own" * 998)
    assert_allclose(many.predict(np.array([2.0]), np.array([[0.5, 0.0, 0.0]]), {}), [[501.0]])
