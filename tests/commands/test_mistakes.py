"""What new users get wrong: each is read rightly, or refused with a way out that works.

A row is a file, the command, and either nothing, when the true sensor must come out without a
warning, or what is said and the command that it leads to, which must find the true sensor.
"""

import json
import re

import numpy as np
import pytest
from cli_bench import run
from log_bench import columns_of
from log_bench import sensor as sensor_of_logs

import multipos as mp

MATRIX = np.array([[1.01, 0.003, 0.0], [0.008, 0.99, 0.0], [-0.005, 0.006, 1.02]])
BIAS = np.array([0.03, -0.02, 0.05])
UP = mp.read_scheme("faces-corners-14").up
NOISE = 3e-4 * np.random.default_rng(1).standard_normal(UP.shape)
READ = UP @ MATRIX.T + BIAS + NOISE  # [g]
NAMES = ("ax", "ay", "az")
HEADER = ("position", *NAMES)
DIRECTIONS = ("+X", "-X", "+Y", "-Y", "+Z", "-Z")
WITHIN = 2e-3  # [g], eight times what noise moves a parameter by


def table(header=HEADER, rows=None, *, mark=",", comma=False, end="\n"):
    """Text of a table, of the true readings where none are given."""
    rows = labelled(READ) if rows is None else rows

    def cell(value):
        text = f"{value:.6f}" if isinstance(value, float) else str(value)
        return text.replace(".", ",") if comma and isinstance(value, float) else text

    return end.join(mark.join(map(cell, row)) for row in [header, *rows]) + end


def labelled(readings, first=()):
    """Rows of readings with their number."""
    return [[i + 1, *first, *map(float, row)] for i, row in enumerate(readings)]


def changed(row, column, value):
    rows = labelled(READ)
    rows[row][column] = value
    return rows


def swapped():
    order = np.arange(len(READ))
    order[[2, 7]] = 7, 2
    return labelled(READ[order])


def repeated():
    rows = labelled(READ)
    rows[6] = [7, *rows[5][1:]]
    return rows


def angles(unit):
    roll, pitch = np.arctan2(-UP[:, 1], -UP[:, 2]), np.arcsin(UP[:, 0])
    rows = zip(unit(roll).tolist(), unit(pitch).tolist(), READ.tolist(), strict=True)
    return [[i + 1, r, p, *read] for i, (r, p, read) in enumerate(rows)]


TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
ANGLES = ("position", "roll_deg", "pitch_deg", *NAMES)


def encoded(text, encoding="utf-8"):
    return text.encode(encoding)


FILES = {
    "names.csv": encoded(table(("position", "foo", "bar", "baz"))),
    "semicolon.csv": encoded(table(mark=";")),
    "deccomma.csv": encoded(table(mark=";", comma=True)),
    "deccomma_comma.csv": encoded(table(comma=True)),
    "tabs.csv": encoded(table(mark="\t")),
    "bom.csv": encoded(table(), "utf-8-sig"),
    "crlf.csv": encoded(table(end="\r\n")),
    "utf16.csv": encoded(table(), "utf-16"),
    "units.csv": encoded(
        table(
            ("position", "ax [m/s²]", "ay [m/s²]", "az [m/s²]"),
            labelled(9.80665 * READ),
        )
    ),
    "german.csv": encoded(
        table(("Lage", *(f"Beschleunigung {c}" for c in "XYZ")), mark=";", comma=True)
    ),
    "chinese.csv": encoded(table(("位置", "加速度X", "加速度Y", "加速度Z")), "gb18030"),
    "ms2.csv": encoded(table(rows=labelled(9.80665 * READ))),
    "swapped.csv": encoded(table(rows=swapped())),
    "missing.csv": encoded(table(rows=changed(5, 2, ""))),
    "nan.csv": encoded(table(rows=changed(5, 2, "nan"))),
    "thirteen.csv": encoded(table(rows=labelled(READ)[:5] + labelled(READ)[6:])),
    "empty.csv": b"",
    "header.csv": encoded(table(rows=[])),
    "few.csv": encoded(table(rows=labelled(READ)[:4])),
    "same_twice.csv": encoded(table(rows=repeated())),
    "turned.csv": encoded(table(rows=labelled(UP @ TURN.T @ MATRIX.T + BIAS + NOISE))),
    "upside.csv": encoded(table(rows=labelled(-UP @ MATRIX.T + BIAS + NOISE))),
    "noheader.csv": encoded(table(labelled(READ)[0], labelled(READ)[1:])),
    "named.csv": encoded(table()),
    "deg.csv": encoded(table(ANGLES, angles(np.degrees))),
    "rad.csv": encoded(table(ANGLES, angles(np.asarray))),
    "dirnames.csv": encoded(
        table(
            ("position", "direction", *NAMES),
            [[i + 1, name, *map(float, READ[i])] for i, name in enumerate(DIRECTIONS)],
        )
    ),
    "gyro.csv": encoded(
        table(
            ("time", *NAMES, "gx", "gy", "gz", "temp"),
            [[0.01 * i, *map(float, READ[i]), 0.1, 0.1, 0.1, 25.0] for i in range(14)],
        )
    ),
    "broken.xlsx": b"PK\x03\x04junk",
}
FIT = "fit {} --scheme faces-corners-14"
FIT_G = f"{FIT} --unit g"


