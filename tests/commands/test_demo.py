"""The demonstration: the paper's figures, what does not follow from them, and the files."""

import json
import re

import numpy as np
import pytest

import multipos as mp
from multipos.cli import main
from multipos.song_qin import PRINTED, TABLE_2, demo_dict, demo_text

# Table 2 as its lines stand in the paper, thousandths set apart
TABLE_2_IN_PRINT = """
1   0.007 055 6   -1.002 908 508    -0.001 607 945
2  -0.009 357 6   -0.005 817 015 8  -1.000 803 973
3   0.996 472 18   0.006 436 241 2   0.001 513 362
4  -0.007 579 7    1.003 011         0.003 215 892
5  -0.996 472 2    0.007 318 172     0.002 705 132
6   0.006 737 47  -0.005 985 89      1.000 799 727
"""


def test_table_2_is_typed_as_printed():
    numbers = re.findall(r"-?\d\.\d+(?: \d+)*", TABLE_2_IN_PRINT)
    printed = np.array([float(number.replace(" ", "")) for number in numbers]).reshape(6, 3)
    np.testing.assert_array_equal(TABLE_2, printed)


def test_the_text_says_what_the_issue_is_about():
    text = demo_text(mp.demo())
    for said in (
        "a_x0   bias_ax     -0.0007860575",
        "13 of 15 printed figures follow from the printed table",
        "S_ay   is printed 1.002908508, which is -A_y1; the formula gives 1.002959754",
        "K_ay3  is off by 1.5e-08, because A_y4 was rounded to 1.003011 in print",
        "+-6.39 mg (s = 12.8 mg)",
        "has U = 81 mg",
        "positions 4 and 6 in the other order than its table 1",
    ):
        assert said in text


def test_every_coefficient_four_ways():
    found = demo_dict(mp.demo())
    entries = found["coefficients"]
    assert len(entries) == 15
    assert [e["name"] for e in entries if not e["agrees"]] == ["scale_ay", "quad_ay"]
    for entry, printed in zip(entries, PRINTED.ravel(), strict=True):
        assert entry["printed"] == printed
        assert entry["closed_form"] == pytest.approx(entry["least_squares"], abs=1e-15)
        assert 0 < entry["u"] < entry["U"]


def test_the_folder_holds_a_calibration_that_can_be_made_again(tmp_path, capsys):
    folder = tmp_path / "new" / "demo"
    assert main(["demo", "-o", str(folder)]) == 0
    assert f"Written to {folder}" in capsys.readouterr().out
    assert {path.name for path in folder.iterdir()} == {
        "readings.csv",
        "calibration.json",
        "report.txt",
    }
    cal = mp.load(folder / "calibration.json")
    again = mp.fit(
        folder / "readings.csv", scheme="song-qin-6", model="own-quadratic", convention="gravity"
    )
    np.testing.assert_array_equal(again.parameters, cal.parameters)
    report = (folder / "report.txt").read_text(encoding="utf-8")
    assert "13 of 15 printed figures" in report
    assert "closed form against least squares" in report


def test_json_is_one_object_and_the_default_folder_is_here(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["demo", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["coefficients"]) == 15
    assert (tmp_path / "multipos-demo" / "report.txt").is_file()


def test_a_folder_that_cannot_be_made(tmp_path, capsys):
    taken = tmp_path / "taken"
    taken.write_text("mine")
    assert main(["demo", "-o", str(taken)]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(f"multipos: error: {taken}: cannot make the folder")
    assert taken.read_text() == "mine"
