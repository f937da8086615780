"""From a raw log to readings: formats, labels, faults, and what the command prints."""

import gzip
import json
import re
import tracemalloc
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from findings_bench import EXACT, texts
from log_bench import columns_of, sensor, shared, write_csv

import multipos as mp
from multipos.cli import main
from multipos.logs.averaging import average
from multipos.logs.faults import _semi_axes, compare_scales, find_faults, suspects
from multipos.logs.matching import Match, _from_ranges, match_directions
from multipos.logs.opening import open_log, read_log
from multipos.logs.rest_means import RestMean

FERRARIS = ("acc_x", "acc_y", "acc_z")


@pytest.fixture(scope="module")
def log():
    return columns_of()


def failing(capsys, *argv):
    """Run a command that must fail; return its exit status and error line, stdout being empty."""
    status = main([*map(str, argv)])
    out, err = capsys.readouterr()
    assert out == ""
    last = err.strip().splitlines()[-1]
    assert last.startswith("multipos: error: ")
    return status, last


# --- formats


@pytest.mark.parametrize(
    "form", ["comma", "semicolon", "tab", "space", "bare", "npz", "npy", "mat"]
)
def test_every_format_gives_the_same(form, log, tmp_path):
    matrix = np.column_stack(list(log.values()))
    names = tuple(log)
    path = tmp_path / f"log.{form if form in ('npz', 'npy', 'mat') else 'txt'}"
    columns = None
    if form == "npz":
        np.savez(path, time=log["time"], a=matrix[:, 1:4], rate=100.0)
        columns = names
    elif form == "npy":
        np.save(path, matrix)
        columns = names
    elif form == "mat":
        from scipy.io import savemat

        savemat(path, {"t": log["time"], "a": matrix[:, 1:4]})
        columns = ("time", "ax", "ay", "az")
    elif form == "semicolon":
        text = "time;ax;ay;az\n" + "\n".join(
            ";".join(repr(float(cell)).replace(".", ",") for cell in row) for row in matrix
        )
        path.write_bytes(b"\xef\xbb\xbf# made by hand\r\n" + text.replace("\n", "\r\n").encode())
    else:
        mark = {"comma": ",", "tab": "\t", "space": "   ", "bare": " "}[form]
        write_csv(path, log, header=form != "bare", delimiter=mark)
        columns = names if form == "bare" else None
    found = average(path, columns=columns)
    expected = average(log)
    np.testing.assert_allclose(found.readings.values, expected.readings.values, rtol=1e-12)
    assert found.sample_rate == pytest.approx(100.0)
    assert [rest.rows for rest in found.rests] == [rest.rows for rest in expected.rests]


def test_without_header_columns_are_numbers(log, tmp_path):
    path = write_csv(tmp_path / "log.csv", {n: c for n, c in log.items() if n != "time"}, False)
    found = average(path, rate=100.0)
    assert found.outputs == ("1", "2", "3")
    assert found.rests[0].time == (0.0, pytest.approx((found.rests[0].rows.end - 1) / 100.0))


def test_content_decides_before_the_suffix(log, tmp_path):
    with (tmp_path / "log.csv").open("wb") as stream:
        np.savez(stream, **log)
    assert average(tmp_path / "log.csv").readings.values.shape == (6, 3)


def test_a_temperature_is_known_in_letters_of_whatever_case(tmp_path):
    log = dict(columns_of())
    log["Temperature (°C)"] = np.full(len(log["time"]), 24.5)
    for source in (log, write_csv(tmp_path / "log.csv", log)):
        assert mp.average(source).readings.environment["temperature"] == pytest.approx(24.5)


def test_a_column_in_degrees_celsius_is_no_output():
    log = dict(columns_of())
    log = {"time": log["time"], "Ux (V)": log["ax"], "Uy (V)": log["ay"]}
    log["Temp (degC)"] = np.full(len(log["time"]), 24.5)
    readings = mp.average(log).readings
    assert readings.outputs == ("Ux", "Uy")
    assert readings.environment["Temp"] == pytest.approx(24.5)


