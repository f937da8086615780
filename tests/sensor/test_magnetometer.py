"""A magnetometer: the same mathematics in a magnetic field, and what its consumers make of it."""

import itertools
import json
import re
import subprocess
import sys
import warnings

import numpy as np
import pytest
from consumers import read_back
from numpy.testing import assert_allclose

import multipos as mp
from multipos.cli import main
from multipos.errors import MultiposError, UsageError

SIZE = 48.6  # [µT]
SOFT = np.array([[1.02, 0.01, -0.02], [0.03, 0.97, 0.01], [-0.01, 0.02, 1.05]])
HARD = np.array([3.0, -8.0, 12.0])  # [µT]
NAMES = ("mx", "my", "mz")


def directions(n=60, seed=1):
    u = np.random.default_rng(seed).normal(size=(n, 3))
    return u / np.linalg.norm(u, axis=1)[:, None]


def readings(n=60, seed=1, sd=0.15, names=NAMES, soft=SOFT):
    """Return readings [µT] by y = o + B K b, and the directions."""
    u = directions(n, seed)
    noise = np.random.default_rng(seed + 1000).normal(size=u.shape) * sd
    return dict(zip(names, (HARD + SIZE * u @ soft.T + noise).T, strict=True)), u


def listed(u):
    return dict(zip(("b_x", "b_y", "b_z"), u.T, strict=True))


@pytest.mark.parametrize("oriented", [False, True])
def test_names_change_no_number(oriented):
    """The same rows as accelerations in counts and as a field: the same to the last bit."""
    rows, u = readings()
    up = dict(zip(("up_x", "up_y", "up_z"), u.T, strict=True)) if oriented else {}
    force = dict(zip(("ax", "ay", "az"), rows.values(), strict=True))
    a = mp.fit({**force, **up}, unit="count", unknown_orientation=not oriented)
    m = mp.fit({**rows, **up}, unit="count")
    assert m.field.kind == "magnetic"
    assert a.field.kind == "gravity"
    for name in ("parameters", "covariance", "residuals", "reference"):
        assert np.array_equal(getattr(a, name), getattr(m, name))


def test_known_size_gives_a_matrix_without_unit_and_its_share_of_u():
    rows, u = readings(sd=0.0)
    cal = mp.fit({**rows, **listed(u)}, unit="uT", field_size="48.6uT", field_size_u="0.1uT")
    assert_allclose(cal["bias_mx"].value, HARD[0], atol=1e-9)
    assert_allclose([cal["mx", t].value for t in "xyz"], SOFT[0], atol=1e-12)
    assert cal["scale_mx"].unit == "1"
    assert cal["bias_mx"].unit == "uT"
    # one for one: u of a scale factor is that of the size
    assert_allclose(cal["scale_mx"].u, SOFT[0, 0] * 0.1 / SIZE, rtol=1e-6)
    assert_allclose(cal.compensate(np.array([*rows.values()]).T), SIZE * u, atol=1e-9)


@pytest.mark.parametrize(("unit", "factor"), [("nT", 1e3), ("G", 1e-2), ("mG", 10.0), ("T", 1e-6)])
def test_units_of_a_field(unit, factor):
    """Numbers scale with the unit, and every unit is one of a field by itself."""
    rows, _ = readings()
    ours = mp.fit(rows, unit="uT", field_size=SIZE)
    other = {name: factor * column for name, column in rows.items()}
    cal = mp.fit(dict(zip("xyz", other.values(), strict=True)), unit=unit, field_size=SIZE * factor)
    assert cal.field.kind == "magnetic"
    assert cal.field.unit == unit
    assert_allclose(cal["bias_x"].value, factor * ours["bias_mx"].value, rtol=1e-8)
    assert_allclose(cal["scale_y"].U, ours["scale_my"].U, rtol=1e-6)
    assert [f.code for f in cal.findings] == [f.code for f in ours.findings]


@pytest.mark.parametrize("unit", ["G", "mG", "uT"])
def test_gauss_is_no_g(unit):
    rows, _ = readings(names=("ax", "ay", "az"))
    with pytest.raises(UsageError, match="of a magnetic field"):
        mp.fit(rows, unit=unit, unknown_orientation=True)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"field": "electric"}, "--field takes gravity or magnetic"),
        ({"gravity": 9.81}, "--gravity and --latitude are of accelerometers"),
        ({"convention": "gravity"}, "are of gravity"),
        ({"field_size": "48.6furlong"}, "such as 48.6uT"),
        ({"field_size_u": 1.0}, "--field-size-u needs --field-size"),
        ({"field_size": -3.0}, "above 0"),
    ],
)
def test_options_that_contradict_a_magnetic_field(options, said):
    rows, _ = readings()
    with pytest.raises(UsageError, match=said):
        mp.fit(rows, unit="uT", **options)


def test_a_position_of_up_is_no_direction_of_the_field():
    rows, _ = readings(6)
    with pytest.raises(MultiposError, match="not where a magnetic field points"):
        mp.fit({**rows, "roll_deg": np.zeros(6), "pitch_deg": np.zeros(6)}, unit="uT")


