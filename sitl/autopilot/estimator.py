"""The PX4 stub's substitute for EKF2: IMU prediction and delayed vision fusion.

It is a fixed-gain observer with the couplings that matter in EKF2: position innovations correct velocity and, through gravity, tilt;
vision corrects yaw; without vision the state is dead-reckoned from the IMU and drifts. As in EKF2 with its delayed horizon, a vision
pose is compared with the state at the time of its exposure, and the output is predicted forward to the present.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import quat_multiply, quat_normalize, wrap_rad, yaw_from_quat
from companion.model.types import IDENTITY_QUAT, Quat, Vec3
from sitl.autopilot.types import Estimate, Fusion, ImuSample

VISION_FUSED_TIMEOUT_S: Final = 0.55
POSITION_DROPS_EARLIER_S: Final = 0.58
"""PX4 drops its position this much less than EKF2_NOAID_TOUT after the last pose: 0.43, 0.92 and 1.42 s with 1, 1.5 and 2 s."""
_HISTORY_S: Final = 0.3
_GATE_M: Final = 0.5
_GATE_RESET_S: Final = 1.0

# What EKF2's gains settle to with vision at 100 Hz, EKF2_EVP_NOISE 0.01, EKF2_EVA_NOISE 0.05, EKF2_ACC_NOISE 0.35 and
# EKF2_GYR_NOISE 0.015 (steady Kalman filter over position, velocity and g times tilt): poles 5.9 rad/s, damped by 0.7,
# and 0.42 rad/s on the tilt. A tilt error of 0.1 deg, which EKF2 has too, causes 4 mm of position error with this
# control law. The vertical accelerometer bias is slower: with EKF2_ABIAS_INIT 0.2 and EKF2_ACC_B_NOISE 0.003 its gain
# is 1.8, 1.2 and 0.7 m/s^3 per m after 20, 30 and 50 s.
_L_POSITION: Final = 8.8
_L_VELOCITY: Final = 38.5
_L_ACCELERATION: Final = 14.7
_L_BIAS: Final = 1.0
_L_YAW: Final = 0.3
_BARO_BIAS_S: Final = 6.0
"""Time constant with which EKF2 follows the barometer's offset from vision (baro_bias_nsd 0.13, EKF2_BARO_NOISE 3.5)."""
_L_BARO = ((1.0, 0.001, 0.0016), (4.0, 0.05, 0.02), (10.0, 0.30, 0.05))
"""Time without vision, and the barometer's gains on position and velocity per second: those of EKF2's filter with EKF2_BARO_NOISE 3.5,
whose covariance grows from what vision left.
"""
_BIAS_MAX_M_S2: Final = 0.4
"""Limit of the accelerometer bias (EKF2_ABL_LIM)."""

# EKF2's defaults: gate in standard deviations (EKF2_EVP_GATE), accelerometer noise (EKF2_ACC_NOISE). The rest was
# measured on 1.16.1: a filtered ratio falls by e in 1 s, is 2 at most, and the position is good to 4 mm with vision at
# 100 Hz and EKF2_EVP_NOISE 0.01.
_VISION_NOISE_M = 0.01
_TEST_GATE: Final = 5.0
_TEST_FILTER_S: Final = 0.5
_TEST_MAX: Final = 4.0
_ACCEL_NOISE_M_S2: Final = 0.35
_DIFFUSION_M2_S: Final = 2.6e-4
_FAKE_POSITION_SIGMA_M = 0.015


