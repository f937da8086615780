"""What reports say of a calibration that was combined from sessions."""

import numpy as np
import pytest

import multipos as mp
from multipos.reports.certificate import build_content

UP = mp.read_scheme("faces-edges-18").up


@pytest.fixture(scope="module")
def compared():
    """Four sessions whose zeros differ by 2 mg, far more than the noise of each."""
    rng = np.random.default_rng(3)
    sessions = [
        mp.fit(
            mp.Readings(
                UP + 2e-3 * rng.standard_normal(3) + 1e-4 * rng.standard_normal(UP.shape), up=UP
            ),
            unit="g",
        )
        for _ in range(4)
    ]
    return mp.compare(sessions, combine=True)


def table_of(content):
    (section,) = (part for part in content.sections if part.title == "Combined sessions")
    return section, {row[0]: row for row in section.tables[0].rows}


def test_a_combined_calibration_says_of_what_and_what_u_holds(compared):
    section, rows = table_of(build_content(compared.combined))
    assert section.paragraphs[0].startswith("4 sessions were combined: ")
    assert "on 9 degrees of freedom" in section.paragraphs[1]
    zeros = np.array([c["bias_ax"].value for c in compared.calibrations])
    _, value, u, U, unit, k, spread = rows["bias_ax"]
    assert (unit, k) == ("mg", "2.26")  # Student's t at 3 degrees of freedom of each of 3 zeros
    sd = 1e3 * zeros.std(ddof=1)
    every = np.array([[c[f"bias_a{a}"].value for a in "xyz"] for c in compared.calibrations])
    pooled = 1e3 * np.sqrt(every.var(axis=0, ddof=1).mean())
    assert float(value) == pytest.approx(1e3 * zeros.mean(), abs=0.02 * sd)
    assert float(spread) == pytest.approx(sd, rel=0.05)
    assert float(u) == pytest.approx(np.sqrt(1.25) * pooled, rel=0.05)  # (1 + 1/4) S
    assert float(U) == pytest.approx(2.262 * np.sqrt(1.25) * pooled, rel=0.05)
    assert not any(
        part.title == "Combined sessions"
        for part in build_content(compared.calibrations[0]).sections
    )


def test_the_scatter_within_a_session_is_named_so(compared):
    """Residuals of all sessions together are far beyond the noise within one."""
    from multipos.plots import draw_residuals, new_figure

    for cal, label in (
        (compared.combined, "±2 sd within a session"),
        (compared.calibrations[0], "±2 sd"),
    ):
        _, (axes,) = new_figure()
        draw_residuals(cal, axes, output="ax")
        assert axes.get_legend_handles_labels()[1] == [label, "ax"]
