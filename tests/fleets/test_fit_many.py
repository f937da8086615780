"""Every unit's numbers are those of `fit` of the unit alone."""

from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest
from fleet_bench import line, rows_of
from hypothesis import given, settings
from hypothesis import strategies as st

import multipos as mp
from multipos.fleets import solving, tasks
from multipos.fleets.workers import open_engine

pytestmark = pytest.mark.filterwarnings("ignore::multipos.errors.CalibrationWarning")


def worst_difference(found, table, **options):
    """The largest difference to `fit`, relative to the larger of |value| and u."""
    worst = 0.0
    for row, unit in enumerate(found["unit"].tolist()):
        with pytest.MonkeyPatch.context() as patch:  # findings change no number
            patch.setattr("multipos.fitting.fit_readings.examine", lambda c, **_: c)
            cal = mp.fit(rows_of(table, unit), **options)
        scale = np.maximum(np.abs(cal.parameters), cal.u)
        mine = np.array([found[name][row] for name in cal.names])
        u = np.array([found[f"u_{name}"][row] for name in cal.names])
        dof = np.array([found[f"dof_{name}"][row] for name in cal.names])
        np.testing.assert_allclose(dof, cal.parameter_dof, rtol=1e-10)
        worst = max(
            worst,
            float(np.max(np.abs(mine - cal.parameters) / scale)),
            float(np.max(np.abs(u - cal.u) / cal.u)),
            abs(found["rms"][row] / cal.rms - 1.0),
        )
    return worst


OWN = "each = b + s*own/(1 + k*own^2)"
KNOWN = {"orientation_sd": 0, "exclude": "none"}  # least squares of the listed orientations


@pytest.mark.parametrize(
    "model", ["linear", "own-quadratic", "ieee", "ieee-odd", "1 + x + y + z + own*|own|", OWN]
)
def test_a_batch_is_the_fit_of_each_unit(model):
    table = line(6)
    options = KNOWN | {"model": model}
    found = mp.fit_many(table, unit_column="unit", station_column="station", **options)
    assert not any(found["reason"])
    assert worst_difference(found, table, **options) < 1e-10


@pytest.mark.parametrize(
    "options",
    [
        {"pool": True},
        {"convention": "gravity"},
        {"gravity": 9.81, "gravity_u": 1e-4},
        {"reading_sd": 1e-3},
        {"unknown_orientation": True},
        {"robust": "huber"},
        {"outputs": "ax,ay"},
        {"outputs": "az", "axes": "z"},
        {"level_sd": 0.0, "axes": "y,x,z"},
        {"model": OWN, "outputs": "ax,ay"},
        {"model": "each = p + q*x + r*y + t*z", "convention": "gravity"},
        {"model": OWN, "pool": True},
        {"range": (-2.0, 2.0)},
    ],
    ids=str,
)
def test_options_reach_every_unit(options):
    if "unknown_orientation" not in options:
        options = KNOWN | options
    table = line(3, scheme="faces-corners-14")
    if "outputs" in options:
        kept = options["outputs"].split(",")
        table = {name: c for name, c in table.items() if name not in {"ax", "ay", "az"} - {*kept}}
    found = mp.fit_many(table, unit_column="unit", station_column="station", **options)
    assert worst_difference(found, table, **options) < 1e-10


@settings(max_examples=15, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([1e-6, 1e-4, 1e-2]),
    st.sampled_from([1.0, 16384.0, 1e-7]),
    st.sampled_from(["faces-6", "corners-8", "icosahedron-12", "all-26"]),
    st.sampled_from(["linear", "1 + x + y + z + own^3"]),
)
def test_noise_unit_and_scheme_do_not_matter(seed, noise, size, scheme, model):
    if scheme in ("faces-6", "corners-8"):
        model = "linear"
    table = line(3, scheme=scheme, noise=noise, seed=seed)
    for axis in "xyz":
        table[f"a{axis}"] = size * table[f"a{axis}"]
    options = KNOWN | {"model": model}
    found = mp.fit_many(table, unit_column="unit", station_column="station", **options)
    # residuals of readings of about 1 g are rounded to this share of the noise
    rounding = 4.0 * np.finfo(float).eps / noise
    assert worst_difference(found, table, **options) < 1e-10 + rounding


