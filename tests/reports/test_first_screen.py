"""The first screen of a report, what a laboratory adds, how numbers stand, and the paper."""

import re

import browser
import numpy as np
import pytest
from findings_bench import texts

import multipos as mp
from multipos.cli import main
from multipos.files.numbers import beside, in_unit
from multipos.plots.pictures import (
    _draw_panel,
    _Picture,
    error_picture,
    residual_picture,
    split_errors,
)
from multipos.reports.certificate import build_content
from multipos.reports.documents import (
    aligned_rows,
    html_report,
    markdown_report,
    pdf_report,
    plain_report,
    readable,
)
from multipos.reports.sections import PageTable

UP = mp.read_scheme("all-26").up
MATRIX = np.array([[1.01, 0.002, 0.0], [0.0, 0.99, 0.001], [0.003, 0.0, 1.0]])


def values(seed=1, sd=2e-4):
    noise = np.random.default_rng(seed).standard_normal(UP.shape)
    return [0.01, -0.02, 0.005] + UP @ MATRIX.T + sd * noise


@pytest.fixture(scope="module")
def cal():
    readings = mp.Readings(values(), outputs=("ax", "ay", "az"), up=UP, unit="g")
    return mp.fit(readings, orientation_sd=0)


@pytest.fixture(scope="module")
def unknown():
    return mp.fit(mp.Readings(values(), outputs=("ax", "ay", "az")), unknown_orientation=True)


@pytest.mark.usefixtures("without_drawing")
def test_the_result_comes_before_what_the_laboratory_says(cal, forms):
    found = mp.check(cal, mp.Readings(values(2), outputs=cal.outputs, up=UP), limit_g=0.002)
    content = build_content(cal, check=found)
    for text in (html_report(content), markdown_report(content), plain_report(content)):
        order = ["Pass: largest error ", "rms error ", "Offset of ax", "the run as a whole: pass"]
        places = [text.index(said) for said in order]
        assert places == sorted(places)
    rows = {row[0]: row[1:] for row in content.result.tables[0].rows}
    assert rows["Offset of ay"][2] == "mg"
    offset = cal.intrinsic["offset"]["ay"]["value"]
    assert float(rows["Offset of ay"][0]) == pytest.approx(1e3 * offset, abs=0.005)
    assert float(rows["Offset of ay"][1]) == pytest.approx(
        1e3 * cal["bias_ay"].U / cal["scale_ay"].value, rel=0.1
    )
    assert rows["Angle between input axes xy"][2] == "°"
    assert "Decision rule: " in plain_report(content)
    assert "Decision rule: " not in forms[2]


def test_a_check_that_denies_u_is_a_doubt_of_the_report(cal):
    off = values(2) + np.array([0.002, 0.0, 0.0])
    found = mp.check(cal, mp.Readings(off, outputs=cal.outputs, up=UP))
    content = build_content(cal, check=found)
    assert any("bias_ax" in text for text in texts(content))


@pytest.fixture(scope="module")
def forms(cal):
    """The page of a calibration alone, its Markdown and its text."""
    content = build_content(cal)
    return tuple(write(content) for write in (html_report, markdown_report, plain_report))


def test_what_is_not_stated_is_not_there(forms):
    for text in forms:
        assert "Administrative data" not in text
        assert "Signature" not in text


LAB = """\
[report]
number = "17 \\";} </style><b>"
authorised_by = "N. N."
[[equipment]]
name = "rotary table"
serial = "7"
due = 2027-01-01
[[equipment]]
name = "voltmeter"
"""


@pytest.mark.usefixtures("without_drawing")
def test_equipment_signature_and_the_number_on_every_page(cal, tmp_path):
    (tmp_path / "lab.toml").write_text(LAB, encoding="utf-8")
    content = build_content(cal, lab=tmp_path / "lab.toml")
    tables = {t.caption: t.rows for part in content.sections for t in part.tables}
    assert [row[0] for row in tables["Equipment used"]] == ["rotary table", "voltmeter"]
    assert tables["Equipment used"][0][4] == "2027-01-01"
    assert tables["Signed by"][0] == ("Authorised by", "N. N.")
    page = html_report(content)
    assert 'counter(page) " / " counter(pages)' in page
    (running,) = re.findall(r"@bottom-left { content: (.*); }", page)
    assert running.startswith('"Calibration report 17 ')
    assert not re.search(r'["<>{}]', running[1:-1])
    (tmp_path / "bad.toml").write_text('[[equipment]]\ncolour = "red"\n', encoding="utf-8")
    with pytest.raises(mp.MultiposError, match=r"\[\[equipment\]\]: unknown key 'colour'"):
        build_content(cal, lab=tmp_path / "bad.toml")


