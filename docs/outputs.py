"""What the commands and examples of pages print, written again: `python docs/outputs.py PAGE …`.

Every block of a page is run as `tests/test_docs.py` runs it; where the page shows something else,
what is printed now takes its place, whole; read the change before you commit it. Without a page
all are run.
"""

import doctest
import io
import os
import re
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import test_docs  # noqa: E402  # after the path to it


def rewrite(page: Path) -> bool:
    """Write what a page's blocks print now into it; return whether anything changed."""
    before = page.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        here = Path.cwd()
        os.chdir(folder)
        try:
            changes = _run(page, Path(folder))
        finally:
            os.chdir(here)
    lines = before.splitlines()
    for start, stop, new in sorted(changes, reverse=True):
        lines[start:stop] = new
    text = "\n".join(lines) + "\n"
    page.write_text(text, encoding="utf-8")
    return text != before


def _run(page: Path, folder: Path) -> list[tuple[int, int, list[str]]]:
    """Return changes (from, to, lines) of a page whose blocks print something else."""
    namespace: dict[str, object] = {"__name__": "__main__"}
    changes: list[tuple[int, int, list[str]]] = []
    for one in test_docs.way_to(page):
        for block in test_docs.blocks(one):
            found: list[tuple[int, int, list[str]]] = []
            if block.note and block.note[0] == "file":
                (folder / block.note[1]).write_text(block.text, encoding="utf-8")
            elif block.note and block.note[0] == "command":
                pass
            elif block.language == "console":
                found = _console(block, folder)
            elif block.language == "python":
                found = _python(block, namespace)
            changes += found if one == page else []
    return changes


def _console(block, folder):
    changes = []
    everything = block.text.splitlines()
    for offset, command, expected in test_docs.commands(block):
        printed = test_docs.printed(command, folder)
        want, got = test_docs.tidy(expected), test_docs.tidy(printed.stdout)
        if want == got:
            continue
        start = offset + len(command.splitlines())
        stop = start + len(expected.splitlines())
        while stop > start and stop - 1 < len(everything) and not everything[stop - 1].strip():
            stop -= 1
        changes.append(_place(block, start, stop, got.rstrip("\n").splitlines()))
    return changes


def _python(block, namespace):
    if ">>>" not in block.text:
        exec(compile(block.text, block.page, "exec"), namespace)
        return []
    test = doctest.DocTestParser().get_doctest(block.text, namespace, "page", None, 0)
    runner = _Recorder(optionflags=test_docs.FLAGS)
    runner.run(test, out=io.StringIO().write, clear_globs=False)
    namespace.update(test.globs)
    changes = []
    for example, got in runner.other:
        start = example.lineno + len(example.source.splitlines())
        stop = start + len(example.want.splitlines())
        got = re.sub(r"^\s*$", "<BLANKLINE>", got.rstrip("\n"), flags=re.MULTILINE)
        changes.append(_place(block, start, stop, got.splitlines()))
    return changes


class _Recorder(doctest.DocTestRunner):
    """Keeps what examples printed that the page does not show."""

    def __init__(self, **how):
        super().__init__(verbose=False, **how)
        self.other = []

    def report_failure(self, out, test, example, got):
        self.other.append((example, got))

    def report_unexpected_exception(self, out, test, example, exc_info):
        raise exc_info[1]


def _place(block, start, stop, new):
    """Return a change of a block's lines as lines of its page, indented as the block is."""
    page = block.page.read_text(encoding="utf-8").splitlines()
    first = block.line - 1
    indent = re.match(r" *", page[first - 1])[0]
    return first + start, first + stop, [f"{indent}{line}".rstrip() for line in new]


def main(arguments: list[str]) -> None:
    """Run the pages that are named, or all but the studies."""
    pages = [Path(name).resolve() for name in arguments]
    for page in pages or test_docs.RUN:
        try:
            changed = rewrite(page)
        except Exception as error:  # the next page all the same
            print(f"{page.relative_to(ROOT)}: {type(error).__name__}: {error}")
        else:
            print(f"{page.relative_to(ROOT)}: {'changed' if changed else 'as it was'}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
