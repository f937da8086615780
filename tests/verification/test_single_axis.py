"""The single-axis tumble: Fourier identities, exact recovery, what N points cannot see."""

import json
import math

import numpy as np
import pytest
from findings_bench import texts
from numpy.testing import assert_allclose
from tumble_bench import ONE_PLANE, TRUTH, output, tumble

import multipos as mp
from multipos import cli
from multipos.finding import serious
from multipos.positions.harmonics import Harmonic, find_rolls, residual_series, strange_harmonics
from multipos.positions.scheme import read_scheme
from multipos.reports.tumble_text import tumble_text


def roll_file(path, angles, values, axis="z"):
    pairs = zip(map(float, angles), map(float, values), strict=True)
    rows = [f"{axis},{angle!r},{value!r}" for angle, value in pairs]
    path.write_text("\n".join(["roll_axis,angle_deg,E", *rows, ""]))
    return str(path)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_two_planes_of_24_return_all_nine_terms(axis):
    # eq. (1) of verification.coefficients
    i = "xyz".index(axis)
    roles = [i, (i + 1) % 3, (i + 2) % 3]  # i, p, o, cyclic
    rolls = {"x": "roll-z-24+roll-y-24", "y": "roll-x-24+roll-z-24", "z": "roll-x-24+roll-y-24"}
    scheme = read_scheme(rolls[axis])
    found = mp.tumble(
        {"E": output(scheme.up[:, roles])}, scheme=rolls[axis], axes=axis, model="ieee-odd"
    )
    assert set(found.coefficients) == set(TRUTH)
    for name, value in TRUTH.items():
        assert_allclose(found[name].value, value, rtol=0, atol=1e-9, err_msg=name)


def test_fourier_identities_in_the_continuum():
    # eqs. (1), (2) of positions.harmonics
    # 900 points: c|c| has harmonics that fall as 1/order^3, so what folds back is below 1e-11
    found = tumble("tumble-900")
    t = TRUTH
    expected = {
        (0, "cos"): t["K1"] * (t["K0"] + t["K2"] / 2),
        (1, "cos"): t["K1"] * (1 + 3 * t["K3"] / 4 + 8 * t["Koq"] / (3 * math.pi)),
        (1, "sin"): t["K1"] * t["delta_o"],
        (2, "cos"): t["K1"] * t["K2"] / 2,
        (2, "sin"): t["K1"] * t["Kip"] / 2,
        (3, "cos"): t["K1"] * (t["K3"] / 4 + 8 * t["Koq"] / (15 * math.pi)),
        (3, "sin"): 0.0,
    }
    series = {h.order: h for h in found.harmonics}
    for (order, part), value in expected.items():
        assert_allclose(getattr(series[order], part), value, rtol=0, atol=1e-11)


@pytest.mark.parametrize("points", [5, 8, 12, 24, 25])
def test_harmonics_at_n_points_are_the_transform_of_the_sampled_terms(points):
    t = 2 * np.pi * np.arange(points) / points
    a = np.column_stack([np.cos(t), np.sin(t), 0 * t])
    spectrum = np.fft.rfft(output(a)) / points
    found = tumble(f"tumble-{points}")
    assert len(found.harmonics) == points // 2 + 1
    for h in found.harmonics:
        once = h.order == 0 or 2 * h.order == points
        value = spectrum[h.order] * (1 if once else 2)
        assert_allclose([h.cos, h.sin], [value.real, -value.imag], rtol=0, atol=1e-14)


def test_uncertainty_of_a_harmonic_by_hand():
    # N even points: the mean of N, and 2/N sum y cos ht, whose squared cosines sum to N/2
    sd = 3e-4
    name = "tumble-12+tumble-12"  # two readings at each point
    found = tumble(name, reading_sd=sd, sd=sd, model=ONE_PLANE)
    by_order = {h.order: h for h in found.harmonics}
    # beside the claim, which is right, the residuals show little more
    assert by_order[0].u_cos == pytest.approx(sd / math.sqrt(24), rel=0.05)
    sd = by_order[0].u_cos * math.sqrt(24)
    assert by_order[1].u_cos == pytest.approx(sd * math.sqrt(2 / 24))
    assert by_order[1].u_sin == pytest.approx(sd * math.sqrt(2 / 24))
    # sin 6t is zero at all of them, and cos 6t is ±1
    assert by_order[6].u_cos == pytest.approx(sd / math.sqrt(24))
    assert by_order[6].u_sin == by_order[6].sin == 0.0
    assert (
        tumble("tumble-12", model=ONE_PLANE).harmonics[1].u_cos is None
    )  # nothing but rounding is left


