"""Slow, bounded motion of one joint at a time on the ground, and the conditions that stop it. No I/O: joint states in, torques out.
The controller is `companion.control.arm_hold` behind a speed-limited reference; a small integral term compensates for friction
and mass errors. Angles are defined as in the paper; the body is assumed to be level.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from companion.config.arm import Arm
from companion.config.vehicle import Vehicle
from companion.control.arm_hold import ArmHold
from companion.control.arm_model import manipulator_of
from companion.model.servos import WATCHDOG_ERROR, hardware_error_text
from companion.model.types import IDENTITY_QUAT, ArmState, Joints

SPEED_MAX_DEG_S: Final = 20.0
ACCELERATION_DEG_S2: Final = 60.0
TORQUE_SHARE: Final = 0.6
"""Torque limit of each servo as a fraction of `torque_max_nm`."""
LOAD_NM: Final = 0.5
"""Torque beyond gravity that indicates an obstacle if it lasts for `LOAD_S`; so does a joint at its torque limit, which is lower for
a small servo."""
LOAD_S: Final = 0.15
LIMIT_MARGIN_DEG: Final = 3.0
RUNAWAY_DEG_S: Final = 90.0
"""Speed that a joint reaches only if its sign is wrong or it is pulled."""
ASTRAY_DEG: Final = 10.0
"""Distance of a joint from its reference at which the motion stops."""
REACHED_DEG: Final = 0.7
_INTEGRAL_NM_RAD_S: Final = 12.0
_INTEGRAL_MAX_NM: Final = 0.25
_LEAD_RAD: Final = math.radians(5.0)
"""Lag of a joint behind its reference at which the reference stops and waits."""


def gentle(arm: Arm) -> Arm:
    """Return the arm's configuration with `TORQUE_SHARE` of the torque limits, to which the driver clips every command."""
    joints = tuple(
        joint.model_copy(update={"torque_max_nm": TORQUE_SHARE * joint.torque_max_nm}) for joint in arm.joints
    )
    return arm.model_copy(update={"joints": joints})


def limits_deg(arm: Arm, joint: int) -> tuple[float, float]:
    """Return the joint limits minus a margin."""
    low, high = arm.joints[joint].angle_deg
    return low + LIMIT_MARGIN_DEG, high - LIMIT_MARGIN_DEG


@dataclass(frozen=True, slots=True)
class Moved:
    """Result of one control step."""

    torque_nm: Joints
    reference_rad: Joints
    reference_rate_rad_s: Joints
    load_nm: Joints
    """Torque beyond gravity."""
    reached: bool
    """Whether reference and joint are at the goal."""
    stop: str = ""
    """Why the motion has to end immediately, with zero torque; empty if it may continue."""


