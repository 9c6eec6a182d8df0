"""The arm's servos and the force sensor at its end: trackers of their state, and the predicates of their rules.

The rows of these rules, with the actions and the texts for the operator, are in `companion.safety.rules`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from companion.model.algebra import dot, minus, plus, scaled
from companion.model.constants import TICK_PERIOD_S
from companion.model.listing import listed
from companion.model.servos import WATCHDOG_ERROR, hardware_error_text
from companion.model.team import Grip
from companion.model.types import ArmState, ForceSample, Inputs, Joints, Vec2, Vec3
from companion.safety.flight_context import HOLDS, Age, FlightContext, Values
from companion.safety.joint_swing import JointSwing

AT_LIMIT: Final = 0.97
"""Fraction of the torque limit at which a joint counts as being at its limit."""
REFUSED_MAX_S: Final = 0.1
"""Time without usable joint torques after which the vehicle lands. `REFUSED_FORGOTTEN` of the time with usable ones is taken off."""
REFUSED_FORGOTTEN: Final = 0.25
LATE_S: Final = 0.005
"""Age beyond which a joint state counts as late. Torques are computed for the angles and rates predicted from it
(`companion.control.joint_prediction`), whose margin is used up at 20 ms."""
MISSING_S: Final = 0.05
"""Time since the last answer beyond which a joint state is missing and not late: `arm_read_failures` and `arm_lost` report that."""
LATE_SHARE: Final = 0.08
"""Share of ticks with a late joint state from which the bus counts as late."""
LATE_TIME_S: Final = 1.0
"""Time constant of that share."""
DRIFT_TIME_S: Final = 1.0
"""Time constant of the mean force."""
CHANGE_SHORT_S: Final = 0.5
CHANGE_LONG_S: Final = 5.0
"""Time constants of the two low-pass filters whose difference is the change of a force: a payload or a shifted zero, but not steady
wind or a wrong hover thrust."""
CHANGE_MIN_N: Final = 0.5
"""Change of the measured force below which it has no direction that could be judged."""
CHANGE_SHARE: Final = 0.6
"""Smallest unexplained part of the measured change: a sensor's scale and mounting explain less."""
CHANGE_HOLD_S: Final = 0.3
CHANGE_ABOVE_M: Final = 0.1
"""Height above standing height from which the floor does not carry the vehicle."""
CHANGE_CHASED_S: Final = 1.0
"""Time after the accelerations of a chase from which the changes are compared again: while the vehicle swings, rotors and attitude lag,
and its motion shows forces of several newtons that are none."""
CHANGE_AGE_MAX_S: Final = 0.05
"""Age of a sample from which there is no measured force to compare."""
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
        self.clamp_error = 0
        """Hardware error of the clamp's servo (register 70); 0 without one."""
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
        self.torque_refused = ""
        """Why the law's joint torques were not sent when that last happened; empty before."""
        self.refused_s = 0.0
        """Time in which the law's joint torques were not sent, less `REFUSED_FORGOTTEN` of the time in which they were."""
        self._awake_s = 0.0

    def update(self, i: Inputs, awake_s: float, torque_refused: str | None = None) -> None:
        """Update with the inputs of one tick."""
        dt_s, self._awake_s = awake_s - self._awake_s, awake_s
        if torque_refused is not None:
            self.torque_refused = torque_refused
            self.refused_s = min(self.refused_s + dt_s, 2.0 * REFUSED_MAX_S)
        elif self.refused_s > 0.0:
            self.refused_s -= REFUSED_FORGOTTEN * dt_s
        self.clamp_error = 0 if i.clamp is None else i.clamp.hardware_error or 0
        arm = self.arm = i.arm
        self.age_s = self._age.update(awake_s, arm.stamp_s if arm else None)
        self.before, self.hottest_c = None, -math.inf
        if arm is not None:
            self.hottest_c = max(arm.temperature_c)
            newest, self._newest = self._newest, arm
            if newest is not None and arm.stamp_s > newest.stamp_s:
                self.before = newest
                self._swing.update(arm)
            if i.t_s - arm.stamp_s <= MISSING_S:
                self._update_lateness(i.t_s - arm.measured_s)
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
    """Fires if the law's joint torques were too often not sent, in a row or not."""
    return (a.torque_refused,) if a.refused_s >= REFUSED_MAX_S else None


def servo_error(a: ArmTracker, _: None) -> Values | None:
    """Fires if a servo reports a hardware error."""
    text = error_text(a.arm.hardware_error) if a.arm is not None and any(a.arm.hardware_error) else ""
    return (text,) if text else None


def clamp_error(a: ArmTracker, _: None) -> Values | None:
    """Fires if the clamp's servo reports a hardware error."""
    return (hardware_error_text(a.clamp_error),) if a.clamp_error else None


def servo_watchdog_tripped(a: ArmTracker, _: None) -> Values | None:
    """Fires if a servo's bus watchdog has switched the torque off."""
    errors = a.arm.hardware_error if a.arm is not None else ()
    return HOLDS if any(errors) and any(error & WATCHDOG_ERROR for error in errors) else None


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


def _lowpassed(mean_n: Vec3, force_n: Vec3, gain: float) -> Vec3:
    return plus(mean_n, scaled(minus(force_n, mean_n), gain))


