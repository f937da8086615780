"""The page: what a visitor's browser asks of the package, with files that are damaged.

A visit is a case like a command line: its words are the requests, one JSON object each.
"""

import json
import random
from collections.abc import Sequence

from multipos.page.visit import TARGETS, Visit

from . import bases, hostile

VISIT = "visit"
FOLDER = "multipos-downloads"
FILES = ("six.csv", "r26.csv", "semicolon.csv", "mag.csv", "log.csv", "bare.log", "incl.csv")
KINDS = ("auto", "auto", "auto", "log", "six", "free", "known")
UNITS = ("", "", "g", "m/s^2", "mg", "count", "uT", "V")
MODELS = ("linear", "own-quadratic", "own-cubic", "cross-quadratic", "ieee")
FORMS = ("json", "readings", "md", "c", *TARGETS)


def draw(rng: random.Random) -> tuple[str, tuple[str, ...]]:
    """Return the file that a visitor gives and the words of the visit."""
    name = rng.choice(FILES)
    asked = [_calibrate(rng, name)] if rng.random() < 0.95 else []
    asked += [_next(rng, name) for _ in range(rng.choice((0, 1, 2, 4)))]
    lines = [json.dumps(each, ensure_ascii=False) for each in asked]
    return name, (VISIT, *lines)


def _calibrate(rng: random.Random, name: str) -> dict:
    outputs = "" if rng.random() < 0.8 else rng.choice(("ax,ay,az", "ax", "1,2,3", ",", "é"))
    if rng.random() < 0.02:
        outputs = hostile.text(rng)
    names = [name] * (2 if rng.random() < 0.05 else 1)
    kind, unit = rng.choice(KINDS), rng.choice(UNITS)
    return {"do": "calibrate", "files": names, "kind": kind, "unit": unit, "outputs": outputs}


def _next(rng: random.Random, name: str) -> dict:
    """One of the other things that the page asks for."""
    positions = rng.choice((0, 1, 4, 6, 9, 12))
    kind = rng.choices(("targets", "download", "plan", "apply"), (4, 12, 0.3, 4))[0]
    if kind == "download":
        return {"do": kind, "form": rng.choice(FORMS), "accept": rng.random() < 0.5}
    if kind == "plan":
        hand_held = rng.random() < 0.5
        model = rng.choice(MODELS)
        return {"do": kind, "model": model, "positions": positions, "hand_held": hand_held}
    if kind == "apply":
        calibration = rng.choice(("", "lin.json", "mag.json"))
        tilt = rng.random() < 0.5
        return {"do": kind, "calibration": calibration, "files": [name], "tilt": tilt}
    return {"do": kind}


def files_of(name: str) -> tuple[str, ...]:
    """Return the valid files that lie where a visit is."""
    return (name, *(each for each in ("lin.json", "mag.json") if each in bases.CALIBRATIONS))


def main(argv: Sequence[str]) -> int:
    """Answer the requests of a visit; what the page would call its own fault is raised."""
    visit = Visit()
    for request in argv[1:]:
        answer = json.loads(visit.answer(request))
        if "; a fault of multipos " in answer.get("error", ""):
            asked = json.loads(request)
            getattr(visit, f"_{asked['do']}")(asked)
    return 0
