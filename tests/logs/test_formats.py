"""Logs in formats of other programs, each in a file that its library has written."""

import datetime
import gzip
import json
import warnings
import zipfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from amounts import rest_slow
from findings_bench import texts
from log_bench import columns_of
from log_files import (
    archive,
    csv_of,
    write_actigraph,
    write_bag,
    write_dataflash,
    write_dataflash_text,
    write_geneactiv,
    write_phyphox,
    write_ulog,
    write_xsens,
)

import multipos as mp
from multipos.cli import main
from multipos.files import handed
from multipos.logs.opening import open_log
from multipos.logs.readers import READERS

OUTPUTS = ("ax", "ay", "az")
G = 9.80665


@pytest.fixture(scope="module")
def log():
    """A session in m/s², in numbers that single precision holds, so that no format changes them."""
    found = columns_of(scheme="faces-corners-14")
    scaled = {n: c if n == "time" else np.float32(G * c).astype(float) for n, c in found.items()}
    return scaled | {"temperature": np.full(len(scaled["time"]), 24.5)}


@pytest.fixture(scope="module")
def expected(log):
    return mp.average(log).readings.values


def force(log):
    return np.column_stack([log[name] for name in OUTPUTS])


def calibrates(path, tmp_path):
    """Whether one command, without an option, goes from the log to a C function."""
    out = tmp_path / "cal.json"
    assert main(["calibrate", str(path), "--to", "c", "-o", str(out)]) == 0
    assert (tmp_path / "cal.c").exists()
    return mp.load(out).model.unit == "m/s^2"


# --- tables


@pytest.mark.parametrize("form", rest_slow(["parquet", "feather", "arrow"]))
def test_arrow(form, log, expected, tmp_path, capsys):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import feather, parquet

    stamps = np.datetime64("2024-05-01T12:00:00", "ns") + np.round(1e9 * log["time"]).astype(int)
    labels = ["moving"] * len(stamps)
    table = pyarrow.table({"when": stamps, **log, "state": labels}).drop(["time"])
    path = tmp_path / f"log.{form}"
    if form == "parquet":
        parquet.write_table(table, path)
    else:
        feather.write_feather(table, path)
    found = mp.average(path)
    np.testing.assert_allclose(found.readings.values, expected, rtol=1e-12)
    assert found.sample_rate == pytest.approx(100.0, rel=1e-4)
    assert found.rests[0].time[0] == pytest.approx(1714564800.0)  # date -u -d … +%s
    assert mp.average(path, label_column="state").rests[0].position == "moving"
    assert calibrates(path, tmp_path)


@pytest.mark.parametrize("form", ["flat", "groups", "table"])
def test_hdf5(form, log, expected, tmp_path, capsys):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        if form == "flat":
            file["t"], file["acc"] = log["time"], force(log)
        elif form == "groups":
            file["imu/time"], file["imu/acc"] = log["time"], force(log)
            file["gps/time"], file["info"] = np.arange(9.0), "by hand"
        else:
            kinds = [(name, "f8") for name in ("time", *OUTPUTS)]
            rows = list(zip(*(log[name] for name in ("time", *OUTPUTS)), strict=True))
            file["samples"] = np.array(rows, dtype=kinds)
    found = mp.average(path)
    np.testing.assert_allclose(found.readings.values, expected, rtol=1e-12)
    assert found.sample_rate == pytest.approx(100.0)


def test_matlab_7_3(log, expected, tmp_path, capsys):
    """As MATLAB writes it: a user block with a text, and matrices column by column."""
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "log.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        file["t"], file["acc"] = log["time"][None, :], force(log).T
        file["name"] = np.array([[116], [101]], dtype="u2")
        file["name"].attrs["MATLAB_class"] = np.bytes_("char")
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124))
    found = mp.average(path)
    assert found.outputs == ("acc_x", "acc_y", "acc_z")
    np.testing.assert_allclose(found.readings.values, expected, rtol=1e-12)


