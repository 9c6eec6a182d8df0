"""Is the arm alive, sound and where a joint can be? And the force sensor at its end."""

from __future__ import annotations

import math

from companion.config.vehicle import Vehicle
from companion.model.types import ArmState, ForceSample, Inputs, Vec2
from companion.safety.findings import Age, Findings, Situation
from companion.safety.rules import (
    ARM_LET_GO,
    ARM_LOST,
    ARM_READ_FAILURES,
    FORCE_DRIFT,
    FORCE_LOST,
    FORCE_OVERLOAD,
    FORCE_STUCK,
    JOINT_FAR_PAST_WALL,
    JOINT_JUMP,
    JOINT_RATE,
    JOINT_WALL,
    SERVO_ERROR,
    SERVO_HOT,
    SERVO_OVERLOAD,
    SERVO_WARM,
)

WATCHDOG_RESTARTED = 0x80
"""Bit of `ArmState.hardware_error` that is the companion's own."""
ERROR_NAMES = {0: "input voltage", 2: "overheating", 3: "motor encoder", 4: "electrical shock", 5: "overload"}
"""Bits of register 70, Hardware Error Status, of the XM430."""
AT_LIMIT = 0.97
"""Share of the torque limit from which on a joint counts as being there."""
DRIFT_TIME_S = 1.0


def error_text(errors: tuple[int, int]) -> str:
    """Hardware errors of both servos by name: "servo 2: overload, overheating"."""
    parts = []
    for index, error in enumerate(errors):
        bits = [bit for bit in range(7) if error >> bit & 1]
        if bits:
            names = ", ".join(ERROR_NAMES.get(bit, f"bit {bit}") for bit in bits)
            parts.append(f"servo {index + 1}: {names}")
    return "; ".join(parts)


class ArmMonitor:
    """Both servos."""

    def __init__(self, vehicle: Vehicle) -> None:
        s, (first, second) = vehicle.safety, vehicle.arm.joints
        self._s = s
        self._age = Age()
        self._before: ArmState | None = None
        self._jump_rad = math.radians(s.joint_jump_deg)
        self._rate_max_rad_s = math.radians(s.joint_rate_max_deg_s)
        self._torque_nm = (AT_LIMIT * first.torque_max_nm, AT_LIMIT * second.torque_max_nm)
        self._walls_rad = (_radians(first.angle_deg), _radians(second.angle_deg))
        self._wall_warn_rad, self._wall_max_rad = _radians((s.joint_wall_warn_deg, s.joint_wall_max_deg))

    def check(self, i: Inputs, awake_s: float, findings: Findings) -> None:
        """One tick; a joint state that was seen before is not judged again, but what was found of it still holds."""
        arm, s = i.arm, self._s
        if self._age.update(awake_s, arm.stamp_s if arm else None) > s.arm_timeout_s:
            findings.found(ARM_LOST, "no joint state from the arm")
        if arm is None:
            return
        if arm.read_failures >= s.arm_read_failures_max:
            findings.found(ARM_READ_FAILURES, "{} bus cycles without an answer", arm.read_failures)
        first, second = arm.hardware_error
        if first or second:
            self._errors(first, second, findings)
        before = self._before
        if before is not None and arm.stamp_s > before.stamp_s:
            step_rad = self._jump_rad + self._rate_max_rad_s * (arm.stamp_s - before.stamp_s)
            self._joint_jump(before.angle_rad, arm.angle_rad, step_rad, findings)
        self._before = arm
        hottest_c = max(arm.temperature_c)
        if hottest_c >= s.servo_warn_c:
            findings.found(SERVO_HOT if hottest_c >= s.servo_max_c else SERVO_WARM, "a servo at {:.0f} degC", hottest_c)
        (t1, t2), (limit1, limit2) = arm.torque_nm, self._torque_nm
        if not (-limit1 < t1 < limit1 and -limit2 < t2 < limit2):
            findings.found(SERVO_OVERLOAD, "joint torques {:.1f}, {:.1f} N m: at the limit", t1, t2)
        (w1, w2), top = arm.velocity_rad_s, self._rate_max_rad_s
        if not (-top < w1 < top and -top < w2 < top):
            text = "joint speeds {:.0f}, {:.0f} deg/s"
            findings.found(JOINT_RATE, text, math.degrees(w1), math.degrees(w2))
        (a1, a2), ((low1, high1), (low2, high2)) = arm.angle_rad, self._walls_rad
        if not (low1 <= a1 <= high1 and low2 <= a2 <= high2):
            self._wall(max(low1 - a1, a1 - high1, low2 - a2, a2 - high2), arm.angle_rad, findings)

    def _errors(self, first: int, second: int, findings: Findings) -> None:
        if (first | second) & ~WATCHDOG_RESTARTED:
            text = error_text((first, second))
            findings.found(SERVO_ERROR, "hardware error (register 70) of {}", text)
        if (first | second) & WATCHDOG_RESTARTED:
            findings.found(ARM_LET_GO, "the arm's bus watchdog had let go; torque is back")

    def _joint_jump(self, before_rad: Vec2, now_rad: Vec2, step_rad: float, findings: Findings) -> None:
        for index in (0, 1):
            step = now_rad[index] - before_rad[index]
            if not -step_rad < step < step_rad:
                text = "joint {} jumped by {:.0f} deg between two reads"
                findings.found(JOINT_JUMP, text, index + 1, math.degrees(step))

    def _wall(self, beyond_rad: float, angle_rad: Vec2, findings: Findings) -> None:
        values = (math.degrees(angle_rad[0]), math.degrees(angle_rad[1]), math.degrees(beyond_rad))
        if beyond_rad > self._wall_warn_rad:
            findings.found(JOINT_WALL, "joints at {:.0f}, {:.0f} deg: {:.0f} deg beyond a wall", *values)
        if beyond_rad > self._wall_max_rad:
            findings.found(JOINT_FAR_PAST_WALL, "joints at {:.0f}, {:.0f} deg: {:.0f} deg beyond a wall", *values)


