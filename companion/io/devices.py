"""Opens the vehicle's devices: all of them for a flight, those that can be opened for a check."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass, field
from typing import TypeVar

from companion.config.arm import Arm as ArmConfig
from companion.config.arm import Jaws
from companion.config.device_plugins import DYNAMIXEL
from companion.config.devices import ArmDevice
from companion.config.loader import FlightConfig
from companion.io.arm.plugin_driver import PluginArm
from companion.io.dynamixel.arm import DynamixelArm
from companion.io.force_torque.plugin_driver import open_force
from companion.io.mocap.driver import MocapDriver
from companion.io.protocols import Arm, Autopilot, DeviceError, ForceTorque, GroundLink, Mocap, Team
from companion.io.px4.driver import MavsdkAutopilot
from companion.io.px4.streams import ESTIMATOR_RATE_HZ
from companion.io.qgroundcontrol.station import GroundStation, check_address
from companion.io.team_link import TeamLink, TeamSettings
from companion.model.estimator import WATCHED_RATE_HZ
from companion.model.flight_stage import is_armed
from companion.model.types import MocapPose
from companion.runtime.clock import Clock

_T = TypeVar("_T")
STATUS_TIMEOUT_S = 2.5
"""Timeout for PX4's status, which needs a heartbeat; PX4 sends one per second."""
ARM_TIMEOUT_S = 1.5
"""Timeout for opening the arm if PX4 was found armed and has to land."""


@dataclass(slots=True)
class PoseForwarder:
    """Forwards motion-capture poses to PX4. Each is judged before that; until there is a core, every tracked pose is forwarded."""

    judge: Callable[[MocapPose], bool] | None = None
    """Returns whether a pose may be forwarded."""
    watch: Callable[[MocapPose], None] | None = None
    """Called with every pose on arrival, forwarded or not."""
    on_frame: Callable[[float], None] | None = None
    """Called first with the arrival time of every frame, s."""


@dataclass(frozen=True, slots=True)
class Devices:
    """All open devices of a flight. A device is None if the vehicle does not have it, or if it could not be opened and PX4 was found
    armed. Motion capture is also None if another program sends the poses to PX4.
    """

    forwarder: PoseForwarder
    autopilot: Autopilot
    mocap: Mocap | None
    arm: Arm | None
    force: ForceTorque | None
    found_armed: bool = False
    """PX4 was armed when its link was opened."""
    failures: tuple[str, ...] = ()
    """Error lines of the devices that could not be opened, if PX4 was found armed."""
    team: Team | None = None
    """Link to the other vehicle of a team; None for a vehicle that flies alone."""
    ground: GroundLink | None = None
    """Link to a MAVLink ground station; None if MAVLink is not forwarded."""


@dataclass(slots=True)
class AvailableDevices:
    """Devices that could be opened; the others are None."""

    forwarder: PoseForwarder
    autopilot: Autopilot | None = None
    mocap: Mocap | None = None
    arm: Arm | None = None
    force: ForceTorque | None = None
    failures: dict[str, str] = field(default_factory=dict)
    """Error line by device: `autopilot`, `mocap`, `arm`, `force`."""


@contextlib.asynccontextmanager
async def open_devices(config: FlightConfig, clock: Clock) -> AsyncIterator[Devices]:
    """Open all devices, the arm last because its torque is then switched on. Poses are forwarded to PX4 as soon as its link is
    open.

    If PX4 is armed the vehicle may be flying: devices that fail are listed in `failures`, and the force sensor is left closed.

    Raises:
        DeviceError: the ground station's address is invalid, PX4 cannot be opened, or it is disarmed and another device cannot be
            opened. All devices are closed again.
    """
    ground_address = config.vehicle.ground.qgroundcontrol
    if ground_address is not None:
        check_address(ground_address)
    available = AvailableDevices(PoseForwarder())
    async with contextlib.AsyncExitStack() as stack:
        problem: DeviceError | None = None
        try:
            available.mocap = await _opened(stack, _mocap(config, clock, available))
        except DeviceError as error:
            problem = error
        try:
            available.autopilot = autopilot = await stack.enter_async_context(_autopilot(config, clock))
        except DeviceError as error:
            raise problem or error from None
        forwarder, mocap = available.forwarder, available.mocap
        if await _is_armed(autopilot):
            failures = [] if problem is None else [str(problem)]
            arm: Arm | None = None
            try:
                async with asyncio.timeout(ARM_TIMEOUT_S):
                    arm = await _opened(stack, _arm(config, clock))
            except DeviceError as error:
                failures.append(str(error))
            except TimeoutError:
                device = config.vehicle.arm_device
                failures.append(f"arm {device.port or device.type}: not open within {ARM_TIMEOUT_S:g} s")
            team: Team | None = None
            try:
                team = await _opened(stack, _team(config, clock))
            except DeviceError as error:
                failures.append(str(error))
            if ground_address is not None:
                failures.append(
                    f"ground.qgroundcontrol {ground_address}: MAVLink is not forwarded because PX4 was found armed"
                )
            yield Devices(
                forwarder=forwarder,
                autopilot=autopilot,
                mocap=mocap,
                arm=arm,
                force=None,
                team=team,
                found_armed=True,
                failures=tuple(failures),
            )
            return
        if problem is not None:
            raise problem
        force = await _opened(stack, _force(config, clock))
        team = await _opened(stack, _team(config, clock))
        ground = await _opened(stack, None if ground_address is None else _ground(config, ground_address, autopilot))
        arm = await _opened(stack, _arm(config, clock))
        yield Devices(
            forwarder=forwarder, autopilot=autopilot, mocap=mocap, arm=arm, force=force, team=team, ground=ground
        )


