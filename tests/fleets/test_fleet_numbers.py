"""Numbers of fleets by hand or by a second route, at points without symmetry."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from multipos.fleets import line, stations
from multipos.fleets.unit_findings import _one_row
from multipos.numerics.rotations import rotation_matrix


@pytest.mark.parametrize("kind", ["trend", "step"])
def test_a_station_that_changed_is_said_with_its_size_and_u(kind, monkeypatch):
    """A line from −½ to ½ over the units, or two means; one unit far off is left out of both."""
    rng = np.random.default_rng(4)
    n, after = 20, 8
    x = np.arange(n) / 19 - 0.5
    values = (0.7 * x if kind == "trend" else np.where(np.arange(n) < after, 0.0, 0.5)) + 0.3
    values = values + 0.02 * rng.normal(size=n)
    kept = np.arange(n) != 5
    monkeypatch.setattr(line, "near_median", lambda values, finite, same: kept)
    parameters = np.full((n, 2), 9.0)
    parameters[:, 1] = values
    units = SimpleNamespace(
        parameters=parameters, names=("a", "b"), unit=[f"u{i}" for i in range(n)],
        time=100.0 + np.arange(n),
    )  # fmt: skip
    said = line._said(units, True, "s", 1, np.arange(n), after, 0.003)
    y = values[kept]
    if kind == "trend":
        z = x[kept]
        slope = (z @ y) / (z @ z)
        left = (y - y.mean()) - slope * (z - z.mean())
        size, u = slope, math.sqrt(left @ left / (len(y) - 2) / (z @ z))
    else:
        low, high = values[:after][kept[:after]], values[after:]
        left = np.concatenate([low - low.mean(), high - high.mean()])
        size = high.mean() - low.mean()
        u = math.sqrt(left @ left / (len(y) - 2) * (1 / len(low) + 1 / len(high)))
    assert (said["kind"], said["from_unit"], said["time"]) == (kind, "u8", 108.0)
    assert (said["value"], said["u"]) == (pytest.approx(size), pytest.approx(u))
    assert (said["name"], said["p"], said["order"]) == ("b", 0.003, "time")
    assert line._said(units, False, "s", 1, np.arange(n), after, 0.003)["time"] is None


def test_the_row_that_is_most_off_of_a_unit():
    """−ν ln Π(1 − share) of outputs, less the price of so many numbers and of the choice."""
    share = np.array([[[0.1, 0.6, 0.2, 0.55], [0.1, 0.6, 0.2, 0.0]], [[0.0, 0.3, 0.1, 0.3]] * 2])
    score, second = _one_row(SimpleNamespace(nu=7.0, freedom=18.0), share)
    gain = [-7.0 * math.log(0.4 * 0.7), -7.0 * math.log(0.45 * 0.7)]
    price = 2 * math.log(18.0) + 2 * math.log(4)
    np.testing.assert_allclose(score, gain[0] - price)
    from multipos.fleets.unit_findings import _COMPARABLE

    others = [gain[1], -7.0 * math.log(0.8 * 0.9)]
    others[1] = max(others[1], -7.0 * math.log(0.7))
    assert second.tolist() == [other > _COMPARABLE * gain[0] for other in others]


def test_levels_of_stations_are_turns_from_the_typical_unit(monkeypatch):
    """Half of what K⁻¹K' is off from its transpose, in degrees, about x, y and z."""
    given = []
    monkeypatch.setattr(
        stations, "_against_mean", lambda turned, *rest: given.append(turned) or [None, None]
    )
    typical = np.array([[2.0, 0.1, -0.2], [0.05, 1.5, 0.15], [-0.1, 0.2, 1.1]])
    turns = np.array([[0.0, 0.0, 0.0], [0.01, -0.02, 0.03], [-0.01, 0.02, -0.03]])
    matrix = np.array([typical @ rotation_matrix(turn).T for turn in turns])
    monkeypatch.setattr(stations, "linear_parts", lambda model, parameters: matrix)
    units = SimpleNamespace(model=1, parameters=None)
    stations._levels(units, np.ones(3, dtype=bool), None, None, 2)
    for place in range(3):
        np.testing.assert_allclose(
            np.abs(given[place]), np.degrees(np.abs(turns[:, place])), atol=0.03
        )
        assert given[place][1] * given[place][2] < 0.0
    signs = [math.copysign(1.0, given[place][1] * turns[1, place]) for place in range(3)]
    assert len(set(signs)) == 1  # all by one rule of the hand


def test_a_fixture_is_corrected_by_its_mean_angles():
    """Two rows repeat a position and share its angle; u of all angles as one of each position."""
    up = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [1.0, 0.0, 0.0]])
    part = SimpleNamespace(up=up, labels=("p", "q", "p"), identifiable=np.ones(3, dtype=bool))
    mean = np.array([[0.0, 0.02, 0.0], [0.01, 0.0, 0.03], [0.0, 0.04, 0.02]])
    u = np.array([[0.001, 0.002, 0.0], [0.003, 0.0, 0.001], [0.002, 0.002, 0.0]])
    found = stations._correction([part, part], mean, u, 12)
    angles = [(mean[0] + mean[2]) / 2.0, mean[1]]
    wanted = [rotation_matrix(a) @ f for a, f in zip(angles, up, strict=False)]
    assert found["scheme"]["position"] == ["p", "q"]
    corrected = np.column_stack([found["scheme"][f"up_{axis}"] for axis in "xyz"])
    np.testing.assert_allclose(corrected, wanted)
    orientation = found["budget"]["orientation"]
    assert orientation["u_deg"] == pytest.approx(math.degrees(math.sqrt(np.sum(u**2) / 6)))
    assert orientation["dof"] == 11.0
    assert stations._correction([part], mean, u, stations.FEWEST - 1) is None
    assert stations._correction([part], mean, u, stations.FEWEST) is not None
    other = SimpleNamespace(**{**vars(part), "up": -up})
    assert stations._correction([part, other], mean, u, 12) is None
