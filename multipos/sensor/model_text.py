"""User-defined models as they are written: a line of text, or a file with parameters and outputs.

`read_model` reads either and leaves any other text as it is; `parsed_dict` and `parsed_from_dict`
carry a `ParsedModel` through the file of a calibration.

A line names outputs and says what each reads, ``each = b + s*own/(1 + k*own^2)``; lines of one
text stand apart by ``;``. A TOML file has the same lines and what is known of the parameters:

    [parameters]
    k = 0.01                                            # where the search starts
    common_t = { start = 20, sd = 5, unit = "degC" }    # sd: of a normal prior about the start
    c = { low = 0, high = 1 }                           # bounds

    [outputs]
    each = "b + s*own/(1 + k*own^2)"

Every output has its own copy of a parameter, unless its name begins ``common_``. Names are x, y, z,
own, columns of the readings and parameters; a parameter need not be listed in the file.
"""

import math
import os
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import field, replace
from functools import cached_property, lru_cache
from typing import Any

from multipos.errors import MultiposError, UsageError
from multipos.files.records import is_number
from multipos.files.spelling import StrPath, near
from multipos.files.trees import read_toml
from multipos.numerics.arrays import COMPONENTS, LARGEST, LARGEST_SAMPLE, SMALLEST
from multipos.positions.headers import is_environment
from multipos.results import Result, frozen
from multipos.sensor.formulas import CONSTANTS, FUNCTIONS, LONGEST_LINE, Formula, parse_formula

SHARED = "common"  # the output of what all outputs share, and how such a name begins
EACH = "each"
_NAME = re.compile(r"[^\W\d]\w*")
_TAKEN = (*COMPONENTS, "own", *CONSTANTS, *FUNCTIONS)
_SAID = ("start", "sd", "unit", "low", "high")  # of a parameter
_TELLING = 4  # characters of a name that can be a misspelt column
_KEPT = 64  # lines
_FAR = 1e9  # of a start: a bound beyond which bounds nothing, and takes its digits
_ALIKE = 0.8  # of two names, from which one is the other misspelt


@frozen(eq=True)
class StatedParameter(Result):
    """What is known of a parameter before any reading; see the module for `start`, `sd`, bounds."""

    name: str
    start: float | None = None
    sd: float | None = None
    unit: str | None = None
    low: float = -math.inf
    high: float = math.inf

    @property
    def bounded(self) -> bool:
        """Whether there is a bound."""
        return math.isfinite(self.low) or math.isfinite(self.high)


@frozen(eq=True)
class ParsedModel(Result):
    """A model of one's own as it was written.

    Attributes
    ----------
    lines : tuple of (output or 'each', formula)
    quantities : tuple of StatedParameter
        The parameters of which something is stated.
    where : str
        The file or the text, for messages.
    starts : tuple of int
        Characters before the formula of each line, in the text.
    """

    lines: tuple[tuple[str, str], ...]
    quantities: tuple[StatedParameter, ...]
    where: str = field(compare=False)
    starts: tuple[int, ...] = field(compare=False)

    @property
    def text(self) -> str:
        """The lines as one."""
        return "; ".join(f"{name} = {formula}" for name, formula in self.lines)

    @property
    def in_line(self) -> bool:
        """Whether it was given as a line of text, not in a file."""
        return self.where.startswith("model '")

    @property
    def fault(self) -> type[ValueError]:
        """The error of a line that is wrong: of the command line, or of a file."""
        return UsageError if self.in_line else MultiposError

    @cached_property
    def formulas(self) -> dict[str, Formula]:
        """The parsed lines by the output that each is of."""
        found = {}
        for (name, formula), start in zip(self.lines, self.starts, strict=True):
            where = self.where if self.in_line else f"{self.where}: [outputs] {name}"
            found[name] = parse_formula(formula, where, start, self.fault)
        return found

    @cached_property
    def built(self) -> dict[tuple[Any, ...], Any]:
        """Models that were built of it, by what each is for."""
        return {}

    @cached_property
    def stated(self) -> dict[str, StatedParameter]:
        """What is stated of parameters, by their names."""
        return {quantity.name: quantity for quantity in self.quantities}

    @cached_property
    def possible_columns(self) -> tuple[str, ...]:
        """Names that are columns if the readings have such: no component, no listed parameter."""
        names = (name for formula in self.formulas.values() for name in formula.names)
        taken = (*COMPONENTS, "own", *self.stated)
        return tuple(
            dict.fromkeys(n for n in names if n not in taken and not n.startswith(f"{SHARED}_"))
        )

    def columns_among(self, known: Iterable[str]) -> tuple[str, ...]:
        """Return the columns that the formulas use, of those known or columns by their name."""
        columns = set(known)
        return tuple(n for n in self.possible_columns if n in columns or is_environment(n))

    def require_no_near_miss(
        self, columns: tuple[str, ...], known: Sequence[str], outputs: Sequence[str] = ()
    ) -> None:
        """Refuse a name that is an output, or no column but nearly one: neither is a parameter.

        Raises
        ------
        UsageError
            With the column that was meant.
        """
        words = {word.casefold(): word for word in (*known, "temperature", "own")}
        for formula in self.formulas.values():
            for name, character in formula.names.items():
                if name in outputs and name not in self.stated:
                    formula.fail(
                        character,
                        f"'{name}' is an output of the readings, which a formula does not use; "
                        "give the parameter another name, or the outputs with --outputs",
                    )
                if name not in self.possible_columns or name in columns or name in known:
                    continue
                meant = _meant(name.casefold(), words)
                if meant:
                    formula.fail(
                        character,
                        f"'{name}' is no column; did you mean '{words[meant]}'? A parameter of "
                        "this name is listed in [parameters] of a TOML file",
                    )


