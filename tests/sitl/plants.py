"""A simulated plant on its own, for tests of what it measures."""

from __future__ import annotations

from companion.model.types import Vec4
from companion.sitl_config.loader import SitlConfig
from sitl.autopilot.types import ImuSample
from sitl.server import start_of
from sitl.servo.drive import ServoDrive
from sitl.world.plant import Plant
from sitl.world.world import PHYSICS_DT_S, World


class FixedRotors:
    """An autopilot that gives every rotor the same command all the time."""

    def __init__(self, commands: Vec4 = (0.0, 0.0, 0.0, 0.0)) -> None:
        self._commands = commands

    def step(self, imu: ImuSample) -> Vec4:
        return self._commands


def run(world: World, time_s: float, *, drag: bool = True) -> None:
    """Let a world run with its rotors and motors off."""
    for _ in range(round(time_s / PHYSICS_DT_S)):
        world.step((0.0,) * world.rotor_count, (0.0,) * len(world.layout.joint_q), False, drag=drag)


def plant_of(config: SitlConfig, commands: Vec4 = (0.0, 0.0, 0.0, 0.0), *, between_steps: bool = False) -> Plant:
    """Return the plant of this world at the start of its mission."""
    start = config.mission.start
    pose = start_of(start.position_m, start.yaw_deg, start.arm_deg)
    where = (pose.position_m, pose.yaw_rad, pose.arm_rad)
    drives = [ServoDrive() for _ in config.vehicle.arm.joints]
    return Plant(config.vehicle, config.world, FixedRotors(commands), drives, where, between_steps=between_steps)
