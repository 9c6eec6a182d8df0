"""Arithmetic written out for speed equals the plain formulas to the last bit."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from companion.model import frames
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import Quat, Vec3
from sitl.autopilot.cascade import Cascade, CascadeGains
from sitl.autopilot.estimator import Estimator
from sitl.autopilot.types import AttitudeTarget, ImuSample

angles = st.floats(-math.pi, math.pi)
attitudes = st.builds(frames.quat_from_euler_zyx, angles, st.floats(-1.4, 1.4), angles)
small = st.floats(-5.0, 5.0)
vectors = st.tuples(small, small, small)
GAINS = CascadeGains()
MIX_ROLL, MIX_PITCH, MIX_YAW = (-1.0, 1.0, 1.0, -1.0), (1.0, -1.0, 1.0, -1.0), (1.0, 1.0, -1.0, -1.0)


def clipped(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))


def plain_rate_setpoint(q: Quat, q_d: Quat, yaw_rate_rad_s: float) -> Vec3:
    def up(a: Quat) -> Vec3:
        w, x, y, z = a
        return (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))

    e, f = up(q), up(q_d)
    dot = e[0] * f[0] + e[1] * f[1] + e[2] * f[2]
    reduced = q_d
    if dot >= -0.9999:
        shortest = (1.0 + dot, e[1] * f[2] - e[2] * f[1], e[2] * f[0] - e[0] * f[2], e[0] * f[1] - e[1] * f[0])
        reduced = frames.quat_multiply(frames.quat_normalize(shortest), q)
    left = frames.quat_multiply(frames.quat_conjugate(reduced), q_d)
    sine = clipped((1.0 if left[0] >= 0 else -1.0) * left[3], 1.0)
    half = math.asin(sine) * (GAINS.attitude_p[2] / GAINS.attitude_p[0])
    wanted = frames.quat_multiply(reduced, (math.cos(half), 0.0, 0.0, math.sin(half)))
    error = frames.quat_multiply(frames.quat_conjugate(q), wanted)
    sign, p, limit = (2.0 if error[0] >= 0 else -2.0), GAINS.attitude_p, GAINS.rate_max_rad_s
    down = (2 * (q[1] * q[3] - q[0] * q[2]), 2 * (q[2] * q[3] + q[0] * q[1]), e[2])
    x, y, z = (
        clipped(gain * sign * err, most) + yaw_rate_rad_s * axis
        for gain, err, most, axis in zip((p[0], p[1], p[0]), error[1:], limit, down, strict=True)
    )
    return (x, y, z)


@given(attitudes, attitudes)
def test_rate_setpoint(q: Quat, q_d: Quat) -> None:
    assert Cascade()._rate_setpoint(q, AttitudeTarget(q_d, 0.5)) == plain_rate_setpoint(q, q_d, 0.0)


@given(attitudes, attitudes, st.floats(-2.0, 2.0))
def test_rate_setpoint_with_yaw_rate(q: Quat, q_d: Quat, yaw_rate_rad_s: float) -> None:
    got = Cascade()._rate_setpoint(q, AttitudeTarget(q_d, 0.5, yaw_rate_rad_s))
    for a, b in zip(got, plain_rate_setpoint(q, q_d, yaw_rate_rad_s), strict=True):
        assert math.isclose(a, b, rel_tol=1e-12, abs_tol=1e-12)


@given(st.tuples(*[st.floats(-1.5, 1.5)] * 3), st.floats(0.0, 1.0))
def test_mixer_of_a_quad_x(torque: Vec3, thrust: float) -> None:
    roll, pitch, yaw = torque
    lean = [a * roll + b * pitch for a, b in zip(MIX_ROLL, MIX_PITCH, strict=True)]
    span = max(lean) - min(lean)
    if span > 1.0:
        lean = [value / span for value in lean]
    base = max(-min(lean), min(1.0 - max(lean), thrust)) if thrust > 0.0 else 0.0
    room = min(min(base + value, 1.0 - base - value) for value in lean)
    turn = clipped(yaw, room) if room > 0 else 0.0
    plain = tuple(min(1.0, max(0.0, base + value + k * turn)) for value, k in zip(lean, MIX_YAW, strict=True))
    assert Cascade().mixer.mix(torque, thrust) == plain


@given(st.lists(st.tuples(vectors, vectors, st.floats(0.0, 1.0)), min_size=1, max_size=8))
def test_rate_loop(course: list[tuple[Vec3, Vec3, float]]) -> None:
    cascade, dt_s = Cascade(), 0.004
    integral, filtered = [0.0] * 3, [0.0] * 3
    previous = course[0][0]
    blend = 1.0 - math.exp(-2 * math.pi * GAINS.d_cutoff_hz * dt_s)
    for rate, wanted, thrust in course:
        got = cascade._rate_loop(dt_s, rate, wanted, thrust)
        for i in range(3):
            error = wanted[i] - rate[i]
            filtered[i] += blend * ((rate[i] - previous[i]) / dt_s - filtered[i])
            integral[i] = clipped(integral[i] + GAINS.rate_i[i] * error * dt_s, GAINS.integrator_max)
            if thrust <= 0.1:
                integral[i] = 0.0
            assert got[i] == GAINS.rate_p[i] * error + integral[i] - GAINS.rate_d[i] * filtered[i]
        previous = rate


@given(st.lists(st.tuples(vectors, vectors), min_size=1, max_size=8))
def test_imu_prediction(samples: list[tuple[Vec3, Vec3]]) -> None:
    estimator, dt = Estimator(), 0.25  # a step that is a power of two, so that times have no rounding
    estimator.predict(ImuSample(0.0, (0.0, 0.0, 0.0), (0.5, -0.3, -9.7)))
    before = estimator.estimate()
    for k, (gyro, accel) in enumerate(samples, start=1):
        estimator.predict(ImuSample(k * dt, gyro, accel))
        now = estimator.estimate()
        angle = math.sqrt(gyro[0] * gyro[0] + gyro[1] * gyro[1] + gyro[2] * gyro[2]) * dt
        q = before.attitude_ned_frd
        if angle > 1e-9:
            s = math.sin(0.5 * angle) / angle * dt
            turn = (math.cos(0.5 * angle), gyro[0] * s, gyro[1] * s, gyro[2] * s)
            q = frames.quat_normalize(frames.quat_multiply(q, turn))
        push = frames.quat_rotate(q, accel)
        push = (push[0], push[1], push[2] + GRAVITY_M_S2)
        assert now.attitude_ned_frd == q
        for i in range(3):
            p, v = before.position_ned_m[i], before.velocity_ned_m_s[i]
            assert now.position_ned_m[i] == p + v * dt + push[i] * (0.5 * dt * dt)
            assert now.velocity_ned_m_s[i] == v + push[i] * dt
        before = now