def test_harmonics_are_printed_to_the_digits_of_their_u():
    def mean_of(found):
        lines = (line.split() for line in tumble_text(found).splitlines())
        return next(cells[2] for cells in lines if cells[:2] == ["xy", "0"])

    noisy = tumble("tumble-12", sd=1e-4, seed=3, model=ONE_PLANE)
    exact = tumble("tumble-12", model=ONE_PLANE)
    assert mean_of(noisy) == "0.002655(41)"
    assert mean_of(exact) == f"{exact.harmonics[0].cos:.6g}"


@pytest.mark.parametrize("points", [4, 8, 12])
def test_least_squares_of_the_harmonics_is_that_of_the_readings(points):
    """By Parseval, eq. (tu-5) of docs/theory/tumble.md."""
    c = tumble(f"tumble-{points}", sd=1e-4).calibration
    design = c.model.basis(c.reference, {})[:, c.model.columns[0]]
    both = np.fft.rfft(np.column_stack([design, c.readings.values]), axis=0)
    both[1 : (points + 1) // 2] *= math.sqrt(2.0)
    rows = np.concatenate([both.real, both.imag])
    by_fourier = np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=None)[0]
    assert_allclose(by_fourier, c.parameters, rtol=0, atol=1e-13)


def test_residual_harmonics_by_hand():
    """Eight angles, 3 cos 2t + cos 3t left by 1, cos t and sin t: rss = 36 + 4 on 5.

    Order 2: F = (36/2)/(4/3) on 2 and 3, whose tail is (1 + 2 F/3)^(−3/2); order 3: (4/2)/(36/3).
    """
    angle = np.arange(8) * math.tau / 8
    (roll,) = find_rolls(mp.Readings(np.zeros(8), up=read_scheme("roll-z-8").up))
    design = np.column_stack([np.ones(8), np.cos(angle), np.sin(angle)])
    residual = 3.0 * np.cos(2 * angle) + np.cos(3 * angle)
    found = residual_series([roll], residual, design, 1e-12)
    assert [h.order for h in found] == [0, 1, 2, 3, 4]
    assert [h.p for h in found[:2]] == [None, None]  # what the model explains
    assert found[2].p == pytest.approx(10**-1.5, rel=1e-9)
    assert found[3].p == pytest.approx((10 / 9) ** -1.5, rel=1e-9)
    assert found[4].p == pytest.approx(1.0, rel=1e-9)
    small = residual_series([roll], 1e-7 * residual, design, 1e-12)  # still beyond rounding
    assert [h.p for h in small[2:]] == pytest.approx([h.p for h in found[2:]], rel=1e-9)


@pytest.mark.parametrize(("last", "spans"), [(180.0, True), (179.9, False)])
def test_half_a_turn_spans_one(last, spans):
    angle = np.radians([0.0, 60.0, 120.0, last])
    up = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    (roll,) = find_rolls(mp.Readings(np.zeros(4), up=up))
    assert roll.spans_a_turn is spans


@pytest.mark.parametrize(("p", "named"), [(0.0033, 1), (0.0034, 0)])
def test_of_three_harmonics_tested_one_is_strange_at_a_third_of_a_percent(p, named):
    found = [
        Harmonic("xy", order, 1.0, 0.0, p=chance)
        for order, chance in enumerate([None, 0.5, p, 0.9])
    ]
    assert len(strange_harmonics(found)) == named


def test_uneven_points_have_harmonics_by_least_squares():
    t = np.radians([0.0, 40.0, 95.0, 130.0, 180.0, 220.0, 265.0, 310.0, 335.0, 350.0])
    up = np.column_stack([np.cos(t), np.sin(t), 0 * t])
    found = mp.tumble(
        {"up_x": up[:, 0], "up_y": up[:, 1], "up_z": up[:, 2], "E": output(up)},
        outputs="E",
        model=ONE_PLANE,
    )
    assert_allclose(found["K3"].value, TRUTH["K3"], rtol=0, atol=1e-9)
    assert found.harmonics  # by least squares, as far as the angles go


