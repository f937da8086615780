"""The text screen: the state of a session on a terminal, for who has no browser at hand.

It shows what `multipos.capturing.session` says and nothing of its own. A line on the keyboard is a
command: ``u`` takes the newest pose back, ``r LABEL`` takes one again, ``f`` finishes, ``l``
changes the language, which at first is that of the terminal.
"""

import os
import shutil
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from multipos.capturing.session import Session, state_of
from multipos.files.numbers import number, table
from multipos.reports.sections import Language, Translator

_OFTEN = 0.25  # [s] from one picture to the next
_SHOWN = 8  # poses


@contextmanager
def text_screen(session: Session, *, commands: bool) -> Iterator[None]:
    """Show a session on stderr while the block runs, where that is a terminal.

    Parameters
    ----------
    session : Session
    commands : bool
        Whether lines from stdin are commands.
    """
    if sys.stderr is None or not sys.stderr.isatty():
        yield
        return
    ended, chosen = threading.Event(), _Choice(_language_of_terminal())
    if commands and sys.stdin is not None and sys.stdin.isatty():
        threading.Thread(target=_obey, args=(session, chosen), daemon=True).start()

    def show() -> None:
        height = 0
        while not ended.wait(_OFTEN):
            with session.changed:
                state = state_of(session)
            height = _draw(picture_of(state, chosen.language), height)
        _draw([], height)

    thread = threading.Thread(target=show)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _draw(lines: Sequence[str], height: int) -> int:
    """Write lines in place of so many written before; return how many there are now."""
    wide = shutil.get_terminal_size().columns
    back = f"\x1b[{height}F\x1b[J" if height else ""
    text = "".join(f"{line[: wide - 1]}\n" for line in lines)
    if sys.stderr is not None:
        sys.stderr.write(back + text)
        sys.stderr.flush()
    return len(lines)


@dataclass
class _Choice:
    """The language that is shown."""

    language: Language


def _language_of_terminal() -> Language:
    named = (os.environ.get(name) for name in ("LC_ALL", "LC_MESSAGES", "LANG"))
    return "zh" if next(filter(None, named), "").lower().startswith("zh") else "en"


def _obey(session: Session, chosen: _Choice) -> None:
    for line in sys.stdin:
        if line.strip() == "l":
            chosen.language = "en" if chosen.language == "zh" else "zh"
        obey(session, line)


def obey(session: Session, line: str) -> None:
    """Do what a line says; what it does not know it leaves."""
    command, _, label = line.strip().partition(" ")
    with session.changed:
        if session.finished:
            return
        if command == "u":
            session.undo()
        elif command == "r":
            session.redo(label.strip())
        elif command == "f":
            session.asked_to_finish = True
        session.changed.notify_all()


def picture_of(state: Mapping[str, Any], language: Language = "en") -> list[str]:
    """Return what the terminal shows of a state, as lines."""
    tr = Translator(language)
    next_ = state["next"]
    lines = [_status(state, tr)]
    if next_ is not None:
        gain = ""
        if next_["gain"] is not None:
            gain = "  " + tr("(gain {size})", size=number(next_["gain"], 3))
        label = "" if next_["label"] is None else f"{next_['label']}: "
        lines.append(f"{tr('next')}: {label}{next_['words'][language]}{gain}")
    if state["missing"]:
        lines.append(
            tr("no pose near the field along {directions}", directions=_listed(state["missing"]))
        )
    lines += [_said(finding, "text", tr) for finding in state["findings"]]
    if state["problem"]:
        lines.append(_said(state, "problem", tr))
    poses = [_pose(pose, tr) for pose in state["taken"][-_SHOWN:]]
    keys = tr("u: undo   r LABEL: redo   f: finish   l: 中文   (then Enter)")
    return [*lines, *_parameters(state, tr), *poses, keys]


def _said(entry: Mapping[str, Any], key: str, tr: Translator) -> str:
    """Return a sentence of the state in the language that is shown."""
    return str(entry[key if tr.language == "en" else f"{key}_{tr.language}"])


def _listed(directions: Sequence[Sequence[float]]) -> str:
    """Return the first of some directions, and how many there are more."""
    shown = ", ".join(f"({x:.1f}, {y:.1f}, {z:.1f})" for x, y, z in directions[:_SHOWN])
    more = len(directions) - _SHOWN
    return f"{shown} + {more}" if more > 0 else shown


def _status(state: Mapping[str, Any], tr: Translator) -> str:
    live = state["live"]
    taken = sum(pose["accepted"] for pose in state["taken"])
    if state["finished"]:
        said = tr("finished")
    elif not state["connected"]:
        said = tr("the source is lost: plug it in again")
    elif live["values"] is None:
        said = tr("waiting for rows")
    elif live["refused"]:
        said = tr("not taken: {reason}", reason=_said(live, "refused", tr))
    elif live["enough"]:
        said = tr("taken: go on to the next pose")
    elif live["still"]:
        left = live["seconds_left"]
        said = tr("hold still")
        if left is not None:
            said = tr("hold still: {seconds} s more", seconds=f"{left:.1f}")
    else:
        said = tr("moving: hold still")
    counts = [tr("{poses} poses, {rows} rows", poses=str(taken), rows=str(live["rows"]))]
    if live["motion"] is not None and live["threshold"] is not None:
        now, limit = number(live["motion"], 3), number(live["threshold"], 3)
        counts.append(tr("motion {now} of {limit}", now=now, limit=limit))
    return f"{said}   ({tr.listed(counts)})"


def _parameters(state: Mapping[str, Any], tr: Translator) -> list[str]:
    header = [tr(title) if title else "" for title in ("parameter", "value", "U", "target", "")]
    rows = [
        [
            entry["name"],
            number(entry["value"], 6),
            f"{number(entry['U'], 2)} {entry['unit']}",
            "" if entry["target"] is None else number(entry["target"], 3),
            tr("met") if entry["met"] else "",
        ]
        for entry in state["parameters"]
    ]
    return table(header, rows).splitlines() if rows else []


def _pose(pose: Mapping[str, Any], tr: Translator) -> str:
    if pose["accepted"]:
        return f"{pose['position']:>4}  {pose['residual_text'] or ''}"
    return f"{pose['position']:>4}  {_said(pose, 'reason', tr)}"
