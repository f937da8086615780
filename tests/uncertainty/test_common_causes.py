"""What a common cause left in the residuals is taken out of their scatter, and added in full."""

import numpy as np
import pytest
from amounts import exactly
from numpy.testing import assert_allclose, assert_array_equal

import multipos as mp
from multipos.uncertainty import common_causes
from multipos.uncertainty.propagation import evaluate_budget

LEVEL = 0.1  # degrees
NOISE = 30e-6


def attitudes(n, seed):
    """Rotations from level to case, even over all of them, by QR of normal matrices."""
    rng = np.random.default_rng(seed)
    Q, R = np.linalg.qr(rng.standard_normal((n, 3, 3)))
    Q = Q * np.sign(np.einsum("nii->ni", R))[:, None, :]
    return Q * np.linalg.det(Q)[:, None, None]


def tilted(rotation, rng, level=LEVEL, noise=NOISE, outputs=3, **stated):
    """Readings of a perfect sensor on a table that leans, exactly turned."""
    east, north = np.radians(level) * rng.standard_normal(2)
    up = np.array([north, -east, 1.0]) / np.sqrt(1.0 + east**2 + north**2)
    values = rotation @ up + noise * rng.standard_normal((len(rotation), 3))
    more = {name: np.full((len(rotation), outputs), size) for name, size in stated.items()}
    return mp.Readings(
        values[:, :outputs], rotation=rotation, up=rotation[:, :, 2], unit="g", **more
    )


def fitted(readings, level=LEVEL, **options):
    return exactly(readings, budget={"level": {"u_deg": level}}, **options)


def of(cal, evaluation):
    """The covariance of the rows of the readings, or of what is stated beside them."""
    rows = [row for row in evaluate_budget(cal).rows if row.evaluation == evaluation]
    return sum(row.covariance for row in rows)


def pattern(rotation):
    """What the linear fit leaves (n, 3, 2) of the moves of a turn of one degree."""
    X = np.column_stack([np.ones(len(rotation)), rotation[:, :, 2]])
    moves = np.radians(1.0) * np.stack([rotation[:, :, 1], -rotation[:, :, 0]], axis=-1)
    return moves - np.einsum("nk,kmq->nmq", X @ np.linalg.pinv(X), moves)


@pytest.mark.parametrize(
    ("e", "size", "variance", "left"),
    [
        # eq. (3) at s² = 1: 2 = 2 (1/2)² + 1 + 1/2, and 1/2 of a degree of freedom is lost
        ((np.sqrt(2.0), 1.0), 1.0, 1.0, 1.5),
        # far above the noise the first residual is the cause's, and 1² is left on one
        ((3.0, 1.0), 1e5, 1.0, 1.0),
        # far below it, nothing: (4 + 16)/2
        ((2.0, 4.0), 1e-5, 10.0, 2.0),
    ],
)
def test_two_residuals_of_which_one_shows_the_cause_by_hand(e, size, variance, left):
    # eq. (3) of uncertainty.common_causes
    residuals, shown = np.array(e)[:, None], np.array([size, 0.0])[:, None, None]
    found = common_causes._settle(
        residuals,
        shown,
        np.zeros((2, 1)),
        np.array([2.0]),
        lambda r: np.sum(r**2, axis=0) / 2.0,
        (1e-12, 500),
    )
    assert_allclose(found.variance, variance, rtol=1e-8)  # 1e-10 of it from the finite size
    assert_allclose(found.left, left, rtol=1e-8)


