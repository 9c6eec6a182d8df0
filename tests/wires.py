"""Wires of tests: serial lines, ports under fixed names, and bridges between a stream of bytes and UDP."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import threading
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

from tests.support import DEADLINE_S


@contextlib.contextmanager
def serial_line() -> Iterator[tuple[int, str]]:
    """A serial line: its far end, which only the test answers, and the name of the port at the near one."""
    far, near = os.openpty()
    try:
        tty.setraw(near)
        yield far, os.ttyname(near)
    finally:
        os.close(near)
        os.close(far)


@contextlib.contextmanager
def plugged(name: Path, port: str) -> Iterator[str]:
    """A port under a fixed name, as in /dev/serial/by-id, until it is unplugged; the name."""
    name.symlink_to(port)
    try:
        yield str(name)
    finally:
        name.unlink()


@contextlib.contextmanager
def bridged(
    udp: socket.socket, px4: tuple[str, int], open_stream: Callable[[], int], piece_bytes: int = 4096
) -> Iterator[None]:
    """Pass bytes between a stream, given by its descriptor, and PX4's UDP address; to the stream in pieces."""
    ended = threading.Event()

    def run() -> None:
        stream = open_stream()
        os.set_blocking(stream, False)
        while not ended.is_set():
            ready = select.select([stream, udp.fileno()], [], [], 0.01)[0]
            with contextlib.suppress(OSError):  # the companion has closed its end, or does not read
                if stream in ready:
                    udp.sendto(os.read(stream, 4096), px4)
                if udp.fileno() in ready:
                    data = udp.recv(4096)
                    for at in range(0, len(data), piece_bytes):
                        os.write(stream, data[at : at + piece_bytes])

    thread = threading.Thread(target=run, name="bridge")
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(DEADLINE_S)
