"""The pose with which a flight is drawn and graded, and the time at which PX4 last used one."""

from __future__ import annotations

from companion.model.observations import Observations
from companion.model.types import Inputs, MocapPose, Quat, Vec3, VehicleState


def tracked_pose(stamp_s: float, position_world_m: Vec3, attitude_wxyz: Quat) -> MocapPose:
    """Return a pose that is known without the frame that it came from."""
    return MocapPose(
        stamp_s=stamp_s,
        frame_number=0,
        position_world_m=position_world_m,
        attitude_wxyz=attitude_wxyz,
        tracking_valid=True,
        marker_error_m=0.0,
    )


def estimated_pose(vehicle: VehicleState) -> MocapPose:
    """Return PX4's estimate in the form of a pose."""
    return tracked_pose(vehicle.position_stamp_s, vehicle.position_world_m, vehicle.attitude_wxyz)


def best_pose(i: Inputs) -> MocapPose | None:
    """Return the pose of motion capture or, if another program feeds PX4, PX4's estimate; None if neither is known."""
    if i.mocap is not None or i.estimator is None or i.vehicle is None:
        return i.mocap
    return estimated_pose(i.vehicle)


def last_pose(o: Observations, *, external: bool) -> MocapPose | None:
    """Return the last tracked pose of an observation; if another program feeds PX4 (`external`), PX4's last estimate."""
    if external:
        return estimated_pose(o.vehicle[-1]) if o.vehicle else None
    return next((pose for pose in reversed(o.mocap) if pose.tracking_valid), None)


def pose_used_s(i: Inputs) -> float | None:
    """Return the time on the flight clock at which PX4 last used a pose, as far as these inputs show: the arrival of a tracked pose, or
    of an ESTIMATOR_STATUS that reports fused vision. None if they show none.
    """
    if i.mocap is not None:
        return i.mocap.stamp_s if i.mocap.tracking_valid else None
    if i.estimator is not None and i.estimator.unaided is None:
        return i.estimator.stamp_s
    return None