class Estimator:
    """A fixed-gain observer that behaves like EKF2 with external vision."""

    def __init__(self) -> None:
        self._t_s: float | None = None
        self._p = (0.0, 0.0, 0.0)
        self._v = (0.0, 0.0, 0.0)
        self._q: Quat = IDENTITY_QUAT
        self._bias_z = 0.0
        self._rates = (0.0, 0.0, 0.0)
        self._accel = (0.0, 0.0, -GRAVITY_M_S2)
        self._history: deque[tuple[float, Vec3, Quat]] = deque()
        self._fused_t_s: float | None = None
        self._arrived_t_s: float | None = None
        self._tilt_aligned = False
        self._test = (_TEST_MAX, _TEST_MAX)
        """Filtered ratios of squared innovation to squared gate: (horizontal, vertical)."""
        self._variance_m2 = _FAKE_POSITION_SIGMA_M**2
        self._baro_t_s: float | None = None
        self._baro_bias_m = 0.0

    def predict(self, imu: ImuSample) -> None:
        """Predict the state to the sample's time."""
        if self._t_s is None or not self._tilt_aligned:
            self._align_tilt(imu)
            return
        t_s, rates, accel, _ = imu
        dt = t_s - self._t_s
        self._t_s = t_s
        if dt <= 0.0:
            return
        w, x, y, z = self._q
        gx, gy, gz = rates
        angle = math.sqrt(gx * gx + gy * gy + gz * gz) * dt
        if angle > 1e-9:
            # Products of quaternions are written out here: this runs at 250 Hz.
            k = math.sin(0.5 * angle) / angle * dt
            rw, rx, ry, rz = math.cos(0.5 * angle), gx * k, gy * k, gz * k
            self._q = w, x, y, z = quat_normalize(
                (
                    w * rw - x * rx - y * ry - z * rz,
                    w * rx + x * rw + y * rz - z * ry,
                    w * ry - x * rz + y * rw + z * rx,
                    w * rz + x * ry - y * rx + z * rw,
                )
            )
        fx, fy, fz = accel
        fz -= self._bias_z
        tx, ty, tz = 2.0 * (y * fz - z * fy), 2.0 * (z * fx - x * fz), 2.0 * (x * fy - y * fx)
        ax = fx + w * tx + y * tz - z * ty
        ay = fy + w * ty + z * tx - x * tz
        az = fz + w * tz + x * ty - y * tx + GRAVITY_M_S2
        px, py, pz = self._p
        vx, vy, vz = self._v
        half = 0.5 * dt * dt
        self._p = p = (px + vx * dt + ax * half, py + vy * dt + ay * half, pz + vz * dt + az * half)
        self._v = (vx + ax * dt, vy + ay * dt, vz + az * dt)
        self._rates = rates
        self._accel = accel
        history = self._history
        history.append((t_s, p, self._q))
        while history[0][0] < t_s - _HISTORY_S:
            history.popleft()

    def _align_tilt(self, imu: ImuSample) -> None:
        """Initialise roll and pitch from the accelerometer at rest; yaw is 0 until vision corrects it."""
        fx, fy, fz = imu.accel_frd_m_s2
        if fx * fx + fy * fy + fz * fz < 1.0:
            return
        roll = math.atan2(-fy, -fz)
        pitch = math.atan2(fx, math.sqrt(fy * fy + fz * fz))
        cr, sr, cp, sp = math.cos(roll / 2), math.sin(roll / 2), math.cos(pitch / 2), math.sin(pitch / 2)
        self._q = (cr * cp, sr * cp, cr * sp, -sr * sp)
        self._t_s = imu.t_s
        self._tilt_aligned = True

    def fuse_vision(
        self, t_s: float, position_ned_m: Vec3, attitude_ned_frd: Quat, noise_m: float = _VISION_NOISE_M
    ) -> None:
        """Fuse a vision pose taken at world time `t_s` (arrival minus EKF2_EV_DELAY); `noise_m` is EKF2_EVP_NOISE."""
        # A sum is finite only if every term is.
        if self._t_s is None or not math.isfinite(sum((*position_ned_m, *attitude_ned_frd))):
            return
        gap = self._t_s - self._arrived_t_s if self._arrived_t_s is not None else 1.0
        self._arrived_t_s = self._t_s
        then_p, then_q = self._at(t_s)
        zx, zy, zz = position_ned_m
        rx, ry, rz = zx - then_p[0], zy - then_p[1], zz - then_p[2]
        yaw_error = wrap_rad(yaw_from_quat(attitude_ned_frd) - yaw_from_quat(then_q))
        if self._fused_t_s is None or self._t_s - self._fused_t_s > _GATE_RESET_S:
            self._reset_to((rx, ry, rz), yaw_error)
            self._test, self._variance_m2 = (_TEST_MAX, _TEST_MAX), noise_m * noise_m
            return
        self._judge(gap, rx * rx + ry * ry, rz * rz, noise_m * noise_m)
        if rx * rx + ry * ry + rz * rz > _GATE_M * _GATE_M:
            return
        noise2 = noise_m * noise_m
        variance = self._variance_m2 + _growth_m2(self._t_s - self._fused_t_s)
        self._variance_m2 = variance * noise2 / (variance + noise2) if noise2 > 0.0 else 0.0
        self._fused_t_s = self._t_s
        dt = min(gap, 0.05)
        kp, kv, ka = min(_L_POSITION * dt, 0.6), min(_L_VELOCITY * dt, 2.0), min(_L_ACCELERATION * dt, 1.0)
        px, py, pz = self._p
        vx, vy, vz = self._v
        self._p = (px + kp * rx, py + kp * ry, pz + kp * rz)
        self._v = (vx + kv * rx, vy + kv * ry, vz + kv * rz)
        # A tilt error shows as a horizontal acceleration error of g x theta.
        self._rotate_world(ka / GRAVITY_M_S2 * ry, -ka / GRAVITY_M_S2 * rx, _L_YAW * dt * yaw_error)
        self._bias_z = max(-_BIAS_MAX_M_S2, min(_BIAS_MAX_M_S2, self._bias_z - _L_BIAS * dt * rz))

    def fuse_barometer(self, height_m: float, descends: bool = False) -> None:
        """Fuse a barometric height above the floor. While vision is fused the barometer's weight is negligible; then only its offset
        is followed, which the position keeps when vision has ended.

        Args:
            descends: PX4 lands: a barometer that shows less than the estimate is not believed, because of the ground effect
                (EKF2_GND_EFF_DZ).
        """
        if self._t_s is None:
            return
        apart_m = height_m + self._p[2]
        dt = min(0.1, self._t_s - self._baro_t_s) if self._baro_t_s is not None else 0.0
        if self._baro_t_s is None:
            self._baro_bias_m = apart_m
        self._baro_t_s = self._t_s
        if self._fused_t_s is not None and self._t_s - self._fused_t_s <= VISION_FUSED_TIMEOUT_S:
            self._baro_bias_m += dt / _BARO_BIAS_S * (apart_m - self._baro_bias_m)
            return
        down_m = self._baro_bias_m - apart_m
        if descends:
            down_m = min(0.0, down_m)
        since_s = self._t_s - self._fused_t_s if self._fused_t_s is not None else math.inf
        k_p, k_v = _baro_gains(since_s)
        (px, py, pz), (vx, vy, vz) = self._p, self._v
        self._p = (px, py, pz + dt * k_p * down_m)
        self._v = (vx, vy, vz + dt * k_v * down_m)

    def _judge(self, gap_s: float, horizontal2: float, vertical2: float, noise2: float) -> None:
        gate2 = _TEST_GATE**2 * max(noise2 + self._variance_m2, 1e-12)
        k = gap_s / (_TEST_FILTER_S + gap_s)
        h, v = self._test
        self._test = (
            h + k * (min(horizontal2 / gate2, _TEST_MAX) - h),
            v + k * (min(vertical2 / gate2, _TEST_MAX) - v),
        )

    def _at(self, t_s: float) -> tuple[Vec3, Quat]:
        for stamp, position, attitude in reversed(self._history):
            if stamp <= t_s + 1e-9:
                return position, attitude
        return (self._history[0][1], self._history[0][2]) if self._history else (self._p, self._q)

    def _reset_to(self, innovation: Vec3, yaw_error: float) -> None:
        self._p = (self._p[0] + innovation[0], self._p[1] + innovation[1], self._p[2] + innovation[2])
        self._v = (0.0, 0.0, 0.0)
        self._rotate_world(0.0, 0.0, yaw_error)
        self._history.clear()
        self._fused_t_s = self._t_s

    def _rotate_world(self, theta_x: float, theta_y: float, theta_z: float) -> None:
        x, y, z = 0.5 * theta_x, 0.5 * theta_y, 0.5 * theta_z
        norm = math.sqrt(x**2 + y**2 + z**2)
        k = math.sin(norm) / norm if norm > 1e-12 else 1.0
        self._q = quat_normalize(quat_multiply((math.cos(norm), k * x, k * y, k * z), self._q))

    def fusion(self) -> Fusion:
        """Return the innovation test ratios of vision and the accuracy of the position."""
        since_s = (self._t_s or 0.0) - self._fused_t_s if self._fused_t_s is not None else math.inf
        if since_s == math.inf:
            return Fusion(math.nan, math.nan, _FAKE_POSITION_SIGMA_M, _FAKE_POSITION_SIGMA_M)
        sigma_m = math.sqrt(self._variance_m2 + _growth_m2(since_s))
        h, v = (math.sqrt(value) for value in self._test) if since_s <= VISION_FUSED_TIMEOUT_S else (math.nan, math.nan)
        if self._baro_t_s is not None:
            # The mean over vision and the barometer, whose own is nearly 0.
            v = 0.0 if math.isnan(v) else 0.5 * v
        return Fusion(h, v, sigma_m, sigma_m)

    def estimate(self, dead_reckons_s: float = 5.0) -> Estimate:
        """Return the newest estimate, whose position is valid for `dead_reckons_s` (EKF2_NOAID_TOUT) after vision was last fused."""
        t_s = self._t_s or 0.0
        since = t_s - self._fused_t_s if self._fused_t_s is not None else math.inf
        valid = since <= dead_reckons_s - POSITION_DROPS_EARLIER_S
        return Estimate(
            t_s=t_s,
            position_ned_m=self._p,
            velocity_ned_m_s=self._v,
            attitude_ned_frd=self._q,
            rates_frd_rad_s=self._rates,
            accel_frd_m_s2=self._accel,
            vision_fused=since <= VISION_FUSED_TIMEOUT_S,
            position_valid=valid,
            height_valid=valid or self._baro_t_s is not None,
            attitude_valid=self._tilt_aligned,
            height_aided=since <= VISION_FUSED_TIMEOUT_S or self._baro_t_s is not None,
        )


def _baro_gains(since_s: float) -> tuple[float, float]:
    """Return the barometer's gains on position and velocity per second after a time without vision."""
    begin_s, k_p, k_v = _L_BARO[0]
    for end_s, to_p, to_v in _L_BARO[1:]:
        share = max(0.0, min(1.0, (since_s - begin_s) / (end_s - begin_s)))
        begin_s, k_p, k_v = end_s, k_p + share * (to_p - k_p), k_v + share * (to_v - k_v)
    return k_p, k_v


def _growth_m2(since_s: float) -> float:
    """Return the growth of the position variance after `since_s` without vision."""
    return _DIFFUSION_M2_S * since_s + _ACCEL_NOISE_M_S2**2 * since_s**3 / 3.0
