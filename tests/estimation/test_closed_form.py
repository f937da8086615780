"""The six-position inversion against the paper's figures, its equations, and least squares."""

import itertools
import json

import numpy as np
import pytest
from amounts import exactly
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from multipos import evaluate_budget, fit, load
from multipos.errors import MultiposError, UsageError
from multipos.estimation.closed_form import closed_form_weights, six_positions
from multipos.positions.readings import Readings
from multipos.positions.scheme import read_scheme
from multipos.song_qin import PRINTED, TABLE_2

FACES = read_scheme("faces-6").up


def test_eqs_2_to_4_of_the_paper_as_printed():
    a = dict(zip(range(1, 7), TABLE_2, strict=True))
    ax, ay, az = ({k: row[i] for k, row in a.items()} for i in range(3))
    by_hand = np.array(
        [
            # below eq. (2)
            (ax[1] + ax[2] + ax[4] + ax[6]) / 4,
            (ax[3] - ax[5]) / 2,
            (ax[4] - ax[1]) / 2,
            (ax[6] - ax[2]) / 2,
            (-ax[1] - ax[2] + 2 * ax[3] - ax[4] + 2 * ax[5] - ax[6]) / 4,
            # below eq. (3): 1, x, y, z, own²
            (ay[2] + ay[3] + ay[5] + ay[6]) / 4,
            (ay[3] - ay[5]) / 2,
            (ay[4] - ay[1]) / 2,
            (ay[6] - ay[2]) / 2,
            (2 * ay[1] - ay[2] - ay[3] + 2 * ay[4] - ay[5] - ay[6]) / 4,
            # below eq. (4)
            (az[1] + az[3] + az[4] + az[5]) / 4,
            (az[3] - az[5]) / 2,
            (az[4] - az[1]) / 2,
            (az[6] - az[2]) / 2,
            (-az[1] + 2 * az[2] - az[3] - az[4] - az[5] + 2 * az[6]) / 4,
        ]
    )
    for closed in (True, False):
        found = fit(TABLE_2_READINGS, model="own-quadratic", closed_form=closed, **PAPER)
        assert_allclose(found.parameters, by_hand, rtol=0, atol=1e-15)


PAPER = {"scheme": "song-qin-6", "convention": "gravity"}
TABLE_2_READINGS = Readings(TABLE_2, unit="g")


def test_the_printed_figures_but_two():
    found = fit(TABLE_2_READINGS, model="own-quadratic", closed_form=True, **PAPER)
    off = np.flatnonzero(np.abs(found.parameters - PRINTED.ravel()) > 1e-11)
    assert [found.names[i] for i in off] == ["scale_ay", "quad_ay"]
    assert found["ay", "y"].value == pytest.approx(1.002959754, abs=5e-13)
    assert PRINTED[1, 2] == -TABLE_2[0, 1]  # S_ay as printed is −A_y1
    assert found["ay", "y^2"].value - PRINTED[1, 4] == pytest.approx(1.5e-8, abs=5e-10)


def test_what_six_positions_leave():
    found = fit(TABLE_2_READINGS, model="own-quadratic", **PAPER)
    # the contrast of y by hand: the pairs of positions 2, 6 and 3, 5, a quarter each
    quarter = (TABLE_2[1, 1] + TABLE_2[5, 1] - TABLE_2[2, 1] - TABLE_2[4, 1]) / 4
    assert_allclose(found.residuals[:, 1], quarter * np.array([0, 1, -1, 0, -1, 1]), atol=1e-16)
    assert abs(quarter) == pytest.approx(6.39e-3, abs=5e-6)
    assert found.residual_sd[1] == pytest.approx(2 * abs(quarter), rel=1e-12)
    assert found.residual_sd[1] == pytest.approx(12.8e-3, abs=5e-5)
    bias = found["ay", "1"]
    assert (bias.dof, bias.k) == (1, pytest.approx(12.706, abs=5e-4))
    assert bias.u == pytest.approx(found.residual_sd[1] / 2)  # a mean of four
    assert abs(bias.U - 0.081) < 5e-4


orders = st.permutations(range(6))
units = st.sampled_from([1e-9, 1.0, 9.80665, 16384.0, 1e12])
gravities = st.sampled_from([None, 9.780, 9.80665, 9.832])


