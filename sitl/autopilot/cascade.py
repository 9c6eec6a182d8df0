"""Attitude and rate cascade with mixer of the PX4 stub (mc_att_control, mc_rate_control, control allocation).

Frames are PX4's: attitude FRD -> NED, rates FRD. Quad-x rotor order: front right, rear left, front left, rear right.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.frames import quat_conjugate, quat_multiply
from companion.types import Vec3
from sitl.autopilot.types import AttitudeTarget, Estimate, RotorCommands

# Sign of each rotor's contribution to roll, pitch and yaw (FRD), in PX4's order.
MIX_ROLL = (-1.0, 1.0, 1.0, -1.0)
MIX_PITCH = (1.0, -1.0, 1.0, -1.0)
MIX_YAW = (1.0, 1.0, -1.0, -1.0)


@dataclass(frozen=True, slots=True)
class CascadeGains:
    """Gains in the meaning of MC_ROLL_P, MC_ROLLRATE_P/I/D and so on; roll, pitch, yaw."""

    attitude_p: Vec3 = (6.5, 6.5, 2.8)
    rate_p: Vec3 = (0.15, 0.15, 0.2)
    rate_i: Vec3 = (0.2, 0.2, 0.1)
    rate_d: Vec3 = (0.003, 0.003, 0.0)
    rate_max_rad_s: Vec3 = (3.84, 3.84, 3.5)
    integrator_max: float = 0.3
    d_cutoff_hz: float = 30.0


class Cascade:
    """PX4's multicopter attitude P loop, rate PID loop and quad-x mixer."""

    def __init__(self, gains: CascadeGains | None = None) -> None:
        self._gains = gains or CascadeGains()
        self.reset()

    def reset(self) -> None:
        """Forget integrators (on arming)."""
        self._integral = [0.0, 0.0, 0.0]
        self._rate_previous: Vec3 | None = None
        self._d_filtered = [0.0, 0.0, 0.0]
        self._unsaturated = True

    def step(self, dt_s: float, estimate: Estimate, target: AttitudeTarget) -> RotorCommands:
        """One control period."""
        rate_sp = self._rate_setpoint(estimate, target)
        torque = self._rate_loop(dt_s, estimate.rates_frd_rad_s, rate_sp, target.thrust)
        return self._mix(torque, target.thrust)

    def _rate_setpoint(self, estimate: Estimate, target: AttitudeTarget) -> Vec3:
        """Quaternion P control with reduced yaw priority (Brescianini et al., as in mc_att_control)."""
        gains = self._gains
        q, q_d = estimate.attitude_ned_frd, target.attitude_ned_frd
        w, x, y, z = q
        wd, xd, yd, zd = q_d
        # z axes of both attitudes and the shortest rotation between them.
        ez = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
        ezd = (2 * (xd * zd + wd * yd), 2 * (yd * zd - wd * xd), 1 - 2 * (xd * xd + yd * yd))
        dot = ez[0] * ezd[0] + ez[1] * ezd[1] + ez[2] * ezd[2]
        if dot < -0.9999:
            q_red = q_d
        else:
            rw = 1.0 + dot
            rx = ez[1] * ezd[2] - ez[2] * ezd[1]
            ry = ez[2] * ezd[0] - ez[0] * ezd[2]
            rz = ez[0] * ezd[1] - ez[1] * ezd[0]
            n = math.sqrt(rw * rw + rx * rx + ry * ry + rz * rz)
            q_red = quat_multiply((rw / n, rx / n, ry / n, rz / n), q)
        mix = quat_multiply(quat_conjugate(q_red), q_d)
        sign = 1.0 if mix[0] >= 0 else -1.0
        yaw_weight = gains.attitude_p[2] / gains.attitude_p[0]
        half = math.asin(max(-1.0, min(1.0, sign * mix[3]))) * yaw_weight
        q_sp = quat_multiply(q_red, (math.cos(half), 0.0, 0.0, math.sin(half)))
        err = quat_multiply(quat_conjugate(q), q_sp)
        sign = 2.0 if err[0] >= 0 else -2.0
        p, limit = gains.attitude_p, gains.rate_max_rad_s
        # PX4 divides the yaw weight out of the yaw gain again, so one gain serves all axes here.
        r = [
            max(-limit[0], min(limit[0], p[0] * sign * err[1])),
            max(-limit[1], min(limit[1], p[1] * sign * err[2])),
            max(-limit[2], min(limit[2], p[0] * sign * err[3])),
        ]
        if target.yaw_rate_rad_s:
            # Feed-forward about the world's vertical.
            r[0] += target.yaw_rate_rad_s * 2 * (x * z - w * y)
            r[1] += target.yaw_rate_rad_s * 2 * (y * z + w * x)
            r[2] += target.yaw_rate_rad_s * ez[2]
        return (r[0], r[1], r[2])

    def _rate_loop(self, dt_s: float, rate: Vec3, rate_sp: Vec3, thrust: float) -> Vec3:
        gains = self._gains
        previous = self._rate_previous or rate
        blend = 1.0 - math.exp(-2 * math.pi * gains.d_cutoff_hz * dt_s)
        out = [0.0, 0.0, 0.0]
        for i in range(3):
            error = rate_sp[i] - rate[i]
            self._d_filtered[i] += blend * ((rate[i] - previous[i]) / dt_s - self._d_filtered[i])
            if (
                thrust > 0.1 and self._unsaturated
            ):  # on the ground the integrator would wind up against the landing gear
                limit = gains.integrator_max
                self._integral[i] = max(-limit, min(limit, self._integral[i] + gains.rate_i[i] * error * dt_s))
            elif thrust <= 0.1:
                self._integral[i] = 0.0
            out[i] = gains.rate_p[i] * error + self._integral[i] - gains.rate_d[i] * self._d_filtered[i]
        self._rate_previous = rate
        return (out[0], out[1], out[2])

    def _mix(self, torque: Vec3, thrust: float) -> RotorCommands:
        """Collective + torques to rotor commands; yaw gives way first, then the collective (airmode off for yaw)."""
        roll, pitch, yaw = torque
        lean = [MIX_ROLL[i] * roll + MIX_PITCH[i] * pitch for i in range(4)]
        span = max(lean) - min(lean)
        if span > 1.0:
            lean = [value / span for value in lean]
        base = max(-min(lean), min(1.0 - max(lean), thrust)) if thrust > 0.0 else 0.0
        room = min(min(base + value, 1.0 - base - value) for value in lean)
        yaw_used = max(-room, min(room, yaw)) if room > 0 else 0.0
        self._unsaturated = span <= 1.0 and abs(base - thrust) < 0.05
        a, b, c, d = (min(1.0, max(0.0, base + lean[i] + MIX_YAW[i] * yaw_used)) for i in range(4))
        return (a, b, c, d)
