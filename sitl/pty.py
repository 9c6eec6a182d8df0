"""The device's end of a pseudo-terminal that the companion opens as a serial port."""

from __future__ import annotations

import asyncio
import fcntl
import os
import select
import struct
import termios
import time
import tty
from collections.abc import Callable
from typing import Final

_INT: Final = struct.Struct("i")
_ARRIVAL_TIMEOUT_S: Final = 1.0
_ARRIVAL_LOOK_S: Final = 0.0005
_UNREAD_BYTES: Final = 1024
"""Number of waiting bytes from which nobody reads the line."""


class PtyLine:
    """One serial line, served by the running event loop between `open` and `close`.

    Args:
        on_bytes: called with the bytes that the companion wrote.
    """

    def __init__(self, on_bytes: Callable[[bytes], None]) -> None:
        self.is_counted = False
        """Whether `await_arrival` is called before the companion reads, in a world in lockstep."""
        self._expected_bytes = 0
        """Number of bytes that the companion can read once all have arrived."""
        self.path = ""
        """Device that the companion opens; valid while the line is open."""
        self._on_bytes = on_bytes
        self._device_fd = -1
        self._companion_fd = -1
        """The companion's end, kept open so that the line does not hang up when the companion closes the port."""

    def open(self) -> None:
        """Create the pseudo-terminal in raw mode and start listening.

        Raises:
            OSError: the kernel has no pseudo-terminal left.
        """
        self._device_fd, self._companion_fd = os.openpty()
        try:
            tty.setraw(self._companion_fd)
            os.set_blocking(self._device_fd, False)
            self.path = os.ttyname(self._companion_fd)
            asyncio.get_running_loop().add_reader(self._device_fd, self.on_readable)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close both ends. If the companion still has the port open, it sees a hang-up."""
        if self._device_fd < 0:
            return
        asyncio.get_running_loop().remove_reader(self._device_fd)
        os.close(self._device_fd)
        os.close(self._companion_fd)
        self._device_fd = self._companion_fd = -1

    def write(self, data: bytes) -> int:
        """Send bytes to the companion without blocking; nothing is sent on a closed line.

        Returns:
            The number of bytes dropped because the companion does not read the line.
        """
        if self._device_fd < 0:
            return 0
        waiting = max(self._expected_bytes, self._waiting()) if self.is_counted else 0
        try:
            written = os.write(self._device_fd, data)
        except BlockingIOError:
            return len(data)
        # A line that nobody reads is full at some point.
        self._expected_bytes = waiting + written if self.is_counted and waiting < _UNREAD_BYTES else 0
        return len(data) - written

    def _waiting(self) -> int:
        return int(_INT.unpack(fcntl.ioctl(self._companion_fd, termios.FIONREAD, _INT.pack(0)))[0])

    def await_arrival(self) -> None:
        """Wait until a thread of the kernel has carried what was written to the companion's end."""
        if not self._expected_bytes:
            return
        deadline_s = time.monotonic() + _ARRIVAL_TIMEOUT_S
        while self._waiting() < self._expected_bytes and time.monotonic() < deadline_s:
            select.select((self._companion_fd,), (), (), _ARRIVAL_LOOK_S)
        self._expected_bytes = 0

    def fileno(self) -> int:
        """Return the descriptor that is readable when the companion has written; -1 while the line is closed."""
        return self._device_fd

    def speed(self) -> int:
        """Return the line speed that the companion has set, as a termios constant (`termios.B3000000` and so on)."""
        return int(termios.tcgetattr(self._companion_fd)[5])

    def on_readable(self) -> None:
        """Read what the companion has written."""
        try:
            data = os.read(self._device_fd, 4096)
        except (BlockingIOError, InterruptedError):
            return
        self._on_bytes(data)
