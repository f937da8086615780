"""The valid files that the damage starts from, made by the project's own commands at the start.

Those in `files` are written by hand; `first.txt` and `then.txt` hold the commands.

Made in this process, which also loads every library before the first case is run. `created` is
set to one moment, so that the same version makes the same files.
"""

import contextlib
import csv
import io
import json
import math
import os
import random
import shlex
from pathlib import Path

from multipos import cli

from .hostile import listed

HERE = Path(__file__).parent
READINGS = listed(
    """
    six.csv r26.csv tumble.csv turned.csv rolled.csv posed.csv averaged.csv grouped.csv
    redundant.csv warm.csv semicolon.csv mag.csv incl.csv
    """
)
SCHEMES = ("scheme.csv", "rolls.csv", "roll-pitch.csv", "quaternions.csv")
LOGS = ("log.csv", "bare.log", "compass.csv")
CALIBRATIONS = listed(
    """
    lin.json closed.json grav.json level.json ieee.json stepwise.json unknown.json uncertain.json
    auto.json robust.json budget.json one.json two.json averaged.json shared.json grouped.json
    redundant.json warm.json own.json mag.json waved.json incl.json
    """
)
REGRESSIONS = listed(
    "plain-reg.json cut-reg.json rate-reg.json auto-reg.json causal-reg.json both-reg.json"
)
CHECKS = ("force-check.json", "tilt-check.json")
BUDGETS = ("bench.toml", "head.toml")
LABORATORIES = ("laboratory.toml",)
SECTIONS = ("sections.csv", "sections.json")
MODELS = ("own.toml", "outputs.toml")
FLEETS = ("fleet.csv",)
LIMITS = ("limits.csv", "limits.toml")
RECORDS = ("noise.json",)
DATA = ("data.csv",)
CROSSED = ("log14.csv", "averaged14.csv")
NAMES = (
    *(READINGS + SCHEMES + LOGS + CALIBRATIONS + REGRESSIONS + CHECKS),
    *(BUDGETS + LABORATORIES + SECTIONS + DATA),
    *(MODELS + FLEETS + LIMITS + RECORDS + CROSSED),
)


