"""Attitude and rate cascade with mixer of the PX4 stub (mc_att_control, mc_rate_control, control allocation).

Frames are PX4's: attitude FRD -> NED, rates FRD.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.model.rotors import RotorLayout, standard_layout
from companion.model.types import Quat, Vec3
from sitl.autopilot.mixer import Mixer
from sitl.autopilot.params import Params
from sitl.autopilot.types import AttitudeTarget, Estimate, RotorCommands


@dataclass(frozen=True, slots=True)
class CascadeGains:
    """Gains for roll, pitch and yaw, as PX4's parameters MC_ROLL_P, MC_ROLLRATE_P/I/D and so on define them."""

    attitude_p: Vec3 = (6.5, 6.5, 2.8)
    rate_p: Vec3 = (0.15, 0.15, 0.2)
    rate_i: Vec3 = (0.2, 0.2, 0.1)
    rate_d: Vec3 = (0.003, 0.003, 0.0)
    rate_max_rad_s: Vec3 = (3.84, 3.84, 3.5)
    integrator_max: float = 0.3
    d_cutoff_hz: float = 30.0


def gains_from_params(params: Params) -> CascadeGains:
    """Return the gains of the attitude and rate loops, given by the MC_* parameters."""
    real = params.real

    def axes(pattern: str) -> Vec3:
        return (real(pattern.format("ROLL")), real(pattern.format("PITCH")), real(pattern.format("YAW")))

    roll_max, pitch_max, yaw_max = axes("MC_{}RATE_MAX")
    return CascadeGains(
        attitude_p=axes("MC_{}_P"),
        rate_p=axes("MC_{}RATE_P"),
        rate_i=axes("MC_{}RATE_I"),
        rate_d=axes("MC_{}RATE_D"),
        rate_max_rad_s=(math.radians(roll_max), math.radians(pitch_max), math.radians(yaw_max)),
        integrator_max=real("MC_RR_INT_LIM"),
        d_cutoff_hz=real("IMU_GYRO_CUTOFF"),
    )


