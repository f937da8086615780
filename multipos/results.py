"""What every result is: a frozen dataclass that can be pickled, copied and compared by value.

A class of results derives from `Result` and is declared ``@dataclass(frozen=True, eq=False)``, for
the equality that a dataclass writes itself asks arrays whether they are true. Two results are equal
where their fields are: arrays by shape and value, NaN equal to NaN. What only tells two runs apart,
the time and the names of files, is a field with ``compare=False``.

Arrays are read-only and mappings `Frozen`, and they are still so after pickling and copying.
Nothing that a `cached_property` has worked out goes along: it is worked out again.
"""

from collections.abc import Iterable, Mapping
from dataclasses import Field, fields
from typing import Any, ClassVar, NoReturn, TypeVar

import numpy as np

K = TypeVar("K")
V = TypeVar("V")


class Record(dict[K, V]):
    """A dictionary whose values, arrays among them, are compared by value."""

    def __eq__(self, other: object) -> bool:
        return _same(self, other) if isinstance(other, Mapping) else NotImplemented

    def __ne__(self, other: object) -> bool:  # a dictionary has its own, which asks arrays
        return not self == other

    __hash__ = None  # as of every dictionary


class Frozen(Record[K, V]):
    """A dictionary that cannot be changed, nor the arrays in it."""

    def __init__(self, content: Mapping[K, V] | Iterable[tuple[K, V]] = ()) -> None:
        super().__init__({key: freeze(value) for key, value in dict(content).items()})

    def __reduce__(self) -> tuple[type, tuple[dict[K, V]]]:
        return type(self), (dict(self),)  # not entry by entry, which it would refuse

    def _refuse(self, *_: object, **__: object) -> NoReturn:
        raise TypeError("what a result holds cannot be changed; make a copy of it with dict(…).")

    __setitem__ = __delitem__ = __ior__ = _refuse
    clear = pop = popitem = setdefault = update = _refuse


class Result:
    """The base of all results."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def __post_init__(self) -> None:
        """Make arrays read-only and mappings frozen."""
        self.__setstate__(self.__getstate__())

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        names = [field.name for field in fields(self) if field.compare]
        return all(_same(getattr(self, name), getattr(other, name)) for name in names)

    __hash__ = None  # type: ignore[assignment]  # arrays have no hash

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        for name, value in state.items():
            object.__setattr__(self, name, freeze(value))


def freeze(value: Any) -> Any:
    """Return a value of a result as it is kept: its arrays read-only, its mappings frozen."""
    if isinstance(value, np.ndarray):
        value.setflags(write=False)
    elif isinstance(value, Mapping):
        return value if isinstance(value, Frozen) else Frozen(value)
    elif isinstance(value, tuple):
        kept = [freeze(part) for part in value]
        if any(new is not old for new, old in zip(kept, value, strict=True)):
            return type(value)(*kept) if hasattr(value, "_fields") else tuple(kept)
    return value


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        if type(one) is not type(other):
            return False
        return np.array_equal(one, other, equal_nan=one.dtype.kind == other.dtype.kind == "f")
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(_same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(_same, one, other))
    return bool(one == other or (one != one and other != other))
