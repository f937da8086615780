"""Reports: what they say, that they say it the same every time, and the page in a real browser."""

import html.parser
import json
import re
from dataclasses import replace

import browser
import numpy as np
import pytest
from findings_bench import texts

import multipos as mp
from multipos import plots
from multipos.cli import main
from multipos.files.numbers import in_unit, markdown_text, plain_number
from multipos.finding import Finding
from multipos.positions.scheme import read_scheme
from multipos.reports.certificate import build_content
from multipos.reports.check_text import check_text
from multipos.reports.documents import html_report, markdown_report, plain_report
from multipos.reports.readable import readable
from multipos.reports.summary import text_report
from multipos.results import plain
from multipos.uncertainty.propagation import evaluate_budget
from multipos.verification.comparison import compare

BUDGET = {
    "gravity": {"value": 9.80123, "u": 2e-5},
    "level": {"u_deg": 0.002},
    "gain": {"U": 1e-5, "k": 2},
    "orientation": {"u_deg": 0.0003},
    "third_order": {"half_width": 1e-4},
}
needs_browser = pytest.mark.skipif(browser.find() is None, reason="no Chromium is installed")


@pytest.fixture(scope="module")
def calibration():
    rng = np.random.default_rng(5)
    scheme = read_scheme("roll-y-12+roll-x-12")
    values = scheme.up @ np.diag([1.002, 0.998, 1.001]) + [0.01, -0.02, 0.015]
    values += 2e-5 * rng.standard_normal(values.shape)
    values[7, 1] += 1e-3  # an outlier, for the warnings
    readings = mp.Readings(values, unit="g", positions=scheme.labels)
    as_listed = {"orientation_sd": 0, "exclude": "none"}
    return mp.fit(readings, scheme=scheme, model="own-quadratic", budget=BUDGET, **as_listed)


@pytest.fixture(scope="module")
def six():
    return mp.demo().calibration


@pytest.fixture(scope="module")
def page(calibration):
    return html_report(build_content(calibration))


class Outline(html.parser.HTMLParser):
    """Headings, ids, tables and what refers to elsewhere."""

    def __init__(self, text):
        super().__init__()
        self.headings, self.ids, self.links, self.open = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        if re.fullmatch("h[1-6]", tag):
            self.headings.append(int(tag[1]))
        if "id" in given:
            self.ids.append(given["id"])
        self.links += [value for name, value in attributes if name in ("src", "href", "xlink:href")]
        assert tag != "script"
        if tag == "svg":
            assert given["role"] == "img"
            assert given["aria-label"]


def test_the_page_stands_alone(page):
    outline = Outline(page)
    assert outline.headings[0] == 1
    assert all(b - a <= 1 for a, b in zip(outline.headings, outline.headings[1:], strict=False))
    assert len(outline.ids) == len(set(outline.ids))
    inside = ("#", "data:,", "data:image/png;base64,")  # the colours of a map are an image
    assert all(link.startswith(inside) for link in outline.links)
    assert "http" not in re.sub(r'xmlns(:xlink)?="[^"]*"|base64,[^"]*', "", page)
    assert page.index('class="answer') < page.index('id="findings"') < page.index('id="section-0"')
    assert page.count("<figure tabindex") == page.count("<figcaption>") == page.count("<svg ") == 4
    assert 'lang="en"' in page


@pytest.mark.parametrize("ending", ["html", "md", "txt"])
def test_the_same_calibration_gives_the_same_bytes(six, ending, tmp_path):
    files = [tmp_path / f"{i}.{ending}" for i in range(2)]
    six.save(tmp_path / "c.json")
    mp.report(six, files[0])
    mp.report(mp.load(tmp_path / "c.json"), files[1])
    one, two = (file.read_bytes() for file in files)
    assert one == two


