"""The emulated servos against the e-manual: known packets, register rules, watchdog, hardware errors, noise on the line."""

from __future__ import annotations

import asyncio
import contextlib
import os
import termios
from typing import Self

import pytest

from sitl.servo.bus import ServoBus, ServoLine
from sitl.servo.model import RAD_PER_COUNT, ServoModel
from sitl.servo.protocol import Instruction, PacketParser, StatusError, packet, status
from tests.sitl.test_servo_model import get
from tests.support import DEADLINE_S

AMP = 2.69e-3


def servo_at(count: int, servo_id: int = 1) -> ServoModel:
    return ServoModel(servo_id, shaft_angle_rad=count * RAD_PER_COUNT)


def line_of(*servos: ServoModel) -> ServoLine:
    for servo in servos:
        servo.write(9, b"\x00")
    return ServoLine(servos)


# --- packets, byte for byte as in the e-manual ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sent", "answered"),
    [
        ("fffffd000103000119 4e", "fffffd0001070055000604266 55d"),
        ("fffffd00fe03000131 42", "fffffd0001070055000604266 55d fffffd0002070055000604266f6d"),
        ("fffffd000107000284000400 1d15", "fffffd00010800550 0a6000000 8cc0"),
        ("fffffd0001090003740000020000 ca89", "fffffd00010400550 0a10c"),
        ("fffffd0001030008 2f4e", "fffffd00010400550 0a10c"),
        ("fffffd00fe090082840004000102 cefa", "fffffd00010800550 0a6000000 8cc0 fffffd00020800550 01f080000 babe"),
        ("fffffd00fe110083 74000400 0196000000 02aa000000 8287", ""),
    ],
)
def test_manual_example_is_answered_byte_for_byte(sent: str, answered: str) -> None:
    servos = [ServoModel(i, firmware=38, shaft_angle_rad=c * RAD_PER_COUNT) for i, c in ((1, 166), (2, 2079))]
    servos[0].set_voltage_v(11.9)
    servos[1].set_temperature_c(36)
    assert line_of(*servos).feed(bytes.fromhex(sent)) == bytes.fromhex(answered.replace(" ", ""))


@pytest.mark.parametrize(("silent", "answered"), [(0, b""), (1, status(3, 0, b"\xa6\x00\x00\x00"))])
def test_a_sync_read_stops_where_a_servo_is_missing(silent: int, answered: bytes) -> None:
    line = line_of(servo_at(166, 3), servo_at(2079, 7))
    line.servos[silent].fail_silent(True)
    assert line.feed(bytes.fromhex("fffffd00fe090082840004000307d376")) == answered


@pytest.mark.parametrize(
    ("body", "error"),
    [
        (bytes((0x7E,)), StatusError.INSTRUCTION),
        (bytes((2, 0x00, 0x10, 4, 0)), StatusError.ACCESS),
        (bytes((3, 132, 0, 1, 0, 0, 0)), StatusError.ACCESS),
        (bytes((3, 65, 0, 2)), StatusError.DATA_RANGE),
        (bytes((3, 116, 0, 1, 0)), StatusError.DATA_LENGTH),
    ],
)
def test_wrong_instruction_is_answered_with_its_error(body: bytes, error: StatusError) -> None:
    assert line_of(ServoModel(1)).feed(packet(1, body)) == status(1, error)


def test_wrong_crc_is_answered_with_its_error_and_not_obeyed() -> None:
    servo = ServoModel(1)
    damaged = bytearray(packet(1, bytes((3, 65, 0, 1))))
    damaged[-1] ^= 1
    assert line_of(servo).feed(bytes(damaged)) == status(1, StatusError.CRC)
    assert get(servo, 65, 1) == 0


def test_servo_does_not_hear_another_baud_rate() -> None:
    line = line_of(ServoModel(1, baud_bps=1_000_000))
    ping = packet(1, b"\x01")
    assert line.feed(ping, 57600) == b""
    assert line.feed(ping, 1_000_000) != b""


# --- noise ----------------------------------------------------------------------------------------------------------------

_PING = packet(1, b"\x01")


# --- pty ------------------------------------------------------------------------------------------------------------------

_READ_MODEL = packet(1, bytes((2, 0, 0, 6, 0)))