@given(
    orders,
    units,
    gravities,
    st.integers(0, 2**32 - 1),
    st.booleans(),
    st.sampled_from(["own-quadratic", "linear"]),
)
def test_closed_form_is_least_squares(order, unit, gravity, seed, down, model):
    rng = np.random.default_rng(seed)
    up = FACES[list(order)]
    f = -up if down else up
    parameters = np.array([0.1, 1, 0.1, 0.1, 0.05]) * rng.uniform(-1, 1, (3, 5))
    parameters[[0, 1, 2], [1, 2, 3]] += 2
    values = np.column_stack(
        [p[0] + f @ p[1:4] + p[4] * f[:, i] ** 2 for i, p in enumerate(parameters)]
    )
    readings = Readings((values + 0.01 * rng.standard_normal((6, 3))) * unit, up=up)
    options = {"convention": "gravity" if down else "specific-force", "gravity": gravity}
    direct = exactly(readings, model=model, closed_form=True, **options)
    fitted = exactly(readings, model=model, **options)
    largest = np.abs(readings.values).max()
    assert_allclose(direct.parameters, fitted.parameters, rtol=0, atol=1e-12 * largest)
    assert_allclose(direct.residuals, fitted.residuals, rtol=0, atol=1e-12 * largest)
    assert_allclose(
        direct.covariance,
        fitted.covariance,
        rtol=1e-10,
        atol=1e-12 * np.abs(fitted.covariance).max(),
    )
    assert direct.cross_check == fitted.cross_check < 1e-12
    assert (direct.estimator, fitted.estimator) == ("closed-form", "linear")


@given(orders, st.sampled_from([1.0, 0.9973]))
def test_the_positions_are_found_in_any_order(order, g):
    reference = g * FACES[list(order)]
    rows = six_positions(reference)
    assert rows is not None
    for axis, side in itertools.product(range(3), range(2)):
        wanted = np.zeros(3)
        wanted[axis] = g * (1 - 2 * side)
        assert_array_equal(reference[rows[axis, side]], wanted)
    # the weights undo the design: they are a left inverse of it
    for own in range(3):
        design = np.column_stack([np.ones(6), reference, reference[:, own] ** 2])
        assert_allclose(closed_form_weights(reference, rows, own) @ design, np.eye(5), atol=1e-15)
        linear = closed_form_weights(reference, rows, own, quadratic=False)
        assert_allclose(linear @ design[:, :4], np.eye(4), atol=1e-15)


def test_other_positions_are_not_six_positions():
    assert six_positions(FACES[[0, 0, 2, 3, 4, 5]]) is None
    assert six_positions(FACES[:5]) is None
    assert six_positions(read_scheme("fibonacci-6").up) is None
    tilted = FACES.copy()
    tilted[0] = [1, 1e-6, 0]
    assert six_positions(tilted) is None


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"scheme": "faces-6", "model": "ieee"}, UsageError, "got 'ieee'; leave out --closed-form"),
        ({"scheme": "faces-6", "drift": True}, UsageError, "--closed-form and --drift contradict"),
        ({"scheme": "fibonacci-6"}, MultiposError, "needs six readings, each axis once up and"),
    ],
)
def test_the_closed_form_refuses_what_it_cannot(options, error, message):
    with pytest.raises(error, match=message):
        fit(TABLE_2_READINGS, closed_form=True, **options)


def test_a_closed_form_at_other_positions_has_no_budget(tmp_path):
    content = fit(TABLE_2_READINGS, closed_form=True, **PAPER).to_dict()
    content["reference"][0] = [0.6, 0.8, 0.0]
    (tmp_path / "c.json").write_text(json.dumps(content))
    with pytest.raises(MultiposError, match="needs six readings, each axis once up"):
        evaluate_budget(load(tmp_path / "c.json"))


def test_the_cross_check_is_there_for_six_positions_whatever_the_model():
    readings = Readings(TABLE_2)
    for model in ("linear", "1 + own", "own-quadratic"):
        assert fit(readings, scheme="faces-6", model=model).cross_check < 1e-12
    assert fit(Readings(TABLE_2[:, :1]), scheme="faces-6").cross_check < 1e-12
    twelve = Readings(np.vstack([TABLE_2, TABLE_2]))
    assert fit(twelve, scheme="faces-6+faces-6").cross_check is None
    assert fit(readings, scheme="fibonacci-6").cross_check is None


def test_unequal_noise_leaves_its_own_covariance():
    rng = np.random.default_rng(1)
    u = rng.uniform(0.5, 2, (6, 3)) * 1e-3
    readings = Readings(TABLE_2, u=u)
    found = fit(readings, scheme="song-qin-6", model="own-quadratic", closed_form=True)
    # S of x by hand: half the difference of the readings with x up and x down
    variance = (u[2, 0] ** 2 + u[4, 0] ** 2) / 4
    factor = 1.0 if np.isinf(found.dof[0]) else found.covariance[1, 1] / variance
    assert found["ax", "x"].u ** 2 == pytest.approx(variance * factor, rel=1e-12)
