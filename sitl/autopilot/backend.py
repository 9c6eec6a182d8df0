"""Interface between the simulated world and its autopilot, implemented here by the stub and in `sitl.px4.backend` by a real PX4."""

from __future__ import annotations

import contextlib
import math
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager
from typing import Any, NamedTuple

from companion.config.airframe import Airframe
from companion.px4.rotors import geometry_of
from companion.sitl_config.effects.imu import Imu
from companion.sitl_config.world import World as WorldConfig
from sitl.autopilot.autopilot import Px4Stub
from sitl.autopilot.cascade import Cascade, gains_from_params
from sitl.autopilot.estimator import Estimator
from sitl.autopilot.mavlink import GROUND_PORTS, VISION_PORTS, MavlinkServer, Ports
from sitl.autopilot.modes import NavState
from sitl.autopilot.params import Params, mav_type
from sitl.autopilot.types import Battery, FaultTarget, ImuSample, LearnedBias, RotorCommands
from sitl.udp import Address
from sitl.world.machine import Machine

LINK_DELAY_S = 0.002
"""Time from sending a setpoint to its arrival at PX4 where the link itself takes no simulated time."""


class Observation(NamedTuple):
    """The state of an autopilot that the world can observe; a field is None if this autopilot does not reveal it."""

    setpoint_at_s: float | None
    """World time at which the newest setpoint arrived."""
    vision_received: int | None
    """Number of vision poses that arrived so far."""
    nav_state: NavState | None


class AutopilotBackend(ABC):
    """An autopilot of the simulated world. The plant steps it with IMU samples. What is not abstract holds for one in this process."""

    lockstep = False
    """Whether the autopilot answers over a network link; if so, the world calls `sense` and awaits `answered` before each `step`."""

    @property
    def down(self) -> bool:
        """Whether the autopilot is booting and does not communicate."""
        return False

    @property
    @abstractmethod
    def armed(self) -> bool:
        """Whether the rotors may turn."""

    @property
    @abstractmethod
    def fault_target(self) -> FaultTarget:
        """The object through which autopilot faults are injected."""

    @property
    @abstractmethod
    def vision_address(self) -> Address:
        """Address of the MAVLink link on which another program may send external vision, while the links are open."""

    @abstractmethod
    def attach(self, machine: Machine) -> None:
        """Set the machine that the autopilot flies; call this method before all others."""

    @abstractmethod
    def wires(self) -> AbstractAsyncContextManager[str]:
        """Open the autopilot's links and yield the value for the companion's `devices.autopilot.address`."""

    @abstractmethod
    def step(self, imu: ImuSample) -> RotorCommands:
        """Process one IMU sample and return normalised rotor commands (0 to 1), which are zero while disarmed."""

    @abstractmethod
    def pump(self, t_s: float, battery: Battery) -> None:
        """Stream telemetry; call this method after every step of the physics."""

    @abstractmethod
    def set_link(self, down: bool, delay_s: float) -> None:
        """Inject link faults in both directions: nothing arrives if `down`; otherwise messages arrive `delay_s` late."""

    @abstractmethod
    def observe(self) -> Observation:
        """Return the autopilot's observable state."""

    @abstractmethod
    def about(self) -> dict[str, Any]:
        """Return the autopilot's kind (stub or px4) and version, for `summary.json`."""

    async def prepare(self) -> None:
        """Make the autopilot ready to fly while the world is being stepped."""
        return

    def sense(self, imu: ImuSample) -> None:
        """Send the IMU sample of the next `step` to the autopilot as soon as it is known."""
        return

    async def answered(self) -> None:
        """Wait until the autopilot has answered the sample that `sense` sent."""
        return

    def start_over(self) -> bool:
        """Return to the state before the first step, because world time starts over; return False if this autopilot cannot."""
        return False

    def skip(self, paused_s: float) -> None:
        """Advance the clock of an autopilot that has one besides world time by a pause of the world."""
        return


def stub_of(config: WorldConfig, airframe: Airframe, link_delay_s: float = 0.0) -> Px4Stub:
    """Return a stub with the parameters and gains of this world; `set_hover_thrust` sets its hover thrust.

    Args:
        config: configuration of the world; `setpoint_delay_s`, `thr_mdl_fac`, `px4_params` and the biases of `imu` are used.
        link_delay_s: added to the setpoint delay, for a loop without a real link.
    """
    params = Params(release=config.px4_release)
    params.set("MAV_TYPE", mav_type(airframe.rotor_layout.count))
    params.set("CA_ROTOR_COUNT", airframe.rotor_layout.count)
    for name, value in geometry_of(airframe).items():
        params.set(name, value)
    params.set("BAT1_N_CELLS", airframe.battery_cells)
    params.set("THR_MDL_FAC", config.thr_mdl_fac)
    for name, value in config.overridden_px4_params().items():
        params.set(name, value)
    cascade = Cascade(gains_from_params(params), airframe.rotor_layout)
    delay_s = config.setpoint_delay_s + link_delay_s
    return Px4Stub(params, Estimator(), cascade, setpoint_delay_s=delay_s, learned=_learned(config.imu))