def test_variance_is_that_of_the_restricted_likelihood():
    """Of one output: the minimum of ln det K'VK + e'K(K'VK)⁻¹K'e, K across the design."""
    # eqs. (1), (2) of uncertainty.common_causes
    from scipy.optimize import minimize_scalar

    rotation, level, noise = attitudes(9, 1), 0.03, 3e-4
    cal = fitted(tilted(rotation, np.random.default_rng(2), level, noise, outputs=1), level)
    X = np.column_stack([np.ones(9), rotation[:, :, 2]])
    K = np.linalg.svd(X)[0][:, 4:]
    A = K.T @ pattern(rotation)[:, 0] * level
    e = K.T @ cal.residuals[:, 0]

    def misfit(log):
        V = np.exp(log) * np.eye(5) + A @ A.T
        return np.linalg.slogdet(V)[1] + e @ np.linalg.solve(V, e)

    best = minimize_scalar(misfit, bracket=np.log([1e-8, 1e-7]), tol=1e-12)
    found = evaluate_budget(cal).cleared
    # a minimum is found to the root of the rounding; the model's J is K to 1e-3
    assert_allclose(found.ratio * cal.residual_sd**2, np.exp(best.x), rtol=2e-3)
    share = np.exp(best.x) / (np.exp(best.x) + np.linalg.svd(A)[1] ** 2)
    assert_allclose(found.dof, 3.0 + share.sum(), rtol=2e-3)


@pytest.mark.parametrize("options", [{}, {"pool": True}, {"model": "own-quadratic"}])
def test_a_large_tilt_is_projected_out_and_added_in_full(options):
    rotation = attitudes(24, 3)
    cal = fitted(tilted(rotation, np.random.default_rng(5)), **options)
    plain = exactly(cal.readings, **options)
    found = evaluate_budget(cal).cleared
    sd = plain.residual_sd * np.sqrt(found.ratio)
    assert (plain.residual_sd > 10.0 * NOISE).all()
    # 57 degrees of freedom or more tell the noise to a tenth, 17 to a fifth: three of them
    assert_allclose(sd, NOISE, rtol=0.6)
    shared = 2.0 if options.get("pool") else 2.0 / 3.0
    assert_allclose(np.sum(plain.dof - found.dof), 3.0 * shared, rtol=1e-2)
    factor = np.sqrt(found.ratio)[cal.model.output_of]
    assert_allclose(of(cal, "A"), plain.covariance * np.outer(factor, factor), rtol=1e-12)
    assert_allclose(cal.covariance, of(cal, "A") + of(cal, "B"), rtol=1e-12)


def test_a_level_of_nothing_changes_nothing():
    readings = tilted(attitudes(12, 1), np.random.default_rng(2), level=0.01)
    plain = exactly(readings)
    for level in (0.0, 1e-6):
        cal = fitted(readings, level)
        found = evaluate_budget(cal).cleared
        assert_array_equal(found.ratio, 1.0)
        assert_array_equal(found.dof, plain.dof)
        assert_array_equal(of(cal, "A"), plain.covariance)
    assert_array_equal(fitted(readings, 0.0).covariance, plain.covariance)


def test_a_small_level_changes_little():
    readings = tilted(attitudes(24, 3), np.random.default_rng(2), level=1e-4, noise=3e-4)
    found = evaluate_budget(fitted(readings, 1e-3)).cleared
    # the pattern has 17 µg rms: (17/300)² of the variance, of which a draw may be ten times that
    assert (found.ratio != 1.0).all()
    assert_allclose(found.ratio, 1.0, atol=0.03)
    assert_allclose(found.dof, 20.0, atol=0.2)


def test_what_the_model_follows_is_added_as_ever():
    """About one shaft a tilt is a bias along it and a turn of the others: no residual shows it."""
    scheme = mp.read_scheme("roll-x-12")
    noise = 1e-4 * np.random.default_rng(1).standard_normal((12, 3))
    readings = mp.Readings(scheme.up + noise, unit="g")
    cal = fitted(readings, scheme=scheme, model="1 + y + z")
    plain = exactly(readings, scheme=scheme, model="1 + y + z")
    assert_array_equal(evaluate_budget(cal).cleared.ratio, 1.0)
    assert_array_equal(of(cal, "A"), plain.covariance)
    assert_allclose(cal.covariance, plain.covariance + of(cal, "B"), rtol=1e-12)


