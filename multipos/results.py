"""What every result is: a frozen dataclass that can be pickled, copied and compared by value.

`frozen` declares a class of results, `changed` returns one with other values and `require` refuses
what is none. `freeze` makes a value unchangeable, `plain` and `plain_dict` make it what JSON can
carry. `stacked` joins tables and `data_frame` returns one as pandas has it.

A class of results derives from `Result` and is declared ``@frozen``, without the equality of a
dataclass, which asks arrays whether they are true. Two results are equal where their fields are:
arrays by shape and value, NaN equal to NaN. What only tells two runs apart, the time and the names
of files, is a field with ``compare=False``.

Arrays are read-only and mappings `Frozen`, and they are still so after pickling and copying.
Nothing that a `cached_property` has worked out goes along: it is worked out again.

A result that is one thing with parts is `Keyed`: its fields are the keys of its JSON, and are read
as attributes or by key. One that is a table is `Columns`, one that has a table is `Tabular`.

How a result shows itself, printed, in a notebook or drawn, is for `multipos.reports.showing`, which
knows results and is found by its name when it is asked: nothing here knows a report.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import Field, FrozenInstanceError, dataclass, field, fields
from importlib import import_module
from operator import is_not
from typing import Any, ClassVar, NoReturn, TypeVar, dataclass_transform, overload

import numpy as np

from multipos.errors import MultiposError

_SHOWING = "multipos.reports.showing"
_LONGEST = 500  # characters of a result in a list, or in the debugger

K = TypeVar("K")
V = TypeVar("V")
T = TypeVar("T")
R = TypeVar("R", bound="Result")


@overload
def frozen(made: type[T], /) -> type[T]: ...


@overload
def frozen(*, eq: bool) -> Callable[[type[T]], type[T]]: ...


@dataclass_transform(eq_default=False, frozen_default=True, field_specifiers=(field,))
def frozen(made: Any = None, /, *, eq: bool = False) -> Any:
    """Make a class a frozen dataclass; with `eq`, one compared and hashed by its fields.

    All share their methods but ``__init__``. Those that ``dataclass(frozen=True)`` compiles for
    every class anew were a fifth of the time in which a command starts.
    """

    def of(made: type[T]) -> type[T]:
        shared = {**_FROZEN, **(_BY_FIELDS if eq else {})}
        for name, method in shared.items():
            if name not in made.__dict__:
                setattr(made, name, method)
        made.__doc__ = made.__doc__ or made.__name__  # a dataclass would ask for its signature
        return dataclass(eq=False, repr=False)(made)

    return of if made is None else of(made)


def _set_once(self: Any, name: str, value: object) -> None:
    """Set a field for the first time, as ``__init__`` does."""
    held = self.__dict__
    if name in held or name not in self.__dataclass_fields__:
        raise FrozenInstanceError(f"cannot assign to field {name!r}")
    held[name] = value


def _keep(self: Any, name: str) -> NoReturn:
    raise FrozenInstanceError(f"cannot delete field {name!r}")


def _show(self: Any) -> str:
    shown = [f"{each.name}={getattr(self, each.name)!r}" for each in fields(self) if each.repr]
    text = f"{type(self).__qualname__}({', '.join(shown)})"
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 2]}…)"


def _compared(self: Any) -> tuple[object, ...]:
    return tuple([getattr(self, each.name) for each in fields(self) if each.compare])


def _equal(self: Any, other: object) -> bool:
    return _compared(self) == _compared(other) if type(other) is type(self) else NotImplemented


def _hash(self: Any) -> int:
    return hash(_compared(self))


_FROZEN = {"__setattr__": _set_once, "__delattr__": _keep, "__repr__": _show}
_BY_FIELDS = {"__eq__": _equal, "__hash__": _hash}


class Frozen(dict[K, V]):
    """A dictionary, compared by value, that cannot be changed, nor the arrays in it."""

    def __init__(self, content: Mapping[K, V] | Iterable[tuple[K, V]] = ()) -> None:
        super().__init__({key: freeze(value) for key, value in dict(content).items()})

    def __eq__(self, other: object) -> bool:
        return _same(self, other) if isinstance(other, Mapping) else NotImplemented

    def __ne__(self, other: object) -> bool:  # a dictionary has its own, which asks arrays
        return not self == other

    __hash__: ClassVar[None] = None  # as of every dictionary

    def __reduce__(self) -> tuple[type, tuple[dict[K, V]]]:
        return type(self), (dict(self),)  # not entry by entry, which it would refuse

    def _refuse(self, *_: object, **__: object) -> NoReturn:
        raise TypeError("what a result holds cannot be changed; make a copy of it with dict(…).")

    __setitem__: ClassVar[Callable[..., NoReturn]] = _refuse
    __delitem__: ClassVar[Callable[..., NoReturn]] = _refuse
    __ior__: ClassVar[Callable[..., NoReturn]] = _refuse
    clear: ClassVar[Callable[..., NoReturn]] = _refuse
    pop: ClassVar[Callable[..., NoReturn]] = _refuse
    popitem: ClassVar[Callable[..., NoReturn]] = _refuse
    setdefault: ClassVar[Callable[..., NoReturn]] = _refuse
    update: ClassVar[Callable[..., NoReturn]] = _refuse


class Result:
    """The base of all results."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def __post_init__(self) -> None:
        """Make arrays read-only and mappings frozen."""
        for name in self.__dataclass_fields__:
            given = getattr(self, name)
            kept = freeze(given)
            if kept is not given:
                object.__setattr__(self, name, kept)

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        names = [field.name for field in fields(self) if field.compare]
        return all(_same(getattr(self, name), getattr(other, name)) for name in names)

    __hash__: ClassVar[None] = None  # type: ignore[assignment]  # arrays have no hash

    def __str__(self) -> str:
        return str(import_module(_SHOWING).show_text(self))

    def _repr_html_(self) -> str:
        return str(import_module(_SHOWING).show_html(self))

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        for name, value in state.items():
            object.__setattr__(self, name, freeze(value))


