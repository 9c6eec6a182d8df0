"""The estimator and the rate setpoints of the PX4 stub: against the plain formulas, with a biased IMU, and as PX4 1.16.1 reports it."""

from __future__ import annotations

import math

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.config.airframe import Airframe
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import euler_zyx_from_quat
from companion.model.types import IDENTITY_QUAT
from companion.sitl_config.effects.imu import Imu
from companion.sitl_config.world import World
from sitl.autopilot import telemetry
from sitl.autopilot.backend import stub_of
from sitl.autopilot.estimator import Estimator
from sitl.autopilot.types import ImuSample
from tests.sitl.px4_rig import Rig

AIRFRAME = Airframe(mass_kg=3.0, thrust_max_n=60.0, ground_clearance_m=0.3)


def test_the_stub_knows_the_biases_that_show_at_rest_and_no_others() -> None:
    bias = Imu(on=True, accel_bias_m_s2=(0.1, 0.2, 0.3), gyro_bias_deg_s=(1.0, 2.0, 3.0))
    stub = stub_of(World(imu=bias), AIRFRAME)
    rates = (math.radians(1.0), math.radians(-2.0), math.radians(-3.0))
    stub.step(ImuSample(1.0, rates, (0.1, -0.2, -GRAVITY_M_S2 - 0.3)))
    assert stub.imu is not None
    assert stub.imu.gyro_frd_rad_s == pytest.approx((0.0, 0.0, 0.0))
    assert stub.imu.accel_frd_m_s2 == pytest.approx((0.1, -0.2, -GRAVITY_M_S2))


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


def test_the_barometer_is_the_height_only_without_vision_and_its_offset_is_known_by_then() -> None:
    estimator, heights = Estimator(), {}
    for k in range(20000):
        estimator.predict(ImuSample(k * 0.004, (0.0, 0.0, 0.0), (0.0, 0.0, -GRAVITY_M_S2)))
        if k < 10000 and k % 2 == 0:
            estimator.fuse_vision(k * 0.004, (0.0, 0.0, 0.0), IDENTITY_QUAT)
        if k % 5 == 0:
            estimator.fuse_barometer(0.7 if k < 11000 else 1.2)
        heights[k] = -estimator.estimate().position_ned_m[2]
    assert max(abs(heights[k]) for k in range(11000)) < 0.02, "0.7 m of offset"
    assert heights[11500] < 0.15, "a gust on the barometer hardly moves it in 2 s"
    assert heights[19999] > 0.3
    assert estimator.estimate().height_valid and not estimator.estimate().position_valid


@pytest.mark.parametrize(("noaid_tout_us", "valid_s"), [(1_000_000, 0.43), (2_000_000, 1.42), (5_000_000, 4.42)])
def test_the_position_is_dropped_as_long_after_the_last_pose_as_on_px4(noaid_tout_us: int, valid_s: float) -> None:
    """Measured on PX4 1.16.1; the last one was computed from the others."""
    rig = Rig({"EKF2_NOAID_TOUT": noaid_tout_us})
    rig.run(2.0)
    rig.vision, begun_s = False, rig.t_s
    while rig.stub.estimate is not None and rig.stub.estimate.position_valid:
        rig.step()
    assert rig.t_s - begun_s == pytest.approx(valid_s, abs=0.03)


def test_while_px4_lands_a_barometer_that_shows_less_is_not_believed() -> None:
    heights = []
    for descends in (False, True):
        estimator = Estimator()
        for k in range(3000):
            estimator.predict(ImuSample(k * 0.004, (0.0, 0.0, 0.0), (0.0, 0.0, -GRAVITY_M_S2)))
            if k < 500:
                estimator.fuse_vision(k * 0.004, (0.0, 0.0, 0.0), IDENTITY_QUAT)
            if k % 5 == 0:
                estimator.fuse_barometer(0.0 if k < 500 else -1.0, descends)
        heights.append(-estimator.estimate().position_ned_m[2])
    assert heights[0] < -0.2 and abs(heights[1]) < 1e-3


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
