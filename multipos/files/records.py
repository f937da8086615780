"""What the JSON files of results hold: a kind for every key, which checks, reads and writes it.

- `require` holds the content of a file to its description, `restore` makes the result of it.
- `require_covariance` holds a covariance to the uncertainties stated beside it.
- `is_number` tells whether a value of a file is a number.

Calibrations, regressions and checks are files that may be old, damaged, edited by hand or from
somebody else. Each kind of file is described by a `Fields` beside the type that it becomes, and
`require` compares: types, sizes, known words, numbers that arithmetic can carry. What it lets
through can be read without a further question; how values hang together is for the reader. Keys
that the description does not name are left alone. `multipos.files.schema` makes the description of
a type of its fields.

Text has no control characters: it goes to terminals, into reports, and as comments into files
that other programs read line by line.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import field
from typing import Annotated, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError
from multipos.files.spelling import control_characters, visible
from multipos.numerics.arrays import COMPONENTS, SMALLEST
from multipos.results import frozen

LARGEST = 1e100  # of a number; squares and their sums stay finite
LARGEST_SQUARE = LARGEST**2  # of variances and covariances
LONGEST = 10_000  # characters of a text
_SAME = 1e-6  # relative; what was written with all its digits is nearer by far
_SHOWN = 40  # characters of a value in a message

Restored = TypeVar("Restored")


class _KindError(Exception):
    """Something is not of its kind: where, what stands there, and what is needed."""


class Kind:
    """What a value must be, and how it goes to a file and comes from there."""

    def check(self, value: Any, place: str) -> None:
        """Raise a fault where the value is something else."""

    def read(self, value: Any) -> Any:
        """Return what a result holds for a value of a file that has been checked."""
        return value

    def write(self, value: Any) -> Any:
        """Return the value of a file, up to arrays and NaN, for what a result holds."""
        return value


@frozen(eq=True)
class Text(Kind):
    """A text without control characters, one of `choices` where these are given."""

    choices: tuple[str, ...] = ()
    empty: bool = True

    def check(self, value: Any, place: str) -> None:
        """Raise a fault where the value is something else."""
        if self.choices:
            if not isinstance(value, str) or value not in self.choices:
                raise _KindError(place, value, f"one of {', '.join(self.choices)}")
            return
        if not isinstance(value, str):
            raise _KindError(place, value, "a text")
        if not (value or self.empty):
            raise _KindError(place, value, "a text that is not empty")
        if len(value) > LONGEST:
            raise _KindError(place, value, f"a text of at most {LONGEST} characters")
        if control_characters(value):
            raise _KindError(place, value, "a text without control characters")


@frozen(eq=True)
class Number(Kind):
    """A number from `low` to `high`; with `above` and `below` these are left out themselves."""

    low: float = -LARGEST
    high: float = LARGEST
    above: bool = False
    below: bool = False

    def check(self, value: Any, place: str) -> None:
        """Raise a fault where the value is something else."""
        if not is_number(value):
            raise _KindError(place, value, "a number")
        low = value > self.low if self.above else value >= self.low
        high = value < self.high if self.below else value <= self.high
        if not (low and high):
            raise _KindError(place, value, f"a number {self._range()}")

    def read(self, value: float) -> float:
        """Return it as a float."""
        return float(value)

    def _range(self) -> str:
        low = f"above {self.low:g}" if self.above else f"of at least {self.low:g}"
        return f"{low} and {'below' if self.below else 'at most'} {self.high:g}"


@frozen(eq=True)
class Whole(Kind):
    """A whole number."""

    low: int = 0
    high: int = 10**12

    def check(self, value: Any, place: str) -> None:
        """Raise a fault where the value is something else."""
        whole = isinstance(value, int) and not isinstance(value, bool)
        if not (whole and self.low <= value <= self.high):
            raise _KindError(place, value, f"a whole number from {self.low} to {self.high}")


@frozen(eq=True)
class Flag(Kind):
    """True or false."""

    def check(self, value: Any, place: str) -> None:
        """Raise a fault where the value is something else."""
        if not isinstance(value, bool):
            raise _KindError(place, value, "true or false")


@frozen(eq=True)
class Maybe(Kind):
    """A kind, or null, which is read as `missing`."""

    kind: Kind
    missing: Any = None

    def check(self, value: Any, place: str) -> None:
        """Raise a fault where the value is something else."""
        if value is not None:
            self.kind.check(value, place)

    def read(self, value: Any) -> Any:
        """Return what a result holds."""
        return self.missing if value is None else self.kind.read(value)

    def write(self, value: Any) -> Any:
        """Return the value of a file."""
        return None if value is None else self.kind.write(value)


@frozen(eq=True)
class AnyOf(Kind):
    """The first of some kinds that fits decides; a fault speaks of the last."""

    kinds: tuple[Kind, ...]

    def check(self, value: Any, place: str) -> None:
        """Raise a fault where the value is something else."""
        for kind in self.kinds[:-1]:
            try:
                return kind.check(value, place)
            except _KindError:
                continue
        return self.kinds[-1].check(value, place)

    def read(self, value: Any) -> Any:
        """Return what a result holds: as the kinds have it where all are of one sort."""
        alike = len(set(map(type, self.kinds))) == 1
        return self.kinds[0].read(value) if alike else value


@frozen(eq=True)
class Listed(Kind):
    """A list of entries of one kind, of a length from `least` to `most`."""

    kind: Kind
    least: int = 0
    most: int = 10**9

    def check(self, value: Any, place: str) -> None:
        """Raise a fault where the value is something else."""
        if not isinstance(value, list):
            raise _KindError(place, value, "a list")
        if not self.least <= len(value) <= self.most:
            need = f"{self.least}" if self.least == self.most else f"at least {self.least}"
            need = need if len(value) < self.least else f"at most {self.most}"
            raise _KindError(place, value, f"a list of {need}")
        for index, entry in enumerate(value):
            self.kind.check(entry, f"{place}[{index}]")

    def read(self, value: Any) -> Any:
        """Return a tuple."""
        return tuple(map(self.kind.read, value))

    def write(self, value: Any) -> Any:
        """Return a list."""
        return list(map(self.kind.write, value))


@frozen(eq=True)
class Entries(Kind):
    """A list of so many entries, each of a kind of its own."""

    kinds: tuple[Kind, ...]

    def check(self, value: Any, place: str) -> None:
        """Raise a fault where the value is something else."""
        if not isinstance(value, list) or len(value) != len(self.kinds):
            raise _KindError(place, value, f"a list of {len(self.kinds)}")
        for index, (kind, entry) in enumerate(zip(self.kinds, value, strict=True)):
            kind.check(entry, f"{place}[{index}]")


@frozen(eq=True)
class Named(Kind):
    """An object whose keys are names, with values of one kind."""

    kind: Kind

    def check(self, value: Any, place: str) -> None:
        """Raise a fault where the value is something else."""
        if not isinstance(value, Mapping):
            raise _KindError(place, value, "an object")
        for name, entry in value.items():
            Text().check(name, f"a key of {place}")
            self.kind.check(entry, f"{place}.{name}")

    def read(self, value: Any) -> Any:
        """Return a dict."""
        return {name: self.kind.read(entry) for name, entry in value.items()}

    def write(self, value: Any) -> Any:
        """Return a dict."""
        return {name: self.kind.write(entry) for name, entry in value.items()}


@frozen(eq=True)
class Fields(Kind):
    """An object with keys that it needs, and keys that it may have."""

    needed: Mapping[str, Kind]
    optional: Mapping[str, Kind] = field(default_factory=dict)

    def check(self, value: Any, place: str) -> None:
        """Raise a fault where the value is something else."""
        if not isinstance(value, Mapping):
            raise _KindError(place, value, "an object")
        inside = f"{place}." if place else ""
        for name, kind in (*self.needed.items(), *self.optional.items()):
            if name in value:
                kind.check(value[name], f"{inside}{name}")
            elif name in self.needed:
                raise _KindError(f"{inside}{name}")


@frozen(eq=True)
class Numbers(Kind):
    """Nested lists of numbers as an array of `depth` dimensions; with `gaps`, null is taken."""

    depth: int = 1
    gaps: bool = False
    low: float = -LARGEST
    high: float = LARGEST

    def check(self, value: Any, place: str) -> None:
        """Raise a fault where the value is something else."""
        if not self._is_sound(value):
            self._search(value, place, self.depth)

    def read(self, value: Any) -> Any:
        """Return an array, null as NaN."""
        return np.array(value, dtype=np.float64)

    def _is_sound(self, value: Any) -> bool:
        """Tell in one go whether all is well, as it is in a long file that is."""
        try:
            array = np.array(value)
        except ValueError:  # rows differ in length
            return False
        if array.ndim != self.depth or array.dtype.kind not in "iuf" or not array.size:
            return False
        return bool(((array >= self.low) & (array <= self.high)).all())

    def _search(self, value: Any, place: str, depth: int) -> None:
        if not depth:
            kind = Number(self.low, self.high)
            return (Maybe(kind) if self.gaps else kind).check(value, place)
        if not isinstance(value, list):
            raise _KindError(place, value, "a list" if depth == 1 else "a list of lists")
        for index, entry in enumerate(value):
            self._search(entry, f"{place}[{index}]", depth - 1)
            if depth > 1 and len(entry) != len(value[0]):
                raise _KindError(f"{place}[{index}]", entry, f"a list of {len(value[0])}")
        return None


ANY_TEXT = Text()
NAME = Text(empty=False)
NAMES = Listed(NAME)
TEXTS = Listed(ANY_TEXT)
ANY_NUMBER = Number()
POSITIVE = Number(0.0, above=True)
DOF = Number(1e-6)  # degrees of freedom; of fewer a tail has no digits
NOT_NEGATIVE = Number(0.0)
SHARE = Number(SMALLEST, 1.0, below=True)  # a probability that is neither never nor always
VARIANCES = Numbers(2, gaps=True, low=-LARGEST_SQUARE, high=LARGEST_SQUARE)
FIGURE = Maybe(Number(-LARGEST_SQUARE, LARGEST_SQUARE), math.nan)  # null: there is none
P_VALUE = Maybe(Number(0.0, 1.0))
AXIS = Text(COMPONENTS)
# The same as types of fields, for `multipos.files.schema`.
Positive = Annotated[float, POSITIVE]
NotNegative = Annotated[float, NOT_NEGATIVE]
Share = Annotated[float, SHARE]
Figure = Annotated[float, FIGURE]


def require(content: Any, kind: Kind, where: str, again: str) -> None:
    """Hold the content of a file to its description.

    Parameters
    ----------
    content : object
        As JSON gave it.
    kind : Kind
    where : str
        The file, for the message.
    again : str
        What writes the file again, as in 'fit again'.

    Raises
    ------
    MultiposError
        Something is missing or of another kind; the message names file, key, what stands there
        and what is needed.
    """
    try:
        kind.check(content, "")
    except _KindError as fault:
        if len(fault.args) == 1:
            said = f"the key '{visible(fault.args[0])}' is missing"
        else:
            place, found, need = fault.args
            said = f"{visible(place) or 'all of it'} is {_in_words(found)}; {need} is needed there"
        raise MultiposError(f"{where}: {said}; the file is damaged, {again}.") from None


def restore(
    content: Any, kind: Kind, make: Callable[[Any], Restored], where: str, *, what: str, again: str
) -> Restored:
    """Return what a file holds, once its content is as its description has it.

    Parameters
    ----------
    content : object
        As JSON gave it.
    kind : Kind
    make : callable
        Takes the content; raises ValueError where its parts contradict each other.
    where : str
        The file, for the message.
    what : str
        What the file should hold, as in 'calibration'.
    again : str
        What writes the file again, as in 'fit again'.

    Raises
    ------
    MultiposError
        As in `require`, or the parts contradict each other.
    """
    require(content, kind, where, again)
    try:
        return make(content)
    except ValueError as error:
        said = str(error).rstrip(".")
        raise MultiposError(f"{where}: not a {what}: {said}; {again}.") from None


def require_covariance(covariance: NDArray[np.float64], u: NDArray[np.float64]) -> None:
    """Hold a covariance (p, p) to the standard uncertainties (p,) stated beside it.

    Where there is none, both are NaN.

    Raises
    ------
    ValueError
        It is not symmetric, has a negative direction, or its diagonal is not u².
    """
    with np.errstate(invalid="ignore"):
        own = np.sqrt(np.diag(covariance))
    known = np.isfinite(own)
    stated = np.allclose(own, u, rtol=_SAME, atol=0.0, equal_nan=True)
    if not stated or (np.diag(covariance) < 0.0).any():
        raise ValueError("its covariance does not have the squared uncertainties on its diagonal")
    rest = covariance[np.ix_(known, known)]
    if not np.isfinite(rest).all() or rest[own[known] == 0.0].any():
        raise ValueError("its covariance has gaps, or a covariance with what has no uncertainty")
    some = own[known] > 0.0
    scale = own[known][some]
    correlation = rest[np.ix_(some, some)] / scale[:, None] / scale
    if len(scale) and not (
        np.allclose(correlation, correlation.T, rtol=0.0, atol=_SAME)
        and float(np.linalg.eigvalsh(correlation)[0]) >= -_SAME * len(scale)
    ):
        raise ValueError("its covariance is not symmetric, or negative in a direction")


def is_number(value: Any) -> bool:
    """Tell whether a value of a file is a number, which true is not."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def _in_words(value: Any) -> str:
    """Return what stands at a place, shortened: the kind of a list or an object, else the value."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, Mapping):
        return "an object"
    if isinstance(value, float) and not math.isfinite(value):
        return f"{value}"
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"
