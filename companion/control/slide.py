"""What a tip that slides along a surface needs besides the control law, the same for every law: a force along the surface, a stiff arm,
and an attitude setpoint that opposes the moment of the friction.

Friction acts far ahead of the rotors and pitches the vehicle. PX4 holds the attitude against it only after its rate integrator has
followed; until then the thrust presses with 0.5 N per degree too much or too little, which changes the friction again: the tip sticks
and slips. The setpoint is therefore turned by moment over stiffness, and the turn ends as the integrator takes over.
"""

from __future__ import annotations

import math

from companion.config.vehicle import Vehicle
from companion.control.arm_model import manipulator_of
from companion.control.types import PlantState
from companion.model.frames import quat_conjugate, quat_from_euler_zyx, quat_multiply, quat_rotate
from companion.model.types import Joints, Quat, Vec3

STIFF_NM_RAD, STIFF_NMS_RAD = 20.0, 0.8
"""Stiffness and damping of the joints in addition to those of the law: with an arm that is soft enough to catch a payload, a tip that
friction has released jumps off the surface.
"""
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
        torque_max_nm = 0.5 * airframe.thrust_max_n * sum(arms_m) / len(arms_m)
        self._rad_per_nm = OPPOSED_SHARE / (ATTITUDE_P * RATE_P * torque_max_nm)
        self._stiff_rad: Joints | None = None
        """Joint angles to which the stiff arm returns; None if nothing slides."""
        self._held_nm = (0.0, 0.0)
        """Moment about body x and y that PX4's integrator holds."""

    def torque_nm(self, dt_s: float, torque_nm: Joints, state: PlantState, force_world_n: Vec3 | None) -> Joints:
        """Return the joint torques of a tick of a contact, within the joints' limits.

        Args:
            dt_s: time since the last tick.
            torque_nm: torques of the control law.
            state: state of the tick.
            force_world_n: force to exert with the tip along the surface; None unless it slides.
        """
        if force_world_n is None and self._stiff_rad is None:
            return torque_nm
        arm_rad, stiff_rad = state.arm_rad, self._stiff_rad or state.arm_rad
        more: Joints = (0.0,) * len(arm_rad)
        if force_world_n is not None:
            force = quat_rotate(quat_conjugate(state.attitude_wxyz), force_world_n)
            more = self._manipulator.joint_torque_from_force(arm_rad, force)
        else:
            k = dt_s / SOFTEN_S
            stiff_rad = tuple([s + k * (a - s) for s, a in zip(stiff_rad, arm_rad, strict=True)])
        self._stiff_rad = stiff_rad
        rows = zip(torque_nm, more, arm_rad, stiff_rad, state.arm_rate_rad_s, self._torque_max_nm, strict=True)
        return tuple(
            [min(max(t + f - STIFF_NM_RAD * (a - s) - STIFF_NMS_RAD * v, -most), most) for t, f, a, s, v, most in rows]
        )

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
        self._stiff_rad, self._held_nm = None, (0.0, 0.0)
