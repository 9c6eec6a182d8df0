"""The two paths of attitude setpoints through MAVSDK: MavlinkDirect (the default) and the Offboard plugin.

Both send SET_ATTITUDE_TARGET once per call, from the caller's thread. They differ when the caller falls silent; decision 1
(docs/decisions) explains the default.
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
    """A path of setpoints to PX4."""

    def send(self, setpoint: AttitudeSetpoint, t_s: float) -> bool:
        """Send at once. Return False if MAVSDK rejected it.

        Raises:
            ValueError: a value is invalid; nothing was sent.
        """

    def stop(self) -> None:
        """Stop sending until the next `send`."""


def setpoint_path(kind: Literal["direct", "offboard"], system: Any, direct: MavlinkDirect) -> SetpointPath:
    """Return the path to a MAVSDK system that `devices.autopilot.setpoint_path` selects."""
    if kind == "offboard":
        return OffboardSetpoints(system)
    return DirectSetpoints(direct, int(system.get_system_id()))


class DirectSetpoints:
    """Setpoints through MavlinkDirect. A setpoint is sent only when the flight loop calls, so PX4's offboard-loss failsafe triggers if
    the companion hangs.

    It adds 0.03 to 0.06 ms (median; 0.1 ms at p99) to a tick of 5 ms, as measured by `python -m benchmarks --only setpoint`.
    """

    def __init__(self, direct: MavlinkDirect, system_id: int) -> None:
        self._direct = direct
        self._system_id = system_id
        self._message = MavlinkMessage("SET_ATTITUDE_TARGET")

    def send(self, setpoint: AttitudeSetpoint, t_s: float) -> bool:
        """Send SET_ATTITUDE_TARGET with the given quaternion, stamped with the flight clock."""
        self._message.fields_json = messages.attitude_target_json(setpoint, int(t_s * 1e3), self._system_id)
        try:
            self._direct.send_message(self._message)
        except MavsdkError as error:
            _log.debug("SET_ATTITUDE_TARGET not sent: %s", error)
            return False
        return True

    def stop(self) -> None:
        """Do nothing, because this path sends nothing by itself."""


class OffboardSetpoints:
    """Setpoints through the Offboard plugin, which takes Euler angles and does not check values.

    A thread of the plugin repeats the last setpoint at 20 Hz until PX4's heartbeat shows a mode other than OFFBOARD, the plugin is
    destroyed or the process dies. PX4's offboard-loss failsafe therefore does not detect that Python hangs; the guardian does, and
    kills the process. The plugin's own `start` and `stop` are never used: the request queue changes modes, and `stop` would command
    HOLD.
    """

    def __init__(self, system: Any) -> None:
        self._system = system
        self._plugin: Any = None

    def send(self, setpoint: AttitudeSetpoint, t_s: float) -> bool:
        """Send roll, pitch, yaw and thrust, stamped by MAVSDK."""
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
        """Destroy the plugin, so that its thread stops repeating the last setpoint."""
        if self._plugin is not None:
            self._plugin.destroy()
            self._plugin = None
