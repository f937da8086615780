"""The correction of a station's nest, against simulated lines whose nests are known."""

from pathlib import Path

import numpy as np
import pytest
from fleet_bench import line

import multipos as mp
from multipos.cli import main
from multipos.fleets.folder import _corrections
from multipos.fleets.stations import _beyond

pytestmark = pytest.mark.filterwarnings("ignore::multipos.errors.CalibrationWarning")


def correction_of(table, **options):
    (station,) = mp.fleet(table, unit_column="unit", **options)["stations"]
    return station["correction"]


def corrected_up(correction):
    return np.column_stack([correction["scheme"][f"up_{axis}"] for axis in "xyz"])


def left_over(up, true):
    """What no rotation of all positions explains of up against the truth, (n, 3) [rad]."""
    off = np.cross(up, true)  # the rotation vector from one to the other, across up
    design = np.concatenate([np.eye(3) - np.outer(f, f) for f in up])
    common = np.linalg.lstsq(design, off.ravel(), rcond=None)[0]
    return off - (design @ common).reshape(off.shape)


def turned_nest(scheme, sd_deg, seed):
    """Up as listed, and where it is in a nest whose positions are off by sd about each axis."""
    up = mp.read_scheme(scheme).up
    turned = np.radians(sd_deg) * np.random.default_rng(seed).standard_normal(up.shape)
    return up, turned, up + np.cross(turned, up)


@pytest.mark.parametrize("convention", ["specific-force", "gravity"])
def test_positions_are_listed_where_they_are_with_their_uncertainty(convention):
    # eqs. (1), (2) of fleets.station_fixtures
    up, turned, true = turned_nest("fibonacci-24", 0.2, 4)
    table = line(200, turned=turned[None], noise=2e-4)
    if convention == "gravity":
        table |= {f"a{axis}": -table[f"a{axis}"] for axis in "xyz"}
    correction = correction_of(table, convention=convention)
    assert list(correction["scheme"]["position"]) == [str(k + 1) for k in range(24)]
    found = corrected_up(correction)
    assert np.linalg.norm(found, axis=1) == pytest.approx(1.0)
    u_deg = correction["budget"]["orientation"]["u_deg"]
    # of 48 tilts; what is not told of them takes away from both sides
    error = np.degrees(left_over(found, true))
    assert 0.5 * u_deg < np.sqrt(np.sum(error**2) / 48) < 1.5 * u_deg
    assert u_deg < 0.01 * np.degrees(np.sqrt(np.sum(left_over(up, true) ** 2) / 48))
    assert correction["budget"]["orientation"]["dof"] == 199.0


@pytest.mark.slow
@pytest.mark.usefixtures("without_findings")
def test_a_unit_that_is_fitted_with_it_is_off_by_no_more_than_it_says():
    runs, count, inside = 20, 15, 0
    before, after = [], []
    for seed in range(runs):
        _, turned, _ = turned_nest("fibonacci-24", 0.2, seed)
        table = line(count + 1, turned=turned[None], noise=2e-4, seed=1000 + seed)
        correction = correction_of({name: cells[: 24 * count] for name, cells in table.items()})
        kept = ("position", "ax", "ay", "az")
        unit = {name: table[name][24 * count :] for name in kept}
        listed = mp.fit(unit, scheme="fibonacci-24", orientation_sd=0)
        cal = mp.fit(unit, scheme=correction["scheme"], budget=correction["budget"])
        rng = np.random.default_rng(1000 + seed)  # as `line` draws them
        rng.integers(0, 1, count + 1)
        matrix = np.eye(3) + 1e-2 * rng.standard_normal((count + 1, 3, 3))[count]
        bias = 1e-2 * rng.standard_normal((count + 1, 3))[count]
        for i, axis in enumerate("xyz"):  # cross terms hold the turn that is not told
            inside += abs(cal[f"a{axis}", axis].value - matrix[i, i]) < cal[f"a{axis}", axis].U
            error = cal[f"a{axis}", "1"].value - bias[i]
            inside += abs(error) < cal[f"a{axis}", "1"].U
            before.append(listed[f"a{axis}", "1"].value - bias[i])
            after.append(error)
    assert abs(inside / (6 * runs) - 0.95) < 0.08  # four binomial sd
    rms_before, rms_after = (np.sqrt(np.mean(np.square(each))) for each in (before, after))
    # 0.2° over the root of 24 positions, 0.7 mg; then noise over it, 0.04 mg: 60 values each
    assert rms_before == pytest.approx(np.radians(0.2) / np.sqrt(24), rel=0.3)
    assert rms_after == pytest.approx(2e-4 / np.sqrt(24), rel=0.3)


