"""The MAVLink link of the fast closed loop, with its faults: loss, or a delay in both directions."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from msgspec.structs import replace

from companion.model.types import AutopilotRequest, AutopilotStatus, VehicleState
from sitl.autopilot.autopilot import Px4Stub
from sitl.autopilot.commander import FORCE_MAGIC, Command
from sitl.autopilot.modes import NavState
from sitl.autopilot.types import Command7
from sitl.faults.injector import Faults
from sitl.world.scene import Scene

MEMORY = 400
"""Longest possible delay of received states, in control ticks."""
_OFFBOARD_MODE: Command7 = (1.0, 6.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_NOTHING: Command7 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class FastLink:
    """The link between the flight core and the stub.

    Args:
        faults: faults of the world; None if there are none, and messages then arrive at once.
        px4: the stub; while it boots, the link is dead.
    """

    def __init__(self, faults: Faults | None, scene: Scene, px4: Px4Stub, tick_s: float) -> None:
        self._faults, self._scene, self._px4, self._tick_s = faults, scene, px4, tick_s
        self._in_flight: deque[tuple[float, Callable[[], object]]] = deque()
        self._received: deque[tuple[VehicleState | None, AutopilotStatus | None]] = deque(maxlen=MEMORY)
        """States that PX4 sent in the last ticks, newest first."""
        self._behind = 0
        """Delay of the state received last, in ticks: while the delay grows nothing arrives, because messages keep their order."""
        self._last: tuple[VehicleState | None, AutopilotStatus | None] = (None, None)

    @property
    def alive(self) -> bool:
        """Whether messages arrive."""
        faults = self._faults
        return faults is None or ("link_loss" not in faults.active and self._scene.t_s >= self._px4.booted_at_s)

    def send(self, deliver: Callable[[], object]) -> None:
        """Send a message to PX4; `deliver` is called when the message arrives."""
        if not self.alive:
            return
        delay_s = 0.0 if self._faults is None else self._faults.size("link_delay")
        if delay_s or self._in_flight:
            self._in_flight.append((self._scene.t_s + delay_s, deliver))
        else:
            deliver()

    def request(self, request: AutopilotRequest) -> None:
        """Send the command of a request to PX4."""
        self.send(lambda: self._execute(request))

    def _execute(self, request: AutopilotRequest) -> None:
        t_s, px4 = self._scene.t_s, self._px4
        if request is AutopilotRequest.OFFBOARD:
            px4.on_command(t_s, Command.DO_SET_MODE, _OFFBOARD_MODE)
        elif request is AutopilotRequest.ARM:
            px4.on_command(t_s, Command.COMPONENT_ARM_DISARM, (1.0, *_NOTHING[1:]))
        elif request is AutopilotRequest.LAND and px4.nav_state is not NavState.LAND:
            px4.on_command(t_s, Command.NAV_LAND, _NOTHING)
        elif request is AutopilotRequest.DISARM:
            px4.on_command(t_s, Command.COMPONENT_ARM_DISARM, _NOTHING)
        elif request is AutopilotRequest.FORCE_DISARM:
            px4.on_command(t_s, Command.COMPONENT_ARM_DISARM, (0.0, float(FORCE_MAGIC), *_NOTHING[2:]))

    def deliver_due(self) -> None:
        """Deliver delayed messages that are due; call this method in every tick."""
        late, t_s = self._in_flight, self._scene.t_s
        while late and late[0][0] <= t_s + 1e-9:
            deliver = late.popleft()[1]
            if self.alive:
                deliver()

    def receive(
        self, state: VehicleState | None, status: AutopilotStatus | None
    ) -> tuple[VehicleState | None, AutopilotStatus | None]:
        """Return what the core receives in this tick: a delayed state on a slow link, the last received one on a lost link."""
        if self._faults is None:
            return state, status
        received = self._received
        if not self.alive and received:
            return received[0]
        if state is None and received:
            state = received[0][0]
        received.appendleft((state, status))
        delay_s = self._faults.size("link_delay")
        behind = min(len(received) - 1, round(delay_s / self._tick_s))
        if behind > self._behind:
            self._behind += 1
            return self._last
        self._behind = behind
        state, status = received[behind]
        if state is not None and delay_s:  # stamps are arrival times
            state = replace(
                state,
                position_stamp_s=state.position_stamp_s + delay_s,
                attitude_stamp_s=state.attitude_stamp_s + delay_s,
                imu_stamp_s=state.imu_stamp_s + delay_s,
            )
        if status is not None and delay_s:
            status = replace(status, heartbeat_stamp_s=status.heartbeat_stamp_s + delay_s)
        self._last = (state, status)
        return self._last
