"""Errors of the turntable: estimated where the data can, named where the sensor does the same."""

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
from findings_bench import texts
from numpy.testing import assert_allclose

import multipos as mp
from multipos.positions.harmonics import find_rolls
from multipos.positions.orientations import orient
from multipos.positions.readings import Readings
from multipos.positions.scheme import read_scheme
from multipos.reports.turntable_text import turntable_tables
from multipos.uncertainty.dividing_head import _unused
from multipos.uncertainty.turntable import QUANTITIES, changes_unseen

T = np.radians(np.arange(0.0, 360.0, 15.0))
ERRORS = dict(zip(QUANTITIES, (1e-3, 5e-4, -3e-4, 2e-4, 4e-4), strict=True))  # [rad]
MATRIX = np.array([[1.001, 0.02, 0.01], [0.018, 0.998, -0.005]])


def stood(t, errors=ERRORS):
    e = errors
    return (
        t
        + e["zero_offset"]
        + e["first_cos"] * np.cos(t)
        + e["first_sin"] * np.sin(t)
        + e["second_cos"] * np.cos(2 * t)
        + e["second_sin"] * np.sin(2 * t)
    )


def rolls(t, sd=1e-6, seed=0, shift=0.0):
    """Two rolls of an inclinometer, main axis x and then y."""
    zero = 0 * t
    up = np.concatenate(
        [
            np.column_stack([np.cos(t), zero, np.sin(t)]),
            np.column_stack([zero, np.cos(t), np.sin(t)]),
        ]
    )
    noise = sd * np.random.default_rng(seed).standard_normal((48, 2))
    values = [2.5008, 2.4993] + up @ MATRIX.T + noise
    values[24:] += shift
    return {"Ux": values[:, 0], "Uy": values[:, 1]}


def test_two_rolls_of_a_pair_tell_every_quantity_of_the_linear_model():
    # eq. (1) of uncertainty.turntable
    cal = mp.fit(rolls(stood(T)), scheme="dual-axis-48", unit="V")
    found = mp.table_errors(cal)
    assert len(found.errors) == 10
    for error in found.errors:
        # second order of e, 1e-6, is outside the linearised eq. (2)
        assert_allclose(np.radians(error.value_deg), ERRORS[error.quantity], rtol=0, atol=5e-6)


@pytest.mark.usefixtures("without_findings")
def test_a_perfect_table_has_no_errors_and_u_covers():
    runs, covered, total = 30, 0, 0
    for seed in range(runs):
        cal = mp.fit(rolls(T, sd=1e-4, seed=seed), scheme="dual-axis-48", unit="V")
        found = mp.table_errors(cal)
        covered += sum(abs(error.value_deg) <= error.U_deg for error in found.errors)
        covered += sum(abs(shift.value) <= shift.U for shift in found.zero_shifts)
        total += len(found.errors) + len(found.zero_shifts)
    # ten quantities of one fit are not independent: a third of them, say
    assert abs(covered / total - 0.95) < 4 * math.sqrt(0.95 * 0.05 / (total / 3))


@pytest.mark.parametrize(
    ("quantity", "same"),
    [
        ("zero_offset", {"cross_E_y"}),
        ("first_cos", {"product_E_xy"}),
        ("first_sin", {"bias_E", "quad_E"}),
        ("second_sin", {"scale_E", "cubic_E"}),
        ("second_cos", set()),
    ],
)
def test_one_axis_in_one_plane(quantity, same):
    """Equation (12) of docs/theory/tumble.md: sin 3t is the only one with no double."""
    up = np.column_stack([np.cos(T), np.sin(T), 0 * T])
    noise = 1e-6 * np.random.default_rng(1).standard_normal(24)
    cal = mp.fit(
        {"E": up[:, 0] + noise}, scheme="tumble-24", unit="V", model="1 + x + y + x^2 + x^3 + x*y"
    )
    error = next(e for e in mp.table_errors(cal).errors if e.quantity == quantity)
    assert set(error.confounded_with) == same
    assert (error.value_deg is None) == bool(same)


