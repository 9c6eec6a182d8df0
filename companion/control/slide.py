"""What a tip that slides along a surface needs besides the control law, the same for every law: a force along the surface, an arm that
answers the force error, and an attitude setpoint that opposes the moment of the friction and steers the tip.

The base moves by some millimetres in every gust. The joints answer the measured force error at once, while the base's push follows
slowly. Nothing makes the arm stiffer: a stiff arm whose torques come 5 ms late swings (docs/internals/contact.md). The friction of the
gears would keep 1 to 2 N of each answer from the tip; the torques that overcome it follow the measured joint rates.

Friction acts far ahead of the rotors and pitches the vehicle. PX4 holds the attitude against it only after its rate integrator has
followed; until then the thrust presses with 0.5 N per degree too much or too little, which changes the friction again: the tip sticks
and slips. The setpoint is therefore turned by moment over stiffness, and the turn ends as the integrator takes over.

The arm cannot move the tip sideways. A sliding tip yields to every sideways force, slowly, because friction opposes its velocity. The
rotors' yaw torque is the only one that acts there, so the reference has a turn of the yaw setpoint (`steer_rad`).
"""

from __future__ import annotations

import math

from companion.config.vehicle import Vehicle
from companion.control.arm_model import manipulator_of
from companion.control.types import PlantState
from companion.model.algebra import dot
from companion.model.frames import quat_conjugate, quat_from_euler_zyx, quat_multiply, quat_rotate
from companion.model.types import Joints, Quat, Reference, Vec3

FORCE_GAIN, FORCE_S, FORCE_MAX_N = 6.0, 0.07, 5.0
"""Gain of the arm's force on the force error, time constant of its filter, and its bound. The loop closes at gain / time constant =
86 rad/s.
"""
GEAR_LOSS_SHARE, GEAR_RATE_RAD_S = 0.15, 0.05
"""Friction of the gears that the joints overcome, as a fraction of the torque, in addition to `arm.joint_friction_nm`; and the rate
below which this torque fades out, two steps of the servos' velocity reading.
"""
ATTITUDE_P, RATE_P, INTEGRATOR_S = 6.5, 0.15, 0.75
"""PX4's defaults of MC_PITCH_P and MC_PITCHRATE_P, and MC_PITCHRATE_P over MC_PITCHRATE_I."""
TURN_MAX_RAD = math.radians(5.0)
"""Largest turn of the setpoint, per axis. With 10 deg, a force sensor that was wrong by 3 N on each axis led to a press with 13 N."""
OPPOSED_SHARE = 0.4
"""Fraction of the friction's moment that the setpoint opposes. With twice as much, the tip starts to swing."""


class Slide:
    """Adds to the command of a control law while the tip slides.

    Args:
        vehicle: its rotors give the stiffness of the attitude, its joints the limits of the torques.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._manipulator, self._torque_max_nm = manipulator_of(vehicle), vehicle.joint_torque_limits_nm
        self._friction_nm = vehicle.arm.joint_friction_nm
        airframe = vehicle.airframe
        arms_m = [abs(x) for x, _, _ in airframe.rotor_layout.positions_body_m]
        torque_max_nm = 0.5 * airframe.thrust_max_n * sum(arms_m, 0.0) / len(arms_m)
        self._rad_per_nm = OPPOSED_SHARE / (ATTITUDE_P * RATE_P * torque_max_nm)
        self._slides = False
        """Whether the tip slides or has slid since the touch."""
        self._held_nm = (0.0, 0.0)
        """Moment about body x and y that PX4's integrator holds."""
        self._answered_n = 0.0
        """Force along the press with which the arm answers the force error."""

    def torque_nm(
        self,
        dt_s: float,
        torque_nm: Joints,
        state: PlantState,
        force_world_n: Vec3 | None,
        direction_world: Vec3,
        measured_world_n: Vec3 | None,
    ) -> Joints:
        """Return the joint torques of a tick of a contact, within the joints' limits.

        Args:
            dt_s: time since the last tick.
            torque_nm: torques of the control law.
            state: state of the tick.
            force_world_n: force to exert with the tip; None unless it slides.
            direction_world: direction of the press, a unit vector.
            measured_world_n: measured force on the tip; None if it is unknown.
        """
        if force_world_n is None:
            self._answered_n = 0.0
            return torque_nm
        self._slides = True
        wanted_n = dot(force_world_n, direction_world)
        more_n = self._answer_n(dt_s, wanted_n, measured_world_n, direction_world) - wanted_n
        (fx, fy, fz), (nx, ny, nz) = force_world_n, direction_world
        force_world_n = (fx + more_n * nx, fy + more_n * ny, fz + more_n * nz)
        force_body_n = quat_rotate(quat_conjugate(state.attitude_wxyz), force_world_n)
        more_nm = self._manipulator.joint_torque_from_force(state.arm_rad, force_body_n)
        limited_nm = []
        for torque, more, rate, most in zip(torque_nm, more_nm, state.arm_rate_rad_s, self._torque_max_nm, strict=True):
            torque += more
            torque += (self._friction_nm + GEAR_LOSS_SHARE * abs(torque)) * math.tanh(rate / GEAR_RATE_RAD_S)
            limited_nm.append(min(max(torque, -most), most))
        return tuple(limited_nm)

    def _answer_n(self, dt_s: float, wanted_n: float, measured_world_n: Vec3 | None, direction_world: Vec3) -> float:
        """Return the force along the press with which the arm answers the force error."""
        error_n = 0.0 if measured_world_n is None else wanted_n + dot(measured_world_n, direction_world)
        answer_n = min(max(FORCE_GAIN * error_n, -FORCE_MAX_N), FORCE_MAX_N)
        self._answered_n += (1.0 - math.exp(-dt_s / FORCE_S)) * (answer_n - self._answered_n)
        return self._answered_n

    def attitude(
        self,
        dt_s: float,
        attitude_wxyz: Quat,
        state: PlantState,
        reference: Reference,
        friction_world_n: Vec3 | None,
    ) -> Quat:
        """Return the attitude setpoint, turned against the moment of the force on the tip along the surface and by `steer_rad`.

        Args:
            dt_s: time since the last tick.
            attitude_wxyz: setpoint of the control law.
            state: state of the tick.
            reference: its `steer_rad` turns the yaw.
            friction_world_n: measured force on the tip along the surface; None if it is unknown.
        """
        if not self._slides:
            return attitude_wxyz
        turn_x = turn_y = 0.0
        if friction_world_n is not None:
            fx, fy, fz = quat_rotate(quat_conjugate(state.attitude_wxyz), friction_world_n)
            x, y, z = self._manipulator.net_body_m(state.arm_rad)
            mx, my = y * fz - z * fy, z * fx - x * fz
            hx, hy = self._held_nm
            k = 1.0 - math.exp(-dt_s / INTEGRATOR_S)
            self._held_nm = hx, hy = hx + k * (mx - hx), hy + k * (my - hy)
            turn_x = min(max(self._rad_per_nm * (hx - mx), -TURN_MAX_RAD), TURN_MAX_RAD)
            turn_y = min(max(self._rad_per_nm * (hy - my), -TURN_MAX_RAD), TURN_MAX_RAD)
        return quat_multiply(attitude_wxyz, quat_from_euler_zyx(turn_x, turn_y, reference.steer_rad or 0.0))

    def end(self) -> None:
        """Forget the slide: the tool touches nothing any more."""
        self._slides, self._held_nm, self._answered_n = False, (0.0, 0.0), 0.0
