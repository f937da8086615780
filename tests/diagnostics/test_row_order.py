"""Causes of time and table: named with row and size, one for each world, by a generator apart."""

import math
import re
import warnings

import numpy as np
import pytest
from consumers import read_back
from findings_bench import EXACT, warned
from scipy import optimize

import multipos as mp
from multipos.diagnostics.row_order import (
    _MOST,
    LEVEL,
    _Along,
    _correlation,
    _law_of_slow,
    _some,
    fit_sizes,
    residuals_in_order,
    search,
    search_units,
)

K = np.array([[1.008, 0.004, -0.007], [-0.003, 0.991, 0.006], [0.005, -0.002, 1.012]])
ZERO = np.array([0.012, -0.021, 0.034])
SD = 1e-4
TRUTH = np.column_stack([ZERO, K]).ravel()


def turned(up, vector):
    """Return directions (n, 3) turned by a rotation vector [rad], by Rodrigues' formula."""
    angle = np.linalg.norm(vector)
    axis = np.asarray(vector) / angle
    along = (up @ axis)[:, None] * axis
    return along + math.cos(angle) * (up - along) + math.sin(angle) * np.cross(axis, up)


def world(cause, seed, scheme="fibonacci-24", **options):
    """Return the fit of readings in random order that a cause has spoilt, as stated exactly."""
    options = options if "unknown_orientation" in options else EXACT | options
    rng = np.random.default_rng(seed)
    up = rng.permutation(mp.read_scheme(scheme).up)
    n = len(up)
    listed, beside, late = up.copy(), {}, np.arange(n) >= n // 2
    if cause == "slipped":
        up[late] = turned(up[late], np.radians([0.2, -0.2, 0.1]))
    y = ZERO + up @ K.T
    if cause == "drift":
        y = y + 3e-4 * np.linspace(-0.5, 0.5, n)[:, None]
    elif cause == "replaced":
        y[late] = 0.01 + up[late] @ (K + 0.01 * rng.standard_normal((3, 3))).T
    elif cause == "settling":
        y[1:] = 0.98 * y[1:] + 0.02 * y[:-1]
    elif cause == "hysteresis":
        beside["approach"] = rng.choice([-1.0, 1.0], n)
        y = y + 5e-4 * beside["approach"][:, None]
    elif cause == "warm-up":
        y = y + 4e-4 * np.exp(-5.0 * np.arange(n) / n)[:, None]
    elif cause == "side":
        y[1:] += 2e-4 * np.sign(np.diff(up, axis=0))
    elif cause == "vibration":
        loud = 1e-3 + 0.03 * (rng.permutation(n) < n // 4)
        beside |= {f"sd_{o}": loud for o in ("ax", "ay", "az")}
        y = y + loud[:, None] ** 2
    elif cause == "outlier":
        y[5] += 0.01
    elif cause == "missing-term":
        y = y + 1e-3 * up**2
    y = y + SD * rng.standard_normal(y.shape)
    columns = dict(zip(("ax", "ay", "az"), y.T, strict=True)) | beside
    if "unknown_orientation" not in options:
        columns |= dict(zip(("up_x", "up_y", "up_z"), listed.T, strict=True))
    return mp.fit(columns, outputs=["ax", "ay", "az"], unit="g", **options)


CAUSES = ("drift", "slipped", "replaced", "settling", "hysteresis", "vibration")
CAUSES += ("outlier", "missing-term")


@pytest.mark.parametrize("cause", CAUSES)
def test_the_one_cause_is_named(cause):
    """Seven of eight times at least; another cause beside it, never."""
    codes = [[d.code for d in world(cause, seed).findings] for seed in range(8)]
    assert sum(found == [cause] for found in codes) >= 7, codes


@pytest.mark.parametrize("cause", [*CAUSES[:-3], CAUSES[-1]])
def test_it_is_named_where_orientation_errors_are_estimated(cause):
    """Which explain what it adds to the readings, all but along the force."""
    found = [warned(world(cause, seed, orientation_sd=None)) for seed in range(8)]
    assert sum(each == [cause] for each in found) >= 7, found


@pytest.mark.parametrize("orientation_sd", [0, None])
@pytest.mark.parametrize(("cause", "code"), [("warm-up", "drift"), ("side", "hysteresis")])
def test_a_warm_up_is_a_drift_and_sides_need_no_column(cause, code, orientation_sd):
    found = [warned(world(cause, seed, orientation_sd=orientation_sd)) for seed in range(8)]
    assert sum(each == [code] for each in found) >= 7, found


def test_of_few_rows_no_cause_needs_their_order_alone():
    for seed in range(8):
        c = world("drift", seed, "faces-6", exclude="none")
        assert not {"drift", "replaced", "slipped", "settling"} & set(warned(c))


def test_rows_that_are_set_aside_are_no_cause_of_others():
    for cause in ("outlier", "vibration"):
        found = [world(cause, seed, orientation_sd=None, exclude="auto") for seed in range(8)]
        apart = [c for c in found if c.excluded]
        assert len(apart) >= 6
        assert sum(map(bool, map(warned, apart))) <= 1


@pytest.mark.parametrize("cause", ["drift", "replaced", "settling", "hysteresis", "vibration"])
def test_the_one_cause_is_named_at_unknown_orientations(cause):
    codes = [
        {d.code for d in world(cause, seed, "fibonacci-48", unknown_orientation=True).findings}
        for seed in range(4)
    ]
    assert sum(cause in found for found in codes) >= 3, codes


def test_settling_of_one_output_is_named():
    """Each reading holds 5 % of the previous row."""
    rng = np.random.default_rng(4)
    up = rng.permutation(mp.read_scheme("fibonacci-24").up)
    y = ZERO[0] + up @ K[0]
    y[1:] = 0.95 * y[1:] + 0.05 * y[:-1]
    y += SD * rng.standard_normal(24)
    (finding,) = mp.fit(mp.Readings(y[:, None], up=up), model="linear", **EXACT).findings
    assert finding.code == "settling"
    assert abs(float(re.search(r"([\d.]+) %", finding.text)[1]) - 5.0) < 0.5


def test_misfits_along_the_force_have_the_variance_of_their_outputs():
    """e_i = n·r / √(n's²n), n = K⁻ᵀf of an unknown orientation; axes of .1, .2 and .4 mg."""
    c = world("", 4, unknown_orientation=True, reading_sd=[1e-4, 2e-4, 4e-4])
    X, e, _, across, *_ = _Along.of_one(c, np.arange(24))
    inverse = np.linalg.inv(c.sensitivity)
    for row in (0, 7, 23):
        normal, sd = inverse.T @ c.reference[row], c.sd_of_readings[row]
        size = math.sqrt(sum((normal * sd) ** 2))
        assert e[row] == pytest.approx(normal @ c.residuals[row] / size, rel=1e-9)
        assert across[row] == pytest.approx(normal * sd / size, rel=1e-9)
        f = dict(zip("1xyz", (1.0, *c.reference[row]), strict=True))
        column = [
            normal[c.outputs.index(output)] * f[str(term)] / size for output, term in c.model.keys
        ]
        assert X[row] == pytest.approx(column, rel=1e-9)


def test_chance_is_shared_by_the_causes_and_slow_noise():
    plan, _, _ = residuals_in_order(world("", 1))
    kinds = {test.family.code for test in plan.tests}
    assert len(kinds) < len(plan.tests)
    assert plan.codes == len(kinds) + 1


@pytest.mark.parametrize("cause", ["slipped", "replaced"])
def test_the_first_row_after_a_change_is_told(cause):
    (finding,) = world(cause, 3).findings
    assert finding.rows == ("13",)
    if cause == "slipped":
        assert abs(float(re.search(r"([\d.]+) degrees", finding.text)[1]) - 0.3) < 0.02


@pytest.mark.parametrize("scheme", ["faces-6", "icosahedron-12", "fibonacci-24", "dual-axis-48"])
def test_sound_readings_have_a_cause_in_one_of_a_hundred_sets_at_most(scheme):
    """All causes together, by residuals of normal noise; no cause takes more than half of that."""
    c = world("", 1, scheme)
    plan, _, slopes = residuals_in_order(c)
    Q = np.linalg.qr(np.column_stack([np.ones(len(c.reference)), c.reference]))[0]
    noise = np.random.default_rng(7).standard_normal((3, 4000, len(Q)))
    noise -= noise @ Q @ Q.T
    found = np.isfinite(search_units(plan, noise, np.broadcast_to(slopes, (4000, 3, 3))).score)
    assert found.any(axis=0).mean() < 0.01 + 2.0 * math.sqrt(0.01 / 4000)
    assert found.mean(axis=1).max() < 0.005 + 2.0 * math.sqrt(0.005 / 4000)


@pytest.mark.parametrize("unknown", [False, True])
def test_slow_noise_is_found_as_often_as_chance_says(unknown):
    """The law of its score, by itself at 1 % of all causes over their number."""
    # eq. (2) of diagnostics.row_order
    plan, _, slopes = residuals_in_order(
        world("", 2, "fibonacci-48", **({"unknown_orientation": True} if unknown else {}))
    )
    ((outputs, Q),) = plan.groups
    noise = np.random.default_rng(8).standard_normal((len(outputs), 20_000, len(Q)))
    noise -= noise @ Q @ Q.T
    rows = np.empty_like(noise)
    rows[:, :, plan.order] = noise
    shown = search_units(plan, rows, np.broadcast_to(slopes, (20_000, *slopes.shape)))
    share = np.isfinite(shown.score[-1]).mean()
    assert abs(share - LEVEL / plan.codes) < 4.0 * math.sqrt(LEVEL / plan.codes / 20_000)


def test_a_slip_in_a_group_of_its_own_is_covered():
    """What the advice is for: U of the rows with a group from the slip on covers again."""
    before, after = [], []
    for seed in range(12):
        c = world("slipped", seed)
        before.append(np.abs(c.parameters - TRUTH) <= c.U)
        names = ("ax", "ay", "az", "up_x", "up_y", "up_z")
        columns = dict(zip(names, np.hstack([c.readings.values, c.readings.up]).T, strict=True))
        (finding,) = c.findings
        first = c.readings.labels.index(finding.rows[0])
        columns["group"] = ["" if row < first else "late" for row in range(24)]
        again = mp.fit(columns, outputs=["ax", "ay", "az"], unit="g")
        after.append(np.abs(again.parameters - TRUTH) <= again.U)
    assert np.mean(before) < 0.8
    assert np.mean(after) > 0.9


def test_a_drift_is_fitted_and_left_out_of_compensation(tmp_path):
    """5 mg over 23 minutes is 13 mg/h; the sensor is what it was, as its file has it."""
    rng = np.random.default_rng(8)
    up = rng.permutation(mp.read_scheme("fibonacci-24").up)
    time = 60.0 * np.arange(24.0)
    y = (
        ZERO
        + up @ K.T
        + 5e-3 * (time / time[-1] - 0.5)[:, None]
        + SD * rng.standard_normal((24, 3))
    )
    names = ("ax", "ay", "az", "up_x", "up_y", "up_z")
    columns = dict(zip(names, np.hstack([y, up]).T, strict=True)) | {"time": time}
    c = mp.fit(columns, unit="g", drift=True)
    drift = c["ax", "drift"]
    assert (drift.name, drift.unit) == ("drift_ax", "g/h")
    assert abs(drift.value - 5e-3 / (time[-1] / 3600.0)) < 2.0 * drift.U
    assert not warned(c)
    assert abs(c["bias_ax"].value - ZERO[0]) < 2.0 * c["bias_ax"].U
    c.save(tmp_path / "c.json")
    assert mp.load(tmp_path / "c.json") == c
    force = np.linalg.solve(K, y[0] - ZERO)
    np.testing.assert_allclose(c.compensate(y[:1])[0], force, rtol=0, atol=3e-4)
    assert "drift" not in mp.export(c, "c").text
    del columns["time"]
    by_row = mp.fit(columns, unit="g", drift=True)["drift_ax"]
    assert by_row.unit == "g/row"
    assert abs(23.0 * by_row.value - 5e-3) < 46.0 * by_row.U


@pytest.mark.parametrize(
    "options", [{"orientation_sd": 0.02}, {"unknown_orientation": True}], ids=str
)
def test_a_drift_is_fitted_whatever_is_known_of_orientations(options, tmp_path):
    """A rise of 5 mg from the first row to the last; an export holds the sensor without it."""
    rng = np.random.default_rng(8)
    up = rng.permutation(mp.read_scheme("fibonacci-24").up)
    y = ZERO + up @ K.T + 5e-3 * np.linspace(-0.5, 0.5, 24)[:, None]
    readings = mp.Readings(y + SD * rng.standard_normal((24, 3)), up=up, unit="g")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mp.CalibrationWarning)  # directions are ignored
        c = mp.fit(readings, drift=True, **options)
    for name in ("drift_ax", "drift_ay", "drift_az"):
        assert c[name].U < 1e-4
        assert abs(23.0 * c[name].value - 5e-3) < 46.0 * c[name].U
    mp.export(c, "c").save(tmp_path / "c.c")
    assert read_back(tmp_path / "c.c", c).difference < 1e-12