def test_what_the_model_leaves_out_can_be_told_and_is_named():
    up = np.column_stack([np.cos(T), np.sin(T), 0 * T])
    moved = np.cos(stood(T, dict.fromkeys(ERRORS, 0.0) | {"first_cos": 1e-4}))
    cal = mp.fit({"E": moved + 0 * up[:, 0]}, scheme="tumble-24", inputs="x,y")
    error = next(e for e in mp.table_errors(cal).errors if e.quantity == "first_cos")
    assert_allclose(np.radians(error.value_deg), 1e-4, rtol=1e-3)
    assert error.confounded_with == ("product_E_xy",)


def test_zero_shift_is_seen_and_warned_of():
    cal = mp.fit(rolls(T, sd=1e-5, shift=3e-4), scheme="dual-axis-48", unit="V")
    for shift in mp.table_errors(cal).zero_shifts:
        assert abs(shift.value - 3e-4) < 4 * shift.u
    assert sum("shifted by" in warning for warning in texts(cal)) == 2


def test_a_row_that_was_set_aside_is_no_zero_shift():
    table, gross = rolls(T, sd=1e-5), rolls(T, sd=1e-5)
    gross["Ux"] = gross["Ux"] + np.where(np.arange(48) == 30, 5e-3, 0.0)
    found, clean = (
        mp.table_errors(mp.fit(each, scheme="dual-axis-48", unit="V", robust="huber"))
        for each in (gross, table)
    )
    for shift, without in zip(found.zero_shifts, clean.zero_shifts, strict=True):
        # of one row in twelve u and value move by less than their u
        assert abs(shift.value - without.value) < without.u
        assert shift.u < 1.3 * without.u


def test_rows_that_were_set_aside_are_as_if_they_had_not_been_measured():
    up = np.column_stack([np.cos(T), np.sin(T), 0 * T])
    values = up[:, :1] + 1e-5 * np.random.default_rng(3).standard_normal((24, 1))
    values[5] += 1e-2
    cal = mp.fit(mp.Readings(values, outputs=("E",), up=up), inputs="x,y", robust="huber")
    kept = cal.robust_weight.ravel() > 0.0
    assert not kept[5]
    rest = mp.fit(mp.Readings(values[kept], outputs=("E",), up=up[kept]), inputs="x,y")
    found, without = mp.table_errors(cal), mp.table_errors(rest)
    assert found.dof == without.dof
    for error, same in zip(found.errors, without.errors, strict=True):
        if same.value_deg is not None:
            # but for what robust slopes differ by, 1e-5
            assert_allclose(error.u_deg, same.u_deg, rtol=1e-3)
            assert_allclose(error.value_deg, same.value_deg, atol=1e-3 * same.u_deg)


def test_positions_that_are_uncertain_are_no_zero_shift():
    up = np.array([v for v in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(v)])
    up /= np.linalg.norm(up, axis=1)[:, None]
    ratios = []
    for seed in range(12):
        generator = np.random.default_rng(seed)
        off = np.cross(math.radians(0.1) * generator.standard_normal((26, 3)), up)
        values = (up + off) @ MATRIX.T + 2e-4 * generator.standard_normal((26, 2))
        cal = mp.fit(mp.Readings(values, outputs=("ax", "ay"), up=up), orientation_sd=0.1)
        assert not any("shifted by" in warning for warning in texts(cal))
        ratios += [shift.value / shift.u for shift in mp.table_errors(cal).zero_shifts]
    # 48 ratios of root mean square one, which scatters by a tenth; 2 at the estimated positions
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.4


@pytest.mark.parametrize("scheme", ["edges-12", "all-26"])
@pytest.mark.parametrize("model", ["linear", "own-quadratic", "1 + x + y + x^2"])
def test_a_pair_is_fitted_whatever_its_rolls_cannot_tell(scheme, model):
    """Zero shifts of three rolls can do what the table or the second order does: not a fault."""
    up = read_scheme(scheme).up
    values = up[:, :2] + 1e-5 * np.random.default_rng(2).standard_normal((len(up), 2))
    cal = mp.fit(mp.Readings(values, up=up), model=model, inputs="x,y")
    assert_allclose(cal["ax", "x"].value, 1.0, atol=1e-4)
    told = [error for error in mp.table_errors(cal).errors if error.value_deg is not None]
    assert told
    assert all(abs(error.value_deg) < 0.01 for error in told)  # noise of 1e-5 is 0.0006 degrees


