"""The two paths of attitude setpoints: straight onto the link (the default) and through MAVSDK's Offboard plugin.

Both send SET_ATTITUDE_TARGET once per call. They differ when the caller falls silent; decision 1 (docs/decisions) explains the default.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, Literal, Protocol

from mavsdk import MavsdkError
from mavsdk.plugins.offboard.offboard import Attitude, Offboard

from companion.io.px4 import messages
from companion.model.types import AttitudeSetpoint

_log = logging.getLogger(__name__)


class SetpointPath(Protocol):
    """A path of setpoints to PX4."""

    def send(self, setpoint: AttitudeSetpoint, t_s: float) -> bool:
        """Send at once. Return False if it was not sent.

        Raises:
            ValueError: a value is invalid; nothing was sent.
        """

    def stop(self) -> None:
        """Stop sending until the next `send`."""


def setpoint_path(kind: Literal["direct", "offboard"], system: Any, send: Callable[[int, bytes], bool]) -> SetpointPath:
    """Return the path that `devices.autopilot.setpoint_path` selects.

    Args:
        kind: the path.
        system: the MAVSDK system.
        send: sends a message, given by id and payload; returns whether it was sent.
    """
    if kind == "offboard":
        return OffboardSetpoints(system)
    return DirectSetpoints(send, int(system.get_system_id()))


class DirectSetpoints:
    """Setpoints straight onto the link. A setpoint is sent only when the flight loop calls, so PX4's offboard-loss failsafe triggers if
    the companion hangs.
    """

    def __init__(self, send: Callable[[int, bytes], bool], system_id: int) -> None:
        self._send = send
        self._system_id = system_id

    def send(self, setpoint: AttitudeSetpoint, t_s: float) -> bool:
        """Send SET_ATTITUDE_TARGET with the given quaternion, stamped with the flight clock."""
        payload = messages.attitude_target(setpoint, int(t_s * 1e3), self._system_id)
        return self._send(messages.SET_ATTITUDE_TARGET_ID, payload)

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
