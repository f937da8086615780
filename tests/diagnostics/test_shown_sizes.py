"""Sizes of higher order that positions show are those of a fit with the term."""

import numpy as np
import pytest
from findings_bench import EXACT

import multipos as mp
from multipos.diagnostics.projections import shown_sizes
from multipos.files.numbers import in_unit


def fitted(scheme, model="linear", cubic=0.0, **options):
    up = mp.read_scheme(scheme).up
    values = 0.01 + up @ np.diag([2.0, 4.0, 8.0]) + cubic * np.array([2.0, 4.0, 8.0]) * up**3
    values += 1e-3 * np.random.default_rng(3).standard_normal(up.shape)
    return mp.fit(mp.Readings(values, up=up, unit="V"), model=model, **EXACT, **options)


def test_sizes_are_those_of_a_fit_with_the_term():
    # eq. (3) of diagnostics.projections
    found = shown_sizes(fitted("fibonacci-24", cubic=2e-3))
    wider = fitted("fibonacci-24", "1 + x + y + z + own^3", cubic=2e-3)
    of_term = [i for i, (_, term) in enumerate(wider.model.keys) if term.force_degree == 3]
    response = np.linalg.norm(wider.sensitivity, axis=1)
    # |K| of the fit without the term holds .6 of the cubic, 1.2e-3 of it
    expected = np.hypot(wider.parameters[of_term], wider.u[of_term]) / response
    assert found["own^3"] == pytest.approx(np.sqrt(np.mean(expected**2)), rel=3e-3)
    assert found["own^3"] == pytest.approx(2e-3, rel=0.3)
    assert "own^3" in shown_sizes(wider) or "x^3" in shown_sizes(wider)


def test_six_faces_show_the_square_alone_and_the_report_says_so(tmp_path):
    cal = fitted("faces-6")
    (size,) = shown_sizes(cal).values()
    assert list(shown_sizes(cal)) == ["own^2"]
    page = tmp_path / "report.md"
    mp.report(cal, page)
    said = page.read_text("utf-8")
    assert "The model omits own^2" in said
    assert f"own^2 ({in_unit(size, 'g')})" in said


def test_nothing_is_said_of_noise_that_is_not_one_for_each_output():
    assert shown_sizes(fitted("faces-6", reading_sd=1e-3)) == {}
