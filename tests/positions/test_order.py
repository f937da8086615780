"""Orders of positions: what of a drift is absorbed, short ways, labels that stay."""

import itertools

import numpy as np
import pytest
from numpy.testing import assert_allclose

import multipos as mp
from multipos.errors import UsageError
from multipos.positions.order import travel_deg, travel_order
from multipos.positions.scheme import named_schemes, read_scheme

SIX = ("faces-6", "song-qin-6")


def absorbed(up, course):
    """Share of the variance of a course that least squares of the linear model takes."""
    X = np.column_stack([np.ones(len(up)), up])
    course = course - course.mean()
    left = course - X @ np.linalg.lstsq(X, course, rcond=None)[0]
    return 1.0 - (left @ left) / (course @ course)


@pytest.mark.parametrize("name", [n for n in named_schemes() if n not in SIX] + ["fibonacci-12"])
def test_the_default_order_hides_no_drift(name):
    up = read_scheme(name, order="spread").up
    row = np.arange(len(up)) - 0.5 * (len(up) - 1)
    assert absorbed(up, row) < 0.05
    if len(up) >= 12:
        assert absorbed(up, row**2) < 0.05
        assert absorbed(up, np.sin(2.0 * np.pi * row / len(up))) < 0.05


def test_the_published_order_of_a_spiral_hides_it_whole():
    # eq. (1) of positions.order
    assert absorbed(read_scheme("fibonacci-24").up, np.arange(24.0)) == pytest.approx(1.0)


def test_six_positions_absorb_the_least_that_they_can():
    least = min(
        absorbed(read_scheme("faces-6").up[list(rows)], np.arange(6.0))
        for rows in itertools.permutations(range(6))
    )
    found = absorbed(read_scheme("faces-6", order="spread").up, np.arange(6.0))
    assert found == pytest.approx(least, abs=1e-12)
    (entry,) = mp.schemes("faces-6").schemes
    assert entry.drift_absorbed == pytest.approx(least, abs=1e-12)


def test_labels_stay_with_their_directions():
    published, spread = (read_scheme("all-26", order=order) for order in ("paper", "spread"))
    assert published.labels != spread.labels
    where = [published.labels.index(label) for label in spread.labels]
    assert_allclose(spread.up, published.up[where], rtol=0, atol=0)
    assert read_scheme("song-qin-6", order="spread").labels == read_scheme("song-qin-6").labels
    with pytest.raises(UsageError, match="--order"):
        read_scheme("faces-6", order="random")


@pytest.mark.parametrize("order", ["spread", "paper"])
def test_rows_are_matched_by_label_in_any_order_and_else_in_the_order_stated(order):
    sensor = mp.demo().calibration
    run = mp.simulate(sensor, "faces-corners-14", order=order, reading_sd=1e-4, seed=2)
    readings = {name: run[name] for name in ("position", "ax", "ay", "az")}
    how = {"scheme": "faces-corners-14", "convention": "gravity"}
    labelled = mp.fit(readings, **how)
    del readings["position"]
    assert_allclose(mp.fit(readings, order=order, **how).parameters, labelled.parameters, rtol=1e-9)
    assert labelled.rms < 1e-3


def test_a_position_has_the_same_errors_in_every_order():
    sensor = mp.demo().calibration
    runs = [
        mp.simulate(sensor, "edges-12", order=order, reading_sd=1e-3, orientation_sd=1.0, seed=4)
        for order in ("paper", "spread")
    ]
    rows = [list(runs[0]["position"]).index(label) for label in runs[1]["position"]]
    assert_allclose(runs[1]["ax"], np.asarray(runs[0]["ax"])[rows], rtol=0, atol=1e-15)


def test_travel_of_many_positions_ends_and_is_short():
    rng = np.random.default_rng(5)
    up = read_scheme("fibonacci-100").up[rng.permutation(100)]
    ordered = up[travel_order(up)]
    assert_allclose(np.sort(ordered, axis=0), np.sort(up, axis=0), rtol=0, atol=0)
    assert_allclose(ordered[0], up[0], rtol=0, atol=0)
    # 100 even points lie about 20.4 degrees apart, so 99 steps turn 2020 degrees at least
    assert 2020.0 * 0.95 < travel_deg(ordered) < 2020.0 * 1.1


def test_travel_is_the_shortest_of_all_orders():
    rng = np.random.default_rng(7)
    for _ in range(5):
        up = rng.standard_normal((7, 3))
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        ordered = up[travel_order(up)]
        shortest = min(travel_deg(up[[0, *order]]) for order in itertools.permutations(range(1, 7)))
        assert travel_deg(ordered) <= 1.05 * shortest
        assert sorted(map(tuple, ordered)) == sorted(map(tuple, up))
    # five quarter turns visit the faces
    assert travel_deg(read_scheme("faces-6", order="travel").up) == pytest.approx(450.0)


def readings_of(scheme, seed=1, **columns):
    noise = 2e-4 * np.random.default_rng(seed).standard_normal(scheme.up.shape)
    values = scheme.up * [1.01, 0.99, 1.0] + [0.01, 0.02, -0.03] + noise
    return dict(zip(("ax", "ay", "az"), values.T, strict=True)) | columns


@pytest.mark.parametrize("name", ["fibonacci-24", "faces-corners-14", "icosahedron-12", "all-26"])
def test_rows_that_were_laid_out_against_drift_are_recognised(name):
    readings = readings_of(read_scheme(name, order="spread"))
    (found,) = [each for each in mp.fit(readings, scheme=name).findings if each.level == "error"]
    assert (found.code, found.action) == ("interchanged-rows", "Fit with --order spread.")
    followed = mp.fit(readings, scheme=name, order="spread")
    assert not [each for each in followed.findings if each.level == "error"]
    assert followed.rms < 1e-3


def test_a_note_says_what_of_a_drift_the_order_absorbs():
    """Rows with a time: the spiral takes all of a drift, the default order next to nothing."""
    said = {}
    for order in ("paper", "spread"):
        readings = readings_of(read_scheme("fibonacci-24", order=order), time=60.0 * np.arange(24))
        found = mp.fit(readings, scheme="fibonacci-24", order=order).findings
        said[order] = [each for each in found if each.code == "drift-absorbed"]
    assert "100 %" in said["paper"][0].text
    assert said["paper"][0].level == "note"
    assert not said["spread"]
