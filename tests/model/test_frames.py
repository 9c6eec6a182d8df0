"""Frames: golden values at compass points, and round trips."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.model import frames
from companion.model.types import Quat, Vec3

S = math.sqrt(0.5)
angles = st.floats(-math.pi, math.pi)
vectors = st.tuples(*[st.floats(-10, 10)] * 3)


def same(a: tuple[float, ...], b: tuple[float, ...], tol: float = 1e-12) -> bool:
    return all(abs(x - y) < tol for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize(
    ("enu", "ned"), [((1, 0, 0), (0, 1, 0)), ((0, 1, 0), (1, 0, 0)), ((0, 0, 1), (0, 0, -1)), ((1, 2, 3), (2, 1, -3))]
)
def test_world_vectors(enu: Vec3, ned: Vec3) -> None:
    assert frames.ned_from_enu(enu) == ned
    assert frames.enu_from_ned(ned) == enu


@pytest.mark.parametrize(
    ("yaw_enu_deg", "heading_ned_deg"),
    [(0, 90), (90, 0), (180, -90), (-90, 180)],  # facing world +x is facing east, and so on
)
def test_headings_at_compass_points(yaw_enu_deg: float, heading_ned_deg: float) -> None:
    q = frames.quat_from_euler_zyx(0, 0, math.radians(yaw_enu_deg))
    heading = frames.euler_zyx_from_quat(frames.attitude_ned_frd_from_enu_flu(q))[2]
    assert abs(frames.wrap_rad(heading - math.radians(heading_ned_deg))) < 1e-12


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
def test_leaning_forward_and_right_mean_the_same_in_both_frames(yaw: float) -> None:
    """Nose down is +pitch in FLU and -pitch in FRD; right side down is +roll in both."""
    forward = frames.attitude_ned_frd_from_enu_flu(frames.quat_from_euler_zyx(0, 0.2, yaw))
    roll, pitch, _ = frames.euler_zyx_from_quat(forward)
    assert abs(roll) < 1e-12
    assert abs(pitch + 0.2) < 1e-12
    right = frames.attitude_ned_frd_from_enu_flu(frames.quat_from_euler_zyx(0.3, 0, yaw))
    roll, pitch, _ = frames.euler_zyx_from_quat(right)
    assert abs(roll - 0.3) < 1e-12
    assert abs(pitch) < 1e-12


@given(angles, st.floats(-1.5, 1.5), angles, vectors)
def test_attitude_conversion_commutes_with_vectors(roll: float, pitch: float, yaw: float, body: Vec3) -> None:
    """Turning a body vector into the world gives the same arrow in either pair of frames."""
    q = frames.quat_from_euler_zyx(roll, pitch, yaw)
    enu = frames.quat_rotate(q, body)
    ned = frames.quat_rotate(frames.attitude_ned_frd_from_enu_flu(q), frames.flu_from_frd(body))
    assert same(frames.ned_from_enu(enu), ned, 1e-9)


@given(angles, st.floats(-1.5, 1.5), angles)
def test_round_trips(roll: float, pitch: float, yaw: float) -> None:
    q = frames.quat_from_euler_zyx(roll, pitch, yaw)
    back = frames.attitude_enu_flu_from_ned_frd(frames.attitude_ned_frd_from_enu_flu(q))
    sign = 1.0 if q[0] * back[0] + q[1] * back[1] + q[2] * back[2] + q[3] * back[3] > 0 else -1.0
    assert same(q, tuple(sign * value for value in back), 1e-9)
    again = frames.quat_from_euler_zyx(*frames.euler_zyx_from_quat(q))
    assert abs(abs(sum(a * b for a, b in zip(q, again, strict=True))) - 1.0) < 1e-9
    assert abs(frames.tilt_rad(q) - math.acos(max(-1, min(1, math.cos(roll) * math.cos(pitch))))) < 1e-6


@given(angles, st.floats(-1.5, 1.5), angles)
def test_shortcuts_are_what_they_stand_for(roll: float, pitch: float, yaw: float) -> None:
    """Bit for bit: a shortcut must not change a flight."""
    q = frames.quat_from_euler_zyx(roll, pitch, yaw)
    assert frames.yaw_from_quat(q) == frames.euler_zyx_from_quat(q)[2]
    w, x, y, z = frames.quat_multiply((0.0, S, S, 0.0), q)
    turned = (-x, w, z, -y)  # on the right, half a turn about x
    whole = turned if turned[0] >= 0.0 else tuple(-value for value in turned)
    assert frames.attitude_ned_frd_from_enu_flu(q) == whole
    assert frames.attitude_enu_flu_from_ned_frd(q) == whole


@pytest.mark.parametrize("q", [(0.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0), (math.inf, 0.0, 0.0, 0.0)])
def test_a_quaternion_without_direction_is_refused(q: Quat) -> None:
    with pytest.raises(ValueError, match="no direction"):
        frames.quat_normalize(q)


def test_quat_multiply_is_rotation_order() -> None:
    yaw = frames.quat_from_euler_zyx(0, 0, math.pi / 2)
    pitch = frames.quat_from_euler_zyx(0, math.pi / 2, 0)
    assert same(frames.quat_rotate(frames.quat_multiply(yaw, pitch), (1.0, 0.0, 0.0)), (0.0, 0.0, -1.0))
    assert same(frames.quat_rotate(frames.quat_multiply(pitch, yaw), (1.0, 0.0, 0.0)), (0.0, 1.0, 0.0))
    assert same(frames.quat_multiply(yaw, frames.quat_conjugate(yaw)), (1.0, 0.0, 0.0, 0.0))
