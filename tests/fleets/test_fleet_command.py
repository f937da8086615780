"""`multipos fleet`: its files, and what a user does wrong."""

import csv
import gzip
import json
import lzma
import os
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from fleet_bench import line, rows_of
from log_bench import columns_of
from numpy.testing import assert_allclose, assert_array_equal

import multipos as mp
from multipos.cli import main
from multipos.fleets import folder as fleet_folder
from multipos.fleets.fleet_text import fleet_sentence

pytestmark = pytest.mark.usefixtures("without_drawing")

LIMITS = "name,lsl,usl\nbias_ax,-0.02,0.02\nscale_ax,0.9,\nU:bias_ay,,0.01\n"
APART = ["--unit-column", "unit", "--station-column", "station"]


def write(path, table):
    mp.write_table(path, table)
    return str(path)


@pytest.fixture
def table(tmp_path):
    return write(tmp_path / "line.csv", line(30, stations=3, scheme="faces-corners-14"))


@pytest.fixture
def limits(tmp_path):
    path = tmp_path / "limits.csv"
    path.write_text(LIMITS)
    return str(path)


def test_the_files_have_what_they_promise(tmp_path, table, limits, capsys):
    pq = pytest.importorskip("pyarrow.parquet")
    out = tmp_path / "out"
    assert main(["fleet", table, *APART, "--limits", limits, "-o", str(out), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    found = json.loads((out / "fleet.json").read_text("utf-8"))
    assert said == found
    assert sorted(path.name for path in out.iterdir()) == sorted(
        ["calibrations.parquet", "units.csv", "fleet.json", "report.html", "stations"]
    )
    assert (found["units"], found["fitted"], found["failed"]) == (30, 30, 0)
    rows = pq.read_table(out / "calibrations.parquet").to_pydict()
    whole = line(30, stations=3, scheme="faces-corners-14")
    cal = mp.fit(rows_of(whole, "U0007"))
    place = rows["unit"].index("U0007")
    for parameter in cal.entries:
        assert rows[parameter.name][place] == pytest.approx(parameter.value, rel=1e-10)
        assert rows[f"u_{parameter.name}"][place] == pytest.approx(parameter.u, rel=1e-10)
        assert rows[f"dof_{parameter.name}"][place] == pytest.approx(parameter.dof, rel=1e-10)
    assert rows["rms"][place] == pytest.approx(cal.rms, rel=1e-10)
    assert rows["findings"][place] == ""

    with (out / "units.csv").open(encoding="utf-8") as stream:
        verdicts = {row["unit"]: row for row in csv.DictReader(stream)}
    outside = {u for u, b in zip(rows["unit"], rows["bias_ax"], strict=True) if abs(b) > 0.02}
    assert {u for u, row in verdicts.items() if row["verdict"] == "fail"} == outside
    assert all("bias_ax" in verdicts[unit]["reasons"] for unit in outside)
    assert {each["unit"]: each["reason"] for each in found["outside"]} == {
        unit: verdicts[unit]["reasons"] for unit in outside
    }
    first = next(unit for unit in rows["unit"] if unit in outside)
    cause = "bias_ax outside its limits"
    assert found["first"][cause] == f"{first}: {verdicts[first]['reasons']}"
    assert found["yield"]["value"] == pytest.approx(1.0 - len(outside) / 30)
    (bias,) = (each for each in found["parameters"] if each["name"] == "bias_ax")
    assert (bias["lsl"], bias["usl"]) == (-0.02, 0.02)
    assert bias["mean"] == pytest.approx(np.mean(rows["bias_ax"]))
    assert bias["sd"] == pytest.approx(np.std(rows["bias_ax"], ddof=1))
    for key in ("cpk", "ppk", "ppk_true"):
        assert bias[key]["low"] < bias[key]["value"] < bias[key]["high"]
    assert [each["station"] for each in found["stations"]] == list(dict.fromkeys(rows["station"]))
    page = (out / "report.html").read_text("utf-8")
    assert "bias_ax" in page
    assert "http" not in page.replace("http://www.w3.org", "")


def test_without_parquet_the_table_is_csv_and_that_is_said(tmp_path, table, capsys, monkeypatch):
    monkeypatch.setattr(fleet_folder, "find_spec", lambda name: None)
    out = tmp_path / "out"
    assert main(["fleet", table, *APART, "-o", str(out), "-v"]) == 0
    shown = capsys.readouterr()
    assert "pip install 'multipos[parquet]'" in shown.out + shown.err
    with (out / "calibrations.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 30
    assert {"unit", "station", "bias_ax", "u_bias_ax", "dof_bias_ax", "rms", "findings"} <= {
        *rows[0]
    }


def test_parquet_folders_and_patterns_are_read_as_the_same(tmp_path):
    pa = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    table = line(8, scheme="faces-corners-14")
    whole = mp.fit_many(table, unit_column="unit", station_column="station")
    lots = tmp_path / "lots"
    lots.mkdir()
    half = 4 * 14 + 5  # in the middle of a unit
    for name, piece in (("a", slice(None, half)), ("b", slice(half, None))):
        part = {column: cells[piece] for column, cells in table.items()}
        parquet.write_table(pa.table(part), lots / f"{name}.parquet")
    for source in (lots, lots / "*.parquet"):
        found = mp.fit_many(str(source), unit_column="unit", station_column="station")
        assert found == whole


def test_a_run_that_was_stopped_goes_on(tmp_path, monkeypatch):
    from multipos.fleets import workers as running

    table = line(6, scheme="faces-corners-14")
    monkeypatch.setattr("multipos.fleets.tasks._READINGS", 2 * 14)
    kept = tmp_path / ".progress"
    of_units = {"unit_column": "unit", "station_column": "station"}
    of_units |= {"orientation_sd": 0, "exclude": "none"}
    options = of_units | {"progress_folder": kept}
    solve = running.solve_task
    solved = []

    def stop_after_two(task):
        if len(solved) == 2:
            raise KeyboardInterrupt
        solved.append(task.units.tolist())
        return solve(task)

    monkeypatch.setattr(running, "solve_task", stop_after_two)
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(1) as executor, pytest.raises(KeyboardInterrupt):
        mp.fleet(table, executor=executor, **options)
    assert len(list(kept.glob("*.npz"))) == 2
    again = []
    monkeypatch.setattr(running, "solve_task", lambda t: again.append(t.units.tolist()) or solve(t))
    with ThreadPoolExecutor(1) as executor:
        found = mp.fleet(table, executor=executor, **options)
    assert solved + again == [[0, 1], [2, 3], [4, 5]]
    monkeypatch.undo()
    whole = mp.fleet(table, **of_units).calibrations
    assert list(found.calibrations) == list(whole)
    for name, column in whole.items():
        if column.dtype.kind == "f":  # batches of other sizes are summed in another order
            assert_allclose(found.calibrations[name], column, rtol=1e-10, atol=1e-13)
        else:
            assert_array_equal(found.calibrations[name], column)


def test_the_report_is_written_again_from_the_folder(tmp_path, table, capsys):
    out = tmp_path / "out"
    assert main(["fleet", table, *APART, "-o", str(out)]) == 0
    again = tmp_path / "again.html"
    assert main(["report", str(out), "-o", str(again)]) == 0
    assert again.read_bytes() == (out / "report.html").read_bytes()
    for source in (out, out / "fleet.json"):
        assert main(["report", str(source), "-o", str(tmp_path / f"{source.name}.md")]) == 0
    assert (tmp_path / "out.md").read_bytes() == (tmp_path / "fleet.json.md").read_bytes()


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_unit_has_a_report_of_its_own(tmp_path, monkeypatch, capsys, kind):
    table = line(12, scheme="faces-corners-14", stations=2, seed=3)
    table["unit"] = np.repeat(np.arange(12) // 2, 14)  # some at both stations
    path, out = tmp_path / f"line.{kind}", tmp_path / "out"
    if kind == "csv":
        mp.write_table(path, table)
    else:
        pa = pytest.importorskip("pyarrow")
        from pyarrow import parquet

        parquet.write_table(pa.table(table), path, row_group_size=50)
    assert main(["fleet", str(path), *APART, "--confidence", "0.9", "-o", str(out)]) == 0
    capsys.readouterr()
    monkeypatch.setattr("multipos.commands.report.build_content", lambda c, **_: made.append(c))
    for form in ("html", "markdown", "plain"):
        monkeypatch.setattr(f"multipos.reports.documents.{form}_report", lambda content: "")
    made = []
    stations = {u: set(table["station"][table["unit"] == u].tolist()) for u in range(6)}
    one = next(u for u, names in stations.items() if len(names) == 1)
    two = next(u for u, names in stations.items() if len(names) == 2)
    page = str(tmp_path / "page.html")
    assert main(["report", str(out), "--unit", str(one), "-o", page]) == 0
    assert main(["report", str(out), "--unit", str(two), "--station", "S1", "-o", page]) == 0
    there = (table["unit"] == two) & (table["station"] == "S1")
    for cal, mine in zip(made, (table["unit"] == one, there), strict=True):
        rows = {name: column[mine] for name, column in table.items() if name not in APART}
        rows = {name: column for name, column in rows.items() if name not in ("unit", "station")}
        assert_allclose(cal.parameters, mp.fit(rows).parameters, rtol=1e-12, atol=1e-15)
        assert cal.confidence == 0.9

    def refused(*options):
        assert main(["report", str(out), *options, "-o", page]) == 1
        return capsys.readouterr().err

    assert "was at stations 'S" in refused("--unit", str(two))
    assert "no unit '99'" in refused("--unit", "99")
    assert main(["report", str(out), "--station", "S1", "-o", page]) == 2
    assert "--station needs --unit" in capsys.readouterr().err
    path.rename(tmp_path / "elsewhere")
    assert "give it with --data" in refused("--unit", str(one))
    data = ["--data", str(tmp_path / "elsewhere")]
    assert main(["report", str(out), "--unit", str(one), *data, "-o", page]) == 0
    mp.write_table(path, rows | {"unit": np.full(len(rows["ax"]), one), "station": ["S0"] * 14})
    assert "has changed since" in refused("--unit", str(one))


@pytest.mark.parametrize(
    ("options", "status", "said"),
    [
        (["--unit-column", "serial"], 1, "no column 'serial'"),
        ([*APART, "--engine", "gpu"], 2, "--engine takes threads, processes, dask"),
        ([*APART, "--scheduler", "tcp://x:1"], 2, "needs --engine dask"),
        ([*APART, "--limits", "missing.csv"], 1, "missing.csv: no such file"),
        ([*APART, "--model", "linnear"], 2, "unknown model 'linnear'"),
        ([*APART, "--stepwise"], 2, "another model"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_what_is_wrong_is_said_and_nothing_is_left(tmp_path, table, options, status, said, capsys):
    out = tmp_path / "out"
    assert main(["fleet", table, *options, "-o", str(out)]) == status
    captured = capsys.readouterr()
    assert captured.out == ""
    last = captured.err.splitlines()[-1]
    assert last.startswith("multipos: error: ")
    assert said in last
    assert not out.exists()


def test_the_folder_that_is_read_is_not_written(tmp_path, table, capsys):
    assert main(["fleet", str(tmp_path), *APART, "-o", str(tmp_path)]) == 2
    assert "is the folder that is read" in capsys.readouterr().err
    assert main(["fleet", table, *APART]) == 2
    there = tmp_path / "there"
    there.write_text("kept")
    assert main(["fleet", table, *APART, "-o", str(there)]) == 1
    assert "a file of this name is there" in capsys.readouterr().err
    assert there.read_text() == "kept"
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "nowhere")
    assert main(["fleet", table, *APART, "-o", str(link)]) == 1
    assert "a link to a folder that is not there" in capsys.readouterr().err
    assert link.is_symlink()


def test_a_folder_that_was_there_stays_where_the_run_fails(tmp_path, capsys):
    there, read = tmp_path / "there", tmp_path / "read"
    there.mkdir()
    read.mkdir()
    assert main(["fleet", str(read), *APART, "-o", str(there)]) == 1
    assert "no .csv or .parquet files" in capsys.readouterr().err
    assert list(there.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name,lsl,usl\nbias_ay,1,0\n", "lsl 1, which is not below usl 0"),
        ("name,lsl,usl\nbias_ay,a,0\n", "row 1 (line 2), column 'lsl': 'a' is not a number"),
        ("name,lsl\nbias_ay,1\n", "no column 'usl'"),
        ("name,lsl,usl\nbias_ay,-1e298,1e298\n", "the limit -1e+298, which no parameter could"),
        ("name,lsl,usl\nbias_q,0,1\n", "'bias_q', which no unit has; did you mean"),
        ("name,lsl,usl\nbias_ax,0,1\nbias_ax,0,2\n", "twice"),
    ],
)
def test_limits_that_are_none(tmp_path, table, text, said, capsys):
    path = tmp_path / "limits.csv"
    path.write_text(text)
    out = tmp_path / "out"
    assert main(["fleet", table, *APART, "--limits", str(path), "-o", str(out)]) in (1, 2)
    assert said in capsys.readouterr().err
    assert not out.exists()


def test_limits_of_toml_are_those_of_csv(tmp_path):
    from multipos.files.limits import read_limits

    one, other = tmp_path / "limits.csv", tmp_path / "limits.toml"
    one.write_text(LIMITS)
    other.write_text('bias_ax = [-0.02, 0.02]\nscale_ax = [0.9, inf]\n"U:bias_ay" = [-inf, 0.01]\n')
    assert read_limits(one) == read_limits(other)
    assert read_limits({"bias_ax": (None, 1.0)})[0].lsl == -np.inf


def test_a_place_that_cannot_be_is_refused_before_the_work(tmp_path, table, capsys):
    assert main(["fleet", table, *APART, "-o", str(tmp_path / ("n" * 256))]) == 1
    assert "cannot make the folder" in capsys.readouterr().err
    assert main(["fleet", str(tmp_path), *APART, "-o", str(tmp_path)]) == 2
    assert "is the folder that is read" in capsys.readouterr().err


def folder_of_units(folder, units=4):
    """A folder with one file a unit; the same rows in one table."""
    folder.mkdir(parents=True, exist_ok=True)
    table = line(units, scheme="faces-corners-14")
    for unit in dict.fromkeys(table["unit"].tolist()):
        mp.write_table(folder / f"{unit}.csv", rows_of(table, unit))
    return {name: column for name, column in table.items() if name != "station"}


def test_a_folder_of_files_is_one_unit_each_and_gives_what_their_table_gives(tmp_path, capsys):
    table = folder_of_units(tmp_path / "lot")
    out = tmp_path / "out"
    assert main(["fleet", str(tmp_path / "lot"), "-o", str(out)]) == 0
    assert "each file is one unit, named by the file" in capsys.readouterr().out
    assert json.loads((out / "fleet.json").read_text("utf-8"))["asked"]["unit_column"] is None
    files = sorted((tmp_path / "lot").iterdir())
    found, whole = mp.fit_many(files), mp.fit_many(table)
    assert_array_equal(found["unit"], whole["unit"])
    for name in ("bias_ax", "u_scale_ay", "rms"):
        assert_allclose(found[name], whole[name], rtol=1e-12)
    report = ["report", str(out), "--unit", "U0002", "--data", str(tmp_path / "lot")]
    assert main([*report, "-o", str(tmp_path / "unit.md")]) == 0
    # names that repeat have their folder
    folder_of_units(tmp_path / "b")
    (tmp_path / "b" / "U0001.csv").write_text((tmp_path / "lot" / "U0002.csv").read_text() + "\n")
    found = mp.fit_many(tmp_path / "lot" / "U0001.csv", tmp_path / "b" / "U0001.csv")
    assert found["unit"].tolist() == ["lot/U0001", "b/U0001"]
    capsys.readouterr()
    assert main(["fleet", str(files[0]), "-o", str(tmp_path / "one")]) == 2
    assert "--unit-column" in capsys.readouterr().err


def test_a_bad_file_in_a_folder_is_a_failed_unit_and_a_copy_is_left_out(tmp_path, capsys):
    lot = tmp_path / "lot"
    folder_of_units(lot)
    good = (lot / "U0000.csv").read_text()
    (lot / "empty.csv").write_text("")
    (lot / "header.csv").write_text(good.splitlines()[0] + "\n")
    (lot / "foreign.csv").write_text("name,price\nbread,2\n")
    (lot / "gone.csv").symlink_to(tmp_path / "nowhere.csv")
    (lot / "copy.csv").symlink_to(lot / "U0003.csv")
    os.mkfifo(lot / "pipe.csv")
    out = tmp_path / "out"
    assert main(["fleet", str(lot), "-o", str(out)]) == 0
    assert "identical files were counted once" in capsys.readouterr().err
    with (out / "units.csv").open(encoding="utf-8") as stream:
        rows = {row["unit"]: row for row in csv.DictReader(stream)}
    bad = {
        "empty": "is empty",
        "header": "only a header",
        "foreign": "'name'",
        "gone": "no such file",
        "pipe": "a pipe or a device",
    }
    assert {unit for unit, row in rows.items() if row["verdict"] == "failed"} == set(bad)
    assert all(text in rows[unit]["reasons"] for unit, text in bad.items())
    assert sum(row["verdict"] == "pass" for row in rows.values()) == 4  # of five files


def test_a_link_is_called_as_its_file_and_a_unit_of_a_folder_has_its_report(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    whole = line(3, scheme="faces-corners-14")
    for folder in ("real", "lots"):
        (tmp_path / folder).mkdir()
    for unit in dict.fromkeys(whole["unit"].tolist()):
        mp.write_table(tmp_path / "real" / f"{unit}.csv", rows_of(whole, unit))
        (tmp_path / "lots" / f"link-{unit}.csv").symlink_to(tmp_path / "real" / f"{unit}.csv")
    assert main(["fleet", "lots", "-o", "out"]) == 0
    assert main(["report", "out", "--unit", "U0001", "-o", "u.md"]) == 0, capsys.readouterr().err
    assert "bias_ax" in (tmp_path / "u.md").read_text("utf-8")


@pytest.mark.parametrize("pack", [gzip.compress, lzma.compress])
def test_a_packed_file_beside_its_own_is_no_second_unit(pack, tmp_path, capsys):
    lot, out = tmp_path / "lot", tmp_path / "out"
    folder_of_units(lot)
    ending = "gz" if pack is gzip.compress else "xz"
    (lot / f"U0001.csv.{ending}").write_bytes(pack((lot / "U0001.csv").read_bytes()))
    (lot / f"U0009.csv.{ending}").write_bytes(pack((lot / "U0002.csv").read_bytes() + b"\n"))
    assert main(["fleet", str(lot), "-o", str(out)]) == 0
    assert f"U0001.csv.{ending} (as " in capsys.readouterr().err
    with (out / "units.csv").open(encoding="utf-8") as stream:
        names = [row["unit"] for row in csv.DictReader(stream)]
    assert names == ["U0000", "U0001", "U0002", "U0003", "U0009"]  # another file is another unit


def test_a_control_character_in_one_file_is_one_failed_unit(tmp_path, capsys):
    lot, out = tmp_path / "lot", tmp_path / "out"
    folder_of_units(lot)
    for name, old, new in (
        ("U0001.csv", "\n3,", "\n\x1b[2J3,"),
        ("U0002.csv", "position,", "pos\x1bition,"),
    ):
        text = (lot / name).read_text()
        assert old in text
        (lot / name).write_text(text.replace(old, new, 1))
    assert main(["fleet", str(lot), "-o", str(out)]) == 0
    said = capsys.readouterr()
    with (out / "units.csv").open(encoding="utf-8") as stream:
        rows = {row["unit"]: row for row in csv.DictReader(stream)}
    verdicts = {unit: row["verdict"] for unit, row in rows.items()}
    failed = ("U0001", "U0002")
    assert verdicts == {f"U000{i}": "pass" for i in range(4)} | dict.fromkeys(failed, "failed")
    assert all("has a control character" in rows[unit]["reasons"] for unit in failed)
    assert "\x1b" not in said.out + said.err + (out / "units.csv").read_text()


def test_a_control_character_in_a_unit_of_one_file_is_one_failed_unit(tmp_path):
    lot, out = tmp_path / "lot", tmp_path / "out"
    folder_of_units(lot)
    for path in lot.iterdir():
        mark = "\x1b" if path.stem == "U0003" else ""
        head, *rows = path.read_text().splitlines()
        lines = [f"unit,{head}", *(f"{mark}{path.stem}x,{row}" for row in rows)]
        path.write_text("\n".join(lines) + "\n")
    assert main(["fleet", str(lot), "-o", str(out)]) == 0
    with (out / "units.csv").open(encoding="utf-8") as stream:
        rows = {row["unit"]: row["verdict"] for row in csv.DictReader(stream)}
    assert rows == {f"U000{i}x": "pass" for i in range(3)} | {"U0003": "failed"}


def test_a_station_whose_nest_is_turned_is_named(tmp_path):
    """Two stations, thirty units each, the second with position 3 turned by .4° about z."""
    rng = np.random.default_rng(3)
    up = mp.read_scheme("faces-corners-14").up
    turned = up.copy()
    angle = np.radians(0.4)
    turned[2, :2] = turned[2, :2] @ [
        [np.cos(angle), np.sin(angle)],
        [-np.sin(angle), np.cos(angle)],
    ]
    rows = []
    for unit in range(60):
        station, true = ("A", up) if unit % 2 else ("B", turned)
        K = np.eye(3) + 0.01 * rng.standard_normal((3, 3))
        values = true @ K.T + 0.02 * rng.standard_normal(3) + 2e-4 * rng.standard_normal((14, 3))
        rows += [
            (f"U{unit}", station, str(k + 1), *listed, *value)
            for k, (listed, value) in enumerate(zip(up.tolist(), values.tolist(), strict=True))
        ]
    names = ("unit", "station", "position", "up_x", "up_y", "up_z", "ax", "ay", "az")
    table = dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))
    found = mp.fleet(table, unit_column="unit", station_column="station")
    off = {station["station"]: station["findings"] for station in found["stations"]}
    assert [each["code"] for each in off["B"]] == ["station"]
    assert "position 3 of station B is off by 0." in off["B"][0]["text"]
    assert off["B"][0] in found.to_dict()["findings"]
    assert [f.to_dict() for f in found.findings] == found.to_dict()["findings"]
    of_b = {
        name: [c for c, at in zip(table[name], table["station"], strict=True) if at == "B"]
        for name in names
        if name != "station"
    }
    alone = mp.fleet(of_b, unit_column="unit")
    said = alone.to_dict()["findings"]
    assert any(each["text"].startswith("position 3 is off by 0.") for each in said)
    assert "; fixture off" in fleet_sentence(alone.to_dict())


def test_columns_of_the_bench_are_no_outputs_and_that_is_said(tmp_path):
    made = line(3, scheme="faces-corners-14")
    count = len(made["ax"])
    beside = {"soak": np.arange(count) // 7, "cycle": np.arange(count) % 3, "run": np.ones(count)}
    found = mp.fleet(made | beside, unit_column="unit")
    (note,) = found.findings
    assert (note.code, note.level) == ("outputs-by-name", "note")
    assert "soak" in note.text
    assert "cycle" in note.text


def test_a_file_with_other_columns_fails_its_units_and_not_the_run(tmp_path):
    lots = [line(4, scheme="faces-corners-14", seed=seed) for seed in (1, 2, 3)]
    for k, lot in enumerate(lots):
        lot["unit"] = np.array([f"{k}-{unit}" for unit in lot["unit"]])
        lot.pop("station")
    lots[1]["az2"] = lots[1].pop("az")
    for k, lot in enumerate(lots):
        write(tmp_path / f"lot{k}.csv", lot)
    found = mp.fleet(tmp_path / "lot*.csv", unit_column="unit")
    verdicts = dict(zip(found.verdicts["unit"], found.verdicts["verdict"], strict=True))
    failed = {unit for unit, verdict in verdicts.items() if verdict == "failed"}
    assert failed == {f"1-U{k:04}" for k in range(4)}
    assert len(verdicts) == 12


def test_raw_logs_give_what_calibrate_gives_of_each(tmp_path, capsys):
    logs = tmp_path / "logs"
    logs.mkdir()
    for k in range(3):
        log = columns_of(scheme="fibonacci-24", seed=k)
        kept = ("time", "ax", "ay", "az")
        write(logs / f"S{k}.csv", {name: log[name] for name in kept})
    (logs / "words.txt").write_text("hello\nworld\n")
    out = tmp_path / "out"
    assert main(["fleet", str(logs), "--raw", "-o", str(out)]) == 0
    found = mp.fleet(logs, raw=True)
    assert found.summary["verdicts"] == {"pass": 3, "failed": 1}
    first = capsys.readouterr().out.splitlines()[0]
    assert first.startswith("Yield 75.00 %")
    assert first.endswith("of 4 units: 3 pass, 1 failed; why: no calibration 1.")
    one = mp.calibrate(logs / "S1.csv", exclude="none")
    row = found.calibrations["unit"].tolist().index("S1")
    assert_allclose(
        [found.calibrations[name][row] for name in one.names], one.parameters, rtol=1e-9
    )
    assert_allclose(
        [found.calibrations[f"u_{name}"][row] for name in one.names],
        np.sqrt(np.diag(one.covariance)),
        rtol=1e-6,
    )
    capsys.readouterr()
    report = ["report", str(out), "--unit", "S1", "--data", str(logs), "-o", str(tmp_path / "u.md")]
    assert main(report) == 0


@pytest.mark.parametrize("header", ["ax,ay,az", "ax [m/s^2],ay [m/s^2],az [m/s^2]"])
def test_a_header_with_units_changes_no_number(header, tmp_path):
    rng, rows = np.random.default_rng(1), []
    up = mp.read_scheme("fibonacci-12").up
    for unit in "ab":
        values = 9.81 * up + 0.1 + 1e-3 * rng.normal(size=up.shape)
        rows += [f"{unit},{','.join(map(str, row))}" for row in np.hstack([values, up]).tolist()]
    (tmp_path / "t.csv").write_text("\n".join([f"unit,{header},up_x,up_y,up_z", *rows]))
    found = mp.fit_many(tmp_path / "t.csv", unit="m/s^2")
    one = mp.fit(mp.Readings(values, up=up, unit="m/s^2"))
    assert_allclose([found[name][1] for name in one.names], one.parameters, rtol=1e-9)


def test_waved_magnetometers_are_what_calibrate_makes_of_each(tmp_path):
    """Rows as they are, of a sensor that was turned all the time."""
    logs = tmp_path / "logs"
    logs.mkdir()
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        t = np.arange(1500) / 50.0
        a, b = 2.3 * t + rng.uniform(0.0, 6.0), np.cos(0.7 * t)
        u = np.column_stack([np.cos(a) * np.sqrt(1.0 - b * b), np.sin(a) * np.sqrt(1.0 - b * b), b])
        values = [3.0, -8.0, 12.0] + 48.0 * u + 0.2 * rng.normal(size=u.shape)
        names = ("mx [uT]", "my [uT]", "mz [uT]")
        write(logs / f"S{seed}.csv", {"time [s]": t, **dict(zip(names, values.T, strict=True))})
    found = mp.fleet(logs, raw=True)
    assert found.summary["verdicts"] == {"pass": 2}
    one = mp.calibrate(logs / "S2.csv", exclude="none")
    given = [found.calibrations[name][1] for name in one.names]
    assert_allclose(given, one.parameters, rtol=1e-9)


def test_a_unit_with_a_flipped_row_is_named_by_that_row(tmp_path, capsys):
    """In `units.csv`, `fleet.json`, on the screen and on the page; two exchanged rows by both."""
    folder, out = tmp_path / "lot", tmp_path / "out"
    table = folder_of_units(folder, 6)
    own = rows_of(table, "U0003")
    for name in ("ax", "ay", "az"):
        own[name][6] = -own[name][6]
    mp.write_table(folder / "U0003.csv", own)
    own = rows_of(table, "U0004")
    for name in ("ax", "ay", "az"):
        own[name][[1, 12]] = own[name][[12, 1]]
    mp.write_table(folder / "U0004.csv", own)
    assert main(["fleet", str(folder), "--exclude", "none", "-o", str(out)]) == 0
    said = {
        "U0003": f"flipped-row at position {own['position'][6]}",
        "U0004": f"interchanged-rows at positions {own['position'][1]}, {own['position'][12]}",
    }
    rows = csv.DictReader((out / "units.csv").read_text("utf-8").splitlines())
    assert {row["unit"]: row["reasons"] for row in rows if row["verdict"] == "unfit"} == said
    unfit = json.loads((out / "fleet.json").read_text("utf-8"))["unfit"]
    assert {each["unit"]: each["reason"] for each in unfit} == said
    pages = capsys.readouterr().out, (out / "report.html").read_text("utf-8")
    assert all(reason in page for reason in said.values() for page in pages)


def test_small_files_are_opened_once_and_give_what_their_table_gives(tmp_path, monkeypatch):
    """Whatever ends their lines, with comments or a mark of the encoding, columns in any order."""
    folder = tmp_path / "lot"
    table = folder_of_units(folder, 12)
    files = sorted(folder.iterdir())
    changes = (
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.rstrip("\n"),
        lambda text: "\ufeff# by hand\n\n" + text,
        lambda text: "\n".join(",".join(reversed(row.split(","))) for row in text.split("\n")),
    )
    opened, own = Counter(), Path.open

    def counted(path, *given, **named):
        opened[path.name] += 1
        return own(path, *given, **named)

    monkeypatch.setattr(Path, "open", counted)
    for change in (str, *changes):
        for file in files[1::3]:
            file.write_text(change(file.read_text("utf-8")), "utf-8", newline="")
        opened.clear()
        found, whole = mp.fit_many(files), mp.fit_many(table)
        assert set(opened.values()) == {1} or change is changes[3]
        assert_array_equal(found["unit"], whole["unit"])
        for name in ("bias_ax", "u_scale_ay", "rms"):
            assert_allclose(found[name], whole[name], rtol=1e-12)
        folder_of_units(folder, 12)