def test_the_file_knows_the_field(tmp_path):
    rows, _ = readings()
    cal = mp.fit(rows, unit="uT", field_size="0.486G", field_size_u="1mG")
    cal.save(tmp_path / "cal.json")
    content = json.loads((tmp_path / "cal.json").read_text())
    assert content["gravity"] is None
    assert content["field"] == {"kind": "magnetic", "size": 0.486, "u": 0.001, "unit": "G"}
    again = mp.load(tmp_path / "cal.json")
    assert again.field == cal.field
    assert again.model.units == cal.model.units
    assert "field" not in mp.demo().calibration.to_dict()


def symmetric_root(soft):
    """Return S of K⁻¹ = V S by the eigenvalues of K K', apart from the package's SVD."""
    size, vectors = np.linalg.eigh(np.linalg.inv(soft @ soft.T))
    return vectors * np.sqrt(size) @ vectors.T


@pytest.mark.parametrize(
    ("target", "unit", "form"),
    [("px4", 0.01, "CAL_MAG0_{0}{1}"), ("ardupilot", 10.0, "COMPASS_{1}_{0}")],
)
def test_autopilots_correct_by_their_own_equation(target, unit, form, tmp_path):
    """PX4: S (raw − OFF) in gauss; ArduPilot: S (raw + OFS) in milligauss; ODIAG xy, xz, yz."""
    # eq. (2) of exports.target_autopilots
    rows, _u = readings(sd=0.0)
    cal = mp.fit(rows, unit="uT", field_size=SIZE)
    exported = mp.export(cal, to=target, device_id=7)
    assert not exported.findings
    kinds = ("OFF", "SCALE", "ODIAG") if target == "px4" else ("OFS", "DIA", "ODI")
    found = {}
    for line in exported.text.splitlines():
        cells = line.replace(",", "\t").split("\t")
        found.update({n: float(v) for n, v in itertools.pairwise(cells) if n.isupper() or "_" in n})
    o, d, b = (np.array([found[form.format(a, k)] for a in "XYZ"]) for k in kinds)
    S = np.array([[d[0], b[0], b[1]], [b[0], d[1], b[2]], [b[1], b[2], d[2]]])
    raw = unit * np.array([*rows.values()]).T
    field = (raw - o if target == "px4" else raw + o) @ S.T
    assert_allclose(np.linalg.norm(field, axis=1), unit * SIZE, rtol=1e-6)
    assert_allclose(S, symmetric_root(SOFT), atol=1e-6)
    assert_allclose(o, unit * HARD * (1 if target == "px4" else -1), atol=1e-5)
    exported.save(tmp_path / "file")
    verified = read_back(tmp_path / "file", cal)
    assert verified.target == target
    assert exported.difference == pytest.approx(0.0, abs=1e-3)  # [µT]


@pytest.mark.parametrize(("single", "tolerance"), [(False, 5e-8), (True, 2.5e-5)])
def test_c_is_held_to_digits_of_the_field(single, tolerance):
    """1e-9 of some 50 µT, and 5e-7 of it in single precision."""
    cal = mp.fit(readings(sd=0.0)[0], unit="uT", field_size=SIZE)
    (said,) = re.findall(r"\(off < ([-.e\d]+)", mp.export(cal, "c", float=single).test)
    assert float(said) == pytest.approx(tolerance)


@pytest.mark.parametrize(("factor", "more", "kind"), [(1.0, 400.0, "OFS"), (6.0, 0.0, "DIA")])
def test_ardupilot_takes_offsets_to_1800_milligauss_and_scales_from_a_fifth(factor, more, kind):
    rows, _ = readings(sd=0.0)
    rows = {name: factor * (column - np.mean(column)) + more for name, column in rows.items()}
    cal = mp.fit(rows, unit="uT", field_size=SIZE)
    (found,) = mp.export(cal, to="ardupilot", device_id=7).findings
    names = ", ".join(f"COMPASS_{kind}_{axis}" for axis in "XYZ")
    assert found.text == f"{names} exceed what ArduPilot accepts"


def test_ros_takes_the_offset_in_tesla(tmp_path):
    rows, _ = readings(sd=0.0)
    exported = mp.export(mp.fit(rows, unit="uT"), to="ros")
    bias = [float(s.split(":")[1]) for s in exported.text.splitlines() if "mag_bias_" in s][-3:]
    assert_allclose(bias, 1e-6 * HARD, atol=1e-12)
    assert [f.code for f in exported.findings] == ["lossy"]


def test_a_turn_of_the_triad_is_refused():
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    rows, u = readings(soft=SOFT @ turn)
    cal = mp.fit({**rows, **listed(u)}, unit="uT", field_size=SIZE)
    with pytest.raises(MultiposError, match="turned by 9"):
        mp.export(cal, to="px4")
    assert "CAL_MAG0_XOFF" in mp.export(cal, to="px4", allow_lossy=True).text


