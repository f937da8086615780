"""Readers in a process of their own: what they find comes back, a crash does not."""

import io
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from amounts import rest_slow

from multipos.errors import MultiposError
from multipos.logs.extras import read_apart


def finds(path: Path) -> dict[str, object]:
    print("what a library prints is no part of the answer")
    return {
        "a": np.arange(12.0).reshape(3, 4, order="F"),
        "naïve": np.array(["x", "yy"]),
        "none": np.zeros((0, 2), dtype=">i2"),
        "one": 3.5,
        "structure": np.array([{"a": 1}], dtype=object),
        "file": np.array([path.read_text()]),
    }


def crashes(path: Path) -> dict[str, object]:
    os.abort()


def refuses(path: Path) -> dict[str, object]:
    raise ZeroDivisionError("first line\nsecond line")


def turns_in_circles(path: Path) -> dict[str, object]:
    time.sleep(60.0)
    return {}


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "a log.mat"
    file.write_text("content")
    return file


def test_what_a_reader_finds_comes_back(path, capfd):
    found = read_apart(path, finds)
    assert list(found) == ["a", "naïve", "none", "one", "file"]  # objects would need pickle
    np.testing.assert_array_equal(found["a"], np.arange(12.0).reshape(3, 4, order="F"))
    assert found["naïve"].tolist() == ["x", "yy"]
    assert found["none"].shape == (0, 2)
    assert found["none"].dtype == ">i2"
    assert found["one"].shape == ()
    assert found["file"].tolist() == ["content"]
    assert capfd.readouterr().out == ""


def test_a_relative_path_is_read_from_the_callers_folder(path, monkeypatch):
    monkeypatch.chdir(path.parent)
    assert read_apart(Path(path.name), finds)["file"].tolist() == ["content"]


@pytest.mark.parametrize(
    ("reader", "message"),
    [
        (crashes, "the file is damaged: its reader crashed"),
        (refuses, "cannot read the log: first line; write it again."),
        (turns_in_circles, "its reader did not end within 2 s"),
    ],
)
def test_a_reader_that_fails_is_one_sentence(reader, message, path):
    with pytest.raises(MultiposError) as caught:
        read_apart(path, reader, patience=2.0 if reader is turns_in_circles else 300.0)
    assert message in str(caught.value)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_child_that_cannot_answer_says_why(path, monkeypatch):
    monkeypatch.setattr(sys, "path", [])
    with pytest.raises(MultiposError, match="ModuleNotFoundError"):
        read_apart(path, finds)


def test_no_interpreter_is_an_error(path, monkeypatch):
    monkeypatch.setattr(sys, "executable", str(path.parent / "gone"))
    with pytest.raises(MultiposError, match=r"cannot start '.*gone' .*No such file"):
        read_apart(path, finds)


def damaged_mat(place: int, value: int) -> bytes:
    from scipy.io import savemat

    stream = io.BytesIO()
    savemat(stream, {"acc": np.arange(30.0).reshape(10, 3), "t": np.arange(10) * 0.01})
    content = bytearray(stream.getvalue())
    content[place] = value
    return bytes(content)


# A byte of the array flags and two of a tag, over which SciPy 1.17 follows a null pointer.
@pytest.mark.parametrize(("place", "value"), rest_slow([(145, 109), (176, 63), (177, 105)]))
def test_a_damaged_mat_file_does_not_end_the_process(place, value, tmp_path):
    from scipy.io import savemat

    (tmp_path / "bad.mat").write_bytes(damaged_mat(place, value))
    savemat(tmp_path / "good.mat", {"ax": np.arange(20.0)})
    # A script without the guard of __main__, as in a notebook: it must not run twice.
    script = tmp_path / "script.py"
    script.write_text(
        "print('runs')\n"
        "import multipos as mp\n"
        "from multipos.logs.opening import open_log\n"
        "print(*open_log('good.mat').columns)\n"
        "try:\n"
        "    open_log('bad.mat')\n"
        "except mp.MultiposError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, script], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    runs, columns, error = done.stdout.splitlines()
    assert (runs, columns) == ("runs", "ax")
    assert error.startswith("bad.mat: ")
    assert error.endswith("; write it again.")
    assert done.stderr == ""
