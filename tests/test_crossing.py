"""Every kind of calibration goes through every command with every option that takes no value."""

import contextlib
import io
import json
import warnings
from pathlib import Path

import pytest
from amounts import few_and_many
from fuzzing import bases, crossing

from multipos import cli

STRIDES = few_and_many(5009, 797)  # prime to the lengths of the lists
LINES = [line for line in crossing.COMMANDS if not any(word in line for word in crossing.SLOW)]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    valid = bases.make(tmp_path_factory.mktemp("bases"))
    crossing.VALID.update(valid)
    return valid


def ended(words):
    """Exit status, stdout and stderr of a command; a warning of a library is an error."""
    out, err = io.StringIO(), io.StringIO()
    streams = contextlib.redirect_stdout(out), contextlib.redirect_stderr(err)
    with streams[0], streams[1], warnings.catch_warnings(action="error", category=RuntimeWarning):
        status = cli.main(words)
    return status, out.getvalue(), err.getvalue()


def broken(words):
    """What a command did that is not promised; an empty list where all is."""
    before = set(Path().iterdir())
    status, out, err = ended(words)
    made = set(Path().iterdir()) - before
    said = err.strip().splitlines()[-1:] or [""]
    faults = []
    if status not in (0, 1, 2, 3):
        faults.append(f"status {status}")
    if status in (1, 2) and (not said[0].startswith("multipos: error: ") or out or made):
        faults.append(f"status {status}, {said[0]!r}, {len(out)} characters, {made}")
    if "a fault of multipos" in err:
        faults.append(said[0])
    if status in (0, 3) and "--json" in words and not isinstance(json.loads(out), dict):
        faults.append("no JSON")
    if status in (0, 3) and "-o" in words and not Path(words[words.index("-o") + 1]).exists():
        faults.append("nothing written")
    for path in made:
        path.unlink()
    return faults


@pytest.fixture
def place(files, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MULTIPOS_DEBUG", raising=False)
    for name, content in files.items():
        Path(name).write_bytes(content)


SHARED = [
    ("averaged14.csv", "--unit", "g", *crossing.chosen(model, ".", budget))
    for model, budget in [(crossing.OWN, ""), (crossing.OWN, "bench.toml"), (crossing.SOFT, "")]
]


@pytest.mark.parametrize("stride", STRIDES)
def test_a_crossing_ends_as_promised(stride, place):
    flags = {line: crossing.cycled(line) for line in LINES}
    seen, faults = 0, []
    for words in (*SHARED, *crossing.KINDS[::stride]):
        made = crossing.make(words)
        faults += [(words, fault) for fault in broken(["fit", *words, "-o", "o.json"])]
        if made is None:
            assert words not in SHARED
            continue
        Path(crossing.CALIBRATION).write_bytes(made)
        for line in LINES:
            asked = [*crossing.filled(line, words), *next(flags[line]).split()]
            faults += [(words, asked, fault) for fault in broken(asked)]
            seen += 1
    assert not faults
    assert seen > 20_000 / stride


@pytest.mark.parametrize("making", crossing.MAKING[:3])
@pytest.mark.parametrize("budget", ["", "--budget=bench.toml"])
def test_what_outputs_share_goes_with_rests(place, making, budget):
    status, _, err = ended([*making.split(), "--model", crossing.OWN, *budget.split()])
    assert status == 0, err
    assert Path(making.split()[-1]).exists()


@pytest.mark.slow
@pytest.mark.parametrize("first", range(4))
def test_a_large_crossing_ends_as_promised(place, first):
    flags, faults = {line: crossing.cycled(line) for line in LINES}, []
    for words in crossing.KINDS[first * 22 :: 88]:
        made = crossing.make(words)
        if made is None:
            continue
        Path(crossing.CALIBRATION).write_bytes(made)
        for line in LINES[first::4]:
            asked = [*crossing.filled(line, words), *next(flags[line]).split()]
            faults += [(words, asked, fault) for fault in broken(asked)]
    assert not faults