def test_unknown_size_keeps_the_mean_scale():
    """det S = 1, so that corrected and raw fields have one mean size."""
    rows, _ = readings()
    text = mp.export(mp.fit(rows, unit="uT"), to="px4").text
    found = dict(line.split("\t")[2:4] for line in text.splitlines() if line.startswith("1\t"))
    d = [float(found[f"CAL_MAG0_{a}SCALE"]) for a in "XYZ"]
    b = [float(found[f"CAL_MAG0_{a}ODIAG"]) for a in "XYZ"]
    S = np.array([[d[0], b[0], b[1]], [b[0], d[1], b[2]], [b[1], b[2], d[2]]])
    assert_allclose(np.linalg.det(S), 1.0, rtol=1e-6)


def wave(n, seed, rho=0.0, sd=0.3):
    """Return a log of a hand that turns a sensor about, noise AR(1) with the coefficient rho."""
    rng = np.random.default_rng(seed)
    knots = rng.normal(size=(max(8, n // 35), 4))
    for i in range(1, len(knots)):
        knots[i] *= np.sign(knots[i] @ knots[i - 1])
    at = np.linspace(0.0, 1.0, n)
    places = np.linspace(0.0, 1.0, len(knots))
    w, x, y, z = (np.interp(at, places, column) for column in knots.T)
    size = w * w + x * x + y * y + z * z
    # the field along a slanted axis, turned by the quaternion (w, x, y, z)
    f = np.array([0.4, 0.1, -0.9]) / np.sqrt(0.98)
    q, v = np.column_stack([x, y, z]), np.tile(f, (n, 1))
    u = v + 2.0 * np.cross(q, np.cross(q, v) + w[:, None] * v) / size[:, None]
    noise = rng.normal(size=(n, 3))
    for row in range(1, n if rho else 0):
        noise[row] = rho * noise[row - 1] + np.sqrt(1.0 - rho**2) * noise[row]
    values = HARD + SIZE * u @ SOFT.T + sd * noise
    return {"time": 0.02 * np.arange(n), **dict(zip(NAMES, values.T, strict=True))}


def test_a_waved_log_to_px4(tmp_path, capsys):
    log = wave(6000, 5)
    table = np.column_stack([*log.values()])
    path = tmp_path / "wave.csv"
    np.savetxt(path, table, delimiter=",", header=",".join(log), comments="", fmt="%.5f")
    asked = ["calibrate", str(path), "--unit", "uT", "--to", "px4", "--device-id", "396825"]
    assert main([*asked, "-o", str(tmp_path / "cal.json")]) == 0
    cal = mp.load(tmp_path / "cal.json")
    assert cal.field.kind == "magnetic"
    assert cal.estimator == "unknown-orientation"
    assert len(cal.readings) == 6000
    for name, truth in zip(("bias_mx", "bias_my", "bias_mz"), HARD, strict=True):
        assert abs(cal[name].value - truth) < 2.0 * cal[name].U
    assert read_back(tmp_path / "cal_px4.params", cal).difference < 1e-6


def test_nine_rests_that_hold_most_of_a_log_are_averaged():
    u = directions(12, 3)
    rng = np.random.default_rng(3)
    rows = np.repeat(HARD + SIZE * u @ SOFT.T, 200, axis=0) + 0.1 * rng.normal(size=(2400, 3))
    log = {"time": 0.02 * np.arange(2400), **dict(zip(NAMES, rows.T, strict=True))}
    cal = mp.calibrate(log, unit="uT")
    assert len(cal.readings) == 12
    assert cal.readings.samples is not None


def accelerometer():
    """Return a calibration of readings that are specific force already."""
    up = mp.read_scheme("all-26").up
    rows = dict(zip(("ax", "ay", "az"), up.T, strict=True))
    return mp.fit({**rows, **dict(zip(("up_x", "up_y", "up_z"), up.T, strict=True))}, unit="g")


@pytest.mark.parametrize("seed", range(3))
def test_heading_is_that_of_a_compass(seed):
    """Attitudes drawn at random; the truth is the azimuth of case axis x."""
    rows, u = readings(sd=0.0)
    cal = mp.fit({**rows, **listed(u)}, unit="uT", field_size=SIZE)
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.normal(size=(50, 3, 3)))[0]
    Q *= np.linalg.det(Q)[:, None, None]  # proper: level to case
    east, north, up = (Q[:, :, i] for i in range(3))
    dip = np.radians(64.0)
    field = SIZE * (np.cos(dip) * north - np.sin(dip) * up)
    raw = HARD + field @ SOFT.T
    table = dict(zip((*NAMES, "ax", "ay", "az"), (*raw.T, *up.T), strict=True))
    found = mp.apply(cal, table, beside=accelerometer())
    assert_allclose(np.column_stack([found.b_x, found.b_y, found.b_z]), field, atol=1e-6)
    truth = np.degrees(np.arctan2(east[:, 0], north[:, 0])) % 360.0
    assert_allclose((found.heading_deg - truth + 180.0) % 360.0, 180.0, atol=1e-5)
    assert "f_x" not in found
    assert not any("turn" in f.code for f in found.findings)


def test_heading_of_unknown_orientations_says_what_it_lacks(tmp_path, capsys):
    rows, u = readings()
    mp.fit(rows, unit="uT").save(tmp_path / "mag.json")
    accelerometer().save(tmp_path / "acc.json")
    table = np.column_stack([*rows.values(), u])
    path = tmp_path / "log.csv"
    np.savetxt(path, table, delimiter=",", header="mx,my,mz,ax,ay,az", comments="")
    asked = ["apply", str(tmp_path / "mag.json"), str(path), "-o", str(tmp_path / "out.csv")]
    assert main([*asked, "--with", str(tmp_path / "acc.json"), "--uncertainty"]) == 0
    assert "is not known" in capsys.readouterr().err
    head = (tmp_path / "out.csv").read_text().splitlines()[0]
    assert head.endswith("b_x,b_y,b_z,u_b_x,u_b_y,u_b_z,U_b_x,U_b_y,U_b_z,heading_deg,outside")
    assert main([*asked, "--tilt"]) == 2
    assert main([*asked, "--with", asked[1]]) == 2  # two magnetometers
    other = str(tmp_path / "acc.json")
    for beside in (other, asked[1]):
        assert main(["apply", other, str(path), "--with", beside]) == 2


FOREIGN = re.compile(
    r"\b([Ff]orces?|(?:[Ss]pecific |out of )force|[Aa]ccel\w*|[Gg]ravity)\b|[\d)] ?[mµ]?g\b|\[m?g\]"
)


def of_a_magnetometer(text):
    """Return what is said of forces in a text, but for the option --force and keys of programs."""
    return [m[0] for m in FOREIGN.finditer(text.replace("--force", ""))]


@pytest.mark.parametrize("case", ["unknown", "known", "six"])
def test_no_word_of_forces(case, tmp_path, capsys):
    """Summaries, reports, C and parameters of a magnetometer, and its findings."""
    rows, u = readings(6 if case == "six" else 40, sd=1.0)
    table = rows if case == "unknown" else {**rows, **listed(u)}
    size = [] if case == "unknown" else ["--field-size", "48.6uT", "--field-size-u", ".1uT"]
    path, cal = tmp_path / "rows.csv", tmp_path / "cal.json"
    columns = np.column_stack([*table.values()])
    np.savetxt(path, columns, delimiter=",", header=",".join(table), comments="")
    assert main(["fit", str(path), "--unit", "uT", *size, "-v", "-o", str(cal)]) in (0, 3)
    texts = [*capsys.readouterr()]
    assert main(["fit", str(path), "--unit", "uT", *size, "-v"]) in (0, 3)
    texts += [*capsys.readouterr()]
    for target in ("c", "px4", "ardupilot", "ros"):
        out = tmp_path / f"cal.{target}"
        made = ["export", str(cal), "--to", target, "--allow-lossy", "--force", "-o", str(out)]
        assert main(made) == 0
        texts += [out.read_text(), *capsys.readouterr()]
    for ending in ("txt", "md", "html"):
        out = tmp_path / f"report.{ending}"
        assert main(["report", str(cal), "-o", str(out)]) == 0
        texts.append(
            re.sub(r"<style.*?</style>", "", out.read_text(encoding="utf-8"), flags=re.DOTALL)
        )
    texts += [entry.label for entry in mp.load(cal).entries]
    for text in texts:
        assert not of_a_magnetometer(text), (of_a_magnetometer(text), text)


def healthy(n, seed, sd=0.3):
    log = wave(n, seed, sd=sd)
    return np.column_stack([log[name] for name in NAMES])


def found_in(values, unit="uT", **options):
    cal = mp.calibrate(dict(zip(NAMES, values.T, strict=True)), unit=unit, **options)
    return {f.code: f for f in cal.findings if f.level != "note"}


def test_a_disturbance_is_found_with_its_rows():
    """Iron near one direction adds 5 % there."""
    values = healthy(3000, 21)
    away = values - HARD
    along = away / np.linalg.norm(away, axis=1)[:, None]
    near = along @ np.array([0.0, 0.6, 0.8]) > np.cos(np.radians(25.0))
    values[near] += 0.05 * away[near]
    every = found_in(values)
    assert set(every) == {"disturbance"}
    found = every["disturbance"]
    assert "larger than elsewhere" in found.text
    inside = [near[int(label) - 1] for label in found.rows]
    assert len(inside) >= 5
    assert np.mean(inside) > 0.8


def test_moving_iron_is_found_with_the_row():
    values = healthy(3000, 22)
    values[1500:] += [1.5, 0.0, -1.5]  # [µT]
    every = found_in(values)
    assert set(every) == {"moving-iron"}
    found = every["moving-iron"]
    assert abs(int(found.rows[0]) - 1500) <= 300
    assert 0.03 < float(re.search(r"by ([\d.]+) % of the field", found.text)[1]) / 100 < 0.06


def test_iron_beside_the_sensor_for_a_while_is_one_cause_with_its_rows():
    """8 µT for a seventh of a log, which makes everything else look wrong."""
    values = healthy(1400, 27)
    values[600:800] += [8.0, 0.0, 0.0]
    every = found_in(values, field_size="48.6uT")
    assert set(every) == {"moving-iron"}
    found = every["moving-iron"]
    rows = [int(label) for label in found.rows]
    assert 580 <= rows[0] <= 640
    assert 760 <= rows[-1] <= 820
    assert f"from row {rows[0]} to row {rows[-1]}" in found.text
    assert 7.0 < float(re.search(r"by ([\d.]+) µT", found.text)[1]) < 9.0


@pytest.mark.parametrize("exclude", ["auto", "none"])
def test_a_spike_is_no_iron_that_moved(exclude):
    values = healthy(500, 30)
    values[253, 0] += 15.0
    assert "moving-iron" not in found_in(values, exclude=exclude)


def test_size_gap_and_saturation():
    assert "field-size" in found_in(3.0 * healthy(1000, 23))
    values = healthy(3000, 24)
    half = found_in(values[values[:, 2] > HARD[2] - 5.0])
    gap = half["sphere-gap"]
    assert re.search(r"\(.*, -1\.0\)|\(0\.0, 0\.0, -1\.0\)", gap.action)
    cut = values.copy()
    cut[:, 0] = np.minimum(cut[:, 0], 35.0)
    assert found_in(cut)["saturated"].level == "error"
    with pytest.raises(MultiposError, match=r"readings of 'mx', 'my', 'mz' are saturated in rows"):
        mp.calibrate(dict(zip(NAMES, np.clip(values, -15.0, 15.0).T, strict=True)), unit="uT")


def test_a_healthy_wave_has_no_finding_of_its_own():
    """Each of the four is asked at .2 %, so that of 20 logs hardly one shows any."""
    own = {"disturbance", "moving-iron", "field-size", "sphere-gap", "saturated"}
    assert sum(bool(own & found_in(healthy(2000, seed)).keys()) for seed in range(20)) <= 1


def ellipsoid(rows):
    """Return A and b of the ellipsoid (x − b)' A (x − b) = 1 by classical least squares.

    The smallest right singular vector of rows (x², y², z², 2xy, 2xz, 2yz, 2x, 2y, 2z, 1), as
    MATLAB's magcal and Magneto take it.
    """
    middle, scale = rows.mean(axis=0), rows.std()
    x, y, z = ((rows - middle) / scale).T
    D = np.column_stack(
        [x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z, np.ones_like(x)]
    )
    v = np.linalg.svd(D)[2][-1]
    A = np.array([[v[0], v[3], v[4]], [v[3], v[1], v[5]], [v[4], v[5], v[2]]])
    b = -np.linalg.solve(A, v[6:9])
    return A / (b @ A @ b - v[9]) / scale**2, scale * b + middle


def magcal(rows):
    """Return A, b and the expected field of MATLAB's magcal: (x − b) A has that size, det A = 1."""
    M, b = ellipsoid(rows)
    size, vectors = np.linalg.eigh(M)
    root = vectors * np.sqrt(size) @ vectors.T
    factor = np.linalg.det(root) ** (1.0 / 3.0)
    return root / factor, b, 1.0 / factor


def magneto(rows, size):
    """Return A⁻¹ and b of Magneto 1.2: A⁻¹ (h − b) has the size that was entered."""
    M, b = ellipsoid(rows)
    values, vectors = np.linalg.eigh(M)
    return size * vectors * np.sqrt(values) @ vectors.T, b


def corrections(cal):
    """Return the symmetric root S and the hard iron of a calibration in the field's size."""
    K = np.array(
        [[cal[o, t].value if (o, t) in keys_of(cal) else 0.0 for t in "xyz"] for o in NAMES]
    )
    return symmetric_root(K), np.array([cal[o, "1"].value for o in NAMES])


def keys_of(cal):
    return {(output, str(term)) for output, term in cal.model.keys}


def test_matlab_and_magneto_are_met_on_good_data():
    """Within one u of the hard iron, and of the matrix that both make of it."""
    rows, _ = readings(200, sd=0.05)
    cal = mp.fit(rows, unit="uT", field_size=SIZE)
    S, hard = corrections(cal)
    u = np.array([cal[o, "1"].u for o in NAMES])
    table = np.array([*rows.values()]).T
    A, b, expected = magcal(table)
    assert (np.abs(b - hard) < u).all()
    assert_allclose(
        A * SIZE / expected, S, atol=max(cal[o, t].u for o, t in keys_of(cal) if t != "1")
    )
    inverse, b = magneto(table, SIZE)
    assert (np.abs(b - hard) < u).all()
    assert_allclose(np.linalg.norm((table - b) @ inverse.T, axis=1), SIZE, rtol=0.01)


@pytest.mark.parametrize(("n", "sd", "ratio"), [(200, (3, 3, 3), 0.95), (60, (1, 1, 3), 0.97)])
@pytest.mark.usefixtures("without_findings")
def test_noisy_data_do_better_than_the_classical_fit(n, sd, ratio):
    """rms error of the field over fresh directions, against Magneto's equation.

    Noise draws the algebraic ellipsoid inwards, the more the more rows there are, .90 ± .01 here
    and .79 ± .02 of 600 rows; and it cannot weight axes that are noisier, .87 ± .03. Of equal noise
    of 1 % both are as good.
    """
    truth, logs = symmetric_root(SOFT), []
    for seed in range(25):
        noise = np.array(sd) * np.random.default_rng(seed + 50).normal(size=(n, 3))
        table = HARD + SIZE * directions(n, seed) @ SOFT.T + noise
        rows = dict(zip(NAMES, table.T, strict=True))
        cal = mp.fit(rows, unit="uT", field_size=SIZE, reading_sd=np.array(sd, dtype=float))
        fresh = SIZE * directions(500, seed + 9000) @ SOFT.T  # without the hard iron
        errors = [
            np.linalg.norm((fresh + HARD - hard) @ S.T - fresh @ truth.T)
            for S, hard in (corrections(cal), magneto(table, SIZE))
        ]
        logs.append(np.log(errors[0] / errors[1]))
    standard_error = np.std(logs, ddof=1) / np.sqrt(len(logs))
    assert np.mean(logs) + 2.0 * standard_error < 0.0
    assert np.exp(np.mean(logs)) < ratio


@pytest.mark.slow
@pytest.mark.usefixtures("without_findings")
@pytest.mark.parametrize("noise", ["equal", "1:1:3"])
def test_coverage_of_a_thousand_sensors(noise):
    """Own generator: 12 to 200 positions, hard iron to 40 µT, soft iron to 10 %; 94 to 96 %."""
    rng = np.random.default_rng(42)
    hits, refused = [], 0
    for _ in range(1000):
        n = int(np.exp(rng.uniform(np.log(12), np.log(200))))
        u = directions(n, int(rng.integers(1 << 30)))
        soft = np.eye(3) + rng.uniform(-0.1, 0.1, (3, 3))
        hard = rng.uniform(-40.0, 40.0, 3)
        sd = rng.uniform(0.05, 0.3) * np.array([1.0, 1.0, 1.0 if noise == "equal" else 3.0])
        table = hard + SIZE * u @ soft.T + sd * rng.normal(size=(n, 3))
        stated = {} if noise == "equal" else {"reading_sd": sd}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                cal = mp.fit(dict(zip(NAMES, table.T, strict=True)), unit="uT", **stated)
            except mp.RankError:  # twelve directions drawn at random, too near to a cone
                refused += 1
                continue
        lower = np.linalg.qr(SIZE * soft.T)[1].T
        lower *= np.sign(np.diag(lower))
        for (output, term), value, U in zip(cal.model.keys, cal.parameters, cal.U, strict=True):
            row = NAMES.index(output)
            truth = hard[row] if str(term) == "1" else lower[row, "xyz".index(str(term))]
            hits.append(abs(value - truth) <= U)
    assert refused <= 5, refused
    # .964 at 1:1:3 (.98 to 24 positions, .95 from 60 on): stated noise is a lower bound, and what
    # exceeds it by chance widens U. Claims × .7, .5, .3 cover .948, .950, .956: a shorter U would
    # be too short there (`benchmarks/tables.md`, *Stated noise*).
    assert 0.94 <= np.mean(hits) <= (0.96 if noise == "equal" else 0.97), np.mean(hits)


@pytest.mark.slow
@pytest.mark.usefixtures("without_findings")
@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9, 0.98])
def test_coverage_of_waved_logs_whose_noise_is_correlated(rho):
    hits = []
    lower = np.linalg.qr(SIZE * SOFT.T)[1].T
    lower *= np.sign(np.diag(lower))
    for seed in range(120):
        log = wave(6000, 7000 + seed, rho=rho)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            cal = mp.calibrate(log, unit="uT")
        for (output, term), value, U in zip(cal.model.keys, cal.parameters, cal.U, strict=True):
            row = NAMES.index(output)
            truth = HARD[row] if str(term) == "1" else lower[row, "xyz".index(str(term))]
            hits.append(abs(value - truth) <= U)
    assert 0.93 <= np.mean(hits) <= 0.97, np.mean(hits)