@pytest.mark.parametrize("preamble", [0, 3])
def test_excel(preamble, log, tmp_path, capsys):
    openpyxl = pytest.importorskip("openpyxl")
    part = {name: column[:1400] for name, column in log.items()}
    book = openpyxl.Workbook()
    for i in range(preamble):
        book.active.append([f"note {i}"])
    book.active.append(["when", "ax (m/s²)", "ay (m/s²)", "az (m/s²)", "remark"])
    start = datetime.datetime(2024, 5, 1, 12, 0, 0)
    for time, *row in zip(*(part[name] for name in ("time", *OUTPUTS)), strict=True):
        stamp = start + datetime.timedelta(microseconds=round(1e6 * time))
        book.active.append([stamp, *map(float, row), None])
    path = tmp_path / "log.xlsx"
    book.save(path)
    found = mp.average(path)
    expected = mp.average(part, outputs=OUTPUTS).readings.values
    np.testing.assert_allclose(found.readings.values, expected, rtol=1e-12)
    assert found.sample_rate == pytest.approx(100.0, rel=1e-4)
    assert found.unit == "m/s^2"
    assert bool(preamble) == any("the table begins on line" in note for note in texts(found))


def test_what_a_library_says_of_other_sheets_of_a_workbook_is_left_out(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.append(["ax", 1.5])
    book.save(tmp_path / "whole.xlsx")
    with zipfile.ZipFile(tmp_path / "whole.xlsx") as whole:
        files = {name: whole.read(name) for name in whole.namelist()}
    with zipfile.ZipFile(tmp_path / "log.xlsx", "w") as damaged:
        for name, data in files.items():
            lost = data.replace(b"</sheets>", b'<sheet name="Chart" sheetId="2"/></sheets>')
            damaged.writestr(name, lost if name == "xl/workbook.xml" else data)
    with pytest.warns(UserWarning, match="invalid specification"):
        openpyxl.load_workbook(tmp_path / "log.xlsx")
    with warnings.catch_warnings(action="error"):
        assert Path(handed.unpack_workbook(tmp_path / "log.xlsx")).read_text() == "ax,1.5\n"


@pytest.mark.parametrize("dated", [False, True])
def test_old_excel_as_phyphox_writes_it(dated, log, tmp_path):
    """One sheet of samples, then sheets about the device."""
    pytest.importorskip("xlrd")
    xlwt = pytest.importorskip("xlwt")
    part = {name: column[:1400] for name, column in log.items()}
    book = xlwt.Workbook()
    sheet = book.add_sheet("Raw Data")
    style = xlwt.easyxf(num_format_str="YYYY-MM-DD HH:MM:SS.000")
    names = ["Time (s)", *(f"Acceleration {axis} (m/s^2)" for axis in "xyz")]
    for j, (name, key) in enumerate(zip(names, ("time", *OUTPUTS), strict=True)):
        sheet.write(0, j, "when" if dated and not j else name)
        for i, value in enumerate(part[key], 1):
            if dated and not j:
                sheet.write(i, j, 45413.0 + float(value) / 86400.0, style)  # 2024-05-01
            else:
                sheet.write(i, j, float(value))
    book.add_sheet("Metadata Device").write(0, 0, "property")
    path = tmp_path / "Accelerometer.xls"
    book.save(str(path))
    found = mp.average(path)
    expected = mp.average(part, outputs=OUTPUTS).readings.values
    np.testing.assert_allclose(found.readings.values, expected, rtol=1e-12)
    assert found.sample_rate == pytest.approx(100.0, rel=1e-4)
    assert found.unit == "m/s^2"
    assert len(mp.read_table(path).numbers(names[1])) == 1400


# --- autopilots


def test_px4(log, expected, tmp_path, capsys):
    """The library writes again what it has read from a file made by the published format."""
    pyulog = pytest.importorskip("pyulog")
    stamps = np.round(1e6 * log["time"])
    axes = dict(zip("xyz", force(log).T, strict=True))
    combined = {f"accelerometer_m_s2[{i}]": log[name] for i, name in enumerate(OUTPUTS)}
    topics = [
        ("sensor_accel", 1, {"timestamp": stamps, **dict.fromkeys("xyz", 0.0 * stamps)}),
        ("sensor_accel", 0, {"timestamp": stamps, **axes, "temperature": log["temperature"]}),
        ("sensor_combined", 0, {"timestamp": stamps, **combined}),
    ]
    topics[0][2]["temperature"] = log["temperature"]
    made = write_ulog(tmp_path / "made.ulg", topics)
    path = tmp_path / "log.ulg"
    pyulog.ULog(str(made)).write_ulog(str(path))
    for each in (made, path):
        found = mp.average(each)
        np.testing.assert_allclose(found.readings.values, expected, rtol=1e-12)
    assert found.outputs == ("accel_x", "accel_y", "accel_z")
    assert found.readings.environment["temperature"][0] == 24.5
    assert texts(found)[0] == "taken from sensor_accel, instance 0 of 2"
    assert found.unit == "m/s^2"
    alone = write_ulog(tmp_path / "combined.ulg", topics[2:])
    found = mp.average(alone)
    np.testing.assert_allclose(found.readings.values, expected, rtol=1e-12)
    assert "sensor_combined, instance 0 of 1, which PX4 had corrected" in texts(found)[0]
    other = write_ulog(tmp_path / "other.ulg", [("vehicle_status", 0, {"timestamp": stamps[:9]})])
    with pytest.raises(mp.MultiposError, match="no sensor_accel or sensor_combined in it"):
        mp.average(other)


@pytest.mark.parametrize(
    ("suffix", "write_log"), [("bin", write_dataflash), ("log", write_dataflash_text)]
)
def test_ardupilot(suffix, write_log, log, expected, tmp_path, capsys):
    """Corrections that were applied are undone: corrected = (raw − OFFS) SCAL."""
    if suffix == "bin":
        pytest.importorskip("pymavlink")
    offset, scale = np.array([0.25, -0.5, 1.0]), np.array([1.0, 0.5, 2.0])  # exact in binary
    names = [f"INS_ACC{kind}_{axis}" for kind in ("OFFS", "SCAL") for axis in "XYZ"]
    parameters = dict(zip(names, [*offset, *scale], strict=True))
    gyro = dict.fromkeys(("GyrX", "GyrY", "GyrZ"), 0.01 * np.ones(len(log["time"])))

    def write(name, corrected, **changes):
        acc = dict(zip(("AccX", "AccY", "AccZ"), corrected.T, strict=True))
        columns = {"TimeUS": np.round(1e6 * log["time"]), **gyro, **acc, "T": log["temperature"]}
        return write_log(tmp_path / f"{name}.{suffix}", parameters | changes, columns)

    path = write("log", (force(log) - offset) * scale)
    found = mp.average(path)
    np.testing.assert_allclose(found.readings.values, expected, rtol=0.0, atol=1e-6)
    assert found.outputs == ("AccX", "AccY", "AccZ")
    assert found.sample_rate == pytest.approx(100.0)
    assert "which were applied to it, are undone" in texts(found)[0]
    assert found.unit == "m/s^2"
    turned = write("turned", force(log), AHRS_ORIENTATION=4.0)
    assert texts(mp.average(turned))[0].endswith("were applied to it and are not undone")
    plain = write("plain", force(log), **dict(zip(names, [0.0] * 3 + [1.0] * 3, strict=True)))
    assert texts(mp.average(plain))[0] == "taken from IMU, the first of the log"
    np.testing.assert_allclose(mp.average(plain).readings.values, expected, rtol=1e-12)


# --- robots


@pytest.mark.parametrize("form", ["bag", "db3", "mcap"])
def test_ros(form, log, expected, tmp_path, capsys):
    pytest.importorskip("rosbags")
    path = write_bag(tmp_path / f"log.{form}", force(log))
    found = mp.average(path)
    np.testing.assert_allclose(found.readings.values, expected, rtol=1e-12)
    assert found.outputs == tuple(f"linear_acceleration.{axis}" for axis in "xyz")
    assert found.rests[0].time[0] == pytest.approx(5.0)
    assert texts(found)[0] == "taken from topic /imu, of 2"
    assert found.unit == "m/s^2"
    if form != "bag":  # what `ros2 bag record` makes is a folder
        np.testing.assert_array_equal(
            mp.average(path.parent).readings.values, found.readings.values
        )


# --- phones, as they are downloaded


def test_phyphox(log, expected, tmp_path, capsys):
    path = write_phyphox(tmp_path / "Acceleration 2024-05-01.zip", log)
    found = mp.average(path)
    np.testing.assert_allclose(found.readings.values, expected, rtol=1e-12)
    assert found.outputs == tuple(f"Acceleration {axis}" for axis in "xyz")
    assert found.unit == "m/s^2"


def test_an_archive_may_have_folders(log, expected, tmp_path):
    text = csv_of(log, ("time", *OUTPUTS), "time,ax,ay,az")
    about = {"session/meta/device.csv": "a,b\n1,2\n", "__MACOSX/session/._run.csv": "?"}
    path = archive(tmp_path / "session.zip", {"session/data/run.csv": text, **about})
    np.testing.assert_allclose(mp.average(path).readings.values, expected, rtol=1e-12)


def test_sensor_logger(log, expected, tmp_path, capsys):
    """Columns z, y, x and two clocks; without total acceleration there is nothing to use."""
    stamps = 1_700_000_000_000_000_000 + np.round(1e9 * log["time"]).astype(int)
    both = log | {"stamp": stamps}
    text = csv_of(both, ("stamp", "time", "az", "ay", "ax"), "time,seconds_elapsed,z,y,x")
    linear = csv_of(
        {n: 0.0 * c if n in OUTPUTS else c for n, c in both.items()},
        ("stamp", "time", "az", "ay", "ax"),
        "time,seconds_elapsed,z,y,x",
    )
    files = {"Accelerometer.csv": linear, "Gravity.csv": text, "Metadata.csv": "a,b\nc,d\n"}
    path = archive(tmp_path / "session.zip", files | {"TotalAcceleration.csv": text})
    found = mp.average(path)
    np.testing.assert_allclose(found.readings.values, expected, rtol=1e-12)
    assert found.outputs == ("x", "y", "z")
    assert found.sample_rate == pytest.approx(100.0, rel=1e-3)
    with pytest.raises(mp.MultiposError, match=r"Accelerometer\.csv has gravity taken away"):
        mp.average(archive(tmp_path / "without.zip", files))
    with pytest.raises(mp.MultiposError, match="none of a\\.csv, b\\.csv looks like"):
        mp.average(archive(tmp_path / "strange.zip", {"a.csv": text, "b.csv": text}))
    (tmp_path / "Accelerometer.csv").write_text(linear)
    with pytest.raises(mp.MultiposError, match=r"Accelerometer\.csv has gravity taken away"):
        mp.average(tmp_path / "Accelerometer.csv")
    # JSON: one record a sample of every sensor, all numbers as texts
    stamped = zip(stamps, log["time"], log["az"], log["ay"], log["ax"], strict=True)
    records = [
        {"sensor": sensor, "time": str(stamp), "seconds_elapsed": repr(float(t))}
        | {axis: repr(float(k * each)) for axis, each in zip("zyx", row, strict=True)}
        for stamp, t, *row in stamped
        for sensor, k in (("Accelerometer", 0.0), ("TotalAcceleration", 1.0))
    ]
    path = tmp_path / "session.json"
    path.write_text(json.dumps(records))
    np.testing.assert_allclose(mp.average(path).readings.values, expected, rtol=1e-12)
    path.write_text(json.dumps(records[::2]))
    with pytest.raises(mp.MultiposError, match="sensor 'Accelerometer' has gravity taken away"):
        mp.average(path)


def test_phyphox_without_gravity(log, tmp_path):
    header = ",".join(["Time (s)", *(f"Linear Acceleration {a} (m/s^2)" for a in "xyz")])
    path = tmp_path / "Raw Data.csv"
    path.write_text(csv_of(log, ("time", *OUTPUTS), header))
    with pytest.raises(mp.MultiposError, match="'Linear Acceleration x' has gravity taken away"):
        mp.average(path)


def test_xsens(log, expected, tmp_path, capsys):
    """The text export of MT Manager: a preamble behind //, tabs, a clock in 100 µs."""
    path = write_xsens(tmp_path / "MT_0001.txt", log)
    found = mp.average(path)
    np.testing.assert_allclose(found.readings.values, expected, rtol=1e-12)
    assert found.outputs == ("Acc_X", "Acc_Y", "Acc_Z")
    assert found.sample_rate == pytest.approx(100.0)


@pytest.mark.parametrize("header", ["", "Accelerometer X,Accelerometer Y,Accelerometer Z\n"])
def test_actigraph(header, log, tmp_path):
    """The raw CSV of ActiLife: ten lines of preamble that tell the rate, with or without names."""
    path = write_actigraph(tmp_path / "actigraph.csv", force(log) / G, header)
    found = mp.average(path)
    plain = mp.average({name: log[name] / G for name in OUTPUTS}, rate=100.0)
    np.testing.assert_array_equal(found.readings.values, plain.readings.values)
    assert found.sample_rate == 100.0
    assert texts(found)[0].startswith("the table begins on line ")


def test_geneactiv(log, expected, tmp_path):
    """A hundred lines of keys, then rows that begin with a date, milliseconds behind a colon."""
    path = write_geneactiv(tmp_path / "geneactiv.csv", log)
    found = mp.average(path)
    np.testing.assert_allclose(found.readings.values, expected, rtol=1e-12)
    assert found.outputs == ("2", "3", "4")


# --- what is missing or damaged

FIRST_BYTES = {
    "px4": (b"ULog\x01\x12\x35\x01", "pyulog"),
    "ardupilot": (b"\xa3\x95\x80\x80", "pymavlink"),
    "ros": (b"#ROSBAG V2.0\n", "rosbags"),
    "parquet": (b"PAR1\0\0", "pyarrow"),
    "hdf5": (b"\x89HDF\r\n\x1a\n", "h5py"),
}


@pytest.mark.parametrize("extra", FIRST_BYTES)
def test_without_the_extra_it_is_named(extra, tmp_path, monkeypatch):
    head, library = FIRST_BYTES[extra]
    (tmp_path / "log.dat").write_bytes(head + bytes(64))
    monkeypatch.setattr(handed, "find_spec", lambda name: None)
    with pytest.raises(mp.MultiposError, match=rf"{library} reads.*'multipos\[{extra}\]'"):
        mp.average(tmp_path / "log.dat")


def test_without_openpyxl_the_extra_is_named(tmp_path, monkeypatch):
    path = archive(tmp_path / "log.dat", {"xl/workbook.xml": "<a/>"})
    monkeypatch.setattr(handed, "find_spec", lambda name: None)
    with pytest.raises(mp.MultiposError, match=r"openpyxl reads.*'multipos\[excel\]'"):
        mp.average(path)


def test_old_excel_without_its_library_names_the_extra(tmp_path, monkeypatch):
    path = tmp_path / "Accelerometer.xls"
    path.write_bytes(handed.OLE + bytes(600))
    monkeypatch.setattr(handed, "find_spec", lambda name: None)
    for read in (mp.average, mp.read_readings):
        with pytest.raises(mp.MultiposError, match=r"xlrd reads.*'multipos\[excel\]'"):
            read(path)


def test_readings_in_an_archive_are_no_workbook(tmp_path):
    path = archive(tmp_path / "phone.zip", {"Accelerometer.csv": "ax,ay,az\n0,0,1\n"})
    with pytest.raises(mp.MultiposError, match="no workbook; unpack it, or give a log"):
        mp.read_readings(path)


def test_a_damaged_old_excel_is_one_line(tmp_path):
    pytest.importorskip("xlrd")
    path = tmp_path / "Accelerometer.xls"
    path.write_bytes(handed.OLE + bytes(600))
    with pytest.raises(mp.MultiposError, match=r"cannot read the workbook: .*save it again"):
        mp.average(path)


@pytest.mark.parametrize("extra", FIRST_BYTES)
def test_a_damaged_file_is_one_line(extra, tmp_path, capsys):
    head, library = FIRST_BYTES[extra]
    if find_spec(library) is None:
        pytest.skip(f"no {library}")
    suffix = {"px4": ".ulg", "ardupilot": ".bin", "ros": ".bag"}.get(extra, ".dat")
    path = tmp_path / f"log{suffix}"
    path.write_bytes(head + bytes(range(256)))
    assert main(["average", str(path)]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines()[-1].startswith(f"multipos: error: {path}: cannot read the log: ")


def test_packed_files_are_named_as_they_are(log, tmp_path, capsys):
    path = tmp_path / "log.csv.gz"
    path.write_bytes(gzip.compress(b"time,ax,ay,az\n2,3,4,5\n1,2,3,x\n3,4,5,6\n"))
    assert main(["average", str(path)]) == 1
    assert f"{path}: row 2 (line 3), column 'az'" in capsys.readouterr().err


def test_every_extra_is_one_of_the_package():
    project = Path(__file__).resolve().parents[2] / "pyproject.toml"
    text = project.read_text(encoding="utf-8")
    for extra in (*FIRST_BYTES, "excel"):
        assert f"\n{extra} = [" in text
    assert len({reader.listed for reader in READERS}) == len(READERS)


def test_the_found_is_in_the_json_of_any_kind(log, tmp_path, capsys):
    np.savez(tmp_path / "log.npz", **log)
    assert main(["average", str(tmp_path / "log.npz"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["findings"] == []


@pytest.mark.parametrize(
    "read",
    [
        lambda path, _: mp.average(path, rate=100.0, columns="1,2,3"),
        lambda _, values: mp.fit(
            dict.fromkeys(("up_x", "up_y", "up_z"), values[:, 1]) | {"ax": values[:, 0]}
        ),
        lambda _, values: mp.Readings(values, up=np.ones((6, 3))),
    ],
    ids=["log", "table", "readings"],
)
def test_a_nan_that_signals_is_no_number(read, tmp_path):
    """In single precision, where NumPy warns when such a NaN becomes a double."""
    values = np.ones((6, 3), dtype=np.float32)
    values.view(np.uint32)[1, 0] = 0x7F800001
    np.save(tmp_path / "log.npy", values)
    with pytest.raises(mp.MultiposError, match=r"row 2.* not finite"):
        read(tmp_path / "log.npy", values)


def test_bytes_of_an_array_are_texts(tmp_path):
    rows = np.array([(b"one", b"1.5"), (b"\xbb", b"-2")], dtype=[("label", "S8"), ("ax", "S8")])
    np.save(tmp_path / "log.npy", rows)
    log = open_log(tmp_path / "log.npy")
    (piece,) = log.read(["ax"], [], ["label"])
    assert piece.table.number("ax").tolist() == [1.5, -2.0]
    assert piece.table.text("label") == ("one", "\ufffd")
    rows["ax"][1] = b"\xbb"
    np.save(tmp_path / "log.npy", rows)
    with pytest.raises(mp.MultiposError, match=r"row 2, column 'ax': .* is not a number"):
        list(open_log(tmp_path / "log.npy").read(["ax"]))
