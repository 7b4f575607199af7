"""Deterministic mutations of files."""

from __future__ import annotations

import random
import re
import struct
from collections.abc import Callable, Sequence

Mutation = Callable[[bytearray, random.Random], None]

_INTEGERS = (0, 1, 2, 3, 127, 128, 255, 256, 65535, 10**6, 2**31 - 1, 2**31, 2**32 - 1, 2**60)
_INTEGERS += (2**63 - 1, 2**63, 2**64 - 1)
_FLOATS = (0.0, -1.0, 1e-45, 3e38, 1e308, -1e308, float("inf"), float("-inf"), float("nan"))
_WORDS = (
    *(b"", b"0", b"-1", b"1e308", b"-1e999", b"nan", b"inf", b"9" * 25, b"9" * 5000, b"2147483648"),
    *(b"null", b"true", b"[]", b"{}", b'"x"', b"[[[[", b"\\ud800", b"../../etc/passwd", b"\0"),
    *(b"\xff\xfe", "é".encode(), b" ", b"\n"),
)
_TOKEN = re.compile(rb"[\w.+-]+")


def mutated(seeds: Sequence[bytes], rng: random.Random) -> bytes:
    """One of ``seeds`` after one to four mutations."""
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        rng.choice(_MUTATIONS)(data, rng)
    return bytes(data)


def _flip(data: bytearray, rng: random.Random) -> None:
    if data:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _byte(data: bytearray, rng: random.Random) -> None:
    if data:
        data[rng.randrange(len(data))] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))


def _cut(data: bytearray, rng: random.Random) -> None:
    del data[rng.randrange(len(data) + 1) :]


def _range(data: bytearray, rng: random.Random) -> slice:
    start = rng.randrange(len(data) + 1)
    return slice(start, start + rng.choice((1, 2, 4, 8, 64, 1024)))


def _delete(data: bytearray, rng: random.Random) -> None:
    del data[_range(data, rng)]


def _duplicate(data: bytearray, rng: random.Random) -> None:
    part = _range(data, rng)
    at = rng.randrange(len(data) + 1)
    data[at:at] = data[part] * rng.choice((1, 1, 2, 50))


def _insert(data: bytearray, rng: random.Random) -> None:
    at = rng.randrange(len(data) + 1)
    data[at:at] = rng.randbytes(rng.choice((1, 2, 4, 8, 64)))


def _near_start(data: bytearray, rng: random.Random) -> int:
    """A position; half of them in the first bytes, where headers are."""
    return rng.randrange(min(len(data), rng.choice((64, len(data)))) + 1)


def _integer(data: bytearray, rng: random.Random) -> None:
    at, size = _near_start(data, rng), rng.choice((1, 2, 4, 8))
    value = rng.choice(_INTEGERS) % (1 << 8 * size)
    data[at : at + size] = value.to_bytes(size, rng.choice(("little", "big")))


def _float(data: bytearray, rng: random.Random) -> None:
    at, value = _near_start(data, rng), rng.choice(_FLOATS)
    code = rng.choice(("<d", "<f"))
    if code == "<f" and abs(value) > 3.4e38 and value not in (float("inf"), float("-inf")):
        value = 3e38
    data[at : at + struct.calcsize(code)] = struct.pack(code, value)


def _word(data: bytearray, rng: random.Random) -> None:
    """Replace a word or a number of a text."""
    start = _near_start(data, rng)
    if found := _TOKEN.search(data, start, start + 4096):
        data[found.start() : found.end()] = rng.choice(_WORDS)


_MUTATIONS: tuple[Mutation, ...] = (
    *(_flip, _byte, _cut, _delete, _duplicate, _insert),
    *(_integer, _integer, _float, _word, _word),
)
