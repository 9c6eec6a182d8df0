"""The landing of a vehicle that holds one end of a bar, while the other vehicle does the same at the other end."""

from __future__ import annotations

from typing import Final

from companion.config.vehicle import Vehicle
from companion.control.manipulator import Manipulator
from companion.mission.plan import BELOW_GROUND_M, Plan, fold_time_s
from companion.mission.plan_builder import PlanBuilder
from companion.model.frames import quat_from_euler_zyx, quat_rotate
from companion.model.types import Joints, PhaseKind, Reference, Vec3

PRESS_M: Final = 0.01
"""Depth by which the clamp is led below the height at which the bar stands."""
STAND_S: Final = 1.0
"""Time on the floor until the clamp opens: the other vehicle may have begun a little later."""
OPENING_S: Final = 0.8
BACK_M: Final = 0.6
BACK_S: Final = 2.2
RISE_M: Final = 0.1
RISE_S: Final = 1.0
FOLD_AFTER_S: Final = 0.5
"""Time from the beginning of the rise until the arm folds: the clamp is above the handle then."""
FOLDED_S: Final = 0.5
"""Time before the end of the fold, which then moves the arm by less than a tenth of its way, at which the descent may begin."""


def landing_with_bar(
    now: Reference,
    velocity_world_m_s: Vec3,
    stands_m: float,
    manipulator: Manipulator,
    arm_fold_rad: Joints,
    speed_m_s: float,
    vehicle: Vehicle,
) -> tuple[Plan, float]:
    """Plan an immediate landing: come to rest, set the bar down with the arm as it is, let it go, move backwards, and land.

    Args:
        now: the last reference.
        stands_m: height of the clamp at which the bar stands.
        arm_fold_rad: joint angles at the end.
        speed_m_s: speed of the descent, the same for both vehicles.
        vehicle: provides the height of the floor.

    Returns:
        The plan, whose segments are all of PhaseKind.LANDING, and the time on its clock at which the clamp is to open.
    """
    builder = PlanBuilder(now.position_world_m, now.yaw_rad, now.arm_rad)
    builder.t_s = builder.stop(velocity_world_m_s)
    drop_m = -manipulator.net_body_m(now.arm_rad)[2]
    builder.t_s = builder.descend(speed_m_s, stands_m - PRESS_M + drop_m)
    opens_s = builder.t_s + STAND_S
    builder.t_s = opens_s + OPENING_S
    builder.end_segment("set the bar down", PhaseKind.LANDING)
    begun_s = builder.t_s
    x, y, z = builder.position_m
    builder.go((x, y, z + RISE_M), RISE_S)
    builder.t_s += FOLD_AFTER_S
    fold_s = fold_time_s(now.arm_rad, arm_fold_rad)
    builder.fold_arm(arm_fold_rad, fold_s)
    folded_s = builder.t_s + fold_s
    builder.t_s = begun_s + RISE_S
    dx, dy, _ = quat_rotate(quat_from_euler_zyx(0.0, 0.0, now.yaw_rad), (-BACK_M, 0.0, 0.0))
    builder.go((x + dx, y + dy, z + RISE_M), BACK_S)
    builder.t_s = max(builder.t_s + BACK_S, folded_s - FOLDED_S)
    builder.end_segment("leave the bar", PhaseKind.LANDING)
    builder.t_s = builder.descend(speed_m_s, vehicle.airframe.ground_clearance_m - BELOW_GROUND_M)
    builder.end_segment("land", PhaseKind.LANDING)
    return Plan.of(builder), opens_s
