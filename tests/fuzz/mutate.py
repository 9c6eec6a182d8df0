"""Damage to bytes, drawn from a seeded generator: the same generator state gives the same damage on every machine."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from random import Random

Step = Callable[[Random, bytearray, Sequence[bytes]], None]

_COUNTS = (0, 1, 2, 3, 0x7F, 0x80, 0xFF, 0x100, 0x7FFF, 0x8000, 0xFFFF, 0x10000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
_FLOATS = (
    float("nan"), float("inf"), float("-inf"), 0.0, -0.0, 1.0, -1.0, 1e-45, 3.4e38, -3.4e38, 1e-30, 1e19,
)  # fmt: skip
_INTEGER_FORMATS = ("<B", "<H", ">H", "<I", ">I", "<Q")
_RANDOM_BYTES_MAX = 400


def mutated(rng: Random, corpus: Sequence[bytes], size_max: int) -> bytes:
    """Return a message of the corpus, damaged by one to four steps; every twentieth is random bytes, every fiftieth is undamaged.

    Args:
        rng: draws everything.
        corpus: valid messages.
        size_max: of the result, bytes.
    """
    kind = rng.random()
    if kind < 0.05:
        return rng.randbytes(rng.randrange(_RANDOM_BYTES_MAX))
    data = bytearray(rng.choice(corpus))
    if kind > 0.98:
        return bytes(data)
    for _ in range(rng.randint(1, 4)):
        rng.choice(_STEPS)(rng, data, corpus)
    return bytes(data[:size_max])


def _flip_bits(rng: Random, data: bytearray, corpus: Sequence[bytes]) -> None:
    if data:
        for _ in range(rng.choice((1, 1, 2, 8))):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _set_byte(rng: Random, data: bytearray, corpus: Sequence[bytes]) -> None:
    if data:
        data[rng.randrange(len(data))] = rng.choice((0, 0xFF, rng.randrange(256)))


def _truncate(rng: Random, data: bytearray, corpus: Sequence[bytes]) -> None:
    del data[rng.randint(0, len(data)) :]


def _extend(rng: Random, data: bytearray, corpus: Sequence[bytes]) -> None:
    data += rng.choice((rng.randbytes(rng.randrange(64)), bytes(rng.randrange(64)), b"\xff" * rng.randrange(64)))


def _insert(rng: Random, data: bytearray, corpus: Sequence[bytes]) -> None:
    at = rng.randint(0, len(data))
    data[at:at] = rng.randbytes(rng.randint(1, 8))


def _delete(rng: Random, data: bytearray, corpus: Sequence[bytes]) -> None:
    start = rng.randint(0, len(data))
    del data[start : start + rng.choice((1, 2, 4, rng.randint(1, 64)))]


def _set_count(rng: Random, data: bytearray, corpus: Sequence[bytes]) -> None:
    form = rng.choice(_INTEGER_FORMATS)
    size = struct.calcsize(form)
    if len(data) >= size:
        value = rng.choice((*_COUNTS, len(data), rng.randrange(1 << 32)))
        struct.pack_into(form, data, rng.randint(0, len(data) - size), value & ((1 << 8 * size) - 1))


def _set_float(rng: Random, data: bytearray, corpus: Sequence[bytes]) -> None:
    form = rng.choice(("<f", "<d"))
    if len(data) >= struct.calcsize(form):
        struct.pack_into(form, data, rng.randint(0, len(data) - struct.calcsize(form)), rng.choice(_FLOATS))


def _splice(rng: Random, data: bytearray, corpus: Sequence[bytes]) -> None:
    other = rng.choice(corpus)
    data[rng.randint(0, len(data)) :] = other[rng.randint(0, len(other)) :]


def _duplicate(rng: Random, data: bytearray, corpus: Sequence[bytes]) -> None:
    start = rng.randint(0, len(data))
    piece = data[start : start + rng.randint(1, 200)]
    at = rng.randint(0, len(data))
    data[at:at] = piece * rng.choice((1, 1, 1, 7))


def _append_message(rng: Random, data: bytearray, corpus: Sequence[bytes]) -> None:
    data += rng.choice(corpus)


_STEPS: tuple[Step, ...] = (
    _flip_bits, _flip_bits, _set_byte, _truncate, _extend, _insert, _delete, _set_count, _set_count, _set_float, _splice,
    _duplicate, _append_message,
)  # fmt: skip
