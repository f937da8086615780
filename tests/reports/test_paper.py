"""The report on paper: its pages, its size, and no heading without what it heads."""

import re
import shutil
import subprocess

import browser
import numpy as np
import pytest

import multipos as mp
from multipos.reports.certificate import build_content
from multipos.reports.documents import html_report, pdf_report

needs_pages = pytest.mark.skipif(
    browser.find() is None or shutil.which("pdftotext") is None,
    reason="needs Chromium and pdftotext",
)
SCHEME = "roll-x-8+roll-y-8+roll-z-8"
LAB = {
    "report": {"number": "K-7", "authorised_by": "the head", "issued": "2026-03-09"},
    "laboratory": {"name": "Laboratory", "address": "Street 1", "country": "DE"},
    "customer": {"name": "Customer", "address": "Street 2"},
    "item": {"description": "accelerometer", "serial": "17"},
    "equipment": [{"name": "dividing head", "serial": "3"}, {"name": "voltmeter", "serial": "4"}],
}
BUDGET = {"level": {"half_width_deg": 0.005}, "orientation": {"u_deg": 0.002}, "gain": {"u": 2e-5}}


def readings(scheme, seed):
    up = mp.read_scheme(scheme).up
    noise = 1e-4 * np.random.default_rng(seed).standard_normal(up.shape)
    values = [0.01, -0.02, 0.025] + 1.2 * up + 1e-3 * up**2 + noise
    return mp.Readings(values, unit="V")


@pytest.fixture(scope="module")
def checked():
    """A calibration of 24 positions in rolls with a budget, and an independent run of 24."""
    given = {"model": "own-quadratic", "gravity": 9.81, "gravity_u": 1e-5, "budget": BUDGET}
    cal = mp.fit(readings(SCHEME, 1), scheme=SCHEME, **given)
    return cal, mp.check(cal, readings("fibonacci-24", 9), scheme="fibonacci-24", limit_g=2e-3)


@pytest.fixture(scope="module")
def content(checked):
    cal, run = checked
    return build_content(cal, lab=LAB, check=run)


def pages_of(path):
    """Return the words of every page, spaces and line ends taken as one."""
    text = subprocess.run(["pdftotext", "-layout", path, "-"], capture_output=True, check=True)
    pages = text.stdout.decode("utf-8").split("\f")[:-1]
    return [re.sub(r"\s+", " ", page) for page in pages]


def assert_holds_together(pages, content):
    """Every heading stands on the page where its first figure or table begins."""
    assert len(pages) <= 6
    for section in content.sections:
        first = next(
            (
                part
                for part in (*section.figures, *section.tables)
                if getattr(part, "on_paper", True)
            ),
            None,
        )
        if first is None:
            continue
        told = [i for i, page in enumerate(pages) if f" {section.title} " in f" {page}"]
        # A caption may be broken into lines beside a table: its first words are enough.
        words = " ".join(first.caption.split()[:3])
        drawn = [i for i, page in enumerate(pages) if words in page]
        assert set(told) & set(drawn), (section.title, told, drawn)
        for paragraph in section.paragraphs:
            start = " ".join(paragraph.split()[:5])
            assert set(told) & {i for i, page in enumerate(pages) if start in page}


@pytest.mark.slow
@needs_pages
def test_a_browser_prints_six_pages(content, tmp_path):
    target = tmp_path / "report.html"
    target.write_text(html_report(content), encoding="utf-8")
    assert target.stat().st_size < 1e6
    with browser.browse(tmp_path) as page:
        page.open(target)
        page.pdf(tmp_path / "report.pdf")
    assert (tmp_path / "report.pdf").stat().st_size < 1e6
    assert_holds_together(pages_of(tmp_path / "report.pdf"), content)


@pytest.mark.skipif(shutil.which("pdftotext") is None, reason="needs pdftotext")
def test_the_extra_prints_six_pages(content, tmp_path):
    pytest.importorskip("weasyprint")
    target = tmp_path / "report.pdf"
    target.write_bytes(pdf_report(content))
    assert target.stat().st_size < 1e6
    assert_holds_together(pages_of(target), content)
