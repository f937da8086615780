"""`apply` on logs: the same numbers piece by piece, columns kept, nothing written on errors."""

import gzip
import json
import math
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
from log_bench import sensor, write_csv

import multipos as mp
from multipos.cli import main
from multipos.compensation.applying_logs import apply_log
from multipos.compensation.correction import range_column
from multipos.errors import MultiposError
from multipos.files.trees import json_table, to_json
from multipos.files.whole import write_text
from multipos.logs.opening import open_log, read_log


@pytest.fixture(scope="module")
def cal():
    return sensor("own-quadratic")


@pytest.fixture
def saved(cal, tmp_path):
    cal.save(tmp_path / "cal.json")
    return str(tmp_path / "cal.json")


@pytest.fixture(scope="module")
def log(cal):
    return mp.simulate_log(cal, "faces-6", rate=50.0, rest=2.0, sample_sd=1e-3, seed=1)


def read(path):
    return np.genfromtxt(path, delimiter=",", names=True)


def test_a_log_is_applied_as_a_table_is(cal, saved, log, tmp_path, monkeypatch):
    monkeypatch.setattr("multipos.logs.text_logs._PIECE", 5000)  # many pieces
    path = write_csv(tmp_path / "log.csv", log)
    out = tmp_path / "out.csv"
    assert main(["apply", saved, str(path), "--uncertainty", "-o", str(out)]) == 0
    whole = mp.apply(cal, log, uncertainty=True)
    found = read(out)
    assert found.dtype.names == tuple(whole)
    for name, column in whole.items():
        # how a product of matrices rounds may depend on its number of rows: ulps of 1 g
        atol = 1e-15 if name.startswith(("f_", "u_f_", "U_f_")) else 0.0
        rtol = 5e-4 if name.startswith(("u_f_", "U_f_")) else 0.0  # four digits in text
        np.testing.assert_allclose(found[name], column, rtol=rtol, atol=atol)
    parquet = pytest.importorskip("pyarrow.parquet")
    file = tmp_path / "out.parquet"
    assert main(["apply", saved, str(path), "--uncertainty", "-o", str(file)]) == 0
    kept = parquet.read_table(file)
    assert kept.column_names == list(whole)
    for name, column in whole.items():
        np.testing.assert_allclose(kept[name].to_numpy(), column, rtol=1e-12, atol=1e-15)


def test_columns_are_kept_as_they_stand(cal, saved, tmp_path, capsys):
    text = '\ufeff# a log\nnote;ax;ay;az\n"a; b";0,10;0,20;0,90\n\n# more\nlast;1,0000;0,0;0,0\n'
    path = tmp_path / "log.csv"
    path.write_text(text, encoding="utf-8")
    assert main(["apply", saved, str(path)]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0] == "note;ax;ay;az;f_x;f_y;f_z;outside"
    assert out[1].startswith('"a; b";0,10;0,20;0,90;')
    assert out[2].startswith("last;1,0000;0,0;0,0;")
    first = cal.compensate([0.10, 0.20, 0.90])[0]
    assert [float(c.replace(",", ".")) for c in out[1].split(";")[5:8]] == first.tolist()