def test_rows_that_repeat_a_position_share_its_place():
    _, turned, true = turned_nest("faces-corners-14", 0.1, 5)
    once = line(40, scheme="faces-corners-14", turned=turned[None], noise=2e-4, lot=0.0)
    again = line(40, scheme="faces-corners-14", turned=turned[None], noise=2e-4, lot=0.0, seed=1)
    table = {name: np.concatenate([column, again[name]]) for name, column in once.items()}
    correction = correction_of(table, orientation_sd=0)
    assert list(correction["scheme"]["position"]) == [str(k + 1) for k in range(14)]
    error = left_over(corrected_up(correction), true)
    u_deg = correction["budget"]["orientation"]["u_deg"]
    assert np.degrees(np.sqrt(np.sum(error**2) / 28)) < 1.5 * u_deg


@pytest.mark.parametrize(("scheme", "units"), [("fibonacci-24", 9), ("faces-6", 30)])
def test_few_units_or_angles_that_are_not_told_give_none(scheme, units):
    assert correction_of(line(units, scheme=scheme)) is None


def test_stations_have_their_own_files_for_fit_and_for_the_bench(tmp_path, capsys):
    rng = np.random.default_rng(2)
    turned = np.radians(0.2) * rng.standard_normal((2, 24, 3))
    table = line(60, stations=2, turned=turned, noise=2e-4)
    table["station"] = np.where(table["station"] == "S0", "a/../b", "塔 1")
    columns = [name for name in table if not name.startswith("up_")]
    mp.write_table(tmp_path / "line.csv", {name: table[name] for name in columns})
    out = tmp_path / "out"
    run = ["fleet", str(tmp_path / "line.csv"), "--unit-column", "unit", "--station-column"]
    run += ["station", "--unit", "g", "-o", str(out)]
    assert main([*run, "--scheme", "fibonacci-24"]) == 0
    assert "report.html, stations/" in capsys.readouterr().out
    names = sorted(path.name for path in (out / "stations").iterdir())
    assert names == ["a____b.csv", "a____b.toml", "塔_1.csv", "塔_1.toml"]
    mine = (table["unit"] == table["unit"][0]) & (table["station"] == table["station"][0])
    unit = {name: table[name][mine] for name in ("position", "ax", "ay", "az")}
    name = {"a/../b": "a____b", "塔 1": "塔_1"}[table["station"][0]]
    place = str(out / "stations" / name)
    known = {"unit": "g", "orientation_sd": 0, "exclude": "none"}
    fitted = mp.fit(unit, scheme=f"{place}.csv", budget=f"{place}.toml", **known)
    assert fitted.rms < 0.2 * mp.fit(unit, scheme="fibonacci-24", **known).rms
    others = len(set(table["unit"][table["station"] == table["station"][0]])) - 1
    assert fitted.budget.tables["orientation"]["dof"] == others
    # what the next run would write over is not read by it
    assert main([*run, "--scheme", f"{place}.csv"]) == 2
    assert "-o would write over" in capsys.readouterr().err


def test_the_uncertainty_of_a_nest_of_rolls_states_a_bench():
    scheme = "roll-x-12+roll-y-12+roll-z-12"
    turned = np.radians(0.05) * np.random.default_rng(3).standard_normal((1, 36, 3))
    correction = correction_of(line(30, scheme=scheme, turned=turned, noise=1e-4))
    u_deg = correction["budget"]["orientation"]["u_deg"]
    first = mp.fit(
        {
            name: column[:36]
            for name, column in line(1, scheme=scheme).items()
            if name not in ("unit", "station")
        }
    )
    known = mp.state_bench(first, reading_sd=1e-4, angle_sd_deg=u_deg)
    # the side of a roll: one output at its zero crossing turns by u and nothing else
    added = known.covariance[::3, ::3].diagonal() - 1e-8
    assert added.max() == pytest.approx(np.radians(u_deg) ** 2, rel=0.1)


