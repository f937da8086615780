"""Valid command lines over the files of `bases`: where every case starts.

The number in front is how often one is drawn; what costs more than some 50 ms is drawn seldom, so
that 100,000 cases fit in two hours of one core.
"""

import random
import shlex
from collections.abc import Mapping
from dataclasses import dataclass

TEXT = """
10 fit six.csv
10 fit six.csv --json -o o.json
 5 fit six.csv --closed-form --model own-quadratic
 3 fit six.csv --level-sd 0.1 -o o.json
 3 fit six.csv --stepwise
10 fit semicolon.csv --unit g
10 fit r26.csv --json
10 fit r26.csv --unknown-orientation
 3 fit r26.csv --unknown-orientation --gauge symmetric --model own-quadratic
 8 fit r26.csv --orientation-sd 0.5 --reading-sd 0.001
 4 fit r26.csv --orientation-sd 0.5 --json
 2 fit r26.csv --orientation-sd auto
 2 fit r26.csv --robust cauchy
 5 fit r26.csv --scheme all-26 --gravity 9.81 --gravity-u 0.001
 5 fit r26.csv --model ieee --stepwise -o o.json
10 fit averaged.csv --convention gravity
10 fit turned.csv -o o.json
10 fit rolled.csv --level-sd 0.05
10 fit posed.csv --json
 5 fit six.csv --scheme quaternions.csv
 5 fit turned.csv --scheme rolls.csv
 5 fit rolled.csv --scheme roll-pitch.csv --json
 6 fit grouped.csv --orientation-sd 0.1 --reading-sd 0.001
 6 fit redundant.csv --axes x,y,z,x --json
10 fit warm.csv --model '1 + x + y + z + temperature'
10 fit r26.csv --budget bench.toml -o o.json
10 fit r26.csv --budget bench.toml --json
 5 fit turned.csv --budget bench.toml --orientation-sd 0.1
 8 fit six.csv --budget head.toml
 6 fit turned.csv --budget head.toml --json
 5 tumble tumble.csv --outputs ax
10 tumble tumble.csv --outputs ay --axes y --json
 4 tumble tumble.csv --outputs ax --model own-cubic -o o.json
.3 tumble tumble.csv --outputs ax -o o.svg
 5 apply lin.json r26.csv
10 apply lin.json six.csv --tilt --uncertainty -o o.csv
 5 apply ieee.json r26.csv --json
 5 apply warm.json warm.csv --outside clamp --uncertainty
 5 apply redundant.json redundant.csv --uncertainty
 5 apply one.json r26.csv --tilt
 3 apply two.json r26.csv --tilt --json
 5 apply unknown.json r26.csv --outside refuse
 5 apply uncertain.json six.csv --uncertainty --json
 5 apply grav.json semicolon.csv -o o.csv
 5 apply lin.json log.csv -o o.csv
 3 apply lin.json bare.log --columns time,ax,ay,az
 5 check lin.json r26.csv --limit-g 0.01
 5 check lin.json six.csv --tilt --limit-deg 0.5 --json
 5 check grav.json r26.csv --nominal 0,1 -o o.json
 3 check ieee.json posed.csv --json
 3 check budget.json turned.csv --limit-g 0.01
 3 check lin.json rolled.csv --scheme roll-pitch.csv
 3 check unknown.json r26.csv --range -2,2
 3 check warm.json warm.csv --limit-g 0.01
.2 check lin.json r26.csv -o o.svg
 4 compare lin.json lin.json
 6 compare lin.json averaged.json level.json --json
 4 compare uncertain.json auto.json robust.json averaged.json -o o.json
.5 compare lin.json averaged.json -o o.svg
.5 stability log.csv --json
.5 stability log.csv log.csv --calibration lin.json -o o.json
.3 stability log.csv --outputs ax,ay --unit g -o o.csv
.1 stability log.csv -o o.svg
 4 report lin.json -o o.md
 3 report stepwise.json -o o.txt
 2 report budget.json -o o.md
 3 report level.json -o o.md
 3 report closed.json -o o.txt --json
 2 report unknown.json -o o.txt
 2 report redundant.json -o o.md
 2 report warm.json -o o.md
1 report shared.json -o o.txt
 2 report grouped.json -o o.md
.1 report lin.json -o o.html
.3 report budget.json -o o.md --monte-carlo 1000
 9 report lin.json --lab laboratory.toml -o o.md
 9 report closed.json --lab laboratory.toml -o o.txt
.1 report lin.json --lab laboratory.toml -o o.html
 8 report lin.json --check force-check.json -o o.md
 4 report lin.json --check tilt-check.json -o o.txt
.1 report lin.json --check force-check.json -o o.html
.1 report lin.json --check tilt-check.json -o o.html
 5 export lin.json --to c -o o.c
 5 export ieee.json --to c --float --name imu -o o.c --json
 3 export warm.json --to c -o o.c
 3 export redundant.json --to c --float -o o.c
 4 export closed.json --to px4 --allow-lossy -o o.params
 4 export lin.json --to ardupilot --allow-lossy -o o.parm
 4 export averaged.json --to ros-imu-calib --allow-lossy -o o.yaml
 5 simulate lin.json --scheme faces-6 --reading-sd 0.001 --seed 1 -o o.csv
 5 simulate ieee.json --scheme scheme.csv --seed 1 --json
 5 simulate warm.json --scheme rolls.csv --temperature 10,30 --seed 2
 5 simulate two.json --scheme quaternions.csv --orientation-sd 0.1 --seed 3
 3 simulate robust.json --scheme roll-pitch.csv --seed 4 --json
 4 simulate lin.json --scheme faces-6 --log --rest 1 --turn 0.2 --rate 50 --seed 1
 5 design --include lin.json --positions 30
 5 design --include uncertain.json --positions 30 --candidates scheme.csv --json
1.5 design --include budget.json --positions 30 --criterion u:ax:x
 2 design --include unknown.json --positions 30 --candidates rolls.csv
 2 schemes scheme.csv
 2 schemes rolls.csv --json
 3 schemes quaternions.csv --model own-quadratic --unknown-orientation
 .5 schemes roll-pitch.csv --orientation-sd 0.1 --reading-sd 0.001 -o o.txt
 1 schemes faces-6 song-qin-6 --model ieee --json
.3 design --positions 6
.3 design --positions 9 --include scheme.csv --candidates all-26 --json
.3 design --positions 8 --region scheme.csv --criterion I -o o.csv
.3 design --positions 7 --candidates rolls.csv --axes x --criterion u:ax:x
 5 average log.csv --scheme faces-6 -o o.csv
 5 average log.csv --scheme rolls.csv --json
 5 average bare.log --columns time,ax,ay,az --time-column time
 3 average bare.log --rate 50 --outputs 2,3,4 --json
 8 average log.csv --sections sections.csv
 8 average log.csv --sections sections.json --json -o o.csv
 4 average log.csv --sections sections.json --only a
 4 average log.csv log.csv --drop-bad --accept-faults --json
 3 average log.csv --label-column temperature --json
 4 calibrate log.csv --scheme faces-6 --drop-bad -o o.json
 2 calibrate bare.log --columns time,ax,ay,az --scheme faces-6 --json
10 regress data.csv --response y --variables T,H
 8 regress data.csv --response y --variables T,H --degree 2 --stepwise -o o.json
 4 regress data.csv --response y --variables T,H,T_rate --stepwise --hierarchy --json
 4 regress data.csv --response y --variables T --segment T:15,25 --continuous --json
 3 regress data.csv --response y --variables T,T_rate --time time
 1 regress data.csv --response y --variables T --segment T:auto
 4 regress data.csv --response y --terms '1 + T + T^2 + T*H' --drop-missing
.3 regress data.csv --response y --variables T,H -o o.svg
 6 apply plain-reg.json data.csv
 6 apply cut-reg.json data.csv --uncertainty -o o.csv
 6 apply rate-reg.json data.csv --correct y --json
 6 apply auto-reg.json data.csv --outside clamp
 6 check plain-reg.json data.csv --limit-g 1
 6 check cut-reg.json data.csv --json -o o.json
 4 check rate-reg.json data.csv
.2 check auto-reg.json data.csv -o o.svg
.3 demo -o o
 6 apply causal-reg.json data.csv --uncertainty
 4 apply both-reg.json data.csv -o o.csv
 3 check both-reg.json data.csv --json
 2 compare plain-reg.json plain-reg.json
 2 compare cut-reg.json cut-reg.json --json
 1 report plain-reg.json -o o.md
.5 report causal-reg.json -o o.txt
.1 report both-reg.json -o o.html
 6 export causal-reg.json --to c -o o.c
 4 export plain-reg.json --to c --float --name drift --correct y -o o.c
 3 export cut-reg.json both-reg.json --to c -o o.c --json
 2 export lin.json plain-reg.json --to c -o o.c
 6 regress data.csv --response y --variables T,T_rate --time time --causal --json
 4 regress data.csv --response y,H --variables T -o o.json
 3 regress data.csv --response y --variables T --run H
 4 fit r26.csv --unit g --model own.toml
 4 fit warm.csv --unit g --model outputs.toml --json
 2 fit r26.csv --unit g --model own.toml --orientation-sd 0.5 --reading-sd 0.001 -o o.json
 1 fit r26.csv --unit g --model own.toml --unknown-orientation
 3 schemes all-26 --model own.toml --json
.2 design --model own.toml --positions 9
 3 apply own.json r26.csv --uncertainty
 2 check own.json r26.csv --limit-g 0.01
 1 export own.json --to c --float -o o.c
 2 export grav.json --to kalibr --allow-lossy --stability noise.json -o o.yaml
 2 export lin.json --to imucal --allow-lossy -o o.json
 1 export lin.json --to inav --allow-lossy -o o.txt
 2 fleet fleet.csv --unit-column unit --unit g -o o
 2 fleet fleet.csv --unit-column unit --station-column station --limits limits.csv --json -o o
 2 fleet fleet.csv --unit-column unit --limits limits.toml --json -o o
 1 fleet fleet.csv --unit-column unit --unknown-orientation --json -o o
 1 fleet fleet.csv --unit-column unit --orientation-sd 0.2 --json -o o
 1 fleet fleet.csv --unit-column unit --reading-sd 0.001 --model own-quadratic --json -o o
.5 capture replay:log.csv:0 --headless
.5 capture replay:log.csv:0 --headless --scheme faces-6 -o o.csv
.3 capture replay:log.csv:0 --headless --positions 6 --target bias=0.01 --to c -o o.csv
.3 capture replay:bare.log:0 --headless --columns time,ax,ay,az --threshold 0.01
10 fit mag.csv --unit uT
 8 fit mag.csv --unit uT --field-size 48.6uT --field-size-u 0.2uT -o o.json
 3 fit mag.csv --field magnetic --robust huber --json
 2 fit mag.csv --model own-cubic
 3 calibrate mag.csv --unit uT -o o.json
 4 calibrate compass.csv --field magnetic --unit uT -o o.json
 4 apply mag.json mag.csv --uncertainty -o o.csv
 4 apply mag.json compass.csv --with lin.json --json
 3 apply waved.json compass.csv --with lin.json --outside clamp
 3 compare mag.json mag.json
 2 report mag.json -o o.md
 1 report waved.json -o o.txt
 2 export mag.json --to c -o o.c
 1 export mag.json --to c --fixed -o o.c
 1 export lin.json --to c --fixed -o o.c
 2 export waved.json --to px4 --device-id 396825 -o o.params
 2 design --include mag.json --positions 30
 2 simulate mag.json --scheme all-26 --reading-sd 0.1 --seed 1 -o o.csv
10 fit incl.csv --inputs x,y --unit V --range 0,5
 4 fit incl.csv --unit V --model own-cubic --json
 4 apply incl.json incl.csv --tilt --uncertainty -o o.csv
 4 check incl.json incl.csv --tilt --limit-deg 0.05 --nominal 2.5,1
 3 report incl.json -o o.md
 2 export incl.json --to c --tilt -o o.c
.5 design --model linear --positions 12 --unknown-orientation --candidates all-26
.3 page -o o
"""


