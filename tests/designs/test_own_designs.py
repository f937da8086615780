"""Positions for models of one's own: information at stated parameters, and over a range of tilt."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import multipos as mp
from multipos.designs.prospects import rank_positions
from multipos.positions.scheme import read_scheme

pytestmark = pytest.mark.usefixtures("optima_once")
LINEAR = "each = a + p*x + q*y + r*z"


def test_a_polynomial_written_as_ones_own_is_judged_alike():
    plain = mp.schemes("all-26", "faces-6")
    own = mp.schemes("all-26", "faces-6", model=LINEAR)
    for a, b in zip(plain.schemes, own.schemes, strict=True):
        assert_allclose(b.log_det, a.log_det, rtol=1e-10)
        assert_allclose(list(b.u.values()), list(a.u.values()), rtol=1e-10)
        assert_allclose(b.i_efficiency, a.i_efficiency, rtol=1e-3)  # a sum in place of an integral


def test_the_information_is_that_at_the_stated_parameters(tmp_path):
    """One output by hand: dy/d(b, s, k) of b + s f/(1 + k f²) at s = 1, k = 0.2."""
    path = tmp_path / "own.toml"
    path.write_text('[parameters]\nk = 0.2\ns = 1\n[outputs]\neach = "b + s*own/(1 + k*own^2)"\n')
    found = mp.schemes("fibonacci-12", model=str(path), axes="x").schemes[0]
    f = read_scheme("fibonacci-12").up[:, 0]
    below = 1 + 0.2 * f**2
    X = np.column_stack([np.ones(12), f / below, -(f**3) / below**2])
    assert_allclose(found.log_det, np.linalg.slogdet(X.T @ X / 12)[1], rtol=1e-9)
    assert_allclose(list(found.u.values()), np.sqrt(np.diag(np.linalg.inv(X.T @ X))), rtol=1e-9)


def test_six_faces_cannot_tell_a_saturation():
    found = mp.schemes("faces-6", model="each = b + s*own/(1 + k*own^2)").schemes[0]
    assert not found.identifiable
    assert "s_ax" in found.unidentifiable[0]
    assert "k_ax" in found.unidentifiable[0]


@pytest.mark.parametrize(("offset", "seen"), [(1e-2, True), (1e-14, False)])
def test_what_information_has_no_digits_for_is_not_separated(tmp_path, offset, seen):
    """Of s f/(c + f²/100) nothing but s/k is left where c is 1e-12 of the other term."""
    path = tmp_path / "own.toml"
    formula = f"b + s*own/({offset} + common_k*own^2)"
    path.write_text(f'[parameters]\ns = 1\ncommon_k = 0.01\n[outputs]\neach = "{formula}"\n')
    found = mp.schemes("all-26", model=str(path)).schemes[0]
    assert found.identifiable is seen


@pytest.mark.parametrize(
    ("term", "said"),
    [("k/x^2", "ax has no value at 4 of 6"), ("k*log(own)", "ax has no value at 49 of 100")],
)
def test_positions_where_a_formula_has_no_value_are_counted(term, said):
    """Of six faces four have no force along x; 49 of the 100 directions have less than none."""
    with pytest.raises(mp.MultiposError, match=f"formula of {said} positions; change"):
        mp.schemes("faces-6", model=f"each = b + s*own + {term}")


def test_a_pole_on_the_sphere_is_no_value(tmp_path):
    """1 - 256 z² is zero at z = 1/16, where two of the directions that a search begins with are."""
    path = tmp_path / "own.toml"
    path.write_text('[parameters]\nk = -256\n[outputs]\neach = "b + own/(1 + k*own^2)"\n')
    with pytest.raises(mp.MultiposError, match=r"formula of az has no value at 2 of 106 positions"):
        mp.schemes("all-26", model=str(path))


def test_shared_parameters_are_told_by_all_outputs():
    found = mp.schemes("all-26", model="each = b + s*own + common_k*own^2").schemes[0]
    up = read_scheme("all-26").up
    X = np.zeros((3, 26, 7))
    for i in range(3):
        X[i, :, 2 * i], X[i, :, 2 * i + 1], X[i, :, 6] = 1.0, up[:, i], up[:, i] ** 2
    M = np.einsum("mnp,mnq->pq", X, X)
    assert_allclose(found.u["common:common_k"], np.linalg.inv(M)[6, 6] ** 0.5, rtol=1e-9)


def test_a_prior_spreads_a_design(tmp_path):
    """The mean of ln det over the prior is better than that of the design for its centre."""

    def design(sd):
        path = tmp_path / "own.toml"
        path.write_text(
            f"[parameters]\nk = {{start = 2, sd = {sd}}}\ns = 1\n"
            '[outputs]\neach = "b + s*own/(1 + k*own^2)"\n'
        )
        return mp.design(str(path), 6, axes="x").positions[:, 0]

    def mean_log_det(f):
        total = 0.0
        for k in (2 - 1.5, 2 + 1.5):
            below = 1 + k * f**2
            X = np.column_stack([np.ones(len(f)), f / below, -(f**3) / below**2])
            total += np.linalg.slogdet(X.T @ X)[1] / 2
        return total

    assert mean_log_det(design(1.5)) > mean_log_det(design(1e-6)) + 1e-3


def tilt_variance(positions, degrees=30.0):
    """Mean variance of tilt of x and y of a nominal triad of unit noise, over ± degrees."""
    X = np.column_stack([np.ones(len(positions)), positions])
    C = np.linalg.inv(X.T @ X)  # of each output
    total, count = 0.0, 0
    for a in np.radians(np.linspace(-degrees, degrees, 7)):
        for b in np.radians(np.linspace(-degrees, degrees, 7)):
            up = np.array([np.sin(a), np.sin(b), 0.0])
            up[2] = np.sqrt(1 - up @ up)
            spread = np.array([1.0, *up]) @ C @ np.array([1.0, *up])
            for i in range(2):  # a turn by t: every output contributes, at right angles to up
                t = (np.eye(3)[i] - up * up[i]) / np.sqrt(1 - up[i] ** 2)
                total += spread * (t @ t)
                count += 1
    return total / count


def test_a_design_for_tilt_serves_tilt():
    tilt = mp.design("linear", 8, criterion="tilt:±30")
    plain = mp.design("linear", 8)
    assert tilt.efficiency > 0.99
    assert tilt_variance(tilt.positions) < 0.9 * tilt_variance(plain.positions)


@pytest.mark.parametrize("name", ["tilt:", "tilt:x", "tilt:0", "tilt:95", "force:2"])
def test_a_range_that_is_none(name):
    with pytest.raises(mp.UsageError, match=r"give (tilt|force):±SIZE"):
        mp.design("linear", 8, criterion=name)


def test_unknown_orientations_of_a_polynomial_written_as_ones_own():
    """What a rotation leaves free is held: slopes above the diagonal, as in the lower gauge."""
    plain = mp.schemes("all-26", unknown_orientation=True).schemes[0]
    own = mp.schemes("all-26", model=LINEAR, unknown_orientation=True).schemes[0]
    assert_allclose(own.log_det, plain.log_det, rtol=1e-9)
    assert_allclose(sorted(own.u.values()), sorted(plain.u.values()), rtol=1e-9)
    best = mp.design(LINEAR, 12, unknown_orientation=True)
    assert_allclose(best.log_det, best.optimum_log_det, rtol=1e-6)  # the icosahedron
    assert best.certificate["parameters"] == 9


def test_unknown_orientations_of_a_saturating_triad_by_hand(tmp_path):
    """The size of f = h⁻¹(y): n ~ u/J by outputs, J = (1 − k u²)/(1 + k u²)² at s = 1, k = 0.2."""
    path = tmp_path / "own.toml"
    path.write_text('[parameters]\nk = 0.2\ns = 1\n[outputs]\neach = "b + s*own/(1 + k*own^2)"\n')
    (found,) = mp.schemes("fibonacci-24", model=str(path), unknown_orientation=True).schemes
    u = read_scheme("fibonacci-24").up
    below = 1 + 0.2 * u**2
    normal = u * below**2 / (1 - 0.2 * u**2)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    X = np.stack([np.ones_like(u), u / below, -(u**3) / below**2], axis=2)
    rows = (normal[:, :, None] * X).reshape(24, 9)
    assert_allclose(list(found.u.values()), np.sqrt(np.diag(np.linalg.inv(rows.T @ rows))))
    assert found.dof == {"all": 15}


def test_a_column_that_no_position_sets_is_refused():
    with pytest.raises(mp.UsageError, match="column 'temperature', which a position does not set"):
        mp.schemes("faces-6", model="each = b + s*own*temperature")


def test_one_more_position_brings_what_a_polynomial_says():
    up = read_scheme("all-26").up
    values = up + 1e-4 * np.random.default_rng(1).standard_normal(up.shape)
    data = mp.Readings(values, up=up)
    plain, own = (rank_positions(cal)[1] for cal in (mp.fit(data), mp.fit(data, model=LINEAR)))
    assert_allclose(own, plain, rtol=1e-6)
