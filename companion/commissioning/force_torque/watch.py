"""The force sensor at work for `companion ft`: the moment a weight hangs on the net, the sensor's own bias. I/O only."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator
from typing import Final

from companion.commissioning.force_torque.fit import mean_force
from companion.config.vehicle import Vehicle
from companion.io.dynamixel.arm import DynamixelArm
from companion.io.force_torque.driver import RobotousForceTorque
from companion.io.force_torque.rft import Command
from companion.io.protocols import DeviceError
from companion.model.types import Vec2, Vec3
from companion.runtime.clock import Clock

HANG_TIMEOUT_S: Final = 90.0
_LOOK_S: Final = 0.5
_STILL_S: Final = 1.5
_STILL_N: Final = 0.3
"""Between means over `_LOOK_S`, for a weight that swings no more."""
_CHANGE_MIN_N: Final = 0.5
_CHANGE_SHARE: Final = 0.15
"""Of the weight: a sensor that reads too little is to be found, too."""


class FtSensor(RobotousForceTorque):
    """The force sensor's edge, and the one command of it that no flight uses."""

    def set_bias(self, on: bool) -> None:
        """Make the present reading zero (SET_BIAS 1), or take that back (0). The sensor does not answer it; look at what it reads."""
        self._send(Command.SET_BIAS, int(on))


@contextlib.asynccontextmanager
async def arm_pose(vehicle: Vehicle, clock: Clock, given_rad: Vec2 | None) -> AsyncIterator[DynamixelArm | Vec2]:
    """Where the arm's angles come from: what was given, or the servos. Those hold with no current: the arm is loose.

    Raises:
        DeviceError: the arm does not open; its own line, and the way without it.
    """
    if given_rad is not None:
        yield given_rad
        return
    arm = DynamixelArm(vehicle.devices.arm, vehicle.arm, clock)
    try:
        await arm.__aenter__()
    except DeviceError as error:
        raise DeviceError(f"{error}; or say where the arm is: --arm-pose A1,A2 in deg") from None
    try:
        yield arm
    finally:
        await arm.__aexit__(None, None, None)


async def angles_rad(arm: DynamixelArm | Vec2) -> Vec2:
    """Both joints now.

    Raises:
        DeviceError: the servos are silent.
    """
    if not isinstance(arm, DynamixelArm):
        return arm
    state = await arm.read(0.5)
    if state is None or state.read_failures:
        raise DeviceError(f"arm: the servos have fallen silent; {arm.problem or 'check their cable'}")
    return state.angle_rad


async def until_hung(sensor: FtSensor, empty_n: Vec3, weight_n: float, timeout_s: float = HANG_TIMEOUT_S) -> bool:
    """Until something as heavy as a good part of the weight pulls steadily at the net. False: not within the time.

    Raises:
        DeviceError: the sensor fell silent.
    """
    loop = asyncio.get_running_loop()
    deadline_s = loop.time() + timeout_s
    least_n = max(_CHANGE_MIN_N, _CHANGE_SHARE * weight_n)
    steady: list[Vec3] = []
    while loop.time() < deadline_s:
        mean = mean_force(await sensor.tare_samples(_LOOK_S))
        steady = [old for old in steady if math.dist(old, mean) <= _STILL_N]
        steady = [*steady, mean] if math.dist(mean, empty_n) >= least_n else []
        if len(steady) * _LOOK_S >= _STILL_S:
            return True
    return False