def make(folder: Path) -> dict[str, bytes]:
    """Make the files in an empty folder and return them by name."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        for name, text in _written().items():
            Path(name).write_text(text, encoding="utf-8")
        _run((HERE / "first.txt").read_text("utf-8"))
        for name, text in _derived().items():
            Path(name).write_text(text, encoding="utf-8")
        _run((HERE / "then.txt").read_text("utf-8"))
        return {name: Path(name).read_bytes() for name in NAMES}
    finally:
        os.chdir(before)


def _run(commands: str) -> None:
    for line in commands.strip().splitlines():
        said = io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            status = cli.main(shlex.split(line))
        if status:
            raise RuntimeError(f"'multipos {line}' makes a file to start from: {said.getvalue()}")
        made = Path(shlex.split(line)[-1])
        if made.suffix == ".json":
            _set_moment(made)


def _set_moment(path: Path) -> None:
    document = json.loads(path.read_bytes())
    if "created" in document:
        document["created"] = "2024-01-01T00:00:00+00:00"
        path.write_text(json.dumps(document, ensure_ascii=False, indent=1), encoding="utf-8")


def _written() -> dict[str, str]:
    written = {path.name: path.read_text("utf-8") for path in (HERE / "files").iterdir()}
    return {**written, "semicolon.csv": written["six.csv"].replace(",", ";").replace(".", ",")}


def _derived() -> dict[str, str]:
    """What no command makes: other columns beside readings, and data for a regression."""
    rng = random.Random("bases")
    rows = _rows("r26.csv")
    warm = []
    for row in rows * 2:
        temperature = rng.uniform(-10, 50)
        ax = float(row["ax"]) + 5e-4 * temperature + rng.gauss(0, 1e-3)
        warm.append({**row, "ax": ax, "temperature": temperature})
    data = []
    for i in range(150):
        warmth, damp = 20 + 15 * math.sin(i / 20), rng.gauss(50, 5)
        response = 1 + 0.1 * warmth + 0.002 * warmth**2 + 0.01 * damp + rng.gauss(0, 0.05)
        data.append({"time": i, "T": warmth, "H": damp, "y": response})
    fleet = []
    for unit in range(8):
        bias = rng.gauss(0, 0.01)
        for row in _rows("r26.csv")[:14]:
            read = {name: float(row[name]) + bias + rng.gauss(0, 1e-3) for name in ("ax", "ay")}
            unit_of = {"unit": f"U{unit}", "station": "AB"[unit % 2], "time": unit}
            fleet.append({**row, **read, **unit_of})
    redundant = [{**row, "a4": 1.01 * float(row["ax"]) + rng.gauss(0, 1e-3)} for row in rows]
    with Path("log.csv").open() as stream:
        bare = "".join(line.replace(",", " ") for line in stream.readlines()[1:])
    return {
        "warm.csv": _csv(warm),
        "grouped.csv": _csv([{**row, "group": i // 7} for i, row in enumerate(rows)]),
        "redundant.csv": _csv(redundant),
        "turned.csv": _with_outputs("rolls.csv", "up-turned.csv"),
        "rolled.csv": _with_outputs("roll-pitch.csv", "up-rolled.csv"),
        "posed.csv": _with_outputs("quaternions.csv", "up-posed.csv"),
        "data.csv": _csv(data),
        "fleet.csv": _csv(fleet),
        "bare.log": bare,
        "mag.csv": _csv(_magnetic(rng, 40, 0.2)),
        "compass.csv": _csv(_magnetic(rng, 400, 0.02)),
        "incl.csv": _csv(_inclined(rng)),
    }


def _magnetic(rng: random.Random, count: int, noise: float) -> list[dict]:
    """A magnetometer [µT] turned through all directions, with the accelerometer beside it [g]."""
    rows = []
    for i in range(count):
        z, turn = 1 - 2 * (i + 0.5) / count, i * math.pi * (3 - math.sqrt(5))
        across = math.sqrt(1 - z * z)
        field = [48.6 * each for each in (across * math.cos(turn), across * math.sin(turn), z)]
        mx, my, mz = (rng.gauss(each, noise) for each in field)
        magnetic = {"mx": 3 + mx, "my": -8 + 0.97 * my + 0.04 * mx, "mz": 12 + 1.05 * mz}
        force = {name: each / 48.6 for name, each in zip(("ax", "ay", "az"), field, strict=True)}
        rows.append({"time": i / 50, **(magnetic | force if count > 100 else magnetic)})
    return rows


def _inclined(rng: random.Random) -> list[dict]:
    """Two rolls of an inclinometer of two axes [V]."""
    rows = []
    for axis, angle in ((axis, angle) for axis in "yx" for angle in range(0, 360, 30)):
        cosine = math.cos(math.radians(angle))
        x, y = (cosine, 0.0) if axis == "y" else (0.0, cosine)
        read = {"Ux": 2.5 + x + 0.02 * y, "Uy": 2.5 - 0.018 * x + y}
        volts = {name: rng.gauss(each, 1e-4) for name, each in read.items()}
        rows.append({"roll_axis": axis, "angle_deg": angle, **volts})
    return rows


def _with_outputs(scheme: str, readings: str) -> str:
    """Whole attitudes, as the scheme has them, beside what was simulated there."""
    pairs = zip(_rows(scheme), _rows(readings), strict=True)
    outputs = ("ax", "ay", "az")
    return _csv([{**where, **{name: read[name] for name in outputs}} for where, read in pairs])


def _rows(name: str) -> list[dict[str, str]]:
    with Path(name).open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def _csv(rows: list[dict]) -> str:
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()