def log(scheme="fibonacci-24", **options):
    return columns_of(scheme=scheme, sample_sd=1e-3, **options)


def counts(columns):
    return np.column_stack([np.round(16384 * columns[name]) for name in NAMES]).astype(int)


def timed(columns, values):
    return zip(columns["time"].tolist(), *values.T.tolist(), strict=True)


def write_logs(folder):
    """Raw logs of one sensor, in counts."""
    whole = log()
    y = counts(whole)
    header = ("t", *NAMES)
    few, short = log("faces-6"), log(rest=1.2)
    cut = np.clip(y, -12000, 12000)
    one = slice(0, 600)
    texts = {
        "moving.csv": table(header, timed(whole, y)),
        "six.csv": table(header, timed(few, counts(few))),
        "short.csv": table(header, timed(short, counts(short))),
        "notime.csv": table(NAMES, y.tolist()),
        "saturated.csv": table(header, timed(whole, cut)),
        "onepos.csv": table(header, [*timed(whole, y)][one]),
        "serial.txt": "MPU6050 init ok\n"
        + "".join(f"ax: {a}\tay: {b}\taz: {c}\n" for a, b, c in y.tolist()),
    }
    for name, text in texts.items():
        (folder / name).write_text(text)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("mistakes")
    for name, content in FILES.items():
        (place / name).write_bytes(content)
    write_logs(place)
    (place / "folder").mkdir()
    return place


SILENT = [
    *(
        FIT.format(f"{name}.csv")
        for name in ("names", "semicolon", "deccomma", "tabs", "bom", "crlf", "utf16", "units")
    ),
    FIT.format("noheader.csv"),
    *(FIT.format(f"{name}.csv") for name in ("german", "chinese", "gyro")),
    "fit deg.csv --unit g",
    "fit dirnames.csv --unit g",
    "calibrate moving.csv",
    "calibrate short.csv",
    "calibrate serial.txt --rate 100",
]


