"""Tumbles of several outputs, any mix of rolls, passes both ways, forces beside gravity."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from findings_bench import texts
from numpy.testing import assert_allclose, assert_array_equal
from tumble_bench import ONE_PLANE, TRUTH, output, triad, tumble

import multipos as mp
from multipos import cli
from multipos.errors import RankError
from multipos.positions.scheme import read_scheme
from multipos.reports.tumble_text import tumble_text
from multipos.verification import coefficients, tumbling
from multipos.verification.coefficients import (
    find_hidden_table,
    find_without_u,
    fitted_coefficients,
)
from multipos.verification.hysteresis import _passes


@pytest.mark.parametrize("steps", [8, 12])
@pytest.mark.parametrize("rolls", ["zyx", "xyz", "zx", "yx"])
def test_every_mix_of_rolls_returns_what_it_can_tell(rolls, steps):
    scheme = "+".join(f"roll-{axis}-{steps}" for axis in rolls)
    data = triad(read_scheme(scheme).up, sd=1e-9)
    model = "ieee-odd" if len(rolls) == 3 and steps > 8 else None
    found = mp.tumble(data, scheme=scheme, unit="V", model=model)
    for name, one in found.outputs.items():
        assert set(one.coefficients) >= {"K0", "K1", "K2", "delta_o"} - set(one.taken_as_zero)
        for key, entry in one.coefficients.items():
            if not one.taken_as_zero:
                assert abs(entry.value - TRUTH[key]) < 6 * entry.u, (name, key)
        facts = (finding.text for finding in one.findings)  # an action may name a column to give
        assert not any("column" in text for text in (*one.unidentifiable, *facts))
    if model:
        assert not any(one.taken_as_zero for one in found.outputs.values())


def test_several_outputs_are_what_each_is_alone():
    scheme = "roll-z-12+roll-y-12+roll-x-12"
    table = triad(read_scheme(scheme).up, sd=1e-5)
    together = mp.tumble(table, scheme=scheme, unit="V")
    for name, axis in zip(together.outputs, together.axes, strict=True):
        alone = mp.tumble(table, scheme=scheme, outputs=name, axes=axis, unit="V")
        assert alone.coefficients == together[name].coefficients
        assert alone.harmonics == together[name].harmonics


def test_misalignment_is_a_matrix():
    # eq. (1) of verification.tumbling
    scheme = "roll-z-12+roll-y-12+roll-x-12"
    found = mp.tumble(triad(read_scheme(scheme).up, sd=1e-9), scheme=scheme)
    o, p = TRUTH["delta_o"], -TRUTH["delta_p"]
    by_hand = [[1.0, o, p], [p, 1.0, o], [o, p, 1.0]]  # delta_o along the next axis
    assert_allclose(found.misalignment, by_hand, atol=1e-7)
    assert_array_equal(np.diag(found.misalignment_u), 0.0)


def test_one_fit_of_a_triad_in_three_rolls_is_not_ended_by_its_diagnosis():
    scheme = "roll-z-12+roll-y-12+roll-x-12"
    table = triad(read_scheme(scheme).up, sd=1e-6)
    cal = mp.fit(table, outputs="ax", model="ieee-odd", scheme=scheme)
    assert_allclose(cal["ax", "x"].value, TRUTH["K1"], atol=1e-4)


def test_an_output_that_no_roll_turns_is_named():
    with pytest.raises(RankError, match=r"K0 from K1 of az.*--outputs"):
        mp.tumble(triad(read_scheme("tumble-24").up), scheme="tumble-24")


def both_ways(hysteresis, sd=0.0):
    """A roll about z forward, then backward, from x to y."""
    angles = np.append(np.arange(0.0, 360.0, 30.0), np.arange(330.0, -1.0, -30.0))
    t, way = np.radians(angles), np.repeat([1.0, -1.0], 12)
    up = np.column_stack([np.cos(t), np.sin(t), 0 * t])
    noise = sd * np.random.default_rng(3).standard_normal((24, 2))
    values = np.column_stack([output(up), output(np.roll(up, -1, axis=1))])
    values += TRUTH["K1"] * way[:, None] * hysteresis / 2.0 + noise
    columns = {"ax": values[:, 0], "ay": values[:, 1]}
    return {"roll_axis": ["z"] * 24, "angle_deg": angles, **columns}


def test_hysteresis_is_forward_less_backward_of_every_output():
    found = mp.tumble(both_ways(5e-6))
    for one, plane in (("ax", "xy"), ("ay", "yx")):  # whose angles run against each other
        (h,) = found[one].hysteresis.values()
        assert list(found[one].hysteresis) == [plane]
        # K1 is fitted beside the hysteresis: a relative 1e-5 of 5e-6
        assert_allclose(h.value, 5e-6, rtol=1e-4)
        assert (h.unit, h.angles, h.dof) == ("g", 12, 11.0)
    assert "Hysteresis" in tumble_text(found)
    assert not any("more than once" in text for text in texts(found))


def test_uncertainty_of_hysteresis_is_the_spread_over_angles():
    found = mp.tumble(both_ways(5e-6, sd=1e-6), outputs="ax")
    (h,) = found.hysteresis.values()
    values = found.calibration.readings.values[:, 0] / found["K1"].value
    d = values[:12] - values[:11:-1]
    assert_allclose(h.value, d.mean())
    assert_allclose(h.u, d.std(ddof=1) / np.sqrt(12))
    assert_allclose(h.U / h.u, 2.2010, rtol=1e-4)  # t of 11 at 0.975


@pytest.mark.parametrize(
    ("degrees", "way"),
    [
        ([0, 90, 180, 270], [1, 1, 1, 1]),
        ([270, 0, 90], [1, 1, 1]),  # through zero
        ([0, 90, 90, 0], [1, 1, -1, -1]),  # read twice at the turning point
        ([0, 180, 0], [0, 0, 0]),  # half a turn goes either way
    ],
)
def test_passes_by_hand(degrees, way):
    # eq. (1) of verification.hysteresis
    assert _passes(np.radians(np.array(degrees, dtype=float))).tolist() == way


def test_one_pass_has_no_hysteresis():
    table = {name: column[:12] for name, column in both_ways(0.0).items()}
    assert mp.tumble(table)["ax"].hysteresis == {}


def test_a_centrifuge_joins_a_tumble():
    """K3 and Koq of 12 points lean on each other; at ±5 g each is what it is."""
    rolls = read_scheme("roll-z-12+roll-y-12").up
    forces = np.outer(np.linspace(-5.0, 5.0, 11), [1.0, 0.0, 0.0])
    up, force = np.full((35, 3), np.nan), np.full((35, 3), np.nan)
    up[:24], force[24:] = rolls, forces
    noise = 1e-6 * np.random.default_rng(1).standard_normal(35)
    table = {f"up_{axis}": up[:, i] for i, axis in enumerate("xyz")}
    table |= {f"f_{axis}": force[:, i] for i, axis in enumerate("xyz")}
    table["E"] = output(np.vstack([rolls, forces])) + noise
    found = mp.tumble(table, gravity=9.80665)
    rolled = {"E": table["E"][:24]}
    alone = mp.tumble(rolled, scheme="roll-z-12+roll-y-12", model="ieee-odd")
    for key in ("K2", "K3", "Koq"):
        assert abs(found[key].value - TRUTH[key]) < 4 * found[key].u
        assert found[key].u < 0.2 * alone[key].u
    assert [len(roll.rows) for roll in found.rolls] == [12, 12]  # a force is on no roll


def test_a_table_that_is_off_is_told_from_the_sensor():
    """Second harmonics of 0.1 mrad pass for K1 and K3; estimated beside them they do not."""
    scheme = read_scheme("roll-z-24+roll-y-24+roll-x-24")
    listed = scheme.up
    stood = np.empty_like(listed)
    for rows, (p, q) in zip(np.split(np.arange(72), 3), ((0, 1), (0, 2), (1, 2)), strict=True):
        t = np.arctan2(listed[rows, q], listed[rows, p])
        t = t + 1e-4 * np.sin(2 * t)
        stood[rows] = 0.0
        stood[rows, p], stood[rows, q] = np.cos(t), np.sin(t)
    found = mp.tumble(triad(stood, sd=1e-6), scheme=scheme, unit="V")
    assert found.table_errors.beside.p < 1e-6
    for name, one in found.outputs.items():
        plain = fitted_coefficients(one.calibration, name[1])["K1"]
        beside = found.beside_table[name]["K1"]
        # of y the errors of its two rolls cancel; x is along cos t in both of its own
        assert name == "ay" or abs(plain.value - TRUTH["K1"]) > 2 * beside.U
        assert abs(beside.value - TRUTH["K1"]) < 2 * beside.U
        leaning = {"K0", "K2", "delta_o"}
        assert not leaning & set(found.beside_table[name])
        # what is given has a U that holds, or none
        assert one["K1"] == beside
        assert all(np.isnan(one[key].u) and np.isnan(one[key].U) for key in leaning)
        assert one["K0"].value == fitted_coefficients(one.calibration, name[1])["K0"].value
    errors = {(e.plane, e.quantity): e for e in found.table_errors.errors}
    for plane in ("xy", "xz", "yz"):
        error = errors[plane, "second_sin"]
        assert abs(np.radians(error.value_deg) - 1e-4) < 4 * np.radians(error.u_deg)
    assert "Beside the table" in tumble_text(found)


def test_the_command_of_several_outputs(tmp_path, capsys):
    scheme = "roll-z-12+roll-y-12+roll-x-12"
    table = triad(read_scheme(scheme).up, sd=1e-6)
    rows = ["ax,ay,az", *(",".join(map(repr, row)) for row in zip(*table.values(), strict=True))]
    path = tmp_path / "r.csv"
    path.write_text("\n".join(rows).replace("np.float64(", "").replace(")", "") + "\n")
    assert cli.main(["tumble", str(path), "--scheme", scheme, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert list(found["outputs"]) == ["ax", "ay", "az"]
    for one in found["outputs"].values():
        assert set(TRUTH) - {"Koq"} < set(one)
        assert one["taken_as_zero"] == ["Koq"]
        assert one["calibration"]["schema"] == "multipos/calibration/1"
    svg = str(tmp_path / "t.svg")
    assert cli.main(["tumble", str(path), "--scheme", scheme, "--outputs", "ax,ay", "-o", svg]) == 0
    said = capsys.readouterr().out
    assert "Misalignment" in said
    assert Path(svg).stat().st_size > 1000


def test_readings_without_noise_find_no_errors_of_the_table():
    scheme = "roll-z-12+roll-y-12+roll-x-12"
    found = mp.tumble(triad(read_scheme(scheme).up), scheme=scheme, unit="V")
    assert found.table_errors.beside.p == 1.0
    assert "Beside the table" not in tumble_text(found)


def test_what_the_table_hides_stands_in_units_of_the_coefficients():
    """An angle off by .01° is 1.745e-4 of g, and the error of it of g per g²."""
    angle = np.arange(0.0, 360.0, 15.0)
    volt = 0.012 + 2.5 * np.cos(np.radians(angle))
    volt += 1e-5 * np.random.default_rng(1).standard_normal(24)
    rolled = {"E": volt, "roll_axis": ["z"] * 24, "angle_deg": angle}
    found = mp.tumble(rolled, unit="V", model=ONE_PLANE)
    (said,) = texts(found)
    assert "change K0 by 175 µg, Kip by 175 µg/g². " in said


def test_what_the_table_hides_is_said_only_where_all_have_a_u(monkeypatch):
    """And not of a table that is known, or of rolls that show every harmonic."""
    one = tumble("roll-z-24", sd=1e-5)
    assert find_hidden_table(one.coefficients, one.calibration, "x")
    bare = one.coefficients | {"K0": replace(one.coefficients["K0"], U=np.nan)}
    assert find_hidden_table(bare, one.calibration, "x") == ()
    monkeypatch.setattr(coefficients, "changes_unseen", lambda c: np.zeros(len(c.parameters)))
    assert find_hidden_table(one.coefficients, one.calibration, "x") == ()


def test_coefficients_without_u_are_said_once_of_all_outputs(monkeypatch):
    """What one roll said of itself and of the table goes; what else it said stays."""
    one = tumble("roll-z-24", sd=1e-5)
    bare = {"K1": replace(one.coefficients["K1"], U=np.nan), "K2": one.coefficients["K2"]}
    turned = {"delta_o": replace(one.coefficients["K1"], U=np.nan)}
    (said,), (way_out,) = find_without_u(bare), find_without_u(turned)
    assert said.text.startswith("no U of K1: ")
    assert said.action.startswith("Roll again")
    assert way_out.action.startswith("State the bench")
    assert find_without_u(one.coefficients) == ()
    other, hidden = replace(said, text="other"), replace(said, text="hidden", code="hidden-table")
    before = replace(one, coefficients=bare, findings=(said, other, hidden))
    monkeypatch.setattr(tumbling, "those_that_hold", lambda *_, stated: bare | turned)
    found = tumbling._beside_all(before, "x", {}, None)
    assert {each.text for each in found.findings} == {
        "other", find_without_u(bare | turned)[0].text
    }  # fmt: skip
    assert found.coefficients.keys() == {"K1", "K2", "delta_o"}