def _meant(name: str, words: Collection[str]) -> str:
    """Return the word that a name nearly is, or ''; of short names only the letters' order errs."""
    from difflib import get_close_matches

    swapped = (w for w in words if w == name or (len(w) > 2 and sorted(w) == sorted(name)))
    close = get_close_matches(name, words, 1, _ALIKE) if len(name) >= _TELLING else []
    return next(swapped, "") or "".join(close)


def read_model(model: StrPath) -> "str | ParsedModel":
    """Return a model of one's own from its line or from a TOML file; any other text as it is.

    Only a text with '=' is a line of one's own, so that a misspelt name never becomes one.

    Raises
    ------
    UsageError
        A line that cannot be read; the message names the character. Neither text nor a path.
    MultiposError
        A file that cannot be read, or says what no model does.
    """
    if not isinstance(model, str | os.PathLike):
        raise UsageError(
            f"a model is a name, a formula or a TOML file, got {type(model).__name__}; write what "
            "a function computes as a formula, such as 'each = b + s*own'."
        )
    if isinstance(model, str) and "=" in model:
        return _from_line(model)
    if isinstance(model, str) and not model.strip().lower().endswith(".toml"):
        return model
    path = os.fspath(model).strip()
    return _checked(_from_tables(read_toml(path, "model"), path))


@lru_cache(maxsize=_KEPT)
def _from_line(text: str) -> ParsedModel:
    where = f"model '{' '.join(text.split())}'"
    lines, starts, at = [], [], 0
    for part in re.split(r"[;\n]", text):
        name, mark, formula = part.partition("=")
        if part.strip():
            if not mark or not _NAME.fullmatch(name.strip()):
                raise UsageError(
                    f"{where}, character {at + 1}: '{part.strip()}' is no line of a model; write "
                    "'each = …', or an output, '=' and what it reads."
                )
            lines.append((name.strip(), formula.strip()))
            starts.append(
                at + len(name) + 1 + len(formula) - len(formula.lstrip()) if formula.strip() else at
            )
        at += len(part) + 1
    return _checked(ParsedModel(tuple(lines), (), where, tuple(starts)))


