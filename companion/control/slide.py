"""What a tip that slides along a surface needs besides the control law, the same for every law: an arm that holds the tip on its way
along the surface and the force across it, and an attitude setpoint that opposes the moment of the friction and steers the tip.

The base moves by some millimetres in every gust. A spring between the tip and its way in the world, carried by the arm, keeps the tip
there; across the surface the joints answer the measured force error at once, while the base's push follows slowly. A dither keeps the
gears moving: their stiction otherwise holds one to two newtons at the tip, and the tip sticks and slips.

Friction acts far ahead of the rotors and pitches the vehicle. PX4 holds the attitude against it only after its rate integrator has
followed; until then the thrust presses with 0.5 N per degree too much or too little. The setpoint is therefore turned by moment over
stiffness, and the turn ends as the integrator takes over.

The arm cannot move the tip sideways. A sliding tip yields to every sideways force, slowly, because friction opposes its velocity. The
rotors' yaw torque is the only one that acts there, so the yaw setpoint is turned against the distance of the tip beside its way.
"""

from __future__ import annotations

import math

from companion.config.vehicle import Vehicle
from companion.control.arm_model import manipulator_of
from companion.control.types import PlantState
from companion.model.algebra import across, cross, dot
from companion.model.frames import quat_conjugate, quat_from_euler_zyx, quat_multiply, quat_rotate
from companion.model.types import Joints, Quat, Reference, Vec3

