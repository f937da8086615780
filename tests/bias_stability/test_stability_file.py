"""A stability file is read back whole, and a damaged one refused in words."""

import json

import numpy as np
import pytest

import multipos as mp
from multipos.errors import MultiposError


@pytest.fixture(scope="module")
def whole():
    rng = np.random.default_rng(1)
    t = np.arange(3000) / 10.0
    logs = [
        {
            "time": t,
            "ax": 0.02 * np.exp(-t / 20.0) + 1e-3 * rng.standard_normal(len(t)),
            "ay": 1.0 + 1e-3 * rng.standard_normal(len(t)),
            "temperature": 20.0 + np.sin(t / 9.0),
        }
        for _ in range(2)
    ]
    return mp.stability(logs, unit="g")


def test_a_file_gives_the_result_back(whole, tmp_path):
    whole.save(tmp_path / "s.json")
    assert whole.outputs["ax"].warm_up is not None  # everything that can be there is
    assert whole.outputs["ax"].temperature_coefficient.ppm is None
    assert whole.outputs["ay"].temperature_coefficient.ppm is not None
    assert mp.load_stability(tmp_path / "s.json") == whole


def test_a_file_without_the_optional_parts_is_read_too(tmp_path):
    found = mp.stability({"ax": np.random.default_rng(1).standard_normal(300)}, rate=1.0)
    found.save(tmp_path / "s.json")
    assert mp.load_stability(tmp_path / "s.json") == found


DAMAGE = {
    "no outputs": (lambda c: c.update(outputs={}), "do not go together"),
    "other times": (lambda c: c["outputs"]["ay"]["allan"].pop(), "do not go together"),
    "other names": (lambda c: c["run_to_run"].pop("ax"), "do not go together"),
    "a record of less": (lambda c: c["records"][0]["zero"].pop("ay"), "do not go together"),
    "a short record": (lambda c: c["records"][1]["time"].pop(), "do not go together"),
    "a short temperature": (lambda c: c["records"][1]["temperature"].pop(), "do not go together"),
    "a negative u": (
        lambda c: c["outputs"]["ax"]["drift"].update(u=-1.0),
        "outputs.ax.drift.u is -1.0; a number of at least 0",
    ),
    "a missing key": (lambda c: c.pop("records"), "the key 'records' is missing"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_file_is_refused(name, whole, tmp_path):
    content = json.loads(json.dumps(whole.to_dict()))
    damage, words = DAMAGE[name]
    damage(content)
    (tmp_path / "s.json").write_text(json.dumps(content))
    with pytest.raises(MultiposError, match=words):
        mp.load_stability(tmp_path / "s.json")