def test_uncertainty_of_a_table_error_by_hand():
    """24 angles and a cos 5t, which nothing explains: rss = 12 a² on 24 − 7.

    Of (sin t − sin 3t)/2 the model leaves −sin 3t/2, whose squares sum to 3: u² = 4 a²/17.
    """
    noise = 1e-5 * np.cos(5 * T)
    cal = mp.fit({"E": np.cos(T) + noise}, scheme="tumble-24", model="1 + x + y + x^2 + x^3 + x*y")
    error = next(e for e in mp.table_errors(cal).errors if e.quantity == "second_cos")
    assert_allclose(np.radians(error.u_deg), 2e-5 / math.sqrt(17), rtol=1e-4)  # K1 is 1 so far
    assert_allclose(error.U_deg / error.u_deg, 2.1098, rtol=1e-4)  # t of 17 at 0.975


def test_what_one_roll_cannot_show_of_its_table_is_said_with_its_size():
    """By hand: the sine of the circle is a_i² − 1, its cosine −a_i a_p, and 2 a_i³ − 2 a_i."""
    noise = 1e-5 * np.cos(5 * T)
    cal = mp.fit({"E": np.cos(T) + noise}, scheme="tumble-24", model="1 + x + y + x^2 + x^3 + x*y")
    one = math.radians(0.01)
    expected = {"bias_E": 1, "scale_E": 2, "quad_E": 1, "cubic_E": 2, "product_E_xy": 1}
    found = dict(zip(cal.names, changes_unseen(cal).tolist(), strict=True))
    assert {name: size for name, size in found.items() if size} == pytest.approx(
        {name: one * size for name, size in expected.items()}, rel=1e-3
    )
    # of a line residuals show it, and a head that is read, or stated, is in U
    assert not changes_unseen(
        mp.fit({"E": np.cos(T) + noise}, scheme="tumble-24", inputs="x,y")
    ).any()
    assert not changes_unseen(
        mp.fit(mp.state_bench(cal, reading_sd=1e-5), model=cal.model.text)
    ).any()


def test_a_stated_table_is_in_u_of_what_one_roll_cannot_show():
    """Twenty benches whose encoder is off by .02°, of its circle: U holds 40 of 40 but two."""
    rng, held, plain = np.random.default_rng(4), [], []
    for _ in range(20):
        first, second = rng.uniform(0.0, 2.0 * np.pi, 2)
        stood = T + math.radians(0.02) * (np.sin(T + first) + 0.5 * np.cos(2 * T + second))
        table = {"E": 0.012 + np.cos(stood) + 1e-4 * rng.standard_normal(24)}
        options = {"scheme": "tumble-24", "model": "1 + x + y + x^2 + x*y", "unit": "g"}
        alone = mp.fit(table, **options)
        stated = mp.fit(table, budget={"index": {"u_deg": 0.016, "harmonics": [1, 2]}}, **options)
        for cal, hits in ((alone, plain), (stated, held)):
            hits += [abs(cal["bias_E"].value - 0.012) < cal["bias_E"].U]
            hits += [abs(cal["quad_E"].value) < cal["quad_E"].U]
        assert "hidden-table" in {finding.code for finding in alone.findings}
        assert "hidden-table" not in {finding.code for finding in stated.findings}
    assert np.mean(plain) < 0.5
    assert np.mean(held) >= 0.9


def test_stated_bench_puts_the_drift_into_u():
    # eq. (5) of uncertainty.turntable
    cal = mp.fit(rolls(T, sd=1e-5), scheme="dual-axis-48", unit="V")
    known = mp.state_bench(cal, reading_sd=1e-5, zero_drift=3e-4)
    again = mp.fit(known, unit="V")
    # two rolls, each with a zero of its own: the mean of two
    assert_allclose(again["Ux", "1"].u, 3e-4 / math.sqrt(2), rtol=0.01)
    assert_allclose(again["Ux", "x"].u, cal["Ux", "x"].u, rtol=0.3)


