"""The file of a result, as the fields of its frozen dataclass declare it, once.

- `schema_of` makes the `Schema` of a class of its annotations: it checks, reads and writes;
  `renamed` that of some fields under other keys, `narrowed` one of other kinds, and `also` says
  what stands beside the fields.
- `Saved` gives a result with a file `to_dict` and `save`; `read_saved` and `restore` read it again.

A field is a key, of the kind that its type says: a number, a text, a tuple as a list, a mapping as
an object, another result, or None as null. What does not follow from name and type stands in the
annotation, a narrower `Kind` or how the field is `Stored`:

    u: Annotated[float, NOT_NEGATIVE]
    source: Annotated[str | None, Stored("input.file")]
    sd: Annotated[Array, NOT_NEGATIVE, Stored(by="outputs")]

What the file has beside the fields stands in the tuple ``_also`` of the class, each attribute or
path of attributes with the key that it comes after: what follows from the fields is written and not
read; with a kind it is read as well, under its path.

    _also = (
        also("verdict", Stored(after="limit")),
        also("model.unit", ANY_TEXT, Stored("unit", after="model")),
    )

A class that is put together of what is read otherwise than by its fields has a class method
``_from_file`` that takes it by name, what is below an attribute as one mapping; a class whose files
were once other has a function `_upgraded` of the content. Either may raise ValueError where parts
contradict each other.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import StrEnum
from functools import cache
from operator import attrgetter
from types import NoneType
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, TypeVar, get_args, get_origin

import numpy as np

from multipos.files import records
from multipos.files.records import (
    ANY_NUMBER,
    ANY_TEXT,
    Entries,
    Fields,
    Flag,
    Kind,
    Listed,
    Maybe,
    Named,
    Numbers,
    Text,
    Whole,
)
from multipos.files.spelling import StrPath
from multipos.files.trees import read_json, to_json
from multipos.files.whole import write_text
from multipos.numerics.arrays import Array, Mask
from multipos.results import Result, frozen, plain_dict

S = TypeVar("S", bound="Saved")
_KINDS: dict[Any, Kind] = {
    str: ANY_TEXT,
    bool: Flag(),
    int: Whole(),
    float: ANY_NUMBER,
    Array: Numbers(),
    Any: Kind(),
}
_ARRAYS = (Array, Array | None, Mask)


@frozen(eq=True)
class Stored:
    """How a field stands in a file, where that does not follow from its name and its type.

    Attributes
    ----------
    key : str
        Where it is called otherwise; 'input.file' is the key 'file' of the object 'input', which is
        null where all that it has is `optional` and None.
    optional : bool
        It is not in the file where it is None, and need not be there: then it is as by default.
    nowhere : bool
        It is not in the file.
    flat : bool
        A result whose keys stand among the others; none of them where it is None.
    by : str
        An array of the file as an object whose keys are the names in this field.
    rows : str
        A column of this table, a list of objects.
    after : str
        What is no field: the key of the field that it comes after.
    """

    key: str = ""
    optional: bool = False
    nowhere: bool = False
    flat: bool = False
    by: str = ""
    rows: str = ""
    after: str = ""


OPTIONAL = Stored(optional=True)
NOWHERE = Stored(nowhere=True)


@frozen(eq=True)
class _Unread(Kind):
    """What follows from the rest: it is written, and not read."""


UNREAD = _Unread()


@frozen(eq=True)
class As(Kind):
    """A kind whose values a result holds as something else: what `of` makes, and `back`."""

    kind: Kind
    of: Callable[[Any], Any]
    back: Callable[[Any], Any] = lambda value: value

    def check(self, value: Any, place: str) -> None:
        """Raise a fault where the value is something else."""
        self.kind.check(value, place)

    def read(self, value: Any) -> Any:
        """Return what a result holds."""
        return self.of(self.kind.read(value))

    def write(self, value: Any) -> Any:
        """Return the value of a file."""
        return self.kind.write(self.back(value))


class _Part(NamedTuple):
    """One field, or one attribute beside the fields, by its path."""

    name: str
    key: str
    said: Any
    kind: Kind
    stored: Stored

    @property
    def derived(self) -> bool:
        """Whether it is written for who reads the file, and not read."""
        return self.kind == UNREAD

    def kinds(self) -> Fields:
        if self.derived:
            return Fields({})
        if self.stored.flat:
            inner = _schema_within(self.kind).fields
            if isinstance(self.kind, Maybe):
                return Fields({}, {**inner.needed, **inner.optional})
            return inner
        kind = Named(self.kind) if self.stored.by else self.kind
        return Fields({}, {self.key: kind}) if self.stored.optional else Fields({self.key: kind})

    def write(self, owner: Any) -> dict[str, Any]:
        value = attrgetter(self.name)(owner)
        empty = isinstance(value, dict) and not value
        if (value is None or empty) and (self.stored.optional or self.stored.flat):
            return {}
        written = self._cell(value, owner)
        return written if self.stored.flat else {self.key: written}

    def read(self, content: Mapping[str, Any]) -> dict[str, Any]:
        if self.derived:
            return {}
        if self.stored.flat:
            return {self.name: self._flat(_schema_within(self.kind), content)}
        if self.key not in content:
            return {}
        return {self.name: self._held(content[self.key], content)}

    def _flat(self, schema: "Schema", content: Mapping[str, Any]) -> Any:
        there = [key for key in schema.keys if key in content]
        lacking = [key for key in schema.fields.needed if key not in content]
        if not there and isinstance(self.kind, Maybe):
            return None
        if lacking:
            raise ValueError(f"an object with '{there[0]}' lacks '{lacking[0]}'")
        return schema.read(content)

    def cells(self, owner: Any) -> Sequence[Any] | None:
        """Return the cells of a column, for each row of its table; None without the column."""
        value = attrgetter(self.name)(owner)
        return None if value is None else [self._cell(each, owner) for each in value]

    def column(self, rows: Sequence[Mapping[str, Any]], content: Mapping[str, Any]) -> Any:
        """Return the column of these rows, None where one of them lacks it."""
        if not all(self.key in row for row in rows):
            return None
        held = [self._held(row[self.key], content) for row in rows]
        return np.array(held) if self.said in _ARRAYS else tuple(held)

    def _cell(self, value: Any, owner: Any) -> Any:
        """Return what the file has of a value: of an array by names an object."""
        if not self.stored.by:
            return self.kind.write(value)
        names = getattr(owner, self.stored.by)
        return dict(zip(names, map(self.kind.write, value), strict=True))

    def _held(self, value: Any, content: Mapping[str, Any]) -> Any:
        """Return the value of what the file has."""
        if not self.stored.by:
            return self.kind.read(value)
        names = content[self.stored.by]
        if set(value) != set(names):
            raise ValueError(f"'{self.key}' is of {', '.join(value)}, not of its {self.stored.by}")
        return np.array([self.kind.read(value[name]) for name in names])


class _Rows(NamedTuple):
    """The fields that are columns of one table."""

    key: str
    parts: tuple[_Part, ...]

    def kinds(self) -> Fields:
        return Fields({self.key: Listed(_fields_of(self.parts), 1)})

    def write(self, owner: Any) -> dict[str, Any]:
        columns = {part.key: part.cells(owner) for part in self.parts}
        there = {key: cells for key, cells in columns.items() if cells is not None}
        rows = zip(*there.values(), strict=True)
        return {self.key: [dict(zip(there, row, strict=True)) for row in rows]}

    def read(self, content: Mapping[str, Any]) -> dict[str, Any]:
        rows = content[self.key]
        read = [part for part in self.parts if not part.derived]
        return {part.name: part.column(rows, content) for part in read}


class _Inside(NamedTuple):
    """The fields that are the keys of an object within the file."""

    key: str
    parts: tuple[_Part, ...]

    def kinds(self) -> Fields:
        inner: Kind = Fields({part.key: part.kind for part in self.parts})
        return Fields({self.key: Maybe(inner) if self._may_be_null() else inner})

    def write(self, owner: Any) -> dict[str, Any]:
        inner = _written(self.parts, owner)
        return {self.key: None if self._may_be_null() and not inner else inner}

    def read(self, content: Mapping[str, Any]) -> dict[str, Any]:
        inner = content[self.key]
        nothing = dict.fromkeys((part.name for part in self.parts), None)
        return nothing if inner is None else _read(self.parts, inner)

    def _may_be_null(self) -> bool:
        return all(part.stored.optional for part in self.parts)


_Place = _Part | _Rows | _Inside


@frozen(eq=True)
class Schema(Kind):
    """How a class stands in a file."""

    made: Any
    parts: tuple[_Place, ...]
    fields: Fields

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys that are read."""
        return (*self.fields.needed, *self.fields.optional)

    def check(self, value: Any, place: str) -> None:
        """Raise a fault where the value is something else."""
        self.fields.check(self._upgraded(value), place)

    def read(self, value: Any) -> Any:
        """Return the result.

        Raises
        ------
        ValueError
            Its parts contradict each other.
        """
        make = getattr(self.made, "_from_file", self.made)
        return make(**self.values(value))

    def values(self, value: Any) -> dict[str, Any]:
        """Return the values of the fields that the file has, those below one as a mapping."""
        values: dict[str, Any] = {}
        for path, held in _read(self.parts, self._upgraded(value)).items():
            name, _, below = path.partition(".")
            if below:
                values.setdefault(name, {})[below] = held
            else:
                values[name] = held
        return values

    def write(self, value: Any) -> dict[str, Any]:
        """Return an object, up to arrays and NaN."""
        return _written(self.parts, value)

    def _upgraded(self, value: Any) -> Any:
        upgraded = getattr(self.made, "_upgraded", None)
        return value if upgraded is None or not isinstance(value, Mapping) else upgraded(value)


