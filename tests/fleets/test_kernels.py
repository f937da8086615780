"""Batches of other estimators than the plain one are the fit of each unit, and not by chance.

Searches end within 1e-7 u of the optimum, wherever they began: numbers are held to 1e-6 u.
"""

import numpy as np
import pytest
from fleet_bench import line, rows_of
from hypothesis import example, given, settings
from hypothesis import strategies as st

import multipos as mp
from multipos.fleets import solving
from multipos.numerics.quantiles import coverage_factors

pytestmark = pytest.mark.filterwarnings("ignore::multipos.errors.CalibrationWarning")
APART = {"unit_column": "unit", "station_column": "station"}
KNOWN = {"orientation_sd": 0, "exclude": "none"}  # least squares of the listed orientations


def worst_difference(found, table, **options):
    """The largest difference to `fit` in units of u, of u and rms relative."""
    worst = 0.0
    for row, unit in enumerate(found["unit"].tolist()):
        assert not found["reason"][row]
        with pytest.MonkeyPatch.context() as patch:  # findings change no number
            patch.setattr("multipos.fitting.fit_readings.examine", lambda c, **_: c)
            cal = mp.fit(rows_of(table, unit), **options)
        for p in cal.entries:
            differences = (
                (found[p.name][row] - p.value) / p.u,
                found[f"u_{p.name}"][row] / p.u - 1.0,
                found[f"dof_{p.name}"][row] / p.dof - 1.0 if np.isfinite(p.dof) else 0.0,
            )
            worst = max(worst, *map(abs, differences))
        worst = max(worst, abs(found["rms"][row] / cal.rms - 1.0))
    return worst


@pytest.fixture
def fitted(monkeypatch):
    """How many units were fitted one by one, the first of a group included."""
    count = []
    fit = solving.fit
    monkeypatch.setattr(solving, "fit", lambda *a, **o: count.append(1) or fit(*a, **o))
    return count


