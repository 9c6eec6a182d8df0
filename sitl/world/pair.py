"""The scene of two vehicles that carry one bar."""

from __future__ import annotations

from collections.abc import Sequence

from companion.mission.phase import phases_of
from companion.phases.carry.grip import GripHandle
from companion.sitl_config.bar import Bar
from companion.sitl_config.distributions import with_model_error
from companion.sitl_config.loader import SitlConfig
from sitl.world.bar import BarSpec
from sitl.world.scene import Scene
from sitl.world.start import MachineSpec, start_of


def pair_scene(members: Sequence[SitlConfig]) -> Scene:
    """Return the scene of both members.

    Args:
        members: the left vehicle, then the right one. The left one's mission places the bar, and its world sets how the true bar
            differs from the planned one.
    """
    specs = []
    for config in members:
        start = config.mission.start
        pose = start_of(start.position_m, start.yaw_deg, start.arm_deg)
        world = with_model_error(config.world, len(config.vehicle.arm.joints))
        specs.append(MachineSpec(config.vehicle, world, pose))
    grip = next(phase for phase in phases_of(members[0].mission) if isinstance(phase, GripHandle))
    return Scene(specs, BarSpec(grip.bar, members[0].world.bar or Bar()))
