"""Which columns are outputs, along which axis and in which unit: by their names, or as asked."""

import numpy as np
import pytest
from findings_bench import EXACT, texts, warned

import multipos as mp
from tests.cli_bench import SIX, run
from tests.diagnostics.test_gross_errors import sense

UP = mp.read_scheme("all-26").up


def columns(*names, **more):
    """Readings whose three outputs have these names, in the order x, y, z."""
    up = dict(zip(("up_x", "up_y", "up_z"), UP.T, strict=True))
    return {**up, **dict(zip(names, sense(UP).T, strict=True)), **more}


def test_columns_in_any_order_sense_the_axes_they_name():
    straight = mp.fit(columns("ax", "ay", "az"))
    given = columns("ax", "ay", "az")
    ax = given.pop("ax")
    cal = mp.fit({**given, "ax": ax})
    assert (cal.outputs, cal.model.axes) == (("ay", "az", "ax"), ("y", "z", "x"))
    for name in straight.names:
        assert cal[name].value == pytest.approx(straight[name].value, abs=1e-14)
    assert any("ay senses y, az senses z, ax senses x" in w for w in texts(cal))
    assert warned(cal) == warned(straight) == []


def test_other_names_go_by_order_and_axes_decides():
    assert mp.fit(columns("p", "q", "r")).model.axes == ("x", "y", "z")
    assert mp.fit(columns("az", "ay", "ax"), axes="x,y,z").model.axes == ("x", "y", "z")


def test_one_output_of_a_name_is_along_its_axis_and_a_tumble_keeps_x():
    up = mp.read_scheme("faces-6").up
    readings = mp.Readings(sense(up)[:, 1], up=up, outputs=("ay",))
    assert mp.fit(readings).model.axes == ("y",)
    roll = mp.read_scheme("tumble-12").up
    table = {"ay": sense(roll)[:, 0], **dict(zip(("up_x", "up_y", "up_z"), roll.T, strict=True))}
    assert mp.tumble(table, model="1 + x + y").calibration.model.axes == ("x",)


def test_signs_of_axes_settle_which_way_an_output_faces(tmp_path):
    given = columns("ax", "ay", "az")
    given["ay"] = -given["ay"]
    assert warned(mp.fit(given)) == ["sign"]
    cal = mp.fit(given, axes="x,-y,z")
    assert warned(cal) == []
    assert cal["ay", "y"].value == pytest.approx(-1.02, abs=0.005)
    cal.save(tmp_path / "cal.json")
    assert mp.load(tmp_path / "cal.json").facing == cal.facing == ("x", "-y", "z")
    assert cal.to_dict()["axes"] == ["x", "y", "z"]
    assert cal.to_dict()["facing"] == ["x", "-y", "z"]
    assert warned(mp.fit(given, axes="-x,y,z")) == ["sign"]


def test_a_sensor_made_to_fall_is_not_sent_to_the_other_convention():
    given = columns("ax", "ay", "az")
    for name in ("ax", "ay", "az"):
        given[name] = -given[name]
    with pytest.warns(mp.CalibrationWarning, match="is negative under .* look like g"):
        mp.fit(given)
    assert warned(mp.fit(given, axes="-x,-y,-z")) == []
    with pytest.warns(mp.CalibrationWarning, match="of the opposite sign to --axes"):
        mp.fit(given, axes="-x,-y,-z", convention="gravity")


def test_an_output_of_a_tumble_that_is_made_to_fall_is_no_finding():
    angle = np.arange(0.0, 360.0, 30.0)
    falling = (
        0.02
        - 1.01 * np.cos(np.radians(angle))
        + 3e-6 * np.random.default_rng(3).standard_normal(12)
    )
    given = {"roll_axis": ["z"] * 12, "angle_deg": angle, "ax": falling}
    found = mp.tumble(given, axes="-x")
    assert found.calibration.facing == ("-x",)
    assert found.findings[-1].code == "hidden-table"  # as of any one roll
    assert warned(found) == []
    assert found["K1"].value == pytest.approx(-1.01, abs=1e-4)


def test_a_turned_chip_that_is_said_to_be_turned_raises_no_finding():
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    given = columns("ax", "ay", "az") | dict(
        zip(("ax", "ay", "az"), sense(UP @ turn.T).T, strict=True)
    )
    assert warned(mp.fit(given)) == ["turned"]
    assert warned(mp.fit(given, axes="y,-x,z")) == []
    wrong = mp.fit(given, axes="y,x,z").diagnostics.findings
    assert [(d.code, d.level) for d in wrong] == [("sign", "error")]


