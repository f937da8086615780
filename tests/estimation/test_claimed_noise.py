"""Stated uncertainties that are themselves estimates of few degrees of freedom."""

import numpy as np
import pytest
from scipy import special

import multipos as mp
from multipos.estimation.stated_uncertainty import (
    StatedNoise,
    combined_dof,
    combined_jointly,
    shrink_variances,
    shrunk,
)
from multipos.numerics.polygamma import inverse_trigamma

UP = mp.read_scheme("faces-6").up


def readings(u, dof, values=UP):
    u = np.broadcast_to(u, values.shape)
    return mp.Readings(values, up=UP, u=u, dof=None if dof is None else np.full(u.shape, dof))


def test_uncertainties_that_differ_by_chance_become_one():
    rng = np.random.default_rng(1)
    u = np.sqrt(rng.chisquare(4.0, (6, 3)) / 4.0)
    u /= np.exp(0.25 * (np.log(u) - np.log(u).mean()))  # a little closer than by chance
    found = shrink_variances(readings(u, 4.0)).u
    pooled = np.sqrt(np.mean(u**2, axis=0))  # all have four degrees of freedom
    np.testing.assert_allclose(found, pooled * np.ones((6, 1)), rtol=1e-9)


def test_uncertainties_that_differ_indeed_stay_and_known_ones_are_not_touched():
    u = np.geomspace(1.0, 1e4, 6)[:, None] * np.ones(3)
    found = shrink_variances(readings(u, 8.0)).u
    assert (np.diff(found, axis=0) > 0.0).all()
    assert np.abs(np.log(found / u)).max() < np.log(2.0)  # of a range of 1e4
    # eqs. (1), (2) of estimation.stated_uncertainty, with SciPy's functions
    e = np.log(u[:, 0] ** 2) - special.digamma(4.0) + np.log(4.0)
    excess = e.var(ddof=1) - special.polygamma(1, 4.0)
    prior = 2.0 * float(inverse_trigamma(excess))
    common = np.exp(e.mean() + special.digamma(prior / 2) - np.log(prior / 2))
    expected = np.sqrt((prior * common + 8.0 * u[:, 0] ** 2) / (prior + 8.0))
    np.testing.assert_allclose(found[:, 0], expected, rtol=1e-9)
    np.testing.assert_array_equal(shrink_variances(readings(u, 1e6)).u, u)
    np.testing.assert_array_equal(shrink_variances(readings(u, None)).u, u)


def test_outputs_and_units_are_drawn_together_each_by_itself():
    rng = np.random.default_rng(2)
    dof = rng.choice([4.0, 30.0, 1e6, np.inf], (5, 8, 3))  # some are known
    dof[0, :6, 1] = 1e6  # two cannot tell what they have in common
    u = np.exp(rng.standard_normal((5, 8, 3)) * rng.uniform(0.0, 2.0, (5, 1, 3)))
    found = shrunk(u, dof)
    for unit, output in np.ndindex(5, 3):
        own = np.s_[unit, :, output]
        alone = shrunk(u[own][None, :, None], dof[own][None, :, None])
        np.testing.assert_allclose(found[own], alone[0, :, 0], rtol=1e-13)
    np.testing.assert_array_equal(found[dof >= 1e6], u[dof >= 1e6])
    np.testing.assert_array_equal(found[0, :, 1], u[0, :, 1])


def test_k_is_that_of_the_claim_where_nothing_else_tells():
    """Four positions for four terms leave no residual: ν is that of the floors, 4 × 5."""
    up = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [-0.6, -0.48, -0.64]])
    u = np.full(up.shape, 1e-3)
    cal = mp.fit(mp.Readings(up, up=up, u=u, dof=np.full(up.shape, 5.0)))
    np.testing.assert_allclose(cal.parameter_dof, 20.0, rtol=1e-9)
    np.testing.assert_allclose(cal.k, 2.0860, atol=1e-4)  # t at 0.975, by table
    np.testing.assert_allclose(cal.u, mp.fit(mp.Readings(up, up=up, u=u)).u, rtol=1e-12)


def test_degrees_of_freedom_in_a_file(tmp_path):
    path = tmp_path / "readings.csv"
    lines = ["position,up_x,up_y,up_z,ax,ay,az,u_ax,u_ay,u_az,dof_ax,dof_ay,dof_az"]
    for i, row in enumerate(UP):
        cells = [*row, *(row + 1e-4 * i), 1e-3, 1e-3, 1e-3, 5, 6, 7]
        lines.append(f"{i}," + ",".join(f"{cell:g}" for cell in cells))
    path.write_text("\n".join(lines) + "\n")
    found = mp.read_readings(path)
    assert found.outputs == ("ax", "ay", "az")
    np.testing.assert_array_equal(found.dof[0], [5, 6, 7])
    path.write_text(path.read_text().replace(",5,6,7\n", ",5,6,0\n", 1))
    with pytest.raises(mp.MultiposError, match=r"column 'dof_az'.*is not above 0"):
        mp.read_readings(path)


def test_degrees_of_freedom_of_noise_half_of_which_is_stated_by_hand():
    """Variances 1 and 3 on 2 and 9, and as much again unstated, w = 1/2, on 8.

    ν_c = 4²/(1/2 + 9/9) = 32/3, 1/ν' = 1/8 + (1/4)/(32/3) = 19/128.
    """
    # eq. (3) of estimation.stated_uncertainty
    variance, stated_dof = np.array([[[1.0], [3.0]]]), np.array([[[2.0], [9.0]]])
    found = combined_dof(np.array([[8.0]]), variance, stated_dof, np.array([[2.0]]))
    np.testing.assert_allclose(found, 128 / 19, rtol=1e-12)
    noise = StatedNoise(np.sqrt(variance), stated_dof, np.array([True]))
    found = combined_jointly(np.array([[8.0]]), noise, np.array([[2.0]]))
    np.testing.assert_allclose(found, 128 / 19, rtol=1e-12)


def test_rests_of_few_degrees_of_freedom_are_weighed_by_their_samples():
    """N u² is 1, 2, 4, 8, 16, 32 and 2 and 3 times that: the fifth of eighteen is 4."""
    # eq. (1a) of estimation.stated_uncertainty
    samples = np.array([4.0, 1.0, 2.0, 16.0, 5.0, 8.0])
    u = np.sqrt(np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0]) / samples)[:, None] * np.sqrt(
        [1.0, 2.0, 3.0]
    )
    known = mp.Readings(UP, up=UP, u=u, dof=np.full(u.shape, 5.0), samples=samples)
    found = shrink_variances(known).u
    np.testing.assert_allclose(found, np.sqrt(4.0 / samples)[:, None] * np.ones(3), rtol=1e-12)
