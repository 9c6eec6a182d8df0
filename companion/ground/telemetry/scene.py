"""The scene message of a flight, from its configuration. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.config.arm_chain import chain_of
from companion.config.loader import FlightConfig
from companion.ground.protocol.messages import VERSION, Scene
from companion.mission.phase import phases_of
from companion.model.arm_skeleton import skeleton_of
from companion.model.types import Vec3
from companion.phases.carry.bar import End
from companion.phases.carry.grip import GripHandle

PATH_POINTS_MAX = 300


def scene_of(config: FlightConfig, session: str, path_world_m: Sequence[Vec3] = (), *, mission_s: float = 0.0) -> Scene:
    """Return the scene of a flight.

    Args:
        path_world_m: planned path at equal time steps; thinned to `PATH_POINTS_MAX` evenly spaced points if it has more.
        mission_s: planned duration; 0 before it is planned.
    """
    vehicle, phases = config.vehicle, phases_of(config.mission)
    room, tether, safety, airframe, arm = vehicle.room, vehicle.tether, vehicle.safety, vehicle.airframe, vehicle.arm
    skeleton = skeleton_of(chain_of(vehicle))
    grip = next((phase for phase in phases if isinstance(phase, GripHandle)), None)
    return Scene(
        v=VERSION,
        session=session,
        room_min_world_m=(room.x_m[0], room.y_m[0], room.z_m[0]),
        room_max_world_m=(room.x_m[1], room.y_m[1], room.z_m[1]),
        anchor_world_m=tether.anchor_world_m if tether is not None else None,
        tether_length_m=tether.length_m if tether is not None else None,
        tether_margin_m=tether.margin_m if tether is not None else None,
        attachment_body_m=tether.attachment_body_m if tether is not None else None,
        radius_m=airframe.radius_m,
        rotors_body_m=airframe.rotor_layout.positions_body_m,
        ground_clearance_m=airframe.ground_clearance_m,
        shoulder_body_m=skeleton.shoulder_body_m,
        link_lengths_m=tuple(math.hypot(*link) for link in skeleton.links_body_m),
        links_body_m=skeleton.links_body_m,
        joint_axes_body=skeleton.joint_axes,
        net_radius_m=vehicle.tool.net_radius_m if vehicle.tool is not None else None,
        joint_min_rad=tuple(math.radians(joint.angle_deg[0]) for joint in arm.joints),
        joint_max_rad=tuple(math.radians(joint.angle_deg[1]) for joint in arm.joints),
        tilt_abort_rad=math.radians(safety.tilt_abort_deg),
        tracking_warn_m=safety.tracking_error_warn_m,
        tracking_abort_m=safety.tracking_error_abort_m,
        mission_s=mission_s,
        path_world_m=thinned(path_world_m),
        phases=tuple(phase.title for phase in phases),
        has_contact=any(phase.touches for phase in phases) or None,
        bar_length_m=grip.bar.length_m if grip is not None else None,
        partner=_partner(vehicle.ground.topic, grip.end) if grip is not None else None,
    )


def _partner(topic: str | None, end: End) -> str | None:
    """Return the name of the other vehicle in topics if this one's is TEAM-END, as a team file sets it."""
    if topic is None or not topic.endswith(f"-{end}"):
        return None
    return topic.removesuffix(end) + ("right" if end == "left" else "left")


def thinned(path_world_m: Sequence[Vec3]) -> tuple[Vec3, ...]:
    """Return at most `PATH_POINTS_MAX` evenly spaced points, including the first and the last."""
    count = len(path_world_m)
    if count <= PATH_POINTS_MAX:
        return tuple(path_world_m)
    last = PATH_POINTS_MAX - 1
    return tuple(path_world_m[round(k * (count - 1) / last)] for k in range(PATH_POINTS_MAX))
