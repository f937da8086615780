"""The page of formats and options says what the code does."""

import importlib
import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from docs_programs import load

import multipos as mp
from multipos.cli import COMMANDS
from multipos.numerics.terms import NAMED
from multipos.positions import attitudes
from multipos.positions.headers import RESERVED
from multipos.positions.scheme import SCHEMES
from multipos.reports.laboratory import LAB_FIELDS
from multipos.sensor.found import FoundOrientations
from multipos.sensor.model import build_model
from multipos.uncertainty.budgets import DIVISORS, KINDS

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGE = (DOCS / "reference/formats.md").read_text("utf-8")
NAMES = {name.replace(r"\|", "|") for name in re.findall(r"`([^`\n]+)`", PAGE)}


def rows(heading):
    """Cells of the tables below a heading, the quotes and the escapes of bars taken off."""
    section = PAGE.split(f"## {heading}\n")[1].split("\n## ")[0]
    for line in section.splitlines():
        if line.startswith("| `"):
            cells = re.split(r"(?<!\\)\|", line)[1:-1]
            yield [cell.replace(r"\|", "|").strip().strip("`") for cell in cells]


def test_what_o_writes_is_described_for_every_command():
    table = dict(re.findall(r"^\| (`\.\w+`.*?) \| (.+?) \|$", PAGE, re.MULTILINE))
    said = {ending: set(re.findall(r"`([\w-]+)`", text)) for ending, text in table.items()}
    forms = {}
    for name in COMMANDS:
        output = importlib.import_module(f"multipos.commands.{name.replace('-', '_')}").OUTPUT
        forms[name] = {output.own, *output.others}
    assert said["`.csv`"] == {name for name, form in forms.items() if "table" in form}
    assert said["`.svg`, `.png`, `.pdf`"] == {name for name in forms if "figure" in forms[name]}
    without = set(re.findall(r"`([\w-]+)`", table["`.json`"].split(";")[1]))
    assert without == {name for name, form in forms.items() if "json" not in form}


def test_every_column_of_readings_is_described():
    assert attitudes.COLUMNS | RESERVED <= NAMES
    assert {"temperature", "time", "u_<output>", "sd_<output>"} <= NAMES


def test_every_scheme_is_described():
    assert set(SCHEMES) <= NAMES


def test_every_model_is_described_with_its_terms():
    described = {row[0]: row[1] for row in rows("Models") if row[0] in NAMED}
    assert set(described) == set(NAMED)
    for name, text in described.items():
        (terms,) = build_model(name, ("ax",), ("x",)).terms
        assert text == " + ".join(map(str, terms))


def test_names_and_units_of_parameters():
    described = [row for row in rows("Models") if len(row) == 4]
    assert len(described) == 10
    for term, name, in_volts, in_g in described:
        for unit, expected in (("V", in_volts), ("g", in_g)):
            model = build_model(f"1*{term}", ("ax",), ("x",), unit=unit)
            assert (model.names, model.units) == ((name,), (expected,))


@pytest.fixture(scope="module")
def calibration():
    """One that has every optional part."""
    rng = np.random.default_rng(0)
    up = np.tile(mp.read_scheme("song-qin-6").rotation[:, :, 2], (3, 1))
    readings = mp.Readings(
        up + 1e-3 * rng.standard_normal((18, 3)),
        rotation=np.tile(mp.read_scheme("song-qin-6").rotation, (3, 1, 1)),
        u=np.full((18, 3), 1e-3),
        sd=np.ones((18, 3)),
        samples=np.ones(18),
        orientation_sd=np.zeros(18),
        group=("g",) * 18,
        environment={"temperature": np.full(18, 20.0)},
    )
    return mp.fit(readings, gravity=9.81)


def test_every_key_of_a_calibration_is_described(calibration):
    content = calibration.to_dict()
    assert set(content) <= NAMES
    assert set(content["parameters"][0]) <= NAMES
    for key in ("input", "gravity", "status", "diagnostics", "intrinsic"):
        assert set(content[key]) <= NAMES, key
    assert set(content["linearity"]["ax"]) <= NAMES
    repeated = mp.Readings(np.tile(np.eye(6)[:, :3], (2, 1)))
    tested = mp.fit(repeated, scheme="faces-6+faces-6").diagnostics.lack_of_fit["ax"]
    assert set(tested) <= NAMES


def test_every_key_that_is_described_is_there(calibration):
    known = set(calibration.to_dict()) | {"reading_covariance"}  # instead of reading_u
    known |= {"variance_components", "robust_weight", "selection", "budget", "own_model", "facing"}
    known |= {"open_roll", "drift_per", "drift", "field"}  # --drift, magnetic
    known |= {field.name for field in fields(FoundOrientations)}
    known |= set(calibration.to_dict()["parameters"][0])
    described = {key for row in rows("Calibration (JSON)") for key in row[0].split("`, `")}
    assert described == known


def test_every_table_of_a_budget_is_described():
    described = {row[0]: row for row in rows("Budget (TOML)")}
    assert set(described) == set(KINDS)
    for name, kind in KINDS.items():
        assert all(key in described[name][3] for key in kind.settings)
    assert set(DIVISORS) <= NAMES


def test_every_field_of_a_lab_file_is_described():
    described = {row[0]: set(re.findall(r"\w+", row[1])) for row in rows("Lab file (TOML)")}
    assert described == {section: set(keys) for section, keys in LAB_FIELDS.items()}


def test_every_key_of_a_comparison_is_described(calibration):
    found = mp.compare(calibration, calibration).to_dict()
    assert set(found) | set(found["parameters"][0]) <= NAMES


def test_every_key_of_a_stability_result_is_described():
    page = (Path(__file__).resolve().parents[1] / "docs/howto/static-records.md").read_text("utf-8")
    names = set(re.findall(r"[a-z_A-Z]+", " ".join(re.findall(r"`([^`\n]+)`", page))))
    t = np.arange(2000) / 10.0
    noise = 1e-3 * np.random.default_rng(1).standard_normal((2, 2000))
    logs = [
        {"time": t, "ax": 1.0 + 0.02 * np.exp(-t / 20.0) + each, "temperature": 20.0 + np.sin(t)}
        for each in noise
    ]
    found = mp.stability(logs, unit="g").to_dict()
    output = found["outputs"]["ax"]
    for part in (
        found,
        output,
        output["allan"][0],
        output["drift"],
        output["warm_up"],
        output["temperature_coefficient"],
        found["run_to_run"]["ax"],
        found["records"][0],
    ):
        assert set(part) - {"schema"} <= names


@pytest.mark.parametrize("name", ["commands", "errors", "messages", "names"])
def test_the_pages_that_the_program_writes_are_of_this_program(name):
    generated = load("generated")
    page = (DOCS / f"reference/{name}.md").read_text("utf-8")
    if page != getattr(generated, f"{name}_page")():
        pytest.fail(f"reference/{name}.md is of another version; run `python docs/generated.py`")
