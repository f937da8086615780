"""The valid files that the damage starts from, made by the project's own commands at the start.

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

SIX = """\
position,direction,ax,ay,az
1,E-U-S,0.0071,1.0029,-0.0016
2,E-N-U,-0.0094,-0.0058,1.0008
3,D-E-S,-0.9965,0.0064,0.0015
4,W-D-S,-0.0076,-1.0030,0.0032
5,U-W-S,0.9965,0.0073,0.0027
6,S-W-D,0.0067,-0.0060,-1.0008
"""
ROLL_PITCH = """\
position,roll_deg,pitch_deg,yaw_deg
1,0,0,0
2,180,0,10
3,90,0,20
4,-90,0,30
5,0,90,40
6,0,-90,50
7,45,30,60
8,200,-40,70
"""
QUATERNIONS = """\
position,qw,qx,qy,qz
1,1,0,0,0
2,0,1,0,0
3,0.7071067811865476,0.7071067811865476,0,0
4,0.7071067811865476,-0.7071067811865476,0,0
5,0.7071067811865476,0,0.7071067811865476,0
6,0.7071067811865476,0,-0.7071067811865476,0
7,0.5,0.5,0.5,0.5
"""
ROLLS = "position,roll_axis,angle_deg\n" + "".join(
    f"{axis}{angle},{axis},{angle}\n" for axis in "xyz" for angle in range(0, 360, 45)
)
BENCH_BUDGET = """\
[gravity]
value = 9.81
u = 0.0001
[orientation]
u_deg = 0.05
[gain]
u = 1e-4
each_output = true
[offset]
half_width = 1e-4
distribution = "rectangular"
dof = 10
[resolution]
step = 0.001
[temperature]
u = 0.5
bias_per_degC = 0.001
scale_per_degC = 0.0001
[third_order]
u = 1e-5
"""
HEAD_BUDGET = """\
[gravity]
latitude_deg = 48
height_m = 500
u = 0.0001
[level]
half_width_deg = 0.1
distribution = "triangular"
[index]
U_deg = 0.01
k = 2
harmonics = [1, 2]
axis = "x"
"""
LABORATORY = """\
[report]
number = "A-1"
issued = 2024-01-01
[laboratory]
name = "Laboratory"
location = "Room 3"
[customer]
name = "Customer"
[item]
description = "Triad"
serial = "117"
[measurement]
performed = "2024"
traceability = "Gravity by the national institute"
"""
OWN_MODEL = """\
[parameters]
b = { start = 0, unit = "V" }
s = { start = 1, unit = "V/g", low = 0.5, high = 2 }
common_k = { start = 0.01, sd = 0.02, low = 0 }

[outputs]
each = "b + s*own/(1 + common_k*own^2)"
"""
OWN_OUTPUTS = """\
[parameters]
c = 0.001

