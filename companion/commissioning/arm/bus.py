"""Reads and writes registers of any servo on a bus, at any baud rate. All calls block; nothing here switches torque on.

Uses dynamixel-sdk on the flight's own port (`companion.io.dynamixel.registers.ServoPort`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Self, get_args

from dynamixel_sdk import COMM_SUCCESS, PacketHandler

from companion.config.devices import ServoBaud
from companion.io.dynamixel import registers as dxl
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
STARTUP = Register(60, 1, "startup configuration")
LED = Register(65, 1, "LED")

PING_BYTES: Final = 14
_REPLY_TIMEOUT_MS: Final = 100.0
"""Timeout for an answer: an FTDI adapter with its factory latency timer delays it by 16 ms, a busy computer by more."""
_ERROR_NUMBER: Final = 0x7F
_CRC_ERROR: Final = 3
_ATTEMPTS: Final = 10
"""Attempts at a read or write: interference corrupts single packets, and a busy computer delays answers."""


class _CountingPort(dxl.ServoPort):
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


class ServoTalk:
    """Communication on one port. Not thread-safe. A KeyboardInterrupt in any method leaves no servo under torque."""

    def __init__(self, port: str) -> None:
        self._name = port
        self._port = _CountingPort(port)
        self._protocol = PacketHandler(2.0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):
            self._port.closePort()

    def open(self, baud: int) -> None:
        """Open the port, or change its baud rate.

        Raises:
            DeviceError: the port does not exist or is busy, or access to it is denied.
        """
        self._port.reply_timeout_ms = _REPLY_TIMEOUT_MS
        self._port.baudrate = baud
        if not self._port.openPort():
            raise DeviceError(f"arm bus {self._name}: this computer's serial ports do not support baud rate {baud}")
        # Discard bytes received at the old rate.
        with contextlib.suppress(OSError):
            self._port.ser.reset_input_buffer()

    @property
    def baud(self) -> int:
        """Baud rate at which the port is open."""
        return int(self._port.baudrate)

    def ping_all(self) -> PingAnswers:
        """Return the answers to a broadcast ping. Takes up to 1.5 s: every servo answers in the time slot of its id.

        Raises:
            DeviceError: the port is gone.
        """
        before = self._port.came_bytes
        with self._named("broadcast ping"):
            answered, _ = self._protocol.broadcastPing(self._port)
        servos = tuple((servo_id, model, firmware) for servo_id, (model, firmware) in sorted(answered.items()))
        return PingAnswers(servos, self._port.came_bytes - before != PING_BYTES * len(servos))

    def answers(self, servo_id: int) -> bool:
        """Return whether this servo answers a ping, which is repeated if a packet was lost or corrupted.

        Raises:
            DeviceError: the port is gone.
        """
        with self._named(f"ping of servo {servo_id}"):
            return any(self._protocol.ping(self._port, servo_id)[1] == COMM_SUCCESS for _ in range(_ATTEMPTS))

    def read(self, servo_id: int, register: Register) -> int:
        """Return a register's value. The request is repeated if a packet was lost or corrupted.

        Raises:
            DeviceError: the servo does not answer, or refuses.
        """
        for _ in range(_ATTEMPTS):
            with self._named(f"servo {servo_id}: reading {register}"):
                data, result, error = self._protocol.readTxRx(self._port, servo_id, register.address, register.size)
            if result == COMM_SUCCESS and error & _ERROR_NUMBER != _CRC_ERROR:
                break
        self._check(servo_id, f"reading {register}", result, error)
        return int.from_bytes(bytes(data), "little", signed=register.signed)

    def reboot(self, servo_id: int) -> None:
        """Restart a servo and wait until it answers again: its torque is off, its errors are cleared unless their cause persists.

        Raises:
            DeviceError: the servo does not answer.
        """
        with self._named(f"reboot of servo {servo_id}"):
            result, error = self._protocol.reboot(self._port, servo_id)
        self._check(servo_id, "reboot", result, error)
        if not self.answers(servo_id):
            raise self._error(servo_id, "does not answer after its reboot; cycle its power")

    def write(self, servo_id: int, register: Register, value: int, *, read_back: bool = True) -> None:
        """Write a register and read it back. The request is repeated if a packet was lost or corrupted.

        Args:
            read_back: False for id and baud rate, because the servo then answers at another id or rate.

        Raises:
            DeviceError: the servo does not answer or refuses, or a different value is read back.
        """
        data = list(value.to_bytes(register.size, "little", signed=register.signed))
        for _ in range(_ATTEMPTS if read_back else 1):
            with self._named(f"servo {servo_id}: writing {register}"):
                result, error = self._protocol.writeTxRx(self._port, servo_id, register.address, register.size, data)
            if result == COMM_SUCCESS and error & _ERROR_NUMBER != _CRC_ERROR:
                break
        if not read_back:
            return
        self._check(servo_id, f"writing {register}", result, error)
        found = self.read(servo_id, register)
        if found != value:
            raise self._error(
                servo_id, f"{register} reads {found} after {value} was written; another program may be using the bus"
            )

    def _check(self, servo_id: int, doing: str, result: int, error: int) -> None:
        if result != COMM_SUCCESS:
            raise self._error(servo_id, f"{doing}: no answer at {self.baud} baud; check for a loose cable or supply")
        if error & _ERROR_NUMBER:
            text = self._protocol.getRxPacketError(error & _ERROR_NUMBER).removeprefix("[RxPacketError] ")
            raise self._error(servo_id, f"{doing} was refused: {text}")

    def _error(self, servo_id: int, text: str) -> DeviceError:
        return DeviceError(f"arm bus {self._name}: servo {servo_id}: {text}")

    @contextlib.contextmanager
    def _named(self, doing: str) -> Iterator[None]:
        """Convert any exception of a failing port to a DeviceError."""
        self._port.is_using = False  # an exception in an earlier transaction leaves it set
        try:
            yield
        except (OSError, TypeError, ValueError) as error:
            text = f"{doing}: the port failed: {error}; plug the adapter in again"
            raise DeviceError(f"arm bus {self._name}: {text}") from error