@pytest.mark.parametrize("options", [EXACT, {}], ids=["exact", "estimated"])
def test_a_coarse_grid_is_the_floor_of_u(options):
    """Readings to 8 mg of a noise of .1 mg: a rounding is uniform, of sd 8/√12 = 2.31 mg."""
    hits = []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        up = mp.read_scheme("faces-6").up
        slopes = np.eye(3) + 8e-3 * rng.uniform(-1.0, 1.0, (3, 3))
        zero = 0.02 * rng.standard_normal(3)
        y = zero + up @ slopes.T + SD * rng.standard_normal((6, 3))
        c = mp.fit(mp.Readings(8e-3 * np.round(y / 8e-3), up=up, unit="g"), **options)
        assert not warned(c)
        if options:
            assert "quantized" in {finding.code for finding in c.findings}
        assert c.U.min() > 1.9 * 8e-3 / math.sqrt(12.0 * 6.0)
        hits.append(np.abs(c.parameters - np.column_stack([zero, slopes]).ravel()) <= c.U)
    assert np.mean(hits) > 0.93


def test_the_level_of_a_table_is_no_orientation_error():
    """A tilt of .1° east, seen by 24 attitudes of the case: one cause, of that size."""
    rng = np.random.default_rng(5)
    rotations = np.linalg.qr(rng.standard_normal((24, 3, 3)))[0]
    rotations *= np.linalg.det(rotations)[:, None, None]
    plumb = np.array([math.sin(math.radians(0.1)), 0.0, math.cos(math.radians(0.1))])
    y = ZERO + rotations @ plumb @ K.T + SD * rng.standard_normal((24, 3))
    found = mp.fit(mp.Readings(y, rotation=rotations, up=rotations[:, :, 2])).findings
    (finding,) = (each for each in found if each.level == "warning")
    assert finding.code == "level"
    assert abs(float(re.search(r"([\d.]+) degrees", finding.text)[1]) - 0.1) < 0.01


