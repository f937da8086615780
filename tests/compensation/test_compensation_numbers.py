"""Numbers of compensation by a second route, at points without symmetry."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.stats import t

import multipos as mp
from multipos.compensation import added_columns, correction, reading_noise
from multipos.compensation.added_columns import _heading, _rows_of
from multipos.compensation.correction import _correct_each
from multipos.compensation.reading_noise import ReadingUncertainty
from multipos.errors import UsageError
from multipos.files.tables import Table
from multipos.finding import Finding


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("heading", [17.0, 141.0, 283.0, 359.9])
def test_the_heading_of_a_case_that_leans(heading, sign):
    """A field of north .3 and down .9; x is headed, then pitched and rolled, in north-east-down."""
    turn = Rotation.from_euler("ZYX", [heading, 23.0, -34.0], degrees=True)
    into_case = turn.inv()
    field = into_case.apply([[0.3, 0.0, 0.9]]) * 48.0
    up = into_case.apply([[0.0, 0.0, -1.0]]) * 1.02
    beside = SimpleNamespace(
        outputs=("ax", "ay", "az"), model=SimpleNamespace(environment=()), sign=sign,
        compensate=lambda raw, environment: sign * raw,
    )  # fmt: skip
    table = Table("s", dict(zip(beside.outputs, up.T, strict=True)), rows=1)
    assert _heading(field, beside, table) == pytest.approx(heading, abs=1e-9)


def test_a_heading_of_nothing_is_none_and_one_of_a_full_turn_is_0():
    beside = SimpleNamespace(
        outputs=("ax", "ay", "az"), model=SimpleNamespace(environment=()), sign=1.0,
        compensate=lambda raw, environment: raw,
    )  # fmt: skip
    up = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    table = Table("s", dict(zip(beside.outputs, up.T, strict=True)), rows=3)
    field = np.array([[0.0, 0.0, -3.0], [1.0, -1e-300, -3.0], [1.0, 0.0, 0.0]])
    found = _heading(field, beside, table)
    assert math.isnan(found[0])
    assert found[1] == 0.0
    assert math.isnan(found[2])


def test_rows_that_are_worked_on_together():
    table = Table("s", {"a": np.arange(10.0)}, rows=10, lines=np.arange(20, 30), first=3)
    parts = [_rows_of(table, start, 4) for start in (0, 4, 8)]
    assert [part.rows for part in parts] == [4, 4, 2]
    assert [part.first for part in parts] == [3, 7, 11]
    assert_allclose(np.concatenate([part.columns["a"] for part in parts]), np.arange(10.0))
    assert parts[1].lines.tolist() == [24, 25, 26, 27]


@pytest.mark.parametrize("own", [True, False])
def test_uncertainty_of_compensated_force_is_the_sum_of_its_parts(own, monkeypatch):
    """Budget, noise of each output, the zero of a soak for what of it the noise contains."""
    rng = np.random.default_rng(5)
    n, K, M, p = 3, 2, 2, 4
    inverse, by_parameter = rng.normal(size=(n, K, M)), rng.normal(size=(n, M, p))
    roots = rng.normal(size=(3, p, p))
    rows = [
        SimpleNamespace(added=root @ root.T * 30.0, dof=np.full(p, nu), evaluation=kind)
        for root, nu, kind in zip(roots, (9.0, 7.0, math.inf), "AAB", strict=True)
    ]
    sd, columns = rng.uniform(0.1, 0.2, (n, M)), rng.normal(size=(n, M, 3))
    contained = rng.uniform(0.1, 0.3, (n, M))
    unseen = np.array([np.diag(each) for each in rng.uniform(0.0, 0.1, (n, K))])
    zeros = SimpleNamespace(dof=np.array([6.0, math.inf]), columns=columns, contained=contained)
    for name, value in (
        ("sensitivities", (inverse, by_parameter)), ("zeros_of_soaks", zeros),
        ("unseen_covariance", unseen),
    ):  # fmt: skip
        monkeypatch.setattr(reading_noise, name, lambda *_, value=value: value)
    c = SimpleNamespace(
        model=SimpleNamespace(sensed_axes=(0, 1)), parameters=np.zeros(p), confidence=0.9
    )
    noise, budget = SimpleNamespace(own=own), SimpleNamespace(rows=rows)
    state = SimpleNamespace(calibration=c, noise=noise, budget=budget)
    force = np.ones((n, K))
    force[2, 1] = math.nan
    u, U = ReadingUncertainty.of_force(state, force, {}, sd)
    for row in range(2):
        for k in range(K):
            gradient = inverse[row, k] @ by_parameter[row]
            parts = [gradient @ each.added @ gradient for each in rows]
            noisy = inverse[row, k] ** 2 * sd[row] ** 2
            zero = inverse[row, k, 0] ** 2 * np.sum(columns[row, 0] ** 2)
            parts[0] -= inverse[row, k, 0] ** 2 * contained[row, 0]
            if own:
                parts[0], parts[1] = parts[0] + noisy[0], parts[1] + noisy[1]
            else:
                parts.append(noisy.sum())
            square = sum(parts) + zero + unseen[row, k, k]
            assert u[row, k] == pytest.approx(math.sqrt(square), rel=1e-9)
            nu = square**2 / (parts[0] ** 2 / 9.0 + parts[1] ** 2 / 7.0 + zero**2 / 6.0)
            lowered = math.floor(10.0 * nu) / 10.0
            assert U[row, k] / u[row, k] == pytest.approx(t.ppf(0.95, lowered), rel=1e-6)
    assert np.isnan(u[2]).all()


@pytest.mark.parametrize("column", [None, "p,q"])
def test_several_regressions_correct_a_column_each(column):
    """Named after their responses; a row is outside where any says so, and counted once."""
    asked = []

    class Found(dict):
        noise = "stated"
        findings = (Finding("outside", "warning", "3"), Finding("other", "note", "what"))

    def correct(one, *, column):
        asked.append(column)
        outside = np.eye(4, dtype=int)[one]
        return Found(t=table.columns["t"], corrected=np.full(4, one), outside=outside)

    table = Table("s", {"t": np.arange(4.0)}, rows=4)
    found = _correct_each({"a": 1, "b": 3}, table, column, correct)
    assert asked == ([None, None] if column is None else ["p", "q"])
    assert list(found) == ["t", "corrected_a", "corrected_b", "outside"]
    assert list(found["outside"]) == [0, 1, 0, 1]
    assert [each.code for each in found.findings].count("outside") == 1
    assert [each.text for each in found.findings if each.code == "other"] == ["a: what", "b: what"]
    (said,) = (each.text for each in found.findings if each.code == "outside")
    assert said.startswith("2 of 4 rows")
    with pytest.raises(UsageError, match="names 1 columns for 2 responses"):
        _correct_each({"a": 1, "b": 3}, table, "p", correct)


def test_rows_beyond_the_columns_of_the_calibration_are_clamped():
    """Calibrated from 12 to 31: the ends are inside."""
    readings = SimpleNamespace(environment={"t": np.array([31.0, 12.0, 20.0])})
    table = Table("s", {"t": np.zeros(5)}, rows=5)
    column = np.array([11.9, 12.0, 25.0, 31.0, 31.1])
    c = SimpleNamespace(readings=readings)
    beyond, clamped = added_columns._environment_outside(c, table, {"t": column})
    assert beyond.tolist() == [True, False, False, False, True]
    assert clamped["t"].tolist() == [12.0, 12.0, 25.0, 31.0, 31.0]


@pytest.mark.parametrize(("column", "named"), [("y", "y"), (None, "x")])
def test_a_refusal_names_the_column_that_is_corrected_or_read(column, named, monkeypatch):
    told = []

    def refuse(table, name, *_):
        told.append(name)
        raise UsageError("outside")

    monkeypatch.setattr(correction, "_refuse_outside", refuse)
    monkeypatch.setattr(
        correction.prediction, "hold_inside", lambda *_: (np.ones(3, dtype=bool), {})
    )
    found = mp.regress(
        {"x": np.arange(9.0), "y": np.arange(9.0) ** 2 / 7.0}, response="y", variables="x"
    )
    table = {"x": [1.0, 2.0, 3.0]} | ({"y": [1.0, 2.0, 3.0]} if column else {})
    with pytest.raises(UsageError):
        mp.correct(found, table, column=column, outside="refuse")
    assert told == [named]


@pytest.mark.parametrize(("beyond", "said"), [(3, "3 of 40 rows"), (40, "40 of 40 rows")])
def test_rows_beyond_the_calibration_are_counted(beyond, said):
    found = added_columns.found_applying(mp.demo().calibration, (), beyond, 40)
    (outside,) = [each for each in found if each.code == "outside"]
    assert outside.text.startswith(said)
    assert ("unit" in outside.action) is (beyond == 40)