class Saved(Result):
    """A result that has a file of its own.

    Attributes
    ----------
    schema : str
        What the file says that it is.
    called : str
        What a message calls it.
    again : str
        What writes the file again, as in 'fit again'.
    """

    _also: ClassVar[tuple[Any, ...]] = ()
    schema: ClassVar[str]
    called: ClassVar[str]
    again: ClassVar[str]

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON carries it, keys as in docs/reference/formats.md."""
        return plain_dict({"schema": self.schema, **schema_of(type(self)).write(self)})

    def save(self, path: StrPath) -> None:
        """Write the result as JSON, whole or not at all."""
        write_text(path, to_json(self.to_dict()))


def read_saved(made: type[S], path: StrPath) -> S:
    """Read a result from the file that its `save` wrote.

    Raises
    ------
    MultiposError
        The file is missing, truncated, of another schema, or holds what no such result does.
    """
    return restore(made, read_json(path, made.schema), str(path))


def restore(made: type[S], content: Any, where: str) -> S:
    """Return the result that its `to_dict` described.

    Parameters
    ----------
    made : subclass of Saved
    content : object
        As JSON gave it.
    where : str
        The file, for the message.

    Raises
    ------
    MultiposError
        Something is missing or of another kind, or the parts contradict each other.
    """
    schema = schema_of(made)
    result: S = records.restore(
        content, schema, schema.read, where, what=made.called, again=made.again
    )
    return result


def schema_of(made: Any) -> Schema:
    """Return the schema of a frozen dataclass or a named tuple."""
    return _schema_of(made)


@cache
def _schema_of(made: Any) -> Schema:
    fields = {
        n: said for n, said in made.__annotations__.items() if get_origin(said) is not ClassVar
    }
    parts = [_part(name, *_marked(said)) for name, said in fields.items()]
    for part in getattr(made, "_also", ()):
        heads = [each.stored.after or each.key.partition(".")[0] for each in parts]
        place = len(heads) - heads[::-1].index(part.stored.after)
        parts.insert(place, part)
    places = _gathered([part for part in parts if not part.stored.nowhere])
    return Schema(made, places, _fields_of(places))


def also(path: str, *marks: Kind | Stored) -> _Part:
    """Return what a file has of an attribute that is no field: its kind, and how it is `Stored`."""
    return _part(path, Any, marks)


def narrowed(made: Any, **kinds: Kind) -> Schema:
    """Return the schema of a class that knows no files, some of its fields of narrower kinds."""
    said = made.__annotations__
    parts = tuple(_part(n, t, [kinds[n]] if n in kinds else []) for n, t in said.items())
    return Schema(made, parts, _fields_of(parts))


def renamed(made: Any, **keys: str) -> Schema:
    """Return the schema of some fields of a class under other keys.

    Parameters
    ----------
    made : type, or partial of one that has the other fields
    keys : of each field
    """
    parts = schema_of(getattr(made, "func", made)).parts
    kept = tuple(
        part._replace(key=keys[part.name])
        for part in parts
        if isinstance(part, _Part) and part.name in keys
    )
    return Schema(made, kept, _fields_of(kept))


def _marked(said: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return the type of a field and what its annotation adds."""
    return (said.__origin__, said.__metadata__) if get_origin(said) is Annotated else (said, ())


