"""The MAVLink link of the fast closed loop when it is faulty: dead, or slow both ways."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from msgspec.structs import replace

from companion.model.types import AutopilotStatus, VehicleState
from sitl.autopilot.autopilot import Px4Stub
from sitl.faults.injector import Faults
from sitl.world.world import World

MEMORY = 400
"""Ticks that the link may hold back."""


class FastLink:
    """Between the core and the stub.

    Args:
        faults: of the world.
        world: for the time.
        px4: the other end; while it boots there is none.
        tick_s: from one control tick to the next.
    """

    def __init__(self, faults: Faults, world: World, px4: Px4Stub, tick_s: float) -> None:
        self._faults, self._world, self._px4, self._tick_s = faults, world, px4, tick_s
        self._on_their_way: deque[tuple[float, Callable[[], None]]] = deque()
        self._told: deque[tuple[VehicleState | None, AutopilotStatus]] = deque(maxlen=MEMORY)
        """What PX4 said in the last ticks, the newest first."""

    @property
    def alive(self) -> bool:
        """What is sent arrives, sooner or later."""
        return "link_loss" not in self._faults.active and self._world.t_s >= self._px4.booted_at_s

    def send(self, deliver: Callable[[], None]) -> None:
        """To PX4; `deliver` is called when it arrives."""
        if not self.alive:
            return
        delay_s = self._faults.size("link_delay")
        if delay_s or self._on_their_way:
            self._on_their_way.append((self._world.t_s + delay_s, deliver))
        else:
            deliver()

    def deliver_late(self) -> None:
        """What arrives now. To be called in every tick."""
        late, t_s = self._on_their_way, self._world.t_s
        while late and late[0][0] <= t_s + 1e-9:
            deliver = late.popleft()[1]
            if self.alive:
                deliver()

    def hear(self, state: VehicleState | None, status: AutopilotStatus) -> tuple[VehicleState | None, AutopilotStatus]:
        """What the core hears in this tick, of what PX4 says now: late if the link is slow, the last of it if the link is dead."""
        told = self._told
        if not self.alive and told:
            return told[0]
        if state is None and told:
            state = told[0][0]
        told.appendleft((state, status))
        delay_s = self._faults.size("link_delay")
        if not delay_s:
            return state, status
        state, status = told[min(len(told) - 1, round(delay_s / self._tick_s))]
        if state is not None:  # stamps are of the arrival
            state = replace(
                state,
                position_stamp_s=state.position_stamp_s + delay_s,
                attitude_stamp_s=state.attitude_stamp_s + delay_s,
                imu_stamp_s=state.imu_stamp_s + delay_s,
            )
        return state, replace(status, heartbeat_stamp_s=status.heartbeat_stamp_s + delay_s)
