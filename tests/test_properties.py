"""What must hold of any calibration: order, units and the naming of the axes do not matter.

To ten digits where orientations are exact. Where their errors are estimated, to the share of u at
which the search for variance components ends.
"""

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from known_noise import with_known_noise
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import multipos as mp

SCHEMES = {
    "linear": ("faces-6", "tetrahedron", "fibonacci-11"),
    "own-quadratic": ("faces-6", "faces-corners-14", "fibonacci-11"),
    "ieee": ("faces-corners-14", "all-26", "fibonacci-30"),
}
exactly = partial(mp.fit, orientation_sd=0, exclude="none")
TETRAHEDRON = {"up_x": [1, 1, -1, -1, 1], "up_y": [1, -1, 1, -1, 0.5], "up_z": [1, -1, -1, 1, -2]}


@st.composite
def problems(draw, models=tuple(SCHEMES)):
    """A model that its scheme can separate, and readings with noise."""
    model = draw(st.sampled_from(models))
    name = draw(st.sampled_from(SCHEMES[model]))
    up = mp.read_scheme(TETRAHEDRON if name == "tetrahedron" else name).up
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    matrix = np.eye(3) + rng.uniform(-0.05, 0.05, (3, 3))
    values = rng.uniform(-0.1, 0.1, 3) + up @ matrix.T + 0.03 * up**2
    return model, up, values + 1e-3 * rng.standard_normal(values.shape), rng


def close(found, expected, scale=1.0):
    # ten digits: condition below 1e3, and a covariance takes it squared
    assert_allclose(found, expected, rtol=1e-9, atol=1e-10 * scale)


@given(problems())
def test_the_order_of_the_positions_does_not_matter(problem):
    model, up, values, rng = problem
    order = rng.permutation(len(up))
    one = exactly(mp.Readings(values, up=up), model=model)
    other = exactly(mp.Readings(values[order], up=up[order]), model=model)
    close(other.parameters, one.parameters)
    close(other.covariance, one.covariance, 1e-6)
    close(other.residuals, one.residuals[order])
    close(other.rms, one.rms)


@given(problems(), st.sampled_from([1e-12, 1e-3, 9.80665, 16384.0, 1e15]))
def test_a_change_of_units_scales_everything(problem, unit):
    model, up, values, _ = problem
    one = exactly(mp.Readings(values, up=up), model=model)
    other = exactly(mp.Readings(unit * values, up=up), model=model)
    close(other.parameters / unit, one.parameters)
    close(other.covariance / unit**2, one.covariance, 1e-6)
    close(other.residuals / unit, one.residuals)
    close(other.rms, one.rms)  # in g
    close(other.compensate(unit * values), one.compensate(values))
    for output in one.outputs:
        for key, value in one.linearity[output].items():
            close(other.linearity[output][key], value)


@given(problems(("linear",)))
def test_a_rotation_of_the_case_rotates_the_answer(problem):
    """The linear model names no axis of its own, so in a turned case M turns with the case."""
    model, up, values, rng = problem
    turn = Rotation.random(random_state=rng.integers(2**31)).as_matrix()
    one = exactly(mp.Readings(values, up=up), model=model)
    other = exactly(mp.Readings(values, up=up @ turn.T), model=model)
    for before, after in zip(one.model.slices, other.model.slices, strict=True):
        a, b = one.parameters[before], other.parameters[after]
        close(b[0], a[0])
        close(b[1:], turn @ a[1:])
        whole = np.block([[np.eye(1), np.zeros((1, 3))], [np.zeros((3, 1)), turn]])
        close(
            other.covariance[after, after], whole @ one.covariance[before, before] @ whole.T, 1e-6
        )
    close(other.residuals, one.residuals)
    close(other.compensate(values), one.compensate(values) @ turn.T)


@given(problems(), st.permutations(range(3)))
def test_renaming_the_axes_permutes_the_answer(problem, order):
    """A quarter turn of the case with its outputs: any model names its axes alike."""
    model, up, values, _ = problem
    order = list(order)
    one = exactly(mp.Readings(values, up=up), model=model)
    other = exactly(mp.Readings(values[:, order], up=up[:, order]), model=model)
    old = dict(zip("xyz", ("xyz"[i] for i in order), strict=True))
    for i, output in enumerate(other.outputs):
        for term in other.model.terms[i]:
            renamed = "".join(old.get(letter, letter) for letter in str(term))
            p, q = other[output, str(term)], one[one.outputs[order[i]], renamed]
            close([p.value, p.u, p.dof], [q.value, q.u, q.dof], 1e-3)


@given(problems(), st.integers(2, 4))
def test_repeating_the_scheme_divides_the_covariance(problem, times):
    model, up, values, _ = problem
    one = with_known_noise(exactly(mp.Readings(values, up=up), model=model, reading_sd=1.0))
    again = mp.Readings(np.tile(values, (times, 1)), up=np.tile(up, (times, 1)))
    many = with_known_noise(exactly(again, model=model, reading_sd=1.0))
    close(many.parameters, one.parameters)
    close(times * many.covariance, one.covariance)


@pytest.fixture(params=[("faces-6", 1e-3), ("faces-corners-14", None), ("fibonacci-24", None)])
def placed(request):
    """Directions and readings at positions that are off by .3 degrees, and what is stated."""
    name, sd = request.param
    up = mp.read_scheme(name).up
    rng = np.random.default_rng(len(up))
    stood = up + np.cross(np.radians(0.3) * rng.standard_normal(up.shape), up)
    stood /= np.linalg.norm(stood, axis=1)[:, None]
    matrix = np.eye(3) + rng.uniform(-0.05, 0.05, (3, 3))
    values = rng.uniform(-0.1, 0.1, 3) + stood @ matrix.T
    return up, values + 1e-3 * rng.standard_normal(values.shape), {"reading_sd": sd}


def found(up, values, unit=1.0, reading_sd=None):
    """Parameters and U of a fit that estimates orientation errors."""
    sd = None if reading_sd is None else unit * reading_sd
    cal = mp.fit(mp.Readings(unit * values, up=up), reading_sd=sd)
    assert cal.estimator == "uncertain-orientation"
    return cal.parameters / unit, cal.U / unit


def alike(found, expected):
    """Within a hundredth of U, and U within a hundredth."""
    assert np.abs((found[0] - expected[0]) / expected[1]).max() < 0.01
    assert_allclose(found[1], expected[1], rtol=0.01)


@pytest.mark.parametrize("unit", [1e-6, 16384.0])
def test_units_do_not_matter_where_orientation_errors_are_estimated(placed, unit):
    up, values, stated = placed
    alike(found(up, values, unit, **stated), found(up, values, **stated))


def test_order_and_case_do_not_matter_where_orientation_errors_are_estimated(placed):
    up, values, stated = placed
    one = found(up, values, **stated)
    order = np.random.default_rng(1).permutation(len(up))
    alike(found(up[order], values[order], **stated), one)
    turn = Rotation.from_rotvec([0.1, -0.2, 0.15]).as_matrix()
    whole = np.kron(np.eye(3), np.block([[np.eye(1), np.zeros((1, 3))], [np.zeros((3, 1)), turn]]))
    parameters, U = found(up @ turn.T, values, **stated)
    assert np.abs((whole.T @ parameters - one[0]) / one[1]).max() < 0.01
    assert_allclose(U[::4], one[1][::4], rtol=0.01)  # of biases, which no turn mixes
