"""Every model to copy finds the numbers of a simulated sensor."""

import re
from pathlib import Path

import numpy as np
import pytest

import multipos as mp
from multipos.positions.scheme import read_scheme
from multipos.sensor.model_text import read_model
from multipos.sensor.own_models import build_parsed

PAGE = Path(__file__).resolve().parents[2] / "docs" / "howto" / "own-model.md"
LINES = re.findall(r"^\| [^|]+ \| `(.+)` \|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
UP = read_scheme("fibonacci-60").up
TRUTH = {"b": 0.1, "s": 1.1, "k": 0.1, "a": 1.5, "w": 1.3, "p": 0.05, "q": 0.04, "h": 0.01}
TRUTH |= {"c": 0.02, "f": 35.0}


def built(line, columns):
    known = tuple(columns)
    return build_parsed(
        read_model(line), ("ax", "ay", "az"), tuple("xyz"), tuple("xyz"), "g", known
    )


def test_there_are_ten():
    assert len(LINES) == 10


@pytest.mark.parametrize("line", LINES)
def test_a_model_finds_its_sensor(line):
    generator = np.random.default_rng(1)
    columns = {
        "temperature": generator.uniform(10.0, 40.0, 60),
        "supply": generator.uniform(4.8, 5.2, 60),
    }
    names = re.findall(r"[a-z]\w*", line)
    used = {name: values for name, values in columns.items() if name in names}
    truth = dict(TRUTH, a=0.02) if "abs" in line else TRUTH
    model = built(line, used)
    theta = np.array([truth[str(term)] for _, term in model.keys])
    values = model.predict(theta, UP, used)
    values = values + 1e-5 * generator.standard_normal(values.shape)
    cal = mp.fit(mp.Readings(values, up=UP, environment=used), model=line)
    assert (np.abs(cal.parameters - theta) < 5.0 * cal.u + 1e-9).all(), cal
