"""A faulty driver is noticed."""

from __future__ import annotations

import ctypes
from random import Random
from typing import ClassVar, Self

import pytest

from tests.fuzz.target import Target, Wrong, feed_watched


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