def test_numbers_of_the_parameters_table(six):
    table, installation = build_content(six).sections[0].tables
    lean = {row[0]: row for row in installation.rows}["Output on x, tilt to y"]
    assert lean[3] == "°"
    assert float(lean[1]) == pytest.approx(six.installation_deg["xy"]["value"], rel=0.01)
    row = table.rows[0]
    p = six["ax", "1"]
    assert row[:3] == ("bias_ax", "a_x0", "output of ax at zero specific force")
    assert row[3:5] == ("-0.79", "0.52")
    assert row[6] == "mg"
    expected = (1e3 * p.u, 1e3 * p.U, p.k)
    assert (float(row[4]), float(row[5]), float(row[7])) == pytest.approx(expected, rel=0.05)
    assert row[8] == "1"


def test_numbers_of_the_sensor(six):
    (table,) = build_content(six).result.tables
    rows = {row[0]: row for row in table.rows}
    offset = six.intrinsic["offset"]["ay"]
    _, value, U, unit, k = rows["Offset of ay"]
    assert (unit, k) == ("mg", "12.7")
    assert float(value) == pytest.approx(1e3 * offset["value"], abs=0.1)
    # one degree of freedom: U = 12.7 u
    assert float(U) == pytest.approx(12.706e3 * offset["u"], rel=0.05)


def test_numbers_of_the_budget(calibration):
    section = build_content(calibration).sections[1]
    lines, contributions = section.tables
    assert [row[0] for row in lines.rows] == [
        "residual noise without common causes",
        "local gravity",
        "level of the table, two axes",
        "gain of the ADC or voltmeter",
        "orientation of each position",
    ]
    assert lines.rows[3][3:5] == ("5", "ppm")
    assert lines.rows[4][7] == "in the residuals"
    i = calibration.names.index("scale_ax")
    row = contributions.rows[i]
    budget = {r.quantity: r.contribution[i] for r in evaluate_budget(calibration).rows[1:]}
    assert row[-1] == "ppm"
    assert float(row[2]) == pytest.approx(1e6 * budget["gravity"], rel=0.05)
    assert row[5].startswith("(")
    assert float(row[-2]) == pytest.approx(1e6 * calibration.u[i], rel=0.05)
    assert "periodic error of the dividing head" in section.paragraphs[1]


def test_shares_of_the_variance_add_up(calibration):
    quantities, share = plots.variance_shares(evaluate_budget(calibration))
    assert quantities == ["readings", "gravity", "level", "gain", "orientation"]
    assert share.sum(axis=0) == pytest.approx(np.full(15, 100.0))


def test_errors_before_and_after(calibration):
    c = calibration
    before = np.linalg.norm(c.readings.values - c.reference, axis=1)
    assert plots.nominal_error(c) == pytest.approx(before)
    after = c.compensate(c.readings.values) - c.reference
    assert plots.compensated_error(c) == pytest.approx(np.linalg.norm(after, axis=1))
    volts = mp.fit(mp.Readings(2.0 * read_scheme("faces-6").up, unit="V"), scheme="faces-6")
    assert plots.nominal_error(volts) == pytest.approx(np.zeros(6), abs=1e-15)


def test_before_of_an_unknown_orientation_is_the_error_of_the_size():
    up = read_scheme("fibonacci-24").up
    noise = 1e-4 * np.random.default_rng(1).standard_normal(up.shape)
    values = [0.03, -0.02, 0.01] + up * [1.02, 0.98, 1.01] + noise
    c = mp.fit(mp.Readings(values, unit="g"), unknown_orientation=True)
    along = np.einsum("ni,ni->n", values - c.reference, c.reference)  # of 1 g
    assert plots.nominal_error(c) == pytest.approx(np.abs(along), abs=1e-12)
    rms = np.sqrt(np.mean(plots.nominal_error(c) ** 2))
    assert f"rms error {in_unit(rms, 'g')} before" in build_content(c).sentence


def displaced(seed=6):
    """Readings at 24 positions off by .1 degrees about each axis, one of them of another place."""
    rng = np.random.default_rng(seed)
    up = mp.read_scheme("fibonacci-24").up
    off = up + np.cross(np.radians(0.1) * rng.standard_normal(up.shape), up)
    off /= np.linalg.norm(off, axis=1)[:, None]
    values = off @ np.diag([1.002, 0.998, 1.001]) + [0.01, -0.02, 0.015]
    values += 1e-4 * rng.standard_normal(values.shape)
    values[7] += [0.02, 0.02, 0.0]
    return mp.Readings(values, unit="g", positions=[f"p{i}" for i in range(24)], up=up)