def _learned(imu: Imu) -> LearnedBias | None:
    """Return the biases that EKF2 learns while the vehicle is on the floor, limited by EKF2_GYR_B_LIM and EKF2_ABL_LIM.

    The world starts seconds before take-off; a real PX4 has run for longer. At rest, EKF2 observes the gyroscope biases directly
    (ZeroGyroUpdate, and the module gyro_calibration) and the bias of the vertical accelerometer from the height. It does not observe
    the biases of the horizontal accelerometers: at rest, and in every flight at constant yaw, position cannot distinguish them from a
    tilt. EKF2 initialises its tilt from the accelerometers, so the tilt is wrong by bias / g, and no innovation corrects it. In
    flight, EKF2 would learn little of these biases (a Kalman filter with EKF2's parameters and vision at 125 Hz: 0.01 m/s^2 per s and
    m of innovation, against 1.7 rad/s per m for the tilt). Measured on PX4 1.16.1 before take-off, in flight and after the catch:
    accelerometer biases of 0.1 and 0.08 m/s^2 (0.58 and 0.47 deg) tilt the estimate by 0.60 to 0.69 and 0.45 to 0.54 deg; a gyroscope
    bias of 0.3 deg/s tilts it by less than 0.03 deg.
    """
    if not imu.on:
        return None
    most_rad_s, most_m_s2 = 0.15, 0.4
    p, q, r = (max(-most_rad_s, min(most_rad_s, math.radians(rate))) for rate in imu.gyro_bias_deg_s)
    return LearnedBias((p, -q, -r), max(-most_m_s2, min(most_m_s2, -imu.accel_bias_m_s2[2])))


def set_hover_thrust(px4: Px4Stub, config: WorldConfig, machine: Machine) -> float:
    """Set MPC_THR_HOVER to this vehicle's hover thrust times 1 + `hover_thrust_error`, unless `px4_params` overrides it.

    Returns:
        The hover thrust before any override by `px4_params`.
    """
    hover_thrust = machine.hover_command * (1.0 + config.hover_thrust_error)
    if "MPC_THR_HOVER" not in config.px4_params:
        px4.params.set("MPC_THR_HOVER", hover_thrust)
    return hover_thrust


class StubBackend(AutopilotBackend):
    """The PX4 stub, which runs in this process."""

    def __init__(
        self,
        airframe: Airframe,
        config: WorldConfig,
        ports: Ports,
        *,
        external_vision: bool = False,
        in_lockstep: bool = False,
    ) -> None:
        self._external_vision = external_vision
        self._in_lockstep = in_lockstep
        self._config = config
        self._ports = ports
        self.px4 = stub_of(config, airframe, LINK_DELAY_S if in_lockstep else 0.0)

    @property
    def armed(self) -> bool:
        """Whether the rotors may turn."""
        return self.px4.commander.armed

    @property
    def fault_target(self) -> FaultTarget:
        """The stub itself."""
        return self.px4

    @property
    def down(self) -> bool:
        """Whether the stub is booting after a restart."""
        return self.px4.t_s < self.px4.booted_at_s

    @property
    def vision_address(self) -> Address:
        """Address of the link that is opened if the stub was made with `external_vision`."""
        return ("127.0.0.1", self._mavlink.vision_port)

    def attach(self, machine: Machine) -> None:
        """Set MPC_THR_HOVER to the hover thrust of this machine."""
        set_hover_thrust(self.px4, self._config, machine)

    @contextlib.asynccontextmanager
    async def wires(self) -> AsyncIterator[str]:
        """Open MAVLink over UDP and yield the companion's address."""
        ground = GROUND_PORTS if self._ports.remote else None
        vision = (VISION_PORTS if self._ports.remote else Ports(0, 0)) if self._external_vision else None
        async with MavlinkServer(self.px4, self._ports, ground, vision, in_lockstep=self._in_lockstep) as self._mavlink:
            yield f"udpout://127.0.0.1:{self._mavlink.onboard_port}"

    def step(self, imu: ImuSample) -> RotorCommands:
        """Run one control period."""
        return self.px4.step(imu)

    def pump(self, t_s: float, battery: Battery) -> None:
        """Update the battery and stream telemetry."""
        self.px4.battery = battery
        if not self.down:  # its clock would be negative
            self._mavlink.pump(t_s)

    def set_link(self, down: bool, delay_s: float) -> None:
        """Apply link faults to both links of the stub."""
        if down is not self._mavlink.link_down:
            self._mavlink.link_down = down
        self._mavlink.delay_s = delay_s

    def start_over(self) -> bool:
        """Start the stub over, unless it is armed."""
        if self.armed:
            return False
        self.px4.start_over()
        self._mavlink.start_over()
        return True

    def skip(self, paused_s: float) -> None:
        """Advance the clock with which the stub stamps its messages."""
        self.px4.clock_ahead_s += paused_s

    def observe(self) -> Observation:
        """Return the stub's state; every field is known."""
        px4 = self.px4
        return Observation(px4.setpoint_at_s, px4.vision_received, px4.nav_state)

    def about(self) -> dict[str, Any]:
        """Return the kind "stub" and the PX4 version that it imitates."""
        return {"kind": "stub", "version": self._config.px4_version}