@pytest.mark.parametrize(
    ("options", "timed"),
    [({}, False), ({"reading_sd": 1e-3}, False), ({"unknown_orientation": True}, True)],
    ids=str,
)
def test_units_whose_rows_are_correlated_have_the_u_of_fit(options, timed):
    table = line(6, scheme="fibonacci-24+fibonacci-24")
    if timed:
        table["time"] = np.tile(np.arange(48.0), 6)
    rng = np.random.default_rng(5)
    drift_factor = np.cumsum(1e-3 * rng.standard_normal((48, 3, 6)), axis=0)
    drift_factor[:, :, ::2] = 0.0
    for i, name in enumerate(("ax", "ay", "az")):
        table[name] = table[name] + drift_factor[:, i].T.ravel()
    found = mp.fit_many(table, unit_column="unit", station_column="station", **options)
    assert worst_difference(found, table, **options) < 1e-10
    codes = [
        [finding.code for finding in mp.fit(rows_of(table, unit), **options).diagnostics.findings]
        for unit in found["unit"].tolist()
    ]
    said = ["time-correlated" in each for each in codes]
    assert not any(said[::2])
    assert sum(said[1::2]) >= 2  # of three that drift, of which one residual a row shows less


def test_units_that_cannot_be_fitted_are_not_tried_again(monkeypatch):
    """Three for their outputs, three for what the group shares, and the other two."""
    tried = []
    for module in (tasks, solving):
        monkeypatch.setattr(module, "fit_one", lambda table, options: tried.append(1) or "no fit.")
    found = mp.fit_many(line(5), unit_column="unit")
    assert (len(tried), found["reason"].tolist()) == (8, ["no fit."] * 5)


def test_units_may_be_ragged_and_their_rows_anywhere():
    table = line(12)
    rng = np.random.default_rng(1)
    kept = rng.permutation(np.flatnonzero(rng.random(len(table["unit"])) < 0.9))
    table = {name: column[kept] for name, column in table.items()}
    found = mp.fit_many(table, unit_column="unit", station_column="station")
    assert set(found["unit"]) == set(table["unit"])
    assert found["unit"].tolist() == list(dict.fromkeys(table["unit"].tolist()))
    assert worst_difference(found, table) < 1e-10


def test_units_with_columns_of_the_model_of_their_own():
    table = line(4)
    rng = np.random.default_rng(2)
    table["temperature"] = 25.0 + 10.0 * rng.standard_normal(len(table["unit"]))
    model = "1 + x + y + z + temperature"
    found = mp.fit_many(table, unit_column="unit", station_column="station", model=model)
    assert worst_difference(found, table, model=model) < 1e-10


# In the second units share their temperatures, in the third they are within 1 K.
@pytest.mark.parametrize(("rows", "sd"), [(96, 10.0), (24, 10.0), (96, 0.15)])
def test_a_term_of_temperature_that_the_model_lacks(rows, sd):
    table = line(4)
    column = 25.0 + sd * np.random.default_rng(2).standard_normal(rows)
    table["temperature"] = np.resize(column, 96)
    table["ax"] = table["ax"] + 0.1 / sd * (table["temperature"] - 25.0)
    found = mp.fit_many(table, unit_column="unit", station_column="station")
    assert found["findings"].tolist() == ["missing-term"] * 4
    assert worst_difference(found, table) < 1e-10


@pytest.mark.parametrize("cell", [np.nan, 1e308, -1e308])
@pytest.mark.parametrize("options", [{}, {"orientation_sd": 0.2, "reading_sd": 1e-3}])
def test_a_unit_without_a_temperature_is_not_asked_what_it_explains(cell, options):
    table = line(4)
    column = 25.0 + 10.0 * np.random.default_rng(2).standard_normal(96)
    table["ax"] = table["ax"] + 0.001 * (column - 25.0)
    column[np.flatnonzero(table["unit"] == "U0002")[3]] = cell
    table["temperature"] = column
    found = mp.fit_many(table, unit_column="unit", station_column="station", **options)
    missing = ["missing-term" in each for each in found["findings"].tolist()]
    assert missing == [True, True, False, True]
    assert (found["reason"] == "").all()


