"""No text of a calibration leaves its comment, and no number leaves its precision unsaid."""

import dataclasses
import itertools
import re
import shutil
import subprocess

import numpy as np
import pytest

import multipos as mp
from multipos.cli import main
from multipos.exports.c_body import _held_by_both, exact_inverse
from multipos.exports.c_text import literal
from multipos.exports.target import self_test
from multipos.exports.targets import export

# What ends a line for some reader of such files, or a comment in C.
ENDS = ["\n", "\r", "\x0b", "\x0c", "\x1c", "\x85", "\u2028", "\u2029"]
HOSTILE = [
    *(f"x{end}SM: [0, 0, 0, 0, 0, 0, 0, 0, 0]" for end in ENDS),
    "x\n1\t1\tCAL_ACC0_XOFF\t9\t9",
    "x\nINS_ACCOFFS_X,9",
    "x*/ int evil; /*",
    "x*\\ int evil; /*",
    "x**/ int evil; /*",
    "x*??/",
    "x???/",
    "x\\",
    "\x1b[31m",
]
# The autopilots refuse a unit that they do not know.
FIELDS = [
    *itertools.product(
        ["px4", "ardupilot", "ros-imu-calib"], ["created", "version", "source", "model"]
    ),
    ("ros-imu-calib", "unit"),
]


@pytest.fixture(scope="module")
def cal():
    up = mp.read_scheme("faces-6").up
    return mp.fit(mp.Readings(9.8 * up, up=up, unit="m/s^2"), model="1 + own")


def comments_only(text, mark):
    """The lines that are no comment, for a reader to whom any of ENDS ends a line."""
    lines = re.split("|".join(ENDS), text)
    return [line for line in lines if line and not line.startswith(mark)]


@pytest.mark.parametrize(("target", "field"), FIELDS)
def test_comments_of_parameters_stay_comments(cal, target, field):
    expected = export(cal, target).text
    for hostile in HOSTILE:
        changed = {
            "source": {"readings": dataclasses.replace(cal.readings, source=hostile)},
            "model": {"model": dataclasses.replace(cal.model, text=hostile)},
            "unit": {"model": dataclasses.replace(cal.model, unit=hostile)},
        }.get(field, {field: hostile})
        text = export(dataclasses.replace(cal, **changed), target).text
        assert comments_only(text, "#") == comments_only(expected, "#"), hostile
        assert "\x1b" not in text


