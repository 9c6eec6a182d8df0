"""Replies that arrive after their timeout, and servos that send without pause: the real dynamixel-sdk and bus code on a port in memory,
in simulated time.
"""

from __future__ import annotations

import itertools

import pytest

from companion.config.devices import ArmDevice
from companion.io.dynamixel import registers as dxl
from companion.io.dynamixel.bus import ArmBus
from sitl.servo.bus import ServoLine
from sitl.servo.model import ServoModel
from sitl.servo.protocol import status
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
        self.coming: list[tuple[float, bytes]] = []

    def write(self, sent: list[int] | bytes) -> int:
        held_up_s = HELD_UP_S if next(self.exchanges) == self._late_exchange else 0.0
        self._free_s = max(self._free_s, self.now_s + held_up_s) + REPLY_S
        self.coming.append((self._free_s, self.answer(bytes(sent))))
        return len(sent)

    def read(self, size: int) -> bytes:
        while self.coming and self.coming[0][0] <= self.now_s:
            self._waiting += self.coming.pop(0)[1]
        if not self._waiting and self.coming and self.coming[0][0] < self.now_s + 1e-3:
            self.now_s = self.coming[0][0]
            return self.read(size)
        return super().read(size)


def servos() -> ServoLine:
    models = [ServoModel(servo_id, baud_bps=3_000_000, shaft_angle_rad=3.1) for servo_id in IDS]
    for model, limit in zip(models, (900, 1000), strict=True):
        model.write(dxl.CURRENT_LIMIT.address, limit.to_bytes(2, "little"))
    return ServoLine(models)


def opened(late_exchange: int, earlier: bytes = b"") -> tuple[ArmBus, LateSerial]:
    """Open the bus; `earlier` arrives between the first request and its reply."""
    line = LateSerial(late_exchange)
    line.coming.append((0.5 * REPLY_S, earlier))
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


@pytest.mark.parametrize("data", [b"", bytes(range(dxl.BLOCK_SIZE))], ids=["a write", "a read in flight"])
def test_a_reply_to_an_earlier_user_of_the_port_is_not_taken_for_the_reply_to_a_ping(data: bytes) -> None:
    """As after a flight whose last requests were answered too late. Without the check the CRC was read: model 3233."""
    bus, _ = opened(-1, status(IDS[0], 0, data))
    assert bus.reports == SET_UP_REPORTS


def test_a_late_reply_to_a_read_does_not_confirm_that_torque_is_off() -> None:
    """A servo whose torque counts as off loses its watchdog, too."""
    bus, line = opened(-1)
    line.answer = lambda sent: b""
    line.coming += [(line.now_s, status(servo_id, 0, bytes(dxl.BLOCK_SIZE))) for servo_id in IDS]
    line.coming += [(line.now_s + 1e-3, status(servo_id, 0, bytes(dxl.BLOCK_SIZE))) for servo_id in IDS]
    assert bus._confirmed(dxl.TORQUE_ENABLE, 0) == []


@pytest.mark.parametrize("pause_s", [4e-5, 3e-4, 9e-4], ids=["without pause", "0.3 ms", "0.9 ms"])
@pytest.mark.parametrize(
    "packet", [status(IDS[0], 0, b"12345"), status(99, 0)], ids=["of another length", "of another id"]
)
def test_a_servo_that_sends_without_pause_delays_a_transaction_no_longer_than_a_silent_one(
    packet: bytes, pause_s: float
) -> None:
    """A read in flight took 0.3 s, in which no torque was sent and the bus watchdogs tripped; a broadcast ping took 16 s."""

    def of_reads(babble: bytes) -> list[float]:
        bus, line = opened(-1)
        line.answer = lambda sent: b""
        took_s: list[float] = []
        for transaction in (bus.read, lambda: bus._confirmed(dxl.TORQUE_ENABLE, 0), bus._servos.ping_all):
            start_s = line.now_s
            line.coming = [(start_s + k * pause_s, babble) for k in range(round(2.0 / pause_s))] if babble else []
            assert not transaction()
            took_s.append(line.now_s - start_s)
        return took_s

    for babbling_s, silent_s in zip(of_reads(packet), of_reads(b""), strict=True):
        assert babbling_s < 1.5 * silent_s


def test_a_read_in_flight_skips_the_late_reply_to_another_request() -> None:
    """The first bytes of a longer reply were taken for the joint's state, and a shorter one failed the read."""
    bus, line = opened(-1)
    answered = line.answer
    expected = bus.read()
    for data in (b"", bytes(range(1, 2 * dxl.BLOCK_SIZE))):
        line.answer = lambda sent, data=data: status(IDS[0], 0, data) + answered(sent)  # type: ignore[misc]
        assert bus.read() == expected is not None