def test_other_columns_are_averaged_along(tmp_path, capsys):
    log = dict(columns_of())
    n = len(log["time"])
    log["temperature"] = np.linspace(20.0, 30.0, n)
    log["wx"] = np.full(n, 0.5)
    path = write_csv(tmp_path / "log.csv", log)
    text = path.read_text().splitlines()
    # A slow sensor leaves cells empty, and a text column is of no use.
    rows = [
        f"{row.rsplit(',', 2)[0]},,0.5,ok" if i % 3 else f"{row},ok"
        for i, row in enumerate(text[1:])
    ]
    path.write_text("\n".join([f"{text[0]},status", *rows]) + "\n")
    out = tmp_path / "readings.csv"
    assert main(["average", str(path), "--outputs", "ax,ay,az", "-v", "-o", str(out)]) == 0
    assert "column 'status' holds text and is not used" in capsys.readouterr().err
    readings = mp.read_readings(out)
    assert readings.outputs == ("ax", "ay", "az")  # wx has no sd_… and is no output
    middle = np.interp(readings.environment["time"], log["time"], log["temperature"])
    np.testing.assert_allclose(readings.environment["temperature"], middle, atol=0.01)
    assert readings.u is not None
    assert (readings.u > 0.0).all()
    np.testing.assert_allclose(np.genfromtxt(out, delimiter=",", names=True)["wx"], 0.5, rtol=1e-12)
    assert mp.fit(out, scheme="faces-6").outputs == ("ax", "ay", "az")


def test_read_log_keeps_texts(tmp_path):
    (tmp_path / "log.csv").write_text('a,b\n1,"x, y"\n,z\n3,w\n')
    found = read_log(open_log(tmp_path / "log.csv"))
    np.testing.assert_array_equal(found["a"], [1.0, np.nan, 3.0])
    assert found["b"] == ["x, y", "z", "w"]


# --- rests


def test_the_mean_is_that_of_the_samples(log):
    found = average(log)
    for rest in found.rests:
        rows = slice(*rest.rows)
        samples = np.column_stack([log[name][rows] for name in ("ax", "ay", "az")])
        np.testing.assert_allclose(rest.found.mean, samples.mean(axis=0), rtol=1e-13)
        np.testing.assert_allclose(rest.found.sd, samples.std(axis=0, ddof=1), rtol=1e-10)


def test_means_lie_within_their_uncertainties():
    """Errors of the means over their u, of a sensor whose noise remembers 0.1 s: χ² of 126."""
    cal = sensor()
    z = []
    for seed in range(3):
        log = columns_of(cal, "faces-corners-14", seed=seed, correlation_time=0.1, rest=20.0)
        found = average(log)
        truth = cal.predict(mp.read_scheme("faces-corners-14").up)
        z.append((found.readings.values - truth) / found.readings.u)
    # 99.9 % of χ²(126)/126 lies within 0.63 and 1.47; u itself is known to about 15 %.
    assert 0.6 < np.mean(np.square(z)) < 1.6


def test_sections_of_the_real_session():
    """The means by sections and by detection are the same within their uncertainties."""
    path = shared("ferraris_session.csv")
    sections = shared("ferraris_session_sections.json")
    samples = np.loadtxt(path, delimiter=",", skiprows=1)[:, 4:]
    known = average(path, outputs=FERRARIS, rate=102.4, sections=sections)
    for rest in known.rests[:6]:
        np.testing.assert_allclose(
            rest.found.mean, samples[slice(*rest.rows)].mean(axis=0), rtol=1e-12
        )
    moving = [
        rest.position for rest in known.rests if any("sensor moved" in n for n in texts(rest))
    ]
    assert moving == ["x_rot", "y_rot", "z_rot"]
    found = average(path, outputs=FERRARIS, rate=102.4, scheme="faces-6")
    order = ["x_p", "x_a", "y_p", "y_a", "z_p", "z_a"]
    labels = dict(zip(order, "123456", strict=True))
    for rest in known.rests[:6]:
        start, end = rest.rows
        same = [other for other in found.rests if other.rows.start < end > start < other.rows.end]
        assert [other.position for other in same] == [labels[rest.position]]
        u = np.hypot(rest.found.u, same[0].found.u)
        # 18 differences at 3.5 sd: a false alarm in 120; common samples only make it safer.
        assert (np.abs(rest.found.mean - same[0].found.mean) < 3.5 * u).all()


def test_the_real_session_gives_the_figures_known_for_it():
    path = shared("ferraris_session.csv")
    order = "x_p,x_a,y_p,y_a,z_p,z_a"
    found = average(
        path,
        outputs=FERRARIS,
        rate=102.4,
        only=order,
        scheme="faces-6",
        sections=shared("ferraris_session_sections.json"),
    )
    values = found.readings.values
    cal = mp.fit(mp.Readings(values, outputs=FERRARIS, up=found.scheme_up), **EXACT)
    bias = [cal[name, "1"].value for name in FERRARIS]
    np.testing.assert_allclose(bias, [0.551, -0.620, 0.386], atol=6e-4)
    np.testing.assert_allclose(cal.residual_sd, [0.032, 0.014, 0.018], atol=6e-4)


