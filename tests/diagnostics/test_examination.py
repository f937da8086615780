"""Findings: what they are, where they stand, and how they reach the user."""

import json
import warnings

import numpy as np
import pytest
from findings_bench import texts

import multipos as mp
from multipos.finding import serious
from multipos.reports.certificate import build_content
from multipos.reports.documents import html_report, markdown_report, plain_report
from multipos.reports.summary import text_report
from multipos.sensor.calibration_file import from_dict
from tests.cli_bench import SIX, run

DEAD = {
    "direction": ["E-U-S", "E-N-U", "D-E-S", "W-D-S", "U-W-S", "S-W-D"],
    "ax": [0.0071, -0.0094, -0.9965, -0.0076, 0.9965, 0.0067],
    "ay": [0.0041] * 6,
}


def test_a_doubt_is_named_and_read_back(tmp_path):
    cal = mp.fit(DEAD)
    finding, beside = cal.diagnostics.findings
    assert beside.code == "inseparable"
    assert (finding.code, finding.level, finding.outputs) == ("dead-output", "error", ("ay",))
    assert texts(cal)[0] == str(finding)
    cal.save(tmp_path / "cal.json")
    assert mp.load(tmp_path / "cal.json").diagnostics.findings == (finding, beside)
    said, _ = cal.to_dict()["diagnostics"]["findings"]
    assert said == {**finding, "rows": [], "outputs": ["ay"]}


def test_a_file_of_version_0_1_is_read():
    """Doubts and warnings as that version wrote them: texts of doubts are the first warnings."""
    content = json.loads(json.dumps(mp.fit(DEAD).to_dict()))
    doubts = [
        {"code": "sign", "severity": "implausible", "text": "x", "rows": [], "outputs": ["ax"]},
        {"code": "outlier", "severity": "caution", "text": "y", "rows": ["2"], "outputs": []},
    ]
    del content["findings"], content["diagnostics"]["findings"]
    assert from_dict(content).findings == ()
    content["diagnostics"] |= {"doubts": doubts, "warnings": ["x", "y", "z"]}
    found = from_dict(content).findings
    assert [(each.code, each.level, each.text) for each in found] == [
        ("sign", "error", "x"),
        ("outlier", "warning", "y"),
        ("earlier-warning", "warning", "z"),
    ]
    assert (found[0].outputs, found[1].rows, found[0].action) == (("ax",), ("2",), "")


def test_doubts_come_first_wherever_a_calibration_is_shown():
    cal = mp.fit(DEAD)
    text = text_report(cal)
    assert text.startswith("Not fit for use: ax, ay calibrated from 6 positions; ")
    assert text.index("Findings\n--------\n- 'ay' has the same reading") < text.index("Residuals")
    content = build_content(cal)
    for page in (plain_report(content), markdown_report(content), html_report(content)):
        verdict, finding, first = map(
            page.index, ("Not fit for use", "has the same reading", "Residuals")
        )
        assert verdict < finding < first


def test_warnings_of_a_fit_are_warnings_of_python():
    with pytest.warns(mp.CalibrationWarning, match="'ay' has the same reading") as caught:
        mp.fit(DEAD)
    assert {warning.filename for warning in caught} == {__file__}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert texts(mp.fit(DEAD))


def test_on_the_command_line_each_is_said_once(tmp_path, capsys):
    path = tmp_path / "six.csv"
    path.write_text(SIX.replace("0.0027", "0.003"))
    table = mp.read_table(path)
    lines = [f"{row.rpartition(',')[0]},0.25" for row in path.read_text().splitlines()[1:]]
    path.write_text("\n".join([",".join(table.columns), *lines]))
    status, out, err = run(capsys, "fit", path)
    assert status == 3
    assert err.count("multipos: not fit for use: 'az' has the same reading at all 6 positions") == 1
    assert out.startswith("Not fit for use: ax, ay, az calibrated from 6 positions; 1 error.")


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_nothing_explains_outputs_of_zeros_at_poor_positions():
    up = np.tile(mp.read_scheme("corners-8").up, (3, 1))
    up[:, 1] = np.abs(up[:, 1]) * np.repeat([5.0, 40.0, 60.0], 8)  # all within 16 degrees of y
    with pytest.warns(mp.CalibrationWarning, match="outputs do not respond"):
        mp.fit(mp.Readings(np.zeros((24, 3)), up=up / np.linalg.norm(up, axis=1)[:, None]))


@pytest.mark.parametrize(("shift", "codes"), [(0.0, []), (273.15, ["temperature-kelvin"])])
def test_kelvin_is_told_from_celsius(shift, codes):
    rng = np.random.default_rng(4)
    up = np.tile(mp.read_scheme("faces-6").up, (3, 1))
    temperature = np.repeat([-20.0, 25.0, 60.0], 6)
    readings = mp.Readings(
        up + 1e-4 * temperature[:, None] + 1e-4 * rng.standard_normal((18, 3)),
        up=up,
        environment={"temperature": temperature + shift},
    )
    cal = mp.fit(readings, model="1 + x + y + z + temperature")
    assert [d.code for d in cal.diagnostics.findings if d.code == "temperature-kelvin"] == codes


def test_an_orientation_sd_that_is_stated_too_small_makes_no_outliers():
    """24 positions off by .2°, .1 mg: half of it is a centre, and one bad position is bad."""
    up = mp.read_scheme("fibonacci-24").up
    alone = 0
    for seed in (1, 3):
        rng = np.random.default_rng([10, seed])
        stood = up + np.cross(np.radians(0.2) * rng.standard_normal((24, 3)), up)
        stood /= np.linalg.norm(stood, axis=1)[:, None]
        values = [0.02, -0.01, 0.03] + 1.01 * stood + 1e-4 * rng.standard_normal((24, 3))
        half = mp.fit(mp.Readings(values, up=up), orientation_sd=0.1, exclude="none")
        assert not serious(half.findings)
        values[7] += 0.03
        gross = mp.fit(mp.Readings(values, up=up), orientation_sd=0.2, exclude="none")
        alone += {"outlier", "set-aside"} >= {each.code for each in serious(gross.findings)} > set()
    assert alone == 2
