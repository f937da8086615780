"""Tables as people write them: faces in any words, no header, angles alone, marks in numbers."""

import numpy as np
import pytest

import multipos as mp
from multipos.errors import MultiposError
from multipos.reports.summary import calibration_sentence

UP = np.array([(0, 0, 1), (0, 0, -1), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)], dtype=float)
MATRIX = np.array([[9.72, -0.03, 0.03], [0.04, 9.85, 0.03], [-0.05, 0.02, 10.04]])
BIAS = np.array([0.41, -0.19, -0.37])
READ = UP @ MATRIX.T + BIAS

WORDS = {
    "signs": ("+Z", "-Z", "+X", "-X", "+Y", "-Y"),
    "signs behind": ("Z+", "Z-", "X+", "X-", "Y+", "Y-"),
    "up and down": ("Z up", "Z down", "x up", "x DOWN", "Y UP", "y down"),
    "glued": ("zup", "zdown", "xup", "xdown", "yup", "ydown"),
    "words before": ("pos z", "neg z", "pos x", "neg x", "plus y", "minus y"),
    "underscores": ("z_pos", "z_neg", "x_pos", "x_neg", "y_pos", "y_neg"),
    "both": ("+Z up", "-Z up", "-X down", "+X down", "+Y up", "-Y up"),
    "hyphens": ("Z-up", "Z-down", "UP-X", "DOWN-X", "y-pos", "y-neg"),
    "arrows, top, French": ("Z↑", "Z↓", "X top", "X bottom", "y haut", "y bas"),
    "minus signs": ("+z", "\N{MINUS SIGN}z", "+x", "\N{MINUS SIGN}x", "+y", "\N{MINUS SIGN}y"),
    "Chinese": ("Z朝上", "Z朝下", "X轴向上", "X轴向下", "Y上", "Y下"),
    "German": ("z oben", "z unten", "x oben", "x unten", "y oben", "y unten"),
    "where each points": ("E-N-U", "N-E-D", "U-E-N", "D-E-S", "N-U-E", "E-D-N"),
}