def test_readings_stand_as_they_were_measured(cal):
    annex = build_content(cal).sections[-1]
    (table,) = (t for t in annex.tables if "Readings as" in t.caption)
    assert table.header == ("Position", "ax [g]", "ay [g]", "az [g]")
    shown = np.array([[float(cell) for cell in row[1:]] for row in table.rows])
    assert np.abs(shown - values()).max() < 1e-5  # two digits below a noise of 2e-4


def test_what_the_gauge_fixed_is_left_out(unknown):
    content = build_content(unknown)
    names = [row[0] for row in content.result.tables[0].rows]
    assert "Offset of az" in names
    assert not any("Mounting" in name for name in names)
    text = plain_report(content)
    assert "Mounting, rotation" not in text
    assert "Output on x, tilt to y" not in text
    assert "Output on y, tilt to x" in text


def test_numbers_in_a_page():
    assert beside(-0.0202347, 0.00017, 0.00035) == ("-0.02023", "0.00035")
    assert beside(1.0, 0.0, 0.0) == ("1", "-")
    assert [in_unit(size, "g") for size in (0.0336, 2.5e-4, 1.25, 0.0)] == [
        "33.6 mg",
        "250 µg",
        "1.25 g",
        "0 g",
    ]
    assert readable("-1e-05") == "−1×10⁻⁵"
    assert readable("0.41(12)e-07") == "0.41(12)×10⁻⁷"
    assert readable("V/g^2") == "V/g²"
    assert readable("inf") == "∞"
    assert readable("1 + own^2 of 1e5a") == "1 + own^2 of 1e5a"
    table = PageTable("", ("a", "b"), (("x", "1.25"), ("y", "-3"), ("z", "10.5"), ("w", "-")))
    cells = [row[1] for row in aligned_rows(table)]
    assert cells == ["1.25", "−3\u2008\u2007\u2007", "10.5\u2007", "-"]


def test_a_page_has_no_number_in_letters(forms):
    page = re.sub(r"<svg.*?</svg>|<style>.*?</style>", "", forms[0], flags=re.DOTALL)
    cells = re.findall(r"<t[dh][^>]*>([^<]*)</t[dh]>", page)
    assert len(cells) > 300
    assert [c for c in cells if re.search(r"\de[-+]\d|^-\d|^inf$|/[a-z]+\^\d$", c)] == []


def test_arrows_are_errors_across_and_rings_errors_along(cal):
    """By hand: the largest error is .32 of a radius of 58, shared by its ring and its arrow."""
    picture = error_picture(cal)
    error = cal.compensate(values()) - UP
    size = np.linalg.norm(error, axis=1)
    assert f">after: largest {in_unit(size.max(), 'g')}<" in picture
    worst = int(np.argmax(size))
    along = float(error[worst] @ UP[worst])
    assert split_errors(cal, "after")[1][worst] == pytest.approx(along)
    radii = [float(r) for r in re.findall(r' r="([\d.]+)"', picture.partition("after")[2])]
    assert np.abs(np.array(radii) - (1.0 + 29.0 * 0.32 * abs(along) / size.max())).min() < 0.05
    arrows = re.findall(r'd="M([\d.]+) ([\d.]+)L([\d.]+) ([\d.]+)M', picture.partition("after")[2])
    x, y, to_x, to_y = np.array(arrows, dtype=float).T
    across = 58.0 * 0.32 * np.sqrt(size.max() ** 2 - along**2) / size.max()
    assert np.abs(np.hypot(to_x - x, to_y - y) - across).min() < 0.15  # coordinates to .1
    assert np.hypot(to_x - x, to_y - y).max() < 58.0 * 0.32 + 0.15


