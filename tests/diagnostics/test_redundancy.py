"""What nothing checks, what positions hardly tell, and rows that make a fit impossible."""

import numpy as np
import pytest
from findings_bench import EXACT, texts

import multipos as mp
from multipos.diagnostics.repairs import rows_in_another_unit
from multipos.errors import MultiposError
from multipos.units import STANDARD_GRAVITY

UP = mp.read_scheme("icosahedron-12").up


def readings(factor=1.0, rows=()):
    values = [0.1, -0.2, 0.05] + UP * [1.02, 0.97, 1.0]
    values += 1e-3 * np.random.default_rng(1).standard_normal(values.shape)
    values[list(rows)] *= factor
    return mp.Readings(values)


def codes(cal):
    return [finding.code for finding in cal.diagnostics.findings]


@pytest.mark.parametrize("factor", [STANDARD_GRAVITY, 1 / STANDARD_GRAVITY, 1e3, 1e-3])
@pytest.mark.parametrize("rows", [(4,), (0, 7, 9)], ids=len)
def test_rows_in_another_unit_are_named_where_no_orientation_is_known(factor, rows):
    labels = [str(row + 1) for row in rows]
    with pytest.raises(MultiposError) as caught:
        mp.fit(readings(factor, rows), unknown_orientation=True, exclude="none")
    assert f"{', '.join(labels)} look" in str(caught.value)
    assert f"{factor:.4g} times the others" in str(caught.value)


def test_half_of_the_rows_in_another_unit_are_named():
    found, factor = rows_in_another_unit(readings(STANDARD_GRAVITY, range(6)))
    assert found == ("1", "2", "3", "4", "5", "6")
    assert factor == pytest.approx(STANDARD_GRAVITY)


def test_good_rows_and_ones_beyond_any_unit_are_none():
    assert rows_in_another_unit(readings())[0] == ()
    assert rows_in_another_unit(readings(100.0, (3,)))[0] == ()  # by no factor of units
    noise = mp.Readings(np.random.default_rng(2).standard_normal((12, 3)))
    with pytest.raises(MultiposError):  # no calibration of noise, whatever the reason told
        mp.fit(noise, unknown_orientation=True)


def test_as_many_terms_as_positions_are_said():
    """Of twelve positions as many terms leave nothing to ask residuals of."""
    up = mp.read_scheme("fibonacci-12").up
    values = up + 1e-3 * np.random.default_rng(0).standard_normal(up.shape)
    powers = " + ".join(f"own^{power}" for power in range(2, 7))
    formula = f"1 + x + y + z + own*other + own*|own| + {powers}"
    cal = mp.fit(mp.Readings(values, up=up), model=formula, **EXACT)
    assert (cal.dof == 0.0).all()
    assert codes(cal) == ["no-redundancy"]


def test_positions_much_alike_are_said():
    """Within half a degree of upright, z is as good as constant: a condition above 10⁴."""
    angles = np.radians(
        [[0.0, 0.0], [0.5, 0.0], [0.0, 0.5], [-0.25, 0.0], [0.0, -0.25], [0.4, 0.4]]
    )
    up = np.column_stack([np.sin(angles), np.sqrt(1.0 - np.sum(np.sin(angles) ** 2, axis=1))])
    values = up + 1e-6 * np.random.default_rng(3).standard_normal(up.shape)
    cal = mp.fit(mp.Readings(values, up=up))
    assert cal.diagnostics.condition > 1e4
    assert "no-redundancy" in codes(cal)
    assert "nearly inseparable at these positions (condition" in texts(cal)[0]


def test_a_scale_factor_that_u_leaves_open_is_said():
    rng = np.random.default_rng(4)
    noisy = mp.Readings(UP + 0.15 * rng.standard_normal(UP.shape), up=UP)
    assert "scale factors are poorly determined: scale_az (U = 27 %)" in " ".join(
        texts(mp.fit(noisy, **EXACT))
    )
    assert "no-redundancy" not in codes(mp.fit(mp.Readings(readings().values, up=UP)))


def test_poses_near_one_direction_that_nothing_contradicts_are_no_result():
    # nine poses within 30° of z: every residual is zero, and 1 mg moves parameters by several g
    rng = np.random.default_rng(1)
    up = rng.standard_normal((4000, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    near, spread = up[up[:, 2] > np.cos(np.radians(30.0))][:9], mp.read_scheme("fibonacci-9").up
    found = {}
    for name, at in (("near", near), ("spread", spread)):
        values = [0.01, -0.02, 0.03] + at * [1.012, 0.991, 1.008]
        values += 1e-4 * rng.standard_normal((9, 3))
        cal = mp.fit(mp.Readings(values, unit="g"), unknown_orientation=True)
        found[name] = cal.findings[0]
    assert (found["near"].code, found["near"].level) == ("no-residuals", "error")
    assert (found["spread"].code, found["spread"].level) == ("no-redundancy", "warning")


def test_a_robust_fit_of_six_faces_is_refused():
    values = mp.read_scheme("faces-6").up + 1e-3
    with pytest.raises(mp.UsageError, match="3 degrees of freedom, and 6 positions leave 2"):
        mp.fit(mp.Readings(values), scheme="faces-6", robust="huber")