def test_axes_that_are_not_square_are_no_turn():
    slanted = np.eye(3)
    slanted[1] = [0.5, math.sqrt(0.75), 0.0]  # y stands 30° from where it should
    up = mp.read_scheme("fibonacci-24").up
    noise = SD * np.random.default_rng(6).standard_normal((24, 3))
    assert not warned(mp.fit(mp.Readings(up @ slanted.T + noise, up=up)))


def test_one_degree_of_freedom_has_no_cause_of_time():
    """Divided by their own size such residuals are signs, of which any cause makes one pattern."""
    up, rng = mp.read_scheme("song-qin-6").up, np.random.default_rng(5)
    for _ in range(20):
        readings = mp.Readings(0.01 + up + 1e-3 * rng.standard_normal((6, 3)), up=up)
        cal = mp.fit(readings, model="own-quadratic", pool=True)
        assert not {"slipped", "settling"} & {found.code for found in cal.findings}


@pytest.mark.parametrize("seed", range(3))
def test_a_missing_term_of_ordered_positions_is_no_change_and_no_slow_noise(seed):
    """Faces, edges, corners, in this order and by time: own^2 by itself steps at row 7."""
    rng = np.random.default_rng(seed)
    up = mp.read_scheme("all-26").up
    y = ZERO + up @ K.T + 1.5e-3 * up**2 * np.array([0.5, -0.3, -1.0])
    y = y + 0.5 * SD * rng.standard_normal(y.shape)
    table = dict(zip(("ax", "ay", "az"), y.T, strict=True)) | {"time": 6.0 * np.arange(26)}
    found = mp.fit(table, unit="g", unknown_orientation=True)
    assert found.effective_rows  # which alone would hide the term
    (named,) = (each for each in found.findings if each.level == "warning")
    assert named.code == "missing-term"
    assert "own^2" in named.text
    assert mp.fit(table, unit="g", unknown_orientation=True, model="own-quadratic").rms < SD


