"""The estimator and the rate setpoints of the PX4 stub: against the plain formulas, with a biased IMU, and as PX4 1.16.1 reports it."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from companion.config.airframe import Airframe
from companion.model import frames
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import euler_zyx_from_quat
from companion.model.types import IDENTITY_QUAT, Quat, Vec3
from companion.sitl_config.effects.imu import Imu
from companion.sitl_config.world import World
from sitl.autopilot import telemetry
from sitl.autopilot.backend import stub_of
from sitl.autopilot.cascade import Cascade, CascadeGains
from sitl.autopilot.estimator import Estimator
from sitl.autopilot.types import AttitudeTarget, ImuSample
from tests.sitl.px4_rig import Rig

angles = st.floats(-math.pi, math.pi)
attitudes = st.builds(frames.quat_from_euler_zyx, angles, st.floats(-1.4, 1.4), angles)
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


@given(attitudes, attitudes, st.floats(-2.0, 2.0))
def test_rate_setpoint(q: Quat, q_d: Quat, yaw_rate_rad_s: float) -> None:
    assert Cascade()._rate_setpoint(q, AttitudeTarget(q_d, 0.5)) == plain_rate_setpoint(q, q_d, 0.0)
    got = Cascade()._rate_setpoint(q, AttitudeTarget(q_d, 0.5, yaw_rate_rad_s))
    for a, b in zip(got, plain_rate_setpoint(q, q_d, yaw_rate_rad_s), strict=True):
        assert math.isclose(a, b, rel_tol=1e-12, abs_tol=1e-12)


small = st.floats(-5.0, 5.0)
vectors = st.tuples(small, small, small)


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


AIRFRAME = Airframe(mass_kg=3.0, thrust_max_n=60.0, ground_clearance_m=0.3)


def test_the_stub_knows_the_biases_that_show_at_rest_and_no_others() -> None:
    bias = Imu(on=True, accel_bias_m_s2=(0.1, 0.2, 0.3), gyro_bias_deg_s=(1.0, 2.0, 3.0))
    stub = stub_of(World(imu=bias), AIRFRAME)
    rates = (math.radians(1.0), math.radians(-2.0), math.radians(-3.0))
    stub.step(ImuSample(1.0, rates, (0.1, -0.2, -GRAVITY_M_S2 - 0.3)))
    assert stub.imu is not None
    assert stub.imu.gyro_frd_rad_s == pytest.approx((0.0, 0.0, 0.0))
    assert stub.imu.accel_frd_m_s2 == pytest.approx((0.1, -0.2, -GRAVITY_M_S2))


def test_a_bias_above_ekf2s_limit_is_learned_up_to_it() -> None:
    stub = stub_of(World(imu=Imu(on=True, accel_bias_m_s2=(0.0, 0.0, 1.0), gyro_bias_deg_s=(0.0, 0.0, 0.0))), AIRFRAME)
    stub.step(ImuSample(1.0, (0.0, 0.0, 0.0), (0.0, 0.0, -GRAVITY_M_S2 - 1.0)))
    assert stub.imu is not None
    assert stub.imu.accel_frd_m_s2[2] == pytest.approx(-GRAVITY_M_S2 - 0.6)


def test_without_errors_the_stub_takes_samples_as_they_are() -> None:
    stub, sample = stub_of(World(), AIRFRAME), ImuSample(1.0, (0.1, 0.2, 0.3), (0.4, 0.5, -9.0))
    stub.step(sample)
    assert stub.imu is sample


def test_a_sideways_bias_stays_a_tilt_whatever_vision_says() -> None:
    estimator, bias = Estimator(), 0.1
    for k in range(2500):
        estimator.predict(ImuSample(k * 0.004, (0.0, 0.0, 0.0), (bias, 0.0, -GRAVITY_M_S2)))
        if k % 2 == 0:
            estimator.fuse_vision(k * 0.004, (0.0, 0.0, 0.0), IDENTITY_QUAT)
    estimate = estimator.estimate()
    roll, pitch, _ = euler_zyx_from_quat(estimate.attitude_ned_frd)
    assert roll == pytest.approx(0.0, abs=1e-6)
    assert pitch == pytest.approx(math.atan2(bias, GRAVITY_M_S2), rel=1e-3)
    assert estimate.position_ned_m == pytest.approx((0.0, 0.0, 0.0), abs=1e-4)


def test_an_upward_bias_that_begins_in_flight_fades_as_slowly_as_in_ekf2() -> None:
    estimator, bias = Estimator(), 0.1
    climbs = {}
    for k in range(-500, 10001):
        up = bias if k > 0 else 0.0
        estimator.predict(ImuSample(k * 0.004, (0.0, 0.0, 0.0), (0.0, 0.0, -GRAVITY_M_S2 - up)))
        if k % 2 == 0:
            estimator.fuse_vision(k * 0.004, (0.0, 0.0, 0.0), IDENTITY_QUAT)
        climbs[k] = -estimator.estimate().velocity_ned_m_s[2]
    # A steady bias leaves the innovation bias/38.5, which the position gain 8.8 turns into velocity; the bias' gain 1.0 empties it.
    assert climbs[500] == pytest.approx(bias * 8.8 / 38.5, rel=0.1)
    assert climbs[10000] / climbs[500] == pytest.approx(math.exp(-38.0 * 1.0 / 38.5), rel=0.1)


AT_REST_BLIND = 0x81  # attitude, constant position
AT_REST_FUSED = 0x1AF  # and velocities, relative and vertical position, aiding


def status(rig: Rig) -> mavlink.MAVLink_estimator_status_message:
    message = telemetry.estimator_status(rig.stub)
    assert message is not None
    return message


def test_right_after_vision_begins_the_ratio_is_high_and_settles() -> None:
    rig = Rig()
    rig.vision = False
    rig.run(1.0)
    rig.vision = True
    rig.run(0.2)
    early = status(rig)
    assert early.flags == AT_REST_FUSED
    assert early.pos_horiz_ratio > 1.0
    rig.run(6.0)
    late = status(rig)
    assert 0.0 < late.pos_horiz_ratio < 0.1
    assert late.pos_horiz_accuracy < 0.01
    assert math.isnan(late.vel_ratio), "no velocity is fused"


def test_without_vision_the_flags_drop_and_the_accuracy_gets_worse() -> None:
    rig = Rig()
    rig.run(3.0)
    good = status(rig)
    rig.vision = False
    rig.run(1.0)
    seen = status(rig)
    assert seen.flags & (mavlink.ESTIMATOR_POS_VERT_ABS | mavlink.ESTIMATOR_PRED_POS_HORIZ_REL) == 0
    assert seen.flags & mavlink.ESTIMATOR_POS_HORIZ_REL
    assert seen.pos_horiz_accuracy > 10.0 * good.pos_horiz_accuracy
    assert math.isnan(seen.pos_horiz_ratio)
    rig.run(4.0)
    assert status(rig).flags == AT_REST_BLIND
    assert telemetry.local_position_ned(rig.stub) is not None, "PX4 sends it valid or not"
