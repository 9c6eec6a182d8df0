"""The computed time of a bus cycle is that of the bytes which the SDK and the servos exchange."""

from __future__ import annotations

import pytest
from dynamixel_sdk import COMM_SUCCESS, PacketHandler

from companion.io.dynamixel import registers as dxl
from companion.io.dynamixel.registers import cycle_bytes, cycle_s
from sitl.servo.bus import ServoLine
from sitl.servo.model import ServoModel


class CountingPort:
    """A port of the SDK whose wire ends at emulated servos; counts the bytes in both directions."""

    def __init__(self, count: int) -> None:
        self._line = ServoLine([ServoModel(servo_id) for servo_id in range(1, count + 1)])
        self._answer = b""
        self.is_using = False
        self.bytes = 0

    def writePort(self, packet: list[int]) -> int:
        self._answer += self._line.feed(bytes(packet))
        self.bytes += len(packet)
        return len(packet)

    def readPort(self, length: int) -> bytes:
        data, self._answer = self._answer[:length], self._answer[length:]
        self.bytes += len(data)
        return data

    def clearPort(self) -> None: ...

    def setPacketTimeout(self, _: int) -> None: ...

    def isPacketTimeout(self) -> bool:
        return False


@pytest.mark.parametrize("count", [1, 2, 7])
def test_a_cycle_has_the_computed_number_of_bytes(count: int) -> None:
    port, protocol, ids = CountingPort(count), PacketHandler(2.0), list(range(1, count + 1))
    assert protocol.syncReadTx(port, dxl.INDIRECT_DATA_1, dxl.BLOCK_SIZE, ids, count, False) == COMM_SUCCESS
    for servo_id in ids:
        data, result, _ = protocol.readRx(port, servo_id, dxl.BLOCK_SIZE)
        assert (len(data), result) == (dxl.BLOCK_SIZE, COMM_SUCCESS)
    port.is_using = False
    goals = [value for servo_id in ids for value in (servo_id, 10, 0)]
    protocol.syncWriteTxOnly(port, dxl.GOAL_CURRENT.address, dxl.GOAL_CURRENT.size, goals, len(goals))
    assert port.bytes == cycle_bytes(count)


def test_seven_servos_at_the_factory_rate_take_eight_control_ticks() -> None:
    assert cycle_s(7, 57_600) == pytest.approx(0.0389, rel=0.01)
    assert cycle_s(7, 1_000_000) == pytest.approx(0.00224)
