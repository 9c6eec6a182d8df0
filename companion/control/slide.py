"""What a tip that slides along a surface needs besides the control law, the same for every law: a force along the surface, an arm that
is stiff along the surface and holds the force across it, and an attitude setpoint that opposes the moment of the friction.

The base moves by some millimetres in every gust. An arm that is stiff in all directions turns each of them into a newton; this one
returns only motion along the surface, and its joints answer the measured force error at once, while the base's push follows slowly.

Friction acts far ahead of the rotors and pitches the vehicle. PX4 holds the attitude against it only after its rate integrator has
followed; until then the thrust presses with 0.5 N per degree too much or too little, which changes the friction again: the tip sticks
and slips. The setpoint is therefore turned by moment over stiffness, and the turn ends as the integrator takes over.
"""

from __future__ import annotations

import math

from companion.config.vehicle import Vehicle
from companion.control.arm_model import manipulator_of
from companion.control.types import PlantState
from companion.model.algebra import cross, dot, mat_vec
from companion.model.frames import quat_conjugate, quat_from_euler_zyx, quat_multiply, quat_rotate
from companion.model.types import Joints, Quat, Vec3

STIFF_NM_RAD, STIFF_NMS_RAD = 20.0, 0.8
"""Stiffness and damping of the joints in addition to those of the law, but for the motion that moves the tip across the surface only:
with an arm that is soft enough to catch a payload, a tip that friction has released jumps off the surface.
"""
FORCE_GAIN, FORCE_S, FORCE_MAX_N = 6.0, 0.1, 5.0
"""Gain of the arm's force on the force error, time constant of its filter, and its bound. The loop closes at gain / time constant =
60 rad/s: 0.6 to 0.9 rad of delay with a sensor and servos that are read every 5 ms.
"""
_DAMPED_M2 = 1e-4
"""Added to J J', so that a direction in which the arm cannot move the tip counts as one that nothing asks for."""
SOFTEN_S = 0.3
"""Time constant with which that stiffness ends after the slide."""
ATTITUDE_P, RATE_P, INTEGRATOR_S = 6.5, 0.15, 0.75
"""PX4's defaults of MC_PITCH_P and MC_PITCHRATE_P, and MC_PITCHRATE_P over MC_PITCHRATE_I."""
TURN_MAX_RAD = math.radians(10.0)
"""Largest turn of the setpoint, per axis: a wrong reading of the force sensor must not tilt the vehicle further."""
OPPOSED_SHARE = 0.4
"""Fraction of the friction's moment that the setpoint opposes. With twice as much, the tip starts to swing."""


