"""A recalibration: changes with E_n, rates, limits and due dates."""

import json
from datetime import date
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import multipos as mp
from multipos import cli
from multipos.errors import UsageError
from multipos.verification.recalibration import Rate, _bounds, _due, _rates

UP = mp.read_scheme("fibonacci-24").up


def calibration(created, bias=0.01, seed=1, sd=2e-4, **how):
    noise = sd * np.random.default_rng(seed).standard_normal(UP.shape)
    values = 2.5 * (UP @ np.diag([1.01, 0.99, 1.0]) + [bias, -0.02, 0.03]) + noise
    cal = mp.fit(mp.Readings(values, unit="V", up=UP), **how).to_dict()
    return json.loads(json.dumps(cal | {"created": f"{created}T10:00:00+00:00"}, default=float))


@pytest.fixture
def files(tmp_path):
    def write(*calibrations):
        paths = [tmp_path / f"c{i}.json" for i in range(len(calibrations))]
        for path, content in zip(paths, calibrations, strict=True):
            path.write_text(json.dumps(content), encoding="utf-8")
        return [str(path) for path in paths]

    return write


def test_a_change_and_its_en_are_those_of_the_values_and_their_u(files):
    # eq. (1) of verification.recalibration
    found = mp.compare(*files(calibration("2024-01-01"), calibration("2026-01-01", 0.0101, 2)))
    first, last = found.calibrations
    for each in found.changes:
        a, b = first[each.name], last[each.name]
        assert each.change == b.value - a.value
        assert each.En == pytest.approx(abs(b.value - a.value) / np.hypot(a.U, b.U), rel=1e-12)
        assert each.per_year.value == pytest.approx(each.change / 2.0, rel=2e-3)  # a leap year
    assert found.largest.name == "bias_ax"


def test_gravity_that_both_share_is_not_in_u(files):
    how = {"gravity": 9.81, "gravity_u": 0.01}
    pair = calibration("2024-01-01", **how), calibration("2025-01-01", seed=2, **how)
    free = calibration("2024-01-01"), calibration("2025-01-01", seed=2)
    with_it, without = (mp.compare(*files(*each)).changes for each in (pair, free))
    # 1e-3 of the scale factor would be ten times what is left
    for a, b in zip(with_it, without, strict=True):
        assert pytest.approx(b.U, rel=1e-2) == a.U


def test_the_trend_is_that_of_the_thermometer_of_the_gum():
    """JCGM 100:2008, table H.6: slope 0.002 18 with u = 0.000 67 of eleven equal readings."""
    # eq. (2) of verification.recalibration
    t = [21.521, 22.012, 22.512, 23.003, 23.507, 23.999, 24.513, 25.002, 25.503, 26.010, 26.511]
    b = [-171, -169, -166, -159, -164, -165, -156, -157, -159, -161, -160]
    values, U = np.array(b)[:, None] * 1e-3, np.full((11, 1), 1e-4)  # far below the scatter
    settings = SimpleNamespace(confidence=0.95, parameter_dof=np.array([np.inf]))
    slope, expanded = _rates(np.array(t), values, U, settings)[:, 0]
    assert slope == pytest.approx(0.00218, abs=5e-6)
    assert expanded / 2.2622 == pytest.approx(0.00067, abs=5e-6)  # t of 9 degrees of freedom


def test_limits_on_changes_are_by_kind_and_in_units_of_the_field(files):
    paths = files(calibration("2024-01-01"), calibration("2026-01-01", 0.0106, 2))
    found = mp.compare(*paths, limits="bias=1mg,scale_ax=500ppm")
    limit = {each.name: each.limit for each in found.changes}
    scale = {name: found.calibrations[1][name].value for name in ("scale_ax", "scale_ay")}
    assert limit["bias_ay"] == pytest.approx(1e-3 * scale["scale_ay"])
    assert limit["scale_ax"] == pytest.approx(500e-6 * scale["scale_ax"])
    assert limit["scale_ay"] is None
    assert all(each.within for each in found.changes if each.limit)
    tight = mp.compare(*paths, limits="bias=0.5mg").changes
    assert [each.name for each in tight if each.within is False] == ["bias_ax"]
    with pytest.raises(UsageError, match="did you mean 'bias'"):
        mp.compare(*paths, limits="bais=1mg")
    with pytest.raises(UsageError, match="no unit of scale_ax"):
        mp.compare(*paths, limits="scale=1mg")


