"""Vicon Tracker's UDP object stream as a motion-capture system of the companion. It has not been tried with a real Tracker yet.

Tracker broadcasts one datagram per frame: u32 frame number, u8 number of items; per item u8 id (0 for an object), u16 size, and for an
object its name in 24 bytes, then position in mm and rotation in rad (Euler XYZ: turned about x, then the new y, then the new z) as six
doubles. Little endian, z up. An object that is not tracked has zeros.
"""

from __future__ import annotations

import math
import socket
import struct

from companion.config.base import Model
from companion.io.arrival import arrived_s
from companion.io.mocap.sockets import open_udp, waiting
from companion.io.mocap.system import MocapSettings
from companion.model.frames import quat_multiply
from companion.model.types import MocapPose

_FRAME = struct.Struct("<IB")
_ITEM = struct.Struct("<BH")
_OBJECT = struct.Struct("<24s6d")


class ViconOptions(Model):
    """Vicon Tracker over its UDP object stream."""

    object_name: str
    """Name of the vehicle's object in Tracker."""
    port: int = 51001


class ViconTracker:
    """Receives the poses of one object; `server` is the address of Tracker's computer."""

    options = ViconOptions
    server_name = "Vicon Tracker, UDP object stream"

    def __init__(self, settings: MocapSettings) -> None:
        if settings.up_axis != "z":
            raise ValueError(f"Vicon Tracker streams z up, devices.mocap.up_axis is {settings.up_axis}")
        options = ViconOptions.model_validate(dict(settings.options))
        self._name = options.object_name.encode()
        self._server = socket.gethostbyname(settings.server)
        self._broadcasts = open_udp(
            "", options.port, shared=True
        )  # the flight and the guardian both receive a broadcast
        self.problem: str | None = None

    def keep_connected(self, now_s: float) -> None:
        """Do nothing: Tracker broadcasts without being asked."""

    def poses(self, now_s: float) -> list[MocapPose]:
        """Return the object's poses that have arrived since the last call."""
        found = []
        for datagram in waiting(self._broadcasts):
            if datagram.sender_ip != self._server:
                continue
            try:
                pose = self._pose(datagram.data, arrived_s(datagram.ancillary, lambda: now_s))
            except (struct.error, ValueError) as error:
                self.problem = f"datagram of {len(datagram.data)} bytes: {error}"
                continue
            if pose is not None:
                found.append(pose)
        return found

    def close(self) -> None:
        """Close the socket."""
        self._broadcasts.close()

    def _pose(self, data: bytes, stamp_s: float) -> MocapPose | None:
        number, items = _FRAME.unpack_from(data)
        offset = _FRAME.size
        for _ in range(items):
            kind, size = _ITEM.unpack_from(data, offset)
            offset += _ITEM.size
            name, *values = _OBJECT.unpack_from(data, offset)
            offset += size
            if kind == 0 and name.partition(b"\0")[0] == self._name:
                if not all(map(math.isfinite, values)):
                    raise ValueError(f"position and angles {values} are not finite")
                x_mm, y_mm, z_mm, *angles_rad = values
                half = [0.5 * angle for angle in angles_rad]
                about_x = (math.cos(half[0]), math.sin(half[0]), 0.0, 0.0)
                about_y = (math.cos(half[1]), 0.0, math.sin(half[1]), 0.0)
                about_z = (math.cos(half[2]), 0.0, 0.0, math.sin(half[2]))
                return MocapPose(
                    stamp_s=stamp_s,
                    frame_number=number,
                    position_world_m=(1e-3 * x_mm, 1e-3 * y_mm, 1e-3 * z_mm),
                    attitude_wxyz=quat_multiply(quat_multiply(about_x, about_y), about_z),
                    tracking_valid=any(values),
                    marker_error_m=0.0,
                )
        return None
