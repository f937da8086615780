"""Compensation is the model's inverse, for one output to four; its uncertainty is first order."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from multipos.errors import MultiposError
from multipos.numerics.arrays import COMPONENTS
from multipos.numerics.terms import NAMED
from multipos.sensor.inverse import _apply_inverse, invert, parameter_jacobian, sensitivities
from multipos.sensor.model import build_model

SENSORS = {
    "triad": (("ax", "ay", "az"), ("x", "y", "z")),
    "pair": (("a", "b"), ("y", "z")),
    "four": (("a", "b", "c", "d"), ("x", "y", "z", "x")),
    "one": (("a",), ("z",)),
}


def sensor(model, kind, rng, environment=()):
    """A sensor near the ideal one: coefficients of a few percent beside unit scale factors."""
    outputs, axes = SENSORS[kind]
    built = build_model(model, outputs, axes, known=environment)
    parameters = rng.uniform(-0.03, 0.03, len(built.keys))
    for output, axis in zip(outputs, axes, strict=True):
        parameters[built.index(output, axis)] += 1.0
    return built, parameters


def forces(built, rng, count=20):
    f = np.zeros((count, 3))
    sensed = list(built.sensed_axes)
    f[:, sensed] = rng.uniform(-1, 1, (count, len(sensed)))
    return f


@pytest.mark.parametrize("kind", SENSORS)
@pytest.mark.parametrize("model", NAMED)
@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_forward_then_inverse_is_identity(model, kind, seed):
    # eq. (1) of sensor.inverse
    rng = np.random.default_rng(seed)
    built, parameters = sensor(model, kind, rng)
    f = forces(built, rng)
    raw = built.predict(parameters, f, {})
    found = invert(built, parameters, raw, {})
    assert_allclose(found, f[:, list(built.sensed_axes)], atol=1e-12)


def test_the_unit_of_the_readings_does_not_matter():
    rng = np.random.default_rng(2)
    built, parameters = sensor("ieee", "triad", rng)
    f = forces(built, rng)
    raw = built.predict(parameters, f, {})
    for unit in (1e-9, 16384.0, 1e9):
        assert_allclose(invert(built, unit * parameters, unit * raw, {}), f, atol=1e-12)


def test_other_columns_take_part():
    rng = np.random.default_rng(3)
    text = "1 + x + y + z + own^2 + temperature + temperature*own"
    built, parameters = sensor(text, "triad", rng, ("temperature",))
    f, t = forces(built, rng), {"temperature": rng.uniform(-1, 1, 20)}
    raw = built.predict(parameters, f, t)
    assert_allclose(invert(built, parameters, raw, t), f, atol=1e-12)


def test_a_symmetric_gauge_is_inverted_with_its_mirror():
    rng = np.random.default_rng(4)
    built = build_model("linear", ("a", "b", "c"), COMPONENTS).with_gauge("symmetric")
    parameters = rng.uniform(-0.03, 0.03, 9)
    parameters[[1, 4, 8]] += 1
    f = forces(built, rng)
    assert_allclose(invert(built, parameters, built.predict(parameters, f, {}), {}), f, atol=1e-14)


def test_no_force_explains_a_reading_below_the_vertex_of_a_parabola():
    built = build_model("1 + own + own^2", ("a",), ("x",))
    parameters = np.array([0.0, 1.0, 0.5])  # lowest at f = -1: -0.5
    found = invert(built, parameters, np.array([[-0.6], [0.0], [1.5], [-0.48]]), {})
    assert np.isnan(found[0]).all()
    assert_allclose(found[1:, 0], [0, 1, -1 + np.sqrt(1 - 2 * 0.48)], atol=1e-12)


@pytest.mark.parametrize("text", ["1", "1 + y", "1 + temperature"])
def test_a_model_without_its_own_axis_cannot_be_inverted(text):
    built = build_model(text, ("a",), ("x",), known=("temperature",))
    if "temperature" in text:
        found = invert(built, np.ones(2), np.ones((1, 1)), {"temperature": [1.0]})
        assert np.isnan(found).all()
        return
    with pytest.raises(MultiposError, match="every output needs its own axis in the model"):
        invert(built, np.ones(len(built.keys)), np.ones((1, 1)), {})


def test_more_outputs_than_axes_are_weighed_by_least_squares():
    built = build_model("1 + own", ("a", "b"), ("x", "x"))
    found = invert(built, np.array([0.0, 1.0, 0.0, 2.0]), np.array([[1.0, 3.0]]), {})
    assert_allclose(found, [[(1 * 1 + 2 * 3) / 5]])


@pytest.mark.parametrize("kind", SENSORS)
def test_the_parameter_jacobian_against_finite_differences(kind):
    rng = np.random.default_rng(5)
    built, parameters = sensor("ieee-odd", kind, rng)
    f = forces(built, rng, 6)
    jacobian = parameter_jacobian(built, parameters, f, {})
    for j in range(len(parameters)):
        step = np.zeros(len(parameters))
        step[j] = 1.0  # the model is linear in its parameters
        difference = built.predict(parameters + step, f, {}) - built.predict(parameters, f, {})
        assert_allclose(jacobian[:, :, j], difference, atol=1e-14)


@pytest.mark.parametrize("kind", ["triad", "pair", "one"])
def test_the_uncertainty_of_a_force_against_forces_of_moved_parameters(kind):
    """Parameters at ±√p times each column of a root of their covariance have that covariance."""
    # eq. (2) of sensor.inverse
    rng = np.random.default_rng(6)
    built, parameters = sensor("own-quadratic", kind, rng)
    root = 1e-4 * rng.standard_normal((len(parameters), len(parameters)))
    f = forces(built, rng, 4)
    raw = built.predict(parameters, f, {})
    sensed = list(built.sensed_axes)
    seen = np.zeros_like(f)
    seen[:, sensed] = f[:, sensed]
    inverse, slopes = sensitivities(built, parameters, seen, {})
    moved = inverse @ slopes @ root
    stated = moved @ moved.transpose(0, 2, 1)
    steps = np.sqrt(len(parameters)) * np.concatenate([root.T, -root.T])
    draws = np.array([invert(built, parameters + step, raw, {}) for step in steps])
    for row in range(len(f)):
        found = np.atleast_2d(np.cov(draws[:, row], rowvar=False, ddof=0))
        sd = np.sqrt(np.diag(stated[row]))
        # what is not linear is some thousandths of these steps
        assert_allclose(found / np.outer(sd, sd), stated[row] / np.outer(sd, sd), atol=1e-2)


def test_a_response_without_slopes_has_no_force_and_leaves_the_others_theirs():
    """Of y = s x and y = x/0 by hand: two rows are not finite, one is singular, one 2."""
    slopes = np.array([[[np.inf]], [[np.nan]], [[0.5]], [[0.0]]])
    step = _apply_inverse(slopes, np.ones((4, 1)))
    assert_array_equal(step, [[np.nan], [np.nan], [2.0], [np.nan]])
