"""A target is one `Target` in one list: export knows none by name."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from consumers import read_back
from log_bench import sensor

import multipos as mp
from multipos.cli import main
from multipos.commands import export
from multipos.exports import targets
from multipos.exports.laws import LINEAR
from multipos.exports.parameters import Form, parameter_target
from multipos.finding import Finding

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "exports.md"


def calibration(source=None):
    up = mp.read_scheme("faces-corners-14").up
    values = sensor(bias=0.05, cross=0.02).predict(up)
    values = values + 1e-4 * np.random.default_rng(0).normal(size=up.shape)
    readings = mp.Readings(values, up=up, unit="g")
    return mp.fit(dataclasses.replace(readings, source=source) if source else readings)


def plain(cal, law, wish):
    text = json.dumps({"plain T": law.matrix.tolist(), "o": law.offset.tolist()})
    return text, [Finding("plain", "warning", "as plain as can be")]


PLAIN = parameter_target("plain", ".txt", Form(LINEAR, plain, raw="readings"))


def test_every_target_is_on_the_page_and_no_two_share_a_name():
    names = [target.name for target in targets.TARGETS]
    assert len(set(names)) == len(names)
    for target in targets.TARGETS:
        assert f"`{target.name}`" in PAGE.read_text(encoding="utf-8") or target.is_code


def test_a_new_target_is_one_line_in_the_list(tmp_path, monkeypatch, capsys):
    more = (*targets.TARGETS, PLAIN)
    for module in (targets, export):  # which keeps the list that it is imported with
        monkeypatch.setattr(module, "TARGETS", more)
    cal = calibration()
    cal.save(tmp_path / "cal.json")
    file = tmp_path / "plain.txt"
    assert main(["export", str(tmp_path / "cal.json"), "--to", "plain", "-o", str(file)]) == 0
    assert "as plain as can be" in capsys.readouterr().err
    assert mp.export(cal, "plain").difference < 1e-12  # the law is all of a linear model
    with pytest.raises(mp.UsageError, match="inav, plain, got 'other'"):
        mp.export(cal, "other")
    with pytest.raises(mp.UsageError, match="--float is for --to c; plain has a precision"):
        mp.export(cal, "plain", float=True)


@pytest.mark.parametrize("target", ["ros-imu-calib", "px4", "ardupilot"])
def test_the_name_of_the_source_does_not_decide_the_target(target, tmp_path):
    cal = calibration("CAL_ACC0_XOFF INS_ACCOFFS_X SM: bias: .csv")
    mp.export(cal, target, allow_lossy=True).save(tmp_path / "file")
    assert read_back(tmp_path / "file", cal).target == target