def table(path, labels, name="face", values=READ):
    rows = [
        f"{label},{','.join(map(repr, row))}"
        for label, row in zip(labels, values.tolist(), strict=True)
    ]
    path.write_text("\n".join([f"{name},ax,ay,az", *rows]) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize("words", WORDS)
def test_faces_are_read_in_any_words(words, tmp_path):
    readings = mp.read_readings(table(tmp_path / "six.csv", WORDS[words]))
    assert readings.up == pytest.approx(UP)
    assert readings.labels == WORDS[words]


@pytest.mark.parametrize(
    "name", ["face", "pose", "orientation", "position", "Lage", "位置", "取向", "方向"]
)
def test_faces_are_read_under_any_name(name, tmp_path):
    found = mp.fit(table(tmp_path / "six.csv", WORDS["signs"], name), unit="m/s^2")
    assert found.parameters == pytest.approx(
        [BIAS[0], *MATRIX[0], BIAS[1], *MATRIX[1], BIAS[2], *MATRIX[2]], abs=1e-12
    )


def test_up_and_down_alone_are_those_of_z(tmp_path):
    path = tmp_path / "two.csv"
    path.write_text("face,az\nup,1.02\ndown,-0.98\n", encoding="utf-8")
    assert mp.read_readings(path).up == pytest.approx(np.array([(0, 0, 1), (0, 0, -1)]))


@pytest.mark.parametrize("cell", ["X", "xyz", "+X-", "up", "E-E-U", "", "+W"])
def test_a_column_with_a_cell_that_is_no_direction_is_none(cell, tmp_path):
    labels = (*WORDS["signs"][:5], cell)
    assert mp.read_readings(table(tmp_path / "six.csv", labels)).up is None


def test_labels_that_contradict_a_scheme_show_the_first(tmp_path):
    path = table(tmp_path / "six.csv", WORDS["signs"])
    with pytest.raises(MultiposError, match=r"row 1, '\+Z'.*as position '1' of scheme 'faces-6'"):
        mp.fit(path, scheme="faces-6")
    order = [2, 3, 4, 5, 0, 1]
    labels = [WORDS["signs"][i] for i in order]
    path = table(tmp_path / "six.csv", labels, values=READ[order])
    assert mp.fit(path, scheme="faces-6").parameters[0] == pytest.approx(BIAS[0])


@pytest.mark.parametrize(
    ("order", "way"),
    [
        (
            [2, 3, 4, 5, 0, 1],
            r"\+X, -X, \+Y, -Y, \+Z, -Z: type multipos fit six.csv --scheme faces-6",
        ),
        ([0, 1, 2, 3, 4, 5], r"\+Z, -Z, .* into a column face and type multipos fit six.csv"),
    ],
)
def test_six_readings_without_names_get_the_line_to_type(order, way, tmp_path):
    path = tmp_path / "six.csv"
    np.savetxt(path, READ[order], delimiter=",")
    with pytest.raises(MultiposError, match=way):
        mp.fit(path)
    if order[0] == 2:
        assert mp.fit(path, scheme="faces-6").parameters[0] == pytest.approx(BIAS[0])


def test_three_axes_at_plus_and_minus_one_g_get_the_rows_to_write(tmp_path):
    path = tmp_path / "pairs.csv"
    path.write_text("axis,+1 g,-1 g\nx,1.02,-0.98\ny,1.0,-0.99\nz,1.01,-0.97\n", encoding="utf-8")
    with pytest.raises(MultiposError, match=r"face,ax,ay,az.* multipos fit pairs.csv"):
        mp.fit(path)


@pytest.mark.parametrize("name", ["angle_deg", "angle"])
@pytest.mark.parametrize(
    ("outputs", "axes"),
    [("ax,ay", (0, 1)), ("ay,az", (1, 2)), ("ax,az", (0, 2)), ("az,ax", (2, 0))],
)
def test_angles_alone_turn_about_the_axis_that_is_missing(name, outputs, axes, tmp_path):
    """Output 1 is b + s cos t, output 2 b + s sin t, by hand."""
    angles = np.arange(0.0, 360.0, 45.0)
    first = 0.02 + 1.01 * np.cos(np.radians(angles))
    second = -0.01 + 0.99 * np.sin(np.radians(angles))
    path = tmp_path / "roll.csv"
    columns = np.column_stack([angles, first, second])
    np.savetxt(path, columns, delimiter=",", header=f"{name},{outputs}", comments="")
    found = mp.fit(path)
    one, two = outputs.split(",")
    assert found[f"bias_{one}"].value == pytest.approx(0.02)
    assert found[f"scale_{one}"].value == pytest.approx(1.01)
    assert found[f"bias_{two}"].value == pytest.approx(-0.01)
    assert found[f"scale_{two}"].value == pytest.approx(0.99)
    assert found.readings.plane == tuple("xyz"[i] for i in sorted(axes))


GERMAN = "Position;ax;ay;az\n1;-3.224;-4.945;16.586\n2;8.072;-14.920;-246\n3;931;-13.164;-9.492\n"


def test_points_between_thousands_are_known_by_the_column(tmp_path):
    """The second output is never below 1,000 and follows the others."""
    path = tmp_path / "de.csv"
    path.write_text(GERMAN, encoding="utf-8")
    readings = mp.read_readings(path)
    assert readings.values.tolist() == [
        [-3224, -4945, 16586],
        [8072, -14920, -246],
        [931, -13164, -9492],
    ]
    assert any("points in ax, ay, az stand between thousands" in f.text for f in readings.findings)


def test_a_temperature_with_three_decimals_stays_what_it_is(tmp_path):
    lines = GERMAN.splitlines()
    with_it = [
        f"{line};{end}"
        for line, end in zip(lines, ("temperature", "25.312", "25.401", "26.000"), strict=True)
    ]
    path = tmp_path / "de.csv"
    path.write_text("\n".join(with_it) + "\n", encoding="utf-8")
    readings = mp.read_readings(path)
    assert readings.environment["temperature"].tolist() == [25.312, 25.401, 26.0]
    assert readings.values[0].tolist() == [-3224, -4945, 16586]


DECIMAL = {
    "every number": "ax;ay\n1.234;2.345\n3.456;4.567\n",
    "a zero before": "ax;ay\n0.125;-246\n9.807;12\n",
    "other digits behind": "ax;ay\n1.25;-246\n9.807;12\n",
    "commas between cells": "ax,ay\n16.586,1.5\n-246,2.5\n",
    "a zero beside": "ax;ay\n2.512;3.104\n0;2.498\n",
}


@pytest.mark.parametrize("case", DECIMAL)
def test_points_before_decimals_stay(case, tmp_path):
    path = tmp_path / "t.csv"
    path.write_text(DECIMAL[case], encoding="utf-8")
    first = DECIMAL[case].splitlines()[1].replace(",", ";").split(";")[0]
    assert mp.read_readings(path, outputs="ax").values[0, 0] == float(first)


def test_a_time_that_goes_up_keeps_its_decimals(tmp_path):
    """And a row that is no number hides no thousands from the look at the first rows."""
    rows = [f"{1 + i / 8:.3f};{16.586 - i:.3f};-246" for i in range(12)]
    path = tmp_path / "t.csv"
    path.write_text("\n".join(["time;ax;ay", *rows, "2.500;-246;n/a"]) + "\n", encoding="utf-8")
    table = mp.read_table(path)
    assert table.numbers("time")[:2].tolist() == [1.0, 1.125]
    assert table.numbers("ax")[[0, -1]].tolist() == [16586.0, -246.0]


def test_columns_that_contradict_each_other_are_refused_by_name(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("ax;ay\n1.234.567;0.25\n2.345.678;0.5\n", encoding="utf-8")
    with pytest.raises(MultiposError, match=r"'ax' has '\.' between thousands and column 'ay'"):
        mp.read_readings(path)


def test_both_marks_in_a_number_settle_the_others(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("ax;ay\n1.234,5;12,25\n-2.345,5;0,5\n", encoding="utf-8")
    assert mp.read_readings(path).values.tolist() == [[1234.5, 12.25], [-2345.5, 0.5]]


def test_registers_are_twos_complement_where_they_reach_8(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("ax,ay\n0x4000,0x0010\n0xC000,0x0020\n", encoding="utf-8")
    assert mp.read_readings(path).values.tolist() == [[16384, 16], [-16384, 32]]


LAYOUTS = {
    "lines above": ("Device: A1\nSerial; 5\n\nface,ax,ay,az\n", ",", ""),
    "its mark": ("sep=;\nface;ax;ay;az\n", ";", ""),
    "tabs and commas": ("face\tax\tay\taz\n", "\t", ""),
    "white space": ("# by hand\nface   ax ay   az\n", "  ", ""),
    "a mark behind": ("face,ax,ay,az,\n", ",", ","),
    "a commented header": ("# face,ax,ay,az\n", ",", ""),
    "units below": ("face,ax,ay,az\n,m/s^2,m/s^2,m/s^2\n", ",", ""),
    "numbers as names, two marks": ("\ufeff\ufeffface,1,2,3\n", ",", ""),
    "a counter and a constant": ("face,ax,id,ay,type,az\n", ",", ""),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_tables_are_laid_out_as_logs_are(layout, tmp_path):
    above, mark, end = LAYOUTS[layout]
    rows = [
        [face, *map(repr, row)] for face, row in zip(WORDS["signs"], READ.tolist(), strict=True)
    ]
    if "id" in above:
        rows = [[f, x, str(n), y, "3", z] for n, (f, x, y, z) in enumerate(rows, 7)]
    lines = [mark.join(row) + end for row in rows]
    if mark not in (",", "  "):
        lines = [line.replace(".", ",") for line in lines]
    (tmp_path / "t.csv").write_text(above + "\n".join(lines) + "\n", encoding="utf-8")
    readings = mp.read_readings(tmp_path / "t.csv")
    assert readings.values == pytest.approx(READ)
    assert readings.up == pytest.approx(UP)
    assert (readings.unit == "m/s^2") == ("units" in layout)


def test_an_uncertainty_and_an_angle_are_in_the_unit_of_their_heading(tmp_path):
    path = tmp_path / "r.csv"
    path.write_text(
        "angle_deg [rad],ax [g],ay [g],u_ax [mg],u_ay [mg]\n0,1,0,1,2\n3.141592653589793,-1,0,1,2\n"
    )
    readings = mp.read_readings(path)
    assert readings.u == pytest.approx(np.array([[1e-3, 2e-3]] * 2))
    assert readings.up[1] == pytest.approx([-1, 0, 0])
    path.write_text(path.read_text().replace("u_ax [mg]", "u_ax [mV]"))
    with pytest.raises(MultiposError, match="'u_ax' is in mV by its header"):
        mp.read_readings(path)


def test_u_of_a_board_that_is_yawed_is_by_the_axis_that_is_sensed(tmp_path):
    path = table(tmp_path / "yawed.csv", WORDS["signs"], values=READ[:, [1, 0, 2]] * [1, -1, 1])
    sizes = [
        calibration_sentence(mp.fit(each, unit="m/s^2", orientation_sd=0))
        for each in (path, table(tmp_path / "s.csv", WORDS["signs"]))
    ]
    assert sizes[0].partition("U (")[2][:30] == sizes[1].partition("U (")[2][:30]


def test_a_commented_row_is_named(tmp_path):
    path = table(tmp_path / "r.csv", ["+Z", "#-Z", "+X", "-X", "+Y", "-Y"])
    (said,) = [each for each in mp.read_readings(path).findings if each.code == "commented-row"]
    assert "line 3 begins as a comment" in said.text
