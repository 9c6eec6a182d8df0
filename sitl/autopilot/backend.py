"""The autopilot's end of the simulated world: what the world's server needs of it, and the stub's way of giving it.

The other way is a real PX4: `sitl.px4.backend`.
"""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager
from typing import Any, NamedTuple, Protocol

from companion.model.types import Vec4
from companion.sitl_config.world import World as WorldConfig
from sitl.autopilot.autopilot import Battery, Px4Stub, gains_from_params
from sitl.autopilot.cascade import Cascade
from sitl.autopilot.estimator import Estimator
from sitl.autopilot.mavlink import GROUND_PORTS, MavlinkServer, Ports
from sitl.autopilot.modes import NavState
from sitl.autopilot.params import Params
from sitl.autopilot.types import ImuSample
from sitl.faults.injector import Autopilot as FaultyAutopilot
from sitl.world.world import World

STUB_VERSION = "1.16"
"""PX4's version that the stub behaves like."""


class Observation(NamedTuple):
    """What can be seen of an autopilot from where the world is; None: not to be seen from there."""

    setpoint_at_s: float | None
    """World time at which the last setpoint arrived."""
    vision_received: int | None
    """Vision poses that arrived so far."""
    nav_state: NavState | None


class AutopilotBackend(Protocol):
    """An autopilot as the world's server sees it. The plant steps it by its IMU."""

    lockstep: bool
    """It answers on a wire: `sense` and `answered` come before each `step`."""

    @property
    def armed(self) -> bool:
        """Rotors may turn."""

    @property
    def faulty(self) -> FaultyAutopilot:
        """For the faults of this world."""

    @property
    def down(self) -> bool:
        """Nobody is there to speak with: it boots."""

    def attach(self, world: World) -> None:
        """The world that it flies in; before anything else."""

    def wires(self) -> AbstractAsyncContextManager[str]:
        """Open what it speaks on; the value is the companion's `devices.autopilot.address`."""

    async def prepare(self) -> None:
        """Make it ready to fly, while the world is being stepped."""

    def sense(self, imu: ImuSample) -> None:
        """The sample of the next `step`, as early as it is known."""

    async def answered(self) -> None:
        """Until it has made something of that sample."""

    def step(self, imu: ImuSample) -> Vec4:
        """One IMU sample in, normalised rotor commands out; all zero while disarmed."""

    def pump(self, t_s: float, battery: Battery) -> None:
        """After every step."""

    def set_link(self, down: bool, delay_s: float) -> None:
        """Faults of the link to the companion: dead, or slow both ways."""

    def skip(self, paused_s: float) -> None:
        """The world has stood still for so long while the wall clock went on: so does the autopilot's own clock, as a real one's."""

    def observe(self) -> Observation:
        """What can be seen of it now."""

    def about(self) -> dict[str, Any]:
        """kind (stub, px4) and version."""


def stub_of(config: WorldConfig, link_delay_s: float = 0.0) -> Px4Stub:
    """Return the stub with the parameters of this world, gains included; its hover thrust is set by `set_hover_thrust`.

    Args:
        config: `setpoint_delay_s` and `px4_params`.
        link_delay_s: added to the setpoint delay, for a loop without a wire that takes this time.
    """
    params = Params()
    for name, value in config.spoiled_px4_params().items():
        params.set(name, value)
    cascade = Cascade(gains_from_params(params))
    return Px4Stub(params, Estimator(), cascade, setpoint_delay_s=config.setpoint_delay_s + link_delay_s)


def set_hover_thrust(px4: Px4Stub, config: WorldConfig, world: World) -> float:
    """Set MPC_THR_HOVER to this machine's hover thrust times 1 + `hover_thrust_error`, unless `px4_params` overrides it.

    Returns:
        The hover thrust before the override.
    """
    hover_thrust = world.hover_command * (1.0 + config.hover_thrust_error)
    if "MPC_THR_HOVER" not in config.px4_params:
        px4.params.set("MPC_THR_HOVER", hover_thrust)
    return hover_thrust


class StubBackend:
    """The stub, in this process."""

    lockstep = False

    def __init__(self, config: WorldConfig, ports: Ports) -> None:
        self._config = config
        self._ports = ports
        self.px4 = stub_of(config)

    @property
    def armed(self) -> bool:
        """Rotors may turn."""
        return self.px4.commander.armed

    @property
    def faulty(self) -> FaultyAutopilot:
        """The stub itself."""
        return self.px4

    @property
    def down(self) -> bool:
        """It boots after a restart."""
        return self.px4.t_s < self.px4.booted_at_s

    def attach(self, world: World) -> None:
        """Its hover thrust is that of this world's machine."""
        set_hover_thrust(self.px4, self._config, world)

    @contextlib.asynccontextmanager
    async def wires(self) -> AsyncIterator[str]:
        """MAVLink on UDP."""
        ground = GROUND_PORTS if self._ports.remote else None
        async with MavlinkServer(self.px4, self._ports, ground) as self._mavlink:
            yield f"udpout://127.0.0.1:{self._mavlink.onboard_port}"

    async def prepare(self) -> None:
        """There is nothing to prepare."""

    def sense(self, imu: ImuSample) -> None:
        """It senses when it is stepped."""

    async def answered(self) -> None:
        """It answers at once."""

    def step(self, imu: ImuSample) -> Vec4:
        """One control period."""
        return self.px4.step(imu)

    def pump(self, t_s: float, battery: Battery) -> None:
        """What it measures and what it streams."""
        self.px4.battery = battery
        if not self.down:  # its clock would be negative
            self._mavlink.pump(t_s)

    def set_link(self, down: bool, delay_s: float) -> None:
        """Both of its links."""
        if down is not self._mavlink.link_down:
            self._mavlink.link_down = down
        self._mavlink.delay_s = delay_s

    def skip(self, paused_s: float) -> None:
        """The clock that its messages carry."""
        self.px4.clock_ahead_s += paused_s

    def observe(self) -> Observation:
        """Everything: it is ours."""
        px4 = self.px4
        return Observation(px4.setpoint_at_s, px4.vision_received, px4.nav_state)

    def about(self) -> dict[str, Any]:
        """A stub, and what it behaves like."""
        return {"kind": "stub", "version": STUB_VERSION}
