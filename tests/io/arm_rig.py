"""An arm on a real pty with emulated servos; the real dynamixel-sdk speaks in between."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

from companion.config.arm import Arm as ArmConfig
from companion.config.arm import Joint
from companion.config.devices import ArmDevice
from companion.io.dynamixel.arm import DynamixelArm
from companion.io.dynamixel.scale import RAD_PER_COUNT
from companion.io.protocols import Arm as ArmEdge
from companion.model.types import ArmState
from companion.runtime.clock import flight_clock
from sitl.servo.bus import ServoBus
from sitl.servo.model import ServoModel

KT = 1.3
NM_PER_COUNT = KT * 2.69e-3
JOINTS = (
    Joint(servo_id=11, sign=-1, zero_count=3072, angle_deg=(-20, 180), torque_max_nm=2.5),
    Joint(servo_id=12, sign=1, zero_count=1024, angle_deg=(-150, 150), torque_max_nm=1.5),
)
START_DEG = (165.0, 140.0)


def arm_config(*joints: Joint, torque_per_amp_nm_a: float | None = KT) -> ArmConfig:
    joints = joints or JOINTS
    return ArmConfig(
        shoulder_body_m=(0.0, 0.0, -0.05),
        link_lengths_m=(0.2,) * len(joints),
        link_masses_kg=(0.05,) * len(joints),
        link_com_m=(0.1,) * len(joints),
        torque_per_amp_nm_a=torque_per_amp_nm_a,
        joints=joints,
    )


def shaft_rad(joint: Joint, angle_rad: float) -> float:
    return joint.zero_count * RAD_PER_COUNT + joint.sign * angle_rad


def new_servos(baud: int = 3_000_000, start_deg: tuple[float, float] = START_DEG) -> list[ServoModel]:
    return [
        ServoModel(joint.servo_id, baud_bps=baud, shaft_angle_rad=shaft_rad(joint, math.radians(angle)))
        for joint, angle in zip(JOINTS, start_deg, strict=True)
    ]


def register(servo: ServoModel, address: int, size: int = 1) -> int:
    return int.from_bytes(servo.read(address, size), "little", signed=size > 1)


def device_on(path: str, **changes: Any) -> ArmDevice:
    return ArmDevice(port=path, **changes)


@dataclass
class Setup:
    servos: list[ServoModel]
    bus: ServoBus
    arm: DynamixelArm
    clock: Callable[[], float]


@asynccontextmanager
async def flying_arm(**device: Any) -> AsyncIterator[Setup]:
    servos = new_servos()
    clock = flight_clock()
    async with ServoBus(servos) as bus, DynamixelArm(device_on(bus.path, **device), arm_config(), clock) as arm:
        yield Setup(servos, bus, arm, clock)


async def state_when(arm: ArmEdge, condition: Callable[[ArmState], bool]) -> ArmState:
    while True:
        state = await arm.read(1.0)
        assert state is not None
        if condition(state):
            return state


async def until(condition: Callable[[], bool]) -> None:
    while not condition():  # noqa: ASYNC110 - registers have no event to wait for
        await asyncio.sleep(0.001)
