"""The likelihood against CasADi, dense algebra and finite differences of the forward equation."""

from dataclasses import replace

import casadi
import numpy as np
import pytest
from numpy.testing import assert_allclose
from orientation_bench import BIAS, MATRIX
from scipy.optimize import least_squares

import multipos as mp
from multipos.estimation.descent import maximise
from multipos.estimation.gains import restate
from multipos.estimation.likelihood import evaluate, linearise
from multipos.estimation.problem import Problem, start_state
from multipos.numerics.arrays import COMPONENTS
from multipos.numerics.losses import loss_weight
from multipos.numerics.rotations import directions, rotation_matrix
from multipos.numerics.terms import NAMED
from multipos.positions.scheme import read_scheme
from multipos.sensor.model import build_model

if not hasattr(casadi.SX, "__abs__"):  # before 3.8
    casadi.SX.__abs__ = casadi.SX.fabs

OUTPUTS = ("ax", "ay", "az")
FORMULAS = [
    *NAMED,
    "1 + own + x*|y| + temperature*x + temperature^2",
    "1 + x + y + z + own^9*|own|",
]


def a_model(text, gauge=None):
    model = build_model(text, OUTPUTS, COMPONENTS, known=("temperature",))
    return model if gauge is None else model.with_gauge(gauge)


def symbolic(model):
    """Return the CasADi function (f, e, p) -> y, dy/dp, dy/df of the terms written once."""
    f, e = casadi.SX.sym("f", 3), casadi.SX.sym("e", 1)
    p = casadi.SX.sym("p", len(model.keys))
    variables = dict(zip(COMPONENTS, casadi.vertsplit(f), strict=True)) | {"temperature": e}
    outputs = []
    for i, output in enumerate(model.outputs):
        y = sum(
            p[k] * term.evaluate(variables)
            for k, (name, term) in enumerate(model.keys)
            if name == output
        )
        for target, column, source in model.mirrored:
            if target == i:
                y = y + p[source] * model.basis_terms[column].evaluate(variables)
        outputs.append(y)
    y = casadi.vertcat(*outputs)
    return casadi.Function("h", [f, e, p], [y, casadi.jacobian(y, p), casadi.jacobian(y, f)])


