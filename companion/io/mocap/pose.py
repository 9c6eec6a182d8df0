"""From a NatNet frame to the pose that the companion flies on; shared by flight and guardian. Pure."""

from __future__ import annotations

from companion.io.mocap import natnet
from companion.model.types import MocapPose

VERSIONS: dict[str, natnet.NatNetVersion] = {"3.0": "3.0", "4.1": "4.1"}
"""NatNet versions that are spoken, as `ServerInfo.version` says them."""


def mocap_pose(frame: natnet.Frame, arrived_s: float, up_axis: str) -> MocapPose | None:
    """The wanted body's pose in the world frame; None if the frame does not hold it.

    Args:
        frame: parsed.
        arrived_s: when its datagram arrived, on the flight clock.
        up_axis: "y" or "z": Motive's streaming setting.
    """
    body = frame.body
    if body is None:
        return None
    position_m, quat_wxyz = body.position_m, body.quat_wxyz
    if up_axis == "y":
        position_m, quat_wxyz = natnet.z_up_from_y_up(position_m, quat_wxyz)
    return MocapPose(
        stamp_s=arrived_s,
        latency_s=frame.latency_s,
        frame_number=frame.number,
        position_world_m=position_m,
        attitude_wxyz=quat_wxyz,
        tracking_valid=body.tracking_valid,
        marker_error_m=body.error_m,
        exposure_server_s=frame.exposure_s,
    )