@pytest.fixture(scope="module")
def estimated():
    return mp.fit(displaced())


@pytest.mark.usefixtures("without_drawing")
def test_orientation_errors_that_were_estimated_stand_in_the_report(estimated, tmp_path):
    found = estimated.variance_components.orientation_sd_deg
    assert found.low < 0.1 < found.high  # which 68 % of such sets hold
    content = build_content(estimated)
    assert "calibrated from 23 of 24 positions: " in content.sentence
    sections = {section.title: section for section in content.sections}
    checks = dict(sections["Checks"].tables[0].rows)
    ends = f"68 %: {found.low:.2g} to {found.high:.2g}"
    assert checks["orientation errors (1 sigma)"] == f"{found.value:.2g} degrees ({ends})"
    budget = sections["Uncertainty budget"]
    assert budget.tables[0].rows[0][0] == "residual noise and orientation errors"
    assert "orientation of each position" not in budget.paragraphs[1]
    assert "no turn of its position explains" in sections["Residuals"].paragraphs[0]
    notes = sections["Validity"].paragraphs
    assert any(f"orientation errors of {found.value:.2g} degrees" in note for note in notes)
    assert any(note.startswith("1 of 24 positions set aside: p7 (") for note in notes)
    estimated.save(tmp_path / "cal.json")
    again = build_content(mp.load(tmp_path / "cal.json"))
    assert plain_report(again) == plain_report(content)


def test_exact_orientations_have_no_errors_in_the_report(six):
    sections = {section.title: section for section in build_content(six).sections}
    assert "orientation errors" not in str(sections["Checks"].tables[0])
    assert "orientation of each position" in sections["Uncertainty budget"].paragraphs[1]


def test_warnings_stand_on_top(calibration, page):
    content = build_content(calibration)
    assert any("position 8" in text for text in texts(content))
    assert page.index("position 8 (") < page.index("Sensitivity, offset and axes")


def test_beyond_one_g_is_marked(calibration, six):
    (table,) = build_content(calibration).sections[2].tables
    assert [row[1] for row in table.rows if row[0] == "force along x"] == ["1 g", "2 g *", "5 g *"]
    said = build_content(six).sections[2].paragraphs  # six faces hide terms between them, too
    assert any("is not included in U between them" in text for text in said)


@pytest.mark.usefixtures("without_drawing")
def test_markdown_and_text_say_what_the_page_says(calibration, tmp_path):
    for ending, show in (("md", markdown_text), ("txt", str)):
        mp.report(calibration, tmp_path / f"r.{ending}")
        text = (tmp_path / f"r.{ending}").read_text("utf-8")
        for section in build_content(calibration).sections:
            assert section.title in text
            for table in section.tables:
                assert table.caption in text
                for row in table.rows:
                    assert all(show(readable(cell)) in text for cell in row)


LAB = """\
[report]
number = "CAL-17"
issued = 2026-11-21
[laboratory]
name = "A & B <Laboratory>"
[item]
serial = 42
"""


def test_the_laboratory_fills_the_fields(six, tmp_path):
    (tmp_path / "lab.toml").write_text(LAB, encoding="utf-8")
    content = build_content(six, lab=tmp_path / "lab.toml")
    said = dict(content.fields)
    assert said["Report number"] == "CAL-17"
    assert said["Date of issue"] == "2026-11-21"
    assert said["Serial number"] == "42"
    assert "Metrological traceability" not in said
    page = html_report(content)
    assert "<h1>Calibration report CAL-17</h1>" in page
    assert "A &amp; B &lt;Laboratory&gt;" in page
    assert page.count("<dt>") == 4
    assert "Administrative data" not in html_report(build_content(six))


