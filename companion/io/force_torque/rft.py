"""Serial protocol of the Robotous RFT60-HA01. Pure: bytes in, records out.

Source: Robotous RFT series manual 1.8, section 3, and the vendor's packet definitions. 115200 8N1. A command has 11 bytes `55 | data 8
| sum | AA`, a response 19 bytes `55 | data 16 | sum | AA`; sum is the sum of the data modulo 256, data byte 0 is the command id. Fx..Tz
are big-endian int16 in data bytes 1-12 (50 counts per N, 2000 counts per N m), data byte 13 holds overload bits. While streaming, the
sensor executes only STOP and SET_BIAS and answers neither.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import Final, NamedTuple

from companion.model.types import Vec3

SOP: Final = 0x55
EOP: Final = 0xAA
COMMAND_BYTES: Final = 11
RESPONSE_BYTES: Final = 19
FORCE_PER_N: Final = 50.0
TORQUE_PER_NM: Final = 2000.0
_INT16_MIN = -32768
_INT16_MAX = 32767
_WRENCH = struct.Struct(">6hB")


class Command(IntEnum):
    """Command ids, data byte 0."""

    PRODUCT_NAME = 1
    SERIAL_NUMBER = 2
    FIRMWARE_VERSION = 3
    READ_ONCE = 10
    START = 11
    STOP = 12
    SET_RATE = 15
    GET_RATE = 16
    SET_BIAS = 17


RATE_CODES: Final[dict[int, int]] = {0: 200, 1: 10, 2: 20, 3: 50, 4: 100, 5: 200, 6: 333}
"""Output rate code -> Hz, limited to what 115200 baud can carry; 0 is the factory default."""

COMMAND_IDS: Final = frozenset(int(command) for command in Command)


class SetError(IntEnum):
    """Error code of a rejected setting, data byte 2 of the response."""

    NONE = 0
    NOT_SUPPORTED = 1
    VALUE_RANGE = 2
    EEPROM_WRITE = 3


class Overload(IntEnum):
    """Bits of data byte 13."""

    FX = 0x20
    FY = 0x10
    FZ = 0x08
    TX = 0x04
    TY = 0x02
    TZ = 0x01


class Wrench(NamedTuple):
    """One measurement in the sensor frame."""

    force_n: Vec3
    torque_nm: Vec3
    overload_bits: int


def encode_command(command: Command, parameter: int = 0) -> bytes:
    """Return a command packet; `parameter` (0 to 255) is data byte 1."""
    return pack(bytes((command, parameter)), COMMAND_BYTES)


def pack(data: bytes, packet_bytes: int) -> bytes:
    """Frame a data field, padded with zeros, into a packet of `packet_bytes` (`COMMAND_BYTES` or `RESPONSE_BYTES`).

    Raises:
        ValueError: if the data field is too long.
    """
    room = packet_bytes - 3
    if len(data) > room:
        raise ValueError(f"data field of {len(data)} bytes, at most {room} fit")
    field = data.ljust(room, b"\0")
    return bytes((SOP,)) + field + bytes((sum(field) & 0xFF, EOP))


def encode_wrench(command: Command, wrench: Wrench) -> bytes:
    """Return a response packet of READ_ONCE or START: rounded to counts, saturated at int16."""
    counts = [_count(value, FORCE_PER_N) for value in wrench.force_n]
    counts += [_count(value, TORQUE_PER_NM) for value in wrench.torque_nm]
    return pack(bytes((command,)) + _WRENCH.pack(*counts, wrench.overload_bits & 0xFF), RESPONSE_BYTES)


def _count(value: float, per_unit: float) -> int:
    return max(_INT16_MIN, min(_INT16_MAX, round(value * per_unit)))


def decode_wrench(data: bytes) -> Wrench:
    """Return the force (N) and the torque (N m) from the 16 data bytes of a READ_ONCE or START response."""
    fx, fy, fz, tx, ty, tz, bits = _WRENCH.unpack_from(data, 1)
    return Wrench(
        force_n=(fx / FORCE_PER_N, fy / FORCE_PER_N, fz / FORCE_PER_N),
        torque_nm=(tx / TORQUE_PER_NM, ty / TORQUE_PER_NM, tz / TORQUE_PER_NM),
        overload_bits=bits,
    )


def decode_text(data: bytes) -> str:
    """Return the text in a response: ASCII from data byte 1 to the first zero byte, unprintable characters replaced by "?"."""
    text = data[1:].partition(b"\0")[0].decode("ascii", "replace")
    return "".join(character if character.isprintable() else "?" for character in text).strip()


class PacketScanner:
    """Finds packets in a byte stream; resynchronises on SOP, length, sum, EOP and a known command id.

    Payloads may contain SOP and EOP: a candidate that fails any test is skipped by one byte only, so that a packet which starts inside
    it is still found. The state is the unfinished tail (less than one packet) and three counters.
    """

    def __init__(self, packet_bytes: int) -> None:
        self._packet_bytes = packet_bytes
        self._tail = b""
        self.packets = 0
        self.skipped_bytes = 0
        self.bad_sums = 0
        """Candidates framed by SOP and EOP whose checksum is wrong."""

    def feed(self, received: bytes) -> list[bytes]:
        """Return the data fields (packets without SOP, sum and EOP) that `received` completes, in order."""
        stream = self._tail + received
        size = self._packet_bytes
        fields: list[bytes] = []
        position = 0
        while True:
            start = stream.find(SOP, position)
            if start < 0:
                self.skipped_bytes += len(stream) - position
                self._tail = b""
                return fields
            self.skipped_bytes += start - position
            if len(stream) - start < size:
                self._tail = stream[start:]
                return fields
            field = self._field(stream[start : start + size])
            if field is None:
                self.skipped_bytes += 1
                position = start + 1
            else:
                self.packets += 1
                fields.append(field)
                position = start + size

    def _field(self, packet: bytes) -> bytes | None:
        if packet[-1] != EOP:
            return None
        field = packet[1:-2]
        if sum(field) & 0xFF != packet[-2]:
            self.bad_sums += 1
            return None
        return field if field[0] in COMMAND_IDS else None