def test_the_real_log_gives_the_figures_known_for_it():
    """Nine parameters by a small independent least squares on |f| − 1."""
    from scipy.optimize import least_squares

    path = shared("mpu9150_imu0.log")
    found = average(path, columns="ax,ay,az,wx,wy,wz", outputs="ax,ay,az", rate=100.0)
    assert len(found.rests) == 23
    y = found.readings.values

    def residuals(p):
        lower = np.zeros((3, 3))
        lower[np.tril_indices(3)] = p[3:]
        return np.linalg.norm(np.linalg.solve(lower, (y - p[:3]).T), axis=0) - 1.0

    start = np.array([0.0, 0.0, 0.0, 9.8, 0.0, 9.8, 0.0, 0.0, 9.8])
    solved = least_squares(residuals, start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    # The figures known are of another program's rests, which are shorter: a tenth of a milli-g.
    np.testing.assert_allclose(solved.x[:3], [0.1024, 0.0966, 0.3435], atol=1.5e-3)
    assert 100e-6 < np.sqrt(np.mean(solved.fun**2)) < 188e-6


def test_the_real_log_by_unknown_orientation():
    path = shared("mpu9150_imu0.log")
    found = average(path, columns="ax,ay,az,wx,wy,wz", outputs="ax,ay,az", rate=100.0)
    readings = mp.Readings(found.readings.values)
    cal = mp.fit(readings, unknown_orientation=True)
    bias = [cal[name, "1"].value for name in ("ax", "ay", "az")]
    np.testing.assert_allclose(bias, [0.1024, 0.0966, 0.3435], atol=1.5e-3)
    assert 100e-6 < cal.rms < 188e-6


def test_sections_from_csv_and_only(log, tmp_path):
    path = write_csv(tmp_path / "log.csv", log)
    (tmp_path / "s.csv").write_text("position,start,end\na,10,300\nb,650,900\nc,0,390\n")
    found = average(path, sections=tmp_path / "s.csv", only=["a", "b"])
    assert [rest.position for rest in found.rests] == ["a", "b"]
    assert [rest.found.n for rest in found.rests] == [290, 250]


# --- matching


@pytest.mark.parametrize("name", ["faces-6", "faces-corners-14", "song-qin-6", "roll-z-12"])
@pytest.mark.parametrize("convention", ["specific-force", "gravity"])
def test_rests_find_their_positions(name, convention):
    scheme = mp.read_scheme(name)
    rng = np.random.default_rng(4)
    order = rng.permutation(len(scheme))
    sign = -1.0 if convention == "gravity" else 1.0
    cal = sensor(bias=0.1)
    parts = []
    for k in order:
        still = np.repeat(cal.predict(sign * scheme.up[k : k + 1]), 400, axis=0)
        parts += [still + 1e-3 * rng.normal(size=still.shape), 0.3 * rng.normal(size=(150, 3))]
    samples = np.concatenate(parts)
    data = dict(zip(("ax", "ay", "az"), samples.T, strict=True))
    found = average(data, rate=100.0, scheme=name, convention=convention)
    assert [rest.position for rest in found.rests] == [scheme.labels[k] for k in order]
    assert max(rest.distance_deg for rest in found.rests) < 10.0
    np.testing.assert_array_equal(found.scheme_up, scheme.up[order])


def test_outputs_of_any_scale_and_bias_are_matched():
    """Scale factors 1, 20 and 300: as they stand, all readings point along z."""
    scheme = mp.read_scheme("faces-corners-14")
    order = [13, 0, 7, 5, 2, 9, 11, 1, 8, 3, 12, 4, 10, 6]
    match = match_directions(
        [0.5, -40.0, 100.0] + scheme.up[order] * [1.0, 20.0, 300.0], scheme, "specific-force"
    )
    assert match.rows == order
    np.testing.assert_allclose(match.distance_deg, 0.0, atol=1e-6)
    # from a face to the corners about it acos(1/√3), between corners 2 asin(1/√3), which is more
    np.testing.assert_allclose(match.second_deg, np.degrees(np.arccos(1 / np.sqrt(3))), rtol=1e-9)


def test_a_match_is_doubtful_beyond_20_degrees_or_half_the_way_to_the_next():
    match = Match([0] * 5, np.array([9.9, 10.1, 0.1, 19.9, 20.1]), np.array([20, 20, 0.3, 40, 90]))
    assert match.doubtful.tolist() == [False, True, False, False, True]


def test_readings_of_a_matched_log_need_no_scheme(log, tmp_path, capsys):
    path = write_csv(tmp_path / "log.csv", log)
    out = tmp_path / "r.csv"
    assert main(["average", str(path), "--scheme", "faces-6", "-o", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    first = found["positions"][0]
    assert {"position", "t_start", "t_end", "n", "mean", "sd", "u"} <= set(first)
    assert set(first["mean"]) == {"ax", "ay", "az"}
    assert found["sample_rate"] == pytest.approx(100.0)
    assert found["threshold"] > 0.0
    cal, truth = mp.fit(out), sensor()
    z = (cal.parameters - truth.parameters) / cal.u
    assert np.abs(z).max() < 4.5  # 12 of them


def test_twins_are_named(log):
    twice = {name: np.concatenate([c, c[:400]]) for name, c in log.items() if name != "time"}
    found = average(twice, rate=100.0)
    assert any("such pairs are repeats" in text and "1 and 7" in text for text in texts(found))


def test_drift_motion_and_gaps_are_named(log):
    changed = {name: column.copy() for name, column in log.items()}
    changed["ax"][600:1000] += np.linspace(0.0, 5e-3, 400)
    changed["time"][1500:] += 0.5
    found = average(changed)
    assert any("'ax' drifted by" in note for note in texts(found.rests[1]))
    assert any("the time has 1 gap" in note for note in texts(found.rests[2]))
    moved = average(log, sections={"a": {"start": 0, "end": 400}, "b": {"start": 300, "end": 700}})
    assert any("moved during" in note for note in texts(moved.rests[1]))
    assert texts(moved.rests[0]) == ()


def a_rest(**changes):
    """Return what one output says at rest: 1000 samples of sd 1e-3, nothing wrong with it."""
    one, count = np.ones(1), np.ones(1, dtype=np.int64)
    plain = RestMean(
        n=1000,
        mean=0.5 * one,
        sd=1e-3 * one,
        u=1e-4 * one,
        drift=0.0 * one,
        drift_u=1e-4 * one,
        edge=0.0 * one,
        low=0.4 * one,
        high=0.6 * one,
        at_low=count,
        at_high=count,
        longest=count,
        dof=99.0 * one,
        drift_factor=one,
        cosines=np.ones((1, 8)),
        common=one,
    )
    new = {name: np.full_like(getattr(plain, name), value) for name, value in changes.items()}
    return replace(plain, **new)


@pytest.mark.parametrize(
    ("below", "above", "said"),
    [
        ({"drift": -4.9e-4}, {"drift": -5.1e-4}, "'a' drifted by -0.00051"),  # five times its u
        (
            {"edge": 4.9},
            {"edge": 5.1},
            "'a' differs at the beginning or end, as if the sensor moved there",
        ),
        ({"sd": 2.9e-3}, {"sd": 3.1e-3}, "'a' has 3.1 times the usual noise; its u includes it"),
        ({"longest": 99}, {"longest": 100}, "'a' repeats one value 100 times"),  # a tenth
    ],
)
def test_faults_of_a_rest_begin_where_they_are_said_to(below, above, said):
    for changes, notes in ((below, []), (above, [said])):
        rests = [a_rest(**changes), a_rest(mean=-0.5), a_rest(mean=0.0)]
        faults, twins = find_faults(("a",), rests, np.array([1e-6]), [0] * 3, [None] * 3, "123")
        assert [[each.text for each in one] for one in faults] == [notes, [], []]
        assert twins == []


def test_sections_that_are_all_in_motion_have_no_twins():
    rests = [a_rest(mean=0.5), a_rest(mean=0.5)]
    faults, twins = find_faults(("a",), rests, np.array([1e-6]), [0] * 2, [0.5, 0.5], "12")
    assert [[each.text for each in one] for one in faults] == [
        ["the sensor moved during 50 % of the time"]
    ] * 2
    assert twins == []


def test_motion_of_a_section_and_twins_begin_where_they_are_said_to():
    rests = [a_rest(mean=0.5), a_rest(mean=-0.5), a_rest(mean=0.0), a_rest(mean=0.0)]
    still = find_faults(("a",), rests, np.array([1e-6]), [0] * 4, [0.09, 0.11, 0.0, 0.0], "1234")
    assert [[each.text for each in one] for one in still[0][:2]] == [
        ["the sensor moved at the beginning or end"],
        ["the sensor moved during 11 % of the time"],
    ]
    # two degrees of half the range of 1
    for apart, twins in ((1.99, 1), (2.01, 0)):
        rests[3] = a_rest(mean=0.5 * np.radians(apart))
        found = find_faults(("a",), rests, np.array([1e-6]), [0] * 4, [None] * 4, "1234")
        assert len(found[1]) == twins


def test_a_gap_is_more_than_three_steps_of_the_time(log):
    for more, notes in ((0.0199, []), (0.0201, ["the time has 1 gap. Check the logger."])):
        time = log["time"].copy()
        time[1500:] += more  # beside the usual step of 0.01 s
        found = average(log | {"time": time})
        assert [text for text in texts(found.rests[2]) if "gap" in text] == notes


def test_units_are_told_by_the_semi_axes_of_what_was_seen():
    """Of the ellipsoid with axes 1, 1 and 2.9 or 3.1 about (5, 0, -7), seen from above only."""
    up = mp.read_scheme("all-26").up
    seen = up[up[:, 2] > -0.6]
    for axis in (2.9, 3.1):
        means = [5.0, 0.0, -7.0] + seen * [1.0, 1.0, axis]
        np.testing.assert_allclose(_semi_axes(means), [1.0, 1.0, axis], rtol=1e-9)
        said = compare_scales(("a", "b", "c"), means)
        assert (said is None) == (axis < 3.0)
        assert said is None or re.match(r"'c' is 3\.1 times as sensitive as '[ab]'", said.text)
    assert compare_scales(("a", "b", "c"), seen * [1.0, 1.0, 1e-310]) is None  # no number is left


# --- bad input: clear words, nothing written


def clipped(log):
    return log | {"az": np.clip(log["az"], -0.9, 0.9)}


def stuck(log):
    az = log["az"].copy()
    az[600:1000] = az[600]
    return log | {"az": az}


def backwards(log):
    time = log["time"].copy()
    time[700] = 1.0
    return log | {"time": time}


def mixed(log):
    return log | {"ay": log["ay"] * 9.80665}


BAD = {
    "saturated": (clipped, [], 1, "output 'az' is saturated at"),
    "stuck": (stuck, [], 1, "output 'az' is stuck at"),
    "backwards": (backwards, [], 1, "row 701 (line 702), column 'time': the time runs backwards"),
    "mixed units": (mixed, [], 1, "their units probably differ"),
    "named units": (
        lambda log: {"time": log["time"], "ax [g]": log["ax"], "ay [m/s^2]": log["ay"]},
        [],
        1,
        "have mixed units",
    ),
    "one long rest": (lambda log: {n: c[:390] for n, c in log.items()}, [], 1, "one rest only"),
    "no rest": (
        lambda log: (
            log
            | {
                n: np.sin(np.arange(len(log["time"])) / 100.0 + i)
                for i, n in enumerate(("ax", "ay", "az"))
            }
        ),
        [],
        1,
        "the log has no rest",
    ),
    "too short": (lambda log: {n: c[:50] for n, c in log.items()}, [], 1, "fewer than one rest"),
    "no such output": (lambda log: log, ["--outputs", "bx"], 1, "no column 'bx'"),
    "an output twice": (lambda log: log, ["--outputs", "ax,ax,ax"], 2, "names a column twice"),
    "too many outputs": (
        lambda log: dict.fromkeys("abcd", log["ax"] ** 2),  # no three of which are gravity
        [],
        2,
        "4 columns could be outputs: a, b, c, d; name them with --outputs",
    ),
    "a clock too fast": (
        lambda log: log | {"time": 1e-20 * log["time"]},
        [],
        1,
        "column 'time' steps by 1e-22, no time between samples in seconds",
    ),
    "two clocks": (lambda log: log, ["--rate", "5", "--time-column", "time"], 2, "give one"),
    "threshold": (lambda log: log, ["--threshold", "-1"], 2, "--threshold must be above 0"),
    "columns": (lambda log: log, ["--columns", "a,b"], 2, "names 2 columns, but"),
    "only": (lambda log: log, ["--only", "9"], 1, "--only names '9', but the rests are 1, 2"),
    "wrong scheme": (lambda log: log, ["--scheme", "corners-8"], 1, "match no position"),
    "unknown scheme": (lambda log: log, ["--scheme", "faces"], 2, "unknown scheme"),
    "no sections": (lambda log: log, ["--sections", "none.json"], 1, "no such file"),
}


@pytest.mark.parametrize("case", BAD, ids=str)
def test_bad_logs(case, log, tmp_path, capsys):
    change, options, status, message = BAD[case]
    path = write_csv(tmp_path / "log.csv", change(dict(log)))
    out = tmp_path / "readings.csv"
    found, error = failing(capsys, "average", path, "-o", out, *options)
    assert message in error
    assert found == status
    assert not out.exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty"),
        ("time,ax\n", "only a header, no rows"),
        ("ax,ax\n1,2\n", "column 'ax' appears twice"),
        ("ax,ay\n1,2\n3\n4,5\n", "row 2 (line 3) has 1 cells where there are 2 columns"),
        ("t,ax,ay\n1,2\n2,3\n3,4\n", "line 1 names 3 columns, the last 'ay', but the rows"),
        ("ax,ay\n1,2\n3,x\n", "row 2 (line 3), column 'ay': 'x' is not a number"),
        ("ax,ay\n1,2\n\n# gone\n3,nan\n", "row 2 (line 5), column 'ay': 'nan' is not finite"),
        ("name\nfoo\nbar\n", "no numeric column can be an output"),
        ("ax\0ay\n", "neither text nor a format that is read"),
    ],
)
def test_bad_files(text, message, tmp_path, capsys):
    path = tmp_path / "log.csv"
    path.write_text(text)
    status, error = failing(capsys, "average", path)
    assert message in error
    assert status == 1


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("log.csv", b"ax\n\xff\xfe1\n", "is not UTF-8"),
        ("log.npz", b"PK\x03\x04 broken", "cannot read the log"),
        ("log.npy", b"\x93NUMPY\x01\x00broken", "cannot read the log"),
    ],
)
def test_bad_bytes(name, content, message, tmp_path, capsys):
    (tmp_path / name).write_bytes(content)
    status, error = failing(capsys, "average", tmp_path / name)
    assert message in error
    assert status == 1