def test_there_is_no_before_where_nothing_says_what_a_reading_is_in_g(cal):
    """By hand: of 2.5 V + 1 V/g the largest error before is that zero, which is no error."""
    volts = mp.Readings(2.5 + values(), up=UP, unit="V")
    stated, bare = mp.fit(volts, nominal=(2.5, 1.0)), mp.fit(volts)
    before = re.search(r">before: largest [^<]+<", error_picture(cal))[0]
    assert before in error_picture(stated)
    assert "before" not in error_picture(bare)
    assert ">after: largest" in error_picture(bare)
    assert "error before" in plain_report(build_content(stated))
    assert "before" not in plain_report(build_content(bare)).lower()


def test_unknown_orientations_have_errors_along_alone(unknown):
    assert not split_errors(unknown, "before")[0].any()
    assert not split_errors(unknown, "after")[0].any()
    assert "L" not in re.sub(r"[^ML]", "", error_picture(unknown))


def test_dots_of_residuals_stand_where_they_are(cal):
    """By hand: a panel is 102 high, its middle at 59, and 36 units are the mark, beyond all."""
    picture = residual_picture(cal)
    heights = np.array(
        [float(y) for y in re.findall(r'<circle cx="[\d.]+" cy="([\d.]+)"', picture)]
    )
    left = np.sqrt(1.0 - cal.diagnostics.leverage)
    largest = np.maximum(np.abs(cal.residuals), 2.0 * cal.sd_of_readings * left).max(axis=0)
    marks = np.array([float(each) for each in re.findall(r">−([\d.]+)</text>", picture)])
    marks *= 10.0 ** np.round(np.log10(largest / marks))  # their unit
    assert (largest <= marks).all()
    assert (marks < 1.5 * largest).all()
    expected = 102 * np.arange(3) + 59.0 - 36.0 * cal.residuals / marks
    assert np.abs(heights.reshape(3, 26).T - expected).max() < 0.051
    named = _Picture(102)  # an output may be called so
    _draw_panel(named, 0, np.ones(1), ("{% raw %}", "V", np.ones(1), np.ones(1)))
    assert "{% raw %} [V]" in str(named)


@pytest.mark.usefixtures("without_drawing")
def test_paper_needs_the_extra_or_a_browser(cal, tmp_path, capsys, monkeypatch):
    cal.save(tmp_path / "c.json")
    monkeypatch.setattr("multipos.reports.paper.find_spec", lambda name: None)
    monkeypatch.setattr("multipos.reports.paper.which", lambda name: None)
    assert main(["report", str(tmp_path / "c.json"), "-o", str(tmp_path / "r.pdf")]) == 1
    assert "pip install 'multipos[pdf]'" in capsys.readouterr().err
    assert not (tmp_path / "r.pdf").exists()


@pytest.mark.parametrize("way", ["weasyprint", "browser"])
def test_paper(cal, tmp_path, monkeypatch, way):
    if way == "weasyprint":
        pytest.importorskip("weasyprint")
    elif browser.find() is None:
        pytest.skip("needs Chromium")
    else:
        monkeypatch.setattr("multipos.reports.paper.find_spec", lambda name: None)
    said = []
    made = pdf_report(build_content(cal), said.append)
    assert made.startswith(b"%PDF")
    assert len(made) < 1_000_000
    assert said  # that it goes on


def test_an_inclinometer_says_degrees_near_level():
    # 1 mg across the vertical is 1e-3 rad: .0573 degrees
    noise = 1e-3 * np.random.default_rng(1).standard_normal((len(UP), 2))
    cal = mp.fit(mp.Readings(UP[:, :2] + noise, outputs=("ax", "ay"), up=UP, unit="g"))
    said = build_content(cal).sentence
    size, unit, angle = re.search(r"([\d.]+) ([mµ]g) \(([\d.]+)° near level\)", said).groups()
    force = float(size) * {"mg": 1e-3, "µg": 1e-6}[unit]
    assert float(angle) == pytest.approx(np.degrees(force), rel=0.01)
    assert re.search(r"g \([\d.]+°\) of bias", said)


def test_residuals_of_all_outputs_have_one_unit():
    # of 3 mg and of 50 µg: each would be read in a unit of its own
    noise = np.random.default_rng(2).standard_normal(UP.shape) * [3e-3, 5e-5, 3e-3]
    cal = mp.fit(mp.Readings(UP + noise, outputs=("ax", "ay", "az"), up=UP, unit="g"))
    tables = [each for section in build_content(cal).sections for each in section.tables]
    header = next(each.header for each in tables if each.caption.startswith("Residuals at"))
    assert header[1:4] == ("ax [mg]", "ay [mg]", "az [mg]")
