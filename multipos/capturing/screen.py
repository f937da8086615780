"""The text screen: the state of a session on a terminal, for who has no browser at hand.

It shows what `multipos.capturing.state` says and nothing of its own. A line on the keyboard is a
command: ``u`` takes the newest pose back, ``r LABEL`` takes one again, ``f`` finishes.
"""

import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from multipos.capturing.session import Session
from multipos.capturing.state import state_of
from multipos.files.numbers import number

if TYPE_CHECKING:
    from rich.console import RenderableType

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
    from rich.console import Console
    from rich.live import Live

    ended = threading.Event()
    if commands and sys.stdin is not None and sys.stdin.isatty():
        threading.Thread(target=_obey, args=(session,), daemon=True).start()
    with Live(console=Console(stderr=True), auto_refresh=False, transient=True) as live:

        def show() -> None:
            while not ended.wait(_OFTEN):
                with session.changed:
                    state = state_of(session)
                live.update(picture_of(state), refresh=True)

        thread = threading.Thread(target=show)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()


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


def picture_of(state: Mapping[str, Any]) -> "RenderableType":
    """Return what the terminal shows of a state."""
    from rich.console import Group
    from rich.text import Text

    next_ = state["next"]
    lines = [Text(_status(state), style="bold")]
    if next_ is not None:
        gain = "" if next_["gain"] is None else f"  (gain {number(next_['gain'], 3)})"
        label = "" if next_["label"] is None else f"{next_['label']}: "
        lines.append(Text(f"next: {label}{next_['words']['en']}{gain}", style="magenta"))
    lines += [Text(doubt["text"], style="yellow") for doubt in state["doubts"]]
    if state["problem"]:
        lines.append(Text(state["problem"], style="dim"))
    keys = Text("u: undo   r LABEL: redo   f: finish   (then Enter)", style="dim")
    return Group(*lines, _parameters(state), *map(_pose, state["taken"][-_SHOWN:]), keys)


def _status(state: Mapping[str, Any]) -> str:
    live = state["live"]
    taken = sum(pose["accepted"] for pose in state["taken"])
    if state["finished"]:
        said = "finished"
    elif not state["connected"]:
        said = "the source is lost: plug it in again"
    elif live["values"] is None:
        said = "waiting for rows"
    elif live["refused"]:
        said = f"not taken: {live['refused']}"
    elif live["enough"]:
        said = "taken: go on to the next pose"
    elif live["still"]:
        left = live["seconds_left"]
        said = "hold still" if left is None else f"hold still: {left:.1f} s more"
    else:
        said = "moving: hold still"
    return f"{said}   ({taken} poses, {state['rows']} rows{_motion(live)})"


def _motion(live: Mapping[str, Any]) -> str:
    if live["motion"] is None or live["threshold"] is None:
        return ""
    return f", motion {number(live['motion'], 3)} of {number(live['threshold'], 3)}"


def _parameters(state: Mapping[str, Any]) -> "RenderableType":
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for title in ("parameter", "value", "U", "target", ""):
        table.add_column(title, justify="left" if title in ("parameter", "") else "right")
    for entry in state["parameters"]:
        target = entry["target"]
        table.add_row(
            entry["name"],
            number(entry["value"], 6),
            f"{number(entry['U'], 2)} {entry['unit']}",
            "" if target is None else number(target, 3),
            "met" if entry["met"] else "",
        )
    return table


def _pose(pose: Mapping[str, Any]) -> "RenderableType":
    from rich.text import Text

    if pose["accepted"]:
        left = pose["residual"]
        return Text(f"{pose['position']:>4}  " + ("" if left is None else f"{1e6 * left:+.0f} µg"))
    return Text(f"{pose['position']:>4}  {pose['reason']}", style="yellow")
