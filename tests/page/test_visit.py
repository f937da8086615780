"""What the page answers, asked without a browser."""

import gzip
import json
import re
import warnings
import zipfile

import numpy as np
import pytest
from consumers import read_back
from numpy.testing import assert_allclose

import multipos as mp
from multipos.page.visit import Visit

README = """position,direction,ax,ay,az
1,E-U-S,0.0071,1.0029,-0.0016
2,E-N-U,-0.0094,-0.0058,1.0008
3,D-E-S,-0.9965,0.0064,0.0015
4,W-D-S,-0.0076,-1.0030,0.0032
5,U-W-S,0.9965,0.0073,0.0027
6,S-W-D,0.0067,-0.0060,-1.0008
"""


@pytest.fixture
def visit(tmp_path, monkeypatch):
    """Return a function that asks a visit in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    visit = Visit()

    def ask(do, **asked):
        return json.loads(visit.answer(json.dumps({"do": do} | asked)))

    return ask


def calibrate(visit, *files, kind="auto", unit=""):
    return visit("calibrate", files=files, kind=kind, unit=unit)


def rows_of(values, header="ax,ay,az", separator=","):
    lines = [separator.join(f"{value:.17g}" for value in row) for row in values]
    return "\n".join([header, *lines] if header else lines) + "\n"


def test_a_table_with_orientations_gives_what_fit_gives(visit, tmp_path):
    (tmp_path / "r.csv").write_text(README)
    answer = calibrate(visit, "r.csv")
    expected = mp.fit("r.csv", unit="g")
    assert answer["kind"] == "known"
    assert [p["name"] for p in answer["parameters"]] == list(expected.names)
    assert [p["value"] for p in answer["parameters"]] == expected.parameters.tolist()
    assert [p["U"] for p in answer["parameters"]] == expected.U.tolist()
    assert {p["unit"] for p in answer["parameters"]} == {"g", "1"}
    directions = [p["direction"] for p in answer["positions"]]
    assert_allclose(directions, expected.reference, atol=1e-15)  # as they were found
    # e.g. row 2: the reading of E-N-U less its reference, all through the inverse of the model
    force = expected.compensate(expected.readings.values)
    off = np.linalg.norm(force - expected.reference, axis=1)
    assert_allclose([p["residual"] for p in answer["positions"]], off, rtol=1e-12)


@pytest.mark.parametrize(
    ("scale", "offset", "unit"),
    [(1.0, 0.02, "g"), (9.80665, -0.1, "m/s^2"), (1024.0, 512.0, "count"), (999.7, 3.3, "mg")],
)
def test_six_faces_in_any_order_without_a_word_on_them(visit, tmp_path, scale, offset, unit):
    order = np.random.default_rng(4).permutation(6)
    up = mp.read_scheme("faces-6").up[order]
    values = offset + scale * up
    values = np.round(values) if unit == "count" else values
    (tmp_path / "six.txt").write_text(rows_of(values, header="", separator="  "))
    answer = calibrate(visit, "six.txt")
    assert (answer["kind"], answer["unit"]) == ("six", unit)
    assert_allclose([p["direction"] for p in answer["positions"]], up, atol=1e-12)
    found = {p["name"]: p["value"] for p in answer["parameters"]}
    assert_allclose(found["bias_ax"], np.round(offset) if unit == "count" else offset, rtol=1e-12)


def test_other_rows_are_hand_held(visit, tmp_path):
    rng = np.random.default_rng(1)
    up = rng.normal(size=(24, 3))
    up /= np.linalg.norm(up, axis=1)[:, None]
    truth = np.array([0.01, -0.02, 0.03])
    values = up * [1.01, 0.99, 1.0] + truth + rng.normal(scale=1e-4, size=up.shape)
    (tmp_path / "hand.tsv").write_text(rows_of(values, "ax\tay\taz", "\t"))
    answer = calibrate(visit, "hand.tsv")
    assert answer["kind"] == "free"
    found = {p["name"]: p for p in answer["parameters"]}
    for name, true in zip(("bias_ax", "bias_ay", "bias_az"), truth, strict=True):
        assert abs(found[name]["value"] - true) < 2.0 * found[name]["U"]
    assert len(answer["next"]) == 3


def test_what_nobody_should_use_says_so_first(visit, tmp_path):
    """Readings of which one has a sign wrong: no sensor gives them at these positions."""
    bad = README.replace("0.9965,0.0073", "-0.9965,0.0073")
    (tmp_path / "bad.csv").write_text(bad)
    answer = calibrate(visit, "bad.csv", kind="known")
    assert answer["findings"][0]["level"] == "error"
    assert answer["sentence"].startswith("Not fit for use: ax, ay, az calibrated from 6 ")
    assert "is not fit for use" in visit("download", form="c")["error"]
    made = visit("download", form="c", accept=True)["path"]
    assert "NOT" in (tmp_path / made).read_text().upper()


def test_outputs_may_be_named(visit):
    log = mp.simulate_log(mp.demo().calibration, "all-26", rate=50, rest=4, sample_sd=1e-3, seed=1)
    columns = {"p": log["time"], "q": log["ax"], "r": log["ay"], "s": log["az"]}
    mp.write_table("log.csv", columns)
    assert "bias_q" in {p["name"] for p in calibrate(visit, "log.csv")["parameters"]}  # they show g
    asked = {"files": ["log.csv"], "kind": "auto", "unit": "", "outputs": "q,r,s"}
    assert [p["name"] for p in visit("calibrate", **asked)["parameters"]][:2] == [
        "bias_q",
        "scale_q",
    ]


def test_many_rows_are_a_log_and_several_files_too(visit):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        sensor = mp.demo().calibration
    log = mp.simulate_log(sensor, "all-26", rate=50, rest=4, sample_sd=1e-3, seed=1)
    mp.write_table("log.csv", log)
    answer = calibrate(visit, "log.csv")
    assert (answer["kind"], answer["unit"], len(answer["positions"])) == ("log", "g", 26)
    expected = mp.calibrate("log.csv")
    assert [p["value"] for p in answer["parameters"]] == expected.parameters.tolist()
    applied = visit("apply", files=["log.csv"], calibration="", tilt=True)
    rows = mp.read_table(applied["path"])
    own = mp.apply(expected, "log.csv", tilt=True)
    assert_allclose(rows.numbers("f_x"), own.f_x, atol=1e-7)
    assert_allclose(rows.numbers("tilt_z_deg"), own.tilt_z_deg, atol=1e-4)


def test_downloads_are_what_the_commands_write(visit, tmp_path):
    (tmp_path / "r.csv").write_text(README)
    calibrate(visit, "r.csv")
    expected = mp.fit("r.csv", unit="g")
    saved = mp.load(visit("download", form="json")["path"])
    assert saved.parameters.tolist() == expected.parameters.tolist()
    assert read_back(visit("download", form="c")["path"], saved).difference < 1e-12
    again = mp.fit(visit("download", form="readings")["path"], unit="g")
    assert_allclose(again.parameters, expected.parameters, rtol=1e-12, atol=1e-12)
    report = (tmp_path / visit("download", form="md")["path"]).read_text("utf-8")
    assert report.startswith("# Calibration report")
    refused = visit("targets")["refused"]
    assert "px4 cannot express cross_ax_y" in refused["px4"]
    assert visit("download", form="px4")["error"] == refused["px4"]
    made = visit("download", form="px4", accept=True)
    assert made["name"] == "r_px4.params"
    assert read_back(made["path"], saved).target == "px4"


def test_what_is_at_fault_is_said_in_the_program_s_words(visit, tmp_path):
    (tmp_path / "bad.csv").write_text("ax,ay,az\n1,2,x\n")
    with pytest.raises(mp.MultiposError) as caught:
        mp.read_readings("bad.csv")
    assert calibrate(visit, "bad.csv") == {"error": str(caught.value)}
    (tmp_path / "image.png").write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" * 9)
    with pytest.raises(mp.MultiposError) as caught:
        mp.calibrate("image.png")
    assert calibrate(visit, "image.png") == {"error": str(caught.value)}
    (tmp_path / "few.csv").write_text(rows_of(np.eye(3)))
    assert "3 equations for 9 parameters" in calibrate(visit, "few.csv", kind="free")["error"]
    assert "not six faces" in calibrate(visit, "few.csv", kind="six")["error"]
    assert "no calibration yet" in visit("download", form="json")["error"]


def test_what_the_runtime_lacks_is_named(visit, tmp_path, monkeypatch):
    def fit(*given, **options):
        raise ModuleNotFoundError("No module named 'scipy'", name="scipy")

    (tmp_path / "r.csv").write_text(README)
    monkeypatch.setattr("multipos.page.visit.fit", fit)
    said = calibrate(visit, "r.csv")["error"]
    assert said == "This takes scipy, which the page lacks; use multipos on your machine."


def test_what_would_be_too_large_unpacked_is_refused(visit, tmp_path):
    with gzip.open(tmp_path / "log.csv.gz", "wb", compresslevel=1) as stream:
        for _ in range(301):
            stream.write(bytes(1_000_000))
    with zipfile.ZipFile(tmp_path / "phone.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(tmp_path / "log.csv.gz", "a.csv")  # a small one passes this gate
    said = calibrate(visit, "log.csv.gz")["error"]
    assert said.startswith("log.csv.gz has 301 MB unpacked, and this page takes 300 MB")
    assert "unpacked" not in calibrate(visit, "phone.zip")["error"]


def test_a_plan_is_a_scheme_that_can_be_read(visit):
    plan = visit("plan", model="linear", positions=12, hand_held=True)
    scheme = mp.read_scheme(plan["path"])
    assert len(scheme) == len(plan["positions"]) == 12
    assert_allclose(scheme.up, [p["direction"] for p in plan["positions"]], atol=1e-12)
    # nine parameters of a hand-held triad can be estimated from them
    (found,) = mp.schemes(scheme, unknown_orientation=True).schemes
    assert found.identifiable
    assert (found.rank, found.parameters) == (9, 9)
    assert f"{100 * found.d_efficiency:.0f} %" in plan["sentence"]


def test_a_magnetometer_is_shown_in_units_and_words_of_its_field(visit, tmp_path):
    """Rows near the axes are directions of a field all the same, and no word is of gravity."""
    rng = np.random.default_rng(4)
    up = mp.read_scheme("all-26").up
    rows = [3.0, -8.0, 12.0] + 48.6 * up + 0.1 * rng.normal(size=up.shape)
    (tmp_path / "m.csv").write_text(rows_of(rows, "mx,my,mz"))
    answer = calibrate(visit, "m.csv")
    assert (answer["kind"], answer["unit"]) == ("free", "uT")  # 48.6 is Earth's in µT alone
    assert {p["unit"] for p in answer["parameters"]} == {"uT"}
    for name, truth in zip(("bias_mx", "bias_my", "bias_mz"), (3.0, -8.0, 12.0), strict=True):
        (found,) = [p for p in answer["parameters"] if p["name"] == name]
        assert abs(found["value"] - truth) < 2.0 * found["U"]
    assert all(each["residual_text"].endswith(" %") for each in answer["positions"])
    shown = json.dumps(answer, ensure_ascii=False)
    foreign = r"\b(force|gravity|accel\w*|up in)\b|\d ?[mµ]?g\b|[Uu]p,"
    assert not re.findall(foreign, shown)
    assert answer["positions_title"] == "Positions, field in case axes"
    words = [each["words"] for each in answer["next"]]
    assert all("field" in each for each in words)
