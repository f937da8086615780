"""Every kind of calibration, every command, every option that takes no value, on valid files.

Nothing is damaged here: what breaks is the combination. A kind of calibration is a line that makes
it (estimator, model, budget, one to four outputs, means with and without their noise); it is made
once by the process that runs the cases. Commands stand below with the places of its files.
"""

import contextlib
import functools
import io
import itertools
import random
import shlex
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

from multipos import cli

from . import options
from .hostile import listed

ESTIMATORS = listed(
    """
    . --closed-form --robust=huber --pool --stepwise --drift --exclude=auto --level-sd=0.1
    --orientation-sd=0.5 --orientation-sd=auto --unknown-orientation --reading-sd=0.001
    --unknown-orientation+--gauge=symmetric --orientation-sd=0.5+--reading-sd=0.001
    --robust=cauchy+--orientation-sd=0.5 --pool+--orientation-sd=0.5 --nominal=0,1
    """
)
SOFT = "each = (bias + scale*own)/(1 + 0.01*(bias + scale*own)^2)"  # saturates softly
CALIBRATION = "made.json"
OWN = "each = b + s*own + common_k*own^2"
MODELS = ("", "own-quadratic", "ieee", "1 + own", OWN, "own.toml", SOFT)
BUDGETS = ("", "bench.toml", "head.toml")
# Readings, and what their outputs need; the formula of temperature stands only where there is some.
SOURCES = {
    "six.csv": "",
    "r26.csv": "",
    "r26.csv ": "--outputs ax --axes x",
    "r26.csv  ": "--outputs ax,ay --axes x,y",
    "averaged14.csv": "",
    "redundant.csv": "--axes x,y,z,x",
    "grouped.csv": "",
    "posed.csv": "",
    "warm.csv": "",
}
WARM = "1 + x + y + z + temperature + temperature*own"
COMMANDS = tuple(
    """
apply made.json READINGS -o o.csv
apply made.json READINGS
check made.json READINGS --limit-g 0.5 -o o.json
compare made.json made.json
compare made.json lin.json -o o.json
compare made.json made.json made.json
report made.json -o o.md
report made.json -o o.txt
report made.json -o o.xml --lab laboratory.toml
report made.json -o o.html
export made.json --to c -o o.c
export made.json --to px4 -o o.params
export made.json --to ardupilot -o o.parm
export made.json --to inav -o o.txt
export made.json --to kalibr --stability noise.json -o o.yaml
export made.json --to ros -o o.yaml
export made.json --to imucal -o o.json
simulate made.json --scheme faces-6+corners-8 --reading-sd 0.001 --seed 1 -o o.csv
simulate made.json --log --scheme faces-6 --rest 1 --turn 0.2 --rate 50 --seed 1 -o o.csv
design --include made.json --positions 30
stability log.csv --calibration made.json -o o.json
""".strip().splitlines()
)
# Figures, and lines that take a third of a second, are drawn seldom.
SLOW = ("o.html", "o.xml", "stability")
_ODDS = tuple(0.1 if any(word in line for word in SLOW) else 1.0 for line in COMMANDS)
# These make their calibration themselves.
MAKING = tuple(
    """
calibrate log14.csv --scheme faces-6+corners-8 -o o.json
calibrate log14.csv -o o.json
capture replay:log14.csv:0 --headless --scheme faces-6+corners-8 -o o.csv
fleet fleet.csv --unit-column unit --unit g -o o
tumble tumble.csv --outputs ax -o o.json
schemes all-26
""".strip().splitlines()
)


def _kinds() -> Iterator[tuple[str, ...]]:
    """Yield what makes a calibration: the words behind ``fit``."""
    for source, asked in SOURCES.items():
        models = (*MODELS, WARM, "outputs.toml") if "warm" in source else MODELS
        for model, estimator, budget in itertools.product(models, ESTIMATORS, BUDGETS):
            yield (source.strip(), "--unit", "g", *asked.split(), *chosen(model, estimator, budget))


def chosen(model: str, estimator: str, budget: str) -> tuple[str, ...]:
    """Return the words of a model, an estimator and a budget."""
    named = {"--model": model, "--budget": budget}
    pairs = [(option, value) for option, value in named.items() if value]
    alone = [] if estimator == "." else estimator.split("+")
    return (*alone, *itertools.chain.from_iterable(pairs))


KINDS = tuple(_kinds())


def flags(command: str) -> tuple[str, ...]:
    """Return the options of a command that take no value."""
    return tuple(a.option_strings[-1] for a in options.actions(command) if a.nargs == 0)


def cycled(line: str) -> Iterator[str]:
    """Return none and each of the options of a line that take no value, for ever."""
    return itertools.cycle(("", *flags(line.split()[0])))


@functools.cache
def make(words: tuple[str, ...]) -> bytes | None:
    """Return the file of a calibration of a kind; None where these words are refused.

    The files that it is made of stand in `VALID`.
    """
    with tempfile.TemporaryDirectory() as place, contextlib.chdir(place):
        for name in VALID.keys() & set(words):
            Path(name).write_bytes(VALID[name])
        said = io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            cli.main(["fit", *words, "-o", "made.json"])
        made = Path("made.json")
        return made.read_bytes() if made.exists() else None


VALID: dict[str, bytes] = {}


def draw(rng: random.Random, valid: Mapping[str, bytes]) -> tuple[list[str], dict[str, bytes]]:
    """Return a command over one kind of calibration, and the file of that; flags are among it."""
    VALID.update(valid)
    words, made = rng.choice(KINDS), None
    if rng.random() < 0.2:
        line = shlex.split(rng.choice(MAKING))
        line += chosen(rng.choice(MODELS), rng.choice(ESTIMATORS), rng.choice(BUDGETS))
    elif rng.random() < 0.9 and (made := make(words)) is not None:
        line = filled(rng.choices(COMMANDS, _ODDS)[0], words)
    else:
        line = ["fit", *words, "-o", "o.json"]
    known = flags(line[0])
    line += rng.sample(known, min(len(known), rng.choice((0, 1, 1, 2, 3))))
    return line, {} if made is None else {CALIBRATION: made}


def filled(line: str, words: tuple[str, ...]) -> list[str]:
    """Return a command that reads a calibration of this kind, with the readings of that."""
    return [words[0] if word == "READINGS" else word for word in shlex.split(line)]
