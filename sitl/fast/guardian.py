"""The guardian in the fast closed loop: its real monitoring and landing code on simulated time, over an in-memory link.

Killing the flight process and taking over its port are modelled only by the time that they take.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from companion.config.vehicle import Vehicle
from companion.flight.heartbeat import Heartbeats
from companion.guardian.heartbeat import Heartbeat
from companion.guardian.link import Link
from companion.guardian.monitors import StallWatch
from companion.guardian.process import PERIOD_S
from companion.guardian.takeover_landing import Notify, TakeoverLanding, notice
from companion.model.outputs import Outputs
from companion.model.types import Event, Inputs, LinkIdentity, MocapPose, Severity
from companion.safety.mocap import limits_of
from companion.safety.pose_filter import PoseFilter
from sitl.autopilot.autopilot import Px4Stub
from sitl.autopilot.receive import Receiver
from sitl.autopilot.streams import Schedule

TAKE_OVER_S = 0.03
"""Time from the decision to the first message: killing the flight process and opening its port."""
_OWN = (1, 191)


class MemoryWire:
    """The guardian's MAVLink connection to the stub, in memory."""

    lost = False

    def __init__(self, px4: Px4Stub) -> None:
        self.schedule = Schedule(False)
        self._px4 = px4
        self._receiver = Receiver(px4)
        self._end = _StubEnd(self)
        self._decoder = mavlink.MAVLink(None)
        self._encoder = mavlink.MAVLink(
            None, srcSystem=px4.params.integer("MAV_SYS_ID"), srcComponent=px4.params.integer("MAV_COMP_ID")
        )
        self._waiting: deque[bytes] = deque()

    # -- the guardian's end ----------------------------------------------------------------------------------------

    def fileno(self) -> int:
        """Return -1: there is no socket to wait for."""
        return -1

    @property
    def ready(self) -> bool:
        """Return whether PX4 was found; always True."""
        return True

    def send(self, data: bytes) -> bool:
        """Deliver MAVLink bytes to the stub at once."""
        for message in self._decoder.parse_buffer(data) or ():
            self._receiver.handle(self._end, message)
        return True

    def receive(self) -> list[tuple[float, bytes]]:
        """Return and clear the packets that the stub has sent; nobody asks when they arrived."""
        waiting = [(math.nan, data) for data in self._waiting]
        self._waiting.clear()
        return waiting

    def close(self) -> None:
        """Do nothing: there is no socket."""

    # -- the stub's end --------------------------------------------------------------------------------------------

    def pump(self, t_s: float) -> None:
        """Send the stub's telemetry streams that are due."""
        for message in self.schedule.messages(self._px4, t_s):
            self.post(message)

    def post(self, message: Any) -> None:
        """Queue one message of the stub."""
        self._waiting.append(message.pack(self._encoder))


class _StubEnd:
    """Receiver of the stub's answers."""

    def __init__(self, wire: MemoryWire) -> None:
        self._wire = wire
        self.schedule = wire.schedule

    def send(self, message: Any) -> None:
        self._wire.post(message)

    def send_all_params(self) -> None:
        """Do nothing: the guardian does not request parameters."""

    def note_ground_station(self) -> None:
        """Do nothing: there is no ground station."""

    def status_text(self, severity: int, text: str) -> None:
        """Drop the text: the guardian does not read it."""


class FastGuardian:
    """The guardian of one fast flight.

    Args:
        vehicle: vehicle file; provides the timeout and the height of the vehicle on the floor.
    """

    def __init__(self, vehicle: Vehicle, px4: Px4Stub) -> None:
        self._vehicle = vehicle
        self._px4 = px4
        self._watch = StallWatch(vehicle.safety.guardian_timeout_s)
        self._beat: Heartbeat | None = None
        system = px4.params.integer("MAV_SYS_ID")
        self._heartbeats = Heartbeats(
            LinkIdentity(autopilot_system=system, own_system=_OWN[0], own_component=_OWN[1], local_port=0), origin_s=0.0
        )
        self._round_s = 0.0
        self._pose_filter = PoseFilter(limits_of(vehicle.safety))
        self.events: list[Event] = []
        self.alive = True

    def heartbeat(self, inputs: Inputs, outputs: Outputs) -> None:
        """Process the heartbeat of one control tick of the flight process."""
        self._beat = self._heartbeats.of(inputs, outputs)

    def see(self, pose: MocapPose) -> None:
        """Learn the motion-capture server's clock from a pose that arrives in standby."""
        if self.alive:
            self._pose_filter.latency_s(pose)

    def decides_to_take_over(self, t_s: float, heard: bool, dead: bool) -> bool:
        """Return whether the guardian now takes over from the flight process, and record the event; call this method in every tick.

        Args:
            heard: whether a heartbeat arrived in this tick.
            dead: whether the flight process has ended.
        """
        if not self.alive or self._beat is None or not self._beat.lifting or t_s - self._round_s < PERIOD_S - 1e-9:
            return False
        self._round_s = t_s
        hangs = self._watch.update(t_s, heard)
        if not (hangs or dead):
            return False
        reason = (
            "the flight process died"
            if dead
            else f"the flight process hangs (silent for {self._watch.silent_s * 1e3:.0f} ms)"
        )
        text = f"{reason}; the guardian has taken over"
        self.events.append(notice(t_s, "guardian_took_over", Severity.CRITICAL, text))
        return True

    def take_over(self, t_s: float) -> Landing:
        """Take control of the vehicle and return the landing."""
        assert self._beat is not None
        return Landing(self._beat, self._vehicle, self._px4, self._pose_filter, t_s, self.events.append)


class Landing:
    """A landing that the guardian controls."""

    def __init__(
        self, beat: Heartbeat, vehicle: Vehicle, px4: Px4Stub, pose_filter: PoseFilter, t_s: float, notify: Notify
    ) -> None:
        self._wire = MemoryWire(px4)
        self._link = Link(self._wire, _OWN, beat.autopilot_system)
        clearance_m, tilt_max_rad = vehicle.airframe.ground_clearance_m, math.radians(vehicle.safety.tilt_abort_deg)
        self._landing = TakeoverLanding(
            beat,
            clearance_m,
            tilt_max_rad,
            pose_filter,
            self._link,
            t_s,
            notify,
            external=vehicle.devices.mocap.external,
        )
        self._round_s = float("-inf")

    @property
    def landed(self) -> bool | None:
        """Result of the landing, as in `TakeoverLanding.landed`."""
        return self._landing.landed

    def step(self, t_s: float, poses: list[MocapPose]) -> None:
        """Advance the landing; call this method in every step of the physics."""
        self._landing.take_poses(poses)
        if t_s - self._round_s >= PERIOD_S - 1e-9:
            self._round_s = t_s
            self._wire.pump(t_s)
            self._landing.take_messages(t_s, self._link.receive())
            self._landing.step(t_s)