@contextlib.asynccontextmanager
async def open_available(
    config: FlightConfig, clock: Clock, show: Callable[[str], None] = lambda _: None
) -> AsyncIterator[AvailableDevices]:
    """Open the devices that can be opened and list the errors of the others.

    Args:
        show: called with the name of each device before it is opened, for the operator.
    """
    available = AvailableDevices(PoseForwarder())
    async with contextlib.AsyncExitStack() as stack:

        @contextlib.contextmanager
        def noted(device: str, name: str) -> Iterator[None]:
            show(name)
            try:
                yield
            except DeviceError as error:
                available.failures[device] = str(error)

        if (sensor := _force(config, clock)) is not None:
            with noted("force", "force sensor"):
                available.force = await stack.enter_async_context(sensor)
        if (system := _mocap(config, clock, available)) is not None:
            with noted("mocap", "motion capture"):
                available.mocap = await stack.enter_async_context(system)
        with noted("autopilot", "PX4"):
            available.autopilot = await stack.enter_async_context(_autopilot(config, clock))
        if (driver := _arm(config, clock)) is not None:
            with noted("arm", "arm"):
                available.arm = await stack.enter_async_context(driver)
        yield available


async def _opened(
    stack: contextlib.AsyncExitStack, device: contextlib.AbstractAsyncContextManager[_T] | None
) -> _T | None:
    return None if device is None else await stack.enter_async_context(device)


async def _is_armed(autopilot: Autopilot) -> bool:
    """Return whether PX4 is armed; False if no status arrives, because then nothing can take off."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(STATUS_TIMEOUT_S):
            while autopilot.status() is None:  # noqa: ASYNC110 - written by MAVSDK's threads
                await asyncio.sleep(0.01)
    return is_armed(autopilot.status())


def _force(config: FlightConfig, clock: Clock) -> ForceTorque | None:
    device = config.vehicle.devices.force
    return open_force(device, clock) if device is not None else None


def _mocap(config: FlightConfig, clock: Clock, available: AvailableDevices) -> Mocap | None:
    """Return the driver of motion capture, or None if another program feeds PX4."""
    if config.vehicle.devices.mocap.external:
        return None
    forwarder = available.forwarder

    def forward(pose: MocapPose) -> None:
        autopilot = available.autopilot
        if autopilot is not None and (pose.tracking_valid if forwarder.judge is None else forwarder.judge(pose)):
            autopilot.send_vision(pose)

    def on_pose(pose: MocapPose) -> None:
        if forwarder.on_frame is not None:
            forwarder.on_frame(pose.stamp_s)
            # The control tick that this frame starts comes first; PX4's estimate gets the pose some tenths of a millisecond later.
            asyncio.get_running_loop().call_soon(forward, pose)
        else:
            forward(pose)
        if forwarder.watch is not None:
            forwarder.watch(pose)

    return MocapDriver(config.vehicle.devices.mocap, clock, on_pose)


def _team(config: FlightConfig, clock: Clock) -> TeamLink | None:
    device = config.vehicle.devices.team
    return None if device is None else TeamLink(TeamSettings(**device.model_dump()), clock)


def _ground(config: FlightConfig, address: str, autopilot: MavsdkAutopilot) -> GroundStation:
    ground = config.vehicle.ground
    return GroundStation(
        address,
        autopilot,
        while_armed=ground.qgroundcontrol_while_armed,
        console=ground.qgroundcontrol_console,
    )


def _autopilot(config: FlightConfig, clock: Clock) -> MavsdkAutopilot:
    forwarding = config.vehicle.ground.qgroundcontrol is not None
    devices = config.vehicle.devices
    rate_hz = WATCHED_RATE_HZ if devices.mocap.external else ESTIMATOR_RATE_HZ
    return MavsdkAutopilot(devices.autopilot, clock, forwarding=forwarding, estimator_rate_hz=rate_hz)


def open_arm(device: ArmDevice, arm: ArmConfig, clock: Clock, jaws: Jaws | None = None) -> DynamixelArm | PluginArm:
    """Return the driver of an arm and of its clamp, which only Dynamixel servos have, to be opened as a context manager."""
    return DynamixelArm(device, arm, clock, jaws) if device.type == DYNAMIXEL else PluginArm(device, arm, clock)


def _arm(config: FlightConfig, clock: Clock) -> Arm | None:
    vehicle = config.vehicle
    return open_arm(vehicle.arm_device, vehicle.arm, clock, vehicle.jaws) if vehicle.arm.joints else None
