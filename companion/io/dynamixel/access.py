"""Pings servos on an open port, and reads and writes their registers. All calls block; dynamixel-sdk implements the protocol.

A request is repeated if a packet was lost or corrupted, and a write if it had no effect: interference corrupts single packets, and a
busy computer delays answers.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from typing import Final

from dynamixel_sdk import COMM_SUCCESS
from dynamixel_sdk.protocol2_packet_handler import Protocol2PacketHandler

from companion.io.dynamixel.port import ServoPort
from companion.io.dynamixel.registers import Register
from companion.io.protocols import DeviceError

ATTEMPTS: Final = 10
"""Attempts at a ping, read or write."""
ERROR_NUMBER: Final = 0x7F
"""Bits of a status packet's error byte that hold its error number."""
_CRC_ERROR: Final = 3
_PING, _READ = 0x01, 0x02
_MODEL_AND_FIRMWARE_BYTES: Final = 3
_ID, _LENGTH, _INSTRUCTION, _ERROR, _DATA, _READ_SIZE = 4, slice(5, 7), 7, 8, 9, slice(10, 12)
"""Places in a packet."""
_BESIDE_DATA_BYTES: Final = 4
"""Bytes that a status packet's length counts beside the data: instruction, error and CRC."""


class _Protocol(Protocol2PacketHandler):  # type: ignore[misc]
    """The SDK's protocol, without replies to other requests: a status packet names its servo, but not its request, so that the SDK
    takes the late reply to a write for that to a ping, and reads a model number from its CRC.
    """

    def txRxPacket(self, port: ServoPort, txpacket: list[int]) -> tuple[list[int] | None, int, int]:
        """Send a request and return its reply; skip status packets that have more or less data than the reply has."""
        reply, result, error = super().txRxPacket(port, txpacket)
        instruction, reads = txpacket[_INSTRUCTION], txpacket[_INSTRUCTION] == _READ
        size = _word(txpacket[_READ_SIZE]) if reads else _MODEL_AND_FIRMWARE_BYTES if instruction == _PING else 0
        while result == COMM_SUCCESS and reply is not None and not _replies(reply, txpacket[_ID], size, reads):
            reply, result = self.rxPacket(port, False)
            error = reply[_ERROR] if result == COMM_SUCCESS else 0
        return reply, result, error

    def readRx(self, port: ServoPort, dxl_id: int, length: int) -> tuple[list[int], int, int]:
        """Return the data of a servo's reply to a read; skip other status packets as `txRxPacket` does."""
        while True:
            reply, result = self.rxPacket(port, False)
            if result != COMM_SUCCESS:
                return [], result, 0
            if _replies(reply, dxl_id, length, True):
                return reply[_DATA : _DATA + length], result, reply[_ERROR]