# command, what is said of it, and the command that this leads to
SAID = [
    (FIT.format("deccomma_comma.csv"), "with semicolons between cells", FIT.format("deccomma.csv")),
    (FIT_G.format("ms2.csv"), r"State --unit m/s\^2", f"{FIT} --unit m/s^2".format("ms2.csv")),
    (
        FIT_G.format("swapped.csv"),
        "3, 8 are .*interchanged.*Exchange",
        FIT.format("crlf.csv"),
    ),
    (FIT_G.format("missing.csv"), r"row 6 .*'ay'.*leave the row out", FIT.format("thirteen.csv")),
    (FIT_G.format("nan.csv"), r"row 6 .*'ay'.*leave the row out", FIT.format("thirteen.csv")),
    (FIT_G.format("empty.csv"), "is empty; give a header and rows", None),
    (FIT_G.format("header.csv"), "give one row per position", None),
    (FIT_G.format("few.csv"), r"fit '1 \+ x \+ y'", None),
    (
        f"{FIT_G} --exclude none".format("same_twice.csv"),
        "--exclude 7",
        f"{FIT_G} --exclude 7".format("same_twice.csv"),
    ),
    (FIT_G.format("turned.csv"), "--axes -y,x,z", f"{FIT_G} --axes -y,x,z".format("turned.csv")),
    (
        FIT_G.format("upside.csv"),
        "--convention gravity",
        f"{FIT_G} --convention gravity".format("upside.csv"),
    ),
    ("fit rad.csv --unit g", "Convert the angles to degrees", "fit deg.csv --unit g"),
    ("calibrate six.csv", "bias and scale factor of each output are fitted", None),
    ("calibrate notime.csv", "Add --rate", "calibrate notime.csv --rate 100"),
    ("calibrate saturated.csv", "saturated at 12000 .*wider range", "calibrate moving.csv"),
    ("calibrate onepos.csv", "record them in one log", "calibrate moving.csv"),
    ("calibrate broken.xlsx", "write it again", None),
    ("fit broken.xlsx", r"save it again as .xlsx or CSV", FIT.format("crlf.csv")),
    ("fit nosuch.csv", "no such file; check the path", FIT.format("crlf.csv")),
    ("fit folder", "Is a directory; check the path", FIT.format("crlf.csv")),
    ("fit crlf.csv --scheme face-6", "give a file or one of .*faces-corners-14", None),
    ("fit crlf.csv --shceme faces-6", "did you mean '--scheme'", FIT.format("crlf.csv")),
    ("fitt crlf.csv", "did you mean 'fit'", FIT.format("crlf.csv")),
    (
        "fit crlf.csv --scheme faces-corners-14 --model quadratic",
        "give linear, own-quadratic",
        f"{FIT} --model own-quadratic".format("crlf.csv"),
    ),
    ("fit crlf.csv --scheme faces-6", "of 14 positions: faces-corners-14", FIT.format("crlf.csv")),
    ("fit crlf.csv", "give --scheme", FIT.format("crlf.csv")),
    (
        "calibrate crlf.csv",
        "multipos fit crlf.csv --unknown-orientation",
        FIT.format("crlf.csv"),
    ),
    (
        "fit moving.csv --unknown-orientation",
        "multipos calibrate moving.csv",
        "calibrate moving.csv",
    ),
    ("fit moving.csv --scheme fibonacci-24", "multipos average moving.csv", "calibrate moving.csv"),
    ("fit moving.csv", "multipos calibrate moving.csv", "calibrate moving.csv"),
    (f"{FIT} --unit mg".format("crlf.csv"), "State --unit g", FIT_G.format("crlf.csv")),
    (f"{FIT} --unit m/s2".format("crlf.csv"), "State --unit g", FIT_G.format("crlf.csv")),
]


def require_right(out):
    """Find bias and own scale factor, in g, of the sensor that the readings were made of."""
    cal = json.loads(out)
    found = {each["name"]: each["value"] for each in cal["parameters"]}
    outputs = [each["output"] for each in cal["parameters"] if each["term"] == "1"]
    if cal["estimator"] == "unknown-orientation":
        truth, size = sensor_of_logs(), 16384.0
        wanted = [[truth[f"{kind}_{n}"].value for n in NAMES] for kind in ("bias", "scale")]
    else:
        size = 9.80665 if cal["unit"] == "m/s^2" else 1.0
        wanted = [BIAS, np.diag(MATRIX)]
    own = np.array([[found[f"{kind}_{name}"] for name in outputs] for kind in ("bias", "scale")])
    own[1] = np.abs(own[1])  # --axes -y: the output falls as y rises
    np.testing.assert_allclose(own / size, wanted, rtol=0, atol=WITHIN)


@pytest.mark.parametrize("command", SILENT)
def test_what_is_read_rightly_without_a_word(command, folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    status, _, err = run(capsys, *command.split())
    assert (status, err) == (0, "")
    _, out, _ = run(capsys, *command.split(), "--json")
    require_right(out)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("swapped", "2 of 14 positions set aside: 3 (919 mg), 8 (920 mg)\n"),
        ("same_twice", "1 of 14 positions set aside: 7 (1.78e+03 mg)\n"),
    ],
)
def test_what_does_not_fit_is_set_aside_by_name(name, said, folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    command = FIT_G.format(f"{name}.csv").split()
    status, out, err = run(capsys, *command)
    assert (status, "not fit for use" in err) == (0, False)
    assert said in out
    assert f" {14 - int(said[0])} of 14 positions: " in out.splitlines()[0]
    require_right(run(capsys, *command, "--json")[1])


@pytest.mark.parametrize(("command", "said", "way_out"), SAID)
def test_what_is_refused_has_a_way_out(command, said, way_out, folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    if "xlsx" in command:
        pytest.importorskip("openpyxl")
    _, _, err = run(capsys, *command.split())
    assert re.search(said, err), err
    if way_out is None:
        return
    status, out, _ = run(capsys, *way_out.split(), "--json")
    assert status == 0
    require_right(out)