def test_a_report_gives_hard_iron_in_the_unit_of_the_readings(tmp_path):
    rows, _ = readings(sd=0.05)
    cal = mp.fit(rows, unit="uT")
    mp.report(cal, tmp_path / "report.md")
    (cells,) = [
        line.split("|")
        for line in (tmp_path / "report.md").read_text().splitlines()
        if line.startswith("| Hard iron of mx")
    ]
    assert cells[4].strip() == "µT"
    assert abs(float(cells[2]) - HARD[0]) < 3.0 * cal["bias_mx"].u


def test_noise_of_a_static_record_is_in_the_unit_of_the_field():
    rows, u = readings()
    cal = mp.fit({**rows, **listed(u)}, unit="uT", field_size=SIZE)
    rng = np.random.default_rng(0)
    still = HARD + SIZE * directions(1)[0] @ SOFT.T + 0.3 * rng.normal(size=(2000, 3))
    record = {"time": 0.02 * np.arange(2000), **dict(zip(NAMES, still.T, strict=True))}
    found = mp.stability(record, calibration=cal)
    assert tuple(found.outputs) == ("b_x", "b_y", "b_z")
    assert found.unit == "uT"
    # white noise of sd s at f Hz is s/√f per √Hz, over the scale of x
    assert_allclose(found.outputs["b_x"].white_noise.value, 0.3 / np.sqrt(50.0), rtol=0.15)


