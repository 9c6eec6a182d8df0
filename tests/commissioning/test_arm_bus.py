"""The commissioning tools' conversation with a servo over a pty on which packets are lost or damaged."""

from __future__ import annotations

import itertools
import os
import tty

import pytest

from companion.commissioning.arm.bus import ServoTalk
from companion.io.dynamixel import registers as dxl
from companion.io.protocols import DeviceError
from sitl.servo.bus import ServoBus
from sitl.servo.model import ServoModel
from tests.commissioning.arm_rig import served

BAUD = 3_000_000


class LossyBus(ServoBus):
    """Loses the first instructions of every group of `lost` + 1."""

    def __init__(self, lost: int) -> None:
        super().__init__([ServoModel(1, baud_bps=BAUD)])
        self._lost, self._number = lost, itertools.count()

    def answer_to(self, data: bytes, baud_bps: int) -> tuple[bytes, float]:
        if next(self._number) % (self._lost + 1) < self._lost:
            return b"", 0.0
        return super().answer_to(data, baud_bps)


def damaging() -> ServoBus:
    """The first two of every three instructions are damaged; the servo answers them with its CRC error."""
    bus, number = ServoBus([ServoModel(1, baud_bps=BAUD)]), itertools.count()
    bus.damaged = lambda: next(number) % 3 < 2
    return bus


@pytest.mark.parametrize("bus", [LossyBus(2), damaging()], ids=["lost", "damaged"])
def test_two_lost_or_damaged_packets_are_repeated(bus: ServoBus) -> None:
    with served(bus) as port, ServoTalk(port) as talk:
        talk.open(BAUD)
        assert talk.ping(1) is not None
        talk.write(1, dxl.RETURN_DELAY, 7)
        assert talk.read(1, dxl.RETURN_DELAY) == 7


def test_a_servo_that_misses_every_packet_but_the_last_does_not_answer() -> None:
    with served(LossyBus(10)) as port, ServoTalk(port) as talk:
        talk.open(BAUD)
        with pytest.raises(DeviceError, match="no answer at 3000000 baud"):
            talk.read(1, dxl.RETURN_DELAY)


def test_a_port_that_goes_away_is_one_error_of_the_device() -> None:
    far, near = os.openpty()
    tty.setraw(near)
    with ServoTalk(os.ttyname(near)) as talk:
        talk.open(BAUD)
        os.close(near)
        os.close(far)
        for attempt in (lambda: talk.ping(1), lambda: talk.read(1, dxl.MODEL), talk.answers_to_ping):
            with pytest.raises(DeviceError, match="the port failed"):
                attempt()