class _Change:
    """Change of a force, N: its low-pass-filtered value minus its slow mean."""

    __slots__ = ("_fast_n", "_slow_n")

    def __init__(self) -> None:
        self._fast_n, self._slow_n = _NO_FORCE, _NO_FORCE

    def update(self, dt_s: float, force_n: Vec3) -> Vec3:
        """Update with the force of one tick and return its change."""
        fast_s, slow_s = CHANGE_SHORT_S, CHANGE_LONG_S
        fx, fy, fz = self._fast_n = _lowpassed(self._fast_n, force_n, dt_s / (fast_s + dt_s))
        sx, sy, sz = self._slow_n = _lowpassed(self._slow_n, force_n, dt_s / (slow_s + dt_s))
        return (fx - sx, fy - sy, fz - sz)


class ForceTracker:
    """Tracks the samples of the force-torque sensor.

    Args:
        stuck_s: hold time after which samples that repeat themselves count as lost, `safety.force_stuck_s`.
        disagreement_n: threshold of the change of the measured force that the vehicle's motion does not show,
            `safety.force_disagreement_n`.
        clearance_m: height of the body's origin when the vehicle is on the ground.
    """

    def __init__(self, stuck_s: float, disagreement_n: float, clearance_m: float) -> None:
        self._stuck_s, self._disagreement_n = stuck_s, disagreement_n
        self._low_m = clearance_m + CHANGE_ABOVE_M
        self._measured, self._felt = _Change(), _Change()
        self._off_s = 0.0
        self._swings_s = 0.0
        """Time until the changes are compared again, after a chase."""
        self.off_n: tuple[Vec3, Vec3] | None = None
        """Changes of the measured force and of the force that moves the vehicle, when they first disagreed in this flight; the samples
        are not passed on from then on."""
        self._age = Age()
        self._before: ForceSample | None = None
        self._same_since_s: float | None = None
        self._moved = False
        self.force: ForceSample | None = None
        self.age_s = 0.0
        self.stuck = False
        """Whether samples repeat themselves although the vehicle is moving."""
        self._repeats = False
        self.mean_n: Vec3 = _NO_FORCE
        """Low-passed external force in the world frame while the controller flies with an empty net; else 0."""

    @property
    def trusted(self) -> bool:
        """Return whether samples are passed on: not while they repeat themselves, nor after they disagreed with the motion."""
        return not self._repeats and self.off_n is None

    def update(self, i: Inputs, context: FlightContext, awake_s: float, dt_s: float, moving: bool) -> None:
        """Update with the inputs of one tick; `moving` is True if PX4's velocity or rates show that the vehicle is moving."""
        force = self.force = i.force
        self.age_s = self._age.update(awake_s, force.stamp_s if force else None)
        self.stuck = False
        if force is not None:
            self._compare(force, context, awake_s, moving)
        control, felt_n = context.control, context.disturbance_world_n
        if control is None or context.contact_n is not None or not context.airborne:
            self.mean_n, self._measured, self._felt = _NO_FORCE, _Change(), _Change()
            return
        measured_n = control.force_measured_world_n or control.force_ext_world_n
        low = i.vehicle is None or i.vehicle.position_world_m[2] < self._low_m
        self._swings_s = CHANGE_CHASED_S if context.chases else max(0.0, self._swings_s - dt_s)
        if low or felt_n is None or self.age_s > CHANGE_AGE_MAX_S or self._swings_s > 0.0:
            self._measured, self._felt = _Change(), _Change()
        elif self.trusted:
            self._disagree(dt_s, self._measured.update(dt_s, measured_n), self._felt.update(dt_s, felt_n))
        if context.caught or context.grip is not Grip.FREE:
            self.mean_n = _NO_FORCE
        else:
            self.mean_n = _lowpassed(self.mean_n, measured_n, dt_s / DRIFT_TIME_S)

    def _disagree(self, dt_s: float, measured_n: Vec3, felt_n: Vec3) -> None:
        """Compare the two changes along the measured one."""
        size_n = math.sqrt(dot(measured_n, measured_n))
        if size_n > CHANGE_MIN_N:
            off_n = size_n - dot(measured_n, felt_n) / size_n
            self._off_s = self._off_s + dt_s if off_n > max(self._disagreement_n, CHANGE_SHARE * size_n) else 0.0
            if self._off_s > CHANGE_HOLD_S:
                self.off_n = (measured_n, felt_n)
        else:
            self._off_s = 0.0

    def _compare(self, force: ForceSample, context: FlightContext, awake_s: float, moving: bool) -> None:
        before = self._before
        self._before = force
        if before is not None and force.stamp_s != before.stamp_s:
            if (
                force.force_sensor_n != before.force_sensor_n
                or force.torque_sensor_nm != before.torque_sensor_nm
                or not context.airborne
            ):
                self._same_since_s, self._repeats = None, False
            elif self._same_since_s is None:
                self._same_since_s, self._moved = awake_s, False
        if self._same_since_s is not None:
            self._moved = self._moved or moving
            if self._moved and awake_s - self._same_since_s > self._stuck_s:
                self.stuck, self._repeats = True, True


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


def force_disagrees(f: ForceTracker, _: None) -> Values | None:
    """Fires if the measured force has changed in a way that the vehicle's motion does not show."""
    return None if f.off_n is None else (*f.off_n[0], *f.off_n[1])
