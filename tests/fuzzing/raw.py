"""Damage that needs no knowledge of a format: encodings, line ends, bytes."""

import gzip
import random
from collections.abc import Callable

Damage = Callable[[random.Random, bytes], bytes]

PIECES = (
    *(b"\0", b"\xff", b"\n", b"\r", b'"', b"\x1a", b"\xe9", b"\xed\xa0\x80", b"\x1b[2J"),
    *(b"\0" * 1000, b"9" * 5000),
)


def _flip_bytes(rng: random.Random, data: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 5, 50))):
        changed[rng.randrange(len(changed))] = rng.randrange(256)
    return bytes(changed)


def _flip_head(rng: random.Random, data: bytes) -> bytes:
    head = min(len(data), rng.choice((16, 128, 512)))
    return _flip_bytes(rng, data[:head]) + data[head:]


def _cut(rng: random.Random, data: bytes) -> bytes:
    return data[: rng.randrange(len(data))]


def _cut_out(rng: random.Random, data: bytes) -> bytes:
    start = rng.randrange(len(data))
    return data[:start] + data[start + rng.choice((1, 2, 10, 1000)) :]


def _insert(rng: random.Random, data: bytes) -> bytes:
    start = rng.randrange(len(data))
    return data[:start] + rng.choice(PIECES) + data[start:]


def _repeat_piece(rng: random.Random, data: bytes) -> bytes:
    start = rng.randrange(len(data))
    piece = data[start : start + rng.choice((1, 10, 200))]
    return data[:start] + piece * rng.choice((2, 10)) + data[start:]


def _nothing(rng: random.Random, _: bytes) -> bytes:
    return rng.choice((b"", b"\n", b" ", b"\xef\xbb\xbf", b"\0", b"#\n", b"x", b"0", b"{}", b"[]"))


_AS_TEXT: tuple[Damage, ...] = (
    lambda _, data: data + data,
    lambda _, data: data.decode("utf-8", "replace").encode("utf-16", "replace"),
    lambda _, data: data.decode("utf-8", "replace").replace("a", "é").encode("latin-1", "replace"),
    lambda _, data: data.replace(b"\n", b"\r\n"),
    lambda _, data: data.replace(b"\n", b"\r"),
    lambda _, data: b"\xef\xbb\xbf" + data,
    lambda _, data: data.rstrip(b"\n"),
    lambda _, data: gzip.compress(data, mtime=0),
)

DAMAGES: tuple[Damage, ...] = (
    *(_flip_bytes, _flip_head, _cut, _cut_out, _insert, _repeat_piece, _nothing),
    *_AS_TEXT,
)

BINARY_DAMAGES: tuple[Damage, ...] = (
    *(_flip_bytes, _flip_head, _flip_head, _flip_head),
    *(_cut, _cut_out, _insert, _repeat_piece),
)


def damage(rng: random.Random, data: bytes, damages: tuple[Damage, ...] = DAMAGES) -> bytes:
    """Return the bytes with one damage; what is empty stays so."""
    return rng.choice(damages)(rng, data) if data else data