class Master:
    """The other end of a bus, at its baud rate."""

    def __init__(self, bus: ServoBus, speed: int = termios.B3000000) -> None:
        self.fd = os.open(bus.path, os.O_RDWR | os.O_NOCTTY)
        settings = termios.tcgetattr(self.fd)
        settings[4] = settings[5] = speed
        termios.tcsetattr(self.fd, termios.TCSANOW, settings)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self.fd)

    def send(self, data: bytes) -> None:
        os.write(self.fd, data)

    async def receive(self, size: int) -> bytes:
        loop, data = asyncio.get_running_loop(), b""
        while len(data) < size:
            ready = loop.create_future()
            loop.add_reader(self.fd, ready.set_result, None)
            try:
                await asyncio.wait_for(ready, DEADLINE_S)
            finally:
                loop.remove_reader(self.fd)
            data += os.read(self.fd, size - len(data))
        return data


@pytest.mark.parametrize(("late_s", "least_s"), [(0.0, 10 * ((14 + 17) * 10 / 57600 + 250 * 2e-6)), (0.03, 0.03)])
async def test_an_answer_is_not_earlier_than_wire_and_delay_allow(late_s: float, least_s: float) -> None:
    servo, loop = ServoModel(1, baud_bps=57600), asyncio.get_running_loop()
    servo.write(9, bytes((250,)))
    async with ServoBus([servo], wire_time=True) as bus:
        bus.answers_late_s = late_s
        with Master(bus, termios.B57600) as master:
            start_s = loop.time()
            master.send(_READ_MODEL * 10)
            assert await master.receive(17 * 10) == status(1, 0, servo.read(0, 6)) * 10
            assert loop.time() - start_s >= least_s


async def test_a_damaged_instruction_is_neither_executed_nor_answered() -> None:
    servo, damaged = ServoModel(1), asyncio.Event()
    async with ServoBus([servo], wire_time=False) as bus:

        def first_only() -> bool:
            is_first = not damaged.is_set()
            damaged.set()
            return is_first

        bus.damaged = first_only
        with Master(bus) as master:
            master.send(packet(1, bytes((3, 65, 0, 1))))
            await asyncio.wait_for(damaged.wait(), DEADLINE_S)
            master.send(_READ_MODEL)
            assert await master.receive(17) == status(1, 0, servo.read(0, 6))
    assert get(servo, 65, 1) == 0


async def test_bus_leaves_no_descriptor_and_no_device_behind() -> None:
    before = set(os.listdir("/proc/self/fd"))
    async with ServoBus([ServoModel(1)]) as bus:
        with Master(bus) as master:
            master.send(_PING)  # its answer falls due after the bus is gone
    assert set(os.listdir("/proc/self/fd")) == before
    assert not os.access(bus.path, os.F_OK)


async def test_bus_survives_a_master_that_never_reads() -> None:
    async with ServoBus([ServoModel(1)], wire_time=False) as bus, asyncio.timeout(DEADLINE_S):
        with Master(bus) as master:
            os.set_blocking(master.fd, False)  # the bus is on this loop: a write that waits would wait forever
            while not bus.dropped_bytes:
                with contextlib.suppress(BlockingIOError):
                    master.send(packet(1, bytes((2, 168, 0, 56, 0))) * 20)
                await asyncio.sleep(0)
            os.set_blocking(master.fd, True)
            termios.tcflush(master.fd, termios.TCIOFLUSH)
            bus.line.parser.drop_partial()
            master.send(_PING)
            await master.receive(len(status(1, 0, b"abc")))


def test_two_servos_with_one_id_answer_at_once_and_the_answer_is_unreadable() -> None:
    first, second, third = ServoModel(1), ServoModel(1), ServoModel(2)
    line = line_of(first, second, third)
    answer = line.feed(_PING)
    assert answer and not [found for found in PacketParser().feed(answer) if found.crc_ok]
    all_found = PacketParser().feed(line.feed(packet(0xFE, bytes((Instruction.PING,)))))
    assert [found.packet_id for found in all_found if found.crc_ok] == [2]
    assert not line.feed(packet(9, bytes((Instruction.PING,))))

    line.feed(packet(1, bytes((Instruction.WRITE, 7, 0, 5))))
    assert [servo.servo_id for servo in (first, second, third)] == [5, 5, 2], "both take what is written"
