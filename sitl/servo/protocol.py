"""DYNAMIXEL Protocol 2.0 on the servo's side, without I/O: CRC, byte stuffing, and a parser that recovers from noise.

Source: ROBOTIS e-manual, "DYNAMIXEL Protocol 2.0".
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from fastcrc.crc16 import umts as crc16

HEADER = b"\xff\xff\xfd\x00"
BROADCAST_ID = 0xFE
MAX_ID = 252
MAX_LENGTH = 1024
"""Largest valid length field; a larger one is noise that resembles a header."""
_PREFIX = 7  # header, id, length


class Instruction(IntEnum):
    """Values of the instruction field of a packet."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REBOOT = 0x08
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


class StatusError(IntEnum):
    """Error number of a status packet (bits 0 to 6 of its error byte)."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


ALERT = 0x80
"""Bit 7 of the error byte: register 70 is not zero."""


def stuff(body: bytes) -> bytes:
    """Return a packet body with FD inserted after every FF FF FD."""
    return body.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")


def unstuff(body: bytes) -> bytes:
    """Undo `stuff`."""
    return body.replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")


def packet(packet_id: int, body: bytes) -> bytes:
    """Return the packet for an unstuffed body (instruction byte and parameters)."""
    body = stuff(body)
    head = HEADER + bytes((packet_id,)) + (len(body) + 2).to_bytes(2, "little") + body
    return head + crc16(head).to_bytes(2, "little")


def status(servo_id: int, error: int, data: bytes = b"") -> bytes:
    """Return a status packet; `error` is the whole error byte, alert bit included."""
    return packet(servo_id, bytes((Instruction.STATUS, error)) + data)


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet on the line."""

    packet_id: int
    instruction: int
    parameters: bytes
    """Parameters without stuffing; empty if the CRC is wrong."""
    crc_ok: bool


class PacketParser:
    """Finds packets in a byte stream. It never raises; it skips noise up to the next valid header."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    @property
    def pending(self) -> bool:
        """Whether a packet has begun but is incomplete."""
        return bool(self._buffer)

    def drop_partial(self) -> None:
        """Drop an incomplete packet (the servo's byte-to-byte timeout)."""
        self._buffer.clear()

    def feed(self, data: bytes) -> list[Packet]:
        """Process bytes from the line and return the completed packets."""
        buffer = self._buffer
        buffer += data
        packets: list[Packet] = []
        while True:
            start = buffer.find(HEADER)
            if start < 0:
                keep = _header_prefix_size(buffer)
                del buffer[: len(buffer) - keep]
                return packets
            del buffer[:start]
            if len(buffer) < _PREFIX:
                return packets
            length = buffer[5] | buffer[6] << 8
            if not 3 <= length <= MAX_LENGTH or not (buffer[4] <= MAX_ID or buffer[4] == BROADCAST_ID):
                del buffer[0]
                continue
            end = _PREFIX + length
            if len(buffer) < end:
                return packets
            if crc16(buffer[: end - 2]) == buffer[end - 2] | buffer[end - 1] << 8:
                body = unstuff(bytes(buffer[_PREFIX : end - 2]))
                packets.append(Packet(buffer[4], body[0], body[1:], True))
                del buffer[:end]
            else:
                # A wrong length may have swallowed the next packet: look for a header inside this one as well.
                packets.append(Packet(buffer[4], buffer[_PREFIX], b"", False))
                del buffer[0]


def _header_prefix_size(buffer: bytearray) -> int:
    """Return the number of bytes at the end of the buffer that may begin a header."""
    for size in (3, 2, 1):
        if buffer.endswith(HEADER[:size]):
            return size
    return 0