class Slide:
    """Adds to the command of a control law while the tip slides.

    Args:
        vehicle: its rotors give the stiffness of the attitude, its joints the limits of the torques.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._manipulator, self._torque_max_nm = manipulator_of(vehicle), vehicle.joint_torque_limits_nm
        airframe = vehicle.airframe
        arms_m = [abs(x) for x, _, _ in airframe.rotor_layout.positions_body_m]
        torque_max_nm = 0.5 * airframe.thrust_max_n * sum(arms_m, 0.0) / len(arms_m)
        self._rad_per_nm = OPPOSED_SHARE / (ATTITUDE_P * RATE_P * torque_max_nm)
        self._stiff_rad: Joints | None = None
        """Joint angles to which the stiff arm returns; None if nothing slides."""
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
        if force_world_n is None and self._stiff_rad is None:
            return torque_nm
        arm_rad, stiff_rad = state.arm_rad, self._stiff_rad or state.arm_rad
        more: Joints = (0.0,) * len(arm_rad)
        to_body = quat_conjugate(state.attitude_wxyz)
        if force_world_n is not None:
            wanted_n = dot(force_world_n, direction_world)
            more_n = self._answer_n(dt_s, wanted_n, measured_world_n, direction_world) - wanted_n
            (fx, fy, fz), (nx, ny, nz) = force_world_n, direction_world
            force = quat_rotate(to_body, (fx + more_n * nx, fy + more_n * ny, fz + more_n * nz))
            more = self._manipulator.joint_torque_from_force(arm_rad, force)
        else:
            k = dt_s / SOFTEN_S
            stiff_rad = tuple([s + k * (a - s) for s, a in zip(stiff_rad, arm_rad, strict=True)])
        self._stiff_rad = stiff_rad
        free = self._free(arm_rad, quat_rotate(to_body, direction_world))
        off, rates = [a - s for a, s in zip(arm_rad, stiff_rad, strict=True)], state.arm_rate_rad_s
        yields, yields_s = 0.0, 0.0
        for d, a, v in zip(free, off, rates, strict=True):
            yields, yields_s = yields + d * a, yields_s + d * v
        torques = []
        for t, f, a, v, d, most in zip(torque_nm, more, off, rates, free, self._torque_max_nm, strict=True):
            t += f - STIFF_NM_RAD * (a - yields * d) - STIFF_NMS_RAD * (v - yields_s * d)
            torques.append(min(max(t, -most), most))
        return tuple(torques)

    def _answer_n(self, dt_s: float, wanted_n: float, measured_world_n: Vec3 | None, direction_world: Vec3) -> float:
        """Return the force along the press with which the arm answers the force error."""
        error_n = 0.0 if measured_world_n is None else wanted_n + dot(measured_world_n, direction_world)
        answer_n = min(max(FORCE_GAIN * error_n, -FORCE_MAX_N), FORCE_MAX_N)
        self._answered_n += (1.0 - math.exp(-dt_s / FORCE_S)) * (answer_n - self._answered_n)
        return self._answered_n

    def _free(self, arm_rad: Joints, normal_body: Vec3) -> Joints:
        """Return the motion of the joints, a unit vector, that moves the tip along the normal only: J' (J J')^-1 n."""
        jacobian = self._manipulator.jacobian_body_m(arm_rad)
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = (
            [sum([u * v for u, v in zip(one, other, strict=True)], 0.0) for other in jacobian] for one in jacobian
        )
        a, b, c = (xx + _DAMPED_M2, xy, xz), (xy, yy + _DAMPED_M2, yz), (xz, yz, zz + _DAMPED_M2)
        x, y, z = mat_vec((cross(b, c), cross(c, a), cross(a, b)), normal_body)
        motion = [x * u + y * v + z * w for u, v, w in zip(*jacobian, strict=True)]
        length = math.hypot(*motion) or 1.0
        return tuple([m / length for m in motion])

    def attitude(self, dt_s: float, attitude_wxyz: Quat, state: PlantState, friction_world_n: Vec3 | None) -> Quat:
        """Return the attitude setpoint, turned against the moment of the force on the tip along the surface.

        Args:
            dt_s: time since the last tick.
            attitude_wxyz: setpoint of the control law.
            state: state of the tick.
            friction_world_n: measured force on the tip along the surface; None if it is unknown.
        """
        if self._stiff_rad is None or friction_world_n is None:
            return attitude_wxyz
        fx, fy, fz = quat_rotate(quat_conjugate(state.attitude_wxyz), friction_world_n)
        x, y, z = self._manipulator.net_body_m(state.arm_rad)
        mx, my = y * fz - z * fy, z * fx - x * fz
        hx, hy = self._held_nm
        k = 1.0 - math.exp(-dt_s / INTEGRATOR_S)
        self._held_nm = hx, hy = hx + k * (mx - hx), hy + k * (my - hy)
        turn_x, turn_y = self._rad_per_nm * (hx - mx), self._rad_per_nm * (hy - my)
        turn_x = min(max(turn_x, -TURN_MAX_RAD), TURN_MAX_RAD)
        turn_y = min(max(turn_y, -TURN_MAX_RAD), TURN_MAX_RAD)
        turn = quat_from_euler_zyx(turn_x, turn_y, 0.0)
        return quat_multiply(attitude_wxyz, turn)

    def end(self) -> None:
        """Forget the slide: the tool touches nothing any more."""
        self._stiff_rad, self._held_nm, self._answered_n = None, (0.0, 0.0), 0.0
