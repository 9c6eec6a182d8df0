"""Replies that arrive after their timeout: the real dynamixel-sdk and bus code on a port in memory, in simulated time."""

from __future__ import annotations

import itertools

import pytest

from companion.config.devices import ArmDevice
from companion.io.dynamixel import registers as dxl
from companion.io.dynamixel.bus import ArmBus
from sitl.servo.bus import ServoLine
from sitl.servo.model import ServoModel
from tests.fuzz.dynamixel import IDS, WIDE, MemoryPort, MemorySerial
from tests.io.arm_rig import arm_config

HELD_UP_S = 0.15
"""Longer than the timeout, shorter than the timeout and the pause after it."""
REPLY_S = 5e-4


class LateSerial(MemorySerial):
    """A port whose servos are held up once, at an exchange counted from 0; then they reply to all requests in turn."""

    def __init__(self, late_exchange: int) -> None:
        super().__init__()
        self.exchanges = itertools.count()
        self._late_exchange = late_exchange
        self._free_s = 0.0
        self._coming: list[tuple[float, bytes]] = []

    def write(self, sent: list[int] | bytes) -> int:
        held_up_s = HELD_UP_S if next(self.exchanges) == self._late_exchange else 0.0
        self._free_s = max(self._free_s, self.now_s + held_up_s) + REPLY_S
        self._coming.append((self._free_s, self.answer(bytes(sent))))
        return len(sent)

    def read(self, size: int) -> bytes:
        while self._coming and self._coming[0][0] <= self.now_s:
            self._waiting += self._coming.pop(0)[1]
        return super().read(size)


def servos() -> ServoLine:
    models = [ServoModel(servo_id, baud_bps=3_000_000, shaft_angle_rad=3.1) for servo_id in IDS]
    for model, limit in zip(models, (900, 1000), strict=True):
        model.write(dxl.CURRENT_LIMIT.address, limit.to_bytes(2, "little"))
    return ServoLine(models)


def opened(late_exchange: int) -> tuple[ArmBus, LateSerial]:
    line = LateSerial(late_exchange)
    line.answer = servos().feed
    bus = ArmBus(ArmDevice(port="memory"), arm_config(*WIDE), aborted=lambda: False)
    bus._port = bus._servos.port = MemoryPort(line)
    bus.open(30.0)
    return bus, line


_, QUIET = opened(-1)
EXCHANGES = next(QUIET.exchanges)
SET_UP_REPORTS = opened(-1)[0].reports


@pytest.mark.parametrize("late_exchange", range(EXCHANGES))
def test_a_late_reply_is_not_taken_for_the_reply_to_the_next_request(late_exchange: int) -> None:
    bus, line = opened(late_exchange)
    assert bus.reports == SET_UP_REPORTS
    assert [report.current_limit_counts for report in bus.reports] == [900, 1000]
    assert EXCHANGES <= next(line.exchanges) <= EXCHANGES + 1