class Cascade:
    """PX4's multicopter attitude P loop, rate PID loop and mixer.

    Products of quaternions and sums over axes are written out for speed, because the cascade runs at 250 Hz.

    Args:
        gains: gains of the loops; None for PX4's defaults.
        rotors: layout of the rotors; None for a quad-x.
    """

    def __init__(self, gains: CascadeGains | None = None, rotors: RotorLayout | None = None) -> None:
        self._gains = gains or CascadeGains()
        self.mixer = Mixer(rotors or standard_layout("quad_x", 1.0, 0.0))
        self.reset()

    def reset(self) -> None:
        """Reset integrators and filters; call this method on arming."""
        self._integral: Vec3 = (0.0, 0.0, 0.0)
        self._rate_previous: Vec3 | None = None
        self._d_filtered: Vec3 = (0.0, 0.0, 0.0)
        self.mixer.unsaturated = True

    def step(self, dt_s: float, estimate: Estimate, target: AttitudeTarget) -> RotorCommands:
        """Run one control period and return normalised rotor commands, 0 to 1."""
        rate_sp = self._rate_setpoint(estimate.attitude_ned_frd, target)
        torque = self._rate_loop(dt_s, estimate.rates_frd_rad_s, rate_sp, target.thrust)
        return self.mixer.mix(torque, target.thrust)

    def _rate_setpoint(self, q: Quat, target: AttitudeTarget) -> Vec3:
        """Return the rate setpoint, rad/s: quaternion P control with reduced yaw priority (Brescianini et al., mc_att_control)."""
        w, x, y, z = q
        wd, xd, yd, zd = target.attitude_ned_frd
        # z axes of both attitudes and the shortest rotation between them.
        ex, ey, ez = 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)
        fx, fy, fz = 2 * (xd * zd + wd * yd), 2 * (yd * zd - wd * xd), 1 - 2 * (xd * xd + yd * yd)
        dot = ex * fx + ey * fy + ez * fz
        if dot < -0.9999:
            aw, ax, ay, az = wd, xd, yd, zd
        else:
            rw = 1.0 + dot
            rx, ry, rz = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
            n = math.sqrt(rw * rw + rx * rx + ry * ry + rz * rz)
            rw, rx, ry, rz = rw / n, rx / n, ry / n, rz / n
            aw = rw * w - rx * x - ry * y - rz * z
            ax = rw * x + rx * w + ry * z - rz * y
            ay = rw * y - rx * z + ry * w + rz * x
            az = rw * z + rx * y - ry * x + rz * w
        # The rest is a turn about the body's z axis, of which a fraction is commanded: a* (.) = target.
        left_w = aw * wd + ax * xd + ay * yd + az * zd
        left_z = aw * zd - ax * yd + ay * xd - az * wd
        p_roll, p_pitch, p_yaw = self._gains.attitude_p
        most_roll, most_pitch, most_yaw = self._gains.rate_max_rad_s
        sine = left_z if left_w >= 0 else -left_z
        half = math.asin(1.0 if sine > 1.0 else -1.0 if sine < -1.0 else sine) * (p_yaw / p_roll)
        c, s = math.cos(half), math.sin(half)
        sw, sx, sy, sz = aw * c - az * s, ax * c + ay * s, ay * c - ax * s, aw * s + az * c
        # The error q* (.) = setpoint; its vector part is half the angle.
        gain = 2.0 if w * sw + x * sx + y * sy + z * sz >= 0 else -2.0
        # PX4 divides the yaw weight out of the yaw gain again, so one gain serves all axes here.
        roll = p_roll * gain * (w * sx - x * sw - y * sz + z * sy)
        pitch = p_pitch * gain * (w * sy + x * sz - y * sw - z * sx)
        yaw = p_roll * gain * (w * sz - x * sy + y * sx - z * sw)
        roll = most_roll if roll > most_roll else -most_roll if roll < -most_roll else roll
        pitch = most_pitch if pitch > most_pitch else -most_pitch if pitch < -most_pitch else pitch
        yaw = most_yaw if yaw > most_yaw else -most_yaw if yaw < -most_yaw else yaw
        if target.yaw_rate_rad_s:
            # Feed-forward about the world's vertical.
            roll += target.yaw_rate_rad_s * 2 * (x * z - w * y)
            pitch += target.yaw_rate_rad_s * 2 * (y * z + w * x)
            yaw += target.yaw_rate_rad_s * ez
        return (roll, pitch, yaw)

    def _rate_loop(self, dt_s: float, rate: Vec3, rate_sp: Vec3, thrust: float) -> Vec3:
        gains = self._gains
        x, y, z = rate
        to_x, to_y, to_z = rate_sp
        px, py, pz = self._rate_previous or rate
        self._rate_previous = rate
        error_x, error_y, error_z = to_x - x, to_y - y, to_z - z
        blend = 1.0 - math.exp(-2 * math.pi * gains.d_cutoff_hz * dt_s)
        dx, dy, dz = self._d_filtered
        dx += blend * ((x - px) / dt_s - dx)
        dy += blend * ((y - py) / dt_s - dy)
        dz += blend * ((z - pz) / dt_s - dz)
        self._d_filtered = (dx, dy, dz)
        if thrust <= 0.1:  # on the ground the integrator would wind up against the landing gear
            self._integral = (0.0, 0.0, 0.0)
        elif self.mixer.unsaturated:
            most = gains.integrator_max
            kx, ky, kz = gains.rate_i
            ix, iy, iz = self._integral
            self._integral = (
                max(-most, min(most, ix + kx * error_x * dt_s)),
                max(-most, min(most, iy + ky * error_y * dt_s)),
                max(-most, min(most, iz + kz * error_z * dt_s)),
            )
        ix, iy, iz = self._integral
        kx, ky, kz = gains.rate_p
        lx, ly, lz = gains.rate_d
        return (kx * error_x + ix - lx * dx, ky * error_y + iy - ly * dy, kz * error_z + iz - lz * dz)
