"""The hand-over to PX4: setpoints end before LAND is requested, whatever the link does."""

from __future__ import annotations

import asyncio
import socket
from dataclasses import dataclass, field

import pytest

from companion.flight.fallback_landing import land_without_core
from companion.model.types import AttitudeSetpoint, AutopilotRequest, AutopilotStatus, Outcome


@dataclass
class Link:
    """The far end of the hand-over: what left, in order. PX4 is disarmed from the second request on."""

    breaks: bool
    left: list[object] = field(default_factory=list)

    def status(self) -> AutopilotStatus | None:
        return None

    def send_attitude(self, setpoint: AttitudeSetpoint | None) -> bool:
        self.left.append(setpoint)
        if self.breaks:
            raise RuntimeError("the link broke")
        return False

    def request(self, request: AutopilotRequest) -> None:
        self.left.append(request)


@pytest.mark.parametrize("breaks", [False, True])
def test_setpoints_end_before_landing_is_requested(breaks: bool) -> None:
    """MAVSDK's Offboard plugin repeats the last setpoint by itself, which keeps PX4's own failsafe from acting."""
    link = Link(breaks)
    times_s = iter([0.0, *(10.0 * n for n in range(9))])
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        outcome = asyncio.run(land_without_core(link, ours, lambda: next(times_s), None))
    assert outcome is Outcome.LOST
    assert link.left[:2] == [None, AutopilotRequest.LAND]
