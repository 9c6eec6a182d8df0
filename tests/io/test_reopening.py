"""A lost device is opened again in a thread, whose waits block nothing else."""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Callable

import pytest

from companion.io.reopening import Reopening
from tests.support import DEADLINE_S, wait_until


class Port:
    """A port that opens once `there` is set; the third attempt waits for that, as a driver of a USB port may."""

    def __init__(self) -> None:
        self.there = threading.Event()
        self.attempts = 0
        self.closed = False

    def open(self) -> Port:
        self.attempts += 1
        if self.attempts < 3:
            raise OSError(errno.ENOENT, os.strerror(errno.ENOENT))
        assert self.there.wait(DEADLINE_S)
        return self

    def close(self) -> None:
        self.closed = True


def waiting(port: Port) -> Reopening[Port]:
    reopening = Reopening("port", port.open)
    wait_until(lambda: port.attempts == 3, lambda: "no third attempt")
    assert reopening.take() is None
    return reopening


def test_it_is_attempted_until_it_opens_and_handed_over_once() -> None:
    port = Port()
    reopening = waiting(port)
    port.there.set()
    found: list[Port | None] = []
    wait_until(taken(reopening, found), lambda: "not open")
    assert found[-1] is port and reopening.take() is None
    reopening.close()
    assert not port.closed, "the caller that took it closes it"


def test_a_device_that_opens_after_the_end_is_closed() -> None:
    port = Port()
    reopening = waiting(port)
    reopening.close()
    port.there.set()
    wait_until(lambda: port.closed, lambda: "left open")
    assert reopening.take() is None


def test_it_is_attempted_once_the_process_can_start_a_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """The control tick starts the thread when a device is lost, and must not end."""

    def no_thread(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    port = Port()
    port.there.set()
    with monkeypatch.context() as limited:
        limited.setattr(threading.Thread, "start", no_thread)
        reopening = Reopening("port", port.open)
        assert reopening.take() is None
    found: list[Port | None] = []
    wait_until(taken(reopening, found), lambda: "not open")
    assert found[-1] is port


def taken(reopening: Reopening[Port], found: list[Port | None]) -> Callable[[], bool]:
    def take() -> bool:
        found.append(reopening.take())
        return found[-1] is not None

    return take