@pytest.mark.parametrize("hostile", HOSTILE, ids=repr)
@pytest.mark.parametrize("field", ["created", "version", "model", "unit", "outputs"])
def test_the_comment_of_c_stays_a_comment(cal, field, hostile, tmp_path):
    model = cal.model
    changed = {
        "model": {"model": dataclasses.replace(model, text=hostile)},
        "unit": {"model": dataclasses.replace(model, unit=hostile)},
        "outputs": {"model": dataclasses.replace(model, outputs=(hostile, "ay", "az"))},
    }.get(field, {field: hostile})
    text = export(dataclasses.replace(cal, **changed), "c").text
    head, _, body = text.partition("\n */")
    assert body == export(cal, "c").text.partition("\n */")[2]
    assert (head.count("/*"), head.count("*/")) == (1, 0)
    assert "\\" not in head
    assert "??" not in head
    assert comments_only(head, " *") == ["/*"]
    if shutil.which("cc") is None:
        return
    (tmp_path / "f.c").write_text(text, encoding="utf-8")
    options = ["-std=c99", "-Wall", "-Wextra", "-Wtrigraphs", "-Wcomment", "-Werror"]
    options += ["-fsyntax-only", "f.c"]
    done = subprocess.run(["cc", *options], cwd=tmp_path, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")


# --- numbers beyond a precision


def scaled(factor, unit="m/s^2", model="linear"):
    up = mp.read_scheme("faces-corners-14").up
    y = up + 0.01 + 0.02 * np.roll(up, 1, axis=1)
    y = y + 1e-4 * np.random.default_rng(0).normal(size=up.shape)
    return mp.fit(mp.Readings(factor * y, up=up, unit=unit), model=model)


@pytest.mark.parametrize(
    ("factor", "message"),
    [
        (
            1e-39,
            r"'bias_ax' = 1e-41 vanishes in single precision; leave out --float",
        ),
        (1e39, r"'scale_ax' = 1e\+39 overflows in single precision"),
    ],
)
def test_single_precision_refuses_by_name(factor, message, tmp_path, capsys):
    scaled(factor).save(tmp_path / "cal.json")
    argv = ["export", str(tmp_path / "cal.json"), "--to", "c", "-o", str(tmp_path / "f.c")]
    assert main([*argv, "--float", "--force"]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert re.search(message, err.splitlines()[-1])
    assert [path.name for path in tmp_path.iterdir()] == ["cal.json"]
    assert main([*argv, "--force"]) == 0
    assert "inf" not in re.sub("calibrated.*", "", (tmp_path / "f.c").read_text())


def test_a_coefficient_that_does_not_matter_may_vanish():
    cal = scaled(1.0)
    tiny = np.where(np.arange(12) % 4 == 1, 1e-60, cal.parameters)
    own = list(cal.model.own_scales)
    tiny[own] = cal.parameters[own]
    assert (
        "f;" in export(dataclasses.replace(cal, parameters=tiny), "c", float=True, force=True).text
    )


@pytest.mark.parametrize("model", ["linear", "own-quadratic"])
def test_a_double_that_is_not_finite_is_refused(model):
    cal = scaled(1.0, model=model)
    flat = dataclasses.replace(cal, parameters=cal.parameters * 1e-310)
    with pytest.raises(mp.MultiposError, match=r"'bias_ax' = .* vanishes in double precision"):
        export(flat, "c", force=True)


@pytest.mark.parametrize(("value", "single"), [(1e39, True), (np.inf, False), (np.nan, True)])
def test_no_number_of_c_is_infinite(value, single):
    with pytest.raises(mp.MultiposError, match=f"{'single' if single else 'double'} precision"):
        literal(value, single)


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("px4", r"CAL_ACC0_XSCALE would be .*e\+39, which the consumer cannot hold"),
        ("ardupilot", r"INS_ACCSCAL_X would be .*e\+39"),
    ],
)
def test_parameters_beyond_the_consumers_precision_are_named(target, message):
    with pytest.raises(mp.MultiposError, match=message):
        export(scaled(1e-39), target, allow_lossy=True, force=True)


def test_the_inverse_in_c_is_rounded_once_and_the_same_everywhere():
    """Whole numbers by hand, thirds as the processor divides; kernels of algebra miss them."""
    assert exact_inverse(np.array([[0.0, 1.0], [1.0, 2.0]])).tolist() == [[-2.0, 1.0], [1.0, 0.0]]
    assert exact_inverse(np.array([[3.0]])).tolist() == [[1.0 / 3.0]]
    tall = np.array([[1.0], [1.0], [1.0]])
    assert exact_inverse(tall).tolist() == [[1.0 / 3.0] * 3]
    A = np.random.default_rng(1).normal(size=(4, 3))
    np.testing.assert_allclose(exact_inverse(A), np.linalg.pinv(A), rtol=0, atol=1e-14)
    with pytest.raises(np.linalg.LinAlgError):
        exact_inverse(np.ones((2, 2)))


def test_a_self_test_stands_beside_a_file_alone(tmp_path):
    path = tmp_path / "imu.c"
    for _ in range(2):
        assert self_test(path) == (tmp_path / "imu_test.c",)
        path.write_text("")
    for other in (tmp_path, "/", ".", "/dev/null"):
        assert self_test(other) == ()


def test_a_middle_that_single_precision_cannot_hold_is_that_of_double():
    assert _held_by_both(0.1) == float(np.float32(0.1)) != 0.1
    assert _held_by_both(1e39) == 1e39
