"""The pictures of the pages: `python docs/pictures.py [PAGE …]` draws them again.

A page runs a command or a few lines that draw a file; `<!-- drawn: FILE -->` above an image says
that it is that file, kept. What draws it runs whenever the tests run the page, and `gallery.md`
shows all pictures with it.
"""

import re
import sys
import tempfile
from collections.abc import Iterator
from contextlib import chdir
from dataclasses import dataclass
from pathlib import Path

DOCS = Path(__file__).resolve().parent
MARK = re.compile(
    r"^<!-- drawn: (?P<drawn>\S+) -->\n!\[(?P<told>[^\]]*)\]\((?P<kept>\S+)\)$", re.MULTILINE
)
FENCED = re.compile(
    r"^```(?P<language>console|python)\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL
)
PAPER = '<rect width="100%" height="100%" fill="#ffffff"/>'
HEAD = """# Gallery

Every picture of these pages with the command or the lines that drew it. The pages give the
readings, and the tests run them; `python docs/pictures.py` draws all again.
[A notebook](notebook.ipynb) goes the whole way from a log to C, with what every cell gives.
"""


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


def drawing(picture: Picture) -> str:
    """Return the fenced command, or the lines of Python, that draw a picture."""
    for block in FENCED.finditer(picture.page.read_text("utf-8")):
        language, text = block["language"], block["text"]
        if picture.drawn not in text:
            continue
        if language == "console":
            commands = re.findall(r"^\$ .*(?:\n> .*)*", text, re.MULTILINE)
            text = next(command for command in commands if picture.drawn in command) + "\n"
        return f"```{language}\n{text}```"
    raise ValueError(f"{picture.page.name} does not draw {picture.drawn}")


def gallery_page() -> str:
    parts = [HEAD]
    for picture in every_picture():
        name = picture.page.relative_to(DOCS).as_posix()
        title = picture.page.read_text("utf-8").splitlines()[0].removeprefix("# ")
        kept = picture.kept.relative_to(DOCS).as_posix()
        head = f"## {picture.told}\n\n![{picture.told}]({kept})\n\n"
        parts.append(f"{head}From [{title}]({name}):\n\n{drawing(picture)}\n")
    return "\n".join(parts)


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
    (DOCS / "gallery.md").write_text(gallery_page(), encoding="utf-8")


if __name__ == "__main__":
    main()
