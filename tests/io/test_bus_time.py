"""The computed time of a bus cycle is that of the bytes which the SDK and the servos exchange."""

from __future__ import annotations

import pytest
from dynamixel_sdk import COMM_SUCCESS, PacketHandler

from companion.io.dynamixel import packets
from companion.io.dynamixel import registers as dxl
from companion.io.dynamixel.registers import cycle_bytes, cycle_s
from sitl.servo.bus import ServoLine
from sitl.servo.model import ServoModel
from tests.fuzz.dynamixel import MemoryPort, MemorySerial

ANSWER_BYTES = packets.STATUS_BYTES + dxl.BLOCK_SIZE


class Line(MemorySerial):
    """A line with emulated servos; keeps what was sent and answered."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.answer = ServoLine([ServoModel(servo_id) for servo_id in range(1, count + 1)]).feed
        self.sent: list[bytes] = []
        self.answers: list[bytes] = []

    def write(self, sent: list[int] | bytes) -> int:
        before = len(self._waiting)
        written = super().write(sent)
        self.sent.append(bytes(sent))
        self.answers.append(bytes(self._waiting[before:]))
        return written


@pytest.mark.parametrize("count", [1, 2, 7])
def test_a_cycle_has_the_computed_number_of_bytes_and_is_that_of_the_sdk(count: int) -> None:
    line, protocol, ids = Line(count), PacketHandler(2.0), list(range(1, count + 1))
    port = MemoryPort(line)
    port.setupPort(57_600)
    assert protocol.syncReadTx(port, dxl.INDIRECT_DATA_1, dxl.BLOCK_SIZE, ids, count, False) == COMM_SUCCESS
    assert line.sent[-1] == packets.sync_read(dxl.INDIRECT_DATA_1, dxl.BLOCK_SIZE, ids)
    answers = line.answers[-1]
    for i, servo_id in enumerate(ids):
        data, result, error = protocol.readRx(port, servo_id, dxl.BLOCK_SIZE)
        assert (len(data), result) == (dxl.BLOCK_SIZE, COMM_SUCCESS)
        packet = answers[i * ANSWER_BYTES : (i + 1) * ANSWER_BYTES]
        assert packets.status_data(packet, servo_id, dxl.BLOCK_SIZE) == (bytes(data), error)
        assert packets.status_data(packet, servo_id + 1, dxl.BLOCK_SIZE) is None
        assert packets.status_data(packet, servo_id, dxl.BLOCK_SIZE - 1) is None
        assert packets.status_data(packet[:-1], servo_id, dxl.BLOCK_SIZE) is None
        assert packets.status_data(packet + b"x", servo_id, dxl.BLOCK_SIZE) is None
        for at in range(ANSWER_BYTES):
            damaged = packet[:at] + bytes([packet[at] ^ 1]) + packet[at + 1 :]
            assert packets.status_data(damaged, servo_id, dxl.BLOCK_SIZE) is None
    port.is_using = False
    goals = [-1 - servo_id for servo_id in ids]
    parameters = [value for i, goal in zip(ids, goals, strict=True) for value in (i, goal & 0xFF, goal >> 8 & 0xFF)]
    protocol.syncWriteTxOnly(port, dxl.GOAL_CURRENT.address, dxl.GOAL_CURRENT.size, parameters, len(parameters))
    assert line.sent[-1] == packets.sync_write_int16(dxl.GOAL_CURRENT.address, ids, goals)
    assert sum(map(len, line.sent + line.answers)) == cycle_bytes(count)


def test_seven_servos_at_the_factory_rate_take_eight_control_ticks() -> None:
    assert cycle_s(7, 57_600) == pytest.approx(0.0389, rel=0.01)
    assert cycle_s(7, 1_000_000) == pytest.approx(0.00224)
