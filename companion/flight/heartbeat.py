"""Heartbeats of the flight process to the guardian, one per tick. Pure except for the client that sends them."""

from __future__ import annotations

import msgspec

from companion.core.sequence import may_be_armed
from companion.guardian.client import GuardianClient
from companion.guardian.heartbeat import Heartbeat
from companion.model.best_pose import best_pose, pose_used_s
from companion.model.contact import ContactMode, ContactState
from companion.model.flight_stage import PILOT_FLIES, flown_by_pilot
from companion.model.outputs import Outputs
from companion.model.types import (
    IDENTITY_QUAT,
    AutopilotRequest,
    AutopilotStatus,
    Inputs,
    LinkIdentity,
    PhaseKind,
    Vec3,
)
from companion.phases.contact.force import way_back_m
from companion.safety.device_rules import MOCAP_DRAGGED, MOCAP_FROZEN, MOCAP_SWAPPED, MOCAP_TWO_STREAMS, PILOT_TOOK_OVER

_IN_THE_AIR = frozenset({PhaseKind.TAKEOFF, PhaseKind.FLIGHT, PhaseKind.LANDING})
_REFUSALS = frozenset({MOCAP_DRAGGED, MOCAP_FROZEN, MOCAP_SWAPPED, MOCAP_TWO_STREAMS})
"""Events after which PX4 lands because motion capture is rejected."""
_FLOWN_SHARE = 0.1
"""Share of the way back from a surface that may be left when it counts as flown."""


class Heartbeats:
    """Builds the heartbeats of one flight. Pure.

    Args:
        identity: identity of the MAVLink link that the guardian would take over.
        origin_s: `companion.runtime.clock.monotonic` when the flight clock was zero.
    """

    def __init__(self, identity: LinkIdentity, origin_s: float) -> None:
        self._identity = identity
        self._origin_s = origin_s
        self._pilot = False
        self._arm_s = float("-inf")
        """When arming was last requested."""
        self._lands_without_mocap = False
        """Whether an event of `_REFUSALS` has occurred. From then on, an untrusted pose means that motion capture is rejected, not
        merely that a single pose is invalid.
        """
        self._pose_stamp_s = float("-inf")
        self._position_world_m, self._attitude_wxyz = (0.0, 0.0, 0.0), IDENTITY_QUAT
        self._left: tuple[Vec3, Vec3] | None = None
        """Way back from a surface, and where it begins, while a landing or a retract that has replaced the mission may still fly it."""

    def of(self, inputs: Inputs, outputs: Outputs, partner_session: int = 0) -> Heartbeat:
        """Return the heartbeat of a tick; call it in every tick.

        Args:
            partner_session: session of the other vehicle of a team; 0 for a vehicle that flies alone.
        """
        ids = {event.id for event in outputs.events}
        self._pilot = self._pilot or PILOT_TOOK_OVER in ids or outputs.phase == PILOT_FLIES
        self._lands_without_mocap = self._lands_without_mocap or not ids.isdisjoint(_REFUSALS)
        pose_s, pose = pose_used_s(inputs), best_pose(inputs)
        if pose_s is not None and pose is not None and outputs.mocap_trusted:
            self._pose_stamp_s = pose_s
            self._position_world_m, self._attitude_wxyz = pose.position_world_m, pose.attitude_wxyz
        # PX4 reports only once a second whether it is armed, so it may be armed as soon as arming is requested.
        if outputs.request is AutopilotRequest.ARM:
            self._arm_s = inputs.t_s
        may_lift = self.may_be_armed(inputs.status, inputs.t_s) or outputs.phase_kind in _IN_THE_AIR
        return self._heartbeat(
            inputs.tick,
            inputs.t_s,
            outputs.mission_t_s,
            lifting=may_lift,
            pilot=self._pilot,
            mocap_refused=self._lands_without_mocap and not outputs.mocap_trusted,
            partner_session=partner_session,
            back_world_m=self._back_world_m(outputs.contact),
        )

    def found_armed(self, t_s: float, status: AutopilotStatus | None) -> Heartbeat:
        """Return the heartbeat of a process that lands a vehicle that it has found armed, without the core."""
        return self._heartbeat(0, t_s, 0.0, lifting=True, pilot=flown_by_pilot(status))

    def _heartbeat(
        self,
        tick: int,
        t_s: float,
        mission_t_s: float,
        *,
        lifting: bool,
        pilot: bool,
        mocap_refused: bool = False,
        partner_session: int = 0,
        back_world_m: Vec3 | None = None,
    ) -> Heartbeat:
        link = self._identity
        return Heartbeat(
            tick=tick,
            t_s=t_s,
            origin_s=self._origin_s,
            mission_t_s=mission_t_s,
            lifting=lifting,
            pilot=pilot,
            goodbye=False,
            mocap_refused=mocap_refused,
            autopilot_system=link.autopilot_system,
            own_system=link.own_system,
            own_component=link.own_component,
            local_port=link.local_port,
            pose_stamp_s=self._pose_stamp_s,
            position_world_m=self._position_world_m,
            attitude_wxyz=self._attitude_wxyz,
            peer=link.peer,
            partner_session=partner_session,
            back_world_m=back_world_m,
        )

    def may_be_armed(self, status: AutopilotStatus | None, t_s: float) -> bool:
        """Return whether PX4 is armed, or may be since the last request to arm."""
        return may_be_armed(status, t_s, self._arm_s)

    def _back_world_m(self, contact: ContactState | None) -> Vec3 | None:
        """Return the way back from the surface that the tool may touch; None if it touches none."""
        if contact is not None:
            way = way_back_m(contact)
            self._left = None if contact.mode is ContactMode.RETURN else (way, self._position_world_m)
            return way
        if self._left is None:
            return None
        way, begin = self._left
        moved = (now - then for now, then in zip(self._position_world_m, begin, strict=True))
        share = 1.0 - sum(w * m for w, m in zip(way, moved, strict=True)) / sum(w * w for w in way)
        if share <= _FLOWN_SHARE:
            self._left = None
            return None
        x, y, z = way
        return (share * x, share * y, share * z)


