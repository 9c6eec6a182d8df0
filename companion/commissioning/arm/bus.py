"""Reads and writes registers of any servo on a bus, at any baud rate. All calls block; nothing here switches torque on.

Uses dynamixel-sdk on the flight's own port (`companion.io.dynamixel.port.ServoPort`).
"""

from __future__ import annotations

import contextlib
import termios
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Self, get_args

from companion.config.devices import ServoBaud
from companion.io.dynamixel.access import ServoAccess
from companion.io.dynamixel.port import ServoPort
from companion.io.dynamixel.registers import Register
from companion.io.protocols import DeviceError

BAUDS: Final[tuple[int, ...]] = (9600, *get_args(ServoBaud))
"""Baud rates that the tools try, in the order of the values of register 8: 9600 and the rates of a flight. The last value, 4.5
Mbps, is missing because termios has no name for it and dynamixel-sdk does not support it.
"""
FACTORY_BAUD: Final = 57600

ID = Register(7, 1, "id")
BAUD = Register(8, 1, "baud rate")
MAX_POSITION_LIMIT = Register(48, 4, "max position limit")
MIN_POSITION_LIMIT = Register(52, 4, "min position limit")
LED = Register(65, 1, "LED")

PING_BYTES: Final = 14
_REPLY_TIMEOUT_MS: Final = 100.0
"""Timeout for an answer: an FTDI adapter with its factory latency timer delays it by 16 ms, a busy computer by more."""


class _CountingPort(ServoPort):
    """Serial port that counts received bytes, to distinguish noise from silence."""

    came_bytes = 0

    def readPort(self, length: int) -> bytes:
        data = super().readPort(length)
        self.came_bytes += len(data)
        return data


@dataclass(frozen=True, slots=True)
class PingAnswers:
    """The answers to a broadcast ping at one baud rate."""

    servos: tuple[tuple[int, int, int], ...]
    """Model and firmware of each servo, by id."""
    garbled: bool
    """Whether unreadable bytes arrived, from two servos with the same id or from noise."""


class ServoTalk(ServoAccess):
    """Communication on one port, whose every failure is a DeviceError. A KeyboardInterrupt leaves no servo under torque."""

    def __init__(self, port: str) -> None:
        self.port: _CountingPort
        super().__init__(_CountingPort(port), f"arm bus {port}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):
            self.port.closePort()

    def open(self, baud: int) -> None:
        """Open the port, or change its baud rate.

        Raises:
            DeviceError: the port does not exist or is busy, or access to it is denied.
        """
        self.port.reply_timeout_ms = _REPLY_TIMEOUT_MS
        self.port.baudrate = baud
        if not self.port.openPort():
            raise DeviceError(f"{self._where}: this computer's serial ports do not support baud rate {baud}")
        # Discard bytes received at the old rate.
        with contextlib.suppress(OSError):
            self.port.ser.reset_input_buffer()

    @property
    def baud(self) -> int:
        """Baud rate at which the port is open."""
        return int(self.port.baudrate)

    def answers_to_ping(self) -> PingAnswers:
        """Return the answers to a broadcast ping. Takes up to 1.5 s: every servo answers in the time slot of its id.

        Raises:
            DeviceError: the port is gone.
        """
        before = self.port.came_bytes
        servos = tuple((servo_id, *about) for servo_id, about in sorted(self.ping_all().items()))
        return PingAnswers(servos, self.port.came_bytes - before != PING_BYTES * len(servos))

    def reboot(self, servo_id: int) -> None:
        """Restart a servo and wait until it answers again: its torque is off, its errors are cleared unless their cause persists.

        Raises:
            DeviceError: the servo does not answer.
        """
        with self.exchange(f"reboot of servo {servo_id}"):
            result, error = self.protocol.reboot(self.port, servo_id)
        self._check(servo_id, "reboot", result, error)
        if self.ping(servo_id) is None:
            raise self.error(servo_id, "does not answer after its reboot; cycle its power")

    @contextlib.contextmanager
    def exchange(self, doing: str) -> Iterator[None]:
        """Convert any exception of a failing port to a DeviceError."""
        try:
            with super().exchange(doing):
                yield
        except (OSError, TypeError, ValueError, termios.error) as error:
            text = f"{doing}: the port failed: {error}; plug the adapter in again"
            raise DeviceError(f"{self._where}: {text}") from error