class Drawn:
    """A result that has a figure."""

    def plot(self, ax: Any = None) -> Any:
        """Draw the result, and return its matplotlib axes: one, or a list of its panels.

        Parameters
        ----------
        ax : Axes or sequence of Axes, optional
            As many as the figure has panels; those of a new figure where not given.

        Raises
        ------
        UsageError
            The axes are too many or too few.
        """
        return import_module(_SHOWING).draw(self, ax)


class Tabular:
    """A result that is a table."""

    def columns(self) -> Mapping[str, Any]:
        """Return the columns of the table."""
        raise NotImplementedError

    def to_pandas(self) -> Any:
        """Return the columns as a pandas data frame.

        Raises
        ------
        MultiposError
            pandas is not installed.
        """
        return data_frame(self.columns())


class Keyed(Result, Mapping[str, Any]):
    """A result whose fields are read by key as well: ``found["positions"]``, ``dict(found)``."""

    def __getitem__(self, key: str) -> Any:
        if key not in self.__dataclass_fields__:
            raise KeyError(key)
        return getattr(self, key)

    def __iter__(self) -> Iterator[str]:
        return iter(self.__dataclass_fields__)

    def __len__(self) -> int:
        return len(self.__dataclass_fields__)

    def to_dict(self) -> dict[str, Any]:
        """Return everything as what JSON can carry, the fields as keys in their order."""
        return plain_dict(self)


class Columns(Frozen[str, Any]):
    """A table: columns by name, each an attribute as well where its name can be one."""

    def __getattr__(self, name: str) -> Any:
        if name not in self:
            raise AttributeError(f"no column '{name}'; the columns are {', '.join(self)}.")
        return self[name]

    def _repr_html_(self) -> str:
        return str(import_module(_SHOWING).show_html(self))

    def to_dict(self) -> dict[str, Any]:
        """Return ``{"columns": {name: […]}}`` as what JSON can carry."""
        return {"columns": plain(self)}

    def to_pandas(self) -> Any:
        """Return the columns as a pandas data frame.

        Raises
        ------
        MultiposError
            pandas is not installed.
        """
        return data_frame(self)


