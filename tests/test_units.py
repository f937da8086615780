"""Degrees with exact zeros, normal gravity by its tables, and the units of coefficients."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from multipos.units import cos_deg, gravity_ratio, normal_gravity, sin_deg, unit_per


def test_exact_angles_are_exact():
    turn = np.arange(-720, 721, 90)
    assert_array_equal(sin_deg(turn), [round(math.sin(math.radians(t))) for t in turn.tolist()])
    assert_array_equal(cos_deg(turn), [round(math.cos(math.radians(t))) for t in turn.tolist()])
    assert_array_equal(sin_deg([30, 150, 210, -30, 390]), [0.5, 0.5, -0.5, -0.5, 0.5])
    assert_array_equal(cos_deg([60, 120, 300, -60, 420]), [0.5, -0.5, 0.5, 0.5, 0.5])
    assert_array_equal(sin_deg([45, 135]), cos_deg([45, -45]))
    assert not np.signbit(sin_deg([0, 180, -180, 360])).any()


@given(st.floats(-1e4, 1e4))
def test_sine_and_cosine_are_those_of_radians(angle):
    # the reduction of radians loses eps of the angle, that of degrees nothing
    atol = 4e-16 * max(1.0, math.radians(abs(angle)))
    assert_allclose(sin_deg(angle), math.sin(math.radians(angle)), rtol=0, atol=atol)
    assert_allclose(cos_deg(angle), math.cos(math.radians(angle)), rtol=0, atol=atol)


@given(st.floats(-360, 360))
def test_sine_is_odd_and_cosine_even(angle):
    assert sin_deg(-angle) == pytest.approx(-float(sin_deg(angle)), abs=1e-15)
    assert cos_deg(-angle) == cos_deg(angle)


# NIMA TR8350.2: table 3.4 (gravity at the equator and the poles) and the sea-level formula at 45°
# as ICAO's standard atmosphere quotes it to seven digits, 9.806198 m/s².
@pytest.mark.parametrize(
    ("latitude", "gravity", "atol"),
    [
        (0, 9.7803253359, 1e-10),
        (90, 9.8321849378, 1e-9),
        (-90, 9.8321849378, 1e-9),
        (45, 9.8061977, 1e-7),
    ],
)
def test_normal_gravity_at_sea_level(latitude, gravity, atol):
    assert normal_gravity(latitude) == pytest.approx(gravity, abs=atol)


def test_normal_gravity_falls_with_height():
    # free-air gradient −0.3086 mGal/m, to the per mil that it changes with latitude
    slope = (normal_gravity(45, 100) - normal_gravity(45)) / 100
    assert slope == pytest.approx(-3.086e-6, rel=2e-3)
    assert normal_gravity(45, -100) > normal_gravity(45)


def test_normal_gravity_at_a_height_by_hand():
    """At 45° 1 + f + m − 2 f sin² is 1 + m, m = 0.00344979, and a = 6378137 m.

    At 10 km: 1 − 2 · 1.00344979 · 1e4/a + 3e8/a² = 1 − 3.1465265e-3 + 7.3745e-6 = 0.9968608.
    At the equator 1 + f + m, at the pole 1 − f + m, with f = 1/298.257.
    """
    for latitude, first in ((45, 1.00344979), (0, 1.00680260), (90, 1.00009698)):
        factor = 1 - 2 * first * 1e4 / 6378137 + 3 * (1e4 / 6378137) ** 2
        found = normal_gravity(latitude, 1e4) / normal_gravity(latitude)
        assert found == pytest.approx(factor, abs=1e-10)


@pytest.mark.parametrize("place", [(91, 0), (math.nan, 0), (0, math.nan), (0, 1e6), (0, -2000)])
def test_normal_gravity_refuses_places_that_are_not(place):
    with pytest.raises(ValueError, match="must lie between"):
        normal_gravity(*place)


def test_gravity_ratio_is_of_standard_gravity():
    assert gravity_ratio(None) == 1.0
    assert gravity_ratio(9.80665) == 1.0
    assert gravity_ratio(9.80665 / 2) == 0.5


@pytest.mark.parametrize(
    ("arguments", "unit"),
    [
        (("V", 0), "V"),
        (("V", 1), "V/g"),
        (("V", 2), "V/g^2"),
        (("g", 0), "g"),
        (("g", 1), "1"),
        (("g", 2), "1/g"),
        (("g", 3), "1/g^2"),
        (("V", 0, (("temperature", 2),)), "V/degC^2"),
        (("V", 1, (("temperature", 1),)), "V/g/degC"),
        (("g", 1, (("ambient_p", 1),)), "1/ambient_p"),
    ],
)
def test_units_of_coefficients(arguments, unit):
    assert unit_per(*arguments) == unit