def held(path, up, seed=0):
    """Write a log of rests of five seconds at directions of the field, with turns between them."""
    rng = np.random.default_rng(seed)
    parts = []
    for before, after in zip([up[0], *up[:-1]], up, strict=True):
        turn = before + np.linspace(0.0, 1.0, 100)[:, None] * (after - before) + 1e-3
        parts += [turn / np.linalg.norm(turn, axis=1)[:, None], np.tile(after, (250, 1))]
    rows = HARD + SIZE * np.concatenate(parts) + 0.2 * rng.normal(size=(350 * len(up), 3))
    table = np.column_stack([0.02 * np.arange(len(rows)), rows])
    np.savetxt(path, table, delimiter=",", header="time,mx,my,mz", comments="", fmt="%.4f")
    return path


def test_capture_lists_the_directions_that_are_missing(tmp_path, capsys):
    """Of the 26 even directions only −z is farther than 60° from poses on the upper half."""
    every = mp.read_scheme("all-26").up
    upper = every[every[:, 2] > -0.1]
    log = held(tmp_path / "log.csv", upper)
    assert main(["capture", f"replay:{log}:0", "--headless", "-o", str(tmp_path / "out.csv")]) == 0
    shown = capsys.readouterr()
    lines = [json.loads(line) for line in shown.out.splitlines()]
    assert lines[-1]["missing"] == [[0.0, 0.0, -1.0]]
    assert len(lines[0]["missing"]) > 15
    assert "field" in lines[0]["next"]["words"]
    assert lines[-1]["residual_text"].endswith("%")
    assert not of_a_magnetometer(shown.err)
    for line in lines:
        assert not of_a_magnetometer(json.dumps(line, ensure_ascii=False))