def stacked(what: str, tables: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return tables of the same columns, one below the other, the name of each in a column."""
    rows = [(name, table, len(next(iter(table.values())))) for name, table in tables.items()]
    columns = list(rows[0][1]) if rows else []
    return {
        what: [name for name, _, count in rows for _ in range(count)],
        **{key: [value for _, table, _ in rows for value in table[key]] for key in columns},
    }


def data_frame(columns: Mapping[str, Any]) -> Any:
    """Return columns as a pandas data frame, which can be changed: it has arrays of its own.

    Raises
    ------
    MultiposError
        pandas is not installed.
    """
    try:
        import pandas as pd
    except ImportError:
        raise MultiposError(
            "`to_pandas` needs pandas, which is not installed; install it, or use `to_dict`."
        ) from None
    return pd.DataFrame(dict(columns))


def plain(value: Any) -> Any:
    """Return nested mappings, sequences and arrays as what JSON can carry."""
    if isinstance(value, np.ndarray | np.generic):
        value, whole = value.tolist(), value.dtype.kind == "f" and bool(np.isfinite(value).all())
        if whole:
            return value
    if isinstance(value, _SINGLE):
        return None if isinstance(value, float) and not math.isfinite(value) else value
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, Mapping):
        return plain_dict(value)
    return value


def plain_dict(value: Mapping[str, Any]) -> dict[str, Any]:
    """Return a mapping as the object that JSON can carry."""
    return {str(key): plain(item) for key, item in value.items()}


_SINGLE = (float, str, int, type(None))  # most of what there is


_AS_THEY_ARE = (str, float, int, type(None), Frozen, Result)  # most of what is kept


def freeze(value: Any) -> Any:
    """Return a value of a result as it is kept: its arrays read-only, its mappings frozen."""
    if isinstance(value, np.ndarray):
        value.setflags(write=False)
    elif isinstance(value, _AS_THEY_ARE):
        return value
    elif isinstance(value, tuple):
        kept = [freeze(part) for part in value]
        if any(map(is_not, kept, value)):
            return type(value)(*kept) if hasattr(value, "_fields") else tuple(kept)
    elif isinstance(value, Mapping):
        return Frozen(value)
    return value


def changed(result: R, **others: Any) -> R:
    """Return a result with other values of some fields; the rest is frozen, and not looked at."""
    made = object.__new__(type(result))
    kept = {name: getattr(result, name) for name in result.__dataclass_fields__}
    made.__dict__.update(kept, **{name: freeze(value) for name, value in others.items()})
    return made


def require(value: object, *kinds: type, reader: str = "multipos.load") -> None:
    """Refuse what is no result of these kinds, such as the path of one; `reader` reads its file.

    Raises
    ------
    TypeError
        It is something else.
    """
    if not isinstance(value, kinds):
        names = " or ".join(kind.__name__ for kind in kinds)
        raise TypeError(
            f"needs a {names}, got {type(value).__name__}; `{reader}` reads one from its file."
        )


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return type(one) is type(other) and _same_arrays(one, other)
    if isinstance(one, Result):
        return bool(one == other)
    if _are(Mapping, one, other):
        return one.keys() == other.keys() and all(_same(one[key], other[key]) for key in one)
    if _are((list, tuple), one, other):
        return len(one) == len(other) and all(map(_same, one, other))
    return _same_values(one, other)


def _are(kinds: type | tuple[type, ...], one: Any, other: Any) -> bool:
    return isinstance(one, kinds) and isinstance(other, kinds)


def _same_arrays(one: Any, other: Any) -> bool:
    return np.array_equal(one, other, equal_nan=one.dtype.kind == other.dtype.kind == "f")


def _same_values(one: Any, other: Any) -> bool:
    """Tell whether two values are equal, or both NaN."""
    return bool(one == other or (one != one and other != other))
