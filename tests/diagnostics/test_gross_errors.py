"""Every gross error, planted in readings otherwise good, and good readings that are strange."""

import numpy as np
import pytest
from findings_bench import texts

import multipos as mp
from multipos.diagnostics.columns import resolution
from multipos.diagnostics.linear_view import look

MATRIX = np.array([[0.98, 0.01, -0.005], [0.004, 1.02, 0.01], [-0.01, 0.003, 0.99]])
G = 9.80665


def sense(up, seed=5, noise=1e-3):
    rng = np.random.default_rng(seed)
    return np.array([0.02, -0.03, 0.05]) + up @ MATRIX.T + noise * rng.standard_normal(up.shape)


def codes(values, up, level="error", **options):
    unit = options.pop("unit", "reading")
    cal = mp.fit(mp.Readings(values, up=up, unit=unit), **options)
    return [d.code for d in cal.diagnostics.findings if d.level == level], cal


def finding(values, up, **options):
    (_, cal) = codes(values, up, **options)
    (found,) = [d for d in cal.diagnostics.findings if d.level == "error"]
    return found


def edited(name, scheme, edit):
    up = mp.read_scheme(scheme).up.copy()
    values = sense(up)
    edit(values, up)
    return pytest.param(values, up, name, id=f"{name} {scheme}")


def swap(values, up):
    values[[0, 1]] = values[[1, 0]]


def flip(values, up):
    up[2] *= -1.0


