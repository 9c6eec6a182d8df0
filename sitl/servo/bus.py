"""A half-duplex bus of emulated Dynamixel servos: `ServoLine` implements the protocol without I/O; `ServoBus` connects it to a pty.

Source: ROBOTIS e-manual, "DYNAMIXEL Protocol 2.0".
"""

from __future__ import annotations

import asyncio
import contextlib
import select
import termios
from collections.abc import Callable, Iterable
from typing import Self

from companion.runtime.simulated_time import Page
from sitl.pty import PtyLine
from sitl.servo.model import ServoModel, ServoRefusal
from sitl.servo.protocol import (
    BROADCAST_ID,
    Instruction,
    Packet,
    PacketParser,
    StatusError,
    status,
)
from sitl.servo.registers import BAUDS

_BITS_PER_BYTE = 10
_PARTIAL_TIMEOUT_S = 0.02
"""Byte-to-byte timeout. The real servo's is 1.5 ms, but a pty on a busy computer may be slower."""
_BAUD_OF_SPEED = {getattr(termios, f"B{baud}"): baud for baud in BAUDS if hasattr(termios, f"B{baud}")}


class ServoLine:
    """The servos on one wire. Two servos with the same id answer at the same time and garble each other's packets."""

    def __init__(self, servos: Iterable[ServoModel]) -> None:
        self.servos = tuple(servos)
        self.parser = PacketParser()
        self._listening: list[ServoModel] = []
        self._delay_s = 0.0

    def feed(self, data: bytes, baud_bps: int | None = None) -> bytes:
        """Process bytes from the master and return the servos' answer; never raise an exception.

        Args:
            baud_bps: baud rate of the bytes; if None, every servo receives them.
        """
        return self.exchange(data, baud_bps)[0]

    def exchange(self, data: bytes, baud_bps: int | None = None) -> tuple[bytes, float]:
        """Process bytes like `feed`, and also return the sum of the servos' return delay times in s."""
        self._delay_s = 0.0
        packets = self.parser.feed(data)
        if not packets:
            return b"", 0.0
        self._listening = [s for s in self.servos if not s.silent and baud_bps in (None, s.baud_bps)]
        return b"".join(self._answer(packet) for packet in packets), self._delay_s

    def _answer(self, packet: Packet) -> bytes:
        if not packet.crc_ok:
            if packet.instruction == Instruction.STATUS:
                return b""
            return _together([self._status(servo, StatusError.CRC) for servo in self._having(packet.packet_id)])
        if packet.instruction == Instruction.STATUS:
            return b""
        for servo in self._listening:
            servo.drive.heard_instruction()
        if packet.packet_id != BROADCAST_ID:
            return self._unicast(packet)
        if packet.instruction == Instruction.SYNC_READ:
            return self._sync_read(packet.parameters)
        if packet.instruction == Instruction.SYNC_WRITE:
            return self._sync_write(packet.parameters)
        return self._broadcast(packet)

    # --- one servo or all --------------------------------------------------------------------------------------------

    def _broadcast(self, packet: Packet) -> bytes:
        if packet.instruction == Instruction.PING:
            ids = sorted({servo.servo_id for servo in self._listening})
            return b"".join(_together([self._ping(servo) for servo in self._having(servo_id)]) for servo_id in ids)
        for servo in self._listening:
            self._carry_out(servo, packet)
        return b""

    def _unicast(self, packet: Packet) -> bytes:
        having = self._having(packet.packet_id)
        for other in self._listening:
            if other not in having and other.secondary_id == packet.packet_id:
                self._carry_out(other, packet)
        return _together([self._answer_of(servo, packet) for servo in having])

    def _answer_of(self, servo: ServoModel, packet: Packet) -> bytes:
        if packet.instruction == Instruction.PING:
            return self._ping(servo)
        # A write to register 68 or 7 takes effect with the next packet.
        level, servo_id = servo.status_return_level, servo.servo_id
        error, data = self._carry_out(servo, packet)
        if level == 0 or (level == 1 and packet.instruction != Instruction.READ):
            return b""
        return self._status(servo, error, data, servo_id)

    def _carry_out(self, servo: ServoModel, packet: Packet) -> tuple[StatusError, bytes]:
        parameters = packet.parameters
        data = b""
        try:
            match packet.instruction:
                case Instruction.READ:
                    if len(parameters) != 4:
                        raise ServoRefusal(StatusError.DATA_LENGTH)
                    data = servo.read(_word(parameters, 0), _word(parameters, 2))
                case Instruction.WRITE:
                    if len(parameters) < 3:
                        raise ServoRefusal(StatusError.DATA_LENGTH)
                    servo.write(_word(parameters, 0), parameters[2:])
                case Instruction.REBOOT:
                    servo.reboot()
                case _:
                    raise ServoRefusal(StatusError.INSTRUCTION)
        except ServoRefusal as refusal:
            return refusal.error, b""
        return StatusError.NONE, data

    def _ping(self, servo: ServoModel) -> bytes:
        return self._status(servo, StatusError.NONE, servo.model.to_bytes(2, "little") + bytes((servo.firmware,)))

    # --- several servos ----------------------------------------------------------------------------------------------

    def _sync_read(self, parameters: bytes) -> bytes:
        if len(parameters) < 5:
            return b""
        address, length, out = _word(parameters, 0), _word(parameters, 2), bytearray()
        for servo_id in parameters[4:]:
            having = self._having(servo_id)
            if not having or having[0].status_return_level == 0:
                break  # each servo waits for the status packet of the previous one
            out += _together([self._status(servo, *_try_read(servo, address, length)) for servo in having])
        return bytes(out)

    def _sync_write(self, parameters: bytes) -> bytes:
        if len(parameters) >= 4:
            address, length = _word(parameters, 0), _word(parameters, 2)
            for i in range(4, len(parameters) - length, 1 + length):
                for servo in self._having(parameters[i]):
                    with contextlib.suppress(ServoRefusal):  # a write to several servos has no status packet
                        servo.write(address, parameters[i + 1 : i + 1 + length])
        return b""

    # --- helpers -----------------------------------------------------------------------------------------------------

    def _having(self, servo_id: int) -> list[ServoModel]:
        return [servo for servo in self._listening if servo.servo_id == servo_id]

    def _status(self, servo: ServoModel, error: int, data: bytes = b"", servo_id: int | None = None) -> bytes:
        self._delay_s += servo.return_delay_s
        return status(servo.servo_id if servo_id is None else servo_id, error | servo.alert, data)


