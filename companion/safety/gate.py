"""The last check of every command: values must be finite, in range, fresh and without jumps. A command that fails it is not sent.

A rejected command is not replaced: PX4's offboard-loss failsafe and the servos' bus watchdog then act. An excess is reduced: thrust
that changes too fast, torque beyond its limit, torque that drives a joint further beyond its limit or speed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from companion.config.vehicle import Vehicle
from companion.model.codec import Record
from companion.model.frames import tilt_rad
from companion.model.types import AttitudeSetpoint, Joints

SLEW_MEMORY_S: Final = 0.1
"""After this time without a setpoint, when PX4 has discarded the previous one, the next may have any value."""
ARM_FRESH_S: Final = 0.05
"""Largest age of a joint state from which a torque may be computed."""


@dataclass(frozen=True, slots=True)
class Refusal:
    """One reason why a command was rejected or changed."""

    kind: str
    """Kind of the reason, independent of the numbers in the text."""
    text: str
    limp: bool = False
    """Whether the law's joint torques are unusable, so that none are sent; a stale joint state is not the law's fault."""


class Verdict(Record, frozen=True):
    """Commands that may be sent, and the reasons for all rejections and changes."""

    attitude: AttitudeSetpoint | None
    arm_torque_nm: Joints | None
    refused: tuple[Refusal, ...]


class Gate:
    """Checks each tick's commands against the vehicle file; keeps the last thrust sent."""

    def __init__(self, vehicle: Vehicle) -> None:
        safety, joints = vehicle.safety, vehicle.arm.joints
        self._tilt_max_rad = math.radians(vehicle.airframe.tilt_max_deg) + 1e-6
        self._tilt_limit = math.sin(0.5 * self._tilt_max_rad) ** 2
        self._bounds = [
            (
                number,
                torque_max_nm,
                math.radians(joint.angle_deg[0]),
                math.radians(joint.angle_deg[1]),
                math.radians(joint.velocity_max_deg_s),
            )
            for number, (joint, torque_max_nm) in enumerate(zip(joints, vehicle.joint_torque_limits_nm, strict=True))
        ]
        """Number, largest torque, N m, lower and upper limit, rad, and largest speed, rad/s, of each joint."""
        self._state_age_max_s = safety.command_state_age_max_s
        self._slew_max_per_s = safety.thrust_slew_max_per_s
        self._last: tuple[float, float] | None = None
        """Flight clock and thrust of the last setpoint; None before the first."""

    def check(
        self,
        attitude: AttitudeSetpoint | None,
        arm_torque_nm: Joints | None,
        arm_rad: Joints | None,
        arm_fresh: bool,
        *,
        t_s: float = 0.0,
        state_age_s: float = 0.0,
        arm_rate_rad_s: Joints | None = None,
    ) -> Verdict:
        """Return the commands that may be sent.

        Args:
            attitude: requested setpoint.
            arm_torque_nm: requested joint torques; empty or None requests none.
            arm_rad: joint angles now; None if unknown.
            arm_fresh: the joint state is fresh enough for closed-loop control.
            t_s: flight clock.
            state_age_s: age of the attitude that the setpoint was computed from.
            arm_rate_rad_s: joint speeds now, rad/s; None counts as 0.
        """
        refused: list[Refusal] = []
        if attitude is not None:
            fault = self._attitude_fault(attitude, state_age_s)
            if fault is not None:
                refused.append(fault)
                attitude = None
            else:
                attitude = self._slewed(attitude, t_s, refused)
        if arm_torque_nm is not None and len(arm_torque_nm) != len(self._bounds):
            text = f"{len(arm_torque_nm)} joint torques for {len(self._bounds)} joints"
            refused.append(Refusal("number of torques", text, limp=True))
            arm_torque_nm = None
        elif arm_torque_nm:
            if not math.isfinite(sum(arm_torque_nm)):
                text = f"joint torque {arm_torque_nm} is not finite"
                refused.append(Refusal("torque not finite", text, limp=True))
                arm_torque_nm = None
            elif arm_rad is None or not arm_fresh:
                refused.append(Refusal("torque without state", "joint torque without a fresh joint state"))
                arm_torque_nm = None
            else:
                rate_rad_s = arm_rate_rad_s if arm_rate_rad_s is not None else (0.0,) * len(arm_rad)
                if not self._is_free(arm_torque_nm, arm_rad, rate_rad_s):
                    arm_torque_nm = tuple(map(self._limited, range(len(arm_rad)), arm_torque_nm, arm_rad, rate_rad_s))
        return Verdict(attitude, arm_torque_nm, tuple(refused) if refused else ())

    def _attitude_fault(self, setpoint: AttitudeSetpoint, state_age_s: float) -> Refusal | None:
        w, x, y, z = setpoint.attitude_wxyz
        norm2, sin2_half_tilt, thrust = w * w + x * x + y * y + z * z, x * x + y * y, setpoint.thrust
        # Written so that NaN fails every condition.
        if 0.998 < norm2 < 1.002 and sin2_half_tilt <= self._tilt_limit and 0.0 <= thrust <= 1.0:
            if state_age_s <= self._state_age_max_s:
                return None
            return Refusal("stale state", f"attitude setpoint from a state {state_age_s * 1e3:.0f} ms old")
        if not (math.isfinite(norm2) and math.isfinite(thrust)):
            return Refusal("setpoint not finite", "attitude setpoint is not finite")
        if not 0.998 < norm2 < 1.002:
            return Refusal("no rotation", "attitude setpoint is not a unit quaternion")
        if not 0.0 <= thrust <= 1.0:
            return Refusal("thrust", f"thrust {thrust:.3f} is outside 0 to 1")
        tilt_deg = math.degrees(tilt_rad(setpoint.attitude_wxyz))
        return Refusal("tilt", f"tilt setpoint {tilt_deg:.1f} deg is above the limit")

    def _slewed(self, setpoint: AttitudeSetpoint, t_s: float, refused: list[Refusal]) -> AttitudeSetpoint:
        """Return the setpoint with its thrust limited to the permitted rate of change."""
        thrust, last = setpoint.thrust, self._last
        if last is not None and t_s - last[0] <= SLEW_MEMORY_S:
            most = self._slew_max_per_s * max(0.0, t_s - last[0])
            if not last[1] - most <= thrust <= last[1] + most:
                slow = max(last[1] - most, min(last[1] + most, thrust))
                text = f"thrust step from {last[1]:.2f} to {thrust:.2f} is limited to {slow:.2f}"
                refused.append(Refusal("thrust slew", text))
                setpoint, thrust = AttitudeSetpoint(setpoint.attitude_wxyz, slow), slow
        self._last = (t_s, thrust)
        return setpoint

    def _is_free(self, arm_torque_nm: Joints, arm_rad: Joints, arm_rate_rad_s: Joints) -> bool:
        """Return whether torques, joint angles and speeds are within their limits, as in nearly every tick."""
        for joint, most_nm, low_rad, high_rad, fast_rad_s in self._bounds:
            if not (
                -most_nm <= arm_torque_nm[joint] <= most_nm
                and low_rad <= arm_rad[joint] <= high_rad
                and -fast_rad_s <= arm_rate_rad_s[joint] <= fast_rad_s
            ):
                return False
        return True

    def _limited(self, index: int, torque_nm: float, angle_rad: float, rate_rad_s: float) -> float:
        """Return the torque clipped to its limit; beyond the angle or speed limit only torque that drives the joint back is kept."""
        _, limit, low, high, fast = self._bounds[index]
        if torque_nm > limit:
            torque_nm = limit
        elif torque_nm < -limit:
            torque_nm = -limit
        if torque_nm > 0.0 and (angle_rad > high or rate_rad_s > fast):
            return 0.0
        if torque_nm < 0.0 and (angle_rad < low or rate_rad_s < -fast):
            return 0.0
        return torque_nm
