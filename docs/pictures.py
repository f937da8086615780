"""The pictures of the pages: `python docs/pictures.py [PAGE …]` draws them again.

A page runs a command or a few lines that draw a file; `<!-- drawn: FILE -->` above an image says
that it is that file, kept. What draws it runs whenever the tests run the page.
"""

import re
import sys
import tempfile
from collections.abc import Iterator
from contextlib import chdir
from dataclasses import dataclass
from math import ceil
from pathlib import Path

DOCS = Path(__file__).resolve().parent
MARK = re.compile(
    r"^<!-- drawn: (?P<drawn>\S+) -->\n!\[(?P<told>[^\]]*)\]\((?P<kept>\S+)\)$", re.MULTILINE
)
PAPER = '<rect width="100%" height="100%" fill="#ffffff"/>'


@dataclass(frozen=True)
class Picture:
    """A picture of a page: the file that is drawn, what it shows, and where it is kept."""

    page: Path
    drawn: str
    told: str
    kept: Path


def pictures(page: Path) -> list[Picture]:
    found = MARK.finditer(page.read_text("utf-8"))
    return [
        Picture(page, mark["drawn"], mark["told"], (page.parent / mark["kept"]).resolve())
        for mark in found
    ]


def every_picture() -> Iterator[Picture]:
    for page in sorted(DOCS.rglob("*.md")):
        if "_build" not in page.parts:
            yield from pictures(page)


def keep(drawn: Path, kept: Path) -> None:
    """Keep a picture, black on white whatever the page is like.

    Pixels are made fewer, of few colours, as pages need no more of them.
    """
    kept.parent.mkdir(exist_ok=True)
    if drawn.suffix == ".svg":
        text = re.sub(r"<svg [^>]*>", lambda tag: tag[0] + PAPER, drawn.read_text("utf-8"), count=1)
        kept.write_text(text, encoding="utf-8")
        return
    from PIL import Image

    with Image.open(drawn) as image:
        image = image.convert("RGB")
        image.thumbnail((1000, 2000))
        image.quantize(32, dither=Image.Dither.NONE).save(kept, optimize=True)


LEAST = 9.0  # px of a label, also on a telephone, where a wider figure is scrolled in its box
_PNG = 632.0  # px, at which labels of 8 points are so large in the widest, of 7.8 inches
_FONT = re.compile(r"font-size(?:: |=\")([\d.]+)")


def least_width(kept: Path) -> int:
    """Return the width [px] at which the smallest label of a picture can be read."""
    if kept.suffix != ".svg":
        return int(_PNG)
    text = kept.read_text("utf-8")
    found = re.search(r'viewBox="[-\d.]+ [-\d.]+ ([\d.]+)', text)
    assert found is not None
    sizes = [float(size) for size in _FONT.findall(text)]
    return ceil(LEAST * float(found[1]) / min(sizes))


def main() -> None:
    sys.path.insert(0, str(DOCS.parent / "tests"))
    from test_docs import run_page

    chosen = [Path(name).resolve() for name in sys.argv[1:]]
    for page in chosen or sorted({picture.page for picture in every_picture()}):
        with tempfile.TemporaryDirectory() as folder, chdir(folder):
            for problem in run_page(page, Path(folder)):
                print(problem, file=sys.stderr)
            for picture in pictures(page):
                keep(Path(folder, picture.drawn), picture.kept)
                print(picture.kept.relative_to(DOCS), picture.kept.stat().st_size)


if __name__ == "__main__":
    main()