@pytest.mark.parametrize(
    ("name", "absent", "said"),
    [
        ("tumble-4", {"K3", "Kip", "Kio", "Koq", "delta_p"}, "`Kip` has no effect"),
        ("tumble-4", {"K3"}, "`K1` cannot be separated from `K3`"),
        (
            "tumble-8",
            {"Koq", "Kio", "delta_p"},
            "`Koq` cannot be separated from `0.414 K1 + 0.586 K3`",
        ),
        ("tumble-24", {"Kio", "delta_p"}, "`K0` cannot be separated from `K2 + Kpp`"),
        ("tumble-24", {"Kio", "delta_p"}, "`Koo` has no effect"),
        ("roll-z-24+roll-y-24", set(), "only the difference Kpp - Koo is identifiable"),
    ],
)
def test_what_n_points_cannot_see_is_said(name, absent, said):
    found = tumble(name, sd=1e-6)
    assert absent.isdisjoint(found.coefficients)
    assert any(said in line for line in found.unidentifiable)
    assert set(found.taken_as_zero) == set(TRUTH) - set(found.coefficients)


def test_twelve_points_tell_k3_from_koq_weakly():
    default = tumble("tumble-12", sd=1e-6)
    assert default.taken_as_zero == ("delta_p", "Kio", "Koq")
    assert any("`Koq` would make the u of K3 10 times" in line for line in default.unidentifiable)
    found = tumble("tumble-12", sd=1e-6, model=ONE_PLANE)
    assert found["K3"].u > 2.0 * default["K3"].u
    assert {"K3", "Koq"} <= set(found.coefficients)
    # by hand: the correlation of the two in (X'X)^-1 at 12 points is -0.99522
    assert any("makes the u of K3 10 times" in line for line in found.unidentifiable)


def test_difference_of_the_cross_squares_is_seen_in_two_planes():
    truth = TRUTH | {"Kpp": 3e-5, "Koo": -1e-5}
    model = "1 + x + y + z + x^2 + x^3 + x*y + x*z + x*|x| + y^2"
    found = tumble("roll-z-24+roll-y-24", truth=truth, model=model)
    assert_allclose(found["Kpp"].value, 4e-5, rtol=0, atol=1e-12)
    with pytest.raises(mp.RankError, match="square_E_y"):
        tumble("roll-z-24", model="1 + x + y + x^2 + y^2")


def test_gravity_convention_turns_the_odd_terms():
    found = tumble("roll-z-24+roll-y-24", convention="gravity", model="ieee-odd")
    assert_allclose(found["K1"].value, -TRUTH["K1"], rtol=1e-12)
    assert_allclose(found["K0"].value, -TRUTH["K0"], rtol=1e-9)
    assert_allclose(found["delta_o"].value, TRUTH["delta_o"], rtol=1e-9)
    first = next(h for h in found.harmonics if h.order == 1)
    assert first.cos < 0.0  # counted from the axis that reads K1


def test_customary_units():
    found = tumble("roll-z-24+roll-y-24", sd=1e-6)
    for name, unit in (("K0", "µg"), ("K2", "µg/g^2"), ("K3", "µg/g^3"), ("delta_o", "µrad")):
        c = found[name]
        assert c.customary["unit"] == unit
        assert_allclose(c.customary["value"], 1e6 * c.value)
        assert_allclose(c.U, c.k * c.u)
    k1 = found["K1"]
    assert k1.unit == "V/g"
    assert_allclose(k1.customary["U"], 1e6 * k1.U / k1.value)
    assert k1.customary["unit"] == "ppm"


def test_ratios_to_k1_carry_the_covariance():
    """Gravity known badly moves every reading in common: K1 takes it, the bias in g as well."""
    # eq. (2) of verification.coefficients
    options = {"gravity": 9.81, "gravity_u": 0.0981, "reading_sd": 1e-6}
    found = tumble("roll-z-24+roll-y-24", sd=1e-6, **options)
    assert_allclose(found["K1"].u / found["K1"].value, 0.01, rtol=1e-3)
    assert_allclose(found["K0"].u / found["K0"].value, 0.01, rtol=1e-2)
    assert found["delta_o"].u < 2e-6  # an angle does not depend on gravity


