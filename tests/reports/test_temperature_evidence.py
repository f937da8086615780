"""A report draws what changes with temperature."""

import numpy as np
import pytest

import multipos as mp
from multipos.reports.certificate import build_content
from multipos.reports.documents import html_report
from multipos.reports.evidence import temperature_sections


@pytest.fixture(scope="module")
def warmed():
    rng = np.random.default_rng(1)
    up = np.tile(mp.read_scheme("faces-6").up, (3, 1))
    T = np.repeat([-20.0, 20.0, 60.0], 6)
    columns = dict(zip(("up_x", "up_y", "up_z"), up.T, strict=True))
    columns |= {"ax": up[:, 0] + 1e-3 * T + 1e-5 * rng.standard_normal(18), "temperature": T}
    return columns


def test_the_section_shows_the_parameters_that_change(warmed):
    c = mp.fit(warmed, model="1 + x + y + z + temperature", unit="g")
    page = html_report(build_content(c))
    assert "Parameters over temperature" in page
    assert "band, all temperatures" in page
    assert "20 to 60 °C." in page


def test_without_temperature_terms_there_is_no_section(warmed):
    titles = [section.title for section in build_content(mp.fit(warmed, unit="g")).sections]
    assert "Over temperature" not in titles


def test_a_user_defined_model_has_no_section(warmed):
    readings = mp.Readings(
        np.column_stack([warmed["ax"]]),
        up=np.tile(mp.read_scheme("faces-6").up, (3, 1)),
        unit="g",
        environment={"temperature": warmed["temperature"]},
    )
    c = mp.fit(readings, model="each = bias + scale*own + change*temperature", axes="x")
    assert c.model.environment == ("temperature",)
    assert temperature_sections(c) == ()
