"""Plans the retraction along the tether: come to rest, fold the arm, move inward, never outward or up."""

from __future__ import annotations

import math

from companion.config.tether import Room, Tether
from companion.config.vehicle import Vehicle
from companion.mission.plan import Plan, fold_time_s, go_back
from companion.mission.plan_builder import PlanBuilder, stopping
from companion.mission.reference import REST_TO_REST_PEAK_SPEED
from companion.model.types import Joints, PhaseKind, Vec2, Vec3

LEAST_WAY_M = 0.5
"""Minimum distance inward, because a tether under tension is shorter than configured or is caught."""
BESIDE_ANCHOR_M = 0.3
"""Distance between the rotors and the vertical through the anchor, so that the vehicle does not land on the anchor."""
RETURN_MIN_S = 1.0


def inward_only(velocity_m_s: Vec3, position_m: Vec3, anchor_m: Vec3) -> Vec3:
    """Return the velocity without its components upwards and away from the anchor's vertical."""
    vx, vy, vz = velocity_m_s
    x, y = position_m[0] - anchor_m[0], position_m[1] - anchor_m[1]
    away_m = math.hypot(x, y)
    if away_m > 1e-6:
        x, y = x / away_m, y / away_m
        outward = max(0.0, vx * x + vy * y)
        vx, vy = vx - outward * x, vy - outward * y
    else:
        vx = vy = 0.0
    return (vx, vy, min(0.0, vz))


def retract_from(
    position_world_m: Vec3,
    velocity_world_m_s: Vec3,
    yaw_rad: float,
    arm_rad: Joints,
    arm_fold_rad: Joints,
    vehicle: Vehicle,
    tether: Tether,
    back_to_m: Vec3 | None = None,
) -> Plan:
    """Plan a stop and a slow return towards the anchor's vertical until the tether has `retract_slack_m` of slack, while the arm
    folds.

    Neither the distance from the anchor's vertical nor the height ever increases, and the path stays in the room. The plan has two
    segments, three with the way back from a surface, which the governor keeps within the tether; a landing follows.

    Args:
        position_world_m: start of the reference: the last reference.
        velocity_world_m_s: initial velocity; its components outward and up are removed, the rest is limited to
            `STOP_SPEED_MAX_M_S`.
        yaw_rad: kept constant.
        arm_rad: joint angles at the start, at rest.
        arm_fold_rad: joint angles at the end.
        vehicle: provides room, airframe and the speed of the return.
        back_to_m: position to go to before everything else, from a surface that the tool may touch.
    """
    safety, anchor = vehicle.safety, tether.anchor_world_m
    builder = PlanBuilder(position_world_m, yaw_rad, arm_rad)
    if back_to_m is not None:
        position_world_m, velocity_world_m_s = back_to_m, go_back(builder, back_to_m, PhaseKind.FLIGHT)
    back_s, fold_s = builder.t_s, fold_time_s(arm_rad, arm_fold_rad)
    builder.fold_arm(arm_fold_rad, fold_s)
    velocity, stop_s = stopping(inward_only(velocity_world_m_s, position_world_m, anchor))
    builder.t_s = builder.stop_within(_never_outward(velocity, stop_s, position_world_m, anchor), stop_s)
    builder.end_segment("stop", PhaseKind.FLIGHT)
    x, y, z = builder.position_m
    away_m = math.hypot(x - anchor[0], y - anchor[1])
    lever_m = math.hypot(*tether.attachment_body_m)
    free_m = max(0.0, tether.length_m - safety.retract_slack_m - lever_m)
    goal_m = min(math.sqrt(max(0.0, free_m * free_m - (z - anchor[2]) ** 2)), away_m - LEAST_WAY_M)
    way_m = away_m - max(goal_m, vehicle.airframe.radius_m + BESIDE_ANCHOR_M)
    if way_m > 0.0:
        share = way_m / away_m
        to = (x + share * (anchor[0] - x), y + share * (anchor[1] - y))
        to = _inside(to, (x, y), vehicle.room, vehicle.airframe.radius_m)
        duration_s = max(RETURN_MIN_S, REST_TO_REST_PEAK_SPEED * math.dist(to, (x, y)) / safety.retract_speed_m_s)
        start_s = builder.t_s
        builder.go((*to, z), duration_s)
        builder.t_s = start_s + duration_s
    builder.t_s = max(builder.t_s, back_s + fold_s)
    builder.end_segment("return", PhaseKind.FLIGHT)
    return Plan.of(builder)


def _never_outward(velocity_m_s: Vec3, duration_s: float, position_m: Vec3, anchor_m: Vec3) -> Vec3:
    """Return the velocity turned inward so far that the path to rest never leads outward: n (r - n) >= t^2, n inward, t across."""
    x, y = position_m[0] - anchor_m[0], position_m[1] - anchor_m[1]
    away_m = math.hypot(x, y)
    if away_m < 1e-6:
        return (0.0, 0.0, velocity_m_s[2])
    x, y = x / away_m, y / away_m
    reach_s, half_m = 0.5 * duration_s, 0.5 * away_m
    sideways_m = max(-half_m, min(half_m, reach_s * (x * velocity_m_s[1] - y * velocity_m_s[0])))
    inward_m = max(
        half_m - math.sqrt(max(0.0, half_m * half_m - sideways_m * sideways_m)),
        min(half_m, -reach_s * (x * velocity_m_s[0] + y * velocity_m_s[1])),
    )
    return (
        (-inward_m * x - sideways_m * y) / reach_s,
        (-inward_m * y + sideways_m * x) / reach_s,
        velocity_m_s[2],
    )


def _inside(to_m: Vec2, from_m: Vec2, room: Room, reach_m: float) -> Vec2:
    """Limit the path so that the rotors stay in the room. A start outside the room is not limited."""
    share = 1.0
    for goal, start, (low, high) in zip(to_m, from_m, (room.x_m, room.y_m), strict=True):
        low, high = min(low + reach_m, start), max(high - reach_m, start)
        if goal > high:
            share = min(share, (high - start) / (goal - start))
        elif goal < low:
            share = min(share, (low - start) / (goal - start))
    return (from_m[0] + share * (to_m[0] - from_m[0]), from_m[1] + share * (to_m[1] - from_m[1]))
