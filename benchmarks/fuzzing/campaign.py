"""Feeds inputs to a target and detects exceptions, endless calls, and growth of memory or open files."""

from __future__ import annotations

import gc
import math
import os
import signal
import time
import traceback
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from random import Random
from types import FrameType
from typing import ClassVar, Self

CPU_LIMIT_S = 5.0
"""Limit of one input in CPU time, so that a loaded computer does not count as an endless call."""
FINDINGS_MAX = 5
"""Number of findings after which a process stops."""
MEMORY_SHARE, MEMORY_BYTES = 0.05, 5 * 2**20
"""Largest growth of the resident set, as share or in bytes, from 10 % of the inputs or of the time to the end."""
_WARM_UP_SHARE = 0.1
_TELL_EVERY = 64


class Wrong(AssertionError):
    """A call returned a wrong result."""


class Endless(BaseException):
    """A call does not return. It is no Exception, because the code under test may catch those."""


class Target(ABC):
    """One wire of the companion. An input is self-contained: fed alone it has the same effect as among a million others."""

    name: ClassVar[str]
    share: ClassVar[float] = 1.0
    """Share of the requested inputs; less than 1 where every input passes a real device driver."""

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


@dataclass(frozen=True, slots=True)
class Finding:
    """An input that made the companion fail."""

    target: str
    seed: int
    index: int | None
    """Index of the input; None if the finding concerns the whole run."""
    text: str
    data: bytes = b""

    def __str__(self) -> str:
        where = "the whole run" if self.index is None else f"--seed {self.seed}, index {self.index}"
        return f"{self.target}, {where}: {self.text}"


@dataclass(frozen=True, slots=True)
class Stretch:
    """Result of one process for a range of inputs."""

    inputs: int
    duration_s: float
    slowest_s: float
    """Wall time of the slowest input."""
    slowest_index: int
    memory_bytes: tuple[int, int]
    """Resident set after 10 % of the inputs, or of the time, and at the end."""
    findings: tuple[Finding, ...]


def generator(target: str, seed: int, index: int) -> Random:
    """Return the random generator of one input."""
    return Random(zlib.crc32(target.encode()) << 96 | (seed & 0xFFFFFFFF) << 64 | index)


def run(
    target: Target,
    seed: int,
    first: int,
    last: int,
    tell: Callable[[int], None] = lambda index: None,
    until_s: float = math.inf,
) -> Stretch:
    """Feed inputs `first` to `last` - 1, or as many as there is time for.

    Args:
        target: entered.
        seed: with the index it makes the input.
        first: index.
        last: index, exclusive.
        tell: called with the index before it is fed, now and then.
        until_s: deadline on the monotonic clock; no input is started after it.
    """
    findings: list[Finding] = []
    start_s = time.monotonic()
    warm_index = first + int(_WARM_UP_SHARE * (last - first))
    warm_s = start_s + _WARM_UP_SHARE * (until_s - start_s)
    warm = False
    memory, files = _resident_bytes(), _open_files()
    slowest_s, slowest_index = 0.0, first
    done = 0
    for index in range(first, last):
        now_s = time.monotonic()
        if now_s >= until_s:
            break
        if not warm and (index == warm_index or now_s >= warm_s):
            warm = True
            memory, files = _resident_bytes(), _open_files()
        if index % _TELL_EVERY == 0:
            tell(index)
        data = target.make(generator(target.name, seed, index))
        done += 1
        begun_s = time.monotonic()
        text = feed_watched(target, data)
        took_s = time.monotonic() - begun_s
        if took_s > slowest_s:
            slowest_s, slowest_index = took_s, index
        if text is not None:
            findings.append(Finding(target=target.name, seed=seed, index=index, text=text, data=data))
            if len(findings) == FINDINGS_MAX:
                break
    end, end_files = _resident_bytes(), _open_files()
    if end - memory > max(MEMORY_SHARE * memory, MEMORY_BYTES):
        text = f"memory grew from {memory / 2**20:.1f} to {end / 2**20:.1f} MiB"
        findings.append(Finding(target.name, seed, None, text))
    if end_files > files:
        findings.append(Finding(target.name, seed, None, f"open files grew from {files} to {end_files}"))
    return Stretch(
        inputs=done,
        duration_s=time.monotonic() - start_s,
        slowest_s=slowest_s,
        slowest_index=slowest_index,
        memory_bytes=(memory, end),
        findings=tuple(findings),
    )


def feed_watched(target: Target, data: bytes, cpu_limit_s: float = CPU_LIMIT_S) -> str | None:
    """Feed one input; return the finding, or None."""
    try:
        with _cpu_limit(cpu_limit_s):
            target.feed(data)
    except Wrong as error:
        return str(error)
    except Endless as error:
        return f"does not return: {error}"
    except Exception as error:  # this is what fuzzing looks for
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


def _resident_bytes() -> int:
    gc.collect()
    with open("/proc/self/statm", encoding="ascii") as statm:
        return int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _open_files() -> int:
    return len(os.listdir("/proc/self/fd"))


def one_line(text: str, what: str) -> None:
    """Check a text that is shown to the user.

    Raises:
        Wrong: it is empty, more than one line, or holds what a terminal would obey.
    """
    if not text or not text.isprintable():
        raise Wrong(f"{what} is no printable line: {text!r:.200}")
