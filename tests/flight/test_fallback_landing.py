"""The hand-over to PX4 without the core."""

from __future__ import annotations

import asyncio
import socket
from dataclasses import dataclass, field

import pytest

from companion.flight.fallback_landing import land_without_core
from companion.model.types import AutopilotRequest, AutopilotStatus, FlightMode, LandedState, Outcome


@dataclass
class Link:
    """The far end of the hand-over: what was requested, in order."""

    requested: list[AutopilotRequest] = field(default_factory=list)
    seen: AutopilotStatus | None = None

    def status(self) -> AutopilotStatus | None:
        return self.seen

    def request(self, request: AutopilotRequest) -> None:
        self.requested.append(request)


@pytest.mark.parametrize("pilot", [False, True], ids=["nothing-heard", "a-pilot-was-heard-last"])
def test_landing_is_requested_until_px4_says_that_it_is_down_or_the_time_is_over(pilot: bool) -> None:
    manual = AutopilotStatus(heartbeat_stamp_s=0.0, armed=True, mode=FlightMode.MANUAL, landed=LandedState.IN_AIR)
    link = Link(seen=manual if pilot else None)
    times_s = iter([0.0, *(10.0 * n for n in range(9))])
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        outcome = asyncio.run(land_without_core(link, ours, lambda: next(times_s), None))
    assert outcome is Outcome.LOST
    assert len(link.requested) >= 2 and set(link.requested) == {AutopilotRequest.LAND}
