"""The kinds of input, and one case of each: what `case(kind, seed, number, bases)` returns.

A case depends on its kind, seed and number alone. Every kind starts from a valid command line and
damages one thing, now and then with an option beside it.
"""

import random
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise

from . import (
    arrays,
    bases,
    crossing,
    hostile,
    json_files,
    options,
    raw,
    recipes,
    recordings,
    tables,
    toml_files,
    visits,
)
from .hostile import listed

Files = dict[str, bytes]
Mutate = Callable[[random.Random, bytes], bytes]

OLD_OUTPUT = b"what stood here before\n"


@dataclass(frozen=True)
class Case:
    """One run of the command line, with all that it finds in its folder.

    Attributes
    ----------
    argv : tuple of str
    files : dict of str to bytes
        What the command may read; none of it may change.
    old : tuple of str
        Outputs that are there already, with `OLD_OUTPUT` in them.
    links : dict of str to str
        Symbolic links and what they name.
    folders : tuple of str
    stdin : bytes or None
        What comes through a pipe; None is an empty stdin.
    stdout, stderr : str
        "open", "closed", "full" or "broken" (a pipe that nobody reads).
    """

    argv: tuple[str, ...]
    files: Files
    old: tuple[str, ...] = ()
    links: dict[str, str] = field(default_factory=dict)
    folders: tuple[str, ...] = ()
    stdin: bytes | None = None
    stdout: str = "open"
    stderr: str = "open"

    @property
    def output(self) -> str | None:
        """What follows the last -o."""
        places = [i for i, word in enumerate(self.argv[:-1]) if word == "-o"]
        return self.argv[places[-1] + 1] if places else None


def case(kind: str, seed: int, number: int, valid: Files) -> Case:
    """Return the case of this kind, seed and number."""
    rng = random.Random(f"{kind}/{seed}/{number}")
    made = KINDS[kind](rng, valid)
    output = made.output
    if output in options.OUTPUTS and output not in made.files and rng.random() < 0.5:
        made = replace(made, old=(output,))
    return made


def _case(words: list[str], valid: Files, changed: Files | None = None) -> Case:
    """A case of this command line, with those of the valid files that it names."""
    files = recipes.files_of(words, valid)
    return Case(tuple(word.replace("\0", "") for word in words), files | (changed or {}))


def _with_options(rng: random.Random, words: list[str], odds: float = 0.25) -> list[str]:
    """Now and then an option more, or another output, for a command that has its inputs."""
    inputs = tuple(name for name in map(recipes.file_of, words[1:]) if name in bases.NAMES)
    words = list(words)
    while rng.random() < odds:
        words += options.draw(rng, words[0], (*inputs, *bases.SCHEMES, *bases.BUDGETS))
        odds /= 2
    if rng.random() < 0.05:
        words = _replace_output(words, options.output(rng, inputs))
    return words


def _replace_output(words: list[str], name: str) -> list[str]:
    if "-o" in words:
        at = words.index("-o")
        words = words[:at] + words[at + 2 :]
    return [*words, "-o", name]


def _damaged(names: tuple[str, ...], mutate: Mutate) -> Callable[[random.Random, Files], Case]:
    """A kind: a command line that reads one of these files, with that file damaged."""

    def make(rng: random.Random, valid: Files) -> Case:
        words = list(recipes.draw(rng, names).words)
        name = rng.choice([name for name in map(recipes.file_of, words) if name in names])
        changed = {name: mutate(rng, valid[name])}
        return _case(_with_options(rng, words), valid, changed)

    return make


def _sections(rng: random.Random, data: bytes) -> bytes:
    return (json_files if data.startswith(b"{") else tables).mutate(rng, data)


def _limits(rng: random.Random, data: bytes) -> bytes:
    return (tables if data.startswith(b"name,") else toml_files).mutate(rng, data)


def _captures(rng: random.Random, valid: Files) -> Case:
    """A log that comes as if live: damaged, and with options."""
    fitting = [recipe for recipe in recipes.RECIPES if recipe.command == "capture"]
    words = list(rng.choice(fitting).words)
    name = recipes.file_of(words[1])
    data = tables.mutate(rng, valid[name]) if rng.random() < 0.8 else valid[name]
    words = _with_options(rng, words, odds=0.4)
    if rng.random() < 0.3:
        words[1] = "-"
        read = [word for before, word in pairwise(words) if before != "-o"]
        return Case(tuple(words), recipes.files_of(read, valid), stdin=data)
    return _case(words, valid, {name: data})