def _together(answers: list[bytes]) -> bytes:
    """Combine answers that overlap on the line: each starts one byte after the previous one, and a 0 bit wins."""
    line = answers[0] if answers else b""
    for late in answers[1:]:
        late = b"\xff" + late
        size = max(len(line), len(late))
        line = bytes(a & b for a, b in zip(line.ljust(size, b"\xff"), late.ljust(size, b"\xff"), strict=True))
    return line


def _word(data: bytes, offset: int) -> int:
    return data[offset] | data[offset + 1] << 8


def _try_read(servo: ServoModel, address: int, length: int) -> tuple[StatusError, bytes]:
    try:
        return StatusError.NONE, servo.read(address, length)
    except ServoRefusal as refusal:
        return refusal.error, b""


class ServoBus:
    """The servos behind a pty, served by the running event loop.

    Args:
        page: page of simulated time, on which the bus writes how much it has answered; None in real time. In simulated time the
            transmission takes no time.
        wire_time: delay every answer by the transmission time of request and answer at the line's baud rate and by the return
            delays. The event loop's granularity of 1 ms represents the latency timer of the USB adapter.

    The companion's baud rate is read from the pty's line settings; servos at another baud rate stay silent, as on a real wire.
    """

    def __init__(self, servos: Iterable[ServoModel], *, wire_time: bool = True, page: Page | None = None) -> None:
        self.line = ServoLine(servos)
        self._page = page
        self.taken_bytes = 0
        """Bytes of instructions that were read from the line."""
        self.dropped_bytes = 0
        """Bytes of answers that were dropped because the line was not read."""
        self.damaged: Callable[[], bool] = lambda: False
        """Fault: called for the instructions that arrive at once; returns whether noise corrupts a byte of them."""
        self.answers_late_s = 0.0
        """Fault: additional delay of every answer; not in simulated time, in which a transmission takes no time."""
        self._wire_time = wire_time
        self._pty = PtyLine(self._on_bytes)
        self._last_byte_s = 0.0
        self._line_free_s = 0.0
        self._timers: set[asyncio.TimerHandle] = set()
        self.unsent = 0
        """Number of answers that wait for their time on the wire."""

    @property
    def path(self) -> str:
        """Device that the companion opens; valid while the bus is open."""
        return self._pty.path

    async def __aenter__(self) -> Self:
        self._pty.open()
        return self

    async def __aexit__(self, *_: object) -> None:
        for timer in self._timers:
            timer.cancel()
        self._timers.clear()
        self._pty.close()

    def _on_bytes(self, data: bytes) -> None:
        loop = asyncio.get_running_loop()
        now_s = loop.time()
        if self._page is None and self.line.parser.pending and now_s - self._last_byte_s > _PARTIAL_TIMEOUT_S:
            self.line.parser.drop_partial()
        self._last_byte_s = now_s
        # No servo supports a speed without a name in termios.
        baud_bps = _BAUD_OF_SPEED.get(self._pty.speed(), 0)
        answer, delay_s = self.answer_to(data, baud_bps)
        if self._page is not None or not self._wire_time:
            if answer:
                self._send(answer)
            self.taken_bytes += len(data)
            if self._page is not None:
                self._page.bus_answered_bytes = self.taken_bytes
            return
        if not answer:
            return
        on_wire_s = (len(data) + len(answer)) * _BITS_PER_BYTE / baud_bps
        self._line_free_s = max(now_s, self._line_free_s) + on_wire_s + delay_s + self.answers_late_s
        self._timers = {timer for timer in self._timers if not timer.cancelled() and timer.when() > now_s}
        self._timers.add(loop.call_at(self._line_free_s, self._send_in_time, answer))
        self.unsent += 1

    def fileno(self) -> int:
        """Return the descriptor that is readable when an instruction has arrived."""
        return self._pty.fileno()

    def on_readable(self) -> None:
        """Answer the instructions that have arrived."""
        self._pty.on_readable()

    def take(self, count: int, timeout_s: float) -> None:
        """Wait until `count` bytes of instructions have been read from the line, at most `timeout_s` of wall time."""
        while self.taken_bytes < count and select.select((self._pty,), (), (), timeout_s)[0]:
            self._pty.on_readable()

    def inject(self, noise: bytes) -> None:
        """Send bytes on the line unchanged, for example noise."""
        self._send(noise)

    def answer_to(self, data: bytes, baud_bps: int) -> tuple[bytes, float]:
        """Return the servos' answer to a request sent at a baud rate, and their return delay, s; noise may corrupt the request."""
        if self.damaged():
            middle = len(data) // 2
            data = data[:middle] + bytes((data[middle] ^ 0x5A,)) + data[middle + 1 :]
        return self.line.exchange(data, baud_bps)

    def _send_in_time(self, answer: bytes) -> None:
        self.unsent -= 1
        self._send(answer)

    def _send(self, answer: bytes) -> None:
        dropped = self._pty.write(answer)
        self.dropped_bytes += dropped
        if self._page is not None:
            self._page.bus_sent_bytes += len(answer) - dropped