class HeartbeatSender:
    """The flight process's connection to the guardian; sends it a heartbeat in each tick.

    Args:
        identity: identity of the MAVLink link that the guardian would take over.
        origin_s: `companion.runtime.clock.monotonic` when the flight clock was zero.
    """

    def __init__(self, client: GuardianClient, identity: LinkIdentity, origin_s: float) -> None:
        self._client = client
        self._heartbeats = Heartbeats(identity, origin_s)
        self._last: Heartbeat | None = None

    @property
    def ready(self) -> bool:
        """Return whether the guardian reported within the last second that it could take over."""
        self._client.listen()
        return self._client.ready

    @property
    def would_take_over(self) -> bool:
        """Return whether the guardian would land if this process ended now."""
        return self._last is not None and self._last.lifting and self.ready

    def tick(self, inputs: Inputs, outputs: Outputs, partner_session: int = 0) -> None:
        """Send the heartbeat at the end of a tick, after its setpoint; `partner_session` as for `Heartbeats.of`."""
        self._last = self._heartbeats.of(inputs, outputs, partner_session)
        self._client.send_heartbeat(self._last)

    def begin_without_core(self, t_s: float, status: AutopilotStatus | None) -> None:
        """Send the first heartbeat of a process that lands a vehicle that it has found armed, without the core."""
        self._last = self._heartbeats.found_armed(t_s, status)
        self._client.send_heartbeat(self._last)

    def still_here(self) -> None:
        """Send a heartbeat after the last tick, while this process lands the vehicle itself."""
        if self._last is not None:
            self._client.send_heartbeat(self._last)

    def goodbye(self, now: AutopilotStatus | None, *, lost: bool = False) -> bool:
        """Send the guardian a final heartbeat; return whether it takes over, because PX4 may be armed.

        Args:
            now: PX4's newest status; None if none was received.
            lost: whether the flight does not know what became of the vehicle.
        """
        if self._last is None:
            return False
        armed = (lost and self._last.lifting) or self._heartbeats.may_be_armed(now, self._last.t_s)
        self._last = msgspec.structs.replace(self._last, goodbye=True, lifting=armed)
        self._client.send_heartbeat(self._last)
        return armed and self.ready