@pytest.mark.parametrize("value", ["1e30", "-1e155", "1e308"])
@pytest.mark.parametrize("name", ["ax", "ambient_p"])
def test_a_corrupt_number_is_named(name, value, log, tmp_path, capsys):
    path = write_csv(tmp_path / "log.csv", log | {"ambient_p": np.full(len(log["ax"]), 1e5)})
    lines = path.read_text().splitlines()
    place = lines[0].split(",").index(name)
    cells = lines[701].split(",")
    cells[place] = value
    lines[701] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")
    status, error = failing(capsys, "average", path)
    assert status == 1
    where = f"row 701 (line 702), column '{name}'"
    assert f"{where}: {float(value):g} is no number that is measured" in error


def test_an_array_of_python_2_is_read_in_silence(tmp_path, capsys):
    np.save(tmp_path / "log.npy", np.tile([0.0, 0.0, 1.0], (500, 1)))
    whole = (tmp_path / "log.npy").read_bytes()
    (tmp_path / "log.npy").write_bytes(whole.replace(b"(500, 3), }  ", b"(500L, 3L), }"))
    assert main(["average", str(tmp_path / "log.npy"), "--rate", "50"]) == 1
    err = capsys.readouterr().err
    assert "every sample of the log is the same" in err  # so it was read
    assert "Python 2" not in err