def test_a_pose_in_another_unit_is_refused_in_words_of_the_field(tmp_path):
    every = mp.read_scheme("all-26").up
    log = held(tmp_path / "log.csv", every)
    table = np.loadtxt(log, delimiter=",", skiprows=1)
    table[-250:, 1:] += 8.80665 * SIZE * every[-1]
    np.savetxt(log, table, delimiter=",", header="time,mx,my,mz", comments="", fmt="%.4f")
    said = []
    mp.capture(f"replay:{log}:0", told=said.append)
    assert said[-1]["reason"] == "another unit: it reads the field 9.81 times as large as before"


def test_capture_takes_the_magnetometer_of_a_log_with_both(tmp_path):
    log = held(tmp_path / "log.csv", mp.read_scheme("all-26").up[:12])
    table = np.loadtxt(log, delimiter=",", skiprows=1)
    both = np.column_stack([table, np.full((len(table), 3), [0.0, 0.0, 1.0])])
    np.savetxt(log, both, delimiter=",", header="time,mx,my,mz,ax,ay,az", comments="", fmt="%.4f")
    assert mp.capture(f"replay:{log}:0", field="magnetic").state["outputs"] == [*NAMES]


def test_a_unit_of_tesla_takes_the_magnetometer_of_a_log_with_both():
    log = wave(1000, 28)
    log |= dict.fromkeys(("ax", "ay", "az"), log["mx"] / SIZE)
    assert mp.calibrate(log, unit="uT").outputs == NAMES