class ServoAccess:
    """Access to the servos on one port. Not thread-safe.

    Args:
        port: the port; it may be opened later.
        where: name of the bus, for errors.
        names: names of servos by id, for errors; a servo without a name is called by its id.
        before_attempt: called before each attempt; it may raise an exception.
    """

    def __init__(
        self,
        port: ServoPort,
        where: str,
        names: Mapping[int, str] | None = None,
        before_attempt: Callable[[], None] = lambda: None,
    ) -> None:
        self.port = port
        self.protocol = _Protocol()
        self._where = where
        self._names = names or {}
        self._before_attempt = before_attempt

    def ping(self, servo_id: int) -> int | None:
        """Return the servo's model number, or None if it does not answer."""
        for _ in range(ATTEMPTS):
            self._before_attempt()
            with self.exchange(f"ping of servo {servo_id}"):
                model, result, error = self.protocol.ping(self.port, servo_id)
            if _arrived(result, error):
                return int(model)
        return None

    def ping_all(self) -> dict[int, tuple[int, int]]:
        """Return model and firmware of each servo that answers a broadcast ping, by id. Takes up to 1.5 s."""
        with self.exchange("broadcast ping"):
            answered: dict[int, tuple[int, int]] = self.protocol.broadcastPing(self.port)[0]
        return answered

    def read(self, servo_id: int, register: Register) -> int:
        """Return a register's value.

        Raises:
            DeviceError: the servo does not answer, or refuses.
        """
        return int.from_bytes(self._read_bytes(servo_id, register), "little", signed=register.signed)

    def write(self, servo_id: int, register: Register, value: int) -> None:
        """Write a register and read it back.

        Raises:
            DeviceError: the servo does not answer or refuses, or a different value is read back.
        """
        self.write_bytes(servo_id, register, value.to_bytes(register.size, "little", signed=register.signed))

    def write_bytes(self, servo_id: int, register: Register, data: bytes) -> None:
        """Write bytes from a register on and read them back; raises the errors of `write`."""
        doing, found = f"writing {register}", b""
        for _ in range(ATTEMPTS):
            self._before_attempt()
            result, error = self._write_once(servo_id, register, data)
            if _arrived(result, error):
                self._check(servo_id, doing, result, error)
                found = self._read_bytes(servo_id, register)
                if found == data:
                    return
        self._check(servo_id, doing, result, error)
        text = f"{register} reads {found.hex()} after {data.hex()} was written; another program may be using the bus"
        raise self.error(servo_id, text)

    def try_write(self, servo_id: int, register: Register, value: int) -> bool:
        """Write a register once; return whether the servo has confirmed it."""
        data = value.to_bytes(register.size, "little", signed=register.signed)
        result, error = self._write_once(servo_id, register, data)
        return result == COMM_SUCCESS and not error & ERROR_NUMBER

    def error(self, servo_id: int, text: str) -> DeviceError:
        """Return an error of one servo."""
        return DeviceError(f"{self._where}: {self._names.get(servo_id, f'servo {servo_id}')}: {text}")

    @contextlib.contextmanager
    def exchange(self, doing: str) -> Iterator[None]:
        """Context of one transaction of the SDK; `doing` names it for errors."""
        self.port.is_using = False  # an exception in an earlier transaction leaves it set
        yield

    def _read_bytes(self, servo_id: int, register: Register) -> bytes:
        for _ in range(ATTEMPTS):
            self._before_attempt()
            with self.exchange(f"servo {servo_id}: reading {register}"):
                data, result, error = self.protocol.readTxRx(self.port, servo_id, register.address, register.size)
            if _arrived(result, error):
                break
        self._check(servo_id, f"reading {register}", result, error)
        return bytes(data)

    def _write_once(self, servo_id: int, register: Register, data: bytes) -> tuple[int, int]:
        with self.exchange(f"servo {servo_id}: writing {register}"):
            written: tuple[int, int] = self.protocol.writeTxRx(
                self.port, servo_id, register.address, len(data), list(data)
            )
        return written

    def _check(self, servo_id: int, doing: str, result: int, error: int) -> None:
        if result != COMM_SUCCESS:
            baud = int(self.port.baudrate)
            raise self.error(servo_id, f"{doing}: no answer at {baud} baud; check for a loose cable or supply")
        if error & ERROR_NUMBER:
            text = self.protocol.getRxPacketError(error & ERROR_NUMBER).removeprefix("[RxPacketError] ")
            raise self.error(servo_id, f"{doing} was refused: {text}")


def _arrived(result: int, error: int) -> bool:
    return bool(result == COMM_SUCCESS and error & ERROR_NUMBER != _CRC_ERROR)


def _replies(reply: list[int], servo_id: int, size: int, reads: bool) -> bool:
    """Return whether a status packet comes from the servo and has so many bytes of data, or refuses a read."""
    found = _word(reply[_LENGTH]) - _BESIDE_DATA_BYTES
    refused = reads and found == 0 and reply[_ERROR] & ERROR_NUMBER
    return reply[_ID] == servo_id and bool(found == size or refused)


def _word(two: list[int]) -> int:
    return two[0] | two[1] << 8
