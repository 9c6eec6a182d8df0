"""The flight process's side of the guardian: messages sent and received."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator

import msgspec
import pytest

from companion.config.loader import load_flight
from companion.core.flight_core import FlightCore
from companion.flight.heartbeat import Heartbeats, HeartbeatSender
from companion.guardian import heartbeat
from companion.guardian.client import SILENT_S, GuardianClient
from companion.io.protocols import DeviceError
from companion.model.contact import ContactMode, ContactState
from companion.model.outputs import Outputs
from companion.model.types import (
    AutopilotRequest,
    AutopilotStatus,
    Event,
    FlightMode,
    Inputs,
    LandedState,
    LinkIdentity,
    OperatorCommand,
    PhaseKind,
    SafetyAction,
    Severity,
)
from companion.phases.contact import force as contact
from tests.guardian.landing_rig import beat
from tests.support import HOVER, level_pose

Pair = tuple[GuardianClient, socket.socket]
LINK = LinkIdentity(autopilot_system=1, own_system=1, own_component=195, local_port=14540, peer=("10.0.0.7", 14580))


class Clock:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def pair(clock: Clock) -> Iterator[Pair]:
    ours, guardian = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    guardian.setblocking(False)
    with ours, guardian:
        yield GuardianClient(ours, clock), guardian


def test_ready_is_a_word_of_the_last_second(pair: Pair, clock: Clock) -> None:
    client, guardian = pair
    client.listen()
    assert not client.ready
    guardian.send(heartbeat.READY)
    client.listen()
    assert client.ready
    clock.now_s += SILENT_S
    client.listen()
    assert not client.ready


def test_a_problem_ends_readiness_and_is_reported(pair: Pair) -> None:
    client, guardian = pair
    guardian.send(heartbeat.READY)
    guardian.send(heartbeat.PROBLEM + "mocap: ärger".encode())
    client.listen()
    assert not client.ready
    with pytest.raises(DeviceError, match=r"guardian: not ready within -1 s: mocap: ärger"):
        asyncio.run(client.wait_ready(-1.0))


async def test_a_guardian_that_says_nothing_for_ten_seconds_is_reported_as_silent(pair: Pair, clock: Clock) -> None:
    waiting = asyncio.create_task(pair[0].wait_ready())
    for step_s in (9.9, 0.2):
        await asyncio.sleep(0.05)
        assert not waiting.done()
        clock.now_s += step_s
    with pytest.raises(DeviceError, match=r"guardian: not ready within 10 s: it has sent no message; see guardian.log"):
        await waiting


def test_the_next_message_is_read_when_it_is_due(pair: Pair, clock: Clock) -> None:
    client, guardian = pair
    guardian.send(heartbeat.READY)
    client.listen()
    guardian.send(heartbeat.PROBLEM)
    client.listen()
    assert client.ready
    clock.now_s += heartbeat.READY_PERIOD_S
    client.listen()
    assert not client.ready


def test_a_dead_guardian_is_noticed_and_costs_nothing(pair: Pair) -> None:
    client, guardian = pair
    guardian.send(heartbeat.READY)
    guardian.close()
    client.listen()
    assert not client.ready
    client.send_heartbeat(beat())
    with pytest.raises(DeviceError, match="its process ended"):
        asyncio.run(client.wait_ready())


def test_a_guardian_that_does_not_read_never_blocks_the_flight(pair: Pair) -> None:
    client, guardian = pair
    for _ in range(20_000):  # far beyond what the socket holds
        client.send_heartbeat(beat())
    assert heartbeat.unpack(guardian.recv(heartbeat.MAX_BYTES)) == beat()


def inputs(*, armed: bool = False, tracking: bool = True) -> Inputs:
    status = AutopilotStatus(heartbeat_stamp_s=5.0, armed=armed, mode=FlightMode.OFFBOARD, landed=LandedState.IN_AIR)
    mocap = level_pose(4.9, position_world_m=(1.0, 2.0, 3.0), tracking_valid=tracking)
    return Inputs(tick=9, t_s=5.0, status=status, mocap=mocap, command=OperatorCommand.NONE, recorder_dropped=0)


def heard(t_s: float) -> Inputs:
    """Inputs with a heartbeat of this moment: PX4 is not armed."""
    status = inputs().status
    assert status is not None
    return msgspec.structs.replace(inputs(), t_s=t_s, status=msgspec.structs.replace(status, heartbeat_stamp_s=t_s))


@pytest.fixture(scope="module")
def waiting() -> Outputs:
    """Return the core's outputs on the ground, in the first tick."""
    airframe = {"vehicle.airframe.hover_thrust": 0.5}
    config = load_flight(HOVER, overrides=[f"{key}={value}" for key, value in airframe.items()])
    return FlightCore(config).step(inputs())


