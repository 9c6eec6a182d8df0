"""The two paths of attitude setpoints: through MAVSDK's Offboard plugin (the default) and straight onto the link.

Both send SET_ATTITUDE_TARGET once per call, and nothing when the caller is silent; decision 1 (docs/internals/decisions) compares them.
"""

from __future__ import annotations

import logging
import math
import struct
import threading
from collections.abc import Callable
from typing import Any, Final, Literal, Protocol

from mavsdk import MavsdkError
from mavsdk.plugins.offboard.offboard import Attitude, Offboard

from companion.io.px4 import messages
from companion.model.types import AttitudeSetpoint
from companion.runtime import simulated_time

PLUGIN_MAX_S: Final = 0.002
"""Time after which a setpoint that the plugin has not sent is written straight onto the link."""
_PLUGIN_MAX_SIMULATED_S: Final = 2.0
"""The same if the flight lives in simulated time, which stands meanwhile."""
_TARGET_AT: Final = 10 + 4
"""Place of the quaternion in a MAVLink 2 frame of SET_ATTITUDE_TARGET, behind the header and the time."""
_TARGET = struct.Struct("<4f12xf")
"""Quaternion and thrust; between them are the body rates."""
_SAME = 1e-4
"""Largest difference of a value of one setpoint: the plugin computes the quaternion from Euler angles in single precision."""
_NEVER_LEAVES = Attitude(math.nan, math.nan, math.nan, math.nan)
"""An attitude that equals no setpoint."""
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

    def pass_on(self, frame: bytes) -> None:
        """Take a SET_ATTITUDE_TARGET that MAVSDK sends; called in a thread of MAVSDK."""


def setpoint_path(
    kind: Literal["offboard", "direct"],
    system: Any,
    send: Callable[[int, bytes], bool],
    write: Callable[[bytes], bool],
) -> SetpointPath:
    """Return the path that `devices.autopilot.setpoint_path` selects.

    Args:
        send: sends a message, given by id and payload; returns whether it was sent.
        write: sends a frame of MAVSDK's; returns whether it was sent.
    """
    direct = DirectSetpoints(send, int(system.get_system_id()))
    return OffboardSetpoints(system, write, direct) if kind == "offboard" else direct


class DirectSetpoints:
    """Setpoints straight onto the link, only when the flight loop calls: if the companion hangs, PX4's offboard-loss failsafe acts."""

    def __init__(self, send: Callable[[int, bytes], bool], system_id: int) -> None:
        self._send = send
        self._system_id = system_id

    def send(self, setpoint: AttitudeSetpoint, t_s: float) -> bool:
        """Send SET_ATTITUDE_TARGET with the given quaternion, stamped with the flight clock."""
        payload = messages.attitude_target(setpoint, int(t_s * 1e3), self._system_id)
        return self._send(messages.SET_ATTITUDE_TARGET_ID, payload)

    def stop(self) -> None:
        """Do nothing, because this path sends nothing by itself."""

    def pass_on(self, frame: bytes) -> None:
        """Do nothing: MAVSDK sends no setpoint on this path."""


class OffboardSetpoints:
    """Setpoints through the Offboard plugin, which takes Euler angles and does not check values.

    A thread of MAVSDK sends them, and another one repeats the last setpoint at 20 Hz when the caller is silent. Everything that MAVSDK
    sends passes through the driver, which lets one setpoint leave for each call of `send`: the one of the call, not a repetition of an
    earlier one that comes in between. So nothing is repeated, and PX4's offboard-loss failsafe triggers if the companion hangs. The
    plugin's own `start` and `stop` are never used: the request queue changes modes, and `stop` would command HOLD.

    A repetition that differs by less than `_SAME` may leave in place of the new setpoint. That is harmless, but in simulated time a
    flight would then depend on the computer's clock; there the plugin has nothing to repeat, at the cost of a second call.

    Args:
        write: sends a frame of MAVSDK's; returns whether it was sent.
        direct: sends what the plugin has not sent in time.
    """

    def __init__(self, system: Any, write: Callable[[bytes], bool], direct: DirectSetpoints) -> None:
        self._system = system
        self._write = write
        self._direct = direct
        self._plugin: Any = None
        self._lock = threading.Lock()
        self._wanted = self._sent = False
        self._target: tuple[float, ...] = ()
        """Quaternion FRD -> NED and thrust of the newest call."""
        self._left = threading.Event()
        self._simulated = simulated_time.current() is not None
        self._max_s = _PLUGIN_MAX_SIMULATED_S if self._simulated else PLUGIN_MAX_S

    def send(self, setpoint: AttitudeSetpoint, t_s: float) -> bool:
        """Send roll, pitch, yaw and thrust, stamped by MAVSDK, and wait until they have left."""
        attitude = Attitude(*messages.attitude_target_deg(setpoint), setpoint.thrust)
        self._target = (*messages.attitude_target_ned(setpoint), setpoint.thrust)
        if self._plugin is None:
            self._plugin = Offboard(self._system)
        self._left.clear()
        self._wanted = True
        try:
            self._plugin.set_attitude(attitude)
            if self._simulated:
                self._plugin.set_attitude(_NEVER_LEAVES)
        except MavsdkError as error:
            _log.debug("SET_ATTITUDE_TARGET not sent by MAVSDK: %s", error)
        else:
            self._left.wait(self._max_s)
        with self._lock:
            late, self._wanted = self._wanted, False
        return self._direct.send(setpoint, t_s) if late else self._sent

    def pass_on(self, frame: bytes) -> None:
        """Send the frame if it is the one that `send` waits for; called in a thread of MAVSDK."""
        with self._lock:
            if not self._wanted or not self._is_target(frame):
                return
            self._wanted = self._sent = False
            try:
                self._sent = self._write(frame)
            finally:
                self._left.set()

    def _is_target(self, frame: bytes) -> bool:
        if len(frame) < _TARGET_AT + _TARGET.size:
            return False
        *q, thrust = _TARGET.unpack_from(frame, _TARGET_AT)
        *target_q, target_thrust = self._target
        sign = math.copysign(1.0, sum(a * b for a, b in zip(q, target_q, strict=True)))  # q and -q are one attitude
        apart = max(abs(sign * a - b) for a, b in zip(q, target_q, strict=True))
        return bool(apart < _SAME and abs(thrust - target_thrust) < _SAME)

    def stop(self) -> None:
        """Destroy the plugin, so that its thread stops repeating the last setpoint."""
        if self._plugin is not None:
            self._plugin.destroy()
            self._plugin = None
