"""The text screen: the state of a session on a terminal, for who has no browser at hand.

`text_screen` shows it, `picture_of` gives its lines: what `multipos.capturing.state` has and
nothing of its own. A line on the keyboard is a command, which `obey` does: ``u`` takes the newest
pose back, ``r LABEL`` takes one again, ``f`` finishes.
"""

import shutil
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from multipos.capturing.session import Session
from multipos.capturing.state import state_of
from multipos.files.numbers import number, table

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
    ended = threading.Event()
    if commands and sys.stdin is not None and sys.stdin.isatty():
        threading.Thread(target=_obey, args=(session,), daemon=True).start()

    def show() -> None:
        height = 0
        while not ended.wait(_OFTEN):
            with session.changed:
                state = state_of(session)
            height = _draw(picture_of(state), height)
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


def _obey(session: Session) -> None:
    for line in sys.stdin:
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


def picture_of(state: Mapping[str, Any]) -> list[str]:
    """Return what the terminal shows of a state, as lines."""
    next_ = state["next"]
    lines = [_status(state)]
    if next_ is not None:
        gain = ""
        if next_["gain"] is not None:
            gain = f"  (gain {number(next_['gain'], 3)})"
        label = "" if next_["label"] is None else f"{next_['label']}: "
        lines.append(f"next: {label}{next_['words']}{gain}")
    if state["missing"]:
        lines.append(f"no pose near the field along {_listed(state['missing'])}")
    lines += [finding["text"] for finding in state["findings"]]
    if state["problem"]:
        lines.append(state["problem"])
    poses = [_pose(pose) for pose in state["taken"][-_SHOWN:]]
    keys = "u: undo   r LABEL: redo   f: finish   (then Enter)"
    return [*lines, *_parameters(state), *poses, keys]


def _listed(directions: Sequence[Sequence[float]]) -> str:
    """Return the first of some directions, and how many there are more."""
    shown = ", ".join(f"({x:.1f}, {y:.1f}, {z:.1f})" for x, y, z in directions[:_SHOWN])
    more = len(directions) - _SHOWN
    return f"{shown} + {more}" if more > 0 else shown


def _status(state: Mapping[str, Any]) -> str:
    live = state["live"]
    taken = sum(pose["accepted"] for pose in state["taken"])
    counts = f"{taken} poses, {live['rows']} rows"
    if live["motion"] is not None and live["threshold"] is not None:
        counts += f", motion {number(live['motion'], 3)} of {number(live['threshold'], 3)}"
    return f"{_doing(state)}   ({counts})"


def _doing(state: Mapping[str, Any]) -> str:
    """Return what the session waits for, or what is to be done."""
    live = state["live"]
    if state["finished"]:
        return "finished"
    if not state["connected"]:
        return "the source is lost: plug it in again"
    if live["values"] is None:
        return "waiting for rows"
    if live["refused"]:
        return f"not taken: {live['refused']}"
    if live["enough"]:
        return "taken: go on to the next pose"
    if not live["still"]:
        return "moving: hold still"
    left = live["seconds_left"]
    return "hold still" if left is None else f"hold still: {left:.1f} s more"


def _parameters(state: Mapping[str, Any]) -> list[str]:
    rows = [
        [
            entry["name"],
            number(entry["value"], 6),
            f"{number(entry['U'], 2)} {entry['unit']}",
            "" if entry["target"] is None else number(entry["target"], 3),
            "met" if entry["met"] else "",
        ]
        for entry in state["parameters"]
    ]
    return table(["parameter", "value", "U", "target", ""], rows).splitlines() if rows else []


def _pose(pose: Mapping[str, Any]) -> str:
    said = pose["residual_text"] or "" if pose["accepted"] else pose["reason"]
    return f"{pose['position']:>4}  {said}"
