"""A faulty driver is noticed, and damage is damage."""

from __future__ import annotations

import ctypes
from random import Random
from typing import ClassVar, Self

import pytest

from tests.fuzz.mutate import mutated
from tests.fuzz.target import Target, Wrong, feed_watched, one_line


class Broken(Target):
    """A target that fails as its input says."""

    name: ClassVar[str] = "broken"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def make(self, rng: Random) -> bytes:
        raise NotImplementedError

    def feed(self, data: bytes) -> None:
        if data == b"raise":
            raise KeyError("armed")
        if data == b"wrong":
            raise Wrong("not understood")
        while data == b"hang":
            try:
                ctypes.c_int(1)
            except Exception:  # as a bus thread that outlives everything does
                continue


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"raise", "KeyError: 'armed'"),
        (b"wrong", "not understood"),
        (b"hang", "does not return: busy for 0.2 s"),
        (b"", None),
    ],
    ids=["exception", "wrong", "endless", "good"],
)
def test_a_failure_is_found(data: bytes, text: str | None) -> None:
    found = feed_watched(Broken(), data, cpu_limit_s=0.2)
    assert found is None if text is None else found is not None and found.startswith(text)


def test_damage_keeps_to_its_size_and_is_damage() -> None:
    valid = [b"0123456789" * 5, b"abc" * 20]
    damaged = [mutated(Random(seed), valid, 80) for seed in range(500)]
    assert max(map(len, damaged[20:])) <= 400
    assert sum(data in valid for data in damaged) < 100


@pytest.mark.parametrize("text", ["", "two\nlines", "\x1b[2Jcleared", "half \ud800"])
def test_a_text_that_is_no_line_is_wrong(text: str) -> None:
    with pytest.raises(Wrong):
        one_line(text, "this")