def test_a_unit_that_fails_is_a_row_with_its_reason():
    table = line(5)
    table["ay"][24 + 3] = np.nan  # of U0001
    keep = np.ones(len(table["unit"]), dtype=bool)
    keep[24 * 3 + 3 : 24 * 4] = False  # three rows of U0003 are left
    table = {name: column[keep] for name, column in table.items()}
    found = mp.fit_many(table, unit_column="unit", station_column="station")
    failed = np.array([bool(reason) for reason in found["reason"]])
    assert found["unit"][failed].tolist() == ["U0001", "U0003"]
    assert "row 4, column 'ay'" in found["reason"][1]
    assert "3 readings cannot determine the 4 terms" in found["reason"][3]
    assert np.isnan(found["bias_ax"][failed]).all()
    assert np.isfinite(found["bias_ax"][~failed]).all()


def test_a_unit_at_two_stations_is_calibrated_at_each():
    table = line(4)
    table["unit"] = np.repeat(["A", "B", "A", "B"], 24)
    table["station"] = np.repeat(["S0", "S0", "S1", "S1"], 24)
    found = mp.fit_many(table, unit_column="unit", station_column="station")
    assert found["unit"].tolist() == ["A", "B", "A", "B"]
    assert found["station"].tolist() == ["S0", "S0", "S1", "S1"]


def test_any_executor_gives_the_same():
    table = line(6)
    table["ax"][5] = np.nan
    options = {"unit_column": "unit", "station_column": "station", "scheme": "fibonacci-24"}
    one = mp.fit_many(table, **options)
    with ThreadPoolExecutor(2) as executor:
        assert mp.fit_many(table, executor=executor, **options) == one
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as executor:
        assert mp.fit_many(table, executor=executor, **options) == one


def test_options_that_no_unit_can_help_end_the_run():
    table = line(3)
    with pytest.raises(mp.UsageError, match="unknown model"):
        mp.fit_many(table, unit_column="unit", model="linnear")
    with pytest.raises(mp.UsageError, match="another model"):
        mp.fit_many(table, unit_column="unit", stepwise=True)
    with pytest.raises(mp.MultiposError, match="did you mean 'unit'"):
        mp.fit_many(table, unit_column="units")


def test_an_empty_unit_is_named_with_its_row(tmp_path):
    path = tmp_path / "line.csv"
    path.write_text("unit,direction,ax,ay,az\nA,E-N-U,0,0,1\n,N-U-E,0,1,0\n")
    with pytest.raises(mp.MultiposError, match=r"row 2 \(line 3\), column 'unit'"):
        mp.fit_many(path, unit_column="unit")


@pytest.mark.slow
def test_dask_on_a_cluster_of_two_workers_gives_the_same():
    distributed = pytest.importorskip("distributed")
    table = line(40)
    table["ax"][30] = np.nan
    options = {"unit_column": "unit", "station_column": "station"}
    one = mp.fleet(table, **options)
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None
    ) as cluster:
        two = mp.fleet(table, engine="dask", scheduler=cluster.scheduler_address, **options)
        with distributed.Client(cluster) as client:
            three = mp.fit_many(table, executor=client.get_executor(), **options)
    assert two.calibrations == one.calibrations == three
    assert two["stations"] == one["stations"]


def test_units_that_are_numbers_stay_numbers():
    table = line(3)
    table["unit"] = np.repeat([12, 7, 30], 24)
    assert mp.fit_many(table, unit_column="unit")["unit"].tolist() == [12, 7, 30]
    found = mp.fleet(table, unit_column="unit", station_column="station")
    assert found.verdicts["unit"].tolist() == [12, 7, 30]


def test_units_none_of_which_can_be_fitted_fail_each_by_itself():
    table = {
        "unit": [1, 1, 2, 2],
        "up_x": [0.0, 1.0] * 2,
        "up_y": [0.0] * 4,
        "up_z": [1.0, 0.0] * 2,
    }
    found = mp.fit_many(table | {"ax": [0.0, 1.0, 0.1, 0.9]}, unit_column="unit")
    assert found["unit"].tolist() == [1, 2]
    assert all(reason.startswith("2 readings cannot ") for reason in found["reason"])


@pytest.mark.parametrize(
    ("engine", "kind"), [("threads", ThreadPoolExecutor), ("processes", ProcessPoolExecutor)]
)
def test_an_engine_is_what_it_says(engine, kind):
    with open_engine(engine) as executor:
        assert type(executor) is kind
