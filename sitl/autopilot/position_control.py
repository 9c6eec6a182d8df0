"""PX4's position controller: position P, velocity PID, and conversion of thrust vector and yaw to attitude (local NED, body FRD)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.model.constants import STANDARD_GRAVITY_M_S2
from companion.model.frames import euler_zyx_from_quat, wrap_rad
from companion.model.types import Quat, Vec3
from sitl.autopilot.params import Params
from sitl.autopilot.setpoints import PositionTarget
from sitl.autopilot.types import AttitudeTarget, Estimate


@dataclass(frozen=True, slots=True)
class _Gains:
    xy_p: float
    z_p: float
    xy_vel_p: float
    xy_vel_i: float
    xy_vel_d: float
    z_vel_p: float
    z_vel_i: float
    z_vel_d: float
    speed_xy_m_s: float
    speed_up_m_s: float
    speed_down_m_s: float
    tilt_rad: float
    hover: float
    thrust_min: float
    thrust_max: float


class PositionControl:
    """The controller of PX4's own modes and of position setpoints in OFFBOARD (mc_pos_control)."""

    def __init__(self, params: Params) -> None:
        self._params = params
        self._revision = -1
        self._gains = self._read()
        self._integral = [0.0, 0.0, 0.0]
        self._velocity_previous: Vec3 | None = None
        self._yaw_rad: float | None = None

    def reset(self) -> None:
        """Reset integrators and yaw setpoint."""
        self._integral = [0.0, 0.0, 0.0]
        self._velocity_previous = None
        self._yaw_rad = None

    def step(
        self, dt_s: float, estimate: Estimate, target: PositionTarget, climb_limit_m_s: float | None = None
    ) -> AttitudeTarget:
        """Run one control period; return the attitude setpoint. `climb_limit_m_s` limits the upward speed, negative: only descent."""
        if self._revision != self._params.revision:
            self._gains = self._read()
        gains = self._gains
        velocity = estimate.velocity_ned_m_s
        wanted = self._velocity_setpoint(estimate, target, climb_limit_m_s)
        push = self._acceleration(dt_s, velocity, wanted, target)
        attitude, thrust = self._thrust_attitude(push, self._next_yaw(dt_s, estimate, target))
        self._integrate(dt_s, velocity, wanted, thrust, gains)
        yaw_rate = target.yaw_rate_rad_s or 0.0
        return AttitudeTarget(attitude, thrust, yaw_rate)

    def idle(self, estimate: Estimate) -> AttitudeTarget:
        """Reset the integrators and return the setpoint for the ground: level attitude, present heading and zero thrust."""
        self.reset()
        yaw = heading_rad(estimate.attitude_ned_frd)
        return AttitudeTarget((math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)), 0.0)

    def _velocity_setpoint(
        self, estimate: Estimate, target: PositionTarget, climb_limit_m_s: float | None
    ) -> list[float | None]:
        gains = self._gains
        out: list[float | None] = [None, None, None]
        for i, gain in enumerate((gains.xy_p, gains.xy_p, gains.z_p)):
            where, speed = target.position_ned_m[i], target.velocity_ned_m_s[i]
            if where is not None:
                out[i] = gain * (where - estimate.position_ned_m[i]) + (speed or 0.0)
            else:
                out[i] = speed
        x, y, z = out
        if x is not None and y is not None:
            fast = math.hypot(x, y)
            if fast > gains.speed_xy_m_s:
                out[0], out[1] = x * gains.speed_xy_m_s / fast, y * gains.speed_xy_m_s / fast
        if z is not None:
            up = gains.speed_up_m_s if climb_limit_m_s is None else min(gains.speed_up_m_s, climb_limit_m_s)
            out[2] = max(-up, min(max(gains.speed_down_m_s, -up), z))
        return out

    def _acceleration(
        self, dt_s: float, velocity: Vec3, wanted: list[float | None], target: PositionTarget
    ) -> list[float]:
        gains = self._gains
        previous = self._velocity_previous or velocity
        self._velocity_previous = velocity
        p = (gains.xy_vel_p, gains.xy_vel_p, gains.z_vel_p)
        d = (gains.xy_vel_d, gains.xy_vel_d, gains.z_vel_d)
        out = [0.0, 0.0, 0.0]
        for i in range(3):
            out[i] = target.acceleration_ned_m_s2[i] or 0.0
            speed = wanted[i]
            if speed is not None:
                rate = (velocity[i] - previous[i]) / dt_s if dt_s > 0.0 else 0.0
                out[i] += p[i] * (speed - velocity[i]) + self._integral[i] - d[i] * rate
        return out

    def _thrust_attitude(self, push: list[float], yaw_rad: float) -> tuple[Quat, float]:
        """Convert an acceleration setpoint to attitude and thrust: hover thrust gives 1 g, and the vertical axis has priority."""
        gains = self._gains
        up = max(STANDARD_GRAVITY_M_S2 - push[2], 1e-3)
        horizontal = math.hypot(push[0], push[1])
        limit = up * math.tan(gains.tilt_rad)
        scale = limit / horizontal if horizontal > limit else 1.0
        ax, ay = push[0] * scale, push[1] * scale
        norm = math.sqrt(ax * ax + ay * ay + up * up)
        thrust = gains.hover * norm / STANDARD_GRAVITY_M_S2
        thrust = max(gains.thrust_min, min(gains.thrust_max, thrust))
        return attitude_from_up((ax / norm, ay / norm, -up / norm), yaw_rad), thrust

    def _integrate(self, dt_s: float, velocity: Vec3, wanted: list[float | None], thrust: float, gains: _Gains) -> None:
        rates = (gains.xy_vel_i, gains.xy_vel_i, gains.z_vel_i)
        for i in range(3):
            speed = wanted[i]
            if speed is None:
                self._integral[i] = 0.0
                continue
            error = speed - velocity[i]
            if i == 2 and ((thrust >= gains.thrust_max and error < 0) or (thrust <= gains.thrust_min and error > 0)):
                continue
            self._integral[i] = max(
                -STANDARD_GRAVITY_M_S2, min(STANDARD_GRAVITY_M_S2, self._integral[i] + rates[i] * error * dt_s)
            )

    def _next_yaw(self, dt_s: float, estimate: Estimate, target: PositionTarget) -> float:
        if target.yaw_rad is not None:
            self._yaw_rad = target.yaw_rad
        else:
            held = heading_rad(estimate.attitude_ned_frd) if self._yaw_rad is None else self._yaw_rad
            self._yaw_rad = wrap_rad(held + (target.yaw_rate_rad_s or 0.0) * dt_s)
        return self._yaw_rad

    def _read(self) -> _Gains:
        real = self._params.real
        self._revision = self._params.revision
        return _Gains(
            xy_p=real("MPC_XY_P"),
            z_p=real("MPC_Z_P"),
            xy_vel_p=real("MPC_XY_VEL_P_ACC"),
            xy_vel_i=real("MPC_XY_VEL_I_ACC"),
            xy_vel_d=real("MPC_XY_VEL_D_ACC"),
            z_vel_p=real("MPC_Z_VEL_P_ACC"),
            z_vel_i=real("MPC_Z_VEL_I_ACC"),
            z_vel_d=real("MPC_Z_VEL_D_ACC"),
            speed_xy_m_s=real("MPC_XY_VEL_MAX"),
            speed_up_m_s=real("MPC_Z_VEL_MAX_UP"),
            speed_down_m_s=real("MPC_Z_VEL_MAX_DN"),
            tilt_rad=math.radians(real("MPC_TILTMAX_AIR")),
            hover=real("MPC_THR_HOVER"),
            thrust_min=real("MPC_THR_MIN"),
            thrust_max=real("MPC_THR_MAX"),
        )


