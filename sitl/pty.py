"""The device's end of a pseudo-terminal that the companion opens as a serial port."""

from __future__ import annotations

import asyncio
import os
import termios
import tty
from collections.abc import Callable


class PtyLine:
    """One serial line, served by the running event loop between `open` and `close`.

    Args:
        on_bytes: called with the bytes that the companion wrote.
    """

    def __init__(self, on_bytes: Callable[[bytes], None]) -> None:
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
            asyncio.get_running_loop().add_reader(self._device_fd, self._on_readable)
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
        try:
            return len(data) - os.write(self._device_fd, data)
        except BlockingIOError:
            return len(data)

    def speed(self) -> int:
        """Return the line speed that the companion has set, as a termios constant (`termios.B3000000` and so on)."""
        return int(termios.tcgetattr(self._companion_fd)[5])

    def _on_readable(self) -> None:
        try:
            data = os.read(self._device_fd, 4096)
        except (BlockingIOError, InterruptedError):
            return
        self._on_bytes(data)