def test_a_flipped_bit_in_a_waved_log_is_named():
    log = wave(1000, 29)
    log["my"][499] = 7e264
    with pytest.raises(MultiposError, match=r"row 500, column 'my': 7e\+264 is no number that is"):
        mp.calibrate(log, unit="uT")


def test_a_temperature_that_none_is_leaves_no_other_out(tmp_path):
    log = wave(1000, 29)
    log["temperature"] = np.full(1000, 25.0)
    log["temperature"][[10, 20]] = 1e308, -1e308
    found = mp.calibrate(log, unit="uT")
    kept = found.readings.environment["temperature"]
    assert np.isnan(kept).sum() <= 2
    assert set(kept[np.isfinite(kept)].tolist()) == {25.0}
    found.save(tmp_path / "o.json")
    assert mp.load(tmp_path / "o.json").names == found.names


def test_percentages_are_of_the_field_whatever_its_size(tmp_path, capsys):
    """The same rows with and without the size have the same linearity, of a fit and of a check."""
    rows, u = readings(sd=0.3)
    table = {**rows, **listed(u)}
    relative = mp.fit(table, unit="uT", orientation_sd=0)
    sized = mp.fit(table, unit="uT", field_size=SIZE, orientation_sd=0)
    for output in NAMES:
        for key, value in relative.linearity[output].items():
            assert_allclose(sized.linearity[output][key], value, rtol=1e-9)
    run, _ = readings(sd=0.3, seed=9)
    found = [mp.check(cal, {**run, **listed(u)}) for cal in (relative, sized)]
    for when in ("before", "after"):
        percents = [each.linearity_percent[when] for each in found]
        assert_allclose(percents[0], percents[1], rtol=1e-9)