@pytest.mark.parametrize(
    ("scheme", "options"),
    [
        ("fibonacci-24", {}),
        ("fibonacci-24", {"gauge": "symmetric", "confidence": 0.99}),
        ("icosahedron-12", {"convention": "gravity", "gravity": 9.81, "gravity_u": 1e-4}),
        ("all-26", {"model": "own-quadratic"}),
        ("fibonacci-24", {"model": "1 + x + y + z + own^3"}),
        ("fibonacci-24", {"model": "1 + x + y + z + temperature"}),
    ],
)
def test_unknown_orientation(scheme, options, fitted):
    table = line(4, scheme=scheme, noise=1e-4)
    surroundings = np.random.default_rng(3).uniform(-10.0, 10.0, len(table["unit"]) // 4)
    table["temperature"] = np.tile(surroundings, 4)
    found = mp.fit_many(table, unknown_orientation=True, **APART, **options)
    assert len(fitted) == 1  # for the columns, and for what units share
    assert worst_difference(found, table, unknown_orientation=True, **options) < 1e-6


def stated(table, low=5e-4, high=1.5e-3, dof=None, seed=0):
    """The table with u of every reading, and their degrees of freedom."""
    rng = np.random.default_rng(seed)
    table = dict(table)
    for axis in "xyz":
        table[f"u_a{axis}"] = rng.uniform(low, high, len(table["unit"]))
        if dof is not None:
            table[f"dof_a{axis}"] = rng.uniform(*dof, len(table["unit"]))
    return table


@pytest.mark.parametrize(
    ("stated_noise", "options"),
    [
        (None, {"reading_sd": 1e-3}),
        (None, {"reading_sd": [1e-3, 2e-3, 5e-4], "pool": True}),
        (None, {"reading_sd": 2e-4, "model": "own-quadratic"}),  # which the residuals deny
        ({}, {}),
        ({"low": 1e-3, "high": 1e-3}, {"gravity": 9.81, "gravity_u": 1e-4}),
        ({"low": 1e-5, "high": 5e-3}, {"model": "1 + x + y + z + own^3"}),
        ({"dof": (3.0, 9.0)}, {}),
        ({"dof": (30.0, 5000.0)}, {"confidence": 0.9}),
    ],
)
def test_stated_noise(stated_noise, options, fitted):
    options = KNOWN | options
    table = line(5) if stated_noise is None else stated(line(5), **stated_noise)
    found = mp.fit_many(table, **APART, **options)
    unlike = bool(stated_noise and stated_noise.get("high") == 5e-3)  # rows seem to stick out
    assert len(fitted) == 1 or unlike
    assert worst_difference(found, table, **options) < 1e-9  # no search, but eq. (1) in two turns


@pytest.mark.parametrize(
    ("stated_noise", "options"),
    [
        (None, {"reading_sd": 1e-4}),  # which the residuals deny
        (None, {"reading_sd": [1e-3, 2e-3, 5e-4], "confidence": 0.99}),
        (None, {"reading_sd": 1e-3, "model": "own-quadratic"}),
        ({}, {"gravity": 9.81, "gravity_u": 1e-3}),
        ({"low": 1e-5, "high": 5e-3}, {"gauge": "symmetric"}),
        ({"dof": (3.0, 9.0)}, {}),
        ({"low": 1e-5, "high": 5e-3, "dof": (2.0, 5000.0)}, {"model": "1 + x + y + z + own^3"}),
    ],
)
def test_unknown_orientation_with_stated_noise(stated_noise, options, fitted):
    table = (
        line(4, scheme="all-26")
        if stated_noise is None
        else stated(line(4, scheme="all-26"), **stated_noise)
    )
    found = mp.fit_many(table, unknown_orientation=True, **APART, **options)
    # one for the columns; faces and corners hardly show own*|own| beside own^3, which is asked of
    assert len(fitted) == 1 + ("own^3" in options.get("model", ""))
    assert worst_difference(found, table, unknown_orientation=True, **options) < 1e-6


@pytest.mark.parametrize(
    ("scheme", "options"),
    [
        ("fibonacci-24", {"robust": "huber"}),
        ("all-26", {"robust": "soft-l1", "model": "own-quadratic"}),
        ("icosahedron-12", {"robust": "cauchy", "gravity": 9.81, "gravity_u": 1e-3}),
        ("faces-corners-14", {"robust": "huber", "model": "1 + x + y + z"}),
    ],
)
def test_robust(scheme, options):
    table = line(4, scheme=scheme, noise=3e-4)
    found = mp.fit_many(table, **APART, **options)
    assert worst_difference(found, table, **options) < 1e-9  # the search of both is one


@settings(max_examples=4, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([1e-5, 3e-4, 5e-3]),
    st.sampled_from([1.0, 16384.0, 1e-7]),
    st.sampled_from(["huber", "soft-l1", "cauchy"]),
    st.sampled_from(["faces-corners-14", "fibonacci-24"]),
)
def test_noise_unit_and_loss_do_not_matter(seed, noise, size, loss, scheme):
    table = line(3, scheme=scheme, noise=noise, seed=seed)
    for axis in "xyz":
        table[f"a{axis}"] = size * table[f"a{axis}"]
    found = mp.fit_many(table, robust=loss, **APART)
    assert worst_difference(found, table, robust=loss) < 1e-6


def test_a_robust_unit_with_a_position_far_off_is_that_of_fit():
    table = line(5)
    table["ax"][24 * 2 + 3] += 0.05
    found = mp.fit_many(table, robust="huber", **APART)
    assert worst_difference(found, table, robust="huber") < 1e-9


@pytest.mark.parametrize("options", [{"reading_sd": 1e-3}, {"pool": True}])
def test_robust_fits_that_are_no_batch(options):
    table = line(3)
    found = mp.fit_many(table, robust="huber", **APART, **options)
    assert worst_difference(found, table, robust="huber", **options) < 1e-9


def placed(units, sd=0.1, **options):
    """A line whose positions are off by so many degrees."""
    table = line(units, **options)
    up = np.column_stack([table[f"up_{axis}"] for axis in "xyz"])
    turns = np.radians(sd) * np.random.default_rng(7).standard_normal(up.shape)
    for axis, off in zip("xyz", np.cross(turns, up).T, strict=True):
        table[f"a{axis}"] = table[f"a{axis}"] + off
    return table


@pytest.mark.parametrize(
    ("scheme", "options"),
    [
        ("fibonacci-24", {"orientation_sd": 0.1}),
        ("fibonacci-24", {"orientation_sd": 0.02}),  # less than they are off by
        ("all-26", {"orientation_sd": 0.1, "model": "own-quadratic", "confidence": 0.99}),
        ("fibonacci-24", {"orientation_sd": 0.1, "model": "1 + x + y + z + temperature"}),
        ("faces-6", {"orientation_sd": 0.1, "convention": "gravity", "gravity": 9.81}),
        ("fibonacci-16", {"orientation_sd": 0.1, "gravity": 9.81, "gravity_u": 1e-4}),
        ("fibonacci-24", {"orientation_sd": 0.1, "reading_sd": 3e-4}),
        ("icosahedron-12", {"orientation_sd": 0.1, "reading_sd": [2e-4, 3e-4, 5e-4]}),
        ("faces-corners-14", {"orientation_sd": 0.1}),
        ("fibonacci-24", {}),
        ("icosahedron-12", {}),
        ("all-26", {"orientation_sd": "auto", "model": "own-quadratic"}),
        ("fibonacci-16", {"orientation_sd": "auto", "reading_sd": 2e-4}),
    ],
)
def test_uncertain_orientation(scheme, options, fitted):
    table = placed(4, scheme=scheme, noise=3e-4)
    surroundings = np.random.default_rng(3).uniform(-10.0, 10.0, len(table["unit"]) // 4)
    table["temperature"] = np.tile(surroundings, 4)
    if options.get("convention") == "gravity":
        for axis in "xyz":
            table[f"a{axis}"] = -table[f"a{axis}"]
    found = mp.fit_many(table, **APART, **options)
    # for the columns, for what units share (as listed, too), and one that may stick out
    if scheme != "faces-6":  # of fewer than 12 positions each is fitted singly
        assert len(fitted) <= (3 if options.get("orientation_sd") == 0.1 else 4)
    # "auto" beside a stated noise: values within 1e-6 u, but u itself only within 3e-5, which no
    # digit of U shows. Both searches end 5e-7 u apart; why u feels it more is not known (the cut
    # of grids at faint nodes is not why).
    both = options.get("orientation_sd") == "auto" and "reading_sd" in options
    assert worst_difference(found, table, **options) < (1e-4 if both else 1e-6)


@pytest.mark.parametrize(
    ("stated_noise", "sd"),
    [
        ({}, 0.1),
        ({"low": 1e-5, "high": 1e-3}, 0.1),
        ({"dof": (3.0, 9.0)}, 0.1),
        ({"low": 3e-4, "high": 3e-4, "dof": (3.0, 9.0)}, "auto"),
    ],
)
def test_uncertain_orientation_with_u_of_every_reading(stated_noise, sd, fitted):
    table = stated(placed(3, noise=3e-4), **({"low": 2e-4, "high": 4e-4} | stated_noise))
    found = mp.fit_many(table, orientation_sd=sd, **APART)
    # outputs drawn together each by itself are unlike, which leaves "auto" to the fit of one
    assert len(fitted) <= (3 if sd == 0.1 else 5)
    assert worst_difference(found, table, orientation_sd=sd) < 1e-6


@pytest.mark.parametrize("options", [{}, {"orientation_sd": "auto"}])
def test_orientation_sds_of_every_position(options):
    table = placed(3, noise=3e-4)
    table["orientation_sd_deg"] = np.tile(np.where(np.arange(24) % 4, 0.1, 0.0), 3)
    found = mp.fit_many(table, **APART, **options)
    assert worst_difference(found, table, **options) < 1e-6


@settings(max_examples=4, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([1e-5, 3e-4, 5e-3]),
    st.sampled_from([1.0, 16384.0, 1e-7]),
    st.sampled_from([0.01, 0.3, 4.0]),
    st.sampled_from(["faces-corners-14", "fibonacci-24"]),
)
def test_noise_unit_and_placement_do_not_matter(seed, noise, size, sd, scheme):
    table = placed(2, sd, scheme=scheme, noise=noise, seed=seed)
    for axis in "xyz":
        table[f"a{axis}"] = size * table[f"a{axis}"]
    found = mp.fit_many(table, orientation_sd=sd, **APART)
    assert worst_difference(found, table, orientation_sd=sd) < 1e-6


def test_placement_that_no_scatter_explains_is_left_to_fit():
    table = placed(3, 0.5, noise=3e-4)
    options = {"orientation_sd": 0.05, "reading_sd": 3e-4}
    found = mp.fit_many(table, **APART, **options)
    assert worst_difference(found, table, **options) < 1e-6


def test_outputs_that_scatter_unlike_are_told_apart_unit_by_unit(fitted):
    table = line(6)
    loud = table["unit"] == "U0003"
    table["az"][loud] += 3e-3 * np.random.default_rng(4).standard_normal(24)
    options = KNOWN | {"reading_sd": 2e-4}
    found = mp.fit_many(table, **options, **APART)
    assert len(fitted) <= 3  # that unit may be looked at in full
    assert worst_difference(found, table, **options) < 1e-9
    # Noise stated far too small leaves U to what each output shows of its own: that of least
    # squares of it alone, t of 24 - 4. An excess over 14 nodes is within .5 %,
    # of the quiet output, which is drawn to the others, 1 %.
    X = np.column_stack([np.ones(24), *(table[f"up_{axis}"][loud] for axis in "xyz")])
    for output, name, part in (("ay", "cross_ay_z", 0.01), ("az", "scale_az", 0.005)):
        rest = np.linalg.lstsq(X, table[output][loud], rcond=None)[1][0]
        alone = 2.0860 * np.sqrt(rest / 20.0 * np.linalg.inv(X.T @ X)[3, 3])  # by table
        half = found[f"u_{name}"][3] * coverage_factors(0.95, found[f"dof_{name}"][[3]])[0]
        assert half == pytest.approx(alone, rel=part), name


@pytest.mark.parametrize(
    ("low", "high", "options"),
    [(6e-4, 9e-4, KNOWN), (4e-4, 8e-4, {"unknown_orientation": True})],
)
def test_a_claim_that_residuals_deny_is_said_unit_by_unit(low, high, options):
    table = stated(line(12), low, high)
    found = mp.fit_many(table, **APART, **options)
    said = []
    for unit in found["unit"].tolist():
        findings = mp.fit(rows_of(table, unit), **options).diagnostics.findings
        said.append("denied-noise" in {finding.code for finding in findings})
    assert [("denied-noise" in each.split(";")) for each in found["findings"]] == said
    assert 0 < sum(said) < len(said)


@pytest.mark.parametrize("options", [{}, {"unknown_orientation": True}])
def test_claims_that_are_none_are_left_to_fit(options):
    table = stated(line(5))
    table["u_ay"][24 * 2 + 3] = np.nan
    table["u_ax"][24 * 4] = -1.0
    found = mp.fit_many(table, **APART, **options)
    for row in (2, 4):
        with pytest.raises(mp.MultiposError) as said:
            mp.fit(rows_of(table, found["unit"][row]), **options)
        assert found["reason"][row] == str(said.value).replace("readings", "table", 1)
    assert [bool(reason) for reason in found["reason"]] == [False, False, True, False, True]


# In one unit of each example a step towards the minimum takes less off F than F is rounded by.
@settings(max_examples=4, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([1e-5, 1e-4, 5e-3]),
    st.sampled_from([1.0, 16384.0, 1e-7]),
    st.sampled_from([1e-3, 0.1]),
    st.sampled_from([None, {}, {"dof": (3.0, 60.0)}]),
)
@example(3874861665, 1e-4, 16384.0, 1e-3, None)
@example(129428, 1e-4, 1e-7, 1e-3, None)
def test_noise_unit_lot_and_claims_do_not_matter(seed, noise, size, lot, stated_noise):
    table = line(3, noise=noise, seed=seed, lot=lot)
    for axis in "xyz":
        table[f"a{axis}"] = size * table[f"a{axis}"]
    if stated_noise is not None:
        table = stated(table, 0.5 * noise * size, 1.5 * noise * size, seed=seed, **stated_noise)
    found = mp.fit_many(table, unknown_orientation=True, **APART)
    assert worst_difference(found, table, unknown_orientation=True) < 1e-6


def test_a_unit_whose_search_is_no_search_is_left_to_fit():
    table = line(6, noise=1e-4)
    flat, loud = (table["unit"] == unit for unit in ("U0002", "U0004"))
    table["az"][flat] = 0.1  # on a circle
    table["ax"][loud] += np.random.default_rng(1).standard_normal(24)
    found = mp.fit_many(table, unknown_orientation=True, **APART)
    for row, unit in ((2, "U0002"), (4, "U0004")):
        with pytest.raises(mp.MultiposError) as said:
            mp.fit(rows_of(table, unit), unknown_orientation=True)
        assert found["reason"][row] == " ".join(str(said.value).split())
    assert [bool(reason) for reason in found["reason"]] == [False, False, True, False, True, False]


@pytest.mark.parametrize("options", [{}, {"gravity": 9.81, "gravity_u": 0.03}])
def test_what_the_positions_hardly_tell_is_said_unit_by_unit(options):
    table = line(12, scheme="icosahedron-12", noise=5e-3)
    options = {"unknown_orientation": True, **options}
    found = mp.fit_many(table, **options, **APART)
    said = []
    for unit in found["unit"].tolist():
        findings = mp.fit(rows_of(table, unit), **options).diagnostics.findings
        said.append("no-redundancy" in {finding.code for finding in findings})
    assert [("no-redundancy" in each.split(";")) for each in found["findings"]] == said
    assert 0 < sum(said) < len(said)


@pytest.mark.parametrize("options", [{}, {"unknown_orientation": True}])
def test_a_line_that_is_all_in_another_unit_is_doubted(options):
    table = line(5)
    for axis in "xyz":
        table[f"a{axis}"] = 9.8 * table[f"a{axis}"]
    found = mp.fit_many(table, unit="g", **APART, **options)
    assert [findings.split(";")[0] for findings in found["findings"]] == ["unit"] * 5