def _from_tables(tables: Mapping[str, Any], path: str) -> ParsedModel:
    for name, table in tables.items():
        if name not in ("parameters", "outputs") or not isinstance(table, Mapping):
            raise MultiposError(
                f"{path}: '{name}' is no table of a model; it has [parameters] and [outputs]."
            )
    outputs = tables.get("outputs", {})
    if not outputs:
        raise MultiposError(f'{path}: no [outputs]; add one with each = "b + s*own".')
    for name, formula in outputs.items():
        if not isinstance(formula, str):
            raise MultiposError(f"{path}: [outputs] {name} must be text, a formula in quotes.")
    found = [_quantity(path, name, said) for name, said in tables.get("parameters", {}).items()]
    lines = tuple((name, formula.strip()) for name, formula in outputs.items())
    starts = tuple(len(text) - len(text.lstrip()) for text in outputs.values())
    return ParsedModel(lines, tuple(found), path, starts)


def _quantity(path: str, name: str, said: Any) -> StatedParameter:
    where = f"{path}: [parameters] {name}"
    if not _NAME.fullmatch(name) or name in _TAKEN:
        raise MultiposError(f"{where}: this is no name for a parameter; use another.")
    given = said if isinstance(said, Mapping) else {"start": said}
    for key, value in given.items():
        _check_entry(where, key, value)
    numbers: dict[str, Any] = {k: v if k == "unit" else float(v) for k, v in given.items()}
    quantity = StatedParameter(name, **numbers)
    _check_quantity(quantity, where)
    low, high = quantity.low, quantity.high
    far = _FAR * max(1.0, abs(quantity.start or 0.0), low, -high)
    return replace(
        quantity, low=-math.inf if low < -far else low, high=math.inf if high > far else high
    )


def _check_entry(where: str, key: str, value: Any) -> None:
    if key not in _SAID:
        raise MultiposError(
            f"{where}: unknown '{key}'{near(key, _SAID)} It takes {', '.join(_SAID)}."
        )
    if key == "unit":
        if not isinstance(value, str):
            raise MultiposError(f"{where}: unit must be text in quotes, got {value!r}.")
        if len(value) > LONGEST_LINE:
            raise MultiposError(f"{where}: unit has {len(value)} characters, above {LONGEST_LINE}.")
        return
    number = is_number(value)
    infinite = number and key in ("low", "high") and math.isinf(value)
    largest = LARGEST_SAMPLE if key == "start" else LARGEST
    if not infinite and not (number and abs(value) <= largest):
        raise MultiposError(
            f"{where}: {key} must be a number of at most {largest:g} in size, got {value!r}."
        )


def _check_quantity(quantity: StatedParameter, where: str) -> None:
    start, sd, low, high = quantity.start, quantity.sd, quantity.low, quantity.high
    if not low < high:
        raise MultiposError(f"{where}: low {low:g} must be below high {high:g}.")
    if start is not None and not low <= start <= high:
        raise MultiposError(f"{where}: start {start:g} is not from {low:g} to {high:g}.")
    if sd is not None and not sd >= SMALLEST:
        raise MultiposError(f"{where}: sd must be at least {SMALLEST:g}, got {sd:g}.")
    if sd is not None and start is None:
        raise MultiposError(f"{where}: sd is that of a prior about start; give start as well.")


def _checked(parsed: ParsedModel) -> ParsedModel:
    """Return a parsed model whose lines can be read, and whose listed parameters are all used."""
    names = [name for name, _ in parsed.lines]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise parsed.fault(f"{parsed.where}: '{twice[0]}' has two lines; give one.")
    used = {name for formula in parsed.formulas.values() for name in formula.names}
    for quantity in parsed.quantities:
        if quantity.name not in used:
            raise MultiposError(
                f"{parsed.where}: [parameters] {quantity.name} stands in no formula"
                f"{near(quantity.name, used)} Use it, or leave it out."
            )
    return parsed


def parsed_dict(parsed: ParsedModel) -> dict[str, Any]:
    """Return a parsed model as what JSON can carry."""
    unsaid = (None, -math.inf, math.inf)
    quantities = {
        q.name: {key: getattr(q, key) for key in _SAID if getattr(q, key) not in unsaid}
        for q in parsed.quantities
    }
    return {"parameters": quantities, "outputs": dict(parsed.lines)}


def parsed_from_dict(content: Mapping[str, Any]) -> ParsedModel:
    """Return the parsed model that `parsed_dict` described.

    Raises
    ------
    MultiposError
        It says what no model does.
    """
    return _checked(_from_tables(content, "its model"))
