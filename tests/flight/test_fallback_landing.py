"""The hand-over to PX4 without the core."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from dataclasses import dataclass, field
from functools import partial

import pytest
from msgspec.structs import replace

from companion.flight.fallback_landing import land_without_core
from companion.flight.heartbeat import HeartbeatSender
from companion.guardian.client import GuardianClient
from companion.guardian.heartbeat import MAX_BYTES, READY, unpack
from companion.model.types import AutopilotRequest, AutopilotStatus, FlightMode, LandedState, LinkIdentity, Outcome


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


@pytest.mark.parametrize("disarms", [False, True], ids=["px4-stays-armed", "px4-disarms"])
def test_a_vehicle_that_is_found_armed_and_cannot_be_recorded_has_a_guardian(disarms: bool) -> None:
    """It hears of the vehicle in the air before the first request to land, and is dismissed only once PX4 has disarmed."""
    armed = AutopilotStatus(heartbeat_stamp_s=0.0, armed=True, mode=FlightMode.LAND, landed=LandedState.IN_AIR)
    link = Link(seen=armed)
    peer = ("127.0.0.1", 14540)
    identity = LinkIdentity(autopilot_system=1, own_system=1, own_component=191, local_port=14550, peer=peer)
    times_s = iter([0.0, *(10.0 * n for n in range(9))])
    pair = partial(socket.socketpair, socket.AF_UNIX, socket.SOCK_SEQPACKET)
    (ours, launcher), (client_end, guardian_end) = pair(), pair()
    with ours, launcher, client_end, guardian_end:
        guardian_end.send(READY)
        guardian = HeartbeatSender(GuardianClient(client_end, lambda: 1.0), identity, 5.0)
        guardian.begin_without_core(1.0, armed)
        outcome = asyncio.run(land_without_core(link, ours, lambda: next(times_s), guardian))
        if disarms:
            link.seen = replace(armed, armed=False, heartbeat_stamp_s=2.0)
        takes_over = guardian.goodbye(link.seen, lost=not disarms)
        heard = []
        guardian_end.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                heard.append(unpack(guardian_end.recv(MAX_BYTES)))
    assert outcome is Outcome.LOST
    *during, last = heard
    assert len(during) > 2 and all(one is not None and one.lifting and not one.goodbye for one in during)
    assert during[0] is not None and (during[0].peer, during[0].origin_s, during[0].pilot) == (peer, 5.0, False)
    assert last is not None and last.goodbye and last.lifting is not disarms and takes_over is not disarms
