"""verify-export runs no code but its own, unless told; what other code prints misleads it not."""

import dataclasses
import json
import math
import os
import shutil
import subprocess
import time

import numpy as np
import pytest
from log_bench import sensor

import multipos as mp
from multipos.cli import main
from multipos.exports.c_running import _SECONDS, _bound
from multipos.exports.targets import export, verify_export

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="no cc on this machine")

CONSTRUCTOR = """
#include <stdio.h>
__attribute__((constructor)) static void first(void)
{{
    FILE *file = fopen("{path}", "w");
    if (file) fclose(file);
    for (int i = 0; i < 1000; ++i) puts("noise");
}}
"""


@pytest.fixture
def cal(tmp_path):
    up = mp.read_scheme("faces-corners-14").up
    y = sensor(bias=0.05, cross=0.02).predict(up)
    y = y + 1e-4 * np.random.default_rng(0).normal(size=up.shape)
    cal = mp.fit(mp.Readings(y, up=up, unit="g"))
    cal.save(tmp_path / "cal.json")
    return cal


def verify(capsys, *argv):
    status = main(["verify-export", *map(str, argv)])
    out, err = capsys.readouterr()
    return status, out, err.splitlines()[-1] if err else ""


@needs_compiler
@pytest.mark.parametrize("single", [False, True], ids=["double", "float"])
def test_the_name_and_the_precision_are_read_back(cal, single, tmp_path):
    export(cal, "c", name="imu_7", float=single).save(tmp_path / "f.c")
    found = verify_export(tmp_path / "f.c", cal)
    assert found.target == ("c, single precision" if single else "c")
    assert found.difference < (5e-7 if single else 1e-12)
    assert not found.foreign


@needs_compiler
def test_what_is_not_its_own_runs_only_where_the_user_says_so(cal, tmp_path, capsys):
    witness = tmp_path / "witness"
    text = export(cal, "c").text
    (tmp_path / "f.c").write_text(text + CONSTRUCTOR.format(path=witness))
    status, out, said = verify(capsys, tmp_path / "f.c", tmp_path / "cal.json")
    assert (status, out) == (1, "")
    assert "so it was exported from another or changed since" in said
    assert "--run-foreign-code" in said
    assert not witness.exists()
    argv = (tmp_path / "f.c", tmp_path / "cal.json", "--run-foreign-code", "--json")
    status, out, _ = verify(capsys, *argv)
    assert status == 0
    found = json.loads(out)  # what the constructor prints is not among the numbers
    assert found["foreign"] is True
    assert found["difference"] < 1e-12
    assert witness.exists()


def test_the_first_line_that_differs_is_named(cal, tmp_path, capsys):
    lines = export(cal, "c").text.split("\n")
    row = next(i for i, line in enumerate(lines) if line.startswith("    accel[1]"))
    lines[row] = "    accel[1] = 0.0; \x1b[31m"
    (tmp_path / "f.c").write_text("\n".join(lines))
    status, _, said = verify(capsys, tmp_path / "f.c", tmp_path / "cal.json")
    assert status == 1
    assert f"line {row + 1} is '    accel[1] = 0.0; \\u001b[31m' where export writes" in (
        said.replace("is ' accel", "is '    accel")  # the command line closes up blanks
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("\n", "\r\n"), "its lines end in CR LF, and in nothing else"),
        (
            lambda text: text.replace(f"multipos {mp.__version__}\n", "multipos 9.8.7\n"),
            f"it was written by multipos 9.8.7, and this is {mp.__version__}",
        ),
        (lambda text: text + "\n", "is nothing of this calibration"),
        (lambda text: text[:-1], "where export writes '' of this calibration"),
        (lambda text: text * 20_000, "more than any file of multipos export has"),
    ],
)
def test_how_a_file_differs(cal, change, message, tmp_path):
    if message.startswith("is nothing"):
        message = "is '' where export writes nothing of this calibration"
    (tmp_path / "f.c").write_bytes(change(export(cal, "c").text).encode())
    with pytest.raises(mp.MultiposError, match=message):
        verify_export(tmp_path / "f.c", cal)


def test_the_file_of_another_calibration_is_refused(cal, tmp_path):
    other = dataclasses.replace(cal, parameters=cal.parameters * 1.0001)
    export(other, "c").save(tmp_path / "f.c")
    with pytest.raises(mp.MultiposError, match="exported from another or changed since"):
        verify_export(tmp_path / "f.c", cal)


