"""Units, joint angles and names of the arm's servos: pure conversions."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config.arm import Joint
from companion.io.dynamixel import registers as dxl
from companion.io.dynamixel.port import usb_latency_ms
from companion.io.dynamixel.scale import joint_scale, turn_offset_counts
from companion.model.servos import WATCHDOG_ERROR, hardware_error_text
from tests.io.arm_rig import JOINTS, KT, NM_PER_COUNT


def test_joint_angle_velocity_and_torque_follow_sign_and_zero() -> None:
    first, second = (joint_scale(joint, KT, 1193) for joint in JOINTS)
    assert first.angle_rad(2048) == pytest.approx(math.pi / 2)
    assert second.angle_rad(0) == pytest.approx(-math.pi / 2)
    assert first.velocity_rad_s(100) == pytest.approx(-22.9 * 2 * math.pi / 60)
    assert first.torque_nm(-100) == pytest.approx(100 * NM_PER_COUNT)
    assert first.current_counts(1.0) == -286
    assert second.current_counts(1.0) == 286


def test_torque_is_clipped_below_the_joint_limit_never_above() -> None:
    for joint in JOINTS:
        scale = joint_scale(joint, KT, 1193)
        assert (
            joint.torque_max_nm - NM_PER_COUNT < abs(scale.torque_nm(scale.current_counts(99.0))) <= joint.torque_max_nm
        )
        assert scale.current_counts(-99.0) == -scale.current_counts(99.0)


@pytest.mark.parametrize("torque_nm", [math.nan, math.inf])
def test_torque_that_is_not_finite_is_an_error(torque_nm: float) -> None:
    with pytest.raises(ValueError, match="not finite"):
        joint_scale(JOINTS[0], KT, 1193).current_counts(torque_nm)


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("zero_count", [-9000, 0, 100, 4000, 20000])
@pytest.mark.parametrize("angle_deg", [-19.5, 0.0, 90.0, 179.5])
def test_angle_is_right_in_whichever_turn_the_encoder_starts(sign: int, zero_count: int, angle_deg: float) -> None:
    joint = Joint(servo_id=1, sign=-1 if sign < 0 else 1, zero_count=zero_count, angle_deg=(-20, 180), torque_max_nm=1)
    position = round(zero_count + sign * angle_deg * 4096 / 360) % 4096
    zero = zero_count + turn_offset_counts(joint, position)
    assert sign * (position - zero) * 360 / 4096 == pytest.approx(angle_deg, abs=0.1)


@given(
    st.integers(-30 * 4096, 30 * 4096),
    st.integers(0, 255),
    st.integers(-1023, 1023),
    st.integers(-1193, 1193),
    st.integers(0, 255),
)
def test_block_never_needs_byte_stuffing(
    position: int, errors: int, velocity: int, current: int, watchdog: int
) -> None:
    fields = (position, errors & 0x3F, velocity, 80, current, watchdog)
    block = dxl.Block(*fields)
    data = b"".join(
        value.to_bytes(reg.size, "little", signed=value < 0) for value, reg in zip(fields, dxl.BLOCK, strict=True)
    )
    assert b"\xff\xff\xfd" not in data
    assert dxl.Block.from_bytes(data) == block


def test_hardware_errors_have_names() -> None:
    assert hardware_error_text(0) == "none"
    assert hardware_error_text(0x24 | WATCHDOG_ERROR) == "overheating, overload, bus watchdog"


def test_latency_timer_is_read_where_the_kernel_keeps_it(tmp_path: Path) -> None:
    timer = tmp_path / "ttyUSB7" / "device" / "latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text("16\n")
    assert usb_latency_ms("/dev/ttyUSB7", tmp_path) == 16
    assert usb_latency_ms("/dev/ttyUSB8", tmp_path) is None
