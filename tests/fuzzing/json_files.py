"""Damage to JSON files: calibrations, regressions, checks, sections.

A mutator changes the document in place at one drawn place: a container and a key in it. Most keep
the shape, so that what comes after the loader is reached as well.
"""

import json
import random
from collections.abc import Callable
from typing import Any

from . import hostile, raw

Mutator = Callable[[random.Random, Any, Any], None]

VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 2, 3, 0.5, 1e308, -1e308, 5e-324, 1e-300, 10**30, 2**31, 2**63),
    *(float("nan"), float("inf"), -(2**63), [], [[]], {}, [1], [None], ["x"], {"a": 1}),
    *([[1, 2], [3]], [1e308] * 3, ["ax", "ay"], "1 + x + y + z", "own^9", "linear", "\ud800", "\0"),
    *("x^9223372036854775808", "</script><b>", "*/ evil(); /*", "multipos/calibration/1"),
)
PIECES = (
    *hostile.listed("NaN -Infinity 1e999 - 1.0e 01 'x' True // {}, 1e308 -0.0 [[[["),
    *('"\\u0000"', '"\\ud800"', "[" * 100_000, '{"a":' * 100_000, "9" * 400, "9" * 5000),
    '"' + "a" * 100_000 + '"',
)
PLACES = ("1", "0.0", "null", "[", "{", ":", ",", '"schema"', '"value"')
FACTORS = (0.0, -1.0, 9.80665, 1e-3, 1e6, 1e-46, 1e150, 1e-150, 1e300, 1e-300)


def _places(value: Any, depth: int = 0) -> list[tuple[Any, Any]]:
    """Every container with every key of it; of long lists the first three places and the last."""
    keys: list[Any] = []
    if isinstance(value, dict):
        keys = list(value)
    elif isinstance(value, list):
        keys = sorted({*range(min(len(value), 3)), len(value) - 1} - {-1})
    found = [(value, key) for key in keys]
    for key in keys:
        found += _places(value[key], depth + 1)
    return found


def _scaled(value: Any, factor: float) -> Any:
    """Every number in a value times the factor."""
    if isinstance(value, list):
        return [_scaled(item, factor) for item in value]
    if isinstance(value, dict):
        return {key: _scaled(item, factor) for key, item in value.items()}
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            return value * factor
        except OverflowError:
            return value
    return value


def _replace(rng: random.Random, holder: Any, key: Any) -> None:
    holder[key] = json.loads(json.dumps(rng.choice(VALUES)))


def _replace_by_number(rng: random.Random, holder: Any, key: Any) -> None:
    if isinstance(holder[key], int) and rng.random() < 0.7:
        holder[key] = rng.choice((-1, 0, 1, 2, 3, 7, 50, 99, 150, 1000, 10**6, 2**31, 2**63))
        return
    try:
        holder[key] = float(hostile.number(rng))
    except ValueError:
        holder[key] = rng.choice((0.0, 1e308, -1.0))


def _replace_by_text(rng: random.Random, holder: Any, key: Any) -> None:
    holder[key] = hostile.text_with_controls(rng)


def _extend_text(rng: random.Random, holder: Any, key: Any) -> None:
    value = holder[key]
    if isinstance(value, str):
        added = hostile.text_with_controls(rng)
        holder[key] = rng.choice((value + added, added + value, value[::-1], value.upper()))
    else:
        _replace(rng, holder, key)


def _scale(rng: random.Random, holder: Any, key: Any) -> None:
    holder[key] = _scaled(holder[key], rng.choice(FACTORS))


def _delete(_: random.Random, holder: Any, key: Any) -> None:
    del holder[key]


def _add_key(rng: random.Random, holder: Any, key: Any) -> None:
    if isinstance(holder, dict):
        holder[hostile.text_with_controls(rng)] = holder[key]
    else:
        holder.insert(key, json.loads(json.dumps(rng.choice(VALUES))))


def _rename_key(rng: random.Random, holder: Any, key: Any) -> None:
    if isinstance(holder, dict):
        value = holder.pop(key)
        holder[rng.choice((key.upper(), f"{key} ", hostile.text_with_controls(rng)))] = value
    else:
        holder.reverse()


def _swap(rng: random.Random, holder: Any, key: Any) -> None:
    other = rng.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
    holder[key], holder[other] = holder[other], holder[key]


def _wrap(_: random.Random, holder: Any, key: Any) -> None:
    holder[key] = [holder[key]]


def _unwrap(rng: random.Random, holder: Any, key: Any) -> None:
    value = holder[key]
    if isinstance(value, list | dict) and value:
        holder[key] = next(iter(value.values())) if isinstance(value, dict) else value[0]
    else:
        _replace(rng, holder, key)


def _shorten(rng: random.Random, holder: Any, key: Any) -> None:
    value = holder[key]
    if isinstance(value, list | str) and value:
        holder[key] = value[: rng.randrange(len(value))]
    else:
        _delete(rng, holder, key)


def _lengthen(rng: random.Random, holder: Any, key: Any) -> None:
    value = holder[key]
    if isinstance(value, list) and value:
        holder[key] = value + value[-1:] * rng.choice((1, 1, 3, 1000))
    else:
        _wrap(rng, holder, key)


def _shuffle(rng: random.Random, holder: Any, key: Any) -> None:
    value = holder[key]
    if isinstance(value, list) and len(value) > 1:
        rng.shuffle(value)
    else:
        _replace_by_number(rng, holder, key)


def _as_text(_: random.Random, holder: Any, key: Any) -> None:
    holder[key] = str(holder[key])


def _nest(rng: random.Random, holder: Any, key: Any) -> None:
    value = holder[key]
    for _ in range(rng.choice((2, 50))):
        value = rng.choice(([value], {"x": value}))
    holder[key] = value


# How often each is drawn.
MUTATORS: dict[Mutator, int] = {
    _replace: 2,
    _replace_by_number: 2,
    _replace_by_text: 1,
    _extend_text: 2,
    _scale: 3,
    _delete: 2,
    _add_key: 1,
    _rename_key: 1,
    _swap: 2,
    _wrap: 1,
    _unwrap: 1,
    _shorten: 1,
    _lengthen: 1,
    _shuffle: 1,
    _as_text: 1,
    _nest: 1,
}


def _in_text(rng: random.Random, text: str) -> str:
    """Put into the text what no document would be written as."""
    new, old = rng.choice(PIECES), rng.choice(PLACES)
    pieces = text.split(old)
    at = rng.randrange(1, len(pieces)) if len(pieces) > 1 else 1
    return old.join(pieces[:at]) + new + old.join(pieces[at:])


def mutate(rng: random.Random, data: bytes) -> bytes:
    """Return a JSON document with one to three places changed, now and then damaged as text."""
    document = json.loads(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        places = _places(document)
        if rng.random() < 0.4:  # the keys that every reader of the file asks for
            places = [(holder, key) for holder, key in places if holder is document] or places
        if places:
            mutator = rng.choices(list(MUTATORS), MUTATORS.values())[0]
            mutator(rng, *rng.choice(places))
    text = json.dumps(document)
    if rng.random() < 0.07:
        text = _in_text(rng, text)
    changed = text.encode()
    return raw.damage(rng, changed) if rng.random() < 0.07 else changed
