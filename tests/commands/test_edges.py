"""Values and inputs at the edge of what there is: each ends in a result or in one line."""

import json
import sys
import time

import numpy as np
import pytest

import multipos as mp
from multipos.cli import main


@pytest.fixture
def readings():
    up = mp.read_scheme("all-26").up
    rng = np.random.default_rng(1)
    return mp.Readings(up + 1e-3 * rng.standard_normal((26, 3)), up=up, unit="g")


@pytest.fixture
def table(tmp_path, readings):
    names = {f"up_{a}": readings.up[:, i] for i, a in enumerate("xyz")}
    path = tmp_path / "r.csv"
    mp.write_table(path, names | {f"a{a}": readings.values[:, i] for i, a in enumerate("xyz")})
    return path


def said(capsys, *words):
    status = main([*map(str, words)])
    return status, capsys.readouterr().err.strip().splitlines()[-1]


@pytest.mark.parametrize("command", ["fit", "average", "stability"])
def test_an_input_without_end_is_refused(capsys, command):
    status, line = said(capsys, command, "/dev/zero")
    assert status == 1
    assert line.startswith("multipos: error: /dev/zero: more than 1 MiB came, and no end")


@pytest.mark.parametrize("size", [1e160, 1e-160, 3.0])
def test_a_quaternion_of_any_length_is_a_rotation(size):
    q = np.array([[0.5, 0.5, 0.5, 0.5], [0.1, -0.3, 0.2, 0.6], [1.0, 0.0, 0.0, 0.0]])
    names = ("qw", "qx", "qy", "qz")

    def up(scale):
        columns = {name: scale * q[:, i] for i, name in enumerate(names)}
        return mp.read_readings(columns | {"ax": [0.0, 1.0, 2.0]}).up

    np.testing.assert_allclose(up(size), up(1.0), rtol=0, atol=1e-15)


def test_a_large_offset_is_not_an_output_that_never_changes(readings):
    far = mp.Readings(readings.values + 1e9, unit="g")
    with pytest.raises(mp.MultiposError, match=r"less than a part in 1e9 .* large offset"):
        mp.fit(far, unknown_orientation=True)
    near = mp.fit(mp.Readings(readings.values + 1e7, unit="g"), unknown_orientation=True)
    assert near["bias_ax"].value == pytest.approx(1e7, rel=1e-9)


def test_pooling_where_outputs_have_one_noise_anyway_is_refused(capsys, table):
    status, line = said(capsys, "fit", table, "--pool", "--unknown-orientation")
    assert status == 2
    assert "--unknown-orientation and --pool contradict each other" in line


@pytest.mark.parametrize("model", ["linear", "own-quadratic"])
@pytest.mark.parametrize("command", ["apply", "c", "px4", "kalibr", "imucal"])
@pytest.mark.parametrize("kept", ["", "cross"])
def test_a_calibration_that_does_not_respond_is_refused(
    capsys, tmp_path, readings, table, model, command, kept
):
    calibration = mp.fit(readings, model=model)
    document = calibration.to_dict()
    for each in document["parameters"]:
        if not (kept and each["name"].startswith(kept)):
            each["value"] = 0.0
    path, out = tmp_path / "c.json", tmp_path / "o"
    path.write_text(json.dumps(document))
    words = ["apply", path, table, "-o", out]
    if command != "apply":
        words = ["export", path, "--to", command, "--allow-lossy", "--force", "-o", out]
    status, line = said(capsys, *words)
    assert (status, out.exists()) == (1, False)
    assert line.startswith("multipos: error: `scale_ax` is 0: the output does not respond to force")


@pytest.mark.parametrize("name", ["direktion", "directon", "directions"])
def test_a_column_that_was_meant_to_be_direction_is_named(capsys, tmp_path, name):
    faces = ("N-U-E", "N-D-W", "U-S-E", "D-N-E", "N-E-D", "up there")
    rows = [f"{face},{0.1 * i},{0.2 + i},{i}" for i, face in enumerate(faces)]
    path = tmp_path / "r.csv"
    path.write_text("\n".join([f"{name},ax,ay,az", *rows]) + "\n")
    status, line = said(capsys, "fit", path)
    assert status == 1
    assert f"a column '{name}'; did you mean 'direction'" in line


def test_many_columns_that_were_meant_for_nothing_are_not_named(capsys, tmp_path):
    path = tmp_path / "r.csv"
    names = ["ax", *(f"c{i}" for i in range(30))]
    path.write_text("\n".join([",".join(names), *[",".join(["1"] * 31)] * 6]) + "\n")
    status, line = said(capsys, "fit", path, "--outputs", "ax")
    assert status == 1
    assert "no orientation; give --scheme" in line


@pytest.mark.parametrize("rate", [0, -5])
def test_a_rate_that_is_none_is_refused(capsys, table, rate):
    for command in ("average", "calibrate", "stability"):
        status, line = said(capsys, command, table, "--rate", rate)
        assert status == 2
        assert f"--rate must be above 0, from 1e-12 to 1e+07 Hz, got {rate}." in line