@pytest.mark.parametrize("claim", [1.0, 0.2])
def test_beside_stated_noise_the_tilt_is_no_scatter_from_rest_to_rest(claim):
    rotation = attitudes(24, 3)
    readings = tilted(rotation, np.random.default_rng(5), u=claim * NOISE)
    cal, plain = fitted(readings), exactly(readings)
    assert min(one.value for one in plain.variance_components.rest_to_rest.values()) > 10.0 * NOISE
    X = np.column_stack([np.ones(24), rotation[:, :, 2]])
    sd = np.sqrt(np.diag(of(cal, "A")) / np.tile(np.diag(np.linalg.inv(X.T @ X)), 3))
    assert_allclose(sd, NOISE, rtol=0.4)  # of 58 degrees of freedom: four of their sd
    assert_array_equal(fitted(readings, 0.0).covariance, plain.covariance)


def test_beside_a_covariance_as_beside_variances():
    rotation = attitudes(12, 3)
    readings = tilted(rotation, np.random.default_rng(5), u=NOISE)
    full = mp.Readings(
        readings.values,
        rotation=rotation,
        up=rotation[:, :, 2],
        unit="g",
        covariance=NOISE**2 * (np.eye(36) + 1e-3 * np.eye(36, k=1) + 1e-3 * np.eye(36, k=-1)),
    )
    assert fitted(full).noise.ndim == 2
    # one scatter of all outputs either way, but settled to a hundredth
    assert_allclose(fitted(full).u, fitted(readings).u, rtol=2e-2)


def test_the_error_of_a_dividing_head_goes_the_same_way():
    scheme = mp.read_scheme("roll-z-24")
    rng = np.random.default_rng(4)
    angle = np.arctan2(scheme.up[:, 1], scheme.up[:, 0])
    off = np.radians(0.1) * np.cos(3.0 * angle)  # half of it is seen as no parameter
    turned = scheme.up[:, :2] + off[:, None] * scheme.up[:, [1, 0]] * [-1.0, 1.0]
    values = turned + NOISE * rng.standard_normal((24, 2))
    cal = exactly(
        mp.Readings(values, unit="g"),
        scheme=scheme,
        inputs="x,y",
        axes="x,y",
        budget={"index": {"u_deg": 0.1, "harmonics": [3]}},
    )
    found = evaluate_budget(cal).cleared
    sd = cal.residual_sd * np.sqrt(found.ratio)
    assert (cal.residual_sd > 10.0 * NOISE).all()
    assert_allclose(sd, NOISE, rtol=0.6)  # 20 degrees of freedom each


def test_few_residuals_are_not_explained_whole():
    """Six positions of one output leave two residuals, and a tilt has two components."""
    readings = tilted(attitudes(6, 1), np.random.default_rng(2), outputs=1)
    found = evaluate_budget(fitted(readings)).cleared
    assert_array_equal(found.ratio, 1.0)
    assert_array_equal(found.dof, 2.0)


def test_robust_weights_follow_the_tilt_themselves():
    readings = tilted(attitudes(12, 1), np.random.default_rng(2))
    cal = fitted(readings, robust="huber")
    assert_array_equal(evaluate_budget(cal).cleared.ratio, 1.0)
    assert_allclose(cal.covariance, of(cal, "A") + of(cal, "B"), rtol=1e-12)


def test_another_budget_starts_from_the_whole_scatter():
    readings = tilted(attitudes(12, 1), np.random.default_rng(2))
    cal, plain = fitted(readings), exactly(readings)
    assert_array_equal(evaluate_budget(cal).covariance, cal.covariance)
    assert_array_equal(mp.state_budget(cal, {}).covariance, plain.covariance)
    again = mp.state_budget(mp.state_budget(cal, {}), {"level": {"u_deg": LEVEL}})
    assert_array_equal(again.covariance, cal.covariance)