[outputs]
ax = "b + s*x + c*temperature"
ay = "b + s*y + exp(-c*temperature)"
az = "b + s*z + c*sin(pi*own)"
"""
LIMITS_CSV = "name,lsl,usl\nbias_ax,-0.035,0.035\nU:scale_ax,,0.02\nrms,,0.01\n"
LIMITS_TOML = "bias_ax = [-0.035, 0.035]\nscale_ay = [0.98, inf]\nrms = [0, 0.01]\n"
SECTIONS_CSV = "position,start,end\na,0,100\nb,200,300\nc,400,500\n"
SECTIONS_JSON = json.dumps({"a": {"start": 0, "end": 100}, "b": {"start": 200, "end": 300}})

FIRST = """
fit six.csv --unit g -o lin.json
fit six.csv --unit g --closed-form --model own-quadratic -o closed.json
fit six.csv --unit g --convention gravity --gravity 9.80665 --gravity-u 0.001 -o grav.json
fit six.csv --unit g --budget head.toml -o level.json
simulate lin.json --scheme all-26 --reading-sd 0.001 --seed 1 -o r26.csv
simulate lin.json --scheme tumble-24 --reading-sd 0.001 --seed 2 -o tumble.csv
simulate lin.json --scheme rolls.csv --reading-sd 0.001 --seed 3 -o up-turned.csv
simulate lin.json --scheme roll-pitch.csv --reading-sd 0.001 --seed 4 -o up-rolled.csv
simulate lin.json --scheme quaternions.csv --reading-sd 0.001 --seed 5 -o up-posed.csv
simulate lin.json --scheme faces-6 --log --rate 50 --rest 3 --turn 1 --sample-sd 0.002 --seed 1 -o log.csv
average log.csv --scheme faces-6 -o averaged.csv
simulate lin.json --scheme faces-6+corners-8 --log --rate 50 --rest 2 --turn .5 --sample-sd 0.002 --seed 6 -o log14.csv
average log14.csv --scheme faces-6+corners-8 -o averaged14.csv
design --positions 8 -o scheme.csv
"""  # noqa: E501
THEN = """
fit r26.csv --unit g --model ieee -o ieee.json
fit r26.csv --unit g --model own-quadratic --stepwise -o stepwise.json
fit r26.csv --unit g --unknown-orientation -o unknown.json
fit r26.csv --unit g --orientation-sd 0.5 --reading-sd 0.001 -o uncertain.json
fit r26.csv --unit g --orientation-sd auto -o auto.json
fit r26.csv --unit g --robust huber --pool -o robust.json
fit r26.csv --unit g --budget bench.toml -o budget.json
fit r26.csv --unit g --outputs ax --axes x -o one.json
fit r26.csv --unit g --outputs ax,ay --axes x,y -o two.json
fit averaged.csv --unit g -o averaged.json
fit posed.csv --unit g --level-sd 0.1 -o shared.json
fit grouped.csv --unit g --orientation-sd 0.1 --reading-sd 0.001 -o grouped.json
fit redundant.csv --unit g --axes x,y,z,x -o redundant.json
fit warm.csv --unit g --model '1 + x + y + z + temperature + temperature*own' -o warm.json
regress data.csv --response y --variables T,H --degree 2 -o plain-reg.json
regress data.csv --response y --variables T,H --degree 2 --stepwise --segment T:15,25 -o cut-reg.json
regress data.csv --response y --variables T,T_rate --time time -o rate-reg.json
regress data.csv --response y --variables T --segment T:auto --continuous -o auto-reg.json
check lin.json r26.csv --limit-g 0.01 -o force-check.json
check lin.json r26.csv --tilt --limit-deg 0.5 --within-deg 80 -o tilt-check.json
export lin.json --to c --name imu -o imu.c
export warm.json --to c --float -o warm.c
export lin.json --to px4 --allow-lossy -o lin.params
export lin.json --to ardupilot --allow-lossy -o lin.parm
export lin.json --to ros-imu-calib --allow-lossy -o lin.yaml
regress data.csv --response y --variables T,T_rate --time time --causal --degree 2 -o causal-reg.json
regress data.csv --response y,H --variables T -o both-reg.json
export causal-reg.json --to c --name drift --correct y -o causal.c
fit r26.csv --unit g --model own.toml -o own.json
export own.json --to c -o own.c
stability log.csv --calibration grav.json --json -o noise.json
fit mag.csv --unit uT --field-size 48.6uT --field-size-u 0.2uT -o mag.json
calibrate compass.csv --field magnetic --unit uT -o waved.json
fit incl.csv --inputs x,y --unit V -o incl.json
export mag.json --to px4 --device-id 396825 -o mag.params
export mag.json --to ardupilot -o mag.parm
export mag.json --to ros -o mag.yaml
export incl.json --to c --tilt -o incl.c
"""  # noqa: E501

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
        _run(FIRST)
        for name, text in _derived().items():
            Path(name).write_text(text, encoding="utf-8")
        _run(THEN)
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
    return {
        "six.csv": SIX,
        "semicolon.csv": SIX.replace(",", ";").replace(".", ","),
        "roll-pitch.csv": ROLL_PITCH,
        "quaternions.csv": QUATERNIONS,
        "rolls.csv": ROLLS,
        "bench.toml": BENCH_BUDGET,
        "head.toml": HEAD_BUDGET,
        "laboratory.toml": LABORATORY,
        "own.toml": OWN_MODEL,
        "outputs.toml": OWN_OUTPUTS,
        "limits.csv": LIMITS_CSV,
        "limits.toml": LIMITS_TOML,
        "sections.csv": SECTIONS_CSV,
        "sections.json": SECTIONS_JSON,
    }


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
