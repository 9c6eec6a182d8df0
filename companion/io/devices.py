"""All devices of the vehicle, opened together: for a flight every one of them, for a check whichever can be."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass, field

from companion.config.loader import FlightConfig
from companion.io.dynamixel.arm import DynamixelArm
from companion.io.force_torque.driver import RobotousForceTorque
from companion.io.mocap.driver import NatNetMocap
from companion.io.protocols import DeviceError
from companion.io.px4.driver import MavsdkAutopilot
from companion.io.qgroundcontrol.station import GroundStation, check_address
from companion.model.flight_stage import is_armed
from companion.model.types import MocapPose
from companion.runtime.clock import Clock

STATUS_TIMEOUT_S = 2.5
"""Of PX4's heartbeat, which comes once a second."""
ARM_PATIENCE_S = 1.5
"""A vehicle in the air does not wait for its arm any longer."""


@dataclass(slots=True)
class VisionValve:
    """Whether poses are passed on to PX4; the core shuts it while it does not believe them."""

    open: bool = True
    watch: Callable[[MocapPose], None] | None = None
    """Shown every pose as it arrives, whatever becomes of it."""
    on_frame: Callable[[float], None] | None = None
    """Told of every frame first: when it arrived."""


@dataclass(frozen=True, slots=True)
class Edges:
    """Everything on a wire, open. None: only beside a PX4 that was found armed, which has to land with what there is."""

    vision: VisionValve
    autopilot: MavsdkAutopilot
    mocap: NatNetMocap | None
    arm: DynamixelArm | None
    force: RobotousForceTorque | None
    found_armed: bool = False
    """PX4 was armed when its link was opened."""
    failures: tuple[str, ...] = ()
    """Of devices that such a landing goes without: the edges' own lines."""
    ground: GroundStation | None = None
    """None: nothing is forwarded, because nobody asked for it or the vehicle was found armed."""


@dataclass(slots=True)
class SomeEdges:
    """What could be opened; None: it could not, or is not yet."""

    vision: VisionValve
    autopilot: MavsdkAutopilot | None = None
    mocap: NatNetMocap | None = None
    arm: DynamixelArm | None = None
    force: RobotousForceTorque | None = None
    failures: dict[str, str] = field(default_factory=dict)
    """Device (`autopilot`, `mocap`, `arm`, `force`) and the edge's own line about it."""


@contextlib.asynccontextmanager
async def open_edges(config: FlightConfig, clock: Clock) -> AsyncIterator[Edges]:
    """Open every device; the arm, which gets torque, last. Motion capture flows to PX4 from the moment on at which its link is open.

    A PX4 that is armed already flies, perhaps: then what does not open is noted, and the force sensor is not waited for.

    Raises:
        DeviceError: PX4 is not there, or it is not armed and another device is not there or not as it must be; the first such one.
            All are closed again. So is the address of a ground station that is none, and that before anything is opened.
    """
    ground_address = config.vehicle.ground.qgroundcontrol
    if ground_address is not None:
        check_address(ground_address)
    some = SomeEdges(VisionValve())
    async with contextlib.AsyncExitStack() as stack:
        problem: DeviceError | None = None
        try:
            some.mocap = await stack.enter_async_context(_mocap(config, clock, some))
        except DeviceError as error:
            problem = error
        try:
            some.autopilot = autopilot = await stack.enter_async_context(_autopilot(config, clock))
        except DeviceError as error:
            raise problem or error from None
        armed = await _is_armed(autopilot)
        if armed:
            failures = [] if problem is None else [str(problem)]
            try:
                async with asyncio.timeout(ARM_PATIENCE_S):
                    some.arm = await stack.enter_async_context(_arm(config, clock))
            except DeviceError as error:
                failures.append(str(error))
            except TimeoutError:
                failures.append(f"arm {config.vehicle.devices.arm.port}: not open within {ARM_PATIENCE_S:g} s")
            if ground_address is not None:
                failures.append(
                    f"ground.qgroundcontrol {ground_address}: MAVLink is not forwarded in a flight found under way"
                )
            yield Edges(some.vision, autopilot, some.mocap, some.arm, None, armed, tuple(failures))
            return
        if problem is not None:
            raise problem
        some.force = await stack.enter_async_context(_force(config, clock))
        ground = None
        if ground_address is not None:
            ground = await stack.enter_async_context(_ground(config, ground_address, autopilot))
        some.arm = await stack.enter_async_context(_arm(config, clock))
        yield Edges(some.vision, autopilot, some.mocap, some.arm, some.force, ground=ground)


@contextlib.asynccontextmanager
async def open_what_opens(
    config: FlightConfig, clock: Clock, tell: Callable[[str], None] = lambda _: None
) -> AsyncIterator[SomeEdges]:
    """The same, but a device that refuses is noted and the others are opened all the same.

    Args:
        config: addresses and settings.
        clock: the flight clock.
        tell: told what is being opened, a word or two for people.
    """
    some = SomeEdges(VisionValve())
    async with contextlib.AsyncExitStack() as stack:

        @contextlib.contextmanager
        def noted(device: str, words: str) -> Iterator[None]:
            tell(words)
            try:
                yield
            except DeviceError as error:
                some.failures[device] = str(error)

        with noted("force", "force sensor"):
            some.force = await stack.enter_async_context(_force(config, clock))
        with noted("mocap", "motion capture"):
            some.mocap = await stack.enter_async_context(_mocap(config, clock, some))
        with noted("autopilot", "PX4"):
            some.autopilot = await stack.enter_async_context(_autopilot(config, clock))
        with noted("arm", "arm"):
            some.arm = await stack.enter_async_context(_arm(config, clock))
        yield some


async def _is_armed(autopilot: MavsdkAutopilot) -> bool:
    """What PX4 says, which may take a second; False if it says nothing: then nothing takes off without its word either."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(STATUS_TIMEOUT_S):
            while autopilot.status() is None:  # noqa: ASYNC110 - written by MAVSDK's threads
                await asyncio.sleep(0.01)
    return is_armed(autopilot.status())


def _force(config: FlightConfig, clock: Clock) -> RobotousForceTorque:
    return RobotousForceTorque(config.vehicle.devices.force, clock)


def _mocap(config: FlightConfig, clock: Clock, some: SomeEdges) -> NatNetMocap:
    valve = some.vision

    def pass_on(pose: MocapPose) -> None:
        autopilot = some.autopilot
        if autopilot is not None and valve.open and pose.tracking_valid:
            autopilot.send_vision(pose)

    def on_pose(pose: MocapPose) -> None:
        if valve.on_frame is not None:
            valve.on_frame(pose.stamp_s)
            # A tick that this frame has started comes first; PX4's estimate waits for the pose some tenths of a millisecond.
            asyncio.get_running_loop().call_soon(pass_on, pose)
        else:
            pass_on(pose)
        if valve.watch is not None:
            valve.watch(pose)

    return NatNetMocap(config.vehicle.devices.mocap, clock, on_pose)


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
    return MavsdkAutopilot(config.vehicle.devices.autopilot, clock, forwarding=forwarding)


def _arm(config: FlightConfig, clock: Clock) -> DynamixelArm:
    return DynamixelArm(config.vehicle.devices.arm, config.vehicle.arm, clock)