def test_a_drift_and_a_slip_by_two_fits_each():
    """Λ and S from sums of squares with and without the columns, by NumPy's least squares."""
    # eqs. (1), (3) of diagnostics.row_order
    c = world("drift", 3)
    n, e = len(c.reference), c.residuals
    X = np.column_stack([np.ones(n), c.reference])
    t = np.arange(n) - (n - 1) / 2.0
    with_drift = np.column_stack([X, t])
    left = e - with_drift @ np.linalg.lstsq(with_drift, e, rcond=None)[0]
    gain = -(n - 4) * np.sum(np.log(np.sum(left**2, axis=0) / np.sum(e**2, axis=0)))
    found = {cause.code: cause for cause in search(c)}
    score = gain - 3 * math.log(3 * (n - 4)) - 2.0 * math.log(4)  # a line and three warm-ups
    assert found["drift"].score == pytest.approx(score, rel=1e-9)
    c = world("slipped", 4)
    X = np.column_stack([np.ones(n), c.reference])
    e, row, nu, scatter = c.residuals, n // 2, n - 4, np.ones(3)
    turns = np.cross(c.reference[:, None], np.eye(3)) * (np.arange(n) >= row)[:, None, None]
    Z = np.einsum("naq,ma->nmq", turns, c.sensitivity)
    V = Z - np.einsum("nk,kmq->nmq", X @ np.linalg.pinv(X), Z)
    for _ in range(60):  # outputs weighted by what they scatter beside the slip
        w = 1.0 / np.repeat([scatter], n, axis=0).ravel()
        rows = V.reshape(-1, 3)
        sizes = np.linalg.solve(rows.T @ (w[:, None] * rows), rows.T @ (w * e.ravel()))
        scatter = np.sum((e - V @ sizes) ** 2, axis=0) / nu
    gain = nu * np.sum(np.log(np.sum(e**2, axis=0) / (nu * scatter)))
    cause = {each.code: each for each in search(c)}["slipped"]
    score = gain - 3 * math.log(3 * nu) - 2.0 * math.log(n - 4)  # rows 3 to n − 2
    assert (cause.row, cause.score) == (row, pytest.approx(score, rel=1e-3))