def heading_rad(attitude_ned_frd: Quat) -> float:
    """Return the yaw of an attitude in rad."""
    return euler_zyx_from_quat(attitude_ned_frd)[2]


def attitude_from_up(thrust_direction_ned: Vec3, yaw_rad: float) -> Quat:
    """Return the attitude with heading `yaw_rad` whose -z axis (the thrust direction) points along a unit vector in NED."""
    zx, zy, zz = -thrust_direction_ned[0], -thrust_direction_ned[1], -thrust_direction_ned[2]
    # x axis: the heading turned into the plane normal to z.
    xx, xy, xz = zz * math.cos(yaw_rad), zz * math.sin(yaw_rad), -(zx * math.cos(yaw_rad) + zy * math.sin(yaw_rad))
    norm = math.sqrt(xx * xx + xy * xy + xz * xz)
    xx, xy, xz = xx / norm, xy / norm, xz / norm
    yx, yy, yz = zy * xz - zz * xy, zz * xx - zx * xz, zx * xy - zy * xx
    # Columns of the rotation are x, y, z; the tilt stays below 90 deg, so w is never small for the headings handled below.
    trace = xx + yy + zz
    if trace > -0.5:
        w = math.sqrt(max(0.0, 1.0 + trace)) / 2.0
        return (w, (yz - zy) / (4 * w), (zx - xz) / (4 * w), (xy - yx) / (4 * w))
    z = math.sqrt(max(0.0, 1.0 - xx - yy + zz)) / 2.0  # near a half turn about the vertical z is the large one
    return ((xy - yx) / (4 * z), (zx + xz) / (4 * z), (yz + zy) / (4 * z), z)
