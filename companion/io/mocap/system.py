"""What a motion-capture system that is a plug-in provides. `companion.config.mocap` checks its settings before a flight.

The flight process and the guardian each make a client of their own from the same settings, because the guardian lands the vehicle
after the flight process has died. `companion.io.mocap.plugin_driver` runs the flight's, `companion.guardian.plugin_mocap` the
guardian's.
"""

from __future__ import annotations

import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

from companion.model.types import MocapPose


@dataclass(frozen=True, slots=True)
class MocapSettings:
    """`devices.mocap` of the vehicle file, with the same keys."""

    server: str
    interface: str
    transport: str
    multicast_group: str
    command_port: int
    data_port: int
    rigid_body_id: int
    up_axis: str
    type: str = "natnet"
    options: Mapping[str, Any] = field(default_factory=dict)
    """`devices.mocap.options`, already checked by the system's model."""


class PoseClient(Protocol):
    """Receives the poses of the vehicle's rigid body; no call waits.

    An entry point of the group `companion.mocap_systems` names its class. The class is called with `MocapSettings`; if it raises, the
    flight does not start. Times are those of the process's clock, s.
    """

    options: ClassVar[type[Any]]
    """Subclass of `companion.config.base.Model` that checks `MocapSettings.options`; its docstring describes the system."""
    server_name: str
    """Program and protocol, such as "Vicon Tracker, UDP object stream"."""
    sockets: Sequence[socket.socket]
    """Non-blocking sockets to wait on; empty if the client has threads of its own: then `poses` is called every 5 ms."""
    problem: str | None
    """Why the newest rejected datagram was invalid, as one line; None if none was rejected."""

    def keep_connected(self, now_s: float) -> None:
        """Send what the server needs to go on streaming; called every 10 to 50 ms."""

    def poses(self, now_s: float) -> list[MocapPose]:
        """Return the poses that have arrived since the last call, in order, in the world frame (z up) and the body frame FLU.

        A pose's `stamp_s` is its arrival, `now_s` or earlier, and `tracking_valid` is False while the body is not tracked. Frame
        numbers increase.
        """

    def close(self) -> None:
        """Close the sockets; never raises."""
