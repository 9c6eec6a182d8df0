"""Converts PX4's messages to the companion's records. Pure."""

from __future__ import annotations

import math
from typing import Any

from companion.io.px4 import messages
from companion.model.estimator import EstimatorReport
from companion.model.flight_stage import flown_by_pilot
from companion.model.frames import attitude_enu_flu_from_ned_frd, euler_zyx_from_quat
from companion.model.types import AutopilotStatus, FlightMode, Quat, Vec3, VehicleState

# SET_MESSAGE_INTERVAL, REQUEST_MESSAGE
_NO_MANOEUVRES = (511, 512)
_ZERO: Vec3 = (0.0, 0.0, 0.0)


class Px4State:
    """Holds the newest message of each kind that the landing needs."""

    def __init__(self) -> None:
        self.refusal: str | None = None
        """Why PX4 rejected the newest command; None if it accepted it."""
        self.estimator: EstimatorReport | None = None
        """Newest ESTIMATOR_STATUS; None before the first."""
        self._heartbeat: tuple[float, bool, FlightMode, int] | None = None
        self._landed = 0
        self._position: tuple[float, Vec3, Vec3] = (-math.inf, _ZERO, _ZERO)
        self._attitude: tuple[float, Quat, Vec3] | None = None
        self._imu: tuple[float, Vec3] = (-math.inf, _ZERO)

    def take(self, t_s: float, message: Any) -> None:
        """Update with a decoded message that arrived at `t_s` (flight clock); ignore a state message with a non-finite value."""
        m = message
        match m.get_type():
            case "HEARTBEAT":
                armed = bool(m.base_mode & messages.MAV_MODE_FLAG_SAFETY_ARMED)
                mode = messages.flight_mode(m.base_mode, m.custom_mode)
                self._heartbeat = (t_s, armed, mode, m.system_status)
            case "EXTENDED_SYS_STATE":
                self._landed = m.landed_state
            case "LOCAL_POSITION_NED" if _finite(m.x, m.y, m.z, m.vx, m.vy, m.vz):
                self._position = (t_s, (m.x, m.y, m.z), (m.vx, m.vy, m.vz))
            case "ATTITUDE_QUATERNION" if _finite(m.q1, m.q2, m.q3, m.q4, m.rollspeed, m.pitchspeed, m.yawspeed):
                self._attitude = (t_s, (m.q1, m.q2, m.q3, m.q4), (m.rollspeed, m.pitchspeed, m.yawspeed))
            case "HIGHRES_IMU" if _finite(m.xacc, m.yacc, m.zacc):
                self._imu = (t_s, (m.xacc, m.yacc, m.zacc))
            case "ESTIMATOR_STATUS":
                self.estimator = messages.estimator_report(m.to_dict(), t_s)
            case "COMMAND_ACK" if m.command not in _NO_MANOEUVRES:
                self.refusal = None if m.result == 0 else f"MAV_CMD {m.command} {messages.result_text(m.result)}"

    def status(self) -> AutopilotStatus | None:
        """Return the autopilot's status, or None before the first HEARTBEAT."""
        if self._heartbeat is None:
            return None
        stamp_s, armed, mode, system = self._heartbeat
        return AutopilotStatus(
            heartbeat_stamp_s=stamp_s,
            armed=armed,
            mode=mode,
            landed=messages.landed_state(self._landed),
            system_status=system,
        )

    def vehicle(self) -> VehicleState | None:
        """Return the vehicle's state, or None before the first attitude. Attitude alone shows whether the vehicle is flipped, so
        the state does not depend on the other messages: a position or IMU sample that has not arrived has the stamp -inf.
        """
        if self._attitude is None:
            return None
        return messages.vehicle_state(*self._position, *self._attitude, *self._imu)

    @property
    def pilot(self) -> bool:
        """Whether a pilot has control: PX4 is armed, and in a mode that only a pilot selects or with its rotors killed."""
        return flown_by_pilot(self.status())

    def yaw_rad(self) -> float | None:
        """Return the heading in the world (ENU), or None if it is unknown."""
        if self._attitude is None or not any(self._attitude[1]):
            return None
        return euler_zyx_from_quat(attitude_enu_flu_from_ned_frd(self._attitude[1]))[2]


def _finite(*values: float) -> bool:
    return all(map(math.isfinite, values))
