"""ESTIMATOR_STATUS and LOCAL_POSITION_NED of the stub against what PX4 1.16.1 was seen to send."""

from __future__ import annotations

import math

from pymavlink.dialects.v20 import common as mavlink

from sitl.autopilot import telemetry
from sitl.autopilot.autopilot import Origin
from tests.sitl.px4_rig import Rig

AT_REST_BLIND = 0x81  # attitude, constant position
AT_REST_FUSED = 0x1AF  # and velocities, relative and vertical position, aiding
WITH_ORIGIN = 0x1BF


def status(rig: Rig) -> mavlink.MAVLink_estimator_status_message:
    message = telemetry.estimator_status(rig.stub)
    assert message is not None
    return message


def test_before_vision_nothing_is_fused_and_the_position_comes_all_the_same() -> None:
    rig = Rig()
    rig.vision = False
    rig.run(1.0)
    seen = status(rig)
    assert seen.flags == AT_REST_BLIND
    assert math.isnan(seen.pos_horiz_ratio)
    assert math.isnan(seen.pos_vert_ratio)
    assert telemetry.local_position_ned(rig.stub) is not None


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


def test_the_absolute_position_needs_an_origin() -> None:
    rig = Rig()
    rig.run(1.0)
    assert status(rig).flags == AT_REST_FUSED
    assert telemetry.gps_global_origin(rig.stub) is None
    rig.stub.set_origin(Origin(0.0, 0.0, 0.0))
    assert status(rig).flags == WITH_ORIGIN
    assert telemetry.gps_global_origin(rig.stub) is not None


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
