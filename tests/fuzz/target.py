"""What is fed with damaged input: a wire of the companion, and how a failure is noticed."""

from __future__ import annotations

import os
import signal
import traceback
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from random import Random
from types import FrameType
from typing import ClassVar, Self

CPU_LIMIT_S = 5.0
"""Limit of one input in CPU time, so that a loaded computer does not count as an endless call."""


class Wrong(AssertionError):
    """A call returned a wrong result."""


class Endless(BaseException):
    """A call does not return. It is no Exception, because the code under test may catch those."""


class Target(ABC):
    """One wire of the companion. An input is self-contained: fed alone it has the same effect as among others."""

    name: ClassVar[str]
    inputs: ClassVar[int] = 40
    """Number of inputs per example; fewer where every input takes long."""

    @abstractmethod
    def make(self, rng: Random) -> bytes:
        """Return the next input."""

    @abstractmethod
    def feed(self, data: bytes) -> None:
        """Let the companion read the input, then valid data. Every exception is a finding."""

    @abstractmethod
    def __enter__(self) -> Self: ...

    @abstractmethod
    def __exit__(self, *_: object) -> None: ...


def feed_watched(target: Target, data: bytes, cpu_limit_s: float = CPU_LIMIT_S) -> str | None:
    """Feed one input; return the finding, or None."""
    try:
        with _cpu_limit(cpu_limit_s):
            target.feed(data)
    except Wrong as error:
        return str(error)
    except Endless as error:
        return f"does not return: {error}"
    except Exception as error:  # this is what is looked for
        place = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {error} ({os.path.basename(place.filename)}:{place.lineno})"
    return None


@contextmanager
def _cpu_limit(limit_s: float) -> Iterator[None]:
    def expired(number: int, frame: FrameType | None) -> None:
        place = "?" if frame is None else f"{os.path.basename(frame.f_code.co_filename)}:{frame.f_lineno}"
        raise Endless(f"busy for {limit_s:g} s of CPU time, at {place}")

    before = signal.signal(signal.SIGPROF, expired)
    signal.setitimer(signal.ITIMER_PROF, limit_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def one_line(text: str, what: str) -> None:
    """Check a text that is shown to the user.

    Raises:
        Wrong: it is empty, more than one line, or holds what a terminal would obey.
    """
    if not text or not text.isprintable():
        raise Wrong(f"{what} is no printable line: {text!r:.200}")