def _part(name: str, bare: Any, marks: Iterable[Any]) -> _Part:
    stored = next((mark for mark in marks if isinstance(mark, Stored)), Stored())
    kind = next((mark for mark in marks if isinstance(mark, Kind)), None)
    if kind is None:
        cell = get_args(bare)[0] if stored.rows and get_origin(bare) is tuple else bare
        unread = stored.nowhere or stored.after
        kind = UNREAD if unread else _kind_of(cell, stored.optional)
    return _Part(name, stored.key or name, bare, kind, stored)


def _gathered(parts: Sequence[_Part]) -> tuple[_Place, ...]:
    """Return parts with the columns of a table, and the keys of an object within, as one."""
    places: dict[str, list[_Part]] = {}
    for part in parts:
        head, _, rest = part.key.partition(".")
        places.setdefault(part.stored.rows or head, []).append(part._replace(key=rest or head))
    return tuple(_place(key, each) for key, each in places.items())


def _place(key: str, parts: Sequence[_Part]) -> _Place:
    if parts[0].stored.rows:
        return _Rows(key, tuple(parts))
    alone = len(parts) == 1 and parts[0].key == key
    return parts[0] if alone else _Inside(key, tuple(parts))


def _fields_of(parts: Iterable[_Place]) -> Fields:
    each = [part.kinds() for part in parts]
    needed = {key: kind for fields in each for key, kind in fields.needed.items()}
    optional = {key: kind for fields in each for key, kind in fields.optional.items()}
    return Fields(needed, optional)


