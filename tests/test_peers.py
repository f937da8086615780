"""The comparison with other programs: what it prints, also where no peer is installed."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "benchmarks/tables.md"


def rows(text):
    """Return the cells of the first table, a list a row."""
    table = re.search(r"^\| recording \| program .*\n(?:\|.*\n)+", text, re.MULTILINE)
    return [[cell.strip() for cell in line.split(" | ")] for line in table[0].splitlines()]


@pytest.mark.slow
def test_it_prints_the_rows_of_its_page():
    command = [sys.executable, "-m", "benchmarks.peers", "--runs", "1", "--pairs", "0"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, encoding="utf-8", check=True)
    printed, page = rows(done.stdout), rows(PAGE.read_text("utf-8"))
    assert printed[0] == page[0]
    mine = {tuple(row[:2]): row for row in printed[2:] if row[1].startswith("multipos")}
    # What is advised comes up by chance as well, once in a hundred sets that lack nothing.
    steady = {key for key in mine if not key[1].endswith("advises")}
    known = {tuple(row[:2]) for row in page[2:] if row[1].startswith("multipos") and row[4] != "–"}
    assert steady == {key for key in known if not key[1].endswith("advises")}
    # K2 of 2 mg/g² is found, and the fit that is advised leaves less than half of the error.
    name = "| 24 rests, K2 of 2 mg/g²"
    assert mine[name, "multipos"][8] == "missing-term"
    left = [
        float(mine[name, program][4]) for program in ("multipos", "multipos, then as it advises")
    ]
    assert left[1] < 0.5 * left[0]
    # Faces placed to .2° put the zero off by milli-g where they are taken as exact.
    name = "| six faces placed to .2°"
    left = [
        float(mine[name, program][5]) for program in ("multipos --orientation-sd 0", "multipos")
    ]
    assert left[1] < 0.5 * left[0]


def test_its_picture_is_of_its_page(tmp_path):
    drawn = tmp_path / "peers.svg"
    command = [sys.executable, "-m", "benchmarks.picture_peers", str(PAGE), str(drawn)]
    subprocess.run(command, cwd=ROOT, check=True)
    shown, kept = (
        re.findall(r"<text[^>]*>([^<]*)</text>", picture.read_text("utf-8"))
        for picture in (drawn, ROOT / "docs/figures/peers.svg")
    )
    assert shown == kept
    assert "worn for 13 h, axes askew" in shown