class Motion:
    """Controls all joints, of which one moves at a time."""

    def __init__(self, vehicle: Vehicle, state: ArmState) -> None:
        self._vehicle = vehicle
        self._arm = vehicle.arm
        self._manipulator = manipulator_of(vehicle)
        self._hold = ArmHold(vehicle)
        self._limit_nm = tuple(TORQUE_SHARE * joint.torque_max_nm for joint in vehicle.arm.joints)
        self._reference = list(state.angle_rad)
        self._count = len(vehicle.arm.joints)
        self._rate = [0.0] * self._count
        self._goal = list(state.angle_rad)
        self._integral = [0.0] * self._count
        self._loaded_s = 0.0
        self._speed_rad_s = math.radians(SPEED_MAX_DEG_S)
        self.load_max_nm = [0.0] * self._count
        """Largest torque beyond gravity so far."""

    @property
    def reference_rad(self) -> Joints:
        """The reference of each joint."""
        return tuple(self._reference)

    def go(self, joint: int, goal_rad: float, speed_rad_s: float) -> None:
        """Start moving a joint; the others stay at their references.

        Args:
            goal_rad: goal, clipped to the joint limits minus the margin; a joint beyond them may only return.
            speed_rad_s: speed, limited to `SPEED_MAX_DEG_S`.
        """
        low, high = (math.radians(limit) for limit in limits_deg(self._arm, joint))
        here = self._reference[joint]
        self._goal = list(self._reference)
        self._goal[joint] = max(min(low, here), min(max(high, here), goal_rad))
        self._speed_rad_s = min(speed_rad_s, math.radians(SPEED_MAX_DEG_S))

    def halt(self) -> None:
        """Stop all joints at their references."""
        self._goal = list(self._reference)
        self._rate = [0.0] * self._count

    def refusal(self, poses_rad: Sequence[Joints]) -> str:
        """Return why the arm must not move to these poses (rad); empty if it may."""
        for pose in poses_rad:
            gravity = self._manipulator.gravity_torque_nm(pose, IDENTITY_QUAT)
            for joint in range(self._count):
                if abs(gravity[joint]) > 0.9 * self._limit_nm[joint]:
                    where = f"({', '.join(f'{math.degrees(angle):.0f}' for angle in pose)}) deg"
                    return (
                        f"at {where} joint {joint + 1} carries {abs(gravity[joint]):.2f} N m, more than 90 % of the "
                        f"{self._limit_nm[joint]:.2f} N m allowed here; choose a pose closer to hanging"
                    )
        return ""

    def step(self, state: ArmState, dt_s: float) -> Moved:
        """Compute one control step.

        Args:
            dt_s: time since the last step; a late step moves the reference by at most 20 ms.
        """
        dt_s = min(dt_s, 0.02)
        for joint in range(self._count):
            self._lead(joint, state.angle_rad[joint], dt_s)
        reference = self.reference_rad
        rate = tuple(self._rate)
        gravity = self._manipulator.gravity_torque_nm(state.angle_rad, IDENTITY_QUAT)
        held = self._hold.torque_nm(state.angle_rad, state.velocity_rad_s, reference, rate, IDENTITY_QUAT)
        torque = [
            self._torque_nm(joint, held[joint], reference[joint] - state.angle_rad[joint], dt_s)
            for joint in range(self._count)
        ]
        load = tuple(a - b for a, b in zip(torque, gravity, strict=True))
        self.load_max_nm = [max(most, abs(now)) for most, now in zip(self.load_max_nm, load, strict=True)]
        pressing = [
            abs(beyond_nm) > LOAD_NM or abs(torque_nm) >= most_nm
            for beyond_nm, torque_nm, most_nm in zip(load, torque, self._limit_nm, strict=True)
        ]
        self._loaded_s = self._loaded_s + dt_s if any(pressing) else 0.0
        stop = self._stop(state, load, pressing)
        if stop:
            torque = [0.0] * self._count
        reached = all(
            self._goal[joint] == reference[joint]
            and abs(reference[joint] - state.angle_rad[joint]) <= math.radians(REACHED_DEG)
            for joint in range(self._count)
        )
        return Moved(
            torque_nm=tuple(torque),
            reference_rad=reference,
            reference_rate_rad_s=rate,
            load_nm=load,
            reached=reached,
            stop=stop,
        )

    def _lead(self, joint: int, angle_rad: float, dt_s: float) -> None:
        """Move the reference towards the goal within its speed limit, and not away from a joint that does not follow."""
        left = self._goal[joint] - self._reference[joint]
        if left == 0.0:
            self._rate[joint] = 0.0
            return
        way = math.copysign(1.0, left)
        most = math.radians(ACCELERATION_DEG_S2)
        speed = min(self._speed_rad_s, abs(self._rate[joint]) + most * dt_s, math.sqrt(2.0 * most * abs(left)))
        if way * (self._reference[joint] - angle_rad) > _LEAD_RAD:
            speed = 0.0
        if speed * dt_s >= abs(left) or abs(left) < 1e-6:
            self._reference[joint], self._rate[joint] = self._goal[joint], 0.0
        else:
            self._reference[joint] += way * speed * dt_s
            self._rate[joint] = way * speed

    def _torque_nm(self, joint: int, held_nm: float, error_rad: float, dt_s: float) -> float:
        most = self._limit_nm[joint]
        grown = self._integral[joint] + self._hold.ratios[joint] * _INTEGRAL_NM_RAD_S * error_rad * dt_s
        self._integral[joint] = max(-_INTEGRAL_MAX_NM, min(_INTEGRAL_MAX_NM, grown))
        return max(-most, min(most, held_nm + self._integral[joint]))

    def _stop(self, state: ArmState, load: Joints, pressing: Sequence[bool]) -> str:
        safety = self._vehicle.safety
        for joint in range(self._count):
            name = f"joint {joint + 1}"
            error = state.hardware_error[joint]
            if error & WATCHDOG_ERROR:
                return f"{name}: the bus watchdog tripped: this computer was too busy, or a cable is loose"
            if error:
                return f"{name}: hardware error: {hardware_error_text(error)}; remove the cause, then run companion arm reboot"
            if state.temperature_c[joint] >= safety.servo_warn_c:
                return f"{name}: {state.temperature_c[joint]:.0f} degC; let the arm cool down"
            if abs(math.degrees(state.velocity_rad_s[joint])) > RUNAWAY_DEG_S:
                return f"{name} runs away; unless it was pulled, its sign is wrong: companion arm zero"
            astray_deg = math.degrees(abs(state.angle_rad[joint] - self._reference[joint]))
            if astray_deg > ASTRAY_DEG:
                return f"{name} is {astray_deg:.0f} deg from its reference; check for an obstacle or for something that pulls it"
            low, high = self._arm.joints[joint].angle_deg
            angle_deg = math.degrees(state.angle_rad[joint])
            if not low <= angle_deg <= high:
                return f"{name} is at {angle_deg:.0f} deg, beyond its limits, {low:g} to {high:g} deg; move it back by hand"
        if self._loaded_s > LOAD_S:
            joint = max(range(self._count), key=lambda index: (pressing[index], abs(load[index])))
            return (
                f"joint {joint + 1}: {load[joint]:+.2f} N m beyond gravity; check for an obstacle, and check the masses "
                "and the torque constant in the vehicle file"
            )
        return ""
