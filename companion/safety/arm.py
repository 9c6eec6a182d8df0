"""The arm's servos and the force sensor at its end: trackers of their state, and the predicates of their rules.

The rows of these rules, with the actions and the texts for the operator, are in `companion.safety.rules`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from companion.model.constants import TICK_PERIOD_S
from companion.model.listing import listed
from companion.model.servos import WATCHDOG_ERROR, hardware_error_text
from companion.model.types import ArmState, ForceSample, Inputs, Joints, Vec2, Vec3
from companion.safety.joint_swing import JointSwing
from companion.safety.situation import HOLDS, Age, Situation, Values

AT_LIMIT: Final = 0.97
"""Fraction of the torque limit at which a joint counts as being at its limit."""
LATE_S: Final = 0.005
"""Age beyond which a joint state counts as late. Torques are computed for the angles and rates predicted from it
(`companion.control.joint_prediction`), whose margin is used up at 20 ms."""
MISSING_S: Final = 0.05
"""Age beyond which a joint state is missing and not late: `arm_read_failures` and `arm_lost` report that."""
LATE_SHARE: Final = 0.08
"""Share of ticks with a late joint state from which the bus counts as late."""
LATE_TIME_S: Final = 1.0
"""Time constant of that share."""
DRIFT_TIME_S: Final = 1.0
"""Time constant of the mean force."""
_NO_FORCE: Vec3 = (0.0, 0.0, 0.0)


def error_text(errors: Sequence[int]) -> str:
    """Return the hardware errors of all servos by name: "servo 2: overheating, overload"."""
    own = [error & ~WATCHDOG_ERROR for error in errors]
    return "; ".join(f"servo {number}: {hardware_error_text(error)}" for number, error in enumerate(own, 1) if error)


class ArmTracker:
    """Tracks the joint state of all servos."""

    def __init__(self) -> None:
        self._age = Age()
        self._newest: ArmState | None = None
        self.arm: ArmState | None = None
        self.before: ArmState | None = None
        """Previous joint state; None if this tick has no new one."""
        self.age_s = 0.0
        self.late_share = 0.0
        """Low-passed share of ticks whose joint state was late."""
        self._late_s = 0.0
        self.swing: tuple[int, float, float] | None = None
        """Number of a joint that swings, its frequency in Hz and its rate amplitude in rad/s; None if none does."""
        self._swing = JointSwing()
        self.hottest_c = -math.inf
        """Temperature of the hottest servo; -inf without a joint state."""
        self.torque_refused: str | None = None
        """Why the law's joint torques were not sent in the last tick; None if they were."""

    def update(self, i: Inputs, awake_s: float, torque_refused: str | None = None) -> None:
        """Update with the inputs of one tick."""
        self.torque_refused = torque_refused
        arm = self.arm = i.arm
        self.age_s = self._age.update(awake_s, arm.stamp_s if arm else None)
        self.before, self.hottest_c = None, -math.inf
        if arm is not None:
            self.hottest_c = max(arm.temperature_c)
            newest, self._newest = self._newest, arm
            if newest is not None and arm.stamp_s > newest.stamp_s:
                self.before = newest
                self._swing.update(arm)
            age_s = i.t_s - arm.measured_s
            if age_s <= MISSING_S:
                self._update_lateness(age_s)
        self.swing = self._swing.swinging(i.t_s)

    @property
    def late_s(self) -> float:
        """Return the mean age of the late joint states of the last second."""
        return self._late_s / self.late_share if self.late_share > 0.0 else 0.0

    def _update_lateness(self, age_s: float) -> None:
        late, k = age_s > LATE_S, TICK_PERIOD_S / LATE_TIME_S
        self.late_share += k * (late - self.late_share)
        self._late_s += k * (late * age_s - self._late_s)


def arm_lost(a: ArmTracker, timeout_s: float) -> Values | None:
    """Fires if no joint state has arrived for longer than the timeout."""
    return (timeout_s,) if a.age_s > timeout_s else None


def arm_read_failures(a: ArmTracker, failures_max: int) -> Values | None:
    """Fires if consecutive bus cycles without an answer have reached the limit."""
    arm = a.arm
    return (arm.read_failures,) if arm is not None and arm.read_failures >= failures_max else None


def joint_states_late(a: ArmTracker, _: None) -> Values | None:
    """Fires if too many ticks use a late joint state."""
    if a.late_share < LATE_SHARE:
        return None
    return (100.0 * a.late_share, LATE_S * 1e3, a.late_s * 1e3, 100.0 * LATE_SHARE)


def joint_swings(a: ArmTracker, _: None) -> Values | None:
    """Fires if a joint swings."""
    if a.swing is None:
        return None
    joint, frequency_hz, rate_rad_s = a.swing
    return (joint, frequency_hz, math.degrees(rate_rad_s))


def torque_refused(a: ArmTracker, _: None) -> Values | None:
    """Fires if the law's joint torques were not sent."""
    return (a.torque_refused,) if a.torque_refused is not None else None


def servo_error(a: ArmTracker, _: None) -> Values | None:
    """Fires if a servo reports a hardware error."""
    arm = a.arm
    if arm is None:
        return None
    if any(arm.hardware_error):
        for error in arm.hardware_error:
            if error & ~WATCHDOG_ERROR:
                return (error_text(arm.hardware_error),)
    return None


def arm_let_go(a: ArmTracker, _: None) -> Values | None:
    """Fires if a servo's bus watchdog has switched the torque off."""
    arm = a.arm
    if arm is not None and any(arm.hardware_error):
        for error in arm.hardware_error:
            if error & WATCHDOG_ERROR:
                return HOLDS
    return None


