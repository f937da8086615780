"""Known specific forces beside orientations: reading, fitting, and what follows from them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from findings_bench import texts
from numpy.testing import assert_allclose, assert_array_equal

import multipos as mp
from multipos.errors import MultiposError
from multipos.estimation.stated_uncertainty import add_reference_noise
from multipos.positions.scheme import read_scheme

G = 9.81
SIZE = G / 9.80665  # [g], of the local gravity
MODEL = "1 + x + y + z + own^2 + own^3"
TRUTH = np.array([0.01, 1.002, 0.001, -0.002, 3e-4, 2e-5])  # of MODEL, in g
FACES = read_scheme("faces-6").up
CENTRIFUGE = np.outer(np.linspace(-5.0, 5.0, 14), [1.0, 0.0, 0.0])


def _reading(force, noise=0.0, seed=1):
    x, y, z = force.T
    columns = np.column_stack([np.ones(len(x)), x, y, z, x**2, x**3])
    return columns @ TRUTH + noise * np.random.default_rng(seed).normal(size=len(x))


def _bench(forces=CENTRIFUGE, noise=0.0, seed=1):
    """Six faces in gravity, then known forces."""
    gap, none = np.full(FACES.shape, np.nan), np.full(forces.shape, np.nan)
    up, force = np.vstack([FACES, none]), np.vstack([gap, forces])
    named = {f"up_{axis}": up[:, i] for i, axis in enumerate("xyz")}
    named |= {f"f_{axis}": force[:, i] for i, axis in enumerate("xyz")}
    return {**named, "ax": _reading(np.vstack([SIZE * FACES, forces]), noise, seed)}


def test_forces_join_the_positions_in_gravity():
    # eq. (1) of positions.forces
    cal = mp.fit(_bench(), model=MODEL, gravity=G)
    assert_allclose(cal.parameters, TRUTH, atol=1e-12)  # rounding of readings of a few g
    assert_allclose(cal.reference, np.vstack([SIZE * FACES, CENTRIFUGE]))
    down = mp.fit(_bench(), model=MODEL, gravity=G, convention="gravity")
    assert_allclose(down.parameters, TRUTH * [1, -1, -1, -1, 1, -1], atol=1e-12)


def test_gravity_beside_forces_needs_its_size():
    with pytest.raises(MultiposError, match=r"position '1' is at rest.*--gravity or --latitude"):
        mp.fit(_bench(), model=MODEL)
    assert mp.fit(_bench(), model=MODEL, latitude=45.0).gravity is not None


def test_forces_alone_are_touched_by_no_gravity():
    bench = {name: column[6:] for name, column in _bench(noise=1e-4).items()}
    bench = {name: column for name, column in bench.items() if not name.startswith("up")}
    plain = mp.fit(bench, model="1 + x + x^2 + x^3")
    stated = mp.fit(bench, model="1 + x + x^2 + x^3", gravity=9.7, gravity_u=0.1)
    assert_array_equal(plain.parameters, stated.parameters)
    assert_array_equal(plain.covariance, stated.covariance)


def test_uncertain_gravity_moves_what_the_rows_at_rest_decide():
    step = 1e-4  # [m/s²]
    low, high = (mp.fit(_bench(noise=1e-4), model=MODEL, gravity=G + d) for d in (-step, step))
    moved = (high.parameters - low.parameters) / (2.0 * step)
    plain, wide = (
        mp.fit(_bench(noise=1e-4), model=MODEL, gravity=G, gravity_u=u) for u in (0.0, 0.01)
    )
    added = np.sqrt(np.diag(wide.covariance - plain.covariance))
    # to the part that residuals, a ten-thousandth of a reading, add to the derivative
    assert_allclose(added, np.abs(moved) * 0.01, rtol=2e-3, atol=2e-8)


@pytest.mark.usefixtures("without_findings")
def test_uncertainty_of_the_force_is_covered():
    rng = np.random.default_rng(5)
    u = np.vstack([np.zeros(FACES.shape), np.full(CENTRIFUGE.shape, 1e-3)])
    stated = {f"reference_u_{axis}": u[:, i] for i, axis in enumerate("xyz")}
    covered, trials = 0, 60
    for _ in range(trials):
        acted = np.vstack([SIZE * FACES, CENTRIFUGE]) + u * rng.normal(size=u.shape)
        value = _reading(acted) + 1e-5 * rng.normal(size=20)
        table = {**_bench(), "ax": value, **stated}
        cal = mp.fit(table, model=MODEL, gravity=G)
        parameters = [cal["ax", term] for term in ("x", "x^3")]  # those that the forces decide
        off = np.abs([p.value for p in parameters] - TRUTH[[1, 5]])
        covered += int((off <= [p.U for p in parameters]).sum())
    # 95 % of 120; four binomial standard deviations below (9 %), as two of a run lean together
    assert covered >= 0.85 * 2 * trials
    weight = 1.0 / np.hypot(1e-5, u[:, 0])
    columns = cal.model.basis(cal.reference, {}) * weight[:, None]
    by_hand = np.sqrt(np.linalg.inv(columns.T @ columns)[5, 5])
    # what the forces add is stated, so U of the cube, which they decide, is that of a known noise
    assert_allclose(parameters[1].U, 1.96 * by_hand, rtol=0.25)


def test_no_claim_of_noise_is_denied_where_none_was_made():
    bench = _bench(noise=1e-3)
    zeros = np.zeros(20)
    bench |= {f"reference_u_{axis}": zeros + 1e-6 for axis in "xyz"}
    cal = mp.fit(bench, model=MODEL, gravity=G)
    assert not any("deny" in text for text in texts(cal))
    plain = mp.fit(_bench(noise=1e-3), model=MODEL, gravity=G)
    assert_allclose(cal.parameters, plain.parameters, rtol=0, atol=1e-5)  # 1 % of their u
    assert_allclose(cal.u, plain.u, rtol=0.15)  # a posterior with a prior of its own


def test_a_calibration_with_forces_is_read_back(tmp_path):
    bench = _bench(noise=1e-4) | {"position": [str(i) for i in range(20)]}
    cal = mp.fit(bench, model=MODEL, gravity=G)
    cal.save(tmp_path / "cal.json")
    assert mp.load(tmp_path / "cal.json") == cal


def test_a_force_of_no_size_is_a_position_too():
    cal = mp.fit(_bench(np.outer(np.arange(-3.0, 4.0), [1.0, 0, 0])), model=MODEL, gravity=G)
    assert_allclose(cal.parameters, TRUTH, atol=1e-12)


def test_outside_follows_the_forces_that_were_applied():
    cal = mp.fit(_bench(noise=1e-6), model=MODEL, gravity=G)
    forces = np.array([[0.5, 0, 0], [4.9, 0, 0], [-4.9, 0, 0], [5.5, 0, 0]])
    assert mp.apply(cal, {"ax": _reading(forces)})["outside"].tolist() == [0, 0, 0, 1]
    rng = np.random.default_rng(2)
    triad = {f"f_{axis}": np.vstack([CENTRIFUGE, FACES])[:, i] for i, axis in enumerate("xyz")}
    triad |= {f"a{axis}": triad[f"f_{axis}"] + 1e-6 * rng.normal(size=20) for axis in "xyz"}
    three = mp.fit(triad)
    rows = {"ax": [4.9, 0.0, 0.9], "ay": [0.0, 4.9, 0.0], "az": [0.0, 0.0, 0.0]}
    assert mp.apply(three, rows)["outside"].tolist() == [0, 1, 0]  # y never felt more than 1 g
    assert "x -5 to 5, y -1 to 1, z -1 to 1 g" in mp.export(three, "c").text


def test_check_knows_the_forces_of_a_run():
    cal = mp.fit(_bench(noise=1e-5), model=MODEL, gravity=G)
    run = mp.check(cal, _bench(noise=1e-5, seed=2))
    assert np.abs(run.after[6:]).max() < 1e-4  # ten times the noise
    assert_allclose(run.after[2:6, 0] * TRUTH[1], SIZE * FACES[2:6] @ TRUTH[1:4], atol=1e-4)
    assert_allclose(run.reference[:, 0], np.concatenate([SIZE * FACES[:, 0], CENTRIFUGE[:, 0]]))
    with pytest.raises(MultiposError, match="has no tilt"):
        mp.check(cal, _bench(), tilt=True)
    at_rest = mp.fit({"ax": _reading(FACES), **_columns("up", FACES)})
    with pytest.raises(MultiposError, match="fit it with --gravity"):
        mp.check(at_rest, _bench())


def test_full_quadratic_is_separable_by_forces_of_several_sizes():
    rng = np.random.default_rng(3)
    force = rng.normal(size=(20, 3)) * rng.uniform(0.5, 4.0, size=(20, 1))
    table = {f"f_{axis}": force[:, i] for i, axis in enumerate("xyz")}
    value = 0.1 + force @ [1.0, 0.01, -0.02] + force**2 @ [1e-3, 2e-3, 3e-3]
    value = value + 4e-3 * force[:, 0] * force[:, 1]
    cal = mp.fit(table | {"ax": value}, model="full-quadratic")
    found = [cal["ax", term].value for term in ("x^2", "y^2", "z^2", "x*y", "x*z")]
    assert_allclose(found, [1e-3, 2e-3, 3e-3, 4e-3, 0.0], atol=1e-12)


def test_columns_of_apply_are_no_positions(tmp_path):
    cal = mp.fit({"ax": _reading(FACES), **_columns("up", FACES)})
    table = {**_columns("up", FACES), "ax": _reading(FACES)}
    applied = dict(mp.apply(cal, table, uncertainty=True))
    again = mp.fit(applied)
    assert again.outputs == ("ax",)
    assert_array_equal(again.parameters, cal.parameters)
    beside = {**table, **_columns("f", FACES)}  # even without what else apply leaves
    found = mp.read_readings(beside)
    assert found.outputs == ("ax",)
    assert found.force is None
    assert any("not used as positions" in note for note in texts(found))


def test_outputs_may_have_the_names_of_forces():
    values = _columns("f", FACES)
    named = mp.read_readings({**values, "ax": _reading(FACES)}, outputs="f_x,f_y,f_z")
    assert named.outputs == ("f_x", "f_y", "f_z")
    assert named.force is None
    alone = mp.read_readings({**values, **_columns("up", FACES)})
    assert alone.outputs == ("f_x", "f_y", "f_z")
    assert alone.force is None


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"f_y": [np.nan] * 7 + [0.0] * 13}, r"row 7, column 'f_y': empty"),
        ({"f_x": [1.0] * 20, "f_y": [0.0] * 20, "f_z": [0.0] * 20}, r"row 1, .*keep one of them"),
        ({"reference_u_x": [0.0] * 20}, r"'reference_u_y' is missing"),
        ({f"reference_u_{a}": [0.0] * 19 + [-1.0] for a in "xyz"}, r"row 20.*negative"),
        ({f"reference_u_{a}": [np.nan] * 20 for a in "xyz"}, r"row 7.*empty for a known force"),
    ],
)
def test_what_is_refused(change, match):
    with pytest.raises(MultiposError, match=match):
        mp.fit({**_bench(), **change}, model=MODEL, gravity=G)


def test_unknown_orientation_does_not_shrink_forces():
    table = {**_columns("f", 3.0 * FACES), **_columns("a", FACES)}
    with pytest.raises(MultiposError, match="3 to 3 g"):
        mp.fit(table, outputs="a_x,a_y,a_z", unknown_orientation=True)


def test_lengths_of_up_vectors_are_said():
    table = {**_columns("up", 2.0 * FACES), "ax": _reading(FACES)}
    assert any("f_x, f_y, f_z" in note for note in texts(mp.read_readings(table)))
    rounded = {**_columns("up", FACES * 0.999), "ax": _reading(FACES)}
    assert not texts(mp.read_readings(rounded))


def test_a_scheme_of_forces_fits_and_simulates():
    scheme = {"position": [f"c{i}" for i in range(14)], **_columns("f", CENTRIFUGE)}
    table = {"position": scheme["position"], "ax": _reading(CENTRIFUGE)}
    cal = mp.fit(table, scheme=scheme, model="1 + x + x^2 + x^3")
    assert_allclose(cal.parameters, TRUTH[[0, 1, 4, 5]], atol=1e-12)
    assert_allclose(mp.simulate(cal, scheme)["ax"], table["ax"], atol=1e-12)
    (found,) = mp.schemes(scheme, model="1 + x", axes="x").schemes
    x = CENTRIFUGE[:, 0]
    assert_allclose(found.u["ax:x"], 1.0 / np.sqrt(x @ x), rtol=1e-12)  # even about zero


def _columns(prefix, values):
    return {f"{prefix}_{axis}": values[:, i] for i, axis in enumerate("xyz")}


@pytest.mark.parametrize("cross", [0.5, 0.02, 1e-3])
def test_what_uncertain_forces_add_by_hand(cross):
    """J = ((1, c), (c, 1)) moves both outputs by u_f = (1, 2) mg: 1 + 4 c², 5 c, c² + 4 mg².

    Beside u = 1 mg they are correlated by 5 c/√10, which counts where it is above 1 %.
    """
    # eq. (4) of estimation.stated_uncertainty
    force = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    readings = mp.Readings(
        force[:, :2],
        force=force,
        outputs=("ax", "ay"),
        u=np.full((3, 2), 1e-3),
        reference_u=np.tile([1e-3, 2e-3, 0.0], (3, 1)),
    )
    slopes = np.tile([[1.0, cross, 0.0], [cross, 1.0, 0.0]], (3, 1, 1))
    model = SimpleNamespace(force_jacobian=lambda *_: slopes)
    solution = SimpleNamespace(
        model=model, parameters=None, reference=force, residual_sd=np.array([1e-3, 1e-3])
    )
    found = add_reference_noise(readings, solution)
    here = 1e-6 * np.array([[2 + 4 * cross**2, 5 * cross], [5 * cross, 5 + cross**2]])
    if cross < 0.01:
        assert found.covariance is None
        assert_allclose(found.u, np.tile(np.sqrt(np.diag(here)), (3, 1)), rtol=1e-12)
    else:
        assert found.u is None
        assert_allclose(found.covariance, np.kron(np.eye(3), here), rtol=1e-12, atol=1e-20)
    # readings that state nothing have a noise far below the residuals, whose part is left to them
    bare = add_reference_noise(replace(readings, u=None), solution)
    none = here - 1e-6 * np.eye(2)
    noise = np.diag(bare.covariance)[:2] if bare.u is None else bare.u[0] ** 2
    assert_allclose(noise, np.diag(none), rtol=1e-4)