@pytest.mark.parametrize("shape", [(), (0, 3), (3, 0), (1, 50, 3)])
def test_an_array_that_is_no_table_is_refused(shape, tmp_path, capsys):
    np.save(tmp_path / "log.npy", np.zeros(shape))
    sensor().save(tmp_path / "cal.json")
    for argv in (["average"], ["apply", tmp_path / "cal.json"]):
        status, error = failing(capsys, *argv, tmp_path / "log.npy")
        assert status == 1
        assert "no arrays of samples" in error or f"an array of shape {shape}; give" in error


def test_an_archive_whose_names_are_no_text_is_refused(tmp_path, capsys):
    np.savez(tmp_path / "log.npz", äx=np.zeros((50, 3)))
    whole = (tmp_path / "log.npz").read_bytes()
    (tmp_path / "log.npz").write_bytes(whole.replace("ä".encode(), b"\xc3\x28"))
    status, error = failing(capsys, "average", tmp_path / "log.npz")
    assert status == 1
    assert "log.npz: cannot read the log" in error


def test_what_is_no_array_in_an_archive_is_left_out(tmp_path, capsys):
    np.savez(tmp_path / "log.npz", ax=np.zeros((50, 3)))
    whole = (tmp_path / "log.npz").read_bytes()
    (tmp_path / "log.npz").write_bytes(whole.replace(b"ax.npy", b"axxnpy"))
    status, error = failing(capsys, "average", tmp_path / "log.npz")
    assert status == 1
    assert error.startswith("multipos: error:")
    assert "a fault of multipos" not in error