def test_the_file_says_what_the_scatter_is_of(tmp_path):
    cal = fitted(tilted(attitudes(12, 1), np.random.default_rng(2)))
    cal.save(tmp_path / "cal.json")
    again = mp.load(tmp_path / "cal.json")
    assert_array_equal(evaluate_budget(again).covariance, cal.covariance)
    rows = cal.to_dict()["budget"]["rows"]
    assert not any(row["contained"] for row in rows)
    texts = {row.text for row in evaluate_budget(cal).rows if row.evaluation == "A"}
    assert texts == {"residual noise without common causes"}


def test_monte_carlo_gives_the_same_u():
    cal = fitted(tilted(attitudes(12, 1), np.random.default_rng(2), 0.02, 3e-4), 0.02)
    found = mp.simulate_budget(cal, trials=40_000, rng=1)
    budget = evaluate_budget(cal)
    nu = budget.cleared.dof[cal.model.output_of]  # of Student's t, whose sd is larger
    u = np.sqrt(np.diag(of(cal, "B")) + np.diag(of(cal, "A")) * nu / (nu - 2.0))
    assert_allclose(found.u, u, rtol=0.02)  # 40,000 trials tell it to .4 %, heavy tails to 1 %


def test_repeats_are_judged_by_what_is_left():
    """A table that leans the same way every time makes no scatter by which they may differ."""
    rotation, rng = attitudes(12, 1), np.random.default_rng(3)
    lean = tilted(rotation, rng, noise=0.0).values
    runs = [
        fitted(
            mp.Readings(
                lean + NOISE * rng.standard_normal((12, 3)),
                rotation=rotation,
                up=rotation[:, :, 2],
                unit="g",
            )
        )
        for _ in range(3)
    ]
    moved = mp.Readings(
        lean + NOISE * rng.standard_normal((12, 3)) + [10.0 * NOISE, 0.0, 0.0],
        rotation=rotation,
        up=rotation[:, :, 2],
        unit="g",
    )
    assert mp.compare(*runs).consistent
    assert not mp.compare(*runs, fitted(moved)).consistent  # 300 µg beside a tilt of 1.7 mg


@pytest.mark.slow
@pytest.mark.parametrize(("level", "noise"), [(0.1, 30e-6), (0.02, 300e-6)])
@pytest.mark.parametrize("claim", [{}, {"u": 1.0}])
@pytest.mark.usefixtures("without_findings")
def test_u_covers_and_is_no_longer_than_it_must_be(level, noise, claim):
    rng = np.random.default_rng(4)
    rotation, runs = attitudes(24, 3), 100
    stated = {name: size * noise for name, size in claim.items()}
    cals = [fitted(tilted(rotation, rng, level, noise, **stated), level) for _ in range(runs)]
    truth = [1.0 if name.startswith("scale") else 0.0 for name in cals[0].names]
    errors = np.array([cal.parameters - truth for cal in cals])
    U = np.array([cal.U for cal in cals])
    # what is common to twelve parameters is two tilts a run: their mean is known to some 2 %
    assert 0.89 < np.mean(np.abs(errors) <= U) < 0.99
    length = np.median(U.mean(axis=0) / np.sqrt(np.mean(errors**2, axis=0)))
    assert 0.85 < length / 1.96 < 1.2  # 100 runs know a standard deviation to 7 %, U is t's


def test_a_level_without_headings_is_an_orientation_error_of_each_position():
    # eq. (2b) of uncertainty.sensitivities
    up = mp.read_scheme("fibonacci-12").up
    values = up + 1e-4 * np.random.default_rng(3).standard_normal(up.shape)
    cal = exactly(mp.Readings(values, up=up, unit="g"))
    found = evaluate_budget(cal, {"level": {"u_deg": 0.01}}).covariance - cal.covariance
    gain = np.linalg.pinv(np.column_stack([np.ones(12), up]))  # of an output
    moves = np.cross(np.eye(3), up[:, None]) @ cal.sensitivity.T  # (position, axis, output)
    by_hand = np.einsum("pk,kam->mpka", gain, moves).reshape(12, -1)
    by_hand = 12.0 * np.radians(0.01) ** 2 * by_hand @ by_hand.T
    assert_allclose(found, by_hand, rtol=0, atol=1e-9 * by_hand.max())
