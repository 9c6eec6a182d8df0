"""Checks of the mission, the arm's start pose, and the vehicle's position in the room. `frames` checks start position and yaw. Pure
functions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

from companion.config.loader import FlightConfig
from companion.config.mission import Start
from companion.config.tether import Room
from companion.model.best_pose import last_pose
from companion.model.check_row import Row
from companion.model.listing import listed
from companion.model.observations import Observations
from companion.model.types import Joints, Vec3
from companion.preflight.checks import Check

LAND_AFTER_S: Final = 0.108
"""From the guardian's timeout to PX4's LAND mode: the longest that was measured with PX4 1.16.1, 0.208 s with a timeout of 0.1 s."""

PLAN = Check(
    "mission.plan",
    "mission",
    "inside room and tether, within all limits; `fly` checks this before it opens a device (exit code 2)",
    "the flight would leave the room, load the tether or exceed the vehicle's limits",
)
ARM = Check(
    "mission.arm",
    "arm at the start",
    "the mission's `start.arm_deg` ± `start.arm_tolerance_deg`",
    "the arm's first motion is planned from this pose",
)
ROOM = Check(
    "mission.room",
    "position in the room",
    "body origin and rotors inside `room`",
    "no sensor detects the real walls; only the limits in `room` keep the rotors away from them",
)
VEHICLE = Check(
    "mission.vehicle",
    "figures of the vehicle file",
    "inertia, rotors, radii, yaw torque, armature of the joints and poses are in the vehicle file (`companion check` only)",
    "a key that is left out has the value of the Tarot 650, which is wrong for another machine",
    warns=True,
)
TAKEOVER = Check(
    "mission.takeover",
    "guardian's takeover",
    f"`safety.react_time_s` is at least `safety.guardian_timeout_s` plus {LAND_AFTER_S:g} s, from the timeout to PX4's LAND mode",
    "after a takeover the vehicle would stop farther away than room, tether and mission allow for",
    warns=True,
)
CHECKS = (VEHICLE, PLAN, ARM, ROOM, TAKEOVER)


def rows(o: Observations, config: FlightConfig) -> Iterator[Row]:
    """Return the rows on plan, arm and position."""
    mission, vehicle = config.mission, config.vehicle
    if o.left_out is not None:
        read = f"left out: {'; '.join(o.left_out)}" if o.left_out else "all given"
        fix = "add them to the vehicle file, as they are on the machine"
        yield VEHICLE.row(not o.left_out, read, "all given", fix)
    if o.plan is not None:
        if o.plan:
            yield PLAN.bad(
                "; ".join(o.plan), "", "correct the mission, then check it with: companion check --plan-only"
            )
        else:
            length = f", {o.mission_s:.0f} s" if o.mission_s is not None else ""
            yield PLAN.good(f"'{mission.name}' can be flown{length}")
    if o.arm:
        yield _arm(o.arm[-1].angle_rad, mission.start)
    pose = last_pose(o, external=vehicle.devices.mocap.external)
    if pose is not None:
        yield _room(pose.position_world_m, vehicle.room, vehicle.airframe.radius_m)
    react_s, timeout_s = vehicle.safety.react_time_s, vehicle.safety.guardian_timeout_s
    fix = "lower safety.guardian_timeout_s, or raise safety.react_time_s as well"
    least_s = timeout_s + LAND_AFTER_S
    yield TAKEOVER.row(react_s >= least_s, f"{react_s:g} s", f"at least {least_s:g} s", fix)


def _arm(angle_rad: Joints, start: Start) -> Row:
    angle_deg = tuple(map(math.degrees, angle_rad))
    off_deg = max(abs(angle - wanted) for angle, wanted in zip(angle_deg, start.arm_deg, strict=True))
    read = f"({listed(angle_deg, '.0f')}) deg"
    wanted = f"({listed(start.arm_deg, 'g')}) ± {start.arm_tolerance_deg:g} deg"
    fix = "move the arm there by hand, or change the mission's start.arm_deg"
    return ARM.row(off_deg <= start.arm_tolerance_deg, read, wanted, fix)


def _room(position: Vec3, room: Room, radius_m: float) -> Row:
    x, y, z = position
    read = f"({x:.2f}, {y:.2f}, {z:.2f}) m"
    spans = (room.x_m, room.y_m, room.z_m)
    wanted = ", ".join(f"{name} {low:g} to {high:g}" for name, (low, high) in zip("xyz", spans, strict=True)) + " m"
    reach = (radius_m, radius_m, 0.0)
    inside = all(low + r <= p <= high - r for p, r, (low, high) in zip(position, reach, spans, strict=True))
    if inside:
        return ROOM.good(read, wanted)
    return ROOM.bad(
        read, f"{wanted}, with rotors ({radius_m:g} m) inside", "move the vehicle further inside, or correct room"
    )