READ_COMMANDS = {
    "average {} --outputs ax,ay,az": 4,
    "average {} --rate 100 --json": 6,
    "average {} --scheme faces-6 -o o.csv": 4,
    "average {} --rate 100 --columns ax,ay,az": 4,
    "calibrate {} -o o.json": 4,
    "calibrate {} --scheme faces-6 -o o.json": 4,
    "apply lin.json {}": 6,
    "apply lin.json {} --columns time,ax,ay,az --json": 4,
    "apply plain-reg.json {}": 1,
    "fit {}": 2,
    "regress {} --response ax --variables time": 1,
    "capture replay:{}:0 --headless": 0.5,
    "stability {} --json": 0.5,
}  # and how often each is drawn


def _read_by(rng: random.Random, valid: Files, name: str, data: bytes) -> Case:
    words = rng.choices(list(READ_COMMANDS), READ_COMMANDS.values())[0].format(name).split()
    return _case(_with_options(rng, words), valid, {name: data})


def _arrays(rng: random.Random, valid: Files) -> Case:
    name = f"log{rng.choice(tuple(arrays.WRITERS))}"
    return _read_by(rng, valid, name, arrays.draw(rng, name[3:]))


def _recordings(rng: random.Random, valid: Files) -> Case:
    name = rng.choice(recordings.NAMES)
    return _read_by(rng, valid, name, recordings.draw(rng, name))


def _visits(rng: random.Random, valid: Files) -> Case:
    """The page, with a file that is damaged or, now and then, as it was."""
    name, words = visits.draw(rng)
    files = {each: valid[each] for each in visits.files_of(name)}
    spoilt = rng.choice((name, name, name, *files, ""))
    if spoilt:
        files[spoilt] = _mutate_any(rng, spoilt, valid[spoilt])
    return Case(words, files)


def _options(rng: random.Random, valid: Files) -> Case:
    """Valid files, and options that nobody gives together."""
    words = list(recipes.draw(rng).words)
    inputs = tuple(recipes.files_of(words[1:], valid))
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3))):
        words += options.draw(rng, words[0], (*inputs, *bases.SCHEMES, *bases.BUDGETS))
    if rng.random() < 0.1:
        words.remove(rng.choice(words[1:] or words))
    if rng.random() < 0.2:
        words = _replace_output(words, options.output(rng, inputs))
    return _case(words, valid)


def _crossed(rng: random.Random, valid: Files) -> Case:
    """Valid files, a kind of calibration, and options that take no value."""
    words, made = crossing.draw(rng, valid)
    return _case(words, valid, made)


def _scheme_names(rng: random.Random, valid: Files) -> Case:
    """Schemes as files or, one in three times, as names."""
    if rng.random() < 0.67:
        return _SCHEME_FILES(rng, valid)
    words = list(recipes.draw(rng, bases.SCHEMES).words)
    at = rng.choice([i for i, word in enumerate(words) if word in bases.SCHEMES])
    names = rng.choices(options.SCHEMES, k=rng.choice((1, 1, 1, 2, 3)))
    words[at] = "+".join(names) if rng.random() < 0.9 else hostile.text(rng)
    if words[at].startswith("-"):
        words[at] = f"x{words[at]}"
    return _case(_with_options(rng, words), valid)


def _streams(rng: random.Random, valid: Files) -> Case:
    """An input through a pipe, -o to stdout, and streams that are closed, full or broken."""
    words = list(recipes.draw(rng).words)
    inputs = [i for i, word in enumerate(words) if recipes.file_of(word) in valid]
    stdin, files = None, recipes.files_of(words, valid)
    if inputs and rng.random() < 0.8:
        at = rng.choice(inputs)
        name = recipes.file_of(words[at])
        words[at] = rng.choice(("-", recipes.renamed(words[at], "/dev/stdin")))
        stdin = _mutate_any(rng, name, valid[name]) if rng.random() < 0.4 else valid[name]
        if name not in map(recipes.file_of, words):
            del files[name]
        if rng.random() < 0.05:
            words[rng.choice(inputs)] = words[at]
    if rng.random() < 0.3:
        words = _replace_output(words, rng.choice(("-", "-", "/dev/stdout")))
    state = ("open", "closed", "full", "broken")
    stdout = rng.choices(state, (8, 1, 1, 1))[0]
    stderr = rng.choices(state, (10, 1, 1, 1))[0]
    return Case(tuple(words), files, stdin=stdin, stdout=stdout, stderr=stderr)


