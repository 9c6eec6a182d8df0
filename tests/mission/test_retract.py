"""The way back along the tether, from anywhere: never outward, never up, slowly, inside the room, folded at the end."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config.loader import load_vehicle
from companion.mission.plan_builder import STOP_SPEED_MAX_M_S
from companion.mission.retract import BESIDE_ANCHOR_M, inward_only, retract_from
from companion.model.types import Joints, Vec3
from tests.support import tether_of

VEHICLE = load_vehicle("configs/vehicles/tarot650_2r.yaml")
ANCHOR = tether_of(VEHICLE).anchor_world_m
FOLD: Joints = (math.radians(165.0), math.radians(140.0))
RADIUS_M = VEHICLE.airframe.radius_m
ROOM = VEHICLE.room

inside = st.tuples(
    st.floats(ROOM.x_m[0] + RADIUS_M, ROOM.x_m[1] - RADIUS_M),
    st.floats(ROOM.y_m[0] + RADIUS_M, ROOM.y_m[1] - RADIUS_M),
    st.floats(0.3, 2.0),
)
velocity = st.tuples(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.floats(-1.0, 1.0))
angle = st.floats(-0.1, 2.9)


def away_m(p: Vec3) -> float:
    return math.hypot(p[0] - ANCHOR[0], p[1] - ANCHOR[1])


@given(inside, velocity, angle, st.tuples(angle, angle))
def test_from_anywhere(position: Vec3, speed: Vec3, yaw_rad: float, arm_rad: Joints) -> None:
    plan = retract_from(position, speed, yaw_rad, arm_rad, FOLD, VEHICLE, tether_of(VEHICLE))
    before = plan.reference(0.0)
    assert before.position_world_m == pytest.approx(position)
    for k in range(1, 201):
        now = plan.reference(plan.duration_s * k / 200)
        p, v = now.position_world_m, now.velocity_world_m_s
        assert away_m(p) <= away_m(before.position_world_m) + 1e-9, "outward"
        assert p[2] <= before.position_world_m[2] + 1e-9, "up"
        assert math.hypot(*v) <= 1.5 * STOP_SPEED_MAX_M_S
        assert now.yaw_rad == yaw_rad
        before = now
    end = plan.reference(plan.duration_s)
    assert end.arm_rad == pytest.approx(FOLD)
    assert end.velocity_world_m_s == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


@given(inside, angle)
def test_at_rest_it_stays_in_the_room_and_beside_the_anchor(position: Vec3, yaw_rad: float) -> None:
    plan = retract_from(position, (0.0, 0.0, 0.0), yaw_rad, FOLD, FOLD, VEHICLE, tether_of(VEHICLE))
    end = plan.reference(plan.duration_s).position_world_m
    assert ROOM.x_m[0] + RADIUS_M - 1e-9 <= end[0] <= ROOM.x_m[1] - RADIUS_M + 1e-9
    assert ROOM.y_m[0] + RADIUS_M - 1e-9 <= end[1] <= ROOM.y_m[1] - RADIUS_M + 1e-9
    assert away_m(end) >= min(away_m(position), RADIUS_M + BESIDE_ANCHOR_M) - 1e-9


def test_it_frees_the_tether() -> None:
    position = (1.4, 0.9, 1.2)
    assert tether_of(VEHICLE).length_m - math.dist(position, ANCHOR) < 0.3
    plan = retract_from(position, (0.0, 0.0, 0.0), 0.0, FOLD, FOLD, VEHICLE, tether_of(VEHICLE))
    end = plan.reference(plan.duration_s).position_world_m
    assert tether_of(VEHICLE).length_m - math.dist(end, ANCHOR) >= VEHICLE.safety.retract_slack_m - 1e-6


def test_from_a_surface_it_moves_back_before_the_arm_folds_and_the_vehicle_returns() -> None:
    position, back_m, unfolded = (1.4, 0.9, 1.2), (1.1, 0.9, 1.2), tuple(a - 0.5 for a in FOLD)
    plan = retract_from(position, (0.03, 0.0, 0.0), 0.0, unfolded, FOLD, VEHICLE, tether_of(VEHICLE), back_m)
    back = plan.segments[0]
    assert back.name == "back" and plan.reference(0.0).position_world_m == position
    at = plan.reference(back.end_s)
    assert at.position_world_m == pytest.approx(back_m) and at.arm_rad == pytest.approx(unfolded)
    assert all(plan.reference(back.end_s * k / 20).position_world_m[0] <= 1.4 for k in range(21))
    end = plan.reference(plan.duration_s)
    assert away_m(end.position_world_m) < away_m(back_m) and end.arm_rad == pytest.approx(FOLD)


@given(velocity, inside)
def test_inward_only_leaves_what_leads_inward(v: Vec3, p: Vec3) -> None:
    x, y, z = inward_only(v, p, ANCHOR)
    assert z <= 0.0 and z in (0.0, v[2])
    outward = x * (p[0] - ANCHOR[0]) + y * (p[1] - ANCHOR[1])
    assert outward <= 1e-9
    assert math.hypot(x, y) <= math.hypot(v[0], v[1]) + 1e-9