@needs_compiler
@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("{", "does not compile or run"),
        ("{ for (;;) { } }", "for more than 1 s"),
        ("{ (void)raw; (void)accel; exit(0); }", "the compiled function stopped"),
    ],
)
def test_foreign_code_that_fails(cal, body, message, tmp_path, monkeypatch):
    if "for (;;)" in body:  # the others end by themselves, on a busy machine too
        monkeypatch.setattr("multipos.exports.c_running._SECONDS", 1)
    head = "#include <stdlib.h>\nvoid a_compensate(const double raw[3], double accel[3])\n"
    (tmp_path / "f.c").write_text(head + body + "\n")
    with pytest.raises(mp.MultiposError, match=message):
        verify_export(tmp_path / "f.c", cal, run_foreign_code=True)


FORKING = """\
#define _POSIX_C_SOURCE 200809L
#include <stdio.h>
#include <unistd.h>
void a_compensate(const double raw[3], double accel[3])
{{
    accel[0] = raw[0];
    if (fork() == 0) {{
        sleep(1);
        fopen("{path}", "w");
        _exit(0);
    }}
    _exit(0);
}}
"""


@needs_compiler
@pytest.mark.skipif(os.name != "posix", reason="processes have no groups")
def test_what_foreign_code_leaves_running_ends_with_it(cal, tmp_path):
    witness = tmp_path / "witness"
    (tmp_path / "f.c").write_text(FORKING.format(path=witness))
    with pytest.raises(mp.MultiposError, match="the compiled function stopped"):
        verify_export(tmp_path / "f.c", cal, run_foreign_code=True)
    time.sleep(1.5)
    assert not witness.exists()


@needs_compiler
def test_a_file_name_is_no_option_of_the_compiler(cal, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    export(cal, "c").save("-o.c")
    status, out, _ = verify(capsys, "cal.json", "--json", "--", "-o.c")
    assert status == 1  # the first name is the file
    status, out, _ = verify(capsys, "--json", "--", "-o.c", "cal.json")
    assert status == 0
    assert json.loads(out)["target"] == "c"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["-o.c", "-o_test.c", "cal.json"]


# --- parameters, which users paste and edit


def edited(cal, target, change, tmp_path):
    (tmp_path / "f").write_text(change(export(cal, target, allow_lossy=True).text))
    return verify_export(tmp_path / "f", cal)


def test_other_parameters_and_comments_may_stand_beside(cal, tmp_path):
    plain = edited(cal, "px4", lambda text: text, tmp_path)
    more = edited(
        cal, "px4", lambda text: f"# CAL_ACC0_XOFF 7\n1\t1\tSYS_HITL\t0\t6\n{text}", tmp_path
    )
    assert np.array_equal(plain.residuals, more.residuals)


@pytest.mark.parametrize(
    ("target", "change", "message"),
    [
        ("px4", lambda text: f"{text}1\t1\tCAL_ACC0_XOFF\t7\t9\n", "is given twice"),
        (
            "ros-imu-calib",
            lambda text: text.replace("SM: [", "SM: [0,0,0,0,0,0,0,0,0]\n#"),
            "SM has no inverse",
        ),
    ],
)
def test_parameters_that_are_refused(cal, target, change, message, tmp_path):
    with pytest.raises(mp.MultiposError, match=message):
        edited(cal, target, change, tmp_path)


def test_parameters_beyond_all_numbers_differ(cal, tmp_path):
    far = lambda text: text.replace("CAL_ACC0_XOFF\t", "CAL_ACC0_XOFF\t1e300\t#")  # noqa: E731
    (found,) = edited(cal, "px4", far, tmp_path).findings
    assert (found.code, found.level) == ("export-differs", "error")


@pytest.mark.skipif(os.name != "posix", reason="no bounds there")
def test_a_second_lies_between_the_signal_that_says_why_and_the_end():
    hard = subprocess.run(["sh", "-c", "ulimit -Ht"], capture_output=True, text=True, check=True)
    largest = math.inf if hard.stdout.strip() == "unlimited" else int(hard.stdout)
    show = ["sh", "-c", "ulimit -t; ulimit -Ht"]
    done = subprocess.run(show, capture_output=True, text=True, check=True, preexec_fn=_bound)
    soft = min(_SECONDS, largest)
    assert done.stdout.split() == [f"{soft}", f"{min(soft + 1, largest)}"]


@pytest.mark.parametrize(("hard", "seconds"), [(-1, (60, 61)), (30, (30, 30)), (90, (60, 61))])
def test_what_runs_is_bounded_by_what_the_system_allows(hard, seconds, monkeypatch):
    resource = pytest.importorskip("resource")
    limits = {}
    monkeypatch.setattr(resource, "RLIM_INFINITY", -1)
    monkeypatch.setattr(resource, "getrlimit", lambda what: (hard, hard))
    monkeypatch.setattr(resource, "setrlimit", limits.__setitem__)
    _bound()
    assert limits[resource.RLIMIT_CPU] == seconds
    bytes_ = (4 << 30,) * 2 if hard == -1 else (hard, hard)
    assert limits[resource.RLIMIT_AS] == bytes_
    assert limits[resource.RLIMIT_CORE] == (0, 0)
