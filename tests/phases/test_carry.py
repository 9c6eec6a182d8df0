"""The plan of two vehicles that carry a bar, and what is refused before take-off."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace

from companion.config.loader import load_flight
from companion.control.arm_model import manipulator_of
from companion.core.transition import Parameters
from companion.mission.bar_landing import landing_with_bar
from companion.mission.check import check_mission
from companion.mission.plan import Plan
from companion.model.algebra import plus
from companion.model.frames import quat_from_euler_zyx, quat_rotate
from companion.model.team import Grip
from companion.model.types import Reference, Vec3
from companion.phases.carry.grip import Gripping
from companion.sitl_config.loader import SitlConfig
from companion.sitl_config.team import load_team
from tests.safety.healthy import healthy, with_partner

LENGTH_M = 1.2
STEP_S = 1e-4


def clamp_m(config: SitlConfig, r: Reference) -> Vec3:
    tip = manipulator_of(config.vehicle).net_body_m(r.arm_rad)
    return plus(r.position_world_m, quat_rotate(quat_from_euler_zyx(0.0, 0.0, r.yaw_rad), tip))


def both_plans(*overrides: str) -> list[tuple[SitlConfig, Plan, float, float]]:
    found = []
    for _, config in load_team("carry", overrides).members:
        plan = Plan.build(config.mission, config.vehicle)
        carry = plan.segments[2]
        found.append((config, plan, carry.start_s, carry.end_s))
    return found


def half_a_turn(from_deg: float) -> tuple[str, ...]:
    """Overrides with which the bar turns to a yaw and then by 180 deg, where neither direction is the shorter one."""
    waypoints = ",".join(f"{{position_m: [-0.6, 0.0], yaw_deg: {yaw}}}" for yaw in (from_deg, from_deg - 180.0))
    room = "vehicle.room={x_m: [-4, 4], y_m: [-4, 4], z_m: [0, 2.2]}"
    return "vehicle.tether=null", room, f"mission.phases[2].waypoints=[{waypoints}]"


@pytest.mark.parametrize(
    ("overrides", "yaws_deg"),
    [((), {90, 45}), (half_a_turn(135.0), {90, 135}), (half_a_turn(100.0), {90, 100}), (half_a_turn(50.0), {90, 50})],
    ids=["shipped", "half a turn from 135 deg", "from 100 deg", "from 50 deg"],
)
def test_both_ends_of_the_bar_move_as_one_rigid_body(overrides: tuple[str, ...], yaws_deg: set[int]) -> None:
    (left, plan_l, begin_l, end_l), (right, plan_r, begin_r, end_r) = both_plans(*overrides)
    assert end_l - begin_l == pytest.approx(end_r - begin_r)
    turned = set()
    for n in range(200):
        after_s = (end_l - begin_l) * n / 200
        a, b = plan_l.reference(begin_l + after_s), plan_r.reference(begin_r + after_s)
        one, other = clamp_m(left, a), clamp_m(right, b)
        assert math.dist(one, other) == pytest.approx(LENGTH_M, abs=1e-6)
        yaw_rad = math.atan2(one[1] - other[1], one[0] - other[0])
        assert math.cos(a.yaw_rad - yaw_rad - math.pi) == pytest.approx(1.0)
        turned.add(round(math.degrees(yaw_rad)))
    assert yaws_deg <= turned


def test_velocity_and_acceleration_of_a_turning_end_are_those_of_its_path() -> None:
    _, plan, begin_s, end_s = both_plans()[0]
    for n in range(1, 60):
        t_s = begin_s + (end_s - begin_s) * n / 60
        before, now, after = (plan.reference(t_s + k * STEP_S) for k in (-1, 0, 1))
        for axis in range(3):
            p, v = (
                [r.position_world_m[axis] for r in (before, now, after)],
                [r.velocity_world_m_s[axis] for r in (before, after)],
            )
            assert now.velocity_world_m_s[axis] == pytest.approx((p[2] - p[0]) / (2 * STEP_S), abs=1e-5)
            assert now.acceleration_world_m_s2[axis] == pytest.approx((v[1] - v[0]) / (2 * STEP_S), abs=1e-3)


@pytest.mark.parametrize("after_s", [1.5, 6.0, 13.0, 24.0])
def test_a_landing_with_the_bar_is_over_within_ten_seconds_and_moves_the_arm_only_above_the_handle(
    after_s: float,
) -> None:
    """Half a second of them is for noticing why."""
    config, plan, begin_s, _ = both_plans()[0]
    parameters, vehicle, stands_m = Parameters.of(config), config.vehicle, 0.2
    now = plan.reference(begin_s + after_s)
    landing, opens_s = landing_with_bar(
        now,
        now.velocity_world_m_s,
        stands_m,
        parameters.manipulator,
        parameters.fold_rad,
        vehicle.safety.land_speed_m_s,
        vehicle,
    )
    course = [landing.reference(0.02 * n) for n in range(int(landing.duration_s / 0.02))]
    assert clamp_m(config, landing.reference(opens_s))[2] == pytest.approx(stands_m, abs=0.02)
    folds = next(r for r in course if r.arm_rad != now.arm_rad)
    assert clamp_m(config, folds)[2] > stands_m + 0.03
    down_s = 0.02 * sum(r.position_world_m[2] > vehicle.airframe.ground_clearance_m for r in course)
    assert down_s < 9.5
    last = course[round(down_s / 0.02)]
    assert last.arm_rad == pytest.approx(parameters.fold_rad, abs=0.01)
    assert math.dist(last.position_world_m[:2], landing.reference(opens_s).position_world_m[:2]) == pytest.approx(0.6)


@pytest.mark.parametrize("end", ["left", "right"])
def test_a_bar_that_the_other_one_has_lifted_is_followed_even_while_that_one_holds(end: str) -> None:
    """A hold of this vehicle at the instant of the lift has cancelled its own, and stopped the other in the air."""
    config: Any = getattr(load_team("carry"), end)
    grip: Any = config.mission.phases[1]
    i, partner = with_partner(healthy()), with_partner(healthy()).partner
    assert partner is not None and i.mocap is not None

    def lift_s(agreed_s: float | None = None, held_here: bool = False, **said: Any) -> float | None:
        heard = replace(partner, said=replace(partner.said, **said))
        air: Any = SimpleNamespace(i=replace(i, partner=heard), t_s=i.t_s, holds=held_here)
        found: float | None = grip._lift_server_s(air, Gripping(closed_s=i.t_s - 1.0, lift_server_s=agreed_s))
        return found

    now_s = i.mocap.exposure_server_s
    assert now_s is not None
    for holds in (False, True):
        assert lift_s(grip=Grip.CARRYING, holds=holds) == now_s
        assert lift_s(grip=Grip.CARRYING, holds=holds, agreed_s=now_s + 0.1) == now_s + 0.1
    assert lift_s(grip=Grip.READY, holds=True, agreed_s=now_s) is None, "it has lifted nothing"
    assert lift_s(grip=Grip.CARRYING, holds=True, held_here=True) is None


@pytest.mark.parametrize(
    ("bar", "said"),
    [({"length_m": 0.8}, "two rotor circles"), ({"handle_height_m": 0.24}, "make the feet shorter: at most 0.23 m")],
    ids=["short", "high"],
)
def test_a_bar_that_brings_the_rotors_together_or_reaches_into_them_is_refused(
    bar: dict[str, float], said: str
) -> None:
    config = load_team("carry").left
    grip = config.mission.phases[1]
    other = grip.model_copy(update={"bar": grip.bar.model_copy(update=bar)})  # type: ignore[attr-defined]
    mission = config.mission.model_copy(
        update={"phases": (config.mission.phases[0], other, *config.mission.phases[2:])}
    )
    assert any(said in line for line in check_mission(mission, config.vehicle))


def test_a_mission_for_two_is_not_flown_by_one() -> None:
    config = load_flight("carry")
    assert any("flies alone: fly a team file" in line for line in check_mission(config.mission, config.vehicle))