def flip_half(values, up):
    up[len(up) // 2 :] *= -1.0


def one_row(values, up):
    values[2] *= G


def half(values, up):
    values[: len(values) // 2] *= G


def one_output(values, up):
    values[:, 1] *= G


def reverse(values, up):
    values[:, 0] *= -1.0


def exchange(values, up):
    values[:, [0, 1]] = values[:, [1, 0]]


def stuck(values, up):
    values[:, 2] = 0.05


def noise(values, up):
    values[:, 2] = 0.05 + 1e-3 * np.random.default_rng(1).standard_normal(len(values))


def wired(values, up):
    values[:, 1] = values[:, 0]


def count(values, up):
    values[:, 1] = np.arange(1.0, len(values) + 1.0)


def clip(values, up):
    np.clip(values, -0.95, 0.95, out=values)


def wrap(values, up):
    values[values > 0.9] -= 2.0


def all_noise(values, up):
    values[:] = np.random.default_rng(2).standard_normal(values.shape)


PLANTED = [
    edited(name, scheme, edit)
    for name, edit in (
        ("interchanged-rows", swap),
        ("flipped-row", flip),
        ("flipped-row", flip_half),
        ("row-unit", one_row),
        ("row-unit", half),
        ("output-unit", one_output),
        ("sign", reverse),
        ("permuted-outputs", exchange),
        ("dead-output", stuck),
        ("no-signal", noise),
        ("no-signal", wired),
        ("counter-column", count),
        ("saturated", clip),
        ("wrapped", wrap),
        ("no-signal", all_noise),
    )
    for scheme in ("song-qin-6", "all-26")
    # of opposite faces half the rows leave nothing to tell, and a wrap by 2 g looks upside down
    if scheme == "all-26" or edit not in (flip_half, wrap)
]


@pytest.mark.parametrize(("values", "up", "code"), PLANTED)
def test_a_planted_gross_error_is_named(values, up, code):
    assert codes(values, up)[0] == [code]


@pytest.mark.parametrize("scheme", ["song-qin-6", "all-26", "dual-axis-48"])
def test_good_readings_raise_no_doubt_of_the_data(scheme):
    up = mp.read_scheme(scheme).up
    assert codes(sense(up), up)[0] == []


def test_a_spiral_of_positions_without_noise_is_no_counter():
    up = mp.read_scheme("fibonacci-40").up  # z falls by one step from row to row
    assert codes(0.01 + 1.02 * up, up)[0] == []


def test_a_repair_names_rows_and_the_rms_before_and_after():
    up = mp.read_scheme("song-qin-6").up
    values = sense(up)
    values[[0, 1]] = values[[1, 0]]
    found = finding(values, up)
    before = mp.fit(mp.Readings(values, up=up)).rms
    assert found.rows == ("1", "2")
    said = f"rms falls from {before:.2g} g to 0.000" if before < 10.0 else "rms is 0.000"
    assert said in found.text


def test_wrapping_tells_the_step():
    up = mp.read_scheme("all-26").up
    values = np.round(1000.0 * sense(up))
    values[values > 900.0] -= 2048.0
    found = finding(values, up)
    assert found.outputs == ("ax", "ay", "az")
    step = float(found.text.split("with ")[1].split(" ")[0])
    # one reading an output wrapped: its noise of 1 is that of the step, times sqrt(1/(1 - h))
    assert step == pytest.approx(2048.0, abs=6.0)


@pytest.mark.parametrize(("factor", "named"), [(G, "--unit m/s^2"), (1000.0, "--unit mg")])
def test_another_unit_is_named(factor, named):
    up = mp.read_scheme("all-26").up
    found = finding(factor * sense(up), up, unit="g")
    assert (found.code, named in found.action) == ("unit", True)
    assert codes(sense(up), up, unit="g")[0] == []
    assert codes(factor * sense(up), up)[0] == []  # no unit was stated


def test_angles_in_radians_are_named():
    rng = np.random.default_rng(3)
    roll, pitch = rng.uniform(-3.1, 3.1, 12), rng.uniform(-1.5, 1.5, 12)
    up = np.column_stack(
        [np.sin(pitch), -np.sin(roll) * np.cos(pitch), -np.cos(roll) * np.cos(pitch)]
    )
    columns = {"roll_deg": roll, "pitch_deg": pitch, **dict(zip("xyz", sense(up).T, strict=True))}
    found = [d.code for d in mp.fit(columns).diagnostics.findings]
    assert found == ["angles-in-radians"]
    columns |= {"roll_deg": np.degrees(roll), "pitch_deg": np.degrees(pitch)}
    assert mp.fit(columns).diagnostics.findings == ()


@pytest.mark.parametrize(("gravity", "said"), [(32.17, True), (9.79, False), (1.0, True)])
def test_gravity_of_another_world(gravity, said):
    up = mp.read_scheme("all-26").up
    assert ("gravity" in codes(sense(up), up, gravity=gravity)[0]) == said


def test_a_chip_turned_in_its_case_is_no_gross_error():
    up = mp.read_scheme("faces-6").up
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # ax along y, ay along -x
    found, cal = codes(sense(up @ turn.T), up, level="warning")
    assert found[0] == "turned"
    said = cal.diagnostics.findings[0]
    assert "by 90 degrees about (0.00, 0.00, 1.00): ax senses y, ay senses -x, az senses z" in (
        said.text
    )
    assert np.abs(cal.compensate(sense(up @ turn.T)) - up).max() < 0.005


def test_the_other_convention_is_a_warning_and_no_gross_error():
    up = mp.read_scheme("faces-6").up
    found, cal = codes(sense(-up), up)
    assert found == []
    assert any("--convention gravity" in said for said in texts(cal))


def test_one_outlier_is_no_gross_error():
    up = mp.read_scheme("all-26").up
    values = sense(up)
    values[4, 1] += 0.5
    assert codes(values, up)[0] == []


def test_copies_are_told_from_repeats():
    up = np.tile(mp.read_scheme("faces-6").up, (4, 1))
    once = sense(up[:6])
    copied, _ = codes(np.tile(once, (4, 1)), up, "warning")
    assert copied[0] == "repeated-rows"
    assert "lack-of-fit" not in copied
    assert "repeated-rows" not in codes(sense(up), up, "warning")[0]
    # repeats of a converter so coarse that noise does not show are repeats all the same
    coarse, _ = codes(np.round(sense(up, noise=1e-4), 2), up, "warning")
    assert not {"repeated-rows", "lack-of-fit"} & set(coarse)


@pytest.mark.parametrize(
    ("values", "step"),
    [([0.25, 1.0, -0.5, 0.0], 0.25), ([3.0, 12.0, 21.0], 9.0), ([0.1, 0.1 + np.pi, 2.0], 0.0)],
)
def test_the_step_of_a_converter(values, step):
    assert resolution(np.array(values)) == pytest.approx(step, abs=1e-12)


def test_the_linear_view_is_least_squares():
    # eq. (1) of diagnostics.linear_view
    up = mp.read_scheme("all-26").up
    values = sense(up)
    view = look(mp.fit(mp.Readings(values, up=up), model="ieee"))
    design = np.column_stack([np.ones(26), up])
    beta, square, *_ = np.linalg.lstsq(design, values, rcond=None)
    assert view.sensitivity == pytest.approx(beta[1:].T, abs=1e-14)
    size = np.linalg.norm(beta[1:], axis=0)
    assert view.misfit == pytest.approx(np.sqrt(np.mean(square / 22 / size**2)), rel=1e-10)
    without = [np.delete(np.arange(26), row) for row in range(26)]
    rest = [np.linalg.lstsq(design[rows], values[rows], rcond=None)[1] for rows in without]
    least = min(float(np.sum(each / size**2)) for each in rest)
    assert view.misfit_but_one == pytest.approx(np.sqrt(least / 3 / 21), rel=1e-10)


def test_an_interchange_is_found_under_a_formula_that_is_nearly_linear():
    up = mp.read_scheme("fibonacci-24").up
    values = sense(up / (1.0 + 0.05 * up**2))
    assert codes(values, up, model="each = a + p*x + q*y + r*z + c*own^3")[0] == []
    swap(values, up)
    found = finding(values, up, model="each = a + p*x + q*y + r*z + c*own^3")
    assert (found.code, found.rows) == ("interchanged-rows", ("1", "2"))


@pytest.mark.parametrize("known", [{}, {"orientation_sd": 0.5}, {"unknown_orientation": True}])
def test_a_reading_in_which_all_others_drown_leaves_no_result(known):
    up = mp.read_scheme("all-26").up
    values = sense(up)
    values[5, 2] = 1e17
    readings = mp.Readings(values, up=None if "unknown_orientation" in known else up)
    with pytest.raises(mp.MultiposError, match=r"position 6: .* is 1e\+17, next to which"):
        mp.fit(readings, **known, reading_sd=1e-3)