def test_a_drift_is_named_beside_a_stated_noise():
    assert "drift" in {finding.code for finding in world("drift", 3, reading_sd=SD).findings}


@pytest.mark.parametrize("beside", [False, True])
def test_the_law_of_slow_noise_is_that_of_a_ratio_of_squares(beside):
    """Σ λ z²/Σ z² of normal z: three moments, λ the eigenvalues of Ω beside the fit.

    By the moments of Dirichlet's law: (Σλ)/ν, (2 Σλ² + (Σλ)²)/ν(ν + 2), and so on.
    """
    # eq. (2) of diagnostics.row_order
    rng = np.random.default_rng(8)
    n, groups, total = 14, [], np.zeros(3)
    across = rng.normal(size=(n, 3)) if beside else None
    gap = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    omega = _correlation(n) ** gap
    if across is not None:
        omega = omega * (across @ across.T)
    for p, outputs in ((3, [0, 1]), (5, [2])):
        Q = np.linalg.qr(rng.normal(size=(n, n)))[0]
        groups.append((np.array(outputs), np.ascontiguousarray(Q[:, :p])))
        values, nu = np.linalg.eigvalsh(Q[:, p:].T @ omega @ Q[:, p:]), n - p
        s1, s2, s3 = (np.sum(values**k) for k in (1, 2, 3))
        m1, m2 = s1 / nu, (2 * s2 + s1**2) / (nu * (nu + 2))
        m3 = (8 * s3 + 6 * s1 * s2 + s1**3) / (nu * (nu + 2) * (nu + 4))
        total += len(outputs) * np.array([m1, m2 - m1**2, m3 - 3 * m1 * m2 + 2 * m1**3])
    mean, sd, skewness = _law_of_slow(tuple(groups), across)
    np.testing.assert_allclose([mean, sd**2, skewness * sd**3], total, rtol=1e-9)


def test_one_size_of_all_outputs_makes_the_product_of_their_squares_least():
    """Σ ν ln |e − V s|² over outputs, by SciPy's search; Λ is by how much it falls."""
    rng = np.random.default_rng(3)
    bases = [np.linalg.qr(rng.normal(size=(14, k)))[0] for k in (2, 4)]
    Z = rng.normal(size=(1, 14, 2, 1))
    e = np.array([0.3, 1.5]) * rng.normal(size=(1, 14, 2)) + 0.4 * Z[..., 0]
    for i, Q in enumerate(bases):
        e[0, :, i] -= Q @ (Q.T @ e[0, :, i])

    def deviance(s):
        total = 0.0
        for i, Q in enumerate(bases):
            V = Z[0, :, i, 0] - Q @ (Q.T @ Z[0, :, i, 0])
            total += (14 - Q.shape[1]) * np.log(np.sum((e[0, :, i] - s * V) ** 2))
        return total

    found = optimize.minimize_scalar(deviance, bounds=(-2.0, 2.0), method="bounded")
    sizes, gain = fit_sizes(bases, Z, e)
    assert sizes[0, 0] == pytest.approx(found.x, abs=2e-3)
    assert gain[0] == pytest.approx(deviance(0.0) - found.fun, rel=1e-3)


def test_where_a_cause_may_begin():
    assert _some(3, 6).tolist() == [3, 4, 5]
    assert _some(5, 3).tolist() == []
    assert _some(_MOST, _MOST + 2).tolist() == [_MOST, _MOST + 1]
    many = _some(7, 7 + 10 * _MOST)
    assert (len(many), many[0], many[-1]) == (_MOST, 7, 6 + 10 * _MOST)
