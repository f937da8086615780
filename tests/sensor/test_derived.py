"""What is derived from a calibration: hand cases, and uncertainties by finite differences."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from multipos.sensor.derived import installation_deg, intrinsic
from multipos.sensor.model import build_model

TRIAD = ("ax", "ay", "az"), ("x", "y", "z")


def linear(bias, matrix, model="linear"):
    """Parameters of a triad with this bias and matrix; what else the model has is zero."""
    built = build_model(model, *TRIAD)
    parameters = np.zeros(len(built.keys))
    for i, output in enumerate(built.outputs):
        parameters[built.index(output, "1")] = bias[i]
        for j, axis in enumerate("xyz"):
            parameters[built.index(output, axis)] = matrix[i][j]
    return built, parameters


def values(found):
    return {name: [entry["value"] for entry in group.values()] for name, group in found.items()}


def test_a_turned_ideal_triad():
    # eqs. (1), (3) of sensor.derived
    rho_deg = np.array([1.5, -2.0, 0.7])
    # readings see the case's force in sensor axes, so the rows of M are those axes
    axes = Rotation.from_rotvec(rho_deg, degrees=True).as_matrix().T
    scale = np.array([2.0, 3.0, 4.0])
    built, parameters = linear([0.2, 0.6, -0.4], scale[:, None] * axes, "ieee")
    found = values(intrinsic(built, parameters, np.zeros((len(parameters),) * 2), {}))
    assert_allclose(found["sensitivity"], scale, rtol=1e-14)
    assert_allclose(found["offset"], [0.1, 0.2, -0.1], rtol=1e-14)
    assert_allclose(found["angle_deg"], [90, 90, 90], rtol=1e-13)
    assert_allclose(found["mounting_deg"], rho_deg, rtol=1e-12)


def test_angles_and_leans_by_hand():
    # eqs. (2), (4) of sensor.derived
    half = np.sqrt(0.5)
    built, parameters = linear([0, 0, 0], [[1, 0, 0], [half, half, 0], [0, 0, 2]])
    zero = np.zeros((12, 12))
    assert_allclose(values(intrinsic(built, parameters, zero, {}))["angle_deg"], [45, 90, 90])
    lean = installation_deg(built, parameters, zero, {})
    assert {k: round(v["value"], 12) for k, v in lean.items()} == {
        "xy": 0,
        "xz": 0,
        "yx": 45,
        "yz": 0,
        "zx": 0,
        "zy": 0,
    }
    # the axis of output y leans towards x: the mounting turns z half of it, the wrong way round
    mounting = values(intrinsic(built, parameters, zero, {}))["mounting_deg"]
    assert_allclose(mounting, [0, 0, -22.5], atol=1e-12)


def test_small_angles_are_the_cross_terms():
    eps = 1e-7  # [rad]; squares are below the rounding of the test
    built, parameters = linear([0] * 3, [[1, eps, 2 * eps], [3 * eps, 1, 4 * eps], [5e-7, 6e-7, 1]])
    zero = np.zeros((12, 12))
    lean = np.radians([v["value"] for v in installation_deg(built, parameters, zero, {}).values()])
    assert_allclose(lean, eps * np.arange(1, 7), rtol=1e-6)
    found = values(intrinsic(built, parameters, zero, {}))
    assert_allclose(
        np.radians(90 - np.array(found["angle_deg"])), np.array([4, 7, 10]) * eps, rtol=1e-6
    )
    # the skew part of M: axis x towards y is a turn about +z
    assert_allclose(np.radians(found["mounting_deg"]), np.array([-2, 3, -2]) * eps / 2, rtol=1e-6)


@pytest.mark.parametrize("model", ["linear", "own-quadratic"])
def test_uncertainties_against_finite_differences(model):
    rng = np.random.default_rng(8)
    matrix = np.diag([100.0, 110, 90]) + rng.uniform(-5, 5, (3, 3))
    built, parameters = linear(rng.uniform(-0.1, 0.1, 3), matrix, model)
    p = len(parameters)
    root = rng.standard_normal((p, p)) * 0.05
    covariance = root @ root.T

    def flat(b):
        zero = np.zeros((p, p))
        whole = intrinsic(built, b, zero, {}) | {"lean": installation_deg(built, b, zero, {})}
        return np.array([v["value"] for group in whole.values() for v in group.values()])

    steps = 1e-4 * np.eye(p)
    gradient = np.array([(flat(parameters + h) - flat(parameters - h)) / 2e-4 for h in steps])
    expected = np.sqrt(np.einsum("pi,pq,qi->i", gradient, covariance, gradient))
    found = intrinsic(built, parameters, covariance, {})
    found |= {"lean": installation_deg(built, parameters, covariance, {})}
    u = [v["u"] for group in found.values() for v in group.values()]
    assert_allclose(u, expected, rtol=1e-5)


def test_the_linear_part_is_taken_at_a_temperature():
    built = build_model("1 + x + y + z + temperature + temperature*own", *TRIAD)
    parameters = np.zeros(len(built.keys))
    for output, axis in zip(*TRIAD, strict=True):
        parameters[built.index(output, axis)] = 1.0
        parameters[built.index(output, f"temperature*{axis}")] = 0.01
        parameters[built.index(output, "temperature")] = 0.24
    found = intrinsic(built, parameters, np.eye(len(parameters)), {"temperature": 20.0})
    assert found["sensitivity"]["ax"]["value"] == pytest.approx(1.2)
    assert found["sensitivity"]["ax"]["u"] == pytest.approx(np.hypot(1, 20))
    assert found["offset"]["ay"]["value"] == pytest.approx(4.0)


def test_a_left_handed_sensor_has_no_mounting():
    built, parameters = linear([0] * 3, np.diag([1.0, 1.0, -1.0]))
    found = values(intrinsic(built, parameters, np.zeros((12, 12)), {}))
    assert np.isnan(found["mounting_deg"]).all()
    assert_allclose(found["angle_deg"], 90)


def test_an_output_that_does_not_respond_has_no_axis():
    built, parameters = linear([0.1] * 3, np.diag([1.0, 0.0, 1.0]))
    assert intrinsic(built, parameters, np.zeros((12, 12)), {}) is None


@pytest.mark.parametrize(
    ("outputs", "axes", "model", "inputs"),
    [
        (("a", "b"), ("x", "y"), "linear", ("x", "y", "z")),
        (("a", "b", "c"), ("x", "y", "x"), "linear", ("x", "y", "z")),
        (("a", "b", "c"), ("x", "y", "z"), "1 + x", ("x", "y", "z")),
    ],
)
def test_what_is_no_triad_has_no_intrinsics(outputs, axes, model, inputs):
    built = build_model(model, outputs, axes, inputs)
    p = len(built.keys)
    assert intrinsic(built, np.ones(p), np.eye(p), {}) is None


def test_leans_of_what_is_there():
    built = build_model("linear", ("a", "b"), ("y", "z"), ("y", "z"))
    parameters = np.array([0, 1, 0.1, 0, -0.1, 1])
    found = installation_deg(built, parameters, np.zeros((6, 6)), {})
    angle = np.degrees(np.arctan(0.1))
    assert {k: v["value"] for k, v in found.items()} == pytest.approx({"yz": angle, "zy": -angle})
    twice = build_model("linear", ("a", "b"), ("x", "x"))
    assert installation_deg(twice, np.ones(8), np.eye(8), {}) == {}


def test_readings_that_are_all_zero_are_not_divided_by():
    built, parameters = linear([0.0] * 3, np.zeros((3, 3)))
    with np.errstate(all="raise"):
        found = installation_deg(built, parameters, np.zeros((12, 12)), {})
    assert [(lean["value"], lean["u"]) for lean in found.values()] == [(0.0, 0.0)] * 6