@pytest.mark.parametrize("order", "<>")
def test_an_array_of_what_is_no_text_is_refused(order, tmp_path, capsys):
    np.save(tmp_path / "log.npy", np.full((50, 3), "0.25", dtype=f"{order}U4"))
    whole = (tmp_path / "log.npy").read_bytes()
    (tmp_path / "log.npy").write_bytes(whole[:-64] + b"\xff" * 64)
    sensor().save(tmp_path / "cal.json")
    for argv in (["average"], ["apply", tmp_path / "cal.json", "--columns", "ax,ay,az"]):
        status, error = failing(capsys, *argv, tmp_path / "log.npy")
        assert status == 1
        assert "log.npy: cannot read the log: column '1' has text that is none" in error


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[1, 2]", "no column 'position', 'start', 'end'"),
        ("{", "not valid JSON"),
        ("{}", "no sections"),
        ('{"a": {"start": 5, "end": 5}}', "at least two rows after"),
        ('{"a": {"start": 0.5, "end": 5}}', "whole numbers of rows"),
        ('{"a": {"start": 1}}', "whole numbers of rows"),
        ('{"a": {"start": 0, "end": 100000}}', "but the log has"),
        ("[" * 100_000, "nested too deeply; write the sections again"),
        (f'{{"a": {{"start": 0, "end": {"9" * 5000}}}}}', "whole numbers of rows"),
    ],
)
def test_bad_sections(content, message, log, tmp_path, capsys):
    path = write_csv(tmp_path / "log.csv", log)
    (tmp_path / "s.json").write_text(content)
    status, error = failing(capsys, "average", path, "--sections", tmp_path / "s.json")
    assert message in error
    assert status == 1