def test_a_nest_is_that_of_its_station_in_whatever_order_a_file_keeps_their_names(tmp_path):
    pa = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    turned = np.zeros((2, 24, 3))
    turned[1, 5] = np.radians([0.0, 0.0, 1.0])
    table = line(40, stations=2, turned=turned, noise=1e-4)
    heads = list(dict.fromkeys(table["station"].tolist()))
    kept = {name: pa.array(column) for name, column in table.items()}
    codes = pa.array([1 - heads.index(name) for name in table["station"].tolist()], pa.int32())
    kept["station"] = pa.DictionaryArray.from_arrays(codes, pa.array(heads[::-1]))
    parquet.write_table(pa.table(kept), tmp_path / "line.parquet")
    apart = {"unit_column": "unit", "station_column": "station"}
    found = mp.fleet(tmp_path / "line.parquet", **apart)["stations"]
    off = {each["station"]: each["positions_deg"][5]["z"]["value"] for each in found}
    assert off["S1"] > 0.3
    assert abs(off["S0"]) < 0.01
    whole = mp.fleet(table, **apart)["stations"]
    assert [each["positions_deg"] for each in found] == [each["positions_deg"] for each in whole]


def test_levels_and_zeros_of_stations_are_one_test_at_one_percent():
    apart = {"unit_column": "unit", "station_column": "station"}

    def off(**options):
        found = mp.fleet(line(30, stations=3, scheme="faces-corners-14", **options), **apart)
        stations = found.summary["stations"]
        return {s["station"]: [f["text"] for f in s["findings"]] for s in stations}

    # of 20 good lines of 18 figures each .2 on average; more than 2 has a chance of one in 1,000
    assert sum(any(off(seed=seed).values()) for seed in range(20)) <= 2
    level, shift = np.zeros((3, 3)), np.zeros((3, 3))
    level[1, 0], shift[2, 1] = np.radians(1.0), 0.02
    said = off(seed=1, level=level, shift=shift)
    assert "degrees about x" in said["S1"][0]
    assert said["S2"][0].startswith("zero of ay at station S2 is off by ")


def test_what_is_off_leaves_the_mean_of_the_others_by_hand():
    """3, 0, 0 about their mean are 2, −1, −1: without the first the others are 0.

    k u = 1.5 names the first alone, .5 none but it, and 2.5 none.
    """
    # eq. (3) of fleets.stations
    figures = [{"shift": {"ax": {"value": v, "u": 0.5}}, "level_deg": {}} for v in (2.0, -1, -1)]
    for k, named in ((3.0, [1, 0, 0]), (1.0, [1, 0, 0]), (5.0, [0, 0, 0])):
        assert [len(each) for each in _beyond(figures, k)] == named


def test_a_unit_far_from_its_model_tells_nothing_of_the_nest():
    _, turned, _ = turned_nest("fibonacci-24", 0.2, 4)
    table = line(30, turned=turned[None], noise=2e-4)
    table["ax"][24 * 7 + 3] += 0.5
    kept = np.asarray(table["unit"]) != "U0007"
    without = {name: np.asarray(column)[kept] for name, column in table.items()}
    with_it, alone = correction_of(table), correction_of(without)
    np.testing.assert_allclose(corrected_up(with_it), corrected_up(alone), rtol=0, atol=1e-12)
    assert with_it["budget"]["orientation"]["dof"] == 28.0


def test_files_of_corrections_say_of_which_station_and_how_many_units():
    budget = {"orientation": {"u_deg": 0.01, "dof": 9.0}}
    found = {"scheme": {"position": ["1"], "up_x": [1.0]}, "budget": budget}
    names = ("line 2", "", "none")
    stations = [{"station": name, "correction": found} for name in names]
    stations[2]["correction"] = None
    files = dict(_corrections({"stations": stations}, Path("out")))
    assert len(files) == 4
    heads = [text.splitlines()[0] for path, text in files.items() if path.suffix == ".csv"]
    said = ": up at every position, from 10 units, but for a turn of all"
    assert heads == [f"# line 2{said}", f"# one station{said}"]
