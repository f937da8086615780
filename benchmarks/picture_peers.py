"""The picture of the peers: the error of every program on every simulation, from the page's table.

`python -m benchmarks.picture_peers benchmarks/tables.md docs/figures/peers.svg` draws it. What the
table says was measured by `benchmarks.peers`, which takes the peers and hours; this takes neither.
"""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.picture import on_white
from multipos.plots import style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RECORDING, PROGRAM, ERROR = 0, 1, 4  # columns of the table
OURS = {  # by the marker, whether it is filled, and the name
    "multipos": ("o", True, "multipos"),
    "multipos, then as it advises": ("o", False, "multipos, as advised"),
    "multipos --orientation-sd 0": ("x", False, "multipos, exact orientations"),
}
THEIRS = {"mag_cal": "s", "imucal": "^", "actipy": "D", "skdh": "v"}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.picture_peers")
    parser.add_argument("page", type=Path, help="with the table")
    parser.add_argument("picture", type=Path, metavar="PICTURE.svg")
    chosen = parser.parse_args()
    figure = drawn(errors(chosen.page.read_text(encoding="utf-8")))
    chosen.picture.write_text(on_white(style.to_svg(figure)), encoding="utf-8")


def errors(page: str) -> dict[str, dict[str, float]]:
    """Return the error [µg] by recording and program, where the truth is known."""
    found: dict[str, dict[str, float]] = {}
    for line in page.split("## Peers on the package index")[1].split("\n## ")[0].splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) > ERROR and cells[ERROR].replace(".", "").isdigit():
            found.setdefault(cells[RECORDING], {})[cells[PROGRAM]] = float(cells[ERROR])
    return found


def drawn(found: dict[str, dict[str, float]]) -> "Figure":
    figure, (axes,) = style.new_figure(width=6.6, height=3.2)
    named = set()
    for row, programs in enumerate(found.values()):
        for program, error in programs.items():
            mark, filled, label = OURS.get(program, (THEIRS.get(program, "x"), False, program))
            colour = style.COLOURS[0 if program in OURS else 1]
            axes.plot(
                error,
                row,
                mark,
                color=colour,
                markersize=6,
                fillstyle="full" if filled else "none",
                label=None if label in named else label,
            )
            named.add(label)
    style.scale_by_powers(axes, "x")
    axes.set_yticks(range(len(found)), list(found))
    axes.invert_yaxis()
    axes.grid(axis="y", color="#dddddd", linewidth=0.6)
    axes.set_xlabel("error [µg]")
    style.name_series(axes, 3)
    return figure


if __name__ == "__main__":
    main()