def test_sizes_known_and_unknown_are_not_compared(tmp_path):
    rows, u = readings()
    one = mp.fit({**rows, **listed(u)}, unit="uT")
    other = mp.fit({**rows, **listed(u)}, unit="uT", field_size=SIZE)
    with pytest.raises(mp.MultiposError, match=r"units of the field differ .* \(uT, not 1\)"):
        mp.compare(one, other)


def test_what_other_commands_print_of_a_magnetometer(tmp_path, capsys):
    """Budget, gains, simulated readings and C in the words and units of the field."""
    rows, _ = readings()
    columns = np.column_stack([*rows.values()])
    path, cal = tmp_path / "rows.csv", tmp_path / "cal.json"
    np.savetxt(path, columns, delimiter=",", header="mx,my,mz", comments="")
    size = ["--unit", "uT", "--field-size", "48.6uT", "--field-size-u", ".1uT"]
    assert main(["fit", str(path), *size, "-o", str(cal)]) == 0
    assert main(["report", str(cal), "-o", str(tmp_path / "report.md")]) == 0
    report = (tmp_path / "report.md").read_text(encoding="utf-8")
    (row,) = [line for line in report.splitlines() if line.startswith("| the field | B ")]
    assert row.split("|")[4:6] == [" 100 ", " nT "]
    assert "Up vector" not in report
    assert "Valid for fields up to 48.6 µT" in report
    more = str(len(columns) + 4)
    assert main(["design", "--include", str(cal), "--positions", more, "-v"]) == 0
    out = capsys.readouterr().out
    assert "4 more lower u by" in out
    assert "field x" in out
    assert "up x" not in out
    run = tmp_path / "run.csv"
    assert main(["simulate", str(cal), "--scheme", "all-26", "-o", str(run)]) == 0
    assert run.read_text().startswith("position,b_x,b_y,b_z,mx,my,mz\n")
    assert main(["check", str(cal), str(run)]) == 0
    assert main(["check", str(cal), str(run), "--tilt"]) == 2
    assert main(["check", str(cal), str(path)]) == 1
    assert not of_a_magnetometer("".join(capsys.readouterr()).replace("accelerometers;", ""))
    assert main(["export", str(cal), "--to", "c", "-o", str(tmp_path / "m.c")]) == 0
    lines = (tmp_path / "m.c").read_text().splitlines()
    hard = next(i for i, line in enumerate(lines) if "hard iron:" in line)
    assert lines[hard - 2].startswith(" * scale_mz")


def test_noise_of_a_record_is_in_the_unit_of_its_header(tmp_path):
    rng = np.random.default_rng(0)
    still = np.column_stack([0.02 * np.arange(2000), 0.3 * rng.normal(size=(2000, 3))])
    path = tmp_path / "still.csv"
    head = "time [s],mx [uT],my [uT],mz [uT]"
    np.savetxt(path, still, delimiter=",", header=head, comments="", fmt="%.5f")
    assert mp.stability(path).unit == "uT"
    other = tmp_path / "other.csv"
    np.savetxt(other, still, delimiter=",", header="time,mx,my,mz", comments="", fmt="%.5f")
    with pytest.raises(mp.MultiposError, match="no stated unit"):
        mp.stability(path, other)


def test_a_waved_log_takes_numpy_alone(tmp_path):
    """SciPy takes longer to import than 6,000 rows take to calibrate."""
    path = tmp_path / "wave.csv"
    log = wave(6000, 5)
    table = np.column_stack([*log.values()])
    np.savetxt(path, table, delimiter=",", header=",".join(log), comments="", fmt="%.5f")
    called = "import sys; from multipos.cli import main; main(sys.argv[1:]); "
    run = [sys.executable, "-c", f"{called}print('scipy' in sys.modules)"]
    run += ["calibrate", str(path), "--unit", "uT"]
    out = subprocess.run(run, capture_output=True, text=True, check=True).stdout
    assert out.endswith("False\n")
