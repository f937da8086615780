"""The programme that changes lines on purpose: its changes are code, and are of what computes."""

import ast
import math
import os
import subprocess
from pathlib import Path

import pytest

from tests.mutation.__main__ import draw
from tests.mutation.changes import Change, changes_of
from tests.mutation.trying import Reached, _waited

SOURCE = '''
def deviation(x: list[float], known: bool = True) -> float:
    """Return it."""
    if not known and len(x) < 2:
        raise ValueError(f"{len(x) + 1} are needed")
    mean = sum(x) / len(x)
    return 1.25 * (sum(each**2 for each in x) - mean) * self.sign + scale(mean, x)
'''


def test_what_computes_is_changed_and_what_speaks_is_not(tmp_path):
    path = tmp_path / "deviation.py"
    path.write_text(SOURCE)
    found = {(change.before, change.after) for change in changes_of(path)}
    assert ("sum(x) / len(x)", "sum(x) * len(x)") in found
    assert ("1.25", "1.875") in found
    assert ("len(x) < 2", "len(x) >= 2") in found
    assert ("not known and len(x) < 2", "not known or len(x) < 2") in found
    assert ("each ** 2", "each * 2") in found
    assert ("scale(mean, x)", "scale(x, mean)") in found
    assert ("sum((each ** 2 for each in x)) - mean", "sum((each ** 2 for each in x))") in found
    assert not any("+ 1" in before or "self.sign" in before[-9:] for before, _ in found)


def test_every_change_is_code(tmp_path):
    (changes,) = draw(["compensation"], 20, 1).values()
    assert len(changes) == 20
    for change in changes:
        copy = tmp_path / change.path
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(Path(change.path).read_bytes())
        change.apply(tmp_path)
        assert ast.dump(ast.parse(copy.read_bytes())) != ast.dump(
            ast.parse(Path(change.path).read_bytes())
        )


def test_tests_of_the_line_come_first_and_those_that_a_cache_hides_last():
    reached = Reached(
        {"a": 0.3, "b[0]": 0.2, "b[1]": 0.1, "c": 0.05, "d": 0.01, "e": 50.0},
        {"known.py": {7: ["a", "b[0]", "b[1]"], 8: ["c", "a"]}},
    )
    change = Change(Path("known.py"), 7, "1", "2", 0, 1)
    assert reached.tests_of(change) == ["b[1]", "a", "b[0]", "c", "d"]


def test_what_waits_without_the_processor_is_given_up():
    """By ten times what its tests took, and half a minute."""
    reached = Reached({"a": 0.2, "b": 3.0}, {})
    assert reached.longest(["b"]) == 60.0
    process = subprocess.Popen(["sleep", "60"], start_new_session=True)
    assert _waited(process.pid, 0.1) == 1
    with pytest.raises(ProcessLookupError):
        os.kill(process.pid, 0)
    process.poll()


def test_an_interrupt_leaves_no_process(monkeypatch):
    def interrupted(seconds):
        raise KeyboardInterrupt

    process = subprocess.Popen(["sleep", "60"], start_new_session=True)
    monkeypatch.setattr("time.sleep", interrupted)
    with pytest.raises(KeyboardInterrupt):
        _waited(process.pid, math.inf)
    with pytest.raises(ProcessLookupError):
        os.kill(process.pid, 0)
    process.poll()