def test_stated_table_moves_readings_as_its_angles_do():
    """By hand: on the roll about y, dU/dt = M (−sin t, 0, cos t)."""
    # eq. (2) of uncertainty.turntable
    cal = mp.fit(rolls(T, sd=1e-6), scheme="dual-axis-48", unit="V")
    sd, noise = 1e-3, 1e-6
    slope = np.column_stack([-np.sin(T), 0 * T, np.cos(T)]) @ MATRIX.T
    waves = {
        "angle_sd_deg": np.eye(24),
        "offset_sd_deg": np.ones((24, 24)),
        "first_sd_deg": np.cos(T - T[:, None]),
        "second_sd_deg": np.cos(2 * (T - T[:, None])),
    }
    for option, together in waves.items():
        known = mp.state_bench(cal, reading_sd=noise, **{option: math.degrees(sd)})
        covariance = known.covariance.reshape(48, 2, 48, 2)[:24, :, :24, :]
        expected = sd**2 * together[:, None, :, None] * slope[:, :, None, None] * slope
        expected += noise**2 * np.eye(48).reshape(24, 2, 24, 2)
        assert_allclose(covariance, expected, rtol=0, atol=1e-10, err_msg=option)


def test_sections_have_titles_and_numbers():
    cal = mp.fit(rolls(T, sd=1e-5), scheme="dual-axis-48", unit="V")
    sections = {each.caption: str(each) for each in turntable_tables(mp.table_errors(cal))}
    assert "second sin" in sections["Turntable"]
    assert "Ux" in sections["Zero between rolls"]


@pytest.mark.parametrize("heading", [True, False])
@pytest.mark.parametrize(
    ("name", "planes"),
    [
        ("dual-axis-48", [("xz", 24), ("yz", 24)]),
        ("roll-z-12+roll-y-12", [("xy", 12), ("xz", 12)]),
        ("roll-z-4+roll-y-4", [("xy", 4), ("xz", 4)]),
        ("tumble-5", [("xy", 5)]),
        ("faces-6", []),
    ],
)
def test_rolls_are_found_with_and_without_headings(name, planes, heading):
    scheme = read_scheme(name)
    rotation = scheme.rotation if heading else None
    found = find_rolls(Readings(np.zeros(len(scheme)), up=scheme.up, rotation=rotation))
    assert [(roll.plane, len(roll.rows)) for roll in found] == planes
    assert all(roll.even and roll.spans_a_turn for roll in found)


def test_gaps_of_a_roll():
    angle = [0.0, 30.0, 60.0, 90.0, 120.0, 360.0]
    data = Readings(np.zeros(6))
    scheme = {"roll_axis": ["z"] * 6, "angle_deg": angle}
    (roll,) = find_rolls(orient(data, scheme))
    assert_allclose(np.degrees(roll.gap), 240.0)
    assert not roll.spans_a_turn
    assert not roll.even


def test_without_rolls_there_is_nothing_to_say():
    up = read_scheme("fibonacci-24").up
    cal = mp.fit({"E": up[:, 0]}, scheme="fibonacci-24")
    found = mp.table_errors(cal)
    assert found.errors == ()
    assert found.zero_shifts == ()


def test_a_shaft_off_the_horizon_moves_the_output_along_it_by_hand():
    """About y: M's second column times g, l + w cos t + v sin t."""
    # eqs. (3), (4) of uncertainty.turntable
    cal = mp.fit(rolls(T, sd=1e-6), scheme="dual-axis-48", unit="V")
    along, sd = cal.model.linear_part(cal.parameters, {})[:, 2], 1e-3
    waves = {"level_sd_deg": np.ones((24, 24)), "wobble_sd_deg": np.cos(T - T[:, None])}
    for option, together in waves.items():
        known = mp.state_bench(cal, reading_sd=1e-9, **{option: math.degrees(sd)})
        covariance = known.covariance.reshape(48, 2, 48, 2)[:24]
        expected = sd**2 * together[:, None, :, None] * along[:, None, None] * along
        assert_allclose(covariance[:, :, :24], expected, rtol=0, atol=1e-14)
        assert not covariance[:, :, 24:].any()


def test_a_head_that_turns_otherwise_is_named_by_its_first_reading():
    roll = SimpleNamespace(rows=np.arange(6, 9), axis="x")
    (found,) = _unused([SimpleNamespace(roll=roll, head=np.zeros(1))])
    assert found.text.startswith("reading 7: ")
    (found,) = _unused([SimpleNamespace(roll=roll, head=np.full(9, np.nan))])
    assert "of the roll about x lack" in found.text


def test_where_no_attitude_is_listed_there_is_no_roll():
    up = read_scheme("all-26").up
    off = up + 1e-3 * np.cos(np.arange(78.0)).reshape(26, 3)
    found = mp.table_errors(mp.fit(mp.Readings(off), unknown_orientation=True))
    assert str(found) == "no roll determines table errors"