@pytest.mark.parametrize(
    ("options", "status", "message"),
    [
        (["-o", "r.svg"], 2, "-o r.svg: this command does not write .svg files"),
        ([], 2, "report needs -o REPORT.html"),
        (["-o", "r.html", "--lab", "none.toml"], 1, "no such file"),
        (["-o", "r.html", "--lab", "bad.toml"], 1, "bad.toml: not valid TOML"),
        (["-o", "r.html", "--lab", "section.toml"], 1, "unknown section [lab]"),
        (["-o", "r.html", "--lab", "key.toml"], 1, "[item]: unknown key 'colour'"),
        (["-o", "no/folder/r.html"], 1, "cannot write"),
    ],
)
def test_command_lines_at_fault(six, options, status, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    six.save("c.json")
    (tmp_path / "bad.toml").write_text("[report", encoding="utf-8")
    (tmp_path / "section.toml").write_text("[lab]\nname = 'x'", encoding="utf-8")
    (tmp_path / "key.toml").write_text("[item]\ncolour = 'x'", encoding="utf-8")
    before = sorted(tmp_path.iterdir())
    assert main(["report", "c.json", *options]) == status
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines()[-1].startswith("multipos: error: ")
    assert message in err
    assert sorted(tmp_path.iterdir()) == before


def test_the_command_says_what_it_wrote(six, tmp_path, capsys):
    six.save(tmp_path / "c.json")
    target = str(tmp_path / "r.html")
    assert main(["report", str(tmp_path / "c.json"), "-o", target, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["report"] == target


def many_positions(count):
    up = mp.read_scheme(f"fibonacci-{count}").up
    values = up + 1e-4 * np.random.default_rng(1).normal(size=up.shape)
    values[7, 1] += 0.01
    return mp.Readings(values, up=up)


@pytest.mark.usefixtures("without_drawing")
def test_long_tables_show_their_largest_rows(tmp_path, capsys):
    as_listed = {"orientation_sd": 0, "exclude": "none"}
    all_of_them, long = (mp.fit(many_positions(count), **as_listed) for count in (24, 101))
    assert "\n17 " in text_report(all_of_them)
    assert "24 largest" not in text_report(all_of_them)
    title = "Residuals at every position (the 24 largest of 101; --json has all)\n"
    residuals = text_report(long).partition(title)[2].partition("\nLinearity")[0]
    heads = [line.split()[0] for line in residuals.strip().splitlines()[1:]]
    assert (heads[:2], heads[-2:], len(heads)) == (["Position", "8"], ["s", "dof"], 27)
    assert len(long.to_dict()["residuals"]) == 101
    *body, annex = build_content(long).sections
    tables = [t for part in body for t in part.tables if "largest of" in t.caption]
    said = " (the 24 largest of 101; all in the annex)"
    names = [
        "Residuals at every position",
        "Up vector and leverage of every position",
        "Readings as measured",
        "Influence of each position: studentised residual r, Cook's D, leave-one-out error e",
    ]
    assert [table.caption.removesuffix(said) for table in tables] == names
    covariance, *annexed = annex.tables
    assert float(covariance.rows[4][5]) == pytest.approx(long.covariance[4, 4], rel=5e-3)
    assert [table.caption for table in annexed] == names
    for table, whole in zip(tables, annexed, strict=True):
        assert (len(table.rows), len(whole.rows)) in ((24, 101), (26, 103))
        assert (table.rows[0][0] == "8") is not table.caption.startswith("Up vector")
        assert set(table.rows) <= set(whole.rows)
    long.save(tmp_path / "c.json")
    found = mp.check(long, many_positions(101))
    assert "Every position (the 24 largest of 101; JSON has all)" in check_text(found)
    assert len(found.to_dict()["positions"]) == 101
    content = build_content(long, check=found)
    assert "Every position (the 24 largest of 101; all in the annex)" in html_report(content)


def test_the_check_by_monte_carlo_is_reported(calibration, tmp_path, capsys):
    calibration.save(tmp_path / "c.json")
    argv = ["report", str(tmp_path / "c.json"), "-o", str(tmp_path / "r.md")]
    assert main([*argv, "--monte-carlo", "20000"]) == 0
    assert capsys.readouterr().err == ""  # no bar where there is no terminal
    text = (tmp_path / "r.md").read_text("utf-8")
    assert "Monte Carlo, 20000 trials" in text
    assert text.count("| yes |") >= 15
    capsys.readouterr()
    for trials in ("3", "1000001", "1000000000"):
        assert main([*argv, "--monte-carlo", trials]) == 2
        assert f"between 100 and 1000000, got {trials};" in capsys.readouterr().err


def test_labels_of_positions_are_escaped(six):
    spoilt = replace(six, readings=replace(six.readings, positions=tuple("<b>&\"'")))
    page = html_report(build_content(spoilt))
    assert "<b>" not in page
    assert "&lt;" in page


def test_figures_take_an_axes_and_draw_on_nothing_else(calibration):
    figure, axes = plots.new_figure(5)
    for one, draw in zip(
        axes,
        (
            lambda a: plots.draw_residuals(calibration, a, output="ay"),
            lambda a: plots.draw_errors(calibration, a),
            lambda a: plots.draw_budget(evaluate_budget(calibration), a),
            lambda a: plots.draw_runs(compare(calibration, calibration), a),
            lambda a: plots.draw_runs(compare(calibration, calibration), a, term="x"),
        ),
        strict=True,
    ):
        assert draw(one) is None
        assert one.has_data()
    assert len(figure.axes) == 5


def test_residuals_are_drawn_where_they_are(calibration):
    _, (axes,) = plots.new_figure()
    plots.draw_residuals(calibration, axes, output="az")
    series = next(line for line in axes.lines if line.get_label() == "az")
    assert series.get_ydata() == pytest.approx(calibration.residuals[:, 2])


# --- the bench: rolls, and an independent run


def rolled(scheme, seed, **options):
    """A pair in volts along rolls, as `fit` takes it."""
    up = read_scheme(scheme).up
    values = 2.5 + up @ [[1.0, 0.02], [-0.02, 1.0], [0.0, 0.0]]
    values += 1e-4 * np.random.default_rng(seed).standard_normal(values.shape)
    return mp.Readings(values, outputs=("Ux", "Uy"), unit="V"), {"scheme": scheme} | options


@pytest.fixture(scope="module")
def pair():
    readings, options = rolled("roll-y-12+roll-x-12", 1, inputs="x,y")
    return mp.fit(readings, **options)


@pytest.fixture(scope="module")
def checked(pair, tmp_path_factory):
    """The check of the pair by the command, and the file it was written to."""
    folder = tmp_path_factory.mktemp("checked")
    pair.save(folder / "cal.json")
    readings, _ = rolled("roll-y-12+roll-x-12", 2)
    rows = "\n".join(f"{x!r},{y!r}" for x, y in readings.values.tolist())
    (folder / "run.csv").write_text(f"Ux,Uy\n{rows}\n", encoding="utf-8")
    argv = ["check", str(folder / "cal.json"), str(folder / "run.csv"), "--nominal", "2.5,1"]
    argv += ["--scheme", "roll-y-12+roll-x-12", "--limit-deg", "0.1", "--within-deg", "60"]
    assert main([*argv, "-o", str(folder / "check.json")]) == 0
    return folder


def section(content, title):
    return next(part for part in content.sections if part.title == title)


def test_rolls_are_in_the_report(pair):
    found = section(build_content(pair), "Rolls")
    assert [figure.caption for figure in found.figures] == [
        "Signal against angle",
        "Residual harmonics",
    ]
    for figure, unit in zip(found.figures, ("V", "µV"), strict=True):
        assert f"Ux [{unit}]" in figure.draw()
    rows = {row[:2]: row for row in found.tables[0].rows}
    errors = {(e.plane, e.quantity): e for e in mp.table_errors(pair).errors}
    value, u = errors["xz", "second_cos"].value_deg, errors["xz", "second_cos"].u_deg
    shown = float(rows["xz", "second cos"][2].split("(")[0])
    assert shown == pytest.approx(value, abs=u / 10)
    assert "bias_Ux" in rows["xz", "first sin"][4]
    assert found.tables[1].caption == "Zero between rolls"


def test_installation_angles_and_turntable_are_in_the_summary(pair, six):
    text = text_report(pair)
    (line,) = (each for each in text.splitlines() if each.startswith("Output on x, tilt to y"))
    theta = pair.installation_deg["xy"]
    assert float(line.split()[6]) == pytest.approx(theta["value"], abs=theta["u"])
    for title in ("Installation", "Turntable", "Zero between rolls"):
        assert f"\n{title}\n{'-' * len(title)}\n" in text
    assert "\nTurntable\n" not in text_report(six)  # six positions are no roll
    assert "Rolls" not in [part.title for part in build_content(six).sections]


def test_a_short_tumble_has_its_signal_in_the_report():
    t = np.pi / 2 * np.arange(4)
    found = mp.fit({"E": 0.1 + np.cos(t)}, scheme="tumble-4", inputs="x", reading_sd=1e-4)
    (figure,) = section(build_content(found), "Rolls").figures  # too few for harmonics
    assert figure.caption == "Signal against angle"


def test_unknown_orientations_have_no_rolls():
    values = read_scheme("roll-y-12+roll-x-12+faces-corners-14").up * 1.01 + 0.01
    found = mp.fit(mp.Readings(values, unit="g"), unknown_orientation=True)
    assert "Rolls" not in [part.title for part in build_content(found).sections]


def test_a_check_survives_its_file(checked):
    argv = {
        "scheme": "roll-y-12+roll-x-12",
        "limit_deg": 0.1,
        "within_deg": 60,
        "nominal": (2.5, 1),
    }
    made = mp.check(mp.load(checked / "cal.json"), checked / "run.csv", **argv)
    assert mp.load_check(checked / "check.json").to_dict() == made.to_dict()
    assert json.loads((checked / "check.json").read_text("utf-8")) == plain(made.to_dict())


@pytest.mark.parametrize("ending", ["html", "md", "txt"])
def test_the_check_is_in_the_report(checked, ending, capsys):
    target = checked / f"report.{ending}"
    argv = ["report", str(checked / "cal.json"), "--check", str(checked / "check.json")]
    assert main([*argv, "-o", str(target)]) == 0
    text = target.read_text("utf-8")
    found = mp.load_check(checked / "check.json")
    for said in (
        "Independent check",
        "run.csv",
        "Verdict against 0.1°: pass",
        "max before [°]",
        plain_number(found.summary("x")["after"]["maximum"]),
        "Every position",
    ):
        assert said in re.sub(r"\s+", " ", text)
    if ending == "html":
        assert "limit ±0.1°" in text


def test_checks_that_a_report_refuses(checked, six, tmp_path, capsys):
    six.save(tmp_path / "six.json")
    kept = json.loads((checked / "check.json").read_text("utf-8"))
    files = {
        "regression.json": kept | {"against": "temperature"},
        "other.json": kept | {"calibration": "2001-01-01T00:00:00Z"},
        "damaged.json": {k: v for k, v in kept.items() if k != "by_axis"},
        "spoilt.json": kept
        | {"positions": [{**kept["positions"][0], "after": {"x": "a", "y": 0}}]},
    }
    for name, content in files.items():
        (tmp_path / name).write_text(json.dumps(content), encoding="utf-8")
    for name, message in (
        ("regression.json", "the check of a regression"),
        ("other.json", "the check is of a calibration created 2001-01-01T00:00:00Z"),
        ("damaged.json", "the key 'by_axis' is missing"),
        ("spoilt.json", "positions[0].after.x is 'a'; a number is needed there"),
        ("six.json", "a calibration is read by multipos.load"),
        ("none.json", "no such file"),
    ):
        argv = ["report", str(checked / "cal.json"), "--check", str(tmp_path / name)]
        assert main([*argv, "-o", str(tmp_path / "r.html")]) == 1
        out, err = capsys.readouterr()
        assert out == ""
        assert message in err.splitlines()[-1]
        assert not (tmp_path / "r.html").exists()


# px of the smallest label of a figure, and the captions of tables that are wider than the page
SMALLEST_LABEL = """Math.min(...[...document.querySelectorAll('figure svg text')]
  .filter(text => text.textContent.trim())
  .map(text => parseFloat(getComputedStyle(text).fontSize) * Math.abs(text.getScreenCTM().a
    || text.getScreenCTM().b)))"""
SCROLLED = """[...document.querySelectorAll('.scroll')]
  .filter(box => box.scrollWidth > box.clientWidth + 1).map(box => box.ariaLabel)"""


@needs_browser
def test_the_page_in_a_browser(calibration, tmp_path):
    target = tmp_path / "report.html"
    target.write_text(html_report(build_content(calibration)), encoding="utf-8")
    with browser.browse(tmp_path) as page:
        for view in ({}, {"dark": True}, {"width": 380}, {"media": "print"}):
            page.open(target, **view)
            assert page.complaints() == []
            fetched = [one for one in page.requests() if not one.startswith("data:image/png")]
            assert fetched == [target.as_uri()]
            width = page.evaluate("document.documentElement.scrollWidth")
            assert width <= page.evaluate("innerWidth")
            assert page.evaluate("document.querySelectorAll('figure svg[aria-label]').length") == 4
        page.open(target, width=390)
        assert page.evaluate(SMALLEST_LABEL) >= 9.0
        assert page.evaluate(SCROLLED) == []
        levels = page.evaluate(
            "[...document.querySelectorAll('h1,h2,h3,h4')].map(h => +h.tagName[1]).join('')"
        )
        assert re.fullmatch("12+", levels)
        page.open(target, dark=True)
        ink = page.evaluate("getComputedStyle(document.querySelector('figure svg text')).fill")
        assert ink == "rgb(236, 236, 236)"
        page.pdf(tmp_path / "report.pdf")
        # A4 in points: 595 × 842
        assert b"/MediaBox [0 0 59" in (tmp_path / "report.pdf").read_bytes()


MARKS = "<script>x</script>|`a`*b*"
HOSTILE = MARKS + "\x1b[31m\u202e"


def test_no_text_from_outside_acts_in_a_report(six):
    spoilt = replace(
        six,
        created=HOSTILE,
        criterion=HOSTILE,
        model=replace(six.model, unit=MARKS),
        diagnostics=replace(six.diagnostics, findings=(Finding("hostile", "warning", HOSTILE),)),
    )
    lab = {
        "report": {"number": HOSTILE},
        "customer": {"name": HOSTILE, "address": f"Street\n# City\n{HOSTILE}"},
    }
    content = build_content(spoilt, lab=lab)
    page, markdown, plain_text = (
        write(content) for write in (html_report, markdown_report, plain_report)
    )
    for text in (page, markdown, plain_text):
        assert "\x1b" not in text
        assert "\u202e" not in text
    for text in (page, markdown):
        assert "<script" not in text
        assert "&lt;script&gt;x&lt;/script&gt;" in text
    assert r"\|\`a\`\*b\*" in markdown
    assert re.search(r"(?<!\\)`", markdown) is None
    assert "Street\\\n  \\# City\\\n  " in markdown
    assert "Street\n  # City\n  " in plain_text
    assert [line for line in markdown.splitlines() if re.match(r"\s*(- )?#\s*\W?[<&]", line)] == []


def test_control_characters_reach_no_terminal(six, tmp_path, capsys):
    six.save(tmp_path / "cal.json")
    (tmp_path / "r.csv").write_text("position,ax\n\x1b[31m,\x1b[32m\n")
    assert main(["fit", str(tmp_path / "r.csv")]) == 1
    (tmp_path / "bad.json").write_text('{"schema": "\\u001b[31m"}')
    assert main(["report", str(tmp_path / "bad.json"), "-o", str(tmp_path / "r.txt")]) == 1
    assert main(["fit", str(tmp_path / "r.csv"), "--outputs", "ax"]) == 1
    out, err = capsys.readouterr()
    assert "\x1b" not in out + err
