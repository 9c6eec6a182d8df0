"""The other program of `devices.mocap.type: external`: sends the poses of the simulated cameras to PX4 over a MAVLink link of its own.

It stands for a bridge such as MAVROS, whose plugin vision_pose sends VISION_POSITION_ESTIMATE. The companion does not take part.
"""

from __future__ import annotations

import asyncio
import math
from typing import Self

from pymavlink.dialects.v20 import common as mavlink

from companion.model.frames import attitude_ned_frd_from_enu_flu, euler_zyx_from_quat, ned_from_enu
from sitl.mocap import MocapFrame
from sitl.udp import Address, UdpEndpoint

_COVARIANCE_FROM_PARAMS = [math.nan] * 21


class ExternalVision(UdpEndpoint):
    """Sender of VISION_POSITION_ESTIMATE; an async context manager.

    Args:
        px4: address of one of PX4's MAVLink links that the companion does not use.
    """

    def __init__(self, px4: Address) -> None:
        super().__init__()
        self._px4 = px4
        self._encoder = mavlink.MAVLink(None, srcSystem=1, srcComponent=mavlink.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY)

    async def __aenter__(self) -> Self:
        await asyncio.get_running_loop().create_datagram_endpoint(lambda: self, local_addr=("127.0.0.1", 0))
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        """Ignore what PX4 sends."""

    def publish(self, frame: MocapFrame, t_s: float) -> None:
        """Send the pose of a frame if the body is tracked; `t_s` is this program's clock."""
        if not frame.valid:
            return
        position_ned_m = ned_from_enu(frame.position_world_m)
        angles_rad = euler_zyx_from_quat(attitude_ned_frd_from_enu_flu(frame.attitude_wxyz))
        message = mavlink.MAVLink_vision_position_estimate_message(
            max(1, round(t_s * 1e6)), *position_ned_m, *angles_rad, _COVARIANCE_FROM_PARAMS
        )
        data = message.pack(self._encoder)
        self._encoder.seq = (self._encoder.seq + 1) % 256
        self.send_to(data, self._px4)