def _mutate_any(rng: random.Random, name: str, data: bytes) -> bytes:
    """Damage a file as its ending asks for."""
    mutators = {".csv": tables.mutate, ".json": json_files.mutate, ".toml": toml_files.mutate}
    return mutators.get(name[name.rfind(".") :], raw.damage)(rng, data)


NAMES = (
    *listed(
        "caf\udce9.csv é.csv 日本.json '.csv -x.csv --json +.csv %s.csv x.CSV x .csv .hidden ~"
    ),
    *listed("faces-6 <b>.csv $HOME *.csv CON x.csv. \x1b[31m.csv"),
    *(" ", "a b.csv", "a\nb.csv", "n" * 250 + ".csv", "n" * 256),
)
PLACES = (
    *listed(
        "missing/o.csv folder folder/o.json . .. loop dangling link beside.csv /dev/null folder/"
    ),
    *listed("inside/../o.csv caf\udce9.json six.csv/x o.csv/ o.json o_test.c o.c o.svg"),
    *("", " ", "o\n.csv", "n" * 250 + ".json", "n" * 256),
)


def _paths(rng: random.Random, valid: Files) -> Case:
    """Names of files: inputs and outputs that are strange, the same, links, folders, missing."""
    words = list(recipes.draw(rng).words)
    files = recipes.files_of(words, valid)
    inputs = [i for i, word in enumerate(words) if recipes.file_of(word) in valid]
    linked = rng.choice(inputs) if inputs else None
    if inputs and rng.random() < 0.5:
        at = rng.choice(inputs)
        if rng.random() < 0.5:
            name = rng.choice(NAMES)
            files[name] = files[recipes.file_of(words[at])]
        else:
            name = rng.choice(PLACES)
        words[at] = recipes.renamed(words[at], name)
    # To what the command reads now: another file may be written over where -o names it.
    target = "" if linked is None else recipes.file_of(words[linked])
    links = {
        "loop": "loop",
        "dangling": "nowhere",
        "link": target or "nothing",
        "beside.csv": "missing/x.csv",
    }
    if rng.random() < 0.7:
        same = [f"{rng.choice(('', './'))}{recipes.file_of(words[i])}" for i in inputs]
        named = (*PLACES, "/dev/full", *NAMES, *same * 3)
        words = _replace_output(words, rng.choice(named))
    return Case(tuple(words), files, links=links, folders=("folder",))


_SCHEME_FILES = _damaged(bases.SCHEMES, tables.mutate)

KINDS: dict[str, Callable[[random.Random, Files], Case]] = {
    "readings": _damaged(bases.READINGS, tables.mutate),
    "schemes": _scheme_names,
    "logs": _damaged(bases.LOGS, tables.mutate),
    "arrays": _arrays,
    "recordings": _recordings,
    "sections": _damaged(bases.SECTIONS, _sections),
    "data": _damaged(bases.DATA, tables.mutate),
    "calibrations": _damaged(bases.CALIBRATIONS, json_files.mutate),
    "regressions": _damaged(bases.REGRESSIONS, json_files.mutate),
    "checks": _damaged(bases.CHECKS, json_files.mutate),
    "budgets": _damaged(bases.BUDGETS, toml_files.mutate),
    "laboratories": _damaged(bases.LABORATORIES, toml_files.mutate),
    "models": _damaged(bases.MODELS, toml_files.mutate),
    "fleets": _damaged(bases.FLEETS, tables.mutate),
    "limits": _damaged(bases.LIMITS, _limits),
    "records": _damaged(bases.RECORDS, json_files.mutate),
    "captures": _captures,
    "visits": _visits,
    "options": _options,
    "crossing": _crossed,
    "streams": _streams,
    "paths": _paths,
}