def test_the_due_date_is_where_rate_and_u_reach_the_limit(files, tmp_path):
    # eq. (3) of verification.recalibration
    paths = files(calibration("2024-01-01"), calibration("2026-01-01", 0.0106, 2))
    found = mp.compare(*paths, limits="bias_ax=2mg")
    each = found.changes[0]
    years = (date.fromisoformat(each.due) - date(2026, 1, 1)).days / 365.25
    reached = each.change + (each.per_year.value + each.per_year.U) * years
    assert reached == pytest.approx(each.limit, abs=(each.per_year.value + each.per_year.U) / 300)
    assert found.to_dict()["changes"][0]["per_year"] == each.per_year._asdict()
    (tmp_path / "l.csv").write_text("name,lsl,usl\nbias_ax,,0.03\nscale_ax,2,3\n", encoding="utf-8")
    by_value = {each.name: each for each in mp.compare(*paths, limits=tmp_path / "l.csv").changes}
    assert by_value["bias_ax"].limit == (None, 0.03)
    assert by_value["bias_ax"].within
    assert by_value["scale_ax"].due is None  # beyond ten years


def test_the_command_answers_first_and_draws_a_chart(files, tmp_path, capsys):
    paths = files(*(calibration(f"{2023 + i}-05-01", 0.01 + 1e-5 * i, 7 + i) for i in range(3)))
    assert cli.main(["compare", *paths, "--limits", "bias=1mg", "-o", str(tmp_path / "c.svg")]) == 0
    first, _, changes, *_ = capsys.readouterr().out.splitlines()
    agree = sum(each.En <= 1.0 for each in mp.compare(*paths).changes)
    assert first.startswith(f"{agree} of 12 parameters agree")
    assert "3 of 3 are within their limits" in first
    assert changes.startswith("parameter")
    assert "cross_ay_z" in (tmp_path / "c.svg").read_text(encoding="utf-8")


def test_calibrations_of_one_day_have_no_rate(files):
    found = mp.compare(*files(calibration("2024-01-01"), calibration("2024-01-01", seed=2)))
    assert {each.per_year for each in found.changes} == {None}
    assert_allclose(
        [each.En for each in found.changes], [abs(c.change) / c.U for c in found.changes]
    )


def test_a_change_beyond_its_limit_is_a_negative_verdict(files, capsys):
    paths = files(calibration("2024-01-01"), calibration("2026-01-01", 0.0106, 2))
    assert cli.main(["compare", *paths, "--limits", "bias=0.1mg", "--json"]) == 3
    changes = json.loads(capsys.readouterr().out)["changes"]
    assert [each["name"] for each in changes if each["within"] is False] == ["bias_ax"]
    assert cli.main(["compare", *paths, "--limits", "bias=1mg"]) == 0


@pytest.mark.parametrize(
    ("value", "rate", "day"),
    [
        (0.0, Rate(0.1, 0.1), "1975-01-01"),  # 1/.2 years of 365.25 days
        (0.0, Rate(-0.1, 0.3), "1972-07-02"),  # −1 is reached at .4 a year, +1 at .2
        (0.5, Rate(0.1, 0.4), "1971-01-01"),
        (0.0, Rate(0.0, 0.05), None),  # in 20 years
        (2.0, Rate(0.1, 0.1), "1970-01-01"),  # beyond it already
        (0.0, Rate(0.1, float("nan")), None),
        (0.0, None, None),
    ],
)
def test_when_a_bound_is_reached_by_hand(value, rate, day):
    # eq. (3) of verification.recalibration
    assert _due(value, rate, -1.0, 1.0, 0.0) == day