def joint_jump(a: ArmTracker, thresholds: Vec2) -> Values | None:
    """Fires if a joint has turned further between two reads than the thresholds allow: an angle plus a rate times the interval."""
    before, arm = a.before, a.arm
    if before is None or arm is None:
        return None
    jump_rad, rate_max_rad_s = thresholds
    step_rad = jump_rad + rate_max_rad_s * (arm.stamp_s - before.stamp_s)
    for index in range(len(arm.angle_rad) - 1, -1, -1):
        step = arm.angle_rad[index] - before.angle_rad[index]
        if not -step_rad < step < step_rad:
            return (index + 1, math.degrees(step))
    return None


def servo_warm(a: ArmTracker, thresholds: Vec2) -> Values | None:
    """Fires if the hottest servo's temperature has reached the first threshold but not the second."""
    return (a.hottest_c, thresholds[0]) if thresholds[0] <= a.hottest_c < thresholds[1] else None


def servo_hot(a: ArmTracker, thresholds: Vec2) -> Values | None:
    """Fires if the hottest servo's temperature has reached both thresholds."""
    if not (a.hottest_c >= thresholds[0] and a.hottest_c >= thresholds[1]):
        return None
    return (a.hottest_c, max(thresholds))


def servo_overload(a: ArmTracker, torque_max_nm: Joints) -> Values | None:
    """Fires if a joint is at its torque limit."""
    if a.arm is None:
        return None
    torques_nm = a.arm.torque_nm
    for joint, max_nm in enumerate(torque_max_nm):
        limit_nm = AT_LIMIT * max_nm
        if not -limit_nm < torques_nm[joint] < limit_nm:
            return (listed(torques_nm, ".1f", " and "),)
    return None


def joint_rate(a: ArmTracker, rate_max_rad_s: float) -> Values | None:
    """Fires if the speed of a joint exceeds the threshold."""
    if a.arm is None:
        return None
    for rate_rad_s in a.arm.velocity_rad_s:
        if not -rate_max_rad_s < rate_rad_s < rate_max_rad_s:
            rates = listed(map(math.degrees, a.arm.velocity_rad_s), ".0f", " and ")
            return (rates, math.degrees(rate_max_rad_s))
    return None


def joint_beyond_limit(a: ArmTracker, thresholds: tuple[float, tuple[Vec2, ...]]) -> Values | None:
    """Fires if a joint is further beyond its limits than the first threshold; the second is each joint's lower and upper limit."""
    if a.arm is None:
        return None
    beyond_max_rad, limits_rad = thresholds
    angles_rad, beyond_rad = a.arm.angle_rad, 0.0
    for joint, (low_rad, high_rad) in enumerate(limits_rad):
        angle_rad = angles_rad[joint]
        if not low_rad <= angle_rad <= high_rad:
            beyond_rad = max(beyond_rad, low_rad - angle_rad, angle_rad - high_rad)
    if not beyond_rad > beyond_max_rad:
        return None
    return (listed(map(math.degrees, angles_rad), ".0f"), math.degrees(beyond_rad))


class ForceTracker:
    """Tracks the samples of the force-torque sensor.

    Args:
        stuck_s: hold time after which samples that repeat themselves count as lost, `safety.force_stuck_s`.
    """

    def __init__(self, stuck_s: float) -> None:
        self._stuck_s = stuck_s
        self._age = Age()
        self._before: ForceSample | None = None
        self._same_since_s: float | None = None
        self._moved = False
        self.force: ForceSample | None = None
        self.age_s = 0.0
        self.stuck = False
        """Whether samples repeat themselves although the vehicle is moving."""
        self.trusted = True
        """Whether samples are passed on; False while they repeat themselves."""
        self.mean_n: Vec3 = _NO_FORCE
        """Low-passed external force in the world frame while the controller flies with an empty net; else 0."""

    def update(self, i: Inputs, situation: Situation, awake_s: float, dt_s: float, moving: bool) -> None:
        """Update with the inputs of one tick; `moving` is True if PX4's velocity or rates show that the vehicle is moving."""
        force = self.force = i.force
        self.age_s = self._age.update(awake_s, force.stamp_s if force else None)
        self.stuck = False
        if force is not None:
            self._compare(force, situation, awake_s, moving)
        control = situation.control
        if control is None or situation.caught or situation.contact_n is not None or not situation.airborne:
            self.mean_n = _NO_FORCE
            return
        mx, my, mz = self.mean_n
        x, y, z = control.force_measured_world_n or control.force_ext_world_n
        k = dt_s / DRIFT_TIME_S
        self.mean_n = (mx + k * (x - mx), my + k * (y - my), mz + k * (z - mz))

    def _compare(self, force: ForceSample, situation: Situation, awake_s: float, moving: bool) -> None:
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
            if self._moved and awake_s - self._same_since_s > self._stuck_s:
                self.stuck, self.trusted = True, False


def force_lost(f: ForceTracker, timeout_s: float) -> Values | None:
    """Fires if no sample has arrived for longer than the timeout."""
    return (timeout_s,) if f.age_s > timeout_s else None


def force_overload(f: ForceTracker, force_max_n: float) -> Values | None:
    """Fires if the sensor reports an overload, or a force beyond its range."""
    if f.force is None:
        return None
    x, y, z = f.force.force_sensor_n
    return (x, y, z) if f.force.overload or x * x + y * y + z * z > force_max_n * force_max_n else None


def force_stuck(f: ForceTracker, _: None) -> Values | None:
    """Fires if samples repeat themselves although the vehicle is moving."""
    return HOLDS if f.stuck else None


def force_drift(f: ForceTracker, drift_n: float) -> Values | None:
    """Fires if the mean force on an empty net exceeds the threshold."""
    x, y, z = f.mean_n
    return (x, y, z, drift_n) if x * x + y * y + z * z > drift_n * drift_n else None