def test_signs_hold_where_orientations_are_unknown():
    given = columns("ax", "ay", "az")
    free = mp.fit(given, unknown_orientation=True)
    faced = mp.fit(given, unknown_orientation=True, axes="x,-y,z")
    assert faced["ay", "y"].value == -free["ay", "y"].value
    assert faced["az", "y"].value == -free["az", "y"].value
    assert faced.rms == pytest.approx(free.rms, rel=1e-9)
    # the same readings: what is predicted at the references as found does not change
    assert faced.predict(faced.reference) == pytest.approx(free.predict(free.reference), abs=1e-12)


def test_a_minus_is_taken_on_the_command_line(tmp_path, capsys):
    path = tmp_path / "six.csv"
    path.write_text(SIX)
    status, _, err = run(capsys, "fit", path, "--axes", "-x,y,z")
    assert status == 3
    assert "contradicts --axes" in err


def test_gyro_columns_are_no_outputs_beside_acceleration():
    given = columns("ax", "ay", "az", gx=np.zeros(26), gy=np.ones(26), gz=np.arange(26.0))
    cal = mp.fit(given)
    assert cal.outputs == ("ax", "ay", "az")
    assert any("gx, gy, gz are not used" in w for w in texts(cal))


def test_columns_that_average_carried_along_cause_no_word():
    given = columns("ax", "ay", "az", gx=np.arange(26.0), n=np.full(26, 10.0))
    given |= {f"sd_{name}": np.full(26, 1e-3) for name in ("ax", "ay", "az")}
    assert texts(mp.fit(given, **EXACT)) == ()
    assert texts(mp.fit(given, outputs="ax,ay,az", **EXACT)) == ()


@pytest.mark.parametrize("cell", ["", "n/a"])
def test_an_output_is_never_dropped(cell):
    given = columns("ax", "ay", "az") | {"ax": [cell] * 26}
    with pytest.raises(mp.MultiposError, match="column 'ax' is an output by its name"):
        mp.fit(given)


def test_a_text_with_the_ending_of_another_name_is_no_output():
    cal = mp.fit(columns("ax", "ay", "az", note_x=["n/a"] * 26))
    assert cal.outputs == ("ax", "ay", "az")


def test_names_are_matched_in_any_case():
    given = {
        name.upper(): column
        for name, column in columns("ax", "ay", "az", temperature=[20.0] * 26).items()
    }
    cal = mp.fit(given, outputs="ax,Ay,AZ")
    assert cal.outputs == ("AX", "AY", "AZ")
    assert list(cal.readings.environment) == ["temperature"]
    with pytest.raises(mp.MultiposError, match="no column 'axx'; did you mean 'AX'"):
        mp.fit(given, outputs="axx,ay,az")


@pytest.mark.parametrize("unit", ["m/s2", "mps2", "m/s**2", "m/s^2"])
def test_units_are_known_by_their_names(unit):
    given = columns("ax", "ay", "az")
    given |= {name: 9.8 * given[name] for name in ("ax", "ay", "az")}
    cal = mp.fit(given, unit=unit)
    assert (cal.model.unit, warned(cal)) == ("m/s^2", [])


def test_a_unit_in_the_header_is_the_unit():
    given = columns("ax (g)", "ay (g)", "az (g)")
    cal = mp.fit(given)
    assert (cal.outputs, cal.model.unit) == (("ax", "ay", "az"), "g")
    assert mp.fit(given, unit="g") == cal
    with pytest.raises(
        mp.MultiposError, match="header gives column 'ax' in g, and --unit states mg"
    ):
        mp.fit(given, unit="mg")
    mixed = columns("ax (g)", "ay (g)", "az (mg)")
    with pytest.raises(mp.MultiposError, match="outputs differ in unit"):
        mp.fit(mixed)


@pytest.mark.parametrize(
    ("header", "outputs"),
    [
        ("Lage,Beschleunigung X,Beschleunigung Y,Beschleunigung Z", "Beschleunigung "),
        ("位置,加速度X,加速度Y,加速度Z", "加速度"),
        ("time,ax,ay,az,gx,gy,gz,temp", "a"),
        ("t,soak,ax,ay,az,run", "a"),
    ],
)
def test_what_stands_beside_acceleration_is_no_output(header, outputs):
    columns = {name: np.arange(6.0) for name in header.split(",")}
    found = mp.read_readings(columns)
    assert [name.upper() for name in found.outputs] == [f"{outputs}{x}".upper() for x in "xyz"]


def test_the_axis_that_is_up_is_a_direction():
    """Up is where the specific force of a sensor at rest points."""
    cells = ["+X", "-x", "Y+", "z- up", "+Z up", "y down", "E-N-U"]
    found = mp.read_readings({"direction": cells, "ax": np.arange(7.0)})
    x, y, z = np.eye(3)
    np.testing.assert_array_equal(found.up, [x, -x, y, -z, z, -y, z])
    with pytest.raises(mp.MultiposError, match=r"row 2.*'\+-x' is not a triple.*as in \+X"):
        mp.read_readings({"direction": ["+X", "+-x"], "ax": [1.0, 2.0]})