def test_two_outputs_are_matched_in_order(log, tmp_path, capsys):
    path = write_csv(tmp_path / "log.csv", {n: log[n] for n in ("time", "ax", "ay")})
    found = average(path, scheme="faces-6")
    assert [rest.position for rest in found.rests] == list("123456")
    assert max(rest.distance_deg for rest in found.rests) < 3.0
    assert not any("nearly the same" in text for text in texts(found))  # ±z read the same
    _, error = failing(capsys, "average", path, "--scheme", "corners-8")
    assert "6 rests were found and scheme 'corners-8' has 8 positions" in error
    _, error = failing(capsys, "average", path, "--scheme", "roll-y-6")
    assert "6 of 6 rests match no position" in error


@pytest.mark.parametrize(("names", "scheme"), [("ay az", "roll-x-12"), ("az ax", "roll-y-12")])
def test_two_outputs_sense_the_axes_they_name(names, scheme):
    log = columns_of(scheme=scheme)
    found = average({n: log[n] for n in ("time", *names.split())}, scheme=scheme)
    assert [rest.position for rest in found.rests] == [str(i + 1) for i in range(12)]
    assert max(rest.distance_deg for rest in found.rests) < 3.0


def test_three_outputs_in_another_order_are_matched_by_their_names(log):
    found = average(log, outputs="az,ax,ay", scheme="faces-6")
    assert [rest.position for rest in found.rests] == list("123456")


def test_a_log_of_rolls_is_matched_by_two_outputs():
    """The 48 rolls of a dual-axis inclinometer, of which half read the same as another."""
    found = average(
        {n: c for n, c in columns_of(scheme="dual-axis-48").items() if n != "az"},
        scheme="dual-axis-48",
    )
    scheme = mp.read_scheme("dual-axis-48")
    assert [rest.position for rest in found.rests] == list(scheme.labels)
    np.testing.assert_array_equal(found.scheme_up, scheme.up)
    assert not any("nearly the same" in text for text in texts(found))


# --- length


@pytest.mark.slow
def test_memory_does_not_grow_with_the_log(tmp_path):
    rng = np.random.default_rng(0)
    one = np.repeat(mp.read_scheme("faces-6").up, 20_000, axis=0)
    samples = one + 1e-3 * rng.normal(size=one.shape)
    text = "".join(f"{x:.6f},{y:.6f},{z:.6f}\n" for x, y, z in samples.tolist())
    peaks = []
    for times in (4, 8):
        path = tmp_path / f"{times}.csv"
        with path.open("w") as stream:
            stream.writelines(["ax,ay,az\n", *[text] * times])
        tracemalloc.start()
        assert len(average(path, rate=1000.0).rests) == 6 * times
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0]


def test_rests_of_one_code_have_the_uncertainty_of_rounding():
    """Noise of .2 mg on steps of 8 mg: a mean is off by anything up to 4 mg, of sd 8/√12 mg."""
    rng, step, pushed = np.random.default_rng(1), 8e-3, []
    up = mp.read_scheme("faces-6").up
    rows = {f"{k}": {"start": 300 * k, "end": 300 * k + 300} for k in range(6)}
    for _ in range(40):
        zero = rng.uniform(-0.01, 0.01, 3)
        values = np.repeat(up + zero, 300, axis=0) + 2e-4 * rng.standard_normal((1800, 3))
        columns = dict(zip(("ax", "ay", "az"), (step * np.round(values / step)).T, strict=True))
        found = mp.average({"time": np.arange(1800) / 100.0} | columns, sections=rows)
        assert "quantized" in {each.code for each in found.findings}
        pushed.append((found.readings.values - up - zero) / found.readings.u)
    # within a session roundings repeat; over 120 of them the rms of a uniform law is 1 ± .06
    assert 0.8 < np.sqrt(np.mean(np.square(pushed))) < 1.15


