"""Device access of `companion ft`: sets the force sensor's own bias, detects a weight on the net and reads the arm's angles. I/O
only.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Final

from companion.config.arm import Tool
from companion.config.devices import ForceDevice
from companion.config.document import ConfigError
from companion.config.vehicle import Vehicle
from companion.io.devices import open_arm
from companion.io.force_torque.samples import SampleStream
from companion.io.protocols import DeviceError
from companion.model.types import Joints, Vec3
from companion.preflight.force import mean_force_n
from companion.runtime.clock import Clock

WEIGHT_TIMEOUT_S: Final = 90.0
_LOOK_S: Final = 0.5
_STILL_S: Final = 1.5
_STILL_N: Final = 0.3
"""Largest difference between means over `_LOOK_S` once the weight has stopped swinging."""
_CHANGE_MIN_N: Final = 0.5
_CHANGE_SHARE: Final = 0.15
"""Fraction of the expected weight from which a change counts as the weight; low enough for a sensor that reads too little."""


def force_device(vehicle: Vehicle) -> ForceDevice:
    """Return the settings of the force sensor.

    Raises:
        DeviceError: the vehicle has no force sensor.
    """
    if vehicle.devices.force is None:
        raise DeviceError(f"force sensor: vehicle '{vehicle.name}' has none; add devices.force to the vehicle file")
    return vehicle.devices.force


def tool_of(vehicle: Vehicle) -> Tool:
    """Return the tool of a vehicle with a force sensor, which the vehicle file requires to have one."""
    assert vehicle.tool is not None
    return vehicle.tool


def pose_rad(text: str | None, vehicle: Vehicle) -> Joints | None:
    """Parse `--arm-pose`.

    Raises:
        ConfigError: the text is not one angle within the joint limits for each joint.
    """
    if text is None:
        return None
    joints = vehicle.arm.joints
    try:
        angles_deg = [float(part) for part in text.split(",")]
        if len(angles_deg) != len(joints):
            raise ValueError
    except ValueError:
        such_as = ",".join(f"{angle:g}" for angle in vehicle.safety.fold_arm_deg)
        raise ConfigError(
            f"--arm-pose {text}: expected the angle of each joint in deg, {len(joints)} in all, such as {such_as}"
        ) from None
    for number, (angle, joint) in enumerate(zip(angles_deg, joints, strict=True), 1):
        low, high = joint.angle_deg
        if not low <= angle <= high:
            raise ConfigError(f"--arm-pose {text}: joint {number} goes from {low:g} to {high:g} deg, got {angle:g}")
    return tuple(map(math.radians, angles_deg))


@contextlib.asynccontextmanager
async def arm_angles(
    vehicle: Vehicle, clock: Clock, given_rad: Joints | None
) -> AsyncIterator[Callable[[], Awaitable[Joints]]]:
    """Yield a function that returns the given joint angles, or reads them from the servos without torque.

    Raises:
        DeviceError: the arm's bus cannot be opened, or the servos stop answering.
    """

    async def given() -> Joints:
        assert given_rad is not None
        return given_rad

    async def read() -> Joints:
        state = await arm.read(0.5)
        if state is None or state.read_failures:
            raise DeviceError(f"arm: the servos no longer answer; {arm.problem or 'check their cable'}")
        return state.angle_rad

    if given_rad is not None:
        yield given
        return
    arm = open_arm(vehicle.arm_device, vehicle.arm, clock)
    try:
        await arm.__aenter__()
    except DeviceError as error:
        raise DeviceError(f"{error}; or give the joint angles: --arm-pose A1,A2,... in deg") from None
    try:
        yield read
    finally:
        await arm.__aexit__(None, None, None)


async def until_loaded(sensor: SampleStream, empty_n: Vec3, weight_n: float) -> bool:
    """Wait until a weight hangs steadily on the net. Return False after `WEIGHT_TIMEOUT_S`.

    Raises:
        DeviceError: the sensor stopped sending.
    """
    loop = asyncio.get_running_loop()
    deadline_s = loop.time() + WEIGHT_TIMEOUT_S
    least_n = max(_CHANGE_MIN_N, _CHANGE_SHARE * weight_n)
    steady: list[Vec3] = []
    while loop.time() < deadline_s:
        mean = mean_force_n(await sensor.tare_samples(_LOOK_S))
        steady = [old for old in steady if math.dist(old, mean) <= _STILL_N]
        steady = [*steady, mean] if math.dist(mean, empty_n) >= least_n else []
        if len(steady) * _LOOK_S >= _STILL_S:
            return True
    return False