@pytest.mark.parametrize(
    ("armed", "request_", "kind", "lifting"),
    [
        (False, AutopilotRequest.NONE, PhaseKind.GROUND, False),
        (False, AutopilotRequest.OFFBOARD, PhaseKind.GROUND, False),
        (False, AutopilotRequest.ARM, PhaseKind.GROUND, True),
        (True, AutopilotRequest.NONE, PhaseKind.GROUND, True),
        (False, AutopilotRequest.NONE, PhaseKind.TAKEOFF, True),
        (True, AutopilotRequest.NONE, PhaseKind.FLIGHT, True),
        (False, AutopilotRequest.NONE, PhaseKind.LANDING, True),
        (True, AutopilotRequest.DISARM, PhaseKind.DONE, True),
        (False, AutopilotRequest.NONE, PhaseKind.DONE, False),
    ],
)
def test_a_heartbeat_says_whether_the_rotors_may_turn(
    pair: Pair, waiting: Outputs, armed: bool, request_: AutopilotRequest, kind: PhaseKind, lifting: bool
) -> None:
    client, guardian = pair
    guard = HeartbeatSender(client, LINK, 77.0)
    guard.tick(inputs(armed=armed), msgspec.structs.replace(waiting, request=request_, phase_kind=kind))
    sent = heartbeat.unpack(guardian.recv(heartbeat.MAX_BYTES))
    assert sent is not None
    assert sent.lifting is lifting
    assert (sent.tick, sent.t_s, sent.origin_s) == (9, 5.0, 77.0)
    assert (sent.autopilot_system, sent.own_system, sent.own_component, sent.local_port) == (1, 1, 195, 14540)
    assert sent.peer == ("10.0.0.7", 14580)
    assert (sent.pose_stamp_s, sent.position_world_m) == (4.9, (1.0, 2.0, 3.0))


def test_a_pilot_stays_one_and_a_rejected_pose_is_not_passed_on(pair: Pair, waiting: Outputs) -> None:
    client, guardian = pair
    guard = HeartbeatSender(client, LINK, 0.0)
    event = Event(
        t_s=5.0, id="pilot_took_over", severity=Severity.CRITICAL, action=SafetyAction.AUTOPILOT_LAND, text="a pilot"
    )
    guard.tick(inputs(tracking=False), msgspec.structs.replace(waiting, events=(event,)))
    guard.tick(inputs(), msgspec.structs.replace(waiting, mocap_trusted=False))
    guard.goodbye(inputs().status)
    beats = [heartbeat.unpack(guardian.recv(heartbeat.MAX_BYTES)) for _ in range(3)]
    assert [beat is not None and (beat.pilot, beat.goodbye, beat.pose_stamp_s) for beat in beats] == [
        (True, False, float("-inf")),
        (True, False, float("-inf")),
        (True, True, float("-inf")),
    ]


def test_the_rotors_may_start_for_as_long_as_px4_takes_to_say_that_it_is_armed(pair: Pair, waiting: Outputs) -> None:
    client, guardian = pair
    guard, lifting = HeartbeatSender(client, LINK, 0.0), []
    requests = {0.0: AutopilotRequest.ARM}
    for after_s in (0.0, 0.005, 1.4, 1.6):
        request_ = requests.get(after_s, AutopilotRequest.DISARM)
        seen = heard(5.0 + after_s)
        guard.tick(seen, msgspec.structs.replace(waiting, request=request_))
        beat = heartbeat.unpack(guardian.recv(heartbeat.MAX_BYTES))
        assert beat is not None
        lifting.append(beat.lifting)
    assert lifting == [True, True, True, False]