@dataclass(frozen=True)
class Recipe:
    """A valid command line and how often it is drawn."""

    weight: float
    words: tuple[str, ...]

    @property
    def command(self) -> str:
        """The command's name."""
        return self.words[0]


def _read() -> tuple[Recipe, ...]:
    lines = [line.strip().partition(" ") for line in TEXT.strip().splitlines()]
    return tuple(Recipe(float(weight), tuple(shlex.split(words))) for weight, _, words in lines)


_REPLAY, _AT_ONCE = "replay:", ":0"
RECIPES = _read()


def draw(rng: random.Random, names: tuple[str, ...] | None = None) -> Recipe:
    """Draw a command line, or one that names one of these files."""
    fitting = [r for r in RECIPES if names is None or set(names) & set(map(file_of, r.words))]
    return rng.choices(fitting, [r.weight for r in fitting])[0]


def file_of(word: str) -> str:
    """The file that a word of a command line names, where it names one: also in replay:FILE:0."""
    return word.removeprefix(_REPLAY).removesuffix(_AT_ONCE)


def renamed(word: str, name: str) -> str:
    """The word with another file in its place; without `replay:` a log would be waited on."""
    return f"{_REPLAY}{name}{_AT_ONCE}" if word.startswith(_REPLAY) and name != "-" else name


def files_of(words: list[str], valid: Mapping[str, bytes]) -> dict[str, bytes]:
    """Those of the valid files that a command line names."""
    return {name: valid[name] for name in map(file_of, words) if name in valid}
