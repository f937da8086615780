"""Examples of messages, as tests make them: `python docs/examples.py [TEST …]`.

The tests are run (those of ROOMS where none is named), and of each code without an example, or
with one that the program no longer says, the shortest sentence with a number goes to
`examples.toml`, which `generated.py` shows beside what the code's sentences are made of.
"""

import json
import re
import sys
import tomllib
from pathlib import Path

import pytest

from multipos import finding

sys.path.insert(0, str(Path(__file__).resolve().parent))

import generated  # beside this file

DOCS = Path(__file__).resolve().parent
ROOMS = (
    *("bias_stability", "capturing", "commands", "compensation", "diagnostics", "estimation"),
    *("exports", "fleets", "logs", "positions", "regression", "sensor", "uncertainty"),
    "verification",
)
FOLDER = re.compile(r"(?<!\S)/\S*/")  # of a test, before the name of its file
HEAD = "# What findings said in tests, a code each: written by docs/examples.py.\n\n"


class Listener:
    """Hears every finding that is made while tests run."""

    def __init__(self) -> None:
        self.heard: dict[str, set[str]] = {}

    def pytest_configure(self, config: pytest.Config) -> None:
        make = finding.Finding.__init__

        def heard(self_: finding.Finding, *parts: object, **named: object) -> None:
            make(self_, *parts, **named)  # type: ignore[arg-type]
            self.heard.setdefault(self_.code, set()).add(self_.text)

        finding.Finding.__init__ = heard  # type: ignore[method-assign]


def main() -> None:
    listener = Listener()
    tests = sys.argv[1:] or [str(DOCS.parent / "tests" / name) for name in ROOMS]
    pytest.main(["-q", "--no-header", "-p", "no:cacheprovider", *tests], plugins=[listener])
    path = DOCS / "examples.toml"
    examples = tomllib.loads(path.read_text("utf-8"))
    texts: dict[str, list[str]] = {}
    for made in generated.messages((DOCS.parent / "multipos").rglob("*.py"), "…"):
        for code in made.codes:
            texts.setdefault(code, []).extend(made.texts)
    for code in texts.keys() & listener.heard.keys():
        said = [FOLDER.sub("", text) for text in listener.heard[code]]
        said = [text for text in said if generated.is_said(text, texts[code])]
        shown = [text for text in said if re.search(r"\d", text)] or said
        if shown and not generated.is_said(examples.get(code, ""), texts[code]):
            examples[code] = min(shown, key=lambda text: (len(text), text))
    lines = (
        f"{code} = {json.dumps(text, ensure_ascii=False)}\n"
        for code, text in sorted(examples.items())
        if code in texts
    )
    path.write_text(HEAD + "".join(lines), encoding="utf-8")


if __name__ == "__main__":
    main()