def test_rounding_of_rests_of_a_fifth_of_a_step_is_alike_and_as_large_as_it_is():
    """A mean is off by up to .15 steps between codes and by nothing on one and half way."""
    rng, step, off = np.random.default_rng(2), 15e-3, []
    up = mp.read_scheme("fibonacci-24").up
    rows = {f"{k}": {"start": 200 * k, "end": 200 * k + 200} for k in range(24)}
    for _ in range(20):
        truth = up + rng.uniform(-0.01, 0.01, 3)
        values = np.repeat(truth, 200, axis=0) + step / 5.0 * rng.standard_normal((4800, 3))
        columns = dict(zip(("ax", "ay", "az"), (step * np.round(values / step)).T, strict=True))
        found = mp.average({"time": np.arange(4800) / 100.0} | columns, sections=rows).readings
        assert (found.u.max(axis=0) < 1.2 * found.u.min(axis=0)).all()
        off.append((found.values - truth) / found.u)
    # 1440 means, whose u is known to a fifth from 24 rests
    assert 0.85 < np.sqrt(np.mean(np.square(off))) < 1.15


def test_saturation_is_suspected_at_either_end():
    """Ten samples at an extreme of the log, in an output that is noisy and in one that is not."""
    ends = np.array([-1.0, -1.0, -1.0]), np.array([1.0, 1.0, 1.0])
    rest = SimpleNamespace(
        n=100,
        sd=np.array([0.1, 0.1, 1e-9]),
        low=np.array([-1.0, 0.2, -1.0]),
        high=np.array([0.5, 1.0, 1.0]),
        at_low=np.array([30, 1, 30]),
        at_high=np.array([1, 30, 30]),
    )
    survey = SimpleNamespace(lowest=ends[0], highest=ends[1], resolution=np.full(3, 0.01))
    assert sorted(suspects(rest, survey)) == [(0, False), (1, True)]
    rest.low[0], rest.high[1] = -0.99, 0.99  # not the ends of the log
    assert suspects(rest, survey) == []
    rest.low[0], rest.at_low[0] = -1.0, 1
    assert suspects(rest, survey) == []


def test_a_file_given_twice_counts_once_packed_or_not(tmp_path):
    """Rests, records and switch-ons of a copy are no second ones."""
    rng = np.random.default_rng(1)
    faces = np.vstack([np.eye(3), -np.eye(3)])
    y = np.repeat(faces, 800, axis=0) + 1e-3 * rng.standard_normal((4800, 3))
    lines = [f"{i / 100.0:.2f},{a:.6f},{b:.6f},{c:.6f}" for i, (a, b, c) in enumerate(y.tolist())]
    text = "\n".join(["time,ax,ay,az", *lines])
    one, two = tmp_path / "one.csv", tmp_path / "two.csv.gz"
    one.write_text(text)
    two.write_bytes(gzip.compress(text.encode()))
    for ask in (
        mp.average,
        mp.stability,
        lambda *files: mp.regress(list(files), response="ax", variables="time"),
    ):
        found, alone = ask(str(one), str(two)), ask(str(one))
        said = [each for each in found.findings if each.code == "repeated-file"]
        text = f"identical files were counted once; omitted: {two} (as {one})"
        assert [each.text[:150] for each in said] == [text[:150]]  # of 160, and folders are long
        assert len(found.findings) == len(alone.findings) + 1


@pytest.mark.parametrize("how", ["columns", "outputs"])
def test_an_array_has_the_names_that_it_is_given(how):
    names = ["ax", "ay", "az"]
    log = open_log(np.arange(12.0).reshape(4, 3), **{how: names})
    assert list(log.columns) == names


def test_bias_and_scale_by_what_readings_and_targets_cover():
    """0 to 4, 10 to 30 for −1 to 1; where targets do not move, the mean scale of the others."""
    means = np.array([[0.0, 30.0, 5.0], [4.0, 10.0, 5.0]])
    bias, scale = _from_ranges(means, np.array([[-1.0, 1.0, 0.5], [1.0, -1.0, 0.5]]))
    np.testing.assert_allclose(scale, [2.0, 10.0, 6.0])
    np.testing.assert_allclose(bias, [2.0, 20.0, 5.0 - 6.0 * 0.5])