def test_logs_whose_rates_differ_by_rounding_have_one(tmp_path):
    log = mp.simulate_log(mp.demo().calibration, "corners-8", rate=100, rest=4, seed=1)
    later = dict(log, time=(log["time"] + 1000.0) * (1 + 2e-13))
    rate = mp.average(log, later).sample_rate
    assert rate == pytest.approx(100.0, rel=1e-9)


def test_a_library_that_cannot_be_loaded_is_to_blame_and_not_the_log(tmp_path, monkeypatch, capsys):
    (tmp_path / "pyarrow").mkdir()
    (tmp_path / "pyarrow" / "__init__.py").write_text(
        "raise ImportError('no symbol', name='pyarrow')"
    )
    monkeypatch.syspath_prepend(tmp_path)
    for name in [name for name in sys.modules if name.partition(".")[0] == "pyarrow"]:
        monkeypatch.delitem(sys.modules, name)
    path = tmp_path / "log.parquet"
    path.write_bytes(b"PAR1" + bytes(100) + b"PAR1")
    status, line = said(capsys, "average", path)
    assert status == 1
    assert "pyarrow is installed but cannot be loaded (no symbol); install it again" in line


def test_a_finding_that_says_more_than_is_known_is_read(tmp_path, readings):
    document = mp.fit(readings, model="own-quadratic").to_dict()
    said = {"code": "x", "level": "note", "text": "t", "action": "", "rows": [], "outputs": []}
    document["diagnostics"]["findings"] = [{**said, "p": None, "since": 1}]
    path = tmp_path / "c.json"
    path.write_text(json.dumps(document))
    assert [each.code for each in mp.load(path).findings][:1] == ["x"]


@pytest.mark.parametrize("outputs", [[], ["--outputs", "ax,ay,az"]])
@pytest.mark.parametrize("command", ["fit", "average", "calibrate"])
def test_a_wide_table_takes_time_in_proportion_and_one_short_line(
    capsys, tmp_path, readings, command, outputs
):
    # 16 times the columns, of which a look at each for each would take 256 times as long
    seconds = []
    for width in (250, 4_000):
        columns = {f"up_{a}": readings.up[:, i] for i, a in enumerate("xyz")}
        columns |= {f"a{a}": readings.values[:, i] for i, a in enumerate("xyz")}
        path, out = tmp_path / f"{width}.csv", tmp_path / "o.json"
        mp.write_table(path, columns | {f"c{i}": np.arange(26.0) ** 2 for i in range(width)})
        begin = time.process_time()
        status = main([command, str(path), *outputs, "-o", str(out)])
        seconds.append(time.process_time() - begin)
        refused = command in ("average", "calibrate") or not outputs
        assert (status > 0) == refused
        assert all(len(line) <= 300 for line in capsys.readouterr().err.splitlines())
    assert seconds[1] < 48 * max(seconds[0], 0.02)
    if not refused:  # one note of the columns beyond a dozen, not one of each
        assert out.stat().st_size < 100_000


def test_labels_of_parquet_come_through_the_door_of_csv(capsys, tmp_path, readings):
    pa = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    labels = ["=1+1", "'@x", "+X up", *(f"p{i}" for i in range(23))]
    columns = {"position": labels} | {f"up_{a}": readings.up[:, i] for i, a in enumerate("xyz")}
    columns |= {f"a{a}": readings.values[:, i] for i, a in enumerate("xyz")}
    path = tmp_path / "r.parquet"

    def write(**changed):
        parquet.write_table(pa.table(columns | changed), path)
        return path

    assert mp.read_readings(write()).labels[:3] == ("=1+1", "@x", "+X up")
    for changed, says in (
        ({"position": ["\x1b[2J", *labels[1:]]}, "column 'position': '\\u001b[2J' has a control"),
        ({"pres\u202esure": [1.0] * 26}, "the name of column 8, 'pres\\u202esure', has a control"),
    ):
        status, line = said(capsys, "fit", write(**changed), "-o", tmp_path / "c.json")
        assert status == 1
        assert line.startswith(f"multipos: error: {path}: ")
        assert says in line


def test_a_log_of_one_short_rest_is_refused(capsys, tmp_path):
    """As the fuzzer found it: no other rest tells how long the usual one is."""
    rng = np.random.default_rng(1)
    mean = np.repeat([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], [60, 43], axis=0)
    mean[60:] = rng.standard_normal((43, 3))
    path = tmp_path / "log.csv"
    mp.write_table(
        path, dict(zip("abc", (mean + 1e-3 * rng.standard_normal((103, 3))).T, strict=True))
    )
    status, line = said(capsys, "average", path, "--scheme", "faces-6")
    assert status == 1
    assert "no rest of" in line