class ForceMonitor:
    """The force-torque sensor."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._s = vehicle.safety
        self._force_max_n = vehicle.devices.force.force_max_n
        self._age = Age()
        self._before: ForceSample | None = None
        self._same_since_s: float | None = None
        self._moved = False
        self._mean_n = (0.0, 0.0, 0.0)
        self.trusted = True
        """Samples are measurements."""

    def check(
        self, i: Inputs, situation: Situation, awake_s: float, dt_s: float, moving: bool, findings: Findings
    ) -> None:
        """One tick."""
        force, s = i.force, self._s
        if self._age.update(awake_s, force.stamp_s if force else None) > s.force_timeout_s:
            findings.found(FORCE_LOST, "no force samples; the law flies on without")
        if force is not None:
            x, y, z = force.force_sensor_n
            if force.overload or x * x + y * y + z * z > self._force_max_n**2:
                findings.found(FORCE_OVERLOAD, "force sensor overloaded: {:.0f}, {:.0f}, {:.0f} N", x, y, z)
            self._stuck(force, situation, awake_s, moving, findings)
        self._drift(situation, dt_s, findings)

    def _stuck(
        self, force: ForceSample, situation: Situation, awake_s: float, moving: bool, findings: Findings
    ) -> None:
        before = self._before
        self._before = force
        if before is not None and force.stamp_s != before.stamp_s:
            if (
                force.force_sensor_n != before.force_sensor_n
                or force.torque_sensor_nm != before.torque_sensor_nm
                or not situation.airborne
            ):
                self._same_since_s, self.trusted = None, True
            elif self._same_since_s is None:
                self._same_since_s, self._moved = awake_s, False
        if self._same_since_s is not None:
            self._moved = self._moved or moving
            if self._moved and awake_s - self._same_since_s > self._s.force_stuck_s:
                self.trusted = False
                findings.found(FORCE_STUCK, "the force sensor repeats the same values; the law flies on without")

    def _drift(self, situation: Situation, dt_s: float, findings: Findings) -> None:
        control = situation.control
        if control is None or situation.caught or not situation.airborne:
            self._mean_n = (0.0, 0.0, 0.0)
            return
        (mx, my, mz), (x, y, z) = self._mean_n, control.force_ext_world_n
        k = dt_s / DRIFT_TIME_S
        mx, my, mz = self._mean_n = (mx + k * (x - mx), my + k * (y - my), mz + k * (z - mz))
        if mx * mx + my * my + mz * mz > self._s.force_drift_n**2:
            text = "the force sensor reads {:.1f}, {:.1f}, {:.1f} N on an empty net"
            findings.found(FORCE_DRIFT, text, mx, my, mz)


def _radians(pair_deg: Vec2) -> Vec2:
    return (math.radians(pair_deg[0]), math.radians(pair_deg[1]))