@pytest.mark.parametrize("gauge", [None, "lower", "symmetric"])
@pytest.mark.parametrize("text", FORMULAS)
def test_fast_derivatives_are_those_of_casadi(text, gauge):
    model = a_model(text, gauge)
    rng = np.random.default_rng(1)
    force, t = rng.standard_normal((20, 3)), rng.standard_normal(20)
    theta = rng.standard_normal(len(model.keys))
    environment = {"temperature": t}
    outputs, blocks = model.respond(theta, force, environment)
    by_force = model.force_jacobian(theta, force, environment)
    exact = symbolic(model)
    for k in range(len(force)):
        y, by_parameter, dy = (np.array(item) for item in exact(force[k], t[k], theta))
        assert_allclose(outputs[k], y.ravel(), rtol=1e-13, atol=1e-13)
        assert_allclose(by_force[k], dy, rtol=1e-12, atol=1e-12)
        mine = np.zeros((3, len(theta)))
        for i, (places, slopes) in enumerate(blocks):
            np.add.at(mine[i], places, slopes[k])
        assert_allclose(mine, by_parameter, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("gauge", [None, "lower", "symmetric"])
def test_casadi_expression_meets_complex_step(gauge):
    """The two independent derivatives of the forward equation, where no modulus is in it."""
    # eqs. (1), (2), (3) of estimation.likelihood
    model = a_model("ieee", gauge)
    rng = np.random.default_rng(2)
    force, theta = rng.standard_normal(3), rng.standard_normal(len(model.keys))
    theta_matrix = model.coefficients(theta)
    _, _, dy = symbolic(model)(force, 0.0, theta)
    for i, axis in enumerate(COMPONENTS):
        variables = dict(zip(COMPONENTS, force.astype(complex), strict=True))
        variables[axis] += 1e-200j
        phi = np.array([term.evaluate(variables) for term in model.basis_terms])
        assert_allclose(np.array(dy)[:, i], (theta_matrix @ phi).imag / 1e-200, rtol=1e-13)


# --- the objective and its reduced normal equations


def a_problem(kind, *, robust=None, full=False):
    """Return a problem of every kind of position, and a state that is no solution."""
    rng = np.random.default_rng(11)
    n = 17
    up = rng.standard_normal((n, 3))
    up /= np.linalg.norm(up, axis=1)[:, None]
    spread = np.full(n, 0.02)
    group = np.full(n, -1)
    level = 0.0
    if kind in ("exact", "everything"):
        spread[3:7] = 0.0
    if kind in ("unknown", "everything"):
        spread[8:10] = np.inf
    if kind in ("groups", "everything"):
        group[10:13], group[13:] = 0, 1
    attitude = None
    if kind in ("level", "everything"):
        level = 0.01
        attitude = np.array([rotation_matrix(v) for v in rng.standard_normal((n, 3))])
        up = np.where(np.isinf(spread)[:, None], up, attitude[:, :, 2])
    model = a_model("own-quadratic")
    precision = rng.uniform(0.5, 2.0, (n, 3)) * 1e4
    if full:
        mix = rng.standard_normal((n, 3, 3))
        precision = 1e4 * (mix @ mix.transpose(0, 2, 1) + np.eye(3))
    problem = Problem(
        model=model,
        values=rng.standard_normal((n, 3)),
        environment={},
        precision=precision,
        reference=-0.998 * up,
        orientation_sd=spread,
        group=group,
        weight=np.ones(n),
        groups=int(group.max()) + 1,
        attitude=attitude,
        level_sd=level,
        robust=robust,
    )
    theta = np.zeros(len(model.keys))
    for i in range(3):
        theta[model.slices[i]] = [BIAS[i], *MATRIX[i], 0.01]
    turns = np.array([rotation_matrix(v) for v in rng.standard_normal((problem.groups, 3))])
    state = start_state(problem, theta, up, turns.reshape(-1, 3, 3))
    step = np.where(spread[:, None] == 0.0, 0.0, 0.05 * rng.standard_normal((n, 2)))
    state = replace(state, step=step, tilt=np.array([0.01, -0.02]) if level else np.zeros(2))
    clean = problem.values * 0.01 + model.predict(theta, evaluate(problem, state).force, {})
    return replace(problem, values=clean), state


KINDS = ["uncertain", "exact", "unknown", "groups", "level", "everything"]


def moved(problem, state, x):
    """Return the state after adding x to all unknowns: parameters, shared ones, then steps."""
    p, q = len(state.theta), problem.shared
    turns = [
        rotation_matrix(x[p + 3 * g : p + 3 * g + 3]) @ turn for g, turn in enumerate(state.turns)
    ]
    return replace(
        state,
        theta=state.theta + x[:p],
        turns=np.array(turns).reshape(-1, 3, 3),
        tilt=state.tilt + (x[p + q - 2 : p + q] if problem.level_sd else 0.0),
        step=state.step + x[p + q :].reshape(-1, 2),
    )


def every_unknown(problem, state):
    """Return the dense Jacobian of whitened residuals and priors by finite differences."""
    p, q, n = len(state.theta), problem.shared, len(problem.values)
    size = p + q + 2 * n
    precision = problem.precision
    if precision.ndim == 2:
        precision = precision[:, :, None] * np.eye(3)
    root = np.linalg.cholesky(precision).transpose(0, 2, 1)
    tied = np.isfinite(problem.orientation_sd) & (problem.orientation_sd > 0.0)

    def whitened(x):
        at = moved(problem, state, x)
        force = evaluate(problem, at).force
        residuals = problem.values - problem.model.predict(at.theta, force, {})
        parts = [np.einsum("nij,nj->ni", root, residuals).ravel()]
        parts.append((at.step[tied] / problem.orientation_sd[tied][:, None]).ravel())
        if problem.level_sd:
            parts.append(at.tilt / problem.level_sd)
        return np.concatenate(parts)

    h = 1e-6
    columns = [(whitened(h * e) - whitened(-h * e)) / (2.0 * h) for e in np.eye(size)]
    held = np.repeat(problem.orientation_sd == 0.0, 2)
    free = np.concatenate([np.ones(p + q, bool), ~held])
    return np.array(columns).T[:, free], whitened(np.zeros(size))


def test_elimination_keeps_its_digits_where_placement_is_all():
    # One output sees one turn of two; with noise of 1e-7 of it a d − b² keeps no digit.
    up = read_scheme("all-26").up
    sd, spread = 1e-8, 0.1
    model = build_model("linear", ("a",), ("x",), ("x", "y", "z"), "g", ())
    problem = Problem(
        model=model,
        values=up[:, :1],
        environment={},
        precision=np.full((26, 1), sd**-2.0),
        reference=up,
        orientation_sd=np.full(26, spread),
        group=np.full(26, -1),
        weight=np.ones(26),
    )
    state = start_state(problem, np.array([0.0, 1.0, 0.02, -0.03]))
    normal = linearise(problem, state, evaluate(problem, state))
    square = np.einsum("nmi,nmi->n", normal.jacobian, normal.jacobian)
    by_hand = 1.0 / (sd**2 + spread**2 * square)  # W = (Sigma + s² J J')^-1 of one reading
    # P − P J H^-1 J'P cancels but for (sd/s)² of P, of which eps/(sd/s)² is not known
    assert_allclose(normal.marginal[:, 0, 0], by_hand, rtol=8.0 * 2.0**-52 / (sd / spread) ** 2)


@pytest.mark.parametrize("full", [False, True], ids=["variances", "covariances"])
@pytest.mark.parametrize("kind", KINDS)
def test_elimination_is_the_dense_normal_equations(kind, full):
    problem, state = a_problem(kind, full=full)
    point = evaluate(problem, state)
    normal = linearise(problem, state, point)
    jacobian, residual = every_unknown(problem, state)
    assert_allclose(point.objective, residual @ residual, rtol=1e-12)
    size = len(state.theta) + problem.shared
    dense = jacobian.T @ jacobian
    right = -jacobian.T @ residual
    cross = dense[:size, size:]
    inner = np.linalg.solve(dense[size:, size:], np.column_stack([cross.T, right[size:]]))
    # finite differences are good to 1e-9 of the largest entry
    scale = np.sqrt(np.diag(normal.information))
    wanted = (dense[:size, :size] - cross @ inner[:, :-1]) / np.outer(scale, scale)
    assert_allclose(normal.information / np.outer(scale, scale), wanted, atol=1e-7)
    pull = right[:size] - cross @ inner[:, -1]
    assert_allclose(normal.gradient / scale, pull / scale, atol=1e-6 * np.abs(pull / scale).max())


@pytest.mark.parametrize("kind", KINDS)
def test_reduced_weight_inverts_the_marginal_covariance(kind):
    # eq. (5) of estimation.likelihood
    problem, state = a_problem(kind)
    normal = linearise(problem, state, evaluate(problem, state))
    J, finite = normal.jacobian, np.isfinite(problem.orientation_sd)
    covariance = np.eye(3) / problem.precision[:, :, None]
    spread = np.where(finite, problem.orientation_sd, 0.0)
    covariance = covariance + spread[:, None, None] ** 2 * (J @ J.transpose(0, 2, 1))
    product = normal.marginal @ covariance
    assert_allclose(product[finite], np.tile(np.eye(3), (finite.sum(), 1, 1)), atol=1e-11)
    # of an unknown direction nothing along the sphere is seen, and the rest in full
    assert_allclose((normal.marginal @ J)[~finite], 0.0, atol=1e-9 * problem.precision.max())
    seen = normal.marginal @ covariance @ normal.marginal
    assert_allclose(seen[~finite], normal.marginal[~finite], atol=1e-11 * problem.precision.max())


@pytest.mark.parametrize("robust", [None, "huber", "soft-l1", "cauchy"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_gradient_is_that_of_the_objective(kind, robust):
    """Where the steps are at their own optimum the reduced gradient is the whole one."""
    # eqs. (4), (6) of estimation.likelihood
    problem, state = a_problem(kind, robust=robust)
    for _ in range(30):  # of the steps alone
        point = evaluate(problem, state)
        normal = linearise(problem, state, point)
        step = state.step + np.einsum("nij,nj->ni", normal.inverse, normal.angle_gradient)
        state = replace(state, step=step)
    size = len(state.theta) + problem.shared
    normal = linearise(problem, state, evaluate(problem, state))
    h = 1e-6
    for i in range(size):
        x = np.zeros(size + 2 * len(problem.values))
        x[i] = h
        up, down = (evaluate(problem, moved(problem, state, s * x)).objective for s in (1, -1))
        scale = np.sqrt(normal.information[i, i])
        assert_allclose(-(up - down) / (4.0 * h) / scale, normal.gradient[i] / scale, atol=2e-4)


@pytest.mark.parametrize("robust", [None, "huber", "soft-l1", "cauchy"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_search_ends_where_nothing_is_left_to_gain(kind, robust):
    problem, state = a_problem(kind, robust=robust)
    rng = np.random.default_rng(3)
    truth = evaluate(problem, state).force
    noise = rng.standard_normal(truth.shape) / np.sqrt(problem.precision)
    problem = replace(problem, values=problem.model.predict(state.theta, truth, {}) + noise)
    found = maximise(problem, state)
    assert found.converged
    assert found.iterations < 60
    least = found.point.objective
    size = len(state.theta) + problem.shared + 2 * len(truth)
    free = np.concatenate(
        [np.ones(len(state.theta) + problem.shared), np.repeat(problem.orientation_sd > 0.0, 2)]
    )
    for _ in range(50):
        nudged = moved(problem, found.state, 1e-4 * free * rng.standard_normal(size))
        assert evaluate(problem, nudged).objective >= least * (1.0 - 1e-12)


def test_a_false_end_is_not_called_convergence():
    """No descent from a point that is no minimum: the search says so."""
    problem, state = a_problem("uncertain")
    broken = replace(problem, values=problem.values + np.nan)
    with np.errstate(invalid="ignore"):
        found = maximise(broken, state)
    assert not found.converged


# --- unknown orientation, one number a position


@pytest.mark.parametrize("robust", [None, "huber", "soft-l1", "cauchy"])
@pytest.mark.parametrize("gauge", ["lower", "symmetric"])
@pytest.mark.parametrize("text", ["linear", "own-cubic", "ieee-odd"])
def test_the_surface_normal_is_the_whole_of_an_unknown_position(text, gauge, robust):
    # eq. (1) of estimation.units
    rng = np.random.default_rng(6)
    n = 60
    model = a_model(text, gauge)
    up = rng.standard_normal((n, 3))
    up /= np.linalg.norm(up, axis=1)[:, None]
    theta = 0.01 * rng.standard_normal(len(model.keys))
    theta[list(model.own_scales)] += 1.0
    values = model.predict(theta, -0.998 * up, {}) + 1e-3 * rng.standard_normal((n, 3))
    values[4] += 0.05
    problem = Problem(
        model=model,
        values=values,
        environment={},
        precision=rng.uniform(0.5, 2.0, (n, 3)) * 1e6,
        reference=-0.998 * np.ones((n, 3)) / np.sqrt(3.0),
        orientation_sd=np.full(n, np.inf),
        group=np.full(n, -1),
        weight=np.ones(n),
        robust=robust,
    )
    state = start_state(problem, theta, -up)
    point = evaluate(problem, state)
    slow = linearise(problem, state, point)
    G = model.force_jacobian(theta, point.force, {})
    normal = np.linalg.solve(G.transpose(0, 2, 1), point.force[..., None])[..., 0]
    m = normal / np.sqrt(np.sum(normal**2 / problem.precision, axis=1))[:, None]
    weight = np.ones(n) if robust is None else loss_weight(robust, point.q, problem.degrees)
    marginal = weight[:, None, None] * m[:, :, None] * m[:, None]
    largest = np.abs(slow.marginal).max()
    assert_allclose(slow.marginal, marginal, atol=1e-10 * largest)
    found = maximise(problem, state)
    assert found.converged
    # a covariance of each reading without correlation is the same
    full = replace(problem, precision=problem.precision[:, :, None] * np.eye(3))
    general = maximise(full, state)
    # F is known to some 1e-14 of itself, and no search sees a step that takes less than that off
    # it. In units of u, whatever the parameters' correlations (ieee-odd: condition 1e5), a step is
    # long by the root of what it takes off F. So far from the end may each of the two be.
    blind = np.sqrt(1e-14 * found.point.objective)
    apart = found.state.theta - general.state.theta
    information = linearise(problem, found.state, found.point).information
    assert np.sqrt(apart @ information @ apart) < 2.0 * blind
    assert found.point.objective == pytest.approx(general.point.objective, rel=1e-10)
    assert_allclose(found.point.force, evaluate(problem, found.state).force, atol=1e-14)


def test_uncertain_orientations_are_the_least_squares_of_scipy():
    """Parameters and two angles of every position in one problem, turned exactly."""
    # eq. (4) of estimation.likelihood
    rng = np.random.default_rng(6)
    up = mp.read_scheme("fibonacci-24").up
    sd, s = 2e-3, np.radians(0.3)
    angles = s * rng.standard_normal((24, 3))
    matrix = np.array([[1.01, 0.004, 0.0], [0.01, 0.99, 0.003], [-0.004, 0.01, 1.02]])
    values = 0.02 + (up + np.cross(angles, up)) @ matrix.T + sd * rng.standard_normal(up.shape)
    cal = mp.fit(mp.Readings(values, up=up), orientation_sd=0.3, reading_sd=sd)
    across = np.linalg.svd(up[:, None])[2][:, 1:]

    def left(unknown):
        p, t = unknown[:12].reshape(3, 4), unknown[12:].reshape(24, 2)
        moved = np.einsum("kq,kqi->ki", t, across)
        size = np.linalg.norm(moved, axis=1)[:, None]
        force = np.cos(size) * up + np.sinc(size / np.pi) * moved
        r = (values - p[:, 0] - force @ p[:, 1:].T) / sd
        return np.concatenate([r.ravel(), t.ravel() / s])

    start = np.concatenate([np.column_stack([np.zeros(3), np.eye(3)]).ravel(), np.zeros(48)])
    best = least_squares(left, start, x_scale="jac").x[:12]
    # ours is a mean over what the noise may be, which moves weights a little; the fit to the
    # listed positions lies several times as far
    listed = mp.fit(mp.Readings(values, up=up)).parameters
    off = [float(np.sqrt(np.mean(((p - best) / cal.u) ** 2))) for p in (cal.parameters, listed)]
    assert off[0] < min(0.12, off[1] / 3.0)


def test_a_prior_of_a_parameter_is_one_more_square(tmp_path):
    path = tmp_path / "own.toml"
    path.write_text(
        '[parameters]\nk = {start = 0.01, sd = 0.02}\n[outputs]\neach = "b + s*own + k*own^2"\n'
    )
    up = read_scheme("fibonacci-24").up
    values = up + 0.02 * up**2 + 2e-3 * np.random.default_rng(1).standard_normal(up.shape)
    readings = mp.Readings(values, up=up)
    c = mp.fit(readings, model=path, orientation_sd=0.1, reading_sd=1e-3)
    problem, theta = restate(c), c.parameters + 0.05
    point = evaluate(problem, start_state(problem, theta, directions(c.reference)))
    squares = ((theta[2::3] - 0.01) / 0.02) ** 2  # of k of each output
    assert_allclose(point.objective - point.q.sum(), squares.sum(), rtol=1e-9)