def test_residual_harmonic_names_what_neither_model_nor_noise_explains():
    t = 2 * np.pi * np.arange(24) / 24
    up = np.column_stack([np.cos(t), np.sin(t), 0 * t])
    noise = 1e-6 * np.random.default_rng(4).standard_normal(24)
    # a table whose circle is centred 20 µrad off twice a turn: sin t cos 2t has a third sine
    stood = t + 2e-5 * np.cos(2 * t)
    moved = np.column_stack([np.cos(stood), np.sin(stood), 0 * t])
    found = mp.tumble({"E": output(moved) + noise}, scheme="tumble-24", unit="V")
    assert any("harmonic 3 in plane xy" in line for line in texts(found))
    error = next(e for e in found.table_errors.errors if e.quantity == "second_cos")
    assert abs(error.value_deg - np.degrees(2e-5)) < 3 * error.u_deg
    clean = mp.tumble({"E": output(up) + noise}, scheme="tumble-24", unit="V")
    assert serious(clean.findings) == ()


@pytest.mark.slow
def test_residual_harmonics_raise_no_false_alarm_and_intervals_cover():
    runs, alarms, covered = 400, 0, dict.fromkeys(TRUTH, 0)
    for seed in range(runs):
        found = tumble("roll-z-12+roll-y-12", sd=1e-5, seed=seed, model="ieee-odd")
        alarms += bool(serious(found.findings))
        for name, value in TRUTH.items():
            covered[name] += abs(found[name].value - value) <= found[name].U
    assert alarms <= 0.02 * runs + 4 * math.sqrt(0.02 * 0.98 * runs)  # harmonics and zero shift
    for name, count in covered.items():
        assert abs(count / runs - 0.95) < 4 * math.sqrt(0.95 * 0.05 / runs), name


def test_zero_shift_between_planes_is_seen():
    scheme = read_scheme("roll-z-12+roll-y-12")
    noise = 1e-6 * np.random.default_rng(1).standard_normal(24)
    values = output(scheme.up) + noise + 2e-5 * (np.arange(24) >= 12)
    found = mp.tumble({"E": values}, scheme="roll-z-12+roll-y-12", unit="V")
    (shift,) = found.table_errors.zero_shifts
    assert abs(shift.value - 2e-5) < 4 * shift.u
    assert any("the bias of E shifted" in line for line in texts(found))


def test_json_of_the_interface(tmp_path, capsys):
    scheme = read_scheme("roll-z-24+roll-y-24")
    path = tmp_path / "readings.csv"
    path.write_text("E\n" + "\n".join(map(repr, output(scheme.up).tolist())) + "\n")
    arguments = ["tumble", str(path), "--scheme", "roll-z-24+roll-y-24", "--json"]
    arguments += ["--model", "ieee-odd"]
    assert cli.main(arguments) == 0
    found = json.loads(capsys.readouterr().out)
    for name, value in TRUTH.items():
        assert set(found[name]) >= {"value", "u", "U", "unit"}
        assert_allclose(found[name]["value"], value, rtol=0, atol=1e-9)
    assert set(found["harmonics"][0]) == {"plane", "order", "cos", "sin", "amplitude"}
    assert found["calibration"]["schema"] == "multipos/calibration/1"
    assert found["unidentifiable"]


def test_text_has_every_number():
    text = tumble_text(tumble("roll-z-12+roll-y-12", sd=1e-6))
    for word in (
        "Koq",
        "µrad",
        "Not identifiable from these points",
        "left by the model",
        "Turntable",
    ):
        assert word in text


def fails(capsys, arguments, status, *words):
    assert cli.main(arguments) == status
    said = capsys.readouterr()
    assert said.out == ""
    last = said.err.strip().splitlines()[-1]
    assert last.startswith("multipos: error: ")
    for word in words:
        assert word in last