def test_what_is_limited_and_where_it_is():
    """A pair bounds the value itself, one number its change; a side that is not given is open."""
    assert _bounds((None, 2.0), 0.5, 1.5) == (-np.inf, 2.0, 1.5)
    assert _bounds((-2.0, None), 0.5, 1.5) == (-2.0, np.inf, 1.5)
    assert _bounds(3.0, 0.5, 1.5) == (-3.0, 3.0, 1.0)
    assert _bounds(None, 0.5, 1.5) == (-np.inf, np.inf, 1.5)


def levelled(created, seed, **how):
    return calibration(created, seed=seed, budget={"level": {"u_deg": 0.1}}, **how)


def test_level_is_common_to_calibrations_of_one_day_only(files):
    """By hand: of two days the variances of level, .1° in µg of the zeros, are in U twice."""
    same = mp.compare(*files(levelled("2024-01-01", 1), levelled("2024-01-01", 2)))
    apart = mp.compare(*files(levelled("2024-01-01", 1), levelled("2024-01-02", 2)))
    first, last = same.calibrations
    for i, (a, b) in enumerate(zip(same.changes, apart.changes, strict=True)):
        whole = np.hypot(first.U[i], last.U[i])
        assert pytest.approx(whole, rel=0.1) == b.U
        assert a.U <= b.U * (1.0 + 1e-9)
    assert max(b.U / a.U for a, b in zip(same.changes, apart.changes, strict=True)) > 3.0
    assert "one day, here 2: level" in apart.common
    assert same.common == "common to all, of one day: gravity, level"


@pytest.mark.parametrize("dates", [("01", "01"), ("01", "02")])
def test_pairs_that_differ_by_their_noise_and_level_agree(files, dates):
    """Of forty pairs in which nothing moved two are beyond 5 %, and beyond 1e-3 hardly one."""
    rng = np.random.default_rng(8)
    beyond = largest = 0
    for run in range(40):
        errors = np.radians(0.1) * rng.standard_normal((2, 2))
        if dates[0] == dates[1]:
            errors[1] = errors[0]
        made = []
        for i, (about_x, about_y) in enumerate(errors):
            turn = np.eye(3) + np.array(
                [[0, 0, about_y], [0, 0, -about_x], [-about_y, about_x, 0.0]]
            )
            noise = np.random.default_rng(2 * run + i).standard_normal(UP.shape)
            values = UP @ turn.T + 2e-4 * noise
            data = mp.Readings(values, unit="g", up=UP)
            cal = mp.fit(data, budget={"level": {"u_deg": 0.1}}, orientation_sd=0.0).to_dict()
            day = f"2024-01-{dates[i]}T10:00:00+00:00"
            made.append(json.loads(json.dumps(cal | {"created": day}, default=float)))
        found = mp.compare(*files(*made))
        beyond += not found.consistent
        largest += found.to_dict()["largest"]["p"] < 0.05
    assert beyond <= 6
    assert largest <= 6


def test_the_largest_of_many_changes_has_a_p_of_all_of_them(files):
    # 1 − (1 − p)^12, Šidák
    found = mp.compare(*files(calibration("2024-01-01"), calibration("2026-01-01", 0.0101, 2)))
    p = found.to_dict()["largest"]["p"]
    assert p == pytest.approx(1.0 - (1.0 - found.largest.p) ** 12)
    assert 0.0 < found.largest.p < p


@pytest.mark.parametrize(
    ("limit", "size"),
    [
        ("2500µV", 2.5e-3),
        ("2500uV", 2.5e-3),
        ("2.5mV", 2.5e-3),
        ("25000 nV", 2.5e-5),
        ("1V", 1.0),
    ],
)
def test_limits_take_every_unit_that_is_printed(files, limit, size):
    paths = files(calibration("2024-01-01"), calibration("2026-01-01", 0.0106, 2))
    found = mp.compare(*paths, limits=f"bias={limit}")
    assert [each.limit for each in found.changes if each.limit] == pytest.approx([size] * 3)