TIP_N_M, TIP_NS_M, TIP_MAX_N = 80.0, 2.0, 6.0
"""Stiffness, damping and largest force of the spring between the tip and its way. With a damping of 6 N s/m the tip swings: the
velocity of the vehicle is late."""
FORCE_GAIN, FORCE_S, FORCE_MAX_N = 9.0, 0.1, 5.0
"""Gain of the arm's force on the force error, time constant of its filter, and its bound. The loop closes at gain / time constant =
90 rad/s."""
DITHER_N, DITHER_TICKS = 0.3, 4
"""Dither: a force on the tip, up and down along the surface, which presses neither more nor less, and the ticks after which its sign
changes (25 Hz)."""
SOFTEN_S = 0.3
"""Time constant with which that spring ends after the slide."""
ATTITUDE_P, RATE_P, INTEGRATOR_S = 6.5, 0.15, 0.75
"""PX4's defaults of MC_PITCH_P and MC_PITCHRATE_P, and MC_PITCHRATE_P over MC_PITCHRATE_I."""
_RESTS_M_S = 1e-6
"""Speed below which the reference of the tip rests."""
TURN_MAX_RAD = math.radians(5.0)
"""Largest turn of the setpoint, per axis. With 10 deg, a force sensor that was wrong by 3 N on each axis led to a press with 13 N."""
OPPOSED_SHARE = 0.55
"""Fraction of the friction's moment that the setpoint opposes. With 1.0 the tip swings."""
STEER_RAD_M, STEER_MAX_RAD = 10.0, math.radians(12.0)
"""Turn of the yaw setpoint per distance of the tip beside its way, and its bound. PX4's yaw is soft: 10 deg make some 0.07 N m."""


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
        self._way_m: Vec3 | None = None
        """Where the tip should be along the surface, world frame; None if nothing slides."""
        self._steer_rad = 0.0
        """Turn of the yaw setpoint."""
        self._held_nm = (0.0, 0.0)
        """Moment about body x and y that PX4's integrator holds."""
        self._answered_n = 0.0
        """Force along the press with which the arm answers the force error."""
        self._tick = 0
        """Ticks of the present half period of the dither; negative in its second half."""

    def torque_nm(
        self,
        dt_s: float,
        torque_nm: Joints,
        state: PlantState,
        reference: Reference,
        direction_world: Vec3,
        measured_world_n: Vec3 | None,
    ) -> Joints:
        """Return the joint torques of a tick of a contact, within the joints' limits.

        Args:
            dt_s: time since the last tick.
            torque_nm: torques of the control law.
            state: state of the tick.
            reference: its velocity is that of the way, its `slide_world_n` the force to exert with the tip.
            direction_world: direction of the press, a unit vector.
            measured_world_n: measured force on the tip; None if it is unknown.
        """
        slide_world_n = reference.slide_world_n
        if slide_world_n is None and self._way_m is None:
            return torque_nm
        force_world_n = self._spring_n(dt_s, state, reference, direction_world)
        if slide_world_n is not None:
            (sx, sy, sz), (fx, fy, fz), (nx, ny, nz) = slide_world_n, force_world_n, direction_world
            wanted_n = dot(slide_world_n, direction_world)
            more_n = self._answer_n(dt_s, wanted_n, measured_world_n, direction_world) - wanted_n
            self._tick = self._tick + 1 if self._tick < DITHER_TICKS else 1 - DITHER_TICKS
            dx, dy, dz = across((0.0, 0.0, DITHER_N if self._tick > 0 else -DITHER_N), direction_world)
            force_world_n = (sx + fx + more_n * nx + dx, sy + fy + more_n * ny + dy, sz + fz + more_n * nz + dz)
        force_body_n = quat_rotate(quat_conjugate(state.attitude_wxyz), force_world_n)
        more_nm = self._manipulator.joint_torque_from_force(state.arm_rad, force_body_n)
        return tuple([min(max(t + f, -m), m) for t, f, m in zip(torque_nm, more_nm, self._torque_max_nm, strict=True)])

    def _spring_n(self, dt_s: float, state: PlantState, reference: Reference, direction_world: Vec3) -> Vec3:
        """Return the force of the spring between the tip and its way, along the surface, world frame, and steer by its extension.

        The way begins where the tip is when its reference begins to move, and follows the tip while the reference rests.
        """
        tip_body_m, attitude = self._manipulator.net_body_m(state.arm_rad), state.attitude_wxyz
        joint_rates = state.arm_rate_rad_s
        jx, jy, jz = (
            sum([j * rate for j, rate in zip(row, joint_rates, strict=True)], 0.0)
            for row in self._manipulator.jacobian_body_m(state.arm_rad)
        )
        wx, wy, wz = cross(state.angular_rate_body_rad_s, tip_body_m)
        ax, ay, az = quat_rotate(attitude, tip_body_m)
        bx, by, bz = quat_rotate(attitude, (wx + jx, wy + jy, wz + jz))
        px, py, pz = state.position_world_m
        vx, vy, vz = state.velocity_world_m_s
        tip = (px + ax, py + ay, pz + az)
        rx, ry, rz = across(reference.velocity_world_m_s, direction_world)
        x, y, z = self._way_m or tip
        if reference.slide_world_n is None:
            k = dt_s / SOFTEN_S
            way = (x + k * (tip[0] - x), y + k * (tip[1] - y), z + k * (tip[2] - z))
        elif math.hypot(rx, ry, rz) < _RESTS_M_S:
            way = tip
        else:
            way = (x + rx * dt_s, y + ry * dt_s, z + rz * dt_s)
        self._way_m = way
        ox, oy, oz = across((tip[0] - way[0], tip[1] - way[1], tip[2] - way[2]), direction_world)
        sx, sy, sz = across((vx + bx - rx, vy + by - ry, vz + bz - rz), direction_world)
        nx, ny, _ = direction_world
        # To the left of the direction; nothing on a floor, where no yaw moves the tip along the surface alone.
        steer_rad = -STEER_RAD_M * (nx * oy - ny * ox)
        self._steer_rad = min(max(steer_rad, -STEER_MAX_RAD), STEER_MAX_RAD)
        fx, fy, fz = (
            -TIP_N_M * ox - TIP_NS_M * sx,
            -TIP_N_M * oy - TIP_NS_M * sy,
            -TIP_N_M * oz - TIP_NS_M * sz,
        )
        size_n = math.hypot(fx, fy, fz)
        k = TIP_MAX_N / size_n if size_n > TIP_MAX_N else 1.0
        return (k * fx, k * fy, k * fz)

    def _answer_n(self, dt_s: float, wanted_n: float, measured_world_n: Vec3 | None, direction_world: Vec3) -> float:
        """Return the force along the press with which the arm answers the force error."""
        error_n = 0.0 if measured_world_n is None else wanted_n + dot(measured_world_n, direction_world)
        answer_n = min(max(FORCE_GAIN * error_n, -FORCE_MAX_N), FORCE_MAX_N)
        self._answered_n += (1.0 - math.exp(-dt_s / FORCE_S)) * (answer_n - self._answered_n)
        return self._answered_n

    def attitude(self, dt_s: float, attitude_wxyz: Quat, state: PlantState, friction_world_n: Vec3 | None) -> Quat:
        """Return the attitude setpoint, turned against the moment of the force on the tip along the surface.

        Args:
            dt_s: time since the last tick.
            attitude_wxyz: setpoint of the control law.
            state: state of the tick.
            friction_world_n: measured force on the tip along the surface; None if it is unknown.
        """
        if self._way_m is None or friction_world_n is None:
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
        turn = quat_from_euler_zyx(turn_x, turn_y, self._steer_rad)
        return quat_multiply(attitude_wxyz, turn)

    def end(self) -> None:
        """Forget the slide: the tool touches nothing any more."""
        self._way_m, self._held_nm, self._answered_n = None, (0.0, 0.0), 0.0