def _written(parts: Iterable[_Place], owner: Any) -> dict[str, Any]:
    content: dict[str, Any] = {}
    for part in parts:
        content |= part.write(owner)
    return content


def _read(parts: Iterable[_Place], content: Mapping[str, Any]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for part in parts:
        values |= part.read(content)
    return values


def _schema_within(kind: Kind) -> Schema:
    inner = kind.kind if isinstance(kind, Maybe) else kind
    assert isinstance(inner, Schema)
    return inner


def _kind_of(said: Any, optional: bool = False) -> Kind:
    """Return the kind of a type; what is `optional` is missing, and not null, where it is None."""
    origin, inner = get_origin(said), get_args(said)
    if said in _KINDS:
        return _KINDS[said]
    if origin is Annotated:
        return _part("", *_marked(said)).kind
    if origin is Literal:
        return Text(inner)
    if NoneType in inner:
        kind = _kind_of(inner[0])
        return kind if optional else Maybe(kind)
    if origin is tuple:
        return _of_tuple(inner)
    if origin is not None:  # a mapping
        return Named(_kind_of(inner[-1]))
    if issubclass(said, StrEnum):
        return As(Text(tuple(said)), said)
    return schema_of(said)


def _of_tuple(inner: tuple[Any, ...]) -> Kind:
    if inner[-1] is Ellipsis:
        return Listed(_kind_of(inner[0]))
    return As(Entries(tuple(map(_kind_of, inner))), tuple)