def test_angles_that_do_not_span_a_turn_tell_what_they_can():
    angle = np.arange(60.0, 121.0, 5.0)  # the input axis is within 30 degrees of level
    i, p = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    rng = np.random.default_rng(2)
    volt = 0.02 + 2.5 * (i + 0.003 * i**2) + 0.01 * p + 1e-5 * rng.standard_normal(13)
    found = mp.tumble({"roll_axis": ["z"] * 13, "angle_deg": angle, "volt": volt}, unit="V")
    # p is nearly a constant there, 1 - i²/2 - i⁴/8: it adds to K0, and takes half of itself from K2
    assert list(found.coefficients) == ["K0", "K1", "K2", "K3"]
    told = found.coefficients
    assert abs(told["K1"].value - 2.5) < told["K1"].U
    # what i⁴/8 adds to both, of 4 mg, over the range is some 4 % of it in K2
    assert abs(told["K0"].value - 0.03 / 2.5) < 1e-5 + told["K0"].U
    assert abs(told["K2"].value - (0.003 - 0.005 / 2.5)) < 1.5e-4 + told["K2"].U
    assert not found.harmonics
    assert any("`delta_o` hides behind the others" in text for text in found.unidentifiable)
    said = [text for text in texts(found) if "leave 300 of 360" in text]
    assert said
    assert "plane xy" in said[0]


def test_one_angle_again_and_again_tells_nothing(tmp_path, capsys):
    path = roll_file(tmp_path / "r.csv", [90.0] * 6, [0.1] * 6)
    fails(capsys, ["tumble", path], 1, "cannot separate K0 from K1")


def test_an_output_that_does_not_follow_the_angle(tmp_path, capsys):
    path = roll_file(tmp_path / "r.csv", np.arange(0.0, 360.0, 15.0), np.zeros(24))
    fails(capsys, ["tumble", path], 1, "the scale factor K1 of E is 0", "check its column")


def test_readings_outside_the_range(tmp_path, capsys):
    angles = np.arange(0.0, 360.0, 30.0)
    values = np.cos(np.radians(angles))
    values[4] = 9.99
    path = roll_file(tmp_path / "r.csv", angles, values)
    fails(capsys, ["tumble", path, "--range", "-5,5"], 1, "row 5", "'E'", "9.99", "-5 to 5")
    fails(capsys, ["tumble", path, "--range", "5,-5"], 2, "--range takes LOW,HIGH")


def test_more_than_one_output_or_axis(capsys, tmp_path):
    path = tmp_path / "r.csv"
    path.write_text("A,B\n1,2\n0,1\n-1,0\n0,1\n")
    arguments = ["tumble", str(path), "--scheme", "tumble-4"]
    fails(capsys, [*arguments, "--axes", "x"], 2, "--axes takes one of", "A, B")
    fails(capsys, [*arguments, "--outputs", "A", "--axes", "x,y"], 2, "--axes takes one of")
    fails(capsys, [*arguments, "--outputs", "A", "--axes", "w"], 2, "--axes takes one of")
    three = [*arguments, "--axes", "x,z"]  # this roll leaves z level
    fails(capsys, three, 1, "cannot separate K0 from K1 of B", "leave the output out")
    fails(capsys, [*arguments, "--outputs", "A", "--model", "1 + y"], 2, "no term x")


@pytest.mark.parametrize(
    ("lean", "told"), [(2.0, []), (20.0, ["wrong-plane"]), (90.0, ["no-signal", "table"])]
)
def test_an_input_axis_that_leans_from_where_it_is_said_to_be(lean, told):
    angle = np.arange(0.0, 360.0, 30.0)
    volt = 0.01 + 2.5 * np.cos(np.radians(angle - lean))
    volt += 1e-4 * np.random.default_rng(1).standard_normal(12)
    found = mp.tumble({"roll_axis": ["z"] * 12, "angle_deg": angle, "volt": volt}, unit="V")
    assert [finding.code for finding in serious(found.findings)] == told
    assert found.to_dict()["findings"] == [finding.to_dict() for finding in found.findings]
    for text, finding in zip(texts(found), found.findings, strict=False):
        assert text.startswith(finding.text)
    if lean == 20.0:
        assert "is 20 degrees from x" in found.findings[0].text


def test_coefficients_without_u_say_why():
    """An encoder off by .02° at one roll: its sines do the same as K0 and K2."""
    scheme = read_scheme("tumble-24")
    angle = np.arctan2(scheme.up[:, 1], scheme.up[:, 0])
    stood = angle + np.radians(0.02) * (np.sin(angle) + 0.5 * np.cos(2.0 * angle))
    up = np.column_stack([np.cos(stood), np.sin(stood), np.zeros(24)])
    values = output(up) + 1e-6 * np.random.default_rng(1).standard_normal(24)
    found = mp.tumble({"E": values}, scheme="tumble-24", unit="V")
    assert math.isnan(found["K0"].U)
    assert any(line.startswith("no U of K0") for line in texts(found))
