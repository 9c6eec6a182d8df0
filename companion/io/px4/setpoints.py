"""The two ways by which an attitude setpoint leaves through MAVSDK: MavlinkDirect (the default) and the Offboard plugin.

Both send SET_ATTITUDE_TARGET once for each call, from the caller's thread. They differ in what happens when the caller falls silent:
decision 1 (docs/decisions) says why the first is the default.
"""

from __future__ import annotations

import logging
from typing import Any, Literal, Protocol

from mavsdk import MavsdkError
from mavsdk.plugins.mavlink_direct.mavlink_direct import MavlinkDirect, MavlinkMessage
from mavsdk.plugins.offboard.offboard import Attitude, Offboard

from companion.io.px4 import messages
from companion.model.types import AttitudeSetpoint

_log = logging.getLogger(__name__)


class SetpointPath(Protocol):
    """A way to PX4."""

    def send(self, setpoint: AttitudeSetpoint, t_s: float) -> bool:
        """Send at once. False: MAVSDK refused it.

        Raises:
            ValueError: a value that must never leave; nothing was sent.
        """

    def stop(self) -> None:
        """From now on nothing leaves until the next `send`."""


def setpoint_path(kind: Literal["direct", "offboard"], system: Any, direct: MavlinkDirect) -> SetpointPath:
    """The way that `devices.autopilot.setpoint_path` names, to a MAVSDK system."""
    if kind == "offboard":
        return OffboardSetpoints(system)
    return DirectSetpoints(direct, int(system.get_system_id()))


class DirectSetpoints:
    """Through MavlinkDirect. Nothing leaves unless the flight loop sends it: PX4's offboard-loss failsafe fires for a hung companion.

    The price was measured: 0.03 to 0.06 ms more from datagram to wire (p50; 0.1 ms at p99), of a tick of 5 ms.
    benchmarks/wire_latency.py measures both.
    """

    def __init__(self, direct: MavlinkDirect, system_id: int) -> None:
        self._direct = direct
        self._system_id = system_id

    def send(self, setpoint: AttitudeSetpoint, t_s: float) -> bool:
        """SET_ATTITUDE_TARGET with the quaternion as it is, stamped with the flight clock."""
        fields = messages.attitude_target_json(setpoint, int(t_s * 1e3), self._system_id)
        try:
            self._direct.send_message(MavlinkMessage("SET_ATTITUDE_TARGET", fields_json=fields))
        except MavsdkError as error:
            _log.debug("SET_ATTITUDE_TARGET not sent: %s", error)
            return False
        return True

    def stop(self) -> None:
        """Nothing leaves by itself."""


class OffboardSetpoints:
    """Through the Offboard plugin, which takes Euler angles and checks nothing.

    A thread of the plugin's repeats the last setpoint at 20 Hz until PX4's heartbeat says that it is not in OFFBOARD, the plugin is
    destroyed or the process dies: PX4's offboard-loss failsafe does not see that Python hangs. The guardian does, and kills the
    process. The plugin's own `start` and `stop` are never used: modes are the request desk's, and `stop` would command HOLD.
    """

    def __init__(self, system: Any) -> None:
        self._system = system
        self._plugin: Any = None

    def send(self, setpoint: AttitudeSetpoint, t_s: float) -> bool:
        """Roll, pitch, yaw and thrust; MAVSDK stamps it."""
        del t_s
        attitude = Attitude(*messages.attitude_target_deg(setpoint), setpoint.thrust)
        if self._plugin is None:
            self._plugin = Offboard(self._system)
        try:
            self._plugin.set_attitude(attitude)
        except MavsdkError as error:
            _log.debug("SET_ATTITUDE_TARGET not sent: %s", error)
            return False
        return True

    def stop(self) -> None:
        """End the plugin and its thread's repeating with it."""
        if self._plugin is not None:
            self._plugin.destroy()
            self._plugin = None