def test_white_space_and_no_header(cal, saved, log, tmp_path, capsys):
    path = write_csv(tmp_path / "log.txt", log, header=False, delimiter="  ")
    assert main(["apply", saved, str(path), "--columns", "time,ax,ay,az"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0] == "time,ax,ay,az,f_x,f_y,f_z,outside"
    assert len(out) == 1 + len(log["time"])
    np.testing.assert_array_equal(
        [float(cell) for cell in out[1].split(",")[:4]], [log[name][0] for name in log]
    )


def test_arrays_become_a_table(cal, saved, log, tmp_path):
    np.savez(tmp_path / "log.npz", **log)
    out = tmp_path / "out.csv"
    assert main(["apply", saved, str(tmp_path / "log.npz"), "-o", str(out)]) == 0
    found = read(out)
    assert found.dtype.names == ("time", "ax", "ay", "az", "f_x", "f_y", "f_z", "outside")
    np.testing.assert_array_equal(found["f_x"], mp.apply(cal, log)["f_x"])


def test_a_regression_keeps_the_form_of_the_table(tmp_path, capsys):
    rows = "".join(f"{t},5;{(2.0 * (t + 0.5)):g}\n".replace(".", ",") for t in range(20))
    path = tmp_path / "table.csv"
    path.write_text(f"temperature;error\n{rows}")
    regression = str(tmp_path / "regression.json")
    argv = ["regress", str(path), "--response", "error", "--variables", "temperature"]
    assert main([*argv, "-o", regression]) == 0
    capsys.readouterr()
    assert main(["apply", regression, str(path)]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0] == "temperature;error;predicted;corrected;outside"
    assert out[1].startswith("0,5;1;")


def test_json_has_every_column(saved, log, tmp_path, capsys):
    path = write_csv(tmp_path / "log.csv", log)
    assert main(["apply", saved, str(path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["rows"] == len(log["time"])
    assert list(found["columns"]) == ["time", "ax", "ay", "az", "f_x", "f_y", "f_z", "outside"]


def test_json_in_pieces_is_json_in_one(cal, log, tmp_path, monkeypatch):
    monkeypatch.setattr("multipos.logs.text_logs._PIECE", 5000)
    monkeypatch.setattr("multipos.files.trees._CELLS", 7)
    far = {name: column.copy() for name, column in log.items()}
    far["az"][[3, -1]] = 1e7
    path = write_csv(tmp_path / "log.csv", far)
    text = path.read_text().splitlines()
    path.write_text("\n".join([f"{text[0]},naïve", *(f'{line},"x"' for line in text[1:])]))
    applied = apply_log(cal, open_log(path), tilt=True)
    found = applied.columns()
    expected = mp.apply(cal, read_log(open_log(path)), tilt=True)
    assert list(found) == list(expected)
    for name, column in expected.items():
        if name == "naïve":
            assert list(found[name]) == list(column)
        else:  # the search stops by the slowest row of a piece
            np.testing.assert_allclose(found[name], column, rtol=1e-12)
    assert (applied.rows, applied.beyond) == (len(far["time"]), int(sum(found["outside"])))
    one = to_json({"rows": applied.rows, "columns": found})
    assert "".join(json_table(found, applied.rows)) == one
    assert "null" in one  # no force explains 1e7
    with pytest.raises(MultiposError, match="use --outside flag"):
        apply_log(cal, open_log(path), outside="refuse").columns()


def test_rows_outside_are_counted_to_the_end(saved, log, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("multipos.logs.text_logs._PIECE", 5000)
    far = {name: column.copy() for name, column in log.items()}
    far["ax"][[10, -1]] = 3.0
    path = write_csv(tmp_path / "log.csv", far)
    out = tmp_path / "out.csv"
    options = ["apply", saved, str(path), "-o", str(out), "--outside", "refuse"]
    assert main(options) == 1
    printed, error = capsys.readouterr()
    assert printed == ""
    assert "row 11 (line 12), column 'ax'" in error
    count = int(np.sum(mp.apply(mp.load(saved), far)["outside"]))
    assert f"{count} of {len(far['ax'])} rows are" in error
    assert not out.exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,ax,ay\n1,2,3\n", "no column 'az', which this calibration needs"),
        ("ax,ay,az,f_x\n1,2,3,4\n", "column 'f_x' is there already"),
        ("ax,ay,az\n1,2,3\n1,,3\n", "row 2 (line 3), column 'ay': the cell is empty"),
        ("ax,ay,az\n1,2,3\n1,-1e308,3\n", "row 2 (line 3), column 'ay': -1e+308 is no number"),
        ("ax,ay,az\n1,2,3\n1,2\n1,2,3\n", "row 2 (line 3) has 2 cells"),
        ("1,2,3\n1,2,3\n", "the columns are 1, 2, 3"),
        ('ax,ay,az,note\n1,2,3,a\n1,2,3,"b\n1,2,3,c\n', "log.csv: line 3: a quote is not closed"),
        ('ax,ay,az,"note\n1,2,3,a\n', "log.csv: line 1: a quote is not closed"),
        (
            "ax,ay,az,note\n" + 60 * "1,2,3,a\n" + f'1,2,3,"{140_000 * "b"}\n',
            "log.csv: line 62: a quote is not closed",
        ),
    ],
)
def test_bad_logs(saved, text, message, tmp_path, capsys):
    path, out = tmp_path / "log.csv", tmp_path / "out.csv"
    path.write_text(text)
    assert main(["apply", saved, str(path), "-o", str(out)]) == 1
    printed, error = capsys.readouterr()
    assert printed == ""
    assert message in error.splitlines()[-1]
    assert not out.exists()


def test_an_error_half_way_leaves_the_old_file(saved, log, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("multipos.logs.text_logs._PIECE", 5000)
    path, out = write_csv(tmp_path / "log.csv", log), tmp_path / "out.csv"
    with path.open("a") as stream:
        stream.write("1,2,x,4\n")
    out.write_text("old")
    assert main(["apply", saved, str(path), "-o", str(out)]) == 1
    assert out.read_text() == "old"
    assert [each.name for each in tmp_path.iterdir() if each.name.startswith(".")] == []
    assert main(["apply", saved, str(path)]) == 1
    assert capsys.readouterr().out == ""


@pytest.fixture
def small_pieces(monkeypatch):
    """What holds of pieces of 4 MB holds of half a megabyte, of a log an eighth as long."""
    monkeypatch.setattr("multipos.logs.text_logs._PIECE", 1 << 19)


@pytest.mark.slow
@pytest.mark.usefixtures("small_pieces")
def test_memory_of_json_is_that_of_its_numbers(saved, log, tmp_path, monkeypatch):
    row = [",".join(map(str, cells)) + "\n" for cells in zip(*log.values(), strict=True)]
    peaks = []
    for times in (1, 7, 14):  # once for what is imported
        (tmp_path / "log.csv").write_text(",".join(log) + "\n" + times * "".join(row))
        with (tmp_path / "out.json").open("w") as stream:
            monkeypatch.setattr("sys.stdout", stream)
            tracemalloc.start()
            assert main(["apply", saved, str(tmp_path / "log.csv"), "--json"]) == 0
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
    numbers = 8 * 8 * 7 * len(row)  # bytes of eight columns; as text they were 1300 a row
    assert peaks[2] - peaks[1] < 6 * numbers  # copies while they are joined; 18 as text


@pytest.mark.slow
@pytest.mark.usefixtures("small_pieces")
def test_memory_does_not_grow_with_the_log(cal, log, tmp_path):
    row = [",".join(map(str, cells)) + "\n" for cells in zip(*log.values(), strict=True)]
    peaks = []
    for times in (25, 50):
        path = tmp_path / "log.csv"
        with path.open("w") as stream:
            stream.write(",".join(log) + "\n")
            for _ in range(times):
                stream.writelines(row)
        tracemalloc.start()
        applied = apply_log(cal, open_log(path))
        write_text(tmp_path / "out.csv", applied)
        assert applied.rows == times * len(row)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0]


def test_a_path_in_python_is_read_as_the_command_reads_it(tmp_path):
    rows = "\n".join(f"{k / 100},{0.1 * k},{0.0},{1.0}" for k in range(5))
    text = f"recorded by hand\nunits: g\n\n# t,ax,ay,az\n{rows}\n"
    path = tmp_path / "log.txt.gz"
    path.write_bytes(gzip.compress(text.encode()))
    cal = mp.demo().calibration
    found = mp.apply(cal, path, tilt=True)
    assert list(found)[:5] == ["t", "ax", "ay", "az", "f_x"]
    columns = {"ax": 0.1 * np.arange(5), "ay": np.zeros(5), "az": np.ones(5)}
    np.testing.assert_allclose(found.f_x, mp.apply(cal, columns).f_x, rtol=1e-12)
    with pytest.raises(MultiposError, match="outside"):
        mp.apply(cal, path, outside="refuse")
    columns["ax"] = np.array([0.0, 0.0, 9.0, 0.0, 0.0])
    with pytest.raises(MultiposError, match=r"row 3, column 'ax': .* \(1 of 5"):
        mp.apply(cal, columns, outside="refuse")


def test_a_row_too_warm_is_refused_by_its_temperature(tmp_path):
    up = mp.read_scheme("faces-6").up
    columns = dict(zip(("ax", "ay", "az"), np.vstack([up, up]).T, strict=True))
    columns |= {"position": list("123456") * 2, "temperature": np.repeat([20.0, 40.0], 6)}
    how = {"model": "1 + x + y + z + temperature", "unit": "g", "reading_sd": 1e-4}
    cal = mp.fit(columns, scheme="faces-6", **how)
    rows = {"ax": [0.5, 0.5], "ay": [0.0, 0.0], "az": [0.0, 0.0], "temperature": [30.0, 41.0]}
    path = write_csv(tmp_path / "warm.csv", {name: np.array(each) for name, each in rows.items()})
    for table in (rows, path):
        with pytest.raises(MultiposError, match=r"row 2.*, column 'temperature': .* \(1 of 2"):
            mp.apply(cal, table, outside="refuse")


@pytest.mark.parametrize(
    ("outputs", "tilt"), [("xyz", 30.0), ("xy", math.degrees(math.asin(0.49)))]
)
def test_tilt_of_three_axes_needs_no_size_of_gravity(outputs, tilt):
    """30° and .98 g: three axes say 30°, two take the arcsine of .49."""
    up = mp.read_scheme("fibonacci-24").up
    own = ["xyz".index(axis) for axis in outputs]
    names = tuple(f"a{axis}" for axis in outputs)
    cal = mp.fit(mp.Readings(up[:, own], outputs=names, up=up, unit="g"))
    force = 0.98 * np.array([0.5, 0.0, math.sqrt(0.75)])
    found = mp.apply(cal, dict(zip(names, force[own, None], strict=True)), tilt=True)
    assert found["tilt_x_deg"][0] == pytest.approx(tilt, abs=1e-6)


def test_a_temperature_beyond_is_held_at_the_limit_by_hand():
    """1 mg/°C from 0 to 40 °C: at 60 °C forces are those of 40 °C where it is held, else of 60."""
    up = np.tile(mp.read_scheme("faces-6").up, (3, 1))
    t = np.repeat([0.0, 20.0, 40.0], 6)
    columns = {f"up_{axis}": up[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"a{axis}": up[:, i] + 1e-3 * t for i, axis in enumerate("xyz")}
    model = "1 + x + y + z + temperature"
    cal = mp.fit(columns | {"temperature": t}, model=model, unit="g")
    table = {"ax": [0.56], "ay": [0.06], "az": [0.06], "temperature": [60.0]}
    for outside, force in (("flag", 0.5), ("clamp", 0.52)):
        found = mp.apply(cal, table, outside=outside)
        assert found["f_x"][0] == pytest.approx(force, abs=1e-9)


def test_many_rows_are_those_of_their_parts(monkeypatch):
    cal = mp.demo().calibration
    log = {name: np.linspace(-0.5, 0.5, 7) for name in cal.outputs}
    whole = mp.apply(cal, log, tilt=True)
    monkeypatch.setattr("multipos.compensation.added_columns._PLAIN", 2)
    parts = mp.apply(cal, log, tilt=True)
    assert list(parts) == list(whole)
    for name in whole:
        np.testing.assert_allclose(parts[name], whole[name], rtol=1e-9)


def test_errors_are_shown_against_the_variable_of_the_segments_or_rows():
    class Rows(dict):
        rows = 3

        def number(self, name):
            return self[name]

    of = SimpleNamespace(range_variable="t", needed=("u", "v"))
    u, v = np.array([4.0, 5.0, 6.0]), np.array([7.0, 8.0, 9.0])
    assert range_column(of, Rows(), {"u": u, "t": v})[0] == "t"
    assert range_column(of, Rows(v=v), {"u": u})[1] is u
    assert range_column(of, Rows(v=v), {})[1] is v
    name, rows = range_column(of, Rows(), {})
    assert (name, rows.tolist()) == ("row", [1.0, 2.0, 3.0])