def test_until_px4_is_heard_after_the_request_to_arm_the_guardian_is_not_dismissed(
    pair: Pair, waiting: Outputs
) -> None:
    client, guardian = pair
    guard = HeartbeatSender(client, LINK, 0.0)
    guardian.send(heartbeat.READY)
    assert guard.ready
    guard.tick(heard(5.0), msgspec.structs.replace(waiting, request=AutopilotRequest.ARM))
    guard.tick(msgspec.structs.replace(inputs(), t_s=13.0), msgspec.structs.replace(waiting, phase_kind=PhaseKind.DONE))
    assert guard.goodbye(inputs().status)
    assert guard.goodbye(None)
    assert not guard.goodbye(heard(12.9).status)
    beats = [heartbeat.unpack(guardian.recv(heartbeat.MAX_BYTES)) for _ in range(5)]
    assert [beat is not None and beat.lifting for beat in beats] == [True, True, True, True, False]


def test_while_px4_may_be_armed_the_guardian_is_left_with_it_at_the_end(pair: Pair, waiting: Outputs) -> None:
    """Whatever the outcome, the guardian must stop turning rotors."""
    client, guardian = pair
    guard = HeartbeatSender(client, LINK, 0.0)
    guard.tick(inputs(armed=True), msgspec.structs.replace(waiting, phase_kind=PhaseKind.DONE))
    guard.goodbye(inputs(armed=True).status)
    guard.goodbye(inputs(armed=False).status, lost=True)
    guard.goodbye(inputs(armed=False).status)
    guard.goodbye(inputs(armed=True).status)
    beats = [heartbeat.unpack(guardian.recv(heartbeat.MAX_BYTES)) for _ in range(5)]
    assert [beat is not None and (beat.goodbye, beat.lifting) for beat in beats] == [
        (False, True), (True, True), (True, True), (True, False), (True, True)
    ]  # fmt: skip


@pytest.mark.parametrize("event_id", ["mocap_dragged", "mocap_two_streams", "mocap_swapped", "mocap_frozen"])
def test_motion_capture_is_refused_from_the_landing_for_it_until_it_is_trusted_again(
    waiting: Outputs, event_id: str
) -> None:
    heartbeats = Heartbeats(LINK, 0.0)
    bad = msgspec.structs.replace(waiting, mocap_trusted=False)
    landing = Event(
        t_s=5.0, id=event_id, severity=Severity.CRITICAL, action=SafetyAction.AUTOPILOT_LAND, text="not believed"
    )
    walk = [bad, waiting, msgspec.structs.replace(bad, events=(landing,)), bad, waiting, bad]
    assert [heartbeats.of(inputs(armed=True), outputs).mocap_refused for outputs in walk] == [
        False,  # a single pose that jumps or repeats itself
        False,
        True,
        True,
        False,
        True,
    ]


def test_the_way_back_from_a_surface_stays_until_a_landing_has_flown_it(waiting: Outputs) -> None:
    heartbeats = Heartbeats(LINK, 0.0)
    touching = contact.entered(contact.begun(4.0, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0)), 4.5, ContactMode.PRESS)
    returning = contact.entered(touching, 4.6, ContactMode.RETURN)

    def back_m(state: ContactState | None, x_m: float) -> float | None:
        now = inputs(armed=True)
        assert now.mocap is not None
        pose = msgspec.structs.replace(now.mocap, position_world_m=(x_m, 0.0, 1.0))
        outputs = msgspec.structs.replace(waiting, contact=state)
        way = heartbeats.of(msgspec.structs.replace(now, mocap=pose), outputs).back_world_m
        return None if way is None else way[0]

    assert back_m(touching, 1.0) == -0.2  # LAND replaces the mission in the next tick
    assert [back_m(None, x_m) for x_m in (1.0, 0.875, 0.81, 0.9)] == [-0.2, pytest.approx(-0.075), None, None]
    assert back_m(returning, 1.0) == -0.2 and back_m(None, 1.0) is None  # a contact that ended in the air
