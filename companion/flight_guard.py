"""What the flight tells the guardian in each tick. Pure but for the client that sends it."""

from __future__ import annotations

from companion.guardian.beat import Beat
from companion.guardian.client import GuardianClient
from companion.io.autopilot import LinkIdentity
from companion.types import AutopilotRequest, AutopilotStatus, Inputs, Outputs, PhaseKind

_IN_THE_AIR = frozenset({PhaseKind.TAKEOFF, PhaseKind.FLIGHT, PhaseKind.LANDING})
_PILOT_EVENT = "pilot_took_over"


class FlightGuard:
    """Beats of one flight.

    Args:
        client: to the guardian.
        identity: of the MAVLink link that the guardian would take over.
        origin_s: `time.monotonic` at zero of the flight clock.
    """

    def __init__(self, client: GuardianClient, identity: LinkIdentity, origin_s: float) -> None:
        self._client = client
        self._identity = identity
        self._origin_s = origin_s
        self._pilot = False
        self._pose_stamp_s = float("-inf")
        self._position_world_m = (0.0, 0.0, 0.0)
        self._last: Beat | None = None

    @property
    def ready(self) -> bool:
        """The guardian said within the last second that it could take over."""
        self._client.listen()
        return self._client.ready

    @property
    def would_take_over(self) -> bool:
        """If this process ended now, the guardian would land."""
        return self._last is not None and self._last.lifting and self.ready

    def tick(self, inputs: Inputs, outputs: Outputs) -> None:
        """At the end of a tick: what was decided has left."""
        self._pilot = self._pilot or any(event.id == _PILOT_EVENT for event in outputs.events)
        mocap = inputs.mocap
        if mocap is not None and mocap.tracking_valid and outputs.mocap_trusted:
            self._pose_stamp_s, self._position_world_m = mocap.stamp_s, mocap.position_world_m
        self._beat(inputs, outputs, goodbye=False)
        self._inputs, self._outputs = inputs, outputs

    def still_here(self) -> None:
        """Between ticks that do not come any more: this process sees to the landing itself."""
        if self._last is not None:
            self._client.beat(self._last)

    def goodbye(self, now: AutopilotStatus | None) -> None:
        """The flight is over. While PX4 is armed no goodbye is said: the guardian takes over once this process has ended.

        Args:
            now: PX4's newest status; None if it was never heard.
        """
        if self._last is not None and not (now is not None and now.armed):
            self._beat(self._inputs, self._outputs, goodbye=True)

    def _beat(self, inputs: Inputs, outputs: Outputs, *, goodbye: bool) -> None:
        armed = inputs.status is not None and inputs.status.armed
        # PX4 says once a second that it is armed: from the request on it may be.
        may_lift = armed or outputs.request is AutopilotRequest.ARM or outputs.phase_kind in _IN_THE_AIR
        ids = self._identity
        self._last = Beat(
            tick=inputs.tick,
            t_s=inputs.t_s,
            origin_s=self._origin_s,
            mission_t_s=outputs.mission_t_s,
            lifting=may_lift,
            pilot=self._pilot,
            goodbye=goodbye,
            autopilot_system=ids.autopilot_system,
            own_system=ids.own_system,
            own_component=ids.own_component,
            local_port=ids.local_port,
            pose_stamp_s=self._pose_stamp_s,
            position_world_m=self._position_world_m,
            peer=ids.peer,
        )
        self._client.beat(self._last)
